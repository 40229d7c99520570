"""The example's kicks, their splits, and what recordings show of them."""

from __future__ import annotations

import numpy as np
import pytest

from examples.kicks import CLASSES, MAX_LENGTH, PLAY, TASK, from_the_start, kick_paths

pytestmark = pytest.mark.unit

UNIVERSE = TASK.make_universe()
SEED = 31


def test_a_path_by_hand() -> None:
    """36 shares of the length in 8 frames: 8, 7, ..., 1; the heading turns evenly by `turn`."""
    (path,) = kick_paths(np.array([0.5]), np.array([0.36]), np.array([0.7]))
    expected = [(0.0, 0.0)]
    for frame in range(8):
        heading, step = 0.5 + 0.1 * frame, 0.01 * (8 - frame)
        x, y = expected[-1]
        expected.append((x + step * np.cos(heading), y + step * np.sin(heading)))
    np.testing.assert_allclose(path, expected, atol=1e-6)  # float32 of numbers below one.


def test_universe() -> None:
    assert UNIVERSE.num_actions == 300
    assert np.bincount(UNIVERSE.class_labels).tolist() == [100] * 3
    paths = UNIVERSE.content
    (x, y), (end_x, end_y) = paths[:, 1].T, paths[:, -1].T
    bend = x * end_y - y * end_x  # Positive where the path ends to the left of how it began.
    for label, sign in zip(range(3), (0, 1, -1), strict=True):
        of_class = bend[UNIVERSE.class_labels == label]
        # Twice the area of a triangle of at most 0.16 x 0.7, in float32.
        assert (np.where(np.abs(of_class) < 1e-6, 0, np.sign(of_class)) == sign).all()
    assert np.hypot(end_x, end_y).max() <= MAX_LENGTH
    np.testing.assert_allclose(np.arctan2(y, x), UNIVERSE.primary_parameter, atol=1e-5)
    np.testing.assert_array_equal(
        UNIVERSE.engineered["path"].reshape(300, 8, 2), UNIVERSE.content[:, 1:]
    )


def test_splits() -> None:
    sizes = {}
    for name in TASK.splits:
        split = TASK.splits[name](UNIVERSE, 0)
        split.check(UNIVERSE)
        sizes[name] = [len(split.ids(part)) for part in ("train", "validation", "test")]
    assert sizes == {"default": [150, 75, 75], "right-is-new": [200, 50, 50]}
    is_right = UNIVERSE.class_labels == CLASSES.index("right")
    assert not is_right[split.train].any()
    assert is_right[split.test].all()


def test_recordings_show_the_kick_from_anywhere() -> None:
    ids = np.array([5, 250, 17])
    films = PLAY.record_block(SEED, ids, 40)
    assert PLAY.format.problem(films, (3, 40, *PLAY.format.shape), True) is None
    np.testing.assert_array_equal(films[1:2], PLAY.record_block(SEED, ids[1:2], 40))
    assert not np.array_equal(films, PLAY.record_block(SEED + 1, ids, 40))
    assert len(np.unique(films[:, :, 0, 0])) == 3 * 40  # No start is shared, also between kicks.
    assert films[:, :, 0].std(axis=1).min() > 0.4  # Starts are uniform over [-1, 1]: 0.58.
    paths = np.asarray(from_the_start(films))
    assert (paths[:, :, 0] == 0).all()
    # In tenths: two camera errors of deviation 0.1, so a mean over 40 films errs by 0.022.
    np.testing.assert_allclose(paths.mean(axis=1), 10 * UNIVERSE.content[ids], atol=0.1)
    noise = (films - films.mean(axis=2, keepdims=True))[0].std(axis=0).mean()
    assert 0.005 < noise < 0.015
