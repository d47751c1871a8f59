"""Plan -> levels: runs the prefilter of one environment on a device, certifies every level against the exact
integral, and refines what misses its tolerance."""
from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from whitefurnace import plan as planning
from whitefurnace import source
from whitefurnace.catalogue import Model
from whitefurnace.derived import at_horizon, lobe_norm, numbers_of
from whitefurnace.device import Buffer, Device, Kernel, Program
from whitefurnace.environments import Environment, cube_solid_angles, latlong_solid_angles
from whitefurnace.recipe import Chosen
from whitefurnace.sphere import (
    Shape,
    block_bounds,
    bounds,
    coarsening,
    composite,
    cube_tables,
    grid_tangents,
    latlong_tables,
    row_edges,
    source_directions,
)

Progress = Callable[[str, float], None]
"""Called with what is being done and its share of the whole, 0 to 1."""

# What a certified error may hide of rounding: float32 leaves up to 3e-5 on the darkest texels of a studio and a
# tenth of that in the median, measured against float64 in another form (tests/test_prefilter_kernels.py).
ROUNDING = {32: 2e-5, 64: 2e-7}

HARMONICS_CHUNK = 1024
EXACT_SHARE = 0.3  # of the progress: the certificate's sums come first and take about this part of the time


@dataclass(frozen=True)
class Level:
    """One finished level: texels (6, size, size, 3) or lat-long (size, 2 size, 3), float32, and its statement.

    `error` bounds the 99th percentile of texel errors at 95 % confidence, `worst` is the largest seen, `rmse`
    the relative RMSE; `grid` and `method` say how it was made; `seconds` is wall time, certificate included.
    """

    texels: np.ndarray
    roughness: float
    error: float
    worst: float
    rmse: float
    method: str
    grid: int
    pairs: int
    seconds: float


