"""The memory that reading one file may take.

Every reader calls `require` with the bytes that a header asks for, before it allocates them or unpacks anything.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import sys
from pathlib import Path

from whitefurnace.errors import InputError, UsageError
from whitefurnace.text import size

VARIABLE = "WHITEFURNACE_MEMORY"
"""Environment variable with the limit of one file, such as 4GB, 512MB or 25%."""

SHARE = 0.5
"""Part of the machine's memory that the default limit allows at most."""

FLOOR = 256 << 20
"""Memory that the default limit allows to a file of any size. A cube of 1024² half floats takes 151 MB."""

RATIO = 1024
"""Bytes of memory that the default limit adds for each byte of a file.

Real images compress far less. A few kilobytes that unpack to gigabytes are a mistake or an attack.
"""

_UNKNOWN = 4 << 30
"""Memory of a machine that does not say how much it has."""

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
_AMOUNT = re.compile(r"(\d{1,15}(?:\.\d{1,9})?)\s*(?:([KMGT]?)(i?)B?|(%))", re.IGNORECASE)


def require(nbytes: int, what: str, path: str | os.PathLike[str], file_bytes: int | None = None) -> None:
    """Check that a file may take this much memory. Call it before the allocation.

    nbytes: the largest memory that reading takes at one time, all copies together. what: the part of the file that
    needs it, in the plural, such as "its 4096 x 2048 pixels". path: the file, or the name that errors call it.
    file_bytes: the file's size; by default that of the file at `path`.
    Raises `InputError` with the sizes, the limit and the way to raise it, and `UsageError` for a variable
    `WHITEFURNACE_MEMORY` that is not an amount.
    """
    if nbytes <= FLOOR and VARIABLE not in os.environ and nbytes <= SHARE * machine():
        return
    if file_bytes is None:
        file_bytes = 0
        with contextlib.suppress(OSError, ValueError):
            file_bytes = os.stat(path).st_size
    allowed = limit(file_bytes)
    if nbytes > allowed:
        has = f" (this machine has {size(machine())})" if nbytes > SHARE * machine() else ""
        raise InputError(
            f"{path}: {what} need {size(nbytes)} of memory, a file of {size(file_bytes)} may take {size(allowed)}; "
            f"set {VARIABLE}={_suggestion(nbytes)} or give --memory {_suggestion(nbytes)} to read it all the same{has}"
        )


def limit(file_bytes: int) -> int:
    """Return the bytes of memory that reading a file of `file_bytes` bytes may take.

    It is the amount in `WHITEFURNACE_MEMORY` where that is set; otherwise 256 MiB and 1024 bytes for each byte of the
    file, but at most half of the machine's memory. Raises `UsageError` for a variable that is not an amount.
    """
    text = os.environ.get(VARIABLE, "").strip()
    if text:
        return amount(text)
    return min(int(SHARE * machine()), FLOOR + RATIO * file_bytes)


def amount(text: str, name: str = VARIABLE) -> int:
    """Return the bytes of an amount of memory: 4GB, 512MB, 1.5GiB, a number of bytes, or a share such as 25%.

    name: what errors call the text. Raises `UsageError` for any other text, and for less than 1 MB.
    """
    found = _AMOUNT.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"{name} is {text[:40]!r}, an amount of memory was expected, such as 4GB, 512MB, 1.5GiB or 25%"
        )
    number, unit, binary, percent = found.groups()
    if percent:
        value = float(number) / 100 * machine()
    else:
        power = "KMGT".find(unit.upper()) + 1 if unit else 0
        value = float(number) * (1024**power if binary else _UNITS[unit.upper()])
    if value < 10**6:
        raise UsageError(f"{name} is {text[:40]!r}, at least 1MB is needed")
    return int(value)


@functools.cache
def machine() -> int:
    """Return the bytes of memory that this process can use at most: the least of all limits that are known."""
    known = [value for value in (_physical(), _control_group(), _address_space()) if value]
    return min(known, default=_UNKNOWN)


def _suggestion(nbytes: int) -> str:
    """Return an amount above `nbytes` as the variable takes it."""
    return f"{-(-nbytes // 10**9)}GB" if nbytes > 10**9 else f"{-(-nbytes // 10**6)}MB"


def _physical() -> int | None:
    if sys.platform == "win32":
        return _windows()
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _windows() -> int | None:
    """Return the physical memory of a Windows machine [Win32, MEMORYSTATUSEX]."""
    import ctypes

    class Status(ctypes.Structure):
        _fields_ = (
            ("length", ctypes.c_ulong),
            ("load", ctypes.c_ulong),
            *((name, ctypes.c_ulonglong) for name in ("total", "free", "page", "pages", "virtual", "rest", "extended")),
        )

    status = Status(length=ctypes.sizeof(Status))
    windll = getattr(ctypes, "windll", None)
    if windll is None or not windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)):
        return None
    return int(status.total)


def _control_group() -> int | None:
    """Return the least memory limit of the process's control group and of those above it, of version 2 or 1."""
    limits = []
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, group = line.split(":", 2)
            if controllers not in ("", "memory") and "memory" not in controllers.split(","):
                continue
            root, name = (
                ("/sys/fs/cgroup/memory", "memory.limit_in_bytes") if controllers else ("/sys/fs/cgroup", "memory.max")
            )
            # In a container the group's path may be that of the host: the root has the limit then.
            folder = Path(root, group.lstrip("/"))
            for place in {folder, *folder.parents, Path(root)}:
                if place.is_relative_to(root):
                    with contextlib.suppress(OSError, ValueError):  # "max" is no limit
                        limits.append(int((place / name).read_text()))
    return min(limits, default=None)


def _address_space() -> int | None:
    """Return the limit of the address space, as `ulimit -v` sets it."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    found = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA)]
    return min((value for value in found if value != resource.RLIM_INFINITY), default=None)
