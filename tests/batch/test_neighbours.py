"""What an input refers to: the same files are read, hashed, sent and listed, none else, and none outside its folder."""

from __future__ import annotations

import base64
import json
import os
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from whitefurnace import environment
from whitefurnace.batch import jobs as batch
from whitefurnace.catalogue.user import user_files
from whitefurnace.errors import InputError, WhitefurnaceError
from whitefurnace.files import light_files, read_manifest, write_exr
from whitefurnace.files.gltf_lights import GltfLight, gltf_text
from whitefurnace.files.png import encode_png
from whitefurnace.files.rgbd import encode_faces
from whitefurnace.sphere.environments import FACE_NAMES, source_digest, source_files

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")

SIZES = "size = 8\nmin_size = 4\ntolerance = 0.3\n"


def light(value: float = 1.0) -> np.ndarray:
    return np.full((6, 8, 8, 3), value, np.float32)


def document(unused: tuple[str, ...] = ()) -> dict:
    """A glTF of one light whose faces are data URIs, with images that nothing uses."""
    found = json.loads(gltf_text([GltfLight((light(),), np.zeros((9, 3)))])[0])
    found["images"] += [{"uri": uri} for uri in unused]
    return found


def beside(path: Path, found: dict, *, binary: bool = False) -> Path:
    """The glTF with its faces in files beside it, as .glb or .gltf."""
    for k, one in enumerate(found["images"][:6]):
        (path.parent / f"f{k}.png").write_bytes(base64.b64decode(one["uri"].partition(",")[2]))
        one["uri"] = f"f{k}.png"
    text = json.dumps(found).encode()
    if binary:
        text += b" " * (-len(text) % 4)
        text = struct.pack("<4s4I", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text
    path.write_bytes(text)
    return path


def face(path: Path, value: float) -> None:
    """An RGBD face of one value."""
    path.write_bytes(encode_faces(light(value))[0][0])


def job(folder: Path, text: str) -> Path:
    (folder / "job.toml").write_text(text)
    return folder / "job.toml"


# The file has one of these names whatever it holds: its bytes decide.
@pytest.mark.parametrize("name, binary", [("a.glb", True), ("a.gltf", False), ("a.png", True)])
def test_a_changed_image_beside_a_gltf_is_baked_again(tmp_path, shell, name, binary):
    source = beside(tmp_path / name, document(), binary=binary)
    command = ("bake", source, "-o", tmp_path / "out", "--size", 8, "--min-size", 4, "--tolerance", ".3")
    assert shell(*command) == 0
    first = read_manifest(tmp_path / "out" / "a.json")
    assert shell(*command) == 0 and "up to date" in shell.out + shell.err
    face(tmp_path / "f3.png", 2.0)
    assert shell(*command) == 0 and "up to date" not in shell.out + shell.err
    assert read_manifest(tmp_path / "out" / "a.json")["key"] != first["key"]
    # What is sent, listed and hashed is what is read.
    listed = ["f0.png", "f1.png", "f2.png", "f3.png", "f4.png", "f5.png"]
    assert list(source_files(source)) == [name, *listed]
    assert environment(source).digest == source_digest(source)
    path = job(tmp_path, f'[[bake]]\nenvironments = ["{name}"]\noutput = "jobs"\n{SIZES}')
    (item,) = (batch.load(item) for item in batch.job(path, send=True).items)
    assert sorted(item.content[str(source)].files) == [name, *listed]
    assert shell("batch", path, "--depfile", tmp_path / "d") == 0
    assert all(f"{tmp_path}/{one}:\n" in (tmp_path / "d").read_text() for one in listed)
    shutil.rmtree(tmp_path / "jobs")
    for one in (name, *listed):
        (tmp_path / one).unlink()
    assert batch.do(item).state == "done"  # on another machine


def test_the_bytes_of_a_buffer_beside_a_gltf_count(tmp_path):
    found = document()
    data = base64.b64decode(found["images"][0]["uri"].partition(",")[2])
    (tmp_path / "b.bin").write_bytes(data)
    found["images"][0] = {"bufferView": 0, "mimeType": "image/png"}
    found |= {"bufferViews": [{"buffer": 0, "byteLength": len(data)}], "buffers": [{"byteLength": 1, "uri": "b.bin"}]}
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(found))
    assert list(light_files(path)) == ["a.gltf", "b.bin"]
    before = source_digest(path)
    (tmp_path / "b.bin").write_bytes(data + b"\0")
    assert source_digest(path) != before


