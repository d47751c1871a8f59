"""Smith's masking-shadowing, height-correlated, for any NDF."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model


def _g1(NoV, at_v):
    """Evaluate by Λ = A/(n·v) - 1, infinite at n·v = 0. [Heitz2014, eq. 43]"""
    with np.errstate(divide="ignore"):
        return 1 / (1 + (np.asarray(at_v, np.float64) / NoV - 1))


def _g(NoV, NoL, NoH, VoH, at_v, at_l):
    """Evaluate by Λ. [Heitz2014, eq. 99]"""
    NoL = np.asarray(NoL, np.float64)
    with np.errstate(divide="ignore"):
        lambda_v, lambda_l = np.asarray(at_v, np.float64) / NoV - 1, np.asarray(at_l) / np.where(NoL > 0, NoL, 1.0) - 1
    return np.where(NoL > 0, 1 / (1 + lambda_v + lambda_l), 0.0)


def _v(NoV, NoL, NoH, VoH, at_v, at_l):
    """Evaluate the separable V divided by the factor that correlation adds, G1(v) + G1(l) - G1(v) G1(l)."""
    NoL = np.asarray(NoL, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        g1_v, g1_l = NoV / np.asarray(at_v, np.float64), NoL / np.asarray(at_l, np.float64)
        return np.where(NoL > 0, 1 / (np.asarray(at_v) * at_l * (g1_v + g1_l - g1_v * g1_l)), 0.0)


ENTRY = Model(
    slot="masking",
    name="smith",
    title="Smith, height-correlated",
    citation=cited("Heitz2014"),
    parameters=(),
    provides=("MASKING_AT", "MASKING_V", "MASKING_G", "MASKING_G1"),
    needs=("NDF_AREA",),
    reference={"V": _v, "G": _g, "G1": _g1},
    checks=Checks(reciprocal=True, weak_furnace=1.0),
    notes={"follows roughness": True},
)
