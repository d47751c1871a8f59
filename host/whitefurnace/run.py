"""Plan -> numbers: runs an integral of the catalogue over a grid of parameters, with its error estimate."""
from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from whitefurnace import source
from whitefurnace.catalogue import Integral, Model, integral, model
from whitefurnace.catalogue.rule import AVERAGE_RULES, LADDERS, Rule, gauss
from whitefurnace.cells import CELLS_A_LAUNCH, over_nodes
from whitefurnace.derived import Areas, numbers_of
from whitefurnace.device import Device, choose_device
from whitefurnace.errors import CheckError, UnsupportedError, UsageError, nearest
from whitefurnace.recipe import Chosen, chosen

DEFAULT_TOLERANCE = {32: 1e-6, 64: 1e-12}
BACKFACING = ("clamp", "absolute")

# What float32 leaves however fine the rule: a relative part of the value, measured in tests/test_integrate.py.
ROUNDING = {32: 1e-6, 64: 2e-14}

BLOCK = 64
"""Neighbouring cells that climb the ladder together. One cell alone could meet two rules that err alike."""

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Integrated:
    """The result of `integrate`.

    `values` has the broadcast shape of the parameters, with a trailing axis for a vector integral; `error` is
    the estimated absolute error, the largest over all cells; `rule` names the finest rule that was used and
    `evaluations` counts its integrand evaluations, all cells together; `seconds` is the wall time; `notices` say
    what was done that was not asked for, such as cells taken to float64.
    """

    values: np.ndarray
    error: float
    evaluations: int
    seconds: float
    rule: str
    notices: tuple[str, ...] = field(default=())

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.values, dtype=dtype) if dtype or copy else self.values


def integrate(name: str, *, ndf: str | Model | None = None, masking: str | Model = "smith",
              fresnel: str | Model = "one", diffuse: str | Model | None = None, brdf: str | Model | None = None,
              precision: int = 32, tolerance: float | None = None, backfacing: str | None = None,
              device: Device | str | None = None, out: np.ndarray | None = None, progress: Progress | None = None,
              **parameters: Any) -> Integrated:
    """Integrates `name` of the catalogue over all broadcast `parameters`.

    name: normalization, projected_area, weak_furnace, albedo, albedo_average or dfg.
    ndf, masking, fresnel, diffuse: names (`ggx`, `ggx:alpha=.3`, `schlick:gold`), catalogue entries, or for an NDF the
        path of a `.clh` file. With a diffuse model, albedos are those of the sum; without an NDF, of it alone.
    brdf: the path of a `.clh` file with a whole BRDF, for albedo and albedo_average, which then have RGB.
    parameters: `NoV` (cosine in [0, 1]; `phi`, its azimuth in radians, for anisotropic models) where the integral has
        a view, and the models' own (`alpha`, `f0`): an unqualified name sets it in every slot that has it,
        `ndf_alpha` in one. They broadcast like numpy arrays; a preset or value with RGB adds a last axis of 3.
    precision: 32 or 64. tolerance: absolute, default 1e-6 or 1e-12; two rules are compared, and the finer
        one's values kept where they agree within it (or at the end of the ladder, with the error stated). Cells that
        float32 cannot do are done in float64, with a notice.
    backfacing: what to do with views behind the surface, NoV < 0: "clamp" to 0 or "absolute"; refused by default.
    out: an array for the values, such as a memory map: a grid of any size then needs little memory of its own.
    progress: called with the share done after each part of 65536 cells.

    Raises UsageError for unknown names and values outside their domain, UnsupportedError for a combination
    that no rule serves, DeviceError where no device works.
    """
    start = time.perf_counter()
    if precision not in (32, 64):
        raise UsageError(f"precision {precision} is not one of 32, 64")
    entry = integral(name)
    if tolerance is None:
        tolerance = DEFAULT_TOLERANCE[precision]
    if not 0 < tolerance < 1:
        raise UsageError(f"tolerance {tolerance!r} is outside (0, 1)")
    slots = _slots(entry, ndf, masking, fresnel, diffuse, brdf)
    grid = _grid(entry, slots, dict(parameters), backfacing)
    on = device if isinstance(device, Device) else choose_device(device)
    if precision == 64 and not on.fp64:
        raise UnsupportedError(f"{on.identity()['name']} has no float64")
    parts = _parts(on, entry, slots, precision)
    components = parts[0].components
    shape = grid.shape if components == 1 else (*grid.shape, components)
    values = _room(shape, precision, out)
    flat = values.reshape(grid.size, components)
    tally = _Tally()
    for begin in range(0, grid.size, CELLS_A_LAUNCH):
        end = min(begin + CELLS_A_LAUNCH, grid.size)
        total = sum(_average(part, grid, begin, end, tolerance, tally) if entry.name == "albedo_average" else
                    _climb(part, grid.rows(part, begin, end), tolerance, tally) for part in parts)
        flat[begin:end] = np.asarray(total).T
        if progress:
            progress(end / grid.size)
    return Integrated(values, tally.error * len(parts), tally.evaluations, time.perf_counter() - start,
                      tally.rule.name if tally.rule else "", tally.notices())


