"""Files of lights: PNG, Babylon.js .env, glTF's EXT_lights_image_based, Radiance .hdr, ASTC and octahedral maps, each
against another program or the specification's own words, and anything at all as input."""

from __future__ import annotations

import base64
import io
import json
import math
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
from PIL import Image

from whitefurnace import files
from whitefurnace.errors import FileError, InputError, UnsupportedError
from whitefurnace.files import astc, env, gltf_lights, hdr
from whitefurnace.files.binary import Source
from whitefurnace.files.codec import decode, encode
from whitefurnace.files.ktx2 import ktx2_bytes, parse_ktx2
from whitefurnace.files.packing import step
from whitefurnace.files.png import decode_png, encode_png
from whitefurnace.files.rgbd import decode_face
from whitefurnace.sphere import octahedral_map as octamap
from whitefurnace.sphere.grids import to_direction, to_square


def lognormal(shape, seed=0, spread=1.0):
    return np.exp(np.random.default_rng(seed).normal(0, spread, shape)).astype(np.float32)


def chain(size: int, least: int = 1, seed: int = 0) -> tuple[np.ndarray, ...]:
    return tuple(lognormal((6, s, s, 3), seed + s) for s in [size >> k for k in range(size.bit_length())] if s >= least)


def refused(read, data, says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        read(Source(bytes(data), "some/file"))
    text = str(caught.value)
    assert text.startswith("some/file") and "\n" not in text and len(text) < 500, text


def from_rgbd(png: bytes) -> np.ndarray:
    """A face as Babylon.js 9 uploads it, rows turned over by UNPACK_FLIP_Y and decoded by `fromRGBD` of its
    helperFunctions; the PNG opened by Pillow."""
    codes = np.asarray(Image.open(io.BytesIO(png)).convert("RGBA"), np.float64)[::-1] / 255
    return codes[..., :3] ** 2.2 / codes[..., 3:]


# --- PNG --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1, 1, 4), (9, 7, 4), (5, 300, 3), (64, 64, 4)])
def test_png_keeps_every_code_and_nothing_else(shape):
    pixels = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    pixels[..., 3:] //= 2  # a colour above its alpha would be cut by any multiplication
    pixels[0, 0, 3:] = 0
    data = encode_png(pixels)
    assert data == encode_png(pixels)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), pixels)
    np.testing.assert_array_equal(decode_png(data), pixels)
    kinds, at = [], 8
    while at < len(data):
        kinds.append(data[at + 4 : at + 8])
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    assert kinds == [b"IHDR", b"IDAT", b"IEND"], "no colour space that a browser would convert from"


def test_png_of_others_is_read():
    pixels = np.random.default_rng(2).integers(0, 256, (6, 5, 4), np.uint8)
    extras = {"icc_profile": b"x" * 200, "dpi": (72, 72)}
    for channels, options in ((4, {}), (3, {}), (4, extras), (3, {"optimize": True})):
        out = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels[..., :channels])).save(out, "png", **options)
        np.testing.assert_array_equal(decode_png(out.getvalue()), pixels[..., :channels])
    for image in (Image.new("P", (4, 4)), Image.new("L", (4, 4)), Image.new("I;16", (4, 4)), Image.new("LA", (4, 4))):
        out = io.BytesIO()
        image.save(out, "png")
        refused(decode_png, out.getvalue(), "8 bits of RGB")


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_of(header=(4, 4, 8, 6, 0, 0, 0), pixels=None, extra=b"") -> bytes:
    pixels = bytes(4 * 17) if pixels is None else pixels
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">2I5B", *header))
        + extra
        + chunk(b"IDAT", zlib.compress(pixels))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize(
    "data, says",
    [
        (b"", "would take bytes 0 to 8"),
        (b"GIF89a..", "signature"),
        (png_of((0, 4, 8, 6, 0, 0, 0)), "1 to 32768"),
        (png_of((1 << 31, 4, 8, 6, 0, 0, 0)), "1 to 32768"),
        (png_of((32768, 32768, 8, 6, 0, 0, 0)), "cannot hold"),
        (png_of((4, 4, 8, 6, 0, 0, 1)), "interlaced"),
        (png_of((4, 4, 16, 6, 0, 0, 0)), "16 bits"),
        (png_of((4, 5, 8, 6, 0, 0, 0)), "unpacks to 68 bytes, its header needs 85"),
        (png_of((4, 3, 8, 6, 0, 0, 0)), "unpacks to more than 51"),
        (png_of(pixels=b"\5" + bytes(67)), "filter"),
        (png_of(extra=chunk(b"ABCD", b"")), "needs the chunk 'ABCD'"),
        (png_of((4, 4, 8, 2, 0, 0, 0), bytes(52), chunk(b"tRNS", bytes(6))), "transparent colour"),
        (png_of()[:-13] + b"\0" + png_of()[-12:], "checksum"),
        (b"\x89PNG\r\n\x1a\n" + chunk(b"IDAT", b""), "first chunk"),
        (png_of()[:33] + chunk(b"IEND", b""), "no pixels"),
    ],
)
def test_lies_of_png_are_found(data, says):
    assert decode_png(png_of()).shape == (4, 4, 4)
    refused(decode_png, data, says)


def test_png_takes_no_memory_that_its_bytes_do_not_hold():
    whole = encode_png(np.zeros((9, 9, 4), np.uint8))
    for cut in range(len(whole)):
        refused(decode_png, whole[:cut], "truncated|signature")
    bomb = png_of((64, 64, 8, 6, 0, 0, 0), bytes(64 << 20))
    tracemalloc.start()
    refused(decode_png, bomb, "more than")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20, f"{peak} bytes for an image of 16 KiB"


