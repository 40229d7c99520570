"""Video recordings as poses: the simulations of the states, the frames of `record_images`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from envs_host.create import poses as create_poses
from envs_host.create.play import PlayConfig, record_block, record_images, record_worlds
from envs_host.create.poses import draw_poses, record_poses
from envs_host.create.tools import ToolClass, all_tools, no_op_id
from jaxnew import collection
from jaxnew.actions import ActionUniverse
from jaxnew.observations import RecordingFormat, Recordings

IDS = np.array([next(t.id for t in all_tools() if t.tool_class == c) for c in ToolClass], np.int32)


def drawn(ids: np.ndarray, poses: np.ndarray, spacing: int = 15) -> np.ndarray:
    """u8[n, S, 7, 48, 48] frames of poses [n, S, ...]."""
    repeated = np.repeat(ids, poses.shape[1])
    frames = draw_poses(repeated, poses.reshape(-1, *poses.shape[2:]), spacing)
    return frames.reshape(*poses.shape[:2], 7, 48, 48)


@pytest.mark.oracle
def test_drawn_poses_are_the_frames_of_the_simulation() -> None:
    poses = record_poses(4, IDS, 6)
    assert (poses.shape, poses.dtype) == ((23, 6, 7, 4, 3), np.float64)
    frames = drawn(IDS, poses)
    assert frames.dtype == np.uint8
    np.testing.assert_array_equal(frames, record_images(4, IDS, 6))
    assert (np.diff(frames.astype(int), axis=2) != 0).any(axis=(1, 2, 3, 4)).all()  # All move.


@pytest.mark.oracle
def test_poses_and_states_are_of_the_same_simulations() -> None:
    poses, states = record_poses(7, IDS, 3), record_block(7, IDS, 3)
    for tool_id, of_tool, expected in zip(IDS.tolist(), poses, states, strict=True):
        sprites = next(record_worlds(7, [tool_id], 1))[0].snapshots[0].sprites
        ball = of_tool[:, :, len(sprites) - 1, :2]
        np.testing.assert_allclose(ball / 42.0 - 1.0, expected[..., 2:4], atol=1e-6)
        assert not of_tool[:, :, len(sprites) :].any()


@pytest.mark.contract
def test_frames_of_a_recording_do_not_depend_on_the_others() -> None:
    poses = record_poses(0, IDS, 2)
    whole = drawn(IDS, poses)
    order = np.random.default_rng(0).permutation(len(IDS))
    np.testing.assert_array_equal(drawn(IDS[order], poses[order]), whole[order])
    np.testing.assert_array_equal(draw_poses(IDS[3:4], poses[3:4, 1])[0, ..., 0], whole[3, 1])
    np.testing.assert_array_equal(
        draw_poses(IDS[3:4], poses[3:4, 1, 2:5])[0, ..., 0], whole[3, 1, 2:5]
    )


@pytest.mark.oracle
def test_the_3_degree_list_is_drawn_with_its_own_tools() -> None:
    ids = np.array([100, 5000, 10000, 10876], np.int32)
    config = PlayConfig(angle_spacing=3)
    poses = record_poses(1, ids, 2, config)
    np.testing.assert_array_equal(drawn(ids, poses, 3), record_images(1, ids, 2, config))


@pytest.mark.contract
def test_no_tool_has_more_sprites_than_poses_hold() -> None:
    assert max(len(create_poses._looks(tool.id, 15)) for tool in all_tools()) == 4
    assert len(create_poses._looks(no_op_id(), 15)) == 1


@pytest.mark.unit
def test_poses_are_collected_and_gone_on_with(tmp_path: Path) -> None:
    """A collection that was cut off is the one that was not."""
    universe = ActionUniverse(
        name="Some-v0",
        class_labels=np.zeros(4, np.int32),
        class_names=("tool",),
        primary_parameter=np.arange(4.0),
        action_names=tuple("abcd"),
        content=np.arange(4.0)[:, None],
        engineered={},
    )
    calls: list[int] = []

    def record(seed: int, ids: np.ndarray, num_recordings: int) -> np.ndarray:
        calls.append(len(ids))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return record_poses(seed, ids, num_recordings)

    def collect(path: Path) -> Recordings:
        return collection.collect(
            path,
            record,
            format=RecordingFormat("poses", create_poses.POSES_SHAPE, "float64"),
            universe=universe,
            ids=np.arange(4, dtype=np.int32),
            num_recordings=2,
            seed=5,
            block_actions=1,
        )

    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path / "cut")
    cut = collect(tmp_path / "cut")
    assert len(calls) == 3 + 2  # Two were there.
    assert cut.hash == collect(tmp_path / "whole").hash
    np.testing.assert_array_equal(cut.data, record_poses(5, np.arange(4), 2))


@pytest.mark.unit
def test_bad_requests_are_refused() -> None:
    with pytest.raises(ValueError, match=r"poses must be \[2, T, 4, 3\].*got shape \(1, 7, 4, 3\)"):
        draw_poses(IDS[:2], np.zeros((1, 7, 4, 3)))
    with pytest.raises(ValueError, match=r"got shape \(1, 7, 3, 3\)"):
        draw_poses(IDS[:1], np.zeros((1, 7, 3, 3)))
    with pytest.raises(ValueError, match=r"2366 is not in 0\.\.2365"):
        record_poses(0, [2366], 1)
