"""What texture files say about their numbers is applied: order of channels, transfer function, primaries, range,
alpha. And the KTX 1 files of Filament's cmgen, made by the tool itself where it is installed."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reference import cube_directions
from whitefurnace import environment
from whitefurnace.errors import InputError
from whitefurnace.files import read_light, write_exr, write_texture
from whitefurnace.files.codec import encode
from whitefurnace.files.dds import dds_bytes
from whitefurnace.files.gltf_lights import GltfLight, write_gltf_lights
from whitefurnace.files.ktx1 import IDENTIFIER as KTX1
from whitefurnace.files.ktx1 import ktx1_bytes
from whitefurnace.files.ktx2 import ktx2_bytes
from whitefurnace.files.texture import Texture, text_value
from whitefurnace.inspection.comparison import compare
from whitefurnace.inspection.contents import contents, described
from whitefurnace.sphere.grids import radiance_at


def words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def patched(data: bytes, at: int, new: bytes) -> bytes:
    return data[:at] + new + data[at + len(new) :]


def floats(count: int = 4, seed: int = 2) -> np.ndarray:
    """A lat-long of 4 x 8 texels whose halves are exact."""
    return (np.random.default_rng(seed).integers(1, 64, (4, 8, count)) / 64).astype(np.float32)


def decoded(path: Path, data: bytes) -> tuple[np.ndarray, tuple[str, ...]]:
    path.write_bytes(data)
    light = read_light(path)
    texels = light.levels[0].decode()
    assert texels.shape == light.levels[0].shape
    assert tuple(described(contents(path))["notices"])[: len(light.notices)] == light.notices
    return texels, light.notices


def ktx2(image: np.ndarray, form: str = "rgba16f", **keys: bytes) -> bytes:
    return ktx2_bytes(encode(form, [image], key_values=keys).texture)


DFD = 80 + 24
"""Where the data format descriptor of a KTX 2 with one level begins."""


def test_an_order_of_channels_is_applied(tmp_path):
    image = floats()
    r, g, b, a = np.moveaxis(image, -1, 0)
    one, zero = np.ones_like(r), np.zeros_like(r)
    for order, wanted in {
        "rgba": (r, g, b, a),
        "bgra": (b, g, r, a),
        "rgb1": (r, g, b),
        "ggg1": (g, g, g),
        "01ra": (zero, one, r, a),
    }.items():
        texels, notices = decoded(tmp_path / "a.ktx2", ktx2(image, KTXswizzle=text_value(order)))
        assert np.array_equal(texels, np.stack(wanted, -1)), order
        assert (f"KTXswizzle {order} was applied" in " ".join(notices)) == (order != "rgba")
    # A missing channel is 0 and a missing alpha is 1: the usual order of a table changes nothing.
    texels, _ = decoded(tmp_path / "a.ktx2", ktx2(image[..., :2], "rg16f", KTXswizzle=text_value("rg01")))
    assert np.array_equal(texels, image[..., :2])
    texels, _ = decoded(tmp_path / "a.ktx2", ktx2(image[..., :1], "r16f", KTXswizzle=text_value("rrr1")))
    assert np.array_equal(texels, np.repeat(image[..., :1], 3, -1))
    with pytest.raises(InputError, match="KTXswizzle is 'rgbx'"):
        decoded(tmp_path / "a.ktx2", ktx2(image, KTXswizzle=text_value("rgbx")))


def test_a_range_is_applied_to_the_colours(tmp_path):
    image = floats()
    texels, notices = decoded(tmp_path / "a.ktx2", ktx2(image, KTXmapRange=struct.pack("<2f", 8.0, -0.5)))
    assert np.array_equal(texels[..., :3], image[..., :3] * 8 - 0.5) and np.array_equal(texels[..., 3], image[..., 3])
    assert "KTXmapRange was applied, x·8 + -0.5" in notices[0]
    assert decoded(tmp_path / "a.ktx2", ktx2(image, KTXmapRange=struct.pack("<2f", 1, 0)))[1] == ()
    for wrong in (b"1 0\0", struct.pack("<2f", 0, 0), struct.pack("<2f", float("nan"), 0)):
        with pytest.raises(InputError, match="KTXmapRange"):
            decoded(tmp_path / "a.ktx2", ktx2(image, KTXmapRange=wrong))


def test_colours_multiplied_with_alpha_are_divided_by_it(tmp_path):
    image = floats()
    image[0, 0] = 0
    stored = image.copy()
    stored[..., :3] *= image[..., 3:]
    data = ktx2(stored, "rgba32f")
    texels, notices = decoded(tmp_path / "a.ktx2", patched(data, DFD + 15, b"\1"))  # KHR_DF_FLAG_ALPHA_PREMULTIPLIED
    # a product of two numbers of 7 bits is exact in float32, and so is its quotient
    assert np.array_equal(texels, image) and "divided by it" in notices[0]
    data = dds_bytes(encode("rgba32f", [stored]).texture)
    for mode, wanted in ((0, stored), (1, stored), (2, image), (3, stored[..., :3]), (4, stored[..., :3])):
        texels, _ = decoded(tmp_path / "a.dds", patched(data, 144, words(mode)))
        assert np.array_equal(texels, wanted), mode


def srgb(codes: np.ndarray) -> np.ndarray:
    """[IEC 61966-2-1], of codes from 0 to 255."""
    x = codes / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def test_eight_bits_are_linear_or_srgb_as_the_file_states(tmp_path):
    codes = np.random.default_rng(4).integers(0, 256, (4, 8, 4), np.uint8)
    linear = (codes / 255).astype(np.float32)
    curved = np.concatenate([srgb(codes[..., :3]), linear[..., 3:]], -1).astype(np.float32)
    for count, names in ((4, ("rgba8", "rgba8srgb")), (3, ("rgb8", "rgb8srgb"))):
        data = codes[..., :count].tobytes()
        for name, wanted in zip(names, (linear, curved), strict=True):
            texture = Texture(name, 8, 4, (data,))
            for suffix in (".ktx", ".ktx2", ".dds")[: 3 if count == 4 else 2]:
                write_texture(tmp_path / f"a{suffix}", texture)
                texels = read_light(tmp_path / f"a{suffix}").levels[0].decode()
                np.testing.assert_array_equal(texels, wanted[..., :count], err_msg=f"{name}{suffix}")
                assert environment(tmp_path / f"a{suffix}").kind == "latlong"
    # A linear VkFormat whose descriptor states the curve of sRGB
    texels, notices = decoded(
        tmp_path / "a.ktx2", patched(ktx2_bytes(Texture("rgba8", 8, 4, (codes.tobytes(),))), DFD + 14, b"\2")
    )
    assert np.array_equal(texels, curved) and "decoded from sRGB" in notices[0]
    with pytest.raises(InputError, match=r"transfer function 1 \(linear\), rgba8srgb has sRGB"):
        decoded(
            tmp_path / "a.ktx2", patched(ktx2_bytes(Texture("rgba8srgb", 8, 4, (codes.tobytes(),))), DFD + 14, b"\1")
        )


def test_red_and_blue_exchanged(tmp_path):
    codes = np.random.default_rng(5).integers(0, 256, (4, 8, 4), np.uint8)
    wanted = (codes / 255).astype(np.float32)
    swapped = codes[..., [2, 1, 0, 3]].tobytes()
    data = dds_bytes(Texture("rgba8", 8, 4, (swapped,)))
    for code, found in ((87, wanted), (88, wanted[..., :3])):
        assert np.array_equal(decoded(tmp_path / "a.dds", patched(data, 128, words(code)))[0], found)
    data = ktx2_bytes(Texture("rgba8", 8, 4, (swapped,)))
    assert np.array_equal(decoded(tmp_path / "a.ktx2", patched(data, 12, words(44)))[0], wanted)
    three = codes[..., [2, 1, 0]].tobytes()
    data = ktx2_bytes(Texture("rgb8", 8, 4, (three,)))
    assert np.array_equal(decoded(tmp_path / "a.ktx2", patched(data, 12, words(30)))[0], wanted[..., :3])
    data = ktx1_bytes(Texture("rgba8", 8, 4, (swapped,)))
    assert np.array_equal(decoded(tmp_path / "a.ktx", patched(data, 24, words(0x80E1)))[0], wanted)


def test_dds_of_the_time_before_dx10(tmp_path):
    codes = np.random.default_rng(6).integers(0, 256, (4, 8, 4), np.uint8)
    wanted = np.concatenate([srgb(codes[..., :3]), codes[..., 3:] / 255], -1).astype(np.float32)
    new = dds_bytes(Texture("rgba8", 8, 4, (codes.tobytes(),)))
    for flags, bits, masks, order, channels in (
        (0x41, 32, (0xFF, 0xFF00, 0xFF0000, 0xFF000000), [0, 1, 2, 3], 4),
        (0x41, 32, (0xFF0000, 0xFF00, 0xFF, 0xFF000000), [2, 1, 0, 3], 4),
        (0x40, 32, (0xFF0000, 0xFF00, 0xFF, 0), [2, 1, 0, 3], 3),
        (0x40, 32, (0xFF0000, 0xFF00, 0xFF, 0xFF000000), [2, 1, 0, 3], 3),
        (0x40, 24, (0xFF0000, 0xFF00, 0xFF, 0), [2, 1, 0], 3),
        (0x40, 24, (0xFF, 0xFF00, 0xFF0000, 0), [0, 1, 2], 3),
    ):
        data = new[:80] + words(flags, 0, bits, *masks) + new[108:128] + codes[..., order].tobytes()
        texels, notices = decoded(tmp_path / "a.dds", data)
        assert np.array_equal(texels, wanted[..., :channels]), (bits, masks)
        assert "states no transfer function" in notices[0]


def test_primaries_and_curves_of_the_descriptor(tmp_path):
    image = floats(3)
    # ITU-R BT.2087-0: BT.2020 to BT.709, linear, four digits
    matrix = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
    texels, notices = decoded(tmp_path / "a.ktx2", patched(ktx2(image, "rgb32f"), DFD + 13, b"\4"))
    # Four digits of nine products up to 1. What is outside the gamut becomes 0, as of images.
    np.testing.assert_allclose(texels, np.maximum(image @ matrix.T, 0), atol=2e-4)
    assert "BT.2020" in notices[0] and "outside the gamut" in " ".join(
        described(contents(tmp_path / "a.ktx2"))["notices"]
    )
    texels, notices = decoded(tmp_path / "a.ktx2", patched(ktx2(image, "rgb32f"), DFD + 14, b"\2"))
    np.testing.assert_allclose(texels, srgb(image * 255.0), rtol=1e-6)
    assert "sRGB" in notices[0]
    # SMPTE ST 2084: the code .58068888 is 203 cd/m², which is 1 here.
    grey = np.full((4, 8, 3), 0.58068888, np.float32)
    texels, _ = decoded(tmp_path / "a.ktx2", patched(ktx2(grey, "rgb32f"), DFD + 14, b"\x0a"))
    np.testing.assert_allclose(texels, 1, rtol=1e-5)
    assert decoded(tmp_path / "a.ktx2", patched(ktx2(image, "rgb32f"), DFD + 13, b"\0\0"))[1] == ()  # unspecified


def test_an_array_of_one_layer_is_a_single_texture(tmp_path):
    cube = np.random.default_rng(7).random((1, 6, 4, 4, 3), np.float32)
    image = floats(3)[None]
    for suffix in (".ktx", ".ktx2"):
        write_texture(tmp_path / f"a{suffix}", encode("rgba32f", [cube], cube=True).texture)
        found = contents(tmp_path / f"a{suffix}")
        assert found.kind == "cube" and np.array_equal(found.levels[0].texels[..., :3], cube[0])
        assert np.array_equal(environment(tmp_path / f"a{suffix}").texels, cube[0])
        write_texture(tmp_path / f"a{suffix}", encode("rgba32f", [image]).texture)
        assert np.array_equal(environment(tmp_path / f"a{suffix}").texels, image[0])


def test_one_channel_is_grey(tmp_path):
    image = floats(1)
    for suffix in (".ktx", ".ktx2", ".dds"):
        write_texture(tmp_path / f"a{suffix}", encode("r32f", [image]).texture)
        assert np.array_equal(environment(tmp_path / f"a{suffix}").texels, np.repeat(image, 3, -1))


# --- Filament's cmgen ------------------------------------------------------------------------------------


def pattern(d: np.ndarray) -> np.ndarray:
    """An image that shows its own directions (…, 3)."""
    x, y, z = np.moveaxis(d, -1, 0)
    return np.stack([1 + 0.8 * x + 0.1 * y, 1 + 0.8 * y + 0.1 * z, 1 + 0.8 * z + 0.1 * x], -1)


def test_ktx1_as_debian_s_cmgen_writes_it(tmp_path):
    """glType 0x8C3A with glFormat GL_RGB and no key but `sh`; the bytes are laid out by hand."""
    cube = pattern(cube_directions(2)).astype(np.float32)
    texels = encode("b10g11r11", [cube], cube=True).texture.levels[0]
    sh = b"sh\0" + b"\n".join(b"1 0.5 0.25" for _ in range(9)) + b"\n\0"
    keys = words(len(sh)) + sh + bytes(-len(sh) % 4)
    header = words(0x04030201, 0x8C3A, 4, 0x1907, 0x8C3A, 0x1907, 2, 2, 0, 0, 6, 1, len(keys))
    path = tmp_path / "studio_ibl.ktx"
    path.write_bytes(KTX1 + header + keys + words(len(texels) // 6) + bytes(texels))
    found = contents(path)
    assert (found.kind, found.container, found.facts["glFormat"]) == ("cube", "KTX 1", "0x1907")
    # 6 bits of mantissa in red and green, 5 in blue: half a step is at most 1/64 of a value
    np.testing.assert_allclose(found.levels[0].texels, cube, rtol=1 / 64)
    assert found.sh is not None and found.sh.shape == (9, 3)
    assert np.array_equal(environment(path).texels, found.levels[0].texels)
    # glType GL_FLOAT: the texels are floats, whatever a GPU converts them to
    data = ktx1_bytes(encode("rgb32f", [cube], cube=True).texture)
    path.write_bytes(patched(data, 28, words(0x8C3A)))
    assert np.array_equal(environment(path).texels, cube)


@pytest.mark.skipif(shutil.which("cmgen") is None, reason="cmgen is not installed (Debian: libfilament-tools)")
@pytest.mark.parametrize("options, axes", [((), "-z +y +x"), (("--no-mirror",), "+z +y +x")])
def test_cmgen_s_own_files_are_read(tmp_path, shell, options, axes):
    """Its cubes are turned by 90° against ours, and with --no-mirror mirrored too, as the page on cmgen says."""
    rows, columns = 64, 128
    theta = (np.arange(rows)[:, None] + 0.5) * np.pi / rows
    phi = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    d = np.stack(np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)), -1)
    write_exr(tmp_path / "pattern.exr", pattern(d).astype(np.float32))
    subprocess.run(
        [
            *("cmgen", "--quiet", *options, "-x", str(tmp_path / "theirs"), "--format=ktx", "--size=64"),
            *("--ibl-samples=32", str(tmp_path / "pattern.exr")),
        ],
        check=True,
        capture_output=True,
        timeout=60,
    )
    ibl, skybox = (next((tmp_path / "theirs").rglob(f"*_{part}.ktx")) for part in ("ibl", "skybox"))
    for path, levels in ((ibl, 3), (skybox, 1)):
        found = contents(path)
        assert found.kind == "cube" and len(found.levels) == levels
    assert contents(ibl).sh is not None and "filament: the prefiltered chain" in described(contents(ibl))["looks_like"]
    # Of all 48 symmetries of the cube the documented one fits: cmgen reads the nearest texel, 2.8° wide at the most,
    # half of that times .8, and rounds to 6 bits; any other is off by .3 on average.
    texels = contents(skybox).levels[0].texels
    off = {}
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        stored = cube_directions(64)[..., list(order)] * np.array(signs)
        off[order, signs] = float(np.abs(texels - pattern(stored)).mean())
    mirrored = (1, 1, 1) if options else (1, 1, -1)
    assert min(off, key=off.__getitem__) == ((2, 1, 0), mirrored) and off[(2, 1, 0), mirrored] < 0.03
    ours = tmp_path / "ours.npy"
    np.save(ours, pattern(cube_directions(64)).astype(np.float32))
    found = compare(contents(skybox), contents(ours), axes_a=axes)
    assert found.rows[0].rmse is not None and found.rows[0].rmse < 0.04
    assert shell("bake", skybox, "-o", tmp_path / "out", "--dry-run") == 0


# --- lights of glTF ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [90.0, -37.0, 180.0])
def test_the_intensity_and_rotation_of_a_light_are_applied(tmp_path, degrees):
    """L'(d) = intensity · L(q⁻¹ d), with the rotation of scipy."""
    half = np.radians(degrees) / 2
    rotation = (0.0, float(np.sin(half)), 0.0, float(np.cos(half)))
    level = pattern(cube_directions(32)).astype(np.float32)
    write_gltf_lights(tmp_path / "a.gltf", GltfLight((level,), np.zeros((9, 3)), rotation, 2.5))
    env = environment(tmp_path / "a.gltf", rotate=10.0)
    d = np.random.default_rng(8).normal(size=(3, 200))
    d /= np.linalg.norm(d, axis=0)
    turned = Rotation.from_quat(rotation)
    # `rotate` turns from +X towards +Z, which is a rotation by -10° about +Y.
    before = (turned.inv() * Rotation.from_euler("y", 10, degrees=True)).apply(d.T)
    # half the diagonal of a texel, 2.5°, times .8 and 2.5; and the steps of RGBD up to 2.2/255 of 4.5
    np.testing.assert_allclose(radiance_at(env, d), 2.5 * pattern(before), atol=0.13)
    said = " ".join(env.notices)
    assert "an intensity of 2.5" in said and "a rotation about +Y" in said


