"""Bakes environments into the files that engines load: plans, reads, computes and writes each of them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from whitefurnace.baking.outputs import Encoded, Made, Target, encoded, targets
from whitefurnace.baking.programs import Program, programs
from whitefurnace.baking.request import BakeRequest
from whitefurnace.catalogue.choice import Chosen, Spec, chosen, is_number
from whitefurnace.engines.presets import Engine, engines, reduced
from whitefurnace.errors import DeviceError, UnsupportedError, UsageError, WhitefurnaceError
from whitefurnace.files import (
    FolderOutput,
    Lock,
    Transaction,
    digest_file,
    require_encoder,
    system_errors,
    write_manifest,
)
from whitefurnace.integrals.quadrature import dfg
from whitefurnace.opencl import source
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.prefiltering.convolution import Level
from whitefurnace.prefiltering.lighting import Filtered, Lighting, Want, light
from whitefurnace.prefiltering.plan import LevelPlan, plan_chain
from whitefurnace.prefiltering.reading import Reader, compared
from whitefurnace.prefiltering.recipe import CERTIFIED, DFG_SIZE, IRRADIANCE_SIZE, TOLERANCE_RANGE, Chain, chain
from whitefurnace.results import Integrated
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere.bad_pixels import check_bad_pixels
from whitefurnace.sphere.environments import (
    DEMO,
    Environment,
    Reading,
    is_demo,
    read_environment,
    source_digest,
    source_files,
    source_name,
)
from whitefurnace.sphere.grids import Shape
from whitefurnace.sphere.suns import Sun, sun_mode, without_sun
from whitefurnace.tables.split_sum import SplitSum, split_sum
from whitefurnace.version import VERSION

if TYPE_CHECKING:
    from whitefurnace.baking.request import Source

DFG_TOLERANCE = 5e-6
SHEEN = 10
"""Factor on the tolerance that Charlie's levels are allowed: a sheen reflects a tenth of what GGX does, and where its
smooth lobes are a rim at the horizon, no grid reaches 1e-3 under panels with sharp edges."""


@dataclass(frozen=True)
class Baked:
    """The result of baking one environment, or the prediction of it in a dry run.

    name       stem of the output files
    state      "done", "skipped" or "planned"
    files      paths of the files
    nbytes     for each file, bytes of its arrays before compression
    manifest   the manifest; of a planned bake only its key and its recipe
    plan       each distinct level, with the engines that it is for
    levels     rows of the manifest, with the seconds that each level took
    as_read    errors after the engine's sampling (`reading.AsRead.data`); a planned bake also has alternative chains
    programs   kernel programs that a planned bake compiles
    """

    name: str
    state: Literal["done", "skipped", "planned"]
    files: tuple[Path, ...]
    manifest: dict[str, Any]
    plan: tuple[tuple[tuple[str, ...], LevelPlan], ...]
    nbytes: tuple[int, ...]
    notices: tuple[str, ...]
    levels: tuple[dict[str, Any], ...] = ()
    seconds: float = 0.0
    as_read: tuple[dict[str, Any], ...] = ()
    programs: tuple[Program, ...] = ()


@dataclass(frozen=True)
class BakePlan:
    """A validated bake of several environments.

    names    stem of the outputs of each environment
    sources  the environments
    engines  the target engines
    chains   the chain of each engine
    reading  how environments are read
    image    whether engines that filter an image themselves get it in its own size, not in that of the chain
    The other fields are options of `bake`.
    """

    names: tuple[str, ...]
    sources: tuple[Any, ...]
    output: Path
    engines: tuple[Engine, ...]
    chains: tuple[Chain, ...]
    reading: Reading
    sun: str
    force: bool
    as_read: bool = False
    window: str | float = "auto"
    image: bool = False

    @property
    def recipe(self) -> Chain:
        """The first chain. Its NDF, tolerance and certificates are those of all chains."""
        return self.chains[0]


def plan(request: BakeRequest) -> BakePlan:
    """Check every option of a request and find the chain of each engine.

    Only descriptions of engines and NDFs are read. Raises UsageError, UnsupportedError, FileError and InputError.
    """
    if not request.sources:
        raise UsageError("no environment was given")
    reading = reading_of(request)
    sources = _distinct(request.sources, reading.layout)
    names = [name_of(item, reading.layout) for item in sources]
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise UsageError(f"two inputs are named {name!r}: their outputs would be the same files")
        seen.add(name)
    sun_mode(request.sun)
    if request.samples and any(e.octahedral for e in engines(request.for_)):
        raise UnsupportedError("samples are not drawn for octahedral maps; give a tolerance")
    if request.certify == 0:
        raise UsageError("certify 0: what is written states its error; give 299 or more texels")
    window = "auto" if request.sh is None else harmonic.sh_window(request.sh)
    without = request.without
    left_out = list(filter(None, map(str.strip, without.split(",")))) if isinstance(without, str) else list(without)
    found = engines(request.for_)
    if left_out or request.table is not None:
        found = tuple(reduced(e, left_out, request.table) for e in found)
    return BakePlan(
        tuple(names),
        tuple(sources),
        Path(request.output),
        found,
        tuple(_chain(e, request) for e in found),
        reading,
        request.sun,
        request.force,
        bool(request.as_read) or request.fit is not None,
        window,
        request.size is None,
    )


def reading_of(request: BakeRequest) -> Reading:
    """Return how the environments of a request are read. Raises UsageError for an option out of its domain."""
    return Reading(
        request.rotate,
        request.exposure,
        check_bad_pixels(request.bad_pixels, request.nonfinite),
        request.layout,
        request.layer,
        request.fill,
    ).check()


def _distinct(sources: Sequence[Source], layout: str | None) -> list[Source]:
    """Return the sources in their order; six files of one cube, as a shell makes them of a pattern, are one source."""
    found: list[Source] = []
    sets: set[tuple[Path, ...]] = set()
    for item in sources:
        if isinstance(item, (str, os.PathLike)) and os.path.isfile(item):
            files = tuple(source_files(item, layout).values())
            if len(files) == 6 and Path(item) in files:
                if files in sets:
                    continue
                sets.add(files)
        found.append(item)
    return found


def name_of(item: Any, layout: str | None = None) -> str:
    """Return the stem of the outputs of a source: a path's stem, the name of a set of six files, "demo", "array", or an
    environment's own name.

    Raises UsageError for an object that is not a source and for a name that cannot be a file name.
    """
    if isinstance(item, Environment):
        name = item.name
    elif isinstance(item, (str, os.PathLike)):
        name = source_name(item, layout)
    elif isinstance(item, np.ndarray):
        name = "array"
    else:
        raise UsageError(f"bake takes paths, arrays and environments, not {type(item).__name__}")
    if name in ("", ".", "..") or "/" in name or "\\" in name:
        raise UsageError(f"{name!r} cannot name an output")
    return name


def _chain(engine: Engine, request: BakeRequest) -> Chain:
    """The chain of an engine: its own mapping, and its sizes where none are given."""
    if engine.whole:
        for name in ("min_size", "levels"):
            if getattr(request, name) is not None:
                raise UsageError(f"{engine.name} needs all levels down to 1²: {name.replace('_', '-')} cannot be given")
    if request.only_levels is not None and engine.container == "files":
        raise UsageError(f"{engine.name} has all levels as mips of one texture: only-levels is of raw and exr")
    size, levels, usual = request.size if request.size is not None else engine.size, request.levels, engine.min_size
    if engine.container == "files" and is_number(size) and size >= 1:
        # A small probe has the levels that it can have.
        usual = min(usual, size)
        if engine.levels and request.min_size is None and levels is None:
            levels = min(engine.levels, int(size).bit_length())
    try:
        return chain(
            ndf=request.ndf,
            size=size,
            min_size=request.min_size,
            tolerance=request.tolerance,
            quality=request.quality,
            levels=levels,
            fit=request.fit,
            samples=request.samples,
            certify=request.certify,
            lods=engine.lods,
            usual_min=usual,
            only_levels=request.only_levels,
        )
    except UsageError as error:
        raise error if engine.container != "files" else UsageError(f"{engine.name}: {error}") from None


def bake(
    sources: Source | Sequence[Source],
    output: str | os.PathLike[str],
    *,
    for_: str = "raw",
    size: int | None = None,
    min_size: int | None = None,
    levels: int | None = None,
    only_levels: str | None = None,
    without: str | Sequence[str] = (),
    table: int | None = None,
    ndf: Spec = "ggx",
    tolerance: float | None = None,
    quality: str | None = None,
    samples: int | None = None,
    certify: int = CERTIFIED,
    fit: str | None = None,
    as_read: bool = False,
    rotate: float = 0.0,
    exposure: float = 0.0,
    bad_pixels: str = "refuse",
    layout: str | None = None,
    layer: str | None = None,
    fill: str | None = None,
    nonfinite: str | None = None,
    sun: str = "keep",
    sh: str | None = None,
    force: bool = False,
    device: Device | str | None = None,
    dry_run: bool = False,
    progress: Callable[[str, str, float], None] | None = None,
) -> list[Baked]:
    """Bake environments into the files that engines load, each with its stated error.

    sources: a path, an array, an `environment`, or a list of them, as `environment` takes them.
    output: the folder of all files. They go to `output/ENGINE/STEM…`; the manifest `output/STEM.json` is written last
        and proves that they are complete. An environment whose manifest has the same key is skipped.
    for_: target engines or .toml files of your own, separated by commas.
    size, min_size: face edge of the first and last level in texels, powers of two from 1 to 2048. levels: number of
        levels, 1 to 32. only_levels: "A-B", the levels that are made for raw and exr, counted from 0.
    without: parts of engines' files to leave out, of irradiance, sh, sheen, dfg, skybox. table: texels per side of
        engines' split-sum tables.
    ndf: an isotropic NDF, by name, path of a .clh file or entry.
    tolerance: bound on the stated error of every level, 1e-5 to .5, 1e-3 by default; or quality "draft" (1e-2),
        "normal" (1e-3), "reference" (2e-5); or samples, 1 to 65536, for filtered importance sampling.
    certify: texels of each level whose error is measured, 299 to 1048576.
    fit: "read" fits the levels to how they are interpolated. as_read: measure the error after the engine's sampling.
    rotate: degrees about +Y. exposure: stops. bad_pixels (or nonfinite, its older name): "refuse", "zero" or "clamp".
        layout, layer, fill: how an image is read, as for `environment`. sun: "keep", "extract" or "clamp=X".
    sh: "window=auto", "window=none" or "window=X", the window of engines' irradiance harmonics.
    force: bake again, and overwrite files that this tool did not write.
    device: a `Device`, or a number or part of a name. dry_run: only return the plan.
    progress: called with the environment's name, the part that is made and the share done.
    Raises UsageError, FileError, InputError, UnsupportedError, CheckError, DeviceError; nothing is written for an
    environment that fails.
    """
    several: Sequence[Source] = (
        [sources] if isinstance(sources, (str, os.PathLike, np.ndarray, Environment)) else list(sources)
    )
    parts: dict[str, Any] = {"levels": levels, "only_levels": only_levels, "without": without, "table": table}
    accuracy: dict[str, Any] = {"tolerance": tolerance, "quality": quality, "samples": samples, "certify": certify}
    reads: dict[str, Any] = {"fit": fit, "as_read": as_read}
    lit: dict[str, Any] = {"rotate": rotate, "exposure": exposure, "sun": sun, "sh": sh}
    pixels: dict[str, Any] = {"bad_pixels": bad_pixels, "nonfinite": nonfinite}
    image: dict[str, Any] = {"layout": layout, "layer": layer, "fill": fill}
    options = {**parts, **accuracy, **reads, **lit, **pixels, **image}
    asked = BakeRequest(several, output, for_, size, min_size, ndf=ndf, force=force, **options)
    planned = plan(asked)
    return [bake_one(planned, k, device, dry_run=dry_run, progress=progress) for k in range(len(planned.names))]


def bake_one(
    request: BakePlan,
    k: int,
    device: Device | str | None = None,
    *,
    dry_run: bool = False,
    progress: Callable[[str, str, float], None] | None = None,
) -> Baked:
    """Bake the k-th environment of a plan, k from 0. Raises the errors of `bake`."""
    found = read(request, k, device, dry_run=dry_run)
    if isinstance(found, Baked):
        return found
    try:
        return write(compute(found, device, progress))
    except BaseException:
        abandon(found, folders=True)
        raise


@dataclass(frozen=True)
class Loaded:
    """An environment that was read and will be baked. It holds the lock of its output until `write` or `abandon`.

    recipe   the data that decide the bytes of the output
    key      hash of the recipe, the source and the version
    there    the manifest that is replaced, or None
    planned  levels, each with the engines that it is for
    made     folders that were created for the output
    """

    request: BakePlan
    k: int
    env: Environment
    sun: Sun | None
    recipe: dict[str, Any]
    key: str
    there: dict[str, Any] | None
    planned: tuple[tuple[tuple[str, ...], LevelPlan], ...]
    lock: Lock
    made: tuple[Path, ...]
    on: Device | None
    begin: float

    @property
    def output(self) -> FolderOutput:
        """The output folder with its manifest."""
        return _output(self.request, self.k)


@dataclass(frozen=True)
class Computed:
    """The device's results for an environment, before they are encoded and written.

    of       for each engine, the indices of its own chain and of Charlie's in `lit.chains`
    table    the (scale, bias) table
    splits   the split-sum table of each engine
    window   the windowed harmonics
    written  the encoded files, where errors after the engine's sampling were measured
    as_read  those errors
    """

    loaded: Loaded
    on: Device
    lit: Lighting
    of: list[tuple[int, int]]
    table: Integrated
    splits: tuple[SplitSum | None, ...]
    window: harmonic.Windowed
    written: list[Encoded] | None
    as_read: list[dict[str, Any]]


def manifest_path(request: BakePlan, k: int) -> Path:
    """Return the path of the manifest of the k-th environment."""
    return request.output / f"{request.names[k]}.json"


def _output(request: BakePlan, k: int) -> FolderOutput:
    return FolderOutput(manifest_path(request, k), (t.path for t in targets_of(request, request.names[k])))


def status(request: BakePlan, k: int) -> Baked:
    """Return whether the k-th environment is up to date, from the bytes of its source and outputs; nothing is decoded.

    The result is a `Baked` in the state "skipped", or in the state "planned" without a plan. Raises FileError for a
    file that cannot be read or is not ours.
    """
    with system_errors(request.output):
        name, output = request.names[k], _output(request, k)
        there = output.manifest()
        if found := _up_to_date(request, k, there, time.perf_counter()):
            return found
        written = targets_of(request, name)
        output.check([t.path for t in written], there, request.force)
        return Baked(name, "planned", tuple(t.path for t in written), {}, (), tuple(t.nbytes for t in written), ())


def _up_to_date(request: BakePlan, k: int, there: dict[str, Any] | None, begin: float) -> Baked | None:
    """Return the item as its manifest states it, if its files are complete and its key matches these source bytes.

    The check reads the bytes of the source and does not decode them.
    """
    item, stated = request.sources[k], (there or {}).get("source")
    if (
        request.force
        or there is None
        or not isinstance(stated, dict)
        or not isinstance(item, (str, os.PathLike))
        or is_demo(item)
    ):
        return None
    try:
        digest = source_digest(item, request.reading.layout)
    except WhitefurnaceError:  # reading it reports the error
        return None
    turn = math.radians(math.remainder(request.reading.rotate, 360.0))
    recipe = _canonical(request, turn, request.reading.exposure or 0.0)
    if there.get("key") != _key(digest, recipe) or "recipe" not in there or not _output(request, k).is_whole(there):
        return None
    written = targets_of(request, request.names[k])
    return Baked(
        request.names[k],
        "skipped",
        tuple(t.path for t in written),
        there,
        (),
        tuple(t.nbytes for t in written),
        tuple(stated.get("notices", ())),
        tuple(there.get("levels", ())),
        time.perf_counter() - begin,
    )


def read(request: BakePlan, k: int, device: Device | str | None = None, *, dry_run: bool = False) -> Baked | Loaded:
    """Read the k-th environment of a plan and take the lock of its output, waiting while another run holds it.

    device: used for the built-in environment and in a dry run. dry_run: return the plan instead of reading.
    Returns a `Baked` where there is nothing to do or in a dry run, otherwise a `Loaded`. Raises FileError and
    InputError.
    """
    with system_errors(request.output):
        begin = time.perf_counter()
        output = _output(request, k)
        there = output.manifest()
        if found := _up_to_date(request, k, there, begin):
            if not dry_run:
                output.tidy()  # killed when the manifest was there
            return found
        if dry_run:
            planned = _read(request, k, device, None, (), there, begin)
            assert isinstance(planned, Baked)
            return planned
        folders = sorted({request.output, *(t.path.parent for t in targets_of(request, request.names[k]))})
        made = tuple(folder for folder in folders if not folder.exists())
        lock = None
        try:
            lock = output.lock()
            there = output.settle(lock)
            found = _up_to_date(request, k, there, begin)  # of the run that had the lock, or of one that died
            loaded = found or _read(request, k, device, lock, made, there, begin)
        except BaseException:
            _give_up(lock, made)
            raise
        if isinstance(loaded, Baked):
            lock.release()
        return loaded


def _read(
    request: BakePlan,
    k: int,
    device: Device | str | None,
    lock: Lock | None,
    made: tuple[Path, ...],
    there: dict[str, Any] | None,
    begin: float,
) -> Baked | Loaded:
    name, item, output = request.names[k], request.sources[k], _output(request, k)
    on: Device | None = device if isinstance(device, Device) else None
    if is_demo(item):
        on = on or choose_device(device if isinstance(device, str) else None)
    # With its rotation and exposure applied: the kernels see the environment only through these.
    env = read_environment(item, request.reading, device=on)
    env, sun = without_sun(env, request.sun)
    recipe = _canonical(request, env.rotation, env.exposure)
    key = _key(env.digest, recipe)
    written = targets_of(request, name, _image_rows(request, env))
    planned = planned_levels(request, math.pi / env.texels.shape[-3] / (1 if env.kind == "latlong" else 2))
    files = tuple(t.path for t in written)
    sizes = tuple(t.nbytes for t in written)
    if not request.force and there and there.get("key") == key and output.is_whole(there):
        return Baked(
            name,
            "skipped",
            files,
            there,
            planned,
            sizes,
            env.notices,
            tuple(there.get("levels", ())),
            time.perf_counter() - begin,
        )
    output.check(files, there, request.force)
    if lock is None:
        shown, notices = _would_read(request, env, device, on)
        return Baked(
            name,
            "planned",
            files,
            {"key": key, "recipe": recipe},
            planned,
            sizes,
            (*env.notices, *_resized(request, env), *notices),
            as_read=shown,
            programs=_programs(request, env),
        )
    for engine in request.engines:
        for file in engine.file:
            require_encoder(file.stored)  # before minutes of work, not when the file is written
    lock.note([*files, output.path, output.probe(request.output)])
    output.check_writable(sorted({request.output, *(file.parent for file in files)}))
    return Loaded(request, k, env, sun, recipe, key, there, planned, lock, made, on, begin)


def _give_up(lock: Lock | None, made: Sequence[Path]) -> None:
    if lock:
        lock.release()
    for folder in reversed(made):
        with contextlib.suppress(OSError):  # not empty: something of ours is whole
            folder.rmdir()


def abandon(found: Loaded | Computed, *, folders: bool = False) -> None:
    """Release the lock of an environment that will not be written; with `folders`, remove the folders made for it."""
    loaded = found.loaded if isinstance(found, Computed) else found
    _give_up(loaded.lock, loaded.made if folders else ())


def compute(
    loaded: Loaded, device: Device | str | None = None, progress: Callable[[str, str, float], None] | None = None
) -> Computed:
    """Do all of the device's work for an environment.

    progress: as for `bake`. Raises CheckError, DeviceError, UnsupportedError.
    """
    request, name = loaded.request, loaded.request.names[loaded.k]
    with system_errors(request.output):
        on = loaded.on or (device if isinstance(device, Device) else choose_device(device))
        report = (lambda part, share: progress(name, part, share)) if progress else None
        wants, of = _wanted(request, loaded.env)
        lit = light(on, loaded.env, wants, seed=loaded.key, progress=report)
        ndf = EntryKey.of(request.recipe.ndf)
        table = _table(on, ndf)
        splits = tuple(_split(on, ndf, engine) if engine.holding("dfg") else None for engine in request.engines)
        window = harmonic.windowed(lit.sh, request.window)
        made = Computed(loaded, on, lit, of, table, splits, window, None, [])
        if not request.as_read:
            return made
        written = _encoded(made)
        return replace(made, written=written, as_read=_as_read(request, on, loaded.env, lit, of, written))


def _encoded(made: Computed) -> list[Encoded]:
    """The files of every engine, ready to be written."""
    loaded, request = made.loaded, made.loaded.request
    provenance = {
        "version": VERSION,
        "key": loaded.key,
        "source": loaded.env.digest,
        "recipe": json.dumps(loaded.recipe, sort_keys=True),
    }
    written: list[Encoded] = []
    for e, engine in enumerate(request.engines):
        own, sheen = made.of[e]
        parts = Made(
            made.lit,
            made.lit.chains[own],
            made.lit.chains[sheen] if engine.holding("sheen") else None,
            made.table,
            made.splits[e],
            made.window,
            provenance,
        )
        written += encoded(engine, request.chains[e], request.output, request.names[loaded.k], parts)
    return written


def write(made: Computed) -> Baked:
    """Encode and write what was computed, the manifest last, and release the lock. Needs no device.

    Raises FileError; then nothing was written.
    """
    try:
        with system_errors(made.loaded.request.output):
            return _write(made)
    finally:
        made.loaded.lock.release()


def _write(made: Computed) -> Baked:
    loaded, request, lit = made.loaded, made.loaded.request, made.lit
    name = request.names[loaded.k]
    written = _encoded(made) if made.written is None else made.written
    manifest = _manifest(
        request, name, loaded.env, loaded.sun, loaded.recipe, loaded.key, made.on, lit, made.of, made.table, made.window
    )
    if request.as_read:
        manifest["as_read"] = made.as_read
    for folder in {target.path.parent for target in written}:  # another item's failure may have removed it
        folder.mkdir(parents=True, exist_ok=True)
    with Transaction() as transaction:
        digests = {}
        for target in written:
            target.write(transaction)
            digests[target.path.relative_to(request.output).as_posix()] = {
                **target.stated,
                "sha256": digest_file(transaction.staged(target.path)),
                "bytes": transaction.staged(target.path).stat().st_size,
            }
        manifest["files"] = digests
        stale, manifest["kept"] = loaded.output.superseded(loaded.there, digests)
        manifest["earlier"] = loaded.output.earlier(loaded.there, manifest["kept"])
        write_manifest(loaded.output.path, manifest, into=transaction)
        transaction.commit(stale)
    seconds = [level.seconds for level, *_ in _rows_of(request, lit, made.of, "levels")]
    rows = tuple({**row, "seconds": s} for row, s in zip(manifest["levels"], seconds, strict=True))
    return Baked(
        name,
        "done",
        tuple(t.path for t in written),
        manifest,
        loaded.planned,
        tuple(t.nbytes for t in written),
        (*loaded.env.notices, *_resized(request, loaded.env), *made.table.notices, *format_notices(manifest)),
        rows,
        time.perf_counter() - loaded.begin,
        tuple(manifest.get("as_read", ())),
    )


def _image_rows(request: BakePlan, env: Environment) -> int:
    """Return the rows of the image for engines that filter it themselves; 0 where it has the size of the chain.

    A cube becomes a lat-long of as many rows as two of its faces.
    """
    return env.texels.shape[-3] * (1 if env.kind == "latlong" else 2) if request.image else 0


def _resized(request: BakePlan, env: Environment) -> list[str]:
    """Return notices of images that `size` makes smaller or larger than their source."""
    own = _image_rows(replace(request, image=True), env)
    return [
        f"{engine.name}: its image has {4 * recipe.size} x {2 * recipe.size} texels, and the source has {own} rows; "
        "without --size it has as many as the source"
        for engine, recipe in zip(request.engines, request.chains, strict=True)
        if engine.holding("environment") and not request.image and 2 * recipe.size != own
    ]


def targets_of(request: BakePlan, name: str, image: int = 0) -> list[Target]:
    """Return the planned files of every engine for an environment called `name`.

    image: rows of the image that engines filter themselves; 0 for those of the chain's size.
    """
    return [
        target
        for engine, recipe in zip(request.engines, request.chains, strict=True)
        for target in targets(engine, recipe, request.output, name, image)
    ]


def _wanted(request: BakePlan, env: Environment) -> tuple[list[Want], list[tuple[int, int]]]:
    """Return the distinct chains to make, and for each engine the indices of its own chain and of Charlie's."""
    rows = _image_rows(request, env)

    def most(a: int | None, b: int | None) -> int | None:
        return None if a is None or b is None else max(a, b)  # None: all

    wants: list[Want] = []
    of = []
    for engine, recipe in zip(request.engines, request.chains, strict=True):
        places = []
        own = Want(
            recipe,
            None if engine.cubes("specular") else 0,
            None if engine.latlong else min(len(engine.holding("environment")), 0 if rows else 1),
            None if engine.octahedral else 0,
            rows if engine.holding("environment") else 0,
        )
        sheen = Want(
            replace(
                recipe,
                ndf=chosen("ndf", "charlie"),
                fit=None,
                tolerance=min(SHEEN * recipe.tolerance, TOLERANCE_RANGE[1]),
            ),
            None if engine.holding("sheen") else 0,
        )
        for want in (own, sheen):
            place = next((k for k, other in enumerate(wants) if other.recipe == want.recipe), len(wants))
            if place == len(wants):
                wants.append(want)
            else:
                old = wants[place]
                wants[place] = Want(
                    want.recipe,
                    most(old.cubes, want.cubes),
                    most(old.latlongs, want.latlongs),
                    most(old.octahedral, want.octahedral),
                    max(old.image, want.image),
                )
            places.append(place)
        of.append((places[0], places[1]))
    return wants, of


