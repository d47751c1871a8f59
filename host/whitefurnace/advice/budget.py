"""What each approximation between a scene's materials and an engine's picture of them costs in an environment, the
error of all of it together, and the cheapest bake that stays within a tolerance.

Points of the materials (`sampled`) are shaded as the engine does it, and held against the full reflectance integral
with multiple scattering (`truth`). In between stand the steps of that way, each alone: what the engine would show of
files without any error is X₀; a part of the files adds what X₀ becomes with that part in it; the split sum is the
engine's prefiltered radiance against the mean that the whole integrand takes; the model is the integral of the
engine's own weights against that of the reference. All are over one reference, so they can be compared. They do not
add up: parts may cancel.
"""
from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from whitefurnace.baking.bake import DEMO, demo
from whitefurnace.baking.outputs import targets
from whitefurnace.catalogue import models
from whitefurnace.engines.presets import ENGINES, FORMATS, Dfg, Engine, File, reduced
from whitefurnace.errors import CheckError, InputError, UnsupportedError, UsageError
from whitefurnace.files import decode, encode, pack, unpack
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.prefiltering.certificate import texel_errors
from whitefurnace.prefiltering.level_fit import read_mixtures
from whitefurnace.prefiltering.lighting import Filtered, Lighting, Want, irradiance, light
from whitefurnace.prefiltering.reading import SMOOTHEST, Exact, bilinear, single, stored
from whitefurnace.prefiltering.recipe import Chain, chain
from whitefurnace.rendering import shading as rendering
from whitefurnace.rendering.shading import Lights, looked_up
from whitefurnace.rendering.truth import Points, Term, Truth, term
from whitefurnace.scenes.material_spheres import insulator, middle
from whitefurnace.scenes.materials import Material, Scene, Spread
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere.environments import Environment, environment
from whitefurnace.sphere.grids import radiance_at
from whitefurnace.tables.split_sum import split_sum

POINTS = 384
"""Sampled, all alike: the standard error of an RMS is some 4 % where errors are spread as a normal distribution's."""

POINTS_RANGE = (16, 1 << 16)

NODES = 8
"""Roughnesses that points have at most; more of a scene's are those of equal parts of its points."""

IORS = 4
"""Indices of refraction that are told apart."""

GRAZING = 0.01
"""The least n·v: a pixel sees the rim of a sphere of 100 pixels no flatter."""

ACCURACY = 5e-3
"""Of the integrals, at the 99th percentile of their texel errors."""

CUBE = 128
"""Texels an edge of the cube of E/π that is the reference of diffuse light: bilinear reads err by 2e-5 of its range."""

TOLERANCE_RANGE = (1e-4, 1.0)

FILTERS = (1e-2, 1e-3)
"""Tolerances of the filter that are tried; finer ones cost more than any read keeps of them."""

SIZES = (32, 64, 128, 256, 512)
TABLES = (16, 32, 64, 128, 256)

Kind = Literal["files", "split", "model", "other"]


# ------------------------------------------------------------------------------------------------- points


@dataclass(frozen=True)
class Sampled:
    """Points of a scene, (m,) or (m, 3) each, all of the same weight: the material's place in the scene, base colour,
    metalness, perceptual roughness, F0 and index of its insulator (0 where Schlick's term with F0 is what it has)."""

    material: np.ndarray
    color: np.ndarray
    metal: np.ndarray
    roughness: np.ndarray
    f0: np.ndarray
    ior: np.ndarray
    points: Points
    notices: tuple[str, ...]


def sampled(scene: Scene, *, least: float = 0.0, count: int = POINTS, seed: int = 0) -> Sampled:
    """Points of the materials of a scene, each as often as primitives have it. Roughness and metalness are drawn from
    their histograms, in equal parts, and colours are means; normals are uniform over the sphere, and views as a
    sphere's pixels have them, of density n·v. Below `least` an engine has no roughness, below SMOOTHEST it is 0: what
    is seen then is the image.

    Raises InputError for a scene without materials that light falls on, UsageError for a bad count.
    """
    if not POINTS_RANGE[0] <= count <= POINTS_RANGE[1]:
        raise UsageError(f"points {count} is outside [{POINTS_RANGE[0]}, {POINTS_RANGE[1]}]")
    there = [k for k, m in enumerate(scene.materials) if not m.unlit]
    if not there:
        raise InputError(f"{scene.path} has no materials that light falls on: there is no error to tell of")
    rng = np.random.default_rng(seed)
    uses = np.array([max(scene.materials[k].uses, 1) for k in there], np.float64)
    ends = np.cumsum(uses) / uses.sum()
    which = np.minimum(np.searchsorted(ends, (np.arange(count) + 0.5) / count), len(there) - 1)
    place = np.array(there)[which]
    color, f0 = np.empty((count, 3)), np.empty((count, 3))
    metal, r, ior = np.empty(count), np.empty(count), np.empty(count)
    for k in np.unique(place):
        some, m = np.flatnonzero(place == k), scene.materials[k]
        color[some] = middle(m["base_color"])
        metal[some] = _drawn(m["metalness"], len(some), rng)
        r[some] = _drawn(m["roughness"], len(some), rng)
        f0[some], ior[some] = _insulator(m)
    r = np.maximum(r, least)
    r[r < SMOOTHEST] = 0.0
    n = rng.normal(size=(3, count))
    n /= np.sqrt((n * n).sum(0))
    across = np.cross(n, rng.normal(size=(3, count)), axis=0)
    across /= np.sqrt((across * across).sum(0))
    NoV = np.maximum(np.sqrt((rng.permutation(count) + rng.random(count)) / count), GRAZING)
    v = NoV * n + np.sqrt((1 - NoV) * (1 + NoV)) * across
    return Sampled(place, color, metal, _fewer(r, NODES), f0, _fewer(ior, IORS), Points(n, v),
                   tuple(_left_out(scene, there, least)))


