"""Measures the cost of a batch of probes, which reads cubes as EXR and writes raw files.

Prints the wall and CPU time of a whole process by number of items and of workers, the overlap of its stages, and a
cost model (fixed, per item, per byte) with a prediction.

    python benchmarks/batch.py [--items N ...] [--sizes S ...] [--workers N ...] [--tolerance X] [--predict N]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from whitefurnace.files import write_exr

# Runs a batch, and prints the CPU time and the memory of the process and its workers at its end.
RUN = """
import json, resource, sys
from whitefurnace.batch import jobs
from whitefurnace.opencl.device import choose_device
total = dict(read=0.0, compute=0.0, write=0.0, nbytes=0, done=0, bad=0)
def on_result(result):
    total["nbytes"] += result.nbytes
    total["done"] += result.state == "done"
    total["bad"] += result.state != "done"
    for name, seconds in result.seconds.items():
        total[name] += seconds
if __name__ == "__main__":
    workers = int(sys.argv[2])
    jobs.run(jobs.job(sys.argv[1], force=True), workers=workers, on_result=on_result)
    total["kernels"] = choose_device().seconds if workers == 1 else None
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    total["cpu"] = sum(u.ru_utime + u.ru_stime for u in used)
    total["peak"] = max(u.ru_maxrss for u in used) * 1024
    print(json.dumps(total))
"""


def probes(folder: Path, count: int, size: int) -> int:
    """Write `count` environments of six `size`² faces (sky, ground, a bright patch, noise); return the bytes of one."""
    random = np.random.default_rng(size)
    row = np.linspace(1, 0, 6 * size, dtype=np.float32)[:, None, None]
    for k in range(count):
        image = (0.2 + row * np.float32([0.4, 0.6, 1.0])) * random.uniform(0.9, 1.1, (6 * size, size, 1))
        at = random.integers(0, 6 * size - 4), random.integers(0, size - 4)
        image[at[0] : at[0] + 4, at[1] : at[1] + 4] = 500
        write_exr(folder / f"probe{k:05d}.exr", image.astype(np.float32))
    return (folder / "probe00000.exr").stat().st_size


def run(folder: Path, count: int, options: argparse.Namespace, workers: int) -> dict[str, float]:
    """Bake the first `count` probes; return seconds and bytes by name."""
    names = ", ".join(f'"probe{k:05d}.exr"' for k in range(count))
    (folder / "job.toml").write_text(
        f'[[bake]]\nenvironments = [{names}]\noutput = "out"\nsize = {options.size}\ntolerance = {options.tolerance}\n'
    )
    script = folder / "run.py"  # a file, because worker processes import their main module
    script.write_text(RUN)
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, str(script), str(folder / "job.toml"), str(workers)], capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(done.stderr)
    used = json.loads(done.stdout)
    if used["bad"] or used["done"] != count:
        sys.exit(f"{used['bad']} of {count} probes were not baked")
    return {**used, "wall": time.perf_counter() - begin}


def fit(terms: list[np.ndarray], seconds: np.ndarray) -> np.ndarray:
    """Fit coefficients of the terms by least squares of relative errors, so that short and long runs count the same."""
    return np.linalg.lstsq(np.stack(terms, 1) / seconds[:, None], np.ones(len(seconds)), rcond=None)[0]


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--items", type=int, nargs="+", default=[1, 30, 100])
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256], help="sizes of the faces of the probes")
    parser.add_argument("--size", type=int, default=128, help="size of the largest level of a bake")
    parser.add_argument("--tolerance", type=float, default=1e-3)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--predict", type=int, default=10_000)
    return parser.parse_args()


def main() -> None:
    options = arguments()
    usual = 128 if 128 in options.sizes else options.sizes[0]
    most = max(options.items)
    head = [
        "faces",
        "workers",
        "items",
        "wall s",
        "CPU s",
        "CPU ms/item",
        "read",
        "compute",
        "write",
        "kernels",
        "wall / stages",
        "wall / kernels",
        "peak MB",
    ]
    rows, points = [], []
    with tempfile.TemporaryDirectory(prefix="whitefurnace-batch-") as top:
        for size in options.sizes:
            folder = Path(top, str(size))
            folder.mkdir()
            nbytes = probes(folder, most if size == usual else min(most, 30), size)
            run(folder, 1, options, 1)  # builds the kernels if they are not in the cache
            for workers in options.workers if size == usual else [1]:
                for count in options.items if size == usual else [1, min(most, 30)]:
                    used = run(folder, count, options, workers)
                    files = used["read"] + used["write"]
                    stages = max(used["compute"], files) / workers
                    kernels = "", ""
                    if used["kernels"] is not None:
                        kernels = f"{used['kernels']:.2f}", f"{used['wall'] / max(used['kernels'], files):.2f}"
                    rows.append(
                        [
                            f"{size}²",
                            f"{workers}",
                            f"{count}",
                            f"{used['wall']:.2f}",
                            f"{used['cpu']:.2f}",
                            f"{used['cpu'] / count * 1e3:.0f}",
                            *(f"{used[name]:.2f}" for name in ("read", "compute", "write")),
                            kernels[0],
                            f"{used['wall'] / stages:.2f}",
                            kernels[1],
                            f"{used['peak'] / 1e6:.0f}",
                        ]
                    )
                    if workers == 1:
                        points.append((size == usual, count, count * nbytes, used["cpu"], used["wall"]))
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    for row in [head, *rows]:
        print("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)))
    print_fits(points, options, usual)
    print(
        f"{os.cpu_count()} cores; wall / stages: over all computing, or all reading and writing, of a worker; wall / "
        f"kernels: over the kernels' own time, or all reading and writing"
    )


def print_fits(points: list[tuple[bool, int, int, float, float]], options: argparse.Namespace, usual: int) -> None:
    """Print what an item costs by the runs with one worker, and what many items would cost.

    points: whether the faces are of the usual size, items, bytes read, CPU seconds and wall seconds of each run. usual:
    that size.
    """
    table = np.array([point[1:] for point in points])
    alike = np.array([point[0] for point in points])
    ones, items, nbytes = np.ones(len(table)), table[:, 0], table[:, 1]
    one = nbytes[alike][0] / items[alike][0]
    fixed, each, byte = (
        fit([ones, items, nbytes], table[:, 2]) if len(options.sizes) > 1 else (*fit([ones, items], table[:, 2]), 0.0)
    )
    off = np.max(np.abs((fixed + items * each + nbytes * byte) / table[:, 2] - 1))
    print(
        f"CPU: {fixed:.2f} s + {each * 1e3:.1f} ms per item + {byte * 1e9:.1f} ms per MB read, at most {off:.0%} "
        f"off above; {options.predict} items of {one / 1e6:.2f} MB: "
        f"{fixed + options.predict * (each + byte * one):.0f} s"
    )
    fixed, each = fit([ones[alike], items[alike]], table[alike, 3])
    print(
        f"wall, one worker, {usual}²: {fixed:.2f} s + {each * 1e3:.1f} ms per item; {options.predict} items: "
        f"{fixed + options.predict * each:.0f} s"
    )


if __name__ == "__main__":
    main()
