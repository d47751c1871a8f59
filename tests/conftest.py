"""Fixtures for all tests: every OpenCL device that works, and the environments the machine offers."""

from __future__ import annotations

import collections
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


KERNEL_TESTS = {"catalogue", "integrals", "opencl", "prefiltering"}
"""Folders whose tests run on every device in the fast suite too, one member of each."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks as long those members of parametrized tests that prove little more than the others of their test.

    The fast suite keeps as few members as show each value of each parameter: of 9 NDFs × 7 maskings it takes 9. A test
    marked `few(n)` keeps n members, evenly drawn; one marked `whole` keeps all. A second device runs one member of each
    test of kernels.
    """
    tests: dict[str, list[pytest.Function]] = {}
    for item in items:
        if isinstance(item, pytest.Function) and hasattr(item, "callspec"):
            tests.setdefault(item.nodeid.partition("[")[0], []).append(item)
    first = next(iter(working_devices()), None)
    for members in tests.values():
        here = [item for item in members if item.callspec.params.get("device", first) == first]
        kept = _kept([item for item in here if not item.get_closest_marker("long")])
        if members[0].path.parent.name in KERNEL_TESTS:
            others = [item for item in members if item not in here]
            kept += list({item.callspec.params["device"]: item for item in reversed(others)}.values())
        for item in members:
            if item not in kept:
                item.add_marker("long")


def _kept(members: list[pytest.Function]) -> list[pytest.Function]:
    """The members of one test that the fast suite runs."""
    if not members or members[0].get_closest_marker("whole"):
        return members
    if few := members[0].get_closest_marker("few"):
        count = min(few.args[0], len(members))
        return [members[k * len(members) // count] for k in range(count)]
    # Each value in at least one member, with as few members as that takes, and each about as often as the others.
    values = {item: {(name, repr(value)) for name, value in item.callspec.params.items()} for item in members}
    shown: collections.Counter[tuple[str, str]] = collections.Counter()
    kept: list[pytest.Function] = []
    while new := {item: n for item in members if (n := sum(not shown[v] for v in values[item]))}:
        best = max(new, key=lambda item: (new[item], -sum(shown[v] for v in values[item])))
        kept.append(best)
        shown.update(values[best])
    return kept


@functools.cache
def working_devices() -> dict[str, Candidate]:
    """Every device whose probe gave the right answer, under a name fit for a test id."""
    return {
        f"{c.index}-" + re.sub(r"[^a-z0-9]+", "-", f"{c.platform} {c.name}".lower()).strip("-"): c
        for c in find_devices()
        if c.works
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
