"""What comes with a choice in hybrid domains: a position and a stop bit.

`docs/method.md`, "Auxiliary heads".

The position has a Beta distribution per coordinate, `u` in (0, 1); what is executed is
`2 (u - 0.5)` in (-1, 1). Its parameters are `1 + softplus(x)`, above 1, so that the density has no
poles. `x` is linear in the state feature `f`, or depends on the chosen action (paper figure 21):

    x = Lin(64, k)( ReLU( Lin(128, 64)( [f, a] ) ) )

with `a` the embedding of that action in the utility. As there, the part of the hidden layer that
depends on the action alone is computed once for a whole table.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from jaxnew.environment import Action, ActionSpec
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.distributions import Beta, Categorical
from jaxnew.policy.state_encoder import FeatureMethod, apply, orthogonal_dense
from jaxnew.policy.utility import UtilityMethod
from jaxnew.sampling import AvailableSet

POSITION_ENTROPY_WEIGHT = 0.1  # Inside the entropy, beside its coefficient.
_POSITION_GAIN = 1.0
_STOP_GAIN = 0.01
_STOP = 1  # Index of the logit that ends the episode.


@struct.dataclass
class HybridSample:
    """A draw from a `HybridDistribution`.

    Attributes:
      choice: sample of the method's own distribution.
      stop: int32[...] 1 to stop, or None in domains without a stop bit.
      position: f32[..., k] in (0, 1), or None in domains without a position.
    """

    choice: Any
    stop: jax.Array | None
    position: jax.Array | None


@struct.dataclass
class HybridDistribution:
    """A choice, a stop bit and a position.

    Attributes:
      choice: distribution of the method.
      stop: of the stop bit, or None.
      position: of the position, f32[..., k]; one per available action, f32[..., m, k], where it is
        conditioned on the choice; or None.
      is_conditioned: whether it is.
    """

    choice: Any
    stop: Categorical | None
    position: Beta | None
    is_conditioned: bool = struct.field(pytree_node=False, default=False)

    def sample(self, key: jax.Array) -> HybridSample:
        """One draw; consumes `key`."""
        key_choice, key_stop, key_position = jax.random.split(key, 3)
        choice = self.choice.sample(key_choice)
        position = self._position_at(choice)
        return HybridSample(
            choice=choice,
            stop=None if self.stop is None else self.stop.sample(key_stop),
            position=None if position is None else position.sample(key_position),
        )

    def log_prob(self, sample: HybridSample) -> jax.Array:
        """f32[...] sum of the parts' log-probabilities; that of the position at `u`."""
        log_prob: jax.Array = self.choice.log_prob(sample.choice)
        if self.stop is not None and sample.stop is not None:
            log_prob += self.stop.log_prob(sample.stop)
        position = self._position_at(sample.choice)
        if position is not None and sample.position is not None:
            log_prob += position.log_prob(sample.position)
        return log_prob

    def entropy(self, sample: HybridSample | None = None) -> jax.Array:
        """f32[...] entropy of choice and stop bit, and a tenth of that of the position.

        Args:
          sample: says which action's position is meant, where that is conditioned on the choice.

        Raises:
          ValueError: it is, and there is no sample.
        """
        if self.is_conditioned and sample is None:
            raise ValueError("The entropy of a conditioned position needs the sampled choice.")
        entropy = self.choice.entropy()
        if self.stop is not None:
            entropy += self.stop.entropy()
        position = self._position_at(None if sample is None else sample.choice)
        if position is None:
            return entropy
        return entropy + POSITION_ENTROPY_WEIGHT * position.entropy()

    def mode(self) -> HybridSample:
        """The most likely choice and stop bit, and the mean position."""
        choice = self.choice.mode()
        position = self._position_at(choice)
        return HybridSample(
            choice=choice,
            stop=None if self.stop is None else self.stop.mode(),
            position=None if position is None else position.mode(),
        )

    def _position_at(self, choice: Any) -> Beta | None:
        """The position's distribution f32[..., k], given the choice."""
        if self.position is None or not self.is_conditioned:
            return self.position

        def row(values: jax.Array) -> jax.Array:
            return jnp.take_along_axis(values, choice[..., None, None], axis=-2)[..., 0, :]

        return Beta(row(self.position.alpha), row(self.position.beta))


class _Heads(nn.Module):
    """State feature f32[..., w] -> parameters of what the domain has."""

    position_dim: int
    has_stop: bool

    @nn.compact
    def __call__(self, features: jax.Array) -> tuple[Categorical | None, Beta | None]:
        stop = position = None
        if self.has_stop:
            stop = Categorical(orthogonal_dense(2, _STOP_GAIN, "stop")(features))
        if self.position_dim:
            alpha, beta = (
                1.0
                + nn.softplus(orthogonal_dense(self.position_dim, _POSITION_GAIN, name)(features))
                for name in ("alpha", "beta")
            )
            position = Beta(alpha, beta)
        return stop, position


