"""Studies of trained policies: one evaluation for each value of a condition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import (
    Domain,
    collect_observations,
    load_encoder,
    parse_representation,
)
from experiments.pipeline.evaluation import evaluate_on, record
from experiments.pipeline.training import Trainer, load_state, load_trainer
from experiments.reports.paper import PaperValue, paper_method, paper_results
from experiments.reports.runs import Group, Run, group_runs, read_runs
from experiments.reports.study_report import Study, StudyPoint
from jaxnew.actions import ActionSplit, mixture_ids
from jaxnew.task import Task


@dataclass(frozen=True)
class Condition:
    """How a run is evaluated: the name of the evaluation, its actions, and further arguments."""

    name: str
    ids: np.ndarray
    options: dict[str, Any]
    table: jnp.ndarray | None = None


Context = tuple[Trainer, ActionSplit, Path | None]


def _set_size(context: Context, value: float) -> Condition:
    _, split, _ = context
    return Condition("test", split.test, {"set_size": int(value)})


def _unseen_ratio(context: Context, value: float) -> Condition:
    trainer, split, _ = context
    size = trainer.config.ppo.rollout.set_size
    ids = mixture_ids(split.train, split.test, value)
    return Condition(f"unseen-{value:g}", ids, {"set_size": size})


def _growing_set(context: Context, value: float) -> Condition:
    trainer, split, _ = context
    size = trainer.config.ppo.rollout.set_size
    steps = trainer.evaluator.max_episode_steps
    growth = -(-(size - int(value)) // max(1, steps - 1))  # Complete at the last step.
    options = {"set_size": size, "first_size": int(value), "growth": growth}
    return Condition("test", split.test, options if value < size else {"set_size": size})


def _recordings(context: Context, value: float) -> Condition:
    trainer, split, encoder = context
    if encoder is None:
        raise flag.UsageError("--study=recordings needs --encoder=RUN, a run of embed.")
    table = trainer.table.at[jnp.asarray(split.test)].set(
        encoded_test_actions(encoder, split, int(value))
    )
    size = trainer.config.ppo.rollout.set_size
    return Condition(f"recordings-{int(value)}", split.test, {"set_size": size}, table)


@dataclass(frozen=True)
class _Kind:
    """A study of trained runs.

    Attributes:
      axis: what its values are.
      values: of the axis.
      condition: what a value means.
      note: below the table.
      paper_method: `(paper's name of the setting, value) ->` the paper's name of the point.
      figure: see `ActionStudy`.
    """

    axis: str
    values: Callable[[Task], Sequence[float]]
    condition: Callable[[Context, float], Condition]
    note: str
    has_log_axis: bool = False
    paper_method: Callable[[str, float], str] | None = None
    figure: str = ""


def _sizes(task: Task) -> list[float]:
    """10 to 60 by 5 (experiments spec 17), in proportion to the domain's sets of 50."""
    scale = task.stage_two["paper"].ppo.rollout.set_size / 50 if "paper" in task.stage_two else 1.0
    return [float(round(scale * size)) for size in range(10, 61, 5)]


