"""Tables of rough glass: the shares of light that a boundary of two insulators reflects and transmits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from whitefurnace.tables.kind import Facts, Kind

if TYPE_CHECKING:
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.results import Integrated
    from whitefurnace.tables.axes import Ends
    from whitefurnace.tables.cells import Cells, Run
    from whitefurnace.tables.request import TableRequest


class Glass(Kind):
    """The kind `glass`: the light that a rough boundary reflects and transmits; see `tables.glass`."""

    name = "glass"
    summary = "Light that a rough boundary reflects and transmits"
    help = (
        "The third axis is the index of refraction, from 1 to 3. `entering` is for light from the side of index 1, "
        "`leaving` for light from the other side."
    )
    schemes = ("entering", "leaving")
    fresnel = "dielectric"
    # Equal steps of F0^¼ = √((n - 1)/(n + 1)), as Cycles has them, to OSPRay's largest index.
    usual_axes: Mapping[str, Ends] = {"ior": (1.0, 3.0, 16, "f0")}

    def usual_tolerance(self, request: TableRequest) -> float | None:
        from whitefurnace.tables.glass import TOLERANCE

        return TOLERANCE if request.precision == 32 else None

    def spec(self, cells: Cells) -> TableSpec:
        from whitefurnace.tables.glass import check, digests

        found = super().spec(cells)
        check(cells.models)
        return replace(found, digests=(*found.digests, *digests(cells.models)))

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.glass import glass

        return glass(cells.scheme, report, **cells.arguments, **run.arguments)


KINDS = (Glass(),)
