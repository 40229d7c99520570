"""Clusters of representations of equal size, for cluster sampling. NumPy only.

`docs/method.md`, "Validation groups and cluster sampling".
"""

from __future__ import annotations

import numpy as np

_MAX_ITERATIONS = 50


def balanced_clusters(vectors: np.ndarray, num_clusters: int = 10, seed: int = 0) -> np.ndarray:
    """k-means whose clusters differ in size by at most one.

    Lloyd's iterations; actions are placed by their distance to the centres, nearest pairs first, as
    long as the cluster has room. The first centres are spread as in k-means++.

    Args:
      vectors: f[n, d] representations.
      num_clusters: k, at most n.
      seed: of the first centres.

    Returns:
      int32[n] labels in `0..k-1`.

    Raises:
      ValueError: `num_clusters` is not in 1..n.
    """
    vectors = np.asarray(vectors, np.float64)
    if not 1 <= num_clusters <= len(vectors):
        raise ValueError(
            f"num_clusters={num_clusters} must be in 1..{len(vectors)}, the number of actions."
        )
    centres = _spread(vectors, num_clusters, np.random.default_rng(seed))
    labels = _assign(_distances(vectors, centres))
    for _ in range(_MAX_ITERATIONS):
        centres = np.stack([vectors[labels == k].mean(axis=0) for k in range(num_clusters)])
        previous, labels = labels, _assign(_distances(vectors, centres))
        if np.array_equal(previous, labels):
            break
    return labels


def _distances(vectors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """f64[n, k] squared distances."""
    return ((vectors[:, None] - centres[None]) ** 2).sum(axis=-1)


def _spread(vectors: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """f64[k, d] vectors drawn one after the other by their squared distance to those drawn."""
    chosen = [int(rng.integers(len(vectors)))]
    for _ in range(count - 1):
        nearest = _distances(vectors, vectors[chosen]).min(axis=1)
        total = nearest.sum()
        weights = nearest / total if total > 0 else None  # All are copies of those drawn.
        chosen.append(int(rng.choice(len(vectors), p=weights)))
    return vectors[chosen]


def _assign(distances: np.ndarray) -> np.ndarray:
    """int32[n] labels: nearest pairs first, and no cluster beyond its share."""
    num_vectors, num_clusters = distances.shape
    share, num_larger = divmod(num_vectors, num_clusters)
    sizes = np.zeros(num_clusters, int)
    labels = np.full(num_vectors, -1, np.int32)
    for pair in np.argsort(distances, axis=None, kind="stable"):
        vector, cluster = divmod(int(pair), num_clusters)
        is_full = sizes[cluster] >= share + (num_larger > 0)
        if labels[vector] >= 0 or is_full:
            continue
        num_larger -= int(sizes[cluster] == share)
        sizes[cluster] += 1
        labels[vector] = cluster
    return labels
