"""The interface of a kind of table. Everything that is not declared here is the same for all kinds.

This module and those in `tables/kinds` load neither numpy nor a device, since `--help` lists the kinds: code that
computes a table is imported inside the methods that need it.
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
"""Statements of a manifest about a table in addition to its error, by key: `channels`, `formula` and a kind's own."""


class Kind:
    """A kind of table: `whitefurnace lut NAME`. A subclass states how it differs from the defaults below.

    By default a table has texels over NoV and roughness, of an NDF and its masking, with two channels. A subclass must
    give `name`, `summary` and `make`.
    """

    name: str
    """Name of the kind on the command line and in the manifest."""

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

    relative: bool = False
    """True if the tolerance may be relative to each value."""

    channels: int = 2
    """The number of values in a cell."""

    ndf: str = "ggx"
    """The default NDF."""

    fresnel: str = "one"
    """The default Fresnel model of the table."""

    usual_axes: Mapping[str, Ends] = {}
    """Axes that the table has in addition to the default ones, by name."""

    on_device: bool = True
    """True if an OpenCL device computes it, False if numpy does."""

    refittable: bool = True
    """True if texels may be fitted for reads between them (`--fit`), and the error of such reads may be measured."""

    coefficients: bool = False
    """True if the array holds coefficients of a curve instead of texels. These are written as .npy or .h alone."""

    if_too_many_channels: str = ""
    """The remedy where a file cannot hold the channels, after "give .npy"."""

    # ------------------------------------------------------------------------------------------ checking a request

    def settled(self, request: TableRequest) -> tuple[Kind, TableRequest]:
        """Return the kind and the request after the choices that the engine `for_` makes. Raises UsageError."""
        if request.for_ is not None:
            raise UsageError(f"{self.name} is not a table that engines load; dfg and sheen are")
        return self, request

    def integral(self, scheme: str | None) -> str:
        """Return the integral of the catalogue that has the parameters of this table; it decides whether there is a
        view.
        """
        return "albedo"

    def usual_tolerance(self, request: TableRequest) -> float | None:
        """Return the default tolerance, absolute; None for that of integrals at the precision asked for."""
        return self.tolerance if request.precision == 32 else None

    def specs(self, request: TableRequest) -> dict[str, Spec]:
        """Return the models of the table, by slot. Raises UnsupportedError for models that this kind does not
        support.
        """
        if not (request.fresnel is None and request.diffuse is None and request.brdf is None):
            shown = "1" if self.fresnel == "one" else self.fresnel
            raise UnsupportedError(
                f"{self.name} is of an NDF and its masking; Fresnel's term is {shown}, and nothing else is added"
            )
        ndf = self.ndf if request.ndf is None else request.ndf
        return {"ndf": ndf, "masking": request.masking or "smith", "fresnel": self.fresnel}

    def lighting(self, request: TableRequest) -> Lighting:
        """Return the light of the table. Raises UsageError for a light given to a kind that has none."""
        from whitefurnace.tables.cells import Lighting

        for name in request.lighting():
            raise UsageError(f"integral {self.name} has no {name}; integral radiance has")
        return Lighting()

    # ------------------------------------------------------------------------------------------ axes

    def default_axes(self, size: Size) -> dict[str, Axis]:
        """Return the axes that the table has unless they are fixed or replaced, by name, x first."""
        from whitefurnace.tables.axes import centred

        return centred(size)

    def with_usual_axes(
        self, axes: Mapping[str, AxisSpec], models: Mapping[str, Chosen], fixed: Mapping[str, float], size: Size
    ) -> dict[str, AxisSpec]:
        """Return the given axes, and those further axes of this kind that are neither given nor fixed."""
        from whitefurnace.tables.axes import usual_beside

        return usual_beside(self.usual_axes, axes, fixed)

    def arranged(self, axes: tuple[Axis, ...]) -> tuple[Axis, ...]:
        """Return the axes in the order of the array, x first."""
        return axes

    # ------------------------------------------------------------------------------------------ computing

    def spec(self, cells: Cells) -> TableSpec:
        """Describe the array and the kernels, without a device. Raises the errors of the checks of the kind."""
        from dataclasses import replace

        from whitefurnace.integrals.quadrature import table_spec

        found = table_spec(self.integral(cells.scheme), **cells.arguments)
        return replace(found, shape=(*found.shape[: len(cells.shape)], self.channels))

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        """Compute the values of the cells, […, channel], and with `report` the facts that the manifest states."""
        raise NotImplementedError

    def facts(self, cells: Cells, run: Run) -> Facts:
        """Return the facts that the manifest states about a table whose texels are fitted."""
        return self.make(cells, run, True)[1]

    # ------------------------------------------------------------------------------------------ files and text

    def recipe(self) -> dict[str, Any]:
        """Return further data that decide the key of a table, in addition to the options, by manifest key."""
        return {}

    def header(self, name: str, facts: Facts, version: str) -> str:
        """Return the text of a .h whose macros are named after `name`; for kinds with `coefficients`."""
        raise NotImplementedError

    def subject(self, models: Sequence[str], scheme: str | None) -> str:
        """Return the subject of a table for a title: its models, otherwise its scheme, otherwise the kind's summary."""
        return ", ".join(models) or scheme or self.summary

    def lines(self, manifest: Mapping[str, Any]) -> list[str]:
        """Return lines that the command line prints of a manifest, after channels, formula and errors."""
        return []
