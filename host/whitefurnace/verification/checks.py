"""Checks of models, derived from the facts in their catalogue entries: one row for each check, with its worst cell."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import NormalDist
from typing import Any
from zlib import crc32

import numpy as np

from whitefurnace.catalogue import SLOTS, Model, Parameter, models
from whitefurnace.catalogue.choice import chosen, file_of
from whitefurnace.catalogue.user import user_model
from whitefurnace.errors import CheckError, InputError, UnsupportedError, UsageError, nearest
from whitefurnace.integrals.normals import sample
from whitefurnace.integrals.quadrature import integrate
from whitefurnace.integrals.radiance import radiance
from whitefurnace.opencl.derived import numbers_of
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import evaluate
from whitefurnace.opencl.source import LEAST_COSINE

PRECISIONS = (32, 64)
ROUNDING = {32: 2.0**-24, 64: 2.0**-53}
RELATIVE = {32: 8 * 2.0**-24, 64: 1e-13}
"""Largest relative error of a kernel in addition to the effect of its arguments' rounding: a few roundings. In float64
the references' own quadratures have more, 1e-14."""
SMALLEST = {32: 1e-32, 64: 1e-300}
"""Below this, relative to the peak, kernels may round D to 0: exp does at 1e-38 (special.clh), and 1/cos⁴θ, 1e6 at most
where it is not held, may come after it."""

RULE = {32: 1e-6, 64: 1e-12}
"""Tolerances for direct quadrature."""

INTEGRAL = {32: 1.25e-6, 64: 1.02e-12}
"""Largest error of a value of 1 by direct quadrature: 1e-6 and 1e-12, and a rounding or two of the value itself."""

ENERGY = 1e-6
"""Largest amount by which an albedo may exceed its bound, in both precisions: the tolerance of the rule."""

FINITE = float(np.finfo(np.float32).max)

FAMILY = 1e-4
"""Probability that a correct sampler fails any of its χ² tests: one level for all tests together."""

# n·v from grazing to normal, the ends thicker.
NOV = np.array([0.0, 1e-4, 1e-3, 1 / 64, 0.1, 0.3, 0.6, 0.9, 0.999, 1.0])
# Angles with both ends thicker, without those where sine or cosine is 0.
ANGLES = np.concatenate(
    [np.geomspace(1e-6, 0.1, 26), np.linspace(0.15, 1.4, 12), math.pi / 2 - np.geomspace(0.1, 1e-6, 16)]
)
PHI = np.array([0.0, 0.4, math.pi / 2, 2.5])

Columns = dict[str, np.ndarray]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Row:
    """The result of one check of a model at its worst cell, where the error takes the largest share of the tolerance.

    slot, model, check, precision: what was checked; precision is 32 or 64 bits.
    parameters: parameters of the worst cell.
    value, expected, error, tolerance: numbers of that cell. `error` is |value - expected|; if `expected` is a bound, it
    is the amount by which the value exceeds it. `tolerance` is absolute; it is None for a value that is only measured.
    passed, cells: the verdict, and the number of cells.
    note: a remark for readers.
    counterexample: the failed cell with its directions, as text.
    """

    slot: str
    model: str
    check: str
    parameters: Mapping[str, float]
    precision: int
    value: float
    expected: float | None
    error: float | None
    tolerance: float | None
    passed: bool
    cells: int
    note: str = ""
    counterexample: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Subject:
    """A model and the parameters at which it is verified. Those that are not `given` run over their domain."""

    model: Model
    label: str
    given: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)


# ---------------------------------------------------------------------------------------------- what is verified


def subjects(specs: Sequence[str]) -> list[Subject]:
    """Return the models of `specs` (`ggx`, `ggx:alpha=.3`, `FILE.clh:p=v`), or the whole catalogue where it is empty.

    Raises UsageError for an unknown name, with the nearest, and for parameters without a value in a file's model.
    """
    entries = [entry for slot in SLOTS for entry in models(slot).values()]
    if not specs:
        return [Subject(entry, entry.name) for entry in entries]
    found = []
    for spec in specs:
        file, name = file_of(spec), spec.partition(":")[0]
        if file is not None:
            found += [_of_file(slot, file, spec) for slot in _slots_of(file)]
            continue
        slots = [entry.slot for entry in entries if entry.name == name]
        if not slots:
            raise UsageError(f"unknown model {name!r}{nearest(name, [entry.name for entry in entries])}")
        for slot in slots:
            choice = chosen(slot, spec)
            found.append(Subject(choice.model, choice.model.name, choice.given))
    return found


def _slots_of(path: str) -> list[str]:
    """Return the slots of the models that a file defines: an NDF, a BRDF or both."""
    defined, reasons = [], []
    for slot in ("ndf", "brdf"):
        try:
            user_model(slot, path)
            defined.append(slot)
        except InputError as error:
            reasons.append(str(error))
    if not defined:
        raise InputError("; ".join(dict.fromkeys(reasons)))  # a fault of both is reported once
    return defined


def _of_file(slot: str, path: str, spec: str) -> Subject:
    choice = chosen(slot, spec)
    missing = [p.name for p in choice.model.parameters if p.name not in choice.given]
    if missing:
        raise UsageError(
            f"{slot} {path}: {', '.join(missing)} must be given, as {Path(path).name}:"
            + ",".join(f"{name}=VALUE" for name in missing)
        )
    return Subject(choice.model, str(Path(path)), choice.given)


def verify(
    asked: Sequence[Subject], precisions: Iterable[int], device: Device, progress: Progress | None = None
) -> Iterator[Row]:
    """Run all checks of every subject in each precision, one after the other, and yield their rows.

    Raises UnsupportedError for float64 on a device without it, and the errors of a user's file.
    """
    order = [(subject, precision) for subject in asked for precision in precisions]
    if not device.fp64 and any(precision == 64 for _, precision in order):
        raise UnsupportedError(f"{device.identity()['name']} has no float64")
    for k, (subject, precision) in enumerate(order):
        if progress:
            progress(f"{subject.label}, float{precision}", k / len(order))
        bench = Bench(subject, precision, device)
        for check in CHECKS[subject.model.slot]:
            yield from check(bench)
    if progress:
        progress("done", 1.0)


