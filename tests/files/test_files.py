"""Reading and writing files: every kind of bad input gets one sentence and the right class, and nothing is
ever half-written."""

from __future__ import annotations

import hashlib
import os
import random
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from whitefurnace.errors import FileError, InputError, WhitefurnaceError
from whitefurnace.files import (
    digest_file,
    read_image,
    read_manifest,
    write_atomic,
    write_exr,
    write_manifest,
    write_npz,
)


def save(path, pixels, kind="float", window=None, full=None, names=None, tile=0, deep=False, **attributes):
    """Write with OpenImageIO alone, not with the code under test."""
    pixels = np.ascontiguousarray(pixels)
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    if names:
        spec.channelnames = names
    if window:
        spec.x, spec.y = window
    if full:
        spec.full_x, spec.full_y, spec.full_width, spec.full_height = full
    spec.tile_width = spec.tile_height = tile
    spec.deep = deep
    for name, value in attributes.items():
        if isinstance(value, tuple):
            spec.attribute(name, oiio.TypeDesc(f"float[{len(value)}]"), value)
        else:
            spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    if deep:
        data = oiio.DeepData()
        data.init(width * height, channels, "float", names or ("R", "G", "B"))
        assert output.write_deep_image(data), output.geterror()
    else:
        assert output.write_image(pixels), output.geterror()
    assert output.close()
    del output
    return path


@pytest.fixture
def pixels():
    return np.random.default_rng(1).random((16, 32, 3), dtype=np.float32)


def one_sentence(error) -> str:
    text = str(error.value)
    assert "\n" not in text and 20 < len(text) < 400, text
    assert not text.endswith(".") and "Traceback" not in text
    return text


def refused(path, kind, *words):
    with pytest.raises(kind) as error:
        read_image(path)
    assert type(error.value) is kind, f"{type(error.value).__name__} is not {kind.__name__}"
    text = one_sentence(error)
    for word in (*words, str(path)):
        assert word in text, f"{word!r} is not in {text!r}"
    return text


# --- what is read ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "suffix, attributes",
    [
        ("exr", {"compression": "zip"}),
        ("exr", {"compression": "piz"}),
        ("exr", {"compression": "none"}),
        ("exr", {"tile": 16}),
        ("tif", {"compression": "zip"}),
        ("tif", {"compression": "none"}),
        ("pfm", {}),
    ],
)
def test_floats_come_back_bit_for_bit(tmp_path, pixels, suffix, attributes):
    pixels[3, 4] = 1e30, 65505, 1e-40
    path = save(tmp_path / f"a.{suffix}", pixels, **attributes)
    image = read_image(path)
    assert image.pixels.dtype == np.float32 and image.pixels.flags.c_contiguous
    np.testing.assert_array_equal(image.pixels, pixels)
    assert image.digest == hashlib.sha256(path.read_bytes()).hexdigest()
    assert image.path == path and image.notices == ()


def test_bands_of_a_tall_image_join(tmp_path):
    pixels = np.random.default_rng(2).random((1500, 700, 3), dtype=np.float32)
    for name, options in (("a.exr", {}), ("t.exr", {"tile": 64}), ("a.tif", {})):
        np.testing.assert_array_equal(read_image(save(tmp_path / name, pixels, **options)).pixels, pixels)


@pytest.mark.parametrize("suffix, kind", [("png", "uint8"), ("png", "uint16"), ("tif", "uint16"), ("bmp", "uint8")])
def test_integers_are_decoded_from_srgb(tmp_path, suffix, kind):
    top = np.iinfo(kind).max
    codes = np.linspace(0, top, 16 * 32 * 3).round().astype(kind).reshape(16, 32, 3)
    image = read_image(save(tmp_path / f"a.{suffix}", codes, kind))
    c = codes / top
    want = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(image.pixels, want, rtol=1e-6)  # one rounding to float32
    assert image.pixels.max() == 1