class Convolver:
    """The state of one environment on one device: texels, source grids, compiled kernels.

    Radiance is scaled by a power of two to a mean near 1, which is exact and keeps sums of very bright or very
    dark images inside float32; results are scaled back. Lobes integrate what lies above the least radiance of
    each channel, and that base is added after: its share needs no sum, and a constant image comes out exactly.
    """

    def __init__(self, device: Device, environment: Environment, *, precision: int = 32, seed: str = "",
                 progress: Progress | None = None) -> None:
        self.device = device
        self.precision = precision if precision == 32 or device.fp64 else 32
        self.kind = np.dtype(f"f{self.precision // 8}")
        self.real = self.kind.type
        self.environment = environment
        self.seed = seed
        self.progress = progress or (lambda _what, _share: None)
        e = environment
        self.latlong = e.kind == "latlong"
        self.rows, self.columns = e.texels.shape[-3:-1]
        self.faces = 1 if self.latlong else 6
        self.mean = mean = float(np.mean(e.statistics["mean"]))
        # Within ±100, so that neither the factor nor what it multiplies leaves float32.
        self.scale = 2.0 ** min(max(-round(math.log2(mean)), -100), 100) if mean > 0 else 1.0
        texels = device.aligned_empty(e.texels.shape, np.float32)
        np.multiply(e.texels, np.float32(self.scale), out=texels)
        self.constant = bool((texels == texels[(0,) * (texels.ndim - 1)]).all())
        self.texel = math.pi / self.rows if self.latlong else math.pi / 2 / self.rows
        self._texels = texels
        self._radiance = device.array(texels)
        self._bright_shares = np.empty(0)
        self._brightest = np.arange(0)
        self._bright_cache: dict[tuple[int, int, int], Buffer] = {}
        self.base = texels.reshape(-1, 3).min(0)
        self._clipped, self._bright = self._extract(texels)
        self._texel_program = source.texels(e.kind)
        self._tables: dict[int, tuple[Buffer, Buffer]] = {}
        self._grids: dict[int, Buffer] = {}
        self._fine: tuple[int, Buffer] | None = None
        self._fine_cuts = 0
        self.cuts = 1  # quadrature nodes a texel edge in the anterpolation
        self._harmonics: dict[int, np.ndarray] = {}  # 9 × 3 coefficients and ∑w, by cuts

    # ------------------------------------------------------------------------------------------- sources

    def _extract(self, texels: np.ndarray) -> tuple[Buffer, tuple[np.ndarray, np.ndarray]]:
        """Clips the BRIGHT texels of largest radiance × solid angle to the least of them.

        Gives the clipped texels and the (indices, excess radiance) taken; a sun then leaves neither a firefly
        nor a hole, since its excess is summed exactly for each output. A small image has few bright texels: their
        nodes, many a texel, would cost more than the grid.
        """
        omega = (latlong_solid_angles(self.rows, self.columns)[:, None] if self.latlong
                 else cube_solid_angles(self.rows)).astype(np.float32)
        clipped = self.device.aligned_empty((texels.size // 3, 3), np.float32)
        np.subtract(texels.reshape(-1, 3), self.base, out=clipped)
        flat = (clipped.sum(-1).reshape(texels.shape[:-1]) * omega).ravel()
        total = float(flat.sum(dtype=np.float64))
        count = min(planning.BRIGHT, max(flat.size // 32, 2 if flat.size >= 8 else 0))
        if count == 0:
            self.share = float(flat.max()) / total if total > 0 else 0.0
            self._brightest = np.array([int(flat.argmax())])
            return self.device.array(clipped), (np.arange(0), np.empty((0, 3)))
        index = np.argpartition(flat, flat.size - count)[flat.size - count:]
        index = index[np.argsort(-flat[index], kind="stable")]
        self._brightest = index[:8]
        level = flat[index].min()
        keep = np.divide(level, flat[index], out=np.ones(count, np.float32), where=flat[index] > 0)
        original = clipped[index]
        clipped[index] = original * keep[:, None]
        excess = original.astype(np.float64) - clipped[index]  # exact, so that no energy is lost to rounding
        real = excess.any(1)
        self.share = float(level) / total if total > 0 else 0.0
        self._bright_shares = flat[index[real]] / total if total > 0 else np.empty(0)
        return self.device.array(clipped), (index[real], excess[real])

    def _table(self, cuts: int) -> tuple[Buffer, Buffer]:
        """Row and column tables of quadrature nodes, made in float64; see texels/*.clh."""
        if cuts not in self._tables:
            x, w = (np.array([0.5]), np.array([1.0])) if cuts == 1 else composite(cuts)
            tables = (latlong_tables(self.rows, self.columns, x, w, self.environment.rotation) if self.latlong
                      else cube_tables(self.rows, x, w))
            rows, columns = (self.device.array(t.astype(self.kind)) for t in tables)
            self._tables[cuts] = rows, columns
        return self._tables[cuts]

    def _texel_arguments(self, cuts: int, radiance: Buffer) -> tuple[Any, ...]:
        rows, columns = self._table(cuts)
        turn = self.environment.rotation
        return (np.int32(self.rows), np.int32(self.columns), np.int32(cuts), self.real(math.cos(turn)),
                self.real(math.sin(turn)), rows, columns, radiance)

    def _texel_kernel(self, name: str) -> Kernel:
        return self.device.build(self._texel_program.text,
                                 {"W": 1, "T": 1, "PRECISION": self.precision, "ORDER": planning.ORDER}).kernel(name)

    def _launch(self, kernel: Kernel, count: int, args: Sequence[Any]) -> None:
        size = self.device.local_size
        self.device.launch(kernel, (-(-count // size) * size,), args)

    def prepare(self, n: int, cuts: int) -> None:
        """Says which grid is the finest that a set of levels needs and how finely texels are cut for it, so that
        none is made from the texels twice."""
        self.cuts = max(self.cuts, cuts)
        self._finest(n)

    def _finest(self, n: int) -> tuple[int, Buffer]:
        """The anterpolated grid made straight from the texels; coarser ones are made from it."""
        if self._fine is None or self._fine[0] < n or self._fine_cuts < self.cuts:
            n = max(n, self._fine[0] if self._fine else 0)
            self._fine_cuts = cuts = self.cuts
            grid = self.device.empty((6, n, n, 4), self.kind)
            moments = self.device.empty(((n - 1) ** 2, planning.ORDER**2 * 4), self.kind)
            for face in range(6):
                self._launch(self._texel_kernel("anterpolate"), (n - 1) ** 2,
                             (moments, np.int32(n), np.int32(face), *self._texel_arguments(cuts, self._clipped)))
                self._launch(self._texel_kernel("gather"), n * n, (grid, np.int32(n), np.int32(face), moments))
            self._fine = n, grid
            self._grids.clear()
        return self._fine

    def _grid(self, n: int) -> Buffer:
        """The source list of the n × n grid."""
        if n not in self._grids:
            fine, grid = self._finest(n)
            if n < fine:
                matrix, first, last = (self.device.array(a) for a in coarsening(fine, n, self.kind.char))
                sizes = (np.int32(fine), np.int32(n))
                half = self.device.empty((6, fine, n, 4), self.kind)
                self._launch(self._texel_kernel("coarsen"), 6 * fine * n,
                             (half, grid, matrix, first, last, *sizes, np.int32(1), np.int32(6 * fine)))
                grid = self.device.empty((6, n, n, 4), self.kind)
                self._launch(self._texel_kernel("coarsen"), 6 * n * n,
                             (grid, half, matrix, first, last, *sizes, np.int32(n), np.int32(6 * n)))
            tangent = grid_tangents(n).astype(self.kind)
            listed = self.device.empty((6 * n * n, 8), self.kind)
            self._launch(self._texel_kernel("grid_list"), 6 * n * n, (listed, np.int32(n),
                                                                      self.device.array(tangent), grid))
            self._grids[n] = listed
        return self._grids[n]

    def _bright_lists(self, lobe: Lobe, tolerance: float, finer: int = 1) -> list[Buffer]:
        """The excess of the bright texels as lists, texels of like share together: the more of the energy one
        holds, the more nodes it takes (`finer` times as many an edge)."""
        index, excess = self._bright
        if not len(index):
            return []
        smooth = planning.cuts_for(self.texel, min(lobe.alpha, planning.SHARP_ENOUGH), tolerance)
        wanted = np.array([max(smooth, planning.bright_cuts(self.texel, lobe.horizon, tolerance, share))
                           for share in self._bright_shares])
        lists = []
        for cuts in np.unique(wanted):
            group = np.flatnonzero(wanted == cuts)
            c = int(cuts) * finer
            key = (c, len(group), int(group[0]))
            if key not in self._bright_cache:
                listed = self.device.empty((len(group) * c * c, 8), self.kind)
                self._launch(self._texel_kernel("chosen_nodes"), len(group) * c * c,
                             (listed, np.int32(len(group)), self.device.array(index[group].astype(np.int32)),
                              self.device.array(excess[group].astype(self.kind)),
                              *self._texel_arguments(c, self._clipped)))
                self._bright_cache[key] = listed
            lists.append(self._bright_cache[key])
        return lists

    def nodes(self, cuts: int) -> int:
        """Quadrature nodes of the whole source at `cuts` an edge of each texel."""
        return self.faces * self.rows * self.columns * cuts * cuts

    def _bands(self, cuts: int) -> Iterator[tuple[Buffer, int, float]]:
        """Every node of the clipped source, in bands of whole rows: (list, nodes in it, share done)."""
        width, rows = self.columns * cuts, self.faces * self.rows * cuts
        band = min(max(planning.NODES_A_BAND // width, 1), rows)
        listed = self.device.empty((band * width, 8), self.kind)
        for first in range(0, rows, band):
            count = min(band, rows - first) * width
            self._launch(self._texel_kernel("nodes"), count,
                         (listed, np.int32(first), np.int32(count), *self._texel_arguments(cuts, self._clipped)))
            yield listed, count, min(first + band, rows) / rows

    # ------------------------------------------------------------------------------------------- lobes

    def _program(self, lobe: Lobe) -> Program:
        return self.device.build(source.convolution(lobe.model).text, {
            "W": self.device.lanes(self.precision), "T": self.device.vectors, "PRECISION": self.precision})

    def _partials(self, lobe: Lobe, listed: Buffer, count: int, directions: Buffer, partial: Buffer, first: int,
                  part: str = "convolve", *window: Any) -> int:
        """Adds ⌈count/CHUNK⌉ partial sums of a list to `partial` from split `first` on; how many they were."""
        kernel = self._program(lobe).kernel(part)
        step = self._step
        outputs = directions.shape[1]
        splits = -(-count // planning.CHUNK)
        self.device.launch(kernel, (outputs // step, splits),
                           (partial, np.int32(outputs), np.int32(count), np.int32(planning.CHUNK), np.int32(first),
                            directions, listed, *window, *(self.real(value) for value in lobe.scalars)))
        return splits

    @property
    def _step(self) -> int:
        """Outputs of one work item."""
        return self.device.lanes(self.precision) * self.device.vectors

    def convolve(self, lobe: Lobe, shape: Shape, n: int, tolerance: float,
                 share: tuple[float, ...] = (0.0, 1.0)) -> np.ndarray:
        """The level over all directions of `shape` from the n × n grid and the bright texels, (dims, 3)."""
        if n % 8:
            raise ValueError(f"a grid of {n} nodes an edge is not a multiple of the blocks' 8")
        self.prepare(n, planning.cuts_for(self.texel, lobe.alpha, tolerance, self.share))
        split = planning.split_for(n, lobe.alpha, lobe.horizon)
        listed, bright = self._grid(n), self._bright_lists(lobe, tolerance)
        far = self._grid(split.grid) if split else None
        blocks = self.device.array(block_bounds(n).astype(self.kind)) if split else None
        group = self._step
        step = group * self.device.local_size
        count = listed.shape[0]
        pairs = planning.pairs_of(1, n, lobe.alpha, lobe.horizon)
        tile = max(planning.PAIRS_A_LAUNCH // pairs // step, 1) * step
        order = shape.tiled()
        out = np.empty((shape.count, 3), np.float32)
        for begin in range(0, shape.count, tile):
            index = order[begin:begin + tile]
            padded = -(-len(index) // step) * step
            part = np.pad(shape.directions(index), ((0, 0), (0, padded - len(index))), mode="edge")
            block = self.device.array(part.astype(self.kind))
            chunks = -(-count // planning.CHUNK) + (-(-far.shape[0] // planning.CHUNK) if far else 0)
            partial = self.device.empty((chunks, 4, padded), self.kind)
            if split and far and blocks:
                window = self.real(split.q0), self.real(split.q1)
                groups = self.device.array(bounds(part, group).astype(self.kind))
                splits = self._partials(lobe, listed, count, block, partial, 0, "convolve_near", *window, groups,
                                        blocks)
                splits += self._partials(lobe, far, far.shape[0], block, partial, splits, "convolve_far", *window)
            else:
                splits = self._partials(lobe, listed, count, block, partial, 0)
            bright_splits, extra = 0, partial
            if bright:
                chunks = sum(-(-part.shape[0] // planning.CHUNK) for part in bright)
                extra = self.device.empty((chunks, 4, padded), self.kind)
                for some in bright:
                    bright_splits += self._partials(lobe, some, some.shape[0], block, extra, bright_splits)
            level = self.device.empty((3, padded), self.kind)
            self.device.launch(self._program(lobe).kernel("finish"), (padded // self.device.lanes(self.precision),),
                               (level, np.int32(padded), partial, np.int32(splits), extra, np.int32(bright_splits),
                                self.real(1 / lobe.norm)))
            out[index] = level.read().T[:len(index)] + self.base
            self.progress(lobe.name, share[0] + (share[1] - share[0]) * (begin + len(index)) / shape.count)
        return out.reshape(*shape.dims, 3)

    def exact(self, wanted: Sequence[tuple[Lobe, np.ndarray]], cuts: int, tolerance: float = 1e-3) -> list[np.ndarray]:
        """For each (lobe, directions (3, m)): the integral over every texel, (m, 3) float64, in one pass.

        Bright texels are cut twice as fine as in `convolve`. The spherical harmonics of the same nodes
        are kept where `harmonics` will ask for them.
        """
        jobs = []
        step = self._step * self.device.local_size
        for lobe, directions in wanted:
            padded = -(-directions.shape[1] // step) * step
            block = np.pad(directions, ((0, 0), (0, padded - directions.shape[1])), mode="edge")
            jobs.append((lobe, self.device.array(block.astype(self.kind)), np.zeros((4, padded))))
        coefficients = np.zeros(28)
        wants_harmonics = cuts in self._harmonic_cuts and cuts not in self._harmonics
        for listed, count, share in self._bands(cuts):
            self.progress("exact integrals", EXACT_SHARE * share)
            if wants_harmonics:
                coefficients += self._harmonic_sums(listed, count)
            for lobe, directions_on, sums in jobs:
                sums += self._list_sums(lobe, listed, count, directions_on)
        results = []
        for (_, directions), (lobe, directions_on, sums) in zip(wanted, jobs, strict=True):
            value = sums[:3] / sums[3]
            for listed in self._bright_lists(lobe, tolerance, finer=2):
                value += self._list_sums(lobe, listed, listed.shape[0], directions_on)[:3] / lobe.norm
            results.append(value.T[:directions.shape[1]] + self.base)
        if wants_harmonics:
            for listed in self._bright_lists(COSINE, 1e-3):
                coefficients[:27] += self._harmonic_sums(listed, listed.shape[0])[:27]
            coefficients[:3] += self.base * 2 * math.sqrt(math.pi)  # ∫ Y00 dω
            self._harmonics[cuts] = coefficients
        return results

    def _list_sums(self, lobe: Lobe, listed: Buffer, count: int, block: Buffer) -> np.ndarray:
        """(4, outputs) float64: ∑K wL and ∑K w of a whole list."""
        partial = self.device.empty((-(-count // planning.CHUNK), 4, block.shape[1]), self.kind)
        self._partials(lobe, listed, count, block, partial, 0)
        return partial.read().sum(0, dtype=np.float64)

    def _harmonic_sums(self, listed: Buffer, count: int) -> np.ndarray:
        """(28,) float64: 9 × 3 coefficients of a list, and ∑w."""
        chunks = -(-count // HARMONICS_CHUNK)
        partial = self.device.empty((chunks, 28), self.kind)
        self._launch(self._texel_kernel("harmonics"), chunks,
                     (partial, np.int32(count), np.int32(HARMONICS_CHUNK), listed))
        return partial.read().sum(0, dtype=np.float64)

    @property
    def _harmonic_cuts(self) -> tuple[int, int]:
        """Nodes a texel edge for spherical harmonics, and half as many."""
        cuts = 2 * math.ceil(self.texel / 0.05)  # pairs of Gauss points on .05 rad: 2e-8 for these polynomials
        return cuts, 1 if cuts == 2 else 2 * (cuts // 4)

    def harmonics(self) -> tuple[np.ndarray, float]:
        """Radiance coefficients (9, 3) in float64 from nodes of every texel, and their error over the largest
        L00: the difference to half as many nodes an edge, which bounds the finer rule's, and float32's part."""
        cuts, fewer = self._harmonic_cuts
        for c in self._harmonic_cuts:
            if c not in self._harmonics:
                self.exact([], c)
        sums = self._harmonics[cuts]
        level = float(np.abs(sums[:3]).max())
        error = float(np.abs(self._harmonics[fewer][:27] - sums[:27]).max()) / level + 1e-6 if level > 0 else 0.0
        return sums[:27].reshape(9, 3) / self.scale, error

    def exact_means(self, shape: Shape, index: np.ndarray) -> np.ndarray:
        """The mean of the source over chosen texels of `shape`, (m, 3), in float64 and in another form."""
        from whitefurnace.catalogue.overlap import mean_over_texels
        return mean_over_texels(self._texels, self.environment.rotation, shape.latlong, shape.size, index)

    # ------------------------------------------------------------------------------------------- level 0

    def means(self, shape: Shape) -> np.ndarray:
        """The mean source radiance over each texel of `shape`, (dims, 3) float32, by exact overlaps."""
        if self._same_texels(shape):
            return self._texels.copy()
        if not self.device.fp64:
            # Float32 places edges to 1e-5 of a texel, and a sliver of sun is brighter than that: the host's float64.
            index = np.arange(shape.count)
            parts = [self.exact_means(shape, part) for part in np.array_split(index, -(-shape.count // 4096))]
            return np.concatenate(parts).astype(np.float32).reshape(*shape.dims, 3)
        program = self.device.build(source.overlap().text, {"W": 1, "T": 1, "PRECISION": 64})
        real = np.float64
        if not self.latlong:
            return self._means_of_cube(program, shape, real)
        if shape.latlong:
            level = self.device.empty((*shape.dims, 3), np.float32)
            self._launch(program.kernel("mean_latlong"), shape.count,
                         (level, np.int32(shape.size), np.int32(2 * shape.size), np.int32(self.rows),
                          np.int32(self.columns), real(self.environment.rotation),
                          self.device.array(row_edges(self.rows, real)),
                          self.device.array(row_edges(shape.size, real)), self._radiance))
            return level.read()
        return self._means_by_edges(program, shape.size, real)

    def _same_texels(self, shape: Shape) -> bool:
        return (shape.latlong == self.latlong and self.rows == shape.size and self.environment.rotation == 0
                and (not self.latlong or self.columns == 2 * self.rows))

    def _means_of_cube(self, program: Any, shape: Shape, real: Any) -> np.ndarray:
        turn = self.environment.rotation
        # Sagitta of a chord of a parallel against the texel's height: (Δφ/chords)²/8 : Δθ ≤ 2e-6, where 48 do.
        chords = min(48, max(2, math.ceil(math.sqrt(math.pi / shape.size / 8 / 2e-6))))
        out = np.empty((shape.count, 3), np.float32)
        tile = 1 << 15
        for first in range(0, shape.count, tile):
            count = min(tile, shape.count - first)
            part = self.device.empty((count, 3), np.float32)
            self._launch(program.kernel("mean_cube"), count,
                         (part, np.int32(first), np.int32(count), np.int32(shape.size), np.int32(shape.latlong),
                          np.int32(chords), np.int32(self.rows), real(math.cos(turn)), real(math.sin(turn)),
                          self._radiance))
            out[first:first + count] = part.read()
        return out.reshape(*shape.dims, 3)

    def _means_by_edges(self, program: Any, size: int, real: Any) -> np.ndarray:
        edges = self.device.array(row_edges(self.rows, real))
        kind = np.dtype(real)
        # Bands of rows bound the float64 prefix sums to 64 MiB whatever the source.
        band = max(1, min(self.rows, (64 << 20) // (3 * self.columns * kind.itemsize)))
        above = self.device.empty((band, self.columns, 3), kind)
        sums = np.zeros((2, size + 1, size, 3), kind)
        faces = [self.device.array(sums, writable=True) for _ in range(6)]
        zero = self.device.array(np.zeros((self.columns, 3), kind), writable=True)
        weights = -np.diff(np.cos(np.arange(self.rows + 1) * math.pi / self.rows))
        total = self.device.array(np.einsum("r,rck->ck", weights, self._texels).astype(kind))
        for first in range(0, self.rows, band):
            last = min(first + band, self.rows)
            self._launch(program.kernel("accumulate_rows"), 3 * self.columns,
                         (above, zero, np.int32(self.columns), np.int32(first), np.int32(last), edges, self._radiance))
            for face in range(6):
                self._launch(program.kernel("cut_edges"), 2 * size * (size + 1),
                             (faces[face], np.int32(size), np.int32(face), np.int32(self.rows),
                              np.int32(self.columns), real(self.environment.rotation), np.int32(first),
                              np.int32(last), edges, above, total, self._radiance))
        out = np.empty((6, size, size, 3), np.float32)
        for face in range(6):
            level = self.device.empty((size, size, 3), np.float32)
            self._launch(program.kernel("close_texels"), size * size, (level, np.int32(size), faces[face]))
            out[face] = level.read()
        return out

    # ------------------------------------------------------------------------------------------- statement

    def sample(self, shape: Shape) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the texels a certificate looks at: (uniform draw, stratum near the brightest sources)."""
        if shape.count <= planning.UNIFORM + planning.NEAR_BRIGHT:
            return np.arange(shape.count), np.arange(0)
        digest = hashlib.sha256(f"{self.seed}/{self.environment.digest}/{shape}".encode()).digest()
        rng = np.random.default_rng(list(digest))
        uniform = rng.choice(shape.count, planning.UNIFORM, replace=False)
        return uniform, self._near_bright(shape)

    def _near_bright(self, shape: Shape) -> np.ndarray:
        """The NEAR_BRIGHT texels nearest the brightest sources, nearest to any of them."""
        if self.constant:
            return np.arange(0)
        targets = source_directions(self.environment, self._brightest).T
        best, closeness = np.arange(0), np.empty(0)
        for first in range(0, shape.count, 1 << 18):
            index = np.arange(first, min(first + (1 << 18), shape.count))
            best = np.concatenate([best, index])
            closeness = np.concatenate([closeness, (targets @ shape.directions(index)).max(0)])
            keep = np.argpartition(-closeness, planning.NEAR_BRIGHT)[:planning.NEAR_BRIGHT]
            best, closeness = best[keep], closeness[keep]
        return np.sort(best)


@dataclass(frozen=True)
class Lobe:
    """A lobe to convolve with: an NDF at its parameters, or irradiance's cosine (model None).

    `alpha` says how sharp it is and `horizon` how hard its kink where l sets, both as GGX's α has them.
    """

    name: str
    model: Model | None
    scalars: tuple[float, ...]
    norm: float
    alpha: float
    horizon: float


def ndf_lobe(device: Device, choice: Chosen, roughness: float, parameters: Mapping[str, Any]) -> Lobe:
    """The prefilter's lobe of an NDF; raises InputError for a user's that cannot be normalized."""
    entry = choice.model
    rows = np.array([[parameters[p.name]] for p in entry.parameters], np.float64).reshape(-1, 1)
    numbers = numbers_of(device, entry, rows)
    norm = lobe_norm(device, entry, parameters)
    # The slope of K/∫K at the horizon is α²/π for GGX. A lobe that lies there altogether (sheen) falls in 1/horizon.
    horizon = math.sqrt(math.pi * at_horizon(device, entry, parameters) / norm)
    return Lobe(f"r = {roughness:.3f}", entry, tuple(numbers[:, 0].tolist()), norm,
                min(max(roughness * roughness, 1e-5), 1 / max(horizon, 1.0)), max(horizon, 1e-5))


COSINE = Lobe("irradiance", None, (), math.pi, 1.0, 1.0)
