"""Rollouts of environments that run inside jit: one scan over vmapped steps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxnew.environment import Environment, Info
from jaxnew.policy import PolicyMethod, distribution_and_value
from jaxnew.rollout.batch import RolloutBatch
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import ActionPool, AvailableSet, draw_sets, whole_pool


@dataclass(frozen=True)
class RolloutConfig:
    """Shapes and rules of a rollout; all static.

    Attributes:
      num_envs: N, parallel environments.
      num_steps: T, steps of each per update.
      set_size: m, actions available in an episode.
      padded_set_size: width of the sets; entries past `set_size` are masked. 0 means `set_size`.
      has_fixed_set: the whole pool is available in every episode; the two sizes are not used.
      normalize_observations: running normalisation (vector-state domains).
      freezes_observation_statistics: the statistics that `init` is given are never updated.
      normalize_rewards: division by the running deviation of the discounted return.
      bootstraps_time_limits: value the final observation of truncated episodes; needed only if the
        learner does not treat time limits as ends.
    """

    num_envs: int = 32
    num_steps: int = 512
    set_size: int = 50
    padded_set_size: int = 0
    has_fixed_set: bool = False
    normalize_observations: bool = True
    freezes_observation_statistics: bool = False
    normalize_rewards: bool = True
    bootstraps_time_limits: bool = False

    def __post_init__(self) -> None:
        for field in ("num_envs", "num_steps", "set_size"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field}={getattr(self, field)} must be at least 1.")
        if self.padded_set_size and self.padded_set_size < self.set_size:
            raise ValueError(
                f"padded_set_size={self.padded_set_size} is below set_size={self.set_size}; "
                "use 0 for no padding."
            )


@struct.dataclass
class RolloutState:
    """Everything that goes on from one rollout to the next.

    Attributes:
      env_state: environment states, [N, ...].
      observation: f32[N, ...] next input of the policy.
      available: sets [N, m] in force, or the fixed set [n].
      observation_statistics: running statistics of raw observations.
      return_statistics: running statistics of discounted returns.
      discounted_return: f32[N] return of the running episodes, for `return_statistics`.
    """

    env_state: Any
    observation: jax.Array
    available: AvailableSet
    observation_statistics: RunningStatistics
    return_statistics: RunningStatistics
    discounted_return: jax.Array


_STOCK_EPISODES = 16


@struct.dataclass
class _Stock:
    """Sets that were drawn together, since many small draws inside a scan cost far more.

    Attributes:
      sets: [K, m], dealt from the first on.
      num_dealt: int32[] how many of them are gone.
      num_draws: int32[] stocks drawn so far in this rollout.
    """

    sets: AvailableSet
    num_dealt: jax.Array
    num_draws: jax.Array

    def deal(self, done: jax.Array, available: AvailableSet) -> tuple[_Stock, AvailableSet]:
        """Sets [N, m] for the next step: the next ones of the stock where `done` bool[N]."""
        place = self.num_dealt + jnp.cumsum(done) - done
        dealt = jax.tree.map(
            lambda stocked, old: jnp.where(done[:, None], stocked[place], old), self.sets, available
        )
        return replace(self, num_dealt=self.num_dealt + jnp.sum(done)), dealt


@dataclass(frozen=True)
class DeviceRollout:
    """Draws sets, acts and steps; see `RolloutConfig`."""

    env: Environment
    env_params: Any
    method: PolicyMethod
    config: RolloutConfig

    def init(
        self,
        key: jax.Array,
        pool: ActionPool,
        observation_statistics: RunningStatistics | None = None,
    ) -> RolloutState:
        """Starts every environment, from fresh statistics or from given ones; consumes `key`."""
        key_reset, key_sets = jax.random.split(key)
        keys = jax.random.split(key_reset, self.config.num_envs)
        raw_obs, env_state = jax.vmap(self.env.reset, in_axes=(0, None))(keys, self.env_params)
        statistics = observation_statistics or RunningStatistics.zeros(raw_obs.shape[1:])
        obs, statistics = self._observe(raw_obs, statistics)
        return RolloutState(
            env_state=env_state,
            observation=obs,
            available=whole_pool(pool)
            if self.config.has_fixed_set
            else self._draw(key_sets, (self.config.num_envs,), pool),
            observation_statistics=statistics,
            return_statistics=RunningStatistics.zeros(()),
            discounted_return=jnp.zeros(self.config.num_envs),
        )

    def collect(
        self,
        key: jax.Array,
        state: RolloutState,
        params: Any,
        table: jax.Array,
        pool: ActionPool,
        discount: jax.Array | float,
    ) -> tuple[RolloutState, RolloutBatch, dict[str, jax.Array]]:
        """`num_steps` steps of every environment.

        Args:
          key: consumed.
          state: where the last rollout ended.
          params: of the policy.
          table: f32[A, d] representations.
          pool: actions that the sets of new episodes are drawn from.
          discount: gamma of the return that scales rewards.

        Returns:
          The next state, the batch, and sums over the episodes that ended: `num_episodes` and each
          of the environment's `episode_metrics`.
        """
        key_sets, key_steps = jax.random.split(key)
        shape = (self.config.num_steps, self.config.num_envs)
        key_samples, key_envs = jax.random.split(key_steps)
        keys = (jax.random.split(key_samples, shape[0]), jax.random.split(key_envs, shape))
        if self.config.has_fixed_set:
            projected = self.method.project(params, table[state.available.ids])
            stock = None
        else:
            projected = self.method.project(params, table)
            stock = self._restocked(key_sets, jnp.int32(0), pool)

        def step(
            carry: tuple[RolloutState, _Stock | None], keys: tuple[jax.Array, jax.Array]
        ) -> tuple[tuple[RolloutState, _Stock | None], tuple[RolloutBatch, jax.Array, Info]]:
            state, stock = carry
            rows = projected if stock is None else projected[state.available.ids]
            state, outputs = self._step(keys, state, params, table, rows, discount)
            if stock is not None:
                stock = self._with_enough(stock, key_sets, pool)
                stock, available = stock.deal(outputs[0].done, state.available)
                state = replace(state, available=available)
            return (state, stock), outputs

        (state, _), (batch, final_values, info) = jax.lax.scan(step, (state, stock), keys)
        last_value = self.method.value(params, state.observation)
        next_value = jnp.concatenate([batch.value[1:], last_value[None]])
        batch = replace(batch, next_value=jnp.where(batch.done, final_values, next_value))
        sums = {
            name: jnp.sum(jnp.where(batch.done, info[name], 0.0))
            for name in self.env.episode_metrics
        }
        return state, batch, {"num_episodes": jnp.sum(batch.done.astype(jnp.float32)), **sums}

    def _step(
        self,
        keys: tuple[jax.Array, jax.Array],
        state: RolloutState,
        params: Any,
        table: jax.Array,
        projected: jax.Array,
        discount: jax.Array | float,
    ) -> tuple[RolloutState, tuple[RolloutBatch, jax.Array, Info]]:
        """One step; the sets of the next state are still those of this one."""
        key_sample, keys_env = keys
        distribution, value = distribution_and_value(
            self.method, params, state.observation, projected, state.available.mask
        )
        sample = distribution.sample(key_sample)
        raw_obs, env_state, reward, terminated, truncated, info = jax.vmap(
            self.env.step, in_axes=(0, 0, 0, None)
        )(
            keys_env,
            state.env_state,
            self.method.decode(sample, state.available, table),
            self.env_params,
        )
        done = terminated | truncated
        obs, observation_statistics = self._observe(raw_obs, state.observation_statistics)
        final_value = jnp.zeros_like(value)
        if self.config.bootstraps_time_limits:
            final_obs = self._normalize(info["final_observation"], observation_statistics)
            final_value = self.method.value(params, final_obs)
        scaled_reward, discounted_return, return_statistics = self._scale_reward(
            reward, state, done, discount
        )
        batch = RolloutBatch(
            observation=state.observation,
            available=None if self.config.has_fixed_set else state.available,
            sample=sample,
            log_prob=distribution.log_prob(sample),
            value=value,
            next_value=final_value,
            reward=scaled_reward,
            terminated=terminated,
            done=done,
        )
        next_state = RolloutState(
            env_state=env_state,
            observation=obs,
            available=state.available,
            observation_statistics=observation_statistics,
            return_statistics=return_statistics,
            discounted_return=discounted_return,
        )
        episode_info = {name: info[name] for name in self.env.episode_metrics}
        return next_state, (batch, final_value, episode_info)

    def _restocked(self, key: jax.Array, num_draws: jax.Array, pool: ActionPool) -> _Stock:
        """`_STOCK_EPISODES` sets per environment, in one batched draw."""
        key = jax.random.fold_in(key, num_draws)
        sets = self._draw(key, (_STOCK_EPISODES * self.config.num_envs,), pool)
        return _Stock(sets, jnp.int32(0), num_draws + 1)

    def _with_enough(self, stock: _Stock, key: jax.Array, pool: ActionPool) -> _Stock:
        """The stock, or a new one if this one could run out in a step.

        A loop that runs at most once, not `cond`: under `vmap` that would draw at every step.
        """
        num_envs = self.config.num_envs

        def runs_out(stock: _Stock) -> jax.Array:
            return stock.num_dealt + num_envs > _STOCK_EPISODES * num_envs

        return jax.lax.while_loop(
            runs_out, lambda stock: self._restocked(key, stock.num_draws, pool), stock
        )

    def _draw(self, key: jax.Array, shape: tuple[int, ...], pool: ActionPool) -> AvailableSet:
        keys = jax.random.split(key, shape)
        return draw_sets(keys, pool, self.config.set_size, self.config.padded_set_size or None)

    def _observe(
        self, raw_obs: jax.Array, statistics: RunningStatistics
    ) -> tuple[jax.Array, RunningStatistics]:
        """Updates the statistics with a batch and normalises it with the result."""
        if self.config.normalize_observations and not self.config.freezes_observation_statistics:
            statistics = statistics.update(raw_obs)
        return self._normalize(raw_obs, statistics), statistics

    def _normalize(self, raw_obs: jax.Array, statistics: RunningStatistics) -> jax.Array:
        return statistics.normalize(raw_obs) if self.config.normalize_observations else raw_obs

    def _scale_reward(
        self, reward: jax.Array, state: RolloutState, done: jax.Array, discount: jax.Array | float
    ) -> tuple[jax.Array, jax.Array, RunningStatistics]:
        """Spec method 5.1: rewards over the running deviation of the discounted return."""
        discounted_return = discount * state.discounted_return + reward
        statistics = state.return_statistics
        if self.config.normalize_rewards:
            statistics = statistics.update(discounted_return)
            reward = statistics.scale(reward)
        return reward, jnp.where(done, 0.0, discounted_return), statistics
