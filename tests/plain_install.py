"""Tries an installation without any extra: `python tests/plain_install.py` in an environment that has the wheel alone.

Every command's help, every command line and Python block of the documents on small inputs, and every public function:
each ends well, or with the one sentence that names the extra it needs, before it computes anything.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import re
import sys
import tempfile
import time
import traceback
from pathlib import Path

EXTRAS = {
    "astc": "astc_encoder",
    "bc6h": "ispc_texcomp",
    "dask": "distributed",
    "plot": "matplotlib",
    "scene": "pygltflib",
}
NAMES_AN_EXTRA = re.compile(r"""pip install ["']?whitefurnace\[(\w+)\]["']?""")
UNSUPPORTED = 5  # the exit code of what an installation cannot do
PROMPT = 5.0  # seconds in which a missing extra is found; a bake of the documents computes for longer


def run(arguments: list[str]) -> tuple[int, str, float]:
    """Exit code, everything printed, and seconds of one command line, in this process."""
    from whitefurnace.cli import main

    printed, begin = io.StringIO(), time.perf_counter()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main(arguments)
            code = 0
        except SystemExit as done:
            code = done.code if isinstance(done.code, int) else 0 if done.code is None else 1
        except BaseException:
            printed.write(traceback.format_exc())
            code = 70
    return code, printed.getvalue(), time.perf_counter() - begin


def complaint(arguments: list[str], wanted: tuple[int, ...] = (0,)) -> str | None:
    """What is wrong with how a command line ended; None where nothing is."""
    code, printed, seconds = run(arguments)
    tail = " | ".join(printed.strip().splitlines()[-3:])
    if "Traceback" in printed or "ModuleNotFoundError" in printed:
        return f"ended in a traceback: {tail}"
    if code in wanted:
        return None
    named = NAMES_AN_EXTRA.search(printed)
    if code == UNSUPPORTED and named and named[1] in EXTRAS:
        return None if seconds < PROMPT else f"took {seconds:.0f} s to find that [{named[1]}] is missing"
    return f"ended with exit code {code}: {tail}"


def commands() -> list[str]:
    from whitefurnace.cli import cli

    return sorted(cli.list_commands(None))  # type: ignore[arg-type]


def main() -> int:
    present = [f"[{extra}]" for extra, module in EXTRAS.items() if importlib.util.find_spec(module)]
    if present:
        print(f"This environment has {', '.join(present)}: it is no plain install and would prove nothing.")
        return 2
    import documents
    import public_calls

    failures = []

    def check(name: str, said: str | None) -> None:
        print(f"{'FAIL' if said else 'ok':4}  {name}" + (f"\n      {said}" if said else ""), flush=True)
        if said:
            failures.append(name)

    check("whitefurnace --help", complaint(["--help"]))
    for command in commands():
        check(f"whitefurnace {command} --help", complaint([command, "--help"]))
    with tempfile.TemporaryDirectory() as folder:
        documents.prepare(Path(folder))
        os.chdir(folder)
        for line in documents.commands():
            if before := documents.needed(line):
                check(f"(the bake of) {line.text}", complaint(before))
            check(line.text, complaint(documents.shortened(line), line.exit_codes))
        for block in documents.python_blocks():
            check(f"the Python of {block.page}", _called(lambda text=block.text: exec(text, {})))
        check("every module can be imported", _called(public_calls.import_everything))
        calls = Path(folder) / "calls"
        calls.mkdir()
        check("every public function can be called", _called(lambda: public_calls.call_everything(calls)))
        os.chdir(os.path.dirname(os.path.abspath(__file__)))
    print(f"{len(failures)} failed" + (f": {'; '.join(failures)}" if failures else ""))
    return 1 if failures else 0


def _called(action) -> str | None:
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            action()
    except Exception:
        return traceback.format_exc().strip().splitlines()[-1]
    return None


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    sys.exit(main())
