"""Burley's diffuse of Disney's principled BRDF."""

import numpy as np

from whitefurnace.catalogue.bibliography import cited
from whitefurnace.catalogue.model import Checks, Model, Parameter


def _f(light, view, albedo, roughness):
    """Evaluate by θd, the angle of l and the half vector: FD90 = ½ + 2 roughness cos²θd. [Burley2012, sec. 5.3]"""
    h = light + view
    cos_d = np.sum(light * h, -1) / np.linalg.norm(h, axis=-1)
    fd90 = 0.5 + 2 * roughness * cos_d**2
    weight_l, weight_v = ((1 - d[..., 2]) ** 5 for d in (light, view))
    return albedo / np.pi * (1 - weight_l + fd90 * weight_l) * (1 - weight_v + fd90 * weight_v)


def _albedo(NoV, albedo, roughness):
    """Integrate the azimuth in closed form and the polar angle by Gauss nodes.

    With q = FD90 - 1 = r(1 + l·v) - ½ and w = (1 - n·l)⁵, f is 1 + q(w + w_v) + q² w w_v. Over azimuth l·v has the mean
    μμv and the variance (1 - μ²)(1 - μv²)/2. The remaining integrand is a polynomial of degree 8 in μ, so 5 Gauss nodes
    are exact.
    """
    x, weights = np.polynomial.legendre.leggauss(5)
    c, albedo, r = (np.asarray(a, np.float64)[..., None] for a in (NoV, albedo, roughness))
    mu, w, w_v = (x + 1) / 2, ((1 - x) / 2) ** 5, (1 - c) ** 5
    q = r * (1 + mu * c) - 0.5
    q2 = q**2 + r**2 * (1 - mu**2) * (1 - c**2) / 2
    return np.sum(weights * mu * albedo * (1 + q * (w + w_v) + q2 * w * w_v), -1)


ENTRY = Model(
    slot="diffuse",
    name="burley",
    title="Burley (Disney)",
    citation=cited("Burley2012"),
    parameters=(
        Parameter("albedo", "ρ", "1", 0.0, 1.0, (0.18, 0.8, 1.0), "base color"),
        Parameter("roughness", "r", "1", 0.0, 1.0, (0.0, 0.25, 0.5, 1.0), "perceptual roughness"),
    ),
    provides=("DIFFUSE_F",),
    reference={"f": _f, "albedo": _albedo},
    from_roughness=lambda r: {"roughness": r},
    checks=Checks(reciprocal=True, largest_albedo=785 / 504),
    notes={"energy": "at most 785/504 = 1.5576 at NoV = 0 (albedo 1, roughness 1); above 1 from roughness .40 on"},
)
