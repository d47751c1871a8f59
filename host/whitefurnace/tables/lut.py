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
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.catalogue import integral
from whitefurnace.catalogue.choice import Chosen, Spec, chosen, is_number
from whitefurnace.engines.presets import Dfg, engines
from whitefurnace.errors import FileError, UnsupportedError, UsageError, nearest
from whitefurnace.files import (
    Lock,
    Transaction,
    acquire,
    after_death,
    check_table,
    digest_file,
    finish,
    identifier,
    lock_path,
    read_manifest,
    release,
    scratch,
    stored_format,
    write_exr,
    write_manifest,
    write_npy,
    write_table,
    write_text,
)
from whitefurnace.integrals.api import integrate
from whitefurnace.integrals.quadrature import DEFAULT_TOLERANCE, Demand, demand, rows_of_roughness
from whitefurnace.integrals.radiance import ENVIRONMENT_TOLERANCE, radiance_demand
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.results import Integrated
from whitefurnace.sphere.environments import environment as load
from whitefurnace.tables import bilinear, curves, diffusion, glass, ltc
from whitefurnace.tables.energy import KINDS as OF_ENERGY
from whitefurnace.tables.energy import Kind, fresnel_demand
from whitefurnace.tables.split_sum import CHARLIE
from whitefurnace.version import VERSION

SIZE = 128
SIZES = (1, 16384)
SCALES = ("linear", "log", "centres", "sqrt", "f0", "angle")
FITS = ("bilinear",)
FITTED = (2, 512)
CHANNELS = {1: ("Y",), 2: ("R", "G"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}
FORMS = (".npy", ".exr", ".png", ".ktx2", ".dds", ".h")
KINDS = {**OF_ENERGY, "glass": Kind("glass", "ggx", glass.SCHEMES, glass.glass, fresnel="dielectric",
                                    axes={"ior": glass.IORS}, tolerance=glass.TOLERANCE, check=glass.check,
                                    digests=glass.digests)}
KINDS |= {name: Kind(name, "ggx", ltc.SCHEMES if "xx" in channels else (), partial(ltc.ltc, name), check=ltc.check,
                     digests=ltc.digests, channels=len(channels), size=ltc.SIZE, fitted=True)
          for name, channels in ltc.CHANNELS.items()}
KINDS["smith"] = Kind("smith", "ggx", curves.SCHEMES, curves.smith, check=curves.smith_check, of="projected_area",
                      axes=curves.SMITH_AXES, shape=curves.shape_of_smith)
KINDS["norm"] = Kind("norm", "abc", (), curves.norm, check=curves.norm_check, of="normalization",
                     axes_of=curves.norm_axes, shape=curves.shape_of_norm, tolerance=curves.NORM_TOLERANCE)
KINDS["diffusion"] = Kind("diffusion", "", diffusion.SCHEMES, diffusion.diffusion, of="normalization",
                          axes=diffusion.AXES, channels=3, demand=diffusion.demand)
OPTIONS = frozenset(inspect.signature(integrate).parameters) - {"parameters"}


@dataclass(frozen=True)
class Axis:
    """A dimension of a table: `count` values of a parameter from `low` to `high`.

    The scales "linear", "log" and "sqrt" have the first value at `low` and the last at `high`, "sqrt" in equal steps of
    the root of what is above `low`, "f0" of an index n in steps of ±F0^¼ = ±√(|n - 1|/(n + 1)), + above 1; "centres"
    has value k at low + (k + ½)(high - low)/count, where a texture is read.
    "angle" has equal steps of acos. `NoV` is the cosine of the view angle, `roughness` the perceptual roughness that
    every model with a roughness follows, all else a parameter of the models.
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
        if self.scale == "f0":
            return self._indices(np.linspace(0, 1, self.count))
        if self.scale == "angle":
            return self._cosines(np.linspace(0, 1, self.count))
        return np.linspace(self.low, self.high, self.count)

    def _cosines(self, share: np.ndarray) -> np.ndarray:
        """Cosines at shares of an "angle" axis, its ends exact."""
        first, last = math.acos(self.low), math.acos(self.high)
        values = np.cos(first + (last - first) * share)
        return np.where(share == 0, self.low, np.where(share == 1, self.high, values))

    def _indices(self, share: np.ndarray) -> np.ndarray:
        """Indices of refraction at shares of an "f0" axis."""
        low, high = (math.copysign(math.sqrt(abs(n - 1) / (n + 1)), n - 1) for n in (self.low, self.high))
        z = low + (high - low) * share
        indices = (1 + z * np.abs(z)) / (1 - z * np.abs(z))
        return np.where(share == 0, self.low, np.where(share == 1, self.high, indices))

    def at(self, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values and texel coordinates (0 is the first value) at shares in [0, 1] of the axis as it is read."""
        if self.scale == "log":
            values = self.low * (self.high / self.low) ** share
        elif self.scale == "f0":
            values = self._indices(share)
        elif self.scale == "angle":
            values = self._cosines(share)
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
    if scale in ("log", "f0") and not (low > 0 and high > 0):
        raise UsageError(f"axis {name}: {'a log' if scale == 'log' else 'an f0'} scale needs ends above 0, not {low:g} "
                         f"and {high:g}")
    if scale == "angle" and not (abs(low) <= 1 and abs(high) <= 1):
        raise UsageError(f"axis {name}: an angle scale is of cosines, from -1 to 1, not {low:g} and {high:g}")
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
    stored: str | None = None
    charlie: bool = False
    """Charlie's albedo as a third channel of a split-sum table."""

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
                **({"scheme": self.scheme} if self.scheme else {}), **self.around,
                **({"stored_format": self.stored} if self.stored else {}),
                **({"charlie": True} if self.charlie else {}),
                "format": self.path.suffix.lower()}

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


