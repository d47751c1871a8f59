"""ABC: a power of 1 + b(1 - cos θ)."""

import numpy as np
from numpy.polynomial.legendre import leggauss

from whitefurnace.catalogue.model import Checks, Model, Paper, Parameter
from whitefurnace.catalogue.numerics import expm1_ratio
from whitefurnace.catalogue.roughness import alpha_within

B = Parameter(
    "b",
    "B",
    "1",
    0.0,
    1e8,
    (0.0, 1e-3, 1.0, 30.0, 1e4, 1e6, 1e8),
    "how narrow: D bends at 1 - cos θ = 1/b; 0 is the uniform lobe",
)
C = Parameter(
    "c",
    "C",
    "1",
    0.0,
    16.0,
    (0.0, 0.5, 1.0, 1.3, 2.0, 3.0, 16.0),
    "how steep: D falls like (1 - cos θ)^-c; 0 is the uniform lobe",
)
# α at which b of GGX's peak, 2(1/α² - 1), is the largest.
_ALPHA = Parameter("alpha", "α", "1", (2 / (B.high + 2)) ** 0.5, 1.0, (), "GGX's α of the same peak")


def _constants(b, c):
    """norm = 1/(2π I), I = ∫₀¹ (1 + bs)^-c (1 - s) ds, s = 1 - cos θ, free of the poles at c = 1 and 2 that
    [Hoffman2012]'s closed form has: with y = log(1 + bs), L = log(1 + b), φ(x) = (eˣ - 1)/x
      I = L/b φ((1 - c)L) - L/b² (φ((2 - c)L) - φ((1 - c)L)),
    whose difference loses a factor 1/b: below b = ½, 16 Gauss nodes in s.
    """
    b, c = np.broadcast_arrays(np.asarray(b, np.float64), np.asarray(c, np.float64))
    wide = np.maximum(b, 0.5)
    L = np.log1p(wide)
    first, second = expm1_ratio((1 - c) * L), expm1_ratio((2 - c) * L)
    closed = L / wide * (first - (second - first) / wide)
    small, sums = np.minimum(b, 0.5), np.zeros(b.shape)
    for x, w in zip(*leggauss(16), strict=True):
        s = (1 + x) / 2
        sums += w / 2 * (1 - s) * np.exp(-c * np.log1p(small * s))
    return {"norm": 1 / (2 * np.pi * np.where(b > 0.5, closed, sums))}


def _d(theta_m, b, c):
    """1/(1 + 2b sin²(θ/2))^c over its own integral, by tanh-sinh, whose nodes crowd at s = 0 beyond any 1/b."""
    theta_m, b, c = (np.asarray(a, np.float64) for a in (theta_m, b, c))
    norm = np.zeros(np.broadcast_shapes(b.shape, c.shape))
    # s = 1/(1 + e^-2y) and 1 - s without cancellation, y = (π/2) sinh x.
    for x in np.arange(-4.0, 4.0, 1 / 64):
        y = np.pi / 2 * np.sinh(x)
        s, rest = 1 / (1 + np.exp(-2 * y)), 1 / (1 + np.exp(2 * y))
        norm += np.pi * np.cosh(x) * s * rest / 64 * rest * (1 + b * s) ** -c
    value = (1 + b * 2 * np.sin(theta_m / 2) ** 2) ** -c / (2 * np.pi * norm)
    return np.where(np.cos(theta_m) > 0, value, 0.0)


ENTRY = Model(
    slot="ndf",
    name="abc",
    title="ABC",
    citation=Paper(
        "Low2012",
        "J. Löw et al., BRDF Models for Accurate and Efficient Rendering of Glossy Surfaces, ACM TOG 31(1), 2012",
    ),
    parameters=(B, C),
    provides=("NDF_D", "NDF_WIDTH", "NDF_REACH"),
    reference={"D": _d},
    constants=_constants,
    constant_names=("norm",),
    # GGX in disguise: (1 + b(1 - cos θ))^-2 with 2(1 - cos θ) for sin²θ.
    from_roughness=lambda r: {"b": np.minimum(2 * (1 / alpha_within(r, _ALPHA) ** 2 - 1), B.high), "c": 2.0},
    checks=Checks(normalized=True, float32_error=3.5e-6),
    notes={
        "tail": "D falls like (1 - cos θ)^-c",
        "float32": "relative error of D at most 3.5e-6 where D > 1e-7 of its peak; 2.5e-7 (1 + |log(D/peak)|) below, "
        "0 below 1e-38 of it",
        "quadrature": "normalization within 3e-7 and 9e-15, weak furnace with Smith within 1e-6 and 2e-13 "
        "(float32 and float64), over the domain and n·v from 0 to 1",
        "limits": "uniform at b = 0 or c = 0; the norm is regular at c = 1 and c = 2",
    },
)
