"""Reads the texture or cube in a KTX 1, KTX 2, DDS, Babylon .env or glTF file as light, with the facts of its header.

Rows are returned from the top.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError, UnsupportedError
from whitefurnace.files import ktx1, ktx2
from whitefurnace.files.atomic import digest_file
from whitefurnace.files.binary import Source, load
from whitefurnace.files.codec import decode, require_decoder
from whitefurnace.files.containers import is_texture, parse_texture
from whitefurnace.files.env import MAGIC as ENV_MAGIC
from whitefurnace.files.env import parse_env
from whitefurnace.files.gltf_lights import GLB_MAGIC, gltf_light_files, read_gltf_lights
from whitefurnace.files.inputs import head_of
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.texture import Texture, upright

Texels = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Deferred:
    """Texels of a file that are decoded when they are asked for, and not kept: memory holds one level at a time.

    shape  that of the array that `decode` returns
    """

    shape: tuple[int, ...]
    decode: Callable[[], Texels]


@dataclass(frozen=True)
class Light:
    """The light in a file of a GPU container.

    container      title of the container; `format` the pixel format in words
    cube, layers   whether the texture is a cube; its number of layers, 0 where it is not an array
    levels         the levels, float32 ([layers,] [6,] height, width, channels); cubes are GL-direct
    stored         bytes of each level in the file; empty where the container does not state them
    largest        the largest finite value that each channel can hold
    facts, keys    facts of the header for display; key-values as texts, binary ones by their number of bytes
    undecoded      the reason where there are no levels because the package that decodes them is not installed
    roughness      perceptual roughness of each level, where the container fixes it
    notices        sentences about what the file states and what was applied
    said           sentences about values that a conversion changed, of the levels that have been decoded
    intensity      factor of the radiance, not yet applied to the levels
    turn           radians that are to be added to the azimuth atan2(z, x) of everything; None for another rotation
    polynomials, irradiance, irradiance_sh   Babylon's (9, 3) and (6, n, n, 3), and glTF's (9, 3) without a scale
    """

    container: str
    format: str
    cube: bool
    layers: int
    levels: tuple[Texels | Deferred, ...]
    stored: tuple[int, ...]
    largest: tuple[float, ...]
    facts: Mapping[str, str | int] = field(default_factory=dict)
    keys: Mapping[str, str] = field(default_factory=dict)
    undecoded: str = ""
    roughness: tuple[float, ...] | None = None
    polynomials: npt.NDArray[np.float64] | None = None
    irradiance: Texels | None = None
    irradiance_sh: npt.NDArray[np.float64] | None = None
    notices: tuple[str, ...] = ()
    said: list[str] = field(default_factory=list)
    intensity: float = 1.0
    turn: float | None = 0.0


def is_light(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is one of these containers by its first bytes, or glTF by its suffix.

    Returns False for a file that cannot be read.
    """
    return is_texture(path) or _kind(path) is not None


def _kind(path: str | os.PathLike[str]) -> str | None:
    head = head_of(path, 8)
    if head == ENV_MAGIC:
        return "env"
    return "gltf" if head.startswith(GLB_MAGIC) or Path(path).suffix.lower() in (".gltf", ".glb") else None


def read_light(path: str | os.PathLike[str]) -> Light:
    """Read the light in a file. The levels of a texture are decoded one at a time, when they are asked for.

    Raises `FileError` for a file that cannot be read, `InputError` for one that is not valid or needs more memory than
    it may take, and `UnsupportedError` for one that is valid and not read.
    """
    kind = _kind(path)
    if kind == "env":
        return _env(load(path))
    if kind == "gltf":
        return _gltf(Path(path))
    source = load(path)
    data = source.view
    texture = parse_texture(source)
    said: list[str] = []
    undecoded = ""
    try:
        require_decoder(texture.format)
    except UnsupportedError as error:
        undecoded = str(error)
    levels = () if undecoded else tuple(_deferred(texture, k, source.name, said) for k in range(len(texture.levels)))
    facts: dict[str, str | int] = {
        "width": texture.width,
        "height": texture.height,
        "mips": len(texture.levels),
        "layers": texture.layers,
        "faces": texture.faces,
        "bytes": len(source),
    }
    stored = tuple(texture.level_bytes(k) for k in range(len(texture.levels)))
    container = "DDS"
    if bytes(data[:12]) == ktx2.IDENTIFIER:
        container = "KTX 2"
        (scheme,) = struct.unpack_from("<I", data, 44)
        facts["supercompression"] = ktx2._SCHEMES[scheme]
        stored = tuple(struct.unpack_from("<Q", data, 80 + 24 * k + 8)[0] for k in range(len(texture.levels)))
    elif bytes(data[:12]) == ktx1.IDENTIFIER:
        container = "KTX 1"
        # Filament's loader accepts 0x8C3A as type and format too, where GL has 0x8C3B and RGB.
        order = "<" if data[12] == 1 else ">"
        facts["glType"], _, facts["glFormat"], facts["glInternalFormat"] = (
            f"{code:#06x}" for code in struct.unpack_from(f"{order}4I", data, 16)
        )
    if texture.orientation != "rd":
        facts["orientation"] = texture.orientation
    title = f"{texture.format} ({FORMATS[texture.format].title})"
    return Light(
        container,
        title,
        texture.cube,
        texture.layers if texture.layers > 1 else 0,
        levels,
        stored,
        _largest(texture),
        facts,
        {key: _text(value) for key, value in texture.key_values.items()},
        undecoded=undecoded,
        notices=texture.notices,
        said=said,
    )


