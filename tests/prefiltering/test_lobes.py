"""The series that stand for lobes, against the NDFs' own references; what lobes say of themselves, by other
quadrature."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebval

import reference
from whitefurnace.catalogue import models
from whitefurnace.catalogue.choice import chosen
from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering.lobes import COSINE, MOST_TERMS, Lobe, Series, mixture_lobe, ndf_lobe
from whitefurnace.prefiltering.plan import Part
from whitefurnace.prefiltering.recipe import Chain, chain
from whitefurnace.prefiltering.symmetry import Octahedral
from whitefurnace.sphere.grids import Shape

NDFS = [n for n, m in models("ndf").items() if m.isotropic and m.from_roughness]
ROUGHNESS = (0.03, 0.1, 0.3, 0.55, 0.8, 1.0)

MINE = """// A lobe of two tails.
real ndf_mine_D(real cos_m, real alpha) {
  const real a2 = alpha * alpha, s = (1 - cos_m) * (1 + cos_m);
  return 1 / (a2 + s) + 1 / sqr(a2 + s);
}
"""


def mine(alpha: float) -> Callable[[np.ndarray], np.ndarray]:
    """MINE at q, sin²θ = q/4, over its norm π∫₀¹ (1/(α² + s) + 1/(α² + s)²) ds, s = sin²θ."""
    a2 = alpha * alpha
    norm = math.pi * (math.log((1 + a2) / a2) + 1 / a2 - 1 / (1 + a2))
    return lambda q: (1 / (a2 + q / 4) + 1 / (a2 + q / 4) ** 2) / norm


@functools.cache
def panels(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of ∫ dω = π ∫ dq over [low, high]: Gauss of 12 on 20 panels a decade from 1e-13 on."""
    edges = np.concatenate([[low], np.geomspace(max(low, 1e-13) * 1.001, high, 280)])
    x, w = reference.gauss(12)
    width = np.diff(edges)[:, None]
    return (edges[:-1, None] + width * x).ravel(), (width * w).ravel() * math.pi


def value(series: Series, q: np.ndarray) -> np.ndarray:
    """K by the series, as lobe_table.clh defines it."""
    x = 1 / (q + series.shift)
    y = np.clip(series.slope * x - series.offset, -1, 1)
    return np.maximum(1 - q / 2, 0) * x**series.power * chebval(y, series.terms)


def parameters_of(name: str, r: float) -> dict[str, float]:
    entry = models("ndf")[name]
    assert entry.from_roughness
    given = {p.name: p.default if p.default is not None else p.typical[0] for p in entry.parameters}
    return {**given, **entry.from_roughness(r)}


def catalogue_lobe(device: Device, name: str, r: float) -> tuple[Lobe, Callable[[np.ndarray], np.ndarray]]:
    """The lobe, and its D at q by the entry's reference in θ."""
    entry, parameters = models("ndf")[name], parameters_of(name, r)
    return (
        ndf_lobe(device, chosen("ndf", entry), r, parameters),
        lambda q: entry.reference["D"](np.arctan2(np.sqrt(q), np.sqrt(4 - q)), **parameters),
    )


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lobes") / "mine.clh"
    path.write_text(MINE)
    return path


def missed(series: Series, density: Callable[[np.ndarray], np.ndarray], low: float, high: float, norm: float) -> float:
    q, w = panels(low, high)
    return float((np.abs(value(series, q) - density(q) * np.maximum(1 - q / 2, 0)) * w).sum()) / norm


@pytest.mark.parametrize("error", [3e-6, 3e-7])
@pytest.mark.parametrize("name", NDFS)
def test_series_are_as_good_as_they_say(device: Device, name: str, error: float) -> None:
    for r in ROUGHNESS:
        lobe, density = catalogue_lobe(device, name, r)
        if lobe.norm < 1e-30:  # sheen of which float32 has nothing left: no level can be made of it
            continue
        for low, high in ((0.0, 2.0), (0.0, 0.1), (0.003, 2.0), (0.05, 0.6)):
            series = lobe.series(low, high, error)
            assert len(series.terms) <= MOST_TERMS, (name, r, low, high, series)
            # Tails of many decades of the sharpest ones, and sheen's sin^(1/α) θ ~ q^(1/2α) at its root, ask for more
            # terms than there may be: what is left is stated, and is little.
            hard = len(series.terms) == MOST_TERMS and (r < 0.1 or density(np.zeros(1))[0] == 0)
            assert series.error <= error or (hard and series.error <= 3e-5), (name, r, low, high, series)
            true = missed(series, density, low, high, lobe.norm)
            # The series states what a coarser rule of 512 cells finds; what that may miss of a peak is of its own size.
            assert true <= 1.5 * max(error, series.error), (name, r, (low, high), len(series.terms), true, series.error)


