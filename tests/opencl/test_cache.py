"""The cache of kernels: what is damaged or unknown in it never reaches a compiler, and a full disk is told in time."""

from __future__ import annotations

import os
import random
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from shell import command, mounted, tree
from whitefurnace.opencl import cache as caches
from whitefurnace.opencl.cache import RECORD, KernelCache

pytestmark = pytest.mark.skipif(os.name != "posix", reason="PoCL, whose cache it is, is used on POSIX systems")

ENTRY, OTHER = "AB/CDEF", "PJ/QRST"


def fill(folder: Path, *entries: str) -> None:
    """Files as PoCL leaves them."""
    for entry in entries:
        (folder / entry / "kernel" / "1-1-1").mkdir(parents=True)
        (folder / entry / "program.bc").write_bytes(b"bitcode of " + entry.encode())
        (folder / entry / "kernel" / "1-1-1" / "kernel.so").write_bytes(b"library of " + entry.encode())
        (folder / entry / "last_accessed").write_bytes(b"")


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder with two entries that a run has recorded."""
    cache = KernelCache(tmp_path)
    assert cache.open()
    fill(tmp_path, ENTRY, OTHER)
    cache.close()
    assert (tmp_path / RECORD).is_file()
    return tmp_path


def entries(folder: Path) -> set[str]:
    return {"/".join(name.split("/")[:2]) for name in tree(folder) if "/" in name}


def opened(folder: Path) -> KernelCache:
    cache = KernelCache(folder)
    assert cache.open()
    return cache


def test_what_is_as_recorded_stays(folder):
    before = tree(folder)
    (folder / ENTRY / "last_accessed").write_bytes(b"now")  # at each use
    opened(folder).close()
    assert tree(folder) == before | {f"{ENTRY}/last_accessed": b"now"}


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[3] ^= 0xFF
    path.write_bytes(data)
    os.utime(path, (1, 1))


@pytest.mark.whole
@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:5]),
        lambda path: path.write_bytes(path.read_bytes() + b"more"),
        flip,
        Path.unlink,
        lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
        lambda path: (path.unlink(), os.mkfifo(path)),
        lambda path: (path.unlink(), path.mkdir()),
        lambda path: (path.parent / "unknown.so").write_bytes(b"of a run that was killed"),
    ],
    ids=["empty", "cut", "longer", "flipped", "gone", "a link", "a pipe", "a folder", "unknown"],
)
@pytest.mark.parametrize("name", ["program.bc", "kernel/1-1-1/kernel.so"])
def test_an_entry_with_anything_else_in_it_goes(folder, name, damage):
    damage(folder / ENTRY / name)
    cache = opened(folder)
    assert entries(folder) == {OTHER}
    cache.close()


def test_entries_of_a_run_that_was_killed_go_and_litter_too(folder):
    fill(folder, "XY/ZZZZ")
    (folder / "tempfile_AbCdEf").write_bytes(b"half")
    opened(folder).close()
    assert entries(folder) == {ENTRY, OTHER} and not list(folder.glob("tempfile*"))


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b'{"files": {"AB/CDEF/program.bc": 3}}', b'{"files": []}', b"\xff"])
def test_a_damaged_record_proves_nothing(folder, text):
    (folder / RECORD).write_bytes(text)
    opened(folder).close()
    assert entries(folder) == set()


def test_a_copy_is_as_good_as_the_original(folder, tmp_path):
    """Archives keep no nanoseconds, and some copies no times at all."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy, copy_function=shutil.copyfile, ignore=shutil.ignore_patterns("copy"))
    for path in copy.rglob("*"):
        os.utime(path, (1e9, 1e9))
    opened(copy).close()
    assert entries(copy) == {ENTRY, OTHER}


def test_nothing_is_removed_while_another_run_uses_the_folder(folder):
    """What is unknown may be what the other writes. What is damaged is not used."""
    first = opened(folder)
    fill(folder, "XY/ZZZZ")
    second = opened(folder)
    assert entries(folder) == {ENTRY, OTHER, "XY/ZZZZ"}
    flip(folder / ENTRY / "program.bc")
    assert not KernelCache(folder).open()
    second.close()
    first.close()
    opened(folder).close()
    assert "XY/ZZZZ" in entries(folder)


# --------------------------------------------------------------------------------- with the compiler


