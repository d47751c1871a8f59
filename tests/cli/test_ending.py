"""How commands end: on closed streams and broken pipes, by signals, and by errors that nobody expected."""

from __future__ import annotations

import errno
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from shell import command, tree
from whitefurnace.cli import ending, main
from whitefurnace.errors import DeviceError, UsageError, WhitefurnaceError, code_of
from whitefurnace.files import write_exr

posix = pytest.mark.skipif(os.name != "posix", reason="streams, pipes and signals as POSIX has them")


def shell_script(text: str, **options) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-c", text], capture_output=True, text=True, timeout=120, **options)


# ---------------------------------------------------------------------------------------------- streams


@posix
@pytest.mark.few(1)
@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", ">&-", "2>&-"])
def test_a_closed_stream_is_the_null_device(tmp_path, device, closed):
    """A file that took the number of a closed stream would have what is printed in it."""
    made = shlex.join(command("lut", "dfg", "-o", tmp_path / "t.npy", "--size", "4", "--force"))
    assert shell_script(made).returncode == 0
    want = tree(tmp_path)
    done = shell_script(f"{made} {closed}")
    assert (done.returncode, done.stderr) == (0, "")
    assert tree(tmp_path) == want
    refused = shell_script(f"{shlex.join(command('models', 'nope'))} {closed}")
    assert refused.returncode == 1 and refused.stderr == ("" if "2>" in closed else "error: " + refused.stderr[7:])


@posix
def test_no_file_takes_the_number_of_a_closed_stream():
    code = (
        "import os\nfrom whitefurnace.cli.ending import open_streams\nopen_streams()\n"
        "kept = os.open('/dev/zero', os.O_RDONLY)\n"
        "names = [os.readlink(f'/proc/self/fd/{k}') for k in range(3)] if os.path.isdir('/proc/self/fd') else []\n"
        "os._exit(0 if kept > 2 and set(names) <= {'/dev/null'} and all(map(os.get_inheritable, range(3))) else 1)"
    )
    done = shell_script(f"{shlex.join([sys.executable, '-c', code])} <&- >&- 2>&-")
    assert done.returncode == 0


