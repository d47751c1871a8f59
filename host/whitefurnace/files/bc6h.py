"""Encodes BC6H blocks with the optional package `ispc-texcomp`, and decodes them with OpenImageIO."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import FileError, UnsupportedError
from whitefurnace.files.dds import write_dds
from whitefurnace.files.packing import Packed, pack
from whitefurnace.files.texture import Texture

SIDE = 4
Profile = Literal["veryfast", "fast", "basic", "slow", "veryslow"]


def encode_bc6h(values: npt.ArrayLike, *, profile: Profile = "slow") -> Packed:
    """Encode `values` (..., height, width, 3) as unsigned BC6H: uint8 (..., blocks down, blocks across, 16).

    profile: quality of the encoder. The last rows and columns are repeated to fill whole blocks. Values too large for a
    half become 65504 and negative values become 0; `Packed` counts both.

    Raises `InputError` for NaN, and `UnsupportedError` for another profile and where ispc-texcomp is not installed.
    """
    if profile not in get_args(Profile):
        raise UnsupportedError(f"there is no profile {profile!r} of BC6H; known: {', '.join(get_args(Profile))}")
    ispc_texcomp = library()
    array = np.asarray(values)
    if array.ndim < 3 or array.shape[-1] != 3:
        raise ValueError(f"values of shape {array.shape} are not (..., height, width, 3)")
    negative = int(np.count_nonzero(array < 0))
    halves = pack("rgba16f", np.maximum(array, 0))  # NaN stays NaN and is refused
    height, width = array.shape[-3:-1]
    down, across = -height % SIDE, -width % SIDE
    images = halves.data.reshape(-1, height, width, 8)
    images = np.pad(images, ((0, 0), (0, down), (0, across), (0, 0)), "edge")
    settings = ispc_texcomp.BC6HEncSettings.from_profile(profile)
    blocks = [
        ispc_texcomp.compress_blocks_bc6h(
            ispc_texcomp.RGBASurface(image.tobytes(), width + across, height + down, 8 * (width + across)), settings
        )
        for image in images
    ]
    shape = (*array.shape[:-3], (height + down) // SIDE, (width + across) // SIDE, 16)
    return Packed(np.frombuffer(b"".join(blocks), np.uint8).reshape(shape), halves.clipped, negative)


def library() -> Any:
    """Return the module of the encoder. Raises `UnsupportedError`, which names the extra to install, where it is
    missing.
    """
    try:
        import ispc_texcomp
    except ImportError:
        raise UnsupportedError('writing BC6H needs ispc-texcomp: pip install "whitefurnace[bc6h]"') from None
    return ispc_texcomp


def decode_bc6h(form: str, data: bytes | memoryview, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Decode BC6H blocks to float32 (*shape, 3).

    form: "bc6hu" (unsigned) or "bc6hs" (signed). data: the bytes of the blocks. shape: (..., height, width) in texels.
    Raises `FileError` where OpenImageIO cannot decode them.
    """
    import OpenImageIO as oiio

    height, width = shape[-2:]
    down, across = height + -height % SIDE, width + -width % SIDE
    blocks = memoryview(data).cast("B")
    size = down * across
    if not len(blocks) or len(blocks) % size:
        raise ValueError(f"{len(blocks)} bytes are not {shape} texels of {form}")
    out = np.empty((len(blocks) // size, height, width, 3), np.float32)
    with tempfile.TemporaryDirectory() as folder:  # OpenImageIO for Python opens files only
        path = Path(folder, "blocks.dds")
        for k in range(len(out)):
            write_dds(path, Texture(form, across, down, (blocks[k * size : (k + 1) * size],)))
            source = oiio.ImageInput.open(str(path))
            pixels = None if source is None else source.read_image("float")
            if source is not None:
                source.close()
            if pixels is None:
                complaint = (oiio.geterror() or "no reason given").strip().splitlines()[0]
                raise FileError(f"OpenImageIO cannot decode BC6H: {complaint}")
            out[k] = pixels[:height, :width, :3]
    return out.reshape(*shape, 3)
