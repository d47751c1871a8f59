"""Reads and writes manifests. A manifest is a JSON file, written last, that proves the files of an output complete."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from whitefurnace.files.atomic import Transaction, write_atomic
from whitefurnace.files.inputs import input_size, is_input, read_input
from whitefurnace.files.jsontext import value_count

# A manifest lists a few files; a larger file, or one with more values, is not ours.
_MAX_BYTES, _MAX_VALUES = 64 << 20, 1 << 20


def read_manifest(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Read the manifest at `path`; None where no file is there or the file is not a manifest of this tool.

    A manifest is a JSON object with the key `whitefurnace`. Raises `FileError` for a file that exists and cannot be
    read.
    """
    path = Path(path)
    try:
        if not is_input(path) or input_size(path) > _MAX_BYTES:
            return None
        text = read_input(path, "a manifest", most=_MAX_BYTES)
        if value_count(text) > _MAX_VALUES:
            return None
        found = json.loads(text)
    except (ValueError, RecursionError):  # not UTF-8, not JSON, or nested without end
        return None
    return found if isinstance(found, dict) and "whitefurnace" in found else None


def write_manifest(
    path: str | os.PathLike[str], manifest: Mapping[str, Any], *, into: Transaction | None = None
) -> None:
    """Write `manifest` as indented JSON with sorted keys.

    manifest: must have the key `whitefurnace` (the version) and hold finite numbers only. into: the transaction that
    the file belongs to. Raises `FileError` where the file cannot be written, and ValueError for another manifest.
    """
    if "whitefurnace" not in manifest:
        raise ValueError("a manifest must have the key 'whitefurnace', the version that wrote it")
    # Python's own indentation is written in Python, at a tenth of the speed.
    plain = json.dumps(manifest, sort_keys=True, ensure_ascii=False, allow_nan=False)
    try:
        text = msgspec.json.format(plain, indent=2)
    except (UnicodeEncodeError, msgspec.DecodeError):  # a name that is not UTF-8; escapes of JSON can hold it
        text = json.dumps(manifest, sort_keys=True, allow_nan=False, indent=2)
    data = text.encode() + b"\n"
    write_atomic(path, lambda temporary: temporary.write_bytes(data), into)
