"""Turns what a compiler says about a user's model file into one sentence that names the file, the line and the cure."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from importlib import resources

from whitefurnace.catalogue.user_text import MARK, OFFERED, OWN
from whitefurnace.errors import nearest

# Compilers write `FILE:LINE:COLUMN: error: TEXT`, PoCL `error: FILE:LINE:COLUMN: TEXT`, after what a macro stands for.
_MESSAGE = re.compile(
    rf"{re.escape(MARK)}(?P<file>.+?):(?P<line>\d+)(?::\d+)?:?(?: ?<[^>]*>)?:? (?:(?:fatal )?error: )?(?P<text>.+)"
)
_PREFIX = re.compile(rf"\b(?:{OWN}|{OFFERED})(?=\w)")

_CURES = (
    (r"use of undeclared identifier '(?P<name>\w+)'", "{name!r} is not known{near}"),
    (r"implicit declaration of function '(?P<name>\w+)'", "the function {name!r} is not known{near}"),
    (r"unknown type name '(?P<name>\w+)'", "the type {name!r} is not known; numbers are `real`, vectors `real3`"),
    (
        r"call to '(?P<name>\w+)' is ambiguous",
        "the arguments of {name!r} are of several types; write numbers as 1.0, not as 1",
    ),
    (r"no matching function for call to '(?P<name>\w+)'", "{name!r} does not take such arguments"),
    (r"array subscript is not an integer", "an index must be an integer: write T[int(x)]"),
    (r"expected ';'(?P<name>.*)", "a semicolon is missing{name}"),
    (r"redefinition of '(?P<name>\w+)'", "{name!r} is defined twice"),
)


def about_user_file(log: Iterable[str]) -> str:
    """Return the first error of a compiler's log that is about a user's model file, as a sentence; or nothing.

    log: the lines of the log.
    """
    for line in log:
        found = _MESSAGE.search(line)
        if found and re.search(r"\berror\b", line):
            return f"{found['file']}:{found['line']}: {_plain(found['text'].strip())}"
        undefined = re.search(rf"\b{OWN}(\w+)", line)
        if undefined and re.search(r"undefined|unresolved|cannot find symbol", line, re.IGNORECASE):
            return f"the model's file declares the function {undefined[1]!r} and does not define it"
    return ""


def _plain(text: str) -> str:
    """The compiler's words with the names as the file has them, and with the cure where one is known."""
    text = _PREFIX.sub("", text)
    for pattern, sentence in _CURES:
        found = re.match(pattern, text)
        if found:
            name = found.groupdict().get("name", "")
            near = nearest(name, vocabulary())
            return sentence.format(name=name, near=near if "did you mean" in near else "")
    return re.sub(r"'scalar(\d?)'(?: \(aka '[^']*'(?: \(vector of [^)]*\))?\))?", r"'real\1'", text)


@cache
def vocabulary() -> frozenset[str]:
    """Return the names that `user.clh` offers to a user's file."""
    text = re.sub("//.*", "", (resources.files("whitefurnace.kernels") / "user.clh").read_text("utf-8"))
    return frozenset(re.findall(rf"\b{OFFERED}(\w+)", text)) | frozenset(re.findall(r"^USER_\w+\((\w+),", text, re.M))
