"""Kelemen and Szirmay-Kalos' visibility, 1/(v·h)²."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Model, Paper


def _v(NoV, NoL, NoH, VoH, at_v, at_l):
    return np.asarray(VoH, np.float64) ** -2.0


def _g(NoV, NoL, NoH, VoH, at_v, at_l):
    return np.where(np.asarray(NoL) > 0, (np.asarray(NoL) / VoH) * (np.asarray(NoV) / VoH), 0.0)


ENTRY = Model(
    slot="masking",
    name="kelemen",
    title="Kelemen-Szirmay-Kalos",
    citation=Paper(
        "Kelemen2001",
        "C. Kelemen, L. Szirmay-Kalos, A Microfacet Based Coupled Specular-Matte BRDF Model with "
        "Importance Sampling, Eurographics short presentations, 2001",
    ),
    parameters=(),
    provides=("MASKING_AT", "MASKING_V", "MASKING_G"),
    reference={"V": _v, "G": _g},
    # A peak of 1/(v·h)² where both graze: the error of a rule is up to this many times its change from the one before.
    checks=Checks(reciprocal=True, slow_rules=8.0),
    notes={"follows roughness": False},
)
