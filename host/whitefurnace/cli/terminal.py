"""Prints for all commands: JSON rows on stdout, notices on stderr, and progress bars where stderr is a terminal."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import click


def print_row(row: Mapping[str, Any]) -> None:
    """Print one JSON row on stdout. Raises ValueError for NaN and infinity: see `plain`."""
    text = json.dumps(row, ensure_ascii=False, allow_nan=False, default=str)
    # A name that is not UTF-8 has characters that only escapes of JSON can hold.
    click.echo(text.encode("utf-8", "backslashreplace").decode())


def say(text: str) -> None:
    """Print a line on stderr. Where stderr cannot be written the line is lost, and nothing else."""
    try:
        click.echo(text, err=True)
    except OSError:
        abandon(sys.stderr)


def abandon(stream: TextIO) -> None:
    """Send what is still to be flushed to the null device, so that Python's own flush at exit does not fail."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def plain(value: Any) -> Any:
    """Return `value` as JSON can hold it, also inside mappings and lists: NaN and infinities as strings, tuples as
    lists.
    """
    if isinstance(value, Mapping):
        return {name: plain(v) for name, v in value.items()}
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return [plain(v) for v in value] if isinstance(value, list | tuple) else value


@contextlib.contextmanager
def progress(wanted: bool) -> Iterator[Callable[[str, str, float], None] | None]:
    """Show progress bars on stderr, where that is a terminal, while the block runs.

    The block gets a function of a name, the current activity and the share in [0, 1] that is done; each name has its
    own bar. It gets None where no bar is wanted or possible.
    """
    if not wanted or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, Any] = {}

        def report(name: str, what: str, share: float) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=1.0)
            bar.update(tasks[name], completed=share, description=f"{name}  {what}")

        yield report


def of_one(report: Callable[[str, str, float], None] | None, name: str) -> Callable[[str, float], None] | None:
    """Return the progress function of one named piece of work, or None where `report` is None.

    The function takes the current activity and the share in [0, 1] that is done.
    """
    return None if report is None else lambda what, share: report(name, what, share)


def plots_into(folder: Path) -> None:
    """Make the folder for plots before the work begins, so that an error is found early.

    Raises UnsupportedError where matplotlib is not installed, and FileError where the folder cannot be made.
    """
    from whitefurnace import plot_style
    from whitefurnace.errors import FileError

    plot_style.require()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{folder}: cannot be made: {error.strerror}") from None
