"""The folder in which OpenCL compilers keep built kernels, and which of its files may be used.

A compiler that reads a damaged file, or whose disk is full, ends the whole process without a word: PoCL maps files
and runs them, and LLVM calls exit(1). So each run checks the files before a compiler sees them. A run that ends well
records size, time and digest of every file that is there. The next run keeps entries whose files are as recorded, and
removes all others: those of a run that was killed, and those that were changed since. While another run uses the
folder nothing is removed, because what is not recorded may be what the other is writing.

Comparing sizes and times costs 5 ms for a hundred kernels, and as much at the end. A trial in a process of its own
would cost half a second in every run and would try one kernel only.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from whitefurnace.errors import DeviceError
from whitefurnace.text import size

if sys.platform != "win32":
    import fcntl
    import resource

LOCK, RECORD = "lock", "seen.json"
UNRECORDED = "last_accessed"
"""A file of PoCL that changes at every use."""

MOST_RECORD = 64 << 20
"""Largest size of a record that is read, in bytes: a hundred thousand kernels."""

LEAST_ROOM = 16 << 20
"""Bytes that must be free where kernels are built: source, bitcode, object and library of the largest take 3 MB."""

LEAST_FILE = 4 << 20
"""Size that a file of this process must be allowed to have: the largest source takes 1 MB after preprocessing."""

LEAST_HANDLES = 12
"""Files that this process must be allowed to open beside those that it has; with fewer than 8 PoCL aborts."""

PATIENCE = 5.0
"""Seconds to wait for another process that cleans the folder, which takes milliseconds."""

State = tuple[int, int, str]
"""Size, time of change in nanoseconds, and sha256 of a file."""


class KernelCache:
    """A folder of built kernels. It is locked as long as this process lives, shared with other processes."""

    def __init__(self, folder: Path, *, temporary: bool = False) -> None:
        self.folder = folder
        self.temporary = temporary
        self._handle: int | None = None

    # ------------------------------------------------------------------------------------------ trust

    def open(self) -> bool:
        """Lock the folder and remove what cannot be trusted; return whether the rest can be used."""
        if self.temporary or sys.platform == "win32":
            return True
        self._handle = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
        known = self._read()
        if self._locked(fcntl.LOCK_EX):
            self._clean(known)
            self._locked(fcntl.LOCK_SH)
            return True
        deadline = time.monotonic() + PATIENCE
        while not self._locked(fcntl.LOCK_SH) and time.monotonic() < deadline:
            time.sleep(0.01)
        files = dict(self._files())
        whole = all(name in files and self._is(name, files[name], state) for name, state in known.items())
        if not whole:
            os.close(self._handle)
            self._handle = None
        return whole

    def _locked(self, how: int) -> bool:
        assert self._handle is not None
        try:
            fcntl.flock(self._handle, how | fcntl.LOCK_NB)
        except OSError:  # another has it, or the file system has no locks
            return False
        return True

    def _clean(self, known: dict[str, State]) -> None:
        """Remove every entry, a folder two levels deep, that is not as recorded, and what lies outside of entries."""
        files = dict(self._files())
        right = {name for name, state in known.items() if name in files and self._is(name, files[name], state)}
        for name in {_entry(name) for name in (files.keys() | known.keys()) - right}:
            path = self.folder / name
            with contextlib.suppress(OSError):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink()

    def _is(self, name: str, status: os.stat_result, state: State) -> bool:
        """Whether a file is as recorded. One of another time, as a copy has, is compared by its digest."""
        nbytes, changed, digest = state
        if status.st_size != nbytes or not stat.S_ISREG(status.st_mode):
            return False
        return status.st_mtime_ns == changed or self._digest(name) == digest

    def _digest(self, name: str) -> str:
        try:
            return hashlib.sha256((self.folder / name).read_bytes()).hexdigest()
        except OSError:
            return ""

    def _files(self) -> Iterator[tuple[str, os.stat_result]]:
        """Each file by its path in the folder, but for the record, locks and what changes at every use."""
        folder, waiting = str(self.folder), [""]
        while waiting:
            inside = waiting.pop()
            with contextlib.suppress(OSError), os.scandir(f"{folder}/{inside}") as entries:
                for entry in entries:
                    name = inside + entry.name
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(name + "/")
                    elif entry.name not in (UNRECORDED, LOCK) and name != RECORD:
                        yield name, entry.stat(follow_symlinks=False)

    # ------------------------------------------------------------------------------------------ record

    def _read(self) -> dict[str, State]:
        """The recorded state of each file; empty where there is no record that can be read."""
        try:
            path = self.folder / RECORD
            if not path.is_file() or path.stat().st_size > MOST_RECORD:
                return {}
            found = json.loads(path.read_bytes())["files"]
            return {
                str(name): (int(size), int(changed), str(digest)) for name, (size, changed, digest) in found.items()
            }
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return {}

    def close(self) -> None:
        """Record what is there, at the end of a run that ended in order, and let go of the folder."""
        if self.temporary:
            shutil.rmtree(self.folder, ignore_errors=True)
            return
        if self._handle is None:
            return
        with contextlib.suppress(OSError):
            known = self._read()
            found: dict[str, Any] = {}
            for name, status in self._files():
                if "/" in name and stat.S_ISREG(status.st_mode):
                    old = known.get(name)
                    same = old is not None and (status.st_size, status.st_mtime_ns) == old[:2]
                    found[name] = old if same else (status.st_size, status.st_mtime_ns, self._digest(name))
            if found != known:
                handle, staged = tempfile.mkstemp(prefix=RECORD, dir=self.folder)
                with open(handle, "w", encoding="utf-8") as file:
                    json.dump({"files": found}, file)
                os.replace(staged, self.folder / RECORD)
        os.close(self._handle)
        self._handle = None

    # ------------------------------------------------------------------------------------------ room

    def check_room(self) -> None:
        """Raise DeviceError where a compiler could not write its files, before it ends the process for that."""
        if sys.platform == "win32":
            return
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        if limit != resource.RLIM_INFINITY and limit < LEAST_FILE:
            raise DeviceError(
                f"files of this process may have {size(limit)} (ulimit -f), and the OpenCL compiler needs "
                f"{size(LEAST_FILE)} in its kernel cache at {self.folder}"
            )
        handles: list[int] = []
        try:
            while len(handles) < LEAST_HANDLES:
                handles.append(os.open(os.devnull, os.O_RDONLY))
        except OSError as error:
            raise DeviceError(
                f"this process may open only {len(handles)} more files (ulimit -n), and the OpenCL compiler needs "
                f"{LEAST_HANDLES}"
            ) from error
        finally:
            for handle in handles:
                os.close(handle)
        with contextlib.suppress(OSError):
            room = os.statvfs(self.folder)
            free = room.f_bavail * room.f_frsize
            if free < LEAST_ROOM or (room.f_files and not room.f_favail):
                raise DeviceError(
                    f"the kernel cache at {self.folder} has {size(free)} of space left, and the OpenCL compiler needs "
                    f"{size(LEAST_ROOM)}: free some there, or let POCL_CACHE_DIR name a folder with more"
                )


def _entry(name: str) -> str:
    """The first two parts of a path."""
    return "/".join(name.split("/")[:2])


def _folder() -> Path:
    """Where kernels are cached: in the folder that POCL_CACHE_DIR names, else in that of the user's caches."""
    own = os.environ.get("POCL_CACHE_DIR")
    if own:
        return Path(own, "whitefurnace")
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser(), "whitefurnace", "kernels")


def kernel_cache() -> KernelCache | None:
    """Return the cache of kernels of this process, open; None where no folder at all can be written.

    A folder of this process alone, which lasts until its end, takes the place of the user's where that cannot be
    written, or is damaged while another process uses it.
    """
    with contextlib.suppress(OSError, RuntimeError, ValueError):  # no home, a NUL in the name
        folder = _folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        cache = KernelCache(folder.resolve())
        with tempfile.TemporaryFile(dir=folder):
            pass
        if cache.open():
            return cache
    with contextlib.suppress(OSError):
        return KernelCache(Path(tempfile.mkdtemp(prefix="whitefurnace-cache-")), temporary=True)
    return None
