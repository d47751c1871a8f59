"""Tables of rough glass: against the BTDF over directions, in closed form, by reciprocity, in the smooth limit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reference
from whitefurnace import integrate, lut
from whitefurnace.catalogue import model
from whitefurnace.catalogue.choice import chosen
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.opencl.device import Device
from whitefurnace.tables.glass import glass


def table(path: Path, device: Device, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
    made = lut("glass", path / "g.npy", device=device, force=True, **options)
    return np.load(path / "g.npy").astype(np.float64), made.manifest


def at(
    path: Path, device: Device, NoV: tuple[float, float, int], alpha: float, ior: float, **options: Any
) -> np.ndarray:
    """(nv, 2) along n·v at one α and index, by the kernel's own n where it is below 1."""
    scheme, index = ("entering", ior) if ior >= 1 else ("leaving", 1 / ior)
    told = table(path, device, axes={"NoV": (*NoV, "linear")}, alpha=alpha, ior=index, scheme=scheme, **options)[0]
    return told.reshape(NoV[2], 2)  # type: ignore[no-any-return]


def fresnel(c: np.ndarray, n: float) -> np.ndarray:
    return np.asarray(model("fresnel", "dielectric").reference["F"](c, ior=n))


def over_directions(NoV: float, alpha: float, n: float, nodes: int = 300) -> tuple[float, float]:
    """R and T of GGX over the direction of l, with the densities of reflected and refracted light as they are written.
    [Walter2007, eqs. 13, 16, 20, 21; Heitz2014, eq. 99]"""
    x, w = reference.gauss(nodes)
    # Of refraction, n·h = 0 at cos θ = n·v/n, where D need not be 0.
    edge = np.arccos(min(NoV / n, 1.0))
    theta = np.concatenate([edge * x, edge + (np.pi / 2 - edge) * x])[:, None]
    phi = np.pi * x[None, :]
    weight = np.concatenate([edge * w, (np.pi / 2 - edge) * w])[:, None] * np.pi * w[None, :] * 2 * np.sin(theta)
    v = np.array([np.sqrt(1 - NoV**2), 0.0, NoV])

    def smith(c: np.ndarray | float) -> np.ndarray:
        return (np.sqrt(1 + alpha**2 * (1 / np.asarray(c) ** 2 - 1)) - 1) / 2

    found = []
    for up in (1.0, -1.0):
        l = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), up * np.cos(theta) + 0 * phi])  # noqa: E741
        h = v[:, None, None] + l if up > 0 else -(v[:, None, None] + n * l)
        h /= np.sqrt((h**2).sum(0))
        h *= np.sign(h[2])
        VoH, LoH = np.einsum("i,ijk->jk", v, h), (l * h).sum(0)
        D = alpha**2 / np.pi / (h[2] ** 2 * (alpha**2 - 1) + 1) ** 2
        G = 1 / (1 + smith(NoV) + smith(np.cos(theta)))
        F = fresnel(np.abs(VoH), n)
        if up > 0:
            f = F * D * G / (4 * NoV * np.cos(theta))
        else:
            f = VoH * -LoH / (NoV * np.cos(theta)) * n**2 * (1 - F) * G * D / (VoH + n * LoH) ** 2
            f = np.where((VoH > 0) & (LoH < 0), f, 0)
        found.append(float((f * np.cos(theta) * weight).sum()))
    return found[0], found[1]


@pytest.mark.parametrize("n", [1.2, 3.0, 1 / 1.3, 1 / 2.4])
def test_the_btdf_over_directions(device: Device, tmp_path: Path, n: float) -> None:
    for alpha in (0.3, 0.8):
        got = at(tmp_path, device, (0.15, 0.95, 3), alpha, n, tolerance=1e-6)
        for k, NoV in enumerate((0.15, 0.55, 0.95)):
            want = over_directions(NoV, alpha, n)
            # The product rule meets the root at the critical angle of n < 1 (1.6e-5); above it agrees to 4e-7.
            assert np.abs(got[k] - want).max() <= (2e-6 if n > 1 else 3e-5), (alpha, n, NoV, got[k], want)


@pytest.mark.few(2)
@pytest.mark.parametrize("ndf", ["ggx", "beckmann", "abc:c=1.3", "charlie"])
def test_no_boundary_is_the_masking_alone(device: Device, tmp_path: Path, ndf: str) -> None:
    """n = 1: nothing is reflected and l = -v, so T = ∫ D (v·m) dω · V(v, -v) n·v = A/(2A - n·v)."""
    got, told = table(tmp_path, device, ndf=ndf, size=(24, 12), ior=1.0)
    x, y = ((np.arange(k) + 0.5) / k for k in (24, 12))
    rows = model("ndf", ndf.partition(":")[0]).from_roughness
    assert rows is not None
    given = {name: np.array([rows(r)[name] for r in y])[:, None] for name in rows(0.5) if name != "c"}
    A = integrate("projected_area", ndf=ndf, NoV=x, **given, precision=64, device=device).values
    assert np.abs(got[..., 0]).max() == 0
    assert np.abs(got[..., 1] - A / (2 * A - x)).max() <= told["error"] + 1e-11 and told["error"] <= 1.2e-5


