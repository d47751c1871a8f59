"""Computes levels by filtered importance sampling: each texel takes N samples of the lobe from a pyramid of means."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from whitefurnace.catalogue.rule import gauss
from whitefurnace.opencl import source
from whitefurnace.opencl.device import Buffer, Kernel
from whitefurnace.prefiltering.lobes import Lobe
from whitefurnace.prefiltering.means import Means
from whitefurnace.sphere.environments import channel_range, cube_solid_angles
from whitefurnace.sphere.grids import Shape

LARGEST_SOURCE = 1024
"""Largest face edge of a pyramid's first level in texels: 135 MB of float32 with its pad, frame and coarser levels."""

CROWDED = 4
"""Number of samples on one texel of the first level, where the lobe is densest, from which a pyramid of twice the size
is read. Its bilinear reads blur a sharp lobe by a quarter of a texel's square, which more samples do not reduce. A 1K
studio at α = .018 has .58 % RMSE at 1 024 samples from 256² and .15 % from 512², which costs 50 ms; .50 % and .14 % at
16 384."""

CHUNK = 1024
"""Number of samples in one partial sum. It bounds float32 rounding to 4e-6, far below the error of as many samples."""

SAMPLES_A_LAUNCH = 1 << 26
"""Number of samples of all outputs of one launch: about 0.2 s on two cores, so that Ctrl-C takes effect."""

INTERVALS = 4096
"""Number of intervals of the table of a lobe's energy. 12 e-folds of angle in as many steps have an error of 1e-6 of
the density."""

STEEPEST = 0.75 * math.log2(3)
"""Number of levels by which a sample at a cube's corner is read higher than at the middle of a face."""

GOLDEN = (math.sqrt(5) - 1) / 2


