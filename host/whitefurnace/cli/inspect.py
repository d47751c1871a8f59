"""`whitefurnace inspect`: what it prints and its JSON row."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import plain, print_row
from whitefurnace.text import size, table

EPILOG = """\b
Examples:
  whitefurnace inspect baked/raw/studio.npz
  whitefurnace inspect environment.env --json

FILE is a .ktx, .ktx2, .dds, .env, .gltf or .glb; a .npz, .npy, .h or manifest that whitefurnace wrote; harmonics as
text; or an image.

Exit codes: 0 done, 1 usage, 2 cannot read, 3 invalid input (truncated and corrupted files too), 130 interrupted.
"""


@options.command("Look and compare", "Show what a texture, table or image contains", EPILOG)
@click.argument("file", type=options.FilePath)
@options.layer(options.RUNNING)
@options.fill(options.RUNNING)
@options.memory()
@options.as_json()
def inspect(file: Path, layer: str | None, fill: str | None, as_json: bool) -> None:
    """Show what a texture, table or image contains: levels with their ranges, key-values, the engine it looks like, and
    the error that was stated when it was made."""
    from whitefurnace.inspection import contents

    row = contents.described(contents.contents(file, layer=layer, fill=fill))
    if as_json:
        print_row(plain(row))
    else:
        click.echo(inspect_text(row))


def inspect_text(row: Mapping[str, Any]) -> str:
    """Return the text of a file's contents.

    row: the value of `contents.described`.
    """
    lines = [f"{row['file']}: {row['kind']} in {row['container']}, {row['format']}"]
    header = {**row["header"], **({"bytes": size(row["header"]["bytes"])} if "bytes" in row["header"] else {})}
    for name in ("layers", "orientation"):
        if not header.get(name, 1):
            del header[name]
    lines.append("  " + ", ".join(f"{name} {value}" for name, value in header.items()))
    lines += [f"  notice: {notice}" for notice in row["notices"]]
    if row["levels"]:
        lines.append(
            table(
                ["", "size", "r", "bytes", "least", "mean", "largest", "error", "format", "to know"],
                [_inspected(level) for level in row["levels"]],
            )
        )
    if "sh" in row:
        lines.append(
            "  spherical harmonics: mean radiance "
            + ", ".join(f"{x * math.sqrt(1 / (4 * math.pi)):.4g}" for x in row["sh"][0])
        )
    proven = row["statement"] is not None and row["statement"]["manifest"] is not None
    for key, value in row["keys"].items():
        if proven and key.startswith("whitefurnace:"):  # the manifest says the same, and more
            continue
        first, *rest = str(value).splitlines() or [""]
        first = first if len(first) <= 70 else first[:70] + "…"
        lines.append(f"  key {key}: {first}" + (f" … {len(rest)} more lines" if rest else ""))
    lines += [f"  looks like a file of {said}" for said in row["looks_like"]]
    return "\n".join([*lines, *_stated(row["statement"])])


def _inspected(level: Mapping[str, Any]) -> list[str]:
    count = {name: level[name] for name in ("nan", "infinite", "negative", "at_limit") if level[name]}
    names = {"nan": "NaN", "infinite": "infinite", "negative": "negative", "at_limit": "at the format's limit"}
    notes = [f"{value} {names[name]}" for name, value in count.items()]
    notes += [f"alpha {level['alpha'][0]:.3g} … {level['alpha'][1]:.3g}"] if level["alpha"] else []
    mean, added = level["mean"], level.get("format_p99", level.get("format_worst"))
    return [
        level["name"],
        level["size"],
        "" if level["roughness"] is None else f"{level['roughness']:.3f}",
        "" if level["bytes"] is None else size(level["bytes"]),
        f"{level['low']:.3g}",
        " ".join(f"{x:.3g}" for x in mean),
        f"{level['high']:.4g}",
        f"{level['error']:.1e}" if "error" in level else "",
        "" if added is None else f"{added:.1e}",
        ", ".join(notes),
    ]


def _stated(statement: Mapping[str, Any] | None) -> list[str]:
    """Return lines with the facts that a manifest or the attributes of whitefurnace state about a file."""
    if statement is None:
        return ["  no manifest lists it, and it states no error"]
    lines = []
    if statement["manifest"] is not None:
        lines.append(
            f"  manifest {statement['manifest']}: "
            + ("the digests match" if statement["whole"] else "the digests do NOT match: files were changed since")
        )
    version = statement.get("whitefurnace", statement.get("version"))
    key = statement.get("key")
    made = [f"whitefurnace {version}"] if version else []
    made += [f"key {str(key)[:12]}…"] if key else []
    device = statement.get("device")
    made += [f"for {statement['engine']}"] if statement.get("engine") else []
    made += [f"on {device.get('name')}"] if isinstance(device, Mapping) else []
    if made:
        lines.append(f"  made by {', '.join(made)}")
    recipe = statement.get("recipe")
    if isinstance(recipe, Mapping):
        shown = {name: _short(value) for name, value in recipe.items() if value is not None}
        lines.append(
            "  recipe "
            + ", ".join(f"{name} {value if len(value) <= 60 else value[:60] + '…'}" for name, value in shown.items())
        )
    if isinstance(statement.get("integral"), str):
        error = statement.get("error")
        lines.append(
            f"  integral {statement['integral']}" + (f", error {error:.1e}" if isinstance(error, float) else "")
        )
    return lines


def _short(value: Any) -> str:
    """A value of a recipe on one line; a model is shown by its name."""
    if isinstance(value, Mapping):
        return str(value["name"]) if "name" in value else "/".join(f"{k}={_short(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return "+".join(_short(v) for v in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
