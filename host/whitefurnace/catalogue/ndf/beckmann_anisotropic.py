"""Anisotropic Beckmann."""

import math

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter
from whitefurnace.catalogue.roughness import alpha_within

ALPHA_X, ALPHA_Y = (
    Parameter(
        f"alpha_{axis}",
        f"α{axis}",
        "1",
        1e-4,
        1.0,
        (1e-4, 0.01, 0.2, 1.0),
        f"roughness along {axis}, √2 times the standard deviation of the slopes",
    )
    for axis in "xy"
)
_erf = np.vectorize(math.erf, otypes=[np.float64])


def _d(theta, phi, alpha_x, alpha_y):
    """Evaluate by slopes: D = P22/cos⁴θ, P22 = exp(-tan²θ (cos²φ/αx² + sin²φ/αy²))/(π αx αy). [Heitz2014, app. A]"""
    theta, phi = np.asarray(theta, np.float64), np.asarray(phi, np.float64)
    tan2 = np.tan(theta) ** 2
    stretched = tan2 * ((np.cos(phi) / alpha_x) ** 2 + (np.sin(phi) / alpha_y) ** 2)
    return np.where(np.cos(theta) > 0, np.exp(-stretched) / (np.pi * alpha_x * alpha_y) * (1 + tan2) ** 2, 0.0)


def _area(theta, phi, alpha_x, alpha_y):
    """cos θ (1 + Λ) with the roughness along v's azimuth, α² = αx²cos²φ + αy²sin²φ. [Heitz2014, eq. 80]"""
    theta, phi = np.asarray(theta, np.float64), np.asarray(phi, np.float64)
    with np.errstate(divide="ignore", over="ignore"):  # a and a² are infinite along n, where Λ is 0
        a = 1 / (np.hypot(alpha_x * np.cos(phi), alpha_y * np.sin(phi)) * np.tan(theta))
        return np.cos(theta) * (1 + (_erf(a) - 1) / 2 + np.exp(-a * a) / (2 * a * math.sqrt(math.pi)))


ENTRY = Model(
    slot="ndf",
    name="beckmann_anisotropic",
    title="Beckmann, anisotropic",
    citation=cited("Heitz2014"),
    parameters=(ALPHA_X, ALPHA_Y),
    provides=("NDF_D", "NDF_AREA", "NDF_STRETCH_X", "NDF_STRETCH_Y", "NDF_REACH", "NDF_SAMPLE"),
    reference={"D": _d, "area": _area},
    isotropic=False,
    from_roughness=lambda r: {"alpha_x": alpha_within(r, ALPHA_X), "alpha_y": alpha_within(r, ALPHA_Y)},
    checks=Checks(normalized=True, float32_error=8e-6),
    notes={
        "projected area": "closed, with erf",
        "tail": "D falls like exp(-tan²θ/α²)",
        "float32": "relative error of D at most 8e-6 where D > 1e-7 of its peak; 7e-7 (1 + |log(D/peak)|) below, "
        "0 below 1e-34 of it",
        "quadrature": "normalization within 4e-7 and 5e-15, weak furnace with Smith within 1e-6 and 2e-13 "
        "(float32 and float64), over the domain and n·v from 0 to 1",
        "limits": "D is 0 at grazing for every α",
    },
)
