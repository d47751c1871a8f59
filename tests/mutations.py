"""Structured mutations of images, textures and arrays: the container stays whole, what it states does not.

Checksums, offsets and lengths are right, so that a mutated file reaches the code behind them.
"""

from __future__ import annotations

import io
import math
import random
import struct
import warnings
import zipfile
import zlib

import numpy as np

from changed_values import changed_env, changed_json
from exr_writer import Part
from exr_writer import exr as write_exr
from whitefurnace.files.zstd import compress

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _number(rng: random.Random) -> int:
    return rng.choice((0, 1, 2, 3, 255, 45455, 65535, 100000, 1 << 31, (1 << 32) - 1, rng.randrange(1 << 32)))


# --- ICC -------------------------------------------------------------------------------------------------


def icc(rng: random.Random) -> bytes:
    """A profile of the matrix or grey kind, with some of its parts changed."""

    def fixed(*values: float) -> bytes:
        return struct.pack(f">{len(values)}i", *(round(65536 * value) for value in values))

    def curve() -> bytes:
        if rng.random() < 0.5:
            count = rng.choice((0, 1, 2, 3, 64))
            stated = count if rng.random() < 0.8 else _number(rng)
            return b"curv" + bytes(4) + struct.pack(">I", stated) + rng.randbytes(2 * count)
        kind = rng.choice((0, 1, 2, 3, 4, 4, 5, 9))
        values = [rng.choice((0.0, 1.0, 2.2, -1.0, 0.1, rng.uniform(-3, 3))) for _ in range(rng.choice((7, 7, 7, 3)))]
        return b"para" + bytes(4) + struct.pack(">HH", kind, 0) + fixed(*values)

    def colorant(*xyz: float) -> bytes:
        shift = rng.choice((0, 0, 0, 0, rng.uniform(-2, 2)))
        return b"XYZ " + bytes(4) + fixed(*(value + shift for value in xyz))

    grey = rng.random() < 0.2
    tags = {b"kTRC": curve()} if grey else {b"rTRC": curve(), b"gTRC": curve(), b"bTRC": curve()}
    if not grey:
        tags[b"rXYZ"] = colorant(0.4361, 0.2225, 0.0139)
        tags[b"gXYZ"] = colorant(0.3851, 0.7169, 0.0971)
        tags[b"bXYZ"] = colorant(0.1431, 0.0606, 0.7141)
    tags[b"desc"] = rng.choice((b"desc", b"mluc")) + bytes(4) + rng.randbytes(rng.randrange(40))
    if rng.random() < 0.1:
        tags[rng.choice((b"A2B0", b"cicp", b"D2B0"))] = b"cicp" + bytes(4) + bytes((rng.randrange(20), 16, 0, 1))
    for name in [name for name in tags if rng.random() < 0.05]:
        del tags[name]
    head = bytearray(128)
    head[8] = rng.choice((2, 4, 4, 5))
    head[12:16] = rng.choice((b"mntr", b"mntr", b"scnr", b"link"))
    head[16:20] = b"GRAY" if grey else rng.choice((b"RGB ", b"RGB ", b"RGB ", b"CMYK", b"Lab "))
    head[20:24] = rng.choice((b"XYZ ", b"XYZ ", b"XYZ ", b"Lab "))
    head[36:40] = b"acsp"
    at, table, body = 132 + 12 * len(tags), b"", b""
    for name, data in tags.items():
        offset = at + len(body) if rng.random() < 0.98 else _number(rng)
        table += struct.pack(">4sII", name, offset, len(data) if rng.random() < 0.98 else _number(rng))
        body += data
    head[:4] = struct.pack(">I", at + len(body) if rng.random() < 0.95 else _number(rng))
    count = len(tags) if rng.random() < 0.97 else _number(rng)
    out = bytes(head) + struct.pack(">I", count) + table + body
    return out if rng.random() < 0.95 else out[: rng.randrange(len(out))]


# --- PNG -------------------------------------------------------------------------------------------------


