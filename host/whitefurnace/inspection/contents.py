"""Reads any file of this tool or of an engine into one type: float levels, spherical harmonics, texts and header facts.

For files that this tool wrote, the statements of their manifests are read too.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.engines.presets import ENGINES, HOLDS, Engine, File, axes_matrix
from whitefurnace.errors import FileError, InputError, UsageError
from whitefurnace.files import (
    Deferred,
    Light,
    digest_file,
    image_facts,
    is_arrays,
    is_light,
    open_input,
    read_header,
    read_image,
    read_light,
    read_manifest,
    read_npy,
    read_npz,
    read_rgbd,
    read_sh,
    read_stored,
    read_text,
)
from whitefurnace.files.harmonics import MAX_BYTES as SH_BYTES
from whitefurnace.sphere.environments import cube_solid_angles, faces_of, latlong_solid_angles
from whitefurnace.sphere.harmonics import SCALINGS, unscaled

KINDS = ("cube", "cube array", "lat-long", "image", "image array", "table", "arrays", "harmonics", "code", "manifest")
FIGURES = ("error", "worst", "rmse", "format_p99", "format_worst")
"""Errors that a manifest states for a level: those of the filter, and those that the pixel format adds."""

PREFIX = "whitefurnace:"
"""Prefix of the key-values and attributes that this tool writes."""

CONTAINERS = {".ktx": "KTX 1", ".ktx2": "KTX 2", ".dds": "DDS", ".env": "Babylon .env", ".gltf": "glTF"}
TITLES = {"openexr": "OpenEXR", "hdr": "Radiance HDR", "png": "PNG", "tiff": "TIFF", "jpeg": "JPEG", "dds": "DDS"}


@dataclass(frozen=True)
class Level:
    """One mip level, table or array.

    held       the texels, or `Deferred` ones, which are decoded anew each time that they are asked for
    roughness  perceptual roughness, where the file or its manifest states it
    stored     bytes in the file, where the level has bytes of its own
    stated     errors that this tool stated for it, by their names in FIGURES
    """

    name: str
    held: np.ndarray | Deferred
    roughness: float | None = None
    stored: int | None = None
    stated: Mapping[str, float] = field(default_factory=dict)

    @property
    def texels(self) -> np.ndarray:
        """The texels, float32: (6, n, n, c) or (h, w, c); arrays of either have one more axis in front.

        Raises InputError where the level of a file is not valid.
        """
        return self.held.decode() if isinstance(self.held, Deferred) else self.held

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the texels, without decoding them."""
        return self.held.shape

    @property
    def size(self) -> int:
        """The side of a cube's faces, or the height of any other level, in texels."""
        return self.shape[-3]


@dataclass(frozen=True)
class Statement:
    """Statements of this tool about a file that it wrote.

    manifest  path of the manifest that lists the file; None where the statements are attributes of the file itself
    whole     whether the digest in the manifest is that of the file
    stated    the statements by name
    """

    manifest: Path | None
    whole: bool | None
    stated: Mapping[str, Any]


