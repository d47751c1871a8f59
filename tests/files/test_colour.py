"""What image files state about their colour, orientation and pixels is applied, or refused by name."""

from __future__ import annotations

import contextlib
import io
import itertools
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image as Pillow
from PIL import ImageCms, ImageOps, TiffImagePlugin

from whitefurnace.cli import main
from whitefurnace.errors import InputError
from whitefurnace.files import image_facts, read_image
from whitefurnace.inspection.contents import contents, described
from whitefurnace.sphere.environments import environment, extent

# Matrices from RGB to XYZ of the standards themselves: IEC 61966-2-1 and ITU-R BT.2087.
SRGB_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
REC2020_TO_709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])


def pattern(height=32, width=64):
    """R, G and B encode the direction; all stay within [.1, 1.9]."""
    v, u = np.mgrid[:height, :width]
    polar, azimuth = (v + 0.5) * np.pi / height, ((u + 0.5) / width - 0.5) * 2 * np.pi
    x, y, z = np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)
    return np.stack([1 + 0.8 * x + 0.1 * y, 1 + 0.8 * y + 0.1 * z, 1 + 0.8 * z + 0.1 * x], axis=-1)


def srgb_encoded(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)


def refused(path, *words):
    with pytest.raises(InputError) as error:
        read_image(path)
    text = str(error.value)
    assert "\n" not in text and len(text) < 400 and str(path) in text
    for word in words:
        assert word in text, f"{word!r} is not in {text!r}"


# --- writers, of the tests' own --------------------------------------------------------------------------


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(path: Path, codes, *chunks: tuple[bytes, bytes]) -> Path:
    """A PNG of the codes (h, w, 1 | 3), uint8 or uint16, with these chunks before its pixels."""
    height, width, channels = codes.shape
    rows = codes.astype(codes.dtype.newbyteorder(">")).reshape(height, -1)
    packed = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    head = struct.pack(">IIBBBBB", width, height, 8 * codes.dtype.itemsize, 2 if channels == 3 else 0, 0, 0, 0)
    body = b"".join(chunk(kind, data) for kind, data in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + body + chunk(b"IDAT", packed) + chunk(b"IEND", b""))
    return path


def codes16(encoded):
    return np.rint(np.clip(encoded, 0, 1) * 65535).astype(np.uint16)


def fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(65536 * value) for value in values))


def para(kind: int, *parameters: float) -> bytes:
    return b"para" + bytes(4) + struct.pack(">HH", kind, 0) + fixed(*parameters)


def curv(*values: int) -> bytes:
    return b"curv" + bytes(4) + struct.pack(f">I{len(values)}H", len(values), *values)


def colorant(xyz) -> bytes:
    return b"XYZ " + bytes(4) + fixed(*xyz)


def bradford(white, other):
    m = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    return np.linalg.solve(m, np.diag((m @ other) / (m @ white)) @ m)


def white_of(x, y):
    return np.array([x / y, 1, (1 - x - y) / y])


D65, D50 = white_of(0.3127, 0.3290), np.array([0.9642, 1, 0.8249])


def colorants(primaries=(0.64, 0.33, 0.30, 0.60, 0.15, 0.06), white=D65):
    """Columns XYZ of red, green and blue, adapted to D50."""
    xyz = np.stack([white_of(*primaries[k : k + 2]) for k in (0, 2, 4)], axis=1)
    return bradford(white, D50) @ (xyz * np.linalg.solve(xyz, white))


