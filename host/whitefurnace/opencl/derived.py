"""Numbers that kernels need in addition to a model's parameters: constants, a user's norm, tables of Smith's area."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from whitefurnace.catalogue import Model, integral
from whitefurnace.catalogue.registry import LOBE
from whitefurnace.catalogue.rule import AREA_RULES, LADDERS, gauss
from whitefurnace.errors import InputError, UnsupportedError
from whitefurnace.opencl import source
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import evaluate, over_nodes

AREA_NODES = {32: 96, 64: 224}
"""Chebyshev nodes of the table of Smith's area. 96 nodes give A to 3e-8, and 224 to 1e-12, for every NDF of the
catalogue over its domain, except where its own rounding is larger (tests/integrals/test_integrate.py)."""

AREA_KEPT = {32: 2e-8, 64: 2e-14}
"""Trailing Chebyshev coefficients whose sum is below this are dropped."""

CONVERGED = 1e-3
"""Relative difference of two fine rules above which an integral is taken to be infinite: a logarithm in 1/cos θ grows
by 5 % from one to the next."""


@dataclass(frozen=True)
class AreaTable:
    """A table of Smith's projected area of several NDFs, as kernels read it.

    rows   (3 + length, n): scale, 1/range, A(0) and `length` terms of a series, one column for each NDF
    error  largest error of the area relative to the area
    """

    rows: np.ndarray
    length: int
    error: float


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct columns (k, m) of an array (k, n), and for each of the n columns the index of its distinct
    one.
    """
    if rows.shape[1] == 0 or rows.shape[0] == 0 or (rows == rows[:, :1]).all():
        return rows[:, :1], np.zeros(rows.shape[1], np.intp)
    # Grids come in runs of equal columns: sorting their heads alone is many times quicker.
    heads = np.concatenate([[True], (rows[:, 1:] != rows[:, :-1]).any(0)])
    distinct, which = np.unique(rows[:, heads], axis=1, return_inverse=True)
    return distinct, which.reshape(-1)[np.cumsum(heads) - 1]


def numbers_of(device: Device, entry: Model, rows: np.ndarray) -> np.ndarray:
    """Return the numbers of a model that kernels take: parameters and constants, (k + c, n) float64.

    rows: the parameters, (k, n) float64, one column for each cell. Raises InputError for a user's NDF that cannot be
    normalized.
    """
    if not entry.constant_names:
        return rows
    distinct, which = unique_rows(rows)
    if entry.text is not None:
        derived = _norm_and_width(device, entry, distinct)
    else:
        assert entry.constants is not None
        named = dict(zip((p.name for p in entry.parameters), distinct, strict=True))
        constants = entry.constants(**named)
        derived = np.stack([np.broadcast_to(constants[name], distinct.shape[1]) for name in entry.constant_names])
    return np.concatenate([rows, derived[:, which]])


def finest(device: Device) -> int:
    """Return the precision, 32 or 64 bits, in which tables and norms are made: the finest that the device supports."""
    return 64 if device.fp64 else 32


def _norm_and_width(device: Device, entry: Model, distinct: np.ndarray) -> np.ndarray:
    """Return 1/norm of a user's D and the angle in radians that holds half of its energy: (2, n)."""
    precision = finest(device)
    theta = np.concatenate(
        [[0.0], np.geomspace(1e-6, math.pi / 4, 600), math.pi / 2 - np.geomspace(math.pi / 4, 1e-6, 400)]
    )
    ones = np.ones((2, 1))
    widths = np.empty(distinct.shape[1])
    for k in range(distinct.shape[1]):
        own = np.repeat(np.concatenate([distinct[:, k : k + 1], ones]), theta.size, 1)
        cells = np.concatenate([np.stack([np.cos(theta), np.sin(theta) ** 2]), own])
        D = evaluate(device, "NDF_D", {"ndf": entry}, cells, precision)[0].astype(np.float64)
        refuse_bad(entry, D, theta)
        energy = np.concatenate([[0.0], np.cumsum(np.diff(theta) * (D * np.sin(2 * theta))[1:])])
        if energy[-1] <= 0:
            raise InputError(f"{entry.path}: cannot be normalized: D is 0 everywhere from θ = {theta[1]:g} rad on")
        widths[k] = np.interp(0.5 * energy[-1], energy, theta)
    cells = np.concatenate([np.ones((1, distinct.shape[1])), distinct, np.ones((1, distinct.shape[1])), widths[None]])
    program = source.integration(integral("normalization"), {"ndf": entry}).text
    rules = LADDERS["polar"][-2:]
    coarse, fine = (
        over_nodes(device, program, "integrate", cells, 1, precision, rule)[0].astype(np.float64) for rule in rules
    )
    if not (np.abs(fine - coarse) <= CONVERGED * np.abs(fine)).all():
        raise InputError(
            f"{entry.path}: cannot be normalized: ∫ D(m)(n·m) dω does not converge (two fine rules give "
            f"{coarse.max():.4g} and {fine.max():.4g}); D must have no jumps (interpolate between the entries of a "
            "table), grow slower than 1/cos²θ at grazing and be wider than 1e-6 rad"
        )
    return np.stack([1 / fine, widths])


