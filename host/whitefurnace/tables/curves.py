"""Fits simple curves that replace costly functions in shaders, and writes them as C and GLSL.

A rational function replaces Smith's term of any NDF, and a polynomial the norm of an NDF. Both are fitted for the
smallest maximum error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from whitefurnace.catalogue.choice import Chosen
from whitefurnace.errors import UnsupportedError
from whitefurnace.files import number
from whitefurnace.integrals.quadrature import integrate, missed, room_for
from whitefurnace.opencl.derived import finest, numbers_of
from whitefurnace.results import Integrated
from whitefurnace.tables.axes import Axis, Ends, Points
from whitefurnace.tables.cells import Cells, Run

TERMS = 6
"""Coefficients of a polynomial in the roughness. GGX needs one of them (k = α/2), other NDFs all."""

DEGREES = range(1, 11)
"""Total degrees of a norm's polynomial. The lowest that meets the tolerance is used."""

POWERS = (2, 4, 8, 16, 32, 64)
"""Powers p of the sums Σ|error|^p that are minimized one after the other. The p-th root of the last is within 3 % of
the largest error of 1e4 points, and unlike the largest error it has a derivative."""

NORM_AXES: Mapping[str, Mapping[str, Ends]] = {
    "abc": {"b": (1.0, 1e6, 48, "log"), "c": (1.0, 3.0, 48, "linear")},
    "shifted_gamma": {"alpha": (1e-3, 1.0, 48, "log"), "p": (0.0, 2.0, 48, "linear")},
}
"""Default ranges of the parameters of the fitted norms, by NDF; --axis gives others."""

LOBES = {"abc": "1/(1 + b (1 - cos θ))^c", "shifted_gamma": "exp(-t/alpha) (1 + t/alpha²)^-p / cos⁴θ, t = tan²θ"}
"""The lobe that each norm belongs to, for the comment of a header."""


@dataclass(frozen=True)
class Span:
    """A variable of a fit. Calling it maps values from [low, high] to [-1, 1], by their logarithm if `log` is True."""

    name: str
    low: float
    high: float
    log: bool

    @classmethod
    def of(cls, name: str, values: np.ndarray) -> Span:
        """Return the span of values of a variable, logarithmic where they span decades."""
        low, high = float(values.min()), float(values.max())
        return cls(name, low, high, low > 0 and high > 20 * low)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        return (2 * (np.log(values) if self.log else values) - low - high) / (high - low)


def least_largest(residuals: Callable[[np.ndarray], np.ndarray], start: np.ndarray, steps: int = 40) -> np.ndarray:
    """Return parameters for which the largest |residual| is nearly as small as possible, beginning at `start`.

    residuals: function from parameters to residuals. steps: largest number of steps for each power. Sums of growing
    powers of the residuals are minimized one after the other, by damped Gauss-Newton steps with a numerical derivative.
    [Marquardt1963]
    """
    best = at = start.astype(np.float64)
    now = residuals(at)
    least = float(np.abs(now).max())
    for power in POWERS:
        damping = 1e-3
        for _ in range(steps):
            top = float(np.abs(now).max())
            if top == 0:
                return best
            weight = (np.abs(now) / top) ** (power / 2 - 1)
            slope = np.empty((now.size, at.size))
            for k in range(at.size):
                move = np.zeros(at.size)
                move[k] = 1e-6 * max(1.0, abs(at[k]))
                slope[:, k] = (residuals(at + move) - now) / move[k]
            system = slope * weight[:, None]
            square, pull = system.T @ system, system.T @ (now * weight)
            # The p-th power's Hessian is p - 1 times that of its weighted squares.
            step = np.linalg.solve(
                square + damping * np.diag(np.diag(square) + 1e-14 * np.trace(square)), -pull / (power - 1)
            )
            tried = residuals(at + step)
            before, after = (float(((np.abs(r) / top) ** power).sum()) for r in (now, tried))
            if np.isfinite(after) and after < before:
                at, now, damping = at + step, tried, damping / 4
                if float(np.abs(now).max()) < least:
                    best, least = at, float(np.abs(now).max())
                if after > before * (1 - 1e-6):
                    break
            else:
                damping *= 8
                if damping > 1e8:
                    break
    return best


