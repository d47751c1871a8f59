"""Finds the texels of a level that are nearest to given directions; certificates check them besides a uniform draw."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from whitefurnace.sphere.grids import Shape, bounds

TEXELS = 64
"""Number of texels that share one bound: a tile of 8 × 8."""

CORNERS = [0, 19, 44, 63]
"""Indices of the corners of a tile, in the order of `Shape.tiled`."""

PART = 1 << 18
"""Number of texels whose directions are in memory together."""


def nearest_texels(shape: Shape, targets: np.ndarray, count: int) -> np.ndarray:
    """Return the flat indices, ascending, of the `count` texels of `shape` nearest to any of the targets.

    targets: unit directions, (m, 3).
    """
    order, centres, radii = _tiles(shape)
    # |c - t|² of the nearest target; rounding, 1e-8 of a chord, is less than `bounds` adds to a radius.
    chord = np.sqrt(np.maximum((centres**2).sum(1) + 1 - 2 * (centres @ targets.T).max(1), 0))
    # The texels of these tiles are enough, and so nothing beyond the farthest of theirs is among the nearest.
    farthest = np.sort(chord + radii, kind="stable")[min(-(-count // TEXELS) + 1, len(chord)) - 1]
    tiles = np.flatnonzero(chord - radii <= farthest)
    index = np.unique(order[tiles])
    closeness = (targets @ shape.directions(index)).max(0)
    return np.sort(index[np.argsort(-closeness, kind="stable")[:count]])


@lru_cache(maxsize=16)
def _tiles(shape: Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return texels in tiles (n, TEXELS), the centre of each tile (n, 3) and the largest chord to it (n,).

    The last tile is filled up with its last texel.
    """
    order = shape.tiled()
    order = np.pad(order, (0, -len(order) % TEXELS), mode="edge").reshape(-1, TEXELS)
    # c·d has no minimum inside a tile around c, along rows or columns, while it is positive: its corners decide.
    small = not any(n % 8 for n in shape.dims[-2:]) and (not shape.latlong or shape.size >= 32)
    seen = order[:, CORNERS] if small else order
    part = PART // TEXELS
    found = np.concatenate(
        [
            bounds(shape.directions(seen[first : first + part].ravel()), seen.shape[1])
            for first in range(0, len(seen), part)
        ]
    )
    return order, found[:, :3], found[:, 3]
