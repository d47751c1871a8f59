"""Ambient light."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Model, Parameter


def _l(light, radiance):
    """A constant environment: every direction, those below the surface too."""
    return np.broadcast_to(
        np.asarray(radiance, np.float64), np.broadcast_shapes(np.shape(light)[:-1], np.shape(radiance))
    )


ENTRY = Model(
    slot="light",
    name="ambient",
    title="Ambient",
    citation=cited("Hoffman2012"),
    parameters=(
        Parameter(
            "radiance", "L", "W/(m²·sr)", 0.0, 1e30, (0.1, 1.0, 10.0), "radiance from every direction", default=1.0
        ),
    ),
    provides=("LIGHT_L",),
    reference={"L": _l},
    notes={"reflected": "the directional albedo times the radiance"},
)
