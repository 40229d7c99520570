"""What the system refuses is told apart from damage; files are whole or absent."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxnew.actions import ActionSplit
from jaxnew.observations import ObservationsError, Recordings
from jaxnew.representation.table import RepresentationTable
from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.files import (
    StorageError,
    access,
    check_new,
    read_json,
    remove_temporaries,
    take_lock,
    write_bytes_atomically,
    write_json_atomically,
)
from jaxnew.storage.run_directory import RunDirectory
from tests.kills import is_killed

SPLIT = ActionSplit(np.arange(2), np.array([2]), np.array([3]), "universe")
READERS = {
    "split.json": ActionSplit.load,
    "table.npz": RepresentationTable.load,
    "recordings.npz": Recordings.load,
    "metrics.jsonl": metrics.read,
}


@contextlib.contextmanager
def as_nobody() -> Iterator[None]:
    """Root, who may do anything, is somebody else for a while."""
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("number", "says"),
    [
        (errno.ENOSPC, r"No space left on device\. [\d,.]+ MB are free in .*run the same command"),
        (errno.EDQUOT, r"Disk quota exceeded\. .*raise the quota"),
        (errno.EFBIG, r"File too large\. .*limit on the size of files"),
        (errno.EACCES, r"Permission denied\. It belongs to user \d+, this process to \d+\. Get"),
        (errno.EROFS, "Read-only file system. Its disk can only be read"),
        (errno.EIO, "Input/output error. Nothing is known to be damaged: look at the disk"),
        (errno.ENAMETOOLONG, "File name too long. Choose a shorter name"),
    ],
)
def test_what_the_system_refuses_is_said_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, says: str
) -> None:
    write_json_atomically(tmp_path / "a.json", {"a": 1})

    def refuse(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", refuse)
        with pytest.raises(StorageError, match=rf"a\.json cannot be written: {says}"):
            write_json_atomically(tmp_path / "a.json", {"a": 2})
    assert read_json(tmp_path / "a.json", ValueError) == {"a": 1}
    assert os.listdir(tmp_path) == ["a.json"]


@pytest.mark.unit
@pytest.mark.parametrize("name", READERS)
def test_no_reader_takes_what_the_system_refuses_for_damage(tmp_path: Path, name: str) -> None:
    read, file = READERS[name], tmp_path / name
    file.symlink_to(file)
    with pytest.raises(StorageError, match=f"{name} cannot be read: Too many levels of symbolic"):
        read(file)
    file.unlink()
    (tmp_path / "plain").write_text("")
    with pytest.raises(StorageError, match="cannot be read: Not a directory"):
        read(tmp_path / "plain" / name)
    with pytest.raises(StorageError, match="cannot be read: File name too long"):
        read(tmp_path / ("x" * 300))
    if name != "metrics.jsonl":  # An absent one holds no reports; a folder is that of a run.
        file.mkdir()
        with pytest.raises(StorageError, match=r"Is a directory\. There is a folder where a file"):
            read(file)
        with pytest.raises(ValueError, match=rf"absent-{name} is missing"):
            read(tmp_path / f"absent-{name}")


@pytest.mark.unit
def test_without_permission_nothing_is_said_to_be_damaged() -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        with RunDirectory.open_or_create(Path(folder) / "run", {"seed": 1}) as run:
            SPLIT.save(run.path / "split.json")
            Checkpointer(run.checkpoints).save("best", 1, {"a": np.zeros(3)})
        for file in ("config.json", "split.json", "checkpoints/best", ".lock"):
            os.chmod(run.path / file, 0)
        with as_nobody():
            for read in (
                lambda: RunDirectory.load(run.path),
                lambda: RunDirectory.open_or_create(run.path, {"seed": 1}),
                lambda: RunDirectory.open_or_create(run.path, {"seed": 1}, overwrite=True),
                lambda: ActionSplit.load(run.path / "split.json"),
                lambda: Checkpointer(run.checkpoints).metadata("best"),
            ):
                with pytest.raises(StorageError, match=r"Permission denied\. It belongs") as caught:
                    read()
                text = str(caught.value).replace("nothing is known to be damaged", "")
                assert not {"damaged", "overwrite", "delete"} & set(text.split())
        os.chmod(run.path / "checkpoints" / "best", 0o755)
        for file in (run.path / "checkpoints" / "best" / "000000000001").rglob("*"):
            os.chmod(file, 0o755 if file.is_dir() else 0)
        with as_nobody(), pytest.raises(StorageError, match="Permission denied"):
            Checkpointer(run.checkpoints).restore("best", {"a": np.zeros(3)})


@pytest.mark.unit
@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "is missing: it says which actions are seen"),
        ("", r"is damaged \(Expecting value"),
        ('{"train": [1', r"is damaged \(Expecting"),
        ("[]", "is damaged .it must hold a dict, got a list"),
        ("\xff", "is damaged .*decode"),
        ('{"hash": "x"}', "is damaged .it lacks 'train'"),
        ({"train": None}, "is damaged .*None"),
        ({"train": [2, 3]}, "is damaged .Action 2 is in both train and validation"),
        ({"test": [2**40]}, "is damaged"),
    ],
)
def test_a_damaged_split_is_named(tmp_path: Path, content: Any, says: str) -> None:
    file = tmp_path / "split.json"
    if isinstance(content, dict):
        SPLIT.save(file)
        file.write_text(json.dumps({**json.loads(file.read_text()), **content}))
    elif content is not None:
        file.write_bytes(content.encode("latin-1"))
    with pytest.raises(ValueError, match=rf"split\.json {says}.*Restore it from a copy"):
        ActionSplit.load(file)


@pytest.mark.unit
def test_a_file_is_whole_wherever_its_writing_is_killed(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    functions = [(os, "replace"), (os, "unlink"), (os, "fsync"), (os, "chmod")]
    for call in range(12):
        write_json_atomically(file, {"a": 1})
        was_killed = is_killed(lambda: write_json_atomically(file, {"a": 2}), call, functions)
        assert read_json(file, ValueError) in ({"a": 1}, {"a": 2})
        remove_temporaries(tmp_path)
        assert os.listdir(tmp_path) == ["a.json"]
        if not was_killed:
            assert call > 3  # Every instant was tried.
            return
    pytest.fail("12 calls were not enough")


@pytest.mark.unit
def test_links_are_replaced_and_not_followed(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_text("precious")
    (tmp_path / "a.json").symlink_to(other)
    write_json_atomically(tmp_path / "a.json", {})
    (tmp_path / ".lock").symlink_to(other)
    with pytest.raises(StorageError, match="It is a link, which is not followed"):
        take_lock(tmp_path / ".lock")
    assert other.read_text() == "precious"
    assert not (tmp_path / "a.json").is_symlink()


@pytest.mark.unit
def test_an_output_is_checked_before_the_work(tmp_path: Path) -> None:
    check_new(tmp_path / "new" / "a.npz", overwrite=False)
    assert os.listdir(tmp_path / "new") == []
    (tmp_path / "a.npz").write_text("precious")
    check_new(tmp_path / "a.npz", overwrite=True)
    with pytest.raises(StorageError, match=r"a\.npz exists already.*--overwrite"):
        check_new(tmp_path / "a.npz", overwrite=False)
    with pytest.raises(StorageError, match="Is a directory"):
        check_new(tmp_path, overwrite=True)
    with pytest.raises(StorageError, match=r"a\.npz.* cannot be written: (Not a dir|File exists)"):
        check_new(tmp_path / "a.npz" / "b.npz", overwrite=False)
    assert (tmp_path / "a.npz").read_text() == "precious"


@pytest.mark.unit
def test_a_temporary_name_is_not_told(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"absent/a cannot be written: No such file.* make it"):
        write_bytes_atomically(tmp_path / "absent" / "a", b"")
    with pytest.raises(FileNotFoundError), access(tmp_path):
        (tmp_path / "absent").read_text()


@pytest.mark.unit
def test_arrays_that_cannot_be_read_on_are_not_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.savez(tmp_path / "new.npz", ids=np.arange(2), recordings=np.zeros((2, 1, 3)))

    def broken(*_: Any, **__: Any) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(np, "load", broken)
        with pytest.raises(StorageError, match="look at the disk"):
            Recordings.load(tmp_path / "new.npz")
    (tmp_path / "new.npz").write_bytes((tmp_path / "new.npz").read_bytes()[:50])
    with pytest.raises(ObservationsError, match=r"is damaged .*Restore it from a copy"):
        Recordings.load(tmp_path / "new.npz")
