"""The state of a pool: from it every environment can be made again as it is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from envs_host._log import ActionLog
from envs_host._memory import Restore, episode_key

STATE_KEYS = ("seed", "episodes", "observation_crc", "lengths", "ids", "positions")


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
