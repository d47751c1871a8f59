"""Reads nine RGB coefficients of spherical harmonics from the text files that engines and tools exchange.

The text has one line for each coefficient, `( r, g, b); // name`, or is JSON by name.
"""

from __future__ import annotations

import json
import math
import os
import re

import numpy as np
import numpy.typing as npt

from whitefurnace.files.binary import Source
from whitefurnace.files.inputs import read_input

MAX_BYTES = 1 << 16
"""Largest size of such a text in bytes; cmgen writes about 700."""

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def read_sh(path: str | os.PathLike[str]) -> npt.NDArray[np.float64]:
    """Read the (9, 3) numbers of a .txt or .json file, in the order of the file.

    Raises `FileError` for a file that cannot be read, and `InputError` for one that does not have nine lines, or nine
    names, of three finite numbers.
    """
    source = Source(read_input(path, "a text of nine coefficients", most=MAX_BYTES), str(path))
    rows: list[list[float]]
    try:
        text = bytes(source.view).decode()
        if text.lstrip().startswith("{"):
            rows = [[float(x) for x in row] for row in json.loads(text).values()]
        else:
            lines = (line.partition("//")[0] for line in text.splitlines())
            rows = [[float(x) for x in _NUMBER.findall(line)] for line in lines if line.strip()]
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        raise source.wrong("it is no text of numbers") from None
    if len(rows) != 9 or any(len(row) != 3 or not all(map(math.isfinite, row)) for row in rows):
        raise source.wrong("it does not hold nine rows of three finite numbers")
    return np.array(rows)
