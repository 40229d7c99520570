"""The arrays that a pool and its workers share, and the messages that describe them."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

_ALIGNMENT = 64  # Bytes: a cache line.


class Format(NamedTuple):
    """Shapes and dtypes of an environment; see `HostEnvironment`."""

    observation_shape: tuple[int, ...]
    observation_dtype: str
    position_dim: int
    episode_metrics: tuple[str, ...]


class Setup(NamedTuple):
    """What a worker is.

    Attributes:
      factory, kwargs: see `HostPool`.
      num_envs: N, of the whole pool.
      halves: environments of this worker, as (first, last + 1) for each half.
      core: that it is pinned to, None for no pinning.
    """

    factory: str
    kwargs: dict[str, Any]
    num_envs: int
    halves: tuple[tuple[int, int], ...]
    core: int | None


class Restore(NamedTuple):
    """Where to bring the environments of a worker.

    Attributes:
      seed: of the pool.
      is_numbered: see `episode_key`.
      logs: {environment: (ids int32[L], positions f32[L, k])}, the actions of its running episode;
        the episode's number is in the shared memory.
    """

    seed: int
    is_numbered: bool
    logs: dict[int, tuple[np.ndarray, np.ndarray]]


class Failure(NamedTuple):
    """Why a worker gave up.

    Attributes:
      environment: that raised, None if it was something else.
      activity: what the worker was doing.
      traceback: of the exception.
    """

    environment: int | None
    activity: str
    traceback: str


def episode_key(
    environment: int, episode: int, num_envs: int, is_numbered: bool
) -> tuple[int, ...]:
    """The spawn key that, with the pool's seed, is the seed of an environment's episode.

    Numbered episodes are those of an evaluation: the n-th of all has the same seed in pools of any
    size, since environment i of N plays the episodes i, i + N, ...
    """
    return (episode * num_envs + environment,) if is_numbered else (environment, episode)


@dataclass(frozen=True)
class SharedArrays:
    """One row per environment of the pool, N in all.

    Attributes:
      ids: int32[N], positions: f32[N, k]; the pool writes them.
      episodes: int64[N] number of the running episode; the pool writes them.
      observations: [N, ...] what the policy sees next: of the new episode where one ended.
      final_observations: [N, ...] what the step produced.
      rewards: f32[N]; terminated, truncated: bool[N]; metrics: f32[N, M]; all of the step.
    """

    ids: np.ndarray
    positions: np.ndarray
    episodes: np.ndarray
    observations: np.ndarray
    final_observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    metrics: np.ndarray

    @classmethod
    def over(cls, descriptor: int, format: Format, num_envs: int) -> SharedArrays:
        """Views of a file that `new_memory` made; they keep it mapped as long as they live."""
        size, entries = _layout(format, num_envs)
        memory = mmap.mmap(descriptor, size)
        arrays = {
            name: np.ndarray(shape, dtype, buffer=memory, offset=offset)
            for name, (shape, dtype, offset) in entries.items()
        }
        return cls(**arrays)


def new_memory(format: Format, num_envs: int) -> int:
    """The descriptor of an anonymous file for `SharedArrays`.

    It has no name from the start, so nothing is left of it when its last user is gone, however
    that came about.
    """
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("envs_host_pool")
    else:  # Not on Linux.
        descriptor, path = tempfile.mkstemp()
        os.unlink(path)
    os.ftruncate(descriptor, _layout(format, num_envs)[0])
    return descriptor


def _layout(
    format: Format, num_envs: int
) -> tuple[int, dict[str, tuple[tuple[int, ...], np.dtype[Any], int]]]:
    """Bytes in all; and {name: (shape, dtype, offset)}."""
    n, observation = num_envs, (num_envs, *format.observation_shape)
    entries: dict[str, tuple[tuple[int, ...], Any]] = {
        "ids": ((n,), np.int32),
        "positions": ((n, format.position_dim), np.float32),
        "episodes": ((n,), np.int64),
        "observations": (observation, format.observation_dtype),
        "final_observations": (observation, format.observation_dtype),
        "rewards": ((n,), np.float32),
        "terminated": ((n,), np.bool_),
        "truncated": ((n,), np.bool_),
        "metrics": ((n, len(format.episode_metrics)), np.float32),
    }
    placed, offset = {}, 0
    for name, (shape, dtype) in entries.items():
        placed[name] = (shape, np.dtype(dtype), offset)
        size = math.prod(shape) * np.dtype(dtype).itemsize
        offset += -(-size // _ALIGNMENT) * _ALIGNMENT
    return offset, placed
