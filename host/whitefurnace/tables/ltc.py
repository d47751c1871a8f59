"""Linearly transformed cosines: matrices for lighting by polygons with a BRDF, fitted for all cells of a table at once.

A clamped cosine whose directions are moved by a matrix M is p(ω) = det N max(w.z, 0)/(π |w|⁴), w = N ω, N = M⁻¹. Its
integral over the sphere is 1, and over a polygon the form factor of the polygon moved by N [Heitz2016]. Engines load
four numbers of N, scaled to N.yy = 1, with v = (sin θ_v, 0, cos θ_v):

    w.x = xx ω.x + xz ω.z,   w.y = ω.y,   w.z = zx ω.x + zz ω.z,   stored (xx, zx, xz, zz), as the columns of mInv.

These are all the free parameters of a lobe that is even in y. The published fit uses three of them: its lobe is centred
on the mean direction of the BRDF, w.z ∝ l̄·ω (scheme "heitz"). Here w.z may turn freely too ("free"): the same four
numbers, read by the same shaders.

The error that is minimized and stated is the misplaced energy m = ∫ |f (n·l)/E - p| dω over the sphere, where E is the
albedo: light of radiance up to 1 is reflected with an error of at most E m/2. 0 is exact, and at 2 the lobes do not
overlap. A fit of the third power of the difference, as in the published fit, does not minimize m: its table has .124,
and its form could reach .114 (64², GGX, Smith).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from whitefurnace.catalogue import integral
from whitefurnace.catalogue.choice import Chosen
from whitefurnace.catalogue.rule import Rule, gauss
from whitefurnace.errors import UnsupportedError
from whitefurnace.integrals.quadrature import grid_of, integrate, own_kernel_of, parts_of, room_for
from whitefurnace.opencl import source
from whitefurnace.opencl.derived import finest
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import evaluate, over_cells
from whitefurnace.results import Integrated

STAGES = ((Rule("gauss", 16, 32, 12), 0.3, 12), (Rule("gauss", 40, 64, 26), 0.02, 20))
"""For each stage: the rule of half vectors, the rounding of the corner of |f̂ - p|, and the largest number of steps.
The first stage finds the basin in a tenth of the work. The m of the second is within 5e-4 of the stated m at the 99th
percentile, 9e-3 at most."""

EXACT = 96, 64
"""Nodes of the stated m in u.z and in half a turn: within 7e-5 of 640 × 300 nodes at the 99th percentile of GGX's 64²
table, 2e-3 at most, 1.4e-2 at n·v = 0."""

WITHIN = 1e-5
"""A step that reduces m by less than this ends a cell."""

STEP = 0.5
"""Largest entry of a step: δ is relative, and det (1 + δ) stays positive."""

ROUNDS = 16
"""Number of rounds in which cells without progress start again from their neighbours: a valley of n·v = 0 is 12 cells
long."""

ADOPTED = 0.98
"""Largest ratio of a neighbour's m to the cell's own m for the cell to start again from the neighbour."""


@dataclass(frozen=True)
class Lobes:
    """Cells of a BRDF on a device. `rows` are the rows that the kernels of ltc.cl read, with four rows for the
    matrix.
    """

    device: Device
    text: str
    rows: np.ndarray
    precision: int

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.rows.shape[1]

    @property
    def NoV(self) -> np.ndarray:
        """Cosines of the views, (n,)."""
        return self.rows[0]

    def _cells(self, N: np.ndarray, which: np.ndarray) -> np.ndarray:
        cells = self.rows[:, which]
        cells[2:6] = N
        return cells

    def descend(self, N: np.ndarray, which: np.ndarray, rule: Rule, soft: float) -> np.ndarray:
        """Return the results (19, n) of the kernel `descend` at matrices N (4, n) = xx, xz, zx, zz of the cells
        `which`.
        """
        polar, azimuthal = rule.tables()
        return over_cells(
            self.device,
            self.text,
            "descend",
            self._cells(N, which),
            19,
            self.precision,
            [
                *map(np.int32, rule.counts),
                polar,
                np.int32(rule.azimuths),
                azimuthal,
                np.dtype(f"f{self.precision // 8}").type(soft),
            ],
        ).astype(np.float64)

    def misplaced(self, N: np.ndarray) -> np.ndarray:
        """Return the misplaced energy m, (n,), of matrices N (4, n); 2 where there is no lobe.

        The nodes are those of the lobe itself, not those of the fit.
        """
        whole = np.isfinite(N).all(0) & (N[0] * N[3] - N[1] * N[2] > 0)
        some = np.flatnonzero(whole)
        polar, azimuthal = (np.stack(gauss(n), 1) for n in EXACT)
        found = np.full(self.count, 2.0)
        if some.size:
            found[some] = over_cells(
                self.device,
                self.text,
                "misplaced",
                self._cells(N[:, some], some),
                3,
                self.precision,
                [np.int32(EXACT[0]), polar, np.int32(EXACT[1]), azimuthal],
            )[0]
        return np.minimum(found, 2.0)  # the largest possible value; sums over nodes exceed it for lobes far apart


def horizon(N: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the energy b below the horizon, (n,), of matrices N (4, n), and its gradient (4, n).

    The gradient is in δ of N <- (1 + δ) N. The lobe's half u.z > 0 meets the half space ω.z > 0 where m·u > 0, m = N⁻ᵀ
    z: a cosine lobe cut by a plane through its origin holds (1 + m.z/|m|)/2. A step turns m by -δᵀ m.
    """
    xx, _, zx, _ = N
    x, z = -zx, xx  # times 1/det N > 0
    size = np.hypot(x, z)
    x, z = x / size, z / size
    turned = np.stack([z * x * x, x * (z * z - 1), z * x * z, z * (z * z - 1)])  # d(m.z/|m|)/δ
    return np.where(z > 0, x * x / (1 + np.abs(z)), 1 - z) / 2, -turned / 2


