"""`--set=pool.FIELD=value` says how a pool is run, and belongs to no config."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from envs_host.pool import PoolSettings
from experiments.pipeline.flags import UsageError, load_task
from experiments.pipeline.machinery import pool_assignments, with_pool_settings
from jaxnew.storage.config import ConfigError
from jaxnew.task import HostDomain, Task
from tests.toy_task import TASK as TOY

pytestmark = pytest.mark.unit


def create() -> Task:
    return load_task("create-ladder")


def host_of(task: Task) -> HostDomain:
    assert task.host is not None
    return task.host


def test_settings_reach_the_pool_and_the_rest_reaches_the_config() -> None:
    given = ["num_updates=3", " pool.timeout_s = 5", "pool.on_worker_death=restart", "poolish=1"]
    mine, others = pool_assignments(given)
    assert mine == [" pool.timeout_s = 5", "pool.on_worker_death=restart"]
    assert others == ["num_updates=3", "poolish=1"]
    received: dict[str, Any] = {}

    def make_pool(**arguments: Any) -> Any:
        received.update(arguments)
        raise KeyboardInterrupt

    task = with_pool_settings(create(), mine)
    host = replace(host_of(task), make_pool=make_pool)
    with pytest.raises(KeyboardInterrupt):
        host.environments(4, seed=7, num_workers=2).start()
    settings = received.pop("settings")
    assert settings == PoolSettings(on_worker_death="restart", timeout_s=5.0)
    assert received == {"num_envs": 4, "num_halves": 2, "num_workers": 2, "seed": 7}
    assert replace(task, host=create().host) == create(), "nothing else of the task changes"


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
        with_pool_settings(create(), [assignment])


def test_tasks_without_a_pool_and_fields_of_a_config() -> None:
    with pytest.raises(UsageError, match="task grid_world has environments inside jit"):
        with_pool_settings(load_task("grid_world"), ["pool.timeout_s=5"])
    with pytest.raises(UsageError, match="task toy has a pool without settings"):
        with_pool_settings(TOY, ["pool.timeout_s=5"])
    with pytest.raises(UsageError, match=r"num_updates=3: the run is there; only --set=pool"):
        with_pool_settings(create(), ["num_updates=3"])
    assert with_pool_settings(TOY, []) is TOY
