"""Schlick's approximation of a Smith term, by its own roughness."""

import math

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter


def _k(alpha):
    return np.asarray(alpha, np.float64) * math.sqrt(2 / math.pi)


def _g1(NoV, at_v, alpha):
    """Evaluate 1/(1 + Λ) with Λ = k (1/c - 1), infinite at c = 0."""
    with np.errstate(divide="ignore"):
        return 1 / (1 + _k(alpha) * (1 / np.asarray(NoV, np.float64) - 1))


def _g(NoV, NoL, NoH, VoH, at_v, at_l, alpha):
    NoL = np.asarray(NoL, np.float64)
    return np.where(NoL > 0, _g1(NoV, at_v, alpha) * _g1(np.where(NoL > 0, NoL, 1.0), at_l, alpha), 0.0)


def _v(NoV, NoL, NoH, VoH, at_v, at_l, alpha):
    """Evaluate a linear function in each cosine: k at 0, 1 at 1."""
    k, NoL = _k(alpha), np.asarray(NoL, np.float64)
    with np.errstate(divide="ignore"):
        return np.where(NoL > 0, 1 / ((NoV * (1 - k) + k) * (NoL * (1 - k) + k)), 0.0)


ENTRY = Model(
    slot="masking",
    name="schlick_smith",
    title="Schlick's approximation of Smith",
    citation=cited("Schlick1994"),
    parameters=(
        Parameter(
            "alpha",
            "α",
            "1",
            1e-5,
            1.0,
            (1e-4, 0.01, 0.1, 0.5, 1.0),
            "roughness, the square of the perceptual one; that of the NDF, unless something else is wanted",
        ),
    ),
    provides=("MASKING_AT", "MASKING_V", "MASKING_G", "MASKING_G1"),
    reference={"V": _v, "G": _g, "G1": _g1},
    from_roughness=lambda r: {"alpha": r * r},
    checks=Checks(reciprocal=True),
    notes={
        "follows roughness": True,
        # Below Smith everywhere but at n·v = 1, at grazing by Smith's slope over this one's: A(0)/(α√(2/π)).
        "G1 less Smith's": "Beckmann: -.455, -.441, -.388, -.335 at most for α = .01, .1, .5, 1 "
        "(at n·v = .006, .06, .24, .39); GGX: -.270, -.249, -.177, -.116 (at .010, .09, .30, .39)",
        "weak furnace, deviation": "Beckmann: down to -.646, 1/√8 - 1, at grazing for every α; "
        "GGX: to -.388, -.380, -.373, -.373 for α = .01, .1, .5, 1",
        "caution": "not the Smith term of any NDF: it approximates another function [Hoffman2012]; use smith",
    },
)
