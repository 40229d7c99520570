"""State features and values, for vectors and for images (`docs/method.md`, "Policy networks").

Which of the two an observation is shows in its dtype: `uint8` is an image. Images stay `uint8` in
rollouts and are divided by 255 here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from jaxnew.convolution import WINDOW, convolution
from jaxnew.policy.config import NetworkConfig

_SQRT_2 = float(np.sqrt(2.0))
_CHANNELS = (16, 16, 32, 32, 32)


def is_image(obs: jax.Array) -> bool:
    """Whether observations are images `uint8[..., height, width, channels]`.

    Raises:
      ValueError: they are `uint8`, but have no such axes.
    """
    if obs.dtype != jnp.uint8:
        return False
    if obs.ndim < 3:
        raise ValueError(
            f"uint8 observations are images [..., height, width, channels], got {obs.shape}; give "
            "observations that are vectors as float32."
        )
    return True


def orthogonal_dense(features: int, gain: float, name: str | None = None) -> nn.Dense:
    """A dense layer with an orthogonal weight of the given gain and zero bias."""
    return nn.Dense(features, kernel_init=nn.initializers.orthogonal(gain), name=name)


class StridedConvolution(nn.Module):
    """A 3x3 convolution with stride 2, padding 1 and a bias; PyTorch's default initialisation.

    Weights and bias are uniform in +-1/sqrt(9 C).

    Attributes:
      features: O.
      form: of `jaxnew.convolution`.
    """

    features: int
    form: Callable[[jax.Array, jax.Array, int], jax.Array] = convolution

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """f32[B, H, W, C] -> f32[B, H', W', O]."""
        num_inputs = WINDOW**2 * x.shape[-1]
        bound = 1.0 / math.sqrt(num_inputs)

        def init(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
            return jax.random.uniform(key, shape, jnp.float32, -bound, bound)

        kernel = self.param("kernel", init, (WINDOW, WINDOW, x.shape[-1], self.features))
        bias = self.param("bias", init, (self.features,))
        return self.form(x, kernel, 2) + bias


class ImageEncoder(nn.Module):
    """Five convolutions and a dense layer, ReLU after each: uint8[..., H, W, C] -> f32[..., w].

    84x84 images become 42, 21, 11, 6, 3 pixels wide: 288 numbers. They are flattened as rows,
    columns, channels (the original's PyTorch: channels, rows, columns), which permutes the rows of
    the dense layer's weight and changes nothing else.

    Attributes:
      width: w.
      form: of the convolutions, see `jaxnew.convolution`.
    """

    width: int = NetworkConfig.state_width
    form: Callable[[jax.Array, jax.Array, int], jax.Array] = convolution

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        """State features f32[..., w] of images uint8[..., H, W, C]."""
        x = obs.reshape(-1, *obs.shape[-3:]).astype(jnp.float32) / 255.0
        for index, channels in enumerate(_CHANNELS):
            x = nn.relu(StridedConvolution(channels, self.form, name=f"convolution_{index}")(x))
        x = x.reshape(*obs.shape[:-3], -1)
        return nn.relu(orthogonal_dense(self.width, _SQRT_2, "dense")(x))


Activation = Callable[[jax.Array], jax.Array]


def _vector_features(obs: jax.Array, width: int, activation: Activation) -> jax.Array:
    """Makes its two layers in the module that calls it."""
    x = activation(orthogonal_dense(width, _SQRT_2)(obs))
    return activation(orthogonal_dense(width, _SQRT_2)(x))


class VectorEncoder(nn.Module):
    """`dense w, tanh, dense w, tanh`: f32[..., n] -> f32[..., w]."""

    width: int = NetworkConfig.state_width

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        return _vector_features(obs, self.width, nn.tanh)


class StateEncoder(nn.Module):
    """The state feature f(s): f32[..., n] or uint8[..., H, W, C] -> f32[..., w].

    Attributes:
      width: w.
      activation: of the layers for vectors; those for images have ReLU.
    """

    width: int = NetworkConfig.state_width
    activation: Activation = nn.tanh

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        if is_image(obs):
            return ImageEncoder(self.width, name="image")(obs)
        return _vector_features(obs, self.width, self.activation)


class StateCritic(nn.Module):
    """The value f32[...] of a state. Blind to the action set.

    Of vectors by an encoder of its own; of images from the state feature of the policy, which its
    gradient reaches.
    """

    width: int = NetworkConfig.critic_width

    @nn.compact
    def __call__(self, obs: jax.Array, features: jax.Array) -> jax.Array:
        """Values of observations [..., n] or [..., H, W, C] with features f32[..., w]."""
        hidden = features if is_image(obs) else VectorEncoder(self.width)(obs)
        return orthogonal_dense(1, _SQRT_2, "value")(hidden)[..., 0]


def apply(module: nn.Module, params: Any, *inputs: jax.Array, **options: Any) -> jax.Array:
    """The output of `module` with `params`."""
    return cast(jax.Array, module.apply({"params": params}, *inputs, **options))


class FeatureMethod:
    """Base of methods that have `features` and `distribution_of`, and keep a critic's parameters in
    `params["critic"]`.

    Attributes:
      network: sizes; w below is its `state_width`.
      failure_loss: see `jaxnew.policy.method.PolicyMethod`; None: it foretells nothing.
    """

    failure_loss: Callable[..., jax.Array] | None = None

    def __init__(self, network: NetworkConfig | None = None) -> None:
        self.network = network or NetworkConfig()
        self._critic = StateCritic(self.network.critic_width)

    def init_critic(self, key: jax.Array, obs: jax.Array) -> Any:
        """Fresh parameters of the critic; consumes `key`."""
        return self._critic.init(key, obs, jnp.zeros(self.network.state_width, jnp.float32))[
            "params"
        ]

    def for_evaluation(self) -> Any:
        """Who acts with its parameters where nothing is learned."""
        return self

    def features(self, params: dict[str, Any], obs: jax.Array) -> jax.Array:
        """f32[..., w] the state feature."""
        raise NotImplementedError

    def distribution_of(
        self, params: dict[str, Any], features: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Any:
        """`distribution` from the state feature f32[..., w]."""
        raise NotImplementedError

    def distribution(
        self, params: dict[str, Any], obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> Any:
        """See `jaxnew.policy.method.PolicyMethod`."""
        return self.distribution_of(params, self.features(params, obs), projected, mask)

    def value(self, params: dict[str, Any], obs: jax.Array) -> jax.Array:
        """f32[...] values of observations, as in `distribution`."""
        return self.value_of(params, obs, self.features(params, obs))

    def value_of(self, params: dict[str, Any], obs: jax.Array, features: jax.Array) -> jax.Array:
        """`value` where the state feature is known."""
        return apply(self._critic, params["critic"], obs, features)

    def distribution_and_value(
        self, params: dict[str, Any], obs: jax.Array, projected: jax.Array, mask: jax.Array
    ) -> tuple[Any, jax.Array]:
        """Both; of images with one pass, and one backward pass, through the trunk they share."""
        if not is_image(obs):
            return self.distribution(params, obs, projected, mask), self.value(params, obs)
        features = self.features(params, obs)
        distribution = self.distribution_of(params, features, projected, mask)
        return distribution, self.value_of(params, obs, features)