def order(kind: str, path: str | os.PathLike[str], *, size: int | str | Sequence[int] | None = None,
          axes: Mapping[str, Any] | None = None, ndf: Spec | None = None, masking: Spec | None = None,
          fresnel: Spec | None = None, diffuse: Spec | None = None, brdf: Spec | None = None,
          light: Spec | None = None, environment: Any = None, normal: Sequence[float] | None = None,
          rotate: float = 0.0, exposure: float = 0.0, nonfinite: str = "refuse", backfacing: str | None = None,
          precision: int = 32, tolerance: float | None = None, fit: str | None = None, as_read: bool = False,
          scheme: str | None = None, stored: str | None = None, for_: str | None = None, force: bool = False,
          parameters: Mapping[str, Any] | None = None, **fixed: Any) -> Order:
    """A validated table; see `lut`. Raises UsageError, UnsupportedError, and what a user's file raises."""
    own = KINDS.get(kind)
    preset = _preset(kind, for_, size, axes, scheme)
    if preset:
        size, scheme = preset.size, preset.form
        axes = {name: (0.0, 1.0, preset.size, preset.NoV if name == "NoV" else "centres")
                for name in (preset.x, preset.y)}
    size = size if size is not None else (own and own.size) or SIZE
    scheme = own.scheme_of(scheme) if own else scheme
    if kind == "dfg":
        scheme = _form(scheme)
    elif own is None and scheme is not None:
        raise UsageError(f"{kind} has no scheme; dfg, energy, glass, ltc and diffusion have")
    entry = integral(own.integral(scheme) if own else kind)
    path = Path(path)
    form = path.suffix.lower()
    if form not in FORMS:
        raise UsageError(f"{path}: a table is written as {', '.join(FORMS[:-1])} or {FORMS[-1]}, not "
                         f"{path.suffix or 'without a suffix'}")
    if precision not in DEFAULT_TOLERANCE:
        raise UsageError(f"precision {precision} is not one of {', '.join(map(str, DEFAULT_TOLERANCE))}")
    if form not in (".npy", ".h") and precision == 64:
        raise UsageError(f"{form[1:].upper()} holds float32 at most: give .npy or .h for precision 64")
    usual = DEFAULT_TOLERANCE if environment is None else ENVIRONMENT_TOLERANCE
    if own and own.tolerance and (precision == 32 or own.shape):
        usual = {**usual, precision: own.tolerance}
    if own and own.shape and form not in (".npy", ".h"):
        raise UsageError(f"{kind} is written as coefficients, to .h or .npy, not {form}")
    tolerance = usual[precision] if tolerance is None else tolerance
    if not is_number(tolerance) or not 0 < tolerance < 1:  # also NaN
        raise UsageError(f"tolerance {tolerance!r} is outside (0, 1)")
    bare = own.demand if own else None
    if bare and (ndf, masking, fresnel, diffuse, brdf) != (None,) * 5:
        raise UnsupportedError(f"{kind} is of a medium alone: give no ndf, masking, fresnel, diffuse or brdf")
    lone = own is not None and own.slot == "fresnel"
    if lone and not (ndf is None and masking is None and diffuse is None and brdf is None):
        raise UnsupportedError(f"{kind} is of Fresnel's term alone: give a fresnel, and no ndf, masking, diffuse or "
                               "brdf")
    if own and not lone and not (fresnel is None and diffuse is None and brdf is None):
        raise UnsupportedError(f"{kind} is of an NDF and its masking; Fresnel's term is {own.fresnel or '1'}, and "
                               "nothing else is added")
    if ndf is None and diffuse is None and brdf is None and not lone:
        ndf = own.model if own else "ggx"
    if ndf is None and not lone and (masking is not None or fresnel is not None):
        raise UsageError(f"{'masking' if masking is not None else 'fresnel'} is of an NDF, and none is given")
    given = {"ndf": ndf, "masking": masking or "smith", "fresnel": fresnel or (own and own.fresnel) or "one",
             "diffuse": diffuse, "brdf": brdf}
    if lone:
        given = {"fresnel": fresnel or own.model}  # type: ignore[union-attr]
    given = {} if bare else given
    # Chosen once: a user's file is read once, and what was read is what the key is of.
    models = {slot: chosen(slot, spec) for slot, spec in given.items() if spec is not None}
    numbers = {name: _number(name, value) for name, value in {**(parameters or {}), **fixed}.items()}
    if lone and not axes:
        axes = _usual(models["fresnel"], numbers, _sizes(size)[0])
    own_axes = {} if own is None else own.axes_of(models) if own.axes_of else own.axes
    if "roughness" in own_axes and not any(_following(c, {*numbers, *(axes or {})}) for c in models.values()):
        own_axes = {name: one for name, one in own_axes.items() if name != "roughness"}
    axes = {**{name: own_axes[name] for name in own_axes if not {name, f"fresnel_{name}"} & {*numbers, *(axes or {})}},
            **(axes or {})}
    if bare:  # in the order of the usual ones, which are of the table's size
        counts = dict(zip(own_axes, _sizes(size), strict=False))
        axes = {name: (*axes[name][:2], counts[name], axes[name][3]) if axes[name] is own_axes.get(name) else axes[name]
                for name in (*own_axes, *axes) if name in axes}
    scaled = {name: given for name, given in axes.items() if given in SCALES}  # a default axis, scaled
    explicit = {name: axis(name, given) for name, given in axes.items() if name not in scaled}
    for name in (*numbers, *explicit, *scaled):
        if name in OPTIONS:
            raise UsageError(f"{name} is an option and no parameter; a model's own of that name is SLOT_{name}")
    sizes = (*_sizes(size)[:2], _sizes(size)[2] and not bare)
    placed = _placed(entry.view, models, sizes, explicit, numbers, scaled, own is not None and own.fitted)
    if preset:
        placed = tuple(sorted(placed, key=lambda one: (preset.x, preset.y).index(one.name)))
    if form == ".exr" and len(placed) > 2:
        raise UsageError(f"EXR holds two axes, not {len(placed)}: give .npy")
    if not placed:
        raise UsageError("a table has an axis at least, and every parameter is given as a number")
    if fit is not None and fit not in FITS:
        raise UsageError(f"unknown fit {fit!r}{nearest(str(fit), FITS)}")
    as_read = as_read or fit is not None
    if as_read and own and (own.fitted or own.shape):
        raise UsageError(f"{kind} is a fit by itself, and states what is misplaced between texels: leave out --fit and "
                         "--as-read")
    if as_read and not (len(placed) == 2 and all(FITTED[0] <= a.count <= FITTED[1] for a in placed)):
        raise UsageError(f"what is read between texels is told of tables with two axes of {FITTED[0]} to {FITTED[1]}")
    columns = _columns(placed, models, numbers)
    lit, around = _lit(kind, light, environment, normal, rotate, exposure, nonfinite)
    what: dict[str, Any] = {**models, **columns, "backfacing": backfacing}
    asked = (bare(scheme, columns) if bare else fresnel_demand(models, columns) if lone else
             radiance_demand(light=lit.get("light"), **what) if lit else demand(entry.name, **what))
    if own and not lone:
        asked = replace(asked, shape=(*asked.shape[:len(np.broadcast_shapes(*map(np.shape, columns.values())))],
                                      own.channels))
    charlie = preset is not None and preset.charlie
    if charlie:
        cloth: dict[str, Any] = {**_charlie(models), **_columns(placed, _charlie(models), numbers)}
        asked = replace(asked, shape=(*asked.shape[:-1], 3),
                        digests=(*asked.digests, *demand("albedo", **cloth).digests))
    if own and own.check:
        own.check(models)
    if own and own.shape:
        asked = replace(asked, shape=own.shape(scheme, placed))
    if own and own.digests:
        asked = replace(asked, digests=(*asked.digests, *own.digests(models)))
    if form == ".exr" and asked.shape[2:] and asked.shape[2] not in CHANNELS:
        raise UsageError(f"EXR holds 1 to 4 channels, not {asked.shape[2]}: give .npy" +
                         (", or write ltc_1 and ltc_2" if kind == "ltc" else ""))
    rows, channels = asked.shape[:max(len(placed), 2)], math.prod(asked.shape[max(len(placed), 2):])
    if form not in (".npy", ".exr") and not (own and own.shape):
        check_table(form, rows, channels)
    held = stored_format(form, channels, stored)
    return Order(kind, path, models, placed, numbers, backfacing, precision, float(tolerance), fit, as_read, scheme,
                 force, columns, asked, lit, around, held, charlie)


