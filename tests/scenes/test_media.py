"""The scale of a scene: what its media ask for, where a pixel's size is from, and the table that follows."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from scenes import document, written
from whitefurnace.batch import jobs as batch
from whitefurnace.cli import cli, main
from whitefurnace.scenes import media
from whitefurnace.scenes.materials import Scene, read_scene

pytest.importorskip("pygltflib")


def volume(name: str = "inside", thickness: float = 0.1, **values: Any) -> dict[str, Any]:
    return {
        "name": name,
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0.5},
        "extensions": {
            "KHR_materials_transmission": {"transmissionFactor": 1},
            "KHR_materials_volume": {"thicknessFactor": thickness, **values},
        },
    }


def matte(name: str) -> dict[str, Any]:
    return {"name": name, "pbrMetallicRoughness": {"metallicFactor": 0}}


def scene_of(tmp_path: Path, *materials: dict[str, Any], **more: Any) -> Scene:
    return read_scene(written(tmp_path / "scene.gltf", {**document(list(materials)), **more}))


def judged(scene: Scene, *named: str, pixel: str | None = None) -> tuple[media.Inside, ...]:
    return media.inside(scene, media.pixel_of(scene, pixel), media.named_media(named, scene))


def with_camera(scene: dict[str, Any], *cameras: tuple[dict[str, Any], list[float]]) -> dict[str, Any]:
    """The document with cameras, each at a place and looking along -z."""
    scene = json.loads(json.dumps(scene))
    scene["cameras"] = [camera for camera, _ in cameras]
    scene["nodes"] += [{"camera": k, "translation": place} for k, (_, place) in enumerate(cameras)]
    scene["scenes"] = [{"nodes": list(range(len(scene["nodes"])))}]
    return scene


def test_a_volume_lets_through_what_its_extension_says(tmp_path):
    (one,) = judged(
        scene_of(tmp_path, volume(thickness=0.3, attenuationDistance=0.1, attenuationColor=[0.9, 0.5, 0.25]))
    )
    assert one.judgement is not None and one.judgement.absorption is not None and one.judgement.transport is None
    # Beer's law in the extension's own form: colour^(thickness / distance)
    assert one.judgement.absorption.transmittance == pytest.approx((0.9**3, 0.5**3, 0.25**3), rel=1e-12)
    assert one.judgement.absorption.verdict == "matters" and one.table is None


def test_a_glass_of_water_is_clear_and_a_pool_is_not(tmp_path):
    # Hoffman's slide. [PopeFry1997] has .34/m at 650 nm: 2 % in 6 cm, half in 2 m.
    scene = scene_of(tmp_path, volume("glass", 0.06), volume("pool", 2.0))
    glass, pool = judged(scene, "glass:water", "pool:water")
    assert glass.judgement.absorption.verdict == "negligible" and pool.judgement.absorption.verdict == "matters"
    assert 0.3 < pool.judgement.absorption.transmittance[0] < 0.7  # red; of a band of it, not of one wavelength


@pytest.mark.parametrize(("pixel", "verdict"), [("5cm", "local"), ("0.1mm", "subsurface")])
def test_skin_from_afar_and_in_close_up(tmp_path, pixel, verdict):
    # Its red light goes millimetres (mean free path 1/(.032 + .74) = 1.3 mm): [Jensen2001].
    (face,) = judged(scene_of(tmp_path, matte("face")), "face:skin1", pixel=pixel)
    assert face.judgement.transport.verdict == verdict
    assert face.judgement.transport.mean_free_path[0] == pytest.approx(1.3e-3, abs=0.05e-3)
    assert (face.table is not None) == (verdict == "subsurface")


def test_coefficients_are_per_millimetre_and_replace_the_file(tmp_path):
    scene = scene_of(tmp_path, volume("wax", 0.02, attenuationDistance=1, attenuationColor=[0.1, 0.1, 0.1]))
    by_number = judged(scene, "wax:σa=.002/.004/.007,σs=2/3/4,g=.25,ior=1.4", pixel="1mm")[0]
    medium = by_number.judgement.medium
    assert medium.absorption == pytest.approx((2, 4, 7)) and medium.scattering == pytest.approx((2000, 3000, 4000))
    assert (medium.g, medium.ior) == (0.25, 1.4)
    given = dict(one.split("=") for one in by_number.table["set"])
    # The dipole has σs' = σs(1 - g) alone.
    assert [float(given[f"scattering_{c}"]) * (1 - float(given["g"])) for c in "rgb"] == pytest.approx([1.5, 2.25, 3])
    by_distance = judged(scene, "wax:distance=10cm,color=.9/.5/.1,sigma_s=1")[0].judgement.medium
    assert by_distance.absorption == pytest.approx([-10 * math.log(c) for c in (0.9, 0.5, 0.1)])
    assert by_distance.scattering == (1000, 1000, 1000) and by_distance.ior == 1.5


def test_the_size_is_the_thickness_or_the_least_side_of_the_scene(tmp_path):
    # The square is 2 m × 2 m × 0.
    scene = scene_of(tmp_path, volume("thick", 0.01), volume("thin", 0), matte("matte"))
    thick, thin, matte_, whole = judged(scene, "matte:wholemilk", "marble")
    assert thick.judgement.size == 0.01 and matte_.judgement.size == 2 and whole.judgement.size == 2
    assert thin.judgement is None and "thin walls" in thin.reason and whole.material == ""


def test_a_pixel_of_a_camera_is_at_the_nearest_of_the_scene(tmp_path):
    doc = document([matte("a")])
    perspective = {"type": "perspective", "perspective": {"yfov": math.pi / 2, "znear": 0.1}, "name": "close"}
    wide = {"type": "orthographic", "orthographic": {"xmag": 8, "ymag": 8, "znear": 0.1, "zfar": 9}, "name": "wide"}
    scene = read_scene(written(tmp_path / "a.gltf", with_camera(doc, (perspective, [0, 0, 3]), (wide, [0, 0, 5]))))
    pixel = media.pixel_of(scene, None, 1000)
    # 3 m before the square, under 90°: 6 m high in 1000 rows
    assert pixel is not None and pixel.metres == pytest.approx(6e-3) and pixel.of == "close"
    aside = read_scene(written(tmp_path / "b.gltf", with_camera(doc, (perspective, [4, 5, 0]))))
    assert media.pixel_of(aside, None, 100).metres == pytest.approx(2 * 5 / 100)  # of the corner (1, 1, 0): √(3² + 4²)
    alone = read_scene(written(tmp_path / "c.gltf", with_camera(doc, (wide, [0, 0, 5]))))
    assert media.pixel_of(alone, None, 1000).metres == pytest.approx(16e-3)
    assert media.pixel_of(scene, "0.5mm").metres == pytest.approx(5e-4)


def run(*arguments: str) -> tuple[int, list[dict[str, Any]]]:
    done = CliRunner().invoke(cli, ["scene", *arguments, "--json"])
    if done.exception and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, [json.loads(line) for line in done.stdout.splitlines()]


def test_the_table_is_baked_and_is_in_the_job(tmp_path):
    file = written(tmp_path / "s.gltf", document([{**matte("a/../b: c"), "extensions": {"KHR_materials_unlit": {}}}]))
    wanted = (str(file), "--environment", "demo", "--pixel", "0.1mm", "--medium", "a/../b: c:skin1")
    code, rows = run(*wanted, "-o", str(tmp_path / "out"))
    (medium,) = [row for row in rows if row["event"] == "medium"]
    assert code == 0 and medium["subsurface"] and medium["material"] == "a/../b: c"
    # Nothing else is needed of what is unlit.
    made = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert (
        made
        == ["diffusion_a_b_c.npy", "diffusion_a_b_c.npy.json"]
        == [medium["table"]["output"], medium["table"]["output"] + ".json"]
    )
    table = np.load(tmp_path / "out" / made[0])
    # Over the circle it keeps what arrives, 1/π in the mean: 64 midpoints of n·l see that, weighted 1/√(1 - x²),
    # within 1 % (the ends of the weight).
    x = (np.arange(64) + 0.5) / 32 - 1
    share = np.diff(np.arcsin(np.linspace(-1, 1, 65))) / math.pi
    assert x.size == table.shape[1] and np.allclose(
        share @ np.asarray(table, float).swapaxes(0, 1).reshape(64, -1), 1 / math.pi, rtol=0.01
    )
    job = tmp_path / "job.toml"
    assert run(*wanted, "--job", str(job))[0] == 0
    (item,) = batch.job(job).items
    assert item.kind == "lut" and Path(item.output).name == made[0]


def test_without_a_scale_nothing_is_judged(tmp_path):
    file = written(tmp_path / "s.gltf", document([volume()]))
    assert not [row for row in run(str(file))[1] if row["event"] == "medium"]
    assert (
        "no material has a volume"
        in CliRunner()
        .invoke(cli, ["scene", str(written(tmp_path / "t.gltf", document([matte("a")]))), "--pixel", "1mm"])
        .stdout
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--pixel", "5"), "has a unit"),
        (("--pixel", "1mm", "--resolution", "9"), "not both"),
        (("--resolution", "1080"), "has none: give --pixel"),
        (("--resolution", "0"), "outside [1, 16384]"),
        (("--medium", "sikn1"), "did you mean 'skin1'"),
        (("--medium", "waxx:skin1"), "did you mean 'wax'"),
        (("--medium", "wax:σa=1/2"), "one number, or three"),
        (("--medium", "wax:sa=1"), "is not one of"),
        (("--medium", "wax:σa=x"), "is not a number"),
        (("--medium", "wax:distance=1m"), "together"),
        (("--medium", "wax:distance=1m,color=.5,σa=1"), "give σa, or"),
        (("--medium", "wax:σa=1,σa=2"), "twice"),
        (("--medium", "wax:skin1", "--medium", "wax:skin2"), "already"),
        (("--medium", "wax:σs=-1"), "from 0"),
        (("--medium", "wax:g=1"), "outside (-1, 1)"),
        (("--medium", "wax:ior=9"), "outside [1, 3]"),
    ],
)
def test_what_is_wrong_is_one_sentence_before_anything_else(tmp_path, capsys, options, message):
    file = written(tmp_path / "s.gltf", document([matte("wax")]))
    with pytest.raises(SystemExit) as ended:
        main(["scene", str(file), *options])
    told = capsys.readouterr()
    assert ended.value.code == 1 and not told.out
    assert message in told.err and len(told.err.strip().splitlines()) == 1
