"""Reads what an image file states about its colour, orientation and shape of pixels.

What is stated is applied by `image`, or refused here by name. OpenImageIO reads the pixels; it drops much of what
containers state, so the parts that bear on colour are read here.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from whitefurnace.errors import InputError
from whitefurnace.files.colour import (
    LINEAR,
    SRGB_CURVE,
    Curve,
    Encoding,
    from_code_points,
    from_primaries,
    power,
)
from whitefurnace.files.exif import read_exif
from whitefurnace.files.icc import MAX_BYTES, read_icc
from whitefurnace.files.inputs import open_input
from whitefurnace.files.tiff import read_tiff

# OpenImageIO's names of colour spaces with the primaries of Rec.709; "" and None stand for nothing stated.
_SPACES = {"srgb_rec709_scene": SRGB_CURVE, "sRGB": SRGB_CURVE, "lin_rec709_scene": LINEAR, "linear": LINEAR}


@dataclass(frozen=True)
class Declared:
    """The statements of a file about its values.

    encoding    conversion of its values to radiance; None where it states none
    associated  True if colour is multiplied by alpha
    inverted    True if the largest code is black and OpenImageIO does not invert it
    """

    encoding: Encoding | None = None
    associated: bool = False
    inverted: bool = False


def read_declared(path: Path, form: str, spec: Any, notices: list[str]) -> Declared:
    """Return the statements of the file at `path`.

    spec: OpenImageIO's description. form: OpenImageIO's name of the format. notices: gets sentences about statements
    that are not applied. Raises `InputError` for a statement that is not supported and changes the values.
    """
    check_panorama(spec, path, notices)
    channels = 3 if spec.nchannels >= 3 else 1
    associated = inverted = False
    encoding: Encoding | None
    if form == "gif":
        _check_gif(path)
    if form == "png":
        encoding = _png(path, channels)
    elif form == "tiff":
        tiff = read_tiff(path)
        encoding, associated, inverted = tiff.encoding, tiff.associated, tiff.inverted
    elif form == "jpeg":
        encoding = _jpeg(path, spec, channels, notices)
    elif form == "webp":
        encoding = _webp(path, channels)
    elif form == "bmp":
        encoding = _bmp(path, channels)
    else:
        if form == "psd":
            _check_psd(path)
        if form == "jpeg2000":
            _check_jpeg2000(path)
        encoding = _by_attributes(spec, form, path, channels)
    return Declared(encoding, associated, inverted)


def from_chromaticities(primaries: Sequence[float] | None, path: Path) -> Encoding | None:
    """Return the encoding of linear values with CIE xy of red, green, blue and white; None where none are stated.

    Raises `InputError` for primaries that span no colour space.
    """
    if primaries is None:
        return None
    shown = " ".join(f"{value:g}" for value in primaries)
    try:
        matrix = from_primaries(primaries)
    except ValueError:
        raise InputError(f"{path} states primaries ({shown}) that span no colour space") from None
    return None if matrix is None else Encoding((LINEAR,), f"the primaries it states ({shown})", matrix)


def _by_attributes(spec: Any, form: str, path: Path, channels: int) -> Encoding | None:
    """Return the encoding that OpenImageIO found, for formats that are not read here."""
    points = spec.getattribute("CICP")
    if points is not None and len(points) == 4:
        return from_code_points(points, f"its code points ({form})", path)
    profile = spec.getattribute("ICCProfile")
    if profile is not None:
        return read_icc(bytes(bytearray(profile)), path, "its profile", channels)
    integer = str(spec.format) in ("uint8", "uint16")
    space = spec.get_string_attribute("oiio:ColorSpace")
    gamma = float(spec.get_float_attribute("oiio:Gamma", 0.0))
    transfer = spec.get_string_attribute("dpx:Transfer")
    if transfer not in ("", "Undefined", "User defined", "Linear", "Logarithmic"):
        raise InputError(f"{path} states the transfer function {transfer!r}, which is not read; convert it to EXR")
    # Netpbm's specification names the curve of Rec.709, programs write sRGB.
    if form == "pnm" or not space:
        return None
    curve = power(gamma) if gamma > 0 else _SPACES.get(space)
    if curve is None:
        raise InputError(f"{path} states the colour space {space[:40]}, which is not read; convert it to sRGB")
    if curve is (SRGB_CURVE if integer else LINEAR):
        return None
    return Encoding((curve,), f"its header (the colour space {space[:40]})")


def check_panorama(spec: Any, path: Path, notices: list[str]) -> None:
    """Refuse another projection than the lat-long, or a part of one, by the metadata GPano of panorama programs."""
    projection = str(spec.get_string_attribute("GPano:ProjectionType") or "equirectangular")
    if projection.lower() != "equirectangular":
        shown = "".join(c if c.isprintable() else "?" for c in projection[:40])
        raise InputError(f"{path} states the projection {shown!r} (GPano), a lat-long (equirectangular) was expected")
    for axis in ("Width", "Height"):
        part = spec.get_int_attribute(f"GPano:CroppedAreaImage{axis}Pixels", 0)
        whole = spec.get_int_attribute(f"GPano:FullPano{axis}Pixels", 0)
        if 0 < part < whole:
            raise InputError(
                f"{path} states that it is a part of its panorama, {axis.lower()} {part} of {whole} pixels (GPano); "
                "the whole was expected"
            )
    pitch, roll = (float(spec.get_float_attribute(f"GPano:Pose{name}Degrees", 0.0)) for name in ("Pitch", "Roll"))
    if abs(pitch) > 0.1 or abs(roll) > 0.1:
        notices.append(
            f"{path}: says that the camera was tilted (GPano: pitch {pitch:g}°, roll {roll:g}°); it is read as it is"
        )


# --- PNG ------------------------------------------------------------------------------------------------

_COLOUR_CHUNKS = (b"cICP", b"iCCP", b"sRGB", b"gAMA", b"cHRM", b"eXIf", b"acTL")


def _png(path: Path, channels: int) -> Encoding | None:
    """Return the encoding of a PNG, by the order cICP, iCCP, sRGB, gAMA and cHRM [PNG 3, 4.3], then Exif."""
    found: dict[bytes, bytes] = {}
    with open_input(path) as file:
        for kind, length in _png_chunks(file):
            if kind not in _COLOUR_CHUNKS:
                continue
            name = kind.decode("ascii")
            if kind in found:
                raise InputError(f"{path} has the chunk {name} more than once, one is allowed")
            if length > MAX_BYTES:
                raise InputError(f"{path} has a chunk {name} of {length} bytes, at most {MAX_BYTES} are read")
            found[kind] = file.read(length)
    if b"acTL" in found and int.from_bytes(found[b"acTL"][:4], "big") > 1:
        frames = int.from_bytes(found[b"acTL"][:4], "big")
        raise InputError(f"{path} is an animation of {frames} frames, a single image was expected")
    for kind, size in ((b"cICP", 4), (b"sRGB", 1), (b"gAMA", 4), (b"cHRM", 32)):
        if kind in found and len(found[kind]) != size:
            have = len(found[kind])
            raise InputError(f"{path} is corrupted: its chunk {kind.decode('ascii')} has {have} bytes, {size} are due")
    if b"cICP" in found:
        return from_code_points(found[b"cICP"], "its cICP chunk", path)
    if b"iCCP" in found:
        return read_icc(_inflated(found[b"iCCP"], path), path, "its iCCP chunk", channels)
    if b"sRGB" in found:
        return Encoding((SRGB_CURVE,), "")
    if not (b"gAMA" in found or b"cHRM" in found):
        return read_exif(found.get(b"eXIf", b""), path)
    curve: Curve = SRGB_CURVE
    said = []
    if b"gAMA" in found:
        (gamma,) = struct.unpack(">I", found[b"gAMA"])
        # 1/1000 to 10: beyond, a code or two hold all the light. 0 is not allowed.
        if not 100 <= gamma <= 1_000_000:
            raise InputError(f"{path} states a gamma of {gamma / 1e5:g} (gAMA), .001 to 10 are read")
        curve = power(1e5 / gamma)
        said.append(f"gAMA ({gamma / 1e5:g})")
    matrix = None
    if b"cHRM" in found:
        white, red, green, blue = (pair for pair in struct.iter_unpack(">2I", found[b"cHRM"]))
        xy = [value / 1e5 for value in (*red, *green, *blue, *white)]
        shown = " ".join(f"{value:g}" for value in xy)
        try:
            matrix = from_primaries(xy)
        except ValueError:
            raise InputError(f"{path} states primaries (cHRM: {shown}) that span no colour space") from None
        said.append(f"cHRM ({shown})")
    return Encoding((curve,), f"its {' and '.join(said)}", matrix)


def _png_chunks(file: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Yield kind and length of each chunk, with the file at its body; `integrity` has checked lengths and sums."""
    at = 8
    while True:
        file.seek(at)
        head = file.read(8)
        if len(head) < 8:
            return
        length, kind = struct.unpack(">I4s", head)
        yield kind, length
        if kind == b"IEND":
            return
        at += 12 + length


