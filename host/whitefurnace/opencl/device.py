"""Finds the OpenCL devices that give right results, chooses one, builds kernels and runs them.

This is the only module that imports pyopencl.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib.metadata
import math
import os
import re
import signal
import sys
import tempfile
import threading
import warnings
import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from whitefurnace.catalogue.user_text import MARK
from whitefurnace.errors import DeviceError, InputError, UnsupportedError, UsageError
from whitefurnace.opencl.cache import KernelCache, kernel_cache
from whitefurnace.opencl.complaints import about_user_file

# pyopencl takes 0.1 to 0.3 s to import, so it is imported by `_opencl()` at the first use of a device.

INSTALL = (
    "install a GPU vendor's driver, or `pip install whitefurnace[pocl]`, or "
    "`pip install whitefurnace[intel]`, or on Debian `apt install pocl-opencl-icd`"
)


class Tuning(NamedTuple):
    """Launch sizes with which a kind of device runs fastest. They are measured on AVX-512 CPUs, and safe on other
    devices.
    """

    vectors: int  # T: vectors of W lanes a work item
    local_size: int  # work items in a group
    scalar_size: int = 64  # of kernels whose work items are many, small and scalar: a group costs 10 ns on PoCL
    orbits: int = 4  # vectors of outputs that take the same classes in turn while these are in cache (octahedral.cl)


TUNING = {
    "cpu16": Tuning(vectors=1, local_size=1),  # two gain nothing: 5.6 against 6.1 G pairs/s, and groups grow
    "cpu8": Tuning(vectors=1, local_size=1),  # 16 registers: a second vector spills
    "cpu4": Tuning(vectors=1, local_size=1),
    "cpu1": Tuning(vectors=1, local_size=16),  # below 16 PoCL's own vectoriser has nothing to join
    "gpu": Tuning(vectors=2, local_size=128, scalar_size=128, orbits=1),
    "other": Tuning(vectors=1, local_size=16),
}

# Variables that CPU runtimes read when they are loaded: PoCL's up to 4 and from 5, Intel's, and those of the host's
# own libraries (numpy's linear algebra, OpenImageIO).
CORE_LIMITS = (
    "POCL_MAX_PTHREAD_COUNT",
    "POCL_CPU_MAX_CU_COUNT",
    "DPCPP_CPU_NUM_CUS",
    "CL_CONFIG_CPU_TBB_NUM_WORKERS",
    "OMP_NUM_THREADS",
    "OPENIMAGEIO_THREADS",
)

# Launches in flight: enough to keep a device busy; few, so that Ctrl-C is heard within seconds and
# unwaited profiling events do not pile up.
QUEUE_DEPTH = 8


@dataclass(frozen=True)
class Candidate:
    """An OpenCL device in the list of devices, and whether it works.

    index                   its place, counted from 0 for the most preferred device
    name, platform, driver  names as the driver reports them
    type                    "gpu", "cpu" or "other"
    verdict                 "works", or one line with the reason why not
    fp64                    True if float64 works too
    """

    index: int
    name: str
    platform: str
    driver: str
    type: str  # "gpu", "cpu" or "other"
    verdict: str
    fp64: bool

    @property
    def works(self) -> bool:
        """True if a small kernel was built on the device and gave the right result."""
        return self.verdict == "works"


# ---------------------------------------------------------------------------------------------- finding


@contextlib.contextmanager
def _quiet() -> Iterator[list[str]]:
    """Suppress pyopencl's warnings and the lines that a driver writes to stderr; the list has these lines
    afterwards.
    """
    lines: list[str] = []
    with contextlib.ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        try:
            sink = stack.enter_context(tempfile.TemporaryFile())
            saved = os.dup(2)
        except OSError:  # no temporary folder or no stderr: noise is better than no device
            yield lines
            return
        if sys.stderr is not None:
            with contextlib.suppress(OSError, ValueError):
                sys.stderr.flush()
        os.dup2(sink.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            lines += sink.read().decode(errors="replace").splitlines()


def _pip_runtimes() -> list[Path]:
    """Return runtimes from pip that the loader does not find, because Intel's .icd holds a placeholder for a path."""
    try:
        files = importlib.metadata.files("intel-opencl-rt") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    return [Path(str(f.locate())).resolve() for f in files if f.name == "libintelocl.so"]


