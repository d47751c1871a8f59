"""Reads what the first image of a TIFF states about its colour and its samples."""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError
from whitefurnace.files.colour import LINEAR, SRGB_CURVE, Curve, Encoding
from whitefurnace.files.exif import read_exif
from whitefurnace.files.icc import MAX_BYTES, read_icc
from whitefurnace.files.inputs import open_input
from whitefurnace.files.tiff_tags import PRIMARIES, WHITE, Values, chromaticities, directories

_SUBFILE, _OLD_SUBFILE, _BITS, _PHOTOMETRIC, _COLOR_MAP = 254, 255, 258, 262, 320
_READ_PHOTOMETRIC = {0: "MinIsWhite", 1: "MinIsBlack", 2: "RGB", 3: "palette", 6: "YCbCr"}
_OTHER_PHOTOMETRIC = {
    4: "a transparency mask",
    5: "CMYK or other inks",
    8: "CIE L*a*b*",
    9: "ICC L*a*b*",
    10: "ITU L*a*b*",
    32803: "a colour filter array",
    32844: "LogL",
    32845: "LogLuv",
    34892: "linear raw",
}


@dataclass(frozen=True)
class Tiff:
    """The statements of the first image of a TIFF.

    encoding    conversion of its values to radiance; None where it states none
    associated  True if colour is multiplied by alpha
    inverted    True if the largest code is black and OpenImageIO does not invert it; it does for up to 8 bits
    """

    encoding: Encoding | None
    associated: bool
    inverted: bool


_WANTED = {_SUBFILE, _OLD_SUBFILE, _BITS, _PHOTOMETRIC, _COLOR_MAP, WHITE, PRIMARIES} | {
    *(290, 291, 301, 338, 339, 532, 34675)
}


