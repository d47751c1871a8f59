"""Colour encodings of image files: transfer functions, primaries and their conversion to linear Rec.709.

An `Encoding` says how the stored values of an image become radiance. The transfer functions and primaries with numbers
are those of ITU-T H.273, which PNG, JPEG XL and AVIF name by code points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError

Array = npt.NDArray[np.float64]

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
D50 = (0.9642, 1.0, 0.8249)
"""The white of ICC's profile connection space, as XYZ [ICC.1:2022, 7.2.16]."""

_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# A curve or a matrix that differs by less from sRGB's is sRGB's, rounded: profiles keep four to five digits, their
# tables 1024 entries. The nearest other curve in use, a power of 2.2, differs from sRGB's by .008.
_CURVE_ROUNDING, _MATRIX_ROUNDING = 5e-4, 2e-3
_CHUNK_BYTES = 8 << 20
REFERENCE_WHITE = 203.0
"""Luminance of diffuse white in cd/m², which becomes 1.0 [ITU-R BT.2408-7, 2.2]."""


@dataclass(frozen=True)
class Curve:
    """A transfer function from encoded values to linear light, where 1 is reference white.

    name     name for messages
    decode   function of float64 arrays
    bounded  True if it is defined for encoded values from 0 to 1 only
    """

    name: str
    decode: Callable[[Array], Array]
    bounded: bool = False

    def near(self, other: Curve) -> bool:
        """Return whether the two curves agree on [0, 1] but for the rounding of a profile."""
        x = np.linspace(0, 1, 1025)
        return bool(np.max(np.abs(self.decode(x) - other.decode(x))) <= _CURVE_ROUNDING)


def power(exponent: float) -> Curve:
    """Return the curve x ↦ x^exponent; a negative x keeps its sign."""
    if exponent == 1:
        return LINEAR
    return Curve(f"a power of {exponent:.5g}", lambda x: np.copysign(np.abs(x) ** exponent, x))


def _srgb(x: Array) -> Array:
    # IEC 61966-2-1: a linear toe below 0.04045, a power of 2.4 above.
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0) + 0.055) / 1.055) ** 2.4)


def _rec709(x: Array) -> Array:
    alpha, beta = 1.09929682680944, 0.018053968510807  # H.273, 8.2
    return np.where(x < 4.5 * beta, x / 4.5, ((np.maximum(x, 0) + alpha - 1) / alpha) ** (1 / 0.45))


def _smpte240(x: Array) -> Array:
    alpha, beta = 1.111572195921731, 0.022821585529445
    return np.where(x < 4 * beta, x / 4, ((np.maximum(x, 0) + alpha - 1) / alpha) ** (1 / 0.45))


def _pq(x: Array) -> Array:
    # SMPTE ST 2084: 1 is 10 000 cd/m².
    m1, m2 = 2610 / 16384, 2523 / 32
    c1, c2, c3 = 3424 / 4096, 2413 / 128, 2392 / 128
    v = np.clip(x, 0, 1) ** (1 / m2)
    return (np.maximum(v - c1, 0) / (c2 - c3 * v)) ** (1 / m1) * (10000 / REFERENCE_WHITE)


def _hlg(x: Array) -> Array:
    # ITU-R BT.2100-2, table 5: the scene's light from 0 to 1. The display's follows from the three channels together.
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.5, x * x / 3, (np.exp((x - c) / a) + b) / 12)


LINEAR = Curve("linear", lambda x: x)
SRGB_CURVE = Curve("sRGB", _srgb)
_HLG = Curve("HLG", _hlg, bounded=True)
# By transfer characteristics of H.273, table 3.
_TRANSFERS = {
    **dict.fromkeys((1, 6, 14, 15), Curve("Rec.709", _rec709)),
    4: Curve("a power of 2.2", power(2.2).decode),
    5: Curve("a power of 2.8", power(2.8).decode),
    7: Curve("SMPTE 240M", _smpte240),
    8: LINEAR,
    13: SRGB_CURVE,
    16: Curve("PQ", _pq, bounded=True),
    18: _HLG,
}
_D65 = (0.3127, 0.3290)
# By colour primaries of H.273, table 2, as xy of red, green, blue and white.
_PRIMARIES = {
    1: ("Rec.709", REC709),
    4: ("BT.470 M", (0.67, 0.33, 0.21, 0.71, 0.14, 0.08, 0.310, 0.316)),
    5: ("BT.601 625", (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *_D65)),
    6: ("BT.601 525", (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65)),
    7: ("SMPTE 240M", (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65)),
    9: ("BT.2020", (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65)),
    11: ("DCI-P3", (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351)),
    12: ("Display P3", (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65)),
    22: ("EBU 3213", (0.630, 0.340, 0.295, 0.605, 0.155, 0.077, *_D65)),
}
# ITU-R BT.2100-2, table 5, note 5e: the system gamma of a display with a peak of 1000 cd/m².
_HLG_GAMMA, _HLG_PEAK = 1.2, 1000.0


