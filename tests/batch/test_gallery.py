"""The page of a batch: its rows say what the manifests say, strangers' names stay text, it sorts in a browser, what has
not changed is not drawn again, and ten thousand rows take no memory."""

from __future__ import annotations

import json
import os
import re
import subprocess
import tempfile
import tracemalloc
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote_to_bytes

import msgspec
import numpy as np
import pytest

import browser
from shell import Shell
from whitefurnace import bake
from whitefurnace.batch import gallery
from whitefurnace.batch.gallery import Gallery, found_in, write_gallery
from whitefurnace.batch.jobs import Result
from whitefurnace.engines.presets import ENGINES
from whitefurnace.errors import FileError
from whitefurnace.files import decode_srgb, write_exr
from whitefurnace.rendering import thumbnails
from whitefurnace.sphere.grids import cube_centres, turned_cube

VOID = {"meta", "col", "img", "input", "br", "rect"}  # rect: <rect/> in SVG
KEY = "0123456789abcdef" * 4


@dataclass
class Page(HTMLParser):
    """Rows of each table as texts and sort keys, and every tag with its attributes; fails where tags do not nest."""

    text: str
    tags: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    heads: dict[str, list[str]] = field(default_factory=dict)
    rows: dict[str, list[list[tuple[str, str | None]]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.table = ""
        self.feed(self.text)
        self.close()
        assert not self.open, self.open

    def handle_starttag(self, tag, attributes):
        names = [name for name, _ in attributes]
        assert len(names) == len(set(names)), (tag, names)
        given = dict(attributes)
        self.tags.append((tag, given))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.table = given["class"].split()[0]
            self.heads[self.table], self.rows[self.table] = [], []
        elif tag == "tr" and "tbody" in self.open:
            self.rows[self.table].append([])
        elif tag in ("td", "th") and "tbody" in self.open:
            self.rows[self.table][-1].append(("", given.get("data-v")))
        elif tag == "th":
            self.heads[self.table].append("")

    def handle_endtag(self, tag):
        assert tag in VOID or self.open.pop() == tag, (tag, self.open)

    def handle_data(self, data):
        if "tbody" in self.open and self.open[-1] != "tbody" and self.rows[self.table][-1:]:
            cell, key = self.rows[self.table][-1].pop()
            self.rows[self.table][-1].append((cell + data, key))
        elif "thead" in self.open:
            self.heads[self.table][-1] += data

    def values(self, column: str, table: str = "bake") -> list[float | None]:
        at = self.heads[table].index(column)
        return [None if row[at][1] is None else float(row[at][1]) for row in self.rows[table]]


def opened(path: Path) -> Page:
    page = Page(path.read_text("utf-8"))
    assert page.text.startswith("<!DOCTYPE html>\n<html lang=")
    said = [given for tag, given in page.tags if tag == "meta" and given.get("http-equiv")]
    assert said and "default-src 'none'" in said[0]["content"]
    assert [tag for tag, _ in page.tags].count("script") == 1
    ids = [given["id"] for _, given in page.tags if "id" in given]
    assert len(ids) == len(set(ids))
    for tag, given in page.tags:
        # No handlers, no styles (the policy would refuse them), and nothing from elsewhere.
        assert not [name for name in given if name.startswith("on") or name in ("style", "srcset")], (tag, given)
        for name in ("src", "href"):
            if name in given:
                assert not re.match(r"[a-z]+:|//", given[name], re.I), given
                assert (path.parent / unquoted(given[name])).exists(), given
        if tag == "img":
            assert given["alt"] and given["loading"] == "lazy" and int(given["width"]) > int(given["height"])
        if tag == "th":
            assert given["scope"] in ("col", "row")
    return page


def unquoted(address: str) -> str:
    return os.fsdecode(unquote_to_bytes(address))


def done(manifest: Path, index: int = 0, **given: object) -> Result:
    told = json.loads(manifest.read_text("utf-8"))
    size = sum(entry["bytes"] for entry in told["files"].values())
    return Result(
        **{
            **dict(
                index=index,
                kind="bake",
                place=f"bake[0]: {told['name']}.exr",
                name=told["name"],
                state="done",
                output=str(manifest.parent),
                manifest=str(manifest),
                seconds={"read": 0.25, "compute": 1.0, "write": 0.5},
                nbytes=size,
            ),
            **given,
        }
    )


# Names of files, and so of environments: markup, both quotes, an entity, what runs right to left, and an override.
NAMES = ("<script>window.alerted=true<", "a\"b'c&amp;d", "été 環境 %41#?", "עברית\u202eexr.<b>")


@pytest.fixture(scope="module")
def baked(tmp_path_factory, device) -> Path:
    """Four small skies of different suns, by names that are none of ours."""
    folder = tmp_path_factory.mktemp("gallery")
    for k, name in enumerate(NAMES):
        pixels = np.random.default_rng(k).random((16, 32, 3), dtype=np.float32) + np.float32(0.1)
        pixels[4, 7] = 10.0**k
        write_exr(folder / f"{name}.exr", pixels)
    bake(
        [folder / f"{name}.exr" for name in NAMES],
        folder / "out",
        for_="raw,babylon",
        size=16,
        tolerance=1e-2,
        device=device,
    )
    return folder / "out"


def test_rows_say_what_manifests_say(baked, tmp_path):
    manifests = [baked / f"{name}.json" for name in NAMES]
    failed = Result(
        9, "bake", "bake[1]: no\n<i>.exr", "no", "failed", "out", message="no <i>.exr & \x1b[2Jno \udcff", exit_code=3
    )
    results = [*(done(m, k) for k, m in enumerate(manifests)), failed]
    path = write_gallery(tmp_path / "a", results, title="</title><script>alert(1)</script>.toml")
    page = opened(path)
    assert page.heads["bake"] == [name for name, _ in gallery.BAKES]
    told = [json.loads(m.read_text("utf-8")) for m in manifests]
    for row, name in zip(page.rows["bake"], NAMES, strict=True):
        assert row[0][0].startswith(name), "names of the files, character by character"
    errors = [max(x["error"] for x in (*m["levels"], m["irradiance"])) for m in told]
    assert page.values("Largest error") == pytest.approx(errors, rel=1e-5)  # six digits
    stored = [max(x["error"] + x["format_p99"] for x in m["files"][f"babylon/{m['name']}.env"]["levels"]) for m in told]
    assert page.values("As stored") == pytest.approx([max(a, b) for a, b in zip(stored, errors, strict=True)], rel=0.5)
    assert all(v >= s * (1 - 1e-5) for v, s in zip(page.values("As stored"), stored, strict=True))
    assert page.values("Sun share") == pytest.approx(
        [m["source"]["statistics"]["brightest_share"] for m in told], rel=1e-5
    )
    kept = [max(abs(x["energy_kept"] - 1) for x in m["levels"]) for m in told]
    assert page.values("Energy kept") == pytest.approx(kept, rel=1e-5)
    assert page.values("Time") == [1.75] * 4
    assert page.values("Size") == [result.nbytes for result in results[:4]]
    # Of the brightest sun RGBD keeps 255 of the mean at most, which the bake said and the manifest tells.
    assert page.values("Notices")[3] > 0 and "rgbd" in page.rows["bake"][3][-1][0]
    assert page.rows["failed"] == [
        [("bake[1]: no\\n<i>.exr", None), ("no <i>.exr & \\x1b[2Jno \\udcff", None), ("3", "3")]
    ]
    assert page.text.index('id="of-failed"') < page.text.index('id="of-bake"'), "failures stand on top"
    head = page.text[: page.text.index("<main>")]
    assert "<dt>items</dt><dd>5<" in head and "<dt>failed</dt><dd>1<" in head and told[0]["device"]["name"] in head
    assert "&lt;/title&gt;&lt;script&gt;alert(1)&lt;/script&gt;.toml" in head


def test_the_same_results_give_the_same_bytes_in_any_order(baked, tmp_path):
    results = [done(baked / f"{name}.json", k) for k, name in enumerate(NAMES)]
    paths = [write_gallery(tmp_path / where, given) for where, given in (("a", results), ("b", reversed(results)))]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    pictures = [{p.name: p.read_bytes() for p in (tmp_path / where / "strips").iterdir()} for where in "ab"]
    assert pictures[0] == pictures[1] and len(pictures[0]) == 4
    # Up to date, times are of no run; a folder of outputs is all that is needed.
    page = opened(write_gallery(tmp_path / "a", found_in(baked)))
    assert page.values("Time") == [None] * 4 and len(page.rows["bake"]) == 4
    assert not [p for p in (tmp_path / "a").iterdir() if p.name not in ("index.html", "strips")]


def test_only_what_changed_is_drawn_again(baked, tmp_path, device):
    def pictures() -> dict[str, int]:
        return {p.name: p.stat().st_ino for p in (report / "strips").iterdir()}

    out, report = tmp_path / "out", tmp_path / "report"
    sources = [baked.parent / f"{name}.exr" for name in NAMES[:2]]
    bake(sources, out, size=16, tolerance=1e-2, device=device)
    write_gallery(report, found_in(out))
    before = pictures()
    (report / "strips" / "mine.png").write_bytes(b"not ours")
    bake(sources[0], out, size=16, tolerance=1e-2, exposure=1, device=device)
    write_gallery(report, found_in(out))
    after = pictures()
    del after["mine.png"]
    assert len(after) == 2 and len(before.items() & after.items()) == 1
    # An interrupted batch has not seen all: it removes nothing, and says how many are missing.
    with Gallery(report, title="part") as page:
        page.add(done(out / f"{NAMES[0]}.json"))
        text = page.close(total=7).read_text("utf-8")
    assert "<dt>not begun</dt><dd>6<" in text and after.keys() <= pictures().keys()


def test_a_page_of_somebody_else_is_not_replaced(baked, tmp_path):
    (tmp_path / "index.html").write_text("<title>home</title>")
    with pytest.raises(FileError, match="not a report of whitefurnace"):
        write_gallery(tmp_path, found_in(baked))
    assert (tmp_path / "index.html").read_text() == "<title>home</title>"
    write_gallery(tmp_path, found_in(baked), force=True)
    write_gallery(tmp_path, found_in(baked))
    with pytest.raises(FileError, match="cannot write the report"):
        write_gallery(tmp_path / "index.html" / "deeper", [])


def test_a_bake_without_its_files_keeps_its_row(baked, tmp_path, device):
    out = tmp_path / "out"
    bake(baked.parent / f"{NAMES[0]}.exr", out, size=16, tolerance=1e-2, device=device)
    (out / "raw" / f"{NAMES[0]}.npz").unlink()
    page = opened(write_gallery(tmp_path / "report", found_in(out)))
    assert "no picture" in page.rows["bake"][0][0][0] and "is not there" in page.rows["bake"][0][0][0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"key": "../../x"},
        {"recipe": []},
        {"recipe": {"for": [3]}},
        {"levels": [1, {"error": "x", "size": []}]},
        {"levels": [{"error": 1e999, "for": 3}]},
        {"files": {"a": 7, "raw/x": {"levels": {"a": 1}, "bytes": -1e308}}},
        {"source": 3},
        {"source": {"notices": 5, "statistics": []}},
        {"sh": {"coefficients": [[1]]}},
        {"device": "<b>"},
        {"irradiance": 5},
        {"whitefurnace": ["<b>"]},
        {"notices": {"<b>": 1}},
        {"files": []},
        {"name": 5},
    ],
)
def test_a_manifest_with_nonsense_in_it_breaks_no_page(baked, tmp_path, wrong):
    told = json.loads((baked / f"{NAMES[1]}.json").read_text("utf-8"))
    path = tmp_path / f"{NAMES[1]}.json"
    path.write_text(json.dumps({**told, **wrong}))
    result = msgspec.structs.replace(done(baked / f"{NAMES[1]}.json"), manifest=str(path))
    page = opened(write_gallery(tmp_path / "report", [result]))
    assert len(page.rows["bake"]) == 1 and not any(tag == "b" and "<b>" in str(given) for tag, given in page.tags)