@dataclass(frozen=True)
class Contents:
    """The contents of a file.

    kind         one of KINDS
    container    "KTX 2", "DDS", "OpenEXR", "npz" …; `format` the pixel format in words
    levels       levels from the largest to the smallest; prefiltered cubes are GL-direct
    irradiance   (6, n, n, 3) E/π, where the file stores it separately
    sh           (9, 3) radiance coefficients in the project's basis, converted from the scale of the file
    dfg          (h, w, c), a DFG table stored with the levels
    keys         texts of the file: key-values and attributes
    facts        facts of the header for display
    largest      largest finite value that each channel of the format holds; () where values do not reach it
    statement    statements of this tool, where it wrote the file
    notices      sentences about assumptions and about data that could not be decoded
    said         sentences about values that a conversion changed, of the levels that have been decoded
    """

    path: Path
    kind: str
    container: str
    format: str
    levels: tuple[Level, ...]
    irradiance: Level | None = None
    sh: np.ndarray | None = None
    dfg: Level | None = None
    keys: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, str | int] = field(default_factory=dict)
    largest: tuple[float, ...] = ()
    statement: Statement | None = None
    notices: tuple[str, ...] = ()
    said: list[str] = field(default_factory=list)

    @property
    def written_for(self) -> tuple[str, str] | None:
        """The engine that the file was written for, and its axes; None where neither manifest nor keys state them.

        For a user's own engine the axes are those that the bake got.
        """
        stated = self.statement.stated if self.statement is not None else {}
        name = self.keys.get(f"{PREFIX}engine", stated.get("engine"))
        if not isinstance(name, str):
            return None
        axes: Any = stated
        for part in ("recipe", "engines", name, "engine", "axes"):
            axes = axes.get(part) if isinstance(axes, Mapping) else None
        if name in ENGINES and not isinstance(axes, str):
            axes = ENGINES[name].axes
        try:
            axes_matrix(axes if isinstance(axes, str) else "")
        except UsageError:
            return None
        return name, axes

    @property
    def holds(self) -> str | None:
        """The use of the file that its manifest states, a key of engines.HOLDS; None where it states none.

        An EXR strip of this tool with harmonics holds irradiance.
        """
        stated = self.statement.stated if self.statement is not None else {}
        if self.container == "OpenEXR" and self.sh is not None:
            return "irradiance"
        return stated["holds"].split(",")[0] if isinstance(stated.get("holds"), str) else None

    @property
    def cube(self) -> bool:
        """True if the file holds a cube or an array of cubes."""
        return self.kind in ("cube", "cube array")


def contents(path: str | os.PathLike[str], *, layer: str | None = None, fill: str | None = None) -> Contents:
    """Read a file: .npz, .npy, .exr, .h and manifests of this tool, KTX 1, KTX 2, DDS, Babylon .env, glTF, or an image.

    layer: name of the part or layer of an OpenEXR file. fill: "black" for pixels that the data window of an image has
    not. A file whose decoder is not installed has no levels, and a notice with the reason. Raises `FileError` for a
    file that cannot be read, `InputError` for one that is not valid or of an unknown format, and `UsageError` for a
    layer that it has not.
    """
    path = Path(path)
    if path.is_dir():
        raise FileError(f"cannot read {path}: it is a folder, a file was expected")
    if layer is not None:
        return _of_image(path, _statement(path), layer, fill)
    if path.suffix.lower() == ".json" and not _is_harmonics(path):
        return _of_manifest(path)
    statement = _statement(path)
    if path.suffix.lower() in (".txt", ".json"):
        return _of_harmonics(path, statement)
    if path.suffix.lower() == ".h":
        return _of_header(path, statement)
    if is_arrays(path):
        return _of_arrays(path, statement)
    if is_light(path):
        return _of_light(path, statement)
    return _of_image(path, statement, layer, fill)


# ------------------------------------------------------------------------------------------------- by container


def _of_manifest(path: Path) -> Contents:
    with open_input(path, "a manifest"):
        size = path.stat().st_size
    found = read_manifest(path)
    if found is None:
        raise InputError(f"{path} is not a manifest of whitefurnace, which is JSON and begins with its version")
    files = _files(found)
    if isinstance(found.get("sha256"), str):  # the manifest of a table lists that one file
        files = {path.name.removesuffix(".json"): found}
    whole = bool(files) and all(_matches(path.parent / name, entry) for name, entry in files.items())
    facts: dict[str, str | int] = {"lists": ", ".join(sorted(files)) or "no files", "bytes": size}
    return Contents(
        path,
        "manifest",
        "JSON",
        "a manifest of whitefurnace",
        (),
        sh=_manifest_sh(found),
        facts=facts,
        statement=Statement(path, whole, _without_files(found)),
    )


def _is_harmonics(path: Path) -> bool:
    """Return whether a JSON file holds nine coefficients by name; otherwise it is a manifest."""
    try:
        read_sh(path)
    except (FileError, InputError):
        return False
    return True


