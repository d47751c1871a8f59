"""Results as rows: for a terminal's table and for JSON Lines. Makes text, prints nothing."""
from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from whitefurnace.catalogue.bibliography import PAPERS
from whitefurnace.text import size, table

if TYPE_CHECKING:
    from whitefurnace.advice.budget import Budget, Choice, Entry
    from whitefurnace.advice.needs import Needs
    from whitefurnace.baking.bake import Baked
    from whitefurnace.batch.jobs import Result, Tally
    from whitefurnace.benching.throughput import Case, Spread, Throughput, Yardstick
    from whitefurnace.benching.tradeoff import Cost, Missed, Point
    from whitefurnace.catalogue import Model
    from whitefurnace.engines.presets import Engine
    from whitefurnace.inspection.comparison import Comparison
    from whitefurnace.opencl.device import Candidate
    from whitefurnace.rendering.shading import Rendered
    from whitefurnace.rendering.side_by_side import Rendered as Beside
    from whitefurnace.scenes.materials import Material, Scene
    from whitefurnace.scenes.materials import Spread as Span
    from whitefurnace.scenes.media import Inside, Pixel
    from whitefurnace.tables.lut import Table
    from whitefurnace.verification.checks import Row


def baked_text(baked: Baked, output: Path) -> str:
    """What a bake wrote, with the statement of every level."""
    if baked.state == "skipped":
        return f"{baked.name}: up to date, nothing to do ({output / (baked.name + '.json')})"
    if baked.state == "planned":
        return planned_text(baked)
    m = baked.manifest
    rows = []
    several = len({tuple(row.get("for", ())) for row in baked.levels}) > 1
    counts: dict[str, int] = {}
    for row in baked.levels:
        name = "sheen" if row.get("ndf") == "charlie" else "specular"
        # Level 0 is the image itself, whatever the lobe.
        counts[name] = counts.get(name, 0 if name == "sheen" else _first(m) - 1) + 1
        what = f"{name} of {', '.join(row['for'])}" if several else f"{name} {counts[name]}"
        rows.append([what, f"{row['size']}²", f"{row['roughness']:.3f}", f"{row['error']:.1e}",
                     f"{row['worst']:.1e}", f"{row['rmse']:.1e}", row["method"], f"{row['seconds']:.2f} s"])
    wide = m.get("latlong_levels", [])
    for k, row in enumerate(wide, _first(m)):
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
             f"  sizes      {engine.size}², " + (f"{engine.levels} levels" if engine.levels else
                                                 f"to {engine.min_size}²"),
             f"  axes       {engine.axes}"]
    if engine.container == "files":
        lines += [f"  direction  mix(mirror, normal, {engine.bend})"] if engine.bend != "0" else []
        lines += [f"  radiance   mix(prefiltered, E/π, {engine.blend})"] if engine.blend != "0" else []
        lines += [f"  least r    {engine.least:g}"] if engine.least else []
        lines += [f"  harmonics  {engine.sh}"] if engine.sh else []
        d = engine.dfg
        lines += [f"  table      {d.size}², x = {d.x}, y = {d.y}, {d.form}" + (", Charlie" if d.charlie else "")]
        lines += [f"  file       {file.name.replace('{stem}', 'STEM')}: {file.holds}, {file.stored}"
                  for file in engine.file]
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


def _first(manifest: Mapping[str, Any]) -> int:
    """The number of the first level that is made."""
    return int((manifest["recipe"].get("only") or [0])[0])


