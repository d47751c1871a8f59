"""Writes tables as PNG of 16 or 8 bits, KTX 2, DDS or a C header, and returns the error of the stored format."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import UnsupportedError, UsageError, nearest
from whitefurnace.files.atomic import Transaction, write_pieces
from whitefurnace.files.codec import decode, encode
from whitefurnace.files.containers import write_texture
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.png import MAX_SIDE, encode_png
from whitefurnace.files.texture import MAX_LAYERS, text_value
from whitefurnace.text import printable

STORED: Mapping[str, Sequence[str]] = {
    ".png": ("r16", "r8"),
    ".ktx2": ("rg16f", "rgba16f", "rgba32f"),
    ".dds": ("rg16f", "rgba16f", "rgba32f"),
    ".h": (),
}
"""Pixel formats by suffix; the first with enough channels is the default. A C header holds the values unchanged."""

ZSTD = 19
"""Compression level of Zstandard: high, because tables are small and are written once."""

MOST = 1 << 22
"""Largest number of values in a C header: compilers take minutes for more."""


@dataclass(frozen=True)
class Stored:
    """The format of the values in a file, and the largest absolute error of storing them."""

    format: str
    error: float


def stored_format(suffix: str, channels: int, given: str | None) -> str | None:
    """Return the format for a table of `channels` in a file with `suffix`; None where the values are stored unchanged.

    given: the format that the user chose, or None for the default. Raises `UsageError` for a format that the file
    does not have, and `UnsupportedError` for more channels than the format holds.
    """
    known = STORED.get(suffix, ())
    if given is not None and given not in known:
        named = f"; {suffix} holds {', '.join(known)}" if known else f"; {suffix} holds the values as they are"
        raise UsageError(f"unknown format {given!r}{nearest(given, known)}{named}")
    if not known:
        return None
    most = {name: 4 if suffix == ".png" else FORMATS[name].channels for name in known}
    fitting = [name for name in known if most[name] >= channels and given in (None, name)]
    if not fitting:
        raise UnsupportedError(
            f"{given or suffix} holds {max(most[name] for name in known if given in (None, name))} "
            f"channels at most, and the table has {channels}"
        )
    return fitting[0]


def check_table(suffix: str, shape: Sequence[int], channels: int) -> None:
    """Check that a table of `shape` […, y, x] fits in a file with that suffix. Raises `UsageError` otherwise."""
    if suffix == ".h":
        if math.prod(shape) * channels > MOST:
            raise UsageError(f"a header holds {MOST} values at most, not {math.prod(shape) * channels}: give .npy")
    elif suffix == ".png":
        if len(shape) > 2 or max(shape) > MAX_SIDE:
            raise UsageError(f"PNG holds two axes of at most {MAX_SIDE}, not {' × '.join(map(str, shape))}: give .npy")
    elif len(shape) > 3 or (len(shape) == 3 and shape[0] > MAX_LAYERS):
        raise UsageError(
            f"{suffix} holds three axes, the slowest of at most {MAX_LAYERS}, not "
            f"{' × '.join(map(str, shape))}: give .npy"
        )


def write_table(
    path: str | os.PathLike[str],
    cells: npt.NDArray[Any],
    form: str | None,
    *,
    slack: float = 0.0,
    texts: Mapping[str, str] | None = None,
    comment: Sequence[str] = (),
    into: Transaction | None = None,
) -> Stored:
    """Write the floats `cells` […, y, x, c] as .png, .ktx2, .dds or .h, by the suffix of `path`.

    A third axis becomes the layers of a 2-D array. Channels that the table does not have are 0, the fourth is 1.
    form: a format of STORED; None for .h. slack: how far values may lie outside 0 to 1 in a PNG; they are clamped.
    texts: key-values of KTX 2. comment: first lines of a C header.
    Raises `UnsupportedError` for values that do not fit, and `FileError` where the file cannot be written.
    """
    path, suffix = Path(path), Path(path).suffix.lower()
    low, high = float(cells.min()), float(cells.max())
    if not (math.isfinite(low) and math.isfinite(high)):
        raise UnsupportedError(
            f"{path}: the table has values that are not finite, which {suffix} does not hold: give .npy or .exr"
        )
    if suffix == ".h":
        write_pieces(path, (line.encode() for line in _header(path.stem, cells, comment)), into)
        return Stored(cells.dtype.name, 0.0)  # enough digits to read back the same floats
    assert form is not None
    if suffix == ".png":
        most = 65535 if form == "r16" else 255
        room = max(slack, 0.5 / most)
        if low < -room or high > 1 + room:
            raise UnsupportedError(
                f"{path}: values from {low:.4g} to {high:.4g} do not fit in [0, 1], which is what "
                "PNG holds: give .exr, .npy or .ktx2"
            )
        held = np.rint(np.clip(cells.astype(np.float64), 0, 1) * most)
        codes = held.astype(np.uint16 if most > 255 else np.uint8)
        # No texture loader reads grey with alpha as two values, so two channels are stored as red and green.
        write_pieces(path, [encode_png(_widened(codes, 3 if codes.shape[-1] == 2 else codes.shape[-1], most))], into)
        return Stored(form, float(np.abs(held / most - cells).max()))
    largest = FORMATS[form].largest
    if max(-low, high) > largest:
        raise UnsupportedError(
            f"{path}: values from {low:.4g} to {high:.4g} do not fit in {form}, which ends at "
            f"{largest:g}: give --format rgba32f"
        )
    keys = {name: text_value(text) for name, text in (texts or {}).items()} if suffix == ".ktx2" else {}
    texture = encode(form, [_widened(np.ascontiguousarray(cells), FORMATS[form].channels, 1)], key_values=keys).texture
    write_texture(path, texture, zstd=ZSTD if suffix == ".ktx2" else None, into=into)
    back = decode(texture, 0)[..., : cells.shape[-1]].astype(np.float64)
    return Stored(form, float(np.abs(back - cells).max()))


def _widened(cells: npt.NDArray[Any], channels: int, one: int) -> npt.NDArray[Any]:
    """Extend `cells` to `channels`: new channels are 0, a new fourth one is `one`."""
    missing = channels - cells.shape[-1]
    if not missing:
        return cells
    more = np.zeros((*cells.shape[:-1], missing), cells.dtype)
    if channels == 4:
        more[..., -1] = one
    return np.concatenate([cells, more], axis=-1)


KEYWORDS = frozenset(
    "auto break case char const continue default do double else enum extern float for goto if inline "
    "int long register restrict return short signed sizeof static struct switch typedef union "
    "unsigned void volatile while".split()
)
"""Keywords of C, which cannot name an array: a file may be called default.h."""


def identifier(stem: str) -> str:
    """Return a C identifier made from the stem of a file's name."""
    name = "".join(c if c.isascii() and c.isalnum() else "_" for c in stem)
    return name if name[:1].isalpha() and name not in KEYWORDS else f"table_{name}"


