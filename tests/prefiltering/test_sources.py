"""What stands for an environment's texels: point masses, anterpolated grids, bright texels apart; against moments of
the texels in closed form and by Gauss quadrature."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from reference import gauss, texel_nodes
from whitefurnace.opencl import constants
from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering.lobes import COSINE
from whitefurnace.prefiltering.sources import Texels
from whitefurnace.sphere.environments import environment

DEGREE = 4
"""Of the harmonics that grids must hold: beyond, lobes of r > .5 have little."""


def noise(*shape: int) -> np.ndarray:
    """Radiance in [0, 1] with zeros in every channel, so that nothing is set apart as the least."""
    texels = np.random.default_rng(list(shape)).random((*shape, 3), np.float32)
    texels.reshape(-1, 3)[:2] = 0
    return texels


def whole(texels: Texels, cuts: int = 1) -> np.ndarray:
    """(nodes, 8) float64: the clipped source as a list."""
    return np.concatenate([listed.read()[:count].astype(np.float64) for listed, count, _ in texels.bands(cuts)])


@pytest.fixture
def nothing_bright(monkeypatch: pytest.MonkeyPatch) -> None:
    """All radiance stays in the texels: the largest alone is clipped to itself."""
    monkeypatch.setattr("whitefurnace.prefiltering.plan.BRIGHT", (1,))


# --------------------------------------------------------------------------------------- masses at centres


def over(at: int, k: int) -> float:
    """∫ x^k over [at - ½, at + ½]."""
    return ((at + 0.5) ** (k + 1) - (at - 0.5) ** (k + 1)) / (k + 1)


def patch(shape: tuple[int, ...], at: tuple[int, ...]) -> np.ndarray:
    """Noise on at most 3 × 3 texels around `at`, across the seam of a lat-long."""
    texels, rng = np.zeros((*shape, 3), np.float32), np.random.default_rng(list(at))
    for a in (-1, 0, 1):
        for b in (-1, 0, 1):
            i, j = at[-2] + a, at[-1] + b
            j = j % shape[1] if len(shape) == 2 else j
            if 0 <= i < shape[-2] and 0 <= j < shape[-1]:
                texels[(*at[:-2], i, j)] = rng.random(3)
    return texels


# Factors and masses are float32, 6e-8 each of nine taps twice.
MASS = 1e-6


@pytest.mark.parametrize("cuts", [1, 2])
@pytest.mark.parametrize("at", [(8, 20), (5, 0), (5, 47), (0, 20), (0, 1), (1, 46), (23, 7), (22, 30)], ids=str)
def test_masses_of_a_latlong_integrate_polynomials(
    device: Device, nothing_bright: None, at: tuple[int, int], cuts: int
) -> None:
    """∫ sin θ f dθ dφ over 3 × 3 texels of noise by their masses: exact for sin θ f a polynomial of degree 5 in θ and
    in φ around them, beyond the poles (where sin θ is negative on the meridian that goes on) and the seam too."""
    texels = patch((24, 48), at)
    t = Texels(device, environment(texels), 32)
    assert t.centred >= cuts
    rows, columns = 24 * cuts, 48 * cuts
    theta = (np.arange(rows) + 0.5) * math.pi / rows
    mass = whole(t, cuts)[:, 4:7].reshape(rows, columns, 3) / t.scale / np.sin(theta)[:, None, None]
    parts = texels.repeat(cuts, 0).repeat(cuts, 1).astype(np.float64)
    row, column = (k * cuts for k in at)

    def around(j: int) -> int:
        return (j - column + columns // 2) % columns - columns // 2

    for a in range(6):
        for b in range(6):
            got, scale = np.zeros(3), np.zeros(3)
            for i, j in np.argwhere(mass.any(-1)).tolist():
                x, y, sign = i - row, around(j), 1.0
                if abs(y) > columns // 4:  # beyond a pole row i is -1 - i (or 2 rows - 1 - i), half way round
                    x = (-1 - i if at[0] < 12 else 2 * rows - 1 - i) - row
                    y, sign = around(j + columns // 2), -1.0
                got += sign * mass[i, j] * float(x) ** a * float(y) ** b
                scale += np.abs(mass[i, j]) * abs(float(x)) ** a * abs(float(y)) ** b
            want = sum(
                parts[i, j] * over(i - row, a) * over(around(j), b) for i, j in np.argwhere(parts.any(-1)).tolist()
            )
            want = want * math.pi / rows * 2 * math.pi / columns
            assert (np.abs(got - want) <= MASS * np.maximum(scale, np.abs(want))).all(), (at, a, b, got, want)


@pytest.mark.parametrize("cuts", [1, 2])
@pytest.mark.parametrize("at", [(8, 9), (0, 9), (9, 0), (0, 0), (19, 19), (1, 18), (2, 2), (17, 10)], ids=str)
def test_masses_of_a_cube_integrate_polynomials(
    device: Device, nothing_bright: None, at: tuple[int, int], cuts: int
) -> None:
    """∫ f (1 + s² + t²)^-3/2 ds dt on one face, exact for the integrand a polynomial in s and in t: of degree 5 inside;
    of 4 by the face's edges, where quartics lean to one side."""
    texels = patch((6, 20, 20), (3, *at))
    t = Texels(device, environment(texels), 32)
    assert t.centred >= cuts
    n = 20 * cuts
    s = (2 * np.arange(n) + 1) / n - 1
    q = 1 + s[:, None] ** 2 + s**2
    mass = whole(t, cuts)[:, 4:7].reshape(6, n, n, 3) / t.scale
    assert not mass[[0, 1, 2, 4, 5]].any()
    mass = mass[3] * (q * np.sqrt(q))[..., None]
    parts = texels[3].repeat(cuts, 0).repeat(cuts, 1).astype(np.float64)
    i, j = (np.arange(n, dtype=float) - k * cuts for k in at)
    degree = 5 if all(4 <= k < 16 for k in at) else 4
    for a in range(degree + 1):
        for b in range(degree + 1):
            got = np.einsum("ijc,i,j->c", mass, i**a, j**b)
            scale = np.einsum("ijc,i,j->c", np.abs(mass), np.abs(i) ** a, np.abs(j) ** b)
            want = (
                sum(
                    parts[k, m] * over(k - at[0] * cuts, a) * over(m - at[1] * cuts, b)
                    for k, m in np.argwhere(parts.any(-1)).tolist()
                )
                * (2 / n) ** 2
            )
            assert (np.abs(got - want) <= MASS * np.maximum(scale, np.abs(want))).all(), (at, a, b, got, want)


