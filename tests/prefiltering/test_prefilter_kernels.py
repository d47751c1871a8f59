"""The anterpolated convolution and the exact sum over texels, against float64 quadrature and closed forms."""

from __future__ import annotations

import itertools
import math

import mpmath
import numpy as np
import pytest

import reference
from whitefurnace.catalogue import models
from whitefurnace.catalogue.choice import chosen
from whitefurnace.opencl import constants
from whitefurnace.opencl.derived import lobe_norm
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.prefiltering import plan
from whitefurnace.prefiltering.convolution import COSINE, Convolver, Lobe, Shape, ndf_lobe
from whitefurnace.sphere.environments import environment

WHERE = Shape(False, 4)


def ggx(device: Device, alpha: float) -> Lobe:
    return ndf_lobe(device, chosen("ndf", "ggx"), math.sqrt(alpha), {"alpha": alpha})


def noise(*shape: int) -> np.ndarray:
    """Radiance in [.1, 1.1], the same for the same shape."""
    return np.random.default_rng(list(shape)).random((*shape, 3), np.float32) + np.float32(0.1)


def convolved(
    device: Device,
    texels: np.ndarray,
    lobe: Lobe,
    n: int,
    rotate: float = 0.0,
    shape: Shape = WHERE,
    tolerance: float = 1e-5,
) -> np.ndarray:
    convolver = Convolver(device, environment(texels, rotate=rotate))
    return convolver.convolve(lobe, shape, n, tolerance).reshape(-1, 3) / convolver.scale


def exact(device: Device, texels: np.ndarray, lobe: Lobe, cuts: int, rotate: float = 0.0) -> np.ndarray:
    convolver = Convolver(device, environment(texels, rotate=rotate))
    return convolver.exact([(lobe, WHERE.directions())], cuts, 1e-5)[0] / convolver.scale


def truth(texels: np.ndarray, alpha: float, cuts: int, rotate: float = 0.0, shape: Shape = WHERE) -> np.ndarray:
    return reference.exact_lobe(texels, math.radians(rotate), shape.directions().T, reference.ggx_lobe(alpha), cuts)


def rounding(alpha: float) -> float:
    """What float32 leaves: directions are rounded to 6e-8, which turns s by 6e-8/α of itself and K ~ s^-2 by
    twice that (seven times allowed: a narrow lobe sees few nodes); sums of up to 8192 terms, 5e-6."""
    return 5e-6 + 8e-7 / alpha


def assert_close(got: np.ndarray, want: np.ndarray, tolerance: float, context: object) -> None:
    error = np.abs(got - want) / want
    at = np.unravel_index(error.argmax(), error.shape)
    assert np.isfinite(got).all() and error.max() <= tolerance, (
        f"{context}: at {at} got {got[at]}, wanted {want[at]}, error {error.max():.2e} > {tolerance:.1e}"
    )


# ---------------------------------------------------------------------------------------------- convergence


@pytest.mark.parametrize("source", [(32, 64), (6, 16, 16)], ids=str)
@pytest.mark.parametrize("alpha, n", [(0.05, 32), (0.07, 32)])
def test_anterpolation_has_its_order(device: Device, source: tuple[int, ...], alpha: float, n: int) -> None:
    texels = noise(*source)
    want = truth(texels, alpha, 8, 21.0)
    errors = [
        float(np.sqrt(np.mean((convolved(device, texels, ggx(device, alpha), n << k, 21.0) / want - 1) ** 2)))
        for k in range(3)
    ]
    nodes = [(n << k) - 2 * constants.BEYOND for k in range(3)]  # on a face
    pairs = [
        (math.log(a / b) / math.log(y / x))
        for (a, b), (x, y) in zip(itertools.pairwise(errors), itertools.pairwise(nodes), strict=True)
        if b > 3e-7  # float32 ends there
    ]
    # RATE is what plans scale grids by; ORDER is the limit, which 2 nodes a lobe width are not. With stencils of 4
    # points no doubling falls faster than by the fourth power.
    assert pairs and plan.RATE - 1 <= max(pairs) <= constants.ORDER + 1, (alpha, source, errors, pairs)


