"""Checks and completes the request for a table, without a device: it decides what will be computed and written."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.catalogue import integral
from whitefurnace.catalogue.choice import chosen
from whitefurnace.errors import UsageError, nearest
from whitefurnace.files import check_table, stored_format
from whitefurnace.integrals.api import integrate
from whitefurnace.integrals.quadrature import DEFAULT_TOLERANCE, TableSpec, tolerances
from whitefurnace.tables.axes import SIZES, Axis, Size, number, placed, size_of
from whitefurnace.tables.cells import Cells
from whitefurnace.tables.kind import Kind
from whitefurnace.tables.kinds import kind as kind_of
from whitefurnace.tables.kinds import kinds, scheme_of
from whitefurnace.tables.request import TableRequest
from whitefurnace.version import VERSION

FORMS = (".npy", ".exr", ".png", ".ktx2", ".dds", ".h")
"""Suffixes of the files that a table is written to."""

FITS = ("bilinear",)

FITTED = (2, 512)
"""Smallest and largest number of texels along an axis for which reads between them are measured."""

CHANNELS = {1: ("Y",), 2: ("R", "G"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}
"""Names of the channels in EXR, by their number."""

OPTIONS = frozenset(inspect.signature(integrate).parameters) - {"parameters"}
"""Names that are options of `integrate` and cannot be parameters."""


@dataclass(frozen=True)
class TablePlan:
    """A table that can be made: a request that was checked.

    fit      "bilinear" if texels are fitted for reads between them
    as_read  True if the error of such reads is measured
    stored   pixel format of a texture, or None
    """

    kind: Kind
    path: Path
    cells: Cells
    spec: TableSpec
    precision: int
    tolerance: float
    relative: float | None
    fit: str | None
    as_read: bool
    stored: str | None
    force: bool

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes; the first, x, varies fastest."""
        return self.cells.axes

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array, […, y, x(, channel)]."""
        return self.spec.shape

    @property
    def form(self) -> str:
        """Suffix of the file, in lower case."""
        return self.path.suffix.lower()

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the array's values: float32 or float64."""
        return np.dtype(f"f{self.precision // 8}")

    @property
    def nbytes(self) -> int:
        """Bytes of the array before compression."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def manifest_path(self) -> Path:
        """Path of the manifest: that of the file with .json appended."""
        return self.path.with_name(self.path.name + ".json")

    def canonical(self) -> dict[str, Any]:
        """Return the recipe as data: everything that changes the bytes, and nothing else."""
        cells = self.cells
        return {
            "integral": self.kind.name,
            "models": {slot: c.canonical() for slot, c in self.spec.slots.items()},
            "parameters": dict(cells.fixed),
            "axes": [a.canonical() for a in self.axes],
            "backfacing": cells.backfacing,
            "precision": self.precision,
            "tolerance": self.tolerance,
            **({"relative_tolerance": self.relative} if self.relative is not None else {}),
            **({"fit": self.fit} if self.fit else {}),
            **({"as_read_stated": True} if self.as_read else {}),
            **({"scheme": cells.scheme} if cells.scheme else {}),
            **cells.lighting.recipe,
            **({"stored_format": self.stored} if self.stored else {}),
            **self.kind.recipe(),
            "format": self.form,
        }

    def key(self) -> str:
        """Return the sha256 of the recipe, the kernels and the version."""
        parts = [VERSION, json.dumps(self.canonical(), sort_keys=True), *self.spec.digests]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def plan(request: TableRequest) -> TablePlan:
    """Check a request and complete it. Raises UsageError, UnsupportedError, and the errors of reading a user's file."""
    kind, request = kind_of(request.kind).settled(request)
    scheme = scheme_of(kind, request.scheme)
    path = Path(request.path)
    _check_file(kind, path, request.precision)
    tolerance, relative = _tolerances(kind, request)
    # Chosen once: a user's file is read once, so the key is that of the text that is used.
    models = {slot: chosen(slot, spec) for slot, spec in kind.specs(request).items()}
    fixed = {name: number(name, value) for name, value in (request.parameters or {}).items()}
    size = size_of(kind.size if request.size is None else request.size)
    given = kind.with_usual_axes(request.axes or {}, models, fixed, size)
    for name in (*fixed, *given):
        if name in OPTIONS:
            raise UsageError(f"{name} is an option and no parameter; a model's own of that name is SLOT_{name}")
    view = integral(kind.integral(scheme)).view
    axes = kind.arranged(placed(kind.default_axes(size), size, view, models, given, fixed))
    if request.backfacing is not None and not view:
        raise UsageError(f"{kind.name} has no view direction: leave out backfacing")
    as_read = _check_axes(kind, path, axes, request)
    cells = Cells(models, axes, fixed, scheme, request.backfacing, kind.lighting(request))
    spec = kind.spec(cells)
    stored = _check_shape(kind, path, axes, spec.shape, request.stored)
    if request.size is not None and request.for_ is None:
        other = Size(size.across % SIZES[1] + 1, size.down % SIZES[1] + 1, size.both)
        wanted = kind.with_usual_axes(request.axes or {}, models, fixed, other)
        if axes == kind.arranged(placed(kind.default_axes(other), other, view, models, wanted, fixed)):
            raise UsageError(f"size {request.size} changes nothing: every axis of this table has a count of its own")
    return TablePlan(
        kind, path, cells, spec, request.precision, tolerance, relative, request.fit, as_read, stored, request.force
    )


