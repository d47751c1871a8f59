"""Imports point one way and each outside library has one door: this keeps the packages of the house apart."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

HOST = Path(__file__).resolve().parents[1] / "host" / "whitefurnace"

# Packages and single modules from the ground up; each imports only what stands before it. "__init__" is the public API.
ORDER = """
    errors version expression text results files catalogue plot_style opencl sphere scenes integrals prefiltering
    verification engines tables baking inspection rendering batch benching advice __init__ cli __main__
""".split()

# The packages that may import an outside library; None: all of them.
DOORS: dict[str, set[str] | None] = {
    "numpy": None,
    "pyopencl": {"opencl"},
    "OpenImageIO": {"files"},
    "zstandard": {"files"},
    "ispc_texcomp": {"files"},
    "astc_encoder": {"files"},
    "click": {"cli"},
    "rich": {"cli"},
    "scipy": {"catalogue"},
    "distributed": {"batch"},
    "matplotlib": {"plot_style"},
    "pygltflib": {"scenes"},
    "msgspec": {"prefiltering", "files", "engines", "batch", "advice"},
}


def modules() -> list[Path]:
    return sorted(path for path in HOST.rglob("*.py") if "__pycache__" not in path.parts)


def room(path: Path) -> str:
    """The package of a file, or the module itself where it stands in none."""
    return path.relative_to(HOST).parts[0].removesuffix(".py")


def dotted(path: Path) -> str:
    parts = path.relative_to(HOST).with_suffix("").parts
    return ".".join(["whitefurnace", *parts]).removesuffix(".__init__")


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
    """The package that a dotted name under `whitefurnace` is in; names of `whitefurnace` itself are the API's."""
    part = name.split(".")[1] if "." in name else "__init__"
    return part if (HOST / part).is_dir() or (HOST / f"{part}.py").is_file() else "__init__"


def test_the_order_names_every_package_once():
    assert len(ORDER) == len(set(ORDER))
    assert {room(path) for path in modules()} == set(ORDER)


@pytest.mark.parametrize("path", modules(), ids=lambda path: path.relative_to(HOST).as_posix())
def test_a_module_imports_only_what_stands_before_it(path):
    here, wrong = room(path), []
    before = ORDER[: ORDER.index(here) + 1]
    for line, name in imports(path):
        top = name.split(".")[0]
        if top == "whitefurnace":
            there = imported_room(name)
            if name != "whitefurnace.__version__" and there not in before:
                wrong.append(f"{path.name}:{line} imports {there}, which stands after {here}")
        elif top not in sys.stdlib_module_names:
            if top not in DOORS:
                wrong.append(f"{path.name}:{line} imports {top}, which has no door: add it to DOORS")
            elif (doors := DOORS[top]) is not None and here not in doors:
                wrong.append(f"{path.name}:{line} imports {top}, whose doors are {sorted(doors)}")
    assert not wrong, "\n".join(wrong)


def test_no_modules_import_each_other():
    """No circle of modules, within a package either; a package's `__init__` counts as the modules that it names."""
    known = {dotted(path): path for path in modules()}
    arrows: dict[str, set[str]] = {}
    for name, path in known.items():
        reached = arrows.setdefault(name, set())
        for _, target in imports(path):
            while target and target not in known:
                target = target.rpartition(".")[0]
            if target and target not in (name, "whitefurnace"):
                reached.add(target)
    done: set[str] = set()

    def visit(name: str, way: tuple[str, ...]) -> None:
        assert name not in way, " imports ".join([*way[way.index(name) :], name])
        if name not in done:
            for target in sorted(arrows[name]):
                visit(target, (*way, name))
            done.add(name)

    for name in known:
        visit(name, ())


def test_the_check_sees_every_form_of_import(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.HOST", tmp_path)
    module = tmp_path / "files" / "one.py"
    module.parent.mkdir()
    module.write_text(
        "import scipy.special\nfrom ..device import x\nfrom . import two\nfrom .. import run\n"
        "def f():\n    from whitefurnace import cli\n    import whitefurnace.plan as p\n"
    )
    (tmp_path / "run.py").touch()
    names = {name for _, name in imports(module)}
    assert names == {
        "scipy.special",
        "whitefurnace.device.x",
        "whitefurnace.files.two",
        "whitefurnace.run",
        "whitefurnace.cli",
        "whitefurnace.plan",
    }
    assert imported_room("whitefurnace.run") == "run" and imported_room("whitefurnace.files.two") == "files"
    assert imported_room("whitefurnace.integrate") == imported_room("whitefurnace") == "__init__"
