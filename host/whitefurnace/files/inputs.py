"""Opens input files: the one door through which files that a person or another file names are read.

Only regular files are opened. A pipe, a socket or a device would block, or never end.
"""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from whitefurnace.errors import FileError, InputError

# Opening a pipe or a terminal does not wait for its other end; regular files do not know the flag.
_FLAGS = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)

_REFUSED = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def input_size(path: str | os.PathLike[str], what: str = "a file") -> int:
    """Return the size in bytes of a regular file without opening it; links are followed.

    what: the kind of file that was expected, for error messages. Raises `FileError` for a file that is missing or not
    regular.
    """
    with _refusals(path):
        return _regular(path, os.stat(path), what)


def is_input(path: str | os.PathLike[str]) -> bool:
    """Return whether there is a regular file at a path, links followed."""
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except (OSError, ValueError):
        return False


@contextlib.contextmanager
def open_input(path: str | os.PathLike[str], what: str = "a file") -> Iterator[BinaryIO]:
    """Open a regular file to read its bytes. Raises `FileError`, also for errors of the system inside the block."""
    with contextlib.ExitStack() as opened:
        with _refusals(path):
            _regular(path, os.stat(path), what)  # first without opening, since that alone may change a device
            file = opened.enter_context(open(path, "rb", opener=lambda name, flags: os.open(name, flags | _FLAGS)))
            _regular(path, os.fstat(file.fileno()), what)  # what was opened may not be what was there before
        try:
            yield file
        except OSError as error:
            raise FileError(f"cannot read {path}: {error.strerror or error}") from error


def read_input(path: str | os.PathLike[str], what: str = "a file", *, most: int) -> bytes:
    """Read a regular file of at most `most` bytes.

    what: the kind of file that was expected, for error messages. Raises `FileError` where it cannot be read, and
    `InputError` where it is larger.
    """
    with open_input(path, what) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise InputError(f"{path} has {size} bytes, {what} has at most {most}")
        return file.read(size)


def read_text(path: str | os.PathLike[str], what: str = "a text", *, most: int) -> str:
    """Read a regular file of at most `most` bytes as UTF-8; a byte-order mark at its beginning is left out.

    Raises the errors of `read_input`, and `InputError` for bytes that are not UTF-8.
    """
    try:
        return read_input(path, what, most=most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text in UTF-8 (byte {error.start}); {what} was expected") from None


def head_of(path: str | os.PathLike[str], count: int) -> bytes:
    """Return the first `count` bytes of a regular file; fewer where it ends, none where it cannot be read."""
    try:
        with open_input(path) as file:
            return file.read(count)
    except FileError:
        return b""


def inside(folder: str | os.PathLike[str], name: str) -> Path:
    """Return the path of a file that another file in `folder` names, without opening it.

    A file from a stranger must not reveal other files of the disk. Raises ValueError for a name that leads out of the
    folder: an absolute path, a drive, a URL, a way upwards, or a link to somewhere else.
    """
    if not name or name[0] in "/\\" or set(name) & {":", "\\", "\0"}:
        raise ValueError(f"{name!r} is not the name of a file in a folder")
    try:
        top = os.path.realpath(folder)
        real = os.path.realpath(os.path.join(top, name))
    except OSError as error:  # links in a circle
        raise ValueError(f"{name!r} cannot be found: {error}") from error
    if os.path.commonpath([top, real]) != top:
        raise ValueError(f"{name!r} is not in the folder")
    return Path(folder, name)


def plain_name(name: str, most: int = 60) -> str:
    """Return the beginning of a name that a file gives, in printable ASCII, for error messages."""
    return name[:most].encode("unicode_escape").decode()


@contextlib.contextmanager
def library_name(path: str | os.PathLike[str]) -> Iterator[str]:
    """Give a name of a file that OpenImageIO accepts.

    It takes names in UTF-8 alone. For a file with another name this is the name of a link in a temporary folder, with
    the same suffix. Raises `FileError` where no link can be made.
    """
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        pass
    else:
        yield str(path)
        return
    suffix = Path(path).suffix
    with tempfile.TemporaryDirectory(prefix="whitefurnace-") as folder:
        link = os.path.join(folder, "file" + (suffix if suffix.isascii() else ""))
        try:
            os.symlink(os.path.abspath(path), link)
        except OSError as error:
            raise FileError(
                f"cannot read {str(path)!r}: its name is not valid Unicode, and no link to it can be made "
                f"({error.strerror or error})"
            ) from error
        yield link


def _regular(path: str | os.PathLike[str], status: os.stat_result, what: str) -> int:
    """Return the size that `status` states. Raises `FileError` where it is not that of a regular file."""
    if stat.S_ISDIR(status.st_mode):
        raise FileError(f"cannot read {path}: it is a folder, {what} was expected")
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for test, name in _REFUSED if test(status.st_mode)), "something else")
        raise FileError(f"cannot read {path}: it is not a regular file but {kind}")
    return status.st_size


@contextlib.contextmanager
def _refusals(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the errors of the system about a file into `FileError`."""
    try:
        yield
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:  # a NUL or a lone surrogate in the name
        raise FileError(f"cannot read {str(path)!r}: {error}") from error
