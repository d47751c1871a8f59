"""Reads and writes Babylon.js `.env` environments, as @babylonjs/core 9 (Misc/environmentTextureTools) does.

The file is a magic number, a JSON manifest that ends with a NUL, and images of RGBD cube faces, mip by mip.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.files import memory
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.binary import Source, load
from whitefurnace.files.jsontext import Reader, parse_object
from whitefurnace.files.rgbd import MAX_SIZE, Level, check_chain, decode_face, encode_faces

MAGIC = bytes((0x86, 0x16, 0x87, 0x96, 0xF6, 0xD6, 0x96, 0x36))
VERSION = 2
POLYNOMIALS = ("x", "y", "z", "xx", "yy", "zz", "yz", "zx", "xy")
LOD_SCALE = 0.8
LEAST_SCALE, MOST_SCALE = 0.05, 20.0
"""Range of the scale of lod by roughness that is read. Babylon.js writes 0.8 always."""

_MAX_MANIFEST = 1 << 20
_IMAGE_TYPES = ("image/png", "image/webp")


@dataclass(frozen=True, eq=False)
class EnvMap:
    """The contents of an `.env` file.

    `levels[k]` is float32 (6, n >> k, n >> k, 3), the complete chain down to one texel. Its faces are GL-direct: the
    texel for direction d is the one that `textureCube(d)` returns in the engine. The engine reads roughness r at level
    `lod_scale`·log2(n·r²).

    `polynomials` (9, 3) are the rows x y z xx yy zz yz zx xy of P(n) = x·n.x + … + xx·n.x² + …. Where they are None
    the engine computes its own from the levels. Materials with `brdf.useSphericalHarmonics` false show P(n) as E/π.
    By default it is true, and materials show P with its part of l = 1 times 3/2 and its part of l = 2 times 4, because
    `preScaledHarmonics` omits the cosine's 2/3 and 1/4. The engine's own files have these factors divided out.

    `irradiance` (6, m, m, 3) is E/π as a cube, which newer materials use in place of P. `dominant` is the direction of
    the strongest light, or None; it is stored with `irradiance` alone.
    """

    levels: tuple[Level, ...]
    polynomials: npt.NDArray[np.float64] | None = None
    irradiance: Level | None = None
    lod_scale: float = LOD_SCALE
    dominant: tuple[float, float, float] | None = None
    version: int = VERSION
    image_type: str = "image/png"

    def __post_init__(self) -> None:
        if complaint := check_chain(self.levels, whole=True):
            raise ValueError(f"an .env map is wrong: {complaint}")
        if self.polynomials is not None and np.shape(self.polynomials) != (len(POLYNOMIALS), 3):
            raise ValueError(f"polynomials of shape {np.shape(self.polynomials)} are not (9, 3)")
        if self.irradiance is not None:
            if complaint := check_chain((self.irradiance,), whole=False):
                raise ValueError(f"the irradiance of an .env map is wrong: {complaint}")

    @property
    def size(self) -> int:
        """Texels a side of level 0."""
        return self.levels[0].shape[1]


def write_env(path: str | os.PathLike[str], envmap: EnvMap, *, into: Transaction | None = None) -> tuple[int, int]:
    """Write `envmap` as `.env` version 2 with PNG images; the same map gives the same bytes.

    Returns the number of values clipped to 255, the largest that RGBD holds, and the number of negative values set
    to 0. Raises `InputError` for NaN, and `FileError` where the file cannot be written.
    """
    data, clipped, negative = env_bytes(envmap)
    write_pieces(path, [data], into)
    return clipped, negative


def env_bytes(envmap: EnvMap) -> tuple[bytes, int, int]:
    """Return the bytes of the file and the two counts of `write_env`. Raises `InputError` for NaN."""
    if envmap.irradiance is not None and envmap.polynomials is None:
        # Babylon would write zeros, and materials that do not read the cube would be black.
        raise ValueError("irradiance as a cube needs polynomials too")
    places: list[dict[str, int]] = []
    blobs: list[bytes] = []
    at = clipped = negative = 0
    for level in (*envmap.levels, *([] if envmap.irradiance is None else [envmap.irradiance])):
        images, over, below = encode_faces(level)
        clipped, negative = clipped + over, negative + below
        for image in images:
            places.append({"length": len(image), "position": at})
            at += len(image)
        blobs += images
    specular = places[: 6 * len(envmap.levels)]
    irradiance: dict[str, Any] | None = None
    if envmap.polynomials is not None:
        rows = np.asarray(envmap.polynomials, np.float64).tolist()
        irradiance = dict(zip(POLYNOMIALS, rows, strict=True))
        if envmap.irradiance is not None:
            irradiance["irradianceTexture"] = {"size": envmap.irradiance.shape[1], "faces": places[len(specular) :]} | (
                {} if envmap.dominant is None else {"dominantDirection": list(envmap.dominant)}
            )
    manifest = {
        "version": VERSION,
        "width": envmap.size,
        "imageType": "image/png",
        "irradiance": irradiance,
        "specular": {"mipmaps": specular, "lodGenerationScale": envmap.lod_scale},
    }
    text = json.dumps(manifest, separators=(",", ":"), allow_nan=False)
    return MAGIC + text.encode("ascii") + b"\0" + b"".join(blobs), clipped, negative


def read_env(path: str | os.PathLike[str]) -> EnvMap:
    """Read an `.env` file of version 1 or 2 and decode it as the engine does.

    Raises `FileError` for a file that cannot be read, and `InputError` for one that is not valid.
    """
    return parse_env(load(path))


def parse_env(source: Source) -> EnvMap:
    """Parse the bytes of an `.env` file. Raises `InputError` where they are not valid."""
    if source.piece(0, len(MAGIC), "the magic number of an .env") != MAGIC:
        raise source.wrong("it does not begin with the magic number of a Babylon.js .env")
    head = bytes(source.view[len(MAGIC) : len(MAGIC) + _MAX_MANIFEST])
    length = head.find(b"\0")
    if length < 0:
        raise source.wrong(f"its manifest does not end within {len(head)} bytes")
    # The engine reads the manifest byte by byte, which is Latin-1.
    manifest = parse_object(source, head[:length].decode("latin-1"), "its manifest")
    start = len(MAGIC) + length + 1
    take = Reader(source)
    version = take.whole(manifest.get("version", 1), "its version", 1, VERSION)
    width = take.whole(manifest.get("width"), "its width", 1, MAX_SIZE)
    if width & (width - 1):
        raise source.wrong(f"its width is {width}, a power of two was expected")
    image_type = "image/png" if version == 1 else take.text(manifest.get("imageType", "image/png"), "its imageType")
    if image_type not in _IMAGE_TYPES:
        raise source.wrong(f"its images are {image_type[:40]!r}, {' and '.join(_IMAGE_TYPES)} are read")
    specular = take.object(manifest.get("specular"), "specular")
    count = width.bit_length()
    spans = _spans(take, specular.get("mipmaps"), "specular.mipmaps", 6 * count, start)
    scale = take.number(specular.get("lodGenerationScale") or LOD_SCALE, "lodGenerationScale")  # as `||` in JavaScript
    if not LEAST_SCALE <= scale <= MOST_SCALE:
        raise source.wrong(f"its lodGenerationScale is {scale:g}, {LEAST_SCALE:g} to {MOST_SCALE:g} is read")

    light = take.object(manifest.get("irradiance") or {}, "irradiance")
    polynomials = None
    if any(name in light for name in POLYNOMIALS):
        polynomials = take.rows([light.get(name) for name in POLYNOMIALS], "irradiance (x y z xx yy zz yz zx xy)", 9)
    dominant = None
    side = 0
    if light.get("irradianceTexture"):
        texture = take.object(light["irradianceTexture"], "irradianceTexture")
        side = take.whole(texture.get("size"), "the size of irradianceTexture", 1, MAX_SIZE)
        if side & (side - 1):
            raise source.wrong(f"the size of irradianceTexture is {side}, a power of two was expected")
        spans += _spans(take, texture.get("faces"), "irradianceTexture.faces", 6, start)
        if texture.get("dominantDirection"):
            x, y, z = take.rows([texture["dominantDirection"]], "dominantDirection", 1)[0].tolist()
            dominant = x, y, z
    for (first, bytes_there), (second, _) in zip(sorted(spans), sorted(spans)[1:], strict=False):
        if first + bytes_there > second:  # else a small file could unpack to any size
            raise source.wrong(f"its images overlap at byte {second}, each must have bytes of its own")

    sides = [width >> k for k in range(count)] + [side] * (side > 0)
    texels = sum(6 * n * n for n in sides)
    most = max(sides) ** 2
    # All cubes as floats, the six faces of one besides, and the codes of one face as they are decoded.
    memory.require(
        len(source) + 12 * texels + 72 * most + 12 * most, f"its {texels} texels as floats", source.name, len(source)
    )
    cubes = []
    for k, n in enumerate(sides):
        mip = f"mip {k}" if k < count else "irradianceTexture"
        faces = [
            decode_face(Source(source.piece(*span, mip), f"{source.name}, face {face} of {mip},"), n)
            for face, span in enumerate(spans[6 * k : 6 * k + 6])
        ]
        cubes.append(np.stack(faces))
    return EnvMap(
        tuple(cubes[:count]), polynomials, cubes[count] if side else None, scale, dominant, version, image_type
    )


def _spans(take: Reader, value: Any, what: str, count: int, start: int) -> list[tuple[int, int]]:
    """Return the offset in the file and the length of each of `count` images."""
    most = len(take.source)
    out = []
    for k, entry in enumerate(take.array(value, what, count, count)):
        place = take.object(entry, f"entry {k} of {what}")
        length = take.whole(place.get("length"), f"the length of entry {k} of {what}", 1, most)
        position = take.whole(place.get("position"), f"the position of entry {k} of {what}", 0, most)
        take.source.piece(start + position, length, f"entry {k} of {what}")
        out.append((start + position, length))
    return out