def _of_harmonics(path: Path, statement: Statement | None) -> Contents:
    """Read a text of nine coefficients. Their scale is stated by the manifest, or by comments of Filament's cmgen."""
    values = read_sh(path)
    stated = statement.stated.get("scale") if statement is not None else None
    scale = stated if isinstance(stated, str) and stated in SCALINGS else None
    if scale is None and "pre-scaled base" in read_text(path, "a text of coefficients", most=SH_BYTES):
        scale = "filament"
    notices = () if scale else ("nothing says the scale of the coefficients; they are taken as the radiance's",)
    return Contents(
        path,
        "harmonics",
        "text",
        f"9 × 3 coefficients, scale {scale or 'radiance'}",
        (),
        sh=unscaled(values, scale or "radiance"),
        facts={"bytes": path.stat().st_size},
        statement=statement,
        notices=notices,
    )


def _of_header(path: Path, statement: Statement | None) -> Contents:
    """Read a C header: the array of a table, or macros, which are not evaluated."""
    array, facts = read_header(path), {"bytes": path.stat().st_size}
    if array is None:
        return Contents(path, "code", "C header", "macros", (), facts=facts, statement=statement)
    level = Level("the table", _floats(path, array, "table"), stated=_stated_figures(statement, "error"))
    form = f"an array of {' × '.join(map(str, array.shape))}"
    return Contents(path, "table", "C header", form, (level,), facts=facts, statement=statement)


def _of_arrays(path: Path, statement: Statement | None) -> Contents:
    size = path.stat().st_size
    if path.suffix.lower() == ".npy" or not (arrays := read_npz(path)):
        array = read_npy(path)
        table = _is_table(statement)
        form = f"{array.dtype.name}, array of {' × '.join(map(str, array.shape)) or '1'}"
        kind = "table" if table else _kind_of(array.shape)
        level = Level(
            "the table" if kind == "table" else "level 0",
            _floats(path, array, kind),
            stored=array.nbytes,
            stated=_stated_figures(statement, "error"),
        )
        return Contents(path, kind, "npy", form, (level,), facts={"bytes": size}, statement=statement)
    names = list(arrays)
    form = " and ".join(sorted({array.dtype.name for array in arrays.values()}))
    facts: dict[str, str | int] = {"arrays": ", ".join(names), "bytes": size}
    if "specular_0" not in arrays:
        plain = tuple(
            Level(name, _floats(path, array, "arrays"), stored=array.nbytes)
            for name, array in arrays.items()
            if array.ndim >= 2
        )
        return Contents(path, "arrays", "npz", form, plain, facts=facts, statement=statement)
    levels: list[Level] = []
    while f"specular_{len(levels)}" in arrays:
        k = len(levels)
        array = arrays[f"specular_{k}"]
        if array.ndim != 4 or array.shape[0] != 6 or array.shape[1] != array.shape[2] or not array.size:
            raise InputError(
                f"{path} is not valid: its specular_{k} is an array of {array.shape}, (6, n, n, 3) was expected"
            )
        own = {
            str(name): float(arrays[name].ravel()[k])
            for name in ("error", "worst", "rmse", "roughness")
            if name in arrays and arrays[name].size > k
        }
        levels.append(Level(f"level {k}", _floats(path, array, "cube"), own.pop("roughness", None), array.nbytes, own))

    def part(name: str, ndim: int) -> Level | None:
        array = arrays.get(name)
        if array is None:
            return None
        square = ndim == 3 or (array.ndim == 4 and array.shape[0] == 6 and array.shape[1] == array.shape[2])
        if array.ndim != ndim or not square or not array.size:
            raise InputError(f"{path} is not valid: its {name} is an array of {array.shape}")
        return Level(
            name,
            _floats(path, array, name),
            stored=array.nbytes,
            stated=_stated_figures(statement, "error", "worst", "rmse", within=name),
        )

    sh = arrays.get("sh")
    if sh is not None and sh.shape != (9, 3):
        raise InputError(f"{path} is not valid: its sh is an array of {sh.shape}, (9, 3) was expected")
    return Contents(
        path,
        "cube",
        "npz",
        form,
        tuple(levels),
        part("irradiance", 4),
        None if sh is None else sh.astype(np.float64),
        part("dfg", 3),
        facts=facts,
        statement=statement,
    )


