"""Scenes: what a glTF's materials hold, what they need of a bake, and what happens to files that are broken."""

from __future__ import annotations

import base64
import io
import json
import math
import os
import random
import struct
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from changed_values import changed, every
from changed_values import put as with_value
from scenes import WHOLE, as_glb, document, uri, written
from whitefurnace import integrate
from whitefurnace.advice.needs import NEGLIGIBLE, TABLE, Needs, lobes, needs, read_shares, write_job
from whitefurnace.baking import bake as baking
from whitefurnace.baking.request import BakeRequest
from whitefurnace.batch import jobs as batch
from whitefurnace.cli import cli, main
from whitefurnace.engines.presets import ENGINES
from whitefurnace.errors import FileError, InputError, UnsupportedError, UsageError, WhitefurnaceError
from whitefurnace.files import read_stored
from whitefurnace.files.png import encode_png
from whitefurnace.prefiltering.recipe import chain
from whitefurnace.scenes.material_spheres import insulator, of_scene
from whitefurnace.scenes.materials import PROPERTIES, Scene, read_scene

pytest.importorskip("pygltflib")


def scene_of(tmp_path: Path, *materials: dict[str, Any], **more: Any) -> Scene:
    return read_scene(written(tmp_path / "scene.gltf", document(list(materials), **more)))


