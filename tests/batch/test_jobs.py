"""`batch` from end to end: what a job is refused for, what runs again, what is left by runs that were killed, and that
nothing of a stranger's job leaves its folder."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from shell import command, mounted, tree
from whitefurnace import bake
from whitefurnace.baking import bake as baking
from whitefurnace.baking.request import BakeRequest
from whitefurnace.batch import jobs as batch
from whitefurnace.errors import FileError
from whitefurnace.files import acquire, lock_path, write_exr
from whitefurnace.opencl.device import choose_device
from whitefurnace.sphere.environments import source_digest
from whitefurnace.tables import lut as tables

SIZES = "size = 16\nmin_size = 16\ntolerance = 1e-2\n"
OPTIONS = dict(size=16, min_size=16, tolerance=1e-2)


def image(path: Path, seed: int = 0, height: int = 4) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, np.random.default_rng(seed).random((height, 2 * height, 3), dtype=np.float32))
    return path


def probes(folder: Path, count: int, height: int = 4) -> list[Path]:
    return [image(folder / "probes" / f"p{k:02d}.exr", k, height) for k in range(count)]


def job(folder: Path, text: str = "", name: str = "job.toml") -> Path:
    path = folder / name
    path.write_text(text or f'[[bake]]\nenvironments = ["probes/*.exr"]\noutput = "out"\n{SIZES}')
    return path


def whole(folder: Path, names: set[str] | None = None) -> None:
    """Every file in a folder of bakes is one that a manifest proves, or a manifest; all of `names` are there."""
    files = tree(folder)
    manifests = {name: json.loads(data) for name, data in files.items() if "/" not in name and name.endswith(".json")}
    assert not names or {name.removesuffix(".json") for name in manifests} == names
    proven = set(manifests)
    for manifest in manifests.values():
        for relative, entry in manifest["files"].items():
            assert hashlib.sha256(files[relative]).hexdigest() == entry["sha256"], relative
            proven.add(relative)
    assert set(files) == proven


def survivors(folder: Path) -> None:
    """After a death: what has its own name is whole, the rest is staged or a lock."""
    for name, data in tree(folder).items():
        if Path(name).name.startswith("."):
            assert name.endswith((".tmp", ".lock")), name
        elif "/" not in name:
            for relative, entry in json.loads(data)["files"].items():
                assert hashlib.sha256((folder / relative).read_bytes()).hexdigest() == entry["sha256"], relative
        else:
            with np.load(folder / name) as archive:
                assert "dfg" in archive.files  # the last of its arrays


# --- jobs that are refused ------------------------------------------------------------------------------


B = '[[bake]]\nenvironments = ["probes/p00.exr"]\noutput = "out"\n'
L = '[[lut]]\nkind = "dfg"\noutput = "dfg.npy"\nsize = 8\n'


@pytest.mark.parametrize(
    "text, words",
    [
        ("", ["no [[bake]]"]),
        ("[[bak]]\n", ["bak is not known", "'bake'"]),
        ("[bake]\nsize = 1\n", ["[[bake]]"]),
        ("bake = 1\n", ["[[bake]]"]),
        ("[[bake]\n", ["not TOML"]),
        (B + "sise = 16\n", ["bake[0].sise is not known", "'size'"]),
        (B + "min-size = 16\nmin_size = 8\n", ["given twice"]),
        (B + 'size = "16"\n', ["bake[0].size", "expected `int"]),
        (B + "size = 17\n", ["bake[0]", "power of two", "[1, 2048]"]),
        (B + "size = 9223372036854775807\n", ["bake[0]", "power of two", "[1, 2048]"]),
        (B + "levels = 1000000\n", ["bake[0]", "[1, 32]"]),
        (B + "certify = 1000000000\n", ["bake[0]", "certify"]),
        (B + "tolerance = nan\n", ["bake[0]", "tolerance"]),
        (B + "rotate = inf\n", ["bake[0]", "rotate"]),
        (B + "exposure = 1000\n", ["bake[0]", "exposure"]),
        (B + 'nonfinite = "ignore"\n', ["bake[0]", "nonfinite"]),
        (B + 'sun = "kept"\n', ["bake[0]", "'keep'"]),
        (B + 'for = ["filamant"]\n', ["bake[0]", "'filament'"]),
        (B + 'for = "raw"\n', ["bake[0].for", "expected `array"]),
        (B + "for = []\n", ["bake[0].for is empty"]),
        (B + 'for = ["raw,exr"]\n', ["a comma"]),
        (B + 'ndf = "ggz"\n', ["bake[0]", "'ggx'"]),
        (B.replace("p00", "nope"), ["bake[0].environments[0]", "is not there"]),
        (B.replace("p00", "n*"), ["bake[0].environments[0]", "nothing matches"]),
        ('[[bake]]\nenvironments = []\noutput = "out"\n', ["environments is empty"]),
        ('[[bake]]\nenvironments = ["probes/p00.exr"]\n', ["bake[0]", "`output`"]),
        (
            B + B.replace("[[bake]]", "[[bake]]\nsize = 8\nmin_size = 8"),
            ["bake[0]: probes/p00.exr", "bake[1]: probes/p00.exr", "both write", "p00.npz"],
        ),
        (B.replace('p00.exr"', 'p00.exr", "other/p00.exr"'), ["probes/p00.exr", "other/p00.exr", "both write"]),
        (L + L, ["lut[0]: dfg.npy", "lut[1]: dfg.npy", "both write"]),
        (L + "size = 8\n", ["not TOML"]),
        (L.replace("8", "99999"), ["lut[0]", "[1, 16384]"]),
        (L.replace("8", "16384") + 'axis = ["f0=0:1:16384", "ior=1:2:16384"]\n', ["lut[0]"]),
        (L.replace('"dfg"', '"dgf"'), ["lut[0]", "'dfg'"]),
        (L + 'axis = ["NoV"]\n', ["lut[0]", "NAME=A:B:N"]),
        (
            B.replace('"out"', '"."') + '[[lut]]\nkind = "dfg"\noutput = "raw/p00.npy"\n[[bake]]\n'
            'environments = ["raw/p00.npz"]\noutput = "x"\n',
            ["is read, and written by bake[0]"],
        ),
        # Every mistake of a job is told at once.
        (B + "size = 17\n" + L.replace("8", "0"), ["bake[0]", "lut[0]"]),
    ],
)
def test_a_job_is_checked_whole_before_anything_runs(tmp_path, shell, text, words):
    probes(tmp_path, 1)
    image(tmp_path / "other" / "p00.exr")
    image(tmp_path / "raw" / "p00.npz")
    before = tree(tmp_path)
    path = job(tmp_path, text or "\n")
    assert shell("batch", path) == 3
    for word in ["job.toml", *words]:
        assert word in shell.sentence()
    path.unlink()
    assert tree(tmp_path) == before


EVERY_MISTAKE = {
    "item_timeout: a time limit": 'item_timeout = "soon"',
    "sise is not known": "sise = 3",
    "bake[0].environments[1]: 'nope.exr'": '[[bake]]\nenvironments = ["probes/p00.exr", "nope.exr"]',
    "bake[0].output": 'output = "../out"',
    "bake[0].size: size 17": "size = 17",
    "bake[0].levels: expected": 'levels = "3"',
    "bake[0].tolerance": "tolerance = 7.0",
    "bake[0].rotate": "rotate = inf",
    "bake[0].exposure": "exposure = 1000",
    "bake[0].ndf: unknown ndf 'GGX'; did you mean 'ggx'": 'ndf = "GGX"',
    "bake[0].for: unknown engine 'Three'; did you mean 'three'": 'for = ["Three"]',
    "bake[0].colour is not known": "colour = 3",
    "bake[1] has no `output`": '[[bake]]\nenvironments = ["probes/p00.exr"]',
    "bake[1].quality": 'quality = "Draught"',
    "lut[0].kind: unknown integral 'DFG'; did you mean 'dfg'": '[[lut]]\noutput = "a.npy"\nkind = "DFG"',
    "lut[1].output": '[[lut]]\nkind = "albedo"\noutput = "b.xyz"',
    "lut[1].ndf": 'ndf = "ggz"',
    "lut[1].masking": 'masking = "Smith"',
    "lut[1].precision": "precision = 16",
    "lut[2].ndf names evil.clh": '[[lut]]\nkind = "dfg"\noutput = "c.npy"\nndf = "evil.clh"',
    "lut[2].size": "size = 99999",
}


def test_every_mistake_of_a_job_is_told_at_once(tmp_path, shell):
    probes(tmp_path, 1)
    path = job(tmp_path, "\n".join(EVERY_MISTAKE.values()) + "\n")
    assert shell("batch", path, "--dry-run") == 3
    for words in EVERY_MISTAKE:
        assert shell.err.count(words) == 1, (words, shell.err)
    # Nothing is told that is only a consequence: a mistake a line, in parts that semicolons separate.
    places = [part for part in shell.err.split("; ") if re.match(r"(bake|lut)\[\d\][ .:]", part)]
    assert len(places) == len(EVERY_MISTAKE) - 2, places


def test_an_item_that_takes_too_long_fails_and_leaves_nothing(tmp_path, shell):
    """Reading and baking take more than a tenth of a second, in which a process does not even build a kernel."""
    probes(tmp_path, 1, height=256)
    path = job(tmp_path, f'item_timeout = 0.1\n[[bake]]\nenvironments = ["probes/*"]\noutput = "out"\n{SIZES}')
    assert shell("batch", path) == 7
    assert "p00.exr: it took longer than the time limit of 0.1 s (exit code 7)" in shell.err
    assert not (tmp_path / "out").exists()
    assert shell("batch", path, "--item-timeout", "600") == 0
    whole(tmp_path / "out", {"p00"})
    assert shell("batch", path, "--item-timeout", "0") == 1 and "[0.1, 1e+07]" in shell.sentence()


def test_every_option_of_bake_and_lut_is_in_a_job():
    from whitefurnace.cli import cli

    own = {"environments", "output", "device", "dry_run", "force", "as_json", "quiet", "kind", "memory", "debug"}
    for name, table in batch.TABLES.items():
        there = {p.name for p in cli.commands[name].params} - own
        there = {{"axes": "axis", "fixed": "set", "stored": "format"}.get(p, p) for p in there}
        assert there == set(table.__struct_fields__) - own, name


@pytest.mark.parametrize("output", ["/tmp/x", "..", "../out", "out/../../x", "link", "link/deep", ""])
@pytest.mark.parametrize("kind", ["bake", "lut"])
def test_outputs_stay_under_the_folder_of_the_job(tmp_path, shell, kind, output):
    inside = tmp_path / "job"
    probes(inside, 1)
    (tmp_path / "victim").mkdir()
    (inside / "link").symlink_to(tmp_path / "victim")
    output = f"{output}/x.npy" if kind == "lut" and output else output
    text = (
        f'[[bake]]\nenvironments = ["probes/*"]\noutput = "{output}"\n{SIZES}'
        if kind == "bake"
        else f'[[lut]]\nkind = "dfg"\noutput = "{output}"\nsize = 4\n'
    )
    path = job(inside, text)
    before = tree(tmp_path)
    assert shell("batch", path) == 3 and "output" in shell.sentence()
    assert tree(tmp_path) == before


def test_a_folder_that_leads_out_when_the_item_runs_is_refused(tmp_path, shell):
    """The engine's folder, which no key of the job names, and one that is exchanged after the check."""
    inside, victim = tmp_path / "job", tmp_path / "victim"
    probes(inside, 1)
    victim.mkdir()
    (inside / "out").mkdir()
    (inside / "out" / "raw").symlink_to(victim)
    path = job(inside)
    assert shell("batch", path) == 2 and "leads out of" in shell.err
    made = batch.job(path)
    (inside / "out" / "raw").unlink()
    (inside / "out").rmdir()
    (inside / "out").symlink_to(victim)
    assert "leads out of" in batch.do(made.items[0]).message
    assert tree(victim) == {}
    # Where it is meant, the user says so.
    (inside / "out").unlink()
    assert shell("batch", path, "-o", victim) == 0
    whole(victim / "out", {"p00"})


