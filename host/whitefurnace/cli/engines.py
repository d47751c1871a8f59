"""`whitefurnace engines`: its options, what it prints and its JSON rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import print_row
from whitefurnace.errors import UsageError
from whitefurnace.text import table

if TYPE_CHECKING:
    from whitefurnace.engines.presets import Engine

EPILOG = (
    "\b\nExamples:\n  whitefurnace engines\n  whitefurnace engines filament\n"
    "  whitefurnace engines bevy --toml > my_engine.toml"
)


@options.command("Lists", "List the engines that files can be baked for", EPILOG)
@click.argument("name", required=False)
@options.option(
    "--toml",
    "as_toml",
    is_flag=True,
    heading=options.RUNNING,
    help="Print the engine as TOML, a file that --for takes: a start for an engine of your own.",
)
@options.as_json()
def engines(name: str | None, as_toml: bool, as_json: bool) -> None:
    """List the engines that `--for` knows, or show one (also a FILE.toml): its files, the roughness of each level, its
    conventions, and the steps to load the files."""
    from whitefurnace.engines.presets import ENGINES, as_text
    from whitefurnace.engines.presets import engines as named

    found = list(ENGINES.values()) if name is None else list(named(name))
    if as_toml:
        if name is None or len(found) > 1 or found[0].container != "files":
            raise UsageError("--toml writes one engine: give a NAME, and neither raw nor exr")
        click.echo(as_text(found[0]), nl=False)
    elif as_json:
        for engine in found:
            print_row({"event": "engine", **engine.data()})
    else:
        click.echo(engines_text(found) if name is None else "\n\n".join(map(engine_text, found)))


def engines_text(engines: Sequence[Engine]) -> str:
    """Return the table of the engines that `--for` knows."""
    rows = [
        [
            e.name,
            e.title.partition(": ")[0],
            "seen" if e.proven else "",
            e.lods_text,
            e.sh or "",
            "" if e.container != "files" else f"{e.dfg.size}² {e.dfg.form}",
        ]
        for e in engines
    ]
    return table(["engine", "description", "proven", "lod(r)", "harmonics", "table"], rows, left=6)


def engine_text(engine: Engine) -> str:
    """Return the text of one engine: its files and how it reads them."""
    lines = [
        f"{engine.name}: {engine.title}",
        f"  facts      {engine.facts}",
        f"  lod(r)     {engine.lods_text}" + (", past r = 1 a lobe of that α" if engine.follow else ""),
        f"  sizes      {engine.size}², " + (f"{engine.levels} levels" if engine.levels else f"to {engine.min_size}²"),
        f"  axes       {engine.axes}",
    ]
    if engine.container == "files":
        lines += [f"  direction  mix(mirror, normal, {engine.bend})"] if engine.bend != "0" else []
        lines += [f"  radiance   mix(prefiltered, E/π, {engine.blend})"] if engine.blend != "0" else []
        lines += [f"  least r    {engine.least:g}"] if engine.least else []
        lines += [f"  harmonics  {engine.sh}"] if engine.sh else []
        d = engine.dfg
        lines += [
            f"  table      {d.size}², x = {d.x}, y = {d.y}, {d.form}"
            + (f", Charlie × {d.charlie_masking}" if d.charlie else "")
        ]
        lines += [f"  sheen      {engine.sheen}"] if engine.sheen else []
        lines += [
            f"  file       {file.name.replace('{stem}', 'STEM')}: {file.holds}, {file.stored}" for file in engine.file
        ]
        lines += [f"  step       {step}" for step in engine.steps]
    return "\n".join(lines)
