"""Schlick's curve with a second reflectance of the metal, near grazing."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Model, Paper, Parameter


def _f(cos_d, f0, f82):
    """Mix 1, f0 and f82 linearly: the weight of 1 is (1 - c)⁵, that of f82 the share of the dip, f0 has the rest."""
    c = np.asarray(cos_d, np.float64)
    dip = (c / (1 / 7)) * ((1 - c) / (6 / 7)) ** 6
    grazing = (1 - c) ** 5 - dip * (6 / 7) ** 5
    return grazing + dip * f82 + (1 - dip - grazing) * f0


ENTRY = Model(
    slot="fresnel",
    name="schlick_f82",
    title="Schlick with F82",
    citation=Paper(
        "Kutz2021", "P. Kutz, M. Hašan, E. Edmondson, Novel Aspects of the Adobe Standard Material, Adobe, 2021"
    ),
    parameters=(
        Parameter("f0", "F0", "1", 0.0, 1.0, (0.04, 0.56, 0.95, 1.0), "reflectance at normal incidence"),
        Parameter(
            "f82",
            "F82",
            "1",
            0.0,
            1.0,
            (0.3, 0.6, 0.9, 1.0),
            "reflectance at cos θ = 1/7 (81.8°); itself, not a tint of Schlick's",
        ),
    ),
    provides=("FRESNEL_F",),
    reference={"F": _f},
    limits={"0°": lambda f0, f82: (1.0, f0), "81.8°": lambda f0, f82: (1 / 7, f82), "90°": lambda f0, f82: (0.0, 1.0)},
    checks=Checks(leaves_unit_range=True),
    notes={
        "at 0°": "f0",
        "at 81.8°": "f82",
        "at 90°": "1",
        "range": "[0, 1] for f82 from 25/49 S to S, Schlick's S = f0 + (1 - f0)(6/7)⁵ at cos θ = 1/7; down to "
        "-.127 below (f0 = f82 = 0, at cos θ = .26) and up to 1.127 above (f0 = 0, f82 = 1, at .06)",
    },
)
