"""Benchmarks run, count what they say they count, and say it as they should; how fast anything is is nobody's test."""

from __future__ import annotations

import importlib.util
import json
import math
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from whitefurnace import plot_style
from whitefurnace.benching import throughput as benching
from whitefurnace.benching import tradeoff
from whitefurnace.benching.figures import draw_tradeoff
from whitefurnace.benching.throughput import CASES, FLOPS, BenchMeter, Spread
from whitefurnace.benching.tradeoff import Cost, Missed, Point
from whitefurnace.cli import bench as printed
from whitefurnace.errors import UsageError
from whitefurnace.files import read_image, write_exr
from whitefurnace.opencl import source
from whitefurnace.opencl.device import Device
from whitefurnace.sphere.environments import environment

ROOT = Path(__file__).resolve().parents[2]
KERNELS = ROOT / "kernels"
NO_CASE = {"probe.cl", "yardstick.cl"}  # whether a device works, and what cases are held against
# Fast but still enough groups for all cores: what is measured is not looked at.
LEAST, BYTES = 1e-5, 1 << 16


@pytest.fixture(scope="module")
def meter(device: Device) -> BenchMeter:
    return BenchMeter(device, LEAST, BYTES)


def run(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "whitefurnace", "bench", *arguments], cwd=cwd, capture_output=True, text=True
    )


# ---------------------------------------------------------------------------------------------- yardsticks


@pytest.mark.parametrize("precision", [32, 64])
def test_multiply_adds_are_done(device: Device, precision: int) -> None:
    """Every chain x <- x/2 + ¼ ends at ½ whatever it starts from: 12 of them are 6."""
    if precision == 64 and not device.fp64:
        pytest.skip("no float64")
    lanes, kind = device.lanes(precision), np.dtype(f"f{precision // 8}")
    kernel = device.build(source.yardstick().text, {"W": lanes, "T": 1, "PRECISION": precision}).kernel("multiply_add")
    items = 4 * device.local_size
    for rounds, part in ((0, None), (1, 2.0**-4), (16, 0.0)):  # a round halves the distance four times
        start = np.linspace(1, 2, benching.CHAINS * lanes)
        out = device.empty((items, lanes), kind)
        device.launch(
            kernel, (items,), (out, np.int32(rounds), kind.type(0.5), kind.type(0.25), device.array(start.astype(kind)))
        )
        away = (start.reshape(benching.CHAINS, lanes) - 0.5).sum(0)
        want = 6 + away * (1 if part is None else part)
        # 12 terms, each rounded a few times; the last distance is 2^-64.
        assert np.abs(out.read() - want).max() <= 64 * np.finfo(kind).eps * want.max(), (precision, rounds)


def test_memory_is_read_and_streamed_whole(device: Device) -> None:
    """The sum of an array of small whole numbers is exact, and a triad of them too."""
    lanes, items, count = device.lanes(), 4 * device.local_size, 8
    program = device.build(source.yardstick().text, {"W": lanes, "T": 1, "PRECISION": 32})
    a, b = (np.random.default_rng(seed).integers(0, 99, items * count * lanes).astype(np.float32) for seed in (1, 2))
    sums, triad = device.empty((items, lanes), np.float32), device.empty(a.shape, np.float32)
    on_a, on_b = device.array(a), device.array(b)
    device.launch(program.kernel("read"), (items,), (sums, np.int32(count), on_a))
    assert sums.read().sum(dtype=np.float64) == a.sum(dtype=np.float64)
    device.launch(program.kernel("triad"), (items,), (triad, np.int32(count), np.float32(0.5), on_a, on_b))
    assert (triad.read() == a + np.float32(0.5) * b).all()


def test_a_yardstick_is_measured(meter: BenchMeter) -> None:
    found = meter.yardstick()
    assert set(found.peak) == set(meter.precisions)
    for spread in (*found.peak.values(), found.read, found.triad):
        assert 0 < spread.low <= spread.median <= spread.high < math.inf


# ---------------------------------------------------------------------------------------------- kernels


def test_every_kernel_has_a_case() -> None:
    files = {path.name for path in KERNELS.glob("*.cl")}
    assert {case.kernel for case in CASES} == files - NO_CASE, "benching.CASES wants an entry for each kernel"
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names) and set(FLOPS) <= set(names)


