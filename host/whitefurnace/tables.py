"""An integral over a grid of parameters -> one file with a manifest beside it: axes, key, skipping, ownership."""
from __future__ import annotations

import hashlib
import inspect
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace import bilinear
from whitefurnace.catalogue import integral
from whitefurnace.device import Device, choose_device
from whitefurnace.energy import KINDS, fresnel_demand
from whitefurnace.environments import environment as load
from whitefurnace.errors import FileError, UnsupportedError, UsageError, nearest
from whitefurnace.files import (
    Transaction,
    digest_file,
    read_manifest,
    release,
    scratch,
    write_exr,
    write_manifest,
    write_npy,
)
from whitefurnace.integrals import integrate
from whitefurnace.radiance import ENVIRONMENT_TOLERANCE, radiance_demand
from whitefurnace.recipe import Chosen, Spec, chosen, is_number
from whitefurnace.run import DEFAULT_TOLERANCE, Demand, Integrated, demand, rows_of_roughness
from whitefurnace.version import VERSION

SIZE = 128
SIZES = (1, 16384)
SCALES = ("linear", "log", "centres", "sqrt")
FITS = ("bilinear",)
FITTED = (2, 512)
CHANNELS = {1: ("Y",), 2: ("R", "G"), 3: ("R", "G", "B")}
FORMS = (".npy", ".exr")
OPTIONS = frozenset(inspect.signature(integrate).parameters) - {"parameters"}