# ------------------------------------------------------------------------------------------------- pictures


def by_direction(size: int) -> np.ndarray:
    """A cube whose colour tells the direction: ½ + ½ (x, y, z)."""
    d = cube_centres(size, np.arange(6 * size * size))
    return np.asarray((0.5 + 0.5 * d).T.reshape(6, size, size, 3), np.float32)


def linear(picture: np.ndarray, exposure: float) -> np.ndarray:
    """The radiance that a pixel of a strip shows: `tone` solved for x, y(2.43x² + .59x + .14) = 2.51x² + .03x."""
    y = decode_srgb(picture).astype(np.float64)
    a, b, c = 2.51 - 2.43 * y, 0.03 - 0.59 * y, -0.14 * y
    return (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a) / exposure


@pytest.mark.parametrize("name", ["raw", "three", "babylon"])
def test_a_strip_shows_each_direction_where_it_is(name):
    """In the axes of every engine: three.js mirrors its faces."""
    cube = by_direction(64)
    matrix = ENGINES[name].matrix
    matte = (0.5 + 0.5 * thumbnails.normals()).T
    stored = turned_cube(cube, matrix)
    picture = thumbnails.thumbnail([stored, stored[:, ::4, ::4]], matte, matrix)
    assert picture.shape == (thumbnails.CELL, 5 * thumbnails.CELL, 4)
    shown = 2 * linear(picture[..., :3], thumbnails.exposure_of(cube)) - 1
    c = thumbnails.CELL
    # ½/255 of sRGB and the width of a pixel, .05 rad, beside what 32² texels a face leave.
    near = dict(abs=0.08)
    assert shown[c // 2, c] == pytest.approx([1, 0, 0], **near)  # +X in the middle of the panorama,
    assert shown[c // 2, c + c // 2] == pytest.approx([0, 0, 1], **near)  # +Z to its right,
    assert shown[1, c] == pytest.approx([0, 1, 0], **near)  # +Y up
    middle = 2 * c + c // 2
    assert shown[c // 2, middle] == pytest.approx([0, 0, 1], **near)  # a mirror seen from +Z shows +Z,
    # and where its normal is turned by 45°, at sin 45° of its radius, what lies at the side.
    radius = 0.45 * c * np.sqrt(0.5)
    assert shown[c // 2, round(middle + radius - 0.5)] == pytest.approx([1, 0, 0], abs=0.15)
    assert shown[round(c / 2 - radius - 0.5), middle] == pytest.approx([0, 1, 0], abs=0.15)
    # The matte sphere at the normal itself: 0.95 of its radius to the right is near +X.
    assert shown[c // 2, 4 * c + round(c / 2 + 0.45 * c * 0.95)][0] == pytest.approx(0.95, abs=0.05)
    assert picture[0, 2 * c, 3] == 0 and picture[c // 2, middle, 3] == 255, "beside a sphere is the page"


def test_a_furnace_is_grey_at_any_radiance():
    """A constant environment has its own average: x = .18, and the curve of it everywhere a strip shows something."""
    x = 0.18
    curve = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    srgb = 1.055 * curve ** (1 / 2.4) - 0.055
    for radiance in (1e-6, 1.0, 3e4):
        cube = np.full((6, 16, 16, 3), radiance, np.float32)
        matte = np.full((thumbnails.normals().shape[1], 3), radiance)
        picture = thumbnails.thumbnail([cube], matte)
        colours = picture[picture[..., 3] > 0][:, :3].astype(int)
        assert np.abs(colours - 255 * srgb).max() <= 1, radiance  # rounded to 8 bits
    assert not thumbnails.thumbnail([np.zeros((6, 4, 4, 3), np.float32)], np.zeros_like(matte))[..., :3].any()
    cube[2, 3, 4] = np.inf  # as a half of over 65504 is read: it decides on nothing
    assert (thumbnails.thumbnail([cube], matte) == picture).all()


def test_every_engine_shows_the_same_sky(baked, tmp_path, device):
    """Formats, axes and containers are undone: panoramas of level 0 agree within what R11G11B10F keeps."""
    source, pictures = baked.parent / f"{NAMES[0]}.exr", {}
    for name in ("raw", "exr", "filament", "three", "godot"):
        bake(source, tmp_path / name, for_=name, size=32, tolerance=1e-2, device=device)
        manifest = tmp_path / name / f"{NAMES[0]}.json"
        picture = thumbnails.thumbnail(*thumbnails.read_thumbnail(manifest, json.loads(manifest.read_text("utf-8"))))
        pictures[name] = picture[:, : 2 * thumbnails.CELL, :3].astype(int)
        matte = picture[thumbnails.CELL // 2, -thumbnails.CELL // 2, :3].astype(int)
        assert np.abs(matte - pictures.setdefault("matte", matte)).max() <= 8, name
    for name, picture in pictures.items():
        # Godot's is sampled from the lat-long, not filtered over it.
        assert name == "matte" or np.abs(picture - pictures["raw"]).mean() < (12 if name == "godot" else 2), name


# ------------------------------------------------------------------------------------------------- in a browser


def many(folder: Path, count: int) -> list[Result]:
    """Results that share one manifest."""
    manifest = folder / "env.json"
    rows = [
        {"size": 128 >> k, "error": 1e-4 / (k + 1), "worst": 2e-4, "energy_kept": 1.0, "for": ["raw"]} for k in range(4)
    ]
    manifest.write_text(
        json.dumps(
            {
                "whitefurnace": "0.1.0",
                "name": "env",
                "key": KEY,
                "levels": rows,
                "irradiance": rows[0],
                "recipe": {"for": ["raw"]},
                "device": {"name": "a", "platform": "b", "driver": "c"},
                "files": {},
                "source": {"layout": "latlong", "statistics": {"width": 8, "height": 4, "brightest_share": 0.25}},
            }
        )
    )
    thumbnails.write_thumbnail(
        folder / "x.png",
        ([np.ones((6, 4, 4, 3), np.float32)], np.ones((thumbnails.normals().shape[1], 3)), thumbnails.WORLD),
    )
    (folder / "strips").mkdir()
    (folder / "x.png").rename(folder / "strips" / f"{KEY[:32]}-{thumbnails.LOOK}.png")
    return [
        Result(
            k,
            "bake",
            f"bake[0]: probes/env {k:02d}.exr",
            f"env {k}",
            "done" if k % 3 else "skipped",
            "out",
            str(manifest),
            {"compute": float(k * 7919 % 101)},
            1000 + k * 104729 % 5003,
        )
        for k in range(count)
    ]


@pytest.fixture
def chromium() -> str:
    found = browser.chromium()
    if found is None:
        pytest.skip(f"none of {', '.join(browser.CHROMIUM)} is installed, and WHITEFURNACE_CHROMIUM names none")
    return found


@pytest.mark.parametrize("most", [gallery.MANY, 20])  # a table, and rows of which only those in sight are laid out
def test_it_sorts_and_finds_in_a_browser(chromium, tmp_path, monkeypatch, most):
    monkeypatch.setattr(gallery, "MANY", most)
    results = many(tmp_path, 30)
    write_gallery(tmp_path, results)
    about = browser.rendered("gallery", [], tmp_path, tmp_path).about
    names = [result.name for result in results]
    assert about["first"] == {"names": names, "sorts": [None] * 8, "said": ""}
    assert about["focusable"] and about["images"] == [[thumbnails.CELL * 4, thumbnails.CELL]] * 30
    up, down = about["sorted"]["Environment"]
    assert up["names"] == names and down["names"] == names[::-1]  # env 2 before env 10
    assert up["sorts"] == ["ascending", *[None] * 7] and down["sorts"] == ["descending", *[None] * 7]
    assert "Environment" in up["said"]
    # Equal ones keep the order that they had, ascending and descending.
    known = {"Time": lambda r: sum(r.seconds.values()) if r.state == "done" else None, "Size": lambda r: r.nbytes}
    assert list(about["sorted"]) == [name for name, _ in gallery.BAKES]
    for column, key in known.items():
        for shown, sign in zip(about["sorted"][column], (1, -1), strict=True):
            keys = [key(next(r for r in results if r.name == name)) for name in shown["names"]]
            values = [k for k in keys if k is not None]
            assert values == sorted(values, key=lambda k, sign=sign: sign * k), column
            assert keys[len(values) :] == [None] * (30 - len(values)), "what has no value is last"
    assert about["found"]["names"] == ["env 7"] and about["found"]["said"] == "1 of 30 environments"


def test_strangers_names_run_nothing_in_a_browser(chromium, baked, tmp_path):
    """From disk, where its policy must let it see its own pictures, and from a server."""
    path = write_gallery(
        tmp_path / "r", [done(baked / f"{name}.json", k) for k, name in enumerate(NAMES)], title=NAMES[0]
    )
    about = browser.rendered("gallery", [], tmp_path / "r", tmp_path / "r").about
    assert about["first"]["names"] == list(NAMES) and not about["alerted"]
    assert all(width > height > 0 for width, height in about["images"])
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        said = subprocess.run(
            [
                chromium,
                *browser.FLAGS,
                f"--user-data-dir={profile}",
                "--enable-logging=stderr",
                "--dump-dom",
                path.as_uri(),
            ],
            capture_output=True,
            timeout=60,
        )
    console = [line for line in said.stderr.decode(errors="replace").splitlines() if "CONSOLE" in line]
    assert not console, console
    assert b'id="of-bake"' in said.stdout


# ------------------------------------------------------------------------------------------------- scale, command line


@pytest.mark.parametrize("rows", [2_000, pytest.param(10_000, marks=pytest.mark.long)])
def test_thousands_of_rows_take_no_memory(tmp_path, rows):
    results = many(tmp_path, rows)
    tracemalloc.start()
    try:
        path = write_gallery(tmp_path, results)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # An index of 10 000 rows, some 150 bytes each, and what one manifest and the page's frame take.
    assert peak < 4e6, f"{peak / 1e6:.1f} MB"
    text = path.read_text("utf-8")
    assert text.count('<tr><th scope="row">') == rows and len(text) < 1500 * rows, len(text)


def test_batch_writes_it(tmp_path, capsys, device):
    shell = Shell(capsys)
    write_exr(tmp_path / "a.exr", np.ones((4, 8, 3), np.float32))
    (tmp_path / "b.exr").write_bytes(b"no image")
    job = tmp_path / "job.toml"
    job.write_text(
        '[[bake]]\nenvironments = ["*.exr"]\noutput = "out"\nsize = 16\nmin_size = 16\ntolerance = 1e-2\n'
        '[[lut]]\nkind = "dfg"\noutput = "dfg.npy"\nsize = 8\ntolerance = 1e-3\n'
    )
    report = tmp_path / "report"
    assert shell("batch", job, "--report", report, "--dry-run") == 8 and not report.exists()
    assert shell("batch", job, "--report", report, "--json", "--device", device.name) == 8
    rows = [json.loads(line) for line in shell.out.splitlines()]
    assert {"event": "report", "file": str(report / "index.html")} in rows
    page = opened(report / "index.html")
    assert [len(page.rows[kind]) for kind in ("failed", "bake", "lut")] == [1, 1, 1]
    assert page.rows["lut"][0][0][0].startswith("dfg.npy") and page.values("Error", "lut")[0] < 1e-3
    first = (report / "index.html").read_bytes()
    shell("batch", job, "--report", report, "--quiet")
    assert (report / "index.html").read_bytes() != first, "nothing was baked, so no times"
    again = (report / "index.html").read_bytes()
    shell("batch", job, "--report", report, "--quiet")
    assert (report / "index.html").read_bytes() == again
