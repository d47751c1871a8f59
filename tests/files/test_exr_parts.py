"""What an OpenEXR file says about itself is applied, named, or refused by name: parts, layers, windows, attributes."""

from __future__ import annotations

import random
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

import mutations
from exr_writer import Part, exr, floats, planes, text
from reference import cube_directions
from whitefurnace.errors import InputError, UsageError
from whitefurnace.files import image_facts, read_image
from whitefurnace.files.exr_header import read_parts
from whitefurnace.sphere.environments import Reading, environment, extent

RNG = np.random.default_rng(7)
RGB = RNG.random((4, 8, 3)).astype(np.float16)
OTHER = RNG.random((4, 8, 3)).astype(np.float32)
DEPTH = np.full((4, 8), 9, np.float32)


def saved(folder, *parts, name="a.exr"):
    (folder / name).write_bytes(exr(*parts))
    return folder / name


def one_sentence(error, *words):
    said = str(error.value)
    assert "\n" not in said and len(said) < 600 and not said.endswith("."), said
    for word in words:
        assert word in said, f"{word!r} is not in {said!r}"


def refused(path, *words, kind=InputError, **options):
    with pytest.raises(kind) as error:
        read_image(path, **options)
    one_sentence(error, str(path), *words)


def test_the_writer_of_these_tests_writes_what_is_read(tmp_path):
    for order in (0, 1):  # from the top and from the bottom
        path = saved(tmp_path, Part(planes(RGB), line_order=order))
        found = read_image(path)
        np.testing.assert_array_equal(found.pixels, RGB.astype(np.float32))
        assert found.notices == () and found.largest == 65504


# --- parts and layers -----------------------------------------------------------------------------------


def test_the_first_part_with_colour_is_read_and_named(tmp_path):
    path = saved(
        tmp_path,
        Part({"Z": DEPTH}, "depth"),
        Part(planes(RGB), "beauty"),
        Part(planes(OTHER), "diffuse"),
    )
    found = read_image(path)
    np.testing.assert_array_equal(found.pixels, RGB.astype(np.float32))
    (notice,) = found.notices
    assert "part beauty was read" in notice and "depth, diffuse" in notice
    for name in ("diffuse", "Diffuse"):
        np.testing.assert_array_equal(read_image(path, layer=name).pixels, OTHER)
    assert read_image(path, layer="diffuse").largest > 1e38
    refused(path, "'depth'", "Z", "R, G and B", layer="depth")
    refused(path, "'beuty'", "did you mean 'beauty'", kind=UsageError, layer="beuty")
    assert environment(path, layer="diffuse").texels.tolist() == OTHER.tolist()


@pytest.mark.parametrize("names", ["Z", "XYZ", "normal.XYZ", "A", "UV", "ZA"])
def test_what_is_no_light_is_refused_by_name(tmp_path, names):
    layer, _, channels = names.rpartition(".")
    channels = [f"{layer}.{c}" if layer else c for c in channels]
    path = saved(tmp_path, Part({name: DEPTH for name in channels}))
    refused(path, channels[0])
    path = saved(tmp_path, Part({name: DEPTH for name in channels}, "data"), Part({"id": DEPTH}, "other"))
    refused(path, "no layer of light", "data", "other")


def test_colours_in_parts_of_their_own_are_not_taken_as_grey(tmp_path):
    path = saved(tmp_path, *(Part({name: DEPTH}, f"beauty_{name}") for name in "RGB"))
    refused(path, "beauty_R, beauty_G, beauty_B")


def test_data_in_colours_is_light_only_when_asked_for(tmp_path):
    path = saved(tmp_path, Part(planes(OTHER), "normals"), Part({"Z": DEPTH}, "depth"))
    refused(path, "normals", "--layer")
    np.testing.assert_array_equal(read_image(path, layer="normals").pixels, OTHER)
    path = saved(tmp_path, Part(planes(OTHER), "normals"), Part(planes(RGB), "grid"))
    np.testing.assert_array_equal(read_image(path).pixels, RGB.astype(np.float32))


