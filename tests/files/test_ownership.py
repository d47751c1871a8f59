"""Who may overwrite an output, and what the next run makes of a killed one: the same for bakes and for tables."""

from __future__ import annotations

import hashlib
import json
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


# --- manifests and locks that somebody planted -----------------------------------------------------------


@pytest.mark.parametrize(
    "name, own",
    [
        ("day.json", True),
        ("day.probe", True),
        ("raw/day.npz", True),
        ("exr/day_specular_0.exr", True),
        ("notes.txt", False),
        ("night.json", False),
        ("raw/night.npz", False),
        ("raw/day2.npz", False),
        ("raw/deep/day.npz", False),
        ("raw/../day.npz", False),
        ("../raw/day.npz", False),
        ("./day.npz", False),
        ("raw/day", False),
        ("my/dayibl.ktx", True),  # of an engine whose files the bake names
        ("raw/day_1.npz", False),  # there is an output day_1
        ("raw/day_2.npz", True),
    ],
)
def test_an_output_owns_its_own_names_alone(tmp_path, name, own):
    write_manifest(tmp_path / "day_1.json", {"whitefurnace": "0"})
    assert FolderOutput(tmp_path / "day.json", [tmp_path / "my" / "dayibl.ktx"]).owns(name) is own


def test_a_table_owns_itself_and_its_manifest(tmp_path):
    output = FileOutput(tmp_path / "a.npy.json")
    assert [name for name in ("a.npy", "a.npy.json", "b.npy", "a.npy.json.json", "") if output.owns(name)] == [
        "a.npy",
        "a.npy.json",
    ]


def test_a_planted_lock_removes_nothing_but_its_own(form, tmp_path):
    others = [tmp_path / ".notes.tmp", tmp_path / "raw" / ".b.npz.tmp", tmp_path / ".other.json.tmp"]
    (tmp_path / "raw").mkdir(exist_ok=True)
    own = [Transaction.staging(form.files[0]), Transaction.staging(form.output.path)]
    for path in (*others, *own):
        path.parent.mkdir(exist_ok=True)
        path.write_text("x")
    names = ["notes", "raw/b.npz", "other.json", *form.names, form.output.path.name]
    lock_path(form.output.path).write_text(json.dumps({"whitefurnace": names}))
    form.output.tidy()
    assert all(path.exists() for path in others) and not any(path.exists() for path in own)
    for text in ('{"whitefurnace": "notes"}', '{"whitefurnace": {"notes": 1}}', '{"whitefurnace": [1, null, ["a"]]}'):
        lock_path(form.output.path).write_text(text)
        form.output.tidy()
    assert all(path.exists() for path in others)


def test_a_planted_manifest_replaces_no_file_of_others(tmp_path):
    mine, theirs = tmp_path / "raw" / "thesis.npz", tmp_path / "raw" / "night.npz"
    mine.parent.mkdir()
    for path in (mine, theirs):
        path.write_text("mine")
    entries = {f"raw/{path.name}": {"sha256": digest(b"mine")} for path in (mine, theirs)}
    output = FolderOutput(tmp_path / "day.json")
    for form in ({"files": entries, "kept": {}}, {"files": {}, "kept": entries}):
        write_manifest(output.path, {"whitefurnace": "0", "name": "day", "key": "k", **form})
        there = output.manifest()
        assert output.superseded(there, ["raw/day.npz"]) == ([], {})
        with pytest.raises(FileError, match="was not written by this bake"):
            output.check([mine], there, False)
        Transaction.staging(output.path).write_bytes(output.path.read_bytes())
        Transaction.staging(mine).write_text("evil")
        lock = output.lock()
        output.settle(lock)
        lock.release()
        assert mine.read_text() == theirs.read_text() == "mine"


def test_nothing_is_written_or_removed_through_a_linked_folder(tmp_path):
    form = Form(FolderOutput, tmp_path / "out")
    (tmp_path / "out").mkdir()
    form.write(1)
    elsewhere = tmp_path / "elsewhere"
    (tmp_path / "out" / "raw").rename(elsewhere)
    (tmp_path / "out" / "raw").symlink_to(elsewhere)
    staged = elsewhere / ".a.npz.tmp"
    staged.write_text("x")
    lock_path(form.output.path).write_text(json.dumps({"whitefurnace": ["raw/a.npz"]}))
    form.output.tidy()
    there = form.output.manifest()
    assert staged.exists() and not form.output.is_whole(there)
    for force in (False, True):
        with pytest.raises(FileError, match="raw is a link that leads out of"):
            form.output.check(form.files, there, force)
    assert form.output.superseded(there, ["raw/other.npz"])[0] == []


def test_a_manifest_with_a_value_of_another_type_is_not_ours(tmp_path):
    """Each value in turn; what a run does not read may be anything."""
    output = FolderOutput(tmp_path / "day.json")
    entry = {"sha256": "0" * 64, "bytes": 12}
    good = {
        "whitefurnace": "0",
        "name": "day",
        "key": "k",
        "recipe": {"only": [0, 1]},
        "source": {"notices": ["a"]},
        "levels": [{"size": 8, "error": 1e-4}],
        "irradiance": {"error": 1e-4},
        "files": {"raw/day.npz": entry},
        "kept": {"exr/day.exr": entry},
        "earlier": {"k": {}},
    }
    write_manifest(output.path, good)
    assert output.manifest() == good
    ours = 0
    for place in [(name,) for name in good] + [
        ("recipe", "only"),
        ("source", "notices"),
        ("levels", 0),
        ("levels", 0, "size"),
        ("files", "raw/day.npz", "sha256"),
        ("files", "raw/day.npz", "bytes"),
        ("kept", "exr/day.exr", "sha256"),
        ("earlier", "k"),
    ]:
        for odd in (None, "x", 5, {"name": "ggx"}, [[1]], True, 10**400):
            copy = json.loads(json.dumps(good))
            node = copy
            for key in place[:-1]:
                node = node[key]
            node[place[-1]] = odd
            output.path.write_text(json.dumps(copy))
            there = output.manifest()
            ours += there is not None
            if there is not None:  # then all that a run does with it works
                output.is_whole(there)
                output.check([], there, False)
                output.earlier(there, output.superseded(there, [])[1])
                assert sum(entry.get("bytes", 0) for entry in there["files"].values()) < 1 << 63
                assert all(isinstance(text, str) for text in there["source"].get("notices", ()))
                assert all({**row} == row for row in there["levels"])
    assert 0 < ours < 60  # some of 126 are of the right type, most are not


def test_the_manifest_with_an_object_for_a_digest_is_not_ours(tmp_path):
    """As a fuzzer made it: one of the files has {"name": "ggx"} in place of its sha256."""
    output = FolderOutput(tmp_path / "day.json")
    files = {"raw/day.npz": {"sha256": "0" * 64}, "exr/day.exr": {"sha256": {"name": "ggx"}}}
    write_manifest(output.path, {"whitefurnace": "0", "name": "day", "files": files})
    assert output.manifest() is None
