"""A trained policy on disk: loaded, evaluated, played (paper algorithm 2)."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Self, cast

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxnew.actions import SPLIT_NAMES, ActionSplit, check_same, content_hash, mixture_ids
from jaxnew.embedding import SPLIT_FILE, TABLE_FILE
from jaxnew.evaluation import EVALUATION_SEED, measure, play, summarize
from jaxnew.loop import NonFiniteError
from jaxnew.new_actions import offer
from jaxnew.representation.table import RepresentationTable
from jaxnew.results import Evaluation, file_stem
from jaxnew.rollout.contract import Episode, Policy
from jaxnew.sampling import Actions
from jaxnew.storage.checkpoint import KINDS, Checkpointer, Kind
from jaxnew.storage.config import Assignments, ConfigError
from jaxnew.storage.files import write_json_atomically
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.places import UsageError, check_output, trusting
from jaxnew.task.settings import (
    TrainConfig,
    check_seed,
    only_computed,
    read_train_config,
)
from jaxnew.task.task import Task
from jaxnew.trainer import Trainer


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
        trust: bool = False,
    ) -> Run:
        """The policy of a run of `train`, `finetune` or a member of `sweep`.

        Args:
          path: the run directory; or one of its checkpoints, `checkpoints/KIND` for the newest of
            a kind and `checkpoints/KIND/STEP` for that of a step.
          checkpoint: `best` or `latest`; None for what `path` names, else `best`.
          task: in place of the one that the run names, for a task that no name or place leads to.
          num_workers: processes for environments on the host; 0: one per core.
          set: `pool.FIELD` alone, how environments on the host are run.
          trust: import the `package.module` that the run names as task or method, installed or not.

        Raises:
          UsageError: `path` is neither a run nor a checkpoint of one, or not of that kind; or the
            run names what has to be trusted.
          RunDirectoryError, ConfigError: it is no run of a policy.
          SplitMismatch: split or table were changed since.
          CheckpointError: there is no such checkpoint.
          NonFiniteError: there is none, because the run diverged before.
        """
        found = locate(path)
        if found.kind not in (None, checkpoint or found.kind):
            raise UsageError(f"{path} is a {found.kind} checkpoint, not a {checkpoint} one.")
        directory = RunDirectory.load(found.path)
        with trusting(trust):
            trainer = load_trainer(directory, num_workers, set, task)
        return cls.of(directory.path, trainer, checkpoint or found.kind or "best", found.step)

    @classmethod
    def of(cls, path: Path, trainer: Trainer, checkpoint: Kind, step: int | None = None) -> Run:
        """A checkpoint of a run whose parts are there; without a `step` the newest of its kind."""
        example = trainer.learner.policy_shapes(trainer.training)
        checkpointer = Checkpointer(path / "checkpoints")
        if not checkpointer.steps(checkpoint) and checkpointer.steps("latest"):
            update = checkpointer.metadata("latest").get("diverged_at")
            if update is not None:
                raise _unsound(f"{path} diverged by update {update}, before its first evaluation")
        state, metadata = checkpointer.restore(checkpoint, example, step, is_part=True)
        diverged_at = metadata.get("diverged_at")
        return cls(
            path, trainer, state.policy, int(state.step), checkpoint, diverged_at=diverged_at
        )

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
        ids: Mapping[str, ArrayLike] | None = None,
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
        record: bool | Path | str = True,
    ) -> Evaluation:
        """Plays episodes on action sets, with no further training.

        Args:
          parts: of the split, one or several of `train`, `validation`, `test`, `all`; default:
            `test`, where nothing else says what to draw from.
          ids: by name, int[n] actions to draw sets from.
          table: representations of actions, which are drawn from. They need not have existed at
            training, and are found by what they do, not by their numbers.
          table_name: what its results are called; default: the beginning of its hash.
          universe, allow: of the table's actions, see `jaxnew.new_actions.offer`.
          unseen_ratio: draw from a mixture of train and test actions with such a share of the
            latter.
          episodes: per list of actions.
          set_size: actions per set; None for the run's `sets.size`.
          grows_from, growth: of a set that grows during the episode, see `Actions.first_size`.
          greedy: take the most likely action instead of sampling.
          seed: of the episodes.
          record: keep the results in the run directory, `evaluation/*.json`; or in another folder.
            Every question has a file of its own.

        Returns:
          The results, also of what could not be recorded, which it says.

        Raises:
          UsageError: several of `parts`, `ids`, `table`, `unseen_ratio` are given, or see `offer`.
          SplitMismatch: the table is none for this run, see `offer`.
          ValueError: there are no such sets.
          NonFiniteError: the run diverged, or parameters of its policy are not finite.
          UsageError: nothing can be recorded there.
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
        folder = self.path / "evaluation" if record is True else Path(record or "")
        if record:
            check_output(folder, "record elsewhere (--output, record) or not at all (record=False)")
        asked = (episodes, seed, greedy)
        rows: dict[str, dict[str, Any]] = {}
        problems: list[str] = []

        def play_with(
            trainer: Trainer, name: str, actions: Actions, known_as: str, **more: Any
        ) -> None:
            row = self._row(trainer, actions.growing(grows_from, growth), *asked)
            rows[name] = {**row, **more}
            if not record:
                return
            try:
                self.record(known_as, rows[name], None if record is True else folder)
            except (OSError, ValueError) as err:  # What was played is not lost for it.
                problems.append(f"{name} is not on record: {err}")

        if table is not None:
            new = offer(self.trainer, table, universe, allow)
            digest = content_hash(table.hash, new.identity.universe)[:8]
            name = f"table-{table_name or digest}"
            known_as = f"{name}-{digest}" if table_name else name
            try:
                actions = new.trainer.actions(name, new.ids, set_size, new.vectors)
                play_with(new.trainer, name, actions, known_as, **new.describe())
            finally:
                if new.trainer is not self.trainer:
                    new.trainer.close()
        else:
            lists = self._lists(named, ids, unseen_ratio)
            drawn = {n: self.trainer.actions(n, chosen, set_size) for n, chosen in lists.items()}
            for name, actions in drawn.items():
                chosen = lists[name] if ids is not None else None
                known_as = name if chosen is None else f"{name}-{content_hash(chosen)[:8]}"
                play_with(self.trainer, name, actions, known_as)
        title = f"{self.path}, {self.checkpoint} checkpoint (update {self.step})"
        return Evaluation(title, rows, tuple(problems))

    def _row(
        self, trainer: Trainer, actions: Actions, episodes: int, seed: int, greedy: bool
    ) -> dict[str, Any]:
        start = time.perf_counter()
        played = measure(trainer.rollout, self.policy, actions, episodes, seed, greedy)
        growth = {"first_size": actions.first_size, "growth": actions.growth}
        numbers, selected = summarize(played), self.task.selection_metric
        first = {selected: numbers[selected]} if selected in numbers else {}
        return {
            "metrics": {**first, **numbers},
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
        ids: Mapping[str, ArrayLike] | None,
        unseen_ratio: float | None,
    ) -> dict[str, np.ndarray | None]:
        """By name, the actions to draw from; None for a part of the split."""
        if ids is not None:
            taken = {*SPLIT_NAMES, "all"}
            if not isinstance(ids, Mapping) or not ids or taken.intersection(ids):
                raise UsageError(
                    "ids are lists by name, such as {'mine': [1, 2, 3]}, at least one; names of "
                    f"parts of the split ({', '.join(sorted(taken))}) are taken."
                )
            return {name: np.asarray(listed) for name, listed in ids.items()}
        if unseen_ratio is not None:
            mixed = mixture_ids(self.split.train, self.split.test, unseen_ratio)
            return {f"unseen-{unseen_ratio:g}": mixed}
        return dict.fromkeys(parts or ("test",))

    def record(self, name: str, row: Mapping[str, Any], folder: Path | None = None) -> Path:
        """Keeps one result in the run directory, or in another folder; returns its file."""
        content = {"checkpoint": self.checkpoint, "step": self.step, "actions": name, **row}
        if folder is None:
            return RunDirectory.load(self.path).record_evaluation(file_stem(content), content)
        file = folder / f"{file_stem(content)}.json"
        write_json_atomically(file, {"run": str(self.path.absolute()), **content})
        return file

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


