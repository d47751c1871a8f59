"""Computes the mean of a piecewise constant source over output texels in float64: the reference of level 0.

`kernels/overlap.cl` finds the areas of overlap in closed form, from arcs of great circles and by clipping polygons;
here they are iterated integrals. A lat-long source is integrated over azimuth by Gauss nodes and along the meridian
exactly; a cube source over a face coordinate s by Gauss nodes and along t exactly. Between the breakpoints (source
columns, corners, places where a side of the texel crosses a row) the integrand is analytic and the rows that a side
lies in are fixed, so only rounding errors remain.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from whitefurnace.catalogue.rule import gauss

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

BATCH = 64
"""Number of output texels that are computed together: enough for NumPy to be efficient, and little memory."""

TALL = 24
"""Number of source rows in a texel from which prefix sums of its own columns are faster."""

BLOCK = 1 << 18
"""Number of source texels of one such prefix sum: 6 MiB."""

ALIGNED = 256
"""Largest number of source texels along an edge of an output texel for which the overlaps of two cubes with the same
axes are computed one by one."""


def mean_over_texels(
    texels: npt.NDArray[np.float32], rotation: float, latlong_output: bool, size: int, indices: npt.NDArray[np.integer]
) -> Floats:
    """Return the mean radiance of a source over output texels, by exact solid angles: (m, 3) float64.

    texels: radiance, (h, w, 3) of a lat-long or (6, n, n, 3) of a cube in the GL-direct layout, constant over each
    texel.
    rotation: radians that are added to the azimuth atan2(z, x) of the source.
    latlong_output, size: True for a lat-long (size, 2 size), False for a cube (6, size, size).
    indices: (m,) flat indices of output texels.

    The error is about 1e-12 of the largest radiance that touches the texel (`tests/sphere/test_overlap.py`).
    """
    flat = np.asarray(indices, np.int64)
    out = np.empty((len(flat), 3))
    if texels.ndim == 3 and latlong_output:
        return _latlong_from_latlong(texels, rotation, size, flat)
    if texels.ndim == 4 and not latlong_output and rotation == 0 and texels.shape[1] <= ALIGNED * size:
        return _cube_on_cube(texels, size, flat)
    for first in range(0, len(flat), BATCH):
        part = flat[first : first + BATCH]
        if texels.ndim == 3:
            sums, area = _cube_from_latlong(texels, rotation, size, part)
        elif latlong_output:
            sums, area = _latlong_from_cube(texels, rotation, size, part)
        else:
            sums, area = _cube_from_cube(texels, rotation, size, part)
        out[first : first + BATCH] = sums / area[:, None]
    return out


# ---------------------------------------------------------------------------------------------- ragged helpers


def _ranges(first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """Return (owner, value) of the concatenated ranges first[k] … last[k] - 1; empty ranges leave nothing."""
    count = np.maximum(last - first, 0)
    owner = np.repeat(np.arange(len(count)), count)
    value = np.arange(len(owner)) + np.repeat(first - (np.cumsum(count) - count), count)
    return owner, value


def _intervals(owners: list[Ints], points: list[Floats], low: Floats, high: Floats) -> tuple[Ints, Floats, Floats]:
    """Return (owner, from, to) of the pieces into which the breakpoints within [low, high] cut each owner's range."""
    own = np.arange(len(low))
    owner = np.concatenate([own, own, *owners])
    point = np.concatenate([low, high, *points])
    inside = (point >= low[owner]) & (point <= high[owner])  # drops NaN
    owner, point = owner[inside], point[inside]
    order = np.lexsort((point, owner))
    owner, point = owner[order], point[order]
    keep = (owner[1:] == owner[:-1]) & (point[1:] > point[:-1])
    return owner[:-1][keep], point[:-1][keep], point[1:][keep]


def _sum_by(owner: Ints, values: Floats, count: int) -> Floats:
    """Return the sums of values (n, 3) by owner, (count, 3)."""
    return np.stack([np.bincount(owner, values[:, k], count) for k in range(3)], 1)


# ---------------------------------------------------------------------------------------------- lat-long source


