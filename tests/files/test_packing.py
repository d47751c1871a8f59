"""Pixel formats against the formulas of their specifications, in exact fractions and by search over all codes."""

from __future__ import annotations

import math
import struct
from fractions import Fraction

import numpy as np
import pytest

from whitefurnace.errors import InputError, UnsupportedError
from whitefurnace.files import packing
from whitefurnace.files.packing import FORMATS, pack, step, unpack

CODED = [name for name, entry in FORMATS.items() if entry.block == 1]
FLOATS = {"b10g11r11": (6, 6, 5), "rgba16f": (10,) * 4}


def small_float(code: int, mantissa: int) -> Fraction:
    """The value of an unsigned float with 5 bits of exponent [GL 4.6 core, 2.3.4.2 to 2.3.4.4], finite ones."""
    exponent, fraction = divmod(code, 1 << mantissa)
    if exponent == 0:
        return Fraction(fraction, 1 << mantissa) / 2**14
    return (1 + Fraction(fraction, 1 << mantissa)) * Fraction(2) ** (exponent - 15)


def word(packed: packing.Packed) -> list[int]:
    return np.ascontiguousarray(packed.data).view("<u4").ravel().tolist()


def codes_of(name: str, packed: packing.Packed) -> np.ndarray:
    """The codes of each channel, (n, channels)."""
    if name == "rgba16f":
        return np.ascontiguousarray(packed.data).view("<u2").astype(int)
    words = np.array(word(packed))
    return np.stack([words & 2047, words >> 11 & 2047, words >> 22], axis=1)


def spread(rng: np.random.Generator, count: int, channels: int, low: float, high: float) -> np.ndarray:
    return np.exp2(rng.uniform(low, high, (count, channels)))


@pytest.mark.parametrize("name", FLOATS)
def test_every_code_has_the_value_of_the_specification_and_comes_back(name):
    for channel, mantissa in enumerate(FLOATS[name]):
        codes = np.arange(31 << mantissa)
        values = np.array([float(small_float(c, mantissa)) for c in codes.tolist()])  # exact in float64
        texels = np.zeros((len(codes), FORMATS[name].channels))
        texels[:, channel] = values
        packed = pack(name, texels)
        np.testing.assert_array_equal(codes_of(name, packed)[:, channel], codes)
        np.testing.assert_array_equal(unpack(name, packed.data, (len(codes),)), texels)
        assert packed.clipped == packed.negative == 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", FLOATS)
def test_floats_round_to_the_nearest_code_and_ties_to_the_even_one(name, dtype):
    for channel, mantissa in enumerate(FLOATS[name]):
        table = [small_float(c, mantissa) for c in range(31 << mantissa)]
        rng = np.random.default_rng(mantissa)
        lower = rng.integers(0, len(table) - 1, 500)
        middle = np.array([float((table[c] + table[c + 1]) / 2) for c in lower.tolist()])  # 12 bits: exact
        values = np.concatenate(
            [
                middle,
                np.nextafter(middle.astype(dtype), dtype(0)),
                np.nextafter(middle.astype(dtype), dtype(np.inf)),
                np.exp2(rng.uniform(-26, 15.99, 500)),
            ]
        ).astype(dtype)
        texels = np.zeros((len(values), FORMATS[name].channels), dtype)
        texels[:, channel] = values
        got = codes_of(name, pack(name, texels))[:, channel]
        floats = np.array([float(x) for x in table])
        for value, code in zip(values.tolist(), got.tolist(), strict=True):
            start = max(int(np.searchsorted(floats, value)) - 1, 0)
            near = range(start, min(start + 2, len(table)))
            distance = {c: abs(table[c] - Fraction(value)) for c in near}
            wanted = min(near, key=lambda c: (distance[c], c & 1))
            assert code == wanted, f"{name} channel {channel}: {value!r} became code {code}, {wanted} is nearer"


