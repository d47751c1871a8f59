"""Makes levels, certifies them against exact integrals, and refines those that miss the tolerance."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from whitefurnace.errors import CheckError, DeviceError
from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.certificate import statement
from whitefurnace.prefiltering.convolution import EXACT_SHARE, ROUNDING, Convolver, Level
from whitefurnace.prefiltering.importance import Sampler
from whitefurnace.prefiltering.independent import wrong_result
from whitefurnace.prefiltering.jobs import Job
from whitefurnace.prefiltering.recipe import CERTIFIED
from whitefurnace.prefiltering.references import Reference, references_of
from whitefurnace.sphere.grids import POINTS


class Clock:
    """Wall time in seconds by activity: "source", "levels" and "certificate"."""

    def __init__(self) -> None:
        self.seconds = {"source": 0.0, "levels": 0.0, "certificate": 0.0}

    @contextlib.contextmanager
    def __call__(self, activity: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.seconds[activity] += time.perf_counter() - begin


@dataclass(frozen=True)
class _Task:
    """A job with everything that is needed to make its level.

    reference  exact values of its certificate; None where nothing is certified
    share      progress before and after the level, in [0, 1]
    sampler    for a level by importance sampling
    """

    job: Job
    reference: Reference | None
    share: tuple[float, float]
    sampler: Sampler | None


def run_jobs(
    convolver: Convolver, jobs: Sequence[Job], tolerance: float, *, certify: int = CERTIFIED, clock: Clock | None = None
) -> list[Level]:
    """Make every level, certify it, and refine it where needed; return the levels in the order of `jobs`.

    The exact values are computed first, because they determine the cuts that the grids need.

    tolerance: bound on `error` of every level. certify: number of uniform texels of each certificate; 0 for none, then
    `error`, `worst` and `rmse` are NaN and nothing is refined. clock: gets the time spent.

    Raises CheckError when a level misses the tolerance and finer grids do not help, or DeviceError if that is because
    the device computes wrongly. A level by importance sampling
    keeps the number of samples that was asked for, and states its error.
    """
    clock = clock or Clock()
    begin = time.perf_counter()
    with clock("certificate"):
        references = references_of(convolver, jobs, tolerance, certify) if certify else []
    planned = [one.job for one in references] or list(jobs)
    with clock("source"):
        sampler = (
            Sampler(convolver.overlaps, convolver.precision, convolver.progress)
            if any(job.plan.samples for job in planned)
            else None
        )
        if any(job.plan.grid for job in planned):
            convolver.prepare(
                max(job.plan.grid for job in planned), max(job.plan.cuts for job in planned if job.plan.grid)
            )
            convolver.device.finish()
    common = (time.perf_counter() - begin) / len(planned)
    levels, done, whole = [], 0, sum(map(_work, planned))
    for k, job in enumerate(planned):
        begin = time.perf_counter()
        share = (_progress(done / whole), _progress((done + _work(job)) / whole))
        done += _work(job)
        task = _Task(job, references[k] if references else None, share, sampler)
        levels.append(_finished(convolver, task, tolerance, clock))
        levels[-1] = replace(levels[-1], seconds=time.perf_counter() - begin + common)
    return levels


def _work(job: Job) -> int:
    """Lobe evaluations that a level takes, or its texels where it is made without a lobe."""
    if job.lobe and job.plan.grid:
        return planning.pairs_of(job.shape.count, job.plan.grid, job.lobe.alpha, job.lobe.horizon)
    return job.shape.count * (job.plan.samples or 1)


def _progress(share: float) -> float:
    """Return the progress of the whole when a share of the levels' work is done."""
    return EXACT_SHARE + (1 - EXACT_SHARE) * share


def _finished(convolver: Convolver, task: _Task, tolerance: float, clock: Clock) -> Level:
    """The level of a task, refined until its error is within the tolerance. Raises CheckError where it cannot be."""
    job, before, stuck = task.job, math.inf, 0
    while True:
        with clock("levels"):
            texels = _texels(convolver, job, tolerance, task)
        if task.reference is None:
            return _level(convolver, job, texels, (math.nan, math.nan, math.nan))
        with clock("certificate"):
            level = _certified(convolver, job, texels, task.reference)
        # The mean over an octahedral texel has a fixed number of points.
        if level.error <= tolerance or job.plan.samples or (job.shape.octahedral and job.lobe is None):
            return level
        missed = level.error / tolerance  # may be NaN
        finer = planning.refined(job.plan, missed, job.lobe.horizon) if job.lobe else None
        stuck = stuck + 1 if not level.error <= 0.9 * before else 0
        if finer is None or stuck == 2:
            name = (
                "mean"
                if job.lobe is None
                else " of ".join([job.lobe.name, *(entry.name for entry, *_ in job.lobe.summands[:1])])
            )
            wrong = wrong_result(convolver, job, texels, task.reference, tolerance)
            if wrong:
                device = convolver.device
                raise DeviceError(
                    f"{device.name} ({device.platform}, driver {device.driver}) computes wrongly: {wrong}, in level "
                    f"{name}; try another driver or --device"
                )
            raise CheckError(
                f"level {name} of {'×'.join(map(str, job.shape.dims))} texels has an error of "
                f"{level.error:.2g}, over the tolerance {tolerance:g}, and finer grids do not help"
            )
        job, before = replace(job, plan=finer), level.error


def _texels(convolver: Convolver, job: Job, tolerance: float, task: _Task) -> np.ndarray:
    """The texels of a level by the method of its plan."""
    if job.lobe is None:
        return convolver.means(job.shape)
    if job.shape.octahedral:  # has no orbits of the cube's group
        values = convolver.on_grid(job.lobe, job.shape.directions(), job.plan.grid, tolerance)
        return values.astype(np.float32).reshape(*job.shape.dims, 3)
    if task.sampler and job.plan.samples:
        return task.sampler.level(job.lobe, job.shape, job.plan.samples, task.share)
    return convolver.convolve(job.lobe, job.shape, job.plan.grid, tolerance, task.share)


def _certified(convolver: Convolver, job: Job, texels: np.ndarray, reference: Reference) -> Level:
    """The level with the errors of its texels against the reference."""
    index, mean = reference.index, job.shape.mean(texels)
    error, worst, rmse = statement(
        texels.reshape(-1, 3)[index],
        reference.values,
        reference.sample,
        job.shape.solid_angles(index),
        mean,
        job.shape.count,
    )
    # A mean over texels is computed and checked in float64 and rounded once; other levels have a larger rounding error.
    rounding = 0.0 if mean == 0 else ROUNDING[64 if job.lobe is None else convolver.precision]
    if mean > 0 and not convolver.constant:
        rounding += reference.doubt
    return _level(convolver, job, texels, (error + rounding, worst + rounding, rmse))


def _level(convolver: Convolver, job: Job, texels: np.ndarray, stated: tuple[float, float, float]) -> Level:
    """The level with its stated error, worst and rmse, in the image's own scale."""
    method, pairs = f"points-{POINTS[0][0]}" if job.shape.octahedral else "texel-mean", 0
    if job.plan.samples:
        method, pairs = f"samples-{job.plan.samples}", job.shape.count * job.plan.samples
    elif job.lobe:
        method = f"anterpolated-{job.plan.grid}"
        pairs = planning.pairs_of(job.shape.count, job.plan.grid, job.lobe.alpha, job.lobe.horizon)
    # The scale is a power of two, so this is exact.
    scaled = texels if convolver.scale == 1 else texels * np.float32(1 / convolver.scale)
    return Level(scaled, job.plan.roughness, *stated, method, job.plan.grid, pairs, seconds=0.0)
