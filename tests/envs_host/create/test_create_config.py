"""Settings: their plain form, and what is refused."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import pytest

from envs_host.create.config import CreateConfig, PhysicsConfig, RewardConfig


@pytest.mark.unit
def test_a_config_survives_its_plain_form() -> None:
    config = CreateConfig(
        physics=PhysicsConfig(gravity=1.0, fan_frame="world"),
        rewards=RewardConfig(alive=0.5),
        frame_walls="on",
    )
    assert CreateConfig.from_plain(json.loads(json.dumps(asdict(config)))) == config
    assert CreateConfig.from_plain({}) == CreateConfig()
    with pytest.raises(TypeError, match="gravitas"):
        CreateConfig.from_plain({"physics": {"gravitas": 1.0}})


@pytest.mark.unit
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"substeps": 0}, "substeps"),
        ({"substeps": 10**9}, "substeps=1000000000 must be from 1 to 10,000"),
        ({"fan_frame": "ball"}, "fan_frame"),
        ({"gravity": -2.0}, "gravity=-2.0 must be from 0 to 1,000"),
    ],
)
def test_wrong_physics_is_refused(wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PhysicsConfig(**wrong)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"observation": "colour"}, "observation='colour' must be one of"),
        ({"split": "gran_2"}, "split='gran_2'"),
        ({"split_part": "dev"}, "split_part='dev'"),
        ({"action_ids": "ids"}, "action_ids='ids'"),
        ({"frame_walls": True}, "frame_walls=True"),
        ({"step_limit": -1}, "step_limit=-1 must be from 0 to 10,000"),
        ({"action_set_size": 1}, "action_set_size=1 must be from 2 to"),
        ({"task_id": -2}, "task_id=-2"),
        ({"step_limit": 10**12}, "step_limit=1000000000000 must be from 0 to 10,000"),
        ({"render_size": 10**6}, "render_size=1000000 must be from 1 to 4,096"),
        ({"min_tool_distance": -0.1}, "min_tool_distance"),
        ({"stop_speed": math.inf}, "stop_speed=inf must be from 0 to"),
        ({"move_threshold": 1.5}, "move_threshold=1.5 must be from 0 to 1"),
    ],
)
def test_wrong_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CreateConfig(**settings)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("rewards", "message"),
    [
        ({"goal": math.nan}, "goal=nan must be from -1,000,000 to 1,000,000"),
        ({"per_tool_discount": -0.1}, "per_tool_discount=-0.1 must be from 0"),
        ({"dense_scale": -1.0}, "dense_scale=-1.0 must be from 0"),
    ],
)
def test_wrong_rewards_are_refused(rewards: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RewardConfig(**rewards)
