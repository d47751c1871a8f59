"""What a bake says that it compiles is what it compiles."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from whitefurnace.baking import bake as baking
from whitefurnace.cli import cli
from whitefurnace.files import write_exr
from whitefurnace.opencl.device import Device

HAT = """static inline real ndf_hat_D(real cos_m, real sin2_m, real alpha) {
  return exp_(-sin2_m / (alpha * alpha + (real)1e-3f));
}
"""


def kernels(*arguments: str) -> list[dict[str, Any]]:
    done = CliRunner().invoke(cli, ["bake", *arguments, "--dry-run", "--json"], catch_exceptions=False)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.exit_code == 0
    return [row for row in rows if row["event"] == "kernel"]


def built(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *arguments: str) -> list[str]:
    """The texts that a bake really builds, nothing being known from another."""
    texts: list[str] = []
    build = Device.build

    def spy(self: Device, text: str, *options: Any) -> Any:
        texts.append(text)
        return build(self, text, *options)

    monkeypatch.setattr(Device, "build", spy)
    baking._table.cache_clear()
    baking._split.cache_clear()
    done = CliRunner().invoke(cli, ["bake", *arguments, "--quiet"], catch_exceptions=False)
    assert done.exit_code == 0, done.stderr
    monkeypatch.undo()
    # Not those that a device is tried with: they are no part of a recipe, and of no file.
    return [text for text in dict.fromkeys(texts) if text.startswith("#line")]


def without_terms(text: str) -> str:
    """A text without the length of the table of Smith's area, which is known when that is made."""
    return "\n".join(line for line in text.splitlines() if not line.startswith("#define AREA_TERMS"))


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "options",
    [
        ("--for", "raw"),
        ("--for", "khronos"),
        ("--for", "exr", "--ndf", "phong"),
        ("--samples", "64"),
        ("--ndf", "{folder}/hat.clh"),
    ],
    ids=["ggx", "charlie", "phong", "samples", "own"],
)
def test_what_is_listed_is_what_is_built(tmp_path, monkeypatch, options):
    (tmp_path / "hat.clh").write_text(HAT)
    write_exr(tmp_path / "sky.exr", np.random.default_rng(3).random((16, 32, 3), np.float32))
    options = tuple(one.format(folder=tmp_path) for one in options)
    common = (
        str(tmp_path / "sky.exr"),
        "-o",
        str(tmp_path / "out"),
        "--size",
        "16",
        *(() if "--samples" in options else ("--tolerance", "1e-2")),
        *(() if "khronos" in options else ("--min-size", "8")),
        *options,
    )
    rows = kernels(*common)
    listed = {without_terms(row["text"]): row for row in rows}
    texts = {without_terms(text) for text in built(monkeypatch, tmp_path, *common)}
    assert not [[line for line in text.splitlines() if line.startswith("#line")] for text in texts - set(listed)]
    # All programs that are listed without a condition were built too.
    built_programs = {listed[text]["program"] for text in texts}
    assert not {row["program"] for text, row in listed.items() if not row["when"]} - built_programs
    for row in rows:
        data = row["text"].encode()
        assert row["bytes"] == len(data) and row["digest"] == hashlib.sha256(data).hexdigest()
        assert row["lines"] == len(row["text"].splitlines())


def test_a_recipe_compiles_no_model_but_its_own(tmp_path):
    write_exr(tmp_path / "sky.exr", np.ones((16, 32, 3), np.float32))
    arguments = (str(tmp_path / "sky.exr"), "-o", str(tmp_path / "out"))
    rows = kernels(*arguments)
    text = "".join(row["text"] for row in rows)
    assert "ndf_ggx_D" in text and not [
        name for name in ("beckmann", "phong", "charlie", "gtr", "abc") if f"ndf_{name}_D" in text
    ]
    told = CliRunner().invoke(cli, ["bake", *arguments, "--dry-run"]).stdout
    assert f"would compile {len(rows)} kernel programs" in told
