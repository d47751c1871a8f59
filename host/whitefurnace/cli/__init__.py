"""The command line: the group of commands, and `main`, which turns every error into one sentence and an exit code.

Each module of this package that defines a command of its own name is a command: a new command is a new file. Commands
import numpy, OpenCL and image libraries when they run, so that `--help` is quick.
"""

from __future__ import annotations

import importlib
import io
import pkgutil
import sys

import click

from whitefurnace.cli.ending import Ended, close_streams, leave, listening, open_streams, tell
from whitefurnace.cli.options import Group, debug
from whitefurnace.cli.terminal import say


@click.group(
    cls=Group,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="`whitefurnace COMMAND --help` shows the options, examples and exit codes of a command. Each may also end "
    "with 70, a fault of whitefurnace and a report to send; 129, 130 or 143, ended by SIGHUP, Ctrl-C or SIGTERM after "
    "cleaning up; or 141, nobody reads its output.",
)
@click.version_option(package_name="whitefurnace")
@debug()
@click.pass_context
def cli(context: click.Context) -> None:
    """Bake image-based lighting and integrate BRDFs on OpenCL devices, with a stated error for every result."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


def _add_commands() -> None:
    """Add the command of every module that has one, under the name of the module."""
    for module in pkgutil.iter_modules(__path__):
        command = getattr(importlib.import_module(f"{__name__}.{module.name}"), module.name, None)
        if isinstance(command, click.Command):
            cli.add_command(command, module.name)


_add_commands()


def main(argv: list[str] | None = None) -> None:
    """Run a command line and exit: every error becomes one sentence on stderr and its exit code."""
    open_streams()
    given = sys.argv[1:] if argv is None else argv
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without ² or × shows a ?, not a traceback
    try:
        with listening():
            result = cli.main(argv, prog_name="whitefurnace", standalone_mode=False)
            sys.stdout.flush()
        code = result if isinstance(result, int) else 0
    except click.exceptions.Exit as done:
        code = done.exit_code
    except (click.Abort, KeyboardInterrupt):
        say("interrupted: nothing half-written was left")
        leave(130)
    except Ended as ended:
        say(f"ended by {ended.name}: nothing half-written was left")
        leave(ended.exit_code)
    except Exception as error:
        code = tell(error, given)
    close_streams()
    sys.exit(code)
