"""Defines the lobes that environments are convolved with, and fits to each the short series that kernels evaluate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np

from whitefurnace.catalogue import Model
from whitefurnace.catalogue.choice import Chosen
from whitefurnace.opencl.derived import at_horizon, density_at, lobe_norm, numbers_of
from whitefurnace.opencl.device import Device

NODES = 64
"""Number of Chebyshev nodes at which a series is fitted. At most MOST_TERMS of as many terms are kept."""

MOST_TERMS = 40

CHECKS = 384
"""Points, from each end, at which a series is compared with its lobe. They are as dense towards an end as lobes are
sharp or thin there."""


@dataclass(frozen=True)
class Series:
    """A series that approximates a lobe: K = (1 - q/2)₊ x^power P(slope x - offset), x = 1/(q + shift).

    P is the polynomial of `kernels/lobe_table.clh`. `error` is ∫|K - series| dω / ∫K dω in exact arithmetic.
    """

    shift: float
    slope: float
    offset: float
    power: int
    terms: np.ndarray
    error: float


@dataclass(frozen=True)
class Lobe:
    """A lobe K to convolve with: the cosine of irradiance, or the weighted sum of lobes of one NDF.

    summands  (NDF, its numbers for the kernels, the weight of its D) of each lobe; empty for irradiance
    norm      ∫K dω
    alpha     width of the lobe: the α of a GGX lobe that is as sharp
    horizon   strength of its kink at the horizon: the α of a GGX lobe with the same kink
    density   D at q = |l - r|², float64, where K = D (1 - q/2)₊
    """

    name: str
    summands: tuple[tuple[Model, tuple[float, ...], float], ...]
    norm: float
    alpha: float
    horizon: float
    density: Callable[[np.ndarray], np.ndarray] = field(repr=False, compare=False)
    """D at q, float64: K = D (1 - q/2)₊."""

    @cached_property
    def reach(self) -> float:
        """The value of q beyond which a billionth of the lobe's integral lies, at most 2."""
        edges = np.concatenate([[0.0], np.geomspace(1e-12, 2.0, 2001)])
        q = (edges[1:] + edges[:-1]) / 2
        energy = np.abs(self.density(q)) * np.maximum(1 - q / 2, 0) * np.diff(edges) * math.pi / self.norm
        beyond = np.cumsum(energy[::-1])[::-1]
        return float(edges[1:][np.flatnonzero(beyond > 1e-9)[-1]]) if (beyond > 1e-9).any() else 2.0

    def series(self, low: float, high: float, error: float) -> Series:
        """Return the shortest series for K on q in [low, high] whose error is at most `error` of the lobe's integral.

        If no series reaches that, the most accurate one of MOST_TERMS terms is returned.
        """
        whose = tuple((entry.name, entry.text, *rest) for entry, *rest in self.summands)
        key = (whose, error, low, high)
        if key not in _fitted:
            if len(_fitted) > 4096:
                _fitted.clear()
            _fitted[key] = _fit(self.density, self.norm, low, high, error)
        return _fitted[key]


_fitted: dict[Any, Series] = {}


