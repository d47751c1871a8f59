"""Kinds of table: each describes itself, and a new one is one module that touches nothing else."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import whitefurnace
from whitefurnace import lut
from whitefurnace.catalogue import INTEGRALS
from whitefurnace.errors import UsageError
from whitefurnace.scenes.scale import MEDIA
from whitefurnace.tables.curves import header
from whitefurnace.tables.kinds import kind, kinds, listed, scheme_of, schemes_listed
from whitefurnace.tables.lut import Table, make, plan
from whitefurnace.tables.request import TableRequest

TABLES = Path(whitefurnace.__file__).parent / "tables"

NEW_KIND = '''"""The mean Fresnel term of a clear coat, by its index of refraction, and what it leaves to the base."""

from __future__ import annotations

from whitefurnace.tables.kind import Kind


class CoatAverage(Kind):
    name = "coat_average"
    summary = "Mean Fresnel term of a coat, and what it leaves to the base"
    schemes = ("outside", "inside")
    size = 8
    tolerance = 1e-3
    fresnel = "dielectric"

    def integral(self, scheme):
        return "albedo_average"

    def specs(self, request):
        return {"fresnel": self.fresnel}

    def with_usual_axes(self, axes, models, fixed, size):
        return axes or {"ior": (1.2, 2.0, size.across)}

    def spec(self, cells):
        from dataclasses import replace

        from whitefurnace.tables.energy import fresnel_spec

        found = fresnel_spec(cells.models, cells.columns)
        return replace(found, shape=(*found.shape, 2))

    def make(self, cells, run, report):
        from dataclasses import replace

        import numpy as np

        from whitefurnace.tables.energy import fresnel_average

        mean = fresnel_average(**cells.arguments, **{**run.arguments, "out": None})
        values = np.stack([mean.values, 1 - mean.values], -1)
        if run.out is not None:
            run.out[...] = values
        return replace(mean, values=values), {"channels": ["F_avg", "1 - F_avg"], "seen_from": cells.scheme}

    def lines(self, manifest):
        return [f"  seen from {manifest['seen_from']}"]


KINDS = (CoatAverage(),)
'''

WITH_FOLDER = (
    "import sys\nfrom whitefurnace.tables import kinds\nkinds.__path__.append(sys.argv.pop(1))\n"
    "from whitefurnace.cli import main\nmain(sys.argv[1:])\n"
)
"""Runs the command line with one more folder in which kinds are looked for."""


@pytest.fixture
def shell_with_new_kind(tmp_path: Path) -> Callable[..., str]:
    """The command line of a whitefurnace that has one more module in `tables/kinds`."""
    folder = tmp_path / "more"
    folder.mkdir()
    (folder / "coat_average.py").write_text(NEW_KIND, "utf-8")

    def run(*arguments: str, code: int = 0) -> str:
        done = subprocess.run(
            [sys.executable, "-c", WITH_FOLDER, str(folder), *arguments],
            capture_output=True,
            text=True,
            encoding="utf-8",
            cwd=tmp_path,
            env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "PYTHONIOENCODING": "utf-8"},
        )
        assert done.returncode == code, done.stderr
        return done.stdout if code == 0 else done.stderr

    return run


def test_a_new_kind_is_one_module(tmp_path: Path, shell_with_new_kind: Callable[..., str]) -> None:
    """Help, errors, --dry-run, text, JSON and every file format know it."""
    shell = shell_with_new_kind
    told = shell("lut", "--help")
    assert "coat_average     Mean Fresnel term of a coat" in told
    assert "coat_average: outside, inside" in " ".join(told.split())
    planned = shell("lut", "coat_average", "-o", "t.npy", "--dry-run")
    assert planned.startswith("t.npy: coat_average, dielectric; array of 1 × 8 × 2, float32\n  x  ior = 1.2 … 2, 8")
    done = shell("lut", "coat_average", "-o", "t.npy", "--scheme", "inside")
    assert "channels  F_avg, 1 - F_avg" in done and "  seen from inside\n" in done
    row = json.loads(shell("lut", "coat_average", "-o", "t.ktx2", "--json"))
    assert row["event"] == "done" and row["integral"] == "coat_average" and row["tolerance"] == 1e-3
    assert row["scheme"] == row["seen_from"] == "outside" and row["stored"]["format"] == "rg16f"
    assert "up to date" in shell("lut", "coat_average", "-o", "t.npy", "--scheme", "inside")
    for name in ("t.exr", "t.png", "t.dds", "t.h"):
        assert f"wrote {name}" in shell("lut", "coat_average", "-o", name)
    assert "did you mean 'coat_average'?" in shell("lut", "coat_avrage", "-o", "u.npy", code=1)
    assert "did you mean 'inside'?" in shell("lut", "coat_average", "-o", "u.npy", "--scheme", "insid", code=1)
    values = np.load(tmp_path / "t.npy")
    assert values.shape == (1, 8, 2) and values.sum(-1) == pytest.approx(1, abs=1e-6) and values[0, 0, 0] < 0.1


def test_it_is_gone_with_its_module() -> None:
    assert "coat_average" not in kinds()
    with pytest.raises(UsageError, match="unknown integral 'coat_average'"):
        kind("coat_average")


def test_every_integral_and_module_has_its_kind() -> None:
    assert set(INTEGRALS) <= set(kinds())
    for name, one in kinds().items():
        assert one.name == name and 10 < len(one.summary) <= 62 and f"  {name} " in listed()
        assert one.integral(scheme_of(one, None)) in INTEGRALS
        assert not one.schemes or f"{name}: {', '.join(one.schemes)}" in schemes_listed()


def test_media_are_schemes() -> None:
    assert kind("diffusion").schemes == (
        "skin",
        "burley",
        "dipole",
        *(name for name in MEDIA if name not in ("water", "air")),
    )


def test_schemes_are_refused_by_name() -> None:
    assert scheme_of(kind("ltc"), None) == "free" and scheme_of(kind("sheen"), None) is None
    with pytest.raises(UsageError, match="unknown scheme 'fre'; did you mean 'free'"):
        scheme_of(kind("ltc"), "fre")
    with pytest.raises(UsageError, match="sheen has no scheme; dfg, diffusion, energy, glass, ltc, ltc_1 and smith"):
        scheme_of(kind("sheen"), "free")


def test_generic_code_names_no_kind() -> None:
    """No string in the modules of all kinds is the name of one, besides those in error messages and docstrings."""
    for module in ("lut", "planning", "cells", "request", "axes", "kinds/__init__"):
        for node in ast.walk(ast.parse((TABLES / f"{module}.py").read_text("utf-8"))):
            assert not (isinstance(node, ast.Constant) and node.value in set(kinds())), (module, node.lineno)


def test_kinds_are_listed_without_numpy() -> None:
    code = (
        "import sys\nfrom whitefurnace.tables.kinds import listed\nlisted()\n"
        "sys.exit(str({'numpy', 'pyopencl', 'OpenImageIO'} & set(sys.modules)).replace('set()', '') or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["diffusion", "dfg", "fresnel_average", "norm"])
def test_a_subject_needs_no_scheme(tmp_path: Path, name: str) -> None:
    size = None if name == "norm" else 4  # its axes have counts of their own
    planned = make(plan(TableRequest(name, tmp_path / "t.npy", size=size)), dry_run=True)
    assert planned.subject and planned.kind.lines(planned.recipe) == []
    bare = Table(planned.kind, planned.path, "done", (1,), (), 4, {"models": {}})
    assert bare.subject == planned.kind.summary


def test_the_signature_is_the_request() -> None:
    """`wf.lut` spells out every option of `TableRequest`, with the same default and type."""
    fields = {f.name: f for f in dataclasses.fields(TableRequest)}
    options = dict(inspect.signature(lut).parameters)
    own = [options.pop(name) for name in ("device", "dry_run", "progress", "fixed")]
    assert [one.kind.name for one in own] == ["KEYWORD_ONLY"] * 3 + ["VAR_KEYWORD"]
    assert list(options) == list(fields)
    for name, field in fields.items():
        default = inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default
        assert options[name].default is default or options[name].default == default, name
        assert options[name].annotation == field.type, name


def test_a_header_is_named_after_its_file() -> None:
    assert "#define MINE_K(x) 1" in header("mine", (["about"], ["#define NAME_K(x) 1"]), "0")
