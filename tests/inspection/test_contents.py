"""What is read of any file that we or an engine know: every container gives the levels that were written, `inspect`
says so, `bake` takes them, and anything else is one sentence."""

from __future__ import annotations

import base64
import contextlib
import json
import math
import os
import random
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from exr_writer import Part, exr, floats, planes
from mutations import STRUCTURED
from reference import cube_directions
from whitefurnace import environment
from whitefurnace.cli import main
from whitefurnace.errors import FileError, InputError, UnsupportedError, UsageError
from whitefurnace.files import (
    FolderOutput,
    Texture,
    digest_file,
    light_digest,
    read_npy,
    read_npz,
    write_exr,
    write_hdr,
    write_manifest,
    write_npz,
    write_texture,
)
from whitefurnace.files.codec import encode
from whitefurnace.files.env import LEAST_SCALE, MOST_SCALE, EnvMap, write_env
from whitefurnace.files.gltf_lights import GltfLight, write_gltf_lights
from whitefurnace.files.memory import VARIABLE
from whitefurnace.files.packing import step
from whitefurnace.files.png import encode_png
from whitefurnace.files.texture import text_value
from whitefurnace.inspection.contents import contents, described, looks_like, statistics
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere.environments import LAYOUTS

SIZES = (8, 4, 2, 1)
FORMATS = {
    ".ktx": ("rgb16f", "rgba16f", "rgba32f", "rgb9e5", "b10g11r11"),
    ".ktx2": ("rgb16f", "rgba16f", "rgba32f", "rgb9e5", "b10g11r11"),
    ".dds": ("rgba16f", "rgba32f", "rgb9e5", "b10g11r11"),
}
TITLES = {".ktx": "KTX 1", ".ktx2": "KTX 2", ".dds": "DDS", ".env": "Babylon .env", ".gltf": "glTF"}


def levels(seed=1) -> list[np.ndarray]:
    """A chain of cubes over three decades, no texel like another."""
    rng = np.random.default_rng(seed)
    return [(10 ** rng.uniform(-2, 1, (6, s, s, 3))).astype(np.float32) for s in SIZES]


def written(folder: Path, suffix: str, form: str, chain=None, **options) -> Path:
    """The chain as a file of that container and pixel format."""
    chain = levels() if chain is None else chain
    path = folder / f"cube_{form}{suffix}"
    if suffix == ".env":
        write_env(path, EnvMap(tuple(chain), np.zeros((9, 3))))
    elif suffix == ".gltf":
        write_gltf_lights(path, GltfLight(tuple(chain), np.zeros((9, 3))))
    else:
        write_texture(path, encode(form, chain, cube=True, **options).texture, zstd=3 if suffix == ".ktx2" else None)
    return path


EVERY = [(suffix, form) for suffix, forms in FORMATS.items() for form in forms] + [(".env", "rgbd"), (".gltf", "rgbd")]


@pytest.mark.parametrize("suffix, form", EVERY)
def test_every_container_gives_the_levels_that_were_written(tmp_path, suffix, form):
    path = written(tmp_path, suffix, form)
    found = contents(path)
    assert (found.kind, found.container) == ("cube", TITLES[suffix]) and found.format.startswith(form)
    assert [level.size for level in found.levels] == list(SIZES) == [found.facts["width"] >> k for k in range(4)]
    for level, wanted in zip(found.levels, levels(), strict=True):
        off = np.abs(level.texels[..., :3] - wanted.astype(np.float64))
        assert (off <= step(form, wanted)).all(), f"{off.max()} off in {level.name}"
    if suffix != ".gltf":
        assert 0 < sum(level.stored for level in found.levels) < path.stat().st_size
    assert found.statement is None and "no manifest" in shown(path)


def shown(path: Path) -> str:
    from whitefurnace.cli.inspect import inspect_text

    return inspect_text(described(contents(path)))


