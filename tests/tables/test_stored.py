"""Tables as textures and as C: what is read back is what was written, to the step of the format, and is told so."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from whitefurnace import lut
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.files import decode, read_texture
from whitefurnace.files.tables import identifier, write_table
from whitefurnace.opencl.device import Device

STEPS = {"r16": 0.5 / 65535, "r8": 0.5 / 255, "rg16f": 2.0**-12, "rgba16f": 2.0**-12, "rgba32f": 0.0}
"""Half a step, of floats below 1 half an ulp."""


def read(path: Path) -> np.ndarray:
    if path.suffix == ".png":
        source = oiio.ImageInput.open(str(path))
        largest = 65535 if str(source.spec().format) == "uint16" else 255
        pixels = np.asarray(source.read_image(source.spec().format)).astype(np.float64) / largest
        source.close()
        return pixels
    if path.suffix == ".h":
        text = path.read_text("utf-8")
        shape = [int(n) for n in re.findall(r"\[(\d+)\]", text)]
        numbers = re.findall(r"-?[\d.]+(?:e[-+]\d+)?(?=f\b)", text.split("= {\n")[1])
        return np.array(numbers, np.float32).reshape(shape)
    return np.asarray(decode(read_texture(path), 0))


@pytest.mark.parametrize(
    "name, stored",
    [
        ("t.png", None),
        ("t.png", "r8"),
        ("t.ktx2", None),
        ("t.ktx2", "rgba16f"),
        ("t.dds", "rgba32f"),
        ("t.dds", None),
        ("t.h", None),
    ],
)
@pytest.mark.parametrize("kind", ["dfg", "albedo", "glass"])
def test_what_is_stored_is_read(device: Device, tmp_path: Path, kind: str, name: str, stored: str | None) -> None:
    options: dict[str, Any] = {"size": (6, 4), "tolerance": 2e-5, "device": device}
    if kind == "glass":
        if name == "t.png":
            options |= {"ior": 1.5}
        else:
            options |= {"axes": {"ior": (1, 2, 3, "f0")}}
    lut(kind, tmp_path / "t.npy", **options)
    made = lut(kind, tmp_path / name, stored=stored, **options)
    want = np.load(tmp_path / "t.npy")
    want = want[..., None] if kind == "albedo" else want
    told = made.manifest["stored"]
    assert told["format"] == (stored or {".png": "r16", ".h": "float32"}.get(Path(name).suffix, "rg16f"))
    back = read(tmp_path / name)
    back = back.reshape(*want.shape[:-1], -1)
    assert np.abs(back[..., : want.shape[-1]] - want).max() == pytest.approx(told["error"], abs=1e-9)
    assert told["error"] <= STEPS.get(told["format"], 0.0) + 1e-12
    # What the format has more: zeros, and an alpha of 1.
    extra = back[..., want.shape[-1] :]
    assert (extra[..., : 3 - want.shape[-1]] == 0).all() and (back.shape[-1] < 4 or (back[..., 3] == 1).all())
    assert lut(kind, tmp_path / name, stored=stored, **options).state == "skipped"


def test_the_layers_of_a_texture_are_its_third_axis(device: Device, tmp_path: Path) -> None:
    made = lut("glass", tmp_path / "g.ktx2", size=(6, 4), axes={"ior": (1, 2, 3, "f0")}, device=device)
    texture = read_texture(tmp_path / "g.ktx2")
    assert (texture.layers, texture.height, texture.width, texture.format) == (3, 4, 6, "rg16f")
    assert b"transmitted" in texture.key_values["whitefurnace:channels"]
    assert made.manifest["format"] == ".ktx2" and made.manifest["stored_format"] == "rg16f"


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_a_header_compiles(device: Device, tmp_path: Path) -> None:
    """With no warning, and the compiler's own last value is the table's."""
    lut("glass", tmp_path / "1 glass.h", size=4, axes={"ior": (1, 2, 3, "f0")}, device=device)
    lut("glass", tmp_path / "g.npy", size=4, axes={"ior": (1, 2, 3, "f0")}, device=device)
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "1 glass.h"\nint main(void) {\n'
        '  printf("%.9g %zu", table_1_glass[2][3][1][0], sizeof table_1_glass);\n}\n'
    )
    subprocess.run(["cc", "-Wall", "-Wextra", "-Werror", "main.c", "-o", "main"], cwd=tmp_path, check=True)
    said = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True).stdout.split()
    assert np.float32(said[0]) == np.load(tmp_path / "g.npy")[2, 3, 1, 0] and int(said[1]) == 4 * 3 * 4 * 4 * 2


def test_names_of_c() -> None:
    assert [identifier(s) for s in ("dfg", "a-b c", "2d", "default", "é")] == [
        "dfg",
        "a_b_c",
        "table_2d",
        "table_default",
        "table__",
    ]


def test_refusals(device: Device, tmp_path: Path) -> None:
    ask: Any = lambda name, kind="dfg", **more: lut(kind, tmp_path / name, size=4, device=device, **more)  # noqa: E731
    for error, words, arguments, more in (
        (UnsupportedError, r"do not fit in \[0, 1\]", ("t.png", "projected_area"), {"ndf": "charlie"}),
        (UsageError, "PNG holds two axes", ("t.png", "glass"), {}),
        (UsageError, "did you mean 'rg16f'", ("t.ktx2",), {"stored": "rg16"}),
        (UsageError, "holds the values as they are", ("t.h",), {"stored": "rg16f"}),
        (UsageError, "precision 64", ("t.dds",), {"precision": 64}),
        (UnsupportedError, "2 channels at most", ("t.dds", "albedo"), {"fresnel": "schlick:gold", "stored": "rg16f"}),
        (UsageError, "is written as", ("t.tga",), {}),
    ):
        with pytest.raises(error, match=words):
            ask(*arguments, **more)
    for values, words in ((np.full((2, 2, 1), 1e5), "end[s]? at 65504"), (np.full((2, 2, 1), np.inf), "not finite")):
        with pytest.raises(UnsupportedError, match=words):
            write_table(tmp_path / "t.ktx2", values, "rg16f")
    assert list(tmp_path.iterdir()) == []
