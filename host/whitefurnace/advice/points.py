"""Draws the surface points on which the error of a bake is measured, from the materials of a glTF scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from whitefurnace.errors import InputError, UsageError
from whitefurnace.prefiltering.reading import SMOOTHEST
from whitefurnace.rendering.truth import Points
from whitefurnace.scenes.material_spheres import insulator, middle
from whitefurnace.scenes.materials import Material, Scene, Spread

POINTS = 384
"""Default number of points. They have equal weights: for normally distributed errors the standard error of an RMS over
384 points is about 4 %."""

POINTS_RANGE = (16, 1 << 16)

NODES = 8
"""Largest number of distinct roughness values among the points. A scene with more is reduced to the means of equal
parts of its points."""

IORS = 4
"""Largest number of distinct indices of refraction among the points."""

GRAZING = 0.01
"""Smallest n·v of a point, about that of a pixel at the rim of a sphere of 100 pixels."""


@dataclass(frozen=True)
class ScenePoints:
    """Surface points of a scene, all with the same weight.

    material    (m,) index of the material in the scene
    color       (m, 3) base colour in [0, 1]
    metal       (m,) metalness in [0, 1]
    roughness   (m,) perceptual roughness in [0, 1]
    f0          (m, 3) F0 of the insulating part
    ior         (m,) index of refraction of the insulating part; 0 where only Schlick's term with `f0` describes it
    points      unit normals and view directions
    notices     sentences about parts of the materials that the points leave out
    """

    material: np.ndarray
    color: np.ndarray
    metal: np.ndarray
    roughness: np.ndarray
    f0: np.ndarray
    ior: np.ndarray
    points: Points
    notices: tuple[str, ...]


def sample_points(scene: Scene, *, least: float = 0.0, count: int = POINTS, seed: int = 0) -> ScenePoints:
    """Draw surface points from the materials of a scene.

    A material gets points in proportion to the number of primitives that use it. Roughness and metalness are drawn from
    the material's histograms in equal parts; colours are means. Normals are uniform over the sphere. View directions
    have the density of a sphere's pixels, proportional to n·v.

    least: smallest perceptual roughness that the engine shades; lower values are raised to it. A roughness below
    SMOOTHEST becomes 0, a mirror. count: number of points, in POINTS_RANGE. seed: seed of the random numbers.

    Raises InputError for a scene in which every material is unlit, and UsageError for a count out of range.
    """
    if not POINTS_RANGE[0] <= count <= POINTS_RANGE[1]:
        raise UsageError(f"points {count} is outside [{POINTS_RANGE[0]}, {POINTS_RANGE[1]}]")
    there = [k for k, m in enumerate(scene.materials) if not m.unlit]
    if not there:
        raise InputError(f"{scene.path} has only unlit materials, for which there is no error to measure")
    rng = np.random.default_rng(seed)
    uses = np.array([max(scene.materials[k].uses, 1) for k in there], np.float64)
    ends = np.cumsum(uses) / uses.sum()
    which = np.minimum(np.searchsorted(ends, (np.arange(count) + 0.5) / count), len(there) - 1)
    place = np.array(there)[which]
    color, f0 = np.empty((count, 3)), np.empty((count, 3))
    metal, r, ior = np.empty(count), np.empty(count), np.empty(count)
    for k in np.unique(place):
        some, m = np.flatnonzero(place == k), scene.materials[k]
        metal[some] = _drawn(m["metalness"], len(some), rng)
        r[some] = _drawn(m["roughness"], len(some), rng)
        f0[some], ior[some] = _insulator(m)
        color[some] = middle(m["base_color"]) * m.diffuse_share(insulator(m))
    r = np.maximum(r, least)
    r[r < SMOOTHEST] = 0.0
    n = rng.normal(size=(3, count))
    n /= np.sqrt((n * n).sum(0))
    across = np.cross(n, rng.normal(size=(3, count)), axis=0)
    across /= np.sqrt((across * across).sum(0))
    NoV = np.maximum(np.sqrt((rng.permutation(count) + rng.random(count)) / count), GRAZING)
    v = NoV * n + np.sqrt((1 - NoV) * (1 + NoV)) * across
    return ScenePoints(
        place,
        color,
        metal,
        _fewer(r, NODES),
        f0,
        _fewer(ior, IORS),
        Points(n, v),
        tuple(_left_out(scene, there, least)),
    )


def _drawn(spread: Spread, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw (count,) values of one channel: one value from each of `count` equal parts of its distribution, shuffled."""
    low, high, share = np.array(spread.shares).T
    ends = np.concatenate([[0.0], np.cumsum(share) / share.sum()])
    u = (np.arange(count) + rng.random(count)) / count
    k = np.clip(np.searchsorted(ends, u, side="right") - 1, 0, len(share) - 1)
    inside = (u - ends[k]) / np.maximum(ends[k + 1] - ends[k], 1e-300)
    return rng.permutation(low[k] + np.clip(inside, 0, 1) * (high[k] - low[k]))


def _insulator(m: Material) -> tuple[np.ndarray, float]:
    """Return F0 (3,) by KHR_materials_ior and KHR_materials_specular, and the index of refraction.

    The index is 0 where the specular extension changes F0, which an index alone cannot describe.
    """
    ior = middle(m["ior"])[0]
    plain = 1 < ior <= 5 and middle(m["specular"])[0] == 1 and np.all(middle(m["specular_color"]) == 1)
    return np.array(insulator(m)), float(ior) if plain else 0.0


def _fewer(values: np.ndarray, most: int) -> np.ndarray:
    """Reduce the positive values to `most` distinct ones, the means of equal parts of them; zeros stay."""
    rest = values > 0
    if len(np.unique(values[rest])) <= most:
        return values
    out, order = values.copy(), np.flatnonzero(rest)[np.argsort(values[rest], kind="stable")]
    for part in np.array_split(order, most):
        out[part] = values[part].mean()
    return out


def _left_out(scene: Scene, there: Sequence[int], least: float) -> list[str]:
    """Return notices about the parts of the lit materials `there` that the points do not have."""
    found = []
    shaded = [scene.materials[k] for k in there]
    for name, what in (
        ("clearcoat", "clear coat"),
        ("transmission", "transmission"),
        ("anisotropy", "anisotropy"),
        ("iridescence", "iridescence"),
        ("diffuse_transmission", "diffuse transmission"),
    ):
        who = [m.name for m in shaded if m[name].most > 0]
        if who:
            found.append(
                f"the {what} of {who[0]}{f' and {len(who) - 1} more' if len(who) > 1 else ''} is not in the "
                "budget: what is measured is the surface under it"
                if name == "clearcoat"
                else f"the {what} of {who[0]}{f' and {len(who) - 1} more' if len(who) > 1 else ''} is not in the budget"
            )
    if any(m["specular"].least < 1 for m in shaded):
        found.append("a specular factor below 1 scales F0 here, and not F90")
    if least > 0 and any(m["roughness"].least < least for m in shaded):
        found.append(f"roughness below {least:g} is shaded as {least:g}, in the reference too")
    return found
