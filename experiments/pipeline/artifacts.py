"""What stages hand to each other: recordings, encoders, tables. Made on demand, said beforehand."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.pipeline.flags import UsageError, budget_of
from experiments.pipeline.recordings import Recordings, collect
from jaxnew import config as config_lib
from jaxnew import loop
from jaxnew.actions import ActionSplit, ActionUniverse
from jaxnew.checkpoint import Checkpointer
from jaxnew.representation import report
from jaxnew.representation.learner import (
    Modality,
    RepresentationConfig,
    RepresentationLearner,
    RepresentationState,
)
from jaxnew.representation.sources import RecordingSource
from jaxnew.representation.table import RepresentationTable, engineered_table, random_table
from jaxnew.run_directory import RunDirectory
from jaxnew.task import Play, StageOneBudget, Task

# One encoder is shared by all policy seeds, as in the paper (spec method 1); so are the recordings.
REPRESENTATION_SEED = 31
TABLE_FILE = "table.npz"
SPLIT_FILE = "split.json"
_ORACLE = "-oracle"


@dataclass(frozen=True)
class Domain:
    """A task with its universe and one of its splits."""

    task: Task
    universe: ActionUniverse
    split_name: str
    split: ActionSplit

    @classmethod
    def of(cls, task: Task, split_name: str | None) -> Domain:
        universe = task.make_universe()
        name = split_name or task.default_split
        return cls(task, universe, name, task.make_split(name, universe))

    def folder(self, runs: Path) -> Path:
        """Where this task's runs are kept."""
        return runs / self.task.name

    def actions_folder(self, runs: Path) -> Path:
        """Where recordings and encoders are kept, which tasks with the same actions share."""
        return runs / (self.task.actions_name or self.task.name)

    @property
    def play(self) -> Play:
        """The default play environment.

        Raises:
          UsageError: the task has none; its representations are given.
        """
        if self.task.play is None:
            raise UsageError(f"Task {self.task.name} has no play environment to record actions in.")
        return self.task.play

    def stage_one(self, play: Play, budget_name: str) -> StageOneBudget:
        """What a budget spends on representations of a play's recordings.

        Raises:
          UsageError: there is no such budget.
        """
        presets = play.stage_one or self.task.stage_one
        budget: StageOneBudget = budget_of(presets, budget_name, "Stage one")
        return budget


@dataclass(frozen=True)
class EmbedConfig:
    """All that fixes a stage-one run."""

    task: str
    representation: str
    split: str
    split_hash: str
    observations_hash: str
    seed: int
    train_on: str
    model: RepresentationConfig


class Learned(NamedTuple):
    """What the name of a learned representation says: `hvae` or `vae`, of what, and how read."""

    kind: str
    play: Play
    modality: Modality


def parse_representation(domain: Domain, name: str) -> Learned:
    """What a learned representation's name, such as `hvae` or `vae-onehot`, says.

    The suffix `-oracle` says that the encoder is trained on all actions, test ones included.

    Raises:
      UsageError: the name is not of that form.
    """
    kind, _, modality_name = name.removesuffix(_ORACLE).partition("-")
    modality_name = modality_name or next(iter(domain.play.modalities))
    of_play = {name: play for play in domain.task.plays for name in play.modalities}
    if kind not in ("hvae", "vae") or modality_name not in of_play:
        legal = [f"{k}-{m}" for k in ("hvae", "vae") for m in of_play]
        raise UsageError(
            f"Unknown representation {name!r}. Learned: hvae, vae, {', '.join(legal)}, each also "
            f"with {_ORACLE}; engineered: {', '.join(domain.universe.engineered)}; random-SIZE; or "
            "an embed run, or an .npz file."
        )
    play = of_play[modality_name]
    return Learned(kind, play, play.modalities[modality_name])


def collect_observations(
    domain: Domain,
    runs: Path,
    num_recordings: int,
    play: Play | None = None,
    stores_drawn: bool = False,
) -> Recordings:
    """The recordings of every action of the domain, made now if they are not there.

    Args:
      play: which ones; default: the task's first.
      stores_drawn: see `StageOneBudget`.
    """
    return collect(
        domain.actions_folder(runs),
        play or domain.play,
        domain.universe,
        num_recordings,
        REPRESENTATION_SEED,
        stores_drawn,
    )


def _with_always_available(split: ActionSplit, part: str) -> np.ndarray:
    """int32[n] the actions of a part of the split, and those that are in every set."""
    return np.union1d(split.ids(part), split.always_available)


