"""The version of the installed package: it stands once, in setup.cfg."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

try:
    VERSION = version("whitefurnace")
except PackageNotFoundError:  # run from a tree that is not installed
    VERSION = "0+unknown"
