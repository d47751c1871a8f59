"""Measures the error of the prefilter against its time, for every method and quality on an environment.

It marks the Pareto front, and measures how the time depends on the output size, the source size and α.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from whitefurnace.benching.throughput import Spread
from whitefurnace.errors import CheckError
from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering import lighting
from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.convolution import Convolver
from whitefurnace.prefiltering.jobs import chain_jobs
from whitefurnace.prefiltering.means import Means
from whitefurnace.prefiltering.recipe import CERTIFIED, QUALITIES, Chain, chain
from whitefurnace.sphere.environments import Environment, environment
from whitefurnace.sphere.grids import Shape

TOLERANCES = (1e-2, 3e-3, 1e-3, 1e-4, 2e-5)
SAMPLES = (32, 128, 512, 2048, 16384)
RUNS = 5
BUDGET = 3.0
"""Seconds of one point. No further run starts after this time. If the first run alone takes longer, it is the only one;
cheaper points have built its kernels by then."""

COST_TOLERANCE = QUALITIES["normal"]
SIZES = (64, 128, 256, 512)
ROWS = (256, 512, 1024, 2048)
ALPHAS = (1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 1.0)
LEVEL = 64
"""Face edge of the one level whose cost is measured over α."""


@dataclass(frozen=True)
class Point:
    """A chain that was made by one method at one setting.

    method              "tolerance" or "samples"; `setting` is its value
    seconds             seconds from texels in memory to finished levels, without the certificate
    certificate         seconds of the certificate
    error, worst, rmse  stated errors of the worst level
    evaluations         number of lobe evaluations
    rules               method of each level
    runs                number of runs that were timed
    front               True if no other point is both faster and more accurate
    """

    environment: str
    method: str  # "tolerance" or "samples"
    setting: float
    seconds: Spread
    certificate: float
    error: float
    worst: float
    rmse: float
    evaluations: int
    rules: tuple[str, ...]
    runs: int
    front: bool = False

    @property
    def label(self) -> str:
        """The setting as users give it, with the quality of the same tolerance."""
        if self.method == "samples":
            return f"{self.setting:.0f}"
        quality = {tolerance: name for name, tolerance in QUALITIES.items()}.get(self.setting)
        return f"{self.setting:g}" + (f" {quality}" if quality else "")


@dataclass(frozen=True)
class Missed:
    """A point or a cost that could not be measured, with the reason. For a cost, `method` is the quantity that
    varies.
    """

    environment: str
    method: str
    setting: float
    why: str


@dataclass(frozen=True)
class Cost:
    """Seconds at COST_TOLERANCE for one value of a quantity that varies.

    over   "output size" (face edge of level 0), "source rows" (of a lat-long) or "alpha" (one level of LEVEL² texels)
    value  value of that quantity
    """

    environment: str
    over: str
    value: float
    seconds: Spread
    runs: int


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the Pareto front of (cost, error) pairs, cheapest first.

    A point is on the front if no other is better in one of the two without being worse in the other. Of equal points
    the first counts; NaN is on no front.
    """
    best, found = math.inf, []
    for k in sorted(range(len(points)), key=lambda k: points[k]):
        cost, error = points[k]
        if math.isfinite(cost) and error < best:
            best = error
            found.append(k)
    return found


def load(source: str, device: Device) -> Environment:
    """Read an environment into memory, from a path or the word `demo`. Raises the errors of `environment`."""
    return environment(source, device=device)


def check(size: int, min_size: int) -> None:
    """Check the sizes of a chain in texels, which must be powers of two. Raises UsageError."""
    chain(size=size, min_size=min_size)


def _repeated(measure: Callable[[], Any], runs: int, budget: float) -> list[Any]:
    """Return the results of `measure` in repeated runs, without the first."""
    begin = time.perf_counter()
    found = [measure()]
    if time.perf_counter() - begin > budget:
        return found
    found.clear()
    begin = time.perf_counter()
    while len(found) < runs and (not found or time.perf_counter() - begin < budget):
        found.append(measure())
    return found


def _prefilter(
    env: Environment,
    device: Device,
    size: int,
    min_size: int,
    *,
    tolerance: float | None = None,
    samples: int | None = None,
    certify: int = CERTIFIED,
) -> tuple[lighting.Prefiltered, float, float]:
    """Return (chain, seconds from texels to levels, seconds of the certificate)."""
    made = lighting.prefilter(
        env, size=size, min_size=min_size, tolerance=tolerance, samples=samples, certify=certify, device=device
    )
    return made, made.timings["source"] + made.timings["levels"], made.timings["certificate"]


