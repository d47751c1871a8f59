"""Shades spheres from an engine's own files as that engine does: a grid of spheres, or a scene's materials."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.engines.presets import Engine, File, engine_of_data, engines
from whitefurnace.errors import FileError, InputError, UnsupportedError, UsageError, nearest
from whitefurnace.files import (
    decode,
    digest_file,
    input_size,
    read_env,
    read_gltf_lights,
    read_manifest,
    read_npz,
    read_rgbd,
    read_sh,
    read_stored,
    read_texture,
    write_png,
)
from whitefurnace.files.texture import upright
from whitefurnace.prefiltering.reading import bilinear
from whitefurnace.scenes.material_spheres import DIELECTRIC, SphereLayout, in_range, layout_of, of_grid
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere import octahedral_map as octamap


@dataclass(frozen=True)
class Lights:
    """The content of an engine's files of one environment as its GPU has it, in the stored axes and decoded.

    levels      the specular chain, each (6, s, s, 3), or octahedral (s, s, 3) with `border` texels around it
    irradiance  (6, s, s, 3) E/π, None where the engine has no such cube
    sh          (9, 3) in the engine's scaling (`Engine.sh`), None where it uses none
    dfg         (h, w, 2 | 3 | 4), row 0 at v = 0, None where the engine has no table and `karis` replaces it
    read        paths of the files
    notices     sentences for users
    """

    levels: tuple[np.ndarray, ...]
    irradiance: np.ndarray | None = None
    sh: np.ndarray | None = None
    dfg: np.ndarray | None = None
    border: int = 1
    read: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()


# ------------------------------------------------------------------------------------------------- shading


def shade(
    engine: Engine,
    lights: Lights,
    n: np.ndarray,
    v: np.ndarray,
    base_color: Any,
    metalness: Any,
    roughness: Any,
    insulator: Any = DIELECTRIC,
) -> np.ndarray:
    """Return radiance (m, 3) of surface points towards the viewer, as the engine shades them by the environment alone.

    n, v: unit normals and view directions (3, m) in world axes, with n·v > 0. base_color: (3,) or (m, 3) in [0, 1].
    metalness, roughness: numbers or (m,) in [0, 1]; the roughness is perceptual. insulator: F0 of the insulating part,
    a number, (3,) or (m, 3).

    The engine decides what is read, where, and how it is weighted: its lod(r), direction and axes, seamless trilinear
    reads, its irradiance, its table read bilinearly on its own axes, and its energy compensation (`SHADINGS`). The
    result is linear in the stored values.
    """
    m = n.shape[1]
    r = np.maximum(np.broadcast_to(np.asarray(roughness, np.float64), (m,)), engine.least)
    metal = np.broadcast_to(np.asarray(metalness, np.float64), (m,))[:, None]
    color = np.broadcast_to(np.asarray(base_color, np.float64), (m, 3))
    NoV = np.clip((n * v).sum(0), 0, 1)
    diffuse = irradiance(engine, lights, n)
    blend = np.broadcast_to(engine.blend_formula(r=r, alpha=r * r), (m,))[:, None]
    radiance = specular(engine, lights, n, v, r)
    radiance = radiance + (diffuse - radiance) * blend
    A, B = split_sum(engine, lights.dfg, NoV, r)
    weights = SHADINGS[engine.shading](A[:, None], B[:, None], color, metal, r[:, None], NoV[:, None], insulator)
    return weights[0] * radiance + weights[1] * diffuse


def lods(engine: Engine, roughness: np.ndarray, levels: int, width: int) -> np.ndarray:
    """Return the lod in [0, levels - 1] that the engine reads for perceptual roughness values (m,).

    width: texels of a face edge of level 0.
    """
    lod = engine.lod_formula(r=roughness, alpha=roughness**2, max_lod=levels - 1, width=width)
    return np.clip(np.broadcast_to(lod, np.shape(roughness)), 0, levels - 1)


def looked_up(engine: Engine, n: np.ndarray, v: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Return the world directions (3, m) in which the engine reads the chain: the mirror direction, bent to the normal.

    n, v: unit normals and view directions (3, m). roughness: perceptual roughness (m,).
    """
    mirror = 2 * (n * v).sum(0) * n - v
    bend = engine.bend_formula(r=roughness, alpha=roughness**2)
    d = mirror + (n - mirror) * bend
    return np.asarray(d / np.sqrt((d * d).sum(0)))


