"""Charlie, the sheen of Estevez and Kulla."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Model, Paper, Parameter
from whitefurnace.catalogue.roughness import alpha_within

# At 1e-3 the lobe is a rim of 3° at grazing (to a quarter of the peak): below, nothing of a cloth is left.
ALPHA = Parameter(
    "alpha",
    "α",
    "1",
    1e-3,
    1.0,
    (1e-3, 0.01, 0.05, 0.1, 0.3, 0.5, 1.0),
    "roughness of the sheen, the square of the perceptual one: small is a thin rim at grazing",
)


def _d(theta_m, alpha):
    """Evaluate (2 + 1/α)/(2π) sin^(1/α) θ with log sin θ = -½ log(1 + cot²θ). [Estevez2017]"""
    theta_m = np.asarray(theta_m, np.float64)
    with np.errstate(divide="ignore"):  # the log is -∞ along n, where D is 0
        log_sin = -0.5 * np.log1p(1 / np.tan(theta_m) ** 2)
    return np.where(np.cos(theta_m) > 0, (2 + 1 / alpha) / (2 * np.pi) * np.exp(log_sin / alpha), 0.0)


ENTRY = Model(
    slot="ndf",
    name="charlie",
    title="Charlie sheen",
    citation=Paper(
        "Estevez2017", "A. C. Estevez, C. Kulla, Production Friendly Microfacet Sheen BRDF, SIGGRAPH 2017 course"
    ),
    parameters=(ALPHA,),
    provides=("NDF_D", "NDF_WIDTH", "NDF_SAMPLE"),
    reference={"D": _d},
    from_roughness=lambda r: {"alpha": alpha_within(r, ALPHA)},
    # A rim of 3° at grazing: an ulp of the cosine is 1e-6 of D.
    checks=Checks(normalized=True, float32_error=4.6e-6, tolerance={"weak furnace": (2e-6, 1e-12)}),
    notes={
        "tail": "none: D rises like sin^(1/α) θ from 0 along n to its peak at grazing",
        "float32": "relative error of D at most 4.6e-6 where D > 1e-7 of its peak; 3e-7 (1 + |log(D/peak)|) below, "
        "0 below 1e-38 of it",
        "quadrature": "normalization within 3e-7 and 8e-15, weak furnace with Smith within 1.5e-6 and 5e-13 "
        "(float32 and float64), over the domain and n·v from 0 to 1",
        "limits": "a rim at grazing for α → 0",
    },
)
