"""What a run does that has lost checkpoints, reports or room on its disk."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer, CheckpointError
from jaxnew.storage.files import StorageError
from tests.jaxnew.test_loop import digest, init, outcome, reports, train


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("undisturbed")
    train(path)
    return outcome(path)


@pytest.mark.unit
@pytest.mark.parametrize("lost", ["checkpoints/latest", "checkpoints"])
@pytest.mark.parametrize("is_old", [False, True])
def test_a_run_that_lost_its_latest_checkpoint_is_left_as_it_is(
    tmp_path: Path, lost: str, is_old: bool
) -> None:
    train(tmp_path, total_steps=10)
    shutil.rmtree(tmp_path / lost)
    if is_old:  # Runs of 0.2.0 do not say whether they were ever saved.
        file = tmp_path / "provenance.json"
        record = json.loads(file.read_text())
        assert record.pop("has_been_saved")
        file.write_text(json.dumps(record))
    before = reports(tmp_path), Checkpointer(tmp_path / "checkpoints").steps("best")
    with pytest.raises(CheckpointError, match=r"latest is lost: .*Restore .* from a copy"):
        train(tmp_path, total_steps=10)
    assert (reports(tmp_path), Checkpointer(tmp_path / "checkpoints").steps("best")) == before
    assert before[0]


def spoil(path: Path, kind: str, steps: list[int]) -> None:
    for step in steps:
        (path / f"checkpoints/{kind}/{step:012d}/record/metadata").write_text("{")


@pytest.mark.unit
def test_a_finished_run_without_a_best_gets_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = train(tmp_path)
    assert (result.best_step, result.best_metric) == (35, 1.0)
    spoil(tmp_path, "best", [25, 30, 35])
    before, checkpointer = reports(tmp_path), Checkpointer(tmp_path / "checkpoints")
    with pytest.raises(
        CheckpointError, match=r"No readable.*run the command that trained it again"
    ):
        checkpointer.restore("best", init())
    with pytest.warns(UserWarning, match="of step 35 in .* is lost; now it is that of step None"):
        result = train(tmp_path)
    # The state at the end is evaluated as it was, and is the best that there is.
    assert (result.best_step, result.best_metric, checkpointer.steps("best")) == (47, 1.0, [47])
    assert digest(checkpointer.restore("best", init())[0]) == digest(result.state)
    assert reports(tmp_path) == before
    again = train(tmp_path, evaluate=lambda _: pytest.fail("evaluated again"))
    assert (again.best_step, again.best_metric) == (47, 1.0)
    kept = [name for name in os.listdir(tmp_path / "checkpoints/best") if "damaged" in name]
    assert len(kept) == 3


@pytest.mark.unit
def test_an_unfinished_run_goes_on_from_the_best_that_is_left(tmp_path: Path) -> None:
    train(tmp_path, total_steps=20)
    spoil(tmp_path, "best", [20])
    with pytest.warns(UserWarning, match="of step 20 in .* is lost; now it is that of step 15"):
        result = train(tmp_path, total_steps=25)
    assert (result.best_step, result.best_metric) == (25, 0.8)
    shutil.rmtree(tmp_path / "checkpoints" / "best")
    with pytest.warns(UserWarning, match="of step 25 in .* is lost; now it is that of step None"):
        result = train(tmp_path)
    assert (result.best_step, result.best_metric) == (35, 1.0)


@pytest.mark.unit
def test_lost_reports_are_noticed_before_anything_is_changed(
    tmp_path: Path, undisturbed: dict[str, Any]
) -> None:
    train(tmp_path, total_steps=20)
    file = tmp_path / "metrics.jsonl"
    whole = file.read_bytes()
    for content in (
        None,
        whole[: len(whole) // 2],
        whole.replace(b'"other": 1.0', b'"other": 2.0'),
    ):
        file.unlink()
        if content is not None:
            file.write_bytes(content)
        with pytest.raises(metrics.MetricsError, match=r"metrics\.jsonl.*Restore the file from a"):
            train(tmp_path)
        assert (file.read_bytes() if file.exists() else None) == content
        file.write_bytes(whole)
    train(tmp_path)
    assert outcome(tmp_path) == undisturbed


@pytest.mark.unit
def test_an_empty_file_does_without_the_reports_so_far(tmp_path: Path) -> None:
    train(tmp_path, total_steps=20)
    (tmp_path / "metrics.jsonl").write_bytes(b"")
    with pytest.warns(UserWarning, match="its first 8 reports were given up"):
        train(tmp_path)
    assert [r["step"] for r in reports(tmp_path) if "loss" in r] == [25, 30, 35, 40, 45, 47]
    train(tmp_path)


@pytest.mark.unit
@pytest.mark.parametrize("kind", ["latest", "best", "metrics"])
def test_a_full_disk_ends_a_run_that_the_same_command_goes_on_with(
    tmp_path: Path, undisturbed: dict[str, Any], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    real, full = os.fsync, OSError(errno.ENOSPC, "No space left on device")

    def save(self: Checkpointer, which: Any, step: int, *rest: Any) -> Any:
        if which == kind and step >= 20:
            raise StorageError.of(self.directory / which, "written", full)
        return saved(self, which, step, *rest)

    def sync(descriptor: int) -> None:
        name = os.readlink(f"/proc/self/fd/{descriptor}")
        if kind == "metrics" and name.endswith("metrics.jsonl"):
            raise full
        real(descriptor)

    saved = Checkpointer.save
    with monkeypatch.context() as patch:
        patch.setattr(Checkpointer, "save", save)
        patch.setattr(os, "fsync", sync)
        with pytest.raises(StorageError, match=r"cannot be written: No space left.*same command"):
            train(tmp_path)
    train(tmp_path)
    assert outcome(tmp_path) == undisturbed
