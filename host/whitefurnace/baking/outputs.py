"""Plans and encodes the files of a bake for each engine, and measures the error of their pixel formats."""

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
    """One file that a bake writes.

    path    where it is written
    engine  name of the engine that loads it
    nbytes  bytes of its arrays before compression
    """

    path: Path
    engine: str
    nbytes: int


@dataclass(frozen=True)
class Encoded(Target):
    """A file of a bake, ready to be written.

    write   stages the file in a transaction
    stated  facts about the file for the manifest
    levels  for a specular chain, each level as a GPU reads it, (6, s, s, 3) in this project's directions
    """

    write: Callable[[Transaction], object]
    stated: Mapping[str, Any] = field(default_factory=dict)
    levels: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True)
class Made:
    """The results of a bake for one engine.

    chain       its specular chain
    sheen       Charlie's chain, where the engine has sheen
    table       the (scale, bias) table of `raw` and `exr`
    split       the engine's own split-sum table, where it has one
    window      the windowed harmonics
    provenance  version, key, source and recipe, as texts
    """

    lit: Lighting
    chain: Filtered
    sheen: Filtered | None
    table: Integrated
    split: SplitSum | None
    window: harmonic.Windowed
    provenance: Mapping[str, str]


@dataclass(frozen=True)
class Writer:
    """The functions that plan and encode the files with one kind of content.

    planned_size  returns the bytes of a file's arrays before anything is computed; raises UsageError for a file that
                  cannot be made
    encode        returns the encoded file at a path, from the results of the bake
    """

    planned_size: Callable[[Engine, Chain, File], int]
    encode: Callable[[Engine, Path, File, Made], Encoded]


@dataclass(frozen=True)
class Container:
    """The functions that plan and encode all files of `raw` or `exr` at once; see `Writer`."""

    planned: Callable[[Engine, Chain, Path, str], list[Target]]
    encode: Callable[[Engine, Chain, Path, str, Made], list[Encoded]]


def targets(engine: Engine, chain: Chain, folder: Path, stem: str, image: int = 0) -> list[Target]:
    """Plan the files of an engine under `folder`/ENGINE. Raises UsageError for a file that cannot be made.

    image: rows of the image that engines filter themselves; 0 for those of the chain's size.
    """
    if engine.container != "files":
        return CONTAINERS[engine.container].planned(engine, chain, folder, stem)
    found = [
        Target(
            _path(engine, folder, stem, file),
            engine.name,
            _image_bytes(file, image)
            if image and file.holds == "environment"
            else WRITERS[file.holds].planned_size(engine, chain, file),
        )
        for file in engine.file
    ]
    return [*found, *_snippets(engine, chain, folder, stem)]


def encoded(engine: Engine, chain: Chain, folder: Path, stem: str, made: Made) -> list[Encoded]:
    """Encode the files that `targets` plans, from the results `made` of a bake."""
    if engine.container != "files":
        return CONTAINERS[engine.container].encode(engine, chain, folder, stem, made)
    found = [WRITERS[file.holds].encode(engine, _path(engine, folder, stem, file), file, made) for file in engine.file]
    return [*found, *_snippets(engine, chain, folder, stem)]


def _path(engine: Engine, folder: Path, stem: str, file: File) -> Path:
    return folder / engine.name / file.name.replace("{stem}", stem)


def _snippets(engine: Engine, chain: Chain, folder: Path, stem: str) -> list[Encoded]:
    if not engine.holding("specular"):
        return []
    return [
        _bytes(
            engine,
            folder / engine.name / f"{stem}.{language}",
            snippet(engine, language, levels=len(chain.levels), width=chain.size, stem=stem).encode(),
            {"holds": "shader snippet"},
        )
        for language in LANGUAGES
    ]


def _bytes(engine: Engine, path: Path, data: bytes, stated: Mapping[str, Any]) -> Encoded:
    return Encoded(
        path,
        engine.name,
        len(data),
        lambda t: write_atomic(path, lambda temporary: temporary.write_bytes(data), t),
        stated,
    )


# ---------------------------------------------------------------------------------------------- errors of formats


def _format_loss(kept: np.ndarray, true: np.ndarray, mean: float) -> dict[str, float]:
    """Return the error that a pixel format adds to a level: the 99th percentile and the largest of its texel errors."""
    off = texel_errors(kept.reshape(-1, 3).astype(np.float64), true.reshape(-1, 3).astype(np.float64), mean)
    return {"format_p99": float(np.quantile(off, 0.99)), "format_worst": float(off.max())}


