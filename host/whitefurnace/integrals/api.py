"""The public function `integrate`, for integrals of a BRDF alone and for reflected radiance.

Reflected radiance needs image readers, so its module is imported at its first use.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
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


def integrate(
    name: str,
    *,
    ndf: Spec | None = None,
    masking: Spec = "smith",
    fresnel: Spec = "one",
    diffuse: Spec | None = None,
    brdf: Spec | None = None,
    light: Spec | None = None,
    environment: str | np.ndarray | Environment | None = None,
    normal: Sequence[float] | None = None,
    rotate: float = 0.0,
    exposure: float = 0.0,
    bad_pixels: str = "refuse",
    layout: str | None = None,
    layer: str | None = None,
    fill: str | None = None,
    nonfinite: str | None = None,
    precision: int = 32,
    tolerance: float | None = None,
    relative_tolerance: float | None = None,
    backfacing: str | None = None,
    device: Device | str | None = None,
    out: np.ndarray | None = None,
    out_errors: np.ndarray | None = None,
    progress: Progress | None = None,
    **parameters: Any,
) -> Integrated:
    """Integrate a BRDF over all broadcast `parameters` and return the values with their errors.

    `error` of the result is the largest estimated absolute error, and `errors` holds that of each cell.

    name: the integral: normalization, projected_area, weak_furnace, albedo, albedo_average, dfg or radiance.
    ndf, masking, fresnel, diffuse: models of the BRDF, as names (`ggx`, `ggx:alpha=.3`, `schlick:gold`), catalogue
      entries, or for an NDF the path of a `.clh` file. With a diffuse model the BRDF is the sum; without an NDF, the
      diffuse one alone.
    brdf: the path of a `.clh` file with a whole BRDF, for albedo, albedo_average and radiance. Values are RGB then.
    light: the light of radiance: "punctual" (NoL, phi_l, color), "ambient" (radiance), "disc" (center_x … radius,
      radiance) or "rectangle" (center_x …, u_x …, v_x …, radiance), in the frame of the surface: n = +z, azimuths from
      +x. Without ndf, diffuse and brdf the surface is perfectly smooth, and the value is the mirror image times
      `fresnel`.
    environment: the surroundings of radiance instead of a light, as `environment` takes them, integrated over its
      texels. RGB is the last axis of the values.
    normal: the normal of the surface in the world, (0, 1, 0) by default, for an environment. Azimuths run from +X to
      -Z under the shortest rotation from +Y to the normal.
    rotate, exposure, bad_pixels, layout, layer, fill, nonfinite: how the environment is read, as in `environment`.
    parameters: `NoV`, the cosine of the view angle in [0, 1], where the integral has a view; `phi`, its azimuth in
      radians, for anisotropic models and radiance; and the models' own (`alpha`, `f0`). An unqualified name sets the
      parameter in every slot that has it, `ndf_alpha` in one. They broadcast like numpy arrays; RGB in a preset or
      value adds a last axis of 3.
    precision: 32 or 64, the bits of the numbers that the device computes with.
    tolerance: the absolute error asked for, in (0, 1); default 1e-6 in float32 and 1e-12 in float64. For radiance it is
      that of a light of radiance 1; for an environment it is relative to the mean radiance, default 1e-5 and 1e-7. Two
      quadrature rules are compared and the values of the finer one are kept where they agree within it, or at the end
      of the rules, with the error stated. Cells beyond float32 are computed in float64, with a notice.
    relative_tolerance: the error asked for as a share of each value, in (0, 1). Given alone, it replaces the absolute
      tolerance, which may be small for one value or large for another; given with it, the larger of both holds for
      each cell. Like `epsrel` and `epsabs` of `scipy.integrate.quad`.
    backfacing: what to do with views behind the surface, NoV < 0: "clamp" to 0 or "absolute". They are refused by
      default. Light from behind gives 0.
    device: a device or a name of one, as `choose_device` takes it.
    out: an array for the values, such as a memory map. A grid of any size then needs little memory of its own, and
      states no errors of its cells but in `out_errors`.
    out_errors: an array for the errors of the cells, of the shape of the values without the axis of components.
    progress: called with the share done, in [0, 1], after each part of the grid.

    Raises UsageError for unknown names and values outside their domain, UnsupportedError for a combination that no rule
    supports, DeviceError where no device works, and the errors of `environment`.
    """
    models: dict[str, Any] = {"ndf": ndf, "masking": masking, "fresnel": fresnel, "diffuse": diffuse, "brdf": brdf}
    accuracy: dict[str, Any] = {"precision": precision, "tolerance": tolerance, "backfacing": backfacing}
    accuracy["relative_tolerance"] = relative_tolerance
    course: dict[str, Any] = {"device": device, "out": out, "out_errors": out_errors, "progress": progress}
    lit: dict[str, Any] = {"light": light, "environment": environment, "normal": normal}
    given = (rotate, exposure, bad_pixels, layout, layer, fill, nonfinite)
    if name != "radiance":
        _refuse_lit(name, lit, given)
        return run.integrate(name, **models, **accuracy, **course, **parameters)
    return _radiance(given, **lit, **models, **accuracy, **course, **parameters)


_READING = {
    name: inspect.signature(integrate).parameters[name].default
    for name in ("rotate", "exposure", "bad_pixels", "layout", "layer", "fill", "nonfinite")
}
"""How an environment is read unless it is said, in the order of `_radiance`."""


def _refuse_lit(name: str, lit: Mapping[str, Any], reading: tuple[Any, ...]) -> None:
    """Refuse the light, or options of reading an environment, for an integral that has none."""
    wrong = [key for key, value in lit.items() if value is not None]
    wrong += [key for key, value in zip(_READING, reading, strict=True) if value != _READING[key]]
    if wrong:
        raise UsageError(f"integral {name} has no {wrong[0]}; integral radiance has")


def _radiance(given: tuple[Any, ...], **others: Any) -> Integrated:
    """Integrate radiance; `given` are the options of reading an environment."""
    from whitefurnace.integrals.radiance import radiance
    from whitefurnace.sphere.bad_pixels import check_bad_pixels
    from whitefurnace.sphere.environments import Reading

    rotate, exposure, bad_pixels, layout, layer, fill, nonfinite = given
    mode = check_bad_pixels(bad_pixels, nonfinite)
    return radiance(reading=Reading(rotate, exposure, mode, layout, layer, fill), **others)


__all__ = ["integrate"]
