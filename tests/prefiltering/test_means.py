"""Level 0 from lists that are made once for a pair of grids: their weights against areas found otherwise, symmetries,
and images and grids that must not be mixed up."""

from __future__ import annotations

import math

import numpy as np
import pytest

from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering import means
from whitefurnace.prefiltering.means import Means
from whitefurnace.sphere import overlap
from whitefurnace.sphere.environments import cube_solid_angles, latlong_solid_angles
from whitefurnace.sphere.grids import Shape
from whitefurnace.sphere.overlap import mean_over_texels

STORED = 6.0e-8
"""A level is rounded to float32 once: half an ulp, 2^-24 = 5.96e-8. Areas and sums in float64 leave nothing beside."""


def random_texels(*shape: int) -> np.ndarray:
    return np.random.default_rng(list(shape)).random((*shape, 3), np.float32) + np.float32(0.01)


def level(device: Device, texels: np.ndarray, size: int, degrees: float = 0.0) -> np.ndarray:
    """(6 size², 3) float64."""
    made = Means(device, texels, math.radians(degrees)).level(Shape(False, size))
    return made.reshape(-1, 3).astype(np.float64)


def worst(got: np.ndarray, want: np.ndarray) -> float:
    return float((np.abs(got - want) / want).max())


def one_texel(device: Device, rows: int, columns: int, r: int, c: int, size: int, degrees: float) -> np.ndarray:
    """(6, size, size): the share of each output texel that one source texel covers."""
    texels = np.zeros((rows, columns, 3), np.float32)
    texels[r, c] = 1
    return level(device, texels, size, degrees).reshape(6, size, size, 3)[..., 0]


# ---------------------------------------------------------------------------------------------- weights


@pytest.mark.parametrize("rows, columns", [(1, 1), (1, 2), (3, 6), (5, 3), (17, 34), (33, 68), (64, 128)])
@pytest.mark.parametrize("size", [1, 2, 3, 5, 32])
@pytest.mark.parametrize("degrees", [0.0, 90.0, -133.7])
def test_against_iterated_integrals(device: Device, rows: int, columns: int, size: int, degrees: float) -> None:
    """Widths that 4 divides or not, odd and even rows and faces, on and off the grid: every texel."""
    texels = random_texels(rows, columns)
    want = mean_over_texels(texels, math.radians(degrees), False, size, np.arange(6 * size * size))
    assert worst(level(device, texels, size, degrees), want) <= STORED, (rows, columns, size, degrees)


@pytest.mark.parametrize("where", [(0, 5), (127, 250), (45, 32), (63, 96), (1, 0)], ids=str)
@pytest.mark.parametrize("degrees", [0.0, 11.25, 37.0])
def test_beside_a_sun(device: Device, where: tuple[int, int], degrees: float) -> None:
    """A texel 1e8 times as bright as the darkest, by the poles, the equator and a seam: no light of it where it is
    not, and its slivers are whole."""
    texels = random_texels(128, 256)
    texels[where] = 1e6
    for size in (16, 64):
        want = mean_over_texels(texels, math.radians(degrees), False, size, np.arange(6 * size * size))
        # What is no overlap has no weight at all, and an area's error, 1e-14 of a texel's, is 1e-6 of the darkest
        # texel only in a sliver as thin: anything else is float32 storage.
        assert worst(level(device, texels, size, degrees), want) <= STORED, (where, size, degrees)


def test_caps_in_closed_form(device: Device) -> None:
    """The cap θ ≤ π/4 cuts a disc of radius 1 out of +Y, which its sides just touch; θ ≤ π/8 one of tan π/8."""
    for rows, covered in ((8, 1), (8, 2), (48, 5)):
        texels = np.zeros((rows, 2 * rows, 3), np.float32)
        texels[:covered] = 1
        share = level(device, texels, 2).reshape(6, 4, 3)[..., 0]
        theta = covered * math.pi / rows
        # A quarter of the cap's 2π(1 - cos θ) over a quarter of the face's 4π/6.
        assert np.allclose(share[2], 3 * (1 - math.cos(theta)), rtol=STORED, atol=0), (rows, covered)
        assert not share[[0, 1, 3, 4, 5]].any()