def test_coverage_is_neither_decoded_nor_multiplied_in(tmp_path):
    codes = np.full((2, 4, 4), 128, np.uint8)
    # Its values are stored as they are: without the hint OpenImageIO would take them for premultiplied.
    path = save(tmp_path / "a.png", codes, "uint8", **{"oiio:UnassociatedAlpha": 1})
    pixels = read_image(path).pixels
    np.testing.assert_allclose(pixels[..., 3], 128 / 255, rtol=1e-6)
    np.testing.assert_allclose(pixels[..., :3], ((128 / 255 + 0.055) / 1.055) ** 2.4, rtol=1e-6)


def test_grey_and_channels_by_name(tmp_path, pixels):
    assert read_image(save(tmp_path / "grey.exr", pixels[..., :1], names=("Y",))).pixels.shape == (16, 32, 1)
    extra = np.concatenate([pixels, pixels * 2], axis=2)
    image = read_image(save(tmp_path / "x.exr", extra, names=("Z", "B", "depth.V", "R", "G", "A")))
    np.testing.assert_array_equal(image.pixels, extra[..., [3, 4, 1, 5]])
    (notice,) = image.notices
    assert "Z" in notice and "depth.V" in notice


def test_data_window_over_the_display_window_is_cut(tmp_path, pixels):
    path = save(tmp_path / "o.exr", pixels, window=(-3, -5), full=(0, 0, 20, 10))
    np.testing.assert_array_equal(read_image(path).pixels, pixels[5:15, 3:23])


def test_upside_down_hdr_is_turned(tmp_path):
    texels = b"".join(bytes([10 * k, 20, 30, 128]) for k in range(8))
    path = tmp_path / "o.hdr"
    red = {}
    for order in ("-Y 2 +X 4", "+Y 2 +X 4", "-Y 2 -X 4"):
        path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + order.encode() + b"\n" + texels)
        red[order] = read_image(path).pixels[..., 0]
    np.testing.assert_array_equal(red["+Y 2 +X 4"], red["-Y 2 +X 4"][::-1])
    np.testing.assert_array_equal(red["-Y 2 -X 4"], red["-Y 2 +X 4"][:, ::-1])


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_followed(tmp_path, orientation):
    """Exif 2.32, tag 274: the side of the picture that row 0, and then column 0, of what is stored shows."""
    sides = (
        "top left",
        "top right",
        "bottom right",
        "bottom left",
        "left top",
        "right top",
        "right bottom",
        "left bottom",
    )
    upright = np.arange(4 * 8, dtype=np.float32).reshape(4, 8, 1)
    row, column = sides[orientation - 1].split()
    stored = upright[::-1] if "bottom" in (row, column) else upright
    stored = stored[:, ::-1] if "right" in (row, column) else stored
    stored = stored.swapaxes(0, 1) if row in ("left", "right") else stored
    path = save(tmp_path / "o.tif", stored, Orientation=orientation)
    image = read_image(path)
    assert image.pixels.flags.c_contiguous
    np.testing.assert_array_equal(image.pixels, upright)


def test_other_primaries_are_converted(tmp_path):
    # BT.2087's matrix from Rec.2020 to Rec.709, both with a white of D65.
    matrix = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
    colour = np.array([0.5, 0.4, 0.3], np.float32)
    flat = np.tile(colour, (2, 4, 1))
    rec2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
    image = read_image(save(tmp_path / "p.exr", flat, chromaticities=rec2020))
    np.testing.assert_allclose(image.pixels[0, 0], matrix @ colour, atol=1e-4)  # four digits are published
    assert len(image.notices) == 1 and "Rec.709" in image.notices[0]
    # Another white (ACES, D60): white stays white.
    aces = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
    white = read_image(save(tmp_path / "w.exr", np.ones((2, 4, 3), np.float32), chromaticities=aces)).pixels
    np.testing.assert_allclose(white, 1, atol=1e-6)
    # Rec.709 itself is left alone.
    rec709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.31271, 0.32902)
    image = read_image(save(tmp_path / "s.exr", flat, chromaticities=rec709))
    assert image.notices == () and np.array_equal(image.pixels, flat)
    degenerate = save(tmp_path / "d.exr", flat, chromaticities=(0.3,) * 8)
    refused(degenerate, InputError, "primaries")


