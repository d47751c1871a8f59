"""Phong, as an NDF."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter
from whitefurnace.catalogue.roughness import alpha_within, exponent_of_alpha

EXPONENT = Parameter(
    "exponent",
    "n",
    "1",
    0.0,
    1e6,
    (0.0, 1.0, 10.0, 100.0, 1e4, 1e6),
    "power of the cosine, 2/α² - 2; 0 is the uniform lobe",
)
# α of the largest exponent.
_ALPHA = Parameter("alpha", "α", "1", (2 / (EXPONENT.high + 2)) ** 0.5, 1.0, (), "Beckmann's α of the same peak")


def _d(theta_m, exponent):
    """Evaluate (n + 2)/(2π) cosⁿθ with log cos θ = -½ log(1 + tan²θ). [Walter2007, eq. 30]"""
    theta_m = np.asarray(theta_m, np.float64)
    log_cos = -0.5 * np.log1p(np.tan(theta_m) ** 2)
    return np.where(np.cos(theta_m) > 0, (exponent + 2) / (2 * np.pi) * np.exp(exponent * log_cos), 0.0)


ENTRY = Model(
    slot="ndf",
    name="phong",
    title="Phong",
    citation=cited("Walter2007"),
    parameters=(EXPONENT,),
    provides=("NDF_D", "NDF_WIDTH", "NDF_REACH", "NDF_SAMPLE"),
    reference={"D": _d},
    from_roughness=lambda r: {"exponent": np.clip(exponent_of_alpha(alpha_within(r, _ALPHA)), 0.0, EXPONENT.high)},
    # A power of cos θ below 1 leaves a root at grazing, seen along n: 4e-12 in the table of its area.
    checks=Checks(normalized=True, float32_error=4e-6, tolerance={"weak furnace": (1.25e-6, 1e-11)}),
    notes={
        "tail": "D falls like cosⁿθ, to 0 at grazing",
        "float32": "relative error of D at most 4e-6 where D > 1e-7 of its peak; 2.5e-7 (1 + |log(D/peak)|) below, "
        "0 below 1e-38 of it",
        "quadrature": "normalization within 2e-7 and 4e-15, weak furnace with Smith within 1e-6 and 4e-12 "
        "(float32 and float64), over the domain and n·v from 0 to 1",
        "limits": "uniform at n = 0",
    },
)
