"""Baking commutes with whatever maps the cube onto itself: the 24 rotations and their mirror images; and with turns
and mirrors of a lat-long."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

from whitefurnace import harmonics, irradiance, prefilter

SIZES = dict(size=32, min_size=8)

# An image and its turn are the same sums in another order and with directions rounded anew: float32 leaves up to
# 6e-8 · a few/α of a lobe, α = .086 the sharpest here, and 7e-7 in a sum. 7.5e-6 was the largest difference on PoCL;
# a misplaced texel or a wrong weight is off by 1e-3 and more.
ROUNDED = 2e-5


@functools.cache
def cube_directions(n):
    """(6, n, n, 3): +X = (1,-t,-s), -X = (-1,-t,s), +Y = (s,1,t), -Y = (s,-1,-t), +Z = (s,-t,1), -Z = (-s,-t,-1), not
    normalized: odd integers and n."""
    middle = 2 * np.arange(n) + 1 - n
    t, s = np.meshgrid(middle, middle, indexing="ij")
    one = np.full_like(s, n)
    return np.array(
        [
            np.stack(f, -1)
            for f in [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
        ]
    )


def signed_permutations():
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            matrix = np.zeros((3, 3), int)
            matrix[range(3), axes] = signs
            yield matrix


ROTATIONS = [m for m in signed_permutations() if round(np.linalg.det(m)) == 1]
MIRRORS = [np.diag(d) for d in ((-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1))]


def name(matrix):
    return " ".join(("+" if row.sum() > 0 else "-") + "xyz"[int(np.abs(row).argmax())] for row in matrix)


def turned(cube, matrix):
    """The cube whose value towards M d is the given one's towards d: whole texels change places."""
    n = cube.shape[1]
    d = cube_directions(n).reshape(-1, 3)
    place = {tuple(key): k for k, key in enumerate(d.tolist())}
    moved = [place[tuple(key)] for key in (d @ matrix.T).tolist()]
    out = np.empty_like(cube)
    out.reshape(len(d), -1)[moved] = cube.reshape(len(d), -1)
    return out


def noise():
    cube = np.random.default_rng(11).random((6, 32, 32, 3), dtype=np.float32)
    cube[1, 3, 31] = 3e3  # a sun at an edge
    return cube


@functools.cache
def baked():
    return prefilter(noise(), **SIZES).values


def close(got, want, what):
    error = np.abs(got - want) / want
    at = tuple(int(i) for i in np.unravel_index(error.argmax(), error.shape))
    assert error.max() <= ROUNDED, f"{what}: {got[at]} and not {want[at]} at {at}, off by {error.max():.2g}"


def test_there_are_24_rotations_and_turning_is_what_it_says():
    assert len(ROTATIONS) == 24 and len({name(m) for m in ROTATIONS}) == 24
    # A quarter turn about +Y that takes +X to +Z takes the whole face +X to the face +Z, upright.
    turn = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    cube = noise()
    np.testing.assert_array_equal(turned(cube, turn)[4], cube[0])


@pytest.mark.few(8)
@pytest.mark.parametrize("matrix", [*ROTATIONS, *MIRRORS], ids=name)
def test_a_cube_that_is_turned(matrix):
    values = prefilter(turned(noise(), matrix), **SIZES).values
    np.testing.assert_array_equal(values[0], turned(baked()[0], matrix))  # the very texels
    for k in (1, 2):
        close(values[k], turned(baked()[k], matrix), f"level {k}")


@pytest.mark.parametrize("matrix", [ROTATIONS[5], ROTATIONS[18], MIRRORS[2]], ids=name)
def test_irradiance_and_harmonics_turn_too(matrix):
    cube = noise()
    close(irradiance(turned(cube, matrix)).values, turned(irradiance(cube).values, matrix), "irradiance")
    before, after = harmonics(cube), harmonics(turned(cube, matrix))
    # L1-1, L10, L11 go with y, z, x: a vector's components.
    bound = (before.error + after.error) * before.values[0].max()
    vector = before.values[[3, 1, 2]]
    assert np.abs(after.values[[3, 1, 2]] - matrix @ vector).max() <= bound
    assert np.abs(after.values[0] - before.values[0]).max() <= bound
    # The power of degree 2 does not change; the error of a square is twice that of its root.
    power = [(h.values[4:] ** 2).sum(0) for h in (before, after)]
    assert np.abs(power[0] - power[1]).max() <= 2 * 5 * bound * np.abs(before.values[4:]).max()


# --- lat-longs ------------------------------------------------------------------------------------------


def panorama():
    pixels = np.random.default_rng(12).random((32, 64, 3), dtype=np.float32)
    pixels[8, 20] = 2e3
    return pixels


QUARTER = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # azimuth atan2(z, x) grows by 90°: a shift right by w/4


@pytest.mark.parametrize(
    "change, matrix",
    [
        (lambda p: np.roll(p, 16, 1), QUARTER),
        (lambda p: np.roll(p, 32, 1), QUARTER @ QUARTER),
        (lambda p: np.roll(p, -16, 1), QUARTER.T),
        (lambda p: p[:, ::-1], np.diag([1, 1, -1])),  # u -> 1 - u: z changes sign
        (lambda p: p[::-1], np.diag([1, -1, 1])),
        (lambda p: p[::-1, ::-1], np.diag([1, -1, -1])),
    ],
    ids=["quarter", "half", "back", "mirrored", "upside down", "turned over"],
)
def test_a_latlong_that_is_shifted_or_mirrored(change, matrix):
    want = prefilter(panorama(), **SIZES).values
    got = prefilter(np.ascontiguousarray(change(panorama())), **SIZES).values
    for k in range(3):
        close(got[k], turned(want[k], matrix), f"level {k}")


@pytest.mark.parametrize("columns", [2, 6, 22, -10])
def test_any_shift_of_a_latlong_is_a_shift_of_lat_long_levels(columns):
    want = prefilter(panorama(), latlong=True, **SIZES)
    got = prefilter(np.roll(panorama(), columns, 1), latlong=True, **SIZES)
    for k, level in enumerate(want.values):
        shifted = np.roll(level, columns * level.shape[1] // 64, 1)
        error = np.abs(got.values[k] - shifted) / shifted
        if k == 0:
            assert error.max() <= ROUNDED
            continue
        # The grid of nodes does not turn by this angle: each side is off by what it states, of which 1 % of the
        # texels may be over.
        bound = want.error[k] + got.error[k]
        assert (error.max(-1) > bound).mean() <= 0.02, f"level {k}: {error.max():.2g}, stated {bound:.2g}"
