"""The options of a table as a caller gives them, before they are checked."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from whitefurnace.catalogue.choice import Spec
    from whitefurnace.sphere.environments import Environment
    from whitefurnace.tables.axes import AxisSpec


@dataclass(frozen=True)
class TableRequest:
    """Every option of a table with its default; `whitefurnace.lut` documents them.

    Where `size`, `tolerance` or `scheme` is None, the kind's own value is used.
    """

    kind: str
    path: str | os.PathLike[str]
    size: int | str | Sequence[int] | None = None
    axes: Mapping[str, AxisSpec] | None = None
    ndf: Spec | None = None
    masking: Spec | None = None
    fresnel: Spec | None = None
    diffuse: Spec | None = None
    brdf: Spec | None = None
    light: Spec | None = None
    environment: str | os.PathLike[str] | np.ndarray | Environment | None = None
    normal: Sequence[float] | None = None
    rotate: float = 0.0
    exposure: float = 0.0
    bad_pixels: str = "refuse"
    layout: str | None = None
    layer: str | None = None
    fill: str | None = None
    nonfinite: str | None = None
    backfacing: str | None = None
    precision: int = 32
    tolerance: float | None = None
    relative_tolerance: float | None = None
    fit: str | None = None
    as_read: bool = False
    scheme: str | None = None
    stored: str | None = None
    for_: str | None = None
    force: bool = False
    parameters: Mapping[str, float | str] | None = None

    def lighting(self) -> list[str]:
        """Return the names of the given options that are of a light or an environment."""
        usual = {field.name: field.default for field in fields(self)}
        given = [name for name in ("light", "environment", "normal") if getattr(self, name) is not None]
        reading = ("rotate", "exposure", "bad_pixels", "layout", "layer", "fill", "nonfinite")
        return given + [name for name in reading if getattr(self, name) != usual[name]]
