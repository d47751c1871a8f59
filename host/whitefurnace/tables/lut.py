"""Writes tables as files: an array over a grid of parameters, with a manifest next to it that proves it complete."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from whitefurnace.catalogue.choice import Spec
from whitefurnace.files import (
    FileOutput,
    Transaction,
    digest_file,
    identifier,
    release,
    scratch,
    system_errors,
    write_exr,
    write_manifest,
    write_npy,
    write_table,
    write_text,
)
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.results import Integrated
from whitefurnace.tables import bilinear
from whitefurnace.tables.axes import Axis, AxisSpec, Points
from whitefurnace.tables.cells import Run
from whitefurnace.tables.kind import Facts, Kind
from whitefurnace.tables.planning import CHANNELS, FORMS, TablePlan, TableRequest, plan
from whitefurnace.version import VERSION

if TYPE_CHECKING:
    from whitefurnace.sphere.environments import Environment

Progress = Callable[[str, str, float], None]
"""Called with the name of the file, "cells", and the share done."""


@dataclass(frozen=True)
class Table:
    """The result of `lut`, or its prediction in a dry run.

    state     "done", "skipped" or "planned"
    manifest  the manifest's content; of a planned table only its key and its recipe
    nbytes    bytes of the array before compression
    """

    kind: Kind
    path: Path
    state: Literal["done", "skipped", "planned"]
    shape: tuple[int, ...]
    axes: tuple[Axis, ...]
    nbytes: int
    manifest: dict[str, Any]
    notices: tuple[str, ...] = ()
    seconds: float = 0.0

    @property
    def recipe(self) -> dict[str, Any]:
        """The part of the manifest that describes the request."""
        found: dict[str, Any] = self.manifest.get("recipe", self.manifest)
        return found

    @property
    def subject(self) -> str:
        """The subject of the table: its models, or the scheme of a table that has none."""
        return self.kind.subject([c["name"] for c in self.recipe["models"].values()], self.recipe.get("scheme"))


def lut(
    kind: str,
    path: str | os.PathLike[str],
    *,
    size: int | str | Sequence[int] | None = None,
    axes: Mapping[str, AxisSpec] | None = None,
    ndf: Spec | None = None,
    masking: Spec | None = None,
    fresnel: Spec | None = None,
    diffuse: Spec | None = None,
    brdf: Spec | None = None,
    light: Spec | None = None,
    environment: str | os.PathLike[str] | np.ndarray | Environment | None = None,
    normal: Sequence[float] | None = None,
    rotate: float = 0.0,
    exposure: float = 0.0,
    bad_pixels: str = "refuse",
    layout: str | None = None,
    layer: str | None = None,
    fill: str | None = None,
    nonfinite: str | None = None,
    backfacing: str | None = None,
    precision: int = 32,
    tolerance: float | None = None,
    relative_tolerance: float | None = None,
    fit: str | None = None,
    as_read: bool = False,
    scheme: str | None = None,
    stored: str | None = None,
    for_: str | None = None,
    force: bool = False,
    parameters: Mapping[str, float | str] | None = None,
    device: Device | str | None = None,
    dry_run: bool = False,
    progress: Progress | None = None,
    **fixed: float,
) -> Table:
    """Write a table of an integral of a BRDF to `path`, and its manifest to `path` with .json appended.

    kind: the kind of table, a name that `whitefurnace lut --help` lists: an integral ("dfg", "albedo", …) or a table
        made from some ("energy", "ltc", "glass", …).
    path: ends with .npy, .exr, .png, .ktx2, .dds or .h.
    size: number of cells along the default axes, N, (N, M) or "NxM", each 1 to 16384; 128 unless the kind has its own.
    axes: by name, (A, B, N) or (A, B, N, SCALE), SCALE being "linear", "log", "centres", "sqrt", "f0" or "angle"; or a
        SCALE alone for a default axis. One with the name of a default axis replaces it; others come after, slower.
    ndf, masking, fresnel, diffuse, brdf: models as `integrate` takes them; ggx and smith unless there is a diffuse or
        brdf.
    light, environment, normal, rotate, exposure, bad_pixels, layout, layer, fill, nonfinite: the light of "radiance",
        as `integrate` takes it.
    backfacing: "clamp" or "absolute" accepts NoV < 0.
    precision: 32 or 64 bits. tolerance: absolute; 1e-6, or 1e-12 with 64 bits, unless the kind has its own.
    relative_tolerance: largest error as a share of each value, instead of the absolute one, or together with it as in
        `integrate`; for tables of integrals themselves.
    fit: "bilinear" fits the texels so that reads between them are most accurate. as_read: measure the error of such
        reads; a fit does.
    scheme: form of the table, where its kind has several. stored: pixel format, such as "rg16f" or "r8".
    for_: an engine, which decides size, axes and scheme of "dfg", and size, axes and masking of "sheen".
    force: overwrite files that this tool did not write.
    parameters, fixed: parameters that stay at one number, as a mapping or by name.
    device: an OpenCL device or a part of its name. dry_run: check everything and write nothing. progress: called with
        the file's name, "cells" and the share done.

    The array is […, y, x] or […, y, x, channel] of float32 or float64. By default x is NoV = (x + ½)/N where the
    integral has a view, and y the perceptual roughness r = (y + ½)/M, smoothest in row 0; the models' own parameters
    follow it. Without a view x is r. Kinds that have other axes say so in their help. A file that exists with the same
    key is skipped, and a file that the manifest proves to be ours is replaced.

    Raises UsageError, UnsupportedError, FileError, CheckError, DeviceError, and InputError for a bad environment.
    """
    models: dict[str, Any] = {"ndf": ndf, "masking": masking, "fresnel": fresnel, "diffuse": diffuse, "brdf": brdf}
    lit: dict[str, Any] = {"light": light, "environment": environment, "normal": normal}
    reading: dict[str, Any] = {"rotate": rotate, "exposure": exposure, "bad_pixels": bad_pixels, "nonfinite": nonfinite}
    image: dict[str, Any] = {"layout": layout, "layer": layer, "fill": fill}
    accuracy: dict[str, Any] = {"precision": precision, "tolerance": tolerance, "fit": fit, "as_read": as_read}
    accuracy |= {"relative_tolerance": relative_tolerance, "backfacing": backfacing}
    form: dict[str, Any] = {"size": size, "axes": axes, "scheme": scheme, "stored": stored, "for_": for_}
    numbers = {**(parameters or {}), **fixed}
    lighting = {**lit, **reading, **image}
    request = TableRequest(kind, path, **models, **lighting, **accuracy, **form, force=force, parameters=numbers)
    return make(plan(request), device, dry_run=dry_run, progress=progress)


def make(
    request: TablePlan, device: Device | str | None = None, *, dry_run: bool = False, progress: Progress | None = None
) -> Table:
    """Make a table as planned, or in a dry run only describe it. Raises the errors of `lut`."""
    with system_errors(request.path):
        return _make(request, device, dry_run, progress)


def _make(request: TablePlan, device: Device | str | None, dry_run: bool, progress: Progress | None) -> Table:
    begin = time.perf_counter()
    key, output = request.key(), FileOutput(request.manifest_path)
    plain = Table(
        request.kind,
        request.path,
        "planned",
        request.shape,
        request.axes,
        request.nbytes,
        {"key": key, "recipe": request.canonical()},
    )

    def up_to_date(there: dict[str, Any] | None) -> Table | None:
        if request.force or there is None or there.get("key") != key or not output.is_whole(there):
            return None
        return replace(plain, state="skipped", manifest=there, seconds=time.perf_counter() - begin)

    there = output.manifest()
    if found := up_to_date(there):
        if not dry_run:
            output.tidy()
        return found
    output.check([request.path], there, request.force)
    if dry_run:
        return plain
    lock = output.lock()
    try:
        there = output.settle(lock)
        if found := up_to_date(there):
            return found
        output.check([request.path], there, request.force)
        lock.note([request.path, request.manifest_path])
        return _made(request, device, key, plain, begin, progress)
    finally:
        lock.release()


def _made(
    request: TablePlan, device: Device | str | None, key: str, plain: Table, begin: float, progress: Progress | None
) -> Table:
    """The table, computed and written."""
    on: Any = device if isinstance(device, Device) else choose_device(device) if request.kind.on_device else None
    made: list[Integrated] = []
    facts: Facts = {}

    def fill(out: np.ndarray) -> None:
        def report(share: float) -> None:
            release(out)
            if progress:
                progress(request.path.name, "cells", share)

        run = Run(on, request.precision, request.tolerance, out, report, request.relative)
        result, found = _fitted(request, run) if request.fit else request.kind.make(request.cells, run, True)
        facts.update(found)
        if request.as_read:
            facts["as_read"] = _as_read(request, replace(run, out=None, progress=None), out)
        made.append(replace(result, values=np.empty(0)))  # the file has them; an array here would keep it mapped

    with Transaction() as transaction:
        if request.form == ".npy":
            write_npy(request.path, request.shape, request.dtype, fill, into=transaction)
        elif request.kind.coefficients:
            fill(np.empty(request.shape, request.dtype))
            text = request.kind.header(identifier(request.path.stem), facts, VERSION)
            write_text(request.path, text, into=transaction)
        elif request.form != ".exr":
            _texture(request, key, fill, made, facts, transaction)
        else:
            _exr(request, key, fill, made, facts, transaction)
        facts.pop("text", None)  # of a header
        staged = transaction.staged(request.path)
        manifest = {**_manifest(request, key, on if request.kind.on_device else None, made[0]), **facts}
        manifest |= {"sha256": digest_file(staged), "bytes": staged.stat().st_size}
        write_manifest(request.manifest_path, manifest, into=transaction)
        transaction.commit()
    return replace(plain, state="done", manifest=manifest, notices=made[0].notices, seconds=time.perf_counter() - begin)


# ---------------------------------------------------------------------------------------------- reads between texels


def _at(request: TablePlan, run: Run, shares: Sequence[np.ndarray]) -> tuple[Any, ...]:
    """Return values at positions in x and y, (ny, nx, c) float64, with the weights of reads there.

    Also returned are the rows whose errors count, and the integrals.
    """
    points, weights = [], []
    for one, share in zip(request.axes, shares, strict=True):
        values, x = one.at(share)
        points.append(Points(one.name, values))
        weights.append(bilinear.hats(one.count, x))
    made, _ = request.kind.make(replace(request.cells, points=tuple(points)), run, False)
    down = points[1]
    counted = down.given >= bilinear.LEAST if down.name == "roughness" else np.ones(down.given.size, bool)
    truth = np.asarray(made.values, np.float64).reshape(down.given.size, points[0].given.size, -1)
    return truth, weights[1], weights[0], counted if counted.any() else ~counted, made


def _fitted(request: TablePlan, run: Run) -> tuple[Integrated, Facts]:
    """Fit texels whose reads between the axes' ends are most accurate, into `run.out`."""
    out, plain = run.out, replace(run, out=None, progress=None)
    assert out is not None
    shares = [
        np.concatenate([[0.0], (np.arange(n) + 0.5) / n, [1.0]])
        for n in (bilinear.SAMPLES * a.count for a in request.axes)
    ]
    truth, down, across, counted, made = _at(request, plain, shares)
    facts = request.kind.facts(request.cells, plain)
    out[...] = bilinear.fit(truth, down, across, counted).reshape(out.shape)
    return replace(made, values=out), facts


