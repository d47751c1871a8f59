"""`whitefurnace lut`: its options, what it prints and its JSON row."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import print_row, progress, say
from whitefurnace.tables.kinds import listed, schemes_listed
from whitefurnace.text import size, table

if TYPE_CHECKING:
    from whitefurnace.tables.lut import Table

HELP = f"""Write a table of an integral over a grid of parameters.

\b
KIND is what to tabulate:
{listed()}
"""

EPILOG = """\b
Examples:
  whitefurnace lut dfg -o dfg.npy --size 256
  whitefurnace lut dfg -o fitted.npy --size 64 --axis sqrt --fit bilinear
  whitefurnace lut energy -o energy.npy --size 64 --scheme turquin
  whitefurnace lut ltc -o ltc.npy
  whitefurnace lut glass -o glass.ktx2 --size 32
  whitefurnace lut sheen -o cloth.npy --masking ashikhmin
  whitefurnace lut smith -o smith.h --ndf abc:c=1.5
  whitefurnace lut diffusion -o skin.png --size 256
  whitefurnace lut albedo -o gold.exr --fresnel schlick:gold --size 64x32
  whitefurnace lut albedo -o sheen.npy --ndf charlie --axis alpha=.01:1:64:log --tolerance 1e-4
  whitefurnace lut albedo_average -o average.npy --fresnel schlick --axis f0=0:1:32
  whitefurnace lut albedo -o diffuse.npy --diffuse burley --set albedo=.8
  whitefurnace lut radiance -o lit.exr --light punctual --set NoL=.5 --set color=1 --tolerance 1e-4

The array is [y, x] or [y, x, channel]; further axes come first. x is NoV = (x + ½)/N. y is the perceptual roughness
r = (y + ½)/M, smoothest in row 0; the models' own parameters follow r (α = r² for GGX). An integral without a view
direction has one axis, r, as x.

