"""The files of a bake: for each engine what is written where, and what its format costs."""
from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.engines.presets import Engine, File
from whitefurnace.engines.snippets import LANGUAGES, snippet
from whitefurnace.errors import UsageError
from whitefurnace.files import (
    EnvMap,
    GltfLight,
    Texture,
    Transaction,
    decode,
    encode,
    pack,
    pack_hdr,
    text_value,
    unpack,
    unpack_hdr,
    write_atomic,
    write_env,
    write_exr,
    write_gltf_lights,
    write_hdr,
    write_npz,
    write_png,
    write_texture,
)
from whitefurnace.prefiltering.certificate import texel_errors
from whitefurnace.prefiltering.convolution import Level
from whitefurnace.prefiltering.lighting import Filtered, Lighting
from whitefurnace.prefiltering.recipe import DFG_SIZE, IRRADIANCE_SIZE, Chain
from whitefurnace.results import Integrated
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere.grids import turned_cube
from whitefurnace.sphere.octahedral_map import to_atlas
from whitefurnace.tables.split_sum import SplitSum
from whitefurnace.version import VERSION


@dataclass(frozen=True)
class Target:
    """One file of a bake: its path, what writes it there, and what the manifest says of it."""

    path: Path
    engine: str
    nbytes: int
    """Bytes of its arrays, before any compression."""
    write: Callable[[Transaction], object] | None = None
    told: Mapping[str, Any] = field(default_factory=dict)
    levels: tuple[np.ndarray, ...] = ()
    """Of a specular chain, what a GPU reads of each level, in this project's directions."""


@dataclass(frozen=True)
class Made:
    """What a bake made for one engine: its chain (and Charlie's), the light they share, its tables, who it is."""

    lit: Lighting
    chain: Filtered
    sheen: Filtered | None
    table: Integrated
    split: SplitSum | None
    window: harmonic.Windowed
    provenance: Mapping[str, str]


def targets(engine: Engine, chain: Chain, folder: Path, stem: str, made: Made | None = None) -> list[Target]:
    """The files of an engine under `folder`/ENGINE; with the results at hand, also what writes them."""
    if engine.container != "files":
        return CONTAINERS[engine.container](engine, chain, folder, stem, made)
    found = [_WRITERS[file.holds](engine, chain, folder / engine.name / file.name.replace("{stem}", stem), file, made)
             for file in engine.file]
    if engine.holding("specular"):
        for language in LANGUAGES:
            text = snippet(engine, language, levels=len(chain.levels), width=chain.size, stem=stem).encode()
            found.append(_bytes(engine, folder / engine.name / f"{stem}.{language}", text, {"holds": "shader snippet"}))
    return found


def _bytes(engine: Engine, path: Path, data: bytes, told: Mapping[str, Any]) -> Target:
    return Target(path, engine.name, len(data),
                  lambda t: write_atomic(path, lambda temporary: temporary.write_bytes(data), t), told)


# ---------------------------------------------------------------------------------------------- what formats cost


def _stored(kept: np.ndarray, true: np.ndarray, mean: float) -> dict[str, float]:
    """What a format adds to a level: p99 and largest of its texel errors."""
    off = texel_errors(kept.reshape(-1, 3).astype(np.float64), true.reshape(-1, 3).astype(np.float64), mean)
    return {"format_p99": float(np.quantile(off, 0.99)), "format_worst": float(off.max())}


def _level_told(level: Level, kept: np.ndarray, true: np.ndarray) -> dict[str, Any]:
    mean = float(true.astype(np.float64).mean())
    return {"size": int(true.shape[-2]), "roughness": level.roughness, "error": level.error,
            **_stored(kept[..., :3], true, mean)}


def _clipped(clipped: Sequence[int]) -> dict[str, Any]:
    return {"clipped": int(sum(clipped))} if sum(clipped) else {}


def _keys(engine: Engine, made: Made, errors: Sequence[float]) -> dict[str, bytes]:
    """What a container tells of itself; the manifest tells the rest."""
    return {"KTXwriter": text_value(f"whitefurnace {VERSION}"), "whitefurnace:engine": text_value(engine.name),
            "whitefurnace:key": text_value(made.provenance["key"]),
            "whitefurnace:error": text_value(" ".join(f"{e:.2e}" for e in errors))}


