"""Environments that cost nothing or a known amount; workers import this module, so no jax in it."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from envs_host.protocol import GymnasiumHost


class Toy(gymnasium.Env[Any, Any]):
    """Shows one 84 x 84 picture for ever, and burns processor time before it does.

    Args:
      work_ms: of this thread, per step.
    """

    observation_space = spaces.Box(0, 255, (84, 84), np.uint8)
    action_space = spaces.Dict(
        {"id": spaces.Discrete(100), "position": spaces.Box(-1.0, 1.0, (2,), np.float32)}
    )

    def __init__(self, work_ms: float = 0.0) -> None:
        self._work_ns = int(1e6 * work_ms)
        self._picture = np.zeros((84, 84), np.uint8)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return self._picture, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        end = time.thread_time_ns() + self._work_ns
        while self._work_ns and time.thread_time_ns() < end:
            pass
        return self._picture, 0.0, False, False, {}


def host_toy(work_ms: float) -> GymnasiumHost:
    """The same in the pool's form."""
    return GymnasiumHost(Toy(work_ms))