def _rows_of(
    request: BakePlan, lit: Lighting, of: Sequence[tuple[int, int]], name: str
) -> list[tuple[Level, float | None, str, tuple[str, ...]]]:
    """Return each distinct level of `name`, a field of Filtered, from large to small and from smooth to rough.

    Each comes with the energy that it keeps (only for "levels"), its NDF and its engines.
    """
    found: dict[int, tuple[Level, float | None, str, tuple[str, ...]]] = {}
    for e, engine in enumerate(request.engines):
        for place, ndf in zip(of[e], (request.recipe.ndf.model.name, "charlie"), strict=True):
            if place == of[e][1] and not engine.holding("sheen") and place != of[e][0]:
                continue
            chain_: Filtered = lit.chains[place]
            if name in ("levels", "coverage") and not engine.cubes("specular"):
                continue
            if name.startswith("octahedral") and not engine.octahedral:
                continue
            if name in ("latlongs", "latlong_coverage") and not (engine.latlong or engine.holding("environment")):
                continue
            own = engine.holding("environment") and chain_.image
            levels = getattr(chain_, name.replace("latlongs", "image").replace("latlong", "image") if own else name)
            kept = chain_.energy_kept if name == "levels" else [None] * len(levels)
            for level, k in zip(levels, kept, strict=True):
                old = found.get(id(level), (level, k, ndf, ()))  # level 0 is of every NDF
                names = old[3] if engine.name in old[3] else (*old[3], engine.name)
                found[id(level)] = (level, k, old[2], names)
    # From large to small and smooth to rough: each engine's are then in the order of its levels.
    return sorted(found.values(), key=lambda row: (row[2] == "charlie", -row[0].texels.shape[-2], row[0].roughness))


