"""Writes float32 OpenEXR files, and reads each back to verify it before it gets its name."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import FileError
from whitefurnace.files.atomic import Transaction, write_atomic
from whitefurnace.files.inputs import library_name

ROWS_AT_ONCE = 1 << 24
"""Bytes of pixel rows passed to OpenImageIO in one call."""


def write_exr(
    path: str | os.PathLike[str],
    pixels: npt.NDArray[np.float32],
    *,
    channel_names: Sequence[str] = ("R", "G", "B"),
    attributes: Mapping[str, str | float | int] | None = None,
    into: Transaction | None = None,
) -> None:
    """Write `pixels` (height, width, channels) as 32-bit floats, ZIP compressed.

    Half floats would silently turn values over 65504 into inf. The same input gives the same bytes: no time is stored.
    The file is read back and compared bit for bit before it is renamed.
    channel_names: one name for each channel. attributes: header attributes by name.
    Raises `FileError` where the file cannot be written, for example on a full disk.
    """
    path = Path(path)
    pixels = np.ascontiguousarray(pixels, np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != len(channel_names):
        raise ValueError(f"pixels of shape {pixels.shape} do not have one channel a name of {tuple(channel_names)}")

    def write(temporary: Path) -> None:
        # Open the file here first: OpenImageIO does not pass on the system's reason for a failure.
        with open(temporary, "wb"):
            pass
        try:
            with library_name(temporary) as name:
                complaint = _write(Path(name), pixels, channel_names, attributes or {})
                if complaint is None and not _holds(Path(name), pixels):
                    complaint = "what was written does not read back, the disk may be full"
        except UnicodeError as error:
            raise FileError(f"cannot write {path}: an attribute is not valid Unicode") from error
        if complaint is not None:
            raise FileError(f"cannot write {path}: {complaint}")

    write_atomic(path, write, into)


def _write(
    path: Path,
    pixels: npt.NDArray[np.float32],
    names: Sequence[str],
    attributes: Mapping[str, str | float | int],
) -> str | None:
    """Write the file with OpenImageIO; return None, or the reason of a failure.

    The output object is deleted before the return, because only its destructor completes some files.
    """
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, "float")
    spec.channelnames = tuple(names)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # an empty one is not written; without it OpenImageIO writes the current time
    for name, value in attributes.items():
        spec.attribute(name, value)
    # Named by format, because the temporary file has another suffix.
    output = oiio.ImageOutput.create("openexr")
    if output is None:
        return _first_line(oiio.geterror())
    done = output.open(str(path), spec)
    # Multiples of ZIP's 16 rows: writing all rows at once takes several times the image's memory.
    step = 16 * max(ROWS_AT_ONCE // (64 * width * channels), 1)
    for y in range(0, height, step):
        done = done and output.write_scanlines(y, min(y + step, height), 0, pixels[y : y + step])
    complaint = output.geterror()
    closed = output.close()
    complaint = complaint or output.geterror()
    del output
    complaint = complaint or oiio.geterror()
    return None if done and closed and not complaint else _first_line(complaint)


def _holds(path: Path, pixels: npt.NDArray[np.float32]) -> bool:
    """Return whether the file reads back as exactly these bits."""
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(str(path))
    if source is None:
        oiio.geterror()
        return False
    height, width, channels = pixels.shape
    try:
        if (source.spec().height, source.spec().width, source.spec().nchannels) != pixels.shape:
            return False
        step = max(ROWS_AT_ONCE // (4 * width * channels), 1)
        for y in range(0, height, step):
            end = min(y + step, height)
            back = source.read_scanlines(y, end, 0, 0, channels, "float")
            if back is None or source.has_error:
                return False
            back = np.ascontiguousarray(back, np.float32)
            if not np.array_equal(back.view(np.uint32).ravel(), pixels[y:end].view(np.uint32).ravel()):
                return False
        return True
    finally:
        source.geterror()
        source.close()


def _first_line(complaint: str) -> str:
    lines = complaint.strip().splitlines()
    return " ".join(lines[0].split())[:160].rstrip(".") if lines else "OpenImageIO gave no reason, the disk may be full"
