"""Access to the bytes of a file by offset and length.

Every access is checked against the file's real size first, so a wrong size in a header allocates no memory.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from pathlib import Path

from whitefurnace.errors import InputError
from whitefurnace.files import memory
from whitefurnace.files.inputs import input_size, open_input

Buffer = bytes | memoryview

MAX_BYTES = 8 << 30
"""Largest size of a texture, both in its file and unpacked."""


class Source:
    """The bytes of a file with bounds-checked access. `name` begins the messages of its errors."""

    def __init__(self, data: Buffer, name: str) -> None:
        self.view = memoryview(data)
        self.name = name

    def __len__(self) -> int:
        return len(self.view)

    def wrong(self, what: str) -> InputError:
        """Return the error for an invalid file; `what` is the end of its sentence."""
        return InputError(f"{self.name} is not valid: {what}")

    def piece(self, offset: int, length: int, what: str) -> memoryview:
        """Return `length` bytes from `offset`. Raises `InputError` where the file ends earlier.

        `what` names the piece in the message.
        """
        if offset < 0 or length < 0 or offset + length > len(self.view):
            raise InputError(
                f"{self.name} is truncated or corrupted: {what} would take bytes {offset} to {offset + length}, the "
                f"file ends at byte {len(self.view)}"
            )
        return self.view[offset : offset + length]

    def integers(self, form: str, offset: int, what: str) -> tuple[int, ...]:
        """Return the little-endian integers of the `struct` format `form` from `offset`. Raises `InputError`."""
        return struct.unpack("<" + form, self.piece(offset, struct.calcsize("<" + form), what))


def load(path: str | os.PathLike[str]) -> Source:
    """Read a whole regular file.

    Raises `FileError` for a file that cannot be read, and `InputError` for one that is empty or larger than 8 GiB.
    """
    path = Path(path)
    size = input_size(path, "a texture file")
    if not 0 < size <= MAX_BYTES:
        raise InputError(f"{path} has {size} bytes, a texture has 1 to {MAX_BYTES}")
    memory.require(size, "its bytes", path, size)
    try:
        with open_input(path, "a texture file") as file:
            return Source(file.read(size), str(path))
    except MemoryError as error:
        raise InputError(f"{path} needs more memory than this machine gives") from error


def pack_key_values(pairs: Mapping[str, bytes]) -> bytes:
    """Encode the key-value data of KTX 1 and 2, sorted by the code points of the keys.

    Each pair is its size, the key, a NUL, the value, and padding to a multiple of 4 bytes.
    """
    out = bytearray()
    for key in sorted(pairs):
        if not key or "\0" in key:
            raise ValueError(f"{key!r} is no key, it must have a character and no NUL")
        pair = key.encode() + b"\0" + pairs[key]
        out += struct.pack("<I", len(pair)) + pair + bytes(-len(pair) % 4)
    return bytes(out)


def parse_key_values(source: Source, offset: int, length: int, order: str = "<") -> dict[str, bytes]:
    """Parse the key-value data of KTX 1 and 2; values are returned as stored. Raises `InputError`.

    order: "<" for little-endian sizes, ">" for big-endian ones.
    """
    source.piece(offset, length, "its key-value data")
    pairs: dict[str, bytes] = {}
    end = offset + length
    while offset < end:
        what = f"the key-value pair at byte {offset}"
        if end - offset < 4:
            raise source.wrong(f"{what} has {end - offset} bytes, it needs 4 for its size")
        (size,) = struct.unpack(f"{order}I", source.piece(offset, 4, what))
        if not 2 <= size <= end - offset - 4:
            raise source.wrong(f"{what} says that it has {size} bytes, between 2 and {end - offset - 4} can be there")
        key, nul, value = bytes(source.piece(offset + 4, size, what)).partition(b"\0")
        try:
            name = key.decode()
        except UnicodeDecodeError:
            raise source.wrong(f"{what} has a key that is not UTF-8") from None
        if not nul or not name:
            raise source.wrong(f"{what} has no key that ends with a NUL")
        if name in pairs:
            raise source.wrong(f"{what} repeats a key, each may be there once")
        pairs[name] = value
        offset += 4 + size + -size % 4
    return pairs
