"""Utility policies (paper section 4.2): they score each action of any set.

The utility of an action with representation `c` in a state with feature `f` is, with the paper's
widths of 64,

    a = Lin(d, 64)(c)
    u = Lin(64, 1)( ReLU( Lin(128, 64)( [f, a] ) ) )

and the policy is the softmax of the utilities of the available actions. The first 64 rows of the
middle weight only ever meet `f` and the last 64 only `a`: `[f, a] @ W = f @ W[:64] + a @ W[64:]`.
The second term depends on the action alone: `project` computes it once for a whole table, and what
is left per state and action is an addition, a ReLU and a dot product with 64 numbers.
"""

from __future__ import annotations

from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxnew.environment import Action
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.distributions import Categorical
from jaxnew.policy.state_encoder import Activation, FeatureMethod, StateEncoder, apply
from jaxnew.sampling import AvailableSet

UTILITY_GAIN = 0.01  # The initial policy is almost exactly uniform.


class Utility(nn.Module):
    """Scores of representations in a state; see the module docstring.

    Attributes:
      network: sizes; w below is its `state_width`, h its `utility_width`.
    """

    network: NetworkConfig = NetworkConfig()
    gain = UTILITY_GAIN  # Of all layers but the last.

    def setup(self) -> None:
        width, hidden = self.network.state_width, self.network.utility_width
        init = nn.initializers.orthogonal(self.gain)
        self.embed = nn.Dense(width, kernel_init=init)
        self.kernel = self.param("kernel", init, (2 * width, hidden), jnp.float32)
        self.bias = self.param("bias", nn.initializers.zeros, (hidden,), jnp.float32)
        last = nn.initializers.orthogonal(UTILITY_GAIN)
        self.score = nn.Dense(self.num_scores, kernel_init=last)

    @property
    def num_scores(self) -> int:
        """Outputs of the last layer."""
        return 1

    def embedded(self, representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., w], the action alone."""
        return self.embed(representations)

    def project(self, representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., h], the action's share of the hidden layer, bias included."""
        return self.embedded(representations) @ self.kernel[self.network.state_width :] + self.bias

    def __call__(self, features: jax.Array, projected: jax.Array, mask: jax.Array) -> Categorical:
        """The policy over projected actions [..., m, h] with features f32[..., w].

        Args:
          mask: bool[..., m] true for a real entry.
        """
        hidden = (features @ self.kernel[: self.network.state_width])[..., None, :] + projected
        return self.scored(features, nn.relu(hidden), mask)

    def scored(self, features: jax.Array, hidden: jax.Array, mask: jax.Array) -> Categorical:
        """The policy from features f32[..., w] and the hidden layer f32[..., m, h]."""
        del features
        return Categorical.masked(self.score(hidden)[..., 0], mask)

    def concatenated(self, features: jax.Array, representations: jax.Array) -> jax.Array:
        """The utilities f32[..., m] as the paper writes them, from vectors f32[..., m, d].

        Kept as the reference for tests and benchmarks.
        """
        embedded = self.embedded(representations)
        repeated = jnp.broadcast_to(
            features[..., None, :], (*embedded.shape[:-1], features.shape[-1])
        )
        hidden = jnp.concatenate([repeated, embedded], axis=-1) @ self.kernel + self.bias
        mask = jnp.ones(embedded.shape[:-1], bool)
        return self.scored(features, nn.relu(hidden), mask).logits


class UtilityMethod(FeatureMethod):
    """Ours: a softmax over the utilities of the available actions. Its sample is the choice.

    Attributes:
      network: sizes; w below is its `state_width`, h its `utility_width`.
    """

    name = "ours"
    utility_type: type[Utility] = Utility
    activation: Activation = staticmethod(nn.tanh)

    def __init__(self, network: NetworkConfig | None = None) -> None:
        super().__init__(network)
        self._encoder = StateEncoder(self.network.state_width, self.activation)
        self._utility = self.utility_type(self.network)

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> dict[str, Any]:
        """Fresh parameters for an observation like `obs`; consumes `key`."""
        key_encoder, key_critic, key_utility = jax.random.split(key, 3)
        return {
            "encoder": self._encoder.init(key_encoder, obs)["params"],
            "critic": self.init_critic(key_critic, obs),
            "utility": self._utility.init(
                key_utility,
                jnp.zeros(self.network.state_width, jnp.float32),
                jnp.zeros((1, representation_size), jnp.float32),
                method="concatenated",
            )["params"],
        }

    def project(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., h]: all that the policy needs of an action, in any state."""
        return apply(self._utility, params["utility"], representations, method="project")

    def features(self, params: dict[str, Any], obs: jax.Array) -> jax.Array:
        """f32[..., w] the state feature `f(s)`."""
        return apply(self._encoder, params["encoder"], obs)

    def distribution_of(
        self, params: dict[str, Any], features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        """The policy over the available actions.

        Args:
          params: as `init` makes them.
          features: f32[..., w] state features.
          projected: f32[..., m, h] `project` of the available representations.
          mask: bool[..., m] true for a real entry of the set.
        """
        variables = {"params": params["utility"]}
        return cast(Categorical, self._utility.apply(variables, features, projected, mask))

    def embed(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """f32[..., d] -> f32[..., w]: the `a` of the utility."""
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
