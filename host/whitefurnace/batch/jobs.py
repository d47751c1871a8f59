"""Reads the job file of `batch`, and runs its items.

The whole job is checked before any item runs. An item runs by the same functions in this process, in a worker process
and on a cluster.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import json
import math
import os
import re
import tempfile
import time
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast, get_type_hints

import msgspec

from whitefurnace.baking import bake as baking
from whitefurnace.baking.request import BakeRequest
from whitefurnace.batch import pool
from whitefurnace.catalogue.choice import file_of
from whitefurnace.catalogue.user import user_files
from whitefurnace.engines.presets import user_engine
from whitefurnace.errors import FileError, InputError, UsageError, WhitefurnaceError, code_of, nearest
from whitefurnace.files import (
    FileOutput,
    FolderOutput,
    digest_file,
    input_size,
    is_lock,
    is_safe,
    locks_in,
    read_input,
    read_text,
    write_atomic,
)
from whitefurnace.opencl.device import device_address
from whitefurnace.prefiltering.recipe import IRRADIANCE_SIZE
from whitefurnace.sphere.environments import DEMO, extent, is_demo, source_files, without_repeats
from whitefurnace.sphere.layouts import SIX_FACES
from whitefurnace.tables import lut as tables
from whitefurnace.tables.axes import named, named_axes
from whitefurnace.tables.request import TableRequest
from whitefurnace.text import shortened

MOST_BYTES = 16 << 20
"""Largest size of a job file; ten thousand paths take about one megabyte."""

MOST_ITEMS = 1_000_000
MOST_SEEN = 2_000_000
"""Largest number of names in folders that are compared with the patterns of a job: a few seconds of work."""

MOST_TABLE = 1 << 34
"""Largest size of a table in a job, in bytes. `lut` has no such limit, because its user typed the size."""

MOST_REPORTED = 100
"""Largest number of mistakes in the error message of a job."""

MISSING = "\0"
"""Stands for a path that a job does not give, so that the rest of its table can be checked."""

TIMEOUT = "item_timeout"
"""The key of a job that limits the seconds that an item may take."""


class Bake(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"for_": "for"}, omit_defaults=True):
    """A table `[[bake]]` of a job: environments (paths and patterns), the output folder, and options of `bake`.

    These are the fields that a job writes in its own way; `TABLES` has the other options of a `BakeRequest` too.
    """

    environments: list[str]
    output: str
    for_: list[str] | None = None
    without: list[str] | None = None
    certify: int | None = None

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


class Lut(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"for_": "for"}, omit_defaults=True):
    """A table `[[lut]]` of a job: kind, output file, and options of `lut`.

    These are the fields that a job writes in its own way; `TABLES` has the other options of a `TableRequest` too.
    `axis` and `set` are lists of the values of these options.
    """

    kind: str
    output: str
    size: int | str | None = None
    axis: list[str] = []
    set: list[str] = []
    for_: str | None = None
    format: str | None = None
    environment: str | None = None
    normal: tuple[float, float, float] | None = None

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


_T = TypeVar("_T", bound=msgspec.Struct)


def _with_options(own: type[_T], request: type, elsewhere: Collection[str]) -> type[_T]:
    """Return `own` with the other options of `request`, so that a new option is written once.

    elsewhere: options that a table of a job does not have, or has by another name. A model is a text in a job.
    """
    python_only = {"np": SimpleNamespace(ndarray=object), "Environment": object, "AxisSpec": object, "Source": object}
    types = get_type_hints(request, localns={**python_only, "Spec": str})
    options = [
        (option.name, types[option.name], option.default)
        for option in dataclasses.fields(request)
        if option.name not in {*own.__struct_fields__, *elsewhere}
    ]
    made = msgspec.defstruct(own.__name__, options, bases=(own,), frozen=True)
    return cast(type[_T], made)


TABLES: dict[str, type[Bake] | type[Lut]] = {
    "bake": _with_options(Bake, BakeRequest, ("sources", "force")),
    "lut": _with_options(Lut, TableRequest, ("path", "axes", "parameters", "stored", "force")),
}
MODELS = ("ndf", "masking", "fresnel", "diffuse", "brdf", "light")
"""Options that name a model, or a file with a user's model."""


class Sent(msgspec.Struct, frozen=True):
    """An input that is sent by value: a file with the files that it refers to, or a folder of faces.

    main   name of the file itself, or None for a folder
    files  bytes of each file by its name relative to the folder
    """

    main: str | None
    files: dict[str, bytes]


class Item(msgspec.Struct, frozen=True):
    """One environment to bake or one table to make, as plain data that a worker can receive.

    index    number of the item in the job
    place    its place in the job file, for messages
    name     stem of the files of a bake, or file name of a table
    source   path of the environment, or the word demo; for a table its kind
    output   folder of a bake, or file of a table; it must stay below the folder `root`
    recipe   the options as JSON, with the digests of the files that they name
    force    whether outputs are made again, and files of others overwritten
    device   the OpenCL device to use, or None for the default
    send     whether the files that it reads are sent to a cluster by value; `content` then holds them by their paths
    """

    index: int
    kind: Literal["bake", "lut"]
    place: str
    name: str
    source: str
    output: str
    root: str
    recipe: str
    force: bool = False
    device: str | None = None
    send: bool = False
    content: dict[str, Sent] | None = None


class Result(msgspec.Struct, frozen=True):
    """The result of an item.

    state      done, skipped (up to date), failed, or planned (in a dry run)
    manifest   path of the manifest
    seconds    wall time of reading, computing and writing
    nbytes     size of all files; `files` has the size of each by its path
    error      the largest error that a level, or the table, states
    predicted  for a planned bake, processor seconds and bytes of memory
    message    reason of a failure; `exit_code` is that of its error
    The other fields are those of the item.
    """

    index: int
    kind: str
    place: str
    name: str
    state: Literal["done", "skipped", "failed", "planned"]
    output: str
    manifest: str = ""
    seconds: dict[str, float] = {}
    nbytes: int = 0
    files: dict[str, int] = {}
    error: float | None = None
    predicted: dict[str, float] = {}
    notices: tuple[str, ...] = ()
    message: str = ""
    exit_code: int = 0


