"""What the methods share: a distribution that is made of a state feature, and a critic."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxnew.policy.state_encoder import FEATURE_SIZE, StateCritic, apply, is_image

Params = dict[str, Any]


class FeatureMethod:
    """Base of methods that have `features` and `distribution_of`, and keep a critic's parameters in
    `params["critic"]`."""

    _critic = StateCritic()

    def init_critic(self, key: jax.Array, obs: jax.Array) -> Any:
        """Fresh parameters of the critic; consumes `key`."""
        return self._critic.init(key, obs, jnp.zeros(FEATURE_SIZE))["params"]

    def features(self, params: Params, obs: jax.Array) -> jax.Array:
        """f32[..., 64] the state feature."""
        raise NotImplementedError

    def distribution_of(
        self, params: Params, features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Any:
        """`distribution` from the state feature f32[..., 64]."""
        raise NotImplementedError

    def distribution(
        self, params: Params, obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Any:
        """What is sampled from; see `jaxnew.policy.method.PolicyMethod`.

        Args:
          params: as `init` makes them.
          obs: f32[..., n] normalised observations, or uint8[..., H, W, C] images.
          projected: `project` of the available representations, [..., m, p].
          mask: bool[..., m] true for a real entry of the set.
        """
        return self.distribution_of(params, self.features(params, obs), projected, mask)

    def value(self, params: Params, obs: jax.Array) -> jax.Array:
        """f32[...] values of observations, as in `distribution`."""
        return self.value_of(params, obs, self.features(params, obs))

    def value_of(self, params: Params, obs: jax.Array, features: jax.Array) -> jax.Array:
        """`value` where the state feature is known."""
        return apply(self._critic, params["critic"], obs, features)

    def distribution_and_value(
        self, params: Params, obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> tuple[Any, jax.Array]:
        """Both; of images with one pass, and one backward pass, through the trunk they share."""
        if not is_image(obs):
            return self.distribution(params, obs, projected, mask), self.value(params, obs)
        features = self.features(params, obs)
        distribution = self.distribution_of(params, features, projected, mask)
        return distribution, self.value_of(params, obs, features)
