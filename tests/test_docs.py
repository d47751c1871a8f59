"""The README is true: its commands run, its Python runs, its generated parts are what the program says."""
from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
from pathlib import Path

import pytest

import documents
from whitefurnace.cli import main
from whitefurnace.engines.presets import user_engine
from whitefurnace.sphere.environments import LAYOUTS

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text("utf-8")


def run(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A command line in this process: a process of its own would start for a second."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.chdir(cwd or Path.cwd()), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(list(arguments))
        except SystemExit as done:
            return subprocess.CompletedProcess(arguments, done.code, out.getvalue(), err.getvalue())
    return subprocess.CompletedProcess(arguments, 0, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    where = tmp_path_factory.mktemp("docs")
    documents.prepare(where)
    return where


def test_there_are_commands_to_test():
    assert len(documents.commands()) >= 5 and len(documents.python_blocks()) >= 1


LONG = ("whitefurnace bake studio.hdr -o baked --fit read --levels 7",
        "whitefurnace scene helmet.glb --for filament --environment", "whitefurnace verify smith",
        "whitefurnace bench tradeoff")
"""Lines that compute for more than some seconds, however small their input."""


@pytest.mark.parametrize("line", [pytest.param(line, id=line.text,
                                               marks=pytest.mark.long if line.text.startswith(LONG) else ())
                                  for line in documents.commands()])
def test_a_command_of_the_documents_runs(line, folder):
    if before := documents.needed(line):
        assert run(*before, cwd=folder).returncode == 0
    done = run(*documents.shortened(line), cwd=folder)
    assert done.returncode in line.exit_codes, done.stderr


@pytest.mark.parametrize("block", documents.python_blocks(), ids=lambda block: block.page)
def test_the_python_of_the_documents_runs(block, folder):
    done = subprocess.run([sys.executable, "-c", block.text], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    # GGX's albedo at α = .25 lies between .9 and 1 at these angles; the rule is named
    assert "gauss-" in done.stdout


def test_the_table_of_models_is_what_the_program_lists():
    listed = run("models")
    written = README.partition("<!-- models:")[2].partition("```\n")[2].partition("```")[0]
    assert written.strip("\n") == listed.stdout.strip("\n")


def test_the_table_of_engines_is_what_the_program_lists():
    written = README.partition("<!-- engines:")[2].partition("```\n")[2].partition("```")[0]
    assert written.strip("\n") == run("engines").stdout.strip("\n")


def test_the_engine_of_the_documents_is_one(folder):
    assert user_engine(folder / "my_engine.toml").file
    done = run("bake", "forest_1k.exr", "-o", "mine", "--for", "my_engine.toml", "--size", "32", cwd=folder)
    assert done.returncode == 0, done.stderr


def test_the_scene_of_the_documents_is_what_the_program_says(folder):
    said = run("scene", "helmet.glb", cwd=folder).stdout
    written = README.partition("<!-- scene:")[2].partition("```\n")[2].partition("```")[0]
    assert written.strip("\n") == said.strip("\n")


def test_the_table_of_layouts_names_every_layout():
    table = README.partition("| layout | aspect |")[2].partition("\n\n")[0]
    for layout in LAYOUTS:
        assert f"| {layout.name} | {layout.columns}:{layout.rows} |" in table, layout.name


def test_the_options_of_the_documents_exist():
    told = "".join(run(command, "--help").stdout for command in ("bake", "lut", "verify", "bench", "models", "devices",
                                                                   "inspect", "compare", "render", "engines", "batch",
                                                                   "scene"))
    for option in set(re.findall(r"`(--[a-z-]+)", README)):
        assert option in told, option


def test_the_targets_of_the_documents_exist():
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for target in set(re.findall(r"\bmake ([a-z-]+)", README)) - {"and"}:
        assert re.search(rf"^{target}:", makefile, re.M), target


def test_help_is_quick_to_import():
    # numpy, OpenCL and the image library cost .1 to .3 s each: help needs none of them.
    script = ("import sys\nfrom whitefurnace.cli import main\n"
              "try: main(['bake', '--help'])\nexcept SystemExit: pass\n"
              "heavy = {'numpy', 'pyopencl', 'OpenImageIO', 'rich'} & set(sys.modules)\n"
              "sys.exit(f'imported {heavy}' if heavy else 0)")
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_diff_of_a_model_is_its_files():
    added: dict[str, list[str]] = {}
    for line in documents.blocks("diff")[0].text.splitlines():
        if line.startswith("+++ b/"):
            lines = added.setdefault(line[6:], [])
        elif line.startswith("+"):
            lines.append(line[1:])
    assert len(added) == 2
    for path, text in added.items():
        assert (ROOT / path).read_text("utf-8").splitlines() == text, path
