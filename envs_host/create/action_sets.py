"""The tools that an episode offers (docs/create.md, "Action sets"). NumPy only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Sampler = Callable[[np.random.Generator, np.ndarray, int], np.ndarray]


def uniform_ids(rng: np.random.Generator, candidates: np.ndarray, size: int) -> np.ndarray:
    """int32[size] distinct ids, every set equally likely."""
    return rng.choice(candidates, size, replace=False).astype(np.int32)


def draw_action_set(
    rng: np.random.Generator,
    candidates: np.ndarray,
    size: int,
    no_op: int,
    sampler: Sampler = uniform_ids,
) -> np.ndarray:
    """One episode's set: `size` sampled ids, of which entry 0 then becomes the no-op.

    Args:
      rng: consumed.
      candidates: int[n] ids without the no-op.
      size: entries of the set.
      no_op: id of the no-op.
      sampler: gives `size` distinct candidates.

    Returns:
      int32[size] tool ids.

    Raises:
      ValueError: there are too few candidates, or the sampler returned something else than `size`
        distinct candidates.
    """
    if not 0 < size <= len(candidates):
        raise ValueError(
            f"action_set_size={size} does not fit {len(candidates)} tools; choose 1.."
            f"{len(candidates)} or a larger part of the split."
        )
    ids = np.array(sampler(rng, candidates, size), np.int32)
    if ids.shape != (size,) or len(np.unique(ids)) != size or not np.isin(ids, candidates).all():
        raise ValueError(
            f"The sampler must return {size} distinct ids of the candidates, not {ids}."
        )
    ids[0] = no_op
    return ids
