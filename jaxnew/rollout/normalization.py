"""Running statistics of observations and of returns (docs/method.md, "Normalisation")."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

_INITIAL_COUNT = 1e-4
_EPSILON = 1e-8
_CLIP = 10.0


@struct.dataclass
class RunningStatistics:
    """Mean and (population) variance of all values seen, per feature.

    Attributes:
      mean: f32[...] shape of one value.
      variance: f32[...] likewise.
      count: f32[] number of values seen, plus the initial 1e-4.
    """

    mean: jax.Array
    variance: jax.Array
    count: jax.Array

    @classmethod
    def zeros(cls, shape: tuple[int, ...]) -> RunningStatistics:
        """Mean 0 and variance 1 that the first batch all but replaces."""
        return cls(
            jnp.zeros(shape, jnp.float32), jnp.ones(shape, jnp.float32), jnp.float32(_INITIAL_COUNT)
        )

    def update(self, batch: jax.Array) -> RunningStatistics:
        """Statistics after one more batch f32[N, ...].

        The merge of two samples in the form of increments, which keeps float32 accurate over
        hundreds of millions of values: with `w` the share of the batch in the whole,
        `variance += w * (batch_variance - variance) + w * (1 - w) * difference^2`.
        """
        count = self.count + batch.shape[0]
        weight = batch.shape[0] / count
        difference = jnp.mean(batch, axis=0) - self.mean
        variance = self.variance + weight * (
            jnp.var(batch, axis=0) - self.variance + (1.0 - weight) * difference**2
        )
        return RunningStatistics(self.mean + weight * difference, variance, count)

    def normalize(self, values: jax.Array) -> jax.Array:
        """`(values - mean) / std`, clipped to +-10."""
        scaled = (values - self.mean) * jax.lax.rsqrt(self.variance + _EPSILON)
        return jnp.clip(scaled, -_CLIP, _CLIP)

    def scale(self, values: jax.Array) -> jax.Array:
        """`values / std`, clipped to +-10; the mean is not subtracted."""
        return jnp.clip(values * jax.lax.rsqrt(self.variance + _EPSILON), -_CLIP, _CLIP)
