"""What was not finite first: counts inside compiled programs, and what is to be done about it.

Numbers that are not finite make others so, and an update later all are. So counts are those of the
first time, and what is named is the first of their causes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

PREFIX = "nonfinite/"
_LEARNING = "Lower the learning rate, or rerun with --debug_nans to find the operation."
_GIVEN = "A lower learning rate does not help."

# What is counted, in the order of cause: what it says, and what is to be done.
CAUSES = {
    "recording": (
        "A feature of the recordings was NaN or infinite",
        f"Look at the play environment, and at the modality's `featurize`. {_GIVEN}",
    ),
    "observation": (
        "An observation was NaN or infinite, or too large for float32 once normalised",
        f"Look at what the environment returns. {_GIVEN}",
    ),
    "policy": ("A value or a log-probability of the policy was not finite", _LEARNING),
    "reward": (
        "A reward was NaN or infinite, or too large for float32 once scaled",
        f"Look at what the environment returns. {_GIVEN}",
    ),
    "next_value": (
        "The value of the last observation of an episode, or of the rollout, was not finite",
        f"Look at what the environment returns there. {_GIVEN}",
    ),
    "advantage": (
        "An advantage was not finite, though rewards and values were",
        f"Look at the size of the rewards. {_GIVEN}",
    ),
    "loss": ("The loss was not finite", _LEARNING),
    "gradient": ("The gradient was not finite", _LEARNING),
    "parameter": ("A parameter was not finite", _LEARNING),
}


def count(values: Any) -> jax.Array:
    """How many of the numbers of a tree are not finite, f32[]."""
    found = [jnp.sum(~jnp.isfinite(leaf), dtype=jnp.int32) for leaf in jax.tree.leaves(values)]
    return jnp.asarray(sum(found), jnp.float32)


def counts_along(values: Any) -> jax.Array:
    """`count` of the numbers at each place along the first axis of all leaves, f32[n]."""
    return jax.vmap(count)(values)


def first(counts: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """Of counts f32[n] those f32[] of the first of the n times that has any."""
    at = jnp.argmax(sum(counts.values(), jnp.zeros((), jnp.float32)) > 0)
    return {name: values[at] for name, values in counts.items()}


def cause_of(metrics: Mapping[str, Any]) -> str | None:
    """Which of `CAUSES` the counts of metrics tell of first; None if all are zero or absent."""
    for name in CAUSES:
        value = metrics.get(PREFIX + name)
        if value is not None and value != 0:
            return name
    return None
