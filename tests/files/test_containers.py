"""Textures in KTX 1, KTX 2 and DDS: bytes against the specifications, other projects' readers, and anything at all as
input."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import random
import shutil
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

import whitefurnace.files
from whitefurnace.errors import FileError, InputError, UnsupportedError
from whitefurnace.files import dds, ktx1, ktx2, zstd
from whitefurnace.files.bc6h import encode_bc6h
from whitefurnace.files.binary import Source
from whitefurnace.files.codec import decode, encode
from whitefurnace.files.containers import is_texture, parse_texture, read_texture, write_texture
from whitefurnace.files.format_names import vk_name
from whitefurnace.files.packing import FORMATS
from whitefurnace.files.texture import Texture, level_bytes, text_value

BYTES = {
    "ktx1": ktx1.ktx1_bytes,
    "ktx2": ktx2.ktx2_bytes,
    "ktx2+zstd": lambda texture: ktx2.ktx2_bytes(texture, zstd=3),
    "dds": dds.dds_bytes,
}
PARSE = {"ktx1": ktx1.parse_ktx1, "ktx2": ktx2.parse_ktx2, "ktx2+zstd": ktx2.parse_ktx2, "dds": dds.parse_dds}
NUMBERS = tuple(f"{letters}{kind}" for kind in ("8", "16", "16f", "32f") for letters in ("r", "rg", "rgb", "rgba"))
OTHERS = ("rgb8srgb", "rgba8srgb", "rgb9e5", "b10g11r11", "bc6hu", "bc6hs")
HOLDS = {
    "ktx1": (*NUMBERS, *OTHERS),
    "ktx2": (*NUMBERS, *OTHERS, "astc4x4hdr"),
    # dxgiformat.h has no three numbers of 8 or 16 bits
    "dds": tuple(name for name in (*NUMBERS, *OTHERS) if name not in ("rgb8", "rgb16", "rgb16f", "rgb8srgb")),
}
HOLDS["ktx2+zstd"] = HOLDS["ktx2"]
# width, height, layers, faces, levels
SHAPES = {"image": (7, 5, 0, 1, 3), "array": (3, 9, 3, 1, 4), "cube": (8, 8, 0, 6, 4), "cubes": (5, 5, 2, 6, 2)}


def made(form: str, shape: str = "cube", seed: int = 1, **options) -> Texture:
    """Random bytes: every bit of every level must come back."""
    width, height, layers, faces, levels = SHAPES[shape]
    data = random.Random(seed)
    images = max(layers, 1) * faces
    return Texture(
        form,
        width,
        height,
        tuple(data.randbytes(level_bytes(form, width, height, k) * images) for k in range(levels)),
        layers,
        faces,
        **options,
    )


def same(a: Texture, b: Texture) -> None:
    assert (a.format, a.width, a.height, a.layers, a.faces) == (b.format, b.width, b.height, b.layers, b.faces)
    assert [bytes(level) for level in a.levels] == [bytes(level) for level in b.levels]
    assert a.orientation == b.orientation


# --- both ways ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind, form", [(kind, form) for kind, forms in HOLDS.items() for form in forms])
def test_what_is_written_is_read(kind, form, shape):
    keys = {} if kind == "dds" else {"sh": text_value("0.5 0.25 1e-3\n"), "a": b"\0\1\2", "é": b""}
    texture = made(form, shape, key_values=keys)
    data = BYTES[kind](texture)
    assert data == BYTES[kind](made(form, shape, key_values=dict(reversed(keys.items())))), "not the same bytes twice"
    read = PARSE[kind](Source(data, "a file"))
    same(read, texture)
    assert {k: v for k, v in read.key_values.items() if k != "KTXwriter"} == keys
    same(parse_texture(Source(data, "a file")), texture)


def test_levels_decode_to_the_values_that_were_given():
    rng = np.random.default_rng(2)
    levels = [rng.random((2, 6, s, s, 3), np.float32) for s in (4, 2, 1)]
    made = encode("rgba16f", levels, cube=True)
    assert made.clipped == made.negative == (0, 0, 0)
    for kind in ("ktx1", "ktx2", "ktx2+zstd", "dds"):
        read = PARSE[kind](Source(BYTES[kind](made.texture), "a file"))
        assert read.cube and read.layers == 2
        for k, level in enumerate(levels):
            got = decode(read, k)
            assert got.shape == (2, 6, *level.shape[2:4], 4) and got.dtype == np.float32
            # half of a half's ulp below 1: 2^-12
            np.testing.assert_allclose(got[..., :3], level, rtol=0, atol=2.0**-12)
    flat = encode("rgb9e5", [np.full((2, 3, 3), -1.0), np.full((1, 1, 3), 1e9)])
    assert flat.negative == (18, 0) and flat.clipped == (0, 3)
    assert decode(flat.texture, 0).shape == (2, 3, 3) and decode(flat.texture, 1).shape == (1, 1, 3)


def test_a_texture_that_is_none_is_a_mistake_of_the_caller():
    for options in (
        dict(width=0),
        dict(width=3),
        dict(faces=2),
        dict(layers=-1),
        dict(levels=()),
        dict(height=3),
        dict(levels=(bytes(48), bytes(12), bytes(3), bytes(3))),
        dict(levels=(bytes(47),)),
    ):
        with pytest.raises(ValueError, match=r"texture|level"):
            Texture(
                **{"format": "b10g11r11", "width": 2, "height": 2, "levels": (bytes(96), bytes(24)), "faces": 6}
                | options
            )
    for key in ("", "a\0b"):
        with pytest.raises(ValueError, match="no key"):
            ktx2.ktx2_bytes(made("rgb9e5", key_values={key: b""}))
    with pytest.raises(ValueError, match="follow"):
        encode("rgb9e5", [np.ones((4, 4, 3)), np.ones((4, 4, 3))])
    with pytest.raises(ValueError, match="6"):
        encode("rgb9e5", [np.ones((5, 4, 4, 3))], cube=True)


def test_files_are_written_by_their_suffix_and_read_by_their_content(tmp_path):
    texture = made("b10g11r11", key_values={"sh": text_value("1")})
    for suffix, options in ((".ktx", {}), (".ktx2", {}), (".ktx2", {"zstd": 22}), (".DDS", {})):
        path = tmp_path / f"one{suffix}"
        write_texture(path, texture, **options)
        again = tmp_path / f"two{suffix}"
        write_texture(again, texture, **options)
        assert path.read_bytes() == again.read_bytes()
        other = path.rename(tmp_path / "renamed.bin")
        assert is_texture(other)
        same(read_texture(other), texture)
    for name, options in (("a.exr", {}), ("a.dds", {"zstd": 3}), ("a.ktx", {"zstd": 3})):
        with pytest.raises(UnsupportedError, match=name):
            write_texture(tmp_path / name, texture, **options)
    for name, form in (("a.dds", "rgb16f"), ("a.ktx", "astc4x4hdr"), ("a.ktx2", "rgbd")):
        flat = Texture(form, 4, 4, (bytes(level_bytes(form, 4, 4, 0)),))
        with pytest.raises(UnsupportedError, match=f"not written in {form}"):
            write_texture(tmp_path / name, flat)
        assert not list(tmp_path.glob("*a.*"))
    assert not is_texture(tmp_path / "none") and not is_texture(tmp_path)


def test_what_the_system_refuses_is_a_file_error(tmp_path):
    for path in (tmp_path / "none.ktx2", tmp_path, "a\0b"):
        with pytest.raises(FileError, match="cannot read"):
            read_texture(path)
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        assert not is_texture(tmp_path / "pipe")
        with pytest.raises(FileError, match="not a regular file"):
            read_texture(tmp_path / "pipe")
    with pytest.raises(FileError, match="cannot write"):
        write_texture(tmp_path / "none" / "a.ktx2", made("rgb9e5"))
    (tmp_path / "empty").touch()
    with pytest.raises(InputError, match="0 bytes"):
        read_texture(tmp_path / "empty")


def by_zlib(texture: Texture) -> bytes:
    """A KTX 2 with ZLIB supercompression, which is read and not written."""
    data = ktx2.ktx2_bytes(texture)
    count = len(texture.levels)
    at = min(struct.unpack_from("<Q", data, 80 + 24 * k)[0] for k in range(count))
    out = bytearray(data[:at])
    out[44:48] = words(3)
    for k in reversed(range(count)):
        packed = zlib.compress(texture.levels[k])
        struct.pack_into("<3Q", out, 80 + 24 * k, len(out), len(packed), len(texture.levels[k]))
        out += packed
    return bytes(out)


def big_endian(texture: Texture) -> bytes:
    """A KTX 1 as a big-endian machine writes it: every integer swapped, texels by glTypeSize."""
    data = ktx1.ktx1_bytes(texture)
    size, key_bytes = struct.unpack_from("<I", data, 20)[0], struct.unpack_from("<I", data, 60)[0]
    if texture.format == "b10g11r11":
        size = 4
    out = bytearray(data[:12]) + np.frombuffer(data[12:64], "<u4").astype(">u4").tobytes()
    out[20:24] = struct.pack(">I", size)
    at, end = 64, 64 + key_bytes
    while at < end:
        (length,) = struct.unpack_from("<I", data, at)
        padded = 4 + length + -length % 4
        out += struct.pack(">I", length) + data[at + 4 : at + padded]
        at += padded
    while at < len(data):
        (length,) = struct.unpack_from("<I", data, at)
        total = length * (6 if texture.cube and not texture.layers else 1)
        out += (
            struct.pack(">I", length) + np.frombuffer(data[at + 4 : at + 4 + total], f"<u{size}").byteswap().tobytes()
        )
        at += 4 + total
    return bytes(out)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("form", [form for form in HOLDS["ktx1"] if FORMATS[form].block == 1])
def test_big_endian_ktx1_is_read(form, shape):
    texture = made(form, shape, key_values={"sh": text_value("1 2")})
    data = big_endian(texture)
    assert data[12:16] == bytes((4, 3, 2, 1))
    read = ktx1.parse_ktx1(Source(data, "a"))
    same(read, texture)
    assert read.key_values == texture.key_values
    if FORMATS[form].size // FORMATS[form].channels > 1:
        refused(data[:20] + struct.pack(">I", 1) + data[24:], "glTypeSize is 1")


@pytest.mark.parametrize("form", HOLDS["ktx2"])
def test_ktx2_of_zlib_is_read(form):
    texture = made(form)
    same(ktx2.parse_ktx2(Source(by_zlib(texture), "a")), texture)


def test_levels_of_ktx2_may_stand_in_any_order():
    """The index says where each is; ours stand from the smallest to the largest."""
    texture = made("rgba16f")
    data = ktx2.ktx2_bytes(texture)
    at = min(struct.unpack_from("<Q", data, 80 + 24 * k)[0] for k in range(4))
    for order in ((0, 1, 2, 3), (2, 0, 3, 1)):
        out = bytearray(data[:at])
        for k in order:
            struct.pack_into("<Q", out, 80 + 24 * k, len(out))
            out += texture.levels[k]
        same(ktx2.parse_ktx2(Source(bytes(out), "a")), texture)


def test_a_level_is_unpacked_when_it_is_asked_for():
    """A damaged last level does not keep the first from being read, and is found when it is."""
    texture = made("rgba16f")
    data = bytearray(ktx2.ktx2_bytes(texture, zstd=3))
    offset, length, _ = struct.unpack_from("<3Q", data, 80 + 24 * 3)
    data[offset : offset + length] = bytes(length)
    levels = ktx2.parse_ktx2(Source(bytes(data), "a")).levels
    assert bytes(levels[0]) == texture.levels[0] and len(levels) == 4
    with pytest.raises(InputError, match="level 3 cannot be unpacked by Zstandard"):
        levels[3]
    with pytest.raises(IndexError):
        levels[4]


def test_lies_of_zlib_are_found():
    texture = Texture("rgba16f", 64, 64, (bytes(64 * 64 * 8),))
    data = by_zlib(texture)
    offset, length, _ = struct.unpack_from("<3Q", data, 80)

    def with_stream(stream: bytes) -> bytes:
        return patched(data[:offset] + stream, 80, offset, len(stream), 64 * 64 * 8, wide=True)

    refused(with_stream(zlib.compress(bytes(64 * 64 * 8 - 1))), "level 0 unpacks to 32767 bytes")
    refused(with_stream(zlib.compress(bytes(1 << 24))), "level 0 unpacks to more than 32768 bytes")
    refused(with_stream(zlib.compress(bytes(64 * 64 * 8))[:-2]), "level 0")
    refused(with_stream(zlib.compress(bytes(64 * 64 * 8)) + b"more"), "4 bytes after the end")
    refused(with_stream(bytes(length)), "ZLIB")
    refused(with_stream(data[offset:][:20]), "cannot hold 32768 bytes in 20")


# --- byte for byte ---------------------------------------------------------------------------------------


def words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def test_ktx1_as_filament_reads_it_byte_for_byte():
    faces = [bytes([face] * 16) for face in range(6)]
    small = [bytes([16 + face] * 4) for face in range(6)]
    texture = Texture("b10g11r11", 2, 2, (b"".join(faces), b"".join(small)), 0, 6, {"sh": b"1 2\0"})
    wanted = (
        # [KTX 1.1, identifier]
        bytes.fromhex("AB 4B 54 58 20 31 31 BB 0D 0A 1A 0A")
        + words(0x04030201)  # endianness
        + words(0x8C3A, 1, 0x8C3A, 0x8C3A, 0x1907)  # glType, glTypeSize, glFormat, glInternalFormat, base: GL_RGB
        + words(2, 2, 0, 0, 6, 2)  # width, height, depth, no array, faces, levels
        + words(44)  # bytesOfKeyValueData: 4 + 23 + 1 of padding, 4 + 7 + 1 of padding, and so on
    )
    keys = words(23) + b"KTXorientation\0S=r,T=d\0" + b"\0" + words(7) + b"sh\0" + b"1 2\0" + b"\0"
    wanted = wanted[:-4] + words(len(keys)) + keys
    wanted += words(16) + b"".join(faces)  # imageSize of a cube that is no array is one face's [KTX 1.1, imageSize]
    wanted += words(4) + b"".join(small)
    assert ktx1.ktx1_bytes(texture) == wanted


def test_ktx1_pads_rows_to_4_bytes_and_takes_gls_own_type():
    rows = [bytes([r] * 6) for r in (1, 2)]
    data = ktx1.ktx1_bytes(Texture("rgb16f", 1, 2, (b"".join(rows),)))
    # [KTX 1.1, GL_UNPACK_ALIGNMENT of 4]: rows of 6 bytes take 8
    assert data.endswith(words(16) + rows[0] + b"\0\0" + rows[1] + b"\0\0")
    own = bytearray(ktx1.ktx1_bytes(made("b10g11r11")))
    own[16:28] = words(0x8C3B, 4, 0x1907)
    same(ktx1.parse_ktx1(Source(own, "a file")), made("b10g11r11"))


# [KDF 1.3, 5]: colour model | primaries << 8 | transfer << 16, block sides - 1, bytes; samples of bit offset |
# bits - 1 << 16 | (channel | qualifiers) << 24, position, lower, upper. 0xC0 is a signed float, 0x80 an unsigned one,
# 0x20 an exponent; channels 0 1 2 15 are R G B A.
ONE, MINUS_ONE = 0x3F800000, 0xBF800000
DESCRIPTORS = {
    "rg16f": (0x010101, 0, 4, [(0xC00F0000, 0, MINUS_ONE, ONE), (0xC10F0010, 0, MINUS_ONE, ONE)]),
    "rgba16f": (
        0x010101,
        0,
        8,
        [
            (0xC00F0000, 0, MINUS_ONE, ONE),
            (0xC10F0010, 0, MINUS_ONE, ONE),
            (0xC20F0020, 0, MINUS_ONE, ONE),
            (0xCF0F0030, 0, MINUS_ONE, ONE),
        ],
    ),
    "rgba32f": (
        0x010101,
        0,
        16,
        [
            (0xC01F0000, 0, MINUS_ONE, ONE),
            (0xC11F0020, 0, MINUS_ONE, ONE),
            (0xC21F0040, 0, MINUS_ONE, ONE),
            (0xCF1F0060, 0, MINUS_ONE, ONE),
        ],
    ),
    "b10g11r11": (0x010101, 0, 4, [(0x800A0000, 0, 0, ONE), (0x810A000B, 0, 0, ONE), (0x82090016, 0, 0, ONE)]),
    "rgb9e5": (
        0x010101,
        0,
        4,
        [
            (0x00080000, 0, 0, 8448),
            (0x2004001B, 0, 15, 31),
            (0x01080009, 0, 0, 8448),
            (0x2104001B, 0, 15, 31),
            (0x02080012, 0, 0, 8448),
            (0x2204001B, 0, 15, 31),
        ],
    ),
    "rgb8": (0x010101, 0, 3, [(0x00070000, 0, 0, 255), (0x01070008, 0, 0, 255), (0x02070010, 0, 0, 255)]),
    # transfer function 2 is sRGB; alpha, of the qualifier 0x10, is linear
    "rgba8srgb": (
        0x020101,
        0,
        4,
        [
            (0x00070000, 0, 0, 255),
            (0x01070008, 0, 0, 255),
            (0x02070010, 0, 0, 255),
            (0x1F070018, 0, 0, 255),
        ],
    ),
    "rg16": (0x010101, 0, 4, [(0x000F0000, 0, 0, 65535), (0x010F0010, 0, 0, 65535)]),
    "r32f": (0x010101, 0, 4, [(0xC01F0000, 0, MINUS_ONE, ONE)]),
    "bc6hu": (0x010185, 0x0303, 16, [(0x807F0000, 0, 0, ONE)]),
    "bc6hs": (0x010185, 0x0303, 16, [(0xC07F0000, 0, MINUS_ONE, ONE)]),
    "astc4x4hdr": (0x0101A2, 0x0303, 16, [(0xC07F0000, 0, MINUS_ONE, ONE)]),
}


@pytest.mark.parametrize("form", DESCRIPTORS)
def test_the_data_format_descriptor_word_for_word(form):
    model, block, plane, samples = DESCRIPTORS[form]
    size = 24 + 16 * len(samples)
    wanted = words(size + 4, 0, 2 | size << 16, model, block, plane, 0) + b"".join(words(*s) for s in samples)
    assert ktx2.data_format_descriptor(form) == wanted


def test_ktx2_byte_for_byte():
    large, small = b"".join(bytes([f] * 32) for f in range(6)), b"".join(bytes([64 + f] * 8) for f in range(6))
    texture = Texture("rgba16f", 2, 2, (large, small), 0, 6, {"Z": b"\x01"})
    descriptor = ktx2.data_format_descriptor("rgba16f")  # tested above
    # [KTX 2.0, 3.11]: sorted by code points, each padded to 4
    keys = (
        words(18)
        + b"KTXorientation\0rd\0"
        + b"\0\0"
        + words(23)
        + b"KTXwriter\0whitefurnace\0"
        + b"\0"
        + words(3)
        + b"Z\0\x01"
        + b"\0"
    )
    index = 80 + 2 * 24
    start = index + len(descriptor) + len(keys)
    start += -start % 8  # lcm(8 bytes a texel, 4) [KTX 2.0, 3.13.2]
    header = (
        bytes.fromhex("AB 4B 54 58 20 32 30 BB 0D 0A 1A 0A")  # [KTX 2.0, 3.1]
        + words(97, 2)  # VK_FORMAT_R16G16B16A16_SFLOAT, typeSize
        + words(2, 2, 0, 0, 6, 2, 0)  # width, height, depth, layers, faces, levels, no supercompression
        + words(index, len(descriptor), index + len(descriptor), len(keys))
        + struct.pack("<2Q", 0, 0)
        # the index from the largest on, the data from the smallest on [KTX 2.0, 3.9.7 and 3.13]
        + struct.pack("<6Q", start + 48, 192, 192, start, 48, 48)
    )
    wanted = header + descriptor + keys
    wanted += bytes(start - len(wanted)) + small + large
    assert ktx2.ktx2_bytes(texture) == wanted


def test_ktx2_levels_are_aligned_and_those_of_zstandard_are_not():
    for form, align in (("rgb16f", 12), ("rg16f", 4), ("rgba32f", 16), ("bc6hu", 16)):  # lcm of 6 bytes and 4 is 12
        texture = made(form, "image")
        data = ktx2.ktx2_bytes(texture)
        index = [struct.unpack_from("<3Q", data, 80 + 24 * k) for k in range(3)]
        for k, (offset, length, unpacked) in enumerate(index):
            assert offset % align == 0 and length == unpacked == len(texture.levels[k])
        assert index[2][0] < index[1][0] < index[0][0] and index[0][0] + index[0][1] == len(data)
    data = ktx2.ktx2_bytes(made("rgb9e5", "cube"), zstd=3)
    index = [struct.unpack_from("<3Q", data, 80 + 24 * k) for k in range(4)]
    assert struct.unpack_from("<I", data, 44) == (2,)  # [KTX 2.0, 3.8: Zstandard]
    assert [o for o, _, _ in index[:3]] == [o + n for o, n, _ in index[1:]]
    for offset, length, unpacked in index:
        assert data[offset : offset + 4] == bytes.fromhex("28 B5 2F FD")  # [RFC 8878, 3.1.1]
        assert len(zstd.decompress(data[offset : offset + length], unpacked, Source(data, "a"), "b")) == unpacked


def test_ktx2_of_the_older_documents_and_of_others():
    """Unsized descriptors with supercompression, no key-values, levelCount 0, and UASTC HDR's colour model."""
    data = bytearray(ktx2.ktx2_bytes(made("rgb9e5"), zstd=1))
    at = struct.unpack_from("<I", data, 48)[0]
    assert data[at + 20] == 4
    data[at + 20] = 0
    same(ktx2.parse_ktx2(Source(data, "a")), made("rgb9e5"))
    flat = Texture("rgb9e5", 2, 2, (bytes(range(16)),))
    data = bytearray(ktx2.ktx2_bytes(flat))
    data[40:44] = words(0)
    data[56:64] = words(0, 0)
    read = ktx2.parse_ktx2(Source(data, "a"))
    same(read, flat)
    assert read.key_values == {}
    data = bytearray(ktx2.ktx2_bytes(made("astc4x4hdr")))
    data[struct.unpack_from("<I", data, 48)[0] + 12] = 167
    same(ktx2.parse_ktx2(Source(data, "a")), made("astc4x4hdr"))


