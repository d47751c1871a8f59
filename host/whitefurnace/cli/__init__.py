"""The command line: argv -> recipe -> … -> exit code. The only module that prints."""
from __future__ import annotations

import contextlib
import io
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from whitefurnace.errors import WhitefurnaceError

# Heavy modules (numpy, OpenCL, image libraries) are imported by the commands that need them: --help is quick.

EPILOG_BAKE = """\b
Examples:
  whitefurnace bake studio.hdr -o baked
  whitefurnace bake day.exr night.exr -o baked --for raw,exr --size 512 --min-size 8
  whitefurnace bake studio.hdr -o baked --quality reference --rotate 90 --exposure -1
  whitefurnace bake demo -o baked --dry-run

\b
Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported,
7 a tolerance was missed, 8 part of several failed, 130 interrupted.
"""


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
             invoke_without_command=True)
@click.version_option(package_name="whitefurnace")
@click.pass_context
def cli(context: click.Context) -> None:
    """Bakes image-based lighting and integrates BRDFs on OpenCL devices, and states the error of what it writes."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@cli.command(epilog=EPILOG_BAKE)
@click.argument("environments", metavar="ENV...", nargs=-1, required=True)
@click.option("-o", "--output", metavar="DIR", required=True, type=click.Path(path_type=Path), help="Output folder.")
@click.option("--for", "for_", metavar="LIST", default="raw", show_default=True,
              help="Who loads it, separated by commas: raw (.npz), exr (strips and lat-longs).")
@click.option("--size", type=int, help="Face edge of the first level, a power of two. [default: 256]")
@click.option("--min-size", type=int, help="Face edge of the last level. [default: 16, or what the engine wants]")
@click.option("--levels", type=int, help="How many levels, down to 1²; those past a --min-size keep that size.")
@click.option("--fit", metavar="read", help="Levels that read best between them, not each its own lobe.")
@click.option("--as-read", is_flag=True, help="State what engines will show of them too; --fit and --dry-run do.")
@click.option("--ndf", metavar="NAME[:p=v,...]", default="ggx", show_default=True,
              help="The lobe; `whitefurnace models` lists them.")
@click.option("--tolerance", metavar="X", type=float, help="Bound on the stated error of every level. [default: 1e-3]")
@click.option("--quality", metavar="NAME", help="draft (1e-2), normal (1e-3) or reference (2e-5), for --tolerance.")
@click.option("--samples", metavar="N", type=int,
              help="Filtered importance sampling with N samples a texel instead, 1 to 65536; its error is stated.")
@click.option("--certify", metavar="N", type=int, default=299, show_default=True,
              help="Texels drawn for each level's statement; more bound it more closely.")
@click.option("--rotate", metavar="DEG", type=float, default=0.0, help="Turn the environment about +Y, +X towards +Z.")
@click.option("--exposure", metavar="EV", type=float, default=0.0, help="Multiply radiance by 2^EV.")
@click.option("--nonfinite", metavar="refuse|zero", default="refuse", show_default=True,
              help="What to do with NaN, infinite and negative values.")
@click.option("--sun", metavar="keep|extract|clamp=X", default="keep", show_default=True,
              help="Take the sun out as a directional light, or leave no texel over X times the mean.")
@click.option("--sh", metavar="window=auto|none|X", default="window=auto", show_default=True,
              help="Window of an engine's irradiance harmonics: the least that keeps them from going negative, none, "
                   "or sinc⁴ with its cutoff at degree X.")
@click.option("--without", metavar="LIST", default="",
              help="Of irradiance, sh, sheen, dfg, skybox, what no material reads; `whitefurnace scene` tells.")
@click.option("--only-levels", metavar="A-B", help="Of raw and exr, the levels that are made, counted from 0.")
@click.option("--table", metavar="N", type=int,
              help="Texels a side of engines' split-sum tables. [default: as they want]")
@click.option("--device", metavar="NAME", help="A number or part of a name from `whitefurnace devices`.")
@click.option("--dry-run", is_flag=True, help="Say what would be done and written, and do nothing.")
@click.option("--force", is_flag=True, help="Bake again, and replace files that are not known to be ours.")
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout, and nothing else there.")
@click.option("--quiet", is_flag=True, help="Print errors only.")
def bake(environments: tuple[str, ...], output: Path, for_: str, device: str | None, dry_run: bool, as_json: bool,
         quiet: bool, **options: Any) -> None:
    """Bake environments into what engines load: the specular chain, irradiance, spherical harmonics and the DFG
    table, each with its error.

    ENV is an image (EXR, HDR, PNG, TIFF, ...) as lat-long, cross or strip, a folder of six faces (px, nx, py, ny,
    pz, nz), a texture (.ktx, .ktx2, .dds, .env, .gltf), or the word demo for the built-in sky.
    """
    from whitefurnace.baking import bake as baking
    from whitefurnace.cli import report

    order = baking.order(environments, output, for_=for_, **options)
    failures: list[tuple[str, WhitefurnaceError]] = []
    with _progress(not (quiet or as_json)) as tell:
        for k, name in enumerate(order.names):
            try:
                baked = baking.bake_one(order, k, device, dry_run=dry_run, progress=tell)
            except WhitefurnaceError as error:
                failures.append((name, error))
                if len(order.names) > 1:
                    if as_json:
                        _json({"event": "error", "name": name, "message": str(error), "exit_code": error.exit_code})
                    _say(f"error: {name}: {error}")
                continue
            for notice in baked.notices:
                if not quiet:
                    _say(f"notice: {name}: {notice}")
            if as_json:
                for row in report.baked_rows(baked):
                    _json(row)
            elif not quiet:
                click.echo(report.baked_text(baked, output))
    if len(order.names) == 1 and failures:
        raise failures[0][1]
    if failures:
        from whitefurnace.errors import PartialError

        alike = len({type(error) for _, error in failures}) == 1 and len(failures) == len(order.names)
        raise (type(failures[0][1]) if alike else PartialError)(
            f"{len(failures)} of {len(order.names)} environments failed")


EPILOG_LUT = """\b
Examples:
  whitefurnace lut dfg -o dfg.npy --size 256
  whitefurnace lut dfg -o fitted.npy --size 64 --axis sqrt --fit bilinear
  whitefurnace lut energy -o energy.npy --size 64 --scheme turquin
  whitefurnace lut ltc -o ltc.npy
  whitefurnace lut glass -o glass.ktx2 --size 32
  whitefurnace lut smith -o smith.h --ndf abc:c=1.5
  whitefurnace lut diffusion -o skin.png --size 256
  whitefurnace lut albedo -o gold.exr --fresnel schlick:gold --size 64x32
  whitefurnace lut albedo -o sheen.npy --ndf charlie --axis alpha=.01:1:64:log --tolerance 1e-4
  whitefurnace lut albedo_average -o average.npy --fresnel schlick --axis f0=0:1:32
  whitefurnace lut albedo -o diffuse.npy --diffuse burley --set albedo=.8
  whitefurnace lut radiance -o lit.exr --light punctual --set NoL=.5 --set color=1 --tolerance 1e-4

