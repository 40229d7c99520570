"""What trains and evaluates a policy: inside jit, or with environments on the host."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp

from experiments.pipeline.flags import UsageError
from jaxnew import config as config_lib
from jaxnew.evaluation import Evaluator
from jaxnew.host_evaluation import HostEvaluator
from jaxnew.policy import PolicyMethod
from jaxnew.ppo import Learner, PPOConfig, TrainState
from jaxnew.ppo.host import HostLearner
from jaxnew.rollout.device import DeviceRollout
from jaxnew.rollout.host import HostRollout, HostRolloutState
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import ActionPool
from jaxnew.task import HostDomain, Task

# Folded into the key of a run where updates fold in their number, which is never as high.
_RESTART = 2**31 - 1


@dataclass(frozen=True)
class DeviceMachinery:
    """Rollout and update in one compiled function."""

    learner: Learner
    evaluator: Evaluator
    restores_whole_state = True

    def init(self, seed: int, table: jax.Array, pool: ActionPool) -> TrainState:
        """The state before the first update."""
        return jax.jit(self.learner.init)(jax.random.key(seed), table, pool)

    @cached_property
    def updates(self) -> Any:
        """`Learner.updates`, compiled."""
        return jax.jit(self.learner.updates, static_argnames="num_updates")

    def restarted(
        self, state: TrainState, pool: ActionPool, statistics: RunningStatistics
    ) -> TrainState:
        """`state` with fresh environments that go on with observation statistics of another run."""
        key = jax.random.fold_in(state.key, _RESTART)
        rollout = jax.jit(self.learner.rollout.init)(key, pool, statistics)
        return replace(state, rollout=rollout)

    def example(self, table: jax.Array, pool: ActionPool) -> TrainState:
        """The shapes of a state."""
        shapes: TrainState = jax.eval_shape(self.learner.init, jax.random.key(0), table, pool)
        return shapes

    def close(self) -> None:
        """Nothing is held."""


@dataclass(frozen=True)
class HostMachinery:
    """A pool on the host and a compiled update; one pool for training and for evaluations."""

    learner: HostLearner
    evaluator: HostEvaluator
    host: HostDomain
    # Whoever only evaluates does not need the environments of training.
    restores_whole_state = False

    def init(self, seed: int, table: jax.Array, pool: ActionPool) -> TrainState:
        """The state before the first update; starts the pool."""
        return self.learner.init(jax.random.key(seed), table, pool)

    @property
    def updates(self) -> Any:
        """`HostLearner.updates`."""
        return self.learner.updates

    def restarted(self, state: TrainState, pool: ActionPool, statistics: None) -> TrainState:
        """`state` itself: there are no statistics, and its environments are fresh."""
        del pool, statistics
        return state

    def example(self, table: jax.Array, pool: ActionPool) -> TrainState:
        """The shapes of what a policy needs to act, without environments."""
        del pool
        seen = self.host.policy_observation

        def init(key: jax.Array) -> TrainState:
            key_run, key_params = jax.random.split(key)
            none: Any = None
            rollout = HostRolloutState(none, none, none, none)
            observation = jnp.zeros(seen.shape, seen.dtype)
            size = table.shape[-1]
            return self.learner.init_state(key_run, key_params, observation, size, rollout)

        shapes: TrainState = jax.eval_shape(init, jax.random.key(0))
        return shapes

    def close(self) -> None:
        """Ends the pool."""
        self.learner.rollout.environments.close()


def machinery_of(
    task: Task, method: PolicyMethod, config: PPOConfig, seed: int, num_workers: int
) -> DeviceMachinery | HostMachinery:
    """What a task needs.

    Args:
      seed: of environments on the host.
      num_workers: processes for them; 0 for one per core.
    """
    rollout, sizes = config.rollout, (config.rollout.set_size, config.rollout.padded_set_size)
    if task.host is None:
        env = task.make_environment()
        params = env.default_params
        normalizes = rollout.normalize_observations
        width = task.evaluation_width
        if jax.default_backend() != "cpu":
            # Many episodes take an accelerator as long as few.
            width = max(width, rollout.num_envs)
        evaluator = Evaluator(env, params, method, *sizes, normalizes, width=width)
        return DeviceMachinery(
            Learner(DeviceRollout(env, params, method, rollout), config), evaluator
        )
    environments = task.host.environments(rollout.num_envs, seed, num_workers)
    learner = HostLearner(HostRollout(environments, method, rollout), config)
    return HostMachinery(learner, HostEvaluator(environments, method, *sizes), task.host)


def in_group(assignments: Sequence[str], name: str) -> tuple[list[str], list[str]]:
    """Those of the form `name.FIELD=value`, and the others."""
    groups = [a.partition("=")[0].strip().split(".")[0] for a in assignments]
    mine = [a for a, group in zip(assignments, groups, strict=True) if group == name]
    return mine, [a for a, group in zip(assignments, groups, strict=True) if group != name]


def pool_assignments(assignments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Those of the form `pool.FIELD=value`, which say how a run is computed, and the others.

    The others say what a run is and belong to its config.
    """
    return in_group(assignments, "pool")


def environment_settings(assignments: Sequence[str]) -> tuple[str, ...]:
    """Those of the form `environment.FIELD=value` as configs keep them; of a field, the last."""
    mine, _ = in_group(assignments, "environment")
    settings = [text.partition("=") for text in mine]
    by_path = {path.strip(): equals + value.strip() for path, equals, value in settings}
    return tuple(sorted(map("".join, by_path.items())))


def with_pool_settings(task: Task, assignments: Sequence[str]) -> Task:
    """A task whose pool is run as `pool.FIELD=value` says.

    Raises:
      UsageError: an assignment is not of that form, or the task has no pool that could be told.
      ConfigError: there is no such field, or it takes no such value.
    """
    mine, others = pool_assignments(assignments)
    if others:
        raise UsageError(f"{others[0]}: the run is there; only --set=pool.FIELD=value can be set.")
    if not mine:
        return task
    settings = None if task.host is None else task.host.pool_settings
    if task.host is None or settings is None:
        kind = "has environments inside jit" if task.host is None else "has a pool without settings"
        raise UsageError(f"{mine[0]}: task {task.name} {kind}; leave out --set=pool.*.")
    changed = _changed(settings, "pool", mine)
    return replace(task, host=replace(task.host, pool_settings=changed))


def with_environment_settings(task: Task, assignments: Sequence[str]) -> Task:
    """A task whose environment is made as `environment.FIELD=value` says.

    Raises:
      UsageError: the environment has nothing to set.
      ConfigError: there is no such field, or it takes no such value.
    """
    if not assignments:
        return task
    if task.environment_settings is None:
        raise UsageError(
            f"{assignments[0]}: the environment of task {task.name} has nothing to set; leave out "
            "--set=environment.*."
        )
    changed = _changed(task.environment_settings, "environment", assignments)
    fields = {field.name: getattr(changed, field.name) for field in dataclasses.fields(changed)}
    make = partial(task.make_environment, **fields)
    return replace(task, make_environment=make, environment_settings=changed)


def _changed(settings: Any, name: str, assignments: Sequence[str]) -> Any:
    """Settings, a dataclass, with `name.FIELD=value` applied."""
    tree = dataclasses.make_dataclass("Settings", [(name, type(settings))], frozen=True)
    return getattr(config_lib.set_paths(tree(settings), list(assignments)), name)
