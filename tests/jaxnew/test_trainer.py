"""The parts of a run: what it is trained and watched with, and what evaluations draw."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from jaxnew.evaluation import measure
from jaxnew.ppo import Learner
from jaxnew.representation.table import engineered_table
from jaxnew.rollout.contract import Policy
from jaxnew.rollout.device import DeviceRollout
from jaxnew.rollout.host import HostRollout
from jaxnew.run import Run
from jaxnew.sampling import Actions
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.settings import with_set
from jaxnew.task.task import Task
from jaxnew.trainer import SPLITS_WATCHED, Trainer, rollout_of
from jaxnew.training import train_config
from tests import toy_device, toy_task


def trainer_of(task: Task, split: str, vectors: str, budget: str = "smoke") -> Trainer:
    domain = Domain.of(task, split)
    table = engineered_table(domain.universe, vectors)
    config = train_config(domain, "ours", vectors, table, task.stage_two[budget], 1)
    return Trainer.of(config, task, domain.split, table)


def ladder_of(changes: dict[str, Any] | None = None, method: str = "ours") -> Trainer:
    """A trainer of the toy inside jit."""
    domain = Domain.of(toy_device.TASK)
    table = engineered_table(domain.universe, "gt3")
    budget = toy_device.TASK.stage_two["smoke"]
    config = train_config(domain, method, "gt3", table, budget, 1)
    return Trainer.of(with_set(config, changes or {}), toy_device.TASK, domain.split, table)


def sets_of(actions: Actions, count: int = 64) -> np.ndarray:
    """int32[count, m]."""
    return np.asarray(actions.draw(jax.random.split(jax.random.key(0), count)).ids)


@pytest.fixture(scope="module")
def full() -> Trainer:
    return trainer_of(load_task("create-push"), "full", "gt32", "paper")


@pytest.mark.contract
def test_validation_sets_of_the_full_split_show_half_of_the_classes(full: Trainer) -> None:
    domain = Domain.of(full.task, "full")
    labels, split = domain.universe.class_labels, domain.split
    actions = full.watched["validation"]
    assert actions.set_size == 50
    sets = sets_of(actions)
    assert (sets[:, :1] == split.always_available).all()
    assert np.isin(sets[:, 1:], split.validation).all()
    assert all(len(set(row)) == 50 for row in sets.tolist())
    classes = [set(labels[row[1:]].tolist()) for row in sets]
    # Fan, two Triangles, Belt, Funnel, Hinge: three of six. A set of 49 without one of its three
    # classes is unlikely: the smallest is a ninth or more of its half.
    assert max(map(len, classes)) == 3
    assert set.union(*classes) == set(labels[split.validation].tolist())
    assert len(set.union(*classes)) == 6
    assert len({frozenset(found) for found in classes if len(found) == 3}) > 10  # Of 20 halves.


@pytest.mark.contract
def test_everything_else_is_drawn_from_all_classes(full: Trainer) -> None:
    domain = Domain.of(full.task, "full")
    labels = domain.universe.class_labels
    assert full.watched["train"].pool.group_starts is None
    np.testing.assert_array_equal(full.watched["train"].pool.ids, full.training.pool.ids)
    for name in ("validation", "test"):
        sets = sets_of(full.actions(name))
        assert np.isin(sets[:, 1:], domain.split.ids(name)).all()
        classes = [len(set(labels[row[1:]].tolist())) for row in sets]
        assert min(classes) >= 5
        assert np.mean(classes) > 5.9
    default = trainer_of(full.task, "default", "gt32")
    assert default.watched["validation"].pool.group_starts is None
    # Of CREATE's Full split alone.
    assert not load_task("create-push-analysis").validation_groups
    assert not load_task("shape_stacking").validation_groups


@dataclass
class Spy:
    """A rollout that remembers what it was to draw from."""

    method: Any = None
    drawn: list[Actions] = field(default_factory=list)

    def measure(
        self, policy: Any, actions: Actions, key: Any, num_episodes: int, is_greedy: bool
    ) -> dict[str, np.ndarray]:
        self.drawn.append(actions)
        return {"is_success": np.ones(num_episodes, np.float32)}


@pytest.mark.contract
def test_training_watches_groups_and_evaluation_does_not(full: Trainer) -> None:
    state: Any = SimpleNamespace(policy=None)
    spy: Any = Spy()
    trainer = replace(full, learner=Learner(spy, full.config.ppo))
    assert trainer.evaluate(state) == {"train/is_success": 1.0, "validation/is_success": 1.0}
    assert [actions.pool.group_starts is None for actions in spy.drawn] == [True, False]
    spy.drawn.clear()
    run = Run(Path("nowhere"), trainer, Policy(None), 0, "best")
    run.evaluate(["validation", "test"], episodes=2, record=False)
    assert [actions.pool.group_starts for actions in spy.drawn] == [None, None]


@pytest.mark.contract
def test_any_task_can_have_groups_for_any_split() -> None:
    def parity(universe: Any) -> np.ndarray:
        return np.asarray(universe.class_labels)  # Even ids and odd ones.

    task = replace(toy_task.TASK, validation_groups={"default": parity})
    budget = toy_task.TASK.stage_two["smoke"].vary(loop__evaluation_set_size=3)
    trainer = trainer_of(replace(task, stage_two={"smoke": budget}), "default", "gt4")
    sets = sets_of(trainer.watched["validation"])
    parities = sets[:, 1:] % 2
    assert (parities == parities[:, :1]).all()
    assert set(parities[:, 0].tolist()) == {0, 1}


@pytest.mark.unit
def test_groups_too_small_for_the_sets_are_refused() -> None:
    each = replace(toy_task.TASK, validation_groups={"default": lambda u: np.arange(u.num_actions)})
    budgets = {"smoke": each.stage_two["smoke"].vary(loop__evaluation_set_size=6)}
    with pytest.raises(ValueError, match="every half of the 6 groups of the validation actions"):
        trainer_of(replace(each, stage_two=budgets), "default", "gt4")


@pytest.mark.unit
@pytest.mark.parametrize(
    ("name", "budget", "on_cpu", "on_gpu"),
    [
        ("shape_stacking", "accelerator", 16, 1024),
        ("shape_stacking", "laptop", 16, 32),
        ("grid_world", "laptop", 128, 128),
    ],
)
def test_accelerators_evaluate_as_wide_as_they_train(
    monkeypatch: pytest.MonkeyPatch, name: str, budget: str, on_cpu: int, on_gpu: int
) -> None:
    task, nobody_asks_it = load_task(name), object()
    config = task.stage_two[budget].ppo
    environment = task.environment_of()
    task = replace(task, make_environment=lambda **fields: environment)
    for backend, width in (("cpu", on_cpu), ("gpu", on_gpu)):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        method: Any = nobody_asks_it
        rollout = rollout_of(task, method, config, 0)
        assert isinstance(rollout, DeviceRollout)
        assert rollout.width == width


@pytest.mark.unit
def test_settings_of_a_run_reach_its_environment() -> None:
    """Whatever the task that was handed over says."""
    given: dict[str, Any] = {"time_limit": 2, "reward_scale": 3.0, "is_inverted": True}
    trainer = ladder_of({f"environment.{name}": value for name, value in given.items()})
    assert vars(trainer.task.environment) == given
    assert trainer.rollout.max_episode_steps == 2
    assert ladder_of().rollout.max_episode_steps == 4
    assert isinstance(trainer.rollout, DeviceRollout)
    published = toy_device.Ladder(2, 1.0, False).default_params.reward
    np.testing.assert_allclose(trainer.rollout.env_params.reward, -3 * published, rtol=1e-6)


@pytest.mark.unit
def test_sets_of_training_and_of_evaluations() -> None:
    sets = {"sets.size": 3, "sets.padded_size": 5, "sets.training_size": 2}
    trainer = ladder_of({**sets, "loop.evaluation_set_size": 4})
    split, table = trainer.split, np.asarray(trainer.table.vectors)
    np.testing.assert_array_equal(trainer.training.table, table)
    sizes = {
        name: (actions.set_size, actions.padded_size, actions.num_actions, actions.is_fixed)
        for name, actions in {
            "training": trainer.training,
            **trainer.watched,
            "of a part": trainer.actions("test"),
            "of a size": trainer.actions("test", set_size=4),
            "of ids": trainer.actions("mine", np.array([0, 5, 7])),
        }.items()
    }
    assert sizes == {
        "training": (2, 5, 12, False),
        "train": (4, 4, 12, False),
        "validation": (4, 4, 6, False),
        "of a part": (3, 5, 6, False),
        "of a size": (4, 4, 6, False),
        "of ids": (3, 5, 3, False),
    }
    parts = {"train": trainer.training, "validation": trainer.watched["validation"]}
    for part, actions in {**parts, "test": trainer.actions("test")}.items():
        assert set(sets_of(actions).ravel().tolist()) == set(split.ids(part).tolist())
    other = trainer.actions("test", vectors=trainer.training.table + 1)
    np.testing.assert_array_equal(other.table, table + 1)
    wrongs: tuple[dict[str, Any], ...] = (
        {"set_size": 7},
        {"ids": np.array([], np.int32)},
        {"ids": np.array([3, 3])},
    )
    for wrong in wrongs:
        with pytest.raises(ValueError, match=r"Sets of 7 |mine actions: (must|action 3 stands)"):
            trainer.actions("mine", **{"ids": split.test, **wrong})
    with pytest.raises(ValueError, match=r"Sets of 30 .* the train actions"):
        ladder_of({"sets.size": 30})


@pytest.mark.unit
def test_sets_of_a_method_with_one_fixed_set() -> None:
    """All train actions in training; evaluated on them, all in an order that is drawn anew."""
    trainer = ladder_of(method="nearest-neighbour")
    assert (trainer.training.is_fixed, trainer.training.set_size) == (True, 12)
    for actions in (trainer.watched["train"], trainer.actions("train")):
        assert (actions.is_fixed, actions.set_size) == (False, 12)
        sets = sets_of(actions)
        assert (np.sort(sets, axis=1) == trainer.split.train).all()
        assert len({tuple(row) for row in sets.tolist()}) > 60
    for part in ("validation", "test"):
        assert trainer.actions(part).set_size == 4
    assert trainer.actions("train", set_size=4).set_size == 4


@pytest.mark.unit
def test_sets_of_clusters_are_for_training_alone() -> None:
    trainer = ladder_of({"num_clusters": 4, "sets.size": 3})
    assert trainer.training.pool.group_starts is not None
    assert trainer.training.pool.group_starts.tolist() == [0, 3, 6, 9, 12]
    for actions in (*trainer.watched.values(), trainer.actions("train")):
        assert actions.pool.group_starts is None


@pytest.mark.unit
def test_a_trainer_trains_and_is_watched() -> None:
    with ladder_of() as trainer:
        state = trainer.init()
        after, metrics = trainer.chunk(state, 2)
        assert (int(state.step), int(after.step)) == (0, 2)
        assert metrics["nonfinite/loss"] == 0
        found = trainer.evaluate(after)
        assert trainer.selection_metric == "validation/is_success"
        names = (*toy_device.Ladder.episode_metrics, "num_steps")
        assert set(found) == {f"{part}/{name}" for part in SPLITS_WATCHED for name in names}
        episodes = measure(trainer.rollout, after.policy, trainer.watched["validation"], 8)
        assert found["validation/num_steps"] == episodes["num_steps"].mean()
        assert trainer.evaluate(after) == found


@pytest.mark.unit
def test_a_trainer_ends_its_processes() -> None:
    with trainer_of(toy_task.TASK, "default", "gt4") as trainer:
        trainer.init()
        assert isinstance(trainer.rollout, HostRollout)
        pool: Any = trainer.rollout.environments.pool
        assert not pool.is_closed
    assert pool.is_closed
