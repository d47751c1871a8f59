"""The texels nearest some directions, against all of them looked at one by one."""

from __future__ import annotations

import numpy as np
import pytest

from whitefurnace.sphere.grids import Shape
from whitefurnace.sphere.nearest import CORNERS, TEXELS, nearest_texels


@pytest.mark.parametrize(
    "shape",
    [Shape(False, n) for n in (1, 4, 7, 8, 16, 36, 64)] + [Shape(True, n) for n in (1, 8, 9, 16, 32, 48, 100)],
    ids=str,
)
@pytest.mark.parametrize("targets", [1, 2, 8])
def test_nearest_of_all(shape: Shape, targets: int) -> None:
    rng = np.random.default_rng([shape.size, targets])
    for count in (1, 5, 64, 65, 211):
        if count > shape.count:
            continue
        to = rng.normal(size=(targets, 3))
        to /= np.linalg.norm(to, axis=1)[:, None]
        closeness = (to @ shape.directions()).max(0)
        found = nearest_texels(shape, to, count)
        assert len(np.unique(found)) == count and (np.diff(found) > 0).all()
        # 1e-15 is the rounding of a cosine: texels as near as that may stand for each other.
        least = np.sort(closeness)[-count]
        assert closeness[found].min() >= least - 1e-15, (shape, targets, count)


@pytest.mark.parametrize("shape", [Shape(False, 16), Shape(True, 64)], ids=str)
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, -1, 0), (1, 1, 1), (1, 0, -1)])
def test_on_axes_edges_corners_and_poles(shape: Shape, axis: tuple[int, int, int]) -> None:
    """Where many texels are as near as each other, and on both sides of seams."""
    to = np.array([axis], np.float64) / np.linalg.norm(axis)
    closeness = (to @ shape.directions())[0]
    found = nearest_texels(shape, to, 64)
    assert closeness[found].min() >= np.sort(closeness)[-64] - 1e-15


def test_corners_of_a_tile() -> None:
    tile = Shape(False, 16).tiled()[:TEXELS]
    rows, columns = np.divmod(tile[CORNERS], 16)
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 0), (0, 7), (7, 0), (7, 7)]
