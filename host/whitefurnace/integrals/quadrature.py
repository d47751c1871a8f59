"""Computes an integral of the catalogue over a grid of parameters, with an estimate of its error."""

from __future__ import annotations

import difflib
import inspect
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from whitefurnace.catalogue import Integral, Model, integral, model
from whitefurnace.catalogue.choice import Chosen, Spec, chosen, is_number
from whitefurnace.catalogue.numerics import held
from whitefurnace.catalogue.registry import CLOSED
from whitefurnace.catalogue.rule import AVERAGE_RULES, LADDERS, Rule, gauss
from whitefurnace.errors import CheckError, UnsupportedError, UsageError, nearest
from whitefurnace.opencl import source
from whitefurnace.opencl.derived import Areas, numbers_of
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.opencl.launch import CELLS_A_LAUNCH, over_nodes
from whitefurnace.results import Integrated

DEFAULT_TOLERANCE = {32: 1e-6, 64: 1e-12}
BACKFACING = ("clamp", "absolute")

# Error of float32 with any rule, relative to the value, as measured in
# tests/integrals/test_integrate.py.
ROUNDING = {32: 1e-6, 64: 2e-14}

BLOCK = 64
"""Number of neighbouring cells that get the same rules. A single cell could meet two rules that have the same error."""

LUCK = 5
"""Assumed largest error reduction between neighbouring rules. It guards against accidental agreement, also of fewer
cells than a block that agree at the first comparison. Without both, one single cell in ten states an error too small in
float64, by up to 30 times; whole blocks lose next to nothing by it."""

CLOSED_FROM = (1 / 512, 1e-8)
"""Smallest n·v and tolerance for kernels with closed forms: nearer to grazing, or for a finer tolerance, the general
kernels are faster."""

UNFINISHED = 3
"""Factor on the last change that bounds the error where the rules did not converge. An error of first order in the
nodes, as kinks have it, falls by 1.4 per rule, and 1/1.4 + 1/1.4² + … is 2.5."""

OF_OTHERS = {
    **dict.fromkeys(("rtol", "epsrel", "rel_tol", "reltol", "relative"), "relative_tolerance"),
    **dict.fromkeys(("atol", "epsabs", "abs_tol", "abstol", "tol"), "tolerance"),
}
"""Names that scipy, numpy and Python's math have for our keywords."""

Progress = Callable[[float], None]


