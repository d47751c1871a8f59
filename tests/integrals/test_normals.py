"""Normals drawn from every NDF follow D(m)(n·m): chi² over (energy, azimuth) bins, and the density of a table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from whitefurnace import sample
from whitefurnace.catalogue import Model, models
from whitefurnace.errors import UsageError
from whitefurnace.opencl.device import Device

COUNT, RINGS, SECTORS = 200_000, 40, 8

CASES = [
    (entry, dict(zip((p.name for p in entry.parameters), values, strict=True)))
    for entry in models("ndf").values()
    for values in {
        tuple(p.typical[0] for p in entry.parameters),
        tuple(p.typical[-1] for p in entry.parameters),
        tuple(p.typical[len(p.typical) // 2] for p in entry.parameters),
    }
]
# One family-wise level for all: a right sampler fails one run of this file in a hundred seeds, and the seed is fixed.
LEVEL = 0.01 / len(CASES)


def energy_below(entry: Model, theta: np.ndarray, phi: np.ndarray, own: dict[str, Any]) -> np.ndarray:
    """Quantile that the float64 reference gives to each polar angle (at its azimuth where it is anisotropic)."""
    t = np.concatenate([[0.0], np.geomspace(1e-9, math.pi / 2, 40_001)])
    mid = (t[1:] + t[:-1]) / 2
    parts = np.diff(t) * np.sin(2 * mid)
    if entry.isotropic:
        cdf = np.concatenate([[0.0], np.cumsum(entry.reference["D"](mid, **own) * parts * math.pi)])
        return np.interp(theta, t, cdf / cdf[-1])
    # In stretched slopes an anisotropic NDF of equal α = 1 is what is left.
    ax, ay = own["alpha_x"], own["alpha_y"]
    unit = {"alpha_x": 1.0, "alpha_y": 1.0}
    stretched = np.arctan(np.tan(theta) * np.hypot(np.cos(phi) / ax, np.sin(phi) / ay))
    cdf = np.concatenate([[0.0], np.cumsum(entry.reference["D"](mid, 0.0, **unit) * parts * math.pi)])
    return np.interp(stretched, t, cdf / cdf[-1])


@pytest.mark.few(9)
@pytest.mark.parametrize(
    "entry, own", CASES, ids=lambda v: v.name if isinstance(v, Model) else ",".join(f"{k}={x:g}" for k, x in v.items())
)
def test_chi2(device: Device, entry: Model, own: dict[str, Any]) -> None:
    m = sample(entry, COUNT, seed=7, device=device, precision=64 if device.fp64 else 32, **own)
    assert np.isfinite(m).all() and (m[:, 2] >= 0).all()
    assert np.abs(np.linalg.norm(m, axis=1) - 1).max() < 1e-6  # float32's cos and sin
    phi = np.arctan2(m[:, 1], m[:, 0])
    theta = np.arctan2(np.hypot(m[:, 0], m[:, 1]), m[:, 2])
    sector = phi if entry.isotropic else np.arctan2(m[:, 1] / own["alpha_y"], m[:, 0] / own["alpha_x"])
    u = energy_below(entry, theta, phi, own)
    rings = np.minimum((u * RINGS).astype(int), RINGS - 1)
    sectors = np.floor((sector + math.pi) / (2 * math.pi) * SECTORS).astype(int) % SECTORS
    counts = np.bincount(rings * SECTORS + sectors, minlength=RINGS * SECTORS)
    p = stats.chisquare(counts).pvalue
    assert p > LEVEL, f"{entry.name} {own}: p = {p:.2g}, rings {counts.reshape(RINGS, SECTORS).sum(1)}"


def test_a_user_s_ndf_is_sampled_by_its_table(device: Device, tmp_path: Path) -> None:
    file = tmp_path / "lobe.clh"
    file.write_text(
        "real ndf_lobe_D(real cos_m, real sin2_m, real alpha) {\n"
        "  real t = alpha * alpha + (1 - alpha) * (1 + alpha) * sin2_m;\n  return 3 / (t * t);\n}\n"
    )
    m = sample(f"{file}:alpha=.2", COUNT, seed=3, device=device)
    tan2 = (1 - m[:, 2] ** 2) / m[:, 2] ** 2
    u = tan2 / (tan2 + 0.2**2)  # GGX's energy below tan²θ [Walter2007, eq. 35]
    assert stats.kstest(u, "uniform").pvalue > 0.001  # a right table fails one seed in a thousand; this one is fixed


def test_the_seed_decides(device: Device) -> None:
    a, b, c = (sample("ggx", 100, seed=s, alpha=0.3, device=device) for s in (1, 1, 2))
    assert (a == b).all() and not (a == c).all()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({}, "needs alpha"),
        ({"alpha": 2}, "outside"),
        ({"alpha": 0.1, "apha": 1}, "did you mean 'alpha'"),
        ({"alpha": [0.1, 0.2]}, "one number"),
    ],
)
def test_bad_input(device: Device, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        sample("ggx", 10, device=device, **arguments)
