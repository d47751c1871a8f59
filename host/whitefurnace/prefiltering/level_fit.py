"""Fits the levels of a chain so that interpolated roughness values are most accurate (`--fit read`).

An engine reads roughness r at lod(r), linearly between two levels. The result is a sum of two fixed kernels, and the
mean of a narrow and a wide lobe is not the lobe between them: GGX's tail grows as α², so between exact levels it is up
to twice the true one. Here each level k but the first gets a mixture ∑_j c_kj K_{r_j}/∫K_{r_j} of the same NDF's lobes,
with ∑_j c_kj = 1, that makes the read most accurate.

The fit needs no environment. For the L² error of any one environment the best mixtures would be the least-squares
spline of the lobe's transform over r, the same for every degree. But the error that matters is relative, so it depends
on how far away the light of a direction comes from. The scenes below cover this: a disc of angular radius ρ over a
background that is β of it, seen at every angle. A disc is zonal, so its exact lobes are 1-D integrals, and the whole
fit takes about 10 ms for GGX in 5 levels, 150 ms for a costly NDF or 12 levels. Real environments are not used in the
fit; they test it (tests/prefiltering/test_reading.py).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from whitefurnace.catalogue import Model
from whitefurnace.catalogue.rule import gauss
from whitefurnace.opencl.derived import finest
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import evaluate
from whitefurnace.prefiltering.recipe import Chain

DISCS = (0.03, 0.1, 0.3, 0.6, 1.0, 1.4)
"""Radii ρ of the discs in radians, from a sun's glare to half the sky."""

BACKGROUNDS = (1e-3, 1e-2, 1e-1)
"""Backgrounds β, from a studio's darkness, the metric's floor of 1e-3, to a clouded sky."""

OFFSETS = (-0.5, -0.25, 0.0, 0.25, 0.5, 1.0)
"""Nodes r_j of level k, as steps of lod from k. More or farther nodes reduce the error by less than 1 %."""

SHARPEST = 1.0
"""Smallest lod of a node, so that no level has a sharper lobe than the first lobe of the chain. A node at .75 would
reduce the error on a studio by another 5 % and need a source grid twice as fine."""

FEWEST, MOST, TOGETHER = 3, 8, 32
"""Number of values of r between two levels at which a read is scored: TOGETHER over all levels, but no fewer than
FEWEST and no more than MOST between two. They are midpoints in lod, each for the range of r around it."""

LEAST = 0.05
"""A mixture is nowhere less than this share of the level's own lobe, so that light from no direction counts as
negative."""

RIDGE = 1e-8
"""Weight of the pull towards the level's own lobe, relative to each node's own weight in the sums. Neighbouring nodes
are nearly alike; without the pull, weights of ±10 would improve only the fourth digit."""

ROUNDS = 5
FLOOR = 1e-3  # of the mean, below which errors are not relative any more: the texel error's

Mixture = tuple[tuple[float, float], ...]
"""(weight, perceptual roughness) of each lobe of a mixture; weights sum to 1."""


def read_mixtures(device: Device, recipe: Chain) -> tuple[Mixture | None, ...]:
    """Return the mixture of lobes for each level of a chain with which interpolated roughness values are most accurate.

    It is None for the first level, which stays the exact mean. The NDF's lobes come from the reference of its entry,
    those of a user's NDF from the device.
    """
    mapping = (recipe.lods, recipe.size) if recipe.lods.lod else ()
    key = repr((sorted(recipe.ndf.canonical().items()), mapping))
    return _cached(_Lobes(device, recipe, key), len(recipe.levels))


class _Lobes:
    """The values of a chain's NDF at any angle, hashed by the NDF's canonical form and the chain's mapping."""

    def __init__(self, device: Device, recipe: Chain, key: str) -> None:
        self.device, self.recipe, self.key = device, recipe, key

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Lobes) and other.key == self.key

    def at(self, theta: np.ndarray, roughness: np.ndarray) -> np.ndarray:
        """Return K(θ) = D(θ/2) cos θ for θ in [0, π/2], (roughness, angles) float64, up to a factor for each row."""
        entry: Model = self.recipe.ndf.model
        rows = [self.recipe.parameters(float(r)) for r in roughness]
        if entry.reference:
            D = np.stack([np.broadcast_to(entry.reference["D"](theta / 2, **row), theta.shape) for row in rows])
        else:
            given = np.array([[row[p.name] for row in rows] for p in entry.parameters], np.float64)
            # For a user's NDF norm and width are set to 1, since any factor of a lobe cancels.
            ones = np.ones((len(entry.constant_names), len(rows)))
            numbers = np.concatenate([given.reshape(len(entry.parameters), len(rows)), ones])
            angles = np.stack([np.cos(theta / 2), np.sin(theta / 2) ** 2])
            cells = np.concatenate([np.tile(angles, len(rows)), np.repeat(numbers, theta.size, 1)])
            D = evaluate(self.device, "NDF_D", {"ndf": entry}, cells, finest(self.device))[0].reshape(len(rows), -1)
        return np.asarray(D, np.float64) * np.maximum(np.cos(theta), 0)