def _room(shape: tuple[int, ...], precision: int, out: np.ndarray | None) -> np.ndarray:
    """The array for the values: `out`, or a new one."""
    if out is None:
        return np.empty(shape, np.dtype(f"f{precision // 8}"))
    if out.shape != shape or not out.flags.c_contiguous:
        raise UsageError(f"out has shape {out.shape}; needed is a contiguous array of {shape}")
    return out


# ---------------------------------------------------------------------------------------------- what is asked


def _slots(entry: Integral, ndf: str | Model | None, masking: str | Model, fresnel: str | Model,
           diffuse: str | Model | None, brdf: str | Model | None) -> dict[str, Chosen]:
    """The slots an integral needs, filled; a slot it does not need is not compiled in."""
    albedo = entry.name in ("albedo", "albedo_average")
    if not albedo and (diffuse is not None or brdf is not None):
        raise UnsupportedError(f"integral {entry.name} is of an NDF; a diffuse model or a BRDF has albedo and "
                               "albedo_average")
    if brdf is not None:
        if ndf is not None or diffuse is not None:
            raise UsageError("a brdf is whole: give it without an ndf and a diffuse model")
        return {"brdf": chosen("brdf", brdf)}
    slots: dict[str, Chosen] = {}
    if ndf is not None:
        asked: dict[str, str | Model] = {"ndf": ndf, "masking": masking, "fresnel": fresnel}
        wanted = {need.split("_")[0].lower() for need in entry.needs}
        slots = {slot: chosen(slot, spec) for slot, spec in asked.items() if slot in wanted}
        provided = {f for choice in slots.values() for f in choice.model.provides}
        missing = [f for f in entry.needs if f not in provided]
        if missing:
            raise UnsupportedError(f"integral {entry.name}: {', '.join(c.model.name for c in slots.values())} "
                                   f"give no {', '.join(missing)}")
    elif diffuse is None:
        raise UsageError(f"integral {entry.name} needs an ndf{', a diffuse model or a brdf' if albedo else ''}")
    if diffuse is not None:
        slots["diffuse"] = chosen("diffuse", diffuse)
    return slots


@dataclass(frozen=True)
class _Grid:
    """Broadcast columns by (slot, parameter) or name, read in parts: nothing of the grid's size is made."""

    shape: tuple[int, ...]
    columns: Mapping[str, np.ndarray]

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    def part(self, name: str, begin: int, end: int) -> np.ndarray:
        """Cells [begin, end) of a column, float64."""
        column = self.columns[name]
        return np.full(end - begin, float(column)) if column.ndim == 0 else np.asarray(
            np.broadcast_to(column, self.shape).flat[begin:end], np.float64)

    def rows(self, part: _Part, begin: int, end: int) -> np.ndarray:
        """The parameter rows of one part of the BRDF, view first: (rows, end - begin)."""
        names = [*part.view, *(f"{slot}_{p.name}" for slot, m in part.slots.items() for p in m.parameters)]
        return np.stack([self.part(name, begin, end) for name in names])