def test_a_picture_is_rounded_and_marked_as_srgb(tmp_path):
    path = tmp_path / "picture.png"
    files.write_png(path, np.array([[[0, 0.5 / 255 - 1e-6, 0.5 / 255 + 1e-6], [254.4 / 255, -3, np.inf]]]))
    np.testing.assert_array_equal(np.asarray(Image.open(path)), [[[0, 0, 1], [254, 0, 255]]])
    assert Image.open(path).info["srgb"] == 0
    with files.Transaction() as transaction:
        files.write_png(tmp_path / "two.png", np.zeros((2, 2, 3), np.uint8), into=transaction)
        assert not (tmp_path / "two.png").exists()
        transaction.commit()
    assert (tmp_path / "two.png").exists()
    with pytest.raises(InputError, match="1 NaN"):
        files.write_png(path, np.array([[[0, np.nan, 0]]]))
    with pytest.raises(FileError):
        files.write_png(tmp_path / "none" / "a.png", np.zeros((1, 1, 3)))


# --- Babylon.js .env ----------------------------------------------------------------------------------------


def made_env(size: int = 4, **options) -> env.EnvMap:
    return env.EnvMap(chain(size), **options)


FULL = {
    "polynomials": np.arange(27).reshape(9, 3) / 7,
    "irradiance": lognormal((6, 2, 2, 3), 9),
    "dominant": (0.0, 1.0, 0.5),
}


def split(data: bytes) -> tuple[dict, bytes]:
    """Manifest and payload, as GetEnvInfo finds them."""
    assert data[:8] == bytes.fromhex("8616879 6F6D69636".replace(" ", ""))
    end = data.index(0, 8)
    return json.loads(data[8:end]), data[end + 1 :]


def joined(manifest: dict | str, payload: bytes) -> bytes:
    text = manifest if isinstance(manifest, str) else json.dumps(manifest)
    return bytes.fromhex("86168796F6D69636") + text.encode() + b"\0" + payload


def test_env_as_babylon_reads_it(tmp_path):
    """Opened by Pillow and the words of environmentTextureTools: every texel within the step of its RGBD code."""
    envmap = made_env(16, **FULL)
    assert files.write_env(tmp_path / "a.env", envmap) == (0, 0)
    files.write_env(tmp_path / "b.env", envmap)
    data = (tmp_path / "a.env").read_bytes()
    assert data == (tmp_path / "b.env").read_bytes()
    manifest, payload = split(data)
    assert list(manifest) == ["version", "width", "imageType", "irradiance", "specular"]
    assert (manifest["version"], manifest["width"], manifest["imageType"]) == (2, 16, "image/png")
    assert manifest["specular"]["lodGenerationScale"] == 0.8
    names = "x y z xx yy zz yz zx xy".split()
    assert list(manifest["irradiance"]) == [*names, "irradianceTexture"]
    np.testing.assert_array_equal([manifest["irradiance"][name] for name in names], FULL["polynomials"])
    texture = manifest["irradiance"]["irradianceTexture"]
    assert texture["size"] == 2 and texture["dominantDirection"] == [0, 1, 0.5]
    places = manifest["specular"]["mipmaps"] + texture["faces"]
    assert len(places) == 6 * (5 + 1), "all mips down to one texel"
    assert [p["position"] for p in places] == np.cumsum([0, *(p["length"] for p in places[:-1])]).tolist()
    assert places[-1]["position"] + places[-1]["length"] == len(payload)
    faces = [from_rgbd(payload[p["position"] : p["position"] + p["length"]]) for p in places]
    back = files.read_env(tmp_path / "a.env")
    for k, level in enumerate([*envmap.levels, envmap.irradiance]):
        seen = np.stack(faces[6 * k : 6 * k + 6])
        assert (np.abs(seen - level) <= step("rgbd", level)).all(), f"level {k}"
        got = back.irradiance if k == 5 else back.levels[k]
        np.testing.assert_allclose(got, seen, rtol=3e-7)  # float32 of the same numbers
    np.testing.assert_array_equal(back.polynomials, envmap.polynomials)
    assert (back.dominant, back.lod_scale, back.version) == ((0, 1, 0.5), 0.8, 2)


def test_env_says_what_rgbd_cannot_hold():
    levels = (np.full((6, 1, 1, 3), 300.0, np.float32),)
    levels[0][0, 0, 0] = (-1, 255, 0)
    data, clipped, negative = env.env_bytes(env.EnvMap(levels))
    assert (clipped, negative) == (15, 1)
    np.testing.assert_allclose(env.parse_env(Source(data, "a")).levels[0].max(), 255, rtol=1e-6)
    with pytest.raises(InputError, match="NaN"):
        env.env_bytes(env.EnvMap((np.full((6, 1, 1, 3), np.nan, np.float32),)))
    for wrong in (chain(4)[:-1], (), (np.zeros((6, 3, 3, 3), np.float32),), (np.zeros((5, 1, 1, 3), np.float32),)):
        with pytest.raises(ValueError, match="level"):
            env.EnvMap(wrong)
    with pytest.raises(ValueError, match="polynomials"):
        env.env_bytes(env.EnvMap(chain(1), irradiance=FULL["irradiance"]))


