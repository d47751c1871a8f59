"""`whitefurnace compare`: its options, what it prints and its JSON rows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import plain, plots_into, print_row, say
from whitefurnace.errors import CheckError, UsageError
from whitefurnace.text import table

if TYPE_CHECKING:
    from whitefurnace.inspection.comparison import Comparison

EPILOG = """\b
Examples:
  whitefurnace compare studio.ktx baked/raw/studio.npz
  whitefurnace compare theirs.dds ours.ktx2 --axes-a three --max-error 1e-2 --plot figures

B is the reference. `error` of a level is the 99th percentile of its texel errors, max over channels of
|a - b| / max(b, 1e-3 of the level's mean); `worst` is the largest and `rmse` the relative RMSE by solid angle. Errors
of tables are absolute; those of harmonics are relative to the largest L00. Levels are matched by size, and by roughness
where both files state it. Where no size is common, level 0 is compared with level 0.

Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 5 not supported, 7 past --max-error,
130 interrupted.
"""


def axes(letter: str, default: str) -> options.Decorator:
    """Return the option `--axes-a` or `--axes-b`, with `default` for its help."""
    return options.option(
        f"--axes-{letter.lower()}",
        metavar="AXES",
        heading="Comparison",
        help=f'Axes that {letter} is stored in, as "-x +y +z" or the name of an engine. {default}',
    )


@options.command("Look and compare", "Compare the cubes, tables or harmonics of two files", EPILOG)
@click.argument("a", type=options.FilePath)
@click.argument("b", type=options.FilePath)
@options.plot("error maps")
@options.option(
    "--max-error",
    metavar="X",
    type=float,
    heading="Comparison",
    help="End with exit code 7 if the `error` of a level, or the `worst` of a table or of harmonics, is "
    "larger than X (0 or more).",
)
@axes("A", "[default: those of the engine that it was written for, else +x +y +z]")
@axes("B", "[default: as for A]")
@options.layer("Comparison", "--layer-a", "A, an OpenEXR file")
@options.layer("Comparison", "--layer-b", "B, an OpenEXR file")
@options.memory()
@options.as_json()
def compare(
    a: Path,
    b: Path,
    folder: Path | None,
    max_error: float | None,
    axes_a: str | None,
    axes_b: str | None,
    layer_a: str | None,
    layer_b: str | None,
    as_json: bool,
) -> None:
    """Compare the cubes, lat-longs, tables or harmonics of two files, in whichever containers they are."""
    from whitefurnace.inspection import comparison
    from whitefurnace.inspection.contents import contents

    if max_error is not None and not 0 <= max_error < float("inf"):
        raise UsageError(f"max-error {max_error} is outside [0, inf)")
    if folder is not None:
        plots_into(folder)
    found = comparison.compare(contents(a, layer=layer_a), contents(b, layer=layer_b), axes_a=axes_a, axes_b=axes_b)
    for row in compared_rows(found) if as_json else ():
        print_row(row)
    for notice in found.notices:
        say(f"notice: {notice}")
    if not as_json:
        click.echo(compared_text(found))
    if folder is not None:
        from whitefurnace.inspection.figures import draw_comparison

        path = draw_comparison(folder, found)
        if as_json:
            print_row({"event": "plot", "file": str(path)})
        else:
            click.echo(f"  wrote {path}")
    if max_error is not None and (beyond := found.beyond(max_error)) is not None:
        what = "error" if beyond.kind == "level" else "worst"
        raise CheckError(f"{beyond.part} of {a} has {what} {beyond.bounded:.3g} against {b}, {max_error:g} is allowed")


def compared_text(found: Comparison) -> str:
    """Return the table of the errors of A against B, a row for each part."""
    rows = [
        [
            row.part,
            row.size,
            "" if row.roughness is None else f"{row.roughness:.3f}",
            f"{row.error:.1e}",
            f"{row.worst:.1e}",
            "" if row.rmse is None else f"{row.rmse:.1e}",
            "" if row.stated is None else f"{row.stated:.1e}",
            row.method,
            row.at,
        ]
        for row in found.rows
    ]
    head = ["", "size", "r", "error", "worst", "rmse", "stated", "compared", "the worst at"]
    lines = [
        f"{found.a.path} ({found.a.kind}, {found.a.container}) against "
        f"{found.b.path} ({found.b.kind}, {found.b.container})"
    ]
    return "\n".join([*lines, table(head, rows)])


def compared_rows(found: Comparison) -> list[dict[str, Any]]:
    """Return the JSON rows of a comparison."""
    return [
        {
            "event": "compared",
            "part": row.part,
            "kind": row.kind,
            "size": row.size,
            "roughness": row.roughness,
            "error": plain(row.error),
            "worst": plain(row.worst),
            "rmse": plain(row.rmse),
            "stated": row.stated,
            "method": row.method,
            "worst_at": row.at,
        }
        for row in found.rows
    ]
