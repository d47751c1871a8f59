"""Files that are whole or not there: written beside their target, synced, then renamed over it."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType

from whitefurnace.errors import FileError


class Transaction:
    """Several files that appear together or not at all: each is staged beside its target, and `commit` renames
    them in the order they were staged. Leaving the block before the first rename, for whatever reason, removes
    what was staged and leaves every target as it was; stopped between two renames, what is still staged stays,
    the manifest with it, and tells the next run whose the renamed files are."""

    def __init__(self) -> None:
        self._targets: list[Path] = []
        self._renamed = False

    @staticmethod
    def staging(path: Path) -> Path:
        """The temporary name of a target."""
        return path.with_name(f".{path.name}.tmp")

    def stage(self, path: Path, writer: Callable[[Path], object]) -> None:
        """Let `writer` write the temporary file of `path`, and sync it. Raises `FileError`."""
        temporary = self.staging(path)
        self._targets.append(path)
        try:
            # What is there may be a link, or a second name of a file: writing would go through to it.
            temporary.unlink(missing_ok=True)
            writer(temporary)
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        except OSError as error:
            raise FileError(f"cannot write {path}: {error.strerror or error}") from error

    def staged(self, path: Path) -> Path:
        """Where the staged bytes of `path` are until `commit`."""
        return self.staging(path)

    def commit(self, stale: Iterable[Path] = ()) -> None:
        """Rename every staged file to its target; before the last, the manifest, remove what is `stale`: the manifest
        that proves it ours is there until then. Raises `FileError`."""
        while self._targets:
            path = self._targets[0]
            for old in stale if len(self._targets) == 1 else ():
                with contextlib.suppress(OSError):
                    old.unlink()
            try:
                os.replace(self.staging(path), path)
            except OSError as error:
                raise FileError(f"cannot write {path}: {error.strerror or error}") from error
            self._renamed = True
            del self._targets[0]

    def __enter__(self) -> Transaction:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._renamed:  # stopped between renames: the manifest still staged proves the renamed ones ours
            return
        for path in self._targets:
            with contextlib.suppress(OSError):
                self.staging(path).unlink()


def write_atomic(
    path: str | os.PathLike[str], writer: Callable[[Path], object], into: Transaction | None = None
) -> None:
    """Let `writer` write `.NAME.tmp` beside `path`, sync it and rename it to `path`, or stage it in `into`.

    Whatever is raised on the way, Ctrl-C too, the temporary file is removed and an existing target is left as
    it was. Raises `FileError` where the system refuses; what else `writer` raises passes through.
    """
    if into is not None:
        into.stage(Path(path), writer)
        return
    with Transaction() as transaction:
        transaction.stage(Path(path), writer)
        transaction.commit()


def write_pieces(
    path: str | os.PathLike[str], pieces: Iterable[bytes | memoryview], into: Transaction | None = None
) -> None:
    """`write_atomic` of bytes, piece by piece."""

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:
            file.writelines(pieces)

    write_atomic(path, write, into)


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