def number(value: float, kind: str) -> str:
    """Return a C and GLSL literal that reads back as the same float; `kind` is "float32" or "float64"."""
    text = f"{value:.9g}" if kind == "float32" else f"{value:.17g}"
    text = text if set(text) & set(".e") else f"{text}.0"
    return f"{text}f" if kind == "float32" else text


def _header(stem: str, cells: npt.NDArray[Any], comment: Sequence[str]) -> Iterator[str]:
    """Yield the text of a C header with the array `cells`."""
    name, kind = identifier(stem), cells.dtype.name
    yield "".join(f"// {printable(line)}\n" for line in comment)
    yield f"#ifndef {name.upper()}_H\n#define {name.upper()}_H\n\n"
    shape = cells.shape[:-1] if cells.shape[-1] == 1 else cells.shape
    yield f"static const {'float' if kind == 'float32' else 'double'} {name}{''.join(f'[{n}]' for n in shape)} = {{\n"
    rows = cells.reshape(-1, *cells.shape[-2:])
    outer = shape[: cells.ndim - 3]
    for k, row in enumerate(rows):
        # The braces of an outer axis open at its first row and close at its last.
        opened = sum(1 for d in range(len(outer)) if k % math.prod([*outer[d + 1 :], cells.shape[-3]]) == 0)
        closed = sum(1 for d in range(len(outer)) if (k + 1) % math.prod([*outer[d + 1 :], cells.shape[-3]]) == 0)
        texels = [", ".join(number(x, kind) for x in texel) for texel in row.tolist()]
        joined = ", ".join(texels if cells.shape[-1] == 1 else (f"{{{t}}}" for t in texels))
        yield f"{'{' * opened}{{{joined}}}{'}' * closed},\n"
    yield f"}};\n\n#endif  // {name.upper()}_H\n"


def write_text(path: str | os.PathLike[str], text: str, *, into: Transaction | None = None) -> None:
    """Write a text file in UTF-8. Raises `FileError`."""
    write_pieces(path, [text.encode()], into)
