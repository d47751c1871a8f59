"""Many recipes: a job file checked whole before anything runs, its items, and one function that does one of them, the
same in this process, in a worker and on a cluster."""
from __future__ import annotations

import contextlib
import fnmatch
import json
import math
import os
import re
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import msgspec
import tomllib

from whitefurnace.baking import bake as baking
from whitefurnace.baking.request import BakeRequest
from whitefurnace.batch import pool
from whitefurnace.catalogue.choice import file_of
from whitefurnace.errors import FileError, InputError, UsageError, WhitefurnaceError, nearest
from whitefurnace.files import FileOutput, FolderOutput, digest_file, is_lock, is_safe, locks_in, write_text
from whitefurnace.opencl.device import device_address
from whitefurnace.prefiltering.recipe import IRRADIANCE_SIZE
from whitefurnace.sphere.environments import extent, source_files
from whitefurnace.tables import lut as tables
from whitefurnace.tables.axes import named, named_axes

MOST_BYTES = 16 << 20
"""Of a job file: ten thousand paths take about one."""

MOST_ITEMS = 1_000_000
MOST_SEEN = 2_000_000
"""Names in folders that all patterns of a job may be compared with: some seconds of work."""

MOST_TABLE = 1 << 34
"""Bytes of a table of a job. The command line's own may be larger: who types it sees it."""

MOST_REPORTED = 10


class Bake(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"for_": "for"}, omit_defaults=True):
    """A `[[bake]]`: environments (paths and patterns), the output folder, and the options of `bake`."""

    environments: list[str]
    output: str
    for_: list[str] | None = None
    size: int | None = None
    min_size: int | None = None
    levels: int | None = None
    fit: str | None = None
    as_read: bool = False
    ndf: str = "ggx"
    tolerance: float | None = None
    quality: str | None = None
    samples: int | None = None
    certify: int | None = None
    rotate: float = 0.0
    exposure: float = 0.0
    nonfinite: str = "refuse"
    sun: str = "keep"
    sh: str | None = None
    without: list[str] | None = None
    only_levels: str | None = None
    table: int | None = None


class Lut(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"for_": "for"}, omit_defaults=True):
    """A `[[lut]]`: kind, the output file, and the options of `lut`; `axis` and `set` are lists of what these take."""

    kind: str
    output: str
    size: int | str | None = None
    axis: list[str] = []
    set: list[str] = []
    for_: str | None = None
    fit: str | None = None
    as_read: bool = False
    format: str | None = None
    scheme: str | None = None
    ndf: str | None = None
    masking: str | None = None
    fresnel: str | None = None
    diffuse: str | None = None
    brdf: str | None = None
    light: str | None = None
    environment: str | None = None
    normal: tuple[float, float, float] | None = None
    rotate: float = 0.0
    exposure: float = 0.0
    nonfinite: str = "refuse"
    backfacing: str | None = None
    precision: int = 32
    tolerance: float | None = None


TABLES: dict[str, type[Bake] | type[Lut]] = {"bake": Bake, "lut": Lut}
MODELS = ("ndf", "masking", "fresnel", "diffuse", "brdf", "light")
"""Options that name models, and may name a user's file."""


