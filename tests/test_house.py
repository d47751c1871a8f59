"""Rules of the house that no linter knows: the length of functions, and that run-time imports are declared."""

from __future__ import annotations

import ast
import configparser
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(path for folder in ("host", "benchmarks", "tests") for path in (ROOT / folder).rglob("*.py"))
LONGEST = 80
DERIVATIONS = {"_cube_from_latlong", "_regions"}
"""Of sphere/overlap.py: cutting a derivation in pieces would only scatter its argument."""

# Import names that differ from the names of their distributions.
DISTRIBUTIONS = {"astc_encoder": "astc-encoder-py", "ispc_texcomp": "ispc-texcomp"}


@pytest.mark.parametrize("folder", ["host", "benchmarks", "tests"])
def test_no_function_is_longer_than_a_page(folder):
    long = []
    for path in SOURCES:
        if path.relative_to(ROOT).parts[0] != folder:
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name not in DERIVATIONS:
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                if lines > LONGEST:
                    long.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.name} has {lines} lines")
    assert not long, "\n".join(long)


def test_every_run_time_import_is_declared():
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    texts = [parser.get("options", "install_requires")]
    texts += [text for name, text in parser.items("options.extras_require") if name not in ("test", "lint")]
    declared = {re.split(r"[><=;\s]", line.strip())[0].lower() for text in texts for line in text.splitlines()}
    missing = set()
    for path in (ROOT / "host").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
                if isinstance(node, ast.ImportFrom) and not node.level
                else []
            )
            for name in names:
                top = name.partition(".")[0]
                if (
                    top not in sys.stdlib_module_names
                    and top != "whitefurnace"
                    and DISTRIBUTIONS.get(top, top).lower() not in declared
                ):
                    missing.add(f"{top} ({path.relative_to(ROOT)})")
    assert not missing, f"imported at run time and not declared in setup.cfg: {sorted(missing)}"