@dataclass(frozen=True)
class Encoding:
    """The conversion of stored values to linear Rec.709: a curve for each channel, then a matrix.

    curves     one curve for all colour channels, or those of R, G and B
    matrix     (3, 3) from the linear channels to Rec.709; None for none
    luminance  weights of R, G and B in the luminance that drives HLG's OOTF; None for another encoding
    narrow     True if integers use the narrow ("video") range of codes
    said       name of the statement in the file, such as "its cICP chunk (BT.2020, PQ)"; empty for no notice
    """

    curves: tuple[Curve, ...]
    said: str
    matrix: Array | None = None
    luminance: Array | None = None
    narrow: bool = False

    def is_near(self, curve: Curve) -> bool:
        """Return whether the values are Rec.709 with this curve, but for rounding."""
        return self.matrix is None and not self.narrow and self.luminance is None and _all_near(self.curves, curve)

    def tables(self, dtype: npt.DTypeLike) -> tuple[npt.NDArray[np.float32], ...]:
        """Return the linear value of every code of uint8 or uint16, a table for each curve."""
        top = np.iinfo(np.dtype(dtype)).max
        codes = np.arange(top + 1, dtype=np.float64)
        if self.narrow:  # H.273, 8.3: black is code 16 and white 235 of 8 bits
            unit = (top + 1) / 256
            encoded = np.clip((codes - 16 * unit) / (219 * unit), 0, 1)
        else:
            encoded = codes / top
        with np.errstate(all="ignore"):
            return tuple(curve.decode(encoded).astype(np.float32) for curve in self.curves)

    def largest(self, dtype: npt.DTypeLike) -> float:
        """Return the value of the largest code of every channel; infinity where a pixel's channels are mixed."""
        mixed = self.matrix is not None or self.luminance is not None
        return np.inf if mixed else max(float(table.max()) for table in self.tables(dtype))

    def check_channels(self, channels: int, path: Path) -> None:
        """Raise `InputError` where a grey image would need a curve for each of R, G and B."""
        if channels == 1 and len(self.curves) > 1 and not all(c.near(self.curves[0]) for c in self.curves[1:]):
            raise InputError(f"{path} is grey, but {self.said} has different curves for red, green and blue")

    def linearize(self, pixels: npt.NDArray[np.float32], path: Path) -> None:
        """Apply the curves to floats (height, width, channels) in place.

        Raises `InputError` for values that a curve is not defined for.
        """
        for channel in range(min(pixels.shape[2], 3)):
            curve = self.curves[min(channel, len(self.curves) - 1)]
            if curve is LINEAR:
                continue
            for rows in _bands(pixels):
                values = rows[..., channel]
                if curve.bounded and not (values.min() >= 0 and values.max() <= 1):
                    raise InputError(
                        f"{path} holds floats out of [0, 1], for which {self.said} has no meaning ({curve.name})"
                    )
                with np.errstate(all="ignore"):
                    values[...] = curve.decode(values.astype(np.float64))

    def to_rec709(self, pixels: npt.NDArray[np.float32]) -> str:
        """Convert decoded `pixels` (height, width, 1 | 3 | 4) to Rec.709 in place.

        Colours outside the gamut of Rec.709 would be negative; those channels become 0, and the sentence that is
        returned says how many. It is empty where there are none.
        """
        colour = pixels.shape[2] >= 3
        if self.luminance is not None:
            for rows in _bands(pixels):
                light = rows[..., :3] if colour else rows
                weights = self.luminance.astype(np.float32) if colour else np.ones(1, np.float32)
                scale = (light @ weights) ** np.float32(_HLG_GAMMA - 1) * np.float32(_HLG_PEAK / REFERENCE_WHITE)
                light *= scale[..., None]
        if self.matrix is None or not colour:
            return ""
        transposed = self.matrix.T
        count, least, lost, total = 0, 0.0, 0.0, 0.0
        for rows in _bands(pixels):
            light = rows[..., :3]
            with np.errstate(all="ignore"):
                converted = light @ transposed
                if not np.isfinite(converted).all():
                    # An infinite channel would make all three of its pixel NaN: such pixels stay as they are.
                    endless = ~np.isfinite(light).all(axis=2)
                    converted[endless] = light[endless]
                # What the file itself states as negative is not a matter of the gamut.
                outside = (converted < 0) & (light.min(axis=2) >= 0)[..., None]
                if outside.any():
                    below = converted[outside]
                    count, least, lost = count + len(below), min(least, float(below.min())), lost - float(below.sum())
                    converted[outside] = 0
                total += float(converted.sum())
                light[...] = converted
        if not count:
            return ""
        share = 100 * lost / total if total > 0 else 0.0
        return (
            f"{count} values outside the gamut of Rec.709 became 0; the least was {least:.3g}, "
            f"all were {share:.2g} % of the energy"
        )