def test_env_of_others():
    """Of version 1, without an imageType or a scale; in any order, with colour profiles; of WebP."""
    levels = chain(2)
    codes = [np.random.default_rng(5).integers(1, 256, (s, s, 4), np.uint8) for s in (2, 1) for _ in range(6)]

    def blobs(form: str, **options) -> list[bytes]:
        out = []
        for code in codes:
            file = io.BytesIO()
            Image.fromarray(code).save(file, form, **options)
            out.append(file.getvalue())
        return out

    def file(images: list[bytes], **manifest) -> bytes:
        places, payload = [], b"?"
        for image in reversed(images):
            places.insert(0, {"position": len(payload), "length": len(image)})
            payload += image + b"??"
        return joined({"width": 2, "specular": {"mipmaps": places}} | manifest, payload)

    wanted = [codes[k][::-1, :, :3].astype(float) for k in range(12)]
    wanted = [(c / 255) ** 2.2 * 255 / codes[k][::-1, :, 3:] for k, c in enumerate(wanted)]
    for data in (
        file(blobs("png"), version=1),
        file(blobs("png", icc_profile=b"p" * 99), version=2, irradiance=None),
        file(blobs("webp", lossless=True, exact=True), version=2, imageType="image/webp"),
        file(blobs("png")),
    ):
        read = env.parse_env(Source(data, "a file"))
        assert read.lod_scale == 0.8 and read.polynomials is None and read.irradiance is None
        for k in range(2):
            np.testing.assert_allclose(read.levels[k], np.stack(wanted[6 * k : 6 * k + 6]), rtol=1e-6)
    assert [level.shape for level in levels] == [level.shape for level in read.levels]


def change(data: bytes, **changes) -> bytes:
    """A manifest in which `a__1__b=value` sets ["a"][1]["b"]; None takes the entry away."""
    manifest, payload = split(data)
    for name, value in changes.items():
        at = manifest
        *path, last = (int(part) if part.isdigit() else part for part in name.split("__"))
        for part in path:
            at = at[part]
        if value is None:
            del at[last]
        else:
            at[last] = value
    return joined(manifest, payload)


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"version": 3}, "version is 3, 1 to 2"),
        ({"width": None}, "width is missing, a whole number"),
        ({"width": 12}, "power of two"),
        ({"width": 1 << 40}, "1 to 8192"),
        ({"width": 4.5}, "whole number"),
        ({"width": True}, "whole number"),
        ({"width": 8}, "has 18 entries, 24 are allowed"),
        ({"width": float("nan")}, "not finite, a whole number"),
        ({"imageType": "image/gif"}, "image/gif"),
        ({"specular": None}, "specular is missing"),
        ({"specular": [1]}, "specular is an array, an object"),
        ({"specular__mipmaps": [{}] * 100}, "has 100 entries, 18"),
        ({"specular__mipmaps__3": 7}, "entry 3 of specular.mipmaps is 7"),
        ({"specular__mipmaps__3__length": 0}, "length of entry 3"),
        ({"specular__mipmaps__3__length": 1 << 62}, "length of entry 3"),
        ({"specular__mipmaps__3__position": -1}, "position of entry 3"),
        ({"specular__mipmaps__17__position": 10**6}, "position of entry 17"),
        ({"specular__mipmaps__3__position": 0}, "overlap"),
        ({"specular__lodGenerationScale": "a"}, "lodGenerationScale is a text"),
        ({"specular__lodGenerationScale": 1e999}, "lodGenerationScale is not finite"),
        ({"irradiance__zx": None}, "entry 7 of irradiance .* is missing"),
        ({"irradiance__zx": [1, 2]}, "entry 7 of irradiance .* has 2 entries, 3"),
        ({"irradiance__zx__1": float("inf")}, "not finite"),
        ({"irradiance__irradianceTexture__size": 3}, "power of two"),
        ({"irradiance__irradianceTexture__size": 4}, "2 x 2 pixels, 4 x 4 were expected"),
        ({"irradiance__irradianceTexture__faces": []}, "faces has 0 entries"),
        ({"irradiance__irradianceTexture__dominantDirection": [1, 2]}, "dominantDirection has 2"),
    ],
)
def test_lies_of_env_are_found(changes, says):
    data = env.env_bytes(made_env(4, **FULL))[0]
    env.parse_env(Source(change(data), "a file"))
    refused(env.parse_env, change(data, **changes), says)


def test_more_lies_of_env():
    data = env.env_bytes(made_env(2))[0]
    end = data.index(0, 8)
    for cut in [*range(0, end, 7), end, *range(end + 1, len(data), 97), len(data) - 1]:
        refused(env.parse_env, data[:cut], "some/file")
    for text, says in (
        ("", "not JSON"),
        ("[]", "not a JSON object"),
        ("[" * 100_000, "not JSON"),
        ("{", "not JSON"),
        ('{"width":' + "9" * 5000 + "}", "not JSON|width is"),
        ("{}", "width is missing"),
    ):
        refused(env.parse_env, joined(text, b""), says)
    refused(env.parse_env, data[:8] + b" " * (1 << 21), "does not end within")
    refused(env.parse_env, data[:7] + b"7" + data[8:], "magic number")
    spoilt = bytearray(data)
    spoilt[-20] ^= 1
    refused(env.parse_env, spoilt, "face 5 of mip 1, is not valid: the PNG chunk at byte .* checksum")


@pytest.fixture(scope="session")
def babylon() -> Path:
    """Folder with @babylonjs/core, where WHITEFURNACE_NODE_MODULES has it."""
    folder = Path(os.environ.get("WHITEFURNACE_NODE_MODULES") or "none", "@babylonjs", "core")
    if shutil.which("node") is None or not folder.is_dir():
        pytest.skip("WHITEFURNACE_NODE_MODULES names no folder with @babylonjs/core: .env was not opened by its code")
    return folder


