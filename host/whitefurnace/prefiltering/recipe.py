"""Validates the choice of a specular chain: its model, sizes, roughness values and accuracy."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from whitefurnace.catalogue.choice import Chosen, Spec, chosen, is_number
from whitefurnace.errors import UnsupportedError, UsageError, nearest
from whitefurnace.expression import Expression

QUALITIES = {"draft": 1e-2, "normal": 1e-3, "reference": 2e-5}
SIZE_RANGE = (1, 2048)
MIN_SIZE = 16
LEVELS_RANGE = (1, 32)
FITS = ("read",)
TOLERANCE_RANGE = (1e-5, 0.5)
SAMPLES_RANGE = (1, 65536)
IRRADIANCE_SIZE = 32
DFG_SIZE = 128


def tolerance_of(tolerance: float | None, quality: str | None) -> float:
    """Return the tolerance of the levels for a tolerance or a quality, 1e-3 where neither is given.

    tolerance: a number in TOLERANCE_RANGE. quality: a name of QUALITIES. Raises UsageError for both at once, an unknown
    name or a tolerance out of range.
    """
    if tolerance is not None and quality is not None:
        raise UsageError("give a tolerance or a quality, not both")
    if quality is not None:
        if quality not in QUALITIES:
            raise UsageError(f"unknown quality {quality!r}{nearest(quality, QUALITIES)}")
        return QUALITIES[quality]
    if tolerance is None:
        return QUALITIES["normal"]
    low, high = TOLERANCE_RANGE
    if not low <= tolerance <= high:  # also NaN
        raise UsageError(f"tolerance {tolerance!r} is outside [{low:g}, {high:g}]")
    return float(tolerance)


def samples_of(samples: int | None, tolerance: float | None, quality: str | None = None) -> int | None:
    """Return the number of importance samples for each texel, or None where `samples` is None.

    Samples replace the tolerance. Raises UsageError for samples out of SAMPLES_RANGE or together with a tolerance or a
    quality.
    """
    if samples is None:
        return None
    for what, value in (("tolerance", tolerance), ("quality", quality)):
        if value is not None:
            raise UsageError(f"give samples or a {what}, not both")
    low, high = SAMPLES_RANGE
    if not (is_number(samples) and low <= samples <= high and samples == int(samples)):
        raise UsageError(f"samples {samples!r} is not a whole number in [{low}, {high}]")
    return int(samples)


def _power_of_two(value: int, what: str) -> int:
    low, high = SIZE_RANGE
    if not (low <= value <= high and value & (value - 1) == 0):
        raise UsageError(f"{what} {value} is not a power of two in [{low}, {high}]")
    return int(value)


def roughness_of_level(k: int, levels: int) -> float:
    """Return the perceptual roughness of level k of n: r = 1 - √(1 - k/(n - 1)), as in Filament and three.js."""
    return roughness_of_lod(k, levels)


def roughness_of_lod(lod: float, levels: int) -> float:
    """Return the perceptual roughness that engines read at a lod in [0, levels - 1], which may lie between two
    levels.
    """
    return 0.0 if levels == 1 else 1 - math.sqrt(max(1 - lod / (levels - 1), 0.0))


def lod_of_roughness(roughness: float, levels: int) -> float:
    """Return the lod at which engines read a perceptual roughness: (levels - 1) r (2 - r).

    This is the inverse of `roughness_of_lod`.
    """
    return (levels - 1) * roughness * (2 - roughness)


LOD_NAMES = ("r", "alpha", "max_lod", "width")
"""Variables of an engine's lod formula: perceptual roughness, its square, levels - 1, and the edge of level 0."""

ROUGHEST = 4.0
"""Largest perceptual roughness of a level, α = 16. Babylon's last mips have α = 1.4 and 3.4."""


