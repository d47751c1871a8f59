"""Devices: only those that give right answers are chosen, and what runs on them is what was asked for."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from whitefurnace.errors import DeviceError, UnsupportedError, UsageError
from whitefurnace.opencl import device as devices
from whitefurnace.opencl.device import Device, choose_device, device_address, find_devices

SCALE = """
kernel void scale(global const float *x, global float *y, float factor, global const float *offset)
{
    const size_t i = get_global_id(0);
    y[i] = x[i] * FACTOR * factor + (offset ? offset[i] : 0.0f);
}
"""


@pytest.fixture
def fresh(monkeypatch):
    """No device chosen yet, and no default from the caller's shell."""
    monkeypatch.setattr(devices, "_chosen", {})
    monkeypatch.delenv("WHITEFURNACE_DEVICE", raising=False)
    monkeypatch.delenv("WHITEFURNACE_LANES", raising=False)


def numbers(device: Device, count: int = 256) -> np.ndarray:
    return np.arange(count, dtype=np.float32)


# ------------------------------------------------------------------------------------------- finding


def test_candidates_are_numbered_and_one_works():
    found = find_devices()
    assert [c.index for c in found] == list(range(len(found)))
    assert any(c.works for c in found), found
    for c in found:
        assert c.name and c.platform and c.type in ("gpu", "cpu", "other")
        assert c.verdict and "\n" not in c.verdict
    order = ["gpu", "cpu", "other"]
    assert [c.type for c in found] == sorted((c.type for c in found), key=order.index)


def test_the_default_is_the_first_that_works_and_is_kept(fresh):
    first = next(c for c in find_devices() if c.works)
    assert choose_device() is choose_device() is choose_device(str(first.index))
    assert (choose_device().name, choose_device().platform) == (first.name, first.platform)


def test_a_name_is_any_part_in_any_case(device, monkeypatch):
    first = next(c for c in find_devices() if device.platform == c.platform)
    for name in (device.platform.upper(), f"{device.platform} {device.name}"[3:], str(first.index)):
        assert choose_device(name).platform == device.platform
        monkeypatch.setenv("WHITEFURNACE_DEVICE", name)
        assert choose_device().platform == device.platform


def test_an_unknown_name_lists_what_there_is():
    with pytest.raises(UsageError, match="no OpenCL device is called 'abacus'; there are: 0 = "):
        choose_device("abacus")
    with pytest.raises(UsageError, match="'999'"):
        choose_device("999")


def test_a_platform_comes_before_a_device_of_that_name(fresh, monkeypatch):
    """`intel` is Intel's runtime, although the device of the other, preferred platform is an Intel CPU."""

    def listed(platform, name):
        return SimpleNamespace(platform=SimpleNamespace(name=platform), name=name)

    pocl = listed("Portable Computing Language", "cpu-skylake-Intel(R) Xeon(R)")
    intel = listed("Intel(R) OpenCL", "Intel(R) Xeon(R)")
    monkeypatch.setattr(devices, "_listed", [pocl, intel])
    monkeypatch.setattr(devices, "_try", lambda raw: (raw, "works"))
    for name in ("intel", "Intel(R) OpenCL: Intel(R) Xeon(R)"):
        assert choose_device(name) is intel
    assert (
        choose_device("pocl") is choose_device("portable") is choose_device("skylake") is choose_device("xeon") is pocl
    )
    monkeypatch.setattr(devices, "_listed", [pocl])
    assert choose_device("intel") is pocl  # nothing else is called that


