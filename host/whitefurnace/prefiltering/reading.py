"""Measures the error of reading a chain as engines do: between texels, between levels and from a stored format.

The levels of a bake are exact to their tolerance, but an engine shows them with further errors. For a roughness r it
reads at lod(r), bilinearly in two cube levels and linearly between them. `Reader.as_read` compares the result with the
exact lobe of r in the same direction, and splits the error into parts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from whitefurnace.errors import UnsupportedError, UsageError, nearest
from whitefurnace.files import pack, unpack
from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.certificate import texel_errors
from whitefurnace.prefiltering.convolution import Convolver
from whitefurnace.prefiltering.level_fit import Mixture, read_mixtures
from whitefurnace.prefiltering.lobes import Lobe, mixture_lobe, ndf_lobe
from whitefurnace.prefiltering.recipe import LEVELS_RANGE, Chain
from whitefurnace.sphere.environments import Environment, cube_solid_angles
from whitefurnace.sphere.grids import Shape, cube_directions, face_coordinates, radiance_at

DIRECTIONS = 256
"""Number of random directions, the same for every environment. Between sets of them the mean over r of a studio's error
varies by 2 % (standard deviation of five), and the ratio of `--fit read` to own lobes by 1 %."""

SCORED = 24
SMOOTHEST = 1 / 24
"""Reads are scored at the midpoints of SCORED equal parts of r from SMOOTHEST to 1. Below, a lobe is narrower than a
texel of a 1K image and what is seen is the image; Filament clamps at .045."""

REDUCED, COARSEST = 0.35, 128
"""A lobe of α is integrated over texels of at most this × α, in no fewer rows than that; finer images are halved by
exact means. On a studio this adds at most 2.4e-3 RMS, far below the error of any read."""

TOLERANCE = 4e-2
"""Tolerance of the quadrature where the image's own texels are coarser than that: at r < .1, where the error of reads
is ten times as large."""

STEP = 0.1
"""Step in log r of the nodes at which lobes are integrated. Between them they are interpolated, within 3e-4 RMS."""

PARTS = ("between", "texels", "levels", "format", "all")
"""Parts of the error that a read adds to the exact lobe: `between` levels that are exact everywhere, linear in lod;
`texels`, bilinear reads between texels; `levels`, the stated p99 errors of the levels that are read; `format`, the
error of the pixel format; and `all`, the total error."""


# ------------------------------------------------------------------------------------------------- formats


FORMATS: Mapping[str, str] = {"float32": "rgba32f", "float16": "rgba16f", "r11g11b10": "b10g11r11", "rgb9e5": "rgb9e5"}
"""Formats through which reads are measured, each with the name of its pixel format in files."""


def stored(values: np.ndarray, format: str) -> np.ndarray:
    """Return radiance (…, 3) after a round trip through the pixel format `format`, one of FORMATS, float64.

    Raises UsageError with the nearest name.
    """
    if format not in FORMATS:
        raise UsageError(f"unknown format {format!r}{nearest(format, FORMATS)}")
    values = np.asarray(values, np.float64)
    form = FORMATS[format]
    return unpack(form, pack(form, values).data, values.shape[:-1])[..., :3].astype(np.float64)


# ------------------------------------------------------------------------------------------------- reads


def taps(size: int, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return flat indices (4, m) and weights (4, m) of a seamless bilinear read of a cube in directions d (3, m).

    size: texels of a face edge. Beyond an edge the read takes the texel of the next face that meets it there. The texel
    that is missing at a corner is the mean of the other three [OpenGL 4.6, 8.13].
    """
    face, s, t = face_coordinates(d)
    x, y = (s + 1) / 2 * size - 0.5, (t + 1) / 2 * size - 0.5
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = x - j, y - i
    index = np.empty((4, d.shape[1]), int)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    missing = np.zeros((4, d.shape[1]), bool)
    for k in range(4):
        column, row = j + k % 2, i + k // 2
        beyond_x, beyond_y = (column < 0) | (column >= size), (row < 0) | (row >= size)
        missing[k] = beyond_x & beyond_y
        # The point just over the edge lies in the texel of the next face that meets it.
        over = 1 + 1e-9
        a = np.where(beyond_x, np.sign(column + 0.5) * over, (2 * column + 1) / size - 1)
        b = np.where(beyond_y, np.sign(row + 0.5) * over, (2 * row + 1) / size - 1)
        there, a, b = face_coordinates(cube_directions(face, a, b))
        column = np.clip(np.floor((a + 1) / 2 * size).astype(int), 0, size - 1)
        row = np.clip(np.floor((b + 1) / 2 * size).astype(int), 0, size - 1)
        index[k] = (there * size + row) * size + column
    lost = (weights * missing).sum(0)
    weights = np.where(missing, 0.0, weights + lost / 3)
    return index, weights