FORMS_OF_DFG = ("scale_bias", "multiscatter")
"""E = F0·A + B as (A, B), and as (∫Fc, ∫1) = (B, A + B) for mix(∫Fc, ∫1, F0): Schlick's F90 is 1."""


def _form(scheme: str | None) -> str:
    if scheme is not None and scheme not in FORMS_OF_DFG:
        raise UsageError(f"unknown scheme {scheme!r}{nearest(scheme, FORMS_OF_DFG)}")
    return scheme or FORMS_OF_DFG[0]


def _preset(kind: str, for_: str | None, size: Any, axes: Any, scheme: Any) -> Dfg | None:
    """The split-sum table of the engine that `--for` names. Raises UsageError."""
    if for_ is None:
        return None
    if kind != "dfg":
        raise UsageError(f"{kind} is no table of engines; dfg is")
    found = engines(for_)
    if len(found) > 1:
        raise UsageError(f"{for_}: a table is for one engine")
    for what, value in (("size", size), ("axis", axes), ("scheme", scheme)):
        if value:
            raise UsageError(f"--for {found[0].name} says the {what}: leave it out")
    return found[0].dfg


def _charlie(models: Mapping[str, Chosen]) -> dict[str, Chosen]:
    """Charlie's lobe with the table's masking."""
    return {"ndf": chosen("ndf", "charlie"), "masking": models["masking"]}


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


