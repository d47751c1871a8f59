"""The documents as programs see them: their command lines, their blocks, and small inputs under the names they use.

`python tests/documents.py` writes the generated blocks of the documents anew. Needs neither pytest nor any extra but
for that: the plain install is tried with it.
"""

from __future__ import annotations

import ast
import contextlib
import io
import re
import shlex
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from whitefurnace.files import write_exr

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ("studio.hdr", "day.exr", "night.exr", "forest_1k.exr")
LARGEST = 64
"""Texels a face edge: sizes of the documents above it are brought down, so that a line costs a second."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page, in its language."""

    page: str
    language: str
    text: str


@dataclass(frozen=True)
class Line:
    """A command line of a page, as printed without its comment, and the exit codes it may have."""

    page: str
    text: str
    exit_codes: tuple[int, ...] = (0,)


def pages() -> list[Path]:
    """README.md and every page of docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(language: str) -> list[Block]:
    """The fenced blocks of a language, page by page."""
    return [
        Block(page.relative_to(ROOT).as_posix(), language, text)
        for page in pages()
        for text in re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)
    ]


def python_blocks() -> list[Block]:
    return blocks("python")


def commands() -> list[Line]:
    """Every command line of whitefurnace in a `sh` block, in order; the same line on two pages counts once."""
    found = {}
    for block in blocks("sh"):
        for line in block.text.splitlines():
            text = line.split("#")[0].strip().removeprefix(".venv/bin/")
            if text.startswith("whitefurnace "):
                found.setdefault(text, Line(block.page, text))
    return list(found.values())


def prepare(folder: Path) -> None:
    """Write small images, models, an engine, a job and a scene under the names that the documents use."""
    import scenes

    rng = np.random.default_rng(7)
    for name in IMAGES:  # all of them EXR, whatever the name says
        write_exr(folder / name, rng.random((16, 32, 3), np.float32))
    (folder / "probes").mkdir()
    for k in range(2):
        write_exr(folder / "probes" / f"p{k}.exr", rng.random((16, 32, 3), np.float32))
    for block in blocks("toml"):
        (folder / ("probes.toml" if "[[bake]]" in block.text else "my_engine.toml")).write_text(block.text, "utf-8")
    for block in blocks("c"):
        name = re.search(r"(?:ndf|brdf)_(\w+)_[Df]\(", block.text)
        assert name, block
        (folder / f"{name[1]}.clh").write_text(block.text, "utf-8")
    scenes.helmet(folder / "helmet.glb")


def shortened(line: Line) -> list[str]:
    """The arguments after `whitefurnace`, with the sizes of a bake brought down to LARGEST."""
    arguments = shlex.split(line.text)[1:]
    if arguments[0] != "bake":
        return arguments
    if "--size" not in arguments:
        return [*arguments, "--size", str(LARGEST)]
    at = arguments.index("--size") + 1
    return [*arguments[:at], str(min(int(arguments[at]), LARGEST)), *arguments[at + 1 :]]


def needed(line: Line) -> list[str] | None:
    """The bake whose files a `render` line reads, None for other lines."""
    arguments = shlex.split(line.text)[1:]
    if arguments[0] != "render":
        return None
    manifest, engine = Path(arguments[1]), arguments[arguments.index("--for") + 1]
    return ["bake", manifest.stem, "-o", str(manifest.parent), "--for", engine, "--size", "32", "--quiet"]


BLOCK = r"(^<!-- {name}: [^\n]*-->\n```\w*\n)(.*?)(^```)"
"""A fenced block under the comment that names what it is made of."""


def marked(page: str, name: str) -> str:
    """The text of the block of a page under `<!-- NAME: … -->`. Raises LookupError where there is none."""
    found = re.search(BLOCK.format(name=re.escape(name)), (ROOT / page).read_text("utf-8"), re.M | re.S)
    if not found:
        raise LookupError(f"{page} has no block marked {name}")
    return found[2].strip("\n")


def printed(*arguments: str) -> str:
    """What a command line prints on stdout, run in this process."""
    from whitefurnace.cli import main

    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main(list(arguments))
    return out.getvalue().strip("\n")


MODEL = ("kernels/ndf/charlie.clh", "host/whitefurnace/catalogue/ndf/charlie.py")
PRESET = "host/whitefurnace/engines/presets/bevy.py"


def generated(folder: Path) -> Iterator[tuple[str, str, str]]:
    """(page, name of the block, what it must hold) of every block that is made by a program or copied from a file.

    folder: one that `prepare` has filled.
    """
    from whitefurnace.engines.presets import ENGINES

    yield "docs/models.md", "models", printed("models")
    for page in ("README.md", "docs/engines/README.md"):
        yield page, "engines", printed("engines")
    for name in ENGINES:
        yield f"docs/engines/{name}.md", f"engine {name}", printed("engines", name)
    with contextlib.chdir(folder):
        yield "docs/scene.md", "scene", printed("scene", "helmet.glb")
    added = ""
    for path in MODEL:
        lines = (ROOT / path).read_text("utf-8").splitlines()
        added += f"--- /dev/null\n+++ b/{path}\n" + "".join(f"+{line}\n" for line in lines)
    yield "docs/add-a-model.md", "diff", added.strip("\n")
    yield "docs/add-an-engine.md", "preset", (ROOT / PRESET).read_text("utf-8").strip("\n")
    tree = ast.parse((ROOT / "tests/tables/test_kinds.py").read_text("utf-8"))
    (kind,) = (
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "NEW_KIND"
    )
    yield "docs/add-a-table.md", "kind", kind.strip("\n")


def write(page: str, name: str, text: str) -> None:
    """Replace the text of the block of a page under `<!-- NAME: … -->`."""
    block = re.compile(BLOCK.format(name=re.escape(name)), re.M | re.S)
    whole = (ROOT / page).read_text("utf-8")
    (ROOT / page).write_text(block.sub(lambda found: f"{found[1]}{text}\n{found[3]}", whole, count=1), "utf-8")


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        prepare(Path(name))
        for page, block, wanted in generated(Path(name)):
            if marked(page, block) != wanted:
                write(page, block, wanted)
                print(f"{page}: {block}")


if __name__ == "__main__":
    main()