def unused(folder: Path) -> tuple[str, ...]:
    """What an image may be named that nothing uses: it is never opened."""
    os.mkfifo(folder / "pipe")
    (folder / "zero").symlink_to("/dev/zero")
    (folder.parent / "secret").write_bytes(b"secret")
    return (
        *("/dev/zero", "zero", "pipe", "gone.png", "http://example.org/a.png", "file:///etc/passwd"),
        *("C:\\a.png", "a%00b", "DATA:image/png;base64,AAAA", "data:,nothing", "", "."),
    )


def test_what_nothing_uses_is_never_opened(tmp_path, shell):
    folder = tmp_path / "in"
    folder.mkdir()
    found = document(unused(folder))
    found["buffers"] = [{"byteLength": 1, "uri": "pipe"}]
    found["images"] += [{"bufferView": 9}]
    source = folder / "a.gltf"
    source.write_text(json.dumps(found))
    assert list(source_files(source)) == ["a.gltf"]
    path = job(tmp_path, f'[[bake]]\nenvironments = ["in/a.gltf"]\noutput = "jobs"\n{SIZES}')
    (item,) = (batch.load(item) for item in batch.job(path, send=True).items)
    assert list(item.content[str(source)].files) == ["a.gltf"]
    small = ("--size", 8, "--min-size", 4, "--tolerance", ".3")
    assert shell("bake", source, "-o", tmp_path / "out", *small, "--dry-run") == 0
    assert shell("bake", source, "-o", tmp_path / "out", *small) == 0
    assert shell("batch", path, "--dry-run") == 0 and shell("batch", path) == 0
    assert shell("inspect", source) == 0
    pytest.importorskip("pygltflib")
    assert shell("scene", source) == 0


@pytest.mark.parametrize("uri", ["../secret", "..%2fsecret", "a/../../secret", "..\\secret", "%2e%2e/secret"])
def test_a_name_that_climbs_out_of_the_folder_is_refused_though_nothing_uses_it(tmp_path, shell, uri):
    folder = tmp_path / "in"
    folder.mkdir()
    (tmp_path / "secret").write_bytes(b"secret")
    source = folder / "a.gltf"
    source.write_text(json.dumps(document((uri,))))
    assert shell("bake", source, "-o", tmp_path / "out", "--dry-run") == 3
    assert "folder of the glTF" in shell.sentence()
    found = document()
    found["buffers"] = [{"byteLength": 1, "uri": uri}]
    source.write_text(json.dumps(found))
    assert shell("inspect", source) == 3


OUTSIDE = [
    *("../out.png", "..%2fout.png", "%2e%2e/out.png", "%2E%2E%2Fout.png", "sub/../../out.png", "link.png"),
    *("sub/link.png", "linked/out.png", "/etc/hostname", "%2fetc%2fhostname", "file:///etc/hostname", "FILE:out.png"),
    *("C:/out.png", "c:out.png", "..\\out.png", "%5c%5chost%5ca.png", "a%00b", "~/../../out.png", "http://a/b.png", ""),
]


@pytest.mark.parametrize("uri", OUTSIDE)
def test_what_is_used_and_outside_is_refused_before_anything_is_read(tmp_path, shell, uri):
    folder = tmp_path / "in"
    (folder / "sub").mkdir(parents=True)
    (tmp_path / "out.png").write_bytes(encode_png(np.zeros((8, 8, 4), np.uint8)))
    for link in ("link.png", "sub/link.png"):
        (folder / link).symlink_to(tmp_path / "out.png")
    (folder / "linked").symlink_to(tmp_path)
    found = document()
    os.mkfifo(folder / "pipe")  # would be opened first
    found["images"][0]["uri"], found["images"][5]["uri"] = "pipe", uri
    source = folder / "a.gltf"
    source.write_text(json.dumps(found))
    for look in (source_files, source_digest, environment):
        with pytest.raises(InputError, match="not a file in the folder of the glTF"):
            look(source)
    path = job(tmp_path, f'[[bake]]\nenvironments = ["in/a.gltf"]\noutput = "jobs"\n{SIZES}')
    with pytest.raises(InputError, match="not a file in the folder"):
        batch.load(batch.job(path, send=True).items[0])
    assert shell("bake", source, "-o", tmp_path / "o") == 3 and shell("inspect", source) == 3
    found["images"][5]["uri"] = "f5.png"
    source.write_text(json.dumps(found))
    (folder / "f5.png").write_bytes(b"")
    with pytest.raises(WhitefurnaceError, match="not a regular file but a pipe"):
        environment(source)