def cores() -> int:
    """Return the number of logical cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def core_limit(count: int) -> dict[str, str]:
    """Return the environment variables with which CPU runtimes use at most `count` cores, for a new process.

    A process that has loaded its runtimes does not read them any more. Sub-devices would be the standard's way, but
    kernels on one of 1 of 2 units kept both cores busy on PoCL 3.1 and Intel's runtime 2026; with these the CPU time
    was 0.99 and 1.01 of the wall time. A variable that the user has set is not among them.
    """
    return {name: str(count) for name in CORE_LIMITS if name not in os.environ}


@contextlib.contextmanager
def _exposed_runtimes() -> Iterator[None]:
    """Let the OpenCL loader see pip's runtimes in addition to the system's while it makes its list, once per process.

    OCL_ICD_VENDORS replaces the system's folder, so the .icd files of that folder are copied to ours. (PoCL from pip
    needs nothing: pyopencl's loader always looks in its own folder.) A user's own setting is left alone.
    """
    runtimes = [] if "OCL_ICD_VENDORS" in os.environ else _pip_runtimes()
    if not runtimes:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="whitefurnace-icd-") as folder:
        vendors = [Path(root) / "etc/OpenCL/vendors" for root in ("/", sys.prefix)]  # Conda has the second
        texts = [f"{path}\n".encode() for path in runtimes]
        for path in (path for vendor in vendors for path in sorted(vendor.glob("*.icd"))):
            with contextlib.suppress(OSError):
                texts.append(path.read_bytes())
        for number, text in enumerate(dict.fromkeys(texts)):
            (Path(folder) / f"{number}.icd").write_bytes(text)
        os.environ["OCL_ICD_VENDORS"] = folder
        try:
            yield
        finally:
            del os.environ["OCL_ICD_VENDORS"]


@contextlib.contextmanager
def _exposed_cache() -> Iterator[None]:
    """Let PoCL, while it is loaded, see the folder whose kernels this process has checked."""
    global _cache
    if _cache is None:
        _cache = kernel_cache()
    before = os.environ.get("POCL_CACHE_DIR")
    if _cache is not None:
        os.environ["POCL_CACHE_DIR"] = str(_cache.folder)
    try:
        yield
    finally:
        if before is not None:
            os.environ["POCL_CACHE_DIR"] = before
        elif _cache is not None:
            del os.environ["POCL_CACHE_DIR"]


class _Invokers(dict[Any, Any]):
    """The code with which pyopencl calls kernels, kept in memory.

    pyopencl keeps it in a database on disk, and runs what it finds there: a damaged one raises errors of any kind.
    Making the code takes half a millisecond a kernel.
    """

    def store_if_not_present(self, key: Any, value: Any) -> None:
        """Keep `value`, as pyopencl's database does."""
        self.setdefault(key, value)