def test_one_layer_of_colour_is_read_and_several_are_asked_for(tmp_path):
    combined = planes(RGB, [f"ViewLayer.Combined.{c}" for c in "RGB"])
    path = saved(tmp_path, Part({**combined, "ViewLayer.Depth.Z": DEPTH}))
    found = read_image(path)
    np.testing.assert_array_equal(found.pixels, RGB.astype(np.float32))
    assert any("layer ViewLayer.Combined was read" in notice for notice in found.notices)
    assert any("ViewLayer.Depth.Z" in notice for notice in found.notices)
    diffuse = planes(OTHER, [f"ViewLayer.Diffuse.{c}" for c in "RGB"])
    crypto = planes(OTHER, [f"ViewLayer.CryptoObject00.{c}" for c in "rgb"])
    path = saved(tmp_path, Part({**combined, **diffuse, **crypto}))
    refused(path, "2 layers", "ViewLayer.Combined, ViewLayer.Diffuse", "--layer")
    for name in ("ViewLayer.Diffuse", "Diffuse", "viewlayer.diffuse"):
        np.testing.assert_array_equal(read_image(path, layer=name).pixels, OTHER)
    refused(path, "did you mean 'ViewLayer.Diffuse'", kind=UsageError, layer="ViewLayer.Difuse")
    # Channels without a layer are the picture itself.
    path = saved(tmp_path, Part({**planes(RGB), **diffuse}))
    np.testing.assert_array_equal(read_image(path).pixels, RGB.astype(np.float32))
    np.testing.assert_array_equal(read_image(path, layer="Diffuse").pixels, OTHER)
    refused(saved(tmp_path, Part(planes(RGB))), "no layer", kind=UsageError, layer="beauty")


def test_a_name_that_fits_several_layers_is_asked_for(tmp_path):
    left, right = (planes(OTHER, [f"{view}.Combined.{c}" for c in "RGB"]) for view in ("left", "right"))
    path = saved(tmp_path, Part({**left, **right}))
    refused(path, "left.Combined, right.Combined", "whole name", kind=UsageError, layer="Combined")


def test_views_are_named_and_can_be_chosen(tmp_path):
    views = "stringvector", b"".join(struct.pack("<i", len(v)) + v for v in (b"left", b"right"))
    right = planes(OTHER, [f"right.{c}" for c in "RGB"])
    path = saved(tmp_path, Part({**planes(RGB), **right}, attributes={"multiView": views}))
    found = read_image(path)
    np.testing.assert_array_equal(found.pixels, RGB.astype(np.float32))
    assert any("left, right" in notice and "left was read" in notice for notice in found.notices)
    np.testing.assert_array_equal(read_image(path, layer="right").pixels, OTHER)
    eyes = [Part(planes(p), n, {"view": text(v)}) for p, n, v in ((RGB, "l", "left"), (OTHER, "r", "right"))]
    path = saved(tmp_path, *eyes)
    assert "view left" in read_image(path).notices[0]
    np.testing.assert_array_equal(read_image(path, layer="right").pixels, OTHER)


def test_channels_of_different_sizes_and_of_integers_are_refused(tmp_path):
    half = np.ones((2, 4), np.float16)
    chroma = Part({"Y": DEPTH, "RY": half, "BY": half}, sampling={"RY": (2, 2), "BY": (2, 2)})
    refused(saved(tmp_path, chroma), "luminance and chroma")
    small = Part({"R": DEPTH, "G": DEPTH, "B": half.astype(np.float32)}, sampling={"B": (2, 2)})
    refused(saved(tmp_path, small), "subsampled")
    refused(saved(tmp_path, Part(planes(np.ones((4, 8, 3), np.uint32)))), "integers", "B, G, R")
    deep = Part(planes(RGB), "a", {"type": text("deepscanline")})
    refused(saved(tmp_path, deep), "deep")
    refused(saved(tmp_path, deep, Part({"Z": DEPTH}, "z")), "no layer of light", "deep")


def test_a_layer_is_of_openexr_alone(tmp_path):
    import OpenImageIO as oiio

    path = tmp_path / "a.png"
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), oiio.ImageSpec(8, 4, 3, "uint8"))
    output.write_image(np.ones((4, 8, 3), np.uint8))
    output.close()
    refused(path, "not OpenEXR", kind=UsageError, layer="beauty")


