"""Tables of the radiance that a surface reflects from a light or an environment."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from whitefurnace.errors import UsageError
from whitefurnace.tables.kinds.integrals import OfIntegral

if TYPE_CHECKING:
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.tables.cells import Cells, Lighting
    from whitefurnace.tables.request import TableRequest


class Radiance(OfIntegral):
    """The kind `radiance`: light that a surface reflects from a light source or an environment."""

    name = "radiance"
    summary = "Light reflected from a light source or an environment"
    help = "Needs --light or --environment; of an environment the table has the channels R, G and B."

    def usual_tolerance(self, request: TableRequest) -> float | None:
        from whitefurnace.integrals.radiance import ENVIRONMENT_TOLERANCE

        return None if request.environment is None else ENVIRONMENT_TOLERANCE[request.precision]

    def lighting(self, request: TableRequest) -> Lighting:
        from whitefurnace.catalogue.choice import chosen
        from whitefurnace.sphere.bad_pixels import check_bad_pixels
        from whitefurnace.sphere.environments import Reading, read_environment
        from whitefurnace.tables.cells import Lighting

        light, around = request.light, request.environment
        if (light is None) == (around is None):
            raise UsageError("integral radiance needs either a light or an environment")
        if light is not None:
            wrong = [name for name in request.lighting() if name != "light"]
            if wrong:
                raise UsageError(f"{wrong[0]} is of an environment; a light lies in the surface's frame")
            return Lighting({"light": chosen("light", light)})
        assert around is not None
        reading = Reading(
            request.rotate,
            request.exposure,
            check_bad_pixels(request.bad_pixels, request.nonfinite),
            request.layout,
            request.layer,
            request.fill,
        )
        env = read_environment(around, reading)
        up = (0.0, 1.0, 0.0) if request.normal is None else tuple(map(float, request.normal))
        return Lighting(
            {"environment": env, "normal": up},
            {
                "environment": {
                    "sha256": env.digest,
                    "rotate": round(math.degrees(env.rotation), 9),
                    "exposure": env.exposure,
                    **reading.recipe(),
                    "normal": list(up),
                }
            },
        )

    def spec(self, cells: Cells) -> TableSpec:
        from whitefurnace.integrals.radiance import radiance_spec

        return radiance_spec(light=cells.lighting.arguments.get("light"), **cells.arguments)


KINDS = (Radiance(),)
