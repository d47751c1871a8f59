"""Prefilters one environment on a device, and computes the exact integrals that certify the result."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from whitefurnace.opencl import source
from whitefurnace.opencl.device import Buffer, Device
from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.lobes import COSINE, Lobe, mixture_lobe, ndf_lobe
from whitefurnace.prefiltering.means import Means
from whitefurnace.prefiltering.recipe import CERTIFIED
from whitefurnace.prefiltering.sources import Texels
from whitefurnace.prefiltering.symmetry import Classes, octahedral_of
from whitefurnace.sphere.environments import Environment
from whitefurnace.sphere.grids import POINTS, Shape, octahedral_means, source_directions
from whitefurnace.sphere.nearest import nearest_texels

Progress = Callable[[str, float], None]
"""Called with the current activity and the share of the work that is done, 0 to 1."""

# Added to a certified error for the rounding of its reference; the level's own rounding is in the measured error.
# Against float64, float32 leaves 1e-6 at the p99 and 2e-6 at most of a studio's levels; ten times that is added.
ROUNDING = {32: 2e-5, 64: 2e-7}

SERIES = {32: 3e-7, 64: 3e-8}
"""Largest share of a lobe's energy that its series may misplace, by precision."""

NEAR_TEXELS = 12.0
"""Radius of the window of a lobe that is much narrower than a texel, in parts of texels. Texels within it are cut
finely; beyond it, masses at corrected centres resolve the lobe."""

MOST_TOGETHER = 4096
"""Largest number of directions of exact integrals at a time. It bounds the memory, and a launch to about a second."""

HARMONICS_CHUNK = 1024
EXACT_SHARE = 0.3  # of the progress: the certificate's sums come first and take about this part of the time


