"""The kinds of table, found by listing this folder: a module here has `KINDS`, a tuple of them.

A new kind is one new module and touches nothing else. Listing loads no numpy: see `tables/kind.py`.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from whitefurnace.errors import UsageError, nearest
from whitefurnace.tables.kind import Kind


@cache
def kinds() -> dict[str, Kind]:
    """Return all kinds by name."""
    found: dict[str, Kind] = {}
    for info in pkgutil.iter_modules(__path__):
        here: tuple[Kind, ...] = importlib.import_module(f"{__name__}.{info.name}").KINDS
        found |= {one.name: one for one in here}
    return found


def kind(name: str) -> Kind:
    """Return the kind called `name`. Raises UsageError with the nearest name."""
    if name not in kinds():
        raise UsageError(f"unknown integral {name!r}{nearest(name, kinds())}")
    return kinds()[name]


def scheme_of(one: Kind, given: str | None) -> str | None:
    """Return the scheme of a table: the one given, or the kind's default. Raises UsageError."""
    if given is None or given in one.schemes:
        return given or next(iter(one.schemes), None)
    if one.schemes:
        raise UsageError(f"unknown scheme {given!r}{nearest(given, one.schemes)}")
    having = [other.name for other in kinds().values() if other.schemes]
    raise UsageError(f"{one.name} has no scheme; {', '.join(having[:-1])} and {having[-1]} have")


def listed() -> str:
    """Return the kinds and their summaries as text, one on each line."""
    width = max(map(len, kinds()))
    return "\n".join(f"  {name.ljust(width)}  {one.summary}" for name, one in kinds().items())


def schemes_listed() -> str:
    """Return the schemes of each kind that has some, in one sentence for help."""
    return "; ".join(f"{one.name}: {', '.join(one.schemes)}" for one in kinds().values() if one.schemes)