def _as_read(request: TablePlan, run: Run, out: np.ndarray) -> dict[str, Any]:
    """Return absolute errors at texel centres and of bilinear reads between them, from the table and from each
    format.
    """
    texels = np.asarray(out, np.float64).reshape(request.axes[1].count, request.axes[0].count, -1)
    # At points where no fit looked, and at the ends.
    shares = [np.concatenate([[0.0], (np.arange(n) + 0.37) / n, [1.0]]) for n in (5 * a.count for a in request.axes)]
    truth, down, across, counted, _ = _at(request, run, shares)
    there = np.asarray(request.kind.make(request.cells, run, False)[0].values, np.float64)
    rows = request.axes[1].values()
    at = rows >= bilinear.LEAST if request.axes[1].name == "roughness" else np.ones(rows.size, bool)
    return {
        "counted": f"roughness from {bilinear.LEAST}; max_all from the axis's end",
        "centres": bilinear.errors(np.abs(texels - there.reshape(texels.shape)), at if at.any() else ~at),
        "between": {
            name: bilinear.errors(np.abs(bilinear.read(held, down, across) - truth), counted)
            for name, held in bilinear.formats(texels, request.dtype).items()
        },
    }


# ---------------------------------------------------------------------------------------------- files


def _exr(
    request: TablePlan,
    key: str,
    fill: Callable[[np.ndarray], None],
    made: list[Integrated],
    facts: Facts,
    transaction: Transaction,
) -> None:
    """Write an EXR by way of a nameless file, so that a large table needs little memory."""
    channels = request.shape[2] if len(request.shape) == 3 else 1
    with scratch(request.path, request.shape, request.dtype, fill) as cells:
        texts = {
            f"whitefurnace:{name}": value
            if isinstance(value, str | float)
            else json.dumps(value, sort_keys=True, ensure_ascii=False)
            for name, value in {**_manifest(request, key, None, made[0]), **facts}.items()
            if name not in ("name", "whitefurnace")
        }
        write_exr(
            request.path,
            cells.reshape(*request.shape[:2], channels),
            channel_names=CHANNELS[channels],
            attributes={"whitefurnace:version": VERSION, **texts},
            into=transaction,
        )