def test_a_folder_of_faces_keeps_to_its_folder_too(tmp_path):
    folder = tmp_path / "six"
    folder.mkdir()
    for name in FACE_NAMES[0]:
        write_exr(folder / f"{name}.exr", np.ones((4, 4, 3), np.float32))
    os.mkfifo(folder / "notes")
    assert list(source_files(folder)) == [f"{name}.exr" for name in FACE_NAMES[0]]
    before = source_digest(folder)
    write_exr(folder / "ny.exr", np.full((4, 4, 3), 2, np.float32))
    assert source_digest(folder) != before
    shutil.move(folder / "px.exr", tmp_path / "px.exr")
    (folder / "px.exr").symlink_to(tmp_path / "px.exr")
    for look in (source_files, source_digest, environment):
        with pytest.raises(InputError, match="link to a file outside"):
            look(folder)


# ------------------------------------------------------------------------------------------------- models


def lobe(folder: Path, power: int = 4) -> Path:
    """A lobe that takes its formula from a file that takes its exponent from another."""
    folder.mkdir(exist_ok=True)
    (folder / "my_lobe.clh").write_text(
        '#include "parts/formula.clh"\nreal ndf_my_lobe_D(real cos_m, real alpha) { return alpha * formula(cos_m); }\n'
    )
    (folder / "parts").mkdir(exist_ok=True)
    (folder / "parts" / "formula.clh").write_text(
        '#include "power.clh"\nreal formula(real x) { return pow(x, (real)(POWER)); }\n'
    )
    (folder / "parts" / "power.clh").write_text(f"#define POWER {power}\n")
    return folder / "my_lobe.clh"


def test_a_changed_include_makes_a_table_again(tmp_path, shell, monkeypatch):
    path = lobe(tmp_path / "models")
    assert [str(one.relative_to(path.parent)) for one in user_files(path)] == [
        *("my_lobe.clh", "parts/formula.clh", "parts/power.clh")
    ]
    table = tmp_path / "t.npy"
    command = ("lut", "albedo", "-o", table, "--size", 4, "--ndf", f"{path}:alpha=1", "--tolerance", "1e-3")
    assert shell(*command) == 0, shell.err
    first = np.load(table)
    monkeypatch.chdir(path.parent / "parts")  # includes lie beside their files, wherever the program runs
    assert shell(*command) == 0 and "up to date" in shell.out + shell.err
    lobe(tmp_path / "models", 40)
    assert shell(*command) == 0 and "up to date" not in shell.out + shell.err
    assert not np.allclose(np.load(table), first)


def test_includes_are_in_keys_depfiles_and_what_is_sent(tmp_path, shell):
    path = lobe(tmp_path / "models")
    (tmp_path / "mine.toml").write_text('[[file]]\nholds = "specular"\nname = "{stem}.ktx2"\nformat = "rgba32f"\n')
    write_exr(tmp_path / "a.exr", np.ones((4, 8, 3), np.float32))
    text = (
        f'[[bake]]\nenvironments = ["a.exr"]\noutput = "out"\nndf = "models/my_lobe.clh"\nfor = ["mine.toml"]\n'
        f'{SIZES}[[lut]]\nkind = "radiance"\noutput = "t.npy"\nsize = 2\nenvironment = "a.exr"\ntolerance = 0.1\n'
    )
    made = batch.job(job(tmp_path, text), allow_kernels=True, send=True)
    own = ["models/my_lobe.clh", "models/parts/formula.clh", "models/parts/power.clh"]
    assert {os.path.relpath(one, tmp_path) for one in made.named} == {*own, "mine.toml", "a.exr"}
    sent = [batch.load(item) for item in made.items]
    assert [sorted(item.content) for item in sent] == [
        sorted(str(tmp_path / one) for one in ("a.exr", "mine.toml", "models/my_lobe.clh")),
        [str(tmp_path / "a.exr")],
    ]
    assert sorted(sent[0].content[str(path)].files) == ["my_lobe.clh", "parts/formula.clh", "parts/power.clh"]
    lobe(tmp_path / "models", 8)
    again = batch.job(job(tmp_path, text), allow_kernels=True)
    assert again.items[0].recipe != made.items[0].recipe
    for item in sent:  # as a worker has them, which sees none of these folders
        batch._bake_plan.cache_clear()
        shutil.rmtree(tmp_path / "models", ignore_errors=True)
        for name in ("a.exr", "mine.toml"):
            (tmp_path / name).unlink(missing_ok=True)
        result = batch.do(item)
        assert result.state == "done", result.message
    assert (tmp_path / "out" / "mine" / "a.ktx2").is_file() and (tmp_path / "t.npy").is_file()


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ('#include "../out.clh"', 3, "not in the folder"),
        ('#include "/etc/hostname"', 3, "not in the folder"),
        ('#include "link.clh"', 3, "not in the folder"),
        ('#include "pipe"', 2, "not a regular file"),
        ('#include "parts"', 2, "it is a folder"),
        ('#include "gone.clh"', 2, "gone.clh"),
        ('#include "my.clh"', 3, "includes itself"),
        ("#include <math.h>", 3, "#include takes a file in the same folder"),
        ("#include NAME", 3, "#include takes a file in the same folder"),
        ('# /* a */ include /* b */ "gone.clh"', 2, "gone.clh"),
        ('#inc\\\nlude "gone.clh"', 3, "my.clh:1"),
        ('%:include "gone.clh"', 3, "my.clh:1"),
        ('#import "gone.clh"', 3, "my.clh:1"),
        ('#include_next "gone.clh"', 3, "my.clh:1"),
        ('#embed "gone.clh"', 3, "my.clh:1"),
        ('#if __has_include("gone.clh")\n#endif', 3, "my.clh:1"),
    ],
)
def test_an_include_that_is_not_followed_is_refused(tmp_path, shell, text, code, says):
    folder = tmp_path / "models"
    (folder / "parts").mkdir(parents=True)
    (tmp_path / "out.clh").write_text("// out\n")
    (folder / "link.clh").symlink_to(tmp_path / "out.clh")
    os.mkfifo(folder / "pipe")
    (folder / "my.clh").write_text(f"{text}\nreal ndf_my_D(real cos_m) {{ return cos_m; }}\n")
    assert shell("lut", "albedo", "-o", tmp_path / "t.npy", "--size", 2, "--ndf", folder / "my.clh") == code
    assert says in shell.err and shell.err.count("\n") == 1, shell.err


