"""Reads JSON from untrusted sources: the type and the range of each value are checked.

A value that does not fit raises an error of one sentence.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.files import memory
from whitefurnace.files.binary import Source

MAX_VALUES = 4_000_000
"""Largest number of values in the JSON of a file, counted by commas and brackets: some hundred megabytes in Python."""

VALUE_BYTES = 120
"""Memory of a value in Python at most, on average: a number with its place in a list, or a short text."""


def value_count(text: str | bytes) -> int:
    """Return about the number of values in a JSON text, without parsing it."""
    if isinstance(text, str):
        return sum(text.count(mark) for mark in ",[{")
    return sum(text.count(mark) for mark in (b",", b"[", b"{"))


def parse_object(source: Source, text: str, what: str) -> dict[str, Any]:
    """Parse the JSON object in `text`; `what` names it in error messages.

    Raises `InputError` also for more than 4 000 000 values, and for more memory than the file may take.
    """
    count = value_count(text)
    if count > MAX_VALUES:
        raise source.wrong(f"{what} has about {count} values, at most {MAX_VALUES} are read")
    # The text is there once as bytes, once as characters, and once in the parsed values.
    memory.require(3 * len(text) + VALUE_BYTES * count, f"the values of {what}", source.name, len(source))
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:  # a number of too many digits is a ValueError too
        reason = str(error).splitlines()[0][:120] if isinstance(error, ValueError) else "nested too deep"
        raise source.wrong(f"{what} is not JSON ({reason})") from error
    if not isinstance(found, dict):
        raise source.wrong(f"{what} is not a JSON object")
    return found


class Reader:
    """Typed access to JSON values of the file `source`.

    Each method returns its value or raises `InputError`; `what` names the value in the message.
    """

    def __init__(self, source: Source) -> None:
        self.source = source

    def object(self, value: Any, what: str) -> dict[str, Any]:
        """Check that the value is an object."""
        if not isinstance(value, dict):
            raise self.source.wrong(f"{what} is {_kind(value)}, an object was expected")
        return value

    def array(self, value: Any, what: str, least: int, most: int) -> list[Any]:
        """Check that the value is an array of `least` to `most` entries."""
        if not isinstance(value, list):
            raise self.source.wrong(f"{what} is {_kind(value)}, an array was expected")
        if not least <= len(value) <= most:
            many = str(least) if least == most else f"{least} to {most}"
            raise self.source.wrong(f"{what} has {len(value)} entries, {many} are allowed")
        return value

    def whole(self, value: Any, what: str, least: int, most: int) -> int:
        """Check that the value is a whole number from `least` to `most`. JSON may write it as 2.0."""
        if isinstance(value, bool) or not isinstance(value, int | float) or value != value // 1:
            raise self.source.wrong(f"{what} is {_kind(value)}, a whole number was expected")
        if not least <= value <= most:
            raise self.source.wrong(f"{what} is {value!r:.40}, {least} to {most} is allowed")
        return int(value)

    def number(self, value: Any, what: str) -> float:
        """Check that the value is a finite number."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e300:
            raise self.source.wrong(f"{what} is {_kind(value)}, a finite number was expected")
        return float(value)

    def text(self, value: Any, what: str) -> str:
        """Check that the value is a text."""
        if not isinstance(value, str):
            raise self.source.wrong(f"{what} is {_kind(value)}, a text was expected")
        return value

    def rows(self, value: Any, what: str, count: int) -> npt.NDArray[np.float64]:
        """Check that the value is `count` rows of three finite numbers; return them as (count, 3)."""
        rows = self.array(value, what, count, count)
        threes = [self.array(row, f"entry {k} of {what}", 3, 3) for k, row in enumerate(rows)]
        return np.array([[self.number(number, f"a number of {what}") for number in row] for row in threes], np.float64)


def _kind(value: Any) -> str:
    """Return the words for a value in an error message."""
    if value is None:
        return "missing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return "not finite" if isinstance(value, float) and not math.isfinite(value) else f"{value!r:.40}"
    return "a text" if isinstance(value, str) else "an array" if isinstance(value, list) else "an object"