def _statement(rng: random.Random) -> tuple[bytes, bytes]:
    """A chunk that says something about the pixels."""
    kind = rng.choice(
        (b"cICP", b"iCCP", b"gAMA", b"cHRM", b"sRGB", b"acTL", b"pHYs", b"eXIf", b"tRNS", b"sBIT", b"mDCV")
    )
    if kind == b"cICP":
        body = bytes(rng.choice((0, 1, 4, 8, 9, 12, 13, 16, 18, rng.randrange(256))) for _ in range(2))
        body += rng.choice((b"\0\1", b"\0\0", rng.randbytes(2)))
    elif kind == b"iCCP":
        packed = zlib.compress(icc(rng))
        body = (
            rng.choice((b"name\0\0", b"\0\0", b"name\0\1", b"n" * 80 + b"\0\0")) if rng.random() < 0.1 else b"name\0\0"
        )
        body += packed if rng.random() < 0.9 else packed[: rng.randrange(len(packed))]
    elif kind == b"gAMA":
        body = struct.pack(">I", _number(rng))
    elif kind == b"cHRM":
        body = struct.pack(
            ">8I", *(rng.choice((31270, 32900, 64000, rng.randrange(100000), _number(rng))) for _ in range(8))
        )
    elif kind == b"acTL":
        body = struct.pack(">II", _number(rng), 0)
    elif kind == b"pHYs":
        body = struct.pack(">IIB", *rng.choice(((1, 1, 0), (_number(rng), _number(rng), rng.randrange(3)))))
    elif kind == b"eXIf":
        body = b"II*\0\x08\0\0\0\1\0" + struct.pack("<HHII", 0x112, 3, 1, rng.choice((*range(10), 65535))) + bytes(4)
    else:
        body = rng.randbytes({b"sRGB": 1, b"tRNS": 6, b"sBIT": 3, b"mDCV": 24}[kind])
    return kind, body if rng.random() < 0.95 else body[: rng.randrange(len(body) + 1)]


def png(data: bytes, rng: random.Random) -> bytes:
    chunks, at = [], 8
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    for _ in range(rng.choice((1, 1, 2, 3))):
        action, place = rng.randrange(10), rng.randrange(len(chunks))
        if action < 6:
            chunks.insert(rng.choice((1, 1, 1, place)), _statement(rng))
        elif action == 6:
            chunks.insert(place, chunks[place])
        elif action == 7 and len(chunks) > 1:
            del chunks[place]
        elif action == 8:
            head = bytearray(chunks[0][1])
            if len(head) == 13:
                head[rng.choice((8, 9, 12))] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16))
            chunks[0] = chunks[0][0], bytes(head)
        else:
            kind, body = chunks[place]
            chunks[place] = kind, body[: rng.randrange(len(body) + 1)]
    return PNG_SIGNATURE + b"".join(chunk(kind, body) for kind, body in chunks)


# --- Radiance --------------------------------------------------------------------------------------------


def hdr(data: bytes, rng: random.Random) -> bytes:
    """Another header for the pixels of a picture, which keep their code or become random."""
    end = data.index(b"\n\n") + 2
    stop = data.index(b"\n", end) + 1
    pixels = data[stop:]

    def number() -> str:
        return rng.choice(
            ("1", "0.5", " 2e0", "0", "-1", "nan", "inf", "1e300", "1e-300", "", "x", "1 1", "\t3\v", "0x1p3")
        )

    def line() -> str:
        name = rng.choice(("EXPOSURE", "COLORCORR", "GAMMA", "PIXASPECT", "PRIMARIES", "FORMAT", "VIEW", "\tEXPOSURE"))
        if name == "FORMAT":
            return "FORMAT=" + rng.choice(("32-bit_rle_rgbe", "32-bit_rle_xyze", "32-bit_rle_rgbe ", "", "\x00"))
        count = {"COLORCORR": 3, "PRIMARIES": 8}.get(name, 1)
        if name == "PRIMARIES" and rng.random() < 0.5:
            return f"PRIMARIES=.64 .33 .3 .6 .15 .06 .3127 {rng.choice(('.329', '0', '1', '-.3'))}"
        return f"{name}={' '.join(number() for _ in range(rng.choice((count, count, count, 1, 9))))}"

    lines = ["FORMAT=32-bit_rle_rgbe"] * (rng.random() < 0.9) + [line() for _ in range(rng.randrange(4))]
    axes = [rng.choice("+-") + axis for axis in rng.choice(("YX", "YX", "XY", "YY"))]
    sizes = [rng.choice((4, 8, 24, 0, 1, 1 << 20, (1 << 31) - 1)) if rng.random() < 0.2 else k for k in (4, 8)]
    order = data[end:stop] if rng.random() < 0.3 else f"{axes[0]} {sizes[0]} {axes[1]} {sizes[1]}\n".encode()
    if rng.random() < 0.3:
        pixels = b"".join(
            rng.choice((bytes((1, 1, 1, rng.choice((1, 3, 255)))), rng.randbytes(4)))
            for _ in range(rng.randrange(1, 64))
        )
    text = "\n".join(["#?RADIANCE", *rng.sample(lines, len(lines)), "", ""]).encode("latin-1")
    return rng.choice((text, text, text, text.replace(b"\n", b"\r\n"))) + order + pixels


