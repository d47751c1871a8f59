"""Tables of energy: the furnace by an independent quadrature, the three schemes, sheen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reference
from whitefurnace import integrate, lut
from whitefurnace.catalogue import model
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.opencl.device import Device
from whitefurnace.tables import energy


def centres(n: int) -> np.ndarray:
    return (np.arange(n) + 0.5) / n


def lost_by_1d(NoV: np.ndarray, alpha: float) -> np.ndarray:
    """1 - E of GGX by the 1-D form, which shares no rule with the tables'."""
    return 1 - reference.ggx_albedo_1d(NoV, np.full(len(NoV), alpha), 120, 2)[0]


@pytest.mark.parametrize(
    "n, axes",
    [
        pytest.param(16, {}, id="centres"),
        pytest.param(32, {}, id="centres of 32", marks=pytest.mark.long),
        pytest.param(32, {"NoV": "sqrt"}, id="sqrt", marks=pytest.mark.long),
    ],
)
def test_kulla_conty_comes_out_of_the_furnace_at_one(
    device: Device, tmp_path: Path, n: int, axes: dict[str, str]
) -> None:
    """∫ (f + f_ms)(n·l) dω = 1 to 1e-4 at texel centres, f and E(l) by the 1-D form, the rest from the table."""
    made = lut("energy", tmp_path / "e.npy", size=n, axes=axes, device=device)
    table = np.load(tmp_path / "e.npy").astype(np.float64)
    assert table.shape == (n, n, 2) and made.manifest["channels"] == ["1 - E", "1 - E_avg"]
    NoV = np.linspace(0, 1, n) ** 2 if axes else centres(n)
    some = NoV >= 1e-3  # below, the 1-D form itself is off by up to 1e-4
    x, w = reference.gauss(160)
    worst = 0.0
    for row in range(n):
        alpha = centres(n)[row] ** 2
        single = 1 - lost_by_1d(NoV[some], alpha)
        lobe = (lost_by_1d(x**4, alpha) * 8 * w * x**7).sum()  # ∫ (1 - E(l)) (n·l) dω / π, μ = x⁴
        many = table[row, some, 0] * lobe / table[row, some, 1]
        worst = max(worst, float(np.abs(single + many - 1).max()))
    assert worst <= 1e-4, worst
    assert made.manifest["furnace"] <= 1e-4 and made.manifest["non_reciprocity"] == 0
    assert set(made.manifest["deviation"].values()) == {0.0}


def test_the_other_schemes_say_how_far_they_are(device: Device, tmp_path: Path) -> None:
    n = 16
    found = {}
    for scheme in ("turquin", "fdez_aguera"):
        path = tmp_path / f"{scheme}.npy"
        found[scheme] = (
            np.load(path) if lut("energy", path, size=n, scheme=scheme, device=device) else None,
            lut("energy", path, size=n, scheme=scheme, device=device).manifest,
        )
    E = np.stack([1 - lost_by_1d(centres(n), r**2) for r in centres(n)])
    table, told = found["turquin"]
    # The 1-D form has 1e-7 here; 1/E - 1 has as much, E ≥ .5.
    assert np.abs(table[..., 0] - E).max() <= 1e-6 and np.abs(table[..., 1] - (1 / E - 1)).max() <= 4e-6
    assert told["furnace"] <= 1e-6
    assert told["non_reciprocity"] == pytest.approx((1 - E.min(1) / E.max(1)).max(), abs=1e-5)
    assert 1e-4 < told["deviation"]["0.5"] < 0.2  # it multiplies by F0 where light that bounces twice has F0²
    table, told = found["fdez_aguera"]
    pairs = integrate("dfg", ndf="ggx", NoV=centres(n), alpha=centres(n)[:, None] ** 2, tolerance=5e-6, device=device)
    assert np.array_equal(table, pairs.values)
    lost = 1 - E
    assert told["non_reciprocity"] == pytest.approx((1 - lost.min(1) / lost.max(1)).max(), abs=1e-2)
    assert told["furnace"] <= 1e-5 and told["deviation"]["1"] <= 1e-5 < told["deviation"]["0.5"]


