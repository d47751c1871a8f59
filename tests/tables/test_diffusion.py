"""Pre-integrated diffusion: against integrals over the cylinder by other rules, energy, limits, units."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from whitefurnace import lut
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.scenes.scale import MEDIA
from whitefurnace.tables import lut as tables

# Variances in mm² and the weights of red, as the paper prints them. [dEonLuebke2007, table 14-1]
RED = [(0.0064, 0.233), (0.0484, 0.100), (0.187, 0.118), (0.567, 0.113), (1.99, 0.358), (7.41, 0.078)]


def made(path: Path, **options: Any) -> np.ndarray:
    lut("diffusion", path / "d.npy", force=True, **options)
    return np.asarray(np.load(path / "d.npy"), np.float64)


def ratio(q: Any, theta: float, width: float) -> float:
    """∫ q(x) max(cos(θ + x), 0) dx / ∫ q dx over -π … π by adaptive Gauss-Kronrod between kinks and q's middle."""

    def whole(f: Any) -> float:
        ends = sorted(
            {
                -math.pi,
                math.pi,
                0.0,
                *(s * width * by for s in (-1, 1) for by in (0.01, 0.3, 3, 20) if width * by < math.pi),
                *(x for x in (math.pi / 2 - theta, -math.pi / 2 - theta) if abs(x) < math.pi),
            }
        )
        return sum(quad(f, a, b, epsabs=1e-13, epsrel=1e-12, limit=200)[0] for a, b in itertools.pairwise(ends))

    return whole(lambda x: q(x) * max(math.cos(theta + x), 0.0)) / whole(q)


@pytest.mark.parametrize("curvature", [0.003, 0.1, 1.0, 20.0])
def test_skin_is_the_published_sum_of_gaussians(tmp_path: Path, curvature: float) -> None:
    """Within what is stated, and 1e-9 of the other rule."""
    NoL = np.linspace(-1, 1, 7)
    table = made(tmp_path, axes={"NoL": (-1, 1, 7)}, curvature=curvature, precision=64)

    def q(x: float) -> float:
        r = 2 * math.sin(x / 2) / curvature
        return sum(w / math.sqrt(2 * math.pi * v) * math.exp(-r * r / (2 * v)) for v, w in RED)

    for k, c in enumerate(NoL):
        want = ratio(q, math.acos(c), 0.08 * curvature)
        assert abs(table[0, k, 0] - want) < 1e-9, (c, table[0, k, 0], want)


@pytest.mark.parametrize("curvature", [0.02, 1.0])
def test_burley_is_integrated_over_a_cylinder(tmp_path: Path, curvature: float) -> None:
    """R itself over the surface, along the axis too: y = x sinh t takes its 1/r. 1e-7 of two nested rules."""
    d = 1.3 / (1.85 - 0.6 + 7 * abs(0.6 - 0.8) ** 3)
    table = made(
        tmp_path,
        scheme="burley",
        axes={"NoL": (-1, 1, 5)},
        curvature=curvature,
        parameters={"albedo": 0.6, "mfp": 1.3},
        precision=64,
    )

    def q(x: float) -> float:
        r = abs(2 * math.sin(x / 2) / curvature)
        if r == 0:
            return 0.0
        # Where the exponent is over 40 nothing is left.
        most = math.acosh(max(1.0, 120 * d / r))
        return (
            2
            * quad(
                lambda t: (math.exp(-r * math.cosh(t) / d) + math.exp(-r * math.cosh(t) / (3 * d))) / (8 * math.pi * d),
                0,
                most,
                epsabs=1e-12,
                epsrel=1e-10,
            )[0]
            if most
            else 0.0
        )

    for k, c in enumerate(np.linspace(-1, 1, 5)):
        want = ratio(q, math.acos(c), d * curvature)
        assert table[0, k] == pytest.approx(np.full(3, want), abs=1e-7), c


