"""Cook and Torrance's geometry factor of V-grooves."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Model, Paper


def _v(NoV, NoL, NoH, VoH, at_v, at_l):
    """Return the smallest of the three terms of G, each divided by (n·l)(n·v) first."""
    NoV, NoL = np.asarray(NoV, np.float64), np.asarray(NoL, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        open_ = 2 * np.asarray(NoH) / VoH
        return np.where(NoL > 0, np.minimum(np.minimum(open_ / NoL, open_ / NoV), 1 / (NoL * NoV)), 0.0)


def _g(NoV, NoL, NoH, VoH, at_v, at_l):
    """Evaluate with 2(n·h)/(v·h) = (n·l + n·v)/(v·h)², since h is (l + v)/2 scaled to unit length."""
    NoV, NoL = np.asarray(NoV, np.float64), np.asarray(NoL, np.float64)
    return np.where(NoL > 0, np.minimum(1.0, (NoL + NoV) * np.minimum(NoL, NoV) / np.square(VoH)), 0.0)


ENTRY = Model(
    slot="masking",
    name="cook_torrance",
    title="Cook-Torrance",
    citation=Paper(
        "CookTorrance1982", "R. Cook, K. Torrance, A Reflectance Model for Computer Graphics, ACM TOG 1(1), 1982"
    ),
    parameters=(),
    provides=("MASKING_AT", "MASKING_V", "MASKING_G"),
    reference={"V": _v, "G": _g},
    # Kinks where the grooves begin to mask: a rule's error is up to this many times its change from the one before.
    checks=Checks(reciprocal=True, slow_rules=32.0),
    notes={"follows roughness": False},
)
