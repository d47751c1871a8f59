"""Reflected radiance of lights and environments: closed forms, albedos, limits and brute force in numpy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from whitefurnace import environment, integrate
from whitefurnace.catalogue import Model, integral, model, models
from whitefurnace.catalogue.rule import gauss
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.integrals import quadrature as engine
from whitefurnace.integrals.radiance import frame_of
from whitefurnace.opencl.bindings import FUNCTIONS
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import evaluate
from whitefurnace.results import Integrated

PRECISIONS = pytest.mark.parametrize("precision", [32, 64])
OVERHEAD: dict[str, float] = {"center_x": 0, "center_y": 0, "center_z": 1}
SQUARE = {**OVERHEAD, "u_x": 1, "u_y": 0, "u_z": 0, "v_x": 0, "v_y": -1, "v_z": 0}


@pytest.fixture
def radiance(device: Device) -> Any:
    def run(**arguments: Any) -> Integrated:
        if arguments.get("precision") == 64 and not device.fp64:
            pytest.skip("no float64")
        return integrate("radiance", device=device, **arguments)

    return run


def brdf(
    to: np.ndarray, v: np.ndarray, *, ndf: str = "ggx", masking: str = "smith", f0: float | None = None, **own: Any
) -> np.ndarray:
    """f(l, v) from the float64 references, by angles: another form than the kernel's."""
    lobe = model("ndf", ndf)
    h = (to + v) / np.linalg.norm(to + v, axis=-1, keepdims=True)
    VoH = (v * h).sum(-1)
    NoL, NoV, NoH = to[..., 2], np.broadcast_to(v[..., 2], to.shape[:-1]), h[..., 2]

    def angles(d: np.ndarray) -> tuple[np.ndarray, ...]:
        theta = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2])
        return (theta,) if lobe.isotropic else (theta, np.arctan2(d[..., 1], d[..., 0]))

    D = lobe.reference["D"](*angles(h), **own)
    areas = [lobe.reference["area"](*angles(d), **own) for d in (np.broadcast_to(v, to.shape), to)]
    V = model("masking", masking).reference["V"](NoV, NoL, NoH, VoH, *areas)
    F = 1.0 if f0 is None else model("fresnel", "schlick").reference["F"](VoH, f0=f0, f90=1.0)
    return np.where(NoL > 0, F * D * V / 4, 0.0)


def direction(cosine: Any, azimuth: Any) -> np.ndarray:
    cosine, azimuth = np.broadcast_arrays(np.asarray(cosine, float), azimuth)
    sine = np.sqrt((1 - cosine) * (1 + cosine))
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], -1)


def over_rectangle(f: Any, center: np.ndarray, u: np.ndarray, v: np.ndarray, n: int = 160) -> float:
    """∫ f NoL dω by Gauss nodes on the rectangle itself: dω = cos dA/d²."""
    x, w = gauss(n)
    a, b = 2 * x[:, None] - 1, 2 * x - 1
    p = center + a[..., None] * u + b[..., None] * v
    d2 = (p * p).sum(-1)
    to = p / np.sqrt(d2)[..., None]
    normal = np.cross(u, v)
    cosine = -(to * normal).sum(-1) * 4  # of the light, times the element of area
    return float((f(to) * np.maximum(to[..., 2], 0) * np.maximum(cosine, 0) / d2 * w[:, None] * w).sum())


def keywords(center: np.ndarray, **edges: np.ndarray) -> dict[str, float]:
    named = {"center": center, **edges}
    return {f"{name}_{axis}": float(x) for name, vector in named.items() for axis, x in zip("xyz", vector, strict=True)}


def lambert_polygon(corners: np.ndarray) -> float:
    """E/π of a polygon of radiance 1 above the horizon. [Lambert's formula: ½π ∑ angle n·(edge's normal)]"""
    unit = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(unit, np.roll(unit, -1, 0), strict=True):
        cross = np.cross(a, b)
        total += math.atan2(np.linalg.norm(cross), a @ b) * cross[2] / np.linalg.norm(cross)
    return abs(total) / (2 * math.pi)


# ---------------------------------------------------------------------------------------------- punctual, ambient


@PRECISIONS
def test_a_white_lambertian_facing_a_punctual_light_returns_its_colour(radiance: Any, precision: int) -> None:
    colours = np.array([0.1, 1.0, 2.5, 1e4])
    found = radiance(light="punctual", diffuse="lambert", albedo=1, NoV=0.3, NoL=1, color=colours, precision=precision)
    assert (found.values == colours.astype(found.values.dtype)).all()
    assert found.rule == "punctual" and found.evaluations == 4


