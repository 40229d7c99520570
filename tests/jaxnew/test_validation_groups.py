"""Validation sets of CREATE's Full split while training: half of the classes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from jaxnew.ppo import Learner
from jaxnew.representation.table import engineered_table
from jaxnew.rollout.contract import Policy
from jaxnew.run import Run
from jaxnew.sampling import Actions
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.task import Task
from jaxnew.trainer import Trainer
from jaxnew.training import train_config
from tests import toy_task, video_task


def trainer_of(task: Task, split: str, vectors: str, budget: str = "smoke") -> Trainer:
    domain = Domain.of(task, split)
    table = engineered_table(domain.universe, vectors)
    config = train_config(domain, "ours", vectors, table, task.stage_two[budget], 1)
    return Trainer.of(config, task, domain.split, table)


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
    small = replace(toy_task.TASK.stage_two["smoke"].loop, evaluation_set_size=3)
    budget = replace(toy_task.TASK.stage_two["smoke"], loop=small)
    trainer = trainer_of(replace(task, stage_two={"smoke": budget}), "default", "gt4")
    sets = sets_of(trainer.watched["validation"])
    parities = sets[:, 1:] % 2
    assert (parities == parities[:, :1]).all()
    assert set(parities[:, 0].tolist()) == {0, 1}


@pytest.mark.unit
def test_groups_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match=r"validation_groups for \['full'\]; its splits are"):
        replace(toy_task.TASK, validation_groups={"full": lambda universe: universe.class_labels})
    each = replace(toy_task.TASK, validation_groups={"default": lambda u: np.arange(u.num_actions)})
    large = replace(each.stage_two["smoke"].loop, evaluation_set_size=6)
    budgets = {"smoke": replace(each.stage_two["smoke"], loop=large)}
    with pytest.raises(ValueError, match="every half of the 6 groups of the validation actions"):
        trainer_of(replace(each, stage_two=budgets), "default", "gt4")


@pytest.mark.unit
def test_plays_of_a_task_do_not_share_names_nor_folders() -> None:
    task = video_task.TASK
    with pytest.raises(ValueError, match=r"the modalities \['state', 'video', 'video'\]"):
        replace(task, plays=(*task.plays, video_task.VIDEO))
    for folder in ("recordings", "frames"):
        with pytest.raises(ValueError, match=r"the folders of recordings .* must be distinct"):
            replace(task, plays=(task.plays[0], replace(video_task.VIDEO, folder=folder)))
