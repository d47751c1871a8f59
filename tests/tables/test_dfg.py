"""The split-sum table: the kernel with the azimuth in closed form against other forms, and tables as they are read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reference
from whitefurnace import dfg, integrate, lut
from whitefurnace.errors import UsageError
from whitefurnace.opencl.device import Device
from whitefurnace.tables import bilinear
from whitefurnace.tables.axes import Axis, axis


def pair_by_tanh_sinh(NoV: float, alpha: float) -> np.ndarray:
    """(scale, bias) over light directions, by another rule and with D and G in other forms than the kernel's."""

    def D(theta: np.ndarray) -> np.ndarray:  # [Walter2007, eq. 33] in the tangent
        with np.errstate(over="ignore", divide="ignore"):
            t = np.tan(theta)
            return np.where(theta < np.pi / 2, alpha**2 / (np.pi * np.cos(theta) ** 4 * (alpha**2 + t * t) ** 2), 0)

    def area(up: np.ndarray) -> np.ndarray:
        return (np.sin(up) + np.hypot(np.sin(up), alpha * np.cos(up))) / 2

    def V(NoV: Any, NoL: Any, NoH: Any, VoH: Any, at_v: Any, at_l: Any) -> Any:
        return 1 / (NoL * at_v + NoV * (at_l - NoL))

    def part(F: Any) -> float:
        return reference.albedo_by_tanh_sinh(D, V, F, area, NoV)

    return np.array([part(lambda c: 1 - (1 - c) ** 5), part(lambda c: (1 - c) ** 5)])


@pytest.mark.parametrize("precision", [32, 64])
def test_closed_azimuth_against_tanh_sinh(device: Device, precision: int) -> None:
    for NoV, alpha in ((1 / 256, 0.0137), (1 / 64, 0.3), (0.1, 0.02), (0.5, 0.05), (0.5, 1.0), (0.93, 0.6), (1.0, 0.2)):
        got = integrate("dfg", ndf="ggx", NoV=NoV, alpha=alpha, precision=precision, tolerance=1e-6, device=device)
        off = np.abs(got.values - pair_by_tanh_sinh(NoV, alpha)).max()
        # The reference has 2e-8, measured by its own step; the statement must hold beyond that.
        assert off <= got.error + 2e-8 and off <= 2e-6, (NoV, alpha, got.rule, off, got.error)
        assert got.rule.startswith("light-angles")


def test_the_figures_of_a_table(device: Device) -> None:
    """128²: 2e-6 for n·v ≥ 1/64, 1e-5 below, and no more than is stated."""
    got = dfg(128, device=device)
    x = (np.arange(128) + 0.5) / 128
    off = np.zeros(128)
    for row in (0, 1, 2, 5, 9, 20, 41, 63, 90, 119, 127):
        E, Fc = reference.ggx_albedo_1d(x, np.full(128, x[row] ** 2), 64, 80)
        off = np.maximum(off, np.abs(got.values[row] - np.stack([E - Fc, Fc], -1)).max(-1))
    assert off[2:].max() <= 2e-6 and off[:2].max() <= 1e-5 and off.max() <= got.error + 2e-8
    assert got.rule.startswith("light-angles") and got.notices == ()


def test_other_rules_where_the_closed_form_does_not_serve(device: Device) -> None:
    """Nearer to grazing, finer or of other models the half-angle rule; both agree where they meet."""
    ask: Any = lambda **more: integrate("dfg", ndf="ggx", device=device, **{"NoV": 0.5, "alpha": 0.3, **more})  # noqa: E731
    assert ask(NoV=1e-3).rule.startswith("gauss")
    assert ask(precision=64).rule.startswith("gauss")
    assert integrate("dfg", ndf="beckmann", NoV=0.5, alpha=0.3, device=device).rule.startswith("gauss")
    edge = np.array([1 / 512 - 1e-9, 1 / 512])
    both = ask(NoV=edge, alpha=np.array([[0.01], [0.1], [1.0]]))
    # Two rules in float32, 1e-6 each at most; the function itself moves by 1e-9 times a slope of some hundred.
    assert np.abs(np.diff(both.values, axis=1)).max() <= 2 * both.error
    separable = integrate("dfg", ndf="ggx", masking="smith_separable", NoV=0.3, alpha=0.4, device=device)
    fine = integrate("dfg", ndf="ggx", masking="smith_separable", NoV=0.3, alpha=0.4, precision=64, device=device)
    assert separable.rule.startswith("light") and np.abs(separable.values - fine.values).max() <= separable.error