def named(option: str, given: Sequence[str]) -> dict[str, str]:
    """NAME=VALUE of an option `axis` or `set` by name, however it is spelled. Raises UsageError."""
    found: dict[str, str] = {}
    for item in given:
        name, equals, value = item.partition("=")
        if not (name.isidentifier() and equals and value) or name in found:
            form = "NAME=A:B:N[:SCALE]" if option.endswith("axis") else "NAME=VALUE"
            raise UsageError(f"{option} {item!r}: {name or 'a name'} must be given once, as {form}")
        found[name] = value
    return found


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
            fixed: Mapping[str, float], scaled: Mapping[str, str] | None = None,
            fitted: bool = False) -> tuple[Axis, ...]:
    """The axes in their order, x first: NoV where there is a view, roughness where some model's follows it and is not
    given, each unless it is fixed and as given where it is; then the others. Of a fit by itself roughness is x, from 0
    to 1, and NoV = 1 - y²."""
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
    if fitted:
        usual = {"roughness": Axis("roughness", 0.0, 1.0, across), "NoV": Axis("NoV", 1.0, 0.0, down, "sqrt")}
        defaults = {name: one for name, one in usual.items() if name in defaults}
    for name, scale in (scaled or {}).items():
        if name not in defaults:
            raise UsageError(f"axis {name}: there is no default axis of that name to scale; give A:B:N:{scale}")
        if scale in ("log", "f0"):
            raise UsageError(f"axis {name}: {'a log' if scale == 'log' else 'an f0'} scale needs ends above 0; give "
                             f"A:B:N:{scale}")
        defaults[name] = replace(defaults[name], scale=scale)
    if both:
        for name, count in (("NoV", down if fitted else across), ("roughness", across if fitted else down)):
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
    """Writes a table of any integral to `path`, and beside it `path.json`, last, which proves it whole.

    kind is an integral's name ("dfg" by `scheme` "scale_bias" or "multiscatter", or `for_` an engine, which says size,
    axes and form), "energy" (what multiple scattering gives back, `scheme` "kulla_conty", "turquin" or
    "fdez_aguera"), "sheen", "fresnel_average" or "ltc" (linearly transformed cosines, `scheme` "free" or "heitz",
    as one array or as the textures "ltc_1" and "ltc_2"), "glass" (what a rough boundary reflects and lets through,
    `scheme` "entering" or "leaving"), "smith" or "norm" (coefficients of simpler curves, to .h or .npy), or "diffusion"
    (diffuse light on a body of some curvature under whose surface light travels, `scheme` "skin", "burley", "dipole" or
    a measured medium). `path` ends with .npy, .exr, .png, .ktx2, .dds or .h.

    options: size (N, (N, M) or "NxM"; 128, 64 for ltc), axes ({name: (A, B, N[, "linear" | "log" | "centres" | "sqrt" |
    "f0" | "angle"])}, or a scale alone for a default axis), stored (the format of texels, as "rg16f" or "r8"), fit
    ("bilinear": texels that read best, of two axes), as_read (state errors between texels; a fit does), ndf (`ggx`
    unless there is a diffuse or brdf), masking, fresnel, diffuse, brdf, backfacing, precision, tolerance, force, for
    radiance light or environment, normal, rotate, exposure, nonfinite, and parameters, as one number each, by name or
    as a mapping.

    The array is […, y, x(, c)] of float32 or float64. x is NoV = (x + ½)/N for integrals with a view, y perceptual
    roughness r = (y + ½)/M, row 0 smoothest, which the models' own parameters follow; without a view r alone is x; of
    ltc x is r from 0 to 1 and NoV = 1 - y²; of diffusion x is NoL from -1 to 1 and y the curvature in 1/mm from 0 to 1,
    both at centres. A parameter that is given stays put; an axis of the same name replaces a
    default one, others come after it, slower, in their order. More than two want .npy, .h, .ktx2 or .dds. What exists
    with the same key is skipped, what the manifest proves ours replaced, and anything else needs `force`. Raises
    UsageError, UnsupportedError, FileError, CheckError, DeviceError.
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
    there = _manifest_at(request.manifest_path, request.path.name)
    plain = Table(request.path, "planned", request.shape, request.axes, request.nbytes,
                  {"key": key, "recipe": request.canonical()})
    if not request.force and there and there.get("key") == key and _proves(there, request.path):
        if not dry_run:
            tidy(request.manifest_path)
        return replace(plain, state="skipped", manifest=there, seconds=time.perf_counter() - begin)
    _check_ownership(request, there)
    if dry_run:
        return plain
    lock = acquire(lock_path(request.manifest_path))
    assert lock is not None
    try:
        there = _settle(request.manifest_path, lock)
        if not request.force and there and there.get("key") == key and _proves(there, request.path):
            return replace(plain, state="skipped", manifest=there, seconds=time.perf_counter() - begin)
        _check_ownership(request, there)
        lock.note([request.path, request.manifest_path])
        return _made(request, device, key, plain, begin, progress)
    finally:
        lock.release()


def _made(request: Order, device: Device | str | None, key: str, plain: Table, begin: float,
          progress: Progress | None) -> Table:
    """Makes and writes the table."""
    hosted = request.kind in KINDS and KINDS[request.kind].demand is not None
    on: Any = device if isinstance(device, Device) else None if hosted else choose_device(device)
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
            result = _values(request, on, request.axes, request.tolerance, told, out, tell)
        if request.as_read:
            told["as_read"] = _as_read(request, on, out)
        made.append(replace(result, values=np.empty(0)))  # the file has them; what is held would keep it mapped

    with Transaction() as transaction:
        if request.path.suffix.lower() == ".npy":
            write_npy(request.path, request.shape, request.dtype, fill, into=transaction)
        elif request.kind in KINDS and KINDS[request.kind].shape:
            fill(np.empty(request.shape, request.dtype))
            write_text(request.path, curves.header(identifier(request.path.stem), told["text"], VERSION),
                       into=transaction)
        elif request.path.suffix.lower() != ".exr":
            _texture(request, key, fill, made, told, transaction)
        else:
            _exr(request, key, fill, made, told, transaction)
        told.pop("text", None)  # of a header
        staged = transaction.staged(request.path)
        manifest = {**_manifest(request, key, None if hosted else on, made[0]), **told}
        manifest |= {"sha256": digest_file(staged), "bytes": staged.stat().st_size}
        write_manifest(request.manifest_path, manifest, into=transaction)
        transaction.commit()
    return replace(plain, state="done", manifest=manifest, notices=made[0].notices,
                   seconds=time.perf_counter() - begin)


def _values(request: Order, on: Device, points: Sequence[Axis | Points], tolerance: float,
            told: dict[str, Any] | None = None, out: np.ndarray | None = None,
            progress: Callable[[float], None] | None = None) -> Integrated:
    """The table's values at points of its axes, […, c]; `told` is what is to be said of them."""
    columns = request.columns if points is request.axes else _columns(points, request.models, request.fixed)
    what: dict[str, Any] = {**request.models, **columns, "backfacing": request.backfacing, "device": on,
                            "precision": request.precision, "tolerance": tolerance, "out": out}
    if request.kind in KINDS:
        if KINDS[request.kind].shape:
            what |= {"axes": request.axes, "columns_of": lambda points: _columns(
                [Points(name, values) for name, values in points], request.models, request.fixed)}
        if KINDS[request.kind].fitted:
            what["middle"] = _middle(request)
        result, facts = KINDS[request.kind].make(request.scheme, told is not None, **what)
        if told is not None:
            told |= facts
        return result
    if request.kind == "dfg":
        return _split_sum(request, points, told, progress, what)
    return integrate(request.kind, progress=progress, **request.lit, **what)


