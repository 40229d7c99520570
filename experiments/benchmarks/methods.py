"""One update of every method, in both domains; and what large sets cost.

    python -m experiments.benchmarks.methods

The Recommender draws sets of 500 products. Beside its update, the parts that grow with the sets are
timed alone, as often as an update does them: drawing the sets, gathering the rows of the projected
table and adding their gradients up again, and the utility of given rows with its gradient.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from experiments._methods import VARIANTS
from experiments._training import Trainer
from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from jaxnew import sampling
from jaxnew.policy.state_encoder import FEATURE_SIZE, apply
from jaxnew.policy.utility import HIDDEN_SIZE, Utility
from jaxnew.ppo import TrainState

TASKS = ("grid_world", "recommender")
PARTS = ("set drawing", "gathering", "utility")


def update_subject(trainer: Trainer) -> m.Subject:
    """One update from a fresh state."""
    start = trainer.init()
    numbers, table, pool = trainer.config.hyperparameters, trainer.table, trainer.training_pool

    def update(state: TrainState) -> Any:
        return trainer.learner.update(state, numbers, table, pool)

    return m.compiled(update, lambda key: (replace(start, key=key),))


def part_subjects(trainer: Trainer) -> dict[str, m.Subject]:
    """What an update does with its sets, part by part."""
    ppo, pool = trainer.config.ppo, trainer.training_pool
    num_steps, set_size = ppo.steps_per_update, ppo.rollout.set_size
    size = ppo.microbatch_size or ppo.minibatch_size
    num_parts = ppo.num_epochs * num_steps // size
    utility = Utility()
    params = utility.init(
        jax.random.key(0),
        jnp.zeros(FEATURE_SIZE),
        jnp.zeros((1, trainer.table.shape[1])),
        method="concatenated",
    )["params"]
    weights = jax.random.normal(jax.random.key(1), (HIDDEN_SIZE,))

    def draw(keys: jax.Array) -> jax.Array:
        return sampling.draw_sets(keys, pool, set_size).ids

    def keys_of(key: jax.Array) -> tuple[jax.Array]:
        return (jax.random.split(key, num_steps),)

    def gather(projected: jax.Array, sets: jax.Array) -> jax.Array:
        """Every microbatch of an update: rows out of the table, gradients back into it."""

        def of_part(total: jax.Array, index: jax.Array) -> tuple[jax.Array, None]:
            ids = jax.lax.dynamic_slice_in_dim(sets, index % (num_steps // size) * size, size)

            def use(projected: jax.Array) -> jax.Array:
                return jnp.sum(projected[ids] ** 2 * weights)

            return total + jax.grad(use)(projected), None

        return jax.lax.scan(of_part, jnp.zeros_like(projected), jnp.arange(num_parts))[0]

    def gather_inputs(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_rows, key_sets = jax.random.split(key)
        shape = (trainer.table.shape[0], HIDDEN_SIZE)
        return jax.random.normal(key_rows, shape), draw(jax.random.split(key_sets, num_steps))

    def score(features: jax.Array, rows: jax.Array) -> Any:
        """Utilities of given rows and their gradients, every microbatch of an update."""

        def of_part(total: Any, index: jax.Array) -> tuple[Any, None]:
            part = jax.lax.dynamic_slice_in_dim(features, index % (num_steps // size) * size, size)

            def use(params: Any, part: jax.Array, rows: jax.Array) -> jax.Array:
                scores = apply(utility, params, part, jnp.broadcast_to(rows, (size, *rows.shape)))
                return jnp.sum(jax.nn.log_softmax(scores)[:, 0])

            grads = jax.grad(use, argnums=(0, 1, 2))(params, part, rows)
            return jax.tree.map(jnp.add, total, (grads[0], jnp.sum(grads[1]), grads[2])), None

        zeros = jax.tree.map(jnp.zeros_like, (params, jnp.float32(0.0), rows))
        return jax.lax.scan(of_part, zeros, jnp.arange(num_parts))[0]

    def score_inputs(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_features, key_rows = jax.random.split(key)
        features = jax.random.normal(key_features, (num_steps, FEATURE_SIZE))
        return features, jax.random.normal(key_rows, (set_size, HIDDEN_SIZE))

    return {
        "set drawing": m.compiled(draw, keys_of),
        "gathering": m.compiled(gather, gather_inputs),
        "utility": m.compiled(score, score_inputs),
    }


def main() -> None:
    report = m.Report("methods")
    for task in TASKS:
        trainers = {
            name: _trainers.make_trainer(task=task, method=name)
            for name in VARIANTS
            if name not in ("no-entropy", "random")  # The same program as ours, and no method.
        }
        subjects = {name: update_subject(trainer) for name, trainer in trainers.items()}
        subjects |= part_subjects(trainers["ours"])
        timings = m.measure(subjects, m.REPEATS.value)
        for name, timing in timings.items():
            trainer = trainers.get(name, trainers["ours"])
            steps = trainer.config.ppo.steps_per_update
            report.timing(
                f"{task}: {name}",
                timing,
                work={"steps": steps},
                num_envs=trainer.config.ppo.rollout.num_envs,
                includes=["auto-reset", "policy", "update"] if name in trainers else [],
                how=_trainers.describe(trainer),
            )
        for name in trainers:
            if name != "ours":
                scale = (
                    trainers["ours"].config.ppo.steps_per_update
                    / trainers[name].config.ppo.steps_per_update
                )
                per_step = {
                    clock: scale * value
                    for clock, value in m.ratio(timings[name], timings["ours"]).items()
                }
                how = "time per environment step over that of ours"
                report.values(f"{task}: {name} / ours", per_step, how=how)
        for name in PARTS:
            how = "time of the part alone over that of an update of ours"
            share = m.ratio(timings[name], timings["ours"])
            report.values(f"{task}: {name} / update", share, how=how)


if __name__ == "__main__":
    m.run_benchmark(main)