def test_babylons_own_code_finds_every_image(babylon, tmp_path):
    files.write_env(tmp_path / "a.env", made_env(8, **FULL))
    script = tmp_path / "read.mjs"
    script.write_text(f"""
import {{ readFileSync }} from "node:fs";
import * as tools from {json.dumps((babylon / "Misc" / "environmentTextureTools.pure.js").as_uri())};
const data = new Uint8Array(readFileSync({json.dumps(str(tmp_path / "a.env"))}));
const info = tools.GetEnvInfo(data);
const text = views => views.map(view => Buffer.from(view).toString("base64"));
console.log(JSON.stringify({{ width: info.width, scale: info.specular.lodGenerationScale, x: info.irradiance.x,
  radiance: tools.CreateRadianceImageDataArrayBufferViews(data, info).map(text),
  irradiance: text(tools.CreateIrradianceImageDataArrayBufferViews(data, info)) }}));
""")
    done = subprocess.run(["node", str(script)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert (found["width"], found["scale"], found["x"]) == (8, 0.8, FULL["polynomials"][0].tolist())
    for k, level in enumerate([*chain(8), FULL["irradiance"]]):
        mip = [*found["radiance"], found["irradiance"]][k]
        seen = np.stack([from_rgbd(base64.b64decode(face)) for face in mip])
        assert (np.abs(seen - level) <= step("rgbd", level)).all()


# --- glTF ---------------------------------------------------------------------------------------------------


def made_light(size: int = 8, least: int = 2, **options) -> gltf_lights.GltfLight:
    return gltf_lights.GltfLight(chain(size, least), np.arange(27).reshape(9, 3) / 9, **options)


def document(*lights) -> dict:
    return json.loads(gltf_lights.gltf_text(lights or [made_light()])[0])


def parsed(found: dict, folder=None):
    return gltf_lights.parse_gltf_lights(Source(json.dumps(found).encode(), "some/file"), folder)


def blob(uri: str) -> bytes:
    head, body = uri.split(",")
    assert head == "data:image/png;base64"
    return base64.b64decode(body)


def test_gltf_as_the_extension_says(tmp_path):
    lights = [made_light(16, 4, name="sky", intensity=2.5, rotation=(0.0, 0.6, 0.0, 0.8)), made_light(2, 1)]
    files.write_gltf_lights(tmp_path / "a.gltf", lights)
    files.write_gltf_lights(tmp_path / "b.gltf", lights)
    assert (tmp_path / "a.gltf").read_bytes() == (tmp_path / "b.gltf").read_bytes()
    found = json.loads((tmp_path / "a.gltf").read_text())
    assert found["asset"]["version"] == "2.0" and found["extensionsUsed"] == ["EXT_lights_image_based"]
    entries = found["extensions"]["EXT_lights_image_based"]["lights"]
    assert [scene["extensions"]["EXT_lights_image_based"]["light"] for scene in found["scenes"]] == [0, 1]
    allowed = {"name", "rotation", "intensity", "irradianceCoefficients", "specularImages", "specularImageSize"}
    for entry, light in zip(entries, lights, strict=True):
        assert set(entry) | {"name"} == allowed  # of light.schema.json; nothing else is
        assert entry["specularImageSize"] == light.size
        assert np.shape(entry["specularImages"]) == (len(light.levels), 6)
        np.testing.assert_array_equal(entry["irradianceCoefficients"], light.coefficients)
        for level, mip in zip(light.levels, entry["specularImages"], strict=True):
            seen = np.stack([from_rgbd(blob(found["images"][k]["uri"])) for k in mip])
            assert (np.abs(seen - level) <= step("rgbd", level)).all()
    assert entries[0]["intensity"] == 2.5 and entries[0]["rotation"] == [0, 0.6, 0, 0.8]
    assert entries[1]["intensity"] == 1, "without it Babylon.js multiplies by undefined"
    for got, light in zip(files.read_gltf_lights(tmp_path / "a.gltf"), lights, strict=True):
        assert (got.name, got.intensity, got.rotation) == (light.name, light.intensity, light.rotation)
        np.testing.assert_array_equal(got.coefficients, light.coefficients)
        assert [level.shape for level in got.levels] == [level.shape for level in light.levels]
        for a, b in zip(got.levels, light.levels, strict=True):
            assert (np.abs(a - b) <= step("rgbd", b)).all()


def glb(found: dict, binary: bytes) -> bytes:
    text = json.dumps(found).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<2I", len(text), 0x4E4F534A) + text + struct.pack("<2I", len(binary), 0x004E4942) + binary
    return struct.pack("<4s2I", b"glTF", 2, 12 + len(chunks)) + chunks


def test_images_in_a_glb_in_buffers_and_in_files(tmp_path):
    light = made_light(4, 2)
    found = document(light)
    images = [blob(image["uri"]) for image in found["images"]]
    places = np.cumsum([0, *map(len, images)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": at, "byteLength": len(image)} for at, image in zip(places, images, strict=False)
    ]
    viewed = [{"bufferView": k, "mimeType": "image/png"} for k in range(len(images))]
    binary = b"".join(images)
    (tmp_path / "a.glb").write_bytes(
        glb(found | {"images": viewed, "bufferViews": views, "buffers": [{"byteLength": len(binary)}]}, binary)
    )
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "all of it.bin").write_bytes(binary)
    (tmp_path / "b.gltf").write_text(
        json.dumps(
            found
            | {
                "images": viewed,
                "bufferViews": views,
                "buffers": [{"uri": "sub/all%20of%20it.bin", "byteLength": len(binary)}],
            }
        )
    )
    for k, image in enumerate(images):
        (tmp_path / "sub" / f"{k}.png").write_bytes(image)
    (tmp_path / "c.gltf").write_text(
        json.dumps(found | {"images": [{"uri": f"sub/../sub/{k}.png"} for k in range(len(images))]}),
        encoding="utf-8-sig",
    )
    for name in ("a.glb", "b.gltf", "c.gltf"):
        (got,) = files.read_gltf_lights(tmp_path / name)
        for a, b in zip(got.levels, light.levels, strict=True):
            assert (np.abs(a - b) <= step("rgbd", b)).all(), name


def test_colours_without_alpha_are_read_as_the_engine_does():
    """JPEG and PNG of three channels: gamma 2.2 of Babylon.js' toLinearSpace, D = 1."""
    codes = np.full((8, 8, 3), (200, 100, 50), np.uint8)
    codes[:4] = (10, 250, 128)
    for form, slack in (("png", 0), ("jpeg", 2)):  # JPEG's own rounding, flat blocks at quality 100: two codes
        out = io.BytesIO()
        Image.fromarray(codes).save(out, form, **({"quality": 100, "subsampling": 0} if form == "jpeg" else {}))
        got = decode_face(Source(out.getvalue(), "a face"), 8)
        low, high = (((np.clip(codes[::-1].astype(int) + d, 0, 255)) / 255) ** 2.2 for d in (-slack, slack))
        assert (got >= low * (1 - 1e-6)).all() and (got <= high * (1 + 1e-6)).all()
        refused(lambda source: decode_face(source, 4), out.getvalue(), "8 x 8 pixels, 4 x 4 were expected")
    refused(lambda source: decode_face(source, 4), b"BM" + bytes(99), "PNG, WebP or JPEG")


@pytest.mark.parametrize(
    "uri",
    [
        "../out.png",
        "sub/../../out.png",
        "%2e%2e/out.png",
        "/etc/hostname",
        "file:///out.png",
        "http://example.org/a.png",
        "C:/out.png",
        "..\\out.png",
        "link.png",
        "a\0b",
        "",
        "\\\\host\\a",
    ],
)
def test_no_uri_leaves_the_folder(tmp_path, uri):
    folder = tmp_path / "folder"
    (folder / "sub").mkdir(parents=True)
    image = blob(document()["images"][0]["uri"])
    (tmp_path / "out.png").write_bytes(image)
    if hasattr(os, "symlink"):
        (folder / "link.png").symlink_to(tmp_path / "out.png")
    found = document()
    found["images"][0] = {"uri": uri}
    (folder / "a.gltf").write_text(json.dumps(found))
    with pytest.raises(InputError, match="not a file in the folder of the glTF"):
        files.read_gltf_lights(folder / "a.gltf")
    found["images"][0] = {"uri": "none.png"}
    (folder / "a.gltf").write_text(json.dumps(found))
    with pytest.raises(FileError, match=r"none\.png"):
        files.read_gltf_lights(folder / "a.gltf")
    (folder / "none.png").write_bytes(image)
    assert len(files.read_gltf_lights(folder / "a.gltf")) == 1


def lied(**changes) -> dict:
    found = document()
    light = found["extensions"]["EXT_lights_image_based"]["lights"][0]
    for name, value in changes.items():
        (light if name in light else found)[name] = value
    return found


ONE = base64.b64encode(png_of()).decode()


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"extensions": {}}, "without EXT_lights_image_based"),
        ({"extensions": {"EXT_lights_image_based": {"lights": []}}}, "0 entries"),
        ({"extensions": {"EXT_lights_image_based": {"lights": [{}] * 17}}}, "17 entries, 1 to 16"),
        (
            {
                "extensions": {
                    "EXT_lights_image_based": {
                        "lights": [
                            {
                                "specularImageSize": 8192,
                                "specularImages": [[0] * 6] * 14,
                                "irradianceCoefficients": [[0] * 3] * 9,
                            }
                        ]
                        * 4
                    }
                }
            },
            "bytes of texels, at most 8589934592",
        ),
        ({"specularImageSize": 6}, "power of two"),
        ({"specularImageSize": 1 << 30}, "1 to 8192"),
        ({"specularImageSize": 16}, "8 x 8 pixels, 16 x 16"),
        ({"specularImages": []}, "0 entries, 1 to 4"),
        ({"specularImages": [[0] * 6] * 5}, "5 entries, 1 to 4"),
        ({"specularImages": [[0] * 5]}, "5 entries, 6"),
        ({"specularImages": [[-1] * 6]}, "0 to 17"),
        ({"specularImages": [["a"] * 6]}, "a text, a whole number"),
        ({"specularImages": [[999] * 6]}, "999, 0 to 17"),
        ({"irradianceCoefficients": [[1, 2, 3]] * 8}, "8 entries, 9"),
        ({"irradianceCoefficients": [[1, 2, "3"]] * 9}, "a finite number"),
        ({"rotation": [0, 0, 1]}, "3 entries, 4"),
        ({"intensity": None}, "intensity of light 0 is missing"),
        ({"images": []}, "there is none"),
        ({"images": {"a": 1}}, "images is an object"),
        ({"images": [{"uri": "data:image/png;base64,***"}] * 18}, "not valid base64"),
        ({"images": [{"uri": "data:image/png,abc"}] * 18}, "not in base64"),
        ({"images": [{"uri": 7}] * 18}, "is 7, a text"),
        ({"images": [{"uri": "data:;base64," + ONE}] * 18}, "4 x 4 pixels, 8 x 8"),
        ({"images": [{}] * 18}, "bufferView, there is none"),
        (
            {"images": [{"bufferView": 0}] * 18, "bufferViews": [{"buffer": 0, "byteLength": 9}], "buffers": [{}]},
            "no binary chunk",
        ),
        (
            {
                "images": [{"bufferView": 0}] * 18,
                "buffers": [{"uri": "data:;base64," + ONE}],
                "bufferViews": [{"buffer": 0, "byteOffset": 2, "byteLength": len(png_of())}],
            },
            "buffer 0 has",
        ),
    ],
)
def test_lies_of_gltf_are_found(changes, says):
    assert len(parsed(document())) == 1
    refused(gltf_lights.parse_gltf_lights, json.dumps(lied(**changes)).encode(), says)


