"""One update of every method, in both domains; and what large sets cost.

    python -m experiments.benchmarks.methods

The Recommender draws sets of 500 products. What grows with the sets is measured by ablation, as in
`training`: the update against the same with a cheap stand-in for the utility of gathered rows, and
for both the utility and the gathering; the rollout against one that draws no sets.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from experiments.benchmarks.training import CountedSets
from experiments.pipeline.methods import VARIANTS
from experiments.pipeline.training import Trainer
from jaxnew.policy import Categorical, UtilityMethod
from jaxnew.ppo import TrainState

TASKS = ("grid_world", "recommender")
PARTS = ("utility", "utility and gathering")


def update_subject(trainer: Trainer) -> m.Subject:
    """One update from a fresh state."""
    start = trainer.init()
    numbers, table, pool = trainer.config.hyperparameters, trainer.table, trainer.training_pool

    def update(state: TrainState) -> Any:
        return trainer.learner.update(state, numbers, table, pool)

    return m.compiled(update, lambda key: (replace(start, key=key),))


class SumOfRow(UtilityMethod):
    """Gathers the rows of the projected table, but only adds up their numbers."""

    def distribution_of(
        self, params: dict[str, Any], features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        scores = 1e-3 * (jnp.sum(features, axis=-1, keepdims=True) + jnp.sum(projected, axis=-1))
        return Categorical.masked(scores, mask)


class OneNumber(SumOfRow):
    """The same sums, made before gathering: one number per action instead of 64."""

    def project(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        return jnp.sum(super().project(params, representations), axis=-1, keepdims=True)


def part_subjects(trainer: Trainer) -> dict[str, m.Subject]:
    """The update of ours with cheap stand-ins for what it does with the rows of its sets."""
    learner = trainer.learner
    variants = {"utility": SumOfRow(), "utility and gathering": OneNumber()}
    return {
        name: update_subject(
            replace(
                trainer,
                learner=replace(learner, rollout=replace(learner.rollout, method=method)),
            )
        )
        for name, method in variants.items()
    }


def rollout_subjects(trainer: Trainer) -> dict[str, m.Subject]:
    """A rollout of ours, and one whose sets are counted off.

    Not an update: gradients of counted sets, which are neighbours in the table, are cheaper too.
    """
    start, numbers = trainer.init(), trainer.config.hyperparameters
    whole = trainer.learner.rollout
    counted = CountedSets(whole.env, whole.env_params, whole.method, whole.config)

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        pool = trainer.training_pool
        return key, start.rollout, start.params, trainer.table, pool, numbers.discount

    return {
        "rollout": m.compiled(whole.collect, inputs),
        "rollout without set drawing": m.compiled(counted.collect, inputs),
    }


def title(name: str) -> str:
    """What a subject is called in the report."""
    return f"ours without {name}" if name in PARTS else name


def main() -> None:
    report = m.Report("methods")
    for task in TASKS:
        trainers = {
            name: _trainers.make_trainer(task=task, method=name)
            for name in VARIANTS
            if name not in ("no-entropy", "random")  # The same program as ours, and no method.
        }
        subjects = {name: update_subject(trainer) for name, trainer in trainers.items()}
        subjects |= part_subjects(trainers["ours"]) | rollout_subjects(trainers["ours"])
        timings = m.measure(subjects, m.REPEATS.value)
        for name, timing in timings.items():
            trainer = trainers.get(name, trainers["ours"])
            steps = trainer.config.ppo.steps_per_update
            report.timing(
                f"{task}: {title(name)}",
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
            how = "1 - time with a cheap stand-in / time of an update of ours, of medians"
            share = m.share_saved(timings["ours"], timings[name])
            report.values(f"{task}: share of {name}", share, how=how)
        drawing = m.share_saved(timings["rollout"], timings["rollout without set drawing"])
        of_update = m.ratio(timings["rollout"], timings["ours"])
        values = {clock: share * of_update[clock] for clock, share in drawing.items()}
        how = "what the rollout saves with sets that are counted off / time of an update of ours"
        report.values(f"{task}: share of set drawing", values, how=how)


if __name__ == "__main__":
    m.run_benchmark(main)
