"""Turns floats into a texture of any pixel format, and a texture into the floats that a GPU reads of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from whitefurnace.files.packing import Packed, pack, unpack
from whitefurnace.files.texture import Texture

BC6H = ("bc6hu", "bc6hs")

ASTC = "astc4x4hdr"


@dataclass(frozen=True)
class Encoded:
    """A texture made of floats, and per level how many values were `clipped` and how many `negative` became 0."""

    texture: Texture
    clipped: tuple[int, ...]
    negative: tuple[int, ...]


def require_encoder(form: str) -> None:
    """Check that this machine can write the pixel format `form`, before anything is computed for it.

    Raises `UnsupportedError` with the sentence that names the extra: for "bc6hu" without ispc-texcomp, for
    "astc4x4hdr" without astc-encoder-py. Other formats need no package.
    """
    if form == "bc6hu":
        from whitefurnace.files.bc6h import library  # loaded when needed

        library()
    elif form == ASTC:
        from whitefurnace.files.astc import library

        library()


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
        form,
        width,
        height,
        tuple(p.data.tobytes() for p in packed),
        first.shape[0] if first.ndim > axes else 0,
        6 if cube else 1,
        dict(key_values or {}),
        orientation,
    )
    return Encoded(texture, tuple(p.clipped for p in packed), tuple(p.negative for p in packed))


def _pack(form: str, array: npt.NDArray[np.generic]) -> Packed:
    if form == "bc6hu":
        from whitefurnace.files.bc6h import encode_bc6h  # loaded when needed

        return encode_bc6h(array)
    if form == ASTC:
        from whitefurnace.files.astc import encode_astc

        return encode_astc(array)
    return pack(form, array)


def decode(texture: Texture, k: int) -> npt.NDArray[np.float32]:
    """Level k of `texture` as a GPU reads it: float32 ([layers,] [6,] height, width, channels).

    Raises `UnsupportedError` for ASTC without astc-encoder-py.
    """
    width, height = texture.extent(k)
    shape = (*([texture.layers] if texture.layers else []), *([6] if texture.cube else []), height, width)
    data = memoryview(texture.levels[k])
    if texture.format in BC6H:
        from whitefurnace.files.bc6h import decode_bc6h  # loaded when needed

        return decode_bc6h(texture.format, data, shape)
    if texture.format == ASTC:
        from whitefurnace.files.astc import decode_astc

        return decode_astc(data, shape)
    return unpack(texture.format, data, shape)