# ---------------------------------------------------------------------------------------------- the job file


@dataclass(frozen=True)
class Job:
    """A checked job.

    path     the job file; `root` is the folder that outputs stay below
    items    its items in order
    named    files that recipes name: models, engines and environments of tables
    looked   folders that were searched for patterns
    folders  folders of outputs that do not exist yet, innermost first
    item_timeout  seconds that an item may take, or None for no limit
    """

    path: Path
    root: Path
    items: tuple[Item, ...]
    named: tuple[Path, ...]
    looked: tuple[Path, ...]
    folders: tuple[Path, ...]
    item_timeout: float | None = None

    def shard(self, k: int, n: int) -> Job:
        """Return the job with every n-th item from the k-th on, k from 1 to n.

        An item that is added at the end of a job does not move the others to another shard.
        """
        return replace(self, items=self.items[k - 1 :: n])

    def predicted(self) -> Iterator[Result]:
        """Predict the result of each item from headers and digests, without running it."""
        return map(predict, self.items)


def job(
    path: str | os.PathLike[str],
    *,
    root: str | os.PathLike[str] | None = None,
    allow_kernels: bool = False,
    force: bool = False,
    device: str | None = None,
    send: bool = False,
) -> Job:
    """Read a job file (TOML) and check it completely. No item runs, and no image is decoded.

    root: the folder that outputs stay below, by default that of the job file. allow_kernels: whether recipes may name
    `.clh` files, whose text runs on the device. force: make all outputs again, and overwrite files of others. device:
    the OpenCL device of all items. send: send sources to a cluster by value.
    Raises FileError for a file that cannot be read, and InputError for an invalid job: unknown keys, impossible values,
    patterns without a match, outputs outside `root`, or two recipes that write the same file.
    """
    path = Path(path)
    data = _parsed(path)
    wrong: list[str] = []
    tables_: list[tuple[str, Bake | Lut]] = []
    timeout = _timeout_of(data, wrong)
    for name, entries in data.items():
        if name not in TABLES:
            wrong.append(f"{name} is not known{nearest(name, [*TABLES, TIMEOUT])}")
        elif not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            wrong.append(f"{name} is not a list of tables; write [[{name}]]")
        else:
            tables_ += [
                (f"{name}[{k}]", made)
                for k, entry in enumerate(entries)
                if (made := _converted(TABLES[name], entry, f"{name}[{k}]", wrong))
            ]
    if not data and not wrong:
        wrong.append("it has no [[bake]] and no [[lut]]")
    base = Path(os.path.realpath(path)).parent
    maker = _Maker(
        path,
        base,
        Path(os.path.realpath(root if root is not None else base)),
        allow_kernels,
        force,
        device,
        send,
        wrong,
    )
    for place, table in tables_:
        if isinstance(table, Bake):
            maker.outputs(place, table)
    for place, table in tables_:
        try:
            if isinstance(table, Bake):
                maker.bake(place, table)
            else:
                maker.lut(place, table)
        except _TooMany as error:
            wrong.append(f"{place}: {error}")
            break
        if len(maker.items) > MOST_ITEMS:
            wrong.append(f"{place} makes it over {MOST_ITEMS} items; split the job")
            break
    maker.check_inputs()
    _raise_all(path, wrong)
    return replace(maker.job(), item_timeout=timeout)


def _timeout_of(data: dict[str, Any], wrong: list[str]) -> float | None:
    """Take the time limit of items out of a job; on a mistake, add it to `wrong` and return None."""
    for key in (TIMEOUT, TIMEOUT.replace("_", "-")):
        if key in data:
            value = data.pop(key)
            try:
                return pool.checked_limit(value)
            except UsageError as error:
                wrong.append(f"{key}: {error}")
    return None


