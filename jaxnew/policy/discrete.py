"""A discrete policy over the train actions; elsewhere the nearest action acts.

`docs/method.md`, "Baselines and ablations".
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.environment import Action
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.distributions import Categorical, nearest_id
from jaxnew.policy.state_encoder import FeatureMethod, StateEncoder, apply, orthogonal_dense
from jaxnew.sampling import AvailableSet

_HEAD_GAIN = 0.01


class _DiscretePolicy(nn.Module):
    """Observation -> logits f32[..., num_actions]."""

    num_actions: int
    width: int

    def setup(self) -> None:
        self.encoder = StateEncoder(self.width)
        self.logits = orthogonal_dense(self.num_actions, _HEAD_GAIN)

    def features(self, obs: jax.Array) -> jax.Array:
        return self.encoder(obs)

    def output(self, features: jax.Array) -> jax.Array:
        return self.logits(features)

    def __call__(self, obs: jax.Array) -> jax.Array:
        return self.output(self.features(obs))


class DiscreteMethod(FeatureMethod):
    """One logit per train action. Its sample is an index into `train_ids`.

    What acts is the available action whose representation is nearest to that of the sampled train
    action: where all train actions are available, that action itself.

    Raises:
      ValueError: there is no train action.
    """

    name = "discrete"

    def __init__(self, train_ids: np.ndarray, network: NetworkConfig | None = None) -> None:
        super().__init__(network)
        if len(train_ids) == 0:
            raise ValueError("The discrete method needs the ids of the actions it is trained on.")
        self._train_ids = np.asarray(train_ids, np.int32)
        self._policy = _DiscretePolicy(len(train_ids), self.network.state_width)

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> dict[str, Any]:
        """Fresh parameters for an observation like `obs`; consumes `key`."""
        del representation_size
        key_policy, key_critic = jax.random.split(key)
        return {
            "policy": self._policy.init(key_policy, obs)["params"],
            "critic": self.init_critic(key_critic, obs),
        }

    def project(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """The representations themselves."""
        del params
        return representations

    def features(self, params: dict[str, Any], obs: jax.Array) -> jax.Array:
        """f32[..., w] the state feature."""
        return apply(self._policy, params["policy"], obs, method="features")

    def distribution_of(
        self, params: dict[str, Any], features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Categorical:
        """`distribution` from the state feature f32[..., w]."""
        del projected, mask
        return Categorical(apply(self._policy, params["policy"], features, method="output"))

    def decode(self, sample: jax.Array, available: AvailableSet, table: jax.Array) -> Action:
        """The available action nearest to the sampled train action."""
        wanted = table[jnp.asarray(self._train_ids)[sample]]
        return Action.of(nearest_id(wanted, available, table))