# --- TIFF ------------------------------------------------------------------------------------------------

_SIZES = {1: "B", 2: "B", 3: "H", 4: "I", 5: "II", 7: "B", 9: "i", 11: "f", 12: "d"}
_TAGS = (254, 256, 257, 258, 259, 262, 266, 273, 274, 277, 278, 279, 282, 283, 284, 291, 301, 317, 318, 319, 320, 338)
_MORE_TAGS = (339, 529, 530, 532, 32995, 34675, 37439)


def tif(data: bytes, rng: random.Random) -> bytes:
    """Rewrites the first directory of a little-endian TIFF, with tags changed, added, left out or repeated."""
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    tags = {}
    for k in range(count):
        tag, kind, number, value = struct.unpack_from("<HHI4s", data, at + 2 + 12 * k)
        tags[tag] = kind, number, value
    out = bytearray(data)

    def stored(kind: int, values: list[float]) -> tuple[int, int, bytes]:
        form = _SIZES[kind]
        flat = [v for v in values for _ in form]
        whole = form[0] not in "fd"
        low, high = {"B": (0, 255), "H": (0, 65535), "I": (0, (1 << 32) - 1), "i": (-(1 << 31), (1 << 31) - 1)}.get(
            form[0], (0, 0)
        )
        packed = struct.pack(f"<{len(flat)}{form[0]}", *(min(max(int(v), low), high) if whole else v for v in flat))
        if len(packed) > 4:
            out.extend(packed)
            packed = struct.pack("<I", len(out) - len(packed))
        return kind, len(values), packed.ljust(4, b"\0")

    for _ in range(rng.choice((1, 1, 2, 3))):
        tag = rng.choice((*_TAGS, *_MORE_TAGS))
        if tag in tags and rng.random() < 0.15:
            del tags[tag]
        elif tag == 34675:
            tags[tag] = stored(7, list(icc(rng)))
        elif tag == 301:
            tags[tag] = stored(3, [rng.randrange(65536) for _ in range(rng.choice((256, 768, 3, 0)))])
        elif tag in tags and rng.random() < 0.3:
            kind, number, value = tags[tag]
            tags[tag] = rng.choice(
                ((rng.randrange(20), number, value), (kind, _number(rng), value), (kind, number, rng.randbytes(4)))
            )
        else:
            kind = rng.choice((3, 3, 4, 5, 11, 12, 1))
            values = [rng.choice((0, 1, 2, 3, 4, 5, 6, 8, 16, 32, 32844, 32845, 34676, _number(rng)))] * rng.choice(
                (1, 1, 2, 3, 6)
            )
            tags[tag] = stored(kind, values)
    if rng.random() < 0.1:  # a circle, or a second page
        following = rng.choice((at, 8, _number(rng)))
    else:
        following = 0
    out.extend(bytes(len(out) % 2))
    struct.pack_into("<I", out, 4, len(out))
    entries = b"".join(
        struct.pack("<HHI", tag, kind, number) + value for tag, (kind, number, value) in sorted(tags.items())
    )
    return bytes(out) + struct.pack("<H", len(tags)) + entries + struct.pack("<I", following)


# --- JPEG and WebP ----------------------------------------------------------------------------------------


