"""Rough glass: the shares of light that a boundary of two insulators reflects and transmits.

They depend on the view, the roughness and the index of refraction.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from whitefurnace.catalogue.choice import Chosen
from whitefurnace.catalogue.registry import REFRACTION
from whitefurnace.catalogue.rule import LADDERS, Rule
from whitefurnace.errors import UnsupportedError
from whitefurnace.integrals.quadrature import Grid, Part, Totals, climb, grid_of, integrate, missed, room_for
from whitefurnace.opencl import source
from whitefurnace.opencl.derived import finest
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import CELLS_A_LAUNCH
from whitefurnace.results import Integrated

TOLERANCE = 1e-5
"""Default tolerance of float32 tables. Finer tolerances are computed in float64."""

LOST = 4e-6
"""Largest rounding error of R and T in float32 at grazing angles over narrow lobes: 3.5e-6 over the NDFs of the
catalogue (tests/tables/test_glass.py)."""


@dataclass
class Boundary(Part):
    """The kernel of reflection and refraction at a rough boundary, as a part of `integrate`."""

    @property
    def kind(self) -> str:
        return "gauss"  # its view is n·v alone

    @property
    def ladder(self) -> tuple[Rule, ...]:
        """The rules of a boundary, from the coarsest to the finest."""
        return LADDERS["refraction"]

    def cells(self, rows: np.ndarray, precision: int, tolerance: float = 0.0) -> tuple[np.ndarray, int, float]:
        made, terms, error = super().cells(rows, precision, tolerance)
        return made, terms, error + (LOST if precision == 32 else 0.0)

    def text(self, terms: int) -> str:
        return source.refraction(self.slots, terms).text


def check(slots: Mapping[str, Chosen]) -> None:
    """Check that the NDF is isotropic and that the masking is a product of one term for each direction.

    Raises UnsupportedError.
    """
    ndf, masking = slots["ndf"].model, slots["masking"].model
    if not ndf.isotropic:
        raise UnsupportedError(f"glass needs an isotropic ndf; {ndf.name} is anisotropic")
    if "MASKING_G1" not in masking.provides:
        raise UnsupportedError(
            f"glass needs a masking that is a product of one term for each direction; "
            f"{masking.name} is not one, smith and smith_separable are"
        )


def digests(slots: Mapping[str, Chosen]) -> tuple[str, ...]:
    """Return the digests of the kernels, for the key of a table."""
    return (source.refraction({slot: choice.model for slot, choice in slots.items()}).digest,)


def glass(
    scheme: str | None,
    report: bool,
    *,
    ndf: Chosen,
    masking: Chosen,
    fresnel: Chosen,
    out: np.ndarray | None,
    precision: int,
    tolerance: float,
    device: Device,
    backfacing: str | None = None,
    **columns: Any,
) -> tuple[Integrated, dict[str, Any]]:
    """Compute the shares R and T (…, 2) of the energy from direction v that is reflected and transmitted.

    scheme: "entering" for light from the side of index 1, "leaving" for light from the other side, where Fresnel's n is
    1/ior. Facets scatter once. With `report` the second value has the facts that the manifest states. Raises
    UnsupportedError. [Walter2007]
    """
    start = time.perf_counter()
    slots = {"ndf": ndf, "masking": masking, "fresnel": fresnel}
    check(slots)
    if precision == 64 and not device.fp64:
        raise UnsupportedError(f"{device.identity()['name']} has no float64")
    grid = grid_of(REFRACTION, slots, dict(columns), backfacing)
    n = 1 / grid.columns["fresnel_ior"] if scheme == "leaving" else grid.columns["fresnel_ior"]
    grid = Grid(grid.shape, {**grid.columns, "fresnel_ior": n})
    part = Boundary(
        device,
        REFRACTION,
        {slot: choice.model for slot, choice in slots.items()},
        32 if tolerance >= TOLERANCE else finest(device),
    )
    left = tolerance - (LOST if part.precision == 32 else 0.0)
    values = room_for((*grid.shape, 2), precision, out)
    flat, totals = values.reshape(grid.size, 2), Totals()
    # For light from the denser side the kernel gives the share of the F = 1 reflection that is refracted instead.
    whole, error = None, 0.0
    if (n < 1).any():
        plain = {name: value for name, value in columns.items() if name not in ("ior", "fresnel_ior")}
        whole = integrate(
            "albedo",
            ndf=ndf,
            masking=masking,
            precision=finest(device),
            tolerance=tolerance / 4,
            backfacing=backfacing,
            device=device,
            **plain,
        )
        error = whole.error
    for begin in range(0, grid.size, CELLS_A_LAUNCH):
        end = min(begin + CELLS_A_LAUNCH, grid.size)
        rows = grid.rows(part, begin, end)
        found = climb(part, rows, left if whole is None else left / 2, totals)
        if whole is not None:
            all_of = np.broadcast_to(_beside(whole.values, grid.shape), grid.shape).flat[begin:end]
            found[0] = np.where(rows[-1] < 1, np.maximum(all_of - found[0], 0), found[0])
        flat[begin:end] = found.T
    error += totals.error
    notices = (*totals.notices(), *missed(error, tolerance, precision))
    made = Integrated(
        values,
        error,
        totals.evaluations + (whole.evaluations if whole else 0),
        time.perf_counter() - start,
        totals.rule.name if totals.rule else "",
        notices,
    )
    if not report:
        return made, {}
    return made, _stated(flat, scheme)


def _stated(shares: np.ndarray, scheme: str | None) -> dict[str, Any]:
    """Return the manifest's facts about the shares (cells, 2) of a scheme."""
    both = shares.sum(1, dtype=np.float64)
    return {
        "channels": ["reflected", "transmitted"],
        "largest": float(both.max()),
        "least": float(both.min()),
        "formula": "shares of the energy that arrives along v, once scattered; both scaled by "
        "1/(reflected + transmitted) they keep all of it",
        "side": "light from the side of index 1"
        if scheme == "entering"
        else "light from the side of index ior: Fresnel's n is 1/ior",
    }


def _beside(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return values over fewer parameters in the shape of a grid over more, aligned at the right."""
    return values.reshape((1,) * (len(shape) - values.ndim) + values.shape)
