"""Spheres of a scene's materials: each is the sphere that the grid has of the same numbers, in the order of the file,
and what it leaves out of its material is said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from scenes import as_glb, document, written
from whitefurnace import bake
from whitefurnace.cli import cli
from whitefurnace.errors import InputError, UsageError
from whitefurnace.files import read_stored, write_exr
from whitefurnace.rendering import shading
from whitefurnace.rendering import side_by_side as beside
from whitefurnace.scenes import material_spheres

pytest.importorskip("pygltflib")

SIZE = 16
GOLD = (1.0, 0.78, 0.34)


@pytest.fixture(scope="module")
def baked(tmp_path_factory) -> Path:
    """A noise baked for two engines with their own ways of insulators, its image beside it."""
    folder = tmp_path_factory.mktemp("scene")
    texels = np.random.default_rng(3).random((16, 32, 3), np.float32) ** 3
    write_exr(folder / "noise.exr", texels)
    bake(folder / "noise.exr", folder, for_="filament,three", size=32)
    return folder


def plain(r: float, m: float, color=GOLD, **extensions) -> dict:
    made = {"pbrMetallicRoughness": {"baseColorFactor": [*color, 1], "metallicFactor": m, "roughnessFactor": r}}
    return (
        {**made, "extensions": {f"KHR_materials_{name}": value for name, value in extensions.items()}}
        if extensions
        else made
    )


def scene(path: Path, materials: list[dict], images=()) -> Path:
    return written(path, document([{"name": f"m{k}", **one} for k, one in enumerate(materials)], images))


def cells(picture: np.ndarray, columns: int) -> np.ndarray:
    """(spheres, SIZE, SIZE, 3) row by row."""
    rows = picture.shape[0] // SIZE
    return picture.reshape(rows, SIZE, columns, SIZE, 3).swapaxes(1, 2).reshape(-1, SIZE, SIZE, 3)


@pytest.mark.long
@pytest.mark.parametrize("engine", ["filament", "three"])
def test_a_sphere_is_that_of_the_grid(baked, tmp_path, engine):
    """A scene with the grid's own 3 × 2 materials is the grid, picture, truth and difference, to the bit; turned
    round, so are its spheres."""
    materials = [plain(r, m) for m in (0.0, 1.0) for r in (0.0, 0.5, 1.0)]
    common = {"for_": engine, "truth": baked / "noise.exr", "size": SIZE, "columns": 3, "background": "plain"}
    beside.render(baked / "noise.json", tmp_path / "grid.exr", rows=2, base_color=GOLD, **common)
    want = read_stored(tmp_path / "grid.exr")
    beside.render(baked / "noise.json", tmp_path / "a.exr", scene=scene(tmp_path / "a.gltf", materials), **common)
    assert np.array_equal(read_stored(tmp_path / "a.exr"), want)
    beside.render(baked / "noise.json", tmp_path / "b.exr", scene=scene(tmp_path / "b.gltf", materials[::-1]), **common)
    turned = read_stored(tmp_path / "b.exr")
    for got, grid in zip(np.split(turned, 3, 2), np.split(want, 3, 2), strict=True):
        assert np.array_equal(cells(got, 3)[::-1], cells(grid, 3))
    shading.render(
        baked / "noise.json",
        tmp_path / "grid.png",
        for_=engine,
        size=SIZE,
        columns=3,
        rows=2,
        base_color=GOLD,
        background="plain",
    )
    shading.render(
        baked / "noise.json",
        tmp_path / "a.png",
        for_=engine,
        size=SIZE,
        columns=3,
        scene=tmp_path / "a.gltf",
        background="plain",
    )
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "grid.png").read_bytes()


@pytest.mark.parametrize("engine", ["filament", "three"])
def test_an_index_is_seen_in_the_picture_and_in_truth(baked, tmp_path, engine):
    """An insulator whose F0 is 1 in one channel is there what a metal of base colour 1 is: nothing is diffuse. Its F0
    of 0 is in another what is left of it, [Schlick1994]'s F90, and .25 of n = 3 lies between as F is linear in F0."""
    tint = {"ior": {"ior": 0}, "specular": {"specularColorFactor": [1, 0, 0.25]}}
    path = scene(
        tmp_path / "s.gltf",
        [plain(0.5, 0, (0, 0, 0), **tint), plain(0.5, 1, (1, 0, 0.25)), plain(0.5, 0, (0, 0, 0), ior={"ior": 3})],
    )
    made = beside.render(
        baked / "noise.json",
        tmp_path / "s.exr",
        for_=engine,
        truth=baked / "noise.exr",
        size=SIZE,
        scene=path,
        background="plain",
    )
    assert [one["f0"] for one in made.materials] == [(1, 0, 0.25), (0.04,) * 3, (0.25,) * 3]
    for layer in np.split(read_stored(tmp_path / "s.exr"), 3, 2)[1:]:
        insulator, metal, third = cells(layer, 3)
        # Float32 of values of order 1.
        np.testing.assert_allclose(insulator, metal, atol=1e-6)
        np.testing.assert_allclose(third[..., 2], insulator[..., 2], atol=1e-6)
        assert third[..., 0].mean() < 0.7 * insulator[..., 0].mean()


