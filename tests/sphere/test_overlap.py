"""Level 0, the mean of the source over each texel: the kernels against iterated integrals and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering.convolution import Convolver, Shape
from whitefurnace.sphere.environments import cube_solid_angles, environment, latlong_solid_angles
from whitefurnace.sphere.overlap import mean_over_texels

SUN = 1e6
CUBE_FACES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


def means(device: Device, texels: np.ndarray, shape: Shape, rotate: float = 0.0) -> np.ndarray:
    """(count, 3) float64 in the units of `texels`."""
    convolver = Convolver(device, environment(texels, rotate=rotate))
    return convolver.means(shape).reshape(-1, 3).astype(np.float64) / convolver.scale


def truth(texels: np.ndarray, shape: Shape, rotate: float, index: np.ndarray | None = None) -> np.ndarray:
    index = np.arange(shape.count) if index is None else index
    return mean_over_texels(texels, math.radians(rotate), shape.latlong, shape.size, index)


def random_texels(shape: tuple[int, ...], sun: tuple[int, ...] | None = None) -> np.ndarray:
    texels = np.random.default_rng(list(shape)).random((*shape, 3), np.float32) + np.float32(0.01)
    if sun is not None:
        texels[sun] = SUN
    return texels


def chosen(shape: Shape, count: int = 400) -> np.ndarray:
    return np.random.default_rng(7).choice(shape.count, min(count, shape.count), replace=False)


def assert_means(got: np.ndarray, want: np.ndarray, tolerance: float, context: object) -> None:
    error = np.abs(got - want) / want
    worst = np.unravel_index(np.argmax(error), error.shape)
    assert np.isfinite(got).all() and error.max() <= tolerance, (
        f"{context}: texel {worst}, got {got[worst]}, wanted {want[worst]}, error {error.max():.2e} > {tolerance:g}"
    )


# A level is stored as float32: half an ulp, 6e-8. A clipped polygon's area is right to 1e-15 of a texel's, or 1e-14 for
# the smaller ones here, and a sun SUN times brighter may lie beside it: 1e-14 SUN on radiance from .01 up is 1e-6, and
# 10 times that is allowed. (Lists of overlaps hold float32's half ulp there too: test_means.py.)
BESIDE_SUN = 1e-5


@pytest.mark.parametrize("rotate", [0.0, 37.0, 90.0, -133.7])
@pytest.mark.parametrize(
    "source, sun",
    [
        ((1, 2), None),
        ((3, 6), (0, 1)),
        ((17, 34), (3, 20)),
        ((64, 128), (16, 48)),
        ((64, 128), (0, 5)),
        ((64, 128), (63, 127)),
        ((128, 256), (45, 32)),
    ],
    ids=str,
)
def test_latlong_source_on_cubes(
    device: Device, source: tuple[int, int], sun: tuple[int, int] | None, rotate: float
) -> None:
    texels = random_texels(source, sun)
    for size in (1, 2, 4, 16, 64):
        index = chosen(Shape(False, size))
        assert_means(
            means(device, texels, Shape(False, size), rotate)[index],
            truth(texels, Shape(False, size), rotate, index),
            BESIDE_SUN,
            (source, size, rotate),
        )


@pytest.mark.parametrize("rotate", [0.0, 37.0])
@pytest.mark.parametrize("source", [(1, 2), (3, 6), (17, 34), (64, 128)], ids=str)
def test_latlong_source_on_latlongs(device: Device, source: tuple[int, int], rotate: float) -> None:
    texels = random_texels(source, (source[0] // 3, source[1] // 2))
    for size in (1, 2, 8, 64):
        index = chosen(Shape(True, size))
        assert_means(
            means(device, texels, Shape(True, size), rotate)[index],
            truth(texels, Shape(True, size), rotate, index),
            BESIDE_SUN,
            (source, size, rotate),
        )


@pytest.mark.parametrize("rotate", [0.0, 37.0, 90.0])
@pytest.mark.parametrize("size", [1, 2, 5, 16])
def test_cube_source_on_cubes(device: Device, size: int, rotate: float) -> None:
    texels = random_texels((6, size, size), (2, size // 2, size // 2) if size > 1 else None)
    for out in (1, 2, 8, 64):
        index = chosen(Shape(False, out))
        assert_means(
            means(device, texels, Shape(False, out), rotate)[index],
            truth(texels, Shape(False, out), rotate, index),
            BESIDE_SUN,
            (size, out, rotate),
        )


@pytest.mark.parametrize("rotate", [0.0, 37.0])
@pytest.mark.parametrize("size", [1, 5, 16])
def test_cube_source_on_latlongs(device: Device, size: int, rotate: float) -> None:
    """Radiance within a factor of 3: chords in the place of parallels move light between neighbours only."""
    texels = random_texels((6, size, size)) + np.float32(0.5)
    for out in (2, 8, 64):
        index = chosen(Shape(True, out))
        # Chords of Δφ/16 cut (Δφ/16)²/12 off a polar texel: 5e-5 at 8 rows, and 1e-5 of the height elsewhere.
        assert_means(
            means(device, texels, Shape(True, out), rotate)[index],
            truth(texels, Shape(True, out), rotate, index),
            1e-4,
            (size, out, rotate),
        )


@pytest.mark.long
def test_large(device: Device) -> None:
    texels = random_texels((512, 1024), (100, 300))
    shape = Shape(False, 256)
    index = chosen(shape, 4000)
    assert_means(means(device, texels, shape, 12.3)[index], truth(texels, shape, 12.3, index), BESIDE_SUN, "512 -> 256")


# ---------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("source", [(1, 1), (17, 34), (6, 5, 5), (6, 1, 1)], ids=str)
@pytest.mark.parametrize(
    "shape", [Shape(False, 1), Shape(False, 16), Shape(False, 64), Shape(True, 2), Shape(True, 32)], ids=str
)
def test_constant(device: Device, source: tuple[int, ...], shape: Shape) -> None:
    texels = np.full((*source, 3), 1, np.float32)
    # Nothing but float32 storage and sums over areas that cancel to 1e-13.
    assert np.abs(means(device, texels, shape, 11.0) - 1).max() <= 1e-6


@pytest.mark.parametrize("source", [(17, 34), (64, 128), (6, 9, 9)], ids=str)
@pytest.mark.parametrize("size", [1, 8, 64])
def test_energy_is_kept(device: Device, source: tuple[int, ...], size: int) -> None:
    texels = random_texels(source, (0,) * (len(source) - 1) + (3,))
    omega = (
        np.repeat(latlong_solid_angles(*source)[:, None], source[1], 1)
        if len(source) == 2
        else np.broadcast_to(cube_solid_angles(source[1]), source)
    )
    shape = Shape(False, size)
    have = shape.solid_angles() @ means(device, texels, shape, 20.0)
    want = np.tensordot(omega, texels.astype(np.float64), omega.ndim)
    # The issue allows 1e-5; rounding of each texel to float32 leaves 6e-8.
    assert np.abs(have / want - 1).max() <= 1e-7


@pytest.mark.parametrize("latlong", [True, False])
def test_one_bright_texel_is_shared_out_whole(device: Device, latlong: bool) -> None:
    """One texel among black: its output texels sum to its energy and all others are black."""
    texels = np.zeros((32, 64, 3) if latlong else (6, 16, 16, 3), np.float32)
    texels[(9, 22) if latlong else (0, 3, 15)] = (1, 2, 4)
    omega = latlong_solid_angles(32, 64)[9] if latlong else cube_solid_angles(16)[3, 15]
    shape = Shape(False, 32)
    level = means(device, texels, shape, 5.0)
    energy = shape.solid_angles() @ level
    assert np.abs(energy / (omega * np.array([1, 2, 4])) - 1).max() <= 1e-7  # float32 storage
    # A texel of 5.6° holds at most (5.6/2.8 + 2)² output texels, here 1.4 times that by its slant.
    assert 1 <= np.count_nonzero(level[:, 0]) <= 32
    assert level.max() <= 4 * (1 + 1e-6) and level.min() >= 0


def cap_texel(size: int, face: int, s: float, t: float) -> int:
    i, j = (min(int((v + 1) / 2 * size), size - 1) for v in (t, s))
    return (face * size + i) * size + j


@pytest.mark.parametrize("size", [1, 4, 64, 256])
def test_suns_on_the_seams(device: Device, size: int) -> None:
    """A lat-long texel centred on a face's edge, and a polar cap: symmetric faces get equal shares."""
    texels = np.full((32, 64, 3), 1, np.float32)
    texels[15:17, 36] = SUN  # across the equator, turned onto azimuth 45°
    level = means(device, texels, Shape(False, size), 45.0 - (36.5 / 64 * 360 - 180)).reshape(6, size, size, 3)
    # +X's left half meets +Z's right half there: mirror images, equal but for rounding (float32 storage, and
    # edges at 1e-14 of a texel beside SUN).
    assert np.allclose(level[0], level[4, :, ::-1], rtol=BESIDE_SUN, atol=0)

    texels[...] = 1
    texels[0] = SUN  # the northern cap, round about +Y
    level = means(device, texels, Shape(False, size)).reshape(6, size, size, 3)
    assert np.allclose(level[2], np.rot90(level[2]), rtol=BESIDE_SUN, atol=0)
    share = Shape(False, size).solid_angles().reshape(6, -1)[2] @ (level[2, ..., 0].ravel() - 1)
    # 2π(1 - cos(π/32)) of cap at SUN, all on +Y; the sum of float32 texels.
    cap = 2 * math.pi * (1 - math.cos(math.pi / 32)) * (SUN - 1)
    assert abs(share / cap - 1) <= 1e-6


