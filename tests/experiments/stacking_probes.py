"""What tests watch in the processes that run Shape Stacking's commands; see `several`.

Also what makes them fast enough for tests: evaluations play no more episodes than are asked for,
and jobs whose programs are equal share them. JAX keeps no program that calls the host on disk, and
each of them takes seconds to compile.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from envs_mjx.shape_stacking import scene
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from jaxnew import trainer
from jaxnew.ppo import Learner
from jaxnew.rollout.device import DeviceRollout
from jaxnew.trainer import rollout_of

EPISODES = 4

_settle = MujocoC.settle_host
_placed: set[int] = set()
_batches: set[tuple[int, ...]] = set()
_rollouts: dict[Any, Any] = {}
_learners: dict[Any, Any] = {}


class Seen(NamedTuple):
    """What the engine was asked for.

    Attributes:
      placed: shapes other than start cylinders.
      batches: shapes of the batches of worlds.
    """

    placed: set[int]
    batches: set[tuple[int, ...]]


@contextlib.contextmanager
def watched(job: list[str]) -> Iterator[None]:
    """Prints, after the job, what the engine was asked for; see `seen`."""
    del job
    _placed.clear()
    _batches.clear()
    with (
        mock.patch.object(MujocoC, "settle_host", _noting),
        mock.patch.object(trainer, "rollout_of", _shared),
        mock.patch.object(trainer, "Learner", _shared_learner),
    ):
        yield
    found = {"placed": sorted(_placed), "batches": sorted(_batches)}
    print(f"engine: {json.dumps(found)}")


@contextlib.contextmanager
def watched_on_one_core(job: list[str]) -> Iterator[None]:
    """`watched`, where a process may use one core: a sweep has one device then."""
    with mock.patch.object(os, "sched_getaffinity", return_value={0}), watched(job):
        yield


def seen(output: str) -> Seen:
    """What `watched` printed after a job."""
    (found,) = re.findall(r"^engine: (\{.*\})$", output, re.MULTILINE)
    plain = json.loads(found)
    return Seen(set(plain["placed"]), {tuple(batch) for batch in plain["batches"]})


def _noting(engine: MujocoC, shape_ids: Any, qpos: Any, qvel: Any) -> Any:
    ids = np.asarray(shape_ids)
    placed = ids[..., scene.NUM_START_CYLINDERS :]
    _placed.update(placed[placed >= 0].tolist())
    _batches.add(ids.shape[:-1])
    return _settle(engine, shape_ids, qpos, qvel)


def _shared(task: Any, method: Any, config: Any, *others: Any) -> DeviceRollout:
    """`rollout_of`, which gives the same to jobs that differ in numbers only."""
    task = replace(task, evaluation_width=EPISODES)
    if method.name != "ours":
        return rollout_of(task, method, config, *others)
    key = (task.name, method._is_conditioned, config)
    if key not in _rollouts:
        _rollouts[key] = rollout_of(task, method, config, *others)
    return _rollouts[key]


def _shared_learner(rollout: DeviceRollout, config: Any) -> Learner:
    """`Learner`, one for each rollout and config, with its compiled programs."""
    # The rollouts are kept, so that their ids stay theirs.
    return _learners.setdefault((id(rollout), config), Learner(rollout, config))
