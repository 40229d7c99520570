"""Training of a policy on a representation table (paper algorithm 1), and going on with one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxnew import loop
from jaxnew.actions import ActionSplit, check_same
from jaxnew.checks.run import check_run
from jaxnew.embedding import SPLIT_FILE, TABLE_FILE, find_table, is_learned
from jaxnew.ppo import TrainState
from jaxnew.representation.table import RepresentationTable
from jaxnew.run import Run, load_trainer, locate
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.config import Assignments
from jaxnew.storage.progress import say
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.budgets import StageTwoBudget, foretold
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.methods import adapted, file_name, variant_of
from jaxnew.task.places import UsageError
from jaxnew.task.settings import TrainConfig, identity, train_config_type, upgraded, with_set
from jaxnew.task.task import Task
from jaxnew.trainer import Trainer

# Method of a pretrained run -> method that is trained with the new actions.
CONTINUED = {"ours": "no-subsampling", "nearest-neighbour": "nearest-neighbour"}


def train(
    task: Task | str,
    table: RepresentationTable | str | Path,
    *,
    method: str = "ours",
    budget: str = "laptop",
    seed: int = 31,
    split: str | None = None,
    split_seed: int = 0,
    set: Assignments = (),
    representation_budget: str | None = None,
    workdir: Path | str | None = None,
    runs: Path | str = "runs",
    overwrite: bool = False,
    num_workers: int = 0,
) -> Run:
    """Trains a policy in its run directory, from where it stands to the end.

    Args:
      task: the domain, or what `load_task` takes.
      table: what the policy knows of each action; or what `find_table` takes, which trains an
        encoder if it has to.
      method: `ours`, a baseline or an ablation, see `jaxnew.task.methods.VARIANTS`, or
        `package.module:NAME` of a user's own.
      budget: a preset of the task's `stage_two`.
      seed: of the run, 0..2^32 - 1.
      split, split_seed: see `Domain.of`.
      set: fields of `TrainConfig`, see `with_set`; also `environment.FIELD` of the task's settings,
        and `pool.FIELD`, how environments on the host are run.
      representation_budget: of an encoder that has to be trained; default: `budget`.
      workdir: the run directory; default: below `runs`, named after what the run is.
      runs: where runs and what they share are kept.
      overwrite: replace an existing run instead of resuming.
      num_workers: processes for environments on the host; 0: one per core.

    Returns:
      The run with its best checkpoint, or with its latest if it was interrupted before the first
      evaluation.

    Raises:
      UsageError, ConfigError: something does not exist, or takes no such value.
      ConfigMismatch: the directory holds another run.
      SplitMismatch: the table was made for another split or universe.
      InterruptedRunError: a signal stopped the training of the encoder that it needs.
    """
    task = load_task(task) if isinstance(task, str) else task
    domain, runs = Domain.of(task, split, split_seed), Path(runs)
    variant_of(method)  # Before a representation is trained for it.
    name, found = named_table(domain, runs, table, budget, representation_budget)
    preset = task.budget(budget)
    config = with_set(train_config(domain, method, name, found, preset, seed), set)
    title = f"{file_name(method)}-{Path(name).name.removesuffix('.npz').replace(':', '-')}"
    path = domain.folder(runs) / f"{title}-{domain.split_label}-{budget}-{seed}"
    path = Path(workdir) if workdir else path
    with Trainer.of(config, task, domain.split, found, num_workers) as trainer:
        check_run(task, trainer.rollout, config.method, np.asarray(trainer.training.table))
        with open_run(path, trainer, overwrite) as directory:
            cost = foretold(preset, config)
            say(f"Training {title}: {config.num_updates} updates ({cost}) in {path}.")
            result = run_updates(trainer, trainer.init(), directory, title, is_evaluated=True)
    if result.best_metric is not None:
        say(
            f"{path}: update {result.step} of {config.num_updates}; best "
            f"{trainer.selection_metric} {result.best_metric:.3f} at update {result.best_step}."
        )
    run = Run.of(path, trainer, "latest" if result.best_metric is None else "best")
    return replace(run, interrupted_by=result.interrupted_by)


def finetune(
    source: Run | Path | str,
    *,
    is_scratch: bool = False,
    budget: str = "laptop",
    seed: int = 31,
    set: Assignments = (),
    workdir: Path | str | None = None,
    overwrite: bool = False,
    num_workers: int = 0,
) -> Run:
    """Goes on learning with the test actions as one fixed set, or learns them from scratch.

    From a utility policy everything is kept; from a discrete policy all but its categorical heads:
    that of the actions, which has one logit per action, and that of the stop bit. The running
    statistics of observations are kept and frozen, and the learning rate starts anew
    (`docs/method.md`, "Fine-tuning").

    Args:
      source: a run of `train` with the method `ours` or `nearest-neighbour`, or a checkpoint of one
        (`Run.load`).
      is_scratch: nothing is kept.
      budget, seed, set, overwrite, num_workers: as of `train`.
      workdir: the run directory; default: in that of `source`.

    Raises:
      UsageError: the source's method has no such continuation, or there is no such budget.
    """
    if not isinstance(source, Run):
        found = locate(source)
        trainer = load_trainer(RunDirectory.load(found.path), num_workers)
        _check_continues(trainer.config)  # Runs that cannot go on may have no best checkpoint.
        source = Run.of(found.path, trainer, found.kind or "best", found.step)
    config = with_set(finetune_config(source, budget, is_scratch, seed), set)
    table = source.trainer.table
    title = f"finetune-{'scratch' if is_scratch else 'warm'}-{budget}-{config.seed}"
    path = Path(workdir) if workdir else source.path / title
    with Trainer.of(config, source.task, source.split, table, num_workers) as trainer:
        state = trainer.init()
        if not is_scratch:
            state = _warm_start(state, source, trainer)
        with open_run(path, trainer, overwrite) as directory:
            say(f"{title}: {config.num_updates} updates with test actions in {path}.")
            result = run_updates(trainer, state, directory, title, is_evaluated=False)
    run = Run.of(path, trainer, "latest")
    return replace(run, interrupted_by=result.interrupted_by)


def named_table(
    domain: Domain,
    runs: Path,
    table: RepresentationTable | str | Path,
    budget: str,
    own_budget: str | None,
) -> tuple[str, RepresentationTable]:
    """What a run calls its representation, and the table, made now if it has to be.

    Raises:
      UsageError: it has a budget of its own, and nothing is trained for it.
    """
    if own_budget and (isinstance(table, RepresentationTable) or not is_learned(str(table))):
        raise UsageError(
            f"representation_budget={own_budget}: nothing is trained for the representation that "
            "was given; leave it out."
        )
    if isinstance(table, RepresentationTable):
        table.check(domain.universe, domain.split)
        name = table.source.partition(",")[0].removeprefix("engineered:")
        return name.replace(":", "-").strip(), table
    return str(table), find_table(domain, runs, str(table), own_budget or budget)


def train_config(
    domain: Domain,
    method: str,
    representation: str,
    table: RepresentationTable,
    budget: StageTwoBudget,
    seed: int,
) -> TrainConfig:
    """The config of a run of a preset, before anything is set."""
    task = domain.task
    budget = adapted(budget, method, task, domain.split)
    return train_config_type(task)(
        task=task.reference,
        method=method,
        representation=representation,
        table_hash=table.hash,
        split=domain.split_name,
        split_seed=domain.split_seed,
        split_hash=domain.split.hash,
        seed=seed,
        num_updates=budget.num_updates,
        ppo=budget.ppo,
        sets=budget.sets,
        hyperparameters=budget.hyperparameters,
        loop=budget.loop,
        network=budget.network,
        environment_version=task.environment_version,
        environment=task.environment,
        pool=None if task.host is None else task.host.pool_settings,
    )


def open_run(path: Path, trainer: Trainer, overwrite: bool = False) -> RunDirectory:
    """The directory of a run, open for writing, with split and table: it needs nothing else."""
    table, split = trainer.table, trainer.split
    directory = RunDirectory.open_or_create(
        path,
        identity(trainer.config),
        overwrite,
        {"split_hash": split.hash, "table_hash": table.hash, "table": table.source},
        upgrade=upgraded,
    )
    split_file, table_file = directory.path / SPLIT_FILE, directory.path / TABLE_FILE
    if table_file.exists():
        check_same("split", ActionSplit.load(split_file).hash, split.hash, path)
        check_same("table", RepresentationTable.load(table_file).hash, table.hash, path)
    else:
        split.save(split_file)
        table.save(table_file)
    return directory


def run_updates(
    trainer: Trainer,
    state: TrainState,
    directory: RunDirectory,
    title: str,
    is_evaluated: bool,
) -> loop.LoopResult[TrainState]:
    """Trains from where the directory stands to the end."""
    config, metric = trainer.config, trainer.task.selection_metric
    rhythm = loop.Rhythm(
        total_steps=config.num_updates,
        chunk_steps=config.loop.chunk_updates,
        checkpoint_every=config.loop.checkpoint_every,
        evaluate_every=config.loop.evaluate_every if is_evaluated else None,
    )
    display = loop.Display(
        title,
        work_per_step=config.ppo.steps_per_update,
        metrics=(f"episode/{metric}", "policy/entropy"),
    )
    return loop.run(
        state,
        trainer.chunk,
        directory,
        rhythm,
        display,
        evaluate=trainer.evaluate if is_evaluated else None,
        selection_metric=trainer.selection_metric if is_evaluated else None,
    )


def finetune_config(source: Run, budget_name: str, is_scratch: bool, seed: int) -> TrainConfig:
    """The config of a run that goes on from `source`; see `finetune`."""
    old, task = source.config, source.task
    _check_continues(old)
    method = CONTINUED[old.method]
    budget = adapted(task.budget(budget_name), method, task, source.split)
    rollout = replace(budget.ppo.rollout, freezes_observation_statistics=not is_scratch)
    return replace(
        old,
        method=method,
        seed=seed,
        num_updates=max(1, round(budget.num_updates * task.baselines.finetune_share)),
        ppo=replace(budget.ppo, rollout=rollout),
        sets=budget.sets,
        hyperparameters=budget.hyperparameters,
        loop=budget.loop,
        trained_on="test",
        start="fresh parameters" if is_scratch else _start(source),
    )


def _start(source: Run) -> str:
    """What a run goes on from: the best checkpoint, unless another is named."""
    words = f"{source.config.method}, seed {source.config.seed}"
    newest = Checkpointer(source.path / "checkpoints").steps("best")[-1:]
    is_best = source.checkpoint == "best" and source.step in newest
    return words if is_best else f"{words}, {source.checkpoint} checkpoint of update {source.step}"


def _check_continues(config: TrainConfig) -> None:
    if config.method not in CONTINUED or config.trained_on != "train":
        raise UsageError(
            f"A run of --method={config.method} on {config.trained_on} actions cannot be "
            f"fine-tuned; give one of --method={' or '.join(CONTINUED)}."
        )


def _warm_start(state: TrainState, source: Run, trainer: Trainer) -> TrainState:
    """A fresh state with the parameters and the observation statistics of a trained policy."""
    params: dict[str, Any] = jax.tree.map(lambda x: x, source.policy.params)
    if "logits" in params.get("policy", {}):
        params["policy"]["logits"] = state.params["policy"]["logits"]
        heads: Mapping[str, Any] = params.get("auxiliary", {}).get("heads", {})
        if "stop" in heads:
            params["auxiliary"]["heads"]["stop"] = state.params["auxiliary"]["heads"]["stop"]
    state = replace(state, params=params)
    statistics = source.policy.observation_statistics
    return trainer.learner.restarted(state, trainer.training, statistics)
