"""Environments: every layout puts every texel where its direction is, statistics are exact, and what is not
an environment is refused in one sentence."""

from __future__ import annotations

import math

import numpy as np
import pytest

from exr_writer import Part, exr, planes
from reference import cube_directions
from whitefurnace.errors import FileError, InputError, UsageError
from whitefurnace.files import write_exr
from whitefurnace.sphere.environments import (
    LAYOUTS,
    Environment,
    channel_range,
    cube_solid_angles,
    environment,
    extent,
    latlong_solid_angles,
    source_digest,
    source_files,
    source_name,
)

N = 8


def latlong_directions(h, w):
    """u = atan2(z, x)/2pi + 1/2 from left to right, v = acos(y)/pi from the top."""
    v, u = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(w) + 0.5) / w, indexing="ij")
    azimuth = 2 * np.pi * (u - 0.5)
    ring = np.sin(np.pi * v)
    return np.stack([ring * np.cos(azimuth), np.cos(np.pi * v), ring * np.sin(azimuth)], axis=-1)


def code(directions):
    return ((directions + 1) / 2).astype(np.float32)


def assemble(layout, faces):
    """The picture of a layout, cell by cell as the text has it; unused parts are NaN."""
    px, nx, py, ny, pz, nz = faces
    gap = np.full_like(px, np.nan)
    rows = {
        "horizontal cross": [[gap, py, gap, gap], [nx, pz, px, nz], [gap, ny, gap, gap]],
        "vertical cross": [[gap, py, gap], [nx, pz, px], [gap, ny, gap], [gap, nz[::-1, ::-1], gap]],
        "horizontal strip": [[px, nx, py, ny, pz, nz]],
        "vertical strip": [[px], [nx], [py], [ny], [pz], [nz]],
    }[layout]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows], axis=0)


CUBES = ["horizontal cross", "vertical cross", "horizontal strip", "vertical strip"]


def one_sentence(error):
    text = str(error.value)
    assert "\n" not in text and 20 < len(text) < 500 and not text.endswith("."), text
    return text


def refused(kind, source, *words, **options):
    with pytest.raises(kind) as error:
        environment(source, **options)
    assert type(error.value) is kind
    text = one_sentence(error)
    for word in words:
        assert word in text, f"{word!r} is not in {text!r}"


# --- layouts --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_file", [False, True])
@pytest.mark.parametrize("name", CUBES)
def test_every_texel_of_a_cube_layout_keeps_its_direction(tmp_path, name, as_file):
    want = code(cube_directions(N))
    source = assemble(name, want)
    if as_file:
        write_exr(tmp_path / "a.exr", source)
        source = tmp_path / "a.exr"
    env = environment(source)
    assert (env.kind, env.layout) == ("cube", name) and env.coverage is None
    assert env.texels.dtype == np.float32 and env.texels.flags.c_contiguous
    np.testing.assert_array_equal(env.texels, want)


