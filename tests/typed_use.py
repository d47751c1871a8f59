"""Uses the public names as a project of somebody else would; `make lint` checks that mypy knows their types."""

from __future__ import annotations

from typing import assert_type

import numpy as np

import whitefurnace as wf
from whitefurnace.results import Integrated

SKY = np.full((8, 16, 3), 0.5, np.float32)


def albedo() -> Integrated:
    return wf.integrate("albedo", ndf="ggx", NoV=[0.1, 1.0], alpha=0.25, tolerance=1e-4)


def use() -> None:
    assert_type(albedo().error, float)
    assert_type(wf.dfg(8).error, float)
    assert_type(wf.sample("ggx", 4, alpha=0.1), np.ndarray)
    wf.environment(SKY, rotate=90.0)
    assert_type(wf.prefilter(SKY, size=8, min_size=4).error, np.ndarray)
    wf.bake(SKY, "baked", size=8, min_size=4)
    wf.lut("dfg", "dfg.npy", size=8)
    wf.bake(SKY, "baked", size="large")  # type: ignore[arg-type]
    wf.lut("dfg", "dfg.npy", tolerance="fine")  # type: ignore[arg-type]
