"""Training from a script: where runs lie, what they resume, and what fine-tuning begins with."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from jaxnew.actions import SplitMismatch
from jaxnew.embedding import SPLIT_FILE, TABLE_FILE
from jaxnew.ppo import TrainState
from jaxnew.representation.table import engineered_table
from jaxnew.run import Run
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.config import ConfigError
from jaxnew.storage.metrics import read
from jaxnew.storage.run_directory import ConfigMismatch
from jaxnew.task.domain import Domain
from jaxnew.task.places import UsageError
from jaxnew.training import _warm_start, finetune, train
from tests import toy_device, toy_task

pytestmark = pytest.mark.integration

LADDER = toy_device.TASK
TABLE = engineered_table(Domain.of(LADDER).universe, "gt3")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def trained(runs: Path) -> Run:
    return train(LADDER, TABLE, budget="smoke", runs=runs)


def test_a_run_lies_where_it_says_and_explains_itself(trained: Run, runs: Path) -> None:
    assert trained.path == runs / "toy-ladder" / "ours-gt3-default-smoke-31"
    assert (trained.checkpoint, trained.was_interrupted) == ("best", False)
    config = trained.config
    assert (config.task, config.method, config.representation) == (
        "tests.toy_device:TASK",
        "ours",
        "gt3",
    )
    assert (config.split, config.split_seed, config.seed) == ("default", 0, 31)
    assert (config.table_hash, config.split_hash) == (TABLE.hash, trained.split.hash)
    assert (trained.path / TABLE_FILE).exists()
    assert (trained.path / SPLIT_FILE).exists()
    reports = [report for report in read(trained.path) if "loss/total" in report]
    assert [report["step"] for report in reports] == [1, 2, 3, 4]
    evaluated = [
        report["step"] for report in read(trained.path) if "validation/is_success" in report
    ]
    assert evaluated == [2, 4]


def test_a_finished_run_is_found_complete(
    trained: Run, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By name of task and table, too; the parameters are those of before."""
    again = train("tests.toy_device:TASK", "gt3", budget="smoke", runs=str(runs))
    assert "already complete" in capsys.readouterr().out
    assert again.path == trained.path
    for one, other in zip(*map(jax.tree.leaves, (again.policy, trained.policy)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_settings_make_another_run(trained: Run, runs: Path, tmp_path: Path) -> None:
    """In the same place it is refused by the name of the field; elsewhere it is made."""
    changes: dict[str, Any] = {"num_updates": 1, "environment.time_limit": 2}
    for same in (changes, ["num_updates=1", "environment.time_limit=2"]):
        with pytest.raises(ConfigMismatch, match=r"environment\.time_limit: 4 recorded, 2 asked"):
            train(LADDER, TABLE, budget="smoke", runs=runs, set=same)
    other = train(LADDER, TABLE, budget="smoke", workdir=tmp_path / "x", set=changes, seed=7)
    assert (other.path, other.step, other.config.seed) == (tmp_path / "x", 1, 7)
    assert other.trainer.rollout.max_episode_steps == 2
    over = train(LADDER, TABLE, budget="smoke", workdir=tmp_path / "x", set=changes, overwrite=True)
    assert over.config.seed == 31


def test_a_run_that_was_stopped_goes_on(trained: Run, tmp_path: Path) -> None:
    """From where it stood after two updates: the same parameters, bit for bit."""
    path = tmp_path / "stopped"
    shutil.copytree(trained.path, path)
    checkpointer = Checkpointer(path / "checkpoints")
    assert checkpointer.steps("latest") == [2, 4]
    checkpointer.discard_after(2)
    resumed = train(LADDER, TABLE, budget="smoke", workdir=path)
    assert resumed.path == path
    latest, expected = (Run.load(run.path, "latest") for run in (resumed, trained))
    assert latest.step == expected.step == 4
    for one, other in zip(*map(jax.tree.leaves, (latest.policy, expected.policy)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_split_of_another_seed_is_another_run(runs: Path) -> None:
    set_one = {"num_updates": 1}
    run = train(LADDER, "gt3", budget="smoke", runs=runs, split_seed=1, set=set_one)
    assert run.path.name == "ours-gt3-default-split1-smoke-31"
    assert run.config.split_seed == 1
    assert run.split.hash == Domain.of(LADDER, split_seed=1).split.hash != run.config.table_hash
    assert Run.load(run.path).split.hash == run.split.hash


def test_host_environments_train_alike(tmp_path: Path) -> None:
    with train(toy_task.TASK, "gt4", budget="smoke", runs=tmp_path, num_workers=1) as run:
        assert run.path == tmp_path / "toy" / "ours-gt4-default-smoke-31"
        assert {"time/rollout_s", "time/learn_s"} <= set(read(run.path)[0])


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        ({"method": "our"}, UsageError, "Unknown method 'our'"),
        ({"budget": "paper"}, UsageError, "Stage two has no budget 'paper'"),
        ({"split": "full"}, UsageError, "has no split 'full'"),
        ({"seed": 2**32}, ConfigError, "seed=4294967296 must be an integer"),
        ({"split_seed": -1}, (ConfigError, ValueError), "split_seed=-1|non-negative"),
        ({"set": {"seed": 3}}, ConfigError, "seed cannot be set; give --seed"),
        ({"set": {"hyperparameters.discount": 2.0}}, ConfigError, "discount=2.0 must be in"),
        ({"set": {"sets.size": 30}}, ValueError, "Sets of 30 actions cannot be drawn from the tr"),
        ({"table": "gt12"}, UsageError, "Unknown representation 'gt12'"),
        ({"table": engineered_table(toy_task.universe(), "gt4")}, SplitMismatch, "universe"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(
    tmp_path: Path, arguments: dict[str, Any], error: Any, says: str
) -> None:
    given = {"table": TABLE, "budget": "smoke", **arguments}
    with pytest.raises(error, match=says):
        train(LADDER, given.pop("table"), runs=tmp_path, **given)
    assert not list(tmp_path.iterdir())


def test_fine_tuning_learns_test_actions_in_the_run(trained: Run) -> None:
    tuned = finetune(trained, budget="smoke", seed=5)
    assert tuned.path == trained.path / "finetune-warm-smoke-5"
    config = tuned.config
    assert (config.method, config.trained_on, config.start) == (
        "no-subsampling",
        "test",
        "ours, seed 31",
    )
    assert config.sets.is_fixed
    assert config.ppo.rollout.freezes_observation_statistics
    assert set(np.asarray(tuned.trainer.training.pool.ids)) == set(trained.split.test)
    assert tuned.checkpoint == "latest"
    for one, other in zip(
        *(jax.tree.leaves(run.policy.observation_statistics) for run in (tuned, trained)),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    # From another checkpoint it is another run.
    named = trained.path / "checkpoints" / "latest" / "000000000004"
    with pytest.raises(
        ConfigMismatch, match="'ours, seed 31, latest checkpoint of update 4' asked"
    ):
        finetune(named, budget="smoke", seed=5)
    scratch = finetune(trained.path, is_scratch=True, budget="smoke", seed=5)
    assert scratch.path == trained.path / "finetune-scratch-smoke-5"
    assert scratch.config.start == "fresh parameters"
    assert not scratch.config.ppo.rollout.freezes_observation_statistics
    with pytest.raises(UsageError, match="on test actions cannot be fine-tuned"):
        finetune(tuned, budget="smoke")


# What it begins with (docs/method.md, "Fine-tuning").

HEADS = ("alpha", "beta", "stop")


def state_of(value: float, policy: str, num_actions: int, statistics: str) -> TrainState:
    """A policy whose parameters all are `value`."""
    params: dict[str, Any] = {
        "policy": {policy: {"kernel": np.full((2, num_actions), value)}},
        "critic": {"value": np.full(2, value)},
        "auxiliary": {"heads": {name: {"kernel": np.full(2, value)} for name in HEADS}},
    }
    rollout: Any = SimpleNamespace(observation_statistics=statistics)
    nothing: Any = None
    return TrainState(params, nothing, rollout, nothing, nothing)


def started(policy: str) -> tuple[TrainState, TrainState, TrainState]:
    """What a policy begins with, and the trained and the fresh state that it is made of."""
    source, fresh = state_of(1.0, policy, 5, "trained"), state_of(0.0, policy, 3, "fresh")

    def restarted(state: TrainState, actions: str, statistics: str) -> TrainState:
        rollout: Any = SimpleNamespace(actions=actions, observation_statistics=statistics)
        return dataclasses.replace(state, rollout=rollout)

    trainer: Any = SimpleNamespace(
        learner=SimpleNamespace(restarted=restarted), training="test actions"
    )
    return _warm_start(fresh, run_of(source), trainer), source, fresh


def run_of(state: TrainState) -> Run:
    """A run that ended so."""
    run: Any = SimpleNamespace(policy=state.policy)
    return run


def test_a_utility_policy_keeps_everything() -> None:
    state, source, _ = started("mean")
    assert state.params == source.params
    assert state.rollout == SimpleNamespace(
        actions="test actions", observation_statistics="trained"
    )


def test_a_discrete_policy_gets_new_categorical_heads() -> None:
    state, source, fresh = started("logits")
    assert state.params["policy"] == fresh.params["policy"]
    assert state.params["critic"] == source.params["critic"]
    heads = state.params["auxiliary"]["heads"]
    assert heads["stop"] is fresh.params["auxiliary"]["heads"]["stop"]
    for name in ("alpha", "beta"):
        assert heads[name] == source.params["auxiliary"]["heads"][name]
    assert source.params["auxiliary"]["heads"]["stop"]["kernel"][0] == 1.0, "it is left alone"


def test_a_discrete_policy_may_have_no_stop_bit() -> None:
    source, fresh = state_of(1.0, "logits", 5, ""), state_of(0.0, "logits", 3, "")
    for state in (source, fresh):
        del state.params["auxiliary"]
    trainer: Any = SimpleNamespace(
        learner=SimpleNamespace(restarted=lambda state, *_: state), training=None
    )
    params = _warm_start(fresh, run_of(source), trainer).params
    assert params == {"policy": fresh.params["policy"], "critic": source.params["critic"]}
