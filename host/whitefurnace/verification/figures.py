"""Figures of models as PNG files: shapes, masking, albedo, Fresnel curves and maps of float32's error.

Every value comes from the device, as users get it, and is compared with the float64 reference of the catalogue.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from whitefurnace.catalogue import Model, Parameter, model
from whitefurnace.errors import UnsupportedError
from whitefurnace.integrals.quadrature import integrate
from whitefurnace.opencl.derived import Areas, numbers_of
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import evaluate
from whitefurnace.plot_style import (
    BLUE,
    RED,
    RGB,
    Axes,
    Figure,
    Page,
    Panel,
    add_legend,
    colour_bar,
    colours_named,
    drawing,
    heading,
    lay_out,
    linear_scale,
    logarithmic_scale,
    number_label,
    shades,
    small_label,
)

if TYPE_CHECKING:
    from whitefurnace.verification.checks import Row

Numbers = Mapping[str, Any]

TOLERANCE = 1e-5  # of the curves: less than a line is wide

FINEST, COARSEST = 1e-8, 1e-5  # range of the colours of an error map: around a rounding of float32, 6e-8

GUESSES = (0.1, 0.2, 0.4, 0.8)  # values of a user's parameters where the rows have none: plausible ones of a roughness

SLOPES = ((0.2, 0.2), (0.4, 0.1), (0.6, 0.03))

SMITH, RIVAL, FACETS, SCHLICK, EXACT = "smith", "smith_separable", "ggx", "schlick", "dielectric"

LIGHTS = (0, 45, 75)  # degrees

SLOT_TITLES = {"ndf": "NDF", "masking": "Masking", "fresnel": "Fresnel", "diffuse": "Diffuse", "brdf": "BRDF"}


def draw(folder: Path, models: Sequence[Model], rows: Sequence[Row], device: Device) -> list[Path]:
    """Draw a PNG `folder`/SLOT_NAME.png for each model of a slot that has a figure, and return the paths in order.

    rows: give each figure its verdict and a user's model its parameters. The same models, rows and device give the same
    bytes. Raises UnsupportedError without matplotlib, and FileError where the folder cannot be written.
    """
    written: list[Path] = []
    for entry in models:
        if entry.slot not in _FIGURES:
            continue
        own = [row for row in rows if row.slot == entry.slot and _of(row.model, entry)]
        path = _free(folder / f"{entry.slot}_{entry.name}.png", written)
        with drawing(path) as figure:
            sheet = _Sheet(figure, entry, _values(entry, own), device)
            lay_out(figure, _FIGURES[entry.slot](sheet))
            _heading(sheet, own)
        written.append(path)
    return written


@dataclass(frozen=True)
class _Sheet:
    """The model of a figure, with the values to show of each parameter."""

    figure: Figure
    entry: Model
    values: Mapping[str, tuple[float, ...]]
    device: Device

    def usual(self) -> dict[str, Any]:
        """Return a middling value of each parameter."""
        defaults = {p.name: p.default for p in self.entry.parameters if p.default is not None}
        if self.entry.slot == "diffuse":  # white and at its least like Lambert
            return {name: values[-1] for name, values in self.values.items()} | defaults
        return {name: values[len(values) // 2] for name, values in self.values.items()} | defaults

    def families(self) -> list[_Family]:
        """Return a family for each parameter that is worth varying; one without a name where there is none."""
        usual = self.usual()
        found = [
            _Family(p, self.values[p.name], {k: v for k, v in usual.items() if k != p.name})
            for p in self.entry.parameters
            if len(self.values[p.name]) > 1
        ]
        return found or [_Family(None, (0.0,), usual)]


@dataclass(frozen=True)
class _Family:
    """Curves for several values of one parameter, with the others fixed."""

    parameter: Parameter | None
    values: tuple[float, ...]
    held: Mapping[str, float]

    def numbers(self, values: Any) -> dict[str, Any]:
        """Return all parameters by name, the varied one at `values`."""
        own = {} if self.parameter is None else {self.parameter.name: values}
        return {**self.held, **own}

    def rows(self, values: Any) -> np.ndarray:
        """Return values as (curves, x), also for a family without a parameter."""
        return np.atleast_2d(np.asarray(values, np.float64))

    @property
    def columns(self) -> dict[str, Any]:
        """Return the parameters with the family along the first of two axes."""
        return self.numbers(np.array(self.values)[:, None])

    def labels(self, entry: Model) -> list[str]:
        """Return the label of each curve."""
        if self.parameter is None:
            return [self._held(entry) or entry.name]
        return [f"{_symbol(self.parameter)} = {number_label(v)}" for v in self.values]

    def caption(self, entry: Model) -> str:
        """Return the parameters that are held, for the head of the legend."""
        return "" if self.parameter is None else self._held(entry)

    def _held(self, entry: Model) -> str:
        symbols = {p.name: _symbol(p) for p in entry.parameters}
        return ", ".join(f"{symbols[name]} = {number_label(v)}" for name, v in self.held.items())


def _of(label: str, entry: Model) -> bool:
    """Return whether a row's label, NAME or FILE.clh with parameters after a colon, names this model."""
    name = entry.path or entry.name
    return label == name or label.startswith(f"{name}:")


def _values(entry: Model, rows: Sequence[Row]) -> dict[str, tuple[float, ...]]:
    """Return values of each parameter to show: its typical values, else those of the rows, else guesses."""
    found = {}
    for p in entry.parameters:
        # Six digits: of one value there are rows as float32 has it and as float64 does.
        seen = [float(f"{row.parameters[p.name]:.6g}") for row in rows if p.name in row.parameters]
        values = sorted(set(p.typical or seen or GUESSES))
        found[p.name] = tuple(values[round(k)] for k in np.linspace(0, len(values) - 1, min(len(values), 7)))
    return found


def _free(path: Path, taken: Iterable[Path]) -> Path:
    """Return `path`, with a number where an earlier model has the same slot and name, such as a user's and ours."""
    names, number = {p.name for p in taken}, 1
    free = path
    while free.name in names:
        number += 1
        free = path.with_stem(f"{path.stem}_{number}")
    return free