def test_dds_byte_for_byte():
    """[Microsoft: DDS_HEADER, DDS_PIXELFORMAT, DDS_HEADER_DXT10, File Layout for Cubic Environment Maps]"""
    large, small = [bytes([f] * 32) for f in range(6)], [bytes([64 + f] * 8) for f in range(6)]
    texture = Texture("rgba16f", 2, 2, (b"".join(large), b"".join(small)), 0, 6)
    wanted = (
        b"DDS "
        + words(124)
        + words(0x1 | 0x2 | 0x4 | 0x8 | 0x1000 | 0x20000)  # CAPS HEIGHT WIDTH PITCH PIXELFORMAT MIPMAPCOUNT
        + words(2, 2, 16, 0, 2)  # height, width, pitch, depth, levels
        + bytes(44)  # reserved
        + words(32, 0x4)
        + b"DX10"
        + bytes(20)
        + words(0x8 | 0x1000 | 0x400000, 0x200 | 0xFC00, 0, 0, 0)  # COMPLEX TEXTURE MIPMAP, CUBEMAP with six faces
        + words(10, 3, 0x4, 1, 0)  # DXGI_FORMAT_R16G16B16A16_FLOAT, TEXTURE2D, TEXTURECUBE, one cube
        + b"".join(a + b for a, b in zip(large, small, strict=True))  # face by face, each with its levels
    )
    assert dds.dds_bytes(texture) == wanted
    blocks = dds.dds_bytes(made("bc6hs", "image"))
    assert struct.unpack_from("<5I", blocks, 4) == (124, 0x1 | 0x2 | 0x4 | 0x1000 | 0x20000 | 0x80000, 5, 7, 64)
    assert struct.unpack_from("<5I", blocks, 128) == (96, 3, 0, 1, 0)
    assert struct.unpack_from("<5I", dds.dds_bytes(made("rg16f", "cubes")), 128) == (34, 3, 4, 2, 0)
    codes = {form: struct.unpack_from("<I", dds.dds_bytes(made(form)), 128)[0] for form in HOLDS["dds"]}
    # dxgiformat.h
    floats = {"rgba32f": 2, "rgb32f": 6, "rgba16f": 10, "rg32f": 16, "rg16f": 34, "r32f": 41, "r16f": 54}
    integers = {"rgba16": 11, "rgba8": 28, "rgba8srgb": 29, "rg16": 35, "rg8": 49, "r16": 56, "r8": 61}
    assert codes == floats | integers | {"b10g11r11": 26, "rgb9e5": 67, "bc6hu": 95, "bc6hs": 96}


