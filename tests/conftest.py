"""Fixtures for all tests: every OpenCL device that works, and the environments the machine offers."""
from __future__ import annotations

import functools
import os
import re
from pathlib import Path

import pytest

from shell import Shell
from whitefurnace.opencl.device import Candidate, Device, choose_device, find_devices


def pytest_configure(config: pytest.Config) -> None:
    # PoCL's cache is not safe for several processes that build the same kernel at once.
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker and getattr(config, "cache", None) is not None:
        os.environ["POCL_CACHE_DIR"] = str(config.cache.mkdir(f"pocl-{worker}"))


@functools.cache
def working_devices() -> dict[str, Candidate]:
    """Every device whose probe gave the right answer, under a name fit for a test id."""
    return {
        f"{c.index}-" + re.sub(r"[^a-z0-9]+", "-", f"{c.platform} {c.name}".lower()).strip("-"): c
        for c in find_devices() if c.works
    }


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "device" in metafunc.fixturenames:
        names = list(working_devices()) or ["none"]
        metafunc.parametrize("device", names, indirect=True, scope="session")


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> Device:
    """Each working OpenCL device in turn; an error where none works."""
    if request.param == "none":
        pytest.fail(f"no OpenCL device works: {find_devices()}")
    return choose_device(str(working_devices()[request.param].index))


@pytest.fixture(scope="session")
def environments() -> list[Path]:
    """The lat-long images in the folder that WHITEFURNACE_ENVIRONMENTS names; skips where there is none."""
    folder = os.environ.get("WHITEFURNACE_ENVIRONMENTS")
    if not folder:
        pytest.skip("WHITEFURNACE_ENVIRONMENTS names no folder of .exr and .hdr images")
    found = sorted(path for suffix in ("*.exr", "*.hdr") for path in Path(folder).glob(suffix))
    if not found:
        pytest.fail(f"WHITEFURNACE_ENVIRONMENTS: no .exr or .hdr image in {folder}")
    return found


@pytest.fixture
def shell(capsys):
    return Shell(capsys)