def test_arrays_and_strips_are_the_same_cube(tmp_path):
    cube = levels()[0]
    write_npz(
        tmp_path / "a.npz",
        {
            "specular_0": cube,
            "roughness": [0.0],
            "error": [1e-4],
            "sh": np.arange(27.0).reshape(9, 3),
            "dfg": np.ones((4, 4, 2), np.float32),
        },
    )
    np.save(tmp_path / "a.npy", cube)
    write_exr(tmp_path / "a.exr", cube.reshape(48, 8, 3))
    for name in ("a.npz", "a.npy", "a.exr"):
        found = contents(tmp_path / name)
        assert found.kind == "cube" and np.array_equal(found.levels[0].texels, cube), name
    found = contents(tmp_path / "a.npz")
    assert found.levels[0].roughness == 0 and found.levels[0].stated == {"error": 1e-4}
    assert found.sh[1, 2] == 5 and found.dfg.texels.shape == (4, 4, 2)
    # A cross: each face at the place that the table of layouts says, -Z turned by half.
    cross = np.zeros((32, 24, 3), np.float32)
    layout = next(one for one in LAYOUTS if one.name == "vertical cross")
    for face, cell in zip(cube, layout.cells, strict=True):
        cross[8 * cell.row : 8 * cell.row + 8, 8 * cell.column : 8 * cell.column + 8] = np.rot90(face, -cell.turns)
    write_exr(tmp_path / "cross.exr", cross)
    found = contents(tmp_path / "cross.exr")
    assert found.facts["layout"] == "vertical cross" and np.array_equal(found.levels[0].texels, cube)


def test_harmonics_come_back_from_every_engine_s_scale(tmp_path):
    """L = 1 + y/2: L00 = √(4π), L1-1 = ½ √(4π/3), and E/π = 1 + y/3, of which Filament has 1 and 1/3."""
    wanted = np.zeros((9, 3))
    wanted[:2] = np.array([[math.sqrt(4 * math.pi)], [math.sqrt(4 * math.pi / 3) / 2]])
    numbers = np.zeros((9, 3))
    numbers[:2] = np.array([[1.0], [1 / 3]])
    text = "\n".join(" ".join(f"{x:.9g}" for x in row) for row in numbers)
    path = written(tmp_path, ".ktx", "b10g11r11", key_values={"sh": text_value(text)})
    np.testing.assert_allclose(contents(path).sh, wanted, atol=1e-8)  # nine digits of the text
    assert looks_like(contents(path)) == ["filament: the prefiltered chain"]
    write_env(tmp_path / "a.env", EnvMap(tuple(levels()), harmonic.babylon(wanted)))
    np.testing.assert_allclose(contents(tmp_path / "a.env").sh, wanted, atol=1e-12)
    write_gltf_lights(tmp_path / "a.gltf", GltfLight(tuple(levels()), harmonic.irradiance(wanted)))
    np.testing.assert_allclose(contents(tmp_path / "a.gltf").sh, wanted, atol=1e-12)


def test_what_is_wrong_with_values_is_counted(tmp_path):
    cube = np.ones((6, 4, 4, 4), np.float32)
    cube[0, 0, 0] = np.nan
    cube[1, 2, 3, 1] = np.inf
    cube[2, 1, 1, 0] = -2
    cube[3, 1, 1, :2] = 65504
    cube[4, 0, 0, 3] = 0.25
    data = cube.astype("<f2").tobytes()
    write_texture(tmp_path / "a.ktx2", Texture("rgba16f", 4, 4, (data,), 0, 6))
    found = contents(tmp_path / "a.ktx2")
    said = statistics(found, found.levels[0])
    assert (said.nan, said.infinite, said.negative, said.at_limit) == (3, 1, 1, 2)
    assert (said.low, said.high) == (-2, 65504) and said.alpha == (0.25, 1.0)
    # The mean over the sphere of what is finite: the corner texel left out, -2 and 65504 by their solid angle.
    from whitefurnace.sphere.environments import cube_solid_angles

    omega = cube_solid_angles(4)
    total = 4 * math.pi - omega[0, 0]
    assert said.mean[0] == pytest.approx((total - 3 * omega[1, 1] + 65503 * omega[1, 1]) / total, rel=1e-12)
    text = shown(tmp_path / "a.ktx2")
    assert "3 NaN, 1 infinite, 1 negative, 2 at the format's limit, alpha 0.25 … 1" in text
    with pytest.raises(InputError, match="--bad-pixels zero"):
        environment(tmp_path / "a.ktx2")
    fixed = environment(tmp_path / "a.ktx2", nonfinite="zero")
    assert np.isfinite(fixed.texels).all() and fixed.texels.min() == 0 and len(fixed.notices) == 2


