"""Optimisers that compute in 32 bits whatever JAX is set to."""

from __future__ import annotations

from typing import Any

import jax
import optax


def in_32_bits(optimizer: optax.GradientTransformation) -> optax.GradientTransformation:
    """`optimizer` with numbers of its own in f32, so that a step has the same bits with
    `jax_enable_x64`; and free to mix them with counts under strict promotion of dtypes.

    Optax computes bias corrections in the widest float that JAX allows, of an int32 count.
    """

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
            return optimizer.update(updates, state, params)

    return optax.GradientTransformation(optimizer.init, update)
