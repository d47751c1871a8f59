"""`whitefurnace scene`: its options, what it prints and its JSON rows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.bake import print_baked
from whitefurnace.cli.lut import print_table
from whitefurnace.cli.terminal import print_row, progress, say
from whitefurnace.errors import FileError, UsageError
from whitefurnace.text import size, table

if TYPE_CHECKING:
    from whitefurnace.advice.budget import Budget, Choice, Entry
    from whitefurnace.advice.needs import Needs
    from whitefurnace.scenes.materials import Material, Scene, Spread
    from whitefurnace.scenes.media import Inside, Pixel

EPILOG = """\b
Examples:
  whitefurnace scene helmet.glb
  whitefurnace scene helmet.glb --for filament --environment studio.hdr -o baked
  whitefurnace scene helmet.glb --for three --environment 'probes/*.exr' --job helmet.toml
  whitefurnace scene helmet.glb --for filament --environment studio.hdr --tolerance .1
  whitefurnace scene helmet.glb --pixel 0.5mm --medium rubber:skin1

FILE's materials are read with their extensions and textures: the range of each value over the part of an image that the
scene's triangles use. The list says which parts of the engine's usual bake the materials need, which they do not, and
why; `cannot` marks effects that no table of an environment can give. -o bakes the parts that are needed; --job writes
them as a job for `whitefurnace batch`.

With --environment but without -o, or with --tolerance, the error of each approximation is measured on these materials
in ENV against the full reflectance integral: the error of the files, of the split sum, of the model, and of the
engine's whole picture. --tolerance X finds the cheapest bake whose files add at most X (RMS), names the part that
limits it and the errors that no choice reduces, and -o bakes it.

