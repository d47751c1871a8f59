"""`whitefurnace render`: its options, what it prints and its JSON row."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import of_one, print_row, progress, say
from whitefurnace.errors import UsageError
from whitefurnace.text import table

if TYPE_CHECKING:
    from whitefurnace.rendering.shading import Rendered
    from whitefurnace.rendering.side_by_side import Rendered as SideBySide

TRUTH_ALONE = ("tolerance", "certify", "multiscatter", "ndf", "dielectric", "metal", "diffuse", "light", "device")
"""Options that are refused without --truth, in the order in which they are looked for."""

EPILOG = """\b
Examples:
  whitefurnace bake demo -o baked --for filament,three --size 64
  whitefurnace render baked/demo.json --for filament -o grid.png
  whitefurnace render baked/demo.json --for three -o gold.png --base-color 1 .78 .34 --rows 1 --exposure -1
  whitefurnace render baked/demo.json --for filament -o beside.png --truth demo --multiscatter
  whitefurnace render baked/demo.json --for filament -o layers.exr --truth demo --light punctual:NoL=.5,color=2
  whitefurnace render baked/demo.json --for filament -o helmet.png --scene helmet.glb

MANIFEST is the STEM.json of a bake. Roughness goes from 0 to 1 across, metalness from 0 to 1 down (one row: 1). The
spheres are seen in parallel along -z with +y up; behind them is level 0, as a camera of 60 degrees sees it. The picture
is in sRGB: radiance times 2^exposure, clipped at 1, without a tone curve.

With --truth, the image that the bake was made from, the picture has three panels: what the engine shows, the full
reflectance integral of the same pixels, and their difference over the truth. An .exr holds them as layers of float32,
in linear radiance. A light's place and directions are in the frame of the viewer (+z to the viewer, +x right), in radii
of a sphere about its middle; lights are added to both pictures alike.

With --scene the picture has a sphere for each of a glTF's materials (at most 64), in the order of the file, --columns
to a row. A sphere has the mean values of the texture parts that are in use. Notices list what it leaves out.

Exit codes: 0 done, 1 usage, 2 cannot read or write, 3 invalid input, 4 device or build, 5 not supported (an engine that
is given no prefiltered chain), 130 interrupted.
"""

OUTPUT, SPHERES, TRUTH = "Output", "Spheres", "Comparison with the truth"


@options.command("Look and compare", "Draw spheres from baked files as an engine shades them", EPILOG)
@click.argument("manifest", type=options.FilePath)
@options.output_file("Picture to write: .png, or with --truth also .exr with a layer for each picture.")
@options.option(
    "--for",
    "for_",
    metavar="ENGINE",
    required=True,
    heading=OUTPUT,
    help="Engine whose files are read and whose shading is followed: one that the bake was made for.",
)
@options.option(
    "--size",
    metavar="N",
    type=int,
    default=128,
    show_default=True,
    heading=OUTPUT,
    help="Edge of the square that holds one sphere in pixels, 8 to 2048.",
)
@options.option(
    "--background",
    metavar="environment|plain",
    default="environment",
    show_default=True,
    heading=OUTPUT,
    help="Draw the environment or a plain colour behind the spheres.",
)
@options.exposure(OUTPUT, "the radiance of the picture")
@options.option(
    "--columns",
    metavar="N",
    type=int,
    default=7,
    show_default=True,
    heading=SPHERES,
    help="Spheres from left to right, 1 to 64, with roughness from 0 to 1.",
)
@options.option(
    "--rows",
    metavar="N",
    type=int,
    heading=SPHERES,
    help="Spheres from top to bottom, 1 to 64, with metalness from 0 to 1. [default: 3]",
)
@options.option(
    "--base-color",
    metavar="R G B",
    type=float,
    nargs=3,
    heading=SPHERES,
    help="Base colour of the spheres, linear, each 0 to 1. [default: 1 1 1]",
)
@options.option(
    "--scene",
    metavar="FILE",
    type=options.FilePath,
    heading=SPHERES,
    help="Draw a sphere for each material of a .glb or .gltf in place of the grid. Needs pygltflib.",
)
@options.option(
    "--truth",
    metavar="ENV",
    heading=TRUTH,
    help="Draw the full reflectance integral and the difference next to the engine's picture. ENV is the "
    "image that was baked. A PNG needs matplotlib. The options below need --truth.",
)
@options.tolerance(
    "Largest relative error of the truth (99th percentile), 1e-4 to 0.5; it sets the number of samples. "
    "[default: 1e-2]",
    heading=TRUTH,
)
@options.option(
    "--certify",
    metavar="N",
    type=int,
    heading=TRUTH,
    help="Pixels of each column of the truth that are checked against a float64 quadrature, 0 to 1000. [default: 1]",
)
@options.option(
    "--multiscatter",
    is_flag=True,
    heading=TRUTH,
    help="Scale the truth so that it regains the energy of multiple scattering between facets.",
)
@options.ndf("[default: that of the bake]", heading=TRUTH)
@options.option(
    "--dielectric",
    metavar="NAME[:p=v,...]",
    heading=TRUTH,
    help=options.fresnel_help(" at metalness 0") + " [default: schlick:f0=.04]",
)
@options.option(
    "--metal",
    metavar="NAME[:p=v,...]",
    heading=TRUTH,
    help=options.fresnel_help(" at metalness 1") + " [default: Schlick's of the base colour]",
)
@options.option(
    "--diffuse",
    metavar="NAME[:p=v,...]",
    heading=TRUTH,
    help="Diffuse model, such as oren_nayar:sigma=.5; see `whitefurnace models`. [default: lambert]",
)
@options.light("Further light in addition to the environment (may be repeated)", multiple=True, heading=TRUTH)
@options.device(TRUTH)
@options.memory()
@options.force("Overwrite FILE if it exists.")
@options.as_json()
def render(
    manifest: Path,
    output: Path,
    for_: str,
    size: int,
    background: str,
    exposure: float,
    columns: int,
    rows: int | None,
    base_color: tuple[float, float, float] | None,
    scene: Path | None,
    truth: str | None,
    tolerance: float | None,
    certify: int | None,
    multiscatter: bool,
    ndf: str | None,
    dielectric: str | None,
    metal: str | None,
    diffuse: str | None,
    light: tuple[str, ...],
    device: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Draw a grid of spheres, or the materials of a scene, from the files that were baked for an engine, shaded as that
    engine does. With --truth, draw the full reflectance integral next to it."""
    if truth is None:
        _refuse_options_of_the_truth(click.get_current_context().params)
        from whitefurnace.rendering import shading

        made = shading.render(
            manifest,
            output,
            for_=for_,
            size=size,
            columns=columns,
            rows=rows,
            exposure=exposure,
            base_color=base_color,
            background=background,
            scene=scene,
            force=force,
        )
        row, text = rendered_row(made), rendered_text(made)
    else:
        from whitefurnace.rendering import side_by_side

        with progress(not as_json) as report:
            both = side_by_side.render(
                manifest,
                output,
                truth=truth,
                for_=for_,
                size=size,
                columns=columns,
                rows=rows,
                exposure=exposure,
                base_color=base_color,
                background=background,
                scene=scene,
                tolerance=tolerance,
                certify=1 if certify is None else certify,
                multiscatter=multiscatter,
                ndf=ndf,
                dielectric=dielectric,
                metal=metal,
                diffuse=diffuse,
                light=light,
                device=device,
                force=force,
                progress=of_one(report, output.name),
            )
        made, row, text = both, side_by_side_row(both), side_by_side_text(both)
    if as_json:
        print_row(row)
        return
    for notice in made.notices:
        say(f"notice: {made.engine}: {notice}")
    click.echo(text)


