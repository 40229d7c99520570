"""Copies of environments go on as their originals do, to the bit, pictures included."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

from envs_host.create import CreateEnv, register_environments
from envs_host.create.hosting import CreateHost
from envs_host.create.illustration import RenderOptions
from envs_host.pool import HostPool
from envs_host.protocol import GymnasiumHost
from tests.envs_host.pool_toys import FAULTY

pytestmark = pytest.mark.property


def pickled(env: Any) -> Any:
    return pickle.loads(pickle.dumps(env))


COPIES = pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
RNG = np.random.default_rng(3)
ACTIONS = [{"index": int(RNG.integers(50)), "position": RNG.uniform(-1, 1, 2)} for _ in range(20)]


def play(env: Any, actions: list[Any]) -> list[list[Any]]:
    """All that is seen of the actions, in one episode after the other, and of random streams."""
    found = []
    for action in actions:
        if env.unwrapped._is_over:
            observation, info = env.reset()
            found.append([observation, info.pop("available_ids"), repr(info)])
        observation, reward, terminated, truncated, info = env.step(action)
        found.append([observation, env.render(), info.pop("available_ids"), repr(info), reward])
        found[-1] += [terminated, truncated, repr(env.unwrapped.world.positions)]
        found[-1] += env.action_space.sample().values()
    return found


def assert_same(found: list[list[Any]], wanted: list[list[Any]]) -> None:
    assert len(found) == len(wanted)
    for seen, expected in zip(found, wanted, strict=True):
        for one, other in zip(seen, expected, strict=True):
            np.testing.assert_array_equal(one, other)


def made(level: str) -> CreateEnv:
    env = CreateEnv(level, render_mode="rgb_array", render_options=RenderOptions(size=96))
    env.reset(seed=5)
    env.action_space.seed(6)
    return env


@COPIES
@pytest.mark.parametrize("level", ["Push", "Seesaw", "Buckets"])
def test_a_copy_and_its_original_go_on_as_if_there_was_no_copy(
    level: str, copied: Callable[[Any], Any]
) -> None:
    alone = made(level)
    before, after = play(alone, ACTIONS[:7]), play(alone, ACTIONS[7:])
    original = made(level)
    at_start = copied(original)
    assert_same(play(original, ACTIONS[:7]), before)
    in_episode = copied(original)
    assert_same(play(original, ACTIONS[7:]), after)
    assert_same(play(in_episode, ACTIONS[7:]), after)
    assert_same(play(at_start, ACTIONS), before + after)


@COPIES
def test_before_the_first_reset(copied: Callable[[Any], Any]) -> None:
    """There is no episode to copy; a stream that has begun goes on."""
    original = CreateEnv("Push", render_mode="rgb_array")
    original.np_random.random()
    original.action_space.seed(6)
    twin = copied(original)
    assert_same(play(twin, ACTIONS[:2]), play(original, ACTIONS[:2]))


@COPIES
def test_wrapped_by_gymnasium(copied: Callable[[Any], Any]) -> None:
    original = gymnasium.make(register_environments()[0], render_mode="rgb_array")
    original.reset(seed=1)
    original.action_space.seed(6)
    play(original, ACTIONS[:3])
    twin = copied(original)
    assert_same(play(twin, ACTIONS[3:6]), play(original, ACTIONS[3:6]))


@COPIES
@pytest.mark.parametrize(
    "make", [CreateHost, lambda: GymnasiumHost.make("CartPole-v1")], ids=["create", "gymnasium"]
)
def test_in_the_form_of_the_pool(make: Callable[[], Any], copied: Callable[[Any], Any]) -> None:
    original = make()
    position = np.zeros(original.position_dim, np.float32)
    original.reset(np.random.SeedSequence(1))
    original.step(0, position)
    twin = copied(original)
    for _ in range(4):
        one, other = twin.step(1, position), original.step(1, position)
        assert one[1:] == other[1:]
        np.testing.assert_array_equal(one[0], other[0])


def test_nobody_watches_a_copy() -> None:
    """What watches may be a film that is under way, and no process needs to know it."""
    original = CreateEnv("Push")
    original.watch = lambda world: None
    assert copy.deepcopy(original).watch is None is pickled(original).watch
    assert original.watch is not None


def test_a_pool_says_how_it_is_copied() -> None:
    with HostPool(FAULTY, {"fault": "hang"}, 1, 1, 0, num_halves=1) as pool:
        for copied in (copy.copy, copy.deepcopy, pickled):
            with pytest.raises(TypeError, match="give it state_dict"):
                copied(pool)
