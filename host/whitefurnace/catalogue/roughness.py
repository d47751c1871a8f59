"""Conversions between perceptual roughness r, α and the Phong exponent n.

Each broadcasts and raises UsageError outside its domain. α = r² is the convention of [Burley2012]. Beckmann and GGX of
one α share the peak 1/(πα²) and nothing more: with x = tan²θ/α² the one falls like e^-x, the other like (1 + x)^-2,
faster at first and far slower in the tail. Phong of n = 2/α² - 2 has the same peak, (n + 2)/(2π), and is Beckmann up to
O(α²). [Walter2007, sec. 5.2]
"""

from __future__ import annotations

from typing import Any

import numpy as np

from whitefurnace.catalogue.model import Parameter
from whitefurnace.errors import UsageError

ROUGHNESS = Parameter(
    "roughness", "r", "1", 0.0, 1.0, (0.0, 0.1, 0.3, 0.5, 0.8, 1.0), "perceptual roughness, the root of α"
)


def _positive(values: Any, most: float, what: str) -> np.ndarray:
    array = np.asarray(values, np.float64)
    bad = ~((array > 0) & (array <= most))  # also catches NaN
    if bad.any():
        raise UsageError(f"{what} = {array[bad].flat[0]:g} is outside ]0, {most:g}]")
    return array


def alpha_of_roughness(r: Any) -> Any:
    """Return α = r² for perceptual roughness r in [0, 1]."""
    return np.square(ROUGHNESS.check(r, "roughness"))


def roughness_of_alpha(alpha: Any) -> Any:
    """Return the perceptual roughness r = √α for α in [0, 1]."""
    array = np.asarray(alpha, np.float64)
    return np.sqrt(np.where(array == 0, 0.0, _positive(np.where(array == 0, 1.0, array), 1.0, "alpha")))[()]


def exponent_of_alpha(alpha: Any) -> Any:
    """Return the Phong exponent n = 2/α² - 2 for α in ]0, 1], 0 at α = 1. [Walter2007, sec. 5.2]"""
    array = _positive(alpha, 1.0, "alpha")
    return 2 * (1 - array) * (1 + array) / np.square(array)


def alpha_of_exponent(exponent: Any) -> Any:
    """Return α = √(2/(n + 2)) for a Phong exponent n ≥ 0."""
    array = np.asarray(exponent, np.float64)
    bad = ~((array >= 0) & np.isfinite(array))
    if bad.any():
        raise UsageError(f"exponent = {array[bad].flat[0]:g} is outside [0, ∞[")
    return np.sqrt(2 / (array + 2))


def alpha_within(r: Any, parameter: Parameter) -> Any:
    """Return α = r², held to the domain of an NDF's parameter α."""
    return np.clip(alpha_of_roughness(r), parameter.low, parameter.high)
