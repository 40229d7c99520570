"""A policy on disk: loaded from its directory alone, evaluated and played."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.actions import ActionIdentity, SplitMismatch, mixture_ids
from jaxnew.evaluation import measure, summarize
from jaxnew.representation.table import RepresentationTable, engineered_table
from jaxnew.run import Evaluation, Run, locate
from jaxnew.storage.checkpoint import CheckpointError
from jaxnew.storage.config import ConfigError
from jaxnew.storage.run_directory import RunDirectory, RunDirectoryError
from jaxnew.task.domain import Domain
from jaxnew.task.places import UsageError
from jaxnew.training import train
from tests import toy_device, toy_task

pytestmark = pytest.mark.integration

LADDER = toy_device.TASK
UNIVERSE = Domain.of(LADDER).universe
TABLE = engineered_table(UNIVERSE, "gt3")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The best checkpoint, as it was loaded."""
    path = tmp_path_factory.mktemp("runs") / "mine"
    train(LADDER, TABLE, budget="smoke", workdir=path)
    return Run.load(path)


def results(run: Run) -> dict[str, Any]:
    """What is in the run's directory, by file."""
    return RunDirectory.load(run.path).evaluations()


def test_a_run_is_loaded_from_its_directory_or_a_checkpoint(run: Run) -> None:
    assert (run.checkpoint, run.was_interrupted) == ("best", False)
    assert run.step in (2, 4)
    assert (run.task.name, run.config.method) == ("toy-ladder", "ours")
    assert run.trainer.table.hash == TABLE.hash
    latest = Run.load(str(run.path), "latest")
    assert (latest.checkpoint, latest.step) == ("latest", 4)
    folder = next((run.path / "checkpoints" / "latest").iterdir())
    assert Run.load(folder).checkpoint == "latest"
    assert Run.load(folder, "best").checkpoint == "best"
    assert Run.load(run.path / "evaluation").checkpoint == "best"
    assert locate(run.path / "checkpoints" / "latest") == (run.path, "latest")
    assert Run.load(run.path, task=replace(LADDER, name="other")).task.name == "other"


def test_what_is_no_run_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is neither a run directory nor in one"):
        Run.load(tmp_path)
    with pytest.raises(ConfigError, match=r"only pool\.FIELD=value can be set"):
        Run.load(run.path, set={"num_updates": 3})
    copy = tmp_path / "copy"
    shutil.copytree(run.path, copy)
    assert Run.load(copy).step == run.step, "it needs nothing but its directory"
    shutil.rmtree(copy / "checkpoints" / "best")
    with pytest.raises(CheckpointError, match="no best checkpoint"):
        Run.load(copy)
    other = replace(TABLE, universe_hash="0" * 16)
    other.save(copy / "table.npz")
    with pytest.raises(SplitMismatch, match="universe"):
        Run.load(copy, "latest")
    (copy / "table.npz").write_bytes(b"")
    with pytest.raises(ValueError, match="damaged"):
        Run.load(copy, "latest")
    RunDirectory.open_or_create(tmp_path / "other", {"members": []}).close()
    with pytest.raises(ConfigError, match="no run of a policy"):
        Run.load(tmp_path / "other")
    (copy / "provenance.json").unlink()
    with pytest.raises(RunDirectoryError, match=r"has no provenance\.json"):
        Run.load(copy)


def test_numbers_are_those_of_the_rollout_and_are_kept(run: Run) -> None:
    found = run.evaluate(["train", "test"], episodes=12)
    assert list(found.rows) == ["train", "test"]
    for name, row in found.to_dict().items():
        played = measure(run.trainer.rollout, run.policy, run.trainer.actions(name), 12)
        assert row["metrics"] == summarize(played)
        seconds = row.pop("seconds")
        assert seconds >= 0
        expected = {
            "num_episodes": 12,
            "num_actions": {"train": 12, "test": 6}[name],
            "set_size": 4,
            "policy": "sampled",
            "evaluation_seed": 2020,
        }
        assert {key: row[key] for key in row if key != "metrics"} == expected
        recorded = results(run)[f"{name}-best-sampled-m4"]
        assert recorded.pop("seconds") == seconds
        assert recorded == {"checkpoint": "best", "step": run.step, "actions": name, **row}
    text = str(found)
    assert text.splitlines()[0] == (
        f"{run.path}, best checkpoint (update {run.step}); mean [95 % interval over episodes]"
    )
    success = found.rows["test"]["metrics"]["is_success"]
    assert f"is_success {success['mean']:.4f} [{success['low']:.4f}, {success['high']:.4f}]" in text


