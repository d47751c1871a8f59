"""Reflected radiance L_o(v) = ∫ f(l, v) L(l)(n·l) dω of a BRDF under a light or an environment, with its error.

[Hoffman2012, "The Reflectance Equation"]
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from whitefurnace.catalogue import Integral, Model, integral
from whitefurnace.catalogue.choice import Chosen, Spec, chosen
from whitefurnace.catalogue.rule import Rule, gauss
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.integrals.outlines import outline, panels
from whitefurnace.integrals.quadrature import (
    DEFAULT_TOLERANCE,
    ROUNDING,
    Grid,
    Part,
    Progress,
    TableSpec,
    Totals,
    climb_with_errors,
    grid_of,
    parts_of,
    refuse_unused,
    room_for,
    room_for_errors,
    slots_of,
    summands_of,
    tolerances,
    with_kinks,
)
from whitefurnace.opencl import source
from whitefurnace.opencl.derived import finest, unique_rows
from whitefurnace.opencl.device import Buffer, Device, choose_device
from whitefurnace.opencl.launch import evaluate, over_nodes
from whitefurnace.results import Integrated
from whitefurnace.sphere.environments import Environment, Reading, read_environment
from whitefurnace.sphere.grids import composite, cube_directions, cube_tables, latlong_tables

CELLS_A_TIME = 4096
"""Number of cells of an area light whose panels, about twenty each, are in memory together."""

LADDER = tuple(
    Rule("outline", *step)
    for step in (
        (10, 6, 5),
        (14, 8, 7),
        (20, 12, 9),
        (28, 16, 13),
        (36, 20, 17),
        (48, 28, 24),
        (64, 40, 32),
        (88, 56, 44),
        (120, 80, 64),
    )
)
"""Nodes of the inner path from n and from its end, and along a panel of the outline (`radiance_outline.cl`)."""

SHARP = {32: 1e-7, 64: 2e-16}
"""Rounding of l + v: what it does to a lobe is `_blur`."""

MOST_NODES = 1 << 27
"""Nodes of an environment for one view at which the doubling of its cuts ends: a second or two."""

BAND = 1 << 18
"""Nodes listed at a time."""

STEPS = 256
"""Terms of one sum in the working precision."""

MOST_PARTS = 1 << 18
"""Parts of texels at which they are parted no further."""

CLOSE = 0.125
"""A texel is parted until it is smaller than this times its distance from the lobe's middle, both in widths."""

LOW = 0.005
"""The least height over the horizon at which masking's turn from n·l = 0 is looked for: narrower lobes have nothing
there (1e-9 of the whole)."""

ENVIRONMENT_TOLERANCE = {32: 1e-5, 64: 1e-7}
"""Default, over the mean radiance: of piecewise constant images, which rules meet slowly where a texel sets."""


Surroundings = str | os.PathLike[str] | np.ndarray | Environment
"""What `environment` reads."""