def _level_stated(level: Level, kept: np.ndarray, true: np.ndarray) -> dict[str, Any]:
    """Return the manifest's statements about a level: `true` is the level as computed, `kept` as the format holds
    it.
    """
    mean = float(true.astype(np.float64).mean())
    return {
        "size": int(true.shape[-2]),
        "roughness": level.roughness,
        "error": level.error,
        **_format_loss(kept[..., :3], true, mean),
    }


def _clipped(clipped: Sequence[int]) -> dict[str, Any]:
    return {"clipped": int(sum(clipped))} if sum(clipped) else {}


def _keys(engine: Engine, made: Made, errors: Sequence[float]) -> dict[str, bytes]:
    """The metadata of a container; the manifest states the rest."""
    return {
        "KTXwriter": text_value(f"whitefurnace {VERSION}"),
        "whitefurnace:engine": text_value(engine.name),
        "whitefurnace:key": text_value(made.provenance["key"]),
        "whitefurnace:error": text_value(" ".join(f"{e:.2e}" for e in errors)),
    }


# ---------------------------------------------------------------------------------------------- cubes


def _texture(
    engine: Engine,
    path: Path,
    file: File,
    levels: Sequence[Level],
    made: Made,
    keys: Mapping[str, bytes],
    coverage: Sequence[Level] = (),
) -> Encoded:
    """Return cube levels in a pixel format and the engine's axes, with the error that the format adds to each."""
    turned = [turned_cube(level.texels, engine.matrix) for level in levels]
    held: list[np.ndarray] = turned
    if coverage and file.stored in ("rgba16f", "rgba32f"):
        held = [
            np.concatenate([texels, turned_cube(alpha.texels, engine.matrix)[..., :1]], -1)
            for texels, alpha in zip(turned, coverage, strict=True)
        ]
    if path.suffix == ".dds":
        keys = {}  # has no place for them
    packed = encode(file.stored, held, cube=True, key_values=keys)
    back = [decode(packed.texture, k) for k in range(len(levels))]
    stated = {
        "holds": file.holds,
        "format": file.stored,
        **_clipped(packed.clipped),
        "levels": [_level_stated(*one) for one in zip(levels, back, turned, strict=True)],
    }
    inverse = np.array(engine.matrix).T
    return Encoded(
        path,
        engine.name,
        _size(packed.texture),
        lambda t: write_texture(path, packed.texture, zstd=file.zstd, into=t),
        stated,
        tuple(turned_cube(texels[..., :3], inverse) for texels in back),
    )


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


def _specular_size(engine: Engine, chain: Chain, file: File) -> int:
    sizes = [s for s, _ in chain.levels]
    if file.layout == "cube":
        return _cube_bytes(sizes, file)
    if file.border > sizes[-1]:
        raise UsageError(
            f"{engine.name}: a border of {file.border} texels does not go around the last level's "
            f"{sizes[-1]}²; give a lower border or a larger --min-size"
        )
    return _cube_bytes(sizes, file) // 6


def _specular(engine: Engine, path: Path, file: File, made: Made) -> Encoded:
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


def _sheen_size(engine: Engine, chain: Chain, file: File) -> int:
    return _cube_bytes([s for s, _ in chain.levels], file)


def _sheen(engine: Engine, path: Path, file: File, made: Made) -> Encoded:
    assert made.sheen is not None
    keys = _keys(engine, made, [level.error for level in made.sheen.levels])
    return _texture(engine, path, file, made.sheen.levels, made, keys, made.sheen.coverage)


def _skybox_size(engine: Engine, chain: Chain, file: File) -> int:
    return _cube_bytes([chain.size], file)


def _skybox(engine: Engine, path: Path, file: File, made: Made) -> Encoded:
    level = made.chain.levels[0]
    return _texture(engine, path, file, [level], made, _keys(engine, made, [level.error]), made.chain.coverage[:1])


def _irradiance_size(engine: Engine, chain: Chain, file: File) -> int:
    return _cube_bytes([IRRADIANCE_SIZE], file)


def _irradiance(engine: Engine, path: Path, file: File, made: Made) -> Encoded:
    level = made.lit.irradiance
    return _texture(engine, path, file, [level], made, _keys(engine, made, [level.error]))