def profile(tags: dict[bytes, bytes], space=b"RGB ", pcs=b"XYZ ", kind=b"mntr", version=4) -> bytes:
    head = bytearray(128)
    head[8], head[12:16], head[16:20], head[20:24] = version, kind, space, pcs
    head[36:40] = b"acsp"
    head[68:80] = fixed(*D50)
    at, table, body = 132 + 12 * len(tags), b"", b""
    for name, data in tags.items():
        table += struct.pack(">4sII", name, at + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head[0:4] = struct.pack(">I", at + len(body))
    return bytes(head) + struct.pack(">I", len(tags)) + table + body


def matrix_profile(curves: list[bytes], columns=None, **options) -> bytes:
    columns = colorants() if columns is None else columns
    tags = {name: colorant(columns[:, k]) for k, name in enumerate((b"rXYZ", b"gXYZ", b"bXYZ"))}
    tags |= dict(zip((b"rTRC", b"gTRC", b"bTRC"), curves * (3 // len(curves)), strict=True))
    return profile(tags | {b"wtpt": colorant(D50)}, **options)


def iccp(data: bytes) -> tuple[bytes, bytes]:
    return b"iCCP", b"name\0\0" + zlib.compress(data)


P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060)
GAMMA_22 = curv(round(2.2 * 256))
SRGB_PARA = para(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


# --- ICC profiles ----------------------------------------------------------------------------------------


def stored_as(tmp_path: Path, form: str, codes8, icc: bytes) -> Path:
    path = tmp_path / f"a.{form}"
    options = {"webp": {"lossless": True}, "jpg": {"quality": 100, "subsampling": 0}}.get(form, {})
    Pillow.fromarray(codes8).save(path, icc_profile=icc, **options)
    return path


@pytest.mark.parametrize("form, within", [("png", 0.002), ("tif", 0.002), ("webp", 0.002), ("jpg", 0.01)])
def test_a_linear_profile_is_applied_in_every_format(tmp_path, form, within):
    """8 bits of linear light round by 1/510, a tenth of a percent of the pattern on average; JPEG adds two codes."""
    codes = np.rint(pattern() / 2 * 255).astype(np.uint8)
    image = read_image(stored_as(tmp_path, form, codes, matrix_profile([curv()])))
    assert np.abs(2 * image.pixels - pattern()).mean() < within
    (notice,) = image.notices
    assert "an ICC profile" in notice


def test_sixteen_bits_keep_their_precision(tmp_path):
    """A power of 1.8: every code gives what float64 gives, rounded to float32 once."""
    codes = np.arange(65536, dtype=np.uint16).reshape(128, 512, 1).repeat(3, axis=2)
    image = read_image(png(tmp_path / "a.png", codes, iccp(matrix_profile([para(0, 1.8)]))))
    # 1.8 in ICC's fixed point is 117965/65536.
    np.testing.assert_allclose(image.pixels, (codes / 65535) ** (117965 / 65536), rtol=2e-7)


@pytest.mark.parametrize("icc", ["littlecms", "para", "curv1024", "iec rounded"])
def test_profiles_of_srgb_give_what_no_profile_gives(tmp_path, icc):
    """Profiles round sRGB to four or five digits; that makes no difference, not even in the last bit."""
    x = np.linspace(0, 1, 1024)
    decoded = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    table = curv(*np.rint(65535 * decoded).astype(int))
    data = {
        "littlecms": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
        "para": matrix_profile([SRGB_PARA]),
        "curv1024": matrix_profile([table], version=2),
        # The colorants of the profile that Hewlett-Packard published with the standard.
        "iec rounded": matrix_profile(
            [table], np.array([[0.4361, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]]), version=2
        ),
    }[icc]
    codes = np.random.default_rng(3).integers(0, 65536, (16, 32, 3), np.uint16)
    image = read_image(png(tmp_path / "a.png", codes, iccp(data)))
    np.testing.assert_array_equal(image.pixels, read_image(png(tmp_path / "b.png", codes)).pixels)
    assert image.notices == ()


CURVES = {
    "table": curv(*(round(65535 * (k / 63) ** 1.7) for k in range(64))),
    "gamma": GAMMA_22,
    "type 0": para(0, 2.0),
    "type 1": para(1, 2.2, 0.9, 0.1),
    "type 2": para(2, 2.2, 0.9, 0.05, 0.04),
    "type 3": SRGB_PARA,
    "type 4": para(4, 2.3, 0.9, 0.1, 0.1, 0.05, 0.01, 0.002),
}


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("primaries", [(0.64, 0.33, 0.30, 0.60, 0.15, 0.06), P3], ids=["709", "p3"])
def test_matrix_profiles_agree_with_littlecms(tmp_path, name, primaries):
    """Both end in sRGB of 8 bits, where littlecms rounds: its curves and matrix of 8 bits err by a code at most."""
    data = matrix_profile([CURVES[name]], colorants(primaries))
    codes = np.array(list(itertools.product(range(0, 256, 51), repeat=3)), np.uint8).reshape(12, 18, 3)
    transform = ImageCms.buildTransform(
        ImageCms.ImageCmsProfile(io.BytesIO(data)),
        ImageCms.createProfile("sRGB"),
        "RGB",
        "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
        flags=ImageCms.Flags.NOOPTIMIZE,
    )
    want = np.asarray(ImageCms.applyTransform(Pillow.fromarray(codes), transform)).astype(float)
    pixels = read_image(png(tmp_path / "a.png", codes, iccp(data))).pixels
    got = 255 * srgb_encoded(np.clip(pixels.astype(float), 0, 1))
    assert np.abs(got - want).max() <= 1.0


def test_grey_profiles(tmp_path):
    grey = profile({b"kTRC": para(0, 1.5)}, space=b"GRAY")
    codes = np.arange(256, dtype=np.uint8).reshape(8, 32, 1)
    pixels = read_image(png(tmp_path / "a.png", codes, iccp(grey))).pixels
    np.testing.assert_allclose(pixels, (codes / 255) ** 1.5, rtol=2e-7)
    # Programs leave the profile of RGB in grey images; with equal curves it says the same.
    pixels = read_image(png(tmp_path / "b.png", codes, iccp(matrix_profile([para(0, 1.5)])))).pixels
    np.testing.assert_allclose(pixels, (codes / 255) ** 1.5, rtol=2e-7)
    # Over Lab the curve gives lightness; sRGB of 8 bits is compared, as for colours.
    lightness = profile({b"kTRC": para(0, 1.2)}, space=b"GRAY", pcs=b"Lab ")
    transform = ImageCms.buildTransform(
        ImageCms.ImageCmsProfile(io.BytesIO(lightness)), ImageCms.createProfile("sRGB"), "L", "RGB", 1
    )
    want = np.asarray(ImageCms.applyTransform(Pillow.fromarray(codes[..., 0]), transform))[..., :1].astype(float)
    pixels = read_image(png(tmp_path / "e.png", codes, iccp(lightness))).pixels
    assert np.abs(255 * srgb_encoded(pixels.astype(float)) - want).max() <= 1
    three = matrix_profile([para(0, 1.5), para(0, 2.0), para(0, 2.5)])
    refused(png(tmp_path / "c.png", codes, iccp(three)), "grey", "different curves")
    refused(png(tmp_path / "d.png", codes.repeat(3, axis=2), iccp(grey)), "grey ICC profile", "3 channels")


LINEAR_TAGS = {b"rXYZ": colorant(colorants()[:, 0])}


@pytest.mark.parametrize(
    "data, words",
    [
        (profile({b"A2B0": bytes(32)}), ("lookup tables (A2B0)",)),
        (profile({b"D2B1": bytes(32)}), ("lookup tables (D2B1)",)),
        (profile({b"A2B0": bytes(32)}, space=b"CMYK", pcs=b"Lab ", kind=b"prtr"), ("colour space CMYK",)),
        (profile({}, space=b"Lab "), ("colour space Lab",)),
        (profile({}, kind=b"link"), ("class link",)),
        (profile({}, version=5), ("version 5",)),
        (profile({b"kTRC": curv()}, space=b"GRAY"), ("3 channels",)),
        (profile(LINEAR_TAGS), ("the tag gXYZ",)),
        (matrix_profile([para(7, 1)]), ("parametric type 7",)),
        (matrix_profile([para(0, 0)]), ("exponent 0",)),
        (matrix_profile([curv(0)]), ("a power of 0",)),
        (matrix_profile([b"curv" + bytes(4) + struct.pack(">I", 1 << 30)]), ("cannot hold so many",)),
        (matrix_profile([b"text" + bytes(8)]), ("of type text",)),
        (matrix_profile([curv()], np.ones((3, 3))), ("span no colour space",)),
        (matrix_profile([curv()])[:150], ("states", "150 are there")),
        (b"none", ("does not begin",)),
    ],
)
def test_profiles_that_are_refused_by_name(tmp_path, data, words):
    path = png(tmp_path / "a.png", np.full((2, 4, 3), 99, np.uint8), iccp(data))
    refused(path, "ICC profile", *words)


def test_a_profile_with_code_points_is_read_by_them(tmp_path):
    """The tag cicp of ICC.1:2022 says PQ, which curves up to 1 cannot."""
    data = profile({b"A2B0": bytes(32), b"cicp": b"cicp" + bytes(4) + bytes((1, 16, 0, 1))})
    codes = np.full((2, 4, 3), round(0.58069 * 65535), np.uint16)  # BT.2408: 203 cd/m² is 58 % of PQ
    np.testing.assert_allclose(read_image(png(tmp_path / "a.png", codes, iccp(data))).pixels, 1, rtol=1e-3)


def test_a_profile_of_jpeg_in_parts(tmp_path):
    """A profile of more than 64 kB is cut into segments, which may come in any order; a missing one is told."""
    big = matrix_profile([curv(*(round(65535 * (k / 39999) ** 3) for k in range(40000)))])
    path = tmp_path / "a.jpg"
    Pillow.new("RGB", (8, 4), (188, 188, 188)).save(path, icc_profile=big, quality=100)
    np.testing.assert_allclose(read_image(path).pixels, (188 / 255) ** 3, rtol=1e-3)
    data = path.read_bytes()
    first = data.index(b"ICC_PROFILE\0\1") - 4
    second = data.index(b"ICC_PROFILE\0\2") - 4
    end = second + 2 + int.from_bytes(data[second + 2 : second + 4], "big")
    path.write_bytes(data[:first] + data[second:end] + data[first:second] + data[end:])
    np.testing.assert_allclose(read_image(path).pixels, (188 / 255) ** 3, rtol=1e-3)
    path.write_bytes(data[:first] + data[second:])
    refused(path, "not complete", "[2")


# --- PNG -------------------------------------------------------------------------------------------------


def gama(value: float) -> tuple[bytes, bytes]:
    return b"gAMA", struct.pack(">I", round(value * 1e5))


def chrm(primaries=P3, white=(0.3127, 0.3290)) -> tuple[bytes, bytes]:
    return b"cHRM", struct.pack(">8I", *(round(1e5 * value) for value in (*white, *primaries)))


SRGB = (b"sRGB", b"\0")


def test_gama(tmp_path):
    image = read_image(png(tmp_path / "a.png", codes16(pattern() / 2), gama(1)))
    assert np.abs(2 * image.pixels - pattern()).mean() < 2e-5  # half a step of 16 bits, doubled
    assert len(image.notices) == 1 and "gAMA (1)" in image.notices[0]
    # The PNG specification's decoding: light is the sample to the power of 1/gamma, without sRGB's toe.
    codes = np.arange(256, dtype=np.uint8).reshape(8, 32, 1)
    for gamma in (0.45455, 0.55, 0.3):
        pixels = read_image(png(tmp_path / "b.png", codes, gama(gamma))).pixels
        np.testing.assert_allclose(pixels, (codes / 255) ** (1 / gamma), rtol=2e-7)
    refused(png(tmp_path / "c.png", codes, (b"gAMA", bytes(4))), "gamma of 0")
    refused(png(tmp_path / "d.png", codes, (b"gAMA", bytes(3))), "gAMA has 3 bytes")
    refused(png(tmp_path / "e.png", codes, gama(1), gama(1)), "gAMA more than once")


def test_notices_are_told_once(tmp_path, capsys):
    """`inspect` prints a notice and writes it as JSON, and Python's environment has it."""
    path = png(tmp_path / "a.png", codes16(pattern() / 2), gama(1))
    for arguments in (["inspect", str(path)], ["inspect", str(path), "--json"]):
        with contextlib.suppress(SystemExit):
            main(arguments)
        out, err = capsys.readouterr()
        assert (out + err).count("gAMA (1)") == 1
    assert sum("gAMA (1)" in notice for notice in environment(path).notices) == 1


def test_chrm(tmp_path):
    """P3 with the curve of sRGB: the published matrix of Display P3 to sRGB, of four digits."""
    matrix = np.array([[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]])
    linear = np.array([0.5, 0.4, 0.3])
    codes = np.tile(codes16(srgb_encoded(linear)), (2, 4, 1))
    image = read_image(png(tmp_path / "a.png", codes, chrm()))
    np.testing.assert_allclose(image.pixels[0, 0], matrix @ linear, atol=3e-4)
    assert "cHRM" in image.notices[0]
    plain = read_image(png(tmp_path / "b.png", codes)).pixels
    rec709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
    np.testing.assert_array_equal(read_image(png(tmp_path / "c.png", codes, chrm(rec709))).pixels, plain)
    refused(png(tmp_path / "d.png", codes, chrm((0.3,) * 6)), "span no colour space")


def test_colours_outside_the_gamut_become_0_and_are_counted(tmp_path):
    codes = np.zeros((2, 4, 3), np.uint16)
    codes[0, 0] = 0, 65535, 0
    image = read_image(png(tmp_path / "a.png", codes, (b"cICP", bytes((9, 8, 0, 1)))))
    np.testing.assert_allclose(image.pixels[0, 0], [0, 1.1329, 0], atol=1e-4)
    assert "2 values outside the gamut" in image.notices[1] and "-0.588" in image.notices[1]
    assert environment(tmp_path / "a.png").texels.min() == 0


def test_the_order_of_the_png_specification(tmp_path):
    """cICP over iCCP over sRGB over gAMA and cHRM [PNG 3, 4.3]; each says another curve here."""
    codes = np.full((2, 4, 3), 30000, np.uint16)
    x = 30000 / 65535
    said = [
        ((b"cICP", bytes((1, 4, 0, 1))), x**2.2),
        (iccp(matrix_profile([para(0, 1.5)])), x**1.5),
        (SRGB, ((x + 0.055) / 1.055) ** 2.4),
        (gama(1), x),
    ]
    for first in range(len(said)):
        path = png(tmp_path / "a.png", codes, *(one for one, _ in said[first:]))
        np.testing.assert_allclose(read_image(path).pixels, said[first][1], rtol=1e-4)  # ICC's fixed point
    harmless = ((b"mDCV", bytes(24)), (b"cLLI", bytes(8)), (b"sBIT", bytes((16, 16, 16))), (b"tIME", bytes(7)))
    np.testing.assert_array_equal(
        read_image(png(tmp_path / "b.png", codes, *harmless)).pixels, read_image(png(tmp_path / "c.png", codes)).pixels
    )


def pq_encoded(nits):
    y = (nits / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * y) / (1 + 18.6875 * y)) ** 78.84375


def hlg_encoded(e):
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(e <= 1 / 12, np.sqrt(3 * e), a * np.log(12 * e - b) + c)


def rec709_encoded(light):
    return np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)


@pytest.mark.parametrize(
    "transfer, encode, within",
    [
        *((k, rec709_encoded, 2e-3) for k in (1, 6, 14, 15)),  # the constants have three digits here
        (4, lambda x: x ** (1 / 2.2), 1e-4),
        (5, lambda x: x ** (1 / 2.8), 1e-4),
        (8, lambda x: x, 1e-4),
        (13, srgb_encoded, 1e-4),
        (16, lambda x: pq_encoded(203 * x), 1e-4),
    ],
)
def test_transfer_functions_by_code_point(tmp_path, transfer, encode, within):
    light = np.linspace(0.02, 1, 8 * 32 * 3).reshape(8, 32, 3)
    path = png(tmp_path / "a.png", codes16(encode(light)), (b"cICP", bytes((1, transfer, 0, 1))))
    np.testing.assert_allclose(read_image(path).pixels, light, rtol=within, atol=2e-5)


def test_pq_is_1_at_203_nits_and_has_its_peak(tmp_path):
    linear = pattern() @ np.linalg.inv(REC2020_TO_709).T  # in gamut: the pattern itself is Rec.709
    path = png(tmp_path / "a.png", codes16(pq_encoded(203 * linear)), (b"cICP", bytes((9, 16, 0, 1))))
    image = read_image(path)
    assert np.abs(image.pixels - pattern()).mean() < 2e-4  # the matrix has four digits
    white = png(tmp_path / "b.png", np.full((1, 2, 3), 65535, np.uint16), (b"cICP", bytes((9, 16, 0, 1))))
    np.testing.assert_allclose(read_image(white).pixels, 10000 / 203, rtol=1e-5)


def test_the_limit_of_codes_is_what_the_largest_code_means(tmp_path):
    """PQ's largest code is 10 000 cd/m²; a value over 1 is not at the limit of its format."""
    codes = codes16(pq_encoded(np.array([203.0, 1000, 10000]))).reshape(1, 3, 1).repeat(3, axis=2)
    path = png(tmp_path / "a.png", codes, (b"cICP", bytes((1, 16, 0, 1))))
    assert read_image(path).largest == pytest.approx(10000 / 203, rel=1e-6)
    (row,) = described(contents(path))["levels"]
    assert row["at_limit"] == 3
    (row,) = described(contents(png(tmp_path / "b.png", codes)))["levels"]
    assert row["at_limit"] == 3 and read_image(tmp_path / "b.png").largest == 1


def test_hlg_with_its_ootf(tmp_path):
    """BT.2408: 75 % of HLG is 203 cd/m² on a display of 1000; a colour keeps its ratios but for luminance^.2."""
    grey = png(tmp_path / "a.png", codes16(np.full((1, 2, 1), 0.75)), (b"cICP", bytes((9, 18, 0, 1))))
    np.testing.assert_allclose(read_image(grey).pixels, 1, rtol=2e-3)  # 203 is rounded from 203.3
    scene = np.array([0.2, 0.1, 0.05])
    path = png(tmp_path / "b.png", np.tile(codes16(hlg_encoded(scene)), (2, 4, 1)), (b"cICP", bytes((9, 18, 0, 1))))
    display = 1000 * (scene @ [0.2627, 0.6780, 0.0593]) ** 0.2 * scene
    np.testing.assert_allclose(read_image(path).pixels[0, 0], REC2020_TO_709 @ display / 203, rtol=2e-3)
    peak = png(tmp_path / "c.png", np.full((1, 2, 3), 65535, np.uint16), (b"cICP", bytes((9, 18, 0, 1))))
    np.testing.assert_allclose(read_image(peak).pixels, 1000 / 203, rtol=1e-3)


def test_primaries_and_range_by_code_point(tmp_path):
    linear = np.tile([0.5, 0.4, 0.3], (2, 4, 1))
    path = png(tmp_path / "a.png", codes16(linear), (b"cICP", bytes((9, 8, 0, 1))))
    np.testing.assert_allclose(read_image(path).pixels[0, 0], REC2020_TO_709 @ linear[0, 0], atol=2e-4)
    # Both whites become D65: white stays white.
    for primaries in (1, 4, 5, 6, 7, 9, 11, 12, 22):
        path = png(tmp_path / "b.png", np.full((1, 2, 3), 65535, np.uint16), (b"cICP", bytes((primaries, 8, 0, 1))))
        np.testing.assert_allclose(read_image(path).pixels, 1, atol=1e-6)
    # H.273: 16 is black and 235 white of 8 bits; what lies beyond is clipped.
    codes = np.array([0, 16, 126, 235, 255], np.uint8).reshape(1, 5, 1).repeat(3, axis=2)
    path = png(tmp_path / "c.png", codes, (b"cICP", bytes((1, 8, 0, 0))))
    np.testing.assert_allclose(read_image(path).pixels[0, :, 0], [0, 0, 110 / 219, 1, 1], rtol=1e-6)
    codes = np.full((1, 2, 3), 126 * 256, np.uint16)
    path = png(tmp_path / "d.png", codes, (b"cICP", bytes((1, 8, 0, 0))))
    np.testing.assert_allclose(read_image(path).pixels, 110 / 219, rtol=1e-6)
    for points, word in (
        ((2, 13, 0, 1), "colour primaries 2"),
        ((1, 2, 0, 1), "transfer characteristics 2"),
        ((1, 9, 0, 1), "transfer characteristics 9"),
        ((1, 13, 1, 1), "matrix coefficients 1"),
        ((1, 13, 0, 2), "range 2"),
        ((1, 13, 0), "cICP has 3 bytes"),
    ):
        refused(png(tmp_path / "e.png", codes, (b"cICP", bytes(points))), word)


def test_pixels_that_are_not_square_and_animations_are_refused(tmp_path):
    codes = np.full((4, 8, 3), 99, np.uint8)
    picture = Pillow.fromarray(codes)
    png(tmp_path / "a.png", codes, (b"pHYs", struct.pack(">IIB", 1000, 2000, 0)))
    picture.save(tmp_path / "b.jpg", dpi=(72, 144))
    picture.save(tmp_path / "c.tif", dpi=(72, 144))
    picture.save(tmp_path / "d.bmp", dpi=(72, 144))
    hdr(tmp_path / "e.hdr", codes, "-Y 4 +X 8", "PIXASPECT=.5")
    for name in ("a.png", "b.jpg", "c.tif", "d.bmp", "e.hdr"):
        for read in (environment, extent):
            with pytest.raises(InputError, match=r"pixel aspect ratio.*--layout"):
                read(tmp_path / name)
        assert read_image(tmp_path / name).aspect == pytest.approx(2, rel=1e-3)
        notices = environment(tmp_path / name, layout="latlong").notices
        assert any("pixel aspect ratio" in notice for notice in notices)
    square = png(tmp_path / "f.png", codes, (b"pHYs", struct.pack(">IIB", 2835, 2835, 1)))
    assert environment(square).notices == ()
    other = Pillow.new("RGB", (8, 4), (1, 2, 3))
    for suffix in ("png", "webp", "gif"):
        picture.save(tmp_path / f"e.{suffix}", save_all=True, append_images=[other])
        refused(tmp_path / f"e.{suffix}", "single")


def test_depths_palettes_and_interlacing(tmp_path):
    """Pillow, which decodes by itself, expands every kind of PNG to the codes that are read here as sRGB."""
    noise = Pillow.fromarray(np.random.default_rng(5).integers(0, 256, (8, 16, 3), np.uint8))
    for name, picture, options in (
        ("one", noise.convert("1"), {}),
        ("two", noise.convert("L").quantize(4), {"bits": 2}),
        ("four", noise.quantize(16), {"bits": 4}),
        ("palette", noise.quantize(64), {}),
        ("transparent", noise.quantize(8), {"transparency": 3}),
        ("grey", noise.convert("L"), {}),
        ("rgba", noise.convert("RGBA"), {}),
        ("gif", noise.quantize(64), {}),
    ):
        path = tmp_path / (f"{name}.gif" if name == "gif" else f"{name}.png")
        picture.save(path, **options)
        image = read_image(path).pixels
        mode = {1: "L", 3: "RGB", 4: "RGBA"}[image.shape[2]]
        want = np.asarray(Pillow.open(path).convert(mode)).reshape(image.shape)
        np.testing.assert_allclose(srgb_encoded(image[..., :3].astype(float)) * 255, want[..., :3], atol=1e-3)
        if image.shape[2] == 4:
            np.testing.assert_allclose(image[..., 3] * 255, want[..., 3], atol=1e-3)


# --- orientation -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_of_exif(tmp_path, suffix, orientation):
    """Pillow turns the picture by Exif too; blocks of 8 pixels survive JPEG. `extent` knows the turned sizes."""
    blocks = np.random.default_rng(7).integers(60, 200, (2, 4, 1)).astype(np.uint8)
    codes = blocks.repeat(8, axis=0).repeat(8, axis=1).repeat(3, axis=2)
    exif = Pillow.Exif()
    exif[0x112] = orientation
    stored = Pillow.fromarray(codes if orientation < 5 else codes.swapaxes(0, 1))
    path = tmp_path / f"a.{suffix}"
    stored.save(path, exif=exif.tobytes(), **({"lossless": True} if suffix == "webp" else {}))
    want = np.asarray(ImageOps.exif_transpose(Pillow.open(path))).astype(float)
    got = 255 * srgb_encoded(read_image(path).pixels.astype(float))
    np.testing.assert_allclose(got, want, atol=1.5)  # JPEG's decoders differ by a code
    assert extent(path) == ("latlong", 16, 32)
    assert (image_facts(path).width, image_facts(path).height) == (32, 16)


# --- Radiance --------------------------------------------------------------------------------------------


def rgbe(values) -> np.ndarray:
    """Codes (…, 4), rounded to the nearest [Ward 1991]."""
    values = np.asarray(values, float)
    exponent = np.frexp(values.max(axis=-1))[1]
    exponent = exponent + (np.rint(values * np.ldexp(1.0, 8 - exponent)[..., None]).max(axis=-1) > 255)
    codes = np.rint(values * np.ldexp(1.0, 8 - exponent)[..., None])
    return np.concatenate([codes, exponent[..., None] + 128], axis=-1).astype(np.uint8)


def hdr(path: Path, scans, order: str, *lines: str, form="32-bit_rle_rgbe", newline="\n") -> Path:
    text = newline.join(["#?RADIANCE", f"FORMAT={form}", *lines, "", order]) + "\n"
    path.write_bytes(text.encode() + rgbe(scans).tobytes())
    return path


@pytest.mark.parametrize("major, minor", [(a, b) for a in ("-Y", "+Y", "-X", "+X") for b in ("-Y", "+Y", "-X", "+X")])
def test_all_eight_orientations_of_radiance(tmp_path, major, minor):
    """A scanline runs along the second axis; +Y is up [Radiance file formats]."""
    if major[1] == minor[1]:
        return
    want = pattern()
    sizes = {"Y": 32, "X": 64}

    def place(axis, k):  # the row or column of the k-th step along an axis
        size = sizes[axis[1]]
        down = axis in ("-Y", "+X")
        return k if down else size - 1 - k

    scans = np.empty((sizes[major[1]], sizes[minor[1]], 3))
    for i in range(len(scans)):
        for j in range(len(scans[0])):
            row, column = (i, j) if major[1] == "Y" else (j, i)
            axes = (major, minor) if major[1] == "Y" else (minor, major)
            scans[i, j] = want[place(axes[0], row), place(axes[1], column)]
    order = f"{major} {sizes[major[1]]} {minor} {sizes[minor[1]]}"
    path = hdr(tmp_path / "a.hdr", scans, order)
    pixels = read_image(path).pixels
    assert pixels.shape == want.shape and np.abs(pixels - want).mean() < 0.004  # RGBE's step of 1/256
    assert extent(path) == ("latlong", 32, 64)


def test_exposure_and_its_like_are_cumulative(tmp_path):
    order = "-Y 32 +X 64"

    def read(values, *lines):
        return read_image(hdr(tmp_path / "a.hdr", values, order, *lines))

    want = pattern()
    image = read(want * 0.25, "EXPOSURE=0.5", "SOFTWARE=pfilt", "EXPOSURE= 5e-1")
    assert np.abs(image.pixels - want).mean() < 0.004
    assert len(image.notices) == 1 and "EXPOSURE of 0.25" in image.notices[0]
    assert read(want, "EXPOSURE=1").notices == ()
    image = read(want * [2, 1, 0.25], "COLORCORR=2 1 .5", "COLORCORR= 1 1 0.5")
    # The steps of RGBE are those of the largest channel, which is up to eight times as large.
    assert np.abs(image.pixels - want).mean() < 0.012 and "COLORCORR of 2 1 0.25" in image.notices[0]
    image = read((want * 0.5) ** (1 / 2.2), "GAMMA=2.2", "EXPOSURE=.5")
    assert np.abs(image.pixels - want).mean() < 0.012  # 2.2 times RGBE's step
    # Lines that begin with a tab belong to the pictures that this one was made of.
    assert read(want, "\tEXPOSURE=4", "pcomb -e x").notices == ()
    assert np.abs(read(want, "PIXASPECT=.5", "PIXASPECT=2").pixels - want).mean() < 0.004


@pytest.mark.parametrize(
    "line, word",
    [
        ("EXPOSURE=abc", "EXPOSURE='abc'"),
        ("EXPOSURE=", "EXPOSURE=''"),
        ("EXPOSURE=0", "over 0"),
        ("EXPOSURE=-1", "over 0"),
        ("EXPOSURE=nan", "over 0"),
        ("EXPOSURE=1e400", "over 0"),
        ("EXPOSURE=1 2", "a number over 0"),
        ("EXPOSURE=1e20\nEXPOSURE=1e20", "outside [1e-30, 1e30]"),
        ("EXPOSURE=1e-31", "outside [1e-30, 1e30]"),
        ("COLORCORR=1 1", "3 numbers"),
        ("COLORCORR=1 0 1", "3 numbers over 0"),
        ("PIXASPECT=x", "PIXASPECT"),
        ("PIXASPECT=1e300", "PIXASPECT"),
        ("GAMMA=0", "GAMMA='0'"),
        ("PRIMARIES=1 2 3", "8 numbers"),
        ("PRIMARIES=.3 .3 .3 .3 .3 .3 .3 .3", "span no colour space"),
        ("FORMAT=32-bit_rle_xyze", "XYZE"),
    ],
)
def test_headers_of_radiance_that_are_refused(tmp_path, line, word):
    refused(hdr(tmp_path / "a.hdr", np.ones((2, 4, 3)), "-Y 2 +X 4", line), word)


def test_forms_of_radiance(tmp_path):
    want = pattern()
    refused(hdr(tmp_path / "a.hdr", want, "-Y 32 +X 64", form="32-bit_rle_xyze"), "XYZE", "ra_xyze")
    refused(hdr(tmp_path / "b.hdr", want, "-Y 32 +X 64", form="rgb8"), "'rgb8'")
    for order in ("-Y 32 -Y 64", "-Y 0 +X 64", "32 64", "-Y +X", "-Y 32 +X 9999999999999999999"):
        refused(hdr(tmp_path / "c.hdr", want, order), "resolution")
    (tmp_path / "d.hdr").write_bytes(b"#?RADIANCE\nEXPOSURE=1\n\n-Y 2 +X 4\n" + bytes(32))
    refused(tmp_path / "d.hdr", "no line FORMAT=")
    # Windows line ends, and the old run-length code: a texel 1 1 1 n repeats the one before n times.
    assert np.abs(read_image(hdr(tmp_path / "e.hdr", want, "-Y 32 +X 64", newline="\r\n")).pixels - want).mean() < 0.004
    head = b"#?RGBE\nFORMAT=32-bit_rle_rgbe\n\n+X 8 +Y 4\n"
    (tmp_path / "f.hdr").write_bytes(head + (bytes((128, 64, 32, 129)) + bytes((1, 1, 1, 3))) * 8)
    pixels = read_image(tmp_path / "f.hdr").pixels
    assert pixels.shape == (4, 8, 3) and np.all(pixels == [1, 0.5, 0.25])
    # Two in a row: 44 and 1 · 256 repeat a texel 300 times.
    runs = bytes((128, 64, 32, 129)) + bytes((1, 1, 1, 43, 1, 1, 1, 1)) + bytes((8, 9, 128, 130)) * 12
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 12 +X 26\n"
    (tmp_path / "h.hdr").write_bytes(head + runs)
    pixels = read_image(tmp_path / "h.hdr").pixels.reshape(-1, 3)
    assert np.all(pixels[:300] == [1, 0.5, 0.25]) and np.all(pixels[300:] == [0.125, 0.140625, 2])
    (tmp_path / "i.hdr").write_bytes(head + runs[:-4])
    refused(tmp_path / "i.hdr", "holds 311 texels, 312")
    primaries = "PRIMARIES=.708 .292 .170 .797 .131 .046 .3127 .3290"
    image = read_image(hdr(tmp_path / "g.hdr", np.tile([0.5, 0.4, 0.3], (2, 4, 1)), "-Y 2 +X 4", primaries))
    np.testing.assert_allclose(image.pixels[0, 0], REC2020_TO_709 @ [0.5, 0.4, 0.3], atol=0.004)
    assert len(image.notices) == 1


# --- TIFF ------------------------------------------------------------------------------------------------

KINDS = {1: "B", 2: "B", 3: "H", 4: "I", 5: "2I", 7: "B", 11: "f", 12: "d"}


def tiff(path: Path, pages, order="<") -> Path:
    """A TIFF of uncompressed pages (strips, tags): tags as {tag: (type, values)}, rationals as pairs."""
    out = bytearray((b"II*\0" if order == "<" else b"MM\0*") + bytes(4))
    link = 4
    for strips, tags in pages:
        at = []
        for strip in strips:
            out += bytes(len(out) % 2)
            at.append(len(out))
            out += strip
        tags = {273: (4, at), 279: (4, [len(strip) for strip in strips]), **tags}
        entries = b""
        for tag, (kind, values) in sorted(tags.items()):
            flat = [number for value in values for number in (value if isinstance(value, tuple) else (value,))]
            data = struct.pack(f"{order}{len(flat)}{KINDS[kind][-1]}", *flat)
            if len(data) > 4:
                out += bytes(len(out) % 2)
                where = len(out)
                out += data
                data = struct.pack(order + "I", where)
            entries += struct.pack(order + "HHI", tag, kind, len(values)) + data.ljust(4, b"\0")
        out += bytes(len(out) % 2)
        struct.pack_into(order + "I", out, link, len(out))
        out += struct.pack(order + "H", len(tags)) + entries
        link = len(out)
        out += bytes(4)
    path.write_bytes(out)
    return path


def page(pixels, photometric, bits=None, form=1, **more):
    """A page of `pixels` (h, w, channels), with further tags as t301=(type, values)."""
    height, width, channels = pixels.shape
    tags = {
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [bits or 8 * pixels.dtype.itemsize] * channels),
        259: (3, [1]),
        262: (3, [photometric]),
        277: (3, [channels]),
        278: (4, [height]),
        339: (3, [form] * channels),
    }
    tags |= {int(name[1:]): value for name, value in more.items()}
    return [pixels.tobytes()], {tag: value for tag, value in tags.items() if value is not None}


RGB8 = np.tile(np.array([64, 128, 192], np.uint8), (4, 8, 1))
RGBF = np.tile(np.array([0.25, 0.5, 0.75], np.float32), (4, 8, 1))
DECODED = (np.array([64, 128, 192]) / 255 + 0.055) ** 2.4 / 1.055**2.4


@pytest.mark.parametrize("order", "<>")
def test_tiff_states_its_curve_and_primaries(tmp_path, order):
    codes = RGB8.astype(RGB8.dtype.newbyteorder(order))
    cube = [round(65535 * (k / 255) ** 3) for k in range(256)]
    path = tiff(tmp_path / "a.tif", [page(codes, 2, t301=(3, cube))], order)
    np.testing.assert_allclose(read_image(path).pixels[0, 0], (np.array([64, 128, 192]) / 255) ** 3, atol=1e-5)
    path = tiff(tmp_path / "b.tif", [page(codes, 2, t301=(3, cube + list(range(0, 65536, 257)) + cube))], order)
    np.testing.assert_allclose(read_image(path).pixels[0, 0, 1], 128 / 255, atol=1e-5)
    xy = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046)
    rationals = [(round(1000 * value), 1000) for value in xy]
    white = (5, [(3127, 10000), (3290, 10000)])
    path = tiff(tmp_path / "c.tif", [page(codes, 2, t318=white, t319=(5, rationals))], order)
    want = np.maximum(REC2020_TO_709 @ DECODED, 0)  # red is outside the gamut of Rec.709
    np.testing.assert_allclose(read_image(path).pixels[0, 0], want, atol=2e-4)
    floats = RGBF.astype(np.dtype("f4").newbyteorder(order))
    path = tiff(tmp_path / "d.tif", [page(floats, 2, form=3, t319=(5, rationals))], order)
    image = read_image(path)
    np.testing.assert_allclose(image.pixels[0, 0], REC2020_TO_709 @ [0.25, 0.5, 0.75], atol=2e-4)
    assert "primaries 0.708" in image.notices[0]
    icc = matrix_profile([curv()])
    path = tiff(tmp_path / "e.tif", [page(codes, 2, t301=(3, cube), t34675=(7, list(icc)))], order)
    np.testing.assert_allclose(read_image(path).pixels[0, 0], np.array([64, 128, 192]) / 255, atol=1e-6)