@dataclass
class Fit:
    """The state of a fit: matrices (4, n), the misplaced energy m (n,) by the current rule, and the mean direction l̄.

    Of l̄ the x and z are kept, (2, n).
    """

    N: np.ndarray
    m: np.ndarray
    mean: np.ndarray


def _value(lobes: Lobes, N: np.ndarray, which: np.ndarray, rule: Rule, soft: float) -> tuple[np.ndarray, ...]:
    """Return m (n,), its gradient (n, 4) and matrix (n, 4, 4) in δ.

    A lobe that slips between the nodes would seem to fit, so the part of p above the horizon that the nodes miss counts
    as misplaced.
    """
    sums = lobes.descend(N, which, rule, soft)
    below, along = horizon(N)
    m = sums[0] + below + np.abs(1 - below - sums[18])
    i, j = np.triu_indices(4)
    curve = np.empty((which.size, 4, 4))
    curve[:, i, j] = curve[:, j, i] = sums[5:15].T
    # b is a square already, of sin ψ/2: its matrix is 2 (√b)'(√b)'ᵀ.
    curve += along.T[:, :, None] * along.T[:, None, :] / (2 * np.maximum(below, 1e-12))[:, None, None]
    return np.where(np.isfinite(m), m, np.inf), (sums[1:5] + along).T, curve


