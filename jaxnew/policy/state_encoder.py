"""State features and values (spec method 5.2), for vectors and for images.

Which of the two an observation is shows in its dtype: `uint8` is an image. Images stay `uint8` in
rollouts and are divided by 255 here.
"""

from __future__ import annotations

import math
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

FEATURE_SIZE = 64  # Width of the state feature f(s).
_SQRT_2 = float(np.sqrt(2.0))
_CHANNELS = (16, 16, 32, 32, 32)
_WINDOW = 3  # Pixels along each side of what a unit of a convolution sees.


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


def strided_convolution(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """3x3 convolution with stride 2 and padding 1: f32[B, H, W, C] -> f32[B, H', W', O].

    `H' = ceil(H / 2)`, likewise W'. On a CPU as a product with the columns of all windows: XLA's
    gradients of a convolution are several times slower there (`experiments/benchmarks/images.py`).

    Args:
      x: images.
      kernel: f32[3, 3, C, O].
    """
    form = convolution_by_columns if jax.default_backend() == "cpu" else convolution_by_xla
    return form(x, kernel)


def convolution_by_xla(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """`strided_convolution` as XLA's own operation."""
    return jax.lax.conv_general_dilated(
        x, kernel, (2, 2), ((1, 1), (1, 1)), dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def convolution_by_columns(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """`strided_convolution` as one matrix product: `[B H' W', 9 C] @ [9 C, O]`."""
    batch, height, width, channels = x.shape
    rows, columns = (height + 1) // 2, (width + 1) // 2
    # Of an even side the padding behind it is never seen.
    padded = jnp.pad(x, ((0, 0), (1, height % 2), (1, width % 2), (0, 0)))
    windows = [
        padded[:, i : i + 2 * rows - 1 : 2, j : j + 2 * columns - 1 : 2]
        for i in range(_WINDOW)
        for j in range(_WINDOW)
    ]
    flat = jnp.concatenate(windows, axis=-1).reshape(-1, _WINDOW**2 * channels)
    return (flat @ kernel.reshape(flat.shape[-1], -1)).reshape(batch, rows, columns, -1)


class StridedConvolution(nn.Module):
    """`strided_convolution` with a bias; PyTorch's default initialisation.

    Weights and bias are uniform in +-1/sqrt(9 C) (spec method 5.2).

    Attributes:
      features: O.
    """

    features: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """f32[B, H, W, C] -> f32[B, H', W', O]."""
        num_inputs = _WINDOW**2 * x.shape[-1]
        bound = 1.0 / math.sqrt(num_inputs)

        def init(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
            return jax.random.uniform(key, shape, jnp.float32, -bound, bound)

        kernel = self.param("kernel", init, (_WINDOW, _WINDOW, x.shape[-1], self.features))
        bias = self.param("bias", init, (self.features,))
        return strided_convolution(x, kernel) + bias


class ImageEncoder(nn.Module):
    """Five convolutions and a dense layer, ReLU after each: uint8[..., H, W, C] -> f32[..., 64].

    84x84 images become 42, 21, 11, 6, 3 pixels wide: 288 numbers. They are flattened as rows,
    columns, channels (the original's PyTorch: channels, rows, columns), which permutes the rows of
    the dense layer's weight and changes nothing else.
    """

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        x = obs.reshape(-1, *obs.shape[-3:]).astype(jnp.float32) / 255.0
        for index, channels in enumerate(_CHANNELS):
            x = nn.relu(StridedConvolution(channels, name=f"convolution_{index}")(x))
        x = x.reshape(*obs.shape[:-3], -1)
        return nn.relu(orthogonal_dense(FEATURE_SIZE, _SQRT_2, "dense")(x))


def _vector_features(obs: jax.Array) -> jax.Array:
    """Makes its two layers in the module that calls it."""
    x = nn.tanh(orthogonal_dense(FEATURE_SIZE, _SQRT_2)(obs))
    return nn.tanh(orthogonal_dense(FEATURE_SIZE, _SQRT_2)(x))


class VectorEncoder(nn.Module):
    """`dense 64, tanh, dense 64, tanh`: f32[..., n] -> f32[..., 64]."""

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        return _vector_features(obs)


class StateEncoder(nn.Module):
    """The state feature f(s): f32[..., n] or uint8[..., H, W, C] -> f32[..., 64]."""

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        return ImageEncoder(name="image")(obs) if is_image(obs) else _vector_features(obs)


class StateCritic(nn.Module):
    """The value f32[...] of a state. Blind to the action set.

    Of vectors by an encoder of its own; of images from the state feature of the policy, which its
    gradient reaches (spec method 5.2).
    """

    @nn.compact
    def __call__(self, obs: jax.Array, features: jax.Array) -> jax.Array:
        """Values of observations [..., n] or [..., H, W, C] with features f32[..., 64]."""
        hidden = features if is_image(obs) else VectorEncoder()(obs)
        return orthogonal_dense(1, _SQRT_2, "value")(hidden)[..., 0]


def apply(module: nn.Module, params: Any, *inputs: jax.Array, **options: Any) -> jax.Array:
    """The output of `module` with `params`."""
    return cast(jax.Array, module.apply({"params": params}, *inputs, **options))
