"""Tables of the energy that single scattering loses, of the albedo of sheen, and of the average of a Fresnel term."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from whitefurnace.catalogue import integral
from whitefurnace.catalogue.choice import Chosen
from whitefurnace.catalogue.rule import gauss
from whitefurnace.errors import UnsupportedError
from whitefurnace.integrals.quadrature import ROUNDING, Grid, TableSpec, grid_of, integrate, missed, room_for
from whitefurnace.opencl import source
from whitefurnace.opencl.derived import numbers_of
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import evaluate
from whitefurnace.results import Integrated

FINE = 1e-11
"""Tolerance, in float64, of albedos whose complements are tabulated: at α = 1e-5 the average loss is 1e-9."""

PAIRS = 5e-6
"""Tolerance of the split-sum pairs."""

F0 = (0.04, 0.5, 0.9, 1.0)
"""Reflectances at which the schemes are compared."""

HALVINGS = 30
SETTLED = 1e-14
AT_ONCE = 1024
"""For the average of a Fresnel term: the largest number of halvings of a panel, the change that ends them, and the
number of cells that are computed at once."""

CHECK = 96
"""Number of nodes of the average that checks the furnace, in another variable than that of the table."""


def _without_view(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters without NoV, its axis kept with one value: (…, y, 1)."""
    return {name: value for name, value in columns.items() if name not in ("NoV", "phi")}


def _albedos(what: Mapping[str, Any]) -> tuple[Integrated, Integrated]:
    """E(v) and its average by the table's axes, float64. Raises UnsupportedError for a BRDF that makes energy."""
    own = {**what, "precision": 64, "tolerance": FINE, "out": None}
    average = {k: v for k, v in _without_view(own).items() if k != "backfacing"}
    E, mean = integrate("albedo", **own), integrate("albedo_average", **average)
    if E.values.max() > 1 + 1e-6:
        raise UnsupportedError(
            f"single scattering with this masking reflects up to {E.values.max():.4g} of what "
            "arrives, so no energy is lost that could be restored; smith has albedos of at most 1"
        )
    return E, mean


def _whole(out: np.ndarray | None, channels: Sequence[np.ndarray], precision: int) -> np.ndarray:
    shape = (*np.broadcast_shapes(*(c.shape for c in channels)), len(channels))
    values = room_for(shape, precision, out)
    for k, channel in enumerate(channels):
        values[..., k] = channel
    return values


def _joined(first: Integrated, *others: Integrated) -> Integrated:
    """The statements of several integrals in one."""
    return replace(
        first,
        error=max(one.error for one in (first, *others)),
        evaluations=sum(one.evaluations for one in (first, *others)),
        seconds=sum(one.seconds for one in (first, *others)),
        notices=tuple(dict.fromkeys(n for one in (first, *others) for n in one.notices)),
    )


