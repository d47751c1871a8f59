"""Chooses the cheapest set of files whose error stays within a tolerance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from whitefurnace.advice.measure import Entry, ErrorMeter
from whitefurnace.advice.reads import Storage, writable_formats
from whitefurnace.baking.outputs import targets
from whitefurnace.engines.presets import ENGINES, Engine, reduced
from whitefurnace.errors import CheckError, UsageError
from whitefurnace.prefiltering.recipe import Chain, chain

TOLERANCE_RANGE = (1e-4, 1.0)

FILTERS = (1e-2, 1e-3)
"""Tolerances of the filter that are tried. Finer ones take longer, and reads between texels and levels hide their gain.
"""

SIZES = (32, 64, 128, 256, 512)
TABLES = (16, 32, 64, 128, 256)


@dataclass(frozen=True)
class Choice:
    """The cheapest set of files within a tolerance.

    options       options of `bake` other than --for
    nbytes        bytes of the files before compression
    usual_nbytes  bytes of the files of the engine's usual bake
    error         RMS error of the files, with the error that the filter may add and without the parts in `beyond`
    whole         RMS error of the engine's picture from these files
    binds         the part with the largest error among those that were judged
    met           True if `error` is within the tolerance
    beyond        errors above the tolerance that no choice changes
    tried         number of sets that were measured
    """

    tolerance: float
    options: Mapping[str, Any]
    engine: Engine
    recipe: Chain
    nbytes: int
    usual_nbytes: int
    error: float
    whole: float
    binds: Entry
    met: bool
    beyond: tuple[Entry, ...]
    tried: int


@dataclass(frozen=True)
class _Candidate:
    """One set of files: the description of the engine's files, its chain and its bytes before compression."""

    engine: Engine
    recipe: Chain
    nbytes: int


@dataclass(frozen=True)
class _Measured:
    """A candidate with the RMS errors of its files and of the engine's picture.

    short  the larger of the two errors divided by the tolerance, with the finest filter
    """

    candidate: _Candidate
    files: float
    whole: float
    short: float


def choose(meter: ErrorMeter, tolerance: float, recipe: Chain) -> Choice:
    """Find the cheapest set of files that adds at most `tolerance` (RMS) to the error of the picture from exact files.

    If the picture from exact files is itself within the tolerance, the whole picture must be too. Parts of the files
    whose error is above the tolerance and that no choice changes (`Choice.beyond`) are not judged.

    recipe: the engine's usual chain. tolerance: a number in TOLERANCE_RANGE. The sets vary face sizes, last sizes,
    numbers of levels, --fit read, table sizes and the filter's tolerance; for raw and exr also harmonics or a cube; for
    a user's own engine also the pixel formats of its container. The formats of a preset are fixed by what its loader
    accepts.

    Raises UsageError for a tolerance out of range, and CheckError where the filter meets no tolerance.
    """
    low, high = TOLERANCE_RANGE
    if not low <= tolerance <= high:
        raise UsageError(f"tolerance {tolerance:g} is outside [{low:g}, {high:g}]")
    engines = _engines(meter)
    fixed = _fixed(meter, engines, tolerance, recipe)
    but = [e.name for e in fixed]
    chains = _chains(meter, recipe)
    seen: list[_Measured] = []
    found: tuple[_Measured, Chain] | None = None
    for candidate in _candidates(engines, chains):
        if not meter.reads.is_baked(candidate.recipe):
            meter.reads.bake([other for other in chains if other.size == candidate.recipe.size])
        one = _measured(meter, candidate, but, tolerance, meter.floor.rms <= tolerance and not fixed)
        seen.append(one)
        enough = [t for t in FILTERS if one.files + t * meter.filter_share <= tolerance]
        if one.short <= 1 and (made := _certified(meter, candidate.recipe, recipe, enough)):
            found = one, made
            break
    met = found is not None
    if not met:
        found = _nearest(meter, recipe, seen)
    if found is None:
        raise CheckError(f"no chain of {meter.engine.name} can be filtered within {FILTERS[0]:g} in {meter.env.name}")
    best, made = found
    engine = best.candidate.engine
    entries = [e for e in meter.files(made, engine) if e.name not in but]
    beyond = (
        [meter.floor] * (meter.floor.rms > tolerance)
        + fixed
        + [e for e in (*meter.split, *meter.model) if e.rms > tolerance]
    )
    return Choice(
        tolerance,
        _options(meter, engine, made, recipe),
        engine,
        made,
        best.candidate.nbytes,
        _nbytes(meter.preset, recipe),
        best.files + entries[0].rms,
        best.whole,
        max(entries, key=lambda e: e.rms),
        met,
        tuple(beyond),
        len(seen),
    )


# ------------------------------------------------------------------------------------------------- measuring sets


def _fixed(meter: ErrorMeter, engines: Sequence[Engine], tolerance: float, recipe: Chain) -> list[Entry]:
    """Return the parts of the usual files whose error is above the tolerance and the same in every set."""
    storages = [Storage.of(engine) for engine in engines]
    return [
        e
        for e in meter.files(recipe, meter.engine)
        if e.rms > tolerance
        and (
            (e.name == "table" and storages[0].table is None)
            or (e.name == "format" and len({s.chain for s in storages}) == 1)
            or (e.name == "diffuse" and {s.diffuse[0] for s in storages} == {"sh"})
        )
    ]