def _octahedral(engine: Engine, path: Path, file: File, made: Made) -> Encoded:
    """Return octahedral maps: mips of a texture, or one image of bordered levels, whose places the manifest states."""
    levels, coverage = made.chain.octahedral, made.chain.octahedral_coverage
    maps = [level.texels for level in levels]
    stated: dict[str, Any] = {"holds": file.holds, "format": file.stored, "layout": "octahedral", "border": file.border}
    if coverage and file.stored in ("rgba16f", "rgba32f", "float32"):
        maps = [
            np.concatenate([texels, alpha.texels[..., :1]], -1) for texels, alpha in zip(maps, coverage, strict=True)
        ]
    if file.suffix == ".exr":
        image, places = to_atlas(maps, file.border)
        stated["levels"] = [
            {"size": p.side, "roughness": level.roughness, "error": level.error, "row": p.row, "column": p.column}
            for level, p in zip(levels, places, strict=True)
        ]
        return Encoded(
            path,
            engine.name,
            image.nbytes,
            lambda t: write_exr(
                path, image, channel_names=tuple("RGBA"[: image.shape[-1]]), attributes=_attributes(made), into=t
            ),
            stated,
        )
    keys = {} if path.suffix == ".dds" else _keys(engine, made, [level.error for level in levels])
    packed = encode(file.stored, maps, key_values=keys)
    stated |= _clipped(packed.clipped)
    stated["levels"] = [_level_stated(level, decode(packed.texture, k), level.texels) for k, level in enumerate(levels)]
    return Encoded(
        path,
        engine.name,
        _size(packed.texture),
        lambda t: write_texture(path, packed.texture, zstd=file.zstd, into=t),
        stated,
    )


def _attributes(made: Made, more: Mapping[str, str | float] | None = None) -> dict[str, str | float]:
    """The attributes of an OpenEXR image."""
    return {f"whitefurnace:{key}": value for key, value in {**made.provenance, **(more or {})}.items()}


# ---------------------------------------------------------------------------------------------- harmonics


def _sh(engine: Engine, made: Made) -> np.ndarray:
    """Return the windowed harmonics in the engine's axes and scaling, (9, 3)."""
    assert engine.sh is not None
    scaled = getattr(harmonic, engine.sh)(harmonic.turned(made.window.values, engine.matrix))
    return np.asarray(scaled, np.float64)


SH_NAMES = ("L00", "L1-1", "L10", "L11", "L2-2", "L2-1", "L20", "L21", "L22")
POLYNOMIAL_NAMES = ("x", "y", "z", "xx", "yy", "zz", "yz", "zx", "xy")


def _sh_size(engine: Engine, chain: Chain, file: File) -> int:
    return 9 * 3 * 8


def _sh_file(engine: Engine, path: Path, file: File, made: Made) -> Encoded:
    rows = _sh(engine, made)
    names = POLYNOMIAL_NAMES if engine.sh == "babylon" else SH_NAMES
    if file.suffix == ".json":
        text = json.dumps(dict(zip(names, rows.tolist(), strict=True)), indent=2) + "\n"
    else:
        scale = "irradiance, pre-scaled base" if engine.sh == "filament" else engine.sh
        text = "".join(
            f"({r:18.15f}, {g:18.15f}, {b:18.15f}); // {name}, {scale}\n"
            for name, (r, g, b) in zip(names, rows, strict=True)
        )
    return _bytes(engine, path, text.encode(), {"holds": "sh", "scale": engine.sh, "error": made.lit.sh_error})


# ---------------------------------------------------------------------------------------------- cubes with harmonics


def _rgbd(levels: Sequence[Level], engine: Engine) -> tuple[list[np.ndarray], list[np.ndarray], int]:
    """Return levels in the engine's axes, the same after a round trip through RGBD, and how many values it clips."""
    turned = [turned_cube(level.texels, engine.matrix) for level in levels]
    packed = [pack("rgbd", texels) for texels in turned]
    return (
        turned,
        [unpack("rgbd", p.data, t.shape[:-1]) for p, t in zip(packed, turned, strict=True)],
        sum(p.clipped for p in packed),
    )


def _whole(
    engine: Engine,
    path: Path,
    levels: Sequence[Level],
    made: Made,
    write: Callable[[Sequence[np.ndarray], Transaction], object],
) -> Encoded:
    """A container of RGBD faces with harmonics."""
    turned, back, clipped = _rgbd(levels, engine)
    stated = {
        "holds": "specular, sh",
        "format": "rgbd",
        **_clipped([clipped]),
        "scale": engine.sh,
        "sh_error": made.lit.sh_error,
        "levels": [_level_stated(*one) for one in zip(levels, back, turned, strict=True)],
    }
    inverse = np.array(engine.matrix).T
    return Encoded(
        path,
        engine.name,
        sum(6 * 4 * t.shape[1] ** 2 for t in turned),
        lambda t: write(turned, t),
        stated,
        tuple(turned_cube(texels, inverse) for texels in back),
    )


