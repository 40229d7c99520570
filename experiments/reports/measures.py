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
from jaxnew.task.places import UsageError

NAME = "measures"
_FEWEST = 3  # Tables of a split, below which ranks say nothing.


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
      paths: runs of `train` or `sweep` that differ in their tables, splits and seeds only.
      episodes: at least so many of each evaluation.
      out: where the picture and the tables are written.
      num_workers: processes for environments on the host; 0: one per core.

    Raises:
      UsageError: a split has fewer than three runs, or runs are of several tasks.
    """
    records = policies(paths)
    metrics = {group.task.name: group.metric for group in group_runs(records)}
    if len(metrics) > 1:
        raise UsageError(f"--study={NAME} compares tables of one task; got {', '.join(metrics)}.")
    found = [measured(record, episodes, num_workers) for record in records]
    by_split = of_splits(found)
    (metric,) = metrics.values()
    text = as_markdown(found, by_split, metric, episodes)
    print(text)
    rows = [
        {"run": table.name, "split_seed": table.split_seed, **table.measures, "test": table.success}
        for table in found
    ]
    written = tables.write(out, NAME, text, tables.csv_text(rows))
    return [*plots.save(figure_of(by_split, metric), out / f"{NAME}.png"), *written]


def measured(record: RunRecord, episodes: int, num_workers: int = 0) -> MeasuredTable:
    """What a run's table has, and what its policy made of it."""
    (group,) = group_runs([record])
    question = Question("test", int(record.config["sets"]["size"]))
    (answer,) = answers_of(record, [Asked.part(question)], episodes, num_workers)
    if record.table is None or record.split is None:
        raise UsageError(f"{record.path} was interrupted before it had a table.")
    numbers = measures(table_report(group.task, record.split, record.table.vectors))
    return MeasuredTable(
        record.path.name,
        int(record.config["split_seed"]),
        {name: np.nan if value is None else value for name, value in numbers.items()},
        answer["metrics"][group.task.selection_metric]["mean"],
    )


def of_splits(found: Sequence[MeasuredTable]) -> dict[int, list[MeasuredTable]]:
    """The tables by their split's seed, best first.

    Raises:
      UsageError: a split has too few of them.
    """
    by_split: dict[int, list[MeasuredTable]] = {}
    for table in sorted(found, key=lambda table: (table.split_seed, -table.success)):
        by_split.setdefault(table.split_seed, []).append(table)
    for seed, few in by_split.items():
        if len(few) < _FEWEST:
            raise UsageError(
                f"The order of tables needs at least {_FEWEST} of each split; the split of seed "
                f"{seed} has {len(few)}."
            )
    return by_split


def rank_correlation(of_split: Sequence[MeasuredTable], name: str) -> float:
    """Spearman's correlation of a measure with success; NaN where the measure does not vary."""
    from scipy.stats import spearmanr  # Half a second to import.

    pairs = np.array([(table.measures[name], table.success) for table in of_split])
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    if len(pairs) < _FEWEST or np.any(np.ptp(pairs, axis=0) == 0.0):
        return float("nan")
    return float(spearmanr(*pairs.T).statistic)


def as_markdown(
    found: Sequence[MeasuredTable],
    by_split: dict[int, list[MeasuredTable]],
    metric: Metric,
    episodes: int,
) -> str:
    """A row for each table, and the rank correlation of each measure for each split."""
    names = list(found[0].measures)
    rows = []
    for seed, of_split in by_split.items():
        for table in of_split:
            values = [f"{table.measures[name]:.3f}" for name in names]
            rows.append([table.name, str(seed), metric.text(table.success), *values])
        ranks = [f"**{rank_correlation(of_split, name):+.2f}**" for name in names]
        rows.append([f"Spearman, {len(of_split)} tables", str(seed), "", *ranks])
    header = ["run", "split seed", "test", *names]
    title = f"# Measures of tables and what policies make of them: {metric.name.lower()}"
    note = f"Best checkpoints, {episodes:,} episodes on test actions each."
    return "\n".join([title, "", *tables.table(header, rows), "", note]) + "\n"


def figure_of(by_split: dict[int, list[MeasuredTable]], metric: Metric) -> Figure:
    """Success against every measure, a colour for each split."""
    names = list(next(iter(by_split.values()))[0].measures)
    columns = (len(names) + 1) // 2
    figure = plots.new_figure(3.0 * columns, 5.6, "Measures of tables and test success")
    panels = iter(figure.subplots(2, columns, sharey=True, squeeze=False).flat)
    for name, axes in zip(names, panels, strict=False):
        colors = plots.hls_palette(len(by_split))
        for color, (seed, of_split) in zip(colors, by_split.items(), strict=True):
            axes.scatter(
                [table.measures[name] for table in of_split],
                [metric.scale * table.success for table in of_split],
                s=22,
                color=color,
                label=f"split {seed}: rank correlation {rank_correlation(of_split, name):+.2f}",
            )
        axes.set_xlabel(name, fontsize=8.5, color=plots.INK)
        axes.legend(**{**plots.LEGEND, "fontsize": 6.5})
        plots.tidy(axes)
    for axes in panels:
        axes.set_axis_off()
    return figure
