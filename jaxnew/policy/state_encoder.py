"""State features and values for vector observations (spec method 5.2)."""

from __future__ import annotations

from typing import Any, cast

import flax.linen as nn
import jax
import numpy as np

FEATURE_SIZE = 64  # Width of the state feature f(s).
_SQRT_2 = float(np.sqrt(2.0))


def orthogonal_dense(features: int, gain: float, name: str | None = None) -> nn.Dense:
    """A dense layer with an orthogonal weight of the given gain and zero bias."""
    return nn.Dense(features, kernel_init=nn.initializers.orthogonal(gain), name=name)


class VectorEncoder(nn.Module):
    """`dense 64, tanh, dense 64, tanh`: f32[..., n] -> f32[..., 64]."""

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        x = nn.tanh(orthogonal_dense(FEATURE_SIZE, _SQRT_2)(obs))
        return nn.tanh(orthogonal_dense(FEATURE_SIZE, _SQRT_2)(x))


class VectorCritic(nn.Module):
    """An encoder of its own and `dense 1`: f32[..., n] -> f32[...]. Blind to the action set."""

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        return orthogonal_dense(1, _SQRT_2, "value")(VectorEncoder()(obs))[..., 0]


def apply(module: nn.Module, params: Any, *inputs: jax.Array, **options: Any) -> jax.Array:
    """The output of `module` with `params`."""
    return cast(jax.Array, module.apply({"params": params}, *inputs, **options))