def test_a_light_that_is_tilted_or_one_of_several_is_named(tmp_path, shell):
    level = np.ones((6, 4, 4, 3), np.float32)
    light = GltfLight((level,), np.zeros((9, 3)), (0.6, 0.0, 0.0, 0.8))
    write_gltf_lights(tmp_path / "a.gltf", light)
    assert shell("bake", tmp_path / "a.gltf", "-o", tmp_path / "out", "--dry-run") == 5
    assert "rotated about another axis than +Y" in shell.sentence()
    assert shell("inspect", tmp_path / "a.gltf") == 0 and "rotation 0.6 0 0 0.8" in shell.out
    write_gltf_lights(tmp_path / "b.gltf", [GltfLight((level,), np.zeros((9, 3))), light])
    assert "the first of its 2 lights was read" in " ".join(environment(tmp_path / "b.gltf").notices)
    text = (tmp_path / "a.gltf").read_text()
    for key, value, says in (
        ("rotation", [0.0, 0.0, 0.0, 2.0], "rotation of light 0 has the length 2"),
        ("rotation", [0.0, 0.0, 0.0, 0.0], "has the length 0"),
        ("intensity", -1.0, "intensity of light 0 is -1"),
        ("intensity", 1e200, "intensity of light 0 is 1e+200"),
        ("intensity", 10**400, "intensity of light 0 is"),
    ):
        document = json.loads(text)
        document["extensions"]["EXT_lights_image_based"]["lights"][0][key] = value
        (tmp_path / "c.gltf").write_text(json.dumps(document))
        with pytest.raises(InputError, match=re.escape(says)):
            environment(tmp_path / "c.gltf")
