"""Recipe and source -> the work: source grids, cuts of texels, precision and lobe evaluations that a tolerance
needs; the sizes of launches and lists that keep memory and rounding bounded."""
from __future__ import annotations

import math
from dataclasses import dataclass, replace

from whitefurnace.recipe import Chain

ORDER = 4
"""Points of the Lagrange stencil of the anterpolated grids; `anterpolate.cl` is compiled for it."""

BRIGHT = 256
"""Texels of largest radiance × solid angle that are clipped and summed exactly; 64 hold a sun, 256 also the
panels of a studio, where they lower the error 2 to 3 times for 1 % of the pairs."""

CHUNK = 8192
"""Sources of one partial sum: bounds float32 rounding to 7e-7 whatever the length (`prefilter.cl`)."""

PAIRS_A_LAUNCH = 1 << 31
"""About 0.1 s on two cores: Ctrl-C and progress between launches, and far below a GPU's watchdog."""

NODES_A_BAND = 1 << 18
"""Source nodes listed at a time in the exact sum: 8 MiB, which stays in cache while all lobes read it."""

# Nodes a face edge for a p99 error of 1e-3 on the hardest of the measured environments (studio, forest): the
# sharp term follows the lobe's width, the floor the kink of (n·l)₊ at the horizon, which rough lobes carry to
# full height. The error falls like n^-ORDER, so other tolerances scale n by (1e-3/tolerance)^(1/ORDER); at
# the kink like n^-2.
SHARP, MARGIN, FLOOR, KINK = 3.5, 12, 28, 44
LARGEST_GRID = 2048
GROWTH = 1.5
"""How much finer the grid of a level becomes when its certificate misses the tolerance: 1.5^4 ≈ 5 in error."""

UNIFORM = 299
"""Uniform texels of a certificate: the largest of 299 errors bounds the 99th percentile at 95 % confidence,
since .99^299 = .0495 (order statistic)."""

NEAR_BRIGHT = 64
"""Further texels, those nearest the brightest sources, where an error hides from a uniform draw."""


def precision_for(tolerance: float) -> int:
    """Working precision: float32 leaves up to 3e-5 on dark texels, so tight tolerances take float64."""
    return 64 if tolerance < 1e-4 else 32


@dataclass(frozen=True)
class LevelPlan:
    """One level: `size` texels a face edge, its roughness, and the grid and cuts that serve it.

    `grid` is the number of nodes a face edge of its anterpolated source, 0 where the level is the exact mean
    over each texel (roughness 0). `cuts` is the number of quadrature nodes a texel edge in its exact sum.
    """

    size: int
    roughness: float
    parameters: dict[str, float]
    grid: int
    cuts: int

    @property
    def outputs(self) -> int:
        return 6 * self.size**2

    @property
    def pairs(self) -> int:
        """Lobe evaluations of the convolution, those it may skip included in proportion to the near cap."""
        return pairs_of(self.outputs, self.grid, max(self.roughness**2, 1e-5))


def pairs_of(outputs: int, grid: int, alpha: float, horizon: float | None = None) -> int:
    """Lobe evaluations of `outputs` directions over a grid, as its split leaves them."""
    split = split_for(grid, alpha, horizon) if grid else None
    if split is None:
        return outputs * 6 * grid**2
    return int(outputs * 6 * (grid**2 * split.q1 / 4 + split.grid**2))


def grid_size(alpha: float, tolerance: float, horizon: float | None = None) -> int:
    """Nodes a face edge that a lobe of roughness α needs for a p99 texel error ≤ tolerance, a multiple of 8.

    `horizon` is the α whose kink where l sets is as hard as the lobe's, α itself for GGX.
    """
    horizon = alpha if horizon is None else horizon
    finer = (1e-3 / tolerance) ** (1 / ORDER)
    n = max((SHARP / max(alpha, 1e-9) + MARGIN) * finer, FLOOR * finer + KINK * horizon * finer**2)
    return min(max(8 * math.ceil(n / 8), 8), LARGEST_GRID)


SHARP_ENOUGH = 0.1
"""Lobes up to this α carry too little near the horizon for its kink to be seen."""

MOST_CUTS = 64
"""Where the search for converged reference nodes ends: 4096 nodes a texel."""


