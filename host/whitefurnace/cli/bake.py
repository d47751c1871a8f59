"""`whitefurnace bake`: its options, what it prints and its JSON rows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import print_row, progress, say
from whitefurnace.errors import PartialError, WhitefurnaceError
from whitefurnace.text import size, table

if TYPE_CHECKING:
    from whitefurnace.baking.bake import Baked, BakePlan

EPILOG = """\b
Examples:
  whitefurnace bake studio.hdr -o baked
  whitefurnace bake day.exr night.exr -o baked --for raw,exr --size 512 --min-size 8
  whitefurnace bake studio.hdr -o baked --quality reference --rotate 90 --exposure -1
  whitefurnace bake demo -o baked --dry-run

Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported,
7 a tolerance was missed, 8 part of several failed, 130 interrupted.
"""

OUTPUT, ACCURACY, ENVIRONMENT, LIGHT = "Output", "Accuracy", "Environment", "Sun and harmonics"


@options.command("Bake and tabulate", "Bake environments into the textures that engines load", EPILOG)
@click.argument("environments", metavar="ENV...", nargs=-1, required=True)
@options.output_folder("Folder that the files are written to.", required=True)
@options.option(
    "--for",
    "for_",
    metavar="LIST",
    default="raw",
    show_default=True,
    heading=OUTPUT,
    help="Target engines, separated by commas: names from `whitefurnace engines`, raw (.npz), exr (strips "
    "and lat-longs), or a FILE.toml that describes your own.",
)
@options.option(
    "--size",
    metavar="N",
    type=int,
    heading=OUTPUT,
    help="Edge of a cube face of the first level in texels, a power of two from 1 to 2048. An engine that filters an "
    "image itself gets one of 4 N columns, and without this option one of the size of the source. [default: 256, or "
    "the engine's]",
)
@options.option(
    "--min-size",
    metavar="N",
    type=int,
    heading=OUTPUT,
    help="Edge of a cube face of the last level in texels, a power of two up to --size. [default: 16, or the engine's]",
)
@options.option(
    "--levels",
    metavar="N",
    type=int,
    heading=OUTPUT,
    help="Number of levels, at most as many as halving gives from --size down to 1 texel. Levels past "
    "--min-size keep that size.",
)
@options.option(
    "--only-levels", metavar="A-B", heading=OUTPUT, help="Make only the levels A to B, counted from 0. For raw and exr."
)
@options.option(
    "--without",
    metavar="LIST",
    default="",
    heading=OUTPUT,
    help="Leave out parts that no material reads, separated by commas: irradiance, sh, sheen, dfg, skybox. "
    "`whitefurnace scene` lists which parts a scene needs.",
)
@options.option(
    "--table",
    metavar="N",
    type=int,
    heading=OUTPUT,
    help="Texels along each side of the engines' split-sum tables, 1 to 4096. [default: the engine's]",
)
@options.ndf("Only isotropic ones can be prefiltered.", default="ggx", heading=OUTPUT)
@options.tolerance(
    "Largest error that the levels may have, 1e-5 to 0.5: a bound on the 99th percentile of the texels' "
    "relative errors. [default: 1e-3]"
)
@options.option(
    "--quality",
    metavar="NAME",
    heading=ACCURACY,
    help="A named tolerance in place of --tolerance: draft (1e-2), normal (1e-3) or reference (2e-5).",
)
@options.option(
    "--samples",
    metavar="N",
    type=int,
    heading=ACCURACY,
    help="Use filtered importance sampling with N samples per texel, 1 to 65536, in place of the exact "
    "sums. The error is measured and stated, not bounded.",
)
@options.certify(
    "Texels per level whose error is measured against the exact integral, 299 to 1048576. More texels "
    "give a tighter bound.",
    default=299,
)
@options.option(
    "--fit",
    metavar="read",
    heading=ACCURACY,
    help="With `read`, fit the levels so that interpolated roughness values are most accurate. By default "
    "each level holds its own lobe.",
)
@options.as_read("Also measure the total error after the engine's sampling. --fit and --dry-run always do.")
@options.rotate(ENVIRONMENT)
@options.exposure(ENVIRONMENT)
@options.bad_pixels(ENVIRONMENT)
@options.layout(ENVIRONMENT)
@options.layer(ENVIRONMENT)
@options.fill(ENVIRONMENT)
@options.option(
    "--sun",
    metavar="keep|extract|clamp=X",
    default="keep",
    show_default=True,
    heading=LIGHT,
    help="Keep the sun in the image, extract it as a directional light, or limit every texel to X times "
    "the mean radiance (X at least 1).",
)
@options.option(
    "--sh",
    metavar="window=auto|none|X",
    default="window=auto",
    show_default=True,
    heading=LIGHT,
    help="Window of the engines' irradiance harmonics: the weakest that keeps them from going negative, "
    "none, or sinc⁴ with its cutoff at degree X, 1 to 1024.",
)
@options.device()
@options.memory()
@options.dry_run()
@options.force()
@options.as_json()
@options.quiet()
def bake(
    environments: tuple[str, ...],
    output: Path,
    for_: str,
    size: int | None,
    min_size: int | None,
    levels: int | None,
    only_levels: str | None,
    without: str,
    table: int | None,
    ndf: str,
    tolerance: float | None,
    quality: str | None,
    samples: int | None,
    certify: int,
    fit: str | None,
    as_read: bool,
    rotate: float,
    exposure: float,
    bad_pixels: str,
    nonfinite: str | None,
    layout: str | None,
    layer: str | None,
    fill: str | None,
    sun: str,
    sh: str,
    device: str | None,
    dry_run: bool,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Bake environments into the files that engines load: the prefiltered specular chain, irradiance, spherical
    harmonics and the DFG table, each with its error.

    ENV is an image (EXR, HDR, PNG, TIFF, ...) as a lat-long, a cross or a strip, six faces (NAME_px, NAME_nx, NAME_py,
    ...) as their folder, a pattern or one of them, a texture (.ktx, .ktx2, .dds, .env, .gltf), or the word demo for the
    built-in sky.
    """
    from whitefurnace.baking import bake as baking
    from whitefurnace.baking.request import BakeRequest

    planned = baking.plan(
        BakeRequest(
            environments,
            output,
            for_=for_,
            size=size,
            min_size=min_size,
            levels=levels,
            only_levels=only_levels,
            without=without,
            table=table,
            ndf=ndf,
            tolerance=tolerance,
            quality=quality,
            samples=samples,
            certify=certify,
            fit=fit,
            as_read=as_read,
            rotate=rotate,
            exposure=exposure,
            bad_pixels=bad_pixels,
            nonfinite=nonfinite,
            layout=layout,
            layer=layer,
            fill=fill,
            sun=sun,
            sh=sh,
            force=force,
        )
    )
    _bake_all(planned, output, device, dry_run, as_json, quiet)


