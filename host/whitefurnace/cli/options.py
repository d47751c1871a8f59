"""Commands and options in groups. Help lists the commands by task, and the options of a command by subject.

An option that several commands have is declared once here, as a decorator. This module loads nothing heavy, so that
`--help` is quick.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import click

Task = Literal["Bake and tabulate", "Look and compare", "Prove and measure", "Scenes and batches", "Lists"]

TASKS: tuple[Task, ...] = ("Bake and tabulate", "Scenes and batches", "Look and compare", "Prove and measure", "Lists")
"""The headings of `whitefurnace --help` in their order."""

RUNNING = "Running"
"""The heading of options that change how a command runs and reports, and not its results."""

FilePath = click.Path(path_type=Path)

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class Option(click.Option):
    """An option with the heading that it stands under in the help of its command."""

    def __init__(self, names: Sequence[str], *, heading: str = RUNNING, **attributes: Any) -> None:
        super().__init__(names, **attributes)
        self.heading = heading


class Command(click.Command):
    """A command with its task, whose help lists the options under their headings."""

    def __init__(self, name: str | None, *, task: Task, **attributes: Any) -> None:
        super().__init__(name, **attributes)
        self.task = task
        debug()(self)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write a definition list for each heading, in the order in which the options are declared."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx) if isinstance(parameter, click.Option) else None
            if record is not None:
                groups.setdefault(getattr(parameter, "heading", RUNNING), []).append(record)
        if list(groups) == [RUNNING]:
            groups = {"Options": groups[RUNNING]}
        for heading, records in groups.items():
            with formatter.section(heading):
                formatter.write_dl(records)


class NoReader(Exception):
    """The reader of stdout went away."""


class Group(click.Group):
    """A group whose help lists the commands by task. A broken pipe is `NoReader`: click would exit with code 1."""

    def make_context(self, *given: Any, **options: Any) -> click.Context:
        """Parse the command line, which may print help or a version."""
        try:
            return super().make_context(*given, **options)
        except BrokenPipeError as error:
            raise NoReader from error

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            raise NoReader from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write a definition list for each task of `TASKS`: the name of every command and its summary."""
        known = [
            (name, command)
            for name in self.list_commands(ctx)
            if isinstance(command := self.get_command(ctx, name), Command)
        ]
        width = max(len(name) for name, _ in known)
        for task in TASKS:
            rows = [(name.ljust(width), command.short_help or "") for name, command in known if command.task == task]
            if rows:
                with formatter.section(task):
                    formatter.write_dl(rows)


def command(task: Task, summary: str, epilog: str, help: str | None = None) -> Callable[[Callable[..., Any]], Command]:
    """Return a decorator that makes a function the command of its own name.

    task: the heading in `whitefurnace --help`. summary: one line after the name there, at most 62 characters. epilog:
    examples and exit codes, after the options. help: what the command does, by default the function's docstring.
    """
    return click.command(cls=Command, task=task, short_help=summary, epilog=epilog, help=help)


def option(*names: str, heading: str, help: str, **attributes: Any) -> Decorator:
    """Return a decorator that adds an option to one command.

    names: the option's names. heading: the heading in the command's help. attributes: those of `click.option`.
    """
    return click.option(*names, cls=Option, heading=heading, help=help, **attributes)


# ---------------------------------------------------------------------------------------------- shared options


def output_folder(help: str, *, required: bool = False, heading: str = "Output") -> Decorator:
    """Return the option `-o DIR`."""
    return option("-o", "--output", metavar="DIR", required=required, type=FilePath, heading=heading, help=help)


def output_file(help: str) -> Decorator:
    """Return the option `-o FILE`."""
    return option("-o", "--output", metavar="FILE", required=True, type=FilePath, heading="Output", help=help)


def ndf(help: str, *, default: str | None = None, heading: str) -> Decorator:
    """Return the option `--ndf`; `help` ends its text."""
    return option(
        "--ndf",
        metavar="NAME[:p=v,...]",
        default=default,
        show_default=default is not None,
        heading=heading,
        help="Microfacet distribution with its parameters: a name from `whitefurnace "
        f"models`, or a FILE.clh of your own. {help}".strip(),
    )


def fresnel_help(help: str) -> str:
    """Return the help of an option that takes a Fresnel model; `help` follows its first two words."""
    return f"Fresnel model{help}, as NAME[:p=v,...] or NAME:PRESET (schlick:gold); see `whitefurnace models`."


def light(help: str, *, multiple: bool = False, heading: str) -> Decorator:
    """Return the option `--light`; `help` begins its text. multiple: it may be repeated."""
    return option(
        "--light",
        metavar="NAME[:p=v,...]",
        multiple=multiple,
        heading=heading,
        help=f"{help}, a name from `whitefurnace models` with its parameters, such as punctual:NoL=.5.",
    )


def tolerance(help: str, *, heading: str = "Accuracy") -> Decorator:
    """Return the option `--tolerance`."""
    return option("--tolerance", metavar="X", type=float, heading=heading, help=help)


def rotate(heading: str) -> Decorator:
    """Return the option `--rotate`, in degrees."""
    return option(
        "--rotate",
        metavar="DEG",
        type=float,
        default=0.0,
        heading=heading,
        help="Rotate the environment by DEG degrees about +Y, from +X towards +Z. [default: 0]",
    )