def _drawn(spread: Spread, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count,) values of one channel in equal parts of its distribution, shuffled."""
    low, high, share = np.array(spread.shares).T
    ends = np.concatenate([[0.0], np.cumsum(share) / share.sum()])
    u = (np.arange(count) + rng.random(count)) / count
    k = np.clip(np.searchsorted(ends, u, side="right") - 1, 0, len(share) - 1)
    inside = (u - ends[k]) / np.maximum(ends[k + 1] - ends[k], 1e-300)
    return rng.permutation(low[k] + np.clip(inside, 0, 1) * (high[k] - low[k]))


def _insulator(m: Material) -> tuple[np.ndarray, float]:
    """(3,) F0 by KHR_materials_ior and KHR_materials_specular, and the index, 0 where they say more than an index."""
    ior = middle(m["ior"])[0]
    plain = 1 < ior <= 5 and middle(m["specular"])[0] == 1 and np.all(middle(m["specular_color"]) == 1)
    return np.array(insulator(m)), float(ior) if plain else 0.0


def _fewer(values: np.ndarray, most: int) -> np.ndarray:
    """Values of which there are `most` different ones at most, 0 beside them: means of equal parts of the rest."""
    rest = values > 0
    if len(np.unique(values[rest])) <= most:
        return values
    out, order = values.copy(), np.flatnonzero(rest)[np.argsort(values[rest], kind="stable")]
    for part in np.array_split(order, most):
        out[part] = values[part].mean()
    return out


def _left_out(scene: Scene, there: Sequence[int], least: float) -> list[str]:
    found = []
    shaded = [scene.materials[k] for k in there]
    for name, what in (("clearcoat", "clear coat"), ("transmission", "transmission"), ("anisotropy", "anisotropy"),
                       ("iridescence", "iridescence"), ("diffuse_transmission", "diffuse transmission")):
        who = [m.name for m in shaded if m[name].most > 0]
        if who:
            found.append(f"the {what} of {who[0]}{f' and {len(who) - 1} more' if len(who) > 1 else ''} is not in the "
                         "budget: what is measured is the surface under it" if name == "clearcoat" else
                         f"the {what} of {who[0]}{f' and {len(who) - 1} more' if len(who) > 1 else ''} is not in the "
                         "budget")
    if any(m["specular"].least < 1 for m in shaded):
        found.append("a specular factor below 1 scales F0 here, and not F90")
    if least > 0 and any(m["roughness"].least < least for m in shaded):
        found.append(f"roughness below {least:g} is shaded as {least:g}, in the reference too")
    return found


# ------------------------------------------------------------------------------------------------- what is told


@dataclass(frozen=True)
class Entry:
    """One approximation: `rms` and `p95`, root mean square and 95th percentile over points of the texel error
    (README, "What the numbers mean") that it makes of reflected radiance. `used`: it is on the engine's way; else it
    is what another choice would cost. `bound`: not measured but what files state."""

    name: str
    kind: Kind
    rms: float
    p95: float
    what: str
    used: bool = True
    bound: bool = False


@dataclass(frozen=True)
class Budget:
    """Of a scene in an environment by one engine. `entries` in their order on the way; `files`, what all of the files
    add to what the engine would show of exact ones; `floor`, what it shows of exact ones, and `whole`, of its own,
    against the reference, whose own accuracy is `accuracy` (p99)."""

    engine: str
    environment: str
    levels: tuple[tuple[int, float], ...]
    points: int
    entries: tuple[Entry, ...]
    files: Entry
    floor: Entry
    whole: Entry
    accuracy: float
    notices: tuple[str, ...]

    def __getitem__(self, name: str) -> Entry:
        return next(e for e in self.entries if e.name == name)

    @property
    def largest(self) -> Entry:
        """Of what is on the engine's way."""
        return max((e for e in self.entries if e.used and not e.bound), key=lambda e: e.rms)


@dataclass(frozen=True)
class Choice:
    """The cheapest set within a tolerance: `options` of `bake` beside --for, `nbytes` before compression, `error` (rms)
    of its files but those parts that are `beyond` (what the filter may add included) and `whole` of its picture;
    `binds` is the largest of the parts judged, `met` whether the error is within the tolerance, `beyond` what is over
    it and no choice changes. `tried` is how many sets were."""

    tolerance: float
    options: Mapping[str, Any]
    engine: Engine
    recipe: Chain
    nbytes: int
    usual_nbytes: int
    error: float
    whole: float
    binds: Entry
    met: bool
    beyond: tuple[Entry, ...]
    tried: int


# ------------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True)
class _Group:
    """Points of one roughness: their indices and what the integral gives of them. R (m, 2, 3) and E (m, 2) of Schlick's
    term for F0 = 0 and 1, `count` samples each."""

    roughness: float
    index: np.ndarray
    count: int
    R: np.ndarray
    E: np.ndarray


