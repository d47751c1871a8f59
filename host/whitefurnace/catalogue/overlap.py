"""The mean of a piecewise-constant source over output texels' solid angle: the float64 truth of level 0.

`kernels/overlap.cl` finds the areas of overlap by Green's theorem and by clipping polygons; here they are
iterated integrals. A lat-long source is integrated over azimuth by Gauss nodes and along the meridian exactly;
a cube source over a face coordinate s by Gauss nodes and along t exactly. Between the breakpoints (source
columns, corners, places where a side of the texel crosses a row) the integrand is analytic and the rows that
a side lies in are fixed, so a texel is left with rounding only.
"""
from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from whitefurnace.catalogue.rule import gauss

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

BATCH = 64
"""Output texels worked on together: what NumPy needs to be busy, and little memory."""

TALL = 24
"""Source rows in a texel from which on prefix sums of its own columns pay."""

BLOCK = 1 << 18
"""Source texels of one such prefix sum: 6 MiB."""


def mean_over_texels(texels: npt.NDArray[np.float32], rotation: float, latlong_output: bool, size: int,
                     indices: npt.NDArray[np.integer]) -> Floats:
    """(m, 3) float64: the mean radiance of a source over each output texel, by exact solid angles.

    texels: radiance, (h, w, 3) a lat-long or (6, n, n, 3) a cube in the GL-direct layout, constant over each
        texel. rotation: radians that the azimuth atan2(z, x) of the source grows by.
    latlong_output, size: texels of a lat-long (size, 2 size) or else of a cube (6, size, size).
    indices: (m,) flat indices of output texels.

    Error: about 1e-12 of the largest radiance that touches the texel (`tests/test_overlap.py`).
    """
    flat = np.asarray(indices, np.int64)
    out = np.empty((len(flat), 3))
    if texels.ndim == 3 and latlong_output:
        return _latlong_from_latlong(texels, rotation, size, flat)
    for first in range(0, len(flat), BATCH):
        part = flat[first:first + BATCH]
        if texels.ndim == 3:
            sums, area = _cube_from_latlong(texels, rotation, size, part)
        elif latlong_output:
            sums, area = _latlong_from_cube(texels, rotation, size, part)
        else:
            sums, area = _cube_from_cube(texels, rotation, size, part)
        out[first:first + BATCH] = sums / area[:, None]
    return out


# ---------------------------------------------------------------------------------------------- ragged helpers


def _ranges(first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """(owner, value) of the concatenated ranges first[k] … last[k] - 1; empty ones leave nothing."""
    count = np.maximum(last - first, 0)
    owner = np.repeat(np.arange(len(count)), count)
    value = np.arange(len(owner)) + np.repeat(first - (np.cumsum(count) - count), count)
    return owner, value


def _intervals(owners: list[Ints], points: list[Floats], low: Floats, high: Floats) -> tuple[Ints, Floats, Floats]:
    """(owner, from, to) of the pieces that the breakpoints within [low, high] cut each owner's range into."""
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
    """(count, 3) sums of values (n, 3) by owner."""
    return np.stack([np.bincount(owner, values[:, k], count) for k in range(3)], 1)


# ---------------------------------------------------------------------------------------------- lat-long source


def _latlong_from_latlong(texels: npt.NDArray[np.float32], rotation: float, size: int, flat: Ints) -> Floats:
    """Rectangles in (φ, cos θ): the product of overlaps in θ and in φ."""
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
        block = texels[r[0]:r[-1] + 1].take(c % columns, axis=1).astype(np.float64)
        out[k] = np.einsum("r,c,rck->k", down, across, block, optimize=True) / (down.sum() * across.sum())
    return out


def _versine(tau: Floats) -> Floats:
    """1 - cos θ of cot θ = tau, without the cancellation of the difference near θ = 0; tau ≥ -1, or inf."""
    with np.errstate(invalid="ignore"):
        root = np.sqrt(1 + tau * tau)
        value = 1 / (root * (root + tau))
    return np.where(tau < np.inf, value, 0.0)


def _cube_from_latlong(texels: npt.NDArray[np.float32], rotation: float, size: int,
                       flat: Ints) -> tuple[Floats, Floats]:
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
        enter = np.where(hits[enter_x, n] > hits[enter_z, n], enter_x, enter_z)
        leave = np.where(hits[1 - enter_x, n] < hits[5 - enter_z, n], 1 - enter_x, 5 - enter_z)
        pole = on & ~(hits[enter, n] > 0)
        inverse_in, inverse_out = 1 / lines[enter, n], 1 / lines[leave, n]
    inverse_in = np.where(pole, 0.0, inverse_in)
    p_up = np.where(on, np.where(enter < 2, inverse_in, 0.0), -t0[own])
    q_up = np.where(on & (enter >= 2), inverse_in, 0.0)
    p_down = np.where(on, np.where(leave < 2, inverse_out, 0.0), -t1[own])
    q_down = np.where(on & (leave >= 2), inverse_out, 0.0)

    def row_of(tau: Floats) -> Ints:
        return np.clip(np.floor(np.arctan2(1, tau) * (rows / math.pi)).astype(np.int64), 0, rows - 1)

    r_up = np.where(pole, 0, row_of(p_up * cosine + q_up * sine))
    r_down = np.maximum(row_of(p_down * cosine + q_down * sine), r_up)
    column = np.floor(middle * per + zero[own]).astype(np.int64) % columns

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

    sums = _sum_by(own, first_weight[:, None] * radiance(r_up, column, flip)
                   + last_weight[:, None] * radiance(r_down, column, flip), m)
    area = np.bincount(own, width * (v_down - v_up), m)

    # Rows wholly between the two sides.
    tall = (r_last - r_first > TALL)[own]
    short = np.flatnonzero(~tall)
    n, r = _ranges(r_up[short] + 1, r_down[short])
    n = short[n]
    sums += _sum_by(own[n], (width[n] * step[r])[:, None] * radiance(r, column[n], flip[n]), m)
    for k in np.flatnonzero(r_last - r_first > TALL):
        here = np.flatnonzero(own == k)
        top, bottom = int(r_up[here].min()), int(r_down[here].max()) + 1
        sums[k] += _between(texels[::-1] if south[k] else texels, top, bottom, step, column[here], width[here],
                            r_up[here] + 1 - top, r_down[here] - top)
    return sums, area


def _between(texels: npt.NDArray[np.float32], top: int, bottom: int, step: Floats, column: Ints, width: Floats,
             first: Ints, last: Ints) -> Floats:
    """(3,): ∑ width · ∑ over rows top + first … top + last - 1 of step · L, by prefix sums of the columns used."""
    total = np.zeros(3)
    used, which = np.unique(column, return_inverse=True)
    last = np.maximum(first, last)
    per = max(BLOCK // (bottom - top), 1)
    for begin in range(0, len(used), per):
        block = texels[top:bottom].take(used[begin:begin + per], axis=1)
        prefix = np.zeros((bottom - top + 1, *block.shape[1:]))
        np.cumsum(block * step[top:bottom, None, None], axis=0, out=prefix[1:])
        here = (which >= begin) & (which < begin + per)
        c = which[here] - begin
        total += width[here] @ (prefix[last[here], c] - prefix[first[here], c])
    return total
