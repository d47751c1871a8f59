"""What GPU containers hold as light: the texture or the cube in a KTX 1, KTX 2, DDS, Babylon .env or glTF file, with
rows from the top, and what their headers say of it."""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError, UnsupportedError
from whitefurnace.files import ktx1, ktx2
from whitefurnace.files.atomic import digest_file
from whitefurnace.files.binary import Source, load
from whitefurnace.files.codec import decode
from whitefurnace.files.containers import is_texture, parse_texture
from whitefurnace.files.env import MAGIC as ENV_MAGIC
from whitefurnace.files.env import parse_env
from whitefurnace.files.gltf_lights import GLB_MAGIC, read_gltf_lights
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.texture import Texture, upright

Texels = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Light:
    """`levels` are decoded, float32 ([layers,] [6,] height, width, channels), GL-direct where they are cubes; `stored`
    the bytes of each in the file, where it tells them. `facts` are what is to be told of the header, `keys` the texts
    among its key-values (others by their number of bytes); `undecoded` why there are no levels, where what decodes them
    is not installed; `roughness` that of each level where the container fixes it.
    `polynomials` (9, 3) and `irradiance` (6, n, n, 3) are Babylon's, `irradiance_sh` (9, 3) glTF's, without a scale."""

    container: str
    format: str
    cube: bool
    layers: int
    levels: tuple[Texels, ...]
    stored: tuple[int, ...]
    largest: tuple[float, ...]
    facts: Mapping[str, str | int] = field(default_factory=dict)
    keys: Mapping[str, str] = field(default_factory=dict)
    undecoded: str = ""
    roughness: tuple[float, ...] | None = None
    polynomials: npt.NDArray[np.float64] | None = None
    irradiance: Texels | None = None
    irradiance_sh: npt.NDArray[np.float64] | None = None


def is_light(path: str | os.PathLike[str]) -> bool:
    """Whether a file begins, or for the JSON of glTF is named, as one of these containers; false where it cannot be
    read."""
    return is_texture(path) or _kind(path) is not None


def _kind(path: str | os.PathLike[str]) -> str | None:
    try:
        if not Path(path).is_file():
            return None
        with open(path, "rb") as file:
            head = file.read(8)
    except (OSError, ValueError):
        return None
    if head == ENV_MAGIC:
        return "env"
    return "gltf" if head.startswith(GLB_MAGIC) or Path(path).suffix.lower() in (".gltf", ".glb") else None


def read_light(path: str | os.PathLike[str], *, first: bool = False) -> Light:
    """What such a file holds; of a texture level 0 alone where `first`. Raises `FileError`, and `InputError` for what
    is not valid."""
    kind = _kind(path)
    if kind == "env":
        return _env(load(path))
    if kind == "gltf":
        return _gltf(Path(path))
    source = load(path)
    data = source.view
    texture = parse_texture(source)
    levels: tuple[Texels, ...] = ()
    undecoded = ""
    try:
        levels = tuple(upright(decode(texture, k), texture.orientation)
                       for k in range(1 if first else len(texture.levels)))
    except UnsupportedError as error:
        undecoded = str(error)
    facts: dict[str, str | int] = {"width": texture.width, "height": texture.height, "mips": len(texture.levels),
                                   "layers": texture.layers, "faces": texture.faces, "bytes": len(source)}
    stored = tuple(memoryview(level).nbytes for level in texture.levels)
    container = "DDS"
    if bytes(data[:12]) == ktx2.IDENTIFIER:
        container = "KTX 2"
        (scheme,) = struct.unpack_from("<I", data, 44)
        facts["supercompression"] = ktx2._SCHEMES[scheme]
        stored = tuple(struct.unpack_from("<Q", data, 80 + 24 * k + 8)[0] for k in range(len(texture.levels)))
    elif bytes(data[:12]) == ktx1.IDENTIFIER:
        container = "KTX 1"
        # Filament's loader takes 0x8C3A as type and format too, where GL has 0x8C3B and RGB.
        facts["glType"], _, facts["glFormat"], facts["glInternalFormat"] = (
            f"{code:#06x}" for code in struct.unpack_from("<4I", data, 16))
    if texture.orientation != "rd":
        facts["orientation"] = texture.orientation
    title = f"{texture.format} ({FORMATS[texture.format].title})"
    return Light(container, title, texture.cube, texture.layers, levels, stored, _largest(texture),
                 facts, {key: _text(value) for key, value in texture.key_values.items()},
                 undecoded=undecoded)


