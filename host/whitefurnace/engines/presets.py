"""What each consumer of a bake loads: files, layout, mapping, conventions. Data only; a user's own engine is the same
data in a TOML file."""
from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import msgspec
import tomllib

from whitefurnace.errors import FileError, InputError, UsageError, nearest
from whitefurnace.expression import Expression, table_text
from whitefurnace.prefiltering.recipe import LOD_NAMES, Lods

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
"""What is written in which container. `.env` and `.gltf` hold the harmonics too."""

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


class File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One file of an engine: what it holds, its name, its pixel format. `layout` of a specular chain: a cube, or
    octahedral maps with `border` texels around each level."""

    holds: Holds
    name: str
    format: str = ""
    zstd: int | None = None
    layout: Literal["cube", "octahedral"] = "cube"
    border: int = 1

    @property
    def suffix(self) -> str:
        return Path(self.name).suffix.lower()

    @property
    def stored(self) -> str:
        """The pixel format, the container's first where none is given."""
        return self.format or FORMATS[self.suffix][0]


class Dfg(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An engine's split-sum table: `size` texels a side; which parameter runs along x and y; whether the axes have
    their values at texel centres, or √NoV with its ends on texels; whether it holds (scale, bias) or the multiscatter
    form (∫Fc, ∫1); and Charlie's albedo as a third channel."""

    size: int = 128
    x: Literal["NoV", "roughness", "alpha"] = "NoV"
    y: Literal["NoV", "roughness", "alpha"] = "roughness"
    NoV: Literal["centres", "sqrt"] = "centres"
    form: Literal["scale_bias", "multiscatter"] = "scale_bias"
    charlie: bool = False


class Engine(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """A preset.

    facts      where what it says is from; `proven`: its files were loaded and rendered by the engine itself
    lod        of a roughness: a formula of LOD_NAMES, or (r, lod) pairs; clamped to the levels there are
    follow     levels past r = 1 hold a lobe of that α; otherwise that of r = 1
    axes       "+x +y +z": for a world direction the engine reads the stored cube at (±x|y|z, …)
    bend       the share of the normal in the direction that is read, mix(mirror direction, normal, bend), a formula
               of r and alpha
    blend      the share of the diffuse light E/π at the normal in the radiance, a formula of r and alpha
    least      the least perceptual roughness that the engine shades with
    size       of the first level, `min_size` of the last, where the command line does not say
    levels     how many, where the engine counts on it
    whole      all mips down to 1² are required
    sh         a scale of SH_SCALES, None: the engine uses none
    steps      what a user does with the files
    shading    how it weighs what it reads (rendering.SHADINGS)
    container  "npz" and "exr" are made of everything, without `files`; `latlong` asks for lat-long levels too
    without    of "npz" and "exr", what of everything is left out (`reduced`)
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
    file: tuple[File, ...] = ()
    steps: tuple[str, ...] = ()
    container: Literal["npz", "exr", "files"] = "files"
    latlong: bool = False
    without: tuple[str, ...] = ()

    @cached_property
    def lods(self) -> Lods:
        """The mapping, None in it where it is the default one, whose inverse is closed."""
        where = f"{self.name}: lod"
        text = self.lod if isinstance(self.lod, str) else table_text(self.lod, "r", where)
        return Lods(None if text == DEFAULT_LOD else Expression(text, LOD_NAMES, where), self.follow)

    @cached_property
    def lod_formula(self) -> Expression:
        """The mapping as a formula, for shaders."""
        return self.lods.lod or Expression(DEFAULT_LOD, LOD_NAMES, f"{self.name}: lod")

    @property
    def lods_text(self) -> str:
        """The mapping for people."""
        return self.lod if isinstance(self.lod, str) else ", ".join(f"{r:g} → {lod:g}" for r, lod in self.lod)

    @cached_property
    def bend_formula(self) -> Expression:
        return Expression(self.bend, ("r", "alpha"), f"{self.name}: bend")

    @cached_property
    def blend_formula(self) -> Expression:
        return Expression(self.blend, ("r", "alpha"), f"{self.name}: blend")

    @cached_property
    def matrix(self) -> tuple[tuple[int, int, int], ...]:
        """`axes` as a signed permutation P: the stored direction is P · the world's."""
        return axes_matrix(self.axes, f"{self.name}: axes")

    def holding(self, holds: str) -> tuple[File, ...]:
        return tuple(file for file in self.file if file.holds == holds)

    @property
    def octahedral(self) -> bool:
        """Whether its chain is of octahedral maps."""
        return any(file.layout == "octahedral" for file in self.file)

    def needs(self, holds: str) -> bool:
        """Whether a bake for it needs this. `npz` and `exr` hold the chain, irradiance, harmonics and the table."""
        if self.container != "files":
            return holds in ("specular", "irradiance", "sh", "dfg") and holds not in self.without
        if holds == "sh":
            return self.sh is not None
        return bool(self.holding(holds)) or (holds == "specular" and bool(self.holding("skybox")))

    def cubes(self, holds: str) -> bool:
        """Whether it needs this as cubes."""
        if holds == "specular" and self.holding("skybox"):
            return True
        return self.needs(holds) and (self.container != "files" or any(
            file.layout == "cube" for file in self.holding(holds)))

    def data(self) -> dict[str, Any]:
        """All of it as plain data: what it says is part of a bake's key."""
        told: dict[str, Any] = msgspec.to_builtins(self)
        if not self.without:
            del told["without"]
        return told


DEFAULT_LOD = "max_lod * r * (2 - r)"

_AXIS = {"x": 0, "y": 1, "z": 2}


def axes_matrix(text: str, where: str = "axes") -> tuple[tuple[int, int, int], ...]:
    """The signed permutation of "+x +y -z". Raises UsageError."""
    found = re.fullmatch(r"\s*([+-]?)([xyz])[\s,]+([+-]?)([xyz])[\s,]+([+-]?)([xyz])\s*", text)
    rows = [] if found is None else [(found[k] == "-", _AXIS[found[k + 1]]) for k in (1, 3, 5)]
    if sorted(axis for _, axis in rows) != [0, 1, 2]:
        raise UsageError(f"{where}: {text!r} is not three of x, y, z with their signs, as \"-x +y +z\"")
    return tuple((*(0,) * a, -1 if negative else 1, *(0,) * (2 - a)) for negative, a in rows)  # type: ignore[misc]


_READ_BY_ITS_SOURCE = "read in the engine's source"
_UNOPENED = "from third-party copies of its shaders"

_PRESETS = (
    Engine("raw", "numpy arrays in one .npz, GL-direct faces", container="npz", facts="this project's own",
           proven=True),
    Engine("exr", "OpenEXR float32: a vertical strip and a lat-long a level", container="exr", latlong=True,
           facts="this project's own", proven=True),
    Engine(
        "filament", "Filament: KTX 1 of R11G11B10F with its harmonics, and a skybox",
        facts="loaded and rendered by its WASM build, whose least roughness is .089; its desktop builds have .045",
        proven=True,
        # A level more than its own tool makes: what is read between levels errs by .6 to .7 of that.
        bend="alpha * alpha", least=0.045, min_size=8, sh="filament",
        dfg=Dfg(128, form="multiscatter", charlie=True),
        shading="scaled",
        file=(File("specular", "{stem}_ibl.ktx", "b10g11r11"), File("skybox", "{stem}_skybox.ktx", "b10g11r11"),
              File("sh", "{stem}_sh.txt"), File("dfg", "{stem}_dfg.ktx2", "rgba16f", 19)),
        steps=("ibl = engine.createIblFromKtx1(STEM_ibl.ktx); engine.createSkyFromKtx1(STEM_skybox.ktx)",
               "its harmonics too, in JavaScript: IndirectLight.Builder().reflections(ibl.getReflectionsTexture())"
               ".irradianceSh(3, ibl.shfloats).build(engine)"),
    ),
    Engine(
        "three", "three.js from r187: a KTX 2 cube of half floats that needs no filtering, and an .hdr",
        facts="loaded and rendered by three.js", proven=True,
        axes="-x +y +z", bend="alpha * alpha", least=0.045, min_size=8, dfg=Dfg(16, x="roughness", y="NoV"),
        shading="fdez_aguera",
        file=(File("specular", "{stem}.ktx2", "rgba16f", 19), File("environment", "{stem}.hdr"),
              File("dfg", "{stem}_dfg.ktx2", "rg16f", 19)),
        # KTX2Loader of r187 refuses BC6H, which loses 8 % in small levels, and makes a 2-D texture of other cubes.
        steps=("const { mipmaps, format, type } = await ktx2Loader.loadAsync('STEM.ktx2')",
               "const faces = [0, 1, 2, 3, 4, 5].map(f => ({ width: mipmaps[0].width, height: mipmaps[0].height, "
               "mipmaps: mipmaps.map(({ data, width, height }) => ({ width, height, "
               "data: data.subarray(f * data.length / 6, (f + 1) * data.length / 6) })) }))",
               "texture = new CompressedCubeTexture(faces, format, type); texture.minFilter = "
               "LinearMipmapLinearFilter; texture.magFilter = LinearFilter; texture.isPMREMTexture = true; "
               "texture.needsUpdate = true",
               "scene.environment = texture; its last level is the diffuse light too",
               "before r187: scene.environment = the texture of RGBELoader for STEM.hdr, which it filters itself"),
    ),
    Engine(
        "babylon", "Babylon.js 9: .env of RGBD with its polynomials",
        facts="loaded and rendered by Babylon.js", proven=True,
        # A right-handed world, ours, in its left-handed one: the world's z is -z there, and in a right-handed scene it
        # reads at -z. It mixes diffuse light into rough reflections (mixIblRadianceWithIrradiance).
        axes="+x +y -z", blend="alpha + 0.0005",
        lod="0.8 * log2(width * (alpha + 0.0005))",  # its MINIMUMVARIANCE
        follow=True, min_size=1, whole=True, sh="babylon",
        dfg=Dfg(256, form="multiscatter"), shading="babylon",
        file=(File("specular", "{stem}.env", "rgbd"), File("dfg", "{stem}_dfg.png", "rgbd")),
        steps=("scene.environmentTexture = CubeTexture.CreateFromPrefilteredData('STEM.env', scene)",),
    ),
    Engine(
        "bevy", "Bevy: two KTX 2 of RGB9E5 with Zstandard",
        facts=_READ_BY_ITS_SOURCE,
        min_size=4,  # levels at equal steps of r need two more for half the error between them
        lod="max_lod * r", axes="+x +y -z", least=0.089, dfg=Dfg(64), shading="fdez_aguera",
        # mix(n, r, s (√s + α)) with s = 1 - α [Lagarde2014, listing 22]
        bend="1 - (1 - alpha) * (sqrt(1 - alpha) + alpha)",
        file=(File("specular", "{stem}_specular.ktx2", "rgb9e5", 19),
              File("irradiance", "{stem}_diffuse.ktx2", "rgb9e5", 19), File("dfg", "{stem}_dfg.ktx2", "rg16f", 19)),
        steps=("EnvironmentMapLight { diffuse_map: assets.load(\"STEM_diffuse.ktx2\"), "
               "specular_map: assets.load(\"STEM_specular.ktx2\"), intensity, ..default() }",),
    ),
    Engine(
        "gltf", "glTF EXT_lights_image_based: RGBD faces and irradiance coefficients in one .gltf",
        facts="the extension's specification", lod="max_lod * r", sh="irradiance", dfg=Dfg(128),
        file=(File("specular", "{stem}.gltf", "rgbd"), File("dfg", "{stem}_dfg.ktx2", "rg16f", 19)),
        steps=("copy `images` and `extensions.EXT_lights_image_based` into the scene's glTF, and name the light in the "
               "scene: \"extensions\": {\"EXT_lights_image_based\": {\"light\": 0}}",),
    ),
    Engine(
        "khronos", "Khronos glTF Sample Viewer: KTX 2 of half floats, Lambert, GGX and Charlie",
        facts=_READ_BY_ITS_SOURCE, lod="max_lod * r", min_size=4, dfg=Dfg(128, charlie=True), shading="khronos",
        file=(File("specular", "{stem}_ggx.ktx2", "rgba16f", 19),
              File("irradiance", "{stem}_lambertian.ktx2", "rgba16f", 19),
              File("sheen", "{stem}_charlie.ktx2", "rgba16f", 19), File("dfg", "{stem}_dfg.ktx2", "rgba16f", 19)),
        steps=("give the three cubes to ResourceLoader.loadEnvironment as lambertian, ggx and charlie",),
    ),
    Engine(
        "unreal", "Unreal Engine: a lat-long that it filters on import, and the chain as a DDS cube",
        facts=_UNOPENED, lod="max_lod - 2 + 1.2 * log2(r)", min_size=1, whole=True, least=0.001,
        file=(File("environment", "{stem}.hdr"), File("specular", "{stem}_cube.dds", "rgba16f")),
        steps=("import STEM.hdr: it becomes a TextureCube; an .exr stays 2-D",
               "a Sky Light of source type SLS Specified Cubemap filters it again: of our work its energy, its turn "
               "and its extracted sun survive, the levels do not",
               "STEM_cube.dds holds levels for its mapping, for shaders that sample a TextureCube themselves"),
    ),
    Engine(
        "unity", "Unity: a lat-long that it filters on import, and the chain as a DDS cube",
        facts=_UNOPENED, lod="6 * r * (1.7 - 0.7 * r)", levels=7,
        file=(File("environment", "{stem}.exr"), File("specular", "{stem}_cube.dds", "rgba16f")),
        steps=("import STEM.exr with Texture Shape: Cube, Mapping: Latitude-Longitude, Convolution Type: Specular; it "
               "is filtered then, and of our work its energy, its turn and its extracted sun survive",
               "with Convolution Type: None it stays; Cubemap.SetPixelData can set the levels of STEM_cube.dds"),
    ),
    Engine(
        "godot", "Godot 4: a panorama that it filters itself",
        facts=_READ_BY_ITS_SOURCE, lod="sqrt(r) * max_lod", bend="alpha",
        file=(File("environment", "{stem}.hdr"),),
        steps=("import STEM.hdr as a PanoramaSkyMaterial's panorama; the sky is filtered by the engine, of our work "
               "its energy, its turn and its extracted sun survive",),
    ),
)

ENGINES = {engine.name: engine for engine in _PRESETS}


def engines(names: str) -> tuple[Engine, ...]:
    """The presets of a comma-separated list of names and `.toml` files, each once. Raises UsageError with the nearest
    name, FileError and InputError for a file."""
    chosen: list[Engine] = []
    for name in (part.strip() for part in names.split(",")):
        engine = user_engine(name) if name.lower().endswith(".toml") else ENGINES.get(name)
        if engine is None:
            raise UsageError(f"unknown engine {name!r}{nearest(name, ENGINES)}, or FILE.toml")
        if engine in chosen:
            continue
        if engine.name in (other.name for other in chosen):
            raise UsageError(f"two engines are named {engine.name!r}: their outputs would be the same files")
        chosen.append(engine)
    return tuple(chosen)


REDUCIBLE = ("irradiance", "sh", "sheen", "dfg", "skybox")
"""What a bake can do without, where no material reads it; `sheen` is Charlie's albedo in the table too."""


def reduced(engine: Engine, without: Sequence[str] = (), table: int | None = None) -> Engine:
    """An engine without some of what it holds, and with a split-sum table of `table` texels a side. Raises UsageError
    for what cannot be left out."""
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
    dfg = msgspec.structs.replace(engine.dfg, charlie=engine.dfg.charlie and "sheen" not in without,
                                  size=table or engine.dfg.size)
    gone = [file.name.replace("{stem}", "STEM") for file in engine.file if file not in files]
    steps = ["; ".join(part for part in step.split("; ") if not any(name in part for name in gone))
             for step in engine.steps if not ("sh" in without and "harmonics" in step)]
    return msgspec.structs.replace(engine, file=files, sh=None if "sh" in without else engine.sh, dfg=dfg,
                                   steps=tuple(filter(None, steps)))


def as_text(engine: Engine) -> str:
    """An engine as the TOML that `user_engine` reads: what differs from the defaults."""
    def value(x: Any) -> str:
        if isinstance(x, bool):
            return str(x).lower()
        if isinstance(x, list | tuple):
            return "[" + ", ".join(map(value, x)) + "]"
        return json.dumps(x, ensure_ascii=False) if isinstance(x, str) else repr(x)

    def lines(one: msgspec.Struct, left_out: Sequence[str] = ()) -> list[str]:
        usual = dict(zip(one.__struct_fields__[::-1], one.__struct_defaults__[::-1], strict=False))
        return [f"{name} = {value(getattr(one, name))}" for name in one.__struct_fields__ if name not in left_out and
                getattr(one, name) is not None and (name not in usual or getattr(one, name) != usual[name])]

    text = [f"# {engine.name}: {engine.facts}",
            *lines(engine, ("name", "facts", "proven", "container", "latlong", "without", "dfg", "file"))]
    if table := lines(engine.dfg):
        text += ["", "[dfg]", *table]
    for file in engine.file:
        text += ["", "[[file]]", *lines(file)]
    return "\n".join(text) + "\n"


MOST_BYTES = 1 << 20


def user_engine(path: str | os.PathLike[str]) -> Engine:
    """An engine of a TOML file: the fields of `Engine`, `[dfg]` and `[[file]]`. Its name is the file's stem.

    Raises FileError for what cannot be read, InputError for what is no such description.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path} has {path.stat().st_size} bytes, an engine's description at most {MOST_BYTES}")
        text = path.read_bytes().decode()
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8") from None
    try:
        data = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not TOML: {error}") from None
    for key in ("name", "proven", "container", "latlong", "without", "facts"):
        if key in data:
            raise InputError(f"{path}: {key} cannot be given; the name is the file's stem")
    for where, given, known in _tables(data):
        for key in given:
            if key not in known:
                raise InputError(f"{path}: {where}{key} is not known{nearest(key, known)}")
    try:
        engine = msgspec.convert({**data, "name": path.stem, "facts": f"given in {path.name}"}, Engine)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {error}") from None
    try:
        _check(engine)
    except UsageError as error:
        raise InputError(f"{path}: {error}") from None
    return engine


def engine_of_data(data: Any, where: str) -> Engine:
    """The engine of `Engine.data`, as a manifest keeps it. Raises InputError for what is none."""
    try:
        engine = msgspec.convert(data, Engine)
        engine.lods, engine.bend_formula, engine.blend_formula, engine.matrix  # noqa: B018 - each raises if it is none
    except (msgspec.ValidationError, UsageError) as error:
        raise InputError(f"{where} describes an engine that is none: {error}") from None
    return engine


def _tables(data: dict[str, Any]) -> list[tuple[str, dict[str, Any], Sequence[str]]]:
    """The tables of a description, each with what may stand in it."""
    found: list[tuple[str, dict[str, Any], Sequence[str]]] = [("", data, Engine.__struct_fields__)]
    if isinstance(data.get("dfg"), dict):
        found.append(("dfg.", data["dfg"], Dfg.__struct_fields__))
    if isinstance(data.get("file"), list):
        found += [(f"file[{k}].", one, File.__struct_fields__) for k, one in enumerate(data["file"])
                  if isinstance(one, dict)]
    return found


def _check(engine: Engine) -> None:
    """What types do not say. Raises UsageError."""
    name = engine.name
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
        raise UsageError(f"{name!r} cannot name an engine: letters, digits, _, . and - can")
    if name in ENGINES:
        raise UsageError(f"{name} is the name of a preset; rename the file")
    if not engine.file:
        raise UsageError("there is no [[file]]: nothing would be written")
    engine.lods, engine.bend_formula, engine.blend_formula, engine.matrix  # noqa: B018 - each raises for what is no formula or no axes
    for low, high, what, value in ((1, 4096, "dfg.size", engine.dfg.size), (0, 1, "least", engine.least),
                                   (1, 16, "levels", engine.levels or 1)):
        if not low <= value <= high:
            raise UsageError(f"{what} {value} is outside [{low}, {high}]")
    if (engine.dfg.x == "NoV") == (engine.dfg.y == "NoV"):
        raise UsageError(f"dfg has x = {engine.dfg.x} and y = {engine.dfg.y}; one of them must be NoV, the other not")
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
        if file.suffix not in SUFFIXES[file.holds]:
            raise UsageError(f"{where}: {file.holds} is not written as {file.suffix or 'a name without a suffix'}; "
                             f"{', '.join(SUFFIXES[file.holds])} are")
        if file.stored not in FORMATS[file.suffix]:
            raise UsageError(f"{where}: {file.stored!r} is no format of {file.suffix}"
                             f"{nearest(file.stored, FORMATS[file.suffix])}")
        if file.zstd is not None and not (file.suffix == ".ktx2" and 1 <= file.zstd <= 22):
            raise UsageError(f"{where}: zstd {file.zstd} is a level from 1 to 22 of .ktx2 files")
        two = file.holds == "dfg" and not engine.dfg.charlie
        if file.stored == "rg16f" and not two:
            raise UsageError(f"{where}: rg16f holds two channels, {file.holds} has more")
        if file.layout == "octahedral" and not (file.holds == "specular" and file.suffix in (".ktx2", ".dds", ".exr")):
            raise UsageError(f"{where}: octahedral maps are of specular, as .ktx2, .dds or .exr")
        if file.layout == "octahedral" and file.suffix != ".exr" and file.border:
            raise UsageError(f"{where}: levels of a texture halve, with a border they do not; border = 0, or an .exr, "
                             "which is an atlas of bordered levels")
        if file.layout == "octahedral" and engine.axes != "+x +y +z":
            raise UsageError(f"{where}: octahedral maps are in the world's axes: axes cannot be given")
        if file.layout == "cube" and file.holds == "specular" and file.suffix == ".exr":
            raise UsageError(f"{where}: a chain as .exr is octahedral here; --for exr writes cubes")
        if not 0 <= file.border <= 16:
            raise UsageError(f"{where}: border {file.border} is outside [0, 16]")
        if file.suffix == ".env" and not (engine.whole and engine.sh in ("babylon", None)):
            raise UsageError(f"{where}: an .env has all mips (whole = true) and sh = \"babylon\"")
        if file.suffix == ".gltf" and engine.sh != "irradiance":
            raise UsageError(f"{where}: an EXT_lights_image_based needs sh = \"irradiance\"")
        if file.holds == "sh" and engine.sh is None:
            raise UsageError(f"{where}: there is no sh, one of {', '.join(SH_SCALES)}")
