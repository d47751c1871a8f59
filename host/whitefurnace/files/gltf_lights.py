"""Reads and writes glTF's EXT_lights_image_based [KhronosGroup/glTF, extensions/2.0/Vendor/EXT_lights_image_based].

A light is a prefiltered cube as RGBD faces in PNG, and irradiance as nine coefficients. Lights are written as one
.gltf with the images inside; .gltf and .glb files of other programs are read too.

The extension asks for every image "flipped about its vertical axis to correspond with the way glTF references texture
space". Its loader in Babylon.js expects rows from the bottom up, so rows are written and read in that order.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import WhitefurnaceError
from whitefurnace.files import memory
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.binary import MAX_BYTES, Source, load
from whitefurnace.files.inputs import inside, plain_name
from whitefurnace.files.jsontext import Reader, parse_object
from whitefurnace.files.rgbd import MAX_SIZE, Level, check_chain, decode_face, encode_faces
from whitefurnace.text import shortened

NAME = "EXT_lights_image_based"
GLB_MAGIC = b"glTF"
_JSON, _BIN = 0x4E4F534A, 0x004E4942  # kinds of GLB chunks [glTF 2.0, 4.4.3]
MAX_LIGHTS = 16
MOST_INTENSITY = 1e12
"""Largest factor of a light's radiance that is read; RGBD holds values up to 255, and the product must be finite."""

MAX_IMAGES = 1 << 16
_MAX_JSON = 1 << 30
_DATA = "data:"


@dataclass(frozen=True, eq=False)
class GltfLight:
    """One image-based light.

    `levels[k]` is float32 (6, n >> k, n >> k, 3), GL-direct, for roughness r = k/(levels − 1). The chain may stop
    before one texel (near 16); engines read no mips after its last level. `coefficients` (9, 3) are those of
    irradiance, A_l·L_lm with A = π, 2π/3, π/4, in the order L00 L1−1 L10 L11 L2−2 L2−1 L20 L21 L22. Babylon.js 9
    expects the sign (−1)^m of Condon and Shortley in them, which the extension does not specify. `rotation` is a
    quaternion x y z w.
    """

    levels: tuple[Level, ...]
    coefficients: npt.NDArray[np.float64]
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    intensity: float = 1.0
    name: str = ""

    def __post_init__(self) -> None:
        if complaint := check_chain(self.levels, whole=False):
            raise ValueError(f"an image-based light is wrong: {complaint}")
        if np.shape(self.coefficients) != (9, 3):
            raise ValueError(f"irradiance coefficients of shape {np.shape(self.coefficients)} are not (9, 3)")

    @property
    def size(self) -> int:
        """Texels a side of level 0: `specularImageSize`."""
        return self.levels[0].shape[1]


def write_gltf_lights(
    path: str | os.PathLike[str], light: GltfLight | Sequence[GltfLight], *, into: Transaction | None = None
) -> tuple[int, int]:
    """Write one .gltf with the images inside; scene k is lit by light k. The same lights give the same bytes.

    Returns the number of values clipped to 255, the largest that RGBD holds, and the number of negative values set
    to 0. Raises `InputError` for NaN, and `FileError` where the file cannot be written.
    """
    text, clipped, negative = gltf_text([light] if isinstance(light, GltfLight) else light)
    write_pieces(path, [text.encode("ascii")], into)
    return clipped, negative


def gltf_text(lights: Sequence[GltfLight]) -> tuple[str, int, int]:
    """Return the text of the file and the two counts of `write_gltf_lights`. Raises `InputError` for NaN."""
    if not 1 <= len(lights) <= MAX_LIGHTS:
        raise ValueError(f"there are {len(lights)} lights, 1 to {MAX_LIGHTS} are written")
    images: list[dict[str, str]] = []
    entries = []
    clipped = negative = 0
    for light in lights:
        mips = []
        for level in light.levels:
            faces, over, below = encode_faces(level)
            clipped, negative = clipped + over, negative + below
            mips.append(list(range(len(images), len(images) + 6)))
            images += [{"uri": f"{_DATA}image/png;base64,{base64.b64encode(face).decode()}"} for face in faces]
        entries.append(
            {
                **({"name": light.name} if light.name else {}),
                "rotation": list(light.rotation),
                "intensity": light.intensity,  # without it Babylon.js multiplies by undefined, which is NaN
                "irradianceCoefficients": np.asarray(light.coefficients, np.float64).tolist(),
                "specularImageSize": light.size,
                "specularImages": mips,
            }
        )
    document = {
        "asset": {"version": "2.0", "generator": "whitefurnace"},
        "extensionsUsed": [NAME],
        "extensions": {NAME: {"lights": entries}},
        "scene": 0,
        "scenes": [{"extensions": {NAME: {"light": k}}} for k in range(len(lights))],
        "images": images,
    }
    return json.dumps(document, separators=(",", ":"), allow_nan=False), clipped, negative


