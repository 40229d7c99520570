"""What `analyze` studies: conditions of evaluation, and grids of hyper-parameters."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments import _flags as flag
from experiments import _plots as plots
from experiments._artifacts import (
    Domain,
    collect_observations,
    load_encoder,
    parse_representation,
)
from experiments._evaluation import evaluate_on, record
from experiments._methods import file_name
from experiments._paper import paper_value
from experiments._plots import Metric
from experiments._production import Job, Source, duration, training_seconds
from experiments._runs import Group, group_runs, read_runs
from experiments._training import Trainer, load_state, load_trainer
from jaxnew.actions import ActionSplit, mixture_ids
from jaxnew.task import Task


@dataclass(frozen=True)
class StudyPoint:
    """One condition of one setting.

    Attributes:
      setting: label of the runs, which differ in their seed only.
      x: place on the horizontal axis.
      means: f64[n] of each seed.
      num_episodes: per seed; 0 for the best evaluation during training.
      paper: the paper's mean, or None.
    """

    setting: str
    x: float
    means: np.ndarray
    num_episodes: int
    paper: float | None = None


@dataclass(frozen=True)
class Study:
    """Points, and what they are.

    Attributes:
      name: of the study.
      axis: what `StudyPoint.x` is.
      has_log_axis: whether it is drawn on a logarithmic scale.
      metric: how the means are shown.
      note: below the table.
    """

    name: str
    axis: str
    has_log_axis: bool
    metric: Metric
    points: tuple[StudyPoint, ...]
    note: str


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
      paper_method: see `ActionStudy`.
    """

    axis: str
    values: Callable[[Task], Sequence[float]]
    condition: Callable[[Context, float], Condition]
    note: str
    has_log_axis: bool = False
    paper_method: Callable[[float], str] | None = None


def _sizes(task: Task) -> list[float]:
    """10 to 60 by 5 (experiments spec 17), in proportion to the domain's sets of 50."""
    scale = task.stage_two["paper"].ppo.rollout.set_size / 50 if "paper" in task.stage_two else 1.0
    return [float(round(scale * size)) for size in range(10, 61, 5)]