def test_lies_of_glb_are_found():
    data = glb(document(), b"abcd")
    read = gltf_lights.parse_gltf_lights
    assert len(read(Source(data, "a"))) == 1
    for at, value, says in (
        (4, 1, "version 1"),
        (8, 1 << 30, "truncated"),
        (8, 12, "without JSON"),
        (12, 1 << 31, "beyond"),
        (16, 0x004E4942, "must be its JSON"),
    ):
        refused(read, data[:at] + struct.pack("<I", value) + data[at + 4 :], says)
    for cut in (0, 3, 8, 11, 13, 19, 40, len(data) - 1):
        refused(read, data[:cut], "some/file")
    refused(read, b"\xff\xfe{}", "UTF-8")


# --- anything at all ----------------------------------------------------------------------------------------


def fuzzed(count: int, seed: int) -> list[int]:
    """How many of `count` mutations of a PNG, an .env, a .gltf and a .glb were taken; any error but `InputError` passes
    through. Half of those of PNG data get their checksums right again, or nothing behind them would be reached."""
    rng = random.Random(seed)
    small = {"polynomials": FULL["polynomials"], "irradiance": FULL["irradiance"][:, :1, :1]}
    found = document(made_light(1, 1))
    images = [blob(image["uri"]) for image in found["images"]]
    views = [{"buffer": 0, "byteOffset": sum(map(len, images[:k])), "byteLength": len(images[k])} for k in range(6)]
    packed = found | {"images": [{"bufferView": k} for k in range(6)], "bufferViews": views, "buffers": [{}]}
    seeds = [
        (decode_png, encode_png(np.arange(300, dtype=np.uint8).reshape(10, 10, 3))),
        (env.parse_env, env.env_bytes(env.EnvMap(chain(1), **small))[0]),
        (gltf_lights.parse_gltf_lights, json.dumps(found).encode()),
        (gltf_lights.parse_gltf_lights, glb(packed, b"".join(images))),
    ]
    words = [b"0", b"-1", b"1e999", b"null", b"[]", b"{}", b'"a"', b"true", b"NaN", b"9" * 11, b"\0", b",", b"[" * 50]
    taken = [0] * len(seeds)
    for number in range(count):
        which = rng.choice((0, 0, 1, 1, 2, 3))
        read, data = seeds[which]
        data = bytearray(data)
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            action, at = rng.randrange(5), rng.randrange(len(data) or 1)
            if action == 0 and data:
                data[at] ^= 1 << rng.randrange(8)
            elif action == 1:
                data[at : at + 4] = struct.pack(
                    rng.choice("<>") + "I", rng.choice((0, 1, 8, 255, 1 << 31, len(data), rng.getrandbits(32)))
                )
            elif action == 2 and rng.random() < 0.3:
                del data[at:]
            elif action == 3:
                data[at : at + rng.randrange(6)] = rng.choice(words)
            else:
                data[at:at] = rng.randbytes(rng.randrange(1, 9))
        if number % 2:
            data = mended(bytes(data))
        try:
            read(Source(bytes(data), "some/file"))
        except InputError as error:
            text = str(error)
            assert text.startswith("some/file") and "\n" not in text and len(text) < 500, text
        else:
            taken[which] += 1
    return taken


