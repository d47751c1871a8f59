"""Measures the gain of specialized kernels in the prefilter's convolution.

Compares the kernel with its NDF bound by #define to the same kernel with all isotropic NDFs compiled in, of which a
number selects one at run time.

    python benchmarks/specialize.py [-n RUNS] [--outputs N] [--precision 32|64]
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from importlib import resources

import numpy as np

from whitefurnace.catalogue import Model, model, models
from whitefurnace.opencl import source
from whitefurnace.opencl.derived import numbers_of
from whitefurnace.opencl.device import Device, Kernel, choose_device
from whitefurnace.prefiltering.plan import CHUNK

ROUGHNESS = 0.5
MOST = 4
"""Largest number of parameters of an NDF; the general kernel receives this many."""


def isotropic() -> list[Model]:
    """Return the isotropic NDFs."""
    return [entry for name in models("ndf") if (entry := model("ndf", name)).isotropic]


def text_of(name: str) -> str:
    """Return the text of a kernel file."""
    return (resources.files("whitefurnace.kernels") / name).read_text("utf-8")


def switched(per_pair: bool) -> str:
    """Return the text of the program with all NDFs, of which the argument `ndf` selects one at run time.

    per_pair: select by a switch at each pair, as a shader with a uniform does; else by an `if` for each NDF, which a
    compiler may hoist out of the loop.
    """
    entries = isotropic()
    given = ", ".join(f"scalar n{k}" for k in range(MOST))
    numbers = ", ".join(f"n{k}" for k in range(MOST))
    calls = [
        f"ndf_{e.name}_D(cos_m, sin2_m" + "".join(f", (real)n{k}" for k in range(len(e.passed("NDF_D")))) + ")"
        for e in entries
    ]
    if per_pair:
        body = "switch (ndf) {" + " ".join(f"case {k}: return {call};" for k, call in enumerate(calls)) + "}"
    else:
        body = " ".join(f"if (ndf == {k}) return {call};" for k, call in enumerate(calls))
    chosen = (
        f"static inline real ndf_any_D(real cos_m, real sin2_m, int ndf, {given}) {{ {body} return (real)0; }}\n"
        f"#define NDF_PARAMETERS , int ndf, {given}\n#define NDF_VALUES , ndf, {numbers}\n"
        f"#define NDF_SCALARS , const int ndf, {given}\n"
        f"#define NDF_D_FRONT(a0, a1) ndf_any_D(a0, a1, ndf, {numbers})\n"
    )
    files = [
        text_of("real.clh"),
        text_of("special.clh"),
        *(text_of(e.kernel_file) for e in entries),
        chosen,
        text_of("window.clh"),
        text_of("lobe.clh"),
        text_of("prefilter.cl"),
    ]
    return "\n".join(files)


def numbers(device: Device, entry: Model) -> list[float]:
    """Return the parameters of an NDF at the roughness of the benchmark, in the order of D's arguments."""
    given = entry.from_roughness(ROUGHNESS) if entry.from_roughness else {}
    row = np.array([[given.get(p.name, p.default)] for p in entry.parameters], np.float64).reshape(-1, 1)
    found = dict(zip(entry.arguments, numbers_of(device, entry, row)[:, 0].tolist(), strict=True))
    return [found[name] for name in entry.passed("NDF_D")]


def built(device: Device, text: str, precision: int, launch: Callable[[Kernel], None]) -> tuple[Kernel, float]:
    """Build the kernel; return it with the processor seconds of the build and a first small launch.

    PoCL compiles for the sizes of a launch at the first one. A function with a unique name keeps the text out of every
    cache.
    """
    fresh = f"{text}\nint fresh_{os.getpid()}_{time.time_ns()}(void) {{ return 0; }}\n"
    begin = time.process_time()
    program = device.build(fresh, {"W": device.lanes(precision), "T": device.vectors, "PRECISION": precision})
    kernel = program.kernel("convolve")
    launch(kernel)
    return kernel, time.process_time() - begin


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", "--runs", type=int, default=15)
    parser.add_argument("--outputs", type=int, default=2048, help="directions that the lobe is evaluated in")
    parser.add_argument("--precision", type=int, choices=(32, 64), default=32)
    return parser.parse_args()


