"""`whitefurnace batch`: its options, what it prints and its JSON rows."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import print_row, say
from whitefurnace.text import size

if TYPE_CHECKING:
    from whitefurnace.batch.jobs import Result, Summary

EPILOG = """\b
Examples:
  whitefurnace batch probes.toml --dry-run
  whitefurnace batch probes.toml --workers 4
  whitefurnace batch probes.toml --shard 2/8 --depfile probes.2.d

JOB is a TOML file of tables [[bake]] and [[lut]].

A [[bake]] has `environments`, a list of paths and patterns (*, ?, [...] and **), `output`, a folder, `for`, a list,
and the options of `whitefurnace bake` under their names.

A [[lut]] has `kind`, `output`, a file, and the options of `whitefurnace lut`, `axis` and `set` as lists.

`item_timeout` at the top is the time limit of an item in seconds.

Paths are relative to the folder of JOB. The whole job is checked before anything runs. Outputs that are up to date are
skipped, whichever run made them, so a batch that was stopped continues where it was.

Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input (the job too), 4 device or build, 5 not supported,
7 a tolerance was missed, 8 part of several failed, 130 interrupted.
"""

OUTPUT, WORK = "Output", "Division of the work"


@options.command("Scenes and batches", "Run the bakes and tables of a job file, each once", EPILOG)
@click.argument("job", type=options.FilePath)
@options.option(
    "-o",
    "--output",
    "root",
    metavar="DIR",
    type=options.FilePath,
    heading=OUTPUT,
    help="Folder that must contain all outputs. [default: the folder of JOB]",
)
@options.option(
    "--report",
    "page",
    metavar="DIR",
    type=options.FilePath,
    heading=OUTPUT,
    help="Write DIR/index.html: for each item its levels as pictures, errors, time and size.",
)
@options.option(
    "--depfile",
    metavar="FILE",
    type=options.FilePath,
    heading=OUTPUT,
    help="Write Makefile rules that name each output and the files it was made from.",
)
@options.option(
    "--workers",
    metavar="N",
    type=int,
    default=1,
    show_default=True,
    heading=WORK,
    help="Number of processes on this machine, 1 to 1024. They share the cores of the device.",
)
@options.option(
    "--scheduler",
    metavar="tcp://HOST:PORT",
    heading=WORK,
    help="Run on a Dask cluster whose workers declare the resource OPENCL and see the same folders. Needs Dask.",
)
@options.option(
    "--send",
    is_flag=True,
    heading=WORK,
    help="Send the source images to the cluster, so that workers need not see their folders.",
)
@options.option(
    "--shard",
    metavar="I/N",
    heading=WORK,
    help="Run only every N-th item, beginning with the I-th, 1 to N. The N shards make the whole job.",
)
@options.option(
    "--item-timeout",
    metavar="SECONDS",
    type=float,
    heading=WORK,
    help="Time limit of an item: its worker process is killed and replaced, and the item fails. "
    "[default: `item_timeout` of JOB, else none]",
)
@options.option(
    "--allow-kernels",
    is_flag=True,
    heading=WORK,
    help="Allow the job to name .clh files. Their code runs on the device.",
)
@options.device()
@options.memory()
@options.dry_run()
@options.force()
@options.as_json()
@options.quiet("Print failures only.")
def batch(
    job: Path,
    root: Path | None,
    page: Path | None,
    depfile: Path | None,
    workers: int,
    scheduler: str | None,
    send: bool,
    shard: str | None,
    item_timeout: float | None,
    allow_kernels: bool,
    device: str | None,
    dry_run: bool,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Run many bakes and tables that a job file lists. Outputs that are up to date are skipped."""
    from whitefurnace import errors
    from whitefurnace.batch import jobs as batching
    from whitefurnace.batch import pool

    part = batching.shard_of(shard) if shard is not None else None
    if item_timeout is not None:
        pool.checked_limit(item_timeout)
    if send and scheduler is None:
        raise errors.UsageError("--send sends sources to a --scheduler's cluster, and none is given")
    made = batching.job(job, root=root, allow_kernels=allow_kernels, force=force, device=device, send=send)
    if part:
        made = made.shard(*part)
    summary = batching.Summary(len(made.items))
    results: list[Result] = []

    def report(result: Result) -> None:
        summary.add(result)
        if depfile is not None:
            results.append(result)
        _print_result(result, as_json, quiet)

    try:
        if dry_run:
            for result in made.predicted():
                report(result)
        else:
            written = print_row if as_json else None if quiet else lambda row: click.echo(f"report: {row['file']}")
            with _page(page, job.name, force, summary, written) as add, _bar(summary, not (quiet or as_json)) as show:

                def on_result(result: Result) -> None:
                    report(result)
                    add(result)
                    show()

                batching.run(
                    made,
                    workers=workers,
                    scheduler=scheduler,
                    item_timeout=item_timeout,
                    on_result=on_result,
                    on_notice=None if quiet else lambda text: say(f"notice: {text}"),
                )
        if depfile is not None and not dry_run:
            for notice in batching.depfile(made, results, depfile):
                say(f"notice: {notice}")
    finally:
        _print_summary(summary, as_json, quiet)
    if summary.failed:
        codes = {result.exit_code for result in summary.failed}
        kind = errors.of_code(codes.pop()) if len(codes) == 1 and len(summary.failed) == summary.total else None
        raise (kind or errors.PartialError)(f"{len(summary.failed)} of {summary.total} items failed")