class Item(msgspec.Struct, frozen=True):
    """One environment or one table: all that a worker needs to do it, as plain data.

    place    where it stands in the job, for people
    source   the path of the environment, or the word demo; of a table its kind
    output   the folder of a bake, the file of a table; `root` is the folder that it stays under
    recipe   the options as JSON, with the digests of the files that they name
    send     whether a cluster gets the source by value; `content` are then its files, by name
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
    content: dict[str, bytes] | None = None


class Result(msgspec.Struct, frozen=True):
    """What became of an item: `done`, `skipped`, `failed` or `planned`. `seconds` of wall time went into reading,
    computing and writing; `error` is the largest that a level, or the table, states. `predicted` are processor seconds
    and bytes of memory of what would be baked."""

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
    """A checked job: its items in their order, the files that recipes name, the folders that patterns were looked for
    in, and the folders of outputs that are not there yet, innermost first."""

    path: Path
    root: Path
    items: tuple[Item, ...]
    named: tuple[Path, ...]
    looked: tuple[Path, ...]
    folders: tuple[Path, ...]

    def shard(self, k: int, n: int) -> Job:
        """Every n-th item from the k-th (of 1 … n) on: items that are added at the end move no other."""
        return replace(self, items=self.items[k - 1::n])

    def predicted(self) -> Iterator[Result]:
        """Each item as it would go, from headers and digests: what is up to date, what would be written, what fails."""
        return map(predict, self.items)


def job(path: str | os.PathLike[str], *, root: str | os.PathLike[str] | None = None, allow_kernels: bool = False,
        force: bool = False, device: str | None = None, send: bool = False) -> Job:
    """The job of a TOML file, checked whole: nothing has run, and nothing was decoded.

    root: outputs are under it, the job file's folder by default. allow_kernels: whether recipes may name `.clh` files,
    whose text a device runs. send: sources go to a cluster by value. Raises FileError for what cannot be read,
    InputError for what is no job: unknown keys, impossible values, patterns without a match, outputs outside `root`,
    two recipes that write one file.
    """
    path = Path(path)
    data = _parsed(path)
    wrong: list[str] = []
    tables_: list[tuple[str, Bake | Lut]] = []
    for name, entries in data.items():
        if name not in TABLES:
            wrong.append(f"{name} is not known{nearest(name, TABLES)}")
        elif not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            wrong.append(f"{name} is not a list of tables; write [[{name}]]")
        else:
            tables_ += [(f"{name}[{k}]", made) for k, entry in enumerate(entries)
                        if (made := _converted(TABLES[name], entry, f"{name}[{k}]", wrong))]
    if not data and not wrong:
        wrong.append("it has no [[bake]] and no [[lut]]")
    _raise_all(path, wrong)
    base = Path(os.path.realpath(path)).parent
    maker = _Maker(path, base, Path(os.path.realpath(root if root is not None else base)), allow_kernels, force, device,
                   send, wrong)
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
            raise InputError(f"{path}: {place}: {error}") from None
        if len(maker.items) > MOST_ITEMS:
            raise InputError(f"{path}: {place} makes it over {MOST_ITEMS} items; split the job")
    maker.check_inputs()
    _raise_all(path, wrong)
    return maker.job()


def shard_of(text: str) -> tuple[int, int]:
    """(I, N) of `I/N`. Raises UsageError."""
    found = re.fullmatch(r"\s*(\d{1,7})\s*/\s*(\d{1,7})\s*", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise UsageError(f"shard {text!r} is not I/N with 1 <= I <= N")
    return int(found[1]), int(found[2])


def _parsed(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path} has {path.stat().st_size} bytes, a job has at most {MOST_BYTES}")
        return tomllib.loads(path.read_bytes().decode())
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not TOML: {error}") from None


def _raise_all(path: Path, wrong: Sequence[str]) -> None:
    if wrong:
        more = f"; and {len(wrong) - MOST_REPORTED} more" if len(wrong) > MOST_REPORTED else ""
        raise InputError(f"{path}: {'; '.join(wrong[:MOST_REPORTED])}{more}")


def _converted(kind: type[Bake] | type[Lut], entry: dict[str, Any], place: str, wrong: list[str]) -> Bake | Lut | None:
    known = [name.rstrip("_") for name in kind.__struct_fields__]
    given: dict[str, Any] = {}
    for key, value in entry.items():
        name = key.replace("-", "_")
        if name not in known:
            wrong.append(f"{place}.{key} is not known{nearest(name, known)}")
        elif name in given:
            wrong.append(f"{place}.{key} is given twice, as {name} and {name.replace('_', '-')}")
        else:
            given[name] = value
    if len(given) < len(entry):
        return None
    try:
        return msgspec.convert(given, kind)
    except msgspec.ValidationError as error:
        text, _, where = str(error).partition(" - at `$")
        wrong.append(f"{place}{where.rstrip('`')}: {text[0].lower()}{text[1:]}")
        return None


class _Maker:
    """Makes items of tables, and finds what cannot be meant."""

    def __init__(self, path: Path, base: Path, root: Path, allow_kernels: bool, force: bool, device: str | None,
                 send: bool, wrong: list[str]) -> None:
        self.path, self.base, self.root = path, base, root
        self.allow_kernels, self.force, self.device, self.send = allow_kernels, force, device, send
        self.wrong = wrong
        self.items: list[Item] = []
        self.owner: dict[str, str] = {}  # of each file that is written: the place of its item
        self.named: dict[Path, None] = {}
        self.finder = _Finder()
        self.own: list[Path] = []  # output folders: patterns do not look into them
        self.folders: set[Path] = set()  # every folder that is written into, and those that they are in

    def job(self) -> Job:
        missing = sorted((folder for folder in self.folders if not folder.exists()), reverse=True)
        return Job(self.path, self.root, tuple(self.items), tuple(self.named), tuple(self.finder.looked),
                   tuple(missing))

    def _into(self, folder: Path) -> None:
        while folder not in self.folders and folder != self.root and _below(self.root, folder):
            self.folders.add(folder)
            folder = folder.parent

    def say(self, place: str, error: Exception) -> None:
        self.wrong.append(f"{place}: {error}")

    def outputs(self, place: str, table: Bake) -> None:
        if (folder := self._output(place, table.output)) not in (None, self.root):
            assert folder
            self.own.append(folder)

    def _output(self, place: str, output: str, report: bool = False) -> Path | None:
        """Where an output is, below the root, through no link that leads out of it."""
        if not output or "\0" in output:
            self.wrong += [f"{place}.output is empty"] if report else []
            return None
        # Both: `..` after a link is the parent of where the link leads.
        plain, real = os.path.normpath(self.root / output), os.path.realpath(self.root / output)
        if all(_below(self.root, where) for where in (plain, real)):
            return Path(plain)
        if report:
            self.wrong.append(f"{place}.output {output!r} is outside {self.root}; outputs are relative to the job "
                              "file's folder and stay below it, or below the folder of -o")
        return None

    def _models(self, place: str, table: Bake | Lut) -> tuple[dict[str, str], bool]:
        """Options that name files of kernels, their paths made absolute; whether they are allowed."""
        found = {}
        for option in MODELS:
            spec = getattr(table, option, None)
            file = file_of(spec) if spec else None
            if spec and file:
                if not self.allow_kernels:
                    self.wrong.append(f"{place}.{option} names {file}, whose text a device would run: give "
                                      "--allow-kernels where you trust it")
                    return {}, False
                own = self.base / file
                self.named[own] = None
                found[option] = f"{own}{spec[len(file):]}"
        return found, True

    def bake(self, place: str, table: Bake) -> None:
        output = self._output(place, table.output, report=True)
        models, allowed = self._models(place, table)
        files = [str(self.base / name) if name.lower().endswith(".toml") else name for name in table.for_ or ()]
        for name in files:
            if "," in name:
                self.wrong.append(f"{place}.for: {name!r} has a comma; it is a list")
                return
            if name.lower().endswith(".toml"):
                self.named[Path(name)] = None
        if table.for_ is not None and not table.for_:
            self.wrong.append(f"{place}.for is empty")
            return
        if output is None or not allowed:
            return
        options = {name: value for name in table.__struct_fields__
                   if name not in ("environments", "output") and (value := getattr(table, name)) is not None}
        options |= models
        options["for_"] = ",".join(files or ["raw"])
        try:
            recipe = _recipe(options)
            order = _bake_plan(recipe, str(output), self.force)
        except WhitefurnaceError as error:
            self.say(place, error)
            return
        sources: dict[str, None] = {}
        for k, pattern in enumerate(table.environments):
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
        # Every name of a file has the stem in it: what one item writes tells what each writes.
        relative = [os.path.relpath(t.path, output) for t in baking.targets_of(order, _STEM)] + [f"{_STEM}.json"]
        for one in relative:
            self._into((output / one).parent)
        for source in sources:
            try:
                name = baking.name_of(source)
            except UsageError as error:
                self.say(place, error)
                continue
            where = f"{place}: {os.path.relpath(source, self.base) if _below(self.base, source) else source}"
            self._take(where, [os.path.join(output, one.replace(_STEM, name)) for one in relative])
            self.items.append(Item(len(self.items), "bake", where, name, source, str(output), str(self.root), recipe,
                                   self.force, self.device, self.send))

    def _environments(self, pattern: str) -> list[str]:
        if "\0" in pattern or not pattern:
            raise InputError("an empty path")
        own = self.base / pattern
        if os.path.lexists(own):  # a path wins over the word demo, and over a pattern
            return [str(own)]
        if pattern == baking.DEMO:
            return [pattern]
        if not re.search(r"[*?\[]", pattern):
            raise InputError(f"{pattern!r} is not there")
        found = self.finder.find(self.base, pattern)
        # What this job wrote the last time is not what it is made from.
        inside = [folder for folder in self.own if not _below(folder, os.path.normpath(self.base / _fixed(pattern)))]
        found = [one for one in found if not any(_below(folder, one) for folder in inside)]
        if not found:
            raise InputError(f"nothing matches {pattern!r}")
        return found

    def lut(self, place: str, table: Lut) -> None:
        output = self._output(place, table.output, report=True)
        models, allowed = self._models(place, table)
        if output is None or not allowed:
            return
        options = {name: value for name in table.__struct_fields__
                   if name not in ("kind", "output") and (value := getattr(table, name)) not in (None, [])}
        options |= models
        if table.for_ is not None and table.for_.lower().endswith(".toml"):
            options["for_"] = str(self.base / table.for_)
            self.named[Path(options["for_"])] = None
        if table.environment is not None:
            options["environment"] = str(self.base / table.environment)
            self.named[Path(options["environment"])] = None
        try:
            recipe = _recipe(options)
            request = _table_plan(recipe, table.kind, str(output), self.force)
            if request.nbytes > MOST_TABLE:
                raise UsageError(f"a table of {request.nbytes} bytes; a job's have at most {MOST_TABLE}")
        except (FileError, InputError) as error:
            if table.environment is None:
                self.say(place, error)
                return  # else this item fails, the others are done
        except WhitefurnaceError as error:
            self.say(place, error)
            return
        where = f"{place}: {table.output}"
        self._into(output.parent)
        self._take(where, [str(output), f"{output}.json"])
        self.items.append(Item(len(self.items), "lut", where, output.name, table.kind, str(output), str(self.root),
                               recipe, self.force, self.device))

    def _take(self, place: str, files: Iterable[str]) -> None:
        for file in files:
            other = self.owner.setdefault(os.path.normcase(file), place)
            if other is not place:
                self.wrong.append(f"{place} and {other} both write {file}")
                return

    def check_inputs(self) -> None:
        for item in self.items:
            if item.kind == "bake" and (writer := self.owner.get(os.path.normcase(os.path.normpath(item.source)))):
                self.wrong.append(f"{item.place} is read, and written by {writer}")


_STEM = "STEM\x7fSTEM"  # no file has this in its name


def _below(folder: str | os.PathLike[str], path: str | os.PathLike[str]) -> bool:
    """Whether a normalized absolute path is `folder` or below it."""
    folder, path = os.path.normcase(folder), os.path.normcase(path)
    return path == folder or path.startswith(folder.rstrip(os.sep) + os.sep)


def _fixed(pattern: str) -> str:
    """The folders of a pattern before its first wildcard."""
    parts = pattern.split("/")[:-1]
    first = next((k for k, part in enumerate(parts) if re.search(r"[*?\[]", part)), len(parts))
    return "/".join(parts[:first]) or "."


class _TooMany(InputError):
    """There is no going on with the next pattern."""


class _Finder:
    """Paths of patterns: *, ? and [...] in names, ** for any folders; hidden names only where a pattern's begins with a
    dot; links to folders are not followed by **. It looks at MOST_SEEN names at most."""

    def __init__(self) -> None:
        self.seen = 0
        self.looked: dict[Path, None] = {}
        self._kept: dict[str, list[tuple[str, bool, bool]]] = {}

    def find(self, base: Path, pattern: str) -> list[str]:
        """Sorted, each once. Raises InputError past MOST_SEEN names."""
        parts = [part for part in re.split(r"[/\\]" if os.sep == "\\" else "/", pattern) if part]
        start = str(base)
        if os.path.isabs(pattern):
            start = Path(pattern).anchor
            parts = list(Path(pattern).parts[1:])
        found: dict[str, None] = {}
        self._walk(start, parts, 0, found)
        return sorted(found)

    def _names(self, folder: str) -> list[tuple[str, bool, bool]]:
        """(name, is a folder, is a link) of what is in a folder; nothing where it cannot be listed."""
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


def _recipe(options: dict[str, Any]) -> str:
    """Options as JSON, with the digests of the files they name: what a worker keeps is then of what they hold."""
    files = [file for name in MODELS if (spec := options.get(name)) and (file := file_of(spec))]
    files += [name for name in options.get("for_", "").split(",") if name.lower().endswith(".toml")]
    if options.get("environment"):
        files.append(options["environment"])
    digests = {file: digest_file(file) for file in files}
    return json.dumps({"options": options, "files": digests}, sort_keys=True)


@lru_cache(maxsize=64)
def _bake_plan(recipe: str, output: str, force: bool) -> baking.BakePlan:
    """The plan of a [[bake]], of no environment yet."""
    options = json.loads(recipe)["options"]
    return baking.plan(BakeRequest(["environment"], output, force=force, **options))


def _table_plan(recipe: str, kind: str, output: str, force: bool) -> tables.TablePlan:
    options = json.loads(recipe)["options"]
    axes, fixed = options.pop("axis", []), options.pop("set", [])
    return tables.plan(tables.TableRequest(kind, output, force=force, stored=options.pop("format", None),
                                           axes=named_axes("axis", axes), parameters=named("set", fixed), **options))


# ---------------------------------------------------------------------------------------------- doing


@dataclass(frozen=True)
class Prepared:
    """An item that was read; `loaded` is None where a device must make it (demo, tables)."""

    item: Item
    loaded: baking.Loaded | None
    seconds: float


@dataclass(frozen=True)
class Computed:
    """An item that is to be encoded and written."""

    item: Item
    made: baking.Computed
    seconds: dict[str, float]


def failed(item: Item, message: str, exit_code: int = 2) -> Result:
    """The result of an item that failed, with its reason."""
    return Result(item.index, item.kind, item.place, item.name, "failed", item.output, message=message,
                  exit_code=exit_code)


def _failure(item: Item, error: Exception) -> Result:
    if isinstance(error, WhitefurnaceError):
        return failed(item, str(error), error.exit_code)
    if isinstance(error, MemoryError):
        return failed(item, "there is not enough memory for this; a smaller input or size is needed")
    if isinstance(error, OSError):
        return failed(item, f"cannot use {error.filename or item.output}: {error.strerror or error}")
    return failed(item, f"{type(error).__name__}: {error}")


def prepare(item: Item) -> Prepared | Result:
    """Reads an item and takes the lock of its output: the part that may run ahead of the device."""
    begin = time.perf_counter()
    try:
        _check_inside(item)
        if item.kind == "lut" or item.source == baking.DEMO:
            return Prepared(item, None, time.perf_counter() - begin)
        with _source(item) as source:
            found = baking.read(_one(item, source), 0)
        if isinstance(found, baking.Baked):
            return _of_baked(item, found, {"read": time.perf_counter() - begin})
        return Prepared(item, found, time.perf_counter() - begin)
    except Exception as error:
        return _failure(item, error)


def compute(prepared: Prepared) -> Computed | Result:
    """What the device does for an item. One thread of a process at a time."""
    item, begin = prepared.item, time.perf_counter()
    loaded = prepared.loaded
    try:
        if item.kind == "lut":
            Path(item.output).parent.mkdir(parents=True, exist_ok=True)
            table = tables.make(_table_plan(item.recipe, item.source, item.output, item.force), item.device)
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
    """Encodes and writes an item: the part that may run behind the device."""
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
    """Lets go of an item that will not go on."""
    held = found.made if isinstance(found, Computed) else found.loaded
    if held is not None:
        baking.abandon(held)


def do(item: Item) -> Result:
    """One item from end to end. Raises nothing but what stops a process: a failure is a result."""
    found: Prepared | Computed | Result = prepare(item)
    if isinstance(found, Prepared):
        found = compute(found)
    if isinstance(found, Computed):
        found = write(found)
    assert isinstance(found, Result)
    return found


def _one(item: Item, source: str | None = None) -> baking.BakePlan:
    """The order of an item alone."""
    return replace(_bake_plan(item.recipe, item.output, item.force), names=(item.name,),
                   sources=(source or item.source,))


MOST_SENT = 1 << 30


def load(item: Item) -> Item:
    """The item with its source, where that is to be sent by value. Raises FileError, InputError."""
    if not item.send or item.kind == "lut" or item.source == baking.DEMO:
        return item
    files = source_files(item.source)
    base = Path(item.source) if os.path.isdir(item.source) else Path(item.source).parent
    try:
        size = sum(os.stat(file).st_size for file in files)
        if size > MOST_SENT:
            raise InputError(f"{item.source} has {size} bytes, at most {MOST_SENT} are sent; use a shared folder")
        return msgspec.structs.replace(item, content={os.path.relpath(file, base): file.read_bytes() for file in files})
    except OSError as error:
        raise FileError(f"cannot read {item.source}: {error.strerror or error}") from error


@contextlib.contextmanager
def _source(item: Item) -> Iterator[str]:
    """Where the item's source can be read: its path, or a folder that holds what was sent."""
    if item.content is None:
        yield item.source
        return
    with tempfile.TemporaryDirectory(prefix="whitefurnace-") as folder:
        base = Path(folder, item.name)
        for name, data in item.content.items():
            if not is_safe(Path(name).as_posix()):
                raise InputError(f"{item.source} refers to {name}, outside its folder, and cannot be sent")
            file = base / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)
        whole = len(item.content) == 1 or any(name.lower().endswith(".gltf") for name in item.content)
        yield str(base / Path(item.source).name if whole else base)