def _opencl() -> Any:
    """The pyopencl module; ImportError where it or its OpenCL library cannot be loaded."""
    _refuse_after_fork()
    if "pyopencl.invoker" in sys.modules:
        return sys.modules["pyopencl"]
    with _undisturbed():
        import pyopencl

        before = getattr(pyopencl, "_PYOPENCL_NO_CACHE", False)
        pyopencl._PYOPENCL_NO_CACHE = True  # else the import opens the database
        import pyopencl.invoker

        pyopencl.invoker.invoker_cache = _Invokers()  # type: ignore[assignment]
        pyopencl._PYOPENCL_NO_CACHE = before
    return pyopencl


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Let signals wait until the end of the `with` block.

    What a handler raises while pyopencl's extension starts, as for Ctrl-C, aborts the whole process.
    """
    if threading.current_thread() is not threading.main_thread():  # handlers run in the main thread
        yield
        return
    heard: list[int] = []
    before: dict[int, Any] = {}
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and callable(signal.getsignal(number)):
            before[number] = signal.signal(number, lambda number, frame: heard.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for number in heard[:1]:
        signal.raise_signal(number)


_lost: list[Any] | None = None
"""In a process that was forked from one that had used OpenCL: what it must never release. None elsewhere."""


def _refuse_after_fork() -> None:
    """Raise DeviceError in a process that was forked from one that had used OpenCL.

    The threads of a driver do not come along in a fork, so that any call could wait for them without end.
    """
    if _lost is not None:
        raise DeviceError(
            "this process was forked from one that had used OpenCL, whose drivers do not survive a fork: use spawn, as "
            'multiprocessing.get_context("spawn"), or use whitefurnace only in the forked processes'
        )


def _after_fork() -> None:
    """Close OpenCL in a forked process where its parent had used it."""
    global _lost, _lock
    _lock = threading.RLock()  # another thread of the parent may have held it
    if _listed is not None and _lost is None:
        # The devices are kept: to release them calls the driver too, and so does the end of a process.
        _lost = [_listed, list(_live), dict(_chosen)]
        _live.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


_lock = threading.RLock()
_listed: list[Any] | None = None
_cache: KernelCache | None = None
_chosen: dict[tuple[int, str], Device] = {}


def _kind(raw: Any) -> str:
    types = _opencl().device_type
    return "gpu" if raw.type & types.GPU else "cpu" if raw.type & types.CPU else "other"


def _preference(raw: Any) -> tuple[Any, ...]:
    """Sort key: GPUs (own memory, then most units), CPUs (PoCL, newest first, then Intel), others."""
    platform = raw.platform.name.lower()
    cpu_runtimes = ("portable computing language", "intel")
    runtime = next((n for n, word in enumerate(cpu_runtimes) if word in platform), len(cpu_runtimes))
    version = tuple(-int(part) for part in re.findall(r"\d+", raw.driver_version)[:3])
    kind = _kind(raw)
    if kind == "gpu":
        # Mesa's two drivers give a GPU that its vendor's own driver, where listed too, serves better.
        fallback = any(word in platform for word in ("rusticl", "clover", "portable"))
        return 0, fallback, bool(raw.host_unified_memory), -raw.max_compute_units
    return (1 if kind == "cpu" else 2), runtime, version


def _list_devices() -> list[Any]:
    """Every pyopencl device, in order of preference; empty without an OpenCL library or platform."""
    global _listed
    _refuse_after_fork()
    with _lock:
        if _listed is None:
            with _quiet():
                try:
                    cl = _opencl()
                    with _exposed_cache(), _exposed_runtimes():
                        found: list[tuple[Any, Any]] = []
                        for platform in cl.get_platforms():
                            with contextlib.suppress(Exception):  # a driver without a device may raise
                                found += [(_preference(raw), raw) for raw in platform.get_devices()]
                except Exception:  # ImportError, or a loader without a platform
                    return []
            _listed = [raw for _, raw in sorted(found, key=lambda pair: pair[0])]
        return _listed


def _label(raw: Any) -> str:
    return f"{raw.platform.name.strip()}: {raw.name.strip()}"


def _platform_names(raw: Any) -> str:
    """Return the name of a device's platform in lower case, and the name that its users give it."""
    name = str(raw.platform.name).strip().lower()
    return f"{name} pocl" if name.startswith("portable computing language") else name


def _address(raw: Any) -> str:
    """A name that finds this very device again in another process: its label, numbered where several share one."""
    alike = [other for other in _list_devices() if _label(other) == _label(raw)]
    return _label(raw) + (f" #{alike.index(raw) + 1}" if len(alike) > 1 else "")


def _refusal(error: BaseException, noise: Sequence[str]) -> str:
    """Return the reason of a failed probe in one line: the compiler's first error where there is one."""
    return _first_errors(str(error), noise, limit=1) or _first_line(error)


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0] or type(error).__name__


