"""The evaluations of runs as a table, beside the paper's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from experiments.reports import tables
from experiments.reports.paper import paper_steps, paper_value
from experiments.reports.plots import Metric
from experiments.reports.runs import Group, RunRecord
from jaxnew.actions import SPLIT_NAMES
from jaxnew.evaluation import EVALUATION_SEED
from jaxnew.results import question_of

RANDOM_PLAY = "random-play"  # What `demo` records in place of a checkpoint.


@dataclass(frozen=True)
class ResultRow:
    """One evaluated set of actions of one setting, beside the paper's number.

    Attributes:
      setting: label of the group.
      task, method, representation: of the runs.
      actions: what the sets were drawn from: train, validation, test, ...
      checkpoint, policy, set_size: what was evaluated, and on how many actions.
      evaluation_seed: of the episodes.
      is_standard: evaluated as the paper does: sampled actions of the checkpoint that was chosen by
        validation, on sets of the paper's size.
      metric: the episode metric.
      mean: jaxnew's; over seeds if there are several.
      low, high: ends of its error bar.
      error: what the error bar is.
      num_seeds, num_episodes: jaxnew's; episodes per seed.
      checkpoint_steps, trained_steps: environment steps of the evaluated checkpoint and of the
        run; means over the seeds.
      paper_method, paper_mean, paper_std, paper_num_seeds, paper_steps: the paper's number, None
        where it has none for this setting.
      difference: jaxnew's minus the paper's, in points (hundredths) for shares, else plain.
      runs: the directories.
    """

    setting: str
    task: str
    method: str
    representation: str
    actions: str
    checkpoint: str
    policy: str
    set_size: int
    evaluation_seed: int
    is_standard: bool
    metric: str
    mean: float
    low: float
    high: float
    error: str
    num_seeds: int
    num_episodes: int
    checkpoint_steps: float
    trained_steps: float
    paper_method: str | None
    paper_mean: float | None
    paper_std: float | None
    paper_num_seeds: int | None
    paper_steps: float | None
    difference: float | None
    runs: tuple[str, ...]


def result_rows(group: Group) -> list[ResultRow]:
    """Every evaluation of the group's runs, over the seeds that have it."""
    found: dict[tuple[Any, ...], list[tuple[RunRecord, dict[str, Any]]]] = {}
    for run in group.runs:
        for e in run.evaluations:
            if group.task.selection_metric in e["metrics"]:
                found.setdefault(question_of(e), []).append((run, e))
    rows = [_result_row(group, evaluations) for evaluations in found.values()]
    return sorted(
        rows,
        key=lambda r: (
            not r.is_standard,
            r.checkpoint,
            SPLIT_NAMES.index(r.actions) if r.actions in SPLIT_NAMES else len(SPLIT_NAMES),
        ),
    )


def _result_row(group: Group, evaluations: list[tuple[RunRecord, dict[str, Any]]]) -> ResultRow:
    """One row from the same evaluation of each seed."""
    runs = [run for run, _ in evaluations]
    first = evaluations[0][1]
    numbers = [e["metrics"][group.task.selection_metric] for _, e in evaluations]
    means = np.array([n["mean"] for n in numbers])
    mean, std = float(means.mean()), float(means.std())
    if len(runs) > 1:
        low, high, error = mean - std, mean + std, "population std over seeds"
    else:
        low, high = numbers[0]["low"], numbers[0]["high"]
        error = "95 % interval over episodes"
    part, method, environment = first["actions"], group.paper_method, str(group.paper_environment)
    is_standard = part in SPLIT_NAMES and group.standard(part).is_answered_by(first)
    paper = None
    if is_standard and part in ("train", "test") and method is not None:
        paper = paper_value(environment, method, part, group.paper_figure)
    return ResultRow(
        setting=group.label,
        task=group.task.name,
        method=group.config["method"],
        representation=runs[0].representation,
        actions=part,
        checkpoint=first["checkpoint"],
        policy=first["policy"],
        set_size=first["set_size"],
        evaluation_seed=first.get("evaluation_seed", EVALUATION_SEED),
        is_standard=is_standard,
        metric=group.task.selection_metric,
        mean=mean,
        low=low,
        high=high,
        error=error,
        num_seeds=len(runs),
        num_episodes=min(e["num_episodes"] for _, e in evaluations),
        checkpoint_steps=float(
            np.mean([e["step"] * run.steps_per_update for run, e in evaluations])
        ),
        trained_steps=float(np.mean([run.trained_steps for run in runs])),
        paper_method=paper and method,
        paper_mean=paper and paper.mean,
        paper_std=paper and paper.std,
        paper_num_seeds=paper and paper.num_seeds,
        paper_steps=paper and paper_steps(environment),
        difference=paper and group.metric.scale * (mean - paper.mean),
        runs=tuple(str(run.path) for run in runs),
    )


def as_csv(rows: Sequence[ResultRow]) -> str:
    """The rows with all fields; an unknown number is empty, `;` stands between several runs."""
    plain = [{**asdict(row), "runs": ";".join(row.runs)} for row in rows]
    return tables.csv_text(plain, [f.name for f in fields(ResultRow)])


def as_markdown(title: str, rows: Sequence[ResultRow], metric: Metric, notes: Sequence[str]) -> str:
    """The rows for reading, and what their numbers are."""
    header = ["setting", "actions", "policy", "jaxnew", "paper", "difference", "seeds"]
    header += ["episodes", "steps (million)", "run"]
    points = ", in percentage points" if metric.unit == "%" else ""
    lines = [
        *(f"# {title}: {metric.name.lower()}", ""),
        *tables.table(header, [_cells(row, metric) for row in rows]),
        "",
        "jaxnew: [low, high] is the 95 % interval over the episodes of one run; ± is the "
        "population standard deviation over seeds, as in the paper, whose numbers are 5,000 "
        "sampled episodes per seed. Seeds and steps: jaxnew's / the paper's; episodes are per "
        "seed. Steps are those that a run was trained for; the checkpoint is the best one by "
        f"validation. Difference: jaxnew's minus the paper's{points}.",
        *(f"\n{note}" for note in notes),
    ]
    return "\n".join(lines) + "\n"


def _cells(row: ResultRow, metric: Metric) -> list[str]:
    """A row for reading."""
    is_random = row.checkpoint == RANDOM_PLAY
    error = f"[{metric.text(row.low)}, {metric.text(row.high)}]"
    if row.num_seeds > 1:
        error = f"± {metric.text(row.high - row.mean)}"
    paper = difference = "-"
    is_usual = row.evaluation_seed == EVALUATION_SEED
    policy = f"{row.policy}, {row.checkpoint}{f', seed {row.evaluation_seed}' * (not is_usual)}"
    seeds, steps = str(row.num_seeds), "-" if is_random else f"{1e-6 * row.trained_steps:.3g}"
    if row.paper_mean is not None and row.paper_std is not None and row.paper_steps is not None:
        paper = f"{metric.text(row.paper_mean)} ± {metric.text(row.paper_std)}"
        difference = f"{row.difference:+.1f}" if metric.unit == "%" else f"{row.difference:+.3f}"
        seeds += f" / {row.paper_num_seeds}"
        steps += f" / {1e-6 * row.paper_steps:.3g}"
    return [
        row.setting,
        f"{row.actions}, sets of {row.set_size}",
        "random play" if is_random else policy,
        f"{metric.text(row.mean)} {error}",
        *(paper, difference, seeds),
        f"{row.num_episodes:,}",
        steps,
        "<br>".join(row.runs),
    ]