# --- what is refused ------------------------------------------------------------------------------------


def test_what_cannot_be_opened_is_a_file_error(tmp_path):
    refused(tmp_path / "missing.exr", FileError, "No such file")
    refused(tmp_path, FileError, "folder")
    refused(Path(os.devnull), FileError, "regular file")
    with pytest.raises(FileError):
        read_image("a\0b.exr")


def test_no_permission(tmp_path, pixels):
    path = save(tmp_path / "a.exr", pixels)
    path.chmod(0)
    if os.access(path, os.R_OK):
        pytest.skip("this user may read everything")
    refused(path, FileError, "ermission")


@pytest.mark.parametrize("suffix", ["exr", "hdr", "png", "tif", "jpg", "tga", "pfm", "null", "txt", "bin"])
def test_empty_and_text_files(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"")
    refused(path, InputError, "empty")
    path.write_text("this is not an image\n" * 100)
    refused(path, InputError)


FORMATS = {
    "zip.exr": ("float", {"compression": "zip"}),
    "piz.exr": ("half", {"compression": "piz"}),
    "none.exr": ("float", {"compression": "none"}),
    "tiled.exr": ("float", {"tile": 16}),
    "a.hdr": ("float", {}),
    "a.png": ("uint8", {}),
    "b.png": ("uint16", {}),
    "a.jpg": ("uint8", {}),
    "zip.tif": ("float", {"compression": "zip"}),
    "none.tif": ("uint8", {"compression": "none"}),
    "a.pfm": ("float", {}),
    "a.bmp": ("uint8", {}),
    "a.webp": ("uint8", {}),
}


@pytest.mark.parametrize("name", FORMATS)
def test_truncated_files(tmp_path, pixels, name):
    kind, options = FORMATS[name]
    whole = save(tmp_path / name, pixels, kind, **options).read_bytes()
    path = tmp_path / f"cut.{name}"
    for length in (
        len(whole) - 1,
        len(whole) - 4,
        len(whole) * 9 // 10,
        len(whole) // 2,
        len(whole) // 5,
        12,
        1,
    ):
        path.write_bytes(whole[:length])
        refused(path, InputError)


@pytest.mark.parametrize("name", ["zip.exr", "a.png", "b.png", "zip.tif"])
def test_flipped_bits_are_found_where_the_format_has_checksums(tmp_path, pixels, name):
    kind, options = FORMATS[name]
    # Values of 11 bits: noise does not shrink, and EXR stores what does not shrink without a checksum.
    pixels = np.tile(pixels, (4, 4, 1)).astype(np.float16).astype(np.float32)
    whole = save(tmp_path / name, pixels, kind, **options).read_bytes()
    path = tmp_path / f"flip.{name}"
    want = read_image(tmp_path / name).pixels
    found = 0
    for at in range(len(whole) // 8, len(whole) - 200, len(whole) // 50):
        damaged = bytearray(whole)
        damaged[at] ^= 16
        path.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(read_image(path).pixels, want)
        except InputError as error:
            assert "corrupted" in str(error)
            found += 1
    assert found > 30  # a bit here and there means nothing


@pytest.mark.parametrize("name", FORMATS)
def test_no_byte_soup_gets_past_the_error_tree(tmp_path, pixels, capfd, name):
    kind, options = FORMATS[name]
    whole = save(tmp_path / name, pixels, kind, **options).read_bytes()
    path = tmp_path / f"soup.{name}"
    draw = random.Random(name)
    for _ in range(120):
        soup = bytearray(whole[: draw.choice([len(whole), len(whole), draw.randrange(1, len(whole))])])
        for _ in range(draw.choice([1, 2, 8])):
            at = draw.randrange(min(len(soup), draw.choice([64, 512, len(soup)])))
            soup[at] = draw.choice([0, 127, 128, 255, draw.randrange(256)])
        path.write_bytes(soup)
        try:
            read_image(path)
        except (InputError, FileError) as error:
            assert "\n" not in str(error) and len(str(error)) < 500
    assert capfd.readouterr() == ("", "")


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_header(width: int, height: int) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))