def _deferred(texture: Texture, k: int, name: str, said: list[str]) -> Deferred:
    """Return level k of a texture, to be decoded upright and as light. An array of one layer is a single texture.

    said: receives sentences when the level is decoded.
    """
    width, height = texture.extent(k)
    layers = texture.layers if texture.layers > 1 else 0

    def decoded() -> Texels:
        texels = upright(decode(texture, k), texture.orientation)
        texels = texture.meaning.as_light(texels, name, said)
        return texels if layers or not texture.layers else texels[0]

    shape = (*([layers] if layers else []), *([6] if texture.cube else []), height, width)
    return Deferred((*shape, texture.meaning.channels(FORMATS[texture.format].channels)), decoded)


class Radiance(NamedTuple):
    """Level 0 of a light as radiance.

    texels   float32 (6, n, n, 1 | 3 | 4) of a cube, or (h, w, 1 | 3 | 4) of an image
    notices  sentences about what the file states and what was applied
    largest  the largest finite value that the format holds in each of R, G and B
    turn     radians that are to be added to the azimuth atan2(z, x) of everything
    """

    texels: Texels
    cube: bool
    notices: tuple[str, ...]
    largest: float
    turn: float = 0.0


def light_extent(path: str | os.PathLike[str]) -> tuple[bool, int, int]:
    """Return whether the light in a file is a cube, and the rows and columns of level 0; a texture is not decoded.

    Raises the errors of `read_radiance` for what the header says.
    """
    light = _single(path)
    height, width = light.levels[0].shape[-3:-1]
    return light.cube, height, width


def read_radiance(path: str | os.PathLike[str]) -> Radiance:
    """Read level 0 of the light in a file as radiance. The intensity of a light of glTF is applied.

    Raises the errors of `read_light`, `InputError` for arrays and for textures of two channels, and `UnsupportedError`
    where the package that decodes the format is not installed, and for a light that is turned about another axis than
    +Y.
    """
    light = _single(path)
    first = light.levels[0]
    texels = np.ascontiguousarray(first.decode() if isinstance(first, Deferred) else first)
    if light.intensity != 1:
        with np.errstate(over="ignore"):  # what becomes infinite is found as such
            texels = texels * np.float32(light.intensity)
    largest = min(light.largest[:3]) * light.intensity
    return Radiance(texels, light.cube, (*light.notices, *light.said), largest, light.turn or 0.0)


def _single(path: str | os.PathLike[str]) -> Light:
    """Read a light that is an environment: a single cube or image. Raises the errors of `read_radiance`."""
    light = read_light(path)
    if light.layers:
        many = "cubes" if light.cube else "images"
        raise InputError(f"{path} is an array of {light.layers} {many}, a single cube or 2-D image was expected")
    if light.undecoded:
        raise UnsupportedError(f"{path} is of {light.format}: {light.undecoded}")
    first = light.levels[0]
    if first.shape[-1] not in (1, 3, 4):
        raise InputError(f"{path} has {first.shape[-1]} channels ({light.format}), 1, 3 or 4 were expected")
    if light.turn is None:
        raise UnsupportedError(f"{path}: its light is rotated about another axis than +Y; give it without a rotation")
    return light


