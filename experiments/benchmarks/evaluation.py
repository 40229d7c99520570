"""Evaluation: episodes per second of a policy on test action sets.

python -m experiments.benchmarks.evaluation
"""

from __future__ import annotations

from typing import Any

import jax

from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers


def main() -> None:
    report = m.Report("evaluation")
    trainer = _trainers.make_trainer()
    state = _trainers.trained_state(trainer, num_updates=1)
    evaluator = trainer.evaluator
    num_episodes = 200 if m.QUICK.value else 5000
    statistics = state.rollout.observation_statistics

    def play(key: jax.Array) -> dict[str, Any]:
        return evaluator.run(
            state.params, statistics, trainer.table, trainer.pools["test"], key, num_episodes
        )

    timings = m.measure({"sampled": m.Subject(play, lambda key: (key,))}, m.REPEATS.value)
    report.timing(
        "evaluation, sampled actions",
        timings["sampled"],
        work={"episodes": num_episodes},
        num_envs=evaluator.width,
        includes=["set drawing", "policy", "transfer"],
        how=f"{num_episodes} episodes on test sets; {_trainers.describe(trainer)}",
    )


if __name__ == "__main__":
    m.run_benchmark(main)
