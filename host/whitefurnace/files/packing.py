"""Encodes and decodes the pixel formats of GPU textures with numpy.

Values are rounded to the nearest code and never to inf. `step` bounds the error of the rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError, UnsupportedError, nearest

_AT_ONCE = 1 << 18
"""Number of texels converted at once, which bounds the memory of the float64 intermediates."""

Floats = npt.NDArray[np.float64]
Codes = npt.NDArray[Any]


@dataclass(frozen=True)
class Format:
    """A pixel format.

    channels  number of colour channels
    size      bytes of a texel, or of a block
    largest   the largest finite value (for `b10g11r11` of red and green)
    signed    whether negative values can be stored
    block     texels per side of a block; 1 where the format is not compressed
    kind      "float", or "whole" for integers that stand for 0 to 1, or "srgb" for those with the curve of sRGB
    """

    name: str
    title: str
    channels: int
    size: int
    largest: float
    signed: bool = False
    block: int = 1
    kind: str = "float"


def _number_formats() -> Iterator[Format]:
    """Yield the formats of one to four numbers of one type."""
    words = ("one", "two", "three", "four")
    for count, letters in enumerate(("r", "rg", "rgb", "rgba"), 1):
        many = f"{words[count - 1]} %s-bit %s{'s' if count > 1 else ''}"
        yield Format(f"{letters}16f", many % (16, "float"), count, 2 * count, 65504.0, signed=True)
        largest = float(np.finfo(np.float32).max)
        yield Format(f"{letters}32f", many % (32, "float"), count, 4 * count, largest, signed=True)
        for bits in (8, 16):
            title = f"{many % (bits, 'integer')} for 0 to 1"
            yield Format(f"{letters}{bits}", title, count, bits // 8 * count, 1.0, kind="whole")
    for count, letters in ((3, "rgb"), (4, "rgba")):
        title = f"{words[count - 1]} 8-bit integers, colours in sRGB"
        yield Format(f"{letters}8srgb", title, count, count, 1.0, kind="srgb")


FORMATS: Mapping[str, Format] = {
    entry.name: entry
    for entry in (
        *_number_formats(),
        # GL 4.6 core, 8.5.2: 511/512 · 2^(31-15)
        Format("rgb9e5", "9-bit mantissas with one 5-bit exponent", 3, 4, 65408.0),
        # GL 4.6 core, 2.3.4.3 and 2.3.4.4: (1 + 63/64)·2^15; blue, of 10 bits, ends at (1 + 31/32)·2^15 = 64512
        Format("b10g11r11", "unsigned floats of 11, 11 and 10 bits", 3, 4, 65024.0),
        Format("rgbd", "8-bit colour · D with D in alpha, of Babylon.js", 3, 4, 255.0),
        # Formats of blocks are encoded elsewhere: BC6H in bc6h.py, ASTC in astc.py.
        Format("bc6hu", "BC6H blocks, unsigned", 3, 16, 65504.0, block=4),
        Format("bc6hs", "BC6H blocks, signed", 3, 16, 65504.0, signed=True, block=4),
        Format("astc4x4hdr", "ASTC blocks of 4 x 4 texels, HDR", 4, 16, 65504.0, signed=True, block=4),
    )
}


@dataclass(frozen=True)
class Packed:
    """Encoded texels.

    `data` is uint8 (..., bytes of a texel), little-endian. `clipped` counts the values that were too large and became
    the largest finite one; `negative` counts the values below 0 that became 0 because the format has no sign.
    """

    data: npt.NDArray[np.uint8]
    clipped: int
    negative: int


def format_named(name: str) -> Format:
    """Return the pixel format called `name`. Raises `UnsupportedError`, which suggests the nearest name."""
    try:
        return FORMATS[name]
    except KeyError:
        raise UnsupportedError(f"there is no pixel format {name!r}{nearest(name, FORMATS)}") from None


def pack(name: str, values: npt.ArrayLike) -> Packed:
    """Encode `values` (..., channels) in the format `name`, each rounded to the nearest code.

    Ties go to the even code; those of rgb9e5 go up, as its specification requires. A missing fourth channel is 1. A
    value that would round to inf becomes the largest finite one; a value below 0 becomes 0 where the format has no
    sign. Both are counted. Raises `InputError` for NaN, and `UnsupportedError` for a format of blocks.
    """
    kind = _coded(name)
    array = _floats(values)
    given = array.shape[-1] if array.ndim else 0
    if given != kind.channels and (given, kind.channels) != (3, 4):
        raise ValueError(f"values of shape {array.shape} do not have the {kind.channels} channels of {name}")
    flat = array.reshape(-1, given)
    data = np.empty((len(flat), kind.size), np.uint8)
    clipped = negative = 0
    for start in range(0, len(flat), _AT_ONCE):
        part = flat[start : start + _AT_ONCE]
        wrong = np.isnan(part)
        if wrong.any():
            texel, channel = np.argwhere(wrong)[0]
            place = (*np.unravel_index(start + int(texel), array.shape[:-1]), channel)
            raise InputError(
                f"{int(wrong.sum())} NaN among the values for {name}, the first at index "
                f"{tuple(map(int, place))}: values must be numbers"
            )
        if not kind.signed:
            below = part < 0
            if count := int(np.count_nonzero(below)):
                negative += count
                part = np.where(below, 0, part)
        if given < kind.channels:
            part = np.concatenate([part, np.ones_like(part[:, :1])], axis=1)
        codes, over = _ENCODERS[name](part)
        clipped += over
        data[start : start + len(part)] = np.ascontiguousarray(codes).view(np.uint8).reshape(len(part), kind.size)
    return Packed(data.reshape(*array.shape[:-1], kind.size), clipped, negative)


def unpack(
    name: str, data: bytes | memoryview | npt.NDArray[np.uint8], shape: tuple[int, ...]
) -> npt.NDArray[np.float32]:
    """Decode `data` as a GPU does, to float32 (*shape, channels).

    The result is exact, except for rgbd (½ ulp). Inf and NaN in the data are kept. Raises `UnsupportedError` for a
    format of blocks.
    """
    kind = _coded(name)
    raw = np.frombuffer(data, np.uint8)
    count = math.prod(shape)
    if raw.size != count * kind.size:
        raise ValueError(f"{raw.size} bytes are not {shape} texels of {name}")
    out = np.empty((count, kind.channels), np.float32)
    raw = raw.reshape(count, kind.size)
    for start in range(0, count, _AT_ONCE):
        out[start : start + _AT_ONCE] = _DECODERS[name](raw[start : start + _AT_ONCE])
    return out.reshape(*shape, kind.channels)


def step(name: str, values: npt.ArrayLike) -> Floats:
    """Return a bound of |unpack(pack(v)) − v| for each of `values` (..., channels), float64 of the same shape.

    The bound is half the distance of the two codes around the value, which for rgb9e5 and rgbd depends on the largest
    channel of the texel; for a clipped value it is the part above the largest code.
    """
    kind = _coded(name)
    array = np.asarray(values, np.float64)
    if not array.ndim or array.shape[-1] > kind.channels:
        raise ValueError(f"values of shape {array.shape} do not have the {kind.channels} channels of {name}")
    positive = np.abs(array) if kind.signed else np.maximum(array, 0)
    half, largest = _STEPS[name](positive)
    bound: Floats = np.maximum(half, positive - largest)
    return bound if kind.signed else np.where(array < 0, -array, bound)


def _coded(name: str) -> Format:
    """Return a format that is encoded texel by texel. Raises `UnsupportedError` for a format of blocks."""
    kind = format_named(name)
    if kind.block > 1:
        raise UnsupportedError(f"{name} ({kind.title}) has blocks, which are not packed texel by texel")
    return kind


def _floats(values: npt.ArrayLike) -> npt.NDArray[Any]:
    """Return the values as float32 or float64, so that nothing is rounded before the encoding."""
    array = np.asarray(values)
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


# --- floats of the processor -----------------------------------------------------------------------------


def _encode_float(dtype: str, values: npt.NDArray[Any]) -> tuple[Codes, int]:
    largest, overflow = _ends(dtype)
    # For float32 values in float32, only inf is too large.
    over = np.isinf(values) if overflow > float(np.finfo(values.dtype).max) else np.abs(values) >= overflow
    count = int(np.count_nonzero(over))
    if count:
        values = np.where(over, np.copysign(largest, values), values)
    # numpy rounds float32 and float64 in one step, ties to even; a warning near the overflow is not needed.
    with np.errstate(over="ignore"):
        return values.astype(dtype), count


@cache
def _ends(dtype: str) -> tuple[float, float]:
    """Return the largest finite value, and the value from which rounding to nearest gives inf, half an ulp above."""
    info = np.finfo(dtype)
    largest = float(info.max)
    return largest, largest + 2.0 ** (info.maxexp - 2 - info.nmant)


def _decode_float(dtype: str, raw: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    return np.ascontiguousarray(raw).view(dtype).astype(np.float32)


def _half_ulp(values: Floats, mantissa: int, smallest_exponent: int, largest: float) -> Floats:
    """Return half an ulp of floats with `mantissa` bits at `values` >= 0; above `largest`, that of the last binade."""
    exponent = np.frexp(np.minimum(values, largest))[1] - 1  # frexp's fraction is in [½, 1)
    exponent = np.where(values > 0, np.maximum(exponent, smallest_exponent), smallest_exponent)
    return np.ldexp(1.0, exponent - mantissa - 1)


def _step_float(dtype: str, values: Floats) -> tuple[Floats, float]:
    info = np.finfo(dtype)
    largest = float(info.max)
    return _half_ulp(values, info.nmant, int(info.minexp), largest), largest


# --- unsigned floats of 11 and 10 bits [GL 4.6 core, 2.3.4.3 and 2.3.4.4] ----------------------------------

_MANTISSAS = (6, 6, 5)
_SHIFTS = (0, 11, 22)


def _small_largest(mantissa: int) -> float:
    return (2.0 - 2.0**-mantissa) * 2.0**15


def _encode_small(values: npt.NDArray[Any]) -> tuple[Codes, int]:
    """Encode R11G11B10F.

    Write x = q·2^(e-m) with e = max(⌊log2 x⌋, -14) and an integer q below 2^(m+1). The code is (e+14)·2^m + q: the
    leading 1 of q increments the exponent. This holds for denormals (e = -14, q < 2^m) and for a q that is rounded up
    to 2^(m+1) too.
    """
    word = np.zeros(len(values), np.uint32)
    clipped = 0
    for channel, (mantissa, shift) in enumerate(zip(_MANTISSAS, _SHIFTS, strict=True)):
        x = values[:, channel].astype(np.float64)
        overflow = _small_largest(mantissa) + 2.0 ** (14 - mantissa)  # half an ulp above; this tie rounds to inf
        over = x >= overflow
        clipped += int(np.count_nonzero(over))
        x = np.where(over, _small_largest(mantissa), x)
        exponent = np.maximum(np.frexp(x)[1] - 1, -14)
        exponent = np.where(x > 0, exponent, -14)
        code = ((exponent + 14) << mantissa) + np.rint(np.ldexp(x, mantissa - exponent)).astype(np.int64)
        word |= code.astype(np.uint32) << np.uint32(shift)
    return word.astype("<u4"), clipped


def _decode_small(raw: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    word = np.ascontiguousarray(raw).view("<u4")[:, 0]
    return np.stack(
        [
            _small_table(mantissa)[(word >> np.uint32(shift)) & np.uint32((32 << mantissa) - 1)]
            for mantissa, shift in zip(_MANTISSAS, _SHIFTS, strict=True)
        ],
        axis=1,
    )


@cache
def _small_table(mantissa: int) -> npt.NDArray[np.float32]:
    """Return the value of every code, float32 (2^(5+mantissa),)."""
    code = np.arange(32 << mantissa)
    exponent, fraction = code >> mantissa, code & ((1 << mantissa) - 1)
    value = np.where(
        exponent > 0, np.ldexp(1 + fraction / (1 << mantissa), exponent - 15), np.ldexp(fraction / (1 << mantissa), -14)
    )
    value = np.where(exponent < 31, value, np.where(fraction > 0, np.nan, np.inf))
    return value.astype(np.float32)


def _step_small(values: Floats) -> tuple[Floats, Floats]:
    mantissas = np.array(_MANTISSAS[: values.shape[-1]])
    largest = np.array([_small_largest(m) for m in mantissas.tolist()])
    halves = [_half_ulp(values[..., c], m, -14, _small_largest(m)) for c, m in enumerate(mantissas.tolist())]
    return np.stack(halves, axis=-1), largest


# --- shared exponent [GL 4.6 core, 8.5.2; EXT_texture_shared_exponent] --------------------------------------

_SHARED_BITS, _SHARED_BIAS = 9, 15
_SHARED_LARGEST = 65408.0


def _round_up_at_half(x: Floats) -> Floats:
    """Return ⌊x + ½⌋ without the rounding error of that sum."""
    whole = np.floor(x)
    return whole + (x - whole >= 0.5)


def _shared_exponent(top: Floats) -> npt.NDArray[np.int64]:
    """Return the biased exponent, exp_shared of 8.5.2, of texels whose largest channel is `top` in [0, 65408]."""
    log2 = np.where(top > 0, np.frexp(top)[1] - 1, -_SHARED_BIAS - 1)
    shared = np.maximum(log2, -_SHARED_BIAS - 1) + 1 + _SHARED_BIAS
    top_code = _round_up_at_half(np.ldexp(top, _SHARED_BIAS + _SHARED_BITS - shared))
    return (shared + (top_code == 1 << _SHARED_BITS)).astype(np.int64)


def _encode_shared(values: npt.NDArray[Any]) -> tuple[Codes, int]:
    x = values.astype(np.float64)
    clipped = int(np.count_nonzero(x >= _SHARED_LARGEST + 64))  # half a step of 2^(31-15-9) above
    x = np.minimum(x, _SHARED_LARGEST)
    shared = _shared_exponent(x.max(axis=1))
    code = _round_up_at_half(np.ldexp(x, (_SHARED_BIAS + _SHARED_BITS - shared)[:, None])).astype(np.uint32)
    word = code[:, 0] | code[:, 1] << np.uint32(9) | code[:, 2] << np.uint32(18)
    return (word | shared.astype(np.uint32) << np.uint32(27)).astype("<u4"), clipped


def _decode_shared(raw: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    word = np.ascontiguousarray(raw).view("<u4").astype(np.int64)
    code = (word >> np.array([0, 9, 18])) & 511
    return np.ldexp(code.astype(np.float32), (word >> 27) - _SHARED_BIAS - _SHARED_BITS).astype(np.float32)


def _step_shared(values: Floats) -> tuple[Floats, float]:
    shared = _shared_exponent(np.minimum(values, _SHARED_LARGEST).max(axis=-1, keepdims=True))
    half = np.ldexp(0.5, shared - _SHARED_BIAS - _SHARED_BITS)
    return np.broadcast_to(half, values.shape).astype(np.float64), _SHARED_LARGEST


# --- RGBD of Babylon.js (helperFunctions: toRGBD and fromRGBD, gamma 2.2, range 255) ------------------------


@cache
def _gamma_table() -> Floats:
    return (np.arange(256) / 255.0) ** 2.2


def _divisor(values: Floats) -> Floats:
    """Return 255·D = ⌊255 / the largest channel⌋, in [1, 255], (..., 1)."""
    top = np.maximum(values.max(axis=-1, keepdims=True), 1.0)
    return np.clip(np.floor(255.0 / top), 1.0, 255.0)


def _code_below(scaled: Floats) -> npt.NDArray[np.int64]:
    """Return the code k in [0, 254] with (k/255)^2.2 <= scaled < ((k+1)/255)^2.2."""
    return np.clip(np.searchsorted(_gamma_table(), scaled, side="right") - 1, 0, 254)


def _encode_rgbd(values: npt.NDArray[Any]) -> tuple[Codes, int]:
    """Encode RGBD. The codes are the nearest in decoded values; the gamma curve makes these differ from code values."""
    x = values.astype(np.float64)
    divisor = _divisor(x)
    scaled = x * (divisor / 255.0)
    table = _gamma_table()
    clipped = int(np.count_nonzero(scaled > 1.0 + (table[255] - table[254]) / 2))
    code = _code_below(scaled)
    excess = np.minimum(scaled, 1.0) - table[code] - (table[code + 1] - np.minimum(scaled, 1.0))
    code = code + ((excess > 0) | ((excess == 0) & (code & 1 == 1)))
    return np.concatenate([code, divisor.astype(np.int64)], axis=1).astype(np.uint8), clipped


def _decode_rgbd(raw: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    with np.errstate(divide="ignore", invalid="ignore"):  # D = 0 gives inf in the shader too
        return (_gamma_table()[raw[:, :3]] * 255.0 / raw[:, 3:]).astype(np.float32)


def _step_rgbd(values: Floats) -> tuple[Floats, Floats]:
    divisor = _divisor(values)
    scale = 255.0 / divisor
    table = _gamma_table()
    code = _code_below(values / scale)
    half = (table[code + 1] - table[code]) / 2 * scale
    # The second term is the rounding of the decoded float32, and of the powers in float64.
    return half + np.spacing(np.float32(255.0)) * values / 255.0, np.broadcast_to(scale, values.shape)


# --- integers for 0 to 1 [GL 4.6 core, 2.3.5], with the curve of sRGB [8.24] or without ---------------------


@cache
def _whole_table(bits: int, srgb: bool) -> Floats:
    """Return the value of every code, rising."""
    codes = np.arange(1 << bits) / ((1 << bits) - 1.0)
    if not srgb:
        return codes
    return np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)


def _curves(channels: int, bits: int, srgb: bool) -> list[Floats]:
    """Return the table of each channel; alpha has no curve."""
    return [_whole_table(bits, srgb and c < 3) for c in range(channels)]


def _encode_whole(bits: int, srgb: bool, values: npt.NDArray[Any]) -> tuple[Codes, int]:
    """Encode integers; the codes are the nearest in decoded values, ties go to the even one."""
    codes = np.empty(values.shape, f"<u{bits // 8}")
    clipped = 0
    for c, table in enumerate(_curves(values.shape[1], bits, srgb)):
        x = values[:, c].astype(np.float64)
        clipped += int(np.count_nonzero(x >= 1.0 + (table[-1] - table[-2]) / 2))
        x = np.minimum(x, 1.0)
        below = np.clip(np.searchsorted(table, x, side="right") - 1, 0, len(table) - 2)
        excess = (x - table[below]) - (table[below + 1] - x)
        codes[:, c] = below + ((excess > 0) | ((excess == 0) & (below & 1 == 1)))
    return codes, clipped


def _decode_whole(bits: int, srgb: bool, raw: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    codes = np.ascontiguousarray(raw).view(f"<u{bits // 8}")
    tables = _curves(codes.shape[1], bits, srgb)
    return np.stack([table.astype(np.float32)[codes[:, c]] for c, table in enumerate(tables)], axis=1)


def _step_whole(bits: int, srgb: bool, values: Floats) -> tuple[Floats, float]:
    halves = []
    for c, table in enumerate(_curves(values.shape[-1], bits, srgb)):
        below = np.clip(np.searchsorted(table, values[..., c], side="right") - 1, 0, len(table) - 2)
        halves.append((table[below + 1] - table[below]) / 2)
    # The second term is the rounding of the decoded float32.
    return np.stack(halves, axis=-1) + np.spacing(np.float32(1.0)) / 2 * np.minimum(values, 1.0), 1.0


def _whole(bits: int, srgb: bool = False) -> tuple[Callable[[Any], Any], Callable[[Any], Any], Callable[[Any], Any]]:
    return (
        lambda v: _encode_whole(bits, srgb, v),
        lambda raw: _decode_whole(bits, srgb, raw),
        lambda v: _step_whole(bits, srgb, v),
    )


def _float(dtype: str) -> tuple[Callable[[Any], Any], Callable[[Any], Any], Callable[[Any], Any]]:
    return (lambda v: _encode_float(dtype, v), lambda raw: _decode_float(dtype, raw), lambda v: _step_float(dtype, v))


_TYPES = {"16f": _float("<f2"), "32f": _float("<f4"), "8": _whole(8), "16": _whole(16), "8srgb": _whole(8, True)}
_CODECS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any], Callable[[Any], Any]]] = {
    **{entry.name: _TYPES[entry.name.lstrip("rgba")] for entry in _number_formats()},
    "rgb9e5": (_encode_shared, _decode_shared, _step_shared),
    "b10g11r11": (_encode_small, _decode_small, _step_small),
    "rgbd": (_encode_rgbd, _decode_rgbd, _step_rgbd),
}
_ENCODERS = {name: codec[0] for name, codec in _CODECS.items()}
_DECODERS = {name: codec[1] for name, codec in _CODECS.items()}
_STEPS = {name: codec[2] for name, codec in _CODECS.items()}
