"""Places of texels and grid nodes on the sphere, and the tables of quadrature nodes that kernels read.

Everything is float64. `kernels/sphere.clh` has the same geometry for a device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any

import numpy as np

from whitefurnace.catalogue.rule import gauss
from whitefurnace.opencl.constants import BEYOND, ORDER, TAPS
from whitefurnace.sphere.environments import Environment, cube_solid_angles, latlong_solid_angles

# Axis, right and down of each face, +X -X +Y -Y +Z -Z: the direction of (s, t) is axis + s·right + t·down.
AXIS = np.array([[1, -1, 0, 0, 0, 0], [0, 0, 1, -1, 0, 0], [0, 0, 0, 0, 1, -1]], np.float64)
RIGHT = np.array([[0, 0, 1, 1, 1, -1], [0, 0, 0, 0, 0, 0], [-1, 1, 0, 0, 0, 0]], np.float64)
DOWN = np.array([[0, 0, 0, 0, 0, 0], [-1, -1, 0, 0, -1, -1], [0, 0, 1, -1, 0, 0]], np.float64)


def cube_directions(face: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the unit directions (3, m) of face coordinates, in the GL-direct layout.

    face: (m,) indices in the order +X -X +Y -Y +Z -Z. s, t: (m,) in [-1, 1], to the right and down.
    """
    d = AXIS[:, face] + s * RIGHT[:, face] + t * DOWN[:, face]
    return d / np.sqrt(1 + s * s + t * t)


