"""A texture as containers hold it: mip levels of a 2-D image, a cube or an array of either, in one pixel format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from whitefurnace.files.binary import MAX_BYTES, Buffer, Source
from whitefurnace.files.packing import FORMATS, Packed, format_named, pack, unpack

MAX_SIDE = 65536
MAX_LAYERS = 2048  # of Direct3D 11 and, at least, of Vulkan
BC6H = ("bc6hu", "bc6hs")
ASTC = "astc4x4hdr"


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

    def decode(self, k: int) -> npt.NDArray[np.float32]:
        """Level k as a GPU reads it: float32 ([layers,] [6,] height, width, channels). Raises `UnsupportedError` for
        ASTC without astc-encoder-py."""
        width, height = self.extent(k)
        shape = (*([self.layers] if self.layers else []), *([6] if self.cube else []), height, width)
        if self.format in BC6H:
            from whitefurnace.files.bc6h import decode_bc6h  # which makes textures

            return decode_bc6h(self.format, memoryview(self.levels[k]), shape)
        if self.format == ASTC:
            from whitefurnace.files.astc import decode_astc  # loaded when needed

            return decode_astc(memoryview(self.levels[k]), shape)
        return unpack(self.format, memoryview(self.levels[k]), shape)


def upright(texels: npt.NDArray[np.float32], orientation: str) -> npt.NDArray[np.float32]:
    """Texels (..., height, width, channels) of a texture of that orientation with their rows from the top and each row
    from the left."""
    if "u" in orientation:
        texels = texels[..., ::-1, :, :]
    return texels[..., ::-1, :] if "l" in orientation else texels


@dataclass(frozen=True)
class Encoded:
    """A texture made of floats, and per level how many values were `clipped` and how many `negative` became 0."""

    texture: Texture
    clipped: tuple[int, ...]
    negative: tuple[int, ...]


def encode(
    form: str,
    levels: Sequence[npt.ArrayLike],
    *,
    cube: bool = False,
    key_values: Mapping[str, bytes] | None = None,
    orientation: str = "rd",
) -> Encoded:
    """A texture of the format `form` from `levels` of floats, each ([layers,] [6,] height, width, channels); the 6 are
    there exactly where `cube` is true. Raises `InputError` for NaN, `UnsupportedError` for signed BC6H, which is not
    encoded, for `bc6hu` without ispc-texcomp and for `astc4x4hdr` without astc-encoder-py."""
    arrays = [np.asarray(level) for level in levels]
    if not arrays:
        raise ValueError("a texture has at least one level")
    axes = 4 if cube else 3
    first = arrays[0]
    if first.ndim not in (axes, axes + 1) or (cube and first.shape[-4] != 6):
        six = "6, " if cube else ""
        raise ValueError(f"levels of shape {first.shape} are not ([layers,] {six}height, width, channels)")
    height, width = first.shape[-3:-1]
    packed = []
    for k, array in enumerate(arrays):
        if array.shape[:-3] != first.shape[:-3] or array.shape[-3:-1] != (max(height >> k, 1), max(width >> k, 1)):
            raise ValueError(f"level {k} of shape {array.shape} does not follow level 0 of shape {first.shape}")
        packed.append(_pack(form, array))
    texture = Texture(
        form, width, height, tuple(p.data.tobytes() for p in packed), first.shape[0] if first.ndim > axes else 0,
        6 if cube else 1, dict(key_values or {}), orientation,
    )
    return Encoded(texture, tuple(p.clipped for p in packed), tuple(p.negative for p in packed))


def _pack(form: str, array: npt.NDArray[np.generic]) -> Packed:
    if form == "bc6hu":
        from whitefurnace.files.bc6h import encode_bc6h  # which makes textures

        return encode_bc6h(array)
    if form == ASTC:
        from whitefurnace.files.astc import encode_astc

        return encode_astc(array)
    return pack(form, array)


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
