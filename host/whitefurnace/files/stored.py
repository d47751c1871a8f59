"""Reads images as stored: the facts of the header, and the values without decoding them to radiance."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import FileError, InputError
from whitefurnace.files import image, memory
from whitefurnace.files.binary import load
from whitefurnace.files.packing import unpack
from whitefurnace.files.png import decode_png

PREFIX = "whitefurnace:"


@dataclass(frozen=True)
class ImageFacts:
    """Facts in the header of an image.

    format       OpenImageIO's name of the file format
    layout       the layout that the file itself states, "latlong" or "openexr cube"; None where it states none
    aspect       width of a pixel over its height, as the file states it
    pixel        type of a value, such as "half" or "uint8"
    compression  its name, empty where there is none
    attributes   the attributes that this package wrote, without their prefix
    """

    format: str
    width: int
    height: int
    channels: tuple[str, ...]
    pixel: str
    compression: str = ""
    attributes: Mapping[str, str | float | int] = field(default_factory=dict)
    layout: str | None = None
    aspect: float = 1.0


def image_facts(
    path: str | os.PathLike[str], *, layer: str | None = None, fill: str | None = None, light: bool = False
) -> ImageFacts:
    """Read the facts in the header of an image.

    layer, fill: as for `read_image`. light: whether an OpenEXR file without light is refused as `read_image` does;
    otherwise the facts are those of its first part.
    Raises `FileError` for a file that cannot be read, and `InputError` for one that is not a valid image.
    """
    image.check_choice(layer, fill)
    with _opened(Path(path), layer, fill, light) as (_, facts):
        return facts


def read_stored(path: str | os.PathLike[str]) -> npt.NDArray[np.float32]:
    """Read all channels as stored, float32 (height, width, channels).

    Integers are divided by their largest code. No transfer function and no primaries are applied. Raises the errors of
    `image_facts`.
    """
    path = Path(path)
    with _opened(path) as (found, facts):
        return image._read_pixels(found.source, found.spec, list(range(len(facts.channels))), path, "float")


def read_rgbd(path: str | os.PathLike[str]) -> npt.NDArray[np.float32]:
    """Decode a PNG of RGBD as Babylon.js does, to float32 (height, width, 3). Raises the errors of `image_facts`."""
    source = load(path)
    pixels = decode_png(source)
    if pixels.shape[2] != 4:
        raise source.wrong("it has no alpha, in which RGBD has its divisor")
    # Four codes of a byte each become three floats of four.
    memory.require(len(source) + 4 * pixels.nbytes, "its colours as floats", path, len(source))
    return unpack("rgbd", pixels, pixels.shape[:2])


@contextlib.contextmanager
def _opened(
    path: Path, layer: str | None = None, fill: str | None = None, light: bool = False
) -> Iterator[tuple[image.Opened, ImageFacts]]:
    size = image._regular_size(path)
    if size == 0:
        raise InputError(f"{path} is empty, an image file was expected")
    try:
        with image.opened(path, size, layer=layer, fill=fill, light=light) as found:
            spec, choice = found.spec, found.choice
            # Ours are texts and numbers; what another program stored under such a name, such as an array, is not ours.
            own: dict[str, Any] = {
                a.name.removeprefix(PREFIX): a.value
                for a in spec.extra_attribs
                if a.name.startswith(PREFIX) and isinstance(a.value, str | int | float)
            }
            yield (
                found,
                ImageFacts(
                    found.form,
                    *found.size,
                    tuple(spec.channelnames),
                    str(spec.format),
                    spec.get_string_attribute("compression"),
                    own,
                    None if choice is None else choice.layout,
                    found.aspect,
                ),
            )
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeError as error:
        raise InputError(f"{path} is corrupted: its header holds text that is not UTF-8") from error
    except MemoryError as error:
        raise InputError(f"{path} needs more memory than this machine gives") from error
