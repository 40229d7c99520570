"""The play environment against a NumPy walk (docs/grid_world.md, "Play data")."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_mjx.grid_world.play import featurize_onehot, featurize_xy, record, trajectory
from envs_mjx.grid_world.skills import net_displacement

pytestmark = pytest.mark.oracle


@pytest.fixture(scope="module")
def stored() -> np.ndarray:
    """uint8[1024, 256, 6, 2] recordings of every skill."""
    recordings = record(jax.random.key(0), jnp.arange(1024), 256)
    assert recordings.dtype == jnp.uint8
    return np.asarray(recordings)


def walk(starts: np.ndarray, skill_id: np.ndarray, low: int, high: int) -> np.ndarray:
    """int[..., 6, 2] by the sentences of the page: a wall stops the move, the next goes on."""
    cells = [starts.astype(int)]
    for t in range(5):
        move = (skill_id // 4**t) % 4
        step = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[move]
        target = cells[-1] + step
        is_blocked = ((target < low) | (target > high)).any(axis=-1, keepdims=True)
        cells.append(np.where(is_blocked, cells[-1], target))
    return np.stack(cells, axis=-2)


def test_every_trajectory_is_the_walk_from_its_start(stored: np.ndarray) -> None:
    skill_id = np.arange(1024)[:, None].repeat(stored.shape[1], axis=1)
    assert stored.shape == (1024, 256, 6, 2)
    assert np.array_equal(stored, walk(stored[:, :, 0], skill_id, 1, 78))
    is_bumped = (np.diff(stored.astype(int), axis=2) == 0).all(axis=-1)
    assert is_bumped.any()


@pytest.mark.golden
def test_trajectory_of_the_spec() -> None:
    cells = trajectory(jnp.array([60, 56]), jnp.int32(912))
    assert cells.tolist() == [[60, 56], [61, 56], [62, 56], [62, 57], [61, 57], [61, 56]]
    # Clipped move by move, not once at the end: R L at the wall is one cell to the left.
    assert trajectory(jnp.array([78, 5]), jnp.int32(0 + 2 * 4)).tolist()[2] == [77, 5]


def test_starts_are_uniform_over_the_free_cells(stored: np.ndarray) -> None:
    starts = stored[:, :, 0].reshape(-1, 2).astype(int)
    counts = np.bincount(80 * starts[:, 0] + starts[:, 1], minlength=6400).reshape(80, 80)
    assert counts[78, 78] == 0  # the goal's cell
    counts[78, 78] = -1
    assert counts[[0, 79]].sum() == counts[:, [0, 79]].sum() == 0
    free = counts[1:79, 1:79].ravel()
    free = free[free >= 0]
    assert len(free) == 6083
    # Chi-square: mean 6082, deviation sqrt(2 * 6082) = 110, five of them.
    expected = len(starts) / len(free)
    assert abs(((free - expected) ** 2 / expected).sum() - 6082) < 550


def test_recordings_depend_on_key_and_skill_only(stored: np.ndarray) -> None:
    some = np.asarray(record(jax.random.key(0), np.array([700, 3]), 256))
    assert np.array_equal(some, stored[[700, 3]])
    other_key = np.asarray(record(jax.random.key(1), np.array([700, 3]), 256))
    assert not np.array_equal(some[:, :, 0], other_key[:, :, 0])
    assert not np.array_equal(some[0, :, 0], some[1, :, 0])


def test_without_border_no_move_is_lost() -> None:
    stored = np.asarray(record(jax.random.key(0), np.arange(1024), 64, has_border=False))
    moved = stored[:, :, -1].astype(int) - stored[:, :, 0]
    assert (moved == net_displacement()[:, None]).all()
    assert stored[:, :, 0].min() == 5
    assert stored[:, :, 0].max() == 74
    assert stored.max() <= 79


def test_features(stored: np.ndarray) -> None:
    some = stored[:3, :4]
    xy, onehot = featurize_xy(some), featurize_onehot(some)
    assert (xy.shape, xy.dtype) == ((3, 4, 6, 2), jnp.float32)
    assert np.array_equal(xy, some)
    assert (onehot.shape, onehot.dtype) == ((3, 4, 6, 160), jnp.float32)
    assert np.array_equal(onehot[..., :80].argmax(-1), some[..., 0])
    assert np.array_equal(onehot[..., 80:].argmax(-1), some[..., 1])
    assert (onehot.sum(-1) == 2).all()
    assert set(np.unique(onehot)) == {0, 1}
