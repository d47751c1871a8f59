"""Writes .npy files, and temporary arrays, through memory maps that are filled part by part.

Tables larger than memory are written this way.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import FileError
from whitefurnace.files.atomic import Transaction, write_atomic

Fill = Callable[[npt.NDArray[Any]], object]


def write_npy(
    path: str | os.PathLike[str],
    shape: Sequence[int],
    dtype: npt.DTypeLike,
    fill: Fill,
    *,
    into: Transaction | None = None,
) -> None:
    """Write a .npy array of `shape` and `dtype` that `fill` fills in place.

    A failure leaves no file behind. Raises `FileError` where the file cannot be written, for example on a full disk;
    exceptions of `fill` pass through.
    """

    def write(temporary: Path) -> None:
        array = np.lib.format.open_memmap(temporary, "w+", np.dtype(dtype), tuple(shape))
        with open(temporary, "rb+") as file:
            _allocate(file, array.offset, array.nbytes)
        with _unmapped(array):
            fill(array)
            array.flush()
            del array

    write_atomic(path, write, into)


@contextlib.contextmanager
def scratch(
    path: str | os.PathLike[str], shape: Sequence[int], dtype: npt.DTypeLike, fill: Fill
) -> Iterator[npt.NDArray[Any]]:
    """Give an array filled by `fill`, in a nameless temporary file in the folder of `path`. Raises `FileError`."""
    path = Path(path)
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(tempfile.TemporaryFile(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp"))
            count = int(np.prod(tuple(shape), dtype=np.int64)) * np.dtype(dtype).itemsize
            _allocate(file, 0, count)
            array = np.memmap(file, dtype, "r+", shape=tuple(shape))
        except OSError as error:
            raise FileError(f"cannot write {path}: {error.strerror or error}") from error
        with _unmapped(array):
            fill(array)
            yield array
            del array


def release(array: npt.NDArray[Any]) -> None:
    """Free the memory of a mapped array; its values stay in the file."""
    if isinstance(array.base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        array.base.madvise(mmap.MADV_DONTNEED)


def _allocate(file: BinaryIO | Any, start: int, count: int) -> None:
    """Reserve the disk space now, so that a full disk raises an error.

    Later, a store to a map without disk space would kill the process.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), start, count)
        return
    file.seek(start)
    for begin in range(0, count, 1 << 20):
        file.write(bytes(min(1 << 20, count - begin)))
    file.flush()


@contextlib.contextmanager
def _unmapped(array: npt.NDArray[Any]) -> Iterator[None]:
    """Close the map at the end in every case: Windows cannot remove or rename a mapped file."""
    mapped = array.base
    del array
    try:
        yield
    except BaseException as error:
        traceback.clear_frames(error.__traceback__)  # variables of the frames refer to the array
        raise
    finally:
        with contextlib.suppress(BufferError):
            if isinstance(mapped, mmap.mmap):
                mapped.close()
