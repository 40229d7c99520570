"""A trained policy on disk: loaded, evaluated, played (paper algorithm 2)."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, cast

import jax
import numpy as np

from jaxnew.actions import ActionSplit, check_same, mixture_ids
from jaxnew.embedding import SPLIT_FILE, TABLE_FILE
from jaxnew.evaluation import EVALUATION_SEED, measure, play, summarize
from jaxnew.loop import NonFiniteError
from jaxnew.new_actions import offer
from jaxnew.representation.table import RepresentationTable
from jaxnew.rollout.contract import Episode, Policy
from jaxnew.sampling import Actions
from jaxnew.storage.checkpoint import KINDS, Checkpointer, Kind
from jaxnew.storage.config import Assignments
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.places import UsageError
from jaxnew.task.settings import (
    TrainConfig,
    check_seed,
    only_computed,
    read_train_config,
)
from jaxnew.task.task import Task
from jaxnew.trainer import Trainer


@dataclass(frozen=True)
class Question:
    """What an evaluation tells: how a policy does on sets of some actions.

    Attributes:
      actions: name of what sets are drawn from, such as a part of the split.
      set_size: m; None for all that there are.
      first_size, growth: of a set that grows during the episode, see `Actions.first_size`.
      checkpoint: whose policy.
      policy: `sampled` or `greedy`.
    """

    actions: str
    set_size: int | None
    first_size: int = 0
    growth: int = 1
    checkpoint: str = "best"
    policy: str = "sampled"

    def is_answered_by(self, evaluation: Mapping[str, Any], episodes: int = 1) -> bool:
        """Whether an evaluation on record is the one.

        Args:
          evaluation: what `Run.record` wrote.
          episodes: it has at least so many, of the seed that all runs share.
        """
        size, whole = evaluation["set_size"], evaluation.get("num_actions", float("inf"))
        first_size = evaluation.get("first_size", 0)
        return (
            (evaluation["actions"], evaluation["checkpoint"], evaluation["policy"])
            == (self.actions, self.checkpoint, self.policy)
            and (size >= whole if self.set_size is None else size == self.set_size)
            and first_size == self.first_size
            and (not first_size or evaluation["growth"] == self.growth)
            and evaluation["num_episodes"] >= episodes
            and evaluation.get("evaluation_seed", EVALUATION_SEED) == EVALUATION_SEED
        )


@dataclass(frozen=True)
class Evaluation:
    """Numbers of one checkpoint, by list of actions; prints as a table.

    Attributes:
      title: which checkpoint of which run.
      rows: by name of the actions what `to_dict` returns.
    """

    title: str
    rows: Mapping[str, Mapping[str, Any]]

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """By name of the actions: `metrics`, each with `mean`, `low`, `high` and the kind of
        `interval` over episodes; `num_episodes`, `num_actions`, `set_size`, `policy`,
        `evaluation_seed` and `seconds`.
        """
        return {name: dict(row) for name, row in self.rows.items()}

    def __str__(self) -> str:
        lines = [f"{self.title}; mean [95 % interval over episodes]"]
        for name, row in self.rows.items():
            metrics = "  ".join(
                f"{metric} {value['mean']:.4f} [{value['low']:.4f}, {value['high']:.4f}]"
                for metric, value in row["metrics"].items()
            )
            lines.append(f"{name:>12} ({row['num_episodes']} episodes, {row['policy']}): {metrics}")
            if "num_seen" in row:
                lines.append(
                    f"{'':>12} {row['num_actions']} actions of {row['universe']}, "
                    f"{row['num_seen']} seen in training, e.g. {'; '.join(row['examples'])}"
                )
        return "\n".join(lines)


@dataclass(frozen=True)
class Run:
    """A policy from a run directory. Nothing but the directory is needed to load one.

    A context manager: on the host it holds worker processes once it has played.

    Attributes:
      path: the run directory.
      trainer: the parts of the run.
      policy: parameters and statistics of the checkpoint.
      step: updates that it was trained for.
      checkpoint: kind of the checkpoint, `best` (by validation) or `latest`.
      diverged_at: update by which the run, a member of a sweep, diverged; None if it did not.
      interrupted_by: number of the signal that stopped its training just now, or None.
    """

    path: Path
    trainer: Trainer
    policy: Policy
    step: int
    checkpoint: str
    interrupted_by: int | None = None
    diverged_at: int | None = None

    @classmethod
    def load(
        cls,
        path: Path | str,
        checkpoint: Kind | None = None,
        *,
        task: Task | None = None,
        num_workers: int = 0,
        set: Assignments = (),
    ) -> Run:
        """The policy of a run of `train`, `finetune` or a member of `sweep`.

        Args:
          path: the run directory, or one of its checkpoints.
          checkpoint: `best` or `latest`; None for what `path` names, else `best`.
          task: in place of the one that the run names, for a task that no name or place leads to.
          num_workers: processes for environments on the host; 0: one per core.
          set: `pool.FIELD` alone, how environments on the host are run.

        Raises:
          UsageError: `path` is neither a run nor in one.
          RunDirectoryError, ConfigError: it is no run of a policy.
          SplitMismatch: split or table were changed since.
          CheckpointError: there is no such checkpoint.
          NonFiniteError: there is none, because the run diverged before.
        """
        path, named = locate(Path(path))
        directory = RunDirectory.load(path)
        trainer = load_trainer(directory, num_workers, set, task)
        return cls.of(directory.path, trainer, checkpoint or named or "best")

    @classmethod
    def of(cls, path: Path, trainer: Trainer, checkpoint: Kind) -> Run:
        """A checkpoint of a run whose parts are there."""
        example = trainer.learner.policy_shapes(trainer.training)
        checkpointer = Checkpointer(path / "checkpoints")
        if not checkpointer.steps(checkpoint) and checkpointer.steps("latest"):
            update = checkpointer.metadata("latest").get("diverged_at")
            if update is not None:
                raise _unsound(f"{path} diverged by update {update}, before its first evaluation")
        state, metadata = checkpointer.restore(checkpoint, example, is_part=True)
        diverged_at = metadata.get("diverged_at")
        step = int(state.step)
        return cls(path, trainer, state.policy, step, checkpoint, diverged_at=diverged_at)

    @property
    def was_interrupted(self) -> bool:
        """Training was stopped; train again to go on."""
        return self.interrupted_by is not None

    @property
    def config(self) -> TrainConfig:
        """All that fixes the run."""
        return self.trainer.config

    @property
    def task(self) -> Task:
        """What it was trained on."""
        return self.trainer.task

    @property
    def split(self) -> ActionSplit:
        """What it was trained and selected with."""
        return self.trainer.split

    def evaluate(
        self,
        parts: str | Sequence[str] = (),
        *,
        ids: Mapping[str, np.ndarray] | None = None,
        table: RepresentationTable | None = None,
        table_name: str = "",
        universe: str = "",
        allow: Collection[str] = (),
        unseen_ratio: float | None = None,
        episodes: int = 5000,
        set_size: int | None = None,
        grows_from: int = 0,
        growth: int = 1,
        greedy: bool = False,
        seed: int = EVALUATION_SEED,
        record: bool = True,
    ) -> Evaluation:
        """Plays episodes on action sets, with no further training.

        Args:
          parts: of the split, one or several of `train`, `validation`, `test`, `all`; default:
            `test`, where nothing else says what to draw from.
          ids: by name, int32[n] actions to draw sets from.
          table: representations of actions, which are drawn from. They need not have existed at
            training, and are found by what they do, not by their numbers.
          table_name: what its results are called; default: the beginning of its hash.
          universe, allow: of the table's actions, see `jaxnew.new_actions.offer`.
          unseen_ratio: draw from a mixture of train and test actions with such a share of the
            latter.
          episodes: per list of actions.
          set_size: actions per set; None for as many as in training.
          grows_from, growth: of a set that grows during the episode, see `Actions.first_size`.
          greedy: take the most likely action instead of sampling.
          seed: of the episodes.
          record: keep the results in the run directory, `evaluation/*.json`.

        Raises:
          UsageError: several of `parts`, `ids`, `table`, `unseen_ratio` are given, or see `offer`.
          SplitMismatch: the table is none for this run, see `offer`.
          ValueError: there are no such sets.
          NonFiniteError: the run diverged, or parameters of its policy are not finite.
        """
        self._check_sound()
        check_seed(seed, "seed of the evaluation")
        named = (parts,) if isinstance(parts, str) else tuple(parts)
        if sum((bool(named), ids is not None, table is not None, unseen_ratio is not None)) > 1:
            raise UsageError(
                "Give one of parts of the split, ids, table, unseen_ratio; each of them says where "
                "sets come from."
            )
        if table is None and (universe or allow):
            raise UsageError("universe and allow are about the actions of a table; give one.")
        asked = (episodes, seed, greedy)
        rows: dict[str, dict[str, Any]] = {}

        def play_with(trainer: Trainer, name: str, actions: Actions, **more: Any) -> None:
            row = self._row(trainer, actions.growing(grows_from, growth), *asked)
            rows[name] = {**row, **more}
            if record:
                self.record(name, rows[name])

        if table is not None:
            name = f"table-{table_name or table.hash[:8]}"
            new = offer(self.trainer, table, universe, allow)
            try:
                actions = new.trainer.actions(name, new.ids, set_size, new.vectors)
                play_with(new.trainer, name, actions, **new.describe())
            finally:
                if new.trainer is not self.trainer:
                    new.trainer.close()
        else:
            for name, chosen in self._lists(named, ids, unseen_ratio).items():
                play_with(self.trainer, name, self.trainer.actions(name, chosen, set_size))
        return Evaluation(f"{self.path}, {self.checkpoint} checkpoint (update {self.step})", rows)

    def _row(
        self, trainer: Trainer, actions: Actions, episodes: int, seed: int, greedy: bool
    ) -> dict[str, Any]:
        start = time.perf_counter()
        played = measure(trainer.rollout, self.policy, actions, episodes, seed, greedy)
        growth = {"first_size": actions.first_size, "growth": actions.growth}
        return {
            "metrics": summarize(played),
            "num_episodes": episodes,
            "num_actions": int(actions.pool.size),
            "set_size": actions.set_size,
            **(growth if actions.first_size else {}),
            "policy": "greedy" if greedy else "sampled",
            "evaluation_seed": seed,
            "seconds": round(time.perf_counter() - start, 2),
        }

    def _lists(
        self,
        parts: tuple[str, ...],
        ids: Mapping[str, np.ndarray] | None,
        unseen_ratio: float | None,
    ) -> dict[str, np.ndarray | None]:
        """By name, the actions to draw from; None for a part of the split."""
        if ids is not None:
            return dict(ids)
        if unseen_ratio is not None:
            mixed = mixture_ids(self.split.train, self.split.test, unseen_ratio)
            return {f"unseen-{unseen_ratio:g}": mixed}
        return dict.fromkeys(parts or ("test",))

    def record(self, name: str, row: Mapping[str, Any]) -> Path:
        """Keeps one result in the run directory; returns its file."""
        content = {"checkpoint": self.checkpoint, "step": self.step, "actions": name, **row}
        return RunDirectory.load(self.path).record_evaluation(file_stem(content), content)

    def play(
        self, part: str = "test", first: int = 0, count: int = 1, seed: int = EVALUATION_SEED
    ) -> list[Episode]:
        """Episodes `first..first+count-1` of `evaluate`, with all that happened in them.

        Args:
          part: of the split, that available sets are drawn from.
          first, count: numbers of the episodes.
          seed: of the evaluation.

        Raises:
          NonFiniteError: as of `evaluate`.
        """
        self._check_sound()
        actions = self.trainer.actions(part)
        return play(self.trainer.rollout, self.policy, actions, first, count, seed)

    def _check_sound(self) -> None:
        if self.diverged_at is not None:
            raise _unsound(f"{self.path} diverged by update {self.diverged_at}")
        if any(not np.isfinite(leaf).all() for leaf in jax.tree.leaves(self.policy)):
            raise _unsound(f"Parameters of {self.path}, {self.checkpoint}, are not finite")

    def acting_as(self, policy: Policy, name: str) -> Run:
        """The same run with other parameters, recorded under another name."""
        return replace(self, policy=policy, checkpoint=name)

    def close(self) -> None:
        """Ends the processes of environments on the host."""
        self.trainer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def locate(path: Path) -> tuple[Path, Kind | None]:
    """The run directory that `path` is or lies in, and the kind of checkpoint that it names.

    Raises:
      UsageError: it is neither.
    """
    for folder in (path, *path.parents):
        if (folder / "config.json").is_file():
            inside = path.relative_to(folder).parts
            is_named = len(inside) > 1 and inside[0] == "checkpoints" and inside[1] in KINDS
            return folder, cast(Kind, inside[1]) if is_named else None
    raise UsageError(f"{path} is neither a run directory nor in one (no config.json).")


def load_trainer(
    directory: RunDirectory,
    num_workers: int = 0,
    assignments: Assignments = (),
    task: Task | None = None,
) -> Trainer:
    """The parts of a run, from its directory alone; see `Run.load`."""
    config, task = read_train_config(directory.config, task)
    config = only_computed(config, assignments)
    split = ActionSplit.load(directory.path / SPLIT_FILE)
    table = RepresentationTable.load(directory.path / TABLE_FILE)
    known = task.make_universe().first(len(table.ids))  # It may have grown since.
    split.check(known)
    table.check(known, split)
    check_same("split", split.hash, config.split_hash, directory.path)
    check_same("table", table.hash, config.table_hash, directory.path)
    return Trainer.of(config, task, split, table, num_workers)


def _unsound(what: str) -> NonFiniteError:
    return NonFiniteError(
        f"{what}, so that nothing it plays tells anything. `nonfinite/*` in its metrics.jsonl says "
        "what was not finite first; train again with other settings."
    )


def file_stem(content: Mapping[str, Any]) -> str:
    """What a result is called: results that were made differently have files of their own."""
    grown = f"-from{content['first_size']}-by{content['growth']}" if "first_size" in content else ""
    stem = "{actions}-{checkpoint}-{policy}-m{set_size}".format(**content)
    return f"{stem}{grown}"
