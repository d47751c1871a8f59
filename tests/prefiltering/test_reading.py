"""What engines show of a chain, and levels fitted to it: against closed forms, other forms of the same reads, and
environments that no fit has seen."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from reference import ggx_lobe
from whitefurnace.cli import main
from whitefurnace.errors import UsageError
from whitefurnace.files import write_exr
from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering import reading
from whitefurnace.prefiltering.convolution import Convolver
from whitefurnace.prefiltering.level_fit import LEAST, SHARPEST, read_mixtures
from whitefurnace.prefiltering.lobes import ndf_lobe
from whitefurnace.prefiltering.reading import FORMATS, Reader, bilinear, halved, hats, scored, stored, taps
from whitefurnace.prefiltering.recipe import chain, lod_of_roughness, roughness_of_level, roughness_of_lod
from whitefurnace.sphere.environments import cube_solid_angles, environment, statistics_of
from whitefurnace.sphere.grids import Shape, cube_centres, latlong_centres

GLASS = """real ndf_glass_D(real cos_m, real sin2_m, real alpha) {
  real t = alpha * alpha + (1 - alpha * alpha) * sin2_m;
  return 7 / (t * t);
}
"""


def latlong(f, rows: int = 128) -> np.ndarray:
    """An image of f(directions (3, m)) at texel centres."""
    d = latlong_centres(rows, 2 * rows, np.arange(2 * rows * rows))
    values = np.asarray(f(d), np.float32)
    return np.broadcast_to(values.reshape(rows, 2 * rows, -1), (rows, 2 * rows, 3)).copy()


def room(seed: int) -> np.ndarray:
    """A dark room with bright panels, hard edges and a gradient: nothing like the discs that the fit knows."""
    rng = np.random.default_rng(seed)

    def lit(d: np.ndarray) -> np.ndarray:
        values = 0.02 + 0.02 * d[1]
        for _ in range(4):
            axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            x, y, z = axes @ d
            a, b = 10 ** rng.uniform(-1.2, -0.3, 2)
            values = values + (z > 0) * (np.abs(x) < a * z) * (np.abs(y) < b * z) * 10 ** rng.uniform(-0.5, 1.5)
        return values

    return latlong(lit)


# ------------------------------------------------------------------------------------------- the mapping


@pytest.mark.parametrize("levels", [1, 2, 5, 9])
def test_lod_and_roughness_are_inverse(levels):
    for k in range(levels):
        r = roughness_of_level(k, levels)
        assert lod_of_roughness(r, levels) == pytest.approx(k, abs=1e-12)
        assert roughness_of_lod(k, levels) == r
    recipe = chain(levels=levels)
    assert hats(np.array([roughness_of_level(k, levels) for k in range(levels)]), recipe) == pytest.approx(
        np.eye(levels), abs=1e-12
    )
    assert hats(scored(), recipe).sum(1) == pytest.approx(np.ones(len(scored())), abs=1e-12)


# ------------------------------------------------------------------------------------------- reads


@pytest.mark.parametrize("size", [1, 2, 8])
def test_a_read_at_a_texel_centre_is_that_texel(size):
    index = np.arange(6 * size * size)
    level = np.random.default_rng(size).random((6, size, size, 3))
    assert bilinear(level, cube_centres(size, index)) == pytest.approx(level.reshape(-1, 3), abs=1e-12)


@pytest.mark.parametrize("size", [1, 2, 4, 8])
def test_reads_are_seamless(size):
    rng = np.random.default_rng(3)
    level = rng.random((6, size, size, 3))
    # Points on edges between faces: two coordinates of equal size, larger than the third.
    signs, third = rng.choice([-1.0, 1.0], (2, 200)), rng.uniform(-1, 1, 200)
    d = np.stack([signs[0], signs[1], third])
    for turn in range(3):
        on = np.roll(d, turn, 0)
        way = np.roll(np.stack([signs[0], -signs[1], 0 * third]), turn, 0)
        here, there = (bilinear(level, on + side * 1e-7 * way) for side in (1, -1))
        # A step of 1e-7 of a face is one of size · 1e-7 of a texel, times a difference of at most 1 between texels.
        assert np.abs(here - there).max() <= 4e-7 * size
        # On the edge half of the weight is each side's: the mean of the texels nearest to the two faces' reads.
        index, weights = taps(size, on + 1e-9 * way)
        faces = np.array([[weights[:, m][index[:, m] // size**2 == f].sum() for f in range(6)] for m in range(200)])
        inner = np.abs(third) < 1 - 1 / size
        assert np.sort(faces[inner], 1)[:, -2:] == pytest.approx(np.full((inner.sum(), 2), 0.5), abs=1e-6)


def test_at_a_corner_three_texels_meet():
    level = np.random.default_rng(5).random((6, 4, 4, 3))
    for corner in np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float):
        nearest = np.argsort(-(corner @ cube_centres(4, np.arange(96))))[:3]
        want = level.reshape(-1, 3)[nearest].mean(0)
        off = corner * [1 + 1e-9, 1, 1]
        assert bilinear(level, off[:, None])[0] == pytest.approx(want, abs=1e-6)


def test_weights_of_a_read_sum_to_one():
    index, weights = taps(8, reading.random_directions(4096))
    assert weights.sum(0) == pytest.approx(np.ones(4096), abs=1e-12) and weights.min() >= -1e-12
    assert index.min() >= 0 and index.max() < 6 * 64


# ------------------------------------------------------------------------------------------- formats


def small_floats(mantissa: int) -> np.ndarray:
    """Every finite value of an unsigned float with 5 bits of exponent, by its definition."""
    m = np.arange(2**mantissa) / 2**mantissa
    normal = [(1 + m) * 2.0 ** (e - 15) for e in range(1, 31)]
    return np.concatenate([m * 2.0**-14, *normal])


@pytest.mark.parametrize(("channel", "mantissa"), [(0, 6), (1, 6), (2, 5)])
def test_r11g11b10_takes_the_nearest_of_its_values(channel, mantissa):
    values = small_floats(mantissa)
    x = np.concatenate([values, 10 ** np.random.default_rng(1).uniform(-9, 4.8, 2000), [1e9, 0.0]])
    got = stored(np.stack([x] * 3, -1), "r11g11b10")[:, channel]
    want = np.abs(np.minimum(x, values[-1])[:, None] - values).min(1)
    assert np.isin(got, values).all()
    assert np.abs(got - np.minimum(x, values[-1])) == pytest.approx(want, abs=0)


def test_rgb9e5_is_within_half_a_step_of_its_shared_exponent():
    x = 10 ** np.random.default_rng(2).uniform(-4, 4.8, (2000, 3))
    got = stored(x, "rgb9e5")
    # 9 bits under an exponent with max < 2^e: steps of 2^(e-9), of at most max/2^8.
    assert (np.abs(got - np.minimum(x, 65408)) <= np.minimum(x, 65408).max(-1, keepdims=True) / 512).all()
    assert (stored(got, "rgb9e5") == got).all()
    for exact in ([1, 0.5, 0.25], [65408, 0, 128], [511 / 512, 1 / 512, 0]):
        assert stored(np.array([exact]), "rgb9e5")[0].tolist() == exact


def test_floats_of_two_sizes_and_an_unknown_format():
    x = np.array([[1 / 3, 1e5, 6e-8]])
    assert stored(x, "float16").tolist() == [[float(np.float16(1 / 3)), 65504.0, float(np.float16(6e-8))]]
    assert stored(x, "float32").tolist() == x.astype(np.float32).astype(float).tolist()
    with pytest.raises(UsageError, match="unknown format 'rgb9e4'; did you mean 'rgb9e5'"):
        stored(x, "rgb9e4")


# ------------------------------------------------------------------------------------------- references


@pytest.mark.parametrize("shape", [(32, 64, 3), (6, 16, 16, 3)])
def test_halving_an_environment_keeps_its_energy(shape):
    env = environment(np.random.default_rng(0).random(shape, np.float32))
    half = halved(env)
    assert half is not None and half.texels.shape[-3:] == (shape[-3] // 2, shape[-2] // 2, 3)
    # Float32 texels round at 6e-8 each.
    assert statistics_of(half)["mean"] == pytest.approx(env.statistics["mean"], rel=1e-6)
    assert halved(environment(np.ones((5, 10, 3), np.float32))) is None


def test_references_are_the_exact_lobe_at_any_roughness(device: Device):
    env = environment(room(11))
    recipe = chain()
    r = np.array([0.0617, 0.2, 0.37, 0.5, 0.83, 1.0])
    reader = Reader(device, env, recipe, directions=48)
    convolver = Convolver(device, env)
    for k, x in enumerate(r):
        lobe = ndf_lobe(device, recipe.ndf, x, recipe.parameters(x))
        want = convolver.exact([(lobe, reader.d)], 32 if x < 0.1 else 8)[0] / convolver.scale
        got = reader.at_directions.at(r[k : k + 1])[0]
        # TOLERANCE of the sharpest, coarser texels and interpolation of the others; a read errs by .1 to 1.
        assert np.sqrt(((got / want - 1) ** 2).mean()) <= (2e-2 if x < 0.1 else 6e-3), x


@pytest.mark.parametrize("rotation", [0.0, 30.0])
def test_roughness_zero_is_the_texel(device: Device, rotation):
    pixels = np.random.default_rng(4).random((16, 32, 3), np.float32)
    index = np.array([0, 31, 77, 300, 511])
    for source in (pixels, np.random.default_rng(4).random((6, 8, 8, 3), np.float32)):
        env = environment(source, rotate=rotation)
        index = np.arange(0, source.size // 3, 7)
        centres = latlong_centres(16, 32, index) if source.ndim == 3 else cube_centres(8, index)
        turn = math.radians(rotation)  # about +Y, +X towards +Z
        c, s = math.cos(turn), math.sin(turn)
        world = np.stack([c * centres[0] - s * centres[2], centres[1], s * centres[0] + c * centres[2]])
        exact = reading.Exact(device, env, chain(size=16))
        assert (exact.radiance(world) == source.reshape(-1, 3)[index]).all()


# ------------------------------------------------------------------------------------------- as read


@pytest.mark.parametrize("radiance", [0.7, 0.0])
@pytest.mark.parametrize("fit", [None, "read"])
def test_a_constant_environment_reads_without_error(device: Device, fit, radiance):
    recipe = chain(size=64, levels=4, fit=fit)
    env = environment(np.full((32, 64, 3), radiance, np.float32))
    found = Reader(device, env, recipe, directions=32).as_read(recipe)
    for part, rms in found.rms.items():
        assert rms.max() <= 1e-6, part  # float32's rounding of .7, and weights that sum to 1 within 1e-12


def transform(degree: int, r: float) -> float:
    """t_l(r) = ∫ K P_l / ∫ K by scipy: Funk and Hecke's factor of a lobe for spherical harmonics of degree l."""
    lobe, legendre = ggx_lobe(r * r), np.polynomial.Legendre.basis(degree)

    def integral(f):  # over u = s^(1/4), where GGX's peak at s = α² is wide
        return quad(lambda u: float(lobe(u**4) * f(1 - u**4)) * 4 * u**3, 0, 1, limit=400, epsabs=1e-11, epsrel=1e-9)[0]

    return integral(legendre) / integral(lambda x: 1.0)


