"""A small call of every public function. Needs neither pytest nor any extra: the plain install is tested with it."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import whitefurnace as wf

SKY = np.full((8, 16, 3), 0.5, np.float32)
SUN = SKY.copy()
SUN[2, 5] = 500.0

CALLS: dict[str, Callable[[Path], Any]] = {
    "bake": lambda folder: wf.bake(SKY, folder / "baked", size=8, min_size=4, tolerance=1e-2),
    "dfg": lambda folder: wf.dfg(8),
    "environment": lambda folder: wf.environment(SKY),
    "harmonics": lambda folder: wf.harmonics(SKY),
    "integrate": lambda folder: wf.integrate("albedo", ndf="ggx", NoV=[0.1, 1.0], alpha=0.25),
    "irradiance": lambda folder: wf.irradiance(SKY, size=4),
    "lut": lambda folder: wf.lut("dfg", folder / "dfg.npy", size=8),
    "prefilter": lambda folder: wf.prefilter(SKY, size=8, min_size=4, tolerance=1e-2),
    "sample": lambda folder: wf.sample("ggx", 16, alpha=0.25),
    "without_sun": lambda folder: wf.without_sun(wf.environment(SUN), "extract"),
}


def import_everything() -> list[ModuleType]:
    """Import every module of the package: a package that bore a public function's name would then stand over it."""
    names = [module.name for module in pkgutil.walk_packages(wf.__path__, "whitefurnace.")]
    return [importlib.import_module(name) for name in names if not name.endswith("__main__")]


def call_everything(folder: Path) -> None:
    """Call every public function once. Raises AssertionError where a name is no function or is left out here."""
    public = set(wf.__all__) - {"__version__"}
    assert set(CALLS) == public, f"public names and calls differ in {sorted(set(CALLS) ^ public)}"
    for name in sorted(public):
        assert callable(getattr(wf, name)), f"whitefurnace.{name} is {getattr(wf, name)!r}, not a function"
        CALLS[name](folder)