def refuse_bad(entry: Model, D: np.ndarray, theta: np.ndarray) -> None:
    """Check that a user's D is finite and not negative at angles theta, in radians. Raises InputError."""
    for bad, what in ((~np.isfinite(D), "not finite"), (D < 0, "negative")):
        if bad.any():
            raise InputError(f"{entry.path}: cannot be normalized: D is {what} at θ = {theta[bad.argmax()]:.4g} rad")


class Areas:
    """Makes the tables of Smith's area of one NDF, each set of parameters once."""

    def __init__(self, device: Device, entry: Model, precision: int) -> None:
        self.device, self.entry, self.precision = device, entry, precision
        self._made: dict[bytes, tuple[np.ndarray, float]] = {}

    def table(self, rows: np.ndarray, tolerance: float = 0.0) -> AreaTable:
        """Return the table for cells of numbers (k, n), with enough terms for an error of a tenth of `tolerance`.

        Raises UnsupportedError where the area is infinite because D grows like 1/cos θ or faster at grazing angles.
        """
        distinct, which = unique_rows(rows)
        keys = [distinct[:, k].tobytes() for k in range(distinct.shape[1])]
        missing = [k for k, key in enumerate(keys) if key not in self._made]
        if len(self._made) > 1 << 16:
            self._made.clear()
            missing = list(range(len(keys)))
        for part in np.array_split(np.array(missing, int), -(-len(missing) // 512)) if missing else ():
            self._make(distinct[:, part], [keys[k] for k in part])
        made = np.stack([self._made[key][0] for key in keys], 1)
        rest = np.cumsum(np.abs(made[3:]).max(1)[::-1])[::-1]
        # Every term costs each lane a multiply-add for each light direction: with all of them GGX is 10 times as fast.
        length = max(16, 8 * math.ceil(int((rest > max(AREA_KEPT[self.precision], tolerance / 10)).sum()) / 8))
        cut = float(rest[length]) if length < rest.size else 0.0
        return AreaTable(made[: 3 + length, which], length, cut + max(self._made[key][1] for key in keys))

    def _make(self, distinct: np.ndarray, keys: list[bytes]) -> None:
        precision, count, n = finest(self.device), AREA_NODES[self.precision], distinct.shape[1]
        program = source.area(self.entry).text

        def area(NoV: np.ndarray, rule: int) -> np.ndarray:
            """Return areas at cosines (m, n) by one of the two rules: (m, n)."""
            m = NoV.shape[0]
            cells = np.concatenate([NoV.reshape(1, -1), np.tile(distinct, m)])
            values = over_nodes(
                self.device, program, "area", cells, 1, precision, AREA_RULES[self.precision][rule], azimuths=False
            )
            return values.reshape(m, n).astype(np.float64)

        zero, width = area(np.zeros((1, n)), 1)[0], self._widths(distinct)
        coarse = area(np.zeros((1, n)), 0)[0]
        if not (np.abs(zero - coarse) <= CONVERGED * zero).all():
            worst = distinct[:, np.abs(zero / coarse - 1).argmax()]
            where = dict(zip(self.entry.arguments, worst.tolist(), strict=True))
            own = ", ".join(f"{p.name} = {where[p.name]:g}" for p in self.entry.parameters)
            why = (
                "not a number, since D is not one somewhere"
                if np.isnan(zero + coarse).any()
                else "infinite, since D grows like 1/cos θ at grazing or faster"
            )
            raise UnsupportedError(
                f"ndf {self.entry.name} has no Smith masking{' for ' if own else ''}{own}: its projected area is {why}"
            )
        scale = np.maximum(np.minimum(zero, width), 1e-7)
        angle = (np.arange(count) + 0.5) * math.pi / count
        q = (1 - np.cos(angle)) / 2
        reach = np.arcsinh(1 / scale)
        c = np.minimum(scale * np.sinh(reach * (1 - (1 - q[:, None]) ** 2)), 1.0)
        values = area(c, 1) / np.hypot(c, zero)
        # A series in T_k(2q - 1), cos(k angle) with its sign: nodes run from q = 0, where T_k is (-1)^k.
        k = np.arange(count)
        basis = np.cos(np.outer(k, math.pi - angle))
        terms = 2 / count * basis @ values
        terms[0] /= 2
        check = area(c[:: count // 8], 0) / np.hypot(c[:: count // 8], zero)
        error = np.abs(check / values[:: count // 8] - 1).max(0) + np.abs(terms[-4:]).sum(0)
        for j, key in enumerate(keys):
            self._made[key] = (np.concatenate([[scale[j], 1 / reach[j], zero[j]], terms[:, j]]), float(error[j]))

    def _widths(self, distinct: np.ndarray) -> np.ndarray:
        found = evaluate(self.device, "NDF_WIDTH", {"ndf": self.entry}, distinct, finest(self.device))
        return found[0].astype(np.float64)


def lobe_norm(device: Device, entry: Model, parameters: Mapping[str, float]) -> float:
    """Return ∫ K dω of the prefilter's lobe K = D(h)(n·l) with n = v = r, exact to rounding.

    For a catalogue model it is summed from the entry's reference, by Gauss panels in the logarithm of s = 1 - l·r. For
    a user's NDF it is computed on the device (`catalogue.registry.LOBE`).
    """
    if entry.reference:
        edges = np.concatenate([[0.0], np.geomspace(1e-14, 1.0, 57)])
        x, w = gauss(12)
        width = np.diff(edges)[:, None]
        s = edges[:-1, None] + width * x
        D = entry.reference["D"](np.arcsin(np.sqrt(s / 2)), **parameters)
        return 2 * math.pi * float((width * w * D * (1 - s)).sum())
    cells = np.concatenate([np.ones((1, 1)), numbers_of(device, entry, _row(entry, parameters))])
    return float(
        over_nodes(
            device,
            source.integration(LOBE, {"ndf": entry}).text,
            "integrate",
            cells,
            1,
            finest(device),
            LADDERS["polar"][-1],
        )[0, 0]
    )


def at_horizon(device: Device, entry: Model, parameters: Mapping[str, float]) -> float:
    """Return D at 45°, which is the slope of the prefilter's lobe at the horizon."""
    if entry.reference:
        return float(entry.reference["D"](np.float64(math.pi / 4), **parameters))
    cells = np.concatenate([np.array([[math.sqrt(0.5)], [0.5]]), numbers_of(device, entry, _row(entry, parameters))])
    return float(evaluate(device, "NDF_D", {"ndf": entry}, cells, finest(device))[0, 0])


def _row(entry: Model, parameters: Mapping[str, float]) -> np.ndarray:
    return np.array([[parameters[p.name]] for p in entry.parameters], np.float64).reshape(-1, 1)


def density_at(device: Device, entry: Model, parameters: Mapping[str, float], q: np.ndarray) -> np.ndarray:
    """Return D, (n,) float64, at the half vectors of directions l with q = |l - r|², where n = v = r.

    q: (n,) in [0, 2]. The half vector has sin²θ = q/4.
    """
    if entry.reference:
        return np.asarray(entry.reference["D"](np.arcsin(np.sqrt(q / 4)), **parameters), np.float64)
    numbers = numbers_of(device, entry, _row(entry, parameters))
    cells = np.concatenate([np.sqrt(1 - q / 4)[None], q[None] / 4, np.repeat(numbers, len(q), 1)])
    return evaluate(device, "NDF_D", {"ndf": entry}, cells, finest(device))[0].astype(np.float64)
