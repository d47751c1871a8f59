"""Zstandard, and the only importer of `zstandard`: what comes out of a frame is never more than was asked for."""

from __future__ import annotations

from whitefurnace.files.binary import Buffer, Source

_PIECE = 1 << 20
# RFC 8878, 3.1.1.2: a block of at most 128 KiB takes at least 4 bytes (a header of 3, and of an RLE block 1).
MAX_RATIO = 32768
# RFC 8878, 3.1.1.1.2: decoders should take windows of 8 MiB; the library's own highest levels use up to 128 MiB.
_WINDOWS = (8 << 20, 128 << 20)


def compress(data: Buffer, level: int) -> bytes:
    """One frame that states its size and has no checksum (the file's digest is in the manifest). `level` 1 to 22."""
    import zstandard

    if not 1 <= level <= 22:
        raise ValueError(f"level {level} of Zstandard is not between 1 and 22")
    return zstandard.ZstdCompressor(level=level, write_checksum=False, write_content_size=True).compress(data)


def decompress(data: Buffer, size: int, source: Source, what: str) -> bytearray:
    """The frame `data`, which must hold exactly `size` bytes. Memory grows with what comes out, a piece at a time, and
    no further than `size`. Raises `InputError` that names `what` of `source`."""
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
