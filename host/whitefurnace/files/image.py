"""Reads an image of any format of OpenImageIO as linear Rec.709 float32.

A file that is missing, truncated, corrupted or has a wrong size in its header raises an error of one sentence.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import FileError, InputError, UsageError, nearest
from whitefurnace.files import exr_parts, memory
from whitefurnace.files.atomic import digest_file
from whitefurnace.files.colour import LINEAR, SRGB_CURVE, Encoding
from whitefurnace.files.declared import Declared, check_panorama, from_chromaticities, read_declared
from whitefurnace.files.exr_header import is_exr
from whitefurnace.files.hdr_header import Radiance, read_radiance_header
from whitefurnace.files.inputs import head_of, library_name, open_input
from whitefurnace.files.integrity import check_file
from whitefurnace.files.png import _scratch_file

MAX_PIXELS = 32768 * 16384
MAX_SIDE = 65536
_CHUNK_BYTES = 8 << 20
# The densest coding of flat TIFF, PNG and JPEG images is near 1365 : 1 (LZW); a header that claims more is wrong.
_MAX_RATIO = 2000
# Formats of OpenImageIO that are no images: `null` makes one from a file's name, `zfile` holds depth.
_NOT_IMAGES = ("null", "zfile", "term")
# Formats of printing density (Cineon), of unknown curves and primaries, of measurements of any unit (FITS), or that
# hold files of another format (ICO).
_UNREAD = ("cineon", "fits", "ico", "rla", "softimage")
_SRGB = Encoding((SRGB_CURVE,), "sRGB")
_FLOAT_MAX = float(np.finfo(np.float32).max)
_HALF_MAX = 65504.0

FILLS = ("black",)
"""What the display window of an image can be filled with where its data window has no pixels."""

_MOST_FILLED = 64
"""Largest display window that is filled, over the pixels of the data window: a patch of 45° by 45° is 1/64 of a
lat-long."""


@dataclass(frozen=True)
class Image:
    """An image that was read.

    pixels   float32 (height, width, channels), linear Rec.709 radiance, row 0 on top; 1 channel (grey), 3 (RGB) or
             4 (RGB and coverage)
    digest   sha256 of the file's bytes, in hex
    format   OpenImageIO's name of the file format
    notices  sentences about conversions and about data that was left out
    layout   the layout that the file itself states, "latlong" or "openexr cube"; None where it states none
    aspect   width of a pixel over its height, as the file states it
    largest  the largest finite value that the file's pixels can hold
    """

    pixels: npt.NDArray[np.float32]
    path: Path
    digest: str
    format: str
    notices: tuple[str, ...] = ()
    layout: str | None = None
    aspect: float = 1.0
    largest: float = _FLOAT_MAX


@cache
def srgb_table(dtype: str) -> npt.NDArray[np.float32]:
    """Return the linear value of every sRGB code of `dtype` ("uint8" or "uint16"): float32 (256,) or (65536,)."""
    return _SRGB.tables(dtype)[0]


def decode_srgb(codes: npt.NDArray[Any], out: npt.NDArray[np.float32] | None = None) -> npt.NDArray[np.float32]:
    """Decode uint8 or uint16 `codes` (..., 1 | 3 | 4) from sRGB to linear float32.

    A fourth channel is not decoded but divided by its largest code. `out` receives the result where it is given.
    """
    if out is None:
        out = np.empty(codes.shape, np.float32)
    _look_up(codes, out, (srgb_table(codes.dtype.name),))
    return out


def _look_up(codes: npt.NDArray[Any], out: npt.NDArray[np.float32], tables: Sequence[npt.NDArray[np.float32]]) -> None:
    """Decode codes (..., 1 | 3 | 4) by one table, or by those of R, G and B; a fourth channel is divided."""
    if len(tables) == 1:
        np.take(tables[0], codes[..., :3], out=out[..., :3], mode="clip")
    else:
        for channel in range(min(codes.shape[-1], 3)):
            out[..., channel] = np.take(tables[channel], codes[..., channel], mode="clip")
    if codes.shape[-1] == 4:
        np.divide(codes[..., 3], np.float32(np.iinfo(codes.dtype).max), out=out[..., 3])


def check_choice(layer: object, fill: object) -> None:
    """Raise `UsageError` for a `layer` or a `fill` of `read_image` that is out of its domain."""
    if layer is not None and (not isinstance(layer, str) or not layer):
        raise UsageError(f"layer is {layer!r}, the name of a part or layer was expected")
    if fill is not None and fill not in FILLS:
        raise UsageError(f"fill is {fill!r}{nearest(str(fill), FILLS)}")


def read_image(path: str | os.PathLike[str], *, layer: str | None = None, fill: str | None = None) -> Image:
    """Read an image as linear Rec.709 float32.

    layer: name of the part or layer of an OpenEXR file; by default the first part with R, G and B. fill: "black" fills
    the pixels of the display window that the data window does not have; such files are refused by default.

    Integers of 8 and 16 bits are decoded from sRGB, except a fourth channel; floats are taken as linear, unless the
    file states another encoding. Its ICC profile, code points, gamma, primaries, exposure and orientation are applied
    and named in the notices; docs/inputs.md lists them. Extra channels are left out with a notice.

    Raises `FileError` for a file that cannot be opened; `InputError` for one that is not a valid image of 1, 3 or 4
    channels with at most 32768 x 16384 pixels and 65536 on a side, or whose statements are not supported; and
    `UsageError` for a layer that the file does not have.
    """
    check_choice(layer, fill)
    path = Path(path)
    size = _regular_size(path)
    if size == 0:
        raise InputError(f"{path} is empty, an image file was expected")
    digest = digest_file(path)
    try:
        return _read(path, size, digest, layer, fill)
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeError as error:  # for example in the name of a channel
        raise InputError(f"{path} is corrupted: its header holds text that is not UTF-8") from error
    except MemoryError as error:
        raise InputError(f"{path} needs more memory than this machine gives") from error


def _regular_size(path: Path) -> int:
    with open_input(path, "an image file") as file:
        return os.fstat(file.fileno()).st_size


@dataclass(frozen=True)
class Opened:
    """An image file that OpenImageIO has opened: its object, specification and format.

    radiance: of a .hdr alone. choice: the part and layer of an OpenEXR file; None where they hold no light.
    """

    source: Any
    spec: Any
    form: str
    radiance: Radiance | None
    choice: exr_parts.Choice | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the upright picture in its display window."""
        if self.radiance is not None:
            return self.radiance.width, self.radiance.height
        width, height = self.spec.full_width, self.spec.full_height
        return (height, width) if 5 <= self.orientation <= 8 else (width, height)

    @property
    def aspect(self) -> float:
        """Width of a pixel over its height, as the file states it; 1 where it states none, or one within 1 %."""
        if self.choice is not None:
            return self.choice.aspect
        if self.radiance is not None:
            return self.radiance.aspect
        # Resolutions first: of a JPEG, OpenImageIO's ratio is the inverse.
        x, y = (float(self.spec.get_float_attribute(f"{axis}Resolution", 0.0)) for axis in "XY")
        aspect = y / x if x > 0 and y > 0 else float(self.spec.get_float_attribute("PixelAspectRatio", 0.0))
        return aspect if aspect > 0 and not 0.99 < aspect < 1.01 else 1.0

    @property
    def orientation(self) -> int:
        """Exif's orientation, 1 to 8, or an invalid number that the file states."""
        # libjxl turns the picture itself, and Exif in JPEG XL is to be ignored [ISO/IEC 18181-2, 9.3].
        return 1 if self.form == "jpegxl" else int(self.spec.get_int_attribute("Orientation", 1))


