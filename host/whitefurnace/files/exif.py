"""Reads what Exif says about colour: the colour space, Adobe RGB by DCF, a gamma, white and primaries."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from whitefurnace.errors import InputError
from whitefurnace.files.colour import SRGB_CURVE, Curve, Encoding, from_primaries, power
from whitefurnace.files.tiff_tags import PRIMARIES, WHITE, Values, chromaticities, directories, directory

_EXIF, _INTEROPERABILITY, _INDEX, _SPACE, _GAMMA = 34665, 40965, 1, 40961, 42240
_SRGB, _ADOBE = 1, 2  # of the tag ColorSpace; 2 is not in the standard, and written for Adobe RGB
# Adobe RGB (1998) Color Image Encoding, 4.3.1: the exponent 563/256 and the primaries.
_ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
_ADOBE_EXPONENT = 563 / 256


def read_exif(data: bytes | mmap.mmap, path: Path, default: Curve = SRGB_CURVE) -> Encoding | None:
    """Return the encoding that Exif states; None where it is sRGB, states none or cannot be read.

    data: a TIFF, or the block of another file, which has the same form. default: the curve where Exif states no gamma.
    Raises `InputError` for a gamma or primaries
    that are not valid.
    """
    try:
        first = next(directories(data, (_EXIF, WHITE, PRIMARIES)))
        tags = _below(data, first, _EXIF, (_INTEROPERABILITY, _SPACE, _GAMMA))
        index = _below(data, tags, _INTEROPERABILITY, (_INDEX,)).get(_INDEX, b"")
        space = int(tags[_SPACE][0]) if _SPACE in tags else 0
        gamma = float(tags[_GAMMA][0]) if _GAMMA in tags else 0.0
    except (struct.error, LookupError, TypeError, ValueError, OverflowError, StopIteration):
        return None
    if space == _SRGB:
        return None
    if space == _ADOBE or (isinstance(index, bytes) and index.startswith(b"R03")):  # DCF 2.0, 5.2
        return Encoding((power(_ADOBE_EXPONENT),), "its Exif (Adobe RGB)", from_primaries(_ADOBE_RGB))
    said = []
    curve = default
    if gamma:
        if not 0.1 <= gamma <= 10:
            raise InputError(f"{path} states a gamma of {gamma:g} (Exif), .1 to 10 are read")
        curve = power(gamma)
        said.append(f"gamma {gamma:g}")
    matrix = None
    if WHITE in first or PRIMARIES in first:
        matrix, shown = chromaticities(first, path)
        said.append(f"primaries {shown}")
    return Encoding((curve,), f"its Exif ({', '.join(said)})", matrix) if said else None


def _below(
    data: bytes | mmap.mmap, tags: dict[int, Values], pointer: int, wanted: tuple[int, ...]
) -> dict[int, Values]:
    """Return the tags of the directory that a tag points to; none where the tag is missing."""
    return directory(data, int(tags[pointer][0]), wanted)[0] if pointer in tags else {}