def test_names_of_channels_may_be_spelled_out_and_small(tmp_path):
    for names in (("red", "green", "blue"), ("r", "g", "b"), ("beauty.Red", "beauty.Green", "beauty.Blue")):
        found = read_image(saved(tmp_path, Part(planes(RGB, names))))
        np.testing.assert_array_equal(found.pixels, RGB.astype(np.float32))


# --- windows --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "window, display, words",
    [
        ((0, 2), (0, 0, 7, 5), ("8 x 4 at (0, 2)", "8 x 6 at (0, 0)", "--fill black")),
        ((-3, 1), (0, 0, 11, 5), ("--fill black",)),
        ((100, 0), (0, 0, 7, 3), ("--fill black",)),
    ],
)
def test_a_data_window_that_lacks_pixels_is_refused_or_filled(tmp_path, window, display, words):
    path = saved(tmp_path, Part(planes(RGB), window=window, display=display))
    refused(path, "data window", *words)
    left, top, right, bottom = display
    want = np.zeros((bottom - top + 1, right - left + 1, 3), np.float32)
    for y in range(4):
        for x in range(8):
            at = window[1] + y - top, window[0] + x - left
            if 0 <= at[0] < want.shape[0] and 0 <= at[1] < want.shape[1]:
                want[at] = RGB[y, x]
    if not want.any():
        refused(path, "no pixel in common", fill="black")
        return
    np.testing.assert_array_equal(read_image(path, fill="black").pixels, want)
    facts = image_facts(path, fill="black", light=True)
    assert (facts.height, facts.width) == want.shape[:2]


def test_a_window_far_larger_than_the_pixels_is_not_filled(tmp_path):
    refused(saved(tmp_path, Part(planes(RGB), display=(0, 0, 9999, 4999))), "64 times", fill="black")
    with pytest.raises(UsageError, match="did you mean 'black'"):
        read_image(saved(tmp_path, Part(planes(RGB))), fill="blak")


def test_what_lies_around_the_display_window_is_left_out_and_said(tmp_path):
    path = saved(tmp_path, Part(planes(RGB), window=(-1, -1), display=(0, 0, 3, 1)))
    found = read_image(path)
    np.testing.assert_array_equal(found.pixels, RGB[1:3, 1:5].astype(np.float32))
    assert any("display window of 4 x 2" in notice for notice in found.notices)


# --- envmap ---------------------------------------------------------------------------------------------


def pattern(d):
    x, y, z = np.moveaxis(d, -1, 0)
    return np.stack([1 + 0.8 * x + 0.1 * y, 1 + 0.8 * y + 0.1 * z, 1 + 0.8 * z + 0.1 * x], -1)


LATLONG = {"envmap": ("envmap", b"\0")}


def openexr_cube(n):
    """The directions, in OpenEXR's x, y, z, of texel centres of six faces as `CubeMap::direction` and
    `CubeMap::pixelPosition` of ImfEnvmap.cpp place them."""
    image = np.zeros((6 * n, n, 3))
    coordinate = (2 * np.arange(n) + 1) / n - 1
    for face in range(6):
        for i in range(n):
            for j in range(n):
                a, b = coordinate[i], coordinate[j]
                d = [(1, a, b), (-1, a, b), (a, 1, b), (a, -1, b), (a, b, 1), (a, b, -1)][face]
                row, column = [
                    (n - 1 - i, j),
                    (n - 1 - i, n - 1 - j),
                    (n - 1 - j, i),
                    (j, i),
                    (n - 1 - j, n - 1 - i),
                    (n - 1 - j, i),
                ][face]
                image[face * n + row, column] = np.array(d) / np.linalg.norm(d)
    return image


