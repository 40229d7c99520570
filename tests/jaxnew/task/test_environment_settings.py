"""`environment.FIELD=value` says what an environment is, and belongs to what a run is."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from jaxnew.representation.table import RepresentationTable
from jaxnew.storage import config as config_lib
from jaxnew.storage.config import ConfigError
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.settings import TrainConfig, identity, read_train_config, with_set
from jaxnew.task.task import Task
from jaxnew.trainer import Trainer
from jaxnew.training import train_config
from tests.toy_task import TASK as TOY

pytestmark = pytest.mark.unit


@dataclass(frozen=True)
class Settings:
    reward: float = 1.0
    is_hard: bool = False


def with_settings() -> tuple[Task, list[dict[str, Any]]]:
    """Grid World with settings of its own, and what environments were made from."""
    received: list[dict[str, Any]] = []
    task = load_task("grid_world")

    def make_environment(**arguments: Any) -> Any:
        received.append(arguments)
        return task.environment_of()

    return replace(task, make_environment=make_environment, environment=Settings()), received


def config_for(task: Task) -> tuple[TrainConfig, Domain, RepresentationTable]:
    domain = Domain.of(task)
    table = RepresentationTable(
        vectors=np.eye(domain.universe.num_actions, 5),
        ids=np.arange(domain.universe.num_actions, dtype=np.int32),
        universe_hash=domain.universe.hash,
    )
    budget = task.stage_two["smoke"]
    return train_config(domain, "ours", "mine", table, budget, 1), domain, table


def test_settings_reach_the_environment_of_a_trainer() -> None:
    task, received = with_settings()
    config, domain, table = config_for(task)
    config = with_set(config, [" environment.is_hard = true", "num_updates=3"])
    assert config.num_updates == 3
    assert config.environment == Settings(is_hard=True)
    trainer = Trainer.of(config, task, domain.split, table)
    assert received
    assert all(fields == {"reward": 1.0, "is_hard": True} for fields in received)
    assert trainer.task.environment == Settings(is_hard=True)


def test_without_any_the_environment_is_the_tasks() -> None:
    task, received = with_settings()
    config, domain, table = config_for(task)
    assert config.environment == Settings()
    Trainer.of(config, task, domain.split, table)
    assert all(fields == {"reward": 1.0, "is_hard": False} for fields in received)


def test_the_last_value_counts_and_the_config_survives_json() -> None:
    task, _ = with_settings()
    config = with_set(
        config_for(task)[0],
        ["environment.reward=2", "environment.is_hard=true", "environment.reward=3"],
    )
    assert config.environment == Settings(3.0, True)
    again = with_set(config, {"environment.reward": 4.0})
    assert again.environment == Settings(4.0, True)
    plain = json.loads(json.dumps(identity(config)))
    assert read_train_config(plain, task)[0] == config


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
        with_set(config_for(with_settings()[0])[0], [assignment])


def test_an_environment_with_nothing_to_set() -> None:
    with pytest.raises(
        ConfigError, match=r"environment\.reward cannot be set: environment is None"
    ):
        with_set(config_for(TOY)[0], ["environment.reward=2"])


def test_shape_stacking_has_settings() -> None:
    task = load_task("shape_stacking-2d-place")
    config = with_set(
        config_for(task)[0], ["environment.physics=mujoco", "environment.reward_variant=paper"]
    )
    environment: Any = task.environment_of(config.environment)
    assert environment.engine.name == "mujoco_c"
    assert environment.position_dim == 2
    assert config.environment == replace(task.environment, physics="mujoco", reward_variant="paper")


def test_runs_are_kept_apart_by_them() -> None:
    config = config_for(with_settings()[0])[0]
    other = with_set(config, ["environment.reward=2"])
    assert config_lib.differences(identity(config), identity(other)) == [
        ("environment.reward", 1.0, 2.0)
    ]