def radiance(
    *,
    light: Spec | None = None,
    environment: Surroundings | None = None,
    normal: Sequence[float] | None = None,
    reading: Reading | None = None,
    ndf: Spec | None = None,
    masking: Spec = "smith",
    fresnel: Spec = "one",
    diffuse: Spec | None = None,
    brdf: Spec | None = None,
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
    """Compute reflected radiance; `whitefurnace.integrate` documents the arguments, values and errors."""
    start = time.perf_counter()
    if precision not in (32, 64):
        raise UsageError(f"precision {precision} is not one of 32, 64")
    if (light is None) == (environment is None):
        raise UsageError("integral radiance needs either a light or an environment")
    defaults = DEFAULT_TOLERANCE if environment is None else ENVIRONMENT_TOLERANCE
    tolerance, relative = tolerances(tolerance, relative_tolerance, defaults[precision])
    reading = reading or Reading()
    if light is not None:
        given = ["normal"] if normal is not None else []
        given += [one.name for one in fields(reading) if getattr(reading, one.name) != one.default]
        if given:
            raise UsageError(f"{given[0]} is of an environment; a light is given in the frame of the surface")
    entry = integral("radiance")
    smooth = ndf is None and diffuse is None and brdf is None
    slots = _chosen(light, ndf, masking, fresnel, diffuse, brdf)
    models = {slot: c.model for slot, c in slots.items() if slot != "light"}
    grid = grid_of(entry, slots, dict(parameters), backfacing)
    on = device if isinstance(device, Device) else choose_device(device)
    if precision == 64 and not on.fp64:
        raise UnsupportedError(f"{on.identity()['name']} has no float64")
    errors = room_for_errors(grid.shape, out, out_errors)
    if errors is not None:
        errors[...] = 0
    task = _Task(on, entry, slots, models, grid, precision, tolerance, relative, progress, errors)
    if environment is not None:
        return _environment_of(task, environment, normal, reading, out, start)
    name = slots["light"].model.name
    how = _mirror if smooth else _punctual if name == "punctual" else _ambient if name == "ambient" else _area
    return task.result(_fill(task, how, 3 if "brdf" in slots else 1, out), start)


def _chosen(
    light: Spec | None, ndf: Spec | None, masking: Spec, fresnel: Spec, diffuse: Spec | None, brdf: Spec | None
) -> dict[str, Chosen]:
    """Return the models by slot; a perfectly smooth surface has its Fresnel term alone."""
    smooth = ndf is None and diffuse is None and brdf is None
    if smooth:
        refuse_unused({"masking": masking}, (), "a perfectly smooth surface masks nothing")
    slots = (
        {"fresnel": chosen("fresnel", fresnel)}
        if smooth
        else slots_of(integral("radiance"), ndf, masking, fresnel, diffuse, brdf)
    )
    if light is not None:
        slots["light"] = chosen("light", light)
        if smooth and slots["light"].model.name == "punctual":
            raise UnsupportedError(
                "a perfectly smooth surface reflects no punctual light but along one direction; "
                "give an ndf, a diffuse model or a brdf"
            )
    return slots


def radiance_spec(
    *,
    light: Spec | None,
    ndf: Spec | None = None,
    masking: Spec = "smith",
    fresnel: Spec = "one",
    diffuse: Spec | None = None,
    brdf: Spec | None = None,
    backfacing: str | None = None,
    **parameters: Any,
) -> TableSpec:
    """Describe the array that `radiance` would compute with the same arguments.

    light: None for a radiance that comes from an environment. Raises the errors of `radiance` for its arguments.
    """
    entry, slots = integral("radiance"), _chosen(light, ndf, masking, fresnel, diffuse, brdf)
    shape = grid_of(entry, slots, dict(parameters), backfacing).shape
    return TableSpec(entry, slots, (*shape, 3) if light is None or "brdf" in slots else shape, (source.everything(),))


def _fill(
    task: _Task, how: Callable[[_Task, int, int], np.ndarray], components: int, out: np.ndarray | None
) -> np.ndarray:
    """Return the values, made by `how` for some cells at a time as (components, n).

    Where the cells themselves are RGB (a preset, a colour), each takes its own of three components.
    """
    grid = task.grid
    own = grid.rgb and components == 3
    values = room_for(grid.shape if own or components == 1 else (*grid.shape, components), task.precision, out)
    flat = values.reshape(grid.size, -1)
    for begin in range(0, grid.size, CELLS_A_TIME):
        end = min(begin + CELLS_A_TIME, grid.size)
        found = how(task, begin, end)
        # The remaining error of float32 is the rounding of the values themselves.
        task.note(begin, end, np.abs(found).max(0) * task.rounding)
        flat[begin:end] = found[np.arange(begin, end) % 3, np.arange(end - begin), None] if own else found.T
        if task.progress:
            task.progress(end / grid.size)
    return values


@dataclass
class _Task:
    """The request, its device, and the work done so far."""

    device: Device
    entry: Integral
    slots: dict[str, Chosen]
    models: dict[str, Model]  # of the BRDF: without the light
    grid: Grid
    precision: int
    tolerance: float
    relative: float
    progress: Progress | None
    cell_errors: np.ndarray | None = None  # of the grid's shape
    totals: Totals = field(default_factory=Totals)
    rule: str = ""
    errors: dict[str, float] = field(default_factory=dict)  # by summand
    closed: int = 0  # evaluations of closed forms
    parts: dict[str, list[Part]] = field(default_factory=dict)

    def column(self, name: str, begin: int, end: int) -> np.ndarray:
        """Return cells [begin, end) of a column."""
        return self.grid.part(name, begin, end)

    def light(self, begin: int, end: int) -> dict[str, np.ndarray]:
        """Return the parameters of the light by name, (end - begin,) each."""
        return {p.name: self.column(f"light_{p.name}", begin, end) for p in self.slots["light"].model.parameters}

    def view(self, begin: int, end: int) -> np.ndarray:
        """Return unit directions to the viewer, (3, n); those at grazing are taken to the limit."""
        NoV, phi = np.maximum(self.column("NoV", begin, end), source.LEAST_COSINE), self.column("phi", begin, end)
        sine = np.sqrt((1 - NoV) * (1 + NoV))
        return np.stack([sine * np.cos(phi), sine * np.sin(phi), NoV])

    def state(self, summand: str, errors: np.ndarray, begin: int, end: int) -> None:
        """Take note of the errors of cells `begin` to `end` - 1.

        In the total the largest of a summand counts, and those of different summands add up.
        """
        self.errors[summand] = max(self.errors.get(summand, 0.0), float(np.max(errors)))
        self.note(begin, end, errors)

    def note(self, begin: int, end: int, errors: np.ndarray) -> None:
        """Add errors to those of cells `begin` to `end` - 1, without the total."""
        if self.cell_errors is not None:
            self.cell_errors.reshape(-1)[begin:end] += errors

    @property
    def rounding(self) -> float:
        """Rounding of a value of 1 as it is written."""
        return 6e-8 if self.precision == 32 else 1e-15

    def result(self, values: np.ndarray, start: float) -> Integrated:
        """Return the values with the error and the work so far; `start` is the clock's time at the beginning."""
        rule = self.totals.rule.name if self.totals.rule else self.rule
        rounding = float(np.abs(values).max()) * self.rounding
        return Integrated(
            values,
            sum(self.errors.values()) + rounding,
            self.totals.evaluations + self.closed,
            time.perf_counter() - start,
            rule,
            self.totals.notices(),
            self.cell_errors,
        )


# ---------------------------------------------------------------------------------------------- closed forms


def _at(
    task: _Task, function: str, slots: Mapping[str, Model], arguments: np.ndarray, begin: int, end: int
) -> tuple[np.ndarray, float]:
    """Return a function of the slots at arguments (rows, n), (components, n), in the finest precision; and its
    table's error.
    """
    part = Part(task.device, integral("albedo"), dict(slots), finest(task.device))
    numbers, terms, error = part.cells(task.grid.rows(part, begin, end), part.precision)
    cells = np.concatenate([arguments, numbers[len(part.view) :]])
    found = evaluate(task.device, function, slots, cells, part.precision, terms)
    task.closed += cells.shape[1]
    return found.astype(np.float64), error


def _light_at(task: _Task, function: str, direction: np.ndarray, begin: int, end: int) -> np.ndarray:
    """Return LIGHT_L or LIGHT_C at directions (3, n): (n,)."""
    model = task.slots["light"].model
    cells = np.concatenate([direction, *(v[None] for v in task.light(begin, end).values())])
    return evaluate(task.device, function, {"light": model}, cells, finest(task.device))[0].astype(np.float64)


def _reflected(v: np.ndarray) -> np.ndarray:
    return np.stack([-v[0], -v[1], v[2]])


def _mirror(task: _Task, begin: int, end: int) -> np.ndarray:
    """L(reflect(v)) F(v, n): the light seen in a perfectly smooth surface. [Hoffman2012, "Image Based Lighting"]"""
    task.rule = "mirror"
    v = task.view(begin, end)
    L = _light_at(task, "LIGHT_L", _reflected(v), begin, end)
    return _fresnel(task, begin, end) * L


def _fresnel(task: _Task, begin: int, end: int) -> np.ndarray:
    """Return F(v, n): (1, n)."""
    model = task.slots["fresnel"].model
    rows = [task.column(f"fresnel_{p.name}", begin, end) for p in model.parameters]
    cells = np.stack([task.column("NoV", begin, end), *rows])
    task.closed += cells.shape[1]
    return evaluate(task.device, "FRESNEL_F", {"fresnel": model}, cells, finest(task.device)).astype(np.float64)


def _punctual(task: _Task, begin: int, end: int) -> np.ndarray:
    """π f(l_c, v) c (n·l_c). [Hoffman2012, "Punctual Light Reflection Equation"]"""
    task.rule = "punctual"
    light, v = task.light(begin, end), task.view(begin, end)
    NoL, phi = light["NoL"], light["phi_l"]
    sine = np.sqrt((1 - NoL) * (1 + NoL))
    to = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.maximum(NoL, source.LEAST_COSINE)])
    arguments = np.concatenate([to, v])
    up = np.zeros((3, end - begin))
    up[2] = 1
    lit = _light_at(task, "LIGHT_C", up, begin, end)
    total: Any = 0.0
    for some in summands_of(task.slots):
        function = "SPECULAR_F" if "ndf" in some else "DIFFUSE_F" if "diffuse" in some else "BRDF_F"
        f, error = _at(task, function, some, arguments, begin, end)
        value = np.where(lit > 0, math.pi * f * lit, 0.0)
        size = np.abs(value).max(0)
        if size.max() > 0:  # the error of a half vector is that over the lobe's width, of the value
            widths = _widths(task, some, begin, end)
            blur = _blur(widths, task.column("NoV", begin, end), finest(task.device))
            task.state(function, size * (error + 8 * blur), begin, end)
        total = total + value
    return total


