"""Reads and writes KTX 1 [Khronos KTX File Format Specification, 1.1], the container that Filament loads."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from whitefurnace.errors import UnsupportedError
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.binary import Buffer, Source, load, pack_key_values, parse_key_values
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.texture import Texture, check_header, text_value

IDENTIFIER = b"\xabKTX 11\xbb\r\n\x1a\n"
_ENDIANNESS = 0x04030201
_HEADER = struct.Struct("<13I")
_START = len(IDENTIFIER) + _HEADER.size


class _Codes(NamedTuple):
    """Header fields of a pixel format: glType, glTypeSize, glFormat, glInternalFormat, glBaseInternalFormat."""

    type: int
    type_size: int
    format: int
    internal: int
    base: int


# [GL 4.6 core, tables 8.2, 8.3 and 8.12; ARB_texture_compression_bptc]
_RG, _RGB, _RGBA, _HALF, _FLOAT = 0x8227, 0x1907, 0x1908, 0x140B, 0x1406
_CODES = {
    "rg16f": _Codes(_HALF, 2, _RG, 0x822F, _RG),
    "rgb16f": _Codes(_HALF, 2, _RGB, 0x881B, _RGB),
    "rgba16f": _Codes(_HALF, 2, _RGBA, 0x881A, _RGBA),
    "rgba32f": _Codes(_FLOAT, 4, _RGBA, 0x8814, _RGBA),
    "rgb9e5": _Codes(0x8C3E, 4, _RGB, 0x8C3D, _RGB),
    # Filament's cmgen writes 0x8C3A three times and its loader requires it; GL's own type is 0x8C3B, its format RGB.
    "b10g11r11": _Codes(0x8C3A, 1, 0x8C3A, 0x8C3A, _RGB),
    "bc6hu": _Codes(0, 1, 0, 0x8E8F, _RGB),
    "bc6hs": _Codes(0, 1, 0, 0x8E8E, _RGB),
}
_BY_INTERNAL = {codes.internal: name for name, codes in _CODES.items()}
# Further pairs (glType, glFormat) that other programs write for an internal format.
_ALSO = {"b10g11r11": {(0x8C3B, _RGB)}}
_ORIENTATION = "KTXorientation"


def write_ktx1(path: str | os.PathLike[str], texture: Texture, *, into: Transaction | None = None) -> None:
    """Write `texture` as KTX 1; the same texture gives the same bytes.

    Raises `UnsupportedError` for a pixel format that is not written to KTX 1, and `FileError` where the file cannot be
    written.
    """
    write_pieces(path, _pieces(texture), into)


def ktx1_bytes(texture: Texture) -> bytes:
    """Return the bytes of the KTX 1 file of `texture`. Raises `UnsupportedError`."""
    return b"".join(_pieces(texture))


def read_ktx1(path: str | os.PathLike[str]) -> Texture:
    """Read a KTX 1 file with a 2-D texture, a cube, or an array of either.

    Raises `FileError` for a file that cannot be read, and `InputError` for one that is not valid.
    """
    return parse_ktx1(load(path))


def parse_ktx1(source: Source) -> Texture:
    """Parse the bytes of a KTX 1 file. Raises `InputError` where they are not valid."""
    if source.piece(0, 12, "the KTX 1 identifier") != IDENTIFIER:
        raise source.wrong("it does not begin with the identifier of KTX 1")
    (endianness, kind, _, form, internal, _, width, height, depth, layers, faces, levels, key_bytes) = source.integers(
        "13I", len(IDENTIFIER), "the KTX 1 header"
    )
    if endianness != _ENDIANNESS:
        raise source.wrong(f"its endianness is {endianness:#010x}, only little-endian KTX 1 (0x04030201) is read")
    name = _BY_INTERNAL.get(internal)
    if name is None:
        known = ", ".join(f"{codes.internal:#06x} ({name})" for name, codes in _CODES.items())
        raise source.wrong(f"its glInternalFormat is {internal:#06x}, known are {known}")
    codes = _CODES[name]
    if (kind, form) not in {(codes.type, codes.format), *_ALSO.get(name, ())}:
        raise source.wrong(
            f"its glType {kind:#06x} and glFormat {form:#06x} do not fit its glInternalFormat {internal:#06x} "
            f"({name}), {codes.type:#06x} and {codes.format:#06x} do"
        )
    if depth > 1:
        raise source.wrong(f"its pixelDepth is {depth}, 3-D textures are not read")
    levels = max(levels, 1)  # 0 asks the loader to generate mip levels
    sizes = check_header(source, name, width, height, layers, faces, levels)
    if key_bytes % 4:
        raise source.wrong(f"its bytesOfKeyValueData is {key_bytes}, a multiple of 4 is allowed")
    pairs = parse_key_values(source, _START, key_bytes)
    orientation = _orientation(source, pairs.pop(_ORIENTATION, b"S=r,T=d"))
    at = _START + key_bytes
    found: list[Buffer] = []
    for k, size in enumerate(sizes):
        (stated,) = source.integers("I", at, f"the size of level {k}")
        row, padded, rows = _rows(name, width, height, k, layers, faces)
        total = padded * rows
        wanted = total // 6 if _lone_cube(layers, faces) else total
        if stated != wanted:
            raise source.wrong(f"the imageSize of level {k} is {stated}, a level of its header's size has {wanted}")
        piece: Buffer = source.piece(at + 4, total, f"level {k}")
        if padded > row:
            piece = np.frombuffer(piece, np.uint8).reshape(rows, padded)[:, :row].tobytes()
        assert len(piece) == size
        found.append(piece)
        at += 4 + total
    if at != len(source):
        raise source.wrong(f"its header describes {at} bytes, the file has {len(source)}")
    return Texture(name, width, height, tuple(found), layers, faces, pairs, orientation)


def _lone_cube(layers: int, faces: int) -> bool:
    """Return whether imageSize is the size of one face, which holds for a cube that is not an array."""
    return faces == 6 and layers == 0


def _rows(form: str, width: int, height: int, k: int, layers: int, faces: int) -> tuple[int, int, int]:
    """Return the bytes of a row of level k, the same padded to 4 (GL_UNPACK_ALIGNMENT), and the rows of the level.

    With padded rows, cubePadding and mipPadding are always empty.
    """
    kind = FORMATS[form]
    columns, rows = (-(-max(side >> k, 1) // kind.block) for side in (width, height))
    row = columns * kind.size
    return row, row + -row % 4, rows * max(layers, 1) * faces


def _orientation(source: Source, value: bytes) -> str:
    """Parse an orientation such as `S=r,T=d` to "rd". Raises `InputError`."""
    parts = value.rstrip(b"\0").split(b",")
    short = b"".join(part[2:] for part in parts)
    if [part[:2] for part in parts] not in ([b"S=", b"T="], [b"S=", b"T=", b"R="]) or short[:2] not in (
        b"rd",
        b"ru",
        b"ld",
        b"lu",
    ):
        raise source.wrong("its KTXorientation is not of the form S=r,T=d (r or l, d or u)")
    return short[:2].decode()


def _pieces(texture: Texture) -> Iterator[Buffer]:
    codes = _CODES.get(texture.format)
    if codes is None:
        raise UnsupportedError(f"KTX 1 is not written in {texture.format}, only in {', '.join(_CODES)}")
    orientation = f"S={texture.orientation[0]},T={texture.orientation[1]}"
    pairs = {**texture.key_values, _ORIENTATION: text_value(orientation)}
    return _file(texture, codes, pack_key_values(pairs))


def _file(texture: Texture, codes: _Codes, keys: bytes) -> Iterator[Buffer]:
    yield (
        IDENTIFIER
        + _HEADER.pack(
            _ENDIANNESS,
            *codes,
            texture.width,
            texture.height,
            0,
            texture.layers,
            texture.faces,
            len(texture.levels),
            len(keys),
        )
        + keys
    )
    for k, level in enumerate(texture.levels):
        row, padded, rows = _rows(texture.format, texture.width, texture.height, k, texture.layers, texture.faces)
        total = padded * rows
        yield struct.pack("<I", total // 6 if _lone_cube(texture.layers, texture.faces) else total)
        if padded > row:
            array = np.zeros((rows, padded), np.uint8)
            array[:, :row] = np.frombuffer(level, np.uint8).reshape(rows, row)
            yield array.tobytes()
        else:
            yield memoryview(level)
