"""Reads the directories (tags) of TIFF and BigTIFF files and of Exif, which has the same form."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError
from whitefurnace.files.colour import REC709, from_primaries

MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

COMPRESSION, WHITE, PRIMARIES = 259, 318, 319
_PAGE_LIMIT = 1000
_VALUE_LIMIT = 1 << 20
_TYPES = {1: "B", 2: "B", 3: "H", 4: "I", 5: "II", 7: "B", 8: "h", 9: "i", 11: "f", 12: "d", 13: "I", 16: "Q", 18: "Q"}

Values = Sequence[int | float]


def directories(
    data: mmap.mmap | bytes, wanted: Collection[int], most: int = _VALUE_LIMIT
) -> Iterator[dict[int, Values]]:
    """Yield the tags in `wanted` of each image of a file, of rationals their quotient.

    most: the largest number of values in a tag that is read.

    Raises `struct.error`, `LookupError` or `ValueError` where the file ends too early or its directories form a circle.
    """
    big = 43 in (data[2], data[3])
    (at,) = struct.unpack_from(_order(data) + ("Q" if big else "I"), data, 8 if big else 4)
    seen: set[int] = set()
    while at:
        if at in seen or len(seen) > _PAGE_LIMIT:
            raise ValueError("its directories form a circle")
        seen.add(at)
        tags, at = directory(data, at, wanted, most)
        yield tags


def directory(
    data: mmap.mmap | bytes, at: int, wanted: Collection[int], most: int = _VALUE_LIMIT
) -> tuple[dict[int, Values], int]:
    """Return the tags in `wanted` of the directory at byte `at`, and where the next one is; 0 after the last."""
    order = _order(data)
    big = 43 in (data[2], data[3])
    offset, count, entry, inline = ("Q", "Q", 20, 8) if big else ("I", "H", 12, 4)
    (entries,) = struct.unpack_from(order + count, data, at)
    at += struct.calcsize(order + count)
    tags: dict[int, Values] = {}
    for k in range(min(entries, 65535)):
        tag, kind, number = struct.unpack_from(order + "HH" + offset, data, at + k * entry)
        value = at + k * entry + entry - inline
        form = _TYPES.get(kind)
        if tag not in wanted or form is None or number > len(data):
            continue
        size = struct.calcsize(order + form)
        if number > most and (form != "B" or most < _VALUE_LIMIT):
            raise ValueError(f"its tag {tag} has {number} values")
        if number * size > inline:
            (value,) = struct.unpack_from(order + offset, data, value)
        if value + number * size > len(data):
            raise ValueError(f"its tag {tag} reaches beyond the end of the file")
        if form == "B":
            tags[tag] = bytes(data[value : value + number])
            continue
        found = struct.unpack_from(f"{order}{number * len(form)}{form[0]}", data, value)
        if form == "II":
            found = tuple(a / b if b else float("nan") for a, b in zip(found[::2], found[1::2], strict=True))
        tags[tag] = found
    (following,) = struct.unpack_from(order + offset, data, at + entries * entry)
    return tags, int(following)


def _order(data: mmap.mmap | bytes) -> str:
    return "<" if data[:1] == b"I" else ">"


def chromaticities(tags: Mapping[int, Values], path: Path) -> tuple[npt.NDArray[np.float64] | None, str]:
    """Return the matrix to Rec.709 of the tags WhitePoint and PrimaryChromaticities, and their numbers for people.

    Those of Rec.709 stand for a tag that is missing. Raises `InputError` for primaries that span no colour space.
    """
    xy = [float(value) for value in (*tags.get(PRIMARIES, REC709[:6]), *tags.get(WHITE, REC709[6:]))]
    shown = " ".join(f"{value:.4g}" for value in xy[:8])
    if len(xy) != 8:
        raise InputError(f"{path} states white and primaries by {len(xy)} numbers, 2 and 6 were expected")
    try:
        if not all(np.isfinite(xy)):
            raise ValueError
        return from_primaries(xy), shown
    except ValueError:
        raise InputError(f"{path} states primaries ({shown}) that span no colour space") from None
