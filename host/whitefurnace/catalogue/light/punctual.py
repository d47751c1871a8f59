"""A punctual light."""

import math

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Model, Parameter


def _c(normal, NoL, phi_l, color):
    """Evaluate by the polar angle and azimuth of both directions, with the spherical law of cosines."""
    normal, NoL = np.asarray(normal, np.float64), np.asarray(NoL, np.float64)
    azimuth = np.arctan2(normal[..., 1], normal[..., 0]) - phi_l
    sines = np.hypot(normal[..., 0], normal[..., 1]) * np.sin(np.arccos(NoL))
    return color * np.maximum(normal[..., 2] * NoL + sines * np.cos(azimuth), 0)


ENTRY = Model(
    slot="light",
    name="punctual",
    title="Punctual",
    citation=cited("Hoffman2012"),
    parameters=(
        Parameter("NoL", "n·l", "1", -1.0, 1.0, (0.05, 0.5, 1.0), "cosine of the light's angle; below 0 it gives 0"),
        Parameter("phi_l", "φl", "rad", -1e6, 1e6, (0.0, math.pi / 2, math.pi), "azimuth of the light", default=0.0),
        Parameter(
            "color",
            "c",
            "W/(m²·sr)",
            0.0,
            1e30,
            (0.1, 1.0, 10.0),
            "radiance of a white Lambertian that faces the light",
            default=1.0,
        ),
    ),
    provides=("LIGHT_C",),
    reference={"C": _c},
    notes={"reflected": "π f(l, v) c (n·l)", "white Lambertian facing it": "c"},
)