@contextlib.contextmanager
def opened(
    path: Path,
    size: int,
    *,
    unassociated: bool = False,
    layer: str | None = None,
    fill: str | None = None,
    light: bool = True,
) -> Iterator[Opened]:
    """Open an image file of `size` bytes, check its sizes and give it to a `with` statement.

    unassociated: values come as stored, colour is not multiplied by coverage. layer, fill: as for `read_image`. light:
    whether an OpenEXR file without light is refused. Raises `FileError` and `InputError`, for errors within the
    statement too, and `UsageError` for a layer that the file has not.
    """
    import OpenImageIO as oiio

    hints = oiio.ImageSpec()
    if unassociated:
        hints.attribute("oiio:UnassociatedAlpha", 1)
    with contextlib.ExitStack() as stack:
        head = head_of(path, 4096)
        check_file(path, size, head)
        choice = _choice(path, size, head, layer, light)
        radiance = read_radiance_header(path) if head.startswith(b"#?") else None
        shown = path
        if radiance is not None:
            flat = radiance.unpacked(path)
            if flat is not None or not radiance.plain:
                path = stack.enter_context(_scratch_file(".hdr"))
                radiance.rewrite(shown, path, flat)
        path = Path(stack.enter_context(library_name(path)))
        source = oiio.ImageInput.open(str(path), hints)
        complaint = _complaint(oiio)  # fetched even without a failure: else it is printed at exit
        if source is None:
            raise _not_opened(complaint, path, shown, head)
        try:
            spec, form = _chosen_spec(source, choice, path), source.format_name()
            if form in _NOT_IMAGES:
                raise InputError(f"{path} is a file of kind {form}, an image of radiance was expected")
            if form in _UNREAD:
                raise InputError(f"{path} is a file of kind {form}, whose statements of colour are not read; use EXR")
            _check_size(spec, path, size, form)
            _check_windows(spec, path, fill)
            yield Opened(source, spec, form, radiance if form == "hdr" else None, choice)
        except InputError as error:
            raise InputError(str(error).replace(str(path), str(shown))) from error
        finally:
            source.close()
            _complaint(source)