@pytest.mark.parametrize("degree", [1, 2, 5])
def test_between_levels_a_harmonic_errs_as_funk_and_hecke_say(device: Device, degree):
    if degree <= 2:  # at α = 1 the lobe is a cosine: 2/3 and 1/4
        assert transform(degree, 1.0) == pytest.approx({1: 2 / 3, 2: 1 / 4}[degree], rel=1e-9)
    legendre = np.polynomial.Legendre.basis(degree)
    env = environment(latlong(lambda d: 1 + 0.9 * legendre(d[1]), 256))
    recipe = chain()
    reader = Reader(device, env, recipe, directions=128)
    found = reader.as_read(recipe, texels=False)
    t = np.array([transform(degree, float(r)) for r in scored()])
    levels = np.array([1.0] + [transform(degree, r) for _, r in recipe.levels[1:]])
    read = hats(scored(), chain()) @ levels
    P = 0.9 * legendre(reader.d[1])
    want = np.sqrt((((read - t)[:, None] * P / (1 + t[:, None] * P)) ** 2).mean(1))
    rough = scored() > recipe.levels[1][1]  # below, the mirror is a texel and not the function in it
    # Texels as large as a third of the lobe leave 4e-3 of the harmonic's change over the lobe, l(l+1)α²/4 of it.
    assert found.rms["between"][rough] == pytest.approx(want[rough], rel=0.03, abs=4e-4)
    assert want[rough].max() > 0.01