def _inflated(body: bytes, path: Path) -> bytes:
    """Return the profile of an iCCP chunk: a name, NUL, the method 0, deflated bytes."""
    name, nul, packed = body.partition(b"\0")
    if not nul or not 1 <= len(name) <= 79 or packed[:1] != b"\0":
        raise InputError(f"{path} is corrupted: its iCCP chunk has no name, or a method of compression other than 0")
    inflate = zlib.decompressobj()
    try:
        profile = inflate.decompress(packed[1:], MAX_BYTES + 1)
    except zlib.error as error:
        raise InputError(f"{path} is corrupted: the profile in its iCCP chunk cannot be inflated ({error})") from error
    if len(profile) > MAX_BYTES:
        raise InputError(f"{path} has an ICC profile of over {MAX_BYTES} bytes, which is not read")
    if not inflate.eof:
        raise InputError(f"{path} is corrupted: the profile in its iCCP chunk ends early")
    return profile


# --- JPEG -----------------------------------------------------------------------------------------------

_ICC, _EXIF = b"ICC_PROFILE\0", b"Exif\0\0"


def _jpeg(path: Path, spec: Any, channels: int, notices: list[str]) -> Encoding | None:
    """Return the encoding of the profile in the segments APP2. Refuses inks; says that a gain map is left out."""
    space = spec.get_string_attribute("jpeg:ColorSpace")
    if space in ("CMYK", "YCCK"):
        raise InputError(f"{path} is a JPEG of inks ({space}), grey and RGB are read; convert it to sRGB")
    pieces: dict[int, bytes] = {}
    counts = set()
    gain_map, exif = False, b""
    with open_input(path) as file:
        for marker, length in _jpeg_segments(file):
            if marker not in (0xE1, 0xE2):
                continue
            body = file.read(length)
            gain_map |= b"hdrgm:Version" in body or body.startswith(b"urn:iso:std:iso:ts:21496")
            if marker == 0xE1 and body.startswith(_EXIF):
                exif = exif or body[6:]
            if marker == 0xE2 and body.startswith(_ICC) and len(body) > 14:
                if body[12] in pieces:
                    raise InputError(f"{path} is corrupted: part {body[12]} of its ICC profile is there twice")
                pieces[body[12]] = body[14:]
                counts.add(body[13])
    if gain_map:
        notices.append(f"{path}: has a gain map for displays of high range, which was left out; its picture was read")
    if not pieces:
        return read_exif(exif, path)
    if len(counts) != 1 or sorted(pieces) != list(range(1, counts.pop() + 1)):
        raise InputError(f"{path} is corrupted: its ICC profile is not complete, parts {sorted(pieces)} are there")
    return read_icc(b"".join(pieces[k] for k in sorted(pieces)), path, "its APP2 segment", channels)


