"""Clusters of equal size of vectors (docs/method.md, cluster sampling)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnew.representation.clusters import balanced_clusters


@pytest.mark.property
@pytest.mark.parametrize(("count", "num_clusters"), [(50, 10), (53, 10), (7, 7), (9, 1)])
def test_clusters_are_of_equal_size(count: int, num_clusters: int) -> None:
    vectors = np.random.default_rng(count).normal(size=(count, 3))
    labels = balanced_clusters(vectors, num_clusters)
    sizes = np.bincount(labels, minlength=num_clusters)
    assert labels.dtype == np.int32
    assert sizes.max() - sizes.min() <= 1
    assert sizes.sum() == count
    np.testing.assert_array_equal(labels, balanced_clusters(vectors, num_clusters))


@pytest.mark.oracle
def test_clusters_are_near_each_other() -> None:
    rng = np.random.default_rng(3)
    blobs = np.repeat(np.arange(5), 12)
    vectors = rng.normal(size=(5, 4))[blobs] * 20 + rng.normal(size=(60, 4))
    labels = balanced_clusters(vectors, 5, seed=1)
    pairs = set(zip(blobs.tolist(), labels.tolist(), strict=True))
    assert len(pairs) == 5  # Each blob is one cluster.

    cloud = rng.normal(size=(60, 4))

    def inertia(labels: np.ndarray) -> float:
        return sum(((cloud[labels == k] - cloud[labels == k].mean(0)) ** 2).sum() for k in range(5))

    shuffled = [inertia(rng.permutation(blobs)) for _ in range(200)]
    assert inertia(balanced_clusters(cloud, 5)) < 0.8 * min(shuffled)


@pytest.mark.unit
def test_clusters_of_copies_and_of_too_few() -> None:
    labels = balanced_clusters(np.zeros((6, 2)), 3)
    assert np.bincount(labels).tolist() == [2, 2, 2]
    with pytest.raises(ValueError, match=r"num_clusters=7 must be in 1..6"):
        balanced_clusters(jnp.zeros((6, 2)), 7)
