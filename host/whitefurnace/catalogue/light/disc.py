"""A disc of constant radiance."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Model, Parameter

_FAR = 1e9


def _l(light, center_x, center_y, center_z, normal_x, normal_y, normal_z, radius, radiance):
    """Evaluate by the distance of the ray's intersection from the disc's axis, as the length of a cross product."""
    light = np.asarray(light, np.float64)
    center = np.stack(np.broadcast_arrays(center_x, center_y, center_z), -1).astype(np.float64)
    normal = np.stack(np.broadcast_arrays(normal_x, normal_y, normal_z), -1).astype(np.float64)
    towards, height = -(light * normal).sum(-1), -(center * normal).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = light * (height / towards)[..., None] - center
        off = np.linalg.norm(np.cross(apart, normal), axis=-1) / np.linalg.norm(normal, axis=-1)
    return np.where((towards > 0) & (height > 0) & (off <= radius), radiance, 0.0)


ENTRY = Model(
    slot="light",
    name="disc",
    title="Disc",
    citation=cited("Hoffman2012"),
    parameters=(
        *(
            Parameter(f"center_{axis}", f"c{axis}", "any length", -_FAR, _FAR, (typical,), f"{axis} of the centre")
            for axis, typical in zip("xyz", (0.3, -0.2, 1.0), strict=True)
        ),
        *(
            Parameter(
                f"normal_{axis}",
                f"k{axis}",
                "any length",
                -_FAR,
                _FAR,
                (typical,),
                f"{axis} of the normal, of any length: the side that shines",
                default=down,
            )
            for axis, typical, down in zip("xyz", (0.1, 0.2, -1.0), (0.0, 0.0, -1.0), strict=True)
        ),
        Parameter("radius", "R", "any length", 1e-6, _FAR, (0.1, 1.0), "that of the disc"),
        Parameter("radiance", "L", "W/(m²·sr)", 0.0, 1e30, (1.0,), "radiance of every point of it", default=1.0),
    ),
    provides=("LIGHT_L",),
    reference={"L": _l},
    notes={"sides": "one: where the normal points", "horizon": "what is below it gives nothing"},
)
