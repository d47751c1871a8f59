"""A texture as containers hold it: mip levels of a 2-D image, a cube or an array of either, in one pixel format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from whitefurnace.files.binary import MAX_BYTES, Buffer, Source
from whitefurnace.files.packing import FORMATS, format_named

MAX_SIDE = 65536
MAX_LAYERS = 2048  # of Direct3D 11 and, at least, of Vulkan


@dataclass(frozen=True)
class Texture:
    """What a reader returns and a writer takes.

    `levels[k]` are the bytes of level k, max(1, width >> k) x max(1, height >> k) texels, without any padding: layers,
    in each its faces (+X -X +Y -Y +Z -Z), in each its rows. `layers` is 0 for what is not an array; `faces` 1 or 6.
    `key_values` are values as stored (a text ends with a NUL: `text_value`), without the key of the orientation.
    `orientation` says where a row's texels and the rows go: "rd", right and down, is the one of GL-direct faces.
    """

    format: str
    width: int
    height: int
    levels: tuple[Buffer | bytearray, ...]
    layers: int = 0
    faces: int = 1
    key_values: Mapping[str, bytes] = field(default_factory=dict)
    orientation: str = "rd"

    def __post_init__(self) -> None:
        format_named(self.format)
        if complaint := misfit(self.width, self.height, self.layers, self.faces, len(self.levels)):
            raise ValueError(f"a texture {complaint}")
        for k, level in enumerate(self.levels):
            if (got := memoryview(level).nbytes) != (wanted := self.level_bytes(k)):
                raise ValueError(f"level {k} has {got} bytes, {self.format} of this size has {wanted}")

    @property
    def cube(self) -> bool:
        return self.faces == 6

    def extent(self, k: int) -> tuple[int, int]:
        """Width and height of level k in texels."""
        return max(self.width >> k, 1), max(self.height >> k, 1)

    def level_bytes(self, k: int) -> int:
        return level_bytes(self.format, self.width, self.height, k) * max(self.layers, 1) * self.faces


def upright(texels: npt.NDArray[np.float32], orientation: str) -> npt.NDArray[np.float32]:
    """Texels (..., height, width, channels) of a texture of that orientation with their rows from the top and each row
    from the left."""
    if "u" in orientation:
        texels = texels[..., ::-1, :, :]
    return texels[..., ::-1, :] if "l" in orientation else texels


def text_value(text: str) -> bytes:
    """A key's value that is a text: UTF-8 with a NUL at its end."""
    return text.encode() + b"\0"


def level_bytes(form: str, width: int, height: int, k: int) -> int:
    """Bytes of one face of level k, whole blocks."""
    kind = FORMATS[form]
    columns, rows = (-(-max(side >> k, 1) // kind.block) for side in (width, height))
    return columns * rows * kind.size


def misfit(width: int, height: int, layers: int, faces: int, levels: int) -> str:
    """What is wrong with these numbers of a texture, to end a sentence; empty where nothing is."""
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        return f"is of {width} x {height} texels, 1 to {MAX_SIDE} a side are allowed"
    if faces not in (1, 6):
        return f"has {faces} faces, 1 or 6 are allowed"
    if faces == 6 and width != height:
        return f"has cube faces of {width} x {height} texels, they must be square"
    if not 0 <= layers <= MAX_LAYERS:
        return f"has {layers} layers, at most {MAX_LAYERS} are allowed"
    most = max(width, height).bit_length()
    if not 1 <= levels <= most:
        return f"has {levels} levels, {width} x {height} texels have 1 to {most}"
    return ""


def check_header(source: Source, form: str, width: int, height: int, layers: int, faces: int, levels: int) -> list[int]:
    """The bytes of each level that a header describes, unpacked. Raises `InputError` for what no texture has, or has
    in more than 8 GiB."""
    if complaint := misfit(width, height, layers, faces, levels):
        raise source.wrong(f"its header says that it {complaint}")
    sizes = [level_bytes(form, width, height, k) * max(layers, 1) * faces for k in range(levels)]
    if sum(sizes) > MAX_BYTES:
        raise source.wrong(f"its header describes {sum(sizes)} bytes of texels, at most {MAX_BYTES} are allowed")
    return sizes
