"""What tasks are trained and evaluated with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import pytest

from jaxnew.rollout.device import DeviceRollout
from jaxnew.task.domain import load_task
from jaxnew.task.places import UsageError
from jaxnew.trainer import rollout_of


@pytest.mark.unit
@pytest.mark.parametrize(
    ("name", "budget", "on_cpu", "on_gpu"),
    [
        ("shape_stacking", "accelerator", 16, 1024),
        ("shape_stacking", "laptop", 16, 32),
        ("grid_world", "laptop", 128, 128),
    ],
)
def test_accelerators_evaluate_as_wide_as_they_train(
    monkeypatch: pytest.MonkeyPatch, name: str, budget: str, on_cpu: int, on_gpu: int
) -> None:
    task, nobody_asks_it = load_task(name), object()
    config = task.stage_two[budget].ppo
    environment = task.environment_of()
    task = replace(task, make_environment=lambda **fields: environment)
    for backend, width in (("cpu", on_cpu), ("gpu", on_gpu)):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        method: Any = nobody_asks_it
        rollout = rollout_of(task, method, config, 0)
        assert isinstance(rollout, DeviceRollout)
        assert rollout.width == width


@pytest.mark.unit
def test_a_task_that_does_not_exist_is_told_those_that_do() -> None:
    tasks = "Tasks: create, grid_world, recommender, shape_stacking; or give package.module:TASK"
    with pytest.raises(UsageError, match=tasks):
        load_task("grid_wrold")