def energy(scheme: str, report: bool, **what: Any) -> tuple[Integrated, dict[str, Any]]:
    """Return the table of a scheme, (…, 2), and with `report` the facts that its manifest states.

    scheme: "kulla_conty" gives (1 - E, 1 - E_avg), since float32 cannot hold the loss at α < .01 as a difference from
    1; "turquin" gives (E, 1/E - 1); "fdez_aguera" gives the split-sum pair.
    what: arguments of `integrate`.

    Raises UnsupportedError for a BRDF that reflects more than arrives. [KullaConty2017; Turquin2019; FdezAguera2019]
    """
    E, mean = _albedos(what)
    lost, lost_avg = np.maximum(1 - E.values, 0), np.maximum(1 - mean.values, 0)
    pairs = (
        integrate("dfg", **{**what, "precision": 32, "tolerance": PAIRS, "out": None})
        if report or scheme == "fdez_aguera"
        else None
    )
    if scheme == "fdez_aguera" and pairs is not None:
        channels, parts = (pairs.values[..., 0], pairs.values[..., 1]), [pairs]
    else:
        channels = (lost, lost_avg) if scheme == "kulla_conty" else (E.values, lost / E.values)
        parts = [E, mean]
    values = _whole(what["out"], channels, what["precision"])
    made = replace(_joined(*parts), values=values)
    # The albedos were asked for more exactly than the table was, and need not have come so far.
    made = replace(made, notices=tuple(missed(made.error, what["tolerance"], what["precision"])))
    if not report or pairs is None:
        return made, {}
    # The average again, in μ = x³: the furnace must not be judged by the nodes that made the table.
    x, w = gauss(CHECK)
    columns: dict[str, Any] = {
        k: np.asarray(v)[..., None] if isinstance(v, np.ndarray) and np.ndim(v) else v
        for k, v in _without_view(what).items()
    }
    columns |= {"NoV": x**3, "precision": 64, "tolerance": FINE, "out": None}
    along = integrate("albedo", **columns).values
    again = ((1 - along) * (6 * w * x**5)).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(lost_avg > 0, again / lost_avg, 1.0)
    A, B = np.asarray(pairs.values[..., 0], float), np.asarray(pairs.values[..., 1], float)

    def furnace(which: str, f0: float) -> np.ndarray:
        """Return the light that leaves a surface of reflectance f0 in a white furnace."""
        single, average = f0 * A + B, f0 + (1 - f0) / 21
        if f0 == 1:
            single = E.values
        if which == "turquin":
            return single * (1 + f0 * lost / E.values)
        if which == "fdez_aguera":
            return single + single * average / (1 - lost * average) * lost
        return single + lost * share * (average**2 * (1 - lost_avg) / (1 - average * lost_avg) if f0 < 1 else 1)

    apart = {"kulla_conty": 0.0, "turquin": _apart(E.values), "fdez_aguera": _apart(lost)}[scheme]
    return made, {
        "channels": {
            "kulla_conty": ["1 - E", "1 - E_avg"],
            "turquin": ["E", "1/E - 1"],
            "fdez_aguera": ["scale", "bias"],
        }[scheme],
        "formula": {
            "kulla_conty": "f + F_ms (1 - E(l)) (1 - E(v)) / (π (1 - E_avg)), "
            "F_ms = F_avg² E_avg / (1 - F_avg (1 - E_avg))",
            "turquin": "f (1 + F0 (1/E(v) - 1))",
            "fdez_aguera": "S radiance + S F_avg (1 - E) / (1 - F_avg (1 - E)) irradiance/π, "
            "S = F0 scale + bias, E = scale + bias, F_avg = F0 + (1 - F0)/21",
        }[scheme],
        "furnace": float(np.abs(furnace(scheme, 1.0) - 1).max()),
        "non_reciprocity": apart,
        "deviation": {f"{f0:g}": float(np.abs(furnace(scheme, f0) - furnace("kulla_conty", f0)).max()) for f0 in F0},
    }


def _apart(values: np.ndarray) -> float:
    """Return the largest 1 - min/max along x: how much f(l, v) and f(v, l) differ where one factor depends on v
    alone.
    """
    high = values.max(-1)
    return float((1 - values.min(-1) / np.where(high > 0, high, 1)).max())


def sheen(report: bool, **what: Any) -> tuple[Integrated, dict[str, Any]]:
    """Albedo E(v) and its average E_avg, (…, 2), of a sheen of colour 1, which scale the layer below. [Estevez2017]

    what: arguments of `integrate`. A notice names a sheen that reflects more than arrives somewhere.
    """
    own = {**what, "out": None}
    E = integrate("albedo", **own)
    mean = integrate("albedo_average", **{k: v for k, v in _without_view(own).items() if k != "backfacing"})
    made = replace(_joined(E, mean), values=_whole(what["out"], (E.values, mean.values), what["precision"]))
    largest, over = float(E.values.max()), float((E.values > 1 + E.error).mean())
    if report and over:
        made = replace(
            made,
            notices=(
                *made.notices,
                f"this sheen reflects up to {largest:.3g} times what arrives, over 1 in {over:.1%} of the cells, where "
                "the scale of the layer below is 0; under the masking smith no albedo passes 1",
            ),
        )
    return made, {
        "channels": ["E", "E_avg"],
        "largest": largest,
        "over_one": over,
        "formula": "f_sheen + f_base max(0, min(1 - s E(v), 1 - s E(l))), s the largest channel of its colour",
    }


