"""Schlick's approximation with f0 and f90."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Model, Parameter


def _f(cos_d, f0, f90):
    weight = np.power(1 - np.asarray(cos_d, np.float64), 5.0)
    return f0 * (1 - weight) + f90 * weight


# F(0°), linear, of "Real-Time Rendering", 3rd edition, as [Hoffman2012] has it.
_METALS = {
    "gold": (1.00, 0.71, 0.29),
    "silver": (0.95, 0.93, 0.88),
    "copper": (0.95, 0.64, 0.54),
    "iron": (0.56, 0.57, 0.58),
    "aluminum": (0.91, 0.92, 0.92),
}
_INSULATORS = {
    "water": 0.02,
    "plastic": 0.03,  # "Plastic / Glass (Low)", under each of its names
    "plastic_low": 0.03,
    "glass_low": 0.03,
    "plastic_high": 0.05,
    "glass_high": 0.08,  # "Glass (High) / Ruby"
    "ruby": 0.08,
    "diamond": 0.17,
}

ENTRY = Model(
    slot="fresnel",
    name="schlick",
    title="Schlick",
    citation=cited("Schlick1994"),
    parameters=(
        Parameter("f0", "F0", "1", 0.0, 1.0, (0.02, 0.04, 0.17, 0.56, 0.95), "reflectance at normal incidence"),
        Parameter("f90", "F90", "1", 0.0, 1.0, (1.0,), "reflectance at grazing incidence", default=1.0),
    ),
    provides=("FRESNEL_F",),
    reference={"F": _f},
    limits={"0°": lambda f0, f90: (1.0, f0), "90°": lambda f0, f90: (0.0, f90)},
    notes={"at 0°": "f0", "at 90°": "f90", "presets": "F(0°), linear, from the tables of [Hoffman2012]"},
    presets={name: {"f0": f0} for name, f0 in _METALS.items()}
    | {name: {"f0": (f0, f0, f0)} for name, f0 in _INSULATORS.items()},
)
