"""What a task brings, and what it refuses to be."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from jaxnew.environment import ActionSpec, ObservationSpec
from jaxnew.task.places import UsageError
from jaxnew.task.task import HostDomain, Task
from tests import toy_device, toy_host, toy_task, video_task

pytestmark = pytest.mark.unit

LADDER, TOY = toy_device.TASK, toy_task.TASK


def test_the_environment_is_made_from_the_settings() -> None:
    env = LADDER.environment_of()
    assert int(env.default_params.time_limit) == 4
    changed = LADDER.environment_of(replace(LADDER.environment, time_limit=2, reward_scale=3.0))
    assert int(changed.default_params.time_limit) == 2
    np.testing.assert_allclose(
        changed.default_params.reward, 3 * np.asarray(env.default_params.reward), rtol=1e-6
    )
    assert LADDER.action_spec == ActionSpec(toy_device.A)
    nothing = replace(
        LADDER, environment=None, make_environment=partial(toy_device.Ladder, 1, 1, False)
    )
    assert nothing.environment_of().default_params.time_limit == 1
    assert TOY.action_spec == ActionSpec(toy_task.A, position_dim=2)
    with pytest.raises(ValueError, match="environments of task toy run on the host"):
        TOY.environment_of()


def test_presets_are_found_by_name() -> None:
    assert LADDER.budget("smoke") is LADDER.stage_two["smoke"]
    with pytest.raises(UsageError, match="Stage two has no budget 'paper'; choose one of smoke"):
        LADDER.budget("paper")


def host_of(**changes: Any) -> HostDomain:
    assert TOY.host is not None
    return replace(TOY.host, **changes)


def test_a_task_is_inside_jit_or_on_the_host() -> None:
    for changes in ({"make_environment": None}, {"host": TOY.host}):
        with pytest.raises(ValueError, match="needs one of make_environment and host"):
            replace(LADDER, **changes)
    with pytest.raises(ValueError, match="without a stop"):
        host_of(action_spec=ActionSpec(3, has_stop=True))


def test_groups_are_of_splits_that_exist() -> None:
    with pytest.raises(ValueError, match=r"validation_groups for \['full'\]; its splits are"):
        replace(TOY, validation_groups={"full": lambda universe: universe.class_labels})


def test_plays_of_a_task_do_not_share_names_nor_folders() -> None:
    task: Task = video_task.TASK
    states, video = task.plays
    with pytest.raises(ValueError, match=r"the modalities \['state', 'video', 'video'\]"):
        replace(task, plays=(states, video, video))
    for folder in ("recordings", "frames"):
        with pytest.raises(ValueError, match=r"the folders of recordings .* must be distinct"):
            replace(task, plays=(states, replace(video, folder=folder)))
    assert (states.seen, video.seen) == (states.format, video.drawing.format)  # type: ignore[union-attr]


def test_what_a_policy_sees_of_a_pool() -> None:
    """Frames as stacks, other shapes as they are."""
    size = toy_host.SIZE
    assert host_of().policy_observation.shape == (size, size, 3)
    vectors = host_of(observation_spec=ObservationSpec((7,), np.float32, 0, 1))
    assert vectors.policy_observation.shape == (7,)
    assert vectors.policy_observation.dtype == np.float32


@pytest.mark.parametrize(
    ("num_envs", "num_workers", "expected"), [(8, 3, (2, 3)), (8, 9, (2, 4)), (7, 9, (1, 7))]
)
def test_a_pool_gets_what_it_is_made_from(
    num_envs: int, num_workers: int, expected: tuple[int, int]
) -> None:
    """Halves where the number is even, no more workers than a half has environments, and settings
    only where there are some."""
    received: dict[str, Any] = {}

    def make_pool(**arguments: Any) -> Any:
        received.update(arguments)
        return toy_host.ToyPool(arguments["num_envs"], arguments["num_halves"])

    given = {"num_envs": num_envs, "seed": 5}
    host_of(make_pool=make_pool).environments(num_envs, 5, num_workers).start()
    halves = {"num_halves": expected[0], "num_workers": expected[1]}
    assert received == {**given, **halves}
    received.clear()
    host = host_of(make_pool=make_pool, pool_settings="how", max_episode_steps=len)
    environments = host.environments(num_envs, 5, num_workers, environment="what")
    assert not received  # Made when first needed.
    environments.start()
    assert received == {**given, **halves, "settings": "how", "environment": "what"}
    assert environments.max_episode_steps == len("what")
