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
from whitefurnace.files.format_names import gl_name
from whitefurnace.files.meaning import STRAIGHT_ORDER, Meaning
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.texture import Levels, Texture, check_header, text_value

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
_RED, _RG, _RGB, _RGBA = 0x1903, 0x8227, 0x1907, 0x1908
_BYTE, _SHORT, _FLOAT, _HALF = 0x1401, 0x1403, 0x1406, 0x140B
_FORMATS = (_RED, _RG, _RGB, _RGBA)
_CODES = {
    **{
        f"{letters}{kind}": _Codes(number, size, _FORMATS[k], internals[k], _FORMATS[k])
        for kind, number, size, internals in (
            ("16f", _HALF, 2, (0x822D, 0x822F, 0x881B, 0x881A)),
            ("32f", _FLOAT, 4, (0x822E, 0x8230, 0x8815, 0x8814)),
            ("8", _BYTE, 1, (0x8229, 0x822B, 0x8051, 0x8058)),
            ("16", _SHORT, 2, (0x822A, 0x822C, 0x8054, 0x805B)),
        )
        for k, letters in enumerate(("r", "rg", "rgb", "rgba"))
    },
    "rgb8srgb": _Codes(_BYTE, 1, _RGB, 0x8C41, _RGB),
    "rgba8srgb": _Codes(_BYTE, 1, _RGBA, 0x8C43, _RGBA),
    "rgb9e5": _Codes(0x8C3E, 4, _RGB, 0x8C3D, _RGB),
    # Filament's loader requires 0x8C3A three times. GL has the type 0x8C3B and the format RGB.
    "b10g11r11": _Codes(0x8C3A, 1, 0x8C3A, 0x8C3A, _RGB),
    "bc6hu": _Codes(0, 1, 0, 0x8E8F, _RGB),
    "bc6hs": _Codes(0, 1, 0, 0x8E8E, _RGB),
}
_BY_INTERNAL = {codes.internal: name for name, codes in _CODES.items()}
# The texels are what glType and glFormat say; glInternalFormat is what a GPU converts them to.
_BY_LAYOUT = {(codes.type, codes.format): name for name, codes in _CODES.items() if "srgb" not in name and codes.type}
# Other programs write R11G11B10F by any of the two numbers in both places: cmgen of Debian 0x8C3A and RGB.
_BY_LAYOUT |= {(kind, form): "b10g11r11" for kind in (0x8C3A, 0x8C3B) for form in (0x8C3A, _RGB)}
# BGR and BGRA: the order of the channels in a texel.
_SWAPPED = {0x80E0: (_RGB, "bgra"), 0x80E1: (_RGBA, "bgra")}
_UNSIZED = {0x8C40: "srgb", 0x8C42: "srgb", **dict.fromkeys(_FORMATS, "whole")}
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

    Raises `FileError` for a file that cannot be read, `InputError` for one that is not valid, and `UnsupportedError`
    for one that is valid and not read.
    """
    return parse_ktx1(load(path))


def parse_ktx1(source: Source) -> Texture:
    """Parse the bytes of a KTX 1 file, of either byte order.

    Raises `InputError` where they are not valid, and `UnsupportedError` for a format that is not read.
    """
    if source.piece(0, 12, "the KTX 1 identifier") != IDENTIFIER:
        raise source.wrong("it does not begin with the identifier of KTX 1")
    order = _byte_order(source)
    (_, kind, type_size, form, internal, _, width, height, depth, layers, faces, levels, key_bytes) = struct.unpack(
        f"{order}13I", source.piece(len(IDENTIFIER), _HEADER.size, "the KTX 1 header")
    )
    name, channels = _pixel_format(source, kind, form, internal)
    if depth > 1 or (width and not height):
        raise UnsupportedError(
            f"{source.name} is a {'3-D' if depth > 1 else '1-D'} texture, 2-D ones and cubes are read"
        )
    levels = max(levels, 1)  # 0 asks the loader to generate mip levels
    swap = _swapped_bytes(source, order, name, type_size)
    sizes = check_header(source, name, width, height, layers, faces, levels, packed=swap > 1)
    if key_bytes % 4:
        raise source.wrong(f"its bytesOfKeyValueData is {key_bytes}, a multiple of 4 is allowed")
    pairs = parse_key_values(source, _START, key_bytes, order)
    orientation = _orientation(source, pairs.pop(_ORIENTATION, b"S=r,T=d"))
    at = _START + key_bytes
    starts = []
    for k in range(len(sizes)):
        (stated,) = struct.unpack(f"{order}I", source.piece(at, 4, f"the size of level {k}"))
        _, padded, rows = _rows(name, width, height, k, layers, faces)
        total = padded * rows
        wanted = total // 6 if _lone_cube(layers, faces) else total
        if stated != wanted:
            raise source.wrong(f"the imageSize of level {k} is {stated}, a level of its header's size has {wanted}")
        source.piece(at + 4, total, f"level {k}")
        starts.append(at + 4)
        at += 4 + total
    if at != len(source):
        raise source.wrong(f"its header describes {at} bytes, the file has {len(source)}")

    def unpack(k: int) -> Buffer:
        row, padded, rows = _rows(name, width, height, k, layers, faces)
        piece: Buffer = source.piece(starts[k], padded * rows, f"level {k}")
        if padded > row:
            piece = np.frombuffer(piece, np.uint8).reshape(rows, padded)[:, :row].tobytes()
        return np.frombuffer(piece, f"u{swap}").byteswap().tobytes() if swap > 1 else piece

    meaning = Meaning(order=channels)
    return Texture(name, width, height, Levels(len(sizes), unpack), layers, faces, pairs, orientation, meaning)


def _byte_order(source: Source) -> str:
    """Return the order of the bytes of a file, "<" or ">", by its field `endianness` [KTX 1.1, 2.2]."""
    stated = bytes(source.piece(len(IDENTIFIER), 4, "the KTX 1 header"))
    for order in "<>":
        if struct.unpack(f"{order}I", stated)[0] == _ENDIANNESS:
            return order
    raise source.wrong(f"its endianness is {stated.hex()}, 01020304 or 04030201 was expected")


def _swapped_bytes(source: Source, order: str, name: str, type_size: int) -> int:
    """Return the size of the units in which the bytes of texels are swapped; 1 for none.

    The units are stated by glTypeSize, which must fit the pixel format.
    """
    if order == "<":
        return 1
    size = 4 if name == "b10g11r11" else _CODES[name].type_size
    if type_size != size:
        raise source.wrong(f"its glTypeSize is {type_size}, {name} has {size}")
    return size


def _pixel_format(source: Source, kind: int, form: int, internal: int) -> tuple[str, str]:
    """Return the pixel format of the texels and the order of their channels.

    kind: glType. form: glFormat. internal: glInternalFormat, which says whether integers are in sRGB. Raises
    `UnsupportedError` for formats that are not read, by name, and `InputError` for numbers that contradict each other.
    """
    there = _BY_INTERNAL.get(internal)
    known = internal in _UNSIZED or there is not None
    if not known:
        title = gl_name(internal)
        if title is None and internal < 0x100:
            raise source.wrong(f"its glInternalFormat is {internal:#06x}, which is not a format of OpenGL")
        shown = f"{internal:#06x} ({title or 'of an extension'})"
        raise UnsupportedError(
            f"{source.name} has the glInternalFormat {shown}, which is not read; {', '.join(_CODES)} are"
        )
    plain, channels = _SWAPPED.get(form, (form, STRAIGHT_ORDER))
    name = _BY_LAYOUT.get((kind, plain)) if kind or form else there
    target = _UNSIZED[internal] if there is None else FORMATS[there].kind
    base = internal if there is None else _CODES[there].base
    base = {0x8C40: _RGB, 0x8C42: _RGBA}.get(base, base)
    fits = name is not None and base == _CODES[name].base and (not kind) == (FORMATS[name].block > 1)
    if fits and name is not None and target == "srgb":
        name, fits = f"{name}srgb", FORMATS[name].kind == "whole" and f"{name}srgb" in _CODES
    if not fits or name is None or (target == "whole" and there and FORMATS[name].kind == "float"):
        raise source.wrong(
            f"its glType {kind:#06x} and glFormat {form:#06x} do not fit its glInternalFormat {internal:#06x} "
            f"({there or gl_name(internal)})"
            + (f", {_CODES[there].type:#06x} and {_CODES[there].format:#06x} do" if there else "")
        )
    return name, channels


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
