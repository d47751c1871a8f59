"""The package is whole: setup.cfg's list is the tree, and what is installed has every module and kernel."""

from __future__ import annotations

import configparser
from fnmatch import fnmatch
from pathlib import Path

import pytest

import whitefurnace.errors

ROOT = Path(__file__).resolve().parents[1]
HOST, KERNELS = ROOT / "host" / "whitefurnace", ROOT / "kernels"
INSTALLED = Path(whitefurnace.errors.__file__).resolve().parent


def setup(section: str, key: str) -> list[str]:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    return parser.get(section, key).replace(",", " ").split()


def kernel_files() -> list[str]:
    found = [path for path in KERNELS.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return sorted(path.relative_to(KERNELS).as_posix() for path in found if path.suffix != ".py")


def test_the_packages_are_those_of_the_tree():
    modules = [path for path in HOST.rglob("*.py")]
    folders = {path.parent.relative_to(HOST.parent) for path in modules}
    bare = sorted(str(folder) for folder in folders if not (HOST.parent / folder / "__init__.py").exists())
    assert not bare, f"folders of modules without __init__.py: {bare}"
    tree = {".".join(folder.parts) for folder in folders} | {"whitefurnace.kernels"}
    listed = setup("options", "packages")
    assert len(listed) == len(set(listed))
    assert set(listed) == tree, f"setup.cfg and the tree differ in {sorted(set(listed) ^ tree)}"


def test_every_kernel_file_is_package_data():
    patterns = setup("options.package_data", "whitefurnace.kernels")

    def matched(name: str) -> bool:
        # setuptools' * does not cross a folder, fnmatch's does
        return any(name.count("/") == p.count("/") and fnmatch(name, p) for p in patterns)

    assert kernel_files()
    lost = [name for name in kernel_files() if not matched(name)]
    assert not lost, f"not in package_data ({', '.join(patterns)}): {lost}"


@pytest.mark.skipif(INSTALLED == HOST, reason="runs from the tree, not from an installed wheel")
def test_the_wheel_has_all_files_and_no_others():
    def files(folder: Path, *suffixes: str) -> dict[str, bytes]:
        return {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            if path.suffix in suffixes and "__pycache__" not in path.parts
        }

    wanted = files(HOST, ".py", ".html") | {
        f"kernels/{name}": text for name, text in files(KERNELS, ".py", ".cl", ".clh").items()
    }
    there = files(INSTALLED, ".py", ".html", ".cl", ".clh")
    assert set(there) == set(wanted)
    assert [name for name in wanted if there[name] != wanted[name]] == [], "an old wheel is installed"
