"""The error budget of a scene: against closed forms, other quadratures and the files of a real bake."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from scenes import document
from whitefurnace import integrate
from whitefurnace.advice.budget import ErrorMeter, choose, of_image, sample_points, usual
from whitefurnace.advice.reference import ACCURACY
from whitefurnace.baking import bake as baking
from whitefurnace.baking.request import BakeRequest
from whitefurnace.catalogue import model
from whitefurnace.cli import main
from whitefurnace.engines.presets import ENGINES, reduced
from whitefurnace.errors import InputError, UnsupportedError, UsageError
from whitefurnace.files import write_exr
from whitefurnace.prefiltering.certificate import texel_errors
from whitefurnace.prefiltering.reading import Exact, single
from whitefurnace.prefiltering.recipe import chain
from whitefurnace.rendering import shading
from whitefurnace.scenes.materials import Scene, read_scene
from whitefurnace.sphere.environments import Environment, environment
from whitefurnace.sphere.grids import radiance_at, source_directions

pytest.importorskip("pygltflib")

COUNT = 96


def scene_of(folder: Path, *materials: Mapping[str, Any], images: list[np.ndarray] | tuple[()] = ()) -> Scene:
    path = folder / "scene.gltf"
    path.write_text(json.dumps(document([dict(m) for m in materials], images)))
    return read_scene(path)


def plain(color: tuple[float, float, float], metal: float, roughness: float, **extensions: Any) -> dict[str, Any]:
    return {
        "pbrMetallicRoughness": {"baseColorFactor": [*color, 1], "metallicFactor": metal, "roughnessFactor": roughness},
        "extensions": {f"KHR_materials_{name}": value for name, value in extensions.items()},
    }


WHITE = (1.0, 1.0, 1.0)
MIXED = (plain((0.8, 0.5, 0.2), 1, 0.3), plain((0.2, 0.3, 0.6), 0, 0.6), plain((0.7, 0.7, 0.7), 0.5, 0.9))


def lobed() -> Environment:
    """A dim sky with three lights of different colours and widths."""
    rng = np.random.default_rng(5)
    texels = np.full((64, 128, 3), 0.2, np.float32)
    d = directions(texels)
    for sharp in (300.0, 30.0, 4.0):
        axis = rng.normal(size=3)
        texels += (
            np.exp(sharp * (d @ (axis / np.linalg.norm(axis)) - 1))[..., None]
            * rng.uniform(0.2, 1, 3)
            * math.sqrt(sharp)
        ).astype(np.float32)
    return environment(texels)


def directions(texels: np.ndarray) -> np.ndarray:
    """(h, w, 3) of a lat-long's texels."""
    env = environment(texels)
    return source_directions(env, np.arange(texels.size // 3)).T.reshape(texels.shape)


# ------------------------------------------------------------------------------------------------- closed forms


@pytest.mark.long
def test_constant_light_leaves_only_the_model(device, tmp_path):
    """Every mean of constant light is that light: what the files and the split sum add is rounding. b10g11r11 and half
    floats hold 1 exactly; float32 sums of some 10⁴ terms keep 1e-5."""
    meter = ErrorMeter(
        scene_of(tmp_path, *MIXED),
        environment(np.ones((16, 32, 3), np.float32)),
        ENGINES["filament"],
        device,
        count=COUNT,
    )
    found = meter.budget(chain(size=32, min_size=8))
    for name in ("texels", "roughness", "format", "diffuse", "n = v = r", "F·G from L", "split sum"):
        assert found[name].rms < 2e-5, (name, found[name])
    assert found["filter"].rms < 2e-3 and found["table"].rms < 1e-3
    # What is left is the model.
    assert found.whole.rms == pytest.approx(found.floor.rms, rel=0.05)
    assert found["single scattering"].rms > 0.01


@pytest.mark.long
def test_a_mirror_has_texels_alone(device, tmp_path):
    env = lobed()
    meter = ErrorMeter(scene_of(tmp_path, plain(WHITE, 1, 0)), env, ENGINES["raw"], device, count=COUNT)
    found = meter.budget(chain(size=64))
    for name in ("diffuse", "roughness", "format", "n = v = r", "F·G from L", "split sum", "Fresnel", "energy"):
        assert found[name].rms < 1e-6, (name, found[name])
    # F = 1 for white metal
    p = meter.points
    mirror = 2 * (p.n * p.v).sum(0) * p.n - p.v
    sought = radiance_at(env, mirror)
    assert np.allclose(meter.right, sought, rtol=1e-6)
    assert 0 < found["texels"].rms == pytest.approx(found.files.rms, rel=1e-3)


def test_a_rough_metal_in_linear_light(device, tmp_path):
    """L = 1 + a·d. GGX of α = 1 has D = 1/π, and Smith's V is 1/(2 (n·l + n·v)): means of l over the lobe are
    (2/3) n with n = v, and k(n·v) n with masking, k(c) = (½ - c + c² q)/(1 - c q), q = ln((1 + c)/c); the albedo is
    1 - c q. Texels of 1.4° hold a linear function within 2e-4, sums are within ACCURACY (p99)."""
    a = np.array([[0.5, 0.2, -0.4], [0.1, -0.6, 0.3], [-0.3, 0.3, 0.5]])  # a row a channel
    texels = np.zeros((128, 256, 3), np.float32)
    texels[:] = 1 + directions(texels) @ a.T
    meter = ErrorMeter(scene_of(tmp_path, plain(WHITE, 1, 1)), environment(texels), ENGINES["raw"], device, count=COUNT)
    p = meter.points
    c = p.NoV
    q = np.log((1 + c) / c)
    mirror = 2 * (p.n * p.v).sum(0) * p.n - p.v
    levels, own_view = 1 + 2 / 3 * (a @ mirror).T, 1 + 2 / 3 * (a @ p.n).T
    E = (1 - c * q)[:, None]
    seen = 1 + ((0.5 - c + c * c * q) / (1 - c * q))[:, None] * (a @ p.n).T
    for got, want in ((meter.reads.prefiltered, levels), (meter.integrals.own_view, own_view), (meter.right, seen)):
        assert np.quantile(np.abs(got / want - 1), 0.95) < ACCURACY, np.abs(got / want - 1).max()
    assert np.allclose(meter.integrals.exact_table[0] + meter.integrals.exact_table[1], E[:, 0], atol=2e-5)
    # raw gives nothing back: the split sum weighs by E, what is right has the mean itself
    for name, difference in (
        ("n = v = r", E * (levels - own_view)),
        ("F·G from L", E * (own_view - seen)),
        ("split sum", E * (levels - seen)),
        ("energy", (E - 1) * seen),
    ):
        off = texel_errors(seen + difference, seen, float(seen.mean()))
        got = next(e for e in (*meter.split, *meter.model) if e.name == name)
        assert got.rms == pytest.approx(float(np.sqrt((off * off).mean())), rel=0.01), name
        assert got.p95 == pytest.approx(float(np.quantile(off, 0.95)), rel=0.02), name


def test_a_mixed_material_in_linear_light(device, tmp_path):
    """Metalness m mixes F0, here of α = 1: the mean of l weighed by F(v·h) (n·l)/(n·l + n·v), by nodes of Gauss in n·l
    and equal ones in azimuth; across n it lies along v. What is right is the engine's own here, and only divides."""
    a, metal, color = np.array([0.5, -0.4, 0.3]), 0.25, np.array([0.9, 0.5, 0.1])
    texels = np.zeros((128, 256, 3), np.float32)
    texels[:] = (1 + directions(texels) @ a)[..., None]
    scene = scene_of(tmp_path, plain((0.9, 0.5, 0.1), metal, 1))
    meter = ErrorMeter(scene, environment(texels), ENGINES["raw"], device, count=48)
    p = meter.points
    c = p.NoV[:, None, None]
    x, w = np.polynomial.legendre.leggauss(96)
    mu, w = ((x + 1) / 2)[:, None], (w / 2)[:, None]
    phi = (np.arange(96) + 0.5) / 96 * math.pi
    across = np.sqrt(1 - mu * mu) * np.cos(phi)
    VoH = np.sqrt((1 + c * mu + np.sqrt(1 - c * c) * across) / 2)
    F0 = (0.04 * (1 - metal) + color * metal)[:, None, None, None]
    weight = w * mu / (mu + c) * model("fresnel", "schlick").reference["F"](VoH, F0, 1) / len(phi)
    E = weight.sum((2, 3)).T
    along = (p.v - p.NoV * p.n) / np.sqrt(1 - p.NoV**2)
    up, aside = (np.asarray((weight * part).sum((2, 3)).T) / E for part in (mu, across))
    seen = 1 + up * (a @ p.n)[:, None] + aside * (a @ along)[:, None]
    own_view = (1 + 2 / 3 * (a @ p.n))[:, None]
    off = texel_errors(meter.right + E * (own_view - seen), meter.right, float(meter.right.mean()))
    assert meter.split[1].name == "F·G from L"
    assert meter.split[1].rms == pytest.approx(float(np.sqrt((off * off).mean())), rel=0.01)


def test_fresnel_against_a_quadrature(device, tmp_path):
    """A black insulator of α = 1 in constant light shows its albedo: ∫ F(v·h) (n·l)/(2π (n·l + n·v)) dω, by nodes of
    Gauss in n·l and equal ones in azimuth, with the catalogue's float64 Fresnel terms."""
    ior = 2.2
    meter = ErrorMeter(
        scene_of(tmp_path, plain((0, 0, 0), 0, 1, ior={"ior": ior})),
        environment(np.ones((16, 32, 3), np.float32)),
        ENGINES["filament"],
        device,
        count=48,
    )
    x, w = np.polynomial.legendre.leggauss(96)
    mu, w = (x + 1) / 2, w / 2
    phi = (np.arange(96) + 0.5) / 96 * math.pi
    c = meter.points.NoV[:, None, None]
    cosine = c * mu[:, None] + np.sqrt((1 - c * c) * (1 - mu[:, None] ** 2)) * np.cos(phi)
    VoH = np.sqrt((1 + cosine) / 2)
    weight = (w * mu)[:, None] / (mu[:, None] + c) / len(phi)
    f0 = ((ior - 1) / (ior + 1)) ** 2
    one = weight.sum((1, 2)) * len(phi)
    exact, schlick = (
        (weight * F).sum((1, 2)) * (1 + f0 * (1 / one - 1))
        for F in (
            model("fresnel", "dielectric").reference["F"](VoH, ior),
            model("fresnel", "schlick").reference["F"](VoH, f0, 1),
        )
    )
    assert np.allclose(meter.right, exact[:, None], rtol=1e-4)
    off = texel_errors(np.repeat(schlick[:, None], 3, 1), np.repeat(exact[:, None], 3, 1), float(exact.mean()))
    assert meter.model[1].rms == pytest.approx(float(np.sqrt((off * off).mean())), rel=2e-3)
    assert meter.model[1].rms > 0.02


def test_other_ways_in_constant_light(device, tmp_path):
    """White metal of α = 1 shows 1; without masking its albedo is ∫ (n·l)/(4π) dω = ¼ in place of 1 - c q. Oren and
    Nayar's diffuse, put together of two albedos, is what the quadrature of this very colour gives."""
    env = environment(np.ones((16, 32, 3), np.float32))
    rough = ErrorMeter(scene_of(tmp_path, plain(WHITE, 1, 1)), env, ENGINES["raw"], device, count=48)
    c = rough.points.NoV
    once = 1 - c * np.log((1 + c) / c)
    assert np.allclose(rough.right, 1, rtol=1e-5)
    assert np.allclose(rough.integrals.masked("implicit"), (0.25 - once)[:, None], atol=1e-4)
    assert np.allclose(rough.integrals.reference(again=False), once[:, None], atol=1e-4)
    assert not rough.integrals.grooved().any()  # metal has no diffuse
    color, r = (0.8, 0.5, 0.2), 0.7
    matte = ErrorMeter(scene_of(tmp_path, plain(color, 0, r)), env, ENGINES["raw"], device, count=48)
    want = integrate(
        "albedo",
        diffuse="oren_nayar",
        NoV=matte.points.NoV[:, None],
        albedo=np.array(color),
        sigma=math.atan(r * r / math.sqrt(2)),
    ).values - np.array(color)
    rest = 1 - matte.integrals.reflected(matte.sampled.f0)[1]
    assert np.allclose(matte.integrals.grooved(), rest * want, atol=2e-4)


@pytest.mark.parametrize("masking", ["ashikhmin", "estevez_kulla"])
def test_the_split_sum_of_a_sheen_is_exact_in_constant_light(device, tmp_path, masking):
    """Every lobe's mean of constant light is that light, whatever the masking; in other light it is not."""
    cloth = plain(WHITE, 0, 0.8, sheen={"sheenColorFactor": [1, 1, 1], "sheenRoughnessFactor": 0.6})
    scene, off = scene_of(tmp_path, cloth), {}
    for name, env in (("constant", environment(np.ones((16, 32, 3), np.float32))), ("lobed", lobed())):
        found = ErrorMeter(scene, env, ENGINES["filament"], device, count=24).integrals.sheen(masking)
        off[name] = 0.0 if found is None else float(np.abs(found).max())
    # Sums of float32 over 10⁴ terms.
    assert off["constant"] <= 1e-4 and off["lobed"] > 1e-2


def test_lobes_are_those_of_the_prefilter(meter, device):
    """By sums over all texels (`reading.Exact`), which share no code with the samples here."""
    exact = Exact(device, meter.env, usual(ENGINES["filament"]))
    for g in meter.integrals.groups:
        want = exact.lobes([(single(g.roughness), meter.reads.looked_up[:, g.index])])[0]
        assert np.quantile(texel_errors(meter.reads.prefiltered[g.index], want, exact.mean), 0.95) < ACCURACY


# ------------------------------------------------------------------------------------------------- the engine's picture


@pytest.mark.long
@pytest.mark.parametrize("name", ["filament", "three", "bevy", "raw", "babylon"])
def test_the_picture_is_that_of_the_files(name, device, tmp_path):
    """X is what `shading.shade` makes of the files that a bake wrote, whose axes differ: float32 sums apart."""
    env, engine = lobed(), ENGINES[name]
    write_exr(tmp_path / "sky.exr", env.texels)
    scene = scene_of(tmp_path, *MIXED, plain((0.1, 0.1, 0.1), 0, 0.2, ior={"ior": 2.0}))
    baking.bake(tmp_path / "sky.exr", tmp_path / "out", for_=name, size=32, device=device)
    lights = shading.read_lights(engine, tmp_path / "out" / name, "sky")
    meter = ErrorMeter(scene, environment(tmp_path / "sky.exr"), engine, device, count=COUNT)
    made = meter.budget(usual(engine, size=32))
    s = meter.sampled
    X = shading.shade(engine, lights, s.points.n, s.points.v, s.color, s.metal, s.roughness, s.f0)
    off = texel_errors(X, meter.right, float(meter.right.mean()))
    # another seed of the certificate may refine a level: 1e-3 is its tolerance
    assert made.whole.rms == pytest.approx(float(np.sqrt((off * off).mean())), rel=2e-3, abs=1e-5)
    assert made.whole.p95 == pytest.approx(float(np.quantile(off, 0.95)), rel=2e-3, abs=1e-5)


@pytest.mark.long  # of Filament: test_the_choice_is_within_and_no_dearer_when_looser
@pytest.mark.parametrize("name", ["filament", "three", "bevy", "raw", "babylon"])
def test_any_engine_has_a_choice(name, device, tmp_path):
    scene = scene_of(tmp_path, *MIXED, plain((0.1, 0.1, 0.1), 0, 0.2, ior={"ior": 2.0}))
    choice = choose(ErrorMeter(scene, lobed(), ENGINES[name], device, count=COUNT), 0.5, usual(ENGINES[name]))
    assert choice.met and choice.nbytes < choice.usual_nbytes


# ------------------------------------------------------------------------------------------------- causes


@pytest.fixture(scope="session")
def meter(device, tmp_path_factory) -> ErrorMeter:
    scene = scene_of(tmp_path_factory.mktemp("mixed"), *MIXED)
    return ErrorMeter(scene, lobed(), ENGINES["filament"], device, count=COUNT)


def test_a_worse_cause_has_a_larger_effect(meter):
    def of(part: str, **options: Any) -> float:
        form, size = options.pop("form", None), options.pop("table", None)
        engine = meter.engine if size is None else reduced(meter.engine, (), size)
        if form:
            engine = msgspec.structs.replace(
                engine,
                file=tuple(
                    msgspec.structs.replace(f, format=form) if f.holds == "specular" else f for f in engine.file
                ),
            )
        return meter.budget(chain(**{"size": 64, **options}), engine)[part].rms

    tables = [of("table", table=n) for n in (8, 32, 128)]
    levels = [of("roughness", levels=n) for n in (2, 3, 5)]
    sizes = [of("texels", size=n, levels=4) for n in (16, 32, 128)]
    formats = [of("format", form=form) for form in ("rgbd", "rgba16f", "rgba32f")]  # 8, 11 and 24 bits
    for found in (tables, levels, sizes, formats):
        assert all(a > 1.3 * b for a, b in itertools.pairwise(found)), found
    assert formats[-1] < 1e-12 and of("format", form="b10g11r11") > formats[1]
    assert of("roughness", levels=4, fit="read") < of("roughness", levels=4)


def test_the_filter_is_bounded_by_its_tolerance(meter):
    loose, strict = (meter.budget(chain(size=32, min_size=8, tolerance=t))["filter"] for t in (1e-2, 1e-3))
    assert strict.bound and strict.rms <= 1e-3 * 1.5 and loose.rms <= 1e-2 * 1.5  # specular over all is 1.5 at most


# ------------------------------------------------------------------------------------------------- the choice


def test_the_choice_is_within_and_no_dearer_when_looser(meter, tmp_path):
    made = [choose(meter, x, usual(ENGINES["filament"])) for x in (0.3, 0.1, 0.03)]
    for one in made:
        assert one.met and one.error <= one.tolerance, one
        own = dict(one.options)
        order = baking.plan(BakeRequest(["x.exr"], tmp_path, for_="filament", **own))  # they are options of bake
        assert order.chains[0].size == one.recipe.size and order.chains[0].levels == one.recipe.levels
    assert made[0].met and made[0].nbytes <= made[1].nbytes <= made[2].nbytes
    assert made[0].nbytes < made[0].usual_nbytes
    # the same files, measured as a budget: what the choice says of them
    again = meter.budget(made[0].recipe, made[0].engine)
    assert again.whole.rms == pytest.approx(made[0].whole, rel=0.02)
    # the split sum is nobody's choice
    assert "split sum" in {e.name for e in made[2].beyond}
    assert {e.name for e in made[0].beyond} <= {e.name for e in made[2].beyond}


def test_raw_may_have_harmonics(device, tmp_path):
    """Light of degree 1 is exactly in nine harmonics: they are cheaper than a cube."""
    texels = np.zeros((64, 128, 3), np.float32)
    texels[:] = (1 + directions(texels) @ [0.3, 0.5, 0.2])[..., None]
    meter = ErrorMeter(
        scene_of(tmp_path, plain((0.8, 0.8, 0.8), 0, 0.9)), environment(texels), ENGINES["raw"], device, count=COUNT
    )
    choice = choose(meter, 0.05, usual(ENGINES["raw"]))
    assert choice.met and choice.options["without"] == ["irradiance"]
    # of an engine without harmonics there is no such choice
    left = ErrorMeter(meter.scene, meter.env, ENGINES["raw"], device, without=["sh"], count=16)
    assert choose(left, 0.5, usual(ENGINES["raw"])).options["without"] == ["sh"]
    assert meter.budget(usual(ENGINES["raw"]))["diffuse by harmonics"].rms < 1e-3


def test_what_cannot_be_measured_is_said(device, meter, tmp_path):
    with pytest.raises(UsageError, match="outside"):
        choose(meter, 0.0, usual(ENGINES["filament"]))
    with pytest.raises(UnsupportedError, match="godot filters the image itself"):
        ErrorMeter(meter.scene, meter.env, ENGINES["godot"], device)
    with pytest.raises(InputError, match="only unlit materials"):
        sample_points(scene_of(tmp_path, {"extensions": {"KHR_materials_unlit": {}}}))


# ------------------------------------------------------------------------------------------------- points


def test_points_are_distributed_as_the_materials(tmp_path):
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, :2, 1], image[:, 2:, 1] = 51, 204  # a quarter at r = .2, the rest at .8
    image[:4, :, 2] = 255
    textured = {"pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}}
    found = sample_points(scene_of(tmp_path, textured, plain(WHITE, 0, 0.5), images=[image]), count=400)
    own = found.material == 0
    assert own.sum() == 200
    assert np.mean(found.roughness[own] < 0.5) == pytest.approx(0.25, abs=0.01)
    assert np.mean(found.metal[own] > 0.5) == pytest.approx(0.5, abs=0.01)
    # histograms have parts of 1/64
    assert set(np.round(found.roughness[own] / 0.6)) == {0.0, 1.0}
    assert np.abs(found.roughness[own] - np.where(found.roughness[own] < 0.5, 0.2, 0.8)).max() <= 1 / 64
    NoV = (found.points.n * found.points.v).sum(0)
    assert np.mean(NoV**2) == pytest.approx(0.5, abs=0.01)  # of density 2 n·v
    again = sample_points(scene_of(tmp_path, textured, plain(WHITE, 0, 0.5), images=[image]), count=400)
    assert np.array_equal(found.roughness, again.roughness) and np.array_equal(found.points.n, again.points.n)


# ------------------------------------------------------------------------------------------------- the command


def code(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return int(ended.value.code or 0)


def test_the_command_tells_and_bakes(device, tmp_path, capsys):
    scene_of(tmp_path, MIXED[2])
    env = lobed()
    write_exr(tmp_path / "sky.exr", env.texels)
    arguments = ["scene", str(tmp_path / "scene.gltf"), "--for", "filament", "--environment", str(tmp_path / "sky.exr")]
    assert code(*arguments, "--tolerance", ".2", "--json", "-o", str(tmp_path / "out")) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (whole,), (choice,) = ([row for row in rows if row["event"] == event] for event in ("budget", "choice"))
    named = {row["name"]: row for row in rows if row["event"] == "approximation"}
    assert (
        whole["largest"]
        == max((row for row in named.values() if row["used"] and not row["bound"]), key=lambda row: row["rms"])["name"]
    )
    assert choice["met"] and choice["error"] <= 0.2
    manifest = json.loads((tmp_path / "out" / "sky.json").read_text())
    assert manifest["levels"][0]["size"] == choice["options"].get("size", 256)
    assert code(*arguments) == 0
    text = capsys.readouterr().out
    assert f"largest: {whole['largest']}" in text and "masking implicit" in text
    assert code(*arguments, "--tolerance", ".1", "--job", str(tmp_path / "job.toml")) == 1
    assert of_image(read_scene(tmp_path / "scene.gltf"), str(tmp_path / "sky.exr"), ENGINES["filament"])[1] is None