With --pixel, --resolution or --medium the list also says what each medium inside an object needs: whether absorption
is visible over the size of the object, and whether light leaves within a pixel of where it entered. Where it does not,
-o and --job add the table of `whitefurnace lut diffusion`. MEDIUM is the name of a measured medium (skin1, marble,
wholemilk, water, ...), or σa and σs per mm, R/G/B or one number, as σa=.03/.17/.48,σs=.74/.88/1.01,g=0,ior=1.3, or
distance=1cm,color=.9/.5/.1 for σa.

Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported (without
pygltflib), 7 a tolerance was missed, 130 interrupted.
"""

OUTPUT, SCENE, MEDIA = "Output", "Scene and lighting", "Media inside objects"


@options.command("Scenes and batches", "List which textures and tables a glTF scene needs, or bake them", EPILOG)
@click.argument("file", type=options.FilePath)
@options.output_folder("Bake the parts that are needed into the folder DIR.")
@options.option(
    "--job",
    metavar="JOB.toml",
    type=options.FilePath,
    heading=OUTPUT,
    help="Write the parts that are needed as a job for `whitefurnace batch`.",
)
@options.option(
    "--for",
    "for_",
    metavar="ENGINE",
    default="raw",
    show_default=True,
    heading=OUTPUT,
    help="Target engine: a name from `whitefurnace engines`, or a FILE.toml that describes your own.",
)
@options.option(
    "--environment",
    "environments",
    metavar="ENV",
    multiple=True,
    heading=SCENE,
    help="Environment image that lights the scene; may be repeated.",
)
@options.option("--background", is_flag=True, heading=SCENE, help="The environment is also visible behind the scene.")
@options.option(
    "--pixel", metavar="LENGTH", heading=MEDIA, help="Length on the object that one pixel covers, such as 0.5mm."
)
@options.option(
    "--resolution",
    metavar="HEIGHT",
    type=int,
    heading=MEDIA,
    help="In place of --pixel: the height of the image in pixels, 1 to 16384, seen by the scene's closest camera.",
)
@options.option(
    "--medium",
    "media",
    metavar="[MATERIAL:]MEDIUM",
    multiple=True,
    heading=MEDIA,
    help="Medium inside one material, or inside all that have a volume; may be repeated. [default: that of "
    "KHR_materials_volume]",
)
@options.tolerance(
    "Find the cheapest bake whose files add at most X (RMS) to the error of reflected radiance, 1e-4 "
    "to 1. Needs --environment."
)
@options.device()
@options.memory()
@options.force()
@options.as_json()
@options.quiet()
def scene(
    file: Path,
    output: Path | None,
    job: Path | None,
    for_: str,
    environments: tuple[str, ...],
    background: bool,
    pixel: str | None,
    resolution: int | None,
    media: tuple[str, ...],
    tolerance: float | None,
    device: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """List which textures and tables the materials of a glTF scene need, bake only those, and say what that saves."""
    from whitefurnace.advice import needs as deciding
    from whitefurnace.engines.presets import engines as named
    from whitefurnace.files import require_encoder
    from whitefurnace.scenes import materials as reading

    _check_options(output, job, environments, tolerance)
    engine = deciding.one_engine(named(for_))
    found = reading.read_scene(file)
    for one in engine.file if environments and job is None else ():
        require_encoder(one.stored)
    needs = deciding.needs(found, engine, background=background)
    scaled = pixel is not None or resolution is not None or bool(media)
    inside, covered = _inside(found, pixel, resolution, media) if scaled else ((), None)
    needs = replace(needs, tables=(*needs.tables, *(one.table for one in inside if one.table is not None)))
    for notice in () if quiet else found.notices:
        say(f"notice: {file.name}: {notice}")
    for row in [*scene_rows(found, needs), *media_rows(inside, covered)] if as_json else ():
        print_row(row)
    if not as_json and not quiet:
        click.echo(scene_text(found, needs))
        if scaled:
            click.echo(media_text(inside, covered))
    if needs.own is None and not needs.tables:
        return
    if job is not None:
        deciding.write_job(job, needs, for_, file.name, environments, force=force)
        if as_json:
            print_row({"event": "job", "file": str(job)})
        elif not quiet:
            click.echo(f"  wrote {job}")
    best: dict[str, dict[str, Any]] = {}
    if environments and needs.own and job is None and (output is None or tolerance is not None):
        best = _measure(found, needs, environments, tolerance, device, as_json, quiet)
    if output is not None:
        _bake(needs, for_, environments, output, device, force, as_json, quiet, best)
        _tabulate(needs, output, device, force, as_json, quiet)


def _check_options(
    output: Path | None, job: Path | None, environments: tuple[str, ...], tolerance: float | None
) -> None:
    """Refuse options that exclude each other or that miss another one. Raises UsageError."""
    if output is not None and job is not None:
        raise UsageError("give -o or --job, not both")
    if (output or job) and not environments:
        raise UsageError(f"{'-o' if output else '--job'} bakes an environment: give --environment ENV")
    if tolerance is not None and (job or not environments):
        raise UsageError(
            "--tolerance is for one environment after another: "
            + ("give -o DIR, a job has the same options for all" if job else "give --environment ENV")
        )


def _inside(
    found: Scene,
    pixel: str | None,
    rows: int | None,
    named: tuple[str, ...],
) -> tuple[Sequence[Inside], Pixel | None]:
    """Judge the media of a scene at its scale, and return the judgements and the length that a pixel covers."""
    from whitefurnace.scenes import media

    covered = media.pixel_of(found, pixel, rows)
    return media.inside(found, covered, media.named_media(named, found)), covered


def _measure(
    found: Scene,
    needs: Needs,
    environments: tuple[str, ...],
    tolerance: float | None,
    device: str | None,
    as_json: bool,
    quiet: bool,
) -> dict[str, dict[str, Any]]:
    """Print the error of each approximation in each environment; return the options of the chosen bake by
    environment.
    """
    from whitefurnace.advice import budget

    best = {}
    for name in environments:
        measured, choice = budget.of_image(found, name, needs.engine, tolerance, device, needs.without)
        if choice is not None:
            best[name] = {key: value for key, value in choice.options.items() if key != "format"}
        for notice in () if quiet else measured.notices:
            say(f"notice: {measured.environment}: {notice}")
        for row in budget_rows(measured, choice) if as_json else ():
            print_row(row)
        if not as_json and not quiet:
            click.echo(budget_text(measured, choice))
    return best


def _bake(
    needs: Needs,
    for_: str,
    environments: tuple[str, ...],
    output: Path,
    device: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
    best: Mapping[str, dict[str, Any]],
) -> None:
    """Bake what a scene needs of every environment, with the options of `best` where some were chosen."""
    from whitefurnace.advice import needs as deciding
    from whitefurnace.baking import bake as baking
    from whitefurnace.baking.request import BakeRequest

    requests = []
    for k, one in enumerate(deciding.bakes(needs, str(output))):
        folder = Path(one.pop("output"))
        for some in [(name,) for name in environments] if best and k == 0 else [environments]:
            own = best[some[0]] if best and k == 0 else one
            requests.append((folder, baking.plan(BakeRequest(some, folder, for_=for_, force=force, **own))))
    with progress(not (quiet or as_json)) as report:
        for folder, request in requests:
            for k in range(len(request.names)):
                print_baked(baking.bake_one(request, k, device, progress=report), folder, as_json, quiet)


def _tabulate(needs: Needs, output: Path, device: str | None, force: bool, as_json: bool, quiet: bool) -> None:
    """Write the tables that a scene needs in addition to its bakes. Raises FileError where the folder cannot be
    made.
    """
    from whitefurnace.tables import lut as tables
    from whitefurnace.tables.axes import named

    if needs.tables:
        try:
            output.mkdir(parents=True, exist_ok=True)  # where there are tables alone, no bake has made the folder
        except OSError as error:
            raise FileError(f"cannot make {output}: {error.strerror or error}") from error
    with progress(not (quiet or as_json)) as report:
        for one in needs.tables:
            own = {key: value for key, value in one.items() if key not in ("kind", "output", "set")}
            request = tables.plan(
                tables.TableRequest(
                    one["kind"],
                    output / one["output"],
                    force=force,
                    parameters=named("--set", one.get("set", [])),
                    **own,
                )
            )
            print_table(tables.make(request, device, progress=report), as_json, quiet)


def scene_text(scene: Scene, needs: Needs) -> str:
    """Return the text of a scene: its materials, and which parts of a bake they need."""
    box = scene.extent
    uses = sum(m.uses for m in scene.materials)
    head = [
        f"{len(scene.materials)} material{'' if len(scene.materials) == 1 else 's'} on {uses} "
        f"primitive{'' if uses == 1 else 's'}"
    ]
    head += [" × ".join(f"{x:.3g}" for x in box) + " m"] if box else []
    for count, what in ((len(scene.cameras), "camera"), (scene.lights, "punctual light")):
        head += [f"{count} {what}{'' if count == 1 else 's'}"] if count else []
    rows = [
        [
            m.name,
            _spread_text(m["base_color"]),
            _spread_text(m["metalness"]),
            _spread_text(m["roughness"]),
            ", ".join(_also(m)),
        ]
        for m in scene.materials
    ]
    lines = [f"{scene.path}: {', '.join(head)}"]
    lines += [table(["material", "base colour", "metalness", "roughness", "and"], rows, left=5)] if rows else []
    lines.append(f"  for {needs.engine.name}, before compression:")
    verdict = {True: "yes", False: "no", None: "cannot"}
    lines.append(
        table(
            ["needed", "", "usual", "here", "because"],
            [
                [
                    verdict[row.needed],
                    row.what,
                    size(row.nbytes) if row.nbytes else "",
                    size(row.kept) if row.kept else "0" if row.nbytes else "",
                    row.reason,
                ]
                for row in needs.rows
            ],
            left=5,
        )
    )
    return "\n".join([*lines, f"  {_saved(needs)}"])


def _saved(needs: Needs) -> str:
    if needs.own is None:
        return (
            f"nothing is to be baked: it saves {size(needs.full_nbytes)} and about {needs.full_seconds:.2g} s of "
            "processor time"
        )
    options = [
        f"--{name.replace('_', '-')} {','.join(v) if isinstance(v, list) else v}" for name, v in needs.options.items()
    ]
    bake = " ".join(["bake", *options]) if options else "the usual bake"
    return (
        f"{size(needs.nbytes)} in place of {size(needs.full_nbytes)}, about {needs.seconds:.2g} s of processor "
        f"time in place of {needs.full_seconds:.2g}: {bake}"
    )


def _spread_text(spread: Spread) -> str:
    """A value, or its range over a texture with the mean, as text."""

    def one(values: Sequence[float]) -> str:
        return f"{values[0]:.3g}" if len(set(values)) == 1 else "/".join(f"{v:.3g}" for v in values)

    if spread.low == spread.high:
        return one(spread.low)
    mean = f", mean {one(spread.mean)}" if spread.mean else ""
    return f"{one(spread.low)} … {one(spread.high)}{mean}"


def _also(m: Material) -> list[str]:
    """Further values of a material that its file gives, as text."""
    core, names = ["base_color", "metalness", "roughness"], {}
    if m.has("pbrSpecularGlossiness"):  # its F0 stands in the specular colour, under an infinite ior
        core, names = [*core, "ior"], {"specular_color": "F0"}
    words = ["unlit"] if m.unlit else []
    return words + [
        f"{names.get(name, name).replace('_', ' ')} {_spread_text(spread)}"
        for name, spread in m.values.items()
        if name not in core and spread.given != "default"
    ]


def scene_rows(scene: Scene, needs: Needs) -> list[dict[str, Any]]:
    """Return the JSON rows of a scene: the scene, each material, each need, and the whole."""

    def plain(x: float) -> float | None:
        return x if math.isfinite(x) else None  # an attenuation distance

    rows: list[dict[str, Any]] = [
        {
            "event": "scene",
            "file": str(scene.path),
            "low": scene.low,
            "high": scene.high,
            "lights": scene.lights,
            "cameras": [vars(camera) for camera in scene.cameras],
            "notices": list(scene.notices),
        }
    ]
    rows += [
        {
            "event": "material",
            "name": m.name,
            "uses": m.uses,
            "unlit": m.unlit,
            "extensions": list(m.given),
            "values": {
                name: {
                    "low": [plain(x) for x in s.low],
                    "high": [plain(x) for x in s.high],
                    "mean": [plain(x) for x in s.mean],
                    "given": s.given,
                    "seen": s.seen,
                    **({"histogram": list(s.histogram)} if s.histogram else {}),
                }
                for name, s in m.values.items()
            },
        }
        for m in scene.materials
    ]
    rows += [
        {
            "event": "need",
            "for": needs.engine.name,
            "what": row.what,
            "kind": row.kind,
            "needed": row.needed,
            "reason": row.reason,
            "usual_bytes": row.nbytes,
            "bytes": row.kept,
        }
        for row in needs.rows
    ]
    return [
        *rows,
        {
            "event": "needs",
            "for": needs.engine.name,
            "bake": needs.own is not None,
            "options": needs.options,
            "tables": list(needs.tables),
            "charlie": needs.cloth,
            "bytes": needs.nbytes,
            "usual_bytes": needs.full_nbytes,
            "predicted": {"cpu_seconds": needs.seconds, "usual_cpu_seconds": needs.full_seconds},
        },
    ]


def media_text(found: Sequence[Inside], pixel: Pixel | None) -> str:
    """Return the text of what the media of a scene need at its scale."""
    lines = [f"  inside, where {pixel.text}:" if pixel else "  inside:"]
    if not found:
        lines.append("    no material has a volume: give --medium [MATERIAL:]MEDIUM")
    for one in found:
        lines += [f"    {one.head}", *(f"      {line}" for line in one.lines)]
    return "\n".join(lines)


def media_rows(found: Sequence[Inside], pixel: Pixel | None) -> list[dict[str, Any]]:
    """Return a JSON row for each medium."""
    of = {"camera": pixel.of or None} if pixel else {}
    return [
        {
            "event": "medium",
            "material": one.material or None,
            "size_of": one.size_of or None,
            "reason": one.reason or None,
            "table": one.table,
            **of,
            **(one.judgement.data() if one.judgement else {"subsurface": False}),
        }
        for one in found
    ]


def budget_text(found: Budget, choice: Choice | None = None) -> str:
    """Return the text of each approximation's error on a scene in one environment, and of the bake that was chosen."""
    rows = [*(e for e in found.entries if e.used), found.files, found.floor, found.whole]
    head = [
        f"  errors of reflected radiance in {found.environment}, at {found.points} points of the scene's materials",
        table(["part", "", "rms", "p95", ""], [_entry_cells(e) for e in rows], left=5),
        f"  largest: {found.largest.name}; they do not add up; the integral is within {found.accuracy:.1g} (p99)",
        "  other ways would change what is right by",
        table(["", "", "rms", "p95", ""], [_entry_cells(e) for e in found.entries if not e.used], left=5),
    ]
    return "\n".join([*head, *_chosen_lines(found, choice)])


