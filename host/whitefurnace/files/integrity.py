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
from whitefurnace.files.tiff import COMPRESSION, MAGIC, directories

_ZLIB_TIFF = (8, 32946)


def check_file(path: Path, size: int, head: bytes) -> None:
    """Verify the checksums of a PNG or TIFF file of `size` bytes that begins with `head`.

    Raises `InputError` for certain damage; a malformed header is left for the reader to report.
    """
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        _check_png(path, size)
    elif head[:4] in MAGIC:
        _check_tiff(path)


def _check_png(path: Path, size: int) -> None:
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
            if kind == b"IEND":
                return
            start += 12 + length


def _check_tiff(path: Path) -> None:
    """Inflate every deflated strip or tile, a piece at a time, to verify its Adler-32 checksum."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            spans = list(_tiff_streams(data))
        except (struct.error, LookupError, TypeError, ValueError, ArithmeticError):
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
    for tags in directories(data, (COMPRESSION, 273, 279, 324, 325)):
        if tags[COMPRESSION][0] in _ZLIB_TIFF:
            starts, lengths = (324, 325) if 324 in tags else (273, 279)
            for start, length in zip(tags[starts], tags[lengths], strict=True):
                if not (isinstance(start, int) and isinstance(length, int)):
                    return
                yield start, length
        return
