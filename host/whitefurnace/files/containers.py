"""Reads and writes textures in KTX 1, KTX 2 and DDS.

The first bytes of a file select the reader, the suffix of its name the writer.
"""

from __future__ import annotations

import os
from pathlib import Path

from whitefurnace.errors import InputError, UnsupportedError
from whitefurnace.files import dds, ktx1, ktx2
from whitefurnace.files.atomic import Transaction
from whitefurnace.files.binary import Source, load
from whitefurnace.files.inputs import head_of
from whitefurnace.files.texture import Texture

_PARSERS = {ktx1.IDENTIFIER: ktx1.parse_ktx1, ktx2.IDENTIFIER: ktx2.parse_ktx2, dds.MAGIC: dds.parse_dds}


def is_texture(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is KTX 1, KTX 2 or DDS by its first bytes; False where it cannot be read."""
    head = head_of(path, 12)
    return any(head.startswith(magic) for magic in _PARSERS)


def read_texture(path: str | os.PathLike[str]) -> Texture:
    """Read a KTX 1, KTX 2 or DDS file.

    Raises `FileError` for a file that cannot be read, and `InputError` for one that is not valid or of another format.
    """
    return parse_texture(load(path))


def parse_texture(source: Source) -> Texture:
    """Parse the bytes of a KTX 1, KTX 2 or DDS file. Raises `InputError`."""
    head = bytes(source.view[:12])
    for magic, parse in _PARSERS.items():
        if head.startswith(magic):
            return parse(source)
    raise InputError(f"{source.name} is not a KTX 1, KTX 2 or DDS texture")


def write_texture(
    path: str | os.PathLike[str], texture: Texture, *, zstd: int | None = None, into: Transaction | None = None
) -> None:
    """Write `texture` as .ktx, .ktx2 or .dds, by the suffix of `path`.

    zstd: level of Zstandard compression, 1 to 22, for .ktx2 alone. into: the transaction that the file belongs to.
    Raises `UnsupportedError` for another suffix or a pixel format that the container cannot hold, and `FileError`
    where the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".ktx2":
        ktx2.write_ktx2(path, texture, zstd=zstd, into=into)
    elif suffix in (".ktx", ".dds") and zstd is not None:
        raise UnsupportedError(f"{path}: only .ktx2 files can be compressed by Zstandard, not {suffix}")
    elif suffix == ".ktx":
        ktx1.write_ktx1(path, texture, into=into)
    elif suffix == ".dds":
        dds.write_dds(path, texture, into=into)
    else:
        raise UnsupportedError(f"cannot write a texture to {path}: its name must end with .ktx, .ktx2 or .dds")