@pytest.mark.parametrize("size", [1, 2, 32])
def test_sun_on_a_corner(device: Device, size: int) -> None:
    """A lat-long texel about the corner (1, 1, 1): its energy lands on +X, +Y and +Z only, all of it."""
    texels = np.zeros((10, 20, 3), np.float32)
    texels[3, 11] = SUN  # θ = 54° … 72° holds acos(1/√3) = 54.7°; φ = 18° … 36°, turned onto 27° + 18° = 45°
    level = means(device, texels, Shape(False, size), 18.0).reshape(6, -1, 3)
    shares = Shape(False, size).solid_angles().reshape(6, -1, 1) * level
    assert all(shares[f].sum() > 0 for f in (0, 2, 4)) and not shares[[1, 3, 5]].any()
    assert abs(shares[..., 0].sum() / (latlong_solid_angles(10, 20)[3] * SUN) - 1) <= 1e-7  # float32 storage


def test_same_grid_is_the_identity(device: Device) -> None:
    texels = random_texels((6, 8, 8))
    assert (means(device, texels, Shape(False, 8)) == texels.reshape(-1, 3)).all()
    # The same through the kernel, by a whole turn's quarter: faces change places, texels stay.
    turned = means(device, texels, Shape(False, 8), 90.0).reshape(6, 8, 8, 3)
    # +X turned by 90° of azimuth is +Z, and +Y turns by a quarter within itself: (x, z) -> (-z, x).
    assert np.allclose(turned[4], texels[0], rtol=1e-6, atol=0)  # float32 storage; edges at 1e-15
    assert np.allclose(turned[1], texels[4], rtol=1e-6, atol=0)
    assert np.allclose(turned[2], np.rot90(texels[2], -1), rtol=1e-6, atol=0)


