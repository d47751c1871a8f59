"""The documents are true: their commands and their Python run, their generated parts are what the program says."""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import documents
import whitefurnace
from whitefurnace.cli import cli, main
from whitefurnace.engines.presets import ENGINES, user_engine
from whitefurnace.files import write_exr
from whitefurnace.sphere.environments import LAYOUTS

ROOT = Path(__file__).resolve().parents[1]
PAGES = {page.relative_to(ROOT).as_posix(): page.read_text("utf-8") for page in documents.pages()}
README = PAGES["README.md"]
COMMANDS = sorted(cli.list_commands(None))  # type: ignore[arg-type]


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
    assert len(documents.commands()) >= 50 and len(documents.python_blocks()) >= 3


LONG = (
    "whitefurnace bake forest_1k.exr -o mine",
    "whitefurnace bake studio.hdr -o baked --as-read",
    "whitefurnace bake studio.hdr -o baked --fit read",
    "whitefurnace bake studio.hdr -o baked --ndf",
    "whitefurnace bake studio.hdr -o baked --tolerance 1e-4 --certify",
    "whitefurnace batch probes.toml --shard",
    "whitefurnace bench ",
    "whitefurnace lut energy -o turquin",
    "whitefurnace lut ltc_1",
    "whitefurnace render baked/demo.json --for filament",
    "whitefurnace scene helmet.glb --for filament --environment",
    "whitefurnace verify hat.clh",
    "whitefurnace verify smith",
)
"""Lines that compute for more than some seconds, however small their input."""


def is_long(line: documents.Line) -> bool:
    """Whether a line belongs to the long tests; of the pages of engines three are enough for the fast ones."""
    of_an_engine = re.fullmatch(r"docs/engines/(?!README|filament|gltf|unreal)\w+\.md", line.page)
    return line.text.startswith(LONG) or of_an_engine is not None


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, id=line.text, marks=pytest.mark.long if is_long(line) else ())
        for line in documents.commands()
    ],
)
def test_a_command_of_the_documents_runs(line, folder):
    if before := documents.needed(line):
        assert run(*before, cwd=folder).returncode == 0
    done = run(*documents.shortened(line), cwd=folder)
    assert done.returncode in line.exit_codes, done.stderr


