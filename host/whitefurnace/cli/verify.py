"""`whitefurnace verify`: its options, what it prints and its JSON rows."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import of_one, plain, plots_into, print_row, progress, say
from whitefurnace.errors import CheckError, UsageError

if TYPE_CHECKING:
    from whitefurnace.verification.checks import Row

EPILOG = """\b
Examples:
  whitefurnace verify
  whitefurnace verify ggx smith burley --precision 32
  whitefurnace verify gtr:gamma=2 schlick:gold --plot figures
  whitefurnace verify my_lobe.clh:alpha=.3 my_brdf.clh:roughness=.5 --json

A row is the worst cell of a check: its value, the expected value or bound, the error and the tolerance, all absolute.
The entry of a model says what is checked; `whitefurnace models NAME` shows it. The verdict `info` marks a value that is
measured for information and has no tolerance. A FILE.clh defines ndf_STEM_D or brdf_STEM_f; give all its parameters.

Exit codes: 0 all passed, 1 usage, 2 cannot read or write, 3 invalid input (an NDF that cannot be normalized), 4 device
or build, 5 not supported, 7 a check failed, 130 interrupted.
"""


@options.command("Prove and measure", "Check models against exact values and float64 references", EPILOG)
@click.argument("specs", metavar="[MODEL|FILE.clh...]", nargs=-1)
@options.plot("shapes, curves and error maps")
@options.option(
    "--precision",
    metavar="32|64",
    type=int,
    heading="Accuracy",
    help="Check one floating-point precision only. [default: both, where the device has float64]",
)
@options.device()
@options.as_json()
@options.quiet("Print failed checks only.")
def verify(
    specs: tuple[str, ...], folder: Path | None, precision: int | None, device: str | None, as_json: bool, quiet: bool
) -> None:
    """Check models against exact values, float64 references and the facts that their entries state.

    Without a MODEL the whole catalogue is checked; otherwise those named (ggx, ggx:alpha=.3, schlick:gold) and files
    of your own.
    """
    from whitefurnace.opencl.device import choose_device
    from whitefurnace.verification import checks

    start = time.perf_counter()
    if precision not in (None, *checks.PRECISIONS):
        raise UsageError(f"precision {precision} is not one of 32, 64")
    subjects = checks.subjects(specs)
    if folder is not None:
        plots_into(folder)
    on = choose_device(device)
    both = checks.PRECISIONS if on.fp64 else (32,)
    if precision is None and not on.fp64 and not quiet:
        say(f"notice: {on.identity()['name']} has no float64: float32 only")
    rows: list[Row] = []
    with progress(not (quiet or as_json)) as report:
        found = checks.verify(subjects, (precision,) if precision else both, on, of_one(report, "verify"))
        for _, group in groupby(found, key=lambda row: (row.slot, row.model)):
            some = list(group)
            _print_rows(some, not rows, as_json, quiet)
            rows += some
    if folder is not None:
        from whitefurnace.verification.figures import draw

        for path in draw(folder, [subject.model for subject in subjects], rows, on):
            if as_json:
                print_row({"event": "plot", "file": str(path)})
            elif not quiet:
                click.echo(f"  wrote {path}")
    if not (quiet or as_json):
        click.echo(verify_summary(rows, time.perf_counter() - start, on.identity()["name"]))
    failed = [row for row in rows if not row.passed]
    if failed:
        raise CheckError(
            f"{len(failed)} of {len(rows)} checks failed, the first: {failed[0].slot} {failed[0].model}, "
            f"{failed[0].check} in float{failed[0].precision}"
        )


def _print_rows(rows: Sequence[Row], first: bool, as_json: bool, quiet: bool) -> None:
    """Print the checks of one model, under the head of the table if they are the first."""
    if as_json:
        for row in verify_rows(rows):
            print_row(row)
    elif shown := [row for row in rows if not (quiet and row.passed)]:
        if first:
            click.echo(VERIFY_HEAD)
        click.echo(verify_text(shown))


VERIFY_HEAD = (
    f"  {'check':<40} {'float':>5} {'value':>14} {'expected':>12} {'error':>8} {'tolerance':>9}  verdict  worst at"
)


def verify_text(rows: Sequence[Row]) -> str:
    """Return the lines below `VERIFY_HEAD` for one model: the worst cell of each check, and counterexamples."""
    lines = [f"{rows[0].slot} {rows[0].model}"]
    for row in rows:
        verdict = "FAIL" if not row.passed else "pass" if row.tolerance is not None else "info"
        expected, error, tolerance = (
            "" if x is None else format(x, digits)
            for x, digits in ((row.expected, ".8g"), (row.error, ".1e"), (row.tolerance, ".1e"))
        )
        figures = f"{row.value:>14.9g} {expected:>12} {error:>8} {tolerance:>9}"
        lines.append(f"  {row.check:<40} {row.precision:>5} {figures}  {verdict:<7}  {_where(row.parameters)}".rstrip())
        if not row.passed:
            lines += [
                f"      counterexample: {_where(row.counterexample or {}, '.9g')}".rstrip(),
                *([f"      {row.note}"] if row.note else []),
            ]
    return "\n".join(lines)


def _where(values: Mapping[str, Any], digits: str = ".4g") -> str:
    return ", ".join(
        f"{name} = ({', '.join(format(x, digits) for x in v)})" if isinstance(v, Sequence) else f"{name} = {v:{digits}}"
        for name, v in values.items()
    )


def verify_summary(rows: Sequence[Row], seconds: float, device: str) -> str:
    """Return the summary: the number of checks and models, and how many passed."""
    informational = sum(row.tolerance is None and row.passed for row in rows)
    failed = sum(not row.passed for row in rows)
    subjects = len({(row.slot, row.model) for row in rows})
    return (
        f"{len(rows) - informational} checks of {subjects} {'model' if subjects == 1 else 'models'}: "
        f"{len(rows) - informational - failed} passed, {failed} failed"
        + (f"; {informational} informational {'value' if informational == 1 else 'values'}" if informational else "")
        + f"; {seconds:.1f} s on {device}"
    )


def verify_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the JSON rows of checks; NaN and infinities are strings."""
    return [
        {
            "event": "check",
            "slot": r.slot,
            "model": r.model,
            "check": r.check,
            "parameters": plain(r.parameters),
            "precision": r.precision,
            "value": plain(r.value),
            "expected": plain(r.expected),
            "error": plain(r.error),
            "tolerance": plain(r.tolerance),
            "passed": r.passed,
            "cells": r.cells,
            "note": r.note,
            "counterexample": plain(r.counterexample),
        }
        for r in rows
    ]
