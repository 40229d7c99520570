"""Gymnasium environments as host environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from envs_host.protocol import GymnasiumHost, load_factory


class Placing(gymnasium.Env[Any, Any]):
    """Records its calls; ends at the third step."""

    def __init__(self, observation: spaces.Space[Any], action: spaces.Space[Any]) -> None:
        self.observation_space, self.action_space = observation, action
        self.calls: list[Any] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.calls = [seed]
        return np.zeros(self.observation_space.shape, self.observation_space.dtype), {"length": 0}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.calls.append(action)
        observation = np.full(self.observation_space.shape, 0.1, self.observation_space.dtype)
        is_end = len(self.calls) == 4
        info = {"length": len(self.calls) - 1, "other": "text"}
        return observation, 0.5, False, is_end, {**info, "score": 2} if is_end else info

    def close(self) -> None:
        self.calls.append("closed")


def box(*shape: int, dtype: Any = np.float32) -> spaces.Box:
    return spaces.Box(0, 1, shape, dtype)


ACTION = spaces.Dict({"where": box(2, dtype=np.float64), "tool": spaces.Discrete(5)})


@pytest.mark.unit
def test_an_id_and_a_position() -> None:
    env = Placing(box(4, dtype=np.float64), ACTION)
    host = GymnasiumHost(env, episode_metrics=("length", "score"))
    assert (host.observation_shape, host.position_dim) == ((4,), 2)
    assert np.dtype(host.observation_dtype) == np.float32
    assert host.episode_metrics == ("length", "score")
    seed = np.random.SeedSequence(3, spawn_key=(1, 2))
    observation = host.reset(seed)
    assert observation.dtype == np.float32
    assert env.calls == [int(seed.generate_state(1, np.uint32)[0])]
    steps = [host.step(t, np.array([0.1, 0.2], np.float32)) for t in (3, 0, 4)]
    assert [call["tool"] for call in env.calls[1:]] == [3, 0, 4]
    assert {call["where"].dtype for call in env.calls[1:]} == {np.dtype(np.float64)}
    np.testing.assert_array_equal(env.calls[1]["where"], np.array([0.1, 0.2], np.float32))
    assert steps[0].observation.dtype == np.float32
    np.testing.assert_array_equal(steps[0].observation, np.full(4, 0.1, np.float32))
    assert [step.reward for step in steps] == [0.5] * 3
    assert [step.terminated for step in steps] == [False] * 3
    assert [step.truncated for step in steps] == [False, False, True]
    assert [step.metrics["length"] for step in steps] == [1.0, 2.0, 3.0]
    np.testing.assert_array_equal([step.metrics["score"] for step in steps], [np.nan, np.nan, 2])
    host.close()
    assert env.calls[-1] == "closed"


@pytest.mark.unit
def test_a_bare_id_and_an_image() -> None:
    env = Placing(box(2, 2, 1, dtype=np.uint8), spaces.Discrete(3))
    host = GymnasiumHost(env)
    assert (host.observation_shape, host.position_dim) == ((2, 2, 1), 0)
    assert np.dtype(host.observation_dtype) == np.uint8
    assert host.reset(np.random.SeedSequence(0)).dtype == np.uint8
    assert host.step(2, np.zeros(0, np.float32)).observation.dtype == np.uint8
    assert env.calls[1:] == [2]


@pytest.mark.unit
def test_a_metric_that_never_comes() -> None:
    host = GymnasiumHost(Placing(box(4), ACTION), episode_metrics=("return",))
    host.reset(np.random.SeedSequence(0))
    for _ in range(2):
        assert np.isnan(host.step(0, np.zeros(2, np.float32)).metrics["return"])
    with pytest.raises(ValueError, match=r"without \['return'\] in its info, which has \['length'"):
        host.step(0, np.zeros(2, np.float32))


@pytest.mark.unit
@pytest.mark.parametrize(
    "action",
    [
        box(2),
        spaces.Tuple([spaces.Discrete(5), box(2)]),
        spaces.Dict({"tool": spaces.Discrete(5)}),
        spaces.Dict({"tool": spaces.Discrete(5), "where": box(2, 2)}),
        spaces.Dict({"tool": spaces.Discrete(5), "other": spaces.Discrete(5)}),
        spaces.Dict({"here": box(2), "where": box(2)}),
        spaces.Dict({**ACTION.spaces, "stop": spaces.Discrete(2)}),
    ],
)
def test_other_action_spaces_are_refused(action: spaces.Space[Any]) -> None:
    with pytest.raises(ValueError, match="must be a Dict of one Discrete and one Box"):
        GymnasiumHost(Placing(box(4), action))


@pytest.mark.unit
@pytest.mark.parametrize(
    "observation", [spaces.Discrete(5), spaces.Box(0, 9, (4,), np.int64), ACTION]
)
def test_other_observation_spaces_are_refused(observation: spaces.Space[Any]) -> None:
    with pytest.raises(ValueError, match="must be a Box of uint8 or floating point"):
        GymnasiumHost(Placing(observation, ACTION))


@pytest.mark.unit
def test_make_hands_arguments_on() -> None:
    make = load_factory("envs_host.protocol:GymnasiumHost.make")
    host = make(id="CartPole-v1", max_episode_steps=2)
    host.reset(np.random.SeedSequence(0))
    ends = [host.step(0, np.zeros(0, np.float32))[3] for _ in range(2)]
    assert ends == [False, True]
