"""The NDFs of the catalogue: kernels against float64 references over the whole domain, references against mpmath and
against closed truths. What holds for every NDF is parametrised over the catalogue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from scipy import integrate, special

import whitefurnace
from whitefurnace.catalogue import Model, Parameter, models, roughness
from whitefurnace.errors import UsageError
from whitefurnace.opencl.device import Device

PRECISIONS = pytest.mark.parametrize("precision", [32, 64])
EVERY = pytest.mark.parametrize("name", models("ndf"))


def providing(function: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("name", [n for n, m in models("ndf").items() if function in m.provides])


# ---------------------------------------------------------------------------------------------- evaluation


@cache
def kernel_file(name: str) -> str:
    return (resources.files("whitefurnace.kernels") / name).read_text("utf-8")


def evaluate(
    device: Device,
    precision: int,
    expression: str,
    rows: Mapping[str, np.ndarray],
    *,
    file: str | None = None,
    lanes: int | None = None,
) -> np.ndarray:
    """`expression` of the kernel files over `rows`, arrays of one length by the name the expression uses."""
    lanes = lanes or device.lanes(precision)
    dtype = np.float32 if precision == 32 else np.float64
    count = len(next(iter(rows.values())))
    pad = -count % (lanes * device.local_size)
    text = "\n".join(
        [
            *(kernel_file(f) for f in ("real.clh", "special.clh", file) if f),
            "__kernel void each(__global scalar *out" + "".join(f", __global const scalar *{n}_" for n in rows) + ") {",
            "  const int g = get_global_id(0);",
            *(f"  const real {n} = LOAD(g, {n}_);" for n in rows),
            f"  STORE({expression}, g, out);\n}}",
        ]
    )
    program = device.build(text, {"W": lanes, "T": 1, "PRECISION": precision})
    buffers = [
        device.array(np.pad(np.asarray(r, np.float64), (0, pad), mode="edge").astype(dtype)) for r in rows.values()
    ]
    out = device.empty(count + pad, dtype)
    device.launch(program.kernel("each"), ((count + pad) // lanes,), [out, *buffers])
    return out.read()[:count].astype(np.float64)


def call(
    device: Device,
    precision: int,
    entry: Model,
    function: str,
    own: Mapping[str, np.ndarray],
    parameters: Mapping[str, np.ndarray],
    **options: Any,
) -> np.ndarray:
    """A kernel function of `entry`; `own` arguments x, y, z make one vector."""
    names = list(own)
    arguments = ["vec3(x, y, z)", *names[3:]] if names[:3] == ["x", "y", "z"] else names
    numbers = dict(parameters)
    if entry.constants is not None:
        numbers |= entry.constants(**parameters)
    takes = entry.arguments if function in ("D", "sample") else [p.name for p in entry.parameters]
    rows = {**own, **{n: np.broadcast_to(numbers[n], next(iter({**own, **numbers}.values())).shape) for n in takes}}
    expression = f"ndf_{entry.name}_{function}({', '.join([*arguments, *takes])})"
    return evaluate(device, precision, expression, rows, file=entry.kernel_file, **options)


def float32(values: Any) -> np.ndarray:
    return np.asarray(values, np.float32).astype(np.float64)


def message(wrong: np.ndarray, error: np.ndarray, got: np.ndarray, wanted: np.ndarray, **inputs: np.ndarray) -> str:
    """The worst of the wrong points: inputs, got, wanted, error."""
    k = int(np.argmax(np.where(wrong, error, -1)))
    at = ", ".join(f"{n}={v[k]:.9g}" for n, v in inputs.items())
    return (
        f"{int(wrong.sum())} of {wrong.size}; worst at {at}: got {got[k]!r}, wanted {wanted[k]!r}, error {error[k]:.2e}"
    )


# ---------------------------------------------------------------------------------------------- domains


def axis(p: Parameter, count: int = 9) -> np.ndarray:
    """Values of a parameter, log-spaced, its ends and the exponents 1 and 2 approached from both sides."""
    low = p.low if p.low > 0 else p.high * 1e-9
    near = [e + d for e in (1, 2) for d in (-1e-3, -1e-6, 0, 1e-6, 1e-3)]
    values = [
        p.low,
        *np.geomspace(low, p.high, count),
        *p.typical,
        *(p.high * (1 - 10.0**-k) for k in (1, 3, 6)),
        *(v for v in near if p.low < v < p.high),
    ]
    return np.unique(np.clip(float32(values), p.low, p.high))


# From 1e-8 to π/2, the ends thicker. Beyond π/2 by a rounding the cosine is negative: not asked here.
THETA = np.unique(
    np.concatenate(
        [
            np.geomspace(1e-8, 1.57, 121),
            np.pi / 2 - np.geomspace(1e-8, 1.5, 60),
            np.linspace(0.01, 1.57, 30),
            [0.0, np.pi / 2],
        ]
    )
)
PHI = np.array([0, 1e-4, 0.3, np.pi / 4, 1.2, np.pi / 2 - 1e-3, np.pi / 2, 2, np.pi])


def directions(entry: Model) -> list[np.ndarray]:
    return [THETA] if entry.isotropic else [THETA[::2], PHI]


def domain(entry: Model, *others: np.ndarray) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """The product of every parameter's `axis` and `others`, flattened: parameters by name, and the others."""
    axes = [axis(p, 9 if entry.isotropic else 5) for p in entry.parameters]
    flat = [v.ravel() for v in np.meshgrid(*axes, *others, indexing="ij")]
    return ({p.name: v for p, v in zip(entry.parameters, flat, strict=False)}, flat[len(axes) :])


