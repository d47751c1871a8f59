"""`bake` from end to end, as a command and from Python: what it writes, what it refuses, and that it never leaves
anything half-written."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import inspect
import json
import math
import os
import random
import signal
import subprocess
import time
import zlib
from importlib import resources
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from exr_writer import Part, exr, planes
from reference import cube_directions
from shell import command, mounted, tree
from whitefurnace import bake, dfg, prefilter
from whitefurnace.baking.request import BakeRequest
from whitefurnace.errors import UsageError
from whitefurnace.files import Transaction, read_image, write_exr
from whitefurnace.opencl import source as kernels
from whitefurnace.opencl.device import Device
from whitefurnace.sphere.environments import cube_solid_angles, latlong_solid_angles

SMALL = ("--size", "32", "--min-size", "8")
SIZES = dict(size=32, min_size=8)
LEVELS = ((32, 0.0), (16, 1 - math.sqrt(0.5)), (8, 1.0))  # r_k = 1 - √(1 - k/(n-1)), n = 3


# --- helpers --------------------------------------------------------------------------------------------


def noise(seed=0, height=32, channels=3):
    return np.random.default_rng(seed).random((height, 2 * height, channels), dtype=np.float32)


def image(path: Path, pixels) -> Path:
    write_exr(path, pixels, channel_names="RGBA"[: pixels.shape[-1]])
    return path


def verified(folder: Path, name="a") -> dict:
    """The manifest of an output after a check of all it proves; nothing else may lie in the folder."""
    manifest = json.loads((folder / f"{name}.json").read_text())
    files = tree(folder)
    for relative, entry in manifest["files"].items():
        assert hashlib.sha256(files[relative]).hexdigest() == entry["sha256"], relative
        assert len(files[relative]) == entry["bytes"], relative
    assert set(files) == {*manifest["files"], f"{name}.json"}
    return manifest


def load(folder: Path, name="a") -> dict[str, np.ndarray]:
    with np.load(folder / "raw" / f"{name}.npz") as archive:
        return dict(archive)


def read_exr(path: Path):
    source = oiio.ImageInput.open(str(path))
    assert source is not None, oiio.geterror()
    pixels, spec = np.asarray(source.read_image("float")), source.spec()
    source.close()
    return pixels, spec


def latlong_directions(h, w):
    """u = atan2(z, x)/2π + ½ from left to right, v = acos(y)/π from the top."""
    v, u = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(w) + 0.5) / w, indexing="ij")
    azimuth, ring = 2 * np.pi * (u - 0.5), np.sin(np.pi * v)
    return np.stack([ring * np.cos(azimuth), np.cos(np.pi * v), ring * np.sin(azimuth)], -1)


@pytest.fixture(scope="module")
def coded(tmp_path_factory):
    """A bake, with raw and exr, of the image whose colour is its direction: (folder, source)."""
    folder = tmp_path_factory.mktemp("coded")
    source = image(folder / "a.exr", ((latlong_directions(32, 64) + 1) / 2).astype(np.float32))
    bake(source, folder / "out", for_="raw,exr", **SIZES)
    return folder / "out", source


# --- what is written ------------------------------------------------------------------------------------


def test_npz_holds_what_the_design_says(coded):
    arrays = load(coded[0])
    shapes = {f"specular_{k}": (6, size, size, 3) for k, (size, _) in enumerate(LEVELS)}
    shapes |= {key: (3,) for key in ("roughness", "error", "worst", "rmse")}
    shapes |= {"irradiance": (6, 32, 32, 3), "sh": (9, 3), "dfg": (128, 128, 2)}
    assert {key: a.shape for key, a in arrays.items()} == shapes
    for key, a in arrays.items():
        single = key.startswith("specular") or key in ("irradiance", "dfg")
        assert a.dtype == (np.float32 if single else np.float64), key
        assert np.isfinite(a).all() and (key == "sh" or (a >= 0).all()), key
    # The formula itself in float64; the two sides differ by rounding at most.
    np.testing.assert_allclose(arrays["roughness"], [r for _, r in LEVELS], rtol=1e-15)


# Half a diagonal of a source texel, .098 rad · √2 / 2, in a code that halves distances, plus the pull of a texel's
# mean towards the middle; a turned or swapped face is off by 0.1 to 1.
PLACED = 0.05


def test_exr_strip_and_latlong_are_placed_as_the_cube(coded):
    folder, _ = coded
    arrays = load(folder)
    for k, (size, r) in enumerate(LEVELS):
        strip, spec = read_exr(folder / "exr" / f"a_specular_{k}.exr")
        assert spec.channelnames == ("R", "G", "B") and str(spec.format) == "float"
        assert strip.shape == (6 * size, size, 3)
        np.testing.assert_array_equal(strip.reshape(6, size, size, 3), arrays[f"specular_{k}"])
        wide, _ = read_exr(folder / "exr" / f"a_specular_{k}_latlong.exr")
        assert wide.shape == (2 * size, 4 * size, 3)
        # A lobe about a direction keeps it and shortens it: colours are ½ + c·d/2 with one c in (0, 1] a level.
        cube = arrays[f"specular_{k}"]
        for got, d in ((cube, cube_directions(size)), (wide, latlong_directions(2 * size, 4 * size))):
            c = float(((2 * got - 1) * d).sum(-1).mean())
            assert (0.9 if r < 0.5 else 0.5) < c < 1.001
            assert np.abs(got - (1 + c * d) / 2).max() < PLACED, f"level {k} of shape {got.shape}"
    e, _ = read_exr(folder / "exr" / "a_irradiance.exr")
    np.testing.assert_array_equal(e.reshape(6, 32, 32, 3), arrays["irradiance"])
    # E/π of ½ + d/2 is ½ + d/3: the cosine lobe keeps ⅔ of degree 1. The source's texels cost about .098²/24.
    assert np.abs(e.reshape(6, 32, 32, 3) - (0.5 + cube_directions(32) / 3)).max() < 2e-3
    table, spec = read_exr(folder / "exr" / "a_dfg.exr")
    assert spec.channelnames == ("R", "G")
    np.testing.assert_array_equal(table, arrays["dfg"])


def test_exr_carries_its_provenance(coded):
    folder, _ = coded
    manifest = verified(folder)
    for path in sorted((folder / "exr").iterdir()):
        _, spec = read_exr(path)
        told = {a.name: a.value for a in spec.extra_attribs}
        assert told["whitefurnace:version"] == manifest["whitefurnace"]
        assert told["whitefurnace:key"] == manifest["key"]
        assert told["whitefurnace:source"] == manifest["source"]["sha256"]
        assert json.loads(told["whitefurnace:recipe"]) == manifest["recipe"]
        assert told["whitefurnace:error"] >= 0
        assert not {"DateTime", "capDate", "Software"} & set(told), path
    for k, level in enumerate(manifest["levels"]):
        told = {a.name: a.value for a in read_exr(folder / "exr" / f"a_specular_{k}.exr")[1].extra_attribs}
        for statistic in ("roughness", "error", "worst", "rmse"):
            # Attributes are float32.
            assert told[f"whitefurnace:{statistic}"] == pytest.approx(level[statistic], rel=1e-6), statistic


def test_manifest_proves_the_rest(coded):
    folder, source = coded
    manifest = verified(folder)
    assert manifest["name"] == "a"
    assert manifest["source"]["sha256"] == hashlib.sha256(source.read_bytes()).hexdigest()
    assert {"raw/a.npz", "exr/a_dfg.exr", "exr/a_irradiance.exr"} < set(manifest["files"])
    assert {"name", "platform", "driver"} <= set(manifest["device"])
    arrays = load(folder)
    for statistic in ("roughness", "error", "worst", "rmse"):
        assert [level[statistic] for level in manifest["levels"]] == arrays[statistic].tolist()
    for level in [*manifest["levels"], *manifest["latlong_levels"], manifest["irradiance"]]:
        assert level["error"] <= 1e-3 and {"method", "pairs", "worst", "rmse"} <= set(level)
    energy = [level["energy_kept"] for level in manifest["levels"]]
    # Level 0 are exact means in float32. Texel centres of rough levels integrate a smooth function: h²/24 of its
    # curvature, for 8² faces and degree 1, which sums to 0 over opposite texels but for rounding.
    assert energy == pytest.approx([1, 1, 1], abs=1e-5)
    text = json.dumps(manifest)
    assert not any(word in text for word in ("seconds", "date", 'time"')), "a manifest holds no times"


def test_a_second_bake_elsewhere_gives_the_same_bytes(coded, tmp_path):
    folder, source = coded
    arguments = ("bake", source, "-o", tmp_path / "b", *SMALL, "--for", "exr,raw")
    done = subprocess.run(command(*arguments), capture_output=True)
    assert done.returncode == 0, done.stderr
    assert tree(tmp_path / "b") == tree(folder)


def test_coverage_is_kept(tmp_path):
    rng = np.random.default_rng(3)
    faces = rng.random((6, 32, 32, 4), dtype=np.float32)
    source = image(tmp_path / "a.exr", faces.reshape(192, 32, 4))
    bake(source, tmp_path / "out", for_="raw,exr", **SIZES)
    arrays = load(tmp_path / "out")
    np.testing.assert_array_equal(arrays["coverage_0"], faces[..., 3])  # same texels: level 0 is the source
    np.testing.assert_array_equal(arrays["specular_0"], faces[..., :3])
    alone = prefilter(np.repeat(faces[..., 3:], 3, -1), **SIZES)
    for k, (size, _) in enumerate(LEVELS):
        coverage = arrays[f"coverage_{k}"]
        assert coverage.shape == (6, size, size) and coverage.dtype == np.float32
        np.testing.assert_array_equal(coverage, alone.values[k][..., 0])
        strip, spec = read_exr(tmp_path / "out" / "exr" / f"a_specular_{k}.exr")
        assert spec.channelnames == ("R", "G", "B", "A")
        np.testing.assert_array_equal(strip[..., 3].reshape(6, size, size), coverage)
        np.testing.assert_array_equal(strip[..., :3].reshape(6, size, size, 3), arrays[f"specular_{k}"])
        wide, spec = read_exr(tmp_path / "out" / "exr" / f"a_specular_{k}_latlong.exr")
        assert spec.channelnames[3] == "A"
        # The mean of the lat-long's and of the cube's coverage, each with its solid angles: the same integral. A
        # texel mean is exact; a lobe's centre samples of 8² faces of noise are good to 1e-2.
        band = np.sin(np.pi * (np.arange(2 * size) + 0.5) / (2 * size))
        mean = (wide[..., 3].mean(1) * band).sum() / band.sum()
        assert mean == pytest.approx((coverage * cube_solid_angles(size)).sum() / (4 * np.pi), abs=1e-2)


# --- running again --------------------------------------------------------------------------------------


def test_a_second_run_skips_and_another_option_replaces(tmp_path, shell):
    source, out = image(tmp_path / "a.exr", noise()), tmp_path / "out"
    arguments = ("bake", source, "-o", out, *SMALL)
    assert shell(*arguments) == 0 and "wrote" in shell.out
    first, stamp = tree(out), (out / "raw" / "a.npz").stat().st_mtime_ns
    assert shell(*arguments) == 0 and "up to date" in shell.out
    assert (tree(out), (out / "raw" / "a.npz").stat().st_mtime_ns) == (first, stamp)
    assert shell(*arguments, "--force") == 0 and "wrote" in shell.out
    assert tree(out) == first
    assert shell(*arguments, "--exposure", "1") == 0 and "wrote" in shell.out
    assert verified(out)["key"] != json.loads(first["a.json"])["key"] and tree(out) != first
    image(source, noise(1))  # another picture under the same name
    assert shell(*arguments, "--exposure", "1") == 0 and "wrote" in shell.out
    verified(out)


@pytest.mark.parametrize(
    "option",
    [
        ("--size", "16"),
        ("--min-size", "16"),
        ("--rotate", "10"),
        ("--exposure", ".5"),
        ("--tolerance", "2e-3"),
        ("--nonfinite", "zero"),
        ("--for", "raw,exr"),
    ],
)
def test_every_option_that_changes_the_output_changes_the_key(tmp_path, shell, option):
    source = image(tmp_path / "a.exr", noise(height=4))
    keys = []
    for extra in ((), option):
        assert shell("bake", source, "-o", tmp_path / "out", *SMALL, *extra, "--dry-run", "--json") == 0
        keys.append(shell.rows()[-1]["key"])
    assert keys[0] != keys[1]


def test_what_is_kept_between_images_is_the_right_one(tmp_path):
    """In one process: two NDFs, two parameters of one, and a user's file that is edited between bakes and keeps its
    name. Each bake has the table of its own NDF, and what was baked before is not taken for it."""
    lobe, picture = tmp_path / "mine.clh", noise(height=4)
    sizes, tables, keys = dict(size=8, min_size=8), [], []
    for k, ndf in enumerate(["ggx", "abc:c=2", "abc:c=3", lobe, lobe, "ggx"]):
        if ndf is lobe:
            lobe.write_text(f"real ndf_mine_D(real cos_m, real alpha) {{ return {k + 1}.0f * cos_m + alpha; }}\n")
        (baked,) = bake(picture, tmp_path / str(k), ndf=ndf, **sizes)
        tables.append(np.load(tmp_path / str(k) / "raw" / "array.npz")["dfg"])
        keys.append(baked.manifest["key"])
        assert np.array_equal(tables[k], dfg(tables[k].shape[0], ndf=ndf).values), ndf
    assert len(set(keys)) == len(keys) - 1 and keys[0] == keys[-1]
    assert len({table.tobytes() for table in tables}) == len(tables) - 1


@pytest.mark.parametrize("where", ["raw/a.npz", "a.json"])
def test_a_foreign_file_is_refused_and_untouched(tmp_path, shell, where):
    source, out = image(tmp_path / "a.exr", noise()), tmp_path / "out"
    (out / where).parent.mkdir(parents=True)
    (out / where).write_bytes(b"somebody's thesis")
    assert shell("bake", source, "-o", out, *SMALL) == 2
    assert "--force" in shell.sentence() and str(out / where) in shell.err
    assert tree(out) == {where: b"somebody's thesis"}
    assert shell("bake", source, "-o", out, *SMALL, "--dry-run") == 2
    assert shell("bake", source, "-o", out, *SMALL, "--force") == 0
    verified(out)


def test_a_file_of_ours_that_was_changed_counts_as_foreign(tmp_path, shell):
    source, out = image(tmp_path / "a.exr", noise()), tmp_path / "out"
    arguments = ("bake", source, "-o", out, *SMALL)
    assert shell(*arguments) == 0
    with open(out / "raw" / "a.npz", "ab") as file:
        file.write(b"edited")
    changed = tree(out)
    assert shell(*arguments) == 2 and "raw" in shell.sentence()
    assert shell(*arguments, "--exposure", "1") == 2
    assert tree(out) == changed
    assert shell(*arguments, "--force") == 0
    verified(out)


def test_a_file_that_is_gone_is_made_again(tmp_path, shell):
    source, out = image(tmp_path / "a.exr", noise()), tmp_path / "out"
    assert shell("bake", source, "-o", out, *SMALL) == 0
    before = tree(out)
    (out / "raw" / "a.npz").unlink()
    assert shell("bake", source, "-o", out, *SMALL) == 0 and "wrote" in shell.out
    assert tree(out) == before


@pytest.mark.parametrize(
    "manifest",
    [
        '{"whitefurnace": "0", "name": "a"}',
        '{"whitefurnace": "0", "name": "a", "files": [1]}',
        '{"whitefurnace": "0", "name": "a", "files": {"raw/a.npz": "x"}}',
        '{"whitefurnace": "0", "name": "b", "files": {}}',
        "[]",
        "{",
    ],
)
def test_a_damaged_manifest_proves_nothing(tmp_path, shell, manifest):
    source, out = image(tmp_path / "a.exr", noise()), tmp_path / "out"
    (out / "raw").mkdir(parents=True)
    (out / "a.json").write_text(manifest)
    (out / "raw" / "a.npz").write_bytes(b"not ours")
    before = tree(out)
    assert shell("bake", source, "-o", out, *SMALL) == 2
    shell.sentence()
    assert tree(out) == before


# --- the command ----------------------------------------------------------------------------------------


def test_two_inputs_of_one_stem_are_refused(tmp_path, shell):
    (tmp_path / "x").mkdir()
    one, two = image(tmp_path / "a.exr", noise()), image(tmp_path / "x" / "a.exr", noise(1))
    assert shell("bake", one, two, "-o", tmp_path / "out", *SMALL) == 1
    assert "'a'" in shell.sentence()
    assert not (tmp_path / "out").exists()
    with pytest.raises(UsageError):
        bake([one, two], tmp_path / "out")


def test_dry_run_writes_nothing(tmp_path, shell):
    source, out = image(tmp_path / "a.exr", noise()), tmp_path / "out"
    assert shell("bake", source, "-o", out, *SMALL, "--for", "raw,exr", "--dry-run") == 0
    assert "would write" in shell.out and "a_specular_2_latlong.exr" in shell.out
    assert not out.exists()
    assert shell("bake", source, "-o", out, *SMALL, "--for", "raw,exr") == 0
    (plan,) = bake(source, out, for_="raw,exr", exposure=1, dry_run=True, **SIZES)
    planned = {p.relative_to(out).as_posix() for p in plan.files}
    assert planned == set(verified(out)["files"])


def test_json_is_json_lines_only(tmp_path, shell):
    source, out = image(tmp_path / "a.exr", noise()), tmp_path / "out"
    for arguments, last in ((("--dry-run",), "planned"), ((), "done"), ((), "skipped")):
        assert shell("bake", source, "-o", out, *SMALL, "--json", *arguments) == 0
        rows = shell.rows()
        kernels = sum(row["event"] == "kernel" for row in rows)
        shown = ["kernel"] * kernels + ["as_read"] * (len(rows) - 4 - kernels) if arguments else []
        assert [row["event"] for row in rows] == ["level"] * 3 + shown + [last]
        assert [(row["size"], round(row["roughness"], 6)) for row in rows[:3]] == [(n, round(r, 6)) for n, r in LEVELS]
        assert {"key", "files", "seconds"} <= set(rows[-1]) and shell.err == ""
    assert shell("bake", tmp_path / "none.exr", "-o", out, "--json") == 2
    assert shell.rows() == [{"event": "error", "message": shell.sentence()[7:], "exit_code": 2}]


def test_quiet_prints_nothing(tmp_path, shell):
    pixels = noise()
    pixels[3, 4] = -1
    source, out = image(tmp_path / "a.exr", pixels), tmp_path / "out"
    for _ in range(2):
        assert shell("bake", source, "-o", out, *SMALL, "--quiet", "--nonfinite", "zero") == 0
        assert (shell.out, shell.err) == ("", "")
    assert shell("bake", tmp_path / "none.exr", "-o", out, "--quiet") == 2
    assert shell.out == "" and shell.sentence()


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("--for", "rwa"), ("rwa", "'raw'")),
        (("--for", ""), ("raw",)),
        (("--for", "raw,exx"), ("'exr'",)),
        (("--ndf", "gxg"), ("gxg", "'ggx'")),
        (("--ndf", "ggx:alpha=.3"), ("alpha",)),
        (("--ndf", "ggx:beta=1"), ("beta",)),
        (("--quality", "norml"), ("norml", "'normal'")),
        (("--quality", "draft", "--tolerance", "1e-2"), ("not both",)),
        (("--tolerance", "0"), ("tolerance", "1e-05")),
        (("--tolerance", "nan"), ("tolerance",)),
        (("--size", "100"), ("100", "power of two", "2048")),
        (("--size", "8192"), ("8192",)),
        (("--size", "0"), ("size",)),
        (("--size", "8", "--min-size", "16"), ("16", "8")),
        (("--size", "x"), ("x",)),
        (("--rotate", "nan"), ("rotate",)),
        (("--rotate", "inf"), ("rotate",)),
        (("--exposure", "nan"), ("exposure",)),
        (("--exposure", "100"), ("64",)),
        (("--nonfinite", "keep"), ("keep", "refuse", "zero")),
        (("--sise", "32"), ("--size",)),
    ],
)
def test_usage_errors_exit_1_and_name_the_range_or_the_nearest(tmp_path, shell, arguments, words):
    source = image(tmp_path / "a.exr", noise(height=2))
    assert shell("bake", source, "-o", tmp_path / "out", *arguments) == 1
    for word in words:
        assert word in shell.sentence(), word
    assert not (tmp_path / "out").exists()


def test_no_output_or_no_input_is_a_usage_error(tmp_path, shell):
    assert shell("bake", "demo") == 1 and "--output" in shell.sentence()
    assert shell("bake", "-o", tmp_path) == 1
    assert shell("bakee") == 1


MY_GGX = """real ndf_my_lobe_D(real cos_m, real sin2_m, real alpha, real scale) {
  const real t = alpha * alpha + (1 - alpha) * (1 + alpha) * sin2_m;
  return scale * sqr(alpha / t);
}
"""


def test_a_model_from_a_file(tmp_path, shell):
    """GGX of any scale bakes as GGX does; the key is of the file's text, not of its name."""
    source, lobe = image(tmp_path / "a.exr", noise(height=16)), tmp_path / "my_lobe.clh"
    lobe.write_text(MY_GGX)
    for name, ndf in (("theirs", "ggx"), ("mine", f"{lobe}:scale=3")):
        assert shell("bake", source, "-o", tmp_path / name, *SMALL, "--ndf", ndf) == 0, shell.err
    theirs, mine = load(tmp_path / "theirs"), load(tmp_path / "mine")
    for k in range(len(LEVELS)):
        # Each is within the tolerance of the truth.
        assert np.abs(mine[f"specular_{k}"] / theirs[f"specular_{k}"] - 1).max() <= 2e-3
    assert np.abs(mine["dfg"] - theirs["dfg"]).max() <= 1e-5  # two tables of 5e-6
    key = verified(tmp_path / "mine")["key"]
    assert shell("bake", source, "-o", tmp_path / "mine", *SMALL, "--ndf", f"{lobe}:scale=3") == 0
    assert "up to date" in shell.out
    lobe.write_text(MY_GGX.replace("sqr(alpha / t)", "alpha / t"))
    again = ("bake", source, "-o", tmp_path / "mine", *SMALL, "--ndf", f"{lobe}:scale=3", "--dry-run", "--json")
    assert shell(*again) == 0, shell.err
    assert shell.rows()[-1]["key"] != key


