"""Validation sets of CREATE's Full split while training: half of the classes (spec create 8.3)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from experiments.pipeline.artifacts import Domain
from experiments.pipeline.evaluation import evaluate_on
from experiments.pipeline.flags import load_task
from experiments.pipeline.training import TrainConfig, Trainer
from jaxnew.representation.table import engineered_table
from jaxnew.sampling import ActionPool, draw_sets
from jaxnew.task import Task
from tests import toy_task, video_task


def trainer_of(task: Task, split: str, vectors: str, budget: str = "smoke") -> Trainer:
    domain = Domain.of(task, split)
    table = engineered_table(domain.universe, vectors)
    config = TrainConfig.of(domain, "ours", vectors, table, task.stage_two[budget], 1)
    return Trainer.of(config, task, domain.split, table)


def sets_of(pool: ActionPool, set_size: int, count: int = 64) -> np.ndarray:
    """int32[count, set_size]."""
    return np.asarray(draw_sets(jax.random.split(jax.random.key(0), count), pool, set_size).ids)


@pytest.fixture(scope="module")
def full() -> Trainer:
    return trainer_of(load_task("create-push"), "full", "gt32", "paper")


@pytest.mark.contract
def test_validation_sets_of_the_full_split_show_half_of_the_classes(full: Trainer) -> None:
    domain = Domain.of(full.task, "full")
    labels, split = domain.universe.class_labels, domain.split
    evaluator, pool = full.watched("validation")
    assert evaluator.set_size == 50
    sets = sets_of(pool, 50)
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
    assert full.watched("train")[1] is full.pools["train"] is full.training_pool
    for name in ("validation", "test"):
        _, pool = full.on_split(name, full.evaluator)
        sets = sets_of(pool, 50)
        assert np.isin(sets[:, 1:], domain.split.ids(name)).all()
        classes = [len(set(labels[row[1:]].tolist())) for row in sets]
        assert min(classes) >= 5
        assert np.mean(classes) > 5.9
    default = trainer_of(full.task, "default", "gt32")
    assert default.watched("validation")[1] is default.pools["validation"]
    assert default.pools["validation"].group_starts is None
    # Of CREATE's Full split alone (spec method 2.2).
    assert not load_task("create-push-analysis").validation_groups
    assert not load_task("shape_stacking").validation_groups


@dataclass
class Spy:
    """An evaluator that remembers what it was to draw from."""

    set_size: int
    pools: list[ActionPool] = field(default_factory=list)

    def run(self, *arguments: Any) -> dict[str, np.ndarray]:
        self.pools.append(arguments[3])
        return {"is_success": np.ones(arguments[5], np.float32)}


@pytest.mark.contract
def test_training_watches_groups_and_evaluation_does_not(full: Trainer) -> None:
    state: Any = SimpleNamespace(params=None, rollout=SimpleNamespace(observation_statistics=None))
    watching, evaluating = Spy(50), Spy(50)
    trainer = replace(full, watcher=watching, evaluator=evaluating)
    found = trainer.evaluate(state)
    assert found == {"train/is_success": 1.0, "validation/is_success": 1.0}
    assert [pool.group_starts is None for pool in watching.pools] == [True, False]
    assert not evaluating.pools
    split = Domain.of(full.task, "full").split
    for name in ("validation", "test"):
        evaluate_on(trainer, state, name, split.ids(name), split, num_episodes=2)
    assert [pool.group_starts for pool in evaluating.pools] == [None, None]


@pytest.mark.contract
def test_any_task_can_have_groups_for_any_split() -> None:
    def parity(universe: Any) -> np.ndarray:
        return np.asarray(universe.class_labels)  # Even ids and odd ones.

    task = replace(toy_task.TASK, validation_groups={"default": parity})
    small = replace(toy_task.TASK.stage_two["smoke"].loop, evaluation_set_size=3)
    budget = replace(toy_task.TASK.stage_two["smoke"], loop=small)
    trainer = trainer_of(replace(task, stage_two={"smoke": budget}), "default", "gt4")
    sets = sets_of(trainer.watched("validation")[1], trainer.watcher.set_size)
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
        replace(task, more_plays=(video_task.VIDEO, video_task.VIDEO))
    for folder in ("recordings", "frames"):
        with pytest.raises(ValueError, match=r"the folders of recordings .* must be distinct"):
            replace(task, more_plays=(replace(video_task.VIDEO, folder=folder),))
