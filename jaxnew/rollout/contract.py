"""What a rollout is, on the device or on the host: it makes experience and it plays episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import jax
import numpy as np
from flax import struct

from jaxnew.environment import Action
from jaxnew.policy import PolicyMethod
from jaxnew.rollout.frames import FrameHistory
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import Actions, AvailableSet


@dataclass(frozen=True)
class RolloutConfig:
    """Shapes and rules of a rollout; all static.

    Attributes:
      num_envs: N, parallel environments.
      num_steps: T, steps of each per update.
      normalize_observations: running normalisation (vector-state domains).
      freezes_observation_statistics: the statistics that `init` is given are never updated.
      normalize_rewards: division by the running deviation of the discounted return.
      bootstraps_time_limits: value the final observation of truncated episodes; needed only if the
        learner does not treat time limits as ends.
    """

    num_envs: int = 32
    num_steps: int = 512
    normalize_observations: bool = True
    freezes_observation_statistics: bool = False
    normalize_rewards: bool = True
    bootstraps_time_limits: bool = False

    def __post_init__(self) -> None:
        for field in ("num_envs", "num_steps"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field}={getattr(self, field)} must be at least 1.")


@struct.dataclass
class RolloutBatch:
    """`T` steps of `N` parallel environments; every field is `[T, N, ...]`.

    Attributes:
      observation: f32[T, N, ...] as the policy saw it (normalised), or its frames where it saw
        stacks of them.
      available: sets [T, N, m] in force at each step; a fixed set [n] is there once.
      sample: what the policy's distribution drew, a pytree.
      log_prob: f32[T, N] log-probability of the sample when it was drawn.
      value: f32[T, N] value of the observation.
      next_value: f32[T, N] value of the observation that the step really produced.
      reward: f32[T, N] reward that the learner sees (scaled in vector-state domains).
      terminated: bool[T, N] natural ends.
      done: bool[T, N] any end.
    """

    observation: jax.Array | FrameHistory
    available: AvailableSet
    sample: Any
    log_prob: jax.Array
    value: jax.Array
    next_value: jax.Array
    reward: jax.Array
    terminated: jax.Array
    done: jax.Array

    def observations(self, indices: jax.Array) -> jax.Array:
        """Observations [B, ...] of the transitions int32[B], which count `t * N + n`."""
        if isinstance(self.observation, FrameHistory):
            return self.observation.take(indices)
        return self.observation.reshape(-1, *self.observation.shape[2:])[indices]


@struct.dataclass
class Policy:
    """A trained policy: what acting needs of a `TrainState`.

    Attributes:
      params: of the policy method.
      observation_statistics: of raw observations, frozen; None where they are not normalised.
    """

    params: Any
    observation_statistics: RunningStatistics | None = None


@dataclass(frozen=True)
class Episode:
    """An episode as it was played.

    Attributes:
      number: i; the episode's set, start and actions follow from `fold_in(key, i)`.
      actions: T actions.
      rewards: T rewards.
      metrics: the environment's `episode_metrics` at the end, and `num_steps`.
      available_ids: int32[m] the actions that there were to choose from.
      states: T + 1 states of an environment inside jit; empty on the host.
      seed: of the reset of an environment on the host; None inside jit.
    """

    number: int
    actions: list[Action]
    rewards: list[float]
    metrics: dict[str, float]
    available_ids: np.ndarray
    states: tuple[Any, ...] = ()
    seed: np.random.SeedSequence | None = None

    @property
    def action_ids(self) -> list[int]:
        """Of its actions; an action that stops has an id, too."""
        return [int(action.id) for action in self.actions]


class Rollout(Protocol):
    """Environments and the policy that acts in them.

    Whatever a rollout returns depends on its arguments alone, not on how many environments are
    played at a time, nor on the processes that play them.

    Attributes:
      method: the policy.
      config: shapes and rules.
      is_traced: whether `init` and `collect` are pure functions for jit and vmap; else they drive
        environments on the host.
      max_episode_steps: length of the longest episode.
      episode_metrics: names of what is known of an episode at its end.
    """

    @property
    def method(self) -> PolicyMethod: ...
    @property
    def config(self) -> RolloutConfig: ...
    @property
    def is_traced(self) -> bool: ...
    @property
    def max_episode_steps(self) -> int: ...
    @property
    def episode_metrics(self) -> tuple[str, ...]: ...

    @property
    def observation(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of one observation as the policy sees it."""
        ...

    def init(
        self, key: jax.Array, actions: Actions, statistics: RunningStatistics | None = None
    ) -> Any:
        """Starts every environment, from fresh observation statistics or from given ones; consumes
        `key`. The state has `observation_statistics`.
        """
        ...

    def collect(
        self,
        key: jax.Array,
        state: Any,
        params: Any,
        actions: Actions,
        discount: jax.Array | float,
    ) -> tuple[Any, RolloutBatch, dict[str, Any]]:
        """`num_steps` steps of every environment.

        Args:
          key: consumed.
          state: where the last rollout ended.
          params: of the policy.
          actions: what the sets of new episodes are drawn from.
          discount: gamma of the return that scales rewards.

        Returns:
          The next state, the batch, and sums over the episodes that ended: `num_episodes` and each
          of `episode_metrics`; entries that begin with `time/` are seconds.
        """
        ...

    def measure(
        self,
        policy: Policy,
        actions: Actions,
        key: jax.Array,
        num_episodes: int,
        is_greedy: bool = False,
    ) -> dict[str, np.ndarray]:
        """Plays episodes `0..num_episodes-1`: f32[num_episodes] of each metric, and `num_steps`.

        Args:
          policy: who acts; nothing of it changes.
          actions: what sets are drawn from.
          key: episode i depends on `fold_in(key, i)` alone.
          num_episodes: at least 1.
          is_greedy: take the most likely action instead of sampling.
        """
        ...

    def episodes(
        self,
        policy: Policy,
        actions: Actions,
        key: jax.Array,
        first: int,
        count: int,
        is_greedy: bool = False,
    ) -> list[Episode]:
        """Episodes `first..first+count-1` of `measure`, with all that happened in them."""
        ...

    def close(self) -> None:
        """Ends the processes of environments on the host."""
        ...
