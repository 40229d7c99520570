"""Rollouts of environments that run inside jit: one scan over vmapped steps.

An episode that is played for its own sake, episode `i`, draws its set, its start and its actions
from `fold_in(key, i)`, and inference runs at one width, so that it is the same however many others
are played beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnew.environment import Environment, Info
from jaxnew.policy import PolicyMethod, distribution_and_value, method_of_evaluations
from jaxnew.rollout.contract import Episode, Policy, RolloutBatch, RolloutConfig
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import Actions, AvailableSet


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


def _number(name: str, info: Info, t: jax.Array) -> jax.Array:
    """A metric of an episode after its step t, f32."""
    return jnp.asarray(t + 1 if name == "num_steps" else info[name], jnp.float32)


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
        ends = done.astype(jnp.int32)
        place = self.num_dealt + jnp.cumsum(ends, dtype=jnp.int32) - ends
        dealt = jax.tree.map(
            lambda stocked, old: jnp.where(done[:, None], stocked[place], old), self.sets, available
        )
        return replace(self, num_dealt=self.num_dealt + jnp.sum(ends, dtype=jnp.int32)), dealt


@dataclass(frozen=True)
class DeviceRollout:
    """Draws sets, acts and steps, all pure; see `jaxnew.rollout.contract.Rollout`.

    Attributes:
      env, env_params: the task, with concrete parameters.
      method: the policy.
      config: shapes and rules.
      width: episodes that `measure` and `episodes` play at a time.
    """

    env: Environment
    env_params: Any
    method: PolicyMethod
    config: RolloutConfig
    width: int = 128
    is_traced = True

    @property
    def max_episode_steps(self) -> int:
        """Length of the longest episode."""
        return self.env.max_episode_steps(self.env_params)

    @property
    def episode_metrics(self) -> tuple[str, ...]:
        """Those of the environment."""
        return self.env.episode_metrics

    @property
    def observation(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of one observation as the policy sees it."""
        raw, _ = jax.eval_shape(self.env.reset, jax.random.key(0), self.env_params)
        dtype = jnp.float32 if self.config.normalize_observations else raw.dtype
        return jax.ShapeDtypeStruct(raw.shape, dtype)

    def init(
        self, key: jax.Array, actions: Actions, statistics: RunningStatistics | None = None
    ) -> RolloutState:
        """Starts every environment, from fresh statistics or from given ones; consumes `key`."""
        key_reset, key_sets = jax.random.split(key)
        keys = jax.random.split(key_reset, self.config.num_envs)
        raw_obs, env_state = jax.vmap(self.env.reset, in_axes=(0, None))(keys, self.env_params)
        statistics = statistics or RunningStatistics.zeros(raw_obs.shape[1:])
        obs, statistics = self._observe(raw_obs, statistics)
        return RolloutState(
            env_state=env_state,
            observation=obs,
            available=actions.draw(jax.random.split(key_sets, self.config.num_envs)),
            observation_statistics=statistics,
            return_statistics=RunningStatistics.zeros(()),
            discounted_return=jnp.zeros(self.config.num_envs, jnp.float32),
        )

    def collect(
        self,
        key: jax.Array,
        state: RolloutState,
        params: Any,
        actions: Actions,
        discount: jax.Array | float,
    ) -> tuple[RolloutState, RolloutBatch, dict[str, jax.Array]]:
        """`num_steps` steps of every environment; see `Rollout.collect`."""
        key_sets, key_steps = jax.random.split(key)
        shape = (self.config.num_steps, self.config.num_envs)
        key_samples, key_envs = jax.random.split(key_steps)
        keys = (jax.random.split(key_samples, shape[0]), jax.random.split(key_envs, shape))
        projected = self.method.project(params, actions.offered(state.available))
        stock = None if actions.is_fixed else self._restocked(key_sets, jnp.int32(0), actions)

        def step(
            carry: tuple[RolloutState, _Stock | None], keys: tuple[jax.Array, jax.Array]
        ) -> tuple[tuple[RolloutState, _Stock | None], tuple[RolloutBatch, jax.Array, Info]]:
            state, stock = carry
            rows = actions.rows(projected, state.available)
            state, outputs = self._step(keys, state, params, actions, rows, discount)
            if stock is not None:
                stock = self._with_enough(stock, key_sets, actions)
                stock, available = stock.deal(outputs[0].done, state.available)
                state = replace(state, available=available)
            return (state, stock), outputs

        (state, _), (batch, final_values, info) = jax.lax.scan(step, (state, stock), keys)
        last_value = self.method.value(params, state.observation)
        next_value = jnp.concatenate([batch.value[1:], last_value[None]])
        batch = replace(batch, next_value=jnp.where(batch.done, final_values, next_value))
        if actions.is_fixed:
            batch = replace(batch, available=state.available)
        sums = {
            name: jnp.sum(jnp.where(batch.done, jnp.asarray(info[name], jnp.float32), 0.0))
            for name in self.env.episode_metrics
        }
        return state, batch, {"num_episodes": jnp.sum(batch.done.astype(jnp.float32)), **sums}

    def _step(
        self,
        keys: tuple[jax.Array, jax.Array],
        state: RolloutState,
        params: Any,
        actions: Actions,
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
            self.method.decode(sample, state.available, actions.table),
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
            # A fixed set is put in once, by `collect`.
            available=cast(AvailableSet, None if actions.is_fixed else state.available),
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

    def _restocked(self, key: jax.Array, num_draws: jax.Array, actions: Actions) -> _Stock:
        """`_STOCK_EPISODES` sets per environment, in one batched draw."""
        key = jax.random.fold_in(key, num_draws)
        sets = actions.draw(jax.random.split(key, _STOCK_EPISODES * self.config.num_envs))
        return _Stock(sets, jnp.int32(0), num_draws + 1)

    def _with_enough(self, stock: _Stock, key: jax.Array, actions: Actions) -> _Stock:
        """The stock, or a new one if this one could run out in a step.

        A loop that runs at most once, not `cond`: under `vmap` that would draw at every step.
        """
        num_envs = self.config.num_envs

        def runs_out(stock: _Stock) -> jax.Array:
            return stock.num_dealt + num_envs > _STOCK_EPISODES * num_envs

        return jax.lax.while_loop(
            runs_out, lambda stock: self._restocked(key, stock.num_draws, actions), stock
        )

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
        """Rewards over the running deviation of the discounted return."""
        discounted_return = discount * state.discounted_return + reward
        statistics = state.return_statistics
        if self.config.normalize_rewards:
            statistics = statistics.update(discounted_return)
            reward = statistics.scale(reward)
        return reward, jnp.where(done, 0.0, discounted_return), statistics

    def measure(
        self,
        policy: Policy,
        actions: Actions,
        key: jax.Array,
        num_episodes: int,
        is_greedy: bool = False,
    ) -> dict[str, np.ndarray]:
        """Plays episodes `0..num_episodes-1`; see `Rollout.measure`."""
        play = partial(self._play, is_greedy=is_greedy)
        blocks = [
            jax.tree.map(np.asarray, play(policy, actions, key, jnp.int32(start))[0])
            for start in range(0, num_episodes, self.width)
        ]
        return {
            name: np.concatenate([block[name] for block in blocks])[:num_episodes]
            for name in (*self.episode_metrics, "num_steps")
        }

    def episodes(
        self,
        policy: Policy,
        actions: Actions,
        key: jax.Array,
        first: int,
        count: int,
        is_greedy: bool = False,
    ) -> list[Episode]:
        """Episodes `first..first+count-1` with every state; see `Rollout.episodes`."""
        play = partial(self._play, is_greedy=is_greedy, keeps_all=True)
        found: list[Episode] = []
        for start in range(first, first + count, self.width):
            block = jax.device_get(play(policy, actions, key, jnp.int32(start)))
            found += [self._episode(block, row, start + row, actions) for row in range(self.width)]
        return found[:count]

    def play(
        self,
        policy: Policy,
        actions: Actions,
        key: jax.Array,
        start: jax.Array,
        is_greedy: bool = False,
        keeps_all: bool = False,
    ) -> tuple[dict[str, jax.Array], Any]:
        """Episodes `start..start+width-1`, pure.

        Args:
          policy, actions, key, is_greedy: see `Rollout.measure`.
          start: int32[], traced.
          keeps_all: return what happened at every step, too.

        Returns:
          f32[width] per metric at the end of each episode; and None, or the sets [width, m], the
          first states [width, ...] and, of each of the T steps of the longest episode, the states
          after it, actions and rewards [T, width, ...].
        """
        episodes = start + jnp.arange(self.width, dtype=jnp.int32)
        keys = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), 3))(episodes)
        keys_sets, keys_reset, keys_steps = keys[:, 0], keys[:, 1], keys[:, 2]
        available = actions.draw(keys_sets)
        obs, first_state = jax.vmap(self.env.reset_env, in_axes=(0, None))(
            keys_reset, self.env_params
        )
        method = method_of_evaluations(self.method)
        projected = method.project(policy.params, actions.offered(available))
        rows = actions.rows(projected, available)

        def step(carry: tuple[Any, ...], t: jax.Array) -> tuple[tuple[Any, ...], Any]:
            obs, state, is_over, metrics = carry
            if policy.observation_statistics is not None:
                obs = self._normalize(obs, policy.observation_statistics)
            now = actions.at(available, t)
            distribution = method.distribution(policy.params, obs, rows, now.mask)
            keys_now = jax.vmap(lambda k: jax.random.split(jax.random.fold_in(k, t)))(keys_steps)
            if is_greedy:
                sample = distribution.mode()
            else:
                sample = jax.vmap(lambda d, k: d.sample(k))(distribution, keys_now[:, 0])
            action = method.decode(sample, now, actions.table)
            obs, state, reward, terminated, truncated, info = jax.vmap(
                self.env.step_env, in_axes=(0, 0, 0, None)
            )(keys_now[:, 1], state, action, self.env_params)
            metrics = {
                name: jnp.where(is_over, old, _number(name, info, t))
                for name, old in metrics.items()
            }
            kept = (state, action, reward) if keeps_all else None
            return (obs, state, is_over | terminated | truncated, metrics), kept

        names = (*self.env.episode_metrics, "num_steps")
        zeros = {name: jnp.zeros(self.width, jnp.float32) for name in names}
        carry = (obs, first_state, jnp.zeros(self.width, bool), zeros)
        times = jnp.arange(self.max_episode_steps, dtype=jnp.int32)
        carry, kept = jax.lax.scan(step, carry, times)
        return carry[3], (available, first_state, *kept) if keeps_all else None

    @cached_property
    def _play(self) -> Any:
        return jax.jit(self.play, static_argnames=("is_greedy", "keeps_all"))

    @staticmethod
    def _episode(block: Any, row: int, number: int, actions: Actions) -> Episode:
        """One row of what `play` returned."""
        metrics, (available, first_state, states, played, rewards) = block
        length = int(metrics["num_steps"][row])

        def at(tree: Any, *index: int) -> Any:
            return jax.tree.map(lambda x: x[index], tree)

        ids = available.ids if actions.is_fixed else available.ids[row]
        return Episode(
            number=number,
            actions=[at(played, t, row) for t in range(length)],
            rewards=[float(rewards[t, row]) for t in range(length)],
            metrics={name: float(values[row]) for name, values in metrics.items()},
            available_ids=ids[: actions.set_size],
            states=(at(first_state, row), *(at(states, t, row) for t in range(length))),
        )

    def close(self) -> None:
        """Nothing is held."""