@pytest.mark.parametrize("where", ["lock", "staged"])
def test_nothing_is_written_through_links_beside_the_outputs(tmp_path, where):
    probes(tmp_path, 1)
    thesis = tmp_path / "thesis"
    thesis.write_text("mine")
    (tmp_path / "out" / "raw").mkdir(parents=True)
    link = tmp_path / "out" / ".p00.lock" if where == "lock" else tmp_path / "out" / "raw" / ".p00.npz.tmp"
    link.symlink_to(thesis)
    result = batch.do(batch.job(job(tmp_path)).items[0])
    assert thesis.read_text() == "mine"
    assert result.state == ("failed" if where == "lock" else "done"), result


def test_a_lock_that_is_not_ours_is_left_alone(tmp_path):
    probes(tmp_path, 1)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".p00.lock").write_text("somebody's")
    assert "not our lock" in batch.do(batch.job(job(tmp_path)).items[0]).message
    assert tree(tmp_path / "out") == {".p00.lock": b"somebody's"}


def test_manifests_do_not_lead_out_of_their_folder(tmp_path):
    """A manifest says what is ours to remove: one that came with the job, of a file elsewhere, proves nothing."""
    probes(tmp_path, 1)
    thesis = tmp_path / "thesis"
    thesis.write_text("mine")
    entry = {"sha256": hashlib.sha256(b"mine").hexdigest()}
    for name in (".p00.json.tmp", "p00.json"):
        (tmp_path / "out").mkdir(exist_ok=True)
        (tmp_path / "out" / name).write_text(
            json.dumps(
                {
                    "whitefurnace": "0",
                    "name": "p00",
                    "key": "",
                    "recipe": {"for": ["raw"]},
                    "files": {"raw/../../thesis": entry},
                }
            )
        )
        (result,) = map(batch.do, batch.job(job(tmp_path), force=True).items)
        assert result.state == "done" and thesis.read_text() == "mine"
        shutil.rmtree(tmp_path / "out")


