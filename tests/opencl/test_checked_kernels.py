"""Kernels under Oclgrind, which checks each access to memory: tiny calls, one lane a work item, one item a group."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import checked_kernels
from whitefurnace.opencl.source import PROGRAMS

LIBRARIES = [
    path
    for folder in ("/usr/lib/oclgrind", "/usr/lib/x86_64-linux-gnu/oclgrind", "/usr/local/lib")
    if (path := Path(folder) / "liboclgrind-rt-icd.so").exists()
]


def under_oclgrind(tmp_path: Path, names: list[str], **environment: str) -> set[str]:
    """Run calls under Oclgrind, which must find nothing, and return the programs that they built."""
    (tmp_path / "oclgrind.icd").write_text(f"{LIBRARIES[0]}\n")
    log = tmp_path / "found.txt"
    done = subprocess.run(
        [sys.executable, checked_kernels.__file__, *names],
        env={
            **os.environ,
            "OCL_ICD_VENDORS": str(tmp_path),
            "OCLGRIND_LOG": str(log),
            "OCLGRIND_BUILD_OPTIONS": "-O0",
            "XDG_CACHE_HOME": str(tmp_path / "cache"),
            **environment,
        },
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert log.read_text() == "", log.read_text()[:2000]
    return {program for line in done.stdout.splitlines() for program in json.loads(line)["programs"]}


@pytest.mark.long
@pytest.mark.skipif(not LIBRARIES, reason="Oclgrind is not installed (Debian: apt install oclgrind)")
def test_kernels_stay_within_their_memory(tmp_path: Path) -> None:
    """Neither an access out of bounds nor a value that no one wrote; what is not covered is listed with its reason."""
    # Values that no one wrote are looked for in two calls: that takes four times as long, and the plugin does not know
    # the instruction `freeze`, which the built-in environment has.
    under_oclgrind(tmp_path, ["integrals", "lights"], OCLGRIND_UNINITIALIZED="1")
    built = under_oclgrind(tmp_path, list(checked_kernels.CALLS))
    assert built & set(PROGRAMS) == set(PROGRAMS) - set(checked_kernels.UNCHECKED)


@pytest.mark.long
@pytest.mark.skipif(not LIBRARIES, reason="Oclgrind is not installed (Debian: apt install oclgrind)")
def test_the_checker_finds_an_access_out_of_bounds(tmp_path: Path) -> None:
    """So that a silent checker is not taken for a clean program."""
    script = tmp_path / "wrong.py"
    script.write_text(
        "import numpy as np\nfrom whitefurnace.opencl.device import choose_device\n"
        "d = choose_device()\n"
        "k = d.build('__kernel void f(__global float *x) { x[get_global_id(0) + 4] = 1; }', {}).kernel('f')\n"
        "d.launch(k, (1,), (d.empty((4,), np.float32),), (1,))\nd.finish()\n"
    )
    with pytest.raises(AssertionError, match="Invalid write"):
        _script, checked_kernels.__file__ = checked_kernels.__file__, str(script)
        try:
            under_oclgrind(tmp_path, [])
        finally:
            checked_kernels.__file__ = _script
