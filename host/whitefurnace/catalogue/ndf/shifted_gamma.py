"""The shifted-gamma NDF."""

import numpy as np
from numpy.polynomial.legendre import leggauss

from whitefurnace.catalogue.model import Checks, Model, Paper, Parameter
from whitefurnace.catalogue.roughness import alpha_within

ALPHA = Parameter(
    "alpha",
    "α",
    "1",
    1e-4,
    1.0,
    (1e-4, 1e-3, 0.01, 0.1, 0.5, 1.0),
    "roughness: the power law bends at tan θ = α, the exponential at tan²θ = α",
)
P = Parameter(
    "p", "p", "1", 0.0, 2.0, (0.0, 0.5, 1.0, 1.5, 2.0), "steepness of the power law; 0 is Beckmann of roughness √α"
)

NODES = 64


def _constants(alpha, p):
    """norm = 1/(πα² S), S = e^α E_p(α) = ∫₀^∞ e^(-αt) (1 + t)^-p dt, which is α^(p-1) e^α Γ(1 - p, α) and regular for
    every p: Gauss-Legendre in y = log(1 + t), up to αt = 40 (e⁻⁴⁰ = 4e-18).
    """
    alpha, p = np.broadcast_arrays(np.asarray(alpha, np.float64), np.asarray(p, np.float64))
    end, total = np.log1p(40 / alpha), np.zeros(alpha.shape)
    for x, w in zip(*leggauss(NODES), strict=True):
        y = end * ((1 + x) / 2)
        total += w / 2 * np.exp((1 - p) * y - alpha * np.expm1(y))
    return {"norm": 1 / (np.pi * alpha**2 * end * total)}


def _gamma(alpha, p):
    """e^α Γ(1 - p, α) = α^-p ∫₀^∞ e^-u (1 + u/α)^-p du, by the trapezoid in x with u = exp((π/2) sinh x)."""
    total = np.zeros(np.broadcast_shapes(np.shape(alpha), np.shape(p)))
    for x in np.arange(-4.0, 2.5, 1 / 32):
        u = np.exp(np.pi / 2 * np.sinh(x))
        total += np.exp(-u) * (1 + u / alpha) ** -p * (u * np.pi / 2 * np.cosh(x) / 32)
    return total * alpha**-p


def _d(theta_m, alpha, p):
    """P22(tan²θ)/(π cos⁴θ) as [Hoffman2012] writes it, with Γ(1 - p, α)."""
    theta_m, alpha, p = (np.asarray(a, np.float64) for a in (theta_m, alpha, p))
    tan2 = np.tan(theta_m) ** 2
    # e^-α of the exponential is in the e^α of _gamma.
    p22 = alpha ** (p - 1) / _gamma(alpha, p) * np.exp(-tan2 / alpha) / (alpha**2 + tan2) ** p
    return np.where(np.cos(theta_m) > 0, p22 / np.pi * (1 + tan2) ** 2, 0.0)


ENTRY = Model(
    slot="ndf",
    name="shifted_gamma",
    title="Shifted gamma",
    citation=Paper(
        "Bagher2012",
        "M. Bagher, C. Soler, N. Holzschuch, Accurate Fitting of Measured Reflectances Using a Shifted "
        "Gamma Micro-facet Distribution, CGF 31(4), 2012",
    ),
    parameters=(ALPHA, P),
    provides=("NDF_D", "NDF_WIDTH", "NDF_REACH"),
    reference={"D": _d},
    constants=_constants,
    constant_names=("norm",),
    # p = 2: the core is GGX's slope density of the same α, (1 + tan²θ/α²)^-2, its tail cut by e^(-tan²θ/α).
    from_roughness=lambda r: {"alpha": alpha_within(r, ALPHA), "p": 2.0},
    checks=Checks(normalized=True, float32_error=5.5e-6),
    notes={
        "tail": "D falls like exp(-tan²θ/α), before it like (α² + tan²θ)^-p",
        "float32": "relative error of D at most 5.5e-6 where D > 1e-7 of its peak; 5e-7 (1 + |log(D/peak)|) below, "
        "0 below 1e-34 of it",
        "quadrature": "normalization within 3e-7 and 8e-15, weak furnace with Smith within 1e-6 and 2e-13 "
        "(float32 and float64), over the domain and n·v from 0 to 1",
        "limits": "Beckmann of roughness √α at p = 0; the norm is regular for p ≥ 1",
    },
)
