"""No masking term at all: V = 1."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model


def _v(NoV, NoL, NoH, VoH, at_v, at_l):
    return np.ones(np.broadcast(NoV, NoL).shape)


def _g(NoV, NoL, NoH, VoH, at_v, at_l):
    return np.where(np.asarray(NoL) > 0, np.asarray(NoV) * np.asarray(NoL), 0.0)


ENTRY = Model(
    slot="masking",
    name="implicit",
    title="Implicit (V = 1)",
    citation=cited("Hoffman2012"),
    parameters=(),
    provides=("MASKING_AT", "MASKING_V", "MASKING_G"),
    reference={"V": _v, "G": _g},
    checks=Checks(reciprocal=True),
    notes={"follows roughness": False},
)
