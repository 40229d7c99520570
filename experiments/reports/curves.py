"""Learning curves, as a pure function from numbers to a matplotlib `Figure`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.reports.paper import PaperCurve
from experiments.reports.plots import (
    INK,
    LEGEND,
    PAPER_COLOR,
    Color,
    Metric,
    new_figure,
    tidy,
)

_PAPER_DASHES = ((0, (5, 2)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5)))
_LONG_LABEL = 62  # Characters; two such columns of a legend are as wide as the figure.


@dataclass(frozen=True)
class RunCurve:
    """A metric of one run: environment steps f64[n], ascending, and values f64[n]."""

    steps: np.ndarray
    values: np.ndarray

    def held_at_best(self) -> RunCurve:
        """The curve up to its first maximum, and that maximum from there on (docs/method.md,
        "Figures").
        """
        best = int(np.argmax(self.values)) if len(self.values) else 0
        is_after = np.arange(len(self.values)) > best
        return RunCurve(self.steps, np.where(is_after, self.values[best : best + 1], self.values))


@dataclass(frozen=True)
class CurveSetting:
    """The curves of one setting.

    Attributes:
      label: of the setting.
      color: of our curves.
      runs: by split, one curve per seed.
      paper: by split; a split may be absent.
      paper_label: of the paper's curves.
    """

    label: str
    color: Color
    runs: Mapping[str, Sequence[RunCurve]]
    paper: Mapping[str, PaperCurve] = field(default_factory=dict)
    paper_label: str = "paper"


def mean_curve(runs: Sequence[RunCurve]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps that all runs have, and there the mean and population deviation over the runs."""
    common = reduce(np.intersect1d, [run.steps for run in runs])
    values = np.array([run.values[np.isin(run.steps, common)] for run in runs])
    return common, values.mean(axis=0), values.std(axis=0)


def learning_curves(
    settings: Sequence[CurveSetting],
    metric: Metric,
    splits: Sequence[str] = ("train", "validation"),
    title: str = "",
) -> Figure:
    """A metric against environment steps, one panel per split.

    Faint lines are the evaluations of each run. Strong lines are drawn as the paper draws its own:
    every run held at its best evaluation, then the mean and, for several runs, the deviation. The
    axis ends where our longest run ends; a dotted line tells where the paper's curve goes to. Where
    several settings have curves of the paper's, these are dashed in the colours of the settings.

    Args:
      settings: at least one.
      metric: of the vertical axis.
      splits: panels from left to right.
      title: of the figure.
    """
    handles, labels = _curve_legend(settings)
    num_columns = 2 if max(map(len, labels)) <= _LONG_LABEL else 1
    num_rows = -(-len(labels) // num_columns)
    figure = new_figure(4.6 * len(splits), 3.5 + 0.17 * num_rows, title)
    panels = figure.subplots(1, len(splits), sharey=True, squeeze=False)[0]
    unit = _Unit.of([run for s in settings for runs in s.runs.values() for run in runs], metric)
    papers = _papers(settings)
    for axes, split in zip(panels, splits, strict=True):
        for paper in papers:
            if split in paper.paper:
                color = PAPER_COLOR if len(papers) == 1 else paper.color
                _draw_paper_curve(axes, paper, paper.paper[split], color, unit)
        for setting in settings:
            runs = [run for run in setting.runs.get(split, ()) if len(run.steps)]
            for run in runs:
                x, y = run.steps / unit.steps, metric.scale * run.values
                faint: dict[str, Any] = {"color": setting.color, "alpha": 0.45, "linewidth": 0.9}
                axes.plot(x, y, label=f"{setting.label}: run", **faint)
            if runs:
                held = [run.held_at_best() for run in runs]
                _draw_mean(axes, held, setting.color, setting.label, unit)
        axes.set_title(f"{split} actions".capitalize(), fontsize=10, color=INK)
        unit.finish(axes, "Environment steps")
    panels[0].set_ylabel(metric.name, fontsize=9, color=INK)
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=num_columns,
        handler_map={tuple: HandlerTuple(ndivide=1, pad=0)},
        **LEGEND,
    )
    return figure


@dataclass(frozen=True)
class _Unit:
    """Of the axes.

    Attributes:
      steps, name: of the horizontal one.
      right: its end, environment steps.
      metric: of the vertical one.
    """

    steps: float
    name: str
    right: float
    metric: Metric

    @classmethod
    def of(cls, runs: Sequence[RunCurve], metric: Metric) -> _Unit:
        """What the longest of some runs needs."""
        right = max((run.steps[-1] for run in runs if len(run.steps)), default=1.0)
        return cls(*((1e6, "million") if right >= 1e6 else (1e3, "thousand")), right, metric)

    def finish(self, axes: Axes, x_label: str) -> None:
        """Limits and labels of axes."""
        axes.set_xlim(0.0, 1.01 * self.right / self.steps)
        axes.set_ylim(0.0, 100.0 if self.metric.unit == "%" else None)
        axes.set_xlabel(f"{x_label} ({self.name})", fontsize=9, color=INK)
        tidy(axes)


