"""Encodes and decodes PNG images bit for bit.

RGBD codes are stored in PNG, so alpha is never multiplied into the colour. OpenImageIO encodes and decodes; lengths,
checksums and sizes are checked before.
"""

from __future__ import annotations

import contextlib
import os
import struct
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import FileError, InputError
from whitefurnace.files import memory
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.binary import Buffer, Source
from whitefurnace.files.zstd import DEFLATE_RATIO, inflate

SIGNATURE = b"\x89PNG\r\n\x1a\n"
MAX_SIDE = 32768
Pixels = npt.NDArray[np.uint8]

_HEADER = struct.Struct(">2I5B")
_RGB, _RGBA = 2, 6  # colour types [PNG 3, 11.2.1]


def encode_png(pixels: npt.NDArray[Any], *, srgb: bool = False, effort: int = 9) -> bytes:
    """Encode `pixels` (height, width, 1 | 3 | 4) of 8 or 16 bits as PNG; the same pixels give the same bytes.

    The file holds the pixels and no other data. srgb: mark the pixels as a picture in sRGB; readers do not convert an
    image without a colour space. effort: compression level of zlib, 1 to 9. Raises `FileError` where OpenImageIO
    fails.
    """
    pixels = np.ascontiguousarray(pixels)
    if (
        pixels.dtype not in (np.uint8, np.uint16)
        or pixels.ndim != 3
        or pixels.shape[2] not in (1, 3, 4)
        or 0 in pixels.shape
    ):
        raise ValueError(
            f"pixels of {pixels.dtype} and shape {pixels.shape} are not uint8 or uint16 (height, width, 1 | 3 | 4)"
        )
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, pixels.dtype.name)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("png:compressionLevel", effort)
    with _scratch_file(".png") as path:
        output = oiio.ImageOutput.create("png")
        done = output is not None and output.open(str(path), spec) and output.write_image(pixels)
        closed = output is not None and output.close()
        if not (done and closed):
            complaint = (output.geterror() if output is not None else "") or oiio.geterror() or "no reason given"
            raise FileError(f"OpenImageIO cannot write a PNG: {complaint.strip().splitlines()[0]}")
        made = Source(path.read_bytes(), "a PNG of OpenImageIO")
    # OpenImageIO also writes a gamma, chromaticities, Exif and an offset. They may lead a browser to convert the codes,
    # and take more bytes than the texels of a small face.
    kept = {kind: b"" for kind in (b"IHDR", b"IDAT", b"IEND")}
    for kind, body in _chunks(made):
        if kind in kept:
            kept[kind] += bytes(body)
    out = SIGNATURE + _chunk(b"IHDR", kept[b"IHDR"])
    if srgb:
        out += _chunk(b"sRGB", b"\0")  # rendering intent: perceptual
    return out + _chunk(b"IDAT", kept[b"IDAT"]) + _chunk(b"IEND", b"")


def decode_png(data: Buffer | Source, *, side: int | None = None) -> Pixels:
    """Decode the stored pixels of an 8-bit RGB or RGBA PNG, uint8 (height, width, 3 | 4).

    side: the expected width and height; None for any. Raises `InputError` for a PNG that is damaged, of another size
    or of another kind.
    """
    source = data if isinstance(data, Source) else Source(data, "a PNG")
    width, height, channels, packed = _checked(source, side)
    head = _chunk(b"IHDR", _HEADER.pack(width, height, 8, _RGBA if channels == 4 else _RGB, 0, 0, 0))
    pixels = decode_by_oiio(SIGNATURE + head + _chunk(b"IDAT", packed) + _chunk(b"IEND", b""), "png", source)
    if pixels.shape != (height, width, channels):
        raise source.wrong(f"its pixels have the shape {pixels.shape}, its header says {(height, width, channels)}")
    return pixels


def write_png(
    path: str | os.PathLike[str], image: npt.ArrayLike, *, effort: int = 9, into: Transaction | None = None
) -> None:
    """Write a picture (height, width, 3 | 4) in sRGB as PNG.

    image: uint8, or sRGB floats from 0 to 1, which are clamped and rounded to the nearest of 255 steps. effort:
    compression level of zlib, 1 to 9. Raises `InputError` for NaN, and `FileError` where the file cannot be written.
    """
    array = np.asarray(image)
    if array.dtype != np.uint8:
        values = array.astype(np.float64)
        if count := int(np.isnan(values).sum()):
            raise InputError(f"{path}: {count} NaN in a picture, its values must be numbers from 0 to 1")
        array = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
    write_pieces(path, [encode_png(array, srgb=True, effort=effort)], into)