def _programs(request: BakePlan, env: Environment) -> tuple[Program, ...]:
    """The kernel programs of a bake."""
    wants, _ = _wanted(request, env)
    texel = math.pi / env.texels.shape[-3] / (1 if env.kind == "latlong" else 2)
    # A part that no engine has needs no program.
    chains = [want.recipe for want in wants if (want.cubes, want.latlongs, want.octahedral, want.image) != (0, 0, 0, 0)]
    charlie = [e.dfg.charlie_masking for e in request.engines if e.dfg.charlie and e.holding("dfg")]
    return programs(chains or [wants[0].recipe], env.kind, texel, demo=env.name == DEMO, charlie=charlie)


def planned_levels(request: BakePlan, texel: float) -> tuple[tuple[tuple[str, ...], LevelPlan], ...]:
    """Return each distinct level of the engines' chains, with the names of its engines.

    texel: angle of the source's texels in radians.
    """
    rows: list[tuple[list[str], LevelPlan]] = []
    for engine, recipe in zip(request.engines, request.chains, strict=True):
        if not engine.needs("specular"):
            continue
        for level in plan_chain(recipe, texel):
            names = next((names for names, other in rows if other == level), None)
            if names is None:
                rows.append(([engine.name], level))
            else:
                names.append(engine.name)
    rows.sort(key=lambda row: (-row[1].size, row[1].roughness))
    return tuple((tuple(sorted(names)), level) for names, level in rows)


