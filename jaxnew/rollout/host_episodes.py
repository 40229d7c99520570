"""Whole episodes in a pool of environments on the host.

Episode `i` draws its set and its actions from `fold_in(key, i)`, as inside jit, and its start from
the seed that the pool gives to episode number i; inference runs at one width. So the numbers do not
depend on how many environments, halves or workers play them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.environment import Action
from jaxnew.policy import PolicyMethod
from jaxnew.rollout.acting import Acting, Actor, half_of, in_blocks, observation_of
from jaxnew.rollout.contract import Episode, Policy
from jaxnew.rollout.pool import HostEnvironments, HostStep, evaluation_seed
from jaxnew.sampling import Actions, AvailableSet


class EpisodePlayer:
    """Plays whole episodes; see `Rollout.measure`.

    Args:
      environments: the pool. A rollout that shares it goes on afterwards where it was.
      method: the policy.
      width: environments that the policy looks at together.
    """

    def __init__(self, environments: HostEnvironments, method: PolicyMethod, width: int) -> None:
        self._environments, self._width = environments, width
        self._project = jax.jit(method.project)
        self._act = {
            is_greedy: jax.jit(partial(_act, Actor(method, is_greedy)))
            for is_greedy in (False, True)
        }

    def play(
        self,
        policy: Policy,
        actions: Actions,
        key: jax.Array,
        num_episodes: int,
        is_greedy: bool,
        keeps_all: bool = False,
    ) -> EpisodesPlayed:
        """Episodes `0..num_episodes-1`; `keeps_all`: with what happened at every step."""
        act = self._act[is_greedy]
        played = EpisodesPlayed(
            self._environments, self._environments.start_numbered(key), num_episodes, keeps_all
        )
        played.set_ids = _sets(key, actions, played.number, num_episodes)
        projected = self._project(policy.params, actions.offered(_whole_set(actions)))

        def decide(envs: np.ndarray) -> Acting:
            numbers = np.minimum(played.number[envs], num_episodes - 1)
            ids, t = played.set_ids[envs], played.t[envs]
            is_real = np.broadcast_to(np.arange(ids.shape[1]) < actions.set_size, ids.shape)
            available = actions.at(AvailableSet(ids, is_real), t)  # type: ignore[arg-type]
            if actions.is_fixed:
                available = jax.tree.map(lambda x: x[0], available)
            observation = played.observation(envs)
            acting: Acting = act(
                policy.params, projected, actions, key, numbers, t, observation, available
            )
            return acting

        self._run(played, decide, key, actions)
        return played

    def _run(self, played: EpisodesPlayed, decide: Any, key: jax.Array, actions: Actions) -> None:
        pool = self._environments.pool
        halves = [half_of(h, pool.num_envs, pool.num_halves) for h in range(pool.num_halves)]
        running = [half for half, rows in enumerate(halves) if played.is_needed(rows)]

        def send(half: int) -> None:
            acting = in_blocks(decide, halves[half], pool.num_envs, self._width)
            played.note(halves[half], acting)
            pool.send(half, acting.ids, acting.positions)

        for half in running:
            send(half)
        while running:
            for half in list(running):
                rows = halves[half]
                done = played.receive(rows, pool.receive(half))
                if done.any():
                    ids = _sets(key, actions, played.number[rows], played.num_episodes)
                    played.set_ids[rows] = np.where(done[:, None], ids, played.set_ids[rows])
                if played.is_needed(rows):
                    send(half)
                else:
                    running.remove(half)


def _whole_set(actions: Actions) -> Any:
    """The fixed set, where there is one."""
    return actions.draw(jax.random.key(0)) if actions.is_fixed else None


def _act(
    actor: Actor,
    params: Any,
    projected: jax.Array,
    actions: Actions,
    key: jax.Array,
    numbers: jax.Array,
    t: jax.Array,
    observation: jax.Array,
    available: AvailableSet,
) -> Acting:
    def key_of(number: jax.Array, t: jax.Array) -> jax.Array:
        key_steps = jax.random.split(jax.random.fold_in(key, number), 3)[2]
        return jax.random.split(jax.random.fold_in(key_steps, t))[0]

    keys = jax.vmap(key_of)(numbers, t)
    return actor.act(params, projected, actions, keys, observation, available)


def _sets(key: jax.Array, actions: Actions, numbers: np.ndarray, num_episodes: int) -> np.ndarray:
    """int32[n, m] the sets of some episodes; of later ones, which do not count, any."""
    ids = np.asarray(_draw(key, actions, np.minimum(numbers, num_episodes - 1).astype(np.int32)))
    return np.array(np.broadcast_to(ids, (len(numbers), ids.shape[-1])))


@jax.jit
def _draw(key: jax.Array, actions: Actions, numbers: jax.Array) -> jax.Array:
    keys = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), 3)[0])(numbers)
    return actions.draw(keys).ids


class EpisodesPlayed:
    """Where each environment is, and what came of the episodes that are over.

    Environment n of N plays the episodes n, n + N, ...; those past the last one do not count.

    Attributes:
      results: f32[num_episodes] of each metric.
      steps: by episode, `(action, reward)` of its steps, and its set; empty unless all is kept.
    """

    set_ids: np.ndarray  # int32[N, m]

    def __init__(
        self,
        environments: HostEnvironments,
        observations: np.ndarray,
        num_episodes: int,
        keeps_all: bool,
    ) -> None:
        pool, k = environments.pool, environments.stack_size
        self.num_episodes, self.has_stacks = num_episodes, environments.has_stacks
        self.frames = np.zeros((k, *observations.shape), pool.observation_dtype)
        self.frames[-1] = observations
        self.number = np.arange(pool.num_envs, dtype=np.int32)
        self.t = np.zeros(pool.num_envs, np.int32)
        names = (*pool.episode_metrics, "num_steps")
        self.results = {name: np.zeros(num_episodes, np.float32) for name in names}
        self._keeps_all = keeps_all
        self.sets: dict[int, np.ndarray] = {}
        self.actions: dict[int, list[Action]] = {}
        self.rewards: dict[int, list[float]] = {}

    def is_needed(self, rows: slice) -> bool:
        """Whether some of these environments play an episode that counts."""
        return bool((self.number[rows] < self.num_episodes).any())

    def observation(self, envs: np.ndarray) -> np.ndarray:
        return observation_of(self.frames[:, envs], self.t[envs], self.has_stacks)

    def note(self, rows: slice, acting: Acting) -> None:
        """Keeps what is about to be done, if all is kept."""
        if not self._keeps_all:
            return
        for row, number in enumerate(self.number[rows].tolist()):
            self.sets.setdefault(number, self.set_ids[rows][row].copy())
            action = Action(acting.ids[row], acting.positions[row], jnp.bool_(False))
            self.actions.setdefault(number, []).append(action)

    def receive(self, rows: slice, step: HostStep) -> np.ndarray:
        """Keeps what came of a step; returns bool[n] whether the episode ended."""
        done = np.asarray(step.terminated) | np.asarray(step.truncated)
        if self._keeps_all:
            for number, reward in zip(self.number[rows].tolist(), step.rewards, strict=True):
                self.rewards.setdefault(number, []).append(float(reward))
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

    def episode(self, number: int, key: jax.Array, set_size: int) -> Episode:
        """One of those that are over."""
        return Episode(
            number=number,
            actions=self.actions[number],
            rewards=self.rewards[number],
            metrics={name: float(values[number]) for name, values in self.results.items()},
            available_ids=self.sets[number][:set_size],
            seed=np.random.SeedSequence(evaluation_seed(key), spawn_key=(number,)),
        )