FORK = """
import multiprocessing, os, signal, sys
import numpy as np
import whitefurnace

def albedo(NoV):
    signal.alarm(60)  # what hangs dies
    try:
        return float(whitefurnace.integrate("albedo", ndf="ggx", NoV=NoV, alpha=0.3).values)
    except Exception as error:
        return f"{type(error).__name__}: {error}"

if __name__ == "__main__":
    parent = albedo(0.5) if "used" in sys.argv else None
    with multiprocessing.get_context(sys.argv[1]).Pool(2) as pool:
        for found in pool.map(albedo, [0.5, 0.5, 0.5]):
            print(found)
    print(parent)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_fork_after_use_is_refused_at_once_and_before_it_works(tmp_path):
    script = tmp_path / "pool.py"
    script.write_text(FORK)

    def lines(*argv):
        done = subprocess.run([sys.executable, script, *argv], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    used = lines("fork", "used")
    assert len(used) == 4 and 0 < float(used.pop()) < 1
    assert all(line.startswith("DeviceError: ") and "use spawn" in line for line in used)
    fresh = lines("fork")
    assert fresh.pop() == "None" and len({float(line) for line in fresh}) == 1
    spawned = lines("spawn", "used")
    assert len(set(spawned)) == 1 and 0 < float(spawned[0]) < 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_drops_what_its_parent_held(device):
    """Every call of a device that the parent made is refused, and the process ends without a call of the driver."""
    buffer = device.array(numbers(device))
    kernel = device.build(SCALE, {"FACTOR": 2}).kernel("scale")
    calls = [
        buffer.read,
        device.finish,
        choose_device,
        find_devices,
        lambda: device.empty(4, np.float32),
        lambda: device.build(SCALE, {"FACTOR": 3}),
        lambda: kernel((256,), buffer, buffer, np.float32(1), None),
    ]
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        refused = 0
        for call in calls:
            try:
                call()
            except DeviceError as error:
                refused += "use spawn" in str(error)
        devices._drain()
        os.write(write, bytes([refused]))
        os._exit(0)
    os.close(write)
    assert os.read(read, 1) == bytes([len(calls)])
    assert os.waitpid(child, 0)[1] == 0


def test_no_opencl_at_all(fresh, monkeypatch):
    def missing():
        raise ImportError("libOpenCL.so.1: cannot open shared object file")

    monkeypatch.setattr(devices, "_listed", None)
    monkeypatch.setattr(devices, "_opencl", missing)
    assert find_devices() == []
    with pytest.raises(DeviceError, match=r"no OpenCL platform was found.*whitefurnace\[pocl\].*pocl-open"):
        choose_device()


@pytest.mark.parametrize(
    "spoil, verdict",
    [
        (lambda text: text.replace("sqrt(v", "sqrt(v + (SCALAR)1.0e-3"), "wrong answer"),
        (lambda text: text.replace("sum > (real)(bend)", "sum < (real)(bend)"), "wrong answer"),
        (lambda text: text.replace("fma(", "no_such_function("), "no_such_function"),
        (lambda text: text.replace("void probe", "void prove"), "probe"),
    ],
)
def test_a_device_that_fails_the_probe_is_refused_with_the_reason(fresh, monkeypatch, capfd, spoil, verdict):
    spoilt = spoil(devices._probe_text())
    assert spoilt != devices._probe_text()
    monkeypatch.setattr(devices, "_probe_text", lambda: spoilt)
    for c in find_devices():
        assert not c.works and not c.fp64
    assert verdict in next(iter(find_devices())).verdict
    with pytest.raises(DeviceError, match=r"was refused \(.*whitefurnace\[intel\]") as error:
        choose_device()
    assert "\n" not in str(error.value)
    assert capfd.readouterr().err == ""


def test_the_next_device_is_tried(fresh, monkeypatch):
    listed = devices._list_devices()
    working = next(c for c in find_devices() if c.works)
    tried = []
    honest = devices._try

    def first_refused(raw):
        tried.append(raw)
        return (None, "broken") if len(tried) == 1 else honest(raw)

    monkeypatch.setattr(devices, "_listed", [listed[working.index], listed[working.index], *listed])
    monkeypatch.setattr(devices, "_try", first_refused)
    assert choose_device().name == working.name
    assert len(tried) == 2, "the search goes on after the first that works"


def test_a_pip_runtime_joins_the_system_s(monkeypatch, tmp_path):
    library = tmp_path / "libintelocl.so"
    monkeypatch.setattr(devices, "_pip_runtimes", lambda: [library])
    monkeypatch.delenv("OCL_ICD_VENDORS", raising=False)
    with devices._exposed_runtimes():
        folder = Path(os.environ["OCL_ICD_VENDORS"])
        texts = {path.read_text().strip() for path in folder.glob("*.icd")}
        assert str(library) in texts
        assert {path.read_text().strip() for path in Path("/etc/OpenCL/vendors").glob("*.icd")} <= texts
    assert "OCL_ICD_VENDORS" not in os.environ and not folder.exists()


def test_the_user_s_own_vendors_are_left_alone(monkeypatch, tmp_path):
    monkeypatch.setattr(devices, "_pip_runtimes", lambda: [tmp_path / "libintelocl.so"])
    monkeypatch.setenv("OCL_ICD_VENDORS", "mine")
    with devices._exposed_runtimes():
        assert os.environ["OCL_ICD_VENDORS"] == "mine"
    assert os.environ["OCL_ICD_VENDORS"] == "mine"


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_ctrl_c_waits_while_pyopencl_starts():
    """pyopencl's extension aborts the process if a handler raises while it starts."""
    steps = []
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            with devices._undisturbed():
                signal.raise_signal(signal.SIGINT)
                steps.append("whole")
            steps.append("never")
        assert steps == ["whole"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_importing_the_module_does_not_import_pyopencl():
    code = "import sys, whitefurnace.opencl.device; sys.exit('pyopencl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


# ------------------------------------------------------------------------------------------ a device


def test_lanes(device):
    if device.type == "gpu" and "WHITEFURNACE_LANES" not in os.environ:
        assert (device.lanes(), device.local_size > 1) == (1, True)
    assert device.lanes(32) in (1, 4, 8, 16)
    if device.fp64:
        assert device.lanes(64) == max(device.lanes(32) // 2, 1)
    assert device.local_size == 1 or device.lanes() == 1
    with pytest.raises(UsageError, match="precision 16"):
        device.lanes(16)


@pytest.mark.parametrize("lanes", [1, 4, 8, 16])
def test_forced_lanes_give_right_answers(fresh, monkeypatch, lanes):
    index = next(c.index for c in find_devices() if c.works)
    monkeypatch.setenv("WHITEFURNACE_LANES", str(lanes))
    forced = choose_device(str(index))  # its probe runs with these lanes
    assert forced.lanes() == lanes
    if lanes == 1 and forced.type == "cpu":
        assert (forced.vectors, forced.local_size) == (1, 16)


def test_forced_lanes_out_of_range(fresh, monkeypatch):
    monkeypatch.setenv("WHITEFURNACE_LANES", "3")
    with pytest.raises(UsageError, match="WHITEFURNACE_LANES is '3'; allowed: 1, 4, 8, 16"):
        choose_device()


def test_no_float64(device, monkeypatch):
    monkeypatch.setattr(device, "_fp64", False)
    with pytest.raises(UnsupportedError, match="no float64"):
        device.lanes(64)


def test_identity_is_plain_text(device):
    assert set(device.identity()) == {"name", "platform", "driver", "version", "type"}
    assert all(isinstance(value, str) and value for value in device.identity().values())
    assert device.max_allocation > 2**20 and device.global_memory >= device.max_allocation


# ----------------------------------------------------------------------------------------- programs


def test_a_program_and_its_kernels_are_kept(device):
    program = device.build(SCALE, {"FACTOR": 2})
    assert program is device.build(SCALE, {"FACTOR": 2}) is not device.build(SCALE, {"FACTOR": 3})
    assert program.kernel("scale") is program.kernel("scale")
    with pytest.raises(DeviceError, match="kernel shrink"):
        program.kernel("shrink")


def test_a_build_error_is_one_line_and_names_the_source(device, capfd):
    with pytest.raises(DeviceError, match=r"did not build on .*lobe\.clh.*no_such_function") as error:
        device.build('#line 7 "lobe.clh"\nkernel void f(global float *x) { x[0] = no_such_function(1); }')
    assert "\n" not in str(error.value)
    assert capfd.readouterr().err == ""


def test_launches_compute_what_was_asked(device):
    x = numbers(device)
    result = device.empty(x.shape, x.dtype)
    kernel = device.build(SCALE, {"FACTOR": "2.0f"}).kernel("scale")
    kernel(x.shape, device.array(x), result, np.float32(0.5), None)
    assert np.array_equal(result.read(), x)
    device.launch(kernel, x.shape, [device.array(x), result, np.float32(1), device.array(x)], (2,))
    assert np.array_equal(result.read(), 3 * x)


def test_time_is_counted_and_events_do_not_pile_up(device):
    x = numbers(device)
    kernel, result = device.build(SCALE, {"FACTOR": 2}).kernel("scale"), device.empty(x.shape, x.dtype)
    source, before = device.array(x), device.seconds
    for _ in range(100):
        kernel(x.shape, source, result, np.float32(1), None)
        assert len(device._pending) < devices.QUEUE_DEPTH
    device.finish()
    assert not device._pending
    assert 0 < device.seconds - before < 10


def test_an_argument_outlives_its_last_name(device):
    """The memory of a shared array must not be freed under a kernel that waits in the queue."""
    x = device.aligned_empty(2**20, np.float32)
    x[:] = 1
    kernel, result = device.build(SCALE, {"FACTOR": 2}).kernel("scale"), device.empty(x.shape, x.dtype)
    kernel(x.shape, device.array(x), result, np.float32(1), None)
    del x
    trash = np.full(2**20, 7, np.float32)
    assert np.all(result.read() == 2), trash[0]


def test_wrong_launches_are_device_errors(device):
    x = numbers(device)
    kernel, result = device.build(SCALE, {"FACTOR": 2}).kernel("scale"), device.empty(x.shape, x.dtype)
    with pytest.raises(DeviceError, match=r"kernel scale: the global size \(255,\) is not a multiple"):
        device.launch(kernel, (255,), [device.array(x), result, np.float32(1), None], (2,))
    with pytest.raises(DeviceError, match="kernel scale"):
        kernel(x.shape, device.array(x), result, np.float64(1), None)


# ------------------------------------------------------------------------------------------ buffers


@pytest.mark.parametrize("shape", [(), (1,), (0, 3), (5, 4, 3)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, np.uint8])
def test_arrays_survive_the_round_trip(device, shape, dtype):
    values = np.random.default_rng(1).integers(0, 99, shape).astype(dtype)
    for buffer in (device.array(values), device.array(values, writable=True)):
        assert (buffer.shape, buffer.dtype, buffer.nbytes) == (values.shape, values.dtype, values.nbytes)
        assert np.array_equal(buffer.read(), values) and buffer.read().dtype == dtype
        buffer.write(values + dtype(1))
        assert np.array_equal(buffer.read(), values + dtype(1))


def test_strided_arrays_are_taken_by_value(device):
    values = np.arange(24, dtype=np.float32).reshape(4, 6)[::2, ::-2]
    assert np.array_equal(device.array(values).read(), values)


def test_a_caller_s_array_is_never_written(device):
    values = device.aligned_empty((64, 4), np.float32)
    assert values.shape == (64, 4) and values.flags.c_contiguous
    values[:] = 3
    buffer = device.array(values)
    assert (buffer._shared is not None) == (device.type == "cpu")
    buffer.write(values + 1)
    assert np.all(values == 3) and np.all(buffer.read() == 4)
    assert device.array(values, writable=True)._shared is None


def test_a_buffer_refuses_another_shape(device):
    with pytest.raises(ValueError, match=r"float32 \(3,\) cannot take float32 \(4,\)"):
        device.empty(3, np.float32).write(np.zeros(4, np.float32))


def test_a_buffer_too_large_says_so(device):
    with pytest.raises(DeviceError, match=r"a buffer of [\d.]+ MiB is above the largest"):
        device.empty(device.max_allocation + 1, np.uint8)


def test_an_address_finds_the_very_device(device):
    assert choose_device(device.address) is device
    assert device_address(device.address) == device.address


def test_devices_that_are_called_alike_have_addresses_of_their_own(monkeypatch):
    class Raw:  # compared by identity, as pyopencl compares devices
        platform = SimpleNamespace(name="Vendor ")

        def __init__(self, name):
            self.name = name

    twins, other = [Raw("GPU"), Raw("GPU")], Raw("CPU")
    monkeypatch.setattr(devices, "_list_devices", lambda: [*twins, other])
    monkeypatch.setattr(devices, "_try", lambda raw: (raw, "works"))
    addresses = [devices._address(raw) for raw in (*twins, other)]
    assert addresses == ["Vendor: GPU #1", "Vendor: GPU #2", "Vendor: CPU"]
    for raw, address in zip((*twins, other), addresses, strict=True):
        assert choose_device(address) is raw
