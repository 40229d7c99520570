"""The continuous-output baseline: a point in the space of representations.

`docs/method.md`, "Baselines and ablations".
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from jaxnew.environment import Action
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.distributions import nearest_id
from jaxnew.policy.state_encoder import FeatureMethod, StateEncoder, apply, orthogonal_dense
from jaxnew.sampling import AvailableSet

_LOG_TWO_PI = 1.8378770664093453
_LOG_PROB_BOUND = 1e5  # Only ever reached in the hybrid environments.


@struct.dataclass
class DiagonalGaussian:
    """A normal distribution over f32[..., d] with independent dimensions.

    Attributes:
      mean: f32[..., d].
      variance: f32[..., d], positive.
      sums_entropy: whether `entropy` is summed over the d dimensions or averaged.
    """

    mean: jax.Array
    variance: jax.Array
    sums_entropy: bool = struct.field(pytree_node=False, default=False)

    def sample(self, key: jax.Array) -> jax.Array:
        """f32[..., d]; consumes `key`."""
        noise = jax.random.normal(key, self.mean.shape, jnp.float32)
        return self.mean + jnp.sqrt(self.variance) * noise

    def log_prob(self, sample: jax.Array) -> jax.Array:
        """f32[...] joint log-density of a sample f32[..., d]."""
        squares = (sample - self.mean) ** 2 / self.variance
        log_prob = -0.5 * jnp.sum(squares + jnp.log(self.variance) + _LOG_TWO_PI, axis=-1)
        return jnp.clip(log_prob, -_LOG_PROB_BOUND, _LOG_PROB_BOUND)

    def entropy(self, sample: jax.Array | None = None) -> jax.Array:
        """f32[...] entropy in nats, of all dimensions or per dimension."""
        del sample
        per_dimension = 0.5 * (1.0 + _LOG_TWO_PI + jnp.log(self.variance))
        reduce = jnp.sum if self.sums_entropy else jnp.mean
        return reduce(per_dimension, axis=-1)

    def mode(self) -> jax.Array:
        """f32[..., d]."""
        return self.mean


class _GaussianPolicy(nn.Module):
    """Observation -> mean and variance, f32[..., d] each."""

    size: int
    width: int

    def setup(self) -> None:
        self.encoder = StateEncoder(self.width)
        self.mean = orthogonal_dense(self.size, 1.0)
        self.variance = orthogonal_dense(self.size, 1.0)

    def features(self, obs: jax.Array) -> jax.Array:
        return self.encoder(obs)

    def output(self, features: jax.Array) -> tuple[jax.Array, jax.Array]:
        return self.mean(features), nn.softplus(self.variance(features))

    def __call__(self, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        return self.output(self.features(obs))


class ContinuousMethod(FeatureMethod):
    """Samples a point; the nearest available action is taken. PPO runs on the point."""

    name = "continuous"

    def __init__(self, sums_entropy: bool = False, network: NetworkConfig | None = None) -> None:
        super().__init__(network)
        self._sums_entropy = sums_entropy

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> dict[str, Any]:
        """Fresh parameters for an observation like `obs`; consumes `key`."""
        key_policy, key_critic = jax.random.split(key)
        return {
            "policy": self._policy(representation_size).init(key_policy, obs)["params"],
            "critic": self.init_critic(key_critic, obs),
        }

    def project(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """The representations themselves."""
        del params
        return representations

    def features(self, params: dict[str, Any], obs: jax.Array) -> jax.Array:
        """f32[..., w] the state feature."""
        return apply(self._policy(0), params["policy"], obs, method="features")

    def distribution_of(
        self, params: dict[str, Any], features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> DiagonalGaussian:
        """`distribution` from the state feature f32[..., w]."""
        del mask
        policy = self._policy(projected.shape[-1])
        both = apply(policy, params["policy"], features, method="output")
        return DiagonalGaussian(both[0], both[1], self._sums_entropy)

    def decode(self, sample: jax.Array, available: AvailableSet, table: jax.Array) -> Action:
        """The available action nearest to each point."""
        return Action.of(nearest_id(sample, available, table))

    def _policy(self, size: int) -> _GaussianPolicy:
        """The network that gives points of `size` numbers."""
        return _GaussianPolicy(size, self.network.state_width)
