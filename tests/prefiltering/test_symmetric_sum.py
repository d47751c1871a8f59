"""The sums by the symmetries of the cube against a double loop in float64 numpy over all pairs, with the NDF's own
reference."""

from __future__ import annotations

import math

import numpy as np
import pytest

from whitefurnace.catalogue import models
from whitefurnace.catalogue.choice import chosen
from whitefurnace.opencl.constants import RUN, TILE
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.prefiltering.lobes import COSINE, Lobe, ndf_lobe
from whitefurnace.prefiltering.plan import Part, Window
from whitefurnace.prefiltering.symmetry import Octahedral, Orbits, orbits, tile_bounds
from whitefurnace.sphere.grids import Shape, grid_tangents

CUBES = [Shape(False, n) for n in (1, 2, 4, 16, 32, 33)]
LATLONGS = [Shape(True, n) for n in (2, 4, 16)]
BASE = np.array([0.1, 0.2, 0.3])
PER_NORM = 0.25

NEAR, MIDDLE = Window(0.01, 0.08), Window(0.02, 0.3)
"""Windows whose steps overlap: between .02 and .08 three parts have a share."""


def whole(n: int) -> list[Part]:
    return [Part(n, None, None)]


PARTS = {
    "one of 24": whole(24),
    "one of 32": whole(32),
    "one of 64": whole(64),
    "two": [Part(64, None, MIDDLE), Part(32, MIDDLE, None)],
    "three": [Part(96, None, NEAR), Part(64, NEAR, MIDDLE), Part(32, MIDDLE, None)],
}


def ggx(device: Device, r: float) -> Lobe:
    return ndf_lobe(device, chosen("ndf", "ggx"), r, {"alpha": r * r})


def grid_directions(n: int) -> np.ndarray:
    """(6, n, n, 3): +X = (1,-t,-s), -X = (-1,-t,s), +Y = (s,1,t), -Y = (s,-1,-t), +Z = (s,-t,1), -Z = (-s,-t,-1)."""
    t, s = np.meshgrid(grid_tangents(n), grid_tangents(n), indexing="ij")
    o = np.ones_like(s)
    faces = [(o, -t, -s), (-o, -t, s), (s, o, t), (s, -o, -t), (s, -t, o), (-s, -t, -o)]
    d = np.array([np.stack(face, -1) for face in faces])
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def grid(n: int, seed: int = 0) -> np.ndarray:
    """(6, n, n, 4) of (wL, w): weights near the solid angles that no symmetry leaves as they are, radiance in [0, 1.5]
    with single nodes 50 times as bright."""
    rng = np.random.default_rng([n, seed])
    tangent = grid_tangents(n)
    s, t = tangent, tangent[:, None]
    w = (1 + s**2) * (1 + t**2) * (1 + s**2 + t**2) ** -1.5 * (math.pi / 2 / n) ** 2 * rng.uniform(0.8, 1.2, (6, n, n))
    L = rng.random((6, n, n, 3)) + 0.5 * (rng.random((6, n, n, 1)) < 0.5)
    L[rng.random((6, n, n)) < 0.01] *= 50
    return np.concatenate([w[..., None] * L, w[..., None]], -1)


def symmetric_weights(values: np.ndarray) -> np.ndarray:
    """(6, n, n): the mean weight of each node's images, those of the same |coordinates| on their face."""
    n = values.shape[1]
    a = np.abs(2 * np.arange(n) + 1 - n)
    key = np.minimum(a, a[:, None]) * n + np.maximum(a, a[:, None])
    key = np.broadcast_to(key, (6, n, n)).ravel()
    return (np.bincount(key, values[..., 3].ravel()) / np.maximum(np.bincount(key), 1))[key].reshape(6, n, n)


def step(q: np.ndarray, window: Window) -> np.ndarray:
    """The smoothstep of seventh degree, from its definition: ∫ t³(1 - t)³ over the whole of it."""
    t = np.clip((q - window.q0) / (window.q1 - window.q0), 0, 1)
    return 140 * (t**4 / 4 - 3 * t**5 / 5 + 3 * t**6 / 6 - t**7 / 7)


