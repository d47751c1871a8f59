"""Axes of a table: their values, their syntax, the default axes of a table, and the parameter columns that follow."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from whitefurnace.catalogue.choice import Chosen
from whitefurnace.catalogue.numerics import held
from whitefurnace.errors import UsageError, nearest
from whitefurnace.integrals.quadrature import rows_of_roughness

SIZES = (1, 16384)
"""Smallest and largest number of values of an axis."""

SCALES = ("linear", "log", "centres", "sqrt", "f0", "angle")


@dataclass(frozen=True)
class Axis:
    """A dimension of a table: `count` values of the parameter `name` from `low` to `high`.

    scale: how the values are spaced. All scales but "centres" have the first value at `low` and the last at `high`.
        linear: equal steps of the parameter.
        log: equal steps of its logarithm.
        centres: value k is low + (k + ½)(high - low)/count, the centre of a texel.
        sqrt: equal steps of the square root of (value - low).
        f0: for an index of refraction n, equal steps of ±F0^¼ = ±√(|n - 1|/(n + 1)), with + above 1.
        angle: for a cosine, equal steps of its angle.

    `NoV` is the cosine of the view angle, and `roughness` the perceptual roughness that every model with a roughness
    follows. Any other name is a parameter of the models.
    """

    name: str
    low: float
    high: float
    count: int
    scale: str = "linear"

    def values(self) -> np.ndarray:
        """Return the (count,) values, float64."""
        if self.scale == "centres":
            return self.low + (np.arange(self.count) + 0.5) * ((self.high - self.low) / self.count)
        if self.scale == "log":
            return np.geomspace(self.low, self.high, self.count)
        if self.scale == "sqrt":
            return self.low + (self.high - self.low) * np.linspace(0, 1, self.count) ** 2
        if self.scale == "f0":
            return self._indices(np.linspace(0, 1, self.count))
        if self.scale == "angle":
            return self._cosines(np.linspace(0, 1, self.count))
        return np.linspace(self.low, self.high, self.count)

    def _cosines(self, share: np.ndarray) -> np.ndarray:
        """Return cosines at positions along an "angle" axis. The ends are exact."""
        first, last = math.acos(self.low), math.acos(self.high)
        values = np.cos(first + (last - first) * share)
        return np.where(share == 0, self.low, np.where(share == 1, self.high, values))

    def _indices(self, share: np.ndarray) -> np.ndarray:
        """Return indices of refraction at positions along an "f0" axis. The ends are exact."""
        low, high = (math.copysign(math.sqrt(abs(n - 1) / (n + 1)), n - 1) for n in (self.low, self.high))
        z = low + (high - low) * share
        indices = (1 + z * np.abs(z)) / (1 - z * np.abs(z))
        return np.where(share == 0, self.low, np.where(share == 1, self.high, indices))

    def at(self, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values and texel coordinates at positions along the axis as a GPU reads it.

        share: positions in [0, 1]. Texel coordinate 0 is the first value.
        """
        if self.scale == "log":
            values = self.low * (self.high / self.low) ** share
        elif self.scale == "f0":
            values = self._indices(share)
        elif self.scale == "angle":
            values = self._cosines(share)
        else:
            values = self.low + (self.high - self.low) * (share**2 if self.scale == "sqrt" else share)
        return values, share * self.count - 0.5 if self.scale == "centres" else share * (self.count - 1)

    def canonical(self) -> dict[str, Any]:
        """Return the axis as a manifest states it."""
        return {"name": self.name, "from": self.low, "to": self.high, "count": self.count, "scale": self.scale}

    def __str__(self) -> str:
        if self.scale == "centres" and (self.low, self.high) == (0.0, 1.0):
            return f"{self.name} = (k + ½)/{self.count}"
        return f"{self.name} = {self.low:g} … {self.high:g}, {self.count} {self.scale}"


@dataclass(frozen=True)
class Points:
    """Values of a parameter at which a table is computed instead of at those of an axis."""

    name: str
    given: np.ndarray

    def values(self) -> np.ndarray:
        """The values, float64."""
        return self.given


AxisSpec = str | Sequence[Any] | Axis
"""An axis as a caller gives it: "A:B:N" or "A:B:N:SCALE", a tuple of the same, the scale of a default axis alone, or an
`Axis`."""

Ends = tuple[float, float, int, str]
"""An axis without its name: first value, last value, count, scale."""


# ---------------------------------------------------------------------------------------------- as they are given


