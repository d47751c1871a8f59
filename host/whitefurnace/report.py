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
    from whitefurnace.comparison import Comparison
    from whitefurnace.device import Candidate
    from whitefurnace.engines import Engine
    from whitefurnace.rendering import Rendered
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
    several = len({tuple(row.get("for", ())) for row in baked.levels}) > 1
    for k, row in enumerate(baked.levels):
        what = f"{row.get('ndf', 'specular')} of {', '.join(row['for'])}" if several else f"specular {k}"
        rows.append([what, f"{row['size']}²", f"{row['roughness']:.3f}", f"{row['error']:.1e}",
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
        lines.append(f"  wrote {output / relative}  {size(entry['bytes'])}{_format_text(entry)}")
    for name, engine in m.get("engines", {}).items():
        if not engine["proven"]:
            lines.append(f"  {name}: not proven in the engine ({engine['facts']})")
        lines += [f"  {name}: {step.replace('STEM', baked.name)}" for step in engine["steps"]]
    lines.append(f"  wrote {output / (baked.name + '.json')}  the manifest; {baked.seconds:.2f} s in all")
    return "\n".join(lines)


def engines_text(engines: Sequence[Engine]) -> str:
    """The engines that `--for` knows, a row each."""
    rows = [[e.name, e.title.partition(": ")[0], "seen" if e.proven else "", e.lods_text, e.sh or "",
             "" if e.container != "files" else f"{e.dfg.size}² {e.dfg.form}"] for e in engines]
    return table(["engine", "of", "proven", "lod(r)", "harmonics", "table"], rows, left=6)


def engine_text(engine: Engine) -> str:
    """One engine: its files and how they are read."""
    lines = [f"{engine.name}: {engine.title}", f"  facts      {engine.facts}",
             f"  lod(r)     {engine.lods_text}" + (", past r = 1 a lobe of that α" if engine.follow else ""),
             f"  sizes      {engine.size}² to " + (f"{engine.levels} levels" if engine.levels else f"{engine.min_size}²"),
             f"  axes       {engine.axes}"]
    if engine.container == "files":
        lines += [f"  direction  mix(mirror, normal, {engine.bend})"] if engine.bend != "0" else []
        lines += [f"  radiance   mix(prefiltered, E/π, {engine.blend})"] if engine.blend != "0" else []
        lines += [f"  least r    {engine.least:g}"] if engine.least else []
        lines += [f"  harmonics  {engine.sh}"] if engine.sh else []
        d = engine.dfg
        lines += [f"  table      {d.size}², x = {d.x}, y = {d.y}, {d.form}" + (", Charlie" if d.charlie else "")]
        lines += [f"  file       {file.name.replace('{stem}', 'STEM')}: {file.holds}, {file.stored}" for file in engine.file]
        lines += [f"  step       {step}" for step in engine.steps]
    return "\n".join(lines)


def _format_text(entry: Mapping[str, Any]) -> str:
    """A file's pixel format and what it costs, beside the error of what it holds."""
    if "format" not in entry:
        return ""
    levels = entry.get("levels", ())
    parts = [entry["format"]]
    if levels:
        parts.append(f"error {max(level['error'] for level in levels):.1e}")
        costs = [level["format_p99"] for level in levels if "format_p99" in level]
        parts += [f"its format's {max(costs):.1e}"] if costs else []
    elif "error" in entry:
        parts.append(f"error {entry['error']:.1e}")
        parts += [f"its format's {entry['format_worst']:.1e}"] if "format_worst" in entry else []
    return "  " + ", ".join(parts)


def planned_text(baked: Baked) -> str:
    """What a bake would do."""
    several = len({names for names, _ in baked.plan}) > 1
    rows = [[f"specular of {', '.join(names)}" if several else f"specular {k}", f"{p.size}²", f"{p.roughness:.3f}",
             f"{p.grid}²" if p.grid else f"{p.samples} samples" if p.samples else "texel mean", f"{p.pairs:.2g}",
             f"{p.cuts}×{p.cuts}"] for k, (names, p) in enumerate(baked.plan)]
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
    several = len({read.get("for") for read in found}) > 1
    rows = [[read["for"] if several else "", str(read["levels"]), f"{read['sizes'][-1]}²", read["fit"] or "own lobe",
             *(f"{read['parts'][part]['mean']:.2g}" if part in read["parts"] else "" for part in parts),
             f"{read['parts']['all' if 'all' in read['parts'] else 'between']['p95']:.2g}"] for read in found]
    formats = ", ".join(dict.fromkeys(read["format"] for read in found))
    head = ["for", "levels", "last", "fit"]
    if not several:
        rows, head = [row[1:] for row in rows], head[1:]
    return [f"  as read from {formats}: error of what engines show, mean over r of the RMS over directions",
            table([*head, *parts, "p95"], rows, left=len(head))]


def baked_rows(baked: Baked) -> list[dict[str, Any]]:
    """JSON rows of a bake: one a level, then one for the whole."""
    rows: list[dict[str, Any]] = []
    if baked.state == "planned":
        rows += [{"event": "level", "name": baked.name, "level": k, "for": list(names), "size": p.size,
                  "roughness": p.roughness, "grid": p.grid, "samples": p.samples, "pairs": p.pairs, "cuts": p.cuts}
                 for k, (names, p) in enumerate(baked.plan)]
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
        lines.append(f"  channels  {', '.join(m['channels'])}")
        lines += [f"  formula   {m['formula']}"] if "formula" in m else []
    if "stored" in m:
        lines += [f"  stored as {m['stored']['format']}: off by {m['stored']['error']:.1e} at most, beside the error"]
    if "furnace" in m:
        lines += [f"  furnace at F = 1: off by {m['furnace']:.1e}; "
                  f"f(l, v) and f(v, l) differ by {m['non_reciprocity']:.2g}",
                  "  off Kulla and Conty's at F0 = " +
                  ", ".join(f"{f0}: {off:.1e}" for f0, off in m["deviation"].items())]
    if "misplaced" in m:
        told = {f"at texels, {k}": e for k, e in m["misplaced"].items() if k != "between"}
        told |= {f"between, {k}": e for k, e in m["misplaced"].get("between", {}).items()}
        names = ("mean", "median", "p99", "max")
        lines.append(table(["  energy misplaced", *names],
                           [(f"  {where}", *(f"{e[k]:.3f}" for k in names)) for where, e in told.items()]))
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


def finite(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row as JSON has it: NaN and infinities as strings."""
    return {name: _plain(value) for name, value in row.items()}


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


# ---------------------------------------------------------------------------------------------- files


def inspect_text(row: Mapping[str, Any]) -> str:
    """What is in a file, from the row of `contents.described`."""
    lines = [f"{row['file']}: {row['kind']} in {row['container']}, {row['format']}"]
    header = {**row["header"], **({"bytes": size(row["header"]["bytes"])} if "bytes" in row["header"] else {})}
    for name in ("layers", "orientation"):
        if not header.get(name, 1):
            del header[name]
    lines.append("  " + ", ".join(f"{name} {value}" for name, value in header.items()))
    lines += [f"  notice: {notice}" for notice in row["notices"]]
    if row["levels"]:
        lines.append(table(["", "size", "r", "bytes", "least", "mean", "largest", "error", "format", "to know"],
                           [_inspected(level) for level in row["levels"]]))
    if "sh" in row:
        lines.append("  spherical harmonics: mean radiance " +
                     ", ".join(f"{x * math.sqrt(1 / (4 * math.pi)):.4g}" for x in row["sh"][0]))
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
    said = [f"{value} {names[name]}" for name, value in count.items()]
    said += [f"alpha {level['alpha'][0]:.3g} … {level['alpha'][1]:.3g}"] if level["alpha"] else []
    mean, added = level["mean"], level.get("format_p99", level.get("format_worst"))
    return [level["name"], level["size"],
            "" if level["roughness"] is None else f"{level['roughness']:.3f}",
            "" if level["bytes"] is None else size(level["bytes"]), f"{level['low']:.3g}",
            " ".join(f"{x:.3g}" for x in mean), f"{level['high']:.4g}",
            f"{level['error']:.1e}" if "error" in level else "",
            "" if added is None else f"{added:.1e}", ", ".join(said)]


def _stated(statement: Mapping[str, Any] | None) -> list[str]:
    """What a manifest or our attributes say of a file."""
    if statement is None:
        return ["  no manifest lists it, and it states no error"]
    told = []
    if statement["manifest"] is not None:
        told.append(f"  manifest {statement['manifest']}: " + (
            "the digests match" if statement["whole"] else "what it lists is NOT what is there, it was changed since"))
    version = statement.get("whitefurnace", statement.get("version"))
    key = statement.get("key")
    made = [f"whitefurnace {version}"] if version else []
    made += [f"key {str(key)[:12]}…"] if key else []
    device = statement.get("device")
    made += [f"for {statement['engine']}"] if statement.get("engine") else []
    made += [f"on {device.get('name')}"] if isinstance(device, Mapping) else []
    if made:
        told.append(f"  made by {', '.join(made)}")
    recipe = statement.get("recipe")
    if isinstance(recipe, Mapping):
        shown = {name: _short(value) for name, value in recipe.items() if value is not None}
        told.append("  recipe " + ", ".join(f"{name} {value if len(value) <= 60 else value[:60] + '…'}"
                                            for name, value in shown.items()))
    if isinstance(statement.get("integral"), str):
        error = statement.get("error")
        told.append(f"  integral {statement['integral']}" + (
            f", error {error:.1e}" if isinstance(error, float) else ""))
    return told


def _short(value: Any) -> str:
    """A value of a recipe on one line; what a model is called, where it is one."""
    if isinstance(value, Mapping):
        return str(value["name"]) if "name" in value else "/".join(f"{k}={_short(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return "+".join(_short(v) for v in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def compared_text(found: Comparison) -> str:
    """A is off from B by so much, part by part."""
    rows = [[row.part, row.size, "" if row.roughness is None else f"{row.roughness:.3f}", f"{row.error:.1e}",
             f"{row.worst:.1e}", "" if row.rmse is None else f"{row.rmse:.1e}",
             "" if row.stated is None else f"{row.stated:.1e}", row.method, row.at] for row in found.rows]
    head = ["", "size", "r", "error", "worst", "rmse", "stated", "compared", "the worst at"]
    lines = [f"{found.a.path} ({found.a.kind}, {found.a.container}) against "
             f"{found.b.path} ({found.b.kind}, {found.b.container})"]
    return "\n".join([*lines, table(head, rows)])


def compared_rows(found: Comparison) -> list[dict[str, Any]]:
    """JSON rows of a comparison."""
    return [{"event": "compared", "part": row.part, "kind": row.kind, "size": row.size, "roughness": row.roughness,
             "error": _plain(row.error), "worst": _plain(row.worst), "rmse": _plain(row.rmse), "stated": row.stated,
             "method": row.method, "worst_at": row.at} for row in found.rows]


# ---------------------------------------------------------------------------------------------- pictures


def rendered_row(made: Rendered) -> dict[str, Any]:
    return {"event": "rendered", **vars(made), "path": str(made.path)}


def rendered_text(made: Rendered) -> str:
    columns, rows = (" ".join(f"{x:.3g}" for x in values) for values in (made.roughness, made.metalness))
    return "\n".join([f"{made.path}: {made.width} × {made.height} pixels, {made.engine}, exposure {made.exposure:g}",
                      f"  across  roughness {columns}", f"  down    metalness {rows}",
                      *(f"  read    {path}" for path in made.read)])