def test_parts_and_their_whole(device: Device):
    env = environment(room(1))
    recipe = chain(size=64, min_size=8)
    reader = Reader(device, env, recipe, directions=96)
    ideal = reader.as_read(recipe)
    assert set(ideal.rms) == {"between", "texels", "format", "all"}
    # Levels that are exact in every texel, as an engine has them: what is stored is the same to rounding.
    levels = [reader.exact.means(64, np.arange(6 * 64**2)).reshape(6, 64, 64, 3).astype(np.float32)]
    for size, r in recipe.levels[1:]:
        shape = Shape(False, size)
        level = reader.exact.lobes([(reading.single(r), shape.directions())])[0]
        levels.append(level.reshape(6, size, size, 3).astype(np.float32))
    baked = reader.as_read(recipe, levels, [1e-3] * 4)
    assert baked.rms["levels"] == pytest.approx(np.full(len(scored()), 1e-3), rel=1e-12)
    for part in ("between", "texels", "all"):
        assert baked.rms[part] == pytest.approx(ideal.rms[part], rel=1e-4, abs=1e-6), part
    # Texels that are wrong by 10 % are read as wrong, wherever they are read from.
    worse = reader.as_read(recipe, [1.1 * level for level in levels])
    assert worse.mean("texels") == pytest.approx(0.1, rel=0.5)
    for name in FORMATS:
        kept = reader.as_read(recipe, levels, format=name)
        # Half a step: of 5 bits of mantissa 1/64; of 9 bits shared by the largest channel 1/512, grey here.
        bound = {"float32": 6e-8, "float16": 5e-4, "r11g11b10": 1 / 64, "rgb9e5": 1 / 512}[name]
        assert kept.rms["format"].max() <= 2 * bound, name  # where a direction is darker than a texel beside it
        assert name == "float32" or kept.rms["format"].min() > 0
    assert "over_roughness" in ideal.data() and json.dumps(ideal.data())


