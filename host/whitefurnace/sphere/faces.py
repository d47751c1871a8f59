"""Sets of six image files, one for each face of a cube, found by the ends of their names."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from whitefurnace.errors import FileError, InputError
from whitefurnace.files import inside

FACE_NAMES = (
    ("px", "nx", "py", "ny", "pz", "nz"),
    ("posx", "negx", "posy", "negy", "posz", "negz"),
    ("right", "left", "top", "bottom", "front", "back"),
)
"""Ends of the names of six files, for the faces +X -X +Y -Y +Z -Z."""

_BETWEEN = "_-. "
"""What stands between the name of a set and that of a face."""


@dataclass
class FaceSet:
    """Files whose names end with those of faces, after the same text.

    prefix: that text, empty where there is none. names: a row of `FACE_NAMES`. files: by the name of the face.
    """

    prefix: str
    names: tuple[str, ...]
    files: dict[str, list[Path]] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        return len(self.files) == 6

    @property
    def apart(self) -> bool:
        """Whether the faces' names stand apart, so that an incomplete set is one too ("bright" is no face)."""
        return self.prefix == "" or self.prefix[-1] in _BETWEEN

    @property
    def title(self) -> str:
        """The name of the set; empty where the folder's name is its name."""
        return self.prefix.rstrip(_BETWEEN)

    def paths(self, folder: Path) -> list[Path]:
        """Return the six files in the order of the faces. Raises `InputError` where one is missing or there twice."""
        missing = [self.prefix + name for name in self.names if name not in self.files]
        if missing:
            raise InputError(
                f"{folder} lacks the cube {'faces' if len(missing) > 1 else 'face'} {', '.join(missing)}, "
                f"all of {' '.join(self.prefix + name for name in self.names)} were expected"
            )
        for name in self.names:
            files = self.files[name]
            if len(files) > 1:
                both = " and ".join(path.name for path in files)
                raise InputError(
                    f"{folder} holds the cube face {self.prefix}{name} more than once ({both}), one file was expected"
                )
        found = [self.files[name][0] for name in self.names]
        for path in found:
            try:
                inside(path.parent, path.name)
            except ValueError:
                raise InputError(f"{path} is a link to a file outside {path.parent}; copy the file there") from None
        return found


def face_files(source: str | os.PathLike[str], *, whole: bool = False) -> tuple[list[Path], str] | None:
    """Return the six files that a path names, in the order of the faces, and the name of their set.

    source: a folder with one set; a pattern (with *, ? or [...]) that matches one; or one file of a complete set.
    whole: whether a path that is neither is refused; otherwise the result is None for it.
    Raises `InputError` for a folder or pattern without a set or with several, and `FileError` for a folder that cannot
    be read.
    """
    path = Path(source)
    if os.path.isdir(path):
        return _only(path, _sets(_listed(path)), "")
    if not os.path.lexists(path):
        if glob.has_magic(str(path)):
            found = [Path(name) for name in glob.glob(str(path))]
            if not found:
                raise FileError(f"cannot read {path}: no file matches it")
            return _only(path, _sets(file for file in sorted(found) if file.is_file()), "; narrow the pattern")
        return None
    if _has_ending(path.stem):
        # Files of the same suffix first: the same faces may be there in another format too.
        files = _listed(path.parent)
        for some in ([file for file in files if file.suffix.lower() == path.suffix.lower()], files):
            for one in _sets(some):
                if one.complete and any(path.name == file.name for same in one.files.values() for file in same):
                    return one.paths(path.parent), one.title or Path(os.path.abspath(path.parent)).name
    if whole:
        raise InputError(f"{path} is not one of six images whose names end with those of faces, as {_choices()}")
    return None


def without_repeats(sources: Iterable[str]) -> list[str]:
    """Return paths in their order, with one file for those that are of one complete set of faces."""
    found: dict[object, str] = {}
    for source in sources:
        files = face_files(source) if os.path.isfile(source) else None
        found.setdefault(source if files is None else tuple(map(str, files[0])), source)
    return list(found.values())


def _choices() -> str:
    return ", or ".join(" ".join(names) for names in FACE_NAMES)


def _listed(folder: Path) -> list[Path]:
    """The files of a folder that are not hidden, sorted."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith(".") and path.is_file())
    except OSError as error:
        raise FileError(f"cannot read {folder}: {error.strerror or error}") from error


def _has_ending(stem: str) -> bool:
    return any(stem.lower().endswith(name) for names in FACE_NAMES for name in names)


def _sets(files: Iterable[Path]) -> list[FaceSet]:
    """All sets of files, in which one may lack faces."""
    found: dict[tuple[str, int], FaceSet] = {}
    for path in files:
        for k, names in enumerate(FACE_NAMES):
            for name in names:
                if path.stem.lower().endswith(name):
                    prefix = path.stem[: -len(name)]
                    one = found.setdefault((prefix.lower(), k), FaceSet(prefix, names))
                    one.files.setdefault(name, []).append(path)
    return list(found.values())


def _only(where: Path, sets: list[FaceSet], cure: str) -> tuple[list[Path], str]:
    """The one set of a folder or pattern, whole."""
    complete = [one for one in sets if one.complete]
    if len(complete) > 1:
        shown = ", ".join(f"{one.prefix}{one.names[0]}" for one in complete[:8])
        example = complete[0].files[complete[0].names[0]][0]
        raise InputError(
            f"{where} holds {len(complete)} sets of cube faces ({shown}{', ...' if len(complete) > 8 else ''})"
            + (cure or f"; give one file of a set, such as {example}")
        )
    if not complete:
        partial = [one for one in sets if one.apart]
        if not partial:
            raise InputError(
                f"{where} holds no cube faces, six square images whose names end with {_choices()} were expected"
            )
        complete = [max(partial, key=lambda one: len(one.files))]
    paths = complete[0].paths(where)
    folder = paths[0].parent
    return paths, complete[0].title or Path(os.path.abspath(folder)).name
