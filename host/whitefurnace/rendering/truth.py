"""Computes the full reflectance integral of surface points in an environment, by importance sampling on the device.

[Hoffman2012, "The Reflectance Equation"] An engine shows the split sum: its levels have n = v = r, and its table knows
no light. Here nothing is split: L_o(v) = ∫ L(l) f(l, v)(n·l) dω, with every facet's own view, Fresnel and masking
inside. `radiance.py` computes the same for a few cells by quadrature in float64; a picture's error is measured against
it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from whitefurnace.catalogue import integral
from whitefurnace.catalogue.choice import Chosen, Spec
from whitefurnace.errors import UnsupportedError
from whitefurnace.integrals.normals import quantiles
from whitefurnace.integrals.quadrature import Part, grid_of, integrate, rows_of_roughness, slots_of
from whitefurnace.integrals.radiance import frame_of, radiance
from whitefurnace.opencl import source
from whitefurnace.opencl.derived import numbers_of
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import evaluate
from whitefurnace.prefiltering.certificate import QUANTILE, texel_errors
from whitefurnace.prefiltering.importance import CHUNK, GOLDEN, LARGEST_SOURCE, SAMPLES_A_LAUNCH, Sampler
from whitefurnace.prefiltering.means import Means
from whitefurnace.sphere.environments import Environment
from whitefurnace.sphere.grids import (
    cube_directions,
    face_coordinates,
    radiance_at,
    source_directions,
    source_solid_angles,
)
from whitefurnace.sphere.suns import without_sun

VISIBLE = ("ggx",)
"""NDFs that are ellipsoids stretched by their width. The distribution of their normals that v sees has a closed form.
"""

LIGHTS = 16384
"""Largest number of bright lights of an environment: 0.2 s of two cores for a sphere of 128 pixels."""

FINEST = 0.0035
"""Angle in radians within which texels are merged to one light, where an image has more bright texels than LIGHTS."""

BLOCK = 0.125
"""The same angle for wider lobes, relative to the lobe's width. Its error is of second order, 1e-3 of the light's
share."""

NEAR = 0.5
"""Largest texel relative to the lobe's width. Larger texels are cut, into at most MOST_CUT parts together."""

MOST_CUT = 8 * LIGHTS

SHARPER = 0.2
"""Largest texel from which a lobe is read, relative to its width, so that bilinear reads do not blur the result."""

QUADRATURE = 1e-4
"""Tolerance of the exact values, relative to the mean radiance."""

MOST_SAMPLES, FIRST_SAMPLES = 1 << 16, 256

TRIED = 192
"""Number of points at which the number of samples for a tolerance is determined."""


@dataclass(frozen=True)
class Points:
    """Surface points: unit normals n and directions v to the viewer, (3, m) in world axes, with n·v > 0."""

    n: np.ndarray
    v: np.ndarray

    @property
    def NoV(self) -> np.ndarray:
        """n·v, (m,), at least 1e-6."""
        return np.clip((self.n * self.v).sum(0), 1e-6, 1.0)

    def surface(self) -> np.ndarray:
        """n, the direction of v's projection, n·v and √(1 - (n·v)²), (8, m).

        Where v equals n, the direction is any tangent.
        """
        n, v, NoV = self.n, self.v, self.NoV
        across = v - NoV * n
        length = np.sqrt((across * across).sum(0))
        other = np.cross(n, np.where(np.abs(n[0]) < 0.6, np.eye(3)[:, :1], np.eye(3)[:, 1:2]), axis=0)
        across = np.where(length > 1e-7, across, other)
        across /= np.sqrt((across * across).sum(0))
        return np.concatenate([n, across, NoV[None], np.sqrt((1 - NoV) * (1 + NoV))[None]])

    def some(self, index: Any) -> Points:
        """Return the points with the indices `index`."""
        return Points(self.n[:, index], self.v[:, index])


