"""Convolves with the symmetries of the cube: the orbits of grids and levels, and the launches of `octahedral.cl`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np

from whitefurnace.opencl import source
from whitefurnace.opencl.constants import RUN, RUN_EDGE, TILE, TILE_EDGE
from whitefurnace.opencl.device import Buffer, Device, Kernel
from whitefurnace.prefiltering.lobes import Lobe
from whitefurnace.prefiltering.plan import Part, Window
from whitefurnace.sphere.grids import Shape, bounds, cube_directions, grid_tangents

PIECE = 1 << 16
"""Number of classes whose images are in memory together: 38 MiB in float32."""

MOST_PLACES = 512
"""Nodes per edge of the finest grid whose places are kept, in 38 MiB."""


@dataclass(frozen=True)
class Orbits:
    """Texels of a level, one for every orbit under its symmetries.

    first, count  the range of texels
    padded        their number with padding to whole lanes
    exchanges     number of exchanges of axes that map the level onto itself
    number        (padded, 2) int32, as `octahedral.cl` reads it
    direction     (3, padded) float64 unit directions
    """

    shape: Shape
    first: int
    count: int
    padded: int
    exchanges: int
    number: np.ndarray
    direction: np.ndarray


@lru_cache(maxsize=64)
def orbits(shape: Shape, lanes: int, most: int) -> tuple[Orbits, ...]:
    """Return the orbits of a level in parts of at most `most`, padded to multiples of `lanes`.

    Neighbours on the sphere stay next to each other.
    """
    if shape.latlong:
        rows, columns = shape.dims
        i, j = np.mgrid[: rows // 2, : -(-columns // 8)].reshape(2, -1)
        number = np.stack([i, 2 * j + 1], 1)
        theta, phi = (i + 0.5) * math.pi / rows, (2 * j + 1) * math.pi / columns
        direction = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)])
    else:
        i, j = np.mgrid[: -(-shape.size // 2), : -(-shape.size // 2)].reshape(2, -1)
        i, j = i[j <= i], j[j <= i]
        odd = 1 - shape.size % 2
        number = np.stack([2 * i + odd, 2 * j + odd], 1)
        s = shape.coordinates()[shape.size // 2 :]
        direction = cube_directions(np.full(len(i), 4), s[i], -s[j])
    order = np.lexsort((j % 4, i % 4, j // 4 % 2, i // 4 % 2, j // 8, i // 8))
    found, step = [], max(most // lanes, 1) * lanes
    for first in range(0, len(order), step):
        part = order[first : first + step]
        padded = -(-len(part) // lanes) * lanes
        index = np.pad(part, (0, padded - len(part)), mode="edge")
        found.append(
            Orbits(
                shape,
                first,
                len(part),
                padded,
                2 if shape.latlong else 6,
                number[index].astype(np.int32),
                direction[:, index],
            )
        )
    return tuple(found)


class Classes:
    """The classes of nodes of one grid on a device. Its arrays are made when they are first used."""

    def __init__(self, symmetries: Octahedral, n: int, grid: Buffer, exchanges: int) -> None:
        self.symmetries, self.n, self.grid, self.exchanges = symmetries, n, grid, exchanges
        self.count = 3 * n * n // 4
        self._place = symmetries.places(n)
        self._images: Buffer | None = None

    def _launch(self, name: str, count: int, out: Buffer, *args: Any) -> None:
        self.symmetries.launch(name, self.exchanges, count, (out, np.int32(self.n), *args, self._place, self.grid))

    @cached_property
    def node(self) -> Buffer:
        """Direction and symmetric weight of each class, (classes, 4), made on the device."""
        node = self.symmetries.device.empty((self.count, 4), self.symmetries.kind)
        self._launch("class_nodes", self.count, node, self.symmetries.tangents(self.n))
        return node

    @cached_property
    def moment(self) -> Buffer:
        """Transforms of each class's images over the reflections, (8, classes, 3 exchanges), made on the device."""
        moment = self.symmetries.device.empty((8, self.count, 3 * self.exchanges), self.symmetries.kind)
        self._launch("class_moments", self.count, moment)
        return moment

    def images(self) -> Iterator[tuple[int, Buffer]]:
        """Yield (first class, images (exchanges, count, 24)) in pieces of at most PIECE classes; a single piece is
        kept.
        """
        if self._images is not None:
            yield 0, self._images
            return
        for first in range(0, self.count, PIECE):
            count = min(PIECE, self.count - first)
            image = self.symmetries.device.empty((self.exchanges, count, 24), self.symmetries.kind)
            self._launch("class_images", count, image, np.int32(first), np.int32(count))
            if count == self.count:
                self._images = image
            yield first, image