@pytest.mark.few(4)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_case_is_measured(device: Device, meter: BenchMeter, case: benching.Case) -> None:
    rows = list(benching.throughput([case], device, meter, runs=2))
    assert [row.precision for row in rows] == [p for p in case.precisions if p in meter.precisions]
    for row in rows:
        assert row.case == case.name and row.runs == 2 and row.seconds > 0
        assert 0 < row.rate.low <= row.rate.median <= row.rate.high < math.inf
        assert (row.gflops is None) == (case.name not in FLOPS) == (row.of_peak is None)
        for figure in (row.gflops, row.of_peak, row.gbytes, row.of_memory):
            assert figure is None or 0 < figure < math.inf
        if row.gflops is not None:
            assert row.gflops == pytest.approx(FLOPS[case.name] * row.rate.median / 1e9)


@pytest.mark.few(8)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_twice_the_scale_is_twice_the_work_at_least(device: Device, case: benching.Case) -> None:
    for precision in case.precisions:
        if precision == 64 and not device.fp64:
            continue
        one, two = (case.make(device, precision, scale) for scale in (1, 2))
        # Numbers of outputs are rounded up to whole work items.
        assert one.units > 0 and two.units >= 1.5 * one.units and two.nbytes > 0, case.name


def test_names() -> None:
    assert benching.cases(()) == CASES
    assert [c.name for c in benching.cases(("dfg", "convolve", "dfg"))] == ["dfg", "convolve"]
    with pytest.raises(UsageError, match="unknown benchmark 'convolv'; did you mean 'convolve'"):
        benching.cases(("convolv",))
    with pytest.raises(UsageError, match="did you mean 'tradeoff'"):
        benching.cases(("tradeof",))
    with pytest.raises(UsageError, match="tradeoff stands alone"):
        benching.cases(("dfg", "tradeoff"))


# ---------------------------------------------------------------------------------------------- the front


@pytest.mark.parametrize(
    "points, front",
    [
        ([], []),
        ([(1, 1)], [0]),
        ([(1, 4), (2, 3), (3, 3.5), (4, 1), (0.5, 9)], [4, 0, 1, 3]),  # (3, 3.5) is slower and worse than (2, 3)
        ([(1, 1), (1, 1)], [0]),  # equal ones: the first
        ([(1, 2), (1, 1)], [1]),  # as fast and better
        ([(1, 1), (2, 1)], [0]),  # as good and slower
        ([(1, math.nan), (math.nan, 0), (2, 1), (math.inf, 0)], [2]),
    ],
)
def test_front(points: list[tuple[float, float]], front: list[int]) -> None:
    assert tradeoff.front(points) == front


def test_front_is_what_nothing_beats() -> None:
    """Against the definition, over all pairs."""
    points = [tuple(p) for p in np.random.default_rng(3).integers(0, 30, (200, 2)).tolist()]
    found = tradeoff.front(points)
    beaten = {k for k, (x, y) in enumerate(points) if any((a <= x and b <= y and (a < x or b < y)) for a, b in points)}
    assert {points[k] for k in found} == {p for k, p in enumerate(points) if k not in beaten}
    assert [points[k] for k in found] == sorted(points[k] for k in found)


# ---------------------------------------------------------------------------------------------- error against time


@pytest.fixture(scope="module")
def light() -> np.ndarray:
    return np.random.default_rng(5).random((16, 32, 3), np.float32)


def test_points(device: Device, light: np.ndarray) -> None:
    env = environment(light)
    found = list(
        tradeoff.points(env, device, size=16, min_size=4, runs=1, todo=[("tolerance", 1e-2), ("tolerance", 1e-3)])
    )
    assert [p.setting for p in found] == [1e-2, 1e-3]
    for p in found:
        assert isinstance(p, Point) and p.runs == 1 and len(p.rules) == 3
        assert 0 < p.seconds.low <= p.seconds.median <= p.seconds.high and p.certificate >= 0 < p.evaluations
        assert 0 <= p.rmse <= p.error <= p.worst and p.error <= p.setting  # a tolerance is kept or said to be missed
    marked = tradeoff.with_front([p for p in found if isinstance(p, Point)])
    assert any(p.front for p in marked)