def read_radiance(path: str | os.PathLike[str]) -> tuple[Texels, bool]:
    """Level 0 as radiance and whether it is a cube: (6, n, n, 3 | 4), or an image (h, w, 3 | 4). Raises as
    `read_light`, `InputError` for arrays and for two channels, `UnsupportedError` for what cannot be decoded here."""
    light = read_light(path, first=True)
    if light.layers:
        many = "cubes" if light.cube else "images"
        raise InputError(f"{path} is an array of {light.layers} {many}, a single cube or 2-D image was expected")
    if light.undecoded:
        raise UnsupportedError(f"{path} is of {light.format}: {light.undecoded}")
    if light.levels[0].shape[-1] not in (3, 4):
        raise InputError(f"{path} has {light.levels[0].shape[-1]} channels ({light.format}), 3 or 4 were expected")
    return np.ascontiguousarray(light.levels[0]), light.cube


def _env(source: Source) -> Light:
    found = parse_env(source)
    text = bytes(source.view[len(ENV_MAGIC):]).partition(b"\0")[0]
    lengths = [image["length"] for image in json.loads(text.decode("latin-1"))["specular"]["mipmaps"]]
    count = len(found.levels)
    # lod = scale · log2(size · α), of which level 0 is read for all that is smoother.
    roughness = (0.0, *(math.sqrt(2 ** (k / found.lod_scale) / found.size) for k in range(1, count)))
    facts: dict[str, str | int] = {"width": found.size, "mips": count, "version": found.version,
                                   "images": found.image_type, "lodGenerationScale": f"{found.lod_scale:g}",
                                   "bytes": len(source)}
    return Light("Babylon .env", f"rgbd ({FORMATS['rgbd'].title})", True, 0, found.levels,
                 tuple(sum(lengths[6 * k:6 * k + 6]) for k in range(count)), (FORMATS["rgbd"].largest,) * 3, facts,
                 polynomials=found.polynomials, irradiance=found.irradiance, roughness=roughness)


def _gltf(path: Path) -> Light:
    lights = read_gltf_lights(path)
    found, count = lights[0], len(lights[0].levels)
    facts: dict[str, str | int] = {"width": found.size, "mips": count, "lights": len(lights),
                                   "intensity": f"{found.intensity:g}", "bytes": path.stat().st_size}
    if found.name:
        facts["name"] = found.name
    if found.rotation != (0.0, 0.0, 0.0, 1.0):
        facts["rotation"] = " ".join(f"{x:g}" for x in found.rotation)
    roughness = tuple(k / (count - 1) for k in range(count)) if count > 1 else None
    return Light("glTF", f"rgbd ({FORMATS['rgbd'].title}), EXT_lights_image_based", True, 0, found.levels, (),
                 (FORMATS["rgbd"].largest,) * 3, facts, roughness=roughness, irradiance_sh=found.coefficients)


def light_files(path: str | os.PathLike[str]) -> list[Path]:
    """The file, and of a .gltf the images and buffers that lie beside it too."""
    path = Path(path)
    try:
        document = json.loads(path.read_bytes()) if path.suffix.lower() == ".gltf" else {}
        uris = [entry.get("uri", "data:") for part in ("images", "buffers") for entry in document.get(part, ())]
    except (OSError, ValueError, AttributeError, TypeError, RecursionError):
        return [path]
    return [path, *(path.parent / unquote(uri) for uri in uris if isinstance(uri, str) and not uri.startswith("data:"))]


def light_digest(path: str | os.PathLike[str]) -> str:
    """sha256 in hex of the file's bytes; of a .gltf whose images or buffers lie beside it of all of their digests.
    Raises `FileError`."""
    parts = [digest_file(file) for file in light_files(path)]
    return parts[0] if len(parts) == 1 else hashlib.sha256("".join(parts).encode()).hexdigest()


def _largest(texture: Texture) -> tuple[float, ...]:
    """The largest finite value that each channel can hold."""
    if texture.format == "b10g11r11":
        return 65024.0, 65024.0, 64512.0
    kind = FORMATS[texture.format]
    return (kind.largest,) * kind.channels


def _text(value: bytes) -> str:
    """A key's value for people: the text it is, else how many bytes."""
    try:
        text = value.removesuffix(b"\0").decode()
    except UnicodeDecodeError:
        text = "\0"
    if all(c.isprintable() or c in "\n\t" for c in text):
        return text
    return f"{len(value)} bytes, not a text"
