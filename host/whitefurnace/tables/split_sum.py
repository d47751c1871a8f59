"""Split-sum tables as engines lay them out: axes, form and channels of a preset."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from whitefurnace.catalogue.choice import Spec, chosen
from whitefurnace.engines.presets import Dfg
from whitefurnace.integrals.quadrature import integrate, rows_of_roughness
from whitefurnace.opencl.device import Device

TOLERANCE = 5e-6
"""Of the pairs; half floats have steps of 2.4e-4."""

CHARLIE = 1e-4
"""Of Charlie's albedo: its error as half is 2e-4."""


@dataclass(frozen=True)
class SplitSum:
    """`values` (size, size, 2 or 3) float32, row y, column x, as the engine reads them; `error` bounds the first two
    channels, absolutely, `charlie_error` the third (0 without one)."""

    values: np.ndarray
    error: float
    charlie_error: float
    rule: str
    notices: tuple[str, ...]


def axis_values(name: str, spacing: str, size: int) -> np.ndarray:
    """(size,) what the texels of an axis stand for: centres (k + ½)/size, and of NoV with `sqrt` (k/(size - 1))²."""
    if name == "NoV" and spacing == "sqrt":
        return (np.arange(size) / max(size - 1, 1)) ** 2
    return (np.arange(size) + 0.5) / size


def split_sum(table: Dfg, *, device: Device, ndf: Spec = "ggx", masking: Spec = "smith",
              integrated: Callable[..., Any] = integrate) -> SplitSum:
    """The table of a preset. Raises as `integrate` does."""
    x, y = (axis_values(name, table.NoV, table.size) for name in (table.x, table.y))
    across = {table.x: np.broadcast_to(x[None], (table.size, table.size)),
              table.y: np.broadcast_to(y[:, None], (table.size, table.size))}
    NoV = across["NoV"]
    roughness = across["roughness"] if "roughness" in across else np.sqrt(across["alpha"])

    def made(name: str, entry: Spec, tolerance: float) -> Any:
        choice = chosen("ndf", entry)
        return integrated(name, ndf=choice, masking=masking, tolerance=tolerance, device=device, NoV=NoV,
                          **rows_of_roughness(choice, roughness))

    pairs = made("dfg", ndf, TOLERANCE)
    scale, bias = np.asarray(pairs.values, np.float64)[..., 0], np.asarray(pairs.values, np.float64)[..., 1]
    # E = F0 scale + bias = mix(∫Fc, ∫1, F0), since F90 = 1: ∫Fc = bias and ∫1 = scale + bias.
    channels = [scale, bias] if table.form == "scale_bias" else [bias, scale + bias]
    error, charlie_error, notices = float(pairs.error), 0.0, tuple(pairs.notices)
    if table.form == "multiscatter":
        error *= 2
    if table.charlie:
        cloth = made("albedo", "charlie", CHARLIE)
        channels.append(np.asarray(cloth.values, np.float64))
        charlie_error = float(cloth.error)
        notices += tuple(cloth.notices)
    return SplitSum(np.stack(channels, -1).astype(np.float32), error, charlie_error, pairs.rule, notices)