def lying(form: str, width: int, height: int, whole: bytes) -> bytes:
    """A small file whose header claims width x height."""
    if form == "png":
        return png_header(width, height) + chunk(b"IDAT", zlib.compress(bytes(5000))) + chunk(b"IEND", b"")
    if form == "hdr":
        return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width) + bytes(5000)
    if form == "pfm":
        return b"PF\n%d %d\n-1.0\n" % (width, height) + bytes(5000)
    if form == "exr":  # both windows of a real file
        box = struct.pack("<iiii", 0, 0, 31, 15)
        assert whole.count(box) == 2
        return whole.replace(box, struct.pack("<iiii", 0, 0, width - 1, height - 1))
    entries = [
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (273, 4, 1, 200),
        (277, 3, 1, 1),
        (278, 4, 1, height),
        (279, 4, 1, 5000),
    ]
    body = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    head = b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + bytes(4)
    return head.ljust(5200, b"\0")


@pytest.mark.parametrize("size", [(200000, 100000), (16384, 8192), (60000, 30000)])
@pytest.mark.parametrize("form", ["exr", "hdr", "png", "tif", "pfm"])
def test_a_header_that_lies_costs_no_memory(tmp_path, pixels, form, size):
    whole = save(tmp_path / "a.exr", pixels, compression="none").read_bytes()
    path = tmp_path / f"lie.{form}"
    path.write_bytes(lying(form, *size, whole))
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(path, InputError)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    # A band of rows is 8 MB and OpenImageIO holds a few; the claim is 400 MB at least.
    assert grown < 100_000, f"{grown / 1000} MB for a file of {path.stat().st_size} bytes"


def test_what_is_valid_and_not_an_environment(tmp_path, pixels):
    refused(save(tmp_path / "two.exr", pixels[..., :2], names=("R", "G")), InputError, "2 channels")
    refused(save(tmp_path / "two.png", pixels[..., :2], "uint8"), InputError, "2 channels")
    refused(save(tmp_path / "abc.exr", pixels, names=("a", "b", "c")), InputError, "3 channels (")
    refused(save(tmp_path / "id.tif", pixels.astype(np.uint32), "uint"), InputError, "type uint")
    refused(save(tmp_path / "w.exr", pixels, full=(0, 0, 40, 16)), InputError, "data window")
    refused(save(tmp_path / "w2.exr", pixels, window=(1, 0), full=(0, 0, 32, 16)), InputError, "data window")
    refused(save(tmp_path / "deep.exr", pixels, deep=True), InputError, "deep")
    refused(save(tmp_path / "wide.exr", np.zeros((1, 70000, 1), np.float32)), InputError, "70000 x 1", "65536")


# --- what is written ------------------------------------------------------------------------------------


