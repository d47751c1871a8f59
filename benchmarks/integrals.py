"""Measures the time and the estimated error of an integral.

The integral is the directional albedo of every NDF with Smith's masking over 256 cosines × 64 roughnesses, in float32
and float64, on a warm kernel cache.

    python benchmarks/integrals.py [-n RUNS] [--markdown]
"""

from __future__ import annotations

import argparse
import statistics

import numpy as np

from whitefurnace import integrate
from whitefurnace.catalogue import models
from whitefurnace.catalogue.choice import chosen
from whitefurnace.integrals.quadrature import rows_of_roughness
from whitefurnace.opencl.device import choose_device

TOLERANCE = 1e-5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", "--runs", type=int, default=5)
    parser.add_argument("--markdown", action="store_true")
    options = parser.parse_args()
    device = choose_device()
    NoV = (np.arange(256) + 0.5) / 256
    r = (np.arange(64) + 0.5) / 64
    head = ["NDF", "bits", "ms (min … max)", "M evaluations/s", "evaluations a cell", "stated error", "finest rule"]
    rows = []
    for name in models("ndf"):
        parameters = rows_of_roughness(chosen("ndf", name), r[:, None])
        for precision in (32, 64) if device.fp64 else (32,):

            def run(name=name, parameters=parameters, precision=precision):
                return integrate(
                    "albedo", ndf=name, NoV=NoV, precision=precision, tolerance=TOLERANCE, device=device, **parameters
                )

            run()  # builds the kernels if they are not in the cache
            runs = [run() for _ in range(options.runs)]
            seconds = [done.seconds for done in runs]
            work = runs[0].evaluations
            spread = f"({1e3 * min(seconds):.0f} … {1e3 * max(seconds):.0f})"
            rows.append(
                [
                    name,
                    str(precision),
                    f"{1e3 * statistics.median(seconds):.0f} {spread}",
                    f"{work / statistics.median(seconds) / 1e6:.0f}",
                    f"{work / runs[0].values.size:.0f}",
                    f"{runs[0].error:.1e}",
                    runs[0].rule,
                ]
            )
    print(
        f"{device.identity()['name']} ({device.identity()['platform']}), tolerance {TOLERANCE:g}, "
        f"median of {options.runs} runs"
    )
    if options.markdown:
        print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
        print("\n".join("| " + " | ".join(row) + " |" for row in rows))
    else:
        for row in [head, *rows]:
            print("  ".join(cell.ljust(22) for cell in row).rstrip())


if __name__ == "__main__":
    main()