def read_gltf_lights(path: str | os.PathLike[str]) -> tuple[GltfLight, ...]:
    """Read the lights of a .gltf or .glb, whose images and buffers are in the file or in files of its folder.

    Raises `FileError` for a file that cannot be read, and `InputError` for one that is not valid, has no image-based
    light, or refers to a file outside its folder.
    """
    return parse_gltf_lights(load(path), Path(path).parent)


def parse_gltf_lights(source: Source, folder: Path | None = None) -> tuple[GltfLight, ...]:
    """Parse the lights in the bytes of a file.

    Other files that it refers to are read from `folder`, and refused where that is None. Raises `FileError` and
    `InputError`.
    """
    document, binary = _document(source)
    take = Reader(source)
    images = _Images(take, document, binary, folder)
    entries = _entries(take, document)
    _neighbours(images, entries)  # all of them are found before the first is read
    texels = sum(6 * (size >> mip) ** 2 for _, size, mips in entries for mip in range(len(mips)))
    if 12 * texels > MAX_BYTES:
        raise source.wrong(f"its lights have {12 * texels} bytes of texels, at most {MAX_BYTES} are allowed")
    # Faces are kept while the lights are made, since several may name one image.
    memory.require(3 * len(source) + 24 * texels, f"its {texels} texels as floats", source.name, len(source))
    lights = []
    for k, (light, size, mips) in enumerate(entries):
        what = f"light {k}"
        coefficients = take.rows(light.get("irradianceCoefficients"), f"irradianceCoefficients of {what}", 9)
        x, y, z, w = [
            take.number(value, f"a number of rotation of {what}")
            for value in take.array(light.get("rotation", [0, 0, 0, 1]), f"rotation of {what}", 4, 4)
        ]
        if not abs(math.hypot(x, y, z, w) - 1) <= 1e-3:  # the rounding of a quaternion's digits
            raise source.wrong(f"rotation of {what} has the length {math.hypot(x, y, z, w):g}, a quaternion has 1")
        intensity = take.number(light.get("intensity", 1), f"intensity of {what}")
        if not 0 <= intensity <= MOST_INTENSITY:
            raise source.wrong(f"intensity of {what} is {intensity:g}, 0 to {MOST_INTENSITY:g} is read")
        name = take.text(light.get("name", ""), f"name of {what}")
        levels = [
            np.stack([images.face(index, size >> mip, _face(face, mip, what)) for face, index in enumerate(six)])
            for mip, six in enumerate(mips)
        ]
        lights.append(GltfLight(tuple(levels), coefficients, (x, y, z, w), intensity, name))
    return tuple(lights)


def gltf_light_files(path: str | os.PathLike[str]) -> dict[str, Path]:
    """Return the files that reading the lights of a .gltf or .glb opens, by their names relative to its folder.

    The first is the glTF itself. Images and buffers that no light uses are not among them. No other file is opened.
    Raises the errors of `read_gltf_lights`.
    """
    path = Path(path)
    source = load(path)
    document, binary = _document(source)
    take = Reader(source)
    return {path.name: path, **_neighbours(_Images(take, document, binary, path.parent), _entries(take, document))}


_Entry = tuple[dict[str, Any], int, list[list[Any]]]


def _entries(take: Reader, document: Mapping[str, Any]) -> list[_Entry]:
    """Return for each light its JSON, the side of its level 0 in texels, and its mips of six indices of images."""
    extension = take.object(document.get("extensions", {}), "extensions").get(NAME)
    if extension is None:
        raise take.source.wrong(f"it is a glTF without {NAME}")
    found = take.array(take.object(extension, NAME).get("lights"), f"{NAME}.lights", 1, MAX_LIGHTS)
    return [_entry(take, entry, f"light {k}") for k, entry in enumerate(found)]


