"""Results as rows: for a terminal's table and for JSON Lines. Makes text, prints nothing."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from whitefurnace.baking import Baked
    from whitefurnace.catalogue import Model
    from whitefurnace.device import Candidate


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
    s = m["source"]["statistics"]
    lines = [f"{baked.name}: {m['source']['layout']} {s['width']}×{s['height']}, brightest texel "
             f"{s['max_over_mean']:.3g} × the mean, on {m['device']['name']} ({m['device']['platform']})",
             table(["", "size", "r", "error", "worst", "rmse", "method", "time"], rows)]
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
        whole |= {"files": m["files"], "device": m["device"], "irradiance": m["irradiance"], "dfg": m["dfg"],
                  "sh": m["sh"]}
    return [*rows, whole]


def devices_text(found: Sequence[Candidate]) -> str:
    """Each listed device with its verdict."""
    rows = [[str(c.index), c.type, f"{c.platform}: {c.name}", c.driver, "yes" if c.fp64 else "no", c.verdict]
            for c in found]
    return table(["", "type", "device", "driver", "float64", "verdict"], rows, left=6)


def models_text(entries: Sequence[Model]) -> str:
    """The catalogue as a table."""
    rows = [[e.slot, e.name, e.title, ", ".join(f"{p.name} [{p.low:g}, {p.high:g}]" for p in e.parameters), e.citation]
            for e in entries]
    return table(["slot", "name", "title", "parameters", "source"], rows, left=5)


def model_rows(entries: Sequence[Model]) -> list[dict[str, Any]]:
    """JSON rows of the catalogue."""
    return [{"slot": e.slot, "name": e.name, "title": e.title, "citation": e.citation,
             "parameters": [{"name": p.name, "symbol": p.symbol, "unit": p.unit, "domain": [p.low, p.high],
                             "typical": list(p.typical), "about": p.about} for p in e.parameters],
             "facts": dict(e.facts)} for e in entries]