@pytest.mark.parametrize(
    "text, options, code, words",
    [
        (MY_GGX, "", 1, "scale must be given"),
        (MY_GGX, ":scale=3,alpha=.2", 1, "alpha follows"),
        (MY_GGX, ":scle=3", 1, "scale"),
        (None, ":scale=3", 2, "my_lobe.clh"),
        (MY_GGX.replace("my_lobe", "other"), ":scale=3", 3, "ndf_my_lobe_D"),
        (MY_GGX.replace("scale *", "-scale *"), ":scale=3", 3, "negative"),
        ("real ndf_my_lobe_D(real cos_m, real a) { return a; }", ":a=1", 5, "roughness"),
        ("real ndf_my_lobe_D(real cos_m, real alpha) { return cosm; }", "", 3, "cosm"),
    ],
    ids=[
        "parameter missing",
        "parameter that follows",
        "unknown parameter",
        "no file",
        "other function",
        "negative",
        "no alpha",
        "does not compile",
    ],
)
def test_models_from_files_that_cannot_be_baked(tmp_path, shell, text, options, code, words):
    source, lobe = image(tmp_path / "a.exr", noise(height=4)), tmp_path / "my_lobe.clh"
    if text is not None:
        lobe.write_text(text)
    assert shell("bake", source, "-o", tmp_path / "out", *SMALL, "--ndf", f"{lobe}{options}") == code
    assert words in shell.err and not (tmp_path / "out").exists()