def _first_sizes(task: Task) -> list[float]:
    sizes = _sizes(task)
    return [max(1.0, sizes[0] // 2), sizes[0], sizes[3], sizes[8]]


STUDIES = {
    "set-size": _Kind(
        "actions in a test set", _sizes, _set_size, "Test actions (experiments spec 17)."
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

    return _Kind(
        study.axis, lambda task: study.values, condition, study.note, False, study.paper_method
    )


def _paper_mean(kind: _Kind, group: Group, value: float) -> float | None:
    if kind.paper_method is None or group.paper_environment is None:
        return None
    found = paper_value(group.paper_environment, kind.paper_method(value), "test")
    return None if found is None else found.mean


def study_runs(
    name: str,
    paths: Sequence[Path],
    values: Sequence[float],
    num_episodes: int,
    encoder: Path | None = None,
) -> Study:
    """Evaluates runs under every condition of a study; what is there already is read.

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
        by_run = [_evaluations(run.path, kind, axis, num_episodes, encoder) for run in group.runs]
        metric = group.task.selection_metric
        for index, value in enumerate(axis):
            means = np.array([rows[index]["metrics"][metric]["mean"] for rows in by_run])
            fewest = min(rows[index]["num_episodes"] for rows in by_run)
            paper = _paper_mean(kind, group, value)
            points.append(StudyPoint(group.label, value, means, fewest, paper))
    return Study(name, kind.axis, kind.has_log_axis, groups[0].metric, tuple(points), kind.note)


def _evaluations(
    path: Path, kind: _Kind, axis: Sequence[float], num_episodes: int, encoder: Path | None
) -> list[dict[str, Any]]:
    """The evaluation of one run under each condition."""
    run, trainer, split = load_trainer(path)
    state, step = load_state(run, trainer, "best")
    (known,) = read_runs([path])
    rows = []
    with closing(trainer):
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


# ---- Search grids ----

# Values searched by the paper (appendix, "Hyperparameter Search").
GRIDS: dict[str, tuple[float, ...]] = {
    "entropy": (0.0001, 0.001, 0.005, 0.01, 0.05, 0.1),
    "batch-size": (1024, 2048, 3072, 4096),
}


def search(name: str, seeds: Sequence[int], steps: float, values: Sequence[float]) -> Study:
    """Trains every value of a grid with every seed; the best by validation is named.

    The entropy coefficient is traced, so that all values are one program; a batch size is a shape,
    so that every value is a program of its own.
    """
    task = flag.load_task(flag.TASK.value)
    domain = Domain.of(task, flag.SPLIT.value)
    source = Source(
        domain=domain,
        folder=Path(flag.RUNS.value),
        budget=flag.BUDGET.value,
        stage_one=flag.BUDGET.value,
        steps=steps,
        seeds=tuple(seeds),
        assignments=tuple(flag.SET.value),
        given={},
    )
    grid = tuple(values or GRIDS[name])
    make = _entropy_groups if name == "entropy" else _batch_size_groups
    groups = make(source, grid)
    points = [
        StudyPoint(group.label.split(",")[0], value, best_validations(group), 0)
        for value, group in groups
    ]
    best = max(points, key=lambda point: float(point.means.mean()))
    axis = {"entropy": "entropy coefficient", "batch-size": "transitions per minibatch"}[name]
    note = (
        f"Best evaluation on validation sets during training, mean over {len(seeds)} seeds. Chosen "
        f"by it: {axis} {best.x:g}."
    )
    return Study(name, axis, name == "entropy", groups[0][1].metric, tuple(points), note)


def best_validations(group: Group) -> np.ndarray:
    """f64[n] the best value on validation sets of each run."""
    name = f"validation/{group.task.selection_metric}"
    return np.array([run.curve(name)[1].max() for run in group.runs])


def _entropy_groups(source: Source, grid: Sequence[float]) -> list[tuple[float, Group]]:
    listed = ",".join(f"{value:g}" for value in grid)
    groups = _searched(source, "entropy", len(grid), f"--vary=entropy_coefficient={listed}")
    return [(g.config["hyperparameters"]["entropy_coefficient"], g) for g in groups]


def _batch_size_groups(source: Source, grid: Sequence[float]) -> list[tuple[float, Group]]:
    """Longer rollouts make larger minibatches; environment steps stay the same."""
    preset = source.budget_of(flag.METHOD.value)
    steps = source.steps or float(preset.num_updates * preset.ppo.steps_per_update)
    num_envs = preset.ppo.rollout.num_envs
    found = []
    for value in grid:
        num_steps, rest = divmod(int(value) * preset.ppo.num_minibatches, num_envs)
        if rest or not num_steps:
            raise flag.UsageError(
                f"Minibatches of {value:g} are no whole number of steps: a rollout of {num_envs} "
                f"environments is cut into {preset.ppo.num_minibatches}."
            )
        assignments = (*source.assignments, f"ppo.rollout.num_steps={num_steps}")
        own = replace(source, steps=steps, assignments=assignments)
        (group,) = _searched(own, f"batch-size-{value:g}", 1)
        found.append((value, group))
    return found


def _searched(source: Source, name: str, num_values: int, *options: str) -> list[Group]:
    """The groups of one search program, trained now unless it is there."""
    method, representation = flag.METHOD.value, flag.REPRESENTATION.value
    budget = source.budget_of(method)
    listed = ",".join(map(str, source.seeds))
    stem = f"search-{name}-{file_name(method)}-{Path(representation).stem}-{source.budget}"
    digits = f"{budget.num_updates}-{listed.replace(',', '-')}"
    folder = source.domain.folder(source.folder) / f"{stem}-{digits}"
    command = (
        "sweep",
        f"--task={flag.TASK.value}",
        f"--split={source.domain.split_name}",
        f"--method={method}",
        f"--representation={representation}",
        f"--budget={source.budget}",
        f"--seeds={listed}",
        f"--runs={source.folder}",
        f"--workdir={folder}",
        *options,
        *(f"--set={assignment}" for assignment in source.assignments),
        f"--set=num_updates={budget.num_updates}",
    )
    num_runs = num_values * len(source.seeds)
    steps = num_runs * budget.num_updates * budget.ppo.steps_per_update
    seconds = training_seconds(source, method, steps, num_runs)
    if not (folder / "members").exists():
        Job(f"{num_runs} runs in one program", command, duration(seconds), seconds).run()
    if not (folder / "members").exists():
        raise flag.UsageError(f"{folder} is not finished; call the same command again to go on.")
    return group_runs(read_runs([folder]))


# ---- Tables and pictures ----


def as_csv(study: Study) -> str:
    """One line per setting, value and seed."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["study", "setting", study.axis, "mean", "std", "num_seeds", "num_episodes", "paper"]
    )
    for point in study.points:
        numbers = [float(point.means.mean()), float(point.means.std()), len(point.means)]
        paper = "" if point.paper is None else point.paper
        writer.writerow([study.name, point.setting, point.x, *numbers, point.num_episodes, paper])
    return text.getvalue()


def as_markdown(study: Study) -> str:
    """A row per value, a column per setting."""
    settings = list(dict.fromkeys(point.setting for point in study.points))
    lines = [f"# {study.name}: {study.metric.name.lower()}", ""]
    has_paper = any(point.paper is not None for point in study.points)
    headings = [study.axis, *settings, *(["paper"] if has_paper else [])]
    lines.append("| " + " | ".join(headings) + " |")
    lines.append("|" + " --- |" * len(headings))
    for x in dict.fromkeys(point.x for point in study.points):
        cells = [f"{x:g}"]
        for setting in settings:
            (point,) = [p for p in study.points if (p.x, p.setting) == (x, setting)]
            mean, std = study.metric.text(point.means.mean()), study.metric.text(point.means.std())
            cells.append(f"{mean} ± {std}" if len(point.means) > 1 else mean)
        if has_paper:
            papers = [p.paper for p in study.points if p.x == x and p.paper is not None]
            cells.append(study.metric.text(papers[0]) if papers else "-")
        lines.append("| " + " | ".join(cells) + " |")
    seeds = sorted({len(point.means) for point in study.points})
    episodes = sorted({point.num_episodes for point in study.points})
    of_each = f", {episodes[0]:,} episodes each" if episodes[0] else ""
    lines += ["", f"{study.note} Seeds: {', '.join(map(str, seeds))}{of_each}; ± is the population"]
    lines[-1] += " standard deviation over seeds."
    return "\n".join(lines) + "\n"


def study_figure(study: Study) -> Figure:
    """Mean and deviation over seeds against the axis, a line per setting."""
    figure = plots.new_figure(5.4, 4.0)
    axes = figure.subplots()
    settings = list(dict.fromkeys(point.setting for point in study.points))
    for color, setting in zip(plots.hls_palette(len(settings)), settings, strict=True):
        points = sorted((p for p in study.points if p.setting == setting), key=lambda p: p.x)
        y = study.metric.scale * np.array([point.means.mean() for point in points])
        error = study.metric.scale * np.array([point.means.std() for point in points])
        x = [point.x for point in points]
        axes.errorbar(x, y, yerr=error, color=color, marker="o", capsize=2.5, label=setting)
    published = sorted({(p.x, p.paper) for p in study.points if p.paper is not None})
    if published:
        places, means = np.array(published).T
        scaled = study.metric.scale * means
        axes.plot(places, scaled, color=plots.INK, linestyle="--", marker=".", label="paper")
    if study.has_log_axis:
        axes.set_xscale("log")
    axes.set_ylim(0.0, None)
    axes.set_xlabel(study.axis.capitalize(), fontsize=9, color=plots.INK)
    axes.set_ylabel(study.metric.name, fontsize=9, color=plots.INK)
    plots.tidy(axes)
    figure.legend(loc="outside lower center", ncols=2, **plots.LEGEND)
    plots.set_title(figure, study.name.replace("-", " ").capitalize())
    return figure
