"""Smith's term of any NDF as a rational function, written as C and GLSL."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from whitefurnace.tables.kind import Facts, Kind

if TYPE_CHECKING:
    from whitefurnace.catalogue.choice import Chosen
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.results import Integrated
    from whitefurnace.tables.axes import AxisSpec, Ends, Size
    from whitefurnace.tables.cells import Cells, Run


class Smith(Kind):
    """The kind `smith`: a rational function for Smith's term of any NDF, as C and GLSL; see `tables.curves`."""

    name = "smith"
    summary = "Fitted curve for Smith's masking of any NDF, as C and GLSL"
    help = "Fitted over NoV and one parameter. `rational` fits a width and a bend, `linear` the width alone."
    schemes = ("rational", "linear")
    coefficients, refittable = True, False
    # From the roughness that engines shade with at least [Lagarde2014].
    usual_axes: Mapping[str, Ends] = {"roughness": (0.045, 1.0, 64, "linear"), "NoV": (0.0, 1.0, 96, "sqrt")}

    def integral(self, scheme: str | None) -> str:
        return "projected_area"

    def with_usual_axes(
        self, axes: Mapping[str, AxisSpec], models: Mapping[str, Chosen], fixed: Mapping[str, float], size: Size
    ) -> dict[str, AxisSpec]:
        from whitefurnace.tables.axes import following, usual_beside

        follows = any(following(choice, {*fixed, *axes}) for choice in models.values())
        usual = {name: ends for name, ends in self.usual_axes.items() if follows or name != "roughness"}
        return usual_beside(usual, axes, fixed)

    def spec(self, cells: Cells) -> TableSpec:
        from whitefurnace.tables.curves import shape_of_smith, smith_check

        smith_check(cells.models)
        found = super().spec(cells)
        return replace(found, shape=shape_of_smith(cells.scheme, cells.axes))

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.curves import smith

        return smith(cells, run, report)

    def header(self, name: str, facts: Facts, version: str) -> str:
        from whitefurnace.tables.curves import header

        return header(name, facts["text"], version)


KINDS = (Smith(),)