@pytest.mark.parametrize("as_file", [False, True])
def test_every_texel_of_a_latlong_keeps_its_direction(tmp_path, as_file):
    want = code(latlong_directions(N, 2 * N))
    source = want
    if as_file:
        source = tmp_path / "a.exr"
        write_exr(source, want)
    env = environment(source)
    assert (env.kind, env.layout) == ("latlong", "latlong")
    np.testing.assert_array_equal(env.texels, want)
    # What is in the middle, at the right edge and on top.
    assert want[N // 2, N, 0] > 0.95 and want[0, 0, 1] > 0.95 and want[N // 2, 3 * N // 2, 2] > 0.95


@pytest.mark.parametrize(
    "names",
    [
        "px nx py ny pz nz",
        "posx negx posy negy posz negz",
        "right left top bottom front back",
        "PX NX PY NY PZ NZ",
    ],
)
def test_six_faces_in_a_folder(tmp_path, names):
    want = code(cube_directions(N))
    folder = tmp_path / "studio"
    folder.mkdir()
    for name, face in zip(names.split(), want, strict=True):
        write_exr(folder / f"{name}.exr", face)
    (folder / "readme.txt").write_text("not a face")
    env = environment(folder)
    assert (env.kind, env.layout, env.name) == ("cube", "six faces", "studio")
    np.testing.assert_array_equal(env.texels, want)


@pytest.mark.parametrize("name", ["horizontal cross", "vertical cross"])
def test_neighbours_in_a_cross_are_neighbours_on_the_sphere(name):
    (layout,) = (layout for layout in LAYOUTS if layout.name == name)
    faces = [np.rot90(face, -cell.turns) for face, cell in zip(cube_directions(64), layout.cells, strict=True)]
    joints = 0
    for a, at in zip(faces, layout.cells, strict=True):
        for b, to in zip(faces, layout.cells, strict=True):
            if (to.column, to.row) == (at.column + 1, at.row):
                gap = a[:, -1] - b[:, 0]
            elif (to.column, to.row) == (at.column, at.row + 1):
                gap = a[-1] - b[0]
            else:
                continue
            joints += 1
            assert np.abs(gap).max() < 2 / 64, (at, to)  # a texel is 2/64 wide
    assert joints == 5


def test_arrays_of_a_cube():
    want = code(cube_directions(N))
    env = environment(want)
    assert (env.kind, env.layout, env.name) == ("cube", "cube", "array")
    np.testing.assert_array_equal(env.texels, want)
    grey = environment(want[..., 0])
    np.testing.assert_array_equal(grey.texels, np.repeat(want[..., :1], 3, axis=-1))


def test_grey_and_coverage():
    rng = np.random.default_rng(1)
    pixels = rng.random((4, 8, 4), dtype=np.float32)
    env = environment(pixels)
    np.testing.assert_array_equal(env.coverage, pixels[..., 3])
    np.testing.assert_array_equal(env.texels, pixels[..., :3])
    pixels[..., 3] = 1
    assert environment(pixels).coverage is None
    cube = rng.random((6, 4, 4, 4), dtype=np.float32)
    np.testing.assert_array_equal(environment(assemble("vertical cross", cube)).coverage, cube[..., 3])
    grey = environment(pixels[..., 0])
    np.testing.assert_array_equal(grey.texels, np.repeat(pixels[..., :1], 3, axis=-1))


def test_a_single_pixel_is_a_constant(tmp_path):
    write_exr(tmp_path / "one.exr", np.array([[[1, 2, 3]]], np.float32))
    env = environment(tmp_path / "one.exr")
    assert env.kind == "latlong" and env.texels.shape == (1, 1, 3)
    np.testing.assert_allclose(env.statistics["mean"], [1, 2, 3], rtol=1e-15)
    assert env.statistics["brightest_share"] == 1 and env.statistics["max_over_mean"] == pytest.approx(1)


def test_integers_are_srgb():
    env = environment(np.full((1, 2, 3), 188, np.uint8))
    np.testing.assert_allclose(env.texels, ((188 / 255 + 0.055) / 1.055) ** 2.4, rtol=1e-6)


# --- options --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["latlong", "cube"])
def test_rotation_increases_the_azimuth(kind):
    pixels = np.zeros((16, 32, 3) if kind == "latlong" else (6, 16, 16, 3), np.float32)
    directions = latlong_directions(16, 32) if kind == "latlong" else cube_directions(16)
    at = (5, 20) if kind == "latlong" else (4, 5, 11)
    pixels[at] = 7
    x, y, z = directions[at]
    np.testing.assert_allclose(environment(pixels).statistics["brightest"], (x, y, z), atol=1e-12)
    for degrees in (30.0, -100.0, 390.0):
        env = environment(pixels, rotate=degrees)
        np.testing.assert_array_equal(env.texels, pixels)
        azimuth = math.atan2(z, x) + math.radians(degrees)
        ring = math.hypot(x, z)
        np.testing.assert_allclose(
            env.statistics["brightest"], (ring * math.cos(azimuth), y, ring * math.sin(azimuth)), atol=1e-12
        )
        assert abs(env.rotation) <= math.pi
        assert math.cos(env.rotation - math.radians(degrees)) == pytest.approx(1, abs=1e-12)


def test_exposure_multiplies():
    pixels = np.random.default_rng(1).random((4, 8, 3), dtype=np.float32)
    np.testing.assert_array_equal(environment(pixels, exposure=3).texels, pixels * 8)
    np.testing.assert_allclose(environment(pixels, exposure=-0.5).texels, pixels / math.sqrt(2), rtol=1e-6)
    bright = np.full((1, 2, 3), 1e30, np.float32)
    environment(bright, exposure=20)
    refused(InputError, bright, "float32", exposure=64)
    np.testing.assert_array_equal(bright, np.float32(1e30))  # a caller's array is not written to


def test_an_environment_passes_through():
    env = environment(np.random.default_rng(1).random((4, 8, 3), dtype=np.float32), rotate=10)
    assert environment(env) is env
    again = environment(env, rotate=20, exposure=1)
    assert again.rotation == pytest.approx(math.radians(30)) and again.exposure == 1
    np.testing.assert_array_equal(again.texels, env.texels * 2)
    assert again.digest == env.digest
    assert again.statistics["mean"] == pytest.approx([2 * m for m in env.statistics["mean"]])


def test_digests_tell_sources_apart(tmp_path):
    pixels = np.random.default_rng(1).random((4, 8, 3), dtype=np.float32)
    assert environment(pixels).digest == environment(pixels.copy(), exposure=1).digest
    others = [pixels + 1, pixels.astype(np.float64), np.ascontiguousarray(pixels[:2, :4])]
    assert len({environment(p).digest for p in [pixels, *others]}) == 4


@pytest.mark.parametrize(
    "options",
    [
        {"rotate": float("nan")},
        {"rotate": float("inf")},
        {"rotate": "10"},
        {"exposure": 65},
        {"exposure": -64.1},
        {"exposure": float("nan")},
        {"exposure": None},
        {"nonfinite": "ignore"},
    ],
)
def test_options_out_of_their_domain(options):
    refused(UsageError, np.ones((1, 2, 3)), next(iter(options)), **options)


# --- statistics -----------------------------------------------------------------------------------------


def test_solid_angles_are_exact():
    for n in (1, 2, 7, 512):
        assert latlong_solid_angles(n, 2 * n).sum() * 2 * n == pytest.approx(4 * math.pi, rel=1e-13)
        assert 6 * cube_solid_angles(n).sum() == pytest.approx(4 * math.pi, rel=1e-12)
    h, w = 5, 12
    edges = np.cos(np.linspace(0, np.pi, h + 1))
    np.testing.assert_allclose(latlong_solid_angles(h, w), 2 * np.pi / w * -np.diff(edges), rtol=1e-14)
    # Midpoint rule on a grid 64 times as fine of dω = (1 + x² + y²)^(-3/2) dx dy; its error is 64⁻² of a
    # texel.
    x = (np.arange(4 * 64) + 0.5) / (2 * 64) - 1
    density = (1 + x[:, None] ** 2 + x**2) ** -1.5 / (2 * 64) ** 2
    blocks = density.reshape(4, 64, 4, 64).sum(axis=(1, 3))
    np.testing.assert_allclose(cube_solid_angles(4), blocks, rtol=1e-4)


@pytest.mark.parametrize("kind", ["latlong", "cube"])
def test_statistics_against_plain_sums(kind):
    rng = np.random.default_rng(5)
    shape = (600, 1200, 3) if kind == "latlong" else (6, 300, 300, 3)
    pixels = rng.random(shape, dtype=np.float32) ** 8
    at = (411, 77) if kind == "latlong" else (3, 211, 77)
    pixels[at] = 5000, 7000, 9000
    env = environment(pixels)
    exact = pixels.astype(np.float64)
    weights = np.broadcast_to(
        latlong_solid_angles(*shape[:2])[:, None] if kind == "latlong" else cube_solid_angles(shape[1]),
        shape[:-1],
    )
    np.testing.assert_allclose(
        env.statistics["mean"], [(exact[..., c] * weights).sum() / (4 * np.pi) for c in range(3)], rtol=1e-10
    )
    energy = (exact.mean(axis=-1) * weights).ravel()
    assert env.statistics["brightest_share"] == pytest.approx(np.sort(energy)[-64:].sum() / energy.sum())
    assert env.statistics["maximum"] == pytest.approx(7000)
    assert env.statistics["max_over_mean"] == pytest.approx(7000 * 4 * np.pi / energy.sum())
    directions = latlong_directions(*shape[:2]) if kind == "latlong" else cube_directions(shape[1])
    np.testing.assert_allclose(env.statistics["brightest"], directions[at], atol=1e-12)
    assert (env.statistics["height"], env.statistics["width"]) == shape[-3:-1]


@pytest.mark.parametrize("shape", [(1, 1), (5, 10), (6, 3, 3)])
def test_range_by_channel(shape):
    texels = np.random.default_rng(list(shape)).normal(size=(*shape, 3)).astype(np.float32)
    least, most = channel_range(texels)
    flat = texels.reshape(-1, 3).tolist()
    assert least.tolist() == [min(x[k] for x in flat) for k in range(3)] and least.dtype == np.float32
    assert most.tolist() == [max(x[k] for x in flat) for k in range(3)]


def test_kept_solid_angles_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        cube_solid_angles(4)[0, 0] = 1


def test_black_is_good_input():
    env = environment(np.zeros((4, 8, 3)))
    assert env.statistics["mean"] == [0, 0, 0] and env.statistics["brightest_share"] == 0
    assert env.statistics["max_over_mean"] == 1


# --- bad input ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(8, 8, 3), (10, 21, 3), (5, 1, 3), (100, 199), (2, 3, 3)])
def test_an_aspect_ratio_that_no_layout_has(tmp_path, shape):
    refused(InputError, np.ones(shape), f"{shape[1]} x {shape[0]}", *(layout.name for layout in LAYOUTS))
    write_exr(tmp_path / "a.exr", np.ones((*shape[:2], 3), np.float32))
    refused(InputError, tmp_path / "a.exr", str(tmp_path / "a.exr"), "aspect ratio")


@pytest.mark.parametrize(
    "array",
    [
        np.ones((4, 8, 2)),
        np.ones((4, 8, 5)),
        np.ones(8),
        np.ones((6, 4, 4, 2)),
        np.ones((5, 4, 4, 3)),
        np.ones((0, 0, 3)),
        np.ones((6, 0, 0, 3)),
        np.ones(()),
        np.ones((4, 8, 3), int),
        np.ones((4, 8), complex),
        np.ones((4, 8), bool),
        np.full((4, 8), "x"),
        np.full((4, 8), None),
    ],
    ids=lambda a: f"{a.shape}-{a.dtype}",
)
def test_arrays_that_are_no_environment(array):
    refused(InputError, array, "expected")


def test_sources_that_are_no_environment(tmp_path):
    refused(UsageError, 3, "int")
    refused(UsageError, None, "NoneType")
    refused(FileError, tmp_path / "missing.exr", "missing.exr")
    refused(FileError, "a\0b", "null")


@pytest.mark.parametrize("value, shown", [(np.nan, "nan"), (np.inf, "inf"), (-np.inf, "-inf"), (-0.25, "-0.25")])
@pytest.mark.parametrize("as_file", [False, True])
def test_the_first_bad_pixel_is_named(tmp_path, value, shown, as_file):
    pixels = np.ones((8, 16, 3), np.float32)
    pixels[3, 5, 1] = value
    pixels[3, 6, 0] = value
    pixels[7, 0] = value
    source = pixels
    if as_file:
        source = tmp_path / "a.exr"
        write_exr(source, pixels)
    refused(
        InputError,
        source,
        shown,
        "channel G",
        "pixel (5, 3)",
        "first of 5",
        "--bad-pixels zero",
        *([str(source)] if as_file else []),
    )
    env = environment(source, nonfinite="zero")
    np.testing.assert_array_equal(env.texels, np.where(pixels == 1, np.float32(1), np.float32(0)))
    (notice,) = env.notices
    assert "5" in notice and ("clamped" if value == -0.25 else "set to 0") in notice
    assert np.array_equal(pixels[3, 5, 1], value, equal_nan=True)


def test_bad_values_of_both_kinds_are_counted_apart():
    pixels = np.ones((1, 2, 3))
    pixels[0, 0] = np.nan, -1, -2
    env = environment(pixels, nonfinite="zero")
    assert [("1 not finite" in n, "2 negative" in n) for n in env.notices] == [(True, False), (False, True)]


def test_bad_values_where_no_face_is_do_not_matter():
    picture = assemble("horizontal cross", code(cube_directions(4)))
    assert np.isnan(picture).any()
    assert environment(picture).notices == ()
    picture[0, 0] = -1
    assert environment(picture).notices == ()
    picture[5, 0, 2] = np.nan
    refused(InputError, picture, "channel B of pixel (0, 5)", "the only value")


def test_bad_values_in_a_cube_name_the_face():
    cube = np.ones((6, 4, 4), np.float32)
    cube[3, 1, 2] = np.nan
    refused(InputError, cube, "pixel (2, 1) of face -Y", "grey")


def test_a_double_over_the_range_of_float32():
    refused(InputError, np.full((1, 2, 3), 1e300), "inf")


def faces(folder, names="px nx py ny pz nz", size=4):
    for name in names.split():
        write_exr(folder / f"{name}.exr", np.ones((size, size, 3), np.float32))


def test_folders_without_six_faces(tmp_path):
    refused(InputError, tmp_path, str(tmp_path), "px nx", "posx", "front")
    faces(tmp_path, "px nx py ny pz")
    refused(InputError, tmp_path, "lacks", "nz")
    faces(tmp_path, "nz")
    environment(tmp_path)
    (tmp_path / "px.png").write_bytes(b"")
    refused(InputError, tmp_path, "px.exr and px.png")
    (tmp_path / "px.png").unlink()
    faces(tmp_path, "ny", size=8)
    refused(InputError, tmp_path, "ny.exr", "8 x 8", "4 x 4")
    write_exr(tmp_path / "ny.exr", np.ones((4, 8, 3), np.float32))
    refused(InputError, tmp_path, "ny.exr", "8 x 4", "square")
    bad = np.ones((4, 4, 3), np.float32)
    bad[2, 1] = np.nan
    write_exr(tmp_path / "ny.exr", bad)
    refused(InputError, tmp_path, "ny.exr", "pixel (1, 2)")


def test_faces_of_different_channels_join(tmp_path):
    faces(tmp_path)
    write_exr(tmp_path / "px.exr", np.full((4, 4, 1), 5, np.float32), channel_names=("Y",))
    write_exr(tmp_path / "nz.exr", np.full((4, 4, 4), 0.5, np.float32), channel_names=tuple("RGBA"))
    env = environment(tmp_path)
    assert (env.texels[0] == 5).all() and (env.texels[5] == 0.5).all() and (env.texels[1:5] == 1).all()
    assert env.coverage is not None and (env.coverage[5] == 0.5).all() and (env.coverage[:5] == 1).all()


def test_an_environment_is_frozen():
    env = environment(np.ones((1, 2, 3)))
    assert isinstance(env, Environment)
    with pytest.raises(AttributeError):
        env.kind = "cube"  # type: ignore[misc]


# --- bad pixels -----------------------------------------------------------------------------------------


def test_negative_values_of_negligible_energy_become_zero_with_a_notice():
    pixels = np.ones((64, 128, 3), np.float32)
    pixels[30, 40, 1] = -0.01
    pixels[31, 41] = -0.02
    env = environment(pixels)
    assert env.texels.min() == 0
    # Their share of the energy by sin θ of the rows, over all other values.
    ring = np.sin((np.arange(64) + 0.5) * np.pi / 64)
    share = (0.01 * ring[30] + 3 * 0.02 * ring[31]) / (3 * 128 * ring.sum() - ring[30] - 3 * ring[31])
    assert share < 2e-5
    (notice,) = env.notices
    assert "4 negative values" in notice and "-0.02" in notice and f"{share:.2g} of the energy" in notice
    pixels[32, 42] = -1
    share += 3 * ring[32] / (3 * 128 * ring.sum())
    refused(InputError, pixels, "first of 7 values that are negative", f"{share:.1g}", "--bad-pixels")
    for mode in ("zero", "clamp"):
        assert environment(pixels, bad_pixels=mode).texels.min() == 0


@pytest.mark.parametrize("kind", ["horizontal cross", "cube"])
def test_the_share_of_negatives_in_a_cube_is_by_solid_angle(kind):
    n = 32
    cube = np.ones((6, n, n, 3), np.float32)
    cube[2, 0, 0] = -0.5  # a corner texel has the least solid angle, .19 of that of the middle
    angles = cube_solid_angles(n)
    share = 0.5 * angles[0, 0] / (4 * math.pi - angles[0, 0])
    source = cube if kind == "cube" else assemble(kind, cube)
    cube[2, 0, 0] *= 1e-5 / share
    source = cube if kind == "cube" else assemble(kind, cube)
    (notice,) = environment(source).notices
    assert "1e-05 of the energy" in notice
    cube[2, 0, 0] *= 3
    source = cube if kind == "cube" else assemble(kind, cube)
    refused(InputError, source, "3e-05 of the energy")


def test_black_with_a_negative_value_has_no_energy_and_is_refused():
    pixels = np.zeros((4, 8, 3), np.float32)
    pixels[0, 0] = -1e-30
    refused(InputError, pixels, "negative")
    assert environment(pixels, bad_pixels="zero").statistics["mean"] == [0, 0, 0]


def test_negative_coverage_counts_for_itself():
    pixels = np.ones((64, 128, 4), np.float32)
    pixels[3, 3, 3] = -1e-3
    env = environment(pixels)
    assert env.coverage is not None and env.coverage[3, 3] == 0
    pixels[..., 3] = -1e-3
    refused(InputError, pixels, "channel A")


@pytest.mark.parametrize("dtype, largest", [(np.float16, 65504), (np.float32, 3.4028235e38)])
def test_clamp_sets_infinite_values_to_the_largest_of_the_type(dtype, largest):
    pixels = np.ones((4, 8, 3), dtype)
    pixels[0, 0] = np.inf, np.nan, -np.inf
    refused(InputError, pixels, f"+inf to {largest:.6g}", "--bad-pixels clamp")
    env = environment(pixels, bad_pixels="clamp")
    np.testing.assert_array_equal(env.texels[0, 0], np.array([largest, 0, 0], np.float32))
    assert ["1 +inf value was set to" in n or "2 not finite values were set to 0" in n for n in env.notices] == [1, 1]
    assert environment(pixels, bad_pixels="zero").texels[0, 0].tolist() == [0, 0, 0]


def test_the_older_name_of_bad_pixels():
    pixels = np.full((1, 2, 3), np.nan)
    assert environment(pixels, nonfinite="zero").texels.max() == 0
    assert environment(pixels, bad_pixels="zero", nonfinite="zero").texels.max() == 0
    refused(UsageError, pixels, "bad_pixels", "nonfinite", bad_pixels="clamp", nonfinite="zero")
    refused(UsageError, pixels, "bad_pixels", "clamp", bad_pixels="keep")


# --- layouts by name ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(8, 17), (8, 15), (9, 16), (8, 8), (5, 1)])
def test_a_latlong_of_any_size_by_name(shape):
    pixels = np.random.default_rng(2).random((*shape, 3), dtype=np.float32)
    env = environment(pixels, layout="latlong")
    assert env.kind == "latlong" and f"{shape[1]} x {shape[0]}" in env.notices[0]
    np.testing.assert_array_equal(env.texels, pixels)


@pytest.mark.parametrize("more", [(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1)])
@pytest.mark.parametrize("name", CUBES)
def test_a_cube_layout_a_pixel_off_by_name(name, more):
    """A texel of each face moves by less than one pixel."""
    n = 16
    want = code(cube_directions(n))
    picture = assemble(name, want)
    for axis, change in enumerate(more):
        if change > 0:
            picture = np.concatenate([picture, picture.take([-1], axis)], axis)
        elif change < 0:
            picture = picture.take(range(picture.shape[axis] - 1), axis)
    refused(InputError, picture, "--layout")
    short, option = name.split()[1], name.replace(" ", "-")
    found = {}
    for asked in (short, option):
        try:
            found[asked] = environment(picture, layout=asked)
        except InputError as error:
            assert "may differ by 1" in str(error)
            h, w = picture.shape[:2]
            columns, rows = next((one.columns, one.rows) for one in LAYOUTS if one.name == name)
            assert abs(w / columns - h / rows) > 1
            return
    env = found[option]
    np.testing.assert_array_equal(env.texels, found[short].texels)
    size = env.texels.shape[1]
    assert size in (n - 1, n) and env.layout == name
    # By a pixel of 2/16, which is 1/16 in the code.
    off = np.abs(env.texels - want[:, :size, :size])
    assert off.max() <= 1.5 / n


def test_a_layout_that_the_size_cannot_have(tmp_path):
    pixels = np.ones((8, 16, 3), np.float32)
    refused(InputError, pixels, "horizontal cross", "4 x 2.6667", "differ by 1", layout="cross")
    refused(InputError, pixels, "horizontal strip", layout="strip")
    refused(InputError, pixels, "faces", layout="faces")
    refused(UsageError, pixels, "did you mean 'latlong'", layout="latlon")
    refused(UsageError, np.ones((6, 4, 4, 3)), "cube", layout="latlong")
    refused(UsageError, pixels, "layer", layer="beauty")
    faces(tmp_path)
    refused(InputError, tmp_path, "folder", layout="latlong")
    assert environment(tmp_path, layout="faces").kind == "cube"


# --- six files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prefix", ["m0_", "Studio-", "a.b.", "probe ", "NAME"])
@pytest.mark.parametrize(
    "names", ["px nx py ny pz nz", "posx negx posy negy posz negz", "right left top bottom front back"]
)
def test_six_files_with_a_prefix(tmp_path, prefix, names):
    want = code(cube_directions(4))
    folder = tmp_path / "studio"
    folder.mkdir()
    for name, face in zip(names.split(), want, strict=True):
        write_exr(folder / f"{prefix}{name}.exr", face)
    (folder / "laptop.txt").write_text("not a face")
    title = prefix.rstrip("_-. ")
    one = folder / f"{prefix}{names.split()[4]}.exr"
    for source in (folder, one, folder / f"{prefix}*.exr", str(folder / f"{prefix}*")):
        env = environment(source)
        assert (env.kind, env.layout, env.name) == ("cube", "six faces", title)
        np.testing.assert_array_equal(env.texels, want)
        assert source_name(source) == title and source_digest(source) == env.digest
        assert len(source_files(source)) == 6 and extent(source) == ("cube", 4, 4)


def test_one_of_two_sets_in_a_folder_is_asked_for(tmp_path):
    for prefix in ("m0_", "m1_"):
        for k, name in enumerate("px nx py ny pz nz".split()):
            write_exr(tmp_path / f"{prefix}{name}.exr", np.full((4, 4, 3), k + 10 * int(prefix[1]), np.float32))
    refused(InputError, tmp_path, "2 sets", "m0_px, m1_px", "m0_px.exr")
    refused(InputError, tmp_path / "*.exr", "2 sets", "narrow")
    for number in (0, 1):
        for source in (tmp_path / f"m{number}_ny.exr", tmp_path / f"m{number}_*.exr"):
            env = environment(source)
            assert env.name == f"m{number}" and env.texels[3].max() == 3 + 10 * number
    (tmp_path / "m1_nz.exr").unlink()
    assert environment(tmp_path).name == "m0"
    refused(InputError, tmp_path / "m1_px.exr", "4 x 4", "--layout")  # one of five is an image
    refused(InputError, tmp_path / "m1_px.exr", "six images", layout="faces")
    refused(InputError, tmp_path / "m1_*.exr", "lacks", "m1_nz")
    refused(FileError, tmp_path / "m7_*.exr", "no file matches")


def test_the_suffix_chooses_between_two_formats_of_one_set(tmp_path):
    for name in "px nx py ny pz nz".split():
        for suffix, value in (("exr", 1), ("dat", 2)):
            write_exr(tmp_path / "new.exr", np.full((4, 4, 3), value, np.float32))
            (tmp_path / "new.exr").rename(tmp_path / f"a_{name}.{suffix}")
    assert environment(tmp_path / "a_px.exr").texels.max() == 1
    assert environment(tmp_path / "a_nz.dat").texels.max() == 2
    refused(InputError, tmp_path, "more than once", "a_px.dat and a_px.exr")


def test_an_image_whose_name_ends_like_a_face_is_an_image(tmp_path):
    for name in ("sunset_front", "bright", "laptop", "upright"):
        write_exr(tmp_path / f"{name}.exr", np.ones((4, 8, 3), np.float32))
        assert environment(tmp_path / f"{name}.exr").kind == "latlong"
    refused(InputError, tmp_path, "sunset_right")
    (tmp_path / "sunset_front.exr").unlink()
    refused(InputError, tmp_path, "no cube faces")


# --- the built-in environment ---------------------------------------------------------------------------


def test_demo_is_an_environment_wherever_one_is_taken(device, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    env = environment("demo", device=device)
    assert env.name == "demo" and env.texels.shape == (512, 1024, 3) and env.statistics["max_over_mean"] > 1e5
    assert extent("demo") == ("latlong", 512, 1024) and source_files("demo") == {} and source_name("demo") == "demo"
    assert environment("demo", rotate=90, device=device).rotation == pytest.approx(math.pi / 2)
    refused(UsageError, "demo", "demo", "layout", layout="latlong")
    write_exr(tmp_path / "demo", np.ones((2, 4, 3), np.float32))
    assert environment("demo").texels.shape == (2, 4, 3)  # a file of that name comes first


def test_a_face_that_states_a_layout_is_refused_unless_it_is_called_a_face(tmp_path):
    faces(tmp_path)
    attributes = {"envmap": ("envmap", b"\0")}
    (tmp_path / "ny.exr").write_bytes(exr(Part(planes(np.ones((4, 4, 3), np.float32)), attributes=attributes)))
    refused(InputError, tmp_path, "ny.exr", "envmap", "--layout faces")
    assert environment(tmp_path, layout="faces").kind == "cube"


@pytest.mark.parametrize("what", ["prefilter", "irradiance", "harmonics", "integrate"])
def test_every_function_reads_an_environment_alike(tmp_path, device, what):
    """The options of reading in each function of Python, and its notices."""
    import whitefurnace as wf

    pixels = np.ones((4, 8, 3), np.float32)
    other = pixels.copy()
    other[1, 2, 0] = np.inf
    path = tmp_path / "a.exr"
    path.write_bytes(exr(Part(planes(pixels), "one"), Part(planes(other), "two", window=(0, 0), display=(0, 0, 7, 3))))
    options = {"layer": "two", "layout": "latlong", "fill": "black", "device": device}
    if what == "integrate":
        options |= {"diffuse": "lambert", "albedo": 0.5, "NoV": 0.5, "environment": path}
        arguments = ("radiance",)
    else:
        options |= {"size": 4} if what == "irradiance" else {"size": 8, "min_size": 8} if what == "prefilter" else {}
        arguments = (path,)
    function = getattr(wf, what)
    with pytest.raises(InputError, match="--bad-pixels clamp"):
        function(*arguments, **options)
    for mode in ({"bad_pixels": "zero"}, {"nonfinite": "zero"}):
        found = function(*arguments, **options, **mode)
        assert any("part two was read" in notice for notice in found.notices)
        assert any("1 not finite value was set to 0" in notice for notice in found.notices)