def _face(face: int, mip: int, what: str) -> str:
    """Return the name of a face for error messages."""
    return f"face {face} of mip {mip} of {what}"


def _neighbours(images: _Images, entries: Sequence[_Entry]) -> dict[str, Path]:
    """Return the files that hold the faces of lights, by their names relative to the glTF's folder."""
    found: dict[str, Path] = {}
    for k, (_, _, mips) in enumerate(entries):
        for mip, six in enumerate(mips):
            for face, index in enumerate(six):
                found |= images.file(index, _face(face, mip, f"light {k}"))
    return found


def _entry(take: Reader, entry: Any, what: str) -> _Entry:
    light = take.object(entry, what)
    size = take.whole(light.get("specularImageSize"), f"specularImageSize of {what}", 1, MAX_SIZE)
    if size & (size - 1):
        raise take.source.wrong(f"specularImageSize of {what} is {size}, a power of two was expected")
    mips = take.array(light.get("specularImages"), f"specularImages of {what}", 1, size.bit_length())
    return light, size, [take.array(faces, f"mip {mip} of {what}", 6, 6) for mip, faces in enumerate(mips)]


def _document(source: Source) -> tuple[dict[str, Any], memoryview | None]:
    """Return the JSON of a .gltf or .glb, and the binary chunk of a .glb."""
    if bytes(source.view[:4]) != GLB_MAGIC:
        if len(source) > _MAX_JSON:
            raise source.wrong(f"it has {len(source)} bytes, JSON of glTF has at most {_MAX_JSON}")
        return _json(source, source.view), None
    version, total = source.integers("2I", 4, "the GLB header")
    if version != 2:
        raise source.wrong(f"it is a GLB of version {version}, 2 is read")
    source.piece(0, total, "what the GLB header says")
    document: dict[str, Any] | None = None
    binary: memoryview | None = None
    at = 12
    while at < total:
        what = f"the GLB chunk at byte {at}"
        length, kind = source.integers("2I", at, what)
        if at + 8 + length > total:
            raise source.wrong(f"{what} has {length} bytes and reaches beyond the {total} of the GLB")
        body = source.piece(at + 8, length, what)
        if document is None:
            if kind != _JSON or length > _MAX_JSON:
                raise source.wrong("the first chunk of a GLB must be its JSON")
            document = _json(source, body)
        elif kind == _BIN and binary is None:
            binary = body
        at += 8 + length
    if document is None:
        raise source.wrong("it is a GLB without JSON")
    return document, binary


def _json(source: Source, data: memoryview) -> dict[str, Any]:
    try:
        text = bytes(data).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise source.wrong("it is neither GLB nor a text in UTF-8") from None
    return parse_object(source, text, "its JSON")