@pytest.mark.parametrize("source", [(16, 32), (24, 48), (37, 74), (6, 16, 16), (6, 33, 33)], ids=str)
def test_weights_are_the_sphere(device: Device, nothing_bright: None, source: tuple[int, ...]) -> None:
    t = Texels(device, environment(noise(*source)), 32)
    for cuts in (k for k in (1, 2, 4) if k <= t.centred):
        weight = whole(t, cuts)[:, 3].sum()
        # Through poles and seams sines are smooth: float32. By the edges of faces, and of an odd number of rows at a
        # pole, quartics leave (1 + s² + t²)^-3/2 its fifth and sixth derivative: 1e-5 at 16 texels, and 32 times less
        # each doubling.
        allowed = 1e-6 + (2e-5 * (16 / cuts / source[1]) ** 5 if len(source) == 3 else 0)
        assert weight == pytest.approx(4 * math.pi, rel=allowed), (source, cuts)


# --------------------------------------------------------------------------------------- moments and energy


def legendre(degree: int, x: np.ndarray) -> np.ndarray:
    return np.polynomial.legendre.Legendre.basis(degree)(x)


AXES = np.array([d / np.linalg.norm(d) for d in np.random.default_rng(4).normal(size=(9, 3))])
"""Zonal harmonics along 2l + 1 axes in general position span those of degree l: 9 are enough up to degree 4."""


