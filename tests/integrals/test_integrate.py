"""Every integral over every NDF, masking and diffuse model against exact values and independent quadrature.

The pieces, D and area and the terms of each model, have tests of their own; here they are put together.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reference
from whitefurnace import dfg, integrate, prefilter
from whitefurnace.catalogue import INTEGRALS, Model, models
from whitefurnace.catalogue.choice import chosen
from whitefurnace.errors import CheckError, FileError, InputError, UnsupportedError, UsageError
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import CELLS_A_LAUNCH

# n·v from grazing to normal, the ends thicker and themselves.
NOV = np.array([0, 1e-4, 1e-3, 0.01, 1 / 64, 0.05, 0.15, 0.4, 0.7, 0.9, 0.99, 0.9999, 1.0])
NDFS, MASKINGS, DIFFUSE = models("ndf"), models("masking"), models("diffuse")
ISOTROPIC = [name for name, m in NDFS.items() if m.isotropic]
ANISOTROPIC = [name for name, m in NDFS.items() if not m.isotropic]
PRECISIONS = pytest.mark.parametrize("precision", [32, 64])

Columns = dict[str, np.ndarray]


@pytest.fixture(autouse=True)
def _float64(request: pytest.FixtureRequest) -> None:
    """Skips what the device cannot do."""
    asked = request.node.callspec.params if hasattr(request.node, "callspec") else {}
    if asked.get("precision") == 64 and not request.getfixturevalue("device").fp64:
        pytest.skip("no float64")


def axes(entry: Model, slot: str = "") -> Columns:
    """Each parameter's typical values and the ends of its domain."""
    return {
        f"{slot or entry.slot}_{p.name}": np.unique([*p.typical, *(v for v in (p.low, p.high) if abs(v) < 1e9)])
        for p in entry.parameters
    }


def product(columns: Mapping[str, Any]) -> Columns:
    return {k: v.ravel() for k, v in zip(columns, np.meshgrid(*columns.values(), indexing="ij"), strict=True)}


def domain(entry: Model, view: bool) -> Columns:
    """Cells over the whole domain of an NDF, ends included, and over views."""
    columns: dict[str, Any] = {"NoV": NOV} if view else {}
    if view and not entry.isotropic:
        columns["phi"] = np.array([0.0, 0.3, math.pi / 4, math.pi / 2])
    return product(columns | axes(entry))


def own(columns: Columns, slot: str = "ndf") -> Columns:
    return {k.removeprefix(f"{slot}_"): v for k, v in columns.items() if k.startswith(f"{slot}_")}


def assert_close(got: np.ndarray, want: Any, tolerance: Any, columns: Columns, context: object = "") -> None:
    error = np.abs(got - want)
    bad = ~(error <= tolerance)  # NaN too
    if bad.any():
        k = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
        cell = {name: float(v.ravel()[k]) if v.size > 1 else float(v) for name, v in columns.items()}
        raise AssertionError(
            f"{context}: {bad.sum()} of {bad.size} cells; at {cell} got {got.ravel()[k]!r}, wanted "
            f"{np.broadcast_to(want, got.shape).ravel()[k]!r}, error {error.ravel()[k]:.2e}"
        )


# ---------------------------------------------------------------------------------------------- exact values


def exact(name: str, precision: int) -> float:
    """What the project promises for integrals of 1: 1e-6 (and the rounding of 1 in float32 itself) and 1e-12, and 1e-9
    where a norm is an incomplete gamma."""
    return 1.06e-6 if precision == 32 else 1e-9 if name == "shifted_gamma" else 1e-12


@PRECISIONS
@pytest.mark.parametrize("name", NDFS)
def test_normalization(device: Device, name: str, precision: int) -> None:
    columns = domain(NDFS[name], False)
    got = integrate("normalization", ndf=name, precision=precision, device=device, **columns)
    assert NDFS[name].checks.normalized
    assert_close(got.values, 1, exact(name, precision), columns, name)
    assert_close(got.values, 1, got.error, columns, f"{name}, stated error")
    assert got.evaluations > 0 and got.seconds > 0 and got.rule.split("-")[0] in ("polar", "stretched")


FURNACE = [name for name, m in MASKINGS.items() if m.checks.weak_furnace == 1]


@pytest.mark.few(5)
@PRECISIONS
@pytest.mark.parametrize("masking", FURNACE)
@pytest.mark.parametrize("name", NDFS)
def test_weak_furnace(device: Device, name: str, masking: str, precision: int) -> None:
    columns = domain(NDFS[name], True)
    got = integrate("weak_furnace", ndf=name, masking=masking, precision=precision, device=device, **columns)
    assert_close(got.values, 1, exact(name, precision), columns, (name, masking, got.rule))
    assert_close(got.values, 1, got.error, columns, f"{name} {masking}, stated error")


@PRECISIONS
@pytest.mark.parametrize("name", [name for name, m in NDFS.items() if "area" in m.reference])
def test_projected_area_against_closed_forms(device: Device, name: str, precision: int) -> None:
    entry = NDFS[name]
    columns = domain(entry, True)
    theta = np.arccos(columns["NoV"])
    where = (theta,) if entry.isotropic else (theta, columns["phi"])
    want = entry.reference["area"](*where, **own(columns))
    got = integrate("projected_area", ndf=name, precision=precision, device=device, **columns)
    # arccos turns n·v by 1e-16, and Λ by that over n·v: 1e-12 at 1e-4.
    assert_close(got.values, want, exact(name, precision) + 1e-12, columns, name)
    assert_close(got.values, want, got.error + 1e-12, columns, f"{name}, stated error")


