"""Integrates the light that the points of a scene reflect, without any approximation of an engine or of files."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from whitefurnace.advice.points import ScenePoints
from whitefurnace.catalogue import models
from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering.lighting import irradiance
from whitefurnace.prefiltering.reading import bilinear
from whitefurnace.rendering.truth import Points, Term, Truth, term
from whitefurnace.scenes.material_spheres import middle
from whitefurnace.scenes.materials import Scene
from whitefurnace.sphere.environments import Environment
from whitefurnace.sphere.grids import radiance_at

ACCURACY = 5e-3
"""Tolerance of the integrals: the 99th percentile of their texel errors."""

CUBE = 128
"""Edge, in texels, of the cube of E/π that is the reference of diffuse light. Its bilinear reads err by 2e-5 of its
range."""


@dataclass(frozen=True)
class Group:
    """The points of one roughness and their specular integrals.

    index  indices of the points
    count  samples taken for each point
    R, E   radiance (m, 2, 3) and albedo (m, 2) with Schlick's Fresnel term, for F0 = 0 and F0 = 1
    """

    roughness: float
    index: np.ndarray
    count: int
    R: np.ndarray
    E: np.ndarray


class PointIntegrals:
    """Integrals of the reflected light at the points of a scene in one environment.

    Arrays are linear radiance (m, 3), one row for each point, unless stated otherwise. `right` is the reference against
    which errors are measured; `accuracy` is the 99th percentile of its own error. Each integral is computed once, on
    first use.
    """

    def __init__(self, scene: Scene, sampled: ScenePoints, env: Environment, device: Device) -> None:
        self.scene, self.sampled, self.env, self.device = scene, sampled, env, device
        self.points = sampled.points
        self.truth = Truth(device, env)
        self.accuracy = 0.0
        self.groups = tuple(self._group(float(r)) for r in np.unique(sampled.roughness))

    def _group(self, r: float) -> Group:
        index = np.flatnonzero(self.sampled.roughness == r)
        one, some = _schlick(r), self.points.some(index)
        count = 0
        if r > 0:
            count, error = self.truth.samples(one, some, ACCURACY)
            self.accuracy = max(self.accuracy, error)
        return Group(r, index, count, *self.truth.reflected(one, some, count))

    def each(self, made: Callable[[Group], np.ndarray]) -> np.ndarray:
        """Return the values of all points, (m, 3), from a function `made` that gives those of one group."""
        out = np.empty((len(self.sampled.roughness), 3))
        for g in self.groups:
            out[g.index] = made(g)
        return out

    # ------------------------------------------------------------------------------------------- means of radiance

    def mean(self, roughness: float, points: Points, count: int) -> np.ndarray:
        """Return the mean radiance over the GGX lobe that v sees, (m, 3): ∫ L D (n·l) dω / ∫ D (n·l) dω.

        roughness: perceptual roughness. count: samples at each point. For v = n this is the value of a prefiltered
        level.
        """
        if roughness == 0:
            return radiance_at(self.env, mirrored(points))
        R, E = self.truth.reflected(term(ndf="ggx", roughness=roughness, masking="implicit"), points, count)
        return np.asarray(R[:, 0] / E)

    def lobe(self, mixture: Sequence[tuple[float, float]], d: np.ndarray, count: int) -> np.ndarray:
        """Return the exact value of a prefiltered level in directions d (3, m): (m, 3).

        mixture: (weight, perceptual roughness) of each lobe of the level. count: samples; more are taken where the
        points need more.
        """
        at = Points(d, d)
        return np.asarray(sum(w * self.mean(r, at, max(count, self._least_count)) for w, r in mixture))

    @property
    def _least_count(self) -> int:
        return max((g.count for g in self.groups), default=0) or 4096

    @cached_property
    def own_view(self) -> np.ndarray:
        """Mean radiance over the GGX lobe as it is seen from v, (m, 3)."""
        return self.each(lambda g: self.mean(g.roughness, self.points.some(g.index), g.count))

    @cached_property
    def diffuse(self) -> np.ndarray:
        """E/π: irradiance at n divided by π, (m, 3)."""
        return bilinear(irradiance(self.env, size=CUBE, device=self.device).values, self.points.n)

    # ------------------------------------------------------------------------------------------- reflected light

    @cached_property
    def _once(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return R (m, 3) and E (m, 1) for F0 = 0, and how much each of them grows to F0 = 1."""
        m = len(self.sampled.roughness)
        R, E = np.empty((m, 2, 3)), np.empty((m, 2))
        for g in self.groups:
            R[g.index], E[g.index] = g.R, g.E
        return R[:, 0], E[:, :1], R[:, 1] - R[:, 0], E[:, 1:] - E[:, :1]

    def reflected(self, F0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return radiance and albedo of single scattering with Schlick's Fresnel term, (m, 3) each.

        F0: reflectance at normal incidence, (m, 3). Both values are linear in it.
        """
        R, E, more_R, more_E = self._once
        return R + F0 * more_R, E + F0 * more_E

    @cached_property
    def exact_table(self) -> tuple[np.ndarray, np.ndarray]:
        """The split-sum terms (A, B), (m,) each, without the error of a table."""
        _, E, _, more = self._once
        return more[:, 0], E[:, 0]

    @cached_property
    def seen(self) -> np.ndarray:
        """Mean radiance weighted by the whole specular integrand, (m, 3)."""
        m = self.sampled.metal[:, None]
        R, E = self.reflected((1 - m) * self.sampled.f0 + m * self.sampled.color)
        return R / np.maximum(E, 1e-12)

    @cached_property
    def _lost(self) -> np.ndarray:
        """1/E₁ - 1, where E₁ is the albedo for F0 = 1, (m, 1)."""
        _, E, _, more = self._once
        return np.asarray(1 / np.maximum(E + more, 1e-6) - 1)

    @cached_property
    def right(self) -> np.ndarray:
        """The reference: the value of `reference()` with exact Fresnel terms and multiple scattering, (m, 3)."""
        return self.reference()

    def reference(self, *, exact: bool = True, again: bool = True) -> np.ndarray:
        """Return the radiance of glTF's reflection model, (m, 3).

        The model is a specular term over a Lambertian one, which gets the light that the specular term leaves, as in
        `side_by_side.Material`.

        exact: True uses Fresnel's equations for insulators, False Schlick's term. again: True includes multiple
        scattering between facets [Turquin2019].
        """
        s = self.sampled
        lost = self._lost if again else 0.0
        R, E = self.reflected(s.f0)
        if exact:
            R, E = self._exact(R, E)
        metal, _ = self.reflected(s.color)
        gain = 1 + s.f0 * lost
        rest = np.maximum(1 - E * gain, 0)
        m = s.metal[:, None]
        return (1 - m) * (R * gain + rest * s.color * self.diffuse) + m * metal * (1 + s.color * lost)

    def _exact(self, R: np.ndarray, E: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R and E with Fresnel's equations at the points that have an index of refraction."""
        s = self.sampled
        iors = np.unique(s.ior[(s.ior > 0) & (s.metal < 1)])
        if not len(iors):
            return R, E
        R, E = R.copy(), E.copy()
        for g in self.groups:
            some = g.index[(s.ior[g.index] > 0) & (s.metal[g.index] < 1)]
            if not len(some):
                continue
            one = term(ndf="ggx", roughness=g.roughness, fresnel="dielectric", fresnel_ior=iors)
            made, albedo = self.truth.reflected(one, self.points.some(some), g.count)
            which = np.searchsorted(iors, s.ior[some])
            R[some], E[some] = made[np.arange(len(some)), which], albedo[np.arange(len(some)), which, None]
        return R, E

    # ------------------------------------------------------------------------------------------- other models

    def masked(self, masking: str) -> np.ndarray:
        """Return the change of the singly scattered specular part under the masking `masking` instead of Smith's,
        (m, 3).
        """
        s = self.sampled
        made = np.empty((len(s.roughness), 2, 3))
        for g in self.groups:
            made[g.index] = (
                g.R
                if g.roughness == 0
                else self.truth.reflected(_schlick(g.roughness, masking), self.points.some(g.index), g.count)[0]
            )
        m = s.metal[:, None]
        F0 = (1 - m) * s.f0 + m * s.color
        R, _ = self.reflected(F0)
        return np.asarray(made[:, 0] + F0 * (made[:, 1] - made[:, 0]) - R)

    def grooved(self) -> np.ndarray:
        """Return the change of the diffuse part under Oren and Nayar's model instead of Lambert's, (m, 3).

        The grooves have the slopes of Beckmann's distribution of the same α: their mean square is α²/2, so tan σ =
        α/√2. The model is a ρ + b ρ² in its albedo ρ, so two albedos determine a and b.
        """
        s = self.sampled
        rho = np.array([0.5, 1.0])
        out = np.zeros((len(s.roughness), 3))
        rest = (1 - s.metal[:, None]) * np.maximum(1 - self.reflected(s.f0)[1], 0)
        for g in self.groups:
            if g.roughness == 0 or not (rest[g.index] * s.color[g.index]).any():
                continue
            sigma = math.atan(g.roughness**2 / math.sqrt(2))
            half, full = (
                self.truth.reflected(
                    term(diffuse="oren_nayar", diffuse_albedo=rho, diffuse_sigma=np.full(2, sigma)),
                    self.points.some(g.index),
                    g.count,
                )[0][:, k]
                for k in (0, 1)
            )
            a = 4 * half - full
            c = s.color[g.index]
            out[g.index] = rest[g.index] * (a * c + (full - a) * c * c - c * self.diffuse[g.index])
        return out

    def sheen(self, masking: str) -> np.ndarray | None:
        """Return the error (m, 3) that the split sum of Charlie's lobe under a masking makes on materials with a sheen.

        None where no point has a sheen.
        """
        some = [k for k in range(len(self.scene.materials)) if self.scene.materials[k]["sheen_color"].most > 0]
        out = np.zeros_like(self.sampled.color)
        for k in some:
            index = np.flatnonzero(self.sampled.material == k)
            if not len(index):
                continue
            m = self.scene.materials[k]
            r = max(float(middle(m["sheen_roughness"])[0]), 0.1)
            points = self.points.some(index)
            cloth = term(ndf="charlie", roughness=r, masking=masking, **_following(masking, r))
            R, E = self.truth.reflected(cloth, points, self._least_count)
            d = mirrored(points)
            levels, own = self.truth.reflected(
                term(ndf="charlie", roughness=r, masking="implicit"), Points(d, d), self._least_count
            )
            out[index] = middle(m["sheen_color"]) * (E * levels[:, 0] / own - R[:, 0])
        return out if some and out.any() else None


def mirrored(points: Points) -> np.ndarray:
    """Return the mirror directions (3, m) of the views of points."""
    return np.asarray(2 * (points.n * points.v).sum(0) * points.n - points.v)


def _schlick(r: float, masking: str = "smith") -> Term:
    """GGX of roughness r with Schlick's Fresnel term, in two variants: F0 = 0 and F0 = 1."""
    f0 = np.array([0.0, 1.0])
    return term(ndf="ggx", roughness=r, masking=masking, fresnel="schlick", fresnel_f0=f0, **_following(masking, r))


def _following(masking: str, r: float) -> dict[str, Any]:
    """The parameters of a masking that follow roughness, as `term` takes them."""
    follows = models("masking")[masking].from_roughness
    return {f"masking_{name}": value for name, value in follows(r).items()} if follows and r > 0 else {}
