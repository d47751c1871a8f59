"""`whitefurnace bench`: its options, what it prints and its JSON rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import of_one, plots_into, print_row, progress
from whitefurnace.errors import UsageError
from whitefurnace.text import table

if TYPE_CHECKING:
    from whitefurnace.benching.throughput import Case, Spread, Throughput, Yardstick
    from whitefurnace.benching.tradeoff import Cost, Missed, Point

EPILOG = """\b
Examples:
  whitefurnace bench
  whitefurnace bench convolve dfg --json
  whitefurnace bench tradeoff studio.hdr demo --plot figures
  whitefurnace bench --dry-run

Kernels are timed by the clock of the device: the median, smallest and largest of several runs, after one that is left
out. `of peak` and `of memory` are fractions of the multiply-adds and of the memory reads that the device reached in the
same run.

tradeoff bakes the specular chain of each ENV by every method and setting. It gives the seconds from texels in memory to
finished levels, without the certificate, and the stated error of the worst level; `front` marks settings that no other
setting beats. On the first ENV it also measures the cost of output size, source size and roughness.

Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported,
130 interrupted.
"""

MEASUREMENT, TRADEOFF = "Measurement", "Options of tradeoff"


@options.command("Prove and measure", "Measure the speed of kernels, or error against time", EPILOG)
@click.argument("words", metavar="[CASE...|tradeoff ENV...]", nargs=-1)
@options.option(
    "--runs",
    metavar="N",
    type=int,
    heading=MEASUREMENT,
    help="Timed runs of each case, 1 to 1000. [default: 7; for tradeoff at most 5 within 3 s]",
)
@options.option(
    "--size",
    metavar="N",
    type=int,
    heading=TRADEOFF,
    help="Edge of a cube face of the first level in texels, a power of two. [default: 256]",
)
@options.option(
    "--min-size",
    metavar="N",
    type=int,
    heading=TRADEOFF,
    help="Edge of a cube face of the last level in texels, a power of two. [default: 16]",
)
@options.option(
    "--plot",
    "folder",
    metavar="DIR",
    type=options.FilePath,
    heading=TRADEOFF,
    help="Draw tradeoff.png into the folder DIR. Needs matplotlib.",
)
@options.device()
@options.dry_run("Print what would be measured, and do nothing.")
@options.as_json()
def bench(
    words: tuple[str, ...],
    runs: int | None,
    size: int | None,
    min_size: int | None,
    folder: Path | None,
    device: str | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Measure kernels against the limits of the device, or the error of prefiltering against its time.

    Without a CASE all kernels are measured; --dry-run lists them. ENV is any environment that `bake` takes.
    """
    from whitefurnace.benching import throughput as benching
    from whitefurnace.opencl.device import choose_device

    if runs is not None and not 1 <= runs <= 1000:
        raise UsageError(f"runs {runs} is outside [1, 1000]")
    if words and words[0] == "tradeoff":
        _tradeoff(
            words[1:],
            256 if size is None else size,
            16 if min_size is None else min_size,
            runs,
            folder,
            device,
            dry_run,
            as_json,
        )
        return
    for name, given in (("--size", size), ("--min-size", min_size), ("--plot", folder)):
        if given is not None:
            raise UsageError(f"{name} is of `bench tradeoff ENV...`")
    cases = benching.cases(words)
    if dry_run:
        for planned in case_rows(cases, benching.FLOPS) if as_json else ():
            print_row(planned)
        if not as_json:
            click.echo(cases_text(cases, benching.FLOPS))
        return
    on = choose_device(device)
    meter = benching.BenchMeter(on)
    rows = []
    with progress(not as_json) as report:
        for row in benching.throughput(cases, on, meter, runs or benching.RUNS, of_one(report, "bench")):
            rows.append(row)
            if as_json:
                print_row(bench_row(row))
    yardstick, identity = meter.yardstick(), on.identity()
    if as_json:
        print_row(yardstick_row(yardstick, identity))
    else:
        click.echo(bench_text(rows, yardstick, f"{identity['name']} ({identity['platform']})"))


