"""Keeps image files readable in a process that was forked from one that had read some."""

from __future__ import annotations

import os
import sys


def _without_threads() -> None:
    """Let OpenEXR work without threads in a forked process.

    The threads of its pool belong to the parent and do not exist after a fork, so a wait for them would never end.
    """
    oiio = sys.modules.get("OpenImageIO")
    if oiio is not None:
        oiio.attribute("exr_threads", -1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_without_threads)
