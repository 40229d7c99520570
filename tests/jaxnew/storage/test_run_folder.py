"""A run's folder is whole after a kill at any rename or deletion, and nothing comes back."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from jaxnew.storage import run_directory as run_directory_lib
from jaxnew.storage.files import StorageError, take_lock
from jaxnew.storage.run_directory import ConfigMismatch, RunDirectory, RunDirectoryError
from tests.kills import is_killed

OLD, NEW = {"seed": 1}, {"seed": 2}
DISK = [(os, name) for name in ("rename", "replace", "unlink", "rmdir", "mkdir", "chmod")]
DISK.append((shutil, "rmtree"))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a look at git for every session."""
    monkeypatch.setattr(run_directory_lib, "describe_session", dict)


def make(path: Path, config: dict[str, Any] = OLD) -> None:
    with RunDirectory.open_or_create(path, config):
        if config == OLD:
            (path / "metrics.jsonl").write_text('{"step": 1}\n')


def open_new(path: Path, overwrite: bool) -> None:
    RunDirectory.open_or_create(path, NEW, overwrite).close()


def kills(parent: Path, has_old: bool, overwrite: bool) -> Iterator[Path]:
    """The directory after each possible kill."""
    for call in itertools.count():
        path = parent / str(call) / "run"
        path.parent.mkdir()
        if has_old:
            make(path)
        work = partial(open_new, path, overwrite)
        if not is_killed(work, call, DISK):
            assert call > 8  # Every instant was tried.
            return
        yield path


def opened(path: Path) -> str:
    """Which run is there when it is opened for writing."""
    for config, name in ((OLD, "old"), (NEW, "new")):
        try:
            with RunDirectory.open_or_create(path, config) as run:
                is_resumed = run.is_resumed
        except ConfigMismatch:
            continue
        assert os.listdir(path.parent) == ["run"]
        assert not [name for name in os.listdir(path) if name.startswith(".") and name != ".lock"]
        assert (path / "metrics.jsonl").exists() == (name == "old" and is_resumed)
        return name if is_resumed else "made now"
    pytest.fail("neither run is there")


@pytest.mark.unit
def test_an_overwrite_that_is_killed_leaves_one_whole_run(tmp_path: Path) -> None:
    found = [opened(path) for path in kills(tmp_path, has_old=True, overwrite=True)]
    assert found == sorted(found, reverse=True)  # First the old run, then the new one.
    assert {*found} == {"old", "new"}


@pytest.mark.unit
def test_a_run_that_was_replaced_does_not_come_back(tmp_path: Path) -> None:
    """The directory is deleted by its user after the kill."""
    for path in kills(tmp_path, has_old=True, overwrite=True):
        if path.exists():
            shutil.rmtree(path)
            assert opened(path) == "made now"
        else:  # Between the two renames: whole, and nobody deleted it.
            assert opened(path) == "old"


@pytest.mark.unit
def test_making_a_run_that_is_killed_leaves_it_or_nothing(tmp_path: Path) -> None:
    found = []
    for path in kills(tmp_path, has_old=False, overwrite=False):
        with RunDirectory.open_or_create(path, NEW) as run:
            found.append(run.is_resumed)
        assert os.listdir(path.parent) == ["run"]
    assert {*found} == {False, True}


@pytest.mark.unit
def test_leftovers_are_removed_but_not_those_of_the_living(tmp_path: Path) -> None:
    make(tmp_path / "run")
    names = (".run.new-abcdefgh", ".run.replaced-abcdefgh", ".run.replaced", ".run.new-12345678")
    others = (".run.newer-abcdefgh", ".running.new-abcdefgh", ".run.new-abc")
    for name in (*names, *others):
        shutil.copytree(tmp_path / "run", tmp_path / name)
    lock = take_lock(tmp_path / names[3] / ".lock")
    make(tmp_path / "run")
    assert sorted(os.listdir(tmp_path)) == sorted([*others, names[3], "run"])
    os.close(lock)
    make(tmp_path / "run")
    assert sorted(os.listdir(tmp_path)) == sorted([*others, "run"])


