"""A tiny run of every OpenCL program, for a simulator that checks each access to memory: one work item a group, W = 1.

`python tests/checked_kernels.py NAME…` runs those calls on the device that OpenCL shows, and prints for each the
programs of `opencl/source.py` that it built, with its seconds. Under Oclgrind:

    mkdir icd && echo /usr/lib/oclgrind/liboclgrind-rt-icd.so > icd/oclgrind.icd
    export OCL_ICD_VENDORS=$PWD/icd OCLGRIND_BUILD_OPTIONS=-O0 OCLGRIND_LOG=errors.txt
    python tests/checked_kernels.py

Without -O0 Oclgrind 21.10 cannot make kernels whose constants the compiler has put into tables.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import whitefurnace as wf
from whitefurnace.opencl import source
from whitefurnace.opencl.device import Device, Program, choose_device
from whitefurnace.rendering import truth
from whitefurnace.sphere.demo import demo_pixels

SKY = np.random.default_rng(1).random((4, 8, 3), np.float32)
SUN = SKY.copy()
SUN[1, 5] = 900
NOV = [0.05, 0.7]
DISC = "disc:center_x=.3,center_y=0,center_z=2,radius=.4"
BRDF = "real3 brdf_mine_f(real3 l, real3 v) { return vec3(l.z, v.z, l.x * l.x); }\n"


def lit(device: Device, folder: Path, **given: Any) -> None:
    wf.integrate("radiance", NoV=NOV, tolerance=0.3, device=device, **given)


def mine(folder: Path) -> str:
    (folder / "mine.clh").write_text(BRDF)
    return str(folder / "mine.clh")


def integrals(device: Device, folder: Path) -> None:
    ask: Any = partial(wf.integrate, device=device, tolerance=0.3)
    ask("projected_area", ndf="ggx:alpha=.3", NoV=0.5)
    ask("albedo", ndf="ggx:alpha=.3", NoV=NOV)
    ask("albedo", ndf="beckmann_anisotropic:alpha_x=.2,alpha_y=.4", NoV=0.5, phi=0.4)
    ask("normalization", ndf="phong:exponent=20")
    ask("dfg", ndf="ggx:alpha=.3", NoV=NOV)
    ask("dfg", ndf="gtr:alpha=.3,gamma=1.5", masking="cook_torrance", NoV=0.5)
    ask("albedo", ndf="charlie:alpha=.4", masking="neumann", fresnel="dielectric:ior=.7", NoV=0.5)
    ask("albedo", diffuse="oren_nayar:albedo=.5,sigma=.4", NoV=NOV)
    ask("albedo", brdf=mine(folder), NoV=NOV)


def tabulated_area(device: Device, folder: Path) -> None:
    wf.integrate("albedo", ndf="abc:b=30,c=1.5", NoV=0.5, tolerance=0.3, device=device)


def lights(device: Device, folder: Path) -> None:
    lit(device, folder, ndf="ggx:alpha=.4", light="punctual", NoL=0.6)
    lit(device, folder, ndf="ggx:alpha=.4", light=DISC)
    lit(device, folder, diffuse="burley:albedo=.5,roughness=.4", light=DISC)
    lit(device, folder, brdf=mine(folder), light=DISC)
    wf.sample("ggx", 4, alpha=0.3, device=device)


def environments(device: Device, folder: Path) -> None:
    for texels in (SKY[:2, :4], np.tile(SKY[None, :1, :1], (6, 1, 1, 1))):
        lit(device, folder, diffuse="lambert:albedo=.5", environment=texels)
    lit(device, folder, ndf="ggx:alpha=.8", environment=SKY[:1, :2])


def tables(device: Device, folder: Path) -> None:
    axes: Any = {"roughness": (0.4, 0.8, 2), "NoV": (0.3, 0.9, 2)}
    wf.lut("ltc", folder / "ltc.npy", axes=axes, tolerance=0.3, device=device)
    wf.lut("glass", folder / "glass.npy", axes={"ior": (1.2, 1.5, 2)}, size=2, tolerance=0.3, device=device)


def reflectance(device: Device, folder: Path) -> None:
    n = np.array([[0.0, 0.1], [1.0, 0.9], [0.0, 0.3]])
    n /= np.linalg.norm(n, axis=0)
    points = truth.Points(n, np.array([[0.6, 0.0], [0.8, 1.0], [0.0, 0.0]]))
    whole = truth.Truth(device, wf.environment(SUN))
    for found in (truth.term(diffuse="lambert:albedo=.8"), truth.term(ndf="ggx", roughness=0.5)):
        whole.sums(found, points, 32, whole.rest)


def others(device: Device, folder: Path) -> None:
    demo_pixels(device, 4)


CALLS: dict[str, Callable[[Device, Path], None]] = {
    f.__name__: f for f in (integrals, tabulated_area, lights, environments, tables, reflectance, others)
}


_LARGE = "the smallest prefilter sums over too many nodes: minutes in a simulator"

UNCHECKED = {
    "convolution by the symmetries of the cube": _LARGE,
    "bright texels under an NDF": _LARGE,
    "bright texels under the cosine": _LARGE,
    "interpolation": _LARGE,
    "nodes and harmonics": _LARGE,
    "convolution with an NDF": _LARGE,
    "convolution with the cosine": _LARGE,
    "texels near a narrow lobe": _LARGE,
    "limits of a device": "runs for a given time, to be timed",
}
"""Programs that no call launches, with the reason."""


def small(device: Device) -> Device:
    """Return the device with one lane a work item and one work item a group, so that no padding hides a wrong index.

    A checker of uninitialized values has buffers of zeros: Oclgrind 21.10 takes what one kernel writes for another one
    as undefined. It then checks private memory.
    """
    device.local_size = device.scalar_size = device.vectors = 1
    assert device.lanes(32) == device.lanes(64) == 1, "a checker runs one lane a work item"
    if os.environ.get("OCLGRIND_UNINITIALIZED"):
        Device.empty = lambda self, shape, dtype: self.array(np.zeros(shape, dtype), writable=True)  # type: ignore[method-assign]
    return device


def record() -> set[str]:
    """Return a set that receives the name of each program that is built from here on."""
    texts: dict[str, str] = {}
    built: set[str] = set()
    assemble, build = source.assembled, Device.build

    def assembled(program: str, *given: Any, **words: Any) -> source.Source:
        made = assemble(program, *given, **words)
        texts[made.text] = program
        return made

    def noted(self: Device, text: str, *given: Any, **words: Any) -> Program:
        built.add(texts.get(text, text))
        return build(self, text, *given, **words)

    source.assembled = assembled
    Device.build = noted  # type: ignore[method-assign]
    return built


def main(names: list[str]) -> None:
    """Run calls by name, all of them by default."""
    device, built = small(choose_device()), record()
    for name in names or list(CALLS):
        built.clear()
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            CALLS[name](device, Path(folder))
        seconds = round(time.perf_counter() - begin, 1)
        print(json.dumps({"call": name, "seconds": seconds, "programs": sorted(built)}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
