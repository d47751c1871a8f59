"""The command line: the group of commands, and `main`, which turns every error into one sentence and an exit code.

Each module of this package that defines a command of its own name is a command: a new command is a new file. Commands
import numpy, OpenCL and image libraries when they run, so that `--help` is quick.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import pkgutil
import sys

import click

from whitefurnace.cli.options import Group
from whitefurnace.cli.terminal import print_row, say
from whitefurnace.errors import WhitefurnaceError


@click.group(
    cls=Group,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="`whitefurnace COMMAND --help` shows the options and examples of a command.",
)
@click.version_option(package_name="whitefurnace")
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


def _abandon_stdout() -> None:
    """Send what is still to be flushed to the null device, so that Python's own flush at exit does not fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def main(argv: list[str] | None = None) -> None:
    """Run a command line and exit: every error becomes one sentence on stderr and its exit code."""
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
                print_row({"event": "error", "message": str(error), "exit_code": error.exit_code})
        say(f"error: {error}")
        code = error.exit_code
    except click.exceptions.Exit as done:
        code = done.exit_code
    except click.ClickException as error:
        say(f"error: {error.format_message()}")
        code = 1
    except (click.Abort, KeyboardInterrupt):
        say("interrupted: nothing half-written was left")
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
        say(f"error: cannot write the results: {error.strerror or error}")
        code = 2
    except MemoryError:
        say("error: there is not enough memory for this; a smaller input or size is needed")
        code = 2
    sys.exit(code)