def _split_sum(request: Order, points: Sequence[Axis | Points], told: dict[str, Any] | None,
               progress: Callable[[float], None] | None, what: dict[str, Any]) -> Integrated:
    """(…, 2 or 3): the pairs in the form asked for, with Charlie's albedo where an engine has it."""
    out = what["out"]
    made = integrate("dfg", progress=progress, **{**what, "out": None if request.charlie else out})
    facts: dict[str, Any] = {"channels": ["scale", "bias"], "formula": "E(v; F0) = F0 scale + bias"}
    if request.scheme == "multiscatter":
        made.values[..., 0] += made.values[..., 1]
        made.values[...] = made.values[..., ::-1].copy()
        made = replace(made, error=2 * made.error)
        facts = {"channels": ["∫Fc", "∫1"], "formula": "E(v; F0) = mix(∫Fc, ∫1, F0)"}
    if request.charlie:
        models = _charlie(request.models)
        cloth = integrate("albedo", **{**what, **models, **_columns(points, models, request.fixed), "out": None,
                                       "tolerance": max(request.tolerance, CHARLIE)})
        values = np.concatenate([made.values, np.broadcast_to(cloth.values, made.values.shape[:-1])[..., None]], -1)
        if out is not None:
            out[...] = values
        made = replace(made, values=values if out is None else out, evaluations=made.evaluations + cloth.evaluations,
                       notices=(*made.notices, *cloth.notices))
        facts |= {"channels": [*facts["channels"], "charlie"], "charlie_error": float(cloth.error)}
    if told is not None:
        told |= facts
    return made