--set fixes a parameter and drops the axis that would vary it: NoV, roughness, phi, a parameter of a model, or
ndf_alpha for the alpha of the slot ndf. --axis NAME=A:B:N replaces the usual axis of that name, or adds a slower one.
The first and last values are A and B, except on the scale `centres`. FILE.json beside FILE describes the table.

Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported,
7 a check failed, 130 interrupted.
"""

OUTPUT, AXES, MODELS, LIGHT, ACCURACY = "Output", "Axes", "Models", "Light (for the kind radiance)", "Accuracy"


@options.command("Bake and tabulate", "Tabulate an integral of a BRDF over roughness and view angle", EPILOG, HELP)
@click.argument("kind")
@options.output_file("Table to write: .npy, .exr, .png (values from 0 to 1), .ktx2, .dds or .h.")
@options.option(
    "--format",
    "stored",
    metavar="NAME",
    heading=OUTPUT,
    help="Pixel format: rg16f, rgba16f or rgba32f in .ktx2 and .dds; r16 or r8 in .png. [default: the "
    "first of these that has enough channels]",
)
@options.option(
    "--for",
    "for_",
    metavar="ENGINE",
    heading=OUTPUT,
    help="Use the size, axes, form and sheen that an engine reads (see `whitefurnace engines`). Only for dfg and "
    "sheen.",
)
@options.option(
    "--scheme",
    metavar="NAME",
    heading=OUTPUT,
    help=f"Form of the table, by default the first of its kind. {schemes_listed()}.",
)
@options.option(
    "--size",
    metavar="N|NxM",
    heading=AXES,
    help="Number of cells along x and y, each 1 to 16384. [default: 128, 64 for ltc]",
)
@options.option(
    "--axis",
    "axes",
    metavar="NAME=A:B:N[:SCALE]",
    multiple=True,
    heading=AXES,
    help="Vary the parameter NAME from A to B in N steps; may be repeated. SCALE is linear (the default), "
    "log, centres, sqrt, f0 or angle; a SCALE alone is that of NoV.",
)
@options.option(
    "--set",
    "fixed",
    metavar="NAME=VALUE",
    multiple=True,
    heading=AXES,
    help="Fix the parameter NAME at VALUE; may be repeated.",
)
@options.option(
    "--backfacing",
    metavar="clamp|absolute",
    heading=AXES,
    help="Accept view directions below the surface (NoV < 0): clamp NoV to 0, or take its absolute value. "
    "[default: refuse them]",
)
@options.ndf("[default: ggx, unless --diffuse or --brdf is given]", heading=MODELS)
@options.option(
    "--masking",
    metavar="NAME",
    heading=MODELS,
    help="Masking and shadowing model, a name from `whitefurnace models`. [default: smith]",
)
@options.option(
    "--fresnel", metavar="NAME[:p=v,...]", heading=MODELS, help=options.fresnel_help("") + " [default: one]"
)
@options.option(
    "--diffuse",
    metavar="NAME[:p=v,...]",
    heading=MODELS,
    help="Diffuse model, added to the specular reflection of --ndf, or alone without --ndf. Only for albedo "
    "and albedo_average.",
)
@options.option(
    "--brdf",
    metavar="FILE.clh",
    heading=MODELS,
    help="A whole BRDF of your own, in RGB. Only for albedo and albedo_average.",
)
@options.light("Light source", heading=LIGHT)
@options.option("--environment", metavar="ENV", heading=LIGHT, help="Environment image in place of a light, in RGB.")
@options.option(
    "--normal",
    metavar="X Y Z",
    type=float,
    nargs=3,
    heading=LIGHT,
    help="Surface normal in the environment. [default: 0 1 0]",
)
@options.rotate(LIGHT)
@options.exposure(LIGHT)
@options.bad_pixels(LIGHT)
@options.layout(LIGHT)
@options.layer(LIGHT)
@options.fill(LIGHT)
@options.tolerance(
    "Largest absolute error, above 0 and below 1. [default: 1e-6, or 1e-12 with --precision 64; some "
    "kinds have their own]"
)
@options.option(
    "--relative-tolerance",
    metavar="X",
    type=float,
    heading=ACCURACY,
    help="Largest error as a share of each value, above 0 and below 1, in place of the absolute tolerance; with both, "
    "the larger of them holds for each value. Of integrals themselves, dfg and radiance.",
)
@options.option(
    "--precision",
    metavar="32|64",
    type=int,
    default=32,
    show_default=True,
    heading=ACCURACY,
    help="Bits of the floating-point numbers that the device computes with.",
)
@options.option(
    "--fit",
    metavar="bilinear",
    heading=ACCURACY,
    help="With `bilinear`, fit the texels so that reads between them are most accurate. For tables of two "
    "axes; implies --as-read.",
)
@options.as_read("Also measure the error of reads between texels, from float16 and 8-bit textures too.")
@options.device()
@options.dry_run()
@options.force()
@options.as_json()
@options.quiet()
def lut(
    kind: str,
    output: Path,
    stored: str | None,
    for_: str | None,
    scheme: str | None,
    size: str | None,
    axes: tuple[str, ...],
    fixed: tuple[str, ...],
    backfacing: str | None,
    ndf: str | None,
    masking: str | None,
    fresnel: str | None,
    diffuse: str | None,
    brdf: str | None,
    light: str | None,
    environment: str | None,
    normal: tuple[float, float, float] | None,
    rotate: float,
    exposure: float,
    bad_pixels: str,
    nonfinite: str | None,
    layout: str | None,
    layer: str | None,
    fill: str | None,
    tolerance: float | None,
    relative_tolerance: float | None,
    precision: int,
    fit: str | None,
    as_read: bool,
    device: str | None,
    dry_run: bool,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Write a table of an integral over a grid of parameters."""
    from whitefurnace.tables import lut as tables
    from whitefurnace.tables.axes import named, named_axes

    request = tables.plan(
        tables.TableRequest(
            kind,
            output,
            stored=stored,
            for_=for_,
            scheme=scheme,
            size=size,
            axes=named_axes("--axis", axes),
            parameters=named("--set", fixed),
            backfacing=backfacing,
            ndf=ndf,
            masking=masking,
            fresnel=fresnel,
            diffuse=diffuse,
            brdf=brdf,
            light=light,
            environment=environment,
            normal=normal,
            rotate=rotate,
            exposure=exposure,
            bad_pixels=bad_pixels,
            nonfinite=nonfinite,
            layout=layout,
            layer=layer,
            fill=fill,
            tolerance=tolerance,
            relative_tolerance=relative_tolerance,
            precision=precision,
            fit=fit,
            as_read=as_read,
            force=force,
        )
    )
    with progress(not (quiet or as_json)) as report:
        made = tables.make(request, device, dry_run=dry_run, progress=report)
    for notice in () if quiet else made.notices:
        say(f"notice: {made.path.name}: {notice}")
    print_table(made, as_json, quiet)