class _Images:
    """Images of a glTF by index. Each image is decoded once, and each buffer or file is loaded once.

    Nothing is opened but what is asked for. folder: where its other files are; None where it must have none.
    """

    def __init__(
        self, take: Reader, document: Mapping[str, Any], binary: memoryview | None, folder: Path | None
    ) -> None:
        self._take, self._source, self._binary, self._folder = take, take.source, binary, folder
        self._images = take.array(document.get("images", []), "images", 0, MAX_IMAGES)
        self._views = take.array(document.get("bufferViews", []), "bufferViews", 0, MAX_IMAGES)
        self._buffers = take.array(document.get("buffers", []), "buffers", 0, MAX_IMAGES)
        self._faces: dict[tuple[int, int], Level] = {}
        self._loaded: dict[int, memoryview] = {}
        for thing, listed in (("image", self._images), ("buffer", self._buffers)):
            for k, one in enumerate(listed):
                if isinstance(one, dict) and _climbs(one.get("uri")):
                    # Nothing would be read through it, yet a file that tries is not one to trust.
                    raise self._outside(_decoded_name(one["uri"]), f"{thing} {k}")

    def face(self, index: Any, side: int, what: str) -> Level:
        """Return image `index` as a face of side x side texels; `what` names the face in error messages."""
        k = self._index(index, len(self._images), "image", what)
        if (k, side) not in self._faces:
            piece = Source(self._bytes(k), f"{self._source.name}, image {k} ({what}),")
            self._faces[k, side] = decode_face(piece, side)
        return self._faces[k, side]

    def file(self, index: Any, what: str) -> dict[str, Path]:
        """Return the file that holds image `index`, by its name relative to the glTF's folder; empty for the glTF."""
        k = self._index(index, len(self._images), "image", what)
        image = self._take.object(self._images[k], f"image {k}")
        if "uri" in image:
            return self._place(image["uri"], f"image {k}")
        buffer = self._take.object(self._buffers[self._view(image, k)[1]], "a buffer")
        return self._place(buffer["uri"], f"buffer {self._view(image, k)[1]}") if "uri" in buffer else {}

    def _index(self, value: Any, count: int, thing: str, what: str) -> int:
        if not count:
            raise self._source.wrong(f"{what} names an {thing}, there is none")
        return self._take.whole(value, f"the {thing} of {what}", 0, count - 1)

    def _bytes(self, k: int) -> memoryview:
        image = self._take.object(self._images[k], f"image {k}")
        if "uri" in image:
            return self._uri(image["uri"], f"image {k}")
        number, buffer = self._view(image, k)
        what, view = f"bufferView {number}", self._views[number]
        data = self._buffer(buffer)
        at = self._take.whole(view.get("byteOffset", 0), f"byteOffset of {what}", 0, len(data))
        length = self._take.whole(view.get("byteLength"), f"byteLength of {what}", 1, len(data))
        if at + length > len(data):
            raise self._source.wrong(f"{what} takes bytes {at} to {at + length}, buffer {buffer} has {len(data)}")
        return data[at : at + length]

    def _view(self, image: Mapping[str, Any], k: int) -> tuple[int, int]:
        """Return the numbers of the bufferView of image k and of its buffer."""
        number = self._index(image.get("bufferView"), len(self._views), "bufferView", f"image {k}")
        view = self._take.object(self._views[number], f"bufferView {number}")
        return number, self._index(view.get("buffer"), len(self._buffers), "buffer", f"bufferView {number}")

    def _buffer(self, k: int) -> memoryview:
        if k not in self._loaded:
            buffer = self._take.object(self._buffers[k], f"buffer {k}")
            if "uri" in buffer:
                data = self._uri(buffer["uri"], f"buffer {k}")
            elif k == 0 and self._binary is not None:
                data = self._binary
            else:
                raise self._source.wrong(f"buffer {k} has no uri, and the file no binary chunk for it")
            self._loaded[k] = data
        return self._loaded[k]

    def _uri(self, value: Any, what: str) -> memoryview:
        """Return the bytes of a data URI, or of a file in the folder of the glTF."""
        uri = self._take.text(value, f"the uri of {what}")
        if uri[: len(_DATA)].lower() == _DATA:
            head, comma, body = uri.partition(",")
            if not comma or not head.lower().endswith(";base64"):
                raise self._source.wrong(f"the data URI of {what} is not in base64")
            try:
                return memoryview(base64.b64decode(body, validate=True))
            except (binascii.Error, ValueError):
                raise self._source.wrong(f"the data URI of {what} is not valid base64") from None
        (path,) = self._place(uri, what).values()
        try:
            return load(path).view
        except WhitefurnaceError as error:  # the name may hold line breaks
            raise type(error)(shortened(str(error), 300)) from None

    def _place(self, value: Any, what: str) -> dict[str, Path]:
        """Return the file of a URI by its name relative to the folder of the glTF; empty for a data URI."""
        uri = self._take.text(value, f"the uri of {what}")
        if uri[: len(_DATA)].lower() == _DATA:
            return {}
        name = _decoded_name(uri)
        try:
            if self._folder is None:
                raise ValueError
            path = inside(self._folder, name)
        except ValueError:
            raise self._outside(name, what) from None
        return {os.path.normpath(name): path}

    def _outside(self, name: str, what: str) -> WhitefurnaceError:
        return self._source.wrong(f"the uri of {what}, {plain_name(name)!r}, is not a file in the folder of the glTF")


def _decoded_name(uri: str) -> str:
    """Return the name of a file in a URI, with its percent signs decoded."""
    return os.fsdecode(unquote_to_bytes(uri.encode("utf-8", "surrogatepass")))


def _climbs(uri: Any) -> bool:
    """Return whether a URI is a relative name that leads out of its folder by `..`."""
    if not isinstance(uri, str) or uri[: len(_DATA)].lower() == _DATA:
        return False
    depth = 0
    for part in _decoded_name(uri).replace("\\", "/").split("/"):
        depth += {"..": -1, ".": 0, "": 0}.get(part, 1)
        if depth < 0:
            return True
    return False
