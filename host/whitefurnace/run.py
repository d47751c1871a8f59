"""Plan -> numbers: runs an integral of the catalogue over a grid of parameters, with its error estimate."""
from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from whitefurnace import source
from whitefurnace.catalogue import Integral, Model, integral, model
from whitefurnace.catalogue.rule import LADDER, Rule
from whitefurnace.device import Device, choose_device
from whitefurnace.errors import CheckError, UnsupportedError, UsageError, nearest
from whitefurnace.recipe import Chosen, chosen

CELLS_A_LAUNCH = 1 << 16
NOV_RANGE = (1e-5, 1.0)
DEFAULT_TOLERANCE = {32: 1e-6, 64: 1e-12}

# What float32 leaves however fine the rule: a relative part of the value, measured in tests/test_integrate.py.
ROUNDING = {32: 2e-6, 64: 2e-14}


@dataclass(frozen=True)
class Integrated:
    """The result of `integrate`.

    `values` has the broadcast shape of the parameters, with a trailing axis for a vector integral; `error` is
    the estimated absolute error, the largest over all cells; `rule` names the rule that was used and
    `evaluations` counts its integrand evaluations, all cells together; `seconds` is the wall time.
    """

    values: np.ndarray
    error: float
    evaluations: int
    seconds: float
    rule: str

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.values, dtype=dtype) if dtype or copy else self.values


def integrate(name: str, *, ndf: str | Model | None = None, masking: str | Model = "smith",
              fresnel: str | Model = "one", diffuse: str | None = None, precision: int = 32,
              tolerance: float | None = None, device: Device | str | None = None, **parameters: Any) -> Integrated:
    """Integrates `name` of the catalogue over all broadcast `parameters`.

    name: normalization, projected_area, weak_furnace, albedo or dfg.
    ndf, masking, fresnel: names (`ggx`, or `ggx:alpha=.3`) or catalogue entries.
    parameters: `NoV` (cosine in [1e-5, 1]) where the integral has a view, and the models' own (`alpha`, `f0`;
        `ndf_alpha` where two slots share a name); they broadcast like numpy arrays.
    precision: 32 or 64. tolerance: absolute, default 1e-6 or 1e-12; two rules are compared, and the finer
        one's values returned once they agree within it (or at the end of the ladder, with the error stated).

    Raises UsageError for unknown names and values outside their domain, UnsupportedError for a combination
    that no rule serves, DeviceError where no device works.
    """
    start = time.perf_counter()
    if diffuse is not None:
        raise UnsupportedError("diffuse models are not part of this version")
    if precision not in (32, 64):
        raise UsageError(f"precision {precision} is not one of 32, 64")
    entry = integral(name)
    if tolerance is None:
        tolerance = DEFAULT_TOLERANCE[precision]
    if not 0 < tolerance < 1:
        raise UsageError(f"tolerance {tolerance!r} is outside (0, 1)")
    slots = _slots(entry, ndf, masking, fresnel)
    cells, shape = _cells(entry, slots, dict(parameters))
    on = device if isinstance(device, Device) else choose_device(device)
    values, error, rule, evaluations = _climb(on, entry, slots, cells, precision, tolerance)
    values = values.reshape(entry.components, *shape)
    values = values[0] if entry.components == 1 else np.moveaxis(values, 0, -1)
    return Integrated(values, error, evaluations, time.perf_counter() - start, rule.name)


def _slots(entry: Integral, ndf: str | Model | None, masking: str | Model,
           fresnel: str | Model) -> dict[str, Chosen]:
    """The slots an integral needs, filled; a slot it does not need is not compiled in."""
    if ndf is None:
        raise UsageError(f"integral {entry.name} needs an ndf")
    asked: dict[str, str | Model] = {"ndf": ndf, "masking": masking, "fresnel": fresnel}
    wanted = {need.split("_")[0].lower() for need in entry.needs}
    slots = {slot: chosen(slot, spec) for slot, spec in asked.items() if slot in wanted}
    provided = {f for choice in slots.values() for f in choice.model.provides}
    missing = [f for f in entry.needs if f not in provided]
    missing += [f"{f} for {choice.model.name}" for choice in slots.values() for f in choice.model.needs
                if f not in provided]
    if missing:
        raise UnsupportedError(f"integral {entry.name}: these models give no {', '.join(missing)}")
    if not slots["ndf"].model.isotropic:
        raise UnsupportedError(f"integral {entry.name} has no rule for the anisotropic {slots['ndf'].model.name}")
    return slots