def test_sheen(device: Device, tmp_path: Path) -> None:
    """E of Charlie against tanh-sinh, and its average as twice the moment of what the table's own row says."""
    made = lut("sheen", tmp_path / "s.npy", size=16, tolerance=1e-5, device=device)
    table = np.load(tmp_path / "s.npy")
    entry, smith = model("ndf", "charlie"), model("masking", "smith")
    assert table.shape == (16, 16, 2) and made.manifest["channels"] == ["E", "E_avg"]
    for row, column in ((4, 0), (8, 3), (8, 12), (15, 8)):
        alpha = centres(16)[row] ** 2

        def D(theta: np.ndarray, alpha: float = alpha) -> np.ndarray:
            return entry.reference["D"](theta, alpha=alpha)  # type: ignore[no-any-return]

        want = reference.albedo_by_tanh_sinh(
            D,
            smith.reference["V"],
            lambda c: 1.0,
            lambda up, D=D: reference.smith_area(D, up),
            float(centres(16)[column]),
        )
        # The tolerance asked for, doubled: the statement holds float32's rounding too.
        assert abs(table[row, column, 0] - want) <= 2e-5, (row, column, want)
    x, w = reference.gauss(48)
    row = integrate("albedo", ndf="charlie", NoV=x**2, alpha=centres(16)[8] ** 2, tolerance=1e-6, device=device).values
    assert abs(table[8, 0, 1] - (row * 4 * w * x**3).sum()) <= 2e-5
    assert np.ptp(table[..., 1], axis=1).max() == 0 and made.manifest["largest"] <= 1


@pytest.mark.few(1)
@pytest.mark.parametrize("ndf, masking", [("beckmann", "smith"), ("gtr:gamma=1.7", "smith_separable")])
def test_any_ndf_has_its_compensation(device: Device, tmp_path: Path, ndf: str, masking: str) -> None:
    made = lut("energy", tmp_path / "e.npy", size=6, ndf=ndf, masking=masking, device=device)
    assert made.manifest["furnace"] <= 1e-4
    E = integrate("albedo", ndf=ndf, masking=masking, NoV=centres(6), alpha=centres(6)[:, None] ** 2, device=device)
    assert np.abs(1 - np.load(tmp_path / "e.npy")[..., 0] - E.values).max() <= 1e-6 + E.error


def test_fresnel_average(device: Device, tmp_path: Path) -> None:
    """Schlick's in closed form, and the dielectric's from either side: by reciprocity and total reflection the light
    that enters is the same, 1 - F_avg(1/n) = (1 - F_avg(n))/n²."""
    lut("fresnel_average", tmp_path / "s.npy", size=9, precision=64, device=device)
    f0 = np.linspace(0, 1, 9)
    assert np.abs(np.load(tmp_path / "s.npy")[0] - (f0 + (1 - f0) / 21)).max() <= 1e-13  # ∫ 2μ (1 - μ)⁵ dμ = 1/21
    sides = []
    for name, axis in (("in", (1.0, 3.0, 9)), ("out", None)):
        n = np.linspace(1, 3, 9)
        values = []
        for k in range(9) if axis is None else range(1):
            path = tmp_path / f"{name}{k}.npy"
            ior = axis or (1 / n[k], 1.0, 2)
            made = lut("fresnel_average", path, fresnel="dielectric", axes={"ior": ior}, precision=64, device=device)
            values += np.load(path)[0].tolist()[: None if axis else 1]
            assert made.manifest["error"] <= 1e-11
        sides.append(np.array(values))
    # Gauss panels, halved down to 2⁻³⁰ at the critical angle.
    assert np.abs((1 - sides[0]) / n**2 - (1 - sides[1])).max() <= 1e-11
    gold = lut("fresnel_average", tmp_path / "g.npy", fresnel="schlick", axes={"f0": (0, 1, 3)}, device=device)
    assert gold.shape == (1, 3) and gold.manifest["error"] <= 2e-7
    with pytest.raises(UnsupportedError, match="alone"):
        lut("fresnel_average", tmp_path / "x.npy", ndf="ggx", device=device)


def test_refusals(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ask: Any = lambda kind, **more: lut(kind, tmp_path / "t.npy", size=4, device=device, **more)  # noqa: E731
    with pytest.raises(UsageError, match="turquin"):
        ask("energy", scheme="turkin")
    with pytest.raises(UsageError, match="no scheme"):
        ask("sheen", scheme="turquin")
    with pytest.raises(UnsupportedError, match="Fresnel"):
        ask("energy", fresnel="schlick:gold")
    # No pair of the catalogue makes energy: one is made up.
    true = energy.integrate
    monkeypatch.setattr(energy, "integrate", lambda *a, **k: replace((r := true(*a, **k)), values=r.values * 1.5))
    with pytest.raises(UnsupportedError, match="no energy is lost that could be restored"):
        ask("energy", tolerance=1e-3)
    assert list(tmp_path.iterdir()) == []