def _jpeg_segments(file: BinaryIO) -> Iterator[tuple[int, int]]:
    """Yield marker and length of each segment before the image data, with the file at its body."""
    at = 2
    while True:
        file.seek(at)
        head = file.read(4)
        if len(head) < 4 or head[0] != 0xFF:
            return
        if head[1] == 0xFF:  # a fill byte
            at += 1
            continue
        if head[1] in (0xDA, 0xD9):
            return
        if head[1] == 1 or 0xD0 <= head[1] <= 0xD8:  # without a length
            at += 2
            continue
        length = int.from_bytes(head[2:4], "big")
        if length < 2:
            return
        yield head[1], length - 2
        at += 2 + length


# --- WebP -----------------------------------------------------------------------------------------------


_MOST_CHUNKS = 100_000


def _webp(path: Path, channels: int) -> Encoding | None:
    """Return the encoding of the profile in the chunk ICCP. Refuses animations."""
    found: dict[bytes, bytes] = {}
    frames = chunks = 0
    with open_input(path) as file:
        at = 12
        while len(head := _at(file, at, 8)) == 8:
            kind, length = struct.unpack("<4sI", head)
            chunks += 1
            if chunks > _MOST_CHUNKS:
                raise InputError(f"{path} has more than {_MOST_CHUNKS} chunks, an image has a few")
            frames += kind == b"ANMF"
            if kind in (b"ICCP", b"EXIF") and kind not in found:
                if length > MAX_BYTES:
                    raise InputError(
                        f"{path} has a chunk {kind.decode()} of {length} bytes, at most {MAX_BYTES} are read"
                    )
                found[kind] = file.read(length)
            at += 8 + length + length % 2
    if frames > 1:
        raise InputError(f"{path} is an animation of {frames} frames, a single image was expected")
    if b"ICCP" in found:
        return read_icc(found[b"ICCP"], path, "its ICCP chunk", channels)
    return read_exif(found.get(b"EXIF", b"").removeprefix(_EXIF), path)


