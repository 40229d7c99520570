"""Runs of version 0.1.0 load, evaluate, go on, and are told from others; those of an environment
that plays otherwise since do not.

`run_of_0_1_0.tar.gz` is `experiments.train --representation=gt5 --budget=smoke` of that version
with its checkpoint of update 2, its metrics up to update 4, and an evaluation of 64 test episodes.
"""

from __future__ import annotations

import shutil
import tarfile
from pathlib import Path
from typing import Any

import pytest

from jaxnew.run import Run
from jaxnew.storage import metrics
from jaxnew.storage.config import ConfigError
from jaxnew.storage.run_directory import ConfigMismatch, RunDirectory
from jaxnew.task.settings import identity
from jaxnew.training import train
from tests.experiments.commands import read_json, run

pytestmark = pytest.mark.integration

ARCHIVE = Path(__file__).with_name("run_of_0_1_0.tar.gz")


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """The run's directory, whose latest checkpoint is that of update 2."""
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    checkpoints = tmp_path / "run" / "checkpoints"
    shutil.copytree(checkpoints / "best", checkpoints / "latest")
    return tmp_path / "run"


def test_it_is_loaded_and_evaluated_as_it_was(old: Path) -> None:
    before = read_json(old / "evaluation" / "test-best-sampled-m50.json")
    with Run.load(old) as found:
        row = found.evaluate("test", episodes=64, record=False).rows["test"]
    assert (found.step, found.config.sets.size, found.config.ppo.rollout.num_envs) == (2, 50, 8)
    assert row["metrics"].keys() == before["metrics"].keys()
    for name, was in before["metrics"].items():
        value = row["metrics"][name]
        assert value["interval"] == was["interval"], name
        for part in ("mean", "low", "high"):
            # Wilson intervals come from SciPy now, and other processors round otherwise.
            assert value[part] == pytest.approx(was[part], rel=1e-4, abs=1e-9), name


def told(line: dict[str, Any]) -> set[str]:
    """Names of what a report tells of learning; counts of what is not finite have other names."""
    return {name for name in line if not name.startswith(("time/", "nonfinite/"))}


def test_it_goes_on(old: Path) -> None:
    before = metrics.read(old)
    flags = ("--representation=gt5", "--budget=smoke", f"--workdir={old}")
    output = run("train", *flags)
    assert "at step 2 of 4" in output
    after = metrics.read(old)
    assert [line["step"] for line in after] == [line["step"] for line in before] == [2, 2, 4, 4]
    for was, found in zip(before, after, strict=True):
        assert told(was) == told(found)
        for name in told(was):
            # Small probability ratios are differences of rounding errors.
            assert found[name] == pytest.approx(was[name], rel=1e-2, abs=1e-6), name


def test_another_run_is_not_taken_for_it(old: Path) -> None:
    output = run(
        "train",
        "--representation=gt5",
        "--budget=smoke",
        "--set=sets.size=40",
        f"--workdir={old}",
        fails=True,
    )
    assert "sets.size: 50 recorded, 40 asked for" in output
    assert "environment" not in output
    assert identity(Run.load(old).config) != RunDirectory.load(old).config, "it is left as it was"


def test_a_run_in_create_before_its_errata_is_refused(tmp_path: Path) -> None:
    """Neither evaluated nor resumed; its config is one that was recorded then."""
    file = Path(__file__).parents[1] / "jaxnew" / "task" / "recorded_configs.json"
    recorded = next(c for c in read_json(file) if c["task"] == "create-push-no-subgoals")
    path = tmp_path / "old"
    RunDirectory.open_or_create(path, recorded).close()
    with pytest.raises(ConfigError, match=r"version 0 of the environment .* train again"):
        Run.load(path)
    with pytest.raises(ConfigMismatch) as error:
        train(
            recorded["task"],
            recorded["representation"],
            budget="smoke",
            set={"sets.padded_size": 60},
            workdir=path,
            runs=tmp_path,
        )
    assert error.value.differences == [("environment_version", 0, 1)]
    assert "Choose another --workdir to keep that run, or --overwrite" in str(error.value)
