"""Bars and scatter plots, as pure functions from numbers to a matplotlib `Figure`; and `save`.

Figures are made through matplotlib's objects, without pyplot, so that nothing global changes.
"""

from __future__ import annotations

import colorsys
import io
import itertools
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxnew.storage.files import write_bytes_atomically

Color = tuple[float, float, float]

INK = "#2d3440"
FAINT_INK = "#7a828f"
GRID_COLOR = "#e4e6ea"
PAPER_COLOR = "#5b6472"  # Of the paper's numbers, whatever the method.

_TRAIN_ALPHA, _TEST_ALPHA = 0.25, 0.8  # docs/method.md, "Figures".
_TEST_HATCH = "///"
_COVER = {"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8}
_ANCHOR: dict[str, Any] = {"color": INK, "linewidth": 1.1}
_ANCHOR_DASHES = (":", "-.", "--", "-")


LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 8.5, "labelcolor": INK}


@dataclass(frozen=True)
class Metric:
    """How a metric is shown.

    Attributes:
      name: of the axis, with its unit.
      scale: what values are multiplied by.
      limit: upper end of the axis in scaled units, None for what the numbers need.
      unit: after a number.
      cuts_train: bars of train actions end at `limit` if they are higher; those of test actions
        make the axis longer.
    """

    name: str
    scale: float = 1.0
    limit: float | None = None
    unit: str = ""
    cuts_train: bool = False

    @classmethod
    def of(cls, name: str, paper_name: str | None = None) -> Metric:
        """An episode metric, under the paper's name for it if there is one."""
        if paper_name == "success_rate" or name == "is_success":
            return cls("Success rate (%)", 100.0, 110.0, "%")
        if paper_name == "ctr":
            return cls("Click-through rate", limit=0.5)
        if "final_height" in (paper_name, name):
            return cls("Final height (m)", limit=2.75, unit=" m", cuts_train=True)
        readable = name.removeprefix("is_").removeprefix("has_").replace("_", " ").capitalize()
        is_share = name.startswith(("is_", "has_"))
        return cls(f"{readable} (%)", 100.0, 110.0, "%") if is_share else cls(readable)

    def text(self, value: float) -> str:
        """A value, rounded for reading."""
        return f"{value * self.scale:.1f}" if self.scale == 100.0 else f"{value:.3f}"


def amount(steps: float) -> str:
    """Environment steps for reading."""
    if steps < 1e3:
        return f"{steps:.0f} steps"
    return f"{1e-6 * steps:.3g} M steps" if steps >= 1e6 else f"{1e-3 * steps:.3g} k steps"