def train_representation(
    domain: Domain,
    runs: Path,
    name: str,
    budget_name: str,
    *,
    seed: int = REPRESENTATION_SEED,
    assignments: list[str] | None = None,
    workdir: Path | None = None,
    overwrite: bool = False,
    num_recordings: int | None = None,
    stores_drawn: bool | None = None,
) -> RunDirectory:
    """Trains (or resumes, or finds complete) an encoder; its table covers every action.

    Args:
      num_recordings, stores_drawn: instead of the budget's.

    Returns:
      The run directory, closed, with `table.npz` and `split.json` in it; without the table if the
      run was interrupted.
    """
    kind, play, modality = parse_representation(domain, name)
    budget = domain.stage_one(play, budget_name)
    recordings = collect_observations(
        domain,
        runs,
        num_recordings or budget.num_recordings,
        play,
        budget.stores_drawn if stores_drawn is None else stores_drawn,
    )
    train_on = "all" if name.endswith(_ORACLE) else "train"
    num_actions = len(_with_always_available(domain.split, train_on))
    num_default = len(_with_always_available(Domain.of(domain.task, None).split, "train"))
    config = config_lib.set_paths(
        EmbedConfig(
            task=domain.task.actions_name or domain.task.reference,
            representation=name,
            split=domain.split_name,
            split_hash=domain.split.hash,
            observations_hash=recordings.hash,
            seed=seed,
            train_on=train_on,
            model=budget.config(kind, num_actions, num_default),
        ),
        assignments or [],
    )
    run_name = f"embed-{name}-{domain.split_name}-{budget_name}-{seed}"
    path = workdir or domain.actions_folder(runs) / run_name
    with RunDirectory.open_or_create(
        path, config_lib.to_dict(config), overwrite, {"split_hash": domain.split.hash}
    ) as run:
        learner = RepresentationLearner(config.model, modality)
        trained = _with_always_available(domain.split, config.train_on)
        data = recordings.for_training(trained)
        if not (path / TABLE_FILE).exists():
            print(f"Training {name} ({config.model.num_steps} steps; {budget.cost}) in {path}.")
        result = loop.run(
            learner.init(jax.random.key(config.seed), data.shape),
            chunk=lambda state, n: _train_chunk(learner, data, state, n),
            run_directory=run,
            total_steps=config.model.num_steps,
            chunk_steps=budget.chunk_steps,
            checkpoint_every=budget.checkpoint_every,
            title=name,
            steps_unit="steps",
            work_per_step=config.model.actions_per_batch * config.model.recordings_per_action,
            work_unit="trajectories",
            shown_metrics=("loss", "kl_action"),
        )
        if not result.was_interrupted and not (path / TABLE_FILE).exists():
            domain.split.save(path / SPLIT_FILE)
            table = RepresentationTable(
                vectors=learner.encode(result.state, recordings.for_encoding()),
                ids=recordings.ids,
                universe_hash=domain.universe.hash,
                split_hash=domain.split.hash,
                source=f"{name}, {budget_name}, seed {config.seed}",
            )
            table.save(path / TABLE_FILE)
            run.add_provenance(table_hash=table.hash)
    return run


def _train_chunk(
    learner: RepresentationLearner,
    data: jax.Array | RecordingSource,
    state: RepresentationState,
    n: int,
) -> Any:
    state, metrics = learner.train_steps(state, data, n)
    metrics["nonfinite/loss_and_gradient"] = metrics.pop("nonfinite")
    return state, metrics


def load_encoder(path: Path) -> tuple[EmbedConfig, RepresentationLearner, RepresentationState, Any]:
    """The frozen encoder of a stage-one run: (config, learner, state, format of what it reads).

    Raises:
      RunDirectoryError, CheckpointError: `path` is no such run, or has no readable checkpoint.
    """
    from experiments.pipeline.flags import load_task

    run = RunDirectory.load(path)
    config = config_lib.from_dict(EmbedConfig, run.config)
    domain = Domain.of(load_task(config.task), config.split)
    _, play, modality = parse_representation(domain, config.representation)
    learner = RepresentationLearner(config.model, modality)
    shape = (
        config.model.actions_per_batch * 8,
        config.model.recordings_per_action,
        *play.seen.shape,
    )
    example = jax.eval_shape(lambda: learner.init(jax.random.key(0), shape))
    state, _ = Checkpointer(run.checkpoints).restore("latest", example)
    return config, learner, state, play.seen


def find_table(domain: Domain, runs: Path, representation: str, budget: str) -> RepresentationTable:
    """The table behind `--representation`, trained now if it has to be.

    Raises:
      UsageError: there is no such representation, or its training was interrupted.
      SplitMismatch: the table belongs to another universe or split.
    """
    path = Path(representation)
    if representation in domain.universe.engineered:
        table = engineered_table(domain.universe, representation)
    elif match := re.fullmatch(r"random-(\d+)", representation):
        table = random_table(domain.universe, int(match[1]), REPRESENTATION_SEED)
    elif path.is_dir() or path.suffix == ".npz":
        table = RepresentationTable.load(path / TABLE_FILE if path.is_dir() else path)
    else:
        run = train_representation(domain, runs, representation, budget)
        if not (run.path / TABLE_FILE).exists():
            raise UsageError(f"{representation} was interrupted; run again to go on.")
        table = RepresentationTable.load(run.path / TABLE_FILE)
    table.check(domain.universe, domain.split)
    return table


def print_report(domain: Domain, run: RunDirectory, table: RepresentationTable) -> None:
    """Prints purity and linear R2 of a table (spec method 3.8); all numbers go to a JSON file."""
    targets = domain.task.representation_targets
    numbers = report.describe(
        table.vectors,
        domain.universe.class_labels,
        held_out=sorted({*domain.split.validation.tolist(), *domain.split.test.tolist()}),
        targets=targets(domain.universe) if targets else {},
    )
    file = run.record_evaluation("representation", numbers)
    entries = numbers["entries"]
    explained = "".join(
        f"; linear R2 to {name} {value:.2f}" for name, value in numbers["linear_r2_mean"].items()
    )
    print(
        f"{table.source}: 5-NN purity {numbers['purity_all']:.3f}, held out "
        f"{numbers['purity_held_out']:.3f}{explained}; {entries['active_dimensions']} of "
        f"{entries['dimensions']} dimensions vary between actions (std > 0.1). All in {file}."
    )
