"""A policy of one's own: its utility of an action depends on what else is available.

`UtilityMethod` scores each available action by itself. Here the actions first look at each other,
through masked self-attention in the light of the state. `docs/your_own_policy.md` explains it.
Run it with `--method=examples.attention_policy:AttentionMethod`.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxnew.environment import Action
from jaxnew.policy.distributions import Categorical
from jaxnew.policy.method import MethodContext
from jaxnew.policy.state_encoder import StateCritic, StateEncoder, apply
from jaxnew.sampling import AvailableSet

WIDTH = 32
NUM_HEADS = 4


class SetUtility(nn.Module):
    """Scores of a set of actions in a state: permuting the set permutes them, padding is unseen."""

    def setup(self) -> None:
        self.embed = nn.Dense(WIDTH)
        self.condition = nn.Dense(WIDTH)
        self.attention = nn.MultiHeadDotProductAttention(num_heads=NUM_HEADS, qkv_features=WIDTH)
        self.hidden = nn.Dense(WIDTH)
        # The first policy is almost uniform, as ours is.
        self.score = nn.Dense(1, kernel_init=nn.initializers.orthogonal(0.01))

    def project(self, representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., 32], what depends on an action alone."""
        return self.embed(representations)

    def __call__(self, features: jax.Array, projected: jax.Array, mask: jax.Array) -> jax.Array:
        """Utilities f32[..., m].

        Args:
          features: f32[..., w] of the state.
          projected: f32[..., m, 32] `project` of the available actions.
          mask: bool[..., m] true for a real entry; what stands in the others does not matter.
        """
        projected = jnp.where(mask[..., None], projected, 0.0)
        tokens = nn.relu(projected + self.condition(features)[..., None, :])
        # Every entry looks at the real ones: [..., heads, looks, looked at].
        seen = self.attention(tokens, mask=mask[..., None, None, :])
        return self.score(nn.relu(self.hidden(tokens + seen)))[..., 0]

    def whole(self, features: jax.Array, representations: jax.Array, mask: jax.Array) -> jax.Array:
        """From representations to utilities; makes all parameters."""
        return self(features, self.project(representations), mask)


class AttentionMethod:
    """A softmax over utilities that look at the whole set. Its sample is the choice."""

    name = "attention"

    def __init__(self, context: MethodContext) -> None:
        self._width = context.network.state_width
        self._encoder = StateEncoder(self._width)
        self._critic = StateCritic(context.network.critic_width)
        self._utility = SetUtility()

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> dict[str, Any]:
        """Fresh parameters for an observation like `obs`; consumes `key`."""
        key_encoder, key_critic, key_utility = jax.random.split(key, 3)
        feature = jnp.zeros(self._width, jnp.float32)
        some_set = jnp.zeros((2, representation_size), jnp.float32), jnp.ones(2, bool)
        return {
            "encoder": self._encoder.init(key_encoder, obs)["params"],
            "critic": self._critic.init(key_critic, obs, feature)["params"],
            "utility": self._utility.init(key_utility, feature, *some_set, method="whole")[
                "params"
            ],
        }

    def project(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., 32]; called with the whole table."""
        return apply(self._utility, params["utility"], representations, method="project")

    def distribution(
        self, params: dict[str, Any], obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        """The policy over the available actions.

        Args:
          params: as `init` makes them.
          obs: f32[..., n] normalised observations, or uint8[..., H, W, C] images.
          projected: f32[..., m, 32] `project` of the available representations.
          mask: bool[..., m] true for a real entry of the set.
        """
        features = apply(self._encoder, params["encoder"], obs)
        utilities = apply(self._utility, params["utility"], features, projected, mask)
        return Categorical.masked(utilities, mask)

    def value(self, params: dict[str, Any], obs: jax.Array) -> jax.Array:
        """f32[...] value of observations, as in `distribution`."""
        features = apply(self._encoder, params["encoder"], obs)
        return apply(self._critic, params["critic"], obs, features)

    def decode(self, sample: jax.Array, available: AvailableSet, table: jax.Array) -> Action:
        """The action behind a choice int32[...] from sets [..., m]."""
        del table
        return Action.of(available.id_of(sample))