def _check_inside(item: Item) -> None:
    """Refuses folders that a link leads out of the root: it may have been put there since the job was checked."""
    folders = {Path(item.output).parent} if item.kind == "lut" else {Path(item.output), *(
        t.path.parent for t in baking.targets_of(_bake_plan(item.recipe, item.output, item.force), _STEM))}
    for folder in sorted(folders):
        if not _below(item.root, os.path.realpath(folder)):
            raise FileError(f"{folder} leads out of {item.root}: outputs stay below it; give -o where that is meant")


def _of_baked(item: Item, baked: baking.Baked, seconds: dict[str, float]) -> Result:
    manifest = baked.manifest
    entries = manifest.get("files", {})
    errors = [row["error"] for row in (*baked.levels, manifest.get("irradiance", {}))
              if isinstance(row, dict) and isinstance(row.get("error"), float)]
    files = {str(Path(item.output, name)): int(entry.get("bytes", 0)) for name, entry in entries.items()}
    files = files or {str(path): n for path, n in zip(baked.files, baked.nbytes, strict=True)}
    return Result(item.index, item.kind, item.place, item.name, baked.state, item.output,  # type: ignore[arg-type]
                  str(Path(item.output, f"{item.name}.json")), seconds, sum(files.values()), files,
                  max(errors, default=None), notices=baked.notices)


