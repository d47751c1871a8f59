"""Spherical harmonics to degree 2: irradiance and its minimum, windows against ringing, and engines' scalings.

Coefficients are (9, 3) or (..., 9, 3): L00, L1-1, L10, L11, L2-2, L2-1, L20, L21, L22 by RGB, of a real orthonormal
basis in world x, y, z without the Condon-Shortley sign. Irradiance is E/π: a constant environment of 1 gives 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from whitefurnace.errors import InputError, UsageError, nearest

BANDS = np.array([0, 1, 1, 1, 2, 2, 2, 2, 2])
"""Degree l of each coefficient."""

COSINE = np.array([1, 2 / 3, 1 / 4])[BANDS]
"""Â_l/π, the factor by which the clamped cosine multiplies degree l of the radiance in E/π. [Ramamoorthi2001, eq. 8]"""

# Factors of 1, y, z, x, xy, yz, 3z² - 1, xz, x² - y² in the basis. [Ramamoorthi2001, eq. 3]
FACTORS = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 5 / 4, 15, 15 / 4]) / (4 * math.pi))

CONDON_SHORTLEY = np.array([1, -1, 1, -1, 1, -1, 1, -1, 1])
"""(-1)^m: converts from our basis to the one with the Condon-Shortley sign (Filament's cmgen --sh, Babylon.js)."""

CUTOFFS = (1.0, 1024.0)
"""Domain of a window's cutoff, in bands."""

_TURNS = 26
_ROUNDING = 16 * np.finfo(np.float64).eps


# --------------------------------------------------------------------------------------------- evaluation
def basis(directions: np.ndarray) -> np.ndarray:
    """Return the nine basis functions at unit directions (3, m): (9, m)."""
    x, y, z = directions
    return FACTORS[:, None] * np.stack([np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y])


def cosine(sh: np.ndarray) -> np.ndarray:
    """Return the coefficients of E/π from those of the radiance, (..., 9, 3)."""
    return np.asarray(sh, np.float64) * COSINE[:, None]


def evaluate(coefficients: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the function with coefficients (..., 9, 3) at unit directions (3, m): (..., m, 3)."""
    return np.einsum("km,...kc->...mc", basis(directions), coefficients)


def irradiance_at(sh: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return E/π at unit normals (3, m) from radiance coefficients: (..., m, 3)."""
    return evaluate(cosine(sh), directions)


# ------------------------------------------------------------------------------------------------- minimum
def polynomial(coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return c (...), b (..., 3), Q (..., 3, 3) of c + b·n + nᵀQn from coefficients (..., 9).

    Q is symmetric with trace 0.
    """
    k = np.asarray(coefficients, np.float64) * FACTORS
    b = k[..., [3, 1, 2]]
    xy, yz, zz, xz, xx_yy = (k[..., i] for i in range(4, 9))
    q = np.stack([xx_yy - zz, xy / 2, xz / 2, xy / 2, -xx_yy - zz, yz / 2, xz / 2, yz / 2, 2 * zz], -1)
    return k[..., 0], b, q.reshape(*q.shape[:-1], 3, 3)


def coefficients_of(c: np.ndarray, b: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the coefficients (..., 9) of a polynomial: the inverse of `polynomial`."""
    k = np.stack(
        [
            c,
            b[..., 1],
            b[..., 2],
            b[..., 0],
            2 * q[..., 0, 1],
            2 * q[..., 1, 2],
            q[..., 2, 2] / 2,
            2 * q[..., 0, 2],
            (q[..., 0, 0] - q[..., 1, 1]) / 2,
        ],
        -1,
    )
    return np.asarray(k / FACTORS)


def minimum(coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest value (...) over the sphere of functions with coefficients (..., 9), and its unit vectors.

    The minimum is exact, not sampled. On |n| = 1 the stationary points of c + b·n + nᵀQn are (Q - μ)n = -b/2, and the
    minimum is at the only μ ≤ λ₁, the smallest eigenvalue: the trust-region problem with its boundary
    [MoreSorensen1983]. With t = λ₁ - μ ≥ 0, δᵢ = λᵢ - λ₁ and b in the eigenvectors' basis, |n| = 1 is the secular
    equation

        g(t) = Σ bᵢ² / (2(δᵢ + t))² = 1,   where   f = c + λ₁ - t - Σ bᵢ² / (4(δᵢ + t)).

    If g(0) ≤ 1 (b has no component along the first eigenvector), t = 0 and that eigenvector completes n to unit length.
    At any t ≥ 0 the second formula is at most the minimum (Lagrange's dual), so rounding of t has an error of second
    order, and on the safe side.
    """
    c, b, q = polynomial(coefficients)
    eigenvalues, axes = np.linalg.eigh(q)
    half = np.einsum("...ij,...i->...j", axes, b) / 2
    gap = eigenvalues - eigenvalues[..., :1]
    size = np.abs(half)
    # Each term alone gives g ≤ 1 beyond |bᵢ|/2 - δᵢ, all of them together beyond |b|/2.
    low = np.maximum((size - gap).max(-1), 0.0)
    high = np.maximum(np.sqrt((half**2).sum(-1)), low)

    def step(t: np.ndarray) -> np.ndarray:
        """nᵢ at t, 0 where bᵢ = 0."""
        return np.divide(-half, gap + t[..., None], out=np.zeros_like(half), where=size > 0)

    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        inside = (step(np.zeros_like(low)) ** 2).sum(-1) <= 1
        # Newton's method on 1/|n(t)| = 1, concave and almost straight, within a shrinking bracket.
        t = np.where(inside, 0.0, low)
        for _ in range(100):
            n = step(t)
            length = np.sqrt((n * n).sum(-1))
            low, high = np.where(length >= 1, t, low), np.where(length <= 1, t, high)
            slope = np.divide(n * n, gap + t[..., None], out=np.zeros_like(n), where=size > 0).sum(-1)
            after = t + length**2 / slope * (length - 1)
            after = np.where((after >= low) & (after <= high), after, (low + high) / 2)
            after = np.where(inside, 0.0, after)
            done = bool((np.abs(after - t) <= 4 * np.finfo(float).eps * t).all())
            t = after
            if done:
                break
        energy = np.divide(half**2, gap + t[..., None], out=np.zeros_like(half), where=size > 0).sum(-1)
        n = step(t)
    least = c + eigenvalues[..., 0] - t - energy
    rest = np.sqrt(np.maximum(1 - (n[..., 1:] ** 2).sum(-1), 0))
    n[..., 0] = np.where(inside, rest, n[..., 0])
    where = np.einsum("...ij,...j->...i", axes, n)
    return least, where / np.sqrt((where**2).sum(-1, keepdims=True))


def least_irradiance(sh: np.ndarray) -> np.ndarray:
    """Return the smallest E/π of each channel over all normals, (..., 3), from radiance coefficients (..., 9, 3)."""
    return minimum(np.swapaxes(cosine(sh), -1, -2))[0]


# -------------------------------------------------------------------------------------------------- window
@dataclass(frozen=True)
class Windowed:
    """Radiance coefficients after a window, and the smallest irradiance without and with it."""

    values: np.ndarray  # (..., 9, 3)
    mode: str | float
    window: np.ndarray  # (..., 3): factor of degree 0, 1, 2
    before: np.ndarray  # (..., 3): least E/π of each channel over the sphere, without the window
    after: np.ndarray  # (..., 3): and with it


WINDOWS = ("auto", "none")
"""The named modes of a window; a number is one too."""


def sh_window(text: str) -> str | float:
    """Return the mode in the text of `--sh window=auto|none|X`. Raises UsageError."""
    name, equals, value = text.partition("=")
    if name != "window" or not equals:
        raise UsageError(f"SH option {text!r} is not window=auto, window=none or window=X")
    if value in WINDOWS:
        return value
    try:
        return _cutoff(float(value))
    except ValueError:
        raise UsageError(
            f"SH window {value!r} is neither auto nor none nor a number{nearest(value, WINDOWS)}"
        ) from None


def _cutoff(cutoff: float) -> float:
    if not CUTOFFS[0] <= cutoff <= CUTOFFS[1]:
        raise UsageError(f"SH window cutoff {cutoff:g} is outside [{CUTOFFS[0]:g}, {CUTOFFS[1]:g}] bands")
    return cutoff


def sinc_window(cutoff: float) -> np.ndarray:
    """Return the factors (3,) of a window by degree l: sinc⁴(l/X) for l < X = `cutoff`, else 0.

    It is the window of Filament's `cmgen --sh-window=X`. [Sloan2017]
    """
    degree = np.arange(3)
    return np.asarray(np.where(degree < cutoff, np.sinc(degree / cutoff) ** 4, 0.0))


def windowed(sh: np.ndarray, mode: str | float = "auto") -> Windowed:
    """Return radiance coefficients with degrees 1 and 2 damped so that their irradiance does not become negative.

    sh: (..., 9, 3). One window is used for all channels, since separate windows would change the hue.
    mode: "none" leaves them alone. A number X in [1, 1024] is `sinc_window(X)`, where a small X damps most; X ≤ 3 is
    enough for any environment without negative radiance, since it is enough for a single sun. "auto" is the window with
    factors in [0, 1] nearest to none, in RMS of E/π over sphere and channels, for which E ≥ 0 for every normal and
    channel; it is none where that holds already. As the coefficients are the projection of the irradiance, it also has
    the smallest RMSE against the true irradiance.

    Raises InputError for coefficients that are not finite, of another shape, or under "auto" with a negative mean,
    which no window mends; UsageError for another mode.
    """
    sh = np.asarray(sh)
    if sh.ndim < 2 or sh.shape[-2:] != (9, 3):
        raise InputError(f"SH coefficients have shape {sh.shape}, not (9, 3)")
    if not np.isfinite(sh).all():
        raise InputError("SH coefficients are not finite")
    before = least_irradiance(sh)
    if isinstance(mode, str):
        if mode not in WINDOWS:
            raise UsageError(f"SH window {mode!r} is neither auto nor none nor a number{nearest(mode, WINDOWS)}")
        window = np.ones((*sh.shape[:-2], 3)) if mode == "none" else _nearest(cosine(sh), before)
    else:
        window = np.broadcast_to(sinc_window(_cutoff(float(mode))), (*sh.shape[:-2], 3))
    if (window == 1).all():
        return Windowed(sh, mode, window, before, before)
    values = sh * window[..., BANDS, None]
    return Windowed(values, mode, window, before, least_irradiance(values))


def _nearest(irradiance: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Return the "auto" window, (..., 3), for coefficients of E/π (..., 9, 3) with their smallest values (..., 3).

    With f₀ the mean and f₁(n), f₂(n) the parts of degree 1 and 2 of a channel, the valid windows (w₁, w₂), f₀ + w₁f₁(n)
    + w₂f₂(n) ≥ 0 for all n, are a convex set K that contains (0, 0). Along the ray w = ρ(cos φ, sin φ) it ends at ρ =
    f₀ / -min(cos φ f₁ + sin φ f₂): one exact minimum, no search. The result is the point of K ∩ [0, 1]² with the
    smallest J = a(1 - w₁)² + b(1 - w₂)², where a and b are the bands' sums of squares. At the place n* of the minimum
    the edge of K has the normal (f₁(n*), f₂(n*)), which gives the sign of dJ/dφ along the edge. It changes once (J is
    convex and K is), so φ is bisected; after 26 steps the error is 2e-8 of φ and its square of J, and the point of
    every step lies exactly in K.
    """
    channels = np.swapaxes(irradiance, -1, -2)  # (..., 3, 9)
    mean = channels[..., 0] * FACTORS[0]
    # Rounding of sums: the largest value that an exact 0 may become.
    scale = np.abs(channels).sum(-1) * _ROUNDING
    if (mean < 0).any():
        raise InputError("the mean of an SH channel is negative, so no window makes its irradiance non-negative")
    enough = (least >= -scale).all(-1)
    power = np.stack([(channels[..., BANDS == band] ** 2).sum((-1, -2)) for band in (1, 2)], -1)  # (..., 2)
    low, high = np.zeros(enough.shape), np.full(enough.shape, math.pi / 2)
    best, cost = np.zeros((*enough.shape, 2)), np.full(enough.shape, np.inf)
    todo = not enough.all()
    for turn in range(_TURNS + 2 if todo else 0):
        # Both ends too: a set with a band that may not stay at all has its best point there.
        phi = (low + high) / 2 if turn > 1 else (low, high)[turn]
        ray = np.stack([np.cos(phi), np.sin(phi)], -1)
        ray[..., 0] = np.where(phi == math.pi / 2, 0.0, ray[..., 0])
        point, normal = _edge(channels, mean, ray)
        value = (power * (1 - point) ** 2).sum(-1)
        better = value < cost
        best, cost = np.where(better[..., None], point, best), np.where(better, value, cost)
        # The edge's direction with φ growing: at right angles to its normal, to the left of the ray.
        along = np.stack([normal[..., 1], -normal[..., 0]], -1)
        along *= np.sign(ray[..., 0] * along[..., 1] - ray[..., 1] * along[..., 0])[..., None]
        rising = -(power * (1 - point) * along).sum(-1) > 0
        if turn > 1:
            low, high = np.where(rising, low, phi), np.where(rising, phi, high)
    best = np.where(enough[..., None] | (power == 0), 1.0, best)  # a band of zeros needs no factor
    return np.concatenate([np.ones((*enough.shape, 1)), best], -1)


def _edge(channels: np.ndarray, mean: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the ray (..., 2) leaves the windows that are valid for every channel, (..., 2), and the edge's
    normal.
    """
    gain = np.concatenate([np.zeros((*ray.shape[:-1], 1)), ray], -1)[..., None, BANDS]
    least, where = minimum(channels * gain)
    with np.errstate(divide="ignore", invalid="ignore"):
        # A hair short, so that rounding does not leave E at -1e-17.
        reach = np.where(least < 0, mean / -least * (1 - _ROUNDING), np.inf)
    worst = reach.argmin(-1)[..., None]
    n = np.take_along_axis(where, worst[..., None], -2)[..., 0, :]
    chosen = np.take_along_axis(channels, worst[..., None], -2)[..., 0, :]
    parts = np.moveaxis(basis(np.moveaxis(n, -1, 0).reshape(3, -1)), 0, -1).reshape(chosen.shape) * chosen
    normal = np.stack([parts[..., BANDS == 1].sum(-1), parts[..., BANDS == 2].sum(-1)], -1)
    reach = np.take_along_axis(reach, worst, -1)[..., 0]
    with np.errstate(divide="ignore"):
        box = 1 / ray
    side = box.argmin(-1)
    boxed = box.min(-1) <= reach
    normal = np.where(boxed[..., None], -np.eye(2)[side], normal)
    return np.minimum(ray * np.minimum(reach, box.min(-1))[..., None], 1.0), normal


# --------------------------------------------------------------------------------------------------- error
def rmse_against(
    sh: np.ndarray, irradiance: np.ndarray, directions: np.ndarray, solid_angles: np.ndarray
) -> tuple[float, float]:
    """Return the relative RMSE of E/π by radiance coefficients, and its largest |error| relative to the mean.

    sh: (9, 3). irradiance: the true cube, (6, s, s, 3). directions: unit directions of its texel centres, (3, 6s²).
    solid_angles: (6s²,), steradians. 0/0 is 0.
    """
    want = np.asarray(irradiance, np.float64).reshape(-1, 3)
    weights = np.asarray(solid_angles, np.float64).reshape(-1, 1)
    wrong = irradiance_at(sh, directions) - want
    power, mean = float((weights * want**2).sum()), float((weights * np.abs(want)).sum() / (3 * weights.sum()))
    spread, worst = float((weights * wrong**2).sum()), float(np.abs(wrong).max())
    return (math.sqrt(spread / power) if spread else 0.0), (worst / mean if worst else 0.0)


# ---------------------------------------------------------------------------------------------- directions
def turned(sh: np.ndarray, matrix: Any) -> np.ndarray:
    """Return radiance coefficients (..., 9, 3) for an engine that reads our direction d at P d.

    matrix: P, a signed permutation (3, 3). L'(P d) = L(d), so b' = P b and Q' = P Q Pᵀ; the minimum does not change.
    """
    p = np.asarray(matrix, np.float64)
    if (p == np.eye(3)).all():
        return sh
    c, b, q = polynomial(np.swapaxes(sh, -1, -2))
    return np.swapaxes(coefficients_of(c, b @ p.T, p @ q @ p.T), -1, -2)


# ------------------------------------------------------------------------------------------------ scalings
def radiance(sh: np.ndarray) -> np.ndarray:
    """Return radiance coefficients unchanged."""
    return sh


def irradiance(sh: np.ndarray) -> np.ndarray:
    """Return coefficients of E with the Condon-Shortley sign, for glTF's EXT_lights_image_based.

    A constant environment of 1 gives π. The extension does not specify the sign; Babylon.js, which loads it, and `cmgen
    --sh -i` use this one.
    """
    return cosine(sh) * (math.pi * CONDON_SHORTLEY)[:, None]


def filament(sh: np.ndarray) -> np.ndarray:
    """Return the factors (..., 9, 3) by which Filament's shader multiplies 1, y, z, x, yx, yz, 3z² - 1, zx, x² - y².

    Their sum is E/π; the factors of the basis are included (libs/ibl CubemapSH::preprocessSHForShader, shaders
    Irradiance_SphericalHarmonics).
    """
    return cosine(sh) * FACTORS[:, None]


def _from_polynomial() -> np.ndarray:
    """Return the matrix (9, 9) from the polynomial in a .env file to our coefficients of Babylon.js's shading function.

    Babylon does not evaluate the polynomial. SphericalHarmonics.FromPolynomial makes harmonics of it (Condon-Shortley
    sign, constants of six digits, copied here) and divides the cosine kernel out, 3/2 and 4 for degree 1 and 2; the
    shader then evaluates those harmonics as E/π, without a kernel (@babylonjs/core 9.35, materialHelper.functions,
    harmonicsFunctions). Its own files agree, since FromHarmonics applies the kernel to E/π a second time.
    """
    x, y, z, xx, yy, zz, yz, zx, xy = np.eye(9)
    rows = [
        0.376127 * xx + 0.376127 * yy + 0.376126 * zz,
        -0.977204 * y,
        0.977204 * z,
        -0.977204 * x,
        1.16538 * xy,
        -1.16538 * yz,
        1.34567 * zz - 0.672834 * xx - 0.672834 * yy,
        -1.16538 * zx,
        1.16538 * xx - 1.16538 * yy,
    ]
    return math.pi * np.stack(rows) * CONDON_SHORTLEY[:, None]


def babylon(sh: np.ndarray) -> np.ndarray:
    """Return the nine RGB vectors x, y, z, xx, yy, zz, yz, zx, xy of a Babylon.js .env file, (..., 9, 3).

    Babylon's shader computes E/π from them. They are not the polynomial of E/π itself: see `_from_polynomial`.
    """
    return np.asarray(np.linalg.inv(_from_polynomial()) @ cosine(sh))


SCALINGS: dict[str, Callable[[Any], np.ndarray]] = {
    "radiance": radiance,
    "irradiance": irradiance,
    "filament": filament,
    "babylon": babylon,
}
"""Functions by the name that a preset gives; each takes radiance coefficients (..., 9, 3), in the engine's own axes."""


def unscaled(values: np.ndarray, scaling: str) -> np.ndarray:
    """Return radiance coefficients (..., 9, 3) from those of an engine: the inverse of SCALINGS[scaling]."""
    return np.asarray(np.linalg.inv(SCALINGS[scaling](np.eye(9))) @ values)
