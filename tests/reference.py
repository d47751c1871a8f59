"""Float64 truths for tests, in NumPy and in other forms than the kernels: lobes over environments, GGX's albedo
with the azimuth in closed form, the albedo of any models over light directions by tanh-sinh."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

Lobe = Callable[[np.ndarray], np.ndarray]


def gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on [0, 1], (n,) float64."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


def cube_directions(n: int) -> np.ndarray:
    """(6, n, n, 3) unit directions of texel centres, by the text of the convention: +X = (1,-t,-s), -X = (-1,-t,s),
    +Y = (s,1,t), -Y = (s,-1,-t), +Z = (s,-t,1), -Z = (-s,-t,-1)."""
    middle = 2 * (np.arange(n) + 0.5) / n - 1
    t, s = np.meshgrid(middle, middle, indexing="ij")
    one = np.ones_like(s)
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    d = np.array([np.stack(face, -1) for face in faces])
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def texel_nodes(texels: np.ndarray, rotation: float, cuts: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes of cuts x cuts Gauss points in every texel: directions (N, 3), solid angles (N,), texel indices (N,).

    texels: (h, w, 3) lat-long, Gauss in θ and φ, dω = sin θ dθ dφ; or (6, n, n, 3) cube (GL-direct), Gauss in
    the face coordinates, dω = ds dt/(1 + s² + t²)^{3/2}. rotation: radians added to the azimuth atan2(z, x).
    """
    x, w = gauss(cuts)
    if texels.ndim == 3:
        rows, columns = texels.shape[:2]
        theta, phi = (
            (np.arange(k)[:, None] + x).ravel() * (span / k) for k, span in ((rows, math.pi), (columns, 2 * math.pi))
        )
        phi = phi - math.pi
        i, j = np.repeat(np.arange(rows), cuts), np.repeat(np.arange(columns), cuts)
        weight = np.outer(
            np.tile(w, rows) * np.sin(theta) * math.pi / rows, np.tile(w, columns) * 2 * math.pi / columns
        )
        y = np.broadcast_to(np.cos(theta)[:, None], weight.shape)
        d = np.stack([np.outer(np.sin(theta), np.cos(phi)), y, np.outer(np.sin(theta), np.sin(phi))], -1)
        index = i[:, None] * columns + j
    else:
        n = texels.shape[1]
        s = (np.arange(n)[:, None] + x).ravel() * (2 / n) - 1
        t, s = np.meshgrid(s, s, indexing="ij")
        o = np.ones_like(s)
        faces = [(o, -t, -s), (-o, -t, s), (s, o, t), (s, -o, -t), (s, -t, o), (-s, -t, -o)]
        q = 1 + s * s + t * t
        d = np.stack([np.stack(face, -1) for face in faces]) / np.sqrt(q)[..., None]
        across = np.tile(w, n) * (2 / n)
        weight = np.broadcast_to(np.outer(across, across) / (q * np.sqrt(q)), (6, *q.shape))
        k = np.repeat(np.arange(n), cuts)
        index = (np.arange(6)[:, None, None] * n + k[:, None]) * n + k
    c, s_ = math.cos(rotation), math.sin(rotation)
    d = d.reshape(-1, 3)
    d = np.stack([c * d[:, 0] - s_ * d[:, 2], d[:, 1], s_ * d[:, 0] + c * d[:, 2]], 1)
    return d, weight.ravel(), index.ravel()


