"""The presets before the engines themselves: three.js, Babylon.js and Filament load their files in headless Chromium.
What they render is held against the files, read as the preset says, against closed forms, and against our renderer.

`make test-engines` installs the engines; without them all of this is skipped. WHITEFURNACE_NODE_MODULES names the
folder with their packages, WHITEFURNACE_CHROMIUM another browser. Renders stay as PNG in the tests' folders.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reference
from browser import Answer, PageError, chromium, glb, rendered
from whitefurnace.catalogue import model
from whitefurnace.engines.presets import ENGINES, Engine
from whitefurnace.files import decode
from whitefurnace.files.codec import encode
from whitefurnace.files.containers import read_texture, write_texture
from whitefurnace.files.env import EnvMap, read_env, write_env
from whitefurnace.files.exr import write_exr
from whitefurnace.files.packing import unpack
from whitefurnace.files.png import decode_png, write_png
from whitefurnace.files.texture import text_value
from whitefurnace.prefiltering.reading import bilinear
from whitefurnace.rendering.shading import irradiance, read_lights, shade, specular, split_sum
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere.grids import turned_cube

pytestmark = pytest.mark.engines

NAMES = ("three", "babylon", "filament")
SNIPPETS = (*NAMES, "bevy", "gltf", "khronos")
PACKAGES = ("three", "@babylonjs/core", "filament")


@pytest.fixture(scope="session")
def node_modules() -> Path:
    """The folder with the engines' npm packages."""
    folder = os.environ.get("WHITEFURNACE_NODE_MODULES")
    if not folder:
        pytest.skip("WHITEFURNACE_NODE_MODULES names no folder with the engines (make test-engines installs them)")
    missing = [name for name in PACKAGES if not Path(folder, name, "package.json").is_file()]
    if missing:
        pytest.skip(f"{folder} has no {', '.join(missing)}")
    if chromium() is None:
        pytest.skip("Chromium is not installed")
    try:
        able = rendered("probe", [], Path(folder), Path(folder), timeout=60).about
    except PageError as error:
        pytest.skip(f"Chromium opens no page here: {error}")
    if not (able["webgl"] and able["floats"] and able["blocks"]):
        pytest.skip(f"Chromium has no WebGL 2 with float canvases and BC6H here: {able}")
    return Path(folder).resolve()


# ------------------------------------------------------------------------------------------------- what is lit

SIZE = 128
HALF = math.sqrt(0.5)
AXIS = np.array([0.36, 0.48, 0.8])
"""Of the red channel, oblique to all faces."""

PATCHES = {
    (1, 0, 0): (3, 0),
    (-1, 0, 0): (0, 3),
    (0, 1, 0): (3, 3),
    (0, -1, 0): (1.5, 0),
    (0, 0, 1): (0, 1.5),
    (0, 0, -1): (1.5, 3),
}
"""What is added to green and blue in each direction: no two alike."""

SPREAD = 0.15


def legendre6(x: np.ndarray) -> np.ndarray:
    return (231 * x**6 - 315 * x**4 + 105 * x**2 - 5) / 16


def light(d: np.ndarray) -> np.ndarray:
    """Radiance (..., 3) from directions (..., 3): in red one spherical harmonic, which lobes only scale [Funk & Hecke];
    in green and blue slopes, and a patch of its own on every axis."""
    x, y, z = np.moveaxis(d, -1, 0)
    out = 0.5 + np.stack([0.45 * legendre6(d @ AXIS), 0.2 * x - 0.1 * z, 0.3 * y], -1)
    for axis, (green, blue) in PATCHES.items():
        bump = np.exp((d @ np.array(axis, float) - 1) / SPREAD**2)
        out[..., 1] += green * bump
        out[..., 2] += blue * bump
    return out


def factor6(roughness: float) -> float:
    """What the prefilter lobe of GGX makes of Y₆: ∫ K P₆ / ∫ K over s = 1 - l·r [Funk & Hecke]."""
    if roughness == 0:
        return 1.0
    alpha = roughness**2
    # s = e^y, as the lobe spans s ~ α²: panels of Gauss nodes from 1e-6 α² to 1.
    y, w = reference.gauss(64)
    low = math.log(1e-6 * alpha**2)
    edges = np.linspace(low, 0, 9)
    s = np.exp((edges[:-1, None] + np.diff(edges)[:, None] * y).ravel())
    weight = (np.diff(edges)[:, None] * w).ravel() * s * reference.ggx_lobe(alpha)(s)
    return float((weight * legendre6(1 - s)).sum() / weight.sum())


# ------------------------------------------------------------------------------------------------- what is shown

White, Gold = (1.0, 1.0, 1.0), (1.0, 0.6, 0.2)
ROUGHNESS = (0.0, 0.25, 0.5, 0.75, 1.0)
MATERIALS = (*((White, 1.0, r) for r in ROUGHNESS), (Gold, 1.0, 0.5), (White, 0.0, 0.5), (White, 0.0, 1.0))
"""Base colour, metallic, roughness."""