def _check_file(kind: Kind, path: Path, precision: int) -> None:
    """Refuse a file that cannot hold such a table. Raises UsageError."""
    form = path.suffix.lower()
    if form not in FORMS:
        raise UsageError(
            f"{path}: a table is written as {', '.join(FORMS[:-1])} or {FORMS[-1]}, not "
            f"{path.suffix or 'without a suffix'}"
        )
    if precision not in DEFAULT_TOLERANCE:
        raise UsageError(f"precision {precision} is not one of {', '.join(map(str, DEFAULT_TOLERANCE))}")
    if form not in (".npy", ".h") and precision == 64:
        raise UsageError(f"{form[1:].upper()} holds float32 at most: give .npy or .h for precision 64")
    if kind.coefficients and form not in (".npy", ".h"):
        raise UsageError(f"{kind.name} is written as coefficients, to .h or .npy, not {form}")


def _tolerances(kind: Kind, request: TableRequest) -> tuple[float, float | None]:
    """The absolute tolerance asked for, or the usual one, and the relative one. Raises UsageError."""
    if request.relative_tolerance is not None and not kind.relative:
        having = [other.name for other in kinds().values() if other.relative]
        raise UsageError(f"{kind.name} has no relative tolerance; {', '.join(having[:-1])} and {having[-1]} have")
    usual = kind.usual_tolerance(request)
    usual = DEFAULT_TOLERANCE[request.precision] if usual is None else usual
    absolute, relative = tolerances(request.tolerance, request.relative_tolerance, usual)
    return absolute, relative or None


def _check_axes(kind: Kind, path: Path, axes: tuple[Axis, ...], request: TableRequest) -> bool:
    """Return whether reads between texels are to be measured. Raises UsageError for axes that cannot be read so."""
    if path.suffix.lower() == ".exr" and len(axes) > 2:
        raise UsageError(f"EXR holds two axes, not {len(axes)}: give .npy")
    if not axes:
        raise UsageError("a table has an axis at least, and every parameter is given as a number")
    if request.fit is not None and request.fit not in FITS:
        raise UsageError(f"unknown fit {request.fit!r}{nearest(str(request.fit), FITS)}")
    as_read = request.as_read or request.fit is not None
    if as_read and not kind.refittable:
        raise UsageError(
            f"{kind.name} is fitted already, and states its error between texels: leave out --fit and --as-read"
        )
    if as_read and not (len(axes) == 2 and all(FITTED[0] <= a.count <= FITTED[1] for a in axes)):
        raise UsageError(
            f"the error of reads between texels is measured only for tables with two axes of {FITTED[0]} to "
            f"{FITTED[1]} texels"
        )
    return as_read


def _check_shape(
    kind: Kind, path: Path, axes: tuple[Axis, ...], shape: tuple[int, ...], stored: str | None
) -> str | None:
    """The pixel format of a texture, None for other files. Raises UsageError for an array that the file cannot hold."""
    form = path.suffix.lower()
    if form == ".exr" and shape[2:] and shape[2] not in CHANNELS:
        raise UsageError(f"EXR holds 1 to 4 channels, not {shape[2]}: give .npy{kind.if_too_many_channels}")
    rows, channels = shape[: max(len(axes), 2)], math.prod(shape[max(len(axes), 2) :])
    if form not in (".npy", ".exr") and not kind.coefficients:
        check_table(form, rows, channels)
    return stored_format(form, channels, stored)


__all__ = ["CHANNELS", "FORMS", "TablePlan", "TableRequest", "plan"]