def _as_read(
    request: BakePlan,
    on: Device,
    env: Environment,
    lit: Lighting,
    of: Sequence[tuple[int, int]],
    written: Sequence[Encoded],
) -> list[dict[str, Any]]:
    """Errors of each engine's chain after its sampling, in its mapping and from its format."""
    rows: list[dict[str, Any]] = []
    read = [e for e, engine in enumerate(request.engines) if engine.cubes("specular")]
    if not read:
        return rows
    reader = Reader(on, env, *(request.chains[e] for e in read))
    for e in read:
        engine, levels = request.engines[e], lit.chains[of[e][0]].levels
        target = next((t for t in written if t.engine == engine.name and len(t.levels) == len(levels)), None)
        found = reader.as_read(
            request.chains[e],
            [level.texels for level in levels],
            [level.error for level in levels],
            kept=target.levels if target else None,
            format=str(target.stated.get("format", "float32")) if target else "float32",
        )
        rows.append({"for": engine.name, **found.data()})
    return rows


FORMAT_LOSS = 0.05
"""A pixel format that adds more than this to the texel error (p99) of a level is worth a notice."""


def format_notices(manifest: Mapping[str, Any]) -> list[str]:
    """Return sentences about losses by pixel formats: clipped values, windowed harmonics, large errors."""
    found = []
    for name, entry in manifest["files"].items():
        if entry.get("clipped"):
            found.append(
                f"{name}: {entry['clipped']} values over the range of {entry['format']} became its largest; "
                "--sun extract or a lower --exposure keeps them"
            )
        if "sh" in str(entry.get("holds", "")).split(", ") and manifest["sh"]["window"] != [1.0, 1.0, 1.0]:
            sh = manifest["sh"]
            found.append(
                f"{name}: degrees 1 and 2 of its harmonics are windowed by {sh['window'][1]:.3f} and "
                f"{sh['window'][2]:.3f}; their least E/π is {min(sh['minimum']['after']):.3g}, without it "
                f"{min(sh['minimum']['before']):.3g}, their RMSE {sh['rmse']:.2g}"
            )
        worst = max((level.get("format_p99", 0.0) for level in entry.get("levels", ())), default=0.0)
        if worst > FORMAT_LOSS:
            found.append(f"{name}: {entry['format']} costs {worst:.2g} of a texel's value (p99)")
    return found


