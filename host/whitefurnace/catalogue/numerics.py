"""Small float64 functions that several entries share."""

import numpy as np


def expm1_ratio(x):
    """Return (eˣ - 1)/x, 1 at x = 0."""
    return np.where(x == 0, 1.0, np.expm1(x) / np.where(x == 0, 1.0, x))


_SLACK = {np.dtype(np.float16): 4e-3, np.dtype(np.float32): 1e-6}
"""Rounding that is forgiven at the end of a domain, by the type of the input: a few units in its last place."""


def held(values, low, high):
    """Return `values` as float64, where those that leave [low, high] by a rounding are its nearer end.

    A rounding is 1e-12 of the end, 1e-6 for float32 and 4e-3 for float16: a dot product of two unit vectors reaches
    1 + 7e-16. At an end of 0 it counts from 1 where the domain is [0, 1], and nothing is forgiven otherwise. Values
    further outside and NaN are returned as they are. Raises TypeError and ValueError for what are no numbers.
    """
    slack = _SLACK.get(np.asarray(values).dtype, 1e-12)
    array = np.asarray(values, np.float64)
    if not ((array < low) | (array > high)).any():
        return array
    below, above = (slack * (abs(end) or (1.0 if (low, high) == (0, 1) else 0.0)) for end in (low, high))
    array = np.where((array < low) & (array >= low - below), low, array)
    return np.where((array > high) & (array <= high + above), high, array)


def critical_angles(NoV, sine):
    """Return the polar angles of m at which v·m of a ring begins or ceases to reach a critical angle: (3, n).

    sine: sine of the critical angle, NaN for none. The first two lie in the plane of incidence, the third where l is at
    the horizon, since v·m is n·v/(2 n·m) there.
    """
    NoV, sine = np.broadcast_arrays(np.asarray(NoV, np.float64), np.asarray(sine, np.float64))
    with np.errstate(invalid="ignore", divide="ignore"):
        critical, view = np.arcsin(sine), np.arccos(NoV)
        horizon = np.arccos(NoV / (2 * np.cos(critical)))
    return np.stack([np.abs(view - critical), view + critical, horizon])
