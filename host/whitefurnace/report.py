"""Results as rows: for a terminal's table and for JSON Lines. Makes text, prints nothing."""
from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from whitefurnace.catalogue.bibliography import PAPERS

if TYPE_CHECKING:
    from whitefurnace.baking import Baked
    from whitefurnace.catalogue import Model
    from whitefurnace.device import Candidate
    from whitefurnace.tables import Table
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
    for relative, entry in sorted(m["files"].items()):
        lines.append(f"  wrote {output / relative}  {size(entry['bytes'])}")
    lines.append(f"  wrote {output / (baked.name + '.json')}  the manifest; {baked.seconds:.2f} s in all")
    return "\n".join(lines)


def planned_text(baked: Baked) -> str:
    """What a bake would do."""
    rows = [[f"specular {k}", f"{p.size}²", f"{p.roughness:.3f}", f"{p.grid}²" if p.grid else "texel mean",
             f"{p.pairs:.2g}", f"{p.cuts}×{p.cuts}"] for k, p in enumerate(baked.plan)]
    lines = [f"{baked.name}: would bake, key {baked.manifest['key'][:12]}…",
             table(["", "size", "r", "source grid a face", "lobe evaluations", "nodes a texel"], rows)]
    for path, nbytes in zip(baked.files, baked.nbytes, strict=True):
        lines.append(f"  would write {path}  {size(nbytes)} before compression")
    return "\n".join(lines)


def baked_rows(baked: Baked) -> list[dict[str, Any]]:
    """JSON rows of a bake: one a level, then one for the whole."""
    rows: list[dict[str, Any]] = []
    if baked.state == "planned":
        rows += [{"event": "level", "name": baked.name, "level": k, "size": p.size, "roughness": p.roughness,
                  "grid": p.grid, "pairs": p.pairs, "cuts": p.cuts} for k, p in enumerate(baked.plan)]
    else:
        rows += [{"event": "level", "name": baked.name, "level": k, **row} for k, row in enumerate(baked.levels)]
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
    return "\n".join([*lines, f"  error {m['error']:.1e}, rule {m['rule']}, {m['evaluations']:.2g} evaluations, "
                      f"on {m['device']['name']} ({m['device']['platform']})",
                      f"  wrote {name}  {size(m['bytes'])}", f"  wrote {beside}  the manifest; {table.seconds:.2f} s"])


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