# ------------------------------------------------------------------------------------------- --fit read


@pytest.fixture(scope="session")
def glass(tmp_path_factory) -> str:
    """A user's NDF: GGX up to its norm."""
    path = tmp_path_factory.mktemp("ndf") / "glass.clh"
    path.write_text(GLASS)
    return str(path)


NODES = np.polynomial.legendre.leggauss(400)


def kernel(mixture, s: np.ndarray) -> np.ndarray:
    """∑ weight K_r(s)/∫K_r of GGX's lobes at s = 1 - cos θ, normalized by Gauss's rule in s^(1/4)."""
    x, w = NODES
    u = (x + 1) / 2
    total = np.zeros_like(s)
    for weight, r in mixture:
        lobe = ggx_lobe(r * r)
        total += weight * lobe(s) / (2 * math.pi * lobe(u**4) * 4 * u**3 * w / 2).sum()
    return total


@pytest.mark.parametrize("levels", [2, 3, 5, 8, 12])
def test_mixtures_sum_to_one_and_are_nowhere_negative(device: Device, levels):
    recipe = chain(size=2048, levels=levels, fit="read")
    first, *rest = read_mixtures(device, recipe)
    assert first is None
    theta = np.concatenate([[0.0], np.geomspace(1e-5, math.pi / 2 - 1e-6, 5000)])
    s = 2 * np.sin(theta / 2) ** 2
    for (_, own), mixture in zip(recipe.levels[1:], rest, strict=True):
        assert sum(w for w, _ in mixture) == pytest.approx(1, abs=1e-12)
        assert min(r for _, r in mixture) >= roughness_of_lod(SHARPEST, levels)  # no finer source grid than before
        total, lobe = (kernel(parts, s) for parts in (mixture, reading.single(own)))
        assert (total / lobe).min() >= LEAST / 3  # LEAST/2 at the fit's own angles


@pytest.mark.parametrize("ndf", ["beckmann", "phong", "abc:c=1.2", "gtr:gamma=1.5", "shifted_gamma:p=1.2", "charlie"])
def test_any_ndf_has_mixtures(device: Device, ndf):
    recipe = chain(ndf=ndf, fit="read")
    first, *rest = read_mixtures(device, recipe)
    assert first is None
    for mixture in rest:
        assert sum(w for w, _ in mixture) == pytest.approx(1, abs=1e-12)
        assert all(math.isfinite(w) and abs(w) < 5 for w, _ in mixture)


