"""The version of the installed package, as setup.cfg states it."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

try:
    VERSION = version("whitefurnace")
except PackageNotFoundError:  # run from a tree that is not installed
    VERSION = "0+unknown"
