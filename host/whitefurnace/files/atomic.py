"""Writes files that are either complete or absent: each is written next to its target, synced, then renamed."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType

from whitefurnace.errors import FileError
from whitefurnace.files.inputs import open_input


class Transaction:
    """A context in which several files are written that appear together or not at all.

    `stage` writes each file next to its target, and `commit` renames all of them in the same order, the manifest last.
    If the block ends before the first rename, the staged files are removed and every target stays as it was. If it ends
    between two renames, the remaining staged files stay: the staged manifest then proves to the next run that the
    renamed files are ours.
    """

    def __init__(self) -> None:
        self._targets: list[Path] = []
        self._renamed = False

    @staticmethod
    def staging(path: Path) -> Path:
        """Return the temporary path of a target: `.NAME.tmp` in the same folder."""
        return path.with_name(f".{path.name}.tmp")

    def stage(self, path: Path, writer: Callable[[Path], object]) -> None:
        """Call `writer` with the temporary path of `path`, and sync the file that it writes. Raises `FileError`."""
        temporary = self.staging(path)
        self._targets.append(path)
        try:
            # The name may be a link, or a second name of a file: writing would change that file.
            temporary.unlink(missing_ok=True)
            writer(temporary)
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        except OSError as error:
            raise FileError(f"cannot write {path}: {error.strerror or error}") from error

    def staged(self, path: Path) -> Path:
        """Return the path of the staged bytes of `path`, valid until `commit`."""
        return self.staging(path)

    def commit(self, stale: Iterable[Path] = ()) -> None:
        """Rename every staged file to its target, in the order in which they were staged.

        stale: files that are removed just before the last rename, that of the manifest. Until then the old manifest
        proves that they are ours. Raises `FileError` where a file cannot be renamed.
        """
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
    """Call `writer` with the path `.NAME.tmp` next to `path`, sync that file and rename it to `path`.

    into: a transaction in which the file is staged instead. After any exception, also Ctrl-C, the temporary file is
    removed and an existing target is unchanged. Raises `FileError` where the system refuses; other exceptions of
    `writer` pass through.
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
    """Write `pieces` one after the other as a file, as `write_atomic` does. Raises `FileError`."""

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:
            file.writelines(pieces)

    write_atomic(path, write, into)


def digest_file(path: str | os.PathLike[str]) -> str:
    """Return the sha256 of a file's bytes in hex. Raises `FileError` where it cannot be read."""
    digest = hashlib.sha256()
    with open_input(path) as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
