"""Spherical harmonics to degree 2: the least irradiance over the sphere, the window that keeps it from going negative,
and each engine's coefficients, evaluated as that engine's shader does."""

from __future__ import annotations

import itertools
import json
import math
import re

import numpy as np
import pytest

from whitefurnace import bake, harmonics
from whitefurnace.engines.presets import ENGINES
from whitefurnace.errors import InputError, UsageError
from whitefurnace.files import read_light
from whitefurnace.opencl.device import Device
from whitefurnace.sphere.grids import Shape
from whitefurnace.sphere.harmonics import (
    SCALINGS,
    evaluate,
    irradiance_at,
    least_irradiance,
    minimum,
    rmse_against,
    sh_window,
    sinc_window,
    turned,
    unscaled,
    windowed,
)

EPS = np.finfo(np.float64).eps


def written_out(d: np.ndarray) -> np.ndarray:
    """(9, m) basis in angles, cos mφ and sin mφ times associated Legendre functions: not the polynomials in x, y, z."""
    x, y, z = d
    theta, phi = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    s, c = np.sin(theta), np.cos(theta)
    k1, k2 = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    return np.stack(
        [
            np.full_like(x, math.sqrt(1 / (4 * math.pi))),
            k1 * s * np.sin(phi),
            k1 * c,
            k1 * s * np.cos(phi),
            k2 / 2 * s**2 * np.sin(2 * phi),
            k2 * s * c * np.sin(phi),
            k2 / math.sqrt(12) * (3 * c**2 - 1),
            k2 * s * c * np.cos(phi),
            k2 / 2 * s**2 * np.cos(2 * phi),
        ]
    )