def test_tiff_samples_that_are_read(tmp_path):
    grey = np.full((4, 8, 1), 50, np.uint8)

    def first(name, *pages):
        return read_image(tiff(tmp_path / name, list(pages))).pixels[0, 0]

    def decoded(x):
        return ((x + 0.055) / 1.055) ** 2.4

    np.testing.assert_allclose(first("a.tif", page(grey, 0)), decoded(205 / 255), rtol=1e-6)
    np.testing.assert_allclose(first("b.tif", page(grey.astype(np.uint16), 0)), decoded(65485 / 65535), rtol=1e-6)
    half = page(RGBF.astype(np.float16), 2, form=3)
    np.testing.assert_allclose(first("c.tif", half), RGBF[0, 0], rtol=1e-6)
    np.testing.assert_allclose(first("d.tif", page(RGBF.astype(float), 2, form=3)), RGBF[0, 0], rtol=1e-6)
    _, tags = page(RGB8, 2, t284=(3, [2]))
    planes = ([RGB8[..., k].tobytes() for k in range(3)], tags)
    np.testing.assert_allclose(first("e.tif", planes), DECODED, rtol=1e-6)
    map16 = [0] * 768
    map16[50], map16[256 + 50], map16[512 + 50] = 64 * 257, 128 * 257, 192 * 257
    np.testing.assert_allclose(first("f.tif", page(grey, 3, t320=(3, map16))), DECODED, rtol=1e-6)
    # Four bits: 1, 2, 3 …; a code of fifteen is white.
    nibbles = page(np.frombuffer(b"\x5f" * 16, np.uint8).reshape(4, 4, 1), 1, bits=4)
    nibbles[1][256] = (4, [8])
    np.testing.assert_allclose(read_image(tiff(tmp_path / "g.tif", [nibbles])).pixels[0, :2, 0], [decoded(1 / 3), 1])