def _grid(models: Mapping[str, Chosen], columns: Mapping[str, Any]) -> Grid:
    return grid_of(integral("albedo_average"), models, dict(columns), None)


def fresnel_spec(models: Mapping[str, Chosen], columns: Mapping[str, Any]) -> TableSpec:
    """Describe the array that `fresnel_average` computes. Raises UsageError for parameters outside their domain."""
    slots = {"fresnel": models["fresnel"].model}
    return TableSpec(
        integral("albedo_average"),
        models,
        _grid(models, columns).shape,
        (source.evaluation("FRESNEL_F", slots).digest,),
    )


def _halved(
    F: Callable[[np.ndarray, np.ndarray], np.ndarray], count: int, rounding: float
) -> tuple[np.ndarray, float, int]:
    """Return 2∫ F μ dμ of `count` curves F(μ, which), the remaining error and the number of evaluations.

    Panels have 10 Gauss nodes and are halved where their halves differ, which closes in on a kink (total reflection).
    rounding: the rounding error of F.
    """
    x, w = gauss(10)

    def panel(low: np.ndarray, length: np.ndarray, which: np.ndarray) -> np.ndarray:
        mu = low[:, None] + length[:, None] * x
        values = F(mu.ravel(), np.repeat(which, x.size)).reshape(mu.shape)
        return (values * mu) @ (2 * w) * length

    total, left, used = np.zeros(count), np.zeros(count), 10 * count
    which, low, length = np.arange(count), np.zeros(count), np.ones(count)
    whole = panel(low, length, which)
    for depth in range(HALVINGS):
        which, low, length = np.repeat(which, 2), np.repeat(low, 2), np.repeat(length / 2, 2)
        low[1::2] += length[1::2]
        halves = panel(low, length, which)
        used += 10 * which.size
        change = np.abs(halves.reshape(-1, 2).sum(1) - whole)
        open_ = np.repeat((change > np.maximum(SETTLED, rounding * length[::2])) & (depth < HALVINGS - 1), 2)
        np.add.at(total, which[~open_], halves[~open_])
        np.add.at(left, which[::2][~open_[::2]], change[~open_[::2]])
        which, low, length, whole = which[open_], low[open_], length[open_], halves[open_]
        if not which.size:
            break
    return total, float(left.max()), used


def fresnel_average(
    *,
    fresnel: Chosen,
    out: np.ndarray | None,
    precision: int,
    tolerance: float,
    device: Device,
    backfacing: str | None = None,
    **columns: Any,
) -> Integrated:
    """Compute the average F_avg = 2∫ F(μ) μ dμ of a Fresnel term, (…), to 1e-6 or better."""
    start, entry = time.perf_counter(), fresnel.model
    slots, grid = {"fresnel": entry}, _grid({"fresnel": fresnel}, columns)
    finest = 64 if device.fp64 else 32
    values, error, evaluations = room_for(grid.shape, precision, out), 0.0, 0
    flat = values.reshape(-1)
    for begin in range(0, grid.size, AT_ONCE):
        end = min(begin + AT_ONCE, grid.size)
        rows = np.array([grid.part(f"fresnel_{p.name}", begin, end) for p in entry.parameters]).reshape(-1, end - begin)
        numbers = numbers_of(device, entry, rows)

        def at(mu: np.ndarray, which: np.ndarray, numbers: np.ndarray = numbers) -> np.ndarray:
            cells = np.concatenate([mu[None], numbers[:, which]])
            return evaluate(device, "FRESNEL_F", slots, cells, finest)[0].astype(np.float64)

        found, left, used = _halved(at, end - begin, ROUNDING[finest])
        flat[begin:end] = found
        error, evaluations = max(error, left), evaluations + used
    error += 1e-7 * float(np.abs(flat).max()) if 32 in (precision, finest) else 1e-15  # of the format
    return Integrated(
        values,
        error,
        evaluations,
        time.perf_counter() - start,
        "gauss-halved-10",
        tuple(missed(error, tolerance, precision)),
    )
