"""What an environment gives a renderer: the specular chain, irradiance and spherical harmonics, each certified
against the exact integral and refined where it misses the tolerance."""
from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from whitefurnace import plan as planning
from whitefurnace.catalogue import Model
from whitefurnace.certificate import statement, texel_errors
from whitefurnace.convolution import COSINE, EXACT_SHARE, ROUNDING, Convolver, Level, Lobe, Progress, ndf_lobe
from whitefurnace.device import Device, choose_device
from whitefurnace.environments import Environment, environment
from whitefurnace.errors import CheckError, UsageError
from whitefurnace.plan import LevelPlan
from whitefurnace.recipe import IRRADIANCE_SIZE, Chain, chain, tolerance_of
from whitefurnace.run import Integrated
from whitefurnace.sphere import Shape, source_solid_angles


@dataclass(frozen=True)
class Prefiltered:
    """A specular chain. `values` is a tuple of float32 arrays, (6, s, s, 3) a level in the GL-direct layout, or
    (s, 2 s, 3) as lat-longs; `roughness`, `error`, `worst`, `rmse` are (n,) float64; `evaluations` counts lobe
    evaluations of the convolution; `seconds` is wall time; `rule` names the method of each level."""

    levels: tuple[Level, ...]
    seconds: float

    @property
    def values(self) -> tuple[np.ndarray, ...]:
        return tuple(level.texels for level in self.levels)

    @property
    def roughness(self) -> np.ndarray:
        return np.array([level.roughness for level in self.levels])

    @property
    def error(self) -> np.ndarray:
        return np.array([level.error for level in self.levels])

    @property
    def worst(self) -> np.ndarray:
        return np.array([level.worst for level in self.levels])

    @property
    def rmse(self) -> np.ndarray:
        return np.array([level.rmse for level in self.levels])

    @property
    def evaluations(self) -> int:
        return sum(level.pairs for level in self.levels)

    @property
    def rule(self) -> tuple[str, ...]:
        return tuple(level.method for level in self.levels)


@dataclass(frozen=True)
class Certified(Integrated):
    """An array with its statement: an `Integrated` whose `error` is the p99 of texel errors at 95 % confidence (for
    spherical harmonics the largest coefficient error over the largest of L00), with `worst` and `rmse`."""

    worst: float = 0.0
    rmse: float = 0.0


@dataclass(frozen=True)
class Job:
    """One level to make: its plan, its lobe (None: the mean over each texel) and where it is evaluated."""

    plan: LevelPlan
    lobe: Lobe | None
    shape: Shape


def chain_jobs(convolver: Convolver, recipe: Chain, *, latlong: bool = False) -> list[Job]:
    """The jobs of a specular chain, as cubes, or as lat-longs of twice a face's height."""
    jobs = []
    for level in planning.plan_chain(recipe, convolver.texel, convolver.share):
        lobe = (None if level.roughness == 0 else
                ndf_lobe(convolver.device, recipe.ndf, level.roughness, level.parameters))
        if lobe and lobe.horizon > lobe.alpha:  # a tail heavier than GGX's
            grid = max(level.grid, planning.grid_size(lobe.alpha, recipe.tolerance, lobe.horizon))
            level = replace(level, grid=grid)
        jobs.append(Job(level, lobe, Shape(latlong, 2 * level.size if latlong else level.size)))
    return jobs


def irradiance_job(convolver: Convolver, size: int, tolerance: float) -> Job:
    """The job of the irradiance cube."""
    cuts = planning.cuts_for(convolver.texel, 1.0, tolerance, convolver.share)
    return Job(LevelPlan(size, 1.0, {}, planning.grid_size(1.0, tolerance), cuts), COSINE, Shape(False, size))


