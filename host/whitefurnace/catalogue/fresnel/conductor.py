"""Fresnel's equations for a metal."""

import numpy as np

from whitefurnace.catalogue.model import Kinks, Model, Paper, Parameter
from whitefurnace.catalogue.numerics import critical_angles


def _f(cos_d, eta, kappa):
    """Evaluate complex amplitudes with the root p of (η + iκ)² - sin²θ, Im p ≥ 0."""
    c = np.asarray(cos_d, np.float64)
    index = np.asarray(eta, np.float64) + 1j * np.asarray(kappa, np.float64)
    index2, p = index**2, np.sqrt((index - 1) * (index + 1) + c**2)
    tiny = 1e-300  # c = 0 and index 1: no boundary, no reflection
    r_s, r_p = (c - p) / (c + p + tiny), (index2 * c - p) / (index2 * c + p + tiny)
    return (np.abs(r_s) ** 2 + np.abs(r_p) ** 2) / 2


def _angles(NoV, eta, kappa):
    """Return the angles of the critical angle that a metal of nearly no extinction has: sin²θ = η² - κ².

    Above κ = .1 no rule of integrals meets the root.
    """
    sine2 = np.asarray((eta - kappa) * (eta + kappa))
    with np.errstate(invalid="ignore"):
        return critical_angles(NoV, np.where((sine2 > 0) & (sine2 < 1) & (kappa <= 0.1), np.sqrt(sine2), np.nan))


ENTRY = Model(
    slot="fresnel",
    name="conductor",
    title="Fresnel, conductor",
    citation=Paper(
        "BornWolf1999", "M. Born, E. Wolf, Principles of Optics, 7th edition, Cambridge University Press, 1999"
    ),
    parameters=(
        Parameter(
            "eta",
            "η",
            "1",
            1e-3,
            20.0,
            (0.05, 0.2, 1.0, 2.5, 10.0),
            "real part of the metal's index over that of this side",
        ),
        Parameter("kappa", "κ", "1", 0.0, 30.0, (0.0, 1.0, 3.0, 10.0), "imaginary part of the same: the extinction"),
    ),
    provides=("FRESNEL_F",),
    reference={"F": _f},
    limits={
        "0°": lambda eta, kappa: (1.0, ((eta - 1) ** 2 + kappa**2) / ((eta + 1) ** 2 + kappa**2)),
        "90°": lambda eta, kappa: (0.0, np.where((eta == 1) & (kappa == 0), 0.0, 1.0)),
        # κ = 0 is a dielectric. Below η = .05 Brewster's angle is the critical one to 1e-3, where any rounding counts.
        "Brewster's angle": lambda eta, kappa: (
            1 / np.hypot(1, eta),
            np.where((kappa == 0) & (eta >= 0.05), ((1 - eta**2) / (1 + eta**2)) ** 2 / 2, np.nan),
        ),
        "total internal reflection": lambda eta, kappa: (
            np.sqrt(np.maximum(1 - eta**2, 0)) / 2,
            np.where((kappa == 0) & (eta < 1), 1.0, np.nan),
        ),
    },
    kinks=Kinks(1, _angles),
    notes={
        "at 0°": "((η - 1)² + κ²)/((η + 1)² + κ²)",
        "at 90°": "1, but 0 for η = 1, κ = 0",
        "float32": "absolute error ≤ 5e-7 everywhere",
        "critical angle": "for κ = 0, η < 1, F leaves 1 like a square root: float64 beside it is good to 1e-7",
    },
)
