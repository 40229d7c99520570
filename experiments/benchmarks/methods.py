"""One update of every method, in both domains; and what large sets cost.

    python -m experiments.benchmarks.methods

The Recommender draws sets of 500 products. What grows with the sets is measured by ablation, as in
`training`: the update against the same with a cheap stand-in for the utility of gathered rows, and
for both the utility and the gathering; the rollout against one that draws no sets. (Not an update:
gradients of counted sets, which are neighbours in the table, are cheaper too.)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from experiments.benchmarks.training import CountedSets
from jaxnew.policy import Categorical, UtilityMethod
from jaxnew.ppo import Learner
from jaxnew.rollout.device import DeviceRollout
from jaxnew.task.methods import VARIANTS

ARGUMENTS = m.Benchmark(__doc__)

TASKS = ("grid_world", "recommender")
# "no-entropy" is the same program as ours, and "random" no method.
METHODS = tuple(name for name in VARIANTS if name not in ("no-entropy", "random"))


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


def compare(report: m.Report, task: str) -> None:
    """The methods of one domain."""
    trainers = {n: _trainers.make_trainer(report.is_quick, task, n) for n in METHODS}
    states = {name: trainer.init() for name, trainer in trainers.items()}
    ours, start = trainers["ours"], states["ours"]
    assert isinstance(ours.rollout, DeviceRollout)
    stand_ins = {"utility": SumOfRow(), "utility and gathering": OneNumber()}
    learners = {
        name: Learner(replace(ours.rollout, method=method), ours.config.ppo)
        for name, method in stand_ins.items()
    }
    counted = CountedSets(**vars(ours.training))
    timings = report.measure(
        {name: _trainers.updating(trainers[name], states[name]) for name in METHODS}
        | {f"ours without {k}": _trainers.updating(ours, start, v) for k, v in learners.items()}
        | {
            "rollout": _trainers.collecting(ours, start),
            "rollout without set drawing": _trainers.collecting(ours, start, actions=counted),
        }
    )
    steps = {name: trainers.get(name, ours).config.ppo.steps_per_update for name in timings}
    for name, timing in timings.items():
        report.timing(
            f"{task}: {name}",
            timing,
            work={"steps": steps[name]},
            num_envs=ours.config.ppo.rollout.num_envs,
            includes=["auto-reset", "policy", "update"] if name in METHODS else [],
            how=_trainers.describe(trainers.get(name, ours)),
        )
    for name in METHODS[1:]:
        scale = steps["ours"] / steps[name]
        per_step = {k: scale * v for k, v in m.ratio(timings[name], timings["ours"]).items()}
        how = "time per environment step over that of ours"
        report.values(f"{task}: {name} / ours", per_step, how=how)
    how = "1 - time with a cheap stand-in / time of an update of ours, of medians"
    for name in stand_ins:
        share = m.share_saved(timings["ours"], timings[f"ours without {name}"])
        report.values(f"{task}: share of {name}", share, how=how)
    saved = timings["rollout"], timings["rollout without set drawing"], timings["ours"]
    how = "what the rollout saves with sets that are counted off / time of an update of ours"
    report.values(f"{task}: share of set drawing", m.share_saved(*saved), how=how)


def main() -> None:
    report = m.Report("methods", ARGUMENTS)
    for task in TASKS:
        compare(report, task)


if __name__ == "__main__":
    ARGUMENTS.start(main)