def test_older_dds_of_floats_is_read():
    texture = made("rgba16f", "cube")
    data = dds.dds_bytes(texture)
    old = data[:84] + words(113) + data[88:128] + data[148:]  # D3DFMT_A16B16G16R16F
    same(dds.parse_dds(Source(old, "a")), texture)
    for code, form in ((36, "rgba16"), (111, "r16f"), (112, "rg16f"), (114, "r32f"), (115, "rg32f"), (116, "rgba32f")):
        data = dds.dds_bytes(made(form, "cube"))
        same(parse_texture(Source(data[:84] + words(code) + data[88:128] + data[148:], "a")), made(form, "cube"))
    unsupported(patched(old, 112, 0x200 | 0x0C00), "the faces +X, -X alone", "six faces")


# --- readers that are not ours ---------------------------------------------------------------------------


def bc6h_block(red: int, green: int, blue: int) -> bytes:
    """One colour in mode 11 [KDF 1.3, 20.2: bits 00011, then two endpoints of three 10-bit values, then indices]."""
    bits = 0b00011
    for i, value in enumerate((red, green, blue) * 2):
        bits |= value << (5 + 10 * i)
    return bits.to_bytes(16, "little")


def bc6h_value(code: int) -> float:
    """Unquantized to 16 bits, scaled by 31/64, the bits of a half [KDF 1.3, 20.2]."""
    wide = 0 if code == 0 else 0xFFFF if code == 1023 else ((code << 16) + 0x8000) >> 10
    return float(np.uint16(wide * 31 >> 6).view(np.float16))


