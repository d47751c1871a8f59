"""Reads the header of Radiance .hdr files, and brings every orientation into one that OpenImageIO reads.

The variables are those of Radiance's file formats [Ward, "Radiance File Formats"]; GAMMA is from Bruce Walter's
rgbe.c. Pixels are values times the product of all EXPOSURE and COLORCORR, after which GAMMA was applied.
"""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError
from whitefurnace.files.colour import LINEAR, Curve, Encoding, from_primaries
from whitefurnace.files.inputs import open_input
from whitefurnace.files.memory import require

_HEADER_BYTES = 1 << 20
_RESOLUTION = re.compile(rb"([+-])([XY]) +(\d{1,9}) +([+-])([XY]) +(\d{1,9})\s*")
_RGBE, _XYZE = b"32-bit_rle_rgbe", b"32-bit_rle_xyze"


@dataclass(frozen=True)
class Radiance:
    """The header of a Radiance picture.

    width, height  pixels of the upright picture
    encoding       conversion of its values; None where the header changes no value
    notices        sentences about the statements of the header
    start          offset of the pixels; `lines` and `length`: the number of scanlines, and of texels in each
    order          the resolution string, such as "-Y 64 +X 128"
    aspect         width of a pixel over its height
    plain          True if rows run from the top and from the left, and lines end as on Unix
    """

    width: int
    height: int
    encoding: Encoding | None
    notices: tuple[str, ...]
    start: int
    lines: int
    length: int
    order: str
    plain: bool
    aspect: float

    def rewrite(self, path: Path, copy: Path, flat: bytes | None) -> None:
        """Write the pixels of `path`, or these flat ones, with a header in which scanlines are rows from the top."""
        with open_input(path) as whole, open(copy, "wb") as out:
            out.write(b"#?RADIANCE\nFORMAT=%s\n\n-Y %d +X %d\n" % (_RGBE, self.lines, self.length))
            if flat is not None:
                out.write(flat)
                return
            whole.seek(self.start)
            shutil.copyfileobj(whole, out)

    def unpacked(self, path: Path) -> bytes | None:
        """Return flat texels of a file in the old run-length code, which OpenImageIO does not read; else None.

        A texel 1 1 1 n repeats the one before it n times; of several in a row each counts 256 times the one before.
        Raises `InputError` where the number of texels is not that of the header.
        """
        size, total = path.stat().st_size - self.start, self.lines * self.length
        if size == 4 * total:
            return None
        with open_input(path) as file:
            file.seek(self.start)
            if file.read(4) == bytes((2, 2, self.length >> 8 & 255, self.length & 255)) or size < 8:
                return None
            file.seek(self.start)
            require(30 * size, f"{size // 4} texels in the old run-length code", path)
            texels = np.frombuffer(file.read(size - size % 4), np.uint8).reshape(-1, 4)
        marks = np.all(texels[:, :3] == 1, axis=1)
        if not marks.any():
            return None
        index = np.arange(len(texels))
        last = np.maximum.accumulate(np.where(marks, -1, index))  # the texel that each repeats
        counts = np.ones(len(texels), np.int64)
        counts[marks] = texels[marks, 3].astype(np.int64) << np.minimum(8 * (index - last - 1)[marks], 32)
        if last[0] < 0 or int(counts.sum()) != total:
            raise InputError(
                f"{path} is truncated or corrupted: its run-length code holds {int(counts.sum())} texels, {total} were "
                "expected"
            )
        require(4 * total + 20 * len(texels), f"its {self.length} x {self.lines} pixels", path)
        return np.repeat(texels[last], counts, axis=0).tobytes()

    def upright(self, scans: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Turn scanlines (lines, length, channels) into rows from the top."""
        major, minor = self.order.split()[0], self.order.split()[2]
        if major[1] == "X":
            scans = scans.swapaxes(0, 1)
            major, minor = minor, major
        return np.ascontiguousarray(scans[:: 1 if major == "-Y" else -1, :: 1 if minor == "+X" else -1])


def read_radiance_header(path: Path) -> Radiance:
    """Read the header of a Radiance picture. Raises `InputError` for one that is malformed or of a kind not read."""
    with open_input(path) as file:
        head = file.read(_HEADER_BYTES)
    end = re.search(rb"\r?\n\r?\n", head)
    if end is None:
        raise InputError(f"{path} is truncated or corrupted: its Radiance header has no end")
    lines = [line.rstrip(b"\r") for line in head[: end.start()].split(b"\n")]
    stop = head.find(b"\n", end.end(), end.end() + 100)
    found = _RESOLUTION.fullmatch(head[end.end() : stop]) if stop >= 0 else None
    if found is None or found[2] == found[5] or min(int(found[3]), int(found[6])) < 1:
        shown = _shown(head[end.end() : end.end() + 40].split(b"\n")[0])
        raise InputError(f"{path} is corrupted: its resolution is {shown}, one such as '-Y 512 +X 1024' was expected")
    _check_format(lines, path)
    encoding, notices = _encoding(lines, path)
    first, second = int(found[3]), int(found[6])
    width, height = (first, second) if found[2] == b"X" else (second, first)
    order = f"{found[1].decode()}{found[2].decode()} {first} {found[4].decode()}{found[5].decode()} {second}"
    plain = order == f"-Y {first} +X {second}" and b"\r" not in head[: stop + 1]
    return Radiance(width, height, encoding, notices, stop + 1, first, second, order, plain, _aspect(lines, path))


def _check_format(lines: list[bytes], path: Path) -> None:
    formats = {line[7:].strip() for line in lines if line.startswith(b"FORMAT=")}
    if _XYZE in formats:
        raise InputError(
            f"{path} is of the format XYZE (32-bit_rle_xyze), which is not read; RGBE was expected, as Radiance's "
            "`ra_xyze -r` writes it"
        )
    if formats != {_RGBE}:
        said = " and ".join(_shown(form) for form in sorted(formats)) or "no line FORMAT="
        raise InputError(f"{path} has {said}, FORMAT=32-bit_rle_rgbe was expected in the header of a Radiance picture")


def _encoding(lines: list[bytes], path: Path) -> tuple[Encoding | None, tuple[str, ...]]:
    """Multiply up the cumulative variables. Lines that begin with a blank tell of other pictures."""
    exposure = gamma = 1.0
    correction = np.ones(3)
    primaries: tuple[float, ...] | None = None
    for line in lines:
        name, _, value = line.partition(b"=")
        if name == b"EXPOSURE":
            exposure *= _numbers(value, 1, "EXPOSURE", path)[0]
        elif name == b"COLORCORR":
            correction = correction * _numbers(value, 3, "COLORCORR", path)
        elif name == b"GAMMA":
            gamma *= _numbers(value, 1, "GAMMA", path)[0]
        elif name == b"PRIMARIES":
            primaries = _numbers(value, 8, "PRIMARIES", path)
    scale = exposure * correction
    # Beyond these no pixel stays between 0 and infinity in float32; real exposures are within 1e±6.
    if not (np.all((scale >= 1e-30) & (scale <= 1e30)) and 0.01 <= gamma <= 100):
        raise InputError(
            f"{path} states a product of EXPOSURE and COLORCORR that is outside [1e-30, 1e30] or of GAMMA outside "
            "[0.01, 100]"
        )
    notices = []
    if exposure != 1:
        notices.append(f"{path}: divided by its EXPOSURE of {exposure:g} in all")
    if np.any(correction != 1):
        notices.append(f"{path}: divided by its COLORCORR of {' '.join(f'{c:g}' for c in correction)} in all")
    if gamma != 1:
        notices.append(f"{path}: decoded by its GAMMA of {gamma:g}")
    matrix = None
    if primaries is not None:
        shown = " ".join(f"{value:g}" for value in primaries)
        try:
            matrix = from_primaries(primaries)
        except ValueError:
            raise InputError(f"{path} states primaries ({shown}) that span no colour space") from None
        if matrix is not None:
            notices.append(f"{path}: converted to linear Rec.709 from the primaries it states ({shown})")
    if not notices:
        return None, ()
    linear = gamma == 1 and bool(np.all(scale == 1))
    curves = (LINEAR,) if linear else tuple(_scaled(gamma, float(factor)) for factor in scale)
    return Encoding(curves, "", matrix), tuple(notices)


def _aspect(lines: list[bytes], path: Path) -> float:
    """Return the width of a pixel over its height by all lines PIXASPECT, which state the inverse; 1 if within 1 %."""
    product = 1.0
    for line in lines:
        if line.startswith(b"PIXASPECT="):
            product *= _numbers(line[10:], 1, "PIXASPECT", path)[0]
    if not 1e-6 < product < 1e6:
        raise InputError(f"{path} states a pixel aspect ratio of {product:g} (PIXASPECT), which is out of range")
    return 1.0 if 0.99 < product < 1.01 else 1 / product


def _scaled(gamma: float, scale: float) -> Curve:
    if gamma == 1:
        return Curve("a factor", lambda x: x / scale)
    return Curve("a power", lambda x: np.copysign(np.abs(x) ** gamma, x) / scale)


def _numbers(text: bytes, count: int, name: str, path: Path) -> tuple[float, ...]:
    """Parse `count` numbers; those of all variables but PRIMARIES must be over 0."""
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)) or (name != "PRIMARIES" and min(values) <= 0):
        wanted = "a number over 0 was" if count == 1 else f"{count} numbers{' over 0' if count == 3 else ''} were"
        raise InputError(f"{path} states {name}={_shown(text)}, {wanted} expected")
    return values


def _shown(text: bytes) -> str:
    return repr("".join(chr(c) if 32 <= c < 127 else "?" for c in text[:40]))