def exact_lobe(texels: np.ndarray, rotation: float, directions: np.ndarray, lobe: Lobe, cuts: int) -> np.ndarray:
    """∫ L K dω / ∫ K dω for each direction: (m, 3) float64, texels integrated by cuts x cuts Gauss nodes.

    directions: (m, 3) unit vectors. lobe: K as a function of s = 1 - l·r in [0, 2].
    """
    d, weight, index = texel_nodes(texels, rotation, cuts)
    radiance = texels.reshape(-1, 3).astype(np.float64)
    sums, norm = np.zeros((len(directions), 3)), np.zeros(len(directions))
    chunk = max((1 << 21) // len(directions), 1)
    for first in range(0, len(d), chunk):
        part = slice(first, first + chunk)
        K = lobe(np.maximum(1 - directions @ d[part].T, 0)) * weight[part]
        sums += K @ radiance[index[part]]
        norm += K.sum(1)
    return sums / norm[:, None]


def ggx_lobe(alpha: float) -> Lobe:
    """K(s) = (1 - s)₊ / (α² + (1 - α²) s/2)², GGX's prefilter lobe up to a factor (design.md, Definitions)."""
    return lambda s: np.maximum(1 - s, 0) / (alpha**2 + (1 - alpha**2) * s / 2) ** 2


def cosine_lobe(s: np.ndarray) -> np.ndarray:
    """(n·l)₊."""
    return np.maximum(1 - s, 0)


def ggx_lobe_norm(alpha: float) -> float:
    """∫ D(h)(n·l) dω_l in closed form: 2α²∫₀¹ (1 - s)/(α² + b s)² ds, b = (1 - α²)/2, with the antiderivatives of
    1/(α² + bs)² and s/(α² + bs)²; for α = 1 it is 2∫(1 - s) ds = 1."""
    a2, b = alpha**2, (1 - alpha**2) / 2
    if alpha == 1:
        return 1.0
    first = 1 / (a2 * (a2 + b))
    second = (math.log1p(b / a2) - b / (a2 + b)) / b**2
    return 2 * a2 * (first - second)


# ------------------------------------------------------------------------------------- GGX, 1-D


def ggx_albedo_1d(NoV: np.ndarray, alpha: np.ndarray, n: int = 96, azimuths: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """(E, Fc): albedo of GGX with height-correlated Smith and F = 1, and its Schlick part, (cells,) float64 each.

    Over l, not over half vectors. At fixed l.z the masking does not depend on azimuth and D is rational in
    cos φ: with N = (l.z + n·v)², κ = (1 - α²)N, A = (sin l - sin v)² + α²N, B = (sin l + sin v)² + α²N,
    Δ = √(AB), R = (A + B)/2, its integral over azimuth is Φ = 2α²(1 + 2κ/Δ + κ²R/Δ³), and
    E = ∫ l.z/(2(l.z S_v + n·v S_l)) Φ d(l.z) with S = √(z² + α² sin²). The Fresnel part is summed in ψ with
    tan(φ'/2) = √(A/B) tan(ψ/2), φ' = π - φ, which spreads the peak of D. θ_l runs over panels graded like sinh
    from θ_v both ways and from π/2. The pair of the split sum is (E - Fc, Fc). Error: 2e-8 for n·v and α ≥ 1e-4
    (against 1.5 times the nodes).
    """
    sv = np.sqrt((1 - NoV) * (1 + NoV))
    tv = np.arctan2(sv, NoV)
    x, w = gauss(n)
    scale = 2 * np.minimum(alpha, np.sqrt(alpha * NoV))[:, None]
    middle = (tv + math.pi / 2) / 2
    total, fresnel = np.zeros(len(NoV)), np.zeros(len(NoV))
    nv, s_v, a = NoV[:, None], sv[:, None], alpha[:, None]
    for start, sign, length in ((tv, -1, tv), (tv, 1, middle - tv), (None, -1, math.pi / 2 - middle)):
        span = np.arcsinh(length[:, None] / scale)
        off, jacobian = scale * np.sinh(span * x), scale * np.cosh(span * x) * span * w
        if start is None:  # from the horizon: cos and sin of π/2 - off, free of cancellation
            theta, lz, sl = math.pi / 2 - off, np.sin(off), np.cos(off)
            half = ((math.pi / 2 - tv)[:, None] - off) / 2
        else:
            theta = start[:, None] + sign * off
            lz, sl, half = np.cos(theta), np.sin(theta), sign * off / 2
        apart = 2 * np.cos((theta + tv[:, None]) / 2) * np.sin(half)  # sin l - sin v
        N = (lz + nv) ** 2
        A, B, k = apart**2 + a * a * N, (sl + s_v) ** 2 + a * a * N, (1 - a * a) * N
        delta = np.sqrt(A * B)
        phi = 2 * a * a * (1 + 2 * k / delta + k * k * (A + B) / 2 / delta**3)
        Sv, Sl = np.sqrt(nv * nv + a * a * s_v**2), np.sqrt(lz * lz + a * a * sl * sl)
        before = lz / (2 * (lz * Sv + nv * Sl)) * sl * jacobian
        total += (before * phi).sum(1)
        grade = np.minimum(nv + lz, 8.0)
        reach = np.arcsinh(math.pi / grade)
        for y, u in zip(*gauss(azimuths), strict=True):
            psi = math.pi - grade * np.sinh(reach * y)
            step = grade * np.cosh(reach * y) * reach / math.pi * u
            t = A / B * np.tan(psi / 2) ** 2
            q = A + (B - A) / 2 * (2 * t / (1 + t))
            VoH = np.sqrt(np.minimum((q + k) / 4, 1))
            D = a * a / math.pi * ((q + k) / q) ** 2
            fresnel += (before * 2 * math.pi * step * D * (1 - VoH) ** 5 * q / delta).sum(1)
    return total, fresnel


# ------------------------------------------------------------------------------------- any models, by tanh-sinh


def double_exponential(step: float = 1 / 12, reach: float = 3.2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tanh-sinh nodes on [0, 1]: x, 1 - x (neither cancels) and weights. They crowd at both ends beyond any scale,
    so a peak of unknown width is resolved where a panel ends at it."""
    y = math.pi / 2 * np.sinh(np.arange(-reach, reach + step / 2, step))
    x, rest = 1 / (1 + np.exp(-2 * y)), 1 / (1 + np.exp(2 * y))
    return x, rest, 2 * np.sqrt(y * y + (math.pi / 2) ** 2) * x * rest * step


def smith_area(D: Callable[[np.ndarray], np.ndarray], up: np.ndarray, step: float = 1 / 12) -> np.ndarray:
    """A(v) = ∫ D (v·m)₊ dω of a D(θ) at views `up` radians above the horizon, in θ_m with the azimuth in closed form:
    ∫ (v·m)₊ dφ = 2 (cos θv cos θm φ1 + sin θv sin θm sin φ1), cos φ1 = -cot θv cot θm."""
    x, rest, w = double_exponential(step)
    up = np.asarray(up, np.float64)[:, None]
    c, s = np.sin(up), np.cos(up)
    total = np.zeros(up.shape[0])
    for start, length, whole in ((0.0, up, True), (up, math.pi / 2 - up, False)):
        theta, left = start + length * x, (math.pi / 2 - length if whole else 0.0) + length * rest
        cos_m, sin_m = np.sin(left), np.sin(theta)
        edge = np.clip(-c * cos_m / np.maximum(s * sin_m, 1e-300), -1, 1)
        phi = np.full_like(theta, math.pi) if whole else np.arccos(edge)
        total += (D(theta) * sin_m * 2 * (c * cos_m * phi + s * sin_m * np.sin(phi)) * length * w).sum(1)
    return total


def albedo_by_tanh_sinh(
    D: Callable[..., np.ndarray],
    V: Callable[..., np.ndarray],
    F: Callable[[np.ndarray], np.ndarray],
    area: Callable[..., np.ndarray],
    NoV: float,
    phi_v: float | None = None,
    step: float = 1 / 16,
) -> float:
    """E = ∫ F(v·h) D(h) V/4 (n·l) dω_l over light directions, by tanh-sinh panels in θ_l that meet at the view's angle
    and in the azimuth that meet at the mirror direction's and opposite to it: whatever the lobe's width, its peak is
    where panels meet.

    Isotropic without `phi_v`: D(θ), area(radians above the horizon); else D(θ, φ), area(θ, φ). V as entries have it.
    """
    x, rest, w = double_exponential(step)
    above = math.asin(NoV)
    theta_v = math.pi / 2 - above
    at_v = area(np.array([above]))[0] if phi_v is None else area(np.array(theta_v), np.array(phi_v))
    away = math.pi * x
    lag = 2 * np.sin(away / 2) ** 2  # 1 - cos
    total = 0.0
    for up, apart, length in ((above + theta_v * x, theta_v * x, theta_v), (above * rest, -above * x, above)):
        NoL, sin_l = np.sin(up)[:, None], np.cos(up)[:, None]
        # l + v with v's azimuth as x: sin θv - sin θl of the mirror direction without cancellation, then what lags.
        h_x = 2 * np.cos((theta_v + math.pi / 2 - up) / 2)[:, None] * np.sin(apart / 2)[:, None] + sin_l * lag
        h_z = NoL + NoV
        at_l = area(up)[:, None] if phi_v is None else None
        for side in (1.0,) if phi_v is None else (1.0, -1.0):
            h_y = -side * sin_l * np.sin(away)
            flat = np.hypot(h_x, h_y)
            theta_h, size = np.arctan2(flat, h_z), np.hypot(flat, h_z)
            if phi_v is None:
                density, seen = D(theta_h), at_l
            else:
                density = D(theta_h, np.arctan2(h_y, h_x) + phi_v)
                theta_l = np.broadcast_to((math.pi / 2 - up)[:, None], theta_h.shape)
                seen = area(theta_l, phi_v + math.pi + side * away)
            VoH = np.minimum(size / 2, 1.0)
            value = F(VoH) * density * V(NoV, NoL, h_z / size, VoH, at_v, seen) / 4 * NoL * sin_l
            total += float(np.einsum("ij,i,j->", value, length * w, math.pi * w)) * (2 if phi_v is None else 1)
    return total


# ------------------------------------------------------------------------------------- any lobe, graded


def graded_lobe(
    texels: np.ndarray,
    rotation: float,
    direction: np.ndarray,
    density: Callable[[np.ndarray], np.ndarray],
    width: float,
    slope: float,
    tolerance: float = 1e-6,
) -> np.ndarray:
    """∫ L K dω/∫ K dω in one direction (3,): (3,) float64, for any lobe K = D(q)(1 - q/2)₊, q = |l - r|².

    Texels are halved until each cell is smaller than 0.4 of its distance to r or of `width`, D's own scale, and takes
    5 × 5 Gauss nodes (poles of K lie √6 half edges off: ρ^-10 = 4.7^-10 = 2e-7 of a cell); where it crosses the
    horizon, until the kink of slope `slope` = D(45°) leaves `tolerance` of the mean: h²/100 of a texel's radiance
    times its length.
    """
    latlong = texels.ndim == 3
    rows, columns = texels.shape[-3:-1]
    flat = texels.reshape(-1, 3).astype(np.float64)
    index = np.arange(len(flat))
    low = np.array([(index // columns) % rows, index % columns], np.float64)  # of a cell, in texels
    edge = np.ones(len(index))
    c, s_ = math.cos(rotation), math.sin(rotation)

    def directions(face: np.ndarray, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(m, 3) directions of places in texels and dω by di dj."""
        if latlong:
            theta, phi = i * math.pi / rows, j * 2 * math.pi / columns - math.pi
            d = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
            weight = np.sin(theta) * (math.pi / rows * 2 * math.pi / columns)
        else:
            t, s = 2 * i / rows - 1, 2 * j / rows - 1
            o = np.ones_like(s)
            faces = [(o, -t, -s), (-o, -t, s), (s, o, t), (s, -o, -t), (s, -t, o), (-s, -t, -o)]
            q = 1 + s * s + t * t
            d = np.choose(face[..., None], [np.stack(f, -1) for f in faces]) / np.sqrt(q)[..., None]
            weight = (2 / rows) ** 2 / (q * np.sqrt(q))
        return np.stack([c * d[..., 0] - s_ * d[..., 2], d[..., 1], s_ * d[..., 0] + c * d[..., 2]], -1), weight

    texel = math.pi / rows if latlong else 2 / rows  # radians an edge at most
    grey = flat.max(1)
    mean = max(float(grey.mean()), 1e-300)
    kink = np.clip(np.sqrt(100 * tolerance * mean / (np.maximum(grey, 1e-300) * max(slope, 1e-9) * texel)), 1e-4, 0.1)
    done: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    while len(index):
        face = index // (rows * columns)
        middle, _ = directions(face, low[0] + edge / 2, low[1] + edge / 2)
        apart, half = middle - direction, texel * edge * 0.75
        distance = np.maximum(np.sqrt((apart * apart).sum(1)) - half, 0)
        across = np.abs(middle @ direction) < half
        large = (texel * edge > 0.4 * np.maximum(width, distance)) | (across & (texel * edge > kink[index]))
        large &= edge > 1e-6
        done.append((index[~large], low[:, ~large], edge[~large]))
        index, start, size = index[large], low[:, large], edge[large] / 2
        low = np.concatenate([start + np.array([[a], [b]]) * size for a in (0, 1) for b in (0, 1)], 1)
        index, edge = np.tile(index, 4), np.tile(size, 4)
    total, weights = np.zeros(3), 0.0
    x, w = gauss(5)
    for index, low, edge in done:
        for part in np.array_split(np.arange(len(index)), max(len(index) // 20_000, 1)):
            if not len(part):
                continue
            i = low[0, part, None, None] + edge[part, None, None] * x[:, None] + 0 * x
            j = low[1, part, None, None] + edge[part, None, None] * x + 0 * x[:, None]
            d, weight = directions(np.broadcast_to((index[part] // (rows * columns))[:, None, None], i.shape), i, j)
            apart = d - direction
            q = (apart * apart).sum(-1)
            K = density(np.minimum(q, 2.0).ravel()).reshape(q.shape) * np.maximum(1 - q / 2, 0)
            K *= weight * np.outer(w, w) * edge[part, None, None] ** 2
            share = K.sum((1, 2))
            total += share @ flat[index[part]]
            weights += float(share.sum())
    return total / weights
