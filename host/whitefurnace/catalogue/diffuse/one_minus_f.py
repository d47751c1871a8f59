"""Lambert times what Schlick's Fresnel leaves at n·l: the plain form."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter


def _f(light, view, albedo, f0):
    fresnel = f0 + (1 - np.asarray(f0, np.float64)) * (1 - light[..., 2]) ** 5
    return albedo / np.pi * (1 - fresnel) * np.ones_like(view[..., 2])


def _albedo(NoV, albedo, f0):
    """2∫μ(1 - (1 - μ)⁵)dμ = 1 - 2(1/6 - 1/7) = 20/21."""
    return np.asarray(albedo, np.float64) * (1 - np.asarray(f0)) * (20 / 21) * np.ones_like(NoV)


ENTRY = Model(
    slot="diffuse",
    name="one_minus_f",
    title="Lambert × (1 - F), plain",
    citation=cited("Hoffman2012"),
    parameters=(
        Parameter("albedo", "ρ", "1", 0.0, 1.0, (0.18, 0.8, 1.0), "fraction reflected of the light that enters"),
        Parameter("f0", "F0", "1", 0.0, 1.0, (0.02, 0.04, 0.17), "reflectance of the surface at normal incidence"),
    ),
    provides=("DIFFUSE_F",),
    reference={"f": _f, "albedo": _albedo},
    checks=Checks(reciprocal=False, largest_albedo=20 / 21),
    notes={"energy": "conserving"},
)