def test_no_code_of_a_job_runs_unless_that_is_allowed(tmp_path, shell):
    probes(tmp_path, 1)
    (tmp_path / "mine.clh").write_text("real ndf_mine_D(real cos_m, real alpha) { return cos_m + alpha; }\n")
    for text in (
        f'[[bake]]\nenvironments = ["probes/*"]\noutput = "out"\n{SIZES}ndf = "mine.clh"\n',
        '[[lut]]\nkind = "albedo"\noutput = "a.npy"\nsize = 4\nndf = "mine.clh:alpha=.3"\ntolerance = 1e-3\n',
        '[[lut]]\nkind = "albedo"\noutput = "b.npy"\nsize = 4\nbrdf = "mine.clh"\n',
    ):
        path = job(tmp_path, text)
        assert shell("batch", path) == 3 and "--allow-kernels" in shell.sentence()
    assert (
        shell(
            "batch",
            job(tmp_path, f'[[bake]]\nenvironments = ["probes/*"]\noutput = "out"\n{SIZES}ndf = "mine.clh"\n'),
            "--allow-kernels",
        )
        == 0
    )
    whole(tmp_path / "out", {"p00"})
    # A worker that lives on takes the file as it is now.
    (tmp_path / "mine.clh").write_text("real ndf_mine_D(real cos_m, real alpha) { return 2.0f * cos_m + alpha; }\n")
    (item,) = batch.job(tmp_path / "job.toml", allow_kernels=True).items
    assert batch.do(item).state == "done" and batch.do(item).state == "skipped"


@pytest.mark.parametrize("count", [100_000, pytest.param(1_000_000, marks=pytest.mark.long)])
def test_many_patterns_and_deep_folders_take_no_minutes(tmp_path, shell, monkeypatch, count):
    monkeypatch.setattr(batch, "MOST_SEEN", min(batch.MOST_SEEN, 2 * count))
    probes(tmp_path, 3)
    begin = time.process_time()
    many = ", ".join(['"*"'] * count)
    assert shell("batch", job(tmp_path, f'[[bake]]\nenvironments = [{many}]\noutput = "out"\n')) == 3
    assert "narrower" in shell.sentence()
    assert shell("batch", job(tmp_path, B.replace("probes/p00.exr", "**/" * 200 + "x"))) == 3
    with open(tmp_path / "job.toml", "wb") as file:
        file.truncate(1 << 40)
    assert shell("batch", tmp_path / "job.toml") == 3 and "at most" in shell.sentence()
    # A bound on the work, not a speed: without one the patterns would compare for a day.
    assert time.process_time() - begin < 120


