"""Masking, Fresnel and diffuse models: kernels against their float64 references, limits, symmetry, and the facts that
the entries state. A new model is tested by being there."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping

import mpmath
import numpy as np
import pytest
from scipy import integrate as quadrature

from whitefurnace.catalogue import Model
from whitefurnace.catalogue.registry import models
from whitefurnace.opencl import source
from whitefurnace.opencl.device import Device

EPS = {32: 2.0**-23, 64: 2.0**-52}

# From grazing to normal, the ends thicker.
COSINES = np.array([1e-7, 1e-5, 1e-4, 1e-3, 0.01, 0.05, 1 / 7, 0.25, 0.4, 0.6, 0.75, 0.9, 0.99, 0.9999, 1.0])
AZIMUTHS = np.array([0.0, 1e-3, 0.5, np.pi / 2, 1.9, 2.7, np.pi])

SHADING = [entry for slot in ("masking", "fresnel", "diffuse") for entry in models(slot).values()]
LANES = pytest.mark.parametrize("lanes", [1, None], ids=["W1", "device"])
PRECISIONS = pytest.mark.parametrize("precision", [32, 64])


def every(slot: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("entry", models(slot).values(), ids=list(models(slot)))


def product(*axes: np.ndarray) -> list[np.ndarray]:
    return [axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")]


def parameters(entry: Model) -> list[np.ndarray]:
    """The ends of the domain, the typical values, and five between."""
    return [np.unique([p.low, p.high, *p.typical, *np.linspace(p.low, p.high, 7)[1:-1]]) for p in entry.parameters]


def rounded(values: np.ndarray, precision: int) -> np.ndarray:
    """What the device sees, as float64."""
    return np.asarray(values).astype(f"f{precision // 8}").astype(np.float64)


def inside(entry: Model, values: list[np.ndarray], precision: int) -> dict[str, np.ndarray]:
    """Parameters as the device sees them, by name."""
    return {p.name: rounded(v, precision) for p, v in zip(entry.parameters, values, strict=True)}


def evaluate(
    device: Device, function: str, slots: Mapping[str, Model], rows: list[np.ndarray], precision: int, lanes: int | None
) -> np.ndarray:
    """A kernel function at `rows`: its own arguments, then each slot's parameters. Lanes past the end repeat."""
    kind, lanes = np.dtype(f"f{precision // 8}"), lanes or device.lanes(precision)
    program = device.build(source.evaluation(function, slots).text, {"W": lanes, "T": 1, "PRECISION": precision})
    cells, step = np.array(rows), lanes * device.local_size
    count = cells.shape[1]
    padded = -(-count // step) * step
    out = device.empty((padded,), kind)
    sent = device.array(np.pad(cells, ((0, 0), (0, padded - count)), mode="edge").astype(kind))
    device.launch(program.kernel("evaluate"), (padded // lanes,), (out, np.int32(padded), sent))
    return out.read()[:count].astype(np.float64)


def check(got: np.ndarray, want: np.ndarray, allowed: np.ndarray | float, **inputs: np.ndarray) -> None:
    """Fails with the inputs of the worst cell."""
    excess = np.where(np.isfinite(got), np.abs(got - want), np.inf) / allowed
    worst = int(np.argmax(excess))
    assert excess[worst] <= 1, (
        f"got {got[worst]!r}, want {np.broadcast_to(want, got.shape)[worst]!r}, error / allowed {excess[worst]:.3g} at "
        + ", ".join(f"{name} = {np.array2string(np.asarray(v)[worst])}" for name, v in inputs.items())
    )


@pytest.fixture(autouse=True)
def float64_where_there_is_some(request: pytest.FixtureRequest) -> None:
    if "device" in request.fixturenames and request.getfixturevalue("precision") == 64:
        device = request.getfixturevalue("device")
        if not device.fp64:
            pytest.skip(f"{device.name} has no float64")


@pytest.mark.parametrize("entry", SHADING, ids=[f"{m.slot}-{m.name}" for m in SHADING])
def test_presets_and_typical_values_stay_in_the_domain(entry: Model) -> None:
    known = {p.name: p for p in entry.parameters}
    for name, preset in entry.presets.items():
        for key, values in preset.items():
            known[key].check(values, f"{entry.name}:{name}")
    for p in entry.parameters:
        p.check(p.typical, entry.name)


# ---------------------------------------------------------------------------------------------- masking


def directions(cos_l: np.ndarray, cos_v: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """l and v, (..., 3), v in the plane of x."""
    sin_l, sin_v = (np.sqrt((1 - c) * (1 + c)) for c in (cos_l, cos_v))
    return (
        np.stack([sin_l * np.cos(phi), sin_l * np.sin(phi), cos_l], -1),
        np.stack([sin_v, np.zeros_like(sin_v), cos_v], -1),
    )


def ggx_area(cosine: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """A of GGX, here only to have one."""
    return (cosine + np.sqrt(cosine**2 + alpha**2 * (1 - cosine) * (1 + cosine))) / 2


def pairs(
    entry: Model, precision: int, lights: np.ndarray = COSINES
) -> tuple[list[np.ndarray], dict[str, np.ndarray], np.ndarray]:
    """(NoV, NoL, NoH, VoH, at_v, at_l), the model's parameters, and the α that made at_v and at_l."""
    own = parameters(entry)[:1] or [np.array([1e-4, 0.03, 0.3, 1.0])]
    own += [np.array(p.typical) for p in entry.parameters[1:]]  # fewer, as cells multiply
    NoV, NoL, phi, *numbers = product(np.append(0.0, COSINES), lights, AZIMUTHS, *own)
    alpha = numbers[0]
    to_l, to_v = directions(NoL, NoV, phi)
    length = np.linalg.norm(to_l + to_v, axis=-1)
    keep = length > 1e-6  # l = -v has no half vector
    rows = [NoV, NoL, (NoL + NoV) / np.maximum(length, 1e-300), length / 2, ggx_area(NoV, alpha), ggx_area(NoL, alpha)]
    rows = [rounded(row[keep], precision) for row in rows]
    given = [column[keep] for column in numbers][: len(entry.parameters)]
    return rows, inside(entry, given, precision), alpha[keep]


def masked(
    device: Device,
    entry: Model,
    function: str,
    rows: list[np.ndarray],
    own: Mapping[str, np.ndarray],
    alpha: np.ndarray,
    precision: int,
    lanes: int | None,
) -> np.ndarray:
    """A function of a masking model; `smith` is built over GGX, which only its MASKING_AT would ask."""
    slots, extra = {"masking": entry}, []
    if entry.needs:
        slots, extra = {"ndf": models("ndf")["ggx"], "masking": entry}, [alpha]
    return evaluate(device, function, slots, [*rows, *extra, *own.values()], precision, lanes)


@every("masking")
@LANES
@PRECISIONS
def test_masking_is_its_reference(entry: Model, device: Device, precision: int, lanes: int | None) -> None:
    rows, own, alpha = pairs(entry, precision)
    names = dict(zip(("NoV", "NoL", "NoH", "VoH", "at_v", "at_l"), rows, strict=True), **own)
    # A handful of multiplications and one division, each half an ulp, a difference that does not cancel. Cook and
    # Torrance's reference takes (n·h) from the cosines, and (v·h) twice, which their own rounding tells apart. An entry
    # whose kernel has costlier functions states its own error.
    for function, name in (("MASKING_V", "V"), ("MASKING_G", "G")):
        allowed = entry.checks.tolerance.get(f"kernel {name}", (6 * EPS[32], 6 * EPS[64]))[precision == 64]
        got = masked(device, entry, function, rows, own, alpha, precision, lanes)
        want = entry.reference[name](*rows, **own)
        known = np.isfinite(want)
        check(
            np.where(known, got, 0.0),
            np.where(known, want, 0.0),
            allowed * np.where(known, np.maximum(np.abs(want), 1e-30), 1.0),
            **names,
        )
        assert np.isfinite(got).all()


@every("masking")
@PRECISIONS
def test_visibility_is_g_over_both_cosines(entry: Model, device: Device, precision: int) -> None:
    rows, own, alpha = pairs(entry, precision)
    V, G = (masked(device, entry, f, rows, own, alpha, precision, None) for f in ("MASKING_V", "MASKING_G"))
    check(V * rows[0] * rows[1], G, 6 * EPS[precision], NoV=rows[0], NoL=rows[1], V=V, **own)
    # n·h and v·h were rounded each for itself, so that G of Cook and Torrance or Kelemen passes 1 by that much.
    assert G.min() >= 0 and G.max() <= 1 + 6 * EPS[precision]


@every("masking")
@PRECISIONS
def test_light_from_below_is_masked(entry: Model, device: Device, precision: int) -> None:
    rows, own, alpha = pairs(entry, precision, np.array([0.0, -1e-7, -0.3, -0.99, -1.0]))
    V, G = (masked(device, entry, f, rows, own, alpha, precision, None) for f in ("MASKING_V", "MASKING_G"))
    assert np.isfinite(V).all()
    assert (G == 0).all()


@every("masking")
@PRECISIONS
def test_masking_is_as_reciprocal_as_it_says(entry: Model, device: Device, precision: int) -> None:
    rows, own, alpha = pairs(entry, precision)
    lit = rows[0] > 0  # n·v = 0 would become a light that is hidden
    rows, own, alpha = [row[lit] for row in rows], {name: v[lit] for name, v in own.items()}, alpha[lit]
    back = [rows[1], rows[0], rows[2], rows[3], rows[5], rows[4]]
    there, again = (masked(device, entry, "MASKING_G", r, own, alpha, precision, None) for r in (rows, back))
    if entry.checks.reciprocal:
        same = np.ones(len(there), bool)
    else:
        assert entry.checks.reciprocal is False and entry.checks.reciprocal_at
        same = np.all([own[name] == value for name, value in entry.checks.reciprocal_at.items()], axis=0)
        assert np.abs(there - again)[~same].max() > 1e-3
    assert same.any()
    where = {"NoV": rows[0], "NoL": rows[1], **own}
    check(there[same], again[same], 6 * EPS[precision], **{name: v[same] for name, v in where.items()})


@pytest.mark.parametrize(
    "entry", [m for m in models("masking").values() if "MASKING_G1" in m.provides], ids=lambda m: m.name
)
@PRECISIONS
def test_masking_of_one_direction(entry: Model, device: Device, precision: int) -> None:
    """G1 is its reference, and G with the light at the normal, which is never shadowed."""
    rows, own, alpha = pairs(entry, precision, np.array([1.0]))
    G1 = masked(device, entry, "MASKING_G1", [rows[0], rows[4]], own, alpha, precision, None)
    check(G1, entry.reference["G1"](rows[0], rows[4], **own), 4 * EPS[precision], NoV=rows[0], **own)
    G = masked(device, entry, "MASKING_G", rows, own, alpha, precision, None)
    check(G, G1, 6 * EPS[precision], NoV=rows[0], **own)


@pytest.mark.parametrize(("NoV", "NoL"), [(1e-4, 0.3), (0.1, 0.1), (0.3, 0.49), (0.51, 0.02), (0.7, 0.999), (1.0, 1.0)])
def test_masking_of_sheen_in_more_digits(NoV: float, NoL: float) -> None:
    """Both formulas as the papers print them, the 4 of f = D F V/4 apart, in 40 digits."""
    given = {"NoV": NoV, "NoL": NoL, "NoH": 0.5, "VoH": 0.5, "at_v": 0.0, "at_l": 0.0}
    with mpmath.workdps(40):
        v, light = mpmath.mpf(NoV), mpmath.mpf(NoL)
        neubelt = 4 / (4 * (light + v - light * v))
        assert float(models("masking")["ashikhmin"].reference["V"](**given)) == pytest.approx(float(neubelt), rel=1e-14)
        for alpha, softening in ((0.0, 0.0), (0.04, 0.0), (0.3, 1.0), (1.0, 0.5)):
            # p(r) = (1 - r)² p₀ + (1 - (1 - r)²) p₁ with the table of the paper.
            share = (1 - mpmath.mpf(alpha)) ** 2
            a, b, c, d, e = (
                share * mpmath.mpf(smooth) + (1 - share) * mpmath.mpf(rough)
                for smooth, rough in (
                    ("25.3245", "21.5473"),
                    ("3.32435", "3.82987"),
                    ("0.16801", "0.19823"),
                    ("-1.27393", "-1.97760"),
                    ("-4.85967", "-4.32054"),
                )
            )

            def fit(x, a=a, b=b, c=c, d=d, e=e):
                return a / (1 + b * x**c) + d * x + e

            def lam(x, fit=fit):
                half = mpmath.mpf(1) / 2
                return mpmath.exp(fit(x)) if x < half else mpmath.exp(2 * fit(half) - fit(1 - x))

            soft = lam(light) ** (1 + 2 * mpmath.mpf(softening) * (1 - light) ** 8)
            want = 1 / (1 + lam(v) + soft)
            own = {"alpha": alpha, "softening": softening}
            entry = models("masking")["estevez_kulla"]
            # exp of logs up to 20 in float64.
            assert float(entry.reference["G"](**given, **own)) == pytest.approx(float(want), rel=1e-13), own
            assert float(entry.reference["V"](**given, **own)) == pytest.approx(float(want / v / light), rel=1e-13), own


def test_schlick_is_as_far_from_smith_as_its_entry_says() -> None:
    """[Hoffman2012] warns of it; the numbers of the entry, measured again."""
    c = np.concatenate([np.geomspace(1e-7, 0.05, 800), np.linspace(0.05, 1, 2000)])
    schlick = models("masking")["schlick_smith"].reference["G1"]
    known = {
        "beckmann": ([-0.455, -0.441, -0.388, -0.335], [-0.646, -0.646, -0.646, -0.646]),
        "ggx": ([-0.270, -0.249, -0.177, -0.116], [-0.388, -0.380, -0.373, -0.373]),
    }
    for ndf, (less, deviation) in known.items():
        for alpha, most, furnace in zip((0.01, 0.1, 0.5, 1.0), less, deviation, strict=True):
            with np.errstate(divide="ignore"):
                a = c / (alpha * np.sqrt((1 - c) * (1 + c)))
                smith = (
                    2 * c / (c + np.sqrt(c**2 + alpha**2 * (1 - c**2)))
                    if ndf == "ggx"
                    # [Walter2007, eq. 26 by Λ]
                    else 1
                    / (
                        1
                        + np.array(
                            [
                                float((mpmath.erf(x) - 1) / 2 + mpmath.exp(-x * x) / (2 * x * mpmath.sqrt(mpmath.pi)))
                                if x < 30
                                else 0.0
                                for x in a
                            ]
                        )
                    )
                )
            own = schlick(c, None, alpha)
            assert np.min(own - smith) == pytest.approx(most, abs=6e-4), (ndf, alpha)
            # ∫ D G1 (v·m)₊ dω/(n·v) = G1 A/(n·v) = G1 over Smith's.
            assert np.min(own / smith - 1) == pytest.approx(furnace, abs=6e-4), (ndf, alpha)
            assert np.max(own - smith) <= 1e-15


# ---------------------------------------------------------------------------------------------- Fresnel


# float32: ten roundings of terms up to 1, some squared. 5.3e-7 was the largest error seen.
FRESNEL_ERROR = {32: 1e-6, 64: 4e-15}


def fresnel_cells(entry: Model, precision: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    cos_d = np.concatenate([[0.0], COSINES, np.linspace(0.02, 0.98, 25)])
    cells = [rounded(row, precision) for row in product(cos_d, *parameters(entry))]
    return cells[0], inside(entry, cells[1:], precision)


@every("fresnel")
@LANES
@PRECISIONS
def test_fresnel_is_its_reference(entry: Model, device: Device, precision: int, lanes: int | None) -> None:
    cos_d, own = fresnel_cells(entry, precision)
    got = evaluate(device, "FRESNEL_F", {"fresnel": entry}, [cos_d, *own.values()], precision, lanes)
    allowed = np.full_like(cos_d, FRESNEL_ERROR[precision])
    index = own.get("ior", own.get("eta"))
    if index is not None and precision == 64:
        # F goes like √g² near the critical angle, and the references know g² to 1e-16 only.
        square = np.abs((index - 1) * (index + 1) + cos_d**2 - own.get("kappa", 0.0) ** 2)
        allowed = np.maximum(allowed, 4 * np.sqrt(square + 4e-16) - 4 * np.sqrt(square))
    check(got, entry.reference["F"](cos_d, **own), allowed, cos_d=cos_d, **own)


@every("fresnel")
@PRECISIONS
def test_fresnel_limits(entry: Model, device: Device, precision: int) -> None:
    """F at 0° and 90°, by the parameters alone."""
    own = inside(entry, product(*parameters(entry)) if entry.parameters else [], precision)
    count = len(next(iter(own.values()), [0.0]))
    at = {"at 0°": 1.0, "at 90°": 0.0}
    zero, grazing = (
        evaluate(device, "FRESNEL_F", {"fresnel": entry}, [np.full(count, c), *own.values()], precision, None)
        for c in at.values()
    )
    n, k = own.get("ior", own.get("eta")), own.get("kappa", 0.0)
    if n is not None:
        check(zero, ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2), FRESNEL_ERROR[precision], **own)
        check(grazing, np.where((n == 1) & (k == 0), 0.0, 1.0), FRESNEL_ERROR[precision], **own)
    else:
        check(zero, entry.limits["0°"](**own)[1], FRESNEL_ERROR[precision], **own)
        check(grazing, entry.limits["90°"](**own)[1], FRESNEL_ERROR[precision], **own)


@PRECISIONS
def test_brewster_and_total_reflection(device: Device, precision: int) -> None:
    dielectric = {"fresnel": models("fresnel")["dielectric"]}
    n = rounded(np.array([0.3, 0.75, 0.999, 1.001, 1.333, 1.5, 2.417, 5.0]), precision)
    # tan θ = n: R_p is 0, and R_s = ((1 - n²)/(1 + n²))². The rounding of the cosine moves R_p by its square only.
    brewster = rounded(1 / np.sqrt(1 + n**2), precision)
    got = evaluate(device, "FRESNEL_F", dielectric, [brewster, n], precision, None)
    check(got, ((1 - n**2) / (1 + n**2)) ** 2 / 2, FRESNEL_ERROR[precision], n=n)
    # sin θ > n: all of it, exactly.
    n, part = product(n[n < 1], np.array([0.0, 0.3, 0.9, 0.999]))
    cos_d = rounded(part * np.sqrt(1 - n**2), precision)
    assert (evaluate(device, "FRESNEL_F", dielectric, [cos_d, n], precision, None) == 1).all()


@PRECISIONS
def test_fresnel_is_the_same_from_the_other_side(device: Device, precision: int) -> None:
    """F(θ, n) = F(θt, 1/n) with sin θ = n sin θt. The rounding of 1/n and cos θt is what differs."""
    dielectric = {"fresnel": models("fresnel")["dielectric"]}
    c, n = (rounded(a, precision) for a in product(COSINES[COSINES >= 1e-3], np.array([1.0, 1.333, 1.5, 2.417, 5.0])))
    # cos θt = √(1 - sin²θ/n²) = √(n² - 1 + c²)/n
    cos_t = np.sqrt((n - 1) * (n + 1) + c**2) / n
    there = evaluate(device, "FRESNEL_F", dielectric, [c, n], precision, None)
    again = evaluate(device, "FRESNEL_F", dielectric, [cos_t, 1 / n], precision, None)
    # dF/dc ≤ 4 n here, dc = ½ε cos θt/c · n through Snell's law: at c = 1e-3 a thousand times the rounding.
    check(there, again, FRESNEL_ERROR[precision] + 8 * n**2 * EPS[precision] / c, c=c, n=n)


@PRECISIONS
def test_a_metal_without_extinction_is_an_insulator(device: Device, precision: int) -> None:
    c, n = (
        rounded(a, precision)
        for a in product(np.append(0.0, COSINES), np.array([0.2, 0.7, 1.0, 1.0001, 1.333, 1.5, 2.5, 5.0]))
    )
    metal = evaluate(device, "FRESNEL_F", {"fresnel": models("fresnel")["conductor"]}, [c, n, 0 * n], precision, None)
    glass = evaluate(device, "FRESNEL_F", {"fresnel": models("fresnel")["dielectric"]}, [c, n], precision, None)
    check(metal, glass, 2 * FRESNEL_ERROR[precision], c=c, n=n)


@PRECISIONS
def test_f82_is_met_at_its_angle(device: Device, precision: int) -> None:
    entry = models("fresnel")["schlick_f82"]
    f0, f82 = (rounded(a, precision) for a in product(*parameters(entry)))
    got = evaluate(device, "FRESNEL_F", {"fresnel": entry}, [np.full_like(f0, 1 / 7), f0, f82], precision, None)
    check(got, f82, FRESNEL_ERROR[precision], f0=f0, f82=f82)


def test_the_range_of_f82() -> None:
    """Within [0, 1] for f82 from 25/49 of Schlick's value to all of it: at f0 = 0, F = (1 - c)⁵(1 - b c(1 - c)) is
    not negative for b ≤ 4. Else at most what the entry says."""
    c, f0, part = np.meshgrid(np.linspace(0, 1, 801), np.linspace(0, 1, 41), np.linspace(0, 1, 21), indexing="ij")
    F, schlick = models("fresnel")["schlick_f82"].reference["F"], f0 + (1 - f0) * (6 / 7) ** 5
    tame = F(c, f0, schlick * (25 + 24 * part) / 49)
    assert tame.min() >= -1e-12 and tame.max() <= 1 + 1e-12
    wild = F(c, f0, part)
    assert wild.min() == pytest.approx(-0.127, abs=1e-3) and wild.max() == pytest.approx(1.127, abs=1e-3)


@pytest.mark.parametrize("c", [1e-5, 0.02, 0.5, 0.999])
@pytest.mark.parametrize("eta", [0.05, 1.0, 2.5])
@pytest.mark.parametrize("kappa", [0.0, 1e-3, 3.0])
def test_fresnel_references_in_more_digits(c: float, eta: float, kappa: float) -> None:
    """Amplitudes from the tangential fields, by Snell's complex angle, in 40 digits."""
    with mpmath.workdps(40):
        index = mpmath.mpc(eta, kappa)
        sin_t = mpmath.sqrt(1 - mpmath.mpf(c) ** 2) / index
        cos_t = mpmath.sqrt(1 - sin_t**2)
        if (index * cos_t).imag < 0:  # the wave that fades inwards
            cos_t = -cos_t
        s = abs((c - index * cos_t) / (c + index * cos_t)) ** 2
        p = abs((index * c - cos_t) / (index * c + cos_t)) ** 2
        want = float((s + p) / 2)
    assert float(models("fresnel")["conductor"].reference["F"](c, eta, kappa)) == pytest.approx(want, abs=1e-13)
    if kappa == 0 and eta >= 0.2:
        assert float(models("fresnel")["dielectric"].reference["F"](c, eta)) == pytest.approx(want, abs=1e-13)


# The tables of [Hoffman2012] as printed: the sRGB column belongs to the linear one that is stored.
SRGB = {
    "gold": (1.00, 0.86, 0.57),
    "silver": (0.98, 0.97, 0.95),
    "copper": (0.98, 0.82, 0.76),
    "iron": (0.77, 0.78, 0.78),
    "aluminum": (0.96, 0.96, 0.97),
    "water": (0.15,) * 3,
    "plastic_low": (0.21,) * 3,
    "plastic_high": (0.24,) * 3,
    "glass_high": (0.31,) * 3,
    "diamond": (0.45,) * 3,
}


def srgb(linear: float) -> float:
    """The curve of IEC 61966-2-1."""
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


@pytest.mark.parametrize("name", SRGB)
def test_presets_agree_with_the_srgb_column(name: str) -> None:
    """Both columns were rounded to ±.005: the intervals must meet. (0.03 is 0.188 and printed as 0.21.)"""
    f0 = models("fresnel")["schlick"].presets[name]["f0"]
    assert isinstance(f0, tuple)
    for linear, encoded in zip(f0, SRGB[name], strict=True):
        assert srgb(linear - 0.005) <= encoded + 0.005 and srgb(linear + 0.005) >= encoded - 0.005


def test_every_preset_is_of_the_table() -> None:
    presets = models("fresnel")["schlick"].presets
    others = {"plastic": "plastic_low", "glass_low": "plastic_low", "ruby": "glass_high"}
    assert set(presets) == set(SRGB) | set(others)
    for name, same in others.items():
        assert presets[name] == presets[same]


# ---------------------------------------------------------------------------------------------- diffuse


def hemisphere_cells(entry: Model, precision: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """l and v with cosines from 1e-5, (cells, 3) each, and parameters."""
    cosines = COSINES[COSINES >= 1e-5]
    cells = product(cosines, cosines, AZIMUTHS, *parameters(entry))
    to_l, to_v = (rounded(d, precision) for d in directions(*cells[:3]))
    own = inside(entry, cells[3:], precision)
    return to_l, to_v, {p.name: np.minimum(own[p.name], p.high) for p in entry.parameters}


def diffuse(
    device: Device,
    entry: Model,
    to_l: np.ndarray,
    to_v: np.ndarray,
    own: Mapping[str, np.ndarray],
    precision: int,
    lanes: int | None = None,
) -> np.ndarray:
    return evaluate(device, "DIFFUSE_F", {"diffuse": entry}, [*to_l.T, *to_v.T, *own.values()], precision, lanes)


def diffuse_error(precision: int, to_l: np.ndarray, to_v: np.ndarray, want: np.ndarray) -> np.ndarray:
    """A dozen roundings of a value up to about 1, or of what 1/max(n·l, n·v) magnifies (Oren and Nayar's tangents);
    relative where a power made f large: the exponent's rounding times its size, up to 23 for (1e-10)^-1."""
    larger = np.maximum(to_l[:, 2], to_v[:, 2])
    return EPS[precision] * (4 + 0.5 / larger + 24 * np.abs(want))


@every("diffuse")
@LANES
@PRECISIONS
def test_diffuse_is_its_reference(entry: Model, device: Device, precision: int, lanes: int | None) -> None:
    to_l, to_v, own = hemisphere_cells(entry, precision)
    want = entry.reference["f"](to_l, to_v, **own)
    allowed = diffuse_error(precision, to_l, to_v, want)
    if precision == 64:
        # The references are written in angles, where π/2 - θ of 1e-5 keeps eleven digits.
        allowed = allowed + 4 * EPS[64] / np.maximum(to_l[:, 2], to_v[:, 2]) * np.maximum(1.0, np.abs(want))
    check(diffuse(device, entry, to_l, to_v, own, precision, lanes), want, allowed, l=to_l, v=to_v, **own)


@every("diffuse")
@PRECISIONS
def test_diffuse_is_as_reciprocal_as_it_says(entry: Model, device: Device, precision: int) -> None:
    to_l, to_v, own = hemisphere_cells(entry, precision)
    there, again = (diffuse(device, entry, *pair, own, precision) for pair in ((to_l, to_v), (to_v, to_l)))
    if entry.checks.reciprocal:
        check(there, again, diffuse_error(precision, to_l, to_v, again), l=to_l, v=to_v, **own)
    else:
        assert np.max(np.abs(there - again)) > 0.1  # a fact, and no small one


def directional_albedo(f: Callable[..., np.ndarray], NoV: float, own: Mapping[str, float]) -> float:
    """∫ f (n·l) dω by Gauss rules in panels that end where Oren and Nayar's maxima have their kinks: at θv, at 90°.

    The elevation goes like a cube from the horizon, and then in equal ratios: for powers of n·l.
    """
    x, w = (a / 2 for a in np.polynomial.legendre.leggauss(48))
    x, up = x + 0.5, np.arcsin(NoV)
    ratio = np.log(np.pi / 2 / up)
    above = up * np.exp(ratio * x)
    rise = np.concatenate([up * x**3, above])
    weight = np.concatenate([up * 3 * x**2 * w, above * ratio * w]) * np.sin(rise) * np.cos(rise)
    phi, across = np.concatenate([x, 1 + x]) * np.pi / 2, np.concatenate([w, w]) * np.pi  # both sides
    rise, phi = np.meshgrid(rise, phi, indexing="ij")
    to_l = np.stack([np.cos(rise) * np.cos(phi), np.cos(rise) * np.sin(phi), np.sin(rise)], -1)
    to_v = np.broadcast_to([np.cos(up), 0.0, NoV], to_l.shape)
    return float(weight @ f(to_l, to_v, **own) @ across)


ALBEDO_VIEWS = (1e-4, 0.01, 0.1, 0.3, 0.6, 0.9, 1.0)


def settings(entry: Model) -> list[dict[str, float]]:
    return [
        dict(zip((p.name for p in entry.parameters), values, strict=True))
        for values in itertools.product(*(sorted({p.low, p.high, *p.typical}) for p in entry.parameters))
    ]


@pytest.mark.parametrize(
    "entry", [m for m in models("diffuse").values() if "albedo" in m.reference], ids=lambda m: m.name
)
def test_closed_albedo_is_the_integral(entry: Model) -> None:
    for own, NoV in itertools.product(settings(entry), ALBEDO_VIEWS):
        # Gauss of 48 nodes is exact to rounding for what is smooth; relative for Minnaert's 1e4.
        want = directional_albedo(entry.reference["f"], NoV, own)
        assert float(entry.reference["albedo"](NoV, **own)) == pytest.approx(want, rel=1e-11, abs=1e-12), (NoV, own)


@every("diffuse")
def test_energy_is_as_declared(entry: Model) -> None:
    """No directional albedo above the largest declared, which is reached where it is said to exceed 1."""
    largest = entry.checks.largest_albedo
    assert largest is not None
    if not np.isfinite(largest):  # Minnaert's: only its closed form binds it
        assert "albedo" in entry.reference
        return
    ranges = [np.linspace(p.low, p.high, 33) for p in entry.parameters if p.name != "albedo"]
    found = max(
        directional_albedo(
            entry.reference["f"], NoV, dict(zip((p.name for p in entry.parameters), (1.0, *values), strict=True))
        )
        for values in itertools.product(*(r[:: len(ranges)] for r in ranges))
        for NoV in (1e-6, *ALBEDO_VIEWS)
    )
    # Declared to four digits; the grid misses the worst parameter by a thirtieth of its range.
    assert found <= largest + 1e-4
    assert found == pytest.approx(largest, abs=2e-3)


def test_directional_albedo_by_an_adaptive_rule() -> None:
    """The rule of these tests, held against QUADPACK for the model with the most kinks."""
    entry, own, NoV = models("diffuse")["oren_nayar"], {"albedo": 0.9, "sigma": 0.5}, 0.4
    to_v = np.array([np.sqrt(1 - NoV**2), 0.0, NoV])

    def radiance(phi: float, theta: float) -> float:
        to_l = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
        return float(entry.reference["f"](to_l, to_v, **own)) * np.sin(theta) * np.cos(theta) * 2

    kink = np.arccos(NoV)
    want = sum(
        quadrature.dblquad(radiance, a, b, c, d, epsabs=1e-10)[0]
        for a, b in ((0, kink), (kink, np.pi / 2))
        for c, d in ((0, np.pi / 2), (np.pi / 2, np.pi))
    )
    assert directional_albedo(entry.reference["f"], NoV, own) == pytest.approx(want, abs=1e-9)


@PRECISIONS
def test_white_eon_returns_everything(device: Device, precision: int) -> None:
    """The furnace of the kernel itself: E(v) = 1 for albedo 1, whatever the roughness."""
    entry = models("diffuse")["eon"]

    def f(to_l: np.ndarray, to_v: np.ndarray, **own: float) -> np.ndarray:
        flat = [d.reshape(-1, 3) for d in (to_l, to_v)]
        rows = {name: np.full(len(flat[0]), value) for name, value in own.items()}
        return diffuse(device, entry, *flat, rows, precision).reshape(to_l.shape[:-1])

    for roughness, NoV in itertools.product((0.0, 0.1, 0.5, 1.0), ALBEDO_VIEWS):
        # The error of the angle's fit, 3e-7 of at most a quarter, f's own rounding, and that of the quadrature.
        assert directional_albedo(f, NoV, {"albedo": 1.0, "roughness": roughness}) == pytest.approx(
            1.0, abs=3 * EPS[precision] + 1e-14
        ), (roughness, NoV)


@pytest.mark.parametrize(
    ("NoL", "NoV", "phi"),
    [(1e-5, 1e-5, 0.3), (1e-5, 1e-5, 3.0), (1e-5, 0.5, 2.0), (0.3, 0.7, 0.4), (0.3, 0.7, 2.2), (0.999, 1e-3, 1.0)],
)
def test_diffuse_references_in_more_digits(NoL: float, NoV: float, phi: float) -> None:
    """Oren and Nayar's, Burley's and EON's formulas once more, in 40 digits."""
    rho, r = 0.8, 0.5
    to_l, to_v = directions(np.array(NoL), np.array(NoV), np.array(phi))
    with mpmath.workdps(40):
        pi, tl, tv, d = mpmath.pi, mpmath.acos(NoL), mpmath.acos(NoV), mpmath.mpf(phi)
        a, b, cos_phi, s2 = max(tl, tv), min(tl, tv), mpmath.cos(d), mpmath.mpf(r) ** 2
        k, c1 = s2 / (s2 + mpmath.mpf("0.09")), 1 - s2 / (2 * (s2 + mpmath.mpf("0.33")))
        c2 = mpmath.mpf("0.45") * k * (mpmath.sin(a) - ((2 * b / pi) ** 3 if cos_phi < 0 else 0))
        c3 = k / 8 * (4 * a * b / pi**2) ** 2
        want = {
            "oren_nayar": rho
            / pi
            * (c1 + c2 * cos_phi * mpmath.tan(b) + (1 - abs(cos_phi)) * c3 * mpmath.tan((a + b) / 2))
            + mpmath.mpf("0.17")
            * mpmath.mpf(rho) ** 2
            / pi
            * s2
            / (s2 + mpmath.mpf("0.13"))
            * (1 - cos_phi * (2 * b / pi) ** 2),
            "oren_nayar_qualitative": rho
            / pi
            * (c1 + mpmath.mpf("0.45") * k * max(0, cos_phi) * mpmath.sin(a) * mpmath.tan(b)),
        }
        flat = mpmath.sin(tl) * mpmath.sin(tv) * cos_phi
        fd90 = mpmath.mpf("0.5") + 2 * r * (1 + flat + mpmath.cos(tl) * mpmath.cos(tv)) / 2
        want["burley"] = (
            rho / pi * (1 + (fd90 - 1) * (1 - mpmath.cos(tl)) ** 5) * (1 + (fd90 - 1) * (1 - mpmath.cos(tv)) ** 5)
        )
        A = 1 / (1 + (mpmath.mpf("0.5") - 2 / (3 * pi)) * r)
        mean = A * (1 + (mpmath.mpf(2) / 3 - 28 / (15 * pi)) * r)

        def fujii(t: mpmath.mpf) -> mpmath.mpf:
            """A + r A/π ∫∫ of the lobe: sin θ (θ - sin θ cos θ) + ⅔ tan θ (1 - sin³θ) - ⅔ sin θ."""
            s = mpmath.sin(t)
            return A + r * A / pi * (s * (t - s * mpmath.cos(t)) + 2 * mpmath.tan(t) * (1 - s**3) / 3 - 2 * s / 3)

        once = rho / pi * A * (1 + r * (flat / max(mpmath.cos(tl), mpmath.cos(tv)) if flat > 0 else flat))
        want["eon"] = once + mpmath.mpf(rho) ** 2 * mean / (1 - rho * (1 - mean)) / pi * (1 - fujii(tl)) * (
            1 - fujii(tv)
        ) / (1 - mean)
    second = {"oren_nayar": "sigma", "oren_nayar_qualitative": "sigma", "burley": "roughness", "eon": "roughness"}
    for name, value in want.items():
        got = models("diffuse")[name].reference["f"](to_l, to_v, albedo=rho, **{second[name]: r})
        # π/2 - θ keeps eleven digits at 1e-5.
        assert float(got) == pytest.approx(float(value), rel=1e-10), name


@PRECISIONS
def test_diffuse_special_cases(device: Device, precision: int) -> None:
    """Roughness 0, exponent 1 and a surface that reflects nothing are Lambert."""
    lambert = models("diffuse")["lambert"]
    same = {
        "oren_nayar": {"sigma": 0.0},
        "oren_nayar_qualitative": {"sigma": 0.0},
        "minnaert": {"exponent": 1.0},
        "eon": {"roughness": 0.0},
    }
    to_l, to_v, own = hemisphere_cells(lambert, precision)
    want = diffuse(device, lambert, to_l, to_v, own, precision)
    for name, extra in same.items():
        rows = own | {k: np.full_like(own["albedo"], v) for k, v in extra.items()}
        got = diffuse(device, models("diffuse")[name], to_l, to_v, rows, precision)
        check(got, want, 2 * EPS[precision], l=to_l, v=to_v, **rows)


@every("diffuse")
@PRECISIONS
def test_diffuse_is_finite_to_the_very_horizon(entry: Model, device: Device, precision: int) -> None:
    """f (n·l) of no light is no light, not 0·∞."""
    cells = product(np.array([0.0, 1e-20, 1e-7, 1.0]), np.array([0.0, 1e-20, 1e-7, 1.0]), AZIMUTHS, *parameters(entry))
    to_l, to_v = directions(*cells[:3])
    own = {p.name: np.minimum(rounded(v, precision), p.high) for p, v in zip(entry.parameters, cells[3:], strict=True)}
    got = diffuse(device, entry, to_l, to_v, own, precision)
    assert np.isfinite(got).all()
