"""What a texture file says about the numbers of its texels beyond their pixel format, and how that is applied.

KTX 2 states a transfer function, primaries, a range, an order of channels and what alpha is; KTX 1 and DDS state some
of these. Everything that a file states is applied here or refused by name by its reader.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from whitefurnace.files.colour import Encoding

Texels = npt.NDArray[np.float32]

STRAIGHT_ORDER = "rgba"


@dataclass(frozen=True, eq=False)
class Meaning:
    """The conversion of decoded numbers to linear Rec.709 radiance.

    encoding       curves and primaries of the colours; None for linear Rec.709
    scale, offset  colours are x·scale + offset, after the curves
    order          source of red, green, blue and alpha: one of r g b a, or 0 or 1 for a constant
    alpha          "straight", "premultiplied" where colours were multiplied by it, or "none" where it is not coverage
                   and is left out
    """

    encoding: Encoding | None = None
    scale: float = 1.0
    offset: float = 0.0
    order: str = STRAIGHT_ORDER
    alpha: Literal["straight", "premultiplied", "none"] = "straight"

    @property
    def plain(self) -> bool:
        """True if the numbers are radiance without any conversion."""
        return (
            self.encoding is None
            and (self.scale, self.offset) == (1.0, 0.0)
            and self.order == STRAIGHT_ORDER
            and self.alpha == "straight"
        )

    def as_light(self, texels: Texels, path: str, said: list[str]) -> Texels:
        """Apply everything to texels (…, height, width, channels); they may be changed in place.

        said: receives sentences about values that the conversion changed. Raises `InputError` for values that the
        transfer function is not defined for.
        """
        if self.plain:
            return texels
        shape = texels.shape
        rows = np.ascontiguousarray(texels).reshape(-1, *shape[-2:])
        if self.encoding is not None:
            self.encoding.linearize(rows, Path(path))
        if (self.scale, self.offset) != (1.0, 0.0):
            rows[..., :3] *= np.float32(self.scale)
            rows[..., :3] += np.float32(self.offset)
        rows = self._ordered(rows)
        if self.alpha == "premultiplied" and rows.shape[-1] == 4:
            _divide(rows)
        if self.encoding is not None and (sentence := self.encoding.to_rec709(rows)):
            sentence = f"{path}: {sentence}"
            if sentence not in said:
                said.append(sentence)
        return rows.reshape(*shape[:-1], rows.shape[-1])

    def channels(self, stored: int) -> int:
        """Return the number of channels that `as_light` makes of texels with `stored` channels."""
        return len(self._picks(stored))

    def _picks(self, channels: int) -> str:
        """Return the letters of the channels that result from texels of so many channels."""
        # Channels that the texels do not have are 0, and alpha is 1, as on a GPU.
        natural = STRAIGHT_ORDER[:channels] + "001"[channels - 1 :]
        missing = dict(zip(STRAIGHT_ORDER[channels:], natural[channels:], strict=True))
        order = "".join(missing.get(letter, letter) for letter in self.order)
        if order == natural and not (channels == 4 and self.alpha == "none"):
            return STRAIGHT_ORDER[:channels]
        return order[:3] if self.alpha == "none" or order[3] == "1" else order

    def _ordered(self, texels: Texels) -> Texels:
        channels = texels.shape[-1]
        picks = self._picks(channels)
        if picks == STRAIGHT_ORDER[:channels]:
            return texels
        out = np.empty((*texels.shape[:-1], len(picks)), np.float32)
        for k, letter in enumerate(picks):
            out[..., k] = float(letter) if letter in "01" else texels[..., STRAIGHT_ORDER.index(letter)]
        return out


def _divide(texels: Texels) -> None:
    """Divide the colours by alpha in place, row by row; they are 0 where alpha is 0."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for row in texels:
            alpha = row[..., 3:]
            row[..., :3] = np.where(alpha > 0, row[..., :3] / alpha, np.float32(0))


def is_order(text: str) -> bool:
    """Return whether a text is an order of channels: four of r g b a 0 1."""
    return len(text) == 4 and not set(text) - set("rgba01")


def is_range(scale: float, offset: float) -> bool:
    """Return whether numbers are the scale and offset of a range: finite, and the scale not 0."""
    return math.isfinite(scale) and math.isfinite(offset) and scale != 0