def _ambient(task: _Task, begin: int, end: int) -> np.ndarray:
    """The directional albedo times the radiance."""
    E, errors = _albedo(task, begin, end)
    L = task.light(begin, end)["radiance"]
    task.state("albedo", errors * L, begin, end)
    return E * L


def _albedo(task: _Task, begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directional albedos (components, n) and their errors (n,)."""
    if "albedo" not in task.parts:
        brdf = {slot: c for slot, c in task.slots.items() if slot != "light"}
        task.parts["albedo"] = parts_of(task.device, integral("albedo"), brdf, task.precision)
    found = [
        with_kinks(part, task.grid.rows(part, begin, end), task.tolerance, task.totals, task.relative)
        for part in task.parts["albedo"]
    ]
    return np.asarray(sum(values for values, _ in found)), np.asarray(sum(errors for _, errors in found))


def _widths(task: _Task, slots: Mapping[str, Model], begin: int, end: int) -> np.ndarray:
    """Return the widths of the lobe along x and y, (n, 2); 1 for a diffuse model."""
    n = end - begin
    if "ndf" not in slots:
        return np.full((n, 2), source.LOBE_WIDTH if "brdf" in slots else 1.0)
    part = Part(task.device, integral("albedo"), {"ndf": slots["ndf"]}, finest(task.device))
    numbers, _, _ = part.cells(task.grid.rows(part, begin, end), part.precision)
    names = ("NDF_WIDTH",) if slots["ndf"].isotropic else ("NDF_STRETCH_X", "NDF_STRETCH_Y")
    distinct, which = unique_rows(numbers[len(part.view) :])
    found = [evaluate(task.device, f, {"ndf": slots["ndf"]}, distinct, part.precision)[0][which] for f in names]
    return np.minimum(np.stack([found[0], found[-1]], -1).astype(np.float64), 1.0)


def _blur(widths: np.ndarray, NoV: np.ndarray, precision: int) -> np.ndarray:
    """Return the rounding of half vectors relative to the lobe's width, (n,).

    Within the lobe |l + v| = 2 v·h is as short as n·v or the lobe's own width, whichever is larger.
    """
    width = widths.min(1)
    return np.where(width < 1, SHARP[precision] / (width * np.maximum(NoV, width)), 0.0)


# ---------------------------------------------------------------------------------------------- area lights


@dataclass
class _Outlined(Part):
    """A summand of the BRDF over the outline of an area light: cells are summed from their panels."""

    light: Model | None = None
    widths: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    largest: float = 0.0  # of the sums of panels' absolute values, by which they may cancel
    rows: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    starts: np.ndarray = field(default_factory=lambda: np.empty(0, int))

    @property
    def view(self) -> tuple[str, ...]:
        assert self.light is not None
        return ("NoV", "phi", *(f"light_{p.name}" for p in self.light.parameters), "number")

    @property
    def components(self) -> int:
        return 3 if "brdf" in self.slots else 1

    @property
    def ladder(self) -> tuple[Rule, ...]:
        return LADDER

    def cells(self, rows: np.ndarray, precision: int, tolerance: float = 0.0) -> tuple[np.ndarray, int, float]:
        """Return rows as `Part.cells` does; the row before the models' numbers names the cell whose panels are
        meant.
        """
        assert self.light is not None
        count = len(self.view)
        numbers = {p.name: rows[2 + k] for k, p in enumerate(self.light.parameters)}
        widths = None if "diffuse" in self.slots else self.widths[rows[count - 1].astype(int)]
        self.rows, cell = panels(outline(self.light.name, numbers), rows[0], rows[1], widths)
        self.starts = np.searchsorted(cell, np.arange(rows.shape[1] + 1))
        found, terms, error = super().cells(rows, precision, tolerance)
        found[count - 1] = np.arange(rows.shape[1])
        return found, terms, error

    def _panels(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the panels of the cells, and for each panel the index of its cell."""
        number = cells[len(self.view) - 1].astype(int)
        first, count = self.starts[number], np.diff(self.starts)[number]
        which = np.repeat(np.arange(len(number)), count)
        return np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count), which

    def lanes(self, cells: np.ndarray) -> int:
        return len(self._panels(cells)[1])

    def sum(self, cells: np.ndarray, terms: int, rule: Rule, precision: int) -> np.ndarray:
        index, which = self._panels(cells)
        total = np.zeros((self.components, cells.shape[1]))
        if not len(index):
            return total
        numbers = cells[len(self.view) :]
        rows = np.concatenate([cells[:2, which], self.rows[:, index], numbers[:, which]])
        values = over_nodes(
            self.device, source.outline(self.slots, terms).text, "integrate", rows, self.components, precision, rule
        ).astype(np.float64)
        for c in range(self.components):
            total[c] = np.bincount(which, values[c], cells.shape[1])
            most = np.bincount(which, np.abs(values[c]), cells.shape[1]).max()
            self.largest = max(self.largest, ROUNDING[precision] * float(most))
        return total


