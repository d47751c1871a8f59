"""Measures the kernels against the limits of the device, and the prefilter's error against its time.

Runs `whitefurnace bench` and `whitefurnace bench tradeoff`, the latter for the demo and every environment in the folder
that WHITEFURNACE_ENVIRONMENTS names.

    python benchmarks/bench.py [-n RUNS] [--markdown | --docs] [--plot DIR]

--docs writes the tables into docs/bench.md and the plot into docs/pictures.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "docs/bench.md"


def environments() -> list[str]:
    """Return the sources of the trade-off: paths of environments, and `demo`."""
    folder = os.environ.get("WHITEFURNACE_ENVIRONMENTS")
    found = [p for p in sorted(Path(folder).iterdir()) if p.suffix in (".exr", ".hdr")] if folder else []
    return [*map(str, found), "demo"]


def bench(*arguments: str) -> list[dict]:
    """Run `whitefurnace bench`; return its JSON rows."""
    done = subprocess.run(
        [sys.executable, "-m", "whitefurnace", "bench", *arguments, "--json"],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


def number(value: float | None) -> str:
    """Return a number with three digits and no exponent; an empty text for None."""
    return "" if value is None else f"{float(f'{value:.3g}'):g}"


def three(row: dict, factor: float = 1.0) -> str:
    """Return the median, the minimum and the maximum of a row as text."""
    return "{} ({} … {})".format(*(number(factor * row[name]) for name in ("median", "min", "max")))


def machine(device: dict) -> str:
    return f"{device['name']}, {device['platform']} {device['driver']}; {os.cpu_count()} cores."


def throughput(rows: list[dict]) -> tuple[str, list[str], list[list[str]]]:
    """Return a heading, the columns, and a row for each kernel with its rates in float32 and float64."""
    can = next(row for row in rows if row["event"] == "yardstick")
    peaks = ", ".join(f"{three(spread)} GFLOP/s in {name}" for name, spread in can["gflops"].items())
    said = (
        f"{machine(can['device'])} Multiply-adds {peaks}; memory read {three(can['read_gbytes'])} GB/s, triad "
        f"{three(can['triad_gbytes'])} GB/s."
    )
    found = {(row["case"], row["precision"]): row for row in rows if row["event"] == "case"}
    table = []
    for case in dict.fromkeys(name for name, _ in found):
        cells = [case, next(row["unit"] for row in found.values() if row["case"] == case) + "s"]
        for precision in (32, 64):
            row = found.get((case, precision))
            cells += (
                ["", "", "", ""]
                if row is None
                else [
                    three(row["per_second"], 1e-6),
                    number(row["gflops"]),
                    "" if row["of_peak"] is None else f"{row['of_peak']:.2f}",
                    f"{row['of_memory']:.2f}",
                ]
            )
        table.append(cells)
    columns = ["GFLOP/s", "of peak", "of memory"]
    return said, ["kernel", "unit", "float32: M/s (min … max)", *columns, "float64: M/s (min … max)", *columns], table


def tradeoff(rows: list[dict]) -> tuple[str, list[str], list[list[str]]]:
    """Return a heading, the columns, and a row for each setting with its time and error on every environment."""
    found = {(row["method"], row["setting"], row["environment"]): row for row in rows if row["event"] == "point"}
    names = list(dict.fromkeys(name for _, _, name in found))
    table = []
    for method, setting in dict.fromkeys(key[:2] for key in found):
        cells = [method, f"{setting:g}"]
        for name in names:
            row = found.get((method, setting, name))
            cells.append(
                ""
                if row is None
                else f"{number(1e3 * row['seconds']['median'])} ms, {row['error']:.1e}" + (" *" if row["front"] else "")
            )
        table.append(cells)
    device = next(row for row in rows if row["event"] == "device")["device"]
    return f"{machine(device)} * is on the front.", ["method", "setting", *names], table


def markdown(said: str, head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in [head, *rows]]
    return "\n".join([said, "", lines[0], "|" + "---|" * len(head), *lines[1:]])


def plain(said: str, head: list[str], rows: list[list[str]]) -> str:
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    return "\n".join(
        [
            said,
            *("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in [head, *rows]),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", "--runs", type=int, default=5)
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--plot", metavar="DIR")
    options = parser.parse_args()
    folder = str(PAGE.parent / "pictures") if options.docs else options.plot
    runs = ["--runs", str(options.runs)]
    parts = {
        "throughput": throughput(bench(*runs)),
        "tradeoff": tradeoff(bench("tradeoff", *environments(), *runs, *(["--plot", folder] if folder else []))),
    }
    for name, part in parts.items():
        if options.docs:
            text = PAGE.read_text("utf-8")
            block = re.compile(rf"(<!-- {name}: [^\n]*-->\n).*?(<!-- end -->)", re.DOTALL)
            if not block.search(text):
                sys.exit(f"docs/bench.md has no <!-- {name}: … --> … <!-- end -->")
            PAGE.write_text(
                block.sub(lambda found, part=part: found[1] + markdown(*part) + "\n" + found[2], text), "utf-8"
            )
        print(markdown(*part) if options.markdown else plain(*part), end="\n\n")


if __name__ == "__main__":
    main()