# ------------------------------------------------------------------------------------------------- names


@pytest.mark.skipif(sys.platform == "darwin", reason="names of files are Unicode there")
@pytest.mark.parametrize("stem", [b"caf\xe9", b"two\nlines", b"\xff\xfe", "\u00e9 \u2603".encode()], ids=repr)
def test_any_name_works_and_only_its_line_is_not_in_the_depfile(tmp_path, shell, stem):
    name = os.fsdecode(stem)
    for one in (name, "plain"):
        write_exr(tmp_path / f"{one}.exr", np.full((4, 8, 3), 0.5, np.float32))
    options = ("--size", 16, "--tolerance", ".3", "--for", "raw,exr,filament,babylon,gltf,three")
    assert shell("bake", tmp_path / f"{name}.exr", "-o", tmp_path / "out", *options, "--json") == 0, shell.err
    assert [json.loads(line) for line in shell.out.splitlines()]
    assert shell("bake", tmp_path / f"{name}.exr", "-o", tmp_path / "out", *options) == 0
    assert "up to date" in shell.out + shell.err
    for path in sorted((tmp_path / "out").rglob("*")):
        if path.is_file() and path.suffix not in (".txt", ".glsl", ".hlsl", ".wgsl"):
            assert shell("inspect", path) == 0, (path, shell.err)
    assert shell("lut", "dfg", "-o", tmp_path / f"{name}.npy", "--size", 2, "--tolerance", ".1") == 0
    assert shell("lut", "dfg", "-o", tmp_path / f"{name}.ktx2", "--size", 2, "--tolerance", ".1") == 0
    function = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    lobe = tmp_path / f"{name}.clh"
    lobe.write_text(f"real ndf_{function}_D(real cos_m, real alpha) {{ return cos_m + alpha; }}\n")
    options = ("--size", 2, "--tolerance", ".1")
    assert shell("lut", "albedo", "-o", tmp_path / "n.npy", "--ndf", f"{lobe}:alpha=.3", *options) == 0, shell.err
    path = job(tmp_path, f'[[bake]]\nenvironments = ["*.exr"]\noutput = "jobs"\n{SIZES}')
    assert shell("batch", path, "--depfile", tmp_path / "d", "--report", tmp_path / "page") == 0
    rules = (tmp_path / "d").read_bytes()
    assert b"plain.json" in rules and rules.count(b"job.toml:\n") == 1
    breaks = b"\n" in stem
    assert ("is left out" in shell.err) == breaks
    assert b"jobs/raw/" in rules and all(b":" in line for line in rules.splitlines())


@pytest.mark.parametrize("name", ["two\nlines", "a\rb", "end\\"])
def test_names_that_no_makefile_can_hold_are_refused(name):
    with pytest.raises(InputError, match="which a Makefile cannot hold"):
        batch.escaped(name)