def _of_light(path: Path, statement: Statement | None) -> Contents:
    light = read_light(path)
    own = {key.removeprefix(PREFIX): value for key, value in light.keys.items() if key.startswith(PREFIX)}
    if own and statement is None:
        statement = Statement(None, None, {name: _value(text) for name, text in own.items()})
    if light.undecoded:
        kind = ("cube" if light.cube else "image") + (" array" if light.layers else "")
        return Contents(
            path,
            kind,
            light.container,
            light.format,
            (),
            None,
            _light_sh(light),
            None,
            light.keys,
            light.facts,
            light.largest,
            statement,
            (light.undecoded, *light.notices),
        )
    kind, placed, notices = _light_kind(light, statement)
    roughness = _roughness_of(light, statement, placed)
    stated = _stated_levels(statement)
    if own and not stated:  # the key `error` has one number for each level
        numbers = [_stated_number(_value(word)) for word in own.get("error", "").split()]
        stated = {k: {"error": number} for k, number in enumerate(numbers) if number is not None}
    if kind == "table":
        stated = {0: _stated_figures(statement, "error", "format_worst")}
    levels = tuple(
        Level(
            "the table" if kind == "table" and k == 0 else f"level {k}", texels, r, stored, _figures(stated.get(k, {}))
        )
        for k, (texels, r, stored) in enumerate(
            zip(placed, roughness, light.stored or [None] * len(placed), strict=False)
        )
    )
    irradiance = None if light.irradiance is None else Level("irradiance", light.irradiance)
    return Contents(
        path,
        kind,
        light.container,
        light.format,
        levels,
        irradiance,
        _light_sh(light),
        None,
        light.keys,
        light.facts,
        light.largest,
        statement,
        (*light.notices, *notices),
        light.said,
    )


def _light_kind(
    light: Light, statement: Statement | None
) -> tuple[str, Sequence[np.ndarray | Deferred], tuple[str, ...]]:
    """Return the kind of a light, its levels in the layout of that kind, and notices."""
    first = light.levels[0]
    if light.cube:
        return "cube array" if light.layers else "cube", light.levels, ()
    if _is_table(statement):
        return "table", light.levels, ()
    if light.layers:
        return "image array", light.levels, ()
    if first.shape[-1] == 2:
        return "table", light.levels, ()
    # A view of one number has the shape without its memory.
    layout = faces_of(np.broadcast_to(np.float32(0), first.shape))
    if layout is None:
        return "image", light.levels, ()
    if layout[0] == "latlong":
        return ("lat-long" if first.shape[1] > 1 else "image"), light.levels, ()
    if len(light.levels) > 1:
        return "image", light.levels, ()
    found = faces_of(first.decode() if isinstance(first, Deferred) else first)
    assert found is not None
    return "cube", (found[1],), (f"taken as a {found[0]}, by its aspect ratio",)


def _of_image(path: Path, statement: Statement | None, layer: str | None, fill: str | None) -> Contents:
    facts = image_facts(path, layer=layer, fill=fill)
    attributes = dict(facts.attributes)
    if statement is None and attributes:
        statement = Statement(None, None, {**attributes, **_parsed(attributes)})
    container = TITLES.get(facts.format, facts.format)
    packed = f", {facts.compression}" if facts.compression else ""
    form = f"{facts.pixel}, {len(facts.channels)} channels ({' '.join(facts.channels)}){packed}"
    shown: dict[str, str | int] = {"width": facts.width, "height": facts.height, "bytes": path.stat().st_size}
    keys = {name: str(value) for name, value in attributes.items() if name in ("method", "rule", "notices")}
    largest = {"half": 65504.0, "uint8": 1.0, "uint16": 1.0}.get(facts.pixel)
    limit = (largest,) * len(facts.channels) if largest else ()
    if _is_table(statement) or "rule" in attributes or len(facts.channels) == 2:
        stated = _figures(attributes) or _stated_figures(statement, "error", "format_worst")
        level = Level("the table", _table_of(path, facts.format, statement), stated=stated)
        limit = () if statement is not None and statement.stated.get("format") == "rgbd" else limit
        return Contents(
            path, "table", container, form, (level,), keys=keys, facts=shown, largest=limit, statement=statement
        )
    image = read_image(path, layer=layer, fill=fill)
    if facts.pixel in ("uint8", "uint16"):  # the largest code is as bright as the file says; coverage ends at 1
        limit = (image.largest,) * min(image.pixels.shape[2], 3) + (1.0,) * (image.pixels.shape[2] == 4)
    atlas = statement is not None and statement.stated.get("layout") == "octahedral"
    found = None if atlas else faces_of(image.pixels, stated=image.layout)
    said = []
    if image.layout is not None:
        fits = "" if found else ", which its size contradicts"
        said.append(f"{path}: its envmap attribute says {image.layout}{fits}")
    if image.aspect != 1:
        said.append(f"{path}: states a pixel aspect ratio of {image.aspect:g}, which is not applied")
    name, texels = found if found is not None else ("", image.pixels)
    kind = "image" if not name or image.pixels.shape[:2] == (1, 1) else "lat-long" if name == "latlong" else "cube"
    if name or atlas:
        shown["layout"] = name or "octahedral maps of all levels"
    row = {**_stated_levels(statement).get(0, {}), **attributes}
    first = Level("level 0", texels, _stated_number(row.get("roughness")), None, _figures(row))
    sh = attributes.get("sh")
    return Contents(
        path,
        kind,
        container,
        form,
        (first,),
        None,
        _sh_text(sh) if isinstance(sh, str) else None,
        keys=keys,
        facts=shown,
        largest=limit,
        statement=statement,
        notices=(*image.notices, *said),
    )


