"""Tables of the energy that single scattering loses, in the forms of three schemes that give it back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from whitefurnace.tables.kind import Facts, Kind

if TYPE_CHECKING:
    from whitefurnace.results import Integrated
    from whitefurnace.tables.cells import Cells, Run


class Energy(Kind):
    """The kind `energy`: the energy that single scattering loses, in the forms of three schemes; see
    `tables.energy`.
    """

    name = "energy"
    summary = "Energy of multiple scattering, for three ways to restore it"
    help = (
        "kulla_conty: 1 - E and 1 - E_avg; turquin: E and 1/E - 1; fdez_aguera: the split-sum pair, E being the "
        "directional albedo."
    )
    schemes = ("kulla_conty", "turquin", "fdez_aguera")

    def integral(self, scheme: str | None) -> str:
        return "dfg" if scheme == "fdez_aguera" else "albedo"

    def make(self, cells: Cells, run: Run, report: bool) -> tuple[Integrated, Facts]:
        from whitefurnace.tables.energy import energy

        return energy(cells.scheme or self.schemes[0], report, **cells.arguments, **run.arguments)

    def lines(self, manifest: Mapping[str, Any]) -> list[str]:
        if "furnace" not in manifest:
            return []
        return [
            f"  furnace at F = 1: off by {manifest['furnace']:.1e}; "
            f"f(l, v) and f(v, l) differ by {manifest['non_reciprocity']:.2g}",
            "  off Kulla and Conty's at F0 = "
            + ", ".join(f"{f0}: {off:.1e}" for f0, off in manifest["deviation"].items()),
        ]


KINDS = (Energy(),)