def run(*argv, **environment: str) -> subprocess.CompletedProcess[str]:
    """A command in a process with the given environment."""
    inherited = {k: v for k, v in os.environ.items() if k not in ("POCL_CACHE_DIR", "XDG_CACHE_HOME")}
    return subprocess.run(
        command(*argv),
        env={**inherited, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )


def made(folder: Path, **environment: str) -> bytes:
    """A table that is made in a process with the given environment."""
    done = run("lut", "dfg", "-o", folder / "t.npy", "--size", "4", "--force", "--quiet", **environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    return (folder / "t.npy").read_bytes()


@pytest.mark.parametrize("damage", ["flipped", pytest.param("cut", marks=pytest.mark.long)])
def test_damaged_kernels_are_built_again(tmp_path, damage):
    """Given to PoCL, such files end the process by SIGSEGV, SIGBUS or SIGABRT, or hang it."""
    home = tmp_path / "caches"
    want = made(tmp_path, XDG_CACHE_HOME=str(home))
    assert not (home / "pytools").exists(), "pyopencl's database is not used"
    rng = random.Random(7)
    found = [path for path in home.rglob("*") if path.suffix in (".bc", ".so")]
    assert found
    for path in found:
        data = bytearray(path.read_bytes())
        for _ in range(20):
            data[rng.randrange(len(data))] ^= 0xFF
        path.write_bytes(data if damage == "flipped" else data[: len(data) // 2])
    assert made(tmp_path, XDG_CACHE_HOME=str(home)) == want


@pytest.mark.few(1)
@pytest.mark.parametrize("setting", ["below a file", "a file", ""])
def test_a_cache_that_cannot_be_written_is_replaced_until_the_end(tmp_path, setting):
    blocked = tmp_path / "file"
    blocked.write_text("")  # a file in the place of a folder stops root too
    name = {"": "", "a file": str(blocked), "below a file": str(blocked / "cache")}[setting]
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    done = run("devices", POCL_CACHE_DIR=name, XDG_CACHE_HOME=name, TMPDIR=str(temporary))
    assert (done.returncode, done.stderr) == (0, "")
    assert tree(temporary) == {}


def test_a_full_disk_is_told_before_the_compiler_meets_it(tmp_path):
    with mounted(tmp_path / "disk", "size=256k") as disk:
        done = run("lut", "dfg", "-o", tmp_path / "t.npy", POCL_CACHE_DIR=str(disk))
    assert done.returncode == 4 and len(done.stderr.splitlines()) == 1
    assert f"the kernel cache at {disk}/whitefurnace has " in done.stderr and "pip install" not in done.stderr


def test_a_limit_of_file_sizes_is_told_before_the_compiler_meets_it(tmp_path):
    """bash counts in 1024 bytes."""
    devices = shlex.join(command("devices"))
    done = subprocess.run(
        ["bash", "-c", f"ulimit -f 64; {devices}"],
        env={**os.environ, "POCL_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 4 and len(done.stderr.splitlines()) == 1
    assert (
        f"65.5 KB (ulimit -f), and the OpenCL compiler needs 4.19 MB in its kernel cache at {tmp_path}" in done.stderr
    )


@pytest.mark.few(1)
@pytest.mark.parametrize("own", [False, True])
def test_the_environment_is_as_it_was(tmp_path, own):
    code = (
        "import os; before = dict(os.environ)\n"
        "from whitefurnace.opencl.device import choose_device; choose_device()\n"
        "assert dict(os.environ) == before, set(os.environ) ^ set(before)"
    )
    environment = {**os.environ, **({"POCL_CACHE_DIR": str(tmp_path)} if own else {})}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=120)


def test_a_limit_of_open_files_is_told_before_the_compiler_meets_it(tmp_path):
    import resource

    cache = opened(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    handle = os.open(os.devnull, os.O_RDONLY)  # the lowest number that is free
    os.close(handle)
    resource.setrlimit(resource.RLIMIT_NOFILE, (handle + 4, before[1]))
    try:
        with pytest.raises(caches.DeviceError, match=r"more files \(ulimit -n\)"):
            cache.check_room()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    cache.check_room()
    cache.close()


def test_room_is_looked_at_where_the_folder_is(tmp_path, monkeypatch):
    cache = opened(tmp_path)
    cache.check_room()
    monkeypatch.setattr(caches, "LEAST_ROOM", 1 << 62)
    with pytest.raises(caches.DeviceError, match=r"of space left.*POCL_CACHE_DIR"):
        cache.check_room()
    cache.close()