def decode_by_oiio(data: bytes, form: str, source: Source) -> Pixels:
    """Decode an image file to its stored pixels, uint8 (height, width, channels).

    The caller must have checked the size that the header states. Raises `InputError`, which names `source`.
    """
    import OpenImageIO as oiio

    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    with _scratch_file(f".{form}") as path:
        path.write_bytes(data)
        reader = oiio.ImageInput.open(str(path), hints)
        complaint = _complaint(oiio)
        pixels = None
        if reader is not None and reader.format_name() == form:
            pixels = reader.read_image("uint8")
            failed = reader.has_error
            complaint = _complaint(reader) or complaint
            reader.close()
            pixels = None if failed else pixels  # missing parts of a JPEG are filled and only set an error message
    if pixels is None:
        reason = " ".join((complaint.replace(str(path), "it") or "no reason given").split())[:120]
        raise source.wrong(f"OpenImageIO cannot decode it as {form} ({reason})")
    return np.ascontiguousarray(pixels, np.uint8)


@contextlib.contextmanager
def _scratch_file(suffix: str) -> Iterator[Path]:
    """Give the path of a temporary file: OpenImageIO's Python binding reads and writes files alone.

    The file is closed while OpenImageIO uses it, as Windows requires.
    """
    try:
        handle, name = tempfile.mkstemp(suffix=suffix)
        os.close(handle)
    except OSError as error:
        raise FileError(f"cannot make a temporary file for OpenImageIO: {error.strerror or error}") from error
    try:
        yield Path(name)
    except OSError as error:
        raise FileError(f"cannot use the temporary file {name}: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            os.unlink(name)


def _checked(source: Source, side: int | None) -> tuple[int, int, int, bytes]:
    """Check everything in a PNG except the pixel values; return width, height, channels and the deflated rows."""
    if source.piece(0, 8, "the signature of a PNG") != SIGNATURE:
        raise source.wrong("it does not begin with the signature of a PNG")
    size: tuple[int, int, int] | None = None
    packed: list[memoryview] = []
    for kind, body in _chunks(source):
        if size is None:
            if kind != b"IHDR" or len(body) != _HEADER.size:
                raise source.wrong("its first chunk is not the header of a PNG")
            size = _size(source, body, side)
        elif kind == b"IDAT":
            packed.append(body)
        elif kind == b"tRNS":
            raise source.wrong("it has a transparent colour (tRNS), only an alpha channel is read")
        elif kind not in (b"IEND", b"PLTE") and not kind[0] & 32:
            raise source.wrong(f"it needs the chunk {kind.decode('latin-1')!r}, which is not read")
    if size is None or not packed:
        raise source.wrong("it has no pixels")
    width, height, channels = size
    data = b"".join(packed)
    row = 1 + width * channels
    wanted = height * row
    if wanted > DEFLATE_RATIO * len(data):
        raise source.wrong(f"its header describes {width} x {height} pixels, {len(data)} bytes cannot hold so many")
    memory.require(2 * len(source) + wanted, f"its {width} x {height} pixels", source.name, len(source))
    rows = inflate(data, wanted, source, "its image data", needs="its header needs", rest=True)
    if max(rows[::row]) > 4:
        raise source.wrong("a row has a filter that PNG does not know")
    return width, height, channels, data


def _size(source: Source, body: memoryview, side: int | None) -> tuple[int, int, int]:
    width, height, depth, colour, method, filters, interlace = _HEADER.unpack(body)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise source.wrong(f"its header says {width} x {height} pixels, 1 to {MAX_SIDE} a side are read")
    if side is not None and (width, height) != (side, side):
        raise source.wrong(f"it has {width} x {height} pixels, {side} x {side} were expected")
    if depth != 8 or colour not in (_RGB, _RGBA) or interlace or method or filters:
        raise source.wrong(
            f"it is a PNG of {depth} bits, colour type {colour}{', interlaced' if interlace else ''}; "
            f"8 bits of RGB (2) or RGBA (6), not interlaced, are read"
        )
    return width, height, 4 if colour == _RGBA else 3


def _chunks(source: Source) -> Iterator[tuple[bytes, memoryview]]:
    """Yield the kind and the body of each chunk up to the end marker, and verify the checksums."""
    at = len(SIGNATURE)
    while True:
        length, kind = struct.unpack(">I4s", source.piece(at, 8, f"the PNG chunk at byte {at}"))
        body = source.piece(at + 8, length, f"the PNG chunk at byte {at}")
        (stated,) = struct.unpack(">I", source.piece(at + 8 + length, 4, f"the checksum of the PNG chunk at byte {at}"))
        if zlib.crc32(body, zlib.crc32(kind)) != stated:
            raise source.wrong(f"the PNG chunk at byte {at} does not match its checksum")
        yield kind, body
        if kind == b"IEND":
            return
        at += 12 + length


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(body, zlib.crc32(kind)))


def _complaint(source: Any) -> str:
    """Fetch and clear the last error message of OpenImageIO or of one of its objects."""
    try:
        return str(source.geterror())
    except UnicodeError:  # the message quotes bytes of the file
        return ""
