"""Proximal policy optimisation over changing action sets (paper algorithm 1)."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import jax
import jax.numpy as jnp

from jaxnew import finiteness
from jaxnew.ppo.gradient import GradientSteps, Metrics, TrainState
from jaxnew.ppo.objective import Hyperparameters
from jaxnew.rollout.contract import Policy
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import Actions
from jaxnew.storage.metrics import TIME_PREFIX

# Folded into the key of a run where updates fold in their number, which is never as high.
_RESTART = 2**31 - 1
_NOISE = 2  # Folded into the key of an update, which is split in two besides.


@dataclass(frozen=True)
class Learner(GradientSteps):
    """The training step of one method on a rollout.

    Of a rollout that is traced, all methods are pure: `init`, `update` and `updates` may be jitted,
    and vmapped over members of a sweep. Otherwise they drive environments on the host and are not
    to be compiled; the gradient steps of an update are one compiled function in either case.
    """

    def init(self, key: jax.Array, actions: Actions) -> TrainState:
        """A fresh run; starts every environment and consumes `key`."""
        key_run, key_params, key_rollout = jax.random.split(key, 3)
        rollout = self.rollout.init(key_rollout, actions)
        params, opt_state = self._init_policy(key_params, actions)
        return TrainState(params, opt_state, rollout, key_run, jnp.int32(0))

    def restarted(
        self, state: TrainState, actions: Actions, statistics: RunningStatistics | None
    ) -> TrainState:
        """`state` with fresh environments that go on with observation statistics of another run."""
        if not self.rollout.is_traced:
            return state  # Its environments are fresh, and there are no statistics.
        key = jax.random.fold_in(state.key, _RESTART)
        return replace(state, rollout=jax.jit(self.rollout.init)(key, actions, statistics))

    def update(
        self, state: TrainState, hyperparameters: Hyperparameters, actions: Actions
    ) -> tuple[TrainState, Metrics]:
        """One rollout and the gradient steps on it.

        Args:
          state: of the run.
          hyperparameters: traced numbers.
          actions: what is learned with.

        Returns:
          The next state and scalars: `episodes/...` are sums over the episodes that ended,
          `nonfinite/...` counts (`jaxnew.finiteness.CAUSES`), the rest means over the gradient
          steps. On the host also
          `time/rollout_s` and `time/learn_s`, the seconds of the two parts, and those of
          `Rollout.collect`.
        """
        start = time.perf_counter()
        hyperparameters = jax.tree.map(jnp.float32, hyperparameters)
        key_update = jax.random.fold_in(state.key, state.step)
        key_rollout, key_learn = jax.random.split(key_update)
        actions = actions.perturbed(
            jax.random.fold_in(key_update, _NOISE), hyperparameters.representation_noise
        )
        rollout, batch, sums = self.rollout.collect(
            key_rollout, state.rollout, state.params, actions, hyperparameters.discount
        )
        collected = time.perf_counter()
        # Inside a compiled update, as a part of it; beside the host, as a function of its own.
        learn = self.learn if self.rollout.is_traced else self._compiled_learn
        params, opt_state, metrics = learn(
            key_learn,
            state.params,
            state.opt_state,
            batch,
            hyperparameters,
            actions,
            state.step,
        )
        for name, value in sums.items():
            metrics[name if name.startswith(TIME_PREFIX) else f"episodes/{name}"] = value
        if not self.rollout.is_traced:
            jax.block_until_ready(metrics)
            metrics[f"{TIME_PREFIX}rollout_s"] = jnp.float32(collected - start)
            metrics[f"{TIME_PREFIX}learn_s"] = jnp.float32(time.perf_counter() - collected)
        next_state = TrainState(params, opt_state, rollout, state.key, state.step + 1)
        return next_state, metrics

    def updates(
        self,
        state: TrainState,
        hyperparameters: Hyperparameters,
        actions: Actions,
        num_updates: int,
    ) -> tuple[TrainState, Metrics]:
        """`num_updates` (static) times `update`, and the metrics over all of them.

        `episode/...` are means over the episodes that ended, NaN if none did; `nonfinite/...` are
        those of the first update that has any.
        """
        if self.rollout.is_traced:

            def body(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
                return self.update(state, hyperparameters, actions)

            state, stacked = jax.lax.scan(body, state, None, length=num_updates)
            return state, reduce_metrics(stacked)
        collected = []
        for _ in range(num_updates):
            state, metrics = self.update(state, hyperparameters, actions)
            collected.append({name: jnp.float32(value) for name, value in metrics.items()})
        return state, reduce_metrics(jax.tree.map(lambda *values: jnp.stack(values), *collected))

    def policy_shapes(self, actions: Actions) -> TrainState:
        """Shapes of the part of a state that acts; nothing is started, and the rest is None."""
        params, _ = jax.eval_shape(self._init_policy, jax.random.key(0), actions)
        statistics, nothing = None, cast(Any, None)
        if self.rollout.config.normalize_observations:
            shape = self.rollout.observation.shape
            statistics = jax.eval_shape(lambda: RunningStatistics.zeros(shape))
        step = cast(jax.Array, jax.ShapeDtypeStruct((), jnp.int32))
        return TrainState(params, nothing, Policy(nothing, statistics), nothing, step)

    @cached_property
    def compiled_updates(self) -> Any:
        """`updates`, compiled as far as it can be."""
        if not self.rollout.is_traced:
            return self.updates
        return jax.jit(self.updates, static_argnames="num_updates")

    @cached_property
    def compiled_init(self) -> Any:
        """`init`, likewise."""
        return jax.jit(self.init) if self.rollout.is_traced else self.init

    @cached_property
    def _init_policy(self) -> Any:
        def init(key: jax.Array, actions: Actions) -> tuple[Any, Any]:
            seen = self.rollout.observation
            observation = jnp.zeros(seen.shape, seen.dtype)
            params = self.method.init(key, observation, actions.table.shape[-1])
            return params, self.optimizer.init(params)

        return jax.jit(init)

    @cached_property
    def _compiled_learn(self) -> Any:
        return jax.jit(self.learn)


def reduce_metrics(stacked: Metrics) -> Metrics:
    """Metrics of several updates, f32[n] each, as one f32[] each; see `Learner.updates`."""
    reduced = {
        name: jnp.mean(values)
        for name, values in stacked.items()
        if not name.startswith(("episodes/", finiteness.PREFIX))
    }
    reduced |= finiteness.first(
        {name: values for name, values in stacked.items() if name.startswith(finiteness.PREFIX)}
    )
    num_episodes = jnp.sum(stacked["episodes/num_episodes"])
    for name, values in stacked.items():
        if name.startswith("episodes/") and name != "episodes/num_episodes":
            mean = jnp.sum(values) / jnp.maximum(num_episodes, 1.0)
            key = name.replace("episodes/", "episode/")
            reduced[key] = jnp.where(num_episodes > 0, mean, jnp.nan)
    return reduced | {"num_episodes": num_episodes}