@pytest.mark.few(4)
@pytest.mark.parametrize("alpha", [0.03, 0.05, 0.2, 1.0])
@pytest.mark.parametrize("source", [(32, 64), (17, 34), (5, 10), (1, 2), (6, 16, 16), (6, 5, 5), (6, 1, 1)], ids=str)
def test_planned_grids_reach_their_tolerance(device: Device, source: tuple[int, ...], alpha: float) -> None:
    """Small and odd sources, with a rotation, on the grid that the plan takes for 1e-3 (split in two for .03)."""
    texels = noise(*source)
    size = source[1] if len(source) == 3 else source[0]
    # Cells of half the lobe's width and of a 64th of a hemisphere, for its kink: Gauss nodes then leave 1e-5.
    cuts = max(4, math.ceil(2 * math.pi / size / max(alpha, 0.04)), math.ceil(64 / size))
    want = truth(texels, alpha, cuts, 33.0)
    got = convolved(device, texels, ggx(device, alpha), plan.grid_size(alpha, 1e-3), 33.0)
    error = np.abs(got / want - 1).max(1)
    # The plan promises 1e-3 at the 99th percentile; noise from texel to texel is harder than any image.
    assert np.percentile(error, 99) <= 1.5e-3, (source, alpha, np.percentile(error, 99), error.max())


def test_checkerboard(device: Device) -> None:
    texels = np.repeat((np.indices((64, 128)).sum(0) % 2)[..., None], 3, -1).astype(np.float32)
    alpha = 0.1
    got = convolved(device, texels, ggx(device, alpha), plan.grid_size(alpha, 1e-3))
    assert_close(got, truth(texels, alpha, 4), 1e-3, "checkerboard")  # the plan's tolerance


# ---------------------------------------------------------------------------------------------- the exact sum


@pytest.mark.few(4)
@pytest.mark.parametrize("rotate", [0.0, 75.0])
@pytest.mark.parametrize("alpha", [0.05, 0.2, 0.6, 1.0])
@pytest.mark.parametrize("source", [(32, 64), (7, 14), (6, 16, 16), (6, 3, 3)], ids=str)
def test_exact_sum(device: Device, source: tuple[int, ...], alpha: float, rotate: float) -> None:
    texels = noise(*source)
    size = source[1] if len(source) == 3 else source[0]
    cuts = max(8, 2 * math.ceil(2 * math.pi / size / alpha))  # 2-point cells of α/2: (1/4)^4/4320 of curvature
    kink = 0.05 * (math.pi / size / cuts) ** 2  # (n·l)₊ over a node's cell, of those at the horizon only
    assert_close(
        exact(device, texels, ggx(device, alpha), cuts, rotate),
        truth(texels, alpha, cuts + 4, rotate),
        rounding(alpha) + kink,
        (source, alpha),
    )


@pytest.mark.parametrize("source", [(32, 64), (6, 16, 16)], ids=str)
def test_irradiance(device: Device, source: tuple[int, ...]) -> None:
    texels = noise(*source)
    want = reference.exact_lobe(texels, 0.4, WHERE.directions().T, reference.cosine_lobe, 8)
    degrees = math.degrees(0.4)
    assert_close(exact(device, texels, COSINE, 8, degrees), want, rounding(1.0) + 2e-5, source)  # kink: texel/8 cells
    assert_close(convolved(device, texels, COSINE, plan.grid_size(1.0, 1e-4), degrees), want, 1e-4, source)


def test_irradiance_of_a_hemisphere(device: Device) -> None:
    """Sky of 1 over a black ground: E/π = (1 + n·y)/2, in closed form."""
    texels = np.zeros((16, 32, 3), np.float32)
    texels[:8] = 1
    d = WHERE.directions()
    got = exact(device, texels, COSINE, 16)
    # Nodes of π/256 across the kink of (n·l)₊: (π/256)²/8 of its length of one row at most.
    assert np.abs(got - (1 + d[1][:, None]) / 2).max() <= 5e-5


# ---------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("source", [(1, 1), (17, 34), (32, 64), (6, 9, 9)], ids=str)
@pytest.mark.parametrize("alpha", [0.03, 0.1, 0.4, 1.0])
def test_constant(device: Device, source: tuple[int, ...], alpha: float) -> None:
    # 1 is what the design asks for; numerator and denominator of .7 round apart, by 6e-8 a sum and block of it.
    for level, tolerance in ((1.0, 1e-6), (0.7, 3e-6)):
        texels = np.full((*source, 3), level, np.float32)
        for got in (
            convolved(device, texels, ggx(device, alpha), plan.grid_size(alpha, 1e-3), 10.0),
            exact(device, texels, ggx(device, alpha), 2 * math.ceil(8 / alpha / source[-1]), 10.0),
        ):
            error = float(np.abs(got / np.float32(level) - 1).max())
            assert error <= tolerance, (source, alpha, level, error)


