"""Reads the headers of OpenEXR files: every part with its channels, windows and attributes.

OpenImageIO renames some attributes and leaves others out; what a file says about itself is decided on these instead.
The format: "OpenEXR File Layout", openexr.com.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from whitefurnace.errors import InputError
from whitefurnace.files.inputs import open_input

MAGIC = b"v/1\x01"
PIXEL_TYPES = ("uint", "half", "float")
COMPRESSIONS = ("none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab", "htj2k256", "htj2k32")
ENVMAPS = ("latlong", "cube")

# The most bytes of pixels for one byte of the file. Deflate reaches 1032 : 1, of which PXR24 drops one byte in four
# first; RLE writes 2 bytes for 128; B44A 3 bytes for 16 halves; PIZ writes runs of 255 values in less than 2 bytes; DWA
# deflates one half for a block of 8 x 8 pixels. HTJ2K has no simple bound and is taken as DWA.
_RATIOS = (1, 64, 1032, 1032, 1032, 1376, 11, 11, 66048, 66048, 66048, 66048)
_ROWS = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32)
"""Rows in a block of each compression."""

_MOST_PARTS = 1024
_MOST_ATTRIBUTES = 4096
_MOST_CHANNELS = 4096
_MOST_BYTES = 1 << 20
"""Largest value that is read; larger ones, such as previews, are passed over."""


class Window(NamedTuple):
    """A rectangle of pixels; both ends belong to it."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def width(self) -> int:
        return self.right - self.left + 1

    @property
    def height(self) -> int:
        return self.bottom - self.top + 1


class Channel(NamedTuple):
    """A channel: its full name, a name of `PIXEL_TYPES`, and the pixels from one sample to the next across and down."""

    name: str
    kind: str
    across: int = 1
    down: int = 1


@dataclass(frozen=True)
class Part:
    """The header of one part.

    name         that of a part of several; empty for the only one of a file
    kind         "scanlineimage", "tiledimage", "deepscanline" or "deeptile"
    compression  an index of `COMPRESSIONS`
    tile         width, height and level mode of tiles (0: one level, 1: mipmaps, 2: ripmaps); None for rows
    attributes   values of the attributes that `_VALUES` reads, by name
    """

    name: str
    kind: str
    channels: tuple[Channel, ...]
    data: Window
    display: Window
    compression: int
    tile: tuple[int, int, int] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def deep(self) -> bool:
        return self.kind.startswith("deep")