BLACK, GREY = (((x, x, x), 0.0, 0.5) for x in (0.0, 0.5))
SHEENS = ((White, 0.25), (White, 0.5), (White, 1.0), (Gold, 0.4), (White, 0.5))
BELOW = (BLACK, BLACK, BLACK, BLACK, GREY)
"""Colour and roughness of sheens, and the materials under them."""

VIEWS = (np.array([0.2, 0.3, 0.933]), np.array([-0.48, -0.6, -0.64]))
TILE = 8
FAR = 100.0


def frame(view: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Towards the camera, right and up, orthonormal."""
    v = view / np.linalg.norm(view)
    right = np.cross([0.0, 1.0, 0.0], v)
    right /= np.linalg.norm(right)
    return v, right, np.cross(v, right)


def normals_about(view: np.ndarray) -> np.ndarray:
    """(8, 3): the view itself, and normals that lean from it by up to 70°, of which every mirror direction differs."""
    v, right, up = frame(view)
    tilt = np.radians([0, 20, 35, 45, 50, 60, 65, 70])
    turn = np.radians([0, 10, 100, 190, 280, 55, 145, 260])
    return np.cos(tilt)[:, None] * v + np.sin(tilt)[:, None] * (
        np.cos(turn)[:, None] * right + np.sin(turn)[:, None] * up
    )


@dataclass(frozen=True)
class Scene:
    """What the engines render: a job without its files, and per mesh and column normal and view, (rows, columns, 3)."""

    job: Mapping[str, Any]
    normals: np.ndarray
    views: np.ndarray

    def values(self, image: np.ndarray) -> np.ndarray:
        """(rows, columns, 3): the middle of each tile."""
        rows, columns = self.normals.shape[:2]
        tiles = image.reshape(image.shape[0] // TILE, TILE, image.shape[1] // TILE, TILE, 3)
        return tiles[:rows, TILE // 2, :columns, TILE // 2]


def tiles(view: np.ndarray, materials: Sequence[Any] = MATERIALS, sheens: Sequence[Any] = ()) -> Scene:
    """A wall of flat tiles seen from far off, a material in a row and a normal in a column: unlike on a sphere, the
    normal of a pixel is known, and no derivative of it roughens anything."""
    v, right, up = frame(view)
    normals = normals_about(view)
    n = max(len(normals), len(materials))
    eye = FAR * n / 2 * v
    meshes, views = [], np.empty((len(materials), len(normals), 3))
    for row, (color, metallic, roughness) in enumerate(materials):
        positions = []
        for column in range(len(normals)):
            corners = [
                (column - n / 2 + dx) * right + (n / 2 - row - dy) * up for dx, dy in ((0, 0), (0, 1), (1, 1), (1, 0))
            ]
            positions += corners
            # The pixel that `values` takes is half a pixel right of and below the middle.
            away = eye - (np.mean(corners, 0) + 0.5 / TILE * (right - up))
            views[row, column] = away / np.linalg.norm(away)
        quads = np.arange(len(normals))[:, None] * 4 + np.array([0, 1, 2, 0, 2, 3])
        meshes.append(
            {
                "positions": np.ravel(positions).tolist(),
                "normals": np.repeat(normals, 4, 0).ravel().tolist(),
                "indices": quads.ravel().tolist(),
                "color": color,
                "metallic": metallic,
                "roughness": roughness,
            }
        )
        if sheens:
            meshes[-1]["sheen"] = dict(zip(("color", "roughness"), sheens[row], strict=True))
    camera = {
        "eye": eye.tolist(),
        "target": [0, 0, 0],
        "up": up.tolist(),
        "fov": math.degrees(2 * math.atan(1 / FAR)),
        "near": 0.9 * FAR * n / 2,
        "far": 1.1 * FAR * n / 2,
    }
    return Scene({"size": n * TILE, "camera": camera, "meshes": meshes}, np.broadcast_to(normals, views.shape), views)


SCENES = [tiles(view) for view in VIEWS]
CLOTHS = tiles(VIEWS[0], BELOW, SHEENS)

BALLS = 5
BALL_SIZE = 320


def balls() -> Scene:
    """A grid of spheres, metals above, rougher to the right: as people look at materials."""
    u, w = np.meshgrid(np.linspace(0, 2 * np.pi, 97), np.linspace(0, np.pi, 49))
    sphere = np.stack([np.sin(w) * np.cos(u), np.cos(w), np.sin(w) * np.sin(u)], -1).reshape(-1, 3)
    corner = (np.arange(48)[:, None] * 97 + np.arange(96)).ravel()
    indices = (corner[:, None] + np.array([0, 1, 98, 0, 98, 97])).ravel().tolist()
    meshes, centres = [], []
    for metallic, y in ((1.0, 1.1), (0.0, -1.1)):
        for k, roughness in enumerate(ROUGHNESS):
            centres.append((2.2 * (k - 2), y, 0.0))
            meshes.append(
                {
                    "positions": (sphere + centres[-1]).ravel().tolist(),
                    "normals": sphere.ravel().tolist(),
                    "indices": indices,
                    "color": White,
                    "metallic": metallic,
                    "roughness": roughness,
                }
            )
    half, away = 5.6, 300.0
    camera = {
        "eye": [0, 0, away],
        "target": [0, 0, 0],
        "up": [0, 1, 0],
        "fov": math.degrees(2 * math.atan(half / away)),
        "near": away - 5,
        "far": away + 5,
    }
    ray = (np.arange(BALL_SIZE) + 0.5) / BALL_SIZE * 2 - 1
    d = np.stack([*np.meshgrid(ray * half, -ray * half), np.full((BALL_SIZE, BALL_SIZE), -away)], -1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    normals = np.zeros((len(meshes), BALL_SIZE, BALL_SIZE, 3))
    for out, centre in zip(normals, centres, strict=True):
        e = np.array([0, 0, away]) - centre
        b = d @ e
        root = b**2 - (e @ e - 1)
        hit = root > 0
        out[hit] = (e + (-b - np.sqrt(np.maximum(root, 0)))[..., None] * d)[hit]
    return Scene({"size": BALL_SIZE, "camera": camera, "meshes": meshes}, normals, np.broadcast_to(-d, normals.shape))


# ------------------------------------------------------------------------------------------------- how engines shade

Radiance = Callable[[np.ndarray, float], np.ndarray]
"""(m, 3) of directions (m, 3) at a lod."""

Irradiance = Callable[[np.ndarray], np.ndarray]
"""E/π (m, 3) at normals (m, 3)."""

Table = Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]]
"""The engine's DFG, (m,) each, at n·v (m,) and a roughness."""


@dataclass(frozen=True)
class Chain:
    levels: int
    width: int


def bent(engine: Engine, n: np.ndarray, v: np.ndarray, roughness: float) -> np.ndarray:
    mirror = 2 * (n * v).sum(-1, keepdims=True) * n - v
    share = float(engine.bend_formula(r=roughness, alpha=roughness**2))
    d = mirror + (n - mirror) * share
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def shaded(
    engine: Engine,
    material: tuple[Sequence[float], float, float],
    n: np.ndarray,
    v: np.ndarray,
    chain: Chain,
    radiance: Radiance,
    irradiance: Irradiance,
    table: Table,
) -> np.ndarray:
    """(m, 3): what an engine makes of light. Where it reads is the preset's; what it does with it is copied from its
    shaders (lights_physical_pars_fragment of three.js, pbrBlockFinalLitComponents of Babylon.js, surface_light_indirect
    of Filament)."""
    least = WASM_LEAST if engine.name == "filament" else engine.least
    color, metallic, roughness = np.asarray(material[0]), material[1], max(material[2], least)
    nov = (n * v).sum(-1)
    diffuse = irradiance(n)
    lit = radiance(bent(engine, n, v, roughness), engine.lods.at(roughness, chain.levels, chain.width))
    lit = lit + (diffuse - lit) * float(engine.blend_formula(r=roughness, alpha=roughness**2))
    f0 = 0.04 * (1 - metallic) + color * metallic
    a, b = (part[:, None] for part in table(nov, roughness))
    if engine.name == "three":  # scale and bias; Fdez-Agüera's compensation
        single = f0 * a + b
        mean = f0 + (1 - f0) / 21
        lost = 1 - a - b
        multiple = single * mean / (1 - lost * mean) * lost
        base = 0.04 * a + b
        mean = 0.04 + 0.96 / 21
        kept = 1 - base - base * mean / (1 - lost * mean) * lost
        return lit * single + diffuse * multiple + color * (1 - metallic) * kept * diffuse
    albedo = a + (b - a) * f0  # (∫Fc, ∫1)
    compensated = albedo * (1 + f0 * (1 / b - 1))
    if engine.name == "filament":
        return lit * compensated + color * (1 - metallic) * (1 - albedo) * diffuse
    return lit * compensated + color * (1 - 0.04) * (1 - metallic) * diffuse  # its LEGACY_SPECULAR_ENERGY_CONSERVATION


WASM_LEAST = 0.089
"""Filament's MIN_PERCEPTUAL_ROUGHNESS for OpenGL ES and WebGL; the preset has that of its desktop builds."""


def bilinear_table(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(m, channels) of a table (rows, columns, channels) at coordinates in [0, 1], clamped to its edges."""
    rows, columns = values.shape[:2]
    out = np.zeros((len(x), values.shape[2]))
    x, y = (np.clip(np.broadcast_to(t, x.shape) * n - 0.5, 0, n - 1) for t, n in ((x, columns), (y, rows)))
    j, i = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
    for dj, di in itertools.product((0, 1), (0, 1)):
        weight = np.abs(1 - dj - (x - j)) * np.abs(1 - di - (y - i))
        out += weight[:, None] * values[i + di, j + dj]
    return out


def table_of(engine: Engine, about: Mapping[str, Any]) -> Table:
    """The engine's own table: what the preset says of its axes is held too. Filament does not show its own: exact
    albedos, of a roughness that is one texel of 64 higher, as its table is (coord = (h - y + 0.5)/h in its cmgen)."""
    if engine.name == "filament":

        def exact(nov: np.ndarray, roughness: float) -> tuple[np.ndarray, np.ndarray]:
            whole, schlick = reference.ggx_albedo_1d(nov, np.full(nov.shape, min(roughness + 1 / 64, 1.0) ** 2))
            return schlick, whole

        return exact
    size = about["dfg"]["size"]
    assert size == engine.dfg.size
    if engine.name == "three":
        values = np.array(about["dfg"]["halves"], np.uint16).view(np.float16).astype(np.float64).reshape(size, size, 2)
    else:
        values = np.array(about["dfg"]["floats"]).reshape(size, size, 4)

    def read(nov: np.ndarray, roughness: float) -> tuple[np.ndarray, np.ndarray]:
        at = {"NoV": nov, "roughness": np.full(nov.shape, roughness), "alpha": np.full(nov.shape, roughness**2)}
        found = bilinear_table(values, at[engine.dfg.x], at[engine.dfg.y])
        return found[:, 0], found[:, 1]

    return read


# ------------------------------------------------------------------------------------------------- files


def written(engine: Engine, levels: Sequence[np.ndarray], sh: np.ndarray, path: Path) -> Path:
    """Levels (6, s, s, 3) and radiance harmonics (9, 3) of the world in the preset's container, format and axes."""
    file = engine.holding("specular")[0]
    turned = [turned_cube(level.astype(np.float32), engine.matrix) for level in levels]
    path = path.with_suffix(file.suffix)
    stored = harmonic.turned(sh, np.array(engine.matrix))
    if file.suffix == ".env":
        write_env(path, EnvMap(tuple(turned), harmonic.babylon(stored)))
        return path
    keys = {}
    if engine.sh == "filament":
        rows = harmonic.filament(stored)
        keys["sh"] = text_value("".join(" ".join(f"{x:.9g}" for x in row) + "\n" for row in rows))
    write_texture(path, encode(file.stored, turned, cube=True, key_values=keys).texture, zstd=file.zstd)
    return path


@dataclass(frozen=True)
class Held:
    """What a file holds: levels as stored, and E/π at the engine's normals where it has harmonics."""

    levels: list[np.ndarray]
    irradiance: Irradiance | None


def babylon_at(rows: np.ndarray, n: np.ndarray) -> np.ndarray:
    """The polynomial x y z xx yy zz yz zx xy as materials show it: by SphericalHarmonics.FromPolynomial, which undoes a
    cosine kernel that Babylon's own exporter applies twice: × 1, 3/2 and 4 by degree."""
    x, y, z = n.T
    slope, square = rows[:3], rows[3:6]
    mean = square.mean(0)
    traceless = np.stack([x * x, y * y, z * z, y * z, z * x, x * y], -1) @ np.concatenate([square - mean, rows[6:]])
    return mean + 1.5 * n @ slope + 4 * traceless


def filament_at(rows: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Filament's Irradiance_SphericalHarmonics (surface_light_indirect.fs)."""
    x, y, z = n.T
    terms = [np.ones_like(x), y, z, x, y * x, y * z, 3 * z * z - 1, z * x, x * x - y * y]
    return np.maximum(np.stack(terms, -1) @ rows, 0)


def held(path: Path) -> Held:
    if path.suffix == ".env":
        env = read_env(path)
        assert env.polynomials is not None
        return Held(list(env.levels), lambda n: babylon_at(env.polynomials, n))
    texture = read_texture(path)
    levels = [decode(texture, k)[..., :3] for k in range(len(texture.levels))]
    if "sh" not in texture.key_values:
        return Held(levels, None)
    rows = np.array(texture.key_values["sh"].rstrip(b"\0").decode().split(), float).reshape(9, 3)
    return Held(levels, lambda n: filament_at(rows, n))


def as_read(engine: Engine, path: Path) -> tuple[Chain, Radiance, Irradiance]:
    """The file by our own reading convention: the preset's axes, seamless bilinear, linear between levels."""
    found = held(path)
    chain = Chain(len(found.levels), found.levels[0].shape[1])
    turn = np.array(engine.matrix, float)

    def radiance(d: np.ndarray, lod: float) -> np.ndarray:
        low = min(int(lod), chain.levels - 1)
        high = min(low + 1, chain.levels - 1)
        a, b = (bilinear(found.levels[k], turn @ d.T) for k in (low, high))
        return a + (b - a) * (lod - low)

    own = found.irradiance
    # Without harmonics the last level is read as diffuse light (three.js).
    return chain, radiance, (lambda n: own(n @ turn.T)) if own else (lambda n: radiance(n, chain.levels - 1.0))


# ------------------------------------------------------------------------------------------------- renders


@dataclass(frozen=True)
class Rendered:
    engine: Engine
    files: Mapping[str, Path]
    answer: Answer
    table: Table

    def wanted(self, name: str, scene: Scene) -> np.ndarray:
        chain, radiance, irradiance = as_read(self.engine, self.files[name])
        return np.stack(
            [
                shaded(self.engine, material, n, v, chain, radiance, irradiance, self.table)
                for material, n, v in zip(MATERIALS, scene.normals, scene.views, strict=True)
            ]
        )


@pytest.fixture(scope="module")
def baked(tmp_path_factory) -> Path:
    """The folder that `bake --for` fills from an image of `light`."""
    folder = tmp_path_factory.mktemp("baked")
    rows = 256
    phi, theta = np.meshgrid((np.arange(2 * rows) + 0.5) / rows * np.pi - np.pi, (np.arange(rows) + 0.5) / rows * np.pi)
    d = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    write_exr(folder / "light.exr", light(d).astype(np.float32))
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "whitefurnace",
            "bake",
            str(folder / "light.exr"),
            "-o",
            str(folder),
            "--for",
            ",".join(SNIPPETS),
            "--size",
            str(SIZE),
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module", params=NAMES)
def engine(request, node_modules, baked, tmp_path_factory) -> Rendered:
    """An engine's renders of every file, in one run of the browser."""
    preset = ENGINES[request.param]
    folder = tmp_path_factory.mktemp(preset.name)
    files = {}
    sizes = [SIZE >> k for k in range(SIZE.bit_length()) if SIZE >> k >= preset.min_size]
    # Red rises with the level, green falls, blue is here and there: no two lods look alike.
    steps = [np.array([(k + 1) / 8, 1 - k / 8, 0.25 + 0.5 * (k % 2)]) for k in range(len(sizes))]
    flat = np.zeros((9, 3))
    flat[0] = 2 * math.sqrt(math.pi)
    for file, values in (("levels", steps), ("furnace", np.ones((len(sizes), 3)))):
        levels = [np.broadcast_to(value, (6, s, s, 3)) for value, s in zip(values, sizes, strict=True)]
        files[file] = written(preset, levels, flat, folder / file)
    name = preset.holding("specular")[0].name.replace("{stem}", "light")
    files["light"] = folder / name
    shutil.copy(baked / preset.name / name, files["light"])
    jobs = []
    for file, scenes in (("levels", SCENES[:1]), ("furnace", [SCENES[0], CLOTHS]), ("light", [*SCENES, balls()])):
        for k, scene in enumerate(scenes):
            geometry = folder / f"{file}{k}.glb"
            geometry.write_bytes(glb(scene.job["meshes"]))
            jobs.append(
                {
                    **scene.job,
                    "name": f"{file}{k}",
                    "environment": f"/files/{files[file].name}",
                    "steps": preset.steps,  # as they are printed
                    "glb": f"/files/{geometry.name}",
                }
            )
    if preset.name == "babylon":  # the one of the three that can be given a table
        shutil.copy(baked / preset.name / "light_dfg.png", folder)
        cloth = next(job for job in jobs if job["name"] == "furnace1")
        jobs.append({**cloth, "name": "table", "table": "/files/light_dfg.png"})
    answer = rendered(preset.name, jobs, node_modules, folder)
    for name, image in answer.images.items():
        shown = np.clip(image, 0, 1)
        shown = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
        write_png(folder / f"{preset.name}-{name}.png", np.round(255 * shown).astype(np.uint8))
    return Rendered(preset, files, answer, table_of(preset, answer.about))


# ------------------------------------------------------------------------------------------------- tests

CANVAS = 2.0**-11
"""Of a value below 1: Filament draws into halves, Babylon.js and Filament hold cubes in them. SwiftShader weighs texels
and levels in float32, where GPUs have 8 bits for it."""


def agree(got: np.ndarray, want: np.ndarray, tolerance: float, what: str) -> None:
    off = np.abs(got - want)
    row, column, channel = np.unravel_index(off.argmax(), off.shape)
    assert off.max() <= tolerance, (
        f"{what}: {MATERIALS[row]}, normal {column}, channel {channel}: {got[row, column]}, wanted {want[row, column]}"
    )


def test_the_lod_of_every_roughness_is_the_presets(engine):
    """Levels of one value each, up to .5 apart: what is seen says which lod was read, to .004 of a level."""
    got = SCENES[0].values(engine.answer.images["levels0"])
    agree(got, engine.wanted("levels", SCENES[0]), 4 * CANVAS, engine.engine.name)


def test_a_furnace_shows_what_the_engine_keeps_of_it(engine):
    """Radiance and irradiance of 1: the scale of the harmonics, and the table on the preset's axes."""
    got = SCENES[0].values(engine.answer.images["furnace0"])
    agree(got, engine.wanted("furnace", SCENES[0]), 4 * CANVAS, engine.engine.name)
    # A white metal is exactly white in all three, whatever its roughness.
    assert np.abs(got[:5] - 1).max() <= 2 * CANVAS


def fit_of_three(nov: np.ndarray, roughness: float) -> np.ndarray:
    """IBLSheenBRDF of three.js (lights_physical_pars_fragment)."""
    inverse = 1 / (roughness + 0.1)
    a = -1.9362 + 1.0678 * roughness + 0.4573 * roughness**2 - 0.8469 * inverse
    b = -0.6014 + 0.5538 * roughness - 0.4670 * roughness**2 - 0.1255 * inverse
    return np.clip(np.exp(a * nov + b), 0, 1)


def charlie_by_tanh_sinh(nov: np.ndarray, roughness: float) -> np.ndarray:
    """The albedo of Charlie under Neubelt's V, by another quadrature than ours."""
    D, V = model("ndf", "charlie").reference["D"], model("masking", "ashikhmin").reference["V"]

    def at(c: float) -> float:
        zero = lambda up: np.zeros_like(up)  # noqa: E731
        return reference.albedo_by_tanh_sinh(lambda t: D(t, alpha=roughness**2), V, lambda c: 1.0, zero, c)

    return np.array([at(float(c)) for c in nov])


def sheens_in_a_furnace(
    engine: Rendered, table: Table, albedo: Callable[[np.ndarray, float], np.ndarray]
) -> np.ndarray:
    """(sheens, normals, 3): each sheen in light of 1, c E + (1 - max c E) of what is below, as all three engines do it.

    Under a sheen the glTF materials of Filament's JavaScript build are matte: they reflect diffuse light alone."""

    def one(directions: np.ndarray, *_: float) -> np.ndarray:
        return np.ones((len(directions), 3))

    found = []
    for (color, roughness), base, n, v in zip(SHEENS, BELOW, CLOTHS.normals, CLOTHS.views, strict=True):
        below = shaded(engine.engine, base, n, v, Chain(5, 128), one, one, table)
        if engine.engine.name == "filament":
            below = np.broadcast_to(base[0], below.shape)
        E = albedo((n * v).sum(-1), roughness)[:, None]
        found.append(np.asarray(color) * E + (1 - max(color) * E) * below)
    return np.array(found)


def test_a_sheen_in_a_furnace_is_shaded_as_the_preset_says(engine):
    """Babylon.js and Filament by a table of Charlie under Neubelt's V, three.js by its fit."""
    name, albedo, tolerance = engine.engine.name, fit_of_three, 4 * CANVAS
    if name == "babylon":
        size = engine.answer.about["dfg"]["size"]
        own = np.array(engine.answer.about["dfg"]["floats"]).reshape(size, size, 4)
        albedo = lambda nov, r: bilinear_table(own, nov, np.full(nov.shape, r))[:, 2]  # noqa: E731
        # What is in its table, beside how it is read: 8 bits with a divisor are a step of 1e-2 at 1.
        for r in (0.25, 0.5, 1.0):
            nov = np.linspace(0.1, 0.95, 18)
            assert np.abs(albedo(nov, r) - charlie_by_tanh_sinh(nov, r)).max() <= 1e-2, r
    elif name == "filament":
        # Its table of 64² is one row off and has 1024 samples a texel.
        albedo = lambda nov, r: charlie_by_tanh_sinh(nov, min(r + 1 / 64, 1.0))  # noqa: E731
        tolerance = 5e-3
    want = sheens_in_a_furnace(engine, engine.table, albedo)
    got = CLOTHS.values(engine.answer.images["furnace1"])
    np.testing.assert_allclose(got, want, rtol=0, atol=tolerance)


def test_babylon_reads_the_table_of_a_bake(engine, baked):
    """STEM_dfg.png as the scene's environmentBRDFTexture: its three channels shade what is below and the sheen."""
    if engine.engine.name != "babylon":
        pytest.skip("it cannot be given a table")
    code = decode_png((baked / "babylon" / "light_dfg.png").read_bytes())
    ours = unpack("rgbd", code, code.shape[:-1]).astype(np.float64)

    def table(nov: np.ndarray, roughness: float) -> tuple[np.ndarray, np.ndarray]:
        found = bilinear_table(ours, nov, np.full(nov.shape, roughness))
        return found[:, 0], found[:, 1]

    got = CLOTHS.values(engine.answer.images["table"])
    read = sheens_in_a_furnace(engine, table, lambda nov, r: bilinear_table(ours, nov, np.full(nov.shape, r))[:, 2])
    np.testing.assert_allclose(got, read, rtol=0, atol=4 * CANVAS)
    # And what is right: albedos up to .8 in steps of 8 bits.
    right = sheens_in_a_furnace(engine, table, charlie_by_tanh_sinh)
    np.testing.assert_allclose(got, right, rtol=0, atol=1e-2)


def test_the_bake_is_read_as_the_preset_says(engine):
    """The bake's own file, by our convention of reading: axes, bend, blend, lods, harmonics, faces' rows and edges."""
    for k, scene in enumerate(SCENES):
        got = scene.values(engine.answer.images[f"light{k}"])
        # Values go up to 4.
        agree(got, engine.wanted("light", scene), 4 * CANVAS, f"{engine.engine.name}, view {k}")


def test_the_image_is_the_right_way_round(engine):
    """Of all 48 ways to turn and mirror a cube, the engine shows the one that is none, by far."""
    got, d = [], []
    for k, scene in enumerate(SCENES):
        got.append(scene.values(engine.answer.images[f"light{k}"])[0])
        n, v = scene.normals[0], scene.views[0]
        d.append(2 * (n * v).sum(-1, keepdims=True) * n - v)
    fits = {}
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)[:, None]
            fits[order, signs] = np.sqrt(np.mean((np.concatenate(got) - light(np.concatenate(d) @ turn.T)) ** 2))
    best = sorted(fits, key=fits.__getitem__)
    assert best[0] == ((0, 1, 2), (1, 1, 1)), (best[0], fits[best[0]])
    # The least roughness, not 0, blurs the patches by a few percent (Filament); the next best is .1 off.
    assert fits[best[1]] > 5 * fits[best[0]], (best[1], fits[best[1]], fits[best[0]])


def test_rough_metal_shows_the_lobe_of_its_roughness(engine):
    """From radiance to pixel: the red channel is a harmonic, of which the lobe of r leaves `factor6(r)`; between levels
    engines interpolate linearly. No file of ours is read here."""
    preset = engine.engine
    texture = held(engine.files["light"])
    chain = Chain(len(texture.levels), texture.levels[0].shape[1])
    factors = [factor6(preset.lods.roughness(float(k), chain.levels, chain.width)) for k in range(chain.levels)]

    def radiance(d: np.ndarray, lod: float) -> np.ndarray:
        factor = np.interp(lod, range(chain.levels), factors)
        return np.repeat((0.5 + 0.45 * factor * legendre6(d @ AXIS))[:, None], 3, 1)

    def irradiance(n: np.ndarray) -> np.ndarray:
        # Harmonics of degree 2 hold nothing of degree 6.
        return np.full((len(n), 3), 0.5) if preset.sh else radiance(n, chain.levels - 1.0)

    for k, scene in enumerate(SCENES):
        got = scene.values(engine.answer.images[f"light{k}"])[:5, :, 0]
        want = np.stack(
            [
                shaded(preset, material, n, v, chain, radiance, irradiance, engine.table)[:, 0]
                for material, n, v in zip(MATERIALS[:5], scene.normals, scene.views, strict=False)
            ]
        )
        # Bilinear reads cut the tops of Y₆ off: by l(l + 1)/2 · h²/8 each way, h = π/2/16 the coarsest texel of levels
        # that hold some of it, .13 of it: 1.2e-2; and level 0 is the mean over a texel.
        np.testing.assert_allclose(got, want, rtol=0, atol=0.018)


def test_a_white_surface_shows_the_irradiance(engine, baked):
    """From radiance to pixel again: degrees 0 to 2 of E/π of `light`, by quadrature over a cube; in three.js, which has
    no harmonics, all of it, as the lobe of r = 1 is the cosine's."""
    preset = engine.engine
    texels = light(reference.cube_directions(64))
    d = reference.cube_directions(64).reshape(-1, 3)
    weight = np.abs(d).max(1) ** 3  # a texel's solid angle
    kernel = np.array([1.0, *[2 / 3] * 3, *[1 / 4] * 5])[:, None]
    coefficients = kernel * (4 * np.pi * (harmonic.basis(d.T) * weight) @ texels.reshape(-1, 3) / weight.sum())

    def irradiance(n: np.ndarray) -> np.ndarray:
        if preset.sh is None:
            return reference.exact_lobe(texels, 0.0, n, reference.ggx_lobe(1.0), 1)
        return harmonic.basis(n.T).T @ coefficients

    # Canvases of halves, coefficients to 6 digits (Babylon's FromPolynomial).
    tolerance = 4 * CANVAS
    if preset.sh is None:
        # What the manifest states of the level's format; and 8² texels, h = .25 at most, cut E off where a patch sets:
        # by h/4 of the kinks, .135 high.
        files = json.loads((baked / "light.json").read_text())["files"]
        stated = files[f"three/{engine.files['light'].name}"]["levels"][-1]["format_worst"]
        tolerance = stated * float(texels.mean()) + 0.01
    chain, radiance, _ = as_read(preset, engine.files["light"])
    for k, scene in enumerate(SCENES):
        got = scene.values(engine.answer.images[f"light{k}"])[-1]
        want = shaded(
            preset, MATERIALS[-1], scene.normals[-1], scene.views[-1], chain, radiance, irradiance, engine.table
        )
        np.testing.assert_allclose(got, want, rtol=0, atol=tolerance)


def test_three_takes_blocks_too(node_modules, tmp_path):
    """A DDS of BC6H: DDSLoader makes no cube of it, and the page shows how it becomes one. An eighth of the memory."""
    pytest.importorskip("ispc_texcomp")
    preset = ENGINES["three"]
    levels = [
        turned_cube(light(reference.cube_directions(s)) * (1 - k / 10), preset.matrix)
        for k, s in enumerate((64, 32, 16, 8))
    ]
    write_texture(tmp_path / "light.dds", encode("bc6hu", levels, cube=True).texture)
    job = {**SCENES[0].job, "name": "light", "environment": "/files/light.dds"}
    answer = rendered("three", [job], node_modules, tmp_path)
    three = Rendered(preset, {"light": tmp_path / "light.dds"}, answer, table_of(preset, answer.about))
    agree(SCENES[0].values(answer.images["light"]), three.wanted("light", SCENES[0]), 1e-5, "three")


def smoothed(engine: Engine, roughness: float, n: np.ndarray) -> np.ndarray:
    """What specular antialiasing makes of a roughness where normals (size, size, 3) turn, by differences in quads of
    2 x 2 pixels: three.js in lights_physical_fragment, Filament's glTF materials by normalFiltering [Tokuyoshi2019]."""
    across, down = (np.diff(n, axis=a).take(range(0, BALL_SIZE, 2), a).repeat(2, a) for a in (1, 0))
    if engine.name == "three":
        return np.minimum(roughness + np.maximum(np.abs(across), np.abs(down)).max(-1), 1)
    if engine.name == "filament":
        kernel = np.minimum(2 * 0.15 * ((across**2).sum(-1) + (down**2).sum(-1)), 0.2)
        return np.minimum(roughness**4 + kernel, 1) ** 0.25
    return np.full(n.shape[:-1], roughness)


def test_our_renderer_shows_the_same_spheres(engine, baked):
    """Every pixel of a grid of spheres by `whitefurnace render`'s own shading, from the files of the bake alone."""
    preset = engine.engine
    lights = read_lights(preset, baked / preset.name, "light")
    scene, image = balls(), engine.answer.images["light2"]
    offs = []
    for (metallic, roughness), n, v in zip(
        itertools.product((1.0, 0.0), ROUGHNESS), scene.normals, scene.views, strict=True
    ):
        # At the rim a pixel is more than one normal, and a hair of position is a large angle.
        seen = (n * v).sum(-1) > 0.4
        least = WASM_LEAST if preset.name == "filament" else preset.least
        want = shade(
            preset, lights, n[seen].T, v[seen].T, White, metallic, smoothed(preset, max(roughness, least), n)[seen]
        )
        offs.append(np.abs(image[seen] - want).max(-1))
    off = np.concatenate(offs)
    # Tables of engines are up to .022 off (of .04 + Fc), ours 1e-3; the mesh of 96 x 48 quads turns normals by 1e-3, on
    # sharp spheres twice that of slopes of 3 e^-½/SPREAD = 12 per radian.
    assert np.median(off) <= 2e-3 and np.quantile(off, 0.99) <= 0.02, np.quantile(off, [0.5, 0.9, 0.99, 1])


POINTS = 32
"""A side of the square of random points at which snippets are asked."""

SHOWS = {
    "radiance": "specular_radiance(n, v, r)",
    "irradiance": "irradiance(n)",
    "albedo": "specular_albedo(vec3(0.9, 0.5, 0.1), dot(n, v), r)",
}


def test_snippets_read_the_files_on_a_gpu_as_our_renderer_does(node_modules, baked, tmp_path):
    """The GLSL beside every bake, compiled by WebGL 2, with the bake's files as its textures."""
    rng = np.random.default_rng(5)
    n, v = rng.normal(size=(2, POINTS * POINTS, 3))
    n, v = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (n, v))
    v = np.where((n * v).sum(1, keepdims=True) < 0, -v, v)
    r = rng.random(len(n))
    r[:8] = 0, 1, 0, 1, 0.5, 0.25, 1e-3, 0.999

    def given(name: str, image: np.ndarray) -> dict[str, Any]:
        """Of (..., height, width, up to 4 channels), as floats on the page's server."""
        whole = np.zeros((*image.shape[:-1], 4), np.float32)
        whole[..., : image.shape[-1]] = image
        (tmp_path / name).write_bytes(whole.tobytes())
        return {"url": f"/files/{name}", "width": image.shape[-2], "height": image.shape[-3]}

    square = (POINTS, POINTS, -1)
    points = {
        "normals": [given("normals", np.column_stack([n, r]).reshape(square))],
        "views": [given("views", v.reshape(square))],
    }
    jobs, wanted = [], {}
    for name in SNIPPETS:
        preset, lights = ENGINES[name], read_lights(ENGINES[name], baked / name, "light")
        shutil.copy(baked / name / "light.glsl", tmp_path / f"{name}.glsl")
        assert lights.dfg is not None
        textures = points | {
            "dfg_map": [given(f"{name}-dfg", lights.dfg)],
            "specular_map": [given(f"{name}-{k}", level) for k, level in enumerate(lights.levels)],
        }
        if lights.irradiance is not None:
            textures["irradiance_map"] = [given(f"{name}-irradiance", lights.irradiance)]
        for what, show in SHOWS.items():
            jobs.append(
                {
                    "name": f"{name}-{what}",
                    "size": POINTS,
                    "snippet": f"/files/{name}.glsl",
                    "show": show,
                    "textures": textures,
                    "sh": None if lights.sh is None else np.ravel(lights.sh).tolist(),
                }
            )
        rough = np.maximum(r, preset.least)
        share = preset.blend_formula(r=rough, alpha=rough**2) * np.ones((len(r), 1)).T
        diffuse = irradiance(preset, lights, n.T)
        lit = specular(preset, lights, n.T, v.T, rough)
        a, b = split_sum(preset, lights.dfg, (n * v).sum(1), rough)
        wanted |= {
            f"{name}-radiance": lit + (diffuse - lit) * share.T,
            f"{name}-irradiance": diffuse,
            f"{name}-albedo": a[:, None] * np.array([0.9, 0.5, 0.1]) + b[:, None],
        }
    images = rendered("snippet", jobs, node_modules, tmp_path).images
    for name, want in wanted.items():
        off = np.abs(images[name].reshape(-1, 3) - want)
        worst = np.unravel_index(off.argmax(), off.shape)[0]
        # float32 of directions and lods, over slopes of 12 per radian and .5 a level: SwiftShader filters in it too.
        assert off.max() <= 2e-5, (name, off.max(), n[worst], v[worst], r[worst], want[worst])