@posix
@pytest.mark.few(2)
@pytest.mark.parametrize("argv", ["models", "--help", "models nope --json", "devices"])
def test_a_broken_pipe_is_quiet(tmp_path, argv):
    """The reader is gone before anything is written; 141 is what shells say of a program that SIGPIPE ended."""
    gone = f"{{ sleep 0.2; {shlex.join(command(*argv.split()))} 2>err; echo $? >code; }} | true; cat code err"
    lines = shell_script(gone, cwd=tmp_path).stdout.splitlines()
    if "nope" in argv:  # its error is on stderr, which is read
        assert lines == ["1", "error: unknown model 'nope'; did you mean 'one'?"]
    else:
        assert lines == ["141"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_streams_that_are_full_are_told_where_that_is_possible():
    devices = shlex.join(command("models"))
    full = shell_script(f"{devices} >/dev/full")
    assert full.returncode == 2 and "No space left" in full.stderr and len(full.stderr.splitlines()) == 1
    both = shell_script(f"{devices} >/dev/full 2>/dev/full")
    assert (both.returncode, both.stderr) == (2, "")
    # What is refused is refused with its code, whether the sentence arrives or not.
    assert shell_script(f"{devices} nope 2>/dev/full").returncode == 1


# ---------------------------------------------------------------------------------------------- signals


def commands(folder: Path) -> dict[str, list[object]]:
    """Each command that writes, with seconds of work."""
    probes = folder / "probes"
    probes.mkdir()
    for k in range(4):
        write_exr(probes / f"p{k}.exr", np.random.default_rng(k).random((64, 128, 3), dtype=np.float32))
    (folder / "job.toml").write_text(
        '[[bake]]\nenvironments = ["probes/*"]\noutput = "out"\nsize = 256\nquality = "reference"\n'
    )
    out = folder / "out"
    return {
        "bake": ["bake", probes / "p0.exr", "-o", out, "--size", "256", "--quality", "reference"],
        "lut": ["lut", "albedo", "-o", out / "t.npy", "--size", "2048", "--precision", "64", "--ndf", "charlie"],
        "batch": ["batch", folder / "job.toml"],
        "workers": ["batch", folder / "job.toml", "--workers", "2"],
        "bench": ["bench", "--runs", "1000"],
    }


SLOW = pytest.mark.long


@posix
@pytest.mark.parametrize(
    "name, signal_name, to_group",
    [
        ("bake", "SIGTERM", False),
        pytest.param("bake", "SIGHUP", True, marks=SLOW),
        pytest.param("lut", "SIGHUP", False, marks=SLOW),
        pytest.param("batch", "SIGTERM", True, marks=SLOW),
        ("workers", "SIGHUP", True),
        pytest.param("workers", "SIGTERM", False, marks=SLOW),
        pytest.param("bench", "SIGTERM", False, marks=SLOW),
    ],
)
def test_a_signal_cleans_up_as_ctrl_c_does(tmp_path, device, name, signal_name, to_group):
    """As a terminal that closes sends SIGHUP to all processes of its group, workers too."""
    out = tmp_path / "out"
    out.mkdir()
    run = subprocess.Popen(
        command(*commands(tmp_path)[name]),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    begin = time.monotonic()
    if name == "bench":
        time.sleep(2)
    else:
        while not any(entry.name.endswith(".lock") for entry in out.iterdir()):
            assert run.poll() is None and time.monotonic() - begin < 60
            time.sleep(0.01)
    assert run.poll() is None, "it was over before it could be ended"
    number = signal.Signals[signal_name]
    (os.killpg if to_group else os.kill)(run.pid, number)
    complaint = run.communicate(timeout=60)[1]
    assert run.returncode == 128 + number, complaint
    assert complaint.splitlines()[-1] == f"ended by {signal_name}: nothing half-written was left"
    assert not out.exists() or tree(out) == {}


@posix
@pytest.mark.long
@pytest.mark.parametrize("signal_name", ["SIGTERM", "SIGINT"])
def test_a_kernel_without_end_keeps_no_signal_waiting(tmp_path, device, signal_name):
    """Python's handlers wait for the driver's call to return, which a model that loops for hours does not let it do."""
    (tmp_path / "loop.clh").write_text(
        "real ndf_loop_D(real cos_m, real alpha) {\n  real s = alpha;\n"
        "  for (int j = 0; j < 100000; j++) for (int i = 0; i < 1000000; i++) s = sqrt(s + cos_m);\n  return s;\n}\n"
    )
    made = ["lut", "normalization", "-o", tmp_path / "t.npy", "--ndf", tmp_path / "loop.clh", "--size", "4"]
    run = subprocess.Popen(command(*made), stderr=subprocess.PIPE, text=True, start_new_session=True)
    time.sleep(10)  # imports and the compiler are done by then; a signal before would end it too
    assert run.poll() is None
    number = signal.Signals[signal_name]
    run.send_signal(number)
    try:
        complaint = run.communicate(timeout=30)[1]  # 5 s of patience, on a busy machine
    finally:
        run.kill()
    assert run.returncode == 128 + number, complaint
    assert complaint.splitlines()[-1].startswith(f"ended by {signal_name} while the device computed")


@posix
def test_a_signal_that_the_caller_ignores_is_ignored():
    """`nohup` ignores SIGHUP for what it starts."""
    code = (
        "import os, signal\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "from whitefurnace.cli.ending import Ended, listening\n"
        "with listening():\n    os.kill(os.getpid(), signal.SIGHUP)\n"
        "    try: os.kill(os.getpid(), signal.SIGTERM); ended = 0\n    except Ended as error: ended = error.exit_code\n"
        "assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL\nos._exit(ended)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 143


@posix
def test_a_signal_waits_for_the_end_of_an_import(tmp_path):
    """An extension module that is interrupted while it starts reports another error, or aborts the process."""
    (tmp_path / "late.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\nwhole = True\n")
    code = (
        "import os, time\nfrom whitefurnace.cli.ending import Ended, listening\ndone = None\n"
        "try:\n    with listening():\n        import late\n        done = late.whole\n        time.sleep(30)\n"
        "except Ended as error: os._exit(error.exit_code if done else 1)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, timeout=60).returncode == 143


# ---------------------------------------------------------------------------------------------- errors


def fails(monkeypatch, error: BaseException) -> None:
    """Let `devices` raise an error."""
    import whitefurnace.opencl.device as device

    def broken():
        secret = "hunter2 of a local variable"
        raise error if secret else None

    monkeypatch.setattr(device, "find_devices", broken)


def test_an_unexpected_error_is_one_sentence_and_a_report(shell, monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setenv("SOME_TOKEN", "xyzzy-of-the-environment")
    fails(monkeypatch, ZeroDivisionError("division by zero\nin two lines"))
    assert shell("devices") == 70
    sentence = shell.sentence()
    assert "ZeroDivisionError: division by zero in two lines" in sentence
    path = Path(re.search(r"report (\S+)$", sentence)[1])
    assert path.parent == tmp_path and (os.name != "posix" or path.stat().st_mode & 0o077 == 0)
    text = path.read_text()
    for words in ("whitefurnace 0.1", "Python 3", "pyopencl", "whitefurnace devices", "Traceback", "in broken"):
        assert words in text
    assert "xyzzy" not in text and "hunter2 of" not in text.replace('secret = "hunter2 of a local variable"', "")
    assert shell("devices", "--json") == 70
    assert shell.rows()[-1]["exit_code"] == 70


def test_a_report_holds_no_password_and_not_the_user_s_folder(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("HOME" if os.name == "posix" else "USERPROFILE", str(tmp_path / "me"))
    path = ending.report(
        ValueError("x"), ["batch", "--scheduler", "tls://me:secret@host:1", str(tmp_path / "me" / "a.toml")]
    )
    text = path.read_text()
    assert "secret" not in text and "tls://...@host:1" in text
    assert str(tmp_path / "me") not in text and "~/a.toml" in text


def test_a_report_that_cannot_be_written_is_no_second_error(shell, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    fails(monkeypatch, KeyError("name"))
    assert shell("devices") == 70 and "--debug" in shell.sentence()


@pytest.mark.parametrize("argv", [["--debug", "models", "nope"], ["models", "nope", "--debug"]])
def test_debug_shows_the_traceback(capsys, argv):
    with pytest.raises(SystemExit) as done:
        main(argv)
    lines = capsys.readouterr().err.splitlines()
    assert done.value.code == 1 and lines[0].startswith("Traceback") and lines[-1].startswith("error: ")


@pytest.mark.parametrize(
    "error, code, words",
    [
        (MemoryError(), 2, "not enough memory"),
        (RecursionError("maximum recursion depth exceeded"), 3, "nested too deeply"),
        (OSError(errno.ENOSPC, "No space left on device", "/x/y"), 2, "use /x/y: No space left on device; free"),
        (OSError(errno.EFBIG, "File too large", "/x/y"), 2, "ulimit -f"),
        (OSError(errno.EMFILE, "Too many open files", "/x/y"), 2, "ulimit -n"),
        (OSError(errno.EIO, "Input/output error"), 2, "write the results: Input/output error"),
        (UsageError("no such thing as this one"), 1, "no such thing"),
        (DeviceError("no device works in this place"), 4, "no device"),
    ],
)
def test_errors_that_can_happen_anywhere_have_their_sentences(shell, monkeypatch, error, code, words):
    fails(monkeypatch, error)
    assert shell("devices") == code and words in shell.sentence()
    assert code_of(error) == code or isinstance(error, RecursionError)


def test_the_page_on_errors_has_every_exit_code():
    page = (Path(__file__).resolve().parents[2] / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    told = {int(code) for row in re.findall(r"^\| ([\d, ]+) \|", page, re.M) for code in row.split(",")}
    kinds = {kind.exit_code for kind in WhitefurnaceError.__subclasses__()}
    signals = {128 + number for number in (*ending.SIGNALS, signal.SIGINT)}
    assert told == {0, *kinds, *signals, ending.EXIT_NO_READER}