@PRECISIONS
@pytest.mark.parametrize("name", ISOTROPIC)
def test_projected_area_against_quadrature(device: Device, name: str, precision: int) -> None:
    entry = NDFS[name]
    columns = product({"NoV": NOV} | axes(entry))
    want = np.empty(columns["NoV"].size)
    for values in itertools.product(*axes(entry).values()):
        at = np.all([columns[k] == v for k, v in zip(axes(entry), values, strict=True)], 0)
        D = partial(entry.reference["D"], **dict(zip((p.name for p in entry.parameters), values, strict=True)))
        want[at] = reference.smith_area(D, np.arcsin(columns["NoV"][at]), 1 / 64)
    got = integrate("projected_area", ndf=name, precision=precision, device=device, **columns)
    # Tanh-sinh at this step holds lobes of 1e-5 rad to 1e-9 (against half of the step).
    # Thin rims of sheen cost float32 a few roundings more, which must be stated.
    assert_close(got.values, want, max(exact(name, precision), got.error, 1e-9), columns, name)
    assert got.error <= (2e-6 if precision == 32 else 1e-11) * max(want.max(), 1)


@pytest.mark.parametrize("masking", [n for n, m in MASKINGS.items() if "MASKING_G1" in m.provides and n not in FURNACE])
def test_weak_furnace_of_what_is_not_smith_is_not_1(device: Device, masking: str) -> None:
    """G1 is constant in m: the furnace is A(v) G1(v)/(n·v), far from 1 as the entry says."""
    NoV = np.array([0.01, 0.2, 0.6])
    area = integrate("projected_area", ndf="ggx", NoV=NoV, alpha=0.1, device=device).values
    got = integrate("weak_furnace", ndf="ggx", masking=masking, NoV=NoV, alpha=0.1, device=device).values
    want = area * MASKINGS[masking].reference["G1"](NoV, area, alpha=0.1) / NoV
    assert np.abs(got - want).max() <= 4e-6  # two integrals of 1e-6, one of them over n·v with A beside it
    assert np.abs(got - 1).max() > 0.1


def test_nov_of_0_and_1(device: Device) -> None:
    """The ends are the limits: all area is seen along n, and ½α of GGX's at grazing."""
    got = integrate("projected_area", ndf="ggx", NoV=[0, 1], alpha=[0.1, 0.1], device=device).values
    assert np.abs(got - [0.05, 1]).max() <= 1e-6
    for name in ISOTROPIC:
        values = middle(NDFS[name])
        near = integrate("albedo", ndf=name, NoV=[0, 1e-7, 1 - 1e-7, 1], device=device, **values).values
        # The albedo of a rough surface leaves its limits like n·v log(n·v): 1e-6 of it.
        assert np.isfinite(near).all() and np.abs(np.diff(near)[[0, 2]]).max() <= 1e-5, (name, near)


# ---------------------------------------------------------------------------------------------- albedo


@PRECISIONS
def test_ggx_against_the_azimuth_in_closed_form(device: Device, precision: int) -> None:
    NoV, alpha = (a.ravel() for a in np.meshgrid(NOV[1:], [1e-4, 1e-3, 0.01, 0.05, 0.2, 0.5, 1.0]))
    E, Fc = reference.ggx_albedo_1d(NoV, alpha, 160, 120)
    kwargs: dict[str, Any] = {"ndf": "ggx", "NoV": NoV, "alpha": alpha, "precision": precision, "device": device}
    kwargs["tolerance"] = 1e-6 if precision == 32 else 1e-9
    columns = {"NoV": NoV, "alpha": alpha}
    albedos, pairs = integrate("albedo", **kwargs), integrate("dfg", **kwargs)
    # What the project promises; the 1-D form is good to 2e-8 at grazing and 1e-10 elsewhere.
    fine = 1e-6 if precision == 32 else 2e-9
    tolerance = np.where(NoV >= 1 / 64, fine, 1e-5 if precision == 32 else 4e-8)
    for got, want in ((albedos.values, E), (pairs.values[:, 0], E - Fc), (pairs.values[:, 1], Fc)):
        assert_close(got, want, tolerance, columns)
        # At n·v = 1e-4 two rules may agree by chance: half of the statement more.
        stated = max(albedos.error, pairs.error) * np.where(NoV < 1e-3, 1.5, 1)
        assert_close(got, want, stated + 2e-8, columns, "stated error")
    # Schlick's F of the albedo, on the same nodes, puts the pair together: F0 A + F90 B.
    schlick = integrate("albedo", **kwargs, fresnel="schlick:f90=.9", f0=0.04).values
    together = 0.04 * pairs.values[:, 0] + 0.9 * pairs.values[:, 1]
    assert_close(schlick, together, 2e-6 if precision == 32 else 1e-8, columns)  # two results of 1e-6