def _draw_mean(axes: Axes, runs: Sequence[RunCurve], color: Color, label: str, unit: _Unit) -> None:
    """Mean and, of several runs, deviation."""
    steps, mean, std = mean_curve(runs)
    x, y, band = steps / unit.steps, unit.metric.scale * mean, unit.metric.scale * std
    if len(runs) > 1:
        axes.fill_between(x, y - band, y + band, color=color, alpha=0.18, linewidth=0)
    points: dict[str, Any] = {"marker": "o", "clip_on": False} if len(x) == 1 else {}
    axes.plot(x, y, color=color, linewidth=2.2, label=label, **points)


def _papers(settings: Sequence[CurveSetting]) -> list[CurveSetting]:
    """One setting for each of the paper's distinct curves."""
    return list({setting.paper_label: setting for setting in settings if setting.paper}.values())


def _draw_paper_curve(
    axes: Axes, setting: CurveSetting, curve: PaperCurve, color: Color | str, unit: _Unit
) -> None:
    """A curve of the paper's; one that is alone has a band, and says where it goes to."""
    metric, label = unit.metric, setting.paper_label
    x, y, band = curve.steps / unit.steps, metric.scale * curve.mean, metric.scale * curve.std
    axes.plot(x, y, color=color, linewidth=1.6, linestyle=_PAPER_DASHES[0], label=label)
    if color != PAPER_COLOR:
        return
    axes.fill_between(x, y - band, y + band, color=color, alpha=0.15, linewidth=0)
    if curve.steps[-1] > 1.05 * unit.right:
        million = 1e-6 * curve.steps[-1]
        end = f"paper after {million:.0f} million: {metric.text(curve.mean[-1])}{metric.unit}"
        axes.axhline(y[-1], color=color, linewidth=0.9, linestyle=":", label=end)
        axes.annotate(
            end,
            (0.0, y[-1]),
            xycoords=axes.get_yaxis_transform(),
            xytext=(4, 3),
            textcoords="offset points",
            fontsize=8,
            color=color,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8},
        )


def _curve_legend(settings: Sequence[CurveSetting]) -> tuple[list[Any], list[str]]:
    handles: list[Any] = []
    labels: list[str] = []
    for setting in settings:
        num_runs = max((len(runs) for runs in setting.runs.values()), default=0)
        strong = Line2D([], [], color=setting.color, linewidth=2.2)
        band = Patch(color=setting.color, alpha=0.18, linewidth=0)
        handles.append((band, strong) if num_runs > 1 else strong)
        spread = f"mean ± std of {num_runs} seeds" if num_runs > 1 else "1 seed"
        labels.append(f"{setting.label}, held at best ({spread})")
    color = settings[0].color if len(settings) == 1 else INK
    handles.append(Line2D([], [], color=color, linewidth=0.9, alpha=0.45))
    labels.append("every evaluation of a run")
    papers = _papers(settings)
    line = Line2D([], [], color=PAPER_COLOR, linewidth=1.6, linestyle=_PAPER_DASHES[0])
    if len(papers) == 1:
        handles.append((Patch(color=PAPER_COLOR, alpha=0.15, linewidth=0), line))
        labels.append(f"{papers[0].paper_label}, held at best (mean ± std over seeds)")
    elif papers:
        handles.append(line)
        labels.append("the paper's, in the same colours, held at best (mean over seeds)")
    return handles, labels


def reference_curves(
    settings: Sequence[tuple[str, Color, Sequence[RunCurve]]],
    lines: Sequence[tuple[str, float]],
    metric: Metric,
    title: str = "",
) -> Figure:
    """Curves against environment steps as they are, and horizontal lines.

    Args:
      settings: label, colour and runs of each; mean, and for several runs the deviation, are drawn.
      lines: label and value; those whose label begins with `paper` have the paper's colour.
      metric: of the vertical axis.
      title: of the figure.
    """
    figure = new_figure(7.4, 4.4 + 0.09 * (len(settings) + len(lines)), title)
    axes = figure.subplots()
    unit = _Unit.of([run for _, _, runs in settings for run in runs], metric)
    for label, color, runs in settings:
        spread = f"mean ± std of {len(runs)} seeds" if len(runs) > 1 else "1 seed"
        _draw_mean(axes, runs, color, f"{label} ({spread})", unit)
    for number, (label, value) in enumerate(lines):
        axes.axhline(
            metric.scale * value,
            color=PAPER_COLOR if label.startswith("paper") else INK,
            linestyle=_PAPER_DASHES[number // 2 % len(_PAPER_DASHES)],
            linewidth=1.2,
            label=f"{label}: {metric.text(value)}{metric.unit}",
        )
    unit.finish(axes, "Environment steps on the new actions")
    axes.set_ylabel(f"{metric.name}, training episodes", fontsize=9, color=INK)
    figure.legend(loc="outside lower center", ncols=2, **LEGEND)
    return figure
