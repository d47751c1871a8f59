"""Job files: whatever a field holds, the job is read or refused with sentences that name their places."""

from __future__ import annotations

import random
import tomllib
import tracemalloc

import numpy as np
import pytest

from changed_values import FOR_TOML, as_toml, changed, every, put
from whitefurnace.batch import jobs as batch
from whitefurnace.errors import FileError, InputError
from whitefurnace.files import write_exr

JOB = {
    "bake": [
        {
            "environments": ["a.exr", "s*", "demo"],
            "output": "out",
            "for": ["raw", "filament"],
            "size": 16,
            "min_size": 8,
            "ndf": "ggx",
            "tolerance": 0.1,
            "rotate": 30.0,
            "exposure": 1.5,
            "nonfinite": "zero",
            "sun": "clamp=5",
            "sh": "window=auto",
            "without": ["sh"],
            "certify": 299,
        },
        {"environments": ["b.exr"], "output": "more", "levels": 3, "quality": "draft", "only_levels": "0-1"},
    ],
    "lut": [
        {"kind": "dfg", "output": "dfg.ktx2", "size": "8x8", "format": "rg16f", "scheme": "multiscatter"},
        {"kind": "albedo", "output": "a.npy", "axis": ["alpha=.1:1:4"], "set": ["f0=.04"], "fresnel": "schlick"},
        {"kind": "radiance", "output": "r.npy", "size": 4, "environment": "a.exr", "normal": [0.0, 1.0, 0.0]},
    ],
}
VALUES = (
    *(
        *FOR_TOML,
        ...,
        "a.exr",
        "../a.exr",
        "/etc",
        "*",
        "**",
        "[",
        "a" * 5000,
        "a" * 300,
        "out",
        "\u202e",
        "gg\x7f",
        "ggx:alpha=x",
    ),
    *("nan", "1e999", "0-99999999999", "window=nan", "clamp=-1", "clamp=nan", "alpha=.1:1:999999999", "16385x16385"),
)


@pytest.mark.parametrize("count", [25, pytest.param(250, marks=pytest.mark.long)])
@pytest.mark.whole
def test_a_value_of_any_kind_in_any_field_is_read_or_refused(tmp_path, count):
    """`count` of the jobs in which one value is replaced by another, and as many with several."""
    folder = tmp_path / "in"
    folder.mkdir()
    for name in ("a", "b", "s1"):
        write_exr(folder / f"{name}.exr", np.ones((4, 8, 3), np.float32))
    path = folder / "job.toml"
    path.write_text(as_toml(JOB), "utf-8")
    assert len(batch.job(path).items) == 7
    rng = random.Random(7)
    jobs = [put(JOB, place, value) for place, value in rng.sample(every(JOB, VALUES), count)]
    jobs += [changed(JOB, rng, VALUES) for _ in range(count)]
    refused, wrong = 0, []
    tracemalloc.start()
    for one in jobs:
        path.write_text(as_toml(one), "utf-8")
        try:
            tomllib.loads(path.read_text("utf-8"))
        except ValueError:
            continue
        try:
            results = list(batch.job(path).predicted())
        except (InputError, FileError) as error:
            refused += 1
            if str(path) not in str(error) or len(str(error)) > 6000:
                wrong.append((different(one), str(error)))
        except Exception as error:
            wrong.append((different(one), repr(error)))
        else:
            wrong += [
                (different(one), result.message)
                for result in results
                if result.state == "failed" and (result.exit_code in (0, 70) or "Error:" in result.message)
            ]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert not wrong, f"{len(wrong)}: " + "\n".join(f"{text!r:.300} --> {said:.600}" for text, said in wrong[:12])
    assert len(jobs) / 4 < refused < len(jobs) and peak < 300e6, (refused, len(jobs), peak)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["in"] and not (folder / "out").exists()


def different(one: dict) -> list:
    """The tables in which a job differs from JOB."""
    return [one.get(key) for key in {**JOB, **one} if repr(one.get(key)) != repr(JOB.get(key))]
