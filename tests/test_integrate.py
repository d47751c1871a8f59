"""Every integral over every model against exact values and independent quadrature, and the kernels' pieces
against their float64 references."""
from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import pytest

import reference
from whitefurnace import dfg, integrate, source
from whitefurnace.catalogue import INTEGRALS, Integral, Model, models
from whitefurnace.device import Device
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.recipe import chosen

# n·v from grazing to normal, the ends thicker.
NOV = np.array([1e-4, 1e-3, 0.01, 1 / 64, 0.05, 0.15, 0.4, 0.7, 0.9, 0.99, 0.9999, 1.0])
PRECISIONS = pytest.mark.parametrize("precision", [32, 64])


def slots_of(entry: Integral) -> list[str]:
    return [slot for slot in ("ndf", "masking", "fresnel") if any(n.startswith(slot.upper()) for n in entry.needs)]


def combinations() -> list[tuple[str, dict[str, str]]]:
    """(integral, models by slot): all that fit together, so that a new entry is tested by being there."""
    found = []
    for entry in INTEGRALS.values():
        slots = slots_of(entry)
        for names in itertools.product(*(models(slot) for slot in slots)):
            used = {slot: models(slot)[name] for slot, name in zip(slots, names, strict=True)}
            provided = {f for m in used.values() for f in m.provides}
            needed = {*entry.needs, *(f for m in used.values() for f in m.needs)}
            if needed <= provided and used["ndf"].isotropic:
                found.append((entry.name, dict(zip(slots, names, strict=True))))
    return found


COMBINATIONS = combinations()
IDS = ["-".join([name, *chosen_models.values()]) for name, chosen_models in COMBINATIONS]