def test_half_agrees_with_the_half_of_the_standard_library():
    values = np.concatenate(
        [
            np.exp2(np.random.default_rng(0).uniform(-26, 15.99, 4000)),
            -np.exp2(np.linspace(-30, 15, 800)),
        ]
    )
    packed = pack("rg16f", values.reshape(-1, 2))
    assert packed.data.tobytes() == b"".join(struct.pack("<e", v) for v in values.tolist())


def shared_exponent(rgb: list[float]) -> int:
    """The encoder of GL 4.6 core, 8.5.2, in exact fractions."""
    bits, bias = 9, 15
    largest = Fraction(2**bits - 1, 2**bits) * 2 ** (31 - bias)
    clamped = [max(Fraction(0), min(largest, Fraction(c))) for c in rgb]
    top = max(clamped)
    log2 = -bias - 1
    while Fraction(2) ** (log2 + 1) <= top:
        log2 += 1
    exponent = log2 + 1 + bias
    if math.floor(top / Fraction(2) ** (exponent - bias - bits) + Fraction(1, 2)) == 2**bits:
        exponent += 1
    codes = [math.floor(c / Fraction(2) ** (exponent - bias - bits) + Fraction(1, 2)) for c in clamped]
    return codes[0] | codes[1] << 9 | codes[2] << 18 | exponent << 27


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shared_exponents_are_those_of_the_specification(dtype):
    rng = np.random.default_rng(3)
    texels = spread(rng, 3000, 3, -30, 16).astype(dtype)
    # Where the largest rounds up to the next exponent, ties, the ends and the smallest steps.
    texels = np.concatenate(
        [
            texels,
            np.array(
                [
                    [0, 0, 0],
                    [1, 1, 1],
                    [511.5 / 512, 0, 0],
                    [511.49 / 512, 0.25, 0],
                    [65408, 65408, 65408],
                    [65471, 1, 0],
                    [2.0**-24, 2.0**-25, 2.0**-26],
                    [2.0**-25, 0, 0],
                    [2.0**-15, 2.0**-16, 0],
                    [256.5, 128.25, 64.125],
                    [1e9, 2, 3],
                    [0.49999999999999994 * 2.0**-24, 0, 0],
                ],
                dtype,
            ),
        ]
    )
    packed = pack("rgb9e5", texels)
    for got, rgb in zip(word(packed), texels.tolist(), strict=True):
        assert got == shared_exponent(rgb), f"{rgb}: {got:#x} is not {shared_exponent(rgb):#x}"
    # 1 = 256·2^(16-15-9), by hand
    assert word(pack("rgb9e5", [1.0, 1.0, 1.0])) == [256 | 256 << 9 | 256 << 18 | 16 << 27]
    assert unpack("rgb9e5", pack("rgb9e5", [65408.0, 128.0, 64.0]).data, ()).tolist() == [65408.0, 128.0, 128.0]


def babylon(code: int, alpha: int) -> float:
    """fromRGBD of Babylon.js with its gamma of 2.2."""
    return (code / 255) ** 2.2 / (alpha / 255)


def test_rgbd_has_babylons_divisor_and_the_nearest_colour_it_reads():
    rng = np.random.default_rng(4)
    texels = np.concatenate([spread(rng, 400, 3, -20, 7.9), [[0, 0, 0], [1, 1, 1], [255, 1, 0], [1.0001, 0.5, 2]]])
    data = pack("rgbd", texels).data.astype(int)
    for rgb, (*codes, alpha) in zip(texels.tolist(), data.tolist(), strict=True):
        assert alpha == max(min(math.floor(255 / max(*rgb, 1e-7)), 255), 1), f"{rgb}: D is {alpha}/255"
        for value, code in zip(rgb, codes, strict=True):
            error = abs(babylon(code, alpha) - value)
            best = min(abs(babylon(c, alpha) - value) for c in range(256))
            # both by the same powers in float64, of a value up to 255
            assert error <= best + 1e-12, f"{value} of {rgb} became {code}, off by {error}; {best} is possible"
    read = unpack("rgbd", pack("rgbd", texels).data, (len(texels),))
    wanted = [[babylon(c, texel[3]) for c in texel[:3]] for texel in data.tolist()]
    np.testing.assert_allclose(read, wanted, rtol=1e-7)  # float32
    assert pack("rgbd", [255.0, 0.0, 0.0]).data.tolist() == [255, 0, 0, 1]