def test_a_manifest_proves_a_file_whole_or_not(tmp_path):
    cube = levels()[:2]
    (tmp_path / "three").mkdir()
    path = tmp_path / "three" / "day_1.dds"
    write_texture(path, encode("rgba16f", cube, cube=True).texture)
    rows = [
        {"size": 8, "roughness": 0.0, "error": 1e-4, "format_p99": 2e-4},
        {"size": 4, "roughness": 1.0, "error": 2e-4},
    ]
    entry = {"sha256": digest_file(path), "bytes": 1, "holds": "specular", "levels": rows}
    write_manifest(
        tmp_path / "day_1.json",
        {
            "whitefurnace": "1",
            "name": "day_1",
            "key": "abcdef0123456789",
            "files": {"three/day_1.dds": entry},
            "recipe": {"size": 8},
        },
    )
    found = contents(path)
    assert found.statement.whole and found.written_for == ("three", "-x +y +z")
    assert [level.roughness for level in found.levels] == [0.0, 1.0]
    assert found.levels[0].stated == {"error": 1e-4, "format_p99": 2e-4}
    assert "the digests match" in shown(path) and "key abcdef012345…" in shown(path)
    listed = contents(tmp_path / "day_1.json")
    assert listed.kind == "manifest" and listed.statement.whole
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert contents(path).statement.whole is False and "files were changed since" in shown(path)
    assert contents(tmp_path / "day_1.json").statement.whole is False


def test_a_file_of_an_earlier_bake_shows_the_recipe_of_that_bake(tmp_path):
    """Two bakes into one folder for different engines: the second one's manifest keeps what the first one said."""
    output = FolderOutput(tmp_path / "day.json")
    (tmp_path / "raw").mkdir()
    (tmp_path / "exr").mkdir()
    np.save(tmp_path / "raw" / "day.npy", levels()[0])
    write_exr(tmp_path / "exr" / "day.exr", levels()[0].reshape(48, 8, 3))
    first = {
        "whitefurnace": "1",
        "name": "day",
        "key": "1111",
        "recipe": {"size": 8},
        "levels": [{"size": 8, "error": 1e-4}],
        "irradiance": {"error": 1e-5},
        "files": {"raw/day.npy": {"sha256": digest_file(tmp_path / "raw" / "day.npy"), "bytes": 1}},
    }
    write_manifest(output.path, first)
    there = output.manifest()
    stale, kept = output.superseded(there, ["exr/day.exr"])
    second = {
        **first,
        "key": "2222",
        "recipe": {"size": 512},
        "irradiance": {"error": 7e-2},
        "files": {"exr/day.exr": {"sha256": digest_file(tmp_path / "exr" / "day.exr"), "bytes": 1}},
        "kept": kept,
        "earlier": output.earlier(there, kept),
    }
    write_manifest(output.path, second)
    stated = contents(tmp_path / "raw" / "day.npy").statement
    assert stale == [] and stated.whole and stated.stated["key"] == "1111" and stated.stated["recipe"] == {"size": 8}
    assert stated.stated["irradiance"] == {"error": 1e-5}
    assert "key 1111" in shown(tmp_path / "raw" / "day.npy") and "recipe size 8" in shown(tmp_path / "raw" / "day.npy")
    assert "recipe size 512" in shown(tmp_path / "exr" / "day.exr")
    # A third bake keeps both; a manifest of before that says nothing of an earlier bake states no recipe of another.
    kept = output.superseded(output.manifest(), ["three/day.ktx2"])[1]
    assert output.earlier(output.manifest(), kept).keys() == {"1111", "2222"}
    write_manifest(output.path, {**second, "kept": {"raw/day.npy": first["files"]["raw/day.npy"]}, "earlier": {}})
    assert contents(tmp_path / "raw" / "day.npy").statement.stated == {"engine": "raw"}


