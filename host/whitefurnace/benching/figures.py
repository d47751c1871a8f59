"""Draws error against time of the prefilter as a PNG."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from whitefurnace.opencl.device import Device
from whitefurnace.plot_style import (
    BLUE,
    RED,
    Axes,
    Panel,
    add_legend,
    drawing,
    heading,
    lay_out,
    seconds_axis,
)

if TYPE_CHECKING:
    from whitefurnace.benching.tradeoff import Cost, Point


def draw_tradeoff(folder: Path, points: Sequence[Point], costs: Sequence[Cost], device: Device) -> Path:
    """Draw error against seconds for each environment with its Pareto front, then the costs, into
    `folder`/tradeoff.png.

    Returns the file's path. Raises the errors of `drawing`.
    """
    from whitefurnace.benching.tradeoff import COST_TOLERANCE

    names = list(dict.fromkeys(p.environment for p in points))
    panels = [Panel(partial(_tradeoff, [p for p in points if p.environment == name]), 5.4) for name in names]
    page = [(3.8, panels[k : k + 2]) for k in range(0, len(panels), 2)]
    varied = list(dict.fromkeys(c.over for c in costs))
    if varied:
        page.append((2.6, [Panel(partial(_cost, [c for c in costs if c.over == over]), 3.3) for over in varied]))
    path = folder / "tradeoff.png"
    with drawing(path) as figure:
        lay_out(figure, page)
        whose = f"  ·  cost at a tolerance of {COST_TOLERANCE:g} on {costs[0].environment}" if costs else ""
        heading(
            figure, "Prefilter: error against time", f"specular chain on {device.identity()['name']}{whose}", "0.35"
        )
    return path


def _tradeoff(points: Sequence[Point], axes: Axes) -> None:
    best = sorted((p.seconds.median, p.error) for p in points if p.front)
    if best:
        # The error of a point on the front is reached in its time and in all longer ones.
        x, y = (np.array(v) for v in zip(*best, strict=True))
        last = max(p.seconds.high for p in points)
        axes.step(
            np.append(x, last),
            np.append(y, y[-1]),
            where="post",
            color="0.85",
            linewidth=6,
            zorder=1,
            label="Pareto front",
        )
    for method, colour, mark in (("tolerance", BLUE, "o"), ("samples", RED, "s")):
        some = [p for p in points if p.method == method]
        if some:
            x = np.array([p.seconds.median for p in some])
            spread = np.array([[p.seconds.median - p.seconds.low, p.seconds.high - p.seconds.median] for p in some]).T
            axes.errorbar(
                x,
                [p.error for p in some],
                xerr=spread,
                color=colour,
                marker=mark,
                elinewidth=1,
                linewidth=1.2,
                label=method,
            )
        for p in some:
            axes.annotate(
                p.label,
                (p.seconds.median, p.error),
                xytext=(5, 5),
                textcoords="offset points",
                fontsize=8.5,
                color="0.3",
            )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="seconds, from texels to levels",
        ylabel="stated error of the worst level",
        title=points[0].environment,
    )
    axes.margins(0.12)
    seconds_axis(axes.xaxis)
    add_legend(axes, inside="upper right")


COST_LABELS = {
    "output size": ("output size", "face edge of level 0"),
    "source rows": ("source size", "rows of the source"),
    "alpha": ("α", "α of one level"),
}


def _cost(costs: Sequence[Cost], axes: Axes) -> None:
    x = [c.value for c in costs]
    axes.fill_between(
        x, [c.seconds.low for c in costs], [c.seconds.high for c in costs], color=BLUE, alpha=0.2, linewidth=0
    )
    axes.plot(x, [c.seconds.median for c in costs], color=BLUE, marker="o", markersize=5)
    title, label = COST_LABELS[costs[0].over]
    axes.set(xscale="log", yscale="log", xlabel=label, ylabel="seconds", title=f"Cost over {title}")
    if costs[0].over != "alpha":
        axes.set_xticks(x, [f"{v:g}" for v in x], minor=False)
        axes.set_xticks([], minor=True)
    seconds_axis(axes.yaxis)
