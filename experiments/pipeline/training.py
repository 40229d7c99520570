"""What `train`, `evaluate`, `sweep` and `demo` share: a policy's config, its parts, its run."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.pipeline.artifacts import SPLIT_FILE, TABLE_FILE, Domain
from experiments.pipeline.flags import budget_of, load_task
from experiments.pipeline.machinery import (
    DeviceMachinery,
    HostMachinery,
    environment_settings,
    in_group,
    machinery_of,
    with_environment_settings,
    with_pool_settings,
)
from experiments.pipeline.methods import adapted, file_name, method_of, trained_ids
from jaxnew import config as config_lib
from jaxnew import loop
from jaxnew.actions import ActionSplit
from jaxnew.checkpoint import Checkpointer, Kind
from jaxnew.ppo import Hyperparameters, PPOConfig, TrainState
from jaxnew.representation.clusters import balanced_clusters
from jaxnew.representation.table import RepresentationTable
from jaxnew.run_directory import RunDirectory
from jaxnew.sampling import ActionPool, check_set_size
from jaxnew.task import LoopConfig, StageTwoBudget, Task

EVALUATION_SEED = 2020  # Shared by all runs, so that they are evaluated on the same episodes.
SPLITS_WATCHED = ("train", "validation")


@dataclass(frozen=True)
class TrainConfig:
    """All that fixes a policy's run.

    Attributes:
      trained_on: part of the split whose actions it is trained with.
      start: what `finetune` begins with, or "fresh parameters".
      num_clusters: training sets are drawn from half of so many clusters of the representations
        (spec method 2.2); 0 for the paper's runs, which draw from all actions.
      conditions_position: the position's head reads the chosen action (spec method 5.5).
      environment: `environment.FIELD=value` of the task's `environment_settings`, where set.
    """

    task: str
    method: str
    representation: str
    table_hash: str
    split: str
    split_hash: str
    seed: int
    num_updates: int
    ppo: PPOConfig
    hyperparameters: Hyperparameters
    loop: LoopConfig
    trained_on: str = "train"
    start: str = "fresh parameters"
    num_clusters: int = 0
    conditions_position: bool = False
    environment: tuple[str, ...] = ()

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> TrainConfig:
        """The config of a run directory; fields that it is too old for are as they were then."""
        absent = {"num_clusters": 0, "conditions_position": False, "environment": []}
        return config_lib.from_dict(cls, {**absent, **plain})

    def with_set(self, assignments: Sequence[str]) -> TrainConfig:
        """A copy with every `path.to.field=value` applied; one of the environment is kept as text.

        Raises:
          ConfigError: see `config.set_paths`.
        """
        environment, others = in_group(assignments, "environment")
        changed = config_lib.set_paths(self, others)
        return replace(changed, environment=environment_settings([*self.environment, *environment]))

    @classmethod
    def of(
        cls,
        domain: Domain,
        method: str,
        representation: str,
        table: RepresentationTable,
        budget: StageTwoBudget,
        seed: int,
    ) -> TrainConfig:
        budget = adapted(budget, method, domain.task, domain.split)
        return cls(
            task=domain.task.reference,
            method=method,
            representation=representation,
            table_hash=table.hash,
            split=domain.split_name,
            split_hash=domain.split.hash,
            seed=seed,
            num_updates=budget.num_updates,
            ppo=budget.ppo,
            hyperparameters=budget.hyperparameters,
            loop=budget.loop,
        )


@dataclass(frozen=True)
class Trainer:
    """The compiled parts of a run. Close it at the end.

    Attributes:
      machinery: what trains, inside jit or with environments on the host.
      learner: its learner.
      pools: actions that evaluations draw sets from, by split.
      watched_pools: the same for the evaluations during training; those of the validation actions
        in the groups of `Task.validation_groups`.
      training_pool: actions that training draws sets from, or the fixed set.
      evaluator: an `Evaluator` or `HostEvaluator` with sets as large as in training, for the
        evaluation after it.
      watcher: with sets as large as `LoopConfig` says, for the evaluations during training.
    """

    config: TrainConfig
    task: Task
    machinery: DeviceMachinery | HostMachinery
    learner: Any
    evaluator: Any
    watcher: Any
    table: jax.Array
    pools: dict[str, ActionPool]
    watched_pools: dict[str, ActionPool]
    training_pool: ActionPool

    @classmethod
    def of(
        cls,
        config: TrainConfig,
        task: Task,
        split: ActionSplit,
        table: RepresentationTable,
        num_workers: int = 0,
    ) -> Trainer:
        """Builds the parts; `num_workers` processes for environments on the host, 0: one per core.

        Raises:
          ValueError: unknown method, or sets larger than the train or validation pool.
        """
        task = with_environment_settings(task, config.environment)
        action_spec = task.action_spec
        method = method_of(
            config.method,
            task,
            split,
            config.trained_on,
            action_spec=action_spec,
            conditions_position=config.conditions_position,
        )
        vectors = table.rows(np.arange(action_spec.num_actions))
        rollout_config = config.ppo.rollout
        pools = {
            name: ActionPool.of(
                split.ids(name), capacity=len(vectors), always_available=split.always_available
            )
            for name in ("train", "validation", "test")
        }
        watched_pools = {name: pools[name] for name in SPLITS_WATCHED}
        if config.split in task.validation_groups:
            labels = task.validation_groups[config.split](task.make_universe())
            ids = split.ids("validation")
            watched_pools["validation"] = ActionPool.of(
                ids,
                capacity=len(vectors),
                always_available=split.always_available,
                groups=np.asarray(labels)[ids],
            )
        training_pool = pools["train"]
        if config.num_clusters:
            ids = split.ids(config.trained_on)
            training_pool = ActionPool.of(
                ids,
                capacity=len(vectors),
                always_available=split.always_available,
                groups=balanced_clusters(table.rows(ids), config.num_clusters),
            )
        if rollout_config.has_fixed_set:
            fixed = trained_ids(config.method, task, split, config.trained_on)
            training_pool = ActionPool.of(
                fixed, capacity=len(fixed), always_available=split.always_available
            )
        watched_size = config.loop.evaluation_set_size or rollout_config.set_size
        check_set_size(pools["train"], rollout_config.set_size, "the train actions")
        if not rollout_config.has_fixed_set:
            check_set_size(training_pool, rollout_config.set_size, "the train actions")
        for name, pool in watched_pools.items():
            check_set_size(pool, watched_size, f"the {name} actions")
        machinery = machinery_of(task, method, config.ppo, config.seed, num_workers)
        return cls(
            config,
            task,
            machinery,
            machinery.learner,
            machinery.evaluator,
            replace(machinery.evaluator, set_size=watched_size, padded_set_size=0),
            jnp.asarray(vectors),
            pools,
            watched_pools,
            training_pool,
        )

    def init(self) -> TrainState:
        """The state before the first update."""
        return self.machinery.init(self.config.seed, self.table, self.training_pool)

    def chunk(self, state: TrainState, num_updates: int) -> tuple[TrainState, dict[str, Any]]:
        """`num_updates` updates in one call, and their metrics reduced."""
        numbers = self.config.hyperparameters
        done: tuple[TrainState, dict[str, Any]] = self.machinery.updates(
            state, numbers, self.table, self.training_pool, num_updates=num_updates
        )
        return done

    def close(self) -> None:
        """Ends the processes of environments on the host."""
        self.machinery.close()

    def evaluate(self, state: TrainState) -> dict[str, float]:
        """Mean episode metrics on train and validation sets, from fixed keys."""
        results: dict[str, float] = {}
        for name in SPLITS_WATCHED:
            evaluator, pool = self.watched(name)
            episodes = evaluator.run(
                state.params,
                state.rollout.observation_statistics,
                self.table,
                pool,
                jax.random.key(EVALUATION_SEED),
                self.config.loop.evaluation_episodes,
            )
            results |= {f"{name}/{metric}": float(v.mean()) for metric, v in episodes.items()}
        return results

    def on_split(self, name: str, evaluator: Any) -> tuple[Any, ActionPool]:
        """What evaluates a part of the split: all of the fixed set where training has one."""
        if name == self.config.trained_on and self.config.ppo.rollout.has_fixed_set:
            return self._fixed_evaluator, self.training_pool
        return evaluator, self.pools[name]

    def watched(self, name: str) -> tuple[Any, ActionPool]:
        """What evaluates a part of the split during training."""
        evaluator, pool = self.on_split(name, self.watcher)
        return evaluator, self.watched_pools[name] if pool is self.pools[name] else pool

    @cached_property
    def _fixed_evaluator(self) -> Any:
        pool = self.training_pool
        return replace(
            self.evaluator,
            set_size=int(pool.size) + len(pool.always_available),
            padded_set_size=0,
        )

    @property
    def selection_metric(self) -> str:
        return f"validation/{self.task.selection_metric}"


def train_policy(
    domain: Domain,
    runs: Path,
    table: RepresentationTable,
    representation: str,
    budget_name: str,
    *,
    method: str = "ours",
    seed: int = 31,
    assignments: list[str] | None = None,
    workdir: Path | None = None,
    overwrite: bool = False,
    num_workers: int = 0,
) -> tuple[Path, loop.LoopResult[TrainState]]:
    """Trains a policy in its run directory, from where it stands to the end.

    Returns:
      The run directory and how the run ended.
    """
    task = domain.task
    budget: StageTwoBudget = budget_of(task.stage_two, budget_name, "Stage two")
    config = TrainConfig.of(domain, method, representation, table, budget, seed)
    config = config.with_set(assignments or [])
    trainer = Trainer.of(config, task, domain.split, table, num_workers)
    name = f"{file_name(method)}-{Path(representation).name.removesuffix('.npz')}"
    path = workdir or domain.folder(runs) / f"{name}-{domain.split_name}-{budget_name}-{seed}"
    provenance = {
        "split_hash": domain.split.hash,
        "table_hash": table.hash,
        "table": table.source,
    }
    with (
        closing(trainer),
        RunDirectory.open_or_create(path, config_lib.to_dict(config), overwrite, provenance) as run,
    ):
        save_inputs(run, domain.split, table)
        print(f"Training {name}: {config.num_updates} updates ({budget.cost}) in {path}.")
        result = loop.run(
            trainer.init(),
            chunk=trainer.chunk,
            evaluate=trainer.evaluate,
            run_directory=run,
            total_steps=config.num_updates,
            chunk_steps=config.loop.chunk_updates,
            evaluate_every=config.loop.evaluate_every,
            checkpoint_every=config.loop.checkpoint_every,
            selection_metric=trainer.selection_metric,
            title=name,
            work_per_step=config.ppo.steps_per_update,
            shown_metrics=(f"episode/{task.selection_metric}", "policy/entropy"),
        )
    if result.best_metric is not None:
        print(
            f"{path}: update {result.step} of {config.num_updates}; best "
            f"{trainer.selection_metric} {result.best_metric:.3f} at update {result.best_step}."
        )
    return path, result


def save_inputs(run: RunDirectory, split: ActionSplit, table: RepresentationTable) -> None:
    """Keeps the split and the table in the run directory, so that it needs nothing else."""
    if not (run.path / TABLE_FILE).exists():
        split.save(run.path / SPLIT_FILE)
        table.save(run.path / TABLE_FILE)


def load_trainer(
    path: Path, num_workers: int = 0, pool_assignments: Sequence[str] = ()
) -> tuple[RunDirectory, Trainer, ActionSplit]:
    """A run's config and parts, from its directory alone; see `Trainer.of`.

    Args:
      path: the run directory.
      num_workers: see `Trainer.of`.
      pool_assignments: see `with_pool_settings`.

    Raises:
      RunDirectoryError: `path` is not a run of `train`.
      SplitMismatch: split or table were changed since.
    """
    run = RunDirectory.load(path)
    config = TrainConfig.from_plain(run.config)
    task = with_pool_settings(load_task(config.task), pool_assignments)
    split = ActionSplit.load(path / SPLIT_FILE)
    split.check(task.make_universe())
    table = RepresentationTable.load(path / TABLE_FILE)
    table.check(task.make_universe(), split)
    return run, Trainer.of(config, task, split, table, num_workers), split


def load_state(run: RunDirectory, trainer: Trainer, kind: Kind) -> tuple[TrainState, int]:
    """A checkpointed state and the update it was saved at.

    Of a domain on the host without its environments: it is there to be evaluated.
    """
    machinery = trainer.machinery
    example = machinery.example(trainer.table, trainer.training_pool)
    checkpointer = Checkpointer(run.checkpoints)
    state, _ = checkpointer.restore(kind, example, is_part=not machinery.restores_whole_state)
    return state, int(state.step)
