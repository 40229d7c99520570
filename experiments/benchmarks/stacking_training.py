"""Shape Stacking on MuJoCo's C engine: placements per second of training, where the time goes.

    taskset -c 0 python -m experiments.benchmarks.stacking_training

Physics is timed where it happens, in the calls that the program makes to the engine. Pictures,
policy and gradient steps are parts of one compiled program; they are timed by programs of their
own, on the states that training came to. What these parts leave of the whole may be below 0.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np

from envs_mjx.shape_stacking import ShapeStacking
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from experiments.pipeline import flags as flag
from jaxnew.policy import distribution_and_value

_REPRESENTATION_SIZE = 128  # Of the HVAE (spec method 3).


class TimedEngine(MujocoC):
    """Adds up what its calls take.

    Attributes:
      spent: wall clock and processor time of all threads, s.
    """

    spent = m.Cost(0.0, 0.0)

    def settle_host(
        self, shape_ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        start = time.perf_counter(), time.process_time()
        result = super().settle_host(shape_ids, qpos, qvel)
        self.spent = m.Cost(
            self.spent.wall_s + time.perf_counter() - start[0],
            self.spent.cpu_s + time.process_time() - start[1],
        )
        return result


def main() -> None:
    report = m.Report("stacking_training")
    report.add_versions("mujoco")
    task = flag.load_task("shape_stacking")
    engine = TimedEngine()
    task = replace(task, make_environment=partial(ShapeStacking, engine))
    trainer = _trainers.make_trainer(
        task=task, representation_size=_REPRESENTATION_SIZE, budget="laptop"
    )
    config = trainer.config.ppo
    num_envs, num_steps = config.rollout.num_envs, config.steps_per_update

    state, _ = trainer.chunk(trainer.init(), 1)  # Compiles.
    updates, physics = [], []
    for _ in range(m.REPEATS.value):
        before = engine.spent
        (state, _), cost = m.timed(partial(trainer.chunk, state, 1))
        updates.append(cost)
        spent = engine.spent
        physics.append(m.Cost(spent.wall_s - before.wall_s, spent.cpu_s - before.cpu_s))
    how = f"{m.REPEATS.value} updates after one; {engine.num_threads} threads of physics; "
    how += _trainers.describe(trainer)
    update, settling = _median(updates), _median(physics)
    report.values(
        "training",
        {"placements_per_s": num_steps / update.wall_s, "update_s": update.wall_s},
        how=how,
        num_envs=num_envs,
    )

    parts = _median_parts(trainer, state)
    calls = num_steps / num_envs
    costs = {
        "physics": settling,
        "pictures": _times(parts["pictures"], calls),
        "policy": _times(parts["policy"], calls),
        "gradient steps": parts["gradient steps"],
    }
    rest = m.Cost(
        update.wall_s - sum(cost.wall_s for cost in costs.values()),
        update.cpu_s - sum(cost.cpu_s for cost in costs.values()),
    )
    costs["the rest"] = rest
    for clock in ("wall_s", "cpu_s"):
        shares = {name: getattr(c, clock) / getattr(update, clock) for name, c in costs.items()}
        report.values(f"shares, {clock.partition('_')[0]}", shares, how="of medians")


def _median_parts(trainer: Any, state: Any) -> dict[str, m.Cost]:
    """What one step's pictures and policy take in all environments, and one update's gradients."""
    learner, table, numbers = trainer.learner, trainer.table, trainer.config.hyperparameters
    env, method, rollout = learner.rollout.env, learner.method, state.rollout
    collect = jax.jit(learner.rollout.collect)

    def pictures(bodies: Any) -> Any:
        # Every step also draws the first picture of a next episode.
        return jax.vmap(lambda b: (env.picture(b), env.start_from(b)[0]))(bodies)

    def policy(params: Any, observation: Any, key: Any) -> Any:
        rows = method.project(params, table)[rollout.available.ids]
        distribution, value = distribution_and_value(
            method, params, observation, rows, rollout.available.mask
        )
        return distribution.sample(key), value

    def learning(key: Any) -> Any:
        key_rollout, key_learn = jax.random.split(key)
        _, batch, _ = collect(
            key_rollout, rollout, state.params, table, trainer.pools["train"], numbers.discount
        )
        return key_learn, state.params, state.opt_state, batch, numbers, table, state.step

    subjects = {
        "pictures": m.compiled(pictures, lambda key: (rollout.env_state.bodies,)),
        "policy": m.compiled(policy, lambda key: (state.params, rollout.observation, key)),
        "gradient steps": m.compiled(learner.learn, learning),
    }
    timings = m.measure(subjects, m.REPEATS.value)
    return {
        name: m.Cost(statistics.median(t.wall_s), statistics.median(t.cpu_s))
        for name, t in timings.items()
    }


def _median(costs: list[m.Cost]) -> m.Cost:
    return m.Cost(
        statistics.median(cost.wall_s for cost in costs),
        statistics.median(cost.cpu_s for cost in costs),
    )


def _times(cost: m.Cost, count: float) -> m.Cost:
    return m.Cost(cost.wall_s * count, cost.cpu_s * count)


if __name__ == "__main__":
    m.run_benchmark(main)
