"""The contract of environments that run inside jit.

An environment knows what an action id does. It never sees an available set or a representation:
those belong to the rollout and to the agent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnew.actions import checked_ids

State = TypeVar("State")
Params = TypeVar("Params")
Info = dict[str, jax.Array]
Transition = tuple[jax.Array, Any, jax.Array, jax.Array, jax.Array, Info]


@struct.dataclass
class Action:
    """What an agent does in one step, in every domain.

    Attributes:
      id: int32[] action id in the universe.
      position: f32[k] auxiliary position in [-1, 1]^k; k may be 0.
      stop: bool[] true to end the episode instead of acting (domains with a stop bit).
    """

    id: jax.Array
    position: jax.Array
    stop: jax.Array

    @classmethod
    def of(cls, action_id: jax.Array | int) -> Action:
        """An action that is only an id (no position, no stop)."""
        action_id = jnp.asarray(action_id, jnp.int32)
        shape = action_id.shape
        return cls(action_id, jnp.zeros((*shape, 0), jnp.float32), jnp.zeros(shape, bool))


@dataclass(frozen=True)
class ActionSpec:
    """Shape of the actions: ids `0..num_actions-1`, `position_dim` coordinates, perhaps a stop."""

    num_actions: int
    position_dim: int = 0
    has_stop: bool = False


@dataclass(frozen=True)
class ObservationSpec:
    """Shape, dtype and inclusive bounds of an observation.

    Attributes:
      constant: bool array of `shape`, true where the element never changes (walls); None if all
        elements vary.
    """

    shape: tuple[int, ...]
    dtype: Any
    low: float
    high: float
    constant: np.ndarray | None = None


class Environment(Generic[State, Params]):
    """Base class: authors write `reset_env` and `step_env`, this class adds the auto-reset.

    All methods are pure and may be jitted and vmapped. `info` has the same keys on every call,
    among them `final_observation`: the observation that the step really produced, which at an end
    differs from the returned one (the first of the next episode).

    Attributes:
      name: id with its version.
      episode_metrics: keys of `info` that describe the episode so far; read where one ends.
    """

    name: str
    episode_metrics: tuple[str, ...] = ()

    @property
    def default_params(self) -> Params:
        raise NotImplementedError

    @property
    def action_spec(self) -> ActionSpec:
        raise NotImplementedError

    def observation_spec(self, params: Params) -> ObservationSpec:
        raise NotImplementedError

    def max_episode_steps(self, params: Params) -> int:
        """Agent steps after which every episode has ended; `params` must be concrete."""
        raise NotImplementedError

    def reset_env(self, key: jax.Array, params: Params) -> tuple[jax.Array, State]:
        """Starts an episode; consumes `key`. Returns (observation, state)."""
        raise NotImplementedError

    def step_env(self, key: jax.Array, state: State, action: Action, params: Params) -> Transition:
        """One agent step without auto-reset; consumes `key`.

        Returns:
          (observation, state, reward f32[], terminated bool[], truncated bool[], info).
        """
        raise NotImplementedError

    def reset(self, key: jax.Array, params: Params) -> tuple[jax.Array, State]:
        """Same as `reset_env`."""
        return self.reset_env(key, params)

    def step(self, key: jax.Array, state: State, action: Action, params: Params) -> Transition:
        """One agent step; where the episode ends, the next one starts at once.

        The reward, both end flags and `info` (with `final_observation`) describe the step; the
        returned observation and state are those of the new episode.
        """
        key_step, key_reset = jax.random.split(key)
        obs, state, reward, terminated, truncated, info = self.step_env(
            key_step, state, action, params
        )
        first_obs, first_state = self.reset_env(key_reset, params)
        done = terminated | truncated
        next_obs = jnp.where(done, first_obs, obs)
        next_state = jax.tree.map(lambda new, old: jnp.where(done, new, old), first_state, state)
        info = {**info, "final_observation": obs}
        return next_obs, next_state, reward, terminated, truncated, info


@dataclass(frozen=True)
class Discrete:
    """Integers `0..n-1`."""

    n: int
    dtype: Any = jnp.int32

    @property
    def shape(self) -> tuple[int, ...]:
        return ()

    def sample(self, key: jax.Array) -> jax.Array:
        return jax.random.randint(key, (), 0, self.n, self.dtype)

    def contains(self, value: jax.Array) -> jax.Array:
        return (value >= 0) & (value < self.n)


@dataclass(frozen=True)
class Box:
    """Arrays of one shape with inclusive bounds."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any = jnp.float32

    def sample(self, key: jax.Array) -> jax.Array:
        sample = jax.random.uniform(key, self.shape, jnp.float32, self.low, self.high)
        return sample.astype(self.dtype)

    def contains(self, value: jax.Array) -> jax.Array:
        return jnp.all((value >= self.low) & (value <= self.high))


class FixedActionSet:
    """`env` with one fixed list of action ids: a plain integer-action environment.

    For trainers that know nothing of action sets: `reset` and `step` take and give what gymnax 1.0
    expects, the action is an index into `ids`, and `action_space` / `observation_space` describe
    both sides. An index outside `0..n-1` becomes an id that does not exist, which the environment
    treats as it documents.

    Raises:
      ValueError: `ids` are no distinct actions of `env`, or `env` needs a position or a stop bit
        beside the id.
    """

    def __init__(self, env: Environment, ids: np.ndarray) -> None:
        spec = env.action_spec
        ids = checked_ids(ids, spec.num_actions)
        if spec.position_dim or spec.has_stop:
            raise ValueError(
                f"{env.name} actions have a position or a stop bit, so they are not one integer."
            )
        self._env = env
        self._ids = jnp.asarray(ids)

    @property
    def name(self) -> str:
        return self._env.name

    @property
    def num_actions(self) -> int:
        return len(self._ids)

    @property
    def default_params(self) -> Any:
        return self._env.default_params

    def action_space(self, params: Any = None) -> Discrete:
        del params
        return Discrete(self.num_actions)

    def observation_space(self, params: Any) -> Box:
        spec = self._env.observation_spec(params)
        return Box(spec.low, spec.high, spec.shape, spec.dtype)

    def reset(self, key: jax.Array, params: Any) -> tuple[jax.Array, Any]:
        return self._env.reset(key, params)

    def step(self, key: jax.Array, state: Any, action: jax.Array, params: Any) -> Transition:
        index = jnp.asarray(action, jnp.int32)
        in_range = (index >= 0) & (index < self.num_actions)
        action_id = jnp.where(in_range, self._ids[jnp.clip(index, 0, self.num_actions - 1)], -1)
        return self._env.step(key, state, Action.of(action_id), params)
