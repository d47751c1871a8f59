"""Results as rows: for a terminal's table and for JSON Lines. Makes text, prints nothing."""
from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from whitefurnace.catalogue.bibliography import PAPERS

if TYPE_CHECKING:
    from whitefurnace.baking import Baked
    from whitefurnace.benching import Case, Spread, Throughput, Yardstick
    from whitefurnace.catalogue import Model
    from whitefurnace.device import Candidate
    from whitefurnace.tables import Table
    from whitefurnace.tradeoff import Cost, Missed, Point
    from whitefurnace.verification import Row


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """A plain table with aligned columns; the first `left` of them to the left, the rest to the right."""
    cells = [list(head), *[list(row) for row in rows]]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    lines = []
    for row in cells:
        parts = [c.ljust(w) if k < left else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))]
        lines.append("  " + "  ".join(parts).rstrip())
    return "\n".join(lines)


def size(nbytes: float) -> str:
    """Bytes for people."""
    for unit in ("B", "KB", "MB"):
        if nbytes < 1000:
            return f"{nbytes:.0f} {unit}" if unit == "B" else f"{nbytes:.3g} {unit}"
        nbytes /= 1000
    return f"{nbytes:.3g} GB"


def baked_text(baked: Baked, output: Path) -> str:
    """What a bake wrote, with the statement of every level."""
    if baked.state == "skipped":
        return f"{baked.name}: up to date, nothing to do ({output / (baked.name + '.json')})"
    if baked.state == "planned":
        return planned_text(baked)
    m = baked.manifest
    rows = []
    for k, row in enumerate(baked.levels):
        rows.append([f"specular {k}", f"{row['size']}²", f"{row['roughness']:.3f}", f"{row['error']:.1e}",
                     f"{row['worst']:.1e}", f"{row['rmse']:.1e}", row["method"], f"{row['seconds']:.2f} s"])
    wide = m.get("latlong_levels", [])
    for k, row in enumerate(wide):
        rows.append([f"lat-long {k}", f"{row['size']}×{row['size'] // 2}", f"{row['roughness']:.3f}",
                     f"{row['error']:.1e}", f"{row['worst']:.1e}", f"{row['rmse']:.1e}", row["method"], ""])
    e = m["irradiance"]
    rows.append(["irradiance", f"{e['size']}²", "", f"{e['error']:.1e}", f"{e['worst']:.1e}", f"{e['rmse']:.1e}",
                 e["method"], ""])
    rows.append(["irradiance SH", "9×3", "", f"{m['sh']['error']:.1e}", "", "", "texel-nodes", ""])
    d = m["dfg"]
    rows.append(["DFG", f"{d['size']}²", "", f"{d['error']:.1e}", "", "", d["rule"], ""])
    if "sun" in m:
        sun = m["sun"]
        triple = ", ".join(f"{x:.4g}" for x in sun["irradiance"])
        towards = ", ".join(f"{x:.4f}" for x in sun["direction"])
        rows.append(["sun", f"{math.degrees(2 * sun['angular_radius']):.2f}°", "", "", "", "", "extracted", ""])
    s = m["source"]["statistics"]
    lines = [f"{baked.name}: {m['source']['layout']} {s['width']}×{s['height']}, brightest texel "
             f"{s['max_over_mean']:.3g} × the mean, on {m['device']['name']} ({m['device']['platform']})",
             table(["", "size", "r", "error", "worst", "rmse", "method", "time"], rows)]
    if "sun" in m:
        lines.append(f"  sun: direction ({towards}), irradiance facing it ({triple}), π times the light colour c")
    lines += as_read_lines(baked.as_read)
    for relative, entry in sorted(m["files"].items()):
        lines.append(f"  wrote {output / relative}  {size(entry['bytes'])}")
    lines.append(f"  wrote {output / (baked.name + '.json')}  the manifest; {baked.seconds:.2f} s in all")
    return "\n".join(lines)


