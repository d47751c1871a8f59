"""The options of a bake as a caller gives them, before they are checked."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from whitefurnace.prefiltering.recipe import CERTIFIED

if TYPE_CHECKING:
    import numpy as np

    from whitefurnace.catalogue.choice import Spec
    from whitefurnace.sphere.environments import Environment

    Source: TypeAlias = str | os.PathLike[str] | np.ndarray | Environment


@dataclass(frozen=True)
class BakeRequest:
    """Every option of a bake with its default; `whitefurnace.bake` documents them.

    Where `size`, `min_size`, `levels` or `table` is None, the engine's own value is used. `nonfinite` is the older name
    of `bad_pixels`.
    """

    sources: Sequence[Source]
    output: str | os.PathLike[str]
    for_: str = "raw"
    size: int | None = None
    min_size: int | None = None
    levels: int | None = None
    only_levels: str | None = None
    without: str | Sequence[str] = ()
    table: int | None = None
    ndf: Spec = "ggx"
    tolerance: float | None = None
    quality: str | None = None
    samples: int | None = None
    certify: int = CERTIFIED
    fit: str | None = None
    as_read: bool = False
    rotate: float = 0.0
    exposure: float = 0.0
    bad_pixels: str = "refuse"
    layout: str | None = None
    layer: str | None = None
    fill: str | None = None
    nonfinite: str | None = None
    sun: str = "keep"
    sh: str | None = None
    force: bool = False