def _middle(request: Order) -> dict[str, np.ndarray] | None:
    """The columns where a read lies in the middle of four texels; None where the axes are not two with two texels."""
    if len(request.axes) != 2 or min(a.count for a in request.axes) < 2:
        return None
    points = []
    for one in request.axes:
        k = np.arange(one.count - 1)
        points.append(Points(one.name, one.at((k + 1) / one.count if one.scale == "centres" else
                                              (k + 0.5) / (one.count - 1))[0]))
    return _columns(points, request.models, request.fixed)


def _at(request: Order, on: Device, shares: Sequence[np.ndarray], tolerance: float) -> tuple[Any, ...]:
    """Values at shares of x and y, (ny, nx, c) float64, the weights of reads there along y and x, the rows that count,
    and what was integrated."""
    points, weights = [], []
    for one, share in zip(request.axes, shares, strict=True):
        values, x = one.at(share)
        points.append(Points(one.name, values))
        weights.append(bilinear.hats(one.count, x))
    made = _values(request, on, points, tolerance)
    down = points[1]
    counted = down.given >= bilinear.LEAST if down.name == "roughness" else np.ones(down.given.size, bool)
    truth = np.asarray(made.values, np.float64).reshape(down.given.size, points[0].given.size, -1)
    return truth, weights[1], weights[0], counted if counted.any() else ~counted, made


