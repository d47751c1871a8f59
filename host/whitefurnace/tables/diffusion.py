"""Pre-integrated diffusion: diffuse light on a curved body of a translucent medium, by curvature. [Penner2011]

It is computed in numpy and not by a kernel: for each curvature the integral is a sum of a few hundred values of the
profile, with weights that are the same in all rows, so a table is one product of two matrices.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from whitefurnace.catalogue import integral
from whitefurnace.catalogue.numerics import held
from whitefurnace.catalogue.rule import gauss
from whitefurnace.catalogue.subsurface import Burley, Dipole, Gaussians, Profile, shape, skin
from whitefurnace.errors import UsageError, nearest
from whitefurnace.integrals.quadrature import TableSpec, missed, room_for
from whitefurnace.results import Integrated
from whitefurnace.scenes.scale import MEDIA, Medium

AXES = ("NoL", "curvature")

CHANNELS = ("r", "g", "b")
OF_COEFFICIENTS = ("absorption", "scattering")
OF_ALBEDO = ("albedo", "mfp")
DOMAINS = {
    "absorption": (0.0, 1e6),
    "scattering": (0.0, 1e6),
    "albedo": (1e-3, 1.0),
    "mfp": (1e-9, 1e9),
    "g": (-0.99, 0.99),
    "ior": (1.0, 3.0),
}

NODES = (14, 20)
"""Gauss nodes of a panel: those of the error estimate, and those of the rule whose values are kept."""

LEFT = {32: 3e-8, 64: 1e-14}
"""Rounding error by precision: that of the format in float32, that of the sums in float64."""

FLAT = 1e-13
"""Width of the profile on a circle of radius 1 below which the body counts as flat; this changes D by as much."""

ROWS, COLUMNS = 64, 1024
"""Curvatures and cosines that are computed at once, in some ten MB."""


def profile(scheme: str | None, given: Mapping[str, float]) -> Profile:
    """Return the profile of a scheme and its parameters. Raises UsageError.

    "dipole" takes `absorption` and `scattering` per mm, `g` and `ior`. "burley" takes the same, or instead `albedo`
    (diffuse reflectance in [0, 1]) and `mfp` (mean free path in mm, 1 unless given). `albedo_r` is the value of red;
    `albedo` is that of all channels without their own.
    """
    if scheme == "skin" or scheme is None:
        _only((), given, "skin")
        return skin()
    if scheme not in ("burley", "dipole"):
        _only((), given, scheme)
        return _dipole(MEDIA[scheme])
    groups = (OF_ALBEDO, OF_COEFFICIENTS) if scheme == "burley" else (OF_COEFFICIENTS,)
    names = {
        f"{name}{suffix}" for group in groups for name in group for suffix in ("", *(f"_{c}" for c in CHANNELS))
    } | {"g", "ior"}
    _only(names, given, scheme)
    given = {name: float(held(value, *DOMAINS[name.rsplit("_", 1)[0]])) for name, value in given.items()}
    for name, value in given.items():
        low, high = DOMAINS[name.rsplit("_", 1)[0]]
        if not low <= value <= high:
            raise UsageError(f"{name} {value:g} is outside [{low:g}, {high:g}]")
    if scheme == "burley":
        either = [{name for name in given if name.split("_")[0] in group} for group in groups]
        if all(either) or not any(either) or (either[0] and {"g", "ior"} & set(given)):
            raise UsageError(
                "burley is of albedo and mfp, or of absorption, scattering, g and ior: give one or the other"
            )
        if either[0]:
            return Burley(_rgb("mfp", given, 1.0) / shape(_rgb("albedo", given)))
    absorption, scattering = ([float(1e3 * v) for v in _rgb(name, given)] for name in OF_COEFFICIENTS)
    if min(scattering) == 0:
        raise UsageError("a channel without scattering has no diffusion: scattering must be above 0 in each")
    medium = Medium((*absorption,), (*scattering,), given.get("g", 0.0), given.get("ior", 1.5))  # type: ignore[arg-type]
    if scheme == "dipole":
        return _dipole(medium)
    return Burley(1e3 * np.array(medium.mean_free_path) / shape(medium.albedo))


def _dipole(medium: Medium) -> Dipole:
    return Dipole(1e3 * np.array(medium.mean_free_path), np.array(medium.lost), medium.ior)


def _only(names: Any, given: Mapping[str, float], scheme: str) -> None:
    for name in given:
        if name not in names:
            hint = nearest(name, names) if names else "; it has no parameters, burley has"
            raise UsageError(f"diffusion of {scheme} has no parameter {name!r}{hint}")


def _rgb(name: str, given: Mapping[str, float], default: float | None = None) -> np.ndarray:
    values = [given.get(f"{name}_{c}", given.get(name, default)) for c in CHANNELS]
    if None in values:
        raise UsageError(f"the profile needs {name}, or {name}_r, {name}_g and {name}_b")
    return np.array(values, np.float64)


def diffusion_spec(scheme: str | None, columns: Mapping[str, np.ndarray]) -> TableSpec:
    """Describe the array that `diffusion` computes. Raises UsageError for parameters that do not fit the scheme."""
    _parts(scheme, columns)
    return TableSpec(integral("normalization"), {}, (*np.broadcast_shapes(*(c.shape for c in columns.values())), 3), ())


def _parts(scheme: str | None, columns: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, Profile]:
    """Return cosines, curvatures and the profile."""
    others = {name: column for name, column in columns.items() if name not in AXES}
    for name, column in others.items():
        if column.ndim:
            raise UsageError(f"diffusion has the axes NoL and curvature; give {name} as one number")
    found = profile(scheme, {name: float(column) for name, column in others.items()})
    NoL, curvature = held(columns["NoL"], -1.0, 1.0), columns["curvature"]
    if not (np.abs(NoL) <= 1).all():
        raise UsageError(f"NoL {float(NoL.flat[np.argmax(np.abs(NoL))]):g} is outside [-1, 1]")
    if not ((curvature >= 0) & (curvature <= 1e9)).all():
        raise UsageError("curvature is 1/radius per mm, from 0 to 1e9")
    return NoL, curvature, found


def diffusion(
    scheme: str | None,
    report: bool,
    *,
    out: np.ndarray | None,
    precision: int,
    tolerance: float,
    NoL: np.ndarray,
    curvature: np.ndarray,
    device: Any = None,
    backfacing: str | None = None,
    **others: np.ndarray,
) -> tuple[Integrated, dict[str, Any]]:
    """Compute the diffuse light D (…, 3) for the cosine NoL of the light and the curvature κ in 1/mm.

    D(θ, κ) = ∫ q(2 sin(x/2)/κ) max(cos(θ + x), 0) dx / ∫ q dx over x from -π to π, θ = acos NoL.

    q is the profile's line spread: the body is a cylinder of curvature κ, lit and shaded alike along its axis, and the
    light that reaches a line is R integrated along the axis. For Gaussians this is what is usually tabulated. For
    Christensen and Burley's R, which grows like 1/r, the integral of R itself over the circle is infinite.
    """
    start = time.perf_counter()
    NoL, curvature, found = _parts(scheme, {"NoL": NoL, "curvature": curvature, **others})
    cosines, bends = (np.unique(a, return_inverse=True) for a in (NoL, curvature))
    table, error, nodes = integrated(found, cosines[0], bends[0])
    which = tuple(np.broadcast_arrays(bends[1].reshape(curvature.shape), cosines[1].reshape(NoL.shape)))
    values = room_for((*which[0].shape, 3), precision, out)
    values[...] = table[which]
    error += LEFT[precision]
    made = Integrated(
        values,
        error,
        3 * nodes * bends[0].size,
        time.perf_counter() - start,
        f"gauss-panels-{NODES[1]}",
        tuple(missed(error, tolerance, precision)),
    )
    return made, {
        "channels": ["R", "G", "B"],
        "units": {"curvature": "1/mm"},
        "profile": _stated(found),
        "formula": "diffuse = albedo D(n·l, curvature) times the irradiance facing the light; a flat body has "
        "max(n·l, 0)",
    } if report else {}


def _stated(found: Profile) -> dict[str, Any]:
    if isinstance(found, Gaussians):
        return {"of": "gaussians", "variances_mm2": found.variances.tolist(), "weights": found.weights.tolist()}
    if isinstance(found, Burley):
        return {"of": "burley", "d_mm": found.d.tolist()}
    return {"of": "dipole", "mean_free_path_mm": found.path.tolist(), "lost": found.lost.tolist(), "ior": found.ior}


def integrated(found: Profile, NoL: np.ndarray, curvature: np.ndarray) -> tuple[np.ndarray, float, int]:
    """Return D for each curvature and cosine, (rows, columns, 3), its absolute error, and the number of nodes of a
    row.
    """
    values = np.empty((curvature.size, NoL.size, 3))
    flat = curvature * found.widest < FLAT
    values[flat] = np.maximum(NoL, 0)[:, None]
    bent = np.flatnonzero(~flat)
    if not bent.size:
        return values, FLAT, 0
    # Panels halve towards x = 0, until the first is one over which q of the least curvature is flat or has no part.
    halvings = max(1, int(np.ceil(np.log2(np.pi / (found.least * curvature[bent].min())))))
    error = FLAT if flat.any() else 0.0
    for first in range(0, NoL.size, COLUMNS):
        columns = slice(first, first + COLUMNS)
        rules = [_rule(NoL[columns], halvings, nodes) for nodes in NODES]
        for begin in range(0, bent.size, ROWS):
            rows = bent[begin : begin + ROWS]
            D = [_ratio(found, 1 / curvature[rows], *rule) for rule in rules]
            error = max(error, float(np.abs(D[1] - D[0]).max()))
            values[rows, columns] = D[1]
    return values, error, (halvings + 1) * NODES[1]


def _ratio(found: Profile, radii: np.ndarray, x: np.ndarray, share: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the integrals over the nodes x, divided by that of the whole: (rows, columns, 3).

    share: (columns, nodes) weights of the integral. weights: those of the whole.
    """
    q = found.line_spread(2 * radii[:, None] * np.sin(x / 2))
    D = np.einsum("cx,rxk->rck", share, q, optimize=True) / np.einsum("x,rxk->rk", weights, q)[:, None]
    return np.asarray(np.maximum(D, 0))  # a mean of values that are not negative, except by rounding