def _bake_all(planned: BakePlan, output: Path, device: str | None, dry_run: bool, as_json: bool, quiet: bool) -> None:
    """Bake every environment of a plan, and print each result or error."""
    from whitefurnace.baking import bake as baking

    failures: list[WhitefurnaceError] = []
    with progress(not (quiet or as_json)) as report:
        for k, name in enumerate(planned.names):
            try:
                baked = baking.bake_one(planned, k, device, dry_run=dry_run, progress=report)
            except WhitefurnaceError as error:
                failures.append(error)
                if len(planned.names) > 1:
                    _print_failure(name, error, as_json)
            else:
                print_baked(baked, output, as_json, quiet)
    _raise_failures(failures, len(planned.names))


def _raise_failures(failures: list[WhitefurnaceError], count: int) -> None:
    """Raise the error of the only environment, or one error that says how many of `count` environments failed."""
    if count == 1 and failures:
        raise failures[0]
    if failures:
        alike = len({type(error) for error in failures}) == 1 and len(failures) == count
        raise (type(failures[0]) if alike else PartialError)(f"{len(failures)} of {count} environments failed")


def _print_failure(name: str, error: WhitefurnaceError, as_json: bool) -> None:
    """Print the error of one of several environments; the others go on."""
    if as_json:
        print_row({"event": "error", "name": name, "message": str(error), "exit_code": error.exit_code})
    say(f"error: {name}: {error}")


def print_baked(baked: Baked, output: Path, as_json: bool, quiet: bool) -> None:
    """Print the result of a bake of one environment, or its plan in a dry run; notices come first."""
    for notice in () if quiet else baked.notices:
        say(f"notice: {baked.name}: {notice}")
    if as_json:
        for row in baked_rows(baked):
            print_row(row)
    elif not quiet:
        click.echo(baked_text(baked, output))


def baked_text(baked: Baked, output: Path) -> str:
    """Return the text of a bake: a row for each level with its errors, then the files."""
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
        rows.append(
            [
                what,
                f"{row['size']}²",
                f"{row['roughness']:.3f}",
                f"{row['error']:.1e}",
                f"{row['worst']:.1e}",
                f"{row['rmse']:.1e}",
                row["method"],
                f"{row['seconds']:.2f} s",
            ]
        )
    wide = m.get("latlong_levels", [])
    for k, row in enumerate(wide, _first(m)):
        rows.append(
            [
                f"lat-long {k}",
                f"{row['size']}×{row['size'] // 2}",
                f"{row['roughness']:.3f}",
                f"{row['error']:.1e}",
                f"{row['worst']:.1e}",
                f"{row['rmse']:.1e}",
                row["method"],
                "",
            ]
        )
    e = m["irradiance"]
    rows.append(
        [
            "irradiance",
            f"{e['size']}²",
            "",
            f"{e['error']:.1e}",
            f"{e['worst']:.1e}",
            f"{e['rmse']:.1e}",
            e["method"],
            "",
        ]
    )
    rows.append(["irradiance SH", "9×3", "", f"{m['sh']['error']:.1e}", "", "", "texel-nodes", ""])
    d = m["dfg"]
    rows.append(["DFG", f"{d['size']}²", "", f"{d['error']:.1e}", "", "", d["rule"], ""])
    if "sun" in m:
        sun = m["sun"]
        triple = ", ".join(f"{x:.4g}" for x in sun["irradiance"])
        towards = ", ".join(f"{x:.4f}" for x in sun["direction"])
        rows.append(["sun", f"{math.degrees(2 * sun['angular_radius']):.2f}°", "", "", "", "", "extracted", ""])
    s = m["source"]["statistics"]
    lines = [
        f"{baked.name}: {m['source']['layout']} {s['width']}×{s['height']}, brightest texel "
        f"{s['max_over_mean']:.3g} × the mean, on {m['device']['name']} ({m['device']['platform']})",
        table(["", "size", "r", "error", "worst", "rmse", "method", "time"], rows),
    ]
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


