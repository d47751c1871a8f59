"""Quadrature rules: Gauss nodes on [0, 1], and the sequences of finer and finer product rules that integrals use."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np


@cache
def gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss-Legendre nodes and weights on [0, 1], (n,) float64 each; exact to degree 2n - 1."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


@dataclass(frozen=True)
class Rule:
    """A product of Gauss rules over the polar angle and the azimuth.

    family: key of the sequence of rules that it belongs to. near, far: number of nodes in the two polar panels; near is
    0 where there is one panel. azimuths: number of nodes in each of `panels` azimuth panels. For `light-angles` the
    panels are polar, and the azimuths are the midpoints of a quarter turn.
    """

    family: str
    near: int
    far: int
    azimuths: int
    panels: int = 1

    @property
    def name(self) -> str:
        """Name of the rule as results state it, such as `gauss-16+32x12`."""
        polar = f"{self.near}+{self.far}" if self.near else f"{self.far}"
        return f"{self.family}-{polar}x{self.azimuths if self.panels == 1 else f'{self.panels}*{self.azimuths}'}"

    @property
    def evaluations(self) -> int:
        """Number of evaluations of the integrand for one cell."""
        return (self.near + self.far) * self.azimuths * self.panels

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of polar nodes as kernels take them: of the first panel where there are two, then of all."""
        return (self.near, self.near + self.far) if self.near else (self.far,)

    def tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Return polar nodes (near + far, 2) and azimuth nodes (azimuths, 2), as (x, weight) pairs in float64.

        For `light-angles` the azimuths are (sin, 1 - sin) pairs instead, whose weights are equal.
        """
        if self.family == "light-angles":
            left = (self.azimuths - 0.5 - np.arange(self.azimuths)) * (np.pi / 2 / self.azimuths)
            return np.stack(gauss(self.far), 1), np.stack([np.cos(left), 2 * np.sin(left / 2) ** 2], 1)
        pairs = [np.stack(gauss(n), 1) for n in (self.near, self.far, self.azimuths) if n]
        return np.concatenate(pairs[:-1]), pairs[-1]


def _ladder(family: str, panels: int, *steps: tuple[int, int, int]) -> tuple[Rule, ...]:
    return tuple(Rule(family, *step, panels) for step in steps)


# The errors that height-correlated GGX shows against an independent 1-D form, n·v ≥ 1/256, α ≥ 1e-4, are in
# tests/integrals/test_integrate.py. Neighbours differ in every factor: the error of one that two rules share would not
# show in their difference. Each step costs about 1.5 times the one before.
LADDERS = {
    # ring.clh: an NDF of the polar angle
    "gauss": _ladder(
        "gauss",
        1,
        (10, 16, 8),
        (12, 24, 10),
        (16, 32, 12),
        (20, 36, 16),
        (24, 40, 18),
        (32, 48, 24),
        (40, 64, 26),
        (56, 88, 32),
        (80, 120, 48),
        (112, 168, 64),
        (160, 240, 96),
    ),
    # kinked.cl: panels between the kinks, in both angles
    "kinked": _ladder(
        "kinked",
        1,
        (0, 8, 5),
        (0, 10, 6),
        (0, 12, 8),
        (0, 16, 11),
        (0, 20, 14),
        (0, 28, 20),
        (0, 40, 28),
        (0, 56, 40),
        (0, 80, 56),
        (0, 120, 80),
    ),
    # dfg_ggx.cl: three panels over the light's polar angle, an azimuth in closed form but for Schlick's part
    "light-angles": _ladder(
        "light-angles",
        3,
        (0, 10, 9),
        (0, 12, 10),
        (0, 14, 11),
        (0, 18, 13),
        (0, 22, 16),
        (0, 28, 24),
        (0, 36, 36),
        (0, 48, 64),
    ),
    # glass.cl: three panels for reflected light, four for refracted light
    "refraction": _ladder(
        "refraction",
        7,
        (0, 8, 8),
        (0, 10, 10),
        (0, 12, 14),
        (0, 16, 18),
        (0, 20, 24),
        (0, 28, 32),
        (0, 36, 40),
        (0, 48, 56),
        (0, 64, 72),
        (0, 96, 104),
        (0, 144, 144),
    ),
    # ring.clh without an azimuth: normalization
    "polar": _ladder(
        "polar",
        1,
        (12, 12, 1),
        (16, 18, 1),
        (20, 24, 1),
        (28, 32, 1),
        (40, 44, 1),
        (56, 64, 1),
        (80, 88, 1),
        (112, 128, 1),
        (168, 192, 1),
        (256, 288, 1),
    ),
    # stretched.cl: anisotropic NDFs
    "stretched": _ladder(
        "stretched",
        4,
        (0, 10, 5),
        (0, 14, 7),
        (0, 20, 10),
        (0, 28, 13),
        (0, 36, 18),
        (0, 48, 24),
        (0, 64, 32),
        (0, 88, 44),
        (0, 120, 64),
        (0, 168, 96),
    ),
    # hemisphere.cl: diffuse models, and BRDFs of whom nothing is known
    "hemisphere": _ladder(
        "hemisphere",
        2,
        (8, 8, 6),
        (10, 12, 8),
        (14, 16, 10),
        (20, 24, 14),
        (28, 32, 18),
        (40, 44, 26),
        (56, 64, 36),
        (80, 88, 48),
        (112, 128, 64),
        (168, 192, 96),
    ),
    "half-vectors": _ladder(
        "half-vectors",
        4,
        (10, 16, 4),
        (14, 24, 6),
        (20, 32, 8),
        (28, 44, 12),
        (40, 64, 16),
        (56, 88, 24),
        (80, 120, 32),
        (112, 168, 48),
        (160, 240, 64),
    ),
}

AREA_RULES = {
    32: (Rule("polar", 80, 120, 1), Rule("polar", 112, 168, 1)),
    64: (Rule("polar", 160, 240, 1), Rule("polar", 224, 320, 1)),
}
"""The rules of the table of Smith's area by precision: the second makes the table, the first gives its error estimate.
"""

AVERAGE_RULES = (12, 18, 26, 36, 52, 76)
"""Nodes in n·v of an average albedo, after μ = x², which resolves the grazing end."""
