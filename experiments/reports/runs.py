"""Run directories as the figures read them, grouped over seeds."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from experiments.reports.paper import (
    paper_environment,
    paper_figure_of_split,
    paper_method,
    paper_results,
    paper_set_size,
)
from experiments.reports.plots import Metric
from jaxnew.actions import ActionSplit
from jaxnew.embedding import SPLIT_FILE, TABLE_FILE
from jaxnew.finiteness import CAUSES, cause_of
from jaxnew.representation.table import RepresentationTable
from jaxnew.results import Question, on_record
from jaxnew.runs import is_sweep
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.config import differences, plain
from jaxnew.storage.metrics import read
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.places import UsageError
from jaxnew.task.settings import recorded_task, upgraded
from jaxnew.task.task import Task

# Fields that tell settings of one method and representation apart in a label, most telling first.
_LABEL_ORDER = (
    *("task", "environment_version", "split", "split_seed", "split_hash", "table_hash"),
    *("hyperparameters", "num_updates", "ppo", "sets", "environment"),
)
_LABEL_CHANGES = 2


@dataclass(frozen=True)
class RunRecord:
    """What one run directory holds; its files are read when they are first asked for.

    Attributes:
      path: the directory.
      config: its plain configuration in today's form.
    """

    path: Path
    config: dict[str, Any]

    @cached_property
    def reports(self) -> list[dict[str, Any]]:
        """The lines of `metrics.jsonl`.

        Raises:
          MetricsError: they are not those that were written.
        """
        checkpointer = Checkpointer(self.path / "checkpoints")
        has_latest = bool(checkpointer.steps("latest"))
        mark = checkpointer.metadata("latest").get("metrics") if has_latest else None
        return read(self.path, mark)

    @cached_property
    def evaluations(self) -> list[dict[str, Any]]:
        """What `Run.evaluate` recorded of its checkpoints as they are now.

        Raises:
          RunDirectoryError: a file is damaged.
        """
        return on_record(self.path)

    @cached_property
    def table(self) -> RepresentationTable | None:
        """Its representations; None if it was interrupted before it had them."""
        return RepresentationTable.load(self.path / TABLE_FILE) if self._has_inputs else None

    @cached_property
    def split(self) -> ActionSplit | None:
        """Its split, as `table`."""
        return ActionSplit.load(self.path / SPLIT_FILE) if self._has_inputs else None

    @property
    def _has_inputs(self) -> bool:
        return (self.path / TABLE_FILE).exists() and (self.path / SPLIT_FILE).exists()

    @property
    def is_policy(self) -> bool:
        """A run of `train` or a member of `sweep`; else one of `embed`."""
        return "ppo" in self.config

    @property
    def steps_per_update(self) -> int:
        """Environment steps of an update."""
        rollout = self.config["ppo"]["rollout"]
        return int(rollout["num_envs"] * rollout["num_steps"])

    @property
    def trained_steps(self) -> int:
        """Environment steps so far."""
        return self.steps_per_update * max((r["step"] for r in self.reports), default=0)

    @property
    def is_finished(self) -> bool:
        """All its updates are done."""
        return self.trained_steps >= self.config["num_updates"] * self.steps_per_update

    @property
    def representation(self) -> str:
        """`hvae`, `gt12`, ...: also where the run was given a directory or a file of vectors."""
        given = str(self.config["representation"])
        if Path(given).name == given and not given.endswith(".npz"):
            return given
        made = self.table.source.split(",")[0].removeprefix("engineered:") if self.table else ""
        return made if re.fullmatch(r"[\w-]+", made) else Path(given).stem

    def curve(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Environment steps and values f64[n] of an evaluated metric, e.g. `train/is_success`."""
        points = [(r["step"], r[name]) for r in self.reports if r.get(name) is not None]
        steps, values = np.array(points, np.float64).reshape(-1, 2).T
        return steps * self.steps_per_update, values

    def answer(self, question: Question, episodes: int = 1) -> dict[str, Any] | None:
        """The evaluation on record that answers a question with enough episodes; None without."""
        return next((e for e in self.evaluations if question.is_answered_by(e, episodes)), None)


