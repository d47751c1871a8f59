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
    "bake": "baking.bake",
    "dfg": "integrals.quadrature",
    "environment": "sphere.environments",
    "harmonics": "prefiltering.lighting",
    "integrate": "integrals.api",
    "irradiance": "prefiltering.lighting",
    "lut": "tables.lut",
    "prefilter": "prefiltering.lighting",
    "sample": "integrals.normals",
    "without_sun": "sphere.suns",
}

__all__ = [
    "__version__",
    "bake",
    "dfg",
    "environment",
    "harmonics",
    "integrate",
    "irradiance",
    "lut",
    "prefilter",
    "sample",
    "without_sun",
]

if TYPE_CHECKING:
    from whitefurnace.baking.bake import bake
    from whitefurnace.integrals.api import integrate
    from whitefurnace.integrals.normals import sample
    from whitefurnace.integrals.quadrature import dfg
    from whitefurnace.prefiltering.lighting import harmonics, irradiance, prefilter
    from whitefurnace.sphere.environments import environment
    from whitefurnace.sphere.suns import without_sun
    from whitefurnace.tables.lut import lut


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"whitefurnace.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'whitefurnace' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
