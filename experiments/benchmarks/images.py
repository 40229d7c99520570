"""The trunk for images: forms of its convolutions and sizes of microbatches.

python -m experiments.benchmarks.images
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from experiments.benchmarks import _measure as m
from jaxnew.convolution import convolution_by_columns, convolution_by_xla
from jaxnew.policy.state_encoder import ImageEncoder

ARGUMENTS = m.Benchmark(__doc__)

FORMS = {"columns": convolution_by_columns, "XLA": convolution_by_xla}
SIZES = (8, 16, 32, 64, 256)  # Of microbatches.


def gradient_subject(
    form: Callable[..., jax.Array], shape: tuple[int, int, int], num_images: int, size: int
) -> m.Subject:
    """The gradient of the trunk's parameters, summed over microbatches of `size` images."""
    encoder = ImageEncoder(form=form)

    def loss(params: Any, images: jax.Array) -> jax.Array:
        return jnp.sum(jnp.tanh(jnp.asarray(encoder.apply(params, images))))

    def total(params: Any, images: jax.Array) -> Any:
        def add(sums: Any, part: jax.Array) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, sums, jax.grad(loss)(params, part)), None

        parts = images.reshape(-1, size, *shape)
        return jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), parts)[0]

    params = jax.jit(encoder.init)(jax.random.key(0), jnp.zeros(shape, jnp.uint8))
    make = jax.jit(lambda key: jax.random.bits(key, (num_images, *shape), jnp.uint8))
    return m.compiled(total, lambda key: (params, make(key)))


def main() -> None:
    report = m.Report("images", ARGUMENTS)
    num_images, side, sizes = (8, 12, (4, 8)) if report.is_quick else (1024, 84, SIZES)
    timings = report.measure(
        {
            f"{name}, microbatches of {size}": gradient_subject(
                form, (side, side, 3), num_images, size
            )
            for name, form in FORMS.items()
            for size in sizes
        }
    )
    best = f"columns, microbatches of {sizes[1]}"
    for name, timing in timings.items():
        how = f"{num_images} stacks of three {side}x{side} frames, forward and backward"
        report.timing(f"gradient, {name}", timing, work={"images": num_images}, how=how)
        report.ratio(f"({name}) / ({best})", timing, timings[best])


if __name__ == "__main__":
    ARGUMENTS.start(main)