@dataclass(frozen=True)
class Shape:
    """The points of a level: the texel centres of a cube, a lat-long or an octahedral map, or the nodes of a grid.

    latlong, octahedral  the form; a cube where neither is True
    size                 texels of a face edge, or rows of a lat-long
    nodes                True if the points are the nodes of an equiangular grid
    """

    latlong: bool
    size: int  # face edge, or height of the lat-long
    nodes: bool = False
    octahedral: bool = field(default=False, repr=False)  # one square of an octahedral map (octahedral_map.py)

    @property
    def dims(self) -> tuple[int, ...]:
        """The shape of an array of the points: (rows, columns), or (6, rows, columns) for faces."""
        if self.octahedral:
            return self.size, self.size
        return (self.size, 2 * self.size) if self.latlong else (6, self.size, self.size)

    @property
    def count(self) -> int:
        """Number of points."""
        return int(np.prod(self.dims))

    def coordinates(self) -> np.ndarray:
        """Return the face coordinates, (size,), of a cube's texel centres or of a grid's nodes."""
        return grid_tangents(self.size) if self.nodes else (2 * np.arange(self.size) + 1) / self.size - 1

    def directions(self, index: np.ndarray | None = None) -> np.ndarray:
        """Return the unit directions (3, m) of all points, or of those with the flat indices given."""
        index = np.arange(self.count) if index is None else index
        if self.octahedral:
            return to_direction(*((2 * x + 1) / self.size - 1 for x in (index % self.size, index // self.size)))
        if self.latlong:
            return latlong_centres(self.size, 2 * self.size, index)
        return cube_centres(self.size, index)

    def solid_angles(self, index: np.ndarray | None = None) -> np.ndarray:
        """Return the solid angles (m,) of all texels, or of those with the flat indices given, in steradians.

        For an octahedral map they are exact to second order in 1/size.
        """
        if self.octahedral:
            return (2 / self.size) ** 2 * octahedral_density(self.directions(index))
        if self.latlong:
            omega = latlong_solid_angles(self.size, 2 * self.size)
            return np.repeat(omega, 2 * self.size) if index is None else omega[index // (2 * self.size)]
        omega = cube_solid_angles(self.size).ravel()
        return np.tile(omega, 6) if index is None else omega[index % self.size**2]

    def mean(self, texels: np.ndarray) -> float:
        """Return the mean of (dims, 3) texels over the sphere, all channels together."""
        if self.octahedral:
            return float(np.average(texels.reshape(-1, 3).mean(1, dtype=np.float64), weights=self.solid_angles()))
        if self.latlong:
            weights = latlong_solid_angles(self.size, 2 * self.size)
            return float(weights @ texels.sum((1, 2), dtype=np.float64)) / (12 * math.pi)
        weights = cube_solid_angles(self.size)
        # Channel by channel: a sum over a last axis of three takes NumPy ten times as long.
        grey = (face[..., 0].astype(np.float64) + face[..., 1] + face[..., 2] for face in texels)
        return sum(float(np.einsum("ij,ij->", weights, plane)) for plane in grey) / (12 * math.pi)

    def tiled(self) -> np.ndarray:
        """Return all flat indices, ordered so that neighbours stay together: tiles of 4 × 4 within tiles of 8 × 8."""
        index = np.arange(self.count, dtype=np.int32).reshape(-1, *self.dims[-2:])
        planes, height, width = index.shape
        if height % 8 or width % 8:
            return index.ravel()
        return index.reshape(planes, height // 8, 2, 4, width // 8, 2, 4).transpose(0, 1, 4, 2, 5, 3, 6).ravel()


def cube_centres(size: int, index: np.ndarray) -> np.ndarray:
    """Return the directions (3, m) of the texel centres of a cube with faces of size², by flat index."""
    face, i, j = index // size**2, index // size % size, index % size
    return cube_directions(face, (2 * j + 1) / size - 1, (2 * i + 1) / size - 1)


def latlong_centres(rows: int, columns: int, index: np.ndarray) -> np.ndarray:
    """Return the directions (3, m) of the texel centres of a lat-long image, by flat index."""
    theta = (index // columns + 0.5) * math.pi / rows
    phi = (index % columns + 0.5) * 2 * math.pi / columns - math.pi
    return np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)])


def turned_cube(texels: np.ndarray, matrix: Any) -> np.ndarray:
    """Return a cube (6, s, s, …) in the axes of an engine that reads the world's direction d at `matrix` @ d.

    matrix: a signed permutation (3, 3). Whole texels change places and none is resampled.
    """
    world = np.asarray(matrix).T
    if (world == np.eye(3)).all():
        return texels
    faces = []
    for face in range(6):
        axis, right, down = (world @ part[:, face] for part in (AXIS, RIGHT, DOWN))
        there = int(np.argmax(axis @ AXIS))
        image = texels[there]
        if abs(right @ DOWN[:, there]) > 0.5:  # its columns are the other's rows
            image = image.swapaxes(0, 1)
            columns, rows = right @ DOWN[:, there], down @ RIGHT[:, there]
        else:
            columns, rows = right @ RIGHT[:, there], down @ DOWN[:, there]
        faces.append(image[:: int(rows), :: int(columns)])
    return np.ascontiguousarray(np.stack(faces))


def to_square(d: np.ndarray) -> np.ndarray:
    """Return the coordinates u, v in [-1, 1], (2, m), of directions (3, m) on the square of an octahedral map.

    The directions may have any length. d over |x| + |y| + |z| lies on an octahedron, whose lower half is folded out.
    [Praun2003]
    """
    x, y, z = d / np.abs(d).sum(0)
    folded = y < 0
    u = np.where(folded, (1 - np.abs(z)) * _sign(x), x)
    v = np.where(folded, (1 - np.abs(x)) * _sign(z), z)
    return np.stack([u, v])


def to_direction(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the unit directions (3, m) of coordinates u, v in [-1, 1], (m,) each, on the square of an octahedral
    map.
    """
    y = 1 - np.abs(u) - np.abs(v)
    folded = y < 0
    x = np.where(folded, (1 - np.abs(v)) * _sign(u), u)
    z = np.where(folded, (1 - np.abs(u)) * _sign(v), v)
    d = np.stack([x, y, z])
    return d / np.sqrt((d * d).sum(0))


def octahedral_density(d: np.ndarray) -> np.ndarray:
    """Return dω/du dv of an octahedral map at directions (3, m): (m,), in steradians.

    It is 1/|p|³ with p = d/(|x| + |y| + |z|) on the octahedron. Its faces are inclined to the square and to the centre
    by the same factor 1/√3.
    """
    return np.abs(d).sum(0) ** 3


def _sign(x: np.ndarray) -> np.ndarray:
    """Return the sign of values, 1 at 0: an edge of the fold belongs to both of its sides."""
    return np.where(x < 0, -1.0, 1.0)


def face_coordinates(d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the face and its coordinates (s, t) in [-1, 1] of directions (3, m): the inverse of `cube_directions`."""
    axis = np.abs(d).argmax(0)
    face = 2 * axis + (np.take_along_axis(d, axis[None], 0)[0] < 0)
    along = (AXIS[:, face] * d).sum(0)
    return face, (RIGHT[:, face] * d).sum(0) / along, (DOWN[:, face] * d).sum(0) / along


def radiance_at(env: Environment, d: np.ndarray) -> np.ndarray:
    """Return the radiance of an environment in directions d (3, m), with its rotation: (m, 3) float64."""
    c, s = math.cos(env.rotation), math.sin(env.rotation)
    x, y, z = c * d[0] + s * d[2], d[1], c * d[2] - s * d[0]
    rows, columns = env.texels.shape[-3:-1]
    if env.kind == "latlong":
        row = np.arccos(np.clip(y, -1, 1)) / math.pi * rows
        column = (np.arctan2(z, x) / (2 * math.pi) + 0.5) * columns
        at = np.minimum(row.astype(int), rows - 1) * columns + np.minimum(column.astype(int), columns - 1)
    else:
        face, a, b = face_coordinates(np.stack([x, y, z]))
        column, row = (np.clip(((u + 1) / 2 * rows).astype(int), 0, rows - 1) for u in (a, b))
        at = (face * rows + row) * rows + column
    return env.texels.reshape(-1, 3)[at].astype(np.float64)


POINTS = ((610, 377), (10946, 6765))
"""Numbers of points of a texel and of its reference: Fibonacci lattices, whose error where an edge of light crosses the
texel falls as N^-¾ for every position of the edge."""


def octahedral_means(env: Environment, shape: Shape, index: np.ndarray, lattice: tuple[int, int]) -> np.ndarray:
    """Return the mean radiance over texels of an octahedral map, by flat index: (m, 3) float64.

    lattice: points in each texel and the step of the Fibonacci lattice, one of POINTS.
    """
    count, step = lattice
    a, b = ((2 * np.arange(count) + 1) / count - 1, 2 * ((np.arange(count) * step % count + 0.5) / count) - 1)
    out = np.empty((len(index), 3))
    step = max(1, (1 << 20) // count)
    for first in range(0, len(index), step):
        part = index[first : first + step]
        u = ((2 * (part % shape.size) + 1)[:, None] + a) / shape.size - 1
        v = ((2 * (part // shape.size) + 1)[:, None] + b) / shape.size - 1
        d = to_direction(u.ravel(), v.ravel())
        weight = octahedral_density(d).reshape(u.shape)
        lit = radiance_at(env, d).reshape(*u.shape, 3)
        out[first : first + step] = np.einsum("mk,mkc->mc", weight, lit) / weight.sum(1)[:, None]
    return out


def source_directions(env: Environment, index: np.ndarray) -> np.ndarray:
    """Return the world directions (3, m) of an environment's texel centres, by flat index, with its rotation."""
    rows, columns = env.texels.shape[-3:-1]
    d = latlong_centres(rows, columns, index) if env.kind == "latlong" else cube_centres(rows, index)
    c, s = math.cos(env.rotation), math.sin(env.rotation)
    return np.stack([c * d[0] - s * d[2], d[1], s * d[0] + c * d[2]])


def source_solid_angles(env: Environment) -> np.ndarray:
    """Return the solid angle of every texel of an environment, in steradians: the shape of its texels without
    channels.
    """
    shape = env.texels.shape[:-1]
    angles = latlong_solid_angles(*shape)[:, None] if len(shape) == 2 else cube_solid_angles(shape[1])
    return np.broadcast_to(angles, shape)


def grid_tangents(n: int) -> np.ndarray:
    """Return the face coordinates of the nodes of an n × n equiangular grid, with BEYOND more nodes past each edge."""
    return np.tan((2 * np.arange(n) + 1 - n) / (n - 2 * BEYOND) * math.pi / 4)


def bounds(directions: np.ndarray, count: int) -> np.ndarray:
    """Return the centre of each `count` consecutive directions (3, m·count) and the largest chord to it: (m, 4)."""
    d = directions.reshape(3, -1, count)
    centre = d.mean(2)
    radius = np.sqrt(((d - centre[..., None]) ** 2).sum(0).max(1))
    return np.concatenate([centre, radius[None] * (1 + 1e-6) + 1e-6]).T.copy()


def composite(cuts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights on [0, 1] of a composite rule: cuts/2 cells of two Gauss points each.

    cuts: number of nodes, even.
    """
    cells = cuts // 2
    x, w = gauss(2)
    nodes = (np.arange(cells)[:, None] + x) / cells
    return nodes.ravel(), np.tile(w / cells, cells)


def latlong_tables(
    rows: int, columns: int, x: np.ndarray, w: np.ndarray, rotation: float, scale: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the quadrature tables of a lat-long image, by refined row and by refined column.

    rows, columns: size of the image. x, w: nodes and weights on [0, 1] within a texel. rotation: radians. scale:
    (rows,) of `corrections`; with it the weights are sin θ Δθ scale.

    The first table has (cos θ, sin θ, weight), where each row's weights sum to cos θ0 - cos θ1; the second (cos φ, sin
    φ, weight).
    """
    theta = (np.arange(rows)[:, None] + x) * (math.pi / rows)
    weight = np.sin(theta) * w
    if scale is None:
        weight *= (-np.diff(np.cos(np.arange(rows + 1) * math.pi / rows)) / weight.sum(1))[:, None]
    else:
        weight *= scale[:, None] * math.pi / rows
    phi = (np.arange(columns)[:, None] + x) * (2 * math.pi / columns) - math.pi + rotation
    across = np.broadcast_to(w * (2 * math.pi / columns), phi.shape)
    return (
        np.stack([np.cos(theta), np.sin(theta), weight], -1).reshape(-1, 3),
        np.stack([np.cos(phi), np.sin(phi), across], -1).reshape(-1, 3),
    )


def cube_tables(
    size: int, x: np.ndarray, w: np.ndarray, scale: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the quadrature tables of a cube's face, by refined row and by refined column.

    size: texels of an edge. x, w: nodes and weights on [0, 1] within a texel. scale: (size,) of `corrections`, which
    replaces the factors below.

    Both tables have (coordinate, weight, 0). The second is flat and followed by factors (size, size) that bring each
    texel's nodes to its exact solid angle. Where there are so many nodes that they reach it to 1e-9, the factors are 1.
    """
    s = ((np.arange(size)[:, None] + x) * (2 / size) - 1).ravel()
    weight = np.tile(w * (2 / size), size)
    correction = np.ones((size, size))
    if scale is not None:
        weight *= scale
    elif len(s) <= 1024:
        density = weight[:, None] * weight * (1 + s[:, None] ** 2 + s**2) ** -1.5
        correction = cube_solid_angles(size) / density.reshape(size, len(x), size, len(x)).sum((1, 3))
    table = np.stack([s, weight, np.zeros_like(s)], 1)
    return table, np.concatenate([table.ravel(), correction.ravel()])


# Mean over |x| ≤ ½ of the quartic through f(-2) … f(2), by moments: 2 c1 + 8 c2 = 1/12, 2 c1 + 32 c2 = 1/80.
CENTRED = (863 / 960, 77 / 1440, -17 / 5760)


@dataclass(frozen=True)
class Correction:
    """The filter that makes point masses of texels, as `correct_rows` and `correct_columns` read it.

    row_tap, column_tap: (count, TAPS) int32, the inputs of each output row and column.
    row_factor, column_factor: (count, TAPS) float32, their factors.
    inner: the factors of a column far from the sides of the image.
    scales: (rows,) and (columns,), the filter's result for an image of ones. Factors are divided by it, and the weights
    of nodes are multiplied by it.
    """

    row_tap: np.ndarray
    row_factor: np.ndarray
    column_tap: np.ndarray
    column_factor: np.ndarray
    inner: tuple[float, ...]
    scales: tuple[np.ndarray, np.ndarray]


@lru_cache(maxsize=16)
def corrections(latlong: bool, rows: int, columns: int) -> Correction:
    """Return the correction of a lat-long or a cube face of rows × columns texels, at least 16 each."""
    c = np.array([*CENTRED[:0:-1], *CENTRED])
    if latlong:
        row: list[dict[int, float]] = [{} for _ in range(rows)]
        for i in range(rows):
            for d in range(-2, 3):
                k = i + d
                # sin θ f(θ) is odd through a pole, where a meridian goes on as the opposite one.
                over = k < 0 or k >= rows
                to = -1 - k if k < 0 else 2 * rows - 1 - k if k >= rows else k
                row[to][~i if over else i] = row[to].get(~i if over else i, 0.0) + (-c[d + 2] if over else c[d + 2])
        column = [{(j + d) % columns: c[d + 2] for d in range(-2, 3)} for j in range(columns)]
    else:
        row = [{} for _ in range(rows)]
        for i in range(rows):
            start = min(max(i - 2, 0), rows - 5)
            for k, value in zip(range(start, start + 5), _mean_weights(i - start), strict=True):
                row[k][i] = float(value)
        column = row
    row_tap, row_factor, row_scale = _taps(row)
    column_tap, column_factor, column_scale = _taps(column)
    return Correction(row_tap, row_factor, column_tap, column_factor, CENTRED, (row_scale, column_scale))


def _mean_weights(at: int) -> np.ndarray:
    """Return the weights (5,) of the mean over the texel `at` of the quartic through the centres of texels 0 … 4."""
    powers = np.arange(5)
    moments = ((at + 0.5) ** (powers + 1) - (at - 0.5) ** (powers + 1)) / (powers + 1)
    return np.linalg.solve(np.arange(5.0)[None] ** powers[:, None], moments)


def _taps(found: list[dict[int, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    scale = np.array([sum(taps.values()) for taps in found])
    tap, factor = np.zeros((len(found), TAPS), np.int32), np.zeros((len(found), TAPS), np.float32)
    for k, taps in enumerate(found):
        tap[k, : len(taps)] = list(taps)
        factor[k, : len(taps)] = np.array(list(taps.values())) / scale[k]
    return tap, factor, scale


def row_edges(rows: int, real: Any) -> np.ndarray:
    """Return (cos θ, cot θ) of the rows + 1 edges of a lat-long's rows, (rows + 1, 2).

    real: the type of the result. The cotangents of the poles are ±1e30, which serve as bounds only.
    """
    theta = np.arange(rows + 1) * math.pi / rows
    cosine, sine = np.cos(theta), np.sin(theta)
    if rows % 2 == 0:
        cosine[rows // 2] = 0.0
    sine[[0, -1]] = 1e-30
    return np.stack([cosine, cosine / sine], 1).astype(real)


@cache
def coarsening(fine: int, coarse: int, kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the matrix (fine, coarse) that interpolates between equiangular nodes, and the fine nodes it uses.

    fine, coarse: numbers of nodes. kind: "f" or "d", the type of the matrix. The second and third value, (coarse,)
    int32 each, are the range [first, last) of fine nodes that each coarse node contributes to.
    """
    order = min(ORDER, coarse)
    ratio = (coarse - 2 * BEYOND) / (fine - 2 * BEYOND)
    x = (2 * np.arange(fine) + 1 - fine) / 2 * ratio + (coarse - 1) / 2  # in coarse node numbers
    start = np.clip(np.floor(x).astype(int) - (order // 2 - 1), 0, coarse - order)
    matrix = np.zeros((fine, coarse))
    for a in range(order):
        weight = np.ones(fine)
        for b in range(order):
            if b != a:
                weight *= (x - (start + b)) / (a - b)
        matrix[np.arange(fine), start + a] = weight
    touched = (np.arange(coarse) >= start[:, None]) & (np.arange(coarse) < start[:, None] + order)
    first = touched.argmax(0)
    last = fine - touched[::-1].argmax(0)
    return matrix.astype(kind), first.astype(np.int32), last.astype(np.int32)