@cache
def _chebyshev(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes of a Chebyshev series in [-1, 1], and the matrix from values at the nodes to coefficients."""
    angle = (np.arange(count) + 0.5) * math.pi / count
    matrix = 2 / count * np.cos(np.outer(np.arange(count), angle))
    matrix[0] /= 2
    return np.cos(angle), matrix


def _fit(density: Callable[[np.ndarray], np.ndarray], norm: float, low: float, high: float, error: float) -> Series:
    ends = density(np.array([low, low + 0.3 * (high - low), high]))
    # For GGX 1/√D is a line, and this shift leaves a constant, so it is tried first.
    shifts = []
    root = 1 / np.sqrt(np.maximum(ends, 1e-300))
    for other, q in ((1, low + 0.3 * (high - low)), (2, high)):
        if root[other] > root[0] * (1 + 1e-9):
            shifts.append((q - low) / (root[other] / root[0] - 1) - low)
    shifts += [10.0 ** (k / 4) for k in range(-36, 5)]
    shift = np.array([s for s in shifts if math.isfinite(s) and s + low > 1e-12 and s > 0])
    y, matrix = _chebyshev(NODES)
    first, last = 1 / (high + shift), 1 / (low + shift)
    middle, half = (first + last) / 2, (last - first) / 2
    x = middle[:, None] + half[:, None] * y
    q = np.clip(1 / x - shift[:, None], low, high)
    D = density(q.ravel()).reshape(q.shape)
    # ∫ x^power (1 - q/2) dq is the weight of an error of P; dω = π dq, dq = dx/x².
    jacobian = half[:, None] * np.sqrt(1 - y * y) * math.pi / NODES / x**2
    # A candidate's map may put its nodes far from the lobe's energy, so its error is measured at other points.
    edges = np.geomspace(1e-10, high - low, CHECKS)
    edges = np.unique(np.concatenate([[low, high], low + edges, high - edges]))
    at = (edges[1:] + edges[:-1]) / 2
    share = np.maximum(1 - at / 2, 0) * np.diff(edges) * math.pi / norm
    true = density(at)
    best: Series | None = None
    for power in (2, 0):
        coefficients = (D / x**power) @ matrix.T
        weight = (x**power * np.maximum(1 - q / 2, 0) * jacobian).sum(1) * math.pi / norm
        rest = np.cumsum(np.abs(coefficients)[:, ::-1], 1)[:, ::-1] * weight[:, None]
        for k in range(len(shift)):
            enough = np.flatnonzero(rest[k] <= error / 2)
            length = max(min(int(enough[0]) if enough.size else NODES, MOST_TERMS), 1)
            if best is not None and best.error <= error and length >= len(best.terms):
                continue
            slope, offset, terms = 1 / half[k], middle[k] / half[k], coefficients[k, :length]
            x_at = 1 / (at + shift[k])
            found = np.polynomial.chebyshev.chebval(np.clip(slope * x_at - offset, -1, 1), terms) * x_at**power
            missed = float((np.abs(found - true) * share).sum())
            if best is None or missed < max(best.error, error):
                best = Series(float(shift[k]), float(slope), float(offset), power, terms, missed)
    assert best is not None
    return best


def ndf_lobe(device: Device, choice: Chosen, roughness: float, parameters: Mapping[str, Any]) -> Lobe:
    """Return the prefilter's lobe of an NDF.

    roughness: perceptual roughness. parameters: parameters of the NDF, by name. Raises InputError for a user's NDF that
    cannot be normalized.
    """
    entry = choice.model
    rows = np.array([[parameters[p.name]] for p in entry.parameters], np.float64).reshape(-1, 1)
    numbers = tuple(numbers_of(device, entry, rows)[:, 0].tolist())
    norm = lobe_norm(device, entry, parameters)
    # The slope of K/∫K at the horizon is α²/π for GGX. A lobe that lies there entirely (sheen) has the width 1/horizon.
    horizon = math.sqrt(math.pi * at_horizon(device, entry, parameters) / norm)
    return Lobe(
        f"r = {roughness:.3f}",
        ((entry, numbers, 1.0),),
        norm,
        min(max(roughness * roughness, 1e-5), 1 / max(horizon, 1.0)),
        max(horizon, 1e-5),
        lambda q: density_at(device, entry, parameters, q),
    )


def mixture_lobe(
    device: Device,
    choice: Chosen,
    parts: Sequence[tuple[float, float]],
    parameters: Callable[[float], Mapping[str, Any]],
) -> Lobe:
    """Return the weighted sum of an NDF's normalized lobes at several roughness values, a lobe of norm 1.

    parts: (weight, perceptual roughness) of each lobe; the weights sum to 1. parameters: a function that returns the
    NDF's parameters at a roughness. Raises InputError for a user's NDF that cannot be normalized.
    """
    lobes = [(weight, ndf_lobe(device, choice, r, parameters(r))) for weight, r in parts if weight != 0]
    summands = tuple(
        (entry, numbers, weight / lobe.norm) for weight, lobe in lobes for entry, numbers, _ in lobe.summands
    )
    name = f"r = {sum(weight * r for weight, r in parts):.3f} fitted"

    def density(q: np.ndarray) -> np.ndarray:
        return np.sum([weight / lobe.norm * lobe.density(q) for weight, lobe in lobes], 0)

    # The sharpest summand with a visible share decides how fine a grid must be; the slopes at the horizon add up.
    alpha = min(lobe.alpha for weight, lobe in lobes if abs(weight) > 1e-4)
    horizon = math.sqrt(sum(max(weight, 0.0) * lobe.horizon**2 for weight, lobe in lobes))
    return Lobe(name, summands, 1.0, alpha, max(horizon, 1e-5), density)


def _one(q: np.ndarray) -> np.ndarray:
    return np.ones_like(q)


COSINE = Lobe("irradiance", (), math.pi, 1.0, 1.0, _one)
