"""The exceptions of this package. The command line turns each class into its exit code.

A message names the wrong value and its place, and gives the allowed range or the nearest known name.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class WhitefurnaceError(Exception):
    """Base class of every error that this package raises on purpose. `exit_code` is that of the command line."""

    exit_code = 1


class UsageError(WhitefurnaceError):
    """An invalid option or argument, such as an unknown name or a value out of its range."""

    exit_code = 1


class FileError(WhitefurnaceError):
    """A file that cannot be read or written: missing, no permission, disk full, or not written by this tool."""

    exit_code = 2


class InputError(WhitefurnaceError):
    """A file or array that was read and is not valid: truncated, corrupted, with NaN, or of a wrong shape."""

    exit_code = 3


class DeviceError(WhitefurnaceError):
    """No OpenCL device gives correct results, or a kernel did not build or run."""

    exit_code = 4


class UnsupportedError(WhitefurnaceError):
    """A valid request that this tool, or this combination of models, does not support."""

    exit_code = 5


class CheckError(WhitefurnaceError):
    """A tolerance was not reached, or a check failed."""

    exit_code = 7


class PartialError(WhitefurnaceError):
    """Some of several items failed; the others are done."""

    exit_code = 8


class InternalError(WhitefurnaceError):
    """A fault of this package itself."""

    exit_code = 70


def code_of(error: BaseException) -> int:
    """Return the exit code for an exception: its own, that of `FileError` for the system's, else `InternalError`'s."""
    if isinstance(error, WhitefurnaceError):
        return error.exit_code
    return (FileError if isinstance(error, OSError | MemoryError) else InternalError).exit_code


def of_code(code: int) -> type[WhitefurnaceError] | None:
    """Return the class of errors with an exit code, or None."""
    return next((kind for kind in WhitefurnaceError.__subclasses__() if kind.exit_code == code), None)


def nearest(name: str, choices: Iterable[str]) -> str:
    """Return the end of an error message that suggests the choice closest to `name`, or lists all choices.

    Case does not count, nor whether words are joined by _, - or a space; among names that differ by case alone, the
    closest in case is suggested.
    """
    choices = list(choices)
    if not choices:
        return "; there is none"
    alike: dict[str, list[str]] = {}
    for choice in choices:
        alike.setdefault(_folded(choice), []).append(choice)
    close = difflib.get_close_matches(_folded(name), alike, n=1, cutoff=0.5)
    if close:
        best = max(alike[close[0]], key=lambda choice: difflib.SequenceMatcher(None, name, choice).ratio())
        return f"; did you mean {best!r}?"
    return f"; known: {', '.join(sorted(choices))}"


def _folded(name: str) -> str:
    return name.casefold().replace("-", "_").replace(" ", "_")
