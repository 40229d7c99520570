"""Studies of trained policies: one question for each value of a condition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.reports.asking import Asked, answers_of
from experiments.reports.paper import PaperValue, paper_method, paper_results
from experiments.reports.runs import Group, RunRecord, group_runs, policies
from experiments.reports.study_report import Study, StudyPoint
from jaxnew.actions import ActionIdentity, ActionSplit
from jaxnew.embedding import Encoder
from jaxnew.recording import collect, parse_representation
from jaxnew.representation.table import RepresentationTable
from jaxnew.results import Question
from jaxnew.run import Run
from jaxnew.task.places import UsageError
from jaxnew.task.presentation import ActionStudy
from jaxnew.task.settings import read_train_config, with_settings
from jaxnew.task.task import Task

NAMES = ("set-size", "unseen-ratio", "growing-set", "recordings")  # Of those for every task.


@dataclass(frozen=True)
class StudyKind:
    """A study of trained runs.

    Attributes:
      axis: what its values are.
      values: of the axis.
      asked: what a value asks of a run.
      note: below the table.
      has_log_axis: see `Study`.
      paper_method: `(paper's name of the setting, value) ->` the paper's name of the point.
      figure: see `ActionStudy`.
    """

    axis: str
    values: Sequence[float]
    asked: Callable[[RunRecord, float], Asked]
    note: str
    has_log_axis: bool = False
    paper_method: Callable[[str, float], str] | None = None
    figure: str = ""


def kind_of(name: str, task: Task, encoder: Path | None = None) -> StudyKind:
    """A study of every task, or one of this task's own.

    Args:
      encoder: run of `embed`, for the study of recordings.

    Raises:
      UsageError: there is none of that name.
    """
    # 10 to 60 by 5, as in the release, in proportion to the domain's sets of 50.
    scale = task.stage_two["paper"].sets.size / 50 if "paper" in task.stage_two else 1.0
    sizes = [float(round(scale * size)) for size in range(10, 61, 5)]
    if name == "set-size":
        return StudyKind(
            "actions in a test set",
            sizes,
            lambda record, value: Asked.part(Question("test", int(value))),
            "Test actions.",
            paper_method=lambda name, value: f"{name}[test_set_size={value:g}]",
        )
    if name == "unseen-ratio":
        return StudyKind(
            "share of unseen actions in the pool",
            [0.0, 0.2, 0.4, 0.6, 0.8, 1.0],
            _unseen_ratio,
            "Sets drawn from a mixture of train and test actions (paper figure 9c).",
        )
    if name == "growing-set":
        return StudyKind(
            "actions at the first step",
            [max(1.0, sizes[0] // 2), sizes[0], sizes[3], sizes[8]],
            partial(_growing_set, task),
            "Test sets that begin with so many actions and grow by as many at every step as make "
            "them complete at the last one; the last value is the whole set from the start.",
        )
    if name == "recordings":
        every = _recordings_beside(Encoder.load(encoder)) if encoder else 1024
        return StudyKind(
            "recordings per test action",
            [float(every), *(number for number in (64.0, 16.0, 4.0, 1.0) if number < every)],
            partial(_recordings, encoder),
            "Test actions encoded by the frozen encoder from their first recordings only.",
            has_log_axis=True,
        )
    own = task.shown.studies
    if name not in own:
        listed = ", ".join([*NAMES, *own])
        raise UsageError(f"Task {task.name} has no study {name!r}; choose one of {listed}.")
    published = own[name].paper_method
    return StudyKind(
        own[name].axis,
        own[name].values,
        partial(_own_study, name, own[name]),
        own[name].note,
        # The rows of an analysis are those of its own policy, whatever the default's are called.
        paper_method=published and (lambda _, value: published(value)),
        figure=own[name].figure,
    )


def _usual(record: RunRecord) -> int:
    """Actions in the sets of a run's training."""
    return int(record.config["sets"]["size"])


def _unseen_ratio(record: RunRecord, value: float) -> Asked:
    question = Question(f"unseen-{value:g}", _usual(record))
    return Asked(question, lambda run: {"unseen_ratio": value})


