"""What came of a study, as a picture and as tables, beside the paper's points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.reports import plots, tables
from experiments.reports.paper import PaperValue
from experiments.reports.plots import Metric


@dataclass(frozen=True)
class StudyPoint:
    """One condition of one setting.

    Attributes:
      setting: label of the runs, which differ in their seed only.
      x: place on the horizontal axis.
      means: f64[n] of each seed.
      num_episodes: per seed; 0 for the best evaluation during training.
      paper: the paper's mean and deviation, or None.
    """

    setting: str
    x: float
    means: np.ndarray
    num_episodes: int
    paper: PaperValue | None = None


@dataclass(frozen=True)
class Study:
    """Points, and what they are.

    Attributes:
      name: of the study.
      axis: what `StudyPoint.x` is.
      has_log_axis: whether it is drawn on a logarithmic scale.
      metric: how the means are shown.
      note: below the table.
      figure: number of the paper's figure, or empty.
      place: the paper's name of where the runs were, or the task's; may be empty.
    """

    name: str
    axis: str
    has_log_axis: bool
    metric: Metric
    points: tuple[StudyPoint, ...]
    note: str
    figure: str = ""
    place: str = ""

    @property
    def title(self) -> str:
        """What is studied where, and the figure of the paper that shows it."""
        start = f"Figure {self.figure}" if self.figure else ""
        head = ", ".join(word for word in (start, self.place) if word)
        return f"{head}: {self.name}" if head else self.name

    @property
    def settings(self) -> list[str]:
        """Labels of the settings, in order."""
        return list(dict.fromkeys(point.setting for point in self.points))

    def of(self, setting: str) -> list[StudyPoint]:
        """The points of a setting, ascending."""
        return sorted((p for p in self.points if p.setting == setting), key=lambda p: p.x)


def write_study(study: Study, out: Path, stem: str, pdf: bool = False) -> list[Path]:
    """The study as a picture and as two tables called `stem`; prints the one for reading."""
    text = as_markdown(study)
    print(text)
    written = tables.write(out, stem, text, as_csv(study))
    return [*plots.save(study_figure(study), out / f"{stem}.png", pdf), *written]


def as_csv(study: Study) -> str:
    """One line per setting and value."""
    rows = [
        {
            "study": study.name,
            "setting": point.setting,
            study.axis: point.x,
            "mean": float(point.means.mean()),
            "std": float(point.means.std()),
            "num_seeds": len(point.means),
            "num_episodes": point.num_episodes,
            "paper": point.paper and point.paper.mean,
            "paper_std": point.paper and point.paper.std,
            "paper_num_seeds": point.paper and point.paper.num_seeds,
        }
        for point in study.points
    ]
    return tables.csv_text(rows)


def as_markdown(study: Study) -> str:
    """A row per value, a column per setting and behind it the paper's, where it has points."""
    columns = {setting: study.of(setting) for setting in study.settings}
    published = [s for s, points in columns.items() if any(p.paper for p in points)]
    header = [study.axis]
    for setting in columns:
        beside = "paper" if len(published) == 1 else f"paper, {setting}"
        header += [setting, *([beside] if setting in published else [])]
    text, rows = study.metric.text, []
    for x in dict.fromkeys(point.x for point in study.points):
        cells = [f"{x:g}"]
        for setting, points in columns.items():
            (point,) = [p for p in points if p.x == x]
            mean, std = text(point.means.mean()), text(point.means.std())
            cells.append(f"{mean} ± {std}" if len(point.means) > 1 else mean)
            if setting in published:
                paper = point.paper
                cells.append(f"{text(paper.mean)} ± {text(paper.std)}" if paper else "-")
        rows.append(cells)
    seeds = ", ".join(map(str, sorted({len(point.means) for point in study.points})))
    fewest = min(point.num_episodes for point in study.points)
    of_each = f", {fewest:,} episodes each" if fewest else ""
    lines = [f"# {study.title}: {study.metric.name.lower()}", "", *tables.table(header, rows), ""]
    note = f"{study.note} Seeds: {seeds}{of_each}; ± is the population standard deviation over "
    return "\n".join([*lines, f"{note}seeds."]) + "\n"


def study_figure(study: Study) -> Figure:
    """Mean and deviation over seeds against the axis, a line per setting; the paper's dashed."""
    title = study.title.replace("-", " ")
    figure = plots.new_figure(5.4, 4.0, title[0].upper() + title[1:])
    axes = figure.subplots()
    scale = study.metric.scale
    settings = study.settings
    for color, setting in zip(plots.hls_palette(len(settings)), settings, strict=True):
        points = study.of(setting)
        y = scale * np.array([point.means.mean() for point in points])
        error = scale * np.array([point.means.std() for point in points])
        x = [point.x for point in points]
        axes.errorbar(x, y, yerr=error, color=color, marker="o", capsize=2.5, label=setting)
        beside = [(p.x, p.paper.mean, p.paper.std) for p in points if p.paper]
        if beside:
            x, y, error = np.array(beside).T
            of_several = len(settings) > 1
            axes.errorbar(
                x,
                scale * y,
                yerr=scale * error,
                color=color if of_several else plots.INK,
                linestyle="--",
                marker=".",
                capsize=2.5,
                alpha=0.7,
                label=f"paper, {setting}" if of_several else "paper",
            )
    if study.has_log_axis:
        axes.set_xscale("log")
    axes.set_ylim(0.0, None)
    axes.set_xlabel(study.axis.capitalize(), fontsize=9, color=plots.INK)
    axes.set_ylabel(study.metric.name, fontsize=9, color=plots.INK)
    plots.tidy(axes)
    figure.legend(loc="outside lower center", ncols=2, **plots.LEGEND)
    return figure
