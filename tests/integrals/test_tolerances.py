"""Relative tolerances, and the errors that results state cell by cell."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reference
import whitefurnace as wf
from whitefurnace import dfg, integrate
from whitefurnace.errors import UsageError
from whitefurnace.opencl.device import Device

NOV = np.array([1 / 64, 0.1, 0.5, 0.9, 1.0])
ALPHA = np.array([0.05, 0.2, 1.0])[:, None]
SKY = np.array([[[0.2, 0.4, 0.1]] * 8] * 4, np.float32) * np.array([3, 1, 1, 0.1], np.float32)[:, None, None]

CASES: dict[str, dict[str, Any]] = {
    "normalization": {"alpha": ALPHA[:, 0]},
    "projected_area": {"NoV": NOV, "alpha": ALPHA},
    "weak_furnace": {"NoV": NOV, "alpha": ALPHA},
    "albedo": {"NoV": NOV, "alpha": ALPHA, "diffuse": "burley", "albedo": 0.5, "roughness": 0.4},
    "albedo_average": {"alpha": ALPHA[:, 0]},
    "dfg": {"NoV": NOV, "alpha": ALPHA},
    "ambient": {"light": "ambient", "NoV": NOV, "alpha": ALPHA, "radiance": 3.0},
    "punctual": {"light": "punctual", "NoV": NOV, "alpha": ALPHA, "NoL": 0.6},
    "disc": {"light": "disc:center_x=.3,center_y=0,center_z=2,radius=.4", "NoV": NOV, "alpha": ALPHA},
    "environment": {"environment": SKY, "NoV": NOV[::2], "alpha": 0.4},
}


@pytest.mark.parametrize("name", CASES)
def test_every_cell_states_its_own_error(device: Device, name: str) -> None:
    """A cell is off by no more than its own error, against the same integral in float64 to a tighter tolerance."""
    given, integral = CASES[name], name if name in ("dfg", *list(CASES)[:5]) else "radiance"
    ask: Any = partial(integrate, integral, ndf="ggx", device=device, **given)
    got = ask(tolerance=1e-3)
    grid = np.broadcast_shapes(*(np.shape(v) for k, v in given.items() if k != "environment"))
    assert got.errors.shape == grid and got.values.shape[: len(grid)] == grid
    # The total counts the rounding of values as they are stored, a cell's before.
    assert 0 < got.errors.max() <= got.error * (1 + 1e-6)
    if not device.fp64:
        return
    want = ask(precision=64, tolerance=1e-6)
    off = np.abs(got.values - want.values).reshape(*grid, -1).max(-1)
    assert (off <= got.errors + want.error).all(), (off / got.errors).max()


def scaled(factor: float, **given: Any) -> Any:
    """E of GGX times a Fresnel term that is `factor` everywhere."""
    NoV, alpha = np.broadcast_arrays(NOV, ALPHA)
    return integrate(
        "albedo", ndf="ggx", fresnel=f"schlick:f0={factor!r},f90={factor!r}", NoV=NoV, alpha=alpha, **given
    )


@pytest.mark.parametrize("factor", [1.0, 1e-3, 1e-7])
@pytest.mark.parametrize("relative", [1e-2, 1e-4])
def test_a_relative_tolerance_holds_for_small_values(device: Device, factor: float, relative: float) -> None:
    """Against the 1-D form of GGX's albedo in float64, which is good to 2e-8 (`reference.ggx_albedo_1d`)."""
    NoV, alpha = np.broadcast_arrays(NOV, ALPHA)
    E = reference.ggx_albedo_1d(NoV.ravel(), alpha.ravel(), 160, 120)[0].reshape(NoV.shape) * factor
    got = scaled(factor, relative_tolerance=relative, device=device)
    # float32 holds the factor itself to 6e-8.
    assert (np.abs(got.values - E) <= (relative + 1e-7) * E).all()
    assert (np.abs(got.values - E) <= got.errors + 1e-7 * E).all()
    assert (got.errors <= 1.01 * relative * E).all()
    assert not got.notices