def test_bands_in_closed_form(device: Device) -> None:
    """The first rows below the equator on a side face of one texel: ∫ y dψ of a parallel, y constant."""
    texels = np.zeros((16, 32, 3), np.float32)
    texels[8:10] = 1
    share = level(device, texels, 1).reshape(6, 3)[:, 0]
    # A quarter of the band's 2π cos(10π/16) over the face's 4π/6; it stays 22.5° from the equator, the face 35°.
    want = 0.75 * -math.cos(10 * math.pi / 16)
    assert np.allclose(share[[0, 1, 4, 5]], want, rtol=STORED, atol=0) and not share[2:4].any()


@pytest.mark.parametrize("columns", [32, 30], ids=["four turns", "one"])
@pytest.mark.parametrize("size", [4, 5])
def test_whole_in_every_place(device: Device, columns: int, size: int) -> None:
    """One texel among black, at every longitude of some rows, each on its own: all of its energy, wherever the
    cube's symmetries find it."""
    rows = 16
    omega = latlong_solid_angles(rows, columns)
    areas = cube_solid_angles(size)
    for r in (0, 3, 7, 8, 15):
        for c in range(columns):
            got = float((areas * one_texel(device, rows, columns, r, c, size, 7.0)).sum())
            assert abs(got / omega[r] - 1) <= 2 * STORED, (r, c)


def test_weights_add_up(device: Device) -> None:
    """∑ weight is 1 for an output texel, and over all outputs a source texel's own solid angle: energy is kept to the
    rounding of each texel, and to 1e-9 on average over many."""
    texels = random_texels(96, 192)
    omega = latlong_solid_angles(96, 192)
    want = np.einsum("r,rck->k", omega, texels.astype(np.float64))
    for degrees in (0.0, 20.0):
        made = level(device, texels, 128, degrees).reshape(6, 128, 128, 3)
        have = np.einsum("ij,fijk->k", cube_solid_angles(128), made)
        # 98 304 roundings of 3e-8 each in either direction: 1e-10 of the sum, and 10 times that is allowed.
        assert np.abs(have / want - 1).max() <= 1e-9
    flat = np.full((96, 192, 3), 0.7, np.float32)
    assert (level(device, flat, 128, 20.0) == np.float64(np.float32(0.7))).all()


@pytest.mark.parametrize("n", [1, 2, 5, 16, 48])
@pytest.mark.parametrize("size", [1, 2, 3, 8, 31, 64])
def test_cubes_on_cubes(device: Device, n: int, size: int) -> None:
    """Faces of other sizes, no turn: rectangles against iterated integrals."""
    texels = random_texels(6, n, n)
    want = mean_over_texels(texels, 0.0, False, size, np.arange(6 * size * size))
    assert worst(level(device, texels, size), want) <= STORED


