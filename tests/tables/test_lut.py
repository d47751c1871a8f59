"""`whitefurnace lut` from the command line to the files: axes, values, manifest, ownership, refusals, stops."""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from shell import command, mounted, tree
from whitefurnace import dfg, integrate, lut
from whitefurnace.catalogue import INTEGRALS
from whitefurnace.catalogue.roughness import alpha_of_roughness
from whitefurnace.errors import FileError, UsageError
from whitefurnace.files import scratch, write_exr, write_npy
from whitefurnace.tables.axes import Axis, axis


def centres(n: int) -> np.ndarray:
    return (np.arange(n) + 0.5) / n


def manifest(path: Path) -> dict[str, Any]:
    """The sidecar, after what it says of the file was checked."""
    found = json.loads(path.with_name(path.name + ".json").read_text("utf-8"))
    assert hashlib.sha256(path.read_bytes()).hexdigest() == found["sha256"]
    assert path.stat().st_size == found["bytes"]
    assert not list(path.parent.glob(".*"))
    return found


def read_exr(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    source = oiio.ImageInput.open(str(path))
    pixels = np.asarray(source.read_image("float"))
    spec = source.spec()
    attributes = {a.name: a.value for a in spec.extra_attribs}
    source.close()
    return pixels.reshape(spec.height, spec.width, -1), {**attributes, "channels": list(spec.channelnames)}


# --- values and axes --------------------------------------------------------------------------------------


def test_dfg_is_the_table_of_the_design(tmp_path, shell):
    """[y, x, c]: x is NoV = (x + ½)/N, y perceptual roughness (y + ½)/M, row 0 smoothest."""
    path = tmp_path / "dfg.npy"
    assert shell("lut", "dfg", "-o", path, "--size", "24x16", "--tolerance", "5e-6") == 0, shell.err
    table = np.load(path)
    assert table.shape == (16, 24, 2) and table.dtype == np.float32
    alpha = alpha_of_roughness(centres(16))[:, None]
    want = integrate("dfg", ndf="ggx", NoV=centres(24), alpha=alpha, tolerance=5e-6)
    assert np.array_equal(table, want.values)
    m = manifest(path)
    assert m["error"] == want.error and m["rule"] == want.rule and m["evaluations"] == want.evaluations
    assert m["axes"] == [
        {"name": "NoV", "from": 0, "to": 1, "count": 24, "scale": "centres"},
        {"name": "roughness", "from": 0, "to": 1, "count": 16, "scale": "centres"},
    ]
    assert m["models"] == {"ndf": {"name": "ggx"}, "masking": {"name": "smith"}} and m["shape"] == [16, 24, 2]
    lut("dfg", tmp_path / "square.npy", size=8, tolerance=5e-6)
    assert np.array_equal(np.load(tmp_path / "square.npy"), dfg(8).values)


KINDS = {
    "normalization": (),
    "projected_area": (),
    "weak_furnace": (),
    "albedo": (),
    "albedo_average": (),
    "dfg": (),
    "radiance": ("--light", "punctual", "--set", "NoL=.5"),
}


@pytest.mark.parametrize("suffix", [".npy", ".exr"])
@pytest.mark.parametrize("kind", INTEGRALS)
def test_every_integral_is_written(tmp_path, shell, kind, suffix):
    path = tmp_path / f"t{suffix}"
    assert shell("lut", kind, "-o", path, "--size", 6, "--tolerance", "1e-4", *KINDS[kind]) == 0, shell.err
    m = manifest(path)
    channels = 2 if kind == "dfg" else 1
    rows = (6, 6) if INTEGRALS[kind].view else (1, 6)  # without a view roughness alone, one row
    values = np.load(path).reshape(*rows, channels) if suffix == ".npy" else read_exr(path)[0]
    assert values.shape == (*rows, channels) and np.isfinite(values).all()
    assert m["integral"] == kind and m["tolerance"] == 1e-4
    assert (kind in shell.out or "t" in shell.out) and str(path) in shell.out


def test_exr_carries_its_recipe(tmp_path, shell):
    path = tmp_path / "gold.exr"
    assert shell("lut", "albedo", "-o", path, "--size", "8x4", "--fresnel", "schlick:gold") == 0, shell.err
    pixels, told = read_exr(path)
    want = integrate(
        "albedo", ndf="ggx", fresnel="schlick:gold", NoV=centres(8), alpha=alpha_of_roughness(centres(4))[:, None]
    )
    assert np.array_equal(pixels, want.values) and told["channels"] == ["R", "G", "B"]
    assert told["whitefurnace:integral"] == "albedo" and told["whitefurnace:rule"] == want.rule
    assert told["whitefurnace:error"] == pytest.approx(want.error, rel=1e-6)  # float32 in EXR
    assert json.loads(told["whitefurnace:axes"])[1]["name"] == "roughness"
    assert json.loads(told["whitefurnace:models"])["fresnel"] == {"name": "schlick", "f0": [1.0, 0.71, 0.29]}
    assert told["whitefurnace:key"] == manifest(path)["key"]
    assert shell("lut", "albedo", "-o", tmp_path / "one.exr", "--size", 2) == 0
    assert read_exr(tmp_path / "one.exr")[1]["channels"] == ["Y"]


def test_axes_and_fixed_parameters(tmp_path):
    """An axis replaces the default one of its name, or comes after the others, slower; what is fixed has none."""
    path = tmp_path / "t.npy"
    one = {"tolerance": 1e-3, "force": True}
    made = lut("albedo", path, size=3, axes={"alpha": "1e-3:1:5:log"}, **one)
    assert [a.name for a in made.axes] == ["NoV", "alpha"] and made.shape == (5, 3)
    want = integrate("albedo", ndf="ggx", NoV=centres(3), alpha=np.geomspace(1e-3, 1, 5)[:, None], tolerance=1e-3)
    assert np.array_equal(np.load(path), want.values)
    made = lut("albedo", path, size=3, fresnel="schlick", axes={"NoV": (0, 1, 4), "f0": (0, 1, 2)}, **one)
    assert [a.name for a in made.axes] == ["NoV", "roughness", "f0"] and made.shape == (2, 3, 4)
    want = integrate(
        "albedo",
        ndf="ggx",
        fresnel="schlick",
        NoV=np.linspace(0, 1, 4),
        alpha=centres(3)[:, None] ** 2,
        f0=np.array([0, 1])[:, None, None],
        tolerance=1e-3,
    )
    assert np.array_equal(np.load(path), want.values)
    made = lut("albedo", path, size=3, alpha=0.3, **one)
    assert [a.name for a in made.axes] == ["NoV"] and made.shape == (1, 3)
    made = lut("albedo", path, size=3, NoV=0.5, **one)
    assert [a.name for a in made.axes] == ["roughness"] and made.shape == (1, 3)
    made = lut("albedo", path, size=3, roughness=0.5, **one)
    want = integrate("albedo", ndf="ggx", NoV=centres(3)[None], alpha=0.25, tolerance=1e-3)
    assert made.shape == (1, 3) and np.array_equal(np.load(path), want.values)
    made = lut("albedo", path, size=2, ndf="ggx_anisotropic", axes={"phi": (0, math.pi / 2, 3)}, **one)
    assert made.shape == (3, 2, 2)
    made = lut("albedo", path, size=2, ndf="ggx", masking="schlick_smith", **one)  # both follow roughness
    want = integrate(
        "albedo", ndf="ggx", masking="schlick_smith", NoV=centres(2), alpha=centres(2)[:, None] ** 2, tolerance=1e-3
    )
    assert np.array_equal(np.load(path), want.values)
    made = lut("albedo", path, size=2, ndf="gtr:gamma=1", **one)
    want = integrate("albedo", ndf="gtr", gamma=1, NoV=centres(2), alpha=centres(2)[:, None] ** 2, tolerance=1e-3)
    assert np.array_equal(np.load(path), want.values)


def test_diffuse_alone_and_a_users_brdf(tmp_path):
    path = tmp_path / "t.npy"
    made = lut("albedo", path, size=4, diffuse="burley", albedo=0.8)
    want = integrate("albedo", diffuse="burley", albedo=0.8, roughness=centres(4)[:, None], NoV=centres(4))
    assert np.array_equal(np.load(path), want.values)
    made = lut("albedo", path, size=4, diffuse="eon", albedo=0.8, axes={"roughness": (0, 1, 3)})
    want = integrate("albedo", diffuse="eon", albedo=0.8, roughness=np.linspace(0, 1, 3)[:, None], NoV=centres(4))
    assert np.array_equal(np.load(path), want.values)
    mine = tmp_path / "mine.clh"
    mine.write_text("real3 brdf_mine_f(real3 l, real3 v, real a) { return vec3(a, a * l.z, a * v.z); }")
    made = lut("albedo", tmp_path / "m.exr", size=4, brdf=str(mine), a=0.2, tolerance=1e-4)
    assert made.shape == (1, 4, 3)
    pixels, _ = read_exr(tmp_path / "m.exr")
    # ∫ cos = π, ∫ cos² = 2π/3
    want = 0.2 * np.stack([np.full(4, math.pi), np.full(4, 2 * math.pi / 3), math.pi * centres(4)], -1)
    assert np.abs(pixels[0] - want).max() <= 1e-4


def test_precision_64(tmp_path):
    made = lut("weak_furnace", tmp_path / "t.npy", size=4, precision=64)
    values = np.load(tmp_path / "t.npy")
    assert values.dtype == np.float64 and np.abs(values - 1).max() <= made.manifest["error"] <= 2e-12


def test_axis_forms():
    assert axis("a", "0:1:3") == Axis("a", 0, 1, 3) == axis("a", (0, 1, 3)) == axis("a", Axis("a", 0, 1, 3))
    assert axis("a", "1:100:3:log").values() == pytest.approx([1, 10, 100], rel=1e-15)
    assert axis("a", "0:1:2:centres").values().tolist() == [0.25, 0.75]
    assert axis("a", "1:0:2").values().tolist() == [1, 0] and axis("a", "2:3:1").values().tolist() == [2]
    for bad in (
        "0:1",
        "0:1:2:3:4",
        "a:1:2",
        "0:1:1.5",
        "0:1:3:lug",
        "0:1:3:log",
        "nan:1:3",
        "0:inf:3",
        "0:1:0",
        "0:1:16385",
        "",
    ):
        with pytest.raises(UsageError):
            axis("a", bad)


# --- refusals ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, code, words",
    [
        (("albdo", "-o", "t.npy"), 1, "albedo"),
        (("albedo", "-o", "t.tga"), 1, ".dds or .h"),
        (("albedo", "-o", "t"), 1, ".dds or .h"),
        (("albedo",), 1, "--output"),
        (("albedo", "-o", "t.npy", "--size", "0"), 1, "[1, 16384]"),
        (("albedo", "-o", "t.npy", "--size", "16385"), 1, "[1, 16384]"),
        (("albedo", "-o", "t.npy", "--size", "4x16385"), 1, "[1, 16384]"),
        (("albedo", "-o", "t.npy", "--size", "4x"), 1, "NxM"),
        (("normalization", "-o", "t.npy", "--size", "4x4"), 1, "NoV"),
        (("albedo", "-o", "t.npy", "--size", "4x4", "--set", "alpha=.1"), 1, "roughness"),
        (("albedo", "-o", "t.npy", "--ndf", "gxx"), 1, "ggx"),
        (("albedo", "-o", "t.npy", "--diffuse", "oren_nayar"), 1, "needs albedo"),
        (("albedo", "-o", "t.npy", "--fresnel", "schlick"), 1, "needs f0"),
        (("albedo", "-o", "t.npy", "--diffuse", "lambert", "--masking", "smith"), 1, "masking"),
        (("albedo", "-o", "t.npy", "--set", "alhpa=.1"), 1, "alpha"),
        (("albedo", "-o", "t.npy", "--set", "alpha"), 1, "NAME=VALUE"),
        (("albedo", "-o", "t.npy", "--set", "alpha=.1", "--set", "alpha=.2"), 1, "once"),
        (("albedo", "-o", "t.npy", "--set", "alpha=0:1:3"), 1, "axis"),
        (("albedo", "-o", "t.npy", "--set", "alpha=2"), 1, "[1e-05, 1]"),
        (("albedo", "-o", "t.npy", "--set", "alpha=.1", "--axis", "alpha=.1:1:3"), 1, "both"),
        (("albedo", "-o", "t.npy", "--set", "alpha=.1", "--axis", "roughness=.1:1:3"), 1, "roughness"),
        (("albedo", "-o", "t.npy", "--set", "alpha=.1", "--set", "NoV=1"), 1, "axis"),
        (("albedo", "-o", "t.npy", "--set", "precision=.1"), 1, "option"),
        (("albedo", "-o", "t.npy", "--axis", "NoV=-1:1:3"), 1, "backfacing"),
        (("albedo", "-o", "t.npy", "--light", "punctual"), 1, "radiance"),
        (("radiance", "-o", "t.npy"), 1, "light or an environment"),
        (("albedo", "-o", "t.exr", "--axis", "f0=0:1:2", "--fresnel", "schlick"), 1, "two axes"),
        (("albedo", "-o", "t.exr", "--precision", "64"), 1, "float32"),
        (("albedo", "-o", "t.npy", "--precision", "16"), 1, "32, 64"),
        (("albedo", "-o", "t.npy", "--tolerance", "0"), 1, "(0, 1)"),
        (("albedo", "-o", "t.npy", "--tolerance", "nan"), 1, "(0, 1)"),
        (("albedo", "-o", "t.npy", "--device", "no such device"), 1, "no such device"),
        (("dfg", "-o", "t.npy", "--diffuse", "lambert"), 5, "dfg"),
        (("weak_furnace", "-o", "t.npy", "--masking", "neumann"), 5, "neumann has no G1"),
        (("albedo", "-o", "nowhere/t.npy"), 2, "nowhere"),
        (("albedo", "-o", "nowhere/t.exr"), 2, "nowhere"),
        (("albedo", "-o", "t.npy", "--ndf", "none.clh"), 2, "none.clh"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_refusals_are_one_sentence_and_leave_nothing(tmp_path, shell, monkeypatch, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    assert shell("lut", *arguments) == code, shell.err
    assert words in shell.sentence() and tree(tmp_path) == {}


# --- what is there ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".npy", ".exr"])
def test_the_same_recipe_is_skipped_and_gives_the_same_bytes(tmp_path, shell, suffix):
    path = tmp_path / f"t{suffix}"
    make = ("lut", "dfg", "-o", path, "--size", 8)
    assert shell(*make) == 0
    before = tree(tmp_path)
    assert shell(*make) == 0 and "up to date" in shell.out and tree(tmp_path) == before
    assert shell(*make, "--force") == 0 and "up to date" not in shell.out and tree(tmp_path) == before
    path.unlink()
    assert shell(*make) == 0 and tree(tmp_path) == before


@pytest.mark.parametrize(
    "more",
    [
        ("--size", 9),
        ("--ndf", "beckmann"),
        ("--masking", "neumann"),
        ("--tolerance", "1e-4"),
        ("--precision", "64"),
        ("--set", "alpha=.3"),
        ("--axis", "NoV=.1:1:8"),
        ("--backfacing", "clamp"),
    ],
    ids=str,
)
def test_another_recipe_replaces_what_is_ours(tmp_path, shell, more):
    path = tmp_path / "t.npy"
    assert shell("lut", "dfg", "-o", path, "--size", 8) == 0
    before = manifest(path)["key"]
    assert shell("lut", "dfg", "-o", path, "--size", 8, *more) == 0, shell.err
    assert "up to date" not in shell.out and manifest(path)["key"] != before


def test_the_key_is_of_a_files_text(tmp_path, shell):
    lobe, path = tmp_path / "mine.clh", tmp_path / "t.npy"
    keys = set()
    for text in ("return cos_m;", "return cos_m * cos_m;"):
        lobe.write_text(f"real ndf_mine_D(real cos_m) {{ {text} }}")
        assert shell("lut", "albedo", "-o", path, "--size", 4, "--ndf", lobe, "--tolerance", "1e-4") == 0, shell.err
        assert "up to date" not in shell.out
        keys.add(manifest(path)["key"])
    assert len(keys) == 2


@pytest.mark.parametrize("which", ["table", "sidecar", "changed"])
def test_foreign_files_need_force(tmp_path, shell, which):
    path = tmp_path / "t.npy"
    make = ("lut", "dfg", "-o", path, "--size", 4)
    if which == "changed":
        assert shell(*make) == 0
        path.write_bytes(path.read_bytes() + b"!")
    else:
        (path if which == "table" else tmp_path / "t.npy.json").write_text("{}")
    before = tree(tmp_path)
    for extra in ((), ("--dry-run",)):
        assert shell(*make, *extra) == 2 and "--force" in shell.sentence()
        assert tree(tmp_path) == before
    assert shell(*make, "--force") == 0
    manifest(path)


def test_a_folder_in_the_way(tmp_path, shell):
    (tmp_path / "t.npy").mkdir()
    assert shell("lut", "dfg", "-o", tmp_path / "t.npy", "--force") == 2 and "folder" in shell.sentence()


def test_dry_run_json_and_quiet(tmp_path, shell):
    path = tmp_path / "t.npy"
    make = ("lut", "dfg", "-o", path, "--size", "8x4")
    assert shell(*make, "--dry-run") == 0 and "would write" in shell.out and tree(tmp_path) == {}
    assert shell(*make, "--dry-run", "--json") == 0
    (row,) = shell.rows()
    assert row["event"] == "planned" and row["shape"] == [4, 8, 2] and tree(tmp_path) == {}
    assert shell(*make, "--json") == 0 and shell.err == ""
    (row,) = shell.rows()
    assert row["event"] == "done" and row["error"] < 1e-5 and row["key"] == manifest(path)["key"]
    assert shell(*make, "--json") == 0 and shell.rows()[0]["event"] == "skipped"
    assert shell(*make, "--force", "--quiet") == 0 and shell.out == shell.err == ""


def test_promotion_is_told(tmp_path, shell):
    huge = tmp_path / "huge.clh"  # beyond float32
    huge.write_text("real ndf_huge_D(real cos_m) { const real x = cos_m * (real)1e25f; return x * x; }")
    assert shell("lut", "albedo", "-o", tmp_path / "t.npy", "--ndf", huge, "--masking", "implicit", "--size", 3) == 0
    told = [line for line in shell.err.splitlines() if "3 cells were done in float64" in line]
    assert told and told[0].startswith("notice: t.npy: ")
    assert any("float64" in notice for notice in manifest(tmp_path / "t.npy")["notices"])


# --- disks, stops and memory ------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".npy", ".exr"])
def test_a_full_disk_leaves_what_was_there(tmp_path, shell, suffix):
    with mounted(tmp_path / "disk", "size=400k") as out:
        make = ("lut", "weak_furnace", "-o", out / f"t{suffix}", "--tolerance", "1e-2")
        assert shell(*make, "--size", 64) == 0, shell.err
        before = tree(out)
        assert shell(*make, "--size", 512) == 2  # 1 MB
        assert str(out) in shell.sentence() and tree(out) == before
        manifest(out / f"t{suffix}")


def test_a_read_only_disk(tmp_path, shell):
    with mounted(tmp_path / "disk", "ro") as out:
        for suffix in (".npy", ".exr"):
            assert shell("lut", "dfg", "-o", out / f"t{suffix}", "--size", 4) == 2
            assert str(out) in shell.sentence() and tree(out) == {}


def test_files_that_may_not_grow(tmp_path):
    """A limit on file size stands in for a full disk where nothing can be mounted."""
    pytest.importorskip("resource")
    code = (
        "import resource, sys; from whitefurnace import lut, integrate\n"
        "from whitefurnace.errors import FileError\n"
        "lut('dfg', sys.argv[1], size=4)\n"
        "soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE); resource.setrlimit(resource.RLIMIT_FSIZE, "
        "(20_000, hard))\n"
        "try:\n    lut('dfg', sys.argv[1], size=256)\n"
        "except FileError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "t.npy"], capture_output=True, text=True)
    assert done.returncode == 0 and str(tmp_path / "t.npy") in done.stdout, done.stderr
    assert np.load(tmp_path / "t.npy").shape == (4, 4, 2)
    manifest(tmp_path / "t.npy")


@pytest.mark.skipif(os.name != "posix", reason="SIGINT is sent as POSIX has it")
@pytest.mark.parametrize("suffix", [".npy", ".exr"])
def test_ctrl_c_leaves_what_was_there(tmp_path, suffix):
    path = tmp_path / f"t{suffix}"
    lut("dfg", path, size=8)
    before = tree(tmp_path)
    # A minute of work: the temporary file appears when it begins, for EXR a nameless one, so a while is waited.
    run = subprocess.Popen(
        command("lut", "dfg", "-o", path, "--size", 6000),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    begin = time.monotonic()
    while suffix == ".npy" and not list(tmp_path.glob(".*")):
        assert run.poll() is None and time.monotonic() - begin < 60
        time.sleep(0.01)
    time.sleep(1.0 if suffix == ".npy" else 3.0)
    assert run.poll() is None, "the table was done before it could be interrupted"
    run.send_signal(signal.SIGINT)
    told, complaint = run.communicate(timeout=60)
    assert run.returncode == 130 and told == "" and complaint.strip().startswith("interrupted"), complaint
    assert tree(tmp_path) == before


@pytest.mark.long
def test_a_large_table_takes_little_memory(tmp_path):
    """4 million cells, 33 MB, in at most 16 MB more than a small table takes."""
    resource = pytest.importorskip("resource")
    code = (
        "import resource, sys; from whitefurnace import lut\n"
        "def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "lut('dfg', sys.argv[1] + '/small.npy', size=512, tolerance=.1); small = peak()\n"
        "lut('dfg', sys.argv[1] + '/large.npy', size=2048, tolerance=.1); print(peak() - small)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    kilobytes = 1 if sys.platform == "darwin" else 1024
    assert resource and int(done.stdout) * kilobytes <= 16e6, done.stdout
    assert np.load(tmp_path / "large.npy", mmap_mode="r").shape == (2048, 2048, 2)


@pytest.mark.long
def test_a_hundred_million_cells(tmp_path):
    made = lut("weak_furnace", tmp_path / "t.npy", size=10000, tolerance=1e-3)
    values = np.load(tmp_path / "t.npy", mmap_mode="r")
    assert values.shape == (10000, 10000) and made.manifest["error"] <= 1e-3
    assert max(float(np.abs(values[k] - 1).max()) for k in range(0, 10000, 97)) <= 1e-3


def test_progress_grows_to_1(tmp_path):
    seen: list[tuple[str, float]] = []
    lut("weak_furnace", tmp_path / "t.npy", size=400, tolerance=0.1, progress=lambda n, what, s: seen.append((n, s)))
    assert len(seen) == 3 and {n for n, _ in seen} == {"t.npy"} and [s for _, s in seen][-1] == 1
    assert [s for _, s in seen] == sorted(s for _, s in seen)


# --- the files' own part ----------------------------------------------------------------------------------


def test_write_npy_leaves_nothing_where_filling_fails(tmp_path):
    path = tmp_path / "t.npy"

    def fill(out: np.ndarray) -> None:
        out[:] = 3
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        write_npy(path, (4, 4), np.float32, fill)
    assert tree(tmp_path) == {}
    write_npy(path, (4, 4), np.float32, lambda out: out.fill(2))
    assert np.array_equal(np.load(path), np.full((4, 4), 2, np.float32))
    with pytest.raises(FileError):
        write_npy(tmp_path / "none" / "t.npy", (4,), np.float32, lambda out: None)


def test_scratch_has_no_name(tmp_path):
    with scratch(tmp_path / "t.exr", (8, 8), np.float32, lambda out: out.fill(5)) as array:
        assert array.shape == (8, 8) and (array == 5).all() and tree(tmp_path) == {}
    with pytest.raises(FileError), scratch(tmp_path / "none" / "t", (8,), np.float32, lambda out: None):
        pass


def test_an_environment_of_a_table_is_read_as_bakes_read_it(tmp_path, shell, monkeypatch):
    """The word demo, options of reading and notices, in a command and in a job."""
    monkeypatch.chdir(tmp_path)
    write_exr(tmp_path / "a.exr", np.where(np.arange(96).reshape(4, 8, 3) == 7, np.inf, 1).astype(np.float32))
    table = ("--diffuse", "lambert:albedo=.5", "--size", "2", "--tolerance", ".01")
    assert shell("lut", "radiance", "-o", "r.npy", "--environment", "demo", *table) == 0
    assert (
        shell("lut", "radiance", "-o", "s.npy", "--environment", "a.exr", *table) == 3 and "--bad-pixels" in shell.err
    )
    assert shell("lut", "radiance", "-o", "s.npy", "--environment", "a.exr", *table, "--bad-pixels", "zero") == 0
    assert "1 not finite value was set to 0" in shell.err
    manifest = json.loads((tmp_path / "s.npy.json").read_text())
    assert manifest["environment"]["bad_pixels"] == "zero" and "not finite" in manifest["notices"][0]
    job = '[[lut]]\nkind = "radiance"\noutput = "{}"\nenvironment = "{}"\n'
    job += 'diffuse = "lambert:albedo=.5"\nsize = 2\ntolerance = 0.01\n{}\n'
    text = job.format("j.npy", "demo", "") + job.format("k.npy", "a.exr", 'bad-pixels = "zero"')
    (tmp_path / "j.toml").write_text(text)
    assert shell("batch", "j.toml") == 0
    for one, other in (("r", "j"), ("s", "k")):
        np.testing.assert_array_equal(np.load(f"{one}.npy"), np.load(f"{other}.npy"))