def test_a_texture_counts_with_its_mean(tmp_path):
    """Half of the texels at G = 0, half at 255, of a factor .8: r = .4; base colours are averaged in linear light."""
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4] = 255
    textured = {
        "pbrMetallicRoughness": {
            "roughnessFactor": 0.8,
            "metallicFactor": 0.5,
            "metallicRoughnessTexture": {"index": 0},
            "baseColorTexture": {"index": 0},
        }
    }
    path = scene(tmp_path / "s.gltf", [textured, plain(0.3, 1)], [image])
    found = material_spheres.of_scene(material_spheres.read_scene(path))
    one, other = found.spheres
    assert one.roughness == pytest.approx(0.4) and one.metalness == pytest.approx(0.25)
    assert one.base_color == pytest.approx((0.5,) * 3)
    assert (other.roughness, other.metalness, other.base_color, other.insulator) == (0.3, 1, GOLD, (0.04,) * 3)
    assert found.notices == ("m0: textures vary, the sphere has the mean of the parts in use",)


def test_what_is_left_out_is_said(tmp_path):
    """Each kind once, with the materials that have it; what is plain is in none."""
    kinds = {
        "clearcoat": ({"clearcoatFactor": 1}, "clear coat"),
        "sheen": ({"sheenColorFactor": [1, 0, 0]}, "sheen"),
        "transmission": ({"transmissionFactor": 0.5}, "transmission"),
        "anisotropy": ({"anisotropyStrength": 0.5}, "anisotropy"),
        "iridescence": ({"iridescenceFactor": 1}, "iridescence"),
        "diffuse_transmission": ({"diffuseTransmissionFactor": 1}, "diffuse transmission"),
        "specular": ({"specularFactor": 0.5}, "a specular factor below 1"),
    }
    materials = [plain(0.5, 0, **{name: value}) for name, (value, _) in kinds.items()]
    materials += [
        plain(0.5, 0),
        plain(0.5, 0, clearcoat={"clearcoatFactor": 0}),
        plain(0.5, 0, unlit={}),
        {**plain(0.5, 0), "emissiveFactor": [1, 1, 1]},
        plain(0.5, 0, transmission={"transmissionFactor": 1}, volume={"thicknessFactor": 1}),
        plain(0.5, 0, fur={}),
    ]
    found = material_spheres.of_scene(material_spheres.read_scene(scene(tmp_path / "s.gltf", materials)))
    said = {}
    for notice in found.notices:
        who, _, what = notice.partition(": ")
        assert what not in said
        said[what.partition(" is left out")[0]] = who
    want = {what: f"m{k}" for k, (_, what) in enumerate(kinds.values())}
    want |= {
        "transmission": "m2, m11",
        "volume": "m11",
        "light of its own": "m10",
        "unlit, no sphere is drawn of it": "m9",
        "KHR_materials_fur is not read, what it falls back to is drawn": "m12",
    }
    assert said == want
    assert [one.name for one in found.spheres] == [f"m{k}" for k in range(13) if k != 9]
    assert found.spheres[6].insulator == pytest.approx((0.02,) * 3)