def _evaluate(
    device: Device,
    function: str,
    slots: Mapping[str, Model],
    own: Sequence[Any],
    numbers: Mapping[str, Numbers],
    precision: int = 32,
) -> np.ndarray:
    """Evaluate a model function at its own arguments and the parameters of each slot, all broadcast, as float64; RGB
    first.
    """
    columns = [*own, *(numbers[slot][p.name] for slot, m in slots.items() for p in m.parameters)]
    arrays = np.broadcast_arrays(*(np.asarray(c, np.float64) for c in columns))
    shape = arrays[0].shape
    flat = np.array([a.ravel() for a in arrays])
    read, terms, cells = len(own), 0, [flat[: len(own)]]
    for slot, entry in slots.items():
        count = len(entry.parameters)
        cells.append(numbers_of(device, entry, flat[read : read + count]))
        read += count
        if slot == "ndf" and "NDF_AREA" not in entry.provides and len(slots) > 1:
            table = Areas(device, entry, precision).table(cells[-1])
            terms, area = table.length, table.rows
    if terms:
        cells.append(area)
    out = evaluate(device, function, slots, np.concatenate(cells), precision, terms).astype(np.float64)
    return out.reshape(shape) if len(out) == 1 else out.reshape(len(out), *shape)


def _rounded(values: Any) -> np.ndarray:
    """Return values rounded to float32, since an error map is of the kernel and not of its input."""
    return np.asarray(values, np.float32).astype(np.float64)