@pytest.mark.parametrize(
    "name, largest, over",
    [
        # `over` is half an ulp more than `largest`, from where on rounding to nearest gives inf [IEEE 754, 4.3.1]
        ("rg16f", 65504.0, 65520.0),
        ("rgb16f", 65504.0, 65520.0),
        ("rgba16f", 65504.0, 65520.0),
        ("rgba32f", float(np.finfo(np.float32).max), 2.0**128 - 2.0**103),
        ("rgb9e5", 65408.0, 65472.0),
    ],
)
def test_nothing_becomes_inf_and_what_is_clipped_is_counted(name, largest, over):
    channels = FORMATS[name].channels
    for value, count in ((largest, 0), (np.nextafter(over, 0), 0), (over, 1), (1e300, 1), (np.inf, 1)):
        texel = np.zeros(channels)
        texel[0] = value
        packed = pack(name, texel)
        assert packed.clipped == count, f"{name}: {value} was counted {packed.clipped} times"
        assert unpack(name, packed.data, ())[0] == np.float32(largest)
        if FORMATS[name].signed:
            packed = pack(name, -texel)
            assert packed.clipped == count and unpack(name, packed.data, ())[0] == -np.float32(largest)
    assert pack(name, np.full(channels, np.inf, np.float32)).clipped == channels


def test_small_floats_clip_at_each_channels_own_end():
    # half an ulp more than the largest: 65024 + 256 and 64512 + 512
    packed = pack("b10g11r11", [[65279.0, 65280.0, 65023.0], [np.inf, 1.0, 65024.0]])
    assert packed.clipped == 3
    assert unpack("b10g11r11", packed.data, (2,)).tolist() == [[65024, 65024, 64512], [65024, 1, 64512]]
    # the last step, 255·(1 - (254/255)^2.2), is 2.19: clipped from 256.1 on
    packed = pack("rgbd", [[300.0, 255.5, 0.0], [256.2, 256.0, np.inf]])
    assert packed.clipped == 3 and np.isfinite(unpack("rgbd", packed.data, (2,))).all()


@pytest.mark.parametrize("name", CODED)
def test_negatives_stay_or_become_0_and_are_counted(name):
    values = np.array([[-1.0, -0.0, 1.0, 0.5], [-np.inf, 0.25, -(2.0**-30), 0.5]])[:, : FORMATS[name].channels]
    packed = pack(name, values)
    read = unpack(name, packed.data, (2,))
    if FORMATS[name].signed:
        assert packed.negative == 0 and packed.clipped == 1 and read[0, 0] == -1
    else:
        below = int((values < 0).sum())
        assert packed.negative == below > 0 and packed.clipped == 0 and (read >= 0).all() and read[0, 0] == 0


@pytest.mark.parametrize("name", CODED)
def test_nan_is_refused_with_its_place(name, monkeypatch):
    monkeypatch.setattr(packing, "_AT_ONCE", 4)
    values = np.ones((2, 3, FORMATS[name].channels), np.float32)
    last = FORMATS[name].channels - 1
    values[1, 2, last] = np.nan
    with pytest.raises(InputError, match=rf"1 NaN among the values for .*, the first at index \(1, 2, {last}\)"):
        pack(name, values)