def _of_table(item: Item, table: tables.Table, seconds: dict[str, float]) -> Result:
    nbytes = int(table.manifest.get("bytes", table.nbytes))
    return Result(item.index, item.kind, item.place, item.name, table.state, item.output,  # type: ignore[arg-type]
                  f"{item.output}.json", seconds, nbytes, {item.output: nbytes}, table.manifest.get("error"),
                  notices=table.notices)


# ---------------------------------------------------------------------------------------------- what would be done

# Processor seconds of an item in a running process, and the most bytes that the process has had by then: least squares
# over lat-longs of 32 to 1 024 rows, chains from 32² to 512² and tolerances of 1e-2 to 1e-4, with PoCL on AVX-512. They
# are off by up to twice, of images of under a hundred rows by up to three times; memory by a tenth.
SECONDS = {"item": 0.041, "texel": 1.3e-7, "pair": 1.2e-10}
BYTES = {"process": 150e6, "texel": 90.0, "cell": 180.0}


def predict(item: Item) -> Result:
    """What an item would do, from its header and digests. Processor time and memory are rough (`SECONDS`, `BYTES`)."""
    try:
        _check_inside(item)
        if item.kind == "lut":
            return _of_table(item, tables.make(_table_plan(item.recipe, item.source, item.output, item.force),
                                               dry_run=True), {})
        order = _one(item)
        found = _of_baked(item, baking.status(order, 0), {})
        if found.state == "skipped":
            return found
        height = baking.DEMO_HEIGHT
        kind, rows, columns = ("latlong", height, 2 * height) if item.source == baking.DEMO else extent(item.source)
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


