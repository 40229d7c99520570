"""A policy that acts for environments on the host: inference at one fixed width.

Environments are looked at in blocks of consecutive ones, `width` at a time whatever their number
and their halves, and every environment has its place in its block. What it does then does not
depend on how many others there are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import struct

from jaxnew.policy import PolicyMethod, distribution_and_value
from jaxnew.rollout.frames import stacks_of
from jaxnew.sampling import Actions, AvailableSet

WIDTH = 16


@struct.dataclass
class Acting:
    """What a policy does in n environments.

    Attributes:
      sample: a pytree of [n, ...].
      log_prob, value: f32[n].
      ids: int32[n] and positions: f32[n, k], what the environments are told.
    """

    sample: Any
    log_prob: Any
    value: Any
    ids: Any
    positions: Any


@dataclass(frozen=True)
class Actor:
    """Acts from keys of single environments.

    Attributes:
      method: the policy.
      is_greedy: takes the most likely action instead of sampling.
    """

    method: PolicyMethod
    is_greedy: bool = False

    def act(
        self,
        params: Any,
        projected: jax.Array,
        actions: Actions,
        keys: jax.Array,
        observation: jax.Array,
        available: AvailableSet,
    ) -> Acting:
        """One decision of `width` environments, pure.

        Args:
          params: of the policy.
          projected: `method.project` of `actions.offered`.
          actions: what the sets are of.
          keys: [width], consumed.
          observation: [width, ...].
          available: sets [width, m], or the fixed one [m].
        """
        rows = actions.rows(projected, available)
        distribution, value = distribution_and_value(
            self.method, params, observation, rows, available.mask
        )
        if self.is_greedy:
            sample = distribution.mode()
        else:
            sample = jax.vmap(lambda one, key: one.sample(key))(distribution, keys)
        action = self.method.decode(sample, available, actions.table)
        return Acting(sample, distribution.log_prob(sample), value, action.id, action.position)


class Block(NamedTuple):
    """Consecutive environments that are looked at together.

    Attributes:
      envs: int[width] the environments; behind the last one, that one again.
      rows: places in the block of those that are wanted.
    """

    envs: np.ndarray
    rows: slice


def blocks(wanted: slice, num_envs: int, width: int) -> list[Block]:
    """The blocks that hold environments `wanted.start .. wanted.stop - 1`."""
    found = []
    for first in range(wanted.start // width * width, wanted.stop, width):
        envs = np.minimum(np.arange(first, first + width), num_envs - 1)
        rows = slice(max(wanted.start - first, 0), min(wanted.stop - first, width))
        found.append(Block(envs, rows))
    return found


def in_blocks(
    function: Callable[[np.ndarray], Any], wanted: slice, num_envs: int, width: int
) -> Any:
    """`function(envs int[width]) -> pytree of [width, ...]`, of the wanted ones: [n, ...]."""
    parts = [
        jax.tree.map(lambda x, rows=block.rows: np.asarray(x)[rows], function(block.envs))
        for block in blocks(wanted, num_envs, width)
    ]
    return jax.tree.map(lambda *pieces: np.concatenate(pieces), *parts)


def half_of(half: int, num_envs: int, num_halves: int) -> slice:
    """The environments of a half.

    Raises:
      ValueError: they cannot be divided so.
    """
    if num_envs % num_halves:
        raise ValueError(f"num_envs={num_envs} is no multiple of num_halves={num_halves}.")
    size = num_envs // num_halves
    return slice(half * size, (half + 1) * size)


def observation_of(frames: np.ndarray, age: np.ndarray, has_stacks: bool) -> np.ndarray:
    """What the policy sees [n, ...], from the last k frames [k, n, ...] and ages int[n]."""
    return stacks_of(frames, age) if has_stacks else frames[-1]


def fold_in_each(key: jax.Array, numbers: jax.Array) -> jax.Array:
    """One key per number; `key` itself is not used otherwise."""
    return jax.vmap(partial(jax.random.fold_in, key))(numbers)