class _ConditionedHead(nn.Module):
    """One parameter of the position, from a state and every available action.

    Attributes:
      position_dim: k.
      network: sizes; w below is its `state_width`, h its `utility_width`.
    """

    position_dim: int
    network: NetworkConfig

    def setup(self) -> None:
        init = nn.initializers.orthogonal(_POSITION_GAIN)
        width, hidden = self.network.state_width, self.network.utility_width
        self.kernel = self.param("kernel", init, (2 * width, hidden), jnp.float32)
        self.bias = self.param("bias", nn.initializers.zeros, (hidden,), jnp.float32)
        self.out = orthogonal_dense(self.position_dim, _POSITION_GAIN)

    def project(self, embedded: jax.Array) -> jax.Array:
        """f32[..., w] -> f32[..., h], the action's share of the hidden layer, bias included."""
        return embedded @ self.kernel[self.network.state_width :] + self.bias

    def __call__(self, features: jax.Array, projected: jax.Array) -> jax.Array:
        """f32[..., m, k] above 1, from features f32[..., w] and projected actions [..., m, h]."""
        hidden = (features @ self.kernel[: self.network.state_width])[..., None, :] + projected
        return 1.0 + nn.softplus(self.out(nn.relu(hidden)))

    def concatenated(self, features: jax.Array, embedded: jax.Array) -> jax.Array:
        """The same f32[..., k] as the paper writes it, for one embedded action f32[..., w]."""
        hidden = jnp.concatenate([features, embedded], axis=-1) @ self.kernel + self.bias
        return 1.0 + nn.softplus(self.out(nn.relu(hidden)))


class AuxiliaryMethod(FeatureMethod):
    """A method with heads for the position and the stop bit of a hybrid domain.

    The heads read the state feature of the method; its parameters stand beside theirs.

    Raises:
      ValueError: the domain has neither; or the position is to be conditioned on the choice, and
        there is none, or the method has no embedding of actions.
    """

    def __init__(self, base: Any, action_spec: ActionSpec, is_conditioned: bool = False) -> None:
        if not (action_spec.position_dim or action_spec.has_stop):
            raise ValueError(
                "The domain has neither a position nor a stop bit; use the method alone."
            )
        if is_conditioned and not (isinstance(base, UtilityMethod) and action_spec.position_dim):
            raise ValueError(
                "Only a position that comes with a choice of the utility policy can be conditioned "
                f"on it; got method {base.name!r} and {action_spec.position_dim} coordinates."
            )
        super().__init__(base.network)
        self.name: str = base.name
        self._base = base
        self._is_conditioned = is_conditioned
        dim = action_spec.position_dim
        self._heads = _Heads(0 if is_conditioned else dim, action_spec.has_stop)
        self._position_dim = dim
        self._conditioned = _ConditionedHead(dim, self.network)
        if getattr(base, "failure_loss", None) is not None:
            self.failure_loss = self._failure_loss

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> dict[str, Any]:
        """Fresh parameters for an observation like `obs`; consumes `key`."""
        key_base, key_heads, key_alpha, key_beta = jax.random.split(key, 4)
        feature = jnp.zeros(self.network.state_width, jnp.float32)
        auxiliary = {"heads": self._heads.init(key_heads, feature).get("params", {})}
        if self._is_conditioned:
            for name, key_head in (("alpha", key_alpha), ("beta", key_beta)):
                both = (feature, feature)
                variables = self._conditioned.init(key_head, *both, method="concatenated")
                auxiliary[name] = variables["params"]
        return {**self._base.init(key_base, obs, representation_size), "auxiliary": auxiliary}

    def for_evaluation(self) -> AuxiliaryMethod:
        """It with the method's own policy for evaluations."""
        changed = copy.copy(self)
        for_evaluation = getattr(self._base, "for_evaluation", lambda: self._base)
        changed._base = for_evaluation()
        return changed

    def _failure_loss(
        self,
        params: dict[str, Any],
        distribution: HybridDistribution,
        representations: jax.Array,
        is_failure: jax.Array,
    ) -> jax.Array:
        choice = distribution.choice
        loss: jax.Array = self._base.failure_loss(params, choice, representations, is_failure)
        return loss

    def project(self, params: dict[str, Any], representations: jax.Array) -> jax.Array:
        """The method's projection f32[..., p] and, conditioned, those of alpha and beta:
        f32[..., p + 2 h].
        """
        projected = self._base.project(params, representations)
        if not self._is_conditioned:
            return projected
        embedded = self._base.embed(params, representations)
        shares = [
            apply(self._conditioned, params["auxiliary"][name], embedded, method="project")
            for name in ("alpha", "beta")
        ]
        return jnp.concatenate([projected, *shares], axis=-1)

    def features(self, params: dict[str, Any], obs: jax.Array) -> jax.Array:
        """f32[..., w] the state feature of the method."""
        features: jax.Array = self._base.features(params, obs)
        return features

    def distribution_of(
        self, params: dict[str, Any], features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> HybridDistribution:
        """The joint distribution; see the method's own."""
        num_more = 2 * self.network.utility_width if self._is_conditioned else 0
        rows, more = jnp.split(projected, [projected.shape[-1] - num_more], axis=-1)
        choice = self._base.distribution_of(params, features, rows, mask)
        heads: Any = self._heads.apply({"params": params["auxiliary"]["heads"]}, features)
        stop, position = heads
        if self._is_conditioned:
            shares = jnp.split(more, 2, axis=-1)
            alpha, beta = (
                apply(self._conditioned, params["auxiliary"][name], features, share)
                for name, share in zip(("alpha", "beta"), shares, strict=True)
            )
            position = Beta(alpha, beta)
        return HybridDistribution(choice, stop, position, self._is_conditioned)

    def value_of(self, params: dict[str, Any], obs: jax.Array, features: jax.Array) -> jax.Array:
        """f32[...] the method's value."""
        value: jax.Array = self._base.value_of(params, obs, features)
        return value

    def decode(self, sample: HybridSample, available: AvailableSet, table: jax.Array) -> Action:
        """The chosen action at the position `2 (u - 0.5)`, or a stop."""
        action: Action = self._base.decode(sample.choice, available, table)
        if sample.position is not None:
            action = replace(action, position=2.0 * (sample.position - 0.5))
        if sample.stop is not None:
            action = replace(action, stop=sample.stop == _STOP)
        return action