def _env(source: Source) -> Light:
    found = parse_env(source)
    text = bytes(source.view[len(ENV_MAGIC) :]).partition(b"\0")[0]
    lengths = [image["length"] for image in json.loads(text.decode("latin-1"))["specular"]["mipmaps"]]
    count = len(found.levels)
    # lod = scale · log2(size · α); roughness that gives a negative lod reads level 0.
    roughness = (0.0, *(math.sqrt(2 ** (k / found.lod_scale) / found.size) for k in range(1, count)))
    facts: dict[str, str | int] = {
        "width": found.size,
        "mips": count,
        "version": found.version,
        "images": found.image_type,
        "lodGenerationScale": f"{found.lod_scale:g}",
        "bytes": len(source),
    }
    return Light(
        "Babylon .env",
        f"rgbd ({FORMATS['rgbd'].title})",
        True,
        0,
        found.levels,
        tuple(sum(lengths[6 * k : 6 * k + 6]) for k in range(count)),
        (FORMATS["rgbd"].largest,) * 3,
        facts,
        polynomials=found.polynomials,
        irradiance=found.irradiance,
        roughness=roughness,
    )


def _gltf(path: Path) -> Light:
    lights = read_gltf_lights(path)
    found, count = lights[0], len(lights[0].levels)
    facts: dict[str, str | int] = {
        "width": found.size,
        "mips": count,
        "lights": len(lights),
        "intensity": f"{found.intensity:g}",
        "bytes": path.stat().st_size,
    }
    if found.name:
        facts["name"] = found.name
    if found.rotation != (0.0, 0.0, 0.0, 1.0):
        facts["rotation"] = " ".join(f"{x:g}" for x in found.rotation)
    roughness = tuple(k / (count - 1) for k in range(count)) if count > 1 else None
    turn = _azimuth(found.rotation)
    notices = []
    if len(lights) > 1:
        notices.append(f"{path}: the first of its {len(lights)} lights was read")
    if found.intensity != 1:
        notices.append(f"{path}: states an intensity of {found.intensity:g}, which multiplies the radiance")
    if turn:
        notices.append(f"{path}: states a rotation about +Y, which turns the light by {math.degrees(turn):g}°")
    return Light(
        "glTF",
        f"rgbd ({FORMATS['rgbd'].title}), EXT_lights_image_based",
        True,
        0,
        found.levels,
        (),
        (FORMATS["rgbd"].largest,) * 3,
        facts,
        roughness=roughness,
        irradiance_sh=found.coefficients,
        notices=tuple(notices),
        intensity=found.intensity,
        turn=turn,
    )


def _azimuth(rotation: tuple[float, float, float, float]) -> float | None:
    """Return what a rotation x y z w adds to the azimuth atan2(z, x), in radians; None for one not about +Y.

    A right-handed rotation by θ about +Y takes +X towards -Z, which lowers the azimuth by θ.
    """
    x, y, z, w = rotation
    # 1e-6: the rounding of float32, in which programs keep quaternions
    if max(abs(x), abs(z)) > 1e-6:
        return None
    return math.remainder(-2 * math.atan2(y, w), 2 * math.pi)


def light_files(path: str | os.PathLike[str]) -> dict[str, Path]:
    """Return the files that reading a light or an image opens, by their names relative to its folder.

    The first is the file itself; a glTF, by its content, may have images and buffers in others. No other file is
    opened. Raises `FileError` and `InputError` for a glTF that is not valid or names a file outside its folder.
    """
    path = Path(path)
    return gltf_light_files(path) if _kind(path) == "gltf" else {path.name: path}


def light_digest(path: str | os.PathLike[str]) -> str:
    """Return the sha256 of the file's bytes in hex; for a glTF with further files, that of all their digests joined.

    Raises the errors of `light_files`.
    """
    parts = [digest_file(file) for file in light_files(path).values()]
    return parts[0] if len(parts) == 1 else hashlib.sha256("".join(parts).encode()).hexdigest()


def _largest(texture: Texture) -> tuple[float, ...]:
    """Return the largest finite value that each channel can hold."""
    if texture.format == "b10g11r11":
        return 65024.0, 65024.0, 64512.0
    kind = FORMATS[texture.format]
    return (kind.largest,) * kind.channels


def _text(value: bytes) -> str:
    """Return a key's value for display: its text, or its number of bytes where it is binary."""
    try:
        text = value.removesuffix(b"\0").decode()
    except UnicodeDecodeError:
        text = "\0"
    if all(c.isprintable() or c in "\n\t" for c in text):
        return text
    return f"{len(value)} bytes, not a text"