\b
The array is [y, x] or [y, x, channel], with more axes before them. x is NoV = (x + ½)/N, y perceptual roughness
r = (y + ½)/M, row 0 smoothest, which the models' own parameters follow (α = r² for GGX). An integral without a view
has r alone, as x. --set fixes a parameter (NoV, roughness, phi, a model's own, or ndf_alpha for that of one slot) and
drops the axis that would vary it; --axis NAME=A:B:N takes the place of the default axis of that name, or comes after
the others, slower. A and B are its ends, unless its scale is `centres`. FILE.json beside FILE tells what is in it.

\b
Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported,
7 a check failed, 130 interrupted.
"""


@cli.command(epilog=EPILOG_LUT)
@click.argument("kind")
@click.option("-o", "--output", metavar="FILE", required=True, type=click.Path(path_type=Path),
              help="The table: .npy, .exr, .png (of values from 0 to 1), .ktx2, .dds or .h.")
@click.option("--size", metavar="N|NxM", help="Cells along x and y, 1 to 16384. [default: 128, 64 for ltc]")
@click.option("--axis", "axes", metavar="NAME=A:B:N[:SCALE]", multiple=True,
              help="A parameter from A to B in N steps; SCALE: linear, log, centres, sqrt, angle. Alone it scales NoV.")
@click.option("--set", "fixed", metavar="NAME=VALUE", multiple=True, help="Fix a parameter.")
@click.option("--fit", metavar="bilinear", help="Texels that read best between them, of two axes; states --as-read.")
@click.option("--as-read", is_flag=True, help="State the error of reads between texels too, of float16 and r8 as well.")
@click.option("--format", "stored", metavar="NAME",
              help="Of .ktx2 and .dds: rg16f (the default up to two channels), rgba16f, rgba32f; of .png: r16, r8.")
@click.option("--for", "for_", metavar="ENGINE", help="Of dfg: the size, axes and form that an engine reads.")
@click.option("--scheme", metavar="NAME",
              help="Of dfg: scale_bias (the default), multiscatter; of energy: kulla_conty (the default), turquin, "
                   "fdez_aguera; of ltc: free (the default), heitz; of "
                   "glass: entering (the default), leaving; of smith: rational (the default), linear; of diffusion: "
                   "skin (the default), burley, dipole, or a medium, as marble.")
@click.option("--ndf", metavar="NAME[:p=v,...]", help="Or FILE.clh. [default: ggx, without a --diffuse or --brdf]")
@click.option("--masking", metavar="NAME", help="[default: smith]")
@click.option("--fresnel", metavar="NAME[:p=v,...]", help="Or NAME:PRESET, as schlick:gold. [default: one]")
@click.option("--diffuse", metavar="NAME[:p=v,...]", help="Added to what the NDF reflects, or alone; for albedos.")
@click.option("--brdf", metavar="FILE.clh", help="A whole BRDF of your own; for albedos, in RGB.")
@click.option("--light", metavar="NAME[:p=v,...]", help="Of radiance: punctual, ambient, disc or rectangle.")
@click.option("--environment", metavar="ENV", help="Of radiance, instead of a light: an image, in RGB.")
@click.option("--normal", metavar="X Y Z", type=float, nargs=3, help="Of the surface there. [default: 0 1 0]")
@click.option("--rotate", metavar="DEG", type=float, default=0.0, help="Turn the environment about +Y, +X towards +Z.")
@click.option("--exposure", metavar="EV", type=float, default=0.0, help="Multiply its radiance by 2^EV.")
@click.option("--nonfinite", metavar="refuse|zero", default="refuse", help="What to do with NaN and infinity there.")
@click.option("--backfacing", metavar="clamp|absolute", help="Views with NoV < 0. [default: refused]")
@click.option("--precision", type=int, default=32, show_default=True, help="32 or 64.")
@click.option("--tolerance", metavar="X", type=float, help="Absolute. [default: 1e-6, 1e-12 for precision 64]")
@click.option("--device", metavar="NAME", help="A number or part of a name from `whitefurnace devices`.")
@click.option("--dry-run", is_flag=True, help="Say what would be done and written, and do nothing.")
@click.option("--force", is_flag=True, help="Make it again, and replace a file that is not known to be ours.")
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout, and nothing else there.")
@click.option("--quiet", is_flag=True, help="Print errors only.")
def lut(kind: str, output: Path, axes: tuple[str, ...], fixed: tuple[str, ...], device: str | None, dry_run: bool,
        as_json: bool, quiet: bool, **options: Any) -> None:
    """Write a table of an integral over a grid of parameters.

    KIND is normalization, projected_area, weak_furnace, albedo, albedo_average, dfg or radiance; energy, which is
    what multiple scattering gives back; sheen, with what it leaves to the layer under it; fresnel_average;
    glass, what a rough boundary reflects and lets through; smith and norm, coefficients of simpler curves;
    diffusion, diffuse light on skin and other media by curvature, over NoL and 1/radius in 1/mm; or
    ltc, linearly transformed cosines for polygonal lights (ltc_1 and ltc_2 are one each of its two textures).
    """
    from whitefurnace.cli import report
    from whitefurnace.tables import lut as tables

    axes = tuple(f"NoV={item}" if item in tables.SCALES else item for item in axes)
    request = tables.order(kind, output, axes=tables.named("--axis", axes),
                           parameters=tables.named("--set", fixed), **options)
    with _progress(not (quiet or as_json)) as tell:
        made = tables.make(request, device, dry_run=dry_run, progress=tell)
    for notice in () if quiet else made.notices:
        _say(f"notice: {made.path.name}: {notice}")
    if as_json:
        _json(report.table_row(made))
    elif not quiet:
        click.echo(report.table_text(made))


EPILOG_BATCH = """\b
Examples:
  whitefurnace batch probes.toml --dry-run
  whitefurnace batch probes.toml --workers 4
  whitefurnace batch probes.toml --shard 2/8 --depfile probes.2.d

\b
JOB is a TOML file of tables [[bake]] and [[lut]]. A [[bake]] has `environments`, a list of paths and patterns (*, ?,
[...] and **), `output`, a folder, `for`, a list, and the options of `whitefurnace bake` under their names; a [[lut]]
has `kind`, `output`, a file, and those of `whitefurnace lut`, `axis` and `set` as lists. Paths are relative to JOB.
All of it is checked before anything runs. What is there and whole is not made again, whoever made it, so a batch that
was stopped goes on where it was.

\b
Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input (the job too), 4 device or build, 5 not supported,
7 a tolerance was missed, 8 part of several failed, 130 interrupted.
"""


@cli.command(epilog=EPILOG_BATCH)
@click.argument("job", type=click.Path(path_type=Path))
@click.option("-o", "--output", "root", metavar="DIR", type=click.Path(path_type=Path),
              help="The folder that all outputs are in and stay in. [default: the folder of JOB]")
@click.option("--workers", metavar="N", type=int, default=1, show_default=True,
              help="Processes on this machine, each with its share of the device's cores.")
@click.option("--scheduler", metavar="tcp://HOST:PORT",
              help="A Dask cluster, whose workers declare the resource OPENCL and see the same folders.")
@click.option("--send", is_flag=True, help="Send sources to the cluster by value: workers need not see them.")
@click.option("--shard", metavar="I/N", help="Every N-th item from the I-th on; the N shards are the whole.")
@click.option("--depfile", metavar="FILE", type=click.Path(path_type=Path),
              help="Write what was made, and from what, as Makefile rules.")
@click.option("--report", "page", metavar="DIR", type=click.Path(path_type=Path),
              help="Write DIR/index.html: a row an item with pictures of its levels, errors, time and size.")
@click.option("--allow-kernels", is_flag=True, help="Let the job name .clh files, whose text the device runs.")
@click.option("--device", metavar="NAME", help="A number or part of a name from `whitefurnace devices`.")
@click.option("--dry-run", is_flag=True, help="Say what would be done and written, and do nothing.")
@click.option("--force", is_flag=True, help="Make all again, and replace files that are not known to be ours.")
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout, and nothing else there.")
@click.option("--quiet", is_flag=True, help="Print failures only.")
def batch(job: Path, root: Path | None, workers: int, scheduler: str | None, send: bool, shard: str | None,
          depfile: Path | None, page: Path | None, allow_kernels: bool, device: str | None, dry_run: bool, force: bool,
          as_json: bool, quiet: bool) -> None:
    """Do many bakes and tables of a job file, each once: what is whole already is skipped."""
    from whitefurnace import errors
    from whitefurnace.batch import jobs as batching
    from whitefurnace.cli import report

    part = batching.shard_of(shard) if shard is not None else None
    if send and scheduler is None:
        raise errors.UsageError("--send sends sources to a --scheduler's cluster, and none is given")
    made = batching.job(job, root=root, allow_kernels=allow_kernels, force=force, device=device, send=send)
    if part:
        made = made.shard(*part)
    tally = batching.Tally(len(made.items))
    results = []

    def tell(result: Any) -> None:
        tally.add(result)
        if depfile is not None:
            results.append(result)
        if as_json:
            _json(report.result_row(result))
        elif not quiet and (line := report.result_text(result)):
            click.echo(line)
        for notice in () if quiet else result.notices:
            _say(f"notice: {result.place}: {notice}")
    try:
        if dry_run:
            for result in made.predicted():
                tell(result)
        else:
            told = _json if as_json else None if quiet else lambda row: click.echo(f"report: {row['file']}")
            with _batch_page(page, job.name, force, tally, told) as add, \
                    _batch_progress(tally, not (quiet or as_json)) as show:
                def on_result(result: batching.Result) -> None:
                    tell(result)
                    add(result)
                    show()

                batching.run(made, workers=workers, scheduler=scheduler, on_result=on_result,
                             on_notice=None if quiet else lambda text: _say(f"notice: {text}"))
        if depfile is not None and not dry_run:
            batching.depfile(made, results, depfile)
    finally:
        if as_json:
            _json(report.tally_row(tally))
        else:
            for line in report.failures_text(tally):
                _say(line)
            if not quiet:
                click.echo(report.tally_text(tally))
    if tally.failed:
        codes = {result.exit_code for result in tally.failed}
        kind = errors.of_code(codes.pop()) if len(codes) == 1 and len(tally.failed) == tally.total else None
        raise (kind or errors.PartialError)(f"{len(tally.failed)} of {tally.total} items failed")


@contextlib.contextmanager
def _batch_page(folder: Path | None, title: str, force: bool, tally: Any,
                tell: Callable[[dict[str, Any]], None] | None) -> Iterator[Callable[[Any], None]]:
    """The page of a batch, which is written of what ended when it is stopped too."""
    if folder is None:
        yield lambda result: None
        return
    from whitefurnace.batch.gallery import Gallery

    with Gallery(folder, title=title, force=force) as page:
        try:
            yield page.add
        finally:
            if tally.count:  # else the page of an earlier run stays
                path = page.close(total=tally.total)
                if tell is not None:
                    tell({"event": "report", "file": str(path)})


@contextlib.contextmanager
def _batch_progress(tally: Any, wanted: bool) -> Iterator[Callable[[], None]]:
    """A bar with the rate, the time that is left and how many failed, on stderr, where that is a terminal."""
    if not wanted or not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from whitefurnace.cli import report

    columns = (MofNCompleteColumn(), BarColumn(), TextColumn("{task.description}"), TimeRemainingColumn(compact=True))
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=tally.total)
        yield lambda: bar.update(task, completed=tally.count, description=report.rate_text(tally))


EPILOG_SCENE = """\b
Examples:
  whitefurnace scene helmet.glb
  whitefurnace scene helmet.glb --for filament --environment studio.hdr -o baked
  whitefurnace scene helmet.glb --for three --environment 'probes/*.exr' --job helmet.toml
  whitefurnace scene helmet.glb --for filament --environment studio.hdr --tolerance .1
  whitefurnace scene helmet.glb --pixel 0.5mm --medium rubber:skin1

\b
FILE's materials are read with their extensions and textures: the range of each value over what the scene's triangles
use of an image. What of ENGINE's usual bake they need is listed, and what not, each with its reason; `cannot` is what
no table of an environment gives. -o bakes it; --job writes a job for `whitefurnace batch`.

\b
With --environment alone, or with --tolerance, the error of each approximation is measured on these materials in ENV: of
the files, the split sum and the model, and of the engine's whole picture, against the full reflectance integral.
--tolerance X finds the cheapest bake whose files add at most X (RMS), says what binds and what no choice reaches, and
-o bakes that.

\b
--pixel, --resolution or --medium tell what each medium inside asks for: whether absorption is seen over the size of the
object, and whether light leaves within a pixel of where it entered; where not, -o and --job have the table of
`whitefurnace lut diffusion`. MEDIUM is the name of a measured one (skin1, marble, wholemilk, water, ...), or σa and σs
per mm, R/G/B or one number, as σa=.03/.17/.48,σs=.74/.88/1.01,g=0,ior=1.3, or distance=1cm,color=.9/.5/.1 for σa.

\b
Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported (without
pygltflib), 7 a tolerance was missed, 130 interrupted.
"""


@cli.command(epilog=EPILOG_SCENE)
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--for", "for_", metavar="ENGINE", default="raw", show_default=True, help="Who loads it, or FILE.toml.")
@click.option("--environment", "environments", metavar="ENV", multiple=True, help="What lights it; may be repeated.")
@click.option("-o", "--output", metavar="DIR", type=click.Path(path_type=Path), help="Bake what is needed into DIR.")
@click.option("--job", metavar="JOB.toml", type=click.Path(path_type=Path),
              help="Write what is needed as a job for `whitefurnace batch`.")
@click.option("--background", is_flag=True, help="The environment itself is seen behind the scene.")
@click.option("--pixel", metavar="LENGTH", help="What a pixel covers of the object, as 0.5mm.")
@click.option("--resolution", metavar="HEIGHT", type=int,
              help="Or that of an image of so many rows by the scene's camera that comes closest.")
@click.option("--medium", "media", metavar="[MATERIAL:]MEDIUM", multiple=True,
              help="What is inside of a material, or of the scene. [default: as KHR_materials_volume has it]")
@click.option("--tolerance", metavar="X", type=float,
              help="Find the cheapest bake whose files add at most X (RMS) to reflected radiance.")
@click.option("--device", metavar="NAME", help="A number or part of a name from `whitefurnace devices`.")
@click.option("--force", is_flag=True, help="Bake again, and replace files that are not known to be ours.")
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout, and nothing else there.")
@click.option("--quiet", is_flag=True, help="Print errors only.")
def scene(file: Path, for_: str, environments: tuple[str, ...], output: Path | None, job: Path | None,
          background: bool, pixel: str | None, resolution: int | None, media: tuple[str, ...],
          tolerance: float | None, device: str | None, force: bool, as_json: bool, quiet: bool) -> None:
    """Say what of a bake the materials of a glTF scene need, bake just that, and what it saves."""
    from dataclasses import replace

    from whitefurnace.advice import needs as deciding
    from whitefurnace.cli import report
    from whitefurnace.engines.presets import engines as named
    from whitefurnace.errors import UsageError
    from whitefurnace.scenes import materials as reading

    if output is not None and job is not None:
        raise UsageError("give -o or --job, not both")
    if (output or job) and not environments:
        raise UsageError(f"{'-o' if output else '--job'} bakes an environment: give --environment ENV")
    if tolerance is not None and (job or not environments):
        raise UsageError("--tolerance is for one environment after another: " + (
            "give -o DIR, a job has the same options for all" if job else "give --environment ENV"))
    engine = deciding.one_engine(named(for_))
    found = reading.read_scene(file)
    needs = deciding.needs(found, engine, background=background)
    scaled = pixel is not None or resolution is not None or bool(media)
    inside, covered = _inside(found, pixel, resolution, media) if scaled else ((), None)
    needs = replace(needs, tables=(*needs.tables, *(one.table for one in inside if one.table is not None)))
    for notice in () if quiet else found.notices:
        _say(f"notice: {file.name}: {notice}")
    for row in [*report.scene_rows(found, needs), *report.media_rows(inside, covered)] if as_json else ():
        _json(row)
    if not as_json and not quiet:
        click.echo(report.scene_text(found, needs))
        if scaled:
            click.echo(report.media_text(inside, covered))
    if needs.own is None and not needs.tables:
        return
    if job is not None:
        deciding.write_job(job, needs, for_, file.name, environments, force=force)
        if as_json:
            _json({"event": "job", "file": str(job)})
        elif not quiet:
            click.echo(f"  wrote {job}")
    found_best: dict[str, dict[str, Any]] = {}
    if environments and needs.own and job is None and (output is None or tolerance is not None):
        found_best = _budgets(found, needs, environments, tolerance, device, as_json, quiet)
    if output is not None:
        _bake_needs(needs, for_, environments, output, device, force, as_json, quiet, found_best)


def _inside(scene: Any, pixel: str | None, rows: int | None, named: tuple[str, ...]) -> tuple[Any, Any]:
    """What media ask for at a scale, and what a pixel covers."""
    from whitefurnace.scenes import media

    covered = media.pixel_of(scene, pixel, rows)
    return media.inside(scene, covered, media.named_media(named, scene)), covered


def _budgets(scene: Any, needs: Any, environments: tuple[str, ...], tolerance: float | None, device: str | None,
             as_json: bool, quiet: bool) -> dict[str, dict[str, Any]]:
    """Tells of each environment what approximations cost; the options of `bake` chosen, by environment."""
    from whitefurnace.advice import budget
    from whitefurnace.cli import report

    best = {}
    for name in environments:
        measured, choice = budget.of_image(scene, name, needs.engine, tolerance, device, needs.without)
        if choice is not None:
            best[name] = {key: value for key, value in choice.options.items() if key != "format"}
        for notice in () if quiet else measured.notices:
            _say(f"notice: {measured.environment}: {notice}")
        for row in report.budget_rows(measured, choice) if as_json else ():
            _json(row)
        if not as_json and not quiet:
            click.echo(report.budget_text(measured, choice))
    return best


def _bake_needs(needs: Any, for_: str, environments: tuple[str, ...], output: Path, device: str | None, force: bool,
                as_json: bool, quiet: bool, best: Mapping[str, dict[str, Any]]) -> None:
    from whitefurnace.advice import needs as deciding
    from whitefurnace.baking import bake as baking
    from whitefurnace.cli import report
    from whitefurnace.errors import FileError
    from whitefurnace.tables import lut as tables

    orders = []
    for k, one in enumerate(deciding.bakes(needs, str(output))):
        folder = one.pop("output")
        for some in [(name,) for name in environments] if best and k == 0 else [environments]:
            options = best[some[0]] if best and k == 0 else one
            orders.append((Path(folder), baking.order(some, folder, for_=for_, force=force, **options)))
    with _progress(not (quiet or as_json)) as tell:
        for folder, order in orders:
            for k, name in enumerate(order.names):
                baked = baking.bake_one(order, k, device, progress=tell)
                for notice in () if quiet else baked.notices:
                    _say(f"notice: {name}: {notice}")
                for row in report.baked_rows(baked) if as_json else ():
                    _json(row)
                if not as_json and not quiet:
                    click.echo(report.baked_text(baked, folder))
        if needs.tables and not orders:  # tables alone: no bake has made the folder
            try:
                output.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise FileError(f"cannot make {output}: {error.strerror or error}") from error
        for one in needs.tables:
            options = {key: value for key, value in one.items() if key not in ("kind", "output", "set")}
            request = tables.order(one["kind"], output / one["output"], force=force,
                                   parameters=tables.named("--set", one.get("set", [])), **options)
            made = tables.make(request, device, progress=tell)
            if as_json:
                _json(report.table_row(made))
            elif not quiet:
                click.echo(report.table_text(made))


EPILOG_VERIFY = """\b
Examples:
  whitefurnace verify
  whitefurnace verify ggx smith burley --precision 32
  whitefurnace verify gtr:gamma=2 schlick:gold --plot figures
  whitefurnace verify my_lobe.clh:alpha=.3 my_brdf.clh:roughness=.5 --json

\b
A row is the worst of all cells of a check: its value, what is expected (equal, or a bound), the error and what is
tolerated, all absolute. A model is checked for what its entry declares; `whitefurnace models NAME` shows that. What is
`told` is measured and not judged. A file defines ndf_STEM_D or brdf_STEM_f, and all its parameters must be given.

\b
Exit codes: 0 all passed, 1 usage, 2 cannot read or write, 3 invalid input (an NDF that cannot be normalized), 4 device
or build, 5 not supported, 7 a check failed, 130 interrupted.
"""


@cli.command(epilog=EPILOG_VERIFY)
@click.argument("specs", metavar="[MODEL|FILE.clh...]", nargs=-1)
@click.option("--precision", metavar="32|64", type=int, help="[default: both, where the device has float64]")
@click.option("--plot", "folder", metavar="DIR", type=click.Path(path_type=Path),
              help="Draw shapes, curves and error maps into this folder.")
@click.option("--device", metavar="NAME", help="A number or part of a name from `whitefurnace devices`.")
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout, and nothing else there.")
@click.option("--quiet", is_flag=True, help="Print what failed only.")
def verify(specs: tuple[str, ...], precision: int | None, folder: Path | None, device: str | None, as_json: bool,
           quiet: bool) -> None:
    """Check models against exact values, float64 references and what they declare of themselves.

    All of the catalogue without a MODEL; else those named (ggx, ggx:alpha=.3, schlick:gold) and files of your own.
    """
    import time
    from itertools import groupby

    from whitefurnace.cli import report
    from whitefurnace.errors import CheckError, UsageError
    from whitefurnace.opencl.device import choose_device
    from whitefurnace.verification import checks as verification

    start = time.perf_counter()
    if precision not in (None, *verification.PRECISIONS):
        raise UsageError(f"precision {precision} is not one of 32, 64")
    subjects = verification.subjects(specs)
    if folder is not None:
        _plots_into(folder)
    on = choose_device(device)
    both = verification.PRECISIONS if on.fp64 else (32,)
    if precision is None and not on.fp64 and not quiet:
        _say(f"notice: {on.identity()['name']} has no float64: float32 only")
    rows: list[verification.Row] = []
    with _progress(not (quiet or as_json)) as tell:
        found = verification.verify(subjects, (precision,) if precision else both, on,
                                    (lambda what, share: tell("verify", what, share)) if tell else None)
        for _, group in groupby(found, key=lambda row: (row.slot, row.model)):
            some = list(group)
            rows += some
            if as_json:
                for row in report.verify_rows(some):
                    _json(row)
            elif shown := [row for row in some if not (quiet and row.passed)]:
                if len(rows) == len(some):
                    click.echo(report.VERIFY_HEAD)
                click.echo(report.verify_text(shown))
    if folder is not None:
        from whitefurnace.verification.figures import draw

        for path in draw(folder, [subject.model for subject in subjects], rows, on):
            if as_json:
                _json({"event": "plot", "file": str(path)})
            elif not quiet:
                click.echo(f"  wrote {path}")
    if not (quiet or as_json):
        click.echo(report.verify_summary(rows, time.perf_counter() - start, on.identity()["name"]))
    failed = [row for row in rows if not row.passed]
    if failed:
        raise CheckError(f"{len(failed)} of {len(rows)} checks failed, the first: {failed[0].slot} {failed[0].model}, "
                         f"{failed[0].check} in float{failed[0].precision}")


EPILOG_BENCH = """\b
Examples:
  whitefurnace bench
  whitefurnace bench convolve dfg --json
  whitefurnace bench tradeoff studio.hdr demo --plot figures
  whitefurnace bench --dry-run

\b
Kernels are timed by the device's own clock: the median of several runs with the least and the largest, one before them
left out. Of peak and of memory are ratios to multiply-adds from registers and to memory that is read, run beside them.
tradeoff bakes the specular chain of each ENV by every method and setting: seconds from texels in memory to levels, the
certificate apart, and the stated error of the worst level; `front` is what no other setting beats. On the first ENV it
also measures what output size, source size and roughness cost.

\b
Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported,
130 interrupted.
"""


@cli.command(epilog=EPILOG_BENCH)
@click.argument("words", metavar="[CASE...|tradeoff ENV...]", nargs=-1)
@click.option("--size", type=int, help="Of tradeoff: face edge of the first level. [default: 256]")
@click.option("--min-size", type=int, help="Of tradeoff: face edge of the last level. [default: 16]")
@click.option("--runs", type=int, help="Runs of each. [default: 7, of tradeoff at most 5 within 3 s]")
@click.option("--plot", "folder", metavar="DIR", type=click.Path(path_type=Path),
              help="Of tradeoff: draw tradeoff.png into this folder.")
@click.option("--device", metavar="NAME", help="A number or part of a name from `whitefurnace devices`.")
@click.option("--dry-run", is_flag=True, help="Say what would be measured, and do nothing.")
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout, and nothing else there.")
def bench(words: tuple[str, ...], size: int | None, min_size: int | None, runs: int | None, folder: Path | None,
          device: str | None, dry_run: bool, as_json: bool) -> None:
    """Measure kernels against what the device can do, or the prefilter's error against its time.

    All kernels without a CASE; --dry-run lists them. ENV is what `bake` takes.
    """
    from whitefurnace.benching import throughput as benching
    from whitefurnace.cli import report
    from whitefurnace.errors import UsageError
    from whitefurnace.opencl.device import choose_device

    if runs is not None and not 1 <= runs <= 1000:
        raise UsageError(f"runs {runs} is outside [1, 1000]")
    if words and words[0] == "tradeoff":
        _tradeoff(words[1:], 256 if size is None else size, 16 if min_size is None else min_size, runs, folder, device,
                  dry_run, as_json)
        return
    for name, given in (("--size", size), ("--min-size", min_size), ("--plot", folder)):
        if given is not None:
            raise UsageError(f"{name} is of `bench tradeoff ENV...`")
    cases = benching.cases(words)
    if dry_run:
        for planned in report.case_rows(cases, benching.FLOPS) if as_json else ():
            _json(planned)
        if not as_json:
            click.echo(report.cases_text(cases, benching.FLOPS))
        return
    on = choose_device(device)
    meter = benching.Meter(on)
    rows = []
    with _progress(not as_json) as tell:
        for row in benching.throughput(cases, on, meter, runs or benching.RUNS,
                                       (lambda what, share: tell("bench", what, share)) if tell else None):
            rows.append(row)
            if as_json:
                _json(report.bench_row(row))
    yardstick, said = meter.yardstick(), on.identity()
    if as_json:
        _json(report.yardstick_row(yardstick, said))
    else:
        click.echo(report.bench_text(rows, yardstick, f"{said['name']} ({said['platform']})"))


def _tradeoff(sources: tuple[str, ...], size: int, min_size: int, runs: int | None, folder: Path | None,
              device: str | None, dry_run: bool, as_json: bool) -> None:
    from whitefurnace.benching import tradeoff
    from whitefurnace.cli import report
    from whitefurnace.errors import UsageError
    from whitefurnace.opencl.device import choose_device

    if not sources:
        raise UsageError("bench tradeoff wants one environment or several: images, or the word demo")
    tradeoff.check(size, min_size)
    if dry_run:
        for source in sources:
            if as_json:
                _json({"event": "planned", "environment": source, "methods": tradeoff.methods()})
            else:
                click.echo(f"{source}: would measure " + ", ".join(f"{m} {x:g}" for m, x in tradeoff.methods()))
        return
    if folder is not None:
        _plots_into(folder)
    on = choose_device(device)
    points: list[tradeoff.Point] = []
    costs: list[tradeoff.Cost | tradeoff.Missed] = []
    with _progress(not as_json) as tell:
        for source in sources:
            env = tradeoff.load(source, on)
            told = (lambda what, share, name=env.name: tell(name, what, share)) if tell else None
            found = list(tradeoff.points(env, on, size=size, min_size=min_size, runs=runs or tradeoff.RUNS,
                                         progress=told))
            own = tradeoff.with_front([p for p in found if isinstance(p, tradeoff.Point)])
            missed = [p for p in found if isinstance(p, tradeoff.Missed)]
            points += own
            for row in report.tradeoff_rows([*own, *missed]) if as_json else ():
                _json(row)
            if not as_json:
                click.echo(report.tradeoff_text(own, missed))
            if source is sources[0]:
                costs = list(tradeoff.costs(env, on, size=size, min_size=min_size, runs=runs or tradeoff.RUNS,
                                            progress=told))
    for row in report.tradeoff_rows(costs) if as_json else ():
        _json(row)
    said, measured = on.identity(), [c for c in costs if isinstance(c, tradeoff.Cost)]
    if not as_json:
        click.echo(report.costs_text(measured, tradeoff.COST_TOLERANCE,
                                     [c for c in costs if isinstance(c, tradeoff.Missed)]))
        click.echo(f"on {said['name']} ({said['platform']})")
    else:
        _json({"event": "device", "device": said})
    if folder is not None:
        from whitefurnace.benching.figures import draw_tradeoff

        path = draw_tradeoff(folder, points, measured, on)
        if as_json:
            _json({"event": "plot", "file": str(path)})
        else:
            click.echo(f"  wrote {path}")


EPILOG_RENDER = """\b
Examples:
  whitefurnace bake demo -o baked --for filament,three --size 64
  whitefurnace render baked/demo.json --for filament -o grid.png
  whitefurnace render baked/demo.json --for three -o gold.png --base-color 1 .78 .34 --rows 1 --exposure -1
  whitefurnace render baked/demo.json --for filament -o beside.png --truth demo --multiscatter
  whitefurnace render baked/demo.json --for filament -o layers.exr --truth demo --light punctual:NoL=.5,color=2
  whitefurnace render baked/demo.json --for filament -o helmet.png --scene helmet.glb

\b
MANIFEST is the STEM.json of a bake. Roughness goes from 0 to 1 across, metalness from 0 to 1 down (one row: 1). The
spheres are seen in parallel along -z with +y up; behind them is level 0, as a camera of 60 degrees sees it. The picture
is in sRGB: radiance times 2^exposure, clipped at 1, without a tone curve.

\b
With --truth, the image that the bake was made of, there are three panels: what the engine shows, the full reflectance
integral of the same pixels, and their difference over the truth. An .exr holds them as layers of float32, in linear
radiance. A light's place and directions are in the frame of the viewer (+z to the viewer, +x right), in radii of a
sphere about its middle; lights are added to both pictures alike.

\b
With --scene there is a sphere for each of a glTF's materials (at most 64), in the order of the file and with the mean
of what its textures have in use, --columns to a row. What a sphere leaves out of its material is a notice.

\b
Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported (an engine that
is given no prefiltered chain), 130 interrupted.
"""


@cli.command(epilog=EPILOG_RENDER)
@click.argument("manifest", type=click.Path(path_type=Path))
@click.option("-o", "--output", metavar="FILE", required=True, type=click.Path(path_type=Path),
              help="The picture: .png, or .exr of the layers with --truth.")
@click.option("--for", "for_", metavar="ENGINE", required=True,
              help="Whose files are read, and who is followed in how they are shaded: one that the bake was for.")
@click.option("--size", type=int, default=128, show_default=True, help="Pixels a sphere's cell, 8 to 2048.")
@click.option("--columns", type=int, default=7, show_default=True, help="Spheres across, roughness 0 to 1.")
@click.option("--rows", type=int, help="Spheres down, metalness 0 to 1. [default: 3]")
@click.option("--base-color", metavar="R G B", type=float, nargs=3, help="[default: 1 1 1]")
@click.option("--scene", metavar="FILE", type=click.Path(path_type=Path),
              help="A .glb or .gltf: a sphere for each of its materials in place of the grid.")
@click.option("--background", metavar="environment|plain", default="environment", show_default=True)
@click.option("--exposure", metavar="EV", type=float, default=0.0, help="Multiply radiance by 2^EV.")
@click.option("--truth", metavar="ENV", help="The image of the bake: draw the full integral beside it.")
@click.option("--tolerance", metavar="X", type=float,
              help="Of the truth: the 99th percentile of relative errors, by which samples are chosen. [default: 1e-2]")
@click.option("--certify", metavar="N", type=int,
              help="Pixels of each column of the truth that are held against a quadrature in float64. [default: 1]")
@click.option("--multiscatter", is_flag=True, help="Give the truth what facets lose that scatter once, by scale.")
@click.option("--ndf", metavar="NAME[:p=v,...]", help="Of the truth. [default: the bake's]")
@click.option("--dielectric", metavar="NAME[:p=v,...]", help="Fresnel of metalness 0. [default: schlick:f0=.04]")
@click.option("--metal", metavar="NAME[:p=v,...]", help="Of metalness 1, as schlick:gold. [default: Schlick's of the "
                                                        "base color]")
@click.option("--diffuse", metavar="NAME[:p=v,...]", help="As oren_nayar:sigma=.5. [default: lambert]")
@click.option("--light", metavar="NAME[:p=v,...]", multiple=True,
              help="Besides the environment: punctual, ambient, disc or rectangle.")
@click.option("--device", metavar="NAME", help="Of the truth: a number or part of a name from `whitefurnace devices`.")
@click.option("--force", is_flag=True, help="Replace FILE where it is there.")
@click.option("--json", "as_json", is_flag=True, help="One JSON row on stdout.")
def render(manifest: Path, output: Path, truth: str | None, as_json: bool, **options: Any) -> None:
    """Draw a grid of spheres, or a scene's materials, from the files that a bake made for an engine, shaded as that
    engine does, and beside it the truth."""
    from whitefurnace.cli import report
    from whitefurnace.errors import UsageError
    from whitefurnace.rendering import shading as rendering

    own: dict[str, Any] = {name: options.pop(name) for name in (
        "tolerance", "certify", "multiscatter", "ndf", "dielectric", "metal", "diffuse", "light", "device")}
    own = {name: value for name, value in own.items() if value is not None and value is not False and value != ()}
    if truth is None:
        if own:
            raise UsageError(f"--{next(iter(own))} is of the truth: give the image of the bake as --truth ENV")
        made = rendering.render(manifest, output, **options)
        row, text = report.rendered_row(made), report.rendered_text(made)
    else:
        from whitefurnace.rendering import side_by_side as beside

        with _progress(not as_json) as tell:
            both = beside.render(manifest, output, truth=truth, **own, **options,
                                 progress=(lambda what, share: tell(output.name, what, share)) if tell else None)
        made, row, text = both, report.beside_row(both), report.beside_text(both)
    if as_json:
        _json(row)
        return
    for notice in made.notices:
        _say(f"notice: {made.engine}: {notice}")
    click.echo(text)


EPILOG_INSPECT = """\b
Examples:
  whitefurnace inspect baked/raw/studio.npz
  whitefurnace inspect environment.env --json

\b
FILE is a .ktx, .ktx2, .dds, .env, .gltf or .glb, a .npz, .npy, .h or manifest of ours, harmonics as text, or an image.

\b
Exit codes: 0 done, 1 usage, 2 cannot read, 3 invalid input (truncated and corrupted files too), 130 interrupted.
"""


@cli.command(epilog=EPILOG_INSPECT)
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="One JSON row on stdout.")
def inspect(file: Path, as_json: bool) -> None:
    """Say what is in a texture, table or image: levels, ranges, key-values, whose it looks like, what we stated."""
    from whitefurnace.cli import report
    from whitefurnace.inspection import contents

    row = contents.described(contents.contents(file))
    if as_json:
        _json(report.finite(row))
    else:
        click.echo(report.inspect_text(row))


EPILOG_COMPARE = """\b
Examples:
  whitefurnace compare studio.ktx baked/raw/studio.npz
  whitefurnace compare theirs.dds ours.ktx2 --axes-a three --max-error 1e-2 --plot figures

\b
B is the reference. Of a level `error` is the 99th percentile of its texel errors, max over channels of
|a - b| / max(b, 1e-3 of the level's mean), `worst` the largest and `rmse` the relative RMSE by solid angle; errors of
tables are absolute, those of harmonics over the largest L00. Levels are matched by size, and by roughness where both
files tell it; where no size is common, level 0 with level 0.

\b
Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 5 not supported, 7 past --max-error,
130 interrupted.
"""


@cli.command(epilog=EPILOG_COMPARE)
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("--max-error", metavar="X", type=float,
              help="Exit 7 where `error` of a level, or `worst` of a table or of harmonics, is larger.")
@click.option("--axes-a", metavar="AXES", help='Axes A is stored in, as "-x +y +z" or an engine. [default: ours]')
@click.option("--axes-b", metavar="AXES", help="The same of B.")
@click.option("--plot", "folder", metavar="DIR", type=click.Path(path_type=Path),
              help="Draw error maps into this folder.")
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout, and nothing else there.")
def compare(a: Path, b: Path, max_error: float | None, axes_a: str | None, axes_b: str | None, folder: Path | None,
            as_json: bool) -> None:
    """Compare cubes, lat-longs, tables and harmonics of two files, whatever containers they are in."""
    from whitefurnace.cli import report
    from whitefurnace.errors import CheckError, UsageError
    from whitefurnace.inspection import comparison
    from whitefurnace.inspection.contents import contents

    if max_error is not None and not 0 <= max_error < float("inf"):
        raise UsageError(f"max-error {max_error} is outside [0, inf)")
    if folder is not None:
        _plots_into(folder)
    found = comparison.compare(contents(a), contents(b), axes_a=axes_a, axes_b=axes_b)
    for row in report.compared_rows(found) if as_json else ():
        _json(row)
    for notice in found.notices:
        _say(f"notice: {notice}")
    if not as_json:
        click.echo(report.compared_text(found))
    if folder is not None:
        from whitefurnace.inspection.figures import draw_comparison

        path = draw_comparison(folder, found)
        if as_json:
            _json({"event": "plot", "file": str(path)})
        else:
            click.echo(f"  wrote {path}")
    if max_error is not None and (beyond := found.beyond(max_error)) is not None:
        what = "error" if beyond.kind == "level" else "worst"
        raise CheckError(f"{beyond.part} of {a} has {what} {beyond.bounded:.3g} against {b}, {max_error:g} is allowed")


@cli.command(epilog="\b\nExample:\n  whitefurnace devices\n\nExit codes: 0 one works, 4 none does.")
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout.")
def devices(as_json: bool) -> None:
    """List OpenCL devices with a verdict: a device counts only after a small build and run gave the right answer."""
    from dataclasses import asdict

    from whitefurnace.cli import report
    from whitefurnace.errors import DeviceError
    from whitefurnace.opencl.device import INSTALL, find_devices

    found = find_devices()
    for candidate in found if as_json else ():
        _json(asdict(candidate))
    if found and not as_json:
        click.echo(report.devices_text(found))
    if not any(candidate.works for candidate in found):
        raise DeviceError(f"no OpenCL device {'works' if found else 'was found'}: {INSTALL}")


@cli.command(epilog="\b\nExamples:\n  whitefurnace models\n  whitefurnace models ggx --json")
@click.argument("name", required=False)
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout.")
def models(name: str | None, as_json: bool) -> None:
    """List the models of the catalogue, or one, with parameters, domains and sources."""
    from whitefurnace.catalogue import SLOTS
    from whitefurnace.catalogue import models as of_slot
    from whitefurnace.cli import report
    from whitefurnace.errors import UsageError, nearest

    entries = [entry for slot in SLOTS for entry in of_slot(slot).values()]
    if name is not None:
        wanted = [entry for entry in entries if entry.name == name]
        if not wanted:
            raise UsageError(f"unknown model {name!r}{nearest(name, [entry.name for entry in entries])}")
        entries = wanted
    if as_json:
        for row in report.model_rows(entries):
            _json(row)
    else:
        click.echo(report.models_text(entries) if name is None else
                   "\n\n".join(report.model_text(entry) for entry in entries))


@cli.command(epilog="\b\nExamples:\n  whitefurnace engines\n  whitefurnace engines filament\n"
                    "  whitefurnace engines bevy --toml > my_engine.toml")
@click.argument("name", required=False)
@click.option("--toml", "as_toml", is_flag=True, help="As a file that --for takes, to begin your own engine with.")
@click.option("--json", "as_json", is_flag=True, help="JSON Lines on stdout.")
def engines(name: str | None, as_toml: bool, as_json: bool) -> None:
    """List the engines that `--for` knows, or one (a FILE.toml too): files, mapping, conventions, steps."""
    from whitefurnace.cli import report
    from whitefurnace.engines.presets import ENGINES, as_text
    from whitefurnace.engines.presets import engines as named
    from whitefurnace.errors import UsageError

    found = list(ENGINES.values()) if name is None else list(named(name))
    if as_toml:
        if name is None or len(found) > 1 or found[0].container != "files":
            raise UsageError("--toml writes one engine: give a NAME, and neither raw nor exr")
        click.echo(as_text(found[0]), nl=False)
    elif as_json:
        for engine in found:
            _json({"event": "engine", **engine.data()})
    else:
        click.echo(report.engines_text(found) if name is None else "\n\n".join(map(report.engine_text, found)))


def _plots_into(folder: Path) -> None:
    """Makes the folder for plots, and finds matplotlib missing, before the work and not after it."""
    from whitefurnace import plot_style
    from whitefurnace.errors import FileError

    plot_style.require()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{folder}: cannot be made: {error.strerror}") from None


def _json(row: dict[str, Any]) -> None:
    click.echo(json.dumps(row, ensure_ascii=False, allow_nan=False, default=str))


def _say(text: str) -> None:
    click.echo(text, err=True)


@contextlib.contextmanager
def _progress(wanted: bool) -> Iterator[Callable[[str, str, float], None] | None]:
    """A bar on stderr, where that is a terminal."""
    if not wanted or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f}%"),
               TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, Any] = {}

        def tell(name: str, what: str, share: float) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=1.0)
            bar.update(tasks[name], completed=share, description=f"{name}  {what}")

        yield tell


def _abandon_stdout() -> None:
    """What is left to be flushed goes nowhere, so that Python's own flush at exit does not complain."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def main(argv: list[str] | None = None) -> None:
    """Entry point: runs the command and turns every error into one sentence and its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without ² or × shows a ?, not a traceback
    try:
        result = cli.main(argv, prog_name="whitefurnace", standalone_mode=False)
        sys.stdout.flush()
        code = result if isinstance(result, int) else 0
    except WhitefurnaceError as error:
        if "--json" in (sys.argv[1:] if argv is None else argv):
            with contextlib.suppress(OSError):  # nobody reads stdout; the code still tells
                _json({"event": "error", "message": str(error), "exit_code": error.exit_code})
        _say(f"error: {error}")
        code = error.exit_code
    except click.exceptions.Exit as done:
        code = done.exit_code
    except click.ClickException as error:
        _say(f"error: {error.format_message()}")
        code = 1
    except (click.Abort, KeyboardInterrupt):
        _say("interrupted: nothing half-written was left")
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        # Not sys.exit: an interrupt inside an exec, as of a dataclass at import, marks the process, and Python then
        # ends it by the signal whatever is asked.
        os._exit(130)
    except BrokenPipeError:  # the reader of stdout went away; what it did not read cannot be flushed either
        _abandon_stdout()
        code = 2
    except OSError as error:  # stdout is full; files have errors of their own
        _abandon_stdout()
        _say(f"error: cannot write the results: {error.strerror or error}")
        code = 2
    except MemoryError:
        _say("error: there is not enough memory for this; a smaller input or size is needed")
        code = 2
    sys.exit(code)