def _texture(
    request: TablePlan,
    key: str,
    fill: Callable[[np.ndarray], None],
    made: list[Integrated],
    facts: Facts,
    transaction: Transaction,
) -> None:
    """Write PNG, KTX 2, DDS or C. The manifest states the error of storing in addition to the table's error."""
    cells = np.empty(request.shape, request.dtype)
    fill(cells)
    whole = {**_manifest(request, key, None, made[0]), **facts}
    texts = {
        f"whitefurnace:{name}": value if isinstance(value, str) else json.dumps(value, sort_keys=True)
        for name, value in whole.items()
        if name not in ("name", "whitefurnace")
    }
    dimensions = max(len(request.axes), 2)
    letters = ", ".join(["wvuzyx"[-dimensions:][k] for k in range(dimensions)])
    models = [f"{slot} {c.model.name}" for slot, c in request.cells.models.items()]
    comment = [
        f"{request.kind.name} of {request.kind.subject(models, request.cells.scheme)}"
        + f", as [{letters}{', channel' if len(request.shape) > dimensions else ''}]; whitefurnace {VERSION}",
        *(f"{name}: {along}" for name, along in zip("xyzuvw", request.axes, strict=False)),
        *(f"{name} = {value:g}" for name, value in request.cells.fixed.items()),
        *([f"channels: {', '.join(facts['channels'])}"] if "channels" in facts else []),
        *([facts["formula"]] if "formula" in facts else []),
        f"error of a value: {made[0].error:.2g}",
    ]
    stored = write_table(
        request.path,
        cells.reshape(*request.shape[:dimensions], -1),
        request.stored,
        slack=made[0].error,
        texts=texts,
        comment=comment,
        into=transaction,
    )
    facts["stored"] = {"format": stored.format, "error": stored.error}


def _manifest(request: TablePlan, key: str, device: Device | None, made: Integrated) -> dict[str, Any]:
    recipe = request.canonical()
    whole = {
        "whitefurnace": VERSION,
        "name": request.path.name,
        "key": key,
        **recipe,
        "shape": list(request.shape),
        "dtype": request.dtype.name,
        "error": made.error,
        "rule": made.rule,
        "evaluations": made.evaluations,
        "notices": list(made.notices),
    }
    return whole if device is None else {**whole, "device": device.identity()}


__all__ = ["FORMS", "Table", "TablePlan", "TableRequest", "lut", "make", "plan"]
