"""Reads and writes KTX 2 [Khronos KTX File Format Specification, 2.0], plain or supercompressed by Zstandard or ZLIB.

Its data format descriptors follow [Khronos Data Format Specification, 1.3] (KDF).
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from whitefurnace.errors import UnsupportedError
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.binary import Buffer, Source, load, pack_key_values, parse_key_values
from whitefurnace.files.colour import LINEAR, from_code_points
from whitefurnace.files.format_names import vk_name
from whitefurnace.files.meaning import STRAIGHT_ORDER, Meaning, is_order, is_range
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.texture import Levels, Texture, check_header, text_value
from whitefurnace.files.zstd import DEFLATE_RATIO, MAX_RATIO, compress, decompress, inflate

IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
WRITER = "whitefurnace"
_HEADER = struct.Struct("<9I4I2Q")
_LEVEL = struct.Struct("<3Q")
_NONE, _ZSTD, _ZLIB = 0, 2, 3
_SCHEMES = {0: "none", 1: "BasisLZ", 2: "Zstandard", 3: "ZLIB"}
_ORIENTATION = "KTXorientation"

# KDF 1.3: colour models (5.6), transfer functions (5.8), channels of RGBSDA and qualifiers of a sample
_RGBSDA, _BC6H, _ASTC, _UASTC_HDR = 1, 133, 162, 167
_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 15}
_FLOAT, _SIGNED, _EXPONENT, _STRAIGHT = 0x80, 0x40, 0x20, 0x10
_PREMULTIPLIED = 1
_ONE, _MINUS_ONE = 0x3F800000, 0xBF800000  # bits of float32 1 and −1, the range of values that is displayed
_BT709, _LINEAR, _SRGB_CODE = 1, 1, 2


@dataclass(frozen=True)
class _Kind:
    """Fields of a pixel format in KTX 2: VkFormat, typeSize, and the descriptor's colour model and samples.

    A sample is (bit offset, bits, channel with qualifiers, lower, upper).
    """

    vk: int
    type_size: int
    model: int
    samples: tuple[tuple[int, int, int, int, int], ...]


def _numbers(vk: int, letters: str, kind: str) -> _Kind:
    """Return the fields of a format whose channels are numbers of one type."""
    bits = 32 if kind.startswith("32") else 16 if kind.startswith("16") else 8
    samples = []
    for c, letter in enumerate(letters):
        channel = _CHANNELS[letter]
        if kind.endswith("f"):
            samples.append((c * bits, bits, channel | _FLOAT | _SIGNED, _MINUS_ONE, _ONE))
        else:
            straight = _STRAIGHT if kind.endswith("srgb") and letter == "a" else 0
            samples.append((c * bits, bits, channel | straight, 0, (1 << bits) - 1))
    return _Kind(vk, bits // 8, _RGBSDA, tuple(samples))


_KINDS = {
    **{
        f"{letters}{kind}": _numbers(vk, letters, kind)
        for kind, codes in (
            ("8", (9, 16, 23, 37)),
            ("16", (70, 77, 84, 91)),
            ("16f", (76, 83, 90, 97)),
            ("32f", (100, 103, 106, 109)),
            ("8srgb", (None, None, 29, 43)),
        )
        for letters, vk in zip(("r", "rg", "rgb", "rgba"), codes, strict=True)
        if vk is not None
    },
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
_BY_VK = {kind.vk: (name, STRAIGHT_ORDER) for name, kind in _KINDS.items()}
# B8G8R8 and B8G8R8A8: the same texels with red and blue exchanged.
_BY_VK |= {30: ("rgb8", "bgra"), 36: ("rgb8srgb", "bgra"), 44: ("rgba8", "bgra"), 50: ("rgba8srgb", "bgra")}
# Transfer functions of KDF 1.3 (5.8) by number, as code points of H.273 where that has them.
_TRANSFERS = {0: 8, 1: 8, 2: 13, 3: 1, 8: 18, 10: 16, 15: 7}
_TRANSFER_NAMES = (
    *("unspecified", "linear", "sRGB", "ITU", "NTSC", "S-Log", "S-Log 2", "BT.1886", "HLG", "inverse HLG", "PQ"),
    *("inverse PQ", "DCI-P3", "PAL", "PAL 625", "ST 240", "ACEScc", "ACEScct", "Adobe RGB"),
)
# Primaries of KDF 1.3 (5.7) by number, as code points of H.273 where that has them.
_PRIMARIES = {0: 1, 1: 1, 2: 5, 3: 6, 4: 9, 8: 4, 9: 22, 10: 12}
_PRIMARY_NAMES = (
    *("unspecified", "BT.709", "BT.601 EBU", "BT.601 SMPTE", "BT.2020", "CIE XYZ", "ACES", "ACEScc", "NTSC 1953"),
    *("PAL 525", "Display P3", "Adobe RGB"),
)
# Colour models of KDF 1.3 (5.6) that have no VkFormat.
_MODELS = {163: "BasisLZ (ETC1S)", 166: "UASTC LDR 4 x 4", 167: "UASTC HDR 4 x 4", 168: "UASTC HDR 6 x 6"}


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
    """Read a KTX 2 file with a 2-D texture, a cube, or an array of either, plain or packed by Zstandard or ZLIB.

    Raises `FileError` for a file that cannot be read, `InputError` for one that is not valid, and `UnsupportedError`
    for one that is valid and not read.
    """
    return parse_ktx2(load(path))


def parse_ktx2(source: Source) -> Texture:
    """Parse the bytes of a KTX 2 file. Its levels are unpacked at their first use.

    Raises `InputError` where they are not valid, and `UnsupportedError` for a valid file of a kind that is not
    supported.
    """
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
    name, channels = _pixel_format(source, vk, dfd_at, dfd_bytes)
    if scheme not in (_NONE, _ZSTD, _ZLIB):
        title = _SCHEMES.get(scheme, "of a vendor or unknown")
        raise UnsupportedError(
            f"{source.name} has the supercompression scheme {scheme} ({title}), which is not read; 0 (none), "
            "2 (Zstandard) and 3 (ZLIB) are"
        )
    if type_size != _KINDS[name].type_size:
        raise source.wrong(f"its typeSize is {type_size}, {name} has {_KINDS[name].type_size}")
    if depth or (width and not height):
        raise UnsupportedError(f"{source.name} is a {'3-D' if depth else '1-D'} texture, 2-D ones and cubes are read")
    if sgd_bytes:
        raise source.wrong(f"it has {sgd_bytes} bytes of supercompression global data, its scheme has none")
    levels = max(levels, 1)  # 0 asks the loader to generate mip levels
    sizes = check_header(source, name, width, height, layers, faces, levels, packed=scheme != _NONE)
    flags = _check_descriptor(source, name, dfd_at, dfd_bytes)
    pairs = parse_key_values(source, kvd_at, kvd_bytes) if kvd_bytes else {}
    orientation = _orientation(source, pairs.pop(_ORIENTATION, b"rd"), faces)
    if "KTXcubemapIncomplete" in pairs:
        raise UnsupportedError(
            f"{source.name} is a cube without all of its faces (KTXcubemapIncomplete), whole ones are read"
        )
    if "KTXanimData" in pairs:
        raise UnsupportedError(f"{source.name} is an animation (KTXanimData), single textures are read")
    name, meaning, notices = _meaning(source, name, channels, flags, pairs)
    spans = _level_index(source, sizes, scheme)

    def unpack(k: int) -> Buffer | bytearray:
        piece = source.piece(*spans[k], f"level {k}")
        if scheme == _NONE:
            return piece
        return (decompress if scheme == _ZSTD else inflate)(piece, sizes[k], source, f"level {k}")

    return Texture(
        name, width, height, Levels(levels, unpack), layers, faces, pairs, orientation, meaning, tuple(notices)
    )


def _level_index(source: Source, sizes: list[int], scheme: int) -> list[tuple[int, int]]:
    """Return the offset and the length of each level. Raises `InputError` for an index that is not valid."""
    start = len(IDENTIFIER) + _HEADER.size
    spans = []
    for k, size in enumerate(sizes):
        offset, length, unpacked = source.integers("3Q", start + k * _LEVEL.size, f"the index of level {k}")
        if unpacked != size:
            raise source.wrong(f"level {k} says that it has {unpacked} bytes, one of its header's size has {size}")
        if scheme == _NONE and length != size:
            raise source.wrong(f"level {k} says that it takes {length} bytes, one of its header's size has {size}")
        if offset < start + len(sizes) * _LEVEL.size:
            raise source.wrong(f"level {k} says that it begins at byte {offset}, inside the header")
        if length > len(source):  # before the slice: a length of 64 bits may be too large for one
            source.piece(0, length, f"level {k}")
        source.piece(offset, length, f"level {k}")
        if (scheme == _ZSTD and size > length * MAX_RATIO) or (scheme == _ZLIB and size > length * DEFLATE_RATIO):
            raise source.wrong(f"level {k} cannot hold {size} bytes in {length} of {_SCHEMES[scheme]}")
        spans.append((offset, length))
    for (first, length), (second, _) in zip(sorted(spans), sorted(spans)[1:], strict=False):
        if first + length > second:
            raise source.wrong(f"its levels overlap at byte {second}, each must have bytes of its own")
    return spans


def _pixel_format(source: Source, vk: int, dfd_at: int, dfd_bytes: int) -> tuple[str, str]:
    """Return the name of the pixel format and the order of its channels.

    Raises `UnsupportedError` for a format that is not read, by its name, and `InputError` for a number that no format
    has.
    """
    if vk in _BY_VK:
        return _BY_VK[vk]
    if vk == 0:  # a format that Vulkan does not have: the descriptor's colour model names it
        source.piece(dfd_at, dfd_bytes, "the data format descriptor")
        model = source.integers("I", dfd_at + 12, "the data format descriptor")[0] & 255 if dfd_bytes >= 16 else 0
        shown = _MODELS.get(model, f"of the colour model {model}")
        raise UnsupportedError(f"{source.name} is {shown}, which is not read; {', '.join(_KINDS)} are")
    title = vk_name(vk)
    if title is None and vk < 1_000_000_000:  # extensions number from there on
        raise source.wrong(f"its vkFormat is {vk}, which is not a format of Vulkan")
    shown = f"{vk} ({title or 'of an extension'})"
    raise UnsupportedError(f"{source.name} has the vkFormat {shown}, which is not read; {', '.join(_KINDS)} are")


def _meaning(
    source: Source, name: str, channels: str, flags: tuple[int, int, int], pairs: dict[str, bytes]
) -> tuple[str, Meaning, list[str]]:
    """Return the pixel format, the meaning of its numbers, and notices of what is applied.

    flags: primaries, transfer function and flags of the descriptor. Raises `UnsupportedError` for what is valid and
    cannot be applied, and `InputError` for what is not valid.
    """
    primaries, transfer, alpha = flags
    notices = []
    if name.endswith("srgb") and transfer not in (0, _SRGB_CODE):
        raise source.wrong(
            f"its descriptor states the transfer function {_named(_TRANSFER_NAMES, transfer)}, {name} has sRGB"
        )
    if transfer == _SRGB_CODE and f"{name}srgb" in _KINDS:
        notices.append(f"{source.name}: its integers are decoded from sRGB, as its descriptor states")
        name = f"{name}srgb"
    for number, known, names, title in (
        (transfer, _TRANSFERS, _TRANSFER_NAMES, "transfer function"),
        (primaries, _PRIMARIES, _PRIMARY_NAMES, "primaries"),
    ):
        if number not in known:
            read = ", ".join(names[k] for k in known)
            raise UnsupportedError(
                f"{source.name} states the {title} {_named(names, number)}, which cannot be applied; {read} can"
            )
    points = (_PRIMARIES[primaries], 8 if name.endswith("srgb") else _TRANSFERS[transfer], 0, 1)
    stated = from_code_points(points, "its data format descriptor", Path(source.name))
    encoding = None if stated.is_near(LINEAR) else stated
    if encoding is not None:
        notices.append(f"{source.name}: {encoding.said} was applied")
    scale, offset = 1.0, 0.0
    if (value := pairs.get("KTXmapRange")) is not None:
        if len(value) < 8 or any(value[8:]):
            raise source.wrong(f"its KTXmapRange has {len(value)} bytes, two floats were expected")
        scale, offset = struct.unpack("<2f", value[:8])
        if not is_range(scale, offset):
            raise source.wrong(f"its KTXmapRange is {scale:g} and {offset:g}, a finite scale and offset were expected")
        if (scale, offset) != (1.0, 0.0):
            notices.append(f"{source.name}: its KTXmapRange was applied, x·{scale:g} + {offset:g}")
    if (value := pairs.get("KTXswizzle")) is not None:
        order = value.rstrip(b"\0").decode("ascii", "replace")
        if not is_order(order):
            raise source.wrong(f"its KTXswizzle is {order[:20]!r}, four of r, g, b, a, 0 and 1 were expected")
        channels = "".join(channels["rgba".index(letter)] if letter in "rgba" else letter for letter in order)
        if order != STRAIGHT_ORDER:
            notices.append(f"{source.name}: its KTXswizzle {order} was applied")
    premultiplied = bool(alpha & _PREMULTIPLIED) and "a" in channels and FORMATS[name].channels == 4
    if premultiplied:
        notices.append(f"{source.name}: its colours are multiplied with alpha, and were divided by it")
    return name, Meaning(encoding, scale, offset, channels, "premultiplied" if premultiplied else "straight"), notices


def _named(names: Sequence[str], number: int) -> str:
    return f"{number} ({names[number]})" if number < len(names) else str(number)


def _check_descriptor(source: Source, name: str, offset: int, length: int) -> tuple[int, int, int]:
    """Return the primaries, the transfer function and the flags of the data format descriptor.

    Raises `InputError` where it differs from the VkFormat. Only the fields that decide how texels are read are
    compared: the ranges of samples differ between writers.
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
    return model >> 8 & 255, model >> 16 & 255, model >> 24


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
    """Return dfdTotalSize and one basic descriptor block [KDF 1.3, 4 and 5]: BT.709 primaries and straight alpha.

    It states the bytes of a texel with supercompression too [KTX 2.0 from document revision 5 on, DFD for
    Supercompressed Data].
    """
    kind, form = _KINDS[name], FORMATS[name]
    size = 24 + 16 * len(kind.samples)
    side = form.block - 1
    transfer = _SRGB_CODE if name.endswith("srgb") else _LINEAR
    words = [size + 4, 0, 2 | size << 16, kind.model | _BT709 << 8 | transfer << 16, side | side << 8, form.size, 0]
    for offset, bits, channel, lower, upper in kind.samples:
        words += [offset | (bits - 1) << 16 | channel << 24, 0, lower, upper]
    return struct.pack(f"<{len(words)}I", *words)