@pytest.mark.parametrize("curvature", [0.02, 1.0])
def test_a_mediums_dipole_is_integrated_over_a_cylinder(tmp_path: Path, curvature: float) -> None:
    """As the paper has R over the surface, along the axis too, for marble's blue. [Jensen2001, eq. 4 and figure 5]"""
    s, a, ior = 3.00, 0.0071, 1.5
    table = made(tmp_path, scheme="marble", axes={"NoL": (-1, 1, 5)}, curvature=curvature, precision=64)
    F = -1.440 / ior**2 + 0.710 / ior + 0.668 + 0.0636 * ior
    sigma, z_r = math.sqrt(3 * a * (a + s)), 1 / (a + s)
    z_v = z_r + 4 * (1 + F) / (1 - F) / (3 * (a + s))

    def R(r: float) -> float:
        return sum(
            z * (sigma * d + 1) * math.exp(-sigma * d) / d**3
            for z, d in ((z_r, math.hypot(r, z_r)), (z_v, math.hypot(r, z_v)))
        )

    def q(x: float) -> float:
        r = abs(2 * math.sin(x / 2) / curvature)
        return 2 * sum(
            quad(lambda y: R(math.hypot(r, y)), *ends, epsabs=1e-12, epsrel=1e-10)[0]
            for ends in ((0, 1), (1, 10), (10, 300))
        )

    for k, c in enumerate(np.linspace(-1, 1, 5)):
        assert table[0, k, 2] == pytest.approx(ratio(q, math.acos(c), z_r * curvature), abs=1e-7), c


@pytest.mark.parametrize("scheme", ["skin", "burley", "skin1"])
def test_nothing_is_lost(tmp_path: Path, scheme: str) -> None:
    """What a circle reflects is what it receives: the mean of D is that of max(cos θ, 0), 1/π. Of a smooth function of
    period 2π the trapezoidal rule is exact: D's harmonics beyond 256 are below 1e-12 where it is as round as here."""
    n = 129
    table = made(
        tmp_path,
        scheme=scheme,
        axes={"NoL": (-1, 1, n, "angle"), "curvature": (2, 20, 4, "log")},
        precision=64,
        parameters={"albedo": 0.8} if scheme == "burley" else {},
    )
    weights = np.full(n, 1.0)
    weights[[0, -1]] = 0.5
    mean = np.einsum("rck,c->rk", table, weights / (n - 1))
    # Burley's line spread has a logarithm, and harmonics that fall like 1/n³: 1e-6 at 256.
    assert np.abs(mean - 1 / np.pi).max() < (1e-6 if scheme == "burley" else 1e-12)
    assert table.min() >= 0 and table.max() <= 1 and (np.diff(table, axis=1) > -1e-14).all()


def test_flat_and_small_bodies(tmp_path: Path) -> None:
    """A flat one is lit like Lambert's, one far smaller than the light's way evenly."""
    NoL = (np.arange(64) + 0.5) / 32 - 1
    table = made(tmp_path, size=64, curvature=0.0)
    assert np.abs(table - np.maximum(NoL, 0)[:, None]).max() <= 1e-7  # of float32
    table = made(tmp_path, size=64, curvature=1e-6)
    # Of width 2.7 mm on a radius of 1 km: off by their ratio at most.
    assert np.abs(table - np.maximum(NoL, 0)[:, None]).max() < 2.8e-6
    table = made(tmp_path, size=64, curvature=1e6)
    assert np.abs(table - 1 / np.pi).max() < 1e-7
    # A smaller body is lit more evenly, and blue, which goes less far, is nearer to a flat one.
    table = made(tmp_path, size=64)
    assert table.shape == (64, 64, 3) and (np.diff(np.ptp(table, axis=1), axis=0) < 0).all()
    off = np.abs(table - np.maximum(NoL, 0)[None, :, None]).max((0, 1))
    assert off[0] > off[1] > off[2]