def _tradeoff(
    sources: tuple[str, ...],
    size: int,
    min_size: int,
    runs: int | None,
    folder: Path | None,
    device: str | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Measure error against time on every environment, and on the first one the cost of sizes and roughness."""
    from whitefurnace.benching import tradeoff
    from whitefurnace.opencl.device import choose_device

    if not sources:
        raise UsageError("bench tradeoff needs one environment or several: images, or the word demo")
    tradeoff.check(size, min_size)
    if dry_run:
        for source in sources:
            if as_json:
                print_row({"event": "planned", "environment": source, "methods": tradeoff.methods()})
            else:
                click.echo(f"{source}: would measure " + ", ".join(f"{m} {x:g}" for m, x in tradeoff.methods()))
        return
    if folder is not None:
        plots_into(folder)
    on = choose_device(device)
    points: list[Point] = []
    costs: list[Cost | Missed] = []
    with progress(not as_json) as report:
        for source in sources:
            env = tradeoff.load(source, on)
            found = list(
                tradeoff.points(
                    env, on, size=size, min_size=min_size, runs=runs or tradeoff.RUNS, progress=of_one(report, env.name)
                )
            )
            own = tradeoff.with_front([p for p in found if isinstance(p, tradeoff.Point)])
            missed = [p for p in found if isinstance(p, tradeoff.Missed)]
            points += own
            for row in tradeoff_rows([*own, *missed]) if as_json else ():
                print_row(row)
            if not as_json:
                click.echo(tradeoff_text(own, missed))
            if source is sources[0]:
                costs = list(
                    tradeoff.costs(
                        env,
                        on,
                        size=size,
                        min_size=min_size,
                        runs=runs or tradeoff.RUNS,
                        progress=of_one(report, env.name),
                    )
                )
    for row in tradeoff_rows(costs) if as_json else ():
        print_row(row)
    identity, measured = on.identity(), [c for c in costs if isinstance(c, tradeoff.Cost)]
    if as_json:
        print_row({"event": "device", "device": identity})
    else:
        click.echo(costs_text(measured, tradeoff.COST_TOLERANCE, [c for c in costs if isinstance(c, tradeoff.Missed)]))
        click.echo(f"on {identity['name']} ({identity['platform']})")
    if folder is not None:
        from whitefurnace.benching.figures import draw_tradeoff

        path = draw_tradeoff(folder, points, measured, on)
        if as_json:
            print_row({"event": "plot", "file": str(path)})
        else:
            click.echo(f"  wrote {path}")


def _spread(spread: Spread, factor: float, digits: int = 3) -> tuple[str, str]:
    """Return the median times a factor as text, and the range as (smallest … largest)."""
    median, low, high = (f"{float(f'{x * factor:.{digits}g}'):g}" for x in (spread.median, spread.low, spread.high))
    return median, f"({low} … {high})"


def cases_text(cases: Sequence[Case], flops: Mapping[str, float]) -> str:
    """Return the table of the cases that can be measured."""
    return table(
        ["case", "kernel", "what", "counted in", "flops"],
        [[c.name, c.kernel, c.about, f"{c.unit}s", f"{flops[c.name]:g}" if c.name in flops else ""] for c in cases],
        left=4,
    )


def case_rows(cases: Sequence[Case], flops: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return the JSON rows of the cases that can be measured."""
    return [
        {
            "event": "planned",
            "case": c.name,
            "kernel": c.kernel,
            "about": c.about,
            "unit": c.unit,
            "flops": flops.get(c.name),
            "precisions": list(c.precisions),
        }
        for c in cases
    ]


def bench_text(rows: Sequence[Throughput], yardstick: Yardstick, device: str) -> str:
    """Return the table of the throughput of kernels, with the limits of the device above it."""
    can = [[f"multiply-adds, float{p}", *_spread(s, 1), "GFLOP/s"] for p, s in yardstick.peak.items()]
    can += [
        [what, *_spread(s, 1), "GB/s"]
        for what, s in (("memory read", yardstick.read), ("memory triad", yardstick.triad))
    ]
    cells = []
    for r in rows:
        flops = ["", ""] if r.gflops is None or r.of_peak is None else [f"{r.gflops:.3g}", f"{r.of_peak:.2f}"]
        cells.append(
            [
                r.case,
                str(r.precision),
                *_spread(r.rate, 1e-6),
                f"M {r.unit}s/s",
                *flops,
                f"{r.gbytes:.2g}",
                f"{r.of_memory:.2f}",
            ]
        )
    return "\n".join(
        [
            device,
            table(["yardstick", "median", "(min … max)", ""], can),
            "",
            table(["case", "float", "median", "(min … max)", "", "GFLOP/s", "of peak", "GB/s", "of memory"], cells),
        ]
    )


def bench_row(row: Throughput) -> dict[str, Any]:
    """Return the JSON row of a kernel."""
    found = {name: value for name, value in vars(row).items() if name != "rate"}
    return {"event": "case", "per_second": _three(row.rate), **found}


def yardstick_row(yardstick: Yardstick, device: Mapping[str, str]) -> dict[str, Any]:
    """Return the JSON row of the limits of the device."""
    return {
        "event": "yardstick",
        "device": dict(device),
        "gflops": {f"float{p}": _three(s) for p, s in yardstick.peak.items()},
        "read_gbytes": _three(yardstick.read),
        "triad_gbytes": _three(yardstick.triad),
    }


def _three(spread: Spread) -> dict[str, float]:
    return {"median": spread.median, "min": spread.low, "max": spread.high}


def tradeoff_text(points: Sequence[Point], missed: Sequence[Missed] = ()) -> str:
    """Return the table of error against time on one environment."""
    name = (points[0] if points else missed[0]).environment
    cells = [
        [
            p.method,
            p.label,
            *_spread(p.seconds, 1e3),
            f"{1e3 * p.certificate:.3g}",
            f"{p.error:.1e}",
            f"{p.worst:.1e}",
            f"{p.rmse:.1e}",
            "front" if p.front else "",
        ]
        for p in points
    ]
    head = ["method", "setting", "ms", "(min … max)", "certificate", "error", "worst", "rmse", ""]
    return "\n".join([name, table(head, cells, left=2), *_missed(missed)])


def costs_text(costs: Sequence[Cost], tolerance: float, missed: Sequence[Missed] = ()) -> str:
    """Return the table of the time of a level by output size, source size and roughness."""
    name = (costs[0] if costs else missed[0]).environment
    return "\n".join(
        [
            f"cost at {tolerance:g} on {name}",
            table(
                ["over", "value", "ms", "(min … max)"],
                [[c.over, f"{c.value:g}", *_spread(c.seconds, 1e3)] for c in costs],
            ),
            *_missed(missed),
        ]
    )


def _missed(missed: Sequence[Missed]) -> list[str]:
    return [f"  {m.method} {m.setting:g}: {m.why}" for m in missed]


def tradeoff_rows(found: Sequence[Point | Missed | Cost]) -> list[dict[str, Any]]:
    """Return the JSON rows of measured points, of settings that could not be measured, and of costs."""
    rows = []
    for one in found:
        row = {**vars(one), "event": type(one).__name__.lower()}
        rows.append({name: _three(value) if name == "seconds" else value for name, value in row.items()})
    return rows
