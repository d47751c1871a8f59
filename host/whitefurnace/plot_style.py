"""The common style of all figures: panels laid out on a page and written as PNG.

Only this module imports matplotlib.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.errors import CheckError, FileError, InputError, UnsupportedError
from whitefurnace.files import write_atomic

# matplotlib is an optional dependency and slow to load: it is imported inside functions, and its types are Any here.
Figure = Any
Axes = Any

DPI = 120
STYLE: Any = {
    "font.family": "DejaVu Sans",  # comes with matplotlib and has all mathematical symbols in use
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.titlepad": 9,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "0.4",
    "axes.formatter.use_mathtext": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.8,
    "legend.frameon": False,
    "legend.fontsize": 10.5,
    "lines.linewidth": 2.0,
    "lines.solid_capstyle": "round",
    "xtick.color": "0.25",
    "ytick.color": "0.25",
}

# Colours of Okabe and Ito, which are distinct for every kind of colour vision.
GREEN, BLUE, RED = "#009E73", "#0072B2", "#D55E00"
RGB = {"red": RED, "green": GREEN, "blue": BLUE}


def require() -> None:
    """Raise UnsupportedError where matplotlib is not installed."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise UnsupportedError('figures need matplotlib: pip install "whitefurnace[plot]"') from None


@contextlib.contextmanager
def drawing(
    path: Path,
    *,
    dpi: int | None = None,
    size: tuple[float, float] | None = None,
    stated: Mapping[str, str] | None = None,
) -> Iterator[Figure]:
    """Yield an empty figure in the common style, and write it to `path` as PNG when the block ends.

    The same drawing gives the same bytes; the matplotlibrc of the machine is ignored.
    dpi: dots per inch, DPI by default. size: width and height in inches. stated: texts that are stored in the file.
    Raises UnsupportedError without matplotlib, and FileError where the folder or the file cannot be written.
    """
    require()
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    dpi = dpi or DPI
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"cannot make {path.parent}: {error.strerror or error}") from error
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        figure = Figure(figsize=size, dpi=dpi, facecolor="white")
        FigureCanvasAgg(figure)
        yield figure
        # matplotlib would store its version under `Software`.
        texts = {**(stated or {}), "Software": None}
        write_atomic(path, partial(figure.savefig, format="png", dpi=dpi, metadata=texts))


def logarithmic_scale(low: float, high: float) -> Any:
    """Return a logarithmic colour scale from `low` to `high`."""
    from matplotlib.colors import LogNorm

    return LogNorm(low, high)


def linear_scale(low: float, high: float) -> Any:
    """Return a linear colour scale from `low` to `high`."""
    from matplotlib.colors import Normalize

    return Normalize(low, high)


def colours_named(name: str, **extremes: Any) -> Any:
    """Return the matplotlib colour map `name`; `extremes` are its colours for values under, over or bad."""
    import matplotlib

    found = matplotlib.colormaps[name]
    return found.with_extremes(**extremes) if extremes else found


