"""No Fresnel term: F = 1."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Model

ENTRY = Model(
    slot="fresnel",
    name="one",
    title="None (F = 1)",
    citation=cited("Hoffman2012"),
    parameters=(),
    provides=("FRESNEL_F",),
    reference={"F": lambda cos_d: np.ones_like(np.asarray(cos_d, np.float64))},
    limits={"0°": lambda: (1.0, 1.0), "90°": lambda: (0.0, 1.0)},
    notes={"at 0°": "1", "at 90°": "1"},
)