@pytest.mark.parametrize("r", ROUGHNESS)
def test_series_of_a_users(device: Device, file: Path, r: float) -> None:
    lobe = ndf_lobe(device, chosen("ndf", file), r, {"alpha": r * r})
    for low, high in ((0.0, 2.0), (0.0, 0.1), (0.003, 2.0)):
        series = lobe.series(low, high, 3e-7)
        true = missed(series, mine(r * r), low, high, lobe.norm)
        assert true <= 1.5 * 3e-7, (r, low, high, series, true)


@pytest.mark.parametrize("r", ROUGHNESS)
def test_ggx_takes_one_term(device: Device, r: float) -> None:
    lobe, density = catalogue_lobe(device, "ggx", r)
    for low, high in ((0.0, 2.0), (0.0, 0.1), (0.02, 2.0)):
        series = lobe.series(low, high, 1e-7)
        assert len(series.terms) == 1, (r, low, high, series)
        q, _ = panels(low, high)
        # Of the sharpest lobe 1.6e-4 lies beyond .02, where 1e-7 of the whole is 6e-4 of what there is.
        np.testing.assert_allclose(value(series, q), density(q) * (1 - q / 2), rtol=1e-3 if low and r < 0.1 else 1e-6)


def test_the_cosine_is_a_constant() -> None:
    series = COSINE.series(0.0, 2.0, 1e-7)
    q, _ = panels(0.0, 2.0)
    assert len(series.terms) == 1
    np.testing.assert_allclose(value(series, q), 1 - q / 2, rtol=0, atol=1e-7)


# ------------------------------------------------------------------------------------------- what lobes say


@pytest.mark.parametrize("name", NDFS)
def test_norm_and_reach(device: Device, name: str) -> None:
    for r in ROUGHNESS:
        lobe, density = catalogue_lobe(device, name, r)
        q, w = panels(0.0, 2.0)
        share = density(q) * (1 - q / 2) * w
        assert share.sum() == pytest.approx(lobe.norm, rel=1e-8), (name, r)
        beyond = share[q > lobe.reach].sum() / lobe.norm
        assert beyond <= 2e-9, (name, r, lobe.reach, beyond)  # a billionth, and a cell of 1/70 decade
        nearer = share[q > 0.9 * lobe.reach].sum() / lobe.norm
        assert lobe.reach == 2 or nearer >= 1e-9, (name, r, lobe.reach, nearer)


def test_norm_of_a_users(device: Device, file: Path) -> None:
    for r in ROUGHNESS:
        lobe = ndf_lobe(device, chosen("ndf", file), r, {"alpha": r * r})
        q, w = panels(0.0, 2.0)
        # 1e-6 is what integrals of users' models are held to; a device without float64 has float32's.
        want = float((mine(r * r)(q) * (1 - q / 2) * w).sum())
        assert lobe.norm == pytest.approx(want, rel=1e-6), r


def test_a_mixture_is_the_sum_of_its_parts(device: Device) -> None:
    recipe: Chain = chain(ndf="ggx")
    parts = [(0.5, 0.2), (0.7, 0.6), (-0.2, 0.9), (0.0, 0.4)]
    lobe = mixture_lobe(device, recipe.ndf, parts, recipe.parameters)
    q, w = panels(0.0, 2.0)
    want = np.sum(
        [
            weight * density(q) / single.norm
            for weight, r in parts
            for single, density in [catalogue_lobe(device, "ggx", r)]
        ],
        0,
    )
    np.testing.assert_allclose(lobe.density(q), want, rtol=1e-10, atol=1e-10)
    assert lobe.norm == 1 and float((want * (1 - q / 2) * w).sum()) == pytest.approx(1, rel=1e-8)
    assert len(lobe.summands) == 3  # that of weight 0 is none
    series = lobe.series(0.0, 2.0, 3e-7)
    assert (
        missed(
            series,
            lambda q: np.sum(
                [
                    weight * density(q) / single.norm
                    for weight, r in parts
                    for single, density in [catalogue_lobe(device, "ggx", r)]
                ],
                0,
            ),
            0.0,
            2.0,
            1.0,
        )
        <= 1.5 * 3e-7
    )
    assert lobe.alpha == pytest.approx(0.04) and lobe.reach == 2  # as sharp as its sharpest


