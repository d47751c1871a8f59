"""Values that leave a domain by the rounding of their own arithmetic are its end; what lies further out is refused."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import whitefurnace as wf
from whitefurnace.catalogue import model, models
from whitefurnace.catalogue.model import Parameter
from whitefurnace.catalogue.registry import SLOTS
from whitefurnace.errors import UsageError
from whitefurnace.opencl.device import Device

ROUNDINGS = [(np.float64, 1e-12), (np.float32, 1e-6), (np.float16, 4e-3)]
# Those whose domain ends where cosines, albedos, indices and roughnesses end; others are lengths and exponents.
PARAMETERS = [
    (slot, name, p)
    for slot in SLOTS
    for name, entry in models(slot).items()
    for p in entry.parameters
    if 0 < p.high <= 5
]


def beyond(end: float, by: float, kind: type) -> Any:
    """The value of the type that lies about `by` beyond the upper end, at least one unit in the last place."""
    return max(kind(end + by), np.nextafter(kind(end), kind(np.inf)))


@pytest.mark.parametrize("kind, slack", ROUNDINGS)
@pytest.mark.parametrize(
    "slot, name, parameter", PARAMETERS, ids=lambda v: v.name if isinstance(v, Parameter) else None
)
def test_every_parameter_forgives_a_rounding(
    slot: str, name: str, parameter: Parameter, kind: type, slack: float
) -> None:
    end = parameter.high
    assert parameter.check(beyond(end, slack * end / 2, kind), f"{slot} {name}") == end
    # Further out than any rounding of the type: ten times what is forgiven.
    with pytest.raises(UsageError, match="outside"):
        parameter.check(kind(end * (1 + 10 * slack)), f"{slot} {name}")
    if (parameter.low, end) == (0, 1):
        assert parameter.check(kind(-slack / 2), f"{slot} {name}") == 0
        with pytest.raises(UsageError, match="outside"):
            parameter.check(kind(-10 * slack), f"{slot} {name}")


def unit_products(kind: type) -> np.ndarray:
    """n·v of normalized vectors with themselves, as a user computes it: some are over 1."""
    n = np.random.default_rng(7).standard_normal((4096, 3)).astype(kind)
    n /= np.sqrt((n * n).sum(-1, keepdims=True))
    found = (n * n).sum(-1)
    assert found.max() > 1, "no product leaves 1, so this tests nothing"
    return np.asarray(np.sort(found)[-3:])


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_dot_products_of_unit_vectors_are_cosines(device: Device, kind: type) -> None:
    NoV = unit_products(kind)
    ask: Any = partial(wf.integrate, ndf="ggx", alpha=0.3, device=device, tolerance=1e-4)
    assert (ask("albedo", NoV=NoV).values == ask("albedo", NoV=1.0).values).all()
    assert (ask("albedo", NoV=-NoV, backfacing="absolute").values == ask("albedo", NoV=1.0).values).all()
    assert (ask("albedo", NoV=-NoV, backfacing="clamp").values == ask("albedo", NoV=0.0).values).all()
    assert (ask("albedo", NoV=1 - NoV).values == ask("albedo", NoV=0.0).values).all()
    lit = ask("radiance", light="punctual", NoV=0.5, NoL=NoV)
    assert (lit.values == ask("radiance", light="punctual", NoV=0.5, NoL=1.0).values).all()


@pytest.mark.parametrize("NoV", [1 + 1e-9, -1e-9, np.float32(1 + 1e-4), np.float32(-1e-4), 2, np.nan])
def test_what_is_further_out_is_refused(device: Device, NoV: Any) -> None:
    with pytest.raises(UsageError, match="NoV"):
        wf.integrate("albedo", ndf="ggx", alpha=0.3, NoV=NoV, device=device)
    with pytest.raises(UsageError, match="NoV"):
        wf.integrate("albedo", ndf="ggx", alpha=0.3, NoV=2 + abs(NoV), backfacing="absolute", device=device)


def test_samples_and_tables(device: Device, tmp_path: Path) -> None:
    over = 1 + 7e-16
    assert (wf.sample("ggx", 8, alpha=over, device=device) == wf.sample("ggx", 8, alpha=1.0, device=device)).all()
    options: Any = {"ndf": "ggx", "alpha": 0.3, "tolerance": 1e-3, "device": device}
    one = wf.lut("albedo", tmp_path / "a.npy", axes={"NoV": (-over + 1, over, 3)}, **options)
    two = wf.lut("albedo", tmp_path / "b.npy", axes={"NoV": (0.0, over, 3, "angle")}, **options)
    fixed = wf.lut("albedo", tmp_path / "c.npy", NoV=np.float32(1 + 2e-7), axes={"alpha": (0.1, over, 2)}, ndf="ggx")
    assert {one.state, two.state, fixed.state} == {"done"}
    assert (np.load(tmp_path / "a.npy").ravel()[-1] == np.load(tmp_path / "b.npy").ravel()[-1]).all()
    skin = wf.lut("diffusion", tmp_path / "skin.npy", axes={"NoL": (-over, over, 3)}, curvature=0.5)
    assert skin.state == "done"


def test_the_ends_themselves_are_kept() -> None:
    alpha = model("ndf", "ggx").parameters[0]
    # float32(1e-5) is below 1e-5 by a quarter of its last place.
    assert alpha.check(np.float32(alpha.low), "ndf ggx") == max(float(np.float32(alpha.low)), alpha.low)
