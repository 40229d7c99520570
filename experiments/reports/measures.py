"""Which measure of a representation table foretells what a policy makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.reports import plots, tables
from experiments.reports.asking import Asked, answers_of
from experiments.reports.plots import Metric
from experiments.reports.runs import RunRecord, group_runs, policies
from jaxnew.embedding import table_report
from jaxnew.representation.report import measures
from jaxnew.results import Question
from jaxnew.storage.config import differences
from jaxnew.task.places import UsageError
from jaxnew.task.task import Task

NAME = "measures"
_OF_TABLES = ("representation", "table_hash", "split_seed", "split_hash", "seed")


@dataclass(frozen=True)
class MeasuredTable:
    """A table, and the policy that was trained on it.

    Attributes:
      name: directory of the policy's run.
      split_seed: of its split.
      measures: by name, see `jaxnew.representation.report.measures`; NaN where there is none.
      success: of the policy on test actions.
    """

    name: str
    split_seed: int
    measures: dict[str, float]
    success: float


def study_measures(
    paths: Sequence[Path], episodes: int, out: Path, num_workers: int = 0
) -> list[Path]:
    """Prints and draws test success against every measure of the runs' tables.

    Args:
      paths: runs of `train` or `sweep` that differ in their tables, split seeds and seeds only.
      episodes: at least so many of each evaluation.
      out: where the picture and the tables are written.
      num_workers: processes for environments on the host; 0: one per core.

    Raises:
      UsageError: the runs differ in more.
    """
    records = policies(paths)
    for record in records:
        for name, value, first in differences(record.config, records[0].config):
            if name not in _OF_TABLES:
                raise UsageError(
                    f"{record.path} has {name}={value} and {records[0].path} {first}; give runs "
                    "that differ in their tables, split seeds and seeds only."
                )
    (group,) = group_runs(records[:1])
    found = [measured(record, group.task, episodes, num_workers) for record in records]
    found.sort(key=lambda table: (table.split_seed, -table.success))
    text = as_markdown(found, group.metric, episodes)
    print(text)
    rows = [
        {"run": table.name, "split_seed": table.split_seed, **table.measures, "test": table.success}
        for table in found
    ]
    written = tables.write(out, NAME, text, tables.csv_text(rows))
    return [*plots.save(figure_of(found, group.metric), out / f"{NAME}.png"), *written]


def measured(record: RunRecord, task: Task, episodes: int, num_workers: int) -> MeasuredTable:
    """What a run's table has, and what its policy made of it."""
    question = Question("test", int(record.config["sets"]["size"]))
    (answer,) = answers_of(record, [Asked.part(question)], episodes, num_workers)
    assert record.table  # It was evaluated.
    assert record.split
    numbers = measures(table_report(task, record.split, record.table.vectors))
    return MeasuredTable(
        record.path.name,
        int(record.config["split_seed"]),
        {name: np.nan if value is None else value for name, value in numbers.items()},
        answer["metrics"][task.selection_metric]["mean"],
    )


def by_split(found: Sequence[MeasuredTable]) -> dict[int, list[MeasuredTable]]:
    """The tables by their split's seed."""
    seeds = dict.fromkeys(each.split_seed for each in found)
    return {seed: [each for each in found if each.split_seed == seed] for seed in seeds}


def rank_correlation(of_split: Sequence[MeasuredTable], name: str) -> float:
    """Spearman's, of a measure with success; NaN where it does not vary or tables are few."""
    from scipy.stats import spearmanr  # Half a second to import.

    pairs = np.array([(table.measures[name], table.success) for table in of_split])
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    if len(pairs) < 3 or np.any(np.ptp(pairs, axis=0) == 0.0):
        return float("nan")
    return float(spearmanr(*pairs.T).statistic)


def as_markdown(found: Sequence[MeasuredTable], metric: Metric, episodes: int) -> str:
    """A row for each table, and the rank correlation of each measure for each split."""
    names, rows = list(found[0].measures), []
    for seed, of_split in by_split(found).items():
        for table in of_split:
            values = [f"{table.measures[name]:.3f}" for name in names]
            rows.append([table.name, str(seed), metric.text(table.success), *values])
        ranks = [f"{rank_correlation(of_split, name):+.2f}".replace("+nan", "-") for name in names]
        rows.append([f"Spearman, {len(of_split)} tables", str(seed), "", *ranks])
    title = f"# Tables and what policies make of them: {metric.name.lower()}, {episodes:,} episodes"
    return "\n".join([title, "", *tables.table(["run", "split seed", "test", *names], rows)]) + "\n"


def figure_of(found: Sequence[MeasuredTable], metric: Metric) -> Figure:
    """Success against every measure, a colour for each split."""
    names, splits = list(found[0].measures), by_split(found)
    colors = plots.hls_palette(len(splits))
    figure = plots.new_figure(2.6 * len(names), 3.2, "Measures of tables and test success")
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for name, axes in zip(names, panels, strict=True):
        for color, (seed, of_split) in zip(colors, splits.items(), strict=True):
            x = [table.measures[name] for table in of_split]
            y = [metric.scale * table.success for table in of_split]
            label = f"split {seed}: rank correlation {rank_correlation(of_split, name):+.2f}"
            axes.scatter(x, y, s=22, color=color, label=label.replace("+nan", "-"))
        axes.set_xlabel(name)
        axes.legend(**{**plots.LEGEND, "fontsize": 6.5})
        plots.tidy(axes)
    panels[0].set_ylabel(metric.name)
    return figure
