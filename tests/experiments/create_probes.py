"""What tests watch and do in the processes that run CREATE's commands; see `several`.

Also what makes them fast enough for tests: jobs whose programs are equal share them.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np

from envs_host.pool import HostPool
from jaxnew import trainer
from jaxnew.ppo import Learner
from jaxnew.rollout.host import HostRollout
from jaxnew.trainer import rollout_of

FATAL = {"in-evaluation": 30, "in-update": 12}
_COMPILED = ("act", "value", "project", "draw_next")
_rollouts: dict[Any, HostRollout] = {}
_learners: dict[Any, Learner] = {}


@contextlib.contextmanager
def sharing() -> Iterator[None]:
    """Runs of `ours` with equal configs share their compiled functions, and nothing else."""
    with (
        mock.patch.object(trainer, "rollout_of", _with_shared_functions),
        mock.patch.object(trainer, "Learner", _learner_with_shared_functions),
    ):
        yield


def _with_shared_functions(task: Any, method: Any, config: Any, *others: Any) -> Any:
    rollout: Any = rollout_of(task, method, config, *others)
    if method.name == "ours":
        first: Any = _rollouts.setdefault(_kind_of(method, config), rollout)
        rollout.__dict__.update({name: getattr(first, name) for name in _COMPILED})
        for name in ("_act", "_project"):
            setattr(rollout._player, name, getattr(first._player, name))
    return rollout


def _learner_with_shared_functions(rollout: Any, config: Any) -> Learner:
    learner: Any = Learner(rollout, config)
    if rollout.method.name == "ours":
        first = _learners.setdefault(_kind_of(rollout.method, config), learner)
        learner.__dict__["_compiled_learn"] = first._compiled_learn
    return learner


def _kind_of(method: Any, config: Any) -> Any:
    """What compiled functions depend on, beside shapes."""
    return method._is_conditioned, config


@contextlib.contextmanager
def acted_ids(job: list[str]) -> Iterator[None]:
    """Prints, after the job, the ids that environments were told, and what their pools were like.

    See `acted`. Of the pools: how many restarts they allowed, and how many the job left open.
    """
    del job
    ids: set[int] = set()
    pools: set[HostPool] = set()
    send = HostPool.send

    def noting(pool: HostPool, half: int, chosen: Any, positions: Any = None) -> None:
        ids.update(np.asarray(chosen).tolist())
        pools.add(pool)
        send(pool, half, chosen, positions)

    with mock.patch.object(HostPool, "send", noting), sharing():
        yield
    restarts = {pool._workers._max_restarts for pool in pools}
    left_open = sum(not pool._workers.why_closed for pool in pools)
    print(f"acted: {json.dumps(sorted(ids))}\nrestarts: {sorted(restarts)}, open: {left_open}")


def acted(output: str) -> set[int]:
    """The ids that `acted_ids` printed, after a job that left nothing open."""
    assert output.endswith(", open: 0\n"), output
    (found,) = re.findall(r"^acted: (\[.*\])$", output, re.MULTILINE)
    return set(json.loads(found))


@contextlib.contextmanager
def killing(job: list[str]) -> Iterator[None]:
    """Kills the second of two workers in runs whose path says so.

    `in-evaluation`: at the 30th decision of a half, which of a smoke run's training is past the
    first update. `in-update`: at the 12th of 24 in the second update, when the pool is back from an
    evaluation or from a checkpoint.
    """
    path = " ".join(job)
    since = {"in-evaluation": 0}
    fatal = {name: at for name, at in FATAL.items() if name in path}
    send, load_state = HostPool.send, HostPool.load_state

    def counting(pool: HostPool, half: int, *action: Any) -> None:
        for name in since:
            since[name] += 1
            if since[name] == fatal.get(name):
                os.kill(pool.worker_pids[1], signal.SIGKILL)
                print(f"killed {name}")
        send(pool, half, *action)

    def noting(pool: HostPool, state: Any) -> Any:
        since.setdefault("in-update", 0)
        return load_state(pool, state)

    with (
        mock.patch.object(HostPool, "send", counting),
        mock.patch.object(HostPool, "load_state", noting),
        sharing(),
    ):
        yield