def _print_result(result: Result, as_json: bool, quiet: bool) -> None:
    """Print an item that ended, and its notices."""
    if as_json:
        print_row(result_row(result))
    elif not quiet and (line := result_text(result)):
        click.echo(line)
    for notice in () if quiet else result.notices:
        say(f"notice: {result.place}: {notice}")


def _print_summary(summary: Summary, as_json: bool, quiet: bool) -> None:
    """Print the failures and the summary of a batch."""
    if as_json:
        print_row(summary_row(summary))
        return
    for line in failures_text(summary):
        say(line)
    if not quiet:
        click.echo(summary_text(summary))


@contextlib.contextmanager
def _page(
    folder: Path | None, title: str, force: bool, summary: Summary, written: Callable[[Mapping[str, Any]], None] | None
) -> Iterator[Callable[[Any], None]]:
    """Open the HTML page of a batch and give a function that adds an item.

    The page is written also when the batch is stopped. `written` is called with a row that names the page.
    """
    if folder is None:
        yield lambda result: None
        return
    from whitefurnace.batch.gallery import Gallery

    with Gallery(folder, title=title, force=force) as page:
        try:
            yield page.add
        finally:
            if summary.count:  # else the page of an earlier run stays
                path = page.close(total=summary.total)
                if written is not None:
                    written({"event": "report", "file": str(path)})


@contextlib.contextmanager
def _bar(summary: Summary, wanted: bool) -> Iterator[Callable[[], None]]:
    """Show a bar on stderr, where that is a terminal: the rate, the time left and the number of failures."""
    if not wanted or not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (MofNCompleteColumn(), BarColumn(), TextColumn("{task.description}"), TimeRemainingColumn(compact=True))
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=summary.total)
        yield lambda: bar.update(task, completed=summary.count, description=rate_text(summary))


def result_row(result: Result) -> dict[str, Any]:
    """Return the JSON row of an item of a batch."""
    row: dict[str, Any] = {
        "event": result.state,
        "kind": result.kind,
        "place": result.place,
        "name": result.name,
        "output": result.output,
    }
    if result.state == "failed":
        return {**row, "message": result.message, "exit_code": result.exit_code}
    row |= {"manifest": result.manifest, "files": result.files, "bytes": result.nbytes}
    row |= {"error": result.error} if result.error is not None else {}
    row |= {"predicted": result.predicted} if result.predicted else {}
    return {**row, "seconds": result.seconds, "notices": list(result.notices)}


def result_text(result: Result) -> str:
    """Return the text of an item: one line, with its files if it is planned; empty if it was skipped or failed."""
    if result.state == "done":
        error = "" if result.error is None else f", error {result.error:.1e}"
        return f"{result.place}: {size(result.nbytes)}{error}, {sum(result.seconds.values()):.2f} s"
    if result.state == "planned":
        about = (
            f"; about {result.predicted['cpu_seconds']:.2g} s of processor time and "
            f"{size(result.predicted['memory'])} of memory"
            if result.predicted
            else ""
        )
        return "\n".join(
            [
                f"{result.place}: {len(result.files)} file{'s' if len(result.files) > 1 else ''}, "
                f"{size(result.nbytes)} before compression{about}",
                *(f"  would write {path}  {size(nbytes)}" for path, nbytes in result.files.items()),
            ]
        )
    return ""


def rate_text(summary: Summary) -> str:
    """Return the items per second and the failures so far, as text."""
    failed = f", {len(summary.failed)} failed" if summary.failed else ""
    return f"{summary.count / max(summary.wall, 1e-9):.3g}/s{failed}"


def failures_text(summary: Summary) -> list[str]:
    """Return a line for each failure with its reason."""
    return [f"failed: {result.place}: {result.message} (exit code {result.exit_code})" for result in summary.failed]


def summary_text(summary: Summary) -> str:
    """Return the summary of a batch in one line."""
    states = {"done": "done", "planned": "to do", "skipped": "up to date", "failed": "failed"}
    items = "1 item" if summary.total == 1 else f"{summary.total} items"
    if summary.total and summary.states["skipped"] == summary.total:
        return f"{items}, all up to date: nothing to do; {summary.wall:.2f} s"
    counts = [f"{summary.states[state]} {text}" for state, text in states.items() if summary.states[state]]
    left = summary.total - summary.count
    counts += [f"{left} not begun"] if left else []
    line = f"{items}: {', '.join(counts) or 'none'}; {size(summary.nbytes)}"
    if summary.states["planned"]:
        return (
            line + f", about {summary.predicted['cpu_seconds']:.2g} s of processor time, "
            f"{size(summary.predicted['memory'])} of memory a worker"
        )
    stages = ", ".join(f"{name} {seconds:.2f}" for name, seconds in summary.seconds.items())
    return line + f", {summary.wall:.2f} s ({stages})"


def summary_row(summary: Summary) -> dict[str, Any]:
    """Return the JSON row of the summary, with every failure."""
    return {
        "event": "summary",
        "items": summary.total,
        **summary.states,
        "bytes": summary.nbytes,
        "wall": summary.wall,
        "seconds": summary.seconds,
        **({"predicted": summary.predicted} if summary.states["planned"] else {}),
        "failures": [{"place": r.place, "message": r.message, "exit_code": r.exit_code} for r in summary.failed],
    }
