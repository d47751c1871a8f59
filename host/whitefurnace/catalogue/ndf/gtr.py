"""Generalized Trowbridge-Reitz."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter
from whitefurnace.catalogue.numerics import expm1_ratio
from whitefurnace.catalogue.roughness import alpha_within

ALPHA = Parameter(
    "alpha", "α", "1", 1e-4, 1.0, (1e-4, 1e-3, 0.01, 0.1, 0.5, 1.0), "roughness, the square of the perceptual one"
)
GAMMA = Parameter(
    "gamma",
    "γ",
    "1",
    0.0,
    10.0,
    (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 10.0),
    "steepness of the tail: 2 is GGX, 1 Burley's clearcoat, 0 the uniform lobe",
)


def _constants(alpha, gamma):
    """peak = D(n) = 1/(π ∫₀¹ (1 + Bs)^-γ ds), s = sin²θ, B = 1/α² - 1: the integral is L/B φ((1 - γ)L) with
    L = log(1 + B) = -2 log α and φ(x) = (eˣ - 1)/x; γ = 1 is φ(0) = 1, α = 1 is L/B = 1. [Burley2012, app. B.2]
    """
    alpha, gamma = np.broadcast_arrays(np.asarray(alpha, np.float64), np.asarray(gamma, np.float64))
    B = (1 - alpha) * (1 + alpha) / alpha**2
    L = np.log1p(B)
    ratio = np.where(B == 0, 1.0, L / np.where(B == 0, 1.0, B))
    return {"peak": 1 / (np.pi * ratio * expm1_ratio((1 - gamma) * L))}


def _d(theta_m, alpha, gamma):
    """c/(α²cos²θ + sin²θ)^γ [Burley2012, app. B.2], 1/c = π ∫ t^-γ dt/(1 - α²) over t from α² to 1; with h = -log α and
    k = 1 - γ that integral is 2e^(-kh) sinh(kh)/k and 1 - α² is 2e^-h sinh h."""
    theta_m, alpha, gamma = (np.asarray(a, np.float64) for a in (theta_m, alpha, gamma))
    h, k = -np.log(alpha), 1 - gamma

    def sinh_ratio(x):
        return np.where(x == 0, 1.0, np.sinh(x) / np.where(x == 0, 1.0, x))

    c = np.exp((k - 1) * h) * sinh_ratio(h) / (np.pi * sinh_ratio(k * h))
    value = c * ((alpha * np.cos(theta_m)) ** 2 + np.sin(theta_m) ** 2) ** -gamma
    return np.where(np.cos(theta_m) > 0, value, 0.0)


ENTRY = Model(
    slot="ndf",
    name="gtr",
    title="Generalized Trowbridge-Reitz (GTR)",
    citation=cited("Burley2012"),
    parameters=(ALPHA, GAMMA),
    provides=("NDF_D", "NDF_WIDTH", "NDF_REACH", "NDF_SAMPLE"),
    reference={"D": _d},
    constants=_constants,
    constant_names=("peak",),
    from_roughness=lambda r: {"alpha": alpha_within(r, ALPHA), "gamma": 2.0},  # GGX
    checks=Checks(normalized=True, float32_error=3e-6),
    notes={
        "tail": "D falls like sin^-2γ θ",
        "float32": "relative error of D at most 3e-6 where D > 1e-7 of its peak; 3e-7 (1 + |log(D/peak)|) below, "
        "0 below 1e-38 of it",
        "quadrature": "normalization within 4e-7 and 7e-15, weak furnace with Smith within 1e-6 and 2e-13 "
        "(float32 and float64), over the domain and n·v from 0 to 1",
        "limits": "GGX at γ = 2; uniform at γ = 0 or α = 1; the norm is regular at γ = 1",
    },
)
