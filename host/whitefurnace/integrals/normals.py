"""Draws microfacet normals from any NDF: by its own quantile function where it has one, otherwise by a table."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from whitefurnace.catalogue import Model
from whitefurnace.catalogue.choice import chosen
from whitefurnace.errors import UsageError, nearest
from whitefurnace.opencl.derived import finest, numbers_of, refuse_bad
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.opencl.launch import evaluate

QUANTILES = 4096
"""Intervals of a tabulated quantile function. The density is taken as constant within an interval, in the graded angle:
with 12 e-folds of angle the error is h²/12 ≈ 1e-6 of the density."""


def sample(
    ndf: str | Model,
    count: int,
    *,
    seed: int = 0,
    device: Device | str | None = None,
    precision: int = 32,
    **parameters: float,
) -> np.ndarray:
    """Draw `count` normals m with density D(m)(n·m): (count, 3) float64, n = +z.

    ndf: a name (`ggx`, `ggx:alpha=.3`), a catalogue entry or the path of a `.clh` file.
    count: number of normals, 1 to 2^28.
    seed: the same seed gives the same normals.
    device, precision: an NDF whose quantile function has a closed form is sampled on the device, in 32 or 64 bits;
    others are sampled by a table of their cumulative distribution.
    parameters: the parameters of the NDF, one number each.

    Raises the errors of `integrate`.
    """
    choice = chosen("ndf", ndf)
    entry = choice.model
    if precision not in (32, 64):
        raise UsageError(f"precision {precision} is not one of 32, 64")
    if not 1 <= count <= 1 << 28:
        raise UsageError(f"count {count} is outside [1, {1 << 28}]")
    given: dict[str, Any] = {
        **{p.name: p.default for p in entry.parameters if p.default is not None},
        **choice.given,
        **{name.removeprefix("ndf_"): value for name, value in parameters.items()},
    }
    known = [p.name for p in entry.parameters]
    for name in given:
        if name not in known:
            raise UsageError(f"ndf {entry.name} has no parameter {name!r}{nearest(name, known)}")
    rows = np.empty((len(known), 1))
    for k, p in enumerate(entry.parameters):
        if p.name not in given:
            raise UsageError(f"ndf {entry.name} needs {p.name}, {p.about}")
        value = p.check(given[p.name], f"ndf {entry.name}")
        if value.ndim:
            raise UsageError(f"ndf {entry.name}: {p.name} must be one number to be sampled")
        rows[k] = value
    on = device if isinstance(device, Device) else choose_device(device)
    u, v = np.random.Generator(np.random.Philox(seed)).random((2, count))
    numbers = numbers_of(on, entry, rows)
    phi = 2 * math.pi * v
    if not entry.isotropic:
        r = np.sqrt(_closed(on, entry, u, numbers, precision))
        stretch = [
            float(evaluate(on, f"NDF_STRETCH_{axis}", {"ndf": entry}, numbers, precision)[0, 0]) for axis in "XY"
        ]
        m = np.stack([stretch[0] * r * np.cos(phi), stretch[1] * r * np.sin(phi), np.ones(count)], 1)
        return m / np.linalg.norm(m, axis=1, keepdims=True)
    sin2 = quantiles(on, entry, numbers, u, precision)
    s = np.sqrt(sin2)
    return np.stack([s * np.cos(phi), s * np.sin(phi), np.sqrt(np.maximum(1 - sin2, 0))], 1)


def quantiles(device: Device, entry: Model, numbers: np.ndarray, u: np.ndarray, precision: int = 32) -> np.ndarray:
    """Return sin²θ, (n,) float64, at the quantiles u of an isotropic NDF's density D(m)(n·m).

    numbers: (k, 1) parameters and constants as kernels take them. u: (n,) in [0, 1). precision: 32 or 64 bits.
    """
    if "NDF_SAMPLE" in entry.provides:
        return _closed(device, entry, u, numbers, precision)
    return np.asarray(np.sin(np.interp(u, *_energy(device, entry, numbers))) ** 2)


def _closed(device: Device, entry: Model, u: np.ndarray, numbers: np.ndarray, precision: int) -> np.ndarray:
    """Return the NDF's own quantiles at u, float64."""
    below_one = np.minimum(u, 1 - (2.0**-24 if precision == 32 else 2.0**-53))  # float32 would round the rest to 1
    cells = np.concatenate([below_one[None], np.repeat(numbers, u.size, 1)])
    return evaluate(device, "NDF_SAMPLE", {"ndf": entry}, cells, precision)[0].astype(np.float64)


def _energy(device: Device, entry: Model, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the energy below each of QUANTILES + 1 angles, from 0 to 1, and the angles."""
    precision = finest(device)
    width, reach = (
        float(evaluate(device, f, {"ndf": entry}, numbers, precision)[0, 0]) for f in ("NDF_WIDTH", "NDF_REACH")
    )
    edges = np.linspace(0, math.asinh(reach / width), QUANTILES + 1)
    x, w = np.polynomial.legendre.leggauss(4)
    t = (edges[:-1, None] + edges[1:, None]) / 2 + np.diff(edges)[:, None] / 2 * x
    theta = np.minimum(width * np.sinh(t), math.pi / 2)
    cells = np.concatenate(
        [np.stack([np.cos(theta), np.sin(theta) ** 2]).reshape(2, -1), np.repeat(numbers, theta.size, 1)]
    )
    D = evaluate(device, "NDF_D", {"ndf": entry}, cells, precision)[0].astype(np.float64).reshape(theta.shape)
    if entry.text is not None:
        refuse_bad(entry, D.ravel(), theta.ravel())
    parts = (w * D * np.cos(theta) * np.sin(theta) * np.cosh(t)).sum(1)
    energy = np.concatenate([[0.0], np.cumsum(parts)])
    return energy / energy[-1], np.minimum(width * np.sinh(edges), math.pi / 2)