def _fitted(request: Order, on: Device, out: np.ndarray, told: dict[str, Any]) -> Integrated:
    """Texels that read best between the axes' ends."""
    shares = [np.concatenate([[0.0], (np.arange(n) + 0.5) / n, [1.0]])
              for n in (bilinear.SAMPLES * a.count for a in request.axes)]
    truth, down, across, counted, made = _at(request, on, shares, request.tolerance)
    if request.kind in KINDS or request.kind == "dfg":
        _values(request, on, request.axes, request.tolerance, told)
    out[...] = bilinear.fit(truth, down, across, counted).reshape(out.shape)
    return replace(made, values=out)


def _as_read(request: Order, on: Device, out: np.ndarray) -> dict[str, Any]:
    """Absolute errors at texel centres and of bilinear reads between them, from the table and as formats hold it."""
    texels = np.asarray(out, np.float64).reshape(request.axes[1].count, request.axes[0].count, -1)
    # Of points where no fit looked, and the ends.
    shares = [np.concatenate([[0.0], (np.arange(n) + 0.37) / n, [1.0]]) for n in (5 * a.count for a in request.axes)]
    truth, down, across, counted, _ = _at(request, on, shares, request.tolerance)
    there = np.asarray(_values(request, on, request.axes, request.tolerance).values, np.float64)
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


