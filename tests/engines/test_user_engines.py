"""Engines of users' TOML files: whatever a field holds, it is read or refused in one sentence that names the file."""

from __future__ import annotations

import random
import tomllib
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from changed_values import FOR_TOML, as_toml, changed, every, put
from whitefurnace.baking import bake as baking
from whitefurnace.engines.presets import engines, user_engine
from whitefurnace.engines.snippets import LANGUAGES, snippet
from whitefurnace.errors import InputError, UnsupportedError, UsageError
from whitefurnace.files import write_exr

CUBES = {
    "title": "Probes",
    "lod": "sqrt(r) * max_lod",
    "axes": "+x +z -y",
    "bend": "alpha",
    "blend": "r * 0.1",
    "least": 0.01,
    "size": 16,
    "min_size": 4,
    "follow": True,
    "whole": False,
    "sh": "irradiance",
    "shading": "split_sum",
    "steps": ["load it"],
    "dfg": {"size": 16, "x": "NoV", "y": "roughness", "NoV": "sqrt", "form": "scale_bias", "charlie": False},
    "file": [
        {"holds": "specular", "name": "{stem}.dds", "format": "rgba16f"},
        {"holds": "sh", "name": "{stem}_sh.json"},
        {"holds": "dfg", "name": "{stem}_dfg.ktx2", "format": "rg16f", "zstd": 19},
        {"holds": "irradiance", "name": "{stem}_irr.ktx", "format": "rgba32f"},
        {"holds": "skybox", "name": "{stem}_sky.dds", "format": "rgba16f"},
    ],
}
MAPS = {
    "lod": [[0.0, 0.0], [0.5, 1.0], [1.0, 2.0]],
    "size": 16,
    "levels": 3,
    "file": [{"holds": "specular", "name": "{stem}.exr", "layout": "octahedral", "border": 1}],
}
FORMULAS = (
    *("0", "nan", "inf", "1e999", "1/0", "r/0", "-r", "1e300", "r ** 1e300", "(-1) ** r", "log2(0)", "sqrt(-1)", "x"),
    *("r" + "+r" * 3000, "(" * 300 + "r" + ")" * 300, "r; r", "__import__('os')", "r.real", "[r]", "r if r else r"),
)
VALUES = (*FOR_TOML, *FORMULAS, ...)


def written(path: Path, document: dict) -> Path:
    path.write_text(as_toml(document), "utf-8")
    return path


def different(one: dict, document: dict) -> dict:
    """The fields in which a description differs from the document that it was made from."""
    return {key: one.get(key) for key in {**document, **one} if repr(one.get(key)) != repr(document.get(key))}


def used(path: Path) -> None:
    """All that a bake does with a description before it computes."""
    user_engine(path)
    (engine,) = engines(str(path))
    image = np.ones((4, 8, 3), np.float32)
    (planned,) = baking.bake(image, path.parent / "out", for_=str(path), dry_run=True)
    assert planned.state == "planned" and all(n >= 0 for n in planned.nbytes)
    for language in LANGUAGES:
        if engine.holding("specular"):
            snippet(engine, language, levels=3, width=16)


@pytest.mark.parametrize("document", [CUBES, MAPS], ids=["cubes", "maps"])
@pytest.mark.parametrize("count", [40, pytest.param(250, marks=pytest.mark.long)])
@pytest.mark.whole
def test_a_value_of_any_kind_in_any_field_is_read_or_refused(tmp_path, document, count):
    """`count` of the files in which one value is replaced by another, and as many with several."""
    path = tmp_path / "mine.toml"
    used(written(path, document))
    rng = random.Random(3)
    changes = [put(document, place, value) for place, value in every(document, VALUES)]
    changes = rng.sample(changes, count) + [changed(document, rng, VALUES) for _ in range(count)]
    refused, wrong = 0, []
    tracemalloc.start()
    for one in changes:
        written(path, one)
        try:
            tomllib.loads(path.read_text("utf-8"))
        except ValueError:
            continue
        try:
            used(path)
        except (InputError, UsageError, UnsupportedError) as error:
            refused += 1
            if "\n" in str(error) or len(str(error)) > 700 or "mine" not in str(error):
                wrong.append((different(one, document), str(error)))
        except Exception as error:
            wrong.append((different(one, document), repr(error)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert not wrong, f"{len(wrong)}: " + "\n".join(f"{text!r:.300} --> {said:.600}" for text, said in wrong[:20])
    assert len(changes) / 4 < refused < len(changes) and peak < 200e6, (refused, len(changes), peak)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        *(("size", n, "size") for n in (0, -1, 3, 4096, 1 << 70)),
        *(("min_size", n, "min_size") for n in (0, -4, 5, 4096)),
        *(("levels", n, "levels") for n in (0, -1, 40)),
        *(("least", x, "least") for x in (-0.1, 1.5, float("nan"), float("inf"))),
        *(("bend", text, "bend") for text in ("2", "-r", "1/r", "r ** -1", "log2(r)")),
        *(("blend", text, "blend") for text in ("1.5", "-0.5", "sqrt(r - 1)")),
        *(("lod", text, "lod") for text in ("1/r", "sqrt(r - 1)", "1e999")),
        *(("lod", rows, "lod") for rows in ([[0.0, 0.0]], [[0.0, 1.0], [0.0, 2.0]], [[0.0, 0.0], [float("nan"), 1.0]])),
    ],
    ids=repr,
)
def test_a_value_out_of_its_range_is_refused_by_name(tmp_path, field, value, says):
    with pytest.raises(InputError, match=rf"mine\.toml: .*{says}"):
        user_engine(written(tmp_path / "mine.toml", {**CUBES, field: value}))


def test_a_bad_engine_fails_its_own_items_alone(tmp_path, shell):
    written(tmp_path / "bad.toml", {**CUBES, "min_size": 0})
    write_exr(tmp_path / "a.exr", np.ones((4, 8, 3), np.float32))
    good = '[[bake]]\nenvironments = ["a.exr"]\noutput = "{}"\nsize = 8\nmin_size = 8\ntolerance = 0.3\n'
    (tmp_path / "job.toml").write_text(good.format("bad") + 'for = ["bad.toml"]\n' + good.format("good"))
    assert shell("batch", tmp_path / "job.toml") == 8
    assert (tmp_path / "good" / "raw" / "a.npz").is_file() and not (tmp_path / "bad").exists()
    said = [line for line in shell.err.splitlines() if "min_size" in line]
    assert len(said) == 1 and "bad.toml" in said[0]
    assert shell("batch", tmp_path / "job.toml", "--dry-run") == 8
