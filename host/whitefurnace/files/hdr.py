"""Writes Radiance .hdr (RGBE) images with every value rounded to the nearest code.

OpenImageIO's writer truncates, which darkens an image by half a step on average and by a whole step at worst.
"""

from __future__ import annotations

import os

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.packing import Packed

# A texel is m·2^(e-136) with three m of 8 bits and one e [Ward 1991, "Real Pixels", Graphics Gems II]; e = 0 is black.
# Ward's own reader adds ½ to m. The readers of OpenImageIO, stb_image, three.js and OpenCV do not, and the rounding
# here is the nearest for these.
_SHIFT = 136
LARGEST = float(np.ldexp(255.0, 255 - _SHIFT))
_LEAST_RUN, _MOST_RUN, _MOST_PLAIN = 4, 127, 128
_MAX_RUN_WIDTH = 32767
_AT_ONCE = 1 << 18


def write_hdr(path: str | os.PathLike[str], image: npt.ArrayLike, *, into: Transaction | None = None) -> Packed:
    """Write `image` (height, width, 3), linear Rec.709, top row first, run-length coded.

    The same image gives the same bytes. Each texel is rounded to the nearest code; its error is at most `step_hdr`,
    1/255 of its largest channel. Returns the codes, with counts of the values clipped to 1.7e38 and of the negative
    values set to 0. Raises `InputError` for NaN, and `FileError` where the file cannot be written.
    """
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise ValueError(f"an image of shape {array.shape} is not (height, width, 3)")
    packed = pack_hdr(array)
    write_pieces(path, hdr_pieces(packed.data), into)
    return packed


def hdr_pieces(codes: npt.NDArray[np.uint8]) -> list[bytes]:
    """Return the bytes of the file of `codes` (height, width, 4): the header, then one piece for each row."""
    height, width = codes.shape[:2]
    pieces = [f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode("ascii")]
    if not 8 <= width <= _MAX_RUN_WIDTH:  # rows of such a width have no runs
        return [*pieces, *(row.tobytes() for row in codes)]
    start = bytes((2, 2, width >> 8, width & 255))
    for row in codes:
        pieces.append(start + b"".join(_runs(np.ascontiguousarray(row[:, channel])) for channel in range(4)))
    return pieces


def pack_hdr(values: npt.ArrayLike) -> Packed:
    """Encode `values` (..., 3) as RGBE codes, uint8 (..., 4). Raises `InputError` for NaN."""
    array = np.asarray(values)
    if count := int(np.count_nonzero(np.isnan(array))):
        raise InputError(f"{count} NaN among the values for .hdr, values must be numbers")
    flat = array.reshape(-1, 3)
    data = np.empty((len(flat), 4), np.uint8)
    clipped = negative = 0
    for start in range(0, len(flat), _AT_ONCE):
        part = flat[start : start + _AT_ONCE].astype(np.float64)
        negative += int(np.count_nonzero(part < 0))
        clipped += int(np.count_nonzero(part >= LARGEST * (1 + 1 / 510)))  # half a step above the largest
        part = np.clip(part, 0, LARGEST)
        exponent = _exponents(part)
        data[start : start + len(part), :3] = np.rint(np.ldexp(part, _SHIFT - exponent))
        data[start : start + len(part), 3:] = exponent
    data[~data[:, :3].any(axis=1)] = 0
    return Packed(data.reshape(*array.shape[:-1], 4), clipped, negative)


def unpack_hdr(codes: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Decode RGBE codes (..., 4) to float32 (..., 3), without error."""
    mantissa, exponent = codes[..., :3].astype(np.float64), codes[..., 3:].astype(int)
    return np.where(exponent > 0, np.ldexp(mantissa, exponent - _SHIFT), 0).astype(np.float32)


def step_hdr(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return a bound of |read − value| for each of the finite `values` (..., 3).

    The bound is half a step of the texel's exponent; for a clipped value, the part above the largest code; for a
    negative value, its magnitude.
    """
    array = np.asarray(values, np.float64)
    half = np.ldexp(0.5, _exponents(np.clip(array, 0, LARGEST)) - _SHIFT)
    return np.where(array < 0, -array, np.maximum(half, array - LARGEST))


def _exponents(part: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return the exponents (..., 1): the least e from 1 to 255 for which no channel rounds to more than 255."""
    top = part.max(axis=-1, keepdims=True)
    exponent = np.where(top > 0, np.frexp(top)[1], -127) + 128
    exponent = np.maximum(exponent, 1)
    return exponent + (np.rint(np.ldexp(top, _SHIFT - exponent)) > 255).astype(np.int64)


def _runs(row: npt.NDArray[np.uint8]) -> bytes:
    """Run-length code one channel of one row: 128 + n and the byte for n equal bytes, n and the bytes for others."""
    borders = np.flatnonzero(np.diff(row)) + 1
    starts = np.concatenate([[0], borders])
    lengths = np.diff(np.concatenate([starts, [len(row)]]))
    long = lengths >= _LEAST_RUN
    data = row.tobytes()
    out = bytearray()
    at = 0
    for start, length in zip(starts[long].tolist(), lengths[long].tolist(), strict=True):
        _plain(out, data, at, start)
        for first in range(0, length, _MOST_RUN):
            out += bytes((128 + min(_MOST_RUN, length - first), data[start]))
        at = start + length
    _plain(out, data, at, len(data))
    return bytes(out)


def _plain(out: bytearray, data: bytes, start: int, end: int) -> None:
    for first in range(start, end, _MOST_PLAIN):
        piece = data[first : min(first + _MOST_PLAIN, end)]
        out.append(len(piece))
        out += piece