def test_tiff_alpha(tmp_path):
    """Of associated alpha the curve was applied before the colour was multiplied; floats are linear throughout."""
    codes = np.tile(np.array([32, 64, 96, 128], np.uint8), (4, 8, 1))
    pixels = read_image(tiff(tmp_path / "a.tif", [page(codes, 2, t338=(3, [1]))])).pixels[0, 0]
    alpha = 128 / 255
    straight = np.array([32, 64, 96]) / 128
    np.testing.assert_allclose(pixels[:3], ((straight + 0.055) / 1.055) ** 2.4 * alpha, rtol=1e-5)
    np.testing.assert_allclose(pixels[3], alpha, rtol=1e-6)
    straight = np.array([32, 64, 96]) / 255
    pixels = read_image(tiff(tmp_path / "b.tif", [page(codes, 2, t338=(3, [2]))])).pixels[0, 0]
    np.testing.assert_allclose(pixels[:3], ((straight + 0.055) / 1.055) ** 2.4, rtol=1e-5)
    floats = np.tile(np.array([0.1, 0.2, 0.3, 0.5], np.float32), (4, 8, 1))
    pixels = read_image(tiff(tmp_path / "c.tif", [page(floats, 2, form=3, t338=(3, [1]))])).pixels[0, 0]
    np.testing.assert_array_equal(pixels, floats[0, 0])
    image = read_image(tiff(tmp_path / "d.tif", [page(codes, 2, t338=(3, [0]))]))
    assert image.pixels.shape == (4, 8, 3) and "channels left out" in image.notices[0]