def zonal(d: np.ndarray) -> np.ndarray:
    """(5 · 9, m): P_l(d · axis) of every degree to 4, at directions (m, 3)."""
    return np.concatenate([legendre(degree, AXES @ d.T) for degree in range(DEGREE + 1)])


def texel_moments(texels: np.ndarray, rotation: float) -> np.ndarray:
    """(45, 3): ∫ L P_l dω over every texel, by 8 × 8 Gauss nodes, more where a texel is a face."""
    d, weight, index = texel_nodes(texels, rotation, 8 if texels.shape[-2] > 4 else 40)
    return (zonal(d) * weight) @ texels.reshape(-1, 3).astype(np.float64)[index]


SOURCES = [(32, 64), (37, 74), (15, 30), (9, 18), (1, 2), (6, 16, 16), (6, 5, 5), (6, 1, 1)]


@pytest.mark.few(2)
@pytest.mark.parametrize("source", SOURCES, ids=str)
def test_nodes_keep_the_moments(device: Device, source: tuple[int, ...]) -> None:
    """All of it: the clipped texels and the excess of the bright ones."""
    texels = noise(*source) ** 8
    env = environment(texels, rotate=33)
    t = Texels(device, env, 32)
    assert (t.centred > 0) == (min(source[-2:]) >= 16)
    cuts = t.centred or max(4, 2 * math.ceil(64 / source[-2]))  # pairs of Gauss points on .05 rad: 1e-8
    listed = whole(t, cuts)
    bright = t.bright_list(COSINE, 1e-5)
    if bright:
        listed = np.concatenate([listed, bright.read()])
    got = zonal(listed[:, :3]) @ listed[:, 4:7] / t.scale
    want = texel_moments(texels, math.radians(33))
    assert not t.base.any()
    # Float32 nodes leave 1e-6 of the energy, and quintics of P_4 on parts of .05 rad less: (4 · .05)^6/1e4.
    assert np.abs(got - want).max() <= 5e-6 * np.abs(want[:9]).max(), (source, np.abs(got - want).max() / want[0].max())
    assert np.abs(got[:9] - want[:9]).max() <= 3e-6 * want[0].max()  # the energy


@pytest.mark.parametrize("source", [(32, 64), (15, 30), (6, 16, 16), (6, 5, 5)], ids=str)
def test_grids_keep_the_moments(device: Device, nothing_bright: None, source: tuple[int, ...]) -> None:
    """As n grows, with at least the order that is said; energy at every n, since Lagrange weights sum to 1."""
    texels = noise(*source)
    least = 1e-8 if device.fp64 else 2e-6
    cuts = 16  # 8 cells of two Gauss points a texel edge: 1e-9 of P_4
    want = texel_moments(texels, math.radians(33))
    energy = np.abs(want[0]).max()
    errors = []
    for n in (12 + 2 * constants.BEYOND, 24 + 2 * constants.BEYOND, 48 + 2 * constants.BEYOND):
        t = Texels(device, environment(texels, rotate=33), 64 if device.fp64 else 32)
        t.prepare(n, cuts)
        listed = t.grid_list(n).read().astype(np.float64)
        got = zonal(listed[:, :3]) @ listed[:, 4:7] / t.scale
        assert np.abs(got[:9] - want[:9]).max() <= least * energy, (source, n)
        assert listed[:, 3].sum() == pytest.approx(4 * math.pi, rel=least)
        errors.append(float(np.abs(got - want).max() / energy))
    assert errors[2] <= 1e-6, (source, errors)
    for coarse, fine in itertools.pairwise(errors):
        # One order is what noise may hide between two grids; 1e-8 is where other errors take over.
        assert fine <= coarse / 2 ** (constants.ORDER - 1) or fine <= 3 * least, (source, errors)


