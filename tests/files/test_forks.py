"""Images in a process that was forked from one that had read some."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest

from whitefurnace.files import read_image, write_exr


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_images_are_read_and_written_in_a_forked_process(tmp_path):
    """OpenEXR's threads stay in the parent; a process that waited for them would be ended by its alarm."""
    path = tmp_path / "a.exr"
    # OpenEXR reads in threads where an image has several blocks of rows.
    pixels = np.random.default_rng(1).random((256, 512, 3), dtype=np.float32)
    write_exr(path, pixels)
    first = read_image(path).pixels
    child = os.fork()
    if child == 0:
        code = 1
        try:
            signal.alarm(60)
            write_exr(tmp_path / "b.exr", pixels)
            code = 0 if np.array_equal(read_image(tmp_path / "b.exr").pixels, first) else 2
        finally:
            os._exit(code)
    assert os.waitpid(child, 0)[1] == 0
    assert np.array_equal(read_image(path).pixels, first)