def test_a_punctual_light_is_the_brdf_times_pi_and_colour(radiance: Any) -> None:
    alpha = np.array([1e-3, 0.05, 0.4, 1.0])
    NoL, phi_l, NoV, phi = 0.35, 2.8, 0.4, -0.2
    found = radiance(
        light="punctual",
        ndf="ggx",
        fresnel="schlick",
        f0=0.04,
        alpha=alpha,
        NoL=NoL,
        phi_l=phi_l,
        color=3,
        NoV=NoV,
        phi=phi,
        precision=64,
    )
    wanted = [math.pi * 3 * NoL * brdf(direction(NoL, phi_l), direction(NoV, phi), f0=0.04, alpha=a) for a in alpha]
    assert np.allclose(found.values, wanted, rtol=1e-11, atol=0)


def test_light_from_behind_gives_nothing_and_views_from_behind_what_was_asked(radiance: Any) -> None:
    lit = {"light": "punctual", "diffuse": "burley", "albedo": 1, "roughness": 0.5}
    assert (radiance(NoV=0.5, NoL=[-1, -0.2, 0], **lit).values == 0).all()
    below = {**SQUARE, "center_z": -1, "v_y": 1}
    assert radiance(light="rectangle", ndf="ggx", alpha=0.3, NoV=0.5, **below).values == 0
    assert radiance(NoV=-0.4, NoL=0.7, backfacing="absolute", **lit).values == radiance(NoV=0.4, NoL=0.7, **lit).values
    assert radiance(NoV=-0.4, NoL=0.7, backfacing="clamp", **lit).values == radiance(NoV=0, NoL=0.7, **lit).values
    with pytest.raises(UsageError, match="views from behind"):
        radiance(NoV=-0.4, NoL=0.7, **lit)


@PRECISIONS
def test_ambient_light_is_the_directional_albedo(radiance: Any, device: Device, precision: int) -> None:
    NoV = np.array([0.05, 0.5, 1.0])
    white = radiance(light="ambient", diffuse="lambert", albedo=1, NoV=NoV, precision=precision)
    assert np.abs(white.values - 1).max() <= white.error
    both = {"ndf": "ggx", "alpha": 0.3, "diffuse": "lambert", "albedo": 0.5, "NoV": NoV, "precision": precision}
    albedo = integrate("albedo", device=device, **both).values
    assert np.abs(radiance(light="ambient", radiance=7, **both).values - 7 * albedo).max() < 1e-5


# ---------------------------------------------------------------------------------------------- area lights


@PRECISIONS
@pytest.mark.parametrize(
    "center, u, v",
    [
        ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
        ((0.3, -2, 1), (0.2, 0.5, 0), (0, 0.3, 0.5)),
        ((2, 1, 0.6), (0.0, 0.5, 0.1), (-0.2, 0.0, 0.5)),
        ((0, 0, 1e-3), (1e3, 0, 0), (0, -1e3, 0)),
    ],
)
def test_lambert_under_a_rectangle_is_lamberts_formula(
    radiance: Any, precision: int, center: Any, u: Any, v: Any
) -> None:
    c, u, v = (np.array(x, float) for x in (center, u, v))
    if np.cross(u, v) @ c > 0:
        v = -v
    found = radiance(
        light="rectangle", diffuse="lambert", albedo=1, NoV=0.5, precision=precision, **keywords(c, u=u, v=v)
    )
    wanted = lambert_polygon(np.array([c - u - v, c + u - v, c + u + v, c - u + v]))
    assert abs(found.values - wanted) <= found.error <= (3e-6 if precision == 32 else 1e-12)


@PRECISIONS
def test_lambert_under_a_rectangle_that_sets(radiance: Any, precision: int) -> None:
    """Upright on the horizon: what is above it is a polygon again."""
    c, u, v = np.array([2.0, 0.3, 0.2]), np.array([0.0, 1.0, 0.0]), np.array([0.1, 0.0, -1.0])
    corners = [c - u - v, c + u - v, c + u + v, c - u + v]
    up = [corners[0], corners[1]]
    for a, b in ((corners[1], corners[2]), (corners[0], corners[3])):
        up.insert(2, a + (b - a) * a[2] / (a[2] - b[2]))
    clipped = np.array([corners[0], corners[1], up[3], up[2]])
    found = radiance(
        light="rectangle", diffuse="lambert", albedo=1, NoV=0.5, precision=precision, **keywords(c, u=u, v=v)
    )
    assert abs(found.values - lambert_polygon(clipped)) <= found.error


