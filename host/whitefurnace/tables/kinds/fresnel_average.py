"""Tables of the average of a Fresnel term over the hemisphere."""

from __future__ import annotations

from typing import TYPE_CHECKING

from whitefurnace.errors import UnsupportedError
from whitefurnace.tables.kind import Facts, Kind

if TYPE_CHECKING:
    from collections.abc import Mapping

    from whitefurnace.catalogue.choice import Chosen, Spec
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.results import Integrated
    from whitefurnace.tables.axes import AxisSpec, Size
    from whitefurnace.tables.cells import Cells, Run
    from whitefurnace.tables.request import TableRequest


class FresnelAverage(Kind):
    """The kind `fresnel_average`: the average of a Fresnel term over the hemisphere; see `tables.energy`."""

    name = "fresnel_average"
    summary = "Average of a Fresnel term over the hemisphere"
    help = "The axis is the first parameter of the Fresnel model that has no value: f0 for schlick."
    fresnel = "schlick"

    def integral(self, scheme: str | None) -> str:
        return "albedo_average"

    def specs(self, request: TableRequest) -> dict[str, Spec]:
        if (request.ndf, request.masking, request.diffuse, request.brdf) != (None,) * 4:
            raise UnsupportedError(
                f"{self.name} is of Fresnel's term alone: give a fresnel, and no ndf, masking, diffuse or brdf"
            )
        return {"fresnel": request.fresnel or self.fresnel}

    def with_usual_axes(
        self, axes: Mapping[str, AxisSpec], models: Mapping[str, Chosen], fixed: Mapping[str, float], size: Size
    ) -> dict[str, AxisSpec]:
        from whitefurnace.tables.axes import over_first_parameter

        return dict(axes or over_first_parameter(models["fresnel"], fixed, size.across))

    def spec(self, cells: Cells) -> TableSpec:
        from whitefurnace.tables.energy import fresnel_spec

        return fresnel_spec(cells.models, cells.columns)

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.energy import fresnel_average

        return fresnel_average(**cells.arguments, **run.arguments), {}


KINDS = (FresnelAverage(),)
