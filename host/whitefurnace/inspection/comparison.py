"""Compares two files of any containers; the second is the reference.

Computes the error of every level by the project's definition, and the errors of spherical harmonics and of tables.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from whitefurnace.engines.presets import ENGINES, axes_matrix
from whitefurnace.errors import UnsupportedError
from whitefurnace.files import Deferred
from whitefurnace.inspection.contents import Contents, Level
from whitefurnace.prefiltering.certificate import texel_errors
from whitefurnace.prefiltering.reading import bilinear
from whitefurnace.sphere.environments import FACES
from whitefurnace.sphere.grids import Shape, cube_centres, latlong_centres, turned_cube
from whitefurnace.sphere.harmonics import turned
from whitefurnace.sphere.overlap import mean_over_texels

AXES = "xyz"
SAME_ROUGHNESS = 1e-4
"""Largest difference between the perceptual roughness that two files state for one level: rounding of texts."""

CUBE_TEXELS, LATLONG_TEXELS, ROW_TEXELS = 6 * 256**2, 2 * 64**2, 2 * 256**2
"""Largest numbers of texels for which exact overlaps take about five seconds.

They are those of a cube (12 µs each), of a lat-long against a cube (300 µs), and against another lat-long (30 µs).
"""

ALIKE = 1.01
"""Largest ratio of the texel angles of two grids at which either may count as the coarser one."""

MIRRORED = 0.2
"""A cube is reported as turned or mirrored if one of the 48 symmetries reduces the error to less than this share."""


@dataclass(frozen=True)
class Row:
    """The errors of one pair of levels, tables or coefficients.

    part       name of the part; `kind` is "level", "table" or "sh"
    size       size in texels or cells; `method` says how the pair was compared
    error      99th percentile of the errors; `worst` is the largest. For levels these are texel errors, the max over
               channels of |a − b| / max(b, 1e-3 · mean of b); for tables absolute differences; for spherical harmonics
               differences over the largest L00
    rmse       relative root mean square difference, weighted with solid angles; None except for levels
    at         place of the largest error
    roughness  perceptual roughness of a level, where it is known
    stated     the error that A's manifest states
    errors     all errors, (6, n, n) or (h, w), for maps
    """

    part: str
    kind: str  # "level", "table" or "sh"
    size: str
    method: str
    error: float
    worst: float
    rmse: float | None
    at: str
    roughness: float | None = None
    stated: float | None = None
    errors: np.ndarray | None = field(default=None, compare=False, repr=False)

    @property
    def bounded(self) -> float:
        """The error that `--max-error` limits: the percentile for a level, the largest error for other parts."""
        return self.error if self.kind == "level" else self.worst


@dataclass(frozen=True)
class Comparison:
    """The result of comparing `a` with the reference `b`.

    rows     the compared parts, in the order of B's
    notices  sentences about the method, and about parts without a counterpart
    """

    a: Contents
    b: Contents
    rows: tuple[Row, ...]
    notices: tuple[str, ...]

    def beyond(self, bound: float) -> Row | None:
        """Return the row that exceeds `bound` the most, or None where no row exceeds it."""
        worst = max(self.rows, key=lambda row: row.bounded)
        return worst if not worst.bounded <= bound else None


def axes_of(text: str) -> np.ndarray:
    """Return the matrix P (3, 3) of axes such as "-x +y +z", or of an engine by its name.

    The radiance from direction d in our axes is stored at P · d. Raises UsageError.
    """
    if text in ENGINES:
        text = ENGINES[text].axes
    return np.array(axes_matrix(text), np.float64)


def compare(a: Contents, b: Contents, *, axes_a: str | None = None, axes_b: str | None = None) -> Comparison:
    """Compare `a` with the reference `b`.

    Levels are matched by size, and by roughness where both files state it. If no size is common, the first levels are
    compared: by the means of the finer level over the texels of the coarser one (exact overlaps), or, if that takes too
    long or a level is not of roughness 0, by a bilinear read of A at the texel centres of B. A notice states the
    method. Arrays are compared layer by layer.
    axes_a, axes_b: the axes in which a file is stored, where they differ from ours (`axes_of`).
    Raises UsageError for invalid axes, and UnsupportedError for contents that cannot be compared.
    """
    # What was chosen and left out of an image, which begins with its path.
    notices = [notice for found in (a, b) for notice in found.notices if notice.startswith(f"{found.path}: ")]
    a, b = (_in_ours(_parted(found), axes, notices) for found, axes in ((a, axes_a), (b, axes_b)))
    if "sheen" in (a.holds, b.holds) and a.holds != b.holds:
        notices.append(f"{a.path.name if a.holds == 'sheen' else b.path.name} holds Charlie's lobe, the other does not")
    for found in (a, b):
        if not found.levels and found.sh is None and found.irradiance is None:
            raise UnsupportedError(
                f"{found.path}: {found.notices[0]}"
                if found.notices
                else f"{found.path} holds no levels and no table to compare"
            )
    rows: list[Row] = []
    if _is_sphere(a) and _is_sphere(b) and a.levels and b.levels:
        rows += _levels(a, b, notices)
    elif a.levels and b.levels:
        rows += _tables(a, b, notices)
    rows += _others(a, b, notices)
    if not rows:
        raise UnsupportedError(f"{a.path} ({a.kind}) and {b.path} ({b.kind}) have nothing in common to compare")
    return Comparison(a, b, tuple(rows), tuple(notices))


# ------------------------------------------------------------------------------------------------- spheres


def _is_sphere(found: Contents) -> bool:
    return found.kind in ("cube", "cube array", "lat-long")


def _levels(a: Contents, b: Contents, notices: list[str]) -> Iterator[Row]:
    layers = {found.levels[0].shape[0] if found.kind == "cube array" else 0 for found in (a, b)}
    if len(layers) > 1:
        raise UnsupportedError(
            f"{a.path} is a {a.kind} and {b.path} a {b.kind}: an array can be compared only with an array "
            "of as many layers"
        )
    shown: list[tuple[Level, Level]] = []
    for one, other in _matched(a, b, notices):
        if a.kind != "cube array":
            yield _sphere(other.name, one, other, notices)
            shown.append((one, other))
            continue
        for k, (first, second) in enumerate(zip(one.texels, other.texels, strict=True)):
            pair = replace(one, held=first), replace(other, held=second)
            yield _sphere(f"{other.name} of layer {k}", *pair, notices)
            shown.append(pair)
    notices += _symmetry(shown)


def _matched(a: Contents, b: Contents, notices: list[str]) -> list[tuple[Level, Level]]:
    """Return pairs of levels (of A, of B) in the order of B; levels without a counterpart get a notice."""
    found: list[tuple[Level, Level]] = []
    free = list(a.levels)
    for other in b.levels:
        alike = [one for one in free if one.shape[:-1] == other.shape[:-1]]
        known = [one for one in alike if one.roughness is not None and other.roughness is not None]
        same = [one for one in known if _same(one, other)]
        pick = same or [one for one in alike if one not in known]
        if pick:
            found.append((pick[0], other))
            free.remove(pick[0])
        elif known:
            notices.append(
                f"{other.name} of {b.path.name} (r = {other.roughness:.4g}) has the size of "
                f"{known[0].name} of {a.path.name}, whose r is {known[0].roughness:.4g}: not compared"
            )
    if found:
        for side, whole in enumerate((a, b)):
            alone = [level for level in whole.levels if not any(pair[side] is level for pair in found)]
            if alone:
                notices.append(
                    ", ".join(f"{level.name} ({_size(level)})" for level in alone)
                    + f" of {whole.path.name}: no counterpart"
                )
        return sorted(found, key=lambda pair: b.levels.index(pair[1]))
    # No size is common: compare a pair of the same known roughness, else the first levels.
    by_roughness = [
        (one, other)
        for one in a.levels
        for other in b.levels
        if one.roughness is not None and other.roughness is not None and _same(one, other)
    ]
    one, other = by_roughness[0] if by_roughness else (a.levels[0], b.levels[0])
    if not by_roughness and one.roughness is not None and other.roughness is not None:
        raise UnsupportedError(
            f"{a.path} and {b.path} have no level of the same roughness: the first that "
            f"could be compared have r = {one.roughness:.4g} and r = {other.roughness:.4g}"
        )
    return [(one, other)]


def _same(one: Level, other: Level) -> bool:
    assert one.roughness is not None and other.roughness is not None
    return abs(one.roughness - other.roughness) <= SAME_ROUGHNESS


def _size(level: Level) -> str:
    shape = level.shape
    return f"{level.size}²" if len(shape) >= 4 else f"{shape[1]}×{shape[0]}"


def _colours(texels: np.ndarray) -> np.ndarray:
    """Return three channels: grey is repeated, coverage is left out."""
    if texels.shape[-1] == 2:
        raise UnsupportedError("a cube or lat-long of two channels cannot be compared: radiance has 1, 3 or 4 channels")
    return np.repeat(texels, 3, -1) if texels.shape[-1] == 1 else texels[..., :3]


def _sphere(part: str, one: Level, other: Level, notices: list[str]) -> Row:
    a, b = _colours(one.texels), _colours(other.texels)
    method = "texel by texel"
    if a.shape != b.shape:
        a, b, method, said = _laid(a, b, (one.roughness or 0) == 0 and (other.roughness or 0) == 0)
        notices.append(f"{part}: A is {_named(one)}, B {_named(other)}; {said}")
    latlong = b.ndim == 3
    shape = Shape(latlong, b.shape[-3])
    dims = b.shape[:-1]
    a, b = a.reshape(-1, 3).astype(np.float64), b.reshape(-1, 3).astype(np.float64)
    weights = _angles(latlong, dims)
    wrong = ~(np.isfinite(a) & np.isfinite(b)).all(1)
    # A texel that is not finite has an infinite error, unless both files have the same value there.
    unlike = wrong & ~((a == b) | (np.isnan(a) & np.isnan(b))).all(1)
    if wrong.any():
        a, b = np.where(wrong[:, None], 0.0, a), np.where(wrong[:, None], 0.0, b)
        notices.append(
            f"{part}: {int(wrong.sum())} texels are not finite in A or B, {int(unlike.sum())} of them differ"
        )
    mean = float((weights[:, None] * b).sum()) / (3 * float(weights.sum()))
    errors = texel_errors(a, b, mean)
    errors[unlike] = math.inf
    energy = float((weights[:, None] * b * b).sum())
    difference = float((weights[:, None] * (a - b) ** 2).sum())
    rmse = (
        math.inf
        if unlike.any()
        else math.sqrt(difference / energy)
        if energy > 0
        else 0.0
        if difference == 0
        else math.inf
    )
    at = int(errors.argmax())
    direction = (
        shape.directions(np.array([at]))
        if dims[-1] == 2 * shape.size or not latlong
        else latlong_centres(dims[0], dims[1], np.array([at]))
    )[:, 0]
    *face, row, column = np.unravel_index(at, dims)
    place = (
        (f"face {FACES[face[0]]}, " if face else "")
        + f"texel ({column}, {row}), towards "
        + "({:.2f}, {:.2f}, {:.2f})".format(*(direction + 0.0))
    )
    roughness = other.roughness if other.roughness is not None else one.roughness
    size = f"{shape.size}²" if not latlong else f"{dims[1]}×{dims[0]}"
    place = place if errors[at] > 0 else ""
    return Row(
        part,
        "level",
        size,
        method,
        percentile(errors),
        float(errors.max()),
        rmse,
        place,
        roughness,
        one.stated.get("error"),
        errors.reshape(dims),
    )


def _named(level: Level) -> str:
    return f"a {'cube' if len(level.shape) == 4 else 'lat-long'} of {_size(level)}"


def _angles(latlong: bool, dims: Sequence[int]) -> np.ndarray:
    if latlong:
        centre = (np.arange(dims[0]) + 0.5) * (math.pi / dims[0])
        return np.repeat(np.sin(centre), dims[1])
    return Shape(False, dims[-1]).solid_angles()


def percentile(errors: np.ndarray) -> float:
    """Return the 99th percentile of all errors: the smallest error that at most one in a hundred exceeds."""
    flat = errors.ravel()
    rank = max(math.ceil(0.99 * flat.size) - 1, 0)
    return float(np.partition(flat, rank)[rank])


def _laid(a: np.ndarray, b: np.ndarray, means: bool) -> tuple[np.ndarray, np.ndarray, str, str]:
    """Bring A and B to the same texels; return both, the name of the method, and a sentence about it.

    means: whether both levels have roughness 0, so that means over texels are comparable.
    """
    angles = [math.pi / 2 / x.shape[1] if x.ndim == 4 else math.pi / x.shape[0] for x in (a, b)]
    order = [(a, b), (b, a)] if angles[1] >= angles[0] else [(b, a), (a, b)]
    for fine, coarse in order[: 2 if max(angles) <= ALIKE * min(angles) else 1]:
        if means and _affordable(fine, coarse):
            latlong = coarse.ndim == 3
            shape = Shape(latlong, coarse.shape[-3])
            over = mean_over_texels(
                np.ascontiguousarray(fine, np.float32), 0.0, latlong, shape.size, np.arange(shape.count)
            ).reshape(*coarse.shape)
            first, second, names = (over, b, "AB") if fine is a else (a, over, "BA")
            return (
                first,
                second,
                "overlap",
                (
                    f"the means of {names[0]} over the texels of {names[1]} are compared, "
                    f"which is exact where {names[1]} was made of {names[0]}"
                ),
            )
    d = (
        cube_centres(b.shape[1], np.arange(b.size // 3))
        if b.ndim == 4
        else latlong_centres(b.shape[0], b.shape[1], np.arange(b.size // 3))
    )
    read = bilinear(a, d) if a.ndim == 4 else _read_latlong(a, d)
    return (
        read.reshape(b.shape),
        b,
        "bilinear",
        ("A is read bilinearly at B's texel centres, and what that is off by is in the errors"),
    )


def _affordable(fine: np.ndarray, coarse: np.ndarray) -> bool:
    if coarse.ndim == 3:
        most = LATLONG_TEXELS if fine.ndim == 4 else ROW_TEXELS
        return coarse.shape[1] == 2 * coarse.shape[0] and coarse.size // 3 <= most
    return coarse.size // 3 <= CUBE_TEXELS


def _read_latlong(texels: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Read a lat-long bilinearly in directions (3, m), across the poles too; return (m, 3)."""
    rows, columns = texels.shape[:2]
    x = (np.arctan2(d[2], d[0]) / (2 * math.pi) + 0.5) * columns - 0.5
    y = np.arccos(np.clip(d[1], -1, 1)) / math.pi * rows - 0.5
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = (x - j)[:, None], (y - i)[:, None]

    def at(row: np.ndarray, column: np.ndarray) -> np.ndarray:
        over = (row < 0) | (row >= rows)
        row = np.where(row < 0, -1 - row, np.where(row >= rows, 2 * rows - 1 - row, row))
        return texels[row, np.where(over, column + columns // 2, column) % columns].astype(np.float64)

    return (1 - v) * ((1 - u) * at(i, j) + u * at(i, j + 1)) + v * ((1 - u) * at(i + 1, j) + u * at(i + 1, j + 1))


def _symmetry(pairs: Sequence[tuple[Level, Level]]) -> list[str]:
    """Return a notice where A's cube agrees far better after a turn or a reflection; else an empty list."""
    alike = [(one, other) for one, other in pairs if len(one.shape) == 4 and one.shape == other.shape and one.size > 1]
    if not alike:
        return []
    one, other = min(alike, key=lambda pair: abs(pair[0].size - 32))
    a, b = (np.nan_to_num(_reduced(_colours(level.texels)), posinf=0, neginf=0) for level in (one, other))

    def off(texels: np.ndarray) -> float:
        return float(((texels - b) ** 2).sum())

    now = off(a)
    if now <= 1e-4 * float((b * b).sum()):  # with an RMSE below 1 % the cube is not turned
        return []
    least, best = min((off(turned_cube(a, axes.T)), text) for text, axes in _symmetries())
    if least > MIRRORED**2 * now:
        # Not a symmetry of the cube: try to turn or mirror each face by itself.
        flips = {"left to right": a[:, :, ::-1], "upside down": a[:, ::-1], "by half a turn": a[:, ::-1, ::-1]}
        least, best = min((off(texels), name) for name, texels in flips.items())
        return (
            []
            if least > MIRRORED**2 * now
            else [
                f"each face of A is turned or mirrored by itself: {best} the RMS difference of {other.name} is "
                f"{math.sqrt(least / now):.1g} of what it is now"
            ]
        )
    return [
        f"A is turned or mirrored: with --axes-a {best!r} the RMS difference of {other.name} is "
        f"{math.sqrt(least / now):.1g} of what it is now"
    ]


def _reduced(texels: np.ndarray) -> np.ndarray:
    """Average square blocks of texels to at most 64² per face, in float64."""
    n = texels.shape[1]
    step = next((k for k in range(1, n + 1) if n % k == 0 and n // k <= 64), n)
    return texels.reshape(6, n // step, step, n // step, step, 3).mean((2, 4), dtype=np.float64)


def _symmetries() -> Iterator[tuple[str, np.ndarray]]:
    """Yield the 48 symmetries of the cube as text and matrix, the identity among them."""
    for order in itertools.permutations(AXES):
        for signs in itertools.product("+-", repeat=3):
            text = " ".join(sign + letter for sign, letter in zip(signs, order, strict=True))
            yield text, axes_of(text)


# ------------------------------------------------------------------------------------------------- axes


def _in_ours(found: Contents, axes: str | None, notices: list[str]) -> Contents:
    """Turn contents to our axes, from the given axes or from those of the engine that a cube was written for."""
    if axes is None and (found.cube or found.kind == "harmonics") and found.written_for is not None:
        engine, text = found.written_for
        if not np.array_equal(axes_of(text), np.eye(3)):
            axes = text
            notices.append(f"{found.path.name} was written for {engine}, in the axes {text}: it was turned back")
    return found if axes is None else _turned(found, axes_of(axes))


def _parted(found: Contents) -> Contents:
    """Move the level of a file that holds irradiance alone to `irradiance`, so that it is compared as irradiance."""
    if found.holds != "irradiance" or not found.cube or len(found.levels) != 1 or found.irradiance is not None:
        return found
    return replace(found, levels=(), irradiance=replace(found.levels[0], name="irradiance"))


def _turned(found: Contents, axes: np.ndarray) -> Contents:
    """Turn contents from `axes` to ours. Raises UnsupportedError for contents without directions."""
    if not _is_sphere(found) and found.levels:
        raise UnsupportedError(f"{found.path} holds {found.kind}, and only cubes and lat-longs have axes")
    levels = tuple(_turned_level(level, axes, found) for level in found.levels)
    irradiance = found.irradiance and _turned_level(found.irradiance, axes, found)
    sh = None if found.sh is None else turned(found.sh, axes.T)
    return replace(found, levels=levels, irradiance=irradiance, sh=sh)


def _turned_level(level: Level, axes: np.ndarray, found: Contents) -> Level:
    return replace(level, held=Deferred(level.shape, lambda: _along(level.texels, axes, found)))


def _along(texels: np.ndarray, axes: np.ndarray, found: Contents) -> np.ndarray:
    if texels.ndim >= 4:  # the transpose of P undoes P · d
        cubes = [turned_cube(cube, axes.T) for cube in texels.reshape(-1, *texels.shape[-4:])]
        return np.stack(cubes).reshape(texels.shape)
    rows, columns, _ = texels.shape
    if abs(axes[1, 1]) != 1 or columns % 4:
        raise UnsupportedError(
            f"{found.path} is a lat-long: its axes must keep y, and its width must be a multiple of 4; "
            "otherwise its texels would have to be resampled"
        )
    d = axes @ latlong_centres(rows, columns, rows // 2 * columns + np.arange(columns))
    column = np.rint((np.arctan2(d[2], d[0]) / (2 * math.pi) + 0.5) * columns - 0.5).astype(int) % columns
    return (texels[::-1] if axes[1, 1] < 0 else texels)[:, column]


# ------------------------------------------------------------------------------------------------- tables and the rest


def _tables(a: Contents, b: Contents, notices: list[str]) -> Iterator[Row]:
    if _is_sphere(a) != _is_sphere(b) and "table" not in (a.kind, b.kind):
        raise UnsupportedError(f"{a.path} holds {a.kind} and {b.path} {b.kind}, which cannot be compared")
    named = {level.name: level for level in a.levels}
    pairs = (
        [(named[level.name], level) for level in b.levels if level.name in named]
        if a.kind == b.kind == "arrays"
        else list(zip(a.levels, b.levels, strict=False))
    )
    alike = [(one, other) for one, other in pairs if one.shape[:-1] == other.shape[:-1]]
    if not alike:
        shapes = (" × ".join(map(str, found.levels[0].shape[:-1])) for found in (a, b))
        raise UnsupportedError(
            f"{a.path} and {b.path} are tables of {' and '.join(shapes)} texels; "
            "only tables of the same size can be compared"
        )
    for one, other in alike:
        yield from _table(other.name, one, other, notices)


def _table(part: str, one: Level, other: Level, notices: list[str]) -> Iterator[Row]:
    a, b = one.texels, other.texels
    if a.shape[-1] != b.shape[-1]:
        notices.append(
            f"{part}: A has {a.shape[-1]} channels, B {b.shape[-1]}; the first "
            f"{min(a.shape[-1], b.shape[-1])} are compared"
        )
    for channel in range(min(a.shape[-1], b.shape[-1])):
        x, y = (texels[..., channel].astype(np.float64) for texels in (a, b))
        with np.errstate(invalid="ignore"):
            errors = np.where((x == y) | (np.isnan(x) & np.isnan(y)), 0.0, np.abs(x - y))
        errors = np.where(np.isnan(errors), math.inf, errors)
        cell = np.unravel_index(int(errors.argmax()), errors.shape)
        place = f"cell ({', '.join(str(int(k)) for k in reversed(cell))})" if errors.max() > 0 else ""
        size = "×".join(str(n) for n in reversed(errors.shape))
        yield Row(
            f"{part}, channel {channel + 1}",
            "table",
            size,
            "cell by cell",
            percentile(errors),
            float(errors.max()),
            None,
            place,
            None,
            one.stated.get("error"),
            errors,
        )


def _others(a: Contents, b: Contents, notices: list[str]) -> Iterator[Row]:
    """Compare the irradiance, the spherical harmonics and the DFG table, where both files have them."""
    if a.irradiance is not None and b.irradiance is not None:
        yield _sphere(
            "irradiance", replace(a.irradiance, roughness=None), replace(b.irradiance, roughness=None), notices
        )
    if a.sh is not None and b.sh is not None:
        off = np.abs(a.sh - b.sh)
        scale = float(np.abs(b.sh[0]).max())
        errors = off / scale if scale > 0 else np.where(off > 0, math.inf, 0.0)
        k, c = np.unravel_index(int(np.nan_to_num(errors, nan=math.inf).argmax()), errors.shape)
        worst = float(np.nan_to_num(errors, nan=math.inf).max())
        names = ("L00", "L1-1", "L10", "L11", "L2-2", "L2-1", "L20", "L21", "L22")
        yield Row(
            "SH",
            "sh",
            "9×3",
            "over the largest L00",
            worst,
            worst,
            None,
            f"{names[int(k)]} of {'RGB'[int(c)]}" if worst > 0 else "",
        )
    if a.dfg is not None and b.dfg is not None and a.dfg.shape[:-1] == b.dfg.shape[:-1]:
        yield from _table("dfg", a.dfg, b.dfg, notices)