def exposure(heading: str, what: str = "the radiance of the environment") -> Decorator:
    """Return the option `--exposure`, in stops; `what` names what it multiplies."""
    return option(
        "--exposure",
        metavar="EV",
        type=float,
        default=0.0,
        heading=heading,
        help=f"Multiply {what} by 2^EV; EV is -64 to 64. [default: 0]",
    )


def bad_pixels(heading: str) -> Decorator:
    """Return the options `--bad-pixels` and `--nonfinite`, its older name, which the help does not list."""

    def both(function: Callable[..., Any]) -> Callable[..., Any]:
        named = option(
            "--bad-pixels",
            metavar="refuse|zero|clamp",
            default="refuse",
            show_default=True,
            heading=heading,
            help="NaN, infinite and negative values in the environment: refuse the image, set them to zero, or clamp: "
            "+inf becomes the largest value of the file's pixel type, the others zero. Negative values of up to 2e-5 "
            "of the energy become zero in any case, with a notice. An older name is --nonfinite.",
        )
        return named(option("--nonfinite", hidden=True, heading=heading, help="Older name of --bad-pixels.")(function))

    return both


def layout(heading: str, what: str = "the environment") -> Decorator:
    """Return the option `--layout`."""
    return option(
        "--layout",
        metavar="NAME",
        heading=heading,
        help=f"Layout of {what}, in place of what its size or file says: latlong, cross, strip, row, column, faces "
        "(six files), openexr-cube, horizontal-cross, vertical-cross, horizontal-strip or vertical-strip.",
    )


def layer(heading: str, name: str = "--layer", what: str = "an OpenEXR file") -> Decorator:
    """Return the option `--layer`, or another name of it."""
    return option(
        name,
        metavar="NAME",
        heading=heading,
        help=f"Part or layer of {what}. [default: the first part with R, G and B]",
    )


def fill(heading: str) -> Decorator:
    """Return the option `--fill`."""
    return option(
        "--fill",
        metavar="black",
        heading=heading,
        help="Read an image whose data window is smaller than its display window, with black around it. By default "
        "it is refused.",
    )


def certify(help: str, *, default: int | None = None) -> Decorator:
    """Return the option `--certify`, a number of texels or pixels."""
    return option(
        "--certify",
        metavar="N",
        type=int,
        default=default,
        show_default=default is not None,
        heading="Accuracy",
        help=help,
    )


def as_read(help: str) -> Decorator:
    """Return the flag `--as-read`."""
    return option("--as-read", is_flag=True, heading="Accuracy", help=help)


def plot(what: str) -> Decorator:
    """Return the option `--plot DIR`; `what` names what is drawn."""
    return option(
        "--plot",
        "folder",
        metavar="DIR",
        type=FilePath,
        heading="Output",
        help=f"Draw {what} as PNG files into the folder DIR. Needs matplotlib.",
    )


def device(heading: str = RUNNING) -> Decorator:
    """Return the option `--device`."""
    return option(
        "--device",
        metavar="NAME",
        heading=heading,
        help="OpenCL device: its number or a part of its name as `whitefurnace devices` lists them. "
        "[default: $WHITEFURNACE_DEVICE, else the best that works]",
    )


def memory(heading: str = RUNNING) -> Decorator:
    """Return the option `--memory`."""
    return option(
        "--memory",
        metavar="SIZE",
        expose_value=False,
        callback=_set_memory,
        heading=heading,
        help="Memory that reading one file may take, as 4GB or 25%. [default: $WHITEFURNACE_MEMORY, else 256 MiB and "
        "1024 bytes for each byte of the file, but at most half of the machine's memory]",
    )


def _set_memory(context: click.Context, parameter: click.Parameter, value: str | None) -> None:
    """Set `WHITEFURNACE_MEMORY` while the command runs, so that processes which it starts have the same limit."""
    if value is None:
        return
    from whitefurnace.files.memory import VARIABLE, amount  # loads numpy

    amount(value, "--memory")
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = value
    context.call_on_close(lambda: os.environ.pop(VARIABLE) if before is None else os.environ.update({VARIABLE: before}))


def dry_run(help: str = "Print what would be computed and written, and do nothing.") -> Decorator:
    """Return the flag `--dry-run`."""
    return option("--dry-run", is_flag=True, heading=RUNNING, help=help)


def force(
    help: str = "Make outputs again that are up to date, and overwrite files that this tool did not write.",
) -> Decorator:
    """Return the flag `--force`."""
    return option("--force", is_flag=True, heading=RUNNING, help=help)


def as_json() -> Decorator:
    """Return the flag `--json`."""
    return option(
        "--json",
        "as_json",
        is_flag=True,
        heading=RUNNING,
        help="Print the results as JSON Lines on stdout, and nothing else there.",
    )


def debug() -> Decorator:
    """An option of every command. It has no value: what ends a command looks for it in the command line."""
    return option(
        "--debug",
        heading=RUNNING,
        is_flag=True,
        expose_value=False,
        help="Print the traceback of an error before its sentence.",
    )


def quiet(help: str = "Print errors only.") -> Decorator:
    """Return the flag `--quiet`."""
    return option("--quiet", is_flag=True, heading=RUNNING, help=help)