def _first_sizes(task: Task) -> list[float]:
    sizes = _sizes(task)
    return [max(1.0, sizes[0] // 2), sizes[0], sizes[3], sizes[8]]


STUDIES = {
    "set-size": _Kind(
        "actions in a test set",
        _sizes,
        _set_size,
        "Test actions (experiments spec 17).",
        paper_method=lambda name, value: f"{name}[test_set_size={value:g}]",
    ),
    "unseen-ratio": _Kind(
        "share of unseen actions in the pool",
        lambda task: [0.0, 0.2, 0.4, 0.6, 0.8, 1.0],
        _unseen_ratio,
        "Sets drawn from a mixture of train and test actions (paper figure 9c, spec method 10).",
    ),
    "growing-set": _Kind(
        "actions at the first step",
        _first_sizes,
        _growing_set,
        "Test sets that begin with so many actions and grow by as many at every step as make them "
        "complete at the last one; the last value is the whole set from the start.",
    ),
    "recordings": _Kind(
        "recordings per test action",
        lambda task: [1024.0, 64.0, 16.0, 4.0, 1.0],
        _recordings,
        "Test actions encoded by the frozen encoder from their first recordings only.",
        has_log_axis=True,
    ),
}


def _kind_of(name: str, task: Task) -> _Kind:
    """A study of every task, or one of this task's own.

    Raises:
      UsageError: there is none of that name.
    """
    if name in STUDIES:
        return STUDIES[name]
    if name not in task.studies:
        listed = ", ".join([*STUDIES, *task.studies])
        raise flag.UsageError(f"Task {task.name} has no study {name!r}; choose one of {listed}.")
    study = task.studies[name]

    def condition(context: Context, value: float) -> Condition:
        trainer, _, _ = context
        size = trainer.config.ppo.rollout.set_size
        ids = study.ids(np.asarray(trainer.table), value)
        return Condition(f"{name}-{value:g}", ids, {"set_size": size})

    published = study.paper_method
    return _Kind(
        study.axis,
        lambda task: study.values,
        condition,
        study.note,
        # The rows of an analysis are those of its own policy, whatever the default's are called.
        paper_method=published and (lambda name, value: published(value)),
        figure=study.figure,
    )


def paper_point(kind: _Kind, group: Group, value: float) -> PaperValue | None:
    """The paper's point beside one of ours; None where it has none for the setting or the value."""
    name = _analysed(group) if kind.figure else group.paper_method
    if kind.paper_method is None or name is None or not group.is_default_split:
        return None
    wanted = kind.paper_method(name, value)
    for row in paper_results(str(group.paper_environment)):
        if (row.method, row.split) == (wanted, "test"):
            return PaperValue(row.mean, row.std, row.num_seeds)
    return None


def _analysed(group: Group) -> str | None:
    """`ours` for the one setting of the paper's analyses; their encoder had seen the whole universe
    (spec method 10), which is an oracle's.
    """
    if group.paper_environment is None or group.is_ours_alone:
        return None
    if group.config.get("conditions_position", False):
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
    """Evaluates runs under every condition of a study; what is there already is read.

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
    runs = [run for run in read_runs(paths) if run.is_policy]
    if not runs:
        raise flag.UsageError("Say which runs to study: --run=DIRECTORY[,DIRECTORY...].")
    groups = group_runs(runs)
    kind = _kind_of(name, groups[0].task)
    axis = [float(value) for value in values or kind.values(groups[0].task)]
    points = []
    for group in groups:
        by_run = [
            _evaluations(run.path, kind, axis, num_episodes, encoder, num_workers)
            for run in group.runs
        ]
        metric = group.task.selection_metric
        for index, value in enumerate(axis):
            means = np.array([rows[index]["metrics"][metric]["mean"] for rows in by_run])
            fewest = min(rows[index]["num_episodes"] for rows in by_run)
            paper = paper_point(kind, group, value)
            points.append(StudyPoint(group.label, value, means, fewest, paper))
    return Study(
        name,
        kind.axis,
        kind.has_log_axis,
        groups[0].metric,
        tuple(points),
        kind.note,
        kind.figure,
        groups[0].paper_environment or groups[0].task.name,
    )


def lacking_values(name: str, run: Run, task: Task, num_episodes: int) -> list[float]:
    """Values of one of the task's own studies for which a run still must be evaluated."""
    wanted = {"set_size": run.config["ppo"]["rollout"]["set_size"]}
    return [
        value
        for value in _kind_of(name, task).values(task)
        if not any(
            _is(e, Condition(f"{name}-{value:g}", np.zeros(0, np.int32), wanted), num_episodes)
            for e in run.evaluations
        )
    ]


def _evaluations(
    path: Path,
    kind: _Kind,
    axis: Sequence[float],
    num_episodes: int,
    encoder: Path | None,
    num_workers: int,
) -> list[dict[str, Any]]:
    """The evaluation of one run under each condition."""
    run, trainer, split = load_trainer(path, num_workers)
    (known,) = read_runs([path])
    rows = []
    with closing(trainer):
        state, step = load_state(run, trainer, "best")
        for value in axis:
            condition = kind.condition((trainer, split, encoder), value)
            found = [e for e in known.evaluations if _is(e, condition, num_episodes)]
            if found:
                rows.append(found[0])
                continue
            used = trainer if condition.table is None else replace(trainer, table=condition.table)
            row = evaluate_on(
                used,
                state,
                condition.name,
                condition.ids,
                split,
                num_episodes=num_episodes,
                **condition.options,
            )
            record(run, condition.name, "best", step, row)
            print(f"{path}: {kind.axis} {value:g} done in {row['seconds']} s", flush=True)
            rows.append(row)
    return rows


def _is(evaluation: dict[str, Any], condition: Condition, num_episodes: int) -> bool:
    """Whether an evaluation on record is the one that a condition asks for."""
    options = condition.options
    return (
        (evaluation["actions"], evaluation["checkpoint"]) == (condition.name, "best")
        and evaluation["policy"] == "sampled"
        and evaluation["num_episodes"] >= num_episodes
        and evaluation["set_size"] == options["set_size"]
        and evaluation.get("first_size", 0) == options.get("first_size", 0)
        and evaluation.get("growth", 0) == options.get("growth", 0)
    )


def encoded_test_actions(encoder: Path, split: ActionSplit, num_recordings: int) -> np.ndarray:
    """f32[n, d] test actions as a frozen encoder sees them in their first recordings.

    Raises:
      UsageError: the encoder has another split, or there are not so many recordings.
    """
    config, learner, state, _ = load_encoder(encoder)
    domain = Domain.of(flag.load_task(config.task), config.split)
    if config.split_hash != split.hash:
        raise flag.UsageError(f"{encoder} was trained with another split than the policy.")
    play = parse_representation(domain, config.representation).play
    folders = sorted(
        encoder.parent.glob(f"{play.folder}-*"), key=lambda p: int(p.name.rpartition("-")[2])
    )
    if not folders:
        raise flag.UsageError(
            f"There are no recordings beside {encoder}; run: python -m experiments.collect."
        )
    available = int(folders[-1].name.rpartition("-")[2])
    if not 1 <= num_recordings <= available:
        raise flag.UsageError(
            f"{num_recordings} recordings per action were asked for; {folders[-1]} has {available}."
        )
    recordings = collect_observations(domain, encoder.parent.parent, available, play)
    return learner.encode(state, recordings.for_encoding(split.test, num_recordings))
