"""Draws the engine's picture, the full integral and their difference as a PNG."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.plot_style import colours_named, drawing


def draw_side_by_side(
    path: Path,
    pictures: Sequence[np.ndarray],
    difference: np.ndarray,
    scale: float,
    engine: str,
    caption: Sequence[str],
    stated: Mapping[str, str],
) -> None:
    """Draw the engine's picture, the truth and the map of their difference, one below the other where they are wide.

    pictures: two (h, w, 3) in [0, 1], shown pixel by pixel. difference: (h, w), NaN where there is none; its colours
    span -scale to scale. caption: lines below. stated: goes into the file's text. Raises the errors of `drawing`.
    """
    high, wide = difference.shape
    head, gap, bar, dpi = 34, 12, 84, 100
    below = wide > 1.5 * high
    columns, rows = (1, 3) if below else (3, 1)
    width = max(columns * wide + (columns + 1) * gap + bar, 460)
    # A letter of 9 points is 6.5 pixels wide on average.
    caption = [part for line in caption for part in textwrap.wrap(line, int((width - 2 * gap) / 6.5))]
    foot = 16 + 16 * len(caption)
    height = rows * (high + head) + gap + foot
    with drawing(path, dpi=dpi, size=(width / dpi, height / dpi), stated=stated) as figure:
        titles = (f"{engine}, from its files", "the full integral", "(engine - truth) / truth, luminance")
        for k, (title, shown) in enumerate(zip(titles, (*pictures, difference), strict=True)):
            left = gap + (0 if below else k * (wide + gap))
            top = (k + 1) * head + k * high if below else head
            axes = figure.add_axes((left / width, 1 - (top + high) / height, wide / width, high / height))
            axes.set_axis_off()
            options: dict[str, Any] = {"interpolation": "none", "aspect": "auto"}
            if k == 2:
                colours = colours_named("RdBu_r", bad="0.8")
                options |= {"cmap": colours, "vmin": -scale, "vmax": scale}
            image = axes.imshow(np.ma.masked_invalid(shown), **options)
            figure.text(left / width, 1 - (top - 9) / height, title, fontsize=11, color="0.15")
        inset = figure.add_axes(((left + wide + 10) / width, 1 - (top + high) / height, 14 / width, high / height))
        marks = np.linspace(-scale, scale, 5)
        marked = figure.colorbar(image, cax=inset, ticks=marks)
        marked.ax.set_yticklabels([f"{100 * x:+.3g} %" if x else "0" for x in marks], fontsize=9)
        marked.outline.set_visible(False)
        for k, line in enumerate(caption):
            figure.text(gap / width, (12 + 16 * (len(caption) - 1 - k)) / height, line, fontsize=9, color="0.35")