def _try(raw: Any) -> tuple[Device | None, str]:
    """Return the device, if a small program ran correctly on it, and the verdict."""
    key = (_list_devices().index(raw), os.environ.get("WHITEFURNACE_LANES", ""))
    with _lock:
        if key in _chosen:
            return _chosen[key], "works"
        with _quiet() as noise:
            try:
                device, failure = Device(raw), None
                device._probe(32)
            except UsageError:
                raise
            except Exception as error:
                failure = error
        if failure is not None:
            return None, _refusal(failure, noise)
        _chosen[key] = device
        return device, "works"


def find_devices() -> list[Candidate]:
    """List every OpenCL device, best first, each tried with a small kernel; an empty list without OpenCL.

    What drivers print is swallowed, and a device that fails says why in `verdict`. Raises UsageError for a
    WHITEFURNACE_LANES that is not 1, 4, 8 or 16.
    """
    candidates = []
    for index, raw in enumerate(_list_devices()):
        device, verdict = _try(raw)
        candidates.append(
            Candidate(
                index=index,
                name=raw.name.strip(),
                platform=raw.platform.name.strip(),
                driver=raw.driver_version.strip(),
                type=_kind(raw),
                verdict=verdict,
                fp64=device is not None and device.fp64,
            )
        )
    return candidates


def choose_device(name: str | None = None) -> Device:
    """Return the first device, best first, that gives right results; the same object for the whole process.

    name: an index of `find_devices` or a part of "platform: device" in any case; by default the variable
    WHITEFURNACE_DEVICE. Devices are tried only until one works. Raises UsageError where no device has that name, and
    DeviceError where none works.
    """
    if name is None:
        name = os.environ.get("WHITEFURNACE_DEVICE") or None
    listed = _list_devices()
    wanted = listed
    if name is not None and listed:
        text = name.strip().lower()
        addressed = [raw for raw in listed if _address(raw).lower() == text]
        if text.isdecimal() and int(text) < len(listed):
            wanted = [listed[int(text)]]
        elif addressed:
            wanted = addressed
        else:
            # Platforms first: "intel" means Intel's runtime, and not another one's device that is an Intel CPU.
            wanted = [raw for raw in listed if text in _platform_names(raw)] or [
                raw for raw in listed if text in _label(raw).lower() or text in _label(raw).lower().replace(":", "")
            ]
        if not wanted:
            there = ", ".join(f"{index} = {_label(raw)}" for index, raw in enumerate(listed))
            raise UsageError(f"no OpenCL device is called {name!r}; there are: {there}")
    refused = []
    for raw in wanted:
        device, verdict = _try(raw)
        if device is not None:
            return device
        refused.append(f"{_label(raw)} was refused ({verdict})")
    if not listed:
        refused = ["no OpenCL platform was found"]
    raise DeviceError(
        f"no OpenCL device {'called ' + repr(name) + ' ' if name else ''}works: {'; '.join(refused)}{advice()}"
    )


def advice() -> str:
    """Return the end of an error message where no device works: what to install, unless the cache has no room."""
    try:
        if _cache is not None:
            _cache.check_room()
    except DeviceError:
        return ""
    return f"; {INSTALL}"


def identities_in_use() -> list[dict[str, str]]:
    """Return the identity of each device that was chosen in this process. No driver is called."""
    return [device.identity() for device in _chosen.values()]


def device_address(name: str | None = None) -> str:
    """Return a name by which another process of this machine finds the device that `choose_device(name)` returns.

    An index, or the preference among several devices, may differ there; this name does not. Raises the errors of
    `choose_device`.
    """
    return choose_device(name).address


# ---------------------------------------------------------------------------------------------- running


