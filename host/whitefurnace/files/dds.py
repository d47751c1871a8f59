"""Reads and writes DDS with the DX10 header [Microsoft, Programming Guide for DDS; DDS_HEADER; DDS_HEADER_DXT10].

The older headers of the same float formats are read too.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator

from whitefurnace.errors import UnsupportedError
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.binary import Buffer, Source, load
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.texture import Texture, check_header, level_bytes

MAGIC = b"DDS "
# DXGI_FORMAT
_DXGI = {"rgba32f": 2, "rgba16f": 10, "b10g11r11": 26, "rg16f": 34, "rgb9e5": 67, "bc6hu": 95, "bc6hs": 96}
_BY_DXGI = {code: name for name, code in _DXGI.items()}
# D3DFORMAT in place of a FourCC, before DX10
_BY_FOURCC = {112: "rg16f", 113: "rgba16f", 116: "rgba32f"}
_DX10 = int.from_bytes(b"DX10", "little")
_CAPS, _HEIGHT, _WIDTH, _PITCH, _PIXELFORMAT, _MIPMAPCOUNT, _LINEARSIZE = 1, 2, 4, 8, 0x1000, 0x20000, 0x80000
_FOURCC = 4
_CAPS_COMPLEX, _CAPS_TEXTURE, _CAPS_MIPMAP = 8, 0x1000, 0x400000
_CAPS2_CUBE, _CAPS2_FACES, _CAPS2_VOLUME = 0x200, 0xFC00, 0x200000
_TEXTURE2D, _MISC_CUBE = 3, 4


def write_dds(path: str | os.PathLike[str], texture: Texture, *, into: Transaction | None = None) -> None:
    """Write `texture` as DDS with the DX10 header; the same texture gives the same bytes.

    DDS has no key-values, so they are left out. An array of one layer is written as a single texture.
    Raises `UnsupportedError` for a pixel format that is not written to DDS, and `FileError` where the file cannot be
    written.
    """
    write_pieces(path, _pieces(texture), into)


def dds_bytes(texture: Texture) -> bytes:
    """Return the bytes of the DDS file of `texture`. Raises `UnsupportedError`."""
    return b"".join(_pieces(texture))


def read_dds(path: str | os.PathLike[str]) -> Texture:
    """Read a DDS file with a 2-D texture, a cube, or an array of either.

    Raises `FileError` for a file that cannot be read, and `InputError` for one that is not valid.
    """
    return parse_dds(load(path))


def parse_dds(source: Source) -> Texture:
    """Parse the bytes of a DDS file. Raises `InputError` where they are not valid."""
    if source.piece(0, 4, "the DDS magic number") != MAGIC:
        raise source.wrong("it does not begin with the magic number of DDS")
    header = source.integers("31I", 4, "the DDS header")
    size, _, height, width, _, _, levels = header[:7]
    pixel_size, pixel_flags, fourcc = header[18:21]
    caps2 = header[27]
    if size != 124 or pixel_size != 32:
        raise source.wrong(f"its header and pixel format have {size} and {pixel_size} bytes, 124 and 32 are allowed")
    if not pixel_flags & _FOURCC:
        raise source.wrong("its pixel format is one of integers, floats and BC6H are read")
    if caps2 & _CAPS2_VOLUME:
        raise source.wrong("it is a 3-D texture, 2-D ones and cubes are read")
    at, layers, name = 128, 1, _BY_FOURCC.get(fourcc)
    if fourcc == _DX10:
        dxgi, dimension, misc, layers, _ = source.integers("5I", at, "the DX10 header")
        at, name, cube = 148, _BY_DXGI.get(dxgi), bool(misc & _MISC_CUBE)
        if name is None:
            known = ", ".join(f"{code} ({name})" for name, code in _DXGI.items())
            raise source.wrong(f"its dxgiFormat is {dxgi}, known are {known}")
        if dimension != _TEXTURE2D:
            raise source.wrong(f"its resourceDimension is {dimension}, 3 (2-D textures and cubes) is read")
        if layers < 1:
            raise source.wrong("its arraySize is 0, it must be at least 1")
    else:
        if name is None:
            known = ", ".join(f"{code} ({name})" for code, name in _BY_FOURCC.items())
            raise source.wrong(f"its FourCC is {fourcc:#010x}, known are DX10 and {known}")
        cube = bool(caps2 & _CAPS2_CUBE)
        if cube and caps2 & _CAPS2_FACES != _CAPS2_FACES:
            raise source.wrong("its cube has not all of its six faces")
    levels = max(levels, 1)  # 0 where dwMipMapCount is not valid
    faces = 6 if cube else 1
    sizes = check_header(source, name, width, height, layers, faces, levels)
    if at + sum(sizes) != len(source):
        raise source.wrong(f"its header describes {at + sum(sizes)} bytes, the file has {len(source)}")
    images = layers * faces
    parts: list[list[Buffer]] = [[] for _ in sizes]
    for _ in range(images):
        for k, part in enumerate(parts):
            length = sizes[k] // images
            part.append(source.piece(at, length, f"level {k}"))
            at += length
    found = tuple(part[0] if images == 1 else b"".join(part) for part in parts)
    return Texture(name, width, height, found, 0 if layers == 1 else layers, faces)


def _pieces(texture: Texture) -> Iterator[Buffer]:
    if texture.format not in _DXGI:
        raise UnsupportedError(f"DDS is not written in {texture.format}, only in {', '.join(_DXGI)}")
    if texture.orientation != "rd":
        raise ValueError(f"DDS has the orientation rd, not {texture.orientation}")
    return _file(texture)


def _file(texture: Texture) -> Iterator[Buffer]:
    kind, count = FORMATS[texture.format], len(texture.levels)
    images = max(texture.layers, 1) * texture.faces
    flags = _CAPS | _HEIGHT | _WIDTH | _PIXELFORMAT | (_LINEARSIZE if kind.block > 1 else _PITCH)
    caps, caps2 = _CAPS_TEXTURE, 0
    if count > 1:
        flags |= _MIPMAPCOUNT
        caps |= _CAPS_COMPLEX | _CAPS_MIPMAP
    if texture.cube:
        caps |= _CAPS_COMPLEX
        caps2 = _CAPS2_CUBE | _CAPS2_FACES
    # Bytes of a row of level 0; for block formats, bytes of the whole image.
    pitch = level_bytes(texture.format, texture.width, texture.height if kind.block > 1 else 1, 0)
    yield MAGIC + struct.pack(
        "<31I",
        124,
        flags,
        texture.height,
        texture.width,
        pitch,
        0,
        count,
        *[0] * 11,
        32,
        _FOURCC,
        _DX10,
        0,
        0,
        0,
        0,
        0,
        caps,
        caps2,
        0,
        0,
        0,
    )
    yield struct.pack(
        "<5I", _DXGI[texture.format], _TEXTURE2D, _MISC_CUBE if texture.cube else 0, max(texture.layers, 1), 0
    )
    for image in range(images):
        for k, level in enumerate(texture.levels):
            size = texture.level_bytes(k) // images
            yield memoryview(level)[image * size : (image + 1) * size]