def shard_of(text: str) -> tuple[int, int]:
    """Parse a shard `I/N` with 1 <= I <= N to (I, N). Raises UsageError."""
    found = re.fullmatch(r"\s*(\d{1,7})\s*/\s*(\d{1,7})\s*", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise UsageError(f"shard {text!r} is not I/N with 1 <= I <= N")
    return int(found[1]), int(found[2])


def _parsed(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(read_text(path, "a job", most=MOST_BYTES))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not TOML: {error}") from None


def _raise_all(path: Path, wrong: Sequence[str]) -> None:
    """Raise InputError with all mistakes of a job, if there are any."""
    if wrong:
        more = f"; and {len(wrong) - MOST_REPORTED} more" if len(wrong) > MOST_REPORTED else ""
        raise InputError(f"{path}: {'; '.join(shortened(one, 600) for one in wrong[:MOST_REPORTED])}{more}")


def _converted(kind: type[Bake] | type[Lut], entry: dict[str, Any], place: str, wrong: list[str]) -> Bake | Lut | None:
    """Convert a table of the job file to its type, and add every mistake to `wrong`.

    A value of a wrong type counts as not given, and `MISSING` takes the place of one that is required.
    """
    fields = {field.name.rstrip("_"): field for field in msgspec.structs.fields(kind)}
    given: dict[str, Any] = {}
    seen: set[str] = set()
    for key, value in entry.items():
        name = key.replace("-", "_")
        if name not in fields:
            wrong.append(f"{place}.{key} is not known{nearest(name, fields)}")
        elif name in seen:
            wrong.append(f"{place}.{key} is given twice, as {name} and {name.replace('_', '-')}")
        else:
            seen.add(name)
            try:
                given[fields[name].name] = msgspec.convert(value, fields[name].type)
            except msgspec.ValidationError as error:
                text, _, where = str(error).partition(" - at `$")
                wrong.append(f"{place}.{key}{where.rstrip('`')}: {text[0].lower()}{text[1:]}")
    for name, field in fields.items():
        if field.required and name not in given:
            wrong += [] if name in seen else [f"{place} has no `{name}`"]
            if name == "kind":  # without it nothing else means anything
                return None
            given[name] = MISSING if field.type is str else [MISSING]
    return kind(**given)


class _Maker:
    """Makes the items of a job from its tables, and collects the mistakes in `wrong`."""

    def __init__(
        self,
        path: Path,
        base: Path,
        root: Path,
        allow_kernels: bool,
        force: bool,
        device: str | None,
        send: bool,
        wrong: list[str],
    ) -> None:
        self.path, self.base, self.root = path, base, root
        self.allow_kernels, self.force, self.device, self.send = allow_kernels, force, device, send
        self.wrong = wrong
        self.items: list[Item] = []
        self.owner: dict[str, str] = {}  # by file that is written: the place of its item
        self.named: dict[Path, None] = {}
        self.finder = _Finder()
        self.own: list[Path] = []  # output folders, which patterns do not search
        self.folders: set[Path] = set()  # every folder that is written to, and their parents below the root

    def job(self) -> Job:
        missing = sorted((folder for folder in self.folders if not os.path.exists(folder)), reverse=True)
        return Job(
            self.path, self.root, tuple(self.items), tuple(self.named), tuple(self.finder.looked), tuple(missing)
        )

    def _into(self, folder: Path) -> None:
        """Note a folder that is written to, and its parents."""
        while folder not in self.folders and folder != self.root and _below(self.root, folder):
            self.folders.add(folder)
            folder = folder.parent

    def say(self, place: str, error: Exception) -> None:
        self.wrong.append(f"{place}: {error}")

    def outputs(self, place: str, table: Bake) -> None:
        """Note the output folder of a bake. All are noted first, because patterns do not search them."""
        if (folder := self._output(place, table.output)) not in (None, self.root):
            assert folder
            self.own.append(folder)

    def _output(self, place: str, output: str, report: bool = False) -> Path | None:
        """Return the absolute path of an output; None where it is not below the root, links followed.

        report: whether a mistake is added to `wrong`.
        """
        if not output or "\0" in output:
            self.wrong += [f"{place}.output is empty"] if report and output != MISSING else []
            return None
        # Both paths must be below the root: `..` after a link is the parent of the link's target.
        plain, real = os.path.normpath(self.root / output), os.path.realpath(self.root / output)
        if all(_below(self.root, where) for where in (plain, real)):
            return Path(plain)
        if report:
            self.wrong.append(
                f"{place}.output {output!r} is outside {self.root}; outputs are relative to the job "
                "file's folder and stay below it, or below the folder of -o"
            )
        return None

    def _models(self, place: str, table: Bake | Lut) -> tuple[dict[str, str], set[str]]:
        """Return the options that name kernel files, with absolute paths, and those that may not."""
        found, refused = {}, set()
        for option in MODELS:
            spec = getattr(table, option, None)
            file = file_of(spec) if spec else None
            if spec and file and not self.allow_kernels:
                refused.add(option)
                self.wrong.append(
                    f"{place}.{option} names {file}, whose text a device would run: give "
                    "--allow-kernels where you trust it"
                )
            elif spec and file:
                found[option] = f"{self.base / file}{spec[len(file) :]}"
        return found, refused

    def _planned(
        self, place: str, options: dict[str, Any], plan: Callable[[dict[str, Any]], Planned]
    ) -> Planned | None:
        """Plan a recipe and return the plan; None where it has mistakes, which are all told.

        Planning ends at its first mistake. Its cause is the option without which another mistake or none is found. That
        is left out, with those whose meaning depends on it, and the rest is planned again.
        """
        left = dict(options)
        while True:
            found = _attempt(plan, left)
            if not isinstance(found, WhitefurnaceError):
                return found if left == options else None
            cause = _cause(plan, left, found)
            if cause is not None or left == options:  # else it may come from what was left out
                self.say(f"{place}.{cause.rstrip('_')}" if cause else place, found)
            if cause is None:
                return None
            for name in (cause, *DEPENDENT.get(cause, ())):
                left.pop(name, None)

    def bake(self, place: str, table: Bake) -> None:
        """Add an item for each environment of a `[[bake]]`."""
        output = self._output(place, table.output, report=True)
        models, refused = self._models(place, table)
        files = [str(self.base / name) if name.lower().endswith(".toml") else name for name in table.for_ or ()]
        for name in files:
            if "," in name:
                self.wrong.append(f"{place}.for: {name!r} has a comma; it is a list")
                refused.add("for_")
        if table.for_ is not None and not table.for_:
            self.wrong.append(f"{place}.for is empty")
        options = {
            name: value
            for name in table.__struct_fields__
            if name not in ("environments", "output", *refused) and (value := getattr(table, name)) is not None
        }
        options |= models
        if "for_" not in refused:
            options["for_"] = ",".join(files or ["raw"])

        def plan(some: dict[str, Any]) -> tuple[str, baking.BakePlan]:
            recipe = self._recipe(some)
            return recipe, _bake_plan(recipe, str(output or self.root), self.force)

        broken = any(map(_is_broken, files))
        if broken:
            refused.add("for_")
        planned = self._planned(place, {name: o for name, o in options.items() if name not in refused}, plan)
        sources: dict[str, None] = {}
        for k, pattern in enumerate(table.environments):
            if pattern == MISSING:
                continue
            try:
                found = self._environments(pattern)
            except _TooMany:
                raise
            except InputError as error:
                self.say(f"{place}.environments[{k}]", error)
                continue
            sources |= dict.fromkeys(found)
        if not table.environments:
            self.wrong.append(f"{place}.environments is empty")
        if planned is None or output is None:
            return
        recipe, order = planned
        # Every file name contains the stem, so the files of one item give the files of each.
        relative = [os.path.relpath(t.path, output) for t in baking.targets_of(order, _STEM)] + [f"{_STEM}.json"]
        if broken:  # these items fail when they run, and the others do not
            recipe, relative = _encoded(options, {}), [f"{_STEM}.json"]
        for one in relative:
            self._into((output / one).parent)
        for source in sources if table.layout not in (None, SIX_FACES) else without_repeats(sources):
            try:
                name = baking.name_of(source, table.layout)
            except UsageError as error:
                self.say(place, error)
                continue
            where = f"{place}: {os.path.relpath(source, self.base) if _below(self.base, source) else source}"
            self._take(where, [os.path.join(output, one.replace(_STEM, name)) for one in relative])
            self.items.append(
                Item(
                    len(self.items),
                    "bake",
                    where,
                    name,
                    source,
                    str(output),
                    str(self.root),
                    recipe,
                    self.force,
                    self.device,
                    self.send,
                )
            )

    def _environments(self, pattern: str) -> list[str]:
        """Return the paths that a path or pattern names, or the word demo. Raises InputError where there are none."""
        if "\0" in pattern or not pattern:
            raise InputError("an empty path")
        own = self.base / pattern
        if os.path.lexists(own):  # an existing path has priority over the word demo and over patterns
            return [str(own)]
        if pattern == DEMO:
            return [pattern]
        if not re.search(r"[*?\[]", pattern):
            raise InputError(f"{pattern!r} is not there")
        found = self.finder.find(self.base, pattern)
        # Outputs of an earlier run of this job are not its inputs.
        inside = [folder for folder in self.own if not _below(folder, os.path.normpath(self.base / _fixed(pattern)))]
        found = [one for one in found if not any(_below(folder, one) for folder in inside)]
        if not found:
            raise InputError(f"nothing matches {pattern!r}")
        return found

    def lut(self, place: str, table: Lut) -> None:
        """Add the item of a `[[lut]]`."""
        output = self._output(place, table.output, report=True)
        models, refused = self._models(place, table)
        options = {
            name: value
            for name in table.__struct_fields__
            if name not in ("output", *refused) and (value := getattr(table, name)) not in (None, [])
        }
        options |= {"output": str(output)} if output is not None else {}
        options |= models
        if table.for_ is not None and table.for_.lower().endswith(".toml"):
            options["for_"] = str(self.base / table.for_)
        if table.environment is not None and not (table.environment == DEMO and not (self.base / DEMO).exists()):
            options["environment"] = str(self.base / table.environment)

        def plan(some: dict[str, Any]) -> str:
            some = dict(some)
            kind, file = some.pop("kind", "dfg"), some.pop("output", str(self.root / "table.npy"))
            recipe = _encoded(some, {})
            try:
                recipe = self._recipe(some)
                request = _table_plan(recipe, kind, file, self.force)
            except (FileError, InputError):
                if "environment" not in some:
                    raise
                return recipe  # an environment that cannot be read fails this item alone, when it runs
            if request.nbytes > MOST_TABLE:
                raise UsageError(f"a table of {request.nbytes} bytes; a job's have at most {MOST_TABLE}")
            return recipe

        recipe = self._planned(place, options, plan)
        if recipe is None or output is None:
            return
        where = f"{place}: {table.output}"
        self._into(output.parent)
        self._take(where, [str(output), f"{output}.json"])
        self.items.append(
            Item(
                len(self.items),
                "lut",
                where,
                output.name,
                table.kind,
                str(output),
                str(self.root),
                recipe,
                self.force,
                self.device,
                self.send,
            )
        )

    def _recipe(self, options: dict[str, Any]) -> str:
        """Return the recipe of options, and note the files that it names."""
        files = named_files(options)
        self.named |= {file: None for parts in files.values() for file in parts.values()}
        return _encoded(options, files)

    def _take(self, place: str, files: Iterable[str]) -> None:
        """Note the files that an item writes; it is a mistake if another item writes one of them."""
        for file in files:
            other = self.owner.setdefault(os.path.normcase(file), place)
            if other is not place:
                self.wrong.append(f"{place} and {other} both write {file}")
                return

    def check_inputs(self) -> None:
        """Add a mistake for each item that reads a file which the job writes."""
        for item in self.items:
            if item.kind == "bake" and (writer := self.owner.get(os.path.normcase(os.path.normpath(item.source)))):
                self.wrong.append(f"{item.place} is read, and written by {writer}")


_STEM = "STEM\x7fSTEM"  # no file has this in its name


def _below(folder: str | os.PathLike[str], path: str | os.PathLike[str]) -> bool:
    """Return whether a normalized absolute path is `folder` or below it."""
    folder, path = os.path.normcase(folder), os.path.normcase(path)
    return path == folder or path.startswith(folder.rstrip(os.sep) + os.sep)


def _fixed(pattern: str) -> str:
    """Return the folders of a pattern before its first wildcard."""
    parts = pattern.split("/")[:-1]
    first = next((k for k, part in enumerate(parts) if re.search(r"[*?\[]", part)), len(parts))
    return "/".join(parts[:first]) or "."


DEPENDENT = {
    "size": ("min_size", "levels", "only_levels", "axis"),
    "min_size": ("size", "levels", "only_levels"),
    "levels": ("size", "min_size", "only_levels"),
    "tolerance": ("quality",),
    "quality": ("tolerance",),
    "axis": ("size", "set"),
    "set": ("axis",),
    "scheme": ("axis", "set", "size", "format"),
    "for_": ("sh", "without", "table", "only_levels", "fit", "as_read", "scheme", "format"),
    "kind": tuple(Lut.__struct_fields__),
    **dict.fromkeys(MODELS, ("axis", "set")),
}
"""For an option that is left out, the others whose meaning depends on it."""

Planned = TypeVar("Planned")


def _attempt(plan: Callable[[dict[str, Any]], Planned], options: dict[str, Any]) -> Planned | WhitefurnaceError:
    """Return what `plan` returns, or the error that it raises."""
    try:
        return plan(options)
    except WhitefurnaceError as error:
        return error


def _cause(plan: Callable[[dict[str, Any]], Any], options: dict[str, Any], error: WhitefurnaceError) -> str | None:
    """Return the option that causes an error of `plan`: without it there is another one or none. None if all do."""
    text = str(error)
    # Options that the message speaks of come first: without another one something different may be missing.
    likely = sorted(options, key=lambda name: not (name.rstrip("_") in text or str(options[name]) in text))
    for name in likely:
        found = _attempt(plan, {other: value for other, value in options.items() if other != name})
        if not isinstance(found, WhitefurnaceError) or str(found) != text:
            return name
    return None


class _TooMany(InputError):
    """Too many names were searched; the remaining patterns are not tried."""


class _Finder:
    """Finds the paths that match patterns with *, ? and [...] in names, and ** for any folders.

    Hidden names match only a part that begins with a dot, and ** does not follow links to folders. At most MOST_SEEN
    names are compared.
    """

    def __init__(self) -> None:
        self.seen = 0
        self.looked: dict[Path, None] = {}
        self._kept: dict[str, list[tuple[str, bool, bool]]] = {}

    def find(self, base: Path, pattern: str) -> list[str]:
        """Return the sorted paths that match, without duplicates. Raises InputError for more than MOST_SEEN names."""
        parts = [part for part in re.split(r"[/\\]" if os.sep == "\\" else "/", pattern) if part]
        start = str(base)
        if os.path.isabs(pattern):
            start = Path(pattern).anchor
            parts = list(Path(pattern).parts[1:])
        found: dict[str, None] = {}
        self._walk(start, parts, 0, found)
        return sorted(found)

    def _names(self, folder: str) -> list[tuple[str, bool, bool]]:
        """Return (name, is a folder, is a link) of each entry of a folder; an empty list where it cannot be read."""
        if folder not in self._kept:
            self.looked[Path(folder)] = None
            try:
                with os.scandir(folder) as entries:
                    self._kept[folder] = [(e.name, e.is_dir(), e.is_symlink()) for e in entries]
            except OSError:
                self._kept[folder] = []
        self.seen += len(self._kept[folder]) + 1
        if self.seen > MOST_SEEN:
            raise _TooMany(f"the patterns of this job look at over {MOST_SEEN} names; make them narrower")
        return self._kept[folder]

    def _walk(self, folder: str, parts: Sequence[str], k: int, found: dict[str, None]) -> None:
        """Add the paths below `folder` that match the parts of a pattern from part k on."""
        part, last = parts[k], k == len(parts) - 1
        if part == "**":
            if not last:
                self._walk(folder, parts, k + 1, found)
            for name, is_folder, link in self._names(folder):
                if name.startswith("."):
                    continue
                if last:
                    found[os.path.join(folder, name)] = None
                if is_folder and not link:
                    self._walk(os.path.join(folder, name), parts, k, found)
            return
        if not re.search(r"[*?\[]", part):
            path = os.path.normpath(os.path.join(folder, part))
            if last and os.path.lexists(path):
                found[path] = None
            elif not last and os.path.isdir(path):
                self._walk(path, parts, k + 1, found)
            return
        match = re.compile(fnmatch.translate(part)).match
        for name, is_folder, _ in self._names(folder):
            if match(name) and (part.startswith(".") or not name.startswith(".")):
                path = os.path.join(folder, name)
                if last:
                    found[path] = None
                elif is_folder:
                    self._walk(path, parts, k + 1, found)


# ---------------------------------------------------------------------------------------------- recipes


def named_files(options: Mapping[str, Any]) -> dict[str, dict[str, Path]]:
    """Return the files that the options of an item name: models, engines, and the environment of a table.

    The result has, by the path of each, this file and the files that it refers to, by their names relative to its
    folder. Raises the errors of reading them.
    """
    found: dict[str, dict[str, Path]] = {}
    for name in MODELS:
        if (spec := options.get(name)) and (file := file_of(spec)):
            top = os.path.dirname(file)
            found[file] = {os.path.relpath(one, top or "."): one for one in user_files(file)}
    for name in options.get("for_", "").split(","):
        if name.lower().endswith(".toml"):
            found[name] = {os.path.basename(name): Path(name)}
    if (environment := options.get("environment")) and not is_demo(environment):
        found[environment] = source_files(environment, options.get("layout"))
    return found


def _is_broken(name: str) -> bool:
    """Return whether a file is the description of an engine and is not valid; False where it cannot be read."""
    if not name.lower().endswith(".toml"):
        return False
    try:
        user_engine(name)
    except InputError:
        return True
    except WhitefurnaceError:
        pass
    return False


def _encoded(options: Mapping[str, Any], files: Mapping[str, Mapping[str, Path]]) -> str:
    """Encode options as JSON, with the digests of the files that they name.

    A worker caches plans by this text, so a changed file gives a new plan.
    """
    digests = {path: {name: digest_file(file) for name, file in parts.items()} for path, parts in files.items()}
    return json.dumps({"options": options, "files": digests}, sort_keys=True)


class _Received:
    """Files that were sent with an item. All are equal, since the recipe beside them has their digests."""

    def __init__(self, files: Mapping[str, Sent]) -> None:
        self.files = files

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Received)

    def __hash__(self) -> int:
        return 0


_NOTHING = _Received({})


@lru_cache(maxsize=64)
def _bake_plan(recipe: str, output: str, force: bool, received: _Received = _NOTHING) -> baking.BakePlan:
    """Return the plan of a `[[bake]]`, with a placeholder for the environment."""
    with _unpacked(received.files) as places:
        options = _moved(json.loads(recipe)["options"], places)
        return baking.plan(BakeRequest(["environment"], output, force=force, **options))


def _plan_of(item: Item) -> baking.BakePlan:
    """Return the plan of a bake's item, with a placeholder for the environment."""
    files = {path: sent for path, sent in (item.content or {}).items() if path != item.source}
    return _bake_plan(item.recipe, item.output, item.force, _Received(files))


def _moved(options: dict[str, Any], places: Mapping[str, str]) -> dict[str, Any]:
    """Return options with the paths of files that were sent replaced by the places where they were unpacked."""
    moved = dict(options)
    for name in MODELS:
        if (spec := options.get(name)) and (file := file_of(spec)) in places:
            assert file is not None
            moved[name] = places[file] + spec[len(file) :]
    if "for_" in options:
        moved["for_"] = ",".join(places.get(name, name) for name in options["for_"].split(","))
    if options.get("environment") in places:
        moved["environment"] = places[options["environment"]]
    return moved


def _table_of(item: Item) -> tables.TablePlan:
    """Return the plan of a table's item; an environment is read here."""
    with _unpacked(item.content or {}) as places:
        return _table_plan(item.recipe, item.source, item.output, item.force, places)


def _table_plan(
    recipe: str, kind: str, output: str, force: bool, places: Mapping[str, str] | None = None
) -> tables.TablePlan:
    options = _moved(json.loads(recipe)["options"], places or {})
    axes, fixed = options.pop("axis", []), options.pop("set", [])
    return tables.plan(
        TableRequest(
            kind,
            output,
            force=force,
            stored=options.pop("format", None),
            axes=named_axes("axis", axes),
            parameters=named("set", fixed),
            **options,
        )
    )


# ---------------------------------------------------------------------------------------------- doing


@dataclass(frozen=True)
class Prepared:
    """An item after reading. `loaded` is None where there is nothing to read: for the built-in environment and for
    tables.
    """

    item: Item
    loaded: baking.Loaded | None
    seconds: float


@dataclass(frozen=True)
class Computed:
    """An item after computing, before encoding and writing."""

    item: Item
    made: baking.Computed
    seconds: dict[str, float]


def failed(item: Item, message: str, exit_code: int = 2) -> Result:
    """Return the result of an item that failed, with the reason and the exit code."""
    return Result(
        item.index, item.kind, item.place, item.name, "failed", item.output, message=message, exit_code=exit_code
    )


def _failure(item: Item, error: Exception) -> Result:
    """Return the result of an item that raised `error`."""
    if isinstance(error, WhitefurnaceError):
        return failed(item, str(error), error.exit_code)
    if isinstance(error, MemoryError):
        return failed(item, "there is not enough memory for this; a smaller input or size is needed")
    if isinstance(error, OSError):
        return failed(item, f"cannot use {error.filename or item.output}: {error.strerror or error}")
    return failed(item, f"{type(error).__name__}: {error}", code_of(error))


def prepare(item: Item) -> Prepared | Result:
    """Read the source of an item and lock its output. This may run while the device computes an earlier item."""
    begin = time.perf_counter()
    try:
        _check_inside(item)
        if item.kind == "lut" or item.source == DEMO:
            return Prepared(item, None, time.perf_counter() - begin)
        with _source(item) as source:
            found = baking.read(_one(item, source), 0)
        if isinstance(found, baking.Baked):
            return _of_baked(item, found, {"read": time.perf_counter() - begin})
        return Prepared(item, found, time.perf_counter() - begin)
    except Exception as error:
        return _failure(item, error)


def compute(prepared: Prepared) -> Computed | Result:
    """Compute an item on the device. Only one thread of a process may call this at a time."""
    item, begin = prepared.item, time.perf_counter()
    loaded = prepared.loaded
    try:
        if item.kind == "lut":
            Path(item.output).parent.mkdir(parents=True, exist_ok=True)
            table = tables.make(_table_of(item), item.device)
            return _of_table(item, table, {"compute": time.perf_counter() - begin})
        if loaded is None:
            found = baking.read(_one(item), 0, item.device)
            if isinstance(found, baking.Baked):
                return _of_baked(item, found, {"read": time.perf_counter() - begin})
            loaded = found
        made = baking.compute(loaded, item.device)
        return Computed(item, made, {"read": prepared.seconds, "compute": time.perf_counter() - begin})
    except BaseException as error:
        if loaded is not None:
            baking.abandon(loaded)
        if isinstance(error, Exception):
            return _failure(item, error)
        raise


def write(computed: Computed) -> Result:
    """Encode and write an item. This may run while the device computes a later item."""
    item, begin = computed.item, time.perf_counter()
    try:
        _check_inside(item)
        baked = baking.write(computed.made)
        return _of_baked(item, baked, {**computed.seconds, "write": time.perf_counter() - begin})
    except BaseException as error:
        baking.abandon(computed.made)
        if isinstance(error, Exception):
            return _failure(item, error)
        raise


def abandon(found: Prepared | Computed) -> None:
    """Release the lock and the memory of an item that will not be finished."""
    held = found.made if isinstance(found, Computed) else found.loaded
    if held is not None:
        baking.abandon(held)


def do(item: Item) -> Result:
    """Read, compute and write one item. A failure is returned as a result and not raised."""
    found: Prepared | Computed | Result = prepare(item)
    if isinstance(found, Prepared):
        found = compute(found)
    if isinstance(found, Computed):
        found = write(found)
    assert isinstance(found, Result)
    return found


def _one(item: Item, source: str | None = None) -> baking.BakePlan:
    """Return the plan of one item, reading `source` in place of the item's own where it is given."""
    return replace(_plan_of(item), names=(item.name,), sources=(source or item.source,))


MOST_SENT = 1 << 30
"""Largest size of what is sent to a cluster for one item, in bytes."""


def load(item: Item) -> Item:
    """Return the item with the files that it reads, where these are sent by value. Raises FileError and InputError.

    They are its source with what that refers to, and the models, engines and environments that its recipe names.
    """
    if not item.send:
        return item
    named = named_files(json.loads(item.recipe)["options"])
    if item.kind == "bake" and item.source != DEMO:
        named[item.source] = source_files(item.source, _one(item).reading.layout)
    size = sum(input_size(file) for parts in named.values() for file in parts.values())
    if size > MOST_SENT:
        raise InputError(f"{item.source} needs {size} bytes, at most {MOST_SENT} are sent; use a shared folder")
    content = {
        path: Sent(
            None if os.path.isdir(path) else os.path.basename(path),
            {name: read_input(file, most=MOST_SENT) for name, file in parts.items()},
        )
        for path, parts in named.items()
    }
    return msgspec.structs.replace(item, content=content)


@contextlib.contextmanager
def _unpacked(content: Mapping[str, Sent]) -> Iterator[dict[str, str]]:
    """Write files that were sent into a temporary folder; give the place of each input there by its own path."""
    if not content:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="whitefurnace-") as folder:
        places = {}
        for k, (path, sent) in enumerate(content.items()):
            base = Path(folder, str(k), "beside" if sent.main else os.path.basename(os.path.abspath(path)))
            for name, data in sent.files.items():
                if not is_safe(Path(name).as_posix()):
                    raise InputError(f"{path} refers to {name}, outside its folder, and cannot be sent")
                file = base / name
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(data)
            places[path] = str(base / sent.main if sent.main else base)
        yield places


