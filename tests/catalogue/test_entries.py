"""Entries of the catalogue as wholes: the papers that they cite, what they state, and that a new one is two files."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pytest

import whitefurnace
from whitefurnace.catalogue import SLOTS, Model, models
from whitefurnace.catalogue.bibliography import SHARED, bibliography, cited
from whitefurnace.catalogue.choice import chosen
from whitefurnace.catalogue.model import Checks, Paper
from whitefurnace.errors import UsageError
from whitefurnace.opencl.device import Device

HOST = Path(whitefurnace.__file__).parent
KERNELS = Path(str(resources.files("whitefurnace.kernels")))
MODELS = [entry for slot in SLOTS for entry in models(slot).values()]
EVERY = pytest.mark.parametrize("entry", MODELS, ids=[f"{m.slot}-{m.name}" for m in MODELS])
KEY = re.compile(r"(?:\[|; )([A-Z][A-Za-z]+\d{4})\b")


@EVERY
def test_an_entry_has_one_paper_and_its_kernel_cites_known_ones(entry: Model) -> None:
    known = bibliography()
    assert known[entry.citation.key] == entry.citation and entry.citation.text
    for key in KEY.findall((KERNELS / entry.kernel_file).read_text("utf-8")):
        assert key in known, f"{entry.kernel_file} cites {key}: add it to the entry's also_cited"


@EVERY
def test_an_entry_is_refused_in_another_slot(entry: Model) -> None:
    """A program binds a model by its slot, so an entry of another slot must not get as far as a kernel."""
    for slot in {*SLOTS, "brdf"} - {entry.slot}:
        with pytest.raises(UsageError, match=rf"^{slot} is {entry.name}, which is a model of the slot {entry.slot}$"):
            chosen(slot, entry)
    assert chosen(entry.slot, entry).model is entry


@EVERY
def test_a_masking_is_made_for_an_ndf_that_there_is(entry: Model) -> None:
    assert entry.made_for == "" or (entry.slot == "masking" and entry.made_for in models("ndf"))


def test_a_paper_is_listed_once() -> None:
    """Papers of entries are not in the list of shared ones, and an entry takes another's paper from that entry."""
    brought: dict[str, Paper] = {}
    for entry in MODELS:
        for paper in (entry.citation, *entry.also_cited):
            if paper.key not in SHARED:
                assert brought.setdefault(paper.key, paper) is paper, f"{entry.name} states {paper.key} anew"
    for entry in MODELS:
        for paper in (entry.citation, *entry.also_cited):
            assert paper.key not in SHARED or paper == cited(paper.key), f"{entry.name} states {paper.key} anew"


def test_every_citation_is_in_the_bibliography() -> None:
    known = bibliography()
    for path in [*KERNELS.rglob("*.cl"), *KERNELS.rglob("*.clh"), *HOST.rglob("*.py")]:
        for key in KEY.findall(path.read_text("utf-8")):
            assert key in known, f"{path.name} cites {key}"


def test_the_list_has_no_paper_that_nobody_cites() -> None:
    texts = [
        path.read_text("utf-8")
        for path in [*KERNELS.rglob("*.cl*"), *HOST.rglob("*.py")]
        if path.name != "bibliography.py"
    ]
    assert not [key for key in SHARED if not any(key in text for text in texts)]


def test_a_listing_shows_checks_among_the_notes() -> None:
    entry = Model(
        "masking",
        "m",
        "M",
        Paper("", ""),
        (),
        (),
        {},
        checks=Checks(reciprocal=True, slow_rules=8.0, negative=True),
        notes={"follows roughness": False, "caution": "none"},
    )
    assert list(entry.facts.items()) == [
        ("reciprocal", True),
        ("follows roughness", False),
        ("slow rules", 8.0),
        ("caution", "none"),
    ]
    assert Model("masking", "m", "M", Paper("", ""), (), (), {}).facts == {}


@EVERY
def test_a_stated_error_is_the_one_that_readers_see(entry: Model) -> None:
    stated = entry.checks.float32_error
    if stated is not None:
        assert f"at most {stated:g}".replace("e-0", "e-") in str(entry.notes["float32"])


KERNEL = """// A lobe that nobody has published, between a uniform one and a squared cosine. [Nobody2030]

// ∫ cos θ dω/π is 1, and so is ∫ 2 cos³θ dω/π.
static inline real ndf_bowl_D(real cos_m, real sin2_m, real k) { return (1 - k + 2 * k * sqr(cos_m)) / PI; }

// It has no peak to grade nodes for.
static inline real ndf_bowl_width(real k) { return (real)HALF_PI; }
"""
ENTRY = '''"""A lobe between a uniform one and a squared cosine."""
import numpy as np

from whitefurnace.catalogue.model import Checks, Model, Paper, Parameter
from whitefurnace.catalogue.roughness import alpha_of_roughness

K = Parameter("k", "k", "1", 0.0, 1.0, (0.0, 0.3, 1.0), "share of the squared cosine")


def _d(theta_m, k):
    """cos² as 1/(1 + tan²)."""
    theta_m = np.asarray(theta_m, np.float64)
    return np.where(np.cos(theta_m) > 0, (1 - k) / np.pi + 2 * k / (np.pi * (1 + np.tan(theta_m) ** 2)), 0.0)


ENTRY = Model(
    slot="ndf",
    name="bowl",
    title="Bowl",
    citation=Paper("Nobody2030", "N. Nobody, A Lobe of No Use, 2030"),
    parameters=(K,),
    provides=("NDF_D", "NDF_WIDTH"),
    reference={"D": _d},
    from_roughness=lambda r: {"k": 1 - alpha_of_roughness(r)},
    checks=Checks(normalized=True),
)
'''


def test_a_new_model_is_its_kernel_and_its_entry(device: Device, tmp_path: Path) -> None:
    """A copy of the package with two files more lists the model, cites its paper and verifies it."""
    package = tmp_path / "whitefurnace"
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(HOST, package, ignore=ignored)
    shutil.copytree(KERNELS, package / "kernels", ignore=ignored, dirs_exist_ok=True)
    (package / "kernels" / "ndf" / "bowl.clh").write_text(KERNEL, "utf-8")
    (package / "catalogue" / "ndf" / "bowl.py").write_text(ENTRY, "utf-8")

    def run(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "whitefurnace", *words],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=300,
            env={**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONUTF8": "1", "WHITEFURNACE_DEVICE": device.address},
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert "Bowl" in run("models") and "Nobody2030" in run("models")
    assert "N. Nobody, A Lobe of No Use, 2030" in run("models", "bowl")
    told = run("verify", "bowl", "--precision", "32")
    assert "normalization" in told and "weak furnace, smith" in told and "sampler, chi²" in told
    listed = "from whitefurnace.catalogue.bibliography import bibliography; print(*bibliography())"
    found = subprocess.run(
        [sys.executable, "-c", listed],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    assert "Nobody2030" in found.stdout, found.stderr
