"""Reads and writes KTX 2 [Khronos KTX File Format Specification, 2.0], plain or supercompressed by Zstandard.

Its data format descriptors follow [Khronos Data Format Specification, 1.3] (KDF).
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from whitefurnace.errors import UnsupportedError
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.binary import Buffer, Source, load, pack_key_values, parse_key_values
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.texture import Texture, check_header, text_value
from whitefurnace.files.zstd import compress, decompress

IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
WRITER = "whitefurnace"
_HEADER = struct.Struct("<9I4I2Q")
_LEVEL = struct.Struct("<3Q")
_NONE, _ZSTD = 0, 2
_SCHEMES = {0: "none", 1: "BasisLZ", 2: "Zstandard", 3: "ZLIB"}
_ORIENTATION = "KTXorientation"

# KDF 1.3: colour models (5.6), transfer functions (5.8), channels of RGBSDA and qualifiers of a sample
_RGBSDA, _BC6H, _ASTC, _UASTC_HDR = 1, 133, 162, 167
_ALPHA = 15
_FLOAT, _SIGNED, _EXPONENT = 0x80, 0x40, 0x20
_ONE, _MINUS_ONE = 0x3F800000, 0xBF800000  # bits of float32 1 and −1, the range of values that is displayed
_BT709, _LINEAR = 1, 1


@dataclass(frozen=True)
class _Kind:
    """Fields of a pixel format in KTX 2: VkFormat, typeSize, and the descriptor's colour model and samples.

    A sample is (bit offset, bits, channel with qualifiers, lower, upper).
    """

    vk: int
    type_size: int
    model: int
    samples: tuple[tuple[int, int, int, int, int], ...]


def _unpacked(vk: int, channels: int, bits: int) -> _Kind:
    names = (0, 1, 2, _ALPHA)
    samples = ((c * bits, bits, names[c] | _FLOAT | _SIGNED, _MINUS_ONE, _ONE) for c in range(channels))
    return _Kind(vk, bits // 8, _RGBSDA, tuple(samples))


_KINDS = {
    "rg16f": _unpacked(83, 2, 16),
    "rgb16f": _unpacked(90, 3, 16),
    "rgba16f": _unpacked(97, 4, 16),
    "rgba32f": _unpacked(109, 4, 32),
    "b10g11r11": _Kind(
        122,
        4,
        _RGBSDA,
        (
            (0, 11, 0 | _FLOAT, 0, _ONE),
            (11, 11, 1 | _FLOAT, 0, _ONE),
            (22, 10, 2 | _FLOAT, 0, _ONE),
        ),
    ),
    # The ranges of the samples are those that Khronos' dfdutils write for this format.
    "rgb9e5": _Kind(
        123,
        4,
        _RGBSDA,
        tuple(sample for c in range(3) for sample in ((9 * c, 9, c, 0, 8448), (27, 5, c | _EXPONENT, 15, 31))),
    ),
    "bc6hu": _Kind(143, 1, _BC6H, ((0, 128, 0 | _FLOAT, 0, _ONE),)),
    "bc6hs": _Kind(144, 1, _BC6H, ((0, 128, 0 | _FLOAT | _SIGNED, _MINUS_ONE, _ONE),)),
    "astc4x4hdr": _Kind(1000066000, 1, _ASTC, ((0, 128, 0 | _FLOAT | _SIGNED, _MINUS_ONE, _ONE),)),
}
_BY_VK = {kind.vk: name for name, kind in _KINDS.items()}


def write_ktx2(
    path: str | os.PathLike[str], texture: Texture, *, zstd: int | None = None, into: Transaction | None = None
) -> None:
    """Write `texture` as KTX 2; the same texture gives the same bytes.

    zstd: level of Zstandard compression, 1 to 22; None for none. The key KTXwriter is `whitefurnace` unless
    `key_values` have another. Raises `UnsupportedError` for a pixel format that is not written to KTX 2, and
    `FileError` where the file cannot be written.
    """
    write_pieces(path, _pieces(texture, zstd), into)


def ktx2_bytes(texture: Texture, *, zstd: int | None = None) -> bytes:
    """Return the bytes of the KTX 2 file of `texture`. Raises `UnsupportedError`."""
    return b"".join(_pieces(texture, zstd))


def read_ktx2(path: str | os.PathLike[str]) -> Texture:
    """Read a KTX 2 file with a 2-D texture, a cube, or an array of either, plain or packed by Zstandard.

    Raises `FileError` for a file that cannot be read, and `InputError` for one that is not valid.
    """
    return parse_ktx2(load(path))


def parse_ktx2(source: Source) -> Texture:
    """Parse the bytes of a KTX 2 file. Raises `InputError` where they are not valid."""
    if source.piece(0, 12, "the KTX 2 identifier") != IDENTIFIER:
        raise source.wrong("it does not begin with the identifier of KTX 2")
    (
        vk,
        type_size,
        width,
        height,
        depth,
        layers,
        faces,
        levels,
        scheme,
        dfd_at,
        dfd_bytes,
        kvd_at,
        kvd_bytes,
        _,
        sgd_bytes,
    ) = source.integers("9I4I2Q", 12, "the KTX 2 header")
    name = _BY_VK.get(vk)
    if name is None:
        known = ", ".join(f"{kind.vk} ({name})" for name, kind in _KINDS.items())
        raise source.wrong(f"its vkFormat is {vk}, known are {known}")
    if scheme not in (_NONE, _ZSTD):
        title = _SCHEMES.get(scheme, "unknown")
        raise source.wrong(f"its supercompression scheme is {scheme} ({title}), 0 (none) and 2 (Zstandard) are read")
    if type_size != _KINDS[name].type_size:
        raise source.wrong(f"its typeSize is {type_size}, {name} has {_KINDS[name].type_size}")
    if depth:
        raise source.wrong(f"its pixelDepth is {depth}, 3-D textures are not read")
    if sgd_bytes:
        raise source.wrong(f"it has {sgd_bytes} bytes of supercompression global data, its scheme has none")
    levels = max(levels, 1)  # 0 asks the loader to generate mip levels
    sizes = check_header(source, name, width, height, layers, faces, levels)
    _check_descriptor(source, name, dfd_at, dfd_bytes)
    pairs = parse_key_values(source, kvd_at, kvd_bytes) if kvd_bytes else {}
    orientation = _orientation(source, pairs.pop(_ORIENTATION, b"rd"), faces)

    start = len(IDENTIFIER) + _HEADER.size
    spans = []
    for k, size in enumerate(sizes):
        offset, length, unpacked = source.integers("3Q", start + k * _LEVEL.size, f"the index of level {k}")
        if unpacked != size:
            raise source.wrong(f"level {k} says that it has {unpacked} bytes, one of its header's size has {size}")
        if scheme == _NONE and length != size:
            raise source.wrong(f"level {k} says that it takes {length} bytes, one of its header's size has {size}")
        if offset < start + levels * _LEVEL.size:
            raise source.wrong(f"level {k} says that it begins at byte {offset}, inside the header")
        source.piece(offset, length, f"level {k}")
        spans.append((offset, length))
    for (first, length), (second, _) in zip(sorted(spans), sorted(spans)[1:], strict=False):
        if first + length > second:
            raise source.wrong(f"its levels overlap at byte {second}, each must have bytes of its own")
    found: list[Buffer | bytearray] = []
    for k, (offset, length) in enumerate(spans):
        piece = source.piece(offset, length, f"level {k}")
        found.append(piece if scheme == _NONE else decompress(piece, sizes[k], source, f"level {k}"))
    return Texture(name, width, height, tuple(found), layers, faces, pairs, orientation)


def _check_descriptor(source: Source, name: str, offset: int, length: int) -> None:
    """Check the data format descriptor against the VkFormat. Raises `InputError` where they differ.

    Only the fields that decide how texels are read are compared: ranges of samples and primaries differ between
    writers.
    """
    kind, form = _KINDS[name], FORMATS[name]
    source.piece(offset, length, "the data format descriptor")
    if length < 28:
        raise source.wrong(f"its data format descriptor has {length} bytes, at least 28 are needed")
    total, vendor, version_size, model, block, plane = source.integers("6I", offset, "the data format descriptor")
    if total != length:
        raise source.wrong(f"its data format descriptor says that it has {total} bytes, its index says {length}")
    size = version_size >> 16
    if vendor != 0 or not 24 <= size <= length - 4 or (size - 24) % 16:
        raise source.wrong("its data format descriptor does not begin with a basic descriptor block")
    models = {kind.model} | ({_UASTC_HDR} if kind.model == _ASTC else set())
    side = form.block - 1
    if model & 255 not in models or (size - 24) // 16 != len(kind.samples) or block != side | side << 8:
        raise source.wrong(
            f"its data format descriptor (colour model {model & 255}, {(size - 24) // 16} samples) is not one of its "
            f"vkFormat {kind.vk} (colour model {kind.model}, {len(kind.samples)} samples)"
        )
    plane &= 255
    if plane not in (0, form.size):  # specifications before revision 5 required 0 with supercompression
        raise source.wrong(f"its data format descriptor has {plane} bytes a texel or block, {name} has {form.size}")


def _orientation(source: Source, value: bytes, faces: int) -> str:
    text = value.rstrip(b"\0")[:2]
    if text not in (b"rd", b"ru", b"ld", b"lu"):
        raise source.wrong("its KTXorientation is not r or l, then d or u")
    if faces == 6 and text != b"rd":
        raise source.wrong(f"its KTXorientation is {text.decode()}, that of a cube must be rd")
    return text.decode()


def _pieces(texture: Texture, zstd: int | None) -> Iterator[Buffer]:
    if texture.format not in _KINDS:
        raise UnsupportedError(f"KTX 2 is not written in {texture.format}, only in {', '.join(_KINDS)}")
    if texture.cube and texture.orientation != "rd":
        raise ValueError(f"a cube in KTX 2 has the orientation rd, not {texture.orientation}")
    return _file(texture, zstd)


def _file(texture: Texture, zstd: int | None) -> Iterator[Buffer]:
    kind, form = _KINDS[texture.format], FORMATS[texture.format]
    keys = pack_key_values(
        {
            "KTXwriter": text_value(WRITER),
            **texture.key_values,
            _ORIENTATION: text_value(texture.orientation),
        }
    )
    descriptor = data_format_descriptor(texture.format)
    count = len(texture.levels)
    dfd_at = len(IDENTIFIER) + _HEADER.size + count * _LEVEL.size
    kvd_at = dfd_at + len(descriptor)
    at = kvd_at + len(keys)
    align = math.lcm(form.size, 4) if zstd is None else 1

    stored = [memoryview(level) if zstd is None else compress(memoryview(level), zstd) for level in texture.levels]
    index = [b""] * count
    body: list[Buffer] = []
    for k in reversed(range(count)):  # the smallest first
        padding = -at % align
        body += [bytes(padding), stored[k]]
        at += padding
        index[k] = _LEVEL.pack(at, len(stored[k]), memoryview(texture.levels[k]).nbytes)
        at += len(stored[k])
    yield IDENTIFIER + _HEADER.pack(
        kind.vk,
        kind.type_size,
        texture.width,
        texture.height,
        0,
        texture.layers,
        texture.faces,
        count,
        _NONE if zstd is None else _ZSTD,
        dfd_at,
        len(descriptor),
        kvd_at,
        len(keys),
        0,
        0,
    )
    yield b"".join(index) + descriptor + keys
    yield from body


def data_format_descriptor(name: str) -> bytes:
    """Return dfdTotalSize and one basic descriptor block [KDF 1.3, 4 and 5]: linear, BT.709 primaries, straight alpha.

    It states the bytes of a texel with supercompression too [KTX 2.0 from document revision 5 on, DFD for
    Supercompressed Data].
    """
    kind, form = _KINDS[name], FORMATS[name]
    size = 24 + 16 * len(kind.samples)
    side = form.block - 1
    words = [size + 4, 0, 2 | size << 16, kind.model | _BT709 << 8 | _LINEAR << 16, side | side << 8, form.size, 0]
    for offset, bits, channel, lower, upper in kind.samples:
        words += [offset | (bits - 1) << 16 | channel << 24, 0, lower, upper]
    return struct.pack(f"<{len(words)}I", *words)