def _env(engine: Engine, path: Path, levels: Sequence[Level], made: Made) -> Encoded:
    polynomials = _sh(engine, made) if engine.sh else None
    return _whole(
        engine, path, levels, made, lambda turned, t: write_env(path, EnvMap(tuple(turned), polynomials), into=t)
    )


def _gltf(engine: Engine, path: Path, levels: Sequence[Level], made: Made) -> Encoded:
    return _whole(
        engine,
        path,
        levels,
        made,
        lambda turned, t: write_gltf_lights(path, GltfLight(tuple(turned), _sh(engine, made)), into=t),
    )


# ---------------------------------------------------------------------------------------------- lat-longs and tables


def _environment_size(engine: Engine, chain: Chain, file: File) -> int:
    return _image_bytes(file, 2 * chain.size)


def _image_bytes(file: File, rows: int) -> int:
    return (4 if file.suffix == ".hdr" else 12) * 2 * rows**2


def _environment(engine: Engine, path: Path, file: File, made: Made) -> Encoded:
    level = (made.chain.image or made.chain.latlongs)[0]
    rows, columns = level.texels.shape[:2]
    stated: dict[str, Any] = {"holds": "environment", "format": file.stored}
    if file.suffix == ".exr":
        covered = made.chain.image_coverage or made.chain.latlong_coverage
        alpha = covered[0].texels[..., :1] if covered else None
        pixels = level.texels if alpha is None else np.concatenate([level.texels, alpha], -1)
        stated |= {"levels": [{"size": columns, "roughness": 0.0, "error": level.error}]}
        return Encoded(
            path,
            engine.name,
            12 * rows * columns,
            lambda t: write_exr(
                path, pixels, channel_names=tuple("RGBA"[: pixels.shape[-1]]), attributes=_attributes(made), into=t
            ),
            stated,
        )
    stated |= {"levels": [_level_stated(level, unpack_hdr(pack_hdr(level.texels).data), level.texels)]}
    return Encoded(path, engine.name, 4 * rows * columns, lambda t: write_hdr(path, level.texels, into=t), stated)


def _dfg_size(engine: Engine, chain: Chain, file: File) -> int:
    return _square_bytes(engine.dfg.size, file, 3 if engine.dfg.charlie else 2)


def _dfg(engine: Engine, path: Path, file: File, made: Made) -> Encoded:
    n, channels = engine.dfg.size, 3 if engine.dfg.charlie else 2
    assert made.split is not None
    values = made.split.values
    stated = {
        "holds": "dfg",
        "format": file.stored,
        "size": n,
        "error": made.split.error,
        "rule": made.split.rule,
        **(
            {"charlie_error": made.split.charlie_error, "charlie_masking": engine.dfg.charlie_masking}
            if engine.dfg.charlie
            else {}
        ),
    }
    if file.suffix == ".exr":
        return Encoded(
            path,
            engine.name,
            values.nbytes,
            lambda t: write_exr(path, values, channel_names=tuple("RGB"[:channels]), into=t),
            stated,
        )
    wide = values
    if file.stored != "rg16f" and channels == 2:
        wide = np.concatenate([values, np.zeros_like(values[..., :1])], -1)
    if file.suffix == ".png":
        png = pack("rgbd", wide)
        back = unpack("rgbd", png.data, wide.shape[:-1])
        stated["format_worst"] = float(np.abs(back - wide).max())
        return Encoded(path, engine.name, png.data.nbytes, lambda t: write_png(path, png.data, into=t), stated)
    keys = _keys(engine, made, [made.split.error])
    packed = encode(file.stored, [wide], key_values={} if file.suffix == ".dds" else keys)
    stated["format_worst"] = float(np.abs(decode(packed.texture, 0)[..., :channels] - values).max())
    return Encoded(
        path,
        engine.name,
        _size(packed.texture),
        lambda t: write_texture(path, packed.texture, zstd=file.zstd, into=t),
        stated,
    )


WRITERS = {
    "specular": Writer(_specular_size, _specular),
    "skybox": Writer(_skybox_size, _skybox),
    "irradiance": Writer(_irradiance_size, _irradiance),
    "sheen": Writer(_sheen_size, _sheen),
    "environment": Writer(_environment_size, _environment),
    "sh": Writer(_sh_size, _sh_file),
    "dfg": Writer(_dfg_size, _dfg),
}
"""The possible contents of an engine's file, each with the functions that make it."""


# ---------------------------------------------------------------------------------------------- everything in one


def _npz_planned(engine: Engine, chain: Chain, folder: Path, stem: str) -> list[Target]:
    count = 3 * sum(6 * s * s for s, _ in chain.levels) + sum(
        n for holds, n in (("irradiance", 3 * 6 * IRRADIANCE_SIZE**2), ("dfg", 2 * DFG_SIZE**2)) if engine.needs(holds)
    )
    return [Target(folder / engine.name / f"{stem}.npz", engine.name, 4 * count)]


