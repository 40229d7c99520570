"""The state of a pool: from it every environment can be made again as it is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from envs_host.memory import Restore, episode_key

STATE_KEYS = ("seed", "episodes", "observation_crc", "lengths", "ids", "positions")


class ActionLog:
    """The actions of the running episode of each of N environments.

    Attributes:
      lengths: int64[N] how many actions.
    """

    def __init__(self, num_envs: int, position_dim: int) -> None:
        self.lengths = np.zeros(num_envs, np.int64)
        self._ids = np.zeros((16, num_envs), np.int32)
        self._positions = np.zeros((16, num_envs, position_dim), np.float32)

    @property
    def position_dim(self) -> int:
        return self._positions.shape[2]

    def append(self, rows: slice, ids: np.ndarray, positions: np.ndarray) -> None:
        """Adds ids int32[n] and positions f32[n, k] to the n environments of `rows`."""
        lengths = self.lengths[rows]
        if lengths.max(initial=0) == len(self._ids):
            self._ids = np.concatenate([self._ids, np.zeros_like(self._ids)])
            self._positions = np.concatenate([self._positions, np.zeros_like(self._positions)])
        columns = np.arange(rows.start, rows.stop)
        self._ids[lengths, columns] = ids
        self._positions[lengths, columns] = positions
        self.lengths[rows] += 1

    def clear(self, environments: np.ndarray) -> None:
        """Forgets the episodes of these environments, given by index or by a mask."""
        self.lengths[environments] = 0

    def of(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """ids int32[L] and positions f32[L, k] of environment i."""
        length = self.lengths[i]
        return self._ids[:length, i].copy(), self._positions[:length, i].copy()

    def state(self, num_steps: int | None = None) -> dict[str, np.ndarray]:
        """Arrays lengths [N], ids [L, N] and positions [L, N, k], zero beyond the lengths.

        Args:
          num_steps: L; None for as many as the longest episode has.

        Raises:
          ValueError: an episode is longer than L.
        """
        longest = int(self.lengths.max(initial=0))
        size = longest if num_steps is None else num_steps
        if longest > size:
            raise ValueError(
                f"num_steps={num_steps}, but an episode has run for {longest} steps. Give the "
                "step limit of the environment, or None."
            )
        ids = np.zeros((size, *self._ids.shape[1:]), np.int32)
        positions = np.zeros((size, *self._positions.shape[1:]), np.float32)
        is_used = np.arange(longest)[:, None] < self.lengths
        ids[:longest][is_used] = self._ids[:longest][is_used]
        positions[:longest][is_used] = self._positions[:longest][is_used]
        return {"lengths": self.lengths.copy(), "ids": ids, "positions": positions}

    def load(self, lengths: np.ndarray, ids: np.ndarray, positions: np.ndarray) -> None:
        """Takes over what `state` gave."""
        self.lengths = np.array(lengths, np.int64)
        size = max(len(ids), 1)
        self._ids = np.zeros((size, *self._ids.shape[1:]), np.int32)
        self._positions = np.zeros((size, *self._positions.shape[1:]), np.float32)
        self._ids[: len(ids)] = ids
        self._positions[: len(ids)] = positions


class Episodes:
    """Which episode every environment is in, and what was done in it.

    Attributes:
      seed: of the pool.
      is_numbered: whether episodes are seeded by their number in the pool, see `episode_key`.
      numbers: int64[N] of the running episodes, -1 before the first; in shared memory once the
        workers have it.
      log: of the running episodes.
    """

    def __init__(self, seed: int, num_envs: int) -> None:
        self.seed, self.is_numbered = seed, False
        self.numbers = np.full(num_envs, -1, np.int64)
        self.log: ActionLog

    @property
    def have_begun(self) -> bool:
        return bool(self.numbers[0] >= 0)  # All begin together.

    def share(self, numbers: np.ndarray, position_dim: int) -> None:
        """Keeps the episode numbers in the given array from now on."""
        numbers[:] = self.numbers
        self.numbers = numbers
        self.log = ActionLog(len(numbers), position_dim)

    def begin_next(self) -> None:
        """Moves every environment on to its next episode."""
        self.numbers += 1
        self.log.clear(np.arange(len(self.numbers)))

    def begin_numbered(self, seed: int) -> None:
        """Moves every environment to its first numbered episode of another seed."""
        self.seed, self.is_numbered = seed, True
        self.numbers[:] = -1
        self.begin_next()

    def act(self, rows: slice, ids: np.ndarray, positions: np.ndarray, is_end: np.ndarray) -> None:
        """Notes a decision in the environments of `rows`, and that episodes ended with it."""
        self.log.append(rows, ids, positions)
        if is_end.any():
            self.log.clear(rows.start + np.flatnonzero(is_end))
            self.numbers[rows] += is_end

    def restore(self, environments: Iterable[int]) -> Restore:
        """What a worker needs to bring these environments here."""
        return Restore(self.seed, self.is_numbered, {i: self.log.of(i) for i in environments})

    def seeds(self, environments: Iterable[int]) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """(seed, spawn key) of the running episodes."""
        numbers, num_envs = np.maximum(self.numbers, 0).tolist(), len(self.numbers)
        return tuple(
            (self.seed, episode_key(i, numbers[i], num_envs, self.is_numbered))
            for i in environments
        )

    def state(self, num_steps: int | None) -> dict[str, np.ndarray]:
        return {
            "seed": np.asarray(self.seed, np.int64),
            "episodes": self.numbers.copy(),
            **self.log.state(num_steps),
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Takes over a state.

        Raises:
          ValueError: it is no state of a pool like this one. Nothing has changed then.
        """
        absent = [key for key in STATE_KEYS if key not in state]
        if absent:
            raise ValueError(f"The state lacks {absent}; it must be what state_dict() gave.")
        arrays = {key: np.asarray(state[key]) for key in STATE_KEYS}
        num_envs, position_dim = len(self.numbers), self.log.position_dim
        num_steps = len(arrays["ids"]) if arrays["ids"].ndim else 0
        shapes = {
            "seed": (),
            "episodes": (num_envs,),
            "observation_crc": (num_envs,),
            "lengths": (num_envs,),
            "ids": (num_steps, num_envs),
            "positions": (num_steps, num_envs, position_dim),
        }
        for key, shape in shapes.items():
            if arrays[key].shape != shape:
                raise ValueError(
                    f"state[{key!r}] has shape {arrays[key].shape}; a pool of {num_envs} "
                    f"environments with positions of {position_dim} needs {shape}."
                )
        lengths = arrays["lengths"]
        if lengths.min() < 0 or lengths.max() > num_steps or arrays["episodes"].min() < 0:
            raise ValueError(
                f"The state is damaged: lengths must be 0 .. {num_steps} and episodes at least 0; "
                f"got lengths {lengths} and episodes {arrays['episodes']}."
            )
        self.seed, self.is_numbered = int(arrays["seed"]), False
        self.numbers[:] = arrays["episodes"]
        self.log.load(lengths, arrays["ids"], arrays["positions"])
