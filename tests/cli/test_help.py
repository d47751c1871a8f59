"""The help of the command line: complete, grouped, never cut, and in agreement with the ranges that the code checks."""

from __future__ import annotations

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from whitefurnace import cli as package
from whitefurnace.advice.budget import TOLERANCE_RANGE as BUDGET_TOLERANCES
from whitefurnace.batch.pool import MOST_WORKERS
from whitefurnace.cli import cli, options
from whitefurnace.engines.presets import REDUCIBLE
from whitefurnace.files.tables import STORED
from whitefurnace.prefiltering import recipe
from whitefurnace.rendering.shading import EXPOSURES
from whitefurnace.rendering.shading import SIZE_RANGE as CELLS
from whitefurnace.rendering.side_by_side import TOLERANCE_RANGE as TRUTH_TOLERANCES
from whitefurnace.scenes.material_spheres import COUNT_RANGE
from whitefurnace.scenes.media import ROWS
from whitefurnace.sphere.harmonics import CUTOFFS
from whitefurnace.tables.kinds import kinds

COMMANDS = [
    "bake",
    "batch",
    "bench",
    "compare",
    "devices",
    "engines",
    "inspect",
    "lut",
    "models",
    "render",
    "scene",
    "verify",
]


def shown(*words: str, width: int = 110) -> str:
    done = CliRunner().invoke(cli, [*words, "--help"], terminal_width=width)
    assert done.exit_code == 0, done.output
    return done.output


def option(command: str, name: str) -> str:
    """The help of an option."""
    return next(p.help for p in cli.commands[command].params if isinstance(p, click.Option) and name in p.opts) or ""


def test_the_commands_are_the_modules():
    assert sorted(cli.commands) == COMMANDS
    for name, command in cli.commands.items():
        assert command is getattr(importlib.import_module(f"whitefurnace.cli.{name}"), name)


def test_a_new_command_is_one_file(tmp_path, monkeypatch):
    (tmp_path / "hello.py").write_text(
        "import click\nfrom whitefurnace.cli import options\n"
        "@options.command('Lists', 'Say hello', '')\n@options.as_json()\ndef hello(as_json):\n"
        "    '''Say hello.'''\n    click.echo('hello')\n"
    )
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    try:
        package._add_commands()
        assert CliRunner().invoke(cli, ["hello"]).output == "hello\n" and "Say hello" in shown()
    finally:
        cli.commands.pop("hello", None)
        sys.modules.pop("whitefurnace.cli.hello", None)


@pytest.mark.parametrize("width", [80, 110])
def test_summaries_are_not_cut(width):
    text = shown(width=width)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "..." not in text.split("Bake and tabulate:")[1]
    for name, command in cli.commands.items():
        assert command.short_help and len(command.short_help) <= 65
        assert f"{name} {command.short_help}" in lines
    for task in options.TASKS:
        assert f"{task}:" in lines
    assert [command.task for command in cli.commands.values() if command.task not in options.TASKS] == []


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_explained_in_a_full_phrase(name):
    command = cli.commands[name]
    assert command.help
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            text = parameter.help or ""
            assert text[:1].isupper() or text[:3] == "NaN", (name, parameter.name, text)
            assert text.endswith((".", "]")), (name, parameter.name, text)
            assert len(text) > 15, (name, parameter.name, text)


def test_an_option_that_commands_share_has_one_help():
    for name in ("--device", "--json", "--rotate", "--bad-pixels"):
        having = [c for c in COMMANDS if any(name in p.opts for p in cli.commands[c].params)]
        assert len(having) > 1 and len({option(c, name) for c in having}) == 1, name


def test_options_stand_under_headings():
    headings = [line.strip() for line in shown("bake").splitlines() if line.endswith(":") and line[0] != " "]
    assert headings == ["Output:", "Accuracy:", "Environment:", "Sun and harmonics:", "Running:"]
    assert "\nOptions:\n" in shown("inspect")


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_name_their_parameters(name):
    signature = inspect.signature(cli.commands[name].callback)
    assert not [p for p in signature.parameters.values() if p.kind is inspect.Parameter.VAR_KEYWORD]
    assert set(signature.parameters) == {p.name for p in cli.commands[name].params if p.expose_value}


@pytest.mark.parametrize(
    "command, name, values",
    [
        ("bake", "--size", recipe.SIZE_RANGE),
        ("bake", "--tolerance", recipe.TOLERANCE_RANGE),
        (
            "bake",
            "--quality",
            [f"{name} ({value:.0e})".replace("e-0", "e-") for name, value in recipe.QUALITIES.items()],
        ),
        ("bake", "--samples", recipe.SAMPLES_RANGE),
        ("bake", "--certify", recipe.CERTIFY_RANGE),
        ("bake", "--fit", recipe.FITS),
        ("bake", "--without", REDUCIBLE),
        ("bake", "--sh", CUTOFFS),
        ("render", "--size", CELLS),
        ("render", "--exposure", (-EXPOSURES, EXPOSURES)),
        ("render", "--rows", COUNT_RANGE),
        ("render", "--columns", COUNT_RANGE),
        ("render", "--tolerance", TRUTH_TOLERANCES),
        ("scene", "--resolution", (1, ROWS)),
        ("scene", "--tolerance", BUDGET_TOLERANCES),
        ("batch", "--workers", (1, MOST_WORKERS)),
        ("lut", "--format", [*STORED[".ktx2"], *STORED[".dds"], *STORED[".png"]]),
    ],
)
def test_help_has_the_ranges_and_names_of_the_code(command, name, values):
    text = option(command, name)
    numbers = {float(number) for number in re.findall(r"-?\b\d[\d.e+-]*\b|-\d+", text)}
    for value in values:
        assert value in text if isinstance(value, str) else value in numbers, (value, text)


def test_help_of_every_command_is_quick_to_import():
    script = (
        "import sys\nfrom whitefurnace.cli import main\n"
        f"for words in ([], *([name] for name in {COMMANDS})):\n"
        "    try: main([*words, '--help'])\n    except SystemExit as done: assert not done.code\n"
        "heavy = {'numpy', 'scipy', 'pyopencl', 'OpenImageIO', 'rich', 'msgspec', 'matplotlib'} & "
        "set(sys.modules)\nsys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_no_function_is_long():
    import ast

    for path in Path(package.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < 80, f"{path.name}: {node.name}"


def test_help_of_lut_lists_every_kind_and_scheme():
    text, schemes = shown("lut"), option("lut", "--scheme")
    for name, kind in kinds().items():
        assert re.search(rf"^ +{name} +{re.escape(kind.summary)}$", text, re.M), name
        assert all(scheme in schemes for scheme in kind.schemes)
