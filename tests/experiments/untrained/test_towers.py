"""Towers from lists of drops."""

from __future__ import annotations

import numpy as np
import pytest

from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from experiments.untrained import towers


@pytest.mark.unit
def test_worlds_with_fewer_drops_stay_as_they_are() -> None:
    engine = MujocoC(settle_steps=20)
    drops = [[(690, 0.0)], [(690, 0.0), (594, 0.1)], []]
    start = towers.start_scenes([799] * 3, [0.0] * 3, [1.3] * 3)
    found = np.asarray(towers.stack(engine, start, drops).qpos)
    alone = towers.start_scenes([799], [0.0], [1.3])
    np.testing.assert_array_equal(found[0], towers.stack(engine, alone, drops[:1]).qpos[0])
    np.testing.assert_array_equal(found[1], towers.stack(engine, alone, drops[1:2]).qpos[0])
    np.testing.assert_array_equal(found[2], start.qpos[2])
    assert (found[1, 2:4, 2] < 10.0).all()
