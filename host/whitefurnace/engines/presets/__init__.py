"""The presets, found by listing this folder: a module here has `PRESET`, the description of one engine.

A new preset is one new module and touches nothing else. A user's own engine is the same description in a TOML file.
"""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from whitefurnace.engines.engine import (
    FORMATS,
    HOLDS,
    REDUCIBLE,
    SH_SCALES,
    SUFFIXES,
    Dfg,
    Engine,
    File,
    Holds,
    Preset,
    Published,
    axes_matrix,
    check,
    reduced,
)
from whitefurnace.errors import InputError, UsageError, nearest
from whitefurnace.files import read_text
from whitefurnace.text import shortened


def _presets() -> dict[str, Preset]:
    """Every preset by the name of its module, in the order that they state."""
    found = {
        info.name: importlib.import_module(f"{__name__}.{info.name}").PRESET for info in pkgutil.iter_modules(__path__)
    }
    return dict(sorted(found.items(), key=lambda one: (one[1].order, one[0])))


PRESETS = _presets()
ENGINES = {name: msgspec.structs.replace(preset.engine, name=name) for name, preset in PRESETS.items()}


def engines(names: str) -> tuple[Engine, ...]:
    """Return the engines of a list of names and `.toml` files, separated by commas; each appears once.

    Raises UsageError with the nearest name, and FileError or InputError for a file.
    """
    chosen: list[Engine] = []
    for name in (part.strip() for part in names.split(",")):
        engine = user_engine(name) if name.lower().endswith(".toml") else ENGINES.get(name)
        if engine is None:
            raise UsageError(f"unknown engine {name!r}{nearest(name, ENGINES)}, or FILE.toml")
        if engine in chosen:
            continue
        if engine.name in (other.name for other in chosen):
            raise UsageError(f"two engines are named {engine.name!r}: their outputs would be the same files")
        chosen.append(engine)
    return tuple(chosen)


def as_text(engine: Engine) -> str:
    """Return an engine as TOML that `user_engine` reads: the fields that differ from their defaults."""

    def value(x: Any) -> str:
        if isinstance(x, bool):
            return str(x).lower()
        if isinstance(x, list | tuple):
            return "[" + ", ".join(map(value, x)) + "]"
        return json.dumps(x, ensure_ascii=False) if isinstance(x, str) else repr(x)

    def lines(one: msgspec.Struct, left_out: Sequence[str] = ()) -> list[str]:
        usual = dict(zip(one.__struct_fields__[::-1], one.__struct_defaults__[::-1], strict=False))
        return [
            f"{name} = {value(getattr(one, name))}"
            for name in one.__struct_fields__
            if name not in left_out
            and getattr(one, name) is not None
            and (name not in usual or getattr(one, name) != usual[name])
        ]

    text = [
        f"# {engine.name}: {engine.facts}",
        *lines(engine, ("name", "facts", "proven", "container", "latlong", "without", "dfg", "file")),
    ]
    if table := lines(engine.dfg):
        text += ["", "[dfg]", *table]
    for file in engine.file:
        text += ["", "[[file]]", *lines(file)]
    return "\n".join(text) + "\n"


MOST_BYTES = 1 << 20


def user_engine(path: str | os.PathLike[str]) -> Engine:
    """Read the description of an engine from a TOML file.

    path: a file with the fields of `Engine`, `[dfg]` and `[[file]]`. The engine's name is the file's stem.
    Raises FileError for a file that cannot be read, and InputError for one that does not describe an engine.
    """
    path = Path(path)
    try:
        data = tomllib.loads(read_text(path, "the description of an engine", most=MOST_BYTES))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not TOML: {shortened(str(error))}") from None
    for key in ("name", "proven", "container", "latlong", "without", "facts"):
        if key in data:
            raise InputError(f"{path}: {key} cannot be given; the name is the file's stem")
    for where, given, known in _tables(data):
        for key in given:
            if key not in known:
                raise InputError(f"{path}: {where}{shortened(key, 60)} is not known{nearest(key, known)}")
    try:
        engine = msgspec.convert({**data, "name": path.stem, "facts": f"given in {path.name}"}, Engine)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {shortened(str(error))}") from None
    try:
        if engine.name in ENGINES:
            raise UsageError(f"{engine.name} is the name of a preset; rename the file")
        check(engine)
    except UsageError as error:
        raise InputError(f"{path}: {shortened(str(error))}") from None
    return engine


def engine_of_data(data: Any, where: str) -> Engine:
    """Return the engine that `Engine.data` described, as a manifest keeps it.

    where: the manifest, for error messages. Raises InputError for data that do not describe an engine.
    """
    try:
        engine = msgspec.convert(data, Engine)
        engine.lods, engine.bend_formula, engine.blend_formula, engine.matrix  # noqa: B018 - each raises if it is none
    except (msgspec.ValidationError, UsageError) as error:
        raise InputError(f"{where} describes an engine that is not valid: {error}") from None
    return engine


def _tables(data: dict[str, Any]) -> list[tuple[str, dict[str, Any], Sequence[str]]]:
    """Return the tables of a description: a prefix for errors, the fields given, and the names of the known fields."""
    found: list[tuple[str, dict[str, Any], Sequence[str]]] = [("", data, Engine.__struct_fields__)]
    if isinstance(data.get("dfg"), dict):
        found.append(("dfg.", data["dfg"], Dfg.__struct_fields__))
    if isinstance(data.get("file"), list):
        found += [
            (f"file[{k}].", one, File.__struct_fields__) for k, one in enumerate(data["file"]) if isinstance(one, dict)
        ]
    return found


__all__ = [
    "ENGINES",
    "FORMATS",
    "HOLDS",
    "PRESETS",
    "REDUCIBLE",
    "SH_SCALES",
    "SUFFIXES",
    "Dfg",
    "Engine",
    "File",
    "Holds",
    "Preset",
    "Published",
    "as_text",
    "axes_matrix",
    "engine_of_data",
    "engines",
    "reduced",
    "user_engine",
]
