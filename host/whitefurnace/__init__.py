"""whitefurnace: integrates BRDFs on OpenCL devices and bakes image-based lighting with a stated error.

    integrate("albedo", ndf="ggx", NoV=[0.1, 0.5, 1], alpha=0.25).values
    prefilter("studio.hdr", size=256).error

The names below are the public interface; OpenCL and image libraries are imported at their first use.
"""
from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from whitefurnace.version import VERSION

__version__ = VERSION

_HOMES = {
    "bake": "baking",
    "dfg": "run",
    "environment": "environments",
    "harmonics": "lighting",
    "integrate": "integrals",
    "irradiance": "lighting",
    "lut": "tables",
    "prefilter": "lighting",
    "sample": "sampling",
    "without_sun": "suns",
}

__all__ = ["__version__", "bake", "dfg", "environment", "harmonics", "integrate", "irradiance", "lut", "prefilter",
           "sample", "without_sun"]

if TYPE_CHECKING:
    from whitefurnace.baking import bake
    from whitefurnace.environments import environment
    from whitefurnace.integrals import integrate
    from whitefurnace.lighting import harmonics, irradiance, prefilter
    from whitefurnace.run import dfg
    from whitefurnace.sampling import sample
    from whitefurnace.suns import without_sun
    from whitefurnace.tables import lut


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"whitefurnace.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'whitefurnace' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
