"""Which recordings a training step sees. Pure functions of a key and a step number.

Batches can be recomputed for any step, so a resumed run sees what an uninterrupted one sees.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Choice(NamedTuple):
    """Recordings of a batch: `recordings[rows, numbers]`.

    Attributes:
      rows: int32[B, 1] or int32[1, n] actions.
      numbers: int32[B, S] or int32[1, n] which recordings of theirs.
    """

    rows: jax.Array
    numbers: jax.Array


def hvae_choice(
    key_epochs: jax.Array,
    key_step: jax.Array,
    step: jax.Array,
    shape: tuple[int, ...],
    actions_per_batch: int,
    recordings_per_action: int,
) -> Choice:
    """One HVAE batch: B of A actions, S recordings of each, both without replacement.

    An epoch is one shuffled pass over the actions, its last incomplete batch dropped (spec
    method 3).

    Args:
      key_epochs: typed key; epoch e is shuffled with `fold_in(key_epochs, e)`.
      key_step: typed key of this step, consumed.
      step: int32[] gradient step, counted from 0.
      shape: (A, S_total, ...) of the recordings.
      actions_per_batch: B, at most A.
      recordings_per_action: S, at most S_total.
    """
    num_actions, num_recordings = shape[:2]
    epoch, batch = jnp.divmod(step, num_actions // actions_per_batch)
    order = jax.random.permutation(jax.random.fold_in(key_epochs, epoch), num_actions)
    actions = jax.lax.dynamic_slice_in_dim(order, batch * actions_per_batch, actions_per_batch)
    # The S largest of independent draws are a uniform subset.
    noise = jax.random.uniform(key_step, (actions_per_batch, num_recordings))
    _, chosen = jax.lax.top_k(noise, recordings_per_action)
    return Choice(actions[:, None], chosen)


def flat_vae_choice(key_step: jax.Array, shape: tuple[int, ...], num_recordings: int) -> Choice:
    """One flat-VAE batch: recordings of all actions alike, drawn with replacement (spec method 4).

    Args:
      key_step: typed key of this step, consumed.
      shape: (A, S_total, ...) of the recordings.
      num_recordings: n.
    """
    chosen = jax.random.randint(key_step, (1, num_recordings), 0, shape[0] * shape[1])
    return Choice(*jnp.divmod(chosen, shape[1]))
