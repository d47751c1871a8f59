"""Computes the mean of a source over each texel of a cube or a lat-long (level 0) by exact areas of overlap.

Data that depend on the two grids alone are made once and kept for every image of the same size.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from whitefurnace.opencl import source
from whitefurnace.opencl.device import Buffer, Device, Program
from whitefurnace.sphere.grids import Shape, row_edges
from whitefurnace.sphere.overlap import mean_over_texels

OVERLAPS = 1 << 22
"""Largest number of overlaps of a lat-long source's texels with a cube's in memory: 64 MiB. Lists up to this length are
kept from image to image; longer ones are made again, part by part."""

LISTS = 4
"""Number of pairs of grids whose lists are kept."""

PIECES = 1024
"""Largest face edge, in texels of the larger of two cubes, up to which the pieces of one on the other are kept: at most
32 MiB."""

TILE = 1 << 15
"""Output texels in one launch of a cube source's general case, which takes up to a second."""


@dataclass(frozen=True)
class _Batch:
    """Generators first … first + count - 1 of `overlap.cl`, with their lists if these are kept."""

    first: int
    count: int
    start: Buffer
    lists: tuple[Buffer, Buffer] | None


class Means:
    """Computes means of one source over texels.

    texels: float32, (h, w, 3) for a lat-long or (6, n, n, 3) for a cube in the GL-direct layout. rotation: radians that
    are added to the azimuth atan2(z, x) of the source. radiance: the same texels on the device, if they are there
    already. Neither may change while this object exists.

    Areas are exact to 1e-11 of a texel's area, sums are float64, and the level is rounded to float32 once (half an
    ulp). Weights add up to 1, so that a constant image gives exactly that constant. A cube source that is rotated, or
    that is read as a lat-long, is clipped by polygons of great circles: its error is 1e-5 next to a sun of 1e6, and
    1e-4 at the poles of a small lat-long.
    """

    def __init__(self, device: Device, texels: np.ndarray, rotation: float, radiance: Buffer | None = None) -> None:
        self.device = device
        self.texels = texels
        self.rotation = rotation
        self.latlong = texels.ndim == 3
        self.rows, self.columns = texels.shape[-3:-1]
        self._radiance = radiance

    @property
    def radiance(self) -> Buffer:
        """The texels on the device."""
        if self._radiance is None:
            self._radiance = self.device.array(self.texels)
        return self._radiance

    def level(self, shape: Shape) -> np.ndarray:
        """Return the mean radiance over each texel of `shape`, (dims, 3) float32. Raises DeviceError."""
        if self._same_texels(shape):
            return self.texels.copy()
        if not self.device.fp64:
            # Float32 places edges to 1e-5 of a texel, too coarse for a sliver of sun, so the host computes in float64.
            parts = [
                self.exact(shape, part) for part in np.array_split(np.arange(shape.count), -(-shape.count // 4096))
            ]
            return np.concatenate(parts).astype(np.float32).reshape(*shape.dims, 3)
        if not self.latlong:
            return self._from_cube(shape)
        return self._latlong(shape) if shape.latlong else self._cube_from_latlong(shape.size)

    def exact(self, shape: Shape, index: np.ndarray) -> np.ndarray:
        """Return the mean over chosen texels of `shape`, (m, 3) float64, computed on the host.

        The method differs from that of `level`. index: flat indices of the texels, (m,).
        """
        return mean_over_texels(self.texels, self.rotation, shape.latlong, shape.size, index)

    def _same_texels(self, shape: Shape) -> bool:
        return (
            shape.latlong == self.latlong
            and self.rows == shape.size
            and self.rotation == 0
            and (not self.latlong or self.columns == 2 * self.rows)
        )

    def _run(self, program: Program, name: str, count: int, args: Sequence[Any]) -> None:
        _run(self.device, program, name, count, args)

    def _cube_from_latlong(self, size: int) -> np.ndarray:
        program = _program(self.device, _turns(self.columns))
        level = self.device.empty((6, size, size, 3), np.float32)
        for batch in _batches(self.device, self.rows, self.columns, self.rotation, size):
            lists = batch.lists or _lists(self.device, self.rows, self.columns, self.rotation, size, batch)
            self._run(
                program,
                "mean_by_list",
                batch.count,
                (
                    level,
                    np.int32(batch.first),
                    np.int32(batch.count),
                    np.int32(size),
                    np.int32(self.rows),
                    np.int32(self.columns),
                    batch.start,
                    *lists,
                    self.radiance,
                ),
            )
        return level.read()

    def _latlong(self, shape: Shape) -> np.ndarray:
        level = self.device.empty((*shape.dims, 3), np.float32)
        self._run(
            _program(self.device),
            "mean_latlong",
            shape.count,
            (
                level,
                np.int32(shape.size),
                np.int32(2 * shape.size),
                np.int32(self.rows),
                np.int32(self.columns),
                np.float64(self.rotation),
                self.device.array(row_edges(self.rows, np.float64)),
                self.device.array(row_edges(shape.size, np.float64)),
                self.radiance,
            ),
        )
        return level.read()

    def _from_cube(self, shape: Shape) -> np.ndarray:
        if self.rotation == 0 and not shape.latlong:
            level = self.device.empty((*shape.dims, 3), np.float32)
            make = _kept_pieces if max(shape.size, self.rows) <= PIECES else _pieces
            self._run(
                _program(self.device),
                "mean_aligned",
                shape.size**2,
                (
                    level,
                    np.int32(shape.size),
                    np.int32(self.rows),
                    *make(self.device, self.rows, shape.size),
                    self.radiance,
                ),
            )
            return level.read()
        # The sagitta of a parallel's chord is at most 2e-6 of the texel's height, (Δφ/chords)²/8 : Δθ; 48 chords do.
        chords = min(48, max(2, math.ceil(math.sqrt(math.pi / shape.size / 8 / 2e-6))))
        out = np.empty((shape.count, 3), np.float32)
        for first in range(0, shape.count, TILE):
            count = min(TILE, shape.count - first)
            part = self.device.empty((count, 3), np.float32)
            self._run(
                _program(self.device),
                "mean_cube",
                count,
                (
                    part,
                    np.int32(first),
                    np.int32(count),
                    np.int32(shape.size),
                    np.int32(shape.latlong),
                    np.int32(chords),
                    np.int32(self.rows),
                    np.float64(math.cos(self.rotation)),
                    np.float64(math.sin(self.rotation)),
                    self.radiance,
                ),
            )
            out[first : first + count] = part.read()
        return out.reshape(*shape.dims, 3)


def _program(device: Device, turns: int = 4) -> Program:
    return device.build(source.overlap().text, {"W": 1, "T": 1, "PRECISION": 64, "TURNS": turns})


def _run(device: Device, program: Program, name: str, count: int, args: Sequence[Any]) -> None:
    size = device.local_size
    device.launch(program.kernel(name), (-(-count // size) * size,), args)


def _pieces(device: Device, n: int, size: int) -> tuple[np.int32, Buffer, Buffer, Buffer]:
    """The pieces into which the edges of faces of n and of `size` texels cut a face, as `mean_aligned` takes them."""
    # Edges are in units of 1/(n · size), so that edges that meet are equal.
    edges = np.union1d(np.arange(n + 1) * size, np.arange(size + 1) * n)
    x = edges * (2 / (n * size)) - 1
    corner = np.arctan(x[:, None] * x / np.sqrt(1 + x[:, None] ** 2 + x * x))
    area = np.diff(np.diff(corner, axis=0), axis=1)
    first = np.searchsorted(edges, np.arange(size + 1) * n).astype(np.int32)
    return (
        np.int32(len(edges) - 1),
        device.array(first),
        device.array((edges[:-1] // size).astype(np.int32)),
        device.array(area),
    )


_kept_pieces = lru_cache(maxsize=LISTS)(_pieces)


def _turns(columns: int) -> int:
    """Return the number of quarter turns that map the columns of a lat-long onto columns."""
    return 4 if columns % 4 == 0 else 1


def _generators(size: int, turns: int) -> int:
    """Return the texels of a cube from which its symmetries give all others, as `generator_at` of `overlap.cl`
    numbers them.
    """
    upper, half = (size + 1) // 2, size // 2
    polar = size * size if turns == 1 else half * (size - half) + size % 2
    return (1 if turns == 4 else 4) * upper * size + polar


@lru_cache(maxsize=LISTS)
def _batches(device: Device, rows: int, columns: int, rotation: float, size: int) -> tuple[_Batch, ...]:
    """The overlaps of a lat-long grid with a cube's, in batches that fit OVERLAPS; made once for all images."""
    turns = _turns(columns)
    total = _generators(size, turns)
    counts = device.empty((total,), np.int32)
    _run(
        device,
        _program(device, turns),
        "overlap_list",
        total,
        (np.int32(0), counts, np.int32(0), *_grids(device, rows, columns, rotation, size, total), None, None, None),
    )
    ends = np.concatenate([[0], np.cumsum(counts.read(), dtype=np.int64)])
    cuts = [0]
    while cuts[-1] < total:
        cuts.append(max(int(np.searchsorted(ends, ends[cuts[-1]] + OVERLAPS, "right")) - 1, cuts[-1] + 1))
    batches = []
    for first, last in itertools.pairwise(cuts):
        start = device.array((ends[first : last + 1] - ends[first]).astype(np.int32))
        batch = _Batch(first, last - first, start, None)
        if len(cuts) == 2:
            batch = _Batch(first, last - first, start, _lists(device, rows, columns, rotation, size, batch))
        batches.append(batch)
    return tuple(batches)


def _lists(device: Device, rows: int, columns: int, rotation: float, size: int, batch: _Batch) -> tuple[Buffer, Buffer]:
    """The (row, column) of the source texels that each generator of a batch overlaps, and their shares of it."""
    length = int(batch.start.read()[-1])
    where, weight = device.empty((length, 2), np.int32), device.empty((length,), np.float64)
    _run(
        device,
        _program(device, _turns(columns)),
        "overlap_list",
        batch.count,
        (
            np.int32(1),
            None,
            np.int32(batch.first),
            *_grids(device, rows, columns, rotation, size, batch.count),
            batch.start,
            where,
            weight,
        ),
    )
    return where, weight


def _grids(device: Device, rows: int, columns: int, rotation: float, size: int, count: int) -> tuple[Any, ...]:
    theta = np.arange(rows + 1) * (math.pi / rows)
    # 1 - cos θ as a square keeps its digits at the pole; the cotangents of the poles only serve as bounds.
    cotangent = np.concatenate([[1e300], 1 / np.tan(theta[1:-1]), [-1e300]])
    if rows % 2 == 0:
        cotangent[rows // 2] = 0.0
    edges = np.stack([2 * np.sin(theta / 2) ** 2, cotangent], 1)
    return (
        np.int32(count),
        np.int32(size),
        np.int32(rows),
        np.int32(columns),
        np.float64(rotation),
        device.array(edges),
    )