@pytest.mark.unit
@pytest.mark.parametrize("name", ["evaluation", "figures", "checkpoints", "tensorboard", "members"])
def test_links_out_of_a_run_are_not_written_through(tmp_path: Path, name: str) -> None:
    make(tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / name, ignore_errors=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("years of work")
    (tmp_path / "run" / name).symlink_to(tmp_path / "other")
    with pytest.raises(StorageError, match=rf"run/{name} is a link to .*other, which is not"):
        RunDirectory.open_or_create(tmp_path / "run", OLD)
    reader = RunDirectory.load(tmp_path / "run")
    writes = {
        "evaluation": lambda: reader.record_evaluation("thesis", {}),
        "figures": lambda: reader.figures,
    }
    if name in writes:
        with pytest.raises(StorageError, match=f"{name} is a link"):
            writes[name]()
    RunDirectory.open_or_create(tmp_path / "run", OLD, overwrite=True).close()
    assert os.listdir(tmp_path / "other") == ["thesis.tex"]


@pytest.mark.unit
def test_a_name_that_checkpoints_cannot_have_is_refused_before_anything_is_made(
    tmp_path: Path,
) -> None:
    path = tmp_path / os.fsdecode(b"caf\xe9")
    with pytest.raises(StorageError, match=r"caf\\xe9' cannot be used: .* UTF-8") as caught:
        RunDirectory.open_or_create(path, OLD)
    str(caught.value).encode()  # It can be printed.
    assert os.listdir(tmp_path) == []
    path.mkdir()
    with pytest.raises(StorageError, match="UTF-8"):
        RunDirectory.load(path)


@pytest.mark.unit
def test_what_cannot_be_made_is_said(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    cases = {
        tmp_path / "plain" / "run": "is a file; choose another path|File exists|Not a directory",
        tmp_path / ("x" * 300): "Choose a shorter name",
        Path("/proc/nope"): "/proc.* cannot be written",
    }
    for path, says in cases.items():
        with pytest.raises(StorageError, match=says):
            RunDirectory.open_or_create(path, OLD)
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    with pytest.raises(RunDirectoryError, match="must not be a mount point or a link"):
        RunDirectory.open_or_create(tmp_path / "link", OLD)
    assert sorted(os.listdir(tmp_path)) == ["empty", "link", "plain"]


@pytest.mark.unit
def test_an_evaluation_that_was_altered_is_named(tmp_path: Path) -> None:
    make(tmp_path / "run")
    run = RunDirectory.load(tmp_path / "run")
    content = {"mean": 0.1, "n": [1, 2], "name": "ä"}
    file = run.record_evaluation("test", content)
    (tmp_path / "run" / "evaluation" / "old.json").write_text('{"mean": 1}')  # As 0.2.0 wrote it.
    assert run.evaluations() == {"old": {"mean": 1}, "test": content}
    recorded = json.loads(file.read_text())
    assert recorded.keys() == {*content, "hash"}
    for altered in ({**recorded, "mean": 0.2}, {**recorded, "hash": "0" * 16}):
        file.write_text(json.dumps(altered))
        with pytest.raises(RunDirectoryError, match=r"test\.json was edited or damaged: its hash"):
            run.evaluations()
    with pytest.raises(FileNotFoundError):
        run.evaluation("absent")


@pytest.mark.unit
def test_whether_it_was_saved_is_remembered(tmp_path: Path) -> None:
    with RunDirectory.open_or_create(tmp_path / "run", OLD) as run:
        assert not run.has_been_saved
        run.note_saved()
        run.note_saved()
        assert run.has_been_saved
    make(tmp_path / "run")
    assert RunDirectory.load(tmp_path / "run").has_been_saved
