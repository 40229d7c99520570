"""CREATE as pools run it: a level with any config that a pool can play."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from envs_host.create import CreateConfig, PhysicsConfig, RewardConfig
from envs_host.create.hosting import CreateHost
from envs_host.create.levels import LevelError
from envs_host.pool import HostPool

FACTORY = "envs_host.create.hosting:CreateHost"
NO_OP = 2365
NOWHERE = np.zeros(2, np.float32)

CONFIG = CreateConfig(
    physics=PhysicsConfig(gravity=1.0, fan_frame="world"),
    rewards=RewardConfig(alive=0.5, no_op=0.25),
    step_limit=1,
    frame_walls="on",
    split="full",
    action_ids="universe",
    render_size=42,
)


@pytest.mark.unit
def test_a_config_may_be_given_in_either_form() -> None:
    assert CreateHost("Push", config=asdict(CONFIG)).env.config == CONFIG
    assert CreateHost("Push", config=CONFIG).env.config == CONFIG
    assert CreateHost().env.config == CreateConfig(action_ids="universe")


@pytest.mark.contract
def test_a_whole_config_reaches_the_worlds_of_a_pool() -> None:
    kwargs = {"level": "Navigate", "deterministic": True, "config": asdict(CONFIG)}
    ids, positions = np.array([NO_OP, NO_OP]), np.zeros((2, 2), np.float32)
    with HostPool(FACTORY, kwargs, 2, 1, seed=3, num_halves=1) as pool:
        first = pool.reset().copy()
        steps = [pool.step(ids, positions) for _ in range(2)]
    assert first.shape == (2, 42, 42)
    np.testing.assert_array_equal(first[0], first[1])  # No noise.
    assert steps[0].rewards.tolist() == [0.75, 0.75]
    assert [step.truncated.tolist() for step in steps] == [[False, False], [True, True]]
    host = CreateHost(**kwargs)
    np.testing.assert_array_equal(host.reset(np.random.SeedSequence(9)), first[0])
    assert host.step(NO_OP, NOWHERE).reward == 0.75


@pytest.mark.unit
@pytest.mark.parametrize(
    ("config", "message"),
    [
        (CreateConfig(), "action_ids='set' must be 'universe' in a pool: the rollout owns"),
        ({"action_ids": "universe", "observation": "rgb"}, "observation='rgb' must be 'gray'"),
        ({"action_ids": "universe", "physics": {"substeps": 0}}, "substeps=0"),
    ],
)
def test_what_a_pool_cannot_play_is_refused(config: CreateConfig | dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CreateHost("Push", config=config)
    with pytest.raises(LevelError, match="Pusch"):
        CreateHost("Pusch")
