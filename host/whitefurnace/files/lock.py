"""Locks an output, so that one process at a time writes it, and finds what a killed process left there.

The operating system releases the lock when the process that holds it ends for any reason.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Collection, Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from whitefurnace.errors import FileError
from whitefurnace.files.atomic import Transaction
from whitefurnace.files.inputs import head_of

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_MOST_BYTES = 1 << 20
_SUFFIX = ".lock"
_BEGIN = b'{"whitefurnace"'
# How long a waiter sleeps between looks: little beside an item, and no load where many wait.
_FIRST, _LAST = 0.02, 0.5


def lock_path(manifest: Path) -> Path:
    """Return the path of the lock file of an output: `.STEM.lock` in the folder of its manifest `STEM.json`."""
    return manifest.with_name(f".{manifest.name.removesuffix('.json')}{_SUFFIX}")


def is_safe(relative: Any) -> bool:
    """Return whether a file name in a manifest or lock is a text that stays in its folder.

    It may not be absolute and may not contain `..`, a drive or a backslash.
    """
    if not isinstance(relative, str) or not relative or "\\" in relative or ":" in relative.split("/")[0][1:2]:
        return False
    path = PurePosixPath(relative)
    return not path.is_absolute() and ".." not in path.parts


def leads_out(folder: Path, below: Path) -> bool:
    """Return whether a folder below `folder` is really elsewhere, through a link."""
    return Path(os.path.realpath(below)) != Path(os.path.realpath(folder), below.relative_to(folder))


class Lock:
    """A lock that this process holds.

    path    the lock file
    left    names of the files that a killed holder may have left staged
    waited  True if another process held the lock first

    The file is removed while the lock is held. A process that opened it before compares the inode and sees that this
    file is no longer the lock.
    """

    def __init__(self, path: Path, handle: int, left: tuple[str, ...], waited: bool) -> None:
        self.path, self.left, self.waited = path, left, waited
        self._handle: int | None = handle

    def note(self, targets: Iterable[Path]) -> None:
        """Write the names of files that will be staged into the lock file, for the next run in case this one is killed.

        targets: paths in the folder of the lock or below. Raises FileError where the lock file cannot be written.
        """
        names = sorted({*self.left, *(t.relative_to(self.path.parent).as_posix() for t in targets)})
        data = json.dumps({"whitefurnace": names}).encode()
        assert self._handle is not None
        try:
            os.lseek(self._handle, 0, os.SEEK_SET)
            os.ftruncate(self._handle, 0)
            os.write(self._handle, data)
        except OSError as error:
            raise FileError(f"cannot write {self.path}: {error.strerror or error}") from error

    def sweep(self, keep: Collection[Path] = ()) -> None:
        """Remove the staged files that a killed holder left, except those in `keep`."""
        for name in self.left:
            staged = Transaction.staging(self.path.parent / name)
            outside = staged.parent != self.path.parent and leads_out(self.path.parent, staged.parent)
            if is_safe(name) and staged not in keep and not outside and staged.is_file() and not staged.is_symlink():
                with contextlib.suppress(OSError):
                    staged.unlink()

    def release(self) -> None:
        """Remove the lock file and release the lock. A second call does nothing."""
        if self._handle is None:
            return
        handle, self._handle = self._handle, None
        if sys.platform != "win32":  # there an open file stays
            with contextlib.suppress(OSError):
                self.path.unlink()
        os.close(handle)
        if sys.platform == "win32":
            with contextlib.suppress(OSError):  # open elsewhere: it is theirs now
                self.path.unlink()


def acquire(
    path: Path, *, wait: bool = True, folder: bool = False, own: Callable[[str], bool] | None = None
) -> Lock | None:
    """Take the lock at `path` and return it, or None where another process holds it and `wait` is False.

    wait: wait until the lock is free. folder: create the folder of the lock where it is missing. own: tells whether a
    file name is one of the output's; other names in a lock file, which anybody may have written, are ignored.
    Raises FileError where the file cannot be created, or exists and is not a lock of this tool.
    """
    pause, waited, missing = _FIRST, False, 0
    while True:
        try:
            if folder:
                path.parent.mkdir(parents=True, exist_ok=True)
            # Not through a symbolic link: what is written would land where it points.
            handle = os.open(
                path,
                os.O_RDWR
                | os.O_CREAT
                | getattr(os, "O_NOFOLLOW", 0)
                | getattr(os, "O_BINARY", 0)
                | getattr(os, "O_NONBLOCK", 0),
                0o666,
            )
        except FileNotFoundError as error:  # a run that failed removed the empty folder just now
            missing += 1
            if not folder or missing == 10:
                raise FileError(f"cannot write into {path.parent}: {error.strerror or error}") from error
            continue
        except OSError as error:
            raise FileError(f"cannot write into {path.parent}: {error.strerror or error}") from error
        try:
            if _try(handle) and _same(handle, path):
                left = tuple(name for name in _left(path, handle) if own is None or own(name))
                return Lock(path, handle, left, waited)
        except BaseException as error:
            # A signal here must not leave the empty file that was made above. A file with content stays: it is
            # somebody else's, or names what a killed holder left.
            with contextlib.suppress(OSError):
                empty = not isinstance(error, Exception) and os.fstat(handle).st_size == 0
                if empty and _try(handle) and _same(handle, path):
                    path.unlink()
            os.close(handle)
            raise
        os.close(handle)
        if not wait:
            return None
        waited = True
        time.sleep(pause)
        pause = min(2 * pause, _LAST)


def _try(handle: int) -> bool:
    try:
        if sys.platform == "win32":
            os.lseek(handle, 1 << 30, os.SEEK_SET)  # beyond what is written: a locked byte cannot be read
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _same(handle: int, path: Path) -> bool:
    """Return whether the open file is still the one at `path`."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path, follow_symlinks=False))
    except FileNotFoundError:
        return False


def _left(path: Path, handle: int) -> tuple[str, ...]:
    os.lseek(handle, 0, os.SEEK_SET)
    data = os.read(handle, _MOST_BYTES)
    if not data:
        return ()
    try:
        names = json.loads(data)["whitefurnace"]
        return tuple(name for name in names if is_safe(name)) if isinstance(names, list) else ()
    except (ValueError, LookupError, TypeError, RecursionError):
        # A death while it was written leaves its beginning.
        if data.startswith(_BEGIN):
            return ()
        raise FileError(f"{path} is there and is not our lock; move it away") from None


def is_lock(path: Path) -> bool:
    """Return whether a file is a lock of this tool, judged by its first bytes; False where it cannot be read."""
    return head_of(path, len(_BEGIN)) == _BEGIN


def locks_in(folder: Path) -> list[Path]:
    """List the lock files in a folder, sorted; empty where the folder cannot be read."""
    try:
        with os.scandir(folder) as entries:
            return sorted(folder / e.name for e in entries if e.name.startswith(".") and e.name.endswith(_SUFFIX))
    except OSError:
        return []