def exif(rng: random.Random) -> bytes:
    """Exif with an orientation, white and primaries, and a second directory of colour space, gamma and index."""
    first = b"II*\0\x08\0\0\0" + struct.pack("<H", 3)
    first += struct.pack("<HHII", 0x112, 3, 1, rng.choice((*range(10), 65535)))
    first += struct.pack(
        "<HHII", rng.choice((318, 319)), 5, rng.choice((2, 6, 0, 1 << 30)), rng.choice((0, 8, _number(rng)))
    )
    first += struct.pack("<HHII", 0x8769, 4, 1, rng.choice((50, 50, 50, 8, 0, _number(rng)))) + bytes(4)
    second = struct.pack("<H", 3) + struct.pack("<HHII", 0xA001, 3, 1, rng.choice((0, 1, 2, 65535)))
    second += struct.pack("<HHII", 0xA500, rng.choice((3, 5)), 1, rng.choice((0, 1, 2, 8, _number(rng))))
    second += struct.pack("<HHII", 0xA005, 4, 1, rng.choice((92, 50, 8, _number(rng)))) + bytes(4)
    third = struct.pack("<H", 1) + struct.pack("<HHI4s", 1, 2, 4, rng.choice((b"R03\0", b"R98\0"))) + bytes(4)
    out = first + second + third
    return out if rng.random() < 0.8 else out[: rng.randrange(len(out))]


