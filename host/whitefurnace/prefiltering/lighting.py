"""Prefilters the light of an environment: the specular chain, irradiance and harmonics, with certified errors."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from whitefurnace.catalogue import Model
from whitefurnace.errors import UsageError
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.convolution import Convolver, Level, Progress
from whitefurnace.prefiltering.jobs import Job, chain_jobs, irradiance_job
from whitefurnace.prefiltering.levels import Clock, run_jobs
from whitefurnace.prefiltering.recipe import CERTIFIED, IRRADIANCE_SIZE, Chain, chain, samples_of, tolerance_of
from whitefurnace.results import Integrated
from whitefurnace.sphere.bad_pixels import check_bad_pixels
from whitefurnace.sphere.environments import Environment, Reading, read_environment
from whitefurnace.sphere.grids import Shape, source_solid_angles


@dataclass(frozen=True)
class Prefiltered:
    """A prefiltered specular chain of n levels.

    values       n float32 arrays of linear radiance: (6, s, s, 3) in the GL-direct layout, or lat-longs (s, 2 s, 3)
    roughness    (n,) perceptual roughness
    error        (n,) bound on the 99th percentile of the texel errors, at 95 % confidence
    worst, rmse  (n,) largest texel error that was seen, and relative RMSE
    evaluations  number of lobe evaluations of the convolution
    seconds      wall time; `timings` splits it into "source" (bright texels, grids), "levels" and "certificate"
    rule         the method of each level
    notices      sentences about how the environment was read
    """

    levels: tuple[Level, ...]
    seconds: float
    timings: dict[str, float]
    notices: tuple[str, ...] = ()

    @property
    def values(self) -> tuple[np.ndarray, ...]:
        """The levels as arrays; see the class."""
        return tuple(level.texels for level in self.levels)

    @property
    def roughness(self) -> np.ndarray:
        """Perceptual roughness of each level, (n,)."""
        return np.array([level.roughness for level in self.levels])

    @property
    def error(self) -> np.ndarray:
        """Stated error of each level, (n,)."""
        return np.array([level.error for level in self.levels])

    @property
    def worst(self) -> np.ndarray:
        """Largest texel error that was seen in each level, (n,)."""
        return np.array([level.worst for level in self.levels])

    @property
    def rmse(self) -> np.ndarray:
        """Relative RMSE of each level, (n,)."""
        return np.array([level.rmse for level in self.levels])

    @property
    def evaluations(self) -> int:
        """Number of lobe evaluations of all levels."""
        return sum(level.pairs for level in self.levels)

    @property
    def rule(self) -> tuple[str, ...]:
        """Method of each level."""
        return tuple(level.method for level in self.levels)


@dataclass(frozen=True)
class Certified(Integrated):
    """An array with its certified errors.

    `error` bounds the 99th percentile of texel errors at 95 % confidence; `worst` is the largest that was seen, `rmse`
    the relative RMSE. For spherical harmonics all of them are the largest coefficient error over the largest L00.
    """

    worst: float = 0.0
    rmse: float = 0.0


@dataclass(frozen=True)
class Want:
    """A chain that a bake needs.

    cubes, latlongs, octahedral  number of its first levels in this form, None for all
    image                        rows of a lat-long of level 0, whatever the size of the chain; 0 for none
    """

    recipe: Chain
    cubes: int | None = None
    latlongs: int | None = 0
    octahedral: int | None = 0
    image: int = 0


@dataclass(frozen=True)
class Filtered:
    """The wanted levels of a chain.

    levels, latlongs, octahedral  levels as cubes, lat-longs and octahedral maps
    energy_kept                   mean radiance of each cube over that of the source, minus 1
    coverage, ...                 the same levels of the source's coverage; empty where it has none
    image, image_coverage         the lat-long of level 0 that was asked for, and its coverage
    """

    levels: tuple[Level, ...]
    latlongs: tuple[Level, ...]
    energy_kept: tuple[float, ...]
    coverage: tuple[Level, ...]
    latlong_coverage: tuple[Level, ...]
    octahedral: tuple[Level, ...] = ()
    octahedral_coverage: tuple[Level, ...] = ()
    image: tuple[Level, ...] = ()
    image_coverage: tuple[Level, ...] = ()


@dataclass(frozen=True)
class Lighting:
    """The light of one environment: its chains in the order of the request, irradiance and harmonics.

    irradiance  E/π as a cube
    sh          (9, 3) radiance coefficients; `sh_error` is their error over the largest L00
    seconds     wall time
    """

    chains: tuple[Filtered, ...]
    irradiance: Level
    sh: np.ndarray
    sh_error: float
    seconds: float


def light(
    device: Device, env: Environment, wants: Sequence[Want], *, seed: str = "", progress: Progress | None = None
) -> Lighting:
    """Prefilter an environment for several chains, which share grids, certificates and equal levels.

    wants: the chains; the tolerance of the first is also that of irradiance. seed: seed of the certificates' samples.
    progress: called with the current activity and the share of the work done.

    Raises CheckError where a level cannot reach its tolerance, and DeviceError where the device fails.
    """
    begin = time.perf_counter()
    recipe = wants[0].recipe
    convolver = Convolver(device, env, precision=planning.precision_for(recipe.tolerance), seed=seed, progress=progress)
    jobs, places, tolerances = _distinct(convolver, wants)
    everything = [*jobs, irradiance_job(convolver, IRRADIANCE_SIZE, recipe.tolerance, recipe.samples)]
    levels = _run(convolver, everything, [*tolerances, recipe.tolerance], recipe.certify)
    sh, sh_error = convolver.harmonics()
    kept = [
        job.shape.mean(level.texels) / convolver.mean - 1 if convolver.mean > 0 else 0.0
        for job, level in zip(jobs, levels[:-1], strict=True)
    ]
    coverage: list[Level] = []
    if env.coverage is not None:
        # Coverage is filtered and certified as light of one channel.
        grey = np.repeat(env.coverage[..., None], 3, -1)
        share = float(np.average(env.coverage, weights=source_solid_angles(env)))
        as_light = replace(env, texels=grey, coverage=None, statistics={"mean": [share] * 3})
        convolver = Convolver(device, as_light, precision=convolver.precision, seed=seed, progress=progress)
        jobs, _, tolerances = _distinct(convolver, wants)
        coverage = _run(convolver, jobs, tolerances, recipe.certify)
    chains = []
    for cubes, wide, square, image in places:
        covered = [tuple(coverage[k] for k in some) if coverage else () for some in (cubes, wide, square, image)]
        chains.append(
            Filtered(
                tuple(levels[k] for k in cubes),
                tuple(levels[k] for k in wide),
                tuple(kept[k] for k in cubes),
                covered[0],
                covered[1],
                tuple(levels[k] for k in square),
                covered[2],
                tuple(levels[k] for k in image),
                covered[3],
            )
        )
    return Lighting(tuple(chains), levels[-1], sh, sh_error, time.perf_counter() - begin)


def _run(convolver: Convolver, jobs: Sequence[Job], tolerances: Sequence[float], certify: int) -> list[Level]:
    """The levels of jobs with a tolerance each; jobs of one tolerance run together."""
    made: dict[int, Level] = {}
    for tolerance in sorted(set(tolerances)):
        some = [k for k, one in enumerate(tolerances) if one == tolerance]
        made |= zip(some, run_jobs(convolver, [jobs[k] for k in some], tolerance, certify=certify), strict=True)
    return [made[k] for k in range(len(jobs))]


def _distinct(
    convolver: Convolver, wants: Sequence[Want]
) -> tuple[list[Job], list[tuple[list[int], ...]], list[float]]:
    """Return the distinct jobs of all chains, with their tolerances.

    The second value has, for each chain, the indices of its cubes, lat-longs, octahedral maps and image. A job has the
    smallest tolerance of the chains that need it.
    """
    jobs: list[Job] = []
    tolerances: list[float] = []
    known: dict[Any, int] = {}
    places: list[tuple[list[int], ...]] = [() for _ in wants]
    for w in sorted(range(len(wants)), key=lambda w: wants[w].recipe.tolerance):
        want = wants[w]
        placed: tuple[list[int], ...] = ([], [], [], [])
        for kind, count in enumerate((want.cubes, want.latlongs, want.octahedral, min(want.image, 1))):
            if count == 0:
                continue
            for job in chain_jobs(convolver, want.recipe, latlong=kind in (1, 3), octahedral=kind == 2)[:count]:
                if kind == 3:
                    job = replace(job, shape=Shape(True, want.image))
                lobe = job.lobe and tuple((entry.name, entry.text, *rest) for entry, *rest in job.lobe.summands)
                key = (lobe, job.shape, job.plan.samples)
                if key not in known:
                    known[key] = len(jobs)
                    jobs.append(job)
                    tolerances.append(want.recipe.tolerance)
                placed[kind].append(known[key])
        places[w] = placed
    return jobs, places, tolerances


def prefilter(
    source: Any,
    *,
    size: int = 256,
    min_size: int | None = None,
    ndf: str | Model = "ggx",
    tolerance: float | None = None,
    quality: str | None = None,
    samples: int | None = None,
    levels: int | None = None,
    fit: str | None = None,
    certify: int = CERTIFIED,
    rotate: float = 0.0,
    exposure: float = 0.0,
    bad_pixels: str = "refuse",
    layout: str | None = None,
    layer: str | None = None,
    fill: str | None = None,
    nonfinite: str | None = None,
    latlong: bool = False,
    device: Device | str | None = None,
) -> Prefiltered:
    """Prefilter the specular chain of an environment.

    source: a path, an array, an `Environment` or the word `demo`. size, min_size: texels of a face edge of the first
    and the last level, powers of two. ndf: name or entry of an isotropic NDF. tolerance: bound on `error` of every
    level, 1e-3 by default. quality: "draft", "normal" or "reference", instead of a tolerance. samples: number of
    filtered importance samples for each texel, 1 to 65536, instead of both; `error` is then the error that they leave.
    levels: number of levels. fit: "read" fits the levels so that interpolated roughness values are most accurate.
    certify: number of uniform texels of each level's certificate, 299 or more; 0 for none, then `error`, `worst` and
    `rmse` are NaN and nothing is refined. rotate: degrees about +Y. exposure: stops. bad_pixels (or nonfinite, its
    older name): "refuse", "zero" or "clamp" for texels that are not finite or negative. layout, layer, fill: how an
    image is read, as for `environment`. latlong: make lat-long images of 2·size rows.

    Raises the errors of `environment`, UsageError, UnsupportedError, CheckError and DeviceError.
    """
    begin = time.perf_counter()
    recipe = chain(
        ndf=ndf,
        size=size,
        min_size=min_size,
        tolerance=tolerance,
        quality=quality,
        samples=samples,
        levels=levels,
        fit=fit,
        certify=certify,
    )
    mode = check_bad_pixels(bad_pixels, nonfinite)
    env = read_environment(source, Reading(rotate, exposure, mode, layout, layer, fill), device=device)
    clock = Clock()
    with clock("source"):
        convolver = Convolver(_device(device), env, precision=planning.precision_for(recipe.tolerance))
    made = run_jobs(
        convolver, chain_jobs(convolver, recipe, latlong=latlong), recipe.tolerance, certify=recipe.certify, clock=clock
    )
    return Prefiltered(tuple(made), time.perf_counter() - begin, clock.seconds, env.notices)


def irradiance(
    source: Any,
    *,
    size: int = IRRADIANCE_SIZE,
    tolerance: float | None = None,
    samples: int | None = None,
    rotate: float = 0.0,
    exposure: float = 0.0,
    bad_pixels: str = "refuse",
    layout: str | None = None,
    layer: str | None = None,
    fill: str | None = None,
    nonfinite: str | None = None,
    device: Device | str | None = None,
) -> Certified:
    """Compute the irradiance of an environment divided by π, as a cube (6, size, size, 3) float32.

    A constant environment of 1 gives 1. size: texels of a face edge, 1 to 1024. The other parameters and the errors
    raised are those of `prefilter`.
    """
    if not 1 <= size <= 1024:
        raise UsageError(f"irradiance size {size} is outside [1, 1024]")
    begin = time.perf_counter()
    count = samples_of(samples, tolerance)
    bound = tolerance_of(tolerance, None)
    mode = check_bad_pixels(bad_pixels, nonfinite)
    env = read_environment(source, Reading(rotate, exposure, mode, layout, layer, fill), device=device)
    convolver = Convolver(_device(device), env, precision=planning.precision_for(bound))
    level = run_jobs(convolver, [irradiance_job(convolver, size, bound, count)], bound)[0]
    return Certified(
        level.texels,
        level.error,
        level.pairs,
        time.perf_counter() - begin,
        level.method,
        env.notices,
        worst=level.worst,
        rmse=level.rmse,
    )


def harmonics(
    source: Any,
    *,
    rotate: float = 0.0,
    exposure: float = 0.0,
    bad_pixels: str = "refuse",
    layout: str | None = None,
    layer: str | None = None,
    fill: str | None = None,
    nonfinite: str | None = None,
    device: Device | str | None = None,
) -> Certified:
    """Compute the spherical harmonics of an environment's radiance to degree 2, (9, 3) float64.

    The basis is real and orthonormal in world x, y, z, without the Condon-Shortley sign, in the order L00, L1-1, L10,
    L11, L2-2, L2-1, L20, L21, L22. The parameters and the errors raised are those of `prefilter`.
    """
    begin = time.perf_counter()
    mode = check_bad_pixels(bad_pixels, nonfinite)
    env = read_environment(source, Reading(rotate, exposure, mode, layout, layer, fill), device=device)
    convolver = Convolver(_device(device), env)
    values, error = convolver.harmonics()
    seconds = time.perf_counter() - begin
    return Certified(values, error, env.texels.size // 3, seconds, "texel-nodes", env.notices, worst=error, rmse=error)


def _device(device: Device | str | None) -> Device:
    return device if isinstance(device, Device) else choose_device(device)


__all__ = ["Certified", "Filtered", "Lighting", "Prefiltered", "Want", "harmonics", "irradiance", "light", "prefilter"]