def is_exr(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is OpenEXR."""
    return head.startswith(MAGIC)


def read_parts(path: Path, size: int) -> tuple[Part, ...]:
    """Read the header of every part of a file of `size` bytes.

    Raises `InputError` for a header that is truncated, corrupted, or describes more pixels than the file can hold, and
    `FileError` where the file cannot be read.
    """
    with open_input(path, "an image file") as file:
        reader = _Reader(file, size, path)
        version = reader.integer()
        several = bool(version & 0x1000)
        if reader.first != MAGIC or version & 0xFF != 2:
            raise reader.wrong("it is not OpenEXR 2")
        parts = []
        while True:
            found = _part(reader, version, several)
            if found is None:
                break
            parts.append(found)
            if not several:
                break
            if len(parts) > _MOST_PARTS:
                raise reader.wrong(f"it has over {_MOST_PARTS} parts")
        if not parts:
            raise reader.wrong("it has no part")
        names = [part.name for part in parts]
        if several and len(set(names)) < len(names):
            raise reader.wrong("two of its parts have one name")
        return tuple(parts)


class _Reader:
    """Reads little-endian values of a header in their order."""

    def __init__(self, file: BinaryIO, size: int, path: Path) -> None:
        self.file, self.left, self.size, self.path = file, size, size, path
        self.first = self.bytes(4)

    def wrong(self, what: str) -> InputError:
        return InputError(f"{self.path} is not a valid OpenEXR file: {what}")

    def bytes(self, count: int) -> bytes:
        if count > self.left:
            raise InputError(f"{self.path} is truncated or corrupted: its header reaches beyond its {self.size} bytes")
        self.left -= count
        return self.file.read(count)

    def skip(self, count: int) -> None:
        if count > self.left:
            self.bytes(count)
        self.left -= count
        self.file.seek(count, 1)

    def integer(self) -> int:
        return int.from_bytes(self.bytes(4), "little")

    def text(self) -> str:
        """A name that ends with a NUL, of at most 255 bytes."""
        found = bytearray()
        while (byte := self.bytes(1)) != b"\0":
            found += byte
            if len(found) > 255:
                raise self.wrong("a name in its header is longer than 255 bytes")
        return found.decode()


def _channels(data: bytes) -> tuple[Channel, ...]:
    found: list[Channel] = []
    at = 0
    while data[at : at + 1] not in (b"\0", b""):
        end = data.index(b"\0", at)
        kind, across, down = struct.unpack_from("<i4xii", data, end + 1)
        if not 0 <= kind < len(PIXEL_TYPES) or across < 1 or down < 1 or len(found) == _MOST_CHANNELS:
            raise ValueError
        found.append(Channel(data[at:end].decode(), PIXEL_TYPES[kind], across, down))
        at = end + 17
    if at + 1 != len(data) or not found or len({channel.name for channel in found}) < len(found):
        raise ValueError
    return tuple(found)


def _names(data: bytes) -> tuple[str, ...]:
    found = []
    while data:
        (length,) = struct.unpack_from("<i", data)
        if not 0 <= length <= len(data) - 4:
            raise ValueError
        found.append(data[4 : 4 + length].decode())
        data = data[4 + length :]
    return tuple(found)


def _numbers(form: str) -> Callable[[bytes], tuple[Any, ...]]:
    return struct.Struct("<" + form).unpack


# By its name: type of an attribute, and how its value is read. What an attribute of another type says is not known.
_VALUES: dict[str, tuple[str, Callable[[bytes], Any]]] = {
    "channels": ("chlist", _channels),
    "compression": ("compression", lambda data: _numbers("B")(data)[0]),
    "dataWindow": ("box2i", lambda data: Window(*_numbers("4i")(data))),
    "displayWindow": ("box2i", lambda data: Window(*_numbers("4i")(data))),
    "pixelAspectRatio": ("float", lambda data: _numbers("f")(data)[0]),
    "tiles": ("tiledesc", _numbers("IIB")),
    "name": ("string", bytes.decode),
    "type": ("string", bytes.decode),
    "view": ("string", bytes.decode),
    "multiView": ("stringvector", _names),
    "envmap": ("envmap", lambda data: _numbers("B")(data)[0]),
    "chromaticities": ("chromaticities", _numbers("8f")),
    "acesImageContainerFlag": ("int", lambda data: _numbers("i")(data)[0]),
    "whiteLuminance": ("float", lambda data: _numbers("f")(data)[0]),
    "adoptedNeutral": ("v2f", _numbers("2f")),
    "renderingTransform": ("string", bytes.decode),
    "lookModTransform": ("string", bytes.decode),
    "colorInteropID": ("string", bytes.decode),
    "oiio:ColorSpace": ("string", bytes.decode),
    "wrapmodes": ("string", bytes.decode),
    "worldToCamera": ("m44f", _numbers("16f")),
    "worldToNDC": ("m44f", _numbers("16f")),
}
_NEEDED = ("channels", "compression", "dataWindow", "displayWindow")


def _part(reader: _Reader, version: int, several: bool) -> Part | None:
    """Read one header; None for the empty one after the last part."""
    found: dict[str, Any] = {}
    count = 0
    while name := reader.text():
        count += 1
        if count > _MOST_ATTRIBUTES:
            raise reader.wrong(f"it has over {_MOST_ATTRIBUTES} attributes")
        kind, length = reader.text(), reader.integer()
        known = _VALUES.get(name)
        if known is None or known[0] != kind:
            if known is not None and (name in _NEEDED or name in ("envmap", "tiles", "chromaticities")):
                raise reader.wrong(f"its attribute {name} is of type {kind!r}, {known[0]} was expected")
            reader.skip(length)
            continue
        if length > _MOST_BYTES:
            raise reader.wrong(f"its attribute {name} has {length} bytes, at most {_MOST_BYTES} are read")
        value = reader.bytes(length)
        try:
            found[name] = known[1](value)
        except (struct.error, ValueError, LookupError) as error:
            if isinstance(error, UnicodeError):
                raise
            raise reader.wrong(f"its attribute {name} cannot be read") from None
    if not count and several:
        return None
    for name in _NEEDED:
        if name not in found:
            raise reader.wrong(f"its header lacks {name}")
    return _checked(reader, found, version, several)


def _checked(reader: _Reader, found: dict[str, Any], version: int, several: bool) -> Part:
    """Return the part that attributes describe, where its pixels can be in the file."""
    data, display, compression = found["dataWindow"], found["displayWindow"], found["compression"]
    for name, window in (("data", data), ("display", display)):
        if window.width < 1 or window.height < 1:
            raise reader.wrong(f"its {name} window is {window.width} x {window.height}, each side must be at least 1")
    if compression >= len(COMPRESSIONS):
        raise reader.wrong(f"its compression {compression} is not known")
    tile = found.get("tiles")
    if tile is not None:
        tile = (tile[0], tile[1], tile[2] & 15)
    tiled = bool(version & 0x200) if not several else "tile" in found.get("type", "")
    if tiled and (tile is None or min(tile[:2]) < 1):
        raise reader.wrong("it is tiled, and its header lacks the size of its tiles")
    kind = found.get("type", "tiledimage" if tiled else "scanlineimage")
    part = Part(
        found.get("name", "") if several else "",
        kind,
        found["channels"],
        data,
        display,
        compression,
        tile if tiled else None,
        found,
    )
    if not part.deep:
        _check_size(reader, part)
    return part


def _check_size(reader: _Reader, part: Part) -> None:
    """Raise InputError for more pixels than the bytes after the header can hold, however well they are compressed."""
    width, height = part.data.width, part.data.height
    step = _ROWS[part.compression] if part.tile is None else part.tile[1]
    blocks = -(-height // step) * (1 if part.tile is None else -(-width // part.tile[0]))
    nbytes = sum(-(-width // c.across) * -(-height // c.down) * (2 if c.kind == "half" else 4) for c in part.channels)
    # A block takes 8 bytes in the table of offsets, and 8 before its pixels.
    if 16 * blocks > reader.left or nbytes > _RATIOS[part.compression] * reader.left:
        raise InputError(
            f"{reader.path} states a size of {width} x {height}, but its {reader.size} bytes cannot hold that many "
            "pixels"
        )