def _grid(entry: Integral, slots: Mapping[str, Chosen], given: dict[str, Any], backfacing: str | None) -> _Grid:
    """Every number the kernels need, checked against its domain, and the broadcast shape."""
    columns: dict[str, Any] = {}
    rgb: set[str] = set()
    isotropic = all(choice.model.isotropic for choice in slots.values()) and "brdf" not in slots
    columns["NoV"] = np.ones(())
    columns["phi"] = np.zeros(())
    if entry.view:
        if "NoV" not in given:
            raise UsageError(f"integral {entry.name} needs NoV, the cosine of the view angle")
        columns["NoV"] = _view(given.pop("NoV"), backfacing)
        if not isotropic and "phi" in given:
            columns["phi"] = _number("phi", given.pop("phi"))
    names = {p.name for choice in slots.values() for p in choice.model.parameters}
    used: set[str] = set()
    for slot, choice in slots.items():
        for p in choice.model.parameters:
            qualified, where = f"{slot}_{p.name}", f"{slot} {choice.model.name}"
            key = qualified if qualified in given else p.name
            value: Any
            if key in given:
                value = given[key]
                used.add(key)
            elif p.name in choice.given:
                value = choice.given[p.name]
                if isinstance(value, tuple):
                    rgb.add(qualified)
            elif p.default is not None:
                value = p.default
            else:
                raise UsageError(f"{where} needs {p.name}, {p.about}")
            columns[qualified] = p.check(value, where)
    unknown = sorted(set(given) - used)
    if unknown:
        known = ["NoV", *([] if isotropic else ["phi"]), *sorted(names)] if entry.view else sorted(names)
        raise UsageError(f"integral {entry.name} has no parameter {unknown[0]!r}{nearest(unknown[0], known)}")
    if rgb:
        columns = {k: v if k in rgb else np.asarray(v)[..., None] for k, v in columns.items()}
    try:
        shape = np.broadcast_shapes(*(np.shape(v) for v in columns.values()))
    except ValueError:
        raise UsageError("parameters do not broadcast: shapes "
                         + ", ".join(f"{k} {np.shape(v)}" for k, v in columns.items() if np.ndim(v))) from None
    if 0 in shape:
        raise UsageError("parameters hold no cell: an array is empty")
    return _Grid(shape, columns)