@dataclass(frozen=True)
class Bar:
    """A mean with the ends of its error bar."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class BarSetting:
    """Bars of one setting: jaxnew's and, beside it, the paper's.

    Attributes:
      label: of the setting.
      color: of our bars.
      own, paper: by split, `train` and `test`; either may be absent.
      own_note, paper_note: below the bars, such as `5 seeds`.
      anchors: what policies without training reach on test actions, by name: lines across.
    """

    label: str
    color: Color
    own: Mapping[str, Bar]
    paper: Mapping[str, Bar]
    own_note: str = ""
    paper_note: str = ""
    anchors: Mapping[str, float] = field(default_factory=dict)


def hls_palette(n: int) -> list[Color]:
    """`n` colours of equal lightness and saturation, evenly spaced in hue."""
    return [colorsys.hls_to_rgb((0.7 + i / n) % 1.0, 0.6, 0.9) for i in range(n)]


def bars(
    settings: Sequence[BarSetting], metric: Metric, title: str = "", footnote: str = ""
) -> Figure:
    """Test actions in front (hatched), train actions behind (pale); jaxnew's beside the paper's.

    Args:
      settings: at least one.
      metric: of the vertical axis.
      title: of the figure.
      footnote: below it, e.g. what the error bars are.
    """
    figure = new_figure(max(4.4, 1.6 + 2.1 * len(settings)), 4.2, title)
    axes = figure.subplots()
    ticks: list[tuple[float, str]] = []
    num_lines = 1 + max(max(s.own_note.count("\n"), s.paper_note.count("\n")) for s in settings)
    end = _axis_end(settings, metric)
    anchors = dict.fromkeys(name for setting in settings for name in setting.anchors)
    dashes = dict(zip(anchors, itertools.cycle(_ANCHOR_DASHES), strict=False))
    for position, setting in enumerate(settings):
        sides: list[tuple[str, Mapping[str, Bar], Color | str, str]] = [
            ("jaxnew", setting.own, setting.color, setting.own_note)
        ]
        if setting.paper:
            sides.append(("paper", setting.paper, PAPER_COLOR, setting.paper_note))
        for side, (name, by_split, color, note) in enumerate(sides):
            x = position + (side - (len(sides) - 1) / 2) * 0.42
            ticks.append((x, f"{name}\n{note}" if note else name))
            for split in ("train", "test"):
                if split in by_split:
                    _draw_bar(axes, x, by_split[split], split, color, metric, end)
        for name, mean in setting.anchors.items():
            ends, height = [position - 0.46, position + 0.46], metric.scale * mean
            axes.plot(ends, [height] * 2, linestyle=dashes[name], zorder=3.5, **_ANCHOR)
        axes.annotate(
            textwrap.fill(setting.label, 26),
            (position, 0.0),
            xycoords=axes.get_xaxis_transform(),
            xytext=(0, -22 - 12 * num_lines),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=9.5,
            fontweight="bold",
            color=INK,
        )
    axes.set_xticks([x for x, _ in ticks], [text for _, text in ticks], fontsize=8.5)
    axes.set_xlim(-0.55, len(settings) - 0.45)
    axes.set_ylim(0.0, end)
    if metric.limit == 110.0:
        axes.set_yticks(range(0, 101, 20))
    axes.set_ylabel(metric.name, fontsize=9, color=INK)
    tidy(axes)
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False, axis="x")
    handles: list[Any] = [
        Patch(facecolor=PAPER_COLOR, alpha=_TEST_ALPHA, edgecolor="black", hatch=_TEST_HATCH),
        Patch(facecolor=PAPER_COLOR, alpha=_TRAIN_ALPHA),
        *(Line2D([], [], linestyle=style, **_ANCHOR) for style in dashes.values()),
    ]
    labels = ["unseen test actions", "train actions", *dashes]
    above: dict[str, Any] = {
        "loc": "lower center",
        "bbox_to_anchor": (0.5, 1.0),
        "borderaxespad": 0.2,
    }
    num_columns = max(2, min(len(labels), int(0.9 * figure.get_figwidth() / _legend_entry(labels))))
    axes.legend(handles, labels, ncols=num_columns, **above, **LEGEND)
    footnote = "\n".join(line for line in (footnote, _beyond(settings, metric, end)) if line)
    if footnote:
        figure.supxlabel(footnote, fontsize=7.5, color=FAINT_INK)
    return figure


def _axis_end(settings: Sequence[BarSetting], metric: Metric) -> float:
    """Upper end of the axis: the metric's limit, or what the bars need."""
    bars = [
        bar
        for setting in settings
        for by_split in (setting.own, setting.paper)
        for split, bar in by_split.items()
        if split == "test" or not metric.cuts_train
    ]
    highest = metric.scale * max((max(bar.mean, bar.high) for bar in bars), default=0.0)
    return metric.limit if metric.limit is not None and metric.limit >= highest else 1.12 * highest


def _beyond(settings: Sequence[BarSetting], metric: Metric, end: float) -> str:
    """What the axis does not reach."""
    found: dict[str, dict[str, None]] = {}
    for setting in settings:
        for name, mean in setting.anchors.items():
            if metric.scale * mean > end:
                found.setdefault(name, {})[metric.text(mean)] = None
    lines = [f"{name} at {', '.join(values)}{metric.unit}" for name, values in found.items()]
    return f"Lines above the axis: {'; '.join(lines)}." if lines else ""