def _area(task: _Task, begin: int, end: int) -> np.ndarray:
    """Return the integral over the light's outline for a radiance of 1, times its radiance."""
    light = task.light(begin, end)
    model = task.slots["light"].model
    _refuse_flat(model.name, light)
    if "area" not in task.parts:
        task.parts["area"] = [
            _Outlined(task.device, task.entry, some, task.precision, light=model) for some in summands_of(task.slots)
        ]
    total: Any = 0.0
    errors = np.zeros(end - begin)
    for part in task.parts["area"]:
        assert isinstance(part, _Outlined)
        part.largest = 0.0
        part.widths = _widths(task, part.slots, begin, end)
        names = [*part.view[:-1], *(f"{slot}_{p.name}" for slot, m in part.slots.items() for p in m.parameters)]
        rows = np.stack([task.column(name, begin, end) for name in names])
        rows = np.insert(rows, len(part.view) - 1, np.arange(end - begin), 0)
        totals = Totals()
        NoV = task.column("NoV", begin, end)
        sharp = np.zeros(end - begin, bool)
        if task.precision == 32 and task.device.fp64:
            sharp = _blur(part.widths, NoV, 32) > max(task.tolerance, task.relative)
        values = np.empty((part.components, end - begin))
        for some, precision in ((~sharp, task.precision), (sharp, 64)):
            if some.any():
                values[:, some], off = climb_with_errors(
                    part, rows[:, some], task.tolerance, totals, precision, task.relative
                )
                errors[some] += off + _blur(part.widths[some], NoV[some], precision)
        totals.promoted += int(sharp.sum())
        errors += part.largest
        task.totals.evaluations += totals.evaluations
        task.totals.promoted += totals.promoted
        if totals.rule and (task.totals.rule is None or totals.rule.evaluations > task.totals.rule.evaluations):
            task.totals.rule = totals.rule
        total = total + values
    task.state("area", errors * light["radiance"], begin, end)
    return total * light["radiance"]