def stored_directions(engine: Engine, d: np.ndarray) -> np.ndarray:
    """Return world directions d (3, m) in the axes of the stored cube, (3, m)."""
    return np.asarray(engine.matrix, np.float64) @ d


def level(texels: np.ndarray, d: np.ndarray, border: int = 1) -> np.ndarray:
    """Read a level bilinearly in stored directions d (3, m): (m, 3).

    texels: a cube (6, s, s, 3), or an octahedral map (s, s, 3) with `border` texels around it.
    """
    return bilinear(texels, d) if texels.ndim == 4 else octamap.read_bilinear(texels.astype(np.float64), d, border)


def trilinear(levels: Sequence[np.ndarray], d: np.ndarray, lod: np.ndarray, border: int = 1) -> np.ndarray:
    """Read a chain in stored directions d (3, m), bilinearly in two levels and linearly between them: (m, 3).

    lod: (m,) in [0, number of levels - 1].
    """
    value = np.zeros((d.shape[1], 3))
    for k, texels in enumerate(levels):
        weight = np.maximum(1 - np.abs(lod - k), 0)
        some = np.flatnonzero(weight)
        if len(some):
            value[some] += weight[some, None] * level(texels, d[:, some], border)
    return value


def specular(engine: Engine, lights: Lights, n: np.ndarray, v: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Return prefiltered radiance (m, 3) as the engine reads it.

    n, v: unit normals and view directions (3, m). roughness: perceptual roughness values (m,) in [0, 1].
    """
    lod = lods(engine, roughness, len(lights.levels), lights.levels[0].shape[1])
    return trilinear(lights.levels, stored_directions(engine, looked_up(engine, n, v, roughness)), lod, lights.border)


def irradiance(engine: Engine, lights: Lights, n: np.ndarray) -> np.ndarray:
    """Return E/π (m, 3) at normals n (3, m), from the harmonics, the cube or, as in three.js, the level of r = 1."""
    d = stored_directions(engine, n)
    if engine.sh is not None and lights.sh is not None:
        return np.maximum(harmonic.irradiance_at(harmonic.unscaled(lights.sh, engine.sh), d), 0)
    if lights.irradiance is not None:
        return bilinear(lights.irradiance, d)
    lod = lods(engine, np.ones(1), len(lights.levels), lights.levels[0].shape[1])
    return trilinear(lights.levels, d, np.repeat(lod, d.shape[1]), lights.border)


def split_sum(
    engine: Engine, dfg: np.ndarray | None, NoV: np.ndarray, roughness: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the terms (A, B), (m,) each, of E = F0·A + B with F90 = 1, read from the engine's table in its own form.

    dfg: the table; None for the fit `karis`. NoV, roughness: (m,) in [0, 1]; the roughness is perceptual.
    """
    if dfg is None:
        return karis(NoV, roughness)
    height, width = dfg.shape[:2]
    at = []
    for axis, count in ((engine.dfg.x, width), (engine.dfg.y, height)):
        if axis == "NoV":
            # An axis of √NoV has its ends on texels: u = (√NoV (N - 1) + ½)/N, which is texel √NoV (N - 1).
            place = np.sqrt(NoV) * (count - 1) if engine.dfg.NoV == "sqrt" else NoV * count - 0.5
        else:
            place = (roughness if axis == "roughness" else roughness**2) * count - 0.5
        at.append(np.clip(place, 0, count - 1))
    i, j = (np.minimum(np.floor(place).astype(int), count - 1) for place, count in ((at[1], height), (at[0], width)))
    t, s = at[1] - i, at[0] - j
    below, right = np.minimum(i + 1, height - 1), np.minimum(j + 1, width - 1)
    texel = dfg[..., :2].astype(np.float64)
    value = (1 - t)[:, None] * ((1 - s)[:, None] * texel[i, j] + s[:, None] * texel[i, right]) + t[:, None] * (
        (1 - s)[:, None] * texel[below, j] + s[:, None] * texel[below, right]
    )
    if engine.dfg.form == "multiscatter":  # (∫Fc, ∫1): E = mix(∫Fc, ∫1, F0)
        return value[:, 1] - value[:, 0], value[:, 0]
    return value[:, 0], value[:, 1]


def karis(NoV: np.ndarray, roughness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the terms (A, B) of the split sum by the fit of [Karis2014], for engines without a table of ours.

    The fit is for the masking of Unreal Engine 4 at the time. Under height-correlated Smith masking the albedo for F0 =
    1 is up to .51 larger, on rough surfaces at grazing angles.
    """
    x, y = 1 - roughness, 0.0425 - 0.0275 * roughness
    a004 = np.minimum(x * x, np.exp2(-9.28 * NoV)) * x + y
    return -1.04 * a004 + 1.04 - 0.572 * roughness, 1.04 * a004 + 0.022 * roughness - 0.04


Weights = tuple[np.ndarray, np.ndarray]
"""Weights of the specular radiance and of E/π, (m, 3) each."""


def _split_sum(
    A: np.ndarray,
    B: np.ndarray,
    color: np.ndarray,
    metal: np.ndarray,
    r: np.ndarray,
    NoV: np.ndarray,
    insulator: Any = DIELECTRIC,
) -> Weights:
    """Weight as [Karis2013] does: the energy that single scattering loses is not restored."""
    E = (insulator + (color - insulator) * metal) * A + B
    return E, color * (1 - metal) * (1 - E)


def _scaled(
    A: np.ndarray,
    B: np.ndarray,
    color: np.ndarray,
    metal: np.ndarray,
    r: np.ndarray,
    NoV: np.ndarray,
    insulator: Any = DIELECTRIC,
) -> Weights:
    """Weight as Filament does: E · (1 + F0 (1/E₁ - 1)) with E₁ = A + B, the albedo for F0 = 1; diffuse light gets 1
    - E.
    """
    F0 = insulator + (color - insulator) * metal
    E = F0 * A + B
    return E * (1 + F0 * (1 / (A + B) - 1)), color * (1 - metal) * (1 - E)


def _babylon(
    A: np.ndarray,
    B: np.ndarray,
    color: np.ndarray,
    metal: np.ndarray,
    r: np.ndarray,
    NoV: np.ndarray,
    insulator: Any = DIELECTRIC,
) -> Weights:
    """Weight as Babylon.js 9 does: the specular term as in Filament, the diffuse term with 1 - F0.

    The diffuse weight does not depend on the specular term, which is Babylon's default
    (LEGACY_SPECULAR_ENERGY_CONSERVATION).
    """
    return _scaled(A, B, color, metal, r, NoV, insulator)[0], color * (1 - insulator) * (1 - metal)


def _fdez_aguera(
    A: np.ndarray,
    B: np.ndarray,
    color: np.ndarray,
    metal: np.ndarray,
    r: np.ndarray,
    NoV: np.ndarray,
    insulator: Any = DIELECTRIC,
) -> Weights:
    """Weight as three.js and Bevy do: [FdezAguera2019] for the dielectric and for the metal alone, mixed by
    metalness.
    """

    def scattered(F0: Any) -> tuple[np.ndarray, np.ndarray]:
        once, lost, average = F0 * A + B, 1 - (A + B), F0 + (1 - F0) / 21
        return once, once * average / (1 - lost * average) * lost

    (once, again), (metal_once, metal_again) = scattered(insulator), scattered(color)
    return (
        once + (metal_once - once) * metal,
        again + (metal_again - again) * metal + color * (1 - metal) * (1 - once - again),
    )


def _khronos(
    A: np.ndarray,
    B: np.ndarray,
    color: np.ndarray,
    metal: np.ndarray,
    r: np.ndarray,
    NoV: np.ndarray,
    insulator: Any = DIELECTRIC,
) -> Weights:
    """Weight as Khronos glTF Sample Viewer does.

    It is [FdezAguera2019] with a Fresnel term that depends on roughness, multiplied by radiance.
    """

    def fresnel(F0: Any) -> np.ndarray:
        k = F0 + (np.maximum(1 - r, F0) - F0) * (1 - NoV) ** 5
        once, lost, average = k * A + B, 1 - (A + B), F0 + (1 - F0) / 21
        return np.asarray(once + lost * once * average / (1 - average * lost))

    dielectric = fresnel(insulator)
    return dielectric + (fresnel(color) - dielectric) * metal, color * (1 - dielectric) * (1 - metal)


SHADINGS: Mapping[str, Callable[..., Weights]] = {
    "split_sum": _split_sum,
    "scaled": _scaled,
    "babylon": _babylon,
    "fdez_aguera": _fdez_aguera,
    "khronos": _khronos,
}
"""For each `Engine.shading`, a function from (A, B, base colour, metalness, r, NoV, F0 of insulators) to the weights of
radiance and of E/π."""


# ------------------------------------------------------------------------------------------------- files


def read_lights(engine: Engine, folder: str | os.PathLike[str], stem: str) -> Lights:
    """Read back the content of an engine's files of a bake.

    folder: DIR/ENGINE. stem: the files' common stem. Raises FileError and InputError for files that are missing or not
    valid, UnsupportedError for an engine that gets no prefiltered chain and for formats that are not decoded.
    """
    folder = Path(folder)
    if engine.container != "files":
        return _read_everything(engine, folder, stem)
    paths: list[Path] = []

    def found(holds: str) -> tuple[File, Path] | None:
        for file in engine.holding(holds):
            paths.append(folder / file.name.replace("{stem}", stem))
            return file, paths[-1]
        return None

    chain = found("specular")
    if chain is None:
        given = ", ".join(file.name.replace("{stem}", stem) for file in engine.file)
        raise UnsupportedError(
            f"{engine.name} is given {given} and filters it itself, so the bake has no prefiltered chain to render from"
        )
    file, path = chain
    sh: np.ndarray | None = None
    border = 1
    if file.layout == "octahedral":
        levels, border = _maps(file, path, folder.parent / f"{stem}.json")
    elif file.suffix == ".env":
        env = read_env(path)
        levels, sh = env.levels, env.polynomials
    elif file.suffix == ".gltf":
        light = read_gltf_lights(path)[0]
        levels, sh = light.levels, light.coefficients
    else:
        levels = _texels(path, cube=True)
    if engine.sh is not None and sh is None:
        of = found("sh")
        sh = None if of is None else read_sh(of[1])
    diffuse, table = found("irradiance"), found("dfg")
    notices = []
    if engine.sh is None and diffuse is None:
        notices.append(
            "its diffuse light is the level of roughness 1"
            + ("" if engine.proven else ", which stands in for what the engine makes of the image itself")
        )
    if table is None:
        notices.append("it has no split-sum table of ours: Karis's fit stands in for it")
    return Lights(
        levels,
        None if diffuse is None else _texels(diffuse[1], cube=True)[0],
        sh,
        None if table is None else _table(*table),
        border,
        tuple(map(str, paths)),
        tuple(notices),
    )


def _read_everything(engine: Engine, folder: Path, stem: str) -> Lights:
    """The content of a bake for `raw` or `exr`, with a cube of E/π and the table of (A, B)."""
    if engine.container == "npz":
        path = folder / f"{stem}.npz"
        held = read_npz(path)
        count = sum(name.startswith("specular_") for name in held)
        try:
            levels = tuple(held[f"specular_{k}"] for k in range(count))
            cube, table = held["irradiance"], held["dfg"]
        except KeyError as error:
            raise InputError(f"{path} has no {error.args[0]}: it is not a bake for raw") from None
        read = [path]
    else:
        read = []
        while (path := folder / f"{stem}_specular_{len(read)}.exr").is_file():
            read.append(path)
        if not read:
            raise FileError(f"cannot read {path}: there is no such file")
        read += [folder / f"{stem}_irradiance.exr", folder / f"{stem}_dfg.exr"]
        *images, table = (read_stored(path) for path in read)
        *levels_, cube = (image[..., :3].reshape(-1, image.shape[1], image.shape[1], 3) for image in images)
        levels = tuple(levels_)
    if (
        not levels
        or any(t.ndim != 4 or t.shape[0] != 6 or t.shape[1] != t.shape[2] or t.shape[3] != 3 for t in (*levels, cube))
        or table.ndim != 3
        or table.shape[2] < 2
    ):
        raise InputError(f"{read[0]}: its levels are not cubes of (6, s, s, 3) with a table (h, w, 2)")
    return Lights(levels, cube, None, table, read=tuple(map(str, read)))


def _texels(path: Path, *, cube: bool) -> tuple[np.ndarray, ...]:
    """The levels of a texture, with three channels if it is a cube. Raises InputError for another shape."""
    texture = read_texture(path)
    if texture.cube != cube or texture.layers:
        raise InputError(f"{path} is not a single {'cube' if cube else '2-D image'}")
    levels = tuple(upright(decode(texture, k), texture.orientation) for k in range(len(texture.levels)))
    if cube and levels[0].shape[-1] < 3:
        raise InputError(f"{path} has {levels[0].shape[-1]} channels, radiance has 3")
    return tuple(level[..., :3] for level in levels) if cube else levels


def _maps(file: File, path: Path, manifest: Path) -> tuple[tuple[np.ndarray, ...], int]:
    """Return octahedral levels and the border around each. Raises InputError.

    They are the mips of a texture, whose edges a sampler repeats, or those of an atlas, as many as the manifest states.
    """
    if file.suffix != ".exr":
        levels = tuple(texels[..., :3] for texels in _texels(path, cube=False))
        if any(texels.shape[0] != texels.shape[1] for texels in levels):
            raise InputError(f"{path} is not a square, an octahedral map is")
        return tuple(np.pad(texels, ((1, 1), (1, 1), (0, 0)), "edge") for texels in levels), 1
    image = read_stored(path)[..., :3]
    files = _listed(dictionary(read_manifest(manifest)))
    rows, b = dictionary(files.get(f"{path.parent.name}/{path.name}")).get("levels"), file.border
    count = len(rows) if isinstance(rows, list) else 0
    # Level 0 and its border, and at its right, where there are more, level 1 and its own (octamap.atlas_places).
    size = image.shape[1] - 2 * b if count == 1 else (image.shape[1] - 4 * b) * 2 // 3
    try:
        places = octamap.atlas_places(size, count, b)
    except ValueError:
        raise InputError(f"{path} is not an atlas of the {count} octahedral levels that {manifest} states") from None
    if any(p.row + p.side + b > image.shape[0] or p.column + p.side + b > image.shape[1] for p in places):
        raise InputError(f"{path} of {image.shape[1]} x {image.shape[0]} has no room for {count} levels from {size}")
    levels = octamap.from_atlas(image, places, b)
    return (levels, b) if b else (tuple(np.pad(one, ((1, 1), (1, 1), (0, 0)), "edge") for one in levels), 1)


def _table(file: File, path: Path) -> np.ndarray:
    if file.suffix == ".png":
        return read_rgbd(path)
    return read_stored(path) if file.suffix == ".exr" else _texels(path, cube=False)[0]


def engine_in(manifest: str | os.PathLike[str], name: str) -> tuple[Engine, Path, str]:
    """Return (engine, its folder, stem) of a bake, from its manifest. The preset is the one that it was baked with.

    Raises InputError for a file that is not the manifest of a bake, or that lists files which are missing or changed;
    UsageError for an engine that it was not baked for.
    """
    path = Path(manifest)
    input_size(path, "a manifest")
    found = read_manifest(path)
    listed = _listed(dictionary(found))
    if found is None or not listed or not isinstance(found.get("name"), str):
        raise InputError(f"{path} is not the manifest of a bake")
    names = sorted({entry.split("/")[0] for entry in listed if "/" in entry})
    recipe = dictionary(dictionary(dictionary(found.get("recipe")).get("engines")).get(name))
    chosen = (engine_of_data(recipe["engine"], str(path)),) if "engine" in recipe else engines(name)
    if len(chosen) != 1:
        raise UsageError(f"{name} are {len(chosen)} engines; a picture is of one")
    engine = chosen[0]
    if engine.name not in names:
        raise UsageError(f"{path} was not baked for {name}; it has {', '.join(names)}")
    for entry, stated in listed.items():
        if entry.split("/")[0] != engine.name:
            continue
        file = path.parent / entry
        if not file.exists():
            raise FileError(f"cannot read {file}: {path} lists it and it is not there")
        if digest_file(file) != dictionary(stated).get("sha256"):
            raise InputError(f"{file} is not the file that {path} lists: it was changed since the bake")
    return engine, path.parent / engine.name, found["name"]


def _listed(manifest: dict[str, Any]) -> dict[str, Any]:
    return {**dictionary(manifest.get("kept")), **dictionary(manifest.get("files"))}


def dictionary(value: Any) -> dict[str, Any]:
    """Return the value if it is a dictionary, otherwise an empty one."""
    return value if isinstance(value, dict) else {}


# ------------------------------------------------------------------------------------------------- picture

SIZE_RANGE = (8, 2048)
MOST_PIXELS = 1 << 26
BACKGROUNDS = ("environment", "plain")
EXPOSURES = 64.0
RADIUS = 0.45
"""Radius of a sphere, in edges of its cell."""

VIEW = math.radians(60)
"""Vertical angle of the camera that sees the background, in radians. The spheres are seen in parallel, from +z."""

GREY = 0.18
"""Linear value of a plain background."""


@dataclass(frozen=True)
class Rendered:
    """A picture that was written.

    width, height         pixels
    roughness, metalness  of the columns and of the rows of a grid
    exposure              stops
    read                  paths of the files that were read
    materials             of a scene: each material's name, row, column and the values of its sphere
    """

    path: Path
    engine: str
    width: int
    height: int
    roughness: tuple[float, ...]
    metalness: tuple[float, ...]
    exposure: float
    read: tuple[str, ...]
    notices: tuple[str, ...]
    materials: tuple[dict[str, object], ...] = ()


def sphere(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels that a sphere covers in a cell of size² pixels.

    They are flat indices (m,), coverage (m,) in [0, 1], and normals (3, m). The sphere is seen from +z. A pixel at the
    rim, whose centre may lie outside the sphere, has the normal of the rim.
    """
    radius = RADIUS * size
    at = (np.arange(size) + 0.5 - size / 2) / radius
    x, y = np.tile(at, size), np.repeat(-at, size)
    far = np.hypot(x, y)
    cover = np.clip((1 - far) * radius + 0.5, 0, 1)
    index = np.flatnonzero(cover)
    # Normals stay short of the rim, where n·v would be 0.
    short = np.minimum(far[index], 1 - 1e-6) / np.maximum(far[index], 1e-300)
    x, y = x[index] * short, y[index] * short
    return index, cover[index], np.stack([x, y, np.sqrt(1 - x * x - y * y)])


def grid(
    engine: Engine,
    lights: Lights,
    *,
    columns: int = 7,
    rows: int = 3,
    size: int = 128,
    base_color: Sequence[float] = (1.0, 1.0, 1.0),
    background: str = "environment",
) -> np.ndarray:
    """Draw a grid of spheres: (rows · size, columns · size, 3) linear radiance, seen along -z.

    Roughness goes from 0 to 1 from left to right, metalness from 0 to 1 from the top down (1 where there is one row).
    size: pixels of a sphere's cell. base_color: colour of all spheres, in [0, 1]. background: "environment" for the
    image, "plain" for grey. Raises UsageError for values out of range.
    """
    return drawn(engine, lights, of_grid(columns, rows, base_color), size=size, background=background)


def drawn(
    engine: Engine, lights: Lights, spheres: SphereLayout, *, size: int = 128, background: str = "environment"
) -> np.ndarray:
    """Draw a layout of spheres as `grid` does: (rows · size, columns · size, 3) linear radiance.

    Where the last row has fewer spheres, the rest is background. Raises UsageError for values out of range.
    """
    columns, rows = spheres.columns, spheres.rows
    in_range("size", size, SIZE_RANGE)
    if columns * rows * size * size > MOST_PIXELS:
        raise UsageError(f"{columns} × {rows} spheres of {size} pixels are more than {MOST_PIXELS} pixels")
    if background not in BACKGROUNDS:
        raise UsageError(f"unknown background {background!r}{nearest(background, BACKGROUNDS)}")
    index, cover, n = sphere(size)
    v = np.broadcast_to(np.array([[0.0], [0.0], [1.0]]), n.shape)
    picture = np.empty((rows * size, columns * size, 3))
    for i in range(rows):
        band = slice(i * size, (i + 1) * size)
        picture[band] = _behind(engine, lights, picture.shape, band) if background == "environment" else GREY
        for j, of in enumerate(spheres.spheres[i * columns : (i + 1) * columns]):
            cell = picture[band, j * size : (j + 1) * size].reshape(-1, 3)  # a copy
            lit = shade(engine, lights, n, v, of.base_color, of.metalness, of.roughness, np.asarray(of.insulator))
            cell[index] += (lit - cell[index]) * cover[:, None]
            picture[band, j * size : (j + 1) * size] = cell.reshape(size, size, 3)
    return picture


def camera(shape: tuple[int, ...], band: slice = slice(None)) -> np.ndarray:
    """Return the world directions (3, m) of the pixels in the rows `band` of a picture.

    shape: (height, width, …) of the picture. The camera looks along -z with +y up.
    """
    height, width = shape[:2]
    scale = 2 * math.tan(VIEW / 2) / height
    x = (np.arange(width) + 0.5 - width / 2) * scale
    y = (height / 2 - 0.5 - np.arange(height)[band]) * scale
    d = np.stack([np.tile(x, len(y)), np.repeat(y, width), np.full(width * len(y), -1.0)])
    return np.asarray(d / np.sqrt((d * d).sum(0)))


def _behind(engine: Engine, lights: Lights, shape: tuple[int, ...], band: slice) -> np.ndarray:
    """Return level 0 as the camera sees it in the rows `band` of a picture."""
    d = stored_directions(engine, camera(shape, band))
    return level(lights.levels[0], d, lights.border).reshape(-1, shape[1], 3)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Return linear values as sRGB in [0, 1], without a tone curve: values above 1 become 1 [IEC 61966-2-1]."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def render(
    manifest: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    for_: str,
    size: int = 128,
    columns: int = 7,
    rows: int | None = None,
    exposure: float = 0.0,
    base_color: Sequence[float] | None = None,
    background: str = "environment",
    scene: str | os.PathLike[str] | None = None,
    force: bool = False,
) -> Rendered:
    """Draw the spheres of a bake for one engine into a PNG in sRGB, as radiance times 2^exposure, clipped at 1.

    manifest: the manifest of the bake. for_: the engine. size: pixels of a sphere's cell. columns, rows: size of the
    grid; 3 rows by default. base_color: colour of the grid's spheres, 1 1 1 by default. exposure: stops. background:
    "environment" or "plain". scene: a glTF file whose materials are drawn instead of the grid. force: replace an
    existing file.

    Raises UsageError for a value out of range or an engine that was not baked for, and the FileError, InputError and
    UnsupportedError of `engine_in`, `read_lights` and `read_scene`.
    """
    output = Path(output)
    if output.suffix.lower() != ".png":
        raise UsageError(f"{output} is not the name of a PNG: it must end with .png")
    if not -EXPOSURES <= exposure <= EXPOSURES:
        raise UsageError(f"exposure {exposure:g} is outside [{-EXPOSURES:g}, {EXPOSURES:g}]")
    if output.exists() and not force:
        raise FileError(f"{output} exists; --force replaces it")
    engine, folder, stem = engine_in(manifest, for_)
    lights = read_lights(engine, folder, stem)
    spheres = layout_of(scene, columns, rows, base_color)
    picture = drawn(engine, lights, spheres, size=size, background=background)
    write_png(output, srgb(picture * 2.0**exposure))
    return Rendered(
        output,
        engine.name,
        picture.shape[1],
        picture.shape[0],
        spheres.roughness,
        spheres.metalness,
        exposure,
        lights.read,
        (*lights.notices, *spheres.notices),
        spheres.placed(),
    )
