"""GGX (Trowbridge-Reitz)."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter
from whitefurnace.catalogue.roughness import alpha_within

ALPHA = Parameter(
    "alpha", "α", "1", 1e-5, 1.0, (1e-4, 1e-3, 0.01, 0.05, 0.2, 0.5, 1.0), "roughness, the square of the perceptual one"
)


def _d(theta_m, alpha):
    """Evaluate by slopes: D = P22(tan θ) / cos⁴θ, P22 = 1/(πα²(1 + tan²θ/α²)²). [Heitz2014, app. A]"""
    theta_m = np.asarray(theta_m, np.float64)
    tan2 = np.tan(theta_m) ** 2
    density = 1 / (np.pi * alpha**2 * (1 + tan2 / alpha**2) ** 2)
    return np.where(np.cos(theta_m) > 0, density * (1 + tan2) ** 2, 0.0)


def _area(theta_v, alpha):
    """cos θ (1 + Λ), Λ = (√(1 + 1/a²) - 1)/2, a = 1/(α tan θ). [Heitz2014, eq. 72]"""
    theta_v = np.asarray(theta_v, np.float64)
    return np.cos(theta_v) * (1 + (np.sqrt(1 + (alpha * np.tan(theta_v)) ** 2) - 1) / 2)


ENTRY = Model(
    slot="ndf",
    name="ggx",
    title="GGX (Trowbridge-Reitz)",
    citation=cited("Walter2007"),
    parameters=(ALPHA,),
    provides=("NDF_D", "NDF_AREA", "NDF_WIDTH", "NDF_SAMPLE"),
    reference={"D": _d, "area": _area},
    from_roughness=lambda r: {"alpha": alpha_within(r, ALPHA)},
    past_one=lambda r: {"alpha": r * r},  # thin at the pole then, and still a density
    checks=Checks(normalized=True, float32_error=8e-7),
    notes={
        "projected area": "closed",
        "tail": "D falls like 1/sin⁴θ",
        "float32": "relative error of D at most 8e-7",
        "quadrature": "normalization within 3e-7 and 4e-15, weak furnace with Smith within 1e-6 and 2e-14 "
        "(float32 and float64), over the domain and n·v from 0 to 1",
        "limits": "uniform at α = 1",
    },
)
