"""Tables of linearly transformed cosines: matrices that light polygons, and the two textures that engines load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from whitefurnace.tables.kind import Facts, Kind
from whitefurnace.text import table

if TYPE_CHECKING:
    from whitefurnace.integrals.quadrature import TableSpec
    from whitefurnace.results import Integrated
    from whitefurnace.tables.axes import Axis, Size
    from whitefurnace.tables.cells import Cells, Run

_NAMES = ("xx", "zx", "xz", "zz", "norm", "fresnel", "0", "sphere")


@dataclass(frozen=True)
class Ltc(Kind):
    """The kinds `ltc`, `ltc_1` and `ltc_2`: linearly transformed cosines, with the channels `names`.

    The matrices are fitted to the BRDF, not to reads between texels.
    """

    name: str
    summary: str
    names: tuple[str, ...]
    schemes: tuple[str, ...] = ()

    help = "x is the roughness from 0 to 1, and NoV = 1 - y² with y from 0 to 1."
    size = 64
    refittable = False
    if_too_many_channels = ", or write ltc_1 and ltc_2"

    @property
    def channels(self) -> int:  # type: ignore[override]  # the number of its names
        return len(self.names)

    def default_axes(self, size: Size) -> dict[str, Axis]:
        from whitefurnace.tables.axes import Axis

        return {"roughness": Axis("roughness", 0.0, 1.0, size.across), "NoV": Axis("NoV", 1.0, 0.0, size.down, "sqrt")}

    def spec(self, cells: Cells) -> TableSpec:
        from whitefurnace.tables.ltc import check, digests

        found = super().spec(cells)
        check(cells.models)
        return replace(found, digests=(*found.digests, *digests(cells.models)))

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.ltc import ltc

        return ltc(
            self.name, self.names, cells.scheme, report, middle=cells.middle(), **cells.arguments, **run.arguments
        )

    def lines(self, manifest: Mapping[str, Any]) -> list[str]:
        if "misplaced" not in manifest:
            return []
        stated = {f"at texels, {k}": e for k, e in manifest["misplaced"].items() if k != "between"}
        stated |= {f"between, {k}": e for k, e in manifest["misplaced"].get("between", {}).items()}
        names = ("mean", "median", "p99", "max")
        return [
            table(
                ["  energy misplaced", *names],
                [(f"  {where}", *(f"{e[k]:.3f}" for k in names)) for where, e in stated.items()],
            )
        ]


_SCHEMES = ("free", "heitz")

KINDS = (
    Ltc("ltc", "Linearly transformed cosines for polygonal lights", _NAMES, _SCHEMES),
    Ltc("ltc_1", "Matrices of ltc, the first texture that engines load", _NAMES[:4], _SCHEMES),
    Ltc("ltc_2", "Norm, Fresnel and sphere of ltc, the second texture", _NAMES[4:]),
)
