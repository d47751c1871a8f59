"""Tables of the albedo of a sheen, for the scaling of the layer under it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from whitefurnace.errors import UsageError
from whitefurnace.tables.engine_axes import arranged, axes_of, engine_of
from whitefurnace.tables.kind import Facts, Kind

if TYPE_CHECKING:
    from whitefurnace.engines.presets import Dfg
    from whitefurnace.results import Integrated
    from whitefurnace.tables.axes import Axis
    from whitefurnace.tables.cells import Cells, Run
    from whitefurnace.tables.request import TableRequest


@dataclass(frozen=True)
class Sheen(Kind):
    """The kind `sheen`: the albedo of a sheen and its average; see `tables.energy`.

    engine: the table of the engine that `--for` names, or None.
    """

    engine: Dfg | None = None

    name = "sheen"
    summary = "Albedo of a sheen, for scaling the layer below"
    help = (
        "The channels are the directional albedo E(v) and its average E_avg, of a sheen of colour 1. The masking is "
        "smith by default, under which no sheen reflects more than arrives; engines use ashikhmin, and `--for ENGINE` "
        "gives the masking, size and axes of one."
    )
    ndf = "charlie"
    tolerance = 2e-5  # what float32 leaves of rims of 3° at grazing, where engines' sheen is 12; a step of half is 2e-4

    def settled(self, request: TableRequest) -> tuple[Sheen, TableRequest]:
        if request.for_ is None:
            return self, request
        engine = engine_of(request, ("size", "axis", "masking"))
        if not engine.dfg.charlie:
            how = f": it shades sheen by {engine.sheen}" if engine.sheen else ""
            raise UsageError(f"{engine.name} reads no table of sheen{how}; give --masking in place of --for")
        table = engine.dfg
        asked = replace(request, size=table.size, axes=axes_of(table), masking=table.charlie_masking)
        return replace(self, engine=table), asked

    def arranged(self, axes: tuple[Axis, ...]) -> tuple[Axis, ...]:
        return arranged(self.engine, axes)

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.energy import sheen

        return sheen(report, **cells.arguments, **run.arguments)


KINDS = (Sheen(),)