def jpg(data: bytes, rng: random.Random) -> bytes:
    """Segments APP1 and APP2 after the first marker, with parts of profiles missing, repeated or misnumbered."""

    def segment(marker: int, body: bytes) -> bytes:
        return bytes((0xFF, marker)) + struct.pack(">H", len(body) + 2) + body

    found = b""
    if rng.random() < 0.7:
        whole = icc(rng)
        count = rng.choice((1, 1, 2, 3))
        size = -(-len(whole) // count)
        parts = [(k + 1, count, whole[k * size : (k + 1) * size]) for k in range(count)]
        if rng.random() < 0.3:
            parts = rng.choices(parts, k=rng.randrange(1, 4))
        for number, of, part in parts:
            head = bytes((number if rng.random() < 0.95 else rng.randrange(256), of if rng.random() < 0.95 else 255))
            found += segment(0xE2, b"ICC_PROFILE\0" + head + part)
    if rng.random() < 0.5:
        found += segment(0xE1, b"Exif\0\0" + exif(rng))
    if rng.random() < 0.2:
        found += segment(rng.choice((0xE0, 0xE1, 0xE2, 0xEE)), rng.randbytes(rng.randrange(40)))
    return data[:2] + found + data[2:]


def webp(data: bytes, rng: random.Random) -> bytes:
    """The extended form of a WebP, with a profile and Exif around the image."""

    def part(kind: bytes, body: bytes) -> bytes:
        return kind + struct.pack("<I", len(body)) + body + bytes(len(body) % 2)

    flags = rng.choice((0x28, 0x20, 0x08, 0x2A, rng.randrange(256)))
    body = part(b"VP8X", bytes((flags, 0, 0, 0)) + struct.pack("<I", 7)[:3] + struct.pack("<I", 3)[:3])
    for _ in range(rng.choice((1, 1, 2))):
        body += part(b"ICCP", icc(rng)) if rng.random() < 0.8 else b""
    body += rng.choice((b"", b"", part(b"ANMF", rng.randbytes(16)) * 2)) + data[12:]
    body += part(b"EXIF", rng.choice((b"", b"Exif\0\0")) + exif(rng)) if rng.random() < 0.6 else b""
    return b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WEBP" + body


# --- OpenEXR ---------------------------------------------------------------------------------------------

_LAYERS = ("", "", "", "left", "right", "beauty", "ViewLayer.Combined", "normal", "crypto00", "a\nb", "x" * 60)
_CHANNELS = (
    ("R", "G", "B"),
    ("R", "G", "B", "A"),
    ("Y",),
    ("Z",),
    ("X", "Y", "Z"),
    ("Y", "RY", "BY"),
    ("r", "g", "b"),
    ("R", "G"),
    ("A",),
    ("U", "V"),
)
_EXR_KINDS = (
    "float",
    "int",
    "string",
    "box2i",
    "v2f",
    "m44f",
    "chromaticities",
    "envmap",
    "stringvector",
    "chlist",
    "x",
)


def _exr_attribute(rng: random.Random) -> tuple[str, tuple[str, bytes]]:
    """An attribute that readers look at; in one of five, its value or its type is not what it should be."""
    known = {
        "envmap": ("envmap", bytes([rng.choice((0, 0, 1, 1, 2, 255))])),
        "chromaticities": (
            "chromaticities",
            struct.pack("<8f", *(rng.choice((0, 0.3, 0.64, 1, -1)) for _ in range(8))),
        ),
        "pixelAspectRatio": ("float", struct.pack("<f", rng.choice((1, 1, 2, 0, -1, float("nan"), float("inf"))))),
        "whiteLuminance": ("float", struct.pack("<f", rng.choice((100, 0, float("nan"))))),
        "adoptedNeutral": ("v2f", struct.pack("<2f", rng.random(), rng.random())),
        "worldToCamera": ("m44f", struct.pack("<16f", *(rng.uniform(-1, 1) for _ in range(16)))),
        "colorInteropID": ("string", rng.choice((b"lin_ap1_scene", b"srgb_rec709_scene", b"data", b"\xff", b"a\nb"))),
        "oiio:ColorSpace": ("string", rng.choice((b"lin_rec709", b"sRGB", b"Filmic", b""))),
        "acesImageContainerFlag": ("int", struct.pack("<i", rng.choice((0, 1, 2)))),
        "wrapmodes": ("string", rng.choice((b"clamp", b"a\nb", b"x" * 300))),
        "multiView": (
            "stringvector",
            struct.pack("<i", 4) + b"left" + struct.pack("<i", rng.choice((5, 5, 99))) + b"right",
        ),
        "view": ("string", rng.choice((b"left", b"right", b""))),
        "compression": ("compression", bytes([rng.choice((0, 0, 1, 3, 9, 12, 255))])),
        "lineOrder": ("lineOrder", bytes([rng.choice((0, 1, 2, 9))])),
        "type": ("string", rng.choice((b"scanlineimage", b"tiledimage", b"deepscanline", b"deeptile", b"?"))),
        "tiles": ("tiledesc", struct.pack("<IIB", rng.choice((0, 1, 64, 1 << 31)), 8, rng.choice((0, 1, 2, 17, 255)))),
        "whitefurnace:sh": ("m44f", bytes(64)),
        "whitefurnace:key": ("string", b"k"),
        "Orientation": ("int", struct.pack("<i", rng.choice((1, 6, 9, -1)))),
    }
    name = rng.choice(tuple(known))
    kind, value = known[name]
    if rng.random() < 0.05:
        kind = rng.choice(_EXR_KINDS)
    if rng.random() < 0.05:
        value = rng.choice((b"", value[:-1], value + b"\0", rng.randbytes(rng.randrange(40))))
    return name, (kind, value)


def exr(data: bytes, rng: random.Random) -> bytes:
    """One to three parts with any layers, windows and attributes; `data` is not used."""
    parts = []
    for number in range(rng.choice((1, 1, 2, 3))):
        height, width = rng.choice((*((4, 8),) * 9, (12, 2), (12, 2), (1, 1), (3, 4), (5, 7)))
        found: dict[str, np.ndarray] = {}
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            layer, names = rng.choice(_LAYERS), rng.choice((*_CHANNELS[:2] * 5, *_CHANNELS))
            kind = rng.choice((*(np.float16,) * 6, *(np.float32,) * 6, np.uint32))
            for name in names:
                value = rng.choice((*(1,) * 20, 0, -1e-6, float("inf"), float("nan"))) if kind is not np.uint32 else 1
                found[f"{layer}.{name}" if layer else name] = np.full((height, width), value, kind)
        left, top = rng.choice((*((0, 0),) * 12, (-1, 2), (1 << 30, 0)))
        display = rng.choice((*(None,) * 12, (0, 0, 7, 3), (0, 0, 8, 3), (0, 0, -5, 2), (0, 0, 1 << 30, 1 << 30)))
        attributes = dict(_exr_attribute(rng) for _ in range(rng.choice((0, 0, 1, 1, 2, 4))))
        if rng.random() < 0.05:
            edge = rng.choice((0, 9, 1000, 1 << 20, (1 << 31) - 1))
            attributes["dataWindow"] = "box2i", struct.pack("<4i", 0, 0, edge, rng.choice((edge, 1, 3)))
        name = rng.choice((f"part{number}", f"part{number}", "beauty", "depth", "")) if rng.random() < 0.95 else "a\nb"
        parts.append(Part(found, name, attributes, (left, top), display))
    out = bytearray(write_exr(*parts))
    if rng.random() < 0.05:
        out = out[: rng.randrange(1, len(out))]
    if rng.random() < 0.1:
        out[rng.randrange(len(out))] = rng.randrange(256)
    return bytes(out)


# --- textures and arrays ---------------------------------------------------------------------------------


def _words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def _pairs(rng: random.Random) -> bytes:
    """Key-values of KTX with sizes that are right: those that a reader applies, and others."""
    out = b""
    for _ in range(rng.randrange(4)):
        key = rng.choice(
            (
                *(b"KTXorientation", b"KTXswizzle", b"KTXmapRange", b"KTXcubemapIncomplete", b"KTXanimData", b"sh"),
                *(b"roughness", b"whitefurnace:error", b"whitefurnace:engine", b"\xff", b"x" * 300),
            )
        )
        value = rng.choice(
            (
                *(b"rd\0", b"ru\0", b"S=r,T=d\0", b"S=r,T=u\0", b"bgra\0", b"rrr1\0", b"0000\0", b"rgbx\0", b""),
                struct.pack("<2f", rng.choice((1, 0, -2, 1e30, math.inf, math.nan)), rng.uniform(-1, 1)),
                b" ".join(rng.choice((b"0.5", b"nan", b"1e999", b"x")) for _ in range(rng.choice((3, 27, 28)))) + b"\0",
                rng.randbytes(rng.randrange(12)),
            )
        )
        pair = key + b"\0" + value
        out += _words(len(pair)) + pair + bytes(-len(pair) % 4)
    return out


def ktx1(data: bytes, rng: random.Random) -> bytes:
    """Another header for the same levels: types and formats of GL that fit each other or not, other key-values."""
    head = list(struct.unpack_from("<13I", data, 12))
    body = data[64 + head[12] :]
    if rng.random() < 0.5:
        head[1:5] = rng.choice(
            (
                *((0x1401, 1, 0x1908, 0x8058), (0x1401, 1, 0x80E1, 0x8C43), (0x1406, 4, 0x1903, 0x822E)),
                *((0x8C3B, 4, 0x1907, 0x8C3A), (0x8C3E, 4, 0x1907, 0x8C3D), (0x140B, 2, 0x8227, 0x8C3A)),
                *((0, 1, 0, 0x8D64), (0, 1, 0, 0x8E8F), (0x1403, 2, 0x1907, 0x1907)),
            )
        )
    for _ in range(rng.choice((0, 1, 1, 2))):
        head[rng.randrange(1, 12)] = rng.choice((0, 1, 2, 4, 6, 0x1907, 0x8C3A, 2048, 65536, _number(rng)))
    keys = _pairs(rng)
    head[12] = len(keys)
    if rng.random() < 0.2:
        return data[:12] + struct.pack(">13I", *head) + keys + body
    return data[:12] + _words(*head) + keys + body


def ktx2(data: bytes, rng: random.Random) -> bytes:
    """Another header, descriptor, key-values or packing of the levels, with offsets and lengths that are right."""
    head = list(struct.unpack_from("<13I2Q", data, 12))
    count = max(head[7], 1)
    index = [list(struct.unpack_from("<3Q", data, 80 + 24 * k)) for k in range(count)]
    levels = [data[at : at + length] for at, length, _ in index]
    descriptor = bytearray(data[head[9] : head[9] + head[10]])
    if rng.random() < 0.4:
        at = rng.choice((12, 13, 14, 15, 16, 17, 20, rng.randrange(len(descriptor))))
        descriptor[at] = rng.choice((0, 1, 2, 4, 10, 11, 16, 18, 133, 163, 255, rng.randrange(256)))
    if rng.random() < 0.3:
        head[0] = rng.choice(
            (0, 9, 23, 30, 37, 43, 50, 83, 97, 106, 109, 122, 123, 143, 146, 152, 1000066000, _number(rng))
        )
    for _ in range(rng.choice((0, 0, 1, 2))):
        head[rng.randrange(1, 9)] = rng.choice((0, 1, 2, 3, 4, 6, 2048, 65536, _number(rng)))
    if rng.random() < 0.4:
        scheme = rng.choice((2, 3))
        pack = zlib.compress if scheme == 3 else lambda part: compress(part, 1)
        raw = [bytes(unpacked) if unpacked < 1 << 16 else b"" for _, _, unpacked in index]
        levels = [pack(part if rng.random() < 0.9 else part + b"x") for part in raw]
        head[8] = scheme if rng.random() < 0.9 else rng.choice((0, 2, 3))
    keys = _pairs(rng)
    at = 80 + 24 * count
    head[9:13] = [at, len(descriptor), at + len(descriptor), len(keys)]
    at += len(descriptor) + len(keys)
    table, body = b"", b""
    for (_, _, unpacked), level in zip(index, levels, strict=True):
        if rng.random() < 0.05:
            unpacked = rng.choice((0, unpacked * 2, 1 << 40, (1 << 64) - 1))
        table += struct.pack("<3Q", at + len(body), len(level), unpacked)
        body += level
    return data[:12] + struct.pack("<13I2Q", *head) + table + bytes(descriptor) + keys + body


def dds(data: bytes, rng: random.Random) -> bytes:
    """Another header before the same texels, with or without the DX10 part."""
    head = list(struct.unpack_from("<31I", data, 4))
    newer = list(struct.unpack_from("<5I", data, 128))
    old = rng.random() < 0.4
    if old:
        head[19:26] = rng.choice(
            (
                [4, rng.choice((36, 111, 112, 113, 114, 115, 116, 0x31545844, _number(rng))), 0, 0, 0, 0, 0],
                [0x41, 0, 32, 0xFF0000, 0xFF00, 0xFF, 0xFF000000],
                [0x40, 0, 24, 0xFF, 0xFF00, 0xFF0000, 0],
                [rng.choice((2, 0x20, 0x20000, 0x40)), 0, 8, _number(rng), 0, 0, 0],
            )
        )
        head[27] = rng.choice((0, 0xFE00, 0x600, 0x200000, head[27]))
    for _ in range(rng.choice((0, 1, 1, 2))):
        if not old and rng.random() < 0.6:
            newer[rng.randrange(5)] = rng.choice((0, 1, 2, 3, 4, 6, 10, 28, 29, 67, 87, 95, 98, _number(rng)))
        else:
            head[rng.randrange(31)] = rng.choice((0, 1, 2, 4, 32, 124, 65536, _number(rng)))
    return data[:4] + _words(*head) + (b"" if old else _words(*newer)) + data[148:]


def npy(data: bytes, rng: random.Random) -> bytes:
    """Another header before the same numbers, with a length that is right."""
    (length,) = struct.unpack_from("<H", data, 8)
    shape = rng.choice(("(6, 2, 2, 3)", "(72,)", "()", "(2**62, 4)", "(-1, 72)", "(6, 12)", "(0,)", "(1,)*40", "[72]"))
    kind = rng.choice(("<f4", "<f8", ">f4", "|u1", "|O", "<c8", "|S4", "<f2", "|b1", "<U9", "x", "<i4"))
    text = f"{{'descr': {kind!r}, 'fortran_order': {rng.choice(('True', 'False', '3'))}, 'shape': {shape}, }}"
    text = rng.choice((text, text, text, text[:-3], "{}", "(" * 200, "\0", text + "#"))
    version = rng.choice((b"\1\0", b"\1\0", b"\1\0", b"\2\0", b"\3\0"))
    size = struct.pack("<H" if version[0] == 1 else "<I", len(text) if rng.random() < 0.95 else _number(rng) & 0xFFFF)
    return data[:6] + version + size + text.encode() + data[10 + length :]


def npz(data: bytes, rng: random.Random) -> bytes:
    """The members of an archive with other headers, names and packing; sizes and checksums are right."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(out, "w") as made, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a name that is there twice
        for name in archive.namelist():
            body = archive.read(name)
            body = npy(body, rng) if rng.random() < 0.5 else body if rng.random() < 0.8 else body[: rng.randrange(200)]
            name = rng.choice(
                (name, name, name, "specular_0.npy", "specular_1.npy", "roughness.npy", "error.npy", "../x")
            )
            made.writestr(name, body, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    found = bytearray(out.getvalue())
    if rng.random() < 0.2 and (at := found.find(b"PK\1\2")) > 0:  # the directory states another size or method
        struct.pack_into("<I", found, at + rng.choice((20, 24, 42)), _number(rng))
    return bytes(found)


STRUCTURED = {
    ".ktx": ktx1,
    ".ktx2": ktx2,
    ".dds": dds,
    ".npy": npy,
    ".npz": npz,
    ".png": png,
    ".hdr": hdr,
    ".tif": tif,
    ".jpg": jpg,
    ".webp": webp,
    ".exr": exr,
    ".gltf": changed_json,
    ".json": changed_json,
    ".env": changed_env,
}
"""The mutation of each suffix; files of others are mutated byte by byte."""
