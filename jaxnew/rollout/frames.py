"""Stacks of the last frames, of which every frame is stored once.

A stack of k frames holds the newest last; of an episode that is younger than k frames the older
ones are zeros. 12,288 transitions with stacks of three 84x84 frames are 260 MB as stacks and 87 MB
as frames.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


@struct.dataclass
class FrameHistory:
    """The observations of T steps of N environments, as frames.

    Attributes:
      frames: [T + k - 1, N, H, W]; number `t + k - 1` is what was new at step t.
      age: int32[T, N] steps since the episode's start, of which more than k - 1 need not be told
        apart.
    """

    frames: jax.Array | np.ndarray
    age: jax.Array | np.ndarray

    @property
    def stack_size(self) -> int:
        """k."""
        return int(self.frames.shape[0] - self.age.shape[0] + 1)

    def take(self, indices: jax.Array) -> jax.Array:
        """The stacks [B, H, W, k] of transitions int32[B], which count `t * N + n`."""
        num_envs = self.age.shape[1]
        newest_last = jnp.arange(self.stack_size, dtype=jnp.int32)
        rows = indices[:, None] + num_envs * newest_last
        frames = jnp.asarray(self.frames).reshape(-1, *self.frames.shape[2:])[rows]
        is_there = (
            self.stack_size - 1 - newest_last <= jnp.asarray(self.age).reshape(-1)[indices][:, None]
        )
        frames = jnp.where(is_there[:, :, None, None], frames, jnp.zeros((), frames.dtype))
        return jnp.moveaxis(frames, 1, -1)


def stacks_of(frames: np.ndarray, age: np.ndarray) -> np.ndarray:
    """The stacks [n, H, W, k] that a policy acts on.

    Args:
      frames: [k, n, H, W] the last ones, newest last.
      age: int[n] steps since the episode's start.
    """
    k = len(frames)
    is_there = np.arange(k - 1, -1, -1)[:, None] <= age
    shown = np.where(is_there[:, :, None, None], frames, np.zeros((), frames.dtype))
    return np.moveaxis(shown, 0, -1)