def _refuse_options_of_the_truth(given: Mapping[str, Any]) -> None:
    """Raise UsageError for an option that only --truth has. given: the values of all options by name."""
    for name in TRUTH_ALONE:
        # An option that is not given has one of these values; 0 is given, though it equals False.
        if not (given[name] is None or given[name] is False or given[name] == ()):
            raise UsageError(f"--{name} is of the truth: give the image of the bake as --truth ENV")


def rendered_row(made: Rendered) -> dict[str, Any]:
    """Return the JSON row of a picture of one engine."""
    row = {"event": "rendered", **vars(made), "path": str(made.path)}
    if not made.materials:
        del row["materials"]
    return row


def rendered_text(made: Rendered) -> str:
    """Return the text of a picture of one engine."""
    columns, rows = (" ".join(f"{x:.3g}" for x in values) for values in (made.roughness, made.metalness))
    of = [f"  across  roughness {columns}", f"  down    metalness {rows}"]
    if made.materials:
        of = [
            table(
                ["material", "row", "column", "base colour", "metalness", "roughness", "F0"],
                [
                    [
                        str(one["name"]),
                        *(_values(one[key]) for key in ("row", "column", "base_color", "metalness", "roughness", "f0")),
                    ]
                    for one in made.materials
                ],
            )
        ]
    return "\n".join(
        [
            f"{made.path}: {made.width} × {made.height} pixels, {made.engine}, exposure {made.exposure:g}",
            *of,
            *(f"  read    {path}" for path in made.read),
        ]
    )


def _values(value: Any) -> str:
    """A number, or RGB values; one number where all three are the same."""
    values = value if isinstance(value, tuple) else (value,)
    return " ".join(f"{x:.3g}" for x in (values[:1] if len(set(values)) == 1 else values))


def side_by_side_row(made: SideBySide) -> dict[str, Any]:
    """Return the JSON row of a picture that is compared with the truth."""
    return {
        **rendered_row(made),
        "certificate": [vars(held) for held in made.certificate],
        "error": made.error if made.certificate else None,
    }


def side_by_side_text(made: SideBySide) -> str:
    """Return the text of a picture that is compared with the truth."""
    seconds = ", ".join(f"{name} {value:.1f} s" for name, value in made.seconds.items())
    return "\n".join(
        [
            rendered_text(made),
            f"  truth   samples {' '.join(map(str, made.samples))} a pixel, within {max(made.estimates):.1e} of four "
            f"times as many; {seconds}",
            *(
                f"  error   roughness {held.roughness:.3g}, n·v {held.NoV:.2f}, {held.of}: {held.error:.1e} of "
                f"{' '.join(f'{x:.4g}' for x in held.exact)} by quadrature"
                for held in made.certificate
            ),
            f"  differs by {100 * made.median:.3g} % or less at half of the pixels, {100 * made.most:.3g} % at 95 of "
            f"100; the colours reach {100 * made.scale:g} %",
        ]
    )
