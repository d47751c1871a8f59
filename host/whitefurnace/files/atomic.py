"""Files that are whole or not there: written beside their target, synced, then renamed over it."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

from whitefurnace.errors import FileError


def write_atomic(path: str | os.PathLike[str], writer: Callable[[Path], object]) -> None:
    """Let `writer` write `.NAME.tmp` beside `path`, sync it and rename it to `path`.

    Whatever is raised on the way, Ctrl-C too, the temporary file is removed and an existing target is left as
    it was. Raises `FileError` where the system refuses; what else `writer` raises passes through.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        try:
            writer(temporary)
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror or error}") from error


def digest_file(path: str | os.PathLike[str]) -> str:
    """sha256 of a file's bytes in hex. Raises `FileError` where it cannot be read."""
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from error
    return digest.hexdigest()
