"""The parts that the benchmarks of training time, at the paper's shapes or tiny."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from experiments.benchmarks import _measure as m
from jaxnew.ppo import Learner, TrainState
from jaxnew.representation.table import RepresentationTable
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.task import Task
from jaxnew.trainer import Trainer
from jaxnew.training import train_config

REPRESENTATION_SIZE = 16  # Of the paper's HVAE in Grid World, and of products.
_TINY = {
    "ppo__rollout__num_envs": 4,
    "ppo__rollout__num_steps": 16,
    "ppo__microbatch_size": 8,
    "ppo__num_epochs": 2,
    "ppo__num_minibatches": 2,
    "sets__size": 5,
}


def make_trainer(
    is_quick: bool,
    task: str | Task = "grid_world",
    method: str = "ours",
    representation_size: int = REPRESENTATION_SIZE,
    budget: str = "paper",
    **changes: Any,
) -> Trainer:
    """A run of a budget on a random table; `is_quick`: with 4 x 16 steps and sets of 5.

    The table holds random numbers: what a representation says does not change what it costs.

    Args:
      changes: of the budget, see `StageTwoBudget.vary`.
    """
    domain = Domain.of(load_task(task) if isinstance(task, str) else task)
    num_actions = domain.universe.num_actions
    vectors = np.random.default_rng(0).normal(size=(num_actions, representation_size))
    ids = np.arange(num_actions, dtype=np.int32)
    table = RepresentationTable(vectors.astype(np.float32), ids, domain.universe.hash)
    preset = domain.task.budget(budget).vary(**(_TINY if is_quick else changes))
    config = train_config(domain, method, "random", table, preset, seed=31)
    return Trainer.of(config, domain.task, domain.split, table)


def updating(trainer: Trainer, state: TrainState, learner: Learner | None = None) -> m.Subject:
    """One update from `state`, with the random numbers of the round."""
    numbers, actions = trainer.config.hyperparameters, trainer.training
    update = (learner or trainer.learner).update
    return m.compiled(update, lambda key: (replace(state, key=key), numbers, actions))


def collecting(
    trainer: Trainer,
    state: TrainState,
    rollout: DeviceRollout | None = None,
    actions: Actions | None = None,
) -> m.Subject:
    """One rollout from `state`."""
    actions, discount = actions or trainer.training, trainer.config.hyperparameters.discount

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        return key, state.rollout, state.params, actions, discount

    return m.compiled((rollout or trainer.rollout).collect, inputs)


def learning(trainer: Trainer, state: TrainState, learner: Learner | None = None) -> m.Subject:
    """The gradient steps of one update, on a rollout from `state`."""
    numbers, actions = trainer.config.hyperparameters, trainer.training
    learner, collect = learner or trainer.learner, jax.jit(trainer.rollout.collect)

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        key_batch, key_learn = jax.random.split(key)
        _, batch, _ = collect(key_batch, state.rollout, state.params, actions, numbers.discount)
        opt_state = learner.optimizer.init(state.params)
        return key_learn, state.params, opt_state, batch, numbers, actions, state.step

    return m.compiled(learner.learn, inputs)


def describe(trainer: Trainer) -> str:
    """The shapes, for the record."""
    ppo, actions = trainer.config.ppo, trainer.training
    return (
        f"{trainer.task.name}, {ppo.rollout.num_envs} x {ppo.rollout.num_steps} steps, "
        f"sets of {actions.set_size} of {actions.num_actions} actions, "
        f"{ppo.num_epochs} x {ppo.num_minibatches} gradient steps in microbatches of "
        f"{ppo.microbatch_size}, d = {actions.table.shape[1]}"
    )
