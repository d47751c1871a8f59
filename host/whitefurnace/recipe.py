"""A validated choice: which models, which integral or chain, which accuracy. No OpenCL and no files."""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from whitefurnace.catalogue import Model, model
from whitefurnace.errors import UnsupportedError, UsageError, nearest

QUALITIES = {"draft": 1e-2, "normal": 1e-3, "reference": 2e-5}
SIZE_RANGE = (1, 2048)
TOLERANCE_RANGE = (1e-5, 0.5)
IRRADIANCE_SIZE = 32
DFG_SIZE = 128


@dataclass(frozen=True)
class Chosen:
    """A model and the parameters given with it (the rest follow from roughness or have defaults)."""

    model: Model
    given: Mapping[str, float]

    def canonical(self) -> dict[str, Any]:
        return {"name": self.model.name, **{k: float(v) for k, v in sorted(self.given.items())}}


def chosen(slot: str, spec: str | Model) -> Chosen:
    """A model from `NAME` or `NAME:p=v,…` or a catalogue entry. Raises UsageError with the nearest name."""
    if isinstance(spec, Model):
        return Chosen(spec, {})
    name, _, rest = spec.partition(":")
    if name.endswith(".clh"):
        raise UnsupportedError(f"{slot} {name!r}: models from a file are not supported by this version")
    entry = model(slot, name)
    known = {p.name: p for p in entry.parameters}
    given: dict[str, float] = {}
    for item in filter(None, rest.split(",")):
        key, equals, value = item.partition("=")
        if key not in known:
            raise UsageError(f"{slot} {name} has no parameter {key!r}{nearest(key, known)}")
        try:
            number = float(value)
        except ValueError:
            raise UsageError(f"{slot} {name}: {key}={value!r} is not a number") from None
        if not equals or key in given:
            raise UsageError(f"{slot} {name}: {key} must be given once, as {key}=VALUE")
        known[key].check(number, f"{slot} {name}")
        given[key] = number
    return Chosen(entry, given)


def tolerance_of(tolerance: float | None, quality: str | None) -> float:
    """The level tolerance that `--tolerance` or `--quality` asks for; 1e-3 by default."""
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


def _power_of_two(value: int, what: str) -> int:
    low, high = SIZE_RANGE
    if not (low <= value <= high and value & (value - 1) == 0):
        raise UsageError(f"{what} {value} is not a power of two in [{low}, {high}]")
    return int(value)


def roughness_of_level(k: int, levels: int) -> float:
    """Perceptual roughness of level k of n: r = 1 - √(1 - k/(n - 1)), the mapping of Filament and three.js."""
    return 0.0 if levels == 1 else 1 - math.sqrt(1 - k / (levels - 1))


@dataclass(frozen=True)
class Chain:
    """A specular chain: sizes halve from `size` to `min_size`, roughness follows the default mapping."""

    ndf: Chosen
    size: int
    min_size: int
    tolerance: float

    @property
    def levels(self) -> tuple[tuple[int, float], ...]:
        """(size, perceptual roughness) of each level."""
        n = int(math.log2(self.size // self.min_size)) + 1
        return tuple((self.size >> k, roughness_of_level(k, n)) for k in range(n))

    def parameters(self, roughness: float) -> dict[str, float]:
        """The NDF's parameters at a perceptual roughness."""
        assert self.ndf.model.from_roughness is not None
        return {**self.ndf.model.from_roughness(roughness), **self.ndf.given}

    def canonical(self) -> dict[str, Any]:
        return {"ndf": self.ndf.canonical(), "size": self.size, "min_size": self.min_size,
                "tolerance": self.tolerance, "roughness": [r for _, r in self.levels]}


def chain(*, ndf: str | Model = "ggx", size: int = 256, min_size: int = 16, tolerance: float | None = None,
          quality: str | None = None) -> Chain:
    """A validated specular chain.

    Raises UsageError for a size that is no power of two, a `min_size` over `size`, a bad tolerance or name;
    UnsupportedError for an NDF that cannot be prefiltered (anisotropic, or without a roughness).
    """
    choice = chosen("ndf", ndf)
    if not choice.model.isotropic:
        raise UnsupportedError(f"ndf {choice.model.name} is anisotropic; only isotropic NDFs can be prefiltered")
    if choice.model.from_roughness is None:
        raise UnsupportedError(f"ndf {choice.model.name} has no parameter that follows roughness")
    follows = choice.model.from_roughness(0.5)
    for name in choice.given:
        if name in follows:
            raise UsageError(f"ndf {choice.model.name}: {name} follows the roughness of each level and cannot be given")
    missing = [p.name for p in choice.model.parameters
               if p.name not in follows and p.name not in choice.given and p.default is None]
    if missing:
        raise UsageError(f"ndf {choice.model.name}: {', '.join(missing)} must be given, as "
                         f"{choice.model.name}:{missing[0]}=VALUE")
    size, min_size = _power_of_two(size, "size"), _power_of_two(min_size, "min-size")
    if min_size > size:
        raise UsageError(f"min-size {min_size} is larger than size {size}")
    return Chain(choice, size, min_size, tolerance_of(tolerance, quality))
