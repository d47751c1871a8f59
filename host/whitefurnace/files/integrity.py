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
from whitefurnace.files.inputs import open_input
from whitefurnace.files.memory import require
from whitefurnace.files.tiff_tags import COMPRESSION, MAGIC, directories

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
    """Verify every length and checksum, and the rows. libpng would print errors in them on stderr."""
    rows: _Rows | None = None
    palette = False
    with open_input(path) as file:
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
            if (rows is None) != (kind == b"IHDR"):
                raise InputError(f"{path} is corrupted: its PNG data does not begin with one header, IHDR")
            checksum, left, blocks = zlib.crc32(kind), length, []
            while left and (block := file.read(min(left, 1 << 20))):
                checksum, left = zlib.crc32(block, checksum), left - len(block)
                if kind == b"IDAT" and rows is not None:
                    rows.take(block)
                elif kind == b"IHDR":
                    blocks.append(block)
            if checksum != int.from_bytes(file.read(4), "big"):
                raise InputError(f"{path} is corrupted: the PNG chunk at byte {start} does not match its checksum")
            palette |= kind == b"PLTE"
            if kind == b"IDAT" and rows is not None and rows.indexed and not palette:
                raise InputError(f"{path} is corrupted: its pixels are of a palette (PLTE), which is not before them")
            if kind == b"IHDR":
                rows = _Rows(b"".join(blocks), path, size)
            if kind == b"IEND":
                break
            start += 12 + length
    if rows is None or not rows.whole:
        raise InputError(f"{path} is truncated or corrupted: its rows end early")


# Of Adam7: first column and row, and the steps of both, for each of the seven passes [PNG 3, 8.1].
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
_MAX_RATIO = 1032  # deflate packs at most 258 bytes into two bits [RFC 1951, 3.2.5]
_SURPLUS = 1 << 16  # bytes after the rows, from which on the end of the data is not looked for
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}


class _Rows:
    """The deflated rows of a PNG: inflates them as they come, and looks at the filter of each."""

    def __init__(self, header: bytes, path: Path, size: int) -> None:
        self._path = path
        if len(header) != 13:
            raise self._wrong(f"its header has {len(header)} bytes, 13 were expected")
        width, height, depth, colour, method, filters, interlace = struct.unpack(">2I5B", header)
        sizes = 0 < width < 1 << 31 and 0 < height < 1 << 31
        if not sizes or depth not in _DEPTHS.get(colour, ()) or method or filters or interlace > 1:
            raise self._wrong(
                f"its header states {width} x {height} pixels of {depth} bits, colour type {colour}, compression "
                f"{method}, filter {filters} and interlace {interlace}, which PNG does not know"
            )
        passes = _PASSES if interlace else ((0, 0, 1, 1),)
        # Number of rows and bytes in each, of passes with pixels.
        self._spans = [
            (-(-(height - y) // dy), 1 + (-(-(width - x) // dx) * depth * _CHANNELS[colour] + 7) // 8)
            for x, y, dx, dy in passes
            if height > y and width > x
        ]
        total = sum(count * stride for count, stride in self._spans)
        if total > _MAX_RATIO * size + 64:
            raise InputError(
                f"{path} states a size of {width} x {height}, but its {size} bytes cannot hold that many pixels"
            )
        require(total, f"its {width} x {height} pixels", path, size)
        self.indexed = colour == 3
        self._inflate = zlib.decompressobj()
        self._passed = 0  # bytes of the current span, and after the last one those that nobody needs

    @property
    def whole(self) -> bool:
        """True if all rows and the end of the deflated data have been read."""
        return not self._spans and (self._inflate.eof or self._passed > _SURPLUS)

    @property
    def _over(self) -> bool:
        """Whether nothing that comes is looked at any more."""
        return self._inflate.eof or (not self._spans and self._passed > _SURPLUS)

    def take(self, block: bytes) -> None:
        try:
            # zlib may take the last of its input and still hold output for the next call, if a piece is full.
            full = False
            while (block or full) and not self._over:
                piece = self._inflate.decompress(block, 1 << 20)
                self._look(piece)
                block, full = self._inflate.unconsumed_tail, len(piece) == 1 << 20
        except zlib.error as error:
            raise self._wrong(f"its pixels cannot be inflated ({error})") from error

    def _look(self, piece: bytes) -> None:
        at = 0
        while at < len(piece) and self._spans:
            count, stride = self._spans[0]
            end = min(len(piece), at + count * stride - self._passed)
            marks = piece[at + -self._passed % stride : end : stride]
            if marks and max(marks) > 4:
                raise self._wrong("a row has a filter that PNG does not know")
            self._passed += end - at
            at = end
            if self._passed == count * stride:
                del self._spans[0]
                self._passed = 0
        if not self._spans:
            self._passed += len(piece) - at

    def _wrong(self, what: str) -> InputError:
        return InputError(f"{self._path} is corrupted: {what}")


def _check_tiff(path: Path) -> None:
    """Inflate every deflated strip or tile, a piece at a time, to verify its Adler-32 checksum."""
    with open_input(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            spans = list(_tiff_streams(data))
        except (struct.error, LookupError, TypeError, ValueError, ArithmeticError):
            return
        for start, length in spans:
            inflate = zlib.decompressobj()
            try:
                piece, full = data[start : start + length], False
                while (piece or full) and not inflate.eof:
                    full = len(inflate.decompress(piece, 1 << 20)) == 1 << 20
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
