"""EON, the energy-preserving Oren-Nayar."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Model, Paper, Parameter

_C1, _C2 = 0.5 - 2 / (3 * np.pi), 2 / 3 - 28 / (15 * np.pi)


def _fujii(c, r):
    """Albedo of Fujii's model for ρ = 1, in closed form. [Portsmouth2025]"""
    c, r = np.asarray(c, np.float64), np.asarray(r, np.float64)
    s = np.sqrt((1 - c) * (1 + c))
    with np.errstate(divide="ignore"):  # log 0 at normal view is right: s³ = 0
        rest = -np.expm1(1.5 * np.log1p(-np.square(c))) / np.maximum(c, 1e-300)  # (1 - s³)/c
    g = s * (np.arccos(c) - s * c) + 2 / 3 * (s * rest - s)
    a = 1 / (1 + _C1 * r)
    return a + r * a / np.pi * g, a * (1 + _C2 * r)


def _again(albedo, mean):
    """Return ρ of the multiple scattering."""
    return np.square(albedo) * mean / (1 - albedo * (1 - mean))


def _f(light, view, albedo, roughness):
    """Evaluate single scattering plus (1 - E(l))(1 - E(v))/(1 - Ē), as in the paper; nothing is lost at roughness 0."""
    cl, cv, r = light[..., 2], view[..., 2], np.asarray(roughness, np.float64)
    s = np.sum(light * view, -1) - cl * cv
    once = albedo / np.pi * (1 + r * np.where(s > 0, s / np.maximum(cl, cv), s)) / (1 + _C1 * r)
    (e_l, mean), (e_v, _) = _fujii(cl, r), _fujii(cv, r)
    lost = np.where(r > 0, (1 - e_l) * (1 - e_v) / np.where(r > 0, 1 - mean, 1.0), 0.0)
    return once + _again(albedo, mean) / np.pi * lost


def _albedo(NoV, albedo, roughness):
    """ρ E(v) + ρ_ms (1 - E(v)): 1 for ρ = 1."""
    e, mean = _fujii(NoV, roughness)
    return albedo * e + _again(albedo, mean) * (1 - e)


ENTRY = Model(
    slot="diffuse",
    name="eon",
    title="Energy-preserving Oren-Nayar (EON)",
    citation=Paper(
        "Portsmouth2025",
        "J. Portsmouth, P. Kutz, S. Hill, EON: A Practical Energy-Preserving Rough Diffuse BRDF, JCGT 14(1), 2025",
    ),
    parameters=(
        Parameter(
            "albedo",
            "ρ",
            "1",
            0.0,
            1.0,
            (0.18, 0.8, 1.0),
            "albedo of a single scattering; that of the surface is a little less, but 1 for 1",
        ),
        Parameter("roughness", "r", "1", 0.0, 1.0, (0.0, 0.1, 0.5, 1.0), "roughness of the grooves, 0 is Lambert"),
    ),
    provides=("DIFFUSE_F",),
    reference={"f": _f, "albedo": _albedo},
    checks=Checks(reciprocal=True, largest_albedo=1.0),
    notes={"energy": "conserving"},
)