def coordinates(entry: Model, angles: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """The direction as the kernel's own arguments, rounded from float64: cosine and sin², or a vector."""
    if entry.isotropic:
        return {"cos_m": np.cos(angles[0]), "sin2_m": np.sin(angles[0]) ** 2}
    theta, phi = angles
    return {"x": np.sin(theta) * np.cos(phi), "y": np.sin(theta) * np.sin(phi), "z": np.cos(theta)}


@cache
def corners(name: str) -> list[dict[str, float]]:
    """Some points of the domain: the ends and the middle of each parameter."""
    entry = models("ndf")[name]
    axes = [np.unique([p.low, p.typical[1], p.typical[len(p.typical) // 2], p.high]) for p in entry.parameters]
    return [
        dict(zip((p.name for p in entry.parameters), map(float, values), strict=True))
        for values in np.stack([v.ravel() for v in np.meshgrid(*axes)], -1)
    ]


# ---------------------------------------------------------------------------------------------- special.clh


def lanes_of(device: Device) -> list[int]:
    return sorted({1, 4, device.lanes(32)})


# (function, least and greatest x, float32 error relative to 1 + grows·|x|^power): the comments of special.clh.
SPECIAL = [
    ("exp_(x)", np.exp, -87.3, 88.0, 1e-7, 0.0),
    ("expm1_(x)", np.expm1, -200.0, 88.0, 1.2e-7, 0.0),
    ("log_(x)", np.log, 1e-37, 1e38, 1e-7, 0.0),
    ("log1p_(x)", np.log1p, -0.999999, 1e30, 2e-7, 0.0),
    ("erfc_(x)", special.erfc, 0.0, 9.0, 3.3e-7, 0.3),
]


@PRECISIONS
@pytest.mark.parametrize(
    ("expression", "truth", "low", "high", "tolerance", "grows"), SPECIAL, ids=[s[0] for s in SPECIAL]
)
def test_special_functions(device, precision, expression, truth, low, high, tolerance, grows):
    x = [np.linspace(max(low, -3), min(high, 3), 20001)]
    if low <= 0:
        x += [-np.geomspace(1e-30, -low, 20001)] if low < 0 else [[0.0]]
    x += [np.geomspace(max(low, 1e-30), high, 20001)]
    if low == -0.999999:
        x += [-1 + np.geomspace(1e-6, 1, 1001)]
    x = np.concatenate(x)
    if precision == 32:
        x = float32(x)
    x = x[(x > -1) | (low < -1)]
    if expression == "log_(x)":
        x = x[np.abs(x - 1) > 1e-30]  # log 1 is 0: no relative error
    wanted = truth(x)
    if precision == 64:
        tolerance, grows = 1.5e-15, 0.3  # built-ins: OpenCL allows 3 to 16 ulp (1.2, 7.4)
    for lanes in lanes_of(device):
        got = evaluate(device, precision, expression, {"x": x}, lanes=lanes)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.where(wanted == 0, np.abs(got), np.abs(got / wanted - 1)) / (1 + grows * x * x * (grows > 0))
        assert np.isfinite(got).all()
        assert (error <= tolerance).all(), message(error > tolerance, error, got, wanted, x=x)


def test_powers_err_by_the_rounding_of_their_exponent(device):
    random = np.random.default_rng(3)
    x, y = float32(10 ** random.uniform(-37, 4, 40000)), float32(10 ** random.uniform(-6, 3, 40000))
    exponent = y * np.log(x)
    inside = np.abs(exponent) < 80
    x, y, exponent = x[inside], y[inside], exponent[inside]
    for lanes in lanes_of(device):
        got = evaluate(device, 32, "pow_(x, y)", {"x": x, "y": y}, lanes=lanes)
        error = np.abs(got / np.exp(exponent) - 1) / (1e-7 + 1.5e-7 * np.abs(exponent))  # as special.clh states
        assert (error <= 1).all(), message(error > 1, error, got, np.exp(exponent), x=x, y=y)


@PRECISIONS
def test_special_functions_at_the_ends(device, precision):
    x = np.array([-np.inf, -1e30, -1e4, 0.0])
    for lanes in lanes_of(device):
        assert evaluate(device, precision, "exp_(x)", {"x": x}, lanes=lanes).tolist() == [0, 0, 0, 1]
        assert evaluate(device, precision, "expm1_(x)", {"x": x}, lanes=lanes).tolist() == [-1, -1, -1, 0]
        assert evaluate(device, precision, "erfc_(-x)", {"x": x}, lanes=lanes).tolist() == [0, 0, 0, 1]
        zero = evaluate(device, precision, "log_(x - x)", {"x": np.ones(4)}, lanes=lanes)
        assert np.isfinite(zero).all() and (zero < -87).all()


# ---------------------------------------------------------------------------------------------- D


@pytest.mark.few(5)
@EVERY
@PRECISIONS
def test_D_against_its_reference_over_the_domain(device, precision, name):
    entry = models("ndf")[name]
    parameters, angles = domain(entry, *directions(entry))
    own = coordinates(entry, angles)
    wanted = entry.reference["D"](*angles, **parameters)
    # The largest D of each set of parameters: the last axes are the angles.
    inner = int(np.prod([len(d) for d in directions(entry)]))
    peak = np.repeat(wanted.reshape(-1, inner).max(1), inner)
    # 32: what the entry states, or 1e-5, which is what the rounding of an exponent of -16 (D = 1e-7 of its peak) and
    # of sin²θ in it may cost. 64: the same 5e8 times finer, and the reference's own error, as large again.
    tolerance = (entry.checks.float32_error or 1e-5) if precision == 32 else 6e-14
    # Below 1e-7 of the peak the exponent grows, and with it its rounding.
    grows = {32: 8e-7, 64: 6e-14}[precision]
    for lanes in {1, device.lanes(precision)}:
        got = call(device, precision, entry, "D", own, parameters, lanes=lanes)
        assert np.isfinite(got).all() and (got >= 0).all()
        with np.errstate(divide="ignore", invalid="ignore"):
            size = wanted / peak
            error = np.abs(got / wanted - 1)
            allowed = np.where(size > 1e-7, tolerance, grows * (1 + np.abs(np.log(size))))
        # exp is 0 where float32 leaves its normal numbers, at 1e-38; a 1/cos⁴ beside it is below 1e4 there.
        wrong = (error > allowed) & (np.abs(got - wanted) > 1e-34 * peak)
        assert not wrong.any(), message(wrong, error, got, wanted, **parameters, **own)


@EVERY
@PRECISIONS
def test_D_and_what_comes_with_it_stays_finite_at_the_ends(device, precision, name):
    """Along n, at grazing, with cosines that float32 makes 0: no NaN, no infinity, nothing below 0."""
    entry = models("ndf")[name]
    cosine = np.array([0.0, 1e-45, 1e-38, 1e-30, 1e-19, 1e-10, 1e-4, 0.5, 1 - 2**-24, 1.0])
    if entry.isotropic:
        parameters, (k,) = domain(entry, np.arange(len(cosine) + 2.0))
        k = k.astype(int)
        # sin² as it rounds, and 0 and 1 with the other one's rounding.
        own = {"cos_m": np.append(cosine, [1.0, 0.0])[k], "sin2_m": np.append(1 - cosine**2, [0.0, 1.0])[k]}
        one = {"cos_v": own["cos_m"]}
    else:
        parameters, (c, phi) = domain(entry, cosine, PHI)
        s = np.sqrt(1 - c * c)
        own = one = {"x": s * np.cos(phi), "y": s * np.sin(phi), "z": c}
    functions: list[tuple[str, dict[str, np.ndarray]]] = [("D", own)]
    if "NDF_AREA" in entry.provides:
        functions.append(("area", one))
    if "NDF_SAMPLE" in entry.provides:
        u = np.tile([0.0, 1e-30, 0.3, 1 - 2**-24], len(own["cos_m"] if entry.isotropic else c))
        functions.append(("sample", {"u": u}))
    for function, arguments in functions:
        repeats = len(next(iter(arguments.values()))) // len(next(iter(parameters.values())))
        got = call(
            device, precision, entry, function, arguments, {n: np.repeat(v, repeats) for n, v in parameters.items()}
        )
        assert np.isfinite(got).all() and (got >= 0).all(), function


# ---------------------------------------------------------------------------------------------- references


# Log tan θ: every NDF is smooth in it at every scale, and e^-60 of the energy lies below.
PANELS = np.arange(-30.0, 40.5, 0.5)


def nodes(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes in y from low to high, panels of at most ½."""
    edges = np.unique(np.concatenate([[low, high], PANELS[(PANELS > low) & (PANELS < high)]]))
    x, w = np.polynomial.legendre.leggauss(20)
    width = np.diff(edges)[:, None]
    return (edges[:-1, None] + width * (1 + x) / 2).ravel(), (width * w / 2).ravel()


def energy(
    entry: Model,
    parameters: Mapping[str, float],
    low: float = -30.0,
    high: float = 40.0,
    stretch: tuple[float, float] | None = None,
) -> float:
    """∫ D cos θ dω over e^low < tan θ < e^high; for anisotropic NDFs over the stretched tangent
    r, slopes (αx r cos φ, αy r sin φ): cos θ dω = αx αy r dr dφ cos⁴θ."""
    y, w = nodes(low, high)
    r = np.exp(y)
    if stretch is None:
        D = entry.reference["D"](np.arctan(r), **parameters)
        return float(np.sum(w * 2 * np.pi * D * (r / (1 + r * r)) ** 2))
    phi = (np.arange(16) + 0.5)[:, None] * (2 * np.pi / 16)
    x, y = stretch[0] * r * np.cos(phi), stretch[1] * r * np.sin(phi)
    slope = np.hypot(x, y)
    D = entry.reference["D"](np.arctan(slope), np.arctan2(y, x), **parameters)
    return float(np.sum(w * D * stretch[0] * stretch[1] * (r / (1 + slope * slope)) ** 2) * 2 * np.pi / 16)


def stretch_of(device: Device, entry: Model, parameters: Mapping[str, float]) -> tuple[float, float] | None:
    if entry.isotropic:
        return None
    rows = {n: np.full(1, v) for n, v in parameters.items()}
    x, y = (
        float(evaluate(device, 64, f"ndf_{entry.name}_{f}({', '.join(rows)})", rows, file=entry.kernel_file)[0])
        for f in ("stretch_x", "stretch_y")
    )
    return x, y


@EVERY
def test_references_are_normalized(device, name):
    entry = models("ndf")[name]
    assert entry.checks.normalized is True
    for parameters in corners(name):
        # 2 800 nodes, each rounded, and D's own error: 1e-13.
        got = energy(entry, parameters, stretch=stretch_of(device, entry, parameters))
        assert abs(got - 1) <= 1e-12, f"{parameters}: {got!r}"


def test_D_is_zero_behind(device):
    for entry in models("ndf").values():
        for parameters in corners(entry.name):
            angles = [np.array([np.pi / 2 + 1e-6, 2.0, np.pi])] + ([] if entry.isotropic else [np.zeros(3)])
            assert (entry.reference["D"](*angles, **parameters) == 0).all(), entry.name


def closed(name: str, **parameters: float) -> Any:
    """D(θ) in mpmath, from the papers' forms with the norm in closed form."""
    q = {n: mp.mpf(v) for n, v in parameters.items()}

    def phong(t):
        return (q["exponent"] + 2) / (2 * mp.pi) * mp.cos(t) ** q["exponent"]

    def beckmann(t):
        return mp.exp(-(mp.tan(t) ** 2) / q["alpha"] ** 2) / (mp.pi * q["alpha"] ** 2 * mp.cos(t) ** 4)

    def ggx(t):
        return q["alpha"] ** 2 / (mp.pi * (mp.cos(t) ** 2 * (q["alpha"] ** 2 - 1) + 1) ** 2)

    def abc(t):  # Hoffman's norm; its poles, and b = 0, by a shift far below float64 at 90 digits
        b, c = q["b"] or mp.mpf(10) ** -30, q["c"]
        c += mp.mpf(10) ** -30 if c in (1, 2) else 0
        k = b**2 * (1 + b) ** c * (c - 2) * (c - 1) / (2 * mp.pi * ((1 + b) ** 2 + (1 + b) ** c * (b * (c - 2) - 1)))
        return k / (1 + b * (1 - mp.cos(t))) ** c

    def shifted_gamma(t):
        a, p, x = q["alpha"], q["p"], mp.tan(t) ** 2
        p22 = a ** (p - 1) / mp.gammainc(1 - p, a) * mp.exp(-(a**2 + x) / a) / (a**2 + x) ** p
        return p22 / (mp.pi * mp.cos(t) ** 4)

    def gtr(t):
        a, g = q["alpha"], q["gamma"]
        a -= mp.mpf(10) ** -30 if a == 1 else 0
        g += mp.mpf(10) ** -30 if g == 1 else 0
        k = (g - 1) * (a**2 - 1) / (mp.pi * (1 - a ** (2 * (1 - g))))
        return k / (a**2 * mp.cos(t) ** 2 + mp.sin(t) ** 2) ** g

    def charlie(t):
        return (2 + 1 / q["alpha"]) * mp.sin(t) ** (1 / q["alpha"]) / (2 * mp.pi)

    return locals()[name]


CLOSED = ["phong", "beckmann", "ggx", "abc", "shifted_gamma", "gtr", "charlie"]


@pytest.mark.parametrize("name", CLOSED)
def test_references_and_constants_against_mpmath(name):
    entry = models("ndf")[name]
    points = list(corners(name))
    if name == "shifted_gamma":
        points += [
            {"alpha": a, "p": e + d} for a in (1e-4, 0.1, 1) for e in (1, 2) for d in (-1e-9, 0, 1e-9) if e + d <= 2
        ]
    if name == "abc":
        points += [{"b": b, "c": e + d} for b in (0.3, 0.5, 0.51, 10, 1e8) for e in (1, 2) for d in (-1e-9, 0, 1e-9)]
    if name == "gtr":
        points += [{"alpha": a, "gamma": 1 + d} for a in (1e-4, 0.3, 1 - 1e-9) for d in (-1e-9, 0, 1e-9)]
    with mp.workdps(90):
        for parameters in points:
            truth = closed(name, **parameters)
            for theta in (0.0, 1e-6, 1e-3, 0.1, 1.0, 1.5, 1.57):
                wanted = truth(mp.mpf(theta))
                got = float(entry.reference["D"](np.float64(theta), **parameters))
                if wanted < 1e-280:
                    assert got < 1e-279, (parameters, theta)
                    continue
                # 2e-14 where a number of size 1 is rounded, and the exponent's rounding: log of D over a D of size 1.
                allowed = 3e-14 + 3e-16 * abs(float(mp.log(wanted)))
                assert abs(got / wanted - 1) <= allowed, (parameters, theta, got, wanted, float(got / wanted - 1))
            if entry.constants is not None:
                (constant,) = entry.constants(**parameters).values()
                # Both constants are D along n; shifted gamma's power of 1 + x/α² begins at 1 there.
                assert abs(float(constant) / truth(mp.mpf(0)) - 1) <= 2e-14, (parameters, constant)


def test_constants_broadcast():
    for entry in models("ndf").values():
        if entry.constants is None:
            continue
        grid = np.meshgrid(*(axis(p) for p in entry.parameters), indexing="ij")
        whole = entry.constants(**{p.name: g for p, g in zip(entry.parameters, grid, strict=True)})
        assert tuple(whole) == entry.constant_names
        for k in [(0,) * len(grid), (-1,) * len(grid), (3,) * len(grid)]:
            one = entry.constants(**{p.name: float(g[k]) for p, g in zip(entry.parameters, grid, strict=True)})
            for name, value in whole.items():
                assert np.isfinite(value).all()
                assert one[name] == pytest.approx(value[k], rel=1e-15)  # other vector widths round differently


def d(name: str, *angles: np.ndarray, **parameters: float) -> np.ndarray:
    return models("ndf")[name].reference["D"](*angles, **parameters)


def test_models_that_are_limits_of_others():
    theta = THETA[THETA < 1.57]
    for alpha in (1e-4, 0.01, 0.3, 1.0):
        # Each side rounds an exponent or a power of at most 1e4 of slopes: 1e-12 over the range where D counts.
        near = theta[theta < 30 * alpha]
        np.testing.assert_allclose(d("gtr", near, alpha=alpha, gamma=2.0), d("ggx", near, alpha=alpha), rtol=1e-12)
        np.testing.assert_allclose(
            d("shifted_gamma", near, alpha=alpha, p=0.0), d("beckmann", near, alpha=np.sqrt(alpha)), rtol=1e-12
        )
        for kind in ("ggx", "beckmann"):
            for phi in PHI:
                np.testing.assert_allclose(
                    d(f"{kind}_anisotropic", near, phi, alpha_x=alpha, alpha_y=alpha),
                    d(kind, near, alpha=alpha),
                    rtol=1e-12,
                    atol=1e-300,
                )
                np.testing.assert_allclose(
                    models("ndf")[f"{kind}_anisotropic"].reference["area"](theta, phi, alpha_x=alpha, alpha_y=alpha),
                    models("ndf")[kind].reference["area"](theta, alpha=alpha),
                    rtol=1e-14,
                )
    uniform = np.full(theta.shape, 1 / np.pi)  # ∫ cos dω = π
    for name, parameters in (
        ("abc", {"b": 0.0, "c": 5.0}),
        ("abc", {"b": 1e8, "c": 0.0}),
        ("phong", {"exponent": 0.0}),
        ("gtr", {"alpha": 1.0, "gamma": 7.0}),
        ("gtr", {"alpha": 1e-4, "gamma": 0.0}),
        ("ggx", {"alpha": 1.0}),
    ):
        np.testing.assert_allclose(d(name, theta, **parameters), uniform, rtol=1e-13)


# ---------------------------------------------------------------------------------------------- area


@providing("NDF_AREA")
@PRECISIONS
def test_area_against_its_reference(device, precision, name):
    entry = models("ndf")[name]
    theta = np.unique(
        np.concatenate([[0.0], np.geomspace(1e-6, 1.57, 40), np.pi / 2 - np.geomspace(1e-12, 1, 40), [np.pi / 2]])
    )
    parameters, angles = domain(entry, *([theta] if entry.isotropic else [theta, PHI]))
    wanted = entry.reference["area"](*angles, **parameters)
    own = {"cos_v": np.cos(angles[0])} if entry.isotropic else coordinates(entry, angles)
    # A sum of two positive terms, an erfc of 3e-7 halved among them, from inputs of 6e-8; in 64 the same with erf.
    tolerance = {32: 4e-7, 64: 2e-15}[precision]
    for lanes in {1, device.lanes(precision)}:
        got = call(device, precision, entry, "area", own, parameters, lanes=lanes)
        error = np.abs(got / wanted - 1)
        assert (error <= tolerance).all(), message(error > tolerance, error, got, wanted, **parameters, **own)
        assert (np.abs(got[angles[0] == 0] - 1) <= tolerance).all()


def area_by_quadrature(entry: Model, theta_v: float, parameters: Mapping[str, float]) -> float:
    """∫ D (v·m)₊ dω of an isotropic NDF. In azimuth it is 2π c cos θ up to θ = π/2 - θv, and from there, with
    cos φ₁ = -cot θ cot θv, 2(c cos θ φ₁ + s sin θ sin φ₁), whose root at its beginning x² takes away."""
    c, s = np.cos(theta_v), np.sin(theta_v)
    split = float(np.clip(-np.log(np.tan(theta_v)), -30, 39.5)) if theta_v > 0 else 39.5
    total = 0.0
    for part in range(3):
        if part == 0:
            y, w = nodes(-30.0, split)
        elif part == 1:
            q, w = nodes(0.0, np.sqrt(0.5))
            y, w = split + q * q, 2 * q * w
        else:
            y, w = nodes(split + 0.5, 40.5)
        t = np.exp(y)
        cos_m, sin_m = 1 / np.sqrt(1 + t * t), t / np.sqrt(1 + t * t)
        around = 2 * np.pi * c * cos_m
        if part:
            edge = np.arccos(np.clip(-c * cos_m / max(s, 1e-300) / sin_m, -1, 1))
            around = 2 * (c * cos_m * edge + s * sin_m * np.sin(edge))
        # dω = sin θ dθ dφ, dθ = sin θ cos θ dy
        total += float(np.sum(w * entry.reference["D"](np.arctan(t), **parameters) * around * sin_m**2 * cos_m))
    return total


@pytest.mark.parametrize("name", [n for n, m in models("ndf").items() if m.isotropic and "area" in m.reference])
def test_area_references_against_quadrature(name):
    entry = models("ndf")[name]
    for parameters in corners(name):
        for theta in (0.0, 1e-3, 0.3, 1.0, 1.5, 1.57, np.pi / 2 - 1e-5, np.pi / 2):
            got = float(entry.reference["area"](theta, **parameters))
            wanted = area_by_quadrature(entry, theta, parameters)
            # The rule's error: the arc cosine of an argument rounded to 1e-16 near its ends, √1e-16 at worst, times
            # the cube of it that the integrand has there.
            assert abs(got / wanted - 1) <= 1e-11, (parameters, theta, got, wanted)


@pytest.mark.parametrize("alpha", [0.01, 0.3, 1.0])
def test_beckmann_area_against_mpmath(alpha):
    reference = models("ndf")["beckmann"].reference["area"]
    with mp.workdps(25):
        a = mp.mpf(alpha)
        for theta in (0.3, 1.2, 1.55):
            # In slopes: A = cos θv + ∫ (x sin θv - cos θv)₊ P(x) dx over the slope's Gaussian P of variance α²/2.
            c, s = mp.cos(theta), mp.sin(theta)
            first = c / s
            beyond = mp.quad(
                lambda x, c=c, s=s: (x * s - c) * mp.exp(-((x / a) ** 2)) / (a * mp.sqrt(mp.pi)),
                [first + k * a for k in (0, 1, 2, 4, 8, 16)],
            )
            assert abs(float(reference(theta, alpha=alpha)) / (c + beyond) - 1) <= 2e-15  # a few roundings


@pytest.mark.parametrize("kind", ["ggx", "beckmann"])
def test_anisotropic_area_against_quadrature(kind):
    """∫ (v·m)₊ P22/cos θ over slopes, in stretched polar coordinates."""
    entry = models("ndf")[f"{kind}_anisotropic"]
    ax, ay, theta, phi = 0.5, 0.1, 1.3, 0.4
    v = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])

    def inner(p: float) -> float:
        def f(r: float) -> float:
            x, y = ax * r * np.cos(p), ay * r * np.sin(p)  # m ~ (x, y, 1)
            slope = float(np.hypot(x, y))
            D = float(entry.reference["D"](np.arctan(slope), np.arctan2(y, x), alpha_x=ax, alpha_y=ay))
            return float(max(v[0] * x + v[1] * y + v[2], 0) * D / (1 + slope**2) ** 2 * ax * ay * r)

        along = v[0] * ax * np.cos(p) + v[1] * ay * np.sin(p)
        end = -v[2] / along if along < 0 else np.inf
        return integrate.quad(f, 0, end, epsabs=1e-12, limit=200)[0]

    # φ is periodic, and smooth but for a third derivative where `end` begins: 200 midpoints are good to 1e-6.
    wanted = sum(inner(p) for p in (np.arange(200) + 0.5) * (2 * np.pi / 200)) * 2 * np.pi / 200
    got = float(entry.reference["area"](theta, phi, alpha_x=ax, alpha_y=ay))
    assert abs(got / wanted - 1) <= 1e-6


# ---------------------------------------------------------------------------------------------- width, reach, sample


@providing("NDF_WIDTH")
@PRECISIONS
def test_width_is_where_D_is_about_a_quarter(device, precision, name):
    entry = models("ndf")[name]
    parameters, _ = domain(entry)
    width = call(device, precision, entry, "width", {}, parameters)
    assert ((width > 0) & (width <= np.pi / 2 * (1 + 1e-7))).all()
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = entry.reference["D"](width, **parameters) / entry.reference["D"](0 * width, **parameters)
    # Wide lobes have no peak to speak of: 1/cos⁴ takes a part, and Charlie is 0 along n.
    ratio = ratio[width < 0.3]
    # "About": the harmonic sum of two scales, where both count, is at a factor 2.5.
    assert ((ratio > 0.1) & (ratio < 0.5)).all(), (ratio.min(), ratio.max())


@providing("NDF_REACH")
@PRECISIONS
def test_nothing_lies_beyond_the_reach(device, precision, name):
    entry = models("ndf")[name]
    points = corners(name)
    parameters = {p.name: np.array([q[p.name] for q in points]) for p in entry.parameters}
    reach = call(device, precision, entry, "reach", {}, parameters)
    if not entry.isotropic:  # a stretched slope
        for slope, at in zip(reach, points, strict=True):
            assert energy(entry, at, float(np.log(slope)), stretch=stretch_of(device, entry, at)) <= 1e-17, (at, slope)
        return
    assert ((reach > 0) & (reach <= np.pi / 2 * (1 + 1e-7))).all()
    for angle, at in zip(reach, points, strict=True):
        low = float(np.log(np.tan(min(angle, np.pi / 2 - 1e-7))))
        # Where the reach is the whole hemisphere what is left is the last 1e-7 of angle: cos² = 1e-14 of a flat lobe.
        assert energy(entry, at, low) <= (1e-17 if angle < 1.57 else 1e-13), (at, angle)


@providing("NDF_SAMPLE")
@PRECISIONS
def test_samples_are_quantiles(device, precision, name):
    entry = models("ndf")[name]
    epsilon = {32: 2.0**-24, 64: 2.0**-53}[precision]
    u = np.array([1e-6, 0.01, 0.3, 0.5, 0.9, 0.999])
    u = float32(u) if precision == 32 else u
    for parameters in corners(name):
        if precision == 32:
            parameters = {n: float(float32(v)) for n, v in parameters.items()}
        rows = {n: np.full(u.shape, v) for n, v in parameters.items()}
        s = call(device, precision, entry, "sample", {"u": u}, rows)
        stretch = stretch_of(device, entry, parameters)
        for uk, sk in zip(u, s, strict=True):

            def cdf(
                value: float,
                parameters: Mapping[str, float] = parameters,
                stretch: tuple[float, float] | None = stretch,
            ) -> float:
                tan2 = value / max(1 - value, 1e-300) if stretch is None else value
                y = float(np.clip(0.5 * np.log(tan2), -29.9, 40))
                return energy(entry, parameters, -30.0, y, stretch)

            # 20 roundings of the quantile, 12 of which the exponent of γ = 10 or 1/(2α) takes, and the rule's 1e-12.
            room = 20 * epsilon
            high = min(sk * (1 + room), 1.0) if stretch is None else sk * (1 + room)
            low, got, above = cdf(sk * (1 - room)), cdf(sk), cdf(high)
            slack = 8 * epsilon * uk + 1e-12
            assert low - slack <= uk <= above + slack, f"{parameters}: u = {uk!r}, sample {sk!r}, energy {got!r}"


# ---------------------------------------------------------------------------------------------- roughness


@EVERY
def test_roughness_gives_parameters_of_the_domain(name):
    entry = models("ndf")[name]
    if entry.from_roughness is None:
        pytest.skip("another parameter must be given")
    for r in np.linspace(0, 1, 201):
        given = entry.from_roughness(float(r))
        assert set(given) == {p.name for p in entry.parameters}
        for p in entry.parameters:
            p.check(given[p.name], name)
    many = entry.from_roughness(np.linspace(0, 1, 5))
    assert all(np.shape(v) in ((), (5,)) for v in many.values())
    with pytest.raises(UsageError, match="roughness"):
        entry.from_roughness(1.5)


def test_lobes_of_one_roughness_share_their_peak():
    for r in (0.3, 0.5, 0.8, 1.0):
        peak = 1 / (np.pi * r**4)
        for name in ("phong", "beckmann", "ggx", "gtr"):
            given = models("ndf")[name].from_roughness(r)
            assert float(d(name, np.float64(0), **given)) == pytest.approx(peak, rel=1e-13), name


def test_conversions_are_inverses():
    r = np.linspace(0.05, 1, 20)
    alpha = roughness.alpha_of_roughness(r)
    np.testing.assert_allclose(alpha, r * r, rtol=1e-15)
    np.testing.assert_allclose(roughness.roughness_of_alpha(alpha), r, rtol=1e-15)
    exponent = roughness.exponent_of_alpha(alpha)
    np.testing.assert_allclose(exponent, 2 / alpha**2 - 2, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(roughness.alpha_of_exponent(exponent), alpha, rtol=1e-15)
    assert roughness.roughness_of_alpha(0) == 0 and roughness.exponent_of_alpha(1) == 0
    assert roughness.alpha_of_exponent(0) == 1


@pytest.mark.parametrize(
    ("function", "bad"),
    [
        (roughness.alpha_of_roughness, -0.1),
        (roughness.alpha_of_roughness, 1.1),
        (roughness.alpha_of_roughness, np.nan),
        (roughness.roughness_of_alpha, -1e-9),
        (roughness.roughness_of_alpha, [0.5, 2]),
        (roughness.exponent_of_alpha, 0),
        (roughness.exponent_of_alpha, 1.5),
        (roughness.alpha_of_exponent, -1),
        (roughness.alpha_of_exponent, np.inf),
    ],
)
def test_conversions_refuse_what_lies_outside(function, bad):
    with pytest.raises(UsageError, match="outside"):
        function(bad)


def test_an_average_states_its_error_where_two_rules_err_alike(device: Device) -> None:
    """A dip at grazing that is narrower than the nodes in n·v: at this α two neighbours agreed 25 times too well."""
    if not device.fp64:
        pytest.skip("no float64")
    x, w = np.polynomial.legendre.leggauss(16)
    edges = np.concatenate([[0.0], np.geomspace(1e-8, 1, 50)])
    mu = (edges[1:, None] + edges[:-1, None]) / 2 + np.diff(edges)[:, None] / 2 * x
    own = {"ndf": "beckmann", "alpha": 9.202191841917986e-05, "precision": 64, "device": device}
    E = whitefurnace.integrate("albedo", NoV=mu, tolerance=1e-12, **own)
    truth = float((np.diff(edges)[:, None] * w * E.values * mu).sum())
    got = whitefurnace.integrate("albedo_average", tolerance=1e-10, **own)
    assert abs(float(got.values) - truth) <= got.error + E.error
