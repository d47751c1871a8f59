"""Oren and Nayar's two-coefficient model."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter


def _f(light, view, albedo, sigma):
    """Evaluate from angles, as in the paper."""
    theta_l, theta_v = (np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2]) for d in (light, view))
    delta = np.arctan2(light[..., 1], light[..., 0]) - np.arctan2(view[..., 1], view[..., 0])
    a, b, s2 = np.maximum(theta_l, theta_v), np.minimum(theta_l, theta_v), np.square(sigma)
    lobe = np.maximum(0.0, np.cos(delta)) * np.sin(a) * np.tan(b)
    return albedo / np.pi * (1 - 0.5 * s2 / (s2 + 0.33) + 0.45 * s2 / (s2 + 0.09) * lobe)


ENTRY = Model(
    slot="diffuse",
    name="oren_nayar_qualitative",
    title="Oren-Nayar, qualitative",
    citation=cited("OrenNayar1994"),
    parameters=(
        Parameter("albedo", "ρ", "1", 0.0, 1.0, (0.18, 0.8, 1.0), "albedo of the facets"),
        Parameter(
            "sigma", "σ", "rad", 0.0, np.pi / 2, (0.0, 0.1, 0.35, 0.8, 1.57), "standard deviation of the grooves' angle"
        ),
    ),
    provides=("DIFFUSE_F",),
    reference={"f": _f},
    # The tolerance is for the reference's tangents of angles near π/2.
    checks=Checks(reciprocal=True, tolerance={"kernel f": (5e-7, 2e-12)}, largest_albedo=1.0152),
    notes={"energy": "at most 1.0152 at NoV = 0 (albedo 1, σ = .199); above 1 for σ < .33, NoV < .3"},
)
