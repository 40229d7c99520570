"""Distributions over choices and positions, and the choice nearest to a point; safe with masks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax.scipy.special import betaln, digamma

from jaxnew.sampling import AvailableSet

MASKED_LOGIT = -1e9  # Finite, so that a set with every entry masked has no NaN.


@struct.dataclass
class Categorical:
    """A choice among the last axis of `logits`.

    Attributes:
      logits: f32[..., m] unnormalised log-probabilities; `MASKED_LOGIT` where masked. If all
        entries of a set are masked, the distribution is uniform over them.
    """

    logits: jax.Array

    @classmethod
    def masked(cls, logits: jax.Array, mask: jax.Array) -> Categorical:
        """Gives the entries where `mask` (bool[..., m]) is false a probability of zero."""
        return cls(jnp.where(mask, logits, MASKED_LOGIT))

    def sample(self, key: jax.Array) -> jax.Array:
        """int32[...] choices; consumes `key`.

        One uniform number per choice and the inverse of the cumulative probability: the Gumbel
        trick of `jax.random.categorical` draws m numbers and takes 2 m logarithms for each.
        """
        probabilities = jax.nn.softmax(self.logits)
        cumulative = jnp.cumsum(probabilities, axis=-1)
        uniform = jax.random.uniform(key, (*self.logits.shape[:-1], 1), jnp.float32)
        # Sums round, so an entry of probability zero could be reached first. One is always reached:
        # the uniform number is at most 1 - 2**-23, and the product with it rounds below the sum.
        is_reached = (cumulative > uniform * cumulative[..., -1:]) & (probabilities > 0.0)
        return jax.lax.argmax(is_reached, is_reached.ndim - 1, jnp.int32)

    def log_prob(self, choice: jax.Array) -> jax.Array:
        """f32[...] log-probability of int32[...] choices."""
        log_probs = jax.nn.log_softmax(self.logits)
        return jnp.take_along_axis(log_probs, choice[..., None], axis=-1)[..., 0]

    def entropy(self, sample: jax.Array | None = None) -> jax.Array:
        """f32[...] entropy in nats; that of all samples, whichever was drawn."""
        del sample
        log_probs = jax.nn.log_softmax(self.logits)
        return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)

    def mode(self) -> jax.Array:
        """int32[...] most likely choice, the first of equals."""
        return jax.lax.argmax(self.logits, self.logits.ndim - 1, jnp.int32)


_INSIDE = 1e-6  # Distance of a sample from 0 and 1: float32 draws of exactly 1 happen.


@struct.dataclass
class Beta:
    """Independent Beta distributions over f32[..., k] in (0, 1).

    Attributes:
      alpha, beta: f32[..., k], positive.
    """

    alpha: jax.Array
    beta: jax.Array

    def sample(self, key: jax.Array) -> jax.Array:
        """f32[..., k] in [1e-6, 1 - 1e-6]; consumes `key`."""
        drawn = jax.random.beta(key, self.alpha, self.beta, dtype=jnp.float32)
        return jnp.clip(drawn, _INSIDE, 1.0 - _INSIDE)

    def log_prob(self, sample: jax.Array) -> jax.Array:
        """f32[...] joint log-density of a sample f32[..., k] inside (0, 1)."""
        numerator = (self.alpha - 1.0) * jnp.log(sample) + (self.beta - 1.0) * jnp.log1p(-sample)
        return jnp.sum(numerator - betaln(self.alpha, self.beta), axis=-1)

    def entropy(self) -> jax.Array:
        """f32[...] differential entropy in nats, summed over the coordinates."""
        a, b = self.alpha, self.beta
        entropies = (
            betaln(a, b)
            - (a - 1.0) * digamma(a)
            - (b - 1.0) * digamma(b)
            + (a + b - 2.0) * digamma(a + b)
        )
        return jnp.sum(entropies, axis=-1)

    def mode(self) -> jax.Array:
        """f32[..., k] the mean: what the release takes for the most likely position."""
        return self.alpha / (self.alpha + self.beta)


def nearest_id(points: jax.Array, available: AvailableSet, table: jax.Array) -> jax.Array:
    """int32[...] ids of the available actions with the smallest squared L2 distance.

    The first in the set wins a tie.

    Args:
      points: f32[..., d].
      available: sets [..., m], or one set [m] for all points.
      table: f32[A, d] representations.
    """
    differences = table[available.ids] - points[..., None, :]
    distances = jnp.sum(differences**2, axis=-1)
    distances = jnp.where(available.mask, distances, jnp.inf)
    return available.id_of(jax.lax.argmin(distances, distances.ndim - 1, jnp.int32))
