"""Input files: regular files alone are opened, through one door, whatever their names; texts have a largest size."""

from __future__ import annotations

import ast
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import whitefurnace
from whitefurnace.errors import FileError, InputError
from whitefurnace.files import inputs, read_image, read_stored, write_exr

HOST = Path(whitefurnace.__file__).parent

# Modules that open files which this package made itself a moment before, or that ship with it.
OWN_FILES = {
    "files/atomic.py": "the staged file, to sync it",
    "files/inputs.py": "the door",
    "files/lock.py": "lock files, without following links",
    "files/memory.py": "what the system says of its memory",
    "files/npy.py": "the staged file",
    "files/png.py": "a temporary file of OpenImageIO",
    "cli/ending.py": "the null device",
    "cli/terminal.py": "the null device",
    "opencl/cache.py": "files of the cache of kernels",
    "opencl/source.py": "kernels of the package",
    "opencl/device.py": "kernels of the package and the source of pyopencl",
}


def openings(path: Path) -> list[str]:
    """The calls in a module that open a file: open, read_bytes, read_text of a path, ImageInput.open, memmap."""
    found = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        call = node.func
        if isinstance(call, ast.Name) and call.id == "open":
            mode = node.args[1] if len(node.args) > 1 else None
            if isinstance(mode, ast.Constant) and mode.value[0] in "wx":
                continue
            found.append(f"line {node.lineno}: open")
        elif isinstance(call, ast.Attribute) and call.attr in ("read_bytes", "read_text", "fromfile", "load", "open"):
            on = ast.unparse(call.value)
            if "resources.files(" in on:  # of the package itself
                continue
            if (call.attr, on) in (("load", "msgspec.json"), ("load", "json"), ("load", "np"), ("open", "webbrowser")):
                found.append(f"line {node.lineno}: {on}.{call.attr}")
            elif call.attr in ("read_bytes", "read_text", "fromfile") or on == "os":
                found.append(f"line {node.lineno}: {on}.{call.attr}")
    return found


def test_files_are_opened_through_one_door():
    wrong = {}
    for path in sorted(HOST.rglob("*.py")):
        name = path.relative_to(HOST).as_posix()
        if name not in OWN_FILES and (found := openings(path)):
            wrong[name] = found
    assert not wrong, f"use whitefurnace.files.inputs: {wrong}"


def test_the_list_of_modules_that_open_their_own_files_is_no_longer_than_needed():
    unused = [name for name in OWN_FILES if not openings(HOST / name)]
    assert not unused


def odd_files(folder: Path) -> dict[str, Path]:
    """What is not a regular file, by name."""
    found = {"folder": folder / "folder"}
    found["folder"].mkdir()
    if hasattr(os, "mkfifo"):
        os.mkfifo(folder / "pipe")
        found["pipe"] = folder / "pipe"
    if hasattr(socket, "AF_UNIX"):
        server = socket.socket(socket.AF_UNIX)
        here = os.getcwd()
        try:
            os.chdir(folder)  # the name of a socket has at most a hundred bytes
            server.bind("socket")
        finally:
            os.chdir(here)
            server.close()
        found["socket"] = folder / "socket"
    for device in ("/dev/zero", "/dev/full"):
        if os.path.exists(device):
            link = folder / device.rpartition("/")[2]
            link.symlink_to(device)
            found[link.name] = link
    return found


def test_only_regular_files_are_opened(tmp_path):
    for name, path in odd_files(tmp_path).items():
        assert not inputs.is_input(path) and inputs.head_of(path, 4) == b"", name
        for read in (
            lambda path: inputs.input_size(path),
            lambda path: inputs.read_input(path, most=10),
            lambda path: inputs.read_text(path, most=10),
        ):
            with pytest.raises(
                FileError, match="it is a folder, a" if name == "folder" else "it is not a regular file"
            ):
                read(path)


@pytest.mark.parametrize("name", ["gone", "a\0b", "x" * 5000, ""])
def test_a_file_that_is_not_there_is_one_sentence(tmp_path, name):
    with pytest.raises(FileError, match=r"^cannot read ") as error:
        inputs.read_input(f"{tmp_path}/{name}" if name else name, most=10)
    assert "\n" not in str(error.value)


