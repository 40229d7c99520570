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

        The merge of two samples (Chan, Golub and LeVeque) in the form of increments: what weighs
        more is moved towards what weighs less by the latter's share of the whole. So float32 stays
        accurate over hundreds of millions of values, of which a batch is next to nothing, and for
        batches of any width, beside which the initial count is next to nothing.
        """
        size = batch.shape[0]
        count = self.count + size
        share = size / count
        rest = share * (self.count / size)  # 1 - share, without cancellation.
        batch_mean, batch_variance = jnp.mean(batch, axis=0), jnp.var(batch, axis=0)

        def moved(old: jax.Array, new: jax.Array) -> jax.Array:
            step = new - old
            return jnp.where(share > 0.5, new - rest * step, old + share * step)

        difference = batch_mean - self.mean
        variance = moved(self.variance, batch_variance) + share * rest * difference**2
        return RunningStatistics(moved(self.mean, batch_mean), variance, count)

    @property
    def _scale(self) -> jax.Array:
        """One over the deviation, whose variance has 1e-8 added to it.

        The bound changes no value. Compilers add up constants, of which the initial variance is
        one, so that the sum alone may lose the small one, and a constant feature would be 0 times
        infinity.
        """
        return jax.lax.rsqrt(jnp.maximum(self.variance + _EPSILON, _EPSILON))

    def normalize(self, values: jax.Array) -> jax.Array:
        """`(values - mean) / std`, clipped to +-10."""
        return jnp.clip((values - self.mean) * self._scale, -_CLIP, _CLIP)

    def scale(self, values: jax.Array) -> jax.Array:
        """`values / std`, clipped to +-10; the mean is not subtracted."""
        return jnp.clip(values * self._scale, -_CLIP, _CLIP)