def _format_text(entry: Mapping[str, Any]) -> str:
    """The pixel format of a file, the error of its contents, and the error that the format adds."""
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
    """Return the text of a planned bake: its levels, its files, and the kernel programs it would compile."""
    several = len({names for names, _ in baked.plan}) > 1
    rows = [
        [
            f"specular of {', '.join(names)}" if several else f"specular {k}",
            f"{p.size}²",
            f"{p.roughness:.3f}",
            f"{p.grid}²" if p.grid else f"{p.samples} samples" if p.samples else "texel mean",
            f"{p.pairs:.2g}",
            f"{p.cuts}×{p.cuts}",
        ]
        for k, (names, p) in enumerate(baked.plan, _first(baked.manifest))
    ]
    lines = [
        f"{baked.name}: would bake, key {baked.manifest['key'][:12]}…",
        table(["", "size", "r", "source grid per face", "lobe evaluations", "nodes per texel"], rows),
    ]
    for path, nbytes in zip(baked.files, baked.nbytes, strict=True):
        lines.append(f"  would write {path}  {size(nbytes)} before compression")
    if baked.programs:
        text = size(sum(program.nbytes for program in baked.programs))
        lines.append(f"  would compile {len(baked.programs)} kernel programs of {text} of text; --json has it")
    return "\n".join([*lines, *as_read_lines(baked.as_read)])


AS_READ = ("between", "texels", "levels", "format", "all")


def as_read_lines(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the table of total errors after the engines' sampling, by part; parts that were not measured have no
    column.
    """
    if not found:
        return []
    parts = [part for part in AS_READ if any(part in read["parts"] for read in found)]
    several = len({read.get("for") for read in found}) > 1
    rows = [
        [
            read["for"] if several else "",
            str(read["levels"]),
            f"{read['sizes'][-1]}²",
            read["fit"] or "own lobe",
            *(f"{read['parts'][part]['mean']:.2g}" if part in read["parts"] else "" for part in parts),
            f"{read['parts']['all' if 'all' in read['parts'] else 'between']['p95']:.2g}",
        ]
        for read in found
    ]
    formats = ", ".join(dict.fromkeys(read["format"] for read in found))
    head = ["for", "levels", "last", "fit"]
    if not several:
        rows, head = [row[1:] for row in rows], head[1:]
    return [
        f"  as read from {formats}: total error after the engine's sampling, mean over r of the RMS over directions",
        table([*head, *parts, "p95"], rows, left=len(head)),
    ]


def baked_rows(baked: Baked) -> list[dict[str, Any]]:
    """Return the JSON rows of a bake: one for each level, then one for the whole."""
    rows: list[dict[str, Any]] = []
    if baked.state == "planned":
        rows += [
            {
                "event": "level",
                "name": baked.name,
                "level": k,
                "for": list(names),
                "size": p.size,
                "roughness": p.roughness,
                "grid": p.grid,
                "samples": p.samples,
                "pairs": p.pairs,
                "cuts": p.cuts,
            }
            for k, (names, p) in enumerate(baked.plan, _first(baked.manifest))
        ]
        rows += [{"event": "kernel", "name": baked.name, **program.data()} for program in baked.programs]
    else:
        rows += [
            {"event": "level", "name": baked.name, "level": k, **row}
            for k, row in enumerate(baked.levels, _first(baked.manifest))
        ]
    rows += [{"event": "as_read", "name": baked.name, **read} for read in baked.as_read]
    m = baked.manifest
    whole: dict[str, Any] = {
        "event": baked.state,
        "name": baked.name,
        "key": m["key"],
        "seconds": baked.seconds,
        "notices": list(baked.notices),
    }
    if baked.state == "planned":
        whole |= {"recipe": m["recipe"], "files": {str(p): n for p, n in zip(baked.files, baked.nbytes, strict=True)}}
    else:
        whole |= {"sun": m["sun"]} if "sun" in m else {}
        whole |= {
            "files": m["files"],
            "device": m["device"],
            "irradiance": m["irradiance"],
            "dfg": m["dfg"],
            "sh": m["sh"],
        }
    return [*rows, whole]
