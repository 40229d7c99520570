"""What has been done in the running episodes: enough to make them again."""

from __future__ import annotations

import numpy as np


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