def test_lengths_scale_and_media_are_their_coefficients(tmp_path: Path) -> None:
    """Twice the mean free path at half the curvature is the same; a medium by name and by coefficients, and Burley's
    profile by coefficients and by albedo and path, to the last digits of float64."""
    one = made(
        tmp_path, scheme="burley", size=16, parameters={"albedo": 0.8}, axes={"curvature": (0.1, 4, 8)}, precision=64
    )
    two = made(
        tmp_path,
        scheme="burley",
        size=16,
        parameters={"albedo": 0.8, "mfp": 2},
        precision=64,
        axes={"curvature": (0.05, 2, 8)},
    )
    assert np.abs(one - two).max() < 1e-12 and (one[..., 0] == one[..., 2]).all()
    medium = MEDIA["skin1"]
    named = made(tmp_path, scheme="skin1", size=16, precision=64)
    told = made(tmp_path, scheme="dipole", size=16, precision=64, parameters=medium.parameters())
    burley = made(tmp_path, scheme="burley", size=16, precision=64, parameters=medium.parameters())
    paths: dict[str, float] = {}
    for c, albedo, path in zip("rgb", medium.albedo, medium.mean_free_path, strict=True):
        paths |= {f"albedo_{c}": albedo, f"mfp_{c}": 1e3 * path}
    again = made(tmp_path, scheme="burley", size=16, precision=64, parameters=paths)
    assert np.abs(named - told).max() < 1e-12 and np.abs(burley - again).max() < 1e-12
    # Channels differ, and so do the profiles: the boundary keeps light in.
    assert np.ptp(named, axis=-1).max() > 0.05 and np.abs(named - burley).max() > 0.02
    # Even scattering of the same σs (1 - g).
    one, two = (
        made(tmp_path, scheme="dipole", size=8, parameters={"absorption": 0.1, "scattering": s, "g": g}, precision=64)
        for s, g in ((1.0, 0.0), (4.0, 0.75))
    )
    assert np.abs(one - two).max() < 1e-12


def test_it_needs_no_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*given: Any) -> None:
        raise AssertionError("a device was asked for")

    monkeypatch.setattr(tables, "choose_device", none)
    told = lut("diffusion", tmp_path / "d.ktx2", size="24x8", as_read=True)
    assert told.shape == (8, 24, 3) and "device" not in told.manifest and told.manifest["error"] < 1e-6
    assert [a.name for a in told.axes] == ["NoL", "curvature"] and told.manifest["stored"]["format"] == "rgba16f"
    assert lut("diffusion", tmp_path / "d.ktx2", size="24x8", as_read=True).state == "skipped"


def test_refusals(tmp_path: Path) -> None:
    ask: Any = lambda **more: lut("diffusion", tmp_path / "t.npy", size=8, **more)  # noqa: E731
    for error, words, more in (
        (UsageError, "did you mean 'skin", {"scheme": "skinn"}),
        (UnsupportedError, "no ndf", {"ndf": "ggx"}),
        (UnsupportedError, "no ndf", {"fresnel": "schlick"}),
        (UsageError, "no parameters", {"albedo": 0.5}),
        (UsageError, "needs absorption", {"scheme": "dipole"}),
        (UsageError, "no parameter 'albedo'", {"scheme": "dipole", "albedo": 0.5}),
        (UsageError, "one or the other", {"scheme": "burley"}),
        (UsageError, "one or the other", {"scheme": "burley", "albedo": 0.5, "absorption": 1}),
        (UsageError, "did you mean 'albedo'", {"scheme": "burley", "albdo": 0.5}),
        (UsageError, "needs scattering", {"scheme": "burley", "absorption": 1}),
        (UsageError, "outside", {"scheme": "burley", "albedo": 1.5}),
        (UsageError, "no diffusion", {"scheme": "burley", "absorption": 1, "scattering": 0}),
        (UsageError, "one number", {"scheme": "burley", "axes": {"albedo": (0, 1, 4)}}),
        (UsageError, "NoL -2", {"axes": {"NoL": (-2, 1, 4)}}),
        (UsageError, "from 0", {"curvature": -1}),
        (UsageError, "EXR holds|an axis at least", {"NoL": 1, "curvature": 1}),
    ):
        with pytest.raises(error, match=words):
            ask(**more)