def test_a_cube_of_openexr_is_read_by_its_convention(tmp_path):
    n = 16
    theirs = openexr_cube(n)
    # Their lat-longs have +Z in the middle and +X a quarter to the left (ImfEnvmap.h); ours have +X in the middle and
    # +Z a quarter to the right. So ours are (z, y, -x) of theirs.
    ours = np.stack([theirs[..., 2], theirs[..., 1], -theirs[..., 0]], -1)
    path = saved(tmp_path, Part(planes(pattern(ours).astype(np.float32)), attributes={"envmap": ("envmap", b"\1")}))
    env = environment(path)
    assert (env.kind, env.layout) == ("cube", "openexr cube")
    np.testing.assert_allclose(env.texels, pattern(cube_directions(n)), atol=1e-6)  # rounding to float32
    assert any("openexr cube" in notice and "envmap" in notice for notice in env.notices)
    assert extent(path) == ("cube", n, n)
    # As an image without the attribute it is a vertical strip, which --layout overrules.
    plain = saved(tmp_path, Part(planes(pattern(ours).astype(np.float32))), name="b.exr")
    assert environment(plain).layout == "vertical strip"
    np.testing.assert_array_equal(environment(plain, layout="openexr-cube").texels, env.texels)
    assert environment(path, layout="column").layout == "vertical strip"


@pytest.mark.skipif(shutil.which("exrenvmap") is None, reason="exrenvmap is not installed (Debian's openexr)")
def test_a_cube_that_openexr_s_own_tool_makes_of_a_latlong_is_the_same_environment(tmp_path):
    h, w, n = 64, 128, 32
    v, u = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(w) + 0.5) / w, indexing="ij")
    ring, azimuth = np.sin(np.pi * v), 2 * np.pi * (u - 0.5)
    directions = np.stack([ring * np.cos(azimuth), np.cos(np.pi * v), ring * np.sin(azimuth)], -1)
    source = saved(tmp_path, Part(planes(pattern(directions).astype(np.float32)), attributes=LATLONG))
    cube = tmp_path / "cube.exr"
    subprocess.run(["exrenvmap", "-c", "-w", str(n), source, cube], check=True)
    env = environment(cube)
    assert env.layout == "openexr cube"
    # The tool places pixel centres on the edges of both maps: half a texel of 2/n, along which the pattern changes by
    # .8 at most.
    assert np.abs(env.texels - pattern(cube_directions(n))).mean() < 0.8 * 0.5 * 2 / n


def test_a_latlong_of_openexr_is_a_latlong(tmp_path):
    path = saved(tmp_path, Part(planes(RGB), attributes={"envmap": ("envmap", b"\0")}))
    env = environment(path)
    assert env.layout == "latlong" and any("envmap attribute" in notice for notice in env.notices)
    np.testing.assert_array_equal(env.texels, RGB.astype(np.float32))


@pytest.mark.parametrize(
    "kind, shape", [(0, (12, 16)), (0, (6, 1)), (1, (4, 8)), (1, (1, 6)), (1, (1, 1)), (0, (9, 17))]
)
def test_a_size_that_contradicts_the_attribute_is_refused(tmp_path, kind, shape):
    path = saved(
        tmp_path, Part(planes(np.ones((*shape, 3), np.float32)), attributes={"envmap": ("envmap", bytes([kind]))})
    )
    for read in (environment, extent):
        with pytest.raises(InputError) as error:
            read(path)
        one_sentence(error, "envmap", ("latlong", "openexr cube")[kind], f"{shape[1]} x {shape[0]}", "--layout")
    found = environment(path, layout="latlong")
    assert found.texels.shape == (*shape, 3)
    refused(saved(tmp_path, Part(planes(RGB), attributes={"envmap": ("envmap", b"\7")})), "envmap", "7")
    refused(saved(tmp_path, Part(planes(RGB), attributes={"envmap": ("int", b"\1\0\0\0")})), "envmap")


def test_an_environment_map_is_its_data_window(tmp_path):
    """ImfEnvmap.h places the pixels by the data window; the display window does not matter."""
    path = saved(
        tmp_path, Part(planes(RGB), window=(5, 6), display=(0, 0, 1, 1), attributes={"envmap": ("envmap", b"\0")})
    )
    np.testing.assert_array_equal(environment(path).texels, RGB.astype(np.float32))
    assert extent(path) == ("latlong", 4, 8)


WORLDS = sorted(Path("/usr/share/blender/datafiles/studiolights/world").glob("*.exr"))


@pytest.mark.skipif(not WORLDS, reason="the HDRIs of Blender are not installed (Debian's blender-data)")
def test_published_hdris_with_a_few_negatives_are_environments():
    for path in WORLDS:
        env = environment(path)
        assert env.texels.min() == 0 and any("negative value" in notice for notice in env.notices), path.name