@pytest.mark.whole
@pytest.mark.parametrize("block", documents.python_blocks(), ids=lambda block: block.page)
def test_the_python_of_the_documents_runs(block, folder):
    done = subprocess.run([sys.executable, "-c", block.text], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    # GGX's albedo at α = .25 lies between .9 and 1 at these angles; the rule is named
    assert ("gauss-" in done.stdout) == ("print(" in block.text)


def test_generated_blocks_are_what_programs_and_files_say(folder):
    """`python tests/documents.py` writes those anew that this finds to differ."""
    for page, name, wanted in documents.generated(folder):
        assert documents.marked(page, name) == wanted, (page, name)


@pytest.mark.whole
@pytest.mark.parametrize("name", sorted(ENGINES))
def test_every_engine_has_its_page(name):
    assert f"whitefurnace bake studio.hdr -o baked --for {name} " in PAGES[f"docs/engines/{name}.md"]
    assert f"]({name}.md)" in PAGES["docs/engines/README.md"]


def test_the_engine_of_the_documents_is_one(folder):
    assert user_engine(folder / "my_engine.toml").file
    done = run("bake", "forest_1k.exr", "-o", "mine", "--for", "my_engine.toml", "--size", "32", cwd=folder)
    assert done.returncode == 0, done.stderr


def test_the_table_of_layouts_names_every_layout():
    table = PAGES["docs/bake.md"].partition("| layout | aspect |")[2].partition("\n\n")[0]
    for layout in LAYOUTS:
        assert f"| {layout.name} | {layout.columns}:{layout.rows} |" in table, layout.name


def test_the_options_of_the_documents_exist():
    told = "".join(run(command, "--help").stdout for command in COMMANDS)
    for page, text in PAGES.items():
        options = set(re.findall(r"`(--[a-z-]+)", text))
        if page == "docs/migrating-from-cmgen.md":  # the first column of its table has cmgen's options
            options -= set(re.findall(r"`(--[a-z-]+)", " ".join(re.findall(r"^\| [^|]*\|", text, re.M))))
        if page == "docs/bench.md":  # of benchmarks/bench.py
            options -= {"--docs"}
        for option in options:
            assert option in told, (page, option)


def test_the_targets_of_the_documents_exist():
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for page, text in PAGES.items():
        for target in set(re.findall(r"(?:`|^)make ([a-z-]+)", text, re.M)):
            assert re.search(rf"^{target}:|^test.*\b{target}\b.*:", makefile, re.M), (page, target)


def anchors(text: str) -> set[str]:
    """The anchors that a page's headings get, as forges make them."""
    outside = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    heads = re.findall(r"^#+ (.*)$", outside, re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.whole
@pytest.mark.parametrize("page", sorted(PAGES))
def test_links_lead_somewhere(page):
    outside = re.sub(r"^```.*?^```", "", PAGES[page], flags=re.M | re.S)
    for link in re.findall(r"\]\(([^)\s]+)\)", outside):
        assert not re.match(r"[a-z]+:|/", link), f"{link} is not relative"
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target.read_text("utf-8")), link


@pytest.mark.whole
@pytest.mark.parametrize("page", sorted(PAGES))
def test_paths_in_the_documents_exist(page):
    for path in re.findall(r"`((?:host|kernels|tests|benchmarks|docs)/[\w./-]+)`", PAGES[page]):
        assert (ROOT / path).exists() or path.isupper() or re.search(r"[A-Z]{4}", path), path


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 200


def test_every_command_has_a_page_one_step_from_the_readme():
    for command in COMMANDS:
        row = re.search(rf"^\| `{command}` \|.*\]\((docs/[\w/-]+\.md)", README, re.M)
        assert row, command
        assert f"whitefurnace {command}" in PAGES[row[1]], (command, row[1])


def test_every_page_is_in_the_index():
    linked = set(re.findall(r"\]\(([\w/-]+\.md)\)", PAGES["docs/README.md"]))
    pages = {page.removeprefix("docs/") for page in PAGES if page.startswith("docs/")} - {"README.md"}
    assert {page for page in pages if not page.startswith("engines/")} | {"engines/README.md"} == linked


def test_every_page_begins_with_a_command():
    for page, text in PAGES.items():
        if page.startswith("docs/") and page != "docs/README.md":
            assert re.search(r"^(whitefurnace|make|import whitefurnace) ?", text[:2000], re.M), page


def test_help_is_quick_to_import():
    # numpy, OpenCL and the image library cost .1 to .3 s each: help needs none of them.
    script = (
        "import sys\nfrom whitefurnace.cli import main\n"
        "try: main(['bake', '--help'])\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'pyopencl', 'OpenImageIO', 'rich'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_cubes_are_turned_as_the_page_for_users_of_cmgen_says(tmp_path):
    """The image's centre lies at +X, at +Z when turned by 90°, and what is right of it at +Z, then −X. cmgen reads
    u = (atan2(x, z)/π + 1)/2 of the direction mirrored in x: at +Z u = ½, at −X ¾."""
    image = np.full((64, 128, 3), 0.01, np.float32)
    image[30:34, 62:66, 0] = 100
    image[30:34, 94:98, 1] = 100
    write_exr(tmp_path / "marks.exr", image)
    for angle, wanted in ((0, (0, 4)), (90, (4, 1))):
        environment = whitefurnace.environment(tmp_path / "marks.exr", rotate=angle)
        level = whitefurnace.prefilter(environment, size=16, min_size=16, certify=0).values[0]
        assert tuple(np.argmax(level[..., :2].mean((1, 2)), 0)) == wanted
