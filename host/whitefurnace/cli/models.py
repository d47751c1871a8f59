"""`whitefurnace models`: what it prints and its JSON rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import print_row
from whitefurnace.errors import UsageError, nearest
from whitefurnace.text import table

if TYPE_CHECKING:
    from whitefurnace.catalogue import Model

EPILOG = "\b\nExamples:\n  whitefurnace models\n  whitefurnace models ggx --json"


@options.command("Lists", "List the reflectance models with their parameters and sources", EPILOG)
@click.argument("name", required=False)
@options.as_json()
def models(name: str | None, as_json: bool) -> None:
    """List the models of the catalogue, or show one: its parameters with their ranges, its source, and known facts."""
    from whitefurnace.catalogue import SLOTS
    from whitefurnace.catalogue import models as of_slot

    entries = [entry for slot in SLOTS for entry in of_slot(slot).values()]
    if name is not None:
        wanted = [entry for entry in entries if entry.name == name]
        if not wanted:
            raise UsageError(f"unknown model {name!r}{nearest(name, [entry.name for entry in entries])}")
        entries = wanted
    if as_json:
        for row in model_rows(entries):
            print_row(row)
    else:
        click.echo(models_text(entries) if name is None else "\n\n".join(model_text(entry) for entry in entries))


def models_text(entries: Sequence[Model]) -> str:
    """Return the table of the catalogue."""
    rows = [[e.slot, e.name, e.title, ", ".join(_domains(e)), e.citation.key] for e in entries]
    return table(["slot", "name", "title", "parameters", "source"], rows, left=5)


def _domains(entry: Model) -> list[str]:
    """Return `NAME [low, high]` for each parameter. A vector's components are one item, `NAME_x/y/z`, whatever their
    number.
    """
    found = []
    for p in entry.parameters:
        stem, _, axis = p.name.rpartition("_")
        if not {f"{stem}_{a}" for a in "xyz"} <= {q.name for q in entry.parameters}:
            found.append(f"{p.name} [{p.low:g}, {p.high:g}]" if p.high < 1e9 else p.name)
        elif axis == "x":
            found.append(f"{stem}_x/y/z")
    return found


def model_text(entry: Model) -> str:
    """Return the text of one model: everything that its entry states."""
    lines = [f"{entry.slot} {entry.name}: {entry.title}", f"  source      {entry.citation.text}"]
    rows = [
        [
            p.name,
            p.symbol,
            f"[{p.low:g}, {p.high:g}]",
            "" if p.default is None else f"{p.default:g}",
            ", ".join(f"{v:g}" for v in p.typical),
            p.about,
        ]
        for p in entry.parameters
    ]
    if rows:
        lines += [
            "  parameters",
            table(
                ["  name", "symbol", "domain", "default", "typical values", "what it is"],
                [[f"  {row[0]}", *row[1:]] for row in rows],
                left=6,
            ),
        ]
    facts = [(name, fact) for name, fact in entry.facts.items() if isinstance(fact, str | int | float)]
    lines += [f"  {'facts' if k == 0 else '':10}  {name}: {fact}" for k, (name, fact) in enumerate(facts)]
    for k, (name, values) in enumerate(entry.presets.items()):
        shown = ", ".join(
            f"{key} = {'/'.join(f'{x:g}' for x in v) if isinstance(v, tuple) else f'{v:g}'}"
            for key, v in values.items()
        )
        lines.append(f"  {'presets' if k == 0 else '':10}  {entry.name}:{name}  {shown}")
    return "\n".join(lines)


def model_rows(entries: Sequence[Model]) -> list[dict[str, Any]]:
    """Return the JSON rows of the catalogue."""
    return [
        {
            "slot": e.slot,
            "name": e.name,
            "title": e.title,
            "citation": e.citation.key,
            "parameters": [
                {
                    "name": p.name,
                    "symbol": p.symbol,
                    "unit": p.unit,
                    "domain": [p.low, p.high],
                    "typical": list(p.typical),
                    "about": p.about,
                }
                for p in e.parameters
            ],
            "presets": {name: dict(values) for name, values in e.presets.items()},
            "facts": {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in e.facts.items()},
        }
        for e in entries
    ]
