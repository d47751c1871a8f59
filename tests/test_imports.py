"""Imports point one way and each outside library has one door: what keeps the rooms of the house apart."""
from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

HOST = Path(__file__).resolve().parents[1] / "host" / "whitefurnace"

# What each room may import, lowest first. A subpackage is one room; "__init__" is the public API.
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    "version": set(),
    "catalogue": {"errors"},
    "expression": {"errors"},
    "harmonic": {"errors"},
    "recipe": {"errors", "catalogue", "expression"},
    "source": {"errors", "catalogue", "recipe"},
    "plan": {"errors", "catalogue", "recipe"},
    "device": {"errors"},
    "pool": {"errors", "version", "device"},
    "files": {"errors"},
    "engines": {"errors", "expression", "recipe"},
    "environments": {"errors", "files"},
    "cells": {"errors", "catalogue", "source", "device"},
    "derived": {"errors", "catalogue", "source", "device", "cells"},
    "fitting": {"catalogue", "recipe", "device", "cells", "derived"},
    "run": {"errors", "catalogue", "recipe", "source", "plan", "device", "cells", "derived"},
    "bilinear": set(),
    "energy": {"errors", "catalogue", "recipe", "source", "device", "cells", "derived", "run"},
    "ltc": {"errors", "catalogue", "recipe", "source", "device", "cells", "derived", "run"},
    "sampling": {"errors", "catalogue", "recipe", "device", "cells", "derived"},
    "lobes": {"catalogue", "recipe", "device", "derived"},
    "certificate": set(),
    "sphere": {"catalogue", "plan", "environments"},
    "octamap": {"sphere"},
    "suns": {"errors", "environments", "sphere"},
    "stratum": {"sphere"},
    "means": {"catalogue", "source", "device", "sphere"},
    "samples": {"catalogue", "source", "device", "environments", "lobes", "sphere", "means"},
    "outlines": set(),
    "radiance": {"errors", "catalogue", "recipe", "source", "device", "environments", "sphere", "cells", "derived",
                 "run", "outlines"},
    "integrals": {"errors", "recipe", "device", "environments", "run", "radiance"},
    "octahedral": {"source", "plan", "device", "lobes", "sphere"},
    "texels": {"source", "plan", "device", "environments", "lobes", "sphere"},
    "convolution": {"recipe", "source", "plan", "device", "environments", "lobes", "sphere", "stratum", "means",
                    "octahedral", "texels"},
    "reading": {"errors", "recipe", "plan", "device", "environments", "certificate", "sphere", "convolution",
                "files", "fitting", "lobes"},
    "lighting": {"errors", "catalogue", "recipe", "plan", "device", "environments", "run", "lobes", "certificate",
                 "sphere", "means", "samples", "convolution", "fitting"},
    "programs": {"catalogue", "recipe", "source", "plan", "run"},
    "snippets": {"errors", "engines", "expression", "harmonic", "octamap"},
    "split_sum": {"engines", "recipe", "device", "run"},
    "outputs": {"errors", "version", "harmonic", "certificate", "convolution", "engines", "files", "lighting",
                "octamap", "recipe", "run", "snippets", "sphere", "split_sum"},
    "baking": {"errors", "version", "suns", "catalogue", "recipe", "source", "plan", "device", "files", "engines",
               "environments", "run", "lighting", "reading", "convolution", "harmonic", "outputs", "split_sum",
               "sphere", "programs"},
    "curves": {"errors", "catalogue", "recipe", "device", "files", "derived", "run"},
    "scale": {"errors", "catalogue"},
    "diffusion": {"errors", "catalogue", "run", "scale"},
    "glass": {"errors", "catalogue", "recipe", "source", "device", "cells", "derived", "run"},
    "tables": {"errors", "version", "bilinear", "energy", "curves", "diffusion", "glass", "ltc", "catalogue",
               "recipe", "device", "engines", "files", "environments", "run", "radiance", "integrals", "split_sum"},
    "batch": {"errors", "baking", "tables", "pool", "environments", "files", "recipe"},
    "truth": {"errors", "catalogue", "recipe", "source", "device", "environments", "cells", "derived", "run",
              "certificate", "sampling", "means", "samples", "sphere", "suns", "radiance"},
    "verification": {"errors", "catalogue", "recipe", "source", "device", "cells", "derived", "run", "sampling",
                     "radiance"},
    "benching": {"errors", "catalogue", "recipe", "source", "plan", "device", "environments", "cells", "derived",
                 "sphere", "means", "lobes", "octahedral", "texels", "samples", "convolution", "truth"},
    "tradeoff": {"errors", "recipe", "plan", "device", "environments", "sphere", "means", "convolution", "lighting",
                 "baking", "benching"},
    "contents": {"errors", "engines", "environments", "files", "harmonic"},
    "scene": {"errors", "files"},
    "swatches": {"errors", "scene"},
    "rendering": {"errors", "engines", "files", "harmonic", "octamap", "reading", "swatches"},
    "strips": {"errors", "contents", "engines", "environments", "files", "harmonic", "reading", "rendering", "sphere"},
    "media": {"errors", "scale", "scene"},
    "needs": {"errors", "files", "engines", "recipe", "plan", "outputs", "baking", "batch", "rendering", "scene"},
    "comparison": {"errors", "catalogue", "certificate", "contents", "engines", "environments", "harmonic", "reading",
                   "sphere"},
    "plots": {"errors", "catalogue", "device", "files", "cells", "derived", "run", "verification", "tradeoff",
              "comparison"},
    "beside": {"errors", "recipe", "device", "engines", "environments", "certificate", "files", "sphere", "suns",
               "reading", "radiance", "lighting", "baking", "truth", "swatches", "rendering", "plots"},
    "budget": {"errors", "swatches", "baking", "catalogue", "recipe", "device", "engines", "environments",
               "certificate", "files", "fitting", "sphere", "harmonic", "lighting", "outputs", "reading",
               "rendering", "scene", "split_sum", "truth"},
    "report": {"errors", "catalogue", "device", "engines", "baking", "batch", "tables", "verification", "benching",
               "tradeoff", "comparison", "rendering", "beside", "scene", "needs", "budget", "media"},
    "gallery": {"errors", "baking", "batch", "files", "report", "strips"},
    "__init__": {"version", "suns", "run", "integrals", "sampling", "lighting", "baking", "environments", "tables"},
    "cli": {"errors", "catalogue", "device", "baking", "batch", "tables", "verification", "benching", "tradeoff",
            "plots", "report", "contents", "comparison", "rendering", "beside", "engines", "gallery",
            "scene", "needs", "budget", "media"},
    "__main__": {"cli"},
}

