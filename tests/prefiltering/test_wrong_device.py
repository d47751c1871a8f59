"""A certificate that misses since a driver computes wrongly names the device and the result, not the grid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import whitefurnace as wf
from whitefurnace.errors import CheckError, DeviceError
from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering import levels
from whitefurnace.prefiltering.convolution import Convolver

SKY = np.random.default_rng(3).random((32, 64, 3), np.float32) + np.float32(0.1)
SUN = SKY.copy()
SUN[8, 20] = 3e4


def ask(device: Device, texels: np.ndarray = SKY) -> Any:
    return wf.prefilter(texels, size=8, min_size=4, tolerance=1e-3, device=device)


@pytest.mark.parametrize("texels", [SKY, SUN, np.stack([SKY[:16, :16]] * 6)], ids=["sky", "sun", "cube"])
def test_a_wrong_convolution_names_the_device(
    device: Device, monkeypatch: pytest.MonkeyPatch, texels: np.ndarray
) -> None:
    right = Convolver.convolve
    monkeypatch.setattr(Convolver, "convolve", lambda self, *given: right(self, *given) * np.float32(1.3))
    with pytest.raises(DeviceError, match="computes wrongly: the convolution") as caught:
        ask(device, texels)
    assert device.name in str(caught.value) and device.driver in str(caught.value) and caught.value.exit_code == 4


def test_a_wrong_exact_integral_names_the_device(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    right = Convolver.exact
    monkeypatch.setattr(Convolver, "exact", lambda self, *given: [1.3 * values for values in right(self, *given)])
    grid = Convolver.on_grid
    monkeypatch.setattr(Convolver, "on_grid", lambda self, *given: 1.3 * grid(self, *given))
    with pytest.raises(DeviceError, match="computes wrongly: the exact integral"):
        ask(device)


def test_a_result_that_is_not_finite_names_the_device(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    right = Convolver.convolve
    monkeypatch.setattr(Convolver, "convolve", lambda self, *given: right(self, *given) * np.float32(np.nan))
    with pytest.raises(DeviceError, match="computes wrongly: the convolution"):
        ask(device)


def test_an_error_of_the_method_names_the_grid(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The level and the exact integral are both right; only what is stated of the level is too large."""
    right = levels.statement
    monkeypatch.setattr(levels, "statement", lambda *given: tuple(0.01 + x for x in right(*given)))
    with pytest.raises(CheckError, match="finer grids do not help"):
        ask(device)
    assert CheckError.exit_code == 7