def test_more_than_64_are_those_of_most_primitives(tmp_path):
    """70 materials of which the last is on two more primitives, and every seventh of the first 35 on one more: these
    stay, and the earliest of the others, in the order of the file."""
    doc = document([{"name": f"m{k}", **plain(0.5, 0)} for k in range(70)])
    primitives = doc["meshes"][0]["primitives"]
    often = [*range(0, 35, 7), 69]
    primitives += [dict(primitives[k]) for k in (*often, 69)]
    found = material_spheres.of_scene(material_spheres.read_scene(written(tmp_path / "s.gltf", doc)), columns=10)
    kept = sorted({*often, *[k for k in range(70) if k not in often][:58]})
    assert [one.name for one in found.spheres] == [f"m{k}" for k in kept]
    assert (found.rows, found.columns) == (7, 10) and "70 materials" in found.notices[0]
    assert found.placed()[-1] == {**found.placed()[-1], "name": "m69", "row": 7, "column": 4}


def test_the_command_names_each_with_its_place(baked, tmp_path):
    """Also what is nearly a mirror, and names that no font of the picture has, or that TeX would read."""
    pytest.importorskip("matplotlib")
    names = ["金 $x_1^", "rubber", "glass"]
    made = [
        {"name": name, **one} for name, one in zip(names, (plain(0.004, 1), plain(0.8, 0), plain(0.1, 0)), strict=True)
    ]
    path = as_glb(tmp_path / "s.glb", document(made))
    asked = [
        "render",
        str(baked / "noise.json"),
        "--for",
        "filament",
        "--size",
        "16",
        "--columns",
        "2",
        "--scene",
        str(path),
    ]
    done = CliRunner().invoke(cli, [*asked, "-o", str(tmp_path / "a.png"), "--json"], catch_exceptions=False)
    row = json.loads(done.stdout)
    assert (row["width"], row["height"], row["roughness"], row["metalness"]) == (32, 32, [], [])
    assert [(one["name"], one["row"], one["column"]) for one in row["materials"]] == [
        (names[0], 1, 1),
        (names[1], 1, 2),
        (names[2], 2, 1),
    ]
    for suffix in ("png", "exr"):
        done = CliRunner().invoke(
            cli,
            [*asked, "-o", str(tmp_path / f"b.{suffix}"), "--truth", str(baked / "noise.exr")],
            catch_exceptions=False,
        )
        assert done.exit_code == 0, done.output
        lines = done.stdout.splitlines()[2:5]
        for line, name, place in zip(lines, names, (["1", "1"], ["1", "2"], ["2", "1"]), strict=True):
            assert line.strip().startswith(name) and line.strip().removeprefix(name).split()[:2] == place
    # The place that is left is background, seen by the camera: as at the corners of a grid, to half a code.
    image = read_stored(tmp_path / "a.png")
    whole = shading.srgb(shading.grid(*lights_of(baked), size=16, columns=2, rows=2))
    beside_spheres = np.ones((16, 16), bool)
    beside_spheres.flat[shading.sphere(16)[0]] = False
    assert np.abs(image - whole)[16:, 16:][beside_spheres].max() <= 0.5 / 255 + 1e-6
    assert len(np.unique(image[20:28, 20:28].reshape(-1, 3), axis=0)) > 1


def lights_of(baked: Path):
    engine, folder, stem = shading.engine_in(baked / "noise.json", "filament")
    return engine, shading.read_lights(engine, folder, stem)


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"rows": 2}, UsageError, "rows are of the grid"),
        ({"base_color": (1, 1, 1)}, UsageError, "base color is of the grid"),
        ({"columns": 65}, UsageError, r"columns 65 is outside \[1, 64\]"),
        ({"metal": "schlick:gold"}, UsageError, "metal is of the grid"),
        ({"dielectric": "schlick:f0=.1"}, UsageError, "dielectric is of the grid"),
        ({"scene": "unlit.gltf"}, InputError, "no materials that light falls on"),
        ({"scene": "broken.glb"}, InputError, r"broken\.glb"),
    ],
)
def test_what_cannot_be_drawn_is_said(baked, tmp_path, options, error, said):
    scene(tmp_path / "unlit.gltf", [plain(0.5, 0, unlit={})])
    (tmp_path / "broken.glb").write_bytes(b"glTF")
    path = tmp_path / options.pop("scene") if "scene" in options else scene(tmp_path / "s.gltf", [plain(0.5, 0)])
    with pytest.raises(error, match=said) as raised:
        if {"metal", "dielectric"} & set(options):
            beside.render(
                baked / "noise.json", tmp_path / "x.exr", for_="three", truth=baked / "noise.exr", scene=path, **options
            )
        else:
            shading.render(baked / "noise.json", tmp_path / "x.png", for_="three", scene=path, **options)
    assert "\n" not in str(raised.value) and not list(tmp_path.glob("x.*"))
