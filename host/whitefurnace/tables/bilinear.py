"""Bilinear reads of tables as a GPU does them, clamped at the edges: texels fitted for such reads, and their errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

SAMPLES = 6
"""Sample points for each texel and axis of a fit."""

ROUNDS = 4
"""Rounds of a fit. The first is least squares, the others weight the rows and columns by their errors [Lawson1961].
Four rounds bring the largest error of a 64² split-sum table from 4.4e-3 to 3.7e-3; more raise the 99th percentile."""

LEAST = 0.045
"""Smallest roughness that engines shade with [Lagarde2014]. At r = n·v = 0 the split-sum pair has no limit, so no table
of texels can hold it. Rows below this roughness have little weight in a fit, and their errors are stated separately."""

FAINT = 1e-2
"""Weight of the rows below `LEAST`."""


def hats(count: int, x: np.ndarray) -> np.ndarray:
    """Return the weights (n, count) of the texels of an axis in linear reads at the texel coordinates x, (n,).

    Coordinate 0 is the centre of the first texel. Coordinates beyond the ends are clamped.
    """
    x = np.clip(x, 0, count - 1)
    first = np.minimum(x.astype(np.intp), max(count - 2, 0))
    weights = np.zeros((x.size, count))
    weights[np.arange(x.size), first] = 1 - (x - first)
    if count > 1:
        weights[np.arange(x.size), first + 1] += x - first
    return weights


def read(texels: np.ndarray, down: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Read texels (M, N, c) with the weights `down` (ny, M) and `across` (nx, N) of `hats`: (ny, nx, c)."""
    return np.stack([down @ texels[..., c] @ across.T for c in range(texels.shape[2])], -1)


def fit(truth: np.ndarray, down: np.ndarray, across: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Return texels (M, N, c), float64, for which the largest error of reads against `truth` (ny, nx, c) is small.

    down, across: weights of the reads, from `hats`. counted: (ny,) booleans, the rows whose errors matter. The fit is
    weighted least squares, whose weights follow the errors of the round before.
    """
    wy, wx = np.where(counted, 1.0, FAINT), np.ones(truth.shape[1])
    best, least = np.empty(0), np.inf
    for _ in range(ROUNDS):
        py, px = np.linalg.pinv(down * wy[:, None]) * wy, np.linalg.pinv(across * wx[:, None]) * wx
        texels = np.stack([py @ truth[..., c] @ px.T for c in range(truth.shape[2])], -1)
        off = np.abs(read(texels, down, across) - truth).max(-1)[counted]
        if off.max() < least:
            best, least = texels, float(off.max())
        if least == 0:
            break
        # A fourth root, and at least a twentieth, so that rows with small errors keep some weight.
        wy[counted] *= np.maximum(off.max(1) / off.max(), 0.05) ** 0.25
        wx *= np.maximum(off.max(0) / off.max(), 0.05) ** 0.25
    return best


def formats(texels: np.ndarray, dtype: np.dtype[Any]) -> Mapping[str, np.ndarray]:
    """Return the texels as each pixel format holds them, by its name, rounded to nearest.

    The formats are `dtype`, float16 where the values fit, and r8 (8 bits from 0 to 1, clamped) where the values lie
    between -0.1 and 1.1: a fit may leave them slightly outside [0, 1].
    """
    held = {dtype.name: texels.astype(dtype).astype(np.float64)}
    if np.abs(texels).max() <= np.finfo(np.float16).max:
        held["float16"] = texels.astype(np.float16).astype(np.float64)
    if texels.min() >= -0.1 and texels.max() <= 1.1:
        held["r8"] = np.round(np.clip(texels, 0, 1) * 255) / 255
    return held


def errors(off: np.ndarray, counted: np.ndarray) -> dict[str, float]:
    """Return statistics of the absolute errors `off` (ny, nx, c).

    `p99` and `max` are over the rows `counted`, `max_all` over all rows.
    """
    some = off[counted]
    return {"p99": float(np.quantile(some, 0.99)), "max": float(some.max()), "max_all": float(off.max())}