# --- patterns -------------------------------------------------------------------------------------------


def test_patterns_find_what_glob_finds(tmp_path):
    import glob

    for name in (
        "a.exr",
        "b.exr",
        "ab.exr",
        ".hidden.exr",
        "d/a.exr",
        "d/e/c.exr",
        "d/e/.x/f.exr",
        "[x].exr",
        "f/px.png",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "loop").symlink_to(tmp_path)
    for pattern in (
        "*.exr",
        "?.exr",
        "[ab].exr",
        "d/*",
        "**/*.exr",
        "d/**/*.exr",
        "*/*.exr",
        "**/e/*",
        ".*.exr",
        "d/e/c*",
        "[[]x].exr",
        "**",
    ):
        found = [os.path.relpath(p, tmp_path) for p in batch._Finder().find(tmp_path, pattern)]
        # Links are not followed by ** here: through `loop` glob finds all of it again and again.
        want = {p.rstrip("/") for p in glob.glob(pattern, root_dir=tmp_path, recursive=True)} - {""}
        want = {p for p in want if not p.startswith("loop/")} if "**" in pattern else want
        assert found == sorted(want), pattern


def test_what_a_job_wrote_is_not_what_its_patterns_find(tmp_path):
    image(tmp_path / "a.exr")
    path = job(tmp_path, f'[[bake]]\nenvironments = ["**/*.exr"]\noutput = "out"\nfor = ["exr"]\n{SIZES}')
    for state in ("done", "skipped"):
        made = batch.job(path)
        assert [item.name for item in made.items] == ["a"]
        assert batch.do(made.items[0]).state == state


# --- running again --------------------------------------------------------------------------------------


def test_a_second_run_does_nothing_and_one_option_bakes_what_depends_on_it(tmp_path, shell, monkeypatch):
    probes(tmp_path, 2)
    text = (
        f'[[bake]]\nenvironments = ["probes/p00.exr", "demo"]\noutput = "out"\n{SIZES}'
        f'[[bake]]\nenvironments = ["probes/p01.exr"]\noutput = "out/deep"\nfor = ["raw", "bevy"]\n{SIZES}'
        '[[lut]]\nkind = "dfg"\noutput = "luts/dfg.npy"\nsize = 8\n'
    )
    path = job(tmp_path, text)
    assert shell("batch", path) == 0 and "4 done" in shell.out
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in tree(tmp_path)}
    # Nothing is decoded for it.
    with monkeypatch.context() as patch:
        patch.setattr(baking, "read_environment", lambda *_, **__: pytest.fail("an image was decoded"))
        assert [batch.do(item).state for item in batch.job(path).items if item.source != "demo"] == ["skipped"] * 3
    assert shell("batch", path) == 0 and "4 items, all up to date" in shell.out
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in tree(tmp_path)} == before
    # A second engine for one of the tables: the others stay as they are.
    job(tmp_path, text.replace('"bevy"]', '"bevy", "exr"]'))
    assert shell("batch", path, "--json") == 0
    assert [row["event"] for row in shell.rows()] == ["skipped", "skipped", "done", "skipped", "summary"] or sorted(
        row["event"] for row in shell.rows()
    ) == ["done", "skipped", "skipped", "skipped", "summary"]
    # And what bake makes of the same options is the same file.
    bake(tmp_path / "probes" / "p00.exr", tmp_path / "alone", **OPTIONS)
    assert (tmp_path / "alone/raw/p00.npz").read_bytes() == (tmp_path / "out/raw/p00.npz").read_bytes()
    assert json.loads((tmp_path / "alone/p00.json").read_text()) == json.loads((tmp_path / "out/p00.json").read_text())


def test_a_broken_image_among_good_ones(tmp_path, shell):
    good = probes(tmp_path, 3)
    good[1].write_bytes(good[1].read_bytes()[:400])
    assert shell("batch", job(tmp_path)) == 8
    assert "1 of 3 items failed" in shell.err and "failed: bake[0]: probes/p01.exr: " in shell.err
    assert "2 done, 1 failed" in shell.out
    whole(tmp_path / "out", {"p00", "p02"})
    assert shell("batch", tmp_path / "job.toml", "--json") == 8
    rows = shell.rows()
    assert sorted(row["event"] for row in rows[:-2]) == ["failed", "skipped", "skipped"]
    summary = next(row for row in rows if row["event"] == "summary")
    assert summary["failed"] == 1 and summary["failures"][0]["exit_code"] == 3
    assert "p01.exr" in summary["failures"][0]["message"]
    # All of them, of one kind: that kind.
    for path in good:
        path.write_bytes(b"")
    assert shell("batch", tmp_path / "job.toml", "--force") == 3
    whole(tmp_path / "out", {"p00", "p02"})


def test_a_dry_run_says_what_would_be_done_and_does_nothing(tmp_path, shell):
    probes(tmp_path, 2)
    path = job(tmp_path)
    bake(tmp_path / "probes" / "p00.exr", tmp_path / "out", **OPTIONS)
    before = tree(tmp_path)
    assert shell("batch", path, "--dry-run") == 0
    assert str(tmp_path / "out/raw/p01.npz") in shell.out and "p00" not in shell.out
    assert "2 items: 1 to do, 1 up to date" in shell.out
    assert shell("batch", path, "--dry-run", "--json") == 0
    planned = next(row for row in shell.rows() if row["event"] == "planned")
    (size,) = planned["files"].values()
    assert planned["predicted"]["cpu_seconds"] > 0 and planned["predicted"]["memory"] > 1e8
    assert tree(tmp_path) == before
    assert shell("batch", path) == 0
    # The arrays' bytes; zip and npy add a header each.
    assert size < (tmp_path / "out/raw/p01.npz").stat().st_size < size + 8192
    (tmp_path / "out/raw/p01.npz").write_bytes(b"not ours any more")
    assert shell("batch", path, "--dry-run") == 8 and "--force" in shell.err


