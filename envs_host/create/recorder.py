"""Recordings of tools made by the workers of a pool: one step of a `Recorder` is one tool."""

from __future__ import annotations

import atexit
import os
from typing import Any

import numpy as np

from envs_host.create.play import NUM_STATES, STATE_SIZE, PlayConfig, record_block
from envs_host.pool import HostPool
from envs_host.protocol import Step

MODALITIES = ("state",)


class Recorder:
    """A host environment without a world: its observation is what action `id` was seen to do.

    Args:
      seed: of the recordings.
      num_recordings: S of each tool.
      modality: `state` f32[S, 7, 6].
      angle_spacing: degrees; which list of tools ids belong to.
    """

    position_dim = 0
    episode_metrics: tuple[str, ...] = ()
    observation_dtype = np.float32

    def __init__(
        self, seed: int, num_recordings: int, modality: str = "state", angle_spacing: int = 15
    ) -> None:
        if modality not in MODALITIES:
            raise ValueError(f"modality={modality!r} must be one of {MODALITIES}.")
        self.observation_shape = (num_recordings, NUM_STATES, STATE_SIZE)
        self._seed = seed
        self._config = PlayConfig(angle_spacing=angle_spacing)

    def reset(self, seed: np.random.SeedSequence) -> np.ndarray:
        """Zeros: nothing has been recorded. What is recorded depends on the argument `seed`."""
        del seed
        return np.zeros(self.observation_shape, self.observation_dtype)

    def step(self, action_id: int, position: np.ndarray) -> Step:
        """Records tool `action_id`."""
        del position
        block = record_block(self._seed, [action_id], self.observation_shape[0], self._config)
        return Step(block[0], 0.0, False, False, {})


class PoolRecorder:
    """`record_block` with worker processes, which are kept from one block to the next.

    The recordings are those of `play.record_block`, whatever the number of workers.

    Args:
      num_workers: processes; 0: as many as there are cores for this one.
      settings: further arguments of `Recorder`.
    """

    def __init__(self, num_workers: int = 0, **settings: Any) -> None:
        self._num_workers = num_workers
        self._settings = settings
        self._made_for: tuple[int, int] | None = None
        self._pool: HostPool | None = None
        atexit.register(self.close)

    def __call__(self, seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
        """[n, S, ...] recordings of `ids`; see `play.record_block`."""
        pool = self._pool_for(seed, num_recordings)
        blocks = []
        for first in range(0, len(ids), pool.num_envs):
            some = np.asarray(ids[first : first + pool.num_envs], np.int32)
            padding = np.full(pool.num_envs - len(some), some[0], np.int32)
            step = pool.step(np.concatenate([some, padding]))
            blocks.append(step.observations[: len(some)].copy())
        return np.concatenate(blocks)

    def close(self) -> None:
        """Ends the workers."""
        if self._pool is not None:
            self._pool.close()
            self._pool = self._made_for = None

    def _pool_for(self, seed: int, num_recordings: int) -> HostPool:
        if self._pool is None or self._made_for != (seed, num_recordings):
            self.close()
            workers = self._num_workers or len(os.sched_getaffinity(0))
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
