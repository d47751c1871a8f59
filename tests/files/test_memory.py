"""One memory budget for every reader: a small file cannot take a gigabyte, and the limit can be set."""

from __future__ import annotations

import os

import numpy as np
import pytest

from whitefurnace.errors import InputError, UsageError
from whitefurnace.files import memory, read_image, write_exr

KIB, MIB, GIB = 1 << 10, 1 << 20, 1 << 30


@pytest.fixture
def machine_of_16_gib(monkeypatch):
    monkeypatch.delenv(memory.VARIABLE, raising=False)
    monkeypatch.setattr(memory, "machine", lambda: 16 * GIB)


def test_the_default_limit_grows_with_the_file_up_to_half_of_the_machine(machine_of_16_gib):
    assert memory.limit(0) == 512 * MIB
    assert memory.limit(6 * KIB) == 518 * MIB
    assert memory.limit(MIB) == 512 * MIB + GIB
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
    assert memory.limit(0) == 512 * MIB
    for text in ("much", "-1GB", "1e9", "nan", "1 B%", "4XB", "inf", "0", "1KB", "9" * 400):
        monkeypatch.setenv(memory.VARIABLE, text)
        with pytest.raises(UsageError, match="WHITEFURNACE_MEMORY is "):
            memory.require(1, "its pixels", "a.exr", 1)


def test_a_refusal_names_the_sizes_the_limit_and_the_cure(machine_of_16_gib):
    memory.require(512 * MIB, "its texels", "a.ktx2", 6 * KIB)
    with pytest.raises(InputError) as error:
        memory.require(934 * 10**6, "its texels", "a.ktx2", 6000)
    assert str(error.value) == (
        "a.ktx2: its texels need 934 MB of memory, a file of 6 KB may take 543 MB; set WHITEFURNACE_MEMORY to a larger "
        "amount, such as 934MB, to read it all the same"
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
