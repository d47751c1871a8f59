"""Light under a surface: measured media, the reflectance of a half-space, and how far light travels before it leaves.

Lengths are in millimetres and coefficients per millimetre, as in the papers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

JENSEN: Mapping[str, tuple[tuple[float, float, float], tuple[float, float, float], float]] = {
    "apple": ((2.29, 2.39, 1.97), (0.0030, 0.0034, 0.046), 1.3),
    "chicken1": ((0.15, 0.21, 0.38), (0.015, 0.077, 0.19), 1.3),
    "chicken2": ((0.19, 0.25, 0.32), (0.018, 0.088, 0.20), 1.3),
    "cream": ((7.38, 5.47, 3.15), (0.0002, 0.0028, 0.0163), 1.3),
    "ketchup": ((0.18, 0.07, 0.03), (0.061, 0.97, 1.45), 1.3),
    "marble": ((2.19, 2.62, 3.00), (0.0021, 0.0041, 0.0071), 1.5),
    "potato": ((0.68, 0.70, 0.55), (0.0024, 0.0090, 0.12), 1.3),
    "skimmilk": ((0.70, 1.22, 1.90), (0.0014, 0.0025, 0.0142), 1.3),
    "skin1": ((0.74, 0.88, 1.01), (0.032, 0.17, 0.48), 1.3),
    "skin2": ((1.09, 1.59, 1.79), (0.013, 0.070, 0.145), 1.3),
    "spectralon": ((11.6, 20.4, 14.9), (0.0, 0.0, 0.0), 1.3),
    "wholemilk": ((2.55, 3.21, 3.77), (0.0011, 0.0024, 0.014), 1.3),
}
"""Reduced scattering and absorption, RGB, and the index of refraction. [Jensen2001, figure 5]"""

WATER = (0.340e-3, 0.0565e-3, 0.00922e-3)
"""Absorption of pure water at 650, 550 and 450 nm. [PopeFry1997]"""

AIR = (5.8e-9, 13.5e-9, 33.1e-9)
"""Rayleigh scattering of air at sea level at 680, 550 and 440 nm. [Bruneton2008]"""

SKIN = (
    (0.0064, (0.233, 0.455, 0.649)),
    (0.0484, (0.100, 0.336, 0.344)),
    (0.187, (0.118, 0.198, 0.0)),
    (0.567, (0.113, 0.007, 0.007)),
    (1.99, (0.358, 0.004, 0.0)),
    (7.41, (0.078, 0.0, 0.0)),
)
"""Skin as Gaussians: variances in mm² and weights in RGB, which sum to 1 in each. [dEonLuebke2007, table 14-1]"""


def diffuse_reflectance(scattering: Any, absorption: Any, ior: float) -> np.ndarray:
    """Return the diffuse reflectance of a half-space in [0, 1], by the integral of the dipole.

    scattering, absorption: reduced scattering and absorption, ≥ 0, both in the same unit of 1/length. ior: index of
    refraction. The value is ½ α' (1 + e^(-4/3 A √(3(1 - α')))) e^(-√(3(1 - α'))), A = (1 + F_dr)/(1 - F_dr).
    [Jensen2001, after eq. 4]
    """
    scattering, absorption = np.asarray(scattering, np.float64), np.asarray(absorption, np.float64)
    # α' = 1/(1 + σa/σs'), which has a value where either is 0 or infinite; 0/0, which does nothing, reflects nothing.
    with np.errstate(divide="ignore", invalid="ignore"):
        reduced = np.where(scattering > 0, 1 / (1 + absorption / scattering), 0.0)
        lost = np.where(
            scattering > 0, np.where(np.isinf(absorption), 1.0, absorption / (absorption + scattering)), 1.0
        )
    root, image = np.sqrt(3 * lost), _image(ior)
    return np.asarray(0.5 * reduced * (np.exp(-root) + np.exp(-image * root)))


def _image(ior: float) -> float:
    """The height of the dipole's image over the surface, 1 + 4/3 A mean free paths; its source is 1 below."""
    # A fit that is .0016 where nothing is reflected.
    internal = max(-1.440 / ior**2 + 0.710 / ior + 0.668 + 0.0636 * ior, 0.0) if ior > 1 else 0.0
    return 1 + 4 / 3 * (1 + internal) / (1 - internal)


def beyond(radius: Any, lost: Any, ior: float) -> np.ndarray:
    """Return the share of the reflected light that leaves farther than `radius` from where it entered, by the dipole.

    radius: distance in mean free paths. lost: 1 - α', the share absorbed at each collision, in [0, 1]. ior: index of
    refraction.

    The share is (z_r e^(-σ d_r)/d_r + z_v e^(-σ d_v)/d_v)/(e^(-σ z_r) + e^(-σ z_v)), σ = √(3(1 - α')), d = √(r² + z²),
    since the flux z (1 + σd) e^(-σd)/(4π d³) of each source is -∂/∂d of z e^(-σd)/(4π d) over d. [Jensen2001, eq. 4]

    The radius that 95 % of the light stays within agrees with a random walk with Fresnel's boundary to 12 % for α' of
    at least .7 (tests/scenes/test_scale.py), and is a third too long at α' = .3. Christensen and Burley's profile,
    which was fitted without a boundary, gives half of it.
    """
    root = np.sqrt(3 * np.asarray(lost, np.float64))
    radius = np.asarray(radius, np.float64)
    image = _image(ior)
    left = sum(z * np.exp(-root * np.hypot(radius, z)) / np.hypot(radius, z) for z in (1.0, image))
    return np.asarray(left / (np.exp(-root) + np.exp(-root * image)))


def within(share: float, lost: Any, ior: float) -> np.ndarray:
    """Return the radius in mean free paths within which `share` of the reflected light leaves; see `beyond`."""
    lost = np.asarray(lost, np.float64)
    low, high = np.full(lost.shape, -20.0), np.full(lost.shape, 20.0)
    for _ in range(60):
        middle = (low + high) / 2
        far = beyond(np.exp(middle), lost, ior) > 1 - share
        low, high = np.where(far, middle, low), np.where(far, high, middle)
    return np.asarray(np.exp((low + high) / 2))


def shape(albedo: Any) -> np.ndarray:
    """Return the ratio of the mean free path to d of Christensen and Burley's profile, for light along the normal.

    albedo: the diffuse reflectance in [0, 1]. [ChristensenBurley2015, eq. 5]
    """
    albedo = np.asarray(albedo, np.float64)
    return 1.85 - albedo + 7 * np.abs(albedo - 0.8) ** 3


@dataclass(frozen=True)
class Gaussians:
    """A diffusion profile as a sum of Gaussians: `variances` (n,) in mm², `weights` (n, 3)."""

    variances: np.ndarray
    weights: np.ndarray

    @property
    def least(self) -> float:
        """Length in mm over which the line spread is still nearly constant."""
        return float(np.sqrt(self.variances.min())) / 8

    @property
    def widest(self) -> float:
        """Upper bound of the mean distance that light travels, in mm."""
        return float(np.sqrt(self.variances.max()))

    def line_spread(self, distance: np.ndarray) -> np.ndarray:
        """Return the light that reaches a line at a distance from the line where light enters, (…, 3).

        distance: in mm. The value is ∫ R(√(x² + y²)) dy up to a factor: the same Gaussians in one dimension.
        """
        x2 = np.square(distance)[..., None]
        return np.asarray((np.exp(x2 * (-0.5 / self.variances)) / np.sqrt(self.variances)) @ self.weights)


@dataclass(frozen=True)
class Burley:
    """Christensen and Burley's profile R = A (e^(-r/d) + e^(-r/3d))/(8π d r) of `d`, (3,) in mm.
    [ChristensenBurley2015, eq. 3]"""

    d: np.ndarray

    @property
    def least(self) -> float:
        # The line spread grows like log 1/x, so the first panel, which is inexact, must be as short as this.
        """Length in mm of the first panel of a quadrature, over which the line spread may be inexact."""
        return 1e-13 * float(self.d.min())

    @property
    def widest(self) -> float:
        """Upper bound of the mean distance that light travels, in mm."""
        return 3 * float(self.d.max())

    def line_spread(self, distance: np.ndarray) -> np.ndarray:
        """Return the line spread, (…, 3) up to a factor.

        distance: in mm. ∫ e^(-√(x² + y²)/d)/√(x² + y²) dy = 2 K₀(x/d), so the value is K₀(x/d) + K₀(x/3d).
        """
        x = np.asarray(distance)[..., None] / self.d
        return np.asarray((special.k0(x) + special.k0(x / 3)) / self.d)


@dataclass(frozen=True)
class Dipole:
    """Jensen's dipole for a mean free path `path`, (3,) in mm, and `lost` = 1 - α', (3,)."""

    path: np.ndarray
    lost: np.ndarray
    ior: float

    @property
    def least(self) -> float:
        """Length in mm over which the line spread is still nearly constant."""
        return float(self.path.min()) / 8

    @property
    def widest(self) -> float:
        # Without absorption the mean distance is infinite, by a logarithm.
        """Upper bound of the distance that light travels, in mm."""
        return 100 * float(self.path.max())

    def line_spread(self, distance: np.ndarray) -> np.ndarray:
        """Return the line spread, (…, 3) up to a factor.

        distance: in mm. -∂/∂z ∫ e^(-σd)/d dy = -∂/∂z 2 K₀(σρ) = 2σ z/ρ K₁(σρ), ρ = √(x² + z²), for source and image.
        """
        x, root = np.asarray(distance)[..., None] / self.path, np.sqrt(3 * self.lost)
        total = np.zeros(x.shape)
        for z in (1.0, _image(self.ior)):
            rho = np.hypot(x, z)
            # σρ K₁(σρ) is 1 where σ is 0.
            bent = root * rho
            total += z / rho**2 * np.where(bent > 0, bent * special.k1(np.where(bent > 0, bent, 1.0)), 1.0)
        return total


Profile = Gaussians | Burley | Dipole


def skin() -> Gaussians:
    """Return the profile of skin. [dEonLuebke2007, table 14-1]"""
    return Gaussians(np.array([v for v, _ in SKIN]), np.array([w for _, w in SKIN]))
