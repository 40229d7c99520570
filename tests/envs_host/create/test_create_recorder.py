"""Recordings made by worker processes."""

from __future__ import annotations

import numpy as np
import pytest

from envs_host.create.poses import record_poses
from envs_host.create.recorder import PoolRecorder, Recorder
from envs_host.create.tools import ToolClass, all_tools

IDS = np.array([next(t.id for t in all_tools() if t.tool_class == c) for c in ToolClass], np.int32)


@pytest.mark.contract
def test_pools_of_any_size_record_the_poses() -> None:
    ids = IDS[[0, 16, 22, 5, 9]]
    expected = record_poses(3, ids, 2)
    for workers in (1, 2):
        recorder = PoolRecorder(workers, "poses")
        try:
            np.testing.assert_array_equal(recorder(3, ids, 2), expected)
        finally:
            recorder.close()


@pytest.mark.unit
def test_unknown_modalities_are_refused() -> None:
    for make in (Recorder, PoolRecorder):
        with pytest.raises(ValueError, match=r"modality='video' must be one of \('state', 'poses'"):
            make(0, 1, "video") if make is Recorder else make(1, "video")
