"""The sun taken out of an environment or clamped: direction, size and power of synthetic suns, the energy ledger, and
what is refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from whitefurnace import environment, integrate, without_sun
from whitefurnace.cli import main
from whitefurnace.errors import UsageError
from whitefurnace.files import write_exr
from whitefurnace.opencl.device import Device
from whitefurnace.sphere.environments import cube_solid_angles, latlong_solid_angles
from whitefurnace.sphere.suns import sun_mode

RADIUS = math.radians(1.5)
POWER = np.array([1e4, 0.9e4, 0.7e4])


def directions(kind: str, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (..., 3) of texel centres by their definition, and solid angles, of a lat-long or a cube."""
    if kind == "latlong":
        theta = ((np.arange(size) + 0.5) * math.pi / size)[:, None]
        phi = (((np.arange(2 * size) + 0.5) / (2 * size) - 0.5) * 2 * math.pi)[None, :]
        d = np.stack(np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)), -1)
        return d, np.broadcast_to(latlong_solid_angles(size, 2 * size)[:, None], d.shape[:2])
    t = 2 * (np.arange(size) + 0.5) / size - 1
    d = np.stack([_face(f, t) for f in range(6)])
    return d, np.broadcast_to(cube_solid_angles(size), d.shape[:3])


def _face(face: int, t: np.ndarray) -> np.ndarray:
    """GL-direct: +X -X +Y -Y +Z -Z, s to the right, t down."""
    u, v = np.meshgrid(t, t)
    one = np.ones_like(u)
    d = [(one, -v, -u), (-one, -v, u), (u, one, v), (u, -one, -v), (u, -v, one), (-u, -v, -one)][face]
    d = np.stack(d, -1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def sky_with_sun(kind: str, size: int, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    d, weights = directions(kind, size)
    sky = np.stack([0.3 + 0.2 * d[..., 1], 0.4 + 0.1 * d[..., 0], 0.8 + 0.1 * d[..., 2]], -1)
    sky[d @ towards > math.cos(RADIUS)] += POWER
    return sky.astype(np.float32), weights


# Towards the middle of a face, an edge and a corner of the cube, the seam and the pole of a lat-long.
PLACES = [(0.0, 0.1, 1.0), (1.0, 0.3, 1.0), (1.0, 1.0, 1.0), (-1.0, 0.4, 0.0), (0.05, 1.0, 0.02)]


@pytest.mark.parametrize("place", PLACES, ids=str)
@pytest.mark.parametrize("kind", ["latlong", "cube"])
def test_a_sun_is_found_whole(kind: str, place: tuple[float, float, float]) -> None:
    towards = np.array(place) / np.linalg.norm(place)
    texels, weights = sky_with_sun(kind, 256 if kind == "latlong" else 128, towards)
    env = environment(texels)
    sky, sun = without_sun(env, "extract")
    assert sun is not None
    source = np.tensordot(weights, texels.astype(np.float64), weights.ndim)
    left = np.tensordot(weights, sky.texels.astype(np.float64), weights.ndim)
    disc = float(weights[texels[..., 0] > 100].sum())
    # The ledger: what is left and what was taken are the source; the irradiance is the power but for cos of 1.5°.
    power = np.array(sun.radiance) * 2 * math.pi * (1 - math.cos(sun.angular_radius))
    np.testing.assert_allclose(left + power, source, rtol=1e-6)  # float32 texels
    np.testing.assert_allclose(power, POWER * disc, rtol=1e-4)  # the sky in the hole changes by 1e-4 of the sun
    np.testing.assert_allclose(sun.irradiance, power, rtol=1 - math.cos(RADIUS) + 1e-6)
    np.testing.assert_allclose(np.array(sun.c) * math.pi, sun.irradiance, rtol=1e-12)
    assert abs(sun.angular_radius - math.acos(1 - disc / (2 * math.pi))) < 1e-4 * RADIUS
    # The texels of a disc are lopsided by a part of a texel: .7° and .7° here.
    assert math.acos(min(1.0, float(np.dot(sun.direction, towards)))) < math.radians(0.35)
    assert sky.statistics["max_over_mean"] < 2 and sky.texels.max() < 1.1
    assert sky.notices and "irradiance" in sky.notices[0] and env.texels is not sky.texels


def test_the_rotation_turns_the_sun_too() -> None:
    texels, _ = sky_with_sun("latlong", 128, np.array([0.6, 0.64, 0.48]))
    sun = without_sun(environment(texels), "extract")[1]
    turned = without_sun(environment(texels, rotate=90), "extract")[1]
    assert sun is not None and turned is not None
    x, y, z = sun.direction
    np.testing.assert_allclose(turned.direction, (-z, y, x), atol=1e-12)


def test_a_sun_of_one_texel_and_one_among_black(device: Device) -> None:
    texels = np.zeros((64, 128, 3), np.float32)
    texels[10, 20] = 1e6
    sky, sun = without_sun(environment(texels), "extract")
    assert sun is not None and sun.texels == 1 and sun.share == pytest.approx(1) and sky.texels.max() == 0
    assert sun.irradiance[0] == pytest.approx(1e6 * latlong_solid_angles(64, 128)[10], rel=1e-6)  # float32 input
    # Lit as engines light it: a white Lambertian facing the light returns c.
    lit = integrate(
        "radiance", diffuse="lambert", albedo=1.0, light="punctual", NoL=1.0, NoV=0.7, color=sun.c[0], device=device
    )
    assert float(lit.values) == pytest.approx(sun.irradiance[0] / math.pi, rel=1e-6)


def test_no_sun_is_no_sun() -> None:
    for texels in (
        np.full((16, 32, 3), 2, np.float32),
        np.zeros((16, 32, 3), np.float32),
        np.ones((1, 1, 3), np.float32),
    ):
        env = environment(texels)
        sky, sun = without_sun(env, "extract")
        assert sun is None and (sky.texels == texels).all() and len(sky.notices) == 1


def test_clamp_keeps_colour_and_says_what_it_took() -> None:
    texels, weights = sky_with_sun("latlong", 128, np.array([0.0, 0.6, 0.8]))
    env = environment(texels)
    clamped, sun = without_sun(env, "clamp=5")
    mean = float(np.mean(env.statistics["mean"]))
    level = clamped.texels.mean(-1)
    hot = texels[..., 0] > 100
    assert sun is None and level.max() <= 5 * mean * (1 + 1e-6)
    np.testing.assert_allclose(
        clamped.texels[hot] / level[hot][:, None], texels[hot] / texels[hot].mean(-1)[:, None], rtol=1e-6
    )
    assert (clamped.texels[~hot] == texels[~hot]).all()
    taken = 1 - float((weights * level).sum() / (weights * texels.mean(-1)).sum())
    assert f"{100 * taken:.3g} %" in clamped.notices[0]
    assert without_sun(env, "clamp=1e9")[0].texels is env.texels


@pytest.mark.parametrize("mode", ["kep", "extract=2", "clamp", "clamp=", "clamp=0.5", "clamp=nan", "clamp=inf"])
def test_other_modes_are_refused(mode: str) -> None:
    with pytest.raises(UsageError):
        sun_mode(mode)


def bake(*arguments: Any) -> int:
    with pytest.raises(SystemExit) as done:
        main(["bake", *map(str, arguments), "--size", "16", "--min-size", "8", "--json"])
    return int(done.value.code or 0)


def test_a_bake_without_its_sun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    texels, _ = sky_with_sun("latlong", 128, np.array([0.0, 0.6, 0.8]))
    write_exr(tmp_path / "sky.exr", texels)
    assert bake(tmp_path / "sky.exr", "-o", tmp_path / "out", "--sun", "extract") == 0
    row = json.loads(capsys.readouterr().out.splitlines()[-1])
    manifest = json.loads((tmp_path / "out/sky.json").read_text())
    assert row["sun"] == manifest["sun"] and manifest["recipe"]["sun"] == "extract"
    with np.load(tmp_path / "out/raw/sky.npz") as arrays:
        assert arrays["specular_0"].max() < 1.1  # the sky alone
    assert bake(tmp_path / "sky.exr", "-o", tmp_path / "out", "--sun", "clamp=10") == 0
    assert "sun" not in json.loads((tmp_path / "out/sky.json").read_text())
    assert bake(tmp_path / "sky.exr", "-o", tmp_path / "out", "--sun", "clamp") == 1


def test_an_environment_is_not_changed_in_place() -> None:
    texels, _ = sky_with_sun("cube", 32, np.array([0.0, 0.0, 1.0]))
    env = environment(texels)
    before = replace(env, texels=env.texels.copy())
    without_sun(env, "extract")
    without_sun(env, "clamp=2")
    assert (before.texels == env.texels).all()


def test_a_panel_is_not_a_sun() -> None:
    d, _ = directions("latlong", 128)
    texels = np.where((d @ np.array([0.0, 0.0, 1.0]) > math.cos(math.radians(20)))[..., None], 500.0, 1.0)
    sky, sun = without_sun(environment(np.repeat(texels, 3, -1).astype(np.float32)), "extract")
    assert sun is None and "panel" in sky.notices[0]


def test_a_highlight_is_not_a_sun() -> None:
    texels = np.ones((128, 256, 3), np.float32)
    texels[60, 20] = 50  # 2e-4 of the energy
    sky, sun = without_sun(environment(texels), "extract")
    assert sun is None and sky.texels.max() == 50 and "% of the energy" in sky.notices[0]
