"""Neumann's G = min(n·l, n·v)."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Kinks, Model, Paper


def _g(NoV, NoL, NoH, VoH, at_v, at_l):
    return np.clip(np.minimum(NoL, NoV), 0.0, None)


def _v(NoV, NoL, NoH, VoH, at_v, at_l):
    """min(1/(n·l), 1/(n·v)), infinite where both graze."""
    with np.errstate(divide="ignore"):
        return np.where(np.asarray(NoL) > 0, np.minimum(1 / np.abs(NoL), 1 / np.asarray(NoV, np.float64)), 0.0)


def _angles(NoV):
    """Return θv: only the rings within it have directions with n·l = n·v."""
    return np.arccos(np.asarray(NoV, np.float64))[None]


ENTRY = Model(
    slot="masking",
    name="neumann",
    title="Neumann",
    citation=Paper(
        "Neumann1999", "L. Neumann, A. Neumann, L. Szirmay-Kalos, Compact Metallic Reflectance Models, CGF 18(3), 1999"
    ),
    parameters=(),
    provides=("MASKING_AT", "MASKING_V", "MASKING_G"),
    reference={"V": _v, "G": _g},
    # A kink at n·l = n·v: the error of a rule is up to this many times its change from the one before.
    kinks=Kinks(1, _angles),
    checks=Checks(reciprocal=True, slow_rules=16.0),
    notes={"follows roughness": False},
)