@PRECISIONS
def test_lambert_under_a_disc_is_the_closed_form(radiance: Any, precision: int) -> None:
    """Overhead, R²/(R² + d²); and wherever a disc faces the surface along any direction at angle θ above the horizon,
    parallel to it: ½(1 - (d² + x² - R²)/√((d² + x² + R²)² - 4 x² R²)) for an offset x."""
    x, R = np.array([0.0, 0.5, 3.0]), 1.3
    found = radiance(
        light="disc",
        diffuse="lambert",
        albedo=1,
        NoV=0.5,
        center_x=x,
        center_y=0,
        center_z=1,
        radius=R,
        precision=precision,
    )
    wanted = (1 - (1 + x**2 - R**2) / np.sqrt((1 + x**2 + R**2) ** 2 - 4 * x**2 * R**2)) / 2
    assert np.abs(found.values - wanted).max() <= found.error <= (3e-6 if precision == 32 else 1e-12)


def test_a_disc_half_below_the_horizon_gives_half_of_what_is_known(radiance: Any) -> None:
    """A disc of angle σ on the horizon facing the origin: E/π = (σ - sin σ cos σ)/π."""
    sigma = np.array([0.1, 0.8, 1.4])
    found = radiance(
        light="disc",
        diffuse="lambert",
        albedo=1,
        NoV=0.5,
        center_x=1,
        center_y=0,
        center_z=0,
        normal_x=-1,
        normal_y=0,
        normal_z=0,
        radius=np.tan(sigma),
        precision=64,
    )
    assert np.abs(found.values - (sigma - np.sin(sigma) * np.cos(sigma)) / math.pi).max() <= found.error < 1e-11


@pytest.mark.parametrize("shape", ["disc", "rectangle"])
def test_a_small_light_is_punctual(radiance: Any, shape: str) -> None:
    """c = L ω/π in the limit; what is left falls with the square of the size."""
    to, size = direction(0.6, 2.5), 1e-4
    edges = {"u": size * np.cross(to, [0, 0, 1]), "v": size * np.cross(np.cross(to, [0, 0, 1]), to)}
    edges["v"] = edges["v"] if np.cross(edges["u"], edges["v"]) @ to < 0 else -edges["v"]
    if shape == "disc":
        area, form = math.pi * size**2, {**keywords(to, normal=-to), "radius": size}
    else:
        area, form = 4 * float(np.linalg.norm(np.cross(edges["u"], edges["v"]))), keywords(to, **edges)
    rest: dict[str, Any] = {
        "ndf": "ggx",
        "alpha": 0.3,
        "diffuse": "lambert",
        "albedo": 0.5,
        "NoV": 0.7,
        "precision": 64,
    }
    found = radiance(light=shape, radiance=1 / area, **form, **rest)
    point = radiance(light="punctual", NoL=0.6, phi_l=2.5, color=1 / math.pi, **rest)
    assert abs(found.values / point.values - 1) < 1e-6


@pytest.mark.parametrize(
    "ndf, own",
    [
        ("ggx", {"alpha": 0.3}),
        ("ggx", {"alpha": 0.05}),
        ("beckmann", {"alpha": 0.2}),
        ("ggx_anisotropic", {"alpha_x": 0.1, "alpha_y": 0.4}),
    ],
)
@pytest.mark.parametrize("NoV", [0.1, 0.6, 1.0])
def test_lobes_under_a_rectangle_are_brute_force(radiance: Any, ndf: str, own: dict[str, float], NoV: float) -> None:
    c, u, v = np.array([-0.4, 0.2, 1.0]), np.array([0.5, 0.1, 0.0]), np.array([0.1, -0.6, 0.2])
    view = direction(NoV, 0.3)
    wanted = over_rectangle(lambda to: brdf(to, view, ndf=ndf, f0=0.04, **own), c, u, v)
    for precision in (32, 64):
        found = radiance(
            light="rectangle",
            ndf=ndf,
            fresnel="schlick",
            f0=0.04,
            NoV=NoV,
            phi=0.3,
            precision=precision,
            **own,
            **keywords(c, u=u, v=v),
        )
        assert abs(found.values - wanted) <= found.error + 1e-12, (found.values - wanted, found.error)
        assert found.error <= (5e-6 if precision == 32 else 1e-11)


