"""Run directories: never half-made, never mixed up, written by one process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from jaxnew.storage import run_directory as run_directory_lib
from jaxnew.storage.files import write_json_atomically
from jaxnew.storage.run_directory import (
    ConfigMismatch,
    RunDirectory,
    RunDirectoryError,
    RunDirectoryInUse,
)
from tests.kills import Killed

ROOT = Path(__file__).resolve().parents[3]
CONFIG = {"seed": 1, "ppo": {"rate": 0.5, "layers": (1, 2)}}


def make(path: Path, config: dict[str, Any] = CONFIG) -> None:
    RunDirectory.open_or_create(path, config).close()


@pytest.mark.unit
def test_a_new_run_explains_itself(tmp_path: Path) -> None:
    with RunDirectory.open_or_create(
        tmp_path / "a" / "run", CONFIG, extra_provenance={"split_hash": "abc"}
    ) as run:
        assert not run.is_resumed
        assert run.is_writable
        run.add_provenance(table_hash="def")
        assert run.checkpoints.is_dir()
        assert run.figures.is_dir()
        (session,) = run.provenance["sessions"]
    assert json.loads((run.path / "config.json").read_text()) == {
        "seed": 1,
        "ppo": {"rate": 0.5, "layers": [1, 2]},
    }
    assert session["split_hash"] == "abc"
    assert session["table_hash"] == "def"
    assert session["versions"]["python"].startswith("3.")
    assert {"jax", "jaxlib", "flax", "optax", "numpy"} <= set(session["versions"])
    assert session["command"][0]
    assert "random" in session
    assert session["started"] > "2020"
    assert not run.is_writable
    # Nothing else was left beside it.
    assert os.listdir(tmp_path / "a") == ["run"]


@pytest.mark.unit
def test_the_same_configuration_resumes_and_adds_a_session(tmp_path: Path) -> None:
    make(tmp_path)
    with RunDirectory.open_or_create(str(tmp_path), CONFIG) as run:
        assert run.is_resumed
        assert len(run.provenance["sessions"]) == 2


@pytest.mark.unit
def test_another_configuration_is_refused_by_field(tmp_path: Path) -> None:
    make(tmp_path)
    before = (tmp_path / "provenance.json").read_bytes()
    other = {"seed": 1, "ppo": {"rate": 0.25, "layers": [1, 2], "clip": 0.1}}
    with pytest.raises(ConfigMismatch) as caught:
        RunDirectory.open_or_create(tmp_path, other)
    message = str(caught.value)
    assert "ppo.rate: 0.5 recorded, 0.25 asked for" in message
    assert "ppo.clip: (absent) recorded, 0.1 asked for" in message
    assert "--workdir" in message
    assert "--overwrite" in message
    assert [path for path, _, _ in caught.value.differences] == ["ppo.rate", "ppo.clip"]
    with pytest.raises(ConfigMismatch) as caught:
        RunDirectory.open_or_create(tmp_path, {**CONFIG, "new": {str(i): i for i in range(999)}})
    assert len(str(caught.value)) < 400
    assert (tmp_path / "provenance.json").read_bytes() == before


@pytest.mark.unit
def test_overwrite_starts_anew(tmp_path: Path) -> None:
    make(tmp_path / "run")
    (tmp_path / "run" / "metrics.jsonl").write_text("{}\n")
    with RunDirectory.open_or_create(tmp_path / "run", {"seed": 2}, overwrite=True) as run:
        assert not run.is_resumed
        assert run.is_writable
    assert RunDirectory.load(tmp_path / "run").config == {"seed": 2}
    assert not (tmp_path / "run" / "metrics.jsonl").exists()
    assert os.listdir(tmp_path) == ["run"]


@pytest.mark.unit
def test_a_config_that_was_altered_is_no_other_run(tmp_path: Path) -> None:
    path = tmp_path / "run"
    RunDirectory.open_or_create(path, CONFIG).close()
    file = path / "config.json"
    written = file.read_text()
    file.write_text(written.replace("1", "2", 1))
    message = r"config\.json was edited or damaged: its hash is [0-9a-f]{16}, .* from a copy"
    with pytest.raises(RunDirectoryError, match=message):
        RunDirectory.load(path)
    with pytest.raises(RunDirectoryError, match=message):
        RunDirectory.open_or_create(path, CONFIG)
    file.write_text(written)
    assert RunDirectory.load(path).config["seed"] == 1


@pytest.mark.unit
@pytest.mark.parametrize("overwrite", [False, True])
def test_other_directories_are_left_alone(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(RunDirectoryError, match=r"it has no config\.json"):
        RunDirectory.open_or_create(tmp_path, CONFIG, overwrite=overwrite)
    # A project that has such files by chance.
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "provenance.json").write_text('{"kind": "art"}')
    with pytest.raises(RunDirectoryError, match="'art'"):
        RunDirectory.open_or_create(tmp_path, CONFIG, overwrite=overwrite)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"
    with pytest.raises(RunDirectoryError, match="is not a directory"):
        RunDirectory.open_or_create(tmp_path / "thesis.tex", CONFIG, overwrite=overwrite)


@pytest.mark.unit
def test_overwrite_does_not_follow_links(tmp_path: Path) -> None:
    make(tmp_path / "run")
    (tmp_path / "link").symlink_to(tmp_path / "run")
    with pytest.raises(RunDirectoryError, match="is a link"):
        RunDirectory.open_or_create(tmp_path / "link", {"seed": 2}, overwrite=True)
    assert RunDirectory.load(tmp_path / "run").config["seed"] == 1


@pytest.mark.unit
@pytest.mark.parametrize("content", ["", "{", "[1]", "\x00\xff"])
def test_a_damaged_configuration_is_named(tmp_path: Path, content: str) -> None:
    make(tmp_path)
    (tmp_path / "config.json").write_bytes(content.encode("latin-1"))
    for open_run in (RunDirectory.load, lambda p: RunDirectory.open_or_create(p, CONFIG)):
        with pytest.raises(RunDirectoryError, match=r"config\.json is damaged"):
            open_run(tmp_path)


@pytest.mark.unit
def test_load_needs_a_run(tmp_path: Path) -> None:
    with pytest.raises(RunDirectoryError, match="is not a directory"):
        RunDirectory.load(tmp_path / "absent")
    with pytest.raises(RunDirectoryError, match=r"has no config\.json"):
        RunDirectory.load(tmp_path)


@pytest.mark.unit
def test_load_reads_while_another_writes_and_changes_nothing(tmp_path: Path) -> None:
    with RunDirectory.open_or_create(tmp_path / "run", CONFIG):
        reader = RunDirectory.load(tmp_path / "run")
        assert reader.config["seed"] == 1
        assert not reader.is_writable
        with pytest.raises(RunDirectoryError, match="reading only"):
            reader.add_provenance(x=1)
        reader.record_evaluation("test", {"success": 0.5})
    assert reader.evaluations() == {"test": {"success": 0.5}}


@pytest.mark.unit
@pytest.mark.parametrize("name", ["../x", "a/b", "", ".hidden", "a b"])
def test_evaluation_names_are_plain(tmp_path: Path, name: str) -> None:
    make(tmp_path)
    with pytest.raises(ValueError, match="must consist of"):
        RunDirectory.load(tmp_path).record_evaluation(name, {})


@pytest.mark.unit
def test_json_is_written_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.json"
    write_json_atomically(file, {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json_atomically(file, {"a": float("nan")})
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(Killed()))
    with pytest.raises(Killed):
        write_json_atomically(file, {"a": 2})
    assert json.loads(file.read_text()) == {"a": 1}
    assert os.listdir(tmp_path) == ["a.json"]


@pytest.mark.unit
def test_the_lock_holds_within_a_process_and_is_released(tmp_path: Path) -> None:
    first = RunDirectory.open_or_create(tmp_path, CONFIG)
    for overwrite in (False, True):
        with pytest.raises(RunDirectoryInUse, match=f"process {os.getpid()}"):
            RunDirectory.open_or_create(tmp_path, CONFIG, overwrite=overwrite)
    first.close()
    first.close()
    second = RunDirectory.open_or_create(tmp_path, CONFIG)
    del second
    make(tmp_path)


HOLDER = """
import sys, time
from jaxnew.storage.run_directory import RunDirectory
from tests.kills import Killed
run = RunDirectory.open_or_create(sys.argv[1], {"seed": 1})
print("locked", flush=True)
time.sleep(60)
"""


@pytest.mark.integration
def test_a_second_process_is_refused_until_the_first_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "run"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(RunDirectoryInUse, match=f"process {holder.pid} on"):
            RunDirectory.open_or_create(path, {"seed": 1})
        with pytest.raises(RunDirectoryInUse):
            RunDirectory.open_or_create(path, {"seed": 2}, overwrite=True)
    finally:
        holder.kill()
        holder.wait()
    with RunDirectory.open_or_create(path, {"seed": 1}) as run:
        assert run.is_resumed


@pytest.mark.unit
def test_a_directory_replaced_while_waiting_is_not_taken(tmp_path: Path) -> None:
    make(tmp_path / "run")
    real = run_directory_lib.take_lock

    # The lock file is opened, then another process overwrites the run, then the lock is got.
    descriptor = os.open(tmp_path / "run" / ".lock", os.O_RDWR)
    RunDirectory.open_or_create(tmp_path / "run", CONFIG, overwrite=True).close()
    original_open = os.open
    try:
        os.open = lambda *_, **__: descriptor  # type: ignore[assignment]
        with pytest.raises(BlockingIOError):
            real(tmp_path / "run" / ".lock")
    finally:
        os.open = original_open