def test_whoever_asks_otherwise_gets_a_file_of_its_own(run: Run) -> None:
    run.evaluate(episodes=4)
    before = set(results(run))
    asked: tuple[dict[str, Any], ...] = (
        {"greedy": True},
        {"set_size": 3},
        {"grows_from": 1, "growth": 2},
        {"parts": "validation"},
        {"ids": {"mine": np.array([1, 2, 3, 4])}},
        {"unseen_ratio": 0.5},
    )
    for arguments in asked:
        run.evaluate(episodes=4, **arguments)
    assert set(results(run)) - before == {
        "test-best-greedy-m4",
        "test-best-sampled-m3",
        "test-best-sampled-m4-from1-by2",
        "validation-best-sampled-m4",
        "mine-best-sampled-m4",
        "unseen-0.5-best-sampled-m4",
    }
    grown = results(run)["test-best-sampled-m4-from1-by2"]
    assert (grown["first_size"], grown["growth"]) == (1, 2)
    mixed = results(run)["unseen-0.5-best-sampled-m4"]
    assert mixed["num_actions"] == len(mixture_ids(run.split.train, run.split.test, 0.5))
    here = results(run)
    run.evaluate("all", episodes=4, record=False)
    assert results(run) == here
    Run.load(run.path, "latest").evaluate(episodes=4)
    assert set(results(run)) - set(here) == {"test-latest-sampled-m4"}


def test_new_actions_are_drawn_and_represented_by_their_table(run: Run) -> None:
    ids = np.array([3, 8, 20, 21], np.int32)
    vectors = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    identity = ActionIdentity.of(UNIVERSE, ids)
    table = RepresentationTable(
        vectors, ids, source="new", encoder_hash=TABLE.hash, identity=identity
    )
    found = run.evaluate(table=table, episodes=6)
    assert list(found.rows) == [f"table-{table.hash[:8]}"]
    assert f"table-{table.hash[:8]}-best-sampled-m4" in results(run)
    named = run.evaluate(table=table, table_name="new", episodes=6, greedy=True)
    assert list(named.rows) == ["table-new"]
    whole = np.array(run.trainer.training.table)
    whole[ids] = vectors
    actions = run.trainer.actions("new", ids, vectors=jnp.asarray(whole))
    assert named.rows["table-new"]["metrics"] == summarize(
        measure(run.trainer.rollout, run.policy, actions, 6, is_greedy=True)
    )
    # One that is hardly trained is almost uniform, but what it likes most is another action.
    own = run.evaluate(ids={"old": ids}, episodes=6, greedy=True).rows["old"]["metrics"]
    assert own != named.rows["table-new"]["metrics"]
    outside = RepresentationTable(vectors, np.array([3, 8, 20, 24], np.int32))
    with pytest.raises(SplitMismatch, match=r"has ids up to 24; Ladder-v0 has 0\.\.23"):
        run.evaluate(table=outside, allow=["other-encoder", "unknown-actions"])


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        ({"parts": "test", "unseen_ratio": 0.4}, UsageError, "Give one of parts of the split, ids"),
        ({"ids": {"a": np.arange(5)}, "table": TABLE}, UsageError, "Give one of parts"),
        ({"parts": "tests"}, ValueError, "tests"),
        ({"set_size": 7}, ValueError, "Sets of 7 .* from the test actions"),
        ({"grows_from": 5}, ValueError, r"first_size=5 must be in 0\.\.4"),
        ({"episodes": 0}, ValueError, "num_episodes=0 must be at least 1"),
        ({"seed": 2**32}, ConfigError, "seed of the evaluation=4294967296 must be an integer"),
        ({"seed": True}, ConfigError, "seed of the evaluation=True must be an integer"),
        ({"unseen_ratio": 1.5}, ValueError, "1.5"),
    ],
)
def test_what_cannot_be_evaluated(
    run: Run, arguments: dict[str, Any], error: type[Exception], says: str
) -> None:
    before = results(run)
    with pytest.raises(error, match=says):
        run.evaluate(**{"episodes": 4, **arguments})
    assert results(run) == before


def test_episodes_are_those_that_are_evaluated(run: Run) -> None:
    (third,) = run.play("test", first=3)
    more = run.play("test", first=0, count=5)
    assert third.action_ids == more[3].action_ids
    assert len(third.states) == len(third.actions) + 1
    numbers = measure(run.trainer.rollout, run.policy, run.trainer.actions("test"), 5)
    for episode in more:
        for name, values in numbers.items():
            assert episode.metrics[name] == pytest.approx(values[episode.number], rel=1e-5)
    assert run.play("test", count=1, seed=1)[0].action_ids != more[0].action_ids
    assert set(more[0].available_ids.tolist()) <= set(run.split.test.tolist())


def test_another_policy_is_recorded_under_its_name(run: Run) -> None:
    other = run.acting_as(Run.load(run.path, "latest").policy, "mean of two")
    assert (other.checkpoint, other.path) == ("mean of two", run.path)
    assert isinstance(other.evaluate(episodes=4, record=False), Evaluation)
    path = run.acting_as(run.policy, "again").record("test", {"policy": "sampled", "set_size": 4})
    assert path == run.path / "evaluation" / "test-again-sampled-m4.json"


def test_a_run_on_the_host_ends_its_processes(tmp_path: Path) -> None:
    train(toy_task.TASK, "gt4", budget="smoke", workdir=tmp_path, set={"num_updates": 1})
    with Run.load(tmp_path, task=toy_task.TASK, num_workers=1) as run:
        found = run.evaluate(["train", "test"], episodes=3)
        (episode,) = run.play("test", first=1)
        test = run.evaluate("test", episodes=2, record=False).rows["test"]
        assert test["num_actions"] == 6
        assert episode.seed is not None
        pool: Any = run.trainer.rollout.environments.pool  # type: ignore[attr-defined]
    assert pool.is_closed
    assert list(found.rows) == ["train", "test"]
