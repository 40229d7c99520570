"""Stage one: trajectories per second of HVAE training, and of encoding actions.

python -m experiments.benchmarks.representation
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.grid_world import play
from experiments.benchmarks import _measure as m
from experiments.tasks.grid_world import TASK
from jaxnew.representation.learner import RepresentationConfig, RepresentationLearner

NUM_STEPS = 4  # Gradient steps per call.


def main() -> None:
    report = m.Report("representation")
    config = replace(RepresentationConfig(), actions_per_batch=128, recordings_per_action=64)
    num_actions, num_recordings = 512, 1024
    if m.QUICK.value:
        config = replace(config, actions_per_batch=4, recordings_per_action=2)
        num_actions, num_recordings = 8, 4
    recordings = play.record(jax.random.key(0), jnp.arange(num_actions), num_recordings)
    assert TASK.play is not None
    learners = {
        name: RepresentationLearner(config, modality)
        for name, modality in TASK.play.modalities.items()
    }
    report_training(report, learners, recordings)
    report_encoding(report, learners, recordings)


def report_training(
    report: m.Report, learners: dict[str, RepresentationLearner], recordings: jax.Array
) -> None:
    """Gradient steps, batch drawing included."""

    def subject(learner: RepresentationLearner) -> m.Subject:
        state = learner.init(jax.random.key(0), recordings.shape)

        def inputs(key: jax.Array) -> tuple[Any, ...]:
            return replace(state, key_steps=key), recordings

        return m.compiled(lambda state, data: learner.train_steps(state, data, NUM_STEPS), inputs)

    timings = m.measure({name: subject(it) for name, it in learners.items()}, m.REPEATS.value)
    for name, timing in timings.items():
        config = learners[name].config
        batch = config.actions_per_batch, config.recordings_per_action
        report.timing(
            f"HVAE training, {name}",
            timing,
            work={"steps": NUM_STEPS, "trajectories": NUM_STEPS * batch[0] * batch[1]},
            includes=["batch drawing", "update"],
            how=f"{NUM_STEPS} steps, B = {batch[0]}, S = {batch[1]}, T = {recordings.shape[2]}",
        )


def report_encoding(
    report: m.Report, learners: dict[str, RepresentationLearner], recordings: jax.Array
) -> None:
    """A frozen encoder on new recordings, as `embed` does it: chunks from and to the host."""
    on_host = np.asarray(recordings)[:64]

    def subject(learner: RepresentationLearner) -> m.Subject:
        state = learner.init(jax.random.key(0), recordings.shape)

        def inputs(key: jax.Array) -> tuple[Any, ...]:
            order = np.asarray(jax.random.permutation(key, len(on_host)))
            return state, on_host[order]

        return m.Subject(learner.encode, inputs)

    timings = m.measure({name: subject(it) for name, it in learners.items()}, m.REPEATS.value)
    for name, timing in timings.items():
        num_actions, num_recordings = on_host.shape[:2]
        report.timing(
            f"HVAE encoding, {name}",
            timing,
            work={"actions": num_actions, "trajectories": num_actions * num_recordings},
            includes=["transfer"],
            how=f"{num_actions} actions with {num_recordings} recordings each",
        )


if __name__ == "__main__":
    m.run_benchmark(main)