def _texture(request: Order, key: str, fill: Callable[[np.ndarray], None], made: list[Integrated],
             told: dict[str, Any], transaction: Transaction) -> None:
    """PNG, KTX 2, DDS and C, and what storing costs beside the table's error."""
    cells = np.empty(request.shape, request.dtype)
    fill(cells)
    whole = {**_manifest(request, key, None, made[0]), **told}
    texts = {f"whitefurnace:{name}": value if isinstance(value, str) else json.dumps(value, sort_keys=True)
             for name, value in whole.items() if name not in ("name", "whitefurnace")}
    dimensions = max(len(request.axes), 2)
    order_ = ", ".join(["wvuzyx"[-dimensions:][k] for k in range(dimensions)])
    of = ", ".join(f"{slot} {c.model.name}" for slot, c in request.models.items()) or request.scheme
    comment = [f"{request.kind} of {of}" +
               f", as [{order_}{', channel' if len(request.shape) > dimensions else ''}]; whitefurnace {VERSION}",
               *(f"{name}: {along}" for name, along in zip("xyzuvw", request.axes, strict=False)),
               *(f"{name} = {value:g}" for name, value in request.fixed.items()),
               *([f"channels: {', '.join(told['channels'])}"] if "channels" in told else []),
               *([told["formula"]] if "formula" in told else []),
               f"error of a value: {made[0].error:.2g}"]
    stored = write_table(request.path, cells.reshape(*request.shape[:dimensions], -1), request.stored,
                         slack=made[0].error, texts=texts, comment=comment, into=transaction)
    told["stored"] = {"format": stored.format, "error": stored.error}


def _manifest(request: Order, key: str, device: Device | None, made: Integrated) -> dict[str, Any]:
    recipe = request.canonical()
    whole = {"whitefurnace": VERSION, "name": request.path.name, "key": key, **recipe, "shape": list(request.shape),
             "dtype": request.dtype.name, "error": made.error, "rule": made.rule, "evaluations": made.evaluations,
             "notices": list(made.notices)}
    return whole if device is None else {**whole, "device": device.identity()}


# ---------------------------------------------------------------------------------------------- ownership


def _manifest_at(path: Path, name: str) -> dict[str, Any] | None:
    found = read_manifest(path)
    return found if found is not None and found.get("name") == name else None


def tidy(path: Path) -> None:
    """Completes or removes what a run that was killed left of the table with the manifest at `path`, unless another run
    is at it. Raises FileError."""
    after_death(path, _settle)


def _settle(path: Path, lock: Lock) -> dict[str, Any] | None:
    """Completes what a run that was killed between its renames left staged, removes what it left otherwise, and gives
    the manifest that is there then."""
    name, staging = path.name.removesuffix(".json"), Transaction.staging(path)
    there, staged = _manifest_at(path, name), _manifest_at(staging, name)
    if staged and (there or not os.path.lexists(path)):
        renames = finish(path, {name: staged.get("sha256")}, {name: {m.get("sha256") for m in (there, staged) if m}})
        if renames is not None:
            for source, target in renames:
                os.replace(source, target)
            there, staged = staged, None
    # What could not be completed still proves whose the renamed file is.
    lock.sweep(keep=[staging] if staged else ())
    return there


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
    known = [m for m in (there, _manifest_at(Transaction.staging(beside), request.path.name)) if m]
    for target in (path, beside):
        ours = any(_proves(m, path) for m in known) if target == path else bool(known)
        if target.exists() and not ours:
            raise FileError(f"{target} is there and was not written by this command; move it away or give --force")
