"""Which recordings a training step sees. Pure functions of a key and a step number.

Batches can be recomputed for any step, so a resumed run sees what an uninterrupted one sees.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def hvae_batch(
    key_epochs: jax.Array,
    key_step: jax.Array,
    step: jax.Array,
    recordings: jax.Array,
    actions_per_batch: int,
    recordings_per_action: int,
) -> jax.Array:
    """One HVAE batch: B of A actions, S recordings of each, both without replacement.

    An epoch is one shuffled pass over the actions, its last incomplete batch dropped (spec
    method 3).

    Args:
      key_epochs: typed key; epoch e is shuffled with `fold_in(key_epochs, e)`.
      key_step: typed key of this step, consumed.
      step: int32[] gradient step, counted from 0.
      recordings: [A, S_total, T, D0].
      actions_per_batch: B, at most A.
      recordings_per_action: S, at most S_total.
    Returns:
      [B, S, T, D0], stored dtype.
    """
    num_actions, num_recordings = recordings.shape[:2]
    epoch, batch = jnp.divmod(step, num_actions // actions_per_batch)
    order = jax.random.permutation(jax.random.fold_in(key_epochs, epoch), num_actions)
    actions = jax.lax.dynamic_slice_in_dim(order, batch * actions_per_batch, actions_per_batch)
    # The S largest of independent draws are a uniform subset.
    noise = jax.random.uniform(key_step, (actions_per_batch, num_recordings))
    _, chosen = jax.lax.top_k(noise, recordings_per_action)
    return recordings[actions[:, None], chosen]


def flat_vae_batch(key_step: jax.Array, recordings: jax.Array, num_recordings: int) -> jax.Array:
    """One flat-VAE batch: recordings of all actions pooled, drawn with replacement (spec method 4).

    Args:
      key_step: typed key of this step, consumed.
      recordings: [A, S_total, T, D0].
      num_recordings: n.
    Returns:
      [1, n, T, D0], stored dtype.
    """
    pool = recordings.reshape(-1, *recordings.shape[2:])
    chosen = jax.random.randint(key_step, (1, num_recordings), 0, len(pool))
    return pool[chosen]
