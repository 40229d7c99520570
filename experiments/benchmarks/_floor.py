"""The least that a training update can take: operations and bytes over what the machine reaches.

Counted from the shapes of the networks (docs/method.md, "Policy networks") in float32, for a
program that never stores an [m, 64] array: a true floor, below what a compiler can reach that does
not fuse products with what surrounds them. Left out: biases, activations, environment, random
numbers, Adam.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from experiments.benchmarks import _measure as m

WIDTH = 64  # Of every hidden layer.
_FLOAT_BYTES = 4


@dataclass(frozen=True)
class Shapes:
    """What the cost of an update depends on.

    Attributes:
      obs_size: n, numbers in an observation.
      representation_size: d.
      num_actions: A, rows of the table.
      set_size: m.
      steps: environment steps per update, T * N.
      epochs: passes over them.
      gradient_steps: of all epochs together.
    """

    obs_size: int
    representation_size: int
    num_actions: int
    set_size: int
    steps: int
    epochs: int
    gradient_steps: int


def encoder_madds(shapes: Shapes) -> tuple[int, int]:
    """Multiply-adds (forward, backward) of one encoder: dense 64, tanh, dense 64, tanh."""
    first, second = shapes.obs_size * WIDTH, WIDTH * WIDTH
    # Backward, a dense layer makes the gradient of its weight and that of its input, each as many
    # operations as forward. Nothing asks for the gradient of an observation.
    return first + second, first + 2 * second


def transition_madds(shapes: Shapes) -> tuple[int, int]:
    """Multiply-adds (forward, backward) of policy and value for one transition."""
    forward, backward = encoder_madds(shapes)
    # The critic's last layer; the state's half of the utility layer; a product with 64 numbers for
    # each available action.
    rest = WIDTH + WIDTH * WIDTH + shapes.set_size * WIDTH
    return 2 * forward + rest, 2 * backward + 2 * rest


def projection_madds(shapes: Shapes) -> tuple[int, int]:
    """Multiply-adds (forward, backward) of the projection of the table, once per gradient step."""
    embed, mix = shapes.representation_size * WIDTH, WIDTH * WIDTH
    # Nothing asks for the gradient of the table.
    return shapes.num_actions * (embed + mix), shapes.num_actions * (embed + 2 * mix)


def update_operations(shapes: Shapes) -> int:
    """Floating-point operations of one update: two for each multiply-add."""
    forward, backward = transition_madds(shapes)
    project, project_back = projection_madds(shapes)
    rollout = shapes.steps * forward + project
    learning = shapes.epochs * shapes.steps * (forward + backward)
    learning += shapes.gradient_steps * (project + project_back)
    return 2 * (rollout + learning)


def update_bytes(shapes: Shapes) -> tuple[int, int]:
    """Bytes that one update moves: (within the caches, to and from memory).

    The projected table, its gradient and the ReLU's inputs, m x 64 of them per transition, stay in
    the caches. Transitions come from memory.
    """
    rows = shapes.set_size * WIDTH * _FLOAT_BYTES
    # Observation; ids and mask of the set; choice, log-probability, value, advantage, target.
    transition = _FLOAT_BYTES * shapes.obs_size + (_FLOAT_BYTES + 1) * shapes.set_size
    transition += 5 * _FLOAT_BYTES
    passes = shapes.epochs * shapes.steps
    # Rows of the table are read in the rollout; in learning they are read forward, read again
    # backward, and their gradient is added to, which reads and writes.
    cached = shapes.steps * rows + passes * 4 * rows
    # Written in the rollout; in learning read, written as a minibatch, and read by the network.
    memory = shapes.steps * transition + passes * 3 * transition
    return cached, memory


def floor_seconds(shapes: Shapes, rates: Mapping[str, float]) -> dict[str, float]:
    """Seconds per update that operations and bytes take, the larger of the two, and their sum.

    The larger one is the floor of a program that computes and moves at the same time.
    """
    cached, memory = update_bytes(shapes)
    operations_s = update_operations(shapes) / rates["operations"]
    bytes_s = cached / rates["cached_bytes"] + memory / rates["memory_bytes"]
    return {
        "operations_s": operations_s,
        "bytes_s": bytes_s,
        "max_s": max(operations_s, bytes_s),
        "sum_s": operations_s + bytes_s,
    }


# Products [rows, width] @ [width, width]: two shapes of the network (one microbatch, one minibatch)
# and two that any matrix library is good at. Then how often, so that a call takes some ms.
_PRODUCTS = ((256, WIDTH, 2000), (4096, WIDTH, 100), (512, 512, 30), (2048, 2048, 1))
# Numbers and how often: 32 kB to 512 kB stay in the caches, 256 MB do not.
_COPIES = {
    "cached_bytes": ((2**13, 20_000), (2**15, 5_000), (2**17, 1_000)),
    "memory_bytes": ((2**26, 2),),
}


def measure_rates(report: m.Report) -> dict[str, float]:
    """Times products and copies; the best of what the machine was seen to reach, per second.

    `operations`: of floating-point numbers, in a matrix product; `cached_bytes` and `memory_bytes`:
    read and written by a copy that stays in the caches, and by one that does not.
    """
    subjects: dict[str, m.Subject] = {}
    work: dict[str, tuple[str, float]] = {}
    for sizes in _PRODUCTS:
        rows, width, times = (8, 8, 2) if report.is_quick else sizes
        name = f"product [{rows}, {width}] @ [{width}, {width}]"
        subjects[name] = _products(rows, width, times)
        work[name] = "operations", 2.0 * rows * width * width * times
    for unit, copies in _COPIES.items():
        for size, times in ((2**10, 2),) if report.is_quick else copies:
            name = f"copy of {size * _FLOAT_BYTES // 1024} kB ({unit})"
            subjects[name] = _copies(size, times)
            work[name] = unit, 2.0 * size * _FLOAT_BYTES * times
    best: dict[str, float] = {}
    for name, timing in report.measure(subjects).items():
        unit, amount = work[name]
        report.timing(name, timing, work={unit: amount}, how="a loop in one program")
        rate = amount / min(cost.wall_s for cost in timing.costs)
        best[unit] = max(rate, best.get(unit, 0.0))
    return best


def _products(rows: int, width: int, times: int) -> m.Subject:
    def inputs(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_x, key_weight = jax.random.split(key)
        # Orthogonal, so that repeated products neither grow nor vanish into slow tiny numbers.
        weight = jax.random.orthogonal(key_weight, width)
        return jax.random.normal(key_x, (rows, width)), weight

    def repeat(x: jax.Array, weight: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, times, lambda _, x: x @ weight, x)

    return m.compiled(repeat, inputs)


def _copies(size: int, times: int) -> m.Subject:
    def repeat(x: jax.Array) -> jax.Array:
        # One addition per number, because a plain copy would be left out.
        return jax.lax.fori_loop(0, times, lambda i, x: x + jnp.float32(i), x)

    return m.compiled(repeat, lambda key: (jax.random.normal(key, (size,)),))
