"""Fresnel's equations between two insulators."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Kinks, Model, Parameter
from whitefurnace.catalogue.numerics import critical_angles


def _f(cos_d, ior):
    """Evaluate amplitudes by the angles, as Fresnel wrote them, with n cos θt = √(n² - sin²θ) by Snell's law."""
    c, n = np.broadcast_arrays(np.asarray(cos_d, np.float64), np.asarray(ior, np.float64))
    square = (n - 1) * (n + 1) + c**2
    cos_t = np.sqrt(np.maximum(square, 0.0)) / n
    tiny = 1e-300  # c = 0 and n = 1: no boundary, no reflection
    r_s = (c - n * cos_t) / (c + n * cos_t + tiny)
    r_p = (n * c - cos_t) / (n * c + cos_t + tiny)
    return np.where(square >= 0, (r_s**2 + r_p**2) / 2, 1.0)


ENTRY = Model(
    slot="fresnel",
    name="dielectric",
    title="Fresnel, dielectric",
    citation=cited("Walter2007"),
    parameters=(
        Parameter(
            "ior",
            "n",
            "1",
            0.2,
            5.0,
            (0.4, 0.75, 1.0, 1.333, 1.5, 2.417, 5.0),
            "index of the far side over that of this side; below 1 there is total internal reflection",
        ),
    ),
    provides=("FRESNEL_F",),
    reference={"F": _f},
    limits={
        "0°": lambda ior: (1.0, ((ior - 1) / (ior + 1)) ** 2),
        "90°": lambda ior: (0.0, np.where(ior == 1, 0.0, 1.0)),
        # tan θ = n, where r_p is 0 and r_s = (1 - n²)/(1 + n²).
        "Brewster's angle": lambda ior: (1 / np.hypot(1, ior), ((1 - ior**2) / (1 + ior**2)) ** 2 / 2),
        # cos θ of half the critical one's: sin²θ > n².
        "total internal reflection": lambda ior: (
            np.sqrt(np.maximum(1 - ior**2, 0)) / 2,
            np.where(ior < 1, 1.0, np.nan),
        ),
    },
    kinks=Kinks(1, lambda NoV, ior: critical_angles(NoV, np.where(ior < 1, ior, np.nan))),
    # The root at the critical angle of n < 1: rules without a panel there gain less on one another than they are off.
    checks=Checks(slow_rules=6.0),
    notes={
        "at 0°": "((n - 1)/(n + 1))²",
        "at 90°": "1, but 0 for n = 1",
        "float32": "absolute error ≤ 6e-7 everywhere, the critical angle included",
        "critical angle": "F leaves 1 like a square root: float64 beside it is good to 1e-7",
    },
    presets={"water": {"ior": 1.333}, "glass": {"ior": 1.5}, "diamond": {"ior": 2.417}},
)
