"""The parts that the benchmarks of training time, at the paper's shapes or tiny."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks import _measure as m
from experiments.pipeline.artifacts import Domain
from experiments.pipeline.flags import load_task
from experiments.pipeline.training import TrainConfig, Trainer
from jaxnew.ppo import TrainState
from jaxnew.ppo.objective import Minibatch
from jaxnew.representation.table import RepresentationTable
from jaxnew.sampling import draw_sets
from jaxnew.task import Task

REPRESENTATION_SIZE = 16  # Of the paper's HVAE in Grid World, and of products (spec method 3).


def make_trainer(
    set_size: int = 0,
    seed: int = 31,
    task: str | Task = "grid_world",
    method: str = "ours",
    representation_size: int = REPRESENTATION_SIZE,
    budget: str = "paper",
) -> Trainer:
    """A run of a budget on a random table; with `--quick` 4 x 16 steps and sets of 5.

    The table holds random numbers: what a representation says does not change what it costs.

    Args:
      set_size: actions in a set; 0 for the task's.
    """
    domain = Domain.of(load_task(task) if isinstance(task, str) else task, None)
    num_actions = domain.universe.num_actions
    vectors = np.random.default_rng(0).normal(size=(num_actions, representation_size))
    table = RepresentationTable(
        vectors=vectors.astype(np.float32),
        ids=np.arange(num_actions, dtype=np.int32),
        universe_hash=domain.universe.hash,
        source="random numbers",
    )
    config = TrainConfig.of(domain, method, "random", table, domain.task.stage_two[budget], seed)
    ppo = config.ppo
    rollout = replace(ppo.rollout, set_size=set_size or ppo.rollout.set_size)
    if m.QUICK.value:
        rollout = replace(rollout, num_envs=4, num_steps=16, set_size=min(rollout.set_size, 5))
        ppo = replace(ppo, microbatch_size=8, num_epochs=2, num_minibatches=2)
    config = replace(config, ppo=replace(ppo, rollout=rollout))
    return Trainer.of(config, domain.task, domain.split, table)


def trained_state(trainer: Trainer, num_updates: int) -> TrainState:
    """A state in which episodes of the environments no longer start together."""
    return trainer.chunk(trainer.init(), num_updates)[0]


def random_minibatch(key: jax.Array, trainer: Trainer, size: int) -> Minibatch:
    """`size` transitions with random contents and sets drawn as in training; consumes `key`."""
    rollout = trainer.config.ppo.rollout
    key_sets, key_obs, key_choice, *keys = jax.random.split(key, 7)
    available = draw_sets(
        jax.random.split(key_sets, size), trainer.pools["train"], rollout.set_size
    )
    env = trainer.learner.rollout.env
    shape = env.observation_spec(env.default_params).shape
    advantage, value, value_target, change = (jax.random.normal(k, (size,)) for k in keys)
    return Minibatch(
        observation=jax.random.normal(key_obs, (size, *shape)),
        available=available,
        sample=jax.random.randint(key_choice, (size,), 0, rollout.set_size),
        log_prob=-jnp.log(float(rollout.set_size)) + 0.1 * change,
        value=value,
        advantage=advantage,
        value_target=value_target,
    )


def describe(trainer: Trainer) -> str:
    """The shapes, for the record."""
    ppo = trainer.config.ppo
    rollout = ppo.rollout
    return (
        f"{trainer.task.name}, {rollout.num_envs} x {rollout.num_steps} steps, "
        f"sets of {rollout.set_size} of {int(trainer.pools['train'].size)} actions, "
        f"{ppo.num_epochs} x {ppo.num_minibatches} gradient steps in microbatches of "
        f"{ppo.microbatch_size}, d = {trainer.table.shape[1]}"
    )