def test_a_table_is_what_its_manifest_says(tmp_path):
    """2:1 like a lat-long, and of two channels in any container."""
    table = np.random.default_rng(3).random((8, 16, 3), np.float32)
    path = tmp_path / "gold.npy"
    np.save(path, table)
    assert contents(path).kind == "lat-long"
    write_manifest(
        tmp_path / "gold.npy.json",
        {"whitefurnace": "1", "name": "gold.npy", "integral": "albedo", "error": 1e-6, "sha256": digest_file(path)},
    )
    found = contents(path)
    assert found.kind == "table" and found.statement.whole and found.levels[0].stated == {"error": 1e-6}
    assert "integral albedo, error 1.0e-06" in shown(path)
    write_exr(tmp_path / "dfg.exr", table[..., :2], channel_names=("R", "G"))
    write_texture(tmp_path / "dfg.ktx2", encode("rg16f", [table[..., :2]]).texture)
    for name in ("dfg.exr", "dfg.ktx2"):
        found = contents(tmp_path / name)
        # half an ulp of a half below 1
        assert found.kind == "table" and np.abs(found.levels[0].texels - table[..., :2]).max() <= 2.0**-12


def test_a_header_is_its_array_and_a_texture_without_its_manifest_says_what_it_can(tmp_path):
    from whitefurnace.files import write_table

    table = np.random.default_rng(4).random((3, 5, 2), np.float32)
    write_table(tmp_path / "t.h", table, None, comment=("12 numbers: 1 2 3",))
    found = contents(tmp_path / "t.h")
    assert found.kind == "table" and np.array_equal(found.levels[0].texels, table)  # digits that tell every float32
    (tmp_path / "norm.h").write_text("#define NORM(x) (1.0f + (x) * 2.0f)\n")
    assert contents(tmp_path / "norm.h").kind == "code"
    for text in (
        "int main;",
        "static const float t[2][2] = {1, 2, 3};",
        "static const float t[2] = {1, 2",
        "static const float t[999999999][999999999] = {1};",
    ):
        (tmp_path / "bad.h").write_text(text)
        with pytest.raises(InputError):
            contents(tmp_path / "bad.h")
    path = written(
        tmp_path,
        ".ktx2",
        "rgba16f",
        key_values={
            "whitefurnace:engine": text_value("bevy"),
            "whitefurnace:key": text_value("abcdef"),
            "whitefurnace:error": text_value("1e-4 2e-4 3e-4 4e-4"),
            "whitefurnace:manifest": text_value("mine"),
        },
    )
    found = contents(path)
    assert found.written_for == ("bevy", "+x +y -z")
    assert found.statement.manifest is None and found.statement.whole is None
    assert [level.stated["error"] for level in found.levels] == [1e-4, 2e-4, 3e-4, 4e-4]
    assert described(found)["statement"]["manifest"] is None and "for bevy" in shown(path)


# --- as an environment ----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix, form", EVERY)
def test_bake_takes_level_0_of_every_container(tmp_path, suffix, form):
    path = written(tmp_path, suffix, form)
    env = environment(path)
    assert (env.kind, env.layout, env.name) == ("cube", "cube", path.stem)
    assert env.digest == digest_file(path) and env.coverage is None
    off = np.abs(env.texels - levels()[0].astype(np.float64))
    assert (off <= step(form, levels()[0])).all()


def test_a_texture_that_lies_upside_down_is_an_environment_the_right_way_up(tmp_path):
    image = np.random.default_rng(5).random((4, 8, 3), np.float32)
    for orientation, stored in (("rd", image), ("ru", image[::-1]), ("ld", image[:, ::-1]), ("lu", image[::-1, ::-1])):
        for suffix in (".ktx", ".ktx2"):
            path = tmp_path / f"{orientation}{suffix}"
            write_texture(path, encode("rgba32f", [stored], orientation=orientation).texture)
            assert np.array_equal(environment(path).texels, image), path.name
            assert np.array_equal(contents(path).levels[0].texels[..., :3], image), path.name
    assert environment(path).kind == "latlong"


