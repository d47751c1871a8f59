"""Beckmann."""

import math

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter
from whitefurnace.catalogue.roughness import alpha_within

ALPHA = Parameter(
    "alpha",
    "α",
    "1",
    1e-5,
    1.0,
    (1e-4, 1e-3, 0.01, 0.05, 0.2, 0.5, 1.0),
    "roughness, √2 times the standard deviation of the slopes; the square of the perceptual one",
)
_erf = np.vectorize(math.erf, otypes=[np.float64])


def _d(theta_m, alpha):
    """Evaluate by slopes: P22(tan θ)/cos⁴θ with the Gaussian P22 = exp(-tan²θ/α²)/(πα²). [Heitz2014, app. A]"""
    theta_m = np.asarray(theta_m, np.float64)
    tan2 = np.tan(theta_m) ** 2
    return np.where(np.cos(theta_m) > 0, np.exp(-tan2 / alpha**2) / (np.pi * alpha**2) * (1 + tan2) ** 2, 0.0)


def _area(theta_v, alpha):
    """cos θ (1 + Λ), Λ = (erf a - 1)/2 + exp(-a²)/(2a√π), a = 1/(α tan θ). [Heitz2014, app. A]"""
    theta_v = np.asarray(theta_v, np.float64)
    with np.errstate(divide="ignore", over="ignore"):  # a and a² are infinite along n, where Λ is 0
        a = 1 / (alpha * np.tan(theta_v))
        value = np.cos(theta_v) * (1 + (_erf(a) - 1) / 2 + np.exp(-a * a) / (2 * a * math.sqrt(math.pi)))
    return value


ENTRY = Model(
    slot="ndf",
    name="beckmann",
    title="Beckmann",
    citation=cited("Walter2007"),
    parameters=(ALPHA,),
    provides=("NDF_D", "NDF_AREA", "NDF_WIDTH", "NDF_REACH", "NDF_SAMPLE"),
    reference={"D": _d, "area": _area},
    from_roughness=lambda r: {"alpha": alpha_within(r, ALPHA)},
    checks=Checks(normalized=True, float32_error=5.5e-6),
    notes={
        "projected area": "closed, with erf",
        "tail": "D falls like exp(-tan²θ/α²)",
        "float32": "relative error of D at most 5.5e-6 where D > 1e-7 of its peak; 6e-7 (1 + |log(D/peak)|) below, "
        "0 below 1e-34 of it",
        "quadrature": "normalization within 3e-7 and 3e-15, weak furnace with Smith within 1e-6 and 2e-14 "
        "(float32 and float64), over the domain and n·v from 0 to 1",
        "limits": "D is 0 at grazing for every α",
    },
)