@pytest.mark.parametrize(
    "pages, words",
    [
        ([page(RGB8, 8)], ("CIE L*a*b*",)),
        ([page(np.zeros((4, 8, 4), np.uint8), 5)], ("CMYK",)),
        ([page(np.zeros((4, 8, 1), np.uint16), 32803)], ("colour filter array",)),
        ([page(np.zeros((4, 8, 3), np.uint16), 34892)], ("linear raw",)),
        ([page(np.zeros((4, 8, 3), np.int16), 32845, form=2, t259=(3, [34677]))], ("LogLuv",)),
        ([page(np.zeros((4, 8, 1), np.int16), 32844, form=2, t259=(3, [34676]))], ("LogL",)),
        ([page(np.zeros((4, 8, 1), np.float32), 0, form=3)], ("white",)),
        ([page(RGB8.astype(np.int8), 2, form=2)], ("int8",)),
        ([page(RGB8.astype(np.uint32), 2)], ("uint",)),
        ([page(np.zeros((4, 8, 9), np.uint8), 2, bits=24, form=3, t277=(3, [3]), t258=(3, [24] * 3))], ("24 bits",)),
        ([page(RGB8[..., :1], 3, t320=(3, [256] * 768))], ("palette", "16 bits")),
        ([page(RGB8[..., :1], 1, t291=(3, list(range(256))))], ("GrayResponseCurve",)),
        ([page(RGB8, 2, t532=(5, [(16, 1), (235, 1)] * 3))], ("ReferenceBlackWhite",)),
        ([page(RGB8, 2, t301=(3, [0, 1, 2]))], ("TransferFunction of 3",)),
        ([page(RGB8, 2, t319=(5, [(3, 10)] * 6))], ("span no colour space",)),
        ([page(RGB8, 2, t318=(5, [(0, 0)] * 2))], ("span no colour space",)),
        ([page(RGB8, 2), page(RGB8, 2)], ("2 images of full size",)),
        ([page(RGB8, 2, t254=(4, [1])), page(RGB8, 2)], ("reduced size",)),
        ([page(RGB8, 2, t34675=(7, list(b"none")))], ("ICC profile",)),
    ],
)
def test_tiffs_that_are_refused(tmp_path, pages, words):
    refused(tiff(tmp_path / "a.tif", pages), *words)


