"""Reads and writes DDS with the DX10 header [Microsoft, Programming Guide for DDS; DDS_HEADER; DDS_HEADER_DXT10].

The older headers of floats and of 8-bit integers are read too.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from typing import Literal

from whitefurnace.errors import UnsupportedError
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.binary import Buffer, Source, load
from whitefurnace.files.format_names import dxgi_name
from whitefurnace.files.meaning import STRAIGHT_ORDER, Meaning
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.texture import Levels, Texture, check_header, level_bytes

MAGIC = b"DDS "
# DXGI_FORMAT
_DXGI = {
    "rgba32f": 2,
    "rgb32f": 6,
    "rgba16f": 10,
    "rgba16": 11,
    "rg32f": 16,
    "b10g11r11": 26,
    "rgba8": 28,
    "rgba8srgb": 29,
    "rg16f": 34,
    "rg16": 35,
    "r32f": 41,
    "rg8": 49,
    "r16f": 54,
    "r16": 56,
    "r8": 61,
    "rgb9e5": 67,
    "bc6hu": 95,
    "bc6hs": 96,
}
_BY_DXGI = {code: (name, STRAIGHT_ORDER) for name, code in _DXGI.items()}
# Red and blue exchanged; X is a fourth byte without meaning.
_BY_DXGI |= {87: ("rgba8", "bgra"), 88: ("rgba8", "bgr1"), 91: ("rgba8srgb", "bgra"), 93: ("rgba8srgb", "bgr1")}
# D3DFORMAT in place of a FourCC, before DX10
_BY_FOURCC = {36: "rgba16", 111: "r16f", 112: "rg16f", 113: "rgba16f", 114: "r32f", 115: "rg32f", 116: "rgba32f"}
_FOURCC_NAMES = {
    110: "Q16W16V16U16, signed integers",
    117: "CxV8U8",
    **{
        int.from_bytes(text.encode(), "little"): f"{text}, {title}"
        for text, title in (
            ("DXT1", "BC1 blocks"),
            ("DXT2", "BC2 blocks, premultiplied"),
            ("DXT3", "BC2 blocks"),
            ("DXT4", "BC3 blocks, premultiplied"),
            ("DXT5", "BC3 blocks"),
            ("ATI1", "BC4 blocks"),
            ("BC4U", "BC4 blocks"),
            ("BC4S", "BC4 blocks"),
            ("ATI2", "BC5 blocks"),
            ("BC5U", "BC5 blocks"),
            ("BC5S", "BC5 blocks"),
            ("RGBG", "packed RGB"),
            ("GRGB", "packed RGB"),
            ("UYVY", "YUV"),
            ("YUY2", "YUV"),
            ("RXGB", "BC3 blocks of normals"),
        )
    },
}
# Formats of 8-bit integers before DX10, by the bits of a texel and the masks of red, green, blue and alpha.
_BY_MASKS = {
    (32, 0xFF, 0xFF00, 0xFF0000, 0xFF000000): ("rgba8srgb", STRAIGHT_ORDER),
    (32, 0xFF, 0xFF00, 0xFF0000, 0): ("rgba8srgb", "rgb1"),
    (32, 0xFF0000, 0xFF00, 0xFF, 0xFF000000): ("rgba8srgb", "bgra"),
    (32, 0xFF0000, 0xFF00, 0xFF, 0): ("rgba8srgb", "bgr1"),
    (24, 0xFF0000, 0xFF00, 0xFF, 0): ("rgb8srgb", "bgra"),
    (24, 0xFF, 0xFF00, 0xFF0000, 0): ("rgb8srgb", STRAIGHT_ORDER),
}
_DX10 = int.from_bytes(b"DX10", "little")
_CAPS, _HEIGHT, _WIDTH, _PITCH, _PIXELFORMAT, _MIPMAPCOUNT, _LINEARSIZE = 1, 2, 4, 8, 0x1000, 0x20000, 0x80000
_ALPHA_PIXELS, _FOURCC, _RGB = 1, 4, 0x40
_PIXEL_KINDS = {0x2: "alpha alone", 0x20: "a palette", 0x200: "YUV", 0x20000: "luminance", 0x80000: "signed integers"}
_CAPS_COMPLEX, _CAPS_TEXTURE, _CAPS_MIPMAP = 8, 0x1000, 0x400000
_CAPS2_CUBE, _CAPS2_FACES, _CAPS2_VOLUME = 0x200, 0xFC00, 0x200000
_TEXTURE2D, _MISC_CUBE = 3, 4
_DIMENSIONS = {2: "1-D", 4: "3-D"}
_FACES = ("+X", "-X", "+Y", "-Y", "+Z", "-Z")
# Values of miscFlags2 [Microsoft, DDS_HEADER_DXT10]
_ALPHA_MODES: tuple[Literal["straight", "premultiplied", "none"], ...] = (
    *("straight", "straight", "premultiplied"),
    *("none", "none"),  # opaque, and custom, which is no coverage
)


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

    Raises `FileError` for a file that cannot be read, `InputError` for one that is not valid, and `UnsupportedError`
    for one that is valid and not read.
    """
    return parse_dds(load(path))