def planned_text(baked: Baked) -> str:
    """What a bake would do."""
    several = len({names for names, _ in baked.plan}) > 1
    rows = [[f"specular of {', '.join(names)}" if several else f"specular {k}", f"{p.size}²", f"{p.roughness:.3f}",
             f"{p.grid}²" if p.grid else f"{p.samples} samples" if p.samples else "texel mean", f"{p.pairs:.2g}",
             f"{p.cuts}×{p.cuts}"] for k, (names, p) in enumerate(baked.plan, _first(baked.manifest))]
    lines = [f"{baked.name}: would bake, key {baked.manifest['key'][:12]}…",
             table(["", "size", "r", "source grid a face", "lobe evaluations", "nodes a texel"], rows)]
    for path, nbytes in zip(baked.files, baked.nbytes, strict=True):
        lines.append(f"  would write {path}  {size(nbytes)} before compression")
    if baked.programs:
        text = size(sum(program.nbytes for program in baked.programs))
        lines.append(f"  would compile {len(baked.programs)} kernel programs of {text} of text; --json has it")
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
                 for k, (names, p) in enumerate(baked.plan, _first(baked.manifest))]
        rows += [{"event": "kernel", "name": baked.name, **program.data()} for program in baked.programs]
    else:
        rows += [{"event": "level", "name": baked.name, "level": k, **row}
                 for k, row in enumerate(baked.levels, _first(baked.manifest))]
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
    of = ", ".join(c["name"] for c in recipe["models"].values()) or recipe["scheme"]
    lines = [f"{name}: {recipe['integral']}, {of}"
             f"; array of {shape}, float{recipe['precision']}"]
    lines += [f"  {axis}  {along}" for axis, along in zip("xyzuvw", table.axes, strict=False)]
    if table.state == "planned":
        return "\n".join([*lines, f"  would write {name}  {size(table.nbytes)} before compression",
                          f"  would write {beside}  the manifest"])
    lines += _told_of_table(m)
    where = f"on {m['device']['name']} ({m['device']['platform']})" if "device" in m else "in numpy"
    done = f"  error {m['error']:.1e}, rule {m['rule']}, {m['evaluations']:.2g} evaluations, {where}"
    return "\n".join([*lines, done,
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
    row = {"event": "rendered", **vars(made), "path": str(made.path)}
    if not made.materials:
        del row["materials"]
    return row


def rendered_text(made: Rendered) -> str:
    columns, rows = (" ".join(f"{x:.3g}" for x in values) for values in (made.roughness, made.metalness))
    of = [f"  across  roughness {columns}", f"  down    metalness {rows}"]
    if made.materials:
        of = [table(["material", "row", "column", "base colour", "metalness", "roughness", "F0"],
                    [[str(one["name"]), *(_values(one[key]) for key in ("row", "column", "base_color", "metalness",
                                                                       "roughness", "f0"))]
                     for one in made.materials])]
    return "\n".join([f"{made.path}: {made.width} × {made.height} pixels, {made.engine}, exposure {made.exposure:g}",
                      *of, *(f"  read    {path}" for path in made.read)])


def _values(value: Any) -> str:
    """Of one number, or of RGB, once where they are the same."""
    values = value if isinstance(value, tuple) else (value,)
    return " ".join(f"{x:.3g}" for x in (values[:1] if len(set(values)) == 1 else values))


def beside_row(made: Beside) -> dict[str, Any]:
    return {**rendered_row(made), "certificate": [vars(held) for held in made.certificate],
            "error": made.error if made.certificate else None}


def beside_text(made: Beside) -> str:
    seconds = ", ".join(f"{name} {value:.1f} s" for name, value in made.seconds.items())
    return "\n".join([
        rendered_text(made),
        f"  truth   samples {' '.join(map(str, made.samples))} a pixel, within {max(made.estimates):.1e} of four times "
        f"as many; {seconds}",
        *(f"  error   roughness {held.roughness:.3g}, n·v {held.NoV:.2f}, {held.of}: {held.error:.1e} of "
          f"{' '.join(f'{x:.4g}' for x in held.exact)} by quadrature" for held in made.certificate),
        f"  differs by {100 * made.median:.3g} % or less at half of the pixels, {100 * made.most:.3g} % at 95 of 100; "
        f"the colours reach {100 * made.scale:g} %"])


# ---------------------------------------------------------------------------------------------- scenes


def scene_text(scene: Scene, needs: Needs) -> str:
    """What is in a scene, and what it needs."""
    box = scene.extent
    uses = sum(m.uses for m in scene.materials)
    head = [f"{len(scene.materials)} material{'' if len(scene.materials) == 1 else 's'} on {uses} "
            f"primitive{'' if uses == 1 else 's'}"]
    head += [" × ".join(f"{x:.3g}" for x in box) + " m"] if box else []
    for count, what in ((len(scene.cameras), "camera"), (scene.lights, "punctual light")):
        head += [f"{count} {what}{'' if count == 1 else 's'}"] if count else []
    rows = [[m.name, _spread_text(m["base_color"]), _spread_text(m["metalness"]), _spread_text(m["roughness"]),
             ", ".join(_also(m))] for m in scene.materials]
    lines = [f"{scene.path}: {', '.join(head)}"]
    lines += [table(["material", "base colour", "metalness", "roughness", "and"], rows, left=5)] if rows else []
    lines.append(f"  for {needs.engine.name}, before compression:")
    verdict = {True: "yes", False: "no", None: "cannot"}
    lines.append(table(["needed", "", "usual", "here", "because"],
                       [[verdict[row.needed], row.what, size(row.nbytes) if row.nbytes else "",
                         size(row.kept) if row.kept else "0" if row.nbytes else "", row.reason] for row in needs.rows],
                       left=5))
    return "\n".join([*lines, f"  {_saved(needs)}"])


def _saved(needs: Needs) -> str:
    if needs.own is None:
        return f"nothing is to be baked: it saves {size(needs.full_nbytes)} and about {needs.full_seconds:.2g} s of " \
               "processor time"
    options = [f"--{name.replace('_', '-')} {','.join(v) if isinstance(v, list) else v}"
               for name, v in needs.options.items()]
    bake = " ".join(["bake", *options]) if options else "the usual bake"
    return (f"{size(needs.nbytes)} in place of {size(needs.full_nbytes)}, about {needs.seconds:.2g} s of processor "
            f"time in place of {needs.full_seconds:.2g}: {bake}")


def _spread_text(spread: Span) -> str:
    """A value, or its range over a texture with the mean."""
    def one(values: Sequence[float]) -> str:
        return f"{values[0]:.3g}" if len(set(values)) == 1 else "/".join(f"{v:.3g}" for v in values)

    if spread.low == spread.high:
        return one(spread.low)
    mean = f", mean {one(spread.mean)}" if spread.mean else ""
    return f"{one(spread.low)} … {one(spread.high)}{mean}"


def _also(m: Material) -> list[str]:
    """What else is given of a material, in words."""
    core = ("base_color", "metalness", "roughness")
    told = ["unlit"] if m.unlit else []
    return told + [f"{name.replace('_', ' ')} {_spread_text(spread)}" for name, spread in m.values.items()
                   if name not in core and spread.given != "default"]


def scene_rows(scene: Scene, needs: Needs) -> list[dict[str, Any]]:
    """JSON rows: the scene, a material and a need each, and the whole."""
    def plain(x: float) -> float | None:
        return x if math.isfinite(x) else None  # an attenuation distance

    rows: list[dict[str, Any]] = [{
        "event": "scene", "file": str(scene.path), "low": scene.low, "high": scene.high, "lights": scene.lights,
        "cameras": [vars(camera) for camera in scene.cameras], "notices": list(scene.notices)}]
    rows += [{"event": "material", "name": m.name, "uses": m.uses, "unlit": m.unlit, "extensions": list(m.given),
              "values": {name: {"low": [plain(x) for x in s.low], "high": [plain(x) for x in s.high],
                                "mean": [plain(x) for x in s.mean], "given": s.given, "seen": s.seen,
                                **({"histogram": list(s.histogram)} if s.histogram else {})}
                         for name, s in m.values.items()}} for m in scene.materials]
    rows += [{"event": "need", "for": needs.engine.name, "what": row.what, "kind": row.kind, "needed": row.needed,
              "reason": row.reason, "usual_bytes": row.nbytes, "bytes": row.kept} for row in needs.rows]
    return [*rows, {"event": "needs", "for": needs.engine.name, "bake": needs.own is not None, "options": needs.options,
                    "tables": list(needs.tables), "charlie": needs.cloth, "bytes": needs.nbytes,
                    "usual_bytes": needs.full_nbytes, "predicted": {"cpu_seconds": needs.seconds,
                                                                    "usual_cpu_seconds": needs.full_seconds}}]


def media_text(found: Sequence[Inside], pixel: Pixel | None) -> str:
    """What the media of a scene ask for at its scale."""
    lines = [f"  inside, where {pixel.text}:" if pixel else "  inside:"]
    if not found:
        lines.append("    no material has a volume: give --medium [MATERIAL:]MEDIUM")
    for one in found:
        lines += [f"    {one.head}", *(f"      {line}" for line in one.lines)]
    return "\n".join(lines)


def media_rows(found: Sequence[Inside], pixel: Pixel | None) -> list[dict[str, Any]]:
    """JSON rows: a medium each."""
    of = {"camera": pixel.of or None} if pixel else {}
    return [{"event": "medium", "material": one.material or None, "size_of": one.size_of or None,
             "reason": one.reason or None, "table": one.table, **of,
             **(one.judgement.data() if one.judgement else {"subsurface": False})} for one in found]


def budget_text(found: Budget, choice: Choice | None = None) -> str:
    """What each approximation costs a scene in an environment, and what stays within a tolerance."""
    rows = [*(e for e in found.entries if e.used), found.files, found.floor, found.whole]
    head = [f"  errors of reflected radiance in {found.environment}, at {found.points} points of the scene's materials",
            table(["part", "", "rms", "p95", ""], [_entry_cells(e) for e in rows], left=5),
            f"  largest: {found.largest.name}; they do not add up; the integral is within {found.accuracy:.1g} (p99)",
            "  other ways would change what is right by",
            table(["", "", "rms", "p95", ""], [_entry_cells(e) for e in found.entries if not e.used], left=5)]
    return "\n".join([*head, *_chosen_lines(found, choice)])


def _entry_cells(e: Entry) -> list[str]:
    what = e.kind if e.kind in ("files", "split", "model") and e.name not in ("files", "exact files") else ""
    return [e.name, what, f"{'≤ ' if e.bound else ''}{e.rms:.2g}", f"{e.p95:.2g}", e.what]


def _chosen_lines(found: Budget, choice: Choice | None) -> Iterable[str]:
    if choice is None:
        return
    options = " ".join(f"--{name.replace('_', '-')} {','.join(v) if isinstance(v, list) else f'{v:g}'}"
                       if not isinstance(v, str) else f"--{name} {v}" for name, v in choice.options.items()
                       if name != "format")
    own = f", its chain as {choice.options['format']}" if "format" in choice.options else ""
    if choice.met:
        yield (f"  cheapest within {choice.tolerance:g}: bake --for {found.engine} {options}{own}: "
               f"{size(choice.nbytes)} in place of {size(choice.usual_nbytes)}; its files add {choice.error:.2g}, and "
               f"{choice.binds.name} binds ({choice.binds.rms:.2g})")
    else:
        yield (f"  none of {choice.tried} sets of files is within {choice.tolerance:g}; the least error, "
               f"{choice.error:.2g}, has bake --for {found.engine} {options}{own}; {choice.binds.name} binds "
               f"({choice.binds.rms:.2g})")
    for e in choice.beyond:
        yield f"  no choice reaches {choice.tolerance:g} of {e.name}: {e.rms:.2g} ({e.what})"


def budget_rows(found: Budget, choice: Choice | None = None) -> list[dict[str, Any]]:
    """JSON rows: an approximation each, the whole, and the choice."""
    def row(e: Entry) -> dict[str, Any]:
        return {"name": e.name, "kind": e.kind, "rms": e.rms, "p95": e.p95, "used": e.used, "bound": e.bound,
                "what": e.what}

    where = {"for": found.engine, "environment": found.environment}
    rows: list[dict[str, Any]] = [{"event": "approximation", **where, **row(e)} for e in found.entries]
    rows.append({"event": "budget", **where, "points": found.points, "accuracy": found.accuracy,
                 "levels": [{"size": s, "roughness": r} for s, r in found.levels], "largest": found.largest.name,
                 "files": row(found.files), "exact_files": row(found.floor), "whole": row(found.whole),
                 "notices": list(found.notices)})
    if choice is not None:
        rows.append({"event": "choice", **where, "tolerance": choice.tolerance, "met": choice.met,
                     "options": dict(choice.options), "bytes": choice.nbytes, "usual_bytes": choice.usual_nbytes,
                     "error": choice.error, "whole": choice.whole, "binds": choice.binds.name,
                     "beyond": [row(e) for e in choice.beyond], "tried": choice.tried})
    return rows


# ---------------------------------------------------------------------------------------------- batches


def result_row(result: Result) -> dict[str, Any]:
    """The JSON row of an item of a batch."""
    row: dict[str, Any] = {"event": result.state, "kind": result.kind, "place": result.place, "name": result.name,
                           "output": result.output}
    if result.state == "failed":
        return {**row, "message": result.message, "exit_code": result.exit_code}
    row |= {"manifest": result.manifest, "files": result.files, "bytes": result.nbytes}
    row |= {"error": result.error} if result.error is not None else {}
    row |= {"predicted": result.predicted} if result.predicted else {}
    return {**row, "seconds": result.seconds, "notices": list(result.notices)}


def result_text(result: Result) -> str:
    """One line of an item; nothing of what is up to date or failed, which the summary tells. Of a plan, its files."""
    if result.state == "done":
        error = "" if result.error is None else f", error {result.error:.1e}"
        return f"{result.place}: {size(result.nbytes)}{error}, {sum(result.seconds.values()):.2f} s"
    if result.state == "planned":
        about = f"; about {result.predicted['cpu_seconds']:.2g} s of processor time and " \
                f"{size(result.predicted['memory'])} of memory" if result.predicted else ""
        return "\n".join([f"{result.place}: {len(result.files)} file{'s' if len(result.files) > 1 else ''}, "
                          f"{size(result.nbytes)} before compression{about}",
                          *(f"  would write {path}  {size(nbytes)}" for path, nbytes in result.files.items())])
    return ""


def rate_text(tally: Tally) -> str:
    """Items a second, and failures so far."""
    failed = f", {len(tally.failed)} failed" if tally.failed else ""
    return f"{tally.count / max(tally.wall, 1e-9):.3g}/s{failed}"


def failures_text(tally: Tally) -> list[str]:
    """Every failure with its reason."""
    return [f"failed: {result.place}: {result.message} (exit code {result.exit_code})" for result in tally.failed]


def tally_text(tally: Tally) -> str:
    """The last line of a batch."""
    states = {"done": "done", "planned": "to do", "skipped": "up to date", "failed": "failed"}
    if tally.total and tally.states["skipped"] == tally.total:
        return f"{tally.total} items, all up to date: nothing to do; {tally.wall:.2f} s"
    told = [f"{tally.states[state]} {text}" for state, text in states.items() if tally.states[state]]
    left = tally.total - tally.count
    told += [f"{left} not begun"] if left else []
    line = f"{tally.total} items: {', '.join(told) or 'none'}; {size(tally.nbytes)}"
    if tally.states["planned"]:
        return line + f", about {tally.predicted['cpu_seconds']:.2g} s of processor time, " \
                      f"{size(tally.predicted['memory'])} of memory a worker"
    return line + f", {tally.wall:.2f} s (" + ", ".join(f"{name} {s:.2f}" for name, s in tally.seconds.items()) + ")"


def tally_row(tally: Tally) -> dict[str, Any]:
    """The last JSON row of a batch, with every failure."""
    return {"event": "summary", "items": tally.total, **tally.states, "bytes": tally.nbytes, "wall": tally.wall,
            "seconds": tally.seconds, **({"predicted": tally.predicted} if tally.states["planned"] else {}),
            "failures": [{"place": r.place, "message": r.message, "exit_code": r.exit_code} for r in tally.failed]}
