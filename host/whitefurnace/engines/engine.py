"""The description of an engine: its files, their layout, its mapping from roughness to lod, and its conventions.

Presets are such descriptions, and so are users' TOML files.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from whitefurnace.catalogue import models
from whitefurnace.errors import UsageError, nearest
from whitefurnace.expression import Expression, table_text
from whitefurnace.prefiltering.recipe import LOD_NAMES, SIZE_RANGE, Lods

Holds = Literal["specular", "skybox", "irradiance", "sheen", "environment", "sh", "dfg"]

HOLDS: dict[str, str] = {
    "specular": "the prefiltered chain",
    "skybox": "level 0 alone: the image itself",
    "irradiance": "E/π as a cube of 32²",
    "sheen": "the chain of Charlie's lobe",
    "environment": "the image as a lat-long, for engines that filter it themselves",
    "sh": "spherical harmonics of the irradiance, in the engine's scaling",
    "dfg": "the split-sum table, on the engine's axes",
}

SUFFIXES: dict[str, tuple[str, ...]] = {
    "specular": (".ktx", ".ktx2", ".dds", ".env", ".gltf", ".exr"),
    "skybox": (".ktx", ".ktx2", ".dds"),
    "irradiance": (".ktx", ".ktx2", ".dds"),
    "sheen": (".ktx", ".ktx2", ".dds"),
    "environment": (".hdr", ".exr"),
    "sh": (".txt", ".json"),
    "dfg": (".ktx2", ".dds", ".png", ".exr"),
}
"""The contents that each container can hold, by suffix. `.env` and `.gltf` hold the harmonics too."""

FORMATS: dict[str, tuple[str, ...]] = {
    ".ktx": ("b10g11r11", "rgba16f", "rgba32f", "rgb9e5", "rg16f"),
    ".ktx2": ("b10g11r11", "rgba16f", "rgba32f", "rgb9e5", "rg16f", "bc6hu", "astc4x4hdr"),
    ".dds": ("rgba16f", "rgba32f", "b10g11r11", "rgb9e5", "rg16f", "bc6hu"),
    ".env": ("rgbd",),
    ".gltf": ("rgbd",),
    ".png": ("rgbd",),
    ".exr": ("float32",),
    ".hdr": ("rgbe",),
    ".txt": ("text",),
    ".json": ("text",),
}

SH_SCALES: dict[str, str] = {
    "filament": "cosine kernel, 1/π and the basis constants folded in",
    "babylon": "nine vectors x y z xx yy zz yz zx xy, from which its loader divides the cosine kernel again",
    "irradiance": "coefficients of the irradiance E in the orthonormal basis",
    "radiance": "coefficients of the radiance in the orthonormal basis",
}

STORED_NAME = re.compile(r"\{stem\}[A-Za-z0-9_.-]*")


ROUNDING = 1e-2
"""How far a share may lie outside [0, 1]: that of Babylon.js is α + 0.0005."""


class File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One file of an engine.

    holds   content of the file, one of HOLDS
    name    file name, "{stem}" with an ending; its suffix selects the container
    format  pixel format, one of the container's FORMATS; the first of them where none is given
    zstd    level of Zstandard compression of a .ktx2, 1 to 22
    layout  "cube", or "octahedral" for maps with `border` texels around each level (specular chains only)
    """

    holds: Holds
    name: str
    format: str = ""
    zstd: int | None = None
    layout: Literal["cube", "octahedral"] = "cube"
    border: int = 1

    @property
    def suffix(self) -> str:
        """Suffix of the file, in lower case."""
        return Path(self.name).suffix.lower()

    @property
    def stored(self) -> str:
        """The pixel format: the one given, or the container's first."""
        return self.format or FORMATS[self.suffix][0]


