"""What `--for ENGINE` decides of a table: the axes on which an engine reads its split sums, and its size."""

from __future__ import annotations

from typing import TYPE_CHECKING

from whitefurnace.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from whitefurnace.engines.presets import Dfg, Engine
    from whitefurnace.tables.axes import Axis, AxisSpec
    from whitefurnace.tables.request import TableRequest


def engine_of(request: TableRequest, decided: Sequence[str]) -> Engine:
    """The engine that a request names.

    decided: options that the engine decides, so that a request may not have them, of size, axis, scheme and masking.
    Raises UsageError for an unknown engine, for more than one, and for an option that it decides.
    """
    from whitefurnace.engines.presets import engines

    found = engines(request.for_ or "")
    if len(found) > 1:
        raise UsageError(f"{request.for_}: a table is for one engine")
    given = {"size": request.size, "axis": request.axes, "scheme": request.scheme, "masking": request.masking}
    for what in decided:
        if given[what]:
            raise UsageError(f"--for {found[0].name} says the {what}: leave it out")
    return found[0]


def axes_of(table: Dfg) -> dict[str, AxisSpec]:
    """The two axes of an engine's table, by name."""
    return {name: (0.0, 1.0, table.size, table.NoV if name == "NoV" else "centres") for name in (table.x, table.y)}


def arranged(table: Dfg | None, axes: tuple[Axis, ...]) -> tuple[Axis, ...]:
    """Axes in the order of an engine's table, x first; as they are without one."""
    return axes if table is None else tuple(sorted(axes, key=lambda one: (table.x, table.y).index(one.name)))