def _not_opened(complaint: str, path: Path, shown: Path, head: bytes) -> InputError:
    if head[4:8] == b"ftyp" and head[8:12] in (b"avif", b"avis", b"heic", b"heix", b"hevc", b"mif1", b"msf1"):
        return InputError(f"{shown} is an AVIF or HEIF image, which is not read; convert it to EXR or PNG")
    if "could not find a format reader" in complaint or not complaint:
        return InputError(f"{shown} is not an image in a format that is known, such as EXR, HDR, PNG, TIFF or JPEG")
    return InputError(f"{shown} is not a valid image: {_reason(complaint, path)}")


def _choice(path: Path, size: int, head: bytes, layer: str | None, light: bool) -> exr_parts.Choice | None:
    """Choose the part and layer of an OpenEXR file that begins with `head`; None for a file of another format."""
    if is_exr(head):
        try:
            return exr_parts.choose(path, size, layer)
        except InputError:
            if light or layer is not None:
                raise
            return None
    if layer is not None:
        raise UsageError(f"{path} is not OpenEXR and has no layer {layer!r}")
    return None


def _chosen_spec(source: Any, choice: exr_parts.Choice | None, path: Path) -> Any:
    """Go to the chosen part and return its header; an environment map is all of its data window."""
    if choice is not None and not source.seek_subimage(choice.part, 0):
        raise InputError(f"{path} is not a valid image: {_reason(_complaint(source), path)}")
    spec = source.spec()
    if choice is not None and choice.layout is not None:
        spec.full_x, spec.full_y, spec.full_width, spec.full_height = spec.x, spec.y, spec.width, spec.height
    return spec


def _read(path: Path, size: int, digest: str, layer: str | None, fill: str | None) -> Image:
    with opened(path, size, unassociated=True, layer=layer, fill=fill) as found:
        return _decode(found, path, digest)