def only(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_exr_reads_back_elsewhere_with_its_attributes(tmp_path, pixels):
    pixels[0, 0] = 1e30, 3e38, -0.0
    path = tmp_path / "a.exr"
    write_exr(path, pixels, attributes={"whitefurnace:key": "abc", "whitefurnace:levels": 5, "roughness": 0.25})
    back = oiio.ImageInput.open(str(path))
    spec = back.spec()
    assert str(spec.format) == "float" and spec.getattribute("compression") == "zip"
    assert spec.getattribute("whitefurnace:key") == "abc"
    assert spec.getattribute("whitefurnace:levels") == 5 and spec.getattribute("roughness") == 0.25
    assert spec.getattribute("DateTime") is None and spec.getattribute("Software") is None
    np.testing.assert_array_equal(back.read_image("float").view(np.uint32), pixels.view(np.uint32))
    assert only(tmp_path) == ["a.exr"]


def test_channels_are_stored_under_their_names(tmp_path, pixels):
    path = tmp_path / "a.exr"
    write_exr(path, pixels[..., :2], channel_names=("R", "G"))
    assert oiio.ImageInput.open(str(path)).spec().channelnames == ("R", "G")
    with pytest.raises(ValueError):
        write_exr(path, pixels, channel_names=("R", "G"))


def test_the_same_input_gives_the_same_bytes(tmp_path, pixels):
    script = (
        "import sys, numpy as np; from whitefurnace.files import write_exr, write_npz;"
        "p = np.random.default_rng(1).random((16, 32, 3), dtype=np.float32);"
        "write_exr(sys.argv[1] + '.exr', p, attributes={'n': 3, 's': 'x'});"
        "write_npz(sys.argv[1] + '.npz', {'b': p, 'a': np.arange(3)})"
    )
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "x")], check=True)
    write_exr(tmp_path / "y.exr", pixels, attributes={"n": 3, "s": "x"})
    write_npz(tmp_path / "y.npz", {"b": pixels, "a": np.arange(3)})
    for suffix in ("exr", "npz"):
        assert (tmp_path / f"x.{suffix}").read_bytes() == (tmp_path / f"y.{suffix}").read_bytes()
    with zipfile.ZipFile(tmp_path / "y.npz") as archive:
        assert {member.date_time for member in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    assert str(np.datetime64("today"))[:4].encode() + b":" not in (tmp_path / "y.exr").read_bytes()


def test_npz_is_numpys(tmp_path, pixels):
    arrays = {"specular_0": pixels, "error": np.array([1e-3, 2e-3]), "empty": np.zeros((0, 3))}
    write_npz(tmp_path / "a.npz", arrays)
    with np.load(tmp_path / "a.npz") as back:
        assert list(back) == list(arrays)
        for name, values in arrays.items():
            np.testing.assert_array_equal(back[name], values)


def test_manifest(tmp_path):
    path = tmp_path / "a.json"
    assert read_manifest(path) is None
    write_manifest(path, {"whitefurnace": "0.1.0", "b": [1, 2.5], "a": {"z": "é"}})
    assert read_manifest(path) == {"whitefurnace": "0.1.0", "b": [1, 2.5], "a": {"z": "é"}}
    text = path.read_text(encoding="utf-8")
    assert text.index('"a"') < text.index('"b"') and text.endswith("}\n")
    for foreign in ("", "[1]", "{}", '{"name": "x"}', "\xff\xfe", "[" * 100_000, "{" * 10):
        path.write_bytes(foreign.encode("latin-1"))
        assert read_manifest(path) is None, foreign[:10]
    assert read_manifest(tmp_path) is None
    with pytest.raises(ValueError):
        write_manifest(path, {"whitefurnace": "0.1.0", "x": float("nan")})
    with pytest.raises(ValueError):
        write_manifest(path, {"x": 1})


@pytest.mark.parametrize("raised", [ZeroDivisionError, KeyboardInterrupt, InputError])
def test_what_goes_wrong_leaves_the_target_as_it_was(tmp_path, raised):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def writer(temporary: Path) -> None:
        assert temporary == tmp_path / ".a.bin.tmp"
        temporary.write_bytes(b"half")
        raise raised

    with pytest.raises(raised):
        write_atomic(path, writer)
    assert path.read_bytes() == b"old" and only(tmp_path) == ["a.bin"]
    write_atomic(path, lambda temporary: temporary.write_bytes(b"new"))
    assert path.read_bytes() == b"new" and only(tmp_path) == ["a.bin"]
    assert digest_file(path) == hashlib.sha256(b"new").hexdigest()


WRITERS = {
    "exr": lambda path: write_exr(path, np.random.default_rng(1).random((64, 64, 3), dtype=np.float32)),
    "npz": lambda path: write_npz(path, {"a": np.zeros((64, 64, 3))}),
    "json": lambda path: write_manifest(path, {"whitefurnace": "0", "text": "x" * 50_000}),
}


@pytest.mark.parametrize("suffix", WRITERS)
def test_unwritable_targets(tmp_path, suffix):
    for target in (tmp_path / "missing" / f"a.{suffix}", tmp_path / "folder"):
        (tmp_path / "folder").mkdir(exist_ok=True)
        with pytest.raises(FileError) as error:
            WRITERS[suffix](target)
        assert f"cannot write {target}" in one_sentence(error)
        assert only(tmp_path) == ["folder"]


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_folder_without_permission(tmp_path, suffix):
    tmp_path.chmod(0o500)
    if os.access(tmp_path, os.W_OK):
        pytest.skip("this user may write everywhere")
    with pytest.raises(FileError, match="ermission"):
        WRITERS[suffix](tmp_path / f"a.{suffix}")


@pytest.mark.parametrize("suffix", WRITERS)
def test_no_room_for_the_file(tmp_path, suffix):
    """A limit on the size of files: the write fails part of the way, as on a full disk."""
    resource = pytest.importorskip("resource")
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"old")
    for limit in (0, 1000, 20_000):
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
        try:
            with pytest.raises(FileError) as error:
                WRITERS[suffix](path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert str(path) in one_sentence(error)
        assert path.read_bytes() == b"old" and only(tmp_path) == [path.name]


@pytest.fixture
def full_disk(tmp_path):
    """A file system of 16 KB."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        pytest.skip("only root on Linux can mount a small tmpfs")
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(disk)], capture_output=True)
    if mounted.returncode:
        pytest.skip("mounting a tmpfs is not allowed here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize("suffix", WRITERS)
def test_full_disk(full_disk, suffix):
    with pytest.raises(FileError) as error:
        WRITERS[suffix](full_disk / f"a.{suffix}")
    one_sentence(error)
    assert only(full_disk) == []


def test_what_does_not_read_back_is_not_kept(tmp_path, pixels, monkeypatch):
    """As when the disk, or the library, loses bytes without a word."""
    import whitefurnace.files.exr as exr

    write = exr._write

    def lossy(path, *rest):
        complaint = write(path, *rest)
        data = bytearray(path.read_bytes())
        data[-10] ^= 1
        path.write_bytes(data)
        return complaint

    monkeypatch.setattr(exr, "_write", lossy)
    with pytest.raises(FileError, match="read back"):
        write_exr(tmp_path / "a.exr", pixels)
    assert only(tmp_path) == []


def test_openimageio_is_loaded_late_and_by_one_package():
    script = "import sys, whitefurnace.files, whitefurnace.sphere.environments; sys.exit('OpenImageIO' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0


def test_errors_are_of_the_tree():
    assert issubclass(InputError, WhitefurnaceError) and InputError.exit_code == 3 and FileError.exit_code == 2


@pytest.mark.parametrize("name", ["plain.png", "plain.tif"])
@pytest.mark.parametrize("rows", [349, 350, 701, 1500])
def test_an_image_that_packs_well_is_whole(tmp_path, name, rows):
    """Rows of several MiB in one chunk, most of them of one colour: 349 and 350 rows of 1000 pixels are 1 MiB."""
    pixels = np.full((rows, 1000, 3), 128, np.uint8)
    pixels[:5] = np.random.default_rng(rows).integers(0, 256, (5, 1000, 3))
    read = read_image(save(tmp_path / name, pixels, "uint8", compression="zip")).pixels
    assert read.shape == pixels.shape and np.ptp(read[5:]) == 0
