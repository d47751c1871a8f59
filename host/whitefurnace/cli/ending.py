"""How a command ends: its streams, the signals that end it, and every error as one sentence with an exit code."""

from __future__ import annotations

import atexit
import contextlib
import errno
import importlib.metadata
import os
import platform
import re
import shlex
import signal
import socket
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import click

from whitefurnace.cli.options import NoReader
from whitefurnace.cli.terminal import abandon, print_row, say
from whitefurnace.errors import InternalError, WhitefurnaceError
from whitefurnace.version import VERSION

EXIT_NO_READER = 128 + 13
"""Exit code where the reader of stdout went away, as shells report a program that SIGPIPE ended."""

HINTS = {
    errno.ENOSPC: "; free some space there",
    errno.EDQUOT: "; free some space there",
    errno.EFBIG: "; a larger file must be allowed (ulimit -f)",
    errno.EMFILE: "; more open files must be allowed (ulimit -n)",
    errno.ENFILE: "; other programs hold too many open files",
}
"""The remedy for each error of the system, by its number."""


# ---------------------------------------------------------------------------------------------- streams


def open_streams() -> None:
    """Connect standard streams that the caller closed to the null device.

    Otherwise the next file that is opened takes their number, and what a driver or library prints goes into it.
    """
    for number, mode in enumerate((os.O_RDONLY, os.O_WRONLY, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            handle = os.open(os.devnull, mode)
            if handle != number:
                os.dup2(handle, number)
                os.close(handle)
            os.set_inheritable(number, True)
    for name, how in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, how, encoding="utf-8"))


def close_streams() -> None:
    """Flush stdout and stderr; where one cannot be written, Python's own flush at exit must not fail once more."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            abandon(stream)


# ---------------------------------------------------------------------------------------------- signals


class Ended(BaseException):
    """A signal asked this process to end. It is raised in the main thread, so that everything is cleaned up."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.name, self.exit_code = signal.Signals(number).name, 128 + number


SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))

PATIENCE = 5.0
"""Seconds that a driver may keep a signal waiting: a kernel that is slow ends in them, and one without end does not."""


