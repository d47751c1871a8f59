"""Lambert's diffuse."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter


def _f(light, view, albedo):
    return np.divide(albedo, np.pi) * np.ones(np.broadcast(light[..., 2], view[..., 2]).shape)


ENTRY = Model(
    slot="diffuse",
    name="lambert",
    title="Lambert",
    citation=cited("Hoffman2012"),
    parameters=(Parameter("albedo", "ρ", "1", 0.0, 1.0, (0.18, 0.8, 1.0), "fraction of light reflected"),),
    provides=("DIFFUSE_F",),
    reference={"f": _f, "albedo": lambda NoV, albedo: np.asarray(albedo, np.float64) * np.ones_like(NoV)},
    checks=Checks(reciprocal=True, largest_albedo=1.0),
    notes={"energy": "conserving"},
)