def seconds_axis(axis: Any) -> None:
    """Set the ticks of a logarithmic axis of times: several ticks a decade where the axis spans one or two."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = axis.get_view_interval()
    steps = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if high < 8 * low else (1.0, 2.0, 5.0) if high < 200 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=steps))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def number_label(value: float) -> str:
    """Return the text of a number for a label: three digits, or a power of ten such as 10⁻³."""
    power = round(math.log10(abs(value))) if value else 0
    if abs(power) >= 3 and math.isclose(value, 10.0**power):
        return "10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{value:.3g}".replace("-", "−")


def small_label(value: float) -> str:
    """Return the text of a small number for a label, such as 1.2×10⁻³."""
    mantissa, _, power = f"{value:.1e}".partition("e")
    superscript = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa}×10{superscript}" if value else "0"


def shades(count: int) -> list[Any]:
    """Return `count` colours from dark to light, none too light for a white page."""
    import matplotlib

    return [matplotlib.colormaps["viridis"](x) for x in np.linspace(0.0, 0.86, count)] if count > 1 else [BLUE]


@dataclass(frozen=True)
class Panel:
    """One set of axes on a page.

    paint  the function that draws on the axes
    width  width of the axes, inches
    after  space right of the axes for a legend or a colour bar, inches
    polar  first and last angle of polar axes, degrees; None for Cartesian axes
    """

    paint: Callable[[Axes], None]
    width: float
    after: float = 0.3
    polar: tuple[int, int] | None = None


Page = Sequence[tuple[float, Sequence[Panel]]]
"""Rows of panels, each with its height in inches."""

HEAD, ABOVE, BELOW, LEFT = 0.75, 0.5, 0.65, 0.87
LEAST = 10.0  # least width of a page, inches: room for the heading


def lay_out(figure: Figure, page: Page) -> None:
    """Place every panel on the figure, in inches, and paint it.

    Positions do not depend on the size of labels, so the axes of a row have the same height.
    """
    width = max(LEAST, *(sum(LEFT + p.width + p.after for p in row) for _, row in page))
    height = HEAD + sum(ABOVE + h + BELOW for h, _ in page)
    figure.set_size_inches(width, height)
    top = height - HEAD
    for high, row in page:
        x = 0.0
        for panel in row:
            low, tall = top - ABOVE - high, high
            if panel.polar and panel.polar[0] < 0:  # a half disc lies across the middle of its square
                low, tall = low - high / 2, 2 * high
            box = ((x + LEFT) / width, low / height, panel.width / width, tall / height)
            x += LEFT + panel.width + panel.after
            _try(figure.add_axes(box) if panel.polar is None else _polar(figure, box, *panel.polar), panel.paint)
        top -= ABOVE + high + BELOW


def heading(figure: Figure, title: str, said: str, colour: str) -> None:
    """Write the title of a page, and the line `said` under it in the colour `colour`."""
    width, height = figure.get_size_inches()
    figure.text(0.25 / width, 1 - 0.2 / height, title, fontsize=18, fontweight="bold", va="top")
    figure.text(0.25 / width, 1 - 0.57 / height, said, fontsize=11, va="top", color=colour)


def add_legend(axes: Axes, title: str = "", inside: str | tuple[float, float] | None = None) -> None:
    """Add a legend right of the axes, or at `inside` in the axes, where the caller knows of free space."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        inch = axes.figure.dpi / axes.bbox.width
        place: dict[str, Any] = (
            {"loc": inside}
            if inside
            else {
                "loc": "upper left",
                "borderaxespad": 0,
                # Half a disc ends at .75 of the height.
                "bbox_to_anchor": (1 + 0.12 * inch, 0.75 if axes.name == "polar" else 1.0),
            }
        )
        legend = axes.legend(handles, labels, title=title or None, alignment="left", **place)
        legend.get_title().set_color("0.35")


def _try(axes: Axes, paint: Callable[[Axes], None]) -> None:
    """Paint a panel, or write the reason where the model does not support it, so that the other panels are drawn."""
    try:
        paint(axes)
    except (UnsupportedError, InputError, CheckError) as error:
        from textwrap import fill

        axes.clear()
        axes.set_axis_off()
        axes.text(0.5, 0.5, fill(str(error), 38), ha="center", va="center", color="0.35", transform=axes.transAxes)


def _polar(figure: Figure, box: tuple[float, ...], low: int, high: int) -> Axes:
    axes = figure.add_axes(box, projection="polar")
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_thetamin(low)
    axes.set_thetamax(high)
    axes.set_thetagrids(range(low, high + 1, 30), [f"{t}°".replace("-", "−") for t in range(low, high + 1, 30)])
    axes.tick_params(labelsize=9.5)
    axes.spines["polar"].set_color("0.6")
    return axes


def colour_bar(figure: Figure, axes: Axes, mesh: Any, label: str = "", **options: Any) -> None:
    """Add a colour bar right of the axes of `mesh`."""
    inch = figure.dpi / axes.bbox.width
    bar = figure.colorbar(mesh, cax=axes.inset_axes([1 + 0.1 * inch, 0, 0.14 * inch, 1]), label=label, **options)
    bar.outline.set_visible(False)
    bar.ax.minorticks_off()