def _entry_cells(e: Entry) -> list[str]:
    what = e.kind if e.kind in ("files", "split", "model") and e.name not in ("files", "exact files") else ""
    return [e.name, what, f"{'≤ ' if e.bound else ''}{e.rms:.2g}", f"{e.p95:.2g}", e.what]


def _chosen_lines(found: Budget, choice: Choice | None) -> Iterable[str]:
    if choice is None:
        return
    options = " ".join(
        f"--{name.replace('_', '-')} {','.join(v) if isinstance(v, list) else f'{v:g}'}"
        if not isinstance(v, str)
        else f"--{name} {v}"
        for name, v in choice.options.items()
        if name != "format"
    )
    own = f", its chain as {choice.options['format']}" if "format" in choice.options else ""
    if choice.met:
        yield (
            f"  cheapest within {choice.tolerance:g}: bake --for {found.engine} {options}{own}: "
            f"{size(choice.nbytes)} in place of {size(choice.usual_nbytes)}; its files add {choice.error:.2g}, and "
            f"{choice.binds.name} binds ({choice.binds.rms:.2g})"
        )
    else:
        yield (
            f"  none of {choice.tried} sets of files is within {choice.tolerance:g}; the least error, "
            f"{choice.error:.2g}, has bake --for {found.engine} {options}{own}; {choice.binds.name} binds "
            f"({choice.binds.rms:.2g})"
        )
    for e in choice.beyond:
        yield f"  no choice reaches {choice.tolerance:g} of {e.name}: {e.rms:.2g} ({e.what})"