def _rule(NoL: np.ndarray, halvings: int, nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes x on (0, π), weights (columns, nodes) of ∫ q max(cos(θ + x), 0) dx and (nodes,) of ∫ q dx over -π … π.

    q is even, so with C(t) = ∫₀ᵗ q cos and S(t) = ∫₀ᵗ q sin, for θ ≤ π/2, where cos(θ + x) > 0 from -π/2 - θ to
    π/2 - θ, the integral is cos θ (C(π/2 - θ) + C(π/2 + θ)) + sin θ (S(π/2 + θ) - S(π/2 - θ)); for others
    max(cos θ, 0) = cos θ + max(cos(π - θ), 0) leads there.
    """
    ends = np.concatenate([[0.0], np.pi * 2.0 ** -np.arange(halvings, -1, -1)])
    t, w = gauss(nodes)
    length = np.diff(ends)
    x, weight = ends[:-1, None] + length[:, None] * t, length[:, None] * w
    cos_t, sin_t = np.abs(NoL), np.sqrt((1 - NoL) * (1 + NoL))
    lower = np.arctan2(cos_t, sin_t)  # π/2 - θ, as θ ≤ π/2
    (C0, S0), (C1, S1) = (_up_to(at, ends, x, weight) for at in (lower, np.pi - lower))
    share = cos_t[:, None] * (C0 + C1) + sin_t[:, None] * (S1 - S0)
    share += np.minimum(NoL, 0)[:, None] * (2 * weight * np.cos(x)).ravel()
    return x.ravel(), share, 2 * weight.ravel()


def _up_to(at: np.ndarray, ends: np.ndarray, x: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (at, nodes) of ∫₀ᵃᵗ q cos dx and of ∫₀ᵃᵗ q sin dx: whole panels by their own weights, the one that ends
    early by the polynomial through its nodes."""
    nodes = x.shape[1]
    t, w = gauss(nodes)
    panel = np.minimum(np.searchsorted(ends, at, "right") - 1, x.shape[0] - 1)
    whole = (np.arange(x.shape[0]) < panel[:, None])[..., None] * weight
    # Barycentric weights of Gauss's nodes. [Wang2012, theorem 3.1]
    bary = (-1.0) ** np.arange(nodes) * np.sqrt(t * (1 - t) * w)
    span = at - ends[panel]
    inner = span[:, None] * t
    off = (inner / np.diff(ends)[panel, None])[..., None] - t  # (at, inner nodes, nodes), on the panel as [0, 1]
    same = off == 0
    part = bary / np.where(same, 1.0, off)
    basis = np.where(same.any(-1, keepdims=True), same, part / part.sum(-1, keepdims=True))
    found = []
    for trig in (np.cos, np.sin):
        total = whole * trig(x)
        total[np.arange(at.size), panel] += np.einsum(
            "aq,aqk->ak", span[:, None] * w * trig(ends[panel, None] + inner), basis
        )
        found.append(total.reshape(at.size, -1))
    return found[0], found[1]
