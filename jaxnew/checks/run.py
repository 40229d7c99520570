"""What `train` and `sweep` check before they compile."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np

from jaxnew.checks.environment import check_forms, check_played
from jaxnew.checks.policy import check_method
from jaxnew.checks.pool import check_pool
from jaxnew.rollout.contract import Rollout
from jaxnew.rollout.device import DeviceRollout
from jaxnew.task.domain import is_installed
from jaxnew.task.task import Task

# What was tried out: classes, and makers of pools.
_SOUND: weakref.WeakSet[Any] = weakref.WeakSet()


def check_run(task: Task, rollout: Rollout, method: str, table: np.ndarray) -> None:
    """What `train` and `sweep` ask of the parts of a run before they compile.

    Of every environment inside jit its forms. Environments, pools and policies that no installed
    package brings are tried out, too, once in a process.

    Args:
      task, rollout: of the run.
      method: its name.
      table: f32[A, d] representations.

    Raises:
      UsageError: one of them breaks a promise.
    """
    if isinstance(rollout, DeviceRollout):
        env, params = rollout.env, rollout.env_params
        check_forms(env, params)
        if not is_installed(task) and type(env) not in _SOUND:
            check_played(env, params, has_fixed_start=True)
            _SOUND.add(type(env))
    elif task.host is not None and not is_installed(task) and task.host.make_pool not in _SOUND:
        check_pool(task.host, task.environment)
        _SOUND.add(task.host.make_pool)
    own = rollout.method
    if ":" in method and type(own) not in _SOUND:
        spec, observation = task.action_spec, rollout.observation
        check_method(own, observation=observation, action_spec=spec, table=table)
        _SOUND.add(type(own))