# ---------------------------------------------------------------------------------------------- cells


def _between(p: Parameter) -> np.ndarray:
    """Return the typical values of a parameter, the ends of its domain, and a value between each two neighbours.

    It is the geometric mean where the neighbours are far apart, otherwise the middle.
    """
    known = sorted({*p.typical, p.low, p.high})
    middles = [math.sqrt(a * b) if a > 0 and b > 2 * a else (a + b) / 2 for a, b in pairwise(known)]
    return np.array(sorted({*known, *middles}))


def _few(p: Parameter) -> np.ndarray:
    """Return three values of a parameter: its ends and the middle one of its typical values."""
    return np.unique([p.low, sorted(p.typical or (p.low,))[len(p.typical) // 2], p.high])


def _typical(p: Parameter) -> np.ndarray:
    return np.unique([*p.typical, p.low, p.high])


def _typical_only(p: Parameter) -> np.ndarray:
    return np.unique(p.typical)


def _drawn(p: Parameter, u: np.ndarray) -> np.ndarray:
    """Return values for u in [0, 1): evenly in a domain such as [0, 1] or [0, 16], otherwise logarithmic from 1e-6
    of its end.
    """
    low = max(p.low, 1e-6 * p.high)
    even = p.high <= 20 if p.low <= 0 else p.high < 100 * p.low
    return p.low + (p.high - p.low) * u if even else low * (p.high / low) ** u


class Bench:
    """One model in one precision on one device, with functions to check it."""

    def __init__(self, subject: Subject, precision: int, device: Device) -> None:
        self.subject, self.model, self.given = subject, subject.model, subject.given
        self.precision, self.device, self.rounding = precision, device, ROUNDING[precision]

    def columns(self, values: Callable[[Parameter], np.ndarray] = _typical, draws: int = 0) -> Columns:
        """Return sets of parameters by name: the product of `values` of each, and `draws` random sets.

        Random sets come from the whole domain. Parameters that are given keep their value; an RGB value becomes three
        sets.
        """
        free = [p for p in self.model.parameters if p.name not in self.given]
        mesh = np.meshgrid(*[values(p) for p in free], indexing="ij")
        columns = {p.name: m.ravel() for p, m in zip(free, mesh, strict=True)}
        if draws and free:
            # An additive recurrence of irrational steps: as even as a lattice in every dimension.
            k = np.arange(1, draws + 1)
            for j, p in enumerate(free):
                columns[p.name] = np.append(columns[p.name], _drawn(p, k * math.sqrt((2, 3, 5, 7)[j % 4]) % 1))
        count = max((c.size for c in columns.values()), default=1)
        rgb = 3 if any(isinstance(v, tuple) for v in self.given.values()) else 1
        columns = {name: np.repeat(c, rgb) for name, c in columns.items()}
        for name, value in self.given.items():
            columns[name] = np.tile(np.broadcast_to(np.asarray(value, np.float64), (rgb,)), count)
        return {p.name: columns[p.name] for p in self.model.parameters}

    def tolerance(self, check: str, usual: Mapping[int, float]) -> float:
        """Return the tolerance of a check: the entry's own for this precision where it states one, otherwise the
        usual.
        """
        declared = self.model.checks.tolerance.get(check)
        return float(usual[self.precision] if declared is None else declared[PRECISIONS.index(self.precision)])

    def rounded(self, values: Any) -> Any:
        """Return values in float64 after rounding to the kernel's precision."""
        return np.asarray(values, f"f{self.precision // 8}").astype(np.float64)

    def kernel(
        self, function: str, arguments: Sequence[np.ndarray], columns: Columns, under: Mapping[str, Model] | None = None
    ) -> np.ndarray:
        """Evaluate a model function on the device: (components, n) float64.

        arguments: the function's own. columns: the parameters by name. under: models of other slots that its text
        needs; their parameters do not matter, since the function does not read them.
        """
        slots = {**(under or {}), self.model.slot: self.model}
        rows = []
        count = np.broadcast(*arguments, *columns.values()).size if arguments or columns else 1
        for slot, entry in slots.items():
            own = [columns[p.name] if slot == self.model.slot else np.array(_few(p)[-1]) for p in entry.parameters]
            parameters = np.stack([np.broadcast_to(c, count) for c in own]) if own else np.empty((0, count))
            rows.append(numbers_of(self.device, entry, np.asarray(parameters, np.float64)))
        given = [np.broadcast_to(np.asarray(a, np.float64), count) for a in arguments]
        cells = np.concatenate([np.stack(given) if given else np.empty((0, count)), *rows])
        if cells.shape[0] == 0:
            cells = np.zeros((1, count))  # a buffer cannot be empty; the kernel reads none of it
        return evaluate(self.device, function, slots, cells, self.precision).astype(np.float64)

    def integral(self, name: str, tolerance: float, **asked: Any) -> tuple[np.ndarray, float, str]:
        """Return the values of `integrate`, its error and its notices.

        If it raises an error, all values are NaN and the reason replaces the notices.
        """
        slots: dict[str, Any] = {self.model.slot: self.model}
        try:
            with np.errstate(invalid="ignore", over="ignore"):
                done = integrate(
                    name, precision=self.precision, tolerance=tolerance, device=self.device, **slots, **asked
                )
        except CheckError as error:
            numbers = [np.shape(v) for v in asked.values() if not isinstance(v, (str, Model))]
            return np.full(np.broadcast_shapes(*numbers), np.nan), 0.0, str(error)
        return np.asarray(done.values, np.float64), done.error, "; ".join(done.notices)

    def row(
        self,
        check: str,
        value: Any,
        expected: Any,
        tolerance: Any,
        where: Mapping[str, Any],
        *,
        bound: str = "",
        note: str = "",
    ) -> Row:
        """Return the row of the worst of all cells of `value` against `expected`.

        where: the parameters and directions of the cells by name. bound: "most" or "least" where `expected` is a bound,
        empty where it is the exact value.
        """
        names = list(where)
        shape = np.broadcast_shapes(
            np.shape(value),
            np.shape(expected),
            np.shape(tolerance),
            *(np.shape(where[n]) if n not in "lv" else np.shape(where[n])[:-1] for n in names),
        )
        value, expected, tolerance = (
            np.broadcast_to(np.asarray(a, np.float64), shape).ravel() for a in (value, expected, tolerance)
        )
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            error = value - expected if bound == "most" else expected - value if bound else np.abs(value - expected)
            error = np.where(value == expected, 0.0, error)  # equal infinities
            # Where nothing is tolerated: any excess fails, and the nearest to it is the worst.
            exact = np.where(error > 0, np.inf, error / (1 + np.abs(error)))
            share = np.where(tolerance > 0, error / np.maximum(tolerance, 1e-320), exact)
        share = np.where(np.isnan(error), np.inf, share)
        k = int(share.argmax())
        passed = bool(share[k] <= 1)
        own: dict[str, Any] = {}
        for name in names:
            if name in "lv":
                vector = np.broadcast_to(where[name], (*shape, 3)).reshape(-1, 3)[k]
                own[name] = [float(x) for x in vector]
            else:
                own[name] = float(np.broadcast_to(where[name], shape).ravel()[k])
        return Row(
            self.model.slot,
            self.subject.label,
            check,
            {n: v for n, v in own.items() if n not in "lv"},
            self.precision,
            float(value[k]),
            float(expected[k]),
            max(float(error[k]), 0.0) if bound else float(error[k]),
            float(tolerance[k]),
            passed,
            value.size,
            note,
            None if passed else own,
        )

    def measured(self, check: str, value: Any, where: Mapping[str, Any], least: bool = False, note: str = "") -> Row:
        """Return the row of a value that is stated and not judged: the largest of all cells.

        least: True for the smallest of all cells. The check fails if all values are NaN.
        """
        flat = np.asarray(value, np.float64).ravel()
        known = not np.isnan(flat).all()
        k = int(np.nanargmin(flat) if least else np.nanargmax(flat)) if known else 0
        own = {n: float(np.broadcast_to(c, np.shape(value)).ravel()[k]) for n, c in where.items()}
        return Row(
            self.model.slot,
            self.subject.label,
            check,
            own,
            self.precision,
            float(flat[k]),
            None,
            None,
            None,
            known,
            flat.size,
            note,
            None if known else own,
        )


def _product(*axes: Any, columns: Columns) -> tuple[list[np.ndarray], Columns]:
    """Combine `axes` (1-D each) with all parameter sets, flattened."""
    count = next((c.size for c in columns.values()), 1)
    mesh = [m.ravel() for m in np.meshgrid(*axes, np.arange(count), indexing="ij")]
    return mesh[:-1], {name: c[mesh[-1]] for name, c in columns.items()}


def _conditioned(
    reference: Callable[..., np.ndarray], arguments: Sequence[np.ndarray], columns: Columns, steps: Sequence[Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a reference, and its change when its arguments change by `steps` and its parameters by the last of them.

    No kernel that computes in rounded numbers can be more accurate than this change.
    """
    with np.errstate(all="ignore"):
        want = np.asarray(reference(*arguments, **columns), np.float64)
        unsure = np.zeros(want.shape)
        for j, a in enumerate([*arguments, *columns.values()]):
            step = steps[min(j, len(steps) - 1)] if j < len(arguments) else np.abs(a) * steps[-1]
            moved = []
            for near in (a + step, a - step):
                args = list(arguments)
                own = dict(columns)
                if j < len(arguments):
                    args[j] = near
                else:
                    own[list(columns)[j - len(arguments)]] = near
                change = np.abs(np.asarray(reference(*args, **own), np.float64) - want)
                moved.append(np.where(np.isfinite(change), change, 0.0))
            unsure += np.maximum(*moved)
    return want, unsure


def _direction(NoV: Any, phi: Any = 0.0) -> np.ndarray:
    """Return unit vectors (..., 3) with a cosine and an azimuth."""
    NoV, phi = np.broadcast_arrays(np.asarray(NoV, np.float64), phi)
    s = np.sqrt((1 - NoV) * (1 + NoV))
    return np.stack([s * np.cos(phi), s * np.sin(phi), NoV], -1)


# ---------------------------------------------------------------------------------------------- ndf


def _normalization(b: Bench) -> Iterator[Row]:
    if b.model.text is not None:
        columns = b.columns()
        values, _, note = b.integral("normalization", RULE[b.precision], **columns)
        yield b.measured("raw norm", values, columns, note=note or "what D is divided by")
        return
    columns = b.columns(_between)
    values, _, note = b.integral("normalization", RULE[b.precision], **columns)
    yield b.row("normalization", values, 1.0, b.tolerance("normalization", INTEGRAL), columns, note=note)


def _views(b: Bench) -> dict[str, Any]:
    """Return keyword arguments that broadcast views before parameter sets, so that neighbouring cells have one view."""
    if b.model.isotropic:
        return {"NoV": NOV[:, None]}
    return {"NoV": NOV[:, None, None], "phi": PHI[None, :, None]}


def _smith() -> list[Model]:
    """The maskings that declare the weak furnace with any NDF, the engine's default first."""
    return [m for m in models("masking").values() if m.checks.weak_furnace is not None]


def _weak_furnace(b: Bench) -> Iterator[Row]:
    views = _views(b)
    columns = b.columns(_between)
    masking = _smith()[0]
    values, _, note = b.integral("weak_furnace", RULE[b.precision], masking=masking, **views, **columns)
    where = {**views, **columns, "v": _direction(views["NoV"], views.get("phi", 0.0))}
    yield b.row(
        f"weak furnace, {masking.name}",
        values,
        masking.checks.weak_furnace,
        b.tolerance("weak furnace", INTEGRAL),
        where,
        note=note,
    )


def _energy(b: Bench) -> Iterator[Row]:
    views = _views(b)
    columns = b.columns()
    masking = _smith()[0]
    values, _, note = b.integral("albedo", ENERGY, masking=masking, **views, **columns)
    where = {**views, **columns}
    if b.model.text is not None:
        yield b.measured("least albedo", values, where, least=True)
        yield b.measured("largest albedo", values, where)
    yield b.row(
        "energy: albedo, F = 1",
        values,
        1.0,
        2 * ENERGY,
        {**where, "v": _direction(views["NoV"], views.get("phi", 0.0))},
        bound="most",
        note=note,
    )


def _normals(b: Bench, columns: Columns) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray], Columns]:
    """Return arguments of D as the kernel reads them, their angles, and the steps of these by rounding."""
    if b.model.isotropic:
        (theta,), own = _product(ANGLES, columns=columns)
        arguments = [b.rounded(np.cos(theta)), b.rounded(np.sin(theta) ** 2)]
        angles = [np.arctan2(np.sqrt(arguments[1]), arguments[0])]
    else:
        (theta, phi), own = _product(ANGLES[::2], PHI, columns=columns)
        arguments = [b.rounded(a) for a in (np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))]
        angles = [np.arctan2(np.hypot(*arguments[:2]), arguments[2]), np.arctan2(arguments[1], arguments[0])]
    # A cosine near 0 is known as well as a sine is: θ to a share of its distance to either end.
    steps = [np.maximum(b.rounding * np.minimum(a, np.abs(math.pi / 2 - a)), 2**-52 * np.abs(a)) for a in angles]
    return arguments, angles, steps, own


def _kernel_D(b: Bench) -> Iterator[Row]:
    columns = {n: b.rounded(c) for n, c in b.columns(draws=100).items()}
    arguments, angles, steps, own = _normals(b, columns)
    got = b.kernel("NDF_D", arguments, own)[0]
    names = dict(zip(("theta_m", "phi_m"), angles, strict=False))
    where = {**names, **own}
    if "D" in b.model.reference:
        want, unsure = _conditioned(b.model.reference["D"], angles, own, [*steps, b.rounding])
        peak = want.reshape(-1, next((c.size for c in columns.values()), 1)).max(0)
        floor = SMALLEST[b.precision] * (1 + np.resize(peak, want.size))
        yield b.row("kernel D", got, want, RELATIVE[b.precision] * want + 8 * unsure + floor, where)
    yield b.row("D finite", got, FINITE, 0.0, where, bound="most")
    yield b.row("D at least 0", got, 0.0, 0.0, where, bound="least")
    behind = [-a for a in arguments[:1]] + arguments[1:] if b.model.isotropic else [*arguments[:2], -arguments[2]]
    yield b.row("D of backfacing m", b.kernel("NDF_D", behind, own)[0], 0.0, 0.0, where)


def _kernel_area(b: Bench) -> Iterator[Row]:
    if "area" not in b.model.reference or "NDF_AREA" not in b.model.provides:
        return
    columns = {n: b.rounded(c) for n, c in b.columns(draws=100).items()}
    cosines = np.concatenate([[0.0], np.cos(ANGLES), [1.0]])
    if b.model.isotropic:
        (cosine,), own = _product(cosines, columns=columns)
        arguments = [b.rounded(cosine)]
        angles = [np.arctan2(np.sqrt((1 - arguments[0]) * (1 + arguments[0])), arguments[0])]
    else:
        (cosine, phi), own = _product(cosines, PHI, columns=columns)
        arguments = [b.rounded(a) for a in np.moveaxis(_direction(cosine, phi), -1, 0)]
        angles = [np.arctan2(np.hypot(*arguments[:2]), arguments[2]), np.arctan2(arguments[1], arguments[0])]
    steps = [np.maximum(b.rounding * np.minimum(a, np.abs(math.pi / 2 - a)), 2**-52 * np.abs(a)) for a in angles]
    want, unsure = _conditioned(b.model.reference["area"], angles, own, [*steps, b.rounding])
    got = b.kernel("NDF_AREA", arguments, own)[0]
    yield b.row(
        "kernel area",
        got,
        want,
        RELATIVE[b.precision] * want + 8 * unsure,
        {**dict(zip(("theta_v", "phi_v"), angles, strict=False)), **own},
    )


DRAWS = 1 << 19
RADIAL, AZIMUTHAL = 24, 8


def _slope_energy(b: Bench, own: dict[str, float], stretch: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return edges in ψ and the energy in each cell (ψ, φ) of the stretched slopes tan ψ (cos φ, sin φ).

    D cos θ dω = D cos⁴θ αx αy r dr dφ, r = tan ψ. The Gauss panels are graded towards both ends of ψ.
    """
    x, w = np.polynomial.legendre.leggauss(6)
    half = np.geomspace(1e-7, math.pi / 4, 160)
    panels = np.concatenate([[0.0], half, (math.pi / 2 - half)[-2::-1], [math.pi / 2]])
    psi = (panels[:-1, None] + panels[1:, None]) / 2 + np.diff(panels)[:, None] / 2 * x
    phi = (np.arange(4 * AZIMUTHAL) + 0.5) * (2 * math.pi / (4 * AZIMUTHAL)) if not b.model.isotropic else np.zeros(1)
    r, azimuth = np.tan(psi)[..., None], phi
    sx, sy = stretch[0] * r * np.cos(azimuth), stretch[1] * r * np.sin(azimuth)
    theta, around = np.arctan(np.hypot(sx, sy)), np.arctan2(sy, sx)
    if "D" in b.model.reference:
        with np.errstate(all="ignore"):
            D = b.model.reference["D"](*([theta] if b.model.isotropic else [theta, around]), **own)
    else:  # a user's
        columns = {n: np.full(theta.size, v) for n, v in own.items()}
        D = b.kernel("NDF_D", [np.cos(theta).ravel(), np.sin(theta).ravel() ** 2], columns)[0].reshape(theta.shape)
    density = D * np.cos(theta) ** 4 * r / np.cos(psi[..., None]) ** 2
    density = np.where(np.isfinite(density), density, 0.0)
    parts = np.einsum("ijk,j,i->ik", density, w, np.diff(panels) / 2) * stretch[0] * stretch[1]
    energy = np.repeat(parts, 4 * AZIMUTHAL, 1) if b.model.isotropic else parts
    energy = energy.reshape(len(parts), AZIMUTHAL, 4).sum(-1) * (2 * math.pi / (4 * AZIMUTHAL))
    # Panels joined until each bin holds its share.
    below = np.concatenate([[0.0], np.cumsum(energy.sum(1))])
    below /= below[-1]
    cuts = np.unique(np.searchsorted(below, np.arange(1, RADIAL) / RADIAL))
    cuts = np.unique(np.concatenate([[0], cuts, [len(panels) - 1]]))
    total = np.add.reduceat(energy, cuts[:-1], axis=0)
    return panels[cuts], total / total.sum()


def _chi2(b: Bench) -> Iterator[Row]:
    columns = b.columns(_typical if len(b.model.parameters) == 1 else _few)
    sets = next((c.size for c in columns.values()), 1)
    level = NormalDist().inv_cdf((1 - FAMILY) ** (1 / (sets * _samplers())))
    found, freedom, critical = np.empty(sets), np.empty(sets), np.empty(sets)
    for k in range(sets):
        own = {n: float(c[k]) for n, c in columns.items()}
        stretch = (
            [1.0, 1.0]
            if b.model.isotropic
            else [
                float(b.kernel(f"NDF_STRETCH_{axis}", [], {n: np.array([v]) for n, v in own.items()})[0, 0])
                for axis in "XY"
            ]
        )
        seed = crc32(os.fsencode(b.model.name)) + k
        m = sample(b.model, DRAWS, seed=seed, device=b.device, precision=b.precision, **own)
        edges, share = _slope_energy(b, own, stretch)
        sx, sy = m[:, 0] / stretch[0], m[:, 1] / stretch[1]
        psi, phi = np.arctan2(np.hypot(sx, sy), m[:, 2]), np.arctan2(sy, sx) % (2 * math.pi)
        bins = np.minimum(np.searchsorted(edges[1:-1], psi, "right"), len(edges) - 2)
        slices = np.minimum((phi * (AZIMUTHAL / (2 * math.pi))).astype(int), AZIMUTHAL - 1)
        seen = np.bincount(bins * AZIMUTHAL + slices, minlength=share.size)
        expected = share.ravel() * DRAWS
        fit = expected >= 5  # the usual smallest count of a cell; cells with fewer are merged
        o, e = np.append(seen[fit], seen[~fit].sum()), np.append(expected[fit], expected[~fit].sum())
        o, e = (o, e) if e[-1] >= 5 else (np.append(o[:-2], o[-2] + o[-1]), np.append(e[:-2], e[-2] + e[-1]))
        found[k], freedom[k] = float(((o - e) ** 2 / e).sum()), e.size - 1
        # [WilsonHilferty1931]: the cube root of χ²/k is nearly normal; the level is met to a few percent.
        spread = 2 / (9 * freedom[k])
        critical[k] = freedom[k] * (1 - spread + level * math.sqrt(spread)) ** 3
    yield b.row(
        "sampler, chi²",
        found,
        freedom,
        critical - freedom,
        columns,
        bound="most",
        note=f"{DRAWS} normals a set, expected is the degrees of freedom",
    )


def _samplers() -> int:
    """Return about how many tests one family has: every NDF in both precisions."""
    return 2 * len(models("ndf"))


# ---------------------------------------------------------------------------------------------- masking


def _geometry(b: Bench) -> tuple[Columns, np.ndarray, np.ndarray]:
    """Return arguments of V and G as the kernel reads them, for pairs of directions and areas of many roughnesses."""
    cosines = np.array([0.0, 1e-4, 1e-3, 1 / 64, 0.1, 0.4, 0.8, 1.0])
    spread = np.array([1e-4, 0.1, 0.5, 1.0])
    (NoV, NoL, phi, alpha), own = _product(
        cosines, cosines[1:], np.array([0.0, 1.0, 2.0, math.pi]), spread, columns=b.columns()
    )
    NoV, NoL = b.rounded(NoV), b.rounded(NoL)
    v, light = _direction(NoV), _direction(NoL, phi)
    VoH = np.linalg.norm(v + light, axis=-1) / 2
    use = VoH > 1e-4  # opposite directions have no half vector
    NoH = (NoV + NoL) / np.maximum(2 * VoH, 1e-30)

    # Areas as a Smith surface has them: between n·v and 1, by an ellipse.
    def area(c: np.ndarray) -> np.ndarray:
        return np.asarray((c + np.sqrt(c * c + alpha**2 * (1 - c * c))) / 2)

    arguments = {"NoV": NoV, "NoL": NoL, "NoH": np.minimum(NoH, 1.0), "VoH": VoH, "at_v": area(NoV), "at_l": area(NoL)}
    rounded = {n: b.rounded(a[use]) for n, a in arguments.items()}
    return ({**rounded, **{n: b.rounded(c[use]) for n, c in own.items()}}, v[use], light[use])


def _any_ndf(b: Bench) -> dict[str, Model]:
    """Return an NDF for the text of a masking that needs one."""
    return (
        {"ndf": next(m for m in models("ndf").values() if m.isotropic and "NDF_AREA" in m.provides)}
        if b.model.needs
        else {}
    )


ARGUMENTS = ("NoV", "NoL", "NoH", "VoH", "at_v", "at_l")


def _kernel_masking(b: Bench) -> Iterator[Row]:
    cells, v, light = _geometry(b)
    faces = cells["NoV"] > 0  # a light at the horizon gives nothing, a view there sees the limit
    arguments = [cells[n] for n in ARGUMENTS]
    own = {p.name: cells[p.name] for p in b.model.parameters}
    where = {"NoV": cells["NoV"], "NoL": cells["NoL"], **own, "l": light, "v": v}
    under = _any_ndf(b)
    got = {}
    for name in ("V", "G"):
        steps = [b.rounding * a for a in arguments]
        want, unsure = _conditioned(b.model.reference[name], arguments, own, [*steps, b.rounding])
        got[name] = b.kernel(f"MASKING_{name}", arguments, own, under)[0]
        relative = b.tolerance(f"kernel {name}", RELATIVE)
        yield b.row(f"kernel {name}", got[name], want, relative * np.abs(want) + 4 * unsure, where)
    V, G = got["V"], got["G"]
    if "G1" in b.model.reference and "MASKING_G1" in b.model.provides:
        few = [cells["NoV"], cells["at_v"]]
        want, unsure = _conditioned(b.model.reference["G1"], few, own, [*(b.rounding * a for a in few), b.rounding])
        G1 = b.kernel("MASKING_G1", few, own, under)[0]
        yield b.row("kernel G1", G1, want, RELATIVE[b.precision] * np.abs(want) + 4 * unsure, where)
    product = V * cells["NoL"] * cells["NoV"]
    yield b.row("G = V (n·l)(n·v)", G, product, 16 * b.rounding * np.abs(product), where)
    yield b.row("G at least 0", G, 0.0, 0.0, where, bound="least")
    yield b.row("G at most 1", G, 1.0, 8 * b.rounding, where, bound="most")
    swapped = [cells[n] for n in ("NoL", "NoV", "NoH", "VoH", "at_l", "at_v")]
    other = b.kernel("MASKING_V", swapped, own, under)[0]
    same = faces & np.all([cells[n] == x for n, x in b.model.checks.reciprocal_at.items()], axis=0)
    loose = 16 * b.rounding * np.maximum(np.abs(V), np.abs(other))
    if b.model.checks.reciprocal_at and same.any():
        yield b.row("reciprocity", V[same], other[same], loose[same], {n: c[same] for n, c in where.items()})
        faces &= ~same
    if faces.any():
        yield _reciprocity(
            b,
            V[faces],
            other[faces],
            loose[faces],
            {n: c[faces] for n, c in where.items()},
            scale=np.maximum(np.abs(V[faces]), 1e-30),
        )
    behind = [arguments[0], -cells["NoL"], *arguments[2:]]
    yield b.row("G of a backfacing light", b.kernel("MASKING_G", behind, own, under)[0], 0.0, 0.0, where)


def _reciprocity(
    b: Bench, one: np.ndarray, other: np.ndarray, tolerance: Any, where: Mapping[str, Any], scale: Any
) -> Row:
    """Check that f is equal under exchange of l and v where the entry says so, and differs where it denies it."""
    if b.model.checks.reciprocal is not False:
        return b.row("reciprocity", one, other, tolerance, where)
    apart = np.abs(one - other) / scale
    k = int(np.nanargmax(apart))
    worst = {n: np.asarray(c)[k] for n, c in where.items()}
    return b.row(
        "not reciprocal, as declared", apart[k], 1e-3, 0.0, worst, bound="least", note="largest relative difference"
    )


def _furnace_of_masking(b: Bench) -> Iterator[Row]:
    if "MASKING_G1" not in b.model.provides:
        return
    declared = b.model.checks.weak_furnace
    for ndf in models("ndf").values():
        own = {p.name: p for p in b.model.parameters}
        # A masking with a parameter of the NDF's name follows it; any other is held at its middle value.
        tied = [name for name in own if name in {p.name for p in ndf.parameters}]
        if declared is None and len(tied) < len(own):
            continue
        facets = Bench(Subject(ndf, ndf.name), b.precision, b.device)
        columns = facets.columns(_few)
        sent: dict[str, Any] = {f"ndf_{n}": c for n, c in columns.items()}
        for n, p in own.items():
            middle = sorted(p.typical)[len(p.typical) // 2]
            sent[f"masking_{n}"] = b.given.get(n, np.clip(columns[n], p.low, p.high) if n in tied else middle)
        views = _views(facets)
        views = {n: c[1:] if n == "NoV" else c for n, c in views.items()} if declared is None else views
        values, _, note = facets.integral("weak_furnace", RULE[b.precision], masking=b.model, **views, **sent)
        where = {**views, **columns}
        if declared is not None:
            yield b.row(
                f"weak furnace with {ndf.name}",
                values,
                declared,
                facets.tolerance("weak furnace", INTEGRAL),
                {**where, "v": _direction(views["NoV"], views.get("phi", 0.0))},
                note=note,
            )
        else:
            yield b.measured(
                f"weak furnace with {ndf.name}",
                values,
                where,
                least=True,
                note="not declared; the least, 1 would be right",
            )


# ---------------------------------------------------------------------------------------------- fresnel


def _kernel_F(b: Bench) -> Iterator[Row]:
    cosines = np.concatenate([[0.0], np.cos(ANGLES), [1.0]])
    (cosine,), own = _product(cosines, columns={n: b.rounded(c) for n, c in b.columns(_between, draws=200).items()})
    cosine = b.rounded(cosine)
    want, unsure = _conditioned(b.model.reference["F"], [cosine], own, [b.rounding * cosine, b.rounding])
    got = b.kernel("FRESNEL_F", [cosine], own)[0]
    where = {"cos_d": cosine, **own}
    yield b.row("kernel F", got, want, 2 * RELATIVE[b.precision] + 2 * unsure, where)
    if not b.model.checks.leaves_unit_range:
        yield b.row("F at least 0", got, 0.0, RELATIVE[b.precision], where, bound="least")
        yield b.row("F at most 1", got, 1.0, RELATIVE[b.precision], where, bound="most")
    else:
        yield b.measured("least F", got, where, least=True, note="declared")
        yield b.measured("largest F", got, where, note="declared")


def _limits(b: Bench) -> Iterator[Row]:
    """Check the entry's exact values: arguments and value by the parameters, NaN where there is none."""
    own = {n: b.rounded(c) for n, c in b.columns(_between).items()}
    count = next((c.size for c in own.values()), 1)
    for name, limit in b.model.limits.items():
        with np.errstate(all="ignore"):
            at, value = (np.broadcast_to(np.asarray(a, np.float64), count) for a in limit(**own))
        use = np.isfinite(value) & np.isfinite(at)
        if not use.any():
            continue
        at, kept = b.rounded(at[use]), {n: c[use] for n, c in own.items()}
        _, unsure = _conditioned(b.model.reference["F"], [at], kept, [2 * b.rounding * at, b.rounding])
        yield b.row(
            f"F at {name}",
            b.kernel("FRESNEL_F", [at], kept)[0],
            value[use],
            2 * RELATIVE[b.precision] + 2 * unsure,
            {"cos_d": at, **kept},
        )


# ---------------------------------------------------------------------------------------------- diffuse


def _pairs(b: Bench, columns: Columns) -> tuple[np.ndarray, np.ndarray, Columns]:
    """Directions (n, 3) of light and view, grazing ones among them, times parameter sets."""
    cosines = np.array([1e-4, 1e-2, 0.15, 0.5, 0.9, 1.0])
    (NoL, NoV, phi, around), own = _product(
        cosines, cosines, np.array([0.0, 0.7, math.pi / 2, 2.2, math.pi]), np.array([0.0, 1.3]), columns=columns
    )
    return b.rounded(_direction(NoL, phi + around)), b.rounded(_direction(NoV, around)), own


def _kernel_f(b: Bench) -> Iterator[Row]:
    light, v, own = _pairs(b, {n: b.rounded(c) for n, c in b.columns(draws=30).items()})

    def reference(*xyz: np.ndarray, **parameters: np.ndarray) -> np.ndarray:
        return np.asarray(b.model.reference["f"](np.stack(xyz[:3], -1), np.stack(xyz[3:], -1), **parameters))

    arguments = [*light.T, *v.T]
    want, unsure = _conditioned(reference, arguments, own, [*(b.rounding * np.abs(a) for a in arguments), b.rounding])
    got = b.kernel("DIFFUSE_F", arguments, own)[0]
    where = {**own, "l": light, "v": v}
    relative = b.tolerance("kernel f", RELATIVE)
    yield b.row("kernel f", got, want, relative * (np.abs(want) + 1 / math.pi) + 4 * unsure, where)
    swapped = b.kernel("DIFFUSE_F", [*v.T, *light.T], own)[0]
    yield _reciprocity(
        b,
        got,
        swapped,
        RELATIVE[b.precision] * (np.abs(got) + 1 / math.pi) + 4 * unsure,
        where,
        scale=np.maximum(np.abs(got), 1e-30),
    )
    if b.model.checks.negative:
        yield b.measured("least f", got, own, least=True, note="declared")
    else:
        yield b.row("f at least 0", got, 0.0, 0.0, where, bound="least")


def _albedo(b: Bench) -> Iterator[Row]:
    columns = b.columns(_between)
    NoV = NOV[:, None]
    values, _, note = b.integral("albedo", RULE[b.precision], NoV=NoV, **columns)
    where = {"NoV": NoV, **columns, "v": _direction(NoV)}
    size = np.maximum(np.abs(values), 1.0)
    if "albedo" in b.model.reference:
        with np.errstate(all="ignore"):
            want = b.model.reference["albedo"](np.maximum(NoV, LEAST_COSINE), **columns)
            finite = np.isfinite(b.model.reference["albedo"](NoV, **columns))
        # Where it is infinite at grazing it must be said to be.
        infinite = ~finite & np.isinf(values)
        yield b.row(
            "albedo",
            np.where(infinite, 0.0, values),
            np.where(infinite, 0.0, want),
            b.tolerance("albedo", INTEGRAL) * np.where(infinite, 1.0, size),
            where,
            note=note,
        )
    largest = math.inf if b.model.checks.largest_albedo is None else b.model.checks.largest_albedo
    if largest <= 1:
        yield b.row("energy: albedo", values, 1.0, INTEGRAL[b.precision], where, bound="most", note=note)
    if math.isfinite(largest):
        # A declared figure is rounded to its fourth decimal.
        yield b.row("energy: albedo as declared", values, largest, 6e-5, where, bound="most", note=note)
    else:
        yield b.measured(
            "largest albedo",
            values[NOV > 0],
            {n: np.broadcast_to(c, values.shape)[NOV > 0] for n, c in where.items() if n != "v"},
            note="declared without bound",
        )


# ---------------------------------------------------------------------------------------------- a user's BRDF


def _random_pairs(b: Bench, count: int = 20000) -> tuple[np.ndarray, np.ndarray]:
    """Return directions all over the hemisphere, half of them grazing, with some mirrored pairs, where lobes are."""
    rng = np.random.default_rng(7)
    cosines = np.where(rng.random((2, count)) < 0.5, rng.random((2, count)), 10 ** (-4 * rng.random((2, count))))
    phi = 2 * math.pi * rng.random((2, count))
    mirrored = np.arange(count) % 4 == 0
    cosines[1, mirrored] = np.clip(cosines[0, mirrored] * (1 + 0.05 * rng.standard_normal(mirrored.sum())), 1e-4, 1)
    phi[1, mirrored] = phi[0, mirrored] + math.pi + 0.05 * rng.standard_normal(mirrored.sum())
    light, v = (b.rounded(_direction(np.maximum(cosines[k], 1e-4), phi[k])) for k in range(2))
    return light, v


def _user_brdf(b: Bench) -> Iterator[Row]:
    light, v = _random_pairs(b)
    columns = b.columns()
    for k in range(next((c.size for c in columns.values()), 1)):
        yield from _user_brdf_at(b, light, v, {n: c[k] for n, c in columns.items()})


def _user_brdf_at(b: Bench, light: np.ndarray, v: np.ndarray, own: Columns) -> Iterator[Row]:
    f = b.kernel("BRDF_F", [*light.T, *v.T], own)  # (3, n), one row a channel
    where = {**own, "l": light, "v": v}
    finite = np.isfinite(f)
    yield b.row("f finite", np.abs(f), FINITE, 0.0, where, bound="most")
    whole = bool(finite.all())
    f = np.where(finite, f, 0.0)
    yield b.row("f at least 0", f, 0.0, 16 * b.rounding, where, bound="least")
    other = b.kernel("BRDF_F", [*v.T, *light.T], own)
    other = np.where(np.isfinite(other), other, 0.0)
    # A file computes n·h and the like its own way: many roundings, amplified by narrow lobes.
    loose = 1e-4 if b.precision == 32 else 1e-10
    yield b.row("reciprocity", f, other, loose * (np.maximum(np.abs(f), np.abs(other)) + 1e-2), where)
    if not whole:
        return
    NoV, phi = NOV[1:, None], PHI[None]
    values, stated, note = b.integral("albedo", 1e-5, NoV=NoV, phi=phi, **own)
    values = values.reshape(*np.broadcast_shapes(NoV.shape, phi.shape), -1)
    views = {"NoV": np.broadcast_to(NoV[..., None], values.shape), "phi": np.broadcast_to(phi[..., None], values.shape)}
    if np.isfinite(values).all():
        yield b.measured("least albedo", values, {**views, **own}, least=True)
        yield b.measured("largest albedo", values, {**views, **own})
    k = np.unravel_index(np.nanargmax(values) if np.isfinite(values).any() else 0, values.shape)
    towards = _direction(views["NoV"][k], views["phi"][k])
    most = (
        (f * light[:, 2]).max(0)
        if np.isnan(values).any()
        else (b.kernel("BRDF_F", [*light.T, *np.repeat(towards[:, None], len(light), 1)], own) * light[:, 2]).max(0)
    )
    yield b.row(
        "energy: albedo",
        values,
        1.0,
        1e-5 + stated,
        {**views, **own, "l": light[int(np.nanargmax(most))], "v": _direction(views["NoV"], views["phi"])},
        bound="most",
        note=note or "l: where most light comes from",
    )


# ---------------------------------------------------------------------------------------------- light


def _kernel_light(b: Bench) -> Iterator[Row]:
    """Check a light's function of a direction, all around. At an edge of the light either side is right."""
    name = next(n for n in b.model.reference if f"LIGHT_{n}" in b.model.provides)
    columns = {n: b.rounded(c) for n, c in b.columns(_typical_only).items()}
    (z, phi), own = _product(np.linspace(-1, 1, 41), np.linspace(0.05, 6.2, 61), columns=columns)
    towards = b.rounded(_direction(z, phi))

    def reference(*xyz: np.ndarray, **parameters: np.ndarray) -> np.ndarray:
        return np.asarray(b.model.reference[name](np.stack(xyz, -1), **parameters))

    steps = [8 * b.rounding for _ in towards.T]
    want, unsure = _conditioned(reference, list(towards.T), own, [*steps, 8 * b.rounding])
    got = b.kernel(f"LIGHT_{name}", list(towards.T), own)[0]
    most = np.maximum(np.abs(want), max(np.abs(want).max(), 1e-30) * 1e-3)
    yield b.row(f"kernel {name}", got, want, RELATIVE[b.precision] * most + 2 * unsure, {**own, "l": towards})
    yield b.row(f"{name} at least 0", got, 0.0, 0.0, {**own, "l": towards}, bound="least")


HEMISPHERE = (512, 1024)
"""Numbers of cells of sin²θ and φ for the reference of a light's irradiance. An edge crosses 3e-3 of them with a random
error of half a cell each, 1e-5 together."""


def _irradiance(b: Bench, own: Mapping[str, float]) -> float:
    """∫ L (n·l) dω/π of the light's float64 reference, by the midpoints of cells of equal projected solid angle."""
    sin2, phi = np.meshgrid(
        (np.arange(HEMISPHERE[0]) + 0.5) / HEMISPHERE[0],
        (np.arange(HEMISPHERE[1]) + 0.5) * (2 * math.pi / HEMISPHERE[1]),
        indexing="ij",
    )
    return float(np.mean(b.model.reference["L"](_direction(np.sqrt(1 - sin2), phi).reshape(-1, 3), **own)))


def _lit(b: Bench) -> Iterator[Row]:
    """Check a white Lambertian: c (n·l) for a punctual light, whose colour is defined by it, irradiance/π for any
    other.
    """
    columns = b.columns(_typical_only)
    sets = [{n: float(c[k]) for n, c in columns.items()} for k in range(next(iter(columns.values())).size)]
    punctual = "C" in b.model.reference
    upright = np.array([0.0, 0.0, 1.0])
    want = np.array([b.model.reference["C"](upright, **own) if punctual else _irradiance(b, own) for own in sets])
    sent: dict[str, Any] = {f"light_{n}": c for n, c in columns.items()}
    got = radiance(light=b.model, diffuse="lambert:albedo=1", NoV=0.6, precision=b.precision, device=b.device, **sent)
    scale = np.abs(columns.get("color", columns.get("radiance", np.ones(len(sets)))))
    usual = 8 * b.rounding if punctual else 1e-4
    yield b.row(
        "white Lambertian",
        got.values,
        want,
        usual * scale,
        columns,
        note="c (n·l)" if punctual else "irradiance/π of the reference",
    )
    if punctual:
        return
    around = _direction(np.linspace(-1, 1, 9)[:, None], np.linspace(0, 6, 9)).reshape(-1, 3)
    if any(np.ptp(b.model.reference["L"](around, **own)) > 0 for own in sets):
        return
    # The radiance is the same from everywhere: the directional albedo times it is reflected.
    ndf = next(m for m in models("ndf").values() if m.isotropic and "NDF_AREA" in m.provides)
    facets = Bench(Subject(ndf, ndf.name), b.precision, b.device)
    rough, NoV = {n: c[:, None] for n, c in facets.columns(_few).items()}, NOV[1:, None, None]
    albedo, _, _ = facets.integral("albedo", ENERGY, NoV=NoV, **rough)
    sent |= {f"ndf_{n}": c for n, c in rough.items()}
    lit = radiance(light=b.model, ndf=ndf, NoV=NoV, precision=b.precision, device=b.device, **sent)
    level = albedo * np.array([float(np.max(b.model.reference["L"](around, **own))) for own in sets])
    yield b.row(f"albedo of {ndf.name}", lit.values, level, 4 * ENERGY * level, {"NoV": NoV, **rough, **columns})


CHECKS: dict[str, tuple[Callable[[Bench], Iterator[Row]], ...]] = {
    "ndf": (_normalization, _weak_furnace, _energy, _kernel_D, _kernel_area, _chi2),
    "masking": (_kernel_masking, _furnace_of_masking),
    "fresnel": (_kernel_F, _limits),
    "diffuse": (_kernel_f, _albedo),
    "brdf": (_user_brdf,),
    "light": (_kernel_light, _lit),
}
