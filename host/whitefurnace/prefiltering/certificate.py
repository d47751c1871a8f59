"""Estimates the errors of a level from a sample of its texels: error, worst and rmse."""

from __future__ import annotations

import math

import numpy as np


def texel_errors(values: np.ndarray, reference: np.ndarray, mean: float) -> np.ndarray:
    """Return texel errors (m,): the maximum over channels of |x - ref| / max(ref, 1e-3 · mean), with 0/0 = 0.

    values, reference: (m, 3) radiance. mean: mean radiance of the level.
    """
    difference = np.abs(values - reference)
    floor = np.maximum(reference, 1e-3 * mean)
    return np.divide(difference, floor, out=np.zeros_like(difference, np.float64), where=floor > 0).max(1, initial=0.0)


def statement(
    values: np.ndarray,
    reference: np.ndarray,
    sample: tuple[np.ndarray, np.ndarray],
    solid_angle: np.ndarray,
    mean: float,
    total: int,
) -> tuple[float, float, float]:
    """Return the stated (error, worst, rmse) of a level, from a sample of its texels.

    `error` bounds the 99th percentile of the texel errors at 95 % confidence, by the uniform draw. `worst` is the
    largest of all. In `rmse` the near-source texels have their own weight, and the uniform texels outside them are
    weighted by inverse probability for the rest of the level. All three are infinite where a texel error is not finite.

    sample: texel indices, those of a uniform draw and those of the near-source sample. values, reference: (m, 3)
    radiance of both, in this order. solid_angle: (m,) solid angles of these texels. mean: mean radiance of the level.
    total: number of texels of the level.
    """
    reference = reference.astype(np.float64)
    errors = texel_errors(values, reference, mean)
    difference = np.abs(values - reference)
    weight = solid_angle.copy()
    uniform = len(sample[0])
    outside = ~np.isin(sample[0], sample[1])
    weight[:uniform] *= outside * (total - len(sample[1])) / max(int(outside.sum()), 1)
    energy = float((weight[:, None] * reference**2).sum())
    rmse = math.sqrt(float((weight[:, None] * difference**2).sum()) / energy) if energy > 0 else 0.0
    if not (np.isfinite(errors).all() and math.isfinite(mean)):  # a texel outside the sample shows in the mean
        return math.inf, math.inf, math.inf
    largest = np.sort(errors[:uniform])[::-1]
    return float(largest[rank(uniform) if uniform < total else 0]), float(errors.max()), rmse


QUANTILE, CONFIDENCE = 0.99, 0.95


def rank(n: int) -> int:
    """Return the rank, from the largest error down, of the one that bounds the 99th percentile of n uniform texels.

    The bound holds at 95 % confidence: the probability that this many errors or fewer lie above the percentile is at
    most 5 % (order statistic). The rank is 0, the largest error, for n = 299, the smallest n that gives a bound.
    """
    # The sum uses logarithms, since .99^n underflows float64 beyond n = 74 000.
    found, chance, below = -1, n * math.log(QUANTILE), 0.0
    while below + math.exp(chance) <= 1 - CONFIDENCE:
        below += math.exp(chance)
        found += 1
        chance += math.log((n - found) / (found + 1) * (1 - QUANTILE) / QUANTILE)
    return max(found, 0)