# The doors of each outside library; None: any room.
DOORS: dict[str, set[str] | None] = {
    "numpy": None,
    "pyopencl": {"device"},
    "OpenImageIO": {"files"},
    "zstandard": {"files"},
    "ispc_texcomp": {"files"},
    "astc_encoder": {"files"},
    "click": {"cli", "report"},
    "rich": {"cli", "report"},
    "scipy": {"catalogue"},
    "distributed": {"pool"},
    "matplotlib": {"plots"},
    "pygltflib": {"scene"},
    "msgspec": {"recipe", "files", "engines", "batch", "budget"},
}


def room(path: Path) -> str:
    return path.relative_to(HOST).parts[0].removesuffix(".py")


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and full dotted name of all that a module imports, inside functions and TYPE_CHECKING too."""
    package = ["whitefurnace", *path.relative_to(HOST).parent.parts]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{stem}.{alias.name}") for alias in node.names)


def imported_room(name: str) -> str:
    """The room that a dotted name under `whitefurnace` is in; names of the package itself are the API's."""
    part = name.split(".")[1] if "." in name else "__init__"
    return part if (HOST / part).is_dir() or (HOST / f"{part}.py").is_file() else "__init__"


def modules() -> list[Path]:
    return sorted(path for path in HOST.rglob("*.py") if "__pycache__" not in path.parts)


def test_the_table_points_one_way():
    seen: set[str] = set()
    for name, allowed in ALLOWED.items():
        assert allowed <= seen, f"{name} may import {sorted(allowed - seen)}, which stand above it"
        seen.add(name)


@pytest.mark.parametrize("path", modules(), ids=lambda path: path.relative_to(HOST).as_posix())
def test_a_module_imports_only_what_its_room_may(path):
    here = room(path)
    assert here in ALLOWED, f"{here} is not in tests/test_imports.py: add what it may import to ALLOWED"
    wrong = []
    for line, name in imports(path):
        top = name.split(".")[0]
        if top == "whitefurnace":
            there = imported_room(name)
            if name != "whitefurnace.__version__" and there != here and there not in ALLOWED[here]:
                wrong.append(f"{path.name}:{line} imports {there}; {here} may import {sorted(ALLOWED[here])}")
        elif top not in sys.stdlib_module_names:
            if top not in DOORS:
                wrong.append(f"{path.name}:{line} imports {top}, which has no door: add it to DOORS")
            elif (doors := DOORS[top]) is not None and here not in doors:
                wrong.append(f"{path.name}:{line} imports {top}, whose doors are {sorted(doors)}")
    assert not wrong, "\n".join(wrong)


def test_the_check_sees_every_form_of_import(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.HOST", tmp_path)
    module = tmp_path / "files" / "one.py"
    module.parent.mkdir()
    module.write_text("import scipy.special\nfrom ..device import x\nfrom . import two\nfrom .. import run\n"
                      "def f():\n    from whitefurnace import cli\n    import whitefurnace.plan as p\n")
    (tmp_path / "run.py").touch()
    names = {name for _, name in imports(module)}
    assert names == {"scipy.special", "whitefurnace.device.x", "whitefurnace.files.two", "whitefurnace.run",
                     "whitefurnace.cli", "whitefurnace.plan"}
    assert imported_room("whitefurnace.run") == "run" and imported_room("whitefurnace.files.two") == "files"
    assert imported_room("whitefurnace.integrate") == imported_room("whitefurnace") == "__init__"
