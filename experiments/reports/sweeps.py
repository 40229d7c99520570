"""A sweep as one table and one picture: what was varied, mean and deviation over seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from experiments.reports import plots, tables
from experiments.reports.plots import Metric
from experiments.reports.study_report import Study, StudyPoint, study_figure
from jaxnew.finiteness import CAUSES
from jaxnew.runs import Runs
from jaxnew.storage.run_directory import RunDirectory


def show_sweep(runs: Runs, out: Path | None = None, stem: str = "sweep") -> list[Path]:
    """Prints the table by what was varied, and writes it for reading and as CSV.

    Args:
      runs: of the sweep, at least one.
      out: folder of the two files; default: `figures/` of the sweep.
      stem: of their names.
    """
    text = as_markdown(runs)
    print(text)
    out = out or RunDirectory.load(runs.path).figures
    return tables.write(out, stem, text, tables.csv_text(runs.summary()))


def as_markdown(runs: Runs) -> str:
    """The table for reading, and what its numbers are."""
    metric, varied, summary = Metric.of(runs.task.selection_metric), runs.varied, runs.summary()
    names = [name.removesuffix("_std") for name in summary[0] if name.endswith("_std")]
    rows = []
    for row in summary:
        numbers = [_number(row, name, metric) for name in names]
        lost = [str(row["diverged"] or "-")] * bool(runs.diverged)
        best = "best" * row["is_best"]
        rows.append([*(f"{row[name]:g}" for name in varied), *numbers, *lost, best])
    header = [*varied, *(_title(runs, name) for name in names)]
    header += [*["diverged"] * bool(runs.diverged), "by validation"]
    lines = [
        *(f"# {runs.path.name}: {metric.name.lower()}", ""),
        *tables.table(header, rows),
        "",
        "Mean ± population standard deviation over seeds (how many). Validation is the best "
        "evaluation of each run in training, by which its checkpoint was chosen; the others are "
        "evaluations on record, by the names of their files.",
    ]
    if runs.diverged:
        lines += ["", "Runs that diverged count nowhere and are not evaluated:", ""]
    for run in runs.diverged:
        what, _ = CAUSES[run["diverged_by"]]
        lines.append(f"* {Path(run['path']).name}, by update {run['diverged_at']}. {what} first.")
    return "\n".join(lines) + "\n"


def sweep_figure(runs: Runs, out: Path, stem: str = "sweep", pdf: bool = False) -> list[Path]:
    """The table as a picture against the first number that was varied; none if there is none.

    Each evaluation, and each combination of what else was varied, has a line.
    """
    if not runs.varied:
        return []
    axis, *others = runs.varied
    points = []
    for values, numbers in runs.groups():
        words = [f"{name} {values[name]:g}" for name in others]
        for name, of_seeds in numbers.items():
            if of_seeds.size:
                label = ", ".join([_title(runs, name), *words])
                points.append(StudyPoint(label, values[axis], of_seeds, 0))
    if not points:
        return []
    x = np.array([point.x for point in points])
    has_log_axis = bool(x.min() > 0 and x.max() >= 10 * x.min())
    study = Study(
        "sweep",
        axis.replace("_", " "),
        has_log_axis,
        Metric.of(runs.task.selection_metric),
        tuple(points),
        "",
        place=runs.task.name.replace("_", " "),
    )
    return plots.save(study_figure(study), out / f"{stem}.png", pdf)


def _title(runs: Runs, name: str) -> str:
    return runs.selection_metric if name == "best_metric" else name


def _number(row: dict[str, Any], name: str, metric: Metric) -> str:
    """A mean with its deviation and the number of its seeds."""
    if row[name] is None:
        return "-"
    return f"{metric.text(row[name])} ± {metric.text(row[f'{name}_std'])} ({row[f'{name}_seeds']})"
