"""Smith's masking times Smith's shadowing, for any NDF."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model


def _g1(NoV, at_v):
    """Evaluate by Λ = A/(n·v) - 1, infinite at n·v = 0. [Heitz2014, eq. 43]"""
    with np.errstate(divide="ignore"):
        return 1 / (1 + (np.asarray(at_v, np.float64) / NoV - 1))


def _g(NoV, NoL, NoH, VoH, at_v, at_l):
    """1/((1 + Λ(v))(1 + Λ(l))). [Heitz2014, eq. 98]"""
    NoL = np.asarray(NoL, np.float64)
    return np.where(NoL > 0, _g1(NoV, at_v) * _g1(np.where(NoL > 0, NoL, 1.0), at_l), 0.0)


def _v(NoV, NoL, NoH, VoH, at_v, at_l):
    with np.errstate(divide="ignore"):
        return np.where(np.asarray(NoL) > 0, np.asarray(at_v, np.float64) ** -1.0 * np.asarray(at_l) ** -1.0, 0.0)


ENTRY = Model(
    slot="masking",
    name="smith_separable",
    title="Smith, separable",
    citation=cited("Walter2007"),
    parameters=(),
    provides=("MASKING_AT", "MASKING_V", "MASKING_G", "MASKING_G1"),
    needs=("NDF_AREA",),
    reference={"V": _v, "G": _g, "G1": _g1},
    checks=Checks(reciprocal=True, weak_furnace=1.0),
    notes={"follows roughness": True},
)