def _would_read(
    request: BakePlan, env: Environment, device: Device | str | None, on: Device | None
) -> tuple[tuple[dict[str, Any], ...], tuple[str, ...]]:
    """Return errors after the engine's sampling of the planned chain and of others, and notices; empty without a
    device.
    """
    try:
        on = on or choose_device(device if isinstance(device, str) else None)
    except DeviceError as error:
        if device is not None:
            raise
        return (), (f"errors as read are not measured: {error}",)
    rows: list[dict[str, Any]] = []
    done: list[Chain] = []
    for engine, recipe in zip(request.engines, request.chains, strict=True):
        if engine.needs("specular") and recipe not in done:
            done.append(recipe)
            rows += [
                {"for": engine.name, **read.data()}
                for read in compared(on, env, recipe, alone=engine.whole or engine.levels is not None)
            ]
    return tuple(rows), ()


def _canonical(request: BakePlan, rotation: float, exposure: float) -> dict[str, Any]:
    """The recipe as data for the key: everything that changes the bytes, and nothing else."""
    own = {
        e.name: {"engine": e.data(), "chain": c.canonical()}
        for e, c in zip(request.engines, request.chains, strict=True)
        if e.container == "files" or e.without
    }
    return {
        **request.recipe.canonical(),
        "for": sorted(e.name for e in request.engines),
        **({"engines": own} if own else {}),
        **({"sh": request.window} if own or request.window != "auto" else {}),
        "rotate": round(math.degrees(rotation), 9),
        "exposure": exposure,
        **request.reading.recipe(),
        **({"image": "own"} if request.image and any(e.holding("environment") for e in request.engines) else {}),
        "sun": request.sun,
        "irradiance": IRRADIANCE_SIZE,
        **({"as_read": True} if request.as_read else {}),
        "dfg": {"size": DFG_SIZE, "masking": "smith", "tolerance": DFG_TOLERANCE},
    }


