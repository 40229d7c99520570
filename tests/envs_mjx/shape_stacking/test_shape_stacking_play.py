"""Shape Stacking's play environment (docs/shape_stacking.md, "Play data")."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.shape_stacking import play
from envs_mjx.shape_stacking.camera import orbit_camera, render_rgb
from envs_mjx.shape_stacking.play import PICTURE_SHAPE, draw_pictures, record_block, viewpoints
from envs_mjx.shape_stacking.shapes import shape_library

pytestmark = pytest.mark.unit


def test_viewpoints_are_uniform_over_the_spec_s_ranges() -> None:
    azimuth, height = viewpoints(0, 1024)
    assert azimuth.dtype == height.dtype == np.float32
    assert len(np.unique(azimuth)) == 1024
    for values, low, high in ((azimuth, 0.0, 2 * np.pi), (height, 0.5, 2.0)):
        assert low <= values.min() < values.max() <= high
        # Eight bins of 128 each; four standard deviations are 42.
        counts, _ = np.histogram(values, 8, (low, high))
        assert np.abs(counts - 128).max() < 43
    assert abs(np.corrcoef(azimuth, height)[0, 1]) < 0.1


def test_viewpoints_depend_on_seed_and_number_only() -> None:
    long, short, other = viewpoints(3, 500), viewpoints(3, 20), viewpoints(4, 20)
    np.testing.assert_array_equal(np.stack(long)[:, :20], np.stack(short))
    assert not np.intersect1d(short[0], other[0]).size


def test_repeated_views_as_in_the_original() -> None:
    azimuth, height = viewpoints(0, 1024, num_distinct_views=32)
    values, counts = np.unique(np.stack([azimuth, height]), axis=1, return_counts=True)
    assert values.shape == (2, 32)
    assert (counts == 32).all()
    np.testing.assert_array_equal(azimuth[:32], viewpoints(0, 32)[0])
    with pytest.raises(ValueError, match="num_distinct_views=0 must be 1 or more"):
        viewpoints(0, 4, num_distinct_views=0)


def recorded(seed: int, ids: np.ndarray, num_recordings: int, **options: int) -> np.ndarray:
    """uint8[n, S, 84, 84, 3] what is recorded of shapes, drawn."""
    views = record_block(seed, ids, num_recordings, **options)
    assert (views.shape, views.dtype) == ((len(ids), num_recordings, 2), np.float32)
    pictures = draw_pictures(np.repeat(ids, num_recordings), views.reshape(-1, 2))
    return pictures.reshape(len(ids), num_recordings, *PICTURE_SHAPE)


def test_recordings_are_the_shape_alone_from_the_shared_viewpoints() -> None:
    ids, num_recordings = np.array([500, 77], np.int32), 5
    block = recorded(5, ids, num_recordings)
    assert block.shape == (2, num_recordings, *PICTURE_SHAPE)
    assert block.dtype == np.uint8
    azimuth, height = viewpoints(5, num_recordings)
    library = shape_library()
    draw = jax.jit(partial(render_rgb, has_table=False, has_shadows=False))
    for row, shape_id in enumerate(ids):
        for k in (0, 1, 4):
            expected = draw(
                jnp.array([shape_id]),
                jnp.zeros((1, 3)),
                jnp.asarray(library.quaternion[[shape_id]], jnp.float32),
                orbit_camera(jnp.float32(azimuth[k]), jnp.float32(height[k])),
            )
            difference = np.abs(block[row, k].astype(int) - np.asarray(expected))
            # Rounding may move a pixel on an edge to the other side.
            assert (difference.max(-1) > 1).sum() <= 3
            assert (block[row, k].any(-1)).sum() > 30


def test_recordings_of_a_shape_do_not_depend_on_the_others() -> None:
    block = recorded(0, np.array([10, 400, 790], np.int32), 3)
    others = recorded(0, np.array([790, 10, 20], np.int32), 3)
    np.testing.assert_array_equal(others[:2], block[[2, 0]])
    assert not np.array_equal(others[2], block[0])
    assert not np.array_equal(recorded(1, np.array([10, 400, 790]), 3), block)
    repeated = recorded(0, np.array([10, 400, 790]), 3, num_distinct_views=2)
    np.testing.assert_array_equal(repeated[:, 2], repeated[:, 0])
    np.testing.assert_array_equal(repeated[:, :2], block[:, :2])


def test_views_drawn_side_by_side_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """As accelerators draw them; seven views do not fill two batches of four."""
    ids = np.array([480], np.int32)
    block = recorded(2, ids, 7)
    monkeypatch.setattr(play, "_VIEWS_AT_ONCE", {jax.default_backend(): 4})
    difference = np.abs(recorded(2, ids, 7).astype(int) - block)
    assert (difference.max(-1) > 1).sum() <= 7 * 3


def test_shapes_that_do_not_exist() -> None:
    with pytest.raises(ValueError, match=r"Shape 810 does not exist; ids are 0\.\.809"):
        draw_pictures(np.array([3, 810]), np.zeros((2, 2), np.float32))
