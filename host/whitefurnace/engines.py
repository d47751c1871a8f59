"""A preset per consumer of a bake: what files it wants, in which layout. Data only."""
from __future__ import annotations

from dataclasses import dataclass

from whitefurnace.errors import UsageError, nearest


@dataclass(frozen=True)
class Engine:
    """`container` names the writer; `latlong` asks for each level as a lat-long too."""

    name: str
    title: str
    container: str
    latlong: bool = False


ENGINES = {
    engine.name: engine
    for engine in (
        Engine("raw", "numpy arrays in one .npz, GL-direct faces", "npz"),
        Engine("exr", "OpenEXR float32: a vertical strip and a lat-long a level", "exr", latlong=True),
    )
}


def engines(names: str) -> tuple[Engine, ...]:
    """The presets of a comma-separated list, each once. Raises UsageError with the nearest name."""
    chosen = []
    for name in (part.strip() for part in names.split(",")):
        if name not in ENGINES:
            raise UsageError(f"unknown engine {name!r}{nearest(name, ENGINES)}")
        if ENGINES[name] not in chosen:
            chosen.append(ENGINES[name])
    return tuple(chosen)