def spread(count: int) -> np.ndarray:
    """(3, count) directions of a Fibonacci spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    phi = np.arange(count) * math.pi * (3 - math.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z])


def unit(*v: float) -> np.ndarray:
    return np.array(v, np.float64) / np.linalg.norm(v)


def suns(*lights: tuple[np.ndarray, tuple[float, float, float]]) -> np.ndarray:
    """(9, 3) radiance coefficients of suns: directions and powers by channel."""
    return np.asarray(sum(written_out(d[:, None]) * np.array(power) for d, power in lights))


A, B = unit(1, 2, -0.5), unit(-0.3, 0.8, 0.6)
WHITE = (1.0, 1.0, 1.0)
LIGHTS = {
    "sun": suns((A, WHITE)),
    "opposite suns": suns((A, WHITE), (-A, WHITE)),
    "coloured suns": suns((A, (5, 1, 0.1)), (B, (0.2, 1, 6))),
    "sun and sky": suns((B, (30, 25, 20))) + np.eye(9)[:, :1] * np.array([1, 1.5, 3]),
    "a channel without light": suns((A, (1, 0, 0))),
    "blue is the sun's alone": suns((A, (0, 0, 1e-3))) + np.eye(9)[:, :1] * np.array([100, 100, 0]),
}


def random_sets(count: int) -> np.ndarray:
    """Sets with a positive mean, half of them of bands that bring E under zero, half with all bands of any weight."""
    rng = np.random.default_rng(5)
    sh = rng.normal(size=(count, 9, 3))
    sh[:, 1:4] *= 10 ** rng.uniform(-3, 1, (count, 1, 1))
    sh[:, 4:] *= 10 ** rng.uniform(-3, 1, (count, 1, 1))
    sh[:, 0] = np.abs(sh[:, 0])
    bright = rng.normal(size=(count // 4, 3, 3))
    sh[: count // 4] = np.einsum(
        "nkl,nlc->nkc",
        written_out(
            (bright / np.linalg.norm(bright, axis=1, keepdims=True)).transpose(1, 0, 2).reshape(3, -1),
        )
        .reshape(9, -1, 3)
        .transpose(1, 0, 2),
        10 ** rng.uniform(-4, 0, (count // 4, 3, 3)),
    )
    return sh


# -------------------------------------------------------------------------------------------- the minimum
def degenerate() -> np.ndarray:
    """Functions whose minimum is not isolated, or whose linear term has nothing along the least eigenvector."""
    sh = np.zeros((9, 9))
    sh[0, 0] = 1  # constant
    sh[1, 3] = 1  # linear
    sh[2, 6] = 1  # least on the equator
    sh[3, 6] = -1  # at both poles
    sh[4, [6, 3]] = -1, 0.1  # a linear term across the poles' axis: two minima
    sh[5, [6, 2]] = 1, 0.1  # a circle
    sh[6, [6, 2]] = 1, 1e-17  # rounding only
    sh[7, [6, 3]] = -1, 1e3  # the linear term rules
    return sh


def test_the_minimum_is_the_least_of_a_dense_grid_refined():
    rng = np.random.default_rng(3)
    strong = rng.normal(size=(20, 9)) * [1, 9, 9, 9, 1, 1, 1, 1, 1]
    sh = np.concatenate([degenerate(), rng.normal(size=(40, 9)), strong])
    least, where = minimum(sh)
    assert np.abs(np.linalg.norm(where, axis=-1) - 1).max() < 4 * EPS
    # Attained where it says, to rounding of nine terms.
    at = np.einsum("kn,nk->n", written_out(where.T), sh)
    assert np.abs(at - least).max() < 1e-14 * np.abs(sh).max()
    # And nowhere less: downhill from the best of 2000 directions, by steps that halve.
    d = spread(2000)
    best = d[:, (written_out(d).T @ sh.T).argmin(0)]
    value = np.einsum("kn,nk->n", written_out(best), sh)
    assert (value >= least - 1e-14 * np.abs(sh).max()).all()
    for step in 0.1 * 0.7 ** np.arange(80):
        tried = best[:, None] + step * spread(16)[..., None]
        tried /= np.linalg.norm(tried, axis=0)
        values = np.einsum("kmn,nk->mn", written_out(tried.reshape(3, -1)).reshape(9, 16, -1), sh)
        pick = values.argmin(0)
        better = values.min(0) < value
        best = np.where(better, np.take_along_axis(tried, pick[None, None], 1)[:, 0], best)
        value = np.minimum(value, values.min(0))
    # The last steps are 1e-13 long and f is level there; what is left is rounding of arccos.
    assert np.abs(value - least).max() < 1e-13 * np.abs(sh).max()


def test_the_least_irradiance_of_a_sun_is_as_by_hand():
    # 4π E/π of a sun of power 1 is 1 + 2c + 5/4 P₂(c), least at c = -8/15: -19/120.
    least = least_irradiance(LIGHTS["sun"])
    assert np.allclose(least, -19 / 120 / (4 * math.pi), rtol=1e-14)


# -------------------------------------------------------------------------------------------- the window
def non_negative(sh: np.ndarray) -> None:
    given = windowed(sh)
    size = np.abs(sh).sum(-2) * 16 * EPS  # rounding of the sums
    assert (given.after >= -size).all()
    assert ((given.window >= 0) & (given.window <= 1)).all() and (given.window[..., 0] == 1).all()
    d = spread(300)
    assert (irradiance_at(given.values, d).min(-2) >= -size).all()
    # Where a channel was negative one now touches zero, to 2e-8 of a bisection: no more was taken than needed.
    ringing = given.before.min(-1) < 0
    assert (given.after.min(-1)[ringing] <= 1e-7 * np.abs(sh).sum(-2).max(-1)[ringing]).all()


def test_no_normal_is_dark_below_zero():
    non_negative(random_sets(2000))
    non_negative(np.stack(list(LIGHTS.values())))


@pytest.mark.long
def test_no_normal_is_dark_below_zero_for_many():
    sets = random_sets(100_000)
    for chunk in np.split(sets, 20):
        non_negative(chunk)


def test_a_sun_s_window_is_as_by_hand():
    # Least in 4/3 (1 - w₁)² + 5/16 (1 - w₂)² of 1 + 2w₁c + 5/4 w₂P₂(c) ≥ 0: its vertex gives w₁² = 15/8 w₂ - 75/64 w₂².
    w2 = np.linspace(0.85, 0.95, 1_000_001)
    w1 = np.sqrt(15 / 8 * w2 - 75 / 64 * w2**2)
    cost = 4 / 3 * (1 - w1) ** 2 + 5 / 16 * (1 - w2) ** 2
    k = int(cost.argmin())
    got = windowed(LIGHTS["sun"]).window
    # Cost is level at its least: 1e-7 of grid spacing, and of the bisection less.
    assert got == pytest.approx([1, w1[k], w2[k]], abs=3e-7)


@pytest.mark.parametrize("name", ["coloured suns", "sun and sky", "blue is the sun's alone"])
def test_no_window_that_serves_changes_less(name):
    sh = LIGHTS[name]
    given = windowed(sh)
    power = [(windowed_band(sh, degree) ** 2).sum() for degree in (1, 2)]
    rng = np.random.default_rng(7)
    tried = np.concatenate([rng.uniform(0, 1, (20_000, 2)), given.window[1:] + rng.uniform(-1e-3, 1e-3, (20_000, 2))])
    tried = tried[(tried <= 1).all(-1)]
    w = np.concatenate([np.ones((len(tried), 1)), tried], 1)[:, [0, 1, 1, 1, 2, 2, 2, 2, 2]]
    serves = (least_irradiance(sh * w[..., None]) >= 0).all(-1)
    cost = ((1 - tried) ** 2 * power).sum(-1)
    assert serves.any() and not serves.all()
    assert ((1 - given.window[1:]) ** 2 * power).sum() <= cost[serves].min() * (1 + 1e-9)


def windowed_band(sh: np.ndarray, degree: int) -> np.ndarray:
    """One band's coefficients of E/π."""
    return sh[1:4] * (2 / 3) if degree == 1 else sh[4:] / 4