@dataclass(frozen=True)
class Axis:
    """A dimension of a table: `count` values of a parameter from `low` to `high`.

    The scales "linear", "log" and "sqrt" have the first value at `low` and the last at `high`, "sqrt" in equal steps of
    the root of what is above `low`; "centres" has value k at low + (k + ½)(high - low)/count, where a texture is read.
    `NoV` is the cosine of the view angle, `roughness` the perceptual roughness that every model with a roughness
    follows, all else a parameter of the models.
    """

    name: str
    low: float
    high: float
    count: int
    scale: str = "linear"

    def values(self) -> np.ndarray:
        if self.scale == "centres":
            return self.low + (np.arange(self.count) + 0.5) * ((self.high - self.low) / self.count)
        if self.scale == "log":
            return np.geomspace(self.low, self.high, self.count)
        if self.scale == "sqrt":
            return self.low + (self.high - self.low) * np.linspace(0, 1, self.count) ** 2
        return np.linspace(self.low, self.high, self.count)

    def at(self, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values and texel coordinates (0 is the first value) at shares in [0, 1] of the axis as it is read."""
        if self.scale == "log":
            values = self.low * (self.high / self.low) ** share
        else:
            values = self.low + (self.high - self.low) * (share**2 if self.scale == "sqrt" else share)
        return values, share * self.count - 0.5 if self.scale == "centres" else share * (self.count - 1)

    def canonical(self) -> dict[str, Any]:
        return {"name": self.name, "from": self.low, "to": self.high, "count": self.count, "scale": self.scale}

    def __str__(self) -> str:
        if self.scale == "centres" and (self.low, self.high) == (0.0, 1.0):
            return f"{self.name} = (k + ½)/{self.count}"
        return f"{self.name} = {self.low:g} … {self.high:g}, {self.count} {self.scale}"


@dataclass(frozen=True)
class Points:
    """Values of a parameter that are no axis of the table."""

    name: str
    given: np.ndarray

    def values(self) -> np.ndarray:
        return self.given


def axis(name: str, given: str | Sequence[Any] | Axis) -> Axis:
    """An axis from `A:B:N`, `A:B:N:SCALE` or a tuple of the same. Raises UsageError."""
    if isinstance(given, Axis):
        return given
    parts = given.split(":") if isinstance(given, str) else list(given)
    form = f"axis {name}: {given!r} is not A:B:N or A:B:N:SCALE"
    if len(parts) not in (3, 4):
        raise UsageError(form)
    try:
        low, high, count = float(parts[0]), float(parts[1]), int(parts[2])
    except (TypeError, ValueError):
        raise UsageError(form) from None
    scale = parts[3] if len(parts) == 4 else "linear"
    if scale not in SCALES:
        raise UsageError(f"axis {name}: unknown scale {scale!r}{nearest(str(scale), SCALES)}")
    if not (math.isfinite(low) and math.isfinite(high)):
        raise UsageError(f"axis {name}: its ends must be finite")
    if scale == "log" and not (low > 0 and high > 0):
        raise UsageError(f"axis {name}: a log scale needs ends above 0, not {low:g} and {high:g}")
    return Axis(name, low, high, _count(count, f"axis {name}: "), scale)


def _count(count: int, where: str = "") -> int:
    low, high = SIZES
    if not low <= count <= high:
        raise UsageError(f"{where}size {count} is outside [{low}, {high}]")
    return count


def _sizes(size: int | str | Sequence[int]) -> tuple[int, int, bool]:
    """(N, M, whether both were given) of `N`, `NxM` or a pair."""
    items: list[Any] = size.lower().replace("×", "x").split("x") if isinstance(size, str) else \
        list(size) if isinstance(size, Sequence) else [size]
    try:
        counts = [_count(int(item)) for item in items]
    except (TypeError, ValueError):
        counts = []
    if len(counts) not in (1, 2):
        raise UsageError(f"size {size!r} is not N or NxM")
    return counts[0], counts[-1], len(counts) == 2


@dataclass(frozen=True)
class Order:
    """A validated table: `axes` the fastest, x, first, `fixed` what is one number, `columns` what `integrate` is told
    of both, `lit` the light of radiance as `integrate` takes it and `around` the environment as data."""

    kind: str
    path: Path
    models: Mapping[str, Chosen]
    axes: tuple[Axis, ...]
    fixed: Mapping[str, float]
    backfacing: str | None
    precision: int
    tolerance: float
    fit: str | None
    as_read: bool
    scheme: str | None
    force: bool
    columns: Mapping[str, np.ndarray]
    demand: Demand
    lit: Mapping[str, Any]
    around: Mapping[str, Any]

    @property
    def shape(self) -> tuple[int, ...]:
        """[…, y, x(, c)]."""
        return self.demand.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(f"f{self.precision // 8}")

    @property
    def nbytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def manifest_path(self) -> Path:
        return self.path.with_name(self.path.name + ".json")

    def canonical(self) -> dict[str, Any]:
        """The recipe as data: everything that changes the bytes, and nothing else."""
        return {"integral": self.kind, "models": {slot: c.canonical() for slot, c in self.demand.slots.items()},
                "parameters": dict(self.fixed), "axes": [a.canonical() for a in self.axes],
                "backfacing": self.backfacing, "precision": self.precision, "tolerance": self.tolerance,
                **({"fit": self.fit} if self.fit else {}), **({"as_read_stated": True} if self.as_read else {}),
                **({"scheme": self.scheme} if self.scheme else {}), **self.around, "format": self.path.suffix.lower()}

    def key(self) -> str:
        """sha256 over the recipe, the kernels and the version."""
        parts = [VERSION, json.dumps(self.canonical(), sort_keys=True), *self.demand.digests]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@dataclass(frozen=True)
class Table:
    """What `lut` did or would do: `done`, `skipped` or `planned`, and its manifest (the recipe alone if planned)."""

    path: Path
    state: str
    shape: tuple[int, ...]
    axes: tuple[Axis, ...]
    nbytes: int
    manifest: dict[str, Any]
    notices: tuple[str, ...] = ()
    seconds: float = 0.0


def order(kind: str, path: str | os.PathLike[str], *, size: int | str | Sequence[int] = SIZE,
          axes: Mapping[str, Any] | None = None, ndf: Spec | None = None, masking: Spec | None = None,
          fresnel: Spec | None = None, diffuse: Spec | None = None, brdf: Spec | None = None,
          light: Spec | None = None, environment: Any = None, normal: Sequence[float] | None = None,
          rotate: float = 0.0, exposure: float = 0.0, nonfinite: str = "refuse", backfacing: str | None = None,
          precision: int = 32, tolerance: float | None = None, fit: str | None = None, as_read: bool = False,
          scheme: str | None = None, force: bool = False,
          parameters: Mapping[str, Any] | None = None, **fixed: Any) -> Order:
    """A validated table; see `lut`. Raises UsageError, UnsupportedError, and what a user's file raises."""
    own = KINDS.get(kind)
    scheme = own.scheme_of(scheme) if own else scheme
    if own is None and scheme is not None:
        raise UsageError(f"{kind} has no scheme; energy has")
    entry = integral(own.integral(scheme) if own else kind)
    path = Path(path)
    form = path.suffix.lower()
    if form not in FORMS:
        raise UsageError(f"{path}: a table is written as {' or '.join(FORMS)}, not {path.suffix or 'without a suffix'}")
    if precision not in DEFAULT_TOLERANCE:
        raise UsageError(f"precision {precision} is not one of {', '.join(map(str, DEFAULT_TOLERANCE))}")
    if form == ".exr" and precision == 64:
        raise UsageError("EXR holds float32: give .npy for precision 64")
    usual = DEFAULT_TOLERANCE if environment is None else ENVIRONMENT_TOLERANCE
    tolerance = usual[precision] if tolerance is None else tolerance
    if not is_number(tolerance) or not 0 < tolerance < 1:  # also NaN
        raise UsageError(f"tolerance {tolerance!r} is outside (0, 1)")
    lone = own is not None and own.slot == "fresnel"
    if lone and not (ndf is None and masking is None and diffuse is None and brdf is None):
        raise UnsupportedError(f"{kind} is of Fresnel's term alone: give a fresnel, and no ndf, masking, diffuse or "
                               "brdf")
    if own and not lone and not (fresnel is None and diffuse is None and brdf is None):
        raise UnsupportedError(f"{kind} is of an NDF and its masking; Fresnel's term is 1, and nothing else is added")
    if ndf is None and diffuse is None and brdf is None and not lone:
        ndf = own.model if own else "ggx"
    if ndf is None and not lone and (masking is not None or fresnel is not None):
        raise UsageError(f"{'masking' if masking is not None else 'fresnel'} is of an NDF, and none is given")
    given = {"ndf": ndf, "masking": masking or "smith", "fresnel": fresnel or "one", "diffuse": diffuse, "brdf": brdf}
    if lone:
        given = {"fresnel": fresnel or own.model}  # type: ignore[union-attr]
    # Chosen once: a user's file is read once, and what was read is what the key is of.
    models = {slot: chosen(slot, spec) for slot, spec in given.items() if spec is not None}
    numbers = {name: _number(name, value) for name, value in {**(parameters or {}), **fixed}.items()}
    if lone and not axes:
        axes = _usual(models["fresnel"], numbers, _sizes(size)[0])
    scaled = {name: given for name, given in (axes or {}).items() if given in SCALES}  # a default axis, scaled
    explicit = {name: axis(name, given) for name, given in (axes or {}).items() if name not in scaled}
    for name in (*numbers, *explicit, *scaled):
        if name in OPTIONS:
            raise UsageError(f"{name} is an option and no parameter; a model's own of that name is SLOT_{name}")
    placed = _placed(entry.view, models, _sizes(size), explicit, numbers, scaled)
    if form == ".exr" and len(placed) > 2:
        raise UsageError(f"EXR holds two axes, not {len(placed)}: give .npy")
    if not placed:
        raise UsageError("a table has an axis at least, and every parameter is given as a number")
    if fit is not None and fit not in FITS:
        raise UsageError(f"unknown fit {fit!r}{nearest(str(fit), FITS)}")
    as_read = as_read or fit is not None
    if as_read and not (len(placed) == 2 and all(FITTED[0] <= a.count <= FITTED[1] for a in placed)):
        raise UsageError(f"what is read between texels is told of tables with two axes of {FITTED[0]} to {FITTED[1]}")
    columns = _columns(placed, models, numbers)
    lit, around = _lit(kind, light, environment, normal, rotate, exposure, nonfinite)
    what: dict[str, Any] = {**models, **columns, "backfacing": backfacing}
    asked = (fresnel_demand(models, columns) if lone else radiance_demand(light=lit.get("light"), **what) if lit else
             demand(entry.name, **what))
    if own and not lone:
        asked = replace(asked, shape=(*asked.shape[:len(np.broadcast_shapes(*map(np.shape, columns.values())))], 2))
    if form == ".exr" and asked.shape[2:] and asked.shape[2] not in CHANNELS:
        raise UsageError(f"EXR holds 1 to 3 channels, not {asked.shape[2]}")
    return Order(kind, path, models, placed, numbers, backfacing, precision, float(tolerance), fit, as_read, scheme,
                 force, columns, asked, lit, around)


def _lit(kind: str, light: Spec | None, around: Any, normal: Sequence[float] | None, rotate: float, exposure: float,
         nonfinite: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What radiance is lit by, for `integrate`, and the environment as data for the recipe."""
    if kind != "radiance":
        wrong = [name for name, given in (("light", light), ("environment", around), ("normal", normal)) if
                 given is not None]
        if wrong:
            raise UsageError(f"integral {kind} has no {wrong[0]}; integral radiance has")
        return {}, {}
    if (light is None) == (around is None):
        raise UsageError("integral radiance needs either a light or an environment")
    if light is not None:
        if normal is not None or rotate or exposure:
            raise UsageError("normal, rotate and exposure are of an environment; a light lies in the surface's frame")
        return {"light": chosen("light", light)}, {}
    env = load(around, rotate=rotate, exposure=exposure, nonfinite=nonfinite)  # type: ignore[arg-type]
    up = (0.0, 1.0, 0.0) if normal is None else tuple(map(float, normal))
    return {"environment": env, "normal": up}, {"environment": {
        "sha256": env.digest, "rotate": round(math.degrees(env.rotation), 9), "exposure": env.exposure,
        "nonfinite": nonfinite, "normal": list(up)}}


def _usual(choice: Chosen, fixed: Mapping[str, float], count: int) -> dict[str, Axis]:
    """An axis over the first parameter of a model that has no value: its domain where that ends at 1, else from the
    least to the largest of its typical values."""
    free = [p for p in choice.model.parameters if p.default is None and p.name not in choice.given
            and not {p.name, f"{choice.model.slot}_{p.name}"} & set(fixed)]
    ends = {p.name: (p.low, p.high) if p.high <= 1 else (min(p.typical), max(p.typical)) for p in free[:1]}
    return {name: Axis(name, *both, count) for name, both in ends.items()}


def _number(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        hint = f"; give a range as an axis, {name}={value}" if isinstance(value, str) and ":" in value else \
            "; RGB goes with its model, as schlick:f0=1/.71/.29" if isinstance(value, str) and "/" in value else ""
        raise UsageError(f"{name}={value!r} is not a number{hint}") from None
    if not math.isfinite(number):
        raise UsageError(f"{name}={value!r} is not finite")
    return number


def _placed(view: bool, models: Mapping[str, Chosen], sizes: tuple[int, int, bool], explicit: Mapping[str, Axis],
            fixed: Mapping[str, float], scaled: Mapping[str, str] | None = None) -> tuple[Axis, ...]:
    """The axes in their order, x first: NoV where there is a view, roughness where some model's follows it and is not
    given, each unless it is fixed and as given where it is; then the others."""
    for name in explicit:
        if name in fixed:
            raise UsageError(f"{name} is given both as a number and as an axis")
    across, down, both = sizes
    defaults = {}
    if view and "NoV" not in fixed:
        defaults["NoV"] = Axis("NoV", 0.0, 1.0, across, "centres")
    taken = {*explicit, *fixed}
    if "roughness" not in fixed and any(_following(choice, taken) for choice in models.values()):
        defaults["roughness"] = Axis("roughness", 0.0, 1.0, down, "centres")
    for name, scale in (scaled or {}).items():
        if name not in defaults:
            raise UsageError(f"axis {name}: there is no default axis of that name to scale; give A:B:N:{scale}")
        if scale == "log":
            raise UsageError(f"axis {name}: a log scale needs ends above 0; give A:B:N:log")
        defaults[name] = replace(defaults[name], scale=scale)
    if both:
        for name, count in (("NoV", across), ("roughness", down)):
            if name not in defaults or name in explicit:
                raise UsageError(f"size {across}x{down}: there is no default axis {name} for the {count}; give one "
                                 "number")
    placed = [explicit.get(name, default) for name, default in defaults.items()]
    placed += [a for name, a in explicit.items() if name not in defaults]
    return tuple(placed)


def _following(choice: Chosen, taken: Any) -> list[str]:
    """The parameters of a model that follow roughness and are not given otherwise."""
    entry = choice.model
    follow = entry.from_roughness(0.5) if entry.from_roughness else {}
    return [name for name in follow if name not in choice.given and f"{entry.slot}_{name}" not in taken and
            (name not in taken or name == "roughness")]


def _columns(axes: Sequence[Axis | Points], models: Mapping[str, Chosen],
             fixed: Mapping[str, float]) -> dict[str, np.ndarray]:
    """What `integrate` is told: numbers, and arrays that broadcast to […, y, x]."""
    dimensions = max(len(axes), 2)  # [y, x] at least
    columns = {name: np.array(value) for name, value in fixed.items()}
    for k, one in enumerate(axes):
        columns[one.name] = one.values().reshape([-1 if dimensions - 1 - k == d else 1 for d in range(dimensions)])
    taken = set(columns)
    values = columns.pop("roughness", None)
    if values is not None:
        rows: dict[str, np.ndarray] = {}
        for choice in models.values():
            follow = _following(choice, taken)
            if follow:
                rows |= {name: row for name, row in rows_of_roughness(choice, values).items()
                         if name.removeprefix(f"{choice.model.slot}_") in follow}
            elif any(p.name == "roughness" for p in choice.model.parameters) and "roughness" not in choice.given:
                rows[f"{choice.model.slot}_roughness"] = values
        if not rows:
            raise UsageError("roughness: no model follows it with a parameter that is not given otherwise")
        columns |= rows
    return columns


# ---------------------------------------------------------------------------------------------- making


Progress = Callable[[str, str, float], None]


def lut(kind: str, path: str | os.PathLike[str], *, device: Device | str | None = None, dry_run: bool = False,
        progress: Progress | None = None, **options: Any) -> Table:
    """Writes a table of any integral to `path` (.npy or .exr), and beside it `path.json`, last, which proves it whole.

    kind is an integral's name, "energy" (what multiple scattering gives back, `scheme` "kulla_conty", "turquin" or
    "fdez_aguera"), "sheen" or "fresnel_average". options: size (N, (N, M) or "NxM"; 128), axes ({name: (A, B, N[,
    "linear" | "log" | "centres" | "sqrt"])}, or a scale alone for a default axis), fit ("bilinear": texels that read
    best, of two axes), as_read (state errors between texels; a fit does), ndf (`ggx` unless there is a diffuse or
    brdf), masking, fresnel, diffuse, brdf, backfacing, precision, tolerance, force, for radiance light or environment,
    normal, rotate, exposure, nonfinite, and parameters, as one number each, by name or as a mapping.

    The array is […, y, x(, c)] of float32 or float64. x is NoV = (x + ½)/N for integrals with a view, y perceptual
    roughness r = (y + ½)/M, row 0 smoothest, which the models' own parameters follow; without a view r alone is x. A
    parameter that is given stays put; an axis of the same name replaces a default one, others come after it, slower,
    in their order. More than two want .npy. What exists with the same key is skipped, what the manifest proves ours
    replaced, and anything else needs `force`. Raises UsageError, UnsupportedError, FileError, CheckError, DeviceError.
    """
    return make(order(kind, path, **options), device, dry_run=dry_run, progress=progress)


def make(request: Order, device: Device | str | None = None, *, dry_run: bool = False,
         progress: Progress | None = None) -> Table:
    """Makes the table of an order."""
    try:
        return _make(request, device, dry_run, progress)
    except OSError as error:  # what the system says of a path in passing
        raise FileError(f"cannot use {error.filename or request.path}: {error.strerror or error}") from error


def _make(request: Order, device: Device | str | None, dry_run: bool, progress: Progress | None) -> Table:
    begin = time.perf_counter()
    key = request.key()
    there = _manifest_at(request.manifest_path, request)
    plain = Table(request.path, "planned", request.shape, request.axes, request.nbytes,
                  {"key": key, "recipe": request.canonical()})
    if not request.force and there and there.get("key") == key and _proves(there, request.path):
        return replace(plain, state="skipped", manifest=there, seconds=time.perf_counter() - begin)
    _check_ownership(request, there)
    if dry_run:
        return plain
    on = device if isinstance(device, Device) else choose_device(device)
    made: list[Integrated] = []
    told: dict[str, Any] = {}

    def fill(out: np.ndarray) -> None:
        def tell(share: float) -> None:
            release(out)
            if progress:
                progress(request.path.name, "cells", share)

        if request.fit:
            result = _fitted(request, on, out, told)
        else:
            result = _values(request, on, request.columns, request.tolerance, told, out, tell)
        if request.as_read:
            told["as_read"] = _as_read(request, on, out)
        made.append(replace(result, values=np.empty(0)))  # the file has them; what is held would keep it mapped

    with Transaction() as transaction:
        if request.path.suffix.lower() == ".npy":
            write_npy(request.path, request.shape, request.dtype, fill, into=transaction)
        else:
            _exr(request, key, fill, made, told, transaction)
        staged = transaction.staged(request.path)
        manifest = {**_manifest(request, key, on, made[0]), **told}
        manifest |= {"sha256": digest_file(staged), "bytes": staged.stat().st_size}
        write_manifest(request.manifest_path, manifest, into=transaction)
        transaction.commit()
    return replace(plain, state="done", manifest=manifest, notices=made[0].notices,
                   seconds=time.perf_counter() - begin)


def _values(request: Order, on: Device, columns: Mapping[str, np.ndarray], tolerance: float,
            told: dict[str, Any] | None = None, out: np.ndarray | None = None,
            progress: Callable[[float], None] | None = None) -> Integrated:
    """The table's values at columns, […, c]; `told` is what is to be said of them."""
    what: dict[str, Any] = {**request.models, **columns, "backfacing": request.backfacing, "device": on,
                            "precision": request.precision, "tolerance": tolerance, "out": out}
    if request.kind in KINDS:
        result, facts = KINDS[request.kind].make(request.scheme, told is not None, **what)
        if told is not None:
            told |= facts
        return result
    return integrate(request.kind, progress=progress, **request.lit, **what)


def _at(request: Order, on: Device, shares: Sequence[np.ndarray], tolerance: float) -> tuple[Any, ...]:
    """Values at shares of x and y, (ny, nx, c) float64, the weights of reads there along y and x, the rows that count,
    and what was integrated."""
    points, weights = [], []
    for one, share in zip(request.axes, shares, strict=True):
        values, x = one.at(share)
        points.append(Points(one.name, values))
        weights.append(bilinear.hats(one.count, x))
    made = _values(request, on, _columns(points, request.models, request.fixed), tolerance)
    down = points[1]
    counted = down.given >= bilinear.LEAST if down.name == "roughness" else np.ones(down.given.size, bool)
    truth = np.asarray(made.values, np.float64).reshape(down.given.size, points[0].given.size, -1)
    return truth, weights[1], weights[0], counted if counted.any() else ~counted, made


def _fitted(request: Order, on: Device, out: np.ndarray, told: dict[str, Any]) -> Integrated:
    """Texels that read best between the axes' ends."""
    shares = [np.concatenate([[0.0], (np.arange(n) + 0.5) / n, [1.0]])
              for n in (bilinear.SAMPLES * a.count for a in request.axes)]
    truth, down, across, counted, made = _at(request, on, shares, request.tolerance)
    if request.kind in KINDS:
        _values(request, on, request.columns, request.tolerance, told)
    out[...] = bilinear.fit(truth, down, across, counted).reshape(out.shape)
    return replace(made, values=out)


def _as_read(request: Order, on: Device, out: np.ndarray) -> dict[str, Any]:
    """Absolute errors at texel centres and of bilinear reads between them, from the table and as formats hold it."""
    texels = np.asarray(out, np.float64).reshape(request.axes[1].count, request.axes[0].count, -1)
    # Of points where no fit looked, and the ends.
    shares = [np.concatenate([[0.0], (np.arange(n) + 0.37) / n, [1.0]]) for n in (5 * a.count for a in request.axes)]
    truth, down, across, counted, _ = _at(request, on, shares, request.tolerance)
    there = np.asarray(_values(request, on, request.columns, request.tolerance).values, np.float64)
    rows = request.axes[1].values()
    at = rows >= bilinear.LEAST if request.axes[1].name == "roughness" else np.ones(rows.size, bool)
    return {"counted": f"roughness from {bilinear.LEAST}; max_all from the axis's end",
            "centres": bilinear.errors(np.abs(texels - there.reshape(texels.shape)), at if at.any() else ~at),
            "between": {name: bilinear.errors(np.abs(bilinear.read(held, down, across) - truth), counted)
                        for name, held in bilinear.formats(texels, request.dtype).items()}}


def _exr(request: Order, key: str, fill: Callable[[np.ndarray], None], made: list[Integrated],
         told: dict[str, Any], transaction: Transaction) -> None:
    """By way of a file without a name, so that a large table needs little memory."""
    channels = request.shape[2] if len(request.shape) == 3 else 1
    with scratch(request.path, request.shape, request.dtype, fill) as cells:
        texts = {f"whitefurnace:{name}": value if isinstance(value, str | float) else
                json.dumps(value, sort_keys=True, ensure_ascii=False)
                for name, value in {**_manifest(request, key, None, made[0]), **told}.items()
                if name not in ("name", "whitefurnace")}
        write_exr(request.path, cells.reshape(*request.shape[:2], channels), channel_names=CHANNELS[channels],
                  attributes={"whitefurnace:version": VERSION, **texts}, into=transaction)


def _manifest(request: Order, key: str, device: Device | None, made: Integrated) -> dict[str, Any]:
    recipe = request.canonical()
    whole = {"whitefurnace": VERSION, "name": request.path.name, "key": key, **recipe, "shape": list(request.shape),
             "dtype": request.dtype.name, "error": made.error, "rule": made.rule, "evaluations": made.evaluations,
             "notices": list(made.notices)}
    return whole if device is None else {**whole, "device": device.identity()}


# ---------------------------------------------------------------------------------------------- ownership


def _manifest_at(path: Path, request: Order) -> dict[str, Any] | None:
    found = read_manifest(path)
    return found if found is not None and found.get("name") == request.path.name else None


def _proves(manifest: Mapping[str, Any], path: Path) -> bool:
    return path.is_file() and digest_file(path) == manifest.get("sha256")


def _check_ownership(request: Order, there: dict[str, Any] | None) -> None:
    """Refuses to replace what no manifest of ours proves ours. Raises FileError."""
    path, beside = request.path, request.manifest_path
    for target in (path, beside):
        if target.is_dir():
            raise FileError(f"cannot write {target}: it is a folder")
    if request.force:
        return
    # Ours is also what a run that was killed between its renames left staged.
    known = [m for m in (there, _manifest_at(Transaction.staging(beside), request)) if m]
    for target in (path, beside):
        ours = any(_proves(m, path) for m in known) if target == path else bool(known)
        if target.exists() and not ours:
            raise FileError(f"{target} is there and was not written by this command; move it away or give --force")
