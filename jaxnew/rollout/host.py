"""Rollouts of environments that run on the host, in halves that overlap.

While one half simulates, the policy looks at the other. Everything that was sent is received before
a rollout ends, so every decision is that of the newest parameters, and a checkpoint finds the pool
at rest. The numbers depend on the keys alone, not on halves, workers or timing.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnew.policy import PolicyMethod, method_of_evaluations
from jaxnew.rollout.acting import (
    WIDTH,
    Acting,
    Actor,
    fold_in_each,
    half_of,
    in_blocks,
    observation_of,
)
from jaxnew.rollout.contract import Episode, Policy, RolloutBatch, RolloutConfig
from jaxnew.rollout.frames import FrameHistory
from jaxnew.rollout.host_episodes import EpisodePlayer
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.rollout.pool import HostEnvironments, HostStep, PoolState
from jaxnew.sampling import Actions, AvailableSet
from jaxnew.storage.metrics import TIME_PREFIX


@struct.dataclass
class HostRolloutState:
    """Everything that goes on from one rollout to the next.

    Attributes:
      environments: state of the pool, NumPy.
      frames: [k, N, ...] what was observed last, newest last; NumPy.
      age: int32[N] steps since the episode's start, at most k - 1; NumPy.
      available: sets [N, m] in force, or the fixed set [n].
      observation_statistics: None; observations are not normalised.
    """

    environments: PoolState
    frames: np.ndarray
    age: np.ndarray
    available: AvailableSet
    observation_statistics: None = None


class _Record:
    """What happens in one rollout of T steps, filled row by row."""

    def __init__(self, state: HostRolloutState, num_steps: int, metrics: tuple[str, ...]) -> None:
        k, num_envs = state.frames.shape[:2]
        self.k, self.num_steps = k, num_steps
        # Row t + k - 1 is what is new at step t; the last row is there for the next rollout.
        self.frames = np.zeros((num_steps + k, *state.frames.shape[1:]), state.frames.dtype)
        self.frames[:k] = state.frames
        self.age = np.zeros((num_steps + 1, num_envs), np.int32)
        self.age[0] = state.age
        shape = (num_steps, num_envs)
        self.reward = np.zeros(shape, np.float32)
        self.terminated, self.done = np.zeros(shape, bool), np.zeros(shape, bool)
        self.final_value = np.zeros(shape, np.float32)
        self.acting: list[list[Acting]] = [[] for _ in range(num_steps)]
        # In float64, and by step and environment: sums do not depend on the order of arrival.
        self.metrics = {name: np.zeros(shape) for name in metrics}

    def last_frames(self, t: int, envs: np.ndarray) -> np.ndarray:
        """[k, n, ...] what the policy sees at step t, newest last."""
        return self.frames[t : t + self.k, envs]

    def receive(self, t: int, rows: slice, step: HostStep) -> np.ndarray:
        """Keeps what came of step t; returns bool[n] whether the episode ended."""
        done = np.asarray(step.terminated) | np.asarray(step.truncated)
        self.frames[t + self.k, rows] = step.observations
        self.age[t + 1, rows] = np.where(done, 0, np.minimum(self.age[t, rows] + 1, self.k - 1))
        self.reward[t, rows] = step.rewards
        self.terminated[t, rows], self.done[t, rows] = step.terminated, done
        for name, values in self.metrics.items():
            values[t, rows] = np.where(done, step.metrics[name], 0.0)
        return done

    def sums(self) -> dict[str, np.float32]:
        """Over the episodes that ended."""
        sums = {name: np.float32(values.sum()) for name, values in self.metrics.items()}
        return {"num_episodes": np.float32(self.done.sum()), **sums}


@dataclass(frozen=True)
class HostRollout:
    """Draws sets, acts, and has a pool of host environments step; see `RolloutConfig`.

    Attributes:
      environments: the pool; its number of environments is that of `config`.
      method: the policy.
      config: without normalisation: rewards are raw, and images are scaled by the network.
      observation: shape and dtype of one observation as the policy sees it.
      width: environments that the policy looks at together.

    Raises:
      ValueError: `config` asks for normalisation.
    """

    environments: HostEnvironments
    method: PolicyMethod
    config: RolloutConfig
    observation: jax.ShapeDtypeStruct
    width: int = WIDTH
    is_traced = False

    def __post_init__(self) -> None:
        if self.config.normalize_observations or self.config.normalize_rewards:
            raise ValueError(
                "Host rollouts normalise neither observations nor rewards; set "
                "ppo.rollout.normalize_observations and ppo.rollout.normalize_rewards to False."
            )

    @property
    def max_episode_steps(self) -> int:
        """Length of the longest episode."""
        return self.environments.max_episode_steps

    @property
    def episode_metrics(self) -> tuple[str, ...]:
        """Those of the pool."""
        return self.environments.pool.episode_metrics

    def init(
        self, key: jax.Array, actions: Actions, statistics: RunningStatistics | None = None
    ) -> HostRolloutState:
        """Starts every environment; consumes `key`. There are no statistics to go on with."""
        del statistics
        num_envs = self.config.num_envs
        if self.environments.pool.num_envs != num_envs:
            raise ValueError(
                f"The pool has {self.environments.pool.num_envs} environments, the rollout "
                f"num_envs={num_envs}; make a pool of as many."
            )
        observations = self.environments.start()
        k = self.environments.stack_size
        frames = np.zeros((k, *observations.shape), self.environments.pool.observation_dtype)
        frames[-1] = observations
        return HostRolloutState(
            environments=self.environments.leave(),
            frames=frames,
            age=np.zeros(num_envs, np.int32),
            available=actions.draw(fold_in_each(key, jnp.arange(num_envs, dtype=jnp.int32))),
        )

    def collect(
        self,
        key: jax.Array,
        state: HostRolloutState,
        params: Any,
        actions: Actions,
        discount: jax.Array | float,
    ) -> tuple[HostRolloutState, RolloutBatch, dict[str, np.float32]]:
        """`num_steps` steps of every environment; see `Rollout.collect`.

        The batch is in NumPy. Step t of environment n acts from `fold_in(fold_in(key, t), n)`. The
        sums have `time/act_s` and `time/wait_s`, too: seconds in which the policy chose, and in
        which it waited for the pool. Rewards are not scaled, so that `discount` is not read.
        """
        del discount
        key_sets, key_samples = jax.random.split(key)
        run = _Run(self, state, params, actions, key_sets, key_samples)
        self.environments.resume(state.environments)
        run.play()
        k, record = run.record.k, run.record
        next_state = HostRolloutState(
            environments=self.environments.leave(),
            frames=record.frames[-k:].copy(),
            age=record.age[-1].copy(),
            available=state.available
            if actions.is_fixed
            else AvailableSet(jnp.asarray(run.set_ids), state.available.mask),
        )
        return next_state, run.batch(), record.sums() | run.seconds()

    def measure(
        self,
        policy: Policy,
        actions: Actions,
        key: jax.Array,
        num_episodes: int,
        is_greedy: bool = False,
    ) -> dict[str, np.ndarray]:
        """Plays episodes `0..num_episodes-1`; see `Rollout.measure`."""
        return self._player.play(policy, actions, key, num_episodes, is_greedy).results

    def episodes(
        self,
        policy: Policy,
        actions: Actions,
        key: jax.Array,
        first: int,
        count: int,
        is_greedy: bool = False,
    ) -> list[Episode]:
        """Episodes `first..first+count-1`; see `Rollout.episodes`. Those before are played, too."""
        played = self._player.play(policy, actions, key, first + count, is_greedy, keeps_all=True)
        numbers = range(first, first + count)
        return [played.episode(number, key, actions.set_size) for number in numbers]

    def close(self) -> None:
        """Ends the pool."""
        self.environments.close()

    @cached_property
    def _player(self) -> EpisodePlayer:
        return EpisodePlayer(self.environments, method_of_evaluations(self.method), self.width)

    @cached_property
    def draw_next(self) -> Any:
        """(key, actions) -> sets [T, N, m], one for every step that may end an episode."""

        @jax.jit
        def draw(key: jax.Array, actions: Actions) -> AvailableSet:
            steps = fold_in_each(key, jnp.arange(self.config.num_steps, dtype=jnp.int32))
            envs = jnp.arange(self.config.num_envs, dtype=jnp.int32)
            return actions.draw(jax.vmap(lambda key: fold_in_each(key, envs))(steps))

        return draw

    @cached_property
    def project(self) -> Any:
        """`method.project`, compiled."""
        return jax.jit(self.method.project)

    @cached_property
    def act(self) -> Any:
        """`Actor.act` from the rollout's key, the step and the environments' numbers."""

        @jax.jit
        def act(
            params: Any,
            projected: jax.Array,
            actions: Actions,
            key: jax.Array,
            t: jax.Array,
            envs: jax.Array,
            observation: jax.Array,
            available: AvailableSet,
        ) -> Acting:
            keys = fold_in_each(jax.random.fold_in(key, t), envs)
            actor = Actor(self.method)
            return actor.act(params, projected, actions, keys, observation, available)

        return act

    @cached_property
    def value(self) -> Any:
        """`method.value`, compiled."""
        return jax.jit(self.method.value)


class _Run:
    """One rollout while it is played."""

    def __init__(
        self,
        rollout: HostRollout,
        state: HostRolloutState,
        params: Any,
        actions: Actions,
        key_sets: jax.Array,
        key_samples: jax.Array,
    ) -> None:
        self.rollout, self.params, self.actions, self.key = rollout, params, actions, key_samples
        self.config, self.environments = rollout.config, rollout.environments
        self.pool = rollout.environments.pool
        self.has_stacks = rollout.environments.has_stacks
        self.record = _Record(state, self.config.num_steps, self.pool.episode_metrics)
        self.act_s, self.wait_s = 0.0, 0.0
        self.projected = rollout.project(params, actions.offered(state.available))
        self.fixed_set = state.available
        if not actions.is_fixed:
            self.set_ids = np.array(state.available.ids)
            self.mask = np.asarray(state.available.mask)
            self.next_ids = np.asarray(rollout.draw_next(key_sets, actions).ids)
            self.all_ids = np.zeros_like(self.next_ids)

    def rows(self, half: int) -> slice:
        return half_of(half, self.config.num_envs, self.pool.num_halves)

    def play(self) -> None:
        """Acts and receives in turns; every half is at rest when it returns."""
        halves = range(self.pool.num_halves)
        for half in halves:
            self._act(0, half)
        for t in range(self.config.num_steps):
            for half in halves:
                self._receive(t, half)
                if t + 1 < self.config.num_steps:
                    self._act(t + 1, half)

    def seconds(self) -> dict[str, np.float32]:
        """Where this process spent its time, of what can be told apart."""
        spent = {"act_s": self.act_s, "wait_s": self.wait_s}
        return {TIME_PREFIX + name: np.float32(seconds) for name, seconds in spent.items()}

    def _act(self, t: int, half: int) -> None:
        start = time.perf_counter()
        rows = self.rows(half)
        if not self.actions.is_fixed:
            self.all_ids[t, rows] = self.set_ids[rows]
        acting = self._in_blocks(rows, partial(self._act_in, t))
        self.record.acting[t].append(acting)
        self.pool.send(half, acting.ids, acting.positions)
        self.act_s += time.perf_counter() - start

    def _act_in(self, t: int, envs: np.ndarray) -> Acting:
        available = self.fixed_set
        if not self.actions.is_fixed:
            available = self._sets(self.set_ids[envs], self.mask[envs])
        acting: Acting = self.rollout.act(
            self.params,
            self.projected,
            self.actions,
            self.key,
            np.int32(t),
            envs.astype(np.int32),
            self._observation(t, envs),
            available,
        )
        return acting

    def _receive(self, t: int, half: int) -> None:
        rows = self.rows(half)
        start = time.perf_counter()
        step = self.pool.receive(half)
        self.wait_s += time.perf_counter() - start
        done = self.record.receive(t, rows, step)
        if self.config.bootstraps_time_limits and np.any(step.truncated):
            self.record.final_value[t, rows] = self._final_value(t, rows, step)
        if not self.actions.is_fixed:
            self.set_ids[rows] = np.where(done[:, None], self.next_ids[t, rows], self.set_ids[rows])

    def _final_value(self, t: int, rows: slice, step: HostStep) -> np.ndarray:
        """f32[n] values of what the step really produced."""
        record = self.record
        frames = record.frames[t + 1 : t + 1 + record.k].copy()
        frames[-1, rows] = step.final_observations
        age = np.minimum(record.age[t] + 1, record.k - 1)

        def value(envs: np.ndarray) -> Any:
            observation = observation_of(frames[:, envs], age[envs], self.has_stacks)
            return self.rollout.value(self.params, observation)

        return np.asarray(self._in_blocks(rows, value))

    def _observation(self, t: int, envs: np.ndarray) -> np.ndarray:
        record = self.record
        return observation_of(record.last_frames(t, envs), record.age[t, envs], self.has_stacks)

    def _in_blocks(self, rows: slice, function: Any) -> Any:
        return in_blocks(function, rows, self.config.num_envs, self.rollout.width)

    def batch(self) -> RolloutBatch:
        """What was recorded, for the learner."""
        record, num_steps = self.record, self.config.num_steps
        steps = [jax.tree.map(lambda *x: np.concatenate(x), *halves) for halves in record.acting]
        acting: Acting = jax.tree.map(lambda *x: np.stack(x), *steps)
        last_value = self._in_blocks(
            slice(0, self.config.num_envs),
            lambda envs: self.rollout.value(self.params, self._observation(num_steps, envs)),
        )
        next_value = np.concatenate([acting.value[1:], last_value[None]])
        fields: dict[str, Any] = {
            "observation": record.frames[:-1],
            "available": self.fixed_set,
            "next_value": np.where(record.done, record.final_value, next_value),
            "reward": record.reward,
            "terminated": record.terminated,
            "done": record.done,
        }
        if self.has_stacks:
            fields["observation"] = FrameHistory(record.frames[:-1], record.age[:-1])
        if not self.actions.is_fixed:
            fields["available"] = self._sets(self.all_ids, self.mask)
        return RolloutBatch(
            sample=acting.sample,
            log_prob=acting.log_prob,
            value=acting.value,
            **fields,
        )

    @staticmethod
    def _sets(ids: Any, mask: Any) -> AvailableSet:
        return AvailableSet(ids, np.broadcast_to(mask, ids.shape))  # type: ignore[arg-type]