def _number(name: str, given: Any) -> np.ndarray:
    try:
        array = np.asarray(given, np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{name} must be a number, not {given!r}") from None
    if not np.isfinite(array).all():
        raise UsageError(f"{name} must be finite")
    return array


def _view(given: Any, backfacing: str | None) -> np.ndarray:
    """n·v in [0, 1], views from behind dealt with as asked."""
    NoV = _number("NoV", given)
    if backfacing is not None and backfacing not in BACKFACING:
        raise UsageError(f"unknown backfacing {backfacing!r}{nearest(backfacing, BACKFACING)}")
    if backfacing == "clamp":
        NoV = np.where((NoV < 0) & (NoV >= -1), 0.0, NoV)
    elif backfacing == "absolute":
        NoV = np.abs(NoV)
    if not ((NoV >= 0) & (NoV <= 1)).all():
        behind = (NoV < 0).any() and backfacing is None
        raise UsageError("NoV is outside [0, 1] (cosine of the view angle)"
                         + ("; views from behind want backfacing = clamp or absolute" if behind else ""))
    return NoV


# ---------------------------------------------------------------------------------------------- how it is done


@dataclass
class _Part:
    """One summand of the BRDF on a device: the specular one, the diffuse one or a user's whole one."""

    device: Device
    entry: Integral
    slots: dict[str, Model]
    precision: int
    areas: dict[int, Areas] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        if "ndf" in self.slots:
            if self.entry.support == "ALL":
                return "polar" if self.slots["ndf"].isotropic else "stretched"
            return "gauss" if self.slots["ndf"].isotropic else "stretched"
        return "hemisphere" if "diffuse" in self.slots else "half-vectors"

    @property
    def view(self) -> tuple[str, ...]:
        return ("NoV",) if self.kind in ("gauss", "polar", "hemisphere") else ("NoV", "phi")

    @property
    def components(self) -> int:
        return 3 if self.kind == "half-vectors" else self.entry.components

    @property
    def tabulated(self) -> bool:
        """Whether the masking reads Smith's area from a table."""
        needs = {f for m in self.slots.values() for f in m.needs}
        return "NDF_AREA" in needs and "NDF_AREA" not in self.slots["ndf"].provides

    def cells(self, rows: np.ndarray, precision: int) -> tuple[np.ndarray, int, float]:
        """Rows of view and parameters -> rows as kernels read them, the length of the area's table, its error."""
        count = len(self.view)
        read, out, ndf = count, [rows[:count]], None
        for entry in self.slots.values():
            numbers = numbers_of(self.device, entry, rows[read:read + len(entry.parameters)])
            if self.entry.name == "normalization" and entry.text is not None:
                numbers[entry.arguments.index("per_norm")] = 1  # the raw norm is what is asked
            ndf = numbers if entry.slot == "ndf" else ndf
            out.append(numbers)
            read += len(entry.parameters)
        terms, error = 0, 0.0
        if self.tabulated:
            assert ndf is not None
            if precision not in self.areas:
                self.areas[precision] = Areas(self.device, self.slots["ndf"], precision)
            table = self.areas[precision].table(ndf)
            out.append(table.rows)
            terms, error = table.length, table.error
        return np.concatenate(out), terms, error

    def text(self, terms: int) -> str:
        if "ndf" in self.slots:
            return source.integration(integral("albedo") if self.entry.name == "albedo_average" else self.entry,
                                      self.slots, terms).text
        return source.hemisphere(next(iter(self.slots.values()))).text

    def sum(self, cells: np.ndarray, terms: int, rule: Rule, precision: int) -> np.ndarray:
        return over_nodes(self.device, self.text(terms), "integrate", cells, self.components, precision, rule)


def _parts(device: Device, entry: Integral, slots: Mapping[str, Chosen], precision: int) -> list[_Part]:
    parts = []
    specular = {slot: c.model for slot, c in slots.items() if slot in ("ndf", "masking", "fresnel")}
    for some in (specular, *({slot: slots[slot].model} for slot in ("diffuse", "brdf") if slot in slots)):
        if some:
            parts.append(_Part(device, entry, some, precision))
    return parts


@dataclass
class _Tally:
    """What a run has cost and how far it is from the truth."""

    error: float = 0.0
    evaluations: int = 0
    rule: Rule | None = None
    promoted: int = 0

    def used(self, rule: Rule, cells: int) -> None:
        self.evaluations += rule.evaluations * cells
        if self.rule is None or rule.evaluations > self.rule.evaluations:
            self.rule = rule

    def notices(self) -> tuple[str, ...]:
        return (f"{self.promoted} cells were done in float64: float32 did not reach the tolerance there",) \
            if self.promoted else ()


def _climb(part: _Part, rows: np.ndarray, tolerance: float, tally: _Tally, precision: int | None = None) -> np.ndarray:
    """(components, n): climbs the ladder, every block of cells until two neighbouring rules agree on it."""
    precision = precision or part.precision
    ladder = LADDERS[part.kind]
    cells, terms, floor = part.cells(rows, precision)
    n = rows.shape[1]
    # A coarse tolerance starts low, a tight one where the tables of the rules say it can end.
    first = 0 if tolerance >= 1e-3 else 1 if tolerance >= 1e-5 else 3 if tolerance >= 1e-8 else 5
    values = part.sum(cells, terms, ladder[first], precision).astype(np.float64)
    tally.used(ladder[first], n)
    active = np.arange(n)
    change = np.empty(0)
    allowed = np.empty(0)
    for rule in ladder[first + 1:]:
        fine = part.sum(cells[:, active], terms, rule, precision).astype(np.float64)
        tally.used(rule, active.size)
        starts = np.arange(0, active.size, BLOCK)
        change = np.maximum.reduceat(np.abs(fine - values[:, active]).max(0), starts)
        size = np.maximum.reduceat(np.abs(fine).max(0), starts)
        values[:, active] = fine
        rounding = ROUNDING[precision] * size
        allowed = np.maximum(tolerance - rounding, rounding)
        with np.errstate(invalid="ignore"):
            open_ = ~(change <= allowed)
        done = float(np.max((change + rounding + floor * size)[~open_], initial=0.0))
        tally.error = max(tally.error, done)
        keep = np.repeat(open_, BLOCK)[:active.size]
        change, allowed, rounding = change[open_], allowed[open_], (rounding + floor * size)[open_]
        active = active[keep]
        if active.size == 0:
            break
    if active.size and precision == 32 and part.device.fp64:
        # Whole ladders end within float32's reach or stop at its rounding: float64 goes on from here.
        tally.promoted += active.size
        values[:, active] = _climb(part, rows[:, active], tolerance, tally, 64)
    elif active.size:
        left = float(np.max(change + rounding))
        if not np.isfinite(left):
            raise CheckError(f"integral {part.entry.name} is not finite for some of these parameters in "
                             f"float{precision}{_example(part, rows, values)}")
        tally.error = max(tally.error, left)
    return values


def _example(part: _Part, rows: np.ndarray, values: np.ndarray) -> str:
    """The first cell whose value is not finite, for a message."""
    bad = np.flatnonzero(~np.isfinite(values).all(0))
    if bad.size == 0:
        return ""
    names = [*part.view, *(p.name for m in part.slots.values() for p in m.parameters)]
    return ": " + ", ".join(f"{name} = {value:g}" for name, value in zip(names, rows[:, bad[0]], strict=True))


def _average(part: _Part, grid: _Grid, begin: int, end: int, tolerance: float, tally: _Tally) -> np.ndarray:
    """(components, n): 2∫ E(μ) μ dμ with μ = x² (the grazing end wants nodes), by rules of more and more nodes."""
    out = np.empty((part.components, end - begin))
    for some in _slices(begin, end, 512):
        rows = grid.rows(part, *some)
        before: np.ndarray | None = None
        for count in AVERAGE_RULES:
            x, w = gauss(count)
            many = np.repeat(rows, count, 1)
            many[0] = np.tile(x * x, rows.shape[1])
            inner = _Tally()
            E = _climb(part, many, tolerance / 2, inner).reshape(part.components, rows.shape[1], count)
            tally.evaluations += inner.evaluations
            tally.promoted += inner.promoted
            tally.rule = inner.rule
            value = E @ (4 * w * x**3)
            change = np.inf if before is None else float(np.abs(value - before).max())
            before = value
            if change + inner.error <= max(tolerance, 2 * inner.error):
                break
        tally.error = max(tally.error, change + inner.error)
        out[:, some[0] - begin:some[1] - begin] = value
    return out


def _slices(begin: int, end: int, step: int) -> Iterator[tuple[int, int]]:
    for k in range(begin, end, step):
        yield k, min(k + step, end)


def dfg(size: int = 128, *, ndf: str | Model = "ggx", masking: str | Model = "smith",
        tolerance: float = 5e-6, precision: int = 32, device: Device | str | None = None) -> Integrated:
    """The split-sum table: `values` (size, size, 2), float32 or float64 by `precision`, as [y, x, (scale, bias)].

    x is n·v = (x + ½)/size, y perceptual roughness r = (y + ½)/size, row 0 smoothest, α = r². E(v; F0) =
    F0·scale + bias for Schlick's Fresnel with F90 = 1. Raises as `integrate` does.
    """
    if not 1 <= size <= 4096:
        raise UsageError(f"dfg size {size} is outside [1, 4096]")
    axis = (np.arange(size) + 0.5) / size
    choice = chosen("ndf", ndf)
    rows: dict[str, Any] = rows_of_roughness(choice, axis[:, None])
    return integrate("dfg", ndf=choice.model, masking=masking, tolerance=tolerance, precision=precision,
                     device=device, NoV=axis[None, :], **rows)


def rows_of_roughness(choice: Chosen, r: np.ndarray) -> dict[str, np.ndarray]:
    """The parameters of an NDF at perceptual roughnesses of any shape, those given with it held."""
    if choice.model.from_roughness is None:
        raise UnsupportedError(f"ndf {choice.model.name} has no parameter that follows roughness")
    sets = [{**choice.model.from_roughness(float(x)), **choice.given} for x in r.ravel()]
    # A table's first row may fall below a domain by half a texel of roughness.
    ends = {p.name: (p.low, p.high) for p in choice.model.parameters}
    return {f"ndf_{name}": np.clip(np.array([s[name] for s in sets]).reshape(r.shape), *ends[name]) for name in sets[0]}


__all__ = ["Integrated", "dfg", "integrate", "model"]