def _latlong_from_latlong(texels: npt.NDArray[np.float32], rotation: float, size: int, flat: Ints) -> Floats:
    """Sum rectangles in (φ, cos θ): the product of overlaps in θ and in φ."""
    rows, columns = texels.shape[:2]
    ratio, shift = columns / (2 * size), rotation / (2 * math.pi) * columns
    out = np.empty((len(flat), 3))
    for k, (i, j) in enumerate(zip(*np.divmod(flat, 2 * size), strict=True)):
        r = np.arange(i * rows // size, -(-(i + 1) * rows // size))
        top = np.maximum(i * rows, r * size) * (math.pi / (rows * size))
        bottom = np.minimum((i + 1) * rows, (r + 1) * size) * (math.pi / (rows * size))
        down = np.sin((top + bottom) / 2) * np.sin((bottom - top) / 2)  # half of cos top - cos bottom
        x0, x1 = j * ratio - shift, (j + 1) * ratio - shift
        c = np.arange(math.floor(x0), math.ceil(x1))
        across = np.maximum(np.minimum(c + 1, x1) - np.maximum(c, x0), 0)
        block = texels[r[0] : r[-1] + 1].take(c % columns, axis=1).astype(np.float64)
        by_column = (down @ block.reshape(len(r), -1)).reshape(-1, 3)
        out[k] = across @ by_column / (down.sum() * across.sum())
    return out


def _versine(tau: Floats) -> Floats:
    """Return 1 - cos θ for cot θ = tau, without the cancellation of the difference near θ = 0; tau ≥ -1, or inf."""
    with np.errstate(invalid="ignore"):
        root = np.sqrt(1 + tau * tau)
        value = 1 / (root * (root + tau))
    return np.where(tau < np.inf, value, 0.0)


def _cube_from_latlong(
    texels: npt.NDArray[np.float32], rotation: float, size: int, flat: Ints
) -> tuple[Floats, Floats]:
    """∫dφ ∫dy L over each texel (m, 3), and its solid angle (m,).

    At azimuth φ the texel is an interval of τ = cot θ. On a side face, ψ = φ - φ_axis: a side t = const is
    τ = -t cos ψ and s is -tan ψ. On ±Y the texel is a rectangle of the plane (x, z), 1/τ the radius: a ray at
    φ enters and leaves it; -Y is +Y of the source upside down. y is replaced by 1 - y, exact at the pole.
    """
    rows, columns = texels.shape[:2]
    m = len(flat)
    face, rest = np.divmod(flat, size * size)
    i, j = np.divmod(rest, size)
    s0, s1, t0, t1 = ((2 * k - size) / size for k in (j, j + 1, i, i + 1))
    polar, south = (face == 2) | (face == 3), face == 3
    z0, z1 = np.where(south, -t1, t0), np.where(south, -t0, t1)

    # Where each texel's azimuth is counted from (`base`), and the angle δ of a point (x, z) of the plane ±Y.
    cx, cz = (s0 + s1) / 2, (z0 + z1) / 2
    cx = np.where((cx == 0) & (cz == 0), 1.0, cx)
    around = polar & (s0 < 0) & (s1 > 0) & (z0 < 0) & (z1 > 0)  # holds the pole
    axis = np.array([0.0, math.pi, 0.0, 0.0, math.pi / 2, -math.pi / 2])[face]
    base = np.where(polar, np.arctan2(cz, cx), axis)

    def delta(k: Ints, x: Floats, z: Floats) -> Floats:
        return np.arctan2(cx[k] * z - cz[k] * x, cx[k] * x + cz[k] * z)

    all_m = np.arange(m)
    corners = np.stack([delta(all_m, x, z) for x in (s0, s1) for z in (z0, z1)])
    low = np.where(polar, np.where(around, -math.pi, corners.min(0)), -np.arctan(s1))
    high = np.where(polar, np.where(around, math.pi, corners.max(0)), -np.arctan(s0))

    # Rows each texel may touch (from the top, or from the bottom for -Y), with one to spare.
    nearest = np.hypot(np.maximum(np.maximum(s0, -s1), 0), np.maximum(np.maximum(z0, -z1), 0))
    farthest = np.hypot(np.maximum(np.abs(s0), np.abs(s1)), np.maximum(np.abs(z0), np.abs(z1)))
    cos_most = np.where(s0 * s1 < 0, 1.0, 1 / np.hypot(1, np.minimum(np.abs(s0), np.abs(s1))))
    cos_least = 1 / np.hypot(1, np.maximum(np.abs(s0), np.abs(s1)))
    up = np.maximum(-t0 * cos_most, -t0 * cos_least)
    down = np.minimum(-t1 * cos_most, -t1 * cos_least)
    theta_low = np.where(polar, np.arctan(nearest), np.arctan2(1, up))
    theta_high = np.where(polar, np.arctan(farthest), np.arctan2(1, down))
    r_first = np.clip(np.floor(theta_low * (rows / math.pi)).astype(np.int64) - 1, 0, rows - 1)
    r_last = np.clip(np.floor(theta_high * (rows / math.pi)).astype(np.int64) + 1, 0, rows - 1)

    owners: list[Ints] = [np.tile(all_m[polar], 4)]
    points: list[Floats] = [corners[:, polar].ravel()]
    # Source columns: δ = 2π c/columns - π + rotation - base.
    per = columns / (2 * math.pi)
    zero = (math.pi + base - rotation) * per
    k, c = _ranges(np.ceil(low * per + zero).astype(np.int64), np.floor(high * per + zero).astype(np.int64) + 1)
    owners.append(k)
    points.append((c - zero[k]) / per)
    # Rows: the circle of radius tan θ_r cuts x = d at z = ±√(tan² θ_r - d²); on a side face τ = cot θ_r at
    # 1 + s² = t² tan² θ_r. Corners and wrong signs fall outside the texel's side and are dropped.
    k, r = _ranges(r_first + 1, r_last + 1)
    theta = r * (math.pi / rows)
    radius = np.tan(theta)
    with np.errstate(invalid="ignore"):
        on = polar[k] & (theta < 1.5)
        kp, radius_p = k[on], radius[on]
        for x in (s0, s1):
            other = np.sqrt((radius_p - x[kp]) * (radius_p + x[kp]))
            for z in (other, -other):
                hit = (z >= z0[kp]) & (z <= z1[kp])
                owners.append(kp[hit])
                points.append(delta(kp[hit], x[kp[hit]], z[hit]))
        for z in (z0, z1):
            other = np.sqrt((radius_p - z[kp]) * (radius_p + z[kp]))
            for x in (other, -other):
                hit = (x >= s0[kp]) & (x <= s1[kp])
                owners.append(kp[hit])
                points.append(delta(kp[hit], x[hit], z[kp[hit]]))
        on = ~polar[k]
        ks, radius_s = k[on], radius[on]
        for t in (t0, t1):
            scaled = -t[ks] * radius_s
            s = np.where(scaled > 0, np.sqrt((scaled - 1) * (scaled + 1)), np.nan)
            owners += [ks, ks]
            points += [np.arctan(s), -np.arctan(s)]
    own, a, b = _intervals(owners, points, low, high)

    # Per interval: the sides τ = p cos α + q sin α above and below, their rows, the column.
    middle, width = (a + b) / 2, b - a
    alpha0 = np.where(polar, base, 0.0)[own]
    cosine, sine = np.cos(alpha0 + middle), np.sin(alpha0 + middle)
    on = polar[own]
    with np.errstate(divide="ignore", invalid="ignore"):
        lines = np.stack([s0[own], s1[own], z0[own], z1[own]])
        hits = lines / np.stack([cosine, cosine, sine, sine])
        enter_x, enter_z = np.where(cosine > 0, 0, 1), np.where(sine > 0, 2, 3)
        n = np.arange(len(own))
        # Along an axis the ray never meets the sides parallel to it.
        enter = np.where((sine == 0) | (hits[enter_x, n] > hits[enter_z, n]) & (cosine != 0), enter_x, enter_z)
        leave = np.where(
            (sine == 0) | (hits[1 - enter_x, n] < hits[5 - enter_z, n]) & (cosine != 0), 1 - enter_x, 5 - enter_z
        )
        pole = on & ~(hits[enter, n] > 0)
        inverse_in, inverse_out = 1 / lines[enter, n], 1 / lines[leave, n]
    # A breakpoint rounded past an axis leaves a piece of 1e-16 rad where no side is left: no weight.
    lost = on & ~np.isfinite(inverse_out)
    width = np.where(lost, 0.0, width)
    inverse_in, inverse_out = np.where(pole | lost, 0.0, inverse_in), np.where(lost, 1.0, inverse_out)
    p_up = np.where(on, np.where(enter < 2, inverse_in, 0.0), -t0[own])
    q_up = np.where(on & (enter >= 2), inverse_in, 0.0)
    p_down = np.where(on, np.where(leave < 2, inverse_out, 0.0), -t1[own])
    q_down = np.where(on & (leave >= 2), inverse_out, 0.0)

    def row_of(tau: Floats) -> Ints:
        return np.clip(np.floor(np.arctan2(1, tau) * (rows / math.pi)).astype(np.int64), 0, rows - 1)

    r_up = np.where(pole, 0, row_of(p_up * cosine + q_up * sine))
    r_down = np.maximum(row_of(p_down * cosine + q_down * sine), r_up)
    column: Ints = np.mod(np.floor(middle * per + zero[own]).astype(np.int64), columns)

    # ∫ (1 - y) dφ of both sides. Singularities lie at least .46 from a piece of at most 2π/columns, or k times
    # its length where sides seen from the pole make it shorter: 12 nodes leave 1e-14, 6 and 4 leave 1e-12.
    x, w = gauss(12 if columns < 64 else 6 if columns < 512 else 4)
    v_up, v_down = np.zeros(len(own)), np.zeros(len(own))
    for xk, wk in zip(x, w, strict=True):
        angle = alpha0 + (a + width * xk)
        cosine, sine = np.cos(angle), np.sin(angle)
        v_up += wk * _versine(np.where(pole, np.inf, p_up * cosine + q_up * sine))
        v_down += wk * _versine(p_down * cosine + q_down * sine)
    edges = 2 * np.sin(np.arange(rows + 1) * (math.pi / (2 * rows))) ** 2
    step = 2 * np.sin((np.arange(rows) + 0.5) * (math.pi / rows)) * math.sin(math.pi / (2 * rows))

    single = r_up == r_down
    first_weight = width * np.where(single, v_down - v_up, edges[r_up + 1] - v_up)
    last_weight = width * np.where(single, 0.0, v_down - edges[r_down])
    flip = south[own]

    def radiance(r: Ints, c: Ints, flipped: npt.NDArray[np.bool_]) -> Floats:
        return texels[np.where(flipped, rows - 1 - r, r), c].astype(np.float64)

    sums = _sum_by(
        own,
        first_weight[:, None] * radiance(r_up, column, flip) + last_weight[:, None] * radiance(r_down, column, flip),
        m,
    )
    area = np.bincount(own, width * (v_down - v_up), m).astype(np.float64)

    # Rows wholly between the two sides.
    tall = (r_last - r_first > TALL)[own]
    short = np.flatnonzero(~tall)
    n, r = _ranges(r_up[short] + 1, r_down[short])
    n = short[n]
    sums += _sum_by(own[n], (width[n] * step[r])[:, None] * radiance(r, column[n], flip[n]), m)
    for number in np.flatnonzero(r_last - r_first > TALL):
        here = np.flatnonzero(own == number)
        top, bottom = int(r_up[here].min()), int(r_down[here].max()) + 1
        sums[number] += _between(
            texels[::-1] if south[number] else texels,
            top,
            bottom,
            step,
            column[here],
            width[here],
            r_up[here] + 1 - top,
            r_down[here] - top,
        )
    return sums, area


def _between(
    texels: npt.NDArray[np.float32],
    top: int,
    bottom: int,
    step: Floats,
    column: Ints,
    width: Floats,
    first: Ints,
    last: Ints,
) -> Floats:
    """Return ∑ width · ∑ over rows top + first … top + last - 1 of step · L, (3,), by prefix sums of the columns
    used.
    """
    total = np.zeros(3)
    used, which = np.unique(column, return_inverse=True)
    last = np.maximum(first, last)
    per = max(BLOCK // (bottom - top), 1)
    for begin in range(0, len(used), per):
        block = texels[top:bottom].take(used[begin : begin + per], axis=1)
        prefix = np.zeros((bottom - top + 1, *block.shape[1:]))
        np.cumsum(block * step[top:bottom, None, None], axis=0, out=prefix[1:])
        here = (which >= begin) & (which < begin + per)
        c = which[here] - begin
        total += width[here] @ (prefix[last[here], c] - prefix[first[here], c])
    return total


# ---------------------------------------------------------------------------------------------- cube source

# A side of a region in the plane of a source face is t(s) = a + b s + k √(e + g s²): a great circle (k = 0), a
# parallel on a side face (e = g = 1) or on ±Y (a circle, e = ρ², g = -1).
_NONE_BELOW = np.array([-1.0, 0.0, 0.0, 1.0, 0.0])
_NONE_ABOVE = np.array([1.0, 0.0, 0.0, 1.0, 0.0])


def _regions(
    texels: npt.NDArray[np.float32], place: Ints, low: Floats, high: Floats, below: Floats, above: Floats, extra: Floats
) -> tuple[Floats, Floats]:
    """∫∫ L (1 + s² + t²)^{-3/2} dt ds over regions of face planes: (R, 3), and with L = 1: (R,).

    texels: (6 n², 3). place: (R, 3), the flat index of texel (s, t) = (0, 0) of a region's face and the steps to
    the next along s and t. low, high: (R,), the range of s in [-1, 1], empty ones too. below, above: (R, K, 5),
    the region lies over the highest of the one and under the lowest of the other. extra: (R, E), places in s
    where two sides meet. The antiderivative of the density in t is t/((1 + s²) √(1 + s² + t²)).
    """
    count, n = len(place), math.isqrt(len(texels) // 6)
    keep = np.flatnonzero(high > low)
    owners: list[Ints] = []
    points: list[Floats] = []
    k, c = _ranges(
        np.ceil((low[keep] + 1) / 2 * n).astype(np.int64), np.floor((high[keep] + 1) / 2 * n).astype(np.int64) + 1
    )
    owners.append(keep[k])
    points.append((2 * c - n) / n)
    owners.append(np.repeat(keep, extra.shape[1]))
    points.append(extra[keep].ravel())
    for sides in (below, above):
        for side in np.moveaxis(sides, 1, 0):
            a, b, bend, e, g = side[keep].T
            # The rows a side can cross lie between its values at the ends and at its apex s = 0.
            ends = np.stack([low[keep], high[keep], np.clip(0, low[keep], high[keep])])
            t = np.clip(a + b * ends + bend * np.sqrt(np.maximum(e + g * ends * ends, 0)), -1, 1)
            first = np.ceil((t.min(0) + 1) / 2 * n - 1e-9).astype(np.int64)
            last = np.floor((t.max(0) + 1) / 2 * n + 1e-9).astype(np.int64) + 1
            k, r = _ranges(np.maximum(first, 0), np.minimum(last, n + 1))
            t = (2 * r - n) / n
            with np.errstate(divide="ignore", invalid="ignore"):
                line = (t - a[k]) / b[k]
                bent = np.sqrt(((t / bend[k]) ** 2 - e[k]) / g[k])
            straight = bend[k] == 0
            for s in (np.where(straight, line, bent), np.where(straight, np.nan, -bent)):
                owners.append(keep[k])
                points.append(s)
    own, s0, s1 = _intervals(owners, points, low, high)
    width, middle = s1 - s0, (s0 + s1) / 2

    def value(side: Floats, s: Floats) -> Floats:
        a, b, bend, e, g = side.T
        return a + b * s + bend * np.sqrt(np.maximum(e + g * s * s, 0))

    def highest(sides: Floats, sign: int) -> tuple[Floats, Floats]:
        """The side (intervals, 5) that bounds each interval, and its t in the middle."""
        best = np.where(sign > 0, _NONE_BELOW, _NONE_ABOVE) * np.ones((len(own), 1))
        t = np.full(len(own), -1.0 * sign)
        for side in np.moveaxis(sides, 1, 0):
            here = value(side[own], middle)
            over = (here - t) * sign > 0
            best[over], t = side[own][over], np.where(over, here, t)
        return best, t

    under, t0 = highest(below, 1)
    over, t1 = highest(above, -1)
    real = t1 > t0
    own, under, over = own[real], under[real], over[real]
    s0, width, middle, t0, t1 = (x[real] for x in (s0, width, middle, t0, t1))
    r0 = np.clip(np.floor((t0 + 1) / 2 * n).astype(np.int64), 0, n - 1)
    r1 = np.maximum(np.clip(np.floor((t1 + 1) / 2 * n).astype(np.int64), 0, n - 1), r0)
    column = np.clip(np.floor((middle + 1) / 2 * n).astype(np.int64), 0, n - 1)
    single = r0 == r1
    after, before = 2 * (r0 + 1) / n - 1, 2 * r1 / n - 1

    # The nearest singularity is s = ±i, or for a circle its end, .3 of its radius away: 14 nodes leave 1e-13 on
    # the largest piece of a face cut in two, 28 where it is whole, 6 where columns cut lines into sixteenths.
    first, last = np.zeros(len(own)), np.zeros(len(own))
    x, w = gauss(28 if n == 1 else 14 if n < 16 or (below[..., 4] < 0).any() else 6)
    for xk, wk in zip(x, w, strict=True):
        s = s0 + width * xk
        q = 1 + s * s
        lower, upper = (np.clip(value(side, s), -1, 1) for side in (under, over))
        low_f, high_f, after_f, before_f = (t / (q * np.sqrt(q + t * t)) for t in (lower, upper, after, before))
        first += wk * np.where(single, high_f - low_f, after_f - low_f)
        last += wk * np.where(single, 0.0, high_f - before_f)
    first *= width
    last *= width
    origin = place[own, 0] + column * place[own, 1]
    step = place[own, 2]
    sums = _sum_by(own, first[:, None] * texels[origin + r0 * step] + last[:, None] * texels[origin + r1 * step], count)
    area = np.bincount(own, first + last, count).astype(np.float64)

    # Texels wholly between the two sides, by Gauss nodes too, in pieces of bounded memory.
    between = np.cumsum(np.maximum(r1 - r0 - 1, 0))
    total = int(between[-1]) if len(between) else 0
    pieces = [int(np.searchsorted(between, full)) for full in range(0, total, BLOCK)] + [len(own)]
    x, w = gauss(8 if n < 16 else 4)
    for begin, end in itertools.pairwise(pieces):
        k, r = _ranges(r0[begin:end] + 1, r1[begin:end])
        k += begin
        a, b = 2 * r / n - 1, 2 * (r + 1) / n - 1
        weight = np.zeros(len(k))
        for xk, wk in zip(x, w, strict=True):
            q = 1 + (s0[begin:end] + width[begin:end] * xk) ** 2
            q, inverse = q[k - begin], (wk * width[begin:end] / q)[k - begin]
            weight += inverse * (b / np.sqrt(q + b * b) - a / np.sqrt(q + a * a))
        sums += _sum_by(own[k], weight[:, None] * texels[origin[k] + r * step[k]], count)
        area += np.bincount(own[k], weight, count)
    return sums, area


def _cube_on_cube(texels: npt.NDArray[np.float32], size: int, flat: Ints) -> Floats:
    """Sum the overlaps of faces with the same axes: rectangles in (s, t), by Gauss nodes in s and exactly along t."""
    n = texels.shape[1]
    out = np.empty((len(flat), 3))
    step = max(BLOCK // (n // size + 2) ** 2, 1)
    for begin in range(0, len(flat), step):
        face, rest = np.divmod(flat[begin : begin + step], size * size)
        i, j = np.divmod(rest, size)
        strip, c = _ranges(j * n // size, -(-(j + 1) * n // size))
        piece, r = _ranges((i * n // size)[strip], -(-(i + 1)[strip] * n // size))
        own, c = strip[piece], c[piece]
        # In units of 1/(n · size), so that edges that meet are equal.
        unit = 2 / (n * size)
        s0, t0 = (np.maximum(a * size, b[own] * n) * unit - 1 for a, b in ((c, j), (r, i)))
        s1, t1 = (np.minimum((a + 1) * size, (b[own] + 1) * n) * unit - 1 for a, b in ((c, j), (r, i)))
        weight = np.zeros(len(own))
        # The nearest singularity is s = ±i: 28 nodes leave 1e-13 on a whole face, 6 on a sixteenth of one.
        x, w = gauss(28 if max(n, size) < 4 else 14 if max(n, size) < 16 else 6)
        for xk, wk in zip(x, w, strict=True):
            q = 1 + (s0 + (s1 - s0) * xk) ** 2
            weight += wk / q * (t1 / np.sqrt(q + t1 * t1) - t0 / np.sqrt(q + t0 * t0))
        weight *= s1 - s0
        values = texels[face[own], r, c].astype(np.float64)
        area = np.bincount(own, weight, len(face))
        out[begin : begin + step] = _sum_by(own, weight[:, None] * values, len(face)) / area[:, None]
    return out


def _to_face(face: int, d: tuple[Floats, Floats, Floats]) -> tuple[Floats, Floats, Floats]:
    """Return the components (s, t, axis) of d in the frame of a face of the GL-direct layout."""
    x, y, z = d
    return ((-z, -y, x), (z, -y, -x), (x, z, y), (x, -z, -y), (x, -y, z), (-x, -y, -z))[face]


def _places(n: int, face: Ints) -> Ints:
    return np.stack([face * n * n, np.full_like(face, 1), np.full_like(face, n)], 1)


def _cube_from_cube(texels: npt.NDArray[np.float32], rotation: float, size: int, flat: Ints) -> tuple[Floats, Floats]:
    """Return the radiance and the solid angle of each texel, from the six source faces.

    In the plane of a source face a texel is the polygon that its four side planes n·d ≥ 0 cut out.
    """
    n, m = texels.shape[1], len(flat)
    face, rest = np.divmod(flat, size * size)
    i, j = np.divmod(rest, size)
    s0, s1, t0, t1 = ((2 * k - size) / size for k in (j, j + 1, i, i + 1))
    one, zero = np.ones(m), np.zeros(m)
    planes = np.empty((4, 3, m))
    for k, (s, t, axis) in enumerate(((one, zero, -s0), (-one, zero, s1), (zero, one, -t0), (zero, -one, t1))):
        for f in range(6):
            # The frame's axes as world vectors: s, t and axis of a face, the transpose of `_to_face`.
            world = _frame(f)
            here = face == f
            for c in range(3):
                planes[k, c, here] = (world[0][c] * s + world[1][c] * t + world[2][c] * axis)[here]
    cosine, sine = math.cos(rotation), math.sin(rotation)
    planes = np.stack(
        [cosine * planes[:, 0] + sine * planes[:, 2], planes[:, 1], cosine * planes[:, 2] - sine * planes[:, 0]], 1
    )
    low, high = np.full((6, m), -1.0), np.full((6, m), 1.0)
    below, above = np.tile(_NONE_BELOW, (6, m, 4, 1)), np.tile(_NONE_ABOVE, (6, m, 4, 1))
    lines = np.empty((6, 8, 3, m))  # the texel's sides and the face's, (a, b, c) of a s + b t + c >= 0
    lines[:, 4:] = np.array([(0, 1, 1), (0, -1, 1), (1, 0, 1), (-1, 0, 1)])[:, :, None]
    for f in range(6):
        for k in range(4):
            ns, nt, na = (np.asarray(v) for v in _to_face(f, tuple(planes[k])))  # type: ignore[arg-type]
            lines[f, k] = ns, nt, na
            with np.errstate(divide="ignore", invalid="ignore"):
                # A plane within 1e-15 of the t axis bounds s: its t(s) would be lost in rounding.
                upright = np.abs(nt) < 1e-15
                bound = -na / ns
                low[f] = np.where(upright & (ns > 0), np.maximum(low[f], bound), low[f])
                high[f] = np.where(upright & (ns < 0), np.minimum(high[f], bound), high[f])
                side = np.stack([-na / nt, -ns / nt, np.zeros(m), np.ones(m), np.zeros(m)], 1)
            # A plane through the centre line of the face that keeps all or nothing of it.
            high[f] = np.where(upright & (ns == 0) & (na < 0), -2.0, high[f])
            below[f, ~upright & (nt > 0), k] = side[~upright & (nt > 0)]
            above[f, ~upright & (nt < 0), k] = side[~upright & (nt < 0)]
    # Corners where two lines meet within all the others: they bound s and cut it.
    meet = []
    for a in range(8):
        for b in range(a):
            p, q = lines[:, a], lines[:, b]
            corner = np.cross(p, q, axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                s, t = corner[:, 0] / corner[:, 2], corner[:, 1] / corner[:, 2]
                inside = (lines[:, :, 0] * s[:, None] + lines[:, :, 1] * t[:, None] + lines[:, :, 2] > -1e-9).all(1)
            meet.append(np.where(inside, s, np.nan))
    extra = np.stack(meet, -1)
    low = np.maximum(low, np.where(np.isnan(extra), 2.0, extra).min(-1))
    high = np.minimum(high, np.where(np.isnan(extra), -2.0, extra).max(-1))
    extra = extra.reshape(6 * m, -1)
    sums, area = _regions(
        texels.reshape(-1, 3),
        _places(n, np.repeat(np.arange(6), m)),
        low.ravel(),
        high.ravel(),
        below.reshape(6 * m, 4, 5),
        above.reshape(6 * m, 4, 5),
        extra,
    )
    return sums.reshape(6, m, 3).sum(0), area.reshape(6, m).sum(0)


def _frame(face: int) -> tuple[tuple[float, float, float], ...]:
    """World vectors of a face's s, t and axis."""
    basis = [
        _to_face(face, (np.float64(x), np.float64(y), np.float64(z)))  # type: ignore[arg-type]
        for x, y, z in ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    ]
    return tuple((float(basis[0][k]), float(basis[1][k]), float(basis[2][k])) for k in range(3))


def _latlong_from_cube(
    texels: npt.NDArray[np.float32], rotation: float, size: int, flat: Ints
) -> tuple[Floats, Floats]:
    """Each texel and its solid angle, over the source faces.

    On a side face s = -tan ψ, so meridians bound s and a parallel is t = -cot θ √(1 + s²). On ±Y a texel is a
    piece of a ring: cut into octants, with the distance p from the octant's axis as s and the one along it as
    t, it lies between the circles √(ρ² - p²) and the rays t = p cot φ, all analytic.
    """
    n, m = texels.shape[1], len(flat)
    i, j = np.divmod(flat, 2 * size)
    phi0, phi1 = ((k * math.pi / size) - math.pi - rotation for k in (j, j + 1))
    cotangent = np.array([np.inf, *(1 / np.tan(np.arange(1, size) * math.pi / size)), -np.inf])
    if size % 2 == 0:
        cotangent[size // 2] = 0.0
    cot0, cot1 = cotangent[i], cotangent[i + 1]
    pieces = _Pieces(m)
    _on_side_faces(pieces, n, phi0, phi1, cot0, cot1)
    _on_polar_faces(pieces, n, phi0, phi1, cot0, cot1)
    return pieces.integrated(texels)


@dataclass
class _Pieces:
    """Pieces of m texels in the planes of source faces, m at a time, as `_regions` takes them."""

    m: int
    place: list[Ints] = field(default_factory=list)
    low: list[Floats] = field(default_factory=list)
    high: list[Floats] = field(default_factory=list)
    below: list[Floats] = field(default_factory=list)
    above: list[Floats] = field(default_factory=list)
    extra: list[Floats] = field(default_factory=list)

    def add(
        self,
        where: Ints,
        s0: Floats,
        s1: Floats,
        under: list[tuple[Floats, ...]],
        over: list[tuple[Floats, ...]],
        meet: list[Floats],
    ) -> None:
        self.place.append(np.broadcast_to(where, (self.m, 3)))
        self.low.append(s0)
        self.high.append(s1)
        self.below.append(np.stack([np.stack(np.broadcast_arrays(*side), -1) for side in under], 1))
        self.above.append(np.stack([np.stack(np.broadcast_arrays(*side), -1) for side in over], 1))
        self.extra.append(np.stack(meet, 1))

    def integrated(self, texels: npt.NDArray[np.float32]) -> tuple[Floats, Floats]:
        """Return the integral (m, 3) and the solid angle (m,) of each texel, over all of its pieces."""
        # Side faces have one side each way: padded with a copy to two, as on ±Y.
        both = [np.repeat(side, 2, 1) if side.shape[1] == 1 else side for side in self.below]
        over = [np.repeat(side, 2, 1) if side.shape[1] == 1 else side for side in self.above]
        meets = [np.pad(x, ((0, 0), (0, 6 - x.shape[1])), constant_values=np.nan) for x in self.extra]
        sums, area = _regions(
            texels.reshape(-1, 3),
            np.concatenate(self.place),
            np.concatenate(self.low),
            np.concatenate(self.high),
            np.concatenate(both),
            np.concatenate(over),
            np.concatenate(meets),
        )
        return sums.reshape(-1, self.m, 3).sum(0), area.reshape(-1, self.m).sum(0)


def _on_side_faces(pieces: _Pieces, n: int, phi0: Floats, phi1: Floats, cot0: Floats, cot1: Floats) -> None:
    """Add the pieces of lat-long texels on ±X and ±Z: azimuths from phi0 to phi1, cot θ from cot0 down to cot1."""
    quarter = math.pi / 4
    zero, one = np.zeros(pieces.m), np.ones(pieces.m)
    nothing = np.full(pieces.m, np.nan)
    for face, axis in ((0, 0.0), (1, math.pi), (4, math.pi / 2), (5, -math.pi / 2)):
        # A texel spans up to 2π (size 1 is π): it may reach the face from both sides, in separate pieces.
        for turn in range(-2, 3):
            a = np.clip(phi0 - axis + 2 * math.pi * turn, -quarter, quarter)
            b = np.clip(phi1 - axis + 2 * math.pi * turn, -quarter, quarter)
            top, bottom = np.clip(-cot0, -4, 4), np.clip(-cot1, -4, 4)
            pieces.add(
                _places(n, np.array([face]))[0],
                np.where(b == quarter, -1.0, -np.tan(b)),
                np.where(a == -quarter, 1.0, -np.tan(a)),
                [(zero, zero, top, one, one)],
                [(zero, zero, bottom, one, one)],
                [nothing],
            )


def _on_polar_faces(pieces: _Pieces, n: int, phi0: Floats, phi1: Floats, cot0: Floats, cot1: Floats) -> None:
    """Add the pieces of lat-long texels on ±Y, by octants: azimuths from phi0 to phi1, cot θ from cot0 down to cot1."""
    quarter = math.pi / 4
    zero, one = np.zeros(pieces.m), np.ones(pieces.m)
    for south in (False, True):
        near, far = (-cot1, -cot0) if south else (cot0, cot1)  # |cot θ| grows towards the pole
        with np.errstate(divide="ignore"):
            inner, outer = np.where(near > 0, 1 / near, np.inf), np.where(far > 0, 1 / far, 4.0)
        inner, outer = np.minimum(inner, 4.0), np.minimum(outer, 4.0)
        for octant in range(8):
            # Axis along ±x or ±z, azimuth from it growing (towards larger φ) or falling.
            quadrant, mirrored = octant // 2, octant % 2
            centre = quadrant * math.pi / 2
            # The direction of the axis and of growing p as steps in (x, z), then in (s, t) of the face.
            ax, az = ((1, 0), (0, 1), (-1, 0), (0, -1))[quadrant]
            px, pz = ((0, 1), (-1, 0), (0, -1), (1, 0))[quadrant]
            if mirrored:
                px, pz = -px, -pz
            flip = -1 if south else 1  # t = ±z
            step_t, step_s = ax + n * flip * az, px + n * flip * pz
            origin = (3 if south else 2) * n * n
            origin += sum(-k * (n - 1) for k in (step_t, step_s) if k < 0)
            for turn in range(-2, 3):
                a, b = phi0 - centre + 2 * math.pi * turn, phi1 - centre + 2 * math.pi * turn
                a, b = (-b, -a) if mirrored else (a, b)
                a, b = np.clip(a, 0, quarter), np.clip(b, 0, quarter)
                live = (b > a) & (outer > inner)
                ray_a = np.where(a > 0, 1 / np.tan(np.where(a > 0, a, 1)), 1e300)
                ray_b = np.where(b > 0, 1 / np.tan(np.where(b > 0, b, 1)), 1e300)
                ray_b = np.where(b == quarter, 1.0, ray_b)
                top_p = np.where(live, np.minimum(outer * np.sin(b), 1.0), -1.0)
                meet = [rho * np.sin(angle) for rho in (inner, outer) for angle in (a, b)]
                meet += [np.tan(a), np.tan(b)]
                pieces.add(
                    np.array([origin, step_s, step_t]),
                    np.where(live, inner * np.sin(a), 0.0),
                    top_p,
                    [(zero, zero, one, inner**2, -one), (zero, ray_b, zero, one, zero)],
                    [
                        (zero, zero, one, outer**2, -one),
                        (np.where(a > 0, 0.0, 1e300), np.where(a > 0, ray_a, 0.0), zero, one, zero),
                    ],
                    meet,
                )