def test_a_users_ndf_gets_the_mixtures_of_the_same_built_in_one(device: Device, glass):
    # The user's lobes come from the device, the built-in ones from a float64 reference in another form.
    own, built_in = (read_mixtures(device, chain(ndf=ndf, fit="read")) for ndf in (glass, "ggx"))
    s = 2 * np.sin(np.linspace(0, 1.57, 200) / 2) ** 2
    for a, b in zip(own[1:], built_in[1:], strict=True):
        assert a is not None and b is not None
        # Sums of unlike signs, of D to 1e-15 or, on devices without float64, to 1e-6.
        assert kernel(a, s) == pytest.approx(kernel(b, s), rel=1e-4 if device.fp64 else 2e-2)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_fit_helps_in_rooms_it_has_not_seen(device: Device, seed):
    own = chain()
    fitted = replace(own, fit="read")
    reader = Reader(device, environment(room(seed)), own, fitted)
    before, after = (reader.as_read(recipe, texels=False) for recipe in (own, fitted))
    # .40 to .55 where a few bright things stand in the dark; .6 leaves room for other rooms.
    assert after.mean("between") <= 0.6 * before.mean("between")
    # What levels were exact at, r_k, pays for what lies between: nowhere more than the worst was.
    assert after.p95["between"].max() <= before.p95["between"].max()


@pytest.mark.long
def test_the_fit_halves_what_is_seen_of_a_studio(device: Device, environments: list[Path]):
    ratios = {}
    for path in environments:
        own = chain()
        fitted = replace(own, fit="read")
        reader = Reader(device, environment(path), own, fitted)
        before, after = (reader.as_read(recipe) for recipe in (own, fitted))
        ratios[path.stem] = after.mean() / before.mean()
    # No environment took part in the fit. The studio's panels are what it is for; a forest's leaves gain least (.59).
    assert all(ratio <= 0.7 for ratio in ratios.values()), ratios
    assert all(ratio <= 0.5 for name, ratio in ratios.items() if "studio" in name), ratios


# ------------------------------------------------------------------------------------------- --levels


def test_levels_and_sizes():
    assert [s for s, _ in chain().levels] == [256, 128, 64, 32, 16]
    assert [s for s, _ in chain(levels=7).levels] == [256, 128, 64, 32, 16, 8, 4]
    assert [s for s, _ in chain(levels=3).levels] == [256, 128, 64]
    assert [s for s, _ in chain(levels=7, min_size=16).levels] == [256, 128, 64, 32, 16, 16, 16]
    assert chain(size=1, levels=1).levels == ((1, 0.0),)
    assert chain(levels=9).levels[-1] == (1, 1.0)
    for recipe in (chain(levels=7), chain(levels=5), chain(fit="read"), chain(levels=7, min_size=16)):
        assert [r for _, r in recipe.levels] == recipe.canonical()["roughness"]
    assert chain(levels=5).canonical() == chain().canonical()  # the same bytes, the same key
    assert chain(fit="read").canonical() != chain().canonical()
    assert chain(levels=7, min_size=16).canonical() != chain(levels=7).canonical()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"levels": 10}, r"levels 10 is outside \[1, 9\]: from 256² each level halves"),
        ({"levels": 0}, r"levels 0 is not a whole number in \[1, 32\]"),
        ({"levels": 33, "min_size": 1}, r"levels 33 is not a whole number in \[1, 32\]"),
        ({"levels": 2.5}, r"levels 2\.5 is not a whole number"),
        ({"levels": 3, "min_size": 16}, r"levels 3 from 256² end at 64², not at min-size 16; .* at least 5 levels"),
        ({"levels": 3, "min_size": 512}, "min-size 512 is larger than size 256"),
        ({"fit": "raed"}, "unknown fit 'raed'; did you mean 'read'"),
    ],
)
def test_levels_and_fits_that_cannot_be_had(options, told):
    with pytest.raises(UsageError, match=told):
        chain(**options)


# ------------------------------------------------------------------------------------------- the command


def shell(capsys, *argv) -> tuple[int, list[dict], str]:
    capsys.readouterr()
    with pytest.raises(SystemExit) as done:
        main([str(a) for a in argv])
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    return done.value.code, [json.loads(line) for line in out.splitlines() if line.startswith("{")], out + err