# ---------------------------------------------------------------------------------------------- cubes


def _texture(engine: Engine, path: Path, file: File, levels: Sequence[Level], made: Made,
             keys: Mapping[str, bytes], coverage: Sequence[Level] = ()) -> Target:
    """Cube levels in a pixel format, turned to the engine's axes, with what the format costs each."""
    turned = [turned_cube(level.texels, engine.matrix) for level in levels]
    held: list[np.ndarray] = turned
    if coverage and file.stored in ("rgba16f", "rgba32f"):
        held = [np.concatenate([texels, turned_cube(alpha.texels, engine.matrix)[..., :1]], -1)
                for texels, alpha in zip(turned, coverage, strict=True)]
    if path.suffix == ".dds":
        keys = {}  # has no place for them
    encoded = encode(file.stored, held, cube=True, key_values=keys)
    back = [decode(encoded.texture, k) for k in range(len(levels))]
    told = {"holds": file.holds, "format": file.stored, **_clipped(encoded.clipped),
            "levels": [_level_told(*one) for one in zip(levels, back, turned, strict=True)]}
    inverse = np.array(engine.matrix).T
    return Target(path, engine.name, _size(encoded.texture),
                  lambda t: write_texture(path, encoded.texture, zstd=file.zstd, into=t), told,
                  tuple(turned_cube(texels[..., :3], inverse) for texels in back))


def _size(texture: Texture) -> int:
    return sum(memoryview(level).nbytes for level in texture.levels)


