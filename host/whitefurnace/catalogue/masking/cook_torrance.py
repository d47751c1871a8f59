"""Cook and Torrance's geometry factor of V-grooves."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Kinks, Model, Paper


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


def _angles(NoV):
    """Return the angles at which the terms of G cross in the plane of incidence, and 45°, where all three cross.

    2(n·h)(n·v) = v·h there for tan θ tan θv = 1, and 2(n·h)(n·l) = v·h for tan θ tan(2θ ∓ θv) = 1. Beyond 45° only
    n·l = n·v counts.
    """
    view = np.arccos(np.asarray(NoV, np.float64))
    steep = view > np.pi / 4
    return np.stack(
        [
            np.full_like(view, np.pi / 4),
            (np.pi / 2 - view) / 3,
            np.where(steep, np.pi / 2 - view, (np.pi / 2 + view) / 3),
            np.where(steep, view, np.nan),
        ]
    )


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
    kinks=Kinks(2, _angles),
    checks=Checks(reciprocal=True, slow_rules=32.0),
    notes={"follows roughness": False},
)
