"""The outline of an area light as a surface sees it, cut into panels for quadrature.

A piece is P(t) = C + A cos t + B sin t above the horizon. Panels are graded where an integral along them has its short
scales. Float64; `radiance_outline.cl` sums them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

_ENDS = np.geomspace(1e-7, 0.03, 14)
SAMPLES = np.concatenate([[0.0], _ENDS, np.linspace(0.06, 0.94, 17), 1 - _ENDS[::-1], [1.0]])
"""Places in a piece, from 0 to 1, at which the search for the place nearest to n begins: also close to its ends, where
it may meet the horizon."""

GOLDEN = 40
"""Steps of golden section after that: they end at the square root of float64's rounding."""

HORIZON = 1e-3
"""Smallest scale at which a panel is graded where it meets the horizon."""


@dataclass(frozen=True)
class Pieces:
    """Pieces of outlines of area lights.

    Each piece is a curve P(t) = C + A cos t + B sin t: vectors C, A, B (n, 3), the ends of t (n,), and the index of its
    cell. The light lies to the left of a piece as the azimuth grows.
    """

    C: np.ndarray
    A: np.ndarray
    B: np.ndarray
    start: np.ndarray
    end: np.ndarray
    cell: np.ndarray

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return the points at t (..., n): (..., n, 3)."""
        return self.C + self.A * np.cos(t)[..., None] + self.B * np.sin(t)[..., None]


def _joined(pieces: list[Pieces]) -> Pieces:
    return Pieces(
        *(np.concatenate([getattr(p, name) for p in pieces]) for name in ("C", "A", "B", "start", "end", "cell"))
    )


def _kept(pieces: Pieces, keep: np.ndarray) -> Pieces:
    return Pieces(
        pieces.C[keep], pieces.A[keep], pieces.B[keep], pieces.start[keep], pieces.end[keep], pieces.cell[keep]
    )


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-300)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(-1)


def _arcs(a: np.ndarray, b: np.ndarray, cell: np.ndarray, keep: np.ndarray) -> Pieces:
    """Return great circles from the directions a to the directions b: the image of straight edges."""
    a, b = _unit(a), _unit(b)
    normal = np.cross(a, b)
    sine = np.linalg.norm(normal, axis=-1)
    angle = np.arctan2(sine, _dot(a, b))
    arcs = Pieces(np.zeros_like(a), a, np.cross(_unit(normal), a), np.zeros(len(a)), angle, cell)
    return _kept(arcs, keep & (sine > 0))


def _rectangle(center: np.ndarray, u: np.ndarray, v: np.ndarray) -> Pieces:
    """Return the edges of a rectangle, clipped at z = 0, counterclockwise about +z where it faces the origin."""
    size = np.abs(np.stack([center, u, v])).max((0, 2))[:, None]
    center, u, v = center / size, u / size, v / size
    facing = _dot(np.cross(u, v), center) < 0
    corners = [center - u - v, center - u + v, center + u + v, center + u - v]
    cell = np.arange(len(center))
    pieces, setting, rising = [], np.zeros_like(center), np.zeros_like(center)
    sets = np.zeros(len(center), bool)
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        up_a, up_b = a[:, 2] > 0, b[:, 2] > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.where(up_a != up_b, a[:, 2] / (a[:, 2] - b[:, 2]), 0.0)
        cut = a + s[:, None] * (b - a)
        cut[:, 2] = 0
        setting = np.where((up_a & ~up_b)[:, None], cut, setting)
        rising = np.where((~up_a & up_b)[:, None], cut, rising)
        sets |= up_a & ~up_b
        pieces.append(
            _arcs(np.where(up_a[:, None], a, cut), np.where(up_b[:, None], b, cut), cell, facing & (up_a | up_b))
        )
    pieces.append(_arcs(setting, rising, cell, facing & sets))
    return _joined(pieces)


def _disc(center: np.ndarray, normal: np.ndarray, radius: np.ndarray) -> Pieces:
    """Return the circle of a disc, seen from the side to which it shines; the part below the horizon becomes a chord
    on it.
    """
    size = np.maximum(np.abs(center).max(1), radius)
    center, radius, normal = center / size[:, None], radius / size, _unit(normal)
    facing = _dot(normal, center) < 0
    # A climbs steepest in the disc's plane, so that the part above the horizon is |t| < set.
    up = np.array([0.0, 0.0, 1.0]) - normal[:, 2:] * normal
    flat = np.linalg.norm(up, axis=1) < 1e-9
    up[flat] = np.array([1.0, 0.0, 0.0]) - normal[flat, :1] * normal[flat]
    A = _unit(up) * radius[:, None]
    B = np.cross(A, normal)  # clockwise about the normal: counterclockwise as azimuths are
    A[flat, 2] = 0
    B[:, 2] = 0
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.where(A[:, 2] > 0, -center[:, 2] / A[:, 2], np.where(center[:, 2] > 0, -np.inf, np.inf))
    sets = np.arccos(np.clip(level, -1, 1))
    cell = np.arange(len(center))
    circle = Pieces(center, A, B, -sets, sets, cell)
    partly = (sets > 0) & (sets < math.pi)
    a, b = circle.at(sets), circle.at(-sets)
    a[:, 2] = b[:, 2] = 0
    return _joined([_kept(circle, facing & (sets > 0)), _arcs(a, b, cell, facing & partly)])


def outline(light: str, numbers: Mapping[str, np.ndarray]) -> Pieces:
    """Return the pieces of a light's outline above the horizon, for cells of parameters (n,) by name.

    light: "disc" or "rectangle". A cell whose light faces away or is below the horizon has no pieces.
    """

    def vector(name: str) -> np.ndarray:
        return np.stack([numbers[f"{name}_{axis}"] for axis in "xyz"], -1)

    if light == "disc":
        return _disc(vector("center"), vector("normal"), numbers["radius"])
    return _rectangle(vector("center"), vector("u"), vector("v"))


# ---------------------------------------------------------------------------------------------- panels


@dataclass(frozen=True)
class _Slopes:
    """The slopes in which an outline passes n: those of the half vector in widths of the lobe, or of l itself (no
    view).
    """

    view: np.ndarray | None  # (n, 3)
    widths: np.ndarray  # (n, 2)

    def of(self, P: np.ndarray) -> np.ndarray:
        """Return the slopes at points P (..., n, 3): (..., n, 2)."""
        H = _unit(P)
        if self.view is not None:
            H = H + self.view
        return H[..., :2] / np.maximum(H[..., 2:], 1e-12) / self.widths


def _nearest(pieces: Pieces, slopes: _Slopes) -> np.ndarray:
    """Return where each piece passes n nearest, and next nearest if there are two such places: (2, n)."""
    t = pieces.start + (pieces.end - pieces.start) * SAMPLES[:, None]
    apart = _dot(*2 * (slopes.of(pieces.at(t)),))
    around = np.pad(apart, ((1, 1), (0, 0)), constant_values=np.inf)
    low = np.where((apart <= around[:-2]) & (apart <= around[2:]), apart, np.inf)
    first = low.argmin(0)
    np.put_along_axis(low, first[None], np.inf, 0)
    second = np.where(np.isfinite(low.min(0)), low.argmin(0), first)
    place = np.stack([first, second])
    a = np.take_along_axis(t, np.maximum(place - 1, 0), 0)
    b = np.take_along_axis(t, np.minimum(place + 1, len(SAMPLES) - 1), 0)
    ratio = (math.sqrt(5) - 1) / 2
    for _ in range(GOLDEN):
        c, d = b - ratio * (b - a), a + ratio * (b - a)
        left = _dot(*2 * (slopes.of(pieces.at(c)),)) < _dot(*2 * (slopes.of(pieces.at(d)),))
        a, b = np.where(left, a, c), np.where(left, d, b)
    return (a + b) / 2


def _scale(pieces: Pieces, slopes: _Slopes, t: np.ndarray) -> np.ndarray:
    """Return the length in t over which the lobe, or the azimuth of n, changes: max(1, |slope|) over the slope's
    speed.
    """
    h = 1e-6 * np.maximum(pieces.end - pieces.start, 1e-3)
    speed = np.linalg.norm(slopes.of(pieces.at(t + h)) - slopes.of(pieces.at(t - h)), axis=-1) / (2 * h)
    return np.hypot(1, np.linalg.norm(slopes.of(pieces.at(t)), axis=-1)) / np.maximum(speed, 1e-30)


def _crossing(pieces: Pieces, direction: np.ndarray, level: np.ndarray | float = 0.0) -> np.ndarray:
    """Return where direction·P = level, or the start where that never holds: (2, n)."""
    a, b, c = (_dot(direction, x) for x in (pieces.A, pieces.B, pieces.C))
    length = np.hypot(a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        side = np.arccos((level - c) / length)
    t = np.arctan2(b, a) + np.stack([side, -side])
    t = pieces.start + np.mod(t - pieces.start, 2 * math.pi)
    return np.where(np.isfinite(t), t, pieces.start)


def panels(
    pieces: Pieces, NoV: np.ndarray, phi: np.ndarray, widths: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (11, m) of quadrature panels, as `source.OUTLINE` names them, and the cell of each panel, sorted.

    NoV, phi: views of the cells, (n,) each; phi in radians. widths: (n, 2) widths of the lobe along x and y; None for a
    diffuse model, whose kinks lie across the view's azimuth and at its polar angle.
    """
    if not len(pieces.cell):
        return np.empty((11, 0)), np.empty(0, int)
    NoV, phi = np.maximum(NoV, 1e-9)[pieces.cell], phi[pieces.cell]
    sin_v = np.sqrt((1 - NoV) * (1 + NoV))
    across = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], -1)
    ends = np.stack([pieces.start, pieces.end])
    if widths is None:
        slopes = _Slopes(None, np.ones((len(NoV), 2)))
    else:
        view = np.stack([sin_v * np.cos(phi), sin_v * np.sin(phi), NoV], -1)
        slopes = _Slopes(view, widths[pieces.cell])
    near = _nearest(pieces, slopes)
    knots = [*ends, *near]
    scales = [_scale(pieces, slopes, t) for t in knots]
    least = NoV if widths is None else np.minimum(NoV, slopes.widths.min(1))
    horizon = np.clip(least, HORIZON, 1)  # where masking turns
    for k in range(2):
        low = pieces.at(ends[k])[:, 2] < 1e-9
        scales[k] = np.where(low, np.minimum(scales[k], horizon), scales[k])
    # A disc's outline passes the origin itself closely where the disc is near.
    reach = np.arctan2(-_dot(pieces.B, pieces.C), -_dot(pieces.A, pieces.C))
    reach = pieces.start + np.mod(reach - pieces.start, 2 * math.pi)
    speed = np.linalg.norm(pieces.B * np.cos(reach)[:, None] - pieces.A * np.sin(reach)[:, None], axis=-1)
    round_ = np.linalg.norm(pieces.C, axis=-1) > 0
    knots.append(np.where(round_, reach, pieces.start))
    scales.append(np.where(round_, np.linalg.norm(pieces.at(reach), axis=-1) / np.maximum(speed, 1e-30), np.inf))
    if widths is None:
        straight = ~round_
        polar = _crossing(pieces, np.array([0.0, 0.0, 1.0]), NoV)
        for t in (*_crossing(pieces, across), *np.where(straight, polar, pieces.start)):
            knots.append(t)
            scales.append(np.full_like(t, np.inf))
    t, scale = np.stack(knots), np.stack(scales)
    t = np.clip(t, pieces.start, pieces.end)
    order = np.argsort(t, 0, kind="stable")
    t, scale = np.take_along_axis(t, order, 0), np.take_along_axis(scale, order, 0)
    # Knots that fall together become one, with the shortest of their scales; the last must stay where the piece ends.
    together = np.diff(t, axis=0) < 1e-9 * np.maximum(pieces.end - pieces.start, 1e-12)
    for k in range(len(t) - 1):
        scale[k + 1] = np.where(together[k], np.minimum(scale[k], scale[k + 1]), scale[k + 1])
    for k in reversed(range(len(t) - 1)):
        scale[k] = np.where(together[k], np.minimum(scale[k], scale[k + 1]), scale[k])
    for k in range(len(t) - 1):
        t[k + 1] = np.where(together[k], t[k], t[k + 1])
    t[-1] = pieces.end
    gap = np.diff(t, axis=0) / 2
    origin = np.concatenate([t[:-1], t[1:]])
    length = np.concatenate([gap, -gap])
    scale = np.minimum(np.concatenate([scale[:-1], scale[1:]]), 1e6)
    piece = np.broadcast_to(np.arange(len(NoV)), origin.shape)
    keep = length != 0
    piece, origin, length, scale = piece[keep], origin[keep], length[keep], scale[keep]
    order = np.argsort(pieces.cell[piece], kind="stable")
    piece, origin, length, scale = piece[order], origin[order], length[order], scale[order]
    c, s = np.cos(origin)[:, None], np.sin(origin)[:, None]
    A, B = pieces.A[piece], pieces.B[piece]
    rows = np.concatenate([pieces.C[piece], A * c + B * s, B * c - A * s, np.stack([length, scale], 1)], 1)
    return rows.T, pieces.cell[piece]