def axis(name: str, given: AxisSpec) -> Axis:
    """Return the axis of `A:B:N`, `A:B:N:SCALE` or a tuple of the same. Raises UsageError."""
    if isinstance(given, Axis):
        return given
    parts = given.split(":") if isinstance(given, str) else list(given)
    form = f"axis {name}: {given!r} is not A:B:N or A:B:N:SCALE"
    if len(parts) not in (3, 4):
        raise UsageError(form)
    try:
        low, high, count = _end(name, parts[0]), _end(name, parts[1]), int(parts[2])
    except (TypeError, ValueError):
        raise UsageError(form) from None
    scale = parts[3] if len(parts) == 4 else "linear"
    if scale not in SCALES:
        raise UsageError(f"axis {name}: unknown scale {scale!r}{nearest(str(scale), SCALES)}")
    if not (math.isfinite(low) and math.isfinite(high)):
        raise UsageError(f"axis {name}: its ends must be finite")
    if scale in ("log", "f0") and not (low > 0 and high > 0):
        raise UsageError(f"axis {name}: {_article(scale)} scale needs ends above 0, not {low:g} and {high:g}")
    if scale == "angle":
        low, high = (float(held(end, -1.0, 1.0)) for end in (low, high))
    if scale == "angle" and not (abs(low) <= 1 and abs(high) <= 1):
        raise UsageError(f"axis {name}: an angle scale is of cosines, from -1 to 1, not {low:g} and {high:g}")
    return Axis(name, low, high, _count(count, f"axis {name}: "), scale)


COSINES = {"NoV": (0.0, 1.0), "NoL": (-1.0, 1.0)}
"""Cosines among the parameters that are no model's own, with their domains."""


def _end(name: str, value: Any) -> float:
    """Return a number of the parameter `name`; what leaves the domain of a cosine by a rounding is its end."""
    return float(held(value, *COSINES[name])) if name in COSINES and not isinstance(value, str) else float(value)


def _article(scale: str) -> str:
    return "an f0" if scale == "f0" else f"a {scale}"


def _count(count: int, where: str = "") -> int:
    low, high = SIZES
    if not low <= count <= high:
        raise UsageError(f"{where}size {count} is outside [{low}, {high}]")
    return count


@dataclass(frozen=True)
class Size:
    """The number of cells of the default axes: `across` along x, `down` along y, and whether both were given."""

    across: int
    down: int
    both: bool


def size_of(given: int | str | Sequence[int]) -> Size:
    """Return the size of `N`, "NxM" or a pair of numbers. Raises UsageError."""
    items: list[Any] = (
        given.lower().replace("×", "x").split("x")
        if isinstance(given, str)
        else list(given)
        if isinstance(given, Sequence)
        else [given]
    )
    try:
        counts = [_count(int(item)) for item in items]
    except (TypeError, ValueError):
        counts = []
    if len(counts) not in (1, 2):
        raise UsageError(f"size {given!r} is not N or NxM")
    return Size(counts[0], counts[-1], len(counts) == 2)


def named(option: str, given: Sequence[str]) -> dict[str, str]:
    """Return values by name from items `NAME=VALUE`.

    option: the option they come from, "--axis", "axis", "--set" or "set", for error messages. Raises UsageError.
    """
    found: dict[str, str] = {}
    for item in given:
        name, equals, value = item.partition("=")
        if not (name.isidentifier() and equals and value) or name in found:
            form = "NAME=A:B:N[:SCALE]" if option.endswith("axis") else "NAME=VALUE"
            raise UsageError(f"{option} {item!r}: {name or 'a name'} must be given once, as {form}")
        found[name] = value
    return found


def named_axes(option: str, given: Sequence[str]) -> dict[str, str]:
    """Return axes by name from items `NAME=AXIS`. A scale alone, such as "sqrt", is that of NoV.

    option: the option they come from, for error messages. Raises UsageError.
    """
    return named(option, [f"NoV={item}" if item in SCALES else item for item in given])


def number(name: str, value: Any) -> float:
    """Return the value of a fixed parameter as a finite number. Raises UsageError."""
    try:
        found = _end(name, value)
    except (TypeError, ValueError):
        hint = (
            f"; give a range as an axis, {name}={value}"
            if isinstance(value, str) and ":" in value
            else "; RGB goes with its model, as schlick:f0=1/.71/.29"
            if isinstance(value, str) and "/" in value
            else ""
        )
        raise UsageError(f"{name}={value!r} is not a number{hint}") from None
    if not math.isfinite(found):
        raise UsageError(f"{name}={value!r} is not finite")
    return found


# ---------------------------------------------------------------------------------------------- which a table has


def centred(size: Size) -> dict[str, Axis]:
    """Return the default axes of most tables: x is NoV and y roughness, both at the centres of texels."""
    return {
        "NoV": Axis("NoV", 0.0, 1.0, size.across, "centres"),
        "roughness": Axis("roughness", 0.0, 1.0, size.down, "centres"),
    }


