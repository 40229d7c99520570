"""Run by `test_sweep.py` in a process with eight virtual CPU devices; prints what it found."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import jax
import numpy as np

from experiments._artifacts import Domain
from experiments._flags import load_task
from experiments._training import TrainConfig, Trainer
from experiments.sweep import Sweep, member_configs
from jaxnew.representation.table import engineered_table


def differences(tree: object, other: object) -> np.ndarray:
    """Absolute differences of all weights of two parameter trees, in one row."""
    pairs = zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True)
    return np.concatenate([np.abs(np.asarray(a) - np.asarray(b)).ravel() for a, b in pairs])


def main() -> None:
    domain = Domain.of(load_task("grid_world"), None)
    table = engineered_table(domain.universe, "gt12")
    budget = domain.task.stage_two["smoke"]
    base = TrainConfig.of(domain, "ours", "gt12", table, budget, 31)
    configs = member_configs(base, [1, 2, 3, 4], ["entropy_coefficient=0.0,0.1"])
    trainer = Trainer.of(configs[0], domain.task, domain.split, table)
    sweep = Sweep.of(trainer, configs, jax.devices())
    started = sweep.init()
    state, metrics = sweep.chunk(started, 1)
    moved = differences(state.members.params, started.members.params).max()
    # As `Trainer` does it; one compilation serves all, for seeds and hyper-parameters are traced.
    init = jax.jit(trainer.learner.init)
    update = jax.jit(partial(trainer.learner.updates, num_updates=1))
    pool = trainer.pools["train"]
    to_single = []
    for index, config in enumerate(configs):
        state_before = init(jax.random.key(config.seed), trainer.table, pool)
        after, single_metrics = update(state_before, config.hyperparameters, trainer.table, pool)
        member = jax.tree.map(lambda x, i=index: x[i], state.members)
        to_single.append(differences(member.params, after.params))
        name = "episode/episode_return"
        np.testing.assert_allclose(
            metrics[f"{index:03d}/{name}"], float(single_metrics[name]), rtol=1e-5
        )
    leaf = jax.tree.leaves(state.members.params)[0]
    seven = Sweep.of(trainer, [replace(base, seed=seed) for seed in range(7)], jax.devices()[:6])
    print(
        json.dumps(
            {
                "devices": len(sweep.devices),
                "devices_of_a_leaf": len(leaf.sharding.device_set),
                "moved": float(moved),
                "largest_difference": max(float(d.max()) for d in to_single),
                "quantile_99": max(float(np.quantile(d, 0.99)) for d in to_single),
                "seven_members_on_six_devices_use": len(seven.devices),
            }
        )
    )


if __name__ == "__main__":
    main()
