"""Encodes and decodes ASTC blocks of 4 x 4 HDR texels with Arm's codec, the optional package `astc-encoder-py`."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError, UnsupportedError
from whitefurnace.files.packing import FORMATS, Packed, pack

SIDE = 4
QUALITY = 98.0
"""astcenc's preset `-thorough`."""


# astc-encoder turns the string that it is given into capitals in place, and with it every equal literal of the process.
_RGBA, _RGB1 = "RGBA", "RGB1"


def encode_astc(values: npt.ArrayLike, *, quality: float = QUALITY) -> Packed:
    """Encode `values` (..., height, width, 3 | 4) as ASTC HDR blocks: uint8 (..., blocks down, blocks across, 16).

    quality: astcenc's, 0 to 100. A fourth channel is HDR too. Values too large for a half become 65504, and negative
    values, which HDR blocks cannot hold, become 0; `Packed` counts both.

    Raises `InputError` for NaN, and `UnsupportedError` for a quality out of range and where astc-encoder-py is not
    installed.
    """
    if not 0 <= quality <= 100:
        raise UnsupportedError(f"a quality of {quality:g} of ASTC is not between 0 and 100")
    astc = library()
    array = np.asarray(values)
    if array.ndim < 3 or array.shape[-1] not in (3, 4):
        raise ValueError(f"values of shape {array.shape} are not (..., height, width, 3 | 4)")
    negative = int(np.count_nonzero(array < 0))
    halves = pack("rgba16f", np.maximum(array, 0))  # NaN stays NaN and is refused
    height, width = array.shape[-3:-1]
    context = _context(astc, quality, 0)
    swizzle = astc.ASTCSwizzle.from_str(_RGBA if array.shape[-1] == 4 else _RGB1)
    blocks = [
        context.compress(astc.ASTCImage(astc.ASTCType.F16, width, height, 1, image.tobytes()), swizzle)
        for image in halves.data.reshape(-1, height, width, 8)
    ]
    shape = (*array.shape[:-3], -(-height // SIDE), -(-width // SIDE), FORMATS["astc4x4hdr"].size)
    return Packed(np.frombuffer(b"".join(blocks), np.uint8).reshape(shape), halves.clipped, negative)


def decode_astc(data: bytes | memoryview, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Decode ASTC blocks to float32 (*shape, 4); blocks that are not valid become NaN, as on a GPU.

    data: the bytes of the blocks. shape: (..., height, width) in texels. Raises `UnsupportedError` where
    astc-encoder-py is not installed, and `InputError` for blocks that it cannot decode.
    """
    astc = library()
    height, width = shape[-2:]
    size = -(-height // SIDE) * -(-width // SIDE) * FORMATS["astc4x4hdr"].size
    blocks = memoryview(data).cast("B")
    if not len(blocks) or len(blocks) % size:
        raise ValueError(f"{len(blocks)} bytes are not {shape} texels of astc4x4hdr")
    context = _context(astc, 0, astc.ASTCConfigFlags.DECOMPRESS_ONLY)
    swizzle = astc.ASTCSwizzle.from_str(_RGBA)
    out = np.empty((len(blocks) // size, height, width, 4), np.float32)
    for k in range(len(out)):
        image = astc.ASTCImage(astc.ASTCType.F16, width, height)
        try:
            context.decompress(bytes(blocks[k * size : (k + 1) * size]), image, swizzle)
        except astc.ASTCError as error:
            raise InputError(f"astcenc cannot decode {size} bytes of ASTC: {str(error).splitlines()[0]}") from error
        out[k] = np.frombuffer(image.data, "<f2").reshape(height, width, 4)
    return out.reshape(*shape, 4)


def _context(astc: Any, quality: float, flags: int) -> Any:
    config = astc.ASTCConfig(astc.ASTCProfile.HDR, SIDE, SIDE, 1, quality, flags)
    return astc.ASTCContext(config)


def library() -> Any:
    """Return the module of the codec. Raises `UnsupportedError`, which names the extra to install, where it is
    missing.
    """
    try:
        import astc_encoder
    except ImportError:
        raise UnsupportedError('ASTC needs astc-encoder-py: pip install "whitefurnace[astc]"') from None
    return astc_encoder