def test_smooth_glass_is_fresnels(device: Device, tmp_path: Path) -> None:
    for n in (1.5, 1 / 1.5, 0.999, 1.001):
        NoV = np.linspace(0.2, 1, 9)
        got, F = at(tmp_path, device, (0.2, 1, 9), 1e-5, n), fresnel(np.linspace(0.2, 1, 9), n)
        critical = np.sqrt(max(1 - n**2, 0))
        # F curves by less than 1e4 where it is not within .02 of total reflection, and the lobe has α² ln(1/α) = 1e-9.
        some = np.abs(NoV - critical) > 0.02
        assert np.abs(got[some] - np.stack([F, 1 - F], 1)[some]).max() <= 1e-5, (n, got, F)


@pytest.mark.few(1)
@pytest.mark.parametrize("ndf", ["ggx", "shifted_gamma:p=1.5"])
def test_as_much_goes_in_as_comes_out(device: Device, tmp_path: Path, ndf: str) -> None:
    """∫ T(n, μ) 2μ dμ = n² ∫ T(1/n, μ) 2μ dμ: f_t/n² is reciprocal. [Walter2007, sec. 4.3]"""
    q, w = reference.gauss(28)
    for ior in (1.1, 2.0):
        # Two panels that meet at the critical angle, with the nodes close to all ends.
        edge = np.sqrt(1 - 1 / ior**2)
        share = q**2 * (3 - 2 * q)
        mu = np.concatenate([edge * share, edge + (1 - edge) * share])
        weight = np.concatenate([edge * w, (1 - edge) * w]) * np.tile(6 * q * (1 - q), 2) * 2 * mu
        for r in (0.2, 0.9):
            total = []
            for scheme in ("entering", "leaving"):
                made, _ = glass(
                    scheme,
                    False,
                    ndf=chosen("ndf", ndf),
                    masking=chosen("masking", "smith"),
                    fresnel=chosen("fresnel", "dielectric"),
                    out=None,
                    precision=64,
                    tolerance=1e-8,
                    device=device,
                    NoV=mu,
                    alpha=r**2,
                    ior=ior,
                )
                total.append(float(made.values[:, 1] @ weight))
            # What 28 nodes a panel leave at r = .2, where T rises within .04 of the critical cosine.
            assert abs(total[0] - ior**2 * total[1]) <= 2e-5, (ior, r, total)


@pytest.mark.parametrize("scheme", ["entering", "leaving"])
@pytest.mark.parametrize("ndf", ["ggx", "shifted_gamma"])
def test_the_statement_holds(device: Device, tmp_path: Path, ndf: str, scheme: str) -> None:
    """Float32 against float64 asked for 1e-8, over the whole grid; never more than arrives."""
    options: dict[str, Any] = {"size": 8, "axes": {"ior": (1, 3, 5, "f0")}, "scheme": scheme, "ndf": ndf}
    rough, told = table(tmp_path, device, **options)
    fine, exact = table(tmp_path, device, precision=64, tolerance=1e-8, **options)
    assert rough.shape == (5, 8, 8, 2) and told["channels"] == ["reflected", "transmitted"]
    assert told["error"] <= 1.2e-5 and exact["error"] <= 1e-8
    assert np.abs(rough - fine).max() <= told["error"]
    assert fine.min() >= 0 and fine.sum(-1).max() <= 1 + exact["error"]
    z = np.linspace(0, np.sqrt(0.5), 5)
    assert told["axes"][2] == {"name": "ior", "from": 1, "to": 3, "count": 5, "scale": "f0"}
    # Cycles' axis: z⁴ is F0.
    n = (1 + z[2] ** 2) / (1 - z[2] ** 2)
    one = table(tmp_path, device, **{**options, "axes": {"ior": (n, n, 1)}, "tolerance": 1e-7})[0]
    assert np.abs(one[0] - rough[2]).max() <= told["error"] + 1e-7


def test_refusals(device: Device, tmp_path: Path) -> None:
    ask: Any = lambda **more: lut("glass", tmp_path / "t.npy", size=4, device=device, **more)  # noqa: E731
    for error, words, more in (
        (UnsupportedError, "one term for each direction", {"masking": "kelemen"}),
        (UnsupportedError, "isotropic", {"ndf": "ggx_anisotropic"}),
        (UnsupportedError, "dielectric", {"fresnel": "schlick:gold"}),
        (UsageError, "did you mean 'leaving'", {"scheme": "leavin"}),
        (UsageError, "outside", {"ior": 9}),
        (UsageError, "f0 scale needs ends above 0", {"axes": {"ior": (-1, 3, 4, "f0")}}),
    ):
        with pytest.raises(error, match=words):
            ask(**more)
    with pytest.raises(UsageError, match="EXR holds two axes"):
        lut("glass", tmp_path / "t.exr", size=4, device=device)
    assert list(tmp_path.iterdir()) == []
