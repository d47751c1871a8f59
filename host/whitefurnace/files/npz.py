"""Writes arrays as .npz with the same bytes every time; numpy's own writer stores the time in each member."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from whitefurnace.files.atomic import Transaction, write_atomic


def write_npz(
    path: str | os.PathLike[str], arrays: Mapping[str, npt.ArrayLike], *, into: Transaction | None = None
) -> None:
    """Write `arrays` by name as .npz, uncompressed and in their order.

    A failure leaves no file behind. Raises `FileError` where the file cannot be written, for example on a full disk.
    """

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, values in arrays.items():
                member = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                member.create_system = 3  # the same on every system
                member.external_attr = 0o600 << 16
                array: npt.NDArray[Any] = np.asarray(values)
                # zipfile does not know the size in advance; members of 2 GiB and more need the 64-bit form.
                with archive.open(member, "w", force_zip64=array.nbytes > 1 << 30) as stream:
                    np.lib.format.write_array(stream, array, allow_pickle=False)

    write_atomic(path, write, into)
