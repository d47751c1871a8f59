"""Estevez and Kulla's masking of Charlie: Smith's form with a fitted Λ, and their softer terminator."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Model, Parameter
from whitefurnace.catalogue.ndf.charlie import ENTRY as CHARLIE

FITTED = np.array([[25.3245, 3.32435, 0.16801, -1.27393, -4.85967], [21.5473, 3.82987, 0.19823, -1.97760, -4.32054]])
"""a, b, c, d, e at α = 0 and at α = 1. [Estevez2017, table 1]"""

NEAREST = 1e-5
"""Cosine from which on c Λ(c) is held: the fit's Λ is finite at grazing, where V would be infinite."""


def _log_lambda(cosine, alpha):
    """log Λ, with the share α (2 - α) of the fit at α = 1 and x^c as a power."""
    cosine, alpha = np.asarray(cosine, np.float64), np.asarray(alpha, np.float64)
    share = alpha * (2 - alpha)
    a, b, c, d, e = ((1 - share) * zero + share * one for zero, one in FITTED.T)

    def fit(x):
        return a / (1 + b * np.power(x, c)) + d * x + e

    return np.where(cosine < 0.5, fit(cosine), 2 * fit(0.5) - fit(1 - np.minimum(cosine, 1.0)))


def _logs(NoV, NoL, alpha, softening):
    """log of c, of c Λ(v) and of c Λ(l)^soft, c held at NEAREST in the products: (log n·v, log n·l, …)."""
    held_v, held_l = (np.maximum(np.asarray(c, np.float64), NEAREST) for c in (NoV, NoL))
    soft = 1 + 2 * np.asarray(softening, np.float64) * (1 - held_l) ** 8
    a_v = np.log(held_v) + _log_lambda(held_v, alpha)
    a_l = np.log(held_l) + soft * _log_lambda(held_l, alpha)
    return np.log(np.asarray(NoV, np.float64)), np.log(np.asarray(NoL, np.float64)), a_v, a_l


def _g(NoV, NoL, NoH, VoH, at_v, at_l, alpha, softening):
    """1/(1 + Λ(v) + Λ(l)), the logarithms added as such; 0 at n·v = 0."""
    with np.errstate(divide="ignore"):
        v, light, a_v, a_l = _logs(NoV, np.where(np.asarray(NoL) > 0, NoL, 1.0), alpha, softening)
        return np.where(np.asarray(NoL) > 0, np.exp(-np.logaddexp(0.0, np.logaddexp(a_v - v, a_l - light))), 0.0)


def _v(NoV, NoL, NoH, VoH, at_v, at_l, alpha, softening):
    """1/((n·l)(n·v) + (n·l) a(v) + (n·v) a(l)), by logarithms too."""
    with np.errstate(divide="ignore"):
        v, light, a_v, a_l = _logs(NoV, np.where(np.asarray(NoL) > 0, NoL, 1.0), alpha, softening)
        total = np.logaddexp(v + light, np.logaddexp(light + a_v, v + a_l))
        return np.where(np.asarray(NoL) > 0, np.exp(-total), 0.0)


ENTRY = Model(
    slot="masking",
    name="estevez_kulla",
    title="Estevez-Kulla (fitted Λ of Charlie)",
    citation=CHARLIE.citation,
    parameters=(
        Parameter(
            "alpha",
            "α",
            "1",
            0.0,
            1.0,
            (1e-3, 0.01, 0.1, 0.3, 1.0),
            "roughness of the sheen, the square of the perceptual one; that of Charlie, unless another is wanted",
        ),
        Parameter(
            "softening",
            "s",
            "1",
            0.0,
            1.0,
            (0.0, 0.5, 1.0),
            "how far the terminator is softened: 0 not at all, 1 as Estevez and Kulla do it; not reciprocal above 0",
            default=0.0,
        ),
    ),
    provides=("MASKING_AT", "MASKING_V", "MASKING_G"),
    reference={"V": _v, "G": _g},
    made_for="charlie",
    from_roughness=lambda r: {"alpha": r * r},
    # Rounding of log Λ, which is up to 61, is a relative error of Λ.
    checks=Checks(
        reciprocal=False,
        reciprocal_at={"softening": 0.0},
        tolerance={"kernel V": (1e-5, 3e-14), "kernel G": (1e-5, 3e-14)},
    ),
    notes={
        "follows roughness": True,
        "reciprocal": "where softening is 0",
        "with Charlie": "it makes energy near grazing where r < .26: the albedo is at most 2.13, 1.20, .92, .81, .87, "
        ".94 for r = .1, .2, .3, .5, .7, 1; below n·v = 10⁻⁵, where the fit would make V infinite, c Λ(c) is held",
    },
)