@contextlib.contextmanager
def _source(item: Item) -> Iterator[str]:
    """Give the path of the item's source: its own, or one in a temporary folder with the content that was sent."""
    own = {path: sent for path, sent in (item.content or {}).items() if path == item.source}
    with _unpacked(own) as places:
        yield places.get(item.source, item.source)


def _check_inside(item: Item) -> None:
    """Refuse output folders outside the root, links followed. A link may be newer than the check of the job."""
    folders = (
        {Path(item.output).parent}
        if item.kind == "lut"
        else {
            Path(item.output),
            *(t.path.parent for t in baking.targets_of(_plan_of(item), _STEM)),
        }
    )
    for folder in sorted(folders):
        if not _below(item.root, os.path.realpath(folder)):
            raise FileError(f"{folder} leads out of {item.root}: outputs stay below it; give -o where that is meant")


def _of_baked(item: Item, baked: baking.Baked, seconds: dict[str, float]) -> Result:
    manifest = baked.manifest
    entries = manifest.get("files", {})
    errors = [
        row["error"]
        for row in (*baked.levels, manifest.get("irradiance", {}))
        if isinstance(row, dict) and isinstance(row.get("error"), float)
    ]
    files = {str(Path(item.output, name)): int(entry.get("bytes", 0)) for name, entry in entries.items()}
    files = files or {str(path): n for path, n in zip(baked.files, baked.nbytes, strict=True)}
    return Result(
        item.index,
        item.kind,
        item.place,
        item.name,
        baked.state,
        item.output,
        str(Path(item.output, f"{item.name}.json")),
        seconds,
        sum(files.values()),
        files,
        max(errors, default=None),
        notices=baked.notices,
    )