class Located(NamedTuple):
    """What a path to a run names.

    Attributes:
      path: the run directory.
      kind: of the checkpoint; None: the run itself was named.
      step: of the checkpoint; None: the newest of its kind.
    """

    path: Path
    kind: Kind | None = None
    step: int | None = None


def locate(path: Path | str) -> Located:
    """The run directory that `path` is, or the checkpoint in one, and nothing but what it names.

    Raises:
      UsageError: it is neither.
    """
    path = Path(path)
    if (path / "config.json").is_file():
        return Located(path)
    whole = path.resolve()
    run = next((folder for folder in whole.parents if (folder / "config.json").is_file()), None)
    if run is None:
        raise UsageError(
            f"{path} is neither a run directory nor a checkpoint in one (no config.json)."
        )
    inside = whole.relative_to(run).parts
    place, kind, step = (*inside, "", "")[:3]
    is_one = place == "checkpoints" and kind in KINDS and (step.isdecimal() or not step)
    if not is_one or len(inside) > 3 or not whole.is_dir():
        there = sorted(run.glob("checkpoints/*/*"))
        listed = ", ".join(str(p.relative_to(run)) for p in there if p.name.isdecimal())
        raise UsageError(
            f"{path} is no checkpoint of {run}; give the run itself or one of its checkpoints: "
            f"{listed or 'there are none'}."
        )
    return Located(run, cast(Kind, kind), int(step) if step else None)


def load_trainer(
    directory: RunDirectory,
    num_workers: int = 0,
    assignments: Assignments = (),
    task: Task | None = None,
) -> Trainer:
    """The parts of a run, from its directory alone; see `Run.load`."""
    try:
        config, task = read_train_config(directory.config, task)
    except ConfigError as err:
        raise ConfigError(f"{directory.path}: {err}") from err
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