def test_shards_are_disjoint_cover_and_stay_when_items_are_added(tmp_path, shell):
    probes(tmp_path, 7)
    names = [item.name for item in batch.job(job(tmp_path)).items]
    for n in (1, 2, 3, 7, 9):
        shards = [[item.name for item in batch.job(tmp_path / "job.toml").shard(k, n).items] for k in range(1, n + 1)]
        assert sorted(name for shard in shards for name in shard) == names
        assert max(map(len, shards)) - min(map(len, shards)) <= 1
    before = [item.name for item in batch.job(tmp_path / "job.toml").shard(2, 3).items]
    image(tmp_path / "probes" / "z.exr")
    assert [item.name for item in batch.job(tmp_path / "job.toml").shard(2, 3).items][: len(before)] == before
    for wrong in ("0/3", "4/3", "1", "a/b", "1/0", "-1/3", "1/99999999"):
        assert shell("batch", tmp_path / "job.toml", "--shard", wrong) == 1 and "I/N" in shell.sentence()
    assert shell("batch", tmp_path / "job.toml", "--shard", "8/8", "--json") == 0
    assert [row["name"] for row in shell.rows() if row["event"] == "done"] == ["z"]


@pytest.mark.skipif(not shutil.which("make"), reason="make is not installed")
def test_make_reads_the_depfile(tmp_path, shell):
    names = ["a b", "c#d", "e$f", "g%h", "i[j]", "k*l", "~o", "p:q", "r'\"s", "=u"]
    for k, name in enumerate(names):
        image(tmp_path / "my probes" / f"{name}.exr", k)
    path = job(tmp_path, f'[[bake]]\nenvironments = ["my probes/*"]\noutput = "my out"\n{SIZES}', "my job.toml")
    assert shell("batch", path, "--depfile", tmp_path / "job.d") == 0
    # On its command line make takes what has an = for a variable.
    (tmp_path / "Makefile").write_text(f"include job.d\nE := =\nassigned: {tmp_path}/my\\ out/$(E)u.json\n")

    def asked(name: str) -> int:
        target = str(tmp_path / "my out" / f"{name}.json")
        return subprocess.run(
            ["make", "-q", "-C", str(tmp_path), "assigned" if "=" in name else target], capture_output=True
        ).returncode

    for name in names:
        assert asked(name) != 2, name  # there is a rule
        os.utime(tmp_path / "my probes" / f"{name}.exr", (2e9, 2e9))
        # A rule without a recipe rebuilds nothing: what make thinks of it tells whether it knows the source.
        goal = "assigned" if "=" in name else str(tmp_path / "my out" / f"{name}.json")
        told = subprocess.run(["make", "-n", "-d", "-C", str(tmp_path), goal], capture_output=True, text=True).stdout
        assert f"'{tmp_path / 'my probes' / name}.exr' is newer than target" in told, name
    (tmp_path / "my probes" / "a b.exr").unlink()
    assert asked("c#d") in (0, 1)  # 2 where a file that is gone is an error


# --- several at once, and deaths ------------------------------------------------------------------------


