"""The public names are functions whatever was imported, and outsiders see their types."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import whitefurnace

HERE = Path(__file__).resolve().parent


def test_every_public_name_is_a_function_after_every_import(tmp_path):
    """In a process of its own, since this one has imported some modules already and in another order."""
    script = (
        "import sys; from pathlib import Path; import public_calls as calls\n"
        "assert len(calls.import_everything()) > 100\n"
        "calls.call_everything(Path(sys.argv[1]))"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], cwd=HERE, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_types_are_shipped():
    assert (Path(whitefurnace.__file__).parent / "py.typed").is_file()
