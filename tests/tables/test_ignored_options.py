"""No option is accepted and then ignored: it changes what is computed, or it is refused in one sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import whitefurnace as wf
from whitefurnace.catalogue import INTEGRALS, model
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.integrals.quadrature import table_spec
from whitefurnace.tables.kinds import kinds
from whitefurnace.tables.lut import plan
from whitefurnace.tables.request import TableRequest

SKY = np.ones((4, 8, 3), np.float32)
BRDF = "real3 brdf_mine_f(real3 l, real3 v) { return vec3(l.z, v.z, l.x); }\n"
# Models that are none's default, with all of their parameters.
SLOTS: dict[str, str] = {
    "ndf": "beckmann:alpha=.3",
    "masking": "neumann",
    "fresnel": "schlick:gold",
    "diffuse": "burley:albedo=.5,roughness=.5",
    "brdf": "mine.clh",
}
OPTIONS: dict[str, Any] = {
    **SLOTS,
    "light": "punctual:NoL=.5",
    "environment": SKY,
    "normal": (1.0, 0.0, 0.0),
    "rotate": 90.0,
    "exposure": 1.0,
    "bad_pixels": "zero",
    "layout": "latlong",
    "layer": "sky",
    "fill": "black",
    "nonfinite": "zero",
    "backfacing": "clamp",
    "precision": 64,
    "tolerance": 0.02,
    "relative_tolerance": 0.01,
    "size": 8,
    "scheme": "none of any kind",
    "stored": "rg16f",
    "for_": "filament",
    "fit": "bilinear",
    "as_read": True,
    "parameters": {"albedo": 0.5},
}
# What a kind cannot be planned without.
NEEDED: dict[str, dict[str, Any]] = {"radiance": {"light": "ambient:radiance=1"}}


@pytest.mark.whole
@pytest.mark.parametrize("name", sorted(kinds()))
def test_every_option_of_every_table_counts(name: str, tmp_path: Path) -> None:
    (tmp_path / "mine.clh").write_text(BRDF)
    needed = NEEDED.get(name, {})
    plain = plan(TableRequest(name, tmp_path / "t.npy", **needed)).key()
    ignored, refused = [], 0
    for option, value in OPTIONS.items():
        given = str(tmp_path / value) if option == "brdf" else value
        try:
            key = plan(TableRequest(name, tmp_path / "t.npy", **{**needed, option: given})).key()
        except (UsageError, UnsupportedError) as error:
            assert str(error) and "\n" not in str(error)
            refused += 1
        else:
            ignored += [option] if key == plain else []
    assert not ignored, f"lut {name} accepts {', '.join(ignored)} and computes the same"
    assert refused, "no option was refused, so this tests nothing"


@pytest.mark.parametrize("slot", SLOTS)
@pytest.mark.parametrize("name", [name for name in INTEGRALS if name != "radiance"])
def test_every_model_of_an_integral_counts(name: str, slot: str, tmp_path: Path) -> None:
    (tmp_path / "mine.clh").write_text(BRDF)
    spec = str(tmp_path / "mine.clh") if slot == "brdf" else SLOTS[slot]
    given: dict[str, Any] = {} if slot in ("ndf", "brdf") else {"ndf": "ggx:alpha=.3"}
    view = {"NoV": 0.5} if INTEGRALS[name].view else {}
    try:
        found = table_spec(name, **{**given, slot: spec}, **view)
    except (UsageError, UnsupportedError) as error:
        assert "\n" not in str(error)
        used = slot == "ndf" or (name.startswith("albedo") and slot in ("masking", "fresnel", "diffuse", "brdf"))
        assert not used and (name, slot) != ("dfg", "masking"), error
    else:
        assert found.slots[slot].model.name in spec


@pytest.mark.parametrize(
    "given",
    [
        {"name": "dfg", "ndf": "ggx", "fresnel": "schlick:gold"},
        {"name": "dfg", "ndf": "ggx", "fresnel": model("fresnel", "dielectric")},
        {"name": "normalization", "ndf": "ggx", "masking": "kelemen"},
        {"name": "normalization", "ndf": "ggx", "backfacing": "clamp"},
        {"name": "albedo_average", "ndf": "ggx", "backfacing": "absolute"},
        {"name": "albedo", "diffuse": "lambert", "masking": "kelemen", "NoV": 0.5},
        {"name": "albedo", "diffuse": "lambert", "fresnel": "schlick:f0=.5", "NoV": 0.5},
        {"name": "albedo", "ndf": "ggx", "rotate": 90.0, "NoV": 0.5},
        {"name": "albedo", "ndf": "ggx", "exposure": 1.0, "NoV": 0.5},
        {"name": "albedo", "ndf": "ggx", "nonfinite": "zero", "NoV": 0.5},
        {"name": "albedo", "ndf": "ggx", "layer": "sky", "NoV": 0.5},
        {"name": "albedo", "ndf": "ggx", "albedo": 0.5, "NoV": 0.5},
        {"name": "radiance", "light": "ambient:radiance=1", "masking": "kelemen", "NoV": 0.5},
        {"name": "radiance", "light": "ambient:radiance=1", "ndf": "ggx", "normal": np.array([0, 1, 0]), "NoV": 0.5},
    ],
    ids=lambda given: "-".join(given),
)
def test_what_an_integral_would_ignore_is_refused(given: dict[str, Any]) -> None:
    with pytest.raises((UsageError, UnsupportedError)) as caught:
        wf.integrate(**{"alpha": 0.3, **given} if "ndf" in given else given)
    assert "\n" not in str(caught.value)


def test_the_usual_models_are_no_choice() -> None:
    """A caller that names the default for an integral that has no use for it is not refused."""
    assert not {"masking", "fresnel"} & set(
        table_spec("normalization", ndf="ggx:alpha=.3", masking="smith", fresnel="one").slots
    )
    assert wf.dfg(2, ndf="ggx").values.shape == (2, 2, 2)


@pytest.mark.parametrize("given", [{"masking": "smith"}, {"alpha_x": 0.1}, {"precision": 16}], ids=str)
def test_samples_ignore_nothing(given: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        wf.sample("gtr:gamma=1.5", 4, **{"alpha": 0.3, **given})