@pytest.mark.parametrize("n", [2, 3, 16, 37])
@pytest.mark.parametrize("size", [1, 4, 7, 64])
def test_two_references_agree(n: int, size: int) -> None:
    """Rectangles, and polygons between four planes of which the six faces have their parts."""
    texels = random_texels(6, n, n)
    texels[2, 0, n // 2] = 1e6
    index = np.arange(0, 6 * size * size, max(size * size // 10, 1))
    sums, area = overlap._cube_from_cube(texels, 0.0, size, index)
    # Gauss nodes leave 1e-13 of the largest pieces, and rounding 1e-15 of a texel beside a sun 1e8 times its own.
    assert worst(mean_over_texels(texels, 0.0, False, size, index), sums / area[:, None]) <= 1e-11


def test_cube_in_the_limit(device: Device) -> None:
    """Nested faces: a texel of four is their mean by solid angle."""
    texels = random_texels(6, 64, 64)
    areas = cube_solid_angles(64)
    blocks = (texels * areas[..., None]).reshape(6, 32, 2, 32, 2, 3).sum((2, 4), dtype=np.float64)
    want = blocks / areas.reshape(32, 2, 32, 2).sum((1, 3))[..., None]
    assert worst(level(device, texels, 32), want.reshape(-1, 3)) <= 2 * STORED  # the product is a float32's


# ---------------------------------------------------------------------------------------------- symmetry


@pytest.mark.parametrize("size", [6, 7])
@pytest.mark.parametrize("columns", [24, 22])
def test_generators_give_every_texel_once(device: Device, size: int, columns: int) -> None:
    """Each texel is written, by an even and an odd face, with and without quarter turns: a texel that is left out
    keeps what the memory held."""
    texels = np.ones((11, columns, 3), np.float32)
    assert (level(device, texels, size, 3.0) == 1).all()
    turns = 4 if columns == 24 else 1
    upper, polar = -(-size // 2) * size, size * size
    want = upper + (polar // 4 + size % 2) if turns == 4 else 4 * upper + polar
    assert means._generators(size, turns) == want


@pytest.mark.parametrize("rows, columns", [(1, 1), (2, 3), (9, 16), (31, 64)])
@pytest.mark.parametrize("size", [1, 7, 32])
@pytest.mark.parametrize("degrees", [0.0, 45.0, 179.99, -180.0])
def test_lists_lie_within_the_image(device: Device, rows: int, columns: int, size: int, degrees: float) -> None:
    """Every overlap is of a texel that there is, by a share in [0, 1], and the shares of each generator add up to 1."""
    means._batches.cache_clear()
    (batch,) = means._batches(device, rows, columns, math.radians(degrees), size)
    assert batch.lists is not None
    start, where, weight = batch.start.read(), *(part.read() for part in batch.lists)
    assert batch.count == means._generators(size, means._turns(columns)) == len(start) - 1
    assert (np.diff(start) > 0).all() and start[-1] == len(weight) == len(where)
    assert where.min() >= 0 and (where < (rows, columns)).all()
    assert weight.min() >= 0 and weight.max() <= 1
    # A few ulps of 1 from sums of at most some hundreds.
    assert np.abs(np.add.reduceat(weight, start[:-1]) - 1).max() <= 1e-13


def test_turns_and_mirrors(device: Device) -> None:
    """A source turned by a quarter gives faces that change places; upside down, rows that do."""
    texels = random_texels(20, 40)
    size = 8
    made = level(device, texels, size).reshape(6, size, size, 3)
    turned = level(device, np.roll(texels, 10, 1), size).reshape(6, size, size, 3)
    assert np.allclose(turned[[4, 1, 5, 0]], made[[0, 4, 1, 5]], rtol=2 * STORED, atol=0)  # +X -> +Z -> -X -> -Z
    assert np.allclose(turned[2], np.rot90(made[2], -1), rtol=2 * STORED, atol=0)
    mirrored = level(device, texels[::-1].copy(), size).reshape(6, size, size, 3)
    assert np.allclose(mirrored[[0, 1, 3, 2, 4, 5]], made[:, ::-1], rtol=2 * STORED, atol=0)


@pytest.mark.parametrize("degrees", [0.0, 17.0])
def test_rotation_is_a_shift_of_columns(device: Device, degrees: float) -> None:
    """A whole number of columns, as a rotation or as a roll of the image."""
    texels = random_texels(18, 36)
    rolled = level(device, np.roll(texels, 7, 1), 16, degrees)
    assert worst(level(device, texels, 16, degrees + 70.0), rolled) <= 2 * STORED


# ---------------------------------------------------------------------------------------------- kept lists


def test_lists_are_not_mixed_up(device: Device) -> None:
    """Images of one size share lists; other sizes, rotations and outputs have their own, in any order of asking."""
    cases = [((12, 24), 0.0, 8), ((12, 24), 30.0, 8), ((24, 12), 0.0, 8), ((12, 24), 0.0, 4), ((16, 24), 0.0, 8)]
    rng = np.random.default_rng(5)
    for case in [*cases, *cases[::-1], *cases]:
        source, degrees, size = case
        texels = rng.random((*source, 3), np.float32) + np.float32(0.01)
        want = mean_over_texels(texels, math.radians(degrees), False, size, np.arange(6 * size * size))
        assert worst(level(device, texels, size, degrees), want) <= STORED, case


def test_a_second_image_finds_its_lists(device: Device) -> None:
    means._batches.cache_clear()
    for k in range(3):
        level(device, random_texels(14, 28) + np.float32(k), 8, 1.0)
    found = means._batches.cache_info()
    assert (found.misses, found.hits) == (1, 2)


def test_lists_that_are_too_long_are_made_in_parts(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Part by part, and not kept: the same bits."""
    texels = random_texels(40, 80)
    whole = level(device, texels, 16, 9.0)
    means._batches.cache_clear()
    monkeypatch.setattr(means, "OVERLAPS", 200)
    parts = level(device, texels, 16, 9.0)
    batches = means._batches(device, 40, 80, math.radians(9.0), 16)
    means._batches.cache_clear()
    assert len(batches) > 3 and all(batch.lists is None for batch in batches)
    assert sum(batch.count for batch in batches) == means._generators(16, 4)
    assert (parts == whole).all()


def test_the_source_is_left_alone(device: Device) -> None:
    texels = random_texels(6, 4, 4)
    made = Means(device, texels, 0.0).level(Shape(False, 4))
    assert (made == texels).all() and not np.shares_memory(made, texels)
