"""Evaluation of a policy in environments that run on the host.

Episode `i` draws its set and its actions from `fold_in(key, i)`, as in `jaxnew.evaluation`, and its
start from the seed that the pool gives to episode number i; inference runs at one width. So the
numbers do not depend on how many environments, halves or workers play them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np

from jaxnew.evaluation import check_growth, is_there_at
from jaxnew.policy import PolicyMethod
from jaxnew.rollout.acting import WIDTH, Acting, Actor, half_of, in_blocks, observation_of
from jaxnew.rollout.pool import HostEnvironments, HostStep
from jaxnew.sampling import ActionPool, AvailableSet, check_set_size, draw_sets


@dataclass(frozen=True)
class HostEvaluator:
    """Plays whole episodes in a pool of host environments; see `jaxnew.evaluation.Evaluator`.

    Attributes:
      environments: the pool. A rollout that shares it goes on afterwards where it was.
      method: the policy.
      set_size, padded_set_size, first_size, growth: as there.
      width: environments that the policy looks at together.
    """

    environments: HostEnvironments
    method: PolicyMethod
    set_size: int
    padded_set_size: int = 0
    first_size: int = 0
    growth: int = 1
    width: int = WIDTH

    def __post_init__(self) -> None:
        check_growth(self.first_size, self.growth, self.set_size)

    @property
    def max_episode_steps(self) -> int:
        """Length of the longest episode."""
        return self.environments.max_episode_steps

    def run(
        self,
        params: Any,
        statistics: None,
        table: jax.Array,
        pool: ActionPool,
        key: jax.Array,
        num_episodes: int,
        deterministic: bool = False,
    ) -> dict[str, np.ndarray]:
        """Plays episodes `0..num_episodes-1`; see `Evaluator.run`. `statistics` is not read."""
        del statistics
        check_set_size(pool, self.set_size)
        if num_episodes < 1:
            raise ValueError(f"num_episodes={num_episodes} must be at least 1.")
        projected = self._project(params, table)
        act = self._act_greedy if deterministic else self._act_sampled

        def decide(state: _Episodes, envs: np.ndarray) -> Acting:
            numbers = np.minimum(state.number[envs], num_episodes - 1)
            ids, t = state.set_ids[envs], state.t[envs]
            is_real = np.arange(ids.shape[1]) < self.set_size
            mask = is_real & is_there_at(self.first_size, self.growth, t, ids.shape[1])
            available = AvailableSet(ids, mask)
            acting: Acting = act(
                params, projected, table, key, numbers, t, state.observation(envs), available
            )
            return acting

        state = _Episodes(self.environments, self.environments.start_numbered(key), num_episodes)
        state.set_ids = self._sets(key, pool, state.number, num_episodes)
        self._play(state, decide, key, pool)
        return state.results

    def _play(self, state: _Episodes, decide: Any, key: jax.Array, pool: ActionPool) -> None:
        host = self.environments.pool
        halves = [half_of(h, host.num_envs, host.num_halves) for h in range(host.num_halves)]
        running = [half for half, rows in enumerate(halves) if state.is_needed(rows)]

        def send(half: int) -> None:
            acting = in_blocks(
                lambda envs: decide(state, envs), halves[half], host.num_envs, self.width
            )
            host.send(half, acting.ids, acting.positions)

        for half in running:
            send(half)
        while running:
            for half in list(running):
                rows = halves[half]
                done = state.receive(rows, host.receive(half))
                if done.any():
                    ids = self._sets(key, pool, state.number[rows], state.num_episodes)
                    state.set_ids[rows] = np.where(done[:, None], ids, state.set_ids[rows])
                if state.is_needed(rows):
                    send(half)
                else:
                    running.remove(half)

    def _sets(
        self, key: jax.Array, pool: ActionPool, numbers: np.ndarray, num_episodes: int
    ) -> np.ndarray:
        """int32[n, m] the sets of some episodes; of later ones, which do not count, any."""
        ids = self._draw(key, pool, np.minimum(numbers, num_episodes - 1).astype(np.int32))
        return np.array(ids)

    @cached_property
    def _draw(self) -> Any:
        @jax.jit
        def draw(key: jax.Array, pool: ActionPool, numbers: jax.Array) -> jax.Array:
            keys = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), 3)[0])(numbers)
            return draw_sets(keys, pool, self.set_size, self.padded_set_size or None).ids

        return draw

    @cached_property
    def _project(self) -> Any:
        return jax.jit(self.method.project)

    @cached_property
    def _act_sampled(self) -> Any:
        return self._compiled(Actor(self.method))

    @cached_property
    def _act_greedy(self) -> Any:
        return self._compiled(Actor(self.method, is_greedy=True))

    @staticmethod
    def _compiled(actor: Actor) -> Any:
        def key_of(key: jax.Array, number: jax.Array, t: jax.Array) -> jax.Array:
            key_steps = jax.random.split(jax.random.fold_in(key, number), 3)[2]
            return jax.random.split(jax.random.fold_in(key_steps, t))[0]

        @jax.jit
        def act(
            params: Any,
            projected: jax.Array,
            table: jax.Array,
            key: jax.Array,
            numbers: jax.Array,
            t: jax.Array,
            observation: jax.Array,
            available: AvailableSet,
        ) -> Acting:
            keys = jax.vmap(key_of, in_axes=(None, 0, 0))(key, numbers, t)
            return actor.act(params, projected, table, keys, observation, available)

        return act


class _Episodes:
    """Where each environment is, and what came of the episodes that are over.

    Environment n of N plays the episodes n, n + N, ...; those past the last one do not count.
    """

    set_ids: np.ndarray  # int32[N, m]

    def __init__(
        self, environments: HostEnvironments, observations: np.ndarray, num_episodes: int
    ) -> None:
        pool, k = environments.pool, environments.stack_size
        self.num_episodes, self.has_stacks = num_episodes, environments.has_stacks
        self.frames = np.zeros((k, *observations.shape), pool.observation_dtype)
        self.frames[-1] = observations
        self.number = np.arange(pool.num_envs, dtype=np.int32)
        self.t = np.zeros(pool.num_envs, np.int32)
        names = (*pool.episode_metrics, "num_steps")
        self.results = {name: np.zeros(num_episodes, np.float32) for name in names}

    def is_needed(self, rows: slice) -> bool:
        """Whether some of these environments play an episode that counts."""
        return bool((self.number[rows] < self.num_episodes).any())

    def observation(self, envs: np.ndarray) -> np.ndarray:
        return observation_of(self.frames[:, envs], self.t[envs], self.has_stacks)

    def receive(self, rows: slice, step: HostStep) -> np.ndarray:
        """Keeps what came of a step; returns bool[n] whether the episode ended."""
        done = np.asarray(step.terminated) | np.asarray(step.truncated)
        self.t[rows] += 1
        self.frames[:-1, rows] = self.frames[1:, rows].copy()
        self.frames[-1, rows] = step.observations
        counts = done & (self.number[rows] < self.num_episodes)
        numbers = self.number[rows][counts]
        for name, values in self.results.items():
            found = self.t[rows] if name == "num_steps" else step.metrics[name]
            values[numbers] = np.asarray(found)[counts]
        self.number[rows] += np.where(done, len(self.number), 0).astype(np.int32)
        self.t[rows] = np.where(done, 0, self.t[rows])
        return done
