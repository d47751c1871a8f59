"""Reads ICC profiles of the matrix/TRC and the grey kind as an `Encoding` [ICC.1:2022].

Profiles with lookup tables and those of other colour spaces than RGB and grey are refused by name.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from whitefurnace.errors import InputError
from whitefurnace.files.colour import (
    D50,
    LINEAR,
    SRGB_CURVE,
    Curve,
    Encoding,
    from_code_points,
    matrix_to_rec709,
    power,
)

MAX_BYTES = 16 << 20
"""Largest profile that is read, inflated; those of printers with tables have a few megabytes."""

_CLASSES = (b"mntr", b"scnr", b"prtr", b"spac")
_TABLES = (b"A2B0", b"A2B1", b"A2B2", b"D2B0", b"D2B1", b"D2B2", b"D2B3")
_MAX_TAGS = 1024
# Parametric curves by type: number of parameters [ICC.1:2022, 10.18].
_PARAMETERS = (1, 3, 4, 5, 7)


def read_icc(data: bytes, path: Path, where: str, channels: int) -> Encoding:
    """Return the encoding that the profile `data` states.

    where: names what holds the profile, such as "its iCCP chunk". channels: those of the image; 1 is grey. Raises
    `InputError` for a profile that is damaged, or of a kind that is not read.
    """
    profile = _Profile(data, path, where)
    space = profile.data[16:20]
    if space not in (b"RGB ", b"GRAY"):
        raise InputError(
            f"{path}: {where} holds an ICC profile of the colour space {_text(space)}, "
            "those of RGB and GRAY are read; convert the image to sRGB or linear RGB"
        )
    if "cicp" in profile.names():
        points = profile.tag(b"cicp")
        if points[:4] != b"cicp" or len(points) < 12:
            raise profile.wrong("its tag cicp is malformed")
        return from_code_points(points[8:12], f"the cicp tag of the ICC profile in {where}", path)
    tables = [_text(name) for name in _TABLES if name in profile.tags]
    if tables:
        raise InputError(
            f"{path}: {where} holds an ICC profile with lookup tables ({', '.join(tables)}), profiles with a matrix "
            "and curves are read; convert the image to sRGB or linear RGB"
        )
    said = f"{where}, an ICC profile" + (f" ({name!r})" if (name := profile.description()) else "")
    if space == b"GRAY":
        if channels >= 3:
            raise InputError(f"{path}: {where} holds a grey ICC profile, but the image has {channels} channels")
        curve = profile.curve(b"kTRC")
        if profile.data[20:24] == b"Lab ":
            curve = _over_lightness(curve)
        elif profile.data[20:24] != b"XYZ ":
            raise profile.wrong(f"its connection space is {_text(profile.data[20:24])}, XYZ or Lab was expected")
        return _snapped((curve,), None, said)
    if profile.data[20:24] != b"XYZ ":
        raise profile.wrong(f"its connection space is {_text(profile.data[20:24])}, XYZ was expected with a matrix")
    colorants = np.stack([profile.xyz(name) for name in (b"rXYZ", b"gXYZ", b"bXYZ")], axis=1)
    try:
        matrix = matrix_to_rec709(colorants, D50)
    except ValueError:
        raise profile.wrong("its colorants span no colour space") from None
    return _snapped(tuple(profile.curve(name) for name in (b"rTRC", b"gTRC", b"bTRC")), matrix, said)


def _over_lightness(curve: Curve) -> Curve:
    """Return the curve of light for one whose values are CIE lightness, L*/100 [ISO/CIE 11664-4, inverted]."""

    def decode(x: np.ndarray) -> np.ndarray:
        f = (100 * curve.decode(x) + 16) / 116
        return np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29))

    return Curve(f"{curve.name} of lightness", decode, curve.bounded)


def _snapped(curves: tuple[Curve, ...], matrix: np.ndarray | None, said: str) -> Encoding:
    """Put the exact curve in the place of one that is it but for rounding, and one curve in the place of three."""
    for exact in (SRGB_CURVE, LINEAR):
        if all(curve is exact or curve.near(exact) for curve in curves):
            curves = (exact,)
    return Encoding(curves, said, matrix)


class _Profile:
    """The tags of a profile. Every access is checked against its size."""

    def __init__(self, data: bytes, path: Path, where: str) -> None:
        self.data, self.path, self.where = data, path, where
        if len(data) < 132 or data[36:40] != b"acsp":
            raise self.wrong("it does not begin with the header of a profile")
        (size,) = struct.unpack_from(">I", data)
        if not 132 <= size <= len(data):
            raise self.wrong(f"it states {size} bytes, {len(data)} are there")
        self.data = data = data[:size]
        if data[8] not in (2, 4):
            raise InputError(f"{path}: {where} holds an ICC profile of version {data[8]}, versions 2 and 4 are read")
        if data[12:16] not in _CLASSES:
            raise InputError(
                f"{path}: {where} holds an ICC profile of the class {_text(data[12:16])}, "
                f"those of {', '.join(_text(c) for c in _CLASSES)} are read"
            )
        (count,) = struct.unpack_from(">I", data, 128)
        if count > _MAX_TAGS or 132 + 12 * count > size:
            raise self.wrong(f"it states {count} tags, {size} bytes cannot hold so many")
        self.tags: Mapping[bytes, tuple[int, int]] = {
            name: (at, length) for name, at, length in struct.iter_unpack(">4sII", data[132 : 132 + 12 * count])
        }

    def wrong(self, what: str) -> InputError:
        return InputError(f"{self.path}: {self.where} holds an ICC profile that is not valid: {what}")

    def names(self) -> set[str]:
        return {name.decode("latin-1") for name in self.tags}

    def tag(self, name: bytes) -> bytes:
        if name not in self.tags:
            raise self.wrong(f"it has neither lookup tables nor the tag {_text(name)}")
        at, length = self.tags[name]
        if at < 128 or length < 8 or at + length > len(self.data):
            raise self.wrong(f"its tag {_text(name)} takes bytes {at} to {at + length} of {len(self.data)}")
        return self.data[at : at + length]

    def xyz(self, name: bytes) -> np.ndarray:
        data = self.tag(name)
        if data[:4] != b"XYZ " or len(data) < 20:
            raise self.wrong(f"its tag {_text(name)} is not of type XYZ")
        return np.array(struct.unpack_from(">3i", data, 8)) / 65536

    def curve(self, name: bytes) -> Curve:
        """Return a tone reproduction curve, of type curv or para."""
        data = self.tag(name)
        if data[:4] == b"curv" and len(data) >= 12:
            (count,) = struct.unpack_from(">I", data, 8)
            if 12 + 2 * count > len(data):
                raise self.wrong(f"its curve {_text(name)} states {count} values, its tag cannot hold so many")
            if count == 0:
                return LINEAR
            values = np.frombuffer(data, ">u2", count, 12).astype(np.float64)
            if count == 1:
                if values[0] == 0:
                    raise self.wrong(f"its curve {_text(name)} is a power of 0")
                return power(values[0] / 256)
            values /= 65535
            grid = np.linspace(0, 1, count)
            return Curve("a table", lambda x: np.interp(x, grid, values), bounded=True)
        if data[:4] == b"para" and len(data) >= 16:
            (kind,) = struct.unpack_from(">H", data, 8)
            if kind >= len(_PARAMETERS) or 12 + 4 * _PARAMETERS[kind] > len(data):
                raise self.wrong(f"its curve {_text(name)} is of the parametric type {kind}, 0 to 4 are known")
            values = np.array(struct.unpack_from(f">{_PARAMETERS[kind]}i", data, 12)) / 65536
            return self._parametric(name, kind, values)
        raise self.wrong(f"its curve {_text(name)} is of type {_text(data[:4])}, curv or para was expected")

    def _parametric(self, name: bytes, kind: int, values: np.ndarray) -> Curve:
        # Every type is (a x + b)^g + e from d up, and c x + f below it [ICC.1:2022, table 68].
        g, a, b, c, d, e, f = (float(values[0]), 1.0, 0.0, 0.0, -np.inf, 0.0, 0.0)
        if kind:
            a, b = float(values[1]), float(values[2])
            d = -b / a if a else np.inf
        if kind == 2:
            e = f = float(values[3])
        if kind >= 3:
            c, d = float(values[3]), float(values[4])
        if kind == 4:
            e, f = float(values[5]), float(values[6])
        if not (g > 0 and a > 0):
            raise self.wrong(
                f"its curve {_text(name)} has the exponent {g:g} and the factor {a:g}, not both are over 0"
            )
        if kind == 0:
            return power(g)

        def decode(x: np.ndarray) -> np.ndarray:
            y = np.where(x >= d, np.maximum(a * x + b, 0) ** g + e, c * x + f)
            return np.where(x >= 0, np.maximum(y, 0), y)

        return Curve("a parametric curve", decode)

    def description(self) -> str:
        """Return the profile's name in printable ASCII, empty where it has none that can be read."""
        at, length = self.tags.get(b"desc", (0, 0))
        data = self.data[at : at + length]
        text = ""
        if data[:4] == b"desc" and len(data) >= 12:
            (count,) = struct.unpack_from(">I", data, 8)
            text = data[12 : 12 + min(count, 200)].decode("latin-1")
        elif data[:4] == b"mluc" and len(data) >= 28:
            length, at = struct.unpack_from(">II", data, 20)
            text = data[at : at + min(length, 200)].decode("utf-16-be", "ignore")
        return " ".join("".join(c for c in text if c.isascii() and c.isprintable()).split())[:60]


def _text(four: bytes) -> str:
    return "".join(chr(c) if 32 < c < 127 else "?" for c in four.rstrip())