def _all_near(curves: Sequence[Curve], other: Curve) -> bool:
    return all(curve is other or curve.near(other) for curve in curves)


def _bands(pixels: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
    rows = max(1, _CHUNK_BYTES // (pixels.shape[1] * 24))
    return [pixels[y : y + rows] for y in range(0, len(pixels), rows)]


def rgb_to_xyz(primaries: Sequence[float]) -> Array:
    """Return the matrix from linear RGB to XYZ for the xy of red, green, blue and white; white has Y = 1.

    Raises `ValueError` for primaries that span no colour space.
    """
    xy = np.array(primaries, np.float64).reshape(4, 2)
    with np.errstate(all="ignore"):
        try:
            xyz = np.stack([xy[:, 0], xy[:, 1], 1 - xy.sum(1)]) / xy[:, 1]
            matrix: Array = xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])
        except np.linalg.LinAlgError:
            matrix = np.full((3, 3), np.nan)
    if not np.all(np.isfinite(matrix)):
        raise ValueError("the primaries span no colour space")
    return matrix


def matrix_to_rec709(to_xyz: Array, white: Sequence[float]) -> Array | None:
    """Return the matrix from linear RGB to linear Rec.709, with Bradford adaptation of the white to D65.

    to_xyz: the matrix from RGB to XYZ. white: XYZ of the white that becomes D65. Returns None for a matrix that is the
    identity but for rounding. Raises `ValueError` for a matrix that spans no colour space.
    """
    target = rgb_to_xyz(REC709)
    with np.errstate(all="ignore"):
        adapt = np.diag((_BRADFORD @ target.sum(1)) / (_BRADFORD @ np.asarray(white, np.float64)))
        matrix: Array = np.linalg.inv(target) @ np.linalg.inv(_BRADFORD) @ adapt @ _BRADFORD @ to_xyz
        # Real colour spaces stay below 4 and have a determinant over .1; values in the thousands mean that the
        # primaries lie on one line.
        if not np.all(np.abs(matrix) < 1e3) or abs(np.linalg.det(matrix)) < 1e-6:
            raise ValueError("the primaries span no colour space")
    return None if np.allclose(matrix, np.eye(3), rtol=0, atol=_MATRIX_ROUNDING) else matrix


def from_primaries(primaries: Sequence[float]) -> Array | None:
    """Return `matrix_to_rec709` for the xy of red, green, blue and white; raises `ValueError` as it does."""
    # 1e-3 allows for the rounding of the numbers in files (.3127 against .31271).
    if np.allclose(primaries, REC709, rtol=0, atol=1e-3):
        return None
    to_xyz = rgb_to_xyz(primaries)
    return matrix_to_rec709(to_xyz, to_xyz.sum(1))


def from_code_points(points: Sequence[int], where: str, path: Path) -> Encoding:
    """Return the encoding of four code points of H.273: primaries, transfer, matrix and full range.

    where: names what holds them, for messages. Raises `InputError` for code points that are not read.
    """
    primaries, transfer, coefficients, full = (int(point) for point in points)
    if coefficients != 0:
        raise InputError(f"{path}: {where} states the matrix coefficients {coefficients}, only 0 (RGB) is read")
    if full not in (0, 1):
        raise InputError(f"{path}: {where} states the range {full}, 0 (narrow) or 1 (full) was expected")
    if primaries not in _PRIMARIES:
        raise InputError(f"{path}: {where} states the colour primaries {primaries}; {_known(_PRIMARIES)} are read")
    if transfer not in _TRANSFERS:
        raise InputError(
            f"{path}: {where} states the transfer characteristics {transfer}; {_known(_TRANSFERS)} are read"
        )
    title, xy = _PRIMARIES[primaries]
    curve = _TRANSFERS[transfer]
    luminance = rgb_to_xyz(xy)[1] if curve is _HLG else None
    said = f"{where} ({title} primaries, {'' if full else 'narrow range, '}{curve.name})"
    return Encoding((curve,), said, from_primaries(xy), luminance, not full)


def _known(codes: dict[int, Any]) -> str:
    return ", ".join(map(str, sorted(codes)))