def _moved(N: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return (1 + δ) N for δ = (xx, xz, zx, zz): (4, n)."""
    a, b, c, d = step
    xx, xz, zx, zz = N
    return np.stack([(1 + a) * xx + b * zx, (1 + a) * xz + b * zz, c * xx + (1 + d) * zx, c * xz + (1 + d) * zz])


def descend(lobes: Lobes, fit: Fit, which: np.ndarray, free: bool, stage: tuple[Rule, float, int]) -> None:
    """Improve the matrices of the cells `which` in place, by Levenberg-Marquardt steps on all cells at a time.

    free: False keeps the direction of the row of w.z (δ.zx = 0).
    """
    rule, soft, steps = stage
    kept = np.array([0, 1, 2, 3] if free else [0, 1, 3])
    at, damping = which, np.full(which.size, 1e-3)
    m, slope, curve = _value(lobes, fit.N[:, at], at, rule, soft)
    fit.m[at] = m
    for _ in range(steps):
        if not at.size:
            break
        A = curve[:, kept[:, None], kept]
        diagonal = np.einsum("nii->ni", A)
        A = A + np.einsum(
            "ni,ij->nij",
            damping[:, None] * (diagonal + 1e-6 * diagonal.max(1, keepdims=True) + 1e-30),
            np.eye(kept.size),
        )
        step = np.zeros((at.size, 4))
        step[:, kept] = -np.linalg.solve(A, slope[:, kept, None])[..., 0]
        step *= np.minimum(1, STEP / np.maximum(np.abs(step).max(1), 1e-30))[:, None]
        N = _moved(fit.N[:, at], step.T)
        trial, next_slope, next_curve = _value(lobes, N, at, rule, soft)
        better = trial < m
        gain = np.where(better, m - trial, 0.0)
        fit.N[:, at[better]] = N[:, better]
        m = np.where(better, trial, m)
        fit.m[at] = m
        slope = np.where(better[:, None], next_slope, slope)
        curve = np.where(better[:, None, None], next_curve, curve)
        damping *= np.where(better, 0.2, 6.0)
        open_ = ~(better & (gain < WITHIN * m)) & (damping < 1e4)
        at, damping, m, slope, curve = at[open_], damping[open_], m[open_], slope[open_], curve[open_]


def _start(lobes: Lobes, width: np.ndarray) -> Fit:
    """Return lobes about the mean direction l̄ of the BRDF, of the size of its own lobe.

    Where the NDF falls to a quarter in the angle a, its reflection does within 2 a in the plane of incidence and within
    2 a n·v across it: a lobe of GGX for a → 0, the cosine itself for a = 1.
    """
    which = np.arange(lobes.count)
    sums = lobes.descend(np.tile([[1.0], [0.0], [0.0], [1.0]], lobes.count), which, STAGES[0][0], 0.1)
    size = np.hypot(sums[15], sums[16])
    x, z = np.where(size > 0, sums[15:17], [[0.0], [1.0]]) / np.where(size > 0, size, 1)
    along = np.clip(2 * width / (1 + width), 1e-6, 1.0)
    across = along * np.hypot(lobes.NoV, along) / np.hypot(1, along)
    return Fit(np.stack([z / along, -x / along, x, z]) * across, np.full(lobes.count, np.inf), np.stack([x, z]))


def _from_neighbours(lobes: Lobes, fit: Fit, shape: tuple[int, ...], width: np.ndarray, free: bool) -> None:
    """Start cells in worse minima again from a neighbour's matrix, scaled to lobes of their own width, in place.

    The neighbour's lobe is turned to the cell's own l̄, and with k the ratio of the widths M's columns x and y scale by
    k. Towards grazing a lobe is a wedge, whose y scales by k² and z by k.
    """
    index = np.arange(lobes.count).reshape(shape)
    rule, soft, _ = STAGES[-1]
    pairs = []
    for axis in range(len(shape)):
        first, last = np.moveaxis(index, axis, 0)[:-1].ravel(), np.moveaxis(index, axis, 0)[1:].ravel()
        pairs += [(first, last), (last, first)]
    changed = np.ones(lobes.count, bool)
    for _ in range(ROUNDS):
        best, start = fit.m * ADOPTED, fit.N.copy()
        for to, of in pairs:
            live = changed[of] & (fit.m[of] < 2)
            to_, of_ = to[live], of[live]
            if not to_.size:
                continue
            k = width[to_] / width[of_]
            xx, xz, zx, zz = fit.N[:, of_]
            # N R_ofᵀ R_to, the rows of R the tangent (l̄.z, -l̄.x) and l̄.
            (x, z), (X, Z) = fit.mean[:, of_], fit.mean[:, to_]
            a, b, c, d = xx * z - xz * x, xx * x + xz * z, zx * z - zz * x, zx * x + zz * z
            framed = [(a, b, c * k, d * k), (a * k, b * k * k, c * k, d * k * k)]
            starts = [np.stack([a * Z + b * X, b * Z - a * X, c * Z + d * X, d * Z - c * X]) for a, b, c, d in framed]
            # As directions scale too, which moves the pole off l̄: the valley of n·v = 0 is found by this alone.
            starts += [np.stack([xx * k * k, xz * k, zx * k * k, zz * k])] if free else []
            for N in starts:
                m = _value(lobes, N, to_, rule, soft)[0]
                won = m < best[to_]
                best[to_[won]] = m[won]
                start[:, to_[won]] = N[:, won]
        again = np.flatnonzero(best < fit.m * ADOPTED)
        if not again.size:
            break
        fit.N[:, again] = start[:, again]
        descend(lobes, fit, again, free, STAGES[-1])
        changed[:] = False
        changed[again] = True


def fit_lobes(lobes: Lobes, shape: tuple[int, ...], width: np.ndarray, scheme: str) -> Fit:
    """Fit the matrices of all cells of a grid of `shape`: (4, n).

    width: (n,) angular widths of the NDF in radians. scheme: "free" or "heitz".
    """
    free = scheme == "free"
    fit, which = _start(lobes, width), np.arange(lobes.count)
    for stage in STAGES:
        descend(lobes, fit, which, free, stage)
    _from_neighbours(lobes, fit, shape, width, free)
    return fit


# ---------------------------------------------------------------------------------------------- tables


def check(slots: Mapping[str, Chosen]) -> None:
    """Check that the NDF is isotropic. Lobes of others need a full matrix and a third axis. Raises UnsupportedError."""
    if not slots["ndf"].model.isotropic:
        raise UnsupportedError(f"ltc needs an isotropic ndf; {slots['ndf'].model.name} is anisotropic")


def digests(slots: Mapping[str, Chosen]) -> tuple[str, ...]:
    """Return the digests of the kernels, for the key of a table."""
    models = {slot: slots[slot].model for slot in ("ndf", "masking", "fresnel")}
    pair, both = integral("dfg"), {slot: models[slot] for slot in ("ndf", "masking")}
    closed = own_kernel_of(pair, both)
    return (
        source.transformed(models).digest,
        source.integration(pair, both).digest,
        *([source.closed(closed, both).digest] if closed else []),
    )


def lobes_of(
    device: Device, models: Mapping[str, Chosen], albedo: np.ndarray, columns: Mapping[str, Any]
) -> tuple[Lobes, np.ndarray]:
    """Return the cells of a grid of parameters with known albedos, and the angular widths (n,) of their NDF in
    radians.
    """
    entry, precision = integral("albedo"), finest(device)
    slots = {slot: models[slot] for slot in ("ndf", "masking", "fresnel")}
    grid = grid_of(entry, slots, dict(columns), None)
    part = parts_of(device, entry, slots, precision)[0]
    cells, terms, _ = part.cells(grid.rows(part, 0, grid.size), precision, 1e-9)
    per = 1 / np.maximum(np.asarray(albedo, np.float64).ravel(), 1e-30)
    rows = np.concatenate([cells[:1], per[None], np.zeros((4, grid.size)), cells[1:]])
    ndf = part.slots["ndf"]
    width = evaluate(device, "NDF_WIDTH", {"ndf": ndf}, cells[1 : 1 + len(ndf.arguments)], precision)[0]
    return (
        Lobes(device, source.transformed(part.slots, terms).text, rows, precision),
        np.clip(width.astype(np.float64), 1e-6, 1.0),
    )


def sphere_form_factor(z: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return the form factor of a sphere cut by the horizon, relative to that of the whole sphere.

    z: cosine of the angle from the normal to the sphere's middle. length: sin² of the sphere's angular radius. Both
    broadcast. Engines clip a polygon with it, as if it were a sphere of the same vector form factor. [Heitz2016, sec.
    6; Snyder1996]
    """
    z, length = np.broadcast_arrays(np.asarray(z, np.float64), np.asarray(length, np.float64))
    sin_w, sin_s, cos_s = np.sqrt(np.maximum(1 - z * z, 0)), np.sqrt(length), np.sqrt(np.maximum(1 - length, 0))
    cut = np.abs(z) < sin_s  # the horizon cuts it: the cap's rim is met at the angle γ
    cos_g = np.where(cut, np.sqrt(np.maximum(sin_s**2 - z * z, 0)) / np.where(cut, sin_w, 1), 0)
    sin_g = np.where(cut, cos_s / np.where(cut, np.maximum(sin_w, cos_s), 1), 1)
    gamma = np.arctan2(sin_g, cos_g)
    rim = -2 * sin_w * cos_s * cos_g + np.pi / 2 - gamma + sin_g * cos_g
    per = np.where(cut, sin_s, 1)
    side = np.abs(z) * (
        cos_g * np.sqrt(np.maximum(sin_s**2 - cos_g**2, 0)) + sin_s**2 * np.arcsin(np.minimum(cos_g / per, 1))
    )
    area = np.pi * np.maximum(z, 0) * length + rim - side
    return np.where(cut, area / (np.pi * np.where(cut, length, 1)), np.maximum(z, 0))


def _stated(m: np.ndarray) -> dict[str, float]:
    return {
        "mean": float(m.mean()),
        "median": float(np.median(m)),
        "p99": float(np.quantile(m, 0.99)),
        "max": float(m.max()),
    }


def _stored(N: np.ndarray, kind: str) -> np.ndarray:
    """Return matrices after a round trip through a format."""
    with np.errstate(over="ignore"):  # an infinite value is no lobe
        return N.astype(kind).astype(np.float64)


def _four(values: np.ndarray) -> np.ndarray:
    """Return means of neighbours on the last two axes: the values that are read in the middle of four texels."""
    down = (values[..., 1:, :] + values[..., :-1, :]) / 2
    return (down[..., 1:] + down[..., :-1]) / 2


def matrices(
    scheme: str, device: Device, models: Mapping[str, Chosen], albedo: np.ndarray, columns: Mapping[str, Any]
) -> tuple[np.ndarray, Lobes]:
    """Return the fitted matrices (4, …), float64, as xx, xz, zx, zz over the broadcast parameters, and their cells.

    scheme: "free" or "heitz". albedo: (n,) albedos of the cells.
    """
    lobes, width = lobes_of(device, models, albedo, columns)
    fit = fit_lobes(lobes, np.shape(albedo), width, scheme)
    return fit.N.reshape(4, *np.shape(albedo)), lobes


def ltc(
    kind: str,
    names: Sequence[str],
    scheme: str | None,
    report: bool,
    *,
    ndf: Chosen,
    masking: Chosen,
    fresnel: Chosen,
    device: Device,
    precision: int,
    tolerance: float,
    out: np.ndarray | None,
    backfacing: str | None = None,
    middle: Mapping[str, Any] | None = None,
    **columns: Any,
) -> tuple[Integrated, dict[str, Any]]:
    """Compute the channels `names` of a table, (…, c), and with `report` the facts that its manifest states.

    ltc_1 holds the matrix, ltc_2 (norm, Fresnel, 0, sphere), ltc both.

    norm and Fresnel are ∫ f (n·l) dω with F = 1 and with F = (1 - v·h)⁵, so the radiance that a polygon P of radiance 1
    causes is (F0 norm + (1 - F0) Fresnel) ∫_P p dω. The sphere's table has axes of its own: x is the cosine from -1 to
    1, y the length of the vector form factor.
    """
    start = time.perf_counter()
    models = {"ndf": ndf, "masking": masking, "fresnel": fresnel}
    pairs = integrate(
        "dfg",
        ndf=ndf,
        masking=masking,
        device=device,
        precision=finest(device),
        backfacing=backfacing,
        tolerance=max(tolerance / 2, 1e-9),
        **columns,
    )
    norm = pairs.values.sum(-1, dtype=np.float64)
    channels = {"norm": norm, "fresnel": pairs.values[..., 1], "0": np.zeros(norm.shape)}
    facts: dict[str, Any] = {"channels": list(names)}
    if "sphere" in names:
        rows, across = norm.shape[-2:]
        channels["sphere"] = np.broadcast_to(
            sphere_form_factor(np.linspace(-1, 1, across), np.linspace(0, 1, rows)[:, None]), norm.shape
        )
    if "xx" in names:
        if backfacing is not None:
            raise UnsupportedError(f"{kind} has no views from behind: leave backfacing out")
        N, lobes = matrices(scheme or "free", device, models, norm, columns)
        channels |= {"xx": N[0], "xz": N[1], "zx": N[2], "zz": N[3]}
        if report:
            facts |= _facts(N, lobes, models, middle, precision, device)
    values = room_for((*norm.shape, len(names)), precision, out)
    for k, name in enumerate(names):
        values[..., k] = channels[name]
    # `error` is that of norm and Fresnel; the matrices have their misplaced energy.
    return replace(pairs, values=values, error=2 * pairs.error, seconds=time.perf_counter() - start), facts


def _facts(
    N: np.ndarray,
    lobes: Lobes,
    models: Mapping[str, Chosen],
    middle: Mapping[str, Any] | None,
    precision: int,
    device: Device,
) -> dict[str, Any]:
    """Return the energy misplaced by the matrices as formats hold them, and by reads in the middle of four texels."""
    flat, name = N.reshape(4, -1), f"float{precision}"
    kinds = {name: f"f{precision // 8}", "float16": "f2"}
    stated: dict[str, Any] = {held: _stated(lobes.misplaced(_stored(flat, kind))) for held, kind in kinds.items()}
    if middle is not None:
        albedo = integrate(
            "albedo",
            ndf=models["ndf"],
            masking=models["masking"],
            device=device,
            precision=lobes.precision,
            tolerance=1e-6,
            **middle,
        )
        between, _ = lobes_of(device, models, albedo.values, middle)
        stated["between"] = {
            held: _stated(between.misplaced(_four(_stored(N, kind)).reshape(4, -1))) for held, kind in kinds.items()
        }
    below = horizon(flat)[0]
    return {
        "misplaced": stated,
        "below_horizon": {"mean": float(below.mean()), "max": float(below.max())},
        "formula": "p(ω) = det N max(w.z, 0)/(π |w|⁴), w = (xx ω.x + xz ω.z, ω.y, zx ω.x + zz ω.z), v = (sin θ, 0, "
        "cos θ); reflected: (F0 norm + (1 - F0) fresnel) ∫ p L dω",
        "misplaced_is": "∫ |f (n·l)/norm - p| dω over the sphere, by nodes that the fit has not",
    }
