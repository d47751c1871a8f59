"""The norm of an NDF as a polynomial, written as C and GLSL."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from whitefurnace.tables.kind import Facts, Kind

if TYPE_CHECKING:
    from whitefurnace.catalogue.choice import Chosen
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.results import Integrated
    from whitefurnace.tables.axes import AxisSpec, Size
    from whitefurnace.tables.cells import Cells, Run
    from whitefurnace.tables.request import TableRequest


class Norm(Kind):
    """The kind `norm`: a polynomial for the norm of an NDF, as C and GLSL; see `tables.curves`."""

    name = "norm"
    summary = "Fitted polynomial for the norm of an NDF, as C and GLSL"
    help = "Of abc, shifted_gamma or a .clh file, over one or two of its parameters. The tolerance is relative."
    ndf = "abc"
    tolerance = 1e-2  # relative: a hundredth of D is less than an eye sees
    coefficients, refittable = True, False

    def integral(self, scheme: str | None) -> str:
        return "normalization"

    def usual_tolerance(self, request: TableRequest) -> float | None:
        return self.tolerance

    def with_usual_axes(
        self, axes: Mapping[str, AxisSpec], models: Mapping[str, Chosen], fixed: Mapping[str, float], size: Size
    ) -> dict[str, AxisSpec]:
        from whitefurnace.tables.axes import usual_beside
        from whitefurnace.tables.curves import norm_axes

        return usual_beside(norm_axes(models), axes, fixed)

    def spec(self, cells: Cells) -> TableSpec:
        from whitefurnace.tables.curves import norm_check, shape_of_norm

        norm_check(cells.models)
        found = super().spec(cells)
        return replace(found, shape=shape_of_norm(cells.axes))

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.curves import norm

        return norm(cells, run, report)

    def header(self, name: str, facts: Facts, version: str) -> str:
        from whitefurnace.tables.curves import header

        return header(name, facts["text"], version)


KINDS = (Norm(),)
