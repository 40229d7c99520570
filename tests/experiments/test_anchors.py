"""The command `anchors` and its files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.anchors import measure_anchors
from experiments.reports.anchors import Anchors, markdown
from experiments.untrained import stacking
from jaxnew.evaluation import EVALUATION_SEED
from jaxnew.storage.config import ConfigError
from jaxnew.task.domain import Domain, load_task
from tests.experiments.commands import run


@pytest.mark.integration
def test_the_command_is_of_the_recommender_unless_told_otherwise(tmp_path: Path) -> None:
    out = f"--out={tmp_path}"
    output = run("anchors", "--sets=test", "--set_sizes=50", "--episodes=128", out)
    title = (
        "Policies without training, recommender, split default: 128 episodes each on sets of 50."
    )
    lines = output.splitlines()
    first = lines.index(title)
    assert lines[first + 2] == (
        "| policy | actions | click through rate [95 % interval] | episode length [95 % interval] |"
    )
    rows = lines[first + 4 : first + 7]
    assert [row.split(" | ")[:2] for row in rows] == [
        [f"| {name}", "test"] for name in ("random", "dot", "oracle")
    ]
    anchors = Anchors.load(tmp_path / "default-m50.json")
    assert markdown(anchors).splitlines()[4:] == rows
    output = run("anchors", "--task=grid_world", fails=True)
    assert "Task grid_world has no policies without training to measure." in output


def fixed_play(env: Any, name: str, ids: Any, *sizes: int) -> Any:
    """Heights that tell apart what was asked for."""
    height = len(name) + env.position_dim + len(ids) / 1024
    assert env.engine.name == "mujoco_c"
    assert sizes in {(20, 4), (10, 4)}
    values = np.array([height, height, height, height + 0.5])
    return {"final_height": values, "reward": values / 2, "num_steps": values}


@pytest.mark.unit
def test_a_file_of_anchors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stacking, "play", fixed_play)
    domain = Domain.of(load_task("shape_stacking-2d-place"))
    out = tmp_path / "anchors"
    (path,) = measure_anchors(domain, ["train", "test"], [], 4, out)
    assert path == out / "default-mujoco_c-m20.json"
    anchors = Anchors.load(path)
    assert (anchors.task, anchors.split) == ("shape_stacking-2d-place", "default")
    assert (anchors.set_size, anchors.num_episodes, anchors.seed) == (20, 4, EVALUATION_SEED)
    assert (anchors.environment, anchors.split_seed) == ({}, 0)
    assert list(anchors.values) == list(stacking.NAMES)
    found = anchors.values["scripted"]["test"]["final_height"]
    mean = 8 + 2 + 203 / 1024 + 0.125
    assert found["mean"] == pytest.approx(mean)
    # Deviation of (0, 0, 0, 0.5) 0.25, of their mean 0.125; 1.96 of them.
    assert found["high"] - mean == pytest.approx(1.96 * 0.125, abs=1e-3)
    lines = capsys.readouterr().out.splitlines()[1:]
    assert lines[0] == (
        "Policies without training, shape_stacking-2d-place, split default, engine mujoco_c: "
        "4 episodes each on sets of 20."
    )
    assert lines[2] == (
        "| policy | actions | final height (m) [95 % interval] | reward [95 % interval] |"
    )
    assert len(lines) == 4 + 4 * 2
    assert lines[-1].startswith(f"| scripted | test | {mean:.3f} [{mean - 0.245:.3f}, ")
    assert markdown(anchors).splitlines() == lines


@pytest.mark.unit
def test_sizes_and_settings_have_files_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def play(env: Any, *others: Any) -> Any:
        seen.append(int(env.default_params.max_actions))
        return fixed_play(env, *others)

    monkeypatch.setattr(stacking, "play", play)
    domain = Domain.of(load_task("shape_stacking"))
    changed = {"environment.max_actions": 3}
    files = measure_anchors(domain, ["test"], [10, 20], 4, tmp_path, changed)
    names = ["default-mujoco_c-max_actions=3-m10.json", "default-mujoco_c-max_actions=3-m20.json"]
    assert [file.name for file in files] == names
    assert set(seen) == {3}
    assert Anchors.load(files[0]).environment == {"max_actions": 3}
    with pytest.raises(ConfigError, match="physics"):
        measure_anchors(domain, ["test"], [], 4, tmp_path, ["environment.physics=bullet"])
    with pytest.raises(ConfigError, match="friction"):
        measure_anchors(domain, ["test"], [], 4, tmp_path, ["environment.friction=1"])