def test_the_work_follows_the_share_and_not_the_size(device: Device) -> None:
    """A factor changes no rule of a relative tolerance; an absolute one is met at once by small values."""
    coarse, fine = (scaled(1e-7, relative_tolerance=t, device=device).evaluations for t in (1e-2, 1e-5))
    assert coarse < fine == scaled(1.0, relative_tolerance=1e-5, device=device).evaluations
    assert scaled(1e-7, tolerance=1e-2, device=device).evaluations < fine


def test_the_larger_of_both_tolerances_holds(device: Device) -> None:
    both = scaled(1e-7, relative_tolerance=1e-5, tolerance=1e-2, device=device)
    assert both.evaluations == scaled(1e-7, tolerance=1e-2, device=device).evaluations


def test_values_of_0_are_within_any_share(device: Device) -> None:
    got = scaled(0.0, relative_tolerance=1e-4, device=device)
    assert (got.values == 0).all() and got.error == 0 and not got.notices


def test_a_missed_share_is_said(device: Device) -> None:
    if not device.fp64:
        pytest.skip("no float64")
    got = integrate(
        "albedo", ndf="ggx:alpha=.3", masking="kelemen", NoV=1e-3, relative_tolerance=1e-13, precision=64, device=device
    )
    assert any("relative tolerance of 1e-13" in notice for notice in got.notices), got.notices


def test_errors_go_where_they_are_asked(device: Device) -> None:
    NoV = np.linspace(0.1, 1, 300)
    ask: Any = partial(integrate, "dfg", ndf="ggx", alpha=0.3, NoV=NoV, device=device)
    errors, out = np.empty(300, np.float32), np.empty((300, 2), np.float32)
    assert ask(out=out).errors is None
    got = ask(out=out, out_errors=errors)
    assert got.errors is errors and np.allclose(errors, ask().errors, rtol=1e-6)
    with pytest.raises(UsageError, match="out_errors"):
        ask(out_errors=np.empty((300, 2)))


@pytest.mark.parametrize(
    "given, words",
    [
        ({"relative_tolerance": 0.0}, r"\(0, 1\)"),
        ({"relative_tolerance": float("nan")}, r"\(0, 1\)"),
        ({"relative_tolerance": "fine"}, r"\(0, 1\)"),
        ({"tolerance": 0.0}, r"\(0, 1\)"),
        ({"rtol": 1e-3}, "relative_tolerance"),
        ({"epsabs": 1e-3}, "called tolerance"),
    ],
    ids=str,
)
def test_what_is_no_tolerance(device: Device, given: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        integrate("albedo", ndf="ggx", NoV=0.5, alpha=0.3, device=device, **given)


def test_tables(device: Device, tmp_path: Path) -> None:
    loose = dfg(4, relative_tolerance=1e-2, device=device)
    assert (loose.errors[..., None] <= 1.01e-2 * loose.values.max(-1, keepdims=True)).all()
    path, options = tmp_path / "a.npy", {"size": 4, "alpha": 0.3, "device": device}
    made: Any = partial(wf.lut, "albedo", path, axes={"NoV": (0.1, 1.0, 4)}, alpha=0.3, device=device)
    assert made(relative_tolerance=1e-3).state == "done"
    told = json.loads(path.with_name("a.npy.json").read_text())
    assert told["relative_tolerance"] == 1e-3 and told["tolerance"] == 0
    assert made(relative_tolerance=1e-3).state == "skipped" and made(tolerance=1e-3).state == "done"
    assert "relative_tolerance" not in json.loads(path.with_name("a.npy.json").read_text())
    with pytest.raises(UsageError, match="ltc has no relative tolerance"):
        wf.lut("ltc", tmp_path / "ltc.npy", relative_tolerance=1e-3, **options)