@dataclass(frozen=True)
class Term:
    """A summand of the BRDF, in S variants that share their samples.

    models      models by slot
    parameters  (S,) values by SLOT_NAME
    smooth      True for a mirror, roughness 0
    """

    models: Mapping[str, Chosen]
    parameters: Mapping[str, np.ndarray]
    smooth: bool = False

    @property
    def sets(self) -> int:
        """The number S of variants."""
        return max((len(v) for v in self.parameters.values()), default=1)

    def width(self, device: Device) -> float:
        """Return the width of the lobe of the term's normals; 1 for a diffuse model."""
        if "ndf" not in self.models:
            return 1.0
        entry = self.models["ndf"].model
        rows = np.stack([self.parameters[f"ndf_{p.name}"][:1] for p in entry.parameters])
        found = evaluate(device, "NDF_WIDTH", {"ndf": entry}, numbers_of(device, entry, rows), 32)
        return min(float(found[0, 0]), 1.0)


def term(
    *,
    roughness: float | None = None,
    ndf: Spec | None = None,
    masking: Spec = "smith",
    fresnel: Spec = "one",
    diffuse: Spec | None = None,
    **parameters: Any,
) -> Term:
    """Make a term from models and parameters. An RGB value of a preset becomes three variants.

    roughness: perceptual roughness of the NDF in [0, 1]. parameters: further parameters by SLOT_NAME. Raises
    UsageError, and UnsupportedError for an anisotropic NDF.
    """
    slots = slots_of(integral("albedo"), ndf, masking, fresnel, diffuse, None)
    given: dict[str, Any] = {}
    if ndf is not None and not slots["ndf"].model.isotropic:
        raise UnsupportedError(
            f"ndf {slots['ndf'].model.name} is anisotropic: the truth of a picture is of isotropic ones"
        )
    if ndf is not None and roughness is not None:
        given |= rows_of_roughness(slots["ndf"], np.asarray(float(roughness)))
    models = {}
    for slot, choice in slots.items():
        models[slot] = Chosen(choice.model, {})
        given |= {
            f"{slot}_{p.name}": p.default
            for p in choice.model.parameters
            if p.default is not None and f"{slot}_{p.name}" not in given
        }
        given |= {f"{slot}_{name}": value for name, value in choice.given.items()}
    given |= parameters
    arrays = {name: np.atleast_1d(np.asarray(value, np.float64)) for name, value in given.items()}
    return Term(models, arrays, smooth=ndf is not None and roughness == 0)


def albedo(found: Term, NoV: np.ndarray, device: Device) -> np.ndarray:
    """Return the directional albedo ∫ f (n·l) dω of a term by quadrature, (m, S).

    NoV: cosines of the views, (m,) in [0, 1].
    """
    distinct, which = np.unique(NoV, return_inverse=True)
    given: dict[str, Any] = {name: np.broadcast_to(v, (found.sets,)) for name, v in found.parameters.items()}
    models: dict[str, Any] = dict(found.models)
    E = integrate("albedo", **models, NoV=distinct[:, None], device=device, **given)
    return np.asarray(E.values, np.float64).reshape(len(distinct), -1)[which.reshape(-1)]


def blocks(env: Environment, excess: np.ndarray, angle: float) -> np.ndarray:
    """Return the excess of bright texels as lights (k, 6): unit directions and Ω L.

    excess: (h, w, 3) or (6, n, n, 3). A light is one texel or, where texels are smaller than `angle` radians, a square
    of about that size, in the direction of its middle, weighted by the mean of the channels.
    """
    flat = excess.reshape(-1, 3)
    index = np.flatnonzero(flat.any(1))
    texel = texel_of(env)
    d, omega = source_directions(env, index), source_solid_angles(env).ravel()[index]
    power = flat[index] * omega[:, None]
    if not len(index) or angle < 2 * texel:
        return np.concatenate([d.T, power], 1)
    face, s, t = face_coordinates(d)
    cells = max(1, int(math.pi / 2 / angle))
    i, j = (np.clip(((x + 1) / 2 * cells).astype(int), 0, cells - 1) for x in (t, s))
    _, which = np.unique((face * cells + i) * cells + j, return_inverse=True)
    grey = power.mean(1)
    towards, whole = (np.stack([np.bincount(which, w) for w in rows], 1) for rows in (d * grey, power.T))
    return np.concatenate([towards / np.sqrt((towards**2).sum(1, keepdims=True)), whole], 1)


