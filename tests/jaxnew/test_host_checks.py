"""Planted mistakes in environments on the host and their pools, told as those of others are."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_checks import told

import jaxnew
from jaxnew.checks.run import check_run
from jaxnew.environment import ActionSpec, ObservationSpec
from jaxnew.task.places import UsageError
from jaxnew.task.task import Task
from tests import toy_task
from tests.toy_host import ToyEnv, ToyPool

pytestmark = pytest.mark.contract


class SoundHost(ToyEnv):
    """The toy, as an environment for the pool. Mistakes are planted in its subclasses."""

    observation_shape, observation_dtype, position_dim = (16, 16), np.uint8, 2
    episode_metrics = ("is_success", "episode_return")


def host_step(**changes: Callable[[Any], Any]) -> dict[str, Any]:
    names = ("observation", "reward", "terminated", "truncated", "metrics")

    def step(self: Any, action_id: int, position: np.ndarray) -> Any:
        parts = ToyEnv.step(self, action_id, position)
        same: Callable[[Any], Any] = lambda part: part  # noqa: E731
        return tuple(changes.get(n, same)(part) for n, part in zip(names, parts, strict=True))

    return {"step": step}


def reset_with_chance(self: Any, seed: np.random.SeedSequence) -> np.ndarray:
    """What follows is left to chance too; a few steps of it may come out alike, the frame not."""
    frame = ToyEnv.reset(self, seed)
    self.rng = np.random.default_rng()
    return self.rng.integers(256, size=frame.shape, dtype=frame.dtype)


HOSTS: dict[str, tuple[dict[str, Any], str]] = {
    "no shape": ({"observation_shape": property()}, "reset fails|lacks observation_shape"),
    "shape": ({"observation_shape": (16, 8)}, r"uint8\[16, 16\]; .* say uint8\[16, 8\]"),
    "dtype": (
        host_step(observation=lambda x: x.astype(np.float32)),
        r"step: the observation is float32\[16, 16\]; .* say uint8",
    ),
    "a dtype that pools have not": ({"observation_dtype": np.float64}, "must be uint8 or float32"),
    "reward of one element": (
        host_step(reward=lambda x: np.array([x])),
        r"step: the reward is float64\[1\]; it must be one number",
    ),
    "NaN": (host_step(reward=lambda x: np.nan), "step: a reward is nan"),
    "a number for an end": (host_step(truncated=int), "truncated is 0, a int; it must be one bool"),
    "metrics": (host_step(metrics=lambda m: {}), r"the metrics of a step are \[\]"),
    "four parts": (
        {"step": lambda self, *arguments: ToyEnv.step(self, *arguments)[:4]},
        "step gives 4 parts; it must give 5: observation, reward",
    ),
    "chance": (
        {"reset": reset_with_chance},
        "the same seed and the same actions gave another episode the second time",
    ),
    "one start": (
        {"reset": lambda self, seed: ToyEnv.reset(self, np.random.SeedSequence(1))},
        "reset: 8 seeds gave one and the same first observation",
    ),
    "an error": (host_step(reward=lambda x: 1 / 0), "step fails: ZeroDivisionError: division"),
}


@pytest.mark.parametrize("what", HOSTS)
def test_an_environment_for_the_pool(what: str) -> None:
    mistake, message = HOSTS[what]
    mine = type("Mine", (SoundHost,), mistake)
    text = told(lambda: jaxnew.check_environment(mine()))
    assert re.search(message, text), text


def test_sound_environments_for_the_pool() -> None:
    jaxnew.check_environment(SoundHost())
    with pytest.raises(UsageError, match=r"object lacks .*see envs_host.protocol.HostEnvironment"):
        jaxnew.check_environment(object())


def made_of(env: type, **changes: Any) -> Task:
    """The toy task with environments of that class, in pools with these members."""
    pool = type("MyPool", (ToyPool,), {"make_env": env, **changes})
    host = toy_task.TASK.host
    assert host is not None
    return replace(
        toy_task.TASK, host=replace(host, make_pool=lambda **arguments: pool(**arguments))
    )


POOLS: dict[str, tuple[dict[str, Any], str]] = {
    "reward": (host_step(reward=lambda x: np.nan), "step: an observation or a reward is NaN"),
    "chance": ({"reset": reset_with_chance}, "The same seed .* gave other episodes"),
    "shape": ({}, r"have observations uint8\[16, 16\] .*; the task's .* say uint8\[8, 8\] and 2"),
    "positions": ({}, r"positions of 2 numbers; the task's .* say uint8\[16, 16\] and 3"),
}


@pytest.mark.parametrize("what", POOLS)
def test_runs_of_mistakes_on_the_host_do_not_begin(what: str, tmp_path: Path) -> None:
    mistake, message = POOLS[what]
    task = made_of(type("Mine", (ToyEnv,), mistake))
    assert task.host is not None
    said = {
        "shape": {"observation_spec": ObservationSpec((8, 8), np.uint8, 0, 255)},
        "positions": {"action_spec": ActionSpec(toy_task.A, position_dim=3)},
    }
    task = replace(task, host=replace(task.host, **said.get(what, {})))
    with pytest.raises(UsageError, match=message):
        jaxnew.train(task, "gt4", budget="smoke", runs=tmp_path)
    assert list(tmp_path.rglob("config.json")) == []


def test_a_pool_is_tried_once_and_closed() -> None:
    pools: list[ToyPool] = []

    def make_pool(**arguments: Any) -> ToyPool:
        pools.append(ToyPool(**arguments))
        return pools[-1]

    host = toy_task.TASK.host
    assert host is not None
    task = replace(toy_task.TASK, host=replace(host, make_pool=make_pool))
    rollout: Any = SimpleNamespace(method=None)
    for _ in range(2):
        check_run(task, rollout, "ours", np.zeros((toy_task.A, 4), np.float32))
    assert [pool.is_closed for pool in pools] == [True]
