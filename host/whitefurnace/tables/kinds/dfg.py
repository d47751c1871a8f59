"""Split-sum tables, of our own layout or of an engine's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from whitefurnace.tables.engine_axes import arranged, axes_of, engine_of
from whitefurnace.tables.kind import Facts
from whitefurnace.tables.kinds.integrals import OfIntegral

if TYPE_CHECKING:
    from whitefurnace.engines.presets import Dfg
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.results import Integrated
    from whitefurnace.tables.axes import Axis
    from whitefurnace.tables.cells import Cells, Run
    from whitefurnace.tables.request import TableRequest


@dataclass(frozen=True)
class SplitSum(OfIntegral):
    """The kind `dfg`: split-sum tables. `engine` is the table of the engine that `--for` names, or None."""

    engine: Dfg | None = None

    name = "dfg"
    summary = "Split-sum pair: scale and bias of F0 for Schlick's Fresnel"
    help = "`--for ENGINE` gives the size, axes, form and channels that an engine reads."
    schemes = ("scale_bias", "multiscatter")

    def settled(self, request: TableRequest) -> tuple[SplitSum, TableRequest]:
        if request.for_ is None:
            return self, request
        table = engine_of(request, ("size", "axis", "scheme")).dfg
        return replace(self, engine=table), replace(request, size=table.size, scheme=table.form, axes=axes_of(table))

    def arranged(self, axes: tuple[Axis, ...]) -> tuple[Axis, ...]:
        return arranged(self.engine, axes)

    @property
    def charlie(self) -> str | None:
        """Masking of Charlie's albedo, the third channel of the table; None for a table without one."""
        return self.engine.charlie_masking if self.engine is not None and self.engine.charlie else None

    def spec(self, cells: Cells) -> TableSpec:
        from whitefurnace.integrals.quadrature import table_spec
        from whitefurnace.tables.split_sum import charlie

        found = super().spec(cells)
        if self.charlie is None:
            return found
        cloth: dict[str, Any] = charlie(cells, self.charlie)
        return replace(
            found, shape=(*found.shape[:-1], 3), digests=(*found.digests, *table_spec("albedo", **cloth).digests)
        )

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.split_sum import CHANNELS, charlie, laid_out

        form = cells.scheme or self.schemes[0]
        cloth = (
            {**charlie(cells, self.charlie), "backfacing": cells.backfacing, **run.arguments} if self.charlie else None
        )
        made, charlie_error = laid_out(form, {**cells.arguments, **run.arguments}, cloth, run.progress)
        channels, formula = CHANNELS[form]
        facts: Facts = {"channels": list(channels), "formula": formula}
        if cloth is not None:
            facts |= {
                "channels": [*channels, "charlie"],
                "charlie_masking": self.charlie,
                "charlie_error": charlie_error,
            }
        return made, facts if report else {}

    def facts(self, cells: Cells, run: Run) -> Facts:
        return self.make(cells, run, True)[1]

    def recipe(self) -> dict[str, Any]:
        return {"charlie": self.charlie} if self.charlie else {}


KINDS = (SplitSum(),)