@pytest.mark.parametrize("name", [name for name, entry in FORMATS.items() if entry.kind != "float"])
def test_integers_are_the_fractions_of_the_specification_and_come_back(name):
    """c/(2^b - 1) [GL 4.6 core, 2.3.5.1], through the curve of sRGB for its colours [8.24], alpha without it."""
    entry = FORMATS[name]
    bits = 8 * entry.size // entry.channels
    codes = np.arange(1 << bits)
    linear = [Fraction(c, (1 << bits) - 1) for c in codes.tolist()]
    curved = [
        float(x / Fraction("12.92")) if x <= Fraction("0.04045") else ((float(x) + 0.055) / 1.055) ** 2.4
        for x in linear
    ]
    data = np.repeat(codes[:, None], entry.channels, 1).astype(f"<u{bits // 8}")
    read = unpack(name, data.view(np.uint8).ravel(), (len(codes),))
    for c in range(entry.channels):
        wanted = np.array(curved if entry.kind == "srgb" and c < 3 else [float(x) for x in linear])
        np.testing.assert_array_equal(read[:, c], wanted.astype(np.float32))
    packed = pack(name, read)
    assert packed.clipped == packed.negative == 0
    np.testing.assert_array_equal(np.ascontiguousarray(packed.data).view(data.dtype), data)
    above = pack(name, np.full((1, entry.channels), 1.5))
    assert above.clipped == entry.channels and (above.data == 255).all()


@pytest.mark.parametrize("name", CODED)
def test_the_step_bounds_the_error_and_no_smaller_one_does(name):
    rng = np.random.default_rng(5)
    entry = FORMATS[name]
    values = np.concatenate(
        [
            spread(rng, 20000, entry.channels, -30, 14),
            spread(rng, 200, entry.channels, 14, 20),
            np.zeros((1, entry.channels)),
        ]
    )
    if name == "rgbd":
        values /= 64  # most of it in range
    values[::7] *= -1
    packed = pack(name, values)
    error = np.abs(unpack(name, packed.data, (len(values),)).astype(np.float64) - values)
    bound = step(name, values)
    assert bound.shape == values.shape
    worst = np.argmax(error / bound)
    assert (error <= bound).all(), (
        f"{name}: {values.flat[worst]!r} is off by {error.flat[worst]!r}, more than {bound.flat[worst]!r}"
    )
    inside = (values >= 0) & (values < entry.largest)
    # 6e4 uniform places between two codes come nearer to the middle than 1/1000 of the way
    assert (error[inside] / bound[inside]).max() > 0.999


def test_a_missing_alpha_is_1_and_other_counts_of_channels_are_refused():
    assert unpack("rgba16f", pack("rgba16f", np.zeros((2, 3))).data, (2,)).tolist() == [[0, 0, 0, 1]] * 2
    for name, channels in (("rgb9e5", 4), ("rg16f", 3), ("rgba32f", 2), ("rgb16f", 1)):
        with pytest.raises(ValueError, match="channels"):
            pack(name, np.zeros((2, channels)))
    with pytest.raises(ValueError, match="texels"):
        unpack("rgba16f", bytes(7), (1,))


def test_parts_join_to_the_whole(monkeypatch):
    values = spread(np.random.default_rng(6), 50, 3, -5, 5).reshape(5, 10, 3)
    for name in ("rgba16f", "rgb9e5", "b10g11r11", "rgbd"):
        whole = pack(name, values)
        with monkeypatch.context() as context:
            context.setattr(packing, "_AT_ONCE", 7)
            parts = pack(name, values)
            read = unpack(name, parts.data, (5, 10))
        np.testing.assert_array_equal(parts.data, whole.data)
        np.testing.assert_array_equal(read, unpack(name, whole.data, (5, 10)))


def test_inf_and_nan_of_foreign_data_are_read_as_they_are():
    # 5 ones of exponent: inf with no mantissa, NaN with one [GL 4.6 core, 2.3.4.3]
    read = unpack("b10g11r11", struct.pack("<I", 31 << 6 | (31 << 6 | 1) << 11 | 31 << 27), ())
    assert read[0] == np.inf and np.isnan(read[1]) and read[2] == np.inf
    assert np.isinf(unpack("rgbd", bytes([255, 0, 255, 0]), ())[0])


def test_unknown_formats_and_blocks_are_named():
    with pytest.raises(UnsupportedError, match="did you mean 'rgb9e5'"):
        pack("rgb9e", [1, 1, 1])
    for action in (
        lambda: pack("bc6hu", [1, 1, 1]),
        lambda: unpack("bc6hu", bytes(16), (4, 4)),
        lambda: step("bc6hs", [1, 1, 1]),
    ):
        with pytest.raises(UnsupportedError, match="blocks"):
            action()