def read_tiff(path: Path) -> Tiff:
    """Return the statements of the first image of a TIFF. Raises `InputError` for a kind that is not supported."""
    with open_input(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            # Of later pages only a few numbers are kept: many could state the same megabytes.
            pages = list(directories(data, (_SUBFILE, _OLD_SUBFILE), 16))
            first = next(directories(data, _WANTED)) if pages else {}
        except (struct.error, LookupError, ValueError, OverflowError) as error:
            said = f" ({error})" if isinstance(error, ValueError) else ""
            raise InputError(f"{path} is truncated or corrupted: its TIFF directories cannot be read{said}") from None
        if not pages:
            raise InputError(f"{path} is a TIFF without an image")
        _check_pages(pages, path)
        _check_samples(first, path)
        encoding = _encoding(first, data, path)
    inverted = _whole(first, _PHOTOMETRIC, -1) == 0 and _whole(first, _BITS, 1) > 8
    return Tiff(encoding, _whole(first, 338, 0) == 1, inverted)


def _whole(tags: dict[int, Values], tag: int, default: int) -> int:
    values = tags.get(tag, ())
    return int(values[0]) if values and values[0] == values[0] else default


def _check_pages(pages: list[dict[int, Values]], path: Path) -> None:
    """Refuse a first page that is a thumbnail or a mask, and several pages of which none is told apart."""
    kinds = [_whole(page, _SUBFILE, 0) | (_whole(page, _OLD_SUBFILE, 1) == 2) for page in pages]
    if kinds[0] & 5:
        what = "a transparency mask" if kinds[0] & 4 else "a copy of reduced size"
        raise InputError(f"{path} has {what} as the first of its {len(pages)} images, an image was expected there")
    whole = sum(not kind & 5 for kind in kinds)
    if whole > 1:
        raise InputError(f"{path} holds {whole} images of full size, one was expected; save the one that is meant")


def _check_samples(tags: dict[int, Values], path: Path) -> None:
    photometric = _whole(tags, _PHOTOMETRIC, -1)
    if photometric not in _READ_PHOTOMETRIC:
        name = _OTHER_PHOTOMETRIC.get(photometric, "an unknown kind")
        known = ", ".join(_READ_PHOTOMETRIC.values())
        stated = f"the photometric interpretation {photometric} ({name})" if photometric >= 0 else "no interpretation"
        raise InputError(f"{path} states {stated}, {known} are read; convert it to RGB")
    bits, formats = set(tags.get(_BITS, (1,))), set(tags.get(339, (1,)))
    if len(bits) > 1 or len(formats) > 1:
        raise InputError(f"{path} has channels of several depths or kinds, one for all was expected")
    form, depth = int(formats.pop()), int(bits.pop())
    if form not in (1, 3):
        kinds = {2: "signed integers", 4: "undefined data", 5: "complex integers", 6: "complex floats"}
        kind = kinds.get(form, "unknown")
        raise InputError(f"{path} states SampleFormat {form} ({kind}), unsigned integers (1) and floats (3) are read")
    if depth not in ((16, 32, 64) if form == 3 else (1, 2, 4, 8, 10, 12, 14, 16)):
        raise InputError(
            f"{path} has {'floats' if form == 3 else 'integers'} of {depth} bits; floats of 16, 32 and 64 and unsigned "
            "integers of 1 to 16 bits are read"
        )
    if form == 3 and photometric == 0:
        raise InputError(f"{path} holds floats and states that the least is white, the least as black was expected")
    # OpenImageIO cuts the colours to 8 bits, so that other ones become darker by up to a code.
    if photometric == 3 and any(value % 257 for value in tags.get(_COLOR_MAP, ())):
        raise InputError(f"{path} has a palette (ColorMap) of 16 bits, those of 8 are read; convert it to RGB")
    if 290 in tags or 291 in tags:
        raise InputError(f"{path} states a curve of optical densities (GrayResponseCurve), which is not read")
    if 532 in tags and photometric != 6:
        top = float((1 << depth) - 1)
        codes = tuple(float(value) for value in tags[532])
        if codes not in ((0.0, top) * 3, (0.0, top)):
            shown = " ".join(f"{value:g}" for value in codes[:6])
            raise InputError(
                f"{path} states black and white as the codes {shown} (ReferenceBlackWhite), 0 and {top:g} are"
            )


def _encoding(tags: dict[int, Values], file: mmap.mmap, path: Path) -> Encoding | None:
    """Return the encoding of an ICC profile, else of TransferFunction, of Exif or of the tags for primaries."""
    grey = _whole(tags, _PHOTOMETRIC, -1) in (0, 1)
    if 34675 in tags:
        data = tags[34675]
        if not isinstance(data, bytes):
            raise InputError(f"{path} is corrupted: its ICC profile (tag 34675) is not of bytes")
        if len(data) > MAX_BYTES:
            raise InputError(f"{path} holds an ICC profile of over {MAX_BYTES} bytes, which is not read")
        return read_icc(data, path, "its tag 34675", 1 if grey else 3)
    floats = _whole(tags, 339, 1) == 3
    default = LINEAR if floats else SRGB_CURVE
    if 301 not in tags and (encoding := read_exif(file, path, default)) is not None:
        return encoding
    said = ["TransferFunction"] if 301 in tags else []
    curves = _transfer(tags, path) if 301 in tags else (default,)
    matrix = None
    if WHITE in tags or PRIMARIES in tags:
        matrix, shown = chromaticities(tags, path)
        said.append(f"PrimaryChromaticities and WhitePoint ({shown})")
    return Encoding(curves, f"its TIFF tags {' and '.join(said)}", matrix) if said else None


def _transfer(tags: dict[int, Values], path: Path) -> tuple[Curve, ...]:
    """Return the curves of the tag TransferFunction: one or three tables of an entry for each code [TIFF 6.0, 20]."""
    depth = _whole(tags, _BITS, 1)
    count = 1 << depth if depth <= 16 else 0
    values: npt.NDArray[np.float64] = np.array(tags[301], np.float64)
    if not count or len(values) not in (count, 3 * count) or _whole(tags, _PHOTOMETRIC, -1) in (0, 3):
        raise InputError(
            f"{path} has a TransferFunction of {len(values)} entries, one or three tables of 2^{depth} were expected"
        )
    grid = np.linspace(0, 1, count)
    return tuple(_table(grid, table / 65535) for table in values.reshape(-1, count))


def _table(grid: npt.NDArray[np.float64], values: npt.NDArray[np.float64]) -> Curve:
    return Curve("a table", lambda x: np.interp(x, grid, values), bounded=True)
