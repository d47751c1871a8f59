"""Checks image files for damage that OpenImageIO silently accepts.

OpenImageIO does not verify the checksums of a deflated TIFF, and does not notice a missing end of a PNG.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from whitefurnace.errors import InputError

_ZLIB_TIFF = (8, 32946)


def check_file(path: Path, size: int, head: bytes, notices: list[str]) -> None:
    """Verify the checksums of a PNG or TIFF file of `size` bytes that begins with `head`.

    Adds sentences to `notices` about colour spaces that are not applied. Raises `InputError` for certain damage; a
    malformed header is left for the reader to report.
    """
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        _check_png(path, size, notices)
    elif head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        _check_tiff(path)


def _check_png(path: Path, size: int, notices: list[str]) -> None:
    """Verify every length and checksum. libpng would print errors in the pixels on stderr."""
    with open(path, "rb") as file:
        start = 8
        while True:
            file.seek(start)
            head = file.read(8)
            if len(head) < 8:
                raise InputError(f"{path} is truncated: its PNG data ends at byte {size} without an end marker")
            length, kind = struct.unpack(">I4s", head)
            if start + 12 + length > size:
                raise InputError(
                    f"{path} is truncated or corrupted: the PNG chunk at byte {start} reaches beyond the end "
                    f"of the file at byte {size}"
                )
            first = file.read(min(length, 1 << 20))
            checksum, left = zlib.crc32(first, zlib.crc32(kind)), length - len(first)
            while left and (block := file.read(min(left, 1 << 20))):
                checksum, left = zlib.crc32(block, checksum), left - len(block)
            if checksum != int.from_bytes(file.read(4), "big"):
                raise InputError(f"{path} is corrupted: the PNG chunk at byte {start} does not match its checksum")
            if kind == b"gAMA" and length == 4 and abs(int.from_bytes(first, "big") - 45455) > 500:
                notices.append(
                    f"{path}: states a gamma of {int.from_bytes(first, 'big') / 1e5:g}, its integers were "
                    "decoded as sRGB all the same"
                )
            if kind == b"cICP" and first[1:2] != b"\x0d":
                notices.append(
                    f"{path}: states a transfer function other than sRGB's (cICP), its integers were decoded "
                    "as sRGB all the same"
                )
            if kind == b"IEND":
                return
            start += 12 + length


def _check_tiff(path: Path) -> None:
    """Inflate every deflated strip or tile, a piece at a time, to verify its Adler-32 checksum."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            spans = list(_tiff_streams(data))
        except (struct.error, LookupError, ValueError, ArithmeticError):
            return
        for start, length in spans:
            inflate = zlib.decompressobj()
            try:
                piece = data[start : start + length]
                while piece and not inflate.eof:
                    inflate.decompress(piece, 1 << 20)
                    piece = inflate.unconsumed_tail
                if inflate.eof:
                    continue
                what = "ends early"
            except zlib.error:
                what = "does not match its checksum"
            raise InputError(f"{path} is truncated or corrupted: the block of pixels at byte {start} {what}")


def _tiff_streams(data: mmap.mmap) -> Iterator[tuple[int, int]]:
    """Yield (start, length) of each strip or tile in the first image of a TIFF or BigTIFF, if it is deflated."""
    order = "<" if data[:1] == b"I" else ">"
    big = 43 in (data[2], data[3])
    offset, count, entry, inline = ("Q", "Q", 20, 8) if big else ("I", "H", 12, 4)
    (at,) = struct.unpack_from(order + offset, data, 8 if big else 4)
    (entries,) = struct.unpack_from(order + count, data, at)
    at += struct.calcsize(order + count)
    tags: dict[int, tuple[int, ...]] = {}
    for k in range(min(entries, 65535)):
        tag, kind, number = struct.unpack_from(order + "HH" + offset, data, at + k * entry)
        value = at + k * entry + entry - inline
        form = {3: "H", 4: "I", 16: "Q"}.get(kind)
        if tag not in (259, 273, 279, 324, 325) or form is None or number > len(data):
            continue
        if number * struct.calcsize(order + form) > inline:
            (value,) = struct.unpack_from(order + offset, data, value)
        tags[tag] = struct.unpack_from(f"{order}{number}{form}", data, value)
    if tags[259][0] in _ZLIB_TIFF:
        starts, lengths = (324, 325) if 324 in tags else (273, 279)
        yield from zip(tags[starts], tags[lengths], strict=True)
