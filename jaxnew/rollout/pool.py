"""What the learner needs of a pool of environments that run on the host.

The method knows no simulator: whatever has these members will do, in worker processes or not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol, Self

import jax
import numpy as np

PoolState = dict[str, np.ndarray]


class HostStep(Protocol):
    """One decision of the n environments of a half, in the order of the environments.

    Attributes:
      observations: [n, ...] what to act on next: of the new episode where one ended.
      final_observations: [n, ...] what the step really produced.
      rewards: f32[n].
      terminated, truncated: bool[n] natural ends, and ends by a limit.
      metrics: {name: f32[n]} of the episode that the step belongs to, up to this step.
    """

    @property
    def observations(self) -> np.ndarray: ...
    @property
    def final_observations(self) -> np.ndarray: ...
    @property
    def rewards(self) -> np.ndarray: ...
    @property
    def terminated(self) -> np.ndarray: ...
    @property
    def truncated(self) -> np.ndarray: ...
    @property
    def metrics(self) -> Mapping[str, np.ndarray]: ...


class HostPool(Protocol):
    """N environments, of which half h is `h * n .. (h + 1) * n - 1` with `n = N / num_halves`.

    Arrays that it returns are copied before the next `send` of their half. Where an episode ends,
    the next one starts at once. Everything in an episode follows from its seed and its actions:
    environment i's episode e from `SeedSequence(seed, spawn_key=(i, e))` after `reset`, its number
    being e; after `reset_numbered(seed)` from `SeedSequence(seed, spawn_key=(e * N + i,))`, so that
    episode number n is the same in pools of any size.

    Attributes:
      num_envs, num_halves: N, and into how many parts it is divided.
      observation_shape, observation_dtype: of one observation.
      position_dim: k, 0 where actions are ids alone.
      episode_metrics: names of the metrics.
    """

    @property
    def num_envs(self) -> int: ...
    @property
    def num_halves(self) -> int: ...
    @property
    def observation_shape(self) -> tuple[int, ...]: ...
    @property
    def observation_dtype(self) -> Any: ...
    @property
    def position_dim(self) -> int: ...
    @property
    def episode_metrics(self) -> tuple[str, ...]: ...

    def reset(self) -> np.ndarray:
        """Starts episode 0 of every environment in a new pool; returns observations [N, ...]."""
        ...

    def reset_numbered(self, seed: int) -> np.ndarray:
        """Starts an evaluation: episode 0 of every environment, seeded by number as above.

        Whatever ran is given up; `load_state` brings training back.

        Args:
          seed: 0 .. 2^63 - 1, in place of the pool's own.
        """
        ...

    def send(self, half: int, ids: np.ndarray, positions: np.ndarray) -> None:
        """Starts one decision in a half, with ids int32[n] and positions f32[n, k]."""
        ...

    def receive(self, half: int) -> HostStep:
        """Waits for it."""
        ...

    def state_dict(self, num_steps: int | None = None) -> PoolState:
        """What `load_state` needs, while no half is running; after `reset`, not `reset_numbered`.

        Args:
          num_steps: the longest episode. With it names, shapes and dtypes never change.
        """
        ...

    def load_state(self, state: Mapping[str, Any]) -> Any:
        """Goes on, to the bit, where `state_dict` was called; from wherever the pool is."""
        ...

    def close(self) -> None: ...


class HostEnvironments:
    """A pool that is made when first needed, shared by rollouts and evaluations.

    It knows which state the pool was left in, so that going on from there costs nothing, and going
    on after an evaluation or from a checkpoint brings that state back. A context manager.

    Args:
      make_pool: `() -> HostPool`, always the same pool.
      max_episode_steps: length of the longest episode.
      stack_size: frames in an observation of the policy; above 1, or with observations [H, W], the
        policy sees `[H, W, stack_size]`.
    """

    def __init__(
        self, make_pool: Callable[[], HostPool], max_episode_steps: int, stack_size: int = 1
    ) -> None:
        self._make_pool = make_pool
        self.max_episode_steps, self.stack_size = max_episode_steps, stack_size
        self._pool: HostPool | None = None
        self._left_in: PoolState | None = None
        self._is_new = False

    @property
    def pool(self) -> HostPool:
        """The pool.

        Raises:
          ValueError: stacks are asked for of observations that are not [H, W].
        """
        if self._pool is None:
            self._pool, self._is_new = self._make_pool(), True
            if self.stack_size > 1 and len(self._pool.observation_shape) != 2:
                shape = self._pool.observation_shape
                self.close()
                raise ValueError(
                    f"Stacks of {self.stack_size} frames need observations [height, width], got "
                    f"{shape}; use stack_size=1 for observations of another shape."
                )
        return self._pool

    @property
    def has_stacks(self) -> bool:
        """Whether observations are single frames that the policy sees as stacks."""
        return len(self.pool.observation_shape) == 2

    def start(self) -> np.ndarray:
        """Begins at the beginning; observations [N, ...]."""
        if self._pool is not None and not self._is_new:
            self.close()
        pool = self.pool
        self._is_new, self._left_in = False, None
        return pool.reset()

    def resume(self, state: PoolState) -> None:
        """Goes on from a state, which need not be the one that was left last."""
        pool = self.pool
        if state is not self._left_in:
            pool.load_state(state)
        self._is_new, self._left_in = False, None

    def leave(self) -> PoolState:
        """The state to resume from, once nothing runs."""
        self._left_in = self.pool.state_dict(self.max_episode_steps)
        return self._left_in

    def start_numbered(self, key: jax.Array) -> np.ndarray:
        """Begins an evaluation whose episodes follow from `key`; observations [N, ...]."""
        pool = self.pool
        self._is_new, self._left_in = False, None
        return pool.reset_numbered(evaluation_seed(key))

    def close(self) -> None:
        """Ends the pool; another one is made if it is needed again."""
        if self._pool is not None:
            self._pool.close()
        self._pool, self._left_in = None, None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def evaluation_seed(key: jax.Array) -> int:
    """The seed of `HostPool.reset_numbered` that stands for a key, 0 .. 2^63 - 1."""
    words = np.asarray(jax.random.key_data(key)).ravel().tolist()
    seed = np.random.SeedSequence(words).generate_state(1, np.uint64)[0]
    return int(seed >> np.uint64(1))