def _of_table(item: Item, table: tables.Table, seconds: dict[str, float]) -> Result:
    nbytes = int(table.manifest.get("bytes", table.nbytes))
    return Result(
        item.index,
        item.kind,
        item.place,
        item.name,
        table.state,
        item.output,
        f"{item.output}.json",
        seconds,
        nbytes,
        {item.output: nbytes},
        table.manifest.get("error"),
        notices=table.notices,
    )


# ---------------------------------------------------------------------------------------------- what would be done

# The cost model of an item: processor seconds in a running process, and peak bytes of that process. Fitted by least
# squares over lat-longs of 32 to 1 024 rows, chains from 32² to 512² and tolerances of 1e-2 to 1e-4, with PoCL on
# AVX-512. Times are within a factor of two, or of three for images of under a hundred rows; memory is within a tenth.
SECONDS = {"item": 0.041, "texel": 1.3e-7, "pair": 1.2e-10}
BYTES = {"process": 150e6, "texel": 90.0, "cell": 180.0}


def predict(item: Item) -> Result:
    """Predict the result of an item from the header and digest of its source.

    Processor time and memory are rough estimates (`SECONDS`, `BYTES`).
    """
    try:
        _check_inside(item)
        if item.kind == "lut":
            return _of_table(item, tables.make(_table_of(item), dry_run=True), {})
        order = _one(item)
        found = _of_baked(item, baking.status(order, 0), {})
        if found.state == "skipped":
            return found
        kind, rows, columns = extent(item.source, order.reading)
        latlong = kind == "latlong"
        texels = rows * columns * (1 if latlong else 6)
        levels = [level for _, level in baking.planned_levels(order, math.pi / rows / (1 if latlong else 2))]
        cells = sum(level.outputs for level in levels) + 6 * IRRADIANCE_SIZE**2
        seconds = SECONDS["item"] + SECONDS["texel"] * texels + SECONDS["pair"] * sum(level.pairs for level in levels)
        memory = BYTES["process"] + BYTES["texel"] * texels + BYTES["cell"] * cells
        return msgspec.structs.replace(found, predicted={"cpu_seconds": seconds, "memory": memory})
    except Exception as error:
        return _failure(item, error)