def _measured(
    meter: ErrorMeter, candidate: _Candidate, but: Sequence[str], tolerance: float, reachable: bool
) -> _Measured:
    """Measure a candidate. but: parts that are not judged. reachable: judge the whole picture too."""
    engine, recipe = candidate.engine, candidate.recipe
    files = meter.entry("files", "files", meter.reads.picture(recipe, engine, but) - meter.reads.perfect, "").rms
    whole = meter.entry("whole", "other", meter.reads.picture(recipe, engine) - meter.right, "").rms
    short = max((files + FILTERS[-1] * meter.filter_share) / tolerance, whole / tolerance if reachable else 0.0)
    return _Measured(candidate, files, whole, short)


def _nearest(meter: ErrorMeter, usual_chain: Chain, seen: Iterable[_Measured]) -> tuple[_Measured, Chain] | None:
    """Return the set that misses the tolerance by the smallest amount, among those whose filter meets one of
    FILTERS.
    """
    for one in sorted(seen, key=lambda one: one.short):
        if made := _certified(meter, one.candidate.recipe, usual_chain, FILTERS[::-1]):
            return one, made
    return None


def _certified(meter: ErrorMeter, one: Chain, usual_chain: Chain, tolerances: Sequence[float]) -> Chain | None:
    """Return the chain with the first of the tolerances that its filter meets, None where it meets none of them."""
    for tolerance in tolerances:
        made = replace(one, tolerance=tolerance, certify=usual_chain.certify)
        try:
            meter.reads.bake([made])
        except CheckError:
            continue
        return made
    return None


# ------------------------------------------------------------------------------------------------- the sets


def _candidates(engines: Sequence[Engine], chains: Sequence[Chain]) -> list[_Candidate]:
    """Every engine with every chain: the smallest first, and a chain of plain lobes before a fitted one."""
    made = [_Candidate(engine, one, _nbytes(engine, one)) for engine in engines for one in chains]
    return sorted(made, key=lambda c: (c.nbytes, c.recipe.fit is not None))


def _engines(meter: ErrorMeter) -> list[Engine]:
    """The engine with other tables, pixel formats and diffuse light."""
    engine = meter.engine
    if engine.container != "files":
        both = engine.needs("sh") and engine.needs("irradiance")
        return [reduced(engine, (*engine.without, left)) for left in ("sh", "irradiance")] if both else [engine]
    found = [engine]
    if engine.holding("dfg") and engine.dfg.NoV == "centres":
        found = [reduced(engine, (), size) for size in sorted({*TABLES, engine.dfg.size})]
    if engine.name not in ENGINES:
        found = [
            msgspec.structs.replace(
                one,
                file=tuple(
                    msgspec.structs.replace(file, format=form) if file.holds == "specular" else file
                    for file in one.file
                ),
            )
            for one in found
            for form in writable_formats(engine.holding("specular")[0])
        ]
    return found


def _chains(meter: ErrorMeter, recipe: Chain) -> list[Chain]:
    """The chains that the engine can read, of every size, number of levels and fit."""
    engine = meter.engine
    found = []
    for size in sorted({*SIZES, recipe.size}):
        for fit in (None,) if engine.lods.follow else (None, "read"):  # levels that follow the lod go beyond r = 1
            # The certificates would cost more than the levels, so these chains have none.
            base: dict[str, Any] = {
                "lods": engine.lods,
                "size": size,
                "fit": fit,
                "ndf": recipe.ndf.model,
                "tolerance": FILTERS[-1],
                "certify": 0,
            }
            if engine.whole:
                found.append(chain(**base, usual_min=engine.min_size))
            elif engine.levels:
                if size >> (engine.levels - 1):
                    found.append(chain(**base, levels=engine.levels))
            else:
                found += [
                    chain(**base, min_size=last)
                    for last in sorted({max(recipe.min_size // 2, 1), recipe.min_size, 2 * recipe.min_size})
                    if last < size
                ]
    return found


def _options(meter: ErrorMeter, engine: Engine, one: Chain, usual: Chain) -> dict[str, Any]:
    """The options of `bake` that make this set of files."""
    found: dict[str, Any] = {}
    if one.size != usual.size:
        found["size"] = one.size
    if not meter.engine.whole and not meter.engine.levels and one.min_size != usual.min_size:
        found["min_size"] = one.min_size
    if one.fit:
        found["fit"] = one.fit
    if engine.dfg.size != meter.preset.dfg.size:
        found["table"] = engine.dfg.size
    if left := list(dict.fromkeys((*meter.without, *engine.without))):
        found["without"] = left
    form, own = Storage.of(engine).chain, Storage.of(meter.engine).chain
    if form != own:
        found["format"] = form
    return {**found, "tolerance": one.tolerance}


def _nbytes(engine: Engine, recipe: Chain) -> int:
    """Bytes of all files before compression."""
    return sum(target.nbytes for target in targets(engine, recipe, Path(), "x"))
