"""The tables of reference figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from experiments.benchmarks import stacking_spec
from experiments.untrained import stacking
from experiments.untrained.towers import Row


@pytest.mark.unit
def test_tables() -> None:
    """Values beyond the tolerance stand out."""
    columns = {
        "a": [Row(6, "cube: z1", 0.482, 0.005, 0.484), Row(16, "cone: z2", "falls", None, 0.3)],
        "b": [Row(6, "cube: z1", 0.482, 0.005, 0.488), Row(16, "cone: z2", "falls", None, 0.9)],
    }
    assert stacking_spec.figures_table(columns) == [
        "| check | what | reference | tolerance | a | b |",
        "| --- | --- | --- | --- | --- | --- |",
        "| 6 | cube: z1 | 0.482 | 0.005 | 0.4840 | **0.4880** |",
        "| 16 | cone: z2 | falls |  | 0.3000 | 0.9000 |",
    ]
    assert stacking_spec.differences_table(columns, "a", "b") == [
        "| check | what | a | b | difference |",
        "| --- | --- | --- | --- | --- |",
        "| 16 | cone: z2 | 0.3000 | 0.9000 | +0.6000 |",
    ]


@pytest.mark.unit
def test_engines_of_the_tables() -> None:
    assert [e.name for e in stacking_spec.engines_of("mujoco").values()] == ["mujoco_c"] * 2
    assert [e.name for e in stacking_spec.engines_of("mjx").values()] == ["mujoco_c"] * 2 + ["mjx"]


@pytest.mark.unit
def test_anchors_are_played_on_every_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    def play(env: Any, name: str, ids: np.ndarray, *sizes: int) -> dict[str, np.ndarray]:
        assert (len(ids), *sizes) == (810, 20, 4)
        height = env.engine.settle_steps + np.array([0.0, 0.0, 0.0, 0.5])
        return {"final_height": height, "reward": height / 2}

    monkeypatch.setattr(stacking, "play", play)
    engines = {"a": MujocoC(settle_steps=1), "b": MujocoC(settle_steps=2)}
    lines = stacking_spec.anchors_table(engines, 4)
    assert lines[0].endswith("| height, a | reward, a | height, b | reward, b |")
    # Deviation of (0, 0, 0, 0.5) 0.25, of their mean 0.125.
    assert lines[-1] == (
        "| scripted | 4.28 +- 0.28 | 3.30 | 1.125 +- 0.125 | 0.562 | 2.125 +- 0.125 | 1.062 |"
    )
    assert len(lines) == 2 + 4