def cut(env: Environment, excess: np.ndarray, cuts: int) -> np.ndarray:
    """Return the excess of bright texels as lights (k, 6), as `blocks` does, with each texel cut into cuts² parts."""
    flat = excess.reshape(-1, 3)
    index = np.flatnonzero(flat.any(1))
    rows, columns = env.texels.shape[-3:-1]
    inside: np.ndarray = (np.arange(cuts) + 0.5) / cuts
    face, rest = np.divmod(index, rows * columns)
    i = ((rest // columns)[:, None, None] + inside[:, None] + 0 * inside).reshape(-1, cuts**2)
    j = ((rest % columns)[:, None, None] + inside + 0 * inside[:, None]).reshape(-1, cuts**2)
    if env.kind == "latlong":
        theta, phi = i * (math.pi / rows), j * (2 * math.pi / columns) - math.pi
        d = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)])
        share = np.sin(theta)
    else:
        s, t = 2 * j / columns - 1, 2 * i / rows - 1
        d = cube_directions(np.repeat(face[:, None], cuts**2, 1).ravel(), s.ravel(), t.ravel()).reshape(3, *s.shape)
        share = (1 + s * s + t * t) ** -1.5
    share = share / share.sum(1, keepdims=True) * source_solid_angles(env).ravel()[index][:, None]
    c, s_ = math.cos(env.rotation), math.sin(env.rotation)
    x, y, z = d.reshape(3, -1)
    power = share[..., None] * flat[index][:, None]
    return np.concatenate([np.stack([c * x - s_ * z, y, s_ * x + c * z], 1), power.reshape(-1, 3)], 1)


def texel_of(env: Environment) -> float:
    """Return the angle of a texel in radians; for a cube that of one in the middle of a face."""
    return math.pi / env.texels.shape[-3] / (1 if env.kind == "latlong" else 2)