def test_what_is_no_environment_is_one_sentence(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "astc_encoder", None)  # ASTC without what decodes it
    rng = np.random.default_rng(6)
    wrong = {
        "array.ktx2": (
            encode("rgba16f", [rng.random((2, 6, 4, 4, 3))], cube=True).texture,
            InputError,
            "array of 2 cubes",
        ),
        "images.dds": (encode("rgba16f", [rng.random((3, 4, 8, 3))]).texture, InputError, "array of 3 images"),
        "two.ktx": (encode("rg16f", [rng.random((4, 8, 2))]).texture, InputError, "2 channels"),
        "square.dds": (encode("rgba16f", [rng.random((8, 8, 3))]).texture, InputError, "aspect ratio"),
        "astc.ktx2": (Texture("astc4x4hdr", 8, 4, (bytes(32),)), UnsupportedError, "ASTC"),
    }
    for name, (texture, kind, said) in wrong.items():
        write_texture(tmp_path / name, texture)
        with pytest.raises(kind, match=said) as error:
            environment(tmp_path / name)
        with pytest.raises(SystemExit) as done:
            main(["bake", str(tmp_path / name), "-o", str(tmp_path / "out"), "--dry-run"])
        assert done.value.code == kind.exit_code and str(error.value) in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_cube_in_a_container_bakes_as_its_array_does(tmp_path, device):
    from whitefurnace import prefilter

    smooth = (1.5 + cube_directions(16)).astype(np.float32)
    write_texture(tmp_path / "a.dds", encode("rgba32f", [smooth], cube=True).texture)
    one, other = (prefilter(source, size=16, min_size=8, device=device) for source in (tmp_path / "a.dds", smooth))
    for a, b in zip(one.levels, other.levels, strict=True):
        assert np.array_equal(a.texels, b.texels)


# --- anything at all ------------------------------------------------------------------------------------


