"""The utility policy (paper section 4.2): scores each action of any set.

The utility of an action with representation `c` in a state with feature `f` is

    a = Lin(d, 64)(c)
    u = Lin(64, 1)( ReLU( Lin(128, 64)( [f, a] ) ) )

and the policy is the softmax of the utilities of the available actions. The first 64 rows of the
middle weight only ever meet `f` and the last 64 only `a`: `[f, a] @ W = f @ W[:64] + a @ W[64:]`.
The second term depends on the action alone: `project` computes it once for a whole table, and what
is left per state and action is an addition, a ReLU and a dot product with 64 numbers.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxnew.environment import Action
from jaxnew.policy.distributions import Categorical
from jaxnew.policy.state_encoder import FEATURE_SIZE, FeatureMethod, StateEncoder, apply
from jaxnew.sampling import AvailableSet

HIDDEN_SIZE = 64
_UTILITY_GAIN = 0.01  # The initial policy is almost exactly uniform.


class Utility(nn.Module):
    """Scores of representations in a state; see the module docstring."""

    def setup(self) -> None:
        init = nn.initializers.orthogonal(_UTILITY_GAIN)
        self.embed = nn.Dense(FEATURE_SIZE, kernel_init=init)
        self.kernel = self.param("kernel", init, (2 * FEATURE_SIZE, HIDDEN_SIZE), jnp.float32)
        self.bias = self.param("bias", nn.initializers.zeros, (HIDDEN_SIZE,), jnp.float32)
        self.score = nn.Dense(1, kernel_init=init)

    def embedded(self, representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., 64], the action alone."""
        return self.embed(representations)

    def project(self, representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., 64], the action's share of the hidden layer, bias included."""
        return self.embed(representations) @ self.kernel[FEATURE_SIZE:] + self.bias

    def __call__(self, features: jax.Array, projected: jax.Array) -> jax.Array:
        """Utilities f32[..., m] from features f32[..., 64] and projected actions [..., m, 64]."""
        hidden = (features @ self.kernel[:FEATURE_SIZE])[..., None, :] + projected
        return self.score(nn.relu(hidden))[..., 0]

    def concatenated(self, features: jax.Array, representations: jax.Array) -> jax.Array:
        """The same utilities f32[..., m] as the paper writes them, from vectors f32[..., m, d].

        Kept as the reference for tests and benchmarks.
        """
        embedded = self.embed(representations)
        features = jnp.broadcast_to(features[..., None, :], (*embedded.shape[:-1], FEATURE_SIZE))
        hidden = jnp.concatenate([features, embedded], axis=-1) @ self.kernel + self.bias
        return self.score(nn.relu(hidden))[..., 0]


class UtilityMethod(FeatureMethod):
    """Ours: a softmax over the utilities of the available actions. Its sample is the choice."""

    name = "ours"

    def __init__(self) -> None:
        self._encoder = StateEncoder()
        self._utility = Utility()

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> dict[str, Any]:
        """Fresh parameters for an observation like `obs`; consumes `key`."""
        key_encoder, key_critic, key_utility = jax.random.split(key, 3)
        return {
            "encoder": self._encoder.init(key_encoder, obs)["params"],
            "critic": self.init_critic(key_critic, obs),
            "utility": self._utility.init(
                key_utility,
                jnp.zeros(FEATURE_SIZE, jnp.float32),
                jnp.zeros((1, representation_size), jnp.float32),
                method="concatenated",
            )["params"],
        }

    def project(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., 64]: all that the policy needs of an action, in any state."""
        return apply(self._utility, params["utility"], representations, method="project")

    def features(self, params: dict[str, Any], obs: jax.Array) -> jax.Array:
        """f32[..., 64] the state feature `f(s)`."""
        return apply(self._encoder, params["encoder"], obs)

    def distribution_of(
        self, params: dict[str, Any], features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        """The policy over the available actions.

        Args:
          params: as `init` makes them.
          features: f32[..., 64] state features.
          projected: f32[..., m, 64] `project` of the available representations.
          mask: bool[..., m] true for a real entry of the set.
        """
        utilities = apply(self._utility, params["utility"], features, projected)
        return Categorical.masked(utilities, mask)

    def embed(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., 64]: the `a` of the module docstring."""
        return apply(self._utility, params["utility"], representations, method="embedded")

    def decode(self, sample: jax.Array, available: AvailableSet, table: jax.Array) -> Action:
        """The action behind a choice int32[...] from sets [..., m]."""
        del table
        return Action.of(available.id_of(sample))


class RandomMethod(UtilityMethod):
    """Uniform over the available actions, whatever its parameters. For reference; does not learn.

    The release draws logits from U(0, 1) anew at every step: as they are
    exchangeable, every action is as likely as any other.
    """

    name = "random"

    def distribution_of(
        self, params: dict[str, Any], features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        """The uniform distribution over the real entries."""
        del params, projected
        logits = jnp.zeros((*features.shape[:-1], mask.shape[-1]), jnp.float32)
        return Categorical.masked(logits, mask)
