"""One memory budget for every reader: a small file cannot take a gigabyte, and the limit can be set."""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from whitefurnace.errors import InputError, UsageError
from whitefurnace.files import Texture, memory, read_image, write_exr
from whitefurnace.files.env import EnvMap, env_bytes
from whitefurnace.files.gltf_lights import GltfLight, gltf_text
from whitefurnace.files.ktx2 import ktx2_bytes
from whitefurnace.files.png import encode_png
from whitefurnace.files.zstd import compress

KIB, MIB, GIB = 1 << 10, 1 << 20, 1 << 30


@pytest.fixture
def machine_of_16_gib(monkeypatch):
    monkeypatch.delenv(memory.VARIABLE, raising=False)
    monkeypatch.setattr(memory, "machine", lambda: 16 * GIB)


def test_the_default_limit_grows_with_the_file_up_to_half_of_the_machine(machine_of_16_gib):
    assert memory.limit(0) == 256 * MIB
    assert memory.limit(6 * KIB) == 262 * MIB
    assert memory.limit(MIB) == 256 * MIB + GIB
    assert memory.limit(100 * MIB) == 8 * GIB


def test_the_variable_is_the_limit_of_every_file(machine_of_16_gib, monkeypatch):
    for text, wanted in (
        ("4GB", 4 * 10**9),
        ("4g", 4 * 10**9),
        ("1.5 GiB", 3 * GIB // 2),
        ("512MB", 512 * 10**6),
        ("2000000", 2 * 10**6),
        ("25%", 4 * GIB),
    ):
        monkeypatch.setenv(memory.VARIABLE, text)
        assert memory.limit(0) == memory.limit(GIB) == wanted, text
    monkeypatch.setenv(memory.VARIABLE, "")
    assert memory.limit(0) == 256 * MIB
    for text in ("much", "-1GB", "1e9", "nan", "1 B%", "4XB", "inf", "0", "1KB", "9" * 400):
        monkeypatch.setenv(memory.VARIABLE, text)
        with pytest.raises(UsageError, match="WHITEFURNACE_MEMORY is "):
            memory.require(1, "its pixels", "a.exr", 1)


def test_a_refusal_names_the_sizes_the_limit_and_the_cure(machine_of_16_gib):
    memory.require(256 * MIB, "its texels", "a.ktx2", 6 * KIB)
    with pytest.raises(InputError) as error:
        memory.require(934 * 10**6, "its texels", "a.ktx2", 6000)
    assert str(error.value) == (
        "a.ktx2: its texels need 934 MB of memory, a file of 6 KB may take 275 MB; set WHITEFURNACE_MEMORY=934MB "
        "or give --memory 934MB to read it all the same"
    )


def test_the_machine_s_memory_is_known_and_no_more_than_its_limits(monkeypatch):
    memory.machine.cache_clear()
    assert 256 * MIB < memory.machine() <= os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for limits, wanted in (((8, 4, None), 4), ((8, None, 2), 2), ((None, None, None), 4 * GIB)):
        for name, value in zip(("_physical", "_control_group", "_address_space"), limits, strict=True):
            monkeypatch.setattr(memory, name, lambda value=value: value)
        memory.machine.cache_clear()
        assert memory.machine() == wanted
    memory.machine.cache_clear()


def test_the_option_sets_the_limit_for_its_command_alone(tmp_path, shell, monkeypatch):
    monkeypatch.delenv(memory.VARIABLE, raising=False)
    path = tmp_path / "a.exr"
    write_exr(path, np.ones((512, 1024, 3), np.float32))  # 6.3 MB of pixels
    assert shell("inspect", path, "--memory", "3MB") == 3
    assert "its 1024 x 512 pixels of 3 channels need" in shell.sentence() and "may take 3 MB" in shell.sentence()
    assert memory.VARIABLE not in os.environ
    assert shell("inspect", path) == 0 and read_image(path).pixels.shape == (512, 1024, 3)
    assert shell("bake", path, "-o", tmp_path / "out", "--dry-run", "--memory", "3MB") == 3
    assert shell("compare", path, path, "--memory", "much") == 1
    assert shell.sentence() == (
        "error: --memory is 'much', an amount of memory was expected, such as 4GB, 512MB, 1.5GiB or 25%"
    )


# --- bombs: small files that ask for much -----------------------------------------------------------------


def bomb_ktx2(side: int, zstd: bool) -> bytes:
    """A cube of side² half floats of 0, packed: about 1 byte for 30 000, or for 1000 with ZLIB."""
    small = Texture("rgba16f", 1, 1, (bytes(48),), 0, 6)
    data = bytearray(ktx2_bytes(small, zstd=3))
    (at,) = struct.unpack_from("<Q", data, 80)
    zeros = bytes(side * side * 48)
    packed = compress(zeros, 19) if zstd else zlib.compress(zeros, 9)
    del data[at:]
    data[20:28] = struct.pack("<2I", side, side)
    data[44:48] = struct.pack("<I", 2 if zstd else 3)
    data[80:104] = struct.pack("<3Q", at, len(packed), len(zeros))
    return bytes(data) + packed


def bombs(folder: Path) -> list[Path]:
    files: dict[str, bytes] = {
        "zstd.ktx2": bomb_ktx2(2048, True),
        "zlib.ktx2": bomb_ktx2(2048, False),
    }
    with zipfile.ZipFile(folder / "one.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        text = repr({"descr": "|u1", "fortran_order": False, "shape": (6, 4096, 4096, 3)}).encode() + b"\n"
        with archive.open("specular_0.npy", "w") as stream:
            stream.write(b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text)
            for _ in range(6):
                stream.write(bytes(4096 * 4096 * 3))
    cube = [np.ones((6, max(16 >> k, 1), max(16 >> k, 1), 3), np.float32) for k in range(5)]
    light = json.loads(gltf_text([GltfLight(tuple(cube[:1]), np.zeros((9, 3)))])[0])
    files["values.gltf"] = json.dumps({**light, "extras": [0] * 12_000_000}, separators=(",", ":")).encode()
    side = 4096
    face = encode_png(np.full((side, side, 4), 255, np.uint8))
    parts: list[tuple[int, int]] = []
    body = bytearray()
    for k in range(int(math.log2(side)) + 1):
        image = face if not k else encode_png(np.full((side >> k, side >> k, 4), 255, np.uint8))
        for _ in range(6):
            parts.append((len(body), len(image)))
            body += image
    whole, _, _ = env_bytes(EnvMap(tuple(cube), np.zeros((9, 3))))
    manifest = json.loads(whole[8 : whole.index(b"\0", 8)])
    manifest["width"] = side
    manifest["specular"]["mipmaps"] = [{"position": at, "length": n} for at, n in parts]
    files["faces.env"] = whole[:8] + json.dumps(manifest).encode() + b"\0" + bytes(body)
    files["flat.png"] = encode_png(np.zeros((8192, 8192, 3), np.uint8))
    files["m.json"] = b'{"whitefurnace": [' + b"0," * 20_000_000 + b"0]}"
    for name, data in files.items():
        (folder / name).write_bytes(data)
    found = [*(folder / name for name in files), folder / "one.npz"]
    return sorted(found, key=lambda path: path.stat().st_size)


CHILD = """
import re, sys
from pathlib import Path
from whitefurnace.errors import WhitefurnaceError
from whitefurnace.inspection.contents import contents, described
for path in sys.argv[1:]:
    try:
        described(contents(path))
        print("read", path)
    except WhitefurnaceError as error:
        print(error)
    # Not ru_maxrss, which begins with that of the process that started this one.
    print(re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="the peak is read from /proc")
def test_no_file_takes_more_than_its_limit(tmp_path):
    """The peak of a process that looks into all of them, from the smallest to the largest."""
    found = bombs(tmp_path)
    environment = {name: value for name, value in os.environ.items() if name != memory.VARIABLE}
    done = subprocess.run(
        [sys.executable, "-c", CHILD, *map(str, found)], capture_output=True, text=True, env=environment, timeout=300
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    for path, said, peak in zip(found, lines[::2], lines[1::2], strict=True):
        size = path.stat().st_size
        # Python, numpy and OpenImageIO take 150 MB; bands of values and copies of the file, some tens.
        allowed = memory.limit(size) + 250 * 10**6
        assert int(peak) * 1024 < allowed, f"{path.name}, {size} bytes: {int(peak) / 1e3:.0f} MB ({said})"
        assert size > 10_000 or int(peak) * 1024 < 500 * 10**6
    refused = {path.name for path, said in zip(found, lines[::2], strict=True) if not said.startswith("read")}
    assert refused >= {"zstd.ktx2", "values.gltf", "flat.png", "m.json", "one.npz"}, lines


def test_small_bombs_are_refused_before_the_memory_is_taken(machine_of_16_gib, tmp_path):
    """The smallest of the bombs in this process, with the sentence of each."""
    import tracemalloc

    from whitefurnace.inspection.contents import contents

    small = bomb_ktx2(64, True)
    (tmp_path / "a.ktx2").write_bytes(small)
    # As if the cube had 4096²: the header alone decides.
    (tmp_path / "b.ktx2").write_bytes(small[:20] + struct.pack("<2I", 4096, 4096) + small[28:])
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"b\.ktx2: its 4096 x 4096 x 6 texels as floats need 2\.42 GB of memory"):
            contents(tmp_path / "b.ktx2")
        values = json.dumps({"asset": {"version": "2.0"}, "extras": [0] * 10}).encode()
        (tmp_path / "c.gltf").write_bytes(values.replace(b"0, 0", b"0," * 4_100_000 + b"0", 1))
        with pytest.raises(InputError, match=r"its JSON has about 41000\d\d values, at most 4000000 are read"):
            contents(tmp_path / "c.gltf")
        assert tracemalloc.get_traced_memory()[1] < 64 * MIB
    finally:
        tracemalloc.stop()
