"""One tree of errors. A message says what, where, the allowed range and the nearest name; only the
command line turns the class into an exit code."""
from __future__ import annotations

import difflib
from collections.abc import Iterable


class WhitefurnaceError(Exception):
    """Base of every error this package raises on purpose."""

    exit_code = 1


class UsageError(WhitefurnaceError):
    """An option or argument that cannot be meant: unknown name, value out of its domain."""

    exit_code = 1


class FileError(WhitefurnaceError):
    """A file that cannot be read or written: missing, no permission, disk full, somebody else's."""

    exit_code = 2


class InputError(WhitefurnaceError):
    """A file or array that was read and is not valid input: truncated, corrupted, NaN, wrong shape."""

    exit_code = 3


class DeviceError(WhitefurnaceError):
    """No OpenCL device gives right answers, or a kernel did not build or run."""

    exit_code = 4


class UnsupportedError(WhitefurnaceError):
    """A valid request that this tool, or this combination of models, does not serve."""

    exit_code = 5


class CheckError(WhitefurnaceError):
    """A tolerance was missed or a check failed."""

    exit_code = 7


class PartialError(WhitefurnaceError):
    """Some of several items failed; the rest is done."""

    exit_code = 8


def of_code(code: int) -> type[WhitefurnaceError] | None:
    """The class with an exit code, or None."""
    return next((kind for kind in WhitefurnaceError.__subclasses__() if kind.exit_code == code), None)


def nearest(name: str, choices: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the choice closest to `name`, or the list of choices, if there is any."""
    choices = list(choices)
    if not choices:
        return "; there is none"
    close = difflib.get_close_matches(name, choices, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known: {', '.join(sorted(choices))}"
