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

from jaxnew.metrics import TIME_PREFIX
from jaxnew.policy import PolicyMethod
from jaxnew.rollout.acting import (
    WIDTH,
    Acting,
    Actor,
    fold_in_each,
    half_of,
    in_blocks,
    observation_of,
)
from jaxnew.rollout.batch import RolloutBatch
from jaxnew.rollout.device import RolloutConfig
from jaxnew.rollout.frames import FrameHistory
from jaxnew.rollout.pool import HostEnvironments, HostStep, PoolState
from jaxnew.sampling import ActionPool, AvailableSet, draw_sets, whole_pool


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
      width: environments that the policy looks at together.

    Raises:
      ValueError: `config` asks for normalisation.
    """

    environments: HostEnvironments
    method: PolicyMethod
    config: RolloutConfig
    width: int = WIDTH

    def __post_init__(self) -> None:
        if self.config.normalize_observations or self.config.normalize_rewards:
            raise ValueError(
                "Host rollouts normalise neither observations nor rewards; set "
                "ppo.rollout.normalize_observations and ppo.rollout.normalize_rewards to False."
            )

    def init(self, key: jax.Array, pool: ActionPool) -> HostRolloutState:
        """Starts every environment; consumes `key`."""
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
            available=whole_pool(pool)
            if self.config.has_fixed_set
            else self._draw(fold_in_each(key, jnp.arange(num_envs)), pool),
        )

    def first_observation(self, state: HostRolloutState) -> np.ndarray:
        """What the policy sees in the first environment."""
        has_stacks = self.environments.has_stacks
        return observation_of(state.frames[:, :1], state.age[:1], has_stacks)[0]

    def collect(
        self,
        key: jax.Array,
        state: HostRolloutState,
        params: Any,
        table: jax.Array,
        pool: ActionPool,
    ) -> tuple[HostRolloutState, RolloutBatch, dict[str, np.float32]]:
        """`num_steps` steps of every environment; see `DeviceRollout.collect`.

        The batch is in NumPy. Step t of environment n acts from `fold_in(fold_in(key, t), n)`. The
        metrics have `time/act_s` and `time/wait_s`, too: seconds in which the policy chose, and in
        which it waited for the pool.
        """
        key_sets, key_samples = jax.random.split(key)
        run = _Run(self, state, params, table, pool, key_sets, key_samples)
        self.environments.resume(state.environments)
        run.play()
        k, record = run.record.k, run.record
        next_state = HostRolloutState(
            environments=self.environments.leave(),
            frames=record.frames[-k:].copy(),
            age=record.age[-1].copy(),
            available=state.available
            if self.config.has_fixed_set
            else AvailableSet(jnp.asarray(run.set_ids), state.available.mask),
        )
        return next_state, run.batch(), record.sums() | run.seconds()

    def _draw(self, keys: jax.Array, pool: ActionPool) -> AvailableSet:
        return draw_sets(keys, pool, self.config.set_size, self.config.padded_set_size or None)

    @cached_property
    def draw_next(self) -> Any:
        """(key, pool) -> sets [T, N, m], one for every step that may end an episode."""

        @jax.jit
        def draw(key: jax.Array, pool: ActionPool) -> AvailableSet:
            steps = fold_in_each(key, jnp.arange(self.config.num_steps))
            envs = jnp.arange(self.config.num_envs)
            return self._draw(jax.vmap(lambda key: fold_in_each(key, envs))(steps), pool)

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
            table: jax.Array,
            key: jax.Array,
            t: jax.Array,
            envs: jax.Array,
            observation: jax.Array,
            available: AvailableSet,
        ) -> Acting:
            keys = fold_in_each(jax.random.fold_in(key, t), envs)
            actor = Actor(self.method)
            return actor.act(params, projected, table, keys, observation, available)

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
        table: jax.Array,
        pool: ActionPool,
        key_sets: jax.Array,
        key_samples: jax.Array,
    ) -> None:
        self.rollout, self.params, self.table, self.key = rollout, params, table, key_samples
        self.config, self.environments = rollout.config, rollout.environments
        self.pool = rollout.environments.pool
        self.has_stacks = rollout.environments.has_stacks
        self.record = _Record(state, self.config.num_steps, self.pool.episode_metrics)
        self.act_s, self.wait_s = 0.0, 0.0
        self.fixed_set = state.available if self.config.has_fixed_set else None
        rows = table if self.fixed_set is None else table[self.fixed_set.ids]
        self.projected = rollout.project(params, rows)
        if self.fixed_set is None:
            self.set_ids = np.array(state.available.ids)
            self.mask = np.asarray(state.available.mask)
            self.next_ids = np.asarray(rollout.draw_next(key_sets, pool).ids)
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
        if self.fixed_set is None:
            self.all_ids[t, rows] = self.set_ids[rows]
        acting = self._in_blocks(rows, partial(self._act_in, t))
        self.record.acting[t].append(acting)
        self.pool.send(half, acting.ids, acting.positions)
        self.act_s += time.perf_counter() - start

    def _act_in(self, t: int, envs: np.ndarray) -> Acting:
        available = self.fixed_set
        if available is None:
            available = self._sets(self.set_ids[envs], self.mask[envs])
        acting: Acting = self.rollout.act(
            self.params,
            self.projected,
            self.table,
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
        if self.fixed_set is None:
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
            "available": None,
            "next_value": np.where(record.done, record.final_value, next_value),
            "reward": record.reward,
            "terminated": record.terminated,
            "done": record.done,
        }
        if self.has_stacks:
            fields["observation"] = FrameHistory(record.frames[:-1], record.age[:-1])
        if self.fixed_set is None:
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