def run_jobs(convolver: Convolver, jobs: Sequence[Job], tolerance: float) -> list[Level]:
    """Makes, certifies and where needed refines every level, in the order of `jobs`.

    The exact values come first: how finely texels must be cut for them is how finely the grids need them too.
    Raises CheckError when a level misses the tolerance and finer grids do not help.
    """
    begin = time.perf_counter()
    samples = [convolver.sample(job.shape) for job in jobs]
    jobs, references, doubts = _references(convolver, jobs, samples, tolerance)
    if any(job.lobe for job in jobs):
        convolver.prepare(max(job.plan.grid for job in jobs), max(job.plan.cuts for job in jobs if job.lobe))
    common = (time.perf_counter() - begin) / len(jobs)
    work = [planning.pairs_of(job.shape.count, max(job.plan.grid, 8), job.lobe.alpha if job.lobe else 1.0,
                              job.lobe.horizon if job.lobe else 1.0)
            for job in jobs]
    levels = []
    for k, job in enumerate(jobs):
        begin = time.perf_counter()
        share = tuple(EXACT_SHARE + (1 - EXACT_SHARE) * sum(work[:m]) / sum(work) for m in (k, k + 1))
        level = _stated(convolver, job, _make(convolver, job, tolerance, share), samples[k], references[k], doubts[k])
        before, stuck = math.inf, 0
        while not level.error <= tolerance:  # NaN too
            finer = planning.refined(job.plan) if job.lobe else None
            stuck = stuck + 1 if not level.error <= 0.9 * before else 0
            if finer is None or stuck == 2:
                what = "mean" if job.lobe is None else job.lobe.name
                raise CheckError(f"level {what} of {'×'.join(map(str, job.shape.dims))} texels has an error of "
                                 f"{level.error:.2g}, over the tolerance {tolerance:g}, and finer grids do not help")
            job, before = replace(job, plan=finer), level.error
            texels = _make(convolver, job, tolerance, share)
            level = _stated(convolver, job, texels, samples[k], references[k], doubts[k])
        levels.append(replace(level, seconds=time.perf_counter() - begin + common))
    return levels


def _make(convolver: Convolver, job: Job, tolerance: float, share: tuple[float, ...]) -> np.ndarray:
    if job.lobe is None:
        return convolver.means(job.shape)
    return convolver.convolve(job.lobe, job.shape, job.plan.grid, tolerance, share)


PROBES = 32
"""Texels on which a reference is checked against itself with twice the nodes: the darkest, where a bright panel
at the horizon shows most."""


def _references(convolver: Convolver, jobs: Sequence[Job], samples: Sequence[tuple[np.ndarray, np.ndarray]],
                tolerance: float) -> tuple[list[Job], list[np.ndarray], list[float]]:
    """Jobs with the cuts their texels need, the exact values of each one's sample (m, 3), and what these may still
    be off by.

    For rough lobes the nodes are doubled until the values change by less than a tenth of the tolerance on the
    PROBES darkest texels; the last change is the doubt. Lobes with the same cuts share one pass over the source.
    """
    jobs = list(jobs)
    index = [np.concatenate(sample) for sample in samples]
    references: list[np.ndarray] = [np.empty(0)] * len(jobs)
    doubts = [0.0] * len(jobs)
    for k, job in enumerate(jobs):
        if job.lobe is None:
            references[k] = convolver.exact_means(job.shape, index[k])
    todo = [k for k, job in enumerate(jobs) if job.lobe]
    while todo:
        for cuts in sorted({jobs[k].plan.cuts for k in todo}):
            group = [k for k in todo if jobs[k].plan.cuts == cuts]
            for k, values in zip(group, _exact(convolver, jobs, group, index, cuts, tolerance), strict=True):
                references[k] = values
                doubts[k] = planning.cuts_error(convolver.texel, _lobe(jobs[k]).alpha, cuts)
        todo = [k for k in todo if _lobe(jobs[k]).horizon > planning.SHARP_ENOUGH and not convolver.constant]
        again = []
        for cuts in sorted({jobs[k].plan.cuts for k in todo}):
            group = [k for k in todo if jobs[k].plan.cuts == cuts]
            dark = {k: np.argsort(references[k].min(1), kind="stable")[:PROBES] for k in group}
            probes = {k: index[k][dark[k]] for k in group}
            finer = _exact(convolver, jobs, group, probes, 2 * cuts, tolerance)
            for k, values in zip(group, finer, strict=True):
                mean = convolver.mean * convolver.scale
                doubts[k] = float(texel_errors(references[k][dark[k]], values, mean).max())
                # On small images more nodes cost nothing: there the reference is made exact, not just good enough.
                cheap = convolver.nodes(2 * cuts) <= 4 * planning.NODES_A_BAND
                if doubts[k] > tolerance / (100 if cheap else 10) and 2 * cuts <= planning.MOST_CUTS:
                    jobs[k] = replace(jobs[k], plan=replace(jobs[k].plan, cuts=2 * cuts))
                    again.append(k)
        todo = again
    return jobs, references, doubts


