"""`verify`: every entry has rows that pass, and what is broken on purpose fails the check that is meant to find it."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from whitefurnace import cli
from whitefurnace.catalogue import SLOTS, Model, model, models
from whitefurnace.cli.verify import verify_text
from whitefurnace.errors import FileError, InputError, UnsupportedError, UsageError
from whitefurnace.opencl.device import Device
from whitefurnace.verification import checks as verification
from whitefurnace.verification.checks import Row, Subject, subjects, verify

FILES = {
    # GGX but for a factor: any scale is fine.
    "lobe": "real ndf_lobe_D(real cos_m, real alpha) {\n  real t = cos_m * cos_m * (alpha * alpha - 1) + 1;\n"
    "  return 7 / (t * t);\n}\n",
    "steep": "real ndf_steep_D(real cos_m) { return 1 / (cos_m * cos_m); }\n",
    "dips": "real ndf_dips_D(real cos_m) { return cos_m - (real)0.5f; }\n",
    "tail": "real ndf_tail_D(real cos_m) { return 1 / cos_m; }\n",
    "white": "real3 brdf_white_f(real3 l, real3 v, real albedo) {\n  real f = albedo / PI;\n"
    "  return vec3(f, f / 2, f / 3);\n}\n",
    "oneway": "real3 brdf_oneway_f(real3 l, real3 v) { real f = l.z / PI; return vec3(f, f, f); }\n",
    "gains": "real3 brdf_gains_f(real3 l, real3 v) {\n  real f = (real)(scalar)0.4f;\n"
    "  return vec3(f / 2, f, f / 2);\n}\n",
    "hole": "real3 brdf_hole_f(real3 l, real3 v) {\n  real f = sqrt(l.z + v.z - (real)0.1f) / PI;\n"
    "  return vec3(f, f, f);\n}\n",
    "minus": "real3 brdf_minus_f(real3 l, real3 v) {\n  real f = (dot3(l, v) - (real)0.5f) / 10;\n"
    "  return vec3(f, f, f);\n}\n",
    # NaN between the angles at which a D is looked at first.
    "gap": "real ndf_gap_D(real cos_m, real sin2_m) {\n"
    "  return sqrt((sin2_m - (real)0.251f) * (sin2_m - (real)0.25f));\n}\n",
    "top": "real ndf_top_D(real cos_m) { return (1 - cos_m) / (1 - cos_m); }\n",
    "neither": "real3 something_f(real3 l, real3 v) { return l; }\n",
}


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clh")
    for name, text in FILES.items():
        (folder / f"{name}.clh").write_text(text, "utf-8")
    return folder


def rows_of(entry: Model, device: Device, precision: int = 32, **given: float) -> list[Row]:
    return list(verify([Subject(entry, entry.name, given)], [precision], device))


def failed(rows: list[Row]) -> dict[str, Row]:
    return {row.check: row for row in rows if not row.passed}


def told(row: Row) -> str:
    return verify_text([row])


# ---------------------------------------------------------------------------------------------- what is right


def check_all(found: Iterator[Row], entries: Mapping[str, Model]) -> None:
    rows = list(found)
    assert not [told(row) for row in rows if not row.passed]
    assert {row.model for row in rows} == set(entries), "each entry is in at least one row"
    for row in rows:
        assert row.cells > 0 and row.counterexample is None and math.isfinite(row.value), told(row)
        if row.tolerance is not None:
            assert row.error is not None and row.error <= row.tolerance, told(row)
    for name in entries:
        assert any(row.tolerance is not None for row in rows if row.model == name), f"{name} is judged by nothing"


HEAVY = {"ndf": ("ggx", "gtr", "charlie"), "masking": ("smith", "neumann")}
"""The models of large slots that the fast suite takes: a closed form, a numerical one and an odd one."""


@pytest.mark.parametrize("slot", SLOTS)
def test_entries_pass(device: Device, slot: str) -> None:
    entries = {name: entry for name, entry in models(slot).items() if name in HEAVY.get(slot, models(slot))}
    check_all(verify([Subject(entry, name) for name, entry in entries.items()], [32], device), entries)


@pytest.mark.long
@pytest.mark.parametrize("slot", HEAVY)
def test_every_entry_passes(device: Device, slot: str) -> None:
    entries = models(slot)
    check_all(verify([Subject(entry, name) for name, entry in entries.items()], [32], device), entries)


@pytest.mark.long
@pytest.mark.parametrize("slot", SLOTS)
def test_every_entry_passes_in_float64(device: Device, slot: str) -> None:
    if not device.fp64:
        pytest.skip("no float64")
    entries = models(slot)
    check_all(verify([Subject(entry, name) for name, entry in entries.items()], [64], device), entries)


def test_every_slot_has_checks() -> None:
    assert set(verification.CHECKS) == {*SLOTS, "brdf"} and all(verification.CHECKS.values())


def test_a_subset_is_quick_and_stays_at_what_is_given(device: Device) -> None:
    list(verify(subjects(["schlick:gold"]), [32], device))  # programs
    start = time.perf_counter()
    rows = list(verify(subjects(["schlick:gold"]), [32], device))
    assert time.perf_counter() - start < 2
    assert {row.parameters["f0"] for row in rows} <= {np.float32(v) for v in (1.0, 0.71, 0.29)}
    narrow = rows_of(model("ndf", "gtr"), device, gamma=2.0)
    assert not failed(narrow) and {row.parameters["gamma"] for row in narrow if row.parameters} == {2.0}


def test_facts_of_energy_are_measured_not_failed(device: Device) -> None:
    burley = rows_of(model("diffuse", "burley"), device)
    assert not failed(burley)
    energy = next(row for row in burley if row.check == "energy: albedo as declared")
    assert 1.5 < energy.value <= 785 / 504 + 1e-5 and energy.parameters["NoV"] == 0
    masking = rows_of(model("masking", "schlick_smith"), device)
    smith = next(row for row in masking if row.check.endswith("with beckmann"))
    assert smith.tolerance is None and -0.65 < smith.value - 1 < -0.3, "its distance from Smith is told"


def test_limits_of_fresnel(device: Device) -> None:
    rows = {row.check: row for row in rows_of(model("fresnel", "dielectric"), device)}
    for name in ("0°", "90°", "Brewster's angle", "total internal reflection"):
        assert rows[f"F at {name}"].passed, told(rows[f"F at {name}"])
    brewster = rows_of(model("fresnel", "dielectric"), device, ior=1.5)
    value = next(row for row in brewster if row.check == "F at Brewster's angle").value
    assert abs(value - 0.5 * (1.25 / 3.25) ** 2) < 1e-6


# ---------------------------------------------------------------------------------------------- what is broken


def test_a_wrong_norm(device: Device) -> None:
    abc = model("ndf", "abc")
    assert abc.constants is not None
    right = abc.constants
    wrong = dataclasses.replace(abc, constants=lambda **p: {n: 1.01 * c for n, c in right(**p).items()})
    bad = failed(rows_of(wrong, device, b=30.0))
    assert {"normalization", "kernel D"} <= set(bad)
    row = bad["normalization"]
    assert abs(row.value - 1.01) < 1e-5 and row.error is not None and row.tolerance is not None
    assert row.error > row.tolerance and row.counterexample is not None and row.counterexample["b"] == 30


def test_a_wrong_reference(device: Device) -> None:
    ggx = model("ndf", "ggx")

    def off(theta: Any, alpha: Any) -> Any:
        """1e-4 too large near grazing, for rough surfaces alone."""
        return ggx.reference["D"](theta, alpha) * np.where((theta > 1.5) & (alpha > 0.5), 1.0001, 1.0)

    bad = failed(rows_of(dataclasses.replace(ggx, reference={**ggx.reference, "D": off}), device))
    assert set(bad) == {"kernel D"}
    where = bad["kernel D"].counterexample
    assert where is not None and where["theta_m"] > 1.5 and where["alpha"] > 0.5


def test_a_wrong_area_breaks_the_furnace(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    masking = model("masking", "schlick_smith")
    boast = dataclasses.replace(masking, checks=dataclasses.replace(masking.checks, weak_furnace=1.0))
    bad = failed(rows_of(boast, device))
    assert "weak furnace with beckmann" in bad
    where = bad["weak furnace with beckmann"].counterexample
    assert where is not None and where["v"][2] == where["NoV"]


def test_a_wrong_sampler(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    right = verification.sample
    monkeypatch.setattr(
        verification,
        "sample",
        lambda ndf, count, alpha, **rest: right(ndf, count, alpha=min(1.03 * alpha, 1.0), **rest),
    )
    bad = failed(rows_of(model("ndf", "ggx"), device))
    assert set(bad) == {"sampler, chi²"} and bad["sampler, chi²"].counterexample is not None


@pytest.mark.parametrize(
    "slot, name, text, checks",
    [
        (
            "fresnel",
            "schlick",
            "static inline real fresnel_schlick_F(real cos_d FRESNEL_PARAMETERS) {\n"
            "  const real m = 1 - cos_d;\n  return fresnel_f0 + (fresnel_f90 - fresnel_f0) * m * m * m * m;\n}\n",
            {"kernel F"},
        ),
        (
            "fresnel",
            "one",
            "static inline real fresnel_one_F(real cos_d FRESNEL_PARAMETERS) { return 1 + cos_d / 8; }\n",
            {"kernel F", "F at most 1", "F at 0°"},
        ),
        (
            "masking",
            "implicit",
            "static inline real masking_implicit_at(DIRECTION d MASKING_PARAMETERS) { return (real)0; }\n"
            "static inline real masking_implicit_V(real NoV, real NoL, real NoH, real VoH, real at_v, real at_l\n"
            "    MASKING_PARAMETERS) { return (real)1 + NoL / 4; }\n"
            "static inline real masking_implicit_G(real NoV, real NoL, real NoH, real VoH, real at_v, real at_l\n"
            "    MASKING_PARAMETERS) { return NoV * NoL; }\n",
            {"kernel V", "G = V (n·l)(n·v)", "reciprocity", "G of a backfacing light"},
        ),
        (
            "diffuse",
            "lambert",
            "static inline real diffuse_lambert_f(real3 l, real3 v, real albedo) {\n"
            "  return albedo / PI * ((real)1.1f - l.z * (real)0.25f);\n}\n",
            {"kernel f", "reciprocity", "albedo"},
        ),
        (
            "diffuse",
            "lambert",
            "static inline real diffuse_lambert_f(real3 l, real3 v, real albedo) {\n  return albedo / 3;\n}\n",
            {"kernel f", "albedo", "energy: albedo", "energy: albedo as declared"},
        ),
    ],
)
def test_a_broken_kernel(device: Device, slot: str, name: str, text: str, checks: set[str]) -> None:
    bad = failed(rows_of(dataclasses.replace(model(slot, name), text=text), device))
    assert checks <= set(bad), sorted(bad)
    for row in bad.values():
        assert row.counterexample is not None, told(row)
        assert row.counterexample.keys() >= row.parameters.keys()
    if slot == "diffuse":
        where = bad["kernel f"].counterexample
        assert where is not None
        assert all(abs(np.linalg.norm(where[d]) - 1) < 1e-6 and where[d][2] >= 0 for d in "lv")


@pytest.mark.parametrize(
    "stated, check",
    [({"reciprocal": False}, "not reciprocal, as declared"), ({"largest_albedo": 0.9}, "energy: albedo as declared")],
)
def test_a_false_declaration(device: Device, stated: dict[str, Any], check: str) -> None:
    lambert = model("diffuse", "lambert")
    bad = failed(rows_of(dataclasses.replace(lambert, checks=dataclasses.replace(lambert.checks, **stated)), device))
    assert set(bad) == {check}


# ---------------------------------------------------------------------------------------------- files


def test_an_ndf_from_a_file(device: Device, files: Path) -> None:
    rows = list(verify(subjects([f"{files}/lobe.clh:alpha=.3"]), [32], device))
    assert not failed(rows)
    by = {row.check: row for row in rows}
    assert abs(by["raw norm"].value / (7 * math.pi / 0.09) - 1) < 1e-5
    assert by["least albedo"].value < by["largest albedo"].value <= 1 + 2e-6
    assert by["weak furnace, smith"].passed and by["sampler, chi²"].passed
    assert all(row.model == f"{files}/lobe.clh" for row in rows)


def test_a_brdf_from_a_file(device: Device, files: Path) -> None:
    rows = list(verify(subjects([f"{files}/white.clh:albedo=.9"]), [32], device))
    assert not failed(rows)
    by = {row.check: row for row in rows}
    assert abs(by["largest albedo"].value - 0.9) < 2e-6 and abs(by["least albedo"].value - 0.3) < 2e-6
    colours = list(verify(subjects([f"{files}/white.clh:albedo=.9/.5/.1"]), [32], device))
    assert {row.parameters["albedo"] for row in colours} == {0.9, 0.5, 0.1}


@pytest.mark.parametrize(
    "stem, check",
    [("oneway", "reciprocity"), ("gains", "energy: albedo"), ("hole", "f finite"), ("minus", "f at least 0")],
)
def test_a_broken_brdf(device: Device, files: Path, stem: str, check: str) -> None:
    bad = failed(list(verify(subjects([f"{files}/{stem}.clh"]), [32], device)))
    assert set(bad) == {check}
    where = bad[check].counterexample
    assert where is not None
    light, v = np.array(where["l"]), np.array(where["v"])
    assert np.isclose([light @ light, v @ v], 1, atol=1e-6).all() and light[2] > 0 and v[2] > 0
    # The counterexample is one.
    assert {
        "oneway": abs(light[2] - v[2]) > 1e-3,
        "gains": abs(bad[check].value - 0.4 * math.pi) < 1e-5,
        "hole": light[2] + v[2] < 0.1,
        "minus": light @ v < 0.5,
    }[stem]


@pytest.mark.parametrize(
    "stem, kind, words",
    [
        ("steep", InputError, "cannot be normalized"),
        ("dips", InputError, "negative"),
        ("top", InputError, "not finite at θ = 0 rad"),
        ("tail", UnsupportedError, "masking: its projected area is infinite"),
    ],
)
def test_an_ndf_that_is_refused(device: Device, files: Path, stem: str, kind: type[Exception], words: str) -> None:
    with pytest.raises(kind, match=words):
        list(verify(subjects([f"{files}/{stem}.clh"]), [32], device))


def test_what_is_not_a_number_fails(device: Device, files: Path) -> None:
    rows = []
    with pytest.raises(InputError, match=r"not finite at θ = 0\.52"):  # as the sampler finds
        for row in verify(subjects([f"{files}/gap.clh"]), [32], device):
            rows.append(row)
    bad = failed(rows)
    assert "raw norm" in bad and all(row.counterexample is not None and "nan" in told(row) for row in bad.values())


def test_specs(files: Path, tmp_path: Path) -> None:
    assert len(subjects([])) == sum(len(models(slot)) for slot in SLOTS)
    with pytest.raises(UsageError, match="did you mean 'ggx'"):
        subjects(["gxx"])
    with pytest.raises(UsageError, match="no parameter 'alhpa'; did you mean 'alpha'"):
        subjects(["ggx:alhpa=1"])
    with pytest.raises(UsageError, match=r"albedo must be given, as white\.clh:albedo=VALUE"):
        subjects([f"{files}/white.clh"])
    with pytest.raises(InputError, match=r"ndf_neither_D.*brdf_neither_f"):
        subjects([f"{files}/neither.clh"])
    with pytest.raises(FileError, match="cannot read"):
        subjects([str(tmp_path / "none.clh")])
    with pytest.raises(UsageError, match="masking implicit has no parameter 'k'; there is none"):
        subjects(["implicit:k=1"])
    odd = tmp_path / "my.clh files" / "one.clh.d"
    odd.mkdir(parents=True)
    (odd / "white.clh").write_text(FILES["white"], "utf-8")
    assert subjects([f"{odd}/white.clh:albedo=1"])[0].label == str(odd / "white.clh")
    (odd / "two words.clh").write_text(FILES["white"].replace("white", "two_words"), "utf-8")
    assert subjects([f"{odd}/two words.clh:albedo=1"])[0].model.function == "brdf_two_words_f"


# ---------------------------------------------------------------------------------------------- the command


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        cli.main(["verify", *argv])
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def test_json_rows(capsys: pytest.CaptureFixture[str], files: Path) -> None:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    code, out, _ = run(capsys, "schlick", f"{files}/hole.clh", "--precision", "32", "--json")
    rows = [json.loads(line, parse_constant=refuse) for line in out.splitlines()]
    assert code == 7 and rows[-1]["event"] == "error" and rows[-1]["exit_code"] == 7
    checks = [row for row in rows if row["event"] == "check"]
    wanted = {"model", "check", "parameters", "precision", "value", "expected", "error", "tolerance", "passed"}
    assert len(checks) == len(rows) - 1 and all(wanted <= row.keys() for row in checks)
    (bad,) = [row for row in checks if not row["passed"]]
    assert bad["value"] == "nan" and len(bad["counterexample"]["l"]) == 3 and bad["model"].endswith("hole.clh")


def test_the_table(capsys: pytest.CaptureFixture[str], files: Path) -> None:
    code, out, err = run(capsys, "one", f"{files}/gains.clh", "--precision", "32")
    assert code == 7 and "FAIL" in out and "counterexample: NoV" in out and "l = (" in out
    assert "fresnel one" in out and "1 failed" in out.splitlines()[-1] and "gains.clh, energy: albedo" in err
    code, out, err = run(capsys, "one", "--precision", "32")
    assert code == 0 and not err and "FAIL" not in out
    assert out.splitlines()[-1].startswith("5 checks of 1 model: 5 passed, 0 failed")
    assert run(capsys, "one", "--precision", "32", "--quiet") == (0, "", "")


@pytest.mark.parametrize(
    "argv, code, words",
    [
        (["gxx"], 1, "did you mean 'ggx'"),
        (["one", "--precision", "16"], 1, "32, 64"),
        (["one", "--device", "no such device"], 1, "no such device"),
        (["none.clh"], 2, "none.clh"),
        (["steep.clh"], 3, "cannot be normalized"),
        (["tail.clh", "--precision", "32"], 5, "infinite"),
    ],
)
def test_exit_codes(
    capsys: pytest.CaptureFixture[str],
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    argv: list[str],
    code: int,
    words: str,
) -> None:
    monkeypatch.chdir(files)
    got, _, err = run(capsys, *argv)
    assert got == code and words in err and len(err.splitlines()) == 1