@pytest.mark.parametrize("source", [(17, 34), (6, 5, 5)], ids=str)
def test_linear(device: Device, source: tuple[int, ...]) -> None:
    a, b = random_texels(source), random_texels(source)[::-1].copy()
    shape = Shape(False, 16)
    parts = means(device, a, shape, 31.0) + 2 * means(device, b, shape, 31.0)
    whole = means(device, a + 2 * b, shape, 31.0)
    assert np.abs(whole / parts - 1).max() <= 4e-7  # a + 2 b and three levels rounded to float32


# ---------------------------------------------------------------------------------------------- float32


@pytest.fixture
def without_fp64(device: Device, monkeypatch: pytest.MonkeyPatch) -> Device:
    monkeypatch.setattr(type(device), "fp64", property(lambda _: False))
    return device


@pytest.mark.parametrize("source", [(17, 34), (64, 128), (6, 5, 5)], ids=str)
@pytest.mark.parametrize("size", [1, 8, 64])
def test_float32(without_fp64: Device, source: tuple[int, ...], size: int) -> None:
    texels = random_texels(source)
    shape = Shape(False, size)
    index = chosen(shape)
    # Made on the host, as the truth is: what is checked is that it is, and float32 storage.
    assert_means(
        means(without_fp64, texels, shape, 37.0)[index], truth(texels, shape, 37.0, index), 1e-7, (source, size)
    )
