"""Runs of `bake`, `lut` and `batch` that end at random moments, by SIGKILL, by SIGTERM or on a full disk.

Nothing is torn: a file under its own name is complete. Nothing is left: after SIGTERM and a full disk at once, after
SIGKILL by the next run.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from shell import mounted, tree
from whitefurnace.files import write_exr

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="signals and limits as POSIX has them")

SIZES = ("--size", "16", "--min-size", "8", "--tolerance", "1e-2", "--certify", "299", "--quiet")

HOST = """
import json, os, sys
import whitefurnace.baking.bake, whitefurnace.batch.jobs, whitefurnace.tables.lut, scipy.special, OpenImageIO
from whitefurnace.cli import main
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        main(json.loads(line))
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class Host:
    """A process that has imported everything and used no device; each command line runs in a fork of it.

    Starting Python and importing take more time than a small bake.
    """

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", HOST],
            env={**os.environ, "OMP_NUM_THREADS": "1"},  # threads of libraries do not come along in a fork
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def __call__(self, argv: list[str], end: Callable[[int], None] = lambda pid: None) -> int:
        """Run a command line, call `end` with its process id meanwhile, and return its exit code."""
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(json.dumps(argv) + "\n")
        self._process.stdin.flush()
        end(int(self._process.stdout.readline()))
        return int(self._process.stdout.readline())

    def close(self) -> None:
        assert self._process.stdin
        self._process.stdin.close()
        self._process.wait()


class Case:
    """A command whose output is another in every trial, so that each trial replaces what the one before made."""

    def __init__(self, kind: str, folder: Path, out: Path) -> None:
        self.kind, self.folder, self.out = kind, folder, out
        names = {"bake": ["a"], "lut": [], "batch": ["a", "b", "c"]}[kind]
        for k, name in enumerate(names):
            pixels = np.random.default_rng(k).random((4, 8, 3), dtype=np.float32)
            write_exr(folder / f"{name}.exr", pixels)

    def argv(self, trial: int) -> list[str]:
        if self.kind == "bake":
            engines = ("--for", "raw,exr", "--exposure", str(trial % 7))
            return ["bake", str(self.folder / "a.exr"), "-o", str(self.out), *SIZES, *engines]
        if self.kind == "lut":
            return ["lut", "dfg", "-o", str(self.out / "t.npy"), "--size", str(32 + trial % 7), "--quiet"]
        job = self.folder / "job.toml"
        job.write_text(
            f'[[bake]]\nenvironments = ["*.exr"]\noutput = "{self.out.name}"\nsize = 16\nmin_size = 8\n'
            f"tolerance = 1e-2\nexposure = {trial % 7}\n"
            f'[[lut]]\nkind = "dfg"\noutput = "{self.out.name}/t.npy"\nsize = {16 + trial % 7}\n'
        )
        return ["batch", str(job), "--quiet", "-o", str(self.folder)]

    def files(self) -> dict[str, bytes]:
        return tree(self.out) if self.out.exists() else {}

    def nothing_torn(self) -> None:
        """Every file under its own name can be read to its end; others are staged, or locks."""
        for name, data in self.files().items():
            path = self.out / name
            if path.name.startswith("."):
                assert name.endswith((".tmp", ".lock")), name
            elif path.suffix == ".json":
                json.loads(data)
            elif path.suffix == ".npz":
                with np.load(path) as archive:
                    assert "dfg" in archive.files  # the last of its arrays
            elif path.suffix == ".npy":
                np.load(path)

    def nothing_left(self) -> None:
        """There is no file but manifests and what they prove."""
        files = self.files()
        proven = set()
        for name in [name for name in files if name.endswith(".json")]:
            manifest = json.loads(files[name])
            entries = manifest.get("files") or {name.removesuffix(".json"): {"sha256": manifest.get("sha256")}}
            for relative, entry in entries.items():
                assert hashlib.sha256(files[relative]).hexdigest() == entry["sha256"], relative
                proven |= {relative, name}
        assert set(files) == proven

    def whole(self) -> None:
        self.nothing_left()
        assert len([name for name in self.files() if name.endswith(".json")]) == (4 if self.kind == "batch" else 1)


@pytest.fixture(scope="module")
def host() -> Iterator[Host]:
    found = Host()
    yield found
    found.close()


@pytest.fixture
def case(request, tmp_path) -> Case:
    out = tmp_path / "out"
    out.mkdir()
    return Case(request.param, tmp_path, out)


KINDS = ["bake", "lut", "batch"]
TRIALS = [pytest.param(2, id="2"), pytest.param(50, id="50", marks=pytest.mark.long)]


def ended(number: int, case: Case, wait: float, rng: random.Random) -> Callable[[int], None]:
    """Send a signal at a random moment of the run; in every second trial of that part in which it writes files."""
    writing = rng.random() < 0.5
    moment = rng.uniform(0, wait)

    def end(pid: int) -> None:
        begin = time.monotonic()
        if writing:
            while time.monotonic() - begin < 2 * wait and not any(case.out.rglob(".*.lock")):
                time.sleep(0.001)
            time.sleep(rng.uniform(0, wait / 5))
        else:
            time.sleep(moment)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)

    return end


@pytest.mark.parametrize("times", TRIALS)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM], ids=["SIGKILL", "SIGTERM"])
@pytest.mark.parametrize("case", KINDS, indirect=True)
def test_a_signal_at_a_random_moment(case, host, shell, device, number, times):
    rng = random.Random(len(case.kind) + number)
    assert host(case.argv(0)) == 0  # its kernels are then in the compiler's cache
    begin = time.monotonic()
    assert host(case.argv(1)) == 0
    length = min(time.monotonic() - begin, 1.0)  # on a busy machine it may take many
    for trial in range(2, times + 2):
        code = host(case.argv(trial), ended(number, case, length, rng))
        assert code in (0, -number, 128 + number), code
        case.nothing_torn()
        if number == signal.SIGTERM:
            case.nothing_left()
        assert shell(*case.argv(trial)) == 0, shell.err
        case.whole()


@pytest.mark.parametrize("times", TRIALS)
@pytest.mark.parametrize("how", ["limit", "disk"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_full_disk_at_a_random_size(tmp_path, shell, device, kind, how, times):
    """A limit of the size of files, or a file system of that size; then there is room."""
    rng = random.Random(len(kind) + len(how))
    with mounted(tmp_path / "out", "size=8m") if how == "disk" else contextlib.nullcontext(tmp_path / "out") as out:
        out.mkdir(exist_ok=True)
        case = Case(kind, tmp_path, out)
        assert shell(*case.argv(0)) == 0
        case.whole()
        sizes = [len(data) for data in case.files().values()]
        failures = 0
        for trial in range(1, times + 1):
            with small(out, how, rng, sizes):
                code = shell(*case.argv(trial))
            assert code in (0, 2, 8), shell.err
            failures += code != 0
            case.nothing_torn()
            case.nothing_left()
            assert shell(*case.argv(trial)) == 0, shell.err
            case.whole()
        assert failures or times < 10  # two random sizes may both be enough


@contextlib.contextmanager
def small(out: Path, how: str, rng: random.Random, sizes: list[int]) -> Iterator[None]:
    """Let files have a random size at most, or leave so much room in the file system of `out`."""
    if how == "limit":
        import resource

        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (rng.randrange(max(sizes)), before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        return
    filler = out.parent / "out" / "filler"
    room = os.statvfs(out)
    left = room.f_bavail * room.f_frsize - rng.randrange(sum(sizes))
    filler.write_bytes(b"x" * max(left, 0))
    try:
        yield
    finally:
        filler.unlink()
