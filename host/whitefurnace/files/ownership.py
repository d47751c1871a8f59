"""Decides who may overwrite an output, and repairs what a run left that was killed while it wrote one.

An output is a manifest and the files next to it that the manifest proves to be ours by their sha256. One process at a
time holds the lock of an output. A `Transaction` renames the files first and the manifest last. A run that was killed
between two renames leaves the manifest staged, which tells the next run that the renamed files are ours. Bakes and
tables differ only in the form of their manifests: `FolderOutput` and `FileOutput`.
"""

from __future__ import annotations

import contextlib
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from whitefurnace.errors import FileError
from whitefurnace.files.atomic import Transaction, digest_file
from whitefurnace.files.lock import Lock, acquire, is_safe, leads_out, lock_path
from whitefurnace.files.manifest import read_manifest


@contextlib.contextmanager
def system_errors(path: Path) -> Iterator[None]:
    """Turn every OSError of the block into a FileError, which names `path` where the error names no file."""
    try:
        yield
    except OSError as error:
        raise FileError(f"cannot use {error.filename or path}: {error.strerror or error}") from error


class Output(ABC):
    """The files that one manifest proves to be ours.

    path: the manifest, `NAME.json`. All files are named by their paths relative to its folder.
    """

    writer: ClassVar[str]
    """Who writes such outputs, as errors say it."""

    makes_folder: ClassVar[bool] = False
    """Whether the folder is made where it is missing."""

    def __init__(self, path: Path) -> None:
        self.path, self.folder = path, path.parent
        self.name = path.name.removesuffix(".json")

    @abstractmethod
    def owns(self, name: str) -> bool:
        """Return whether a file may belong to this output by its name, relative to the folder.

        Manifests and locks act on such files alone: one that somebody planted must not reach other files.
        """

    @abstractmethod
    def digests(self, manifest: Mapping[str, Any]) -> dict[str, str] | None:
        """Return the sha256 of each file that a manifest lists as complete; None where it is no manifest of this
        form.
        """

    def kept(self, manifest: Mapping[str, Any]) -> dict[str, str]:
        """Return the sha256 of each file of earlier runs that a manifest still proves to be ours."""
        return {}

    def stale(self, there: dict[str, Any] | None, written: Iterable[str]) -> list[Path]:
        """List the files that the manifest `there` proves to be ours and that the files `written` make useless."""
        return []

    # ------------------------------------------------------------------------------------------ manifests

    def manifest(self) -> dict[str, Any] | None:
        """Return the manifest, or None where there is none that proves anything. Raises FileError."""
        return self._manifest(self.path)

    def staged(self) -> dict[str, Any] | None:
        """Return the manifest that a killed run left staged, or None. Raises FileError."""
        return self._manifest(Transaction.staging(self.path))

    def _manifest(self, path: Path) -> dict[str, Any] | None:
        found = read_manifest(path)
        return found if found and found.get("name") == self.name and self.digests(found) is not None else None

    def is_whole(self, manifest: Mapping[str, Any]) -> bool:
        """Return whether every file exists with the bytes whose digest the manifest states. Raises FileError."""
        return all(self._has(self.folder / name, [digest]) for name, digest in (self.digests(manifest) or {}).items())

    def _has(self, file: Path, digests: Iterable[Any]) -> bool:
        return file.is_file() and not self._leads_out(file) and digest_file(file) in digests

    def _leads_out(self, file: Path) -> bool:
        """Return whether the folder of a file is a link to elsewhere."""
        return file.parent != self.folder and leads_out(self.folder, file.parent)

    def _ours(self, manifests: Iterable[dict[str, Any] | None]) -> dict[str, list[Any]]:
        """Return, for each file, the digests that prove it to be ours."""
        found: dict[str, list[Any]] = {}
        for manifest in filter(None, manifests):
            for name, digest in {**self.kept(manifest), **(self.digests(manifest) or {})}.items():
                found.setdefault(name, []).append(digest)
        return found

    # ------------------------------------------------------------------------------------------ ownership

    def check(self, files: Sequence[Path], there: dict[str, Any] | None, force: bool) -> None:
        """Refuse to overwrite files, or a manifest, that are not ours.

        files: the files that will be written. there: the existing manifest, or None. force: True if the user allows it.
        Raises FileError, which names the file. A folder that is a link to elsewhere is refused in every case.
        """
        for folder in sorted({path.parent for path in files if self._leads_out(path)}):
            raise FileError(
                f"{folder} is a link that leads out of {self.folder} to {os.path.realpath(folder)}; nothing is written "
                "through it: remove the link, or give -o where that is meant"
            )
        if force:
            return
        known = [there, self.staged()]
        ours = self._ours(known)
        for path in (*files, self.path):
            if not path.exists() or (path == self.path and any(known)):
                continue
            if not self._has(path, ours.get(path.relative_to(self.folder).as_posix(), ())):
                raise FileError(f"{path} is there and was not written by {self.writer}; move it away or give --force")

    def lock(self) -> Lock:
        """Wait for the lock of the output and take it. Raises FileError."""
        lock = acquire(lock_path(self.path), folder=self.makes_folder, own=self.owns)
        assert lock is not None
        return lock

    # ------------------------------------------------------------------------------------------ recovery

    def settle(self, lock: Lock) -> dict[str, Any] | None:
        """Complete or remove what a killed run left, and return the manifest that exists then.

        Staged files are renamed to their targets if all of them exist and no foreign file would be replaced; otherwise
        they are removed. Raises FileError.
        """
        there, staged = self.manifest(), self.staged()
        if staged and (there or not os.path.lexists(self.path)):
            digests = self.digests(staged) or {}
            renames = self._renames(digests, self._ours((there, staged)))
            if renames is not None:
                stale = self.stale(there, digests)
                for source, target in renames:
                    os.replace(source, target)
                for file in stale:  # before the manifest that proves it ours is replaced
                    with contextlib.suppress(OSError):
                        file.unlink()
                os.replace(Transaction.staging(self.path), self.path)
                there, staged = staged, None
        # An incomplete manifest still proves that the renamed files are ours.
        lock.sweep(keep=[Transaction.staging(self.path)] if staged else ())
        return there

    def _renames(self, digests: Mapping[str, Any], ours: Mapping[str, Sequence[Any]]) -> list[tuple[Path, Path]] | None:
        """Return the renames of staged files that complete the output.

        None where a file is neither staged nor at its place, or where a file that is not ours would be replaced.
        """
        renames = []
        for name, digest in digests.items():
            target = self.folder / name
            if self._leads_out(target):
                return None
            staged = Transaction.staging(target)
            there = digest_file(target) if target.is_file() and not target.is_symlink() else None
            if there == digest:
                continue
            if staged.is_symlink() or not self._has(staged, [digest]):
                return None
            if os.path.lexists(target) and there not in ours.get(name, ()):
                return None
            renames.append((staged, target))
        return renames

    def tidy(self) -> None:
        """Complete or remove what a killed run left, unless another run holds the lock. Raises FileError."""
        path = lock_path(self.path)
        if path.exists() and (lock := acquire(path, wait=False, own=self.owns)):
            try:
                self.settle(lock)
            finally:
                lock.release()


