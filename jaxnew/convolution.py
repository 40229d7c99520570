"""3x3 convolutions with padding 1, in the form that is fast where they run.

Inside of loops, such as those over a policy's microbatches, on a CPU they are matrix products with
the columns of all windows: there XLA's own gradients take ten times as long
(`experiments/benchmarks/images.py`). Outside of loops XLA's are faster, and encoders use them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

WINDOW = 3  # Pixels along each side of what a unit sees.


def convolution(x: jax.Array, kernel: jax.Array, stride: int = 1) -> jax.Array:
    """f32[B, H, W, C] -> f32[B, H', W', O], where `H' = ceil(H / stride)` and likewise W'.

    Args:
      x: images.
      kernel: f32[3, 3, C, O].
      stride: 1 or more.
    """
    form = convolution_by_columns if jax.default_backend() == "cpu" else convolution_by_xla
    return form(x, kernel, stride)


def convolution_by_xla(x: jax.Array, kernel: jax.Array, stride: int = 1) -> jax.Array:
    """`convolution` as XLA's own operation."""
    strides, padding = (stride, stride), ((1, 1), (1, 1))
    dimensions = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, strides, padding, dimension_numbers=dimensions)


def convolution_by_columns(x: jax.Array, kernel: jax.Array, stride: int = 1) -> jax.Array:
    """`convolution` as one matrix product: `[B H' W', 9 C] @ [9 C, O]`."""
    batch, height, width, channels = x.shape
    rows, columns = -(-height // stride), -(-width // stride)
    padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    windows = [
        padded[
            :,
            i : i + stride * (rows - 1) + 1 : stride,
            j : j + stride * (columns - 1) + 1 : stride,
        ]
        for i in range(WINDOW)
        for j in range(WINDOW)
    ]
    flat = jnp.concatenate(windows, axis=-1).reshape(-1, WINDOW**2 * channels)
    return (flat @ kernel.reshape(flat.shape[-1], -1)).reshape(batch, rows, columns, -1)
