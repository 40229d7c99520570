"""`--set=environment.FIELD=value` says what an environment is, and belongs to the config."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from experiments.pipeline.artifacts import Domain
from experiments.pipeline.flags import UsageError, load_task
from experiments.pipeline.machinery import with_environment_settings
from experiments.pipeline.training import TrainConfig, Trainer
from jaxnew.representation.table import RepresentationTable
from jaxnew.storage import config as config_lib
from jaxnew.storage.config import ConfigError
from jaxnew.task import Task

pytestmark = pytest.mark.unit


@dataclass(frozen=True)
class Settings:
    reward: float = 1.0
    is_hard: bool = False


def with_settings() -> tuple[Task, dict[str, Any]]:
    """Grid World with settings, and where they arrive."""
    received: dict[str, Any] = {}
    task = load_task("grid_world")

    def make_environment(**arguments: Any) -> Any:
        received.update(arguments)
        return task.make_environment()

    settings = Settings()
    return replace(task, make_environment=make_environment, environment_settings=settings), received


def config_for(task: Task) -> tuple[TrainConfig, Domain, RepresentationTable]:
    domain = Domain.of(task, None)
    table = RepresentationTable(
        vectors=domain.universe.engineered["gt5"],
        ids=np.arange(domain.universe.num_actions, dtype=np.int32),
        universe_hash=domain.universe.hash,
        source="engineered:gt5",
    )
    budget = task.stage_two["smoke"]
    return TrainConfig.of(domain, "ours", "gt5", table, budget, 1), domain, table


def test_settings_reach_the_environment_of_a_trainer() -> None:
    task, received = with_settings()
    config, domain, table = config_for(task)
    config = config.with_set([" environment.is_hard = true", "num_updates=3"])
    assert config.num_updates == 3
    assert config.environment == ("environment.is_hard=true",)
    trainer = Trainer.of(config, task, domain.split, table)
    assert received == {"reward": 1.0, "is_hard": True}
    assert trainer.task.environment_settings == Settings(is_hard=True)


def test_without_any_the_environment_is_made_from_nothing() -> None:
    task, received = with_settings()
    config, domain, table = config_for(task)
    assert config.environment == ()
    assert with_environment_settings(task, config.environment) is task
    Trainer.of(config, task, domain.split, table)
    assert received == {}


def test_the_last_value_counts_and_the_config_survives_json() -> None:
    config = config_for(load_task("grid_world"))[0].with_set(
        ["environment.reward=2", "environment.is_hard=true", "environment.reward=3"]
    )
    assert config.environment == ("environment.is_hard=true", "environment.reward=3")
    again = config.with_set(["environment.reward=4"])
    assert again.environment == ("environment.is_hard=true", "environment.reward=4")
    plain = json.loads(json.dumps(config_lib.to_dict(config)))
    assert TrainConfig.from_plain(plain) == config
    del plain["environment"]  # As in runs of before there were settings.
    assert TrainConfig.from_plain(plain) == replace(config, environment=())


@pytest.mark.parametrize(
    ("assignment", "says"),
    [
        ("environment.is_hrd=true", r"Did you mean environment\.is_hard\?"),
        ("environment.reward=much", r"environment\.reward must be float, got 'much'"),
        ("environment=hard", r"environment is a group of fields; set one of them"),
        ("environment.reward", "must look like path.to.field=value"),
    ],
)
def test_wrong_names_and_values(assignment: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        with_environment_settings(with_settings()[0], [assignment])


def test_an_environment_with_nothing_to_set() -> None:
    with pytest.raises(UsageError, match="environment of task grid_world has nothing to set"):
        with_environment_settings(load_task("grid_world"), ["environment.reward=2"])


def test_shape_stacking_has_settings() -> None:
    task = load_task("shape_stacking-2d-place")
    assignments = ["environment.physics=mujoco", "environment.reward_variant=paper"]
    changed = with_environment_settings(task, assignments)
    environment: Any = changed.make_environment()
    assert environment.engine.name == "mujoco_c"
    assert environment.position_dim == 2
    assert changed.environment_settings == replace(
        task.environment_settings, physics="mujoco", reward_variant="paper"
    )


def test_runs_are_kept_apart_by_them() -> None:
    config = config_for(load_task("grid_world"))[0]
    other = config.with_set(["environment.reward=2"])
    assert config_lib.differences(config, other) == [("environment", [], ["environment.reward=2"])]
