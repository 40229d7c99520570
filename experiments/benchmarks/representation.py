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
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.learner import RepresentationLearner

ARGUMENTS = m.Benchmark(__doc__)

NUM_STEPS = 4  # Gradient steps per call.


def training(learner: RepresentationLearner, recordings: jax.Array) -> m.Subject:
    """Gradient steps, batch drawing included."""
    state = learner.init(jax.random.key(0), recordings.shape)

    def steps(state: Any, data: jax.Array) -> Any:
        return learner.train_steps(state, data, NUM_STEPS)

    return m.compiled(steps, lambda key: (replace(state, key_steps=key), recordings))


def encoding(learner: RepresentationLearner, recordings: np.ndarray) -> m.Subject:
    """A frozen encoder on new recordings, as `embed` does it: chunks from and to the host."""
    state = learner.init(jax.random.key(0), recordings.shape)

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        return state, recordings[np.asarray(jax.random.permutation(key, len(recordings)))]

    return m.Subject(learner.encode, inputs)


def main() -> None:
    report = m.Report("representation", ARGUMENTS)
    num_actions, num_recordings, batch = (
        (8, 4, (4, 2)) if report.is_quick else (512, 1024, (128, 64))
    )
    config = RepresentationConfig(actions_per_batch=batch[0], recordings_per_action=batch[1])
    recordings = play.record(jax.random.key(0), jnp.arange(num_actions), num_recordings)
    on_host = np.asarray(recordings)[:64]
    modalities = TASK.plays[0].modalities.items()
    learners = {name: RepresentationLearner(config, modality) for name, modality in modalities}
    timings = report.measure({name: training(it, recordings) for name, it in learners.items()})
    for name, timing in timings.items():
        report.timing(
            f"HVAE training, {name}",
            timing,
            work={"steps": NUM_STEPS, "trajectories": NUM_STEPS * batch[0] * batch[1]},
            includes=["batch drawing", "update"],
            how=f"{NUM_STEPS} steps, B = {batch[0]}, S = {batch[1]}, T = {recordings.shape[2]}",
        )
    timings = report.measure({name: encoding(it, on_host) for name, it in learners.items()})
    for name, timing in timings.items():
        report.timing(
            f"HVAE encoding, {name}",
            timing,
            work={"actions": len(on_host), "trajectories": len(on_host) * num_recordings},
            includes=["transfer"],
            how=f"{len(on_host)} actions with {num_recordings} recordings each",
        )


if __name__ == "__main__":
    ARGUMENTS.start(main)
