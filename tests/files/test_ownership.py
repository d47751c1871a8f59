"""Who may overwrite an output, and what the next run makes of a killed one: the same for bakes and for tables."""

from __future__ import annotations

import hashlib
import os

import pytest

from whitefurnace.errors import FileError
from whitefurnace.files import FileOutput, FolderOutput, Transaction, acquire, lock_path, write_manifest


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


class Form:
    """An output of one form in a folder, with files of a version."""

    def __init__(self, kind, folder):
        self.kind, self.folder = kind, folder
        self.names = ["a.npy"] if kind is FileOutput else ["raw/a.npz", "exr/a_0.exr", "exr/a_1.exr"]
        self.output = kind(folder / ("a.npy.json" if kind is FileOutput else "a.json"))
        self.files = [folder / name for name in self.names]

    def bytes_of(self, version):
        return {name: f"{name} {version}".encode() for name in self.names}

    def manifest(self, version):
        data = {name: {"sha256": digest(text)} for name, text in self.bytes_of(version).items()}
        plain = {"whitefurnace": "0", "name": self.output.name, "version": version}
        return {**plain, **data["a.npy"]} if self.kind is FileOutput else {**plain, "files": data, "kept": {}}

    def write(self, version, renames=None):
        """Writes a version, as if killed after some renames, with its lock left behind."""
        lock = self.output.lock()
        lock.note([*self.files, self.output.path])
        transaction = Transaction()
        for file, text in zip(self.files, self.bytes_of(version).values(), strict=True):
            file.parent.mkdir(parents=True, exist_ok=True)
            transaction.stage(file, lambda path, text=text: path.write_bytes(text))
        write_manifest(self.output.path, self.manifest(version), into=transaction)
        targets = [*self.files, self.output.path]
        for target in targets if renames is None else targets[:renames]:
            os.replace(Transaction.staging(target), target)
        if renames is None:
            lock.release()
        else:
            os.close(lock._handle)

    def version(self):
        """The version of the manifest, whose files are whole."""
        there = self.output.manifest()
        assert there is None or self.output.is_whole(there)
        return there and there["version"]

    def left(self):
        return [path.name for path in self.folder.rglob(".*") if path.is_file()]


@pytest.fixture(params=[FileOutput, FolderOutput])
def form(request, tmp_path):
    return Form(request.param, tmp_path)


@pytest.mark.parametrize("renames", range(4))
@pytest.mark.parametrize("before", [None, 1])
def test_a_death_between_renames_is_completed(form, before, renames):
    if renames > len(form.files):
        pytest.skip("a table has two renames")
    if before:
        form.write(before)
    form.write(2, renames)
    form.output.check(form.files, form.output.manifest(), False)  # nothing there is foreign
    form.output.tidy()
    assert form.version() == 2 and form.left() == []


def test_a_death_while_staging_leaves_what_was_there(form):
    form.write(1)
    form.write(2, 0)
    Transaction.staging(form.output.path).unlink()
    form.output.tidy()
    assert form.version() == 1 and form.left() == []


def test_a_death_is_not_completed_over_a_foreign_file(form):
    form.write(2, 0)
    form.files[0].write_bytes(b"mine")
    form.output.tidy()
    assert form.output.manifest() is None and form.files[0].read_bytes() == b"mine"
    with pytest.raises(FileError, match=f"was not written by {form.output.writer}; move it away or give --force"):
        form.output.check(form.files, None, False)
    form.output.check(form.files, None, True)


def test_files_that_were_changed_are_foreign(form):
    form.write(1)
    there = form.output.manifest()
    form.output.check(form.files, there, False)
    form.files[0].write_bytes(b"edited")
    assert not form.output.is_whole(there)
    with pytest.raises(FileError, match="was not written by"):
        form.output.check(form.files, there, False)


def test_what_another_run_is_at_is_left_alone(form):
    form.write(2, 0)
    lock = acquire(lock_path(form.output.path))
    form.output.tidy()
    assert form.output.manifest() is None and form.output.staged() is not None
    form.output.settle(lock)
    lock.release()
    assert form.version() == 2


@pytest.mark.parametrize("change", [{"name": "b"}, {"files": None}, {"files": {"../x": {}}}, {"kept": {"/x": {}}}])
def test_a_manifest_that_could_prove_nothing_is_none(tmp_path, change):
    output = FolderOutput(tmp_path / "a.json")
    good = {"whitefurnace": "0", "name": "a", "files": {}}
    write_manifest(output.path, good)
    assert output.manifest() == good
    write_manifest(output.path, {**good, **change})
    assert output.manifest() is None


def test_files_of_other_engines_stay_ours(tmp_path):
    form = Form(FolderOutput, tmp_path)
    form.write(1)
    stale, kept = form.output.superseded(form.output.manifest(), ["exr/a_0.exr"])
    assert stale == [tmp_path / "exr" / "a_1.exr"]
    assert kept == {"raw/a.npz": {"sha256": digest(b"raw/a.npz 1")}}


def test_a_table_never_replaces_a_folder(tmp_path):
    (tmp_path / "a.npy").mkdir()
    with pytest.raises(FileError, match="it is a folder"):
        FileOutput(tmp_path / "a.npy.json").check([tmp_path / "a.npy"], None, True)