def test_copies_of_reduced_size_do_not_count(tmp_path):
    path = tiff(tmp_path / "a.tif", [page(RGB8, 2), page(RGB8[:2, :4], 2, t254=(4, [1]))])
    assert read_image(path).pixels.shape == (4, 8, 3)


def test_many_pages_that_state_the_same_numbers_take_no_memory(tmp_path):
    """500 directories whose TransferFunction is the same 200 kB: as Python's numbers they would be 2 GB."""
    path = tiff(tmp_path / "a.tif", [page(RGB8, 2, t301=(3, [0] * 100_000)), *[page(RGB8, 2, t254=(4, [1]))] * 500])
    data = bytearray(path.read_bytes())
    first = struct.unpack_from("<I", data, 4)[0]
    entry = next(data[at : at + 12] for at in range(first + 2, first + 200, 12) if data[at : at + 2] == b"\x2d\1")
    at = first
    while at:  # the entry of 254 becomes another one of 301
        count = struct.unpack_from("<H", data, at)[0]
        for k in range(count):
            if data[at + 2 + 12 * k : at + 4 + 12 * k] == b"\xfe\0" and at != first:
                data[at + 2 + 12 * k : at + 14 + 12 * k] = entry
        at = struct.unpack_from("<I", data, at + 2 + 12 * count)[0]
    path.write_bytes(data)
    tracemalloc.start()
    refused(path, "501 images of full size")
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()


