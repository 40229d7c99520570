"""`pool.FIELD=value` says how a pool is run, and is no part of what a run is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from envs_host.pool import PoolSettings
from jaxnew.representation.table import random_table
from jaxnew.storage.config import ConfigError
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.settings import TrainConfig, identity, only_computed, with_set, with_settings
from jaxnew.task.task import Task
from jaxnew.training import train_config
from tests.toy_task import TASK as TOY

pytestmark = pytest.mark.unit


def create() -> Task:
    return load_task("create-ladder")


def config_of(task: Task) -> TrainConfig:
    domain = Domain.of(task)
    table = random_table(domain.universe, 4, 0)
    return train_config(domain, "ours", "random-4", table, task.stage_two["smoke"], 1)


def test_settings_reach_the_pool_and_the_rest_reaches_the_config() -> None:
    given = ["num_updates=3", " pool.timeout_s = 5", "pool.on_worker_death=restart"]
    config = with_set(config_of(create()), given)
    assert config.num_updates == 3
    assert config.pool == PoolSettings(on_worker_death="restart", timeout_s=5.0)
    assert identity(config) == identity(with_set(config_of(create()), ["num_updates=3"]))
    assert "pool" not in identity(config)
    received: dict[str, Any] = {}

    def make_pool(**arguments: Any) -> Any:
        received.update(arguments)
        raise KeyboardInterrupt

    task = with_settings(create(), config)
    assert task.host is not None
    host = replace(task.host, make_pool=make_pool)
    with pytest.raises(KeyboardInterrupt):
        host.environments(4, seed=7, num_workers=2, environment=task.environment).start()
    assert received.pop("settings") == config.pool
    assert received.pop("environment") == create().environment
    assert received == {"num_envs": 4, "num_halves": 2, "num_workers": 2, "seed": 7}


@pytest.mark.parametrize(
    ("assignment", "says"),
    [
        ("pool.on_worker_deth=restart", r"Did you mean pool\.on_worker_death\?"),
        ("pool.on_worker_death=again", r"pool\.on_worker_death must be one of 'raise', 'restart'"),
        ("pool.timeout_s=soon", r"pool\.timeout_s must be float, got 'soon'"),
        ("pool.timeout_s=0", "timeout_s=0.0 must be above 0 seconds"),
        ("pool.max_restarts=-1", "max_restarts=-1 must be 0 or more"),
        ("pool=restart", r"pool is a group of fields; set one of them: pool\.on_worker_death"),
        ("pool.on_worker_death", "must look like path.to.field=value"),
    ],
)
def test_wrong_names_and_values(assignment: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        with_set(config_of(create()), [assignment])


def test_tasks_without_a_pool_and_fields_of_a_config() -> None:
    for task in (load_task("grid_world"), TOY):
        with pytest.raises(ConfigError, match=r"pool\.timeout_s cannot be set: pool is None"):
            with_set(config_of(task), ["pool.timeout_s=5"])
    with pytest.raises(ConfigError, match=r"num_updates=3: the run is there; only pool"):
        only_computed(config_of(create()), ["num_updates=3"])
    config = config_of(TOY)
    assert only_computed(config, []) == config