@dataclass(frozen=True)
class Lods:
    """The mapping between the perceptual roughness of a surface and the lod that an engine reads.

    lod     the engine's formula lod(r); None for the mapping of Filament and three.js
    follow  True if levels past r = 1 have the lobe of that α, as the engine's own filter makes them; False if they have
            the lobe of r = 1
    """

    lod: Expression | None = None
    follow: bool = False

    def at(self, roughness: float, levels: int, width: int) -> float:
        """Return the lod in [0, levels - 1] that the engine reads for a perceptual roughness.

        width: texels of an edge of level 0.
        """
        if self.lod is None or levels == 1:
            return lod_of_roughness(roughness, levels) if levels > 1 else 0.0
        return min(max(self._lod(roughness, levels, width), 0.0), levels - 1.0)

    def roughness(self, lod: float, levels: int, width: int) -> float:
        """Return the perceptual roughness of a lod, the inverse of `at`.

        It is 0 for lod 0, where engines have the image itself. width: texels of an edge of level 0. Raises UsageError
        where lod(r) falls as r grows, or is not a positive number.
        """
        if self.lod is None or levels == 1:
            return roughness_of_lod(lod, levels)
        if lod <= 0:
            return 0.0
        low, high = 0.0, 1.0
        end = _checked_end(self.lod, levels, width)
        if abs(end - lod) <= 1e-9:  # lod(r) may be flat there
            return 1.0
        if end < lod:  # past r = 1
            if not self.follow:
                return 1.0
            while high < ROUGHEST and self._lod(high, levels, width) < lod:
                low, high = high, high + 1 / 64
            if self._lod(high, levels, width) < lod:  # never read
                return 1.0
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if self._lod(middle, levels, width) < lod else (low, middle)
        # Rounded to 12 digits, so that a level at r = 1 is exactly that.
        return round(high, 12)

    def _lod(self, roughness: float, levels: int, width: int) -> float:
        assert self.lod is not None
        return float(self.lod(r=roughness, alpha=roughness * roughness, max_lod=levels - 1, width=width))


@lru_cache(maxsize=64)
def _checked_end(lod: Expression, levels: int, width: int) -> float:
    """The lod of r = 1. Raises UsageError for a formula that is no number in (0, 1] or does not grow there."""
    r = np.arange(1, 513) / 512
    values = np.broadcast_to(lod(r=r, alpha=r * r, max_lod=levels - 1, width=width), r.shape)
    what = f"{lod.where}: {lod.text!r} over {levels} levels of {width}²"
    if not np.all(values < math.inf):  # NaN too
        raise UsageError(f"{what} is {values[~(values < math.inf)][0]} at r = {r[~(values < math.inf)][0]:g}")
    with np.errstate(invalid="ignore"):
        if not np.all(values[1:] >= values[:-1]):
            raise UsageError(f"{what} falls where r grows, near r = {r[1:][~(values[1:] >= values[:-1])][0]:g}")
    if values[-1] <= 0:
        raise UsageError(f"{what} is {values[-1]:g} at r = 1: every roughness would read level 0")
    return float(values[-1])


CERTIFIED = 299
"""Default number of uniform texels of a certificate. The largest of 299 errors bounds the 99th percentile at 95 %
confidence, since .99^299 = .0495 (order statistic)."""

CERTIFY_RANGE = (CERTIFIED, 1 << 20)