@lru_cache(maxsize=64)
def _cached(lobes: _Lobes, levels: int) -> tuple[Mixture | None, ...]:
    return fitted(lobes, levels)


def angles() -> tuple[np.ndarray, np.ndarray]:
    """Return nodes θ in radians and weights of Gauss panels on [0, π/2] that double in width, for lobes of α from
    1e-4 to 1.
    """
    x, w = gauss(4)
    edges = np.concatenate([[0.0], np.geomspace(2e-5, math.pi / 2, 44)])
    width = np.diff(edges)[:, None]
    return (edges[:-1, None] + width * x).ravel(), (width * w).ravel()


def _disc(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return angles from a disc's centre at which it is seen, finest at its edge, and the share of the sphere of
    each.
    """
    off = np.concatenate([-np.geomspace(0.6 * radius, 1e-3, 12), np.geomspace(1e-3, math.pi - radius - 1e-3, 48)])
    seen = radius + off
    edges = np.concatenate([[0.0], (seen[1:] + seen[:-1]) / 2, [math.pi]])
    return seen, -np.diff(np.cos(edges)) / 2


def _within(radius: float, seen: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return the share of the circle of radius θ around a direction that lies in a disc, (seen, θ).

    seen: angles of the direction from the disc's centre. The circle leaves the disc where cos radius = cos seen cos θ +
    sin seen sin θ cos φ.
    """
    cosine = (math.cos(radius) - np.cos(seen)[:, None] * np.cos(theta)) / (np.sin(seen)[:, None] * np.sin(theta))
    return np.arccos(np.clip(cosine, -1, 1)) / math.pi


def fitted(lobes: _Lobes, levels: int) -> tuple[Mixture | None, ...]:
    """Return the mixtures of a chain's levels, None for the first.

    The fit minimizes the sum over scenes of the mean over r of the RMS over directions of |read/exact - 1|, where each
    scene is relative to the error of the levels' own lobes. It is an iteratively reweighted least-squares fit (the
    square root of a sum of squares weighs it by 1/RMS), under ∑_j c_kj = 1 and mixture ≥ LEAST × own lobe at every θ.
    """
    if levels < 2:
        return (None,) * levels
    pairs = [(k, k + off) for k in range(1, levels) for off in OFFSETS if SHARPEST <= k + off <= levels - 1]
    level, lod = np.array([k for k, _ in pairs]), np.array([x for _, x in pairs])
    width = lobes.recipe.size

    def roughness(lods: np.ndarray) -> np.ndarray:
        return np.array([lobes.recipe.lods.roughness(float(x), levels, width) for x in lods])

    nodes = roughness(lod)
    theta, weight = angles()
    kernels = lobes.at(theta, nodes)
    ring = 2 * math.pi * np.sin(theta) * weight
    kernels /= (kernels @ ring)[:, None]
    # Reads are scored at midpoints in lod, in each segment.
    per = min(max(TOGETHER // (levels - 1), FEWEST), MOST)
    steps = (np.arange(per * (levels - 1)) + 0.5) / per
    scored = roughness(steps)
    ends = roughness(np.arange(steps.size + 1) / per)
    share = np.diff(ends)
    exact = lobes.at(theta, scored) * ring
    exact /= exact.sum(1)[:, None]

    own = (lod == level).astype(np.float64)
    sums = (level == np.arange(1, levels)[:, None]).astype(np.float64)
    scenes = []
    for radius in DISCS:
        seen, omega = _disc(radius)
        inside = _within(radius, seen, theta)
        at_scored, at_nodes = inside @ exact.T, inside @ (kernels * ring).T
        for background in BACKGROUNDS:
            lit = [background + (1 - background) * part for part in (at_scored, at_nodes, (seen < radius)[:, None])]
            mean = background + (1 - background) * (1 - math.cos(radius)) / 2
            scenes.append(_squares(steps, level, lit[0], lit[1], lit[2], omega, FLOOR * mean))
    gram, right, rest = (np.stack(part) for part in zip(*scenes, strict=True))

    def rms(c: np.ndarray) -> np.ndarray:
        # Bounds the rounding of the difference: an RMS of 1e-4 is far below any that matters.
        return np.sqrt(np.maximum(gram @ c @ c - 2 * right @ c + rest, 1e-8))

    before = rms(own) @ share
    # Values are relative to the largest of the level's lobes at each angle: Beckmann's fall by 10^300.
    largest = np.stack([kernels[level == k].max(0) for k in range(1, levels)])[level - 1]
    allowed = np.divide(kernels, largest, out=np.zeros_like(kernels), where=largest > 0)
    least = LEAST * allowed[np.flatnonzero(own)]  # (levels - 1, θ)
    c = own
    for _ in range(ROUNDS):
        weights = share / rms(c) / before[:, None]
        a, b = np.tensordot(weights, gram, 2), np.tensordot(weights, right, 2)
        ridge = RIDGE * np.maximum(np.diag(a), 1e-6 * a.max())
        scale = 1 / a.max()
        c = _constrained((a + np.diag(ridge)) * scale, (b + ridge * own) * scale, sums, allowed, least, level)
    return (
        None,
        *(_mixture(c[level == k], own[level == k], allowed[level == k], nodes[level == k]) for k in range(1, levels)),
    )


def _squares(
    steps: np.ndarray,
    level: np.ndarray,
    exact: np.ndarray,
    nodes: np.ndarray,
    mirror: np.ndarray,
    omega: np.ndarray,
    floor: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the squared relative error of one scene at each scored r, as a quadratic form in the weights.

    The form is (r, p, p), (r, p) and (r,). exact: (angles, r); nodes: (angles, p); mirror: (angles, 1), the image that
    level 0 shows.
    """
    count = level.size
    gram, right = np.zeros((steps.size, count, count)), np.zeros((steps.size, count))
    rest = np.zeros(steps.size)
    for lower in range(int(steps[-1]) + 1):
        at = np.flatnonzero(steps.astype(int) == lower)
        used = np.flatnonzero((level == lower) | (level == lower + 1))
        upper = steps[at] - lower
        hat = np.where(level[used] == lower, 1 - upper[:, None], upper[:, None])
        scale = np.sqrt(omega)[:, None] / np.maximum(exact[:, at], floor)
        rows = (nodes[:, None, used] * hat * scale[..., None]).transpose(1, 0, 2)
        wanted = ((exact[:, at] - (1 - upper) * mirror * (lower == 0)) * scale).T
        gram[np.ix_(at, used, used)] = rows.transpose(0, 2, 1) @ rows
        right[np.ix_(at, used)] = (wanted[:, None] @ rows)[:, 0]
        rest[at] = (wanted * wanted).sum(1)
    return gram, right, rest


def _constrained(
    a: np.ndarray, b: np.ndarray, sums: np.ndarray, allowed: np.ndarray, least: np.ndarray, level: np.ndarray
) -> np.ndarray:
    """Minimize ½cᵀac - bᵀc with sums @ c = 1 and ∑ c·allowed ≥ least for every level.

    A dual active-set method [Goldfarb1983]: the angles with the lowest values are held as equalities, and any that then
    pull the wrong way are released before the next ones are searched. `_mixture` removes what violation remains.
    """
    count = level.size

    def solved(held: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
        rows = np.array([np.where(level == k, allowed[:, t], 0.0) for k, t in held]).reshape(len(held), count)
        z = np.concatenate([sums, rows])
        values = np.array([1.0] * len(sums) + [least[k - 1, t] for k, t in held])
        # A little regularization, since two constrained angles may be nearly the same.
        system = np.block([[a, z.T], [z, -1e-13 * np.eye(len(z))]])
        solution = np.linalg.solve(system, np.concatenate([b, values]))
        return solution[:count], solution[count + len(sums) :]

    held: list[tuple[int, int]] = []
    c, pull = solved(held)
    for _ in range(60):
        while held and pull.max() > 1e-12:
            held.pop(int(pull.argmax()))
            c, pull = solved(held)
        low = []
        for k in range(1, len(sums) + 1):
            spare = c[level == k] @ allowed[level == k] - least[k - 1]
            if spare.min() < -1e-7 and (k, int(spare.argmin())) not in held:
                low.append((k, int(spare.argmin())))
        if not low:
            break
        held += low
        c, pull = solved(held)
    return c


def _mixture(c: np.ndarray, own: np.ndarray, allowed: np.ndarray, nodes: np.ndarray) -> Mixture:
    """Return the weights of one level, rounded.

    A mixture that falls below LEAST/2 of the own lobe is mixed with that lobe until it does not.
    """
    c = c / c.sum()
    lobe = own @ allowed
    spare = c @ allowed - LEAST / 2 * lobe
    low = spare < -1e-7
    if low.any():
        part = float((spare[low] / (spare[low] - (1 - LEAST / 2) * lobe[low])).max())
        c = (1 - part) * c + part * own
    c = np.round(c, 6)  # rounding of linear algebra differs between machines, and the bake must not
    c[np.abs(c).argmax()] += 1 - c.sum()
    return tuple((round(float(w), 6), float(r)) for w, r in zip(c, nodes, strict=True) if abs(w) > 5e-7)
