"""What an environment gives a renderer: the specular chain, irradiance and spherical harmonics, each certified
against the exact integral and refined where it misses the tolerance."""
from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from whitefurnace.catalogue import Model
from whitefurnace.errors import CheckError, UsageError
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.certificate import statement, texel_errors
from whitefurnace.prefiltering.convolution import EXACT_SHARE, ROUNDING, Convolver, Level, Progress
from whitefurnace.prefiltering.importance import Sampler
from whitefurnace.prefiltering.level_fit import read_mixtures
from whitefurnace.prefiltering.lobes import COSINE, Lobe, mixture_lobe, ndf_lobe
from whitefurnace.prefiltering.plan import LevelPlan
from whitefurnace.prefiltering.recipe import CERTIFIED, IRRADIANCE_SIZE, Chain, chain, samples_of, tolerance_of
from whitefurnace.results import Integrated
from whitefurnace.sphere.environments import Environment, environment
from whitefurnace.sphere.grids import POINTS, Shape, source_solid_angles


@dataclass(frozen=True)
class Prefiltered:
    """A specular chain. `values` is a tuple of float32 arrays, (6, s, s, 3) a level in the GL-direct layout, or
    (s, 2 s, 3) as lat-longs; `roughness`, `error`, `worst`, `rmse` are (n,) float64; `evaluations` counts lobe
    evaluations of the convolution; `seconds` is wall time, `timings` what of it went into the "source" (bright texels,
    grids), the "levels" and the "certificate"; `rule` names the method of each level."""

    levels: tuple[Level, ...]
    seconds: float
    timings: dict[str, float]

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


def chain_jobs(convolver: Convolver, recipe: Chain, *, latlong: bool = False, octahedral: bool = False) -> list[Job]:
    """The jobs of a specular chain, as cubes, as lat-longs of twice a face's height, or as octahedral maps."""
    jobs = []
    planned = planning.plan_chain(recipe, convolver.texel, convolver.share, convolver.texels.centred)
    mixtures = read_mixtures(convolver.device, recipe) if recipe.fit else [None] * len(planned)
    for level, mixture in zip(planned, mixtures, strict=True):
        lobe = None
        if mixture:
            lobe = mixture_lobe(convolver.device, recipe.ndf, mixture, recipe.parameters)
        elif level.roughness > 0:
            lobe = ndf_lobe(convolver.device, recipe.ndf, level.roughness, level.parameters)
        if lobe and (mixture or lobe.horizon > lobe.alpha):  # other than GGX's own
            grid = planning.grid_size(lobe.alpha, recipe.tolerance, max(lobe.horizon, lobe.alpha))
            level = replace(level, grid=level.grid and max(level.grid, grid), cuts=max(level.cuts, planning.cuts_for(
                convolver.texel, lobe.alpha, recipe.tolerance, convolver.share, convolver.texels.centred)))
        jobs.append(Job(level, lobe, Shape(latlong, 2 * level.size if latlong else level.size, octahedral=octahedral)))
    return jobs


def irradiance_job(convolver: Convolver, size: int, tolerance: float, samples: int | None = None) -> Job:
    """The job of the irradiance cube."""
    cuts = planning.cuts_for(convolver.texel, 1.0, tolerance, convolver.share, convolver.texels.centred)
    grid = 0 if samples else planning.grid_size(1.0, tolerance)
    return Job(LevelPlan(size, 1.0, {}, grid, cuts, samples or 0), COSINE, Shape(False, size))