class Dfg(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An engine's split-sum table.

    size     texels on a side
    x, y     parameter along each axis; one of them is NoV
    NoV      spacing of NoV: "centres" has values at texel centres, "sqrt" has √NoV with its ends on texels
    form     "scale_bias" for (scale, bias), or "multiscatter" for (∫Fc, ∫1)
    charlie  True if Charlie's albedo is a third channel
    charlie_masking  masking of Charlie's albedo; Neubelt's V is that of Filament, Babylon.js and Khronos' sampler
    """

    size: int = 128
    x: Literal["NoV", "roughness", "alpha"] = "NoV"
    y: Literal["NoV", "roughness", "alpha"] = "roughness"
    NoV: Literal["centres", "sqrt"] = "centres"
    form: Literal["scale_bias", "multiscatter"] = "scale_bias"
    charlie: bool = False
    charlie_masking: str = "ashikhmin"


class Engine(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """The files that an engine loads and how it reads them.

    name, title: its name in paths and on the command line, and a line that says what it loads.
    facts: sources of the description. proven: True if a test has the engine itself render its
        chain; `facts` names the files that were tried.
    lod: level that is read at a roughness: a formula of LOD_NAMES, or pairs (r, lod); clamped to the existing levels.
    follow: True if levels past r = 1 hold a lobe of that α; False if they hold the lobe of r = 1.
    axes: "+x +y +z"; the engine reads the stored cube at (±x|y|z, …) for a world direction.
    bend: share of the normal in the direction that is read, mix(mirror direction, normal, bend), a formula of r and
    alpha.
    blend: share of the diffuse light E/π at the normal in the radiance, a formula of r and alpha.
    least: smallest perceptual roughness that the engine shades with.
    size, min_size: texels of a face edge of the first and the last level, where the user gives none.
    levels: number of levels, where the engine requires a fixed number.
    whole: True if the engine needs all mips down to 1².
    sh: scale of its harmonics, one of SH_SCALES; None where it uses none.
    dfg: its split-sum table. shading: the formula with which it weights what it reads. sheen: words for how it shades
    a sheen.
    file: its files. steps: what a user does with them.
    container: "files", or "npz" and "exr", which hold everything and need no `file`. latlong: True if lat-long levels
    are needed too.
    without: parts that "npz" and "exr" leave out (see `reduced`).
    """

    name: str = ""
    title: str = ""
    facts: str = ""
    proven: bool = False
    lod: str | tuple[tuple[float, float], ...] = "max_lod * r * (2 - r)"
    follow: bool = False
    axes: str = "+x +y +z"
    bend: str = "0"
    blend: str = "0"
    least: float = 0.0
    size: int = 256
    min_size: int = 16
    levels: int | None = None
    whole: bool = False
    sh: Literal["filament", "babylon", "irradiance", "radiance"] | None = None
    dfg: Dfg = Dfg()
    shading: Literal["split_sum", "scaled", "babylon", "fdez_aguera", "khronos"] = "split_sum"
    sheen: str = ""
    file: tuple[File, ...] = ()
    steps: tuple[str, ...] = ()
    container: Literal["npz", "exr", "files"] = "files"
    latlong: bool = False
    without: tuple[str, ...] = ()

    @cached_property
    def lods(self) -> Lods:
        """The mapping from roughness to lod. Its formula is None for the default mapping, whose inverse has a closed
        form.
        """
        where = f"{self.name}: lod"
        text = self.lod if isinstance(self.lod, str) else table_text(self.lod, "r", where)
        return Lods(None if text == DEFAULT_LOD else Expression(text, LOD_NAMES, where), self.follow)

    @cached_property
    def lod_formula(self) -> Expression:
        """The mapping from roughness to lod as a formula, for shaders."""
        return self.lods.lod or Expression(DEFAULT_LOD, LOD_NAMES, f"{self.name}: lod")

    @property
    def lods_text(self) -> str:
        """The mapping from roughness to lod as text for users."""
        return self.lod if isinstance(self.lod, str) else ", ".join(f"{r:g} → {lod:g}" for r, lod in self.lod)

    @cached_property
    def bend_formula(self) -> Expression:
        """The formula `bend` of r and alpha."""
        return Expression(self.bend, ("r", "alpha"), f"{self.name}: bend")

    @cached_property
    def blend_formula(self) -> Expression:
        """The formula `blend` of r and alpha."""
        return Expression(self.blend, ("r", "alpha"), f"{self.name}: blend")

    @cached_property
    def matrix(self) -> tuple[tuple[int, int, int], ...]:
        """The axes as a signed permutation P: the stored direction is P · the world's."""
        return axes_matrix(self.axes, f"{self.name}: axes")

    def holding(self, holds: str) -> tuple[File, ...]:
        """Return the engine's files that hold `holds`, one of HOLDS."""
        return tuple(file for file in self.file if file.holds == holds)

    @property
    def octahedral(self) -> bool:
        """True if the chain is stored as octahedral maps."""
        return any(file.layout == "octahedral" for file in self.file)

    def needs(self, holds: str) -> bool:
        """Return whether a bake for this engine needs `holds`, one of HOLDS."""
        if self.container != "files":  # these hold the chain, irradiance, harmonics and the table
            return holds in ("specular", "irradiance", "sh", "dfg") and holds not in self.without
        if holds == "sh":
            return self.sh is not None
        return bool(self.holding(holds)) or (holds == "specular" and bool(self.holding("skybox")))

    def cubes(self, holds: str) -> bool:
        """Return whether a bake for this engine needs `holds` as cubes."""
        if holds == "specular" and self.holding("skybox"):
            return True
        return self.needs(holds) and (
            self.container != "files" or any(file.layout == "cube" for file in self.holding(holds))
        )

    def data(self) -> dict[str, Any]:
        """Return the description as plain data, which is part of a bake's key."""
        data: dict[str, Any] = msgspec.to_builtins(self)
        if not self.without:
            del data["without"]
        return data


DEFAULT_LOD = "max_lod * r * (2 - r)"

_AXIS = {"x": 0, "y": 1, "z": 2}


def axes_matrix(text: str, where: str = "axes") -> tuple[tuple[int, int, int], ...]:
    """Return the signed permutation matrix of axes such as "+x +y -z". Raises UsageError, with `where` as the place."""
    found = re.fullmatch(r"\s*([+-]?)([xyz])[\s,]+([+-]?)([xyz])[\s,]+([+-]?)([xyz])\s*", text)
    rows = [] if found is None else [(found[k] == "-", _AXIS[found[k + 1]]) for k in (1, 3, 5)]
    if sorted(axis for _, axis in rows) != [0, 1, 2]:
        raise UsageError(f'{where}: {text!r} is not three of x, y, z with their signs, as "-x +y +z"')
    return tuple((*(0,) * a, -1 if negative else 1, *(0,) * (2 - a)) for negative, a in rows)  # type: ignore[misc]


READ_IN_ITS_SOURCE = "read in the engine's source"
READ_IN_COPIES = "from third-party copies of its shaders"
"""Sources of the facts of presets, as `Engine.facts` states them."""


@dataclass(frozen=True)
class Published:
    """Numbers from the engine's own sources at perceptual roughness 1/2, where alpha is 1/4.

    They are worked out by hand and not from the preset's formulas, so that tests can compare the formulas with them.

    levels, width: number of levels and texels of a face edge of the chain that the numbers are for.
    lod: level that is read.
    bend: share of the normal in the direction that is read, 0 to 1.
    blend: share of the diffuse light in the radiance, 0 to 1.
    direction: for each axis of the stored direction, the world axis that it equals, 1 to 3, negative where it points
    the other way.
    table: place (u, v) in the split-sum table at NoV = 0.3; None where the engine gets no table.
    form: "scale_bias" or "multiscatter", the form of the table.
    diffuse_lod: level whose radiance along the normal is the diffuse light; None where there are harmonics or an
    irradiance cube.
    """

    levels: int
    width: int
    lod: float
    bend: float = 0.0
    blend: float = 0.0
    direction: tuple[int, int, int] = (1, 2, 3)
    table: tuple[float, float] | None = None
    form: Literal["scale_bias", "multiscatter"] = "scale_bias"
    diffuse_lod: float | None = None


@dataclass(frozen=True)
class Preset:
    """One preset, as a module of `engines/presets` states it.

    order: place in lists, smaller first.
    engine: the description of the engine. Its name is that of the module.
    published: numbers that tests compare with the engine's formulas; required for every engine whose container is
    "files".
    """

    order: int
    engine: Engine
    published: Published | None = None


REDUCIBLE = ("irradiance", "sh", "sheen", "dfg", "skybox")
"""Parts of files that a bake can leave out where no material reads them. `sheen` includes Charlie's albedo in the
table."""


def reduced(engine: Engine, without: Sequence[str] = (), table: int | None = None) -> Engine:
    """Return an engine that gets fewer parts, or a split-sum table of another size.

    without: parts to leave out, names of REDUCIBLE. table: texels on a side, 1 to 4096; None keeps the engine's own
    size.
    Raises UsageError for a part that cannot be left out.
    """
    for holds in without:
        if holds not in REDUCIBLE:
            raise UsageError(f"{holds!r} cannot be left out{nearest(holds, REDUCIBLE)}")
    if table is not None and not 1 <= table <= 4096:
        raise UsageError(f"table {table} is outside [1, 4096]")
    if engine.container != "files":
        if table is not None:
            raise UsageError(f"the table of {engine.name} has one size; --table is of engines' files")
        return msgspec.structs.replace(engine, without=tuple(h for h in REDUCIBLE[:4] if h in without and h != "sheen"))
    files = tuple(file for file in engine.file if file.holds not in without)
    if not files:
        raise UsageError(f"without {', '.join(without)} nothing of {engine.name} is left")
    if "sh" in without and any(file.suffix == ".gltf" for file in files):
        raise UsageError("an EXT_lights_image_based has its irradiance coefficients: sh cannot be left out")
    dfg = msgspec.structs.replace(
        engine.dfg, charlie=engine.dfg.charlie and "sheen" not in without, size=table or engine.dfg.size
    )
    gone = [file.name.replace("{stem}", "STEM") for file in engine.file if file not in files]
    steps = [
        "; ".join(part for part in step.split("; ") if not any(name in part for name in gone))
        for step in engine.steps
        if not ("sh" in without and "harmonics" in step)
    ]
    return msgspec.structs.replace(
        engine, file=files, sh=None if "sh" in without else engine.sh, dfg=dfg, steps=tuple(filter(None, steps))
    )


def check(engine: Engine) -> None:
    """Check those properties of a description that its types do not express. Raises UsageError."""
    name = engine.name
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
        raise UsageError(f"{name!r} cannot name an engine: letters, digits, _, . and - can")
    if not engine.file:
        raise UsageError("there is no [[file]]: nothing would be written")
    engine.lods, engine.bend_formula, engine.blend_formula, engine.matrix  # noqa: B018 - each raises for what is no formula or no axes
    for low, high, what, value in (
        (1, 4096, "dfg.size", engine.dfg.size),
        (0, 1, "least", engine.least),
        (1, 16, "levels", 1 if engine.levels is None else engine.levels),
        (*SIZE_RANGE, "size", engine.size),
        (*SIZE_RANGE, "min_size", engine.min_size),
    ):
        if not low <= value <= high:
            raise UsageError(f"{what} {value} is outside [{low}, {high}]")
    for what in ("size", "min_size"):
        if (value := getattr(engine, what)) & (value - 1):
            raise UsageError(f"{what} {value} is not a power of two")
    _check_formulas(engine)
    if (engine.dfg.x == "NoV") == (engine.dfg.y == "NoV"):
        raise UsageError(f"dfg has x = {engine.dfg.x} and y = {engine.dfg.y}; one of them must be NoV, the other not")
    if engine.dfg.charlie_masking not in models("masking"):
        raise UsageError(
            f"dfg.charlie_masking: unknown masking {engine.dfg.charlie_masking!r}"
            f"{nearest(engine.dfg.charlie_masking, models('masking'))}"
        )
    if engine.whole and engine.min_size != 1:
        raise UsageError(f"min_size {engine.min_size}: `whole` chains go down to 1")
    seen: set[str] = set()
    for k, file in enumerate(engine.file):
        where = f"file[{k}]"
        if not STORED_NAME.fullmatch(file.name):
            raise UsageError(f"{where}: {file.name!r} is not {{stem}} with letters, digits, _, . and - after it")
        if file.name in seen:
            raise UsageError(f"{where}: {file.name} is written twice")
        seen.add(file.name)
        _check_file(engine, file, where)


def _check_formulas(engine: Engine) -> None:
    """Check the values of an engine's formulas over all roughness values. Raises UsageError."""
    r = np.linspace(0, 1, 257)
    for what, formula in (("bend", engine.bend_formula), ("blend", engine.blend_formula)):
        values = np.broadcast_to(formula(r=r, alpha=r * r), r.shape)
        for bad in np.flatnonzero(~((values >= -ROUNDING) & (values <= 1 + ROUNDING)))[:1]:
            raise UsageError(f"{what} is {values[bad]:g} at r = {r[bad]:g}, a share in [0, 1] was expected")
    sizes = {"max_lod": 4.0, "width": 256.0}  # any that an engine may have
    lods = np.broadcast_to(engine.lod_formula(r=r, alpha=r * r, **sizes), r.shape)
    # At r = 0 a logarithm is −∞, which is read at level 0.
    for bad in np.flatnonzero(~np.isfinite(lods) & ((r > 0) | (lods != -np.inf)))[:1]:
        raise UsageError(f"lod is {lods[bad]:g} at r = {r[bad]:g}, a level was expected")


def _check_file(engine: Engine, file: File, where: str) -> None:
    """Check the format of one file. Raises UsageError."""
    if file.suffix not in SUFFIXES[file.holds]:
        raise UsageError(
            f"{where}: {file.holds} is not written as {file.suffix or 'a name without a suffix'}; "
            f"{', '.join(SUFFIXES[file.holds])} are"
        )
    if file.stored not in FORMATS[file.suffix]:
        raise UsageError(
            f"{where}: {file.stored!r} is not a format of {file.suffix}{nearest(file.stored, FORMATS[file.suffix])}"
        )
    if file.zstd is not None and not (file.suffix == ".ktx2" and 1 <= file.zstd <= 22):
        raise UsageError(f"{where}: zstd {file.zstd} is a level from 1 to 22 of .ktx2 files")
    two = file.holds == "dfg" and not engine.dfg.charlie
    if file.stored == "rg16f" and not two:
        raise UsageError(f"{where}: rg16f holds two channels, {file.holds} has more")
    _check_layout(engine, file, where)
    if file.suffix == ".env" and not (engine.whole and engine.sh in ("babylon", None)):
        raise UsageError(f'{where}: an .env has all mips (whole = true) and sh = "babylon"')
    if file.suffix == ".gltf" and engine.sh != "irradiance":
        raise UsageError(f'{where}: an EXT_lights_image_based needs sh = "irradiance"')
    if file.holds == "sh" and engine.sh is None:
        raise UsageError(f"{where}: sh is missing, one of {', '.join(SH_SCALES)}")


def _check_layout(engine: Engine, file: File, where: str) -> None:
    """Check the layout of a chain, a cube or octahedral maps. Raises UsageError."""
    if file.layout == "octahedral" and not (file.holds == "specular" and file.suffix in (".ktx2", ".dds", ".exr")):
        raise UsageError(f"{where}: octahedral maps are of specular, as .ktx2, .dds or .exr")
    if file.layout == "octahedral" and file.suffix != ".exr" and file.border:
        raise UsageError(
            f"{where}: levels of a texture halve, with a border they do not; border = 0, or an .exr, "
            "which is an atlas of bordered levels"
        )
    if file.layout == "octahedral" and engine.axes != "+x +y +z":
        raise UsageError(f"{where}: octahedral maps are in the world's axes: axes cannot be given")
    if file.layout == "cube" and file.holds == "specular" and file.suffix == ".exr":
        raise UsageError(f"{where}: a chain as .exr is octahedral here; --for exr writes cubes")
    if not 0 <= file.border <= 16:
        raise UsageError(f"{where}: border {file.border} is outside [0, 16]")