def print_table(made: Table, as_json: bool, quiet: bool) -> None:
    """Print the text or the JSON row of a table that was written, skipped or planned."""
    if as_json:
        print_row(table_row(made))
    elif not quiet:
        click.echo(table_text(made))


def table_text(made: Table) -> str:
    """Return the text of a table that was written, skipped or planned."""
    name, beside = made.path, made.path.with_name(made.path.name + ".json")
    if made.state == "skipped":
        return f"{name}: up to date, nothing to do ({beside})"
    m = made.manifest
    shape = " × ".join(str(n) for n in made.shape)
    lines = [f"{name}: {made.kind.name}, {made.subject}; array of {shape}, float{made.recipe['precision']}"]
    lines += [f"  {axis}  {along}" for axis, along in zip("xyzuvw", made.axes, strict=False)]
    if made.state == "planned":
        return "\n".join(
            [
                *lines,
                f"  would write {name}  {size(made.nbytes)} before compression",
                f"  would write {beside}  the manifest",
            ]
        )
    lines += _stated_lines(made)
    where = f"on {m['device']['name']} ({m['device']['platform']})" if "device" in m else "in numpy"
    done = f"  error {m['error']:.1e}, rule {m['rule']}, {m['evaluations']:.2g} evaluations, {where}"
    return "\n".join(
        [*lines, done, f"  wrote {name}  {size(m['bytes'])}", f"  wrote {beside}  the manifest; {made.seconds:.2f} s"]
    )


def _stated_lines(made: Table) -> list[str]:
    """Return lines with the facts that a manifest states about a table in addition to its error."""
    m, lines = made.manifest, []
    if "channels" in m:
        lines.append(f"  channels  {', '.join(m['channels'])}")
        lines += [f"  formula   {m['formula']}"] if "formula" in m else []
    if "stored" in m:
        lines += [f"  stored as {m['stored']['format']}: off by {m['stored']['error']:.1e} at most, added to the error"]
    lines += made.kind.lines(m)
    if "as_read" in m:
        read = m["as_read"]
        rows = [
            (name, *(f"{e[k]:.1e}" for k in ("p99", "max", "max_all")))
            for name, e in (
                ("at texel centres", read["centres"]),
                *((f"between, {k}", e) for k, e in read["between"].items()),
            )
        ]
        lines.append(table(["  as read", "p99", "max", "max, with r < .045"], [(f"  {r[0]}", *r[1:]) for r in rows]))
    return lines


def table_row(made: Table) -> dict[str, Any]:
    """Return the JSON row of a table."""
    return {
        "event": made.state,
        "file": str(made.path),
        "shape": list(made.shape),
        "seconds": made.seconds,
        **{name: value for name, value in made.manifest.items() if name not in ("whitefurnace", "name")},
        "notices": list(made.notices),
    }