@pytest.mark.parametrize("alpha", [1e-4, 1e-3, 0.01, 0.1, 0.5, 0.999, 1.0])
def test_lobe_norm_of_ggx(device: Device, alpha: float) -> None:
    model = models("ndf")["ggx"]
    # Panels of 12 Gauss nodes a quarter decade of s leave 1e-12; near α = 1 the closed form here cancels to
    # 1e-16/(1 - α²)².
    tolerance = 2e-11 + (1e-9 if alpha > 0.9 else 0)
    assert lobe_norm(device, model, {"alpha": alpha}) == pytest.approx(reference.ggx_lobe_norm(alpha), rel=tolerance)
    with mpmath.workdps(20):
        a2 = mpmath.mpf(alpha) ** 2
        breaks = [0, *(float(a2) * 10**k for k in range(-1, 9) if float(a2) * 10**k < 1), 1]
        integral = mpmath.quad(lambda s: 2 * a2 * (1 - s) / (a2 + (1 - a2) * s / 2) ** 2, breaks)
    assert reference.ggx_lobe_norm(alpha) == pytest.approx(float(integral), rel=1e-13 if alpha < 0.9 else 1e-9)


@pytest.mark.few(5)
@pytest.mark.parametrize("name", [n for n, m in models("ndf").items() if m.isotropic and m.from_roughness])
@pytest.mark.parametrize("r", [0.1, 0.3, 0.7, 1.0])
def test_lobe_norm(device: Device, name: str, r: float) -> None:
    model = models("ndf")[name]
    assert model.from_roughness is not None
    given = {p.name: p.typical[0] for p in model.parameters}
    parameters = {**given, **model.from_roughness(r)}
    width = r**4 if r < 1 else 1e-3

    def lobe(s: mpmath.mpf) -> float:
        theta_h = math.asin(math.sqrt(float(s) / 2))
        return 2 * math.pi * float(model.reference["D"](theta_h, **parameters)) * (1 - float(s))

    breaks = [0.0, *(width * 10**k for k in range(-2, 6) if width * 10**k < 1), 1.0]
    # mpmath's tanh-sinh on a float64 integrand.
    assert lobe_norm(device, model, parameters) == pytest.approx(float(mpmath.quad(lobe, breaks)), rel=1e-9)


@pytest.mark.parametrize("alpha", [0.02, 0.1, 0.5, 1.0])
@pytest.mark.parametrize(
    "source, at",
    [((32, 64), (11, 40)), ((32, 64), (0, 3)), ((17, 34), (16, 33)), ((6, 16, 16), (2, 8, 3)), ((6, 5, 5), (4, 0, 4))],
    ids=str,
)
def test_one_bright_texel_is_the_lobe(
    device: Device, source: tuple[int, ...], at: tuple[int, ...], alpha: float
) -> None:
    """L K over one texel by 24 x 24 Gauss nodes, over ∫K dω in closed form."""
    texels = np.zeros((*source, 3), np.float32)
    texels[at] = (1e4, 2e4, 5e3)
    d, weight, index = reference.texel_nodes(texels, 0.3, 24)
    own = index == np.ravel_multi_index(at, source)
    s = np.maximum(1 - WHERE.directions().T @ d[own].T, 0)
    K = reference.ggx_lobe(alpha)(s) @ weight[own]
    want = (K * alpha**2 / math.pi / reference.ggx_lobe_norm(alpha))[:, None] * texels[at]
    got = convolved(device, texels, ggx(device, alpha), plan.grid_size(alpha, 1e-3), math.degrees(0.3), tolerance=1e-4)
    error = np.abs(got - want).max(1) / want.max()
    setting = (s.min(1) < 1.01) & (s.max(1) > 0.99)  # the texel lies across the horizon, the kink of (n·l)₊
    # Texels are cut for a tenth of the tolerance asked for.
    assert error[~setting].max() <= 1e-5 + rounding(alpha), (source, at, alpha, error[~setting].max())
    # There 24 nodes an edge leave the size of a texel, .4 at most, over 4 · 24².
    assert error[setting].max(initial=0) <= 2e-4, (source, at, alpha, error[setting].max())


# ---------------------------------------------------------------------------------------------- harmonics


