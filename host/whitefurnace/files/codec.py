"""Encodes floats as a texture of any pixel format, and decodes a texture to the floats that a GPU reads from it."""

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
    """A texture that was encoded from floats.

    clipped   for each level, the number of values too large for the format
    negative  for each level, the number of negative values that became 0
    """

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


def require_decoder(form: str) -> None:
    """Check that this machine can read the pixel format `form`. Raises `UnsupportedError`, which names the extra."""
    if form == ASTC:
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
    """Encode levels of floats as a texture of the pixel format `form`.

    levels: arrays ([layers,] [6,] height, width, channels) with halving sizes, level 0 first. cube: True if they have
    the axis of 6 faces. key_values, orientation: those of the `Texture`.

    Raises `InputError` for NaN, and `UnsupportedError` for signed BC6H, which is not encoded, and for "bc6hu" and
    "astc4x4hdr" where the package of the encoder is not installed.
    """
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
    """Decode level k of `texture` as a GPU reads it: float32 ([layers,] [6,] height, width, channels).

    Raises `UnsupportedError` for ASTC where astc-encoder-py is not installed.
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