def planned_text(baked: Baked) -> str:
    """What a bake would do."""
    methods = [f"{p.grid}²" if p.grid else f"{p.samples} samples" if p.samples else "texel mean" for p in baked.plan]
    rows = [[f"specular {k}", f"{p.size}²", f"{p.roughness:.3f}", methods[k], f"{p.pairs:.2g}", f"{p.cuts}×{p.cuts}"]
            for k, p in enumerate(baked.plan)]
    lines = [f"{baked.name}: would bake, key {baked.manifest['key'][:12]}…",
             table(["", "size", "r", "source grid a face", "lobe evaluations", "nodes a texel"], rows)]
    for path, nbytes in zip(baked.files, baked.nbytes, strict=True):
        lines.append(f"  would write {path}  {size(nbytes)} before compression")
    return "\n".join([*lines, *as_read_lines(baked.as_read)])


AS_READ = ("between", "texels", "levels", "format", "all")


def as_read_lines(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """What engines show of chains, part by part; parts that none of them measured are left out."""
    if not found:
        return []
    parts = [part for part in AS_READ if any(part in read["parts"] for read in found)]
    rows = [[str(read["levels"]), f"{read['sizes'][-1]}²", read["fit"] or "own lobe",
             *(f"{read['parts'][part]['mean']:.2g}" if part in read["parts"] else "" for part in parts),
             f"{read['parts']['all' if 'all' in read['parts'] else 'between']['p95']:.2g}"] for read in found]
    return [f"  as read from {found[0]['format']}: error of what engines show, mean over r of the RMS over directions",
            table(["levels", "last", "fit", *parts, "p95"], rows, left=3)]


def baked_rows(baked: Baked) -> list[dict[str, Any]]:
    """JSON rows of a bake: one a level, then one for the whole."""
    rows: list[dict[str, Any]] = []
    if baked.state == "planned":
        rows += [{"event": "level", "name": baked.name, "level": k, "size": p.size, "roughness": p.roughness,
                  "grid": p.grid, "samples": p.samples, "pairs": p.pairs, "cuts": p.cuts}
                 for k, p in enumerate(baked.plan)]
    else:
        rows += [{"event": "level", "name": baked.name, "level": k, **row} for k, row in enumerate(baked.levels)]
    rows += [{"event": "as_read", "name": baked.name, **read} for read in baked.as_read]
    m = baked.manifest
    whole: dict[str, Any] = {"event": baked.state, "name": baked.name, "key": m["key"], "seconds": baked.seconds,
                             "notices": list(baked.notices)}
    if baked.state == "planned":
        whole |= {"recipe": m["recipe"], "files": {str(p): n for p, n in zip(baked.files, baked.nbytes, strict=True)}}
    else:
        whole |= {"sun": m["sun"]} if "sun" in m else {}
        whole |= {"files": m["files"], "device": m["device"], "irradiance": m["irradiance"], "dfg": m["dfg"],
                  "sh": m["sh"]}
    return [*rows, whole]


def table_text(table: Table) -> str:
    """What `lut` wrote or would write."""
    name, beside = table.path, table.path.with_name(table.path.name + ".json")
    if table.state == "skipped":
        return f"{name}: up to date, nothing to do ({beside})"
    m = table.manifest
    recipe = m.get("recipe", m)
    shape = " × ".join(str(n) for n in table.shape)
    lines = [f"{name}: {recipe['integral']}, " + ", ".join(c["name"] for c in recipe["models"].values()) +
             f"; array of {shape}, float{recipe['precision']}"]
    lines += [f"  {axis}  {along}" for axis, along in zip("xyzuvw", table.axes, strict=False)]
    if table.state == "planned":
        return "\n".join([*lines, f"  would write {name}  {size(table.nbytes)} before compression",
                          f"  would write {beside}  the manifest"])
    lines += _told_of_table(m)
    return "\n".join([*lines, f"  error {m['error']:.1e}, rule {m['rule']}, {m['evaluations']:.2g} evaluations, "
                      f"on {m['device']['name']} ({m['device']['platform']})",
                      f"  wrote {name}  {size(m['bytes'])}", f"  wrote {beside}  the manifest; {table.seconds:.2f} s"])


def _told_of_table(m: Mapping[str, Any]) -> list[str]:
    """What a manifest says of a table beside its error."""
    lines = []
    if "channels" in m:
        lines += [f"  channels  {', '.join(m['channels'])}", f"  formula   {m['formula']}"]
    if "furnace" in m:
        lines += [f"  furnace at F = 1: off by {m['furnace']:.1e}; "
                  f"f(l, v) and f(v, l) differ by {m['non_reciprocity']:.2g}",
                  "  off Kulla and Conty's at F0 = " +
                  ", ".join(f"{f0}: {off:.1e}" for f0, off in m["deviation"].items())]
    if "as_read" in m:
        read = m["as_read"]
        rows = [(name, *(f"{e[k]:.1e}" for k in ("p99", "max", "max_all"))) for name, e in
                (("at texel centres", read["centres"]), *((f"between, {k}", e) for k, e in read["between"].items()))]
        lines.append(table(["  as read", "p99", "max", "max, with r < .045"], [(f"  {r[0]}", *r[1:]) for r in rows]))
    return lines


def table_row(table: Table) -> dict[str, Any]:
    """The JSON row of a table."""
    return {"event": table.state, "file": str(table.path), "shape": list(table.shape), "seconds": table.seconds,
            **{name: value for name, value in table.manifest.items() if name not in ("whitefurnace", "name")},
            "notices": list(table.notices)}


def devices_text(found: Sequence[Candidate]) -> str:
    """Each listed device with its verdict."""
    rows = [[str(c.index), c.type, f"{c.platform}: {c.name}", c.driver, "yes" if c.fp64 else "no", c.verdict]
            for c in found]
    return table(["", "type", "device", "driver", "float64", "verdict"], rows, left=6)


def models_text(entries: Sequence[Model]) -> str:
    """The catalogue as a table."""
    rows = [[e.slot, e.name, e.title, ", ".join(_domains(e)), e.citation] for e in entries]
    return table(["slot", "name", "title", "parameters", "source"], rows, left=5)


def _domains(entry: Model) -> list[str]:
    """`NAME [low, high]` a parameter; the components of a vector as one, `NAME_x/y/z`, of any length."""
    found = []
    for p in entry.parameters:
        stem, _, axis = p.name.rpartition("_")
        if not {f"{stem}_{a}" for a in "xyz"} <= {q.name for q in entry.parameters}:
            found.append(f"{p.name} [{p.low:g}, {p.high:g}]" if p.high < 1e9 else p.name)
        elif axis == "x":
            found.append(f"{stem}_x/y/z")
    return found


def model_text(entry: Model) -> str:
    """All that the catalogue says of one model."""
    lines = [f"{entry.slot} {entry.name}: {entry.title}", f"  source      {PAPERS.get(entry.citation, entry.citation)}"]
    rows = [[p.name, p.symbol, f"[{p.low:g}, {p.high:g}]", "" if p.default is None else f"{p.default:g}",
             ", ".join(f"{v:g}" for v in p.typical), p.about] for p in entry.parameters]
    if rows:
        lines += ["  parameters", table(["  name", "symbol", "domain", "default", "typical values", "what it is"],
                                        [[f"  {row[0]}", *row[1:]] for row in rows], left=6)]
    facts = [(name, fact) for name, fact in entry.facts.items() if isinstance(fact, str | int | float)]
    lines += [f"  {'facts' if k == 0 else '':10}  {name}: {fact}" for k, (name, fact) in enumerate(facts)]
    for k, (name, values) in enumerate(entry.presets.items()):
        shown = ", ".join(f"{key} = {'/'.join(f'{x:g}' for x in v) if isinstance(v, tuple) else f'{v:g}'}"
                          for key, v in values.items())
        lines.append(f"  {'presets' if k == 0 else '':10}  {entry.name}:{name}  {shown}")
    return "\n".join(lines)


def model_rows(entries: Sequence[Model]) -> list[dict[str, Any]]:
    """JSON rows of the catalogue."""
    return [{"slot": e.slot, "name": e.name, "title": e.title, "citation": e.citation,
             "parameters": [{"name": p.name, "symbol": p.symbol, "unit": p.unit, "domain": [p.low, p.high],
                             "typical": list(p.typical), "about": p.about} for p in e.parameters],
             "presets": {name: dict(values) for name, values in e.presets.items()},
             "facts": {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in e.facts.items()}}
            for e in entries]


VERIFY_HEAD = (f"  {'check':<40} {'float':>5} {'value':>14} {'expected':>12} {'error':>8} {'tolerance':>9}  verdict  "
               "worst at")


def verify_text(rows: Sequence[Row]) -> str:
    """The checks of one model, each with its worst cell, under `VERIFY_HEAD`; the counterexample of what failed."""
    lines = [f"{rows[0].slot} {rows[0].model}"]
    for row in rows:
        verdict = "FAIL" if not row.passed else "pass" if row.tolerance is not None else "told"
        expected, error, tolerance = ("" if x is None else format(x, digits) for x, digits in (
            (row.expected, ".8g"), (row.error, ".1e"), (row.tolerance, ".1e")))
        figures = f"{row.value:>14.9g} {expected:>12} {error:>8} {tolerance:>9}"
        lines.append(f"  {row.check:<40} {row.precision:>5} {figures}  {verdict:<7}  {_where(row.parameters)}".rstrip())
        if not row.passed:
            lines += [f"      counterexample: {_where(row.counterexample or {}, '.9g')}".rstrip(),
                      *([f"      {row.note}"] if row.note else [])]
    return "\n".join(lines)


def _where(values: Mapping[str, Any], digits: str = ".4g") -> str:
    return ", ".join(f"{name} = ({', '.join(format(x, digits) for x in v)})" if isinstance(v, Sequence) else
                     f"{name} = {v:{digits}}" for name, v in values.items())


def verify_summary(rows: Sequence[Row], seconds: float, device: str) -> str:
    """How many checks of how many models passed."""
    told = sum(row.tolerance is None and row.passed for row in rows)
    failed = sum(not row.passed for row in rows)
    subjects = len({(row.slot, row.model) for row in rows})
    return (f"{len(rows) - told} checks of {subjects} {'model' if subjects == 1 else 'models'}: "
            f"{len(rows) - told - failed} passed, {failed} failed"
            + (f"; {told} figures told" if told else "") + f"; {seconds:.1f} s on {device}")


def verify_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """JSON rows of checks; NaN and infinities as strings."""
    return [{"event": "check", "slot": r.slot, "model": r.model, "check": r.check, "parameters": _plain(r.parameters),
             "precision": r.precision, "value": _plain(r.value), "expected": _plain(r.expected),
             "error": _plain(r.error), "tolerance": _plain(r.tolerance), "passed": r.passed, "cells": r.cells,
             "note": r.note, "counterexample": _plain(r.counterexample)} for r in rows]


def _plain(value: Any) -> Any:
    """As JSON has it."""
    if isinstance(value, Mapping):
        return {name: _plain(v) for name, v in value.items()}
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else value


# ---------------------------------------------------------------------------------------------- bench


def _spread(spread: Spread, factor: float, digits: int = 3) -> tuple[str, str]:
    """Median, and (least … largest), times a factor."""
    median, low, high = (f"{float(f'{x * factor:.{digits}g}'):g}" for x in (spread.median, spread.low, spread.high))
    return median, f"({low} … {high})"


def cases_text(cases: Sequence[Case], flops: Mapping[str, float]) -> str:
    """What can be measured."""
    return table(["case", "kernel", "what", "counted in", "flops"],
                 [[c.name, c.kernel, c.about, f"{c.unit}s", f"{flops[c.name]:g}" if c.name in flops else ""]
                  for c in cases], left=4)


def case_rows(cases: Sequence[Case], flops: Mapping[str, float]) -> list[dict[str, Any]]:
    """JSON rows of what can be measured."""
    return [{"event": "planned", "case": c.name, "kernel": c.kernel, "about": c.about, "unit": c.unit,
             "flops": flops.get(c.name), "precisions": list(c.precisions)} for c in cases]


def bench_text(rows: Sequence[Throughput], yardstick: Yardstick, device: str) -> str:
    """The throughput of kernels beside what the device can do."""
    can = [[f"multiply-adds, float{p}", *_spread(s, 1), "GFLOP/s"] for p, s in yardstick.peak.items()]
    can += [[what, *_spread(s, 1), "GB/s"] for what, s in (("memory read", yardstick.read),
                                                           ("memory triad", yardstick.triad))]
    cells = []
    for r in rows:
        flops = ["", ""] if r.gflops is None or r.of_peak is None else [f"{r.gflops:.3g}", f"{r.of_peak:.2f}"]
        cells.append([r.case, str(r.precision), *_spread(r.rate, 1e-6), f"M {r.unit}s/s", *flops, f"{r.gbytes:.2g}",
                      f"{r.of_memory:.2f}"])
    return "\n".join([device, table(["yardstick", "median", "(min … max)", ""], can), "",
                      table(["case", "float", "median", "(min … max)", "", "GFLOP/s", "of peak", "GB/s", "of memory"],
                            cells)])


def bench_row(row: Throughput) -> dict[str, Any]:
    """The JSON row of a kernel."""
    found = {name: value for name, value in vars(row).items() if name != "rate"}
    return {"event": "case", "per_second": _three(row.rate), **found}


def yardstick_row(yardstick: Yardstick, device: Mapping[str, str]) -> dict[str, Any]:
    """The JSON row of what the device can do."""
    return {"event": "yardstick", "device": dict(device),
            "gflops": {f"float{p}": _three(s) for p, s in yardstick.peak.items()},
            "read_gbytes": _three(yardstick.read), "triad_gbytes": _three(yardstick.triad)}


def _three(spread: Spread) -> dict[str, float]:
    return {"median": spread.median, "min": spread.low, "max": spread.high}


def tradeoff_text(points: Sequence[Point], missed: Sequence[Missed] = ()) -> str:
    """Error against time on one environment."""
    name = (points[0] if points else missed[0]).environment
    cells = [[p.method, p.label, *_spread(p.seconds, 1e3), f"{1e3 * p.certificate:.3g}", f"{p.error:.1e}",
              f"{p.worst:.1e}", f"{p.rmse:.1e}", "front" if p.front else ""] for p in points]
    head = ["method", "setting", "ms", "(min … max)", "certificate", "error", "worst", "rmse", ""]
    return "\n".join([name, table(head, cells, left=2), *_missed(missed)])


def costs_text(costs: Sequence[Cost], tolerance: float, missed: Sequence[Missed] = ()) -> str:
    """What makes a level dear."""
    name = (costs[0] if costs else missed[0]).environment
    return "\n".join([f"cost at {tolerance:g} on {name}",
                      table(["over", "value", "ms", "(min … max)"],
                            [[c.over, f"{c.value:g}", *_spread(c.seconds, 1e3)] for c in costs]), *_missed(missed)])


def _missed(missed: Sequence[Missed]) -> list[str]:
    return [f"  {m.method} {m.setting:g}: {m.why}" for m in missed]


def tradeoff_rows(found: Sequence[Point | Missed | Cost]) -> list[dict[str, Any]]:
    """JSON rows of points, of those that could not be made, and of costs."""
    rows = []
    for one in found:
        row = {**vars(one), "event": type(one).__name__.lower()}
        rows.append({name: _three(value) if name == "seconds" else value for name, value in row.items()})
    return rows