def test_openimageio_finds_each_face_of_a_bc6h_dds(tmp_path):
    colours = [(100 * f + 10, 50 * f + 5, 900 - 100 * f) for f in range(6)]
    faces = b"".join(bc6h_block(*colour) for colour in colours)
    dds.write_dds(tmp_path / "cube.dds", Texture("bc6hu", 4, 4, (faces, faces[::-1]), 0, 6))
    source = oiio.ImageInput.open(str(tmp_path / "cube.dds"))
    assert source is not None, oiio.geterror()
    spec = source.spec()
    assert (spec.width, spec.height) == (4, 24) and spec.getattribute("dds:CubeMapSides") == "+x -x +y -y +z -z"
    pixels = source.read_image("float")
    np.testing.assert_array_equal(pixels[::4, 3], [[bc6h_value(c) for c in colour] for colour in colours])
    source.close()


def test_bc6h_is_decoded_and_cut_to_the_texture():
    colours = [(100 * f + 10, 50 * f + 5, 900 - 100 * f) for f in range(6)]
    values = np.array([[bc6h_value(c) for c in colour] for colour in colours], np.float32)
    blocks = [bc6h_block(*colour) for colour in colours]
    texture = Texture("bc6hu", 7, 5, (b"".join(blocks[:4]), blocks[4], blocks[5]))
    wide = decode(texture, 0)
    assert wide.shape == (5, 7, 3)
    np.testing.assert_array_equal(wide[[0, 0, 4, 4], [0, 6, 0, 6]], values[:4])
    assert decode(texture, 1).shape == (2, 3, 3) and decode(texture, 2).tolist() == [[values[5].tolist()]]
    cubes = decode(Texture("bc6hu", 2, 2, (b"".join(blocks) * 2,), 2, 6), 0)
    assert cubes.shape == (2, 6, 2, 2, 3)
    np.testing.assert_array_equal(cubes[1, :, 1, 1], values)