@dataclass(frozen=True)
class EntryKey:
    """An NDF as a dictionary key. Two keys are equal only for the same entry, not for two entries of the same name."""

    identity: int
    given: tuple[tuple[str, Any], ...]
    choice: Chosen = field(compare=False)
    """Kept so that no other entry takes its identity."""

    @staticmethod
    def of(choice: Chosen) -> EntryKey:
        """Return the key of an NDF with its given parameters."""
        return EntryKey(id(choice.model), tuple(sorted(choice.given.items())), choice)


@lru_cache(maxsize=4)
def _table(device: Device, ndf: EntryKey) -> Integrated:
    """Return the (scale, bias) table, read-only. It depends on the NDF and the device alone, not on the image."""
    table = dfg(DFG_SIZE, ndf=ndf.choice, tolerance=DFG_TOLERANCE, device=device)
    table.values.flags.writeable = False
    return table


@lru_cache(maxsize=16)
def _split(device: Device, ndf: EntryKey, engine: Engine) -> SplitSum:
    """The split-sum table of an engine, the same for every image."""
    return split_sum(engine.dfg, device=device, ndf=ndf.choice)


def _key(digest: str, recipe: dict[str, Any]) -> str:
    """Return the sha256 of the source bytes, the recipe (with the text of a user's NDF), all kernels and the version.

    All kernels count because tables and derived numbers use many of them.
    """
    parts = [VERSION, digest, json.dumps(recipe, sort_keys=True), source.everything()]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _manifest(
    request: BakePlan,
    name: str,
    env: Environment,
    sun: Sun | None,
    recipe: dict[str, Any],
    key: str,
    device: Device,
    lit: Lighting,
    of: Sequence[tuple[int, int]],
    table: Integrated,
    window: harmonic.Windowed,
) -> dict[str, Any]:
    def row(
        level: Level, kept: float | None = None, ndf: str | None = None, names: Sequence[str] = ()
    ) -> dict[str, Any]:
        data = {
            "size": level.texels.shape[-2],
            "roughness": level.roughness,
            "method": level.method,
            "pairs": level.pairs,
            "error": level.error,
            "worst": level.worst,
            "rmse": level.rmse,
        }
        data |= {"for": sorted(names)} if names else {}
        data |= {"ndf": ndf} if ndf not in (None, request.recipe.ndf.model.name) else {}
        return data if kept is None else {**data, "energy_kept": 1 + kept}

    def rows(name: str) -> list[dict[str, Any]]:
        return [row(*found) for found in _rows_of(request, lit, of, name)]

    cube = Shape(False, IRRADIANCE_SIZE)
    off, most = harmonic.rmse_against(window.values, lit.irradiance.texels, cube.directions(), cube.solid_angles())
    return {
        "whitefurnace": VERSION,
        "name": name,
        "key": key,
        "recipe": recipe,
        "device": device.identity(),
        "source": {
            "sha256": env.digest,
            "layout": env.layout,
            "statistics": env.statistics,
            "notices": list(env.notices),
        },
        **({} if sun is None else {"sun": sun.data()}),
        **(
            {
                "engines": {
                    e.name: {"facts": e.facts, "proven": e.proven, "steps": list(e.steps)}
                    for e in request.engines
                    if e.container == "files"
                }
            }
            if any(e.container == "files" for e in request.engines)
            else {}
        ),
        "levels": rows("levels"),
        "latlong_levels": rows("latlongs"),
        **({"octahedral_levels": rows("octahedral")} if any(e.octahedral for e in request.engines) else {}),
        "coverage_levels": [*rows("coverage"), *rows("latlong_coverage"), *rows("octahedral_coverage")],
        "irradiance": row(lit.irradiance),
        "sh": {
            "coefficients": lit.sh.tolist(),
            "error": lit.sh_error,
            "mode": window.mode,
            "window": window.window.tolist(),
            "minimum": {"before": window.before.tolist(), "after": window.after.tolist()},
            "rmse": off,
            "worst": most,
        },
        "dfg": {"size": DFG_SIZE, "error": table.error, "rule": table.rule},
    }