def test_a_text_has_a_largest_size_and_is_utf8(tmp_path):
    path = tmp_path / "t"
    path.write_bytes("\ufeffä\r\n".encode())
    assert inputs.read_text(path, most=7) == "ä\r\n"
    with pytest.raises(InputError, match="has 7 bytes, a text has at most 6"):
        inputs.read_text(path, most=6)
    path.write_bytes(b"caf\xe9")
    with pytest.raises(InputError, match=r"not a text in UTF-8 \(byte 3\)"):
        inputs.read_text(path, most=10)


def test_errors_inside_the_block_keep_their_kind(tmp_path):
    (tmp_path / "t").write_bytes(b"x")
    with pytest.raises(KeyError), inputs.open_input(tmp_path / "t"):
        raise KeyError
    with pytest.raises(ValueError, match="mine"), inputs.open_input(tmp_path / "t"):
        raise ValueError("mine")


ODD_NAMES = [b"caf\xe9.exr", b"two\nlines.exr", b"\xff.exr", "\u2603.exr".encode()]


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="names of files are Unicode there")
@pytest.mark.parametrize("name", ODD_NAMES, ids=repr)
def test_an_image_of_any_name_is_written_and_read(tmp_path, name):
    path = tmp_path / os.fsdecode(name)
    pixels = np.random.default_rng(1).random((4, 8, 3), np.float32)
    write_exr(path, pixels)
    assert [os.fsencode(one.name) for one in tmp_path.iterdir()] == [name]
    assert np.array_equal(read_image(path).pixels, pixels) and np.array_equal(read_stored(path), pixels)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match="truncated or corrupted"):
        read_image(path)


COMMANDS = {
    "job": ("batch", "X.toml"),
    "job, dry": ("batch", "X.toml", "--dry-run"),
    "source": ("bake", "X.exr", "-o", "out"),
    "source, dry": ("bake", "X.exr", "-o", "out", "--dry-run"),
    "glTF as a source": ("bake", "X.glb", "-o", "out"),
    "engine": ("bake", "demo", "-o", "out", "--for", "X.toml"),
    "model of a bake": ("bake", "demo", "-o", "out", "--ndf", "X.clh"),
    "model of a table": ("lut", "albedo", "-o", "t.npy", "--ndf", "X.clh"),
    "environment of a table": ("lut", "radiance", "-o", "t.npy", "--environment", "X.exr"),
    "model to verify": ("verify", "X.clh"),
    "scene": ("scene", "X.gltf"),
    "environment of a scene": ("scene", "scene.gltf", "--environment", "X.exr"),
    "engine of a scene": ("scene", "scene.gltf", "--for", "X.toml"),
    "manifest of a picture": ("render", "X.json", "-o", "p.png", "--for", "raw"),
    "compared": ("compare", "X.exr", "X.exr"),
    **{f"inspect {suffix}": ("inspect", f"X{suffix}") for suffix in (".json", ".txt", ".h", ".npz", ".npy")},
    **{f"inspect {suffix}": ("inspect", f"X{suffix}") for suffix in (".ktx", ".dds", ".env", ".gltf", ".png", ".hdr")},
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.whole
def test_no_command_waits_for_a_pipe_or_reads_a_device(tmp_path, shell, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.gltf").write_text('{"asset": {"version": "2.0"}, "materials": [{}]}')
    odd = odd_files(tmp_path)
    for kind in ("pipe", "zero", "folder"):
        argv = [word.replace("X", kind) if "X" in word else word for word in COMMANDS[command]]
        for word in argv:
            if kind in word and kind in odd and not os.path.lexists(word):
                os.symlink(odd[kind].name, word)
        assert shell(*argv) in (2, 3), (argv, shell.out)
        said = [line for line in shell.err.splitlines() if not line.startswith("notice: ")]
        assert len(said) == 1 and ("not a regular file" in said[0] or kind == "folder"), (argv, said)


LINK = """
import sys
from whitefurnace.files import inputs
try:
    inputs.read_input(sys.argv[1], most=10)
except Exception as error:
    print(type(error).__name__, error)
"""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_that_takes_the_place_of_a_file_does_not_block(tmp_path):
    """The file is a regular one when it is looked at, and a pipe when it is opened."""
    os.mkfifo(tmp_path / "pipe")
    text = LINK.replace("try:", "import os; os.stat = lambda path, real=os.stat: real(__file__)\ntry:")
    (tmp_path / "run.py").write_text(text)
    done = subprocess.run(
        [sys.executable, tmp_path / "run.py", tmp_path / "pipe"], capture_output=True, text=True, timeout=60
    )
    assert done.stdout.startswith("FileError") and "not a regular file but a pipe" in done.stdout, done
