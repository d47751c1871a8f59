"""Launches kernels over cells: columns of numbers, one cell in each lane, in blocks of bounded size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from whitefurnace.catalogue import Model
from whitefurnace.catalogue.rule import Rule
from whitefurnace.opencl import source
from whitefurnace.opencl.device import Device

CELLS_A_LAUNCH = 1 << 16


def over_cells(
    device: Device,
    text: str,
    kernel: str,
    cells: np.ndarray,
    components: int,
    precision: int,
    between: Sequence[np.generic | np.ndarray] = (),
) -> np.ndarray:
    """Run a kernel over cells and return its values, (components, n), in the working precision.

    cells: (rows, n) float64, one column for each cell. components: numbers that the kernel writes for each cell.
    precision: 32 or 64 bits. between: arguments of the kernel between the number of cells and the cells; arrays among
    them are sent in the working precision. Lanes past the end repeat the last cell.
    """
    kind = np.dtype(f"f{precision // 8}")
    lanes = device.lanes(precision)
    bound = device.build(text, {"W": lanes, "T": 1, "PRECISION": precision}).kernel(kernel)
    sent = [device.array(a.astype(kind)) if isinstance(a, np.ndarray) else a for a in between]
    out = np.empty((components, cells.shape[1]), kind)
    step = lanes * device.local_size
    for begin in range(0, cells.shape[1], CELLS_A_LAUNCH):
        part = cells[:, begin : begin + CELLS_A_LAUNCH]
        count = part.shape[1]
        padded = -(-count // step) * step
        block = np.pad(part, ((0, 0), (0, padded - count)), mode="edge").astype(kind)
        result = device.empty((components, padded), kind)
        device.launch(bound, (padded // lanes,), (result, np.int32(padded), *sent, device.array(block)))
        out[:, begin : begin + count] = result.read()[:, :count]
    return out


def over_nodes(
    device: Device,
    text: str,
    kernel: str,
    cells: np.ndarray,
    components: int,
    precision: int,
    rule: Rule,
    azimuths: bool = True,
) -> np.ndarray:
    """Run a kernel that sums over the nodes of a quadrature rule: `over_cells` with the rule's tables as `between`.

    azimuths: True if the kernel takes the azimuth nodes too.
    """
    polar, azimuthal = rule.tables()
    between: list[np.generic | np.ndarray] = [*map(np.int32, rule.counts), polar]
    if azimuths:
        between += [np.int32(rule.azimuths), azimuthal]
    return over_cells(device, text, kernel, cells, components, precision, between)


def evaluate(
    device: Device, function: str, slots: Mapping[str, Model], cells: np.ndarray, precision: int, area_terms: int = 0
) -> np.ndarray:
    """Evaluate a function of a model on the device at given arguments: (components, n).

    function: its name in kernels (`NDF_D`, `FRESNEL_F`, …). slots: the models of the program. cells: (rows, n), the
    function's arguments first (three rows for a vector), then the parameters and constants of each slot, then the table
    of Smith's area of `area_terms` terms where the masking reads one. precision: 32 or 64 bits.
    """
    components = 3 if function == "BRDF_F" else 1
    return over_cells(
        device, source.evaluation(function, slots, area_terms).text, "evaluate", cells, components, precision
    )