def test_a_missed_point_is_told(device: Device, light: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    from whitefurnace.errors import CheckError

    def fails(*_: object, **__: object) -> None:
        raise CheckError("finer grids do not help")

    monkeypatch.setattr(tradeoff.lighting, "prefilter", fails)
    found = list(tradeoff.points(environment(light), device, size=16, todo=[("tolerance", 1e-3)]))
    assert found == [Missed("array", "tolerance", 1e-3, "finer grids do not help")]
    assert "finer grids do not help" in printed.tradeoff_text([], found)  # type: ignore[arg-type]


def test_costs(device: Device, light: np.ndarray) -> None:
    found = list(
        tradeoff.costs(
            environment(light), device, size=16, min_size=4, runs=1, sizes=(8, 16), rows=(8, 16), alphas=(0.1, 1.0)
        )
    )
    assert [(c.over, c.value) for c in found] == [
        ("output size", 8),
        ("output size", 16),
        ("source rows", 8),
        ("source rows", 16),
        ("alpha", 0.1),
        ("alpha", 1.0),
    ]
    assert all(0 < c.seconds.low <= c.seconds.median <= c.seconds.high for c in found)


@pytest.mark.parametrize("rows", [7, 16, 40])
def test_resampled_light_keeps_its_energy(device: Device, light: np.ndarray, rows: int) -> None:
    env = environment(np.float32(1000) * light)
    found = tradeoff.resampled(env, device, rows)
    assert found.texels.shape == (rows, 2 * rows, 3)
    # Exact means over texels in float64, rounded once.
    assert found.statistics["mean"] == pytest.approx(env.statistics["mean"], rel=1e-6)


def test_few_runs_within_the_budget() -> None:
    count = iter(range(100))
    assert tradeoff._repeated(lambda: next(count), 3, 60.0) == [1, 2, 3]  # the first is left out
    assert tradeoff._repeated(lambda: next(count), 3, 0.0) == [4]  # unless it took all the time there is


# ---------------------------------------------------------------------------------------------- what is said


def point(method: str, setting: float, seconds: float, error: float, front: bool) -> Point:
    return Point(
        "sky",
        method,
        setting,
        Spread(seconds, 0.9 * seconds, 1.1 * seconds),
        0.01,
        error,
        error,
        error / 9,
        100,
        ("texel-mean",),
        3,
        front,
    )


POINTS = [
    point("tolerance", 1e-2, 0.02, 5e-3, True),
    point("tolerance", 1e-3, 0.1, 5e-4, True),
    point("samples", 1024, 0.5, 5e-2, False),
]
COSTS = [
    Cost("sky", over, value, Spread(value, value, value), 1)
    for over in ("output size", "source rows", "alpha")
    for value in (0.5, 1.0)
]


def test_text_and_json() -> None:
    text = printed.tradeoff_text(POINTS)
    assert "0.001 normal" in text and re.search(r"samples +1024 ", text) and "(90 … 110)" in text
    assert text.count("front") == 2
    rows = printed.tradeoff_rows([*POINTS, Missed("sky", "samples", 32, "why"), *COSTS])
    rows = [json.loads(json.dumps(row, allow_nan=False)) for row in rows]
    assert [row["event"] for row in rows] == ["point"] * 3 + ["missed"] + ["cost"] * 6
    assert rows[0]["seconds"] == {"median": 0.02, "min": pytest.approx(0.018), "max": pytest.approx(0.022)}
    assert "alpha" in printed.costs_text(COSTS, 1e-3)


def test_figure(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot_style, "DPI", 40)
    path = draw_tradeoff(tmp_path / "a", POINTS, COSTS, device)
    assert path == tmp_path / "a/tradeoff.png" and path.read_bytes().startswith(b"\x89PNG")
    pixels = read_image(path).pixels
    assert len(np.unique(np.round(pixels.reshape(-1, pixels.shape[-1]), 3), axis=0)) > 20
    assert draw_tradeoff(tmp_path / "b", POINTS, COSTS, device).read_bytes() == path.read_bytes()


def test_the_script_that_fills_the_page(device: Device, meter: BenchMeter) -> None:
    """It reads what the command writes, and the page has the places."""
    spec = importlib.util.spec_from_file_location("bench_script", ROOT / "benchmarks/bench.py")
    assert spec and spec.loader
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    measured = list(benching.throughput(benching.cases(("evaluate", "demo")), device, meter, runs=1))
    said, head, table = script.throughput(
        [*map(printed.bench_row, measured), printed.yardstick_row(meter.yardstick(), device.identity())]
    )
    assert device.identity()["name"] in said
    assert [row[:2] for row in table] == [["evaluate", "cells"], ["demo", "points"]]
    assert all(len(row) == len(head) for row in table)
    whose = {"event": "device", "device": device.identity()}
    said, head, table = script.tradeoff([*printed.tradeoff_rows(POINTS), whose])
    assert head == ["method", "setting", "sky"]
    assert table[0] == ["tolerance", "0.01", "20 ms, 5.0e-03 *"] and table[2] == ["samples", "1024", "500 ms, 5.0e-02"]
    page = (ROOT / "docs/bench.md").read_text("utf-8")
    for name in ("throughput", "tradeoff"):
        assert re.search(rf"<!-- {name}: [^\n]*-->\n.*?<!-- end -->", page, re.DOTALL)


def test_command(tmp_path: Path) -> None:
    done = run("evaluate", "--runs", "1", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["event"] for row in rows[:-1]] == ["case"] * (len(rows) - 1) and rows[-1]["event"] == "yardstick"
    assert rows[0]["case"] == "evaluate" and rows[0]["per_second"]["median"] > 0


def test_command_tradeoff(tmp_path: Path, light: np.ndarray, small: Callable[[], None]) -> None:
    write_exr(tmp_path / "sky.exr", light)
    small()
    from click.testing import CliRunner

    from whitefurnace.cli import cli

    arguments = ["bench", "tradeoff", str(tmp_path / "sky.exr"), "--size", "16", "--min-size", "8", "--runs", "1"]
    done = CliRunner().invoke(cli, [*arguments, "--json", "--plot", str(tmp_path / "figures")])
    assert done.exit_code == 0, done.output
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    events = [row["event"] for row in rows]
    assert events == ["point"] * len(tradeoff.methods()) + ["cost"] * 3 + ["device", "plot"]
    assert all(row["environment"] == "sky" for row in rows if row["event"] == "point")
    assert (tmp_path / "figures/tradeoff.png").is_file()
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0 and re.search(r"tolerance +0.01 draft", done.stdout), done.output


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Fewer points: what the command does with them does not need more."""

    def shrink() -> None:
        monkeypatch.setattr(plot_style, "DPI", 40)
        monkeypatch.setattr(tradeoff, "TOLERANCES", (1e-2, 1e-3))
        monkeypatch.setattr(tradeoff, "SAMPLES", (32,))
        monkeypatch.setattr(
            tradeoff.costs,
            "__kwdefaults__",
            {**tradeoff.costs.__kwdefaults__, "sizes": (16,), "rows": (16,), "alphas": (0.5,)},
        )

    return shrink


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("convolvee",), "did you mean 'convolve'"),
        (("--size", "64"), "--size is of `bench tradeoff ENV...`"),
        (("dfg", "--plot", "figures"), "--plot is of `bench tradeoff ENV...`"),
        (("--runs", "0"), "runs 0 is outside [1, 1000]"),
        (("tradeoff",), "needs one environment"),
        (("tradeoff", "demo", "--size", "63"), "size 63 is not a power of two"),
        (("tradeoff", "demo", "--min-size", "512"), "min-size 512 is larger than size 256"),
    ],
)
def test_bad_usage(arguments: tuple[str, ...], said: str) -> None:
    from click.testing import CliRunner

    from whitefurnace.cli import cli

    done = CliRunner().invoke(cli, ["bench", *arguments])
    assert isinstance(done.exception, UsageError) and said in str(done.exception), done.output


def test_dry_run() -> None:
    from click.testing import CliRunner

    from whitefurnace.cli import cli

    told = CliRunner().invoke(cli, ["bench", "--dry-run"])
    assert told.exit_code == 0 and all(case.name in told.stdout for case in CASES)
    rows = CliRunner().invoke(cli, ["bench", "dfg", "--dry-run", "--json"]).stdout.splitlines()
    assert [json.loads(row)["case"] for row in rows] == ["dfg"]
    told = CliRunner().invoke(cli, ["bench", "tradeoff", "demo", "--dry-run"])
    assert told.exit_code == 0 and "demo: would measure tolerance 0.01" in told.stdout