def seeds(folder: Path) -> list[Path]:
    chain = [level[:, :4, :4] for level in levels()[1:]]
    found = [
        written(folder, suffix, form, chain)
        for suffix, form in (
            (".ktx", "b10g11r11"),
            (".ktx2", "rgb9e5"),
            (".dds", "rgba16f"),
            (".env", "rgbd"),
            (".gltf", "rgbd"),
        )
    ]
    write_npz(folder / "a.npz", {"specular_0": chain[0], "sh": np.zeros((9, 3)), "dfg": np.ones((2, 2, 2))})
    np.save(folder / "a.npy", chain[0])
    with zipfile.ZipFile(folder / "b.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(folder / "a.npy", "specular_0.npy")
    write_manifest(folder / "m.json", {"whitefurnace": "1", "files": {"a.npy": {"sha256": "0"}}, "sh": {}})
    write_exr(folder / "a.exr", chain[0].reshape(24, 4, 3))
    (folder / "sh.txt").write_text("(1.0, 2, 3e-1); // L00\n" * 9)
    (folder / "t.h").write_text(
        "// a table\nstatic const float t[2][3] = {\n{1.0f, .5f, 2e-1f},\n{1.0f, 2.0f, 3.0f},\n};\n"
    )
    codes = np.arange(96, dtype=np.uint8).reshape(4, 8, 3)
    (folder / "a.png").write_bytes(encode_png(codes))
    write_hdr(folder / "a.hdr", codes / 8)
    for name in ("a.tif", "a.jpg", "a.webp"):
        Image.fromarray(codes).save(folder / name, lossless=True)
    named = (
        "a.npz",
        "b.npz",
        "a.npy",
        "m.json",
        "a.exr",
        "sh.txt",
        "t.h",
        "a.png",
        "a.hdr",
        "a.tif",
        "a.jpg",
        "a.webp",
    )
    return [*found, *(folder / name for name in named)]


def mutated(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(max(min(len(out), 400), 1)) if rng.random() < 0.7 else rng.randrange(max(len(out), 1))
        action = rng.randrange(4)
        if action == 0:
            del out[at:]
        elif action == 1:
            out[at : at + 1] = rng.randbytes(1)
        elif action == 2:
            out[at : at + 4] = struct.pack("<I", rng.choice((0, 1, 255, 1 << 16, 1 << 31, (1 << 32) - 1, len(out))))
        else:
            out[at:at] = rng.randbytes(rng.randrange(1, 9))
    return bytes(out)


@pytest.fixture
def bounded(monkeypatch):
    """Readers may take 64 MB; the process may not grow by much more, whatever a file says."""
    monkeypatch.setenv(VARIABLE, "64MB")
    resource = pytest.importorskip("resource") if sys.platform == "linux" else None
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss if resource else 0
    yield
    if resource:
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        # Libraries that are loaded during the test take 60 MB, copies and bands of values as much again.
        assert grown < 250_000, f"the process grew by {grown / 1e3:.0f} MB"


def fuzzed(folder: Path, count: int, seed: int) -> int:
    """How many of `count` mutated files held something; any error but ours passes through."""
    print(f"seed {seed}, {count} files")  # shown where the test fails
    rng = random.Random(seed)
    files = [(path.name, path.read_bytes()) for path in seeds(folder)]
    where = folder / "fuzz"
    where.mkdir()
    taken = 0
    for number in range(count):
        name, data = files[number % len(files)]
        path = where / name
        # Half of them are changed in what they state, with checksums and offsets that are right.
        structured = STRUCTURED.get(path.suffix)
        path.write_bytes(structured(data, rng) if structured and rng.random() < 0.5 else mutated(data, rng))
        try:
            row = described(contents(path))
        except (InputError, UnsupportedError) as error:
            assert str(path) in str(error) and "\n" not in str(error) and len(str(error)) < 600, str(error)
        except FileError as error:  # a changed address may name a file that is not there
            assert str(where) in str(error) and "\n" not in str(error), str(error)
        else:
            taken += 1
            assert row["kind"]
    return taken


@pytest.mark.filterwarnings("error")
def test_thousands_of_broken_files_are_one_sentence_each(tmp_path, capfd, bounded):
    taken = fuzzed(tmp_path, 2500, 11)
    assert "seed 11" in capfd.readouterr().out
    assert 100 < taken < 2400  # both ends are seen
    assert capfd.readouterr() == ("", "")  # libraries of C print nothing either


@pytest.mark.long
def test_a_hundred_thousand_broken_files(tmp_path, bounded):
    """WHITEFURNACE_FUZZ is another number of files, such as 1000000."""
    count = int(os.environ.get("WHITEFURNACE_FUZZ", 100_000))
    assert count / 100 < fuzzed(tmp_path, count, 12) < 0.99 * count


@pytest.mark.parametrize(
    "scale", [1e-9, -0.8, 1e-300, 1e300, 0.04, 21, "0.8", [0.8], True, 10**400, math.nan, math.inf]
)
def test_an_absurd_scale_of_lod_is_one_sentence(tmp_path, shell, scale):
    """A scale of 1e-9 overflowed where the roughness of each level follows from it."""
    path = written(tmp_path, ".env", "rgbd")
    data = path.read_bytes()
    end = data.index(b"\0", 8)
    manifest = json.loads(data[8:end])
    manifest["specular"]["lodGenerationScale"] = scale
    path.write_bytes(data[:8] + json.dumps(manifest).encode() + data[end:])
    for argv in (("inspect", path), ("bake", path, "-o", tmp_path / "out", "--dry-run")):
        assert shell(*argv) == 3 and "lodGenerationScale is" in shell.sentence()


def test_every_scale_of_lod_that_is_read_gives_a_finite_roughness(tmp_path):
    chain = [np.ones((6, n, n, 3), np.float32) for n in (64, 32, 16, 8, 4, 2, 1)]
    for scale in (LEAST_SCALE, 0.8, MOST_SCALE):
        write_env(tmp_path / "a.env", EnvMap(tuple(chain), np.zeros((9, 3)), lod_scale=scale))
        assert all(math.isfinite(level.roughness) for level in contents(tmp_path / "a.env").levels)


def test_every_file_cut_short_is_exit_3(tmp_path, capsys):
    for path in seeds(tmp_path):
        if path.suffix in (".txt", ".h"):  # a text may end anywhere after its numbers
            continue
        data = path.read_bytes()
        cut = tmp_path / f"cut{path.suffix}"
        for length in (len(data) // 2, len(data) - 3, 3):
            cut.write_bytes(data[:length])
            with pytest.raises(SystemExit) as done:
                main(["inspect", str(cut)])
            out, err = capsys.readouterr()
            assert done.value.code == 3 and not out, (path.name, length)
            assert len(err.splitlines()) == 1 and err.startswith("error: ") and str(cut) in err


def test_exit_codes_of_inspect(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "astc_encoder", None)

    def code(*argv) -> int:
        with pytest.raises(SystemExit) as done:
            main(["inspect", *map(str, argv)])
        return done.value.code

    assert code(tmp_path / "missing.ktx") == 2 and code(tmp_path) == 2 and code(tmp_path / "missing.json") == 2
    (tmp_path / "text.txt").write_text("no image")
    assert code(tmp_path / "text.txt") == 3
    (tmp_path / "other.json").write_text("{}")
    assert code(tmp_path / "other.json") == 3
    write_texture(tmp_path / "astc.ktx2", Texture("astc4x4hdr", 8, 4, (bytes(32),)))
    capsys.readouterr()
    assert code(tmp_path / "astc.ktx2") == 0  # all but its texels
    out = capsys.readouterr().out
    assert "width 8, height 4" in out and "notice: ASTC needs astc-encoder-py" in out and "level" not in out
    cube = np.full((6, 2, 2, 3), np.nan, np.float32)
    np.save(tmp_path / "nan.npy", cube)
    assert code(tmp_path / "nan.npy", "--json") == 0
    row = json.loads(capsys.readouterr().out)
    assert row["levels"][0]["nan"] == 72 and row["levels"][0]["low"] == "nan"


def test_a_header_of_numpy_allocates_nothing(tmp_path):
    """A few bytes that say they are 10¹² floats, and a member that says it inflates to 8 GiB."""
    for shape in ((10**12,), (2**62, 4), (1 << 40, 1 << 40)):
        text = repr({"descr": "<f4", "fortran_order": False, "shape": shape}).encode()
        (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text)
        with pytest.raises(InputError, match="says that it has"):
            read_npy(tmp_path / "a.npy")
    np.save(tmp_path / "b.npy", np.zeros(3, object), allow_pickle=True)
    with pytest.raises(InputError, match="not numbers"):
        read_npy(tmp_path / "b.npy")
    np.savez_compressed(tmp_path / "c.npz", a=np.zeros(10))
    data = bytearray((tmp_path / "c.npz").read_bytes())
    at = data.index(b"PK\1\2")
    data[at + 24 : at + 28] = struct.pack("<I", 0xFFFFFFF0)
    (tmp_path / "c.npz").write_bytes(data)
    with pytest.raises(InputError, match="more than its bytes can"):
        read_npz(tmp_path / "c.npz")
    with pytest.raises(FileError):
        read_npz(tmp_path / "missing.npz")


def test_a_manifest_that_says_anything_at_all_breaks_nothing(tmp_path):
    """Every value of it in turn is of another kind: the file is read, with or without a word of the manifest."""
    (tmp_path / "bevy").mkdir()
    path = tmp_path / "bevy" / "day.dds"
    write_texture(path, encode("rgba16f", levels()[:2], cube=True).texture)
    entry = {
        "sha256": digest_file(path),
        "bytes": 1,
        "holds": "specular",
        "format": "rgba16f",
        "scale": "radiance",
        "levels": [{"size": 8, "roughness": 0.0, "error": 1e-4}, {"size": 4, "roughness": 1.0, "error": 1e-4}],
    }
    whole = {
        "whitefurnace": "1",
        "name": "day",
        "key": "k",
        "device": {"name": "d"},
        "recipe": {"size": 8, "fit": [1]},
        "sh": {"coefficients": np.zeros((9, 3)).tolist()},
        "files": {"bevy/day.dds": entry},
        "kept": {},
    }

    def places(node, at=()):
        for key in node if isinstance(node, dict) else range(len(node)):
            yield (*at, key)
            if isinstance(node[key], dict | list):
                yield from places(node[key], (*at, key))

    tried = 0
    for place in list(places(whole)):
        for odd in (None, [], {}, "x", 10**400, True, [[1]], -1):
            copy = json.loads(json.dumps(whole))
            node = copy
            for key in place[:-1]:
                node = node[key]
            node[place[-1]] = odd
            (tmp_path / "day.json").write_text(json.dumps(copy))
            assert "cube in DDS" in shown(path)
            with contextlib.suppress(InputError):
                shown(tmp_path / "day.json")
            tried += 1
    assert tried > 300


def test_the_digest_of_a_gltf_is_of_the_files_it_names_too(tmp_path):
    write_gltf_lights(tmp_path / "a.gltf", GltfLight(tuple(levels()), np.zeros((9, 3))))
    document = json.loads((tmp_path / "a.gltf").read_text())
    assert light_digest(tmp_path / "a.gltf") == digest_file(tmp_path / "a.gltf")
    for part in ("images", "buffers"):
        for k, one in enumerate(document.get(part, ())):
            if one.get("uri", "").startswith("data:"):
                one["uri"], data = f"{part}{k}.bin", one["uri"]
                (tmp_path / one["uri"]).write_bytes(base64.b64decode(data.partition(",")[2]))
    beside = sorted(tmp_path.glob("*.bin"))
    assert beside
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    first = environment(tmp_path / "b.gltf")
    assert np.array_equal(first.texels, environment(tmp_path / "a.gltf").texels)
    beside[-1].write_bytes(beside[-1].read_bytes() + b"\0")  # the file that names it is as it was
    with contextlib.suppress(InputError):
        environment(tmp_path / "b.gltf")
    assert light_digest(tmp_path / "b.gltf") != first.digest


def test_a_part_of_openexr_is_shown_and_compared(tmp_path, capsys):
    beauty = np.random.default_rng(3).random((4, 8, 3)).astype(np.float32)
    depth = Part({"Z": np.ones((4, 8), np.float32)}, "depth")
    path = tmp_path / "a.exr"
    path.write_bytes(exr(depth, Part(planes(beauty), "beauty"), Part(planes(2 * beauty), "lamp")))
    found = contents(path)
    assert found.kind == "lat-long" and np.array_equal(found.levels[0].texels, beauty)
    assert "part beauty was read" in shown(path) and "(R G B)" in found.format
    assert np.array_equal(contents(path, layer="lamp").levels[0].texels, 2 * beauty)
    with pytest.raises(UsageError, match="did you mean 'lamp'"):
        contents(path, layer="lump")
    with pytest.raises(InputError, match="Z"):
        contents(path, layer="depth")
    with pytest.raises(SystemExit) as done:
        main(["compare", str(path), str(path), "--layer-a", "lamp", "--max-error", "0.1"])
    assert done.value.code == 7
    with pytest.raises(SystemExit) as done:
        main(["compare", str(path), str(path), "--layer-b", "beauty", "--max-error", "0"])
    assert done.value.code == 0 and "part beauty was read" in capsys.readouterr().err
    lamp = Part(planes(beauty), window=(0, 1), display=(0, 0, 7, 4))
    path.write_bytes(exr(lamp))
    with pytest.raises(InputError, match="--fill black"):
        contents(path)
    assert contents(path, fill="black").levels[0].texels.shape == (5, 8, 3)


def test_attributes_of_openexr_that_are_not_ours_are_not_shown_as_ours(tmp_path):
    """An attribute of our name that is an array of numbers."""
    values = floats("m44f", *range(16))
    for name in ("key", "version", "axes", "rule", "sh", "error", "method"):
        path = tmp_path / f"{name}.exr"
        pixels = np.ones((4, 8, 3), np.float32)
        path.write_bytes(exr(Part(planes(pixels), attributes={f"whitefurnace:{name}": values})))
        assert "lat-long in OpenEXR" in shown(path)


def test_an_envmap_attribute_is_shown(tmp_path):
    path = tmp_path / "a.exr"
    for kind, shape, said in ((1, (24, 4), "openexr cube"), (0, (4, 8), "latlong"), (0, (24, 4), "contradicts")):
        pixels = np.ones((*shape, 3), np.float32)
        path.write_bytes(exr(Part(planes(pixels), attributes={"envmap": ("envmap", bytes([kind]))})))
        assert said in shown(path)


@pytest.mark.parametrize("number", ["1" + "0" * 400, "1e999", "NaN", '"x"', "[1]", "null", "{}"])
def test_harmonics_of_any_numbers_are_one_sentence(tmp_path, shell, number):
    """An integer of 400 digits has no float."""
    rows = ",".join(f'"L{k}": [1, 2, {number if k == 4 else 3}]' for k in range(9))
    (tmp_path / "a_sh.json").write_text("{" + rows + "}")
    assert shell("inspect", tmp_path / "a_sh.json") == 3 and shell.sentence()
