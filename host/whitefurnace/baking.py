"""One environment -> the files engines load: key, skipping, ownership, writing, manifest."""
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
from typing import Any

import numpy as np

from whitefurnace import source
from whitefurnace.catalogue import INTEGRALS, model
from whitefurnace.device import Device, choose_device
from whitefurnace.engines import Engine, engines
from whitefurnace.environments import Environment, environment
from whitefurnace.errors import DeviceError, FileError, UsageError
from whitefurnace.files import Transaction, digest_file, read_manifest, write_exr, write_manifest, write_npz
from whitefurnace.lighting import Lighting, light
from whitefurnace.plan import LevelPlan, plan_chain
from whitefurnace.reading import Reader, compared
from whitefurnace.recipe import DFG_SIZE, IRRADIANCE_SIZE, Chain, Chosen, chain
from whitefurnace.run import Integrated, dfg, own_kernel_of
from whitefurnace.suns import Sun, sun_mode, without_sun
from whitefurnace.version import VERSION

DEMO = "demo"
DEMO_HEIGHT = 512
SUN_RADIUS = math.radians(0.2665)  # of the sun as seen from the earth
SUN_RADIANCE = 4e5
DFG_TOLERANCE = 5e-6


def demo(device: Device, height: int = DEMO_HEIGHT) -> Environment:
    """The built-in environment: sky, ground, and a sun over 1e5 times the mean radiance, by a kernel."""
    program = device.build(source.demo().text, {"W": 1, "T": 1, "PRECISION": 32})
    # At the centre of a texel, so that the disc covers one whole and the maximum is the sun's own radiance.
    theta = (round(0.29 * height) + 0.5) * math.pi / height
    phi = (round(1.27 * height) + 0.5) * math.pi / height - math.pi
    size = device.local_size
    image = device.empty((height, 2 * height, 3), np.float32)
    count = -(-2 * height * height // size) * size
    sun = [math.sin(theta) * math.cos(phi), math.cos(theta), math.sin(theta) * math.sin(phi)]
    device.launch(program.kernel("demo"), (count,),
                  (image, np.int32(height), np.int32(4), *(np.float32(x) for x in sun),
                   np.float32(math.cos(SUN_RADIUS)), np.float32(SUN_RADIANCE)))
    return replace(environment(image.read()), name=DEMO)


@dataclass(frozen=True)
class Target:
    """One file of a bake: its path, and what writes it there."""

    path: Path
    engine: str
    nbytes: int
    """Bytes of its arrays, before any compression."""
    write: Callable[[Transaction], None] | None = None


@dataclass(frozen=True)
class Baked:
    """What a bake did or would do for one environment: `done`, `skipped` or `planned`, and its manifest."""

    name: str
    state: str
    files: tuple[Path, ...]
    manifest: dict[str, Any]
    plan: tuple[LevelPlan, ...]
    nbytes: tuple[int, ...]
    notices: tuple[str, ...]
    levels: tuple[dict[str, Any], ...] = ()
    seconds: float = 0.0
    as_read: tuple[dict[str, Any], ...] = ()
    """What an engine shows of the chain (reading.AsRead.data): of this one, or in a plan of what could be had too."""


@dataclass(frozen=True)
class Order:
    """A validated bake of several environments."""

    names: tuple[str, ...]
    sources: tuple[Any, ...]
    output: Path
    engines: tuple[Engine, ...]
    recipe: Chain
    rotate: float
    exposure: float
    nonfinite: str
    sun: str
    force: bool
    as_read: bool = False


def order(sources: Sequence[Any], output: str | os.PathLike[str], *, for_: str = "raw", rotate: float = 0.0,
          exposure: float = 0.0, nonfinite: str = "refuse", sun: str = "keep", force: bool = False,
          as_read: bool = False, **options: Any) -> Order:
    """A validated order; `options` are those of `recipe.chain`. Raises UsageError, UnsupportedError."""
    if not sources:
        raise UsageError("no environment was given")
    names = []
    for item in sources:
        if isinstance(item, Environment):
            names.append(item.name)
        elif isinstance(item, (str, os.PathLike)):
            path = Path(os.path.abspath(item))
            names.append(DEMO if _is_demo(item) else path.name if path.is_dir() else path.stem)
        elif isinstance(item, np.ndarray):
            names.append("array")
        else:
            raise UsageError(f"bake takes paths, arrays and environments, not {type(item).__name__}")
    for k, name in enumerate(names):
        if name in names[:k]:
            raise UsageError(f"two inputs are named {name!r}: their outputs would be the same files")
        if name in ("", ".", "..") or "/" in name or "\\" in name:
            raise UsageError(f"{name!r} cannot name an output")
    sun_mode(sun)
    if options.get("certify") == 0:
        raise UsageError("certify 0: what is written states its error; give 299 or more texels")
    return Order(tuple(names), tuple(sources), Path(output), engines(for_), chain(**options), float(rotate),
                 float(exposure), nonfinite, sun, force, bool(as_read) or options.get("fit") is not None)


def _is_demo(item: Any) -> bool:
    """The word `demo` is the built-in environment, unless there is such a path: a path always wins."""
    return str(item) == DEMO and not os.path.exists(item)


def bake(sources: Any, output: str | os.PathLike[str], *, device: Device | str | None = None,
         dry_run: bool = False, progress: Callable[[str, str, float], None] | None = None,
         **options: Any) -> list[Baked]:
    """Bakes environments (a path, an array, an `environment`, or a list of them; `demo` is built in) into `output`.

    options: for_ ("raw,exr"), size, min_size, ndf, tolerance, quality or samples, rotate (degrees), exposure (stops),
    nonfinite ("refuse", "zero"), sun ("keep", "extract", "clamp=X"), certify (texels of each level's statement),
    levels, fit ("read"), as_read (measures what an engine will show, as fit "read" does too and a plan always), force.
    Files go to `output/ENGINE/STEM…`; `output/STEM.json`, written last, proves the rest whole. An environment whose
    manifest has the same key is skipped.
    Raises UsageError, FileError, InputError, UnsupportedError, CheckError, DeviceError; nothing is written for an
    environment that fails.
    """
    single = isinstance(sources, (str, os.PathLike, np.ndarray, Environment))
    request = order([sources] if single else list(sources), output, **options)
    return [bake_one(request, k, device, dry_run=dry_run, progress=progress) for k in range(len(request.names))]


def bake_one(request: Order, k: int, device: Device | str | None = None, *, dry_run: bool = False,
             progress: Callable[[str, str, float], None] | None = None) -> Baked:
    """The k-th environment of an order."""
    try:
        return _bake_one(request, k, device, dry_run, progress)
    except OSError as error:  # what the system says of a path in passing
        raise FileError(f"cannot use {error.filename or request.output}: {error.strerror or error}") from error


def _bake_one(request: Order, k: int, device: Device | str | None, dry_run: bool,
              progress: Callable[[str, str, float], None] | None) -> Baked:
    begin = time.perf_counter()
    name, item = request.names[k], request.sources[k]
    on: Device | None = device if isinstance(device, Device) else None
    if _is_demo(item):
        on = on or choose_device(device if isinstance(device, str) else None)
        item = demo(on)
    # With its rotation and exposure applied: the kernels see the environment only through these.
    env = environment(item, rotate=request.rotate, exposure=request.exposure,
                      nonfinite=request.nonfinite)  # type: ignore[arg-type]
    env, sun = without_sun(env, request.sun)
    recipe = _canonical(request, env)
    key = _key(env, recipe, request.recipe.ndf)
    targets = _targets(request, name)
    texel = math.pi / env.texels.shape[-3] / (1 if env.kind == "latlong" else 2)
    planned = plan_chain(request.recipe, texel)
    files = tuple(t.path for t in targets)
    sizes = tuple(t.nbytes for t in targets)
    path = request.output / f"{name}.json"
    there = _manifest_at(path, name)
    if not request.force and there and there.get("key") == key and _whole(there, request.output):
        return Baked(name, "skipped", files, there, planned, sizes, env.notices,
                     tuple(there.get("levels", ())), time.perf_counter() - begin)
    # Ours is also what the manifest proves that a killed run left staged.
    known = [m for m in (there, _manifest_at(Transaction.staging(path), name)) if m]
    _check_ownership([*files, path], known, request, path)
    if dry_run:
        read, notices = _would_read(request, env, device, on)
        return Baked(name, "planned", files, {"key": key, "recipe": recipe}, planned, sizes, (*env.notices, *notices),
                     as_read=read)
    folders = sorted({request.output, *(file.parent for file in files)})
    made = [folder for folder in folders if not folder.exists()]
    try:
        for folder in folders:
            _check_writable(folder)
        return _make(request, k, env, sun, recipe, key, device, on, progress, there, planned, begin)
    except BaseException:
        for folder in reversed(made):
            with contextlib.suppress(OSError):  # not empty: something of ours is whole
                folder.rmdir()
        raise


def _make(request: Order, k: int, env: Environment, sun: Sun | None, recipe: dict[str, Any], key: str,
          device: Device | str | None, on: Device | None, progress: Callable[[str, str, float], None] | None,
          there: dict[str, Any] | None, planned: tuple[LevelPlan, ...], begin: float) -> Baked:
    """Bakes and writes; `there` is the manifest that is replaced."""
    name = request.names[k]
    path = request.output / f"{name}.json"
    on = on or choose_device(device if isinstance(device, str) else None)
    tell = (lambda what, share: progress(name, what, share)) if progress else None
    lit = light(on, env, request.recipe, latlong=any(e.latlong for e in request.engines), seed=key, progress=tell)
    table = _table(on, _Held.of(request.recipe.ndf))
    manifest = _manifest(name, env, sun, recipe, key, on, lit, table)
    if request.as_read:
        read = Reader(on, env, request.recipe).as_read(request.recipe, [level.texels for level in lit.levels],
                                                       [level.error for level in lit.levels])
        manifest["as_read"] = read.data()
    with Transaction() as transaction:
        digests = {}
        provenance = {"version": VERSION, "key": key, "source": env.digest,
                      "recipe": json.dumps(recipe, sort_keys=True)}
        for target in _targets(request, name, lit, table, provenance):
            assert target.write is not None
            target.write(transaction)
            digests[target.path.relative_to(request.output).as_posix()] = {
                "sha256": digest_file(transaction.staged(target.path)),
                "bytes": transaction.staged(target.path).stat().st_size}
        manifest["files"] = digests
        stale, manifest["kept"] = _superseded(request, there, digests)
        write_manifest(path, manifest, into=transaction)
        transaction.commit()
    for file in stale:
        with contextlib.suppress(OSError):
            file.unlink()
    seconds = [level.seconds for level in lit.levels]
    rows = tuple({**row, "seconds": s} for row, s in zip(manifest["levels"], seconds, strict=True))
    targets = _targets(request, name)
    return Baked(name, "done", tuple(t.path for t in targets), manifest, planned, tuple(t.nbytes for t in targets),
                 (*env.notices, *table.notices), rows, time.perf_counter() - begin,
                 (manifest["as_read"],) if request.as_read else ())


def _would_read(request: Order, env: Environment, device: Device | str | None,
                on: Device | None) -> tuple[tuple[dict[str, Any], ...], tuple[str, ...]]:
    """What engines would show of the planned chain and of others, and notices: a plan needs no device for the rest."""
    try:
        on = on or choose_device(device if isinstance(device, str) else None)
    except DeviceError as error:
        if device is not None:
            raise
        return (), (f"errors as read are not measured: {error}",)
    return tuple(read.data() for read in compared(on, env, request.recipe)), ()


def _superseded(request: Order, there: dict[str, Any] | None,
                digests: dict[str, Any]) -> tuple[list[Path], dict[str, Any]]:
    """What the old manifest proves ours and the new bake does not write: files of the same engines, which are
    stale (a longer chain's last levels), and entries of other engines, which stay and stay ours."""
    baked = {engine.name for engine in request.engines}
    stale, kept = [], {}
    for relative, entry in _entries(there).items() if there else ():
        file = request.output / relative
        if relative in digests or not file.is_file() or digest_file(file) != entry.get("sha256"):
            continue
        if relative.split("/")[0] in baked:
            stale.append(file)
        else:
            kept[relative] = entry
    return stale, kept


def _entries(manifest: dict[str, Any]) -> dict[str, Any]:
    """Every file that a manifest proves ours, those of earlier bakes for other engines too."""
    return {**manifest.get("kept", {}), **manifest["files"]}


def _canonical(request: Order, env: Environment) -> dict[str, Any]:
    """The recipe as data: everything that changes the bytes, and nothing else."""
    return {**request.recipe.canonical(), "for": sorted(e.name for e in request.engines),
            "rotate": round(math.degrees(env.rotation), 9),
            "exposure": env.exposure, "nonfinite": request.nonfinite, "sun": request.sun, "irradiance": IRRADIANCE_SIZE,
            **({"as_read": True} if request.as_read else {}),
            "dfg": {"size": DFG_SIZE, "masking": "smith", "tolerance": DFG_TOLERANCE}}


@dataclass(frozen=True)
class _Held:
    """An NDF as the key of what is kept between the images of a bake: this very entry, not one of the same name."""

    identity: int
    given: tuple[tuple[str, Any], ...]
    choice: Chosen = field(compare=False)
    """Kept too, so that no other entry takes its identity."""

    @staticmethod
    def of(choice: Chosen) -> _Held:
        return _Held(id(choice.model), tuple(sorted(choice.given.items())), choice)


@lru_cache(maxsize=4)
def _table(device: Device, ndf: _Held) -> Integrated:
    """The DFG table: of the NDF and the device alone, so the same for every image. Not to be written to."""
    table = dfg(DFG_SIZE, ndf=ndf.choice, tolerance=DFG_TOLERANCE, device=device)
    table.values.flags.writeable = False
    return table


def _key(env: Environment, recipe: dict[str, Any], ndf: Chosen) -> str:
    """sha256 over the source bytes, the canonical recipe, the kernels and the version."""
    parts = [VERSION, env.digest, json.dumps(recipe, sort_keys=True), *_kernel_digests(env.kind, _Held.of(ndf))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@lru_cache(maxsize=8)
def _kernel_digests(kind: str, ndf: _Held) -> tuple[str, ...]:
    """The digests of every kernel that a bake of a source of this kind may run."""
    slots = {"ndf": ndf.choice.model, "masking": model("masking", "smith")}
    texts = [source.texels(kind), source.overlap(), source.convolution(ndf.choice.model), source.convolution(None),
             source.samples(), source.octahedral(), source.apart(ndf.choice.model), source.apart(None),
             source.interpolation(), source.near_texels(kind, ndf.choice.model),
             source.integration(INTEGRALS["dfg"], slots)]
    if own := own_kernel_of(INTEGRALS["dfg"], slots):
        texts.append(source.closed(own, slots))
    return tuple(t.digest for t in texts)


def _manifest_at(path: Path, name: str) -> dict[str, Any] | None:
    """The manifest of this item at `path`, or None where there is none that could prove anything."""
    found = read_manifest(path)
    if found is None or found.get("name") != name:
        return None
    for files in (found.get("files"), found.get("kept", {})):
        if not (isinstance(files, dict) and all(isinstance(entry, dict) for entry in files.values())):
            return None
    return found


def _whole(manifest: dict[str, Any], output: Path) -> bool:
    for relative, entry in manifest["files"].items():
        path = output / relative
        if not path.is_file() or digest_file(path) != entry.get("sha256"):
            return False
    return True


def _check_ownership(paths: Sequence[Path], known: Sequence[dict[str, Any]], request: Order, manifest: Path) -> None:
    """Refuses to replace what no manifest of ours proves to be ours for this item. Raises FileError."""
    if request.force:
        return
    ours: dict[str, set[Any]] = {}
    for m in known:
        for relative, entry in _entries(m).items():
            ours.setdefault(relative, set()).add(entry.get("sha256"))
    for path in paths:
        if not path.exists():
            continue
        if path == manifest and known:
            continue
        relative = path.relative_to(request.output).as_posix()
        if relative not in ours or not path.is_file() or digest_file(path) not in ours[relative]:
            raise FileError(f"{path} is there and was not written by this bake; move it away or give --force")


def _check_writable(output: Path) -> None:
    """Finds an output folder that cannot be made or written before the work is done, not after."""
    try:
        output.mkdir(parents=True, exist_ok=True)
        probe = output / f".whitefurnace-{os.getpid()}.tmp"
        try:
            with open(probe, "wb"):
                pass
        finally:  # Ctrl-C between the two would leave it there
            probe.unlink(missing_ok=True)
    except OSError as error:
        raise FileError(f"cannot write into {output}: {error.strerror or error}") from error


def _manifest(name: str, env: Environment, sun: Sun | None, recipe: dict[str, Any], key: str, device: Device,
              lit: Lighting, table: Integrated) -> dict[str, Any]:
    def row(level: Any, kept: float | None = None) -> dict[str, Any]:
        data = {"size": level.texels.shape[-2], "roughness": level.roughness, "method": level.method,
                "pairs": level.pairs, "error": level.error, "worst": level.worst, "rmse": level.rmse}
        return data if kept is None else {**data, "energy_kept": 1 + kept}

    return {
        "whitefurnace": VERSION,
        "name": name,
        "key": key,
        "recipe": recipe,
        "device": device.identity(),
        "source": {"sha256": env.digest, "layout": env.layout, "statistics": env.statistics,
                   "notices": list(env.notices)},
        **({} if sun is None else {"sun": sun.data()}),
        "levels": [row(level, kept) for level, kept in zip(lit.levels, lit.energy_kept, strict=True)],
        "latlong_levels": [row(level) for level in lit.latlongs],
        "coverage_levels": [row(level) for level in (*lit.coverage, *lit.latlong_coverage)],
        "irradiance": row(lit.irradiance),
        "sh": {"coefficients": lit.sh.tolist(), "error": lit.sh_error},
        "dfg": {"size": DFG_SIZE, "error": table.error, "rule": table.rule},
    }


# ------------------------------------------------------------------------------------------------- containers


def _targets(request: Order, name: str, lit: Lighting | None = None, table: Integrated | None = None,
             provenance: dict[str, str] | None = None) -> list[Target]:
    """The files of every engine; with the results at hand, also what writes them."""
    found: list[Target] = []
    for engine in request.engines:
        found += CONTAINERS[engine.container](request, engine, name, lit, table, provenance or {})
    return found


def _npz(request: Order, engine: Engine, name: str, lit: Lighting | None, table: Integrated | None,
         provenance: dict[str, str]) -> list[Target]:
    path = request.output / engine.name / f"{name}.npz"
    count = 3 * sum(6 * s * s for s, _ in request.recipe.levels) + 3 * 6 * IRRADIANCE_SIZE**2 + 2 * DFG_SIZE**2
    if lit is None or table is None:
        return [Target(path, engine.name, 4 * count)]
    arrays: dict[str, np.ndarray] = {f"specular_{k}": level.texels for k, level in enumerate(lit.levels)}
    for statistic in ("roughness", "error", "worst", "rmse"):
        arrays[statistic] = np.array([getattr(level, statistic) for level in lit.levels])
    arrays |= {"irradiance": lit.irradiance.texels, "sh": lit.sh, "dfg": table.values}
    arrays |= {f"coverage_{k}": level.texels[..., 0] for k, level in enumerate(lit.coverage)}
    return [Target(path, engine.name, 4 * count, lambda t: write_npz(path, arrays, into=t))]


def _exr(request: Order, engine: Engine, name: str, lit: Lighting | None, table: Integrated | None,
         provenance: dict[str, str]) -> list[Target]:
    targets: list[Target] = []

    def add(ending: str, shape: tuple[int, int], texels: np.ndarray | None, alpha: np.ndarray | None = None,
            channels: str = "RGB", attributes: Mapping[str, str | float] | None = None) -> None:
        path = request.output / engine.name / f"{name}_{ending}.exr"
        nbytes = 4 * shape[0] * shape[1] * len(channels)
        if texels is None:
            targets.append(Target(path, engine.name, nbytes))
            return
        pixels = texels.reshape(*shape, -1)
        names = channels
        if alpha is not None:
            pixels, names = np.concatenate([pixels, alpha.reshape(*shape, 1)], -1), "RGBA"
        told = {f"whitefurnace:{key}": value for key, value in {**provenance, **(attributes or {})}.items()}
        targets.append(Target(path, engine.name, nbytes, lambda t: write_exr(
            path, pixels, channel_names=tuple(names), attributes=told, into=t)))

    for k, (size, _) in enumerate(request.recipe.levels):
        cube, wide = (6 * size, size), (2 * size, 4 * size)
        if lit is None:
            add(f"specular_{k}", cube, None)
            add(f"specular_{k}_latlong", wide, None)
            continue
        for ending, shape, level, coverage in (
            (f"specular_{k}", cube, lit.levels[k], lit.coverage),
            (f"specular_{k}_latlong", wide, lit.latlongs[k], lit.latlong_coverage),
        ):
            add(ending, shape, level.texels, coverage[k].texels[..., 0] if coverage else None, attributes={
                "roughness": level.roughness, "error": level.error, "worst": level.worst, "rmse": level.rmse,
                "method": level.method})
    irradiance = (6 * IRRADIANCE_SIZE, IRRADIANCE_SIZE)
    if lit is None or table is None:
        add("irradiance", irradiance, None)
        add("dfg", (DFG_SIZE, DFG_SIZE), None, channels="RG")
        return targets
    add("irradiance", irradiance, lit.irradiance.texels, attributes={
        "error": lit.irradiance.error, "sh": json.dumps(lit.sh.tolist())})
    add("dfg", (DFG_SIZE, DFG_SIZE), table.values, channels="RG", attributes={"error": table.error, "rule": table.rule})
    return targets


CONTAINERS = {"npz": _npz, "exr": _exr}