@dataclass(frozen=True)
class Chain:
    """A specular chain, whose sizes halve from `size` to `min_size` and whose roughness follows `lods`.

    ndf        the NDF and its given parameters
    tolerance  bound on the stated error of every level
    count      number of levels, None for as many as halving gives; sizes after `min_size` stay at it
    fit        "read" if levels are fitted so that interpolated roughness values are most accurate (level_fit.py), else
               None
    samples    importance samples for each texel of irradiance and of every level r > 0; None to meet the tolerance
    certify    number of uniform texels of each certificate, 0 for none
    only       first and last level that are made, None for all of them; lods count these
    """

    ndf: Chosen
    size: int
    min_size: int
    tolerance: float
    count: int | None = None
    fit: str | None = None
    samples: int | None = None
    certify: int = CERTIFIED
    lods: Lods = Lods()
    only: tuple[int, int] | None = None

    @cached_property
    def all_levels(self) -> tuple[tuple[int, float], ...]:
        """Pairs (size, perceptual roughness) of all levels, including those that are not made."""
        n = self.count or int(math.log2(self.size // self.min_size)) + 1
        return tuple((max(self.size >> k, self.min_size), self.lods.roughness(k, n, self.size)) for k in range(n))

    @cached_property
    def levels(self) -> tuple[tuple[int, float], ...]:
        """Pairs (size, perceptual roughness) of the levels that are made."""
        return self.all_levels if self.only is None else self.all_levels[self.only[0] : self.only[1] + 1]

    @property
    def first(self) -> int:
        """Number of the first level that is made."""
        return self.only[0] if self.only else 0

    def lod(self, roughness: float) -> float:
        """Return the lod, among the levels that are made, at which the engine reads a perceptual roughness."""
        lod = self.lods.at(roughness, len(self.all_levels), self.size)
        return lod if self.only is None else min(max(lod - self.first, 0.0), len(self.levels) - 1.0)

    def parameters(self, roughness: float) -> dict[str, float]:
        """Return the parameters of the NDF at a perceptual roughness."""
        entry = self.ndf.model
        assert entry.from_roughness is not None
        given = {name: value for name, value in self.ndf.given.items() if not isinstance(value, tuple)}
        defaults = {p.name: p.default for p in self.ndf.model.parameters if p.default is not None}
        if roughness > 1 and entry.past_one:
            return {**defaults, **entry.past_one(roughness), **given}
        return {**defaults, **entry.from_roughness(min(roughness, 1.0)), **given}

    def canonical(self) -> dict[str, Any]:
        """Return the chain as a JSON object for recipes and keys, equal for equal chains."""
        return {
            "ndf": self.ndf.canonical(),
            "size": self.size,
            "min_size": self.min_size,
            **({"tolerance": self.tolerance} if self.samples is None else {"samples": self.samples}),
            "roughness": [r for _, r in self.levels],
            "fit": self.fit,
            "certify": self.certify,
            **({"only": list(self.only)} if self.only else {}),
        }


def _smallest(size: int, min_size: int | None, levels: int | None, usual: int = MIN_SIZE) -> int:
    """Return the face edge of the last level: the one given, or that after `levels` halvings, or the usual one.

    Raises UsageError.
    """
    if levels is None:
        return usual if min_size is None else min_size
    low, high = LEVELS_RANGE
    if not (is_number(levels) and low <= levels <= high and levels == int(levels)):
        raise UsageError(f"levels {levels!r} is not a whole number in [{low}, {high}]")
    halvings = int(math.log2(size)) + 1
    if min_size is None:
        if levels > halvings:
            raise UsageError(
                f"levels {levels} is outside [1, {halvings}]: from {size}² each level halves, down to 1²; "
                f"with a min-size too, the last levels keep that size"
            )
        return size >> (levels - 1)
    if min_size <= size and size >> (levels - 1) > min_size:
        raise UsageError(
            f"levels {levels} from {size}² end at {size >> (levels - 1)}², not at min-size {min_size}; "
            f"give one of the two, or at least {int(math.log2(size // min_size)) + 1} levels"
        )
    return min_size


def _ndf_of_roughness(ndf: Spec) -> Chosen:
    """Return an isotropic NDF that follows roughness, with all other parameters given as one number.

    Raises UnsupportedError for an NDF that is anisotropic or has no roughness, UsageError for its parameters.
    """
    choice = chosen("ndf", ndf)
    name = choice.model.name
    if not choice.model.isotropic:
        raise UnsupportedError(f"ndf {name} is anisotropic; only isotropic NDFs can be prefiltered")
    if choice.model.from_roughness is None:
        raise UnsupportedError(f"ndf {name} has no parameter that follows roughness")
    smooth, rough = choice.model.from_roughness(0.3), choice.model.from_roughness(0.7)
    follows = {p for p in rough if rough[p] != smooth[p]}  # the rest are defaults and can be given
    for given in choice.given:
        if given in follows:
            raise UsageError(f"ndf {name}: {given} follows the roughness of each level and cannot be given")
    if any(isinstance(value, tuple) for value in choice.given.values()):
        raise UsageError(f"ndf {name}: a chain takes one number a parameter, not three")
    wanted = [p.name for p in choice.model.parameters if p.default is None]
    missing = [p for p in wanted if p not in rough and p not in choice.given]
    if missing:
        raise UsageError(f"ndf {name}: {', '.join(missing)} must be given, as {name}:{missing[0]}=VALUE")
    return choice


def chain(
    *,
    ndf: Spec = "ggx",
    size: int = 256,
    min_size: int | None = None,
    tolerance: float | None = None,
    quality: str | None = None,
    levels: int | None = None,
    fit: str | None = None,
    samples: int | None = None,
    certify: int = CERTIFIED,
    lods: Lods | None = None,
    usual_min: int = MIN_SIZE,
    only_levels: str | None = None,
) -> Chain:
    """Check the choice of a specular chain and return it.

    ndf: name, entry or path of an isotropic NDF. size, min_size: face edges of the first and last level in texels,
    powers of two. levels: number of levels; without `min_size` each level halves, with it sizes halve to `min_size` and
    stay. tolerance, quality, samples: accuracy, at most one of them; 1e-3 without. fit: "read" or None. certify:
    uniform texels of each certificate, 0 for none. lods: the mapping of an engine, by default Filament's and
    three.js's. usual_min: last size where neither `min_size` nor `levels` is given. only_levels: "A-B", the levels that
    are made.

    Raises UsageError for a size that is not a power of two, a `min_size` larger than `size`, levels that do not fit, a
    bad tolerance or name, and samples out of range or together with a tolerance; UnsupportedError for an NDF that
    cannot be prefiltered because it is anisotropic or has no roughness.
    """
    choice = _ndf_of_roughness(ndf)
    if fit is not None and fit not in FITS:
        raise UsageError(f"unknown fit {fit!r}{nearest(fit, FITS)}")
    size = _power_of_two(size, "size")
    given = None if min_size is None else _power_of_two(min_size, "min-size")
    smallest = _smallest(size, given, levels, usual_min)
    if smallest > size:
        raise UsageError(f"min-size {smallest} is larger than size {size}")
    count = samples_of(samples, tolerance, quality)
    low, high = CERTIFY_RANGE
    if certify != 0 and not (is_number(certify) and low <= certify <= high and certify == int(certify)):
        raise UsageError(
            f"certify {certify!r} is not a whole number in [{low}, {high}]: {low} texels are the fewest "
            "that bound 99 % of a level at 95 % confidence"
        )
    made = Chain(
        choice,
        size,
        smallest,
        tolerance_of(tolerance, quality),
        None if levels is None else int(levels),
        fit,
        count,
        int(certify),
        lods or Lods(),
    )
    if only_levels is not None:
        found = re.fullmatch(r"\s*(\d{1,3})\s*-\s*(\d{1,3})\s*", only_levels)
        if not found or not int(found[1]) <= int(found[2]) < len(made.levels):
            raise UsageError(f"only-levels {only_levels!r} is not A-B with 0 <= A <= B <= {len(made.levels) - 1}")
        if fit:
            raise UsageError("give a fit or only-levels, not both: a fit mixes lobes over all levels")
        made = replace(made, only=(int(found[1]), int(found[2])))
    if fit and made.levels[-1][1] > 1:
        raise UnsupportedError(
            f"fit {fit!r} goes up to r = 1; the last level of this mapping is at r = {made.levels[-1][1]:.3g}"
        )
    return made
