"""Hard inputs for the whole of a bake: panels with sharp edges, suns on cubes, radiance at the ends of float32,
devices without float64, and whose files are whose."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from whitefurnace import bake, environment, harmonics, irradiance, prefilter
from whitefurnace.errors import FileError
from whitefurnace.opencl.device import Device
from whitefurnace.sphere.grids import composite, cube_tables

SMALL = {"size": 32, "min_size": 8}


def noise(seed: int = 0, shape: tuple[int, ...] = (32, 64, 3)) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, np.float32)


def test_a_panel_with_hard_edges_meets_the_default_tolerance(device: Device):
    # All texels of a row of the panel set at once behind the horizon of a direction; midpoints leave 3e-2 there.
    pixels = np.full((128, 256, 3), 1e-4, np.float32)
    pixels[40:60, 100:140] = 100
    chain = prefilter(pixels, size=64, device=device)
    assert (chain.error <= 1e-3).all() and (chain.worst <= 1e-2).all()


def test_a_sun_on_a_cube_needs_no_table_of_every_node():
    tracemalloc.start()
    table, columns = cube_tables(128, *composite(256))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64e6  # (128·256)² float64 would be 8.6 GB
    # Without corrections the nodes must give each texel's solid angle by themselves: pairs of Gauss points on
    # 1/128 of a texel of 1/64 are exact far below float32.
    nodes = table[:256, :2]
    s, w = nodes.T
    area = (w[:, None] * w * (1 + s[:, None] ** 2 + s**2) ** -1.5).sum()
    corner = [np.arctan2(a * b, np.sqrt(a * a + b * b + 1)) for a in (-1, -1 + 2 / 128) for b in (-1, -1 + 2 / 128)]
    assert area == pytest.approx(corner[0] - corner[1] - corner[2] + corner[3], rel=1e-10)
    assert (columns[3 * 128 * 256 :] == 1).all()


@pytest.mark.parametrize("radiance", [1e-40, 1e-30, 1.0, 3e38])
def test_radiance_at_the_ends_of_float32(device: Device, radiance):
    chain = prefilter(np.full((8, 16, 3), radiance, np.float32), **SMALL, device=device)
    for level in chain.values:
        assert (level == np.float32(radiance)).all()  # a constant needs no sum, and the scale is a power of two


def test_a_device_without_float64_makes_level_0_as_well(device: Device, monkeypatch):
    pixels = noise()
    pixels[9, 20] = 1e5
    want = prefilter(pixels, **SMALL, device=device).values[0]
    monkeypatch.setattr(type(device), "fp64", property(lambda self: False))
    chain = prefilter(pixels, **SMALL, device=device)
    # Two float64 sums in different forms, each rounded once to float32; beside the sun, 1e-11 of it more.
    assert np.abs(chain.values[0] - want).max() <= 2e-7 * want.max()
    assert chain.error[0] <= 1e-6


def test_the_power_of_the_prefilter_scales_with_its_input(device: Device):
    pixels = noise(3)
    one, three = (prefilter(k * pixels, **SMALL, device=device) for k in (np.float32(1), np.float32(3)))
    for a, b in zip(one.values, three.values, strict=True):
        assert np.abs(3 * a - b).max() <= 1e-5 * b.max()  # sums in float32 round differently at another scale


def test_irradiance_and_harmonics_agree_in_the_mean(device: Device):
    pixels = noise(5)
    cube, sh = irradiance(pixels, size=16, device=device).values, harmonics(pixels, device=device).values
    # The mean of E/π over the sphere is that of the radiance, L00/√(4π); the cube's mean is by texel centres,
    # which for a function of degree two (and little beyond) is off by the square of a texel's angle.
    mean = cube.mean((0, 1, 2))
    assert mean == pytest.approx(sh[0] / np.sqrt(4 * np.pi), rel=(np.pi / 2 / 16) ** 2)


def test_files_of_another_engine_stay_and_stay_ours(tmp_path, device: Device):
    env = environment(noise())
    for engine in ("raw", "exr", "raw", "raw,exr"):
        bake(env, tmp_path, for_=engine, device=device, **SMALL)
    assert (tmp_path / "raw" / "array.npz").exists() and (tmp_path / "exr" / "array_specular_0.exr").exists()
    (tmp_path / "raw" / "array.npz").write_bytes(b"somebody's")
    with pytest.raises(FileError, match="not written by this bake"):
        bake(env, tmp_path, for_="raw", device=device, **SMALL)


def test_levels_of_a_longer_chain_do_not_stay_beside_a_shorter_one(tmp_path, device: Device):
    env = environment(noise())
    bake(env, tmp_path, for_="exr", size=32, min_size=8, device=device)
    bake(env, tmp_path, for_="exr", size=16, min_size=16, device=device)
    assert {p.name for p in (tmp_path / "exr").glob("array_specular_*")} == {
        "array_specular_0.exr",
        "array_specular_0_latlong.exr",
    }
    bake(env, tmp_path, for_="exr", size=32, min_size=8, device=device)
    assert (tmp_path / "exr" / "array_specular_2.exr").exists()


def test_an_environment_is_known_by_what_was_applied_to_it(tmp_path, device: Device):
    pixels = noise()
    states = [
        bake(env, tmp_path, device=device, **SMALL)[0].state
        for env in (
            environment(pixels),
            environment(pixels, rotate=90),
            environment(pixels, exposure=1),
            environment(pixels),
            environment(pixels),
        )
    ]
    assert states == ["done", "done", "done", "done", "skipped"]


def test_an_array_can_be_baked(tmp_path, device: Device):
    assert bake(noise(), tmp_path, device=device, **SMALL)[0].name == "array"


def test_an_odd_irradiance_cube_holds_a_sun_once(device: Device):
    """Of an odd size the middle rows of faces lie on mirror planes: two or four images of an output are one texel. From
    135² on the level is read from nodes and the sun is added to it."""
    pixels = noise(2)
    pixels[9, 20] = 3000
    made = irradiance(pixels, size=151, device=device)
    assert made.rule == irradiance(pixels, size=32, device=device).rule  # no refinement hides it
    rows = made.values[:, 75].reshape(-1, 3), made.values[:, :, 75].reshape(-1, 3)
    beside = made.values[:, 74].reshape(-1, 3), made.values[:, :, 74].reshape(-1, 3)
    for on, off in zip(rows, beside, strict=True):
        # Neighbours .01 rad apart: E changes by at most .01 of its largest value a step.
        assert np.abs(on - off).max() <= 0.011 * made.values.max()
