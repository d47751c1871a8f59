"""Measures the throughput of every kernel, and its ratio to the multiply-adds and memory bandwidth of the same device.

These limits are measured right before and after each case, since the absolute speed of a shared machine varies by a
factor of 2 to 4 within an hour.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from whitefurnace.catalogue import integral, model
from whitefurnace.catalogue.choice import chosen
from whitefurnace.catalogue.rule import AREA_RULES, LADDERS, Rule
from whitefurnace.errors import UsageError, nearest
from whitefurnace.integrals.quadrature import Part
from whitefurnace.opencl import source
from whitefurnace.opencl.derived import numbers_of
from whitefurnace.opencl.device import Device
from whitefurnace.opencl.launch import over_cells, over_nodes
from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.convolution import HARMONICS_CHUNK, Convolver
from whitefurnace.prefiltering.importance import Sampler
from whitefurnace.prefiltering.lobes import Lobe, ndf_lobe
from whitefurnace.prefiltering.means import Means
from whitefurnace.prefiltering.sources import Texels
from whitefurnace.prefiltering.symmetry import Octahedral
from whitefurnace.rendering.truth import Points, Term, Truth, term
from whitefurnace.sphere.environments import environment
from whitefurnace.sphere.grids import Shape, latlong_tables

RUNS = 7
"""Number of timed runs of a case, after one that is not timed. The median is stated."""

LEAST_SECONDS = 0.02
"""Shortest run in seconds. The work grows until the device takes this long, a hundred times the start of a launch on a
CPU."""

GROUPS = 4096
"""Number of work groups of a yardstick: many for each core, so that none waits long for the last."""

STREAM_BYTES = 1 << 27
"""Bytes of an array of a bandwidth yardstick, several times the largest cache."""

CHAINS, STEPS_A_ROUND = 12, 4  # as yardstick.cl has them

# Operations of one unit, counted in the kernel's text as it runs for GGX with Smith's masking and no Fresnel: an
# addition, multiplication, division, root, comparison with its selection, minimum or maximum is 1, a fused multiply-add
# 2, a polynomial the operations in it, a built-in (sin, exp, atan2 …) 1 whatever it takes. What does not change in the
# inner loop, integers, addresses and scalars that all lanes share are left out: GFLOP/s is a lower bound.
FLOPS: Mapping[str, float] = {
    # Differences 3, their square 5, the lobe 8 (q/4, α² + (1 - α²)sin²θ 2, /, square, 1 - q/2 and its maximum 3), its
    # product 1, four multiply-adds 8; GGX needs no cosine, so its root goes.
    "convolve": 25,
    # Of a source class and an orbit of outputs, 384 pairs: eight distances 24, eight values of the lobe as a series of
    # one term 64, the transform 24, 8 × 18 multiply-adds and the weight's one 290.
    "octahedral": 402 / 384,
    # l 15, its face and place 20, how much higher it is read 9 and between which levels 6, two addresses 34, two
    # bilinear reads of four scalars 72, their blend and sum 20.
    "samples": 176,
    # A normal that v sees 26, l 10, its area 10 and V 7, D 8, what is left 3 and its level 9, then as samples but for
    # the sum 157; two Fresnels with their weights 17, the blend 12 and two sums of four 16.
    "truth": 275,
    # n·l 7, the half vector 9 and its cosines and slope 17, D 6, area of l 9, V 6, n·l D V 3, two Fresnels 16, three
    # sums of each 12.
    "truth-lights": 85,
    # Two filters of five taps 36, node 3, face coordinates 19 and their test 5, two arctangents 36, places 6 and
    # stencils 12, two bases 62, w L 3, rows 32, 256 multiply-adds 512.
    "anterpolate": 726,
    # Eight distances 24 shared by eight pairs, the lobe 8, three multiply-adds 6.
    "apart": 17,
    # Face coordinates 6, two arctangents 36, places 18, two bases 62, 72 multiply-adds of four 576.
    "interpolate": 698,
    # Azimuth's cosine 14, v·h 3, n·l 3, Fc 4, Smith's area of l 9, V 6, what is visible and its weight 3, two sums 5.
    "dfg": 47,
    # p/q of two steps 18, S and w 5, (w/q)² dφ 7, Fc 7, the sum 2; the ring's 150 are shared by 16.
    "dfg-closed": 48,
    # exp 23 and sinh 4, the slope's vector 10, v·h 6, l 8, Fc 4, area of l 10, V 6, visible 3, sums 9, D 11, measure 8.
    "dfg-anisotropic": 102,
    # l 2, measure 1, Burley's f 14 (that of v and n·l comes before), the sum 2.
    "hemisphere": 19,
    # Grading 22, θ and its complement with two series of sinh 43, sines and cosines 5, the azimuth's end 8, measure 6;
    # v·m over the azimuth 6, D 5, the compensated sum 5.
    "area": 100,
    # Grading along the path 26 and its place 5, m 4, v·h 6, n·l 4, measure 1, D 6, Smith's area 9 and V 8, the sum 4.
    "radiance-light": 73,
    # f(l, v) 38 (half vector 10, its slope 2, D 6, area of l 9, V 6, product and horizon 5), n·l 3, three sums 12.
    "radiance-image": 53,
    # To the surface's frame 15, the node 3, w L 3.
    "radiance-texels": 21,
    # Nine basis functions 18, their products with RGB 54, the weight 1.
    "harmonics": 73,
    # α²cos²θ + sin²θ with a lane's own α 7, the quotient squared 2, the test of the side 1.
    "evaluate": 10,
}


@dataclass(frozen=True)
class Spread:
    """A measured figure: the median, the smallest and the largest of its runs."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Return the spread of the values of several runs."""
        return cls(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Work:
    """The work of one run.

    run     launches the work; it gets the result of `before`, which is not timed
    units   amount of work, in the unit of the case
    nbytes  bytes of its arrays, if each is read or written once
    """

    run: Callable[[Any], object]
    units: float
    nbytes: float
    before: Callable[[], Any] = lambda: None


@dataclass(frozen=True)
class Case:
    """A kernel to measure.

    kernel      name of its file
    unit        unit in which its work is counted
    about       one line for users
    make        returns its work on a device in a precision, `scale` times the smallest
    precisions  precisions in bits
    """

    name: str
    kernel: str
    unit: str
    about: str
    make: Callable[[Device, int, int], Work]
    precisions: tuple[int, ...] = (32, 64)


@dataclass(frozen=True)
class Throughput:
    """The result of a case.

    rate       units of work per second
    gflops     GFLOP/s of the median run, None where operations are not counted
    gbytes     GB/s of the median run
    of_peak    median ratio to the multiply-adds of the same device
    of_memory  median ratio to its memory bandwidth
    seconds    seconds of a run on the device
    """

    case: str
    unit: str
    precision: int
    rate: Spread
    gflops: float | None
    of_peak: float | None
    gbytes: float
    of_memory: float
    seconds: float
    runs: int


@dataclass(frozen=True)
class Yardstick:
    """The measured limits of a device.

    peak   multiply-adds in GFLOP/s by precision; each is an addition and a multiplication
    read   GB/s of reading memory
    triad  GB/s of a + x·b
    """

    peak: Mapping[int, Spread]
    read: Spread
    triad: Spread


# ---------------------------------------------------------------------------------------------- the clock


def _seconds(device: Device, work: Work) -> float:
    """Seconds that the device spends on one run."""
    state = work.before()
    device.finish()
    begin = device.seconds
    work.run(state)
    device.finish()
    return device.seconds - begin


def _enough(device: Device, make: Callable[[int], Work], least: float) -> Work:
    """Return work that takes the device at least `least` seconds per run, or the largest work there is."""
    scale, work = 1, make(1)
    while scale < 1 << 12:
        _seconds(device, work)  # builds, touches its memory for the first time
        if _seconds(device, work) >= least:
            break
        scale *= 2
        more = make(scale)
        if more.units <= work.units:
            break
        work = more
    return work


class BenchMeter:
    """Measures the limits of a device. Each call is one run; `yardstick` returns the results of all runs."""

    def __init__(self, device: Device, least: float = LEAST_SECONDS, nbytes: int = STREAM_BYTES) -> None:
        self.device, self.least = device, least
        self.precisions = (32, 64) if device.fp64 else (32,)
        most = min(nbytes, device.max_allocation // 2, device.global_memory // 16)
        group = GROUPS * device.local_size * device.lanes() * 4 * 4  # one vector of floats an item, by fours
        self.stream = max(most // group, 1) * group
        self._works: dict[str | int, Work] = {}
        self._rates: dict[str | int, list[float]] = {}

    def _run(self, which: str | int, make: Callable[[], Work]) -> float:
        """Return the rate of one run in 1e9 units per second; the first of all runs is not counted."""
        if which not in self._works:
            self._works[which] = make()
            _seconds(self.device, self._works[which])
        rate = self._works[which].units / max(_seconds(self.device, self._works[which]), 1e-9) / 1e9
        self._rates.setdefault(which, []).append(rate)
        return rate

    def peak(self, precision: int) -> float:
        """Measure the GFLOP/s of multiply-adds on all cores, in one run.

        precision: 32 or 64 bits.
        """
        return self._run(precision, lambda: self._multiply_adds(precision))

    def read(self) -> float:
        """Measure the GB/s of reading memory, in one run."""
        return self._run("read", lambda: self._streams()[0])

    def triad(self) -> float:
        """Measure the GB/s of a + x·b, which reads two arrays and writes one, in one run."""
        return self._run("triad", lambda: self._streams()[1])

    def _multiply_adds(self, precision: int) -> Work:
        device, lanes = self.device, self.device.lanes(precision)
        kind = np.dtype(f"f{precision // 8}")
        kernel = device.build(source.yardstick().text, {"W": lanes, "T": 1, "PRECISION": precision}).kernel(
            "multiply_add"
        )
        items = GROUPS * device.local_size
        start = device.array(np.linspace(1, 2, CHAINS * lanes).astype(kind))
        out = device.empty(items * lanes, kind)

        def make(scale: int) -> Work:
            arguments = out, np.int32(16 * scale), kind.type(0.5), kind.type(0.25), start
            return Work(
                lambda _: device.launch(kernel, (items,), arguments),
                2.0 * CHAINS * STEPS_A_ROUND * lanes * 16 * scale * items,
                0,
            )

        return _enough(device, make, self.least / 2)

    def _streams(self) -> tuple[Work, Work]:
        device, lanes = self.device, self.device.lanes()
        items, floats = GROUPS * device.local_size, self.stream // 4
        arrays = [device.empty(floats, np.float32) for _ in range(3)]
        for array in arrays:  # memory that nobody wrote to is one page of zeros, or no numbers at all
            array.write(np.ones(floats, np.float32))
        program = device.build(source.yardstick().text, {"W": lanes, "T": 1, "PRECISION": 32})
        count, out = np.int32(floats // (items * lanes)), device.empty(items * lanes, np.float32)
        read, triad = program.kernel("read"), program.kernel("triad")
        return (
            Work(lambda _: device.launch(read, (items,), (out, count, arrays[0])), self.stream, self.stream),
            Work(
                lambda _: device.launch(triad, (items,), (arrays[0], count, np.float32(0.5), *arrays[1:])),
                3.0 * self.stream,
                3.0 * self.stream,
            ),
        )

    def yardstick(self) -> Yardstick:
        """Return the limits of the device; those that were not measured yet are measured now in RUNS runs."""
        measures: dict[str | int, Callable[[], float]] = {p: partial(self.peak, p) for p in self.precisions}
        for which, measure in {**measures, "read": self.read, "triad": self.triad}.items():
            while len(self._rates.get(which, [])) < RUNS:
                measure()
        found = {which: Spread.of(rates) for which, rates in self._rates.items()}
        return Yardstick({p: found[p] for p in self.precisions}, found["read"], found["triad"])


# ---------------------------------------------------------------------------------------------- the cases


def _rng() -> np.random.Generator:
    return np.random.default_rng(1)


def _directions(count: int) -> np.ndarray:
    """Return unit directions all over the sphere, (3, count)."""
    d = _rng().normal(size=(3, count))
    return d / np.linalg.norm(d, axis=0)


def _cells(*ranges: tuple[float, float], count: int) -> np.ndarray:
    """Return cells of random numbers within their ranges, (rows, count)."""
    low, high = np.array(ranges).T
    return low[:, None] + (high - low)[:, None] * _rng().random((len(ranges), count))


def _noise(rows: int) -> Any:
    """A lat-long of random texels."""
    return environment(_rng().random((rows, 2 * rows, 3), np.float32))


def _convolve(device: Device, precision: int, scale: int) -> Work:
    """GGX at α = ¼ over two chunks of sources."""
    kind, lanes = np.dtype(f"f{precision // 8}"), device.lanes(precision)
    step = lanes * device.vectors * device.local_size
    outputs, sources = -(-512 * scale // step) * step, 2 * planning.CHUNK
    entry = model("ndf", "ggx")
    kernel = device.build(
        source.convolution(entry).text, {"W": lanes, "T": device.vectors, "PRECISION": precision}
    ).kernel("convolve")
    listed = np.zeros((sources, 8), kind)
    listed[:, :3], listed[:, 3:7] = _directions(sources).T, _rng().random((sources, 4))
    arguments = (
        device.empty((2, 4, outputs), kind),
        np.int32(outputs),
        np.int32(sources),
        np.int32(planning.CHUNK),
        device.array(_directions(outputs).astype(kind)),
        device.array(listed),
        kind.type(0),
        kind.type(0),
        *(kind.type(number) for number in numbers_of(device, entry, np.array([[0.25]]))[:, 0]),
    )
    return Work(
        lambda _: device.launch(kernel, (outputs // lanes // device.vectors, 2), arguments),
        float(outputs) * sources,
        kind.itemsize * (8 * sources + (3 + 8) * outputs),
    )


def _ggx(device: Device) -> Lobe:
    """GGX at α = ¼."""
    return ndf_lobe(device, chosen("ndf", "ggx"), 0.5, {"alpha": 0.25})


def _octahedral(device: Device, precision: int, scale: int) -> Work:
    """The same lobe over the grid of 64² nodes per face, by the 48 symmetries."""
    kind, n = np.dtype(f"f{precision // 8}"), 64
    shape, symmetries = Shape(False, min(16 * scale, 1024)), Octahedral(device, precision)
    grid = device.array(_rng().random((6, n, n, 4)).astype(kind))
    lobe, whole = _ggx(device), planning.Part(n, None, None)
    classes = symmetries.classes(n, grid, 6)
    tiles = [
        (found, symmetries.empty(planning.splits_for(found.padded // symmetries.lanes, 3 * n * n // 4), found))
        for found in symmetries.orbits(shape)
    ]

    def run(_: Any) -> None:
        for found, sums in tiles:
            symmetries.convolve(sums, 0, sums.shape[0], found, lobe, whole, classes, 1e-5)

    return Work(
        run,
        6.0 * n * n * shape.count,
        float(classes.node.nbytes + classes.moment.nbytes + sum(sums.nbytes for _, sums in tiles)),
    )


def _samples(device: Device, precision: int, scale: int) -> Work:
    """256 samples of the same lobe per texel, each between two levels of a pyramid of 256²."""
    sampler = Sampler(Means(device, _rng().random((6, 256, 256, 3), np.float32), 0.0), precision)
    lobe, shape, pyramid = _ggx(device), Shape(False, min(8 * scale, 1024)), sampler.pyramid(256)
    return Work(
        lambda _: sampler.level(lobe, shape, 256), 256.0 * shape.count, pyramid.nbytes + precision / 8 * 6 * shape.count
    )


def _truth(device: Device, precision: int, scale: int) -> tuple[Truth, Term, Points]:
    """Points of a sphere in random light, with GGX at α = ¼ and Schlick's Fresnel of two F0."""
    n = _directions(1024 * scale)
    n[2] = np.abs(n[2])
    return (
        Truth(device, _noise(64), precision),
        term(ndf="ggx", fresnel="schlick", ndf_alpha=0.25, fresnel_f0=np.array([0.04, 1.0]), fresnel_f90=1.0),
        Points(n, np.broadcast_to(np.array([[0.0], [0.0], [1.0]]), n.shape)),
    )


def _truth_samples(device: Device, precision: int, scale: int) -> Work:
    """256 samples per point, each between two levels."""
    truth, found, points = _truth(device, precision, scale)
    count = points.n.shape[1]
    pyramid = truth.rest.pyramid(truth.rest.size)
    return Work(
        lambda _: truth.sums(found, points, 256, truth.rest), 256.0 * count, pyramid.nbytes + precision / 8 * count * 16
    )


def _truth_lights(device: Device, precision: int, scale: int) -> Work:
    """1 024 lights per point."""
    truth, found, points = _truth(device, precision, scale)
    count, lights = points.n.shape[1], np.concatenate([_directions(1024).T, _rng().random((1024, 3))], 1)
    return Work(
        lambda _: truth.gathered(found, points, lights), 1024.0 * count, precision / 8 * (8 * 1024 + count * 14)
    )


def _pyramid(device: Device, precision: int, scale: int) -> Work:
    """The pyramid of a cube."""
    size = 1 << min(4 + scale.bit_length(), 10)
    means, texels = Means(device, _rng().random((6, size, size, 3), np.float32), 0.0), 6.0 * size**2
    # A texel has 4 scalars; the coarser levels, which read what was written, add a third.
    return Work(
        lambda sampler: sampler.pyramid(size),
        texels,
        texels * (12 + precision / 8 * 4 * (4 / 3 + 1)),
        lambda: Sampler(means, precision),
    )


def _anterpolate(device: Device, precision: int, scale: int) -> Work:
    """A lat-long's texels onto the grid of 64² nodes per face."""
    env = _noise(rows := min(64 * scale, 2048))
    texels = 2.0 * rows**2
    return Work(
        lambda light: light.prepare(64, 1),
        texels,
        12 * texels + precision / 8 * 6 * 64**2 * 4,
        lambda: Texels(device, env, precision),
    )


def _apart(device: Device, precision: int, scale: int) -> Work:
    """256 nodes of bright texels for the outputs of a cube."""
    kind, symmetries, lobe = np.dtype(f"f{precision // 8}"), Octahedral(device, precision), _ggx(device)
    shape, listed = Shape(False, min(16 * scale, 1024)), np.zeros((256, 8), kind)
    listed[:, :3], listed[:, 4:7] = _directions(256).T, _rng().random((256, 3))
    buffer, tiles = device.array(listed), symmetries.orbits(shape)

    def run(_: Any) -> None:
        for found in tiles:
            symmetries.apart(found, lobe, buffer)

    return Work(run, 256.0 * shape.count, float(listed.nbytes + kind.itemsize * 3 * shape.count))


def _interpolate(device: Device, precision: int, scale: int) -> Work:
    """A level of a cube from 128² nodes per face."""
    convolver, shape = Convolver(device, _noise(16), precision=precision), Shape(False, min(64 * scale, 1024))
    grid = device.array(_rng().random((6, 128, 128, 4), np.float32))
    level = device.empty((*shape.dims, 3), np.float32)
    return Work(lambda _: convolver.interpolate(level, shape, grid), float(shape.count), grid.nbytes + level.nbytes)


def _near_texels(device: Device, precision: int, scale: int) -> Work:
    """GGX at α = .005 in some directions over a lat-long of 64 rows, including the list of its parts."""
    convolver, lobe = (
        Convolver(device, _noise(64), precision=precision),
        ndf_lobe(device, chosen("ndf", "ggx"), math.sqrt(0.005), {"alpha": 0.005}),
    )
    directions = _directions(16 * scale)
    return Work(lambda _: convolver.exact_narrow(lobe, directions, 64, 1e-3), 16.0 * scale, float(12 * 64 * 128))


def _means(device: Device, precision: int, scale: int) -> Work:
    """Return the work of making the means of a lat-long over the texels of a cube of 128²."""
    rows = min(64 * scale, 2048)
    texels = _rng().random((rows, 2 * rows, 3), np.float32)
    return Work(
        lambda means: means.level(Shape(False, 128)),
        texels.size / 3,
        texels.nbytes + 12 * 6 * 128**2,
        lambda: Means(device, texels, 0.0),
    )


def _means_of_cube(device: Device, precision: int, scale: int) -> Work:
    """Return the work of making the means of a rotated cube over the texels of another cube of half its size."""
    size = min(8 * scale, 512)
    texels = _rng().random((6, 2 * size, 2 * size, 3), np.float32)
    return Work(
        lambda means: means.level(Shape(False, size)),
        texels.size / 3,
        texels.nbytes + 12 * 6 * size**2,
        lambda: Means(device, texels, 0.5),
    )


def _sum(
    device: Device,
    text: str,
    kernel: str,
    cells: np.ndarray,
    components: int,
    precision: int,
    rule: Rule,
    azimuths: bool = True,
) -> Work:
    """A kernel that sums over the nodes of a rule for each cell."""
    rows, count = cells.shape
    return Work(
        lambda _: over_nodes(device, text, kernel, cells, components, precision, rule, azimuths),
        float(count) * rule.evaluations,
        precision / 8 * count * (rows + components),
    )


def _dfg(device: Device, precision: int, scale: int) -> Work:
    slots = {"ndf": model("ndf", "ggx"), "masking": model("masking", "smith")}
    return _sum(
        device,
        source.integration(integral("dfg"), slots).text,
        "integrate",
        _cells((0, 1), (0.01, 1), count=2048 * scale),
        2,
        precision,
        LADDERS["gauss"][4],
    )


def _albedo_with_kinks(device: Device, precision: int, scale: int) -> Work:
    """The albedo of Cook-Torrance's masking, whose panels meet where its terms cross."""
    names = {"ndf": "beckmann", "masking": "cook_torrance", "fresnel": "one"}
    slots = {slot: model(slot, name) for slot, name in names.items()}
    part = Part(device, integral("albedo"), slots, precision, kinked=True)
    cells, terms, _ = part.cells(_cells((0.05, 1), (0.1, 1), count=2048 * scale), precision)
    return _sum(device, part.text(terms), "integrate", cells, 1, precision, part.ladder[4])


def _dfg_closed(device: Device, precision: int, scale: int) -> Work:
    slots = {"ndf": model("ndf", "ggx"), "masking": model("masking", "smith")}
    return _sum(
        device,
        source.closed("dfg_ggx.cl", slots).text,
        "integrate",
        _cells((0.01, 1), (0.01, 1), count=2048 * scale),
        2,
        precision,
        LADDERS["light-angles"][4],
    )


def _glass(device: Device, precision: int, scale: int) -> Work:
    slots = {
        slot: model(slot, name) for slot, name in (("ndf", "ggx"), ("masking", "smith"), ("fresnel", "dielectric"))
    }
    return _sum(
        device,
        source.refraction(slots).text,
        "integrate",
        _cells((0.01, 1), (0.01, 1), (0.4, 3), count=2048 * scale),
        2,
        precision,
        LADDERS["refraction"][2],
    )


def _dfg_anisotropic(device: Device, precision: int, scale: int) -> Work:
    slots = {"ndf": model("ndf", "ggx_anisotropic"), "masking": model("masking", "smith")}
    return _sum(
        device,
        source.integration(integral("dfg"), slots).text,
        "integrate",
        _cells((0, 1), (0, 1), (0.1, 1), (0.1, 1), count=1024 * scale),
        2,
        precision,
        LADDERS["stretched"][4],
    )


def _hemisphere(device: Device, precision: int, scale: int) -> Work:
    return _sum(
        device,
        source.hemisphere(model("diffuse", "burley")).text,
        "integrate",
        _cells((0, 1), (0, 1), (0, 1), count=2048 * scale),
        1,
        precision,
        LADDERS["hemisphere"][4],
    )


def _area(device: Device, precision: int, scale: int) -> Work:
    return _sum(
        device,
        source.area(model("ndf", "ggx")).text,
        "area",
        _cells((0, 1), (0.01, 1), count=4096 * scale),
        1,
        precision,
        AREA_RULES[32][1],
        azimuths=False,
    )


def _lobes(device: Device, precision: int, scale: int) -> Work:
    """A step of the fit of linearly transformed cosines to GGX, beginning at the untransformed cosine."""
    slots = {"ndf": model("ndf", "ggx"), "masking": model("masking", "smith"), "fresnel": model("fresnel", "one")}
    rule, soft = LADDERS["gauss"][4], np.dtype(f"f{precision // 8}").type(0.02)
    cells = _cells((0, 1), (1, 1), (1, 1), (0, 0), (0, 0), (1, 1), (0.01, 1), count=1024 * scale)
    polar, azimuthal = rule.tables()
    between = [*map(np.int32, rule.counts), polar, np.int32(rule.azimuths), azimuthal, soft]
    text = source.transformed(slots).text
    return Work(
        lambda _: over_cells(device, text, "descend", cells, 19, precision, between),
        float(cells.shape[1]) * rule.evaluations,
        precision / 8 * cells.shape[1] * (len(cells) + 19),
    )


def _radiance_light(device: Device, precision: int, scale: int) -> Work:
    """Arcs of a disc's outline, 1 to 2 above the surface."""
    slots = {"ndf": model("ndf", "ggx"), "masking": model("masking", "smith"), "fresnel": model("fresnel", "one")}
    ranges = {
        "NoV": (0.1, 1),
        "phi": (0, 6),
        "Cz": (1, 2),
        "Ax": (0.5, 1),
        "By": (0.5, 1),
        "length": (0.1, 0.5),
        "scale": (0.1, 0.5),
        "alpha": (0.05, 1),
    }
    cells = _cells(*(ranges.get(name, (0, 0)) for name in ("NoV", "phi", *source.OUTLINE, "alpha")), count=1024 * scale)
    return _sum(device, source.outline(slots).text, "integrate", cells, 1, precision, Rule("outline", 20, 12, 9))


def _radiance_image(device: Device, precision: int, scale: int) -> Work:
    """One view over a list of nodes, of which half are above the surface."""
    kind, lanes = np.dtype(f"f{precision // 8}"), device.lanes(precision)
    slots = {"ndf": model("ndf", "ggx"), "masking": model("masking", "smith"), "fresnel": model("fresnel", "one")}
    steps, items = 64, 16 * scale * device.local_size
    nodes = items * steps * lanes
    kernel = device.build(source.lit_nodes(slots).text, {"W": lanes, "T": 1, "PRECISION": precision}).kernel(
        "integrate"
    )
    tile = np.concatenate([_directions(steps * lanes), _rng().random((4, steps * lanes))]).astype(kind)
    listed = device.array(np.tile(tile, (1, items)))
    out = device.empty((3, items * lanes), kind)
    cells = device.array(np.repeat(np.array([[0.7], [0.0], [0.25]]), lanes, 1).astype(kind))
    return Work(
        lambda _: device.launch(
            kernel, (items, 1), (out, np.int32(lanes), np.int32(items), np.int32(steps), listed, cells)
        ),
        nodes,
        kind.itemsize * 7 * nodes,
    )


def _radiance_texels(device: Device, precision: int, scale: int) -> Work:
    """A lat-long's texels in the frame of a surface."""
    kind = np.dtype(f"f{precision // 8}")
    rows, local = min(64 * scale, 2048), device.local_size
    count = 2 * rows * rows
    stride = -(-count // local) * local
    kernel = device.build(source.frame_nodes("latlong").text, {"W": 1, "T": 1, "PRECISION": precision}).kernel(
        "frame_nodes"
    )
    tables = (device.array(t.astype(kind)) for t in latlong_tables(rows, 2 * rows, np.array([0.5]), np.ones(1), 0.0))
    arguments = (
        device.empty((7, stride), kind),
        np.int32(stride),
        np.int32(0),
        np.int32(count),
        device.array(np.eye(3, dtype=kind)),
        None,
        np.int32(rows),
        np.int32(2 * rows),
        np.int32(1),
        kind.type(1),
        kind.type(0),
        *tables,
        device.array(_rng().random((count, 3), np.float32)),
    )
    return Work(lambda _: device.launch(kernel, (stride,), arguments), count, count * (7.0 * kind.itemsize + 12))


def _harmonics(device: Device, precision: int, scale: int) -> Work:
    """Return the work of making the harmonics of a list of nodes, to degree 2."""
    kind = np.dtype(f"f{precision // 8}")
    chunks = 16 * scale * device.local_size
    nodes = chunks * HARMONICS_CHUNK
    kernel = device.build(
        source.texels("latlong").text, {"W": device.lanes(precision), "T": 1, "PRECISION": precision}
    ).kernel("harmonics")
    listed = device.array(np.tile(_rng().random((HARMONICS_CHUNK, 8)).astype(kind), (chunks, 1)))
    out = device.empty((chunks, 28), kind)
    return Work(
        lambda _: device.launch(kernel, (chunks,), (out, np.int32(nodes), np.int32(HARMONICS_CHUNK), listed)),
        nodes,
        kind.itemsize * 8.0 * nodes,
    )


def _evaluate(device: Device, precision: int, scale: int) -> Work:
    """GGX's D at distinct cells, more than the caches hold."""
    kind, lanes = np.dtype(f"f{precision // 8}"), device.lanes(precision)
    step, again = lanes * device.local_size, max(scale // 256, 1)
    count = -(-16384 * min(scale, 256) // step) * step
    kernel = device.build(
        source.evaluation("NDF_D", {"ndf": model("ndf", "ggx")}).text, {"W": lanes, "T": 1, "PRECISION": precision}
    ).kernel("evaluate")
    theta = np.linspace(0, 1.5, count)
    cells = np.stack([np.cos(theta), np.sin(theta) ** 2, np.linspace(0.01, 1, count)]).astype(kind)
    arguments = device.empty(count, kind), np.int32(count), device.array(cells)

    def run(_: Any) -> None:
        for _ in range(again):
            device.launch(kernel, (count // lanes,), arguments)

    return Work(run, float(count) * again, kind.itemsize * 4.0 * count * again)


def _demo(device: Device, precision: int, scale: int) -> Work:
    """Points of the built-in sky, 16 per texel."""
    rows, cuts = min(32 * scale, 2048), 4
    kernel = device.build(source.demo().text, {"W": 1, "T": 1, "PRECISION": 32}).kernel("demo")
    count = -(-2 * rows * rows // device.local_size) * device.local_size
    sun = [np.float32(x) for x in (0.6, 0.64, 0.48, 0.9999, 1e4)]
    arguments: tuple[Any, ...] = (device.empty((rows, 2 * rows, 3), np.float32), np.int32(rows), np.int32(cuts), *sun)
    return Work(lambda _: device.launch(kernel, (count,), arguments), 2.0 * rows**2 * cuts**2, 12 * 2.0 * rows**2)


# One entry a kernel. tests/benching/test_bench.py requires one for every file that has a kernel.
CASES = (
    Case("convolve", "prefilter.cl", "pair", "a lobe, GGX, over a list of sources, every pair", _convolve),
    Case("octahedral", "octahedral.cl", "pair", "the same over a grid, by the symmetries of the cube", _octahedral),
    Case("samples", "samples.cl", "sample", "filtered importance sampling of the same", _samples),
    Case("pyramid", "pyramid.cl", "texel", "the pyramid that the samples are read from", _pyramid),
    Case("anterpolate", "anterpolate.cl", "texel", "a lat-long onto an equiangular grid of 64²", _anterpolate),
    Case("apart", "apart.cl", "pair", "the same over a list of bright texels, by the NDF itself", _apart),
    Case("interpolate", "interpolate.cl", "texel", "a level's texels read from values at nodes", _interpolate),
    Case("near-texels", "exact.cl", "direction", "a narrow lobe over texels near it, finely cut", _near_texels, (32,)),
    Case("means", "overlap.cl", "texel", "exact means of a lat-long over the texels of a cube", _means, (64,)),
    Case("means-of-cube", "overlap.cl", "texel", "exact means of a turned cube over another", _means_of_cube, (64,)),
    Case("harmonics", "harmonics.cl", "node", "spherical harmonics to degree 2", _harmonics),
    Case("albedo-with-kinks", "kinked.cl", "evaluation", "albedo of Cook-Torrance's masking", _albedo_with_kinks),
    Case("dfg", "integrate.cl", "evaluation", "split-sum pair, GGX with Smith's masking", _dfg),
    Case("dfg-closed", "dfg_ggx.cl", "evaluation", "split-sum pair, GGX, azimuth in closed form", _dfg_closed),
    Case("glass", "glass.cl", "evaluation", "reflected and refracted by a rough boundary, GGX", _glass),
    Case("dfg-anisotropic", "stretched.cl", "evaluation", "split-sum pair, anisotropic GGX", _dfg_anisotropic),
    Case("ltc", "ltc.cl", "evaluation", "a step of the fit of linearly transformed cosines, GGX", _lobes),
    Case("hemisphere", "hemisphere.cl", "evaluation", "albedo of a diffuse model, Burley's", _hemisphere),
    Case("area", "area.cl", "node", "projected area for the table of Smith's term", _area),
    Case("radiance-light", "radiance_outline.cl", "evaluation", "reflected radiance of an area light", _radiance_light),
    Case("radiance-image", "radiance_nodes.cl", "node", "reflected radiance of an image's nodes", _radiance_image),
    Case("radiance-texels", "radiance_texels.cl", "node", "texels in the frame of a surface", _radiance_texels),
    Case("truth", "truth.cl", "sample", "the reflectance integral by samples, GGX of two F0", _truth_samples),
    Case("truth-lights", "truth.cl", "pair", "the same over a list of bright texels", _truth_lights),
    Case("evaluate", "evaluate.cl", "cell", "a model function, GGX's D", _evaluate),
    Case("demo", "demo.cl", "point", "the built-in environment", _demo, (32,)),
)


def cases(names: Sequence[str]) -> tuple[Case, ...]:
    """Return the cases with these names in the order given, or all cases where no name is given.

    Raises UsageError with the nearest name.
    """
    known = {case.name: case for case in CASES}
    for name in names:
        if name == "tradeoff":
            raise UsageError("tradeoff stands alone: bench tradeoff ENV...")
        if name not in known:
            raise UsageError(f"unknown benchmark {name!r}{nearest(name, [*known, 'tradeoff'])}")
    return tuple(known[name] for name in dict.fromkeys(names)) if names else CASES


def throughput(
    wanted: Sequence[Case],
    device: Device,
    meter: BenchMeter,
    runs: int = RUNS,
    progress: Callable[[str, float], None] | None = None,
) -> Iterator[Throughput]:
    """Measure cases one after the other, in every precision of the device, with the limits of the device next to each.

    runs: number of timed runs of a case. progress: called with the case and the share of the work done.
    """
    todo = [(case, precision) for case in wanted for precision in case.precisions if precision in meter.precisions]
    for k, (case, precision) in enumerate(todo):
        if progress:
            progress(f"{case.name}, float{precision}", k / len(todo))

        def make(scale: int, case: Case = case, precision: int = precision) -> Work:
            return case.make(device, precision, scale)

        work = _enough(device, make, meter.least)
        _seconds(device, work)
        rates, peaks, memories = [], [], []
        for _ in range(runs):  # in turn, so that a disturbance meets the yardsticks too
            peaks.append(meter.peak(precision))
            memories.append(meter.read())
            # A driver without a clock for kernels gives 0 seconds, from which no rate follows.
            rates.append(work.units / max(_seconds(device, work), 1e-9))
        rate, flops, nbytes = Spread.of(rates), FLOPS.get(case.name), work.nbytes / work.units
        ratio = [statistics.median(r / y / 1e9 for r, y in zip(rates, by, strict=True)) for by in (peaks, memories)]
        yield Throughput(
            case.name,
            case.unit,
            precision,
            rate,
            None if flops is None else flops * rate.median / 1e9,
            None if flops is None else flops * ratio[0],
            nbytes * rate.median / 1e9,
            nbytes * ratio[1],
            work.units / rate.median,
            runs,
        )