class FileOutput(Output):
    """The output of a table: FILE, and its manifest FILE.json with the sha256 of FILE."""

    writer = "this command"

    def owns(self, name: str) -> bool:
        return name in (self.name, self.path.name)

    def digests(self, manifest: Mapping[str, Any]) -> dict[str, str] | None:
        return {self.name: manifest["sha256"]} if _is_entry(manifest) and _is_typed(manifest, _OF_TABLE) else None

    def check(self, files: Sequence[Path], there: dict[str, Any] | None, force: bool) -> None:
        for path in (*files, self.path):
            if path.is_dir():
                raise FileError(f"cannot write {path}: it is a folder")
        super().check(files, there, force)


EARLIER = ("whitefurnace", "device", "dfg", "irradiance", "recipe", "sh", "source")
"""Parts of a manifest that describe files of earlier bakes, for other engines, too."""


class FolderOutput(Output):
    """The output of a bake: `ENGINE/STEM…` for several engines, and one manifest STEM.json that lists the files.

    In the manifest, `files` lists what its bake wrote, and `kept` what earlier bakes wrote for other engines. `earlier`
    describes these bakes by their keys.
    """

    writer, makes_folder = "this bake", True

    def __init__(self, path: Path, written: Iterable[Path] = ()) -> None:
        """Take the manifest's path, and the files that the bake will write, which are the output's in any case."""
        super().__init__(path)
        self._written = {file.relative_to(self.folder).as_posix() for file in written}

    def owns(self, name: str) -> bool:
        """Return whether a file may belong to this output by its name.

        That is its manifest and probes, and ENGINE/STEM with an ending that no letter or digit begins: `raw/day2.npz`
        belongs to `day2` and not to `day`. Where outputs `day` and `day_1` are there, `raw/day_1.npz` belongs to the
        latter.
        """
        if name in self._written or name in (self.path.name, f"{self.name}.probe"):
            return True
        engine, slash, file = name.partition("/")
        if not (slash and is_safe(name) and engine not in (".", "") and "/" not in file and file.startswith(self.name)):
            return False
        ending = file[len(self.name) :]
        if not ending or ending[0].isalnum():
            return False
        longer = (file[:k] for k in range(len(self.name) + 1, len(file)) if not file[k].isalnum())
        return not any(self._is_output(stem) for stem in longer)

    def _is_output(self, stem: str) -> bool:
        """Return whether an output of this name is there or being written."""
        manifest = self.folder / f"{stem}.json"
        return any(map(os.path.lexists, (manifest, Transaction.staging(manifest), lock_path(manifest))))

    def digests(self, manifest: Mapping[str, Any]) -> dict[str, str] | None:
        for files in (manifest.get("files"), manifest.get("kept", {})):
            if not (isinstance(files, dict) and all(map(is_safe, files)) and all(map(_is_entry, files.values()))):
                return None
        if not _is_typed(manifest, _OF_BAKE) or not all(map(self.owns, manifest["files"])):
            return None
        return {name: entry["sha256"] for name, entry in manifest["files"].items()}

    def kept(self, manifest: Mapping[str, Any]) -> dict[str, str]:
        return {name: entry["sha256"] for name, entry in manifest.get("kept", {}).items() if self.owns(name)}

    def stale(self, there: dict[str, Any] | None, written: Iterable[str]) -> list[Path]:
        return self.superseded(there, written)[0]

    def superseded(self, there: dict[str, Any] | None, written: Iterable[str]) -> tuple[list[Path], dict[str, Any]]:
        """Return what the manifest `there` proves to be ours apart from the files `written`.

        The first value lists stale files of the same engines, such as the last levels of a longer chain. The second has
        the manifest's entries for files of other engines, which stay. Raises FileError.
        """
        new = set(written)
        engines = {name.split("/")[0] for name in new}
        stale: list[Path] = []
        kept: dict[str, Any] = {}
        for name, entry in {**there.get("kept", {}), **there["files"]}.items() if there else ():
            file = self.folder / name
            if name in new or not self.owns(name) or not self._has(file, [entry.get("sha256")]):
                continue
            if name.split("/")[0] in engines:
                stale.append(file)
            else:
                # The bake that wrote the file is told by its key: the manifest describes another one from now on.
                key = there.get("key") if there and name in there["files"] else None
                kept[name] = {**entry, "key": key} if isinstance(key, str) else entry
        return stale, kept

    def earlier(self, there: dict[str, Any] | None, kept: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the manifest `there` says of the bakes that wrote the files `kept`, by their keys."""
        if not there:
            return {}
        known = dict(there.get("earlier", {}))
        if isinstance(there.get("key"), str):
            known[there["key"]] = {name: there[name] for name in EARLIER if name in there}
        return {key: known[key] for key in sorted({entry.get("key", "") for entry in kept.values()}) if key in known}

    def check_writable(self, folders: Iterable[Path]) -> None:
        """Create the folders and a file in each, so that a folder that cannot be written is found before the work
        begins.

        The caller first notes `probe` of the manifest's folder in the lock. Raises FileError.
        """
        for folder in folders:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                probe = Transaction.staging(self.probe(folder))
                probe.unlink(missing_ok=True)  # of a run that was killed, or a link: never written through
                try:
                    with open(probe, "xb"):
                        pass
                finally:  # Ctrl-C between the two would leave it there
                    probe.unlink(missing_ok=True)
            except OSError as error:
                raise FileError(f"cannot write into {folder}: {error.strerror or error}") from error

    def probe(self, folder: Path) -> Path:
        """Return the file that `check_writable` stages in a folder. Its name differs between the outputs of one
        folder.
        """
        return folder / f"{self.name}.probe"


# ------------------------------------------------------------------------------------------------ forms of manifests

_DIGEST = re.compile(r"[0-9a-f]{64}")
_MOST = 1 << 62
"""Larger numbers of bytes are not those of a file."""


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e300


def _rows(value: Any) -> bool:
    """Return whether a value is a list of objects whose errors and sizes are numbers."""
    return isinstance(value, list) and all(map(_row, value))


def _row(value: Any) -> bool:
    figures = ("error", "worst", "rmse", "size", "roughness", "energy_kept", "pairs")
    return isinstance(value, dict) and all(value.get(name) is None or _number(value[name]) for name in figures)


def _source(value: Any) -> bool:
    return isinstance(value, dict) and _texts(value.get("notices", []))


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(text, str) for text in value)


def _recipe(value: Any) -> bool:
    only = value.get("only") if isinstance(value, dict) else 0
    return only is None or (isinstance(only, list) and len(only) == 2 and all(type(k) is int for k in only))


# What a run reads of a manifest that is up to date, where the manifest has it.
_OF_TABLE: Mapping[str, Callable[[Any], bool]] = {
    "key": lambda value: isinstance(value, str),
    "recipe": lambda value: isinstance(value, dict),
    "error": lambda value: value is None or _number(value),
    "notices": _texts,
}
_OF_BAKE: Mapping[str, Callable[[Any], bool]] = {
    "key": lambda value: isinstance(value, str),
    "recipe": _recipe,
    "source": _source,
    "levels": _rows,
    "as_read": _rows,
    "irradiance": _row,
    "earlier": lambda value: isinstance(value, dict) and all(isinstance(one, dict) for one in value.values()),
}


def _is_typed(manifest: Mapping[str, Any], form: Mapping[str, Callable[[Any], bool]]) -> bool:
    """Return whether the values of a manifest have the types that a run expects, where it has them."""
    return all(fits(manifest[name]) for name, fits in form.items() if name in manifest)


def _is_entry(entry: Any) -> bool:
    """Return whether the entry of a file has a sha256, and a number of bytes where it states one."""
    if not isinstance(entry, Mapping) or not isinstance(entry.get("sha256"), str):
        return False
    nbytes = entry.get("bytes", 0)
    if not isinstance(entry.get("key", ""), str):
        return False
    return bool(_DIGEST.fullmatch(entry["sha256"])) and type(nbytes) is int and 0 <= nbytes <= _MOST