# ------------------------------------------------------------------------------------------------------ Smith's term


def smith_check(slots: Mapping[str, Chosen]) -> None:
    """Check that the Smith term of the models depends on n·v alone. Raises UnsupportedError."""
    ndf, masking = slots["ndf"].model, slots["masking"].model
    if not ndf.isotropic:
        raise UnsupportedError(f"smith needs an isotropic ndf; {ndf.name} is anisotropic")
    if masking.name != "smith":
        raise UnsupportedError(f"smith is of Smith's masking; {masking.name} is another")


def shape_of_smith(scheme: str | None, axes: Sequence[Axis]) -> tuple[int, ...]:
    """Return the shape (polynomials, coefficients) of a fit of Smith's term; one coefficient if only n·v varies.

    Raises UnsupportedError for axes other than NoV and at most one more.
    """
    others = [axis.name for axis in axes if axis.name != "NoV"]
    if len(others) > 1 or len(others) == len(axes):
        raise UnsupportedError(
            "smith is fitted over NoV and one parameter more, not "
            f"{', '.join(axis.name for axis in axes)}: fix the others with --set"
        )
    return (2 if scheme == "rational" else 1, TERMS if others else 1)


def area(scheme: str | None, c: np.ndarray, k: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the fitted area A(c) = c/G1(c) = c + k (1 - c), with a factor q/(q + c) on the second term for "rational".

    c: n·v in [0, 1]. k, q: the fitted polynomials' values.
    """
    return c + k * (1 - c) * (q / (q + c) if scheme == "rational" else 1)


def smith(cells: Cells, run: Run, report: bool) -> tuple[Integrated, dict[str, Any]]:
    """Fit Smith's term: return coefficients (polynomials, coefficients) of k and q as polynomials in a parameter x.

    The fit is G1(c) = c/A(c), A = c + k (1 - c) q/(q + c), c = n·v. Without q and with k = α/2 it is Hammon's
    approximation of GGX's height-correlated term. [Hammon2017]
    """
    start = time.perf_counter()
    ndf, axes, scheme = cells.models["ndf"], cells.axes, cells.scheme
    shape = shape_of_smith(scheme, axes)
    along = next((axis for axis in axes if axis.name != "NoV"), None)

    def exact(share: Callable[[Axis], np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        """c, x and A at shares of the axes, flat, and evaluations."""
        values = {axis.name: axis.at(share(axis))[0] for axis in axes}
        columns: dict[str, Any] = cells.columns_at([Points(*one) for one in values.items()])
        made = integrate(
            "projected_area", ndf=ndf, precision=finest(run.device), tolerance=1e-8, device=run.device, **columns
        )
        x = values[along.name] if along else np.zeros(1)
        c, x = (a.ravel() for a in np.broadcast_arrays(values["NoV"][None, :], x[:, None]))
        return c, x, np.asarray(made.values, np.float64).ravel(), made.evaluations

    c, x, A, used = exact(lambda axis: np.linspace(0, 1, axis.count))
    powers = x[:, None] ** np.arange(shape[1])

    def curves(numbers: np.ndarray, powers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """k and q > 0."""
        both = numbers.reshape(shape)
        k = powers @ both[0]
        return k, powers @ both[1] if len(both) > 1 else np.ones_like(k)

    def off(numbers: np.ndarray, c: np.ndarray, powers: np.ndarray, A: np.ndarray) -> np.ndarray:
        """Error of G1; a curve that falls below 0 is pushed up."""
        k, q = curves(numbers, powers)
        low = np.maximum(1e-4 - np.minimum(k, q), 0)
        k, q = np.maximum(k, 1e-6), np.maximum(q, 1e-6)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(c > 0, c / area(scheme, c, k, q) - c / A, 0.0) + 100 * low

    first = np.zeros(shape)
    grazing = A[c == c.min()]
    first[0] = np.linalg.lstsq(powers[c == c.min()], grazing, rcond=None)[0]
    if shape[0] == 2:
        first[1] = np.linalg.lstsq(powers[c == c.min()], 2 * grazing + 0.02, rcond=None)[0]
    found = least_largest(lambda numbers: off(numbers, c, powers, A), first.ravel())
    values = room_for(shape, run.precision, run.out)
    values[...] = found.reshape(shape)
    held = np.asarray(values, np.float64).ravel()
    # The error is also measured at points between those that were fitted, from the coefficients as they are written.
    c2, x2, A2, more = exact(lambda axis: (np.arange(2 * axis.count) + 0.37) / (2 * axis.count))
    powers2 = x2[:, None] ** np.arange(shape[1])
    error = max(float(np.abs(off(held, c, powers, A)).max()), float(np.abs(off(held, c2, powers2, A2)).max()))
    made = Integrated(values, error, used + more, time.perf_counter() - start, f"least-largest-{scheme}", ())
    if not report:
        return made, {}
    pair = _pairs(scheme, *curves(held, powers2), c2, A2, x2)
    return made, _smith_stated(cells, values, error, pair)


def _smith_stated(cells: Cells, values: np.ndarray, error: float, pair: float) -> dict[str, Any]:
    """Return the manifest's facts about a fit of Smith's term, with the text of its header.

    values: the coefficients as written. error: the largest error of G1, pair: of the height-correlated G.
    """
    scheme = cells.scheme
    along = next((axis for axis in cells.axes if axis.name != "NoV"), None)
    name = along.name if along else "x"
    formula = (
        "G1 = c/A, A = c + k (1 - c)"
        + (" q/(q + c)" if scheme == "rational" else "")
        + ", c = n·v; V = 1/((n·l) A(n·v) + (n·v) (A(n·l) - n·l)), to be divided by 4"
    )
    span = f"{name} from {along.low:g} to {along.high:g}" if along else "the parameters given"
    lines = [
        f"Smith's term of {_named(cells.models['ndf'])}, fitted over {span} and all n·v:",
        *formula.split("; "),
        f"largest error of G1 {error:.2g}, of the height-correlated G {pair:.2g}",
    ]
    polynomials = [_horner(row, name, values.dtype.name) for row in values.tolist()]
    body = [f"#define NAME_K({name}) ({polynomials[0]})"]
    if scheme == "rational":
        body += [
            f"#define NAME_Q({name}) ({polynomials[1]})",
            f"#define NAME_A(c, {name}) ((c) + NAME_K({name}) * NAME_Q({name}) * (1.0f - (c)) / "
            f"(NAME_Q({name}) + (c)))",
        ]
    else:
        body += [f"#define NAME_A(c, {name}) ((c) + NAME_K({name}) * (1.0f - (c)))"]
    body += [
        f"#define NAME_G1(c, {name}) ((c) / NAME_A(c, {name}))",
        f"#define NAME_V(NoL, NoV, {name}) (1.0f / ((NoL) * NAME_A(NoV, {name}) + (NoV) * (NAME_A(NoL, {name}) - "
        "(NoL))))",
    ]
    return {
        "channels": ["k", "q"][: len(values)],
        "formula": formula,
        "error_pairs": pair,
        "variable": name,
        "text": (lines, body),
    }


def _pairs(scheme: str | None, k: np.ndarray, q: np.ndarray, c: np.ndarray, A: np.ndarray, x: np.ndarray) -> float:
    """Return the largest error of the height-correlated G over pairs of directions at the same parameter."""
    worst = 0.0
    for one in np.unique(x)[::4]:
        at = (x == one) & (c > 0)
        v, true = c[at][::4], A[at][::4]
        mine = area(scheme, v, k[at][::4], q[at][::4])

        def both(a: np.ndarray, v: np.ndarray = v) -> np.ndarray:
            return v[:, None] * v / (v[:, None] * a + v * (a[:, None] - v[:, None]))

        worst = max(worst, float(np.abs(both(mine) - both(true)).max()))
    return worst


# ------------------------------------------------------------------------------------------------------ norms


def norm_axes(slots: Mapping[str, Chosen]) -> Mapping[str, Ends]:
    """Return the default ranges of the parameters that are not given with the NDF."""
    ndf = slots["ndf"]
    return {name: axis for name, axis in NORM_AXES.get(ndf.model.name, {}).items() if name not in ndf.given}


def norm_check(slots: Mapping[str, Chosen]) -> None:
    """Check that the NDF has a norm that is costly to compute. Raises UnsupportedError."""
    entry = slots["ndf"].model
    if not {"norm", "per_norm"} & set(entry.constant_names):
        raise UnsupportedError(
            f"norm is of an NDF with a norm that costs: {', '.join(NORM_AXES)} or a .clh file; "
            f"{entry.name} has a plain one"
        )


def shape_of_norm(axes: Sequence[Axis]) -> tuple[int, ...]:
    """Return the shape (coefficients,) or (coefficients of x, of y) of a norm's polynomial of the highest degree.

    Coefficients beyond the chosen degree are 0. Raises UnsupportedError for more than two axes.
    """
    if not 1 <= len(axes) <= 2:
        raise UnsupportedError(f"norm is fitted over one or two parameters, not {len(axes)}: fix the others with --set")
    return tuple(DEGREES.stop for _ in axes)


def norm(cells: Cells, run: Run, report: bool) -> tuple[Integrated, dict[str, Any]]:
    """Fit the logarithm of the norm: return coefficients (n,) or (n, n) of a polynomial in one or two parameters.

    Each parameter is mapped from its range, or the logarithm of it, to [-1, 1]. [i, j] is the coefficient of x^i y^j,
    where x is the first axis. The degree is the smallest that meets the tolerance, which is relative to the norm.
    """
    start, ndf, axes = time.perf_counter(), cells.models["ndf"], cells.axes
    entry = ndf.model
    which = len(entry.parameters) + next(i for i, n in enumerate(entry.constant_names) if n in ("norm", "per_norm"))

    def exact(share: Callable[[Axis], np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
        """Parameters and ln norm at shares of the axes, flat."""
        points = [Points(axis.name, axis.at(share(axis))[0]) for axis in axes]
        given = {**ndf.given, **cells.columns_at(points)}
        every = np.broadcast_arrays(
            *[
                np.asarray(given.get(f"ndf_{p.name}", given.get(p.name, p.default)), np.float64)
                for p in entry.parameters
            ]
        )
        rows = np.stack(
            [p.check(one, f"ndf {entry.name}").ravel() for p, one in zip(entry.parameters, every, strict=True)]
        )
        # The variables of the polynomial are the axes: a roughness is one, though the NDF takes an α that follows it.
        grids = np.meshgrid(
            *(one.given for one in reversed(points)), indexing="ij"
        )  # the first axis is the last dimension
        mine = [grid.ravel() for grid in reversed(grids)]
        return mine, np.log(numbers_of(run.device, entry, rows)[which])

    spans = [Span.of(axis.name, axis.values()) for axis in axes]

    def basis(mine: Sequence[np.ndarray], degree: int) -> tuple[np.ndarray, Sequence[tuple[int, ...]]]:
        powers = [span(values)[:, None] ** np.arange(degree + 1) for span, values in zip(spans, mine, strict=True)]
        if len(powers) == 1:
            return powers[0], [(i,) for i in range(degree + 1)]
        kept = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        return np.stack([powers[0][:, i] * powers[1][:, j] for i, j in kept], 1), kept

    at, wanted = exact(lambda axis: np.linspace(0, 1, axis.count))
    between, wanted_there = exact(lambda axis: (np.arange(2 * axis.count) + 0.37) / (2 * axis.count))
    values, error, degree = room_for(shape_of_norm(axes), run.precision, run.out), math.inf, 0
    for degree in DEGREES:
        matrix, kept = basis(at, degree)
        values[...] = 0
        for index, coefficient in zip(kept, _lawson(matrix, wanted), strict=True):
            values[index] = coefficient
        held = np.array([values[index] for index in kept], np.float64)
        there, _ = basis(between, degree)
        error = max(
            float(np.abs(np.expm1(matrix @ held - wanted)).max()),
            float(np.abs(np.expm1(there @ held - wanted_there)).max()),
        )
        if error <= run.tolerance:
            break
    made = Integrated(
        values,
        error,
        wanted.size + wanted_there.size,
        time.perf_counter() - start,
        f"least-largest-degree-{degree}",
        tuple(missed(error, run.tolerance, run.precision)),
    )
    if not report:
        return made, {}
    return made, _norm_stated(ndf, spans, values, degree, error)


def _lawson(matrix: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the coefficients c that make the largest relative error of exp(matrix @ c) against exp(wanted) least.

    matrix: (points, coefficients). The weights of a least-squares fit follow its errors. [Lawson1961]
    """
    weights: np.ndarray = np.ones(wanted.size)
    best, least = np.zeros(matrix.shape[1]), math.inf
    for _ in range(40):
        numbers = np.linalg.lstsq(matrix * weights[:, None], wanted * weights, rcond=None)[0]
        off = np.abs(np.expm1(matrix @ numbers - wanted))
        if off.max() < least:
            best, least = numbers, float(off.max())
        weights = np.sqrt(weights**2 * (off / max(off.max(), 1e-300) + 1e-3))
        weights /= weights.max()
    return best


def _norm_stated(ndf: Chosen, spans: Sequence[Span], values: np.ndarray, degree: int, error: float) -> dict[str, Any]:
    """Return the manifest's facts about the fit of a norm, with the text of its header.

    values: the coefficients as written. error: the largest relative error of the norm.
    """
    kind = values.dtype.name
    names = [span.name.removeprefix("ndf_") for span in spans]
    scaled = [
        f"({_literal(2 / _width(s), kind)} * {'log' if s.log else ''}({n}) - {_literal(_shift(s), kind)})"
        for s, n in zip(spans, names, strict=True)
    ]
    rows = values.reshape(len(values), -1)
    used = [row[: degree + 1 - (i if rows.shape[1] > 1 else 0)].tolist() for i, row in enumerate(rows[: degree + 1])]
    inner = [_horner(row, "y", kind) for row in used] if rows.shape[1] > 1 else [_literal(row[0], kind) for row in used]
    body = [
        f"#define NAME_POLYNOMIAL({', '.join('xy'[: len(names)])}) ({_nested(inner, 'x')})",
        f"#define NAME_NORM({', '.join(names)}) exp(NAME_POLYNOMIAL({', '.join(scaled)}))",
    ]
    formula = f"D = norm · {LOBES.get(ndf.model.name, 'the lobe')}; ln norm is a polynomial of degree {degree}"
    lines = [
        f"The norm of {_named(ndf)} for "
        + ", ".join(f"{n} from {s.low:g} to {s.high:g}" for n, s in zip(names, spans, strict=True))
        + f"; largest relative error {error:.2g}",
        formula,
    ]
    return {
        "formula": formula,
        "degree": degree,
        "text": (lines, body),
        "spans": [
            {"name": n, "from": s.low, "to": s.high, "scale": "log" if s.log else "linear"}
            for n, s in zip(names, spans, strict=True)
        ],
    }


def _width(span: Span) -> float:
    return math.log(span.high / span.low) if span.log else span.high - span.low


def _shift(span: Span) -> float:
    """Evaluate the series at 2 u/width - shift."""
    low, high = (math.log(span.low), math.log(span.high)) if span.log else (span.low, span.high)
    return (high + low) / (high - low)


# ------------------------------------------------------------------------------------------------------ C and GLSL


def _named(ndf: Chosen) -> str:
    given = ", ".join(f"{name} = {value}" for name, value in ndf.given.items())
    return ndf.model.name + (f" ({given})" if given else "")


def _literal(value: float, kind: str) -> str:
    text = number(value, kind)
    return f"({text})" if value < 0 else text


def _horner(numbers: Sequence[float], name: str, kind: str) -> str:
    return _nested([_literal(x, kind) for x in numbers], name)


def _nested(terms: Sequence[str], name: str) -> str:
    text = terms[-1]
    for term in terms[-2::-1]:
        text = f"{term} + ({name}) * ({text})"
    return text


def header(name: str, text: tuple[Sequence[str], Sequence[str]], version: str) -> str:
    """Return the text of a .h for C and GLSL, whose macros are named after `name`."""
    lines, body = text
    guard = f"{name.upper()}_H"
    return "\n".join(
        [
            *(f"// {line}" for line in lines),
            f"// Made by whitefurnace {version}.",
            f"#ifndef {guard}",
            f"#define {guard}",
            "",
            *(line.replace("NAME_", f"{name.upper()}_") for line in body),
            "",
            f"#endif  // {guard}",
            "",
        ]
    )
