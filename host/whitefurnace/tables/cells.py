"""The cells of a table (models, parameters, light) and the settings of their computation, for all kinds of table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from whitefurnace.catalogue.choice import Chosen
from whitefurnace.opencl.device import Device
from whitefurnace.tables.axes import Axis, Points, columns_of


@dataclass(frozen=True)
class Lighting:
    """The light of a table of reflected radiance.

    arguments  light arguments of `whitefurnace.integrate`
    recipe     facts about an environment that a manifest states
    """

    arguments: Mapping[str, Any] = field(default_factory=dict)
    recipe: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Cells:
    """A grid of parameters of some models.

    axes    axes of the table, x first
    fixed   parameters that are one number
    points  values at which the table is computed instead of at those of its axes
    """

    models: Mapping[str, Chosen]
    axes: tuple[Axis, ...]
    fixed: Mapping[str, float]
    scheme: str | None = None
    backfacing: str | None = None
    lighting: Lighting = Lighting()
    points: tuple[Points, ...] | None = None

    @cached_property
    def columns(self) -> dict[str, np.ndarray]:
        """Return the parameters as `integrate` takes them: numbers, and arrays that broadcast to […, y, x]."""
        return self.columns_at(self.axes if self.points is None else self.points)

    def columns_at(
        self, points: Sequence[Axis | Points], models: Mapping[str, Chosen] | None = None
    ) -> dict[str, np.ndarray]:
        """Return the parameters at other values of the axes, or for other models, as `columns` does."""
        return columns_of(points, self.models if models is None else models, self.fixed)

    def columns_for(self, models: Mapping[str, Chosen]) -> dict[str, np.ndarray]:
        """Return the parameters of the same cells for other models, as `columns` does."""
        return self.columns_at(self.axes if self.points is None else self.points, models)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid, […, y, x], without channels."""
        return np.broadcast_shapes(*map(np.shape, self.columns.values()))

    @property
    def arguments(self) -> dict[str, Any]:
        """Return models, parameters and `backfacing`, as `integrate` takes them."""
        return {**self.models, **self.columns, "backfacing": self.backfacing}

    def middle(self) -> dict[str, np.ndarray] | None:
        """Return the parameters in the middle of every four texels; None unless there are two axes of at least two
        texels each.
        """
        if len(self.axes) != 2 or min(a.count for a in self.axes) < 2:
            return None
        points = []
        for one in self.axes:
            k = np.arange(one.count - 1)
            points.append(
                Points(
                    one.name, one.at((k + 1) / one.count if one.scale == "centres" else (k + 0.5) / (one.count - 1))[0]
                )
            )
        return self.columns_at(points)


@dataclass(frozen=True)
class Run:
    """Settings of a computation of cells.

    device     the device; None for a kind that needs none
    precision  32 or 64 bits
    tolerance  absolute tolerance
    relative   tolerance relative to each value, or None
    out        array to fill, or None for a new one
    progress   called with the share of the work done
    """

    device: Device
    precision: int
    tolerance: float
    out: np.ndarray | None = None
    progress: Callable[[float], None] | None = None
    relative: float | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """Return device, precision, tolerances and `out`, as `integrate` takes them."""
        relative = {} if self.relative is None else {"relative_tolerance": self.relative}
        return {
            "device": self.device,
            "precision": self.precision,
            "tolerance": self.tolerance,
            "out": self.out,
            **relative,
        }
