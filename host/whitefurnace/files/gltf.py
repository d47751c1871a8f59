"""Reads the JSON, buffers, accessors and images of .glb and .gltf files from untrusted sources.

Every size is checked against the bytes in the file before memory is allocated. `whitefurnace.scenes.materials`
interprets the contents.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import FileError, InputError
from whitefurnace.files.binary import load
from whitefurnace.files.gltf_lights import _document, _Images
from whitefurnace.files.image import MAX_PIXELS, _check_size, _complaint, _reason
from whitefurnace.files.inputs import head_of, plain_name
from whitefurnace.files.integrity import check_file
from whitefurnace.files.jsontext import Reader
from whitefurnace.files.png import _scratch_file
from whitefurnace.text import printable

MAX_ELEMENTS = 1 << 26
"""Largest number of elements in an accessor: as pairs of float64 they take a gigabyte."""

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

_MAGIC = (
    (".png", re.compile(rb"\x89PNG\r\n\x1a\n")),
    (".jpg", re.compile(rb"\xff\xd8\xff")),
    (".webp", re.compile(rb"RIFF....WEBP", re.DOTALL)),
)
_BAND = 8 << 20

Codes = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


class Gltf:
    """An opened glTF file. `document` is its JSON; `take` reads values from it and checks their type and range."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open the file. Raises `FileError` where it cannot be read, and `InputError` where it is not glTF 2."""
        self.path = Path(path)
        self.source = load(path)
        self.take = Reader(self.source)
        self.document, binary = _document(self.source)
        asset = self.take.object(self.document.get("asset"), "asset")
        version = self.take.text(asset.get("version"), "asset.version")
        if not version.startswith("2."):
            raise self.source.wrong(f"it is glTF {version[:20]!r}, 2.0 is read")
        self._pieces = _Images(self.take, self.document, binary, self.path.parent)

    def objects(self, name: str, most: int) -> list[dict[str, Any]]:
        """Return an array of at most `most` objects at the top of the document; empty where it is missing."""
        found = self.take.array(self.document.get(name, []), name, 0, most)
        return [self.take.object(one, f"{name}[{k}]") for k, one in enumerate(found)]

    def index(self, value: Any, count: int, what: str) -> int:
        """Check that `value` is an index below `count`. Raises `InputError`."""
        if not count:
            raise self.source.wrong(f"{what} is {value!r:.40}, there is none")
        return self.take.whole(value, what, 0, count - 1)

    # ---------------------------------------------------------------------------------------- accessors

    def accessor(self, k: int, types: tuple[str, ...], what: str) -> npt.NDArray[Any] | None:
        """Return the values of accessor k, (count, n); normalized integers become floats.

        Returns None for compressed and sparse accessors, which are not read. Raises `InputError` where the accessor is
        not of one of `types` or reaches beyond its buffer.
        """
        accessors = self.take.array(self.document.get("accessors", []), "accessors", 0, 1 << 20)
        k = self.index(k, len(accessors), what)
        name = f"accessor {k}"
        one = self.take.object(accessors[k], name)
        kind = self.take.text(one.get("type"), f"the type of {name}")
        component = self.take.whole(one.get("componentType"), f"componentType of {name}", 0, 1 << 16)
        if kind not in types or component not in COMPONENTS:
            raise self.source.wrong(
                f"{name}, {what}, is of {plain_name(kind, 20)} and componentType {component}; "
                f"{' or '.join(types)} of {', '.join(map(str, COMPONENTS))} were expected"
            )
        count = self.take.whole(one.get("count"), f"count of {name}", 1, MAX_ELEMENTS)
        dtype, n = np.dtype(COMPONENTS[component]), TYPES[kind]
        if "bufferView" not in one or "sparse" in one:
            return None
        view = self._view(one["bufferView"], name)
        if view is None:
            return None
        data, stride = view
        stride = stride or n * dtype.itemsize
        offset = self.take.whole(one.get("byteOffset", 0), f"byteOffset of {name}", 0, 1 << 40)
        end = offset + stride * (count - 1) + n * dtype.itemsize
        if stride < n * dtype.itemsize or end > len(data):
            raise self.source.wrong(
                f"{name}, {what}, has {count} elements of {n * dtype.itemsize} bytes, {stride} "
                f"apart, up to byte {end} of a bufferView of {len(data)}"
            )
        values = np.ndarray((count, n), dtype, data, offset, (stride, dtype.itemsize))
        if one.get("normalized") is True and dtype.kind != "f":
            return np.maximum(values / np.float64(np.iinfo(dtype).max), -1.0)
        return values

    def _view(self, value: Any, what: str) -> tuple[memoryview, int] | None:
        """Return the bytes and the stride (0: packed) of a bufferView; None for a compressed one."""
        views = self._pieces._views
        k = self.index(value, len(views), f"the bufferView of {what}")
        name = f"bufferView {k}"
        view = self.take.object(views[k], name)
        if "EXT_meshopt_compression" in self.take.object(view.get("extensions", {}), f"extensions of {name}"):
            return None
        buffer = self.index(view.get("buffer"), len(self._pieces._buffers), f"the buffer of {name}")
        data = self._buffer(buffer)
        at = self.take.whole(view.get("byteOffset", 0), f"byteOffset of {name}", 0, 1 << 40)
        length = self.take.whole(view.get("byteLength"), f"byteLength of {name}", 1, 1 << 40)
        if at + length > len(data):
            raise self.source.wrong(f"{name} takes bytes {at} to {at + length}, buffer {buffer} has {len(data)}")
        return data[at : at + length], self.take.whole(view.get("byteStride", 0), f"byteStride of {name}", 0, 252)

    def _buffer(self, k: int) -> memoryview:
        buffer = self.take.object(self._pieces._buffers[k], f"buffer {k}")
        stated = self.take.whole(buffer.get("byteLength"), f"byteLength of buffer {k}", 1, 1 << 40)
        try:
            data = self._pieces._buffer(k)
        except FileError as error:  # a scene without its buffers is not valid
            raise self.source.wrong(f"buffer {k} is missing: {printable(str(error))}") from None
        if stated > len(data):
            raise self.source.wrong(f"buffer {k} should have {stated} bytes, {len(data)} are there")
        return data[:stated]

    # ---------------------------------------------------------------------------------------- images

    def bands(self, k: int, what: str) -> Iterator[tuple[int, int, int, Codes]]:
        """Read the codes of image k in bands of rows: (height, width, first row, codes (rows, width, 4)).

        The codes have 8 or 16 bits. Grey fills all three colours, and a missing alpha is the largest code.
        Raises `InputError`.
        """
        image = self.take.object(self._pieces._images[self.index(k, len(self._pieces._images), what)], f"image {k}")
        try:
            data = self._pieces._bytes(k)
        except FileError as error:
            raise self.source.wrong(f"image {k}, {what}, is missing: {printable(str(error))}") from None
        name = f"{self.source.name}: image {k}, {what},"
        self.take.text(image.get("mimeType", ""), f"the mimeType of image {k}")
        head = bytes(data[:12])  # decides what it is, since mimeType is often wrong and may be left out for a URI
        suffix = next((suffix for suffix, magic in _MAGIC if magic.match(head)), None)
        if suffix is None:
            raise InputError(f"{name} is neither PNG, JPEG nor WebP")
        with _scratch_file(suffix) as path:
            path.write_bytes(data)
            try:
                yield from _decoded(path, len(data))
            except InputError as error:
                raise InputError(str(error).replace(str(path), name)) from None
            except MemoryError:
                raise InputError(f"{name} needs more memory than this machine gives") from None