def test_a_curve_of_floats(tmp_path):
    """A profile says that floats are encoded too: sRGB's curve goes on over 1; a table ends there."""
    floats = np.tile(np.array([0.25, 0.5, 2.0], np.float32), (4, 8, 1))
    path = tiff(tmp_path / "a.tif", [page(floats, 2, form=3, t34675=(7, list(matrix_profile([SRGB_PARA]))))])
    want = ((np.array([0.25, 0.5, 2.0]) + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(read_image(path).pixels[0, 0], want, rtol=1e-6)
    path = tiff(tmp_path / "b.tif", [page(floats, 2, form=3, t34675=(7, list(matrix_profile([curv()]))))])
    np.testing.assert_array_equal(read_image(path).pixels, floats)
    table = matrix_profile([curv(0, 10000, 65535)])
    path = tiff(tmp_path / "c.tif", [page(floats, 2, form=3, t34675=(7, list(table)))])
    refused(path, "floats out of [0, 1]")


def test_an_infinite_pixel_stays_infinite_through_a_matrix(tmp_path):
    floats = np.tile(np.array([0.25, 0.5, 0.75], np.float32), (4, 8, 1))
    floats[1, 2, 0] = np.inf
    primaries = (5, [(round(1000 * value), 1000) for value in P3])
    pixels = read_image(tiff(tmp_path / "a.tif", [page(floats, 2, form=3, t319=primaries)])).pixels
    np.testing.assert_array_equal(pixels[1, 2], [np.inf, 0.5, 0.75])
    assert np.isfinite(np.delete(pixels.reshape(-1, 3), 8 + 2, axis=0)).all()


def test_big_tiff(tmp_path):
    spec = oiio.ImageSpec(8, 4, 3, "uint8")
    spec.attribute("tiff:bigtiff", 1)
    icc = np.frombuffer(matrix_profile([curv()]), np.uint8)
    spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(icc)}]"), icc)
    out = oiio.ImageOutput.create("tiff")
    assert out.open(str(tmp_path / "a.tif"), spec) and out.write_image(RGB8) and out.close()
    assert (tmp_path / "a.tif").read_bytes()[:3] == b"II+"
    np.testing.assert_allclose(read_image(tmp_path / "a.tif").pixels[0, 0], np.array([64, 128, 192]) / 255, rtol=1e-6)


# --- other formats ---------------------------------------------------------------------------------------


def test_inks_and_other_statements_are_refused(tmp_path):
    picture = Pillow.fromarray(RGB8)
    picture.convert("CMYK").save(tmp_path / "a.jpg")
    refused(tmp_path / "a.jpg", "inks")
    (tmp_path / "b.avif").write_bytes(struct.pack(">I", 28) + b"ftypavif" + bytes(16))
    refused(tmp_path / "b.avif", "AVIF")
    spec = oiio.ImageSpec(8, 4, 3, "uint16")
    spec.attribute("oiio:ColorSpace", "KodakLog")
    out = oiio.ImageOutput.create("dpx")
    assert out.open(str(tmp_path / "c.dpx"), spec) and out.write_image(RGBF) and out.close()
    refused(tmp_path / "c.dpx", "KodakLog")