def _growing_set(task: Task, record: RunRecord, value: float) -> Asked:
    size = _usual(record)
    if value >= size:
        return Asked.part(Question("test", size))
    config, task = read_train_config(record.config, task)
    task = with_settings(task, config)
    if task.host is not None:
        steps = task.host.max_episode_steps(task.environment)
    else:
        env = task.environment_of()
        steps = env.max_episode_steps(env.default_params)
    growth = -(-(size - int(value)) // max(1, steps - 1))  # Complete at the last step.
    return Asked.part(Question("test", size, int(value), growth))


def _recordings(encoder: Path | None, record: RunRecord, value: float) -> Asked:
    if encoder is None:
        raise UsageError("--study=recordings needs --encoder=RUN, a run of embed.")

    def table(run: Run) -> dict[str, Any]:
        return {"table": encoded_test_actions(encoder, run.split, int(value))}

    name = f"recordings-{int(value)}-{Encoder.load(encoder).table.hash[:8]}"
    return Asked(Question(name, _usual(record)), table)


def _own_study(name: str, study: ActionStudy, record: RunRecord, value: float) -> Asked:
    title = f"{name}-{value:g}"

    def ids(run: Run) -> dict[str, Any]:
        return {"ids": {title: study.ids(np.asarray(run.trainer.training.table), value)}}

    return Asked(Question(title, _usual(record)), ids)


def paper_point(kind: StudyKind, group: Group, value: float) -> PaperValue | None:
    """The paper's point beside one of ours; None where it has none for the setting or the value."""
    name = _analysed(group) if kind.figure else group.paper_method
    if kind.paper_method is None or name is None or not group.is_default_split:
        return None
    wanted = kind.paper_method(name, value)
    for row in paper_results(str(group.paper_environment)):
        if (row.method, row.split) == (wanted, "test"):
            return row.value
    return None


def _analysed(group: Group) -> str | None:
    """`ours` for the one setting of the paper's analyses, whose encoder was an oracle
    (docs/create.md, "Analysis").
    """
    is_other = group.is_ours_alone or group.config["conditions_position"]
    if group.paper_environment is None or is_other:
        return None
    name = paper_method(group.config["method"], group.representation.removesuffix("-oracle"))
    return name if name == "ours" else None


def study_runs(
    name: str,
    paths: Sequence[Path],
    values: Sequence[float],
    num_episodes: int,
    encoder: Path | None = None,
    num_workers: int = 0,
) -> Study:
    """Asks runs about every value of a study; what is there already is read.

    Args:
      name: of the study.
      paths: the runs.
      values: of the axis; none for the study's own.
      num_episodes: of each evaluation.
      encoder: run of `embed`, for the study of recordings.
      num_workers: processes for environments on the host; 0: one per core.

    Raises:
      UsageError: no runs, or not those that the study needs.
    """
    groups = group_runs(policies(paths))
    first = groups[0]
    kind = kind_of(name, first.task, encoder)
    axis = [float(value) for value in values or kind.values]
    points = []
    for group in groups:
        rows = []
        for run in group.runs:
            asked = [kind.asked(run, value) for value in axis]
            rows.append(answers_of(run, asked, num_episodes, num_workers))
        metric = group.task.selection_metric
        for value, of_value in zip(axis, zip(*rows, strict=True), strict=True):
            means = np.array([row["metrics"][metric]["mean"] for row in of_value])
            fewest = min(row["num_episodes"] for row in of_value)
            paper = paper_point(kind, group, value)
            points.append(StudyPoint(group.label, value, means, fewest, paper))
    about = (kind.note, kind.figure, first.place)
    return Study(name, kind.axis, kind.has_log_axis, first.metric, tuple(points), *about)


def _recordings_beside(encoder: Encoder) -> int:
    """How many recordings per action lie beside an encoder.

    Raises:
      UsageError: none.
    """
    play = parse_representation(encoder.domain(), encoder.config.representation).play
    folders = encoder.path.parent.glob(f"{play.folder}-*")
    sizes = [int(folder.name.rpartition("-")[2]) for folder in folders]
    if not sizes:
        raise UsageError(
            f"There are no recordings beside {encoder.path}; run: python -m experiments.collect."
        )
    return max(sizes)


def encoded_test_actions(
    encoder: Path, split: ActionSplit, num_recordings: int
) -> RepresentationTable:
    """Test actions as a frozen encoder sees them in their first recordings.

    Raises:
      UsageError: the encoder has another split, or there are not so many recordings.
    """
    trained = Encoder.load(encoder)
    if trained.config.split_hash != split.hash:
        raise UsageError(f"{encoder} was trained with another split than the policy.")
    learner, weights, play = trained.frozen()
    every = _recordings_beside(trained)
    if not 1 <= num_recordings <= every:
        raise UsageError(
            f"{num_recordings} recordings per action were asked for; {encoder.parent} has {every}."
        )
    domain = trained.domain()
    recordings = collect(domain, encoder.parent.parent, every, play)
    return RepresentationTable(
        vectors=learner.encode(weights, recordings.for_encoding(split.test, num_recordings)),
        ids=split.test,
        encoder_hash=trained.table.made_by,
        identity=ActionIdentity.of(domain.universe, split.test),
    )
