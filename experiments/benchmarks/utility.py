"""The utility layer: factored or concatenated, projected before or after the gather, microbatches.

python -m experiments.benchmarks.utility
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from jaxnew.policy import Categorical, UtilityMethod
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.state_encoder import VectorEncoder
from jaxnew.policy.utility import Utility
from jaxnew.ppo import Learner
from jaxnew.rollout.device import DeviceRollout

ARGUMENTS = m.Benchmark(__doc__)

SET_SIZES = (20, 50, 250)
MICROBATCHES = (0, 64, 128, 256, 512)
# One gradient step a rollout: 32 environments make as many transitions as the minibatch has.
_ONE_STEP: dict[str, Any] = {"ppo__num_epochs": 1, "ppo__num_minibatches": 1}


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


def factored(params: Any, features: jax.Array, table: jax.Array, ids: jax.Array) -> Any:
    """Utilities of the layer alone, of the rows of a projected table."""
    projected = Utility().apply(params, table, method="project")
    policy: Any = Utility().apply(
        params, features, jnp.asarray(projected)[ids], jnp.ones(ids.shape, bool)
    )
    return policy.logits


def concatenated(params: Any, features: jax.Array, table: jax.Array, ids: jax.Array) -> Any:
    """The same as the paper writes it."""
    return Utility().apply(params, features, table[ids], method="concatenated")


def with_gradients(forward: Callable[..., Any]) -> Callable[..., Any]:
    """Also the gradients of parameters and features, for those of the utilities."""

    def both(
        params: Any, features: jax.Array, table: jax.Array, ids: jax.Array, up: jax.Array
    ) -> Any:
        utilities, pull_back = jax.vjp(lambda p, f: forward(p, f, table, ids), params, features)
        return utilities, pull_back(up)

    return both


def report_layer(report: m.Report) -> None:
    """The layer alone, from state features, a table and ids; forward, and with its gradients."""
    num_states, set_size, num_actions = (16, 5, 32) if report.is_quick else (4096, 50, 1024)

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        keys = jax.random.split(key, 5)
        features = jnp.tanh(jax.random.normal(keys[0], (num_states, NetworkConfig.state_width)))
        table = jax.random.normal(keys[1], (num_actions, _trainers.REPRESENTATION_SIZE))
        ids = jax.random.randint(keys[2], (num_states, set_size), 0, num_actions)
        params = Utility().init(keys[3], features[0], table[:1], method="concatenated")
        return params, features, table, ids, jax.random.normal(keys[4], ids.shape)

    forms = {"factored": factored, "concatenated": concatenated}
    both = "forward and backward"
    timings = report.measure(
        {f"{k}, forward": m.compiled(v, lambda key: inputs(key)[:4]) for k, v in forms.items()}
        | {f"{k}, {both}": m.compiled(with_gradients(v), inputs) for k, v in forms.items()}
    )
    for name, timing in timings.items():
        how = f"B = {num_states}, m = {set_size}, A = {num_actions}; whole batch at once"
        report.timing(f"layer {name}", timing, work={"states": num_states}, how=how)
    for direction in ("forward", both):
        slow, fast = (timings[f"{form}, {direction}"] for form in ("concatenated", "factored"))
        report.ratio(f"concatenated / factored, {direction}", slow, fast)


def report_steps(
    report: m.Report, variants: dict[str, tuple[UtilityMethod, int]], base: str, **changes: Any
) -> None:
    """A gradient step with each name -> (method, microbatch size), against that of `base`."""
    trainer = _trainers.make_trainer(report.is_quick, **_ONE_STEP, **changes)
    state, rollout, ppo = trainer.init(), trainer.rollout, trainer.config.ppo
    assert isinstance(rollout, DeviceRollout)
    timings = report.measure(
        {
            name: _trainers.learning(
                trainer,
                state,
                Learner(replace(rollout, method=method), replace(ppo, microbatch_size=size)),
            )
            for name, (method, size) in variants.items()
        }
    )
    for name, timing in timings.items():
        work, how = {"transitions": ppo.steps_per_update}, _trainers.describe(trainer)
        report.timing(f"gradient step, {name}", timing, work=work, how=how)
    for name, timing in timings.items():
        if name != base:
            report.ratio(f"({name}) / ({base})", timing, timings[base])


def main() -> None:
    report = m.Report("utility", ARGUMENTS)
    report_layer(report)
    sizes, default = ((0, 8), 8) if report.is_quick else (MICROBATCHES, 256)
    by_size = {f"microbatches of {size}": (UtilityMethod(), size) for size in sizes}
    report_steps(report, by_size, f"microbatches of {default}", ppo__rollout__num_steps=128)
    for set_size in (5,) if report.is_quick else SET_SIZES:  # Fewer steps keep m = 250 short.
        forms = {
            f"{k}, m = {set_size}": (method(), 8 if report.is_quick else 128)
            for k, method in METHODS.items()
        }
        changes = {"sets__size": set_size, "ppo__rollout__num_steps": 64}
        report_steps(report, forms, next(iter(forms)), **changes)


if __name__ == "__main__":
    ARGUMENTS.start(main)
