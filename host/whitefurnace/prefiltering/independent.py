"""Checks a level that misses its tolerance without the device's sums: is the grid too coarse, or the device wrong?"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from whitefurnace.prefiltering.certificate import texel_errors
from whitefurnace.prefiltering.convolution import Convolver
from whitefurnace.prefiltering.jobs import Job
from whitefurnace.prefiltering.references import Reference
from whitefurnace.sphere.grids import cube_directions

LEAST_FAULT = 0.05
"""Texel error below which no device is blamed: the sum over texel centres and the methods themselves err less."""


SURE = 4
"""Times its own doubt that the sum in numpy must differ from a result of the device to accuse it."""

MOST_TEXELS = 3 << 20
"""Numbers of an image whose texels are cut more finely: the check then takes a second or two."""


def wrong_result(
    convolver: Convolver, job: Job, texels: np.ndarray, reference: Reference, tolerance: float
) -> str | None:
    """Return what the device computed wrongly, for a message; None if a method's own error explains the miss.

    The texel of the sample with the largest error is summed in numpy, in float64, over points of all source texels.
    Where the device's exact integral of that texel is off by more than half of the level's error, and by more than the
    doubt of the sum allows, that integral is wrong. Otherwise the device sums the nodes of the level's grid with
    another kernel: if that result is much nearer to the truth, the level's own sum is wrong.

    texels: the level, (dims, 3). tolerance: that of the level.
    """
    lobe = job.lobe
    if lobe is None or job.shape.octahedral or not job.plan.grid:
        return None
    mean = job.shape.mean(texels)
    if not np.isfinite(mean):
        mean = convolver.mean * convolver.scale
    values = texels.reshape(-1, 3)[reference.index].astype(np.float64)
    errors = texel_errors(values, reference.values, mean)
    worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
    direction = job.shape.directions(reference.index[worst : worst + 1])
    coarse, true = (summed(convolver, lobe.density, direction[:, 0], cuts) for cuts in cuts_of(convolver))

    def off(found: np.ndarray) -> float:
        one = float(texel_errors(found[None], true[None], mean)[0])
        return one if np.isfinite(one) else np.inf

    missed = float(errors[worst])
    least = max(LEAST_FAULT, SURE * off(coarse), missed / 2 if np.isfinite(missed) else 0.0)
    where = f"of a texel that is {_listed(true / convolver.scale)} by a sum in numpy"
    if off(reference.values[worst]) > least:
        return f"the exact integral {where} is {_listed(reference.values[worst] / convolver.scale)} there"
    if off(values[worst]) > least:
        again = convolver.on_grid(lobe, direction, job.plan.grid, tolerance)[0]
        if off(again) <= off(values[worst]) / 2:
            return f"the convolution {where} is {_listed(values[worst] / convolver.scale)} there"
    return None


def cuts_of(convolver: Convolver) -> tuple[int, int]:
    """Return the nodes of a texel's edge of two sums, whose difference is the doubt of the finer one."""
    return (2, 4) if convolver.environment.texels.size <= MOST_TEXELS else (1, 2)


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{x:.6g}" for x in values)


def summed(
    convolver: Convolver, density: Callable[[np.ndarray], np.ndarray], direction: np.ndarray, cuts: int
) -> np.ndarray:
    """Return ∫ L K dω/∫ K dω for one direction (3,) as a sum over cuts × cuts points of each texel: (3,) float64.

    density: D as a function of q = |l - r|², K = D (1 - q/2)₊. Values have the convolver's scale.
    """
    env = convolver.environment
    rows, columns = env.texels.shape[-3:-1]
    c, s = math.cos(env.rotation), math.sin(env.rotation)
    total, whole = np.zeros(3), 0.0
    for row in range(env.texels.size // 3 // columns):  # of one face after the other
        at, along = (np.arange(n * cuts) + 0.5 for n in (1, columns))
        i, j = (x.ravel() for x in np.meshgrid(at / cuts + row % rows, along / cuts, indexing="ij"))
        if env.kind == "latlong":
            theta, phi = i * (math.pi / rows), j * (2 * math.pi / columns) - math.pi
            d = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)])
            weight = np.sin(theta)
        else:
            x, y = 2 * j / columns - 1, 2 * i / rows - 1
            d = cube_directions(np.full(x.shape, row // rows), x, y)
            weight = (1 + x * x + y * y) ** -1.5
        world = np.stack([c * d[0] - s * d[2], d[1], s * d[0] + c * d[2]])
        q = ((world - direction[:, None]) ** 2).sum(0)
        above = q < 2
        K = density(q[above]) * (1 - q[above] / 2) * weight[above]
        texel = j[above].astype(int) + row * columns
        total += K @ env.texels.reshape(-1, 3)[texel].astype(np.float64)
        whole += float(K.sum())
    return total / whole * convolver.scale