def mended(data: bytes) -> bytes:
    """Checksums of PNG chunks made right, where lengths still fit."""
    out, start = bytearray(data), data.find(b"\x89PNG\r\n\x1a\n")
    while start >= 0:
        at = start + 8
        while at + 12 <= len(out):
            length = int.from_bytes(out[at : at + 4], "big")
            if at + 12 + length > len(out):
                break
            out[at + 8 + length : at + 12 + length] = struct.pack(">I", zlib.crc32(out[at + 4 : at + 8 + length]))
            if out[at + 4 : at + 8] == b"IEND":
                break
            at += 12 + length
        start = data.find(b"\x89PNG\r\n\x1a\n", start + 1)
    return bytes(out)


@pytest.mark.parametrize("count", [5_000, pytest.param(20_000, marks=pytest.mark.long)])
def test_thousands_of_inputs_give_a_light_or_one_sentence(capfd, count):
    taken = fuzzed(count, 3)
    assert all(10 < count < 15_000 for count in taken), taken  # of each kind both ends are seen
    assert not capfd.readouterr().err, "libraries must not speak for themselves"


@pytest.mark.long
def test_a_million_inputs_give_a_light_or_one_sentence():
    for seed in range(10):
        fuzzed(100_000, 100 + seed)


# --- Radiance .hdr ------------------------------------------------------------------------------------------


def by_oiio(path: Path) -> np.ndarray:
    reader = oiio.ImageInput.open(str(path))
    pixels = reader.read_image("float")
    reader.close()
    return pixels


@pytest.mark.parametrize("width", [1, 7, 8, 50, 300])
def test_hdr_is_rounded_to_the_nearest_code(tmp_path, width):
    """Read by OpenImageIO. Nearest, by trying: no other mantissa of the texel's exponent is nearer, and a smaller
    exponent could not hold its largest channel."""
    image = lognormal((9, width, 3), width, 6).astype(np.float64)
    image[1], image[2, :, 1], image[3], image[4] = 2.0, 0.0, 0.0, (255.5, 255.4, 1e-3)
    image[5] = (255.49, 127.6, 0)
    path = tmp_path / "a.hdr"
    packed = files.write_hdr(path, image)
    assert (packed.clipped, packed.negative) == (0, 0)
    got = by_oiio(path).astype(np.float64)
    exponent = packed.data[..., 3:].astype(int)
    unit = np.where(exponent > 0, np.ldexp(1.0, exponent - 136), 1.0)
    for other in range(256):
        assert (np.abs(got - image) <= np.abs(other * unit - image)).all()
    top = image.max(-1, keepdims=True)
    assert (np.where(top > 0, np.rint(top / (unit / 2)), 999) > 255).all()
    assert (np.abs(got - image) <= hdr.step_hdr(image)).all()
    # Half a step in 127½ at worst, of the largest channel; of black half of the smallest step there is.
    assert (hdr.step_hdr(image) <= np.maximum(top / 255, 2.0**-136)).all()
    np.testing.assert_array_equal(hdr.unpack_hdr(packed.data), got)
    first = path.read_bytes()
    files.write_hdr(path, image)
    assert path.read_bytes() == first


