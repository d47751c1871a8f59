"""Runs command lines in this process or names them for one of their own; looks at the folders they leave."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from whitefurnace.cli import main


class Shell:
    """Runs the command line in this process: what a shell would see of it."""

    def __init__(self, capsys):
        self.capsys = capsys

    def __call__(self, *argv) -> int:
        self.capsys.readouterr()
        with pytest.raises(SystemExit) as done:
            main([str(a) for a in argv])
        self.out, self.err = self.capsys.readouterr()
        assert "Traceback" not in self.out + self.err, self.err
        return done.value.code

    def sentence(self) -> str:
        """The one line on stderr."""
        lines = self.err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("error: "), self.err
        assert 20 < len(lines[0]) < 500
        return lines[0]

    def rows(self) -> list[dict]:
        return [json.loads(line) for line in self.out.splitlines()]


def command(*argv) -> list[str]:
    return [sys.executable, "-m", "whitefurnace", *(str(a) for a in argv)]


def tree(folder: Path) -> dict[str, bytes]:
    """Every file under a folder with its bytes."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if not p.is_dir()}


@contextlib.contextmanager
def mounted(folder: Path, *options: str):
    """A tmpfs, where this user may mount one."""
    folder.mkdir(exist_ok=True)
    tried = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(folder)], capture_output=True
    )
    if not tried or tried.returncode:
        pytest.skip("only root with the right to mount can make a small file system")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)