def cells(entry: Integral, names: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Keyword arguments: n·v times the product of every parameter's typical values, flattened."""
    axes: dict[str, Any] = {"NoV": NOV} if entry.view else {}
    for slot, name in names.items():
        for p in models(slot)[name].parameters:
            axes[f"{slot}_{p.name}"] = np.array(p.typical)
    return {k: v.ravel() for k, v in zip(axes, np.meshgrid(*axes.values(), indexing="ij"), strict=True)}


def of_slot(arguments: Mapping[str, np.ndarray], slot: str) -> dict[str, np.ndarray]:
    return {k.removeprefix(f"{slot}_"): v for k, v in arguments.items() if k.startswith(f"{slot}_")}


# ---------------------------------------------------------------------------------------------- truths


Truth = Callable[[Mapping[str, str], Mapping[str, np.ndarray]], "tuple[np.ndarray, np.ndarray] | None"]
"""(indices of the cells it speaks of, values), or None where it knows nothing."""


def everywhere(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(len(value)), value


def one(names: Mapping[str, str], arguments: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    if not models("ndf")[names["ndf"]].facts.get("normalized"):
        return None
    return everywhere(np.ones(len(next(iter(arguments.values())))))


def furnace(names: Mapping[str, str], arguments: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    """1 where the masking says so."""
    fact = models("masking")[names["masking"]].facts.get("weak furnace")
    return None if fact is None else everywhere(np.full(len(arguments["NoV"]), fact))


def smith_area(names: Mapping[str, str], arguments: Mapping[str, np.ndarray],
               ) -> tuple[np.ndarray, np.ndarray] | None:
    """n·v (1 + Λ(v)) [Heitz2014, eq. 30], for NDFs with a closed Λ."""
    entry = models("ndf")[names["ndf"]]
    if "lambda" not in entry.reference:
        return None
    NoV = arguments["NoV"]
    with np.errstate(divide="ignore"):  # a = cot θ/α is infinite at normal incidence
        return everywhere(NoV * (1 + entry.reference["lambda"](NoV, **of_slot(arguments, "ndf"))))


def over_lights(names: Mapping[str, str], arguments: Mapping[str, np.ndarray],
                fresnel: Callable[[int, np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    """Quadrature over light directions, where it is good to 1e-7: n·v ≥ .3 and lobes of .2 and wider."""
    ndf = models("ndf")[names["ndf"]]
    if "lambda" not in ndf.reference or "alpha" not in of_slot(arguments, "ndf"):
        return None
    masking = models("masking")[names["masking"]].reference["G"]
    index, values = [], []
    for k in map(int, np.flatnonzero((arguments["NoV"] >= 0.3) & (arguments["ndf_alpha"] >= 0.2))):
        own = {name: v[k] for name, v in of_slot(arguments, "ndf").items()}

        def G(v: np.ndarray, light: np.ndarray, own: dict[str, Any] = own) -> np.ndarray:
            with np.errstate(divide="ignore"):
                return masking(ndf.reference["lambda"](v, **own), ndf.reference["lambda"](light, **own))

        index.append(k)
        values.append(reference.albedo_over_lights(partial(ndf.reference["D"], **own), G, partial(fresnel, k),
                                                   float(arguments["NoV"][k]), float(own["alpha"])))
    return np.array(index), np.array(values)


def albedo(names: Mapping[str, str], arguments: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    model = models("fresnel")[names["fresnel"]]
    own = of_slot(arguments, "fresnel")
    return over_lights(names, arguments, lambda k, c: model.reference["F"](c, **{n: v[k] for n, v in own.items()}))


def split_sum(names: Mapping[str, str], arguments: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    parts = [over_lights(names, arguments, f) for f in
             (lambda k, c: 1 - (1 - c) ** 5, lambda k, c: (1 - c) ** 5)]
    if parts[0] is None or parts[1] is None:
        return None
    return parts[0][0], np.stack([parts[0][1], parts[1][1]], -1)


TRUTHS: dict[str, Truth] = {"normalization": one, "projected_area": smith_area, "weak_furnace": furnace,
                            "albedo": albedo, "dfg": split_sum}

# Quadrature over lights is good to 1e-7; closed forms to rounding.
TRUTH_ERROR = {"albedo": 1e-7, "dfg": 1e-7}


def test_every_integral_has_a_truth() -> None:
    assert set(TRUTHS) == set(INTEGRALS)


@PRECISIONS
@pytest.mark.parametrize("name, names", COMBINATIONS, ids=IDS)
def test_integrals(device: Device, name: str, names: dict[str, str], precision: int) -> None:
    if precision == 64 and not device.fp64:
        pytest.skip("no float64")
    arguments = cells(INTEGRALS[name], names)
    known = TRUTHS[name](names, arguments)
    if known is None:
        pytest.skip(f"no truth of {name} for {names}")
    index, want = known
    got = integrate(name, **names, precision=precision, device=device, **arguments)  # type: ignore[arg-type]
    error = np.abs(got.values[index] - want)
    at = np.unravel_index(error.argmax(), error.shape)
    cell = {k: v[index[at[0]]] for k, v in arguments.items()}
    context = f"{name} {names} at {cell}: got {got.values[index][at]}, wanted {want[at]}, stated {got.error:.1e}"
    slack = TRUTH_ERROR.get(name, 0.0)
    assert error.max() <= got.error + slack, context
    # The default tolerance of the design with float32's 2e-6 of values up to 1. In float64 the design's 1e-12 is met
    # away from the ends; where n·v and α are both 1e-4 the ladder ends at 1e-9, and says so.
    assert error.max() <= (4e-6 if precision == 32 else 1e-9 if slack == 0 else slack), context
    assert got.evaluations > 0 and got.seconds > 0 and got.rule.startswith("gauss-")


@pytest.mark.parametrize("name", ["normalization", "weak_furnace", "projected_area"])
def test_float64_reaches_its_tolerance(device: Device, name: str) -> None:
    if not device.fp64:
        pytest.skip("no float64")
    NoV, alpha = (a.ravel() for a in np.meshgrid([0.05, 0.2, 0.5, 0.9, 1.0], [0.05, 0.2, 0.3, 0.5, 1.0]))
    view: dict[str, Any] = {"NoV": NoV} if INTEGRALS[name].view else {}
    got = integrate(name, ndf="ggx", alpha=alpha, precision=64, device=device, **view)
    known = TRUTHS[name]({"ndf": "ggx", "masking": "smith"}, {**view, "ndf_alpha": alpha})
    assert known is not None
    error = float(np.abs(got.values - known[1]).max())
    # The design's default for float64.
    assert error <= got.error <= 1.1e-12, (name, error, got.error, got.rule)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize("name", ["weak_furnace", "dfg"])
def test_the_stated_error_is_not_less_than_the_true_one(device: Device, name: str, tolerance: float) -> None:
    NoV, alpha = (a.ravel() for a in np.meshgrid(NOV[1:], models("ndf")["ggx"].parameters[0].typical))
    got = integrate(name, ndf="ggx", NoV=NoV, alpha=alpha, tolerance=tolerance, device=device)
    if name == "dfg":
        E, Fc = reference.ggx_albedo_1d(NoV, alpha)
        want = np.stack([E - Fc, Fc], -1)
    else:
        want = np.ones_like(NoV)
    true = np.abs(got.values - want).max()
    # 2e-8: the 1-D reference.
    assert true <= got.error + 2e-8, (name, tolerance, got.rule, true, got.error)
    assert got.error <= tolerance + 4e-6, (name, tolerance, got.rule, got.error)  # + rounding of values up to 2


# ---------------------------------------------------------------------------------------------- GGX, 1-D


@PRECISIONS
def test_ggx_against_the_azimuth_in_closed_form(device: Device, precision: int) -> None:
    if precision == 64 and not device.fp64:
        pytest.skip("no float64")
    NoV, alpha = (a.ravel() for a in np.meshgrid(NOV, [1e-4, 1e-3, 0.01, 0.05, 0.2, 0.5, 1.0]))
    E, Fc = reference.ggx_albedo_1d(NoV, alpha)
    kwargs: dict[str, Any] = {"ndf": "ggx", "NoV": NoV, "alpha": alpha, "precision": precision, "device": device,
                              "tolerance": 1e-6 if precision == 32 else 1e-8}
    albedos, pairs = integrate("albedo", **kwargs), integrate("dfg", **kwargs)
    # 1e-6 for the rule and twice float32's 6e-8 for each of ten roundings; the 1-D form is good to 2e-8.
    tolerance = 2.5e-6 if precision == 32 else 4e-8
    for got, want in ((albedos.values, E), (pairs.values[:, 0], E - Fc), (pairs.values[:, 1], Fc)):
        error = np.abs(got - want)
        k = error.argmax()
        assert error[k] <= tolerance, (NoV[k], alpha[k], got[k], want[k], error[k])
    # Schlick's F of the albedo, on the same nodes, puts the pair together: F0 A + F90 B.
    schlick = integrate("albedo", **kwargs, fresnel="schlick:f90=.9", f0=0.04).values
    together = 0.04 * pairs.values[:, 0] + 0.9 * pairs.values[:, 1]
    assert np.abs(schlick - together).max() <= tolerance


def test_dfg_table(device: Device) -> None:
    """128 x 128 against the 1-D form at every cell, row 0 smoothest, y the perceptual roughness."""
    got = dfg(128, device=device)
    assert got.values.shape == (128, 128, 2) and got.values.dtype == np.float32
    axis = (np.arange(128) + 0.5) / 128
    worst = 0.0
    for row in range(0, 128, 3):
        E, Fc = reference.ggx_albedo_1d(axis, np.full(128, axis[row] ** 2), 64, 40)
        worst = max(worst, float(np.abs(got.values[row] - np.stack([E - Fc, Fc], -1)).max()))
    # The issue asks for 1e-5; the table's own tolerance is 5e-6, and 7e-7 was measured.
    assert worst <= 5e-6 and worst <= got.error + 2e-8, (worst, got.error)


def test_dfg_table_of_any_size(device: Device) -> None:
    for size in (1, 7):
        got = dfg(size, device=device)
        axis = (np.arange(size) + 0.5) / size
        y, x = np.meshgrid(axis, axis, indexing="ij")
        E, Fc = reference.ggx_albedo_1d(x.ravel(), y.ravel() ** 2)
        assert np.abs(got.values.reshape(-1, 2) - np.stack([E - Fc, Fc], -1)).max() <= 5e-6  # its tolerance


# ---------------------------------------------------------------------------------------------- pieces


def evaluate(device: Device, slots: Mapping[str, Model], call: str, columns: list[np.ndarray], precision: int,
             names: list[str]) -> np.ndarray:
    """`call`, an expression of the arrays `names` and of the models' parameters, by one lane an element."""
    kind = np.dtype(f"f{precision // 8}")
    order = [f"{slot}_{name}" for slot, name in source.cell_parameters(slots)]
    assert len(columns) == len(names) + len(order)
    loads = "".join(f"const real {n} = in[{k} * count + g];\n" for k, n in enumerate([*names, *order]))
    body = (f"__kernel void evaluate(__global scalar *out, const int count, __global const scalar *in) {{\n"
            f"const int g = get_global_id(0);\nif (g >= count) return;\n{loads}out[g] = {call};\n}}\n")
    text = source._assemble(["real.clh", ("bindings", source._bindings(slots)),
                             *(m.kernel_file for m in slots.values()), ("evaluate", body)]).text
    block = np.stack(np.broadcast_arrays(*columns)).astype(kind)
    count = block.shape[1]
    out = device.empty(count, kind)
    size = device.local_size
    device.launch(device.build(text, {"W": 1, "T": 1, "PRECISION": precision}).kernel("evaluate"),
                  (-(-count // size) * size,), (out, np.int32(count), device.array(block)))
    return out.read().astype(np.float64)


# Angles with both ends thicker: 1e-5 … 1e-2, the middle, and as near to π/2.
ANGLES = np.concatenate([np.geomspace(1e-5, 0.1, 25), np.linspace(0.1, 1.47, 25),
                         math.pi / 2 - np.geomspace(0.1, 1e-3, 15)])


def grid(entry: Model, *axes: np.ndarray) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
    """The product of `axes` and of the entry's typical values and ends, flattened, in float32's numbers."""
    sides = [np.unique([*p.typical, *(v for v in (p.low, p.high) if math.isfinite(v))]) for p in entry.parameters]
    values = [v.ravel().astype(np.float32).astype(np.float64) for v in np.meshgrid(*axes, *sides, indexing="ij")]
    return values[:len(axes)], {p.name: v for p, v in zip(entry.parameters, values[len(axes):], strict=True)}


def check_piece(got: np.ndarray, wanted: Callable[[np.ndarray], np.ndarray], x: np.ndarray, precision: int,
                context: str, ulps: float = 8, floor: float = 0.0) -> None:
    """Within `ulps` roundings, `floor` and what the reference itself changes by when its cosine x is rounded."""
    with np.errstate(divide="ignore", over="ignore"):
        want = wanted(x)
        unsure = np.maximum(np.abs(wanted(x * (1 + 2**-52)) - want), np.abs(wanted(x * (1 - 2**-52)) - want))
    tolerance = ulps * (2**-24 if precision == 32 else 2**-53) * np.abs(want) + 4 * unsure + floor
    finite = np.isfinite(want) & (np.abs(want) < (1e37 if precision == 32 else 1e300))
    bad = finite & ~(np.abs(got - want) <= tolerance)
    k = int(np.argmax(np.where(finite, np.abs(got - want) / np.maximum(tolerance, 1e-300), 0)))
    assert not bad.any(), f"{context}: at cosine {x[k]!r} got {got[k]}, wanted {want[k]}, {bad.sum()} bad"


@PRECISIONS
@pytest.mark.parametrize("name", models("ndf"))
def test_ndf_pieces(device: Device, name: str, precision: int) -> None:
    entry = models("ndf")[name]
    if precision == 64 and not device.fp64:
        pytest.skip("no float64")
    (angle,), parameters = grid(entry, ANGLES)
    columns = list(parameters.values())
    kind = np.float32 if precision == 32 else np.float64
    if "NDF_D" in entry.provides:
        cosine, sin2 = np.cos(angle), (np.sin(angle) ** 2).astype(kind).astype(np.float64)
        # The kernel is given sin² too, and from it the reference its cosine.
        cosine = np.sqrt(1 - sin2) if precision == 32 else cosine
        got = evaluate(device, {"ndf": entry}, "NDF_D(cosine, sin2)", [cosine, sin2, *columns], precision,
                       ["cosine", "sin2"])
        check_piece(got, lambda c: entry.reference["D"](c, **parameters), cosine, precision, f"{name} D")
        behind = evaluate(device, {"ndf": entry}, "NDF_D(-cosine, sin2)", [cosine, sin2, *columns], precision,
                          ["cosine", "sin2"])
        assert not behind.any(), f"{name}: D is 0 for backfacing m"
    if "NDF_LAMBDA" in entry.provides:
        cosine = np.cos(angle).astype(kind).astype(np.float64)
        got = evaluate(device, {"ndf": entry}, "NDF_LAMBDA(cosine)", [cosine, *columns], precision, ["cosine"])
        inside = cosine < 1
        own = {k: v[inside] for k, v in parameters.items()}
        # A reference may be a difference from 1, as (√(1 + x) - 1)/2 is: two of its roundings, absolute.
        check_piece(got[inside], lambda c: entry.reference["lambda"](c, **own), cosine[inside], precision,
                    f"{name} Λ", floor=2**-52)
        assert (got[~inside] == 0).all(), f"{name}: Λ is 0 at normal incidence"


@PRECISIONS
@pytest.mark.parametrize("name", models("masking"))
@pytest.mark.parametrize("ndf", [n for n, m in models("ndf").items() if "NDF_LAMBDA" in m.provides])
def test_masking_pieces(device: Device, name: str, ndf: str, precision: int) -> None:
    if precision == 64 and not device.fp64:
        pytest.skip("no float64")
    entry, facets = models("masking")[name], models("ndf")[ndf]
    slots = {"ndf": facets, "masking": entry}
    (v, light), parameters = grid(facets, np.cos(ANGLES[::4]), np.cos(ANGLES[1::5]))
    own = [np.full_like(v, p.typical[0]) for p in entry.parameters]
    columns = [v, light, *parameters.values(), *own]

    def lam(c: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return facets.reference["lambda"](np.minimum(c, 1.0), **parameters)

    if "MASKING_G1" in entry.provides:
        got = evaluate(device, slots, "MASKING_G1(v)", columns, precision, ["v", "l"])
        check_piece(got, lambda c: entry.reference["G1"](lam(c)), v, precision, f"{name} G1 of {ndf}")
    if "MASKING_G" in entry.provides:
        got = evaluate(device, slots, "MASKING_G(v, l)", columns, precision, ["v", "l"])
        check_piece(got, lambda c: entry.reference["G"](lam(c), lam(light)), v, precision, f"{name} G of {ndf}")
        assert not evaluate(device, slots, "MASKING_G(v, -l)", columns, precision, ["v", "l"]).any()
        if entry.facts.get("reciprocal"):
            swapped = evaluate(device, slots, "MASKING_G(l, v)", columns, precision, ["v", "l"])
            # Two sums in another order.
            assert np.abs(swapped - got).max() <= (3e-7 if precision == 32 else 1e-15)


@PRECISIONS
@pytest.mark.parametrize("name", models("fresnel"))
def test_fresnel_pieces(device: Device, name: str, precision: int) -> None:
    if precision == 64 and not device.fp64:
        pytest.skip("no float64")
    entry = models("fresnel")[name]
    (cosine,), parameters = grid(entry, np.cos(ANGLES))
    columns = [cosine, *parameters.values()]
    got = evaluate(device, {"fresnel": entry}, "FRESNEL_F(cosine)", columns, precision, ["cosine"])
    want = entry.reference["F"](cosine, **parameters)
    # Absolute: F is a sum of two parts of size 1 at most, (1 - c)⁵ five roundings.
    assert np.abs(got - want).max() <= (4e-7 if precision == 32 else 1e-15)


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


def test_precision(device: Device) -> None:
    assert integrate("weak_furnace", ndf="ggx", NoV=0.5, alpha=0.3, device=device).values.dtype == np.float32
    if device.fp64:
        fine = integrate("weak_furnace", ndf="ggx", NoV=0.5, alpha=0.3, precision=64, device=device)
        assert fine.values.dtype == np.float64 and abs(float(fine.values) - 1) <= fine.error


def test_work_is_counted(device: Device) -> None:
    """Evaluations are the product of cells and of the nodes of every rule that was tried, the last named."""
    a = integrate("albedo", ndf="ggx", NoV=0.5, alpha=0.3, tolerance=1e-2, device=device)
    b = integrate("albedo", ndf="ggx", NoV=[0.5] * 10, alpha=0.3, tolerance=1e-2, device=device)
    assert b.evaluations == 10 * a.evaluations and a.rule == b.rule
    assert 0 < a.seconds < 60
    c = integrate("albedo", ndf="ggx", NoV=0.5, alpha=0.3, tolerance=1e-6, device=device)
    assert c.evaluations > a.evaluations


@pytest.mark.parametrize("kwargs, expected", [
    ({"name": "albdo", "ndf": "ggx"}, "albedo"),
    ({"name": "albedo", "ndf": "gxx"}, "ggx"),
    ({"name": "albedo", "ndf": "ggx", "masking": "smth"}, "smith"),
    ({"name": "albedo", "ndf": "ggx", "fresnel": "schlik"}, "schlick"),
    ({"name": "albedo", "ndf": "ggx", "NoV": 0.5, "alpa": 0.3, "alpha": 0.2}, "alpha"),
    ({"name": "albedo", "ndf": "ggx:alhpa=.3", "NoV": 0.5}, "alpha"),
    ({"name": "albedo", "NoV": 0.5}, "ndf"),
    ({"name": "albedo", "ndf": "ggx", "alpha": 0.3}, "NoV"),
    ({"name": "albedo", "ndf": "ggx", "NoV": 0.5}, "alpha"),
    ({"name": "albedo", "ndf": "ggx", "NoV": 0.0, "alpha": 0.3}, "1e-05"),
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
], ids=lambda value: value if isinstance(value, str) else None)
def test_bad_arguments(device: Device, kwargs: dict[str, Any], expected: str) -> None:
    with pytest.raises(UsageError) as caught:
        integrate(**kwargs, device=device)
    assert expected in str(caught.value) and "\n" not in str(caught.value), caught.value


def test_what_is_not_supported(device: Device) -> None:
    with pytest.raises(UnsupportedError):
        integrate("albedo", ndf="ggx", diffuse="lambert", NoV=0.5, alpha=0.3, device=device)
    with pytest.raises(UsageError):
        dfg(0, device=device)


def test_entries_by_object(device: Device) -> None:
    by_name = integrate("normalization", ndf="ggx", alpha=0.2, device=device)
    assert integrate("normalization", ndf=models("ndf")["ggx"], alpha=0.2, device=device).values == by_name.values
    assert chosen("ndf", "ggx").model is models("ndf")["ggx"]
