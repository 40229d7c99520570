"""The available action that is nearest to a point in the space of representations."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxnew.sampling import AvailableSet


def nearest_id(points: jax.Array, available: AvailableSet, table: jax.Array) -> jax.Array:
    """int32[...] ids of the available actions with the smallest squared L2 distance.

    The first in the set wins a tie.

    Args:
      points: f32[..., d].
      available: sets [..., m], or one set [m] for all points.
      table: f32[A, d] representations.
    """
    differences = table[available.ids] - points[..., None, :]
    distances = jnp.sum(differences**2, axis=-1)
    return available.id_of(jnp.argmin(jnp.where(available.mask, distances, jnp.inf), axis=-1))
