"""Tables of the integrals of the catalogue themselves: the values of `whitefurnace.integrate` over a grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from whitefurnace.errors import UsageError
from whitefurnace.tables.kind import Facts, Kind

if TYPE_CHECKING:
    from whitefurnace.catalogue.choice import Spec
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.results import Integrated
    from whitefurnace.tables.cells import Cells, Run
    from whitefurnace.tables.request import TableRequest


class OfIntegral(Kind):
    """A kind that tabulates the integral of its own name, for any BRDF that the integral takes."""

    relative = True

    def integral(self, scheme: str | None) -> str:
        return self.name

    def specs(self, request: TableRequest) -> dict[str, Spec]:
        ndf = request.ndf
        if ndf is None and request.diffuse is None and request.brdf is None:
            ndf = self.ndf
        if ndf is None and (request.masking is not None or request.fresnel is not None):
            raise UsageError(
                f"{'masking' if request.masking is not None else 'fresnel'} is of an NDF, and none is given"
            )
        given = {
            "ndf": ndf,
            "masking": request.masking or "smith",
            "fresnel": request.fresnel or self.fresnel,
            "diffuse": request.diffuse,
            "brdf": request.brdf,
        }
        return {slot: spec for slot, spec in given.items() if spec is not None}

    def spec(self, cells: Cells) -> TableSpec:
        from whitefurnace.integrals.quadrature import table_spec

        return table_spec(self.name, **cells.arguments)

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.integrals.api import integrate

        what: dict[str, Any] = {**cells.arguments, **cells.lighting.arguments, **run.arguments}
        return integrate(self.name, progress=run.progress, **what), {}

    def facts(self, cells: Cells, run: Run) -> Facts:
        return {}


@dataclass(frozen=True)
class Plain(OfIntegral):
    """A kind for one integral without further settings."""

    name: str
    summary: str


KINDS = (
    Plain("normalization", "Integral of an NDF over the hemisphere; 1 if it is normalized"),
    Plain("projected_area", "Area of the microfacets projected along the view direction"),
    Plain("weak_furnace", "Weak white furnace test; 1 if the masking fits the NDF"),
    Plain("albedo", "Share of light that a BRDF reflects, by view direction"),
    Plain("albedo_average", "Share of uniform light that a BRDF reflects"),
)