def middle(entry: Model) -> dict[str, float]:
    """A typical value of each parameter."""
    return {p.name: p.typical[len(p.typical) // 2] for p in entry.parameters}


Reference = tuple[np.ndarray, np.ndarray, Columns]


@functools.cache
def quadrature(name: str, masking: str, fresnel: str = "one", phi: float | None = None) -> Reference:
    """Albedos over light directions in float64 from the entries' references, what a coarser rule says otherwise, and
    the cells; cells where the rules do not agree to 1e-6 within their steps are left out."""
    entry, mask = NDFS[name], MASKINGS[masking]
    V = partial(mask.reference["V"], **{p.name: 0.2 for p in mask.parameters})
    F = partial(models("fresnel")[fresnel].reference["F"], **middle(models("fresnel")[fresnel]))
    # The two azimuth panels of an anisotropic lobe meet beside its peak: they see no lobe narrower than .05.
    every = product(
        {"NoV": np.array([1e-4, 1e-3, 1 / 64, 0.15, 0.5, 0.9, 1.0])}
        | {f"ndf_{p.name}": np.array(p.typical if entry.isotropic else (0.05, 0.3, 1.0)) for p in entry.parameters}
    )
    # All cells of the promised masking where there are few, some of the others'.
    some = slice(0, None, 1 + every["NoV"].size // (100 if masking == "smith" and entry.isotropic else 15))
    cells = {k: v[some] for k, v in every.items()}
    values = np.empty(cells["NoV"].size)
    doubt = np.full(values.size, np.inf)
    with np.errstate(all="ignore"):
        for k in range(values.size):
            parameters = {n: float(v[k]) for n, v in own(cells).items()}
            D = partial(entry.reference["D"], **parameters)
            area: Callable[..., np.ndarray] = partial(reference.smith_area, D)
            before = math.nan
            for step in (1 / 16, 1 / 26, 1 / 42):
                seen = partial(area, step=step) if entry.isotropic else partial(entry.reference["area"], **parameters)
                values[k] = reference.albedo_by_tanh_sinh(D, V, F, seen, float(cells["NoV"][k]), phi, step)
                doubt[k] = abs(values[k] - before)
                before = values[k]
                if doubt[k] <= 1e-7:
                    break
    good = doubt <= 1e-6
    return values[good], doubt[good], {n: v[good] for n, v in cells.items()}


def check_quadrature(
    device: Device, name: str, masking: str, at_least: float, fresnel: str = "one", phi: float | None = None
) -> None:
    want, doubt, columns = quadrature(name, masking, fresnel, phi)
    others = {f"masking_{p.name}": 0.2 for p in MASKINGS[masking].parameters}
    others |= {f"fresnel_{name}": value for name, value in middle(models("fresnel")[fresnel]).items()}
    if phi is not None:
        others["phi"] = phi
    # What is promised of Smith at the default tolerance; grooves and 1/(v·h)² would climb to the end for it.
    got = integrate(
        "albedo",
        ndf=name,
        masking=masking,
        fresnel=fresnel,
        device=device,
        tolerance=1e-6 if masking == "smith" else 1e-4,
        **columns,
        **others,
    )
    context = (name, masking, got.rule, got.error)
    assert want.size >= at_least, f"{context}: the reference converges in {want.size} cells only"
    if masking == "smith":
        assert_close(got.values, want, 1e-5, columns, context)
    # At n·v = 1e-4 Kelemen's root, and a kink of an anisotropic lobe, may hide from three rules in a row.
    panels = NDFS[name].isotropic and MASKINGS[masking].kinks is not None
    slow = MASKINGS[masking].checks.slow_rules is not None and not panels
    stated = got.error * np.where((columns["NoV"] < 1e-3) & slow, 3, 1)
    assert_close(got.values, want, stated + doubt, columns, f"{context}, stated error")


@pytest.mark.few(2)
@pytest.mark.parametrize("name", [n for n in ISOTROPIC if n != "ggx"])
def test_albedo_with_smith(device: Device, name: str) -> None:
    check_quadrature(device, name, "smith", 30)


@pytest.mark.few(4)
@pytest.mark.parametrize("masking", [n for n in MASKINGS if n != "smith"])
@pytest.mark.parametrize("name", ISOTROPIC)
def test_albedo_with_every_masking(device: Device, name: str, masking: str) -> None:
    check_quadrature(device, name, masking, 3)


@pytest.mark.few(2)
@pytest.mark.parametrize("masking", MASKINGS)
@pytest.mark.parametrize("name", ANISOTROPIC)
def test_albedo_of_anisotropic_ndfs(device: Device, name: str, masking: str) -> None:
    check_quadrature(device, name, masking, 3, phi=0.7)


@pytest.mark.parametrize("fresnel", [n for n in models("fresnel") if n != "one"])
def test_albedo_with_every_fresnel(device: Device, fresnel: str) -> None:
    check_quadrature(device, "beckmann", "smith_separable", 5, fresnel)


@pytest.mark.parametrize(
    "name, masking",
    [
        pytest.param(name, masking, marks=() if masking == "smith" or name == "ggx" else pytest.mark.long)
        for name in ISOTROPIC
        for masking in MASKINGS
    ],
)
def test_the_pair_of_the_split_sum(device: Device, name: str, masking: str) -> None:
    """A + B is the albedo at F = 1 and F0 A + B that with Schlick's F, for every NDF and masking."""
    columns = product({"NoV": NOV[2::2]} | {f"ndf_{p.name}": np.array(p.typical[1:-1]) for p in NDFS[name].parameters})
    others = {f"masking_{p.name}": 0.2 for p in MASKINGS[masking].parameters}
    asked: Any = partial(integrate, ndf=name, masking=masking, tolerance=1e-4, device=device, **columns, **others)
    pair, E, F = asked("dfg"), asked("albedo"), asked("albedo", fresnel="schlick", f0=0.04)
    # Each is within what it states of the truth.
    slack = pair.error + max(E.error, F.error)
    assert_close(pair.values.sum(-1), E.values, 2 * slack, columns, (name, masking))
    assert_close(0.04 * pair.values[:, 0] + pair.values[:, 1], F.values, 2 * slack, columns, (name, masking))


@pytest.mark.parametrize("integral", [n for n, i in INTEGRALS.items() if i.view and n != "radiance"])
@pytest.mark.parametrize("name", ANISOTROPIC)
def test_equal_roughness_is_isotropic_and_a_quarter_turn_swaps(device: Device, name: str, integral: str) -> None:
    cells = product({"NoV": NOV[1::2], "phi": np.array([0.0, 0.4, 1.3]), "alpha": np.array([0.02, 0.2, 1.0])})
    alpha = cells.pop("alpha")
    ask: Any = partial(integrate, integral, device=device)
    turned = ask(ndf=name, alpha_x=alpha, alpha_y=alpha, **cells)
    plain = ask(ndf=name.removesuffix("_anisotropic"), alpha=alpha, NoV=cells["NoV"])
    columns = {**cells, "alpha": alpha}
    assert_close(turned.values, plain.values, turned.error + plain.error, _like(columns, turned.values))
    one = ask(ndf=name, alpha_x=alpha, alpha_y=0.1, **cells)
    other = ask(ndf=name, alpha_x=0.1, alpha_y=alpha, **{**cells, "phi": cells["phi"] + math.pi / 2})
    assert_close(one.values, other.values, one.error + other.error, _like(columns, one.values))


def _like(columns: Columns, values: np.ndarray) -> Columns:
    """Cells of a vector integral, a component each."""
    return columns if values.ndim == 1 else {k: np.repeat(v, values.shape[1]) for k, v in columns.items()}


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize("name", ["weak_furnace", "dfg"])
def test_the_stated_error_is_not_less_than_the_true_one(device: Device, name: str, tolerance: float) -> None:
    NoV, alpha = (a.ravel() for a in np.meshgrid(NOV[1:], NDFS["ggx"].parameters[0].typical))
    got = integrate(name, ndf="ggx", NoV=NoV, alpha=alpha, tolerance=tolerance, device=device)
    if name == "dfg":
        E, Fc = reference.ggx_albedo_1d(NoV, alpha)
        want = np.stack([E - Fc, Fc], -1)
    else:
        want = np.ones_like(NoV)
    # At n·v = 1e-4 two rules may agree by chance: half of the statement more. 2e-8: the 1-D reference.
    far = np.abs(got.values - want).reshape(NoV.size, -1).max(1)
    true = np.where(NoV < 1e-3, far / 1.5, far).max()
    assert true <= got.error + 2e-8, (name, tolerance, got.rule, true, got.error)
    assert got.error <= tolerance + 4e-6, (name, tolerance, got.rule, got.error)  # + rounding of values up to 2


@pytest.mark.few(2)
@pytest.mark.parametrize("name", NDFS)
def test_one_cell_alone_states_its_error(device: Device, name: str) -> None:
    """A cell alone climbs by itself, and may meet two rules that err alike."""
    rng = np.random.default_rng(list(name.encode()))
    for _ in range(12):
        parameters = {
            p.name: float(np.clip(p.typical[1] ** (1 - t) * p.typical[-1] ** t, p.low, p.high))
            for p in NDFS[name].parameters
            for t in [rng.random()]
        }
        NoV = float(rng.choice([rng.random(), 10 ** rng.uniform(-4, 0), 1 - 10 ** rng.uniform(-4, -1)]))
        got = integrate("weak_furnace", ndf=name, NoV=NoV, device=device, **parameters)
        assert abs(float(got.values) - 1) <= got.error, (name, NoV, parameters, got)


# ---------------------------------------------------------------------------------------------- average albedo


@pytest.mark.parametrize("alpha", [0.01, 0.2, 1.0])
def test_average_albedo_of_ggx(device: Device, alpha: float) -> None:
    # 2∫Eμdμ with μ = x², by 96 Gauss nodes of the 1-D form.
    x, w = reference.gauss(96)
    E, _ = reference.ggx_albedo_1d(x * x, np.full(96, alpha))
    got = integrate("albedo_average", ndf="ggx", alpha=alpha, device=device)
    assert got.values.shape == () and abs(float(got.values) - 4 * (w * x**3) @ E) <= max(got.error, 1e-6) <= 4e-6


@pytest.mark.parametrize("name", [n for n in ISOTROPIC if n != "ggx"])
def test_average_albedo_is_the_average(device: Device, name: str) -> None:
    # By the engine's own albedos at 64 nodes: 1e-6 each.
    x, w = reference.gauss(64)
    values = middle(NDFS[name])
    E = integrate("albedo", ndf=name, NoV=x * x, device=device, **values)
    got = integrate("albedo_average", ndf=name, device=device, **values)
    assert abs(float(got.values) - 4 * (w * x**3) @ E.values) <= got.error + E.error, (name, values)


def test_average_albedo_of_lambert_is_its_albedo(device: Device) -> None:
    got = integrate("albedo_average", diffuse="lambert", albedo=[0.0, 0.18, 1.0], device=device)
    assert np.abs(got.values - [0, 0.18, 1]).max() <= 2e-6  # rounding


# ---------------------------------------------------------------------------------------------- diffuse


@PRECISIONS
@pytest.mark.parametrize("name", [n for n, m in DIFFUSE.items() if "albedo" in m.reference])
def test_diffuse_albedo_against_closed_forms(device: Device, name: str, precision: int) -> None:
    entry = DIFFUSE[name]
    columns = product({"NoV": NOV[1:]} | axes(entry))
    tolerance = 1e-6 if precision == 32 else 1e-9
    want = entry.reference["albedo"](columns["NoV"], **own(columns, "diffuse"))
    finite = np.abs(want) <= 1e3  # Minnaert's of exponent 0 grows like 1/(n·v)
    columns, want = {k: v[finite] for k, v in columns.items()}, want[finite]
    got = integrate("albedo", diffuse=name, precision=precision, tolerance=tolerance, device=device, **columns)
    # Values over 1 are held relatively; a power near 0 costs float32 3e-7 of its logarithm (the entry).
    scale = np.maximum(np.abs(want), 1) * (8 if name == "minnaert" else 1)
    assert_close(got.values, want, 2 * tolerance * scale, columns, (name, got.rule, got.error))
    assert_close(got.values, want, got.error, columns, f"{name}, stated error")


@pytest.mark.parametrize("name", [n for n, m in DIFFUSE.items() if "albedo" not in m.reference])
def test_diffuse_albedo_against_quadrature(device: Device, name: str) -> None:
    """By tanh-sinh over light directions, θ in panels that meet at θv and φ at π/2, where the models have kinks."""
    entry = DIFFUSE[name]
    columns = product({"NoV": NOV[1::3]} | {f"diffuse_{p.name}": np.array(p.typical) for p in entry.parameters})
    x, _, w = reference.double_exponential()
    want = np.zeros(columns["NoV"].size)
    for k, NoV in enumerate(columns["NoV"]):
        parameters = {n: v[k] for n, v in own(columns, "diffuse").items()}
        theta_v = math.acos(NoV)
        v = np.array([math.sin(theta_v), 0, NoV])
        for start, length in ((0.0, theta_v), (theta_v, math.pi / 2 - theta_v)):
            for quarter in (0, 1):
                theta, phi = (start + length * x)[:, None], (quarter + x) * math.pi / 2
                light = np.stack(
                    np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1
                )
                f = entry.reference["f"](light, v, **parameters)
                want[k] += np.einsum("ij,i,j->", f * np.cos(theta) * np.sin(theta), length * w, math.pi * w)
    got = integrate("albedo", diffuse=name, device=device, **columns)
    # 1e-8 of a tan θ at grazing in the reference.
    assert_close(got.values, want, got.error + 1e-8, columns, (name, got.rule, got.error))
    assert got.error <= 1e-5


def test_albedos_add_up(device: Device) -> None:
    NoV = np.linspace(0.05, 1, 7)
    asked: Any = partial(integrate, "albedo", NoV=NoV, device=device)
    whole = asked(ndf="ggx:alpha=.3", fresnel="schlick:f0=.04", diffuse="one_minus_f:albedo=.8,f0=.04")
    parts = [asked(ndf="ggx:alpha=.3", fresnel="schlick:f0=.04"), asked(diffuse="one_minus_f:albedo=.8,f0=.04")]
    assert np.abs(whole.values - parts[0].values - parts[1].values).max() <= 1e-6  # one rounding of the sum
    assert whole.evaluations == parts[0].evaluations + parts[1].evaluations


# ---------------------------------------------------------------------------------------------- a user's files


@pytest.fixture
def files(tmp_path: Path) -> Callable[[str, str], str]:
    def write(name: str, text: str) -> str:
        (tmp_path / f"{name}.clh").write_text(text, encoding="utf-8")
        return str(tmp_path / f"{name}.clh")

    return write


MY_GGX = """// GGX, 7 times too large.
real ndf_my_ggx_D(real cos_m, real sin2_m, real alpha) {
  const real t = alpha * alpha + (1 - alpha) * (1 + alpha) * sin2_m;
  return 7 * sqr(alpha / t) / PI;
}
"""


def test_a_scaled_ndf_is_the_ndf(device: Device, files: Any) -> None:
    mine = files("my_ggx", MY_GGX)
    alpha = np.array([0.003, 0.05, 0.3, 1.0])
    # The raw norm, to the tolerance of the integral relative to 7.
    norm = integrate("normalization", ndf=mine, alpha=alpha, device=device)
    assert np.abs(norm.values - 7).max() <= 7e-6
    columns = product({"NoV": NOV, "alpha": alpha})
    for integral in ("projected_area", "weak_furnace", "albedo", "dfg"):
        for masking in ("smith", "implicit") if integral in ("albedo", "dfg") else ("smith",):
            a, b = (integrate(integral, ndf=ndf, masking=masking, device=device, **columns) for ndf in (mine, "ggx"))
            assert_close(a.values, b.values, a.error + b.error, _like(columns, a.values), (integral, masking))
            assert max(a.error, b.error) <= 1e-5
    averages = [integrate("albedo_average", ndf=ndf, alpha=alpha, device=device) for ndf in (mine, "ggx")]
    assert np.abs(averages[0].values - averages[1].values).max() <= averages[0].error + averages[1].error


def test_a_scaled_ndf_prefilters_as_the_ndf(device: Device, files: Any) -> None:
    image = np.random.default_rng(3).random((16, 32, 3), np.float32)
    mine, built_in = (
        prefilter(image, size=16, min_size=4, ndf=ndf, device=device) for ndf in (files("my_ggx", MY_GGX), "ggx")
    )
    for a, b in zip(mine.levels, built_in.levels, strict=True):
        # Each level is within its error of the truth, 99 % of texels; 1e-3 is the chain's tolerance.
        assert np.abs(a.texels / b.texels - 1).max() <= 1e-3


@pytest.mark.parametrize(
    "power, integral, masking, error, words",
    [
        (1, "albedo", "smith", UnsupportedError, "infinite"),
        (1, "weak_furnace", "smith_separable", UnsupportedError, "infinite"),
        (2, "normalization", "smith", InputError, "normalized"),
        (2, "albedo", "implicit", InputError, "normalized"),
    ],
)
def test_ndfs_without_area_or_norm_are_refused(
    device: Device, files: Any, power: int, integral: str, masking: str, error: type[Exception], words: str
) -> None:
    """1/cosᵏ: the norm of k = 1 is 2π, its area infinite; k = 2 has no norm."""
    mine = files("my_wall", f"real ndf_my_wall_D(real cos_m) {{ return 1 / ({' * '.join(['cos_m'] * power)}); }}")
    view = {"NoV": 0.5} if INTEGRALS[integral].view else {}
    with pytest.raises(error, match=words):
        integrate(integral, ndf=mine, masking=masking, device=device, **view)


def test_an_ndf_of_infinite_area_has_a_norm_and_maskings_that_need_none(device: Device, files: Any) -> None:
    mine = files("my_wall", "real ndf_my_wall_D(real cos_m) { return 1 / cos_m; }")
    assert abs(float(integrate("normalization", ndf=mine, device=device).values) / (2 * math.pi) - 1) <= 1e-6
    assert 0 < float(integrate("albedo", ndf=mine, masking="implicit", NoV=0.5, device=device).values) < 1


@pytest.mark.parametrize(
    "text, error, words",
    [
        ("real ndf_mine_D(real cos_m) { return -1; }", InputError, "negative"),
        ("real ndf_mine_D(real cos_m) { return 0; }", InputError, "0 everywhere"),
        ("real ndf_mine_D(real cos_m) { return sqrt(cos_m - (real).5f); }", InputError, "not finite"),
        ("real ndf_mine_E(real cos_m) { return 1; }", InputError, "ndf_mine_D"),
        ("real ndf_mine_D(int cos_m) { return 1; }", InputError, "real"),
    ],
)
def test_files_that_are_no_ndf(device: Device, files: Any, text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        integrate("normalization", ndf=files("mine", text), device=device)


def test_a_file_that_is_not_there(device: Device, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"none\.clh"):
        integrate("normalization", ndf=str(tmp_path / "none.clh"), device=device)


@pytest.mark.parametrize("precision", [32, 64])
def test_a_users_brdf_against_closed_forms(device: Device, files: Any, precision: int) -> None:
    """f = (a/π, (n·l)(n·v), (l·x)²): albedos a, (2π/3)(n·v) and ∫ x² z dω = π/4."""
    mine = files(
        "mine", "real3 brdf_mine_f(real3 l, real3 v, real a) { return vec3(a * (real)(1 / PI), l.z * v.z, l.x * l.x); }"
    )
    NoV = NOV[1:]
    got = integrate("albedo", brdf=mine, NoV=NoV, a=0.6, phi=0.3, precision=precision, device=device)
    assert got.values.shape == (NoV.size, 3)
    want = np.stack([np.full_like(NoV, 0.6), 2 * math.pi / 3 * NoV, np.full_like(NoV, math.pi / 4)], -1)
    # The default tolerances, relative to the largest value, 2.1; the end of the ladder is stated.
    assert np.abs(got.values - want).max() <= max(got.error, 2.1e-6 if precision == 32 else 2.1e-12)
    assert got.error <= (1e-5 if precision == 32 else 1e-9)
    average = integrate("albedo_average", brdf=mine, a=0.6, device=device)
    assert average.values.shape == (3,)
    # 2∫ (2π/3) μ² dμ = 4π/9
    assert np.abs(average.values - [0.6, 4 * math.pi / 9, math.pi / 4]).max() <= average.error <= 1e-5


# ---------------------------------------------------------------------------------------------- tables


def test_dfg_table(device: Device) -> None:
    """128 x 128 against the 1-D form, row 0 smoothest, y the perceptual roughness."""
    got = dfg(128, device=device)
    assert got.values.shape == (128, 128, 2) and got.values.dtype == np.float32
    axis = (np.arange(128) + 0.5) / 128
    worst = 0.0
    for row in range(0, 128, 3):
        E, Fc = reference.ggx_albedo_1d(axis, np.full(128, axis[row] ** 2), 64, 40)
        worst = max(worst, float(np.abs(got.values[row] - np.stack([E - Fc, Fc], -1)).max()))
    # The table's own tolerance is 5e-6, and 7e-7 was measured.
    assert worst <= 5e-6 and worst <= got.error + 2e-8, (worst, got.error)


def test_dfg_table_of_any_size(device: Device) -> None:
    for size in (1, 7):
        got = dfg(size, device=device)
        axis = (np.arange(size) + 0.5) / size
        y, x = np.meshgrid(axis, axis, indexing="ij")
        E, Fc = reference.ggx_albedo_1d(x.ravel(), y.ravel() ** 2)
        assert np.abs(got.values.reshape(-1, 2) - np.stack([E - Fc, Fc], -1)).max() <= 5e-6  # its tolerance


def test_dfg_keeps_what_is_given_with_the_ndf(device: Device) -> None:
    """GTR's gamma follows roughness as 2, unless it is given."""
    usual, given, steep = (dfg(4, ndf=ndf, device=device).values for ndf in ("gtr", "gtr:gamma=2", "gtr:gamma=1"))
    assert np.array_equal(usual, given) and np.abs(usual - steep).max() > 1e-2


# ---------------------------------------------------------------------------------------------- the interface


def test_broadcasting(device: Device) -> None:
    NoV, alpha = np.linspace(0.1, 1, 5)[:, None], np.array([0.1, 0.5, 1.0])
    table = integrate("albedo", ndf="ggx", NoV=NoV, alpha=alpha, device=device)
    assert table.values.shape == (5, 3)
    pairs = integrate("dfg", ndf="ggx", NoV=NoV, alpha=alpha, device=device)
    assert pairs.values.shape == (5, 3, 2)
    assert np.array_equal(np.asarray(pairs), pairs.values)
    single = integrate("albedo", ndf="ggx", NoV=float(NoV[2, 0]), alpha=0.5, device=device)
    assert single.values.shape == ()
    assert abs(float(single.values) - table.values[2, 1]) <= 4e-6  # two tolerances: the ladder may end elsewhere
    assert integrate("normalization", ndf="ggx:alpha=.3", device=device).values.shape == ()


def test_rgb_adds_an_axis(device: Device) -> None:
    NoV = np.array([0.1, 0.6])
    ask: Any = partial(integrate, "albedo", ndf="ggx", alpha=0.3, device=device)
    gold = ask(fresnel="schlick:gold", NoV=NoV)
    by_hand = ask(fresnel="schlick:f0=1/.71/.29", NoV=NoV)
    each = np.stack([ask(fresnel="schlick", f0=f0, NoV=NoV).values for f0 in (1.0, 0.71, 0.29)], -1)
    assert gold.values.shape == (2, 3)
    assert np.array_equal(gold.values, by_hand.values)
    assert np.abs(gold.values - each).max() <= 4e-6  # two tolerances: the ladder may end elsewhere
    assert ask(fresnel="schlick:gold", NoV=0.5).values.shape == (3,)
    assert ask(fresnel="schlick:gold", NoV=NoV, f0=0.5).values.shape == (2,)  # a number instead of the preset
    assert integrate("albedo_average", diffuse="lambert:albedo=.1/.2/.3", device=device).values.shape == (3,)


def test_names_shared_by_slots_and_qualified_ones(device: Device) -> None:
    ask: Any = partial(integrate, "albedo", ndf="ggx", masking="schlick_smith", NoV=0.3, device=device)
    both = float(ask(alpha=0.3).values)
    assert both == float(ask(ndf_alpha=0.3, masking_alpha=0.3).values)
    assert both == float(ask(alpha=0.3, masking_alpha=0.3).values)
    assert abs(both - float(ask(alpha=0.3, masking_alpha=0.5).values)) > 1e-3
    assert float(ask(alpha=0.5, ndf_alpha=0.3).values) == float(ask(ndf_alpha=0.3, masking_alpha=0.5).values)
    with pytest.raises(UsageError, match="masking schlick_smith needs alpha"):
        ask(ndf_alpha=0.3)


def test_backfacing_views(device: Device) -> None:
    ask: Any = partial(integrate, "albedo", ndf="ggx", alpha=0.3, device=device)
    with pytest.raises(UsageError, match="backfacing"):
        ask(NoV=[-0.5, 0.5])
    front = ask(NoV=[0.0, 0.5]).values
    assert np.array_equal(ask(NoV=[-0.5, 0.5], backfacing="clamp").values, front)
    assert np.array_equal(ask(NoV=[0.0, -0.5], backfacing="absolute").values, front)
    for bad in ({"backfacing": "clmp"}, {"backfacing": "clamp", "NoV": -1.5}, {"backfacing": "absolute", "NoV": -2.0}):
        with pytest.raises(UsageError):
            ask(**{"NoV": -0.5, **bad})


def test_out_and_progress(device: Device, tmp_path: Path) -> None:
    shape = (3, CELLS_A_LAUNCH // 2 + 7)
    NoV, alpha = np.linspace(0.01, 1, shape[1]), np.array([[0.1], [0.4], [0.9]])
    ask: Any = partial(integrate, "dfg", ndf="ggx", NoV=NoV, alpha=alpha, tolerance=1e-2, device=device)
    mapped = np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.float32, (*shape, 2))
    shares: list[float] = []
    got = ask(out=mapped, progress=shares.append)
    assert got.values is mapped and np.array_equal(mapped, ask().values)
    assert shares == sorted(shares) and len(shares) == 2 and shares[-1] == 1
    for bad in (np.empty(shape), np.empty((*shape, 3)), np.empty((2, *shape)).T):
        with pytest.raises(UsageError, match="out"):
            ask(out=bad)


def test_a_stop_in_progress_passes_through(device: Device) -> None:
    def stop(share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        integrate("weak_furnace", ndf="ggx", NoV=0.5, alpha=0.3, device=device, progress=stop)


HUGE = """// A square of 1e25, beyond float32.
real ndf_huge_D(real cos_m) { const real x = cos_m * (real)1e25f; return x * x; }
"""


def test_cells_that_float32_cannot_do_are_promoted_with_a_notice(device: Device, files: Any) -> None:
    if not device.fp64:
        pytest.skip("no float64")
    got = integrate("albedo", ndf=files("huge", HUGE), masking="implicit", NoV=[0.2, 0.5, 0.9], device=device)
    assert got.values.dtype == np.float32
    assert [n for n in got.notices if "float64" in n and n.startswith("3 cells")], got.notices
    # cos² is Phong's D of exponent 2.
    want = integrate("albedo", ndf="phong:exponent=2", masking="implicit", NoV=[0.2, 0.5, 0.9], device=device)
    assert want.notices == ()
    assert np.abs(got.values - want.values).max() <= got.error + want.error


def test_what_is_not_finite_is_refused(device: Device, files: Any) -> None:
    broken = files("broken", "real3 brdf_broken_f(real3 l, real3 v) { return vec3(sqrt(-1 - l.z), 0, 0); }")
    with pytest.raises(CheckError, match="not finite"):
        integrate("albedo", brdf=broken, NoV=0.5, precision=64 if device.fp64 else 32, device=device)


def test_precision(device: Device) -> None:
    assert integrate("weak_furnace", ndf="ggx", NoV=0.5, alpha=0.3, device=device).values.dtype == np.float32
    if device.fp64:
        fine = integrate("weak_furnace", ndf="ggx", NoV=0.5, alpha=0.3, precision=64, device=device)
        assert fine.values.dtype == np.float64 and abs(float(fine.values) - 1) <= fine.error


def test_work_is_counted(device: Device) -> None:
    """Evaluations are the product of cells and of the nodes of every rule that was tried, the last named."""
    ask: Any = partial(integrate, "albedo", ndf="ggx", alpha=0.3, tolerance=1e-2, device=device)
    # Fewer than a block of 64 climb one rule more.
    a, b = ask(NoV=[0.5] * 64), ask(NoV=[0.5] * 65536)
    assert a.rule == b.rule and 0 < 1024 * a.evaluations == b.evaluations
    assert 0 < a.seconds < 60
    assert ask(NoV=[0.5] * 64, tolerance=1e-6).evaluations > a.evaluations


@pytest.mark.parametrize(
    "kwargs, expected",
    [
        ({"name": "albdo", "ndf": "ggx"}, "albedo"),
        ({"name": "albedo", "ndf": "gxx"}, "ggx"),
        ({"name": "albedo", "ndf": "ggx", "masking": "smth"}, "smith"),
        ({"name": "albedo", "ndf": "ggx", "fresnel": "schlik"}, "schlick"),
        ({"name": "albedo", "ndf": "ggx", "fresnel": "schlick:glod"}, "gold"),
        ({"name": "albedo", "diffuse": "lambrt"}, "lambert"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 0.5, "alpa": 0.3, "alpha": 0.2}, "alpha"),
        ({"name": "albedo", "ndf": "ggx:alhpa=.3", "NoV": 0.5}, "alpha"),
        ({"name": "albedo", "ndf": "ggx:alpha=x", "NoV": 0.5}, "number"),
        ({"name": "albedo", "ndf": "ggx:alpha=1/2", "NoV": 0.5}, "three"),
        ({"name": "albedo", "ndf": "ggx:alpha=.1,alpha=.2", "NoV": 0.5}, "once"),
        ({"name": "albedo", "NoV": 0.5}, "ndf"),
        ({"name": "albedo", "ndf": "ggx", "alpha": 0.3}, "NoV"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 0.5}, "alpha"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 0.5, "alpha": 0.3, "phi": 1.0}, "phi"),
        ({"name": "albedo", "ndf": "ggx_anisotropic:alpha_x=.1,alpha_y=.2", "NoV": 0.5, "phi": math.nan}, "phi"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 1.1, "alpha": 0.3}, "1]"),
        ({"name": "albedo", "ndf": "ggx", "NoV": math.nan, "alpha": 0.3}, "NoV"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 0.5, "alpha": 1.5}, "[1e-05, 1]"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 0.5, "alpha": math.nan}, "alpha"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 0.5, "alpha": "rough"}, "number"),
        ({"name": "albedo", "ndf": "ggx", "NoV": [0.5, 0.6], "alpha": [0.1, 0.2, 0.3]}, "broadcast"),
        ({"name": "albedo", "ndf": "ggx", "NoV": [], "alpha": 0.3}, "empty"),
        ({"name": "albedo", "ndf": "ggx", "NoV": "grazing", "alpha": 0.3}, "number"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 0.5, "alpha": 0.3, "precision": 16}, "32"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 0.5, "alpha": 0.3, "tolerance": 0}, "tolerance"),
        ({"name": "albedo", "ndf": "ggx", "NoV": 0.5, "alpha": 0.3, "tolerance": math.nan}, "tolerance"),
        ({"name": "albedo", "ndf": "ggx", "brdf": "x.clh", "NoV": 0.5}, "brdf"),
        ({"name": "albedo_average", "ndf": "ggx", "alpha": 0.5, "NoV": 0.5}, "NoV"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_bad_arguments(device: Device, kwargs: dict[str, Any], expected: str) -> None:
    with pytest.raises(UsageError) as caught:
        integrate(**kwargs, device=device)
    assert expected in str(caught.value) and "\n" not in str(caught.value), caught.value


@pytest.mark.parametrize(
    "kwargs",
    [
        {"name": "dfg", "ndf": "ggx", "diffuse": "lambert"},
        {"name": "normalization", "diffuse": "lambert"},
        {"name": "weak_furnace", "ndf": "ggx", "masking": "neumann", "alpha": 0.3, "NoV": 0.5},
        {"name": "weak_furnace", "brdf": "mine.clh"},
    ],
    ids=str,
)
def test_what_is_not_supported(device: Device, kwargs: dict[str, Any]) -> None:
    with pytest.raises(UnsupportedError):
        integrate(**kwargs, device=device)


@pytest.mark.parametrize("size", [0, -1, 4097])
def test_sizes_of_a_dfg_table(device: Device, size: int) -> None:
    with pytest.raises(UsageError, match="4096"):
        dfg(size, device=device)


def test_entries_by_object(device: Device) -> None:
    by_name = integrate("normalization", ndf="ggx", alpha=0.2, device=device)
    assert integrate("normalization", ndf=NDFS["ggx"], alpha=0.2, device=device).values == by_name.values
    assert integrate("normalization", ndf=chosen("ndf", "ggx:alpha=.2"), device=device).values == by_name.values
    assert chosen("ndf", "ggx").model is NDFS["ggx"]


# ---------------------------------------------------------------------------------------------- another program


def mitsuba_albedo(mitsuba: Any, alpha: float, NoV: float) -> float:
    """∫ f (n·l) dω of mitsuba's rough mirror (GGX, separable Smith, F = 1) by tanh-sinh over light directions."""
    bsdf = mitsuba.load_dict({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha})
    seen = mitsuba.SurfaceInteraction3f()
    theta_v = math.acos(NoV)
    seen.wi = mitsuba.Vector3f(math.sin(theta_v), 0, NoV)
    context = mitsuba.BSDFContext()
    x, _, w = reference.double_exponential(1 / 8)
    total = 0.0
    for start, length in ((theta_v, -theta_v), (theta_v, math.pi / 2 - theta_v)):
        for t, wt in zip(start + length * x, abs(length) * w, strict=True):
            for away, wp in zip(math.pi * x, 2 * math.pi * w, strict=True):
                light = mitsuba.Vector3f(-math.sin(t) * math.cos(away), math.sin(t) * math.sin(away), math.cos(t))
                total += float(bsdf.eval(context, seen, light)[0]) * math.sin(t) * wt * wp
    return total


@pytest.mark.parametrize("alpha, NoV", [(0.1, 0.9), (0.3, 0.3), (1.0, 0.1), (0.5, 0.6)])
def test_separable_smith_against_mitsuba(device: Device, alpha: float, NoV: float) -> None:
    mitsuba: Any = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    got = integrate("albedo", ndf="ggx", masking="smith_separable", NoV=NoV, alpha=alpha, device=device)
    # Float32 of mitsuba, whose D is (α² - 1) cos² + 1 with its cancellation, and a rule of 1e-5.
    assert abs(float(got.values) - mitsuba_albedo(mitsuba, alpha, NoV)) <= 3e-5


def test_an_albedo_that_is_infinite_is_said_to_be(device: Device) -> None:
    # E = albedo · NoV^(k - 1) [Minnaert1941]: at NoV = 0 infinite for k < 1, albedo for k = 1, 0 above.
    got = integrate("albedo", diffuse="minnaert", albedo=0.5, exponent=[0.5, 1.0, 2.0], NoV=0.0, device=device)
    assert got.values[0] == np.inf and np.abs(got.values[1:] - [0.5, 0.0]).max() < 2e-6  # the default 1e-6, rounding
    assert got.error < 2e-6 and got.notices == ()


def test_a_missed_tolerance_is_said(device: Device) -> None:
    # Kelemen's 1/(v·h)² has a root at grazing that no rule resolves to 1e-6.
    missed = integrate("albedo", ndf="ggx", masking="kelemen", alpha=0.3, NoV=1e-4, device=device)
    assert missed.error > 2e-6 and any("over the tolerance" in notice for notice in missed.notices)
    met = integrate("albedo", ndf="ggx", alpha=0.3, NoV=0.5, device=device)
    assert not any("tolerance" in notice for notice in met.notices)


@pytest.mark.parametrize("wrong", [{"tolerance": "fine"}, {"tolerance": True}, {"ndf": 3}, {"masking": None}], ids=str)
def test_what_is_no_number_and_no_name_is_said(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        integrate("albedo", **{"ndf": "ggx", "NoV": 0.5, "alpha": 0.3, **wrong})  # type: ignore[arg-type]