class _Watch:
    """Ends this process after a signal that the main thread cannot hear, since a call of the driver does not return.

    Python runs the handler of a signal in the main thread, and only between two of its own instructions. The number of
    the signal is written to a socket at once, where a thread reads it.
    """

    def __init__(self) -> None:
        self.heard = threading.Event()
        self._numbers, self._written = socket.socketpair()
        self._written.setblocking(False)  # signal.set_wakeup_fd needs that
        self._before = signal.set_wakeup_fd(self._written.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while numbers := self._numbers.recv(1):
            number = numbers[0]
            # A handler that somebody else has set ends nothing here.
            ours = getattr(signal.getsignal(number), "__module__", "") == __name__
            if ours and not self.heard.wait(PATIENCE):
                name = signal.Signals(number).name
                say(f"ended by {name} while the device computed; the next run removes what this one left")
                os._exit(128 + number)
        self._numbers.close()

    def close(self) -> None:
        """Watch no longer."""
        signal.set_wakeup_fd(self._before)
        self.heard.set()
        self._written.close()


@contextlib.contextmanager
def listening() -> Iterator[None]:
    """Raise `Ended` for SIGTERM and SIGHUP within the `with` block, where the caller does not ignore them.

    During an import the signal waits: an extension module that is interrupted while it starts reports another error.
    While the driver computes it waits for `PATIENCE` seconds at most, as does Ctrl-C; then the process ends at once.
    """

    top = sys._getframe(2)
    watch: _Watch | None = None

    def interrupted(number: int, frame: FrameType | None) -> None:
        if watch is not None:
            watch.heard.set()
        raise KeyboardInterrupt

    def heard(number: int, frame: FrameType | None) -> None:
        if watch is not None:
            watch.heard.set()
        if _imports(frame, top):
            again = threading.Timer(0.02, _signal_main_thread, [number])
            again.daemon = True
            again.start()
            return
        for other in SIGNALS:  # a second one would stop the cleaning
            signal.signal(other, signal.SIG_IGN)
        raise Ended(number)

    before: dict[int, Any] = {}
    with contextlib.suppress(ValueError):  # not the main thread
        for number in SIGNALS:
            if signal.getsignal(number) == signal.SIG_DFL:
                before[number] = signal.signal(number, heard)
        if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
            before[signal.SIGINT] = signal.signal(signal.SIGINT, interrupted)
        if before:
            watch = _Watch()
    try:
        yield
    finally:
        if watch is not None:
            watch.close()
        for number, handler in before.items():
            signal.signal(number, handler)


def _signal_main_thread(number: int) -> None:
    """Send a signal to the main thread itself, whose sleep or wait it then interrupts; another thread's would not."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)


def _imports(frame: FrameType | None, top: FrameType) -> bool:
    """Whether a module is being imported in a frame, or in one that it was called from below `top`."""
    while frame is not None and frame is not top:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def leave(code: int) -> NoReturn:
    """End this process after a signal.

    sys.exit does not do: Python ends a process by SIGINT, whatever is asked, if the interrupt came inside an exec, as
    of a dataclass at import. It also waits for threads, and those of a driver may never end.
    """
    last = threading.Thread(target=_run_exit_functions, daemon=True)
    last.start()
    last.join(PATIENCE)  # one of them waits for running kernels, which may never end
    close_streams()
    os._exit(code)


def _run_exit_functions() -> None:
    with contextlib.suppress(BaseException):
        atexit._run_exitfuncs()


# ---------------------------------------------------------------------------------------------- errors


def tell(error: BaseException, argv: Sequence[str]) -> int:
    """Print an error as one sentence on stderr, with --json as a row on stdout too; return its exit code.

    With --debug the traceback stands before it.
    """
    if "--debug" in argv:
        say("".join(traceback.format_exception(error)).rstrip())
    if isinstance(error, BrokenPipeError | NoReader):  # nobody is told
        abandon(sys.stdout)
        return EXIT_NO_READER
    sentence, code = told(error, argv)
    if "--json" in argv:
        try:
            print_row({"event": "error", "message": sentence, "exit_code": code})
        except OSError:  # nobody reads stdout; the code still tells
            abandon(sys.stdout)
    say(f"error: {sentence}")
    return code


def told(error: BaseException, argv: Sequence[str]) -> tuple[str, int]:
    """Return the sentence and the exit code of an error. An unexpected one is reported into a file."""
    if isinstance(error, WhitefurnaceError):
        return str(error), error.exit_code
    if isinstance(error, click.ClickException):
        return error.format_message(), 1
    if isinstance(error, MemoryError):
        return "there is not enough memory for this; a smaller input or size is needed", 2
    if isinstance(error, RecursionError):
        return "the input is nested too deeply to be read", 3
    if isinstance(error, OSError):
        what = "write the results" if error.filename is None else f"use {error.filename}"
        return f"cannot {what}: {error.strerror or error}{HINTS.get(error.errno or 0, '')}", 2
    line = " ".join(f"{type(error).__name__}: {error}".split())
    line = line if len(line) <= 200 else f"{line[:197]}..."
    path = report(error, argv)
    where = f"please send the report {path}" if path else "please report it with what --debug prints"
    return f"this is a fault of whitefurnace ({line}); {where}", InternalError.exit_code


def report(error: BaseException, argv: Sequence[str]) -> Path | None:
    """Write a report of an unexpected error into the folder for temporary files; return its path, None without room.

    It holds the traceback, versions, the device and the command line, without passwords of addresses, and ~ in place of
    the user's folder. It holds no environment variables and no values of variables.
    """
    text = "\n".join(
        [
            f"whitefurnace {VERSION}, Python {platform.python_version()}, {platform.platform()}",
            *(f"{name} {version}" for name in ("numpy", "pyopencl", "OpenImageIO") if (version := _version(name))),
            *_devices(),
            f"whitefurnace {shlex.join(map(str, argv))}",
            "",
            *(line.rstrip("\n") for line in traceback.format_exception(error)),
            "",
        ]
    )
    text = re.sub(r"(\w://)[^/@\s]*@", r"\1...@", text)
    home = os.path.expanduser("~")
    if len(home) > 1:
        text = text.replace(home, "~")
    try:
        handle, name = tempfile.mkstemp(prefix="whitefurnace-report-", suffix=".txt")
        with open(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
    except OSError:
        return None
    return Path(name)


def _version(name: str) -> str | None:
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(name)
    return None


def _devices() -> list[str]:
    """A line for each OpenCL device that was in use, without a call of its driver."""
    module = sys.modules.get("whitefurnace.opencl.device")
    return [] if module is None else [f"device {', '.join(one.values())}" for one in module.identities_in_use()]