def test_hdr_does_not_darken(tmp_path):
    """OpenImageIO's own writer loses a third of a step on average; ours nothing: the mean of N uniform errors within
    half a step has a standard deviation of 1/√(12 N)."""
    image = np.random.default_rng(4).uniform(1, 2, (100, 100, 3))
    files.write_hdr(tmp_path / "a.hdr", image)
    error = (by_oiio(tmp_path / "a.hdr") - image) * 128
    assert abs(error.mean()) < 5 / math.sqrt(12 * image.size)


def test_hdr_packs_runs_and_counts_what_it_cannot_hold(tmp_path):
    path = tmp_path / "a.hdr"
    rows = np.ones((64, 2000, 3))
    rows[::2, 5:900:3] = np.random.default_rng(1).random((32, 299, 3))
    rows[1, 3:130] = 7
    files.write_hdr(path, rows)
    np.testing.assert_array_equal(by_oiio(path), hdr.unpack_hdr(hdr.pack_hdr(rows).data))
    # 2000 equal bytes are 16 runs of two bytes, in four channels, and four bytes before them
    assert len(path.read_bytes()) < 64 * (4 + 4 * 32) + 32 * 4 * 900 + 100
    packed = files.write_hdr(path, [[[np.inf, 1e38, -1.0], [1e-45, 0, 0]]])
    assert (packed.clipped, packed.negative) == (1, 1)
    assert np.isfinite(by_oiio(path)).all()
    with pytest.raises(InputError, match="2 NaN"):
        files.write_hdr(path, [[[np.nan, np.nan, 1]]])


# --- ASTC ---------------------------------------------------------------------------------------------------


def test_astc_of_one_colour_is_the_block_of_the_specification():
    """A void extent of HDR: nine bits 111111100, bit 9 for HDR, no extent, then four halves [KDF 1.3, 23.22]."""
    pytest.importorskip("astc_encoder")
    colour = np.array([0.25, 3.5, 1000.0])
    made = encode("astc4x4hdr", [np.broadcast_to(colour, (6, s, s, 3)) for s in (8, 4)], cube=True)
    block = struct.pack("<Q4e", 0xFFFFFFFFFFFFFFFC | 0x200, *colour, 1.0)
    assert bytes(made.texture.levels[0]) == block * 24 and bytes(made.texture.levels[1]) == block * 6
    data = ktx2_bytes(made.texture)
    assert struct.unpack_from("<I", data, 12) == (1000066000,)
    np.testing.assert_array_equal(decode(parse_ktx2(Source(data, "a")), 0), np.broadcast_to([*colour, 1], (6, 8, 8, 4)))


def test_astc_codes_what_is_given():
    pytest.importorskip("astc_encoder")
    y, x = np.mgrid[0:13, 0:11]
    ramp = np.stack([1 + x / 10, 2 + y / 10, 3 + (x + y) / 30, 1 + 0 * x], axis=-1)
    for channels in (3, 4):
        made = encode("astc4x4hdr", [ramp[..., :channels]])
        # Two weights of a block span this plane of colours only in part, as for BC6H; half of what is left of 0.3.
        np.testing.assert_allclose(decode(made.texture, 0), ramp, rtol=0.075)
        assert bytes(made.texture.levels[0]) == bytes(encode("astc4x4hdr", [ramp[..., :channels]]).texture.levels[0])
    for value, read, clipped, negative in (
        (65504, 65504, 0, 0),
        (1e9, 65504, 3, 0),
        (-2, 0, 0, 3),
        (np.inf, 65504, 3, 0),
    ):
        flat = encode("astc4x4hdr", [np.full((1, 1, 3), value)])
        assert (flat.clipped, flat.negative) == ((clipped,), (negative,))
        np.testing.assert_array_equal(decode(flat.texture, 0), [[[read, read, read, 1]]])
    with pytest.raises(InputError, match="NaN"):
        encode("astc4x4hdr", [np.full((4, 4, 3), np.nan)])
    with pytest.raises(UnsupportedError, match="0 and 100"):
        astc.encode_astc(ramp, quality=101)
    noise = random.Random(1)
    for _ in range(300):  # blocks of any bits decode to something, NaN among it
        assert astc.decode_astc(noise.randbytes(64), (7, 8)).shape == (7, 8, 4)


def test_astc_leaves_strings_as_they_are():
    """astc-encoder writes capitals into the string of channels that it is given, and equal literals are one object."""
    pytest.importorskip("astc_encoder")
    order = "rgba"
    astc.decode_astc(astc.encode_astc(np.ones((4, 4, 4), np.float32)).data.tobytes(), (4, 4))
    assert [ord(letter) for letter in order] == [0x72, 0x67, 0x62, 0x61]


def test_astc_without_its_library_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "astc_encoder", None)
    with pytest.raises(UnsupportedError, match=r'pip install "whitefurnace\[astc\]"'):
        encode("astc4x4hdr", [np.ones((4, 4, 3))])


# --- octahedral maps ----------------------------------------------------------------------------------------


def smooth(d: np.ndarray) -> np.ndarray:
    """(m, 2): functions of the sphere without any symmetry."""
    x, y, z = d
    return np.stack([2 + x + 0.5 * y * z - 0.7 * z * z * x + 0.3 * y, np.exp(0.5 * x - 0.8 * y + 0.6 * z)], -1)


def sphere_directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(3, count))
    return d / np.sqrt((d * d).sum(0))


def octahedral(n: int) -> np.ndarray:
    return smooth(octamap.texel_directions(n)).reshape(n, n, 2)


