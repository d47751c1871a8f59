"""Arrays that are filled part by part in a memory map, for tables larger than memory, and .npy files made so."""

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


def write_npy(path: str | os.PathLike[str], shape: Sequence[int], dtype: npt.DTypeLike, fill: Fill, *,
              into: Transaction | None = None) -> None:
    """Write an array that `fill` fills in place; `numpy.load` gives it back. Nothing is left behind where it
    fails. Raises `FileError` for what cannot be written, a full disk too; what `fill` raises passes through."""

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
def scratch(path: str | os.PathLike[str], shape: Sequence[int], dtype: npt.DTypeLike,
            fill: Fill) -> Iterator[npt.NDArray[Any]]:
    """An array that `fill` has filled, in a file without a name beside `path`. Raises `FileError`."""
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
    """Lets go of the memory that the written part of a mapped array takes; the file keeps it."""
    if isinstance(array.base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        array.base.madvise(mmap.MADV_DONTNEED)


def _allocate(file: BinaryIO | Any, start: int, count: int) -> None:
    """Takes the room on disk now, for an error that can be caught: a store to a map that the disk has no room for
    kills the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), start, count)
        return
    file.seek(start)
    for begin in range(0, count, 1 << 20):
        file.write(bytes(min(1 << 20, count - begin)))
    file.flush()


@contextlib.contextmanager
def _unmapped(array: npt.NDArray[Any]) -> Iterator[None]:
    """Closes the map at the end, whatever happens: Windows removes and renames no file that is mapped."""
    mapped = array.base
    del array
    try:
        yield
    except BaseException as error:
        traceback.clear_frames(error.__traceback__)  # their variables hold the array
        raise
    finally:
        with contextlib.suppress(BufferError):
            if isinstance(mapped, mmap.mmap):
                mapped.close()
