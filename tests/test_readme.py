"""The README is true: its commands run, its Python runs, its generated parts are what the program says."""
from __future__ import annotations

import contextlib
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scenes import helmet
from whitefurnace.cli import main
from whitefurnace.engines.presets import user_engine
from whitefurnace.files import write_exr
from whitefurnace.sphere.environments import LAYOUTS

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text("utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.M | re.S)


def commands() -> list[str]:
    lines = [line.split("#")[0].strip() for block in blocks("sh") for line in block.splitlines()]
    return [line for line in lines if line.startswith("whitefurnace ")]


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
    """Small images under the names that the README uses, all of them EXR whatever the name says, and its models."""
    where = tmp_path_factory.mktemp("readme")
    rng = np.random.default_rng(7)
    for name in ("studio.hdr", "day.exr", "night.exr", "forest_1k.exr"):
        write_exr(where / name, rng.random((16, 32, 3), np.float32))
    (where / "my_engine.toml").write_text(blocks("toml")[0])
    (where / "probes").mkdir()
    for k in range(2):
        write_exr(where / "probes" / f"p{k}.exr", rng.random((16, 32, 3), np.float32))
    (where / "probes.toml").write_text(next(block for block in blocks("toml") if "[[bake]]" in block))
    helmet(where / "helmet.glb")
    for block in blocks("c"):
        name = re.search(r"(?:ndf|brdf)_(\w+)_[Df]\(", block)
        assert name, block
        (where / f"{name[1]}.clh").write_text(block)
    return where


def test_there_are_commands_to_test():
    assert len(commands()) >= 5 and len(blocks("python")) == 1


@pytest.mark.parametrize("command", commands())
def test_a_command_of_the_readme_runs(command, folder):
    arguments = shlex.split(command)[1:]
    if arguments[0] == "render":  # of a small bake, its manifest DIR/NAME.json
        manifest, engine = Path(arguments[1]), arguments[arguments.index("--for") + 1]
        run("bake", manifest.stem, "-o", str(manifest.parent), "--for", engine, "--size", "32", cwd=folder)
    elif arguments[0] != "scene" and {"--size", "--tolerance"} & set(arguments):  # long bakes: planned only
        arguments.append("--dry-run")
    done = run(*arguments, cwd=folder)
    assert done.returncode == 0, done.stderr


def test_the_python_of_the_readme_runs(folder):
    done = subprocess.run([sys.executable, "-c", blocks("python")[0]], cwd=folder, capture_output=True, text=True)
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


def test_the_engine_of_the_readme_is_one(folder):
    (text,) = blocks("toml")[:1]
    (folder / "my_engine.toml").write_text(text)
    assert user_engine(folder / "my_engine.toml").file
    done = run("bake", "forest_1k.exr", "-o", "mine", "--for", "my_engine.toml", "--dry-run", cwd=folder)
    assert done.returncode == 0, done.stderr


def test_the_scene_of_the_readme_is_what_the_program_says(folder):
    said = run("scene", "helmet.glb", cwd=folder).stdout
    written = README.partition("<!-- scene:")[2].partition("```\n")[2].partition("```")[0]
    assert written.strip("\n") == said.strip("\n")


def test_the_table_of_layouts_names_every_layout():
    table = README.partition("| layout | aspect |")[2].partition("\n\n")[0]
    for layout in LAYOUTS:
        assert f"| {layout.name} | {layout.columns}:{layout.rows} |" in table, layout.name


def test_the_options_of_the_readme_exist():
    told = "".join(run(command, "--help").stdout for command in ("bake", "lut", "verify", "bench", "models", "devices",
                                                                   "inspect", "compare", "render", "engines", "batch",
                                                                   "scene"))
    for option in set(re.findall(r"`(--[a-z-]+)", README)):
        assert option in told, option


def test_the_targets_of_the_readme_exist():
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
    for line in blocks("diff")[0].splitlines():
        if line.startswith("+++ b/"):
            lines = added.setdefault(line[6:], [])
        elif line.startswith("+"):
            lines.append(line[1:])
    assert len(added) == 2
    for path, text in added.items():
        assert (ROOT / path).read_text("utf-8").splitlines() == text, path