def test_a_lock_is_held_once_and_leaves_nothing(tmp_path):
    path, held, most = tmp_path / ".a.lock", [0], [0]

    def hold() -> None:
        for _ in range(40):
            lock = acquire(path)
            assert lock
            held[0] += 1
            most[0] = max(most[0], held[0])
            time.sleep(1e-4)
            held[0] -= 1
            lock.release()

    threads = [threading.Thread(target=hold) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[0] == 1 and not path.exists()
    lock = acquire(path)
    assert acquire(path, wait=False) is None
    lock.release()
    lock.release()


@pytest.mark.skipif(os.name != "posix", reason="an open file stays on Windows")
def test_a_signal_while_a_lock_is_taken_leaves_no_file(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("whitefurnace.files.lock._left", interrupted)
    for text, stays in (("", False), ("not a lock", True)):
        (tmp_path / ".a.lock").write_text(text)
        with pytest.raises(KeyboardInterrupt):
            acquire(tmp_path / ".a.lock")
        assert (tmp_path / ".a.lock").exists() == stays


def test_a_lock_whose_file_was_removed_is_no_lock(tmp_path, monkeypatch):
    """Who opened the file before its holder removed it locks a file without a name, while a third makes a new one."""
    from whitefurnace.files import lock as locks

    path, real, third = tmp_path / ".a.lock", locks._try, []
    holder = acquire(path)

    def late(handle):
        monkeypatch.setattr(locks, "_try", real)
        holder.release()
        third.append(acquire(path))
        return real(handle)

    monkeypatch.setattr(locks, "_try", late)
    assert acquire(path, wait=False) is None
    third[0].release()


def test_two_batches_into_one_folder(tmp_path):
    probes(tmp_path, 12, height=16)
    path = job(
        tmp_path,
        '[[bake]]\nenvironments = ["probes/*"]\noutput = "out"\nsize = 32\nmin_size = 16\n'
        '[[lut]]\nkind = "albedo"\noutput = "a.npy"\nsize = 64\n',
    )
    pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    runs = [subprocess.Popen(command("batch", path, "--json"), **pipes) for _ in range(2)]
    events = {}
    for run in runs:
        told, complaint = run.communicate(timeout=300)
        assert run.returncode == 0, complaint
        for row in map(json.loads, told.splitlines()):
            events.setdefault(row.get("name"), []).append(row["event"])
    summary = events.pop(None)
    assert summary == ["summary"] * 2
    # Each was made once; the other batch found it made.
    assert all(sorted(found) == ["done", "skipped"] for found in events.values()), events
    whole(tmp_path / "out", {f"p{k:02d}" for k in range(12)})
    assert not [name for name in tree(tmp_path) if Path(name).name.startswith(".")]


def died(folder: Path, output: str, count: int, rng: random.Random, times: int) -> list[float]:
    """Kills a batch at random moments of its run, and looks each time at what is left and at what the next makes."""
    path, out = folder / "job.toml", folder / output
    begin = time.monotonic()
    subprocess.run(command("batch", path, "--quiet"), check=True)
    length = time.monotonic() - begin
    moments = []
    for k in range(times):
        # Now and then another recipe, over what was there.
        text = path.read_text()
        path.write_text(
            "\n".join(
                [*(line for line in text.splitlines() if not line.startswith("exposure")), f"exposure = {k + 1}", ""]
            )
        )
        run = subprocess.Popen(command("batch", path, "--quiet"), start_new_session=True)
        moments.append(rng.uniform(0.2, 1.0))
        time.sleep(length * moments[-1])
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
        survivors(out)
        kept = {
            name: (out / name).stat().st_mtime_ns
            for name in tree(out)
            if name.endswith(".json")
            and not name.startswith(".")
            and json.loads((out / name).read_text())["recipe"]["exposure"] == k + 1
        }
        if k % 3 == 0:  # died again
            run = subprocess.Popen(command("batch", path, "--quiet"), start_new_session=True)
            time.sleep(length * rng.uniform(0.2, 0.8))
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()
            survivors(out)
        subprocess.run(command("batch", path, "--quiet"), check=True)
        whole(out, {f"p{j:02d}" for j in range(count)})
        # Only what was missing was made again.
        assert all((out / name).stat().st_mtime_ns == stamp for name, stamp in kept.items())
    return moments


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="SIGKILL is POSIX's")
@pytest.mark.parametrize("times", [8])
def test_killed_at_random_moments(tmp_path, times):
    """With all that a process of its own does; test_deaths.py has fifty deaths of each command."""
    probes(tmp_path, 6, height=16)
    job(tmp_path, '[[bake]]\nenvironments = ["probes/*"]\noutput = "out"\nsize = 32\nmin_size = 16\n')
    died(tmp_path, "out", 6, random.Random(6 + times), times)


class Death(BaseException):
    """Nothing of ours catches this on its way and goes on."""


@contextlib.contextmanager
def deadly(step: int | None):
    """Lets the process die, as far as its files can tell, at the step-th of all calls that change the disk: neither
    that call nor any after it does anything, and its locks go. Gives the calls that were made."""
    calls: list[str] = []
    handles: list[int] = []
    dead = [False]
    names = ("replace", "unlink", "fsync", "rmdir", "mkdir", "ftruncate", "write")
    real = {name: getattr(os, name) for name in (*names, "open", "close")}

    def dying(name):
        def call(*args, **kwargs):
            dead[0] = dead[0] or len(calls) == step
            if dead[0]:
                raise Death
            calls.append(name)
            return real[name](*args, **kwargs)

        return call

    def opened(path, *args, **kwargs):
        if dead[0]:
            raise Death
        handle = real["open"](path, *args, **kwargs)
        if str(path).endswith(".lock"):
            handles.append(handle)
        return handle

    with pytest.MonkeyPatch.context() as patch:
        for name in names:
            patch.setattr(os, name, dying(name))
        patch.setattr(os, "open", opened)
        patch.setattr(os, "close", lambda handle: None if handle in handles else real["close"](handle))
        try:
            yield calls
        finally:
            for handle in handles:
                real["close"](handle)


@pytest.mark.few(2)
@pytest.mark.parametrize("again", [False, True], ids=["new", "over a longer chain"])
@pytest.mark.parametrize("kind", ["bake", "lut"])
def test_a_death_at_every_step_of_writing(tmp_path, kind, again):
    """Each call that changes the disk in turn is the last: the next run makes it whole and leaves nothing else."""
    source = image(tmp_path / "a.exr")
    first = dict(OPTIONS, for_="raw,exr", size=32) if again else None

    def run(out: Path) -> None:
        if kind == "bake":
            bake(source, out, **OPTIONS, for_="raw,exr")
        else:
            tables.lut("dfg", out / "d.npy", size=4)

    def before(out: Path) -> None:
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        if again:
            bake(source, out, **first) if kind == "bake" else tables.lut("dfg", out / "d.npy", size=8)

    out = tmp_path / "out"
    before(out)
    with deadly(None) as calls:
        run(out)
    want = tree(out)
    assert len(calls) > 8
    for step in range(len(calls)):
        before(out)
        with contextlib.suppress(Death), deadly(step):
            run(out)
        run(out)
        assert tree(out) == want, f"after a death at step {step}, {calls[step]}"


@pytest.mark.long
@pytest.mark.parametrize("stride", [4, pytest.param(1, marks=pytest.mark.long)])
def test_a_death_in_the_run_after_a_death(tmp_path, stride):
    """The first run dies with one of its renames done, the second, of another recipe, at one step after another:
    nothing is taken for a stranger's."""
    source, out = image(tmp_path / "a.exr"), tmp_path / "out"
    first, second = dict(OPTIONS, for_="raw,exr", exposure=1), dict(OPTIONS, for_="raw,exr")
    bake(source, out, **second)
    want = tree(out)
    shutil.rmtree(out)
    with deadly(None) as calls:
        bake(source, out, **first)
    renamed = calls.index("replace") + 1
    for step in itertools.count(0, stride):
        shutil.rmtree(out)
        with contextlib.suppress(Death), deadly(renamed):
            bake(source, out, **first)
        with contextlib.suppress(Death), deadly(step) as calls:
            bake(source, out, **second)
        bake(source, out, **second)
        assert tree(out) == want, f"after a second death at step {step}"
        if len(calls) < step:  # it lived
            break
    assert step > 20


# --- places and sources that change ---------------------------------------------------------------------


def test_a_source_that_changes_while_it_is_read_is_refused(tmp_path, monkeypatch):
    """Written to between the digest and the pixels: nothing of it is kept, and the next run bakes what is there."""
    path = image(tmp_path / "a.exr", 0)
    other = image(tmp_path / "b.exr", 1).read_bytes()
    import whitefurnace.files.image as reader

    real = reader._read

    def read(*args):
        path.write_bytes(other)
        return real(*args)

    with monkeypatch.context() as patch:
        patch.setattr(reader, "_read", read)
        with pytest.raises(FileError, match="changed while it was read"):
            bake(path, tmp_path / "out", **OPTIONS)
    assert tree(tmp_path / "out") == {}

    # Within one tick of the clock: no time tells, the bytes do.
    def same_times(*args):
        before = os.stat(path)
        path.write_bytes(other if path.read_bytes() != other else image(tmp_path / "c.exr", 2).read_bytes())
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        return real(*args)

    import whitefurnace.sphere.environments as environments

    with monkeypatch.context() as patch:
        patch.setattr(reader, "_read", same_times)
        stamps = environments._stamps
        patch.setattr(environments, "_stamps", lambda *p: tuple((*s[:4], s[3]) for s in stamps(*p)))
        with pytest.raises(FileError, match="changed while it was read"):
            bake(path, tmp_path / "out", **OPTIONS)
    (baked,) = bake(path, tmp_path / "out", **OPTIONS)
    assert baked.manifest["source"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_source_that_changes_all_the_time_never_gets_a_manifest_that_lies(tmp_path):
    """A writer exchanges the image all along, by renames and in place: whatever a manifest says it is of, it is of."""
    path, out = image(tmp_path / "a.exr", 0), tmp_path / "out"
    versions = {}
    for k in range(4):
        data = image(tmp_path / f"v{k}.exr", k).read_bytes()
        bake(tmp_path / f"v{k}.exr", tmp_path / "true", **OPTIONS)
        with np.load(tmp_path / "true" / "raw" / f"v{k}.npz") as arrays:
            versions[hashlib.sha256(data).hexdigest()] = (data, arrays["specular_0"])
    stop = threading.Event()

    def write() -> None:
        rng = random.Random(1)
        while not stop.wait(rng.uniform(0, 0.004)):
            data = rng.choice(list(versions.values()))[0]
            if rng.random() < 0.5:
                path.write_bytes(data)
            else:
                (tmp_path / "new").write_bytes(data)
                os.replace(tmp_path / "new", path)

    writer = threading.Thread(target=write)
    writer.start()
    states = []
    try:
        for _ in range(60):
            try:
                states.append(bake(path, out, **OPTIONS)[0].state)
            except Exception as error:
                states.append(type(error).__name__)
                assert type(error).__name__ in ("FileError", "InputError"), error  # changed, or cut short just then
                continue
            told = json.loads((out / "a.json").read_text())["source"]["sha256"]
            with np.load(out / "raw" / "a.npz") as arrays:
                assert told in versions and np.array_equal(arrays["specular_0"], versions[told][1])
    finally:
        stop.set()
        writer.join()
    assert "done" in states, states


@pytest.mark.parametrize("form", ["file", "faces", "ktx2", "gltf"])
def test_the_digest_without_decoding_is_that_of_the_environment(tmp_path, form):
    from whitefurnace.sphere.environments import environment, extent

    path = image(tmp_path / "a.exr", 0, 8)
    if form == "faces":
        for k, name in enumerate(("px", "nx", "py", "ny", "pz", "nz")):
            write_exr(tmp_path / "six" / f"{name}.exr", np.full((4, 4, 3), k + 1, np.float32)) if (
                tmp_path / "six"
            ).mkdir(exist_ok=True) is None else None
        path = tmp_path / "six"
    elif form in ("ktx2", "gltf"):
        engine = {"ktx2": "khronos", "gltf": "gltf"}[form]
        bake(path, tmp_path / "out", for_=engine, **OPTIONS)
        path = tmp_path / "out" / engine / {"ktx2": "a_ggx.ktx2", "gltf": "a.gltf"}[form]
    env = environment(path)
    assert source_digest(path) == env.digest
    assert extent(path) == (env.kind, *env.texels.shape[-3:-1])
    assert bake(path, tmp_path / "once", **OPTIONS)[0].state == "done"
    assert baking.status(baking.plan(BakeRequest([path], tmp_path / "once", **OPTIONS)), 0).state == "skipped"


def test_a_read_only_target_fails_alone_and_reads_on(tmp_path, shell):
    probes(tmp_path, 2)
    text = f'[[bake]]\nenvironments = ["probes/*"]\noutput = "out"\n{SIZES}'
    with mounted(tmp_path / "disk", "ro") as disk:
        path = job(tmp_path, text)
        assert shell("batch", path, "-o", disk) == 2
        assert shell.err.count("failed:") == 2 and str(disk / "out") in shell.err
        assert tree(disk) == {}
    with mounted(tmp_path / "other", "size=4m") as disk:
        assert shell("batch", path, "-o", disk) == 0
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        # What is whole already needs no lock.
        assert shell("batch", path, "-o", disk) == 0 and "all up to date" in shell.out


def test_a_full_disk_fails_what_does_not_fit_and_goes_on_when_there_is_room(tmp_path, shell):
    probes(tmp_path, 5)
    path = job(tmp_path)
    # 240 KB of npz and 6 of manifest each: three fit.
    with mounted(tmp_path / "disk", "size=840k") as disk:
        assert shell("batch", path, "-o", disk) == 8
        done = len([name for name in tree(disk / "out") if name.endswith(".json")])
        assert 0 < done < 5 and shell.err.count("failed:") == 5 - done
        assert "No space left" in shell.err
        whole(disk / "out")
        subprocess.run(["mount", "-o", "remount,size=8m", str(disk)], check=True)
        assert shell("batch", path, "-o", disk) == 0 and f"{5 - done} done, {done} up to date" in shell.out
        whole(disk / "out", {f"p{k:02d}" for k in range(5)})


def test_folders_that_stay_empty_are_removed(tmp_path, shell):
    for path in probes(tmp_path, 2):
        path.write_bytes(b"no image")
    before = tree(tmp_path)
    assert shell("batch", job(tmp_path, f'[[bake]]\nenvironments = ["probes/*"]\noutput = "a/b"\n{SIZES}')) == 3
    assert not (tmp_path / "a").exists()
    (tmp_path / "job.toml").unlink()
    assert tree(tmp_path) == before


def test_litter_of_items_that_left_the_job_goes_too(tmp_path, shell):
    probes(tmp_path, 2)
    path = job(tmp_path)
    assert shell("batch", path) == 0
    out = tmp_path / "out"
    lock = acquire(lock_path(out / "gone.json"))
    lock.note([out / "raw" / "gone.npz", out / "gone.json"])
    for name in ("raw/.gone.npz.tmp", ".gone.json.tmp"):
        (out / name).write_bytes(b"half")
    (out / "raw" / ".foreign.tmp").write_bytes(b"mine")
    os.close(lock._handle)  # as a death does
    assert shell("batch", path) == 0
    assert [name for name in tree(out) if Path(name).name.startswith(".")] == ["raw/.foreign.tmp"]


def test_what_is_sent_is_read_without_its_path(tmp_path):
    """A source by value: the same bytes come out, with the source away."""
    probes(tmp_path, 1)
    image(tmp_path / "six" / "px.exr")
    for k, name in enumerate(("px", "nx", "py", "ny", "pz", "nz")):
        write_exr(tmp_path / "six" / f"{name}.exr", np.full((4, 4, 3), k + 1, np.float32))
    path = job(tmp_path, f'[[bake]]\nenvironments = ["probes/*", "six"]\noutput = "out"\n{SIZES}')
    items = [batch.load(item) for item in batch.job(path, send=True).items]
    for item in batch.job(path).items:
        assert batch.do(item).state == "done"
    want = tree(tmp_path / "out")
    shutil.rmtree(tmp_path / "out")
    shutil.rmtree(tmp_path / "probes")
    shutil.rmtree(tmp_path / "six")
    assert [batch.do(item).state for item in items] == ["done", "done"]
    assert tree(tmp_path / "out") == want
    assert [batch.do(item).state for item in items] == ["skipped", "skipped"]


def test_a_result_is_small_and_items_can_be_sent(tmp_path):
    import pickle

    probes(tmp_path, 1)
    (item,) = batch.job(job(tmp_path)).items
    assert pickle.loads(pickle.dumps(item)) == item
    result = batch.do(item)
    # Ten thousand of them are to lie in a client's memory.
    assert len(pickle.dumps(result)) < 4096 and pickle.loads(pickle.dumps(result)) == result


def test_help_of_batch_imports_nothing_heavy():
    script = (
        "import sys\nfrom whitefurnace.cli import main\n"
        "try: main(['batch', '--help'])\nexcept SystemExit: pass\n"
        "sys.exit(bool({'numpy', 'msgspec', 'distributed'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", script], capture_output=True).returncode == 0


def test_workers_use_the_device_of_their_parent(tmp_path, monkeypatch):
    """Each worker is told the address of the parent's device; a worker that chose for itself could find another."""
    write_exr(tmp_path / "a.exr", np.full((8, 16, 3), 0.5, np.float32))
    (tmp_path / "job.toml").write_text('[[bake]]\nenvironments = ["a.exr"]\nsize = 8\nmin_size = 4\noutput = "out"\n')
    seen = []
    monkeypatch.setattr(batch.pool, "run", lambda stages, items, **options: seen.extend(items))
    for options in ({}, {"workers": 2}, {"scheduler": "tcp://127.0.0.1:1"}):
        batch.run(batch.job(tmp_path / "job.toml"), on_result=print, **options)
    address = choose_device().address
    assert [item.device for item in seen] == [None, address, None]


def test_workers_say_why_no_device_works(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr", np.full((8, 16, 3), 0.5, np.float32))
    (tmp_path / "job.toml").write_text('[[bake]]\nenvironments = ["a.exr"]\nsize = 8\nmin_size = 4\noutput = "out"\n')
    seen = []
    monkeypatch.setattr(batch.pool, "run", lambda stages, items, **options: seen.extend(items))
    batch.run(batch.job(tmp_path / "job.toml", device="no such device"), on_result=print, workers=2)
    assert [item.device for item in seen] == ["no such device"]