def test_bc6h_is_encoded_by_ispc_texcomp():
    pytest.importorskip("ispc_texcomp")
    y, x = np.mgrid[0:13, 0:11]
    ramp = np.stack([1 + x / 10, 2 + y / 10, 3 + (x + y) / 30], axis=-1)
    made = encode("bc6hu", [ramp])
    # A block's colours lie on a line, or two: of this plane of them, 0.3 of 1 wide and 0.3 of 2 or more high, a line
    # along the one can leave half of the other, 7.5 %.
    np.testing.assert_allclose(decode(made.texture, 0), ramp, rtol=0.075)
    for value, read, clipped, negative in (
        (65504, 65504, 0, 0),
        (1e9, 65504, 18, 0),
        (-2, 0, 0, 18),
        (0.5, 0.5, 0, 0),
        (np.inf, 65504, 18, 0),
    ):
        flat = encode("bc6hu", [np.full((6, 1, 1, 3), value)], cube=True)
        assert (flat.clipped, flat.negative) == ((clipped,), (negative,))
        assert (decode(flat.texture, 0) == read).all(), f"{value} is read as {decode(flat.texture, 0).ravel()[0]}"
    with pytest.raises(InputError, match="NaN"):
        encode("bc6hu", [np.full((4, 4, 3), np.nan)])
    with pytest.raises(UnsupportedError, match="fastest"):
        encode_bc6h(ramp, profile="fastest")


def test_bc6h_without_its_encoder_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    with pytest.raises(UnsupportedError, match=r'pip install "whitefurnace\[bc6h\]"'):
        encode("bc6hu", [np.ones((4, 4, 3))])


