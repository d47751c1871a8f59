"""The statement of a level from a sample of its texels: error, worst, rmse, as the README defines them."""
from __future__ import annotations

import math

import numpy as np


def texel_errors(values: np.ndarray, reference: np.ndarray, mean: float) -> np.ndarray:
    """(m,): max over channels of |x - ref| / max(ref, 1e-3 · mean), 0/0 = 0. values, reference: (m, 3)."""
    difference = np.abs(values - reference)
    floor = np.maximum(reference, 1e-3 * mean)
    return np.divide(difference, floor, out=np.zeros_like(difference, np.float64), where=floor > 0).max(1, initial=0.0)


def statement(values: np.ndarray, reference: np.ndarray, sample: tuple[np.ndarray, np.ndarray],
              solid_angle: np.ndarray, mean: float, total: int) -> tuple[float, float, float]:
    """(error, worst, rmse) of a level from its sample.

    sample: texel indices, a uniform draw and a stratum. values, reference: (m, 3) and solid_angle: (m,) of the
    two in this order. In `rmse` the stratum stands for itself and the uniform texels outside it, by inverse
    probability, for the rest.
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
    if not np.isfinite(errors).all():
        return math.inf, math.inf, math.inf
    largest = np.sort(errors[:uniform])[::-1]
    return float(largest[rank(uniform) if uniform < total else 0]), float(errors.max()), rmse


QUANTILE, CONFIDENCE = 0.99, 0.95


def rank(n: int) -> int:
    """Which of n errors of uniform texels, the largest being 0, bounds the 99th percentile at 95 % confidence: that
    many and fewer lie above the percentile with a probability of at most 5 % (order statistic). 0 for the least n,
    299."""
    # The logarithm, since .99^n is less than any float64 beyond 74 000.
    found, chance, below = -1, n * math.log(QUANTILE), 0.0
    while below + math.exp(chance) <= 1 - CONFIDENCE:
        below += math.exp(chance)
        found += 1
        chance += math.log((n - found) / (found + 1) * (1 - QUANTILE) / QUANTILE)
    return max(found, 0)
