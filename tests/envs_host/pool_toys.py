"""Environments for the tests of the pool; workers import them from here."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

NAME = "tests.envs_host.pool_toys"
CHAOTIC, FAULTY = f"{NAME}:Chaotic", f"{NAME}:Faulty"


class Chaotic:
    """A logistic map in float64: any other seed, action or order changes every bit soon.

    It ends where the map leads it below 0.02, and after 25 steps at the latest.
    """

    observation_shape = (3, 2)
    observation_dtype = np.float32
    position_dim = 2
    episode_metrics = ("length", "total")

    def reset(self, seed: np.random.SeedSequence) -> np.ndarray:
        self.x = float(np.random.default_rng(seed).uniform(0.1, 0.9))
        self.length, self.total = 0, 0.0
        return self.observe()

    def step(
        self, action_id: int, position: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, float]]:
        kick = 1e-3 * action_id + 1e-3 * float(position[0]) - 1e-4 * float(position[1])
        self.x = 3.99 * self.x * (1.0 - self.x) + kick
        self.x -= np.floor(self.x)
        self.length += 1
        self.total += self.x
        metrics = {"total": self.total, "length": self.length}
        return self.observe(), self.x - 0.5, self.x < 0.02, self.length == 25, metrics

    def observe(self) -> np.ndarray:
        return np.linspace(self.x, 1e3 * self.x, 6, dtype=np.float32).reshape(3, 2)


class Faulty(Chaotic):
    """Misbehaves once, or always, at the first step with action 99.

    Args:
      fault: what it does.
      once: a file; the fault happens only if it does not exist, and makes it. None: always.
    """

    def __init__(self, fault: str, once: str | None = None) -> None:
        self.fault, self.once = fault, once

    def step(self, action_id: int, position: np.ndarray) -> Any:
        if action_id == 99 and not (self.once and Path(self.once).exists()):
            if self.once:
                Path(self.once).touch()
            misbehave(self.fault)
        return super().step(action_id, position)


class Unfaithful(Chaotic):
    """Depends on more than its seed: on the process, or on what it did before.

    Args:
      how: "start", its first observations are others in another process; or "length", its second
        episode in one process ends after a step.
    """

    def __init__(self, how: str) -> None:
        self.how, self.num_episodes = how, 0

    def reset(self, seed: np.random.SeedSequence) -> np.ndarray:
        super().reset(seed)
        self.num_episodes += 1
        if self.how == "start":
            self.x = (self.x + os.getpid() % 1000 / 1000.0) % 1.0
        return self.observe()

    def step(self, action_id: int, position: np.ndarray) -> Any:
        observation, reward, _, _, metrics = super().step(action_id, position)
        is_short = self.how == "length" and self.num_episodes > 1
        return observation, reward, is_short, False, metrics


class Broken(Chaotic):
    """Is not what it declares.

    Args:
      how: shape, dtype or metrics, of its steps; int64 or differing, of its declaration,
        or process: it declares something else in every process.
    """

    num_made = 0

    def __init__(self, how: str) -> None:
        Broken.num_made += 1
        self.how = how
        if how == "int64":
            self.observation_dtype = np.int64
        if how == "differing":
            self.position_dim = Broken.num_made
        if how == "process":
            self.position_dim = os.getpid() % 1000

    def step(self, action_id: int, position: np.ndarray) -> Any:
        observation, *others, metrics = super().step(action_id, position)
        if self.how == "shape":
            observation = observation[0]
        if self.how == "dtype":
            observation = observation.astype(np.float64)
        if self.how == "metrics":
            del metrics["total"]
        return (observation, *others, metrics)


class Spy(Chaotic):
    """Tells about its process, and prints what is done to it."""

    position_dim = 0
    episode_metrics = ("has_jax", "ignores_sigint", "num_threads", "num_cores", "pid")

    def step(self, action_id: int, position: np.ndarray) -> Any:
        assert position.shape == (0,)
        print(f"printed by {action_id}")
        observation, reward, terminated, truncated, _ = super().step(action_id, np.zeros(2))
        metrics = {
            "has_jax": "jax" in sys.modules,
            "ignores_sigint": signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            and signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, []),
            "num_threads": float(os.environ["OMP_NUM_THREADS"]),
            "num_cores": len(os.sched_getaffinity(0)),
            "pid": os.getpid() % 2**16,
        }
        return observation, reward, terminated, truncated, metrics

    def close(self) -> None:
        print("closed")


def misbehave(fault: str) -> None:
    sys.stdout.write(f"about to {fault}\n")  # In one piece: workers share the pipe. `print` is two.
    if fault == "raise":
        raise ZeroDivisionError("a fault in the physics")
    if fault == "exit":
        sys.exit("an environment that ends the process")
    if fault == "hang":
        while True:
            time.sleep(1000.0)
    if fault == "segfault":
        signal.raise_signal(signal.SIGSEGV)
    os.kill(os.getpid(), getattr(signal, fault))