def _towards(theta: Any, phi: Any = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The direction at polar angles, in the local frame."""
    theta, phi = np.broadcast_arrays(np.asarray(theta, np.float64), np.asarray(phi, np.float64))
    return np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)


def _axis(parameter: Parameter, values: Sequence[float], count: int) -> tuple[np.ndarray, bool]:
    """Return values over a parameter's domain, and whether they are logarithmic; a user's parameter has only those
    shown.
    """
    low, high = (parameter.low, parameter.high) if parameter.typical else (values[0], values[-1])
    least = low if low > 0 else min((v for v in values if v > 0), default=1.0)
    if low >= 0 and high >= 50 * least and (low > 0 or high >= 1e3 * least):
        return np.geomspace(least, high, count), True
    return np.linspace(low, high, count), False


COSINES = np.sin(np.linspace(0.02, math.pi / 2, 97)) ** 2
"""n·v of the curves: more of them at both ends."""


def _symbol(parameter: Parameter) -> str:
    """Return a parameter's symbol, with the letters after the first of a short one as a subscript: αx, F82."""
    short = re.fullmatch(r"([^\W\d_])([xy]|\d+)", parameter.symbol)
    return rf"$\mathrm{{{short[1]}}}_{{\mathrm{{{short[2]}}}}}$" if short else parameter.symbol


def _heading(sheet: _Sheet, rows: Sequence[Row]) -> None:
    figure, entry = sheet.figure, sheet.entry
    failed = sorted({row.check for row in rows if not row.passed})
    said = [
        SLOT_TITLES[entry.slot],
        f"[{entry.citation.key}]" if entry.citation.key else "",
        f"float32 on {sheet.device.identity()['name']}",
    ]
    if rows:
        said.append(
            f"{sum(row.passed for row in rows)} of {len(rows)} checks passed"
            + (f", failed: {', '.join(failed[:2])}{' …' if len(failed) > 2 else ''}" if failed else "")
        )
    title = entry.title if entry.text is None else f"{entry.name}, {entry.title}"
    heading(figure, title, "  ·  ".join(filter(None, said)), RED if failed else "0.35")


def _degrees(axes: Axes, low: float = 0, high: float = 90, step: float = 15, label: str = "θ (degrees)") -> None:
    axes.set_xlim(low, high)
    axes.set_xticks(np.arange(low, high + 1, step))
    axes.set_xlabel(label)


def _cosine_axis(axes: Axes) -> None:
    axes.set_xlim(0, 1)
    axes.set_xlabel("n·v  (0 grazing, 1 normal)")


def _map(figure: Figure, axes: Axes, x: np.ndarray, y: np.ndarray, error: np.ndarray) -> None:
    """Draw a map of errors in the colours that all maps share; grey where there is nothing to compare."""
    colours = colours_named("cividis")
    colours = colours.with_extremes(under=colours(0.0))
    axes.set_facecolor("0.85")
    axes.grid(False)
    mesh = axes.pcolormesh(
        x,
        y,
        np.ma.masked_invalid(np.maximum(error, 1e-300)),
        cmap=colours,
        shading="nearest",
        norm=logarithmic_scale(FINEST, COARSEST),
        rasterized=True,
    )
    colour_bar(figure, axes, mesh, extend="both")


def _largest(error: np.ndarray) -> str:
    return f"at most {small_label(float(np.nanmax(error)))}" if np.isfinite(error).any() else "nothing to compare"


def _ndf(sheet: _Sheet) -> Page:
    """Draw a row of panels for each parameter (D twice, G1, E), and below them the errors of float32."""
    if not sheet.entry.isotropic:
        return _anisotropic(sheet)
    families = sheet.families()[:3]
    mapped = families[:2]
    wide = 7.6 if len(mapped) == 1 else 2.9
    maps = [
        panel
        for family in mapped
        for panel in (
            Panel(partial(_ndf_error, sheet, family), wide, 0.95),
            Panel(partial(_furnace_error, sheet, family), wide, 0.95),
        )
    ]
    return [*((3.1, _ndf_row(sheet, family)) for family in families), (2.9, maps)]


def _ndf_row(sheet: _Sheet, family: _Family) -> list[Panel]:
    entry, device = sheet.entry, sheet.device
    labels, colours = family.labels(entry), shades(len(family.values))

    def shape(axes: Axes) -> None:
        theta = np.radians(np.concatenate([np.geomspace(1e-3, 60, 260), np.linspace(60.5, 89.999, 90)]))
        D = family.rows(
            _evaluate(device, "NDF_D", {"ndf": entry}, [np.cos(theta), np.sin(theta) ** 2], {"ndf": family.columns})
        )
        for values, colour, label in zip(D, colours, labels, strict=True):
            axes.loglog(np.degrees(theta), np.where(values > 0, values, np.nan), color=colour, label=label)
        axes.set(title="D, both axes logarithmic_scale", xlabel="θ (degrees)", ylabel="D (1/sr)", xlim=(1e-3, 90))
        top = float(D.max())
        axes.set_ylim(max(min(1e-6, top * 1e-6), float(np.min(D[D > 0], initial=top)) / 2), top * 4)
        axes.set_xticks([1e-3, 1e-2, 0.1, 1, 10, 90], ["0.001", "0.01", "0.1", "1", "10", "90"])
        axes.minorticks_off()

    def lobe(axes: Axes) -> None:
        theta = np.radians(np.concatenate([np.geomspace(1e-3, 10, 200), np.linspace(10.1, 89.999, 320)]))
        D = family.rows(
            _evaluate(device, "NDF_D", {"ndf": entry}, [np.cos(theta), np.sin(theta) ** 2], {"ndf": family.columns})
        )
        for values, colour in zip(D, colours, strict=True):
            axes.plot(theta, values / values.max(), color=colour)
        axes.set_ylim(0, 1.02)
        axes.set_rgrids([0.25, 0.5, 0.75, 1], ["", "0.5", "", "1"])
        axes.set_title("D / its peak, over θ", x=0.1, y=1.0)  # next to the label of 0°

    def masking(axes: Axes) -> None:
        slots = {"ndf": entry, "masking": model("masking", SMITH)}
        numbers = {"ndf": family.columns, "masking": {}}
        at = _evaluate(device, "MASKING_AT", slots, [COSINES], numbers)
        G1 = _evaluate(device, "MASKING_G1", slots, [COSINES, at], numbers)
        for values, colour in zip(family.rows(G1), colours, strict=True):
            axes.plot(COSINES, values, color=colour)
        axes.set(title="Masking $G_1$, Smith", ylim=(0, 1.03), ylabel="$G_1$")
        _cosine_axis(axes)

    def albedo(axes: Axes) -> None:
        E = integrate("albedo", ndf=entry, NoV=COSINES, tolerance=TOLERANCE, device=device, **family.columns).values
        for values, colour, label in zip(family.rows(E), colours, labels, strict=True):
            axes.plot(COSINES, values, color=colour, label=label)
        axes.set(title="Directional albedo, Smith, F = 1", ylim=(0, 1.03), ylabel="E")
        _cosine_axis(axes)
        add_legend(axes, family.caption(entry))

    room = max(1.45, 0.75 + 0.09 * max(len(text) for text in (*labels, family.caption(entry))))
    return [Panel(shape, 3.7), Panel(lobe, 3.1, polar=(0, 90)), Panel(masking, 3.2), Panel(albedo, 3.2, room)]


def _float64(sheet: _Sheet, cos_m: np.ndarray, sin2_m: np.ndarray, theta: np.ndarray, numbers: Numbers) -> np.ndarray:
    """Return D to compare float32's with: the reference, or a user's own text in float64."""
    if "D" in sheet.entry.reference:
        with np.errstate(all="ignore"):
            return np.asarray(sheet.entry.reference["D"](theta, **numbers), np.float64)
    if not sheet.device.fp64:
        raise UnsupportedError(f"{sheet.device.identity()['name']} has no float64 to compare with")
    return _evaluate(sheet.device, "NDF_D", {"ndf": sheet.entry}, [cos_m, sin2_m], {"ndf": numbers}, 64)


def _ndf_error(sheet: _Sheet, family: _Family, axes: Axes) -> None:
    # cos θ and sin²θ as float32 has them, the angle from the one of them that tells it better.
    theta = np.radians(np.concatenate([np.geomspace(1e-3, 10, 90), np.linspace(10.5, 89.9, 90)]))
    small = theta < math.pi / 4
    sin2 = np.where(small, _rounded(np.sin(theta) ** 2), 1 - _rounded(np.cos(theta)) ** 2)
    cosine = np.where(small, np.sqrt(1 - sin2), _rounded(np.cos(theta)))
    angle = np.where(small, np.arcsin(np.sqrt(sin2)), np.arccos(cosine))

    def error(values: np.ndarray) -> np.ndarray:
        numbers = family.numbers(_rounded(values)[:, None])
        numbers = {name: _rounded(v) for name, v in numbers.items()}
        got = family.rows(_evaluate(sheet.device, "NDF_D", {"ndf": sheet.entry}, [cosine, sin2], {"ndf": numbers}))
        want = np.broadcast_to(_float64(sheet, cosine, sin2, angle, numbers), got.shape)
        peak = want.max(1, keepdims=True)
        # float32 ends at 1e-38, and a factor of D before D: nothing to compare.
        with np.errstate(all="ignore"):
            return np.where(want > np.maximum(1e-30 * peak, 1e-30), np.abs(got / want - 1), np.nan)

    ticks = [1e-3, 0.1, 1, 10, 90], ["0.001", "0.1", "1", "10", "90"]
    _error_panel(sheet, family, axes, np.degrees(theta), error, "Relative error of D", True)
    axes.set(xlim=(1e-3, 90), xlabel="θ (degrees)")
    axes.set_xticks(*ticks)
    axes.minorticks_off()


def _furnace_error(sheet: _Sheet, family: _Family, axes: Axes) -> None:
    NoV = np.geomspace(1e-3, 1, 48)

    def error(values: np.ndarray) -> np.ndarray:
        got = integrate(
            "weak_furnace", ndf=sheet.entry, NoV=NoV, device=sheet.device, **family.numbers(values[:, None])
        ).values
        return np.abs(family.rows(got) - 1)

    _error_panel(sheet, family, axes, NoV, error, "Weak white furnace less 1", True)
    axes.set(xlim=(1e-3, 1), xlabel="n·v")


def _error_panel(
    sheet: _Sheet,
    family: _Family,
    axes: Axes,
    x: np.ndarray,
    error: Callable[[np.ndarray], np.ndarray],
    what: str,
    log: bool,
) -> None:
    """Draw a map over x and the family's parameter, or lines where that has a single value."""
    p = family.parameter
    if p is None:
        values = error(np.array(family.values))
        axes.plot(x, np.maximum(values[0], 1e-9), ".", color=BLUE)
        axes.set(yscale="log", ylim=(1e-9, max(COARSEST, 2 * float(np.nanmax(values)))), ylabel="error")
    else:
        y, log_y = _axis(p, family.values, 56)
        values = error(y)
        _map(sheet.figure, axes, x, y, values)
        axes.set(
            yscale="log" if log_y else "linear",
            ylim=(y[0], y[-1]),
            ylabel=_symbol(p) + ("" if p.unit in ("", "1") else f" ({p.unit})"),
        )
    if log:
        axes.set_xscale("log")
    axes.set_title(f"{what}: {_largest(values)}", fontsize=11)


def _anisotropic(sheet: _Sheet) -> Page:
    """D over slopes for three pairs of roughness; G1 and E by azimuth; errors by azimuth."""
    figure, entry, device = sheet.figure, sheet.entry, sheet.device
    names = [p.name for p in entry.parameters]
    symbols = [_symbol(p) for p in entry.parameters]
    usual = sheet.usual()
    sets = [{**usual, **dict(zip(names, pair, strict=False))} for pair in SLOPES]

    def caption(numbers: Numbers) -> str:
        return ", ".join(f"{s} = {number_label(numbers[n])}" for s, n in zip(symbols, names, strict=True))

    slope = np.linspace(-1, 1, 241)
    x, y = np.meshgrid(slope, slope)
    long = np.sqrt(1 + x * x + y * y)

    def slopes(numbers: Numbers, last: bool, axes: Axes) -> None:
        D = _evaluate(device, "NDF_D", {"ndf": entry}, [-x / long, -y / long, 1 / long], {"ndf": numbers})
        share = np.maximum(D / D.max(), 1e-30)
        mesh = axes.pcolormesh(
            slope, slope, share, cmap="inferno", norm=logarithmic_scale(1e-5, 1), shading="nearest", rasterized=True
        )
        axes.contour(slope, slope, share, levels=[1e-4, 1e-3, 1e-2, 1e-1], colors="white", linewidths=0.6, alpha=0.6)
        axes.grid(False)
        axes.set(
            xlabel="slope along x",
            ylabel="slope along y",
            xticks=[-1, -0.5, 0, 0.5, 1],
            yticks=[-1, -0.5, 0, 0.5, 1],
            title=f"D, {caption(numbers)}, peak {number_label(float(D.max()))} / sr",
        )
        if last:
            colour_bar(figure, axes, mesh, "D / its peak", extend="min")

    numbers = sets[1]
    turns = np.radians([0, 30, 60, 90])
    colours = shades(len(turns))
    labels = [f"φ = {round(math.degrees(t))}°" for t in turns]
    v = _towards(np.arccos(COSINES), turns[:, None])

    def masking(axes: Axes) -> None:
        slots = {"ndf": entry, "masking": model("masking", SMITH)}
        own = {"ndf": numbers, "masking": {}}
        G1 = _evaluate(device, "MASKING_G1", slots, [v[2], _evaluate(device, "MASKING_AT", slots, v, own)], own)
        for values, colour, label in zip(G1, colours, labels, strict=True):
            axes.plot(COSINES, values, color=colour, label=label)
        axes.set(title=f"Masking $G_1$, Smith, {caption(numbers)}", ylim=(0, 1.03), ylabel="$G_1$")
        _cosine_axis(axes)

    def albedo(axes: Axes) -> None:
        E = integrate(
            "albedo", ndf=entry, NoV=COSINES, phi=turns[:, None], tolerance=TOLERANCE, device=device, **numbers
        ).values
        for values, colour, label in zip(E, colours, labels, strict=True):
            axes.plot(COSINES, values, color=colour, label=label)
        axes.set(title="Directional albedo, Smith, F = 1", ylim=(0, 1.03), ylabel="E")
        _cosine_axis(axes)
        add_legend(axes)

    around = np.linspace(0, math.pi / 2, 40)

    heat = [Panel(partial(slopes, n, n is sets[-1]), 4.4, 1.1 if n is sets[-1] else 0.3) for n in sets]
    return [
        (4.4, heat),
        (
            3.1,
            [
                Panel(masking, 2.8),
                Panel(albedo, 2.8, 1.25),
                Panel(partial(_turned_shape_error, sheet, numbers, around), 2.6, 0.95),
                Panel(partial(_turned_furnace_error, sheet, numbers, around[::2]), 2.6, 0.95),
            ],
        ),
    ]


def _turned_shape_error(sheet: _Sheet, numbers: Numbers, around: np.ndarray, axes: Axes) -> None:
    """Draw a map of the error of D of an anisotropic NDF, over θ and the azimuths `around` in radians."""
    entry = sheet.entry
    theta = np.radians(np.linspace(0.25, 89.75, 120))
    m = [_rounded(c) for c in _towards(theta, around[:, None])]
    own = {name: float(_rounded(value)) for name, value in numbers.items()}
    got = _evaluate(sheet.device, "NDF_D", {"ndf": entry}, m, {"ndf": own})
    want = entry.reference["D"](np.arctan2(np.hypot(m[0], m[1]), m[2]), np.arctan2(m[1], m[0]), **own)
    with np.errstate(all="ignore"):
        error = np.where(want > max(1e-30, 1e-30 * float(want.max())), np.abs(got / want - 1), np.nan)
    _map(sheet.figure, axes, np.degrees(theta), np.degrees(around), error)
    axes.set(ylabel="φ (degrees)", yticks=[0, 30, 60, 90])
    axes.set_title(f"Relative error of D: {_largest(error)}", fontsize=11)
    _degrees(axes, step=30)


def _turned_furnace_error(sheet: _Sheet, numbers: Numbers, around: np.ndarray, axes: Axes) -> None:
    """Draw a map of the error of the weak white furnace over n·v and the azimuths `around` in radians."""
    NoV = np.geomspace(1e-3, 1, 36)
    got = integrate(
        "weak_furnace", ndf=sheet.entry, NoV=NoV, phi=around[:, None], device=sheet.device, **numbers
    ).values
    error = np.abs(np.asarray(got, np.float64) - 1)
    _map(sheet.figure, axes, NoV, np.degrees(around), error)
    axes.set(xscale="log", xlabel="n·v", ylabel="φ (degrees)", yticks=[0, 30, 60, 90])
    axes.set_title(f"Weak white furnace less 1: {_largest(error)}", fontsize=11)


DASHED = (0, (4, 2.5))


def _masking(sheet: _Sheet) -> Page:
    """G and V as v sweeps through the plane of l, and the energy they leave, against Smith's, for GGX."""
    rival = model("masking", RIVAL if sheet.entry.name == SMITH else SMITH)
    return [
        (
            3.5,
            [
                Panel(partial(_sweep, sheet, alpha, rival, "G"), 4.2),
                Panel(partial(_sweep, sheet, alpha, rival, "V"), 4.2, 1.95),
                Panel(partial(_energy, sheet, alpha, rival), 3.6, 2.15),
            ],
        )
        for alpha in (0.1, 0.5)
    ]


def _own(of: Model, alpha: float) -> dict[str, Any]:
    """Return a masking model's parameters for an NDF of this roughness."""
    return {p.name: alpha if p.name == "alpha" else p.typical[len(p.typical) // 2] for p in of.parameters}


def _sweep(sheet: _Sheet, alpha: float, rival: Model, function: str, axes: Axes) -> None:
    theta = np.radians(np.linspace(-89.5, 89.5, 359))
    for degrees, colour in zip(LIGHTS, shades(len(LIGHTS)), strict=True):
        light = math.radians(degrees)
        NoV, NoL = np.cos(theta), np.full_like(theta, math.cos(light))
        curves = {}
        for of in (sheet.entry, rival):
            slots = {"ndf": model("ndf", FACETS), "masking": of}
            numbers = {"ndf": {"alpha": alpha}, "masking": _own(of, alpha)}
            at = [_evaluate(sheet.device, "MASKING_AT", slots, [c], numbers) for c in (NoV, NoL)]
            # l and v are in one plane, where h bisects them.
            given = [NoV, NoL, np.cos((theta + light) / 2), np.cos((theta - light) / 2), *at]
            curves[of.name] = _evaluate(sheet.device, f"MASKING_{function}", slots, given, numbers)
            if of is sheet.entry:
                want = of.reference[function](*given, **numbers["masking"])
        axes.plot(np.degrees(theta), curves[rival.name], color=colour, linestyle=DASHED, linewidth=1.3)
        axes.plot(np.degrees(theta), curves[sheet.entry.name], color=colour, label=rf"$\theta_l$ = {degrees}°")
        axes.plot(
            np.degrees(theta)[17::36], want[17::36], "o", color="white", markeredgecolor=colour, markersize=5, zorder=4
        )
    axes.plot([], [], color="0.3", linestyle=DASHED, linewidth=1.3, label=rival.name)
    axes.plot([], [], "o", color="white", markeredgecolor="0.3", markersize=5, label="float64 reference")
    _degrees(axes, -90, 90, 30, r"$\theta_v$ in the plane of l (degrees; + towards l)")
    axes.set(
        ylabel=function,
        title=("Masking and shadowing, G" if function == "G" else "Visibility V = G / (n·l n·v)")
        + f"; GGX, α = {alpha}",
    )
    if function == "G":
        axes.set_ylim(0, 1.05)
    else:
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        axes.set_ylim(min(max(low, 0.01), 0.8), max(min(high, 300), 3))
        axes.set_yticks([t for t in (0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 100, 300) if low <= t <= axes.get_ylim()[1]])
        axes.set_yticklabels([f"{t:g}" for t in axes.get_yticks()])
        axes.minorticks_off()
        add_legend(axes)


def _energy(sheet: _Sheet, alpha: float, rival: Model, axes: Axes) -> None:
    entry = sheet.entry
    for what, of, colour, style, width, label in (
        ("albedo", entry, BLUE, "-", 2.0, f"E, {entry.name}"),
        ("albedo", rival, BLUE, DASHED, 1.3, f"E, {rival.name}"),
        ("weak_furnace", entry, RED, "-", 2.0, "weak white furnace"),
    ):
        if what == "albedo" or "MASKING_G1" in of.provides:
            own = {f"masking_{name}": value for name, value in _own(of, alpha).items()}
            values = integrate(
                what,
                ndf=FACETS,
                masking=of,
                NoV=COSINES,
                device=sheet.device,
                tolerance=TOLERANCE,
                ndf_alpha=alpha,
                **own,
            ).values
            axes.plot(COSINES, values, color=colour, linestyle=style, linewidth=width, label=label)
    axes.set(title=f"Energy, F = 1; GGX, α = {alpha}", ylabel="share of the energy")
    axes.set_ylim(0, max(1.05, min(axes.get_ylim()[1], 3)))
    _cosine_axis(axes)
    add_legend(axes)


INCIDENCE = np.radians(np.linspace(0, 90, 721))


def _fresnel_of(sheet: _Sheet, entry: Model, numbers: Numbers, theta: np.ndarray = INCIDENCE) -> np.ndarray:
    return _evaluate(sheet.device, "FRESNEL_F", {"fresnel": entry}, [np.cos(theta)], {"fresnel": numbers})


def _fresnel(sheet: _Sheet) -> Page:
    """Draw curves over the angle for presets and parameters, Schlick's curve against the exact one, and the error."""
    entry = sheet.entry
    presets = {name: _preset(entry, numbers) for name, numbers in entry.presets.items()}
    metals = {name: n for name, n in presets.items() if any(np.ptp(v) > 0 for v in n.values())}
    plain = {name: n for name, n in presets.items() if name not in metals}
    panels: list[Callable[[Axes], None]] = []
    for name, numbers in metals.items():
        panels.append(partial(_metal, sheet, name, numbers))
    if metals and plain:
        panels.append(partial(_insulators, sheet, plain))
    families = [f for f in sheet.families() if not metals]
    for family in families:
        below = [v for v in family.values if family.parameter is not None and family.parameter.name == "ior" and v < 1]
        if below:
            rest = tuple(v for v in family.values if v >= 1)
            parts = [_Family(family.parameter, rest, family.held), _Family(family.parameter, tuple(below), family.held)]
        else:
            parts = [family]
        for part in parts:
            panels.append(partial(_angles, sheet, part))
    if entry.name == SCHLICK:
        panels.append(partial(_exact, sheet, False))
        panels.append(partial(_exact, sheet, True))
    elif families[0].parameter is not None:
        panels.append(partial(_against_schlick, sheet))
    if sheet.families()[0].parameter is not None:
        panels.append(partial(_fresnel_error, sheet))
    # Presets have their legends in free corners, other curves outside the axes.
    columns, after = (3, 0.4) if metals else (2, 1.75)
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    return [
        (3.3, [Panel(paint, 4.2, 1.0 if metals and k == columns - 1 else after) for k, paint in enumerate(row)])
        for row in rows
    ]


def _preset(entry: Model, numbers: Mapping[str, float | tuple[float, float, float]]) -> dict[str, np.ndarray]:
    """Return three values of each parameter, one per colour: those of a preset, or the default."""
    defaults = {p.name: p.default for p in entry.parameters}
    return {
        p.name: np.broadcast_to(np.asarray(numbers.get(p.name, defaults[p.name]), np.float64), 3)
        for p in entry.parameters
    }


def _metal(sheet: _Sheet, name: str, numbers: Numbers, axes: Axes) -> None:
    F = _fresnel_of(sheet, sheet.entry, {k: v[:, None] for k, v in numbers.items()})
    for values, (channel, colour), style in zip(F, RGB.items(), ("-", (0, (6, 2)), (0, (2, 1.5))), strict=True):
        axes.plot(np.degrees(INCIDENCE), values, color=colour, label=channel, linestyle=style)
    axes.set(title=name.replace("_", " "), ylim=(0, 1.03), ylabel="F")
    _degrees(axes)
    strip = axes.inset_axes([0, 0.0, 1, 0.06])  # the reflected colour
    even = np.stack([np.interp(np.linspace(0, math.pi / 2, 181), INCIDENCE, values) for values in F], -1)
    srgb = np.where(even <= 0.0031308, 12.92 * even, 1.055 * np.maximum(even, 0) ** (1 / 2.4) - 0.055)
    strip.imshow(np.clip(srgb, 0, 1)[None], aspect="auto")
    strip.set(xticks=[], yticks=[])
    for spine in strip.spines.values():
        spine.set(visible=True, linewidth=0.6, color="0.7")
    even = F[:, INCIDENCE <= math.radians(60)]
    free = even.min() > 0.4  # below the curves, above the strip
    if free or even.max() < 0.6:
        add_legend(axes, inside="center left" if even.min() > 0.7 else (0.02, 0.12) if free else "upper left")


def _insulators(sheet: _Sheet, presets: Mapping[str, Mapping[str, np.ndarray]], axes: Axes) -> None:
    together: dict[tuple[float, ...], list[str]] = {}
    for name, numbers in presets.items():
        together.setdefault(tuple(float(v[0]) for v in numbers.values()), []).append(name.replace("_", " "))
    keys = sorted(together)
    names = [p.name for p in sheet.entry.parameters]
    for key, colour in zip(keys, shades(len(keys)), strict=True):
        F = _fresnel_of(sheet, sheet.entry, dict(zip(names, key, strict=True)))
        axes.plot(np.degrees(INCIDENCE), F, color=colour, label=", ".join(together[key]))
    axes.set(title="insulators", ylim=(0, 1.03), ylabel="F")
    _degrees(axes)
    add_legend(axes, inside="upper left")


def _angles(sheet: _Sheet, family: _Family, axes: Axes) -> None:
    entry, p = sheet.entry, family.parameter
    F = np.atleast_2d(_fresnel_of(sheet, entry, family.columns))
    for values, colour, label in zip(F, shades(len(F)), family.labels(entry), strict=True):
        axes.plot(np.degrees(INCIDENCE), values, color=colour, label=label)
    title = f"F by {_symbol(p)}" if p else "F"
    if p is not None and p.name == "ior":
        denser = family.values[-1] >= 1
        for n, colour in zip(family.values, shades(len(F)), strict=True):
            if n != 1:
                theta = np.array([math.atan(n) if denser else math.asin(n)])
                axes.plot(
                    np.degrees(theta),
                    _fresnel_of(sheet, entry, {**family.held, p.name: n}, theta),
                    "o" if denser else "D",
                    color=colour,
                    markeredgecolor="white",
                    markersize=8,
                    zorder=5,
                )
        axes.plot(
            [],
            [],
            "o" if denser else "D",
            color="0.35",
            markeredgecolor="white",
            markersize=8,
            label="Brewster's\nangle, tan θ = n" if denser else "critical angle,\nsin θ = n",
        )
        title = "into the denser side, n ≥ 1" if denser else "into the thinner side, n < 1: total internal reflection"
    axes.set(title=title, ylim=(min(0, float(F.min()) * 1.1), max(1.03, float(F.max()) * 1.02)), ylabel="F")
    _degrees(axes)
    add_legend(axes, family.caption(entry))


def _exact(sheet: _Sheet, difference: bool, axes: Axes) -> None:
    """Draw Schlick's curve and the exact one of the insulator that has its f0, or with `difference` their
    difference.
    """
    exact, usual = model("fresnel", EXACT), sheet.usual()
    values = [f0 for f0 in sheet.values["f0"] if f0 < 0.4]
    for f0, colour in zip(values, shades(len(values)), strict=True):
        root = math.sqrt(f0)
        n = (1 + root) / (1 - root)
        got = _fresnel_of(sheet, sheet.entry, {**usual, "f0": f0})
        want = _fresnel_of(sheet, exact, {"ior": n})
        label = rf"$\mathrm{{F}}_\mathrm{{0}}$ = {number_label(f0)}, n = {n:.3g}"
        if difference:
            axes.plot(np.degrees(INCIDENCE), got - want, color=colour, label=label)
        else:
            axes.plot(np.degrees(INCIDENCE), got, color=colour, label=label)
            axes.plot(np.degrees(INCIDENCE), want, color=colour, linestyle=(0, (3, 2)))
    if difference:
        axes.axhline(0, color="0.4", linewidth=1)
        axes.set(title="Schlick less exact", ylabel="F − F exact")
        axes.locator_params(axis="y", nbins=6)
    else:
        axes.plot([], [], color="0.3", linestyle=(0, (3, 2)), label="dashed: exact")
        axes.set(title="Schlick and the exact insulator", ylim=(0, 1.03), ylabel="F")
    _degrees(axes)
    if not difference:
        add_legend(axes, inside="upper left")


def _against_schlick(sheet: _Sheet, axes: Axes) -> None:
    """Draw the error of Schlick's curve with the same F(0°)."""
    schlick = model("fresnel", SCHLICK)
    family = sheet.families()[-1]
    values = (
        tuple(v for v in family.values if v >= 1)
        if family.parameter and family.parameter.name == "ior"
        else family.values
    )
    family = _Family(family.parameter, values, family.held)
    F = _fresnel_of(sheet, sheet.entry, family.columns)
    for curve, colour, label in zip(F, shades(len(F)), family.labels(sheet.entry), strict=True):
        if curve[0] < 1e-9:
            continue  # no boundary
        other = _fresnel_of(sheet, schlick, {"f0": float(np.clip(curve[0], 0, 1)), "f90": 1.0})
        axes.plot(np.degrees(INCIDENCE), other - curve, color=colour, label=label)
    axes.axhline(0, color="0.4", linewidth=1)
    axes.set(title="Schlick of the same F(0°), less this", ylabel="F Schlick − F")
    axes.locator_params(axis="y", nbins=6)
    _degrees(axes)
    add_legend(axes, family.caption(sheet.entry))


def _fresnel_error(sheet: _Sheet, axes: Axes) -> None:
    family = sheet.families()[0]
    cosine = _rounded(np.cos(np.radians(np.linspace(0, 90, 181))))

    def error(values: np.ndarray) -> np.ndarray:
        numbers = {k: _rounded(v) for k, v in family.numbers(values[:, None]).items()}
        got = _evaluate(sheet.device, "FRESNEL_F", {"fresnel": sheet.entry}, [cosine], {"fresnel": numbers})
        return np.abs(got - sheet.entry.reference["F"](cosine, **numbers))

    _error_panel(sheet, family, axes, np.linspace(0, 90, 181), error, "Absolute error of F", False)
    _degrees(axes)


def _diffuse(sheet: _Sheet) -> Page:
    """E for each parameter with its reference, slices of f through the plane of v, the error."""
    figure, entry, device = sheet.figure, sheet.entry, sheet.device
    families = sheet.families()[::-1][:2]

    def albedo(family: _Family, axes: Axes) -> None:
        E = np.atleast_2d(
            integrate("albedo", diffuse=entry, NoV=COSINES, tolerance=TOLERANCE, device=device, **family.columns).values
        )
        for value, values, colour, label in zip(family.values, E, shades(len(E)), family.labels(entry), strict=True):
            axes.plot(COSINES, values, color=colour, label=label)
            if "albedo" in entry.reference:
                dots = COSINES[8::9]
                want = np.broadcast_to(entry.reference["albedo"](dots, **family.numbers(value)), dots.shape)
                axes.plot(dots, want, "o", color="white", markeredgecolor=colour, markersize=4.5)
        if "albedo" in entry.reference:
            axes.plot([], [], "o", color="white", markeredgecolor="0.3", markersize=4.5, label="float64\nreference")
        axes.axhline(1, color="0.4", linewidth=1)
        axes.set(
            title="Directional albedo" + (f" by {_symbol(family.parameter)}" if family.parameter else ""),
            ylabel="E",
            ylim=(0, float(np.clip(E.max() * 1.04, 1.05, 2.5))),
        )
        _cosine_axis(axes)
        add_legend(axes, family.caption(entry))

    def error(axes: Axes) -> None:
        theta = np.radians(np.linspace(-89.5, 89.5, 120))
        light = [_rounded(c) for c in _towards(theta)]
        view = [_rounded(c) for c in _towards(-np.radians(np.linspace(0.5, 89.5, 60))[:, None])]
        numbers = {k: float(_rounded(v)) for k, v in sheet.usual().items()}
        got = _evaluate(device, "DIFFUSE_F", {"diffuse": entry}, [*light, *view], {"diffuse": numbers})
        wide = [np.stack(np.broadcast_arrays(*(np.broadcast_to(c, got.shape) for c in d)), -1) for d in (light, view)]
        want = np.broadcast_to(entry.reference["f"](*wide, **numbers), got.shape)
        off = np.abs(got - want) / np.abs(want)
        _map(figure, axes, np.degrees(theta), np.linspace(0.5, 89.5, 60), off)
        caption = ", ".join(f"{_symbol(p)} = {number_label(numbers[p.name])}" for p in entry.parameters)
        axes.set(ylabel=r"$\theta_v$ (degrees)", yticks=[0, 30, 60, 90])
        axes.set_title(f"Relative error of f, {caption}: {_largest(off)}", fontsize=11)
        _degrees(axes, -90, 90, 30, r"$\theta_l$ in the plane of v (degrees; − towards v)")

    family = families[0]
    shown = list(
        dict.fromkeys(
            (family.values[min(1, len(family.values) - 1)], family.values[len(family.values) // 2], family.values[-1])
        )
    )
    curves = [Panel(partial(albedo, f), 3.6, 1.5) for f in families]
    slices = [
        Panel(partial(_slices, sheet, family, v, v == shown[-1]), 4.6, 1.5 if v == shown[-1] else 0.3, polar=(-90, 90))
        for v in shown
    ]
    return [(3.4, [*curves, Panel(error, 3.9, 0.9)]), (2.3, slices)]


def _slices(sheet: _Sheet, family: _Family, value: float, legend: bool, axes: Axes) -> None:
    theta = np.radians(np.linspace(-89.5, 89.5, 359))
    numbers = family.numbers(value)
    views = np.radians([0, 30, 60, 80])
    f = math.pi * _evaluate(
        sheet.device,
        "DIFFUSE_F",
        {"diffuse": sheet.entry},
        [*_towards(theta), *_towards(-views[:, None])],
        {"diffuse": numbers},
    )
    top = float(np.clip(f.max() * 1.05, 0.2, 3))
    if "albedo" in numbers:
        axes.plot(
            theta,
            np.full_like(theta, numbers["albedo"]),
            color="0.55",
            linestyle=(0, (3, 2)),
            linewidth=1.3,
            label="Lambert",
        )
        top = max(top, numbers["albedo"] * 1.05)
    for values, view, colour in zip(f, views, shades(len(views)), strict=True):
        axes.plot(
            theta,
            np.where((values >= 0) & (values <= top), values, np.nan),
            color=colour,
            label=rf"$\theta_v$ = {round(math.degrees(view))}°",
        )
        axes.plot([-view], [top], "v", color=colour, markersize=9, clip_on=False, zorder=6)
    axes.set_ylim(0, top)
    marks = [t for t in (0.5, 1, 1.5, 2, 2.5, 3) if t <= top]
    axes.set_rgrids(marks, [f"{t:g}" for t in marks])
    name = family.labels(sheet.entry)[0].split(" = ")[0]
    # Above the half disc and the label of 0°.
    axes.set_title(rf"π f over $\theta_l$, {name} = {number_label(value)}   (▼ v)", y=0.75, pad=22)
    if legend:
        add_legend(axes)


def _brdf(sheet: _Sheet) -> Page:
    """E in RGB, f in the plane of v, and f over all l for one v."""
    figure, entry, device, usual = sheet.figure, sheet.entry, sheet.device, sheet.usual()
    caption = ", ".join(f"{k} = {number_label(v)}" for k, v in usual.items())

    def albedo(axes: Axes) -> None:
        E = integrate("albedo", brdf=entry, NoV=COSINES, tolerance=TOLERANCE, device=device, **usual).values
        styles = ("-", (0, (6, 2)), (0, (2, 1.5)))
        for k, ((channel, colour), style) in enumerate(zip(RGB.items(), styles, strict=True)):
            axes.plot(COSINES, E[:, k], color=colour, label=channel, linestyle=style)
        axes.axhline(1, color="0.4", linewidth=1)
        axes.set(
            title="Directional albedo" + (f", {caption}" if caption else ""),
            ylabel="E",
            ylim=(0, float(np.clip(E.max() * 1.05, 1.05, 4))),
        )
        _cosine_axis(axes)
        add_legend(axes)

    def plane(axes: Axes) -> None:
        theta, views = np.radians(np.linspace(-89.5, 89.5, 719)), np.radians([0, 30, 60, 80])
        f = _evaluate(
            device, "BRDF_F", {"brdf": entry}, [*_towards(theta), *_towards(-views[:, None])], {"brdf": usual}
        ).mean(0)
        for values, view, colour in zip(f, views, shades(4), strict=True):
            axes.semilogy(
                np.degrees(theta),
                np.where(values > 0, values, np.nan),
                color=colour,
                label=rf"$\theta_v$ = {round(math.degrees(view))}°",
            )
        top = float(np.nanmax(f[np.isfinite(f)], initial=1e-3))
        axes.set(
            title="f in the plane of v, mean of RGB",
            ylabel="f (1/sr)",
            ylim=(max(float(np.min(f[f > 0], initial=top)) / 2, top * 1e-8), top * 2),
        )
        _degrees(axes, -90, 90, 30, r"$\theta_l$ (degrees; − towards v)")
        add_legend(axes)

    def disc(axes: Axes) -> None:
        side = np.linspace(-1, 1, 301)
        x, y = np.meshgrid(side, side)
        inside = x * x + y * y < 0.9999
        z = np.sqrt(np.maximum(1 - x * x - y * y, 1e-4))
        view = _towards(-math.pi / 4)
        f = _evaluate(device, "BRDF_F", {"brdf": entry}, [x, y, z, *view], {"brdf": usual}).mean(0)
        shown = np.ma.masked_where(~inside | ~(f > 0), f)
        low, top = float(shown.min()), float(shown.max())
        norm = logarithmic_scale(max(low, top * 1e-5), top) if top > 30 * low else linear_scale(0, top)
        mesh = axes.pcolormesh(side, side, shown, cmap="inferno", norm=norm, shading="nearest", rasterized=True)
        axes.plot(*view[:2], "P", color="white", markeredgecolor="black", markersize=11)
        axes.set(aspect="equal", title="f over l, seen from above; + v at 45°", xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set_visible(False)
        axes.grid(False)
        colour_bar(figure, axes, mesh, "f (1/sr)")

    return [(4.0, [Panel(albedo, 4.0, 1.1), Panel(plane, 4.8, 1.3), Panel(disc, 4.0, 1.2)])]


_FIGURES: dict[str, Callable[[_Sheet], Page]] = {
    "ndf": _ndf,
    "masking": _masking,
    "fresnel": _fresnel,
    "diffuse": _diffuse,
    "brdf": _brdf,
}
