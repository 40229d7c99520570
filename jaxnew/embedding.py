"""Stage one: an encoder that is trained on recordings of actions, and its table."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from jaxnew import loop
from jaxnew.actions import ActionIdentity, ActionSplit, check_same
from jaxnew.observations import ObservationsError, Recordings
from jaxnew.recording import (
    ORACLE,
    REPRESENTATION_SEED,
    Learned,
    PlayRecordings,
    collect,
    parse_representation,
    stores,
)
from jaxnew.representation import report
from jaxnew.representation.config import RepresentationConfig
from jaxnew.representation.learner import EncoderWeights, RepresentationLearner
from jaxnew.representation.table import RepresentationTable, engineered_table, random_table
from jaxnew.storage.arrays import read_arrays, write_arrays
from jaxnew.storage.checkpoint import Checkpointer, CheckpointError
from jaxnew.storage.config import Assignments, ConfigError, from_dict
from jaxnew.storage.progress import say
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.budgets import StageOneBudget, scaled_cost
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError, place_of, trusting
from jaxnew.task.settings import EmbedConfig, identity, upgraded, with_set
from jaxnew.task.task import Play, Task

TABLE_FILE = "table.npz"
WEIGHTS_FILE = "weights.npz"
UNTRAINED_FILE = "untrained.npz"  # What the encoder made of actions before it was trained.
_RECORDINGS_UNTRAINED = 4
SPLIT_FILE = "split.json"


@dataclass(frozen=True)
class Encoder:
    """A trained encoder of actions, frozen.

    Attributes:
      path: its run directory.
      config: all that fixes it.
      task: whose actions it was trained on.
      interrupted_by: number of the signal that stopped its training just now, or None.
    """

    path: Path
    config: EmbedConfig
    task: Task
    interrupted_by: int | None = None
    _table: RepresentationTable | None = None

    @classmethod
    def load(cls, path: Path | str, task: Task | None = None, *, trust: bool = False) -> Encoder:
        """The encoder of a run of `embed`.

        Args:
          path: the run directory, or `pretrained:NAME` for one that comes with jaxnew.
          task: in place of the one that the run names, for a task that no name or place leads to.
          trust: import the `package.module` that it names as its task, installed or not.

        Raises:
          RunDirectoryError, ConfigError: `path` is no such run.
          SplitMismatch: its table was exchanged for another.
        """
        directory = RunDirectory.load(place_of(path))
        if "model" not in directory.config:
            raise ConfigError(f"{path} is no run of an encoder: its config has no model.")
        config = from_dict(EmbedConfig, upgraded(directory.config))
        is_made = (directory.path / TABLE_FILE).exists()
        table = load_table(directory.path) if is_made else None
        with trusting(trust):
            task = task or load_task(config.task, is_recorded=True)
        return cls(directory.path, config, task, _table=table)

    @property
    def is_finished(self) -> bool:
        """Whether its training reached the end."""
        return self._table is not None

    @property
    def table(self) -> RepresentationTable:
        """Representations of all actions of its domain.

        Raises:
          InterruptedRunError: a signal stopped training just now.
          UsageError: training was interrupted earlier.
        """
        if self._table is None:
            message = f"{self.path} was interrupted; embed again to go on."
            if self.interrupted_by is not None:
                raise loop.InterruptedRunError(message, self.interrupted_by)
            raise UsageError(message)
        return self._table

    def domain(self) -> Domain:
        """Its task with the split that it was trained on."""
        return Domain.of(self.task, self.config.split, self.config.split_seed)

    def encode(self, recordings: Recordings) -> RepresentationTable:
        """Representations of recorded actions, which need not have existed before.

        Args:
          recordings: [A, S, ...] as its play environment makes them, of any universe of its task.

        Raises:
          ObservationsError: they are of another format.
          UsageError: training was interrupted, or the task has no such universe.
          CheckpointError: the run has no readable checkpoint.
        """
        learner, weights, play = self.frozen()
        if self.table.play not in (None, play.seen.modality):
            raise ObservationsError(
                f"{self.path} learned from {self.table.play!r}, and what is recorded today is "
                f"{play.seen.modality!r}. Train the encoder again."
            )
        universe = recordings.identity.place if recordings.identity else ""
        plays = self.task.with_universe(universe).plays
        alike = [each for each in plays if learner.modality.name in each.modalities]
        fitting = recordings.fits((alike or [play])[0].seen)
        return RepresentationTable(
            vectors=learner.encode(weights, fitting.data),
            ids=fitting.ids,
            universe_hash=fitting.universe_hash,
            split_hash=self.config.split_hash,
            source=f"{self.config.representation} of {self.path.name}, new recordings",
            play=fitting.format.modality,
            encoder_hash=self.table.made_by,
            identity=fitting.identity,
        )

    def frozen(self) -> tuple[RepresentationLearner, EncoderWeights, Play]:
        """The learner, its weights at the end, and the play whose recordings it reads."""
        model = self.config.model
        learned = parse_representation(self.domain(), self.config.representation)
        play = learned.play
        learner = RepresentationLearner(model, learned.modality, learned.appends_changes)
        shape = (model.actions_per_batch, model.recordings_per_action, *play.seen.shape)
        example = jax.eval_shape(lambda: learner.init(jax.random.key(0), shape))
        if (self.path / WEIGHTS_FILE).exists():
            return learner, _read_weights(self.path / WEIGHTS_FILE, example.weights), play
        # A run of before version 0.4.0.
        state, _ = Checkpointer(self.path / "checkpoints").restore("latest", example)
        return learner, state.weights, play

    def export(self, folder: Path | str) -> Path:
        """A copy for others, all that `load` and `encode` need: a few megabytes.

        Raises:
          UsageError: its training was interrupted.
          StorageError: the folder exists, or the system refuses.
        """
        if not self.is_finished:
            raise UsageError(f"{self.path} was interrupted; embed again to go on.")
        folder, (_, weights, _) = Path(folder), self.frozen()
        RunDirectory.load(self.path).export(
            folder,
            (SPLIT_FILE, TABLE_FILE),
            lambda new: _write_weights(new / WEIGHTS_FILE, weights),
        )
        return folder

    def report(self) -> dict[str, Any]:
        """What its table tells of actions, see `jaxnew.representation.report.describe`.

        Also kept in `evaluation/representation.json`.
        """
        split = ActionSplit.load(self.path / SPLIT_FILE)
        check_same("split", split.hash, self.config.split_hash, self.path)
        numbers = table_report(self.task, split, self.table.vectors)
        RunDirectory.load(self.path).record_evaluation("representation", numbers)
        return numbers

    def references(self) -> dict[str, dict[str, Any]]:
        """The same for tables beside which its own is to be seen.

        `random` vectors, the encoder `untrained` (unless the run is of before version 0.4.0), and
        the task's engineered vectors by their names.
        """
        split = ActionSplit.load(self.path / SPLIT_FILE)
        num_actions, size = self.table.vectors.shape
        universe = self.task.make_universe().first(num_actions)
        vectors = {"random": random_table(universe, size, REPRESENTATION_SEED).vectors}
        if (self.path / UNTRAINED_FILE).exists():
            vectors["untrained"] = RepresentationTable.load(self.path / UNTRAINED_FILE).vectors
        vectors |= universe.engineered
        return {name: table_report(self.task, split, each) for name, each in vectors.items()}


def table_report(task: Task, split: ActionSplit, vectors: np.ndarray) -> dict[str, Any]:
    """What vectors f32[A, d] tell of the first A actions of a task, see `report.describe`."""
    universe = task.make_universe().first(len(vectors))
    targets = task.shown.representation_targets
    return report.describe(
        vectors,
        universe.class_labels,
        held_out=sorted({*split.validation.tolist(), *split.test.tolist()}),
        targets=targets(universe) if targets else {},
    )


def embed(
    task: Task | str,
    representation: str = "hvae",
    *,
    budget: str = "laptop",
    seed: int = REPRESENTATION_SEED,
    split: str | None = None,
    split_seed: int = 0,
    set: Assignments = (),
    num_recordings: int | None = None,
    stores_drawn: bool | None = None,
    workdir: Path | str | None = None,
    runs: Path | str = "runs",
    overwrite: bool = False,
) -> Encoder:
    """Trains an encoder, or resumes, or finds it complete; its table covers every action.

    Args:
      task: the domain, or what `load_task` takes.
      representation: `hvae` or `vae` with an optional `-MODALITY`, `-changes` and `-oracle`, see
        `parse_representation`.
      budget: a preset of stage one.
      seed: of the run, 0..2^32 - 1.
      split, split_seed: see `Domain.of`.
      set: fields of `EmbedConfig`, see `with_set`.
      num_recordings, stores_drawn: instead of the budget's.
      workdir: the run directory; default: below `runs`, named after what the run is.
      runs: where runs and recordings are kept.
      overwrite: replace an existing run instead of resuming.

    Raises:
      UsageError, ConfigError: something does not exist, or takes no such value.
      ConfigMismatch: the directory holds another run.
    """
    task = load_task(task) if isinstance(task, str) else task
    domain = Domain.of(task, split, split_seed)
    learned = parse_representation(domain, representation)
    preset = domain.stage_one(learned.play, budget)
    recordings = collect(
        domain,
        runs,
        num_recordings or preset.num_recordings,
        learned.play,
        stores(learned.play, preset, stores_drawn),
    )
    base = _config(domain, representation, learned.kind, preset, recordings, seed)
    config = with_set(base, set)
    title = f"embed-{representation}-{domain.split_label}-{budget}-{seed}"
    path = Path(workdir) if workdir else domain.actions_folder(Path(runs)) / title
    shares = {
        "steps": config.model.num_steps / base.model.num_steps,
        "batches": _batch_size(config.model) / _batch_size(base.model),
        "recordings": recordings.recorded.num_recordings / preset.num_recordings,
    }
    preset = replace(preset, cost=scaled_cost(preset.cost, **shares))
    provenance = {"split_hash": domain.split.hash}
    with RunDirectory.open_or_create(
        path, identity(config), overwrite, provenance, upgrade=upgraded
    ) as directory:
        source = f"{representation}, {budget}, seed {config.seed}"
        stopped_by = _train(directory, domain, config, learned, preset, recordings, source)
    return replace(Encoder.load(path, task), interrupted_by=stopped_by)


def _batch_size(model: RepresentationConfig) -> int:
    return model.actions_per_batch * model.recordings_per_action


def _config(
    domain: Domain,
    representation: str,
    kind: str,
    preset: StageOneBudget,
    recordings: PlayRecordings,
    seed: int,
) -> EmbedConfig:
    """The config of a run of a preset, before anything is set."""
    task, split = domain.task, domain.split
    train_on = "all" if representation.endswith(ORACLE) else "train"
    return EmbedConfig(
        task=task.actions_name or task.reference,
        representation=representation,
        split=domain.split_name,
        split_seed=domain.split_seed,
        split_hash=split.hash,
        observations_hash=recordings.recorded.hash,
        seed=seed,
        train_on=train_on,
        model=preset.config(
            kind,
            len(_with_always_available(split, train_on)),
            len(_with_always_available(Domain.of(task).split, "train")),
        ),
    )


def _train(
    directory: RunDirectory,
    domain: Domain,
    config: EmbedConfig,
    learned: Learned,
    preset: StageOneBudget,
    recordings: PlayRecordings,
    source: str,
) -> int | None:
    """Trains from where the directory stands to the end, and then writes the table.

    Returns:
      The number of the signal that stopped it before there was a table, or None.
    """
    model, name = config.model, config.representation
    learner = RepresentationLearner(model, learned.modality, learned.appends_changes)
    data = recordings.for_training(_with_always_available(domain.split, config.train_on))
    is_made = (directory.path / TABLE_FILE).exists()
    chunk_steps = min(preset.chunk_steps, preset.checkpoint_every)
    if not is_made:
        say(f"Training {name} ({model.num_steps} steps; {preset.cost}) in {directory.path}.")
    start = learner.init(jax.random.key(config.seed), data.shape)
    result = loop.run(
        start,
        lambda state, n: learner.train_steps(state, data, n),
        directory,
        loop.Rhythm(model.num_steps, chunk_steps, preset.checkpoint_every),
        loop.Display(
            name,
            unit="steps",
            work_per_step=model.actions_per_batch * model.recordings_per_action,
            work_unit="trajectories",
            metrics=("loss", "kl_action"),
        ),
    )
    if result.was_interrupted or is_made:
        return result.interrupted_by
    domain.split.save(directory.path / SPLIT_FILE)
    few = min(_RECORDINGS_UNTRAINED, recordings.recorded.num_recordings)
    # In the units of the recordings, which are no part of what is learned.
    averages = {
        name: result.state.batch_stats[name] for name in start.batch_stats if name == "scales"
    }
    untrained = learner.encode(
        replace(start, batch_stats={**start.batch_stats, **averages}),
        recordings.for_encoding(num_recordings=few),
    )
    RepresentationTable(untrained, recordings.recorded.ids, source=f"untrained {name}").save(
        directory.path / UNTRAINED_FILE
    )
    _write_weights(directory.path / WEIGHTS_FILE, result.state.weights)
    table = RepresentationTable(
        vectors=learner.encode(result.state, recordings.for_encoding()),
        ids=recordings.recorded.ids,
        universe_hash=domain.universe.hash,
        split_hash=domain.split.hash,
        source=source,
        play=recordings.play.seen.modality,
        identity=ActionIdentity.of(
            domain.universe, recordings.recorded.ids, domain.task.universe_name
        ),
    )
    table.save(directory.path / TABLE_FILE)
    directory.add_provenance(table_hash=table.hash)
    return None


def _write_weights(path: Path, weights: EncoderWeights) -> None:
    write_arrays(path, flatten_dict(vars(weights), sep="/"))


def _read_weights(path: Path, example: EncoderWeights) -> EncoderWeights:
    """The weights in a file, which are those of an encoder like `example`."""
    expected = flatten_dict(vars(example), sep="/")
    arrays = read_arrays(path, sorted(expected), CheckpointError)
    found = {name: leaf.shape for name, leaf in arrays.items()}
    if found != {name: leaf.shape for name, leaf in expected.items()}:
        raise CheckpointError(
            f"{path} holds the weights of another encoder than config.json describes. Restore the "
            "files from a copy, or embed again with --overwrite."
        )
    return EncoderWeights(**unflatten_dict(arrays, sep="/"))


def _with_always_available(split: ActionSplit, part: str) -> np.ndarray:
    """int32[n] the actions of a part of the split, and those that are in every set."""
    return np.union1d(split.ids(part), split.always_available)


def is_learned(representation: str) -> bool:
    """Whether a representation is the name of one that is learned, not of a file or a run."""
    path = Path(representation)
    is_place = os.path.isdir(path) or path.suffix == ".npz"
    return representation.startswith(("hvae", "vae")) and not is_place


def load_table(path: Path) -> RepresentationTable:
    """A table from its file, or from a run directory, where it has to be the one on record.

    Raises:
      UsageError: the run has none, because it was interrupted.
      RunDirectoryError: it is no run directory.
      SplitMismatch: the table of the run was exchanged for another.
      ValueError: the file is missing or damaged.
    """
    if not os.path.isdir(path):
        return RepresentationTable.load(path)
    sessions = RunDirectory.load(path).provenance["sessions"]
    if not (path / TABLE_FILE).exists():
        raise UsageError(f"{path} has no {TABLE_FILE}: it was interrupted; embed again to go on.")
    table = RepresentationTable.load(path / TABLE_FILE)
    made = [session["table_hash"] for session in sessions if "table_hash" in session]
    if made:
        check_same("table", table.hash, made[-1], path)
    return table


def find_table(domain: Domain, runs: Path, representation: str, budget: str) -> RepresentationTable:
    """A table by name: engineered, `random-SIZE`, of a run of `embed`, of an `.npz`, or learned.

    An encoder that is not there is trained now.

    Args:
      representation: its name, or the path of a run or file, or `pretrained:NAME`.
      budget: of an encoder that has to be trained.

    Raises:
      UsageError: there is no such representation, or its training was interrupted earlier.
      InterruptedRunError: a signal stopped its training just now.
      SplitMismatch: the table belongs to another universe or split.
    """
    path = place_of(representation)
    if representation in domain.universe.engineered:
        table = engineered_table(domain.universe, representation)
    elif match := re.fullmatch(r"random-(\d+)", representation):
        table = random_table(domain.universe, int(match[1]), REPRESENTATION_SEED)
    elif os.path.isdir(path) or path.suffix == ".npz":
        table = load_table(path)
    else:
        table = embed(
            domain.task,
            representation,
            budget=budget,
            split=domain.split_name,
            split_seed=domain.split_seed,
            runs=runs,
        ).table
    table.check(domain.universe, domain.split)
    return table
