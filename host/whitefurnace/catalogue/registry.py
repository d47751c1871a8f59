"""Finds the catalogue entries in their folders and returns them by name; lists the integrals."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from whitefurnace.catalogue.model import Integral, Model
from whitefurnace.errors import UsageError, nearest

SLOTS = ("ndf", "masking", "fresnel", "diffuse", "light")


@cache
def models(slot: str) -> dict[str, Model]:
    """Return all models of a slot by name. Raises UsageError for an unknown slot."""
    if slot not in SLOTS:
        raise UsageError(f"unknown slot {slot!r}{nearest(slot, SLOTS)}")
    package = importlib.import_module(f"whitefurnace.catalogue.{slot}")
    found = {}
    for info in pkgutil.iter_modules(package.__path__):
        entry: Model = importlib.import_module(f"{package.__name__}.{info.name}").ENTRY
        found[entry.name] = entry
    return found


def model(slot: str, name: str) -> Model:
    """Return the model `name` of `slot`. Raises UsageError with the nearest name."""
    known = models(slot)
    if name not in known:
        raise UsageError(f"unknown {slot} {name!r}{nearest(name, known)}")
    return known[name]


INTEGRALS = {
    entry.name: entry
    for entry in (
        Integral(
            "normalization",
            "NDF normalization",
            1,
            ("NDF_D",),
            "ALL",
            False,
            "∫ D(m)(n·m) dω over the hemisphere; 1 for a normalized NDF, the raw norm of a user's",
        ),
        Integral("projected_area", "Projected area", 1, ("NDF_D",), "POLAR", True, "A(v) = ∫ D(m)(v·m)₊ dω"),
        Integral(
            "weak_furnace",
            "Weak white furnace",
            1,
            ("NDF_D", "MASKING_G1"),
            "POLAR",
            True,
            "∫ D(m) G1(v)(v·m)₊ dω / (n·v); 1 where the masking fits the NDF",
        ),
        Integral(
            "albedo",
            "Directional albedo",
            1,
            ("NDF_D", "MASKING_V", "FRESNEL_F"),
            "HALF_ANGLE",
            True,
            "E(v) = ∫ f(l, v)(n·l) dω",
        ),
        Integral(
            "albedo_average",
            "Average albedo",
            1,
            ("NDF_D", "MASKING_V", "FRESNEL_F"),
            "HALF_ANGLE",
            False,
            "2 ∫ E(μ) μ dμ",
        ),
        Integral(
            "dfg",
            "Split-sum pair",
            2,
            ("NDF_D", "MASKING_V"),
            "HALF_ANGLE",
            True,
            "(A, B) with E(v; F0) = F0·A + B, Schlick's F with F90 = 1",
        ),
        Integral(
            "radiance",
            "Reflected radiance",
            1,
            ("NDF_D", "MASKING_V", "FRESNEL_F", "LIGHT_L"),
            "LIGHT",
            True,
            "L_o(v) = ∫ f(l, v) L(l)(n·l) dω of a light or an environment",
        ),
    )
}

CLOSED = {("dfg", "ggx", "smith"): "dfg_ggx.cl", ("dfg", "ggx", "smith_separable"): "dfg_ggx.cl"}
"""Integrals that have a kernel of their own for a pair of NDF and masking, by closed forms that others do not have."""

LOBE = Integral(
    "lobe", "The prefilter's lobe", 1, ("NDF_D",), "LOBE", False, "∫ K dω of K(l·r) = D(h)(n·l) with n = v = r"
)

REFRACTION = Integral(
    "refraction",
    "Reflected and refracted",
    2,
    ("NDF_D", "MASKING_V", "MASKING_G1", "FRESNEL_F"),
    "POLAR",
    True,
    "(R, T) of a rough boundary of two insulators, of what arrives along v",
)


def integral(name: str) -> Integral:
    """Return the integral `name`. Raises UsageError with the nearest name."""
    if name not in INTEGRALS:
        raise UsageError(f"unknown integral {name!r}{nearest(name, INTEGRALS)}")
    return INTEGRALS[name]
