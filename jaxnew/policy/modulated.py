"""Ours with other utilities, and with heads that foretell failures (docs/method.md, "Modulated
utility").

It learns as any utility policy does; what is foretold is learned beside it, and counts in
evaluations only.
"""

from __future__ import annotations

import copy
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.distributions import Categorical
from jaxnew.policy.state_encoder import apply
from jaxnew.policy.utility import UTILITY_GAIN, Utility, UtilityMethod

_HIDDEN_GAIN = 2.0**0.5
NUM_HEADS = 4
HEAD_WIDTH = 32
CAUTION = 8.0  # Weight of the log-probability that there is no failure, in evaluations.


class ModulatedUtility(Utility):
    """Utilities whose last weights depend on the state.

        a = ReLU( Lin(d, w)(c) )
        x = ReLU( Lin(2 w, h)( [f, a] ) )
        u = sum of Lin(w, h)(f) * x

    In each state it is a network of its own from embeddings to utilities. Hidden layers have the
    usual gain of sqrt(2).
    """

    gain = _HIDDEN_GAIN

    @property
    def num_scores(self) -> int:
        """One weight for each number of the hidden layer."""
        return self.network.utility_width

    def embedded(self, representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., w], the action alone."""
        return nn.relu(self.embed(representations))

    def scored(self, features: jax.Array, hidden: jax.Array, mask: jax.Array) -> Categorical:
        """The policy from features f32[..., w] and the hidden layer f32[..., m, h]."""
        utilities = jnp.sum(hidden * self.score(features)[..., None, :], axis=-1)
        return Categorical.masked(utilities, mask)


class FailureHeads(nn.Module):
    """The log-odds that an action ends the episode for less than expected, as each of E heads has
    them.

        x = ReLU( Lin(2 w, k)( [f, a] ) )
        o = sum of Lin(w, k)(f) * x + Lin(w, 1)(f)

    Heads differ in where their weights start, so that they agree about what they have seen and
    need not about anything else.
    """

    def setup(self) -> None:
        init = nn.initializers.orthogonal(_HIDDEN_GAIN)
        size = NUM_HEADS * HEAD_WIDTH
        self.of_action = nn.Dense(size, kernel_init=init)
        self.of_state = nn.Dense(size, kernel_init=init, use_bias=False)
        last = nn.initializers.orthogonal(UTILITY_GAIN)
        self.weights = nn.Dense(size + NUM_HEADS, kernel_init=last)

    def project(self, embedded: jax.Array) -> jax.Array:
        """f32[..., w] -> f32[..., E k], the action's share of the hidden layers."""
        return self.of_action(embedded)

    def __call__(self, features: jax.Array, projected: jax.Array) -> jax.Array:
        """f32[..., m, E] from features f32[..., w] and projected actions f32[..., m, E k]."""
        hidden = nn.relu(self.of_state(features)[..., None, :] + projected)
        hidden = hidden.reshape(*hidden.shape[:-1], NUM_HEADS, HEAD_WIDTH)
        weights = self.weights(features)[..., None, :]
        weights = weights.reshape(*weights.shape[:-1], NUM_HEADS, HEAD_WIDTH + 1)
        return jnp.sum(hidden * weights[..., :-1], axis=-1) + weights[..., -1]


@struct.dataclass
class FeaturedCategorical(Categorical):
    """A choice that knows the state feature that it was made from.

    Attributes:
      features: f32[..., w].
    """

    features: jax.Array


class ModulatedMethod(UtilityMethod):
    """A utility policy with a `ModulatedUtility`, `FailureHeads`, and ReLUs in its state encoder.

    It reads representations in their own unit: less their mean, over their deviation, one number,
    so that the shape of their space stays.

    Args:
      network: sizes.
      representations: f32[n, d] those that have the unit; None: they are read as they are.
    """

    name = "modulated"
    utility_type = ModulatedUtility
    activation = staticmethod(nn.relu)

    def __init__(
        self,
        network: NetworkConfig | None = None,
        representations: np.ndarray | None = None,
    ) -> None:
        super().__init__(network)
        self._heads = FailureHeads()
        self._is_cautious = False
        seen = np.zeros(1) if representations is None else np.asarray(representations, np.float64)
        self._mean = np.float32(seen.mean(axis=0))
        deviation = np.sqrt(seen.var(axis=0).mean())
        self._unit = np.float32(deviation if deviation > 0 else 1.0)

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> dict[str, Any]:
        """Fresh parameters for an observation like `obs`; consumes `key`."""
        key, key_heads = jax.random.split(key)
        feature = jnp.zeros(self.network.state_width, jnp.float32)
        projected = jnp.zeros((1, NUM_HEADS * HEAD_WIDTH), jnp.float32)
        heads = self._heads.init(key_heads, feature, projected)["params"]
        of_action = self._heads.init(key_heads, feature, method="project")["params"]
        return {**super().init(key, obs, representation_size), "failure": {**heads, **of_action}}

    def for_evaluation(self) -> ModulatedMethod:
        """It with utilities `u - 8 max softplus(o)`, the log-odds `o` of the head that is most
        afraid; same parameters.
        """
        cautious = copy.copy(self)
        cautious._is_cautious = True
        return cautious

    def project(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., h], and the share of the heads where they count."""
        projected = super().project(params, self._in_unit(representations))
        if not self._is_cautious:
            return projected
        share = self._share_of_heads(params, representations)
        return jnp.concatenate([projected, share], axis=-1)

    def distribution_of(
        self, params: dict[str, Any], features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> FeaturedCategorical:
        """The policy over the available actions; see `UtilityMethod`."""
        rows, share = jnp.split(projected, [self.network.utility_width], axis=-1)
        logits = super().distribution_of(params, features, rows, mask).logits
        if self._is_cautious:
            odds = jnp.max(apply(self._heads, params["failure"], features, share), axis=-1)
            logits = Categorical.masked(logits - CAUTION * nn.softplus(odds), mask).logits
        return FeaturedCategorical(logits, features)

    def failure_loss(
        self,
        params: dict[str, Any],
        distribution: FeaturedCategorical,
        representations: jax.Array,
        is_failure: jax.Array,
    ) -> jax.Array:
        """f32[...] minus the log-probabilities that the heads give to what came of actions
        f32[..., d] that were taken from a distribution [...], summed over heads.
        """
        share = self._share_of_heads(params, representations)[..., None, :]
        odds = apply(self._heads, params["failure"], distribution.features, share)[..., 0, :]
        labels = jnp.broadcast_to(is_failure[..., None], odds.shape).astype(jnp.float32)
        return jnp.sum(optax.sigmoid_binary_cross_entropy(odds, labels), axis=-1)

    def embed(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., w]: the `a` of the utility."""
        return super().embed(params, self._in_unit(representations))

    def _share_of_heads(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        embedded = self.embed(params, representations)
        return apply(self._heads, params["failure"], embedded, method="project")

    def _in_unit(self, representations: jax.Array) -> jax.Array:
        return (representations - self._mean) / self._unit
