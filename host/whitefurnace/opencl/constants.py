"""Constants that kernels and the host share. The host states them; kernel texts are given them as `#define` lines.

Each group below becomes one generated piece of a program's text (`opencl.source`), so a kernel file never repeats a
value. A changed constant changes the text and the digest of every program that uses it.
"""

from __future__ import annotations

from math import factorial

ORDER = 8
"""Points of the Lagrange stencil that interpolates between the nodes of an equiangular grid. A sharp lobe needs two
fifths of the nodes that it needs with 4 points at an error of 1e-3, and a quarter of them at 2e-5."""

BEYOND = 4
"""Nodes of an equiangular grid past each edge of a cube face, so that stencils are centred at the edges too."""

PATCH = 16
"""Gaps along an edge of the square blocks in which texels are anterpolated (`anterpolate.cl`)."""

TAPS = 9
"""Inputs of one output of the filter that turns texels into point masses (`anterpolate.cl`)."""

TILE_EDGE = 4
"""Source classes along an edge of a tile: the classes of a tile are summed or skipped together (`octahedral.cl`)."""

RUN_EDGE = 8
"""Source classes along an edge of a run: the kernel values of a run wait in cache while they are summed."""

TILE = TILE_EDGE**2
"""Source classes of a tile."""

RUN = RUN_EDGE**2
"""Source classes of a run, which holds whole tiles."""


def grid_defines() -> str:
    """Return the `#define` lines of equiangular grids: ORDER, BEYOND and LAGRANGE_FACTORS.

    The factors are 1/∏(a - b) over the other nodes b of the stencil, one for each node a, as C expressions.
    """
    factors = []
    for a in range(ORDER):
        rest = ORDER - 1 - a
        factors.append(f"{'-' if rest % 2 else ''}1 / (scalar){factorial(a) * factorial(rest)}")
    return f"#define ORDER {ORDER}\n#define BEYOND {BEYOND}\n#define LAGRANGE_FACTORS {', '.join(factors)}\n"


def anterpolation_defines() -> str:
    """Return the `#define` lines of `anterpolate.cl` beyond those of grids: PATCH and TAPS."""
    return f"#define PATCH {PATCH}\n#define TAPS {TAPS}\n"


def class_defines() -> str:
    """Return the `#define` lines of `octahedral.cl`: edges of tiles and runs, and the numbers of classes in them."""
    return f"#define TILE_EDGE {TILE_EDGE}\n#define RUN_EDGE {RUN_EDGE}\n#define TILE {TILE}\n#define RUN {RUN}\n"
