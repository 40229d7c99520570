"""Proximal policy optimisation over changing action sets (paper algorithm 1, spec method 6)."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxnew.ppo.config import PPOConfig
from jaxnew.ppo.gradient import GradientSteps, Metrics, TrainState
from jaxnew.ppo.objective import Hyperparameters
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import ActionPool

__all__ = ["Learner", "PPOConfig", "TrainState", "reduce_metrics"]


@dataclass(frozen=True)
class Learner(GradientSteps):
    """The training step of one method in one environment that runs inside jit.

    All methods are pure; `update` and `init` may be vmapped over members of a sweep.
    """

    rollout: DeviceRollout

    def init(self, key: jax.Array, table: jax.Array, pool: ActionPool) -> TrainState:
        """A fresh run; consumes `key`."""
        key_run, key_params, key_rollout = jax.random.split(key, 3)
        rollout = self.rollout.init(key_rollout, pool)
        return self.init_state(
            key_run, key_params, rollout.observation[0], table.shape[-1], rollout
        )

    def update(
        self,
        state: TrainState,
        hyperparameters: Hyperparameters,
        table: jax.Array,
        pool: ActionPool,
    ) -> tuple[TrainState, Metrics]:
        """One rollout and the gradient steps on it.

        Args:
          state: of the run.
          hyperparameters: traced numbers.
          table: f32[A, d] representations.
          pool: actions that sets are drawn from.

        Returns:
          The next state and scalars: `episodes/...` are sums over the episodes that ended,
          `nonfinite/...` counts, the rest means over the gradient steps.
        """
        key_rollout, key_learn = jax.random.split(jax.random.fold_in(state.key, state.step))
        rollout, batch, sums = self.rollout.collect(
            key_rollout, state.rollout, state.params, table, pool, hyperparameters.discount
        )
        params, opt_state, metrics = self.learn(
            key_learn,
            state.params,
            state.opt_state,
            batch,
            hyperparameters,
            table,
            state.step,
            rollout.available if batch.available is None else None,
        )
        metrics |= {f"episodes/{name}": value for name, value in sums.items()}
        next_state = TrainState(params, opt_state, rollout, state.key, state.step + 1)
        return next_state, metrics

    def updates(
        self,
        state: TrainState,
        hyperparameters: Hyperparameters,
        table: jax.Array,
        pool: ActionPool,
        num_updates: int,
    ) -> tuple[TrainState, Metrics]:
        """`num_updates` (static) times `update`, and the metrics over all of them.

        `episode/...` are means over the episodes that ended, NaN if none did.
        """

        def body(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
            return self.update(state, hyperparameters, table, pool)

        state, stacked = jax.lax.scan(body, state, None, length=num_updates)
        return state, reduce_metrics(stacked)


def reduce_metrics(stacked: Metrics) -> Metrics:
    """Metrics of several updates, f32[n] each, as one f32[] each; see `Learner.updates`."""
    reduced = {
        name: jnp.sum(values) if name.startswith("nonfinite/") else jnp.mean(values)
        for name, values in stacked.items()
        if not name.startswith("episodes/")
    }
    num_episodes = jnp.sum(stacked["episodes/num_episodes"])
    for name, values in stacked.items():
        if name.startswith("episodes/") and name != "episodes/num_episodes":
            mean = jnp.sum(values) / jnp.maximum(num_episodes, 1.0)
            key = name.replace("episodes/", "episode/")
            reduced[key] = jnp.where(num_episodes > 0, mean, jnp.nan)
    return reduced | {"num_episodes": num_episodes}