def latlong_harmonics(texels: np.ndarray) -> np.ndarray:
    """(9, 3): ∑ L ∫ Y dω over the texels of a lat-long, each integral in closed form over θ and φ."""
    rows, columns = texels.shape[:2]
    theta = np.arange(rows + 1) * math.pi / rows
    phi = np.arange(columns + 1) * 2 * math.pi / columns - math.pi
    c, s = np.cos(theta), np.sin(theta)
    # Antiderivatives in θ of sin θ times 1, cos, cos², sin², and of sin² θ, sin² θ cos θ.
    one, cos1, cos2 = -np.diff(c), np.diff(s**2) / 2, -np.diff(c**3) / 3
    sin2, plain, cross = one - cos2, np.diff(theta / 2 - s * c / 2), np.diff(s**3) / 3
    p1, pc, ps = np.diff(phi), np.diff(np.sin(phi)), -np.diff(np.cos(phi))
    pcc, pss = np.diff(phi / 2 + np.sin(2 * phi) / 4), np.diff(phi / 2 - np.sin(2 * phi) / 4)
    pcs = np.diff(np.sin(phi) ** 2) / 2
    # x = sin θ cos φ, y = cos θ, z = sin θ sin φ.
    k0, k1, k2 = math.sqrt(1 / (4 * math.pi)), math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    k20, k22 = math.sqrt(5 / (16 * math.pi)), math.sqrt(15 / (16 * math.pi))
    basis = [
        k0 * np.outer(one, p1),
        k1 * np.outer(cos1, p1),
        k1 * np.outer(plain, ps),
        k1 * np.outer(plain, pc),
        k2 * np.outer(cross, pc),
        k2 * np.outer(cross, ps),
        k20 * (3 * np.outer(sin2, pss) - np.outer(one, p1)),
        k2 * np.outer(sin2, pcs),
        k22 * (np.outer(sin2, pcc) - np.outer(cos2, p1)),
    ]
    return np.stack([np.einsum("ij,ijk->k", b, texels.astype(np.float64)) for b in basis])


def values_of_harmonics(d: np.ndarray) -> np.ndarray:
    """(9, N): the real basis at directions (N, 3), in the order and signs of design.md."""
    x, y, z = d.T
    k1, k2 = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    return np.stack(
        [
            np.full_like(x, math.sqrt(1 / (4 * math.pi))),
            k1 * y,
            k1 * z,
            k1 * x,
            k2 * x * y,
            k2 * y * z,
            math.sqrt(5 / (16 * math.pi)) * (3 * z * z - 1),
            k2 * x * z,
            k2 / 2 * (x * x - y * y),
        ]
    )


@pytest.mark.parametrize("source", [(1, 1), (2, 4), (17, 34), (64, 128)], ids=str)
def test_harmonics_of_latlongs(device: Device, source: tuple[int, int]) -> None:
    texels = noise(*source)
    got, stated = Convolver(device, environment(texels)).harmonics()
    want = latlong_harmonics(texels)
    error = np.abs(got - want).max() / np.abs(want[0]).max()
    # Float32 nodes and sums of 1024 leave 2e-6; the statement must hold too.
    assert error <= 4e-6 and error <= stated, (source, error, stated)


@pytest.mark.parametrize("source", [(32, 64), (6, 16, 16), (6, 5, 5)], ids=str)
@pytest.mark.parametrize("which", range(9))
def test_harmonics_of_a_harmonic(device: Device, source: tuple[int, ...], which: int) -> None:
    """Radiance 2 + Y: texel means of Y by 6 x 6 Gauss nodes, whose coefficients come back by the same nodes."""
    d, weight, index = reference.texel_nodes(np.empty((*source, 3)), 0.0, 6)
    count = int(np.prod(source))
    basis = values_of_harmonics(d)
    areas = np.bincount(index, weight, count)
    mean = np.stack([np.bincount(index, weight * b, count) for b in basis]) / areas
    texels = np.repeat((2 + mean[which]).reshape(*source, 1), 3, -1).astype(np.float32)
    want = (mean * areas) @ texels.reshape(-1, 3).astype(np.float64)
    got, stated = Convolver(device, environment(texels)).harmonics()
    error = np.abs(got - want).max() / want[0].max()
    assert error <= 4e-6 and error <= stated, (source, which, error, stated)  # float32, as above
    # Orthonormal but for what is lost to texels: a texel h wide keeps 1 - O(h²) of a harmonic.
    others = np.delete(np.arange(1, 9), which - 1) if which else np.arange(1, 9)
    assert np.abs(got[others]).max() <= 0.02 * got[0].max()
    assert abs(got[which, 0] - (1 if which else 1 + 2 * math.sqrt(4 * math.pi))) <= 0.1


# ---------------------------------------------------------------------------------------------- lanes


@pytest.mark.few(2)
@pytest.mark.parametrize("alpha", [0.04, 0.2, 1.0])
@pytest.mark.parametrize("lanes", [1, 4, 16])
def test_every_width_gives_the_same(device: Device, monkeypatch: pytest.MonkeyPatch, lanes: int, alpha: float) -> None:
    texels = noise(16, 32)
    n = plan.grid_size(alpha, 1e-2)
    usual = convolved(device, texels, ggx(device, alpha), n)
    monkeypatch.setenv("WHITEFURNACE_LANES", str(lanes))
    other = choose_device(f"{device.platform}: {device.name}")
    assert other.lanes(32) == lanes
    # One text; only contractions to fused operations may differ between widths: 2e-6 of chunked sums.
    assert np.abs(convolved(other, texels, ggx(other, alpha), n) / usual - 1).max() <= 2e-6