def _lobe(job: Job) -> Lobe:
    assert job.lobe is not None
    return job.lobe


def _exact(convolver: Convolver, jobs: Sequence[Job], group: Sequence[int], index: Any, cuts: int,
           tolerance: float) -> list[np.ndarray]:
    """Exact values of the texels `index[k]` for every job k of a group, in one pass over the source."""
    return convolver.exact([(_lobe(jobs[k]), jobs[k].shape.directions(index[k])) for k in group], cuts, tolerance)


def _stated(convolver: Convolver, job: Job, texels: np.ndarray, sample: tuple[np.ndarray, np.ndarray],
            reference: np.ndarray, doubt: float) -> Level:
    index = np.concatenate(sample)
    mean = job.shape.mean(texels)
    error, worst, rmse = statement(texels.reshape(-1, 3)[index], reference, sample, job.shape.solid_angles(index), mean,
                                   job.shape.count)
    # A mean over texels is made and checked in float64, and rounded once; elsewhere rounding has its own part.
    rounding = 0.0 if mean == 0 else ROUNDING[64 if job.lobe is None else convolver.precision]
    if mean > 0 and not convolver.constant:
        rounding += doubt
    method, pairs = "texel-mean", 0
    if job.lobe:
        method = f"anterpolated-{job.plan.grid}"
        pairs = planning.pairs_of(job.shape.count, job.plan.grid, job.lobe.alpha, job.lobe.horizon)
    scaled = (texels * (1 / convolver.scale)).astype(np.float32)  # a power of two: exact
    return Level(scaled, job.plan.roughness, error + rounding, worst + rounding, rmse, method, job.plan.grid, pairs,
                 seconds=0.0)


@dataclass(frozen=True)
class Lighting:
    """Everything of one environment: levels as cubes and (where asked for) as lat-longs, irradiance, SH."""

    levels: tuple[Level, ...]
    latlongs: tuple[Level, ...]
    irradiance: Level
    sh: np.ndarray
    sh_error: float
    energy_kept: tuple[float, ...]
    coverage: tuple[Level, ...]
    latlong_coverage: tuple[Level, ...]
    seconds: float


def light(device: Device, env: Environment, recipe: Chain, *, latlong: bool = False, seed: str = "",
          progress: Progress | None = None) -> Lighting:
    """The whole of an environment under one recipe, sharing grids and certificates. Raises CheckError where a
    level cannot reach the tolerance, DeviceError where the device fails."""
    begin = time.perf_counter()
    convolver = Convolver(device, env, precision=planning.precision_for(recipe.tolerance), seed=seed,
                          progress=progress)
    jobs = chain_jobs(convolver, recipe)
    wide = chain_jobs(convolver, recipe, latlong=True) if latlong else []
    everything = [*jobs, *wide, irradiance_job(convolver, IRRADIANCE_SIZE, recipe.tolerance)]
    levels = run_jobs(convolver, everything, recipe.tolerance)
    sh, sh_error = convolver.harmonics()
    kept = tuple(job.shape.mean(level.texels) / convolver.mean - 1 if convolver.mean > 0 else 0.0
                 for job, level in zip(jobs, levels[:len(jobs)], strict=True))
    coverage: list[Level] = []
    if env.coverage is not None:
        # Coverage is light of one channel: the same chain, the same statement.
        grey = np.repeat(env.coverage[..., None], 3, -1)
        share = float(np.average(env.coverage, weights=source_solid_angles(env)))
        as_light = replace(env, texels=grey, coverage=None, statistics={"mean": [share] * 3})
        convolver = Convolver(device, as_light, precision=convolver.precision, seed=seed, progress=progress)
        jobs = chain_jobs(convolver, recipe)
        wide = chain_jobs(convolver, recipe, latlong=True) if latlong else []
        coverage = run_jobs(convolver, [*jobs, *wide], recipe.tolerance)
    n = len(jobs)
    return Lighting(tuple(levels[:n]), tuple(levels[n:-1]), levels[-1], sh, sh_error, kept, tuple(coverage[:n]),
                    tuple(coverage[n:]), time.perf_counter() - begin)