# ---------------------------------------------------------------------------------------------- all of them


STAGES = pool.Stages(prepare, compute, write, abandon, failed, Result, load)


def run(
    job: Job,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    item_timeout: float | None = None,
    on_result: Callable[[Result], None],
    on_notice: Callable[[str], None] | None = None,
) -> None:
    """Run every item of a job, and remove the files that killed runs left in its folders.

    workers: number of processes on this machine. scheduler: address of a Dask scheduler to run on instead. on_result
    is called with each result, in the order in which items end; on_notice with sentences about the run.
    Workers of this machine use the device that this process would use; workers of a cluster choose their own.
    Raises the errors of `pool.run`.
    """
    items: Iterable[Item] = job.items
    limit = item_timeout if item_timeout is not None else job.item_timeout
    if scheduler is None and (workers > 1 or limit is not None):
        items = _on_one_device(job.items)
    try:
        pool.run(
            STAGES,
            items,
            workers=workers,
            scheduler=scheduler,
            limit=limit,
            on_result=on_result,
            on_notice=on_notice,
        )
    finally:
        clean(job)


def _on_one_device(items: Iterable[Item]) -> Iterator[Item]:
    """Yield the items with their device named so that every process of this machine finds the same one.

    Where no device works the items are unchanged, and each that needs a device fails with the reason.
    """
    known: dict[str | None, str | None] = {}
    for item in items:
        if item.device not in known:
            known[item.device] = item.device
            with contextlib.suppress(WhitefurnaceError):
                known[item.device] = device_address(item.device)
        yield msgspec.structs.replace(item, device=known[item.device])