def test_diffuse_models_under_a_rectangle_are_brute_force(radiance: Any) -> None:
    c, u, v = np.array([-0.4, 0.2, 1.0]), np.array([0.5, 0.1, 0.0]), np.array([0.1, -0.6, 0.2])
    view = direction(0.4, 0.3)
    for name, entry in models("diffuse").items():
        own = {p.name: p.typical[len(p.typical) // 2] for p in entry.parameters}
        found = radiance(light="rectangle", diffuse=name, NoV=0.4, phi=0.3, **own, **keywords(c, u=u, v=v))

        def f(to: np.ndarray, entry: Model = entry, own: dict[str, float] = own) -> np.ndarray:
            return entry.reference["f"](to, np.broadcast_to(view, to.shape), **own)

        wanted = over_rectangle(f, c, u, v, 400)
        assert abs(found.values - wanted) <= found.error + 1e-6 and found.error < 5e-6, name


@PRECISIONS
@pytest.mark.parametrize("ndf", ["ggx", "beckmann"])
@pytest.mark.parametrize("aimed", [False, True])
def test_a_light_is_the_sum_of_its_parts(radiance: Any, precision: int, ndf: str, aimed: bool) -> None:
    """Any width from 1e-4, grazing views, lights that set or that the lobe's middle falls into: the inner edges cut
    lobes where the whole does not, and the stated errors cover the difference."""
    rng = np.random.default_rng(1)
    n = 60
    NoV, phi = rng.choice([1e-3, 0.01, 0.1, 0.3, 0.7, 0.99, 1.0], n), rng.uniform(0, 2 * math.pi, n)
    alpha = 10 ** rng.uniform(-4, 0, n)
    center = rng.normal(size=(n, 3))
    center[:, 2] = 0.7 * np.abs(center[:, 2]) + 0.05 * rng.normal(size=n)
    if aimed:
        center = direction(NoV, phi + math.pi) + rng.normal(size=(n, 3)) * (alpha * rng.uniform(0, 3, n))[:, None]
    u, v = rng.normal(size=(2, n, 3)) / 2
    v[(np.cross(u, v) * center).sum(1) > 0] *= -1

    def lit(c: np.ndarray, u: np.ndarray, v: np.ndarray) -> Integrated:
        form = {
            f"{name}_{axis}": x[:, k] for name, x in (("center", c), ("u", u), ("v", v)) for k, axis in enumerate("xyz")
        }
        return radiance(light="rectangle", ndf=ndf, alpha=alpha, NoV=NoV, phi=phi, precision=precision, **form)

    whole = lit(center, u, v)
    parts = [lit(center + a * u / 2 + b * v / 2, u / 2, v / 2) for a in (-1, 1) for b in (-1, 1)]
    apart = np.abs(sum(p.values.astype(float) for p in parts) - whole.values).max()
    assert apart <= whole.error + sum(p.error for p in parts)
    assert whole.error <= (2e-5 if precision == 32 else 1e-7)
    assert -whole.error <= whole.values.min() and whole.values.max() <= 1 + whole.error


def test_a_light_over_the_whole_sky_is_ambient(radiance: Any, device: Device) -> None:
    alpha = np.array([1e-3, 0.03, 0.3, 1.0])
    albedo = integrate("albedo", ndf="ggx", alpha=alpha, NoV=0.4, precision=64, device=device)
    found = radiance(
        light="disc", center_x=0, center_y=0, center_z=1e-6, radius=1e6, ndf="ggx", alpha=alpha, NoV=0.4, precision=64
    )
    assert np.abs(found.values - albedo.values).max() <= found.error + albedo.error + 1e-11


def test_a_tabulated_area_serves_lights(radiance: Any) -> None:
    """Phong has no closed area: whole and parts, and the punctual limit."""
    rest: dict[str, Any] = {"ndf": "phong", "exponent": 50, "NoV": 0.5, "phi": math.pi, "precision": 64}
    found = radiance(
        light="disc", **{**OVERHEAD, "center_x": 1.5}, normal_x=-1.5, radius=1e-4, radiance=1e8 / math.pi * 3.25, **rest
    )
    NoL = 1 / math.sqrt(3.25)
    point = radiance(light="punctual", NoL=NoL, color=1 / math.pi, **rest)
    assert abs(found.values / point.values - 1) < 1e-6


def test_a_users_brdf_under_a_light_has_rgb(radiance: Any, tmp_path: Any) -> None:
    path = tmp_path / "tinted.clh"
    path.write_text(
        "real3 brdf_tinted_f(real3 l, real3 v, real k) "
        "{ const real f = k / PI; const real3 r = {f, f / 2, f / 4}; return r; }\n"
    )
    white = radiance(light="rectangle", diffuse="lambert", albedo=0.5, NoV=[0.2, 0.9], **SQUARE)
    found = radiance(light="rectangle", brdf=str(path), k=0.5, NoV=[0.2, 0.9], **SQUARE)
    assert found.values.shape == (2, 3)
    assert np.abs(found.values - white.values[:, None] * [1, 0.5, 0.25]).max() <= found.error + white.error
    tinted = radiance(light="punctual:color=1/2/4", brdf=str(path), k=1, NoV=[0.2, 0.9], NoL=1)
    assert tinted.values.shape == (2, 3) and np.allclose(tinted.values, 1)


def test_colours_add_an_axis_and_numbers_do_not(radiance: Any) -> None:
    lit: dict[str, Any] = {"ndf": "ggx", "alpha": 0.3, "NoV": [0.2, 0.5], "NoL": 0.5}
    grey = radiance(light="punctual", **lit)
    red = radiance(light="punctual:color=1/.5/0", **lit)
    gold = radiance(light="punctual", fresnel="schlick:gold", **lit)
    assert grey.values.shape == (2,) and red.values.shape == gold.values.shape == (2, 3)
    assert np.allclose(red.values, grey.values[:, None] * [1, 0.5, 0], rtol=1e-6)
    assert gold.values[0, 0] > gold.values[0, 2]


# ---------------------------------------------------------------------------------------------- kernels of lights


@PRECISIONS
@pytest.mark.parametrize("name", sorted(models("light")))
def test_the_kernels_of_lights_are_their_references(device: Device, name: str, precision: int) -> None:
    if precision == 64 and not device.fp64:
        pytest.skip("no float64")
    entry = models("light")[name]
    to = np.moveaxis(direction(*np.meshgrid(np.linspace(-0.99, 0.99, 40), np.linspace(0, 6.2, 40))), -1, 0)
    to = to.reshape(3, -1)
    own = {p.name: np.full(to.shape[1], p.typical[0]) for p in entry.parameters}
    function = entry.provides[0]
    found = evaluate(
        device, function, {"light": entry}, np.concatenate([to, *(v[None] for v in own.values())]), precision
    )[0]
    wanted = entry.reference[FUNCTIONS[function].ending](to.T, **own)
    assert np.isfinite(found).all() and (wanted > 0).any()
    assert np.abs(found - wanted).max() < (1e-6 if precision == 32 else 1e-14)


@pytest.mark.parametrize("ndf", ["ggx", "phong", "ggx_anisotropic"])
@pytest.mark.parametrize("masking", ["smith", "smith_separable", "cook_torrance", "kelemen"])
def test_the_specular_brdf_is_reciprocal(device: Device, ndf: str, masking: str) -> None:
    """SPECULAR_F as verification uses it, the area from its table where there is no closed one."""
    rng = np.random.default_rng(3)
    slots = {"ndf": model("ndf", ndf), "masking": model("masking", masking), "fresnel": model("fresnel", "schlick")}
    n, precision = 300, 64 if device.fp64 else 32
    to, v = (direction(rng.uniform(0.01, 1, n), rng.uniform(0, 6.28, n)) for _ in range(2))
    part = engine.Part(device, integral("albedo"), slots, precision)
    own = {p.name: p.typical[len(p.typical) // 2] for m in slots.values() for p in m.parameters}
    rows = np.stack(
        [*(np.ones(n) for _ in part.view), *(np.full(n, own[p.name]) for m in slots.values() for p in m.parameters)]
    )
    numbers, terms, _ = part.cells(rows, precision)
    numbers = numbers[len(part.view) :]
    there, back = (
        evaluate(device, "SPECULAR_F", slots, np.concatenate([a.T, b.T, numbers]), precision, terms)[0]
        for a, b in ((to, v), (v, to))
    )
    assert np.allclose(there, back, rtol=1e-12 if device.fp64 else 1e-5, atol=0) and there.max() > 0
    if "area" in slots["ndf"].reference and masking == "smith":
        f0 = own.pop("f0")
        own.pop("f90")
        assert np.allclose(there, brdf(to, v, ndf=ndf, f0=f0, **own), rtol=1e-9 if device.fp64 else 1e-3, atol=1e-30)


# ---------------------------------------------------------------------------------------------- environments


def over_texels(texels: np.ndarray, f: Any, frame: np.ndarray, n: int) -> np.ndarray:
    """(3,) ∫ f L NoL dω of a lat-long by n × n Gauss nodes a texel."""
    rows, columns, _ = texels.shape
    x, w = gauss(n)
    total = np.zeros(3)
    for r in range(rows):
        theta = ((r + x) * math.pi / rows)[:, None]
        for c in range(columns):
            if not texels[r, c].any():
                continue
            phi = (c + x) * 2 * math.pi / columns - math.pi
            axes = np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)
            d = np.stack(np.broadcast_arrays(*axes))
            to = np.moveaxis(np.tensordot(frame, d, 1), 0, -1)
            weight = np.sin(theta) * (math.pi / rows) * (2 * math.pi / columns) * w[:, None] * w
            total += (f(to) * np.maximum(to[..., 2], 0) * weight).sum() * texels[r, c].astype(float)
    return total


def random_sky(rows: int = 6) -> np.ndarray:
    return np.random.default_rng(5).uniform(0, 1, (rows, 2 * rows, 3)).astype(np.float32)


@PRECISIONS
def test_a_constant_environment_is_the_albedo(radiance: Any, device: Device, precision: int) -> None:
    alpha = np.array([1e-4, 0.1, 1.0])
    rest: dict[str, Any] = {"ndf": "ggx", "alpha": alpha, "NoV": 0.3, "precision": precision}
    albedo = integrate("albedo", device=device, **rest)
    found = radiance(environment=np.full((4, 8, 3), 2.0, np.float32), **rest)
    assert found.values.shape == (3, 3)
    assert np.abs(found.values - 2 * albedo.values[:, None]).max() <= found.error + 2 * albedo.error


@PRECISIONS
@pytest.mark.parametrize("cube", [False, True])
def test_a_white_sky_over_a_black_ground_is_the_albedo_too(
    radiance: Any, device: Device, precision: int, cube: bool
) -> None:
    """With no least radiance to take away: all of it over nodes, sharp lobes too."""
    sky = np.zeros((6, 4, 4, 3) if cube else (4, 8, 3), np.float32)
    if cube:
        sky[2] = 1
        sky[[0, 1, 4, 5], :2] = 1
    else:
        sky[:2] = 1
    alpha = np.array([1e-4, 0.01, 0.1, 0.5])
    rest: dict[str, Any] = {"ndf": "ggx", "alpha": alpha, "NoV": 0.4, "precision": precision}
    albedo = integrate("albedo", device=device, **rest)
    found = radiance(environment=sky, phi=0.3, **rest)
    assert np.abs(found.values - albedo.values[:, None]).max() <= found.error + albedo.error
    assert found.error < 2e-5


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "ndf, own, nodes",
    [
        ("ggx", {"alpha": 0.4}, 60),
        ("ggx", {"alpha": 0.02}, 700),
        ("ggx_anisotropic", {"alpha_x": 0.1, "alpha_y": 0.4}, 160),
    ],
)
def test_lobes_in_an_environment_are_brute_force(radiance: Any, ndf: str, own: dict[str, float], nodes: int) -> None:
    sky, view = random_sky(), direction(0.6, 0.7)
    wanted = over_texels(sky, lambda to: brdf(to, view, ndf=ndf, f0=0.04, **own), frame_of((0, 1, 0)), nodes)
    for precision in (32, 64):
        found = radiance(
            environment=sky, ndf=ndf, fresnel="schlick", f0=0.04, NoV=0.6, phi=0.7, precision=precision, **own
        )
        assert np.abs(found.values - wanted).max() <= found.error + 1e-9, (found.values - wanted, found.error)
        assert found.error < 2e-5


@pytest.mark.few(2)
@pytest.mark.parametrize("ndf, alpha, NoV", [("ggx", 0.017, 0.001), ("beckmann", 0.044, 0.001), ("ggx", 0.025, 0.02)])
def test_grazing_views_are_promoted_where_float32_blurs_the_lobe(
    radiance: Any, ndf: str, alpha: float, NoV: float
) -> None:
    """A half vector l + v is short there: what float32 leaves of it is 1e-7/(n·v) of a radian."""
    sky = np.random.default_rng(4).uniform(0, 1, (16, 32, 3)).astype(np.float32) ** 8
    rest: dict[str, Any] = {"environment": sky, "ndf": ndf, "alpha": alpha, "NoV": NoV, "normal": (0.3, 1, 0.2)}
    single, double = radiance(**rest), radiance(precision=64, tolerance=1e-6, **rest)
    assert np.abs(single.values - double.values).max() <= single.error + double.error
    assert "float64" in single.notices[0]


def test_a_tilted_surface_and_the_sum_of_lobes(radiance: Any) -> None:
    """The horizon cuts texels: brute force with many nodes is good to 1e-5."""
    sky, normal, view = random_sky(), (0.3, 0.5, -0.8), direction(0.5, 1.0)

    def f(to: np.ndarray) -> np.ndarray:
        return brdf(to, view, alpha=0.5) + 0.3 / math.pi

    found = radiance(
        environment=sky, normal=normal, ndf="ggx", alpha=0.5, diffuse="lambert", albedo=0.3, NoV=0.5, phi=1.0
    )
    assert np.abs(found.values - over_texels(sky, f, frame_of(normal), 200)).max() <= found.error + 1e-5


def test_frames_are_rotations_and_turn_the_shortest_way() -> None:
    for normal in ((0, 1, 0), (1, 2, 3), (0, -1, 0), (-1, -1e-9, 0), (1e-4, -1, 0)):
        frame = frame_of(normal)
        assert np.allclose(frame @ frame.T, np.eye(3), atol=1e-12) and np.linalg.det(frame) == pytest.approx(1)
        assert np.allclose(frame[2], np.array(normal) / np.linalg.norm(normal))
    assert np.allclose(frame_of((0, 3, 0)), [[1, 0, 0], [0, 0, -1], [0, 1, 0]])


def test_one_bright_texel_is_a_punctual_light(radiance: Any) -> None:
    sky = np.zeros((512, 1024, 3), np.float32)
    row, column = 130, 300
    sky[row, column] = (1e5, 2e5, 3e5)
    theta, phi = (row + 0.5) * math.pi / 512, (column + 0.5) * 2 * math.pi / 1024 - math.pi
    omega = 2 * math.pi / 1024 * (math.cos(row * math.pi / 512) - math.cos((row + 1) * math.pi / 512))
    rest: dict[str, Any] = {"ndf": "ggx", "alpha": 0.5, "NoV": 0.6, "phi": 0.4, "precision": 64}
    found = radiance(environment=sky, **rest)
    # In the frame of +Y an azimuth runs from +X to -Z.
    point = radiance(light="punctual", NoL=math.cos(theta), phi_l=-phi, color=1e5 * omega / math.pi, **rest)
    assert np.allclose(found.values, point.values * [1, 2, 3], rtol=2e-5)


@pytest.mark.few(1)
@pytest.mark.parametrize("cube", [False, True])
def test_a_mirror_shows_the_texel_times_fresnel(radiance: Any, cube: bool) -> None:
    rng = np.random.default_rng(2)
    sky = rng.uniform(0, 1, (6, 8, 8, 3) if cube else (16, 32, 3)).astype(np.float32)
    NoV, phi = np.array([0.05, 0.3, 0.6, 0.9]), np.array([0.3, 1.7, 3.3, 5.1])
    gold = model("fresnel", "schlick").presets["gold"]["f0"]
    F = np.stack([model("fresnel", "schlick").reference["F"](NoV, f0=f, f90=1.0) for f in gold], -1)
    found = radiance(environment=sky, rotate=40, fresnel="schlick:gold", NoV=NoV, phi=phi)
    mirrored = direction(NoV, phi + math.pi) @ frame_of((0, 1, 0))
    turn = -math.radians(40)
    x, y, z = mirrored.T
    x, z = x * math.cos(turn) - z * math.sin(turn), x * math.sin(turn) + z * math.cos(turn)
    if cube:
        wanted = []
        for d in zip(x, y, z, strict=True):
            axis = int(np.abs(d).argmax())
            face = 2 * axis + (d[axis] < 0)
            s, t = {0: (-z, -y), 1: (z, -y), 2: (x, z), 3: (x, -z), 4: (x, -y), 5: (-x, -y)}[face]
            k = len(wanted)
            i, j = (int((a[k] / abs(d[axis]) + 1) / 2 * 8) for a in (t, s))
            wanted.append(sky[face, i, j])
    else:
        rows = (np.arccos(y) / math.pi * 16).astype(int)
        wanted = list(sky[rows, ((np.arctan2(z, x) / (2 * math.pi) + 0.5) * 32).astype(int)])
    assert found.rule == "mirror" and found.values.shape == (4, 3)
    assert np.allclose(found.values, np.array(wanted) * F, rtol=1e-6)
    # A narrow lobe shows the same texel but for what its tail sees.
    lobe = radiance(environment=sky, rotate=40, ndf="beckmann", alpha=1e-4, fresnel="schlick:gold", NoV=NoV, phi=phi)
    assert np.allclose(lobe.values, found.values, rtol=2e-3)


def test_a_mirror_under_a_light_shows_it(radiance: Any) -> None:
    found = radiance(light="disc", **OVERHEAD, radius=0.5, radiance=3, fresnel="schlick", f0=0.04, NoV=[1.0, 0.95, 0.5])
    F = 0.04 + 0.96 * (1 - np.array([1.0, 0.95, 0.5])) ** 5
    assert np.allclose(found.values, 3 * F * [1, 1, 0], rtol=1e-6)


def test_environments_keep_their_options(radiance: Any) -> None:
    sky = random_sky()
    rest: dict[str, Any] = {"diffuse": "lambert", "albedo": 1, "NoV": 0.5, "normal": (1, 0, 0)}
    plain = radiance(environment=sky, **rest)
    assert np.allclose(radiance(environment=sky, exposure=1, **rest).values, 2 * plain.values, rtol=1e-5)
    turned = radiance(environment=environment(sky, rotate=90), **{**rest, "normal": (0, 0, 1)})
    assert np.allclose(turned.values, plain.values, atol=2e-5)
    many = np.empty((2, 3), np.float32)
    seen: list[float] = []
    radiance(environment=sky, out=many, progress=seen.append, **{**rest, "NoV": [0.5, 0.5]})
    assert np.array_equal(many[0], many[1]) and seen[-1] == 1


# ---------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    "arguments, said",
    [
        ({"ndf": "ggx"}, "either a light or an environment"),
        ({"ndf": "ggx", "light": "ambient", "environment": np.ones((2, 4, 3))}, "either a light or an environment"),
        ({"ndf": "ggx", "light": "punctul"}, "did you mean 'punctual'"),
        ({"ndf": "ggx", "light": "punctual"}, "light punctual needs NoL"),
        ({"ndf": "ggx", "light": "punctual", "NoL": 2}, r"NoL = 2 is outside \[-1, 1\]"),
        ({"ndf": "ggx", "light": "ambient", "normal": (0, 1, 0)}, "normal is of an environment"),
        ({"ndf": "ggx", "environment": np.ones((2, 4, 3)), "normal": (0, 0, 0)}, "three numbers that are not all 0"),
        ({"ndf": "ggx", "environment": np.ones((2, 4, 3)), "color": 1}, "no parameter 'color'"),
        ({"ndf": "ggx", "light": "disc", **OVERHEAD, "radius": 1, "normal_z": 0}, "normal is 0"),
        ({"ndf": "ggx", "light": "rectangle", **SQUARE, "v_x": 1, "v_y": 0}, "parallel or 0"),
        ({"ndf": "ggx", "light": "ambient", "tolerance": 2}, r"outside \(0, 1\)"),
    ],
)
def test_bad_input_is_one_sentence(radiance: Any, arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        radiance(NoV=0.5, alpha=0.3, **arguments)


def test_out_must_hold_fractions(radiance: Any) -> None:
    with pytest.raises(UsageError, match="out is int32 of shape"):
        radiance(light="ambient", ndf="ggx", NoV=[0.2, 0.5], alpha=0.3, out=np.empty(2, np.int32))


def test_what_cannot_be_is_refused(radiance: Any, device: Device) -> None:
    with pytest.raises(UnsupportedError, match="reflects no punctual light"):
        radiance(light="punctual", NoV=0.5, NoL=0.5)
    with pytest.raises(UsageError, match="integral albedo has no light"):
        integrate("albedo", ndf="ggx", alpha=0.3, NoV=0.5, light="ambient", device=device)
    with pytest.raises(UsageError, match=r"whitefurnace\.integrate takes them"):
        engine.integrate("radiance", ndf="ggx", alpha=0.3, NoV=0.5, device=device)