def prefilter(source: Any, *, size: int = 256, min_size: int = 16, ndf: str | Model = "ggx",
              tolerance: float | None = None, quality: str | None = None, rotate: float = 0.0, exposure: float = 0.0,
              nonfinite: str = "refuse", latlong: bool = False, device: Device | str | None = None) -> Prefiltered:
    """The specular chain of an environment (a path, an array or an `environment`).

    size, min_size: powers of two, texels a face edge of the first and last level. ndf: an isotropic NDF.
    tolerance: bound on `error` of every level, default 1e-3; or quality draft, normal, reference. rotate:
    degrees about +Y; exposure: stops; nonfinite: "refuse" or "zero". latlong: levels as lat-long images of
    2·size rows. Raises the errors of `environment`, UsageError, UnsupportedError, CheckError, DeviceError.
    """
    begin = time.perf_counter()
    recipe = chain(ndf=ndf, size=size, min_size=min_size, tolerance=tolerance, quality=quality)
    env = environment(source, rotate=rotate, exposure=exposure, nonfinite=nonfinite)  # type: ignore[arg-type]
    convolver = Convolver(_device(device), env, precision=planning.precision_for(recipe.tolerance))
    levels = run_jobs(convolver, chain_jobs(convolver, recipe, latlong=latlong), recipe.tolerance)
    return Prefiltered(tuple(levels), time.perf_counter() - begin)


def irradiance(source: Any, *, size: int = IRRADIANCE_SIZE, tolerance: float | None = None, rotate: float = 0.0,
               exposure: float = 0.0, nonfinite: str = "refuse", device: Device | str | None = None) -> Certified:
    """E/π as a cube (6, size, size, 3) float32: a constant environment of 1 gives 1. Raises as `prefilter`."""
    if not 1 <= size <= 1024:
        raise UsageError(f"irradiance size {size} is outside [1, 1024]")
    begin = time.perf_counter()
    bound = tolerance_of(tolerance, None)
    env = environment(source, rotate=rotate, exposure=exposure, nonfinite=nonfinite)  # type: ignore[arg-type]
    convolver = Convolver(_device(device), env, precision=planning.precision_for(bound))
    level = run_jobs(convolver, [irradiance_job(convolver, size, bound)], bound)[0]
    return Certified(level.texels, level.error, level.pairs, time.perf_counter() - begin, level.method,
                     worst=level.worst, rmse=level.rmse)


def harmonics(source: Any, *, rotate: float = 0.0, exposure: float = 0.0, nonfinite: str = "refuse",
              device: Device | str | None = None) -> Certified:
    """Radiance coefficients (9, 3) float64 to degree 2: real orthonormal basis in world x, y, z without the
    Condon-Shortley sign, in the order L00, L1-1, L10, L11, L2-2, L2-1, L20, L21, L22. Raises as `prefilter`."""
    begin = time.perf_counter()
    env = environment(source, rotate=rotate, exposure=exposure, nonfinite=nonfinite)  # type: ignore[arg-type]
    convolver = Convolver(_device(device), env)
    values, error = convolver.harmonics()
    return Certified(values, error, convolver.faces * convolver.rows * convolver.columns,
                     time.perf_counter() - begin, "texel-nodes", worst=error, rmse=error)


def _device(device: Device | str | None) -> Device:
    return device if isinstance(device, Device) else choose_device(device)


__all__ = ["Certified", "Lighting", "Prefiltered", "harmonics", "irradiance", "light", "prefilter"]