@dataclass(frozen=True)
class Group:
    """Runs of `train` that differ in their seed only.

    Attributes:
      label: tells it from the other groups.
      task: of its runs.
      runs: ascending by seed.
    """

    label: str
    task: Task
    runs: tuple[RunRecord, ...]

    @property
    def config(self) -> dict[str, Any]:
        """Of the first run; the others differ in `seed`."""
        return self.runs[0].config

    @property
    def representation(self) -> str:
        """Of all its runs."""
        return self.runs[0].representation

    @property
    def paper_environment(self) -> str | None:
        """Where the paper reports on this task and representation; None if it does not."""
        return paper_environment(self.task.shown.paper_environment, self.representation)

    @property
    def place(self) -> str:
        """The paper's name of where the runs were, or the task's."""
        return self.paper_environment or self.task.name

    @property
    def paper_method(self) -> str | None:
        """What the paper calls this setting; None where it has no counterpart."""
        is_shown = self.is_default_split or self._paper_split is not None
        if self.paper_environment is None or not is_shown or self.is_ours_alone:
            return None
        conditioned = "conditioned_auxiliary" if self.config["conditions_position"] else ""
        of_split = self._paper_split[1] if self._paper_split else ""
        words = (self.task.shown.paper_variant, conditioned, of_split)
        variant = "_".join(word for word in words if word)
        return paper_method(self.config["method"], self.representation, variant)

    @property
    def is_ours_alone(self) -> bool:
        """Trained in a way that the paper has no bars of."""
        return (
            self.config["trained_on"] != "train"
            or bool(self.config["num_clusters"])
            or self.config["environment"] != plain(self.task.environment)
        )

    @property
    def is_default_split(self) -> bool:
        """Trained on the split that the task takes if none is named."""
        return bool(self.config["split"] == self.task.default_split)

    @property
    def paper_figure(self) -> str | None:
        """Where the rows of `paper_method` stand; None for the first figure that has them."""
        return self._paper_split[0] if self._paper_split else None

    @property
    def _paper_split(self) -> tuple[str, str] | None:
        """See `paper_figure_of_split`; None for the default split."""
        if self.is_default_split:
            return None
        return paper_figure_of_split(self.paper_environment, self.config["split"])

    @property
    def metric(self) -> Metric:
        """How the task's selection metric is shown."""
        if self.paper_environment is None:
            return Metric.of(self.task.selection_metric)
        published = paper_results(self.paper_environment)[0].metric
        return Metric.of(self.task.selection_metric, published)

    def standard(self, part: str) -> Question:
        """What the paper asked of such runs on a part of the split.

        Sets are of its size, or all that training had at once.
        """
        sets = self.config["sets"]
        if sets["is_fixed"] and part == self.config["trained_on"]:
            return Question(part, None)
        return Question(part, paper_set_size(self.paper_environment, part, int(sets["size"])))


def read_runs(paths: Sequence[Path]) -> list[RunRecord]:
    """The runs at `paths`; a sweep stands for its members, a path given twice counts once.

    Raises:
      UsageError: no path, or one of a kind that has no figures.
      RunDirectoryError: a path is no run directory, or it is damaged.
    """
    runs: dict[Path, RunRecord] = {}
    for path in paths:
        for run_path in _members(path) or [path]:
            config = RunDirectory.load(run_path).config
            if "representation" not in config or not ("ppo" in config or "model" in config):
                raise UsageError(
                    f"{run_path} is no run of train, sweep or embed, so there is nothing to draw."
                )
            runs.setdefault(run_path.resolve(), RunRecord(run_path, upgraded(config)))
    if not runs:
        raise UsageError("Say which runs: --run=DIRECTORY[,DIRECTORY...].")
    return list(runs.values())


def _members(path: Path) -> list[Path]:
    """The member directories of a sweep; none of another run."""
    if not is_sweep(RunDirectory.load(path)):
        return []
    members = sorted(p.parent for p in path.glob("members/*/config.json"))
    if not members:
        raise UsageError(f"The sweep {path} has written no members yet; run it to its end.")
    return [member for member in members if not _has_diverged(member)]


@cache
def _has_diverged(member: Path) -> bool:
    """Whether a member of a sweep diverged, which is said once."""
    cause = next(filter(None, map(cause_of, read(member))), None)
    if cause is not None:
        print(f"{member} is left out: {CAUSES[cause][0].lower()}, so that it diverged.")
    return cause is not None


def policies(paths: Sequence[Path]) -> list[RunRecord]:
    """Those of `read_runs` that are of policies.

    Raises:
      UsageError: there is none, or see `read_runs`.
    """
    found = [run for run in read_runs(paths) if run.is_policy]
    if not found:
        raise UsageError(f"This needs a run of train; {', '.join(map(str, paths))} are of embed.")
    return found


def group_runs(runs: Sequence[RunRecord]) -> list[Group]:
    """Runs of `train` with equal configurations but for the seed, in the order given.

    Raises:
      UsageError: two runs of a group have the same seed, so that they are not two samples.
    """
    by_config: dict[str, list[RunRecord]] = {}
    for run in runs:
        key = json.dumps({**run.config, "seed": None}, sort_keys=True)
        by_config.setdefault(key, []).append(run)
    groups = []
    for members in by_config.values():
        members.sort(key=lambda run: run.config["seed"])
        for one, other in pairwise(members):
            if one.config["seed"] == other.config["seed"]:
                raise UsageError(
                    f"{one.path} and {other.path} are the same setting with the same seed, "
                    f"{one.config['seed']}; give one of them."
                )
        first = members[0]
        label = f"{first.config['method']}, {first.representation}"
        groups.append(Group(label, recorded_task(first.config), tuple(members)))
    return with_distinct_labels(groups)


def with_distinct_labels(groups: list[Group]) -> list[Group]:
    """The groups; those of one label get values in which they differ appended to it."""
    labelled: list[Group] = []
    for group in groups:
        others = [other for other in groups if other.label == group.label and other is not group]
        changes: dict[str, Any] = {}
        for other in others:
            changes |= {name: value for name, value, _ in differences(group.config, other.config)}
        if "table_hash" in changes and group.runs[0].table is not None:
            changes["table_hash"] = f"({group.runs[0].table.source})"
        names = [name for name in changes if name != "seed" and not name.startswith("loop.")]
        ranks = {group: rank for rank, group in enumerate(_LABEL_ORDER)}
        names.sort(key=lambda name: ranks.get(name.partition(".")[0], len(ranks)))
        words = [f"{name.rpartition('.')[2]} {changes[name]}" for name in names[:_LABEL_CHANGES]]
        label = ", ".join([group.label, *words])
        number = 1 + sum(done.label.partition(" #")[0] == label for done in labelled)
        labelled.append(replace(group, label=f"{label} #{number}" if number > 1 else label))
    return labelled
