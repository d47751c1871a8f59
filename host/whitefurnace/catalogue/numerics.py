"""Small float64 functions that several entries share."""

import numpy as np


def expm1_ratio(x):
    """Return (eˣ - 1)/x, 1 at x = 0."""
    return np.where(x == 0, 1.0, np.expm1(x) / np.where(x == 0, 1.0, x))