def test_octahedron_both_ways_and_where_the_axes_are():
    d = np.concatenate([sphere_directions(5000), np.eye(3), -np.eye(3)], axis=1)
    u, v = to_square(d)
    assert (np.abs([u, v]) <= 1).all()
    np.testing.assert_allclose(to_direction(u, v), d, atol=1e-15 * 8)
    for direction, places in (
        ((0, 1, 0), [(0, 0)]),
        ((1, 0, 0), [(1, 0)]),
        ((-1, 0, 0), [(-1, 0)]),
        ((0, 0, 1), [(0, 1)]),
        ((0, 0, -1), [(0, -1)]),
        ((0, -1, 0), [(1, 1), (-1, 1), (1, -1), (-1, -1)]),
    ):
        for a, b in places:
            np.testing.assert_array_equal(to_direction(np.array([a]), np.array([b]))[:, 0], direction)
    t = np.linspace(-1, 1, 33)
    for edge in (-np.ones(33), np.ones(33)):  # what the border relies on
        np.testing.assert_allclose(to_direction(edge, t), to_direction(edge, -t), atol=1e-15)
        np.testing.assert_allclose(to_direction(t, edge), to_direction(-t, edge), atol=1e-15)
    # Each octant is an eighth of the square; the horizon goes through 2 · 64 texel centres.
    texels = octamap.texel_directions(64)
    signs = texels[:, np.abs(texels[1]) > 1e-9] > 0
    assert (np.bincount(signs[0] * 4 + signs[1] * 2 + signs[2]) == (64 * 64 - 128) / 8).all()


@pytest.mark.parametrize("b", [1, 2, 5])
def test_a_border_makes_every_seam_vanish(b):
    """On both sides of an edge a read is the same to rounding; clamped instead, it differs by a texel's slope."""
    n = 16
    image = octahedral(n)
    bordered = octamap.add_border(image, b)
    np.testing.assert_array_equal(octamap.strip_border(bordered, b), image)
    clamped = np.pad(image, ((b, b), (b, b), (0, 0)), "edge")

    def read(of: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        x, y = (u + 1) / 2 * n - 0.5 + b, (v + 1) / 2 * n - 0.5 + b
        j, i = np.floor(x).astype(int), np.floor(y).astype(int)
        a, e = (x - j)[:, None], (y - i)[:, None]
        return (of[i, j] * (1 - a) + of[i, j + 1] * a) * (1 - e) + (of[i + 1, j] * (1 - a) + of[i + 1, j + 1] * a) * e

    t = np.linspace(-1, 1, 401)
    one = np.ones_like(t)
    jumps = {}
    for name, of in (("bordered", bordered), ("clamped", clamped)):
        jumps[name] = max(np.abs(read(of, s * one, t) - read(of, s * one, -t)).max() for s in (-1, 1))
        jumps[name] = max(jumps[name], *(np.abs(read(of, t, s * one) - read(of, -t, s * one)).max() for s in (-1, 1)))
        corners = read(of, np.array([-1, -1, 1, 1]), np.array([-1, 1, -1, 1]))
        jumps[name] = max(jumps[name], np.ptp(corners, axis=0).max())
    assert jumps["bordered"] < 1e-13 and jumps["clamped"] > 0.05, jumps
    # Deeper in the border stand the texels themselves.
    x = np.arange(-b, n + b)
    u, v = np.meshgrid((2 * x + 1) / n - 1, (2 * x + 1) / n - 1)
    outside = np.maximum(np.abs(u), np.abs(v)) > 1
    fold_u = np.abs(u) > 1
    u1, v1 = np.where(fold_u, np.sign(u) * 2 - u, u), np.where(fold_u, -v, v)
    fold_v = np.abs(v1) > 1
    u2, v2 = np.where(fold_v, -u1, u1), np.where(fold_v, np.sign(v1) * 2 - v1, v1)
    wanted = smooth(to_direction(u2.ravel(), v2.ravel())).reshape(n + 2 * b, n + 2 * b, 2)
    np.testing.assert_allclose(bordered[outside], wanted[outside], rtol=1e-14)
    for wrong in (-1, n + 1):
        with pytest.raises(ValueError, match="border"):
            octamap.add_border(image, wrong)
    with pytest.raises(ValueError, match="no border"):
        octamap.read_bilinear(image, sphere_directions(3), 0)


def test_reads_converge_at_second_order_and_at_creases_at_first():
    d = sphere_directions(40_000)
    crease = np.sort(np.abs(d / np.abs(d).sum(0)), axis=0)[0]  # distance from the octahedron's edges, in u, v
    u, v = to_square(d)
    edge = 1 - np.maximum(np.abs(u), np.abs(v))
    inside, worst = [], []
    for n in (16, 32, 64, 128):
        error = np.abs(octamap.read_bilinear(octamap.add_border(octahedral(n), 1), d) - smooth(d)).max(1)
        inside.append(error[np.minimum(crease, edge) > 2 / 16].max())
        worst.append(error.max())
    orders = np.log2(np.array([inside, worst])[:, :-1] / np.array([inside, worst])[:, 1:])
    # Maxima over drawn directions: within a quarter of the order, worse creases still first order.
    assert (orders[0] > 1.75).all() and (orders[1] > 0.75).all() and orders[1].min() < 1.5, orders


def test_an_atlas_holds_every_level_with_its_border():
    b = 2
    levels = [octahedral(n) for n in (32, 16, 8, 4)]
    image, places = octamap.to_atlas(levels, b)
    assert image.shape == (20 + 12 + 8, 36 + 20, 2)
    covered = np.zeros(image.shape[:2], int)
    for level, place, part in zip(levels, places, octamap.from_atlas(image, places, b), strict=True):
        np.testing.assert_array_equal(part, octamap.add_border(level, b))
        covered[place.row - b : place.row + place.side + b, place.column - b : place.column + place.side + b] += 1
    assert covered.max() == 1, "levels must not overlap"
    with pytest.raises(ValueError, match="levels from 4"):
        octamap.atlas_places(4, 3, 2)