def bilinear(texels: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Read a cube level (6, s, s, 3) bilinearly in directions d (3, m): (m, 3)."""
    index, weights = taps(texels.shape[1], d)
    return np.einsum("km,kmc->mc", weights, texels.reshape(-1, 3)[index].astype(np.float64))


def hats(roughness: np.ndarray, recipe: Chain) -> np.ndarray:
    """Return the weights of the levels of a chain in reads at roughness values (r,): (r, levels).

    A read is linear in lod between two levels.
    """
    lod = np.array([recipe.lod(float(r)) for r in roughness])
    return np.maximum(1 - np.abs(lod[:, None] - np.arange(len(recipe.levels))), 0)


# ------------------------------------------------------------------------------------------------- references


def halved(env: Environment) -> Environment | None:
    """Return the environment over texels twice as large, each the exact mean of four; None where a size is odd."""
    rows, columns = env.texels.shape[-3:-1]
    if rows % 2 or columns % 2:
        return None
    if env.kind == "latlong":
        # The solid angle of a row is a product of sines (environments.latlong_solid_angles).
        weights = np.sin((np.arange(rows) + 0.5) * math.pi / rows)[:, None]
    else:
        weights = cube_solid_angles(rows)
    weights = np.broadcast_to(weights, (rows, columns)).astype(np.float32)
    tiles = (*env.texels.shape[:-3], rows // 2, 2, columns // 2, 2)
    lit = (env.texels * weights[..., None]).reshape(*tiles, 3).sum((-4, -2), dtype=np.float64)
    total = weights.reshape(tiles[-4:]).sum((-3, -1), dtype=np.float64)
    return replace(env, texels=np.ascontiguousarray(lit / total[..., None], np.float32), coverage=None)


def single(roughness: float) -> Mixture:
    """Return the mixture that is one lobe of this perceptual roughness."""
    return ((1.0, roughness),)


class Exact:
    """Computes exact values of a chain's lobes in any direction, over texels as large as each lobe allows."""

    def __init__(self, device: Device, env: Environment, recipe: Chain) -> None:
        self.device, self.env, self.recipe = device, env, recipe
        self.mean = float(np.mean(env.statistics["mean"]))
        self._sources: list[tuple[float, Environment]] = []
        self._convolvers: dict[tuple[int, int], Convolver] = {}
        reduced: Environment | None = env
        while reduced is not None:
            rows = reduced.texels.shape[-3]
            self._sources.append((math.pi / rows if env.kind == "latlong" else math.pi / 2 / rows, reduced))
            reduced = halved(reduced) if rows >= 2 * (COARSEST if env.kind == "latlong" else COARSEST // 2) else None
        self._lobes: dict[Mixture, Lobe] = {}

    def _lobe(self, mixture: Mixture) -> Lobe:
        if mixture not in self._lobes:
            choice, parameters = self.recipe.ndf, self.recipe.parameters
            roughness = mixture[0][1]
            self._lobes[mixture] = (
                ndf_lobe(self.device, choice, roughness, parameters(roughness))
                if mixture == single(roughness)
                else mixture_lobe(self.device, choice, mixture, parameters)
            )
        return self._lobes[mixture]

    def convolver(self, k: int, precision: int = 32) -> Convolver:
        """Return the convolver of the k-th source, where 0 is the environment itself and each next one has larger
        texels.
        """
        if (k, precision) not in self._convolvers:
            self._convolvers[k, precision] = Convolver(self.device, self._sources[k][1], precision=precision)
        return self._convolvers[k, precision]

    def lobes(self, wanted: Sequence[tuple[Mixture, np.ndarray]]) -> list[np.ndarray]:
        """Return exact values of lobes in given directions, (m, 3) float64 for each (mixture, directions (3, m)).

        At roughness 0 the value is the radiance. Raises UnsupportedError for a lobe that underflows.
        """
        values: list[np.ndarray] = [np.empty(0)] * len(wanted)
        groups: dict[tuple[int, int], list[int]] = {}
        for job, (mixture, d) in enumerate(wanted):
            if mixture == single(0.0):
                values[job] = self.radiance(d)
                continue
            alpha = self._lobe(mixture).alpha
            fit = [k for k, (texel, _) in enumerate(self._sources) if texel <= REDUCED * alpha]
            k = fit[-1] if fit else 0
            texel = self._sources[k][0]
            cuts = 1
            while not fit and planning.cuts_error(texel, alpha, cuts) > TOLERANCE and cuts < planning.MOST_CUTS:
                cuts = 2 * cuts
            groups.setdefault((k, cuts), []).append(job)
        for (k, cuts), jobs in sorted(groups.items()):
            for precision in (32, 64):
                convolver = self.convolver(k, precision)
                with np.errstate(invalid="ignore"):
                    found = convolver.exact(
                        [(self._lobe(wanted[job][0]), wanted[job][1]) for job in jobs], cuts, TOLERANCE
                    )
                for job, value in zip(jobs, found, strict=True):
                    values[job] = value / convolver.scale
                # Charlie's lobe lies in the last degrees above the horizon, and underflows float32 where it is thin.
                jobs = [job for job in jobs if not np.isfinite(values[job]).all()]
                if not jobs:
                    break
            else:
                lobe = self._lobe(wanted[jobs[0]][0]).name
                raise UnsupportedError(
                    f"ndf {self.recipe.ndf.model.name} at {lobe} has no lobe that "
                    f"float{convolver.precision} can integrate"
                )
        return values

    def radiance(self, d: np.ndarray) -> np.ndarray:
        """Return the radiance (m, 3) of the environment's texel in each direction d (3, m), with its rotation."""
        return radiance_at(self.env, d)

    def means(self, size: int, index: np.ndarray) -> np.ndarray:
        """Return exact means (m, 3) over texels of a cube of `size`, by flat index, as level 0 stores them."""
        convolver = self.convolver(0)
        return convolver.exact_means(Shape(False, size), index) / convolver.scale


class Interpolated:
    """Interpolates exact values in fixed directions at any roughness of a range.

    The logarithm of the values is interpolated cubically in log r, since they are positive, span decades and are smooth
    in r.
    """

    def __init__(self, exact: Exact, d: np.ndarray, smoothest: float) -> None:
        self.exact, self.d = exact, d
        count = max(math.ceil(-math.log(smoothest) / STEP) + 1, 4)
        self.low = math.log(smoothest)
        self.step = -self.low / (count - 1)
        nodes = [min(math.exp(self.low + k * self.step), 1.0) for k in range(count)]
        values = exact.lobes([(single(r), d) for r in nodes])
        self.floor = 1e-12 * exact.mean or 1.0  # black has a logarithm too
        self.values = np.log(np.stack(values) + self.floor)  # (nodes, m, 3)

    def at(self, roughness: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return values (r, m, 3) float64 at perceptual roughness values (r,); at 0 the radiance of the environment."""
        out = []
        for r in roughness:
            if r == 0:
                out.append(self.exact.radiance(self.d))
                continue
            x = (math.log(r) - self.low) / self.step
            first = min(max(int(x) - 1, 0), len(self.values) - 4)
            nodes = range(4)
            weights = [math.prod((x - first - b) / (a - b) for b in nodes if b != a) for a in nodes]
            out.append(np.exp(np.tensordot(weights, self.values[first : first + 4], 1)) - self.floor)
        return np.stack(out)


# ------------------------------------------------------------------------------------------------- as read


@dataclass(frozen=True)
class AsRead:
    """The error of a chain as an engine reads it, split into the PARTS that were measured.

    sizes      face edge of each level in texels
    roughness  (n,) perceptual roughness values of the reads
    rms, p95   for each part (n,): root mean square and 95th percentile of the texel error, over directions that are
               uniform on the sphere. The texel error is the maximum over channels of |x - ref| / max(ref, 1e-3 · mean),
               where ref is the exact lobe in the direction, and x - ref the change that the part makes
    """

    sizes: tuple[int, ...]
    fit: str | None
    format: str
    roughness: np.ndarray
    rms: Mapping[str, np.ndarray]
    p95: Mapping[str, np.ndarray]

    def mean(self, part: str = "all") -> float:
        """Return the mean of a part's RMS error over roughness, uniform from SMOOTHEST to 1."""
        return float(self.rms[part].mean())

    def data(self) -> dict[str, Any]:
        """Return the errors as manifests and JSON rows hold them."""
        parts = {
            part: {"mean": float(self.rms[part].mean()), "p95": float(self.p95[part].mean())}
            for part in PARTS
            if part in self.rms
        }
        whole = "all" if "all" in self.rms else "between"
        return {
            "levels": len(self.sizes),
            "sizes": list(self.sizes),
            "fit": self.fit,
            "format": self.format,
            "parts": parts,
            "over_roughness": {
                "roughness": [round(float(r), 6) for r in self.roughness],
                "rms": [float(x) for x in self.rms[whole]],
                "p95": [float(x) for x in self.p95[whole]],
            },
        }


def scored() -> np.ndarray:
    """Return the (SCORED,) roughness values at which reads are measured."""
    return SMOOTHEST + (1 - SMOOTHEST) * (np.arange(SCORED) + 0.5) / SCORED


def random_directions(count: int = DIRECTIONS, seed: int = 0) -> np.ndarray:
    """Draw directions (3, count) that are uniform over the sphere."""
    d = np.random.default_rng(seed).normal(size=(3, count))
    return d / np.sqrt((d * d).sum(0))


class Reader:
    """Measures chains of one environment as engines read them; integrals that they share are computed once.

    recipes: chains of one NDF. directions: number of random directions, drawn from `seed`. Raises InputError and
    DeviceError.
    """

    def __init__(
        self, device: Device, env: Environment, *recipes: Chain, directions: int = DIRECTIONS, seed: int = 0
    ) -> None:
        self.device = device
        self.exact = Exact(device, env, recipes[0])
        self.d = random_directions(directions, seed)
        used = [r for recipe in recipes for mixture in self.mixtures(recipe) for _, r in mixture if r > 0]
        self.at_directions = Interpolated(self.exact, self.d, min([float(scored()[0]), *used]))
        self.reference = self.at_directions.at(scored())

    def mixtures(self, recipe: Chain) -> list[Mixture]:
        """Return the mixture of lobes of each level, as (weight, roughness) pairs; ((1, 0),) is a mirror."""
        own = [single(r) for _, r in recipe.levels]
        if recipe.fit != "read":
            return own
        return [mixture or lobe for mixture, lobe in zip(read_mixtures(self.device, recipe), own, strict=True)]

    def as_read(
        self,
        recipe: Chain,
        levels: Sequence[np.ndarray] | None = None,
        errors: Sequence[float] | None = None,
        *,
        format: str = "float32",
        kept: Sequence[np.ndarray] | None = None,
        texels: bool = True,
    ) -> AsRead:
        """Measure the error of a chain as engines read it.

        levels: its baked levels, (6, s, s, 3) each; without them the levels are exact in every texel. errors: their
        stated errors. format: one of FORMATS. kept: the levels after a round trip through the format; without them, the
        format is applied here. texels: False leaves out the error within a level, which makes the measurement fast.
        """
        mixtures = self.mixtures(recipe)
        weights = hats(scored(), recipe)
        nodes = sorted({r for mixture in mixtures for _, r in mixture})
        values = dict(zip(nodes, self.at_directions.at(nodes), strict=True))
        there = np.stack([sum(w * values[r] for w, r in mixture) for mixture in mixtures])  # (levels, m, 3)
        parts = {"between": np.tensordot(weights, there, 1) - self.reference}
        if texels:
            tapped = [taps(size, self.d) for size, _ in recipe.levels]
            made = (
                self._texels(recipe, mixtures, tapped)
                if levels is None
                else [
                    level.reshape(-1, 3)[index].astype(np.float64)
                    for level, (index, _) in zip(levels, tapped, strict=True)
                ]
            )
            held = (
                [stored(part, format) for part in made]
                if kept is None
                else [
                    level.reshape(-1, 3)[index].astype(np.float64)
                    for level, (index, _) in zip(kept, tapped, strict=True)
                ]
            )
            read, shown = (
                np.stack([np.einsum("km,kmc->mc", w, part) for part, (_, w) in zip(some, tapped, strict=True)])
                for some in (made, held)
            )
            parts["texels"] = np.tensordot(weights, read - there, 1)
            parts["format"] = np.tensordot(weights, shown - read, 1)
            parts["all"] = np.tensordot(weights, shown, 1) - self.reference
        off = {
            part: np.stack(
                [
                    texel_errors(ref + more, ref, self.exact.mean)
                    for ref, more in zip(self.reference, difference, strict=True)
                ]
            )
            for part, difference in parts.items()
        }
        rms = {part: np.sqrt((e * e).mean(1)) for part, e in off.items()}
        p95 = {part: np.quantile(e, 0.95, axis=1) for part, e in off.items()}
        if errors is not None:
            rms["levels"] = p95["levels"] = weights @ np.asarray(errors, np.float64)
        return AsRead(tuple(size for size, _ in recipe.levels), recipe.fit, format, scored(), rms, p95)

    def _texels(
        self, recipe: Chain, mixtures: Sequence[Mixture], tapped: Sequence[tuple[np.ndarray, np.ndarray]]
    ) -> list[np.ndarray]:
        """Return exact values of the texels from which each level is read, (4, m, 3)."""
        wanted, places = [], []
        for (size, roughness), mixture, (index, _) in zip(recipe.levels, mixtures, tapped, strict=True):
            distinct, back = np.unique(index, return_inverse=True)
            places.append((size, roughness, distinct, back.reshape(index.shape)))
            if roughness > 0:
                wanted.append((mixture, Shape(False, size).directions(distinct)))
        values = iter(self.exact.lobes(wanted))
        return [
            (next(values) if roughness > 0 else self.exact.means(size, distinct))[back]
            for size, roughness, distinct, back in places
        ]


def alternatives(recipe: Chain) -> list[Chain]:
    """Return the chains that a chain can be compared with: with own lobes and with `--fit read`.

    Each has as many levels as the chain, half as many more, or twice as many. Where there are more levels than
    halvings, the last levels keep the last size.
    """
    count = len(recipe.levels)
    found = []
    for n in dict.fromkeys((count, min(math.ceil(1.5 * count), LEVELS_RANGE[1]), min(2 * count, LEVELS_RANGE[1]))):
        found += [replace(recipe, count=n, fit=fit) for fit in (None, "read")]
    return found


def compared(device: Device, env: Environment, recipe: Chain, *, alone: bool = False) -> list[AsRead]:
    """Measure the errors of `alternatives` as engines read them, with exact levels.

    alone: True measures the recipe only, for an engine that allows no other.
    """
    choices = [recipe] if alone or recipe.only or recipe.levels[-1][1] > 1 else alternatives(recipe)
    reader = Reader(device, env, *choices)
    return [reader.as_read(choice, texels=len(choice.levels) == len(recipe.levels)) for choice in choices]