class Truth:
    """Computes reflected radiance in one environment, in the units of its texels.

    Sums are over the radiance above the smallest value of each channel, and are divided by the sum of their own
    weights. The albedo, by quadrature, replaces that sum, so that constant light gives exactly that constant.
    """

    def __init__(self, device: Device, env: Environment, precision: int = 32) -> None:
        self.device, self.env, self.precision = device, env, precision
        self.kind = np.dtype(f"f{precision // 8}")
        bright = 1.0
        while True:
            rest, _ = without_sun(env, f"clamp={bright!r}")
            self.excess = env.texels.astype(np.float64) - rest.texels
            count = int(self.excess.any(-1).sum())
            if count <= LIGHTS or (count <= 64 * LIGHTS and len(blocks(env, self.excess, FINEST)) <= LIGHTS):
                break
            bright *= 2
        self.bright = bright
        """Radiance, in multiples of the mean, from which a texel's light is summed apart."""
        self.rest = self._sampler(rest)
        self._whole: Sampler | None = None

    def _sampler(self, env: Environment) -> Sampler:
        return Sampler(Means(self.device, env.texels, env.rotation), self.precision)

    @property
    def whole(self) -> Sampler:
        """The sampler of all light, for lobes too narrow for lights."""
        self._whole = self._whole or self._sampler(self.env)
        return self._whole

    def lights(self, found: Term) -> np.ndarray | None:
        """Return the lights (k, 6) that are summed apart for a term; None where its lobe is too narrow to cut texels
        for.
        """
        width, count = found.width(self.device), int(self.excess.any(-1).sum())
        cuts = math.ceil(texel_of(self.env) / (NEAR * width))
        if count * cuts**2 > MOST_CUT and cuts > 1:
            return None
        # As many cuts as there is room for, so that a setting texel fades in steps.
        cuts = max(cuts, min(math.isqrt(LIGHTS // max(count, 1)), 16))
        if cuts > 1:
            return cut(self.env, self.excess, cuts)
        return blocks(self.env, self.excess, max(BLOCK * width, FINEST) if count > LIGHTS else 0.0)

    def reflected(
        self,
        found: Term,
        points: Points,
        count: int,
        progress: Callable[[float], None] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute radiance (m, S, 3) and albedo (m, S) of points under a term.

        count: number of samples of each point. progress: called with the share of the points that is done.
        """
        if found.smooth:
            return self.mirror(found, points)
        E, lights = albedo(found, points.NoV, self.device), self.lights(found)
        sampler = self.whole if lights is None else self.rest
        sums, weights = self.sums(found, points, count, sampler, progress)
        mean = np.divide(sums, weights[..., None], out=np.zeros_like(sums), where=weights[..., None] > 0)
        value = E[..., None] * (mean + np.asarray(sampler.base, np.float64))
        return value if lights is None else value + self.gathered(found, points, lights), E

    def mirror(self, found: Term, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """Return what `reflected` returns, for a perfectly smooth surface: L(reflect(v)) F(n·v).

        [Hoffman2012, "Image Based Lighting"]
        """
        entry, m = found.models["fresnel"].model, points.n.shape[1]
        rows = [np.broadcast_to(found.parameters[f"fresnel_{p.name}"], (found.sets,)) for p in entry.parameters]
        cells = np.stack([np.tile(points.NoV, found.sets), *(np.repeat(row, m) for row in rows)])
        F = evaluate(self.device, "FRESNEL_F", {"fresnel": entry}, cells, 32)[0].reshape(found.sets, m).T
        L = radiance_at(self.env, 2 * (points.n * points.v).sum(0) * points.n - points.v)
        return F[..., None].astype(np.float64) * L[:, None], F.astype(np.float64)

    def samples(self, found: Term, points: Points, tolerance: float) -> tuple[int, float]:
        """Return the number of samples with which a term meets a tolerance, and the error of that many samples.

        The error is the 99th percentile over all variants at some of the points, measured against four times as many
        samples. Where the tolerance is never met, the number is MOST_SAMPLES.
        """
        m = points.n.shape[1]
        some = points.some(np.unique(np.linspace(0, m - 1, min(TRIED, m)).astype(int)))
        mean = float(np.mean(self.env.statistics["mean"]))
        count = FIRST_SAMPLES
        before = self.reflected(found, some, count)[0].reshape(-1, 3)
        while True:
            after = self.reflected(found, some, 4 * count)[0].reshape(-1, 3)
            error = float(np.quantile(texel_errors(before, after, mean), QUANTILE))
            if error <= tolerance or count >= MOST_SAMPLES:
                return count, error
            count, before = 4 * count, after

    def exact(self, found: Term, variant: int, points: Points, k: int) -> np.ndarray:
        """Return the reflected radiance (3,) of one variant at point k, by quadrature in float64 over the
        environment's texels.
        """
        frame = frame_of(points.n[:, k].tolist())
        x, y, z = frame @ points.v[:, k]
        given: dict[str, Any] = {
            name: float(np.broadcast_to(v, (found.sets,))[variant]) for name, v in found.parameters.items()
        }
        models: dict[str, Any] = dict(found.models)
        precision = 64 if self.device.fp64 else 32
        return np.asarray(
            radiance(
                environment=self.env,
                normal=points.n[:, k].tolist(),
                NoV=float(min(z, 1.0)),
                phi=math.atan2(y, x),
                precision=precision,
                tolerance=QUADRATURE,
                device=self.device,
                **models,
                **given,
            ).values,
            np.float64,
        )

    def sums(
        self, found: Term, points: Points, count: int, sampler: Sampler, progress: Callable[[float], None] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the means over `count` samples of weight × (L - base), (m, S, 3), and of the weights, (m, S)."""
        device, size, width = self.device, sampler.size, found.width(self.device)
        while size < LARGEST_SOURCE and math.pi / 2 / size > SHARPER * width:
            size *= 2
        numbers, terms = self._numbers(found)
        how, table = self._samples(found, numbers, count, size)
        pyramid, listed = sampler.pyramid(size), device.array(table.astype(self.kind))
        between = (listed, np.int32(size), np.int32(size.bit_length()), pyramid)
        total = self._over(found, numbers, terms, how, "reflect", points, count, between, 4, progress) / count
        return total[..., :3], total[..., 3]

    def gathered(
        self, found: Term, points: Points, lights: np.ndarray, progress: Callable[[float], None] | None = None
    ) -> np.ndarray:
        """Return ∑ Ω L f (n·l) over lights (k, 6), which are unit directions and Ω L: (m, S, 3)."""
        if not len(lights):
            return np.zeros((points.n.shape[1], found.sets, 3))
        table = np.zeros((len(lights), 8))
        table[:, :3], table[:, 4:7] = lights[:, :3], lights[:, 3:]
        numbers, terms = self._numbers(found)
        how = "COSINE" if "diffuse" in found.models else "NORMALS"
        return self._over(
            found,
            numbers,
            terms,
            how,
            "gather",
            points,
            len(lights),
            (self.device.array(table.astype(self.kind)),),
            3,
            progress,
        )

    def _numbers(self, found: Term) -> tuple[np.ndarray, int]:
        """Return the numbers of the models as kernels take them, (k, S), and the terms of the table of Smith's area."""
        models = {slot: choice.model for slot, choice in found.models.items()}
        part = Part(self.device, integral("albedo"), models, self.precision)
        grid = grid_of(
            integral("albedo"),
            found.models,
            {**{name: np.broadcast_to(v, (found.sets,)) for name, v in found.parameters.items()}, "NoV": 1.0},
            None,
        )
        numbers, terms, _ = part.cells(grid.rows(part, 0, found.sets), self.precision)
        return numbers[len(part.view) :], terms

    def _over(
        self,
        found: Term,
        numbers: np.ndarray,
        terms: int,
        how: str,
        name: str,
        points: Points,
        count: int,
        between: Sequence[Any],
        components: int,
        progress: Callable[[float], None] | None,
    ) -> np.ndarray:
        """Return the sums of a kernel of `truth.cl` over `count` samples or lights: (m, S, components)."""
        device, sets = self.device, found.sets
        models = {slot: choice.model for slot, choice in found.models.items()}
        lanes = device.lanes(self.precision)
        kernel = device.build(
            source.truth(models, how, sets, terms).text, {"W": lanes, "T": 1, "PRECISION": self.precision}
        ).kernel(name)
        cells = device.array(np.repeat(numbers, lanes, 1).astype(self.kind))
        step, splits, m = lanes * device.local_size, -(-count // CHUNK), points.n.shape[1]
        tile = max(SAMPLES_A_LAUNCH // count // step, 1) * step
        surface = points.surface()
        out = np.empty((m, sets, components))
        for begin in range(0, m, tile):
            some = surface[:, begin : begin + tile]
            held = some.shape[1]
            padded = -(-held // step) * step
            block = np.pad(some, ((0, 0), (0, padded - held)), mode="edge").astype(self.kind)
            partial = device.empty((splits, sets, components, padded), self.kind)
            device.launch(
                kernel,
                (padded // lanes, splits),
                (
                    partial,
                    np.int32(padded),
                    np.int32(count),
                    np.int32(CHUNK),
                    device.array(block),
                    *between,
                    np.int32(sets * lanes),
                    cells,
                ),
            )
            out[begin : begin + held] = partial.read().sum(0, dtype=np.float64)[:, :, :held].transpose(2, 0, 1)
            if progress:
                progress((begin + held) / m)
        return out

    def _samples(self, found: Term, numbers: np.ndarray, count: int, size: int) -> tuple[str, np.ndarray]:
        """Return the macro that says how directions are drawn, and the (count, 4) table that `truth.cl` reads.

        Ω is relative to the solid angle of a texel at the middle of a face, 4/size²; the samples are a lattice of two
        dimensions as in `importance.light_samples`.
        """
        u = (np.arange(count) + 0.5) / count
        phi = 2 * math.pi * np.mod(np.arange(count) * GOLDEN, 1.0)
        texels = size**2 / 4
        if "diffuse" in found.models:
            z = np.sqrt(1 - u)
            lod = 0.5 * np.log2(texels * math.pi / (count * z))
            return "COSINE", np.stack([np.sqrt(u) * np.cos(phi), np.sqrt(u) * np.sin(phi), z, lod], 1)
        entry = found.models["ndf"].model
        if entry.name in VISIBLE:  # Ω = 4 A/(N D)
            lod = np.full(count, 0.5 * math.log2(texels * 4 / count))
            return "VISIBLE", np.stack([u, np.cos(phi), np.sin(phi), lod], 1)
        own = numbers[: len(entry.arguments), :1]
        sin2 = quantiles(self.device, entry, own, u)
        s, z = np.sqrt(sin2), np.sqrt(np.maximum(1 - sin2, 1e-12))
        cells = np.concatenate([np.stack([z, sin2]), np.repeat(own, count, 1)])
        D = evaluate(self.device, "NDF_D", {"ndf": entry}, cells, 32)[0].astype(np.float64)
        lod = 0.5 * np.log2(texels * 4 / (count * np.maximum(D * z, 1e-12)))  # × v·h
        return "NORMALS", np.stack([s * np.cos(phi), s * np.sin(phi), z, lod], 1)