def _is_table(statement: Statement | None) -> bool:
    """Return whether the manifest states that the file is a table, written by `lut` or as the DFG table of a bake."""
    return statement is not None and ("integral" in statement.stated or statement.stated.get("holds") == "dfg")


def _table_of(path: Path, container: str, statement: Statement | None) -> np.ndarray:
    """Read the values of a table as its shader does: stored values, or RGBD where the manifest states that format."""
    if container == "png" and statement is not None and statement.stated.get("format") == "rgbd":
        return read_rgbd(path)
    return read_stored(path)


def _kind_of(shape: tuple[int, ...]) -> str:
    """Return the kind of an array without a manifest, by its shape."""
    if len(shape) == 4 and shape[0] == 6 and shape[1] == shape[2] and shape[3] in (1, 3, 4):
        return "cube"
    if len(shape) == 3 and shape[1] == 2 * shape[0] and shape[2] in (3, 4):
        return "lat-long"
    return "table"


def _floats(path: Path, array: np.ndarray, kind: str) -> Deferred:
    """Return the array as float32 with a channel axis, converted when it is asked for.

    Tables of more than two axes become rows of the last two. Raises InputError for an array without a value.
    """
    if array.size == 0:
        raise InputError(f"{path} is not valid: it holds an array of {array.shape}, without a value")
    if kind in ("cube", "irradiance", "lat-long", "dfg"):
        shape = array.shape
    elif array.ndim <= 2:
        rows = array.shape[0] if array.ndim == 2 else 1
        shape = (rows, array.size // rows, 1)
    elif array.shape[-1] <= 4:
        shape = (array.size // (array.shape[-2] * array.shape[-1]), *array.shape[-2:])
    else:
        shape = (array.size // array.shape[-1], array.shape[-1], 1)

    def converted() -> np.ndarray:
        with np.errstate(over="ignore"):
            return np.array(array, np.float32, order="C").reshape(shape)

    return Deferred(shape, converted)


# ------------------------------------------------------------------------------------------------- statements


def _statement(path: Path) -> Statement | None:
    """Return the statements of the manifest that lists the file, or None.

    For a table that is FILE.json in the same folder. For a bake it is STEM.json in the same folder or the one above,
    where the file's name begins with STEM.
    """
    beside = path.with_name(path.name + ".json")
    found = _manifest(beside)
    if found is not None and found.get("name") == path.name:
        return Statement(beside, _matches(path, found), _without_files(found))
    stems = [path.name[:k] for k, c in enumerate(path.name) if c in "._-" and k]
    for folder in (path.parent.absolute().parent, path.parent.absolute()):
        for stem in reversed(stems):
            manifest = folder / f"{stem}.json"
            found = _manifest(manifest)
            if found is None:
                continue
            relative = path.absolute().relative_to(folder).as_posix()
            entry = _files(found).get(relative)
            if entry is not None:
                own = {name: value for name, value in entry.items() if name not in ("sha256", "bytes")}
                engine = relative.split("/")[0] if "/" in relative else None
                # The levels in `entry` are those of this file; the others describe the whole bake.
                bake = {name: value for name, value in _bake_of(found, relative).items() if name != "levels"}
                return Statement(manifest, _matches(path, entry), {**bake, **own, "engine": engine})
    return None


def _manifest(path: Path) -> dict[str, Any] | None:
    try:
        return read_manifest(path)
    except (FileError, ValueError):  # a manifest that cannot be read states nothing
        return None


def _files(manifest: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the entries of all files that a manifest lists, by name."""
    found: dict[str, dict[str, Any]] = {}
    for part in (manifest.get("kept"), manifest.get("files")):
        if isinstance(part, dict):
            found |= {name: entry for name, entry in part.items() if isinstance(entry, dict)}
    return found


def _bake_of(manifest: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return what a manifest says of the bake that wrote a file: its own, or an earlier one for another engine."""
    files, kept, earlier = (manifest.get(part) for part in ("files", "kept", "earlier"))
    if isinstance(files, dict) and name in files:
        return _without_files(manifest)
    entry = kept.get(name) if isinstance(kept, dict) else None
    key = entry.get("key") if isinstance(entry, dict) else None
    made = earlier.get(key) if isinstance(earlier, dict) and isinstance(key, str) else None
    return dict(made) if isinstance(made, dict) else {}


def _matches(path: Path, entry: Mapping[str, Any]) -> bool:
    """Return whether the file has the digest of its entry in a manifest."""
    try:
        return path.is_file() and digest_file(path) == entry.get("sha256")
    except (FileError, OSError, ValueError):
        return False


def _without_files(manifest: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in manifest.items() if name not in ("files", "kept", "earlier")}


def _manifest_sh(manifest: Mapping[str, Any]) -> np.ndarray | None:
    sh = manifest.get("sh")
    return _sh(sh.get("coefficients")) if isinstance(sh, dict) else None


def _sh_text(text: str) -> np.ndarray | None:
    try:
        return _sh(json.loads(text))
    except (ValueError, RecursionError):
        return None


def _sh(given: Any) -> np.ndarray | None:
    """Convert a value to (9, 3) numbers; None where it has another form."""
    try:
        values = np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return values if values.shape == (9, 3) else None


def _value(text: str) -> Any:
    """Parse a text as JSON; return the text itself where it is not JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _parsed(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Parse the recipe, which attributes hold as JSON; an empty dict where there is none."""
    try:
        return {"recipe": json.loads(attributes["recipe"])} if isinstance(attributes.get("recipe"), str) else {}
    except (ValueError, RecursionError):
        return {}


def _figures(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of FIGURES that a row of a manifest states."""
    return {name: number for name in FIGURES if (number := _stated_number(row.get(name))) is not None}


def _stated_number(value: Any) -> float | None:
    """Return a stated number as a float; None for any other value."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def _stated_figures(statement: Statement | None, *names: str, within: str = "") -> dict[str, float]:
    """Return those of the figures `names` that a statement, or its part `within`, has."""
    stated = dict(statement.stated) if statement is not None else {}
    if isinstance(stated.get("stored"), Mapping):  # written by `lut`: the error of the format of the values
        stated["format_worst"] = stated["stored"].get("error")
    row = stated.get(within) if within else stated
    return {name: value for name, value in _figures(row).items() if name in names} if isinstance(row, Mapping) else {}


def _stated_levels(statement: Statement | None) -> dict[int, Mapping[str, Any]]:
    """Return the rows of a manifest for the levels of the file, by number."""
    rows = statement.stated.get("levels") if statement is not None else None
    return {k: row for k, row in enumerate(rows) if isinstance(row, Mapping)} if isinstance(rows, list) else {}


def _roughness_of(
    light: Light, statement: Statement | None, levels: Sequence[np.ndarray | Deferred]
) -> list[float | None]:
    """Return the roughness of each level, or None.

    It comes from the container, from a key `roughness`, or from a manifest whose levels have the same sizes.
    """
    if light.roughness is not None:
        return list(light.roughness)
    for key, value in light.keys.items():
        if key.lower().rpartition(":")[2].removeprefix("whitefurnace.") == "roughness":
            try:
                numbers = [float(word) for word in value.replace(",", " ").split()]
            except ValueError:
                continue
            if len(numbers) == len(levels) and all(math.isfinite(r) for r in numbers):
                return list(numbers)
    rows = _stated_levels(statement)
    if (
        light.cube
        and len(rows) == len(levels)
        and all(row.get("size") == texels.shape[-3] for row, texels in zip(rows.values(), levels, strict=True))
    ):
        return [_stated_number(row.get("roughness")) for row in rows.values()]
    return [None] * len(levels)


# ------------------------------------------------------------------------------------------------- harmonics


def _light_sh(light: Light) -> np.ndarray | None:
    """Return the radiance coefficients of a light, converted from the scale of its engine; None where it has none."""
    if light.polynomials is not None:
        return unscaled(np.asarray(light.polynomials, np.float64), "babylon")
    if light.irradiance_sh is not None:
        return unscaled(np.asarray(light.irradiance_sh, np.float64), "irradiance")
    try:
        numbers = np.array([float(word) for word in light.keys.get("sh", "").split()])
    except ValueError:
        return None
    return unscaled(numbers.reshape(9, 3), "filament") if numbers.size == 27 else None


# ------------------------------------------------------------------------------------------------- figures


@dataclass(frozen=True)
class Statistics:
    """Statistics of the colour channels of a level.

    low, high                the smallest and the largest finite value
    mean                     mean of the finite values of each channel, over the sphere, or over the cells of a table
    nan, infinite, negative  counts of such values
    at_limit                 count of values at the largest value of the pixel format
    alpha                    range of a fourth channel that is not 1 everywhere
    """

    low: float
    high: float
    mean: tuple[float, ...]
    nan: int
    infinite: int
    negative: int
    at_limit: int
    alpha: tuple[float, float] | None = None


def statistics(found: Contents, level: Level) -> Statistics:
    """Compute the statistics of a level in bands of its rows, with little memory compared with the texels."""
    texels = level.texels
    height, width, channels = texels.shape[-3:]
    weights = np.broadcast_to(_weights(found, level), (height, width))
    rows = texels.reshape(-1, width, channels)
    coloured = 3 if channels == 4 and found.kind not in ("table", "arrays") else channels
    total = _Sums(coloured, found.largest[:coloured])
    band = max(1, _BAND // (width * channels))
    for start in range(0, len(rows), band):
        part = rows[start : start + band]
        total.add(part, weights[np.arange(start, start + len(part)) % height])
    return total.statistics()


_BAND = 1 << 20
"""Values whose statistics are computed at once."""


class _Sums:
    """Statistics of the values of a level, gathered band by band."""

    def __init__(self, channels: int, largest: Sequence[float]) -> None:
        self.channels, self.largest = channels, np.array(largest, np.float32)
        self.low, self.high = math.inf, -math.inf
        self.sums, self.weights = np.zeros(channels), np.zeros(channels)
        self.nan = self.infinite = self.negative = self.at_limit = 0
        self.alpha: tuple[float, float] | None = None
        self.partial = False

    def add(self, rows: np.ndarray, weights: np.ndarray) -> None:
        """Add rows (n, width, channels) with the weights (n, width) of their texels."""
        if rows.shape[-1] > self.channels:
            coverage = rows[..., 3]
            self.partial = self.partial or not np.all(coverage == 1)
            there = coverage[~np.isnan(coverage)]
            if there.size:
                ends = float(there.min()), float(there.max())
                self.alpha = ends if self.alpha is None else (min(ends[0], self.alpha[0]), max(ends[1], self.alpha[1]))
            rows = rows[..., : self.channels]
        finite = np.isfinite(rows)
        clean = rows if finite.all() else np.where(finite, rows, np.float32(0))
        some = clean if clean is rows else rows[finite]
        if some.size:
            self.low, self.high = min(self.low, float(some.min())), max(self.high, float(some.max()))
        self.sums += np.einsum("ijk,ij->k", clean, weights, dtype=np.float64)
        self.weights += np.einsum("ijk,ij->k", finite, weights, dtype=np.float64)
        nan = int(np.count_nonzero(np.isnan(rows)))
        self.nan += nan
        self.infinite += int(finite.size - np.count_nonzero(finite)) - nan
        self.negative += int(np.count_nonzero(rows < 0))
        if self.largest.size:
            self.at_limit += int(np.count_nonzero(clean[..., : self.largest.size] >= self.largest))

    def statistics(self) -> Statistics:
        """Return the statistics of all that was added."""
        none = self.low > self.high
        with np.errstate(divide="ignore", invalid="ignore"):
            means = np.where(self.weights > 0, self.sums / self.weights, math.nan)
        return Statistics(
            math.nan if none else self.low,
            math.nan if none else self.high,
            tuple(means.tolist()),
            self.nan,
            self.infinite,
            self.negative,
            self.at_limit,
            self.alpha if self.partial else None,
        )


def _weights(found: Contents, level: Level) -> np.ndarray:
    """Return the weights of the texels in means, which broadcast to them: solid angles, or 1 for a table."""
    if (found.cube or level is found.irradiance) and len(level.shape) >= 4:
        return cube_solid_angles(level.size)
    if found.kind == "lat-long" and level is not found.dfg:
        return latlong_solid_angles(*level.shape[:2])[:, None]
    return np.ones(())


def described(found: Contents) -> dict[str, Any]:
    """Return all facts about the contents as plain data for a row of JSON, with `statistics` and `looks_like`."""
    parts = [*found.levels, *(part for part in (found.irradiance, found.dfg) if part is not None)]
    return {
        "event": "contents",
        "file": str(found.path),
        "kind": found.kind,
        "container": found.container,
        "format": found.format,
        **({"header": dict(found.facts)}),
        "levels": [_row(found, level) for level in parts],
        **({} if found.sh is None else {"sh": found.sh.tolist()}),
        "keys": dict(found.keys),
        "looks_like": looks_like(found),
        "statement": None
        if found.statement is None
        else {
            **found.statement.stated,
            "manifest": None if found.statement.manifest is None else str(found.statement.manifest),
            "whole": found.statement.whole,
        },
        "notices": [*found.notices, *found.said],
    }


def _row(found: Contents, level: Level) -> dict[str, Any]:
    said = statistics(found, level)
    shape = level.shape
    faces = len(shape) >= 4 and (found.cube or level is found.irradiance)
    size = f"{level.size}²" if faces else "×".join(str(n) for n in shape[-2:-4:-1])
    return {
        "name": level.name,
        "shape": list(shape),
        "size": size,
        "bytes": level.stored,
        "roughness": level.roughness,
        "low": said.low,
        "high": said.high,
        "mean": list(said.mean),
        "nan": said.nan,
        "infinite": said.infinite,
        "negative": said.negative,
        "at_limit": said.at_limit,
        "alpha": None if said.alpha is None else list(said.alpha),
        **level.stated,
    }


# ------------------------------------------------------------------------------------------------- engines


def looks_like(found: Contents) -> list[str]:
    """List the engines whose files look like this one, judged by its bytes alone, as `ENGINE: use of the file`."""
    if not found.levels:
        return []
    said = [
        f"{engine.name}: {HOLDS[file.holds]}"
        for engine in ENGINES.values()
        for file in engine.file
        if _fits(found, engine, file)
    ]
    if found.container == "npz" and found.cube:
        said.append(f"raw: {ENGINES['raw'].title}")
    return said


def _fits(found: Contents, engine: Engine, file: File) -> bool:
    """Return whether the contents have the container, pixel format, shape and packing of a preset's file."""
    if found.container != CONTAINERS.get(file.suffix) or found.format.split(" ")[0] != file.stored:
        return False
    if file.suffix == ".ktx2" and (file.zstd is not None) != (found.facts.get("supercompression") == "Zstandard"):
        return False
    many = len(found.levels) > 1
    if file.holds == "dfg":
        return found.kind in ("table", "image") and found.levels[0].shape[:2] == (engine.dfg.size,) * 2
    if file.holds in ("specular", "sheen"):
        chain = found.cube and many and (found.levels[-1].size == 1 or not engine.whole)
        # Filament's loader needs the harmonics in the file.
        return chain and ("sh" in found.keys or engine.sh != "filament")
    return found.cube and not many and file.holds in ("skybox", "irradiance")