def run(job: Job, *, workers: int = 1, scheduler: str | None = None, on_result: Callable[[Result], None],
        on_notice: Callable[[str], None] | None = None) -> None:
    """Does every item; `on_result` hears of each in the order they end. What a killed run left in the job's folders is
    removed at the end.

    Workers of this machine use the device that this process would use; those of a cluster choose on their own machine.
    Raises what `pool.run` does.
    """
    items: Iterable[Item] = job.items
    if scheduler is None and workers > 1:
        items = _on_one_device(job.items)
    try:
        pool.run(STAGES, items, workers=workers, scheduler=scheduler, on_result=on_result, on_notice=on_notice)
    finally:
        clean(job)


def _on_one_device(items: Iterable[Item]) -> Iterator[Item]:
    """The items with their device named so that any process of this machine finds the same one.

    Where none works the items keep what was asked for, and each that needs a device fails with the reason.
    """
    known: dict[str | None, str | None] = {}
    for item in items:
        if item.device not in known:
            known[item.device] = item.device
            with contextlib.suppress(WhitefurnaceError):
                known[item.device] = device_address(item.device)
        yield msgspec.structs.replace(item, device=known[item.device])


class Summary:
    """Counts of results as they come, and the failures with their reasons. `begin` is when it was made."""

    def __init__(self, total: int) -> None:
        self.total, self.begin = total, time.perf_counter()
        self.states = dict.fromkeys(("done", "skipped", "planned", "failed"), 0)
        self.seconds = dict.fromkeys(("read", "compute", "write"), 0.0)
        self.predicted = {"cpu_seconds": 0.0, "memory": 0.0}
        self.nbytes = 0
        self.failed: list[Result] = []

    def add(self, result: Result) -> None:
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
        """How many have ended."""
        return sum(self.states.values())

    @property
    def wall(self) -> float:
        return time.perf_counter() - self.begin