# --- other attributes -----------------------------------------------------------------------------------

AP1 = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)


@pytest.mark.parametrize(
    "attributes, words",
    [
        ({"whiteLuminance": floats("float", 80)}, ("whiteLuminance", "80")),
        ({"adoptedNeutral": floats("v2f", 0.3457, 0.3585)}, ("adoptedNeutral",)),
        ({"wrapmodes": text("clamp,periodic")}, ("wrapmodes", "clamp,periodic")),
        ({"renderingTransform": text("film")}, ("renderingTransform", "film")),
        ({"lookModTransform": text("warm")}, ("lookModTransform",)),
        (
            {"worldToCamera": floats("m44f", 0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 0, 1)},
            ("worldToCamera", "--rotate"),
        ),
        ({"oiio:ColorSpace": text("Filmic Log")}, ("Filmic Log",)),
    ],
)
def test_what_is_not_applied_is_named(tmp_path, attributes, words):
    found = read_image(saved(tmp_path, Part(planes(RGB), attributes=attributes)))
    np.testing.assert_array_equal(found.pixels, RGB.astype(np.float32))
    (notice,) = found.notices
    assert all(word in notice for word in words), notice


@pytest.mark.parametrize(
    "attributes",
    [
        {"owner": text("me"), "expTime": floats("float", 0.5), "comments": text("a\nb")},
        {"adoptedNeutral": floats("v2f", 0.3127, 0.329)},
        {"worldToCamera": floats("m44f", *np.eye(4).ravel())},
        {"oiio:ColorSpace": text("lin_rec709")},
        {"colorInteropID": text("lin_rec709_scene")},
        {"envmapper": text("cube")},
    ],
)
def test_what_is_harmless_is_not_named(tmp_path, attributes):
    assert read_image(saved(tmp_path, Part(planes(RGB), attributes=attributes))).notices == ()


def test_primaries_by_numbers_and_by_name_are_one(tmp_path):
    by_numbers = read_image(
        saved(tmp_path, Part(planes(OTHER), attributes={"chromaticities": floats("chromaticities", *AP1)}))
    )
    assert np.abs(by_numbers.pixels - OTHER).max() > 0.1 and "primaries" in by_numbers.notices[0]
    for attribute in ({"colorInteropID": text("lin_ap1_scene")}, {"oiio:ColorSpace": text("ACEScg")}):
        found = read_image(saved(tmp_path, Part(planes(OTHER), attributes=attribute)))
        np.testing.assert_allclose(found.pixels, by_numbers.pixels, atol=1e-6)  # float32 of the numbers in the file
    white = np.ones((4, 8, 3), np.float32)
    aces = read_image(saved(tmp_path, Part(planes(white), attributes={"acesImageContainerFlag": ("int", b"\1\0\0\0")})))
    np.testing.assert_allclose(aces.pixels, 1, atol=1e-6)
    assert "0.7347" in aces.notices[0]


@pytest.mark.parametrize("name", ["srgb_rec709_scene", "g22_ap1_scene", "data", "sRGB", "pq_rec2020_display"])
def test_a_space_that_is_not_linear_is_refused(tmp_path, name):
    for attribute in ("colorInteropID", "oiio:ColorSpace"):
        refused(saved(tmp_path, Part(planes(RGB), attributes={attribute: text(name)})), name, "linear")


def test_pixels_that_are_not_square_are_refused_until_a_layout_is_given(tmp_path):
    path = saved(tmp_path, Part(planes(RGB), attributes={"pixelAspectRatio": floats("float", 2)}))
    for read in (environment, extent):
        with pytest.raises(InputError) as error:
            read(path)
        one_sentence(error, "pixel aspect ratio of 2", "--layout")
    assert environment(path, layout="latlong").texels.shape == (4, 8, 3)
    assert extent(path, Reading(layout="latlong")) == ("latlong", 4, 8)


# --- headers that lie -----------------------------------------------------------------------------------


def header(width, height, compression=3, **more):
    part = Part(planes(RGB), attributes={"dataWindow": ("box2i", struct.pack("<4i", 0, 0, width - 1, height - 1))})
    part.attributes["displayWindow"] = part.attributes["dataWindow"]
    part.attributes["compression"] = ("compression", bytes([compression]))
    return Part(part.planes, part.name, {**part.attributes, **more})


