"""The split-sum pair in the forms and with the channels that engines read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from whitefurnace.catalogue.choice import Chosen, Spec, chosen
from whitefurnace.engines.presets import Dfg
from whitefurnace.integrals.quadrature import integrate, rows_of_roughness
from whitefurnace.opencl.device import Device
from whitefurnace.results import Integrated
from whitefurnace.tables.cells import Cells

TOLERANCE = 5e-6
"""Tolerance of the pairs of a bake; half floats have steps of 2.4e-4."""

CHARLIE = 1e-4
"""Smallest tolerance of Charlie's albedo: its error as half floats is 2e-4, since its values are up to 10 near grazing.
"""

CHANNELS: Mapping[str, tuple[tuple[str, str], str]] = {
    "scale_bias": (("scale", "bias"), "E(v; F0) = F0 scale + bias"),
    "multiscatter": (("∫Fc", "∫1"), "E(v; F0) = mix(∫Fc, ∫1, F0)"),
}
"""Channels of each form, and how a shader reads them. Schlick's F90 is 1, so ∫Fc = bias and ∫1 = scale + bias."""


@dataclass(frozen=True)
class SplitSum:
    """The split-sum table of an engine.

    values         (size, size, 2 or 3) float32, row y, column x, as the engine reads them
    error          bound on the absolute error of the first two channels
    charlie_error  bound on that of the third channel, 0 without one
    """

    values: np.ndarray
    error: float
    charlie_error: float
    rule: str
    notices: tuple[str, ...]


def laid_out(
    form: str,
    pair: Mapping[str, Any],
    cloth: Mapping[str, Any] | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Integrated, float]:
    """Compute the pair in a form, […, 2], or with Charlie's albedo as a third channel, and the error of that channel.

    form: a key of `CHANNELS`. pair: arguments of `integrate` for the pair. cloth: those for Charlie's albedo, or None
    where it is not a channel; its tolerance is at least `CHARLIE`. Raises the errors of `integrate`.
    """
    out = pair.get("out")
    made = integrate("dfg", progress=progress, **{**pair, "out": out if cloth is None else None})
    if form == "multiscatter":
        made.values[..., 0] += made.values[..., 1]
        made.values[...] = made.values[..., ::-1].copy()
        made = replace(made, error=2 * made.error)
    if cloth is None:
        return made, 0.0
    own = integrate("albedo", **{**cloth, "out": None, "tolerance": max(cloth["tolerance"], CHARLIE)})
    values = np.concatenate([made.values, np.broadcast_to(own.values, made.values.shape[:-1])[..., None]], -1)
    if out is not None:
        out[...] = values
    return replace(
        made,
        values=values if out is None else out,
        evaluations=made.evaluations + own.evaluations,
        notices=(*made.notices, *own.notices),
    ), float(own.error)


def charlie(cells: Cells, masking: str) -> dict[str, Any]:
    """Return Charlie's lobe with a masking, and their parameters over the cells of a table."""
    models: dict[str, Chosen] = {"ndf": chosen("ndf", "charlie"), "masking": chosen("masking", masking)}
    return {**models, **cells.columns_for(models)}


def axis_values(name: str, spacing: str, size: int) -> np.ndarray:
    """Return the parameter values (size,) of the texels of an axis.

    They are (k + ½)/size, or (k/(size - 1))² for NoV spaced by "sqrt".
    """
    if name == "NoV" and spacing == "sqrt":
        return (np.arange(size) / max(size - 1, 1)) ** 2
    return (np.arange(size) + 0.5) / size


def split_sum(table: Dfg, *, device: Device, ndf: Spec = "ggx", masking: Spec = "smith") -> SplitSum:
    """Compute the split-sum table of an engine, in float32.

    ndf, masking: models of the first two channels; Charlie's albedo has the masking of `table`. Raises the errors of
    `integrate`.
    """
    x, y = (axis_values(name, table.NoV, table.size) for name in (table.x, table.y))
    across = {
        table.x: np.broadcast_to(x[None], (table.size, table.size)),
        table.y: np.broadcast_to(y[:, None], (table.size, table.size)),
    }
    roughness = across["roughness"] if "roughness" in across else np.sqrt(across["alpha"])

    def of(ndf: Spec, masking: Spec) -> dict[str, Any]:
        models = {"ndf": chosen("ndf", ndf), "masking": chosen("masking", masking)}
        rows: dict[str, Any] = {}
        for choice in models.values():
            if choice.model.from_roughness is not None:
                rows |= rows_of_roughness(choice, roughness)
        return {**models, "tolerance": TOLERANCE, "device": device, "NoV": across["NoV"], **rows}

    cloth = of("charlie", table.charlie_masking) if table.charlie else None
    made, charlie_error = laid_out(table.form, of(ndf, masking), cloth)
    return SplitSum(made.values, made.error, charlie_error, made.rule, made.notices)
