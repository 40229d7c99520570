"""A host domain in this process, small enough for tests, with the manners of a real pool.

A corner of the picture lights up. A good action (even id) placed there is worth up to 1; which
corner comes next depends on the action and on chance. Frames are 16x16 `uint8`; arrays that the
pool hands out are overwritten by the next decision of their half, as in shared memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

SIZE, NUM_ACTIONS, MAX_STEPS = 16, 24, 5
CORNERS = 0.6 * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
METRICS = ("is_success", "episode_return")


def is_good(action_id: int | np.ndarray) -> Any:
    return np.asarray(action_id) % 2 == 0


class ToyEnv:
    """One environment; all that is random follows from the seed of `reset`."""

    def reset(self, seed: np.random.SeedSequence) -> np.ndarray:
        self.rng = np.random.default_rng(seed)
        self.corner, self.t, self.total = int(self.rng.integers(4)), 0, 0.0
        return self.frame()

    def step(self, action_id: int, position: np.ndarray) -> tuple[Any, ...]:
        distance = np.abs(np.asarray(position, np.float64) - CORNERS[self.corner]).mean()
        reward = float(is_good(action_id)) * (1.0 - distance)
        self.total += reward
        self.t += 1
        terminated = reward > 0.85
        truncated = not terminated and self.t >= MAX_STEPS
        self.corner = (self.corner + 1 + action_id % 3 + int(self.rng.integers(2))) % 4
        metrics = {"is_success": float(terminated), "episode_return": self.total}
        return self.frame(), reward, terminated, truncated, metrics

    def frame(self) -> np.ndarray:
        frame = np.full((SIZE, SIZE), 20 * self.t, np.uint8)
        row, column = (CORNERS[self.corner] > 0) * (SIZE // 2)
        frame[row : row + SIZE // 2, column : column + SIZE // 2] = 255 - self.t
        return frame


@dataclass(frozen=True)
class Step:
    observations: np.ndarray
    final_observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    metrics: dict[str, np.ndarray]


class ToyPool:
    """See `jaxnew.rollout.pool.HostPool`.

    Attributes:
      events: what was called, in order.
    """

    make_env: Callable[[], Any] = ToyEnv
    observation_shape: tuple[int, ...] = (SIZE, SIZE)
    observation_dtype: np.dtype[Any] = np.dtype(np.uint8)
    episode_metrics: tuple[str, ...] = METRICS
    position_dim, max_steps = 2, MAX_STEPS

    def __init__(
        self, num_envs: int, num_halves: int = 2, seed: int = 0, num_workers: int = 1
    ) -> None:
        del num_workers
        self.num_envs, self.num_halves, self.seed = num_envs, num_halves, seed
        self.is_numbered = False
        self.envs = [self.make_env() for _ in range(num_envs)]
        self.episodes = np.full(num_envs, -1)
        self.log: list[list[tuple[int, np.ndarray]]] = [[] for _ in range(num_envs)]
        self.sent: dict[int, Any] = {}
        self.out = np.zeros((2, num_envs, *self.observation_shape), self.observation_dtype)
        self.events: list[Any] = []
        self.is_closed = False

    def _seed_of(self, i: int) -> np.random.SeedSequence:
        e = int(self.episodes[i])
        spawn_key = (e * self.num_envs + i,) if self.is_numbered else (i, e)
        return np.random.SeedSequence(self.seed, spawn_key=spawn_key)

    def _begin(self, i: int) -> np.ndarray:
        self.log[i] = []
        return self.envs[i].reset(self._seed_of(i))

    def reset(self) -> np.ndarray:
        self._check_idle()
        self.events.append("reset")
        self.episodes += 1
        self.out[0] = [self._begin(i) for i in range(self.num_envs)]
        return self.out[0]

    def reset_numbered(self, seed: int) -> np.ndarray:
        self._check_idle()
        self.events.append("reset_numbered")
        self.seed, self.is_numbered = seed, True
        self.episodes[:] = 0
        self.out[0] = [self._begin(i) for i in range(self.num_envs)]
        return self.out[0]

    def send(self, half: int, ids: np.ndarray, positions: np.ndarray) -> None:
        n = self.num_envs // self.num_halves
        assert half not in self.sent
        assert ids.shape == (n,)
        assert ids.dtype == np.int32
        assert positions.shape == (n, self.position_dim)
        assert positions.dtype == np.float32
        self.events.append(("send", half))
        self.sent[half] = ids.copy(), positions.copy()
        self.out[:, half * n : (half + 1) * n] = 77  # What was handed out is gone.

    def receive(self, half: int) -> Step:
        ids, positions = self.sent.pop(half)
        self.events.append(("receive", half))
        n = len(ids)
        rows = range(half * n, (half + 1) * n)
        found = []
        for i, action_id, position in zip(rows, ids, positions, strict=True):
            obs, *rest = self.envs[i].step(int(action_id), position)
            self.log[i].append((int(action_id), position))
            self.out[0, i] = self.out[1, i] = obs
            if rest[1] or rest[2]:
                self.episodes[i] += 1
                self.out[0, i] = self._begin(i)
            found.append(rest)
        rewards, terminated, truncated, metrics = zip(*found, strict=True)
        where = slice(rows[0], rows[-1] + 1)
        return Step(
            self.out[0, where],
            self.out[1, where],
            np.array(rewards, np.float32),
            np.array(terminated),
            np.array(truncated),
            {
                name: np.array([m[name] for m in metrics], np.float32)
                for name in self.episode_metrics
            },
        )

    def state_dict(self, num_steps: int | None = None) -> dict[str, np.ndarray]:
        self._check_idle()
        assert num_steps == self.max_steps
        assert not self.is_numbered
        ids = np.full((num_steps, self.num_envs), -1, np.int32)
        positions = np.zeros((num_steps, self.num_envs, self.position_dim), np.float32)
        for i, log in enumerate(self.log):
            for t, (action_id, position) in enumerate(log):
                ids[t, i], positions[t, i] = action_id, position
        return {
            "seed": np.asarray(self.seed, np.int64),
            "episodes": self.episodes.copy(),
            "lengths": np.array([len(log) for log in self.log]),
            "ids": ids,
            "positions": positions,
        }

    def load_state(self, state: Any) -> None:
        self._check_idle()
        self.events.append("load_state")
        self.seed, self.is_numbered = int(state["seed"]), False
        self.episodes = np.array(state["episodes"])
        for i in range(self.num_envs):
            self._begin(i)
            for t in range(int(state["lengths"][i])):
                action = int(state["ids"][t, i]), np.array(state["positions"][t, i])
                self.envs[i].step(*action)
                self.log[i].append(action)

    def close(self) -> None:
        self.is_closed = True

    def _check_idle(self) -> None:
        assert not self.sent, "a half is running"
        assert not self.is_closed