def test_what_is_not_negative_stays_as_it_is():
    sh = LIGHTS["sun"] + np.eye(9)[:, :1] * 1.0
    assert least_irradiance(sh).min() > 0
    for mode in ("auto", "none"):
        assert windowed(sh, mode).values is sh
    # Two suns opposite each other have no degree 1, and 5/4 P₂ is -5/8 at the least.
    assert windowed(LIGHTS["opposite suns"]).values is LIGHTS["opposite suns"]
    ringing = LIGHTS["sun"].astype(np.float32)
    assert windowed(ringing, "none").values is ringing
    hemisphere = np.zeros((9, 3))
    # E/π = (1 + z)/2 touches zero at the nadir, and may by rounding fall under it.
    hemisphere[0], hemisphere[2] = math.sqrt(math.pi), 0.75 * math.sqrt(4 * math.pi / 3)
    assert windowed(hemisphere).values is hemisphere


def test_a_cutoff_of_three_serves_any_light():
    # cmgen's window: sinc⁴(π/3) and sinc⁴(2π/3) are (27/4π²)² and a sixteenth of it.
    assert sinc_window(3) == pytest.approx([1, (27 / (4 * math.pi**2)) ** 2, (27 / (4 * math.pi**2)) ** 2 / 16])
    assert list(sinc_window(2)[2:]) == [0] and list(sinc_window(1)) == [1, 0, 0]
    for sh in LIGHTS.values():
        given = windowed(sh, 3)
        assert (given.after >= 0).all() and given.mode == 3
    assert windowed(LIGHTS["sun"], 13).after.min() < 0  # where cmgen's search begins


def test_a_band_of_zeros_has_no_factor_and_no_mean_leaves_no_band():
    linear, tilted = np.zeros((2, 9, 3))
    linear[0], linear[3] = 1, 9
    got = windowed(linear).window
    # E/π of degree 1 is 2/3 of the radiance's, and √3·9·2/3·w₁ = 1 touches zero.
    assert got == pytest.approx([1, 1 / (math.sqrt(3) * 6), 1], rel=1e-7) and got[2] == 1
    tilted[[3, 6]] = 1
    assert windowed(tilted).window.tolist() == [1, 0, 0]


def test_what_cannot_be_windowed_is_refused():
    sh = LIGHTS["sun"].copy()
    sh[4, 1] = np.nan
    with pytest.raises(InputError, match="not finite"):
        windowed(sh)
    with pytest.raises(InputError, match=r"shape \(3, 9\), not \(9, 3\)"):
        windowed(sh.T)
    with pytest.raises(InputError, match="negative"):
        windowed(-LIGHTS["sun"])
    assert (windowed(np.zeros((9, 3))).window == 1).all()


def test_the_option():
    assert [sh_window(f"window={x}") for x in ("auto", "none", "3", "2.5")] == ["auto", "none", 3.0, 2.5]
    for text in (
        "auto",
        "window",
        "windows=auto",
        "window=",
        "window=best",
        "window=0.5",
        "window=nan",
        "window=inf",
        "window=-1",
        "window=1e9",
    ):
        with pytest.raises(UsageError) as told:
            sh_window(text)
        assert "\n" not in str(told.value) and "window" in str(told.value)