class Sampler:
    """Computes levels of one environment by filtered importance sampling.

    [Krivanek2008; Colbert2007, GPU Gems 3, ch. 20] The environment is a cube of exact means over its texels, with a
    pyramid of means above it. Sums are over the radiance above the smallest value of each channel, so that a constant
    environment gives exactly that constant.

    Every texel uses the same samples, in frames that turn slowly from texel to texel. A random turn of each texel
    leaves the RMSE as it is (32 to 1 024 samples, four environments) and turns errors that neighbours share into noise.

    precision: 32 or 64 bits of the kernels; float32 has an error of 4e-6. progress: called with a lobe's name and the
    share of all work that is done.
    """

    def __init__(self, means: Means, precision: int = 32, progress: Callable[[str, float], None] | None = None) -> None:
        self.means = means
        self.device = means.device
        self.precision = precision
        self.progress = progress or (lambda _what, _share: None)
        self.kind = np.dtype(f"f{precision // 8}")
        self.base, _ = channel_range(means.texels)
        rows = means.rows // 2 if means.latlong else means.rows
        self.size = min(1 << max(rows - 1, 0).bit_length(), LARGEST_SOURCE)
        """Texels of a face edge of the first level: a power of two, at least as fine as the environment's own."""
        self._pyramids: dict[int, Buffer] = {}

    def _kernel(self, name: str, lanes: int) -> Kernel:
        return self.device.build(source.samples().text, {"W": lanes, "T": 1, "PRECISION": self.precision}).kernel(name)

    def _launch(self, name: str, count: int, *args: Any) -> None:
        """Launch a kernel of one lane over `count` items."""
        size = self.device.local_size
        self.device.launch(self._kernel(name, 1), (-(-count // size) * size,), args)

    def pyramid(self, size: int) -> Buffer:
        """Return all levels of the pyramid that begins at `size` texels of a face edge, in the layout of
        `pyramid.cl`.
        """
        if size not in self._pyramids:
            texels = self.device.array(self.means.level(Shape(False, size)))
            levels = size.bit_length()
            made = self.device.empty((sum(6 * ((size >> k) + 2) ** 2 for k in range(levels)), 4), self.kind)
            self._launch("first_level", 6 * size * size, made, np.int32(size), texels, *self.base)
            for k in range(levels):
                n = size >> k
                if k:
                    weights = self.device.array(_weights(2 * n).astype(self.kind))
                    self._launch("next_level", 6 * n * n, made, np.int32(size), np.int32(k), weights)
                self._launch("frame_level", 24 * (n + 1), made, np.int32(size), np.int32(k))
            self._pyramids[size] = made
        return self._pyramids[size]

    def level(self, lobe: Lobe, shape: Shape, count: int, share: tuple[float, ...] = (0.0, 1.0)) -> np.ndarray:
        """Compute a level by `count` samples in each texel of `shape`: (dims, 3) float32, in the units of the means.

        share: progress before and after.
        """
        device = self.device
        table, flat, size = self._table(lobe, count)
        pyramid, listed = self.pyramid(size), device.array(table.astype(self.kind))
        lanes = device.lanes(self.precision)
        add, finish = self._kernel("add_samples", lanes), self._kernel("finish_samples", lanes)
        step = lanes * device.local_size
        tile = max(SAMPLES_A_LAUNCH // count // step, 1) * step
        splits = -(-count // CHUNK)
        order = shape.tiled()
        out = np.empty((shape.count, 3), np.float32)
        for begin in range(0, shape.count, tile):
            index = order[begin : begin + tile]
            padded = -(-len(index) // step) * step
            part = np.pad(shape.directions(index), ((0, 0), (0, padded - len(index))), mode="edge")
            partial = device.empty((splits, 3, padded), self.kind)
            device.launch(
                add,
                (padded // lanes, splits),
                (
                    partial,
                    np.int32(padded),
                    np.int32(count),
                    np.int32(flat),
                    np.int32(CHUNK),
                    device.array(part.astype(self.kind)),
                    listed,
                    np.int32(size),
                    np.int32(size.bit_length()),
                    pyramid,
                ),
            )
            level = device.empty((3, padded), self.kind)
            device.launch(finish, (padded // lanes,), (level, np.int32(padded), partial, np.int32(splits)))
            out[index] = level.read().T[: len(index)] + self.base
            self.progress(lobe.name, share[0] + (share[1] - share[0]) * (begin + len(index)) / shape.count)
        return out.reshape(*shape.dims, 3)

    def _table(self, lobe: Lobe, count: int) -> tuple[np.ndarray, int, int]:
        """Return samples (count, 5) float64 as `add_samples` reads them, and facts about the first level.

        The facts are the number of samples that never leave it, and its size.
        """
        light, share, solid_angle = light_samples(lobe, count)
        size = self.size
        if size < LARGEST_SOURCE and 4 / size**2 > CROWDED * solid_angle.min():
            size *= 2
        # A texel at the middle of a face of the first level has 4/size² steradians.
        lod = 0.5 * np.log2(solid_angle * size**2 / 4)
        order = np.argsort(lod, kind="stable")
        table = np.concatenate([light, share[:, None], lod[:, None]], 1)[order]
        return table, count if size == 1 else int(np.searchsorted(table[:, 4], -STEEPEST, "right")), size


def light_samples(lobe: Lobe, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the samples of a lobe: directions (count, 3), shares (count,) and solid angles (count,), float64.

    Directions l are in the frame of n = v. The shares are the weights of the samples and sum to 1. A sample stands for
    the solid angle 1/(count · pdf).

    Half vectors have the density D(h)(n·h) of the NDF, within 45° of n, since others reflect below the horizon. With
    θ_l = 2θ_h, dω_l = 4 (n·h) dω_h, so pdf(l) = D/(4 ∫ D (n·h) dω_h), and the weight that remains of K = D(h)(n·l) is
    n·l [Karis2013, "Real Shading in Unreal Engine 4"]. Where a mixture of lobes is negative, |D| is sampled and the
    share gets its sign. Directions of irradiance have the density n·l/π and equal shares.

    The samples are a two-dimensional lattice: equal steps of energy, and azimuths by the golden ratio, whose points
    keep their distance at every count [Vogel1979]. Its error is two thirds of that of Hammersley's points (four
    environments).
    """
    u = (np.arange(count) + 0.5) / count
    phi = 2 * math.pi * np.mod(np.arange(count) * GOLDEN, 1.0)
    if not lobe.summands:
        sine, z, share = np.sqrt(u), np.sqrt(1 - u), np.ones(count)
        solid_angle = math.pi / (count * z)
    else:
        energy, sin2 = _energy(lobe)
        # Within an interval D is taken as constant, so that energy grows with sin²θ_h = q/4.
        half = np.interp(u * energy[-1], energy, sin2)
        D = lobe.density(4 * half)
        sine, z = 2 * np.sqrt(half * (1 - half)), 1 - 2 * half
        share = z * np.sign(D)
        # Next to a step of the table, D = 0 would mean a solid angle larger than the sphere. Such a sample is read from
        # the last level.
        solid_angle = 8 * math.pi * energy[-1] / (count * np.maximum(np.abs(D), energy[-1] * 1e-12))
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1), share / share.sum(), solid_angle


def _energy(lobe: Lobe) -> tuple[np.ndarray, np.ndarray]:
    """Return the energy of a lobe below each of INTERVALS + 1 values of sin²θ_h in [0, ½], and these values.

    The energy is ∫ |D| (n·h) sin θ_h dθ_h = ∫ |D|/2 d(sin²θ_h). The angles are graded from the width of the lobe.
    """
    width = min(lobe.alpha, 1.0)
    edges = np.linspace(0, math.asinh(math.pi / 4 / width), INTERVALS + 1)
    sin2 = np.minimum(np.sin(width * np.sinh(edges)) ** 2, 0.5)
    x, w = gauss(4)
    nodes = sin2[:-1, None] + np.diff(sin2)[:, None] * x
    D = np.abs(lobe.density(4 * nodes.ravel())).reshape(nodes.shape)
    return np.concatenate([[0.0], np.cumsum((D * w).sum(1) * np.diff(sin2) / 2)]), sin2


@lru_cache(maxsize=2 * LARGEST_SOURCE.bit_length())
def _weights(n: int) -> np.ndarray:
    """Return the solid angles of a face's texels relative to their mean, (n, n), as weights of averages."""
    omega = cube_solid_angles(n)
    return omega / omega.mean()