@pytest.mark.parametrize("source", [(32, 64), (6, 16, 16)], ids=str)
def test_coarser_grids_are_made_from_the_finest(device: Device, nothing_bright: None, source: tuple[int, ...]) -> None:
    texels = noise(*source)
    want = texel_moments(texels, 0.0)
    t = Texels(device, environment(texels), 64 if device.fp64 else 32)
    t.prepare(96, 8)
    for n in (32, 48, 96):
        listed = t.grid_list(n).read().astype(np.float64)
        got = zonal(listed[:, :3]) @ listed[:, 4:7] / t.scale
        # (4 · π/2/32)^4/384 = 4e-6 of P_4 for order 4, the least there may be.
        assert np.abs(got - want).max() <= 5e-6 * want[0].max(), (source, n)
    assert t.fineness == (96, 8)


# --------------------------------------------------------------------------------------- bright texels


@pytest.mark.parametrize("source", [(32, 64), (9, 18), (6, 16, 16)], ids=str)
def test_clipped_and_excess_are_the_original(device: Device, source: tuple[int, ...]) -> None:
    texels = noise(*source)
    texels.reshape(-1, 3)[7] = (1e5, 3e4, 1e-3)
    texels.reshape(-1, 3)[70] = (2e3, 0, 5e5)
    t = Texels(device, environment(texels), 32)
    clipped = t._clipped.read().reshape(-1, 3)
    assert len(t._index) and {7, 70} <= set(t._index.tolist())
    original = texels.reshape(-1, 3) * np.float32(t.scale) - t.base  # float32, as the kernels have it
    restored = clipped.astype(np.float64)
    restored[t._index] += t._excess
    assert (restored == original).all()
    assert (clipped >= 0).all() and (t._excess >= 0).all()
    # What is left of any texel holds no more than the largest that was clipped.
    _, weight, index = texel_nodes(texels, 0.0, 2)
    omega = np.bincount(index, weight)
    left = clipped.sum(1) * omega
    assert left.max() <= left[t._index].max() * (1 + 1e-3)  # solid angles by 2 × 2 nodes
    assert t.share == pytest.approx(left.max() / (original.sum(1) * omega).sum(), rel=1e-3)


def test_the_excess_of_a_sun_as_nodes(device: Device) -> None:
    """The list carries the excess and its first moment, by Gauss in the texel."""
    texels = np.full((24, 48, 3), 0.5, np.float32)
    texels[7, 13] = 1e5
    t = Texels(device, environment(texels, rotate=20), 32)
    bright = t.bright_list(COSINE, 1e-3)
    assert bright
    listed = bright.read().astype(np.float64)
    x, w = gauss(12)
    theta = (7 + x) * math.pi / 24
    phi = (13 + x) * 2 * math.pi / 48 - math.pi + math.radians(20)
    omega = np.outer(w * np.sin(theta) * math.pi / 24, w * 2 * math.pi / 48)
    d = np.stack(
        [
            np.outer(np.sin(theta), np.cos(phi)),
            np.outer(np.cos(theta), np.ones(12)),
            np.outer(np.sin(theta), np.sin(phi)),
        ]
    )
    excess = t._excess[t._index.tolist().index(7 * 48 + 13)]
    assert listed[:, 4:7].sum(0) == pytest.approx(excess * omega.sum(), rel=2e-6)
    got = listed[:, :3].T @ listed[:, 4]
    assert got == pytest.approx((d * omega).sum((1, 2)) * excess[0], rel=2e-6)  # float32


def test_a_constant_has_nothing_bright(device: Device) -> None:
    t = Texels(device, environment(np.full((16, 32, 3), 0.7, np.float32)), 32)
    assert t.constant and t.bright_list(COSINE, 1e-3) is None
    assert (t.base == np.float32(0.7) * np.float32(t.scale)).all()
