"""Octahedral maps: the full sphere on one square, borders for seamless bilinear reads, and chains of maps in an atlas.

d, divided by |x| + |y| + |z|, lies on an octahedron; its upper half (y ≥ 0) seen from above is the inner diamond, u ↔
x, v ↔ z, and the lower half is folded out over the diamond's edges [Praun2003; Cigolle2014, section 2]. u goes right
and v down, both in [-1, 1]: +Y is the centre, −Y all four corners, +X the middle of the right edge and +Z that of the
lower one. Texel (i, j) of n x n has its centre at u = (2j + 1)/n − 1, v = (2i + 1)/n − 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from whitefurnace.sphere.grids import Shape, to_square


def texel_directions(size: int) -> np.ndarray:
    """Return the unit directions (3, size²) of the texel centres, row by row."""
    return Shape(False, size, octahedral=True).directions()


def add_border(image: np.ndarray, b: int) -> np.ndarray:
    """Return `image` (n, n, c) with a border of b ≤ n texels around it, (n + 2b, n + 2b, c).

    A border texel has the value of the texel that lies there on the sphere. Each edge is folded onto itself at its
    middle, since (−1, v) and (−1, −v) are one direction. So the k-th texel beyond an edge equals the k-th texel within
    it, in reverse order along the edge. A corner of the border equals the opposite corner of the image.
    """
    n = image.shape[0]
    if image.ndim != 3 or image.shape[1] != n or not 0 <= b <= n:
        raise ValueError(f"a border of {b} does not go around an image of shape {image.shape}")
    wide = np.concatenate([image[::-1, :b][:, ::-1], image, image[::-1, n - b :][:, ::-1]], axis=1)
    return np.concatenate([wide[:b][::-1, ::-1], wide, wide[n - b :][::-1, ::-1]], axis=0)


def strip_border(image: np.ndarray, b: int) -> np.ndarray:
    """Return an image without its border of b texels: the inverse of `add_border`."""
    return image[b : image.shape[0] - b, b : image.shape[1] - b]


def read_bilinear(image: np.ndarray, d: np.ndarray, b: int = 1) -> np.ndarray:
    """Return values (m, c) of a map with a border of b ≥ 1 texels, read in directions (3, m) as a GPU does.

    For a smooth function the error is of second order in 1/n, except within a texel of the octahedron's edges, whose
    creases make it of first order there.
    """
    side = image.shape[0]
    if b < 1 or image.shape[1] != side or side <= 2 * b:
        raise ValueError(f"an image of shape {image.shape} has no border of {b} to read bilinearly")
    u, v = to_square(d)
    x, y = (u + 1) / 2 * (side - 2 * b) - 0.5 + b, (v + 1) / 2 * (side - 2 * b) - 0.5 + b
    return _bilinear(image[None], np.zeros(x.shape, int), x, y)


@dataclass(frozen=True)
class Place:
    """The place of a level in an atlas: the first row and column of its texels, inside its border, and its side."""

    row: int
    column: int
    side: int


def atlas_places(size: int, levels: int, b: int) -> tuple[Place, ...]:
    """Return the places of the levels in an atlas: level 0 at the left, the others below each other at its right.

    size: texels on a side of level 0. levels: their number. b: texels of border around each.
    """
    if levels < 1 or size >> (levels - 1) < max(b, 1):
        raise ValueError(f"{levels} levels from {size} texels do not keep at least the {max(b, 1)} of a border")
    places = [Place(b, b, size)]
    row = b
    for k in range(1, levels):
        places.append(Place(row, size + 3 * b, size >> k))
        row += (size >> k) + 2 * b
    return tuple(places)


def to_atlas(levels: Sequence[np.ndarray], b: int) -> tuple[np.ndarray, tuple[Place, ...]]:
    """Return one image (height, width, c) with all maps (n >> k, n >> k, c) and their borders, and their places in it.

    Texels that belong to no map are 0.
    """
    places = atlas_places(levels[0].shape[0], len(levels), b)
    height, width = (
        max(side + b for side in sides)
        for sides in zip(*((p.row + p.side, p.column + p.side) for p in places), strict=True)
    )
    image = np.zeros((height, width, levels[0].shape[2]), levels[0].dtype)
    for level, p in zip(levels, places, strict=True):
        if level.shape[0] != p.side:
            raise ValueError(f"a level of shape {level.shape} is not of {p.side} texels a side")
        image[p.row - b : p.row + p.side + b, p.column - b : p.column + p.side + b] = add_border(level, b)
    return image, places


def from_atlas(image: np.ndarray, places: Sequence[Place], b: int) -> tuple[np.ndarray, ...]:
    """Return the maps of an atlas, each with its border of b texels."""
    return tuple(image[p.row - b : p.row + p.side + b, p.column - b : p.column + p.side + b] for p in places)


def _bilinear(images: np.ndarray, k: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Read images (count, h, w, c) bilinearly at the image k, column x and row y: (m, c)."""
    height, width = images.shape[1:3]
    j = np.clip(np.floor(x).astype(int), 0, width - 1)
    i = np.clip(np.floor(y).astype(int), 0, height - 1)
    right, below = np.minimum(j + 1, width - 1), np.minimum(i + 1, height - 1)
    a, e = (x - j)[:, None], (y - i)[:, None]
    return (images[k, i, j] * (1 - a) + images[k, i, right] * a) * (1 - e) + (
        images[k, below, j] * (1 - a) + images[k, below, right] * a
    ) * e
