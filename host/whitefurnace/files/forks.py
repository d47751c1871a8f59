"""Keeps image files readable in a process that was forked from one that had read some."""

from __future__ import annotations

import os
import sys


def _without_threads() -> None:
    """Let OpenEXR work without threads in a forked process.

    Its pool belongs to the parent: its threads do not come along in a fork, and whoever waits for them waits without
    end.
    """
    oiio = sys.modules.get("OpenImageIO")
    if oiio is not None:
        oiio.attribute("exr_threads", -1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_without_threads)