def _decode(found: Opened, path: Path, digest: str) -> Image:
    source, spec, form = found.source, found.spec, found.form
    notices: list[str] = []
    names, choice = list(spec.channelnames), found.choice
    if choice is None:
        picks = _pick_channels(names, path, form, notices)
    elif set(choice.channels) <= set(names):
        picks = [names.index(name) for name in choice.channels]
        notices += choice.notices
    else:
        raise InputError(f"{path} is corrupted: its header names channels in two ways")
    pixel = str(spec.format)
    # Channels of an EXR may differ in type; OpenImageIO converts all to the type of the first.
    if pixel not in ("uint8", "uint16", "half", "float", "double"):
        raise InputError(f"{path} has pixels of type {pixel}, 8- or 16-bit unsigned integers or floats were expected")
    if found.radiance is not None:
        declared = Declared(found.radiance.encoding)
        notices += found.radiance.notices
    elif choice is not None:
        check_panorama(spec, path, notices)
        declared = Declared(from_chromaticities(choice.primaries, path))
    else:
        declared = read_declared(path, form, spec, notices)
    # TIFF, PNG and WebP are looked at in `declared`; others have one image, or the whole one first.
    if form in ("gif", "jpegxl"):
        if source.seek_subimage(1, 0):
            raise InputError(f"{path} holds several images or frames, a single one was expected")
        source.seek_subimage(0, 0)  # a GIF reader stands at no image after it has looked for a second one
    _complaint(source)
    if choice is None and int(spec.get_int_attribute("oiio:subimages", 1)) > 1:
        notices.append(f"{path}: only the first of its {spec.get_int_attribute('oiio:subimages')} images was read")
    pixels, largest = _radiance(source, spec, picks, path, pixel, declared, notices)
    if found.radiance is not None:
        pixels = found.radiance.upright(pixels)
    else:
        if not 1 <= found.orientation <= 8:
            notices.append(
                f"{path}: states the orientation {found.orientation}, 1 to 8 exist; its rows were taken as stored"
            )
        pixels = _upright(pixels, found.orientation)
    if choice is not None:
        return Image(pixels, path, digest, form, tuple(notices), choice.layout, found.aspect, choice.largest)
    return Image(pixels, path, digest, form, tuple(notices), aspect=found.aspect, largest=largest)


def _radiance(
    source: Any, spec: Any, picks: list[int], path: Path, pixel: str, declared: Declared, notices: list[str]
) -> tuple[npt.NDArray[np.float32], float]:
    """Read the pixels and bring them to linear Rec.709 by the encoding that the file states.

    Returns the largest value that they can hold too.
    """
    integer = pixel in ("uint8", "uint16")
    default = SRGB_CURVE if integer else LINEAR
    encoding = declared.encoding
    if encoding is None or encoding.is_near(default):
        encoding = Encoding((default,), "")
    encoding.check_channels(len(picks), path)
    associated = declared.associated and len(picks) == 4
    if integer and not associated:
        tables = encoding.tables(pixel)
        if declared.inverted:
            tables = tuple(table[::-1] for table in tables)
        pixels = _read_pixels(source, spec, picks, path, pixel, tables)
    else:
        pixels = _read_pixels(source, spec, picks, path, "float")
        if associated and encoding.curves != (LINEAR,):
            # The curve was applied before the colour was multiplied by alpha.
            alpha = pixels[..., 3:]
            np.divide(pixels[..., :3], alpha, out=pixels[..., :3], where=alpha > 0)
            if integer:
                np.minimum(pixels[..., :3], 1, out=pixels[..., :3])
            encoding.linearize(pixels, path)
            pixels[..., :3] *= alpha
        else:
            encoding.linearize(pixels, path)
    largest = encoding.largest(pixel) if integer else _HALF_MAX if pixel == "half" else _FLOAT_MAX
    outside = encoding.to_rec709(pixels)
    if encoding.said:
        notices.append(f"{path}: converted to linear Rec.709 from {encoding.said}")
    if outside:
        notices.append(f"{path}: {outside}")
    return pixels, min(largest, _FLOAT_MAX)