class Clock:
    """Wall seconds by what they were spent on: "source", "levels", "certificate"."""

    def __init__(self) -> None:
        self.seconds = {"source": 0.0, "levels": 0.0, "certificate": 0.0}

    @contextlib.contextmanager
    def __call__(self, what: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.seconds[what] += time.perf_counter() - begin


def run_jobs(convolver: Convolver, jobs: Sequence[Job], tolerance: float, *, certify: int = CERTIFIED,
             clock: Clock | None = None) -> list[Level]:
    """Makes, certifies and where needed refines every level, in the order of `jobs`.

    The exact values come first: how finely texels must be cut for them is how finely the grids need them too.
    certify: uniform texels of each certificate, 0 for none: then nothing is stated (NaN) and nothing refined.
    Raises CheckError when a level misses the tolerance and finer grids do not help; samples are as many as were asked
    for, and their levels state what they leave.
    """
    clock = clock or Clock()
    begin = time.perf_counter()
    with clock("certificate"):
        samples = [convolver.sample(job.shape, certify) for job in jobs] if certify else []
        jobs, references, doubts = (_references(convolver, jobs, samples, tolerance) if certify else
                                    (jobs, [np.empty(0)] * len(jobs), [0.0] * len(jobs)))
    with clock("source"):
        sampler = _sampler(convolver) if any(job.plan.samples for job in jobs) else None
        if any(job.plan.grid for job in jobs):
            convolver.prepare(max(job.plan.grid for job in jobs), max(job.plan.cuts for job in jobs if job.plan.grid))
            convolver.device.finish()
    common = (time.perf_counter() - begin) / len(jobs)
    work = [job.shape.count * (job.plan.samples or 1) if not (job.lobe and job.plan.grid) else
            planning.pairs_of(job.shape.count, job.plan.grid, job.lobe.alpha, job.lobe.horizon) for job in jobs]
    levels = []
    for k, job in enumerate(jobs):
        begin = time.perf_counter()
        share = tuple(EXACT_SHARE + (1 - EXACT_SHARE) * sum(work[:m]) / sum(work) for m in (k, k + 1))
        before, stuck = math.inf, 0
        while True:
            with clock("levels"):
                texels = _make(convolver, job, tolerance, share, sampler)
            if not certify:
                level = _level(convolver, job, texels, (math.nan, math.nan, math.nan))
                break
            with clock("certificate"):
                level = _stated(convolver, job, texels, samples[k], references[k], doubts[k])
            # Points of an octahedral texel are as many as they are.
            if level.error <= tolerance or job.plan.samples or (job.shape.octahedral and job.lobe is None):
                break
            missed = level.error / tolerance  # NaN too
            finer = planning.refined(job.plan, missed, job.lobe.horizon) if job.lobe else None
            stuck = stuck + 1 if not level.error <= 0.9 * before else 0
            if finer is None or stuck == 2:
                what = "mean" if job.lobe is None else " of ".join([job.lobe.name, *(
                    entry.name for entry, *_ in job.lobe.summands[:1])])
                raise CheckError(f"level {what} of {'×'.join(map(str, job.shape.dims))} texels has an error of "
                                 f"{level.error:.2g}, over the tolerance {tolerance:g}, and finer grids do not help")
            job, before = replace(job, plan=finer), level.error
        levels.append(replace(level, seconds=time.perf_counter() - begin + common))
    return levels


def _sampler(convolver: Convolver) -> Sampler:
    return Sampler(convolver.overlaps, convolver.precision, convolver.progress)


def _make(convolver: Convolver, job: Job, tolerance: float, share: tuple[float, ...],
          sampler: Sampler | None = None) -> np.ndarray:
    if job.lobe is None:
        return convolver.means(job.shape)
    if job.shape.octahedral:  # has no orbits of the cube's group
        values = convolver.on_grid(job.lobe, job.shape.directions(), job.plan.grid, tolerance)
        return values.astype(np.float32).reshape(*job.shape.dims, 3)
    if sampler and job.plan.samples:
        return sampler.level(job.lobe, job.shape, job.plan.samples, share)
    return convolver.convolve(job.lobe, job.shape, job.plan.grid, tolerance, share)


PROBES = 16
"""Texels on which a reference is checked against itself with twice the nodes: the darkest, where a bright panel
at the horizon shows most."""

COARSE = {"sharp": 2.0, "rough": 2.2}
"""How much finer than its own a grid is that may stand for all texels in a level's reference: 2^6.5 = 90 times less
error where the lobe's width decides, 2.2² = 5 times where its kink does."""

COARSE_GRID = 512
"""Nodes an edge at most of such a grid: of sharper lobes texels are summed, near their direction if need be."""


def _references(convolver: Convolver, jobs: Sequence[Job], samples: Sequence[tuple[np.ndarray, np.ndarray]],
                tolerance: float) -> tuple[list[Job], list[np.ndarray], list[float]]:
    """Jobs with the cuts their texels need, the exact values of each one's sample (m, 3), and what these may still
    be off by.

    A lobe is integrated over every texel, or over a much finer grid than its level where that has half as many nodes.
    The grid is checked on the PROBES darkest texels against every texel, cut twice as finely where the lobe has a kink
    that they would not show; the change there is the doubt. While it is more than a tenth of the tolerance, texels take
    the grid's place, and then twice the nodes. Lobes with the same cuts share one pass over the source.
    """
    jobs = list(jobs)
    index = [np.concatenate(sample) for sample in samples]
    cut = [job.plan.cuts for job in jobs]  # nodes a texel edge of each reference
    references: list[np.ndarray] = [np.empty(0)] * len(jobs)
    doubts = [0.0] * len(jobs)
    grids = [0] * len(jobs)
    for k, job in enumerate(jobs):
        if job.lobe is None:
            references[k] = convolver.exact_means(job.shape, index[k])
        elif job.plan.grid:
            n = planning.nodes_for(COARSE["rough" if _kinked(job) else "sharp"] * job.plan.grid)
            grids[k] = n if n <= COARSE_GRID and 2 * 6 * n * n <= convolver.texels.nodes(job.plan.cuts) else 0
    if any(grids):
        convolver.prepare(max(*grids, *(job.plan.grid for job in jobs)), max(job.plan.cuts for job in jobs if job.lobe))
    todo = [k for k, job in enumerate(jobs) if job.lobe]
    while todo:
        for k in todo:
            if grids[k]:
                directions = jobs[k].shape.directions(index[k])
                references[k] = convolver.on_grid(_lobe(jobs[k]), directions, grids[k], tolerance)
        for cuts in sorted({cut[k] for k in todo if not grids[k]}):
            group = [k for k in todo if not grids[k] and cut[k] == cuts]
            for k, values in zip(group, _exact(convolver, jobs, group, index, cuts, tolerance), strict=True):
                references[k] = values
                doubts[k] = planning.cuts_error(convolver.texel, _lobe(jobs[k]).alpha, cuts,
                                                convolver.texels.centred)
        todo = [k for k in todo if (_kinked(jobs[k]) or grids[k]) and not convolver.constant]
        again = []
        seen = {k: _seen(convolver, jobs[k], cut[k], grids[k]) for k in todo}
        finest = {k: cut[k] * (1 if seen[k] else 2) for k in todo}
        for cuts in sorted(set(finest.values())):
            group = [k for k in todo if finest[k] == cuts]
            dark = {k: np.argsort(references[k].min(1), kind="stable")[:PROBES] for k in group}
            probes = {k: index[k][dark[k]] for k in group}
            finer = _exact(convolver, jobs, group, probes, cuts, tolerance)
            for k, values in zip(group, finer, strict=True):
                mean = convolver.mean * convolver.scale
                doubts[k] = float(texel_errors(references[k][dark[k]], values, mean).max()) / (seen[k] or 1.0)
                # On small images more nodes cost nothing: there the reference is made exact, not just good enough.
                cheap = convolver.texels.nodes(cuts) <= planning.NODES_A_BAND
                if doubts[k] <= tolerance / (100 if cheap else 10):
                    continue
                if grids[k]:
                    grids[k] = 0
                    again.append(k)
                elif cuts <= planning.MOST_CUTS:
                    cut[k] = cuts
                    again.append(k)
                    if doubts[k] > tolerance / 10:  # the level needs them too
                        jobs[k] = replace(jobs[k], plan=replace(jobs[k].plan, cuts=cuts))
        todo = again
    return jobs, references, doubts


def _seen(convolver: Convolver, job: Job, cuts: int, grid: int) -> float:
    """Of what a reference grid errs by, the part that texels show that are cut in `cuts`, 0 where that is too
    little. Where a lobe sets, nodes h apart err by h², texels as well as the grid."""
    if not _kinked(job):
        return 1.0
    ratio = convolver.texel / cuts / planning.spacing(grid) if grid else 1.0
    return 1 - ratio**2 if ratio**2 <= 0.55 else 0.0


def _kinked(job: Job) -> bool:
    return _lobe(job).horizon > planning.SHARP_ENOUGH


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
    return _level(convolver, job, texels, (error + rounding, worst + rounding, rmse))


def _level(convolver: Convolver, job: Job, texels: np.ndarray, stated: tuple[float, float, float]) -> Level:
    method, pairs = f"points-{POINTS[0][0]}" if job.shape.octahedral else "texel-mean", 0
    if job.plan.samples:
        method, pairs = f"samples-{job.plan.samples}", job.shape.count * job.plan.samples
    elif job.lobe:
        method = f"anterpolated-{job.plan.grid}"
        pairs = planning.pairs_of(job.shape.count, job.plan.grid, job.lobe.alpha, job.lobe.horizon)
    # Back to the image's own scale, a power of two: exact.
    scaled = texels if convolver.scale == 1 else texels * np.float32(1 / convolver.scale)
    return Level(scaled, job.plan.roughness, *stated, method, job.plan.grid, pairs, seconds=0.0)


@dataclass(frozen=True)
class Want:
    """A chain of a bake: how many of its first levels as cubes, lat-longs and octahedral maps; None: all."""

    recipe: Chain
    cubes: int | None = None
    latlongs: int | None = 0
    octahedral: int | None = 0


@dataclass(frozen=True)
class Filtered:
    """The levels of a chain that were wanted, and what of the energy each cube keeps, relative to the source."""

    levels: tuple[Level, ...]
    latlongs: tuple[Level, ...]
    energy_kept: tuple[float, ...]
    coverage: tuple[Level, ...]
    latlong_coverage: tuple[Level, ...]
    octahedral: tuple[Level, ...] = ()
    octahedral_coverage: tuple[Level, ...] = ()


@dataclass(frozen=True)
class Lighting:
    """Everything of one environment: its chains, in the order they were wanted, irradiance, SH."""

    chains: tuple[Filtered, ...]
    irradiance: Level
    sh: np.ndarray
    sh_error: float
    seconds: float


def light(device: Device, env: Environment, wants: Sequence[Want], *, seed: str = "",
          progress: Progress | None = None) -> Lighting:
    """The whole of an environment under several chains, sharing grids, certificates and equal levels; irradiance is
    held to the tolerance of the first. Raises CheckError where a level cannot reach its tolerance, DeviceError where
    the device fails."""
    begin = time.perf_counter()
    recipe = wants[0].recipe
    convolver = Convolver(device, env, precision=planning.precision_for(recipe.tolerance), seed=seed,
                          progress=progress)
    jobs, places, tolerances = _distinct(convolver, wants)
    everything = [*jobs, irradiance_job(convolver, IRRADIANCE_SIZE, recipe.tolerance, recipe.samples)]
    levels = _run(convolver, everything, [*tolerances, recipe.tolerance], recipe.certify)
    sh, sh_error = convolver.harmonics()
    kept = [job.shape.mean(level.texels) / convolver.mean - 1 if convolver.mean > 0 else 0.0
            for job, level in zip(jobs, levels[:-1], strict=True)]
    coverage: list[Level] = []
    if env.coverage is not None:
        # Coverage is light of one channel: the same chain, the same statement.
        grey = np.repeat(env.coverage[..., None], 3, -1)
        share = float(np.average(env.coverage, weights=source_solid_angles(env)))
        as_light = replace(env, texels=grey, coverage=None, statistics={"mean": [share] * 3})
        convolver = Convolver(device, as_light, precision=convolver.precision, seed=seed, progress=progress)
        jobs, _, tolerances = _distinct(convolver, wants)
        coverage = _run(convolver, jobs, tolerances, recipe.certify)
    chains = []
    for cubes, wide, square in places:
        covered = [tuple(coverage[k] for k in some) if coverage else () for some in (cubes, wide, square)]
        chains.append(Filtered(tuple(levels[k] for k in cubes), tuple(levels[k] for k in wide),
                               tuple(kept[k] for k in cubes), covered[0], covered[1],
                               tuple(levels[k] for k in square), covered[2]))
    return Lighting(tuple(chains), levels[-1], sh, sh_error, time.perf_counter() - begin)


def _run(convolver: Convolver, jobs: Sequence[Job], tolerances: Sequence[float], certify: int) -> list[Level]:
    """`run_jobs`, together those of one tolerance."""
    made: dict[int, Level] = {}
    for tolerance in sorted(set(tolerances)):
        some = [k for k, one in enumerate(tolerances) if one == tolerance]
        made |= zip(some, run_jobs(convolver, [jobs[k] for k in some], tolerance, certify=certify), strict=True)
    return [made[k] for k in range(len(jobs))]


def _distinct(convolver: Convolver, wants: Sequence[Want]
              ) -> tuple[list[Job], list[tuple[list[int], ...]], list[float]]:
    """The jobs of all chains, each once; for each chain the places of its cubes, lat-longs and octahedral maps; and the
    tolerance of each job, the least of the chains it is for."""
    jobs: list[Job] = []
    tolerances: list[float] = []
    known: dict[Any, int] = {}
    places: list[tuple[list[int], ...]] = [() for _ in wants]
    for w in sorted(range(len(wants)), key=lambda w: wants[w].recipe.tolerance):
        want = wants[w]
        placed: tuple[list[int], ...] = ([], [], [])
        for kind, count in enumerate((want.cubes, want.latlongs, want.octahedral)):
            if count == 0:
                continue
            for job in chain_jobs(convolver, want.recipe, latlong=kind == 1, octahedral=kind == 2)[:count]:
                lobe = job.lobe and tuple((entry.name, entry.text, *rest) for entry, *rest in job.lobe.summands)
                key = (lobe, job.shape, job.plan.samples)
                if key not in known:
                    known[key] = len(jobs)
                    jobs.append(job)
                    tolerances.append(want.recipe.tolerance)
                placed[kind].append(known[key])
        places[w] = placed
    return jobs, places, tolerances


def prefilter(source: Any, *, size: int = 256, min_size: int | None = None, ndf: str | Model = "ggx",
              tolerance: float | None = None, quality: str | None = None, samples: int | None = None,
              levels: int | None = None, fit: str | None = None, certify: int = CERTIFIED, rotate: float = 0.0,
              exposure: float = 0.0, nonfinite: str = "refuse", latlong: bool = False,
              device: Device | str | None = None) -> Prefiltered:
    """The specular chain of an environment (a path, an array or an `environment`).

    size, min_size: powers of two, texels a face edge of the first and last level. ndf: an isotropic NDF.
    tolerance: bound on `error` of every level, default 1e-3; or quality draft, normal, reference; or samples, 1 to
    65536 a texel of filtered importance sampling, whatever `error` that leaves. levels: how many; fit: "read" for
    levels that read best between them. certify: uniform texels of each level's certificate, 299 or more; 0 for none,
    then `error`, `worst` and `rmse` are NaN and nothing is refined. rotate: degrees about +Y; exposure: stops;
    nonfinite: "refuse" or "zero". latlong: levels as lat-long images of 2·size rows. Raises the errors of
    `environment`, UsageError, UnsupportedError, CheckError, DeviceError.
    """
    begin = time.perf_counter()
    recipe = chain(ndf=ndf, size=size, min_size=min_size, tolerance=tolerance, quality=quality, samples=samples,
                   levels=levels, fit=fit, certify=certify)
    env = environment(source, rotate=rotate, exposure=exposure, nonfinite=nonfinite)  # type: ignore[arg-type]
    clock = Clock()
    with clock("source"):
        convolver = Convolver(_device(device), env, precision=planning.precision_for(recipe.tolerance))
    made = run_jobs(convolver, chain_jobs(convolver, recipe, latlong=latlong), recipe.tolerance, certify=recipe.certify,
                    clock=clock)
    return Prefiltered(tuple(made), time.perf_counter() - begin, clock.seconds)


def irradiance(source: Any, *, size: int = IRRADIANCE_SIZE, tolerance: float | None = None,
               samples: int | None = None, rotate: float = 0.0, exposure: float = 0.0, nonfinite: str = "refuse",
               device: Device | str | None = None) -> Certified:
    """E/π as a cube (6, size, size, 3) float32: a constant environment of 1 gives 1. Raises as `prefilter`."""
    if not 1 <= size <= 1024:
        raise UsageError(f"irradiance size {size} is outside [1, 1024]")
    begin = time.perf_counter()
    count = samples_of(samples, tolerance)
    bound = tolerance_of(tolerance, None)
    env = environment(source, rotate=rotate, exposure=exposure, nonfinite=nonfinite)  # type: ignore[arg-type]
    convolver = Convolver(_device(device), env, precision=planning.precision_for(bound))
    level = run_jobs(convolver, [irradiance_job(convolver, size, bound, count)], bound)[0]
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
    return Certified(values, error, env.texels.size // 3,
                     time.perf_counter() - begin, "texel-nodes", worst=error, rmse=error)


def _device(device: Device | str | None) -> Device:
    return device if isinstance(device, Device) else choose_device(device)


__all__ = ["Certified", "Filtered", "Lighting", "Prefiltered", "Want", "harmonics", "irradiance", "light", "prefilter"]