@pytest.fixture
def image(tmp_path) -> Path:
    path = tmp_path / "room.exr"
    write_exr(path, room(2))
    return path


def test_a_plan_says_what_engines_would_show(capsys, tmp_path, image):
    bake = ("bake", image, "-o", tmp_path / "out", "--size", "32", "--min-size", "8", "--dry-run")
    code, rows, _ = shell(capsys, *bake, "--json")
    assert code == 0
    found = [row for row in rows if row["event"] == "as_read"]
    assert [(row["levels"], row["fit"]) for row in found] == [
        (3, None),
        (3, "read"),
        (5, None),
        (5, "read"),
        (6, None),
        (6, "read"),
    ]
    assert [row["sizes"] for row in found[::2]] == [[32, 16, 8], [32, 16, 8, 8, 8], [32, 16, 8, 8, 8, 8]]
    for row in found[:2]:
        assert row["format"] == "float32" and set(row["parts"]) == {"between", "texels", "format", "all"}
        assert len(row["over_roughness"]["roughness"]) == len(row["over_roughness"]["rms"]) == reading.SCORED
        for part in row["parts"].values():
            assert 0 <= part["mean"] and 0 <= part["p95"]
    between = [row["parts"]["between"]["mean"] for row in found]
    assert between[1] < between[0] and between[2] < between[0] and between[3] < between[2]
    code, _, text = shell(capsys, *bake)
    assert code == 0 and "as read from float32" in text and "own lobe" in text
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [("--as-read",), ("--fit", "read")])
def test_a_bake_states_what_engines_show(capsys, tmp_path, image, options):
    out = tmp_path / "out"
    code, rows, text = shell(capsys, "bake", image, "-o", out, "--size", "32", "--min-size", "8", "--json", *options)
    assert code == 0, text
    manifest = json.loads((out / "room.json").read_text())
    (found,) = manifest["as_read"]
    assert found["for"] == "raw"
    assert set(found["parts"]) == {"between", "texels", "levels", "format", "all"}
    assert found["parts"]["levels"]["mean"] <= 1e-3  # the levels' tolerance
    assert found["fit"] == (options[1] if len(options) == 2 else None)
    (row,) = [row for row in rows if row["event"] == "as_read"]
    assert row["parts"] == found["parts"]
    whole, between = found["parts"]["all"]["mean"], found["parts"]["between"]["mean"]
    # 32² to 8²: interpolation inside levels costs as much as between them, and the two do not add up by chance.
    assert whole <= between + sum(found["parts"][part]["mean"] for part in ("texels", "format")) + 1e-9
    if options == ("--fit", "read"):
        recipe = chain(size=32, min_size=8, fit="read")
        assert manifest["recipe"]["fit"] == "read" and recipe.fit == "read"


def test_a_bake_that_is_not_asked_does_not_measure(capsys, tmp_path, image):
    code, rows, _ = shell(capsys, "bake", image, "-o", tmp_path / "out", "--size", "32", "--min-size", "8", "--json")
    assert code == 0 and not [row for row in rows if row["event"] == "as_read"]
    assert "as_read" not in json.loads((tmp_path / "out" / "room.json").read_text())


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--levels", "12"), "levels 12 is outside [1, 9]"),
        (("--levels", "3", "--min-size", "16"), "not at min-size 16"),
        (("--fit", "write"), "unknown fit 'write'"),
    ],
)
def test_what_the_command_refuses(capsys, tmp_path, image, options, told):
    code, _, text = shell(capsys, "bake", image, "-o", tmp_path / "out", *options)
    assert code == 1 and told in text


def test_energy_of_a_cube_of_reads(device: Device):
    # A level fitted to reads has the mean of the environment: weights that sum to 1 keep energy, whatever they are.
    env = environment(room(7))
    recipe = chain(fit="read")
    exact = reading.Exact(device, env, recipe)
    shape = Shape(False, 16)
    for mixture in read_mixtures(device, recipe)[2:]:
        assert mixture is not None
        level = exact.lobes([(mixture, shape.directions())])[0].reshape(6, 16, 16, 3)
        mean = np.einsum("ij,fijc->c", cube_solid_angles(16), level) / (4 * math.pi)
        # Texel centres of 16² against the sphere, for lobes of α ≥ .09, two texels wide.
        assert mean == pytest.approx(np.array(env.statistics["mean"]), rel=2e-2)