class Buffer:
    """An array in the device's memory, made by `Device.array` or `Device.empty`."""

    def __init__(
        self, device: Device, memory: Any, shape: tuple[int, ...], dtype: np.dtype[Any], shared: np.ndarray | None
    ) -> None:
        self.device = device
        self.shape = shape
        self.dtype = dtype
        self.nbytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        self._memory = memory
        self._shared = shared  # the host array whose memory this is; kept alive here

    def read(self) -> np.ndarray:
        """Wait for all launches and return a copy, of `shape` and `dtype`. Raises DeviceError if a launch failed."""
        self.device.finish()
        values = np.empty(self.shape, self.dtype)
        if self.nbytes:
            with _translated(self.device, "reading a buffer"):
                _opencl().enqueue_copy(self.device._queue, values, self._memory, is_blocking=True)
        return values

    def write(self, values: np.ndarray) -> None:
        """Wait for all launches and copy `values`, which have the buffer's shape and dtype, into it.

        Raises ValueError for another shape or dtype, and DeviceError if a launch failed.
        """
        if values.shape != self.shape or values.dtype != self.dtype:
            raise ValueError(f"a buffer of {self.dtype} {self.shape} cannot take {values.dtype} {values.shape}")
        self.device.finish()
        values = np.ascontiguousarray(values)
        if self._shared is not None:  # the caller's array must not change: take memory of our own
            fresh = self.device._allocate(values.shape, values.dtype, values, writable=False, share=False)
            self._memory, self._shared = fresh._memory, None
        elif self.nbytes:
            with _translated(self.device, "writing a buffer"):
                _opencl().enqueue_copy(self.device._queue, self._memory, values, is_blocking=True)


class Kernel:
    """A kernel of a program. `kernel(global_size, *args)` is `device.launch(kernel, global_size, args)`."""

    def __init__(self, device: Device, raw: Any, name: str) -> None:
        self.device = device
        self.name = name
        self._raw = raw
        with _translated(device, f"kernel {name}"):
            self.work_group_limit = int(
                raw.get_work_group_info(_opencl().kernel_work_group_info.WORK_GROUP_SIZE, device._raw)
            )

    def __call__(
        self, global_size: tuple[int, ...], *args: Buffer | np.generic | None, local_size: tuple[int, ...] | None = None
    ) -> None:
        self.device.launch(self, global_size, args, local_size)


class Program:
    """A built program, made by `Device.build`."""

    def __init__(self, device: Device, raw: Any) -> None:
        self.device = device
        self._raw = raw
        self._kernels: dict[str, Kernel] = {}

    def kernel(self, name: str) -> Kernel:
        """Return the kernel called `name`, the same object every time. Raises DeviceError where there is none."""
        if name not in self._kernels:
            with _translated(self.device, f"kernel {name}"):
                raw = _opencl().Kernel(self._raw, name)
            self._kernels[name] = Kernel(self.device, raw, name)
        return self._kernels[name]


@contextlib.contextmanager
def _translated(device: Device, doing: str) -> Iterator[None]:
    """Turn pyopencl's errors into DeviceError."""
    try:
        yield
    except _opencl().Error as error:
        raise DeviceError(f"{device.name} failed at {doing}: {_first_line(error)}") from error


def _first_errors(log: str, noise: Sequence[str] = (), limit: int = 3) -> str:
    """Return the first lines of a compiler's log that report an error, joined by "; ", or nothing."""
    lines = [line.strip() for line in [*log.splitlines(), *noise]]
    errors = [line for line in lines if re.search(r"\b(fatal )?error:", line, re.IGNORECASE)]
    return "; ".join(dict.fromkeys(errors[:limit]))


def _define(name: str, value: int | float | str) -> str:
    if isinstance(value, (bool, np.bool_)):
        value = int(value)
    return f"-D{name}={value}"