@pytest.fixture(scope="session")
def node_modules(tmp_path_factory) -> Path:
    """ktx-parse, libktx (in the glTF viewer's package) and Filament: from WHITEFURNACE_NODE_MODULES, else by npm for
    this run."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed, KTX files were not opened by other readers")
    if folder := os.environ.get("WHITEFURNACE_NODE_MODULES"):
        return Path(folder)
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed, KTX files were not opened by other readers")
    folder = tmp_path_factory.mktemp("node")
    command = [
        "npm",
        "install",
        "--ignore-scripts",
        "--no-audit",
        "--no-fund",
        "--fetch-retries=1",
        "--prefix",
        str(folder),
        "ktx-parse@2.0.0",
        "@khronosgroup/gltf-viewer@1.1.0",
        "filament@1.53.4",
    ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    except (OSError, subprocess.TimeoutExpired) as error:
        pytest.skip(f"npm cannot install ktx-parse and libktx: {error}")
    if done.returncode:
        pytest.skip(f"npm cannot install ktx-parse and libktx: {done.stderr.strip().splitlines()[-1:]}")
    return folder / "node_modules"


def others(node_modules: Path, files: list[Path]) -> dict[tuple[str, str], dict]:
    script = Path(__file__).with_name("ktx_readers.mjs")
    done = subprocess.run(
        ["node", str(script), str(node_modules), *map(str, files)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    answers = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    return {(Path(answer["file"]).name, answer["reader"]): answer for answer in answers}


def digest(data) -> str:
    return hashlib.sha256(data).hexdigest()


# internal format, format and type that WebGL 2 takes for each [OpenGL ES 3.0, table 3.2; WEBGL extensions of blocks]
GL = {
    "r8": (0x8229, 0x1903, 0x1401),
    "rg8": (0x822B, 0x8227, 0x1401),
    "rgb8": (0x8051, 0x1907, 0x1401),
    "rgba8": (0x8058, 0x1908, 0x1401),
    "rgb8srgb": (0x8C41, 0x1907, 0x1401),
    "rgba8srgb": (0x8C43, 0x1908, 0x1401),
    "r16f": (0x822D, 0x1903, 0x140B),
    "rg16f": (0x822F, 0x8227, 0x140B),
    "rgb16f": (0x881B, 0x1907, 0x140B),
    "rgba16f": (0x881A, 0x1908, 0x140B),
    "r32f": (0x822E, 0x1903, 0x1406),
    "rg32f": (0x8230, 0x8227, 0x1406),
    "rgb32f": (0x8815, 0x1907, 0x1406),
    "rgba32f": (0x8814, 0x1908, 0x1406),
    "rgb9e5": (0x8C3D, 0x1907, 0x8C3E),
    "b10g11r11": (0x8C3A, 0x1907, 0x8C3B),
    "bc6hu": (0x8E8F, 0, 0),
    "bc6hs": (0x8E8E, 0, 0),
    "astc4x4hdr": (0x93B0, 0, 0),
}
VK = {
    **dict(zip(("r8", "rg8", "rgb8", "rgba8"), (9, 16, 23, 37), strict=True)),
    **dict(zip(("r16", "rg16", "rgb16", "rgba16"), (70, 77, 84, 91), strict=True)),
    **dict(zip(("r16f", "rg16f", "rgb16f", "rgba16f"), (76, 83, 90, 97), strict=True)),
    **dict(zip(("r32f", "rg32f", "rgb32f", "rgba32f"), (100, 103, 106, 109), strict=True)),
    "rgb8srgb": 29,
    "rgba8srgb": 43,
    "b10g11r11": 122,
    "rgb9e5": 123,
    "bc6hu": 143,
    "bc6hs": 144,
    "astc4x4hdr": 1000066000,
}


def test_ktx_parse_reads_every_ktx2(node_modules, tmp_path):
    textures = {}
    for form in HOLDS["ktx2"]:
        for shape in SHAPES:
            for level in (None, 3):
                path = tmp_path / f"{form}-{shape}-{level}.ktx2"
                textures[path] = made(form, shape, key_values={"sh": text_value("0.5 1"), "raw": b"\1\2"})
                ktx2.write_ktx2(path, textures[path], zstd=level)
    answers = others(node_modules, list(textures))
    for path, texture in textures.items():
        answer = answers[path.name, "ktx-parse"]
        assert "error" not in answer, f"{path.name}: {answer}"
        packed = not path.stem.endswith("None")
        assert answer["header"] == {
            "vkFormat": VK[texture.format],
            "typeSize": answer["header"]["typeSize"],
            "pixelWidth": texture.width,
            "pixelHeight": texture.height,
            "pixelDepth": 0,
            "layerCount": texture.layers,
            "faceCount": texture.faces,
            "levelCount": len(texture.levels),
            "supercompressionScheme": 2 * packed,
        }
        descriptor = answer["descriptor"]
        assert descriptor["transferFunction"] == 1 + texture.format.endswith("srgb")
        assert descriptor["colorPrimaries"] == 1
        assert descriptor["bytesPlane"][0] == FORMATS[texture.format].size
        # It makes texts of the keys that the specification has, bytes of others.
        assert answer["keys"] == {
            "KTXwriter": "whitefurnace",
            "KTXorientation": "rd",
            "sh": [*b"0.5 1\0"],
            "raw": [1, 2],
        }
        for level, got in zip(texture.levels, answer["levels"], strict=True):
            assert got["unpacked"] == len(level)
            assert packed or got["digest"] == digest(level)


def test_libktx_uploads_every_face_of_ktx1_and_ktx2(node_modules, tmp_path):
    """It unpacks Zstandard by itself and chooses OpenGL's formats by our header."""
    textures = {}
    for form in GL:
        for shape in ("image", "cube"):  # WebGL 2 has no cube arrays
            textures[tmp_path / f"{form}-{shape}.ktx2"] = made(form, shape)
            textures[tmp_path / f"{form}-{shape}-zstd.ktx2"] = made(form, shape)
            # Filament's 0x8C3A in all three places is against the specification: libktx refuses it (see below).
            if form in HOLDS["ktx1"] and form != "b10g11r11":
                textures[tmp_path / f"{form}-{shape}.ktx"] = made(form, shape)
    for path, texture in textures.items():
        write_texture(path, texture, zstd=3 if "zstd" in path.name else None)
    for form in ("rgb8srgb", "rgb32f", "rgba16f"):
        path = tmp_path / f"{form}-zlib.ktx2"
        textures[path] = made(form)
        path.write_bytes(by_zlib(textures[path]))
        swapped = tmp_path / f"{form}-swapped.ktx"
        textures[swapped] = made(form)
        swapped.write_bytes(big_endian(textures[swapped]))
    answers = others(node_modules, list(textures))
    for path, texture in textures.items():
        answer = answers[path.name, "libktx"]
        assert "error" not in answer and answer["failed"] == 0, f"{path.name}: {answer}"
        assert (answer["baseWidth"], answer["baseHeight"]) == (texture.width, texture.height)
        wanted = {}
        for k, level in enumerate(texture.levels):
            size = len(level) // texture.faces
            for face in range(texture.faces):
                target = 0x8515 + face if texture.cube else 0x0DE1  # TEXTURE_CUBE_MAP_POSITIVE_X, …; TEXTURE_2D
                data = level[face * size : (face + 1) * size]
                if path.suffix == ".ktx":  # rows padded to 4 bytes
                    rows = -(-texture.extent(k)[1] // FORMATS[texture.format].block)
                    data = b"".join(
                        data[i : i + size // rows] + bytes(-(size // rows) % 4) for i in range(0, size, size // rows)
                    )
                wanted[target, k] = (*texture.extent(k), *GL[texture.format], digest(data))
        got = {
            (u["target"], u["level"]): (u["width"], u["height"], u["kind"], u["format"], u["type"], u["digest"])
            for u in answer["uploads"]
        }
        assert got == wanted, path.name


def test_filament_reads_its_ktx1(node_modules, tmp_path):
    texture = made("b10g11r11", key_values={"sh": text_value("0.5 0.25 1\n")})
    ktx1.write_ktx1(tmp_path / "filament.ktx", texture)
    answer = others(node_modules, [tmp_path / "filament.ktx"])["filament.ktx", "filament"]
    assert answer == {
        "file": str(tmp_path / "filament.ktx"),
        "reader": "filament",
        "layers": 1,
        "cube": True,
        "sh": "0.5 0.25 1\n",
        "internal": "R11F_G11F_B10F",
        "format": "RGB",
        "type": "UINT_10F_11F_11F_REV",
        "faces": [
            {"level": k, "face": face, "digest": digest(level[face * size : (face + 1) * size])}
            for k, level in enumerate(texture.levels)
            for size in [len(level) // 6]
            for face in range(6)
        ],
    }


def test_the_names_of_vulkan_s_formats_are_those_of_ktx_parse(node_modules):
    """`format_names` writes them by families; ktx-parse has each as a constant."""
    script = Path(__file__).with_name("ktx_readers.mjs")
    done = subprocess.run(
        ["node", str(script), str(node_modules), "--names"], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    theirs = {
        code: name.removeprefix("VK_FORMAT_").removesuffix("_EXT") for name, code in json.loads(done.stdout).items()
    }
    assert len(theirs) > 150
    wrong = {
        code: (name, vk_name(code)) for code, name in theirs.items() if code < 1000156000 and name != vk_name(code)
    }
    assert not wrong


# --- what is not valid -----------------------------------------------------------------------------------


def refused(data: bytes, *says: str, kind: type[Exception] = InputError) -> str:
    with pytest.raises(kind) as error:
        for _ in parse_texture(Source(data, "some/file")).levels:
            pass
    assert type(error.value) is kind
    text = str(error.value)
    assert text.startswith("some/file") and "\n" not in text and 20 < len(text) < 400 and not text.endswith("."), text
    for part in says:
        assert part in text, f"{part!r} is not in {text!r}"
    return text


def unsupported(data: bytes, *says: str) -> str:
    """A file that is valid and not read: exit code 5, by name."""
    text = refused(data, *says, kind=UnsupportedError)
    assert "not valid" not in text
    return text


DFD = 80 + 4 * 24
"""Where the data format descriptor of a KTX 2 of ours with four levels begins."""


def patched(data: bytes, at: int, *values: int, wide: bool = False) -> bytes:
    new = struct.pack(f"<{len(values)}{'Q' if wide else 'I'}", *values)
    return data[:at] + new + data[at + len(new) :]


@pytest.mark.parametrize(
    "at, value, says",
    [
        (12, 0x01020305, ["endianness is 05030201", "04030201"]),
        (16, 5, ["glType 0x0005", "0x8c3a"]),
        (28, 0x8058, ["0x8c3a do not fit", "glInternalFormat 0x8058 (rgba8)"]),
        (28, 0, ["glInternalFormat is 0x0000"]),
        (36, 0, ["0 x 8", "1 to 65536"]),
        (36, 0xFFFFFFFF, ["4294967295 x 8", "1 to 65536"]),
        (36, 16, ["16 x 8", "square"]),
        (48, 0xFFFFFFFF, ["4294967295 layers", "2048"]),
        (48, 1, ["imageSize of level 0 is 256", "has 1536"]),
        (52, 5, ["5 faces", "1 or 6"]),
        (56, 9, ["9 levels", "1 to 4"]),
        (60, 0xFFFFFFFC, ["truncated", "key-value"]),
        (60, 41, ["multiple of 4"]),
        (64, 1000, ["key-value pair at byte 64", "1000 bytes"]),
        (64, 1, ["key-value pair at byte 64", "1 bytes"]),
        (68, 0xFFFFFFFF, ["UTF-8"]),
        (92, 300, ["imageSize of level 0 is 300", "has 256"]),
    ],
)
def test_lies_of_ktx1_are_found(at, value, says):
    data = ktx1.ktx1_bytes(made("b10g11r11"))
    assert struct.unpack_from("<I", data, 92) == (256,)
    refused(patched(data, at, value), *says)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    "at, value, says",
    [
        (12, 200, ["vkFormat is 200", "not a format of Vulkan"]),
        (16, 1, ["typeSize is 1", "has 4"]),
        (20, 0, ["0 x 8", "1 to 65536"]),
        (20, 16, ["16 x 8", "square"]),
        (32, 3000, ["3000 layers", "2048"]),
        (36, 2, ["2 faces", "1 or 6"]),
        (40, 31, ["31 levels", "1 to 4"]),
        (48, 0xFFFFFFFF, ["truncated", "data format descriptor"]),
        (52, 16, ["descriptor has 16 bytes", "at least 28"]),
        (52, 200, ["says that it has 124 bytes", "200"]),
        (56, 0xFFFFFFF0, ["truncated", "key-value"]),
        (60, 0xFFFFFFF0, ["truncated", "key-value"]),
        (72, 8, ["global data"]),
        (80, 3, ["level 0", "byte 3", "inside the header"]),
        (84, 0x7FFFFFFF, ["truncated", "level 0"]),  # the upper half of its offset
        (96, 7, ["level 0", "7 bytes"]),
        (80 + 96 + 4, 1, ["basic descriptor block"]),
        (80 + 96 + 8, 0xFFFF0002, ["basic descriptor block"]),
        (80 + 96 + 12, 0x0101A2, ["colour model 162", "colour model 1"]),
        (80 + 96 + 20, 9, ["9 bytes a texel", "has 4"]),
    ],
)
def test_lies_of_ktx2_are_found(at, value, says, packed):
    data = ktx2.ktx2_bytes(made("rgb9e5"), zstd=3 if packed else None)
    refused(patched(data, at, value), *says)


def test_more_lies_of_ktx2():
    data = ktx2.ktx2_bytes(made("rgb9e5"))
    first = struct.unpack_from("<Q", data, 80)[0]
    refused(patched(data, 88, 12, wide=True), "level 0", "takes 12 bytes")
    refused(patched(data, 104, first, wide=True), "overlap")
    for text, says in ((b"xx", "KTXorientation"), (b"ru", "must be rd")):
        refused(data.replace(b"KTXorientation\0rd", b"KTXorientation\0" + text), says)
    refused(data.replace(b"KTXwriter\0whitefurnace\0\0", b"KTXorientation\0rd\0\0\0\0\0\0\0"), "repeats a key")


def test_lies_of_zstandard_are_found_before_memory_is_taken():
    texture = Texture("rgba16f", 64, 64, (bytes(64 * 64 * 8),))
    data = ktx2.ktx2_bytes(texture, zstd=3)
    offset, length, size = struct.unpack_from("<3Q", data, 80)
    assert size == 1 << 15 and offset + length == len(data)

    def with_frame(frame: bytes, width: int = 64) -> bytes:
        new = patched(data[:offset] + frame, 20, width, 64)
        return patched(new, 80, offset, len(frame), width * 64 * 8, wide=True)

    assert not any(parse_texture(Source(with_frame(data[offset:]), "a")).levels[0])
    frame = data[offset:]
    refused(with_frame(frame[:-1]), "level 0")
    refused(with_frame(b"\0" * 30), "level 0", "Zstandard")
    refused(with_frame(frame, 128), "level 0", "states 32768 bytes", "has 65536")
    other = zstd.compress(bytes(64 * 64 * 8 - 1), 3)
    refused(with_frame(other), "states 32767 bytes")
    # RFC 8878: magic, descriptor (no size stated, no checksum), window of 1 KiB << 17, then RLE blocks of 128 KiB
    rle = bytes.fromhex("28B52FFD 00 38") + (b"\x02\x00\x10\x41" * 4096)[:-4] + b"\x03\x00\x10\x41"
    tracemalloc.start()
    try:
        refused(with_frame(rle), "unpacks to more than 32768 bytes")  # it holds 512 MiB
        refused(with_frame(bytes.fromhex("28B52FFD 00 88") + rle[6:]), "level 0")  # a window of 128 GiB
        refused(with_frame(b"\x28\xb5\x2f\xfd", 65536), "cannot hold 33554432 bytes in 4")
        refused(with_frame(bytes.fromhex("28B52FFD E0") + b"\xff" * 8 + rle[6:]), "level 0")  # 2^64 - 1 bytes stated
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 8 << 20, f"{peak} bytes were taken for a level of 32 KiB"  # a few of its pieces of 1 MiB
    huge = patched(patched(data, 20, 65536, 65536), 32, 2048)
    refused(patched(huge, 36, 6), "at most 8589934592")


@pytest.mark.parametrize(
    "at, values, says",
    [
        (16, (0x1401, 1, 0x1907, 0x9274), ["0x9274 (GL_COMPRESSED_RGB8_ETC2)"]),
        (16, (0, 1, 0, 0x8D64), ["GL_ETC1_RGB8_OES"]),
        (16, (0, 1, 0, 0x83F1), ["GL_COMPRESSED_RGBA_S3TC_DXT1"]),
        (28, (0x7FFF,), ["0x7fff (of an extension)"]),
        (36, (8, 0), ["1-D"]),
        (44, (7,), ["3-D"]),
    ],
)
def test_valid_ktx1_that_is_not_read_is_named(at, values, says):
    unsupported(patched(ktx1.ktx1_bytes(made("b10g11r11")), at, *values), *says)


@pytest.mark.parametrize(
    "at, values, says",
    [
        (12, (146,), ["vkFormat 146 (BC7_SRGB_BLOCK)"]),
        (12, (147,), ["ETC2_R8G8B8_UNORM_BLOCK"]),
        (12, (1000054000,), ["PVRTC1_2BPP_UNORM_BLOCK_IMG"]),
        (12, (1000066004,), ["ASTC_6x6_SFLOAT_BLOCK"]),
        (12, (1000999000,), ["1000999000 (of an extension)"]),
        (24, (0,), ["1-D"]),
        (28, (1,), ["3-D"]),
        (44, (1,), ["scheme 1 (BasisLZ)", "3 (ZLIB)"]),
        (44, (0x10000,), ["scheme 65536 (of a vendor"]),
        (DFD + 12, (0x0B0101,), ["transfer function 11 (inverse PQ)", "linear, sRGB"]),
        (DFD + 12, (0x100101,), ["16 (ACEScc)"]),
        (DFD + 12, (0x010501,), ["primaries 5 (CIE XYZ)", "BT.2020"]),
    ],
)
def test_valid_ktx2_that_is_not_read_is_named(at, values, says):
    unsupported(patched(ktx2.ktx2_bytes(made("rgb9e5")), at, *values), *says)


def test_textures_of_basis_universal_are_named_by_their_colour_model():
    for model, says in ((163, "BasisLZ (ETC1S)"), (166, "UASTC LDR 4 x 4"), (168, "UASTC HDR 6 x 6")):
        data = patched(ktx2.ktx2_bytes(made("rgb9e5")), 12, 0, 1)
        unsupported(patched(data, DFD + 12, 0x010100 | model), says)
    for key in ("KTXcubemapIncomplete", "KTXanimData"):
        unsupported(ktx2.ktx2_bytes(made("rgb9e5", key_values={key: b"\x3f"})), key)


@pytest.mark.parametrize(
    "at, values, says",
    [
        (80, (4, 0x31545844), ["FourCC DXT1, BC1 blocks"]),
        (80, (4, 0x34545844), ["DXT4, BC3 blocks, premultiplied"]),
        (80, (4, 110), ["Q16W16V16U16"]),
        (80, (0x40, 0, 16, 0xF800, 0x7E0, 0x1F, 0), ["16 bits", "0xf800, 0x7e0, 0x1f"]),
        (80, (0x20000, 0, 8, 255), ["luminance"]),
        (80, (0x20,), ["a palette"]),
        (112, (0x200000,), ["3-D"]),
        (128, (98,), ["dxgiFormat 98 (BC7_UNORM)"]),
        (128, (27,), ["R8G8B8A8_TYPELESS"]),
        (132, (2,), ["1-D"]),
        (132, (4,), ["3-D"]),
    ],
)
def test_valid_dds_that_is_not_read_is_named(at, values, says):
    unsupported(patched(dds.dds_bytes(made("rgba16f")), at, *values), *says)


@pytest.mark.parametrize(
    "at, value, says",
    [
        (4, 123, ["123 and 32 bytes"]),
        (12, 70000, ["8 x 70000"]),
        (16, 16, ["16 x 8", "square"]),
        (28, 20, ["20 levels", "1 to 4"]),
        (28, 3, ["describes", "the file has"]),
        (76, 31, ["124 and 31 bytes"]),
        (80, 0x8, ["flags 0x8"]),
        (128, 0, ["dxgiFormat is 0"]),
        (132, 5, ["resourceDimension is 5"]),
        (144, 7, ["alpha mode is 7"]),
        (140, 0, ["arraySize is 0"]),
        (140, 0xFFFFFFFF, ["4294967295 layers", "2048"]),
        (140, 2, ["describes", "the file has"]),
    ],
)
def test_lies_of_dds_are_found(at, value, says):
    refused(patched(dds.dds_bytes(made("rgba16f")), at, value), *says)


@pytest.mark.parametrize("kind", BYTES)
def test_every_length_but_the_whole_is_refused(kind):
    data = BYTES[kind](made("rgb9e5", "cube", key_values={"sh": b"1\0"}))
    for length in range(len(data)):
        with pytest.raises(InputError):
            PARSE[kind](Source(data[:length], "some/file"))
    if not kind.startswith("ktx2"):  # there the index says where everything is
        refused(data + bytes(4), "the file has")
    refused(b"GIF89a" + data, "KTX 1, KTX 2 or DDS")


def fuzzed(count: int, seed: int) -> int:
    """How many of `count` inputs, mutations of valid files and noise, were taken for textures; any error but
    `InputError` passes through."""
    rng = random.Random(seed)
    seeds = [
        write(made(form, shape, seed, **({} if kind == "dds" else {"key_values": {"sh": b"1 2\0"}})))
        for kind, write in BYTES.items()
        for form, shape in (("b10g11r11", "cube"), ("rgba16f", "image"), ("bc6hu", "cubes"), ("rgb9e5", "array"))
    ]
    magics = (ktx1.IDENTIFIER, ktx2.IDENTIFIER, dds.MAGIC + words(124))
    extremes = (0, 1, 2, 3, 4, 6, 7, 255, 65536, 1 << 31, (1 << 32) - 1, (1 << 32) - 4)
    taken = 0
    for number in range(count):
        if number % 20 == 0:
            data = bytearray(rng.choice(magics) + rng.randbytes(rng.randrange(300)))
        else:
            data = bytearray(rng.choice(seeds))
            for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
                size = len(data)
                action = rng.randrange(6)
                if size < 8:
                    break
                if action == 0:
                    data[rng.randrange(size)] ^= 1 << rng.randrange(8)
                elif action in (1, 2):  # a word of the header or of what follows it
                    at = rng.randrange(0, min(size - 3, 256 if action == 1 else size - 3), 4 if action == 1 else 1)
                    value = rng.choice((*extremes, size, rng.getrandbits(32), rng.randrange(1024)))
                    data[at : at + 4] = words(value)
                elif action == 3:
                    del data[rng.randrange(size) :]
                elif action == 4:
                    at = rng.randrange(size)
                    data[at:at] = rng.randbytes(rng.randrange(1, 9))
                else:
                    at, other = rng.randrange(size), rng.choice(seeds)
                    data[at : at + 16] = other[at : at + 16]
        try:
            texture = parse_texture(Source(bytes(data), "some/file"))
            unpacked = sum(len(level) for level in texture.levels)
            if FORMATS[texture.format].block == 1 and number % 16 == 1:
                texture.meaning.as_light(decode(texture, 0), "some/file", [])
        except (InputError, UnsupportedError) as error:
            text = str(error)
            assert text.startswith("some/file") and "\n" not in text and len(text) < 500, text
        else:
            taken += 1
            assert unpacked < 32768 * len(data)
    return taken


def test_100000_inputs_give_a_texture_or_one_sentence():
    taken = fuzzed(100_000, 7)
    # Most mutations hit the texels and leave a file valid, and many do not: both ends are seen.
    assert 5_000 < taken < 95_000


@pytest.mark.long
def test_a_million_inputs_give_a_texture_or_one_sentence():
    for seed in range(10):
        fuzzed(100_000, 100 + seed)


def test_one_module_is_the_door_of_zstandard():
    folder = Path(whitefurnace.files.__file__).parent
    doors = set()
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else ([node.module or ""] if isinstance(node, ast.ImportFrom) else [])
            )
            if any(name.split(".")[0] == "zstandard" for name in names):
                doors.add(path.name)
    assert doors == {"zstd.py"}
