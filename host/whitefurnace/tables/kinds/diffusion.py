"""Tables of pre-integrated diffusion: diffuse light on a curved body under whose surface light travels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from whitefurnace.errors import UnsupportedError
from whitefurnace.tables.kind import Facts, Kind

if TYPE_CHECKING:
    from whitefurnace.catalogue.choice import Chosen, Spec
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.results import Integrated
    from whitefurnace.tables.axes import Axis, AxisSpec, Ends, Size
    from whitefurnace.tables.cells import Cells, Run
    from whitefurnace.tables.request import TableRequest


class Diffusion(Kind):
    """The kind `diffusion`: diffuse light on skin and other media by curvature; see `tables.diffusion`."""

    name = "diffusion"
    summary = "Diffuse light on skin and other media, by curvature"
    help = (
        "x is NoL from -1 to 1 and y the curvature from 0 to 1 per mm. `skin` is a sum of Gaussians, `burley` and "
        "`dipole` take absorption and scattering, burley also albedo and mfp, with --set; the other schemes are "
        "measured media."
    )
    schemes = (
        "skin",
        "burley",
        "dipole",
        "apple",
        "chicken1",
        "chicken2",
        "cream",
        "ketchup",
        "marble",
        "potato",
        "skimmilk",
        "skin1",
        "skin2",
        "spectralon",
        "wholemilk",
    )
    on_device = False
    # Of the table's size.
    usual_axes: Mapping[str, Ends] = {"NoL": (-1.0, 1.0, 0, "centres"), "curvature": (0.0, 1.0, 0, "centres")}

    def integral(self, scheme: str | None) -> str:
        return "normalization"

    def specs(self, request: TableRequest) -> dict[str, Spec]:
        if (request.ndf, request.masking, request.fresnel, request.diffuse, request.brdf) != (None,) * 5:
            raise UnsupportedError(f"{self.name} is of a medium alone: give no ndf, masking, fresnel, diffuse or brdf")
        return {}

    def default_axes(self, size: Size) -> dict[str, Axis]:
        return {}

    def with_usual_axes(
        self, axes: Mapping[str, AxisSpec], models: Mapping[str, Chosen], fixed: Mapping[str, float], size: Size
    ) -> dict[str, AxisSpec]:
        counts = dict(zip(self.usual_axes, (size.across, size.down), strict=True))
        own: dict[str, AxisSpec] = {
            name: (low, high, counts[name], scale)
            for name, (low, high, _, scale) in self.usual_axes.items()
            if name not in fixed
        }
        return {**own, **axes}

    def spec(self, cells: Cells) -> TableSpec:
        from whitefurnace.tables.diffusion import diffusion_spec

        return diffusion_spec(cells.scheme, cells.columns)

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.diffusion import diffusion

        return diffusion(cells.scheme, report, **cells.arguments, **run.arguments)


KINDS = (Diffusion(),)