class Device:
    """An OpenCL device with an in-order queue. `choose_device` makes it after it has seen it give a right answer.

    name, platform, driver, version: the driver's words. type: "gpu", "cpu" or "other".
    vectors: T, the vectors of W lanes of one work item.
    local_size, scalar_size: work items of a group along the first axis; the second where items are small and scalar.
    orbits: groups of outputs that share what `octahedral.cl` reads.
    max_allocation, global_memory: bytes.
    seconds: the time for which kernels have run, up to date after `finish` and `Buffer.read`.

    The variable WHITEFURNACE_LANES (1, 4, 8 or 16) overrides the number of lanes.
    """

    def __init__(self, raw: Any) -> None:
        cl = _opencl()
        self._raw = raw
        self.name: str = raw.name.strip()
        self.platform: str = raw.platform.name.strip()
        self.driver: str = raw.driver_version.strip()
        self.version: str = raw.version.strip()
        self.type: str = _kind(raw)
        self._is_pocl = _platform_names(raw).endswith(" pocl")
        self.max_allocation = int(raw.max_mem_alloc_size)
        self.global_memory = int(raw.global_mem_size)
        self.seconds = 0.0
        self._lanes = self._float_lanes()
        tuning = TUNING[f"cpu{self._lanes}" if self.type == "cpu" or self._lanes > 1 else self.type]
        self.vectors = tuning.vectors
        most = min(int(raw.max_work_group_size), int(raw.max_work_item_sizes[0]))
        self.local_size = min(tuning.local_size, most)
        self.scalar_size = min(tuning.scalar_size, most)
        self.orbits = tuning.orbits
        self._alignment = max(int(raw.mem_base_addr_align) // 8, 64)
        self._fp64: bool | None = None
        self._programs: dict[tuple[str, str], Program] = {}
        self._pending: list[tuple[Any, Any]] = []
        self._lock = threading.RLock()
        with _translated(self, "making a context"):
            self._context = cl.Context([raw])
            self._queue = cl.CommandQueue(self._context, raw, properties=cl.command_queue_properties.PROFILING_ENABLE)
        _live.add(self)

    def __repr__(self) -> str:
        return f"<Device {self.platform}: {self.name}>"

    def _float_lanes(self) -> int:
        forced = os.environ.get("WHITEFURNACE_LANES")
        if forced:
            if forced not in ("1", "4", "8", "16"):
                raise UsageError(f"WHITEFURNACE_LANES is {forced!r}; allowed: 1, 4, 8, 16")
            return int(forced)
        if self.type != "cpu":
            return 1
        # Intel's *preferred* width is 1, which asks for its own vectoriser; the native one is the hardware's.
        native = int(self._raw.native_vector_width_float)
        return next((lanes for lanes in (16, 8) if native >= lanes), 4)

    @property
    def fp64(self) -> bool:
        """True if float64 kernels give right results; tried at the first use."""
        if self._fp64 is None:
            self._fp64 = False
            if "cl_khr_fp64" in self._raw.extensions.split() or self._raw.double_fp_config:
                with _lock, _quiet(), contextlib.suppress(Exception):
                    self._probe(64)
                    self._fp64 = True
        return self._fp64

    def lanes(self, precision: int = 32) -> int:
        """Return W, the number of lanes of a vector: 1 on a GPU; on a CPU 16, 8 or 4, and half as many for 64 bits.

        precision: 32 or 64 bits. Raises UnsupportedError where the device has no correct float64.
        """
        if precision == 32:
            return self._lanes
        if precision != 64:
            raise UsageError(f"precision {precision} is not one of 32, 64")
        if not self.fp64:
            raise UnsupportedError(f"{self.name} has no float64; use --precision 32 or another device")
        return max(self._lanes // 2, 1)

    @property
    def address(self) -> str:
        """Name by which `choose_device` finds this very device in another process of this machine."""
        return _address(self._raw)

    def identity(self) -> dict[str, str]:
        """Return the facts of the device that a manifest records: name, platform, driver, version and type."""
        return {
            "name": self.name,
            "platform": self.platform,
            "driver": self.driver,
            "version": self.version,
            "type": self.type,
        }

    def build(self, text: str, options: Mapping[str, int | float | str] | None = None) -> Program:
        """Build OpenCL C 1.2 `text` and return the program; the same text and options return the same object.

        options: values by name, each passed as -D. Floats are written as Python writes them, without a suffix. Raises
        DeviceError with the compiler's first errors, InputError where they are about a user's model file.
        """
        cl = _opencl()  # refused in a forked process before the lock, which a thread of the parent may have held
        # No fast-math: explicit lanes gain nothing by it and compensated sums break under it.
        flags = ["-cl-std=CL1.2", *(_define(name, value) for name, value in sorted((options or {}).items()))]
        key = (text, " ".join(flags))
        with self._lock:
            if key not in self._programs:
                if _cache is not None and self._is_pocl:
                    _cache.check_room()
                with _quiet() as noise:
                    failure = None
                    try:
                        # Drivers without a cache of their own are given pyopencl's.
                        folder = str(_cache.folder / "pyopencl") if _cache is not None else None
                        raw = cl.Program(self._context, text).build(flags, devices=[self._raw], cache_dir=folder)
                    except (cl.Error, OSError) as error:
                        failure = error
                if failure is not None:
                    if MARK in text and (complaint := about_user_file([*str(failure).splitlines(), *noise])):
                        raise InputError(complaint) from failure
                    why = _first_errors(str(failure), noise) or _first_line(failure)
                    raise DeviceError(f"a kernel did not build on {self.name}: {why}") from failure
                self._programs[key] = Program(self, raw)
            return self._programs[key]

    def _allocate(
        self, shape: tuple[int, ...], dtype: np.dtype[Any], values: np.ndarray | None, *, writable: bool, share: bool
    ) -> Buffer:
        cl = _opencl()
        nbytes = math.prod(map(int, shape)) * dtype.itemsize
        if nbytes > self.max_allocation:
            raise DeviceError(
                f"a buffer of {nbytes / 2**20:.1f} MiB is above the largest that {self.name} "
                f"takes, {self.max_allocation / 2**20:.1f} MiB"
            )
        flags = cl.mem_flags.READ_WRITE if writable else cl.mem_flags.READ_ONLY
        try:
            if values is None or not nbytes:
                memory = cl.Buffer(self._context, flags, size=max(nbytes, 1))
            else:
                flags |= cl.mem_flags.USE_HOST_PTR if share else cl.mem_flags.COPY_HOST_PTR
                memory = cl.Buffer(self._context, flags, hostbuf=values)
        except cl.Error as error:
            raise DeviceError(f"{self.name} has no room for a buffer of {nbytes / 2**20:.1f} MiB") from error
        return Buffer(self, memory, shape, dtype, values if share else None)

    def array(self, values: np.ndarray, *, writable: bool = False) -> Buffer:
        """Return a buffer that holds `values`. Kernels may read it, and with `writable` write it too.

        On a CPU a contiguous array at an aligned address (see `aligned_empty`) is not copied unless `writable`: do not
        change it while the buffer exists. Raises DeviceError where there is not enough memory.
        """
        values = np.ascontiguousarray(values).reshape(np.shape(values))
        share = self.type == "cpu" and not writable and values.nbytes > 0 and values.ctypes.data % self._alignment == 0
        return self._allocate(values.shape, values.dtype, values, writable=writable, share=share)

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Buffer:
        """Return a buffer with undefined values, for kernels to write. Raises DeviceError where there is not enough
        memory.
        """
        shape = (int(shape),) if isinstance(shape, (int, np.integer)) else tuple(int(n) for n in shape)
        return self._allocate(shape, np.dtype(dtype), None, writable=True, share=False)

    def aligned_empty(self, shape: int | tuple[int, ...], dtype: Any) -> np.ndarray:
        """Return a host array with undefined values, aligned so that `array` need not copy it on a CPU."""
        dtype = np.dtype(dtype)
        nbytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        raw = np.empty(nbytes + self._alignment, np.uint8)
        start = -raw.ctypes.data % self._alignment
        return raw[start : start + nbytes].view(dtype).reshape(shape)

    def launch(
        self,
        kernel: Kernel,
        global_size: tuple[int, ...],
        args: Sequence[Buffer | np.generic | None],
        local_size: tuple[int, ...] | None = None,
    ) -> None:
        """Enqueue `kernel` over exactly `global_size` work items.

        args: buffers of this device, numpy scalars of the kernel's types, or None for a null pointer. local_size: by
        default `(self.local_size, 1, …)`; the global size must be a multiple of it. Raises DeviceError where the
        runtime refuses; a failure while the kernel runs is raised by a later call.
        """
        first, *rest = local_size or (self.local_size, *(1,) * (len(global_size) - 1))
        while first > max(kernel.work_group_limit, 1):  # halves still divide a padded global size
            first //= 2
        local_size = (first, *rest)
        if any(n % m or n < 1 for n, m in zip(global_size, local_size, strict=True)):
            raise DeviceError(
                f"kernel {kernel.name}: the global size {global_size} is not a multiple of the local size {local_size}"
            )
        _refuse_after_fork()
        with self._lock, _translated(self, f"kernel {kernel.name}"):
            kernel._raw.set_args(*(arg._memory if isinstance(arg, Buffer) else arg for arg in args))
            event = _opencl().enqueue_nd_range_kernel(self._queue, kernel._raw, global_size, local_size)
            # With the event go the arguments: a buffer may share the memory of an array nobody else holds.
            self._pending.append((event, tuple(args)))
            if len(self._pending) >= QUEUE_DEPTH:
                self._settle(QUEUE_DEPTH // 2)

    def _settle(self, count: int) -> None:
        """Wait for the oldest `count` launches and add their times."""
        while count > 0 and self._pending:
            event = self._pending[0][0]
            try:
                event.wait()
                self.seconds += (event.profile.end - event.profile.start) * 1e-9
            finally:
                del self._pending[0]
            count -= 1

    def finish(self) -> None:
        """Wait until all launches are done. Raises DeviceError where one failed."""
        _refuse_after_fork()
        with self._lock, _translated(self, "running a kernel"):
            self._settle(len(self._pending))
            self._queue.finish()

    def _probe(self, precision: int) -> None:
        """Build and run a small kernel. Raises DeviceError unless it gives the right result."""
        scalar = np.dtype(f"f{precision // 8}").type
        lanes = self._lanes if precision == 32 else max(self._lanes // 2, 1)
        program = self.build(_probe_text(), {"SCALAR": "float" if precision == 32 else "double", "W": lanes})
        items, terms, a, bend = 2 * self.local_size, 8, 0.75, 20.0
        x = np.linspace(0.5, 30, items * lanes).astype(scalar)
        result = self.empty(x.shape, scalar)
        self.launch(
            program.kernel("probe"), (items,), [self.array(x), result, scalar(a), scalar(bend), np.int32(terms)]
        )
        total = a * np.sqrt(x.astype(np.float64)[:, None] + np.arange(terms)).sum(1)
        wanted = np.where(total > bend, 1 / total, total)
        # Roots of at most 3 ulp, the roundings of their sum and a division of 2.5 ulp (OpenCL 1.2, 7.4).
        error = np.max(np.abs(result.read() / wanted - 1))
        if not error <= 16 * np.finfo(scalar).eps:
            raise DeviceError(f"a small float{precision} kernel gave a wrong answer, off by {error:.1e}")
        self.seconds = 0.0


def _probe_text() -> str:
    package = Path(__file__).resolve().parents[1]
    # In an installed package the kernels are a subpackage; in a checkout they are at the top of the tree.
    folder = package / "kernels" if (package / "kernels").is_dir() else package.parents[1] / "kernels"
    return (folder / "probe.cl").read_text(encoding="utf-8")


_live: weakref.WeakSet[Device] = weakref.WeakSet()


@atexit.register
def _drain() -> None:
    """Wait for running kernels before the driver is unloaded: PoCL's threads crash otherwise."""
    for device in list(_live):
        with contextlib.suppress(Exception):
            device.finish()
    if _cache is not None and _lost is None:
        _cache.close()