def usual_beside(
    usual: Mapping[str, Ends], given: Mapping[str, Any], fixed: Mapping[str, float], slot: str = "fresnel"
) -> dict[str, Any]:
    """Return the given axes, after those of `usual` that are neither given nor fixed.

    usual: default ranges of the parameters of `slot`. given: axes by name. fixed: parameters that stay at one number.
    A parameter may be named by itself or as SLOT_NAME.
    """
    taken = {*given, *fixed}
    return {**{name: ends for name, ends in usual.items() if not {name, f"{slot}_{name}"} & taken}, **given}


def over_first_parameter(choice: Chosen, fixed: Collection[str], count: int) -> dict[str, Axis]:
    """Return an axis over the first parameter of a model that has no value.

    It covers the parameter's domain if that ends at 1, otherwise the range of its typical values. fixed: names of
    parameters that have values. count: number of values.
    """
    free = [
        p
        for p in choice.model.parameters
        if p.default is None
        and p.name not in choice.given
        and not {p.name, f"{choice.model.slot}_{p.name}"} & set(fixed)
    ]
    ends = {p.name: (p.low, p.high) if p.high <= 1 else (min(p.typical), max(p.typical)) for p in free[:1]}
    return {name: Axis(name, *both, count) for name, both in ends.items()}


def following(choice: Chosen, taken: Collection[str]) -> list[str]:
    """Return the parameters of a model that follow roughness, except those in `taken`."""
    entry = choice.model
    follow = entry.from_roughness(0.5) if entry.from_roughness else {}
    return [
        name
        for name in follow
        if name not in choice.given
        and f"{entry.slot}_{name}" not in taken
        and (name not in taken or name == "roughness")
    ]


def placed(
    default: Mapping[str, Axis],
    size: Size,
    view: bool,
    models: Mapping[str, Chosen],
    axes: Mapping[str, AxisSpec],
    fixed: Mapping[str, float],
) -> tuple[Axis, ...]:
    """Return the axes of a table in their order, x first.

    default: the table's own axes in their order. An axis that is fixed is dropped, and so are NoV where the integral
    has no view and roughness where no model follows it.
    axes: the given axes, by name. An axis with the name of a default axis replaces it in its place, or changes its
    scale; the others come after and vary more slowly.

    Raises UsageError.
    """
    scaled = {name: str(given) for name, given in axes.items() if isinstance(given, str) and given in SCALES}
    explicit = {name: axis(name, given) for name, given in axes.items() if name not in scaled}
    for name in explicit:
        if name in fixed:
            raise UsageError(f"{name} is given both as a number and as an axis")
    taken = {*explicit, *fixed}
    wanted = {
        "NoV": view and "NoV" not in fixed,
        "roughness": "roughness" not in fixed and any(following(choice, taken) for choice in models.values()),
    }
    found = {name: one for name, one in default.items() if wanted.get(name, name not in fixed)}
    for name, scale in scaled.items():
        if name not in found:
            raise UsageError(f"axis {name}: no default axis has that name; give A:B:N:{scale}")
        if scale in ("log", "f0"):
            raise UsageError(f"axis {name}: {_article(scale)} scale needs ends above 0; give A:B:N:{scale}")
        found[name] = replace(found[name], scale=scale)
    for name, one in sorted(default.items()) if size.both else ():
        if name not in found or name in explicit:
            raise UsageError(
                f"size {size.across}x{size.down}: there is no default axis {name} for the {one.count}; give one number"
            )
    return (
        *(explicit.get(name, one) for name, one in found.items()),
        *(one for name, one in explicit.items() if name not in found),
    )


def columns_of(
    axes: Sequence[Axis | Points], models: Mapping[str, Chosen], fixed: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Return the parameters that `integrate` takes: numbers, and arrays that broadcast to […, y, x]. Raises
    UsageError.
    """
    dimensions = max(len(axes), 2)  # [y, x] at least
    columns = {name: np.array(value) for name, value in fixed.items()}
    for k, one in enumerate(axes):
        columns[one.name] = one.values().reshape([-1 if dimensions - 1 - k == d else 1 for d in range(dimensions)])
    taken = set(columns)
    values = columns.pop("roughness", None)
    if values is not None:
        rows: dict[str, np.ndarray] = {}
        for choice in models.values():
            follow = following(choice, taken)
            if follow:
                rows |= {
                    name: row
                    for name, row in rows_of_roughness(choice, values).items()
                    if name.removeprefix(f"{choice.model.slot}_") in follow
                }
            elif any(p.name == "roughness" for p in choice.model.parameters) and "roughness" not in choice.given:
                rows[f"{choice.model.slot}_roughness"] = values
        if not rows:
            raise UsageError("roughness: no model follows it with a parameter that is not given otherwise")
        columns |= rows
    return columns