def parse_dds(source: Source) -> Texture:
    """Parse the bytes of a DDS file.

    Raises `InputError` where they are not valid, and `UnsupportedError` for what is valid and not read.
    """
    if source.piece(0, 4, "the DDS magic number") != MAGIC:
        raise source.wrong("it does not begin with the magic number of DDS")
    header = source.integers("31I", 4, "the DDS header")
    size, _, height, width, _, _, levels = header[:7]
    pixel_size, pixel_flags, fourcc = header[18:21]
    caps2 = header[27]
    if size != 124 or pixel_size != 32:
        raise source.wrong(f"its header and pixel format have {size} and {pixel_size} bytes, 124 and 32 are allowed")
    if caps2 & _CAPS2_VOLUME:
        raise UnsupportedError(f"{source.name} is a 3-D texture, 2-D ones and cubes are read")
    at, layers = 128, 1
    alpha: Literal["straight", "premultiplied", "none"] = "straight"
    if pixel_flags & _FOURCC and fourcc == _DX10:
        name, order, layers, cube, alpha = _newer(source, at)
        at = 148
    else:
        name, order = _older(source, pixel_flags, header[20:26])
        cube = bool(caps2 & _CAPS2_CUBE)
        if cube and caps2 & _CAPS2_FACES != _CAPS2_FACES:
            there = ", ".join(face for k, face in enumerate(_FACES) if caps2 & 0x400 << k) or "none"
            raise UnsupportedError(f"{source.name} is a cube with the faces {there} alone, cubes of six faces are read")
    notices = []
    if name.endswith("srgb") and at == 128:
        notices.append(f"{source.name}: states no transfer function, its 8-bit integers were decoded as sRGB")
    if alpha == "premultiplied":
        notices.append(f"{source.name}: its colours are multiplied with alpha, and were divided by it")
    levels = max(levels, 1)  # 0 where dwMipMapCount is not valid
    faces = 6 if cube else 1
    sizes = check_header(source, name, width, height, layers, faces, levels, packed=layers * faces > 1)
    if at + sum(sizes) != len(source):
        raise source.wrong(f"its header describes {at + sum(sizes)} bytes, the file has {len(source)}")
    images = layers * faces
    stride = sum(sizes) // images

    def unpack(k: int) -> Buffer:
        length = sizes[k] // images
        first = at + sum(sizes[:k]) // images
        parts = [source.piece(first + image * stride, length, f"level {k}") for image in range(images)]
        return parts[0] if images == 1 else b"".join(parts)

    return Texture(
        name,
        width,
        height,
        Levels(levels, unpack),
        0 if layers == 1 else layers,
        faces,
        meaning=Meaning(order=order, alpha=alpha),
        notices=tuple(notices),
    )


def _newer(source: Source, at: int) -> tuple[str, str, int, bool, Literal["straight", "premultiplied", "none"]]:
    """Return what the DX10 header states: pixel format, order of channels, layers, whether it is a cube, and alpha."""
    dxgi, dimension, misc, layers, misc2 = source.integers("5I", at, "the DX10 header")
    if dxgi not in _BY_DXGI:
        title = dxgi_name(dxgi)
        if title is None and dxgi < 116:
            raise source.wrong(f"its dxgiFormat is {dxgi}, which is not a format of a texture")
        raise UnsupportedError(
            f"{source.name} has the dxgiFormat {dxgi} ({title or 'unknown'}), which is not read; {', '.join(_DXGI)} are"
        )
    if dimension in _DIMENSIONS:
        raise UnsupportedError(f"{source.name} is a {_DIMENSIONS[dimension]} texture, 2-D ones and cubes are read")
    if dimension != _TEXTURE2D:
        raise source.wrong(f"its resourceDimension is {dimension}, 3 (2-D textures and cubes) is read")
    if layers < 1:
        raise source.wrong("its arraySize is 0, it must be at least 1")
    if misc2 & 7 >= len(_ALPHA_MODES):
        raise source.wrong(f"its alpha mode is {misc2 & 7}, 0 to {len(_ALPHA_MODES) - 1} are defined")
    name, order = _BY_DXGI[dxgi]
    four = FORMATS[name].channels == 4
    return name, order, layers, bool(misc & _MISC_CUBE), _ALPHA_MODES[misc2 & 7] if four else "straight"


def _older(source: Source, flags: int, pixel: tuple[int, ...]) -> tuple[str, str]:
    """Return the pixel format and the order of channels of a header without DX10.

    pixel: FourCC, bits of a texel and four masks. Raises `UnsupportedError` for a format that is not read.
    """
    fourcc, bits, *masks = pixel
    if flags & _FOURCC:
        if fourcc in _BY_FOURCC:
            return _BY_FOURCC[fourcc], STRAIGHT_ORDER
        text = struct.pack("<I", fourcc).decode("latin-1")
        title = _FOURCC_NAMES.get(fourcc, repr(text) if text.isprintable() else f"{fourcc:#010x}")
        read = ", ".join(f"{code} ({name})" for code, name in _BY_FOURCC.items())
        raise UnsupportedError(f"{source.name} has the FourCC {title}, which is not read; DX10 and {read} are")
    if flags & _RGB:
        key = (bits, *masks[:3], masks[3] if flags & _ALPHA_PIXELS else 0)
        if key in _BY_MASKS:
            return _BY_MASKS[key]
        shown = ", ".join(f"{mask:#x}" for mask in key[1:])
        raise UnsupportedError(
            f"{source.name} has integers of {bits} bits a texel with the masks {shown}, which are not read; 8-bit RGB, "
            "BGR, RGBA and BGRA are"
        )
    title = next((title for flag, title in _PIXEL_KINDS.items() if flags & flag), "")
    if not title:
        raise source.wrong(f"its pixel format has the flags {flags:#x}, which name no kind of texel")
    raise UnsupportedError(f"{source.name} holds {title}, which is not read; floats, BC6H and 8-bit RGB are")


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
