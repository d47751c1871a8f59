"""Represents one environment on a device: bright texels apart, the rest as lists of nodes and as anterpolated grids."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from whitefurnace.opencl import constants, source
from whitefurnace.opencl.device import Buffer, Device, Kernel
from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.lobes import Lobe
from whitefurnace.sphere.environments import Environment, channel_range
from whitefurnace.sphere.grids import (
    coarsening,
    composite,
    corrections,
    cube_tables,
    grid_tangents,
    latlong_tables,
    source_solid_angles,
)

LIGHT = frozenset({"nodes", "chosen_nodes", "gather", "coarsen", "grid_list"})
"""Kernels whose work items are too small to be a group each."""


PATCHES = 1 << 23
"""Largest number of the blocks' sums in memory together, in an anterpolation of several faces at once."""


CENTRED_NODES = 1 << 24
"""Largest number of masses at corrected centres, for texels in several parts: two buffers of 200 MB."""


class Texels:
    """The texels of one environment as kernels read them.

    Radiance is scaled by a power of two to a mean near 1. This is exact, and keeps sums of very bright or very dark
    images inside float32; results are scaled back. Lobes integrate the radiance above the smallest value of each
    channel (`base`), which is added afterwards: its share needs no sum, and a constant image comes out exactly.
    """

    def __init__(self, device: Device, environment: Environment, precision: int) -> None:
        self.device = device
        self.precision = precision
        self.kind = np.dtype(f"f{precision // 8}")
        self.real = self.kind.type
        self.environment = environment
        e = environment
        self.latlong = e.kind == "latlong"
        self.rows, self.columns = e.texels.shape[-3:-1]
        self.faces = 1 if self.latlong else 6
        mean = float(np.mean(e.statistics["mean"]))
        # The exponent is within ±100, so that neither the factor nor its products leave float32.
        self.scale = 2.0 ** min(max(-round(math.log2(mean)), -100), 100) if mean > 0 else 1.0
        self.values = device.aligned_empty(e.texels.shape, np.float32)
        np.multiply(e.texels, np.float32(self.scale), out=self.values)
        self.radiance = device.array(self.values)
        self.base, most = channel_range(self.values)
        self.constant = bool((most == self.base).all())
        self.texel = math.pi / self.rows if self.latlong else math.pi / 2 / self.rows
        self._program = source.texels(e.kind)
        self._extract()
        self._tables: dict[tuple[int, bool], tuple[Buffer, Buffer]] = {}
        self._corrected: dict[int, Buffer] = {}
        self._grids: dict[int, Buffer] = {}
        self._fine: tuple[int, int, Buffer] | None = None
        self._bright_cache: dict[tuple[int, ...], Buffer] = {}
        self.cuts = 1

    def _extract(self) -> None:
        """Clip BRIGHT texels, those of largest radiance × solid angle, to the smallest of them.

        A sun then leaves neither a firefly nor a hole, since its excess is summed exactly for each output. A small
        image has few bright texels, because many nodes for each of them would cost more than the grid. `share` is the
        largest share of all energy that a texel still holds; `brightest` are the indices of some of the largest of all.
        """
        omega = source_solid_angles(self.environment).astype(np.float32)
        clipped = self.device.aligned_empty((self.values.size // 3, 3), np.float32)
        np.subtract(self.values.reshape(-1, 3), self.base, out=clipped)
        flat = ((clipped[:, 0] + clipped[:, 1] + clipped[:, 2]).reshape(omega.shape) * omega).ravel()
        total = float(flat.sum(dtype=np.float64))
        most = max(flat.size // 32, 2 if flat.size >= 8 else 0)
        self._index, self._excess, self._shares = np.arange(0), np.empty((0, 3)), np.empty(0)
        if most == 0:
            self.brightest = np.array([int(flat.argmax())])
            level = float(flat.max())
        else:
            index = _enough(flat, _largest(flat, min(planning.BRIGHT[-1], most)), total)
            count = len(index)
            self.brightest = index[:8]
            level = float(flat[index].min())
            keep = np.divide(np.float32(level), flat[index], out=np.ones(count, np.float32), where=flat[index] > 0)
            original = clipped[index]
            clipped[index] = original * keep[:, None]
            excess = original.astype(np.float64) - clipped[index]  # exact, so that no energy is lost to rounding
            real = excess.any(1)
            self._index, self._excess = index[real], excess[real]
            self._shares = flat[index[real]] / total if total > 0 else np.empty(0)
        self.share = level / total if total > 0 else 0.0
        self._clipped = self.device.array(clipped)

    # ------------------------------------------------------------------------------------------- nodes

    @property
    def centred(self) -> int:
        """Largest number of parts of an edge into which texels may be cut for masses at corrected centres.

        It is 0 where the image is too small for the stencil of the correction.
        """
        if self.rows < 16 or self.columns < 16 or (self.latlong and self.columns % 2):
            return 0
        return next(c for c in planning.CENTRED if c == 1 or self.nodes(c) <= CENTRED_NODES)

    def _table(self, cuts: int, centred: bool) -> tuple[Buffer, Buffer]:
        """Row and column tables of quadrature nodes, made in float64; see texels/*.clh. Centred parts are as texels."""
        if (cuts, centred) not in self._tables:
            size = (self.rows * cuts, self.columns * cuts, 1) if centred else (self.rows, self.columns, cuts)
            tables = _node_tables(self.latlong, *size, self.environment.rotation, centred)
            rows, columns = (self.device.array(t.astype(self.kind)) for t in tables)
            self._tables[cuts, centred] = rows, columns
        return self._tables[cuts, centred]

    def _centres(self, cuts: int) -> Buffer:
        """The clipped texels, each in cuts × cuts parts, as masses at the parts' centres: `correct_rows`,
        `correct_columns`."""
        if cuts not in self._corrected:
            rows, columns = self.rows * cuts, self.columns * cuts
            fix = corrections(self.latlong, rows, columns)
            half, out = (self.device.empty((self.faces * rows, columns * 3), np.float32) for _ in range(2))
            parts = self._clipped
            if cuts > 1:
                parts = out
                self.launch(
                    "cut_texels",
                    self.faces * rows,
                    (parts, self._clipped, np.int32(columns), np.int32(self.faces * rows), np.int32(cuts)),
                )
            self.launch(
                "correct_rows",
                self.faces * rows,
                (
                    half,
                    parts,
                    np.int32(rows),
                    np.int32(columns * 3),
                    self.device.array(fix.row_tap),
                    self.device.array(fix.row_factor),
                ),
            )
            self.launch(
                "correct_columns",
                self.faces * rows,
                (
                    out,
                    half,
                    np.int32(rows),
                    np.int32(columns),
                    self.device.array(fix.column_tap),
                    self.device.array(fix.column_factor),
                    *(np.float32(f) for f in fix.inner),
                ),
            )
            self._corrected[cuts] = out
        return self._corrected[cuts]

    def arguments(self, cuts: int, whole: bool = True) -> tuple[Any, ...]:
        """Return the arguments of the kernels that read texels.

        cuts: nodes of the edge of each texel. whole: True if the kernel reads all texels together, so that masses may
        be corrected by those of neighbours.
        """
        centred = whole and cuts <= self.centred and cuts in planning.CENTRED
        rows, columns = self._table(cuts, centred)
        size = (self.rows * cuts, self.columns * cuts, 1) if centred else (self.rows, self.columns, cuts)
        turn = self.environment.rotation
        return (
            *(np.int32(k) for k in size),
            self.real(math.cos(turn)),
            self.real(math.sin(turn)),
            rows,
            columns,
            self._centres(cuts) if centred else self._clipped,
        )

    def kernel(self, name: str) -> Kernel:
        """Return a kernel of the texels' program by its name."""
        return self.device.build(
            self._program.text, {"W": self.device.lanes(self.precision), "T": 1, "PRECISION": self.precision}
        ).kernel(name)

    def launch(self, name: str, count: int, args: Sequence[Any], times: int = 1) -> None:
        """Launch a kernel of the texels' program over at least `count` work items, and `times` along a second axis."""
        size = self.device.scalar_size if name in LIGHT else self.device.local_size
        self.device.launch(self.kernel(name), (-(-count // size) * size, times), args, (size, 1))

    def nodes(self, cuts: int) -> int:
        """Return the number of quadrature nodes of the whole source, at `cuts` of an edge of each texel."""
        return self.faces * self.rows * self.columns * cuts * cuts

    def bands(self, cuts: int) -> Iterator[tuple[Buffer, int, float]]:
        """Yield every node of the clipped source in bands of whole rows: (list, number of nodes in it, share done)."""
        width, rows = self.columns * cuts, self.faces * self.rows * cuts
        band = min(max(planning.NODES_A_BAND // width, 1), rows)
        listed = self.device.empty((band * width, 8), self.kind)
        for first in range(0, rows, band):
            count = min(band, rows - first) * width
            self.launch("nodes", count, (listed, np.int32(first), np.int32(count), *self.arguments(cuts)))
            yield listed, count, min(first + band, rows) / rows

    def bright_list(self, lobe: Lobe, tolerance: float, finer: int = 1) -> Buffer | None:
        """Return the excess of the bright texels as one list of nodes, None where nothing was clipped.

        A texel gets more nodes the more energy it holds. finer: factor on the nodes of an edge.
        """
        if not len(self._index):
            return None
        smooth = planning.cuts_for(self.texel, min(lobe.alpha, planning.SHARP_ENOUGH), tolerance, centred=0)
        wanted = np.maximum(smooth, planning.bright_cuts(self.texel, lobe.horizon, tolerance, self._shares)) * finer
        key = tuple(wanted.tolist())
        if key not in self._bright_cache:
            listed = self.device.empty((int((wanted**2).sum()), 8), self.kind)
            first = 0
            for cuts in np.unique(wanted):
                group = np.flatnonzero(wanted == cuts)
                count = len(group) * int(cuts) ** 2
                self.launch(
                    "chosen_nodes",
                    count,
                    (
                        listed,
                        np.int32(first),
                        np.int32(len(group)),
                        self.device.array(self._index[group].astype(np.int32)),
                        self.device.array(self._excess[group].astype(self.kind)),
                        *self.arguments(int(cuts), whole=False),
                    ),
                )
                first += count
            self._bright_cache[key] = listed
        return self._bright_cache[key]

    # ------------------------------------------------------------------------------------------- grids

    def prepare(self, n: int, cuts: int) -> None:
        """Announce the finest grid that a set of levels needs, so that no grid is made from the texels twice.

        n: nodes of its edge. cuts: nodes of each texel's edge for it.
        """
        self.cuts = max(self.cuts, cuts)
        self._finest(n)

    @property
    def fineness(self) -> tuple[int, int]:
        """Nodes of a face edge of the finest grid so far, 0 for none, and the cuts with which it was made."""
        return self._fine[:2] if self._fine else (0, 0)

    def _finest(self, n: int) -> tuple[int, int, Buffer]:
        """The anterpolated grid made straight from the texels; coarser ones are made from it."""
        if self._fine is None or self._fine[0] < n or self._fine[1] < self.cuts:
            n = max(n, self._fine[0] if self._fine else 0)
            cuts = self.cuts if self.cuts > 1 or self.centred else 2
            grid = self.device.empty((6, n, n, 4), self.kind)
            blocks = -(-(n - 1) // constants.PATCH)
            reached = (constants.PATCH + constants.ORDER - 1) ** 2 * 4
            faces = next(f for f in (6, 3, 2, 1) if f == 1 or f * blocks**2 * reached <= PATCHES)
            patches = self.device.empty((faces, blocks**2, reached), self.kind)
            for face in range(0, 6, faces):
                self.launch(
                    "anterpolate", blocks**2, (patches, np.int32(n), np.int32(face), *self.arguments(cuts)), faces
                )
                self.launch("gather", n * n, (grid, np.int32(n), np.int32(face), patches), faces)
            self._fine = n, self.cuts, grid
            self._grids = {n: grid}
        return self._fine

    def grid(self, n: int) -> Buffer:
        """Return the n × n grid of each face, (6, n, n, 4): ∫ (L, 1) φ_a dω for its nodes, without the excess of
        bright texels.
        """
        fine, _, grid = self._finest(n)
        if n not in self._grids:
            matrix, first, last = (self.device.array(a) for a in coarsening(fine, n, self.kind.char))
            sizes = (np.int32(fine), np.int32(n))
            half = self.device.empty((6, fine, n, 4), self.kind)
            self.launch(
                "coarsen", 6 * fine * n, (half, grid, matrix, first, last, *sizes, np.int32(1), np.int32(6 * fine))
            )
            coarse = self.device.empty((6, n, n, 4), self.kind)
            self.launch("coarsen", 6 * n * n, (coarse, half, matrix, first, last, *sizes, np.int32(n), np.int32(6 * n)))
            self._grids[n] = coarse
        return self._grids[n]

    def grid_list(self, n: int) -> Buffer:
        """Return the n × n grid as a list of nodes."""
        listed = self.device.empty((6 * n * n, 8), self.kind)
        self.launch(
            "grid_list",
            6 * n * n,
            (listed, np.int32(n), self.device.array(grid_tangents(n).astype(self.kind)), self.grid(n)),
        )
        return listed


def _largest(values: np.ndarray, count: int) -> np.ndarray:
    """Indices of the `count` largest values, largest first, ties by index."""
    at_least = np.partition(values, values.size - count)[values.size - count]
    index = np.flatnonzero(values >= at_least)
    return index[np.argsort(-values[index], kind="stable")][:count]


def _enough(values: np.ndarray, index: np.ndarray, total: float) -> np.ndarray:
    """The first of the largest values that hold the energy which stands out; see BRIGHT."""
    for count in planning.BRIGHT:
        if count <= len(index) and count * float(values[index[count - 1]]) <= planning.LEFT_BRIGHT * total:
            return index[:count]
    return index[: planning.BRIGHT[0]]


@lru_cache(maxsize=16)
def _node_tables(
    latlong: bool, rows: int, columns: int, cuts: int, rotation: float, corrected: bool
) -> tuple[np.ndarray, np.ndarray]:
    x, w = (np.array([0.5]), np.array([1.0])) if cuts == 1 else composite(cuts)
    scales = corrections(latlong, rows, columns).scales if corrected else None
    if latlong:
        return latlong_tables(rows, columns, x, w, rotation, None if scales is None else scales[0])
    return cube_tables(rows, x, w, None if scales is None else scales[0])