def test_an_unknown_device_is_a_usage_error(tmp_path, shell):
    source = image(tmp_path / "a.exr", noise(height=2))
    assert shell("bake", source, "-o", tmp_path / "out", *SMALL, "--device", "no such device") == 1
    assert "no such device" in shell.sentence()
    assert tree(tmp_path) == {"a.exr": source.read_bytes()}


# --- bad input ------------------------------------------------------------------------------------------


def chunk(kind, data):
    return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")


def png(width, height, rows):
    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 2, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def spoilt(value):
    pixels = noise()
    pixels[5, 7, 1] = value
    return pixels


def bad(kind: str, path: Path) -> Path:
    """A file of a kind of badness."""
    whole = image(path, noise()).read_bytes()
    if kind == "missing":
        path.unlink()
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("This is not the image you are looking for.\n" * 20)
    elif kind == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "corrupted":
        path.write_bytes(whole[:-3000] + bytes(range(256)) * 8 + whole[-952:])
    elif kind == "corrupted png":
        path = path.with_suffix(".png")
        data = bytearray(png(4, 2, (b"\0" + bytes(12)) * 2))
        data[-20] ^= 0xFF
        path.write_bytes(data)
    elif kind == "lying":
        path = path.with_suffix(".hdr")
        path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 200000\n" + bytes(64))
    elif kind == "lying png":
        path = path.with_suffix(".png")
        path.write_bytes(png(32768, 16384, bytes(100)))
    elif kind in ("NaN", "inf", "negative"):
        image(path, spoilt({"NaN": np.nan, "inf": np.inf, "negative": -1.0}[kind]))
    elif kind == "aspect":
        image(path, noise()[:, :40])
    elif kind == "two channels":
        write_exr(path, noise()[..., :2], channel_names=("R", "G"))
    elif kind == "folder":
        path.unlink()
        path.mkdir()
    elif kind == "five faces":
        path.unlink()
        path.mkdir()
        for face in ("px", "nx", "py", "ny", "pz"):
            image(path / f"{face}.exr", noise()[:, :32])
    return path


