"""Tables of the albedo of a sheen, for the scaling of the layer under it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from whitefurnace.tables.kind import Facts, Kind

if TYPE_CHECKING:
    from whitefurnace.results import Integrated
    from whitefurnace.tables.cells import Cells, Run


class Sheen(Kind):
    """The kind `sheen`: the albedo of a sheen and its average; see `tables.energy`."""

    name = "sheen"
    summary = "Albedo of a sheen, for scaling the layer below"
    help = "The channels are the directional albedo E(v) and its average E_avg, of a sheen of colour 1."
    ndf = "charlie"

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.energy import sheen

        return sheen(report, **cells.arguments, **run.arguments)


KINDS = (Sheen(),)
