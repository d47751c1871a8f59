"""Assembled kernel text: the tables of programs and of functions agree with the kernel files, and constants of the host
reach the text."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path

import pytest

from whitefurnace.catalogue import INTEGRALS, SLOTS, Model, models
from whitefurnace.catalogue.user import user_model
from whitefurnace.opencl import constants, source
from whitefurnace.opencl.bindings import FUNCTIONS, SELF_CONTAINED, VECTOR
from whitefurnace.opencl.device import Device

KERNELS = resources.files("whitefurnace.kernels")
MODELS = [entry for slot in SLOTS for entry in models(slot).values()]


def text_of(name: str) -> str:
    return (KERNELS / name).read_text("utf-8")


@pytest.mark.parametrize("entry", MODELS, ids=[f"{m.slot}-{m.name}" for m in MODELS])
def test_models_have_the_functions_that_they_provide(entry: Model) -> None:
    """The signature in the kernel file begins with the parameters of the table, then has the model's numbers."""
    for function in entry.provides:
        name = f"{entry.slot}_{entry.name}_{FUNCTIONS[function].ending}"
        found = re.search(rf"\b{name}\(([^)]*)\)", text_of(entry.kernel_file))
        assert found, f"{entry.kernel_file} has no {name}"
        taken = [item.split() for item in found[1].split(",") if item.strip()]
        kinds = FUNCTIONS[function].kinds(entry.isotropic)
        if entry.slot in SELF_CONTAINED:
            wanted = [
                *("real3" if kind is VECTOR else "real" for kind in kinds),
                *("real" for _ in entry.passed(function)),
            ]
            assert [words[0] for words in taken if words != ["void"]] == wanted, f"{name}({found[1]})"


def test_every_program_is_made_of_files_that_exist() -> None:
    known = {"kind": ("latlong", "cube"), "integral": (*INTEGRALS, "lobe"), "file": ("dfg_ggx.cl",)}
    used = set()
    for name, row in source.PROGRAMS.items():
        for piece in row.pieces:
            if piece.startswith("<"):
                assert ("<bindings>" in row.pieces) == bool(row.slots), name
                continue
            word = re.search(r"{(\w+)}", piece)
            files = [piece] if word is None else [piece.format(**{word[1]: value}) for value in known[word[1]]]
            used |= {file for file in files if (KERNELS / file).is_file()}
            assert word or files[0] in used, f"{name}: {piece}"
    there = {path.relative_to(Path(str(KERNELS))).as_posix() for path in Path(str(KERNELS)).rglob("*.cl*")}
    generated = {entry.kernel_file for entry in MODELS} | {"special.clh", "user.clh", "area_table.clh", "probe.cl"}
    assert there == used | generated


@pytest.mark.parametrize(
    ("constant", "programs"),
    [
        ("ORDER", ("interpolation", "texels")),
        ("BEYOND", ("interpolation", "texels")),
        ("PATCH", ("texels",)),
        ("TAPS", ("texels",)),
        ("RUN", ("octahedral",)),
        ("TILE", ("octahedral",)),
        ("RUN_EDGE", ("octahedral",)),
        ("TILE_EDGE", ("octahedral",)),
    ],
)
def test_a_constant_of_the_host_is_the_kernels(
    constant: str, programs: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A changed constant changes the text of every program that uses it, and no kernel file states it."""

    def texts() -> dict[str, source.Source]:
        row = {"interpolation": "interpolation", "octahedral": "convolution by the symmetries of the cube"}
        return {
            name: source.assembled(row[name]) if name in row else source.assembled("nodes and harmonics", kind="cube")
            for name in programs
        }

    before, digest = texts(), source.everything.__wrapped__()
    value = getattr(constants, constant)
    for found in before.values():
        assert re.findall(rf"^#define {constant} (\d+)$", found.text, re.MULTILINE) == [str(value)]
    monkeypatch.setattr(constants, constant, value + 2)
    for name, found in texts().items():
        assert f"#define {constant} {value + 2}\n" in found.text
        assert found.text != before[name].text and found.digest != before[name].digest
    assert source.everything.__wrapped__() != digest
    piece = "<classes>" if programs == ("octahedral",) else "<grid>"
    used = {
        file
        for row in source.PROGRAMS.values()
        if piece in row.pieces
        for file in row.pieces
        if not re.search("[<{]", file)
    }
    for file in used:
        assert not re.search(rf"#define {constant}\b", text_of(file)), file


def test_programs_build_with_other_constants(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """No kernel relies on the value of a constant that it is told."""
    monkeypatch.setattr(constants, "RUN", 2 * constants.RUN)
    monkeypatch.setattr(constants, "PATCH", constants.PATCH // 2)
    monkeypatch.setattr(constants, "BEYOND", constants.BEYOND + 2)
    options = {"W": device.lanes(32), "T": 1, "PRECISION": 32}
    device.build(source.assembled("convolution by the symmetries of the cube").text, {**options, "PERMS": 6})
    device.build(source.assembled("nodes and harmonics", kind="latlong").text, {**options, "W": 1})


def test_the_text_of_a_program_is_kept_for_its_very_model(tmp_path: Path) -> None:
    """Two user models of one name are two keys."""
    found = []
    for k in range(2):
        folder = tmp_path / str(k)
        folder.mkdir()
        (folder / "mine.clh").write_text(f"real ndf_mine_D(real cos_m) {{ return {k + 1}.0f; }}\n")
        found.append(source.convolution(user_model("ndf", folder / "mine.clh")))
    assert found[0].digest != found[1].digest
    ggx = models("ndf")["ggx"]
    assert source.convolution(ggx) is source.convolution(ggx)
