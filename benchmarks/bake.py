"""Measures the cost and the stated errors of a default bake.

The cost is the CPU time and the memory of a whole process on a warm kernel cache. The sources are the demo and every
environment in the folder that WHITEFURNACE_ENVIRONMENTS names.

    python benchmarks/bake.py [-n RUNS] [--markdown]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

# Runs the command line as `python -m whitefurnace` does, and prints the process's CPU time and peak memory at its end.
RUN = """
import atexit, resource, sys
def report():
    used = resource.getrusage(resource.RUSAGE_SELF)
    print("usage", used.ru_utime + used.ru_stime, used.ru_maxrss, file=sys.stderr)
atexit.register(report)
from whitefurnace.cli import main
main(sys.argv[1:])
"""


def environments() -> list[str]:
    """Return the sources of the bakes: `demo` and the paths of environments."""
    folder = os.environ.get("WHITEFURNACE_ENVIRONMENTS")
    found = [p for p in sorted(Path(folder).iterdir()) if p.suffix in (".exr", ".hdr")] if folder else []
    return ["demo", *map(str, found)]


def bake(environment: str, output: str) -> tuple[float, float, float, list[dict]]:
    """Run one bake; return wall seconds, CPU seconds, peak memory in MB, and its JSON rows."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", RUN, "bake", environment, "-o", output, "--force", "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    wall = time.perf_counter() - begin
    usage = next(line for line in done.stderr.splitlines() if line.startswith("usage")).split()
    return wall, float(usage[1]), float(usage[2]) / 1000, [json.loads(line) for line in done.stdout.splitlines()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", "--runs", type=int, default=5)
    parser.add_argument("--markdown", action="store_true")
    options = parser.parse_args()
    head = ["environment", "CPU s (min … max)", "wall s", "peak MB", "error, largest level", "worst texel", "DFG error"]
    rows = []
    device = {}
    with tempfile.TemporaryDirectory() as output:
        for environment in environments():
            bake(environment, output)  # builds the kernels if they are not in the cache
            runs = [bake(environment, output) for _ in range(options.runs)]
            levels = [row for row in runs[0][3] if row["event"] == "level"]
            whole = runs[0][3][-1]
            device = whole["device"]
            cpu = [run[1] for run in runs]
            rows.append(
                [
                    Path(environment).stem,
                    f"{statistics.median(cpu):.2f} ({min(cpu):.2f} … {max(cpu):.2f})",
                    f"{statistics.median(run[0] for run in runs):.2f}",
                    f"{max(run[2] for run in runs):.0f}",
                    f"{max(row['error'] for row in levels):.1e}",
                    f"{max(row['worst'] for row in levels):.1e}",
                    f"{whole['dfg']['error']:.1e}",
                ]
            )
    print(
        f"{device.get('name')}, {device.get('platform')} {device.get('driver')}; {os.cpu_count()} cores; "
        f"median of {options.runs} runs"
    )
    if options.markdown:
        print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
        print("\n".join("| " + " | ".join(row) + " |" for row in rows))
    else:
        widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
        for row in [head, *rows]:
            print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


if __name__ == "__main__":
    main()