class Meter:
    """Measures budgets of one scene and engine in one environment; what chains share is integrated once.

    without: what of the engine's files is left out (`engines.reduced`). Raises UnsupportedError for an engine that is
    given no chain, and as `sampled` does.
    """

    def __init__(self, scene: Scene, env: Environment, engine: Engine, device: Device, *,
                 without: Sequence[str] = (), count: int = POINTS, seed: int = 0) -> None:
        if not engine.needs("specular"):
            raise UnsupportedError(f"{engine.name} filters the image itself: what it shows is not ours to measure")
        self.scene, self.env, self.device = scene, env, device
        self.preset, self.without = _upright(engine), tuple(without)
        self.engine = reduced(self.preset, self.without) if without else self.preset
        self.sampled = sampled(scene, least=engine.least, count=count, seed=seed)
        self.points = self.sampled.points
        self.truth = Truth(device, env)
        self.mean_radiance = float(np.mean(env.statistics["mean"]))
        self.accuracy = 0.0
        self.groups = tuple(self._group(float(r)) for r in np.unique(self.sampled.roughness))
        self._lights: dict[str, tuple[Lighting, Filtered]] = {}
        self._reads: dict[tuple[str, ...], np.ndarray] = {}
        self._tables: dict[tuple[Dfg, str | None], np.ndarray] = {}

    # ------------------------------------------------------------------------------------------- integrals

    def _group(self, r: float) -> _Group:
        index = np.flatnonzero(self.sampled.roughness == r)
        one, some = self._schlick(r), self.points.some(index)
        count = 0
        if r > 0:
            count, error = self.truth.samples(one, some, ACCURACY)
            self.accuracy = max(self.accuracy, error)
        return _Group(r, index, count, *self.truth.reflected(one, some, count))

    @staticmethod
    def _schlick(r: float, masking: str = "smith") -> Term:
        follows = models("masking")[masking].from_roughness
        given = follows(r) if follows and r > 0 else {}
        own: dict[str, Any] = {f"masking_{name}": value for name, value in given.items()}
        return term(ndf="ggx", roughness=r, masking=masking, fresnel="schlick", fresnel_f0=np.array([0.0, 1.0]), **own)

    def _mean(self, roughness: float, points: Points, count: int) -> np.ndarray:
        """(m, 3): ∫ L D (n·l) dω / ∫ D (n·l) dω, the lobe as v sees it. Where v is n that is what levels hold."""
        if roughness == 0:
            return radiance_at(self.env, 2 * (points.n * points.v).sum(0) * points.n - points.v)
        R, E = self.truth.reflected(term(ndf="ggx", roughness=roughness, masking="implicit"), points, count)
        return np.asarray(R[:, 0] / E)

    @cached_property
    def looked_up(self) -> np.ndarray:
        """(3, m) directions of the world in which the chain is read."""
        return looked_up(self.engine, self.points.n, self.points.v, self.sampled.roughness)

    def lobe(self, mixture: Sequence[tuple[float, float]], d: np.ndarray, count: int) -> np.ndarray:
        """(m, 3): what a level of those lobes holds in directions (3, m), exactly."""
        at = Points(d, d)
        return np.asarray(sum(w * self._mean(r, at, max(count, self._least_count)) for w, r in mixture))

    @property
    def _least_count(self) -> int:
        return max((g.count for g in self.groups), default=0) or 4096

    def _each(self, made: Any) -> np.ndarray:
        """(m, 3) of what `made` gives for each group."""
        out = np.empty((len(self.sampled.roughness), 3))
        for g in self.groups:
            out[g.index] = made(g)
        return out

    @cached_property
    def prefiltered(self) -> np.ndarray:
        """(m, 3): exact lobes of n = v = r in the direction that the engine reads."""
        return self._each(lambda g: self.lobe(single(g.roughness), self.looked_up[:, g.index], g.count))

    @cached_property
    def own_view(self) -> np.ndarray:
        """(m, 3): means of radiance over the lobe as it is seen from v."""
        return self._each(lambda g: self._mean(g.roughness, self.points.some(g.index), g.count))

    @cached_property
    def diffuse(self) -> np.ndarray:
        """(m, 3): E/π."""
        return bilinear(irradiance(self.env, size=CUBE, device=self.device).values, self.points.n)

    @cached_property
    def _once(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """R (m, 3) and E (m, 1) for F0 = 0, and what both gain to F0 = 1."""
        m = len(self.sampled.roughness)
        R, E = np.empty((m, 2, 3)), np.empty((m, 2))
        for g in self.groups:
            R[g.index], E[g.index] = g.R, g.E
        return R[:, 0], E[:, :1], R[:, 1] - R[:, 0], E[:, 1:] - E[:, :1]

    def reflected(self, F0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(m, 3) radiance and albedo by Schlick's term of F0 (m, 3), scattered once: both are linear in F0."""
        R, E, more_R, more_E = self._once
        return R + F0 * more_R, E + F0 * more_E

    @cached_property
    def _lost(self) -> np.ndarray:
        """(m, 1): 1/E₁ - 1."""
        _, E, _, more = self._once
        return np.asarray(1 / np.maximum(E + more, 1e-6) - 1)

    # ------------------------------------------------------------------------------------------- references

    def reference(self, *, exact: bool = True, again: bool = True) -> np.ndarray:
        """(m, 3): the integral of glTF's model, Lambert under what the specular leaves, as `beside.Material` has it.
        exact: Fresnel's equations for the insulators, else Schlick's term. again: facets scatter more than once
        [Turquin2019]."""
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
        """Both by Fresnel's equations where an index is given."""
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

    @cached_property
    def right(self) -> np.ndarray:
        """(m, 3): what is held to be right."""
        return self.reference()

    def masked(self, masking: str) -> np.ndarray:
        """(m, 3): what another masking term adds to the specular part, scattered once."""
        s = self.sampled
        made = np.empty((len(s.roughness), 2, 3))
        for g in self.groups:
            made[g.index] = g.R if g.roughness == 0 else self.truth.reflected(
                self._schlick(g.roughness, masking), self.points.some(g.index), g.count)[0]
        m = s.metal[:, None]
        F0 = (1 - m) * s.f0 + m * s.color
        R, _ = self.reflected(F0)
        return np.asarray(made[:, 0] + F0 * (made[:, 1] - made[:, 0]) - R)

    def grooved(self) -> np.ndarray:
        """(m, 3): what Oren and Nayar's diffuse adds to Lambert's. Grooves with slopes as Beckmann's of the same α,
        whose mean square is α²/2, have tan σ = α/√2. Its f is a ρ + b ρ², known from two albedos ρ."""
        s = self.sampled
        rho = np.array([0.5, 1.0])
        out = np.zeros((len(s.roughness), 3))
        rest = (1 - s.metal[:, None]) * np.maximum(1 - self.reflected(s.f0)[1], 0)
        for g in self.groups:
            if g.roughness == 0 or not (rest[g.index] * s.color[g.index]).any():
                continue
            sigma = math.atan(g.roughness**2 / math.sqrt(2))
            half, full = (self.truth.reflected(term(diffuse="oren_nayar", diffuse_albedo=rho,
                                                    diffuse_sigma=np.full(2, sigma)),
                                               self.points.some(g.index), g.count)[0][:, k] for k in (0, 1))
            a = 4 * half - full
            c = s.color[g.index]
            out[g.index] = rest[g.index] * (a * c + (full - a) * c * c - c * self.diffuse[g.index])
        return out

    # ------------------------------------------------------------------------------------------- the engine

    def weights(self, table: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Of the specular radiance and of E/π, (m, 3) each, by (A, B)."""
        s = self.sampled
        made = rendering.SHADINGS[self.engine.shading](table[0][:, None], table[1][:, None], s.color, s.metal[:, None],
                                                       s.roughness[:, None], self.points.NoV[:, None], s.f0)
        return np.broadcast_to(made[0], s.color.shape), np.broadcast_to(made[1], s.color.shape)

    def shown(self, radiance: np.ndarray, diffuse: np.ndarray, table: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """(m, 3): the engine's picture of what it reads, as `rendering.shade` puts it together."""
        r = self.sampled.roughness
        blend = np.broadcast_to(self.engine.blend_formula(r=r, alpha=r * r), r.shape)[:, None]
        specular, rest = self.weights(table)
        return specular * (radiance + (diffuse - radiance) * blend) + rest * diffuse

    @cached_property
    def exact_table(self) -> tuple[np.ndarray, np.ndarray]:
        """(A, B), (m,) each."""
        _, E, _, more = self._once
        return more[:, 0], E[:, 0]

    @cached_property
    def perfect(self) -> np.ndarray:
        """(m, 3): X₀, what the engine would show of files without any error."""
        return self.shown(self.prefiltered, self.diffuse, self.exact_table)

    # ------------------------------------------------------------------------------------------- files

    def lights(self, recipes: Sequence[Chain]) -> None:
        """Bakes those chains that were not, all of a filter's tolerance and work together."""
        wanted = [recipe for key, recipe in {_key(r): r for r in recipes}.items() if key not in self._lights]
        for tolerance in dict.fromkeys(recipe.tolerance for recipe in wanted):
            some = [recipe for recipe in wanted if recipe.tolerance == tolerance]
            made = light(self.device, self.env, [Want(recipe) for recipe in some], seed="budget")
            for recipe, filtered in zip(some, made.chains, strict=True):
                self._lights[_key(recipe)] = made, filtered

    def read(self, recipe: Chain, form: str) -> np.ndarray:
        """(m, 3): prefiltered radiance as it is read from the levels of a chain in a pixel format."""
        key = (_key(recipe), form)
        if key not in self._reads:
            self.lights([recipe])
            levels = kept([level.texels for level in self._lights[key[0]][1].levels], form)
            self._reads[key] = rendering.specular(self.engine, Lights(tuple(levels)), self.points.n, self.points.v,
                                                  self.sampled.roughness)
        return self._reads[key]

    def between(self, recipe: Chain) -> np.ndarray:
        """(m, 3): the same of levels that are exact everywhere."""
        own = [single(r) for _, r in recipe.levels]
        mixtures = [mixture or lobe for mixture, lobe in zip(
            read_mixtures(self.device, recipe) if recipe.fit else [None] * len(own), own, strict=True)]
        lod = rendering.lods(self.engine, self.sampled.roughness, len(own), recipe.size)
        value = np.zeros_like(self.sampled.color)
        for k, mixture in enumerate(mixtures):
            weight = np.maximum(1 - np.abs(lod - k), 0)
            some = np.flatnonzero(weight)
            if len(some):
                d = self.looked_up[:, some]
                # Rougher than 1 are the last mips of an engine that follows its lod: lobes of the prefilter alone.
                held = self.lobe(mixture, d, 0) if max(r for _, r in mixture) <= 1 else \
                    Exact(self.device, self.env, recipe).lobes([(tuple(mixture), d)])[0]
                value[some] += weight[some, None] * held
        return value

    def stated(self, recipe: Chain) -> np.ndarray:
        """(m,): the bound that levels state, of those that are read."""
        self.lights([recipe])
        errors = np.array([level.error for level in self._lights[_key(recipe)][1].levels])
        lod = rendering.lods(self.engine, self.sampled.roughness, len(errors), recipe.size)
        return np.asarray(np.maximum(1 - np.abs(lod[:, None] - np.arange(len(errors))), 0) @ errors)

    def diffuse_read(self, recipe: Chain, how: str, form: str) -> np.ndarray:
        """(m, 3): E/π as it is read from "sh", the "cube" of a format, or the "level" of r = 1."""
        key = (_key(recipe), how, form)
        if key not in self._reads:
            self.lights([recipe])
            made, filtered = self._lights[key[0]]
            if how == "level":
                levels = tuple(kept([level.texels for level in filtered.levels], form))
                engine = msgspec.structs.replace(self.engine, sh=None)
                self._reads[key] = rendering.irradiance(engine, Lights(levels), self.points.n)
            elif how == "cube":
                self._reads[key] = bilinear(kept([made.irradiance.texels], form)[0], self.points.n)
            else:
                sh = harmonic.windowed(made.sh).values
                self._reads[key] = np.maximum(harmonic.irradiance_at(sh, self.points.n), 0)
        return self._reads[key]

    def table(self, dfg: Dfg | None, form: str | None) -> tuple[np.ndarray, np.ndarray]:
        """(A, B) as they are read from a table in a pixel format, None: float32; of no table Karis's fit."""
        NoV, r = self.points.NoV, self.sampled.roughness
        if dfg is None:
            return rendering.karis(NoV, r)
        dfg = msgspec.structs.replace(dfg, charlie=False)
        if (dfg, None) not in self._tables:
            self._tables[dfg, None] = split_sum(dfg, device=self.device).values
        if (dfg, form) not in self._tables:
            values = self._tables[dfg, None]
            wide = values if form == "rg16f" else np.concatenate([values, np.zeros_like(values[..., :1])], -1)
            self._tables[dfg, form] = kept([wide], form or "", cube=False)[0][..., :2]
        engine = msgspec.structs.replace(self.engine, dfg=dfg)
        return rendering.split_sum(engine, self._tables[dfg, form], NoV, r)

    # ------------------------------------------------------------------------------------------- the budget

    def entry(self, name: str, kind: Kind, difference: np.ndarray, what: str, *, used: bool = True,
              bound: bool = False) -> Entry:
        off = texel_errors(self.right + difference, self.right, float(self.right.mean()))
        return Entry(name, kind, float(np.sqrt((off * off).mean())), float(np.quantile(off, 0.95)), what, used, bound)

    def budget(self, recipe: Chain, engine: Engine | None = None) -> Budget:
        """Of a chain, as it is baked for the engine, or for one with other files but the same shading."""
        engine = _upright(engine) if engine else self.engine
        forms = _Forms.of(engine)
        files, X0, whole = self._files(recipe, engine, forms), self.perfect, self._shown(recipe, engine, forms)
        return Budget(engine.name, self.env.name, recipe.levels, len(X0),
                      (*files, *self.split, *self.model, *self._held(recipe, forms), *self._others),
                      self.entry("files", "files", whole - X0, "all of them, against exact ones"),
                      self.entry("exact files", "split", X0 - self.right, _FLOOR),
                      self.entry("whole", "other", whole - self.right, "the engine's picture against the integral"),
                      self.accuracy, self.sampled.notices)

    @cached_property
    def _seen(self) -> np.ndarray:
        """(m, 3): the mean of radiance by the whole integrand of the specular part."""
        m = self.sampled.metal[:, None]
        R, E = self.reflected((1 - m) * self.sampled.f0 + m * self.sampled.color)
        return R / np.maximum(E, 1e-12)

    @cached_property
    def split(self) -> tuple[Entry, ...]:
        """The split sum, whose two parts come first."""
        engine, specular = self.engine, self.weights(self.exact_table)[0]
        r = self.sampled.roughness
        blend = np.broadcast_to(engine.blend_formula(r=r, alpha=r * r), r.shape)[:, None]
        read = self.prefiltered + (self.diffuse - self.prefiltered) * blend
        how = f"mix(mirror direction, n, {engine.bend})" if engine.bend != "0" else "the mirror direction"
        return (
            self.entry("n = v = r", "split", specular * (read - self.own_view),
                       f"a lobe seen from n, read in {how}" +
                       (f", blended with E/π by {engine.blend}" if engine.blend != "0" else "")),
            self.entry("F·G from L", "split", specular * (self.own_view - self._seen),
                       "Fresnel and masking weigh no light"),
            self.entry("split sum", "split", specular * (read - self._seen),
                       "both of these, against the full integral"))

    @cached_property
    def model(self) -> tuple[Entry, ...]:
        specular, rest = self.weights(self.exact_table)
        schlick = self.reference(exact=False)
        return (
            self.entry("energy", "model", specular * self._seen + rest * self.diffuse - schlick,
                       "what it gives back of multiple scattering, and leaves for the diffuse"),
            self.entry("Fresnel", "model", schlick - self.right, "Schlick's term for the materials' indices"))

    def _files(self, recipe: Chain, engine: Engine, forms: _Forms) -> list[Entry]:
        """Each part of the files, in X₀."""
        P, D, AB, X0 = self.prefiltered, self.diffuse, self.exact_table, self.perfect
        specular, _ = self.weights(AB)
        exact, read = self.between(recipe), self.read(recipe, "float32")
        found = [
            self.entry("filter", "files", specular * P * self.stated(recipe)[:, None],
                       "p99 of texels that its levels state", bound=True),
            self.entry("texels", "files", self.shown(P + read - exact, D, AB) - X0,
                       f"bilinear reads within levels of {recipe.size}² to {recipe.levels[-1][0]}²"),
            self.entry("roughness", "files", self.shown(exact, D, AB) - X0,
                       f"linear reads between {len(recipe.levels)} levels" + (", fitted" if recipe.fit else "")),
            self.entry("format", "files", self.shown(P + self.read(recipe, forms.chain) - read, D, AB) - X0,
                       forms.chain)]
        if forms.table is None:
            found.append(self.entry("table", "files", self.shown(P, D, self.table(None, None)) - X0,
                                    "Karis's fit in place of one"))
        else:
            plain = self.table(engine.dfg, None)
            found.append(self.entry("table", "files", self.shown(P, D, plain) - X0,
                                    f"{engine.dfg.size}², read bilinearly"))
            stored_table = self.table(engine.dfg, forms.table)
            changed = (AB[0] + stored_table[0] - plain[0], AB[1] + stored_table[1] - plain[1])
            found.append(self.entry("table format", "files", self.shown(P, D, changed) - X0, forms.table))
        found.append(self.entry("diffuse", "files", self.shown(P, self.diffuse_read(recipe, *forms.diffuse), AB) - X0,
                                _DIFFUSE[forms.diffuse[0]]))
        return found

    def _shown(self, recipe: Chain, engine: Engine, forms: _Forms, but: Sequence[str] = ()) -> np.ndarray:
        """(m, 3): the engine's picture of its files, but that some parts are exact."""
        return self.shown(
            self.read(recipe, "float32" if "format" in but else forms.chain),
            self.diffuse if "diffuse" in but else self.diffuse_read(recipe, *forms.diffuse),
            self.exact_table if "table" in but else
            self.table(None if forms.table is None else engine.dfg, forms.table))

    def _held(self, recipe: Chain, forms: _Forms) -> list[Entry]:
        """Diffuse light held in other ways than the engine's."""
        return [self.entry(f"diffuse by {'harmonics' if how == 'sh' else 'cube'}", "other", self.shown(
            self.prefiltered, self.diffuse_read(recipe, how, "float32"), self.exact_table) - self.perfect,
            _DIFFUSE[how], used=False) for how in ("sh", "cube") if how != forms.diffuse[0]]

    @cached_property
    def _others(self) -> tuple[Entry, ...]:
        """What else a renderer could do, each against what is right."""
        found = []
        if self.engine.bend != "0" or self.engine.blend != "0":
            plain = self._each(lambda g: self.lobe(single(g.roughness), _mirrored(self.points.some(g.index)), g.count))
            found.append(self.entry("mirror direction", "other",
                                    self.weights(self.exact_table)[0] * (plain - self.own_view),
                                    "n = v = r read there, and nothing blended", used=False))
        found.append(self.entry("single scattering", "other", self.reference(again=False) - self.right,
                                "nothing given back, in the reference", used=False))
        if (grooved := self.grooved()).any():
            found.append(self.entry("Lambert", "other", grooved, "Oren and Nayar's grooves of the same roughness "
                                    "(tan σ = α/√2) in its place", used=False))
        found += [self.entry(f"masking {name}", "other", self.masked(name), f"{models('masking')[name].title}, in "
                             "place of height-correlated Smith", used=False)
                  for name in models("masking") if name != "smith"]
        cloth = self._sheen()
        return (*found, cloth) if cloth else tuple(found)

    def _sheen(self) -> Entry | None:
        """The split sum of Charlie's lobe on top of the materials that have a sheen."""
        some = [k for k in range(len(self.scene.materials)) if self.scene.materials[k]["sheen_color"].most > 0]
        out = np.zeros_like(self.sampled.color)
        for k in some:
            index = np.flatnonzero(self.sampled.material == k)
            if not len(index):
                continue
            m = self.scene.materials[k]
            r = max(float(middle(m["sheen_roughness"])[0]), 0.1)
            points = self.points.some(index)
            R, E = self.truth.reflected(term(ndf="charlie", roughness=r), points, self._least_count)
            d = _mirrored(points)
            levels, own = self.truth.reflected(term(ndf="charlie", roughness=r, masking="implicit"), Points(d, d),
                                               self._least_count)
            out[index] = middle(m["sheen_color"]) * (E * levels[:, 0] / own - R[:, 0])
        return self.entry("split sum of sheen", "other", out, "Charlie's lobe from n = v = r, Smith's masking",
                          used=False) if some and out.any() else None

    # ------------------------------------------------------------------------------------------- the choice

    def choose(self, tolerance: float, recipe: Chain) -> Choice:
        """The cheapest set whose files add at most `tolerance` (rms) to what the engine shows of exact ones, and with
        which, where exact ones allow it, the whole is within it too. `recipe` is the engine's usual chain. Parts of
        the files that are over it and that no choice changes (`beyond`) are left out of the judgement.

        Tried are sizes, last sizes and levels as the engine has them, --fit read, tables, the filter's tolerance; of
        raw and exr harmonics or a cube; of an engine of one's own the formats of its container: those of a preset are
        what its loader takes. Raises UsageError for a tolerance out of range, CheckError where no filter meets one.
        """
        low, high = TOLERANCE_RANGE
        if not low <= tolerance <= high:
            raise UsageError(f"tolerance {tolerance:g} is outside [{low:g}, {high:g}]")
        engines, chains = self._engines(), self._chains(recipe)
        X0, floor = self.perfect, self.entry("exact files", "split", self.perfect - self.right, _FLOOR)
        forms = [_Forms.of(engine) for engine in engines]
        fixed = [e for e in self._files(recipe, self.engine, _Forms.of(self.engine)) if e.rms > tolerance and (
            (e.name == "table" and forms[0].table is None) or
            (e.name == "format" and len({f.chain for f in forms}) == 1) or
            (e.name == "diffuse" and {f.diffuse[0] for f in forms} == {"sh"}))]
        but = [e.name for e in fixed]
        reachable = floor.rms <= tolerance and not fixed
        specular, _ = self.weights(self.exact_table)
        # What a filter of tolerance t may add is t times this at most.
        share = self.entry("filter", "files", specular * self.prefiltered, "").rms
        tried = sorted(((_nbytes(engine, one), one.fit is not None, i, j) for i, engine in enumerate(engines)
                        for j, one in enumerate(chains)), key=lambda key: key[:2])
        seen: list[tuple[float, int, float, float]] = []
        found: tuple[int, Chain, float, float] | None = None
        for at, (_, _, i, j) in enumerate(tried):
            engine, one = engines[i], chains[j]
            if _key(one) not in self._lights:
                self.lights([other for other in chains if other.size == one.size])
            files = self.entry("files", "files", self._shown(one, engine, forms[i], but) - X0, "").rms
            whole = self.entry("whole", "other", self._shown(one, engine, forms[i]) - self.right, "").rms
            short = max((files + FILTERS[-1] * share) / tolerance, whole / tolerance if reachable else 0.0)
            seen.append((short, at, files, whole))
            if short <= 1 and (made := self._certified(one, recipe, [t for t in FILTERS
                                                                     if files + t * share <= tolerance])):
                found = at, made, files, whole
                break
        met = found is not None
        for _, at, files, whole in sorted(seen) if not met else ():
            if made := self._certified(chains[tried[at][3]], recipe, FILTERS[::-1]):
                found = at, made, files, whole
                break
        if found is None:
            raise CheckError(f"no chain of {self.engine.name} can be filtered within {FILTERS[0]:g} in {self.env.name}")
        at, one, files, whole = found
        nbytes, _, i, _ = tried[at]
        engine = engines[i]
        entries = [e for e in self._files(one, engine, forms[i]) if e.name not in but]
        beyond = [floor] * (floor.rms > tolerance) + fixed + [
            e for e in (*self.split, *self.model) if e.rms > tolerance]
        return Choice(tolerance, self._options(engine, one, recipe), engine, one, nbytes, _nbytes(self.preset, recipe),
                      files + entries[0].rms, whole, max(entries, key=lambda e: e.rms), met, tuple(beyond), len(seen))

    def _certified(self, one: Chain, usual_chain: Chain, tolerances: Sequence[float]) -> Chain | None:
        """The chain under the first of those tolerances that its filter meets; None where it meets none."""
        for tolerance in tolerances:
            made = replace(one, tolerance=tolerance, certify=usual_chain.certify)
            try:
                self.lights([made])
            except CheckError:
                continue
            return made
        return None

    def _engines(self) -> list[Engine]:
        """The engine with other tables, formats and diffuse light."""
        engine = self.engine
        if engine.container != "files":
            both = engine.needs("sh") and engine.needs("irradiance")
            return [reduced(engine, (*engine.without, left)) for left in ("sh", "irradiance")] if both else [engine]
        found = [engine]
        if engine.holding("dfg") and engine.dfg.NoV == "centres":
            found = [reduced(engine, (), size) for size in sorted({*TABLES, engine.dfg.size})]
        if engine.name not in ENGINES:
            found = [msgspec.structs.replace(one, file=tuple(
                msgspec.structs.replace(file, format=form) if file.holds == "specular" else file for file in one.file))
                for one in found for form in _formats(engine.holding("specular")[0])]
        return found

    def _chains(self, recipe: Chain) -> list[Chain]:
        engine = self.engine
        found = []
        for size in sorted({*SIZES, recipe.size}):
            for fit in (None,) if engine.lods.follow else (None, "read"):  # which goes up to r = 1
                # Without certificates, which cost more than the levels do.
                base: dict[str, Any] = {"lods": engine.lods, "size": size, "fit": fit, "ndf": recipe.ndf.model,
                                        "tolerance": FILTERS[-1], "certify": 0}
                if engine.whole:
                    found.append(chain(**base, usual_min=engine.min_size))
                elif engine.levels:
                    if size >> (engine.levels - 1):
                        found.append(chain(**base, levels=engine.levels))
                else:
                    found += [chain(**base, min_size=last) for last in sorted({
                        max(recipe.min_size // 2, 1), recipe.min_size, 2 * recipe.min_size}) if last < size]
        return found

    def _options(self, engine: Engine, one: Chain, usual: Chain) -> dict[str, Any]:
        found: dict[str, Any] = {}
        if one.size != usual.size:
            found["size"] = one.size
        if not self.engine.whole and not self.engine.levels and one.min_size != usual.min_size:
            found["min_size"] = one.min_size
        if one.fit:
            found["fit"] = one.fit
        if engine.dfg.size != self.preset.dfg.size:
            found["table"] = engine.dfg.size
        if left := list(dict.fromkeys((*self.without, *engine.without))):
            found["without"] = left
        form, own = _Forms.of(engine).chain, _Forms.of(self.engine).chain
        if form != own:
            found["format"] = form
        return {**found, "tolerance": one.tolerance}


# ------------------------------------------------------------------------------------------------- details


_FLOOR = "the engine with these, against the integral"

_DIFFUSE = {"sh": "nine harmonics, windowed", "cube": "a cube of 32², read bilinearly",
            "level": "the level of r = 1, whose lobe is the cosine's for GGX"}


@dataclass(frozen=True)
class _Forms:
    """Pixel formats of an engine's files, "float32" for numbers as they are; `table` None without one; how diffuse
    light is held, and in which."""

    chain: str
    table: str | None
    diffuse: tuple[str, str]

    @classmethod
    def of(cls, engine: Engine) -> _Forms:
        if engine.container != "files":
            return cls("float32", "float32", ("sh" if "irradiance" in engine.without else "cube", "float32"))
        held = {holds: engine.holding(holds) for holds in ("specular", "skybox", "dfg", "irradiance")}
        levels = (held["specular"] or held["skybox"])[0].stored
        diffuse = ("sh", "float32") if engine.sh else ("cube", held["irradiance"][0].stored) if held["irradiance"] \
            else ("level", levels)
        return cls(levels, held["dfg"][0].stored if held["dfg"] else None, diffuse)


def _upright(engine: Engine) -> Engine:
    """The engine in the world's axes, in which levels are baked: a turn moves whole texels, and errors not at all."""
    return msgspec.structs.replace(engine, axes="+x +y +z")


def _key(recipe: Chain) -> str:
    return repr(recipe.canonical())


def _mirrored(points: Points) -> np.ndarray:
    return np.asarray(2 * (points.n * points.v).sum(0) * points.n - points.v)


def kept(levels: Sequence[np.ndarray], form: str, *, cube: bool = True) -> list[np.ndarray]:
    """What a pixel format makes of cube levels, or of images of three channels. Raises UnsupportedError for BC6H and
    ASTC without their packages."""
    if form in ("", "float32"):
        return list(levels)
    if form in ("bc6hu", "astc4x4hdr"):
        made = encode(form, levels, cube=cube).texture
        return [decode(made, k)[..., :3] for k in range(len(levels))]
    if form == "rgba16f":
        return [stored(level, "float16") for level in levels]
    return [unpack(form, pack(form, level).data, level.shape[:-1])[..., :level.shape[-1]] for level in levels]


def _formats(file: File) -> list[str]:
    """Those of a container that hold three channels, and can be written here."""
    found = []
    for form in FORMATS[file.suffix]:
        if form == "rg16f":
            continue
        try:
            kept([np.ones((6, 4, 4, 3), np.float32)], form)
        except UnsupportedError:
            continue
        found.append(form)
    return found


def _nbytes(engine: Engine, recipe: Chain) -> int:
    """Of all files, before compression."""
    return sum(target.nbytes for target in targets(engine, recipe, Path(), "x"))


def usual(engine: Engine, **options: Any) -> Chain:
    """The chain that is baked for an engine where nothing else is asked for."""
    given = {"size": engine.size, **({"levels": engine.levels} if engine.levels else {}), **options}
    return chain(lods=engine.lods, usual_min=engine.min_size, **given)


def measure(scene: Scene, env: Environment, engine: Engine, recipe: Chain | None, device: Device) -> Budget:
    """The budget of a scene in an environment by an engine's bake of `recipe`, its usual one without. Raises InputError
    for a scene without lit materials, UnsupportedError for an engine that is given no chain, DeviceError."""
    return Meter(scene, env, engine, device).budget(recipe or usual(engine))


def of_image(scene: Scene, source: str, engine: Engine, tolerance: float | None = None,
             device: str | None = None, without: Sequence[str] = ()) -> tuple[Budget, Choice | None]:
    """The budget of an engine's usual bake of an image, `demo` the built-in one, and what stays within a tolerance.
    Raises as `Meter`, `Meter.choose`, `environments.environment` and `device.choose_device` do."""
    on = choose_device(device)
    env = demo(on) if source == DEMO and not os.path.exists(source) else environment(source)
    meter, recipe = Meter(scene, env, engine, on, without=without), usual(engine)
    return meter.budget(recipe), None if tolerance is None else meter.choose(tolerance, recipe)


__all__ = ["Budget", "Choice", "Entry", "Meter", "Sampled", "measure", "of_image", "sampled", "usual"]