# ------------------------------------------------------------------------------------------------- error
def test_the_rmse_is_as_by_hand():
    shape = Shape(False, 32)
    d, weights = shape.directions(), shape.solid_angles()
    c = (A @ d)[:, None]
    # Of a sun's E/π = 4c₊/4π degrees 0, 1 and 2 hold all but 1/128 of the square. Midpoints of 6·32² texels integrate
    # it to 1e-3, and the mean of 1 that the largest error is told in.
    cube = np.maximum(c, 0) / math.pi * np.ones(3)
    rmse, worst = rmse_against(LIGHTS["sun"], cube.reshape(6, 32, 32, 3), d, weights)
    assert rmse == pytest.approx(math.sqrt(1 / 128), rel=1e-2)
    wrong = np.abs(1 + 2 * c + 5 / 8 * (3 * c * c - 1) - 4 * np.maximum(c, 0))
    assert worst == pytest.approx(wrong.max(), rel=2e-3) and 0.34 < worst < 0.375  # 3/8 at the horizon
    sky = np.zeros((9, 3))
    sky[0], sky[2] = math.sqrt(math.pi), 0.75 * math.sqrt(4 * math.pi / 3)
    # A hemisphere of 1 has no degree 2, and (1 + z)/2 exactly.
    rmse, worst = rmse_against(sky, np.repeat((1 + d[2]) / 2, 3), d, weights)
    assert max(rmse, worst) < 8 * EPS
    assert rmse_against(np.zeros((9, 3)), np.zeros((6, 32, 32, 3)), d, weights) == (0, 0)


