"""Reads .npy and .npz files, and arrays in C headers, from untrusted sources.

No memory is allocated for a size that a header states until the file is known to hold that many bytes, and nothing in
a file is executed.
"""

from __future__ import annotations

import math
import os
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError
from whitefurnace.files import memory
from whitefurnace.files.binary import MAX_BYTES, Source, load
from whitefurnace.files.inputs import head_of, read_text

NPY, ZIP = b"\x93NUMPY", b"PK\x03\x04"
_ARRAY = re.compile(r"static const (?:float|double) \w+((?:\[\d{1,9}\]){1,8}) = \{")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_LONGEST_HEADER = 64 << 20
"""Largest size of a C header in bytes: five million numbers."""

_DENSEST = 1032
"""Largest number of bytes that one byte of deflated data can expand to [zlib: Maximum Expansion Factor]."""
_READERS: dict[tuple[int, int], Callable[[Any], tuple[tuple[int, ...], bool, np.dtype[Any]]]] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
# The exceptions that numpy's header parser and zipfile raise for malformed bytes.
_NONSENSE = (
    ValueError,
    TypeError,
    SyntaxError,
    OverflowError,
    EOFError,
    MemoryError,
    RecursionError,
    LookupError,
    AttributeError,
    NotImplementedError,
    RuntimeError,
    tokenize.TokenError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
    OSError,
)


def read_npy(path: str | os.PathLike[str]) -> npt.NDArray[Any]:
    """Read the array of a .npy file.

    Raises `FileError` for a file that cannot be read, and `InputError` for a file that is not valid or holds anything
    but numbers.
    """
    import io

    source = load(path)
    return _array(cast(BinaryIO, io.BytesIO(source.view)), len(source), source, "it", len(source))


def read_npz(path: str | os.PathLike[str]) -> dict[str, npt.NDArray[Any]]:
    """Read the arrays of a .npz file, by name and in the file's order. Every checksum is verified.

    Raises the same errors as `read_npy`.
    """
    import io

    source = load(path)
    found: dict[str, npt.NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(source.view)) as archive:
            members = archive.infolist()
            total = sum(member.file_size for member in members)
            if total > min(MAX_BYTES, _DENSEST * len(source)):
                raise source.wrong("its directory says that it holds more than its bytes can")
            memory.require(len(source) + total, "its arrays", source.name, len(source))
            for member in members:
                name = member.filename.removesuffix(".npy")
                if name in found:
                    raise source.wrong(f"it holds {name!r} twice")
                with archive.open(member) as stream:
                    found[name] = _array(
                        cast(BinaryIO, stream), member.file_size, source, f"its member {name!r}", total
                    )
                    if stream.read(1):
                        raise source.wrong(f"its member {name!r} is longer than its header says")
    except InputError:
        raise
    except _NONSENSE as error:
        raise source.wrong(f"it is truncated or corrupted ({_said(error)})") from error
    return found


def read_header(path: str | os.PathLike[str]) -> npt.NDArray[np.float64] | None:
    """Read the array of floats in a C header, with the shape that the header declares.

    Returns None for a header that has macros and no array. Raises the same errors as `read_npy`.
    """
    text = read_text(path, "a C header", most=_LONGEST_HEADER)
    source = Source(b"", str(path))
    found = _ARRAY.search(text)
    if found is None:
        if "#define" in text:
            return None
        raise source.wrong("it is no C header: it has neither an array of floats nor a macro")
    shape = tuple(int(size) for size in found[1].strip("[]").split("]["))
    body, end, _ = text[found.end() :].partition("};")
    memory.require(3 * len(text) + 200 * body.count(","), "its numbers", source.name, len(text))
    numbers = _NUMBER.findall(body)
    if not end or math.prod(shape) != len(numbers):
        raise source.wrong(f"it says that it has {math.prod(shape)} numbers, {len(numbers)} are there")
    return np.array([float(number) for number in numbers]).reshape(shape)


def is_arrays(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is .npy by its first bytes, or .npz by its first bytes and its suffix."""
    head = head_of(path, 6)
    return head == NPY or (head.startswith(ZIP) and Path(path).suffix.lower() == ".npz")


def _array(stream: BinaryIO, size: int, source: Source, what: str, total: int) -> npt.NDArray[Any]:
    """Parse the array in a stream of `size` bytes; `what` names the stream in error messages.

    total: bytes of all arrays of the file.
    """
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _READERS:
            raise source.wrong(f"{what} is of version {version[0]}.{version[1]} of .npy, 1.0 and 2.0 are read")
        shape, fortran, dtype = _READERS[version](stream)
        start = stream.tell()
    except InputError:
        raise
    except _NONSENSE as error:
        raise source.wrong(f"{what} has no header of .npy ({_said(error)})") from error
    if dtype.kind not in "fiub" or any(not isinstance(n, int) or n < 0 for n in shape):
        raise source.wrong(f"{what} holds {dtype}, not numbers")
    wanted = math.prod(shape) * dtype.itemsize
    if wanted != size - start:
        raise source.wrong(f"{what} says that it has {wanted} bytes of numbers, {size - start} are there")
    # The values are read as float32 later, one array at a time.
    memory.require(len(source) + total + 4 * math.prod(shape), f"the numbers of {what}", source.name, len(source))
    try:
        flat = np.frombuffer(stream.read(wanted), dtype)
        return flat.reshape(shape, order="F" if fortran else "C")
    except _NONSENSE as error:
        raise source.wrong(f"{what} is truncated or corrupted ({_said(error)})") from error


def _said(error: BaseException) -> str:
    """Return the text of an exception on one line of at most 120 characters."""
    return " ".join(str(error).split())[:120].rstrip(".") or type(error).__name__