def pbr(**values: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": values}


def with_extension(name: str, **values: Any) -> dict[str, Any]:
    return {"extensions": {f"KHR_materials_{name}": values}}


# ------------------------------------------------------------------------------------------------- materials

# What the specifications say, apart from the program's own table: (property, where, factor, texture, channels, sRGB?).
SPECIFIED = [
    ("base_color", "pbr", "baseColorFactor", "baseColorTexture", "RGB", True),
    ("metalness", "pbr", "metallicFactor", "metallicRoughnessTexture", "B", False),
    ("roughness", "pbr", "roughnessFactor", "metallicRoughnessTexture", "G", False),
    ("emission", "", "emissiveFactor", "emissiveTexture", "RGB", True),
    ("specular", "specular", "specularFactor", "specularTexture", "A", False),
    ("specular_color", "specular", "specularColorFactor", "specularColorTexture", "RGB", True),
    ("sheen_color", "sheen", "sheenColorFactor", "sheenColorTexture", "RGB", True),
    ("sheen_roughness", "sheen", "sheenRoughnessFactor", "sheenRoughnessTexture", "A", False),
    ("clearcoat", "clearcoat", "clearcoatFactor", "clearcoatTexture", "R", False),
    ("clearcoat_roughness", "clearcoat", "clearcoatRoughnessFactor", "clearcoatRoughnessTexture", "G", False),
    ("anisotropy", "anisotropy", "anisotropyStrength", "anisotropyTexture", "B", False),
    ("transmission", "transmission", "transmissionFactor", "transmissionTexture", "R", False),
    ("thickness", "volume", "thicknessFactor", "thicknessTexture", "G", False),
    ("iridescence", "iridescence", "iridescenceFactor", "iridescenceTexture", "R", False),
    (
        "diffuse_transmission",
        "diffuse_transmission",
        "diffuseTransmissionFactor",
        "diffuseTransmissionTexture",
        "A",
        False,
    ),
    (
        "diffuse_transmission_color",
        "diffuse_transmission",
        "diffuseTransmissionColorFactor",
        "diffuseTransmissionColorTexture",
        "RGB",
        True,
    ),
]
CODES = {"R": 51, "G": 102, "B": 153, "A": 204}


def linear(code: int) -> float:
    """IEC 61966-2-1."""
    x = code / 255
    return x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4


def placed(where: str, values: dict[str, Any]) -> dict[str, Any]:
    return pbr(**values) if where == "pbr" else values if not where else with_extension(where, **values)


@pytest.mark.parametrize(
    ("name", "where", "factor", "texture", "channels", "srgb"), SPECIFIED, ids=[row[0] for row in SPECIFIED]
)
def test_a_factor_and_a_texture_multiply_in_the_channels_of_the_specification(
    tmp_path, name, where, factor, texture, channels, srgb
):
    image = np.broadcast_to(np.array([CODES[c] for c in "RGBA"], np.uint8), (4, 4, 4))
    value = [0.5, 0.75, 1.0] + ([1.0] if name == "base_color" else []) if len(channels) == 3 else 0.5
    scene = scene_of(tmp_path, placed(where, {factor: value, texture: {"index": 0}}), images=[image])
    spread = scene.materials[0][name]
    factors = value[:3] if isinstance(value, list) else [value]
    wanted = [f * (linear(CODES[c]) if srgb else CODES[c] / 255) for f, c in zip(factors, channels, strict=True)]
    # sRGB tables are float32: 6e-8 of a value
    assert spread.low == pytest.approx(wanted, rel=1e-6) and spread.high == pytest.approx(wanted, rel=1e-6)
    assert spread.given == "texture"
    alone = scene_of(tmp_path, placed(where, {factor: value})).materials[0][name]
    assert alone.low == alone.high == pytest.approx(factors) and alone.given == "factor"


def test_the_specified_properties_are_those_that_have_a_texture():
    assert {row[0] for row in SPECIFIED} == {p.name for p in PROPERTIES if p.texture}


GLOSSY = {"diffuseFactor": [0.5, 0.2, 0.1, 1], "specularFactor": [0.9, 0.7, 0.3], "glossinessFactor": 0.7}


def test_specular_glossiness_is_a_material(tmp_path):
    """r = 1 − glossiness; F0 and the diffuse colour as given [KHR_materials_pbrSpecularGlossiness]."""
    doc = document([{**pbr(metallicFactor=1, roughnessFactor=1), **with_extension("pbrSpecularGlossiness", **GLOSSY)}])
    doc["extensionsRequired"] = ["KHR_materials_pbrSpecularGlossiness"]
    scene = read_scene(written(tmp_path / "s.gltf", doc))
    (m,) = scene.materials
    assert m["roughness"].low == m["roughness"].high == pytest.approx((0.3,)) and m.unread == ()
    assert m["base_color"].low == (0.5, 0.2, 0.1) and m["metalness"].low == (0.0,)
    assert insulator(m) == pytest.approx((0.9, 0.7, 0.3))
    # c_diff = diffuse · (1 − max(specular))
    assert m.diffuse_share(insulator(m)) == pytest.approx(0.1)
    said = verdicts(needs(scene, ENGINES["raw"]))
    # the levels on either side of r = .3, at r = .293 and .5
    assert [said[f"level {k}"] for k in range(5)] == [False, False, True, True, False] and said["irradiance"]
    black = with_extension("pbrSpecularGlossiness", **{**GLOSSY, "diffuseFactor": [0, 0, 0, 1]})
    assert not verdicts(needs(scene_of(tmp_path, black), ENGINES["raw"]))["irradiance"]
    sphere = of_scene(scene, 1).spheres[0]
    assert sphere.base_color == pytest.approx((0.05, 0.02, 0.01)) and sphere.insulator == pytest.approx((0.9, 0.7, 0.3))
    (default,) = scene_of(tmp_path, with_extension("pbrSpecularGlossiness")).materials
    assert default["roughness"].low == (0.0,) and insulator(default) == (1, 1, 1)


def test_glossiness_is_in_alpha_and_specular_in_the_colours(tmp_path):
    image = np.zeros((4, 8, 4), np.uint8)
    image[..., :3] = [CODES[c] for c in "RGB"]
    image[:, :4, 3], image[:, 4:, 3] = 51, 204
    values = {**GLOSSY, "specularGlossinessTexture": {"index": 0}, "diffuseTexture": {"index": 0}}
    (m,) = scene_of(tmp_path, with_extension("pbrSpecularGlossiness", **values), images=[image]).materials
    gloss = 0.7 * np.array([51, 204]) / 255
    r = m["roughness"]
    # sRGB tables are float32: 6e-8 of a value
    assert (r.least, r.most) == pytest.approx((1 - gloss[1], 1 - gloss[0])) and r.mean == pytest.approx(
        (1 - gloss.mean(),)
    )
    assert r.given == "texture" and [k for k, share in enumerate(r.histogram) if share] == [
        *(int(64 * (1 - g)) for g in gloss[::-1])
    ]
    for name, factors in (("specular_color", (0.9, 0.7, 0.3)), ("base_color", (0.5, 0.2, 0.1))):
        wanted = [f * linear(CODES[c]) for f, c in zip(factors, "RGB", strict=True)]
        assert m[name].low == m[name].high == pytest.approx(wanted, rel=1e-6)
    doc = document([with_extension("pbrSpecularGlossiness", **values)], [image])
    doc["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    unseen = read_scene(written(tmp_path / "u.gltf", doc)).materials[0]["roughness"]
    assert (unseen.least, unseen.most, unseen.seen) == (pytest.approx(0.3), 1.0, False)


def test_an_image_is_what_its_bytes_are(tmp_path):
    """A WebP, as Pillow writes it, by its own bytes: without a type, with a wrong one, in an extension."""
    image = pytest.importorskip("PIL.Image")
    data = io.BytesIO()
    image.fromarray(np.full((8, 8, 3), 102, np.uint8)).save(data, "WEBP", lossless=True)
    for given in ({"uri": uri(data.getvalue(), "image/webp")}, {"uri": uri(data.getvalue()), "mimeType": "image/png"}):
        doc = document([pbr(metallicRoughnessTexture={"index": 0})], [ramp(4, 4)])
        doc["images"], doc["textures"] = [given], [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
        r = read_scene(written(tmp_path / "s.gltf", doc)).materials[0]["roughness"]
        assert r.seen and r.low == r.high == pytest.approx((102 / 255,))
    doc["images"] = [{"uri": uri(b"GIF89a" + bytes(20)), "mimeType": "image/png"}]
    with pytest.raises(InputError, match="neither PNG, JPEG nor WebP"):
        read_scene(written(tmp_path / "s.gltf", doc))


def test_values_without_textures_and_what_is_default(tmp_path):
    scene = scene_of(
        tmp_path,
        {
            "extensions": {
                "KHR_materials_ior": {"ior": 1.33},
                "KHR_materials_emissive_strength": {"emissiveStrength": 7},
                "KHR_materials_volume": {"attenuationDistance": 0.1, "attenuationColor": [0.9, 0.5, 0.1]},
                "KHR_materials_iridescence": {"iridescenceIor": 1.8, "iridescenceThicknessMaximum": 300},
                "KHR_materials_dispersion": {"dispersion": 2},
                "VENDOR_other": {},
            }
        },
    )
    m = scene.materials[0]
    found = {
        name: m[name].low
        for name in (
            "ior",
            "emissive_strength",
            "attenuation_distance",
            "attenuation_color",
            "iridescence_ior",
            "iridescence_thickness",
            "dispersion",
        )
    }
    assert found == {
        "ior": (1.33,),
        "emissive_strength": (7.0,),
        "attenuation_distance": (0.1,),
        "dispersion": (2.0,),
        "attenuation_color": (0.9, 0.5, 0.1),
        "iridescence_ior": (1.8,),
        "iridescence_thickness": (300.0,),
    }
    # glTF's defaults: white, a metal, rough; n = 1.5
    assert (m["base_color"].low, m["metalness"].low, m["roughness"].low) == ((1, 1, 1), (1,), (1,))
    assert m["base_color"].given == "default" and m.unread == ("VENDOR_other",)
    plain = scene_of(tmp_path, {}).materials[0]
    assert plain["ior"].low == (1.5,) and plain["attenuation_distance"].low == (math.inf,)


def test_the_film_of_iridescence_runs_from_minimum_to_maximum(tmp_path):
    image = np.zeros((2, 2, 3), np.uint8)
    image[0, :, 1] = 255
    scene = scene_of(
        tmp_path,
        with_extension(
            "iridescence",
            iridescenceThicknessMinimum=200,
            iridescenceThicknessMaximum=500,
            iridescenceThicknessTexture={"index": 0},
        ),
        images=[image],
    )
    assert (scene.materials[0]["iridescence_thickness"].low, scene.materials[0]["iridescence_thickness"].high) == (
        (200.0,),
        (500.0,),
    )


def ramp(rows: int = 64, columns: int = 256) -> np.ndarray:
    """Roughness (G) k/255 in column k, metalness (B) 0 above and 255 below."""
    image = np.zeros((rows, columns, 3), np.uint8)
    image[..., 1] = np.arange(columns)
    image[rows // 2 :, :, 2] = 255
    return image


ROUGH = pbr(metallicRoughnessTexture={"index": 0}, roughnessFactor=0.5)


def test_roughness_of_a_texture_has_a_range_a_mean_and_a_histogram(tmp_path):
    m = scene_of(tmp_path, ROUGH, images=[ramp()]).materials[0]
    r = m["roughness"]
    assert (r.low, r.high) == ((0.0,), (0.5,)) and r.mean == pytest.approx((0.25,))
    assert sum(r.histogram) == pytest.approx(1) and len(r.histogram) == 64
    # 256 values over half of [0, 1]: 8 in a part, or 7 where one falls on its end; .5 itself is in the 33rd
    assert all(round(256 * share) in (7, 8) for share in r.histogram[:32]) and max(r.histogram[33:]) == 0
    assert round(256 * r.histogram[32]) == 1
    assert (m["metalness"].low, m["metalness"].high, m["metalness"].mean) == ((0,), (1,), (0.5,))


@pytest.mark.parametrize("case", ["left quarter", "by a transform", "sixteen bits", "wrapped", "clamped"])
def test_only_what_triangles_use_of_an_image_counts(tmp_path, case):
    image, uv, material = ramp(), WHOLE * [0.25, 1], json.loads(json.dumps(ROUGH))
    material["pbrMetallicRoughness"]["roughnessFactor"] = 1.0
    if case == "by a transform":
        uv = WHOLE
        material["pbrMetallicRoughness"]["metallicRoughnessTexture"]["extensions"] = {
            "KHR_texture_transform": {"scale": [0.25, 1]}
        }
    if case == "sixteen bits":
        image = image.astype(np.uint16) * 257
    if case == "wrapped":
        uv = uv + np.array([3.0, 0.0])
    doc = document([material], [image], uv)
    if case == "clamped":
        doc = document([material], [image], WHOLE * [0.25, 1] - [1.0, 0.0])
        doc["samplers"] = [{"wrapS": 33071}]
        doc["textures"][0]["sampler"] = 0
    r = read_scene(written(tmp_path / "s.gltf", doc)).materials[0]["roughness"]
    # a quarter is columns 0 to 64; a tile beside it counts too, as a filter reads it: one column here
    assert r.least == 0 and r.most == pytest.approx((0 if case == "clamped" else 65) / 255, abs=1.01 / 255)


def test_images_that_are_not_decoded_count_from_nothing_to_the_factor(tmp_path):
    doc = document([ROUGH], [ramp()])
    doc["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    scene = read_scene(written(tmp_path / "s.gltf", doc))
    r = scene.materials[0]["roughness"]
    assert (r.low, r.high, r.mean, r.seen) == ((0.0,), (0.5,), (), False)
    assert len(scene.notices) == 1 and "KHR_texture_basisu" in scene.notices[0]


def test_extent_cameras_and_only_what_stands_in_the_scene(tmp_path):
    doc = document([{"name": "seen"}, {"name": "not seen"}])
    doc["meshes"] = [{"primitives": [p]} for p in doc["meshes"][0]["primitives"]]
    c = math.sqrt(0.5)
    doc["nodes"] = [
        {"children": [1, 2], "translation": [0, 3, 0], "scale": [2, 2, 2]},
        {"mesh": 0, "rotation": [0, c, 0, c]},
        {"camera": 0, "translation": [0, 0, 5]},
        {"mesh": 1},
    ]
    doc["nodes"][1]["children"] = [4]
    doc["nodes"].append({"camera": 0})
    doc["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}}]
    scene = read_scene(written(tmp_path / "s.gltf", doc))
    assert [m.name for m in scene.materials] == ["seen"]
    # 2 m wide, twice as large, turned by 90° about y: along z
    assert scene.extent == pytest.approx((0, 4, 4), abs=1e-6) and scene.low == pytest.approx((0, 1, -2), abs=1e-6)
    # the second is turned with the mesh: +90° about y take z to x, and -z, where it looks, to -x
    turned, camera = scene.cameras
    assert turned.direction == pytest.approx((-1, 0, 0), abs=1e-9)
    assert camera.position == pytest.approx((0, 3, 10)) and camera.direction == pytest.approx((0, 0, -1))
    assert camera.yfov == 0.7


def test_a_glb_is_the_same_as_its_gltf(tmp_path):
    doc = document([ROUGH], [ramp()])
    plain = read_scene(written(tmp_path / "s.gltf", doc))
    whole = read_scene(as_glb(tmp_path / "s.glb", doc))
    assert whole.materials == plain.materials and whole.extent == plain.extent
    beside = json.loads(json.dumps(doc))
    for name, thing in (("b.bin", beside["buffers"][0]), ("i m.png", beside["images"][0])):
        (tmp_path / name).write_bytes(base64.b64decode(thing["uri"].partition(",")[2]))
        thing["uri"] = name.replace(" ", "%20")
    assert read_scene(written(tmp_path / "t.gltf", beside)).materials == plain.materials


# ------------------------------------------------------------------------------------------------- needs


def verdicts(found: Needs) -> dict[str, bool | None]:
    return {row.what.partition(",")[0]: row.needed for row in found.rows}


MIRROR = {"name": "mirror", **pbr(metallicFactor=1, roughnessFactor=0)}
CHALK = {"name": "chalk", **pbr(metallicFactor=0, roughnessFactor=1)}
CLOTH = {
    "name": "cloth",
    **pbr(metallicFactor=0, roughnessFactor=0.8),
    **with_extension("sheen", sheenColorFactor=[1, 1, 1], sheenRoughnessFactor=0.5),
}


def test_a_mirror_needs_the_image_and_no_diffuse_light(tmp_path):
    found = needs(scene_of(tmp_path, MIRROR), ENGINES["raw"])
    said = verdicts(found)
    assert [said[f"level {k}"] for k in range(5)] == [True, False, False, False, False]
    assert not said["irradiance"] and not said["irradiance harmonics"] and said["split-sum table"]
    assert found.options == {"only_levels": "0-0", "without": ["irradiance", "sh"]}
    assert found.nbytes == 6 * 256 * 256 * 12 + 128 * 128 * 8
    assert found.full_nbytes == sum(6 * (256 >> k) ** 2 * 12 for k in range(5)) + 6 * 32 * 32 * 12 + 128 * 128 * 8


def test_chalk_needs_diffuse_light_and_the_last_level(tmp_path):
    found = needs(scene_of(tmp_path, CHALK), ENGINES["raw"])
    said = verdicts(found)
    assert [said[f"level {k}"] for k in range(5)] == [False, False, False, False, True] and said["irradiance"]
    # r = 1 is read at 16², and no other level is
    assert found.options == {"only_levels": "4-4"} and found.chain.levels == ((16, 1.0),)
    assert found.nbytes == 6 * 16 * 16 * 12 + 6 * 32 * 32 * 12 + 128 * 128 * 8
    assert found.seconds < found.full_seconds


def test_nothing_lit_needs_nothing(tmp_path):
    unlit = {"name": "sign", **with_extension("unlit")}
    found = needs(scene_of(tmp_path, unlit), ENGINES["filament"])
    assert found.own is None and found.options == {} and found.nbytes == 0 and found.full_nbytes > 3e6
    assert [row.needed for row in found.rows] == [False] and "unlit" in found.rows[0].reason


def test_charlie_is_needed_by_a_sheen_alone(tmp_path):
    bare, cloth = (needs(scene_of(tmp_path, m), ENGINES["khronos"]) for m in (CHALK, CLOTH))
    assert verdicts(bare)["Charlie's chain"] is False and verdicts(cloth)["Charlie's chain"] is True
    assert bare.without == ("sheen",) and cloth.without == ()
    assert bare.own.holding("sheen") == () and not bare.own.dfg.charlie and cloth.own == ENGINES["khronos"]
    # beyond a preset: a chain and a table of their own for raw, and none for an engine that reads none
    raw = needs(scene_of(tmp_path, CLOTH), ENGINES["raw"])
    assert raw.cloth["ndf"] == "charlie" and [t["kind"] for t in raw.tables] == ["sheen"]
    three = needs(scene_of(tmp_path, CLOTH), ENGINES["three"])
    assert verdicts(three)["Charlie's chain"] is None and three.cloth is None and not three.tables


@pytest.mark.parametrize("engine", [name for name, e in ENGINES.items() if e.container == "files"])
def test_a_table_and_a_sheen_that_do_not_go_together_are_told(tmp_path, engine):
    """A material with sheen and a table without its channel, and the other way round: one sentence each."""
    table = ENGINES[engine].dfg.charlie and bool(ENGINES[engine].holding("dfg"))
    for material in (CLOTH, CHALK):
        found = needs(scene_of(tmp_path, material), ENGINES[engine])
        rows = [row for row in found.rows if row.what == "Charlie's albedo in the table"]
        if material is CLOTH:
            (row,) = rows
            assert row.needed is (True if table else None) and "cloth has a sheen at r = 0.5" in row.reason
            lacks = (f"the table of {engine} has no channel for it", f"the files for {engine} have no table of it")
            assert table or row.reason.endswith(lacks)
            assert found.own.dfg.charlie is ENGINES[engine].dfg.charlie
        else:
            assert [row.needed for row in rows] == ([False] if table else [])
            assert all("no material has a sheen, so the table's third channel is left out" in r.reason for r in rows)
            assert not found.own.dfg.charlie and ("sheen" in found.without) is table


@pytest.mark.parametrize("engine", ["filament", "babylon", "khronos"])
def test_a_sheen_alone_needs_the_table_and_the_levels_that_it_reads(tmp_path, engine):
    """Felt that mirrors nothing: the table is for its sheen, and without Charlie's chain so are levels."""
    felt = {
        **CLOTH,
        "extensions": {**CLOTH["extensions"], **with_extension("specular", specularFactor=0)["extensions"]},
    }
    found = needs(scene_of(tmp_path, felt), ENGINES[engine])
    said = verdicts(found)
    assert said["split-sum table"] and said["Charlie's albedo in the table"] and "dfg" not in found.without
    reads = [row for row in found.rows if row.kind == "level" and "of reads: cloth" in row.reason]
    assert bool(reads) is (engine != "khronos")


def test_a_clear_coat_reads_at_its_own_roughness(tmp_path):
    coated = {"name": "paint", **CHALK, **with_extension("clearcoat", clearcoatFactor=1, clearcoatRoughnessFactor=0.03)}
    scene = scene_of(tmp_path, coated)
    assert sorted(lobe.roughness.least for lobe in lobes(scene, least=0.045)) == [0.045, 1.0]
    found = needs(scene, ENGINES["raw"])
    assert verdicts(found)["level 0"] and verdicts(found)["level 4"] and not verdicts(found)["level 2"]
    assert found.chain == found.full


@pytest.mark.parametrize(
    ("engine", "wanted"),
    [
        ("raw", False),  # single scattering: a metal has no diffuse part
        ("filament", False),
        ("three", True),  # [FdezAguera2019] gives what is scattered again as diffuse light, of metals too
        ("babylon", True),  # mixes α of the diffuse light into what is reflected
    ],
)
def test_whether_a_rough_metal_needs_diffuse_light_is_the_engines(tmp_path, engine, wanted):
    gold = {"name": "gold", **pbr(baseColorFactor=[1, 0.78, 0.34, 1], roughnessFactor=0.6)}
    found = needs(scene_of(tmp_path, gold), ENGINES[engine])
    assert ("sh" in found.without) == (not wanted and ENGINES[engine].needs("sh"))
    assert found.own.needs("sh") == (wanted and ENGINES[engine].needs("sh"))


def test_black_and_clear_need_no_diffuse_light(tmp_path):
    black = pbr(baseColorFactor=[0, 0, 0, 1], metallicFactor=0, roughnessFactor=0.4)
    clear = {**pbr(metallicFactor=0, roughnessFactor=0), **with_extension("transmission", transmissionFactor=1)}
    assert "irradiance" in needs(scene_of(tmp_path, black, clear), ENGINES["raw"]).without
    leaf = {
        **pbr(baseColorFactor=[0, 0, 0, 1], metallicFactor=0),
        **with_extension("diffuse_transmission", diffuseTransmissionFactor=0.5),
    }
    assert "irradiance" not in needs(scene_of(tmp_path, leaf), ENGINES["raw"]).without


def test_what_no_table_gives_is_said(tmp_path):
    strange = {"name": "strange", "emissiveFactor": [1, 1, 1], **pbr(metallicFactor=0, roughnessFactor=0.3)}
    strange |= {
        "extensions": {
            "KHR_materials_iridescence": {"iridescenceFactor": 1},
            "KHR_materials_transmission": {"transmissionFactor": 1},
            "KHR_materials_volume": {"thicknessFactor": 1, "attenuationDistance": 2},
            "KHR_materials_ior": {"ior": 1.4},
            "KHR_materials_dispersion": {"dispersion": 1},
            "KHR_materials_anisotropy": {"anisotropyStrength": 0.5},
            "KHR_materials_emissive_strength": {"emissiveStrength": 5},
            "VENDOR_x": {},
        }
    }
    found = needs(scene_of(tmp_path, strange), ENGINES["raw"])
    said = {row.what for row in found.rows if row.needed is None}
    assert said == {
        "iridescence",
        "refraction with volume",
        "absorption",
        "dispersion",
        "anisotropy",
        "light of its own",
        "VENDOR_x",
    }
    assert found.tables == ({"kind": "glass", "output": "glass_1.4.npy", "size": 32, "set": ["ior=1.4"]},)


def test_every_engine_decides_about_every_scene(tmp_path):
    scene = scene_of(tmp_path, MIRROR, CLOTH, ROUGH, images=[ramp()])
    for engine in ENGINES.values():
        for background in (False, True):
            found = needs(scene, engine, background=background)
            assert 0 < found.nbytes <= found.full_nbytes and found.seconds <= found.full_seconds
            order = baking.plan(BakeRequest(["demo"], "x", for_=engine.name, **found.options))
            assert order.chains == (found.chain,) and order.engines == (found.own,)
            assert ("skybox" in found.without) == (bool(engine.holding("skybox")) and not background)


@pytest.mark.few(1)
@pytest.mark.parametrize("engine", ["raw", "exr"])
def test_what_surfaces_read_does_not_change(tmp_path, engine):
    """Of the usual bake and of what the scene needs, the levels that its roughness reads are the same under the same
    names, but for rounding: their grids are made from the finest one of a bake (1.4e-5 seen), so not bit by bit."""
    found = needs(scene_of(tmp_path, pbr(metallicFactor=0, roughnessFactor=0.4)), ENGINES[engine])
    assert found.options == {"only_levels": "2-3"}  # lod(.4) = 4 · .64 = 2.56
    for folder, more in (("all", {}), ("own", found.options)):
        baking.bake(["demo"], tmp_path / folder, tolerance=1e-2, for_=engine, **more)

    def arrays(folder: str) -> dict[str, np.ndarray]:
        if engine == "exr":
            return {p.name: read_stored(p) for p in (tmp_path / folder / "exr").glob("*specular*.exr")}
        with np.load(tmp_path / folder / "raw/demo.npz") as held:
            return {name: held[name] for name in held if name.startswith("specular") or name == "roughness"}

    whole, own = arrays("all"), arrays("own")
    assert len([name for name in own if "specular" in name]) == (2 if engine == "raw" else 4)  # and lat-longs
    for name, array in own.items():
        np.testing.assert_allclose(array, whole[name], rtol=1e-4, err_msg=name)  # a hundredth of the tolerance


def test_the_size_of_tables_is_as_stated():
    """128² read within half a step of 8 bits at the 99th percentile, whatever the roughness, and 64² not."""
    rng = np.random.default_rng(1)
    for low in (0.0, 0.3, 0.7):
        NoV, r = rng.random(4000), low + (1 - low) * rng.random(4000)

        def made(NoV: np.ndarray, r: np.ndarray) -> np.ndarray:
            alpha = np.maximum(r * r, 1e-4)
            return np.asarray(integrate("dfg", ndf="ggx", NoV=NoV, alpha=alpha, tolerance=1e-5).values)

        def off(n: int, NoV: np.ndarray = NoV, r: np.ndarray = r, made: Callable[..., np.ndarray] = made) -> float:
            x, y = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n)
            t = made(x, y)
            s, u = (np.clip(v * n - 0.5, 0, n - 1) for v in (NoV, r))
            j, i = (np.minimum(v.astype(int), n - 2) for v in (s, u))
            s, u = (s - j)[:, None], (u - i)[:, None]
            read = (1 - u) * ((1 - s) * t[i, j] + s * t[i, j + 1]) + u * ((1 - s) * t[i + 1, j] + s * t[i + 1, j + 1])
            return float(np.quantile(np.abs(read - made(NoV, r)).max(1), 0.99))

        assert off(TABLE) <= NEGLIGIBLE < off(TABLE // 2)


def test_shares_of_reads_are_the_hats_of_the_lods(tmp_path):
    m = scene_of(tmp_path, pbr(roughnessFactor=0.5))
    shares = read_shares(lobes(m), chain())
    # lod(.5) = 4 · .75 = 3
    assert shares == pytest.approx([0, 0, 0, 1, 0])


# ------------------------------------------------------------------------------------------------- command line


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(cli, ["scene", *arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.output


def test_what_is_needed_is_baked_and_nothing_else(tmp_path):
    glass = {
        "name": "glass",
        **pbr(metallicFactor=0, roughnessFactor=1.0),
        **with_extension("transmission", transmissionFactor=1),
    }
    file = written(tmp_path / "s.gltf", document([glass]))
    code, said = run(str(file), "--environment", "demo", "-o", str(tmp_path / "out"))
    assert code == 0 and "bake --only-levels 4-4 --without irradiance,sh" in said
    assert sorted(p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*") if p.is_file()) == [
        "demo.json",
        "glass_1.5.npy",
        "glass_1.5.npy.json",
        "raw/demo.npz",
    ]
    with np.load(tmp_path / "out/raw/demo.npz") as held:
        assert sorted(held) == ["dfg", "error", "rmse", "roughness", "specular_4", "worst"]
        assert len(held["roughness"]) == 5 and held["specular_4"].shape == (6, 16, 16, 3)
        assert np.isnan(held["error"][:4]).all() and held["error"][4] <= 1e-3
    # and again, there is nothing to do
    assert run(str(file), "--environment", "demo", "-o", str(tmp_path / "out"))[1].count("up to date") == 2


def test_a_job_is_what_batch_takes(tmp_path):
    file = written(tmp_path / "s.gltf", document([CLOTH]))
    job = tmp_path / "jobs" / "cloth.toml"
    job.parent.mkdir()
    np.save(tmp_path / "sky.npy", np.ones((8, 16, 3), np.float32))
    for engine in ("raw", "khronos"):
        code, _ = run(str(file), "--environment", "demo", "--for", engine, "--job", str(job), "--force")
        assert code == 0
        made = batch.job(job)
        found = needs(read_scene(file), ENGINES[engine])
        assert len(made.items) == (3 if engine == "raw" else 1)
        first = json.loads(made.items[0].recipe)["options"]
        assert first["for_"] == engine and {k: first.get(k) for k in found.options} == found.options
        assert all(result.state == "planned" for result in made.predicted())
    with pytest.raises(FileError, match="another job"):
        write_job(job, needs(read_scene(file), ENGINES["raw"]), "raw", "s.gltf", ["demo"])


def test_paths_of_a_job_are_relative_to_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("jobs").mkdir()
    engine = Path("mine.toml")
    engine.write_text('lod = "max_lod * r"\n[[file]]\nholds = "specular"\nname = "{stem}.ktx2"\n')
    name = 'odd "ö\x7f.exr'
    Path(name).touch()
    file = written(tmp_path / "s.gltf", document([CHALK]))
    assert run(str(file), "--for", str(engine), "--environment", name, "--job", "jobs/j.toml")[0] == 0
    (item,) = batch.job(Path("jobs/j.toml")).items
    assert Path(item.source).samefile(name) and "mine.toml" in item.recipe


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("-o", "x"), "give --environment"),
        (("--job", "x.toml"), "give --environment"),
        (("-o", "x", "--job", "y.toml", "--environment", "demo"), "not both"),
        (("--for", "raw,exr"), "one engine"),
        (("--for", "filamnet"), "did you mean 'filament'"),
        (("--job", "x.txt", "--environment", "demo"), ".toml file"),
    ],
)
def test_options_that_cannot_be_meant(tmp_path, arguments, message):
    file = written(tmp_path / "s.gltf", document([CHALK]))
    with pytest.raises(UsageError, match=message.replace(".", r"\.")):
        CliRunner().invoke(cli, ["scene", str(file), *arguments], catch_exceptions=False)


def test_json_rows_are_json(tmp_path):
    file = written(tmp_path / "s.gltf", document([{**CLOTH, **with_extension("volume", thicknessFactor=1)}]))
    rows = [
        json.loads(line, parse_constant=lambda name: pytest.fail(name))
        for line in run(str(file), "--json")[1].splitlines()
    ]
    assert [row["event"] for row in rows][:2] == ["scene", "material"] and rows[-1]["event"] == "needs"
    assert rows[-1]["bytes"] < rows[-1]["usual_bytes"] and rows[1]["values"]["attenuation_distance"]["low"] == [None]


def test_without_pygltflib_one_sentence_names_the_extra(tmp_path, monkeypatch, capsys):
    file = written(tmp_path / "s.gltf", document([CHALK]))
    monkeypatch.setitem(sys.modules, "pygltflib", None)
    with pytest.raises(SystemExit) as left:
        main(["scene", str(file)])
    said = capsys.readouterr().err
    assert left.value.code == 5 and said.count("\n") == 1 and "whitefurnace[scene]" in said


@pytest.mark.parametrize(
    "options",
    [
        {"without": "irradiance,nothing"},
        {"table": 0},
        {"table": 64},
        {"without": ["sh"], "for_": "gltf"},
        {"only_levels": "1-2", "for_": "three"},
        {"only_levels": "3-5"},
        {"only_levels": "2-1"},
        {"only_levels": "1"},
        {"only_levels": "1-2", "fit": "read"},
    ],
)
def test_what_cannot_be_left_out(options):
    with pytest.raises(UsageError):
        baking.plan(BakeRequest(["demo"], "x", **options))


# ------------------------------------------------------------------------------------------------- broken files


def broken(change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    doc = document([ROUGH], [ramp()])
    change(doc)
    return doc


def put(*path: Any) -> Callable[[dict[str, Any]], object]:
    """Sets the value at a path of keys, the last of `path`; the value ... removes it."""

    def change(doc: dict[str, Any]) -> None:
        *keys, last, value = path
        at: Any = doc
        for key in keys:
            at = at[key]
        if value is ...:
            del at[last]
        else:
            at[last] = value

    return change


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "no asset": (put("asset", ...), "asset is missing"),
    "glTF 1": (put("asset", "version", "1.0"), "glTF '1.0'"),
    "a missing buffer": (put("buffers", 0, "uri", "gone.bin"), "buffer 0 is missing"),
    "a buffer without data": (put("buffers", 0, "uri", ...), "buffer 0 has no uri"),
    "a buffer that is shorter than it says": (put("buffers", 0, "byteLength", 1 << 30), "should have 1073741824 bytes"),
    "a buffer outside the folder": (put("buffers", 0, "uri", "../x.bin"), "not a file in the folder"),
    "a buffer by a scheme": (put("buffers", 0, "uri", "file:///etc/passwd"), "not a file in the folder"),
    "a buffer at the root": (put("buffers", 0, "uri", "/etc/passwd"), "not a file in the folder"),
    "an image outside the folder": (put("images", 0, "uri", "%2e%2e/x.png"), "not a file in the folder"),
    "a missing image": (put("images", 0, "uri", "gone.png"), "image 0, of a material, is missing"),
    "an image that is none": (put("images", 0, "uri", uri(b"hello")), "neither PNG, JPEG nor WebP"),
    "bad base64": (put("images", 0, "uri", "data:image/png;base64,@@@@"), "base64"),
    "no index of a texture": (
        put("materials", 0, "pbrMetallicRoughness", "metallicRoughnessTexture", {}),
        "the index of",
    ),
    "a texture that is not there": (
        put("materials", 0, "pbrMetallicRoughness", "metallicRoughnessTexture", {"index": 7}),
        "0 to 0 is allowed",
    ),
    "an image that is not there": (put("textures", 0, "source", 9), "0 to 0 is allowed"),
    "a sampler that is not there": (put("textures", 0, "sampler", 0), "there is none"),
    "a material that is not there": (put("meshes", 0, "primitives", 0, "material", 1), "0 to 0 is allowed"),
    "a mesh that is not there": (put("nodes", 0, "mesh", -1), "0 to 0 is allowed"),
    "a roughness that is NaN": (put("materials", 0, "pbrMetallicRoughness", "roughnessFactor", math.nan), "finite"),
    "a roughness past 1": (put("materials", 0, "pbrMetallicRoughness", "roughnessFactor", 1.5), "outside [0, 1]"),
    "a roughness that is a text": (
        put("materials", 0, "pbrMetallicRoughness", "roughnessFactor", "rough"),
        "not as glTF has them",
    ),
    "a colour of two": (put("materials", 0, "pbrMetallicRoughness", "baseColorFactor", [1, 1]), "has 2 entries"),
    "an ior below 1": (put("materials", 0, "extensions", {"KHR_materials_ior": {"ior": 0.5}}), "0 and 1 or more"),
    "an attenuation distance of 0": (
        put("materials", 0, "extensions", {"KHR_materials_volume": {"attenuationDistance": 0}}),
        "over 0",
    ),
    "an extension that is a number": (put("materials", 0, "extensions", {"KHR_materials_sheen": 3}), "an object was"),
    "a texture that is a number": (
        put("materials", 0, "pbrMetallicRoughness", "metallicRoughnessTexture", 3),
        "not as glTF has them",
    ),
    "a base that is a number": (put("materials", 0, "pbrMetallicRoughness", 3), "not as glTF has them"),
    "materials that are none": (put("materials", [3]), "an object was expected"),
    "a node that is its own child": (put("nodes", [{"mesh": 0, "children": [0]}]), "its own ancestor"),
    "cyclic nodes": (
        put("nodes", [{"children": [1]}, {"children": [2]}, {"mesh": 0, "children": [0]}]),
        "its own ancestor",
    ),
    "a cycle beside the scene": (put("nodes", [{"mesh": 0}, {"children": [2]}, {"children": [1]}]), "its own ancestor"),
    "two parents": (put("nodes", [{"children": [1, 2]}, {"children": [2]}, {"mesh": 0}]), "a child of both"),
    "a child that is not there": (put("nodes", 0, "children", [5]), "0 to 0 is allowed"),
    "a scene that is not there": (put("scene", 3), "0 to 0 is allowed"),
    "a scene of a child": (put("nodes", [{"mesh": 0}, {"children": [0]}]), "which is a child of"),
    "a rotation of three": (put("nodes", 0, "rotation", [0, 0, 1]), "has 3 entries"),
    "a scale that overflows": (
        put("nodes", [{"scale": [1e200] * 3, "children": [1]}, {"scale": [1e200] * 3, "mesh": 0}]),
        "is not finite",
    ),
    "an accessor without a type": (put("accessors", 1, "type", ...), "the type of accessor 1 is missing"),
    "coordinates of another type": (put("accessors", 1, "type", "VEC3"), "VEC2 of"),
    "a component that is none": (put("accessors", 1, "componentType", 5130), "componentType 5130"),
    "an accessor beyond its view": (put("accessors", 1, "count", 5), "up to byte 40 of a bufferView of 32"),
    "absurd counts": (put("accessors", 1, "count", 1 << 60), "is allowed"),
    "an offset beyond": (put("accessors", 1, "byteOffset", 1 << 35), "of a bufferView of 32"),
    "a stride that overlaps": (put("bufferViews", 1, "byteStride", 4), "4 apart"),
    "a view beyond its buffer": (put("bufferViews", 1, "byteLength", 1 << 33), "buffer 0 has 92"),
    "a view that is not there": (put("accessors", 1, "bufferView", 3), "0 to 2 is allowed"),
    "indices beyond the vertices": (put("accessors", 2, "bufferView", 0), "go up to"),
    "indices that are floats": (
        put("accessors", 2, {"bufferView": 1, "componentType": 5126, "count": 6, "type": "SCALAR"}),
        "unsigned integers",
    ),
    "a box that is inside out": (put("accessors", 0, "min", [2, 2, 2]), "a min above its max"),
    "a camera that is none": (put("nodes", 0, "camera", 0), "there is none"),
    "a mesh without primitives": (put("meshes", 0, "primitives", []), "0 entries"),
    "a million nodes": (put("nodes", [{}] * 1_000_000), "1000000 entries"),
    "six million values": (put("extras", [0] * 6_000_000), "at most 4000000 are read"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_one_sentence(tmp_path, case):
    change, message = BROKEN[case]
    (tmp_path / "in").mkdir()
    (tmp_path / "x.bin").write_bytes(bytes(92))
    (tmp_path / "x.png").write_bytes(encode_png(ramp()))
    file = written(tmp_path / "in" / "s.gltf", broken(change))
    with pytest.raises(InputError) as told:
        read_scene(file)
    text = str(told.value)
    assert message in text and "\n" not in text and str(file) in text and len(text) < 500


def test_a_link_that_leads_out_of_the_folder(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "x.bin").write_bytes(bytes(92))
    (tmp_path / "in" / "x.bin").symlink_to(tmp_path / "x.bin")
    file = written(tmp_path / "in" / "s.gltf", broken(put("buffers", 0, "uri", "x.bin")))
    with pytest.raises(InputError, match="not a file in the folder"):
        read_scene(file)


def test_the_command_line_exits_with_3(tmp_path, capsys):
    file = written(tmp_path / "s.gltf", broken(put("nodes", [{"mesh": 0, "children": [0]}])))
    with pytest.raises(SystemExit) as left:
        main(["scene", str(file)])
    assert left.value.code == 3 and capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"glTF",
        b"\xff\xfe",
        b"[" * 200_000,
        b'{"a":' * 100_000,
        b'{"asset":{"version":"2.0"},"nodes":{}}',
        b'{"asset":{"version":"2.0"},"scene":1e400}',
        struct.pack("<4s2I", b"glTF", 2, 12),
        struct.pack("<4s4I", b"glTF", 2, 1 << 31, 1 << 31, 0x4E4F534A),
        struct.pack("<4s4I", b"glTF", 2, 20, 0xFFFFFFFF, 0x4E4F534A),
    ],
)
def test_what_is_no_gltf_is_one_sentence(tmp_path, text):
    file = tmp_path / "s.glb"
    file.write_bytes(text)
    with pytest.raises(InputError) as told:
        read_scene(file)
    assert "\n" not in str(told.value)


def test_what_a_file_requires_and_is_not_known(tmp_path):
    with pytest.raises(UnsupportedError, match="requires VENDOR_geometry, EXT_x, which are not read"):
        read_scene(
            written(
                tmp_path / "s.gltf",
                broken(put("extensionsRequired", ["KHR_materials_ior", "VENDOR_geometry", "EXT_x"])),
            )
        )
    with pytest.raises(
        UnsupportedError, match="KHR_materials_sheem, which is not read; did you mean 'KHR_materials_sh"
    ):
        read_scene(written(tmp_path / "s.gltf", broken(put("extensionsRequired", ["KHR_materials_sheem"]))))


def test_nodes_may_be_nested_deep(tmp_path):
    nodes: list[dict[str, Any]] = [{"children": [k + 1], "translation": [1, 0, 0]} for k in range(20_000)]
    scene = read_scene(written(tmp_path / "s.gltf", broken(put("nodes", [*nodes, {"mesh": 0}]))))
    assert scene.low[0] == pytest.approx(19_999)


def mutated(data: bytes, rng: random.Random) -> bytes:
    made = bytearray(data)
    kind = rng.randrange(4)
    if kind == 0:
        return bytes(made[: rng.randrange(len(made))])
    for _ in range(rng.randrange(1, 8)):
        at = rng.randrange(len(made)) if kind == 1 else rng.randrange(min(len(made), 2500))  # the header and the JSON
        if kind == 3:
            made[at] = rng.choice(b'0123456789-eE.[]{},:"')
        else:
            made[at] = rng.randrange(256)
    return bytes(made)


def with_everything() -> dict[str, Any]:
    """A scene with every property, a camera, a sampler, and images beside it and inside."""
    extensions = {
        f"KHR_materials_{row[1]}": {row[2]: 0.5 if len(row[4]) == 1 else [0.5] * 3, row[3]: {"index": 0}}
        for row in SPECIFIED
        if row[1] not in ("", "pbr")
    }
    doc = document([{**ROUGH, "extensions": extensions}], [ramp(4, 8)])
    doc["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}]
    doc["nodes"].append({"camera": 0, "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]})
    doc["samplers"] = [{"wrapS": 33071}]
    doc["textures"][0]["sampler"] = 0
    return doc


@pytest.mark.parametrize("count", [150, pytest.param(600, marks=pytest.mark.long)])
def test_anything_at_all_is_read_or_refused(tmp_path, count):
    rng = random.Random(5)
    doc = with_everything()
    read_scene(written(tmp_path / "whole.gltf", doc))
    whole = as_glb(tmp_path / "whole.glb", doc).read_bytes()
    refused, file = 0, tmp_path / "s.glb"
    tracemalloc.start()
    for k in range(count):
        if k % 2:
            file.write_bytes(mutated(whole, rng))
        else:
            written(file, changed(doc, rng))
        try:
            scene = read_scene(file)
            for engine in ("raw", "khronos"):
                needs(scene, ENGINES[engine])
        except WhitefurnaceError as error:
            refused += 1
            assert "\n" not in str(error), str(error)
            assert isinstance(error, InputError | UnsupportedError | FileError)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert refused > count / 3 and peak < 100e6, (refused, peak)  # the file itself is 10 kB


@pytest.mark.parametrize("count", [250, pytest.param(4000, marks=pytest.mark.long)])
def test_a_value_of_any_type_anywhere_in_a_glTF_is_read_or_refused(tmp_path, count):
    """Every value is replaced by one of every type; `count` of these files."""
    doc = with_everything()
    doc["nodes"][0]["extensions"] = {"KHR_lights_punctual": {"light": 0}}
    doc["meshes"][0]["primitives"][0]["extensions"] = {"KHR_materials_variants": {"mappings": [{"material": 0}]}}
    texture = doc["materials"][0]["pbrMetallicRoughness"]["metallicRoughnessTexture"]
    texture["extensions"] = {"KHR_texture_transform": {"scale": [1, 1], "offset": [0, 0], "rotation": 0, "texCoord": 0}}
    doc["images"][0] = {"bufferView": 3, "mimeType": "image/png"}
    data = encode_png(ramp(4, 8))
    doc["bufferViews"].append({"buffer": 1, "byteOffset": 0, "byteLength": len(data)})
    doc["buffers"].append({"byteLength": len(data), "uri": uri(data)})
    doc["extensionsRequired"] = ["KHR_texture_transform"]
    read_scene(written(tmp_path / "whole.gltf", doc))
    changes = random.Random(6).sample(every(doc), count)
    refused, wrong, file = 0, [], tmp_path / "s.gltf"
    for path, value in changes:
        made = with_value(doc, path, value)
        try:
            needs(read_scene(written(file, made)), ENGINES["raw"])
        except WhitefurnaceError as error:
            refused += 1
            if "\n" in str(error) or len(str(error)) > 500:
                wrong.append((path, value, str(error)))
        except Exception as error:
            wrong.append((path, value, repr(error)))
    assert not wrong, (len(wrong), wrong[:9])
    assert len(changes) / 3 < refused < len(changes)


# ------------------------------------------------------------------------------------------------- others' files

SAMPLES = os.environ.get("WHITEFURNACE_GLTF_SAMPLES", "")


@pytest.mark.skipif(not SAMPLES, reason="WHITEFURNACE_GLTF_SAMPLES names no folder of Khronos' sample models")
def test_the_sample_models_are_read():
    files = [*Path(SAMPLES).rglob("*.gltf"), *Path(SAMPLES).rglob("*.glb")]
    assert files
    for file in files:
        try:
            scene = read_scene(file)
        except UnsupportedError:
            continue
        assert scene.materials or not scene.low, file
        needs(scene, ENGINES["raw"])
