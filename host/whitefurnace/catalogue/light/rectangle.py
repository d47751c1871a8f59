"""A rectangle of constant radiance."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Model, Parameter

_FAR = 1e9
_TYPICAL = {"u": (0.5, 0.0, 0.1), "v": (0.0, -0.8, 0.2)}


def _l(light, center_x, center_y, center_z, u_x, u_y, u_z, v_x, v_y, v_z, radiance):
    """Evaluate by solving t l = c + a u + b v for (t, a, b)."""
    light = np.asarray(light, np.float64)
    center, u, v = (
        np.stack(np.broadcast_arrays(*axes), -1).astype(np.float64)
        for axes in ((center_x, center_y, center_z), (u_x, u_y, u_z), (v_x, v_y, v_z))
    )
    shape = np.broadcast_shapes(light.shape, center.shape, u.shape, v.shape)
    light, center, u, v = (np.broadcast_to(a, shape) for a in (light, center, u, v))
    matrix = np.stack([light, -u, -v], -1)
    facing = ((np.cross(u, v) * light).sum(-1) < 0) & ((np.cross(u, v) * center).sum(-1) < 0)
    matrix = np.where(facing[..., None, None], matrix, np.eye(3))
    _, a, b = np.moveaxis(np.linalg.solve(matrix, center[..., None])[..., 0], -1, 0)
    return np.where(facing & (np.abs(a) <= 1) & (np.abs(b) <= 1), radiance, 0.0)


ENTRY = Model(
    slot="light",
    name="rectangle",
    title="Rectangle",
    citation=cited("Hoffman2012"),
    parameters=(
        *(
            Parameter(f"center_{axis}", f"c{axis}", "any length", -_FAR, _FAR, (typical,), f"{axis} of the centre")
            for axis, typical in zip("xyz", (0.3, -0.2, 1.0), strict=True)
        ),
        *(
            Parameter(
                f"{edge}_{axis}",
                f"{edge}{axis}",
                "any length",
                -_FAR,
                _FAR,
                (typical,),
                f"{axis} of the half edge {edge}",
            )
            for edge in "uv"
            for axis, typical in zip("xyz", _TYPICAL[edge], strict=True)
        ),
        Parameter("radiance", "L", "W/(m²·sr)", 0.0, 1e30, (1.0,), "radiance of every point of it", default=1.0),
    ),
    provides=("LIGHT_L",),
    reference={"L": _l},
    notes={"sides": "one: where u × v points", "horizon": "what is below it gives nothing"},
)
