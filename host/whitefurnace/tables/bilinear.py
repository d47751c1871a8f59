"""Tables as a GPU reads them: bilinearly, clamped at the edges. Texels that read best, and what a read is off by."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

SAMPLES = 6
"""Points a texel and axis that a fit sees."""

ROUNDS = 4
"""Rounds of weights that follow the errors [Lawson1961], axis by axis: the first round is least squares; four bring a
64² split-sum table from 4.4e-3 to 3.7e-3 at its worst, more trade the 99th percentile for nothing."""

LEAST = 0.045
"""Roughness that engines shade with at least [Lagarde2014]: r = n·v = 0 is a point where the pair has no limit, and no
table of texels holds it. Below, a fit weighs little and errors are stated apart."""

FAINT = 1e-2
"""The weight of rows below that."""


def hats(count: int, x: np.ndarray) -> np.ndarray:
    """(n, count): weights of texels in a linear read at texel coordinates x (n,), 0 the first texel's centre."""
    x = np.clip(x, 0, count - 1)
    first = np.minimum(x.astype(np.intp), max(count - 2, 0))
    weights = np.zeros((x.size, count))
    weights[np.arange(x.size), first] = 1 - (x - first)
    if count > 1:
        weights[np.arange(x.size), first + 1] += x - first
    return weights


def read(texels: np.ndarray, down: np.ndarray, across: np.ndarray) -> np.ndarray:
    """(ny, nx, c): reads of texels (M, N, c) by the weights of both axes."""
    return np.stack([down @ texels[..., c] @ across.T for c in range(texels.shape[2])], -1)


def fit(truth: np.ndarray, down: np.ndarray, across: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """(M, N, c) float64: texels whose reads are nearest to `truth` (ny, nx, c) at its worst, by least squares with
    weights that follow the errors; `counted` (ny,) are the rows that matter."""
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
        # A fourth root, and no less than a twentieth, so that what errs little is not forgotten.
        wy[counted] *= np.maximum(off.max(1) / off.max(), 0.05) ** 0.25
        wx *= np.maximum(off.max(0) / off.max(), 0.05) ** 0.25
    return best


def formats(texels: np.ndarray, dtype: np.dtype[Any]) -> Mapping[str, np.ndarray]:
    """The texels as formats hold them, rounded to the nearest: as they are, float16, and r8, 8 bits from 0 to 1 with
    what a fit leaves beyond clamped, where they lie about there."""
    held = {dtype.name: texels.astype(dtype).astype(np.float64)}
    if np.abs(texels).max() <= np.finfo(np.float16).max:
        held["float16"] = texels.astype(np.float16).astype(np.float64)
    if texels.min() >= -0.1 and texels.max() <= 1.1:
        held["r8"] = np.round(np.clip(texels, 0, 1) * 255) / 255
    return held


def errors(off: np.ndarray, counted: np.ndarray) -> dict[str, float]:
    """p99 and max of absolute errors (ny, nx, c) over the rows that count, and the largest of all."""
    some = off[counted]
    return {"p99": float(np.quantile(some, 0.99)), "max": float(some.max()), "max_all": float(off.max())}
