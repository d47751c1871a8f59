"""Recipe and source -> the work: source grids, cuts of texels, launches, bytes; chosen by the tolerance."""
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
# full height. The error falls like n^-ORDER, so other tolerances scale n by (1e-3/tolerance)^(1/ORDER).
SHARP, MARGIN, FLOOR, KINK = 2.75, 12, 28, 26
LARGEST_GRID = 2048
GROWTH = 1.5
"""How much finer the grid of a level becomes when its certificate misses the tolerance: 1.5^4 ≈ 5 in error."""

UNIFORM = 299
"""Uniform texels of a certificate: the largest of 299 errors bounds the 99th percentile at 95 % confidence,
since .99^299 = .0495 (order statistic)."""

NEAR_BRIGHT = 64
"""Further texels, those nearest the brightest sources, where an error hides from a uniform draw."""


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
        """Lobe evaluations of the convolution."""
        return self.outputs * 6 * self.grid**2


def grid_size(alpha: float, tolerance: float) -> int:
    """Nodes a face edge that a lobe of roughness α needs for a p99 texel error ≤ tolerance, a multiple of 8."""
    finer = (1e-3 / tolerance) ** (1 / ORDER)
    n = max(SHARP / max(alpha, 1e-9) + MARGIN, FLOOR + KINK * alpha) * finer
    return min(max(8 * math.ceil(n / 8), 8), LARGEST_GRID)


def cuts_for(texel: float, alpha: float, tolerance: float) -> int:
    """Quadrature nodes a texel edge so that integrating a lobe over a texel of angle `texel` errs < tolerance/10.

    Midpoints (1) leave 1.3e-3·(texel/α/.34)² (measured: 1.3e-3 at .34); pairs of Gauss points in m cells an
    edge leave about 1.3e-3·(.02·texel/α/m/.34)·(texel/α/m/.34)³, which this bounds by its fourth power.
    """
    x = texel / alpha / 0.34
    if 1.3e-3 * x * x <= tolerance / 20:
        return 1
    cells = x * (5e-4 / tolerance) ** 0.25
    return 2 * min(max(1, math.ceil(cells)), 512)


def plan_chain(chain: Chain, texel: float) -> tuple[LevelPlan, ...]:
    """The levels of a chain for a source whose texels subtend `texel` radians."""
    levels = []
    for size, r in chain.levels:
        parameters = chain.parameters(r)
        alpha = max(r * r, 1e-5)
        levels.append(LevelPlan(size, r, parameters, 0 if r == 0 else grid_size(alpha, chain.tolerance),
                                1 if r == 0 else cuts_for(texel, alpha, chain.tolerance)))
    return tuple(levels)


def refined(level: LevelPlan) -> LevelPlan | None:
    """The same level on a finer grid, or None where the finest has been tried."""
    grid = min(8 * math.ceil(level.grid * GROWTH / 8), LARGEST_GRID)
    return None if grid <= level.grid else replace(level, grid=grid)
