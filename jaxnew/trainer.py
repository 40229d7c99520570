"""The parts of a policy's run, put together from its config."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import numpy as np

from jaxnew.actions import ActionSplit
from jaxnew.evaluation import measure
from jaxnew.policy import PolicyMethod
from jaxnew.ppo import Learner, PPOConfig, TrainState
from jaxnew.representation.clusters import balanced_clusters
from jaxnew.representation.table import RepresentationTable
from jaxnew.rollout.contract import Rollout
from jaxnew.rollout.device import DeviceRollout
from jaxnew.rollout.host import HostRollout
from jaxnew.sampling import Actions
from jaxnew.task.methods import learned_ids, method_of, trained_ids
from jaxnew.task.settings import TrainConfig, with_settings
from jaxnew.task.task import Task

SPLITS_WATCHED = ("train", "validation")


@dataclass(frozen=True)
class Trainer:
    """The compiled parts of a run. A context manager: close it at the end.

    Attributes:
      config: all that fixes the run.
      task: with the settings of the run.
      split: its parts are trained with and evaluated on.
      table: what the policy knows of every action.
      learner: what trains, and its rollout, which plays episodes.
      training: what is trained with.
      watched: what is evaluated during training, by part of the split; of the validation actions in
        the groups of `Task.validation_groups`.
    """

    config: TrainConfig
    task: Task
    split: ActionSplit
    table: RepresentationTable
    learner: Learner
    training: Actions
    watched: Mapping[str, Actions]
    num_workers: int = 0

    @classmethod
    def of(
        cls,
        config: TrainConfig,
        task: Task,
        split: ActionSplit,
        table: RepresentationTable,
        num_workers: int = 0,
    ) -> Trainer:
        """Builds the parts.

        Raises:
          ValueError: unknown method, or sets larger than the train or validation pool.
        """
        task = with_settings(task, config)
        method = policy_of(config, task, split, split, table)
        rollout = rollout_of(task, method, config.ppo, config.seed, num_workers)
        vectors = jax.numpy.asarray(table.rows(np.arange(len(table.ids))))
        always = split.always_available
        sets = config.sets
        if sets.is_fixed:
            ids = trained_ids(config.method, task, split, config.trained_on)
            training = Actions.of(vectors, ids, always_available=always)
        else:
            ids = split.ids(config.trained_on)
            training = Actions.of(
                vectors,
                ids,
                sets.training_size or sets.size,
                padded_size=sets.padded_size,
                always_available=always,
                groups=balanced_clusters(table.rows(ids), config.num_clusters)
                if config.num_clusters
                else None,
                name="the train actions",
            )
        watched = {}
        for part in SPLITS_WATCHED:
            if sets.is_fixed and part == config.trained_on:
                watched[part] = _drawn(training)
                continue
            groups = None
            if part == "validation" and config.split in task.validation_groups:
                labels = np.asarray(task.validation_groups[config.split](task.make_universe()))
                groups = labels[split.ids(part)]
            watched[part] = Actions.of(
                vectors,
                split.ids(part),
                config.loop.evaluation_set_size or sets.size,
                always_available=always,
                groups=groups,
                name=f"the {part} actions",
            )
        learner = Learner(rollout, config.ppo)
        return cls(config, task, split, table, learner, training, watched, num_workers)

    @property
    def rollout(self) -> Rollout:
        """Environments and the policy that acts in them."""
        return self.learner.rollout

    @property
    def selection_metric(self) -> str:
        """What the best checkpoint is chosen by."""
        return f"validation/{self.task.selection_metric}"

    def actions(
        self,
        name: str,
        ids: np.ndarray | None = None,
        set_size: int | None = None,
        vectors: jax.Array | None = None,
    ) -> Actions:
        """Sets as evaluations after training draw them.

        Args:
          name: part of the split, or of the ids.
          ids: int32[n] in place of the part's.
          set_size: None for the run's `sets.size`: all of them on the part that a method with one
            fixed set was trained with.
          vectors: f32[A, d] in place of the run's own table.

        Raises:
          ValueError: there is no such part, or there are no such sets.
        """
        sets, is_part = self.config.sets, ids is None
        if set_size is None and is_part and sets.is_fixed and name == self.config.trained_on:
            found = _drawn(self.training)
            return found if vectors is None else replace(found, table=vectors)
        return Actions.of(
            self.training.table if vectors is None else vectors,
            self.split.ids(name) if ids is None else ids,
            set_size or sets.size,
            padded_size=0 if set_size else sets.padded_size,
            always_available=self.split.always_available,
            name=f"the {name} actions",
        )

    def init(self) -> TrainState:
        """The state before the first update; starts environments on the host."""
        return self.learner.compiled_init(jax.random.key(self.config.seed), self.training)

    def chunk(self, state: TrainState, num_updates: int) -> tuple[TrainState, dict[str, Any]]:
        """`num_updates` updates in one call, and their metrics reduced."""
        return self.learner.compiled_updates(
            state, self.config.hyperparameters, self.training, num_updates=num_updates
        )

    def evaluate(self, state: TrainState) -> dict[str, float]:
        """Mean episode metrics on train and validation sets, from fixed keys."""
        results: dict[str, float] = {}
        for part, actions in self.watched.items():
            episodes = measure(
                self.rollout, state.policy, actions, self.config.loop.evaluation_episodes
            )
            results |= {f"{part}/{metric}": float(v.mean()) for metric, v in episodes.items()}
        return results

    def close(self) -> None:
        """Ends the processes of environments on the host."""
        self.rollout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _drawn(training: Actions) -> Actions:
    """All actions of a fixed set, in an order drawn for each episode."""
    return replace(training, is_fixed=False, padded_size=training.set_size)


def policy_of(
    config: TrainConfig,
    task: Task,
    acting: ActionSplit,
    split: ActionSplit,
    table: RepresentationTable,
) -> PolicyMethod:
    """The policy of a run, before it has parameters.

    Args:
      acting: the run's split, by the ids that its actions have where the policy acts.
      split, table: the run's own.
    """
    learned = learned_ids(config.method, task, split, config.trained_on)
    return method_of(
        config.method,
        task,
        acting,
        config.trained_on,
        action_spec=task.action_spec,
        conditions_position=config.conditions_position,
        network=config.network,
        representations=table.rows(learned),
    )


def rollout_of(
    task: Task, method: PolicyMethod, config: PPOConfig, seed: int, num_workers: int = 0
) -> Rollout:
    """The rollout that a task needs.

    Args:
      seed: of environments on the host.
      num_workers: processes for them; 0 for one per core.
    """
    task.check_workers(num_workers)
    if task.host is not None:
        environments = task.host.environments(
            config.rollout.num_envs, seed, num_workers, task.environment
        )
        return HostRollout(environments, method, config.rollout, task.host.policy_observation)
    env = task.environment_of()
    width = task.evaluation_width
    if jax.default_backend() != "cpu":
        # Many episodes take an accelerator as long as few.
        width = max(width, config.rollout.num_envs)
    return DeviceRollout(env, env.default_params, method, config.rollout, width)
