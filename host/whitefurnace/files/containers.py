"""Textures of any container: read by what a file begins with, written by what its name ends with."""

from __future__ import annotations

import os
from pathlib import Path

from whitefurnace.errors import InputError, UnsupportedError
from whitefurnace.files import dds, ktx1, ktx2
from whitefurnace.files.atomic import Transaction
from whitefurnace.files.binary import Source, load
from whitefurnace.files.texture import Texture

_PARSERS = {ktx1.IDENTIFIER: ktx1.parse_ktx1, ktx2.IDENTIFIER: ktx2.parse_ktx2, dds.MAGIC: dds.parse_dds}


def is_texture(path: str | os.PathLike[str]) -> bool:
    """Whether a file begins as KTX 1, KTX 2 or DDS does; false where it cannot be read."""
    try:
        if not Path(path).is_file():
            return False
        with open(path, "rb") as file:
            head = file.read(12)
    except (OSError, ValueError):
        return False
    return any(head.startswith(magic) for magic in _PARSERS)


def read_texture(path: str | os.PathLike[str]) -> Texture:
    """Read a KTX 1, KTX 2 or DDS file. Raises `FileError`, and `InputError` for what is none of them or not valid."""
    return parse_texture(load(path))


def parse_texture(source: Source) -> Texture:
    """The texture in the bytes of a KTX 1, KTX 2 or DDS file. Raises `InputError`."""
    head = bytes(source.view[:12])
    for magic, parse in _PARSERS.items():
        if head.startswith(magic):
            return parse(source)
    raise InputError(f"{source.name} is not a texture in a container that is known: KTX 1, KTX 2 or DDS")


def write_texture(path: str | os.PathLike[str], texture: Texture, *, zstd: int | None = None,
                  into: Transaction | None = None) -> None:
    """Write `texture` as .ktx, .ktx2 or .dds; `zstd` is for .ktx2. Raises `UnsupportedError` for another suffix or a
    format that the container is not written in, `FileError` for what cannot be written."""
    suffix = Path(path).suffix.lower()
    if suffix == ".ktx2":
        ktx2.write_ktx2(path, texture, zstd=zstd, into=into)
    elif suffix in (".ktx", ".dds") and zstd is not None:
        raise UnsupportedError(f"{path}: Zstandard is for .ktx2, not for {suffix}")
    elif suffix == ".ktx":
        ktx1.write_ktx1(path, texture, into=into)
    elif suffix == ".dds":
        dds.write_dds(path, texture, into=into)
    else:
        raise UnsupportedError(f"{path} is no texture's name, .ktx, .ktx2 and .dds are")