@dataclass(frozen=True)
class Level:
    """One finished level and its stated errors.

    texels     (6, size, size, 3) or lat-long (size, 2 size, 3) float32 linear radiance
    roughness  perceptual roughness
    error      bound on the 99th percentile of the texel errors, at 95 % confidence
    worst      largest texel error that was seen
    rmse       relative RMSE
    method     how the level was made
    grid       nodes of a face edge of its source grid
    pairs      number of lobe evaluations
    seconds    wall time, with the certificate
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
    """Prefilters one environment on one device.

    precision: 32 or 64 bits; 32 where the device has no float64. seed: seed of the certificates' samples. progress:
    called while work is done. `texels` is the environment as kernels read it; all values are multiplied by `scale`, a
    power of two.
    """

    def __init__(
        self,
        device: Device,
        environment: Environment,
        *,
        precision: int = 32,
        seed: str = "",
        progress: Progress | None = None,
    ) -> None:
        self.device = device
        self.precision = precision if precision == 32 or device.fp64 else 32
        self.kind = np.dtype(f"f{self.precision // 8}")
        self.real = self.kind.type
        self.environment = environment
        self.seed = seed
        self.progress = progress or (lambda _what, _share: None)
        self.mean = float(np.mean(environment.statistics["mean"]))
        self.texels = Texels(device, environment, self.precision)
        self.latlong, self.rows, self.columns = self.texels.latlong, self.texels.rows, self.texels.columns
        self.scale, self.base, self.constant = self.texels.scale, self.texels.base, self.texels.constant
        self.texel, self.share = self.texels.texel, self.texels.share
        self.overlaps = Means(device, self.texels.values, environment.rotation, self.texels.radiance)
        self._symmetries = octahedral_of(device, self.precision)
        self._classes: dict[tuple[int, ...], Classes] = {}  # by exchanges too
        self._lists: dict[tuple[int, ...], Buffer] = {}  # by nodes per edge and what they were made from
        self._harmonics: dict[int, np.ndarray] = {}  # 9 × 3 coefficients and ∑w, by cuts

    def prepare(self, n: int, cuts: int) -> None:
        """Announce the finest grid that a set of levels needs, so that no grid is made from the texels twice.

        n: nodes of its edge. cuts: nodes of each texel's edge for it.
        """
        self.texels.prepare(n, cuts)

    # ------------------------------------------------------------------------------------------- levels

    def _sources(self, n: int, exchanges: int) -> Classes:
        """The classes of a grid."""
        grid = self.texels.grid(n)
        key = (n, exchanges, *self.texels.fineness)
        if key not in self._classes:
            self._classes = {k: v for k, v in self._classes.items() if k[2:] == key[2:]}
            self._classes[key] = self._symmetries.classes(n, grid, exchanges)
        return self._classes[key]

    def convolve(
        self, lobe: Lobe, shape: Shape, n: int, tolerance: float, share: tuple[float, ...] = (0.0, 1.0)
    ) -> np.ndarray:
        """Compute a level from the n × n grid and the bright texels: all texels of `shape`, (dims, 3) float32.

        tolerance: tolerance of the level's error. share: progress before and after. Raises ValueError for an n that is
        not a multiple of 16.
        """
        if n % 16:
            raise ValueError(f"a grid of {n} nodes an edge is not a multiple of the tiles' 16")
        self.prepare(n, planning.cuts_for(self.texel, lobe.alpha, tolerance, self.share, self.texels.centred))
        s, error = self._symmetries, max(SERIES[self.precision], tolerance / 300)
        bright = self.texels.bright_list(lobe, tolerance)
        nodes = planning.output_nodes(n, lobe.alpha)
        if 6 * nodes**2 > planning.FEWER_NODES * shape.count:
            level = self.device.empty((*shape.dims, 3), np.float32)
            self._sum_parts(level, lobe, shape, n, bright, error, share)
            return level.read()
        # The level has more texels than its lobe has detail, so it is convolved at nodes and read at texels.
        grid = self.device.empty((6, nodes, nodes, 4), np.float32)
        self._sum_parts(grid, lobe, Shape(False, nodes, nodes=True), n, None, error, share)
        level = self.device.empty((*shape.dims, 3), np.float32)
        self.interpolate(level, shape, grid)
        if bright:
            for found in s.orbits(shape):
                s.unfold(level, found, None, None, s.apart(found, lobe, bright), 1 / lobe.norm, np.zeros(3))
        return level.read()

    def _sum_parts(
        self,
        level: Buffer,
        lobe: Lobe,
        shape: Shape,
        n: int,
        bright: Buffer | None,
        error: float,
        share: tuple[float, ...],
    ) -> None:
        """Sum the lobe over the n × n grid and the list `bright`, part by part, into all of `level`.

        The base is not added where the level is one of nodes.
        """
        s, parts = self._symmetries, planning.parts_for(n, lobe.alpha, lobe.horizon)
        exchanges = 2 if shape.latlong else 6
        most = max(6 * part.work for part in parts)
        tile = int(planning.PAIRS_A_LAUNCH * planning.SYMMETRIC / (most * 8 * exchanges))
        done, base = 0, np.zeros(3) if shape.nodes else self.base
        for found in s.orbits(shape, tile):
            groups = found.padded // s.lanes
            sums = []
            for near in (False, True):
                some = [part for part in parts if (part.outer is not None) == near]
                splits = [planning.splits_for(groups, 3 * part.grid**2 // 4) for part in some]
                partial = s.empty(sum(splits), found) if some else None
                for k, part in enumerate(some):
                    assert partial
                    s.convolve(
                        partial,
                        sum(splits[:k]),
                        splits[k],
                        found,
                        lobe,
                        part,
                        self._sources(part.grid, exchanges),
                        error,
                    )
                sums.append(partial)
            apart = s.apart(found, lobe, bright) if bright else None
            s.unfold(level, found, sums[0], sums[1], apart, 1 / lobe.norm, base)
            done += found.count
            self.progress(lobe.name, share[0] + (share[1] - share[0]) * min(done * 8 * exchanges / shape.count, 1.0))

    def interpolate(self, level: Buffer, shape: Shape, grid: Buffer) -> None:
        """Interpolate the texels of `shape` from values at the nodes of `grid`, add the base, and write them into
        `level`.
        """
        kernel = self.device.build(source.interpolation().text, {"W": 1, "T": 1, "PRECISION": self.precision}).kernel(
            "interpolate"
        )
        size = self.device.scalar_size
        for first in range(0, shape.count, planning.TEXELS_A_LAUNCH):
            count = min(planning.TEXELS_A_LAUNCH, shape.count - first)
            self.device.launch(
                kernel,
                (-(-count // size) * size,),
                (
                    level,
                    np.int32(first),
                    np.int32(count),
                    np.int32(shape.size),
                    np.int32(shape.latlong),
                    grid,
                    np.int32(grid.shape[1]),
                    *(self.real(b) for b in self.base),
                ),
                (size,),
            )

    # ------------------------------------------------------------------------------------------- exact integrals

    def exact(self, wanted: Sequence[tuple[Lobe, np.ndarray]], cuts: int, tolerance: float = 1e-3) -> list[np.ndarray]:
        """Compute exact values of lobes in given directions: (m, 3) float64 for each pair of `wanted`.

        wanted: (lobe, directions (3, m)) pairs. Every source texel is summed, in one pass for all pairs. cuts: nodes of
        each texel's edge; bright texels are cut twice as finely as in `convolve`. tolerance: tolerance of the level.
        The spherical harmonics of the same nodes are kept if `harmonics` needs them.
        """
        if any(directions.shape[1] > MOST_TOGETHER for _, directions in wanted):  # of a certificate of many texels
            pieces = [
                np.array_split(directions, -(-directions.shape[1] // MOST_TOGETHER), 1) for _, directions in wanted
            ]
            return [
                np.concatenate([self.exact([(lobe, piece)], cuts, tolerance)[0] for piece in some])
                for (lobe, _), some in zip(wanted, pieces, strict=True)
            ]
        # Beyond the window of narrow lobes the sum errs by up to 3e-5.
        coarse = self.texels.centred and cuts > max(planning.CENTRED) and tolerance >= 1e-4
        if wanted and coarse and all(_narrow(lobe) for lobe, _ in wanted):
            return [self.exact_narrow(lobe, directions, cuts, tolerance) for lobe, directions in wanted]
        jobs = [(lobe, self._directions(directions)) for lobe, directions in wanted]
        sums = [np.zeros((4, block.shape[1])) for _, block in jobs]
        coefficients = np.zeros(28)
        wants_harmonics = cuts == self._harmonic_cuts and cuts not in self._harmonics
        for listed, count, share in self.texels.bands(cuts):
            self.progress("exact integrals", EXACT_SHARE * share)
            if wants_harmonics:
                coefficients += self._harmonic_sums(listed, count)
            for k, (lobe, block) in enumerate(jobs):
                sums[k] += self._list_sums(lobe, listed, count, block)
        if wants_harmonics:
            self._harmonics[cuts] = self._with_bright(coefficients)
        return [
            self._value(lobe, block, total, tolerance, directions.shape[1])
            for (lobe, block), total, (_, directions) in zip(jobs, sums, wanted, strict=True)
        ]

    def exact_narrow(self, lobe: Lobe, directions: np.ndarray, cuts: int, tolerance: float) -> np.ndarray:
        """Compute what `exact` does, for one lobe that is much narrower than a texel: (m, 3) float64.

        Texels are cut finely only near the lobe's direction; beyond a window, larger parts resolve the lobe.
        """
        parts = self.texels.centred
        reach = min(NEAR_TEXELS * self.texel / parts, 1.0)
        q1 = 2 - 2 * math.cos(reach)
        window = (q1 / 16, 16 / (15 * q1))
        block = self._directions(directions)
        sums = np.zeros((4, block.shape[1]))
        for listed, count, _ in self.texels.bands(parts):
            sums += self._list_sums(lobe, listed, count, block, window)
        for entry, numbers, weight in lobe.summands:
            program = self.device.build(
                source.near_texels(self.environment.kind, entry).text,
                {"W": self.device.lanes(self.precision), "T": 1, "PRECISION": self.precision},
            )
            near = self.device.empty((block.shape[1], 4), self.kind)
            size = self.device.local_size
            self.device.launch(
                program.kernel("convolve_texels"),
                (-(-block.shape[1] // size) * size,),
                (
                    near,
                    np.int32(block.shape[1]),
                    block,
                    *(self.real(x) for x in (*window, 1.01 * reach)),
                    *self.texels.arguments(cuts),
                    *(self.real(value) for value in numbers),
                ),
            )
            sums += weight * near.read().T
        return self._value(lobe, block, sums, tolerance, directions.shape[1])

    def on_grid(self, lobe: Lobe, directions: np.ndarray, n: int, tolerance: float) -> np.ndarray:
        """Compute what `exact` does for one lobe, from the n × n grid instead of every texel: (m, 3) float64."""
        if directions.shape[1] > MOST_TOGETHER:
            pieces = np.array_split(directions, -(-directions.shape[1] // MOST_TOGETHER), 1)
            return np.concatenate([self.on_grid(lobe, piece, n, tolerance) for piece in pieces])
        self.texels.grid(n)  # which may make the finest anew
        key = (n, *self.texels.fineness)
        if key not in self._lists:
            self._lists[key] = self.texels.grid_list(n)
        block = self._directions(directions)
        total = self._list_sums(lobe, self._lists[key], 6 * n * n, block)
        return self._value(lobe, block, total, tolerance, directions.shape[1])

    def _directions(self, directions: np.ndarray) -> Buffer:
        step = self.device.lanes(self.precision) * self.device.vectors * self.device.local_size
        padded = -(-directions.shape[1] // step) * step
        block = np.pad(directions, ((0, 0), (0, padded - directions.shape[1])), mode="edge")
        return self.device.array(block.astype(self.kind))

    def _value(self, lobe: Lobe, block: Buffer, sums: np.ndarray, tolerance: float, count: int) -> np.ndarray:
        value = sums[:3] / sums[3]
        bright = self.texels.bright_list(lobe, tolerance, finer=2)
        if bright:
            value = value + self._list_sums(lobe, bright, bright.shape[0], block)[:3] / lobe.norm
        return value.T[:count] + self.base

    def _list_sums(
        self, lobe: Lobe, listed: Buffer, count: int, block: Buffer, window: tuple[float, float] = (0.0, 0.0)
    ) -> np.ndarray:
        """Return ∑K wL and ∑K w of a whole list by the NDFs themselves, beyond a window where there is one: (4,
        outputs) float64.
        """
        outputs, splits = block.shape[1], -(-count // planning.CHUNK)
        step = self.device.lanes(self.precision) * self.device.vectors
        total = np.zeros((4, outputs))
        for entry, numbers, weight in lobe.summands or ((None, (), 1.0),):
            program = self.device.build(
                source.convolution(entry).text,
                {"W": self.device.lanes(self.precision), "T": self.device.vectors, "PRECISION": self.precision},
            )
            partial = self.device.empty((splits, 4, outputs), self.kind)
            self.device.launch(
                program.kernel("convolve"),
                (outputs // step, splits),
                (
                    partial,
                    np.int32(outputs),
                    np.int32(count),
                    np.int32(planning.CHUNK),
                    block,
                    listed,
                    *(self.real(x) for x in window),
                    *(self.real(value) for value in numbers),
                ),
            )
            total += weight * partial.read().sum(0, dtype=np.float64)
        return total

    # ------------------------------------------------------------------------------------------- harmonics

    def _harmonic_sums(self, listed: Buffer, count: int) -> np.ndarray:
        """Return 9 × 3 coefficients of a list, and ∑w: (28,) float64."""
        chunks = -(-count // HARMONICS_CHUNK)
        partial = self.device.empty((chunks, 28), self.kind)
        self.texels.launch("harmonics", chunks, (partial, np.int32(count), np.int32(HARMONICS_CHUNK), listed))
        return partial.read().sum(0, dtype=np.float64)

    def _with_bright(self, coefficients: np.ndarray) -> np.ndarray:
        whole = coefficients.copy()
        bright = self.texels.bright_list(COSINE, 1e-3)
        if bright:
            whole[:27] += self._harmonic_sums(bright, bright.shape[0])[:27]
        whole[:3] += self.base * 2 * math.sqrt(math.pi)  # ∫ Y00 dω
        return whole

    @property
    def _harmonic_cuts(self) -> int:
        """Return the nodes per texel edge for spherical harmonics to degree 2."""
        if self.texels.centred and self.texel <= 0.05:
            return 1
        return 2 * math.ceil(self.texel / 0.05)  # pairs of Gauss points on .05 rad: 2e-8 for these polynomials

    def harmonics(self) -> tuple[np.ndarray, float]:
        """Return radiance coefficients (9, 3) float64 from nodes of every texel, and their error over the largest L00.

        The error is the difference to another quadrature of the same texels plus float32's rounding. That quadrature
        has twice as many nodes of an edge on a small image, otherwise it is the finest grid.
        """
        cuts = self._harmonic_cuts
        if cuts not in self._harmonics:
            self.exact([], cuts)
        sums = self._harmonics[cuts]
        if cuts == 1:
            n = self.texels.fineness[0] or 64
            other = self._with_bright(self._harmonic_sums(self.texels.grid_list(n), 6 * n * n))
        else:
            other = np.zeros(28)
            for listed, count, _ in self.texels.bands(2 * cuts):
                other += self._harmonic_sums(listed, count)
            other = self._with_bright(other)
        level = float(np.abs(sums[:3]).max())
        error = float(np.abs(other[:27] - sums[:27]).max()) / level + 1e-6 if level > 0 else 0.0
        return sums[:27].reshape(9, 3) / self.scale, error

    # ------------------------------------------------------------------------------------------- level 0

    def exact_means(self, shape: Shape, index: np.ndarray) -> np.ndarray:
        """Return the mean of the source over chosen texels of `shape`, (m, 3) float64, by another method than `means`.

        index: flat indices of the texels, (m,).
        """
        if shape.octahedral:
            return octahedral_means(self.environment, shape, index, POINTS[1]) * self.scale
        return self.overlaps.exact(shape, index)

    def means(self, shape: Shape) -> np.ndarray:
        """Return the mean source radiance over each texel of `shape`, (dims, 3) float32.

        The means are computed by exact overlaps, or for octahedral maps from points, whose error the certificate
        measures.
        """
        if shape.octahedral:
            index = np.arange(shape.count)
            means = octahedral_means(self.environment, shape, index, POINTS[0]) * self.scale
            return means.astype(np.float32).reshape(*shape.dims, 3)
        return self.overlaps.level(shape)

    # ------------------------------------------------------------------------------------------- statement

    def sample(self, shape: Shape, uniform_count: int = CERTIFIED) -> tuple[np.ndarray, np.ndarray]:
        """Draw the texels of a certificate: flat indices of a uniform draw, and of the near-source sample.

        The near-source sample holds the texels nearest the brightest sources. It is empty where the level is so small
        that all of its texels are drawn.
        """
        if shape.count <= uniform_count + planning.NEAR_BRIGHT:
            return np.arange(shape.count), np.arange(0)
        digest = hashlib.sha256(f"{self.seed}/{self.environment.digest}/{shape}".encode()).digest()
        rng = np.random.default_rng(list(digest))
        uniform = rng.choice(shape.count, uniform_count, replace=False)
        return uniform, self._near_bright(shape)

    def _near_bright(self, shape: Shape) -> np.ndarray:
        """Indices of the NEAR_BRIGHT texels nearest to any of the brightest sources."""
        if self.constant:
            return np.arange(0)
        return nearest_texels(shape, source_directions(self.environment, self.texels.brightest).T, planning.NEAR_BRIGHT)


def _narrow(lobe: Lobe) -> bool:
    return bool(lobe.summands) and lobe.horizon <= planning.SHARP_ENOUGH


__all__ = ["COSINE", "Convolver", "Level", "Lobe", "Progress", "mixture_lobe", "ndf_lobe"]
