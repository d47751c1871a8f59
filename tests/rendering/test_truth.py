"""The truth beside an engine's picture: closed forms, another quadrature, and the integral by hand."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from whitefurnace import bake, integrate
from whitefurnace.catalogue.choice import chosen
from whitefurnace.cli import cli
from whitefurnace.errors import InputError, UsageError
from whitefurnace.files import read_image, read_stored, write_exr
from whitefurnace.opencl.device import Device
from whitefurnace.rendering import side_by_side as beside
from whitefurnace.rendering.side_by_side import Material, Spheres, in_frame
from whitefurnace.rendering.truth import LIGHTS, Points, Truth, albedo, blocks, cut, term
from whitefurnace.sphere.environments import environment
from whitefurnace.sphere.grids import source_directions, source_solid_angles

UP = np.array([[0.0], [0.0], [1.0]])


def points(count: int, seed: int = 1, least: float = 0.1) -> Points:
    """Normals anywhere and views above them, n·v from `least` to 1."""
    rng = np.random.default_rng(seed)
    n, other = (d / np.linalg.norm(d, axis=0) for d in rng.normal(size=(2, 3, count)))
    across = np.cross(n, other, axis=0)
    across /= np.linalg.norm(across, axis=0)
    c = rng.uniform(least, 1, count)
    return Points(n, c * n + np.sqrt(1 - c * c) * across)


def schlick(alpha: float, F0: tuple[float, ...] = (0.04, 1.0)):
    return term(ndf="ggx", fresnel="schlick", ndf_alpha=alpha, fresnel_f0=np.array(F0), fresnel_f90=1.0)


def ggx(l: np.ndarray, n: np.ndarray, v: np.ndarray, alpha: float, F0: float) -> np.ndarray:  # noqa: E741
    """f (n·l) of [Hoffman2012, "Microfacet BRDF"] by its textbook factors: D of [Walter2007, eq. 33], height-correlated
    G of [Heitz2014, eq. 99], Schlick's F. Directions (3, …)."""
    h = (l + v) / np.linalg.norm(l + v, axis=0)
    c_l, c_v, c_h, c_d = ((n * l).sum(0), (n * v).sum(0), (n * h).sum(0), (v * h).sum(0))
    D = alpha**2 / (math.pi * (c_h**2 * (alpha**2 - 1) + 1) ** 2)

    def Lambda(c: np.ndarray) -> np.ndarray:
        return (np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1) / 2

    up = c_l > 0
    c = np.where(up, c_l, 1)
    F = F0 + (1 - F0) * (1 - c_d) ** 5
    return np.where(up, D * F / (1 + Lambda(c) + Lambda(c_v)) / (4 * c_v), 0.0)


def noise(rows: int, lamps: int = 0, seed: int = 3):
    """A smooth sky with noise, and lamps."""
    rng = np.random.default_rng(seed)
    texels = rng.random((rows, 2 * rows, 3), np.float32) + np.linspace(2, 0.1, rows, dtype=np.float32)[:, None, None]
    row, column = rng.integers(0, rows, (2, lamps))
    texels[row, column] = 900
    return environment(texels)


# ------------------------------------------------------------------------------------------------- samples


@pytest.mark.parametrize(
    ("ndf", "roughness"),
    [("ggx", 0.2), ("ggx", 0.5), ("ggx", 1.0), ("beckmann", 0.5), ("gtr:gamma=1.5", 0.6), (None, 0.0)],
)
def test_the_samples_weigh_what_the_albedo_is(device: Device, ndf, roughness):
    """The white furnace of the sampling itself, before the albedo takes its place: against quadrature. 16 384 lattice
    points leave 1e-3 where n·v is .1 and normals, not those that v sees, are drawn."""
    found = (
        term(diffuse="burley:albedo=.8,roughness=.4")
        if ndf is None
        else term(ndf=ndf, roughness=roughness, fresnel="schlick", fresnel_f0=np.array([0.0, 1.0]), fresnel_f90=1.0)
    )
    truth, some = Truth(device, environment(np.ones((4, 8, 3), np.float32))), points(64)
    _, weights = truth.sums(found, some, 1 << 14, truth.rest)
    own = {name: v for name, v in found.parameters.items()}
    want = integrate("albedo", **found.models, NoV=some.NoV[:, None], device=device, **own).values
    assert np.abs(weights - want.reshape(weights.shape)).max() < 1.5e-3