def _check_size(spec: Any, path: Path, size: int, form: str) -> None:
    width, height = spec.width, spec.height
    if spec.deep:
        raise InputError(f"{path} is a deep image, a flat one was expected")
    if spec.depth > 1:
        raise InputError(f"{path} is a volume of {spec.depth} slices, a flat image was expected")
    if width < 1 or height < 1:
        raise InputError(f"{path} states a size of {width} x {height}, each side must be at least 1")
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise InputError(
            f"{path} states a size of {width} x {height}, more than 32768 x 16384 pixels or {MAX_SIDE} a side"
        )
    if spec.tile_width and max(spec.tile_width, spec.tile_height) > MAX_SIDE:
        raise InputError(
            f"{path} states tiles of {spec.tile_width} x {spec.tile_height}, at most {MAX_SIDE} a side are read"
        )
    if form in ("tiff", "png", "jpeg") and spec.image_bytes(True) > _MAX_RATIO * size:
        raise InputError(
            f"{path} states a size of {width} x {height}, but its {size} bytes cannot hold that many pixels"
        )


def _check_windows(spec: Any, path: Path, fill: str | None) -> None:
    """Raise InputError where the data window lacks pixels of the display window that are not to be filled."""
    left, top = spec.full_x - spec.x, spec.full_y - spec.y
    whole = left >= 0 and top >= 0 and left + spec.full_width <= spec.width and top + spec.full_height <= spec.height
    if spec.full_width >= 1 and spec.full_height >= 1 and whole:
        return
    windows = (
        f"{path} has a data window of {spec.width} x {spec.height} at ({spec.x}, {spec.y}) that does not cover its "
        f"display window of {spec.full_width} x {spec.full_height} at ({spec.full_x}, {spec.full_y})"
    )
    if fill is None:
        raise InputError(f"{windows}; --fill black has the missing pixels black")
    columns = min(spec.x + spec.width, spec.full_x + spec.full_width) - max(spec.x, spec.full_x)
    rows = min(spec.y + spec.height, spec.full_y + spec.full_height) - max(spec.y, spec.full_y)
    if columns < 1 or rows < 1:
        raise InputError(f"{windows}: they have no pixel in common")
    texels = spec.full_width * spec.full_height
    if max(spec.full_width, spec.full_height) > MAX_SIDE or texels > min(MAX_PIXELS, _MOST_FILLED * columns * rows):
        raise InputError(f"{windows}: a display window of at most {_MOST_FILLED} times the pixels can be filled")


def _pick_channels(names: list[str], path: Path, form: str, notices: list[str]) -> list[int]:
    """Return the indices of the channels to read: R, G, B and A by name, else Y, else all where there are 1, 3 or 4."""
    found: dict[str, int] = {}
    for index, name in enumerate(names):
        found.setdefault(name.upper(), index)
    if len(names) == 1:
        picks = [0]
    elif len(names) == 2:
        raise InputError(f"{path} has 2 channels ({', '.join(names)}), 1, 3 or 4 were expected")
    elif all(name in found for name in "RGB"):
        picks = [found[name] for name in "RGBA" if name in found]
    elif "RY" in found or "BY" in found:
        raise InputError(f"{path} stores luminance and chroma ({', '.join(names)}), channels R, G and B were expected")
    elif "Y" in found:
        picks = [found["Y"]]
    elif form != "openexr" and len(names) in (3, 4):
        picks = list(range(len(names)))
    else:
        shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
        raise InputError(f"{path} has {len(names)} channels ({shown}), but none named R, G and B, or Y")
    left_out = [name for index, name in enumerate(names) if index not in picks]
    if left_out:
        shown = ", ".join(left_out[:8]) + (", ..." if len(left_out) > 8 else "")
        notices.append(f"{path}: channels left out: {shown}")
    return picks


