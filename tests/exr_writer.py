"""Writes small OpenEXR files without compression and with any header, for tests of readers ("OpenEXR File Layout")."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

TYPES = {np.dtype(np.uint32): 0, np.dtype(np.float16): 1, np.dtype(np.float32): 2}


def attribute(name: str, kind: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value


@dataclass
class Part:
    """One part: planes (rows, columns) by channel name, all of one size, and attributes by name as (type, bytes).

    window: left and top of the data window. display: left, top, right and bottom; the data window by default.
    sampling: pixels between samples, across and down, by channel name.
    """

    planes: Mapping[str, np.ndarray]
    name: str = ""
    attributes: Mapping[str, tuple[str, bytes]] = field(default_factory=dict)
    window: tuple[int, int] = (0, 0)
    display: tuple[int, int, int, int] | None = None
    sampling: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    line_order: int = 0

    @property
    def size(self) -> tuple[int, int]:
        whole = next(plane for name, plane in self.planes.items() if self.sampling.get(name, (1, 1)) == (1, 1))
        return whole.shape

    def header(self, several: bool) -> bytes:
        height, width = self.size
        left, top = self.window
        data = (left, top, left + width - 1, top + height - 1)
        channels = b"".join(
            name.encode() + b"\0" + struct.pack("<iB3xii", TYPES[plane.dtype], 0, *self.sampling.get(name, (1, 1)))
            for name, plane in sorted(self.planes.items())
        )
        found = {
            "channels": ("chlist", channels + b"\0"),
            "compression": ("compression", b"\0"),
            "dataWindow": ("box2i", struct.pack("<4i", *data)),
            "displayWindow": ("box2i", struct.pack("<4i", *(self.display or data))),
            "lineOrder": ("lineOrder", bytes([self.line_order])),
            "pixelAspectRatio": ("float", struct.pack("<f", 1)),
            "screenWindowCenter": ("v2f", struct.pack("<2f", 0, 0)),
            "screenWindowWidth": ("float", struct.pack("<f", 1)),
        }
        if several:
            found |= {
                "name": ("string", self.name.encode()),
                "type": ("string", b"scanlineimage"),
                "chunkCount": ("int", struct.pack("<i", height)),
            }
        found |= self.attributes
        return b"".join(attribute(name, *value) for name, value in found.items()) + b"\0"

    def rows(self) -> list[tuple[int, bytes]]:
        height, _ = self.size
        found = []
        for y in range(height):
            data = b""
            for name, plane in sorted(self.planes.items()):
                down = self.sampling.get(name, (1, 1))[1]
                if (self.window[1] + y) % down == 0:
                    data += np.ascontiguousarray(plane[y // down]).astype(plane.dtype.newbyteorder("<")).tobytes()
            found.append((self.window[1] + y, data))
        return found


def exr(*parts: Part) -> bytes:
    """The bytes of a file with these parts, without compression; a single one without a name is not multipart."""
    several = len(parts) > 1 or bool(parts[0].name)
    head = b"v/1\x01" + struct.pack("<I", 2 | (0x1000 if several else 0))
    head += b"".join(part.header(several) for part in parts) + (b"\0" if several else b"")
    at = len(head) + sum(8 * part.size[0] for part in parts)
    tables, chunks = b"", b""
    for number, part in enumerate(parts):
        rows = part.rows()
        offsets = {}
        for y, data in reversed(rows) if part.line_order == 1 else rows:
            offsets[y] = at
            chunk = (struct.pack("<i", number) if several else b"") + struct.pack("<ii", y, len(data)) + data
            chunks += chunk
            at += len(chunk)
        tables += b"".join(struct.pack("<Q", offsets[y]) for y, _ in rows)
    return head + tables + chunks


def planes(pixels: np.ndarray, names: Sequence[str] = "RGB") -> dict[str, np.ndarray]:
    """The channels of pixels (h, w, c) as planes by name."""
    return {name: pixels[..., k] for k, name in enumerate(names)}


def text(value: str) -> tuple[str, bytes]:
    return "string", value.encode()


def floats(kind: str, *values: float) -> tuple[str, bytes]:
    return kind, struct.pack(f"<{len(values)}f", *values)
