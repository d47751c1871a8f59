"""Changes values anywhere in JSON-like documents, for the fuzz tests of glTF, manifests, jobs and engines."""

from __future__ import annotations

import copy
import json
import math
import random
import struct
from collections.abc import Iterator
from typing import Any

VALUES: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 0.0, 1, 1.0, 2.5, 1e300, -1e300, math.inf, -math.inf, math.nan, 65536, 1 << 40),
    *(1 << 64, -(1 << 63), 10**400, "", "x", "0", "\0", "\ud800", "\n", "../x", "x" * 300, [], {}, [0], [{}], [[]]),
    *({"index": 0}, {"uri": 1}, [None] * 9, [1] * 3, [1e300] * 3),
)
"""A value of every type, and the ends of their ranges."""

FOR_TOML = tuple(value for value in VALUES if value is not None and value != "\ud800" and value != "\0")
"""Those that a TOML file can hold."""


def places(document: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every value in a document."""
    if path:
        yield path
    if isinstance(document, dict | list):
        for key in document if isinstance(document, dict) else range(len(document)):
            yield from places(document[key], (*path, key))


def put(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy of a document with another value at a path; without that value where it is `...`."""
    made = copy.deepcopy(document)
    at = made
    for key in path[:-1]:
        at = at[key]
    if value is ...:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return made


def every(document: Any, values: tuple[Any, ...] = (*VALUES, ...)) -> list[tuple[tuple[Any, ...], Any]]:
    """Every path of a document with every value that it may get."""
    return [(path, value) for path in places(document) for value in values]


def changed(document: Any, rng: random.Random, values: tuple[Any, ...] = (*VALUES, ...)) -> Any:
    """A copy of a document with one to three values replaced, removed, or exchanged with another of the document."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        found = list(places(document))
        if not found:
            break
        path = rng.choice(found)
        value = rng.choice(values)
        if rng.random() < 0.2:
            value = document
            for key in rng.choice(found):
                value = value[key]
        document = put(document, path, copy.deepcopy(value))
    return document


def changed_json(data: bytes, rng: random.Random) -> bytes:
    """JSON with other values. It may hold NaN and lone surrogates, as escapes."""
    return json.dumps(changed(json.loads(data), rng)).encode()


def changed_env(data: bytes, rng: random.Random) -> bytes:
    """A Babylon .env with other values in its JSON."""
    end = data.index(b"\0", 8)
    return data[:8] + changed_json(data[8:end], rng) + data[end:]


def changed_glb(data: bytes, rng: random.Random) -> bytes:
    """A .glb with other values in its JSON, and sizes that are right."""
    (length,) = struct.unpack_from("<I", data, 12)
    text, rest = changed_json(data[20 : 20 + length], rng), data[20 + length :]
    text += b" " * (-len(text) % 4)
    return struct.pack("<4s4I", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def toml(value: Any) -> str:
    """A value as TOML writes it; tables are inline."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(k))} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, float):
        return "nan" if math.isnan(value) else repr(value)
    return str(value)


def as_toml(document: dict[str, Any]) -> str:
    """A document as TOML, one key a line."""
    return "".join(f"{json.dumps(key)} = {toml(value)}\n" for key, value in document.items())
