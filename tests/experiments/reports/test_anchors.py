"""Where figures find the anchors of their runs."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from envs_mjx.shape_stacking import StackingSettings
from experiments.reports.anchors import Anchors, anchors_of, lines_of, markdown, notes_of
from experiments.reports.runs import Group, read_runs
from jaxnew.storage import config as config_lib
from jaxnew.task.domain import load_task
from jaxnew.task.places import UsageError
from tests.experiments.handwritten import plain_config, write_anchors, write_run


def group_at(
    folder: Path, split: str = "default", set_size: int = 20, max_actions: int = 10
) -> Group:
    task = load_task("shape_stacking")
    config = {
        **plain_config(split=split),
        "task": task.name,
        "ppo": config_lib.to_dict(task.budget("paper").ppo),
        "sets": {**config_lib.to_dict(task.budget("paper").sets), "size": set_size},
        "environment": config_lib.to_dict(StackingSettings(max_actions=max_actions)),
    }
    name = f"run-{split}-{set_size}-{max_actions}"
    path = write_run(folder / name, config, metric="final_height")
    return Group("ours", task, tuple(read_runs([path])))


@pytest.mark.unit
def test_anchors_stand_beside_their_runs(tmp_path: Path) -> None:
    runs = tmp_path / "shape_stacking"
    group = group_at(runs)
    assert anchors_of(group) == []
    assert notes_of([group]) == []
    first = Anchors.load(write_anchors(runs / "anchors", 0.25))
    full = Anchors.load(write_anchors(runs / "anchors", 0.5, split="full"))
    assert anchors_of(group) == [first]
    assert lines_of(group) == {"stop at once": 0.25}
    assert lines_of(group, "validation") == {}
    assert lines_of(group_at(runs, "full")) == {"stop at once": 0.5}
    assert lines_of(group_at(runs, set_size=10)) == {}
    # In a sweep, a member is further down.
    assert anchors_of(group_at(runs / "sweep" / "members")) == [first]
    assert anchors_of(group_at(tmp_path / "elsewhere")) == []
    both = notes_of([group, group_at(runs, "full"), group_at(runs / "sweep")])
    assert both == [markdown(first), markdown(full)]
    # Of worlds with other settings there are others.
    short = group_at(runs, max_actions=3)
    assert lines_of(short) == {}
    write_anchors(runs / "anchors", 0.375, environment={"max_actions": 3})
    assert lines_of(short) == {"stop at once": 0.375}
    write_anchors(runs / "anchors", 0.75, engine="mjx")
    assert lines_of(group) == {"stop at once (mjx)": 0.75, "stop at once (mujoco_c)": 0.25}
    # A file of the version before, which was named otherwise, counts unless there is a newer one.
    newer = runs / "anchors" / "default-mujoco_c-m20.json"
    older = newer.rename(newer.with_name("default-mujoco_c.json"))
    assert lines_of(group)["stop at once (mujoco_c)"] == 0.25
    write_anchors(runs / "anchors", 0.125)
    os.utime(older, (0, 0))
    assert lines_of(group)["stop at once (mujoco_c)"] == 0.125
    file = runs / "anchors" / "default-mjx-m20.json"
    file.write_text(json.dumps({"task": "shape_stacking"}))
    with pytest.raises(UsageError, match=r"default-mjx-m20\.json is damaged"):
        lines_of(group)