def _square_bytes(size: int, file: File, channels: int = 3) -> int:
    """Bytes of size² texels before any compression."""
    per = {"b10g11r11": 4, "rgb9e5": 4, "rg16f": 4, "rgbd": 4, "rgba16f": 8, "rgba32f": 16, "float32": 4 * channels}
    if file.stored in per:
        return size * size * per[file.stored]
    return (-(-size // 4)) ** 2 * 16  # blocks of 4 × 4


def _cube_bytes(sizes: Sequence[int], file: File) -> int:
    return 6 * sum(_square_bytes(size, file) for size in sizes)


def _specular(engine: Engine, chain: Chain, path: Path, file: File, made: Made | None) -> Target:
    sizes = [s for s, _ in chain.levels]
    if made is None:
        if file.layout == "octahedral" and file.border > sizes[-1]:
            raise UsageError(f"{engine.name}: a border of {file.border} texels does not go around the last level's "
                             f"{sizes[-1]}²; give a lower border or a larger --min-size")
        return Target(path, engine.name, _cube_bytes(sizes, file) // (6 if file.layout == "octahedral" else 1))
    if file.layout == "octahedral":
        return _octahedral(engine, path, file, made)
    levels, coverage = made.chain.levels, made.chain.coverage
    errors = [level.error for level in levels]
    if file.suffix == ".env":
        return _env(engine, path, levels, made)
    if file.suffix == ".gltf":
        return _gltf(engine, path, levels, made)
    keys = _keys(engine, made, errors)
    if engine.sh == "filament" and file.suffix == ".ktx":
        keys["sh"] = text_value("".join(" ".join(f"{x:.9g}" for x in row) + "\n" for row in _sh(engine, made)))
    return _texture(engine, path, file, levels, made, keys, coverage)


def _sheen(engine: Engine, chain: Chain, path: Path, file: File, made: Made | None) -> Target:
    if made is None:
        return Target(path, engine.name, _cube_bytes([s for s, _ in chain.levels], file))
    assert made.sheen is not None
    keys = _keys(engine, made, [level.error for level in made.sheen.levels])
    return _texture(engine, path, file, made.sheen.levels, made, keys, made.sheen.coverage)


def _skybox(engine: Engine, chain: Chain, path: Path, file: File, made: Made | None) -> Target:
    if made is None:
        return Target(path, engine.name, _cube_bytes([chain.size], file))
    level = made.chain.levels[0]
    return _texture(engine, path, file, [level], made, _keys(engine, made, [level.error]), made.chain.coverage[:1])


def _irradiance(engine: Engine, chain: Chain, path: Path, file: File, made: Made | None) -> Target:
    if made is None:
        return Target(path, engine.name, _cube_bytes([IRRADIANCE_SIZE], file))
    level = made.lit.irradiance
    return _texture(engine, path, file, [level], made, _keys(engine, made, [level.error]))


def _octahedral(engine: Engine, path: Path, file: File, made: Made) -> Target:
    """Octahedral maps: mips of a texture, or one image of bordered levels, whose places the manifest tells."""
    levels, coverage = made.chain.octahedral, made.chain.octahedral_coverage
    maps = [level.texels for level in levels]
    told: dict[str, Any] = {"holds": file.holds, "format": file.stored, "layout": "octahedral", "border": file.border}
    if coverage and file.stored in ("rgba16f", "rgba32f", "float32"):
        maps = [np.concatenate([texels, alpha.texels[..., :1]], -1)
                for texels, alpha in zip(maps, coverage, strict=True)]
    if file.suffix == ".exr":
        image, places = to_atlas(maps, file.border)
        told["levels"] = [{"size": p.side, "roughness": level.roughness, "error": level.error, "row": p.row,
                           "column": p.column} for level, p in zip(levels, places, strict=True)]
        texts = {f"whitefurnace:{name}": value for name, value in made.provenance.items()}
        return Target(path, engine.name, image.nbytes, lambda t: write_exr(
            path, image, channel_names=tuple("RGBA"[:image.shape[-1]]), attributes=texts, into=t), told)
    keys = {} if path.suffix == ".dds" else _keys(engine, made, [level.error for level in levels])
    encoded = encode(file.stored, maps, key_values=keys)
    told |= _clipped(encoded.clipped)
    told["levels"] = [_level_told(level, decode(encoded.texture, k), level.texels) for k, level in enumerate(levels)]
    return Target(path, engine.name, _size(encoded.texture),
                  lambda t: write_texture(path, encoded.texture, zstd=file.zstd, into=t), told)


# ---------------------------------------------------------------------------------------------- harmonics


def _sh(engine: Engine, made: Made) -> np.ndarray:
    """(9, 3): the windowed harmonics in the engine's axes and scaling."""
    assert engine.sh is not None
    scaled = getattr(harmonic, engine.sh)(harmonic.turned(made.window.values, engine.matrix))
    return np.asarray(scaled, np.float64)


SH_NAMES = ("L00", "L1-1", "L10", "L11", "L2-2", "L2-1", "L20", "L21", "L22")
POLYNOMIAL_NAMES = ("x", "y", "z", "xx", "yy", "zz", "yz", "zx", "xy")


def _sh_file(engine: Engine, chain: Chain, path: Path, file: File, made: Made | None) -> Target:
    if made is None:
        return Target(path, engine.name, 9 * 3 * 8)
    rows = _sh(engine, made)
    names = POLYNOMIAL_NAMES if engine.sh == "babylon" else SH_NAMES
    if file.suffix == ".json":
        text = json.dumps(dict(zip(names, rows.tolist(), strict=True)), indent=2) + "\n"
    else:
        what = "irradiance, pre-scaled base" if engine.sh == "filament" else engine.sh
        text = "".join(f"({r:18.15f}, {g:18.15f}, {b:18.15f}); // {name}, {what}\n"
                       for name, (r, g, b) in zip(names, rows, strict=True))
    return _bytes(engine, path, text.encode(), {"holds": "sh", "scale": engine.sh, "error": made.lit.sh_error})


# ---------------------------------------------------------------------------------------------- whole files


def _rgbd(levels: Sequence[Level], engine: Engine) -> tuple[list[np.ndarray], list[np.ndarray], int]:
    """Levels turned to the engine's axes, what RGBD makes of them, and how many values it clips."""
    turned = [turned_cube(level.texels, engine.matrix) for level in levels]
    packed = [pack("rgbd", texels) for texels in turned]
    return turned, [unpack("rgbd", p.data, t.shape[:-1]) for p, t in zip(packed, turned, strict=True)], sum(
        p.clipped for p in packed)


def _whole(engine: Engine, path: Path, levels: Sequence[Level], made: Made,
           write: Callable[[Sequence[np.ndarray], Transaction], object]) -> Target:
    """A container of RGBD faces with harmonics."""
    turned, back, clipped = _rgbd(levels, engine)
    told = {"holds": "specular, sh", "format": "rgbd", **_clipped([clipped]), "scale": engine.sh,
            "sh_error": made.lit.sh_error,
            "levels": [_level_told(*one) for one in zip(levels, back, turned, strict=True)]}
    inverse = np.array(engine.matrix).T
    return Target(path, engine.name, sum(6 * 4 * t.shape[1] ** 2 for t in turned), lambda t: write(turned, t), told,
                  tuple(turned_cube(texels, inverse) for texels in back))


def _env(engine: Engine, path: Path, levels: Sequence[Level], made: Made) -> Target:
    polynomials = _sh(engine, made) if engine.sh else None
    return _whole(engine, path, levels, made,
                  lambda turned, t: write_env(path, EnvMap(tuple(turned), polynomials), into=t))


def _gltf(engine: Engine, path: Path, levels: Sequence[Level], made: Made) -> Target:
    return _whole(engine, path, levels, made,
                  lambda turned, t: write_gltf_lights(path, GltfLight(tuple(turned), _sh(engine, made)), into=t))


# ---------------------------------------------------------------------------------------------- lat-longs and tables


def _environment(engine: Engine, chain: Chain, path: Path, file: File, made: Made | None) -> Target:
    rows = 2 * chain.size
    nbytes = (4 if file.suffix == ".hdr" else 12) * rows * 2 * rows
    if made is None:
        return Target(path, engine.name, nbytes)
    level = made.chain.latlongs[0]
    told: dict[str, Any] = {"holds": "environment", "format": file.stored}
    if file.suffix == ".exr":
        alpha = made.chain.latlong_coverage[0].texels[..., :1] if made.chain.latlong_coverage else None
        pixels = level.texels if alpha is None else np.concatenate([level.texels, alpha], -1)
        texts = {f"whitefurnace:{name}": value for name, value in made.provenance.items()}
        told |= {"levels": [{"size": 2 * rows, "roughness": 0.0, "error": level.error}]}
        return Target(path, engine.name, nbytes, lambda t: write_exr(
            path, pixels, channel_names=tuple("RGBA"[:pixels.shape[-1]]), attributes=texts, into=t), told)
    told |= {"levels": [_level_told(level, unpack_hdr(pack_hdr(level.texels).data), level.texels)]}
    return Target(path, engine.name, nbytes, lambda t: write_hdr(path, level.texels, into=t), told)


def _dfg(engine: Engine, chain: Chain, path: Path, file: File, made: Made | None) -> Target:
    n, channels = engine.dfg.size, 3 if engine.dfg.charlie else 2
    if made is None:
        return Target(path, engine.name, _square_bytes(n, file, channels))
    assert made.split is not None
    values = made.split.values
    told = {"holds": "dfg", "format": file.stored, "size": n, "error": made.split.error, "rule": made.split.rule,
            **({"charlie_error": made.split.charlie_error} if engine.dfg.charlie else {})}
    if file.suffix == ".exr":
        return Target(path, engine.name, values.nbytes, lambda t: write_exr(
            path, values, channel_names=tuple("RGB"[:channels]), into=t), told)
    wide = values
    if file.stored != "rg16f" and channels == 2:
        wide = np.concatenate([values, np.zeros_like(values[..., :1])], -1)
    if file.suffix == ".png":
        packed = pack("rgbd", wide)
        back = unpack("rgbd", packed.data, wide.shape[:-1])
        told["format_worst"] = float(np.abs(back - wide).max())
        return Target(path, engine.name, packed.data.nbytes, lambda t: write_png(path, packed.data, into=t), told)
    keys = _keys(engine, made, [made.split.error])
    encoded = encode(file.stored, [wide], key_values={} if file.suffix == ".dds" else keys)
    told["format_worst"] = float(np.abs(decode(encoded.texture, 0)[..., :channels] - values).max())
    return Target(path, engine.name, _size(encoded.texture),
                  lambda t: write_texture(path, encoded.texture, zstd=file.zstd, into=t), told)


_WRITERS = {"specular": _specular, "skybox": _skybox, "irradiance": _irradiance, "sheen": _sheen,
            "environment": _environment, "sh": _sh_file, "dfg": _dfg}


# ---------------------------------------------------------------------------------------------- everything in one


def _npz(engine: Engine, chain: Chain, folder: Path, stem: str, made: Made | None) -> list[Target]:
    path = folder / engine.name / f"{stem}.npz"
    count = 3 * sum(6 * s * s for s, _ in chain.levels) + sum(n for holds, n in (
        ("irradiance", 3 * 6 * IRRADIANCE_SIZE**2), ("dfg", 2 * DFG_SIZE**2)) if engine.needs(holds))
    if made is None:
        return [Target(path, engine.name, 4 * count)]
    lit, levels = made.lit, made.chain.levels
    arrays: dict[str, np.ndarray] = {f"specular_{k}": level.texels for k, level in enumerate(levels, chain.first)}
    for statistic in ("roughness", "error", "worst", "rmse"):
        arrays[statistic] = np.full(len(chain.all_levels), np.nan)  # of levels that are not made
        arrays[statistic][chain.first:chain.first + len(levels)] = [getattr(level, statistic) for level in levels]
    arrays["roughness"] = np.array([r for _, r in chain.all_levels])
    rest = {"irradiance": lit.irradiance.texels, "sh": lit.sh, "dfg": made.table.values}
    arrays |= {holds: array for holds, array in rest.items() if engine.needs(holds)}
    arrays |= {f"coverage_{k}": level.texels[..., 0] for k, level in enumerate(made.chain.coverage, chain.first)}
    return [Target(path, engine.name, 4 * count, lambda t: write_npz(path, arrays, into=t),
                   levels=tuple(level.texels for level in levels))]


def _exr(engine: Engine, chain: Chain, folder: Path, stem: str, made: Made | None) -> list[Target]:
    found: list[Target] = []

    def add(ending: str, shape: tuple[int, int], texels: np.ndarray | None, alpha: np.ndarray | None = None,
            channels: str = "RGB", attributes: Mapping[str, str | float] | None = None) -> None:
        path = folder / engine.name / f"{stem}_{ending}.exr"
        nbytes = 4 * shape[0] * shape[1] * len(channels)
        if texels is None or made is None:
            found.append(Target(path, engine.name, nbytes))
            return
        pixels = texels.reshape(*shape, -1)
        names = channels
        if alpha is not None:
            pixels, names = np.concatenate([pixels, alpha.reshape(*shape, 1)], -1), "RGBA"
        told = {f"whitefurnace:{key}": value for key, value in {**made.provenance, **(attributes or {})}.items()}
        found.append(Target(path, engine.name, nbytes, lambda t: write_exr(
            path, pixels, channel_names=tuple(names), attributes=told, into=t)))

    for k, (size, _) in enumerate(chain.levels):
        cube, wide = (6 * size, size), (2 * size, 4 * size)
        if made is None:
            add(f"specular_{k + chain.first}", cube, None)
            add(f"specular_{k + chain.first}_latlong", wide, None)
            continue
        for ending, shape, level, coverage in (
            (f"specular_{k + chain.first}", cube, made.chain.levels[k], made.chain.coverage),
            (f"specular_{k + chain.first}_latlong", wide, made.chain.latlongs[k], made.chain.latlong_coverage),
        ):
            add(ending, shape, level.texels, coverage[k].texels[..., 0] if coverage else None, attributes={
                "roughness": level.roughness, "error": level.error, "worst": level.worst, "rmse": level.rmse,
                "method": level.method})
    irradiance = (6 * IRRADIANCE_SIZE, IRRADIANCE_SIZE)
    if engine.needs("irradiance"):
        add("irradiance", irradiance, made.lit.irradiance.texels if made else None, attributes={
            "error": made.lit.irradiance.error, "sh": json.dumps(made.lit.sh.tolist())} if made else None)
    if engine.needs("dfg"):
        add("dfg", (DFG_SIZE, DFG_SIZE), made.table.values if made else None, channels="RG",
            attributes={"error": made.table.error, "rule": made.table.rule} if made else None)
    return found


CONTAINERS = {"npz": _npz, "exr": _exr}
