"""Certificates: their order statistic against the binomial distribution, and how often what they state holds, against
the errors of all texels."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom
from test_statement import matrix, synthetic, texel_at

from whitefurnace import prefilter
from whitefurnace.catalogue.choice import chosen
from whitefurnace.errors import UsageError
from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering.certificate import CONFIDENCE, QUANTILE, rank, statement, texel_errors
from whitefurnace.prefiltering.convolution import Convolver
from whitefurnace.prefiltering.jobs import Job
from whitefurnace.prefiltering.levels import run_jobs
from whitefurnace.prefiltering.lobes import ndf_lobe
from whitefurnace.prefiltering.plan import LevelPlan, cuts_for, grid_size
from whitefurnace.sphere.environments import environment
from whitefurnace.sphere.grids import Shape

# ------------------------------------------------------------------------------------------- the statistic


@pytest.mark.parametrize("n", [299, 300, 400, 472, 473, 474, 627, 628, 1000, 2048, 10_000, 1 << 17])
def test_rank_is_the_binomials(n: int) -> None:
    """k errors of n lie over the 99th percentile with binomial chance: the largest k that is still rare, and no
    larger."""
    k = rank(n)
    assert binom.cdf(k, n, 1 - QUANTILE) <= 1 - CONFIDENCE < binom.cdf(k + 1, n, 1 - QUANTILE)


def test_299_are_the_fewest() -> None:
    assert rank(299) == 0 and QUANTILE**299 <= 1 - CONFIDENCE < QUANTILE**298


@pytest.mark.parametrize("n", [299, 1000])
def test_rank_covers(n: int) -> None:
    """Of errors drawn from any continuous law the one of this rank is at least the true 99th percentile 95 times in
    100."""
    draws = np.sort(np.random.default_rng(n).random((20_000, n)), 1)[:, ::-1]
    kept = (draws[:, rank(n)] >= QUANTILE).mean()
    assert kept >= CONFIDENCE - 3 * math.sqrt(0.95 * 0.05 / 20_000)


def test_texel_errors() -> None:
    reference = np.array([[1.0, 2.0, 4.0], [0.0, 0.0, 0.0], [1e-6, 1.0, 1.0], [0.0, 0.0, 0.0]])
    values = np.array([[1.1, 2.0, 4.0], [0.0, 0.0, 0.0], [2e-6, 1.0, 1.0], [0.0, 1e-3, 0.0]])
    # 0/0 is 0; below a thousandth of the mean errors are those of a thousandth.
    np.testing.assert_allclose(texel_errors(values, reference, 2.0), [0.1, 0, 1e-6 / 2e-3, 0.5])
    np.testing.assert_array_equal(texel_errors(values[1:2], reference[1:2], 0.0), [0.0])


def test_a_statement_by_hand() -> None:
    """300 uniform texels with errors .001 … .300 and two near a sun: `error` is the largest of the uniform, `worst`
    that of all, `rmse` weighs each by its solid angle, those outside the near-source sample for all there are."""
    reference, error = np.ones((302, 3)), np.concatenate([np.arange(1, 301) / 1e3, [0.7, 0.5]])
    values, omega = reference + error[:, None], np.linspace(1, 2, 302)
    sample, total = (np.arange(300), np.array([5000, 5001])), 6002
    got = statement(values, reference, sample, omega, 1.0, total)
    weight = omega * np.where(np.arange(302) < 300, 6000 / 300, 1)
    assert got == pytest.approx((0.3, 0.7, math.sqrt((weight * error**2).sum() / weight.sum())), rel=1e-12)
    # Of a level that is sampled whole nothing is left to chance: the largest of all.
    every = (np.arange(302), np.arange(0))
    assert statement(values, reference, every, omega, 1.0, 302)[:2] == pytest.approx((0.7, 0.7))
    # Of 473 the second largest is enough.
    many = np.concatenate([np.arange(1, 472), [5000, 9000]]) / 1e4
    one = np.ones((473, 3))
    assert statement(one + many[:, None], one, (np.arange(473), np.arange(0)), np.ones(473), 1.0, 6000)[:2] == (
        pytest.approx(0.5),
        pytest.approx(0.9),
    )


# ------------------------------------------------------------------------------------------- how often it holds


def job_of(convolver: Convolver, alpha: float, shape: Shape, tolerance: float) -> Job:
    lobe = ndf_lobe(convolver.device, chosen("ndf", "ggx"), math.sqrt(alpha), {"alpha": alpha})
    cuts = cuts_for(convolver.texel, alpha, tolerance, convolver.share, convolver.texels.centred)
    plan = LevelPlan(shape.size, math.sqrt(alpha), {"alpha": alpha}, grid_size(alpha, tolerance), cuts)
    return Job(plan, lobe, shape)


def kept(
    device: Device,
    texels: np.ndarray,
    alpha: float,
    shape: Shape,
    tolerance: float,
    runs: int,
    truth: Callable[[Convolver, Job], np.ndarray],
) -> tuple[int, list[tuple[float, float]]]:
    """In how many of `runs` certificates, each of its own draw, `error` is at least the 99th percentile of the errors
    of all texels; and (stated, true) of each."""
    env = environment(texels)
    convolver = Convolver(device, env)
    job = job_of(convolver, alpha, shape, tolerance)
    want = truth(convolver, job)
    found = []
    for seed in range(runs):
        convolver.seed = str(seed)
        (level,) = run_jobs(convolver, [job], tolerance)
        values = level.texels.reshape(-1, 3).astype(np.float64)
        errors = texel_errors(values, want, shape.mean(level.texels))
        found.append((level.error, float(np.quantile(errors, QUANTILE, method="higher"))))
    return sum(stated >= true for stated, true in found), found


def enough(runs: int) -> float:
    """95 % less three standard deviations of what luck does to it."""
    return CONFIDENCE * runs - 3 * math.sqrt(CONFIDENCE * (1 - CONFIDENCE) * runs)


SUN = texel_at(1, 0.4, 0.3)


def sunlit() -> np.ndarray:
    texels = synthetic("noise", 3) + np.float32(0.05)
    texels.reshape(-1, 3)[SUN] = 1e5 * texels.mean()
    return texels


@functools.cache
def by_matrix(size: int, alpha: float) -> np.ndarray:
    return matrix(size, alpha, (SUN,))


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["sun", "panels"])
@pytest.mark.parametrize("alpha", [0.06, 0.4])
def test_what_is_stated_holds_95_times_in_100(device: Device, kind: str, alpha: float) -> None:
    """Against the float64 integrals of tests/test_statement.py over every texel."""
    texels = sunlit() if kind == "sun" else synthetic("panels", 1)

    def truth(_convolver: Convolver, job: Job) -> np.ndarray:
        return by_matrix(job.shape.size, alpha) @ texels.reshape(-1, 3).astype(np.float64)

    held, found = kept(device, texels, alpha, Shape(False, 16), 1e-3, 60, truth)
    assert held >= enough(60), (kind, alpha, held, found)


def picture(kind: str) -> np.ndarray:
    """512 × 256: a soft sky over a ground with either a sun of 1e5 × the mean or the panels of a studio."""
    rng = np.random.default_rng(21)
    v, u = np.meshgrid((np.arange(256) + 0.5) / 256, (np.arange(512) + 0.5) / 512, indexing="ij")
    waves = sum(np.cos(2 * math.pi * (k * u + rng.random()))[..., None] * rng.random(3) / k for k in range(1, 24))
    texels = (1.5 + np.tanh(20 * (0.5 - v))[..., None] + 0.2 * waves * np.sin(math.pi * v)[..., None]) * rng.uniform(
        0.8, 1.2, (256, 512, 3)
    )
    if kind == "sun":
        texels[70:72, 200:202] = 1e5 * texels.mean() / 4
    else:
        texels *= 0.02
        for row, column in ((60, 40), (90, 200), (100, 330), (30, 430)):
            texels[row : row + 40, column : column + 60] = 20 * rng.random(3)
    return texels.astype(np.float32)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["sun", "panels"])
@pytest.mark.parametrize("alpha, size", [(0.018, 128), (0.085, 64), (0.25, 64)])
def test_what_is_stated_holds_at_real_sizes(device: Device, kind: str, alpha: float, size: int) -> None:
    """Against the plain sum over every texel (itself held to float64 quadrature in tests/test_prefilter_kernels.py),
    twice as finely cut as the plan's."""

    def truth(convolver: Convolver, job: Job) -> np.ndarray:
        finer = replace(job.plan, cuts=2 * max(job.plan.cuts, 2))
        assert job.lobe
        parts = np.array_split(job.shape.directions(), max(job.shape.count // 8192, 1), 1)
        values = [convolver.exact([(job.lobe, part)], finer.cuts, 1e-4)[0] for part in parts]
        return np.concatenate(values) / convolver.scale  # levels are in the units of the image

    held, found = kept(device, picture(kind), alpha, Shape(False, size), 1e-3, 60, truth)
    assert held >= enough(60), (kind, alpha, held, found)


# ------------------------------------------------------------------------------------------- certify


def small() -> np.ndarray:
    return np.random.default_rng(1).random((16, 32, 3), np.float32)


@pytest.mark.parametrize("certify", [-1, 1, 298, 299.5, 1 << 21, True, "299", None, math.nan, math.inf])
def test_a_bad_certify_is_refused(device: Device, certify: object) -> None:
    with pytest.raises(UsageError, match=r"certify .*299"):
        prefilter(small(), size=8, min_size=8, certify=certify, device=device)  # type: ignore[arg-type]


def test_certify_0_states_nothing(device: Device) -> None:
    stated, bare = (prefilter(small(), size=32, min_size=8, certify=k, device=device) for k in (299, 0))
    assert np.isnan(bare.error).all() and np.isnan(bare.worst).all() and np.isnan(bare.rmse).all()
    assert np.isfinite(stated.error).all() and bare.timings["certificate"] <= 0.01 * bare.seconds + 1e-3
    for a, b in zip(stated.values, bare.values, strict=True):
        # The certificate may have asked for finer texels: both are within its tolerance.
        np.testing.assert_allclose(b, a, rtol=1e-3)


def test_more_texels_state_closer(device: Device) -> None:
    """2000 texels leave 12 of them over the bound: what is stated comes down towards the percentile and stays over
    it."""
    few, many = (prefilter(small(), size=32, min_size=32, levels=3, certify=k, device=device) for k in (299, 2000))
    for k in (1, 2):
        assert many.error[k] <= few.error[k] * 1.5 and many.worst[k] >= many.error[k]
