"""The documents as programs see them: their command lines, their blocks, and small inputs under the names they use.

Needs neither pytest nor any extra: the plain install is tried with it.
"""
from __future__ import annotations

import re
import shlex
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
    return [Block(page.relative_to(ROOT).as_posix(), language, text) for page in pages()
            for text in re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)]


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
    return [*arguments[:at], str(min(int(arguments[at]), LARGEST)), *arguments[at + 1:]]


def needed(line: Line) -> list[str] | None:
    """The bake whose files a `render` line reads, None for other lines."""
    arguments = shlex.split(line.text)[1:]
    if arguments[0] != "render":
        return None
    manifest, engine = Path(arguments[1]), arguments[arguments.index("--for") + 1]
    return ["bake", manifest.stem, "-o", str(manifest.parent), "--for", engine, "--size", "32", "--quiet"]
