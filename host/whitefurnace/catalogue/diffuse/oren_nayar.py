"""Oren and Nayar's full model."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter


def _f(light, view, albedo, sigma):
    """Evaluate from angles, as in the paper."""
    theta_l, theta_v = (np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2]) for d in (light, view))
    cos_phi = np.cos(np.arctan2(light[..., 1], light[..., 0]) - np.arctan2(view[..., 1], view[..., 0]))
    a, b, s2 = np.maximum(theta_l, theta_v), np.minimum(theta_l, theta_v), np.square(sigma)
    k = s2 / (s2 + 0.09)
    c1 = 1 - 0.5 * s2 / (s2 + 0.33)
    c2 = 0.45 * k * (np.sin(a) - np.where(cos_phi < 0, (2 * b / np.pi) ** 3, 0.0))
    c3 = 0.125 * k * (4 * a * b / np.pi**2) ** 2
    once = c1 + cos_phi * c2 * np.tan(b) + (1 - np.abs(cos_phi)) * c3 * np.tan((a + b) / 2)
    twice = 0.17 * s2 / (s2 + 0.13) * (1 - cos_phi * (2 * b / np.pi) ** 2)
    return albedo / np.pi * once + np.square(albedo) / np.pi * twice


ENTRY = Model(
    slot="diffuse",
    name="oren_nayar",
    title="Oren-Nayar, full",
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
    checks=Checks(reciprocal=True, tolerance={"kernel f": (5e-7, 2e-12)}, largest_albedo=1.0511, negative=True),
    notes={
        "energy": "at most 1.0511 at NoV = 0 (albedo 1, σ = .304); above 1 for σ < .62, NoV < .31",
        "negative": "down to -.27 albedo/π where both directions graze on opposite sides, for σ near π/2 and "
        "albedo < .84",
    },
)