def budget_rows(found: Budget, choice: Choice | None = None) -> list[dict[str, Any]]:
    """Return the JSON rows of an error budget: each approximation, the whole, and the choice."""

    def row(e: Entry) -> dict[str, Any]:
        return {
            "name": e.name,
            "kind": e.kind,
            "rms": e.rms,
            "p95": e.p95,
            "used": e.used,
            "bound": e.bound,
            "what": e.what,
        }

    where = {"for": found.engine, "environment": found.environment}
    rows: list[dict[str, Any]] = [{"event": "approximation", **where, **row(e)} for e in found.entries]
    rows.append(
        {
            "event": "budget",
            **where,
            "points": found.points,
            "accuracy": found.accuracy,
            "levels": [{"size": s, "roughness": r} for s, r in found.levels],
            "largest": found.largest.name,
            "files": row(found.files),
            "exact_files": row(found.floor),
            "whole": row(found.whole),
            "notices": list(found.notices),
        }
    )
    if choice is not None:
        rows.append(
            {
                "event": "choice",
                **where,
                "tolerance": choice.tolerance,
                "met": choice.met,
                "options": dict(choice.options),
                "bytes": choice.nbytes,
                "usual_bytes": choice.usual_nbytes,
                "error": choice.error,
                "whole": choice.whole,
                "binds": choice.binds.name,
                "beyond": [row(e) for e in choice.beyond],
                "tried": choice.tried,
            }
        )
    return rows