@pytest.mark.parametrize("stated", [{0xA001: 2}, {0xA001: 65535, 0xA005: {1: "R03", 2: b"0100"}}])
def test_adobe_rgb_by_exif(tmp_path, stated):
    """The primaries of Adobe RGB (1998) and its exponent 563/256; its own matrix of XYZ has five digits."""
    to_xyz = np.array([[0.57667, 0.18556, 0.18823], [0.29734, 0.62736, 0.07529], [0.02703, 0.07069, 0.99134]])
    exif = Pillow.Exif()
    exif[0x8769] = stated
    codes = np.tile(np.array([120, 128, 130], np.uint8), (8, 16, 1))
    path = tmp_path / "a.jpg"
    Pillow.fromarray(codes).save(path, exif=exif.tobytes(), quality=100, subsampling=0)
    image = read_image(path)
    assert "Adobe RGB" in image.notices[0]
    want = np.linalg.solve(SRGB_TO_XYZ, to_xyz @ (codes[0, 0] / 255) ** (563 / 256))
    np.testing.assert_allclose(image.pixels[0, 0], want, rtol=0.02)  # JPEG's colours err by a code
    # A profile says more than Exif, and a chunk sRGB of a PNG too.
    Pillow.fromarray(codes).save(path, exif=exif.tobytes(), icc_profile=matrix_profile([SRGB_PARA]))
    assert read_image(path).notices == ()


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_gamma_and_primaries_by_exif(tmp_path, suffix):
    """In every format that has Exif; codes of one grey survive JPEG."""
    ratio = TiffImagePlugin.IFDRational
    exif = Pillow.Exif()
    exif[0x8769] = {0xA001: 65535, 0xA500: ratio(18, 10)}
    exif[318] = ratio(3127, 10000), ratio(3290, 10000)
    exif[319] = tuple(ratio(round(1000 * value), 1000) for value in P3)
    path = tmp_path / f"a.{suffix}"
    Pillow.new("RGB", (8, 4), (99, 99, 99)).save(path, exif=exif.tobytes(), quality=100)
    image = read_image(path)
    np.testing.assert_allclose(image.pixels, (99 / 255) ** 1.8, rtol=0.01)
    assert "its Exif (gamma 1.8, primaries 0.68" in image.notices[0]


def test_a_gain_map_is_told(tmp_path):
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/" hdrgm:Version="1.0"/>'
    Pillow.fromarray(RGB8).save(tmp_path / "a.jpg", xmp=xmp)
    assert "gain map" in read_image(tmp_path / "a.jpg").notices[0]


def test_panoramas_say_what_they_are(tmp_path):
    def saved(**fields):
        text = " ".join(f'GPano:{name}="{value}"' for name, value in fields.items())
        xmp = (
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            f'<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {text}/>'
            "</rdf:RDF></x:xmpmeta>"
        )
        Pillow.fromarray(RGB8).save(tmp_path / "a.jpg", xmp=xmp.encode())
        return tmp_path / "a.jpg"

    whole = {"FullPanoWidthPixels": 8, "CroppedAreaImageWidthPixels": 8, "ProjectionType": "equirectangular"}
    assert read_image(saved(**whole, PoseHeadingDegrees=90)).notices == ()
    assert "tilted" in read_image(saved(**whole, PosePitchDegrees=10)).notices[0]
    refused(saved(ProjectionType="cylindrical"), "cylindrical")
    refused(saved(FullPanoHeightPixels=16, CroppedAreaImageHeightPixels=4), "height 4 of 16")


def test_colour_spaces_of_jpeg_2000(tmp_path):
    path = tmp_path / "a.jp2"
    Pillow.fromarray(RGB8).save(path, irreversible=False)
    np.testing.assert_allclose(read_image(path).pixels[0, 0], DECODED, rtol=1e-6)
    data = path.read_bytes()
    at = data.index(b"colr") - 4
    path.write_bytes(data[: at + 11] + struct.pack(">I", 14) + data[at + 15 :])
    refused(path, "colour space 14")
    icc = matrix_profile([curv()])
    box = struct.pack(">I4s3B", 11 + len(icc), b"colr", 2, 0, 0) + icc
    head = data.index(b"jp2h") - 4
    size = int.from_bytes(data[head : head + 4], "big") - 15 + len(box)
    path.write_bytes(data[:head] + struct.pack(">I", size) + data[head + 4 : at] + box + data[at + 15 :])
    np.testing.assert_allclose(read_image(path).pixels[0, 0], np.array([64, 128, 192]) / 255, rtol=1e-6)


def test_jpeg_xl_by_code_points(tmp_path):
    spec = oiio.ImageSpec(8, 4, 3, "uint16")
    spec.attribute("CICP", oiio.TypeDesc("int[4]"), (9, 16, 0, 1))
    out = oiio.ImageOutput.create("jpegxl")
    light = np.tile([0.5, 0.4, 0.3], (4, 8, 1))
    encoded = pq_encoded(203 * light).astype(np.float32)
    assert out.open(str(tmp_path / "a.jxl"), spec) and out.write_image(encoded) and out.close()
    pixels = read_image(tmp_path / "a.jxl").pixels
    np.testing.assert_allclose(pixels[0, 0], REC2020_TO_709 @ light[0, 0], rtol=0.02)  # lossy by default


def bmp(path: Path, size: int, **fields) -> Path:
    """A BMP of 24 bits with a header of version 4 (108) or 5 (124)."""
    head = bytearray(size)
    struct.pack_into("<IiiHHI", head, 0, size, 8, 4, 1, 24, 0)
    head[56:60] = fields.get("space", b"BGRs")
    struct.pack_into("<9i", head, 60, *(round(value * (1 << 30)) for value in fields.get("ends", [0] * 9)))
    struct.pack_into("<3I", head, 96, *(round(value * 65536) for value in fields.get("gammas", [0] * 3)))
    icc = fields.get("icc", b"")
    pixels = RGB8[..., ::-1].tobytes()
    if icc:
        struct.pack_into("<II", head, 112, size + len(pixels), len(icc))
    path.write_bytes(b"BM" + struct.pack("<IHHI", 14 + size + len(pixels), 0, 0, 14 + size) + head + pixels + icc)
    return path


def test_headers_of_bmp(tmp_path):
    np.testing.assert_allclose(read_image(bmp(tmp_path / "a.bmp", 124)).pixels[0, 0], DECODED, rtol=1e-6)
    linear = np.array([64, 128, 192]) / 255
    path = bmp(tmp_path / "b.bmp", 124, space=b"DEBM", icc=matrix_profile([curv()]))
    np.testing.assert_allclose(read_image(path).pixels[0, 0], linear, atol=1e-6)
    refused(bmp(tmp_path / "c.bmp", 124, space=b"KNIL"), "another file")
    calibrated = bmp(tmp_path / "d.bmp", 108, space=bytes(4), ends=SRGB_TO_XYZ.T.ravel(), gammas=(2.0,) * 3)
    np.testing.assert_allclose(read_image(calibrated).pixels[0, 0], linear**2, atol=3e-4)
    silent = read_image(bmp(tmp_path / "e.bmp", 108, space=bytes(4)))
    np.testing.assert_allclose(silent.pixels[0, 0], DECODED, rtol=1e-6)