def _refuse_flat(name: str, light: Mapping[str, np.ndarray]) -> None:
    if name == "disc" and (np.hypot(np.hypot(light["normal_x"], light["normal_y"]), light["normal_z"]) == 0).any():
        raise UsageError("light disc: normal is 0, it must point to the side that shines")
    if name == "rectangle":
        u, v = (np.stack([light[f"{edge}_{axis}"] for axis in "xyz"], -1) for edge in "uv")
        area = np.linalg.norm(np.cross(u, v), axis=-1)
        if not (area > 1e-12 * np.linalg.norm(u, axis=-1) * np.linalg.norm(v, axis=-1)).all():
            raise UsageError("light rectangle: the half edges u and v are parallel or 0, they must span an area")


# ---------------------------------------------------------------------------------------------- environments


def _environment_of(
    task: _Task,
    given: Surroundings,
    normal: Sequence[float] | None,
    reading: Reading,
    out: np.ndarray | None,
    start: float,
) -> Integrated:
    """Return values (…, 3): the smallest radiance of each channel times the albedo, plus the rest over the texels'
    nodes.
    """
    frame = frame_of((0.0, 1.0, 0.0) if normal is None else normal)
    env = read_environment(given, reading, device=task.device)
    texels = _Texels(task, env, frame)

    def mirror(task: _Task, begin: int, end: int) -> np.ndarray:
        task.rule = "mirror"
        return texels.at(_reflected(task.view(begin, end))) * _fresnel(task, begin, end)

    smooth = set(task.models) == {"fresnel"}
    values = _fill(task, mirror if smooth else lambda _, begin, end: texels.integral(begin, end), 3, out)
    result = task.result(values, start)
    return Integrated(
        result.values,
        result.error,
        result.evaluations,
        result.seconds,
        task.rule,
        (*env.notices, *result.notices),
        result.errors,
    )


def frame_of(normal: Sequence[float]) -> np.ndarray:
    """Return the frame of a surface with this normal in the world: (3, 3), whose rows are the local x, y, z.

    z is the normal. x and y are +X and -Z under the shortest rotation from +Y to the normal (about +X where the normal
    is -Y).
    """
    try:
        n = np.asarray(normal, np.float64)
    except (TypeError, ValueError):
        n = np.empty(0)
    length = float(np.linalg.norm(n)) if n.shape == (3,) else math.nan
    if not (math.isfinite(length) and length > 0):
        raise UsageError(f"normal is {normal!r}, three numbers that are not all 0 were expected")
    x, y, z = n / length
    if 1 + y < 1e-12:
        return np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    # Rodrigues' turn of +Y to n about (z, 0, -x), in columns: R e = e + k × e + k × (k × e)/(1 + y).
    k = np.array([z, 0.0, -x])

    def turned(e: np.ndarray) -> np.ndarray:
        return e + np.cross(k, e) + np.cross(k, np.cross(k, e)) / (1 + y)

    return np.stack([turned(np.array([1.0, 0, 0])), turned(np.array([0, 0, -1.0])), np.array([x, y, z])])


class _Turned(Part):
    """The whole BRDF, whose cells always have an azimuth."""

    @property
    def view(self) -> tuple[str, ...]:
        return ("NoV", "phi")