def _at(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


# --- BMP, PSD, JPEG 2000 --------------------------------------------------------------------------------


def _bmp(path: Path, channels: int) -> Encoding | None:
    """Return the encoding of the headers of version 4 and 5 [Microsoft, BITMAPV5HEADER]."""
    with open_input(path) as file:
        head = file.read(14 + 124)
        if len(head) < 14 + 108 or int.from_bytes(head[14:18], "little") < 108:
            return None
        space = head[70:74][::-1]
        if space in (b"sRGB", b"Win "):
            return None
        if space == b"LINK":
            raise InputError(f"{path} names a colour profile in another file, which is not read; embed or apply it")
        if space == b"MBED":
            at, length = struct.unpack_from("<II", head.ljust(138, b"\0"), 14 + 112)
            if length > MAX_BYTES:
                raise InputError(f"{path} has an ICC profile of {length} bytes, at most {MAX_BYTES} are read")
            return read_icc(_at(file, 14 + at, length), path, "its header", channels)
    if space != b"\0\0\0\0":
        raise InputError(f"{path} states the colour space {space!r}, which is not read; convert it to sRGB")
    ends = [value / (1 << 30) for value in struct.unpack_from("<9i", head, 74)]
    gammas = [value / (1 << 16) for value in struct.unpack_from("<3I", head, 110)]
    if not any(ends) and not any(gammas):  # calibrated, with nothing stated: what most writers leave
        return None
    import numpy as np

    from whitefurnace.files.colour import matrix_to_rec709

    matrix = None
    if any(ends):
        to_xyz = np.array(ends).reshape(3, 3).T
        try:
            matrix = matrix_to_rec709(to_xyz, to_xyz.sum(1))
        except ValueError:
            raise InputError(f"{path} states primaries that span no colour space") from None
    if any(gammas) and not all(0.1 <= gamma <= 10 for gamma in gammas):
        raise InputError(f"{path} states the gammas {' '.join(f'{g:g}' for g in gammas)}, .1 to 10 are read")
    curves = tuple(map(power, gammas)) if any(gammas) else (SRGB_CURVE,)
    return Encoding(curves, "its header (calibrated RGB)", matrix)


def _check_gif(path: Path) -> None:
    with open_input(path) as file:
        ratio = file.read(13)[-1]
    if ratio and not 0.99 < (ratio + 15) / 64 < 1.01:  # [GIF 89a, 18]
        raise InputError(
            f"{path} states pixels of the aspect ratio {(ratio + 15) / 64:.4g}; square pixels were expected"
        )


def _check_psd(path: Path) -> None:
    with open_input(path) as file:
        mode = int.from_bytes(_at(file, 24, 2), "big")
    if mode not in (0, 1, 2, 3):
        name = {4: "CMYK", 7: "multichannel", 8: "duotone", 9: "Lab"}.get(mode, "unknown")
        raise InputError(f"{path} is in the colour mode {mode} ({name}), RGB and grey are read; convert it to RGB")


def _check_jpeg2000(path: Path) -> None:
    """Refuse an enumerated colour space other than sRGB, grey and sYCC [ISO/IEC 15444-1, I.5.3.3]."""
    with open_input(path) as file:
        head = file.read(1 << 16)
    at = head.find(b"colr")
    if at > 0 and head[at + 4 : at + 5] == b"\1":
        space = int.from_bytes(head[at + 7 : at + 11], "big")
        if space not in (16, 17, 18):
            raise InputError(
                f"{path} states the colour space {space} of JPEG 2000; sRGB (16), grey (17) and sYCC (18) are read"
            )