def integrate(
    name: str,
    *,
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
    """Integrate a BRDF over all broadcast `parameters`; `whitefurnace.integrate` documents the arguments.

    name: any integral but radiance. Raises the errors of `whitefurnace.integrate`.
    """
    start = time.perf_counter()
    if precision not in (32, 64):
        raise UsageError(f"precision {precision} is not one of 32, 64")
    entry = integral(name)
    _refuse_lit(entry)
    tolerance, relative = tolerances(tolerance, relative_tolerance, DEFAULT_TOLERANCE[precision])
    slots = slots_of(entry, ndf, masking, fresnel, diffuse, brdf)
    grid = grid_of(entry, slots, dict(parameters), backfacing)
    on = device if isinstance(device, Device) else choose_device(device)
    if precision == 64 and not on.fp64:
        raise UnsupportedError(f"{on.identity()['name']} has no float64")
    parts = parts_of(on, entry, slots, precision)
    components = parts[0].components
    shape = grid.shape if components == 1 else (*grid.shape, components)
    values = room_for(shape, precision, out)
    errors = room_for_errors(grid.shape, out, out_errors)
    flat = values.reshape(grid.size, components)
    totals, error, over = Totals(), 0.0, (0.0, 0.0, 0.0)
    for begin in range(0, grid.size, CELLS_A_LAUNCH):
        end = min(begin + CELLS_A_LAUNCH, grid.size)
        found = [
            _average(part, grid, begin, end, tolerance, totals, relative)
            if entry.name == "albedo_average"
            else _at_grazing(part, grid.rows(part, begin, end), tolerance, totals, relative)
            for part in parts
        ]
        total, off = sum(values for values, _ in found), np.asarray(sum(errors for _, errors in found))
        flat[begin:end] = np.asarray(total).T
        if errors is not None:
            errors.reshape(-1)[begin:end] = off
        error = max(error, float(off.max()))
        over = max(over, _furthest(off, np.abs(np.asarray(total)).max(0), tolerance, relative, precision))
        if progress:
            progress(end / grid.size)
    return Integrated(
        values,
        error,
        totals.evaluations,
        time.perf_counter() - start,
        totals.rule.name if totals.rule else "",
        (
            *totals.notices(),
            *(missed_relative(over, relative) if relative else missed(error, tolerance, precision)),
            *_of_files(parts, flat),
        ),
        errors,
    )


def tolerances(absolute: float | None, relative: float | None, default: float) -> tuple[float, float]:
    """Return the absolute and the relative tolerance, of which a cell needs the larger. 0 stands for none.

    default: the absolute tolerance where neither is given. Raises UsageError.
    """
    if relative is not None and (not is_number(relative) or not 0 < relative < 1):
        raise UsageError(f"relative_tolerance {relative!r} is outside (0, 1)")
    if absolute is None:
        absolute = default if relative is None else 0.0
    if not is_number(absolute) or not (0 < absolute < 1 or (absolute == 0 and relative is not None)):
        raise UsageError(f"tolerance {absolute!r} is outside (0, 1)")
    return float(absolute), float(relative or 0.0)


def _furthest(
    errors: np.ndarray, size: np.ndarray, tolerance: float, relative: float, precision: int
) -> tuple[float, float, float]:
    """Return the largest ratio of an error to what the cell allows, with that error and the size of its value."""
    with np.errstate(invalid="ignore", divide="ignore"):  # values that are infinite, as Minnaert's at grazing
        allowed = np.maximum(np.maximum(tolerance, relative * size), ROUNDING[precision] * size)
        ratio = np.where(np.isfinite(size) & (errors > 0), errors / allowed, 0.0)
    worst = int(np.argmax(ratio))
    return float(ratio[worst]), float(errors[worst]), float(size[worst])


def missed_relative(over: tuple[float, float, float], relative: float) -> Iterator[str]:
    """Yield a notice where an error misses the tolerance by more than twice; `over` is what `_furthest` returns."""
    ratio, error, size = over
    if not ratio <= 2:
        yield (
            f"the error of {error:.2g} of a value of {size:.2g} is over the relative tolerance of {relative:g}: the "
            "finest rule did not reach it"
        )


def missed(error: float, tolerance: float, precision: int) -> Iterator[str]:
    """Yield a notice where the error misses the tolerance by more than twice the rounding of a value of 1.

    precision: 32 or 64 bits.
    """
    if not error <= 2 * max(tolerance, ROUNDING[precision]):
        yield f"the error of {error:.2g} is over the tolerance of {tolerance:g}: the finest rule did not reach it"


def _of_files(parts: Sequence[Part], flat: np.ndarray) -> Iterator[str]:
    """Return notices about models from a file: the norm that was divided out, or the range of the albedo."""
    for part in parts:
        for entry in part.slots.values():
            low, high = part.norms
            if entry.text is not None and entry.slot == "ndf":
                some = f"{low:.4g}" if high - low <= 1e-4 * high else f"{low:.4g} to {high:.4g}"
                yield f"{entry.path}: ∫ D(m)(n·m) dω = {some}" + (
                    "" if part.entry.name == "normalization" else ", divided out"
                )
            elif entry.text is not None:
                yield f"{entry.path}: albedo from {flat.min():.4g} to {flat.max():.4g}"


@dataclass(frozen=True)
class TableSpec:
    """A description of the array that `integrate` would compute with the same arguments.

    entry    the integral
    slots    models by slot
    shape    shape of `values`
    digests  digests of the kernels

    The arguments `precision`, `tolerance`, `device`, `out` and `progress` do not change it.
    """

    entry: Integral
    slots: Mapping[str, Chosen]
    shape: tuple[int, ...]
    digests: tuple[str, ...]


def table_spec(
    name: str,
    *,
    ndf: Spec | None = None,
    masking: Spec = "smith",
    fresnel: Spec = "one",
    diffuse: Spec | None = None,
    brdf: Spec | None = None,
    backfacing: str | None = None,
    **parameters: Any,
) -> TableSpec:
    """Check the arguments of `integrate` without a device, and describe what it would compute.

    Raises the errors of `integrate` for its arguments.
    """
    entry = integral(name)
    _refuse_lit(entry)
    slots = slots_of(entry, ndf, masking, fresnel, diffuse, brdf)
    shape = grid_of(entry, slots, dict(parameters), backfacing).shape
    digests = [_program(entry, some, 0).digest for some in summands_of(slots)]
    digests += [
        source.kinked(_integrand(entry), some, count).digest
        for some in summands_of(slots)
        if entry.support == "HALF_ANGLE" and "ndf" in some and some["ndf"].isotropic and (count := edge_count(some))
    ]
    digests += [source.closed(own, some).digest for some in summands_of(slots) if (own := own_kernel_of(entry, some))]
    if "ndf" in slots and slots["ndf"].model.isotropic:
        digests.append(source.area(slots["ndf"].model).digest)  # of the table, should it be needed
    components = 3 if "brdf" in slots else entry.components
    return TableSpec(entry, slots, shape if components == 1 else (*shape, components), tuple(digests))


def room_for(shape: tuple[int, ...], precision: int, out: np.ndarray | None) -> np.ndarray:
    """Return the array for the values: `out`, or a new one of `shape`.

    precision: 32 or 64 bits. Raises UsageError for an `out` of another shape or dtype.
    """
    if out is None:
        return np.empty(shape, np.dtype(f"f{precision // 8}"))
    if out.shape != shape or not out.flags.c_contiguous or out.dtype.kind != "f":
        raise UsageError(f"out is {out.dtype} of shape {out.shape}; needed is a contiguous array of floats, {shape}")
    return out


def room_for_errors(shape: tuple[int, ...], out: np.ndarray | None, errors: np.ndarray | None) -> np.ndarray | None:
    """Return the array for the errors of the cells: the one given, or a new one unless `out` saves memory.

    Raises UsageError for an array of another shape or dtype.
    """
    if errors is None:
        return np.empty(shape) if out is None else None
    if errors.shape != shape or not errors.flags.c_contiguous or errors.dtype.kind != "f":
        raise UsageError(
            f"out_errors is {errors.dtype} of shape {errors.shape}; needed is a contiguous array of floats, {shape}"
        )
    return errors


# ---------------------------------------------------------------------------------------------- what is asked


def _refuse_lit(entry: Integral) -> None:
    if entry.name == "radiance":
        raise UsageError("integral radiance needs a light or an environment: whitefurnace.integrate takes them")


USUAL = {"masking": "smith", "fresnel": "one"}
"""Models of the slots that have one where none is given."""


def refuse_unused(given: Mapping[str, Spec], used: Collection[str], why: str) -> None:
    """Refuse models that an integral would ignore. The usual ones are left out in silence.

    given: models by slot, of masking and fresnel. used: slots that count. why: begins the message. Raises UsageError.
    """
    for slot, spec in given.items():
        if slot in used or (isinstance(spec, str) and spec == USUAL[slot]):
            continue
        choice = chosen(slot, spec)
        if choice.given or choice.model is not model(slot, USUAL[slot]):
            raise UsageError(f"{why}: leave out the {slot} {choice.model.name}")


def slots_of(
    entry: Integral, ndf: Spec | None, masking: Spec, fresnel: Spec, diffuse: Spec | None, brdf: Spec | None
) -> dict[str, Chosen]:
    """Return the models of the slots that an integral needs. Other slots are not compiled in.

    Raises UsageError and UnsupportedError for models that do not fit together or that the integral does not use.
    """
    albedo = entry.name in ("albedo", "albedo_average", "radiance")
    if not albedo and (diffuse is not None or brdf is not None):
        raise UnsupportedError(
            f"integral {entry.name} is of an NDF; a diffuse model or a BRDF has albedo, albedo_average and radiance"
        )
    if brdf is not None:
        if ndf is not None or diffuse is not None:
            raise UsageError("a brdf is whole: give it without an ndf and a diffuse model")
        refuse_unused({"masking": masking, "fresnel": fresnel}, (), "a brdf is whole")
        return {"brdf": chosen("brdf", brdf)}
    slots: dict[str, Chosen] = {}
    if ndf is not None:
        asked: dict[str, Spec] = {"ndf": ndf, "masking": masking, "fresnel": fresnel}
        wanted = {need.split("_")[0].lower() for need in entry.needs}
        unused = {"masking": masking, "fresnel": fresnel}
        refuse_unused(unused, wanted, f"integral {entry.name} does not depend on it, being {entry.about}")
        slots = {slot: chosen(slot, spec) for slot, spec in asked.items() if slot in wanted}
        provided = {f for choice in slots.values() for f in choice.model.provides}
        missing = [f for f in entry.needs if f not in provided and f.split("_")[0].lower() in slots]
        if missing:
            owners = [(slots[f.split("_")[0].lower()].model, f.split("_", 1)[1]) for f in missing]
            raise UnsupportedError(
                f"integral {entry.name}: "
                + ", ".join(f"{owner.slot} {owner.name} has no {what}" for owner, what in owners)
            )
    elif diffuse is None:
        raise UsageError(f"integral {entry.name} needs an ndf{', a diffuse model or a brdf' if albedo else ''}")
    else:
        refuse_unused(
            {"masking": masking, "fresnel": fresnel}, (), "masking and fresnel are of an NDF, and none is given"
        )
    if diffuse is not None:
        slots["diffuse"] = chosen("diffuse", diffuse)
    return slots


@dataclass(frozen=True)
class Grid:
    """Broadcast columns of numbers by name (`NoV`, `ndf_alpha`), read in parts: no array of the grid's size exists.

    shape  the broadcast shape
    rgb    True if the last axis is that of the RGB channels
    """

    shape: tuple[int, ...]
    columns: Mapping[str, np.ndarray]
    rgb: bool = False  # the last axis is that of the channels

    @property
    def size(self) -> int:
        """Number of cells."""
        return int(np.prod(self.shape, dtype=np.int64))

    def part(self, name: str, begin: int, end: int) -> np.ndarray:
        """Return cells `begin` to `end` - 1 of a column, float64."""
        column = self.columns[name]
        return (
            np.full(end - begin, float(column))
            if column.ndim == 0
            else np.asarray(np.broadcast_to(column, self.shape).flat[begin:end], np.float64)
        )

    def rows(self, part: Part, begin: int, end: int) -> np.ndarray:
        """Return the parameters of one part of the BRDF for cells `begin` to `end` - 1: (rows, end - begin), view
        first.
        """
        names = [*part.view, *(f"{slot}_{p.name}" for slot, m in part.slots.items() for p in m.parameters)]
        return np.stack([self.part(name, begin, end) for name in names])


def grid_of(entry: Integral, slots: Mapping[str, Chosen], given: dict[str, Any], backfacing: str | None) -> Grid:
    """Return every number that the kernels need, checked against its domain, with the broadcast shape.

    given: the parameters by name; those that are used are removed from it. Raises UsageError for numbers outside their
    domain, unknown or missing names, and shapes that do not broadcast.
    """
    columns: dict[str, Any] = {}
    rgb: set[str] = set()
    isotropic = (
        all(choice.model.isotropic for choice in slots.values()) and "brdf" not in slots and entry.name != "radiance"
    )
    names = {p.name for choice in slots.values() for p in choice.model.parameters}
    known = ["NoV", *([] if isotropic else ["phi"]), *sorted(names)] if entry.view else sorted(names)
    qualified_names = {f"{slot}_{p.name}" for slot, choice in slots.items() for p in choice.model.parameters}
    # Unknown names come before missing ones: a misspelt name is the reason why another is missing.
    for name in sorted(set(given) - {*known, *qualified_names}):
        raise UsageError(f"integral {entry.name} has no parameter {name!r}{_suggested(name, known)}")
    if backfacing is not None and not entry.view:
        raise UsageError(f"integral {entry.name} has no view direction: leave out backfacing")
    columns["NoV"] = np.ones(())
    columns["phi"] = np.zeros(())
    if entry.view:
        if "NoV" not in given:
            raise UsageError(f"integral {entry.name} needs NoV, the cosine of the view angle")
        columns["NoV"] = _view(given.pop("NoV"), backfacing)
        if not isotropic and "phi" in given:
            columns["phi"] = _finite_array("phi", given.pop("phi"))
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
    for name in sorted(set(given) - used):
        raise UsageError(f"{name!r} is given, and for each model that has it also with the name of its slot; give one")
    if rgb:
        columns = {k: v if k in rgb else np.asarray(v)[..., None] for k, v in columns.items()}
    try:
        shape = np.broadcast_shapes(*(np.shape(v) for v in columns.values()))
    except ValueError:
        raise UsageError(
            "parameters do not broadcast: shapes "
            + ", ".join(f"{k} {np.shape(v)}" for k, v in columns.items() if np.ndim(v))
        ) from None
    if 0 in shape:
        raise UsageError("parameters hold no cell: an array is empty")
    return Grid(shape, columns, bool(rgb))


def _suggested(name: str, known: Sequence[str]) -> str:
    """Return the end of the error message for an unknown parameter: a misspelt keyword of `integrate` is one too."""
    keywords = [key for key in inspect.signature(integrate).parameters if key not in ("name", "parameters")]
    if name in OF_OTHERS:
        return f"; it is called {OF_OTHERS[name]} here"
    # At .8 and above one or two letters differ.
    close = difflib.get_close_matches(name.casefold(), keywords, n=1, cutoff=0.8)
    return nearest(name, close or known)


def _finite_array(name: str, given: Any) -> np.ndarray:
    try:
        array = np.asarray(given, np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{name} must be a number, not {given!r}") from None
    if not np.isfinite(array).all():
        raise UsageError(f"{name} must be finite")
    return array


def _view(given: Any, backfacing: str | None) -> np.ndarray:
    """Return n·v in [0, 1]. Views from behind are treated as asked; the rounding of a dot product is accepted."""
    _finite_array("NoV", given)
    NoV = np.asarray(held(held(given, 0.0, 1.0), -1.0, 1.0) if backfacing is None else held(given, -1.0, 1.0))
    if backfacing is not None and backfacing not in BACKFACING:
        raise UsageError(f"unknown backfacing {backfacing!r}{nearest(backfacing, BACKFACING)}")
    if backfacing == "clamp":
        NoV = np.where((NoV < 0) & (NoV >= -1), 0.0, NoV)
    elif backfacing == "absolute":
        NoV = np.abs(NoV)
    bad = ~((NoV >= 0) & (NoV <= 1))
    if bad.any():
        behind = (NoV < 0).any() and backfacing is None
        raise UsageError(
            f"NoV = {NoV[bad].flat[0]:g} is outside [0, 1] (cosine of the view angle)"
            + ("; views from behind want backfacing = clamp or absolute" if behind else "")
        )
    return NoV


# ---------------------------------------------------------------------------------------------- how it is done


@dataclass
class Part:
    """One summand of the BRDF on a device: the specular one, the diffuse one or a user's whole BRDF.

    closed  kernel file of an integral that has its own, or None
    kinked  True for cells whose panels meet at the kinks of their models
    areas   tables of Smith's area by precision
    norms   smallest and largest norm of a user's NDF so far
    """

    device: Device
    entry: Integral
    slots: dict[str, Model]
    precision: int
    closed: str | None = None  # the file of a kernel of its own
    kinked: bool = False
    areas: dict[int, Areas] = field(default_factory=dict)
    norms: tuple[float, float] = (np.inf, 0.0)

    @property
    def kind(self) -> str:
        """Key of `LADDERS`: the sequence of rules with which this part is integrated."""
        if self.closed:
            return "light-angles"
        if self.kinked:
            return "kinked"
        if "ndf" in self.slots:
            if self.entry.support == "ALL":
                return "polar" if self.slots["ndf"].isotropic else "stretched"
            return "gauss" if self.slots["ndf"].isotropic else "stretched"
        return "hemisphere" if "diffuse" in self.slots else "half-vectors"

    @property
    def view(self) -> tuple[str, ...]:
        """Names of the numbers that describe the view, the first rows of a cell."""
        return ("NoV",) if self.kind in ("gauss", "kinked", "polar", "hemisphere", "light-angles") else ("NoV", "phi")

    @property
    def components(self) -> int:
        """Number of components of one value."""
        return 3 if self.kind == "half-vectors" else self.entry.components

    @property
    def tabulated(self) -> bool:
        """True if the masking reads Smith's area from a table."""
        needs = {f for m in self.slots.values() for f in m.needs}
        return "NDF_AREA" in needs and "NDF_AREA" not in self.slots["ndf"].provides

    def cells(self, rows: np.ndarray, precision: int, tolerance: float = 0.0) -> tuple[np.ndarray, int, float]:
        """Return rows as kernels read them, the length of the table of Smith's area, and the error of that table.

        rows: view and parameters, (k, n) float64. tolerance: ten times the largest error that the table may have.
        """
        count = len(self.view)
        read, out, ndf = count, [rows[:count]], None
        if self.kinked:
            out += self._edges(rows)
        for entry in self.slots.values():
            numbers = numbers_of(self.device, entry, rows[read : read + len(entry.parameters)])
            if entry.slot == "ndf" and entry.text is not None:
                at = entry.arguments.index("per_norm")
                self.norms = (min(self.norms[0], 1 / numbers[at].max()), max(self.norms[1], 1 / numbers[at].min()))
                if self.entry.name == "normalization":
                    numbers[at] = 1  # the raw norm is asked for
            ndf = numbers if entry.slot == "ndf" else ndf
            out.append(numbers)
            read += len(entry.parameters)
        terms, error = 0, 0.0
        if self.tabulated:
            assert ndf is not None
            if precision not in self.areas:
                self.areas[precision] = Areas(self.device, self.slots["ndf"], precision)
            table = self.areas[precision].table(ndf, tolerance)
            out.append(table.rows)
            terms, error = table.length, table.error
        return np.concatenate(out), terms, error

    def kinks(self, rows: np.ndarray) -> np.ndarray:
        """Return the polar angles at which kinks want panels to meet, (k, n), NaN for none."""
        found, read = [np.empty((0, rows.shape[1]))], len(self.view)
        for entry in self.slots.values():
            if entry.kinks:
                own = {p.name: rows[read + k] for k, p in enumerate(entry.parameters)}
                found.append(entry.kinks.angles(rows[0], **own))
            read += len(entry.parameters)
        return np.concatenate(found)

    def _edges(self, rows: np.ndarray) -> list[np.ndarray]:
        """Return the polar angles at which panels meet, in their order, and their complements to π/2: (k, n) each."""
        above = np.arctan2(rows[0], np.sqrt((1 - rows[0]) * (1 + rows[0])))
        kinks, end = self.kinks(rows), np.pi / 2 - above / 2
        # Where a panel of ring.clh ends, and the end of all for what lies beyond it.
        edges = np.concatenate([kinks, above[None] / 2])
        inside = (edges > 0) & (edges < end)
        edges, rests = np.where(inside, edges, end), np.where(inside, np.pi / 2 - edges, above / 2)
        order = np.argsort(edges, 0)
        return [np.take_along_axis(some, order, 0) for some in (edges, rests)]

    @property
    def slow(self) -> float:
        """Largest ratio of a rule's error to its change from the rule before."""
        return 1.0 if self.kinked else max(m.checks.slow_rules or 1.0 for m in self.slots.values())

    @property
    def ladder(self) -> tuple[Rule, ...]:
        """The rules of this part, from the coarsest to the finest."""
        if self.kinked:
            kinks = [entry.kinks for entry in self.slots.values() if entry.kinks]
            panels = (1 + sum(k.on_ring for k in kinks)) * (2 + edge_count(self.slots) - 1)
            return tuple(replace(rule, panels=panels) for rule in LADDERS[self.kind])
        return LADDERS[self.kind]

    def lanes(self, cells: np.ndarray) -> int:
        """Return the number of integrals that the kernel sums for these cells."""
        return cells.shape[1]

    def text(self, terms: int) -> str:
        """Return the kernel text for a table of Smith's area of `terms` terms."""
        if self.closed:
            return source.closed(self.closed, self.slots).text
        if self.kinked:
            return source.kinked(_integrand(self.entry), self.slots, edge_count(self.slots), terms).text
        return _program(self.entry, self.slots, terms).text

    def sum(self, cells: np.ndarray, terms: int, rule: Rule, precision: int) -> np.ndarray:
        """Return the sums of one rule over cells: (components, n) in the working precision."""
        return over_nodes(self.device, self.text(terms), "integrate", cells, self.components, precision, rule)


def _program(entry: Integral, slots: Mapping[str, Model], terms: int) -> source.Source:
    """The kernel text of one summand of the BRDF."""
    if "ndf" in slots:
        return source.integration(_integrand(entry), slots, terms)
    return source.hemisphere(next(iter(slots.values())))


def _integrand(entry: Integral) -> Integral:
    """The integral whose kernel serves `entry`: an average is one of many albedos."""
    return integral("albedo") if entry.name == "albedo_average" else entry


def edge_count(slots: Mapping[str, Model]) -> int:
    """Return the number of polar angles at which panels of models with kinks meet; 0 where no model has kinks."""
    count = 0
    for entry in slots.values():
        if entry.kinks:
            count += len(entry.kinks.angles(np.ones(1), **{p.name: np.array([p.low]) for p in entry.parameters}))
    return count + 1 if count else 0


def own_kernel_of(entry: Integral, slots: Mapping[str, Model]) -> str | None:
    """Return the kernel file that is written for this integral and these models alone, or None."""
    if "ndf" not in slots or any(m.text is not None for m in slots.values()):
        return None
    names = [m.name for m in slots.values()]
    return CLOSED.get((entry.name, names[0], names[1])) if len(names) == 2 else None


def summands_of(slots: Mapping[str, Chosen]) -> list[dict[str, Model]]:
    """Return the models of each summand of the BRDF: the specular one, the diffuse one or a user's whole BRDF."""
    specular = {slot: c.model for slot, c in slots.items() if slot in ("ndf", "masking", "fresnel")}
    return [
        some
        for some in (specular, *({slot: slots[slot].model} for slot in ("diffuse", "brdf") if slot in slots))
        if some
    ]


def parts_of(device: Device, entry: Integral, slots: Mapping[str, Chosen], precision: int) -> list[Part]:
    """Return the parts of a BRDF on a device, one for each summand."""
    return [Part(device, entry, some, precision) for some in summands_of(slots)]


@dataclass
class Totals:
    """Running totals of an integration.

    error        largest estimated error
    evaluations  evaluations of the integrand
    rule         finest rule used
    promoted     number of cells that were computed in float64 after float32 missed the tolerance
    """

    error: float = 0.0
    evaluations: int = 0
    rule: Rule | None = None
    promoted: int = 0

    def used(self, rule: Rule, cells: int) -> None:
        """Count one launch of `rule` over `cells` cells."""
        self.evaluations += rule.evaluations * cells
        if self.rule is None or rule.evaluations > self.rule.evaluations:
            self.rule = rule

    def notices(self) -> tuple[str, ...]:
        """Return a sentence about promoted cells, or nothing where there are none."""
        many = "1 cell was" if self.promoted == 1 else f"{self.promoted} cells were"
        return (f"{many} done in float64: float32 did not reach the tolerance there",) if self.promoted else ()


def climb(
    part: Part,
    rows: np.ndarray,
    tolerance: float,
    totals: Totals,
    precision: int | None = None,
    relative: float = 0.0,
) -> np.ndarray:
    """Return the values of `climb_with_errors` alone, (components, n)."""
    return climb_with_errors(part, rows, tolerance, totals, precision, relative)[0]


@np.errstate(invalid="ignore", over="ignore", divide="ignore")  # values infinite in float32 are computed in float64
def climb_with_errors(
    part: Part,
    rows: np.ndarray,
    tolerance: float,
    totals: Totals,
    precision: int | None = None,
    relative: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate cells by finer and finer rules until two neighbouring rules agree: (components, n) and errors (n,).

    rows: view and parameters, (k, n). tolerance, relative: a cell's two rules may differ by the larger of the absolute
    tolerance and the relative one times its value; each block of cells continues until all of its cells agree, and
    each of them states the largest of the block's differences, measured in what each allows. totals: gets the error
    and the work. precision: 32 or 64 bits, None for that of the part. Raises CheckError for values that are not finite.
    """
    precision = precision or part.precision
    ladder = part.ladder
    coarse = max(tolerance, relative)
    cells, terms, floor = part.cells(rows, precision, coarse)
    n = rows.shape[1]
    # A coarse tolerance starts low, a tight one where the tables of the rules say it can end.
    first = 0 if coarse >= 1e-3 else 1 if coarse >= 1e-5 else 3 if coarse >= 1e-8 else 5
    values = part.sum(cells, terms, ladder[first], precision).astype(np.float64)
    errors = np.zeros(n)
    totals.used(ladder[first], part.lanes(cells))
    active = np.arange(n)
    left = np.empty(0)
    slow = part.slow
    before = np.where(np.minimum(BLOCK, n - np.arange(0, n, BLOCK)) < BLOCK, np.inf, 0.0)
    for rule in ladder[first + 1 :]:
        fine = part.sum(cells[:, active], terms, rule, precision).astype(np.float64)
        totals.used(rule, part.lanes(cells[:, active]))
        starts = np.arange(0, active.size, BLOCK)
        own = np.abs(fine)
        # An absolute tolerance is one for a block, and so is the rounding beside it.
        size = own if relative else np.repeat(np.maximum.reduceat(own.max(0), starts), BLOCK)[: active.size]
        rounding = ROUNDING[precision] * size
        # 1e-300 stands for a value of 0 without an absolute tolerance, which agrees with 0 alone.
        allowed = np.broadcast_to(
            np.maximum(np.maximum(tolerance, relative * size) - rounding, np.maximum(rounding, 1e-300)), fine.shape
        )
        off = np.abs(fine - values[:, active])
        ratio = np.where(off == 0, 0.0, off / allowed).max(0)
        values[:, active] = fine
        step = slow * np.maximum.reduceat(ratio, starts)
        change, before = np.maximum(step, before / LUCK), step
        open_ = ~(change <= 1)
        keep = np.repeat(open_, BLOCK)[: active.size]
        change = np.repeat(change, BLOCK)[: active.size]
        stated = change * allowed + (ROUNDING[precision] + floor) * own
        errors[active[~keep]] = stated[:, ~keep].max(0)
        # At the end of the ladder differences add up.
        left = (stated + (max(UNFINISHED / slow, 1) - 1) * change * allowed)[:, keep].max(0)
        before = before[open_]
        active = active[keep]
        if active.size == 0:
            break
    if active.size and precision == 32 and part.device.fp64:
        # Whole ladders end within float32's reach or stop at its rounding: float64 goes on from here.
        totals.promoted += active.size
        found = climb_with_errors(part, rows[:, active], tolerance, totals, 64, relative)
        values[:, active], errors[active] = found
    elif active.size:
        if not np.isfinite(left).all():
            raise CheckError(
                f"integral {part.entry.name} is not finite for some of these parameters in "
                f"float{precision}{_example(part, rows, values)}"
            )
        errors[active] = left
    totals.error = max(totals.error, float(errors.max(initial=0.0)))
    return values, errors


def _example(part: Part, rows: np.ndarray, values: np.ndarray) -> str:
    """The first cell whose value is not finite, for a message."""
    bad = np.flatnonzero(~np.isfinite(values).all(0))
    if bad.size == 0:
        return ""
    names = [*part.view, *(p.name for m in part.slots.values() for p in m.parameters)]
    return ": " + ", ".join(f"{name} = {value:g}" for name, value in zip(names, rows[:, bad[0]], strict=True))


def with_kinks(
    part: Part, rows: np.ndarray, tolerance: float, totals: Totals, relative: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate as `climb_with_errors` does, with panels that meet at the kinks in those cells that have some."""
    if part.kind != "gauss" or part.entry.support != "HALF_ANGLE" or not edge_count(part.slots):
        return climb_with_errors(part, rows, tolerance, totals, relative=relative)
    kinked = np.isfinite(part.kinks(rows)).any(0)
    values, errors = np.empty((part.components, rows.shape[1])), np.empty(rows.shape[1])
    for some, how in ((kinked, replace(part, kinked=True)), (~kinked, part)):
        if some.any():
            values[:, some], errors[some] = climb_with_errors(how, rows[:, some], tolerance, totals, relative=relative)
    return values, errors


def _at_grazing(
    part: Part, rows: np.ndarray, tolerance: float, totals: Totals, relative: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate as `with_kinks` does, or by a kernel that is written for these models.

    The value is infinite where a diffuse albedo is infinite at n·v = 0, as its closed form says (Minnaert's).
    """
    own_kernel, far = own_kernel_of(part.entry, part.slots), rows[0] >= CLOSED_FROM[0]
    if own_kernel and max(tolerance, relative) >= CLOSED_FROM[1] and far.any():
        values, errors = np.empty((part.components, rows.shape[1])), np.empty(rows.shape[1])
        for some, how in ((far, replace(part, closed=own_kernel)), (~far, part)):
            if some.any():
                values[:, some], errors[some] = climb_with_errors(
                    how, rows[:, some], tolerance, totals, relative=relative
                )
        return values, errors
    along = np.flatnonzero(rows[0] == 0) if "diffuse" in part.slots else np.empty(0, int)
    closed = part.slots["diffuse"].reference.get("albedo") if along.size else None
    if closed is None:
        return with_kinks(part, rows, tolerance, totals, relative)
    own = {p.name: rows[1 + k, along] for k, p in enumerate(part.slots["diffuse"].parameters)}
    with np.errstate(all="ignore"):
        infinite = along[np.isinf(closed(rows[0, along], **own))]
    rows[0, infinite] = 1  # any view that has an answer
    values, errors = climb_with_errors(part, rows, tolerance, totals, relative=relative)
    values[:, infinite], errors[infinite] = np.inf, 0.0
    return values, errors


def _average(
    part: Part, grid: Grid, begin: int, end: int, tolerance: float, totals: Totals, relative: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return 2∫ E(μ) μ dμ with μ = x², (components, n), and errors (n,), by rules of more and more nodes.

    The grazing end needs many.
    """
    out, errors = np.empty((part.components, end - begin)), np.empty(end - begin)
    for some in _slices(begin, end, 512):
        rows = grid.rows(part, *some)
        before: np.ndarray | None = None
        last = np.inf  # two steps must be small: one alone can be luck
        for count in AVERAGE_RULES:
            x, w = gauss(count)
            many = np.repeat(rows, count, 1)
            many[0] = np.tile(x * x, rows.shape[1])
            inner = Totals()
            E, off = with_kinks(part, many, tolerance / 2, inner, relative / 2)
            totals.evaluations += inner.evaluations
            totals.promoted += inner.promoted
            totals.rule = inner.rule
            value = E.reshape(part.components, rows.shape[1], count) @ (4 * w * x**3)
            within = off.reshape(-1, count).max(1) if relative else np.full(rows.shape[1], inner.error)
            unit = np.maximum(tolerance, np.maximum(relative * np.abs(value), 1e-300))
            with np.errstate(invalid="ignore", divide="ignore"):
                ratio = 0.0 if before is None else np.where(value == before, 0.0, np.abs(value - before) / unit)
            step = np.inf if before is None else float(np.max(ratio))
            change, last = max(step, last), step if before is not None else last
            before, unit = value, unit.max(0)
            stated = change * unit + within
            if (stated <= np.maximum(unit, 2 * within)).all():
                break
        place = slice(some[0] - begin, some[1] - begin)
        out[:, place], errors[place] = value, stated
    totals.error = max(totals.error, float(errors.max()))
    return out, errors


def _slices(begin: int, end: int, step: int) -> Iterator[tuple[int, int]]:
    for k in range(begin, end, step):
        yield k, min(k + step, end)


def dfg(
    size: int = 128,
    *,
    ndf: Spec = "ggx",
    masking: Spec = "smith",
    tolerance: float | None = None,
    relative_tolerance: float | None = None,
    precision: int = 32,
    device: Device | str | None = None,
) -> Integrated:
    """Compute the split-sum table of a specular BRDF: `values` (size, size, 2) as [y, x, (scale, bias)].

    size: texels on an edge, 1 to 4096. x is n·v = (x + ½)/size, and y is perceptual roughness r = (y + ½)/size, α = r²,
    with the smoothest in row 0.
    ndf, masking: models, as in `integrate`. E(v; F0) = F0·scale + bias for Schlick's Fresnel with F90 = 1.
    tolerance, relative_tolerance, precision, device: as in `integrate`, but 5e-6 where no tolerance is given.

    Raises the errors of `integrate`.
    """
    if tolerance is None and relative_tolerance is None:
        tolerance = 5e-6
    if not 1 <= size <= 4096:
        raise UsageError(f"dfg size {size} is outside [1, 4096]")
    axis = (np.arange(size) + 0.5) / size
    choice = chosen("ndf", ndf)
    rows: dict[str, Any] = rows_of_roughness(choice, axis[:, None])
    return integrate(
        "dfg",
        ndf=choice,
        masking=masking,
        tolerance=tolerance,
        relative_tolerance=relative_tolerance,
        precision=precision,
        device=device,
        NoV=np.broadcast_to(axis, (size, size)),
        **rows,
    )


def rows_of_roughness(choice: Chosen, r: np.ndarray) -> dict[str, np.ndarray]:
    """Return the parameters of a model that follow perceptual roughness, by name, at roughnesses of any shape.

    r: perceptual roughness in [0, 1]. Parameters that were given with the model are fixed and not returned. Raises
    UnsupportedError for a model without any parameter that follows roughness.
    """
    entry = choice.model
    if entry.from_roughness is None:
        raise UnsupportedError(f"{entry.slot} {entry.name} has no parameter that follows roughness")
    sets = [entry.from_roughness(float(x)) for x in r.ravel()]
    # A table's first row may fall below a domain by half a texel of roughness.
    ends = {p.name: (p.low, p.high) for p in entry.parameters}
    return {
        f"{entry.slot}_{name}": np.clip(np.array([s[name] for s in sets]).reshape(r.shape), *ends[name])
        for name in sets[0]
        if name not in choice.given
    }


__all__ = ["Integrated", "dfg", "integrate", "model"]
