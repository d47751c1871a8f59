"""Recipe and source -> the work: source grids, cuts of texels, precision and lobe evaluations that a tolerance
needs; the sizes of launches and lists that keep memory and rounding bounded."""
from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from whitefurnace.opencl.constants import BEYOND, RUN
from whitefurnace.prefiltering.recipe import Chain

BRIGHT = 64, 256, 1024, 4096
"""Texels of largest radiance × solid angle that are clipped and summed exactly: what a sun or a lamp holds more than
its surroundings. 16 leave up to twice the error on rough levels, 256 no less than 64 (studio, forest, sunset); a sun
that covers hundreds of texels of a large image must go as a whole."""

LEFT_BRIGHT = 2e-3
"""Of all energy, what a number of bright texels may leave, clipped, for that number to have been enough."""

CHUNK = 8192
"""Sources of one partial sum: bounds float32 rounding to 7e-7 whatever the length (`prefilter.cl`)."""

PAIRS_A_LAUNCH = 1 << 31
"""About 0.1 s on two cores where every pair is evaluated: Ctrl-C and progress between launches, and far below a GPU's
watchdog."""

SYMMETRIC = 8
"""How many times as many pairs the symmetric sums take in the same time."""


def splits_for(groups: int, classes: int) -> int:
    """Into how many partial sums a launch of `groups` work items divides its classes, so that all cores are busy."""
    return max(1, min(-(-SPREAD // groups), classes // RUN))


SPREAD = 16
"""Work items at least, where there are sources enough: what few outputs would else leave idle."""

NODES_A_BAND = 1 << 18
"""Source nodes listed at a time in the exact sum: 8 MiB, which stays in cache while all lobes read it."""

# Nodes a face edge for a p99 error of 1e-3 on the hardest of the measured environments (studio, forest): the
# sharp term follows the lobe's width, the floor the kink of (n·l)₊ at the horizon, which rough lobes carry to
# full height. The error falls like n^-RATE (measured, 1e-2 to 1e-5), so other tolerances scale n by
# (1e-3/tolerance)^(1/RATE); at the kink like n^-2.
SHARP, MARGIN, FLOOR, KINK = 2.1, 8, 24, 42
RATE = 6.5
LARGEST_GRID = 2048
GROWTH = 1.2, 3.0
"""How much finer at least and at most the grid of a level becomes when its certificate misses the tolerance."""

NEAR_BRIGHT = 64
"""Further texels, those nearest the brightest sources, where an error hides from a uniform draw."""


def precision_for(tolerance: float) -> int:
    """Working precision: float32 leaves up to 3e-5 on dark texels, so tight tolerances take float64."""
    return 64 if tolerance < 1e-4 else 32


@dataclass(frozen=True)
class LevelPlan:
    """One level: `size` texels a face edge, its roughness, and the grid and cuts that serve it.

    `grid` is the number of nodes a face edge of its anterpolated source, 0 where the level is the exact mean
    over each texel (roughness 0) or sampled. `cuts` is the number of quadrature nodes a texel edge in its exact sum.
    `samples` is how many a texel of filtered importance sampling takes, 0 for none.
    """

    size: int
    roughness: float
    parameters: dict[str, float]
    grid: int
    cuts: int
    samples: int = 0

    @property
    def outputs(self) -> int:
        return 6 * self.size**2

    @property
    def pairs(self) -> int:
        """Lobe evaluations of the convolution, those it may skip included in proportion to the near cap."""
        return self.outputs * self.samples or pairs_of(self.outputs, self.grid, max(self.roughness**2, 1e-5))


def pairs_of(outputs: int, grid: int, alpha: float, horizon: float | None = None) -> int:
    """Pairs of `outputs` directions and sources over a grid, as its parts leave them."""
    return int(outputs * 6 * sum(part.grid**2 * part.share for part in parts_for(grid, alpha, horizon)) if grid else 0)


def kink(horizon: float) -> float:
    """What the grid follows of the kink where l sets: a rim (sheen) meets so many nodes that their errors cancel,
    all but for hard panels, which a certificate finds."""
    return horizon if horizon <= 1 else horizon**0.6


def grid_size(alpha: float, tolerance: float, horizon: float | None = None) -> int:
    """Nodes a face edge that a lobe of roughness α needs for a p99 texel error ≤ tolerance, a multiple of 16.

    `horizon` is the α whose kink where l sets is as hard as the lobe's, α itself for GGX.
    """
    finer = (1e-3 / tolerance) ** (1 / RATE)
    n = max((SHARP / max(alpha, 1e-9) + MARGIN) * finer,
            FLOOR * finer + KINK * kink(alpha if horizon is None else horizon) * finer ** (RATE / 2))
    return min(nodes_for(n), LARGEST_GRID)


FEWER_NODES = 0.7
"""Nodes for a texel at most where a level is convolved at nodes: fewer, since it is then read at texels too."""

TEXELS_A_LAUNCH = 1 << 20
"""Texels read from nodes together, .05 s."""


def output_nodes(n: int, alpha: float) -> int:
    """Nodes an edge of the grid from which a level can be read whose lobe takes the grid n: a quarter finer than the
    lobe needs, for a fourth of the error. The kink where l sets is no more in what it was convolved with."""
    finer = (n - 2 * BEYOND) / (SHARP / alpha + MARGIN)
    return nodes_for(1.25 * min(n - 2 * BEYOND, max(finer, 1.0) * (SHARP / alpha + FLOOR)))


def spacing(grid: int) -> float:
    """Radians between the nodes of a grid."""
    return math.pi / 2 / (grid - 2 * BEYOND)


def nodes_for(n: float) -> int:
    """Nodes an edge of the grid with at least n of them on a face: a multiple of 16."""
    return max(16 * math.ceil((n + 2 * BEYOND) / 16), 32)


SHARP_ENOUGH = 0.1
"""Lobes up to this α carry too little near the horizon for its kink to be seen."""

MOST_CUTS = 64
"""Where the search for converged reference nodes ends: 4096 nodes a texel."""


CENTRE_ERROR = 1e-5
"""Of masses at corrected texel centres, at the p99, for a texel of .34 α: measured, 3e-6 on a studio, 8e-6 on noise
whose texels differ by factors of 20."""

CENTRED = (4, 2, 1)
"""Parts an edge into which texels may be cut for masses at corrected centres."""


def cuts_for(texel: float, alpha: float, tolerance: float, share: float = 0.0, centred: int = 1) -> int:
    """Quadrature nodes a texel edge to begin with, so that integrating a lobe over a texel of angle `texel` errs
    less than tolerance/10.

    Masses at the corrected centres of c × c parts of each texel, c up to `centred` (0 where there are none), leave
    CENTRE_ERROR (texel/α/c/.34)⁶; an uncorrected midpoint 1.3e-3·(texel/α/.34)²; pairs of Gauss points in m cells an
    edge about 1.3e-3·(.02·texel/α/m/.34)·(texel/α/m/.34)³, which this bounds by its fourth power. The
    kink of (n·l)₊ costs a texel with `share` of all energy share·texel/(8 cuts²) where it sets; what a whole
    panel costs that sets at once no formula says: a certificate doubles the cuts until nothing changes.
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
    """What `cuts` nodes an edge leave of a smooth lobe, by the laws of `cuts_for`."""
    x = texel / alpha / 0.34
    return CENTRE_ERROR * (x / cuts) ** 6 if cuts <= centred else 2.6e-5 * (2 * x / cuts) ** 4


def bright_cuts(texel: float, horizon: float, tolerance: float, shares: np.ndarray) -> np.ndarray:
    """Nodes an edge of bright texels that hold `shares` (m,) of all energy, powers of two, (m,) integers.

    Where one sets, the kink of (n·l)₊ costs share·texel/(8 cuts²) of the mean; texels a thousand times darker
    than the mean are held to the tolerance too, so the factor is 10³/8. Lobes with little at the `horizon` need none.
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
    """A share of a lobe on a grid of `grid` nodes a face edge: what lies beyond the window `inner` and within the
    window `outer` (None: no bound on that side). The parts of a lobe sum to it."""

    grid: int
    inner: Window | None
    outer: Window | None

    @property
    def share(self) -> float:
        """Of the sphere, the part within reach."""
        return self.outer.q1 / 4 if self.outer else 1.0

    @property
    def work(self) -> float:
        """Products for each output, in those of a transformed sum over one node."""
        return self.grid**2 * (close_work(math.sqrt(self.outer.q1), self.grid) if self.outer else 1.0)


TILE_REACH = 4.0
"""Nodes of a grid by which its tiles and groups of outputs widen the reach of a window."""


def close_work(chord: float, n: int) -> float:
    """Of a sum over all nodes by transforms, what one over those within a chord costs without: eight times as much a
    node, and chord²/4 of the sphere."""
    return 2 * (chord + TILE_REACH * math.pi / 2 / n) ** 2


FAR_NODES = 20.0
"""Nodes × radians of a far grid beyond the angle where the near part ends, for 1e-3: measured to leave the error as
it is."""

@lru_cache(maxsize=4096)
def parts_for(n: int, alpha: float, horizon: float | None = None) -> tuple[Part, ...]:
    """The parts of a lobe whose fine grid is n × n, the cheapest that were found.

    A sharp lobe needs its fine grid near r only. Near pairs grow with θ², θ the angle at which a window ends; what
    lies beyond is smooth on the scale θ, its grid falls like 1/θ, and may be parted again. The last grid
    must also carry the lobe's kink at the horizon. A finer n, for a tighter tolerance, refines all alike.
    """
    horizon = alpha if horizon is None else horizon
    finer = (n - 2 * BEYOND) / (SHARP / alpha + MARGIN)
    angles = [0.02 * 1.25**k for k in range(18)]  # to .9
    floor = finer * FLOOR + finer ** (RATE / 2) * KINK * kink(horizon)

    def far(theta: float) -> int:
        return nodes_for(max(finer * FAR_NODES / theta, floor))

    def q1(theta: float) -> float:
        return 2 - 2 * math.cos(theta)

    # rest[k]: cost and angles of the cheapest way on beyond angle k, from the widest inwards.
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
    return tuple(Part(grid, inner, outer) for grid, inner, outer
                 in zip(grids, [None, *windows], [*windows, None], strict=True))


def plan_chain(chain: Chain, texel: float, share: float = 0.0, centred: int = 1) -> tuple[LevelPlan, ...]:
    """The levels of a chain for a source whose texels subtend `texel` radians and hold at most `share` of its
    energy each, bright ones apart."""
    levels = []
    for size, r in chain.levels:
        parameters = chain.parameters(r)
        alpha = max(r * r, 1e-5)
        samples = 0 if r == 0 else chain.samples or 0
        levels.append(LevelPlan(size, r, parameters, 0 if r == 0 or samples else grid_size(alpha, chain.tolerance),
                                1 if r == 0 else cuts_for(texel, alpha, chain.tolerance, share, centred), samples))
    return tuple(levels)


def refined(level: LevelPlan, missed: float, horizon: float) -> LevelPlan | None:
    """The same level on a finer grid, or None where the finest has been tried. `missed`: its error by the tolerance."""
    order = RATE if horizon <= SHARP_ENOUGH else 2
    growth = min(max((1.5 * missed) ** (1 / order), GROWTH[0]), GROWTH[1]) if missed < math.inf else GROWTH[1]
    grid = min(16 * math.ceil(level.grid * growth / 16), LARGEST_GRID)
    return None if grid <= level.grid else replace(level, grid=grid)