def methods() -> list[tuple[str, float]]:
    """Return the (method, setting) of every point: each of TOLERANCES and of SAMPLES."""
    return [*(("tolerance", x) for x in TOLERANCES), *(("samples", n) for n in SAMPLES)]


def points(
    env: Environment,
    device: Device,
    *,
    size: int = 256,
    min_size: int = 16,
    runs: int = RUNS,
    budget: float = BUDGET,
    todo: Sequence[tuple[str, float]] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Iterator[Point | Missed]:
    """Measure every method and setting on one environment; those that cannot be made are `Missed`.

    size, min_size: face edges of the first and last level in texels. runs: largest number of runs of a point. budget:
    seconds after which a point gets no further run. todo: (method, setting) pairs, by default `methods()`. progress:
    called with a setting and the share of the work done.
    """
    todo = methods() if todo is None else todo
    for k, (method, setting) in enumerate(todo):
        if progress:
            progress(f"{method} {setting:g}", k / len(todo))
        sampled = method == "samples"
        chosen = partial(
            _prefilter,
            env,
            device,
            size,
            min_size,
            tolerance=None if sampled else setting,
            samples=int(setting) if sampled else None,
        )
        try:
            found = _repeated(chosen, runs, budget)
        except CheckError as error:
            yield Missed(env.name, method, setting, str(error))
            continue
        made = found[0][0]
        yield Point(
            env.name,
            method,
            setting,
            Spread.of([seconds for _, seconds, _ in found]),
            Spread.of([certificate for _, _, certificate in found]).median,
            float(made.error.max()),
            float(made.worst.max()),
            float(made.rmse.max()),
            made.evaluations,
            made.rule,
            len(found),
        )


def with_front(measured: Sequence[Point]) -> list[Point]:
    """Return the points of one environment with `front` set for those on the Pareto front."""
    best = set(front([(p.seconds.median, p.error) for p in measured]))
    return [replace(p, front=k in best) for k, p in enumerate(measured)]


@dataclass(frozen=True)
class _One(Chain):
    """A chain of one level, at any roughness."""

    roughness: float = 1.0

    @property
    def levels(self) -> tuple[tuple[int, float], ...]:
        return ((self.size, self.roughness),)


def _level(env: Environment, device: Device, size: int, alpha: float, tolerance: float = COST_TOLERANCE) -> float:
    """Measure the seconds of one level alone, from texels in memory, without its certificate."""
    recipe = _One(chain(size=size, min_size=size).ndf, size, size, tolerance, roughness=math.sqrt(alpha))
    begin = time.perf_counter()
    convolver = Convolver(device, env, precision=planning.precision_for(tolerance))
    (job,) = chain_jobs(convolver, recipe)
    assert job.lobe is not None
    convolver.convolve(job.lobe, job.shape, job.plan.grid, tolerance)
    return time.perf_counter() - begin


def resampled(env: Environment, device: Device, rows: int) -> Environment:
    """Return the same light as a lat-long of `rows` rows, where each texel is the exact mean over its solid angle."""
    return replace(environment(Means(device, env.texels, env.rotation).level(Shape(True, rows))), name=env.name)


def costs(
    env: Environment,
    device: Device,
    *,
    size: int = 256,
    min_size: int = 16,
    runs: int = RUNS,
    budget: float = BUDGET,
    sizes: Sequence[int] = SIZES,
    rows: Sequence[int] = ROWS,
    alphas: Sequence[float] = ALPHAS,
    progress: Callable[[str, float], None] | None = None,
) -> Iterator[Cost | Missed]:
    """Measure the seconds of a chain over output sizes and source rows, and of a level over α, at COST_TOLERANCE.

    sizes: face edges in texels. rows: rows of a lat-long source. alphas: α of the level. The other parameters are those
    of `points`.
    """

    def whole(some: Environment, size: int) -> float:
        return _prefilter(some, device, size, min(min_size, size), tolerance=COST_TOLERANCE, certify=0)[1]

    def measures() -> Iterator[tuple[str, float, Callable[[], float]]]:
        for n in sizes:
            yield "output size", n, partial(whole, env, n)
        for height in rows:
            some = resampled(env, device, height)
            yield "source rows", height, partial(whole, some, size)
        for alpha in alphas:
            yield "alpha", alpha, partial(_level, env, device, min(LEVEL, size), alpha)

    count = len(sizes) + len(rows) + len(alphas)
    for k, (over, value, measure) in enumerate(measures()):
        if progress:
            progress(f"cost, {over} {value:g}", k / count)
        try:
            seconds = _repeated(measure, runs, budget)
        except CheckError as error:
            yield Missed(env.name, over, value, str(error))
            continue
        yield Cost(env.name, over, value, Spread.of(seconds), len(seconds))
