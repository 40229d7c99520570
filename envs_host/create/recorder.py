"""Recordings of tools made by the workers of a pool: one step of a `Recorder` is one tool."""

from __future__ import annotations

import atexit
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from envs_host.create.play import NUM_STATES, STATE_SIZE, PlayConfig, record_block
from envs_host.create.poses import POSES_SHAPE, record_poses
from envs_host.pool import HostPool
from envs_host.protocol import Step
from jaxnew.cores import available_cores


class _Kind(NamedTuple):
    """What is recorded: how, and shape and dtype of one recording."""

    record: Callable[..., np.ndarray]
    shape: tuple[int, ...]
    dtype: type[np.generic]


MODALITIES = {
    "state": _Kind(record_block, (NUM_STATES, STATE_SIZE), np.float32),
    "poses": _Kind(record_poses, POSES_SHAPE, np.float64),
}


class Recorder:
    """A host environment without a world: its observation is what action `id` was seen to do.

    Args:
      seed: of the recordings.
      num_recordings: S of each tool.
      modality: `state` f32[S, 7, 6], or `poses` f64[S, 7, 4, 3] (see `record_poses`), which pools
        carry as their bytes u8[S, 672].
      angle_spacing: degrees; which list of tools ids belong to.

    Raises:
      ValueError: there is no such modality.
    """

    position_dim = 0
    episode_metrics: tuple[str, ...] = ()

    def __init__(
        self, seed: int, num_recordings: int, modality: str = "state", angle_spacing: int = 15
    ) -> None:
        kind = _kind_of(modality)
        self.observation_shape: tuple[int, ...] = (num_recordings, *kind.shape)
        self.observation_dtype: type[np.generic] = kind.dtype
        if kind.dtype == np.float64:
            size = math.prod(kind.shape) * np.dtype(kind.dtype).itemsize
            self.observation_shape, self.observation_dtype = (num_recordings, size), np.uint8
        self._record = kind.record
        self._seed = seed
        self._config = PlayConfig(angle_spacing=angle_spacing)

    def reset(self, seed: np.random.SeedSequence) -> np.ndarray:
        """Zeros: nothing has been recorded. What is recorded depends on the argument `seed`."""
        del seed
        return np.zeros(self.observation_shape, self.observation_dtype)

    def step(self, action_id: int, position: np.ndarray) -> Step:
        """Records tool `action_id`."""
        del position
        num_recordings = self.observation_shape[0]
        block = self._record(self._seed, [action_id], num_recordings, self._config)[0]
        seen = block.view(self.observation_dtype).reshape(self.observation_shape)
        return Step(seen, 0.0, False, False, {})


class PoolRecorder:
    """`record_block` or `record_poses` with worker processes, kept from one block to the next.

    The recordings are those of the function itself, whatever the number of workers.

    Args:
      num_workers: processes; 0: as many as there are cores for this one.
      modality: see `Recorder`.
      settings: its further arguments.

    Raises:
      ValueError: there is no such modality.
    """

    def __init__(self, num_workers: int = 0, modality: str = "state", **settings: Any) -> None:
        self._num_workers = num_workers
        self._kind = _kind_of(modality)
        self._settings = {"modality": modality, **settings}
        self._made_for: tuple[int, int] | None = None
        self._pool: HostPool | None = None
        atexit.register(self.close)

    def __call__(self, seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
        """[n, S, ...] recordings of `ids`; see `play.record_block` and `poses.record_poses`."""
        pool = self._pool_for(seed, num_recordings)
        blocks = []
        for first in range(0, len(ids), pool.num_envs):
            some = np.asarray(ids[first : first + pool.num_envs], np.int32)
            padding = np.full(pool.num_envs - len(some), some[0], np.int32)
            step = pool.step(np.concatenate([some, padding]))
            blocks.append(step.observations[: len(some)].copy())
        recorded = np.concatenate(blocks).view(self._kind.dtype)
        return recorded.reshape(len(ids), num_recordings, *self._kind.shape)

    def close(self) -> None:
        """Ends the workers."""
        if self._pool is not None:
            self._pool.close()
            self._pool = self._made_for = None

    def _pool_for(self, seed: int, num_recordings: int) -> HostPool:
        if self._pool is None or self._made_for != (seed, num_recordings):
            self.close()
            workers = self._num_workers or available_cores()
            self._pool = HostPool(
                "envs_host.create.recorder:Recorder",
                {"seed": seed, "num_recordings": num_recordings, **self._settings},
                num_envs=workers,
                num_workers=workers,
                seed=0,
                num_halves=1,
                timeout_s=60.0 + num_recordings,  # A recording takes some milliseconds.
            )
            self._pool.reset()
            self._made_for = (seed, num_recordings)
        return self._pool


def _kind_of(modality: str) -> _Kind:
    if modality not in MODALITIES:
        raise ValueError(f"modality={modality!r} must be one of {tuple(MODALITIES)}.")
    return MODALITIES[modality]
