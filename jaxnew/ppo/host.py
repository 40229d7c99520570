"""Learning from environments on the host: a rollout beside the same gradient steps."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp

from jaxnew.metrics import TIME_PREFIX
from jaxnew.ppo.gradient import GradientSteps, Metrics, TrainState
from jaxnew.ppo.learner import reduce_metrics
from jaxnew.ppo.objective import Hyperparameters
from jaxnew.rollout.host import HostRollout
from jaxnew.sampling import ActionPool


@dataclass(frozen=True)
class HostLearner(GradientSteps):
    """The training step of one method in a pool of host environments.

    `init`, `update` and `updates` drive the pool and are not to be compiled; the gradient steps of
    an update are one compiled function.
    """

    rollout: HostRollout

    def init(self, key: jax.Array, table: jax.Array, pool: ActionPool) -> TrainState:
        """A fresh run, as `Learner.init`; starts every environment and consumes `key`."""
        key_run, key_params, key_rollout = jax.random.split(key, 3)
        rollout = self.rollout.init(key_rollout, pool)
        observation = self.rollout.first_observation(rollout)
        make = jax.jit(self.init_state, static_argnums=3)
        return make(key_run, key_params, observation, table.shape[-1], None).replace(
            rollout=rollout
        )

    def update(
        self,
        state: TrainState,
        hyperparameters: Hyperparameters,
        table: jax.Array,
        pool: ActionPool,
    ) -> tuple[TrainState, Metrics]:
        """One rollout and the gradient steps on it; see `Learner.update`.

        Beside its metrics, `time/rollout_s` and `time/learn_s`, the seconds of the two parts, and
        those of `HostRollout.collect`.
        """
        start = time.perf_counter()
        key_rollout, key_learn = jax.random.split(jax.random.fold_in(state.key, state.step))
        rollout, batch, sums = self.rollout.collect(
            key_rollout, state.rollout, state.params, table, pool
        )
        collected = time.perf_counter()
        params, opt_state, metrics = jax.block_until_ready(
            self._learn(
                key_learn,
                state.params,
                state.opt_state,
                batch,
                hyperparameters,
                table,
                state.step,
                rollout.available if batch.available is None else None,
            )
        )
        for name, value in sums.items():
            key = name if name.startswith(TIME_PREFIX) else f"episodes/{name}"
            metrics[key] = jnp.asarray(value)
        metrics = {
            **metrics,
            f"{TIME_PREFIX}rollout_s": jnp.float32(collected - start),
            f"{TIME_PREFIX}learn_s": jnp.float32(time.perf_counter() - collected),
        }
        return TrainState(params, opt_state, rollout, state.key, state.step + 1), metrics

    def updates(
        self,
        state: TrainState,
        hyperparameters: Hyperparameters,
        table: jax.Array,
        pool: ActionPool,
        num_updates: int,
    ) -> tuple[TrainState, Metrics]:
        """`num_updates` times `update`, and the metrics over all of them; see `Learner.updates`."""
        collected: list[Metrics] = []
        for _ in range(num_updates):
            state, metrics = self.update(state, hyperparameters, table, pool)
            collected.append(metrics)
        stacked = jax.tree.map(lambda *values: jnp.stack(values), *collected)
        return state, reduce_metrics(stacked)

    @cached_property
    def _learn(self) -> Any:
        return jax.jit(self.learn)
