"""Lambert times what Schlick's Fresnel leaves at n·l and at n·v: the reciprocal form."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter


def _through(c, f0):
    """Return 1 - F."""
    return 1 - (f0 + (1 - np.asarray(f0, np.float64)) * (1 - np.asarray(c, np.float64)) ** 5)


def _f(light, view, albedo, f0):
    return albedo / np.pi * _through(light[..., 2], f0) * _through(view[..., 2], f0)


def _albedo(NoV, albedo, f0):
    """Integrate as in the plain form: 2∫μ(1 - F)dμ = (1 - f0) 20/21."""
    return np.asarray(albedo, np.float64) * _through(NoV, f0) * (1 - np.asarray(f0)) * (20 / 21)


ENTRY = Model(
    slot="diffuse",
    name="one_minus_f_reciprocal",
    title="Lambert × (1 - F)(1 - F), reciprocal",
    citation=cited("Hoffman2012"),
    parameters=(
        Parameter("albedo", "ρ", "1", 0.0, 1.0, (0.18, 0.8, 1.0), "fraction reflected of the light that enters"),
        Parameter("f0", "F0", "1", 0.0, 1.0, (0.02, 0.04, 0.17), "reflectance of the surface at normal incidence"),
    ),
    provides=("DIFFUSE_F",),
    reference={"f": _f, "albedo": _albedo},
    checks=Checks(reciprocal=True, largest_albedo=20 / 21),
    notes={"energy": "conserving"},
)