def main() -> None:
    options = arguments()
    device, precision = choose_device(), options.precision
    kind = np.dtype(f"f{precision // 8}")
    lanes = device.lanes(precision)
    step = lanes * device.vectors * device.local_size
    outputs, count = -(-options.outputs // step) * step, 2 * CHUNK
    rng = np.random.default_rng(1)

    def directions(n: int) -> np.ndarray:
        v = rng.standard_normal((3, n))
        return v / np.sqrt((v * v).sum(0))

    listed = np.zeros((count, 8), kind)
    listed[:, :3], listed[:, 3:7] = directions(count).T, rng.random((count, 4))
    out, at, of = (
        device.empty((2, 4, outputs), kind),
        device.array(directions(outputs).astype(kind)),
        device.array(listed),
    )

    def seconds(kernel: Kernel, last: list[np.generic], sources: int = count) -> float:
        """Return the processor seconds of a launch, or wall seconds on a GPU. Variants take turns to share the load."""
        clock = time.process_time if device.type == "cpu" else time.perf_counter
        begin = clock()
        device.launch(
            kernel,
            (outputs // lanes // device.vectors, 2),
            (out, np.int32(outputs), np.int32(sources), np.int32(CHUNK), at, of, kind.type(0), kind.type(0), *last),
        )
        device.finish()
        return clock() - begin

    def once(last: list[np.generic]) -> Callable[[Kernel], None]:
        return lambda kernel: seconds(kernel, last, 1) and None

    none = [np.int32(0), *(kind.type(1) for _ in range(MOST))]
    first = isotropic()[0]  # an untimed build first, for the one-time work of the compiler
    built(device, source.convolution(first).text, precision, once([kind.type(x) for x in numbers(device, first)]))
    general = {
        name: (text := switched(pair), *built(device, text, precision, once(none)))
        for name, pair in (("switch", True), ("if", False))
    }
    rows = []
    for place, entry in enumerate(isotropic()):
        found = [kind.type(x) for x in numbers(device, entry)]
        every = [np.int32(place), *found, *(kind.type(0) for _ in range(MOST - len(found)))]
        text = source.convolution(entry).text
        own, build = built(device, text, precision, once(found))
        variants = {"own": (own, found), **{name: (kernel, every) for name, (_, kernel, _) in general.items()}}
        values = {}
        for name, (kernel, last) in variants.items():
            seconds(kernel, last)
            values[name] = out.read()
        for name in general:
            assert np.allclose(values[name], values["own"], rtol=1e-4, atol=1e-4 * np.abs(values["own"]).max()), (
                f"{name} of {entry.name} differs"
            )
        runs: dict[str, list[float]] = {name: [] for name in variants}
        for _ in range(options.runs):
            for name, (kernel, last) in variants.items():
                runs[name].append(seconds(kernel, last))
        own_time = min(runs["own"])
        rows.append(
            [
                entry.name,
                f"{1e3 * own_time:.1f}",
                *(f"{min(runs[n]) / own_time:.2f}" for n in general),
                f"{1e3 * build:.0f}",
                f"{len(text.encode()) / 1e3:.1f}",
            ]
        )
    for name, (text, _, build) in general.items():
        rows.append([f"all, by {name}", "", "", "", f"{1e3 * build:.0f}", f"{len(text.encode()) / 1e3:.1f}"])
    print(
        f"{device.identity()['name']} ({device.identity()['platform']}), float{precision}, {outputs} directions × "
        f"{count} sources, least of {options.runs} launches; × own: times as long as the kernel of this NDF alone"
    )
    for row in [["NDF", "own, ms of CPU", "switch, × own", "if, × own", "build, ms of CPU", "text, kB"], *rows]:
        print("  ".join(cell.ljust(16) for cell in row).rstrip())


if __name__ == "__main__":
    main()
