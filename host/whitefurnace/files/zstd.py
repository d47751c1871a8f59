"""Compresses with Zstandard; unpacks Zstandard and ZLIB, never to more bytes than the caller expects.

Only this module imports `zstandard`.
"""

from __future__ import annotations

import zlib

from whitefurnace.files.binary import Buffer, Source

_PIECE = 1 << 20
# RFC 8878, 3.1.1.2: a block of at most 128 KiB takes at least 4 bytes, 3 of its header and 1 of an RLE block.
MAX_RATIO = 32768
# RFC 8878, 3.1.1.1.2: decoders should accept windows of 8 MiB; the library's highest levels use up to 128 MiB.
_WINDOWS = (8 << 20, 128 << 20)


def compress(data: Buffer, level: int) -> bytes:
    """Compress `data` at `level`, 1 to 22, to one frame that states its size and has no checksum.

    No checksum is needed because manifests hold the digest of the file.
    """
    import zstandard

    if not 1 <= level <= 22:
        raise ValueError(f"level {level} of Zstandard is not between 1 and 22")
    return zstandard.ZstdCompressor(level=level, write_checksum=False, write_content_size=True).compress(data)


def decompress(data: Buffer, size: int, source: Source, what: str) -> bytearray:
    """Decompress the frame `data`, which must hold exactly `size` bytes.

    Memory grows with the output, piece by piece, to no more than `size`. Raises `InputError`, which names `what` of
    `source`.
    """
    import zstandard

    if size > len(data) * MAX_RATIO:
        raise source.wrong(f"{what} cannot hold {size} bytes in {len(data)}, Zstandard packs at most 1 : {MAX_RATIO}")
    window = min(max(size, _WINDOWS[0]), _WINDOWS[1])
    out = bytearray()
    try:
        stated = zstandard.frame_content_size(data)
        if stated not in (-1, size):
            raise source.wrong(f"the Zstandard frame of {what} states {stated} bytes, its level has {size}")
        unpacker = zstandard.ZstdDecompressor(max_window_size=window)
        with unpacker.stream_reader(data, read_size=_PIECE, read_across_frames=False) as stream:
            while piece := stream.read(min(_PIECE, size + 1 - len(out))):
                out += piece
    except zstandard.ZstdError as error:
        reason = str(error).removeprefix("zstd decompress error: ").replace("\n", " ")
        raise source.wrong(f"{what} cannot be unpacked by Zstandard ({reason})") from error
    if len(out) != size:
        more = "more than " if len(out) > size else ""
        raise source.wrong(f"{what} unpacks to {more}{min(len(out), size)} bytes, its level has {size}")
    return out


DEFLATE_RATIO = 1032
"""Deflate packs at most 258 bytes into two bits [RFC 1951, 3.2.5]."""


def inflate(
    data: Buffer, size: int, source: Source, what: str, *, needs: str = "its level has", rest: bool = False
) -> bytearray:
    """Unpack the ZLIB stream `data`, which must hold exactly `size` bytes and an end.

    needs: what states the size, for messages. rest: whether bytes may follow the end. Memory grows with the output,
    piece by piece, to no more than `size`. Raises `InputError`, which names `what` of `source`.
    """
    if size > len(data) * DEFLATE_RATIO:
        raise source.wrong(f"{what} cannot hold {size} bytes in {len(data)}, ZLIB packs at most 1 : {DEFLATE_RATIO}")
    unpacker, out, at = zlib.decompressobj(), bytearray(), 0
    try:
        for at in range(0, len(data), _PIECE):
            left, full = bytes(data[at : at + _PIECE]), True
            while full and not unpacker.eof and len(out) <= size:
                room = min(_PIECE, size + 1 - len(out))
                piece = unpacker.decompress(left, room)
                out += piece
                left = unpacker.unconsumed_tail
                full = bool(left) or len(piece) == room  # there may be more without further input
            if unpacker.eof or len(out) > size:
                break
    except zlib.error as error:
        raise source.wrong(f"{what} cannot be unpacked by ZLIB ({error})") from error
    if len(out) != size or not unpacker.eof:
        beyond = "more than " if len(out) > size else ""
        end = "" if unpacker.eof or len(out) > size else " and an end"
        raise source.wrong(f"{what} unpacks to {beyond}{min(len(out), size)} bytes, {needs} {size}{end}")
    if not rest and (unused := len(unpacker.unused_data) + max(len(data) - at - _PIECE, 0)):
        raise source.wrong(f"{what} has {unused} bytes after the end of its ZLIB stream")
    return out