@pytest.mark.parametrize("ndf", ["ggx", "beckmann"])
def test_samples_read_as_much_as_they_stand_for(device: Device, ndf: str, monkeypatch):
    """64 samples of fields of light err least from the level of Ω = 1/(N pdf): two levels finer they miss what lies
    between them, two coarser they blur what the lobe tells apart: 1.7 to 4 times as much was measured. Of 65 536
    samples none is NaN."""
    fields = np.where((np.arange(512) // 64 + np.arange(256)[:, None] // 64) % 2, 1.0, 0.2).astype(np.float32)
    truth, some = Truth(device, environment(fields)), points(200, seed=2, least=0.3)
    found, drawn = term(ndf=ndf, ndf_alpha=0.3, fresnel="one"), truth._samples

    def error(higher: float) -> float:
        def moved(*given):
            how, table = drawn(*given)
            return how, table + np.array([0, 0, 0, higher])

        monkeypatch.setattr(truth, "_samples", moved)
        sums, weights = truth.sums(found, some, 64, truth.rest)
        return float(np.sqrt(np.mean((sums / weights[..., None] - want) ** 2)))

    sums, weights = truth.sums(found, some, 1 << 16, truth.rest)
    want = sums / weights[..., None]
    assert error(0) < 0.75 * min(error(-2), error(2)), (error(-2), error(0), error(2))


def test_constant_light_gives_the_albedo(device: Device):
    some = points(32)
    got, E = Truth(device, environment(np.full((4, 8, 3), 0.7, np.float32))).reflected(schlick(0.3), some, 256)
    want = integrate(
        "albedo",
        ndf="ggx",
        fresnel="schlick",
        alpha=0.3,
        f0=np.array([0.04, 1.0]),
        f90=1.0,
        NoV=some.NoV[:, None],
        device=device,
    ).values
    assert np.abs(got - 0.7 * want[..., None]).max() < 2e-6  # the albedos' own tolerance
    assert np.abs(E - want).max() < 2e-6


@pytest.mark.few(2)
@pytest.mark.parametrize("alpha", [0.1, 0.4, 1.0])
def test_the_integral_by_hand(device: Device, alpha: float):
    """Of 32 × 64 texels, a third of them bright, against a sum over 1 024 × 2 048 directions in float64; lights are a
    part of it, samples the other."""
    env = noise(32, lamps=4)
    truth, some = Truth(device, env), points(6, seed=5)
    assert 0 < (truth.excess.any(-1)).sum() <= LIGHTS
    cuts = 32
    inside = (np.arange(32 * cuts) + 0.5) / cuts
    theta, phi = inside * math.pi / 32, (np.arange(64 * cuts) + 0.5) / cuts * 2 * math.pi / 64 - math.pi
    texels = env.texels.astype(np.float64)
    want = np.zeros((6, 2, 3))
    area = math.pi / (32 * cuts) * 2 * math.pi / (64 * cuts)
    for i, t in enumerate(theta):
        d = np.stack([math.sin(t) * np.cos(phi), np.full(phi.shape, math.cos(t)), math.sin(t) * np.sin(phi)])
        L = np.repeat(texels[i // cuts], cuts, 0) * (math.sin(t) * area)
        for k in range(6):
            for s, F0 in enumerate((0.04, 1.0)):
                want[k, s] += ggx(d, some.n[:, k : k + 1], some.v[:, k : k + 1], alpha, F0) @ L
    got, _ = truth.reflected(schlick(alpha), some, 1 << 14)
    # Texels of 5.6° are edges for the samples: half a percent where the lobe is as narrow as one.
    assert np.abs(got / want - 1).max() < 6e-3, (got, want)


def test_one_texel_is_a_light(device: Device):
    """Rows of lanes, frames and numbers: each variant and channel of single directions by the textbook formula."""
    truth, some = Truth(device, environment(np.ones((4, 8, 3), np.float32))), points(40, least=0.02)
    rng = np.random.default_rng(2)
    d = rng.normal(size=(3, 50))
    lights = np.concatenate([(d / np.linalg.norm(d, axis=0)).T, rng.random((50, 3))], 1)
    got = truth.gathered(schlick(0.15), some, lights)
    for s, F0 in enumerate((0.04, 1.0)):
        f = ggx(lights[:, :3].T[:, None], some.n[:, :, None], some.v[:, :, None], 0.15, F0)
        assert np.abs(got[:, s] - f @ lights[:, 3:]).max() <= 2e-5 * np.abs(got[:, s]).max()  # float32 of 50 terms


@pytest.mark.parametrize("cube", [False, True])
def test_lights_hold_what_the_image_held_above_the_bound(device: Device, cube: bool):
    env = noise(48, lamps=400)
    if cube:
        texels = np.random.default_rng(2).random((6, 32, 32, 3), np.float32)
        texels[texels > 0.9] = 50
        env = environment(texels, rotate=25.0)
    truth = Truth(device, env)
    power = (truth.excess * source_solid_angles(env)[..., None]).reshape(-1, 3)
    for lights in (blocks(env, truth.excess, 0.0), blocks(env, truth.excess, 0.3), cut(env, truth.excess, 3)):
        assert np.allclose(lights[:, 3:].sum(0), power.sum(0))
        assert np.allclose(np.linalg.norm(lights[:, :3], axis=1), 1)
        index = np.arange(env.texels[..., 0].size)
        moment = source_directions(env, index) @ power
        # Together they point where the texels did: each is moved by less than its own square, .3 rad.
        assert np.abs(lights[:, :3].T @ lights[:, 3:] - moment).max() < 0.02 * np.abs(power.sum(0)).max()
    assert len(blocks(env, truth.excess, 0.3)) < len(blocks(env, truth.excess, 0.0)) / 3


def test_a_mirror_shows_the_image(device: Device):
    """Every texel's centre, seen where it is reflected; F = 1."""
    env = environment(np.random.default_rng(1).random((16, 32, 3), np.float32), rotate=40.0)
    d = source_directions(env, np.arange(512))
    some = points(512)
    n = d + some.v
    n /= np.linalg.norm(n, axis=0)
    truth = Truth(device, env)
    smooth = term(ndf="ggx", roughness=0.0, fresnel="one")
    got, E = truth.reflected(smooth, Points(n, some.v), 64)
    assert (E == 1).all() and np.array_equal(got[:, 0], env.texels.reshape(-1, 3).astype(np.float64))
    # Nearly smooth it is almost the same: bilinear reads of means over half a texel.
    even = environment(np.repeat(np.repeat(env.texels[:4, :8], 4, 0), 4, 1), rotate=40.0)
    near = Truth(device, even).reflected(term(ndf="ggx", roughness=0.03, fresnel="one"), Points(n, some.v), 64)[0]
    inner = np.isin(np.arange(512) // 32 % 4, (1, 2)) & np.isin(np.arange(512) % 4, (1, 2)) & (np.abs(d[1]) < 0.9)
    assert np.abs(near[:, 0] - even.texels.reshape(-1, 3))[inner].max() < 0.02


def test_quadrature_agrees_at_points_of_a_lit_room(device: Device):
    """The certificate: another method (`radiance.py`) on a small image with lamps, within the tolerance asked for."""
    truth, some = Truth(device, noise(64, lamps=12, seed=8)), points(200, seed=11)
    for roughness in (0.25, 0.7):
        found = term(
            ndf="ggx", roughness=roughness, fresnel="schlick", fresnel_f0=np.array([0.04, 1.0]), fresnel_f90=1.0
        )
        count, estimate = truth.samples(found, some, 1e-2)
        assert estimate <= 1e-2
        got, _ = truth.reflected(found, some, count)
        for k in (3, 77):
            want = truth.exact(found, k % 2, some, k)
            assert np.abs(got[k, k % 2] / want - 1).max() < 1e-2, (roughness, k)


@pytest.mark.long
def test_quadrature_agrees_in_real_environments(device: Device, environments):
    for path in environments:
        truth, some = Truth(device, environment(path)), points(400, seed=4)
        for roughness in (1 / 6, 0.5, 1.0):
            found = term(
                ndf="ggx", roughness=roughness, fresnel="schlick", fresnel_f0=np.array([0.04, 1.0]), fresnel_f90=1.0
            )
            count, estimate = truth.samples(found, some, 1e-2)
            assert estimate <= 1e-2, (path, roughness)
            got, _ = truth.reflected(found, some, count)
            errors = [np.abs(got[k, k % 2] / truth.exact(found, k % 2, some, k) - 1).max() for k in (0, 133, 266)]
            # Twice the tolerance: that is of the 99th percentile of what differs from four times as many samples.
            assert max(errors) < 2e-2, (path, roughness, errors)


# ------------------------------------------------------------------------------------------------- lights


def test_punctual_light_in_closed_form(device: Device):
    """π f(l, v) c (n·l), [Hoffman2012, "Punctual Light Reflection Equation"], from the frame of the viewer."""
    n = points(64, seed=9).n
    n[2] = np.abs(n[2]) + 0.05
    some = Points(n / np.linalg.norm(n, axis=0), np.broadcast_to(UP, n.shape))
    black = Truth(device, environment(np.zeros((4, 8, 3), np.float32)))
    lit = Spheres(black, Material(), some, ["punctual:NoL=.6,phi_l=2,color=1/2/3"])
    to = np.array([0.8 * math.cos(2), 0.8 * math.sin(2), 0.6])[:, None]
    for s, F0 in enumerate((0.04, 1.0)):
        want = math.pi * ggx(to, some.n, some.v, 0.16, F0)[:, None] * [1, 2, 3]
        assert np.abs(lit.lit(schlick(0.16))[:, s] - want).max() < 1e-5 * want.max()
    want = np.maximum((to * some.n).sum(0), 0)[:, None] * [1, 2, 3]
    assert np.allclose(lit.diffuse_lit((1.0, 1.0, 1.0)), want, atol=1e-6)


def test_a_far_disc_is_punctual(device: Device):
    """Of radius ε at a distance far over it: c = L ε²/d² from its centre; the sphere's own place counts."""
    some = Points(np.array([[0.0, 0.6], [0.0, 0.0], [1.0, 0.8]]), np.broadcast_to(UP, (3, 2)))
    black = Truth(device, environment(np.zeros((4, 8, 3), np.float32)))
    lit = Spheres(
        black,
        Material(),
        some,
        ["disc:center_x=0,center_y=3,center_z=4,normal_x=0,normal_y=-3,normal_z=-4,radius=.01,radiance=1e4"],
    ).lit(schlick(0.5))
    to = np.array([[0.0], [3.0], [4.0]]) - some.n
    far = np.linalg.norm(to, axis=0)
    to = to / far
    slant = (to * np.array([[0.0], [0.6], [0.8]])).sum(0)
    want = math.pi * 1e4 * 1e-4 / far**2 * slant * ggx(to, some.n, some.v, 0.5, 1.0)
    assert np.abs(lit[:, 1, 0] / want - 1).max() < 1e-3  # (ε/d)² = 1e-5 and the outline's tolerance


def test_a_light_says_what_it_lacks():
    with pytest.raises(UsageError, match="disc needs"):
        in_frame(chosen("light", "disc"), {"radius": 1.0}, Points(UP, UP))


# ------------------------------------------------------------------------------------------------- pictures


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """A white sky and a noise, baked for Filament; the folder, their images beside it."""
    folder = tmp_path_factory.mktemp("beside")
    write_exr(folder / "white.exr", np.ones((16, 32, 3), np.float32))
    write_exr(folder / "noise.exr", noise(16).texels)
    bake([folder / "white.exr", folder / "noise.exr"], folder, for_="filament,raw", size=32, rotate=30.0)
    return folder


def shown(folder, *options: str) -> dict:
    done = CliRunner().invoke(cli, ["render", *options, "--force", "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout.splitlines()[-1])


def layers(path) -> dict[str, np.ndarray]:
    image = read_stored(path)
    return dict(zip(("difference", "engine", "truth"), np.split(image, 3, axis=2), strict=True))


def test_white_spheres_in_truth(baked, device: Device):
    """Under a white sky a white dielectric is white; a metal is its albedo, and 1 where it scatters again."""
    from whitefurnace.rendering import shading

    index, cover, n = shading.sphere(32)
    for again in (False, True):
        row = shown(
            baked,
            str(baked / "white.json"),
            "--for",
            "filament",
            "-o",
            str(baked / "w.exr"),
            "--truth",
            str(baked / "white.exr"),
            "--size",
            "32",
            "--columns",
            "3",
            "--rows",
            "2",
            "--certify",
            "2",
            *(["--multiscatter"] if again else []),
        )
        got = layers(baked / "w.exr")["truth"].reshape(2, 32, 3, 32, 3).swapaxes(1, 2).reshape(2, 3, -1, 3)
        got = got[:, :, index[cover == 1]]
        NoV = n[2, cover == 1]
        assert np.abs(got[1, 0] - 1).max() < 1e-6
        if not again:
            assert np.abs(got[0] - 1).max() < 2e-5  # irradiance's tolerance
        for j, r in ((1, 0.5), (2, 1.0)):
            E = 1.0 if again else np.asarray(integrate("albedo", ndf="ggx", alpha=r * r, NoV=NoV).values)[:, None]
            assert np.abs(got[1, j] - E).max() < 2e-5
        assert row["error"] < 1e-4 and len(row["certificate"]) == 4  # the smooth column needs none


def test_the_difference_is_what_it_says(baked):
    common = [
        str(baked / "noise.json"),
        "--for",
        "filament",
        "--truth",
        str(baked / "noise.exr"),
        "--size",
        "24",
        "--columns",
        "2",
        "--rows",
        "2",
        "--certify",
        "0",
        "--background",
        "plain",
    ]
    row = shown(baked, *common, "-o", str(baked / "n.exr"))
    first = (baked / "n.exr").read_bytes()
    got = layers(baked / "n.exr")
    luminance = got["truth"] @ np.array([0.2126, 0.7152, 0.0722])
    inside = np.abs(got["difference"]).sum(-1) > 0
    want = (got["engine"] - got["truth"]) / luminance[..., None]
    centre = np.zeros(inside.shape, bool)
    for i in (12, 36):
        for j in (12, 36):
            centre[i - 6 : i + 6, j - 6 : j + 6] = True
    assert inside[centre].all() and not inside[0].any()
    assert np.abs(want - got["difference"])[centre].max() < 1e-5
    assert row["error"] is None and row["certificate"] == [] and row["samples"][0] == 0 and 0 < row["median"] < 1
    shown(baked, *common, "-o", str(baked / "n.exr"))
    assert (baked / "n.exr").read_bytes() == first
    # The engine's layer is the picture that is drawn without the truth.
    CliRunner().invoke(
        cli,
        ["render", *common[:3], "-o", str(baked / "alone.png"), *common[5:11], "--background", "plain", "--force"],
        catch_exceptions=False,
    )
    from whitefurnace.rendering.shading import srgb

    alone = read_image(baked / "alone.png").pixels
    assert np.abs(srgb(alone[..., :3]) - srgb(got["engine"])).max() < 0.6 / 255 + 1e-3


def test_three_panels_with_a_scale(baked):
    pytest.importorskip("matplotlib")
    row = shown(
        baked,
        str(baked / "noise.json"),
        "--for",
        "raw",
        "-o",
        str(baked / "p.png"),
        "--truth",
        str(baked / "noise.exr"),
        "--size",
        "64",
        "--columns",
        "3",
        "--rows",
        "1",
        "--certify",
        "1",
        "--light",
        "punctual:NoL=.7,color=1",
        "--diffuse",
        "oren_nayar:sigma=.4",
        "--metal",
        "schlick:gold",
        "--dielectric",
        "dielectric:ior=1.5",
    )
    pixels = read_image(baked / "p.png").pixels
    assert pixels.shape[0] > 3 * 64 and pixels.shape[1] >= 3 * 64
    assert row["scale"] in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
    assert any("both pictures" in notice for notice in row["notices"])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--truth", "white.exr"], "is not the image that"),
        (["--tolerance", ".1"], "give the image of the bake"),
        (["--truth", "noise.exr", "--tolerance", "2"], "outside"),
        (["--truth", "noise.exr", "--certify", "-1"], "outside"),
        (["--truth", "noise.exr", "--light", "spot"], "unknown light"),
        (["--truth", "none.exr"], "none.exr"),
        (["--truth", "noise.exr", "--ndf", "ggx_anisotropic:alpha_x=.1,alpha_y=.2"], "anisotropic"),
        (["--truth", "noise.exr", "-o", "x.jpg"], "not the name of a picture"),
    ],
)
def test_what_is_refused_is_said(baked, options, said, monkeypatch):
    monkeypatch.chdir(baked)
    command = ["render", "noise.json", "--for", "raw", *([] if "-o" in options else ["-o", "r.exr"]), *options]
    from whitefurnace.errors import WhitefurnaceError

    with pytest.raises(WhitefurnaceError, match=said):
        CliRunner().invoke(cli, command, catch_exceptions=False, standalone_mode=False)


def test_another_image_is_refused(baked, device: Device):
    with pytest.raises(InputError, match="sha256"):
        beside.source_of(baked / "noise.json", baked / "white.exr", device)
    # As it was baked: turned by 30°.
    found = beside.source_of(baked / "noise.json", baked / "noise.exr", device)
    assert math.degrees(found.rotation) == pytest.approx(30)


def test_albedo_of_many_points_is_each_ones_own(device: Device):
    some = points(50)
    E = albedo(schlick(0.3), some.NoV[::-1], device)[::-1]
    assert np.array_equal(E, albedo(schlick(0.3), some.NoV, device))