BAD = {
    "missing": (2,),
    "empty": (3, "empty"),
    "text": (3,),
    "truncated": (3,),
    "corrupted": (3,),
    "corrupted png": (3, "corrupted"),
    "lying": (3, "200000", "100000"),
    "lying png": (3,),
    "NaN": (3, "nan", "(7, 5)", "--bad-pixels"),
    "inf": (3, "inf", "(7, 5)"),
    "negative": (3, "-1.0", "(7, 5)"),
    "aspect": (3, "40 x 32", "latlong 2:1"),
    "two channels": (3, "2 channels"),
    "folder": (3, "px"),
    "five faces": (3, "nz"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_gets_one_sentence_and_leaves_nothing(tmp_path, shell, kind):
    code, *words = BAD[kind]
    path = bad(kind, tmp_path / "a.exr")
    before = tree(tmp_path)
    assert shell("bake", path, "-o", tmp_path / "out", *SMALL, "--for", "raw,exr") == code, shell.err
    for word in (str(path), *words):
        assert word in shell.sentence(), word
    assert tree(tmp_path) == before and not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["NaN", "inf", "negative"])
def test_nonfinite_zero_bakes_with_a_notice(tmp_path, shell, kind):
    path = bad(kind, tmp_path / "a.exr")
    assert shell("bake", path, "-o", tmp_path / "out", *SMALL, "--nonfinite", "zero") == 0
    assert shell.err.startswith("notice: a: ") and len(shell.err.splitlines()) == 1
    (notice,) = verified(tmp_path / "out")["source"]["notices"]
    assert notice in shell.err
    image(tmp_path / "a.exr", spoilt(0.0))
    bake(tmp_path / "a.exr", tmp_path / "zero", **SIZES)
    got, want = load(tmp_path / "out"), load(tmp_path / "zero")
    for k in range(3):
        np.testing.assert_array_equal(got[f"specular_{k}"], want[f"specular_{k}"])


def test_a_name_that_is_no_unicode(tmp_path):
    path = os.fsencode(tmp_path) + b"/\xff\xfe.exr"
    try:
        with open(path, "wb") as file:
            file.write(image(tmp_path / "a.exr", noise()).read_bytes())
    except (OSError, UnicodeError):
        pytest.skip("this file system has Unicode names only")
    done = subprocess.run([*command("bake", "-o", tmp_path / "out", *SMALL), path], capture_output=True)
    assert done.returncode in (0, 2) and b"Traceback" not in done.stderr, done.stderr


def test_one_broken_of_several(tmp_path, shell):
    good = [image(tmp_path / f"{name}.exr", noise(k)) for k, name in enumerate("ac")]
    broken, out = bad("truncated", tmp_path / "b.exr"), tmp_path / "out"
    assert shell("bake", good[0], broken, good[1], "-o", out, *SMALL) == 8
    assert "b.exr" in shell.err and "1 of 3" in shell.err
    assert {p.name for p in out.iterdir()} == {"raw", "a.json", "c.json"}
    assert shell("bake", good[0], broken, good[1], "-o", out, *SMALL, "--json") == 8
    assert [row["event"] for row in shell.rows() if row["event"] != "level"] == ["skipped", "error", "skipped", "error"]
    assert shell("bake", broken, bad("empty", tmp_path / "d.exr"), "-o", out, *SMALL) == 3  # all, of one kind
    assert shell("bake", broken, bad("missing", tmp_path / "e.exr"), "-o", out, *SMALL) == 8


# --- places that cannot be written -----------------------------------------------------------------------


@pytest.mark.parametrize("where", ["out", "out/raw"])
def test_a_file_where_a_folder_is_needed(tmp_path, shell, where):
    source = image(tmp_path / "a.exr", noise())
    (tmp_path / where).parent.mkdir(exist_ok=True)
    (tmp_path / where).write_bytes(b"a file")
    before = tree(tmp_path)
    for force in ((), ("--force",)):
        assert shell("bake", source, "-o", tmp_path / "out", *SMALL, *force) == 2
        assert str(tmp_path / "out") in shell.sentence()
        assert tree(tmp_path) == before


def test_a_folder_where_a_file_is_needed(tmp_path, shell):
    source = image(tmp_path / "a.exr", noise())
    (tmp_path / "out" / "raw" / "a.npz").mkdir(parents=True)
    for force in ((), ("--force",)):
        assert shell("bake", source, "-o", tmp_path / "out", *SMALL, *force) == 2
        shell.sentence()
        assert tree(tmp_path / "out") == {}


def test_a_full_disk_leaves_nothing_half_written(tmp_path, shell):
    source = image(tmp_path / "a.exr", noise())
    # 304 KB of npz fit, the EXRs beside it do not.
    with mounted(tmp_path / "disk", "size=400k") as out:
        assert shell("bake", source, "-o", out, *SMALL) == 0
        before = tree(out)
        for more in (("--for", "raw,exr"), ("--exposure", "1"), ("--for", "exr", "--force")):
            assert shell("bake", source, "-o", out, *SMALL, *more) == 2
            assert str(out) in shell.sentence()
            assert tree(out) == before, more
        verified(out)


def test_a_read_only_disk(tmp_path, shell):
    source = image(tmp_path / "a.exr", noise())
    with mounted(tmp_path / "disk", "ro") as out:
        for place in (out, out / "deeper"):
            assert shell("bake", source, "-o", place, *SMALL) == 2
            assert str(place) in shell.sentence()
        assert tree(out) == {}


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="permissions do not bind root, or are not POSIX's")
def test_a_folder_without_permission(tmp_path, shell):
    source, out = image(tmp_path / "a.exr", noise()), tmp_path / "out"
    out.mkdir(mode=0o500)
    assert shell("bake", source, "-o", out, *SMALL) == 2
    assert str(out) in shell.sentence() and tree(out) == {}