class Summary:
    """Running totals of a batch: counts of results, sums of times and sizes, and the failures. Its clock starts at
    once.
    """

    def __init__(self, total: int) -> None:
        self.total, self.begin = total, time.perf_counter()
        self.states = dict.fromkeys(("done", "skipped", "planned", "failed"), 0)
        self.seconds = dict.fromkeys(("read", "compute", "write"), 0.0)
        self.predicted = {"cpu_seconds": 0.0, "memory": 0.0}
        self.nbytes = 0
        self.failed: list[Result] = []

    def add(self, result: Result) -> None:
        """Add the result of an item."""
        self.states[result.state] += 1
        if result.state == "failed":
            self.failed.append(result)
        for name, seconds in result.seconds.items():
            self.seconds[name] += seconds
        self.nbytes += result.nbytes if result.state != "skipped" else 0
        if result.predicted:
            self.predicted["cpu_seconds"] += result.predicted["cpu_seconds"]
            self.predicted["memory"] = max(self.predicted["memory"], result.predicted["memory"])

    @property
    def count(self) -> int:
        """Number of items that have ended."""
        return sum(self.states.values())

    @property
    def wall(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.begin


def clean(job: Job) -> None:
    """Remove the files that killed runs left in the output folders of a job, and new folders that are empty."""
    folders: dict[Path, set[str]] = {}
    for item in job.items:
        folders.setdefault(Path(item.output).parent if item.kind == "lut" else Path(item.output), set()).add(item.name)
    for folder, names in folders.items():
        if not _below(job.root, os.path.realpath(folder)):
            continue
        for lock in locks_in(folder):
            name = lock.name[1:].removesuffix(".lock")
            if name in names or is_lock(lock):
                with contextlib.suppress(WhitefurnaceError, OSError):
                    form = FileOutput if Path(name).suffix.lower() in tables.FORMS else FolderOutput
                    form(folder / f"{name}.json").tidy()
    for folder in job.folders:
        with contextlib.suppress(OSError):  # not empty, or never made
            folder.rmdir()


def depfile(job: Job, results: Sequence[Result], path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Write a dependency file in Makefile syntax: the outputs of every item that is done or up to date, and its inputs.

    Inputs are targets without a recipe too, so that a missing input is a reason to run and not an error of make.
    A line with a name that the syntax cannot hold is left out; the notices that are returned say which. Raises
    FileError where the file cannot be written.
    """
    written = {Path(result.output).parent if result.kind == "lut" else Path(result.output) for result in results}
    # A searched folder changes when a file is added or removed. A folder that is written to changes in every run, so it
    # is left out.
    looked = [str(folder) for folder in job.looked if folder not in written]
    common = [str(job.path), *map(str, job.named), *looked]
    items = {item.index: item for item in job.items}
    lines: list[str] = []
    notices: dict[str, None] = {}
    needed: dict[str, None] = {}
    for result in results:
        if result.state not in ("done", "skipped"):
            continue
        item = items[result.index]
        made = item.kind == "lut" or item.source == DEMO
        inputs = [*common, *([] if made else _listed(item))]
        needed |= dict.fromkeys(inputs)
        try:
            targets = " ".join(escaped(name, target=True) for name in (result.manifest, *result.files))
            lines.append(f"{targets}: {' '.join(map(escaped, inputs))}\n")
        except InputError as error:
            notices[f"{path}: the line of {item.place!r} is left out: {error}"] = None
    for one in needed:
        with contextlib.suppress(InputError):
            lines.append(f"{escaped(one, target=True)}:\n")
    text = "".join(lines)
    # make would read a rule with = before its colon as the definition of a variable.
    if "=" in text:
        text = "whitefurnace_equals := =\n" + text.replace("=", "$(whitefurnace_equals)")
    write_atomic(path, lambda staged: staged.write_bytes(os.fsencode(text)))
    return tuple(notices)


def _listed(item: Item) -> list[str]:
    """Return the paths of the files that an environment was made from; its own where they cannot be found any more."""
    try:
        return [str(file) for file in source_files(item.source, _one(item).reading.layout).values()]
    except WhitefurnaceError:
        return [item.source]


def escaped(name: str, *, target: bool = False) -> str:
    """Escape a file name for Makefiles of GNU make and Ninja; % is escaped in targets alone, where it is a pattern.

    Raises InputError for a name with a line break, and for one that ends with a backslash, which would join it to what
    follows.
    """
    if "\n" in name or "\r" in name:
        raise InputError(f"{name!r} has a line break, which a Makefile cannot hold")
    if name.endswith("\\"):
        raise InputError(f"{name!r} ends with a backslash, which a Makefile cannot hold")
    special = r" \t#" + (r":*?\[\]" if os.sep == "/" else "") + ("%" if target else "")
    name = f"./{name}" if name.startswith("~") else name
    # Backslashes before an escaped character are doubled and others are kept, as GCC does.
    return re.sub(rf"(\\*)([{special}])", r"\1\1\\\2", name).replace("$", "$$")
