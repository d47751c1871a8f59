"""Plans the work of a specular chain: source grids, texel cuts, precision and launch sizes for a tolerance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from whitefurnace.opencl.constants import BEYOND, RUN
from whitefurnace.prefiltering.recipe import Chain

BRIGHT = 64, 256, 1024, 4096
"""Numbers of brightest texels (radiance × solid angle) that may be clipped and summed exactly, so that a sun or a lamp
is not part of the grid. 16 leave up to twice the error on rough levels, 256 no less than 64 (studio, forest, sunset). A
sun that covers hundreds of texels of a large image must be taken as a whole."""

LEFT_BRIGHT = 2e-3
"""Largest share of all energy that the bright texels may leave when clipped, for their number to be enough."""

CHUNK = 8192
"""Number of sources in one partial sum. It bounds float32 rounding to 7e-7 whatever the length (`prefilter.cl`)."""

PAIRS_A_LAUNCH = 1 << 31
"""Pairs of a launch, about 0.1 s on two cores where every pair is evaluated. Ctrl-C and progress come between launches,
and this is far below a GPU's watchdog."""

SYMMETRIC = 8
"""Speed-up of the symmetric convolution over direct summation."""


def splits_for(groups: int, classes: int) -> int:
    """Return the number of partial sums into which a launch divides its classes so that all cores are busy.

    groups: work items of the launch. classes: number of classes of nodes.
    """
    return max(1, min(-(-SPREAD // groups), classes // RUN))


SPREAD = 16
"""Smallest number of work items where there are enough sources. Otherwise cores would be idle with few outputs."""

NODES_A_BAND = 1 << 18
"""Number of source nodes that are listed at a time in the exact sum: 8 MiB, which stay in cache while all lobes read
them."""

# Nodes a face edge for a p99 error of 1e-3 on the hardest of the measured environments (studio, forest). The sharp
# term follows the lobe's width. The floor follows the kink of (n·l)₊ at the horizon, which rough lobes have at full
# height. The error falls like n^-RATE (measured, 1e-2 to 1e-5), so other tolerances scale n by
# (1e-3/tolerance)^(1/RATE); at the kink it falls like n^-2.
SHARP, MARGIN, FLOOR, KINK = 2.1, 8, 24, 42
RATE = 6.5
LARGEST_GRID = 2048
GROWTH = 1.2, 3.0
"""Smallest and largest factor by which a level's grid is refined when its certificate misses the tolerance."""

NEAR_BRIGHT = 64
"""Size of the near-source sample: the texels nearest the brightest sources, where an error hides from a uniform draw.
"""


def precision_for(tolerance: float) -> int:
    """Return the working precision for a tolerance: 64 bits below 1e-4, since float32 errs by up to 3e-5 on dark
    texels.
    """
    return 64 if tolerance < 1e-4 else 32


@dataclass(frozen=True)
class LevelPlan:
    """The plan of one level.

    size        texels of a face edge
    roughness   perceptual roughness
    parameters  parameters of the NDF
    grid        nodes of a face edge of the anterpolated source; 0 for the mean over each texel (r = 0) and for samples
    cuts        quadrature nodes of a source texel's edge in the exact sum
    samples     importance samples for each texel, 0 for none
    """

    size: int
    roughness: float
    parameters: dict[str, float]
    grid: int
    cuts: int
    samples: int = 0

    @property
    def outputs(self) -> int:
        """Number of texels of the cube."""
        return 6 * self.size**2

    @property
    def pairs(self) -> int:
        """Number of lobe evaluations of the convolution. Pairs that it may skip count in proportion to the near cap."""
        return self.outputs * self.samples or pairs_of(self.outputs, self.grid, max(self.roughness**2, 1e-5))


def pairs_of(outputs: int, grid: int, alpha: float, horizon: float | None = None) -> int:
    """Return the number of pairs of output directions and grid sources, over the parts into which the lobe is split.

    outputs: number of directions. grid: nodes of a face edge. alpha, horizon: as in `parts_for`.
    """
    return int(outputs * 6 * sum(part.grid**2 * part.share for part in parts_for(grid, alpha, horizon)) if grid else 0)


def kink(horizon: float) -> float:
    """Return the effective strength of the lobe's kink at the horizon.

    horizon: the α at which GGX has the same kink. The rim of a sheen lobe crosses so many nodes that their errors
    cancel, except under hard panels, which a certificate finds; so strengths above 1 count less.
    """
    return horizon if horizon <= 1 else horizon**0.6


def grid_size(alpha: float, tolerance: float, horizon: float | None = None) -> int:
    """Return the nodes per face edge, a multiple of 16, with which a lobe meets a tolerance.

    alpha: width of the lobe. tolerance: largest 99th percentile of the texel errors. horizon: the α at which GGX's kink
    at the horizon is as strong as the lobe's; by default alpha itself.
    """
    finer = (1e-3 / tolerance) ** (1 / RATE)
    n = max(
        (SHARP / max(alpha, 1e-9) + MARGIN) * finer,
        FLOOR * finer + KINK * kink(alpha if horizon is None else horizon) * finer ** (RATE / 2),
    )
    return min(nodes_for(n), LARGEST_GRID)


FEWER_NODES = 0.7
"""Largest number of nodes for a texel where a level is convolved at nodes. It is below 1, because the level is then
read at texels too."""

TEXELS_A_LAUNCH = 1 << 20
"""Number of texels that one launch reads from nodes, which takes .05 s."""


def output_nodes(n: int, alpha: float) -> int:
    """Return the nodes of an edge of the grid at which a level is convolved before it is interpolated at texels.

    n: nodes of an edge of the lobe's source grid. The result is a quarter finer than the lobe needs, for a fourth of
    the error. The convolved light has no kink at the horizon any more.
    """
    finer = (n - 2 * BEYOND) / (SHARP / alpha + MARGIN)
    return nodes_for(1.25 * min(n - 2 * BEYOND, max(finer, 1.0) * (SHARP / alpha + FLOOR)))


def spacing(grid: int) -> float:
    """Return the angle between the nodes of a grid, in radians.

    grid: nodes of a face edge.
    """
    return math.pi / 2 / (grid - 2 * BEYOND)


def nodes_for(n: float) -> int:
    """Return the smallest number of nodes of a face edge that is at least n and a multiple of 16."""
    return max(16 * math.ceil((n + 2 * BEYOND) / 16), 32)


SHARP_ENOUGH = 0.1
"""Largest α of a lobe that carries too little near the horizon for its kink to matter."""

MOST_CUTS = 64
"""Largest number of nodes per texel edge in the search for converged reference nodes: 4096 per texel."""


CENTRE_ERROR = 1e-5
"""Error (p99) of masses at corrected texel centres, for a texel of .34 α. Measured: 3e-6 on a studio, 8e-6 on noise
whose texels differ by factors of 20."""

CENTRED = (4, 2, 1)
"""Numbers of parts per edge into which texels may be cut for masses at corrected centres."""


def cuts_for(texel: float, alpha: float, tolerance: float, share: float = 0.0, centred: int = 1) -> int:
    """Return the first number of quadrature nodes of a texel edge to try, for an error below tolerance/10.

    texel: angle of a texel in radians. alpha: width of the lobe. share: largest share of all energy that a texel holds.
    centred: largest number of parts of an edge for masses at corrected centres, 0 where there are none.

    Masses at the corrected centres of c × c parts of each texel, c up to `centred`, have an error of CENTRE_ERROR
    (texel/α/c/.34)⁶; an uncorrected midpoint of 1.3e-3·(texel/α/.34)²; pairs of Gauss points in m cells of an edge of
    about 1.3e-3·(.02·texel/α/m/.34)·(texel/α/m/.34)³, which this function bounds by its fourth power. The kink of
    (n·l)₊ adds share·texel/(8 cuts²) for a texel with `share` of all energy at the horizon. No formula gives the error
    of a whole bright panel at the horizon: a certificate doubles the cuts until nothing changes.
    """
    x = texel / alpha / 0.34
    kinked = math.sqrt(2.5 * share * texel / tolerance)
    for cuts in reversed(CENTRED):
        if cuts <= centred and kinked <= cuts and CENTRE_ERROR * (x / cuts) ** 6 <= tolerance / 10:
            return cuts
    if not centred and kinked <= 1 and 1.3e-3 * x * x <= tolerance / 10:
        return 1
    cells = max(x * (5e-4 / tolerance) ** 0.25, kinked / 2, centred / 2 + 0.5)
    return 2 * min(max(1, math.ceil(cells)), 512)


def cuts_error(texel: float, alpha: float, cuts: int, centred: int = 1) -> float:
    """Return the error of integrating a smooth lobe over texels with `cuts` nodes of an edge, by the laws of
    `cuts_for`.
    """
    x = texel / alpha / 0.34
    return CENTRE_ERROR * (x / cuts) ** 6 if cuts <= centred else 2.6e-5 * (2 * x / cuts) ** 4


def bright_cuts(texel: float, horizon: float, tolerance: float, shares: np.ndarray) -> np.ndarray:
    """Return the nodes of an edge of bright texels, powers of two, (m,) integers.

    texel: angle of a texel in radians. horizon: strength of the lobe's kink at the horizon; a lobe with a small value
    there needs no more than 2 nodes. shares: (m,) shares of all energy that the texels hold. Where a bright texel
    crosses the horizon, the kink of (n·l)₊ has an error of share·texel/(8 cuts²) of the mean. Texels a thousand times
    darker than the mean must meet the tolerance too, so the factor is 10³/8.
    """
    if horizon <= SHARP_ENOUGH:
        return np.full(len(shares), 2)
    wanted = max(horizon, 1.0) * np.sqrt(125 * shares * texel / tolerance)
    return 2 ** np.clip(np.ceil(np.log2(np.maximum(wanted, 1e-9))), 1, 9).astype(int)


@dataclass(frozen=True)
class Window:
    """A smooth step in q = |l - r|² from 0 at q0 to 1 at q1."""

    q0: float
    q1: float


@dataclass(frozen=True)
class Part:
    """A part of a lobe, on a grid of `grid` nodes of a face edge. The parts of a lobe add up to it.

    inner  the part lies beyond this window, None for no bound
    outer  the part lies within this window, None for no bound
    """

    grid: int
    inner: Window | None
    outer: Window | None

    @property
    def share(self) -> float:
        """Share of the sphere within reach of the part."""
        return self.outer.q1 / 4 if self.outer else 1.0

    @property
    def work(self) -> float:
        """Number of products for each output, in units of a transformed sum over one node."""
        return self.grid**2 * (close_work(math.sqrt(self.outer.q1), self.grid) if self.outer else 1.0)


TILE_REACH = 4.0
"""Number of grid nodes by which its tiles and groups of outputs widen the reach of a window."""


def close_work(chord: float, n: int) -> float:
    """Return the cost of summing the nodes within a chord directly, relative to a transformed sum over all nodes.

    A node costs eight times as much, and chord²/4 of the sphere is summed. n: nodes of an edge of the grid.
    """
    return 2 * (chord + TILE_REACH * math.pi / 2 / n) ** 2


FAR_NODES = 20.0
"""Nodes × radians of a far grid beyond the angle where the near part ends, for a tolerance of 1e-3. Measured: it does
not change the error."""


@lru_cache(maxsize=4096)
def parts_for(n: int, alpha: float, horizon: float | None = None) -> tuple[Part, ...]:
    """Return the cheapest partition found of a lobe whose fine grid has n × n nodes on a face.

    A sharp lobe needs its fine grid only near r. The number of near pairs grows with θ², where θ is the angle at which
    a window ends. The rest of the lobe is smooth on the scale θ, so its grid shrinks like 1/θ, and it may be divided
    again. The last grid must also resolve the lobe's kink at the horizon. A finer n, for a tighter tolerance, refines
    all grids alike.
    """
    horizon = alpha if horizon is None else horizon
    finer = (n - 2 * BEYOND) / (SHARP / alpha + MARGIN)
    angles = [0.02 * 1.25**k for k in range(18)]  # to .9
    floor = finer * FLOOR + finer ** (RATE / 2) * KINK * kink(horizon)

    def far(theta: float) -> int:
        return nodes_for(max(finer * FAR_NODES / theta, floor))

    def q1(theta: float) -> float:
        return 2 - 2 * math.cos(theta)

    # rest[k] is the cost and the angles of the cheapest partition beyond angle k, from the widest inwards.
    widest = angles[::-1]
    rest: list[tuple[float, tuple[float, ...]]] = []
    for theta in widest:
        grid = far(theta)
        way: tuple[float, tuple[float, ...]] = (float(grid**2), ())
        for outer, (cost, more) in zip(widest, rest, strict=False):
            way = min(way, (grid**2 * close_work(math.sqrt(q1(outer)), grid) + cost, (outer, *more)))
        rest.append(way)
    best: tuple[float, tuple[float, ...]] = (float(n * n), ())
    for theta, (cost, more) in zip(widest, rest, strict=True):
        if far(theta) < n:
            best = min(best, (n * n * close_work(math.sqrt(q1(theta)), n) + cost, (theta, *more)))
    chosen = best[1]
    windows = [Window(q1(theta) / 16, q1(theta)) for theta in chosen]
    grids = [n, *(far(theta) for theta in chosen)]
    return tuple(
        Part(grid, inner, outer) for grid, inner, outer in zip(grids, [None, *windows], [*windows, None], strict=True)
    )


def plan_chain(chain: Chain, texel: float, share: float = 0.0, centred: int = 1) -> tuple[LevelPlan, ...]:
    """Plan the levels of a chain.

    texel: angle of the source's texels in radians. share: largest share of the source's energy that a texel holds,
    without the bright ones. centred: as in `cuts_for`.
    """
    levels = []
    for size, r in chain.levels:
        parameters = chain.parameters(r)
        alpha = max(r * r, 1e-5)
        samples = 0 if r == 0 else chain.samples or 0
        levels.append(
            LevelPlan(
                size,
                r,
                parameters,
                0 if r == 0 or samples else grid_size(alpha, chain.tolerance),
                1 if r == 0 else cuts_for(texel, alpha, chain.tolerance, share, centred),
                samples,
            )
        )
    return tuple(levels)


def refined(level: LevelPlan, missed: float, horizon: float) -> LevelPlan | None:
    """Return the same level on a finer grid, or None where the finest grid was tried.

    missed: the level's error divided by the tolerance. horizon: strength of the lobe's kink at the horizon.
    """
    order = RATE if horizon <= SHARP_ENOUGH else 2
    growth = min(max((1.5 * missed) ** (1 / order), GROWTH[0]), GROWTH[1]) if missed < math.inf else GROWTH[1]
    grid = min(16 * math.ceil(level.grid * growth / 16), LARGEST_GRID)
    return None if grid <= level.grid else replace(level, grid=grid)