@pytest.mark.parametrize("compression", range(12))
def test_a_size_that_the_bytes_cannot_hold_is_refused_before_anything_is_allocated(tmp_path, compression):
    for width, height in ((16384, 8192), (2**31 - 1, 2**31 - 1), (8, 100_000)):
        refused(saved(tmp_path, header(width, height, compression)), f"{width} x {height}")


@pytest.mark.parametrize(
    "attributes, words",
    [
        ({"dataWindow": ("box2i", struct.pack("<4i", 0, 0, -5, 3))}, ("data window",)),
        ({"displayWindow": ("box2i", struct.pack("<4i", 9, 0, 0, 3))}, ("display window",)),
        ({"compression": ("compression", b"\x63")}, ("compression 99",)),
        ({"channels": ("chlist", b"\0")}, ("channels",)),
        ({"channels": ("chlist", b"R\0" + struct.pack("<iiii", 7, 0, 1, 1) + b"\0")}, ("channels",)),
        ({"channels": ("chlist", b"R\0" + struct.pack("<iiii", 1, 0, 0, 1) + b"\0")}, ("channels",)),
        ({"channels": ("string", b"R")}, ("channels", "string")),
        ({"chromaticities": ("chromaticities", b"\0\0")}, ("chromaticities",)),
        ({"multiView": ("stringvector", struct.pack("<i", 2**30))}, ("multiView",)),
    ],
)
def test_a_header_that_cannot_be_is_one_sentence(tmp_path, attributes, words):
    refused(saved(tmp_path, Part(planes(RGB), attributes=attributes)), *words)


def test_parts_of_one_name_and_no_parts_are_refused(tmp_path):
    refused(saved(tmp_path, Part(planes(RGB), "a"), Part(planes(RGB), "a")), "one name")
    (tmp_path / "b.exr").write_bytes(b"v/1\x01" + struct.pack("<I", 2 | 0x1000) + b"\0" * 9)
    refused(tmp_path / "b.exr", "no part")


def test_every_byte_of_a_header_that_is_cut_is_one_sentence(tmp_path):
    data = exr(Part({"Z": DEPTH}, "depth"), Part(planes(RGB), "beauty"))
    end = data.index(b"beauty") + 200
    path = tmp_path / "a.exr"
    for length in range(8, end, 7):
        path.write_bytes(data[:length])
        with pytest.raises(InputError) as error:
            read_parts(path, length)
        one_sentence(error, str(path))


# --- anything at all ------------------------------------------------------------------------------------


def fuzzed(folder, count, seed):
    """How many of `count` files with structured headers are environments; any error but ours passes through."""
    rng = random.Random(seed)
    print(f"seed {seed}")
    taken = 0
    path = folder / "a.exr"
    for _ in range(count):
        path.write_bytes(mutations.exr(b"", rng))
        layer = rng.choice((None, None, None, "beauty", "left", "Combined", "normal"))
        options = {
            "layer": layer,
            "fill": rng.choice((None, None, "black")),
            "layout": rng.choice((None, None, None, "latlong", "cross", "column", "openexr-cube")),
            "bad_pixels": rng.choice(("refuse", "zero", "clamp")),
        }
        shape = None
        try:
            shape = extent(path, Reading(**options))
        except (InputError, UsageError) as error:
            said = str(error)
        try:
            env = environment(path, **options)
        except (InputError, UsageError) as error:
            said = str(error)
            assert str(path) in said and "\n" not in said and len(said) < 700, said
        else:
            taken += 1
            assert shape == (env.kind, *env.texels.shape[-3:-1]), (shape, env.texels.shape)
            assert np.isfinite(env.texels).all() and env.texels.min() >= 0
            assert not any("\n" in notice for notice in env.notices), env.notices
    return taken


@pytest.mark.filterwarnings("error")
def test_hundreds_of_structured_headers_are_environments_or_one_sentence(tmp_path):
    assert 20 < fuzzed(tmp_path, 600, 21) < 500  # both ends are seen


@pytest.mark.long
def test_twenty_thousand_structured_headers(tmp_path):
    assert 1000 < fuzzed(tmp_path, 20_000, 22) < 19_000