def truth(
    lobe: Lobe, parts: list[Part], grids: dict[int, np.ndarray], directions: np.ndarray, bright: np.ndarray | None
) -> np.ndarray:
    """(m, 3): what `unfold` writes at directions (3, m)."""
    sums, weight = np.zeros((directions.shape[1], 3)), np.zeros(directions.shape[1])

    def K(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = ((directions.T[:, None] - nodes[None]) ** 2).sum(-1)
        return q, lobe.density(np.minimum(q, 2.0).ravel()).reshape(q.shape) * np.maximum(1 - q / 2, 0)

    for part in parts:
        values, w = grids[part.grid], symmetric_weights(grids[part.grid])
        nodes = grid_directions(part.grid).reshape(-1, 3)
        for rows in np.array_split(np.arange(len(nodes)), max(len(nodes) * directions.shape[1] // 2_000_000, 1)):
            q, k = K(nodes[rows])
            # Steps may overlap: the difference of two and no product, so that parts add up to the lobe.
            k *= (step(q, part.inner) if part.inner else 1) - (step(q, part.outer) if part.outer else 0)
            sums += k @ values.reshape(-1, 4)[rows, :3]
            weight += k @ w.ravel()[rows]
    level = sums / weight[:, None] + BASE
    return level if bright is None else level + PER_NORM * K(bright[:, :3])[1] @ bright[:, 4:7]


def bright_list(count: int) -> np.ndarray:
    rng = np.random.default_rng(count)
    d = rng.normal(size=(count, 3))
    return np.concatenate(
        [d / np.linalg.norm(d, axis=1)[:, None], np.zeros((count, 1)), rng.random((count, 3)), np.zeros((count, 1))], 1
    )


def symmetric(
    o: Octahedral,
    shape: Shape,
    lobe: Lobe,
    parts: list[Part],
    grids: dict[int, np.ndarray],
    bright: np.ndarray | None = None,
    splits: int = 2,
    error: float = 1e-7,
    most: int = 1 << 14,
) -> np.ndarray:
    """(dims, 3) float32 from the device; NaN where no texel was written."""
    level = o.device.array(np.full((*shape.dims, 3), np.nan, np.float32), writable=True)
    buffers = {n: o.device.array(values.astype(o.kind)) for n, values in grids.items()}
    for found in o.orbits(shape, most):
        classes = {n: o.classes(n, buffer, found.exchanges) for n, buffer in buffers.items()}
        sums = []
        for near in (False, True):
            some = [part for part in parts if (part.outer is not None) == near]
            partial = o.empty(max(splits * len(some), 1), found)
            for k, part in enumerate(some):
                o.convolve(partial, k * splits, splits, found, lobe, part, classes[part.grid], error)
            sums.append(partial if some else None)
        apart = o.apart(found, lobe, o.device.array(bright.astype(o.kind))) if bright is not None else None
        assert sums[0]
        o.unfold(level, found, sums[0], sums[1], apart, PER_NORM, BASE)
    return level.read()


def looked_at(shape: Shape, count: int = 150) -> np.ndarray:
    """Texels with every kind among them: those that symmetries leave where they are come first."""
    if shape.count <= count:
        return np.arange(shape.count)
    index = np.arange(shape.count).reshape(shape.dims)
    special = (
        index[0]
        if shape.latlong
        else np.concatenate(
            [np.diagonal(index[4]), np.diagonal(index[1, ::-1]), index[2, shape.size // 2], index[5, 0]]
        )
    )
    return np.unique(np.concatenate([special, np.random.default_rng(1).choice(shape.count, count, replace=False)]))


def assert_level(
    level: np.ndarray, shape: Shape, want: np.ndarray, index: np.ndarray, tolerance: float, context: object
) -> None:
    assert np.isfinite(level).all(), f"{context}: {(~np.isfinite(level)).any(-1).sum()} texels were not written"
    got = level.reshape(-1, 3)[index]
    error = np.abs(got - want) / want
    k = np.unravel_index(error.argmax(), error.shape)
    assert error.max() <= tolerance, (
        f"{context}: texel {index[k[0]]}, got {got[k]}, wanted {want[k]}, error {error.max():.2e} > {tolerance:.1e}"
    )


# Of float32: directions are rounded by 6e-8, which turns q by 6e-8/√q of itself and K ~ q^-2 by twice that; α = .04
# leaves 1e-5 of single nodes 50 times as bright as their neighbours, sums less than 5e-6.
FLOAT32 = 2e-5

# Of float64 only the level's own float32 is left: half an ulp, and GGX is one term of a series without error.
FLOAT64 = 1e-7


@pytest.mark.parametrize("precision", [32, 64])
@pytest.mark.parametrize("shape", CUBES + LATLONGS, ids=str)
def test_every_shape(device: Device, shape: Shape, precision: int) -> None:
    if precision == 64 and not device.fp64:
        pytest.skip("the device has no float64")
    o, lobe, bright = Octahedral(device, precision), ggx(device, 0.5), bright_list(5)
    grids, index = {32: grid(32)}, looked_at(shape)
    want = truth(lobe, whole(32), grids, shape.directions(index), bright)
    level = symmetric(o, shape, lobe, whole(32), grids, bright)
    assert_level(level, shape, want, index, FLOAT32 if precision == 32 else FLOAT64, (shape, precision))


@pytest.mark.parametrize("precision", [32, 64])
@pytest.mark.parametrize("shape", [Shape(False, 16), Shape(False, 33), Shape(True, 16)], ids=str)
@pytest.mark.parametrize("parts", PARTS)
def test_every_way_to_part_a_lobe(device: Device, parts: str, shape: Shape, precision: int) -> None:
    if precision == 64 and not device.fp64:
        pytest.skip("the device has no float64")
    o, lobe, index = Octahedral(device, precision), ggx(device, 0.2), looked_at(shape, 60)
    grids = {part.grid: grid(part.grid) for part in PARTS[parts]}
    want = truth(lobe, PARTS[parts], grids, shape.directions(index), None)
    level = symmetric(o, shape, lobe, PARTS[parts], grids)
    assert_level(level, shape, want, index, FLOAT32 if precision == 32 else FLOAT64, (parts, shape, precision))


@pytest.mark.few(1)
@pytest.mark.parametrize("shape", [Shape(False, 16), Shape(True, 8)], ids=str)
def test_what_is_skipped_is_beyond_reach(device: Device, shape: Shape) -> None:
    """Of a lobe that is as heavy where its window begins to end as at its middle, nothing within the window is left
    out: in float64 a node shows that has 1e-3 of the height."""
    if not device.fp64:
        pytest.skip("the device has no float64")
    o, index = Octahedral(device, 64), looked_at(shape, 60)
    for q1 in (0.003, 0.02, 0.3, 1.2):
        window = Window(0.9 * q1, q1)
        parts = [Part(96, None, window), Part(24, window, None)]
        grids = {96: grid(96, 3), 24: grid(24, 3)}
        grids[24][..., :3] = 0
        want = truth(COSINE, parts, grids, shape.directions(index), None)
        level = symmetric(o, shape, COSINE, parts, grids)
        # One node of 96 × 96 × 6 is 1.8e-5 of the sphere; the level is float32, right to half an ulp.
        error = np.abs(level.reshape(-1, 3)[index] - want)
        assert (error <= 0.51 * np.spacing(want.astype(np.float32))).all(), (shape, q1, error.max())


@pytest.mark.few(3)
@pytest.mark.parametrize("name", [n for n, m in models("ndf").items() if m.isotropic and m.from_roughness])
def test_every_ndf(device: Device, name: str) -> None:
    entry, shape = models("ndf")[name], Shape(False, 16)
    assert entry.from_roughness
    given = {p.name: p.default if p.default is not None else p.typical[0] for p in entry.parameters}
    lobe = ndf_lobe(device, chosen("ndf", entry), 0.45, {**given, **entry.from_roughness(0.45)})
    parts, grids, index = PARTS["two"], {64: grid(64), 32: grid(32)}, looked_at(shape, 60)
    want = truth(lobe, parts, grids, shape.directions(index), bright_list(3))
    level = symmetric(Octahedral(device, 32), shape, lobe, parts, grids, bright_list(3), error=3e-7)
    # The series misplaces 3e-7 of its energy; a node 50 times as bright as the rest weighs that 50 times.
    assert_level(level, shape, want, index, FLOAT32 + 50 * 3e-7, name)


@pytest.mark.few(2)
@pytest.mark.parametrize("lanes", [1, 4, 16])
@pytest.mark.parametrize("shape", [Shape(False, 4), Shape(False, 33), Shape(True, 4)], ids=str)
def test_every_width(device: Device, monkeypatch: pytest.MonkeyPatch, shape: Shape, lanes: int) -> None:
    monkeypatch.setenv("WHITEFURNACE_LANES", str(lanes))
    other = choose_device(f"{device.platform}: {device.name}")
    assert other.lanes(32) == lanes
    lobe, parts, index = ggx(other, 0.3), PARTS["two"], looked_at(shape, 60)
    grids = {part.grid: grid(part.grid) for part in parts}
    want = truth(lobe, parts, grids, shape.directions(index), bright_list(130))
    level = symmetric(Octahedral(other, 32), shape, lobe, parts, grids, bright_list(130))
    assert_level(level, shape, want, index, FLOAT32, (lanes, shape))


@pytest.mark.parametrize("splits", [1, 3, 7])
def test_splits_and_tiles_of_outputs_change_nothing_but_rounding(device: Device, splits: int) -> None:
    o, shape, lobe, parts = Octahedral(device, 32), Shape(False, 32), ggx(device, 0.3), PARTS["three"]
    grids = {part.grid: grid(part.grid) for part in parts}
    one = symmetric(o, shape, lobe, parts, grids, splits=2)
    other = symmetric(o, shape, lobe, parts, grids, splits=splits, most=o.lanes * device.local_size)
    assert np.isfinite(other).all()
    assert np.abs(other / one - 1).max() <= 3e-6  # sums of a few thousand terms in another order


def test_pieces_of_images_change_nothing(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid too fine for all its images at once, and for a table of places, is convolved piece by piece."""
    shape, lobe, parts = Shape(False, 16), ggx(device, 0.2), PARTS["two"]
    grids = {part.grid: grid(part.grid) for part in parts}
    want = symmetric(Octahedral(device, 32), shape, lobe, parts, grids)
    monkeypatch.setattr("whitefurnace.prefiltering.symmetry.PIECE", 4 * RUN)
    monkeypatch.setattr("whitefurnace.prefiltering.symmetry.MOST_PLACES", 16)
    got = symmetric(Octahedral(device, 32), shape, lobe, parts, grids)
    assert np.abs(got / want - 1).max() <= 3e-6  # the same terms, their sums cut elsewhere


@pytest.mark.parametrize(
    "shape", [*(Shape(False, n) for n in (1, 16, 33, 64)), Shape(True, 2), Shape(True, 34)], ids=str
)
def test_the_same_bits_each_time(device: Device, shape: Shape) -> None:
    """Texels on planes of symmetry have several images of themselves, of which one alone may be written."""
    o, lobe = Octahedral(device, 32), ggx(device, 0.3)
    buffer = device.array(grid(32).astype(o.kind))
    level, first = device.empty((*shape.dims, 3), np.float32), None
    for found in o.orbits(shape):
        partial = o.empty(1, found)
        o.convolve(partial, 0, 1, found, lobe, whole(32)[0], o.classes(32, buffer, found.exchanges), 1e-7)
        for _ in range(40):  # cores that race do not always end alike
            o.unfold(level, found, partial, None, None, PER_NORM, BASE)
            again = level.read()
            first = again if first is None else first
            assert (again == first).all(), f"{shape}: {(again != first).any(-1).sum()} texels differ"


# ---------------------------------------------------------------------------------------------- orbits and tiles


def images(shape: Shape, found: Orbits) -> np.ndarray:
    """(images · count, 3) directions of all that the orbits stand for."""
    d = found.direction[:, : found.count].T
    mirrored = [d * np.array([1 - 2 * (s & 1), 1 - (s & 2), 1 - (s & 4) // 2]) for s in range(8)]
    orders = [(0, 1, 2), (2, 1, 0)] + ([] if shape.latlong else [(1, 2, 0), (2, 0, 1), (0, 2, 1), (1, 0, 2)])
    return np.concatenate([m[:, order] for m in mirrored for order in orders])


@pytest.mark.parametrize("shape", CUBES + LATLONGS, ids=str)
def test_orbits_hold_every_texel(shape: Shape) -> None:
    for most in (16, 1 << 14):
        every = np.concatenate([images(shape, found) for found in orbits(shape, 16, most)])
        cosine = shape.directions().T @ every.T
        # The angle between neighbours is far over 1e-7, the rounding of an angle by its cosine.
        assert (cosine.max(1) >= 1 - 1e-14).all(), shape
        assert (cosine.max(0) >= 1 - 1e-14).all(), shape


@pytest.mark.parametrize("n", [16, 32, 48, 64])
def test_bounds_of_tiles_hold_their_nodes(n: int) -> None:
    """Against the nodes of the quarter faces +x, +y and +z of the grid, however they are ordered: every tile's bound
    holds 16 of them or more, every run's 64."""
    bound = tile_bounds(n)
    d = grid_directions(n)[[0, 2, 4]].reshape(-1, 3)
    d = d[(d > 0).all(1)]
    assert bound.shape == (3 * n * n // 256, 5, 4) and len(d) == 3 * n * n // 4
    chord = np.sqrt(((d - bound[:, :, None, :3]) ** 2).sum(-1))
    inside = chord <= bound[:, :, None, 3]
    assert (inside[:, 0].sum(-1) >= RUN).all() and (inside[:, 1:].sum(-1) >= TILE).all()
    assert inside[:, 0].any(0).all() and inside[:, 1:].any((0, 1)).all()