def cuts_for(texel: float, alpha: float, tolerance: float, share: float = 0.0) -> int:
    """Quadrature nodes a texel edge to begin with, so that integrating a lobe over a texel of angle `texel` errs
    less than tolerance/10.

    Midpoints (1) leave 1.3e-3·(texel/α/.34)² (measured: 1.3e-3 at .34); pairs of Gauss points in m cells an
    edge leave about 1.3e-3·(.02·texel/α/m/.34)·(texel/α/m/.34)³, which this bounds by its fourth power. The
    kink of (n·l)₊ costs a texel with `share` of all energy share·texel/(8 cuts²) where it sets; what a whole
    panel costs that sets at once no formula says: a certificate doubles the cuts until nothing changes.
    """
    x = texel / alpha / 0.34
    kink = math.sqrt(2.5 * share * texel / tolerance)
    if 1.3e-3 * x * x <= tolerance / 10 and kink <= 1:
        return 1
    cells = max(x * (5e-4 / tolerance) ** 0.25, kink / 2)
    return 2 * min(max(1, math.ceil(cells)), 512)


def cuts_error(texel: float, alpha: float, cuts: int) -> float:
    """What `cuts` nodes an edge leave of a smooth lobe, by the laws of `cuts_for`."""
    x = texel / alpha / 0.34
    return 1.3e-3 * x * x if cuts == 1 else 2.6e-5 * (2 * x / cuts) ** 4


def bright_cuts(texel: float, horizon: float, tolerance: float, share: float) -> int:
    """Nodes an edge of a bright texel that holds `share` of all energy, a power of two.

    Where it sets, the kink of (n·l)₊ costs share·texel/(8 cuts²) of the mean; texels a thousand times darker
    than the mean are held to the tolerance too, so the factor is 10³/8. Lobes with little at the `horizon` need none.
    """
    if horizon <= SHARP_ENOUGH:
        return 2
    wanted = max(horizon, 1.0) * math.sqrt(125 * share * texel / tolerance)
    return 2 ** min(max(1, math.ceil(math.log2(max(wanted, 1e-9)))), 9)


@dataclass(frozen=True)
class Split:
    """A lobe in two parts: within the squared chord q1 over the fine grid, beyond q0 over `grid` nodes an edge."""

    q0: float
    q1: float
    grid: int


NEAR_ANGLE, FAR_NODES = 0.62, 28.0
"""Where the near part of a lobe of 192 nodes ends, radians, and nodes × that angle of the far grid, for 1e-3:
measured to leave the error as it is at a quarter of the time."""


def split_for(n: int, alpha: float, horizon: float | None = None) -> Split | None:
    """How to part the work over an n × n grid, or None where the far part would cost as much as the whole.

    Near pairs grow with θ1², far ones with 1/θ1² since the far part is smooth on the scale θ1; the far grid
    must also carry the lobe's kink at the horizon. A finer n, for a tighter tolerance, refines both alike.
    """
    horizon = alpha if horizon is None else horizon
    sharp = SHARP / alpha + MARGIN
    theta = NEAR_ANGLE * math.sqrt(192 / sharp)
    if theta > 1.0:
        return None
    far = n / sharp * max(FAR_NODES / theta, FLOOR + KINK * horizon)
    far = 8 * math.ceil(far / 8)
    q1 = 2 - 2 * math.cos(theta)
    return Split(q1 / 16, q1, far) if far <= n / 2 else None


def plan_chain(chain: Chain, texel: float, share: float = 0.0) -> tuple[LevelPlan, ...]:
    """The levels of a chain for a source whose texels subtend `texel` radians and hold at most `share` of its
    energy each, bright ones apart."""
    levels = []
    for size, r in chain.levels:
        parameters = chain.parameters(r)
        alpha = max(r * r, 1e-5)
        levels.append(LevelPlan(size, r, parameters, 0 if r == 0 else grid_size(alpha, chain.tolerance),
                                1 if r == 0 else cuts_for(texel, alpha, chain.tolerance, share)))
    return tuple(levels)


def refined(level: LevelPlan) -> LevelPlan | None:
    """The same level on a finer grid, or None where the finest has been tried."""
    grid = min(8 * math.ceil(level.grid * GROWTH / 8), LARGEST_GRID)
    return None if grid <= level.grid else replace(level, grid=grid)
