"""The public `integrate`: integrals of a BRDF alone go to `run`, reflected radiance to `radiance`, imported when it is
first asked for, since it reads images."""
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from whitefurnace.catalogue.choice import Spec
from whitefurnace.errors import UsageError
from whitefurnace.integrals import quadrature as run
from whitefurnace.integrals.quadrature import Progress
from whitefurnace.opencl.device import Device
from whitefurnace.results import Integrated

if TYPE_CHECKING:
    from whitefurnace.sphere.environments import Environment


def integrate(name: str, *, ndf: Spec | None = None, masking: Spec = "smith", fresnel: Spec = "one",
              diffuse: Spec | None = None, brdf: Spec | None = None, light: Spec | None = None,
              environment: str | np.ndarray | Environment | None = None, normal: Sequence[float] | None = None,
              rotate: float = 0.0, exposure: float = 0.0, nonfinite: str = "refuse", precision: int = 32,
              tolerance: float | None = None, backfacing: str | None = None, device: Device | str | None = None,
              out: np.ndarray | None = None, progress: Progress | None = None, **parameters: Any) -> Integrated:
    """Integrates `name` of the catalogue over all broadcast `parameters`.

    name: normalization, projected_area, weak_furnace, albedo, albedo_average, dfg or radiance.
    ndf, masking, fresnel, diffuse: names (`ggx`, `ggx:alpha=.3`, `schlick:gold`), catalogue entries, or for an NDF the
        path of a `.clh` file. With a diffuse model, the BRDF is the sum; without an NDF, the diffuse one alone.
    brdf: the path of a `.clh` file with a whole BRDF, for albedo, albedo_average and radiance, which then have RGB.
    light: of radiance, "punctual" (NoL, phi_l, color), "ambient" (radiance), "disc" (center_x … radius, radiance) or
        "rectangle" (center_x …, u_x …, v_x …, radiance), in the frame of the surface: n = +z, azimuths from +x. Neither
        ndf nor diffuse nor brdf is a perfectly smooth surface: what `fresnel` leaves of the mirror image.
    environment: of radiance instead of a light, an image's path, an array or an `environment`, integrated over its
        texels, RGB as last axis; `normal` is that of the surface in the world, (0, 1, 0) by default, azimuths from +X
        to -Z turned with it on the shortest way; rotate, exposure and nonfinite as of `prefilter`.
    parameters: `NoV` (cosine in [0, 1]; `phi`, its azimuth in radians, for anisotropic models and radiance) where the
        integral has a view, and the models' own (`alpha`, `f0`): an unqualified name sets it in every slot that has
        it, `ndf_alpha` in one. They broadcast like numpy arrays; a preset or value with RGB adds a last axis of 3.
    precision: 32 or 64. tolerance: absolute, default 1e-6 or 1e-12 (of radiance, for a light of radiance 1; of an
        environment over its mean radiance, default 1e-5 or 1e-7); two rules are compared, and the finer one's values
        kept where they agree within it, or at the end of what is tried, with the error stated. Cells that float32
        cannot do are done in float64, with a notice.
    backfacing: what to do with views behind the surface, NoV < 0: "clamp" to 0 or "absolute"; refused by default.
        Light from behind gives 0.
    out: an array for the values, such as a memory map: a grid of any size then needs little memory of its own.
    progress: called with the share done after each part of the grid.

    Raises UsageError for unknown names and values outside their domain, UnsupportedError for a combination
    that no rule serves, DeviceError where no device works, and what `environment` raises of one.
    """
    models: dict[str, Any] = {"ndf": ndf, "masking": masking, "fresnel": fresnel, "diffuse": diffuse, "brdf": brdf,
                              "precision": precision, "tolerance": tolerance, "backfacing": backfacing,
                              "device": device, "out": out, "progress": progress}
    if name != "radiance":
        lit = {"light": light, "environment": environment, "normal": normal}
        wrong = [key for key, value in lit.items() if value is not None]
        if wrong:
            raise UsageError(f"integral {name} has no {wrong[0]}; integral radiance has")
        return run.integrate(name, **models, **parameters)
    from whitefurnace.integrals.radiance import radiance

    return radiance(light=light, environment=environment, normal=normal, rotate=rotate, exposure=exposure,
                    nonfinite=nonfinite, **models, **parameters)


__all__ = ["integrate"]