@cache
def tile_bounds(n: int) -> np.ndarray:
    """Return the centre and radius of every run of classes of the n × n grid, then of each tile in the run.

    The shape is (runs, 1 + tiles in a run, 4). The order of the classes is that of `class_numbers` in `octahedral.cl`.
    """
    half, tiles = n // 2, RUN_EDGE // TILE_EDGE
    index = np.arange(half * half)
    run, tile, inside, across = index // RUN, index // TILE % tiles**2, index % TILE, half // RUN_EDGE
    u = grid_tangents(n)[half:]
    t = u[run // across * RUN_EDGE + tile // tiles * TILE_EDGE + inside // TILE_EDGE]
    s = u[run % across * RUN_EDGE + tile % tiles * TILE_EDGE + inside % TILE_EDGE]
    one = np.ones_like(s)
    d = np.concatenate([np.stack([one, s, t]), np.stack([t, one, s]), np.stack([s, t, one])], 1)
    d /= np.sqrt((d * d).sum(0))
    outer, inner = bounds(d, RUN), bounds(d, TILE)
    return np.concatenate([outer[:, None], inner.reshape(-1, tiles**2, 4)], 1)


class Octahedral:
    """The launches on one device in one precision, with the data that depend on neither environment nor lobe."""

    def __init__(self, device: Device, precision: int) -> None:
        self.device = device
        self.precision = precision
        self.kind = np.dtype(f"f{precision // 8}")
        self.lanes = device.lanes(precision)
        self.groups = device.orbits
        self._on_device: dict[Any, Buffer] = {}

    def _kernel(self, name: str, exchanges: int = 6) -> Kernel:
        return self.device.build(
            source.octahedral().text,
            {"W": self.lanes, "T": self.groups, "PRECISION": self.precision, "PERMS": exchanges},
        ).kernel(name)

    def launch(self, name: str, exchanges: int, count: int, args: Sequence[Any]) -> None:
        """Launch a kernel over at least `count` work items."""
        size = self.device.scalar_size
        self.device.launch(self._kernel(name, exchanges), (-(-count // size) * size,), args, (size,))

    def _kept(self, key: Any, values: np.ndarray) -> Buffer:
        """Return `values` on the device in the working precision (integers unchanged), made once for each `key`."""
        if key not in self._on_device:
            kind = values.dtype if values.dtype.kind == "i" else self.kind
            self._on_device[key] = self.device.array(values.astype(kind))
        return self._on_device[key]

    def orbits(self, shape: Shape, most: int = 1 << 14) -> tuple[Orbits, ...]:
        """Return the orbits of a level in tiles of at most about `most`."""
        return orbits(shape, self.lanes * self.device.local_size, min(most, 1 << 14))

    def tangents(self, n: int) -> Buffer:
        """Return the face coordinates of the nodes of an n × n grid."""
        return self._kept(("tangent", n), grid_tangents(n))

    def places(self, n: int) -> Buffer | None:
        """Return the places of each class's images in an n × n grid; None where they would take more memory than the
        grid.
        """
        if n > MOST_PLACES:
            return None
        if ("place", n) not in self._on_device:
            count = 3 * n * n // 4
            place = self.device.empty((count, 48), np.int32)
            self.launch("class_places", 6, count, (place, np.int32(n)))
            self._on_device["place", n] = place
        return self._on_device["place", n]

    def classes(self, n: int, grid: Buffer, exchanges: int) -> Classes:
        """Return the classes of an n × n grid."""
        return Classes(self, n, grid, exchanges)

    def _series(self, lobe: Lobe, inner: Window | None, outer: Window | None, error: float) -> tuple[Any, ...]:
        real = self.kind.type
        if lobe.reach < (outer.q0 if outer else 1.0):  # a lobe that ends before its part does
            outer = Window(lobe.reach, 1.25 * lobe.reach)
        series = lobe.series(min(inner.q0, lobe.reach) if inner else 0.0, outer.q1 if outer else 2.0, error)
        key = ("terms", series.terms.tobytes())
        windows = [x for w in (inner, outer) for x in ((w.q0, 1 / (w.q1 - w.q0)) if w else (0.0, 0.0))]
        return (
            real(series.shift),
            real(series.slope),
            real(series.offset),
            np.int32(series.power),
            np.int32(len(series.terms)),
            self._kept(key, series.terms),
            *(real(x) for x in windows),
        )

    def empty(self, splits: int, found: Orbits) -> Buffer:
        """Return a buffer for partial sums."""
        return self.device.empty((splits, 24 * found.exchanges + 1, found.padded), self.kind)

    def _direction(self, found: Orbits) -> Buffer:
        return self._kept(("direction", found.shape, found.first, found.padded), found.direction)

    def convolve(
        self,
        partial: Buffer,
        first: int,
        splits: int,
        found: Orbits,
        lobe: Lobe,
        part: Part,
        classes: Classes,
        error: float,
    ) -> None:
        """Write the partial sums of one part of a lobe into splits `first` to `first + splits - 1` of `partial`.

        error: largest share of its energy that the lobe's series may misplace.
        """
        items = -(-found.padded // self.lanes // self.groups // self.device.local_size) * self.device.local_size
        series = self._series(lobe, part.inner, part.outer, error)

        def head(count: int, *origin: Any) -> tuple[Any, ...]:
            chunk = RUN * math.ceil(count / splits / RUN)
            return (
                partial,
                np.int32(found.padded),
                *origin,
                np.int32(count),
                np.int32(chunk),
                np.int32(first),
                self._direction(found),
                classes.node,
            )

        if part.outer is None:
            self.device.launch(
                self._kernel("convolve_all", found.exchanges),
                (items, splits),
                (*head(classes.count), classes.moment, *series),
            )
            return
        group = self._kept(("group", found.shape, found.first, found.padded), bounds(found.direction, self.lanes))
        tile = self._kept(("tile", part.grid), tile_bounds(part.grid))
        for origin, image in classes.images():
            self.device.launch(
                self._kernel("convolve_close", found.exchanges),
                (items, splits),
                (*head(image.shape[1], np.int32(origin)), image, group, tile, self.kind.type(part.outer.q1), *series),
            )

    def apart(self, found: Orbits, lobe: Lobe, listed: Buffer) -> Buffer:
        """Return sums over a list of single sources for every output, by the NDFs themselves."""
        real, partial = self.kind.type, self.empty(1, found)
        for k, (entry, numbers, weight) in enumerate(lobe.summands or ((None, (), 1.0),)):
            program = self.device.build(
                source.apart(entry).text,
                {"W": self.lanes, "T": 1, "PRECISION": self.precision, "PERMS": found.exchanges},
            )
            self.device.launch(
                program.kernel("convolve_apart"),
                (found.padded // self.lanes, found.exchanges),
                (
                    partial,
                    np.int32(found.padded),
                    np.int32(listed.shape[0]),
                    self._direction(found),
                    listed,
                    real(weight),
                    np.int32(k > 0),
                    *(real(value) for value in numbers),
                ),
            )
        return partial

    def unfold(
        self,
        level: Buffer,
        found: Orbits,
        whole: Buffer | None,
        close: Buffer | None,
        apart: Buffer | None,
        per_norm: float,
        base: np.ndarray,
    ) -> None:
        """Write the texels of these orbits into `level`, (dims, 3 or 4) float32.

        whole, close: partial sums of the parts with and without transforms, or None. apart: sums over single sources,
        or None. The value is the partial sums divided by their weights, plus `apart` times per_norm, plus the base.
        Without `whole` the sums are added to the level.
        """
        real, shape = self.kind.type, found.shape
        number = self._kept(("number", shape, found.first, found.padded), found.number)
        sums = (x for some in (whole, close, apart) for x in (some, np.int32(some.shape[0] if some else 0)))
        self.device.launch(
            self._kernel("unfold", found.exchanges),
            (found.padded // self.lanes, found.exchanges),
            (
                level,
                np.int32(level.shape[-1]),
                np.int32(found.padded),
                np.int32(found.count),
                np.int32(shape.size),
                np.int32(shape.latlong),
                number,
                *sums,
                real(per_norm),
                *(real(x) for x in base),
            ),
        )


@cache
def octahedral_of(device: Device, precision: int) -> Octahedral:
    """Return the shared `Octahedral` of a device and a precision."""
    return Octahedral(device, precision)
