"""The exact solid angles of the texels of lat-longs and cubes."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

_KEPT_SIZE = 512  # faces of up to 2 MiB of solid angles are kept: every level and image asks for the same


def latlong_solid_angles(height: int, width: int) -> npt.NDArray[np.float64]:
    """Return the solid angle, in steradians, of one texel in each row of a lat-long: (height,).

    It is (2π/width)(cos θ0 - cos θ1) for the polar angles of the row's edges.
    """
    centre = (np.arange(height) + 0.5) * (math.pi / height)
    # As a product of sines: the difference of cosines cancels at the poles.
    return (2 * math.pi / width) * 2 * np.sin(centre) * math.sin(0.5 * math.pi / height)


def cube_solid_angles(size: int) -> npt.NDArray[np.float64]:
    """Return the solid angles, in steradians, of the texels of one cube face: (size, size), read-only.

    They are differences over the corners of atan(x y/√(1 + x² + y²)), the solid angle between the face's centre and (x,
    y).
    """
    return _kept_solid_angles(size) if size <= _KEPT_SIZE else _cube_solid_angles(size)


@lru_cache(maxsize=12)
def _kept_solid_angles(size: int) -> npt.NDArray[np.float64]:
    angles = _cube_solid_angles(size)
    angles.flags.writeable = False
    return angles


def _cube_solid_angles(size: int) -> npt.NDArray[np.float64]:
    edge = np.arange(size + 1) * (2 / size) - 1
    x, y = edge[None, :], edge[:, None]
    corner = np.arctan(x * y / np.sqrt(1 + x * x + y * y))
    return np.diff(np.diff(corner, axis=0), axis=1)