def _cells(entry: Integral, slots: Mapping[str, Chosen],
           parameters: dict[str, Any]) -> tuple[np.ndarray, tuple[int, ...]]:
    """Rows (n·v, every parameter) by flattened cells, float64, and the broadcast shape."""
    order = source.cell_parameters({slot: c.model for slot, c in slots.items()})
    names = [name for _, name in order]
    columns: list[np.ndarray] = []
    if entry.view:
        if "NoV" not in parameters:
            raise UsageError(f"integral {entry.name} needs NoV, the cosine of the view angle")
        given = parameters.pop("NoV")
        try:
            NoV = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            raise UsageError(f"NoV must be a number, not {given!r}") from None
        if not ((NoV >= NOV_RANGE[0]) & (NoV <= NOV_RANGE[1])).all():
            raise UsageError(f"NoV is outside [{NOV_RANGE[0]:g}, {NOV_RANGE[1]:g}] (cosine of the view angle)")
        columns.append(NoV)
    else:
        columns.append(np.ones(()))
    for slot, parameter in order:
        choice = slots[slot]
        declared = next(p for p in choice.model.parameters if p.name == parameter)
        qualified = f"{slot}_{parameter}"
        key = qualified if qualified in parameters else parameter
        if key == parameter and parameter in parameters and names.count(parameter) > 1:
            raise UsageError(f"{parameter} belongs to several models; give {qualified}")
        if key in parameters:
            value = parameters.pop(key)
        elif parameter in choice.given:
            value = choice.given[parameter]
        elif declared.default is not None:
            value = declared.default
        else:
            raise UsageError(f"{slot} {choice.model.name} needs {parameter}, {declared.about}")
        columns.append(declared.check(value, f"{slot} {choice.model.name}"))
    if parameters:
        unknown = sorted(parameters)[0]
        raise UsageError(f"integral {entry.name} has no parameter {unknown!r}{nearest(unknown, ['NoV', *names])}")
    try:
        columns = list(np.broadcast_arrays(*columns))
    except ValueError:
        raise UsageError("parameters do not broadcast: shapes "
                         + ", ".join(str(c.shape) for c in columns)) from None
    shape = columns[0].shape
    if columns[0].size == 0:
        raise UsageError("parameters hold no cell: an array is empty")
    return np.stack([c.ravel() for c in columns]), shape


def _climb(device: Device, entry: Integral, slots: Mapping[str, Chosen], cells: np.ndarray, precision: int,
           tolerance: float) -> tuple[np.ndarray, float, Rule, int]:
    """Climbs the ladder until two neighbouring rules agree within the tolerance on every cell."""
    models = {slot: c.model for slot, c in slots.items()}
    # A coarse tolerance starts low, a tight one where the tables of the rules say it can end.
    first = 0 if tolerance >= 1e-3 else 1 if tolerance >= 1e-5 else 3 if tolerance >= 1e-8 else 6
    coarse = _sum(device, entry, models, cells, LADDER[first], precision)
    spent = LADDER[first].evaluations
    error, rule = float("inf"), LADDER[first]
    for rule in LADDER[first + 1:]:
        fine = _sum(device, entry, models, cells, rule, precision)
        spent += rule.evaluations
        rounding = ROUNDING[precision] * float(np.abs(fine).max())
        error = float(np.abs(fine.astype(np.float64) - coarse).max())
        coarse = fine
        if error <= max(tolerance - rounding, rounding):
            break
    if not np.isfinite(error):
        raise CheckError(f"integral {entry.name} is not finite for some of these parameters in float{precision}")
    return coarse, error + ROUNDING[precision] * float(np.abs(coarse).max()), rule, spent * cells.shape[1]


def _sum(device: Device, entry: Integral, models: Mapping[str, Model], cells: np.ndarray, rule: Rule,
         precision: int) -> np.ndarray:
    """(components, cells) of one rule, in launches of bounded size."""
    kind = np.dtype(f"f{precision // 8}")
    lanes = device.lanes(precision)
    program = device.build(source.integration(entry, models).text,
                           {"W": lanes, "T": 1, "PRECISION": precision})
    kernel = program.kernel("integrate")
    theta, phi = (device.array(table.astype(kind)) for table in rule.tables())
    out = np.empty((entry.components, cells.shape[1]), kind)
    step = lanes * device.local_size
    for begin in range(0, cells.shape[1], CELLS_A_LAUNCH):
        part = cells[:, begin:begin + CELLS_A_LAUNCH]
        count = part.shape[1]
        padded = -(-count // step) * step
        block = np.pad(part, ((0, 0), (0, padded - count)), mode="edge").astype(kind)
        result = device.empty((entry.components, padded), kind)
        device.launch(kernel, (padded // lanes,),
                      (result, np.int32(padded), np.int32(rule.near), np.int32(rule.near + rule.far), theta,
                       np.int32(rule.azimuths), phi, device.array(block)))
        out[:, begin:begin + count] = result.read()[:, :count]
    return out


def dfg(size: int = 128, *, ndf: str | Model = "ggx", masking: str | Model = "smith",
        tolerance: float = 5e-6, precision: int = 32, device: Device | str | None = None) -> Integrated:
    """The split-sum table: `values` (size, size, 2), float32 or float64 by `precision`, as [y, x, (scale, bias)].

    x is n·v = (x + ½)/size, y perceptual roughness r = (y + ½)/size, row 0 smoothest, α = r². E(v; F0) =
    F0·scale + bias for Schlick's Fresnel with F90 = 1. Raises as `integrate` does.
    """
    if not 1 <= size <= 4096:
        raise UsageError(f"dfg size {size} is outside [1, 4096]")
    choice = chosen("ndf", ndf)
    if choice.model.from_roughness is None:
        raise UnsupportedError(f"ndf {choice.model.name} has no parameter that follows roughness")
    axis = (np.arange(size) + 0.5) / size
    rows = [{**choice.model.from_roughness(float(r)), **choice.given} for r in axis]
    columns = {name: np.array([row[name] for row in rows])[:, None] for name in rows[0]}
    columns = {name: np.clip(v, _low(choice.model, name), None) for name, v in columns.items()}
    parameters: dict[str, Any] = {"NoV": axis[None, :], **columns}
    result = integrate("dfg", ndf=choice.model, masking=masking, tolerance=tolerance, precision=precision,
                       device=device, **parameters)
    return Integrated(np.ascontiguousarray(result.values), result.error, result.evaluations,
                      result.seconds, result.rule)


def _low(entry: Model, parameter: str) -> float:
    """The lower end of a domain: a table's first row may fall below it by half a texel of roughness."""
    return next(p.low for p in entry.parameters if p.name == parameter)


__all__ = ["Integrated", "dfg", "integrate", "model"]
