"""Encodes and decodes cube faces as Babylon.js stores them in `.env` and glTF: RGBD in PNG, rows from the bottom up."""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

from whitefurnace.files.binary import Source
from whitefurnace.files.packing import pack, unpack
from whitefurnace.files.png import SIGNATURE, decode_by_oiio, decode_png, encode_png

Level = npt.NDArray[np.float32]
MAX_SIZE = 8192
"""Largest side of a face: all mips of such a cube, as floats, stay below the 8 GiB that a texture may have."""


def check_chain(levels: tuple[Level, ...], whole: bool) -> str:
    """Return the error in the levels of a cube as the end of a sentence; an empty text where there is none.

    whole: whether the chain must go down to one texel.
    """
    if not levels:
        return "there is no level"
    size = levels[0].shape[1] if levels[0].ndim == 4 else 0
    if size < 1 or size & (size - 1) or size > MAX_SIZE:
        return f"level 0 of shape {levels[0].shape} is not (6, n, n, 3), n a power of two up to {MAX_SIZE}"
    for k, level in enumerate(levels):
        if level.shape != (6, size >> k, size >> k, 3) or size >> k < 1:
            return f"level {k} of shape {level.shape} is not {(6, size >> k, size >> k, 3)}, half of the one before"
    if whole and len(levels) != size.bit_length():
        return f"there are {len(levels)} levels, all {size.bit_length()} down to one texel are needed"
    return ""


def encode_faces(level: npt.ArrayLike) -> tuple[list[bytes], int, int]:
    """Encode a level (6, n, n, 3) as six PNG.

    Returns the PNG, the number of values clipped to 255, and the number of negative values set to 0. Raises
    `InputError` for NaN.
    """
    packed = pack("rgbd", level)
    return [encode_png(face[::-1]) for face in packed.data], packed.clipped, packed.negative


def decode_face(source: Source, side: int) -> Level:
    """Decode a face to (side, side, 3) as the engine does.

    An image with alpha holds RGBD. An image without (some PNG, all JPEG) holds colours up to 1 with a gamma of 2.2.
    Raises `InputError`.
    """
    head = bytes(source.view[:12])
    if head.startswith(SIGNATURE):
        codes = decode_png(source, side=side)
    elif head.startswith(b"RIFF") and head[8:] == b"WEBP":
        codes = _other("webp", source, _webp_size(source), side)
    elif head.startswith(b"\xff\xd8\xff"):
        codes = _other("jpeg", source, _jpeg_size(source), side)
    else:
        raise source.wrong("it is not an image in a format that is read: PNG, WebP or JPEG")
    if codes.shape[2] == 3:
        codes = np.concatenate([codes, np.full_like(codes[..., :1], 255)], axis=2)
    return unpack("rgbd", np.ascontiguousarray(codes[::-1]), (side, side))


def _other(form: str, source: Source, size: tuple[int, int], side: int) -> npt.NDArray[np.uint8]:
    """Decode a WebP or JPEG whose header states `size`.

    OpenImageIO allocates what the header states, so the size is compared with `side` before.
    """
    if size != (side, side):
        raise source.wrong(f"it has {size[0]} x {size[1]} pixels, {side} x {side} were expected")
    codes = decode_by_oiio(bytes(source.view), form, source)
    if codes.shape[:2] != (side, side) or codes.shape[2] not in (3, 4):
        raise source.wrong(f"its pixels have the shape {codes.shape}, {side} x {side} of 3 or 4 channels were expected")
    return codes


def _webp_size(source: Source) -> tuple[int, int]:
    """Return the width and height in the first chunk of a WebP [RFC 9649, 2.5 to 2.7]."""
    kind = bytes(source.piece(12, 4, "the first chunk of a WebP"))
    body = bytes(source.piece(20, 10, "the header of a WebP"))
    if kind == b"VP8X":
        return 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
    if kind == b"VP8L" and body[0] == 0x2F:
        bits = int.from_bytes(body[1:5], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 " and body[3:6] == b"\x9d\x01\x2a":
        width, height = struct.unpack("<2H", body[6:10])
        return width & 0x3FFF, height & 0x3FFF
    raise source.wrong("its first chunk is not one of an image in WebP")


def _jpeg_size(source: Source) -> tuple[int, int]:
    """Return the width and height in the frame header of a JPEG [ITU T.81, B.2.2]."""
    at = 2
    while True:
        mark, kind = source.piece(at, 2, f"the JPEG marker at byte {at}")
        if mark != 0xFF:
            raise source.wrong(f"there is no JPEG marker at byte {at}")
        if kind == 0xFF:  # a fill byte
            at += 1
            continue
        (length,) = struct.unpack(">H", source.piece(at + 2, 2, f"the JPEG segment at byte {at}"))
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">2H", source.piece(at + 5, 4, "the frame header of a JPEG"))
            return width, height
        if kind == 0xDA or length < 2:
            raise source.wrong("it is a JPEG without a frame header")
        at += 2 + length
