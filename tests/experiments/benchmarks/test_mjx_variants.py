"""The comparison of MJX's variants: its worlds, and the cells of its table."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from envs_mjx.shape_stacking import scene, shape_library
from envs_mjx.shape_stacking.engines import Settled
from envs_mjx.shape_stacking.engines import mjx_pool as _mjx_pool
from experiments.benchmarks import mjx_variants as variants


@pytest.fixture(scope="module")
def at() -> variants.Scenes:
    return variants.scenes(worlds=2, steps=5)


@pytest.mark.unit
def test_worlds_are_of_three_stages_and_of_every_class(at: variants.Scenes) -> None:
    ids, qpos, qvel = at.state
    assert ids.shape == (2 * 3 + 16, 12)
    np.testing.assert_array_equal((ids >= 0).sum(axis=1), [6, 6, 9, 9, 12, 12] + [1] * 16)
    np.testing.assert_array_equal(shape_library().class_labels[at.rests], np.arange(16))
    np.testing.assert_array_equal(ids[6:, 0], at.rests)
    assert not qvel.any()
    for row, slot in zip(range(6), (5, 5, 8, 8, 11, 11), strict=True):
        z = np.where(ids[row] >= 0, qpos[row, :, 2], -1.0)
        assert z[slot] == z.max()
        assert at.reference[row, slot, 2] < z[slot]  # It has begun to fall.


@pytest.mark.unit
def test_coarse_hulls_have_the_cross_section_of_the_fine_ones() -> None:
    library = shape_library()
    cylinder, cone, cube = 794, 404, 684
    ids = jnp.array([cylinder, cone, cube])
    with variants._coarse_hulls():
        found = _mjx_pool.pool(ids)
    fine = _mjx_pool.pool(ids)
    assert (found.vertices.shape, fine.vertices.shape) == ((3, 16, 3), (3, 24, 3))
    for k, i in enumerate(np.asarray(ids)):
        volume, expected = (ConvexHull(pool.vertices[k]).volume for pool in (found, fine))
        assert volume == pytest.approx(expected, rel=1e-5), i
    assert library.s[cylinder] ** 3 * 2.0 * np.pi == pytest.approx(
        ConvexHull(found.vertices[0]).volume, rel=1e-5
    )
    assert found.face_normals.shape == (3, 10, 3)


@pytest.mark.unit
def test_cells_by_hand(at: variants.Scenes) -> None:
    """C's own state but for the rests; one body sinks 0.02 m, one tower grows by 0.06 m."""
    qpos = at.reference.copy()
    ids = at.state[0]
    base = shape_library().base[at.rests]
    qpos[-16:, 0, 2] = scene.TABLE_HEIGHT - base
    qpos[-3, 0, 2] -= 0.0015
    qpos[0, 0, 2] -= 0.02
    tallest = np.where(ids[1] >= 0, qpos[1, :, 2], -1.0).argmax()
    qpos[1, tallest, 2] += 0.06
    ok = jnp.ones(len(ids), bool).at[2].set(False)
    cells = variants.outcome(Settled(jnp.asarray(qpos), jnp.zeros(1), ok), at)
    num_bodies = 2 * (6 + 9 + 12)
    # Six towers, one 0.06 higher: 0.01 on average, deviation 0.0245 over sqrt(6).
    expected = ["1.50", f"{1 - 2 / num_bodies:.1%}", "83%", "+0.010 +- 0.010", "1"]
    assert cells == expected
