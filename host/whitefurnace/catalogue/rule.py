"""Quadrature rules: Gauss nodes on [0, 1], and the ladder of product rules an integral climbs."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np


@cache
def gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on [0, 1], (n,) float64 each; exact to degree 2n - 1."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


@dataclass(frozen=True)
class Rule:
    """A product rule of `integrate.cl`: nodes in the two θ panels and in φ."""

    near: int
    far: int
    azimuths: int

    @property
    def name(self) -> str:
        return f"gauss-{self.near}+{self.far}x{self.azimuths}"

    @property
    def evaluations(self) -> int:
        return (self.near + self.far) * self.azimuths

    def tables(self) -> tuple[np.ndarray, np.ndarray]:
        """θ nodes of both panels (near + far, 2) and φ nodes (azimuths, 2), as (x, w) pairs in float64."""
        pairs = [np.stack(gauss(n), 1) for n in (self.near, self.far, self.azimuths)]
        return np.concatenate(pairs[:2]), pairs[2]


# The errors that height-correlated GGX shows against an independent 1-D form, n·v ≥ 1/256, α ≥ 1e-4, are in
# tests/test_integrate.py. Neighbours differ in every factor: the error
# of one that two rules share would not show in their difference. Each step costs about 1.5 times the one before.
LADDER = (Rule(10, 16, 8), Rule(12, 24, 10), Rule(16, 32, 12), Rule(20, 36, 16), Rule(24, 40, 16), Rule(32, 48, 24),
          Rule(40, 64, 24), Rule(56, 88, 32), Rule(80, 120, 48), Rule(112, 168, 64))