# ------------------------------------------------------------------------------------------- on a device


class OneClass:
    """A grid of one class with the radiance 1 in its own direction and none in its images."""

    count = 1

    def __init__(self, o: Octahedral, source: np.ndarray) -> None:
        self.node = o.device.array(np.array([[*source, 1]], o.kind))
        self.moment = o.device.array(np.ones((8, 1, 18), o.kind))


def on_device(o: Octahedral, lobe: Lobe, source: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(q, K, ∑|K| over the mirror images) of one source for every reflection of the outputs of a cube: sums of
    `convolve_all`, transformed back."""
    (found,) = o.orbits(Shape(False, 32))
    partial, at = o.empty(1, found), source.astype(o.kind)
    o.convolve(partial, 0, 1, found, lobe, Part(32, None, None), OneClass(o, at), error)  # type: ignore[arg-type]
    sums = partial.read()[0]
    assert (sums[:144].reshape(8, 18, -1) == sums[:144].reshape(8, 18, -1)[:, :1]).all()
    assert (sums[144] == sums[0]).all()  # ∑K w
    sign = np.array([[(-1) ** (p & s).bit_count() for p in range(8)] for s in range(8)])
    K = sign @ sums[:144].reshape(8, 18, -1)[:, 0].astype(np.float64) / 8
    d = found.direction.astype(o.kind).astype(np.float64)
    flips = np.array([[1 - 2 * (s & 1), 1 - (s & 2), 1 - (s & 4) // 2] for s in range(8)])
    q = ((d - (flips * at.astype(np.float64))[..., None]) ** 2).sum(1)
    return q.ravel(), K.ravel(), np.broadcast_to(np.abs(K).sum(0), K.shape).ravel()


@pytest.mark.parametrize("precision", [32, 64])
@pytest.mark.parametrize("name", [*NDFS, "mine"])
def test_series_on_a_device(device: Device, file: Path, name: str, precision: int) -> None:
    """Every value of the kernel is that of the series in numpy, at distances from nothing to the horizon and beyond."""
    if precision == 64 and not device.fp64:
        pytest.skip("the device has no float64")
    o, epsilon, rng = Octahedral(device, precision), 2.0 ** (-24 if precision == 32 else -53), np.random.default_rng(5)
    (found,) = o.orbits(Shape(False, 32))
    for r in (0.03, 0.3, 1.0):
        lobe = (
            ndf_lobe(device, chosen("ndf", file), r, {"alpha": r * r})
            if name == "mine"
            else catalogue_lobe(device, name, r)[0]
        )
        series = lobe.series(0.0, 2.0 if lobe.reach >= 1 else 1.25 * lobe.reach, 3e-7)
        k = np.arange(len(series.terms))
        for away in (0.0, 1e-4, 1e-3, 1e-2, 0.1):
            at = found.direction[:, 100] + away * rng.normal(size=3)
            q, K, mixed = on_device(o, lobe, at / np.linalg.norm(at), 3e-7)
            want = value(series, q)
            if lobe.reach < 1:
                t = np.clip((q - lobe.reach) / (0.25 * lobe.reach), 0, 1)
                want *= 1 - t**4 * (35 + t * (-84 + t * (70 - 20 * t)))
            x = 1 / (q + series.shift)
            # y is off by an ulp of its parts and T_k by k² of that; Clenshaw's sums by as many ulps as terms.
            bend = float((np.abs(series.terms) * (1 + k + k * k * (1 + abs(series.offset)))).sum())
            allowed = 12 * epsilon * np.maximum(1 - q / 2, 0) * x**series.power * bend + 3e-38
            # Where 1 - q/2 cancels, an ulp of q is its own.
            allowed += 4 * epsilon * x**series.power * np.abs(series.terms).sum()
            allowed += 4 * epsilon * mixed  # three additions there and three back in float64
            error = np.abs(K - want)
            worst = (error / allowed).argmax()
            assert (error <= allowed).all(), (name, r, q[worst], K[worst], want[worst], error[worst] / allowed[worst])


def test_a_lobe_that_ends_is_cut_where_it_ends(device: Device) -> None:
    lobe, _ = catalogue_lobe(device, "beckmann", 0.15)
    assert lobe.reach < 0.1
    q, K, mixed = on_device(Octahedral(device, 32), lobe, np.array([0.1, 0.2, math.sqrt(1 - 0.05)]), 3e-7)
    assert (np.abs(K) <= 3e-7 * mixed)[q > 1.26 * lobe.reach].all() and (K[q < lobe.reach / 2] > 0).all()