class _Texels:
    """An environment on a device in the frame of one surface, its radiance scaled to a mean near 1."""

    def __init__(self, task: _Task, env: Environment, frame: np.ndarray) -> None:
        self.task, self.env, self.frame = task, env, frame
        self.latlong = env.kind == "latlong"
        self.rows, self.columns = env.texels.shape[-3:-1]
        self.faces = 1 if self.latlong else 6
        mean = float(np.mean(env.statistics["mean"]))
        self.scale = 2.0 ** min(max(-round(math.log2(mean)), -100), 100) if mean > 0 else 1.0
        self.mean = mean
        scaled = (env.texels * np.float32(self.scale)).reshape(-1, 3)
        # A multiple of the largest texel's last digit: the difference is exact in float32.
        digit = np.spacing(scaled.max(0))
        self.base = np.floor(scaled.min(0) / digit) * digit
        self.rest = scaled - self.base
        self._rest_on = task.device.array(self.rest)
        self._tables: dict[tuple[int, int], tuple[Buffer, Buffer]] = {}
        self.whole = _Turned(task.device, integral("albedo"), dict(task.models), task.precision)

    def at(self, direction: np.ndarray) -> np.ndarray:
        """Return the radiance of the texels in local directions (3, n): (3, n)."""
        x, y, z = self.frame.T @ direction
        c, s = math.cos(self.env.rotation), math.sin(self.env.rotation)
        x, z = c * x + s * z, c * z - s * x
        if self.latlong:
            u = np.arctan2(z, x) / (2 * math.pi) + 0.5
            v = np.arctan2(np.hypot(x, z), y) / math.pi
            row, column = np.minimum((v * self.rows).astype(int), self.rows - 1), (u * self.columns).astype(int)
            return self.env.texels[row, column % self.columns].T.astype(np.float64)
        d = np.stack([x, y, z])
        size = np.abs(d)
        axis = np.where((size[0] >= size[1]) & (size[0] >= size[2]), 0, np.where(size[1] >= size[2], 1, 2))
        face = 2 * axis + (np.take_along_axis(d, axis[None], 0)[0] < 0)
        along = np.stack([[-z, z, x, x, x, -x][k] for k in range(6)])
        down = np.stack([[-y, -y, z, -z, -y, -y][k] for k in range(6)])
        reach = np.take_along_axis(size, axis[None], 0)[0]
        column, row = (
            np.clip(
                ((np.take_along_axis(a, face[None], 0)[0] / reach + 1) / 2 * self.rows).astype(int), 0, self.rows - 1
            )
            for a in (along, down)
        )
        return self.env.texels[face, row, column].T.astype(np.float64)

    # ---------------------------------------------------------------------------------- nodes

    def _table(self, cuts: int, precision: int) -> tuple[Buffer, Buffer]:
        if (cuts, precision) not in self._tables:
            x, w = (np.array([0.5]), np.array([1.0])) if cuts == 1 else composite(cuts)
            tables = (
                latlong_tables(self.rows, self.columns, x, w, self.env.rotation)
                if self.latlong
                else cube_tables(self.rows, x, w)
            )
            kind = np.dtype(f"f{precision // 8}")
            rows, columns = (self.task.device.array(t.astype(kind)) for t in tables)
            self._tables[cuts, precision] = rows, columns
        return self._tables[cuts, precision]

    def far(self, cells: np.ndarray, terms: int, cuts: int, precision: int, skip: np.ndarray | None) -> np.ndarray:
        """Return the sum over all texels except those of `skip`, for cells (…, n): (3, n).

        cuts: nodes per edge of each texel.
        """
        device = self.task.device
        kind = np.dtype(f"f{precision // 8}")
        real = kind.type
        rows, columns = self._table(cuts, precision)
        kernel = device.build(source.frame_nodes(self.env.kind).text, {"W": 1, "T": 1, "PRECISION": precision}).kernel(
            "frame_nodes"
        )
        frame = device.array(self.frame.astype(kind))
        skipped = None if skip is None else device.array(skip.astype(np.uint8))
        width, height = self.columns * cuts, self.faces * self.rows * cuts
        band = min(max(BAND // width, 1), height)
        stride = self._stride(band * width, precision)
        listed = device.empty((7, stride), kind)
        turn = self.env.rotation
        total = np.zeros((3, cells.shape[1]))
        for first in range(0, height, band):
            count = min(band, height - first) * width
            device.launch(
                kernel,
                (stride,),
                (
                    listed,
                    np.int32(stride),
                    np.int32(first),
                    np.int32(count),
                    frame,
                    skipped,
                    np.int32(self.rows),
                    np.int32(self.columns),
                    np.int32(cuts),
                    real(math.cos(turn)),
                    real(math.sin(turn)),
                    rows,
                    columns,
                    self._rest_on,
                ),
            )
            total += self._over(listed, stride, cells, terms, precision)
        return total

    def _stride(self, count: int, precision: int) -> int:
        """Return the number of nodes of a list in whole work items of STEPS vectors."""
        item = self.task.device.lanes(precision) * self._steps(count, precision) * self.task.device.local_size
        return -(-count // item) * item

    def _steps(self, count: int, precision: int) -> int:
        return max(1, min(STEPS, count // (4 * self.task.device.lanes(precision) * self.task.device.local_size)))

    def _over(self, listed: Buffer, stride: int, cells: np.ndarray, terms: int, precision: int) -> np.ndarray:
        """Return the sum over a list of nodes, (3, n)."""
        device = self.task.device
        lanes, n = device.lanes(precision), cells.shape[1]
        steps = next(s for s in range(STEPS, 0, -1) if stride % (s * lanes * device.local_size) == 0)
        items = stride // (lanes * steps)
        kernel = device.build(
            source.lit_nodes(self.task.models, terms).text, {"W": lanes, "T": 1, "PRECISION": precision}
        ).kernel("integrate")
        kind = np.dtype(f"f{precision // 8}")
        total = np.empty((3, n))
        for begin in range(0, n, 256):
            some = np.repeat(cells[:, begin : begin + 256], lanes, 1).astype(kind)
            views = some.shape[1] // lanes
            result = device.empty((3, views, items * lanes), kind)
            device.launch(
                kernel,
                (items, views),
                (result, np.int32(some.shape[1]), np.int32(items), np.int32(steps), listed, device.array(some)),
            )
            total[:, begin : begin + views] = result.read().sum(2, dtype=np.float64)
        return total

    # ---------------------------------------------------------------------------------- close texels

    def close(self, cells: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the texels over which one view's lobe varies, and their parts.

        The texels are flags (faces·rows·columns,). The parts (m, 5) are face, top and left edge, height and width in
        texels; each part is small compared with its distance from the lobe's middle.
        """
        NoV, phi = max(float(cells[0]), source.LEAST_COSINE), float(cells[1])
        sine = math.sqrt((1 - NoV) * (1 + NoV))
        v = np.array([sine * math.cos(phi), sine * math.sin(phi), NoV])
        face, row, column = np.meshgrid(
            np.arange(self.faces), np.arange(self.rows), np.arange(self.columns), indexing="ij"
        )
        parts = np.stack([face.ravel(), row.ravel(), column.ravel(), np.ones(face.size), np.ones(face.size)], 1)
        parts = parts.astype(np.float64)
        split = self._too_large(parts, v, widths)
        skip = split.copy()
        done, parts = [], parts[split]
        while len(parts):
            half = parts[:, 3:] / 2
            parts = np.concatenate(
                [np.concatenate([parts[:, :1], parts[:, 1:3] + half * [a, b], half], 1) for a in (0, 1) for b in (0, 1)]
            )
            split = self._too_large(parts, v, widths) & (parts[:, 3] > 2.0**-40) & (len(parts) < MOST_PARTS)
            done.append(parts[~split])
            parts = parts[split]
        return skip, np.concatenate(done) if done else np.empty((0, 5))

    def _too_large(self, parts: np.ndarray, v: np.ndarray, widths: np.ndarray) -> np.ndarray:
        def slope(a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
            x, y, z = self.directions(parts[:, 0], parts[:, 1] + a * parts[:, 3], parts[:, 2] + b * parts[:, 4])
            h = np.stack([x + v[0], y + v[1]], -1)
            across = np.linalg.norm(h, axis=1)
            # The half vector's angle, not its slope: bounded where l and v both graze.
            angle = np.arctan2(across, np.maximum(z, 0) + v[2])
            return h * (angle / np.maximum(across, 1e-300))[:, None] / widths, z

        middle, height = slope(0.5, 0.5)
        size, highest, lowest = np.zeros(len(parts)), height, height
        for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
            corner, height = slope(a, b)
            size = np.maximum(size, np.linalg.norm(corner - middle, axis=1))
            highest, lowest = np.maximum(highest, height), np.minimum(lowest, height)
        lowest = np.maximum(lowest, 0)
        turn = max(min(v[2], float(widths.min())), LOW)
        large = size > CLOSE * np.hypot(1, np.linalg.norm(middle, axis=1))
        return (large | (highest - lowest > lowest + turn)) & (highest > 0)

    def directions(self, face: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return local directions (3, n) of points in texels, given by face and fractional row and column."""
        if self.latlong:
            theta = i * (math.pi / self.rows)
            phi = j * (2 * math.pi / self.columns) - math.pi
            d = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)])
        else:
            d = cube_directions(face.astype(int), 2 * j / self.columns - 1, 2 * i / self.rows - 1)
        c, s = math.cos(self.env.rotation), math.sin(self.env.rotation)
        return self.frame @ np.stack([c * d[0] - s * d[2], d[1], s * d[0] + c * d[2]])

    def near(self, cell: np.ndarray, terms: int, parts: np.ndarray, edge: int, precision: int) -> np.ndarray:
        """Return the sum over parts of texels for one cell (rows, 1): (3, 1).

        edge: Gauss nodes per edge of each part.
        """
        device = self.task.device
        kind = np.dtype(f"f{precision // 8}")
        x, w = gauss(edge)
        total = np.zeros((3, 1))
        a, b = np.repeat(x, edge), np.tile(x, edge)
        weights = np.repeat(w, edge) * np.tile(w, edge)
        step = max(1, BAND // edge**2)
        for begin in range(0, len(parts), step):
            some = parts[begin : begin + step, :, None]
            face = np.broadcast_to(some[:, 0], (len(some), edge**2))
            i, j = some[:, 1] + a * some[:, 3], some[:, 2] + b * some[:, 4]
            texel = (face * self.rows + np.floor(some[:, 1])) * self.columns + np.floor(some[:, 2])
            if self.latlong:
                density = np.sin(i * (math.pi / self.rows)) * (math.pi / self.rows) * (2 * math.pi / self.columns)
            else:
                s, t = 2 * j / self.columns - 1, 2 * i / self.rows - 1
                density = 4 / (self.rows * self.columns) * (1 + s * s + t * t) ** -1.5
            share = (density * weights * some[:, 3] * some[:, 4]).ravel()
            count = share.size
            stride = self._stride(count, precision)
            listed = np.zeros((7, stride), kind)
            listed[2] = 1  # padding has no weight
            listed[:3, :count] = self.directions(face.ravel(), i.ravel(), j.ravel())
            listed[3, :count] = share
            listed[4:, :count] = share * self.rest[texel.ravel().astype(int)].T
            total += self._over(device.array(listed), stride, cell, terms, precision)
        return total

    # ---------------------------------------------------------------------------------- the sum

    def integral(self, begin: int, end: int) -> np.ndarray:
        """Return the radiance of cells `begin` to `end` - 1: (3, n)."""
        task = self.task
        total = np.zeros((3, end - begin))
        if self.base.any():
            E, errors = _albedo(task, begin, end)
            total += E * self.base[:, None]
            task.state("albedo", errors * (float(self.base.max()) / self.scale), begin, end)
            task.rule = task.totals.rule.name if task.totals.rule else ""
        if self.rest.any():
            task.rule, rest = self._rest(begin, end)
            total += rest
        return total / self.scale

    def _rest(self, begin: int, end: int) -> tuple[str, np.ndarray]:
        task = self.task
        rows = task.grid.rows(self.whole, begin, end)
        widths = _widths(task, task.models, begin, end)
        total = np.zeros((3, end - begin))
        NoV = task.column("NoV", begin, end)
        sharp = _blur(widths, NoV, task.precision) > max(task.tolerance, task.relative)
        errors, most = np.zeros(end - begin), 0
        bound = task.tolerance * self.mean * self.scale
        for precision, cells_of in ((task.precision, ~sharp), (finest(task.device), sharp)):
            index = np.flatnonzero(cells_of)
            if not len(index):
                continue
            if precision > task.precision:
                task.totals.promoted += len(index)
            cells, terms, table = self.whole.cells(rows[:, index], precision)
            alone = "ndf" in task.models or "brdf" in task.models
            # Diffuse models share their texels for all views; a lobe has its own close texels for each view.
            for some in [np.array([k]) for k in range(len(index))] if alone else [np.arange(len(index))]:
                group = cells[:, some]
                skip, parts = self.close(group[:2, 0], widths[index[some[0]]]) if alone else (None, np.empty((0, 5)))
                before: np.ndarray | None = None
                cuts = 1
                while True:
                    value = self.far(group, terms, cuts, precision, skip if skip is not None and skip.any() else None)
                    task.totals.evaluations += self.faces * self.rows * self.columns * cuts**2 * len(some)
                    if len(parts):
                        edge = 2 + 2 * cuts
                        value += self.near(group, terms, parts, edge, precision)
                        task.totals.evaluations += len(parts) * edge**2
                    off = np.full(len(some), np.inf) if before is None else np.abs(value - before).max(0)
                    before, change = value, float(off.max())
                    most = max(most, cuts)
                    agree = (off <= np.maximum(bound, task.relative * np.abs(value).max(0))).all()
                    if agree or self.faces * self.rows * self.columns * (2 * cuts) ** 2 > MOST_NODES:
                        break
                    cuts *= 2
                blur = _blur(widths[index[some]], NoV[index[some]], precision)
                errors[index[some]] = change + np.abs(value).max(0) * (ROUNDING[precision] + blur + table)
                total[:, index[some]] = value
        task.state("texels", errors / self.scale, begin, end)
        return f"texels-{most}x{most}", total
