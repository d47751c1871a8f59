"""Ashikhmin's masking of cloth in the form of Neubelt and Pettineo, which engines use for sheen."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Model, Paper


def _g(NoV, NoL, NoH, VoH, at_v, at_l):
    """Evaluate Smith's form 1/(1 + Λ(v) + Λ(l)) with Λ(c) = 1/c - 1, infinite at c = 0."""
    NoL = np.asarray(NoL, np.float64)
    with np.errstate(divide="ignore"):
        lambda_v, lambda_l = 1 / np.asarray(NoV, np.float64) - 1, 1 / np.where(NoL > 0, NoL, 1.0) - 1
    return np.where(NoL > 0, 1 / (1 + lambda_v + lambda_l), 0.0)


def _v(NoV, NoL, NoH, VoH, at_v, at_l):
    """Evaluate 1/(1 - (1 - n·l)(1 - n·v)) from logarithms of the complements, which are exact at grazing angles."""
    NoV, NoL = np.asarray(NoV, np.float64), np.asarray(NoL, np.float64)
    with np.errstate(divide="ignore"):
        complements = np.log1p(-NoV) + np.log1p(-np.maximum(NoL, 0.0))
        return np.where(NoL > 0, -1 / np.expm1(complements), 0.0)


ENTRY = Model(
    slot="masking",
    name="ashikhmin",
    title="Ashikhmin-Neubelt (sheen of engines)",
    citation=Paper(
        "Neubelt2013",
        "D. Neubelt, M. Pettineo, Crafting a Next-Gen Material Pipeline for The Order: 1886, SIGGRAPH 2013 course",
    ),
    also_cited=(
        Paper("Ashikhmin2007", "M. Ashikhmin, S. Premože, Distribution-based BRDFs, University of Utah, 2007"),
    ),
    parameters=(),
    made_for="charlie",
    provides=("MASKING_AT", "MASKING_V", "MASKING_G"),
    reference={"V": _v, "G": _g},
    checks=Checks(reciprocal=True),
    notes={
        "follows roughness": False,
        "with Charlie": "the sheen of engines; it makes energy near grazing where r < .46: the albedo passes 1 at n·v "
        "below .091, .086, .053 for r = .1, .2, .3, and at n·v = 0 it is 4.02, 2.05, 1.42, "
        "then .94 and .64 for r = .5 and 1",
    },
)
