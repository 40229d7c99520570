"""Run by `test_sweep.py` in a process with eight virtual CPU devices; prints what it found."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import jax
import numpy as np

from jaxnew.ppo import TrainState
from jaxnew.representation.table import engineered_table
from jaxnew.sweeping import SweepProgram, member_configs
from jaxnew.task.domain import Domain, load_task
from jaxnew.trainer import Trainer
from jaxnew.training import train_config


def distance(tree: object, other: object) -> float:
    """The Euclidean distance of two parameter trees."""
    pairs = zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True)
    return float(np.sqrt(sum(np.sum((np.asarray(a) - np.asarray(b)) ** 2) for a, b in pairs)))


def opinionated(state: TrainState) -> TrainState:
    """The state with utilities far from uniform.

    At the start they are about 1e-8, and so are their gradients: Adam would magnify rounding to
    steps as large as what hyper-parameters change.
    """
    utility = jax.tree.map(lambda x: 50.0 * x, state.params["utility"])
    return replace(state, params={**state.params, "utility": utility})


def main() -> None:
    domain = Domain.of(load_task("grid_world"))
    table = engineered_table(domain.universe, "gt12")
    budget = domain.task.stage_two["smoke"]
    base = train_config(domain, "ours", "gt12", table, budget, 31)
    configs = member_configs(base, list(range(8)), {"entropy_coefficient": (0.0, 0.1)})
    trainer = Trainer.of(configs[0], domain.task, domain.split, table)
    # As `Trainer` does it; one compilation serves all, for seeds and hyper-parameters are traced.
    init = jax.jit(trainer.learner.init)
    update = jax.jit(partial(trainer.learner.updates, num_updates=1))
    singles = [
        update(
            opinionated(init(jax.random.key(config.seed), trainer.training)),
            config.hyperparameters,
            trainer.training,
        )
        for config in configs
    ]
    errors: dict[int, list[float]] = {1: [], 2: []}
    for members_at_once in errors:
        sweep = SweepProgram.of(trainer, configs, jax.devices(), members_at_once)
        started = sweep.init()
        started = replace(started, members=opinionated(started.members))
        state, metrics = sweep.chunk(started, 1)
        for index, (after, single_metrics) in enumerate(singles):
            before, member = (
                jax.tree.map(lambda x, i=index: x[i], tree.members.params)
                for tree in (started, state)
            )
            moved = distance(before, after.params)
            errors[members_at_once].append(distance(member, after.params) / moved)
            name = "episode/episode_return"
            np.testing.assert_allclose(
                metrics[f"{index:03d}/{name}"], float(single_metrics[name]), rtol=1e-5
            )
    leaf = jax.tree.leaves(state.members.params)[0]
    seven = SweepProgram.of(
        trainer, [replace(base, seed=seed) for seed in range(7)], jax.devices()[:6]
    )
    print(
        json.dumps(
            {
                "devices": len(sweep.devices),
                "devices_of_a_leaf": len(leaf.sharding.device_set),
                "error_in_turn": max(errors[1]),
                "error_two_at_once": max(errors[2]),
                "median_error_two_at_once": float(np.median(errors[2])),
                "seven_members_on_six_devices_use": len(seven.devices),
            }
        )
    )


if __name__ == "__main__":
    main()
