"""Schlick's approximation with f0 and f90."""
import numpy as np

from whitefurnace.catalogue.model import Model, Parameter


def _f(cos_d, f0, f90):
    weight = np.power(1 - np.asarray(cos_d, np.float64), 5.0)
    return f0 * (1 - weight) + f90 * weight


ENTRY = Model(
    slot="fresnel",
    name="schlick",
    title="Schlick",
    citation="Schlick1994",
    parameters=(
        Parameter("f0", "F0", "1", 0.0, 1.0, (0.02, 0.04, 0.17, 0.56, 0.95), "reflectance at normal incidence"),
        Parameter("f90", "F90", "1", 0.0, 1.0, (1.0,), "reflectance at grazing incidence", default=1.0),
    ),
    provides=("FRESNEL_F",),
    reference={"F": _f},
)
