"""What a kind of table says of itself; everything else about tables is the same for all kinds.

This module and those in `tables/kinds` load neither numpy nor a device, since `--help` lists the kinds: what computes a
table is imported inside the methods that need it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from whitefurnace.errors import UnsupportedError, UsageError

if TYPE_CHECKING:
    from whitefurnace.catalogue.choice import Chosen, Spec
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.results import Integrated
    from whitefurnace.tables.axes import Axis, AxisSpec, Ends, Size
    from whitefurnace.tables.cells import Cells, Lighting, Run
    from whitefurnace.tables.request import TableRequest

Facts = dict[str, Any]
"""What a manifest states of a table beside its error, by key: `channels`, `formula` and a kind's own."""


class Kind:
    """A kind of table: `whitefurnace lut NAME`. A subclass states what differs from the defaults below.

    By itself a kind is a table of texels over NoV and roughness, of an NDF and its masking, with two channels. A
    subclass must give `name`, `summary` and `make`.
    """

    name: str
    """What the command line and the manifest call it."""

    summary: str
    """One line for help: what the table holds."""

    help: str = ""
    """Further sentences for help: its channels and axes, where they are not the usual ones."""

    schemes: tuple[str, ...] = ()
    """Forms of the table. The first is the default."""

    size: int = 128
    """The default number of cells along x and y."""

    tolerance: float | None = None
    """The default tolerance in float32, absolute, where it is not that of integrals."""

    channels: int = 2
    """The number of values in a cell."""

    ndf: str = "ggx"
    """The default NDF."""

    fresnel: str = "one"
    """The Fresnel model that the table is of."""

    usual_axes: Mapping[str, Ends] = {}
    """Axes that the table has beside the default ones, by name."""

    on_device: bool = True
    """Whether an OpenCL device computes it; numpy does otherwise."""

    refittable: bool = True
    """Whether texels may be fitted for reads between them (`--fit`), and what such reads cost may be measured."""

    coefficients: bool = False
    """Whether the array holds coefficients of a curve in place of texels. These are written as .npy or .h alone."""

    if_too_many_channels: str = ""
    """What to do where a file cannot hold the channels, after "give .npy"."""

    # ------------------------------------------------------------------------------------------ checking a request

    def settled(self, request: TableRequest) -> tuple[Kind, TableRequest]:
        """The kind and the request with what `for_`, an engine, decides. Raises UsageError."""
        if request.for_ is not None:
            raise UsageError(f"{self.name} is no table of engines; dfg is")
        return self, request

    def integral(self, scheme: str | None) -> str:
        """The integral of the catalogue that has the parameters of this table: it says whether there is a view."""
        return "albedo"

    def usual_tolerance(self, request: TableRequest) -> float | None:
        """The default tolerance, absolute; None for that of integrals at the precision asked for."""
        return self.tolerance if request.precision == 32 else None

    def specs(self, request: TableRequest) -> dict[str, Spec]:
        """The models that the table is of, by slot. Raises UnsupportedError for those that it cannot be of."""
        if not (request.fresnel is None and request.diffuse is None and request.brdf is None):
            shown = "1" if self.fresnel == "one" else self.fresnel
            raise UnsupportedError(
                f"{self.name} is of an NDF and its masking; Fresnel's term is {shown}, and nothing else is added"
            )
        ndf = self.ndf if request.ndf is None else request.ndf
        return {"ndf": ndf, "masking": request.masking or "smith", "fresnel": self.fresnel}

    def lighting(self, request: TableRequest) -> Lighting:
        """The light of the table. Raises UsageError where it has none and one is given."""
        from whitefurnace.tables.cells import Lighting

        for name in ("light", "environment", "normal"):
            if getattr(request, name) is not None:
                raise UsageError(f"integral {self.name} has no {name}; integral radiance has")
        return Lighting()

    # ------------------------------------------------------------------------------------------ axes

    def default_axes(self, size: Size) -> dict[str, Axis]:
        """The axes that the table has unless they are fixed or replaced, by name, x first."""
        from whitefurnace.tables.axes import centred

        return centred(size)

    def with_usual_axes(
        self, axes: Mapping[str, AxisSpec], models: Mapping[str, Chosen], fixed: Mapping[str, float], size: Size
    ) -> dict[str, AxisSpec]:
        """The axes given, and those that the table has beside the default ones and that are neither given nor fixed."""
        from whitefurnace.tables.axes import usual_beside

        return usual_beside(self.usual_axes, axes, fixed)

    def arranged(self, axes: tuple[Axis, ...]) -> tuple[Axis, ...]:
        """The axes in the order in which they lie in the array, x first."""
        return axes

    # ------------------------------------------------------------------------------------------ computing

    def spec(self, cells: Cells) -> TableSpec:
        """The shape of the array and the digests of the kernels, found without a device. Raises what checks raise."""
        from dataclasses import replace

        from whitefurnace.integrals.quadrature import table_spec

        found = table_spec(self.integral(cells.scheme), **cells.arguments)
        return replace(found, shape=(*found.shape[: len(cells.shape)], self.channels))

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        """The values of the cells, […, channel], and what is stated of them if `report`; otherwise nothing."""
        raise NotImplementedError

    def facts(self, cells: Cells, run: Run) -> Facts:
        """What is stated of a table whose texels are fitted."""
        return self.make(cells, run, True)[1]

    # ------------------------------------------------------------------------------------------ files and text

    def recipe(self) -> dict[str, Any]:
        """What the key of a table depends on beside the options, by manifest key."""
        return {}

    def header(self, name: str, facts: Facts, version: str) -> str:
        """The text of a .h whose macros are named after `name`, of a kind with `coefficients`."""
        raise NotImplementedError

    def subject(self, models: Sequence[str], scheme: str | None) -> str:
        """What a table is of, for a title: its models, else its scheme, else what the kind is."""
        return ", ".join(models) or scheme or self.summary

    def lines(self, manifest: Mapping[str, Any]) -> list[str]:
        """What the command line prints of a manifest beside channels, formula and errors."""
        return []