# ------------------------------------------------------------------------------------------------ engines
def filament_shader(sh: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Irradiance_SphericalHarmonics of Filament's light_indirect shader, without its max(…, 0)."""
    x, y, z = n[:, :, None]
    return np.asarray(
        sh[0]
        + sh[1] * y
        + sh[2] * z
        + sh[3] * x
        + sh[4] * (y * x)
        + sh[5] * (y * z)
        + sh[6] * (3 * z * z - 1)
        + sh[7] * (z * x)
        + sh[8] * (x * x - y * y)
    )


def babylon_shader(harmonics: np.ndarray, n: np.ndarray) -> np.ndarray:
    """SphericalHarmonics.preScaleForRendering of @babylonjs/core, then computeEnvironmentIrradiance."""
    pi = math.pi
    constants = np.array(
        [
            (1 / (4 * pi)) ** 0.5,
            -((3 / (4 * pi)) ** 0.5),
            (3 / (4 * pi)) ** 0.5,
            -((3 / (4 * pi)) ** 0.5),
            (15 / (4 * pi)) ** 0.5,
            -((15 / (4 * pi)) ** 0.5),
            (5 / (16 * pi)) ** 0.5,
            -((15 / (4 * pi)) ** 0.5),
            (15 / (16 * pi)) ** 0.5,
        ]
    )
    return filament_shader(harmonics * constants[:, None], n)  # the same nine terms


def babylon_env(p: np.ndarray, n: np.ndarray) -> np.ndarray:
    """SphericalPolynomial.FromArray and SphericalHarmonics.FromPolynomial, as for a .env file."""
    x, y, z, xx, yy, zz, yz, zx, xy = p
    harmonics = np.stack(
        [
            xx * 0.376127 + yy * 0.376127 + zz * 0.376126,
            -y * 0.977204,
            z * 0.977204,
            -x * 0.977204,
            xy * 1.16538,
            -yz * 1.16538,
            zz * 1.34567 - xx * 0.672834 - yy * 0.672834,
            -zx * 1.16538,
            xx * 1.16538 - yy * 1.16538,
        ]
    )
    return babylon_shader(math.pi * harmonics, n)


def babylon_lights_image_based(e: np.ndarray, n: np.ndarray) -> np.ndarray:
    """EXT_lights_image_based's loader: FromArray, convertIrradianceToLambertianRadiance, and shaded as they are."""
    return babylon_shader(e / math.pi, n)


SHADERS = {"filament": filament_shader, "babylon": babylon_env, "irradiance": babylon_lights_image_based}


@pytest.mark.parametrize("engine", SHADERS)
def test_an_engine_s_shader_gives_the_irradiance(engine):
    n = spread(500)
    scaled, shade = SCALINGS[engine], SHADERS[engine]
    rng = np.random.default_rng(11)
    for sh in (*LIGHTS.values(), rng.normal(size=(9, 3))):
        # Nine terms of the largest coefficient's size, Babylon's through a matrix of condition 6.
        tolerance = 1e-13 * np.abs(sh).max()
        assert np.abs(shade(scaled(sh), n) - irradiance_at(sh, n)).max() < tolerance
        assert np.abs(unscaled(scaled(sh), engine) - sh).max() < tolerance
    c = (A @ n)[:, None]
    sun = shade(scaled(LIGHTS["sun"]), n)
    assert np.abs(4 * math.pi * sun - (1 + 2 * c + 5 / 8 * (3 * c * c - 1))).max() < 1e-13
    constant = np.zeros((9, 3))
    constant[0] = math.sqrt(4 * math.pi)
    assert np.abs(shade(scaled(constant), n) - 1).max() < 1e-14
    hemisphere = np.zeros((9, 3))  # radiance 1 where A·d > 0: 1/2 + 3/4 c, no degree 2
    hemisphere[0], hemisphere[[1, 2, 3]] = math.sqrt(math.pi), 0.75 * math.sqrt(4 * math.pi / 3) * A[[1, 2, 0], None]
    assert np.abs(shade(scaled(hemisphere), n) - (1 + c) / 2).max() < 1e-14


def test_radiance_stays_and_what_has_no_basis_is_evaluated_in_angles():
    sh = LIGHTS["coloured suns"]
    assert SCALINGS["radiance"](sh) is sh
    n = spread(500)
    # arccos and arctan2 lose a digit at the poles.
    assert np.abs(evaluate(sh, n) - written_out(n).T @ sh).max() < 1e-13


# ------------------------------------------------------------------------------------------------- axes
def test_all_48_axes_turn_the_light_exactly():
    sh, n = LIGHTS["coloured suns"], spread(200)
    tolerance = 1e-14 * np.abs(sh).max()
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
            light = turned(sh, matrix)
            assert np.abs(irradiance_at(light, matrix @ n) - irradiance_at(sh, n)).max() < tolerance
            assert np.abs(turned(light, matrix.T) - sh).max() < tolerance
            # A sun's coefficients are the basis where it is stored.
            assert np.abs(turned(LIGHTS["sun"], matrix) - suns((matrix @ A, WHITE))).max() < 1e-14
    assert turned(sh, ((1, 0, 0), (0, 1, 0), (0, 0, 1))) is sh
    # By hand, a mirror in x changes the sign of what is odd in x.
    odd = np.array([1, 1, 1, -1, -1, 1, 1, -1, 1])[:, None]
    assert turned(sh, np.diag([-1, 1, 1])) == pytest.approx(sh * odd, rel=8 * EPS)


# ------------------------------------------------------------------------------------------------ a bake
def test_a_bake_gives_engines_the_window_and_states_it(device: Device, tmp_path):
    image = np.full((16, 32, 3), 0.01, np.float32)
    image[4, 9], image[9, 25] = (900, 700, 300), (0, 40, 90)
    made = bake(image, tmp_path, for_="raw,filament,babylon,gltf", size=16, quality="draft", device=device)[0]
    own = harmonics(image, device=device).values
    told = made.manifest["sh"]
    assert np.abs(np.load(tmp_path / "raw" / "array.npz")["sh"] - own).max() <= told["error"] * own[0].max()
    assert told["coefficients"] == np.load(tmp_path / "raw" / "array.npz")["sh"].tolist()
    want = windowed(np.array(told["coefficients"]))
    assert want.before.min() < 0 and told["window"] == want.window.tolist() and told["mode"] == "auto"
    assert min(told["minimum"]["before"]) < 0 <= min(told["minimum"]["after"]) + 1e-12 and 0 < told["rmse"] < 0.3
    assert [n for n in made.notices if "windowed by" in n]
    n, text = spread(300), (tmp_path / "filament" / "array_sh.txt").read_text()
    triples = re.findall(r"\(\s*(\S+),\s*(\S+),\s*(\S+)\); // (\S+),", text)
    assert [t[3] for t in triples] == ["L00", "L1-1", "L10", "L11", "L2-2", "L2-1", "L20", "L21", "L22"]
    keys = read_light(tmp_path / "filament" / "array_ibl.ktx").keys["sh"].split()
    env = read_light(tmp_path / "babylon" / "array.env").polynomials
    gltf = read_light(tmp_path / "gltf" / "array.gltf").irradiance_sh
    assert env is not None and gltf is not None
    # Texts of nine digits and 15 decimals; an engine's own direction is where it reads the cube.
    for engine, shade, values in (
        ("filament", filament_shader, np.array([t[:3] for t in triples], float)),
        ("filament", filament_shader, np.array(keys, float).reshape(9, 3)),
        ("babylon", babylon_env, env),
        ("gltf", babylon_lights_image_based, gltf),
    ):
        shown = shade(values, np.array(ENGINES[engine].matrix) @ n)
        assert np.abs(shown - irradiance_at(want.values, n)).max() < 1e-8 * np.abs(own).max()
        assert shown.min() > -1e-8 * np.abs(own).max()

    plain = bake(image, tmp_path, for_="filament", size=16, quality="draft", sh="window=none", device=device)[0]
    assert plain.state == "done" and plain.manifest["sh"]["window"] == [1, 1, 1]
    assert json.dumps(plain.manifest["sh"]["coefficients"]) == json.dumps(told["coefficients"])
    with pytest.raises(UsageError, match="window"):
        bake(image, tmp_path, sh="none", device=device)