def _draw_bar(
    axes: Axes, x: float, bar: Bar, split: str, color: Color | str, metric: Metric, end: float
) -> None:
    """A bar with its error and its number; `end` is that of the axis."""
    is_test = split == "test"
    height = metric.scale * bar.mean
    sides = bar.mean - bar.low, bar.high - bar.mean
    errors = [[metric.scale * max(side, 0.0)] for side in sides]  # -1e-17 is an error bar's end.
    axes.bar(
        x,
        height,
        width=0.36,
        color=color,
        alpha=_TEST_ALPHA if is_test else _TRAIN_ALPHA,
        edgecolor="black" if is_test else "none",
        hatch=_TEST_HATCH if is_test else None,
        linewidth=0.8,
        zorder=3 if is_test else 2,
        label=split,
    )
    # Beside each other, so that both are seen where the bars are of like height.
    shifted = x + (0.085 if is_test else -0.085)
    axes.errorbar(shifted, height, yerr=errors, color=INK, capsize=2.5, linewidth=1.1, zorder=4)
    is_cut = metric.scale * bar.high > end
    axes.annotate(
        metric.text(bar.mean) + " ↑" * (height > end),
        (shifted, end if is_cut else metric.scale * bar.high),
        xytext=(0, -2.5 if is_cut else 2.5),
        textcoords="offset points",
        ha="center",
        va="top" if is_cut else "baseline",
        bbox=_COVER if is_cut else None,
        fontsize=8.5,
        fontweight="bold" if is_test else "normal",
        color=INK if is_test else FAINT_INK,
        zorder=5,
    )


@dataclass(frozen=True)
class Scatter:
    """Two-dimensional representations.

    Attributes:
      points: f[n, 2].
      labels: int[n] index into the names of the classes.
      subtitle: above it.
    """

    points: np.ndarray
    labels: np.ndarray
    subtitle: str = ""


def tsne_scatter(panels: Sequence[Scatter], class_names: Sequence[str], title: str = "") -> Figure:
    """Two-dimensional representations, coloured by class.

    Args:
      panels: from left to right.
      class_names: legend, in label order; classes without a point are left out.
      title: of the figure.
    """
    width = 4.6 * len(panels)
    figure = new_figure(width, 4.8, title)
    colors = hls_palette(len(class_names))
    shown: dict[str, Any] = {}
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for label, name in enumerate(class_names):
            of_class = panel.points[panel.labels == label]
            if len(of_class):
                shown[name] = axes.scatter(
                    *of_class.T,
                    s=22,
                    color=colors[label],
                    edgecolor="white",
                    linewidth=0.4,
                    label=name,
                )
        axes.set_axis_off()
        axes.set_title(panel.subtitle, fontsize=9, color=FAINT_INK)
    names = [name for name in class_names if name in shown]
    narrow: dict[str, Any] = {"handletextpad": 0.1, "columnspacing": 1.0, "markerscale": 1.4}
    figure.legend(
        [shown[name] for name in names],
        names,
        loc="outside lower center",
        ncols=max(1, min(4 * len(panels), len(names), int(width / _legend_entry(names)))),
        **narrow,
        **LEGEND,
    )
    return figure


def _legend_entry(names: Sequence[str]) -> float:
    """Inches that the longest name takes in a legend, with its mark and the space behind it."""
    return 0.5 + 0.075 * max(map(len, names), default=0)


def save(figure: Figure, path: Path, pdf: bool = False) -> list[Path]:
    """Writes `path` (PNG) and, if asked for, the same name with `.pdf`; returns what it wrote."""
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[Path, dict[str, Any]] = {path: {"dpi": 200, "facecolor": "white"}}
    if pdf:
        options[path.with_suffix(".pdf")] = {"metadata": {"CreationDate": None}}
    for file, how in options.items():
        content = io.BytesIO()
        figure.savefig(content, format=file.suffix[1:], **how)
        write_bytes_atomically(file, content.getvalue())
    return list(options)


def new_figure(width: float, height: float, title: str = "") -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold", color=INK)
    return figure


def tidy(axes: Axes) -> None:
    """Quiet axes: faint horizontal lines, no frame above and to the right."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT_INK)
    axes.tick_params(labelsize=8.5, colors=INK, color=FAINT_INK)
    axes.grid(axis="y", color=GRID_COLOR, linewidth=0.8)
    axes.set_axisbelow(True)
