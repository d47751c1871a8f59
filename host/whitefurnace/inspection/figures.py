"""Draws maps of the errors of one file against another, as PNG."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from whitefurnace.plot_style import (
    RED,
    Axes,
    Figure,
    Panel,
    colour_bar,
    colours_named,
    drawing,
    heading,
    lay_out,
    logarithmic_scale,
    small_label,
)

if TYPE_CHECKING:
    from whitefurnace.inspection.comparison import Comparison
    from whitefurnace.inspection.comparison import Row as Compared

CROSS = ((1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (1, 3))
"""Row and column of the faces +X -X +Y -Y +Z -Z in a horizontal cross (environments.LAYOUTS)."""


def draw_comparison(folder: Path, found: Comparison) -> Path:
    """Draw `folder`/compare.png: a map of the errors of each level and of each channel of a table.

    Cubes are drawn as crosses. Returns the path. Raises the errors of `plot_style.drawing`.
    """
    # All maps of one kind have the same colour scale: five decades down from the largest error.
    shown = [row for row in found.rows if row.errors is not None]
    largest = {
        kind: max((row.worst for row in shown if row.kind == kind and math.isfinite(row.worst)), default=1.0)
        for kind in ("level", "table")
    }
    path = folder / "compare.png"
    with drawing(path) as figure:
        panels = [Panel(partial(_error_map, figure, row, largest[row.kind] or 1.0), 4.6, after=0.5) for row in shown]
        lay_out(figure, [(3.45, panels[k : k + 2]) for k in range(0, len(panels), 2)])
        heading(figure, "Errors of A against B", f"{found.a.path.name}  against  {found.b.path.name}", "0.35")
    return path


def _error_map(figure: Figure, row: Compared, largest: float, axes: Axes) -> None:
    errors = np.asarray(row.errors, np.float64)
    if errors.ndim == 3 and errors.shape[0] == 6 and row.kind == "level":
        n = errors.shape[1]
        flat = np.full((3 * n, 4 * n), np.nan)
        for face, (down, across) in zip(errors, CROSS, strict=True):
            flat[down * n : (down + 1) * n, across * n : (across + 1) * n] = face
    else:
        flat = errors.reshape(-1, errors.shape[-1])
    colours = colours_named("cividis")
    colours = colours.with_extremes(bad=(1, 1, 1, 0), under=colours(0.0), over=RED)
    axes.grid(False)
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(False)
    flat = np.clip(flat, 1e-300, 1e300)  # keeps the logarithm finite for 0 and for infinite errors
    image = axes.imshow(
        np.ma.masked_invalid(flat),
        cmap=colours,
        norm=logarithmic_scale(1e-5 * largest, largest),
        interpolation="nearest",
    )
    roughness = "" if row.roughness is None else f", r = {row.roughness:.3g}"
    axes.set_title(
        f"{row.part}, {row.size}{roughness}: {small_label(row.error)}, worst {small_label(row.worst)}"
        if math.isfinite(row.worst)
        else f"{row.part}, {row.size}{roughness}: red is not finite"
    )
    colour_bar(figure, axes, image, extend="both")
