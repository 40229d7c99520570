"""The utility layer: factored or concatenated, projected before or after the gather, microbatches.

python -m experiments.benchmarks.utility
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from experiments.pipeline.training import Trainer
from jaxnew.policy import Categorical, UtilityMethod
from jaxnew.policy.state_encoder import FEATURE_SIZE, VectorEncoder
from jaxnew.policy.utility import Utility
from jaxnew.ppo import Learner

SET_SIZES = (20, 50, 250)
SIZES = (0, 64, 128, 256, 512)  # Of microbatches.
RATIO = "time of the first over time of the second"
FORMS = ("factored", "concatenated")


class GatherThenProject(UtilityMethod):
    """The same policy; the rows of a set are gathered first and projected for every transition."""

    def project(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        del params
        return representations

    def distribution(
        self, params: dict[str, Any], obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        projected = UtilityMethod.project(self, params, projected)
        return super().distribution(params, obs, projected, mask)


class ConcatenatedMethod(GatherThenProject):
    """The same policy as the paper writes it: state feature and action embedding concatenated."""

    def distribution(
        self, params: dict[str, Any], obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        features = VectorEncoder().apply({"params": params["encoder"]}, obs)
        utilities = Utility().apply(
            {"params": params["utility"]}, features, projected, method="concatenated"
        )
        return Categorical.masked(jnp.asarray(utilities), mask)


METHODS: dict[str, type[UtilityMethod]] = {
    "project the table, gather": UtilityMethod,
    "gather, project": GatherThenProject,
    "gather, concatenate": ConcatenatedMethod,
}


def layer_subjects(num_states: int, set_size: int, num_actions: int) -> dict[str, m.Subject]:
    """The layer alone, from state features, a table and ids; forward, and with its gradients."""
    layer: nn.Module = Utility()
    size = _trainers.REPRESENTATION_SIZE

    def factored(params: Any, features: jax.Array, table: jax.Array, ids: jax.Array) -> Any:
        projected = layer.apply(params, table, method="project")
        return layer.apply(params, features, jnp.asarray(projected)[ids])

    def concatenated(params: Any, features: jax.Array, table: jax.Array, ids: jax.Array) -> Any:
        return layer.apply(params, features, table[ids], method="concatenated")

    def with_gradients(forward: Callable[..., Any]) -> Callable[..., Any]:
        def both(
            params: Any, features: jax.Array, table: jax.Array, ids: jax.Array, up: jax.Array
        ) -> Any:
            utilities, pull_back = jax.vjp(lambda p, f: forward(p, f, table, ids), params, features)
            return utilities, pull_back(up)

        return both

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        keys = jax.random.split(key, 5)
        features = jnp.tanh(jax.random.normal(keys[0], (num_states, FEATURE_SIZE)))
        table = jax.random.normal(keys[1], (num_actions, size))
        ids = jax.random.randint(keys[2], (num_states, set_size), 0, num_actions)
        params = layer.init(keys[3], features[0], table[:1], method="concatenated")
        return params, features, table, ids, jax.random.normal(keys[4], ids.shape)

    subjects = {}
    for name, forward in (("factored", factored), ("concatenated", concatenated)):
        subjects[f"{name}, forward"] = m.compiled(forward, lambda key: inputs(key)[:4])
        subjects[f"{name}, forward and backward"] = m.compiled(with_gradients(forward), inputs)
    return subjects


def gradient_subjects(
    trainer: Trainer,
    variants: Mapping[str, tuple[UtilityMethod, int]],
    num_transitions: int,
) -> dict[str, m.Subject]:
    """The learner's gradient of one minibatch, for each name -> (method, microbatch size)."""
    rollout = trainer.learner.rollout
    rollout_config = replace(rollout.config, num_envs=1, num_steps=num_transitions)
    params = jax.jit(trainer.learner.init)(
        jax.random.key(0), trainer.table, trainer.pools["train"]
    ).params
    minibatch = jax.jit(lambda key: _trainers.random_minibatch(key, trainer, num_transitions))

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        return params, minibatch(key), trainer.config.hyperparameters, trainer.table

    def learner(method: UtilityMethod, microbatch_size: int) -> Learner:
        config = replace(
            trainer.config.ppo,
            rollout=rollout_config,
            num_minibatches=1,
            microbatch_size=microbatch_size,
        )
        return Learner(replace(rollout, method=method, config=rollout_config), config)

    return {
        name: m.compiled(learner(*variant)._gradient, inputs) for name, variant in variants.items()
    }


def report_layer(report: m.Report) -> None:
    num_states, set_size, num_actions = (16, 5, 32) if m.QUICK.value else (4096, 50, 1024)
    timings = m.measure(layer_subjects(num_states, set_size, num_actions), m.REPEATS.value)
    for name, timing in timings.items():
        how = f"B = {num_states}, m = {set_size}, A = {num_actions}; whole batch at once"
        report.timing(f"layer {name}", timing, work={"states": num_states}, how=how)
    for direction in ("forward", "forward and backward"):
        slow, fast = (timings[f"{form}, {direction}"] for form in reversed(FORMS))
        report.values(f"concatenated / factored, {direction}", m.ratio(slow, fast), how=RATIO)


def report_microbatches(report: m.Report) -> None:
    num_transitions, sizes, default = (32, (0, 8), 8) if m.QUICK.value else (4096, SIZES, 256)
    trainer = _trainers.make_trainer()
    variants = {str(size): (UtilityMethod(), size) for size in sizes}
    timings = m.measure(gradient_subjects(trainer, variants, num_transitions), m.REPEATS.value)
    shapes = f"minibatch of {num_transitions}, 0: undivided; {_trainers.describe(trainer)}"
    for name, timing in timings.items():
        work = {"transitions": num_transitions}
        report.timing(f"gradient, microbatches of {name}", timing, work=work, how=shapes)
    for name, timing in timings.items():
        values = m.ratio(timing, timings[str(default)])
        report.values(f"microbatches of {name} / of {default}", values, how=RATIO)


def report_projection(report: m.Report) -> None:
    """Forms of the layer within the learner's gradient; small minibatches keep m = 250 short."""
    num_transitions, size = (16, 8) if m.QUICK.value else (2048, 128)
    variants = {name: (method(), size) for name, method in METHODS.items()}
    for set_size in (5,) if m.QUICK.value else SET_SIZES:
        trainer = _trainers.make_trainer(set_size)
        timings = m.measure(gradient_subjects(trainer, variants, num_transitions), m.REPEATS.value)
        how = f"minibatch of {num_transitions}, microbatches of {size}, m = {set_size}"
        for name, timing in timings.items():
            work = {"transitions": num_transitions}
            report.timing(f"gradient, {name}, m = {set_size}", timing, work=work, how=how)
        first, *others = METHODS
        for name in others:
            values = m.ratio(timings[name], timings[first])
            report.values(f"({name}) / ({first}), m = {set_size}", values, how=RATIO)


def main() -> None:
    report = m.Report("utility")
    report_layer(report)
    report_microbatches(report)
    report_projection(report)


if __name__ == "__main__":
    m.run_benchmark(main)
