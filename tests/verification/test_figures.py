"""Figures: there for a model of every slot and for a user's, the same bytes twice, a clear word without the extra."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from whitefurnace import plot_style
from whitefurnace.catalogue import Model, model
from whitefurnace.catalogue.user import user_model
from whitefurnace.errors import FileError, UnsupportedError
from whitefurnace.files import read_image
from whitefurnace.opencl.device import Device
from whitefurnace.verification import figures
from whitefurnace.verification.checks import Row

LOBE = "real ndf_lobe_D(real cos_m, real spread) { return exp((cos_m - 1) / (spread * spread)); }\n"
BARE = "real ndf_bare_D(real cos_m) { return cos_m * cos_m; }\n"
STEEP = "real ndf_steep_D(real cos_m) { return 1 / (cos_m * sqrt(cos_m)); }\n"  # ∫ D(m)(v·m)₊ dω is infinite
PAINT = """real3 brdf_paint_f(real3 l, real3 v, real gloss) {
  const real x = l.x + v.x, y = l.y + v.y, z = l.z + v.z;
  const real c = pow(fmax(z / sqrt(x * x + y * y + z * z), (real)0), 2 / (gloss * gloss));
  return vec3(c + (scalar)0.2, c + (scalar)0.1, c + (scalar)0.05);
}
"""


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer pixels: what is looked at here does not need them."""
    monkeypatch.setattr(plot_style, "DPI", 40)


def row(entry: Model, passed: bool = True, **parameters: float) -> Row:
    return Row(entry.slot, entry.path or entry.name, "normalization", parameters, 32, 1.0, 1.0, 0.0, 1e-6, passed, 1)


def user(folder: Path, slot: str, name: str, text: str) -> Model:
    path = folder / f"{name}.clh"
    path.write_text(text, "utf-8")
    return user_model(slot, path)


def colours(path: Path) -> int:
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n"), path
    pixels = read_image(path).pixels
    return len(np.unique(np.round(pixels.reshape(-1, pixels.shape[-1]), 3), axis=0))


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "slot, name",
    [
        ("ndf", "gtr"),
        ("ndf", "beckmann_anisotropic"),
        ("masking", "schlick_smith"),
        ("fresnel", "schlick"),
        ("fresnel", "dielectric"),
        ("fresnel", "one"),
        ("diffuse", "minnaert"),
    ],
)
def test_a_figure_a_model(device: Device, tmp_path: Path, slot: str, name: str) -> None:
    entry = model(slot, name)
    path = tmp_path / "figures" / f"{slot}_{name}.png"
    assert figures.draw(path.parent, [entry], [row(entry)], device) == [path]
    assert [p.name for p in (tmp_path / "figures").iterdir()] == [f"{slot}_{name}.png"]
    assert colours(tmp_path / f"figures/{slot}_{name}.png") > 20


@pytest.mark.parametrize(
    "slot, name, text, parameters",
    [
        pytest.param("ndf", "lobe", LOBE, {"spread": 0.3}, id="lobe", marks=pytest.mark.long),
        pytest.param("ndf", "lobe", LOBE, {}, id="lobe-guessed", marks=pytest.mark.long),
        pytest.param("ndf", "bare", BARE, {}, id="bare"),
        pytest.param("ndf", "steep", STEEP, {}, id="steep", marks=pytest.mark.long),
        pytest.param("brdf", "paint", PAINT, {"gloss": 0.4}, id="brdf"),
    ],
)
def test_a_users_model(
    device: Device, tmp_path: Path, slot: str, name: str, text: str, parameters: dict[str, float]
) -> None:
    """With the parameters of its rows, or with guesses; a panel that a model has no values for says why."""
    entry = user(tmp_path, slot, name, text)
    written = figures.draw(tmp_path, [entry], [row(entry, **parameters)] if parameters else [], device)
    assert written == [tmp_path / f"{slot}_{name}.png"] and colours(written[0]) > 20


def test_values_are_those_of_the_rows(tmp_path: Path) -> None:
    """One value, though a row of float32 has it rounded; of several, each; an entry's own are its typical ones."""
    entry = user(tmp_path, "ndf", "lobe", LOBE)
    rows = [row(entry, spread=v) for v in (0.3, float(np.float32(0.3)))]
    assert figures._values(entry, rows) == {"spread": (0.3,)}
    assert figures._values(entry, [*rows, row(entry, spread=0.5)]) == {"spread": (0.3, 0.5)}
    ggx = model("ndf", "ggx")
    assert figures._values(ggx, [row(ggx, alpha=0.123)]) == {"alpha": ggx.parameters[0].typical}


def test_names_do_not_clash(device: Device, tmp_path: Path) -> None:
    mine, theirs = model("fresnel", "one"), model("fresnel", "one")
    written = figures.draw(tmp_path, [mine, theirs], [], device)
    assert [p.name for p in written] == ["fresnel_one.png", "fresnel_one_2.png"]


def test_the_same_bytes_twice_and_a_verdict(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib

    entry = model("diffuse", "burley")
    (first,) = figures.draw(tmp_path / "a", [entry], [row(entry)], device)
    monkeypatch.setitem(matplotlib.rcParams, "lines.linewidth", 9)  # somebody's matplotlibrc
    (second,) = figures.draw(tmp_path / "b", [entry], [row(entry)], device)
    assert first.read_bytes() == second.read_bytes()
    assert matplotlib.rcParams["lines.linewidth"] == 9
    assert b"tEXt" not in first.read_bytes() and b"tIME" not in first.read_bytes()
    (failed,) = figures.draw(tmp_path / "c", [entry], [row(entry, passed=False)], device)
    assert failed.read_bytes() != first.read_bytes()


def test_no_half_file(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.figure import Figure

    def fails(self: Figure, to: Path, **options: object) -> None:
        Path(to).write_bytes(b"\x89PNG")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", fails)
    with pytest.raises(FileError, match=r"fresnel_one\.png: No space left"):
        figures.draw(tmp_path, [model("fresnel", "one")], [], device)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    with pytest.raises(FileError, match="cannot make"):
        figures.draw(tmp_path / "file", [model("fresnel", "one")], [], device)


def test_without_matplotlib(tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(UnsupportedError) as caught:
        figures.draw(tmp_path / "figures", [model("ndf", "ggx")], [], device)
    assert str(caught.value) == 'figures need matplotlib: pip install "whitefurnace[plot]"'
    assert not (tmp_path / "figures").exists()
