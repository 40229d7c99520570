"""Shape Stacking on MuJoCo's C engine: placements per second of training, where the time goes.

    taskset -c 0 python -m experiments.benchmarks.stacking_training

Physics is timed where it happens, in the calls that the program makes to the engine. Pictures,
policy and gradient steps are parts of one compiled program; they are timed by programs of their
own, on the states that training came to. What these parts leave of the whole may be below 0.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np

from envs_mjx.shape_stacking import ShapeStacking
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from jaxnew.policy import distribution_and_value
from jaxnew.ppo import TrainState
from jaxnew.rollout.device import DeviceRollout
from jaxnew.task.domain import load_task
from jaxnew.trainer import Trainer

ARGUMENTS = m.Benchmark(__doc__)

_REPRESENTATION_SIZE = 128  # Of the HVAE.


class TimedEngine(MujocoC):
    """Adds up what its calls take.

    Attributes:
      spent: wall clock and processor time of all threads.
    """

    spent = m.Cost(0.0, 0.0)

    def settle_host(
        self, shape_ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        result, cost = m.timed(partial(super().settle_host, shape_ids, qpos, qvel))
        self.spent = self.spent + cost
        return result


def main() -> None:
    report = m.Report("stacking_training", ARGUMENTS)
    report.add_versions("mujoco")
    engine = TimedEngine()
    task = load_task("shape_stacking")
    task = replace(task, environment=None, make_environment=partial(ShapeStacking, engine))
    trainer = _trainers.make_trainer(report.is_quick, task, "ours", _REPRESENTATION_SIZE, "laptop")
    num_envs = trainer.config.ppo.rollout.num_envs
    num_steps = trainer.config.ppo.steps_per_update

    state, _ = trainer.chunk(trainer.init(), 1)  # Compiles.
    updates, physics = [], []
    for _ in range(report.repeats):
        before = engine.spent
        (state, _), cost = m.timed(partial(trainer.chunk, state, 1))
        updates.append(cost)
        physics.append(engine.spent - before)
    how = f"{report.repeats} updates after one; {engine.num_threads} threads of physics; "
    how += _trainers.describe(trainer)
    update = m.Cost.median(updates)
    speed = {"placements_per_s": num_steps / update.wall_s, "update_s": update.wall_s}
    report.values("training", speed, how=how, num_envs=num_envs)

    parts = {name: t.median for name, t in report.measure(part_subjects(trainer, state)).items()}
    calls = num_steps / num_envs
    costs = {
        "physics": m.Cost.median(physics),
        "pictures": parts["pictures"] * calls,
        "policy": parts["policy"] * calls,
        "gradient steps": parts["gradient steps"],
    }
    costs["the rest"] = update - sum(costs.values(), m.Cost(0.0, 0.0))
    for clock in ("wall_s", "cpu_s"):
        shares = {name: getattr(c, clock) / getattr(update, clock) for name, c in costs.items()}
        report.values(f"shares, {clock.partition('_')[0]}", shares, how="of medians")


def part_subjects(trainer: Trainer, state: TrainState) -> dict[str, m.Subject]:
    """One step's pictures and policy in all environments, and one update's gradient steps."""
    assert isinstance(trainer.rollout, DeviceRollout)
    env: Any = trainer.rollout.env
    method, rollout, actions = trainer.learner.method, state.rollout, trainer.training

    def pictures(bodies: Any) -> Any:
        # Every step also draws the first picture of a next episode.
        return jax.vmap(lambda b: (env.picture(b), env.start_from(b)[0]))(bodies)

    def policy(params: Any, observation: Any, key: Any) -> Any:
        rows = actions.rows(method.project(params, actions.table), rollout.available)
        distribution, value = distribution_and_value(
            method, params, observation, rows, rollout.available.mask
        )
        return distribution.sample(key), value

    return {
        "pictures": m.compiled(pictures, lambda key: (rollout.env_state.bodies,)),
        "policy": m.compiled(policy, lambda key: (state.params, rollout.observation, key)),
        "gradient steps": _trainers.learning(trainer, state),
    }


if __name__ == "__main__":
    ARGUMENTS.start(main)