def _npz(engine: Engine, chain: Chain, folder: Path, stem: str, made: Made) -> list[Encoded]:
    (target,) = _npz_planned(engine, chain, folder, stem)
    lit, levels = made.lit, made.chain.levels
    arrays: dict[str, np.ndarray] = {f"specular_{k}": level.texels for k, level in enumerate(levels, chain.first)}
    for statistic in ("roughness", "error", "worst", "rmse"):
        arrays[statistic] = np.full(len(chain.all_levels), np.nan)  # of levels that are not made
        arrays[statistic][chain.first : chain.first + len(levels)] = [getattr(level, statistic) for level in levels]
    arrays["roughness"] = np.array([r for _, r in chain.all_levels])
    rest = {"irradiance": lit.irradiance.texels, "sh": lit.sh, "dfg": made.table.values}
    arrays |= {holds: array for holds, array in rest.items() if engine.needs(holds)}
    arrays |= {f"coverage_{k}": level.texels[..., 0] for k, level in enumerate(made.chain.coverage, chain.first)}
    return [
        Encoded(
            target.path,
            engine.name,
            target.nbytes,
            lambda t: write_npz(target.path, arrays, into=t),
            levels=tuple(level.texels for level in levels),
        )
    ]


@dataclass(frozen=True)
class _Image:
    """An OpenEXR image of `exr`: the end of its name, its rows and columns, its channels without coverage."""

    ending: str
    shape: tuple[int, int]
    channels: str = "RGB"

    def target(self, engine: Engine, folder: Path, stem: str) -> Target:
        rows, columns = self.shape
        return Target(
            folder / engine.name / f"{stem}_{self.ending}.exr", engine.name, 4 * rows * columns * len(self.channels)
        )


def _images(engine: Engine, chain: Chain) -> dict[str, _Image]:
    """The images of `exr` by the end of their names."""
    found = []
    for k, (size, _) in enumerate(chain.levels, chain.first):
        found += [_Image(f"specular_{k}", (6 * size, size)), _Image(f"specular_{k}_latlong", (2 * size, 4 * size))]
    if engine.needs("irradiance"):
        found.append(_Image("irradiance", (6 * IRRADIANCE_SIZE, IRRADIANCE_SIZE)))
    if engine.needs("dfg"):
        found.append(_Image("dfg", (DFG_SIZE, DFG_SIZE), "RG"))
    return {image.ending: image for image in found}


def _exr_planned(engine: Engine, chain: Chain, folder: Path, stem: str) -> list[Target]:
    return [image.target(engine, folder, stem) for image in _images(engine, chain).values()]


def _exr(engine: Engine, chain: Chain, folder: Path, stem: str, made: Made) -> list[Encoded]:
    found: list[Encoded] = []
    images = _images(engine, chain)

    def add(ending: str, texels: np.ndarray, more: Mapping[str, str | float], alpha: np.ndarray | None = None) -> None:
        image = images[ending]
        target = image.target(engine, folder, stem)
        pixels, names = texels.reshape(*image.shape, -1), image.channels
        if alpha is not None:
            pixels, names = np.concatenate([pixels, alpha.reshape(*image.shape, 1)], -1), "RGBA"
        found.append(
            Encoded(
                target.path,
                engine.name,
                target.nbytes,
                lambda t: write_exr(
                    target.path, pixels, channel_names=tuple(names), attributes=_attributes(made, more), into=t
                ),
            )
        )

    for k in range(len(chain.levels)):
        for ending, level, coverage in (
            (f"specular_{k + chain.first}", made.chain.levels[k], made.chain.coverage),
            (f"specular_{k + chain.first}_latlong", made.chain.latlongs[k], made.chain.latlong_coverage),
        ):
            add(
                ending,
                level.texels,
                {
                    "roughness": level.roughness,
                    "error": level.error,
                    "worst": level.worst,
                    "rmse": level.rmse,
                    "method": level.method,
                },
                coverage[k].texels[..., 0] if coverage else None,
            )
    if "irradiance" in images:
        add(
            "irradiance",
            made.lit.irradiance.texels,
            {"error": made.lit.irradiance.error, "sh": json.dumps(made.lit.sh.tolist())},
        )
    if "dfg" in images:
        add("dfg", made.table.values, {"error": made.table.error, "rule": made.table.rule})
    return found


CONTAINERS = {"npz": Container(_npz_planned, _npz), "exr": Container(_exr_planned, _exr)}