def clean(job: Job) -> None:
    """Removes what dead runs left in the folders of a job's outputs, and folders that were made and stayed empty."""
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


def depfile(job: Job, results: Iterable[Result], path: str | os.PathLike[str]) -> None:
    """Writes rules in Makefile syntax: the outputs of every item that is whole, and what each was made from. The latter
    are targets too, without a recipe: that one is gone is then no error but a reason to run. Raises FileError, and
    InputError for a name with a line break, which the syntax cannot hold."""
    written = {Path(result.output).parent if result.kind == "lut" else Path(result.output) for result in results}
    # A folder that patterns look into changes when a file comes or goes; one that is written into always does.
    looked = [str(folder) for folder in job.looked if folder not in written]
    common = [str(job.path), *map(str, job.named), *looked]
    items = {item.index: item for item in job.items}
    lines: list[str] = []
    needed: dict[str, None] = {}
    for result in results:
        if result.state not in ("done", "skipped"):
            continue
        item = items[result.index]
        made = item.kind == "lut" or item.source == baking.DEMO
        sources = [] if made else [str(file) for file in source_files(item.source)]
        needed |= dict.fromkeys([*common, *sources])
        targets = " ".join(escaped(name, target=True) for name in (result.manifest, *result.files))
        lines.append(f"{targets}: {' '.join(map(escaped, [*common, *sources]))}\n")
    lines += [f"{escaped(one, target=True)}:\n" for one in needed]
    text = "".join(lines)
    # A rule with = before its colon would be read as a variable's definition.
    if "=" in text:
        text = "whitefurnace_equals := =\n" + text.replace("=", "$(whitefurnace_equals)")
    write_text(path, text)


def escaped(name: str, *, target: bool = False) -> str:
    """A file's name as Makefiles have it, for GNU make and Ninja: a % is a pattern in a target alone. Raises InputError
    for a name with a line break."""
    if "\n" in name or "\r" in name:
        raise InputError(f"{name!r} has a line break, which a Makefile cannot hold")
    special = r" \t#" + (r":*?\[\]" if os.sep == "/" else "") + ("%" if target else "")
    name = f"./{name}" if name.startswith("~") else name
    # Backslashes before what is escaped are doubled, the others stay, as GCC writes them.
    return re.sub(rf"(\\*)([{special}])", r"\1\1\\\2", name).replace("$", "$$")
