"""The texture type of all containers: mip levels of a 2-D image, a cube, or an array of either, in one pixel format."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.files import memory
from whitefurnace.files.binary import MAX_BYTES, Buffer, Source
from whitefurnace.files.meaning import Meaning
from whitefurnace.files.packing import FORMATS, format_named

MAX_SIDE = 65536
MAX_LAYERS = 2048  # the limit of Direct3D 11, and the least limit of Vulkan


class Levels(Sequence[Buffer | bytearray]):
    """Levels of a file that are unpacked when they are asked for, and not kept: memory holds one at a time."""

    def __init__(self, count: int, unpack: Callable[[int], Buffer | bytearray]) -> None:
        self._count, self._unpack = count, unpack

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: Any) -> Any:
        """Return the bytes of level k. Raises `InputError` where they are not valid."""
        if not -self._count <= k < self._count:
            raise IndexError(f"there is no level {k} of {self._count}")
        return self._unpack(k % self._count)


@dataclass(frozen=True)
class Texture:
    """A texture as readers return it and writers take it.

    format       name of the pixel format, a key of `packing.FORMATS`
    levels       `levels[k]` are the bytes of level k, max(1, width >> k) x max(1, height >> k) texels without padding;
                 the order is layers, in each its faces (+X -X +Y -Y +Z -Z), in each its rows; `Levels` of a reader may
                 raise `InputError` when they are unpacked
    layers       0 where the texture is not an array
    faces        1, or 6 for a cube
    key_values   values as stored (a text ends with a NUL: `text_value`), without the key of the orientation
    orientation  direction of texels in a row and of the rows; "rd", right and down, is that of GL-direct faces
    meaning      what the file says of the numbers beyond their format
    notices      sentences about what was assumed and applied
    """

    format: str
    width: int
    height: int
    levels: Sequence[Buffer | bytearray]
    layers: int = 0
    faces: int = 1
    key_values: Mapping[str, bytes] = field(default_factory=dict)
    orientation: str = "rd"
    meaning: Meaning = field(default_factory=Meaning)
    notices: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        format_named(self.format)
        if complaint := misfit(self.width, self.height, self.layers, self.faces, len(self.levels)):
            raise ValueError(f"a texture {complaint}")
        for k, level in enumerate(() if isinstance(self.levels, Levels) else self.levels):
            if (got := memoryview(level).nbytes) != (wanted := self.level_bytes(k)):
                raise ValueError(f"level {k} has {got} bytes, {self.format} of this size has {wanted}")

    @property
    def cube(self) -> bool:
        """True if the texture is a cube or an array of cubes."""
        return self.faces == 6

    def extent(self, k: int) -> tuple[int, int]:
        """Return the width and height of level k in texels."""
        return max(self.width >> k, 1), max(self.height >> k, 1)

    def level_bytes(self, k: int) -> int:
        """Return the bytes of level k, all layers and faces."""
        return level_bytes(self.format, self.width, self.height, k) * max(self.layers, 1) * self.faces


def upright(texels: npt.NDArray[np.float32], orientation: str) -> npt.NDArray[np.float32]:
    """Turn texels (..., height, width, channels) of a texture with `orientation` to rows from the top and left."""
    if "u" in orientation:
        texels = texels[..., ::-1, :, :]
    return texels[..., ::-1, :] if "l" in orientation else texels


def text_value(text: str) -> bytes:
    """Encode a text as the value of a key: UTF-8 that ends with a NUL; what is not Unicode in a name is escaped."""
    return text.encode("utf-8", "backslashreplace") + b"\0"


def level_bytes(form: str, width: int, height: int, k: int) -> int:
    """Return the bytes of one face of level k, in whole blocks."""
    kind = FORMATS[form]
    columns, rows = (-(-max(side >> k, 1) // kind.block) for side in (width, height))
    return columns * rows * kind.size


def misfit(width: int, height: int, layers: int, faces: int, levels: int) -> str:
    """Return the error in the dimensions of a texture as the end of a sentence; an empty text where there is none."""
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


def check_header(
    source: Source, form: str, width: int, height: int, layers: int, faces: int, levels: int, *, packed: bool = False
) -> list[int]:
    """Return the unpacked bytes of each level that a header describes.

    packed: whether a level is unpacked to memory of its own before it is decoded.
    Raises `InputError` for dimensions that no texture has, for more than 8 GiB, and where the largest level, decoded,
    takes more memory than the file may take.
    """
    if complaint := misfit(width, height, layers, faces, levels):
        raise source.wrong(f"its header says that it {complaint}")
    sizes = [level_bytes(form, width, height, k) * max(layers, 1) * faces for k in range(levels)]
    if sum(sizes) > MAX_BYTES:
        raise source.wrong(f"its header describes {sum(sizes)} bytes of texels, at most {MAX_BYTES} are allowed")
    texels = width * height * max(layers, 1) * faces
    many = " x ".join(str(n) for n in (width, height, max(layers, 1) * faces) if n > 1) or "1"
    memory.require(
        len(source) + sizes[0] * packed + 4 * FORMATS[form].channels * texels,
        f"its {many} texels as floats",
        source.name,
        len(source),
    )
    return sizes
