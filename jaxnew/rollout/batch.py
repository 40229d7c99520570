"""What a rollout, on the device or on the host, hands to the learner."""

from __future__ import annotations

from typing import Any

import jax
from flax import struct

from jaxnew.rollout.frames import FrameHistory
from jaxnew.sampling import AvailableSet


@struct.dataclass
class RolloutBatch:
    """`T` steps of `N` parallel environments; every field is `[T, N, ...]`.

    Attributes:
      observation: f32[T, N, ...] as the policy saw it (normalised), or its frames where it saw
        stacks of them.
      available: sets [T, N, m] in force at each step; None where one set stays in force for ever
        (`RolloutConfig.has_fixed_set`), which is not stored for every step.
      sample: what the policy's distribution drew, a pytree.
      log_prob: f32[T, N] log-probability of the sample when it was drawn.
      value: f32[T, N] value of the observation.
      next_value: f32[T, N] value of the observation that the step really produced.
      reward: f32[T, N] reward that the learner sees (scaled in vector-state domains).
      terminated: bool[T, N] natural ends.
      done: bool[T, N] any end.
    """

    observation: jax.Array | FrameHistory
    available: AvailableSet | None
    sample: Any
    log_prob: jax.Array
    value: jax.Array
    next_value: jax.Array
    reward: jax.Array
    terminated: jax.Array
    done: jax.Array

    def observations(self, indices: jax.Array) -> jax.Array:
        """Observations [B, ...] of the transitions int32[B], which count `t * N + n`."""
        if isinstance(self.observation, FrameHistory):
            return self.observation.take(indices)
        return self.observation.reshape(-1, *self.observation.shape[2:])[indices]