def test_one_lane_gives_the_same(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    NoV, alpha = np.linspace(0.01, 1, 9), np.geomspace(1e-4, 1, 7)[:, None]
    wide = integrate("dfg", ndf="ggx", NoV=NoV, alpha=alpha, device=device)
    monkeypatch.setattr(Device, "lanes", lambda self, precision=32: 1)
    one = integrate("dfg", ndf="ggx", NoV=NoV, alpha=alpha, device=device)
    # The same sums, compiled otherwise: contraction may differ by an ulp a term.
    assert np.abs(one.values - wide.values).max() <= 5e-7


# --- as they are read -------------------------------------------------------------------------------------


def test_reads_are_those_of_a_gpu() -> None:
    """u·N - ½ between texel centres, clamped at the edges, by hand."""
    weights = bilinear.hats(4, np.array([-0.5, 0.0, 0.25, 2.5, 3.0, 3.5]))
    want = [[1, 0, 0, 0], [1, 0, 0, 0], [0.75, 0.25, 0, 0], [0, 0, 0.5, 0.5], [0, 0, 0, 1], [0, 0, 0, 1]]
    assert np.array_equal(weights, want)


def test_what_a_table_can_hold_is_fitted_exactly() -> None:
    rng = np.random.default_rng(3)
    texels = rng.random((5, 7, 2))
    down, across = (bilinear.hats(n, np.linspace(-0.5, n - 0.5, 40)) for n in (5, 7))
    truth = bilinear.read(texels, down, across)
    # A pseudo-inverse of condition 10 in float64.
    assert np.abs(bilinear.fit(truth, down, across, np.ones(40, bool)) - texels).max() <= 1e-12


def test_axis_sqrt() -> None:
    made = axis("NoV", "0:1:5:sqrt")
    assert made.values().tolist() == [0, 1 / 16, 1 / 4, 9 / 16, 1]
    values, at = made.at(np.array([0.0, 0.5, 1.0]))
    assert values.tolist() == [0, 0.25, 1] and at.tolist() == [0, 2, 4]
    for scale in ("linear", "centres", "sqrt", "log"):
        one = Axis("a", 0.5, 2.0, 6, scale)
        share = (np.arange(6) + 0.5) / 6 if scale == "centres" else np.linspace(0, 1, 6)
        values, at = one.at(share)
        assert values == pytest.approx(one.values(), rel=1e-14) and at == pytest.approx(np.arange(6), abs=1e-12)


def read_by_hand(table: np.ndarray, u: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Texels (N, N, 2) at texel coordinates, one point at a time."""
    found = []
    for x, y in zip(u, r, strict=True):
        x, y = (min(max(c, 0), len(table) - 1) for c in (x, y))
        i, j = min(int(x), len(table) - 2), min(int(y), len(table) - 2)
        a, b = x - i, y - j
        found.append(
            (1 - b) * ((1 - a) * table[j, i] + a * table[j, i + 1])
            + b * ((1 - a) * table[j + 1, i] + a * table[j + 1, i + 1])
        )
    return np.array(found)


def test_a_fitted_table_as_read(device: Device, tmp_path: Path) -> None:
    """64² on the root of n·v: at most 5e-3 off as read, by random reads against the 1-D form, as stated."""
    path = tmp_path / "t.npy"
    made = lut("dfg", path, size=64, axes={"NoV": "sqrt"}, fit="bilinear", device=device)
    told = json.loads((tmp_path / "t.npy.json").read_text("utf-8"))["as_read"]
    table = np.load(path).astype(np.float64)
    rng = np.random.default_rng(11)
    share, r = rng.random(3000), rng.uniform(bilinear.LEAST, 1, 3000)
    E, Fc = reference.ggx_albedo_1d(np.maximum(share**2, 1e-6), r * r)
    truth = np.stack([E - Fc, Fc], -1)
    off = np.abs(read_by_hand(table, share * 63, r * 64 - 0.5) - truth)
    assert off.max() <= 5e-3
    # 3000 random points hardly find a worse one than 10⁵ on a lattice did; the 1-D form has 1e-5 below n·v = 1e-3.
    assert off.max() <= 1.05 * told["between"]["float32"]["max"] + 1e-5
    assert abs(np.quantile(off, 0.99) / told["between"]["float32"]["p99"] - 1) <= 0.3  # of 3000
    plain = lut("dfg", tmp_path / "p.npy", size=64, as_read=True, device=device).manifest["as_read"]
    assert told["between"]["float32"]["max"] < plain["between"]["float32"]["max"] / 5
    assert plain["centres"]["max"] == 0 and set(plain["between"]) == {"float32", "float16", "r8"}
    # Half an ulp of float16 below 1, and half a step of 8 bits, is what they may add.
    for name, step in (("float16", 2**-12), ("r8", 0.5 / 255)):
        assert abs(plain["between"][name]["max"] - plain["between"]["float32"]["max"]) <= step + 1e-12
    assert made.axes[0] == Axis("NoV", 0, 1, 64, "sqrt")


@pytest.mark.parametrize(
    "options, words",
    [
        ({"fit": "bilnear"}, "bilinear"),
        ({"fit": "bilinear", "NoV": 0.5}, "two axes"),
        ({"as_read": True, "size": 1024}, "512"),
        ({"axes": {"NoV": "sqrt"}, "NoV": 0.5}, "no default axis"),
        ({"axes": {"NoV": "log"}}, "log"),
        ({"scheme": "turquin"}, "unknown scheme 'turquin'"),
    ],
)
def test_refusals(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        lut("dfg", tmp_path / "t.npy", **options)