def _decoded(path: Path, size: int) -> Iterator[tuple[int, int, int, Codes]]:
    import OpenImageIO as oiio

    check_file(path, size, head_of(path, 4096))
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), hints)
    complaint = _complaint(oiio)
    if source is None:
        raise InputError(f"{path} cannot be decoded: {_reason(complaint, path)}")
    try:
        spec = source.spec()
        _check_size(spec, path, size, source.format_name())
        height, width, channels = spec.height, spec.width, spec.nchannels
        if channels not in (1, 2, 3, 4) or height * width > MAX_PIXELS // 4:
            raise InputError(
                f"{path} has {width} x {height} pixels of {channels} channels; textures of 1 to 4 and at "
                f"most {MAX_PIXELS // 4} pixels are read"
            )
        kind = "uint16" if str(spec.format) == "uint16" else "uint8"
        rows = max(1, _BAND // (width * channels * 2))
        for y in range(0, height, rows):
            stop = min(y + rows, height)
            band = source.read_scanlines(0, 0, y, stop, 0, 0, channels, kind)
            if band is None or source.has_error:
                raise InputError(f"{path} is truncated or corrupted: {_reason(_complaint(source), path)}")
            yield height, width, y, _four(np.asarray(band).reshape(stop - y, width, channels))
    finally:
        source.close()
        _complaint(source)


def _four(codes: Codes) -> Codes:
    """Extend codes of 1 to 4 channels to RGBA."""
    channels = codes.shape[2]
    out = np.full((*codes.shape[:2], 4), np.iinfo(codes.dtype).max, codes.dtype)
    out[..., :3] = codes[..., :1] if channels < 3 else codes[..., :3]
    if channels in (2, 4):
        out[..., 3] = codes[..., channels - 1]
    return out