def test_files_that_may_not_grow(tmp_path, shell, monkeypatch):
    """A limit on file size stands in for a full disk where nothing can be mounted."""
    resource = pytest.importorskip("resource")
    source, out = image(tmp_path / "a.exr", noise()), tmp_path / "out"
    bake(source, out, **SIZES)
    before = tree(out)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    enter, leave = Transaction.__enter__, Transaction.__exit__

    # Only while results are written: the OpenCL compiler writes files too.
    def limited(self):
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
        return enter(self)

    def unlimited(self, *error):
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        leave(self, *error)

    monkeypatch.setattr(Transaction, "__enter__", limited)
    monkeypatch.setattr(Transaction, "__exit__", unlimited)
    assert shell("bake", source, "-o", out, *SMALL, "--exposure", "1") == 2
    assert str(out) in shell.sentence()
    assert tree(out) == before


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_a_full_stdout(tmp_path):
    source = image(tmp_path / "a.exr", noise())
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            command("bake", source, "-o", tmp_path / "out", *SMALL), stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == 2 and "Traceback" not in done.stderr and "Exception" not in done.stderr, done.stderr
    verified(tmp_path / "out")


@pytest.mark.parametrize("extra", [(), ("--json",)])
def test_stdout_closed_early(tmp_path, extra):
    source = image(tmp_path / "a.exr", noise())
    run = subprocess.Popen(
        command("bake", source, "-o", tmp_path / "out", *SMALL, *extra), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    run.stdout.close()
    complaint = run.stderr.read()
    run.stderr.close()
    run.wait(60)
    assert b"Traceback" not in complaint and b"Exception" not in complaint, complaint
    verified(tmp_path / "out")


# --- interruptions --------------------------------------------------------------------------------------


@pytest.mark.skipif(os.name != "posix", reason="SIGINT is sent as POSIX has it")
@pytest.mark.parametrize("delay", [0.0, 0.7])
def test_ctrl_c_leaves_nothing_half_written(tmp_path, delay):
    source, out = image(tmp_path / "a.exr", noise(height=128)), tmp_path / "out"
    # Seconds of work: the folder appears when it begins.
    arguments = ("bake", source, "-o", out, "--quality", "reference", "--size", "512", "--for", "raw,exr")
    run = subprocess.Popen(
        command(*arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    begin = time.monotonic()
    while not out.exists():
        assert run.poll() is None and time.monotonic() - begin < 60
        time.sleep(0.01)
    time.sleep(delay)
    assert run.poll() is None, "the bake was over before it could be interrupted"
    run.send_signal(signal.SIGINT)
    told, complaint = run.communicate(timeout=60)
    assert run.returncode == 130, complaint
    # click ends the terminal's line with ^C on it first.
    assert told == "" and complaint.strip().startswith("interrupted") and len(complaint.strip().splitlines()) == 1
    assert tree(out) == {}


def broken_off(monkeypatch, after: int, error: type[BaseException], cleaned: bool):
    """Makes the commit stop at a rename; with `cleaned` false nothing runs after it, as when killed."""
    count = [0]
    real = os.replace

    def replace(*names):
        count[0] += 1
        if count[0] > after:
            raise error
        real(*names)

    monkeypatch.setattr("whitefurnace.files.atomic.os.replace", replace)
    if not cleaned:
        monkeypatch.setattr(Transaction, "__exit__", lambda *_: None)


FILES = 10  # of `--for raw,exr` with three levels: .npz, 2 · 3 levels, irradiance, DFG, manifest


@pytest.mark.parametrize("cleaned", [False, True], ids=["killed", "ctrl-c"])
@pytest.mark.parametrize("again", [False, True], ids=["new", "over another"])
@pytest.mark.parametrize("after", [0, 1, FILES - 2, FILES - 1])
def test_stopped_between_renames_the_next_run_needs_no_force(tmp_path, monkeypatch, after, again, cleaned):
    source, out = image(tmp_path / "a.exr", noise(height=4)), tmp_path / "out"
    options = dict(SIZES, for_="raw,exr", tolerance=1e-2)
    if again:
        bake(source, out, **options)
    with monkeypatch.context() as patch:
        broken_off(patch, after, KeyboardInterrupt, cleaned)
        with pytest.raises(KeyboardInterrupt):
            bake(source, out, exposure=1, **options)
    bake(source, out, exposure=1, **options)
    assert len(verified(out)["files"]) == FILES - 1
    assert bake(source, out, exposure=1, **options)[0].state == "skipped"


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL is POSIX's")
@pytest.mark.parametrize("times", [2, pytest.param(10, marks=pytest.mark.long)])
def test_killed_at_random_moments_the_next_run_needs_no_force(tmp_path, times):
    rng = random.Random(5)
    source, out = image(tmp_path / "a.exr", noise(height=8)), tmp_path / "out"
    arguments = ("bake", source, "-o", out, *SMALL, "--for", "raw,exr", "--quiet")
    begin = time.monotonic()
    subprocess.run(command(*arguments), check=True)
    length = time.monotonic() - begin
    for k in range(times):
        run = subprocess.Popen(command(*arguments, "--exposure", str(k + 1)))
        time.sleep(length * rng.uniform(0.3, 1.0))  # the first third is the start of Python
        run.kill()
        run.wait()
        bake(source, out, for_="raw,exr", exposure=k + 1, **SIZES)
        verified(out)


# --- known values ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "pixels",
    [
        np.ones((32, 64, 3)),
        np.ones((1, 1, 3)),
        np.ones((1, 1)),
        np.ones((6, 4, 4, 3)),
        np.full((8, 16, 3), 1, np.float32),
    ],
    ids=lambda p: str(p.shape),
)
def test_a_constant_is_constant(tmp_path, pixels):
    pixels = np.asarray(pixels, np.float32)
    source = image(
        tmp_path / "a.exr",
        pixels.reshape(-1, pixels.shape[-2] if pixels.ndim > 2 else 1, 3)
        if pixels.ndim > 2
        else np.ones((1, 1, 3), np.float32),
    )
    (done,) = bake(source, tmp_path / "out", **SIZES)
    arrays = load(tmp_path / "out")
    for key in ("specular_0", "specular_1", "specular_2", "irradiance"):
        # The issue's figure for the white furnace: eight units of float32's last place.
        assert np.abs(arrays[key] - 1).max() <= 1e-6, key
    # ∫ Y00 dω = √(4π); the other degrees integrate to 0.
    want = np.zeros((9, 3))
    want[0] = math.sqrt(4 * math.pi)
    # The manifest states the error over L00.
    np.testing.assert_allclose(arrays["sh"], want, rtol=0, atol=done.manifest["sh"]["error"] * want[0, 0])
    assert done.manifest["sh"]["error"] <= 1e-5
    # A constant has no error but float32's, for which the statement keeps a twentieth of the tolerance at most.
    assert max(arrays["worst"]) <= 5e-5
    assert done.manifest["source"]["statistics"]["max_over_mean"] == pytest.approx(1)


@pytest.mark.parametrize("level", [1e-30, 3e-5, 0.3, 6e4, 1e30])
def test_a_constant_of_any_magnitude(level):
    found = prefilter(np.full((4, 8, 3), level, np.float32), **SIZES)
    for values in found.values:
        # As for 1: radiance is scaled by a power of two before it meets the lobe.
        assert np.abs(values / np.float32(level) - 1).max() <= 1e-6


@pytest.mark.parametrize("shape", [(32, 64, 3), (1, 1, 3)])
def test_black_is_black_without_error(tmp_path, shape):
    source = image(tmp_path / "a.exr", np.zeros(shape, np.float32))
    bake(source, tmp_path / "out", for_="raw,exr", **SIZES)
    arrays = load(tmp_path / "out")
    for key in ("specular_0", "specular_1", "specular_2", "irradiance", "sh", "error", "worst", "rmse"):
        assert not arrays[key].any(), key
    manifest = verified(tmp_path / "out")
    for level in [*manifest["levels"], *manifest["latlong_levels"], manifest["irradiance"]]:
        assert level["error"] == 0
    assert manifest["sh"]["error"] == 0


def test_twice_the_light_gives_twice_the_values(tmp_path):
    source = image(tmp_path / "a.exr", noise())
    for ev in (0, 1, -3):
        bake(source, tmp_path / f"{ev}", exposure=ev, **SIZES)
    once = load(tmp_path / "0")
    for ev in (1, -3):
        got = load(tmp_path / f"{ev}")
        for key in ("specular_0", "specular_1", "specular_2", "irradiance", "sh"):
            # Exactly: a power of two changes exponents only.
            np.testing.assert_array_equal(got[key], once[key] * 2.0**ev, err_msg=f"{key} at {ev} EV")


def test_light_adds_up():
    a, b = noise(1), 100 * noise(2) ** 8
    one, two, both = (prefilter(x, **SIZES) for x in (a, b, a + b))
    for k in range(3):
        total = one.values[k] + two.values[k]
        # Each of the three may be off by what it states.
        bound = one.worst[k] * one.values[k] + two.worst[k] * two.values[k] + both.worst[k] * both.values[k]
        # `worst` is the largest seen of a sample; those not seen lie within twice that here.
        assert (np.abs(both.values[k] - total) <= 2 * bound + 1e-6 * total).all()


def test_rotation_is_a_shift_of_the_latlong(tmp_path):
    pixels = noise(4)
    pixels[9, 17] = 1e4  # a sun
    source = image(tmp_path / "a.exr", pixels)
    for degrees in (90, -180, 360 / 64):
        turned = prefilter(source, rotate=degrees, **SIZES)
        # Azimuth atan2(z, x) grows to the right: + degrees moves everything right.
        shifted = prefilter(np.roll(pixels, round(degrees / 360 * 64), 1), **SIZES)
        for k in range(3):
            # The same nodes up to float32: an angle is rounded by 6e-8 · π, which the sharpest lobe here (α = .086)
            # and the sun's edge turn into at most 2e-7/.086 · 4.
            np.testing.assert_allclose(turned.values[k], shifted.values[k], rtol=2e-5, err_msg=f"{degrees}° level {k}")
    assert np.abs(prefilter(source, rotate=360, **SIZES).values[1] - prefilter(source, **SIZES).values[1]).max() == 0


def test_a_folder_of_six_faces(tmp_path, shell):
    faces = np.random.default_rng(6).random((6, 16, 16, 3), dtype=np.float32)
    image(tmp_path / "strip.exr", faces.reshape(96, 16, 3))
    folder = tmp_path / "room.v2"  # a dot in a folder's name begins no suffix
    folder.mkdir()
    for name, face in zip(("px", "nx", "py", "ny", "pz", "nz"), faces, strict=True):
        image(folder / f"{name}.exr", face)
    link = tmp_path / "link"
    with contextlib.suppress(OSError):
        link.symlink_to(folder, target_is_directory=True)
    out = tmp_path / "out"
    bake(tmp_path / "strip.exr", out, **SIZES)
    want = load(out, "strip")
    for source in [folder, *([link] if link.exists() else [])]:
        for expected in ("wrote", "up to date"):
            assert shell("bake", source, "-o", out, *SMALL) == 0, shell.err
            assert expected in shell.out
        name = source.name
        got = load(out, name)
        for key in ("specular_0", "specular_1", "specular_2", "irradiance"):
            np.testing.assert_array_equal(got[key], want[key])
        assert shell("bake", source, "-o", out, *SMALL, "--exposure", "1") == 0, shell.err


def test_the_demo_has_a_sun_and_keeps_its_tolerance(tmp_path, shell):
    assert shell("bake", "demo", "-o", tmp_path, "--size", "64", "--json") == 0
    manifest = verified(tmp_path, "demo")
    assert manifest["source"]["statistics"]["max_over_mean"] >= 1e5
    for level in [*manifest["levels"], manifest["irradiance"]]:
        assert level["error"] <= 1e-3 and level["worst"] <= 1e-2
        # Energy is kept to 1e-5 by level 0's exact means; rougher levels are sampled at texel centres.
    assert manifest["levels"][0]["energy_kept"] == pytest.approx(1, abs=1e-5)


def test_a_path_wins_over_the_word_demo(tmp_path, monkeypatch):
    folder = tmp_path / "demo"
    folder.mkdir()
    for name in ("px", "nx", "py", "ny", "pz", "nz"):
        image(folder / f"{name}.exr", np.ones((4, 4, 3), np.float32))
    monkeypatch.chdir(tmp_path)
    bake("demo", tmp_path / "out", **SIZES)
    assert load(tmp_path / "out", "demo")["specular_2"] == pytest.approx(1, abs=1e-6)


def test_a_tolerance_out_of_reach_fails_the_check_and_writes_nothing(tmp_path, shell, monkeypatch):
    source = image(tmp_path / "a.exr", noise())
    monkeypatch.setattr("whitefurnace.prefiltering.plan.LARGEST_GRID", 16)
    assert shell("bake", source, "-o", tmp_path / "out", *SMALL, "--tolerance", "1e-5") == 7
    assert "1e-05" in shell.sentence() and tree(tmp_path / "out") == {}


def test_kernels_are_in_the_key(tmp_path, device, monkeypatch):
    """A bake is skipped on the word of its key: another kernel text anywhere is another bake."""
    assert bake(noise(), tmp_path / "out", device=device, **SIZES)[0].state == "done"
    assert bake(noise(), tmp_path / "out", device=device, **SIZES)[0].state == "skipped"
    before = kernels.everything()
    monkeypatch.setattr(kernels, "everything", lambda: before[::-1])
    assert bake(noise(), tmp_path / "out", device=device, **SIZES)[0].state == "done"


@pytest.mark.parametrize(
    "options", [{}, {"samples": 16}, {"for_": "khronos,filament,babylon", "min_size": None}], ids=str
)
def test_kernels_are_of_the_files_that_the_key_is_of(tmp_path, device, monkeypatch, options):
    """Every line of a program that a bake builds is of a kernel file, or names models: no text from elsewhere."""
    built, build = set(), Device.build
    monkeypatch.setattr(Device, "build", lambda self, text, *rest: (built.add(text), build(self, text, *rest))[1])
    bake(noise(), tmp_path / "out", device=device, **{**SIZES, "size": 16, **options})
    folder = resources.files("whitefurnace.kernels")
    lines = {line for path in Path(str(folder)).rglob("*.cl*") for line in path.read_text("utf-8").splitlines()}
    unknown = {
        line
        for text in built
        for line in text.splitlines()
        if line not in lines and not line.startswith(("#line", "#define"))
    }
    assert not unknown


def test_bake_and_its_request_have_the_same_options():
    """The public function spells them out for editors and mypy; both lists are this test's to keep equal."""
    spelled = inspect.signature(bake).parameters
    asked = {field.name: field.default for field in dataclasses.fields(BakeRequest)}
    own = {"device", "dry_run", "progress"}
    assert [name for name in spelled if name not in own] == list(asked)
    for name, default in asked.items():
        if default is not dataclasses.MISSING:
            assert spelled[name].default == default, name


def test_an_unknown_option_is_refused_by_python(tmp_path):
    with pytest.raises(TypeError, match="sizes"):
        bake(noise(), tmp_path, sizes=32)


# --- images in their own size, and how sources are read --------------------------------------------------


def test_engines_that_filter_an_image_get_it_in_its_own_size(tmp_path, shell):
    pixels = noise(4, 75)
    source = image(tmp_path / "a.exr", pixels)
    out = tmp_path / "out"
    draft = ("--for", "godot,unity,exr", "--quality", "draft")
    assert shell("bake", source, "-o", out, *draft, "--min-size", "128") == 0
    found, _ = read_exr(out / "unity" / "a.exr")
    np.testing.assert_array_equal(found, pixels)
    assert read_image(out / "godot" / "a.hdr").pixels.shape == (75, 150, 3)
    # Levels of the chain keep the chain's size.
    assert read_exr(out / "exr" / "a_specular_0_latlong.exr")[0].shape == (512, 1024, 3)
    assert shell("bake", source, "-o", out, *draft, *SMALL) == 0
    assert read_exr(out / "unity" / "a.exr")[0].shape == (64, 128, 3)
    assert "godot: its image has 128 x 64 texels, and the source has 75 rows" in shell.err


def test_a_cube_becomes_an_image_of_two_faces_height(tmp_path):
    cube = np.random.default_rng(5).random((6, 20, 20, 3)).astype(np.float32)
    source = np.concatenate(cube)  # a vertical strip
    (baked,) = bake(source, tmp_path, for_="godot")
    found = read_image(tmp_path / "godot" / "array.hdr").pixels
    assert found.shape == (40, 80, 3)
    assert found.mean() == pytest.approx(0.5, abs=0.05)
    assert not any("its image has" in notice for notice in baked.notices)


def half_sun(path):
    """A lat-long of half floats whose 2 x 2 sun overflowed."""
    pixels = np.full((64, 128, 3), 0.25, np.float16)
    pixels[20:22, 40:42] = np.inf
    path.write_bytes(exr(Part(planes(pixels))))
    return path


def test_an_overflowed_sun_becomes_the_largest_half(tmp_path, shell):
    source = half_sun(tmp_path / "a.exr")
    out = tmp_path / "out"
    assert shell("bake", source, "-o", out, *SMALL) == 3
    assert "--bad-pixels clamp" in shell.err and "65504" in shell.err
    assert shell("bake", source, "-o", out, *SMALL, "--bad-pixels", "clamp") == 0
    assert "12 +inf values were set to 65504" in shell.err
    manifest = verified(out)
    assert manifest["recipe"]["bad_pixels"] == "clamp"
    assert any("+inf" in notice for notice in manifest["source"]["notices"])
    # E/π at the centres of the cube's texels is Σ L cosθ ω/π over the texels of the image.
    directions = latlong_directions(64, 128).reshape(-1, 3)
    angles = np.repeat(latlong_solid_angles(64, 128), 128)
    radiance = np.full((64, 128), 0.25)
    radiance[20:22, 40:42] = 65504
    normals = cube_directions(32).reshape(-1, 3)
    want = (np.maximum(normals @ directions.T, 0) * (radiance.ravel() * angles)).sum(1).max() / np.pi
    got = load(out)["irradiance"].max()
    assert got == pytest.approx(want, rel=1e-3)  # a texel of 2.8° taken as its centre: 1 - cos of a third of it


@pytest.mark.parametrize(
    "option, value",
    [("--bad-pixels", "clamp"), ("--layout", "latlong"), ("--layer", "beauty"), ("--fill", "black")],
)
def test_options_of_reading_are_part_of_the_key(tmp_path, shell, option, value):
    part = Part(planes(noise(1, 4)), "beauty")
    source = tmp_path / "a.exr"
    source.write_bytes(exr(part, Part(planes(noise(2, 4)), "other")))
    assert shell("bake", source, "-o", tmp_path / "out", *SMALL) == 0
    before = verified(tmp_path / "out")["key"]
    assert shell("bake", source, "-o", tmp_path / "out", *SMALL, option, value) == 0
    after = verified(tmp_path / "out")
    assert after["key"] != before and value in after["recipe"].values()
    assert shell("bake", source, "-o", tmp_path / "out", *SMALL, option, value) == 0 and "up to date" in shell.out


def test_six_files_of_a_shell_pattern_are_one_environment(tmp_path, shell):
    names = "px nx py ny pz nz".split()
    files = [image(tmp_path / f"m0_{name}.exr", np.full((8, 8, 3), k, np.float32)) for k, name in enumerate(names)]
    assert shell("bake", *files, "-o", tmp_path / "out", *SMALL) == 0
    assert verified(tmp_path / "out", "m0")["source"]["layout"] == "six faces"
    assert shell("bake", files[3], "-o", tmp_path / "out", *SMALL) == 0 and "m0: up to date" in shell.out
    assert shell("bake", tmp_path / "m0_*.exr", "-o", tmp_path / "out", *SMALL) == 0 and "m0: up to date" in shell.out


@pytest.mark.parametrize("options", [(), ("--force",), ("--dry-run",)])
def test_an_engine_s_folder_that_is_a_link_to_elsewhere_is_refused(tmp_path, shell, options):
    """`batch` refuses it too: what it would write lands in a folder that nobody named."""
    path = image(tmp_path / "a.exr", noise())
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "raw").symlink_to(tmp_path / "elsewhere")
    assert shell("bake", path, "-o", tmp_path / "out", *SMALL, *options) == 2
    assert "raw is a link that leads out of" in shell.sentence()
    assert tree(tmp_path / "elsewhere") == {} == tree(tmp_path / "out")