def _read_pixels(
    source: Any,
    spec: Any,
    picks: list[int],
    path: Path,
    pixel: str,
    tables: Sequence[npt.NDArray[np.float32]] = (),
) -> npt.NDArray[np.float32]:
    """Read the display window, (height, width, len(picks)); codes of integers are looked up in `tables`.

    Pixels that the data window has not are 0.
    Rows are read in bands, so that memory of `out` is committed only for rows that the file holds; a header with a
    wrong size takes no memory.
    """
    first, last = min(picks), max(picks) + 1
    left, right = max(spec.full_x, spec.x), min(spec.full_x + spec.full_width, spec.x + spec.width)
    begin, end = max(spec.full_y, spec.y), min(spec.full_y + spec.full_height, spec.y + spec.height)
    columns = slice(left - spec.x, right - spec.x)
    kind = pixel if pixel in ("uint8", "uint16") else "float"
    tile = spec.tile_height if spec.tile_width else 0
    # Bands are whole compressed blocks; the largest of EXR has 256 rows (DWAB). Tiles have their own height.
    unit = tile or max(1, min(int(spec.get_int_attribute("oiio:RowsPerChunk", 1)), 256))
    row = spec.width * (last - first) * 4
    rows = unit * max(1, _CHUNK_BYTES // (row * unit))
    texels = spec.full_height * spec.full_width
    # A band is there twice: as OpenImageIO's bytes and as the array that it is returned in.
    memory.require(
        4 * texels * len(picks) + 2 * row * min(rows, spec.height),
        f"its {spec.full_width} x {spec.full_height} pixels of {len(picks)} channels",
        path,
    )
    out = np.zeros((spec.full_height, spec.full_width, len(picks)), np.float32)
    inner = out[begin - spec.full_y : end - spec.full_y, left - spec.full_x : right - spec.full_x]
    order = [pick - first for pick in picks]
    straight = order == list(range(last - first))
    # Bands start at whole blocks of the data window, which may begin above the display window.
    part = source.current_subimage()
    for y in range(spec.y + (begin - spec.y) // unit * unit, end, rows):
        stop = min(y + rows, spec.y + spec.height)
        if tile:
            band = source.read_tiles(
                part, 0, spec.x, spec.x + spec.width, y, stop, spec.z, spec.z + 1, first, last, kind
            )
        else:
            band = source.read_scanlines(part, 0, y, stop, spec.z, first, last, kind)
        # OpenImageIO fills missing parts of a JPEG with grey and only sets an error message.
        if band is None or source.has_error:
            raise InputError(f"{path} is truncated or corrupted: {_reason(_complaint(source), path)}")
        band = np.asarray(band).reshape(stop - y, spec.width, last - first)
        band = band[max(begin - y, 0) : min(stop, end) - y, columns]
        if not straight:
            band = band[..., order]
        piece = inner[max(y, begin) - begin : min(stop, end) - begin]
        if kind == "float":
            if piece.shape == out.shape and band.dtype == np.float32 and band.flags.c_contiguous:
                return band  # one band holds the whole image
            piece[...] = band
        else:
            _look_up(band, piece, tables)
    return out


def _upright(pixels: npt.NDArray[np.float32], orientation: int) -> npt.NDArray[np.float32]:
    """Turn the image by its Exif orientation, 1 to 8, which OpenImageIO reports but does not apply."""
    if orientation in (5, 7):
        pixels = pixels.swapaxes(0, 1)
    pixels = {
        2: pixels[:, ::-1],
        3: pixels[::-1, ::-1],
        4: pixels[::-1],
        6: np.rot90(pixels, -1),
        7: pixels[::-1, ::-1],
        8: np.rot90(pixels),
    }.get(orientation, pixels)
    return np.ascontiguousarray(pixels)


def _complaint(source: Any) -> str:
    """Fetch and clear the last error message of OpenImageIO or of one of its objects."""
    try:
        return str(source.geterror())
    except UnicodeError:  # the message quotes bytes of the file
        return ""


def _reason(complaint: str, path: Path) -> str:
    """Return the first line of a library's message in a form that ends a sentence."""
    lines = complaint.strip().splitlines() or ["it could not be decoded"]
    text = " ".join("".join(c if c.isprintable() else " " for c in lines[0]).split())
    text = text.replace(f"({path})", "").replace(f'"{path}": ', "").replace(str(path), "it")
    text = re.sub(r"^EXR Error *: *EXR_ERR_[A-Z_]+ |^(JPEG|PNG read|IFF) error:? ", "", text)
    return " ".join(text.split())[:160].rstrip(" .:") or "it could not be decoded"
