"""Bars and scatter plots show the numbers that they are given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from PIL import Image

from experiments.reports.plots import (
    Bar,
    BarSetting,
    Metric,
    Scatter,
    amount,
    bars,
    hls_palette,
    save,
    tsne_scatter,
)
from jaxnew.task.domain import Domain, load_task

RED = (1.0, 0.0, 0.0)
SUCCESS = Metric.of("is_success")


def texts(figure: Any) -> str:
    return " | ".join(t.get_text() for axes in figure.axes for t in axes.texts)


def legend_texts(figure: Any) -> list[str]:
    legends = [*figure.legends, *(a.get_legend() for a in figure.axes if a.get_legend())]
    return [text.get_text() for legend in legends for text in legend.get_texts()]


@pytest.mark.unit
def test_palette_is_evenly_spaced_in_hue_from_h() -> None:
    # Hue 0.7 + 3/10 = 0 (red): with l = 0.6, s = 0.9 the parts are l + s - l s = 0.96 and 0.24.
    assert hls_palette(10)[3] == pytest.approx((0.96, 0.24, 0.24))
    # Hue 0.7 + 2/4 = 0.2: yellow-green, red falls to 0.96 - 0.72 * 0.2.
    assert hls_palette(4)[2] == pytest.approx((0.816, 0.96, 0.24))
    assert len(set(hls_palette(7))) == 7


@pytest.mark.unit
def test_bars_draw_the_numbers() -> None:
    ours = {"train": Bar(0.9, 0.88, 0.91), "test": Bar(0.7, 0.65, 0.72)}
    settings = [
        BarSetting("mine", RED, ours, {"test": Bar(0.6, 0.5, 0.7)}, "1 seed", "8 seeds"),
        BarSetting("other", RED, {"test": Bar(0.2, 0.2, 0.2)}, {}),
    ]
    figure = bars(settings, SUCCESS, footnote="error bars: so")
    (axes,) = figure.axes
    shown = [
        (p.get_x() + p.get_width() / 2, p.get_height(), p.get_alpha(), bool(p.get_hatch()))
        for p in axes.patches
    ]
    assert shown[0] == pytest.approx((-0.21, 90.0, 0.25, False))
    assert shown[1] == pytest.approx((-0.21, 70.0, 0.8, True))
    assert shown[2] == pytest.approx((0.21, 60.0, 0.8, True))
    assert shown[3] == pytest.approx((1.0, 20.0, 0.8, True))  # Nothing of the paper: in the middle.
    assert axes.patches[1].get_zorder() > axes.patches[0].get_zorder()
    assert to_rgb(axes.patches[0].get_facecolor()) == RED
    assert to_rgb(axes.patches[2].get_facecolor()) != RED
    ends = [c.get_paths()[0].vertices[:, 1] for c in axes.collections]
    assert ends[0] == pytest.approx([88.0, 91.0])
    assert ends[1] == pytest.approx([65.0, 72.0])
    assert ends[2] == pytest.approx([50.0, 70.0])
    ticks = [label.get_text() for label in axes.get_xticklabels()]
    assert ticks == ["jaxnew\n1 seed", "paper\n8 seeds", "jaxnew"]
    assert texts(figure) == "90.0 | 70.0 | 60.0 | mine | 20.0 | other"
    assert legend_texts(figure) == ["unseen test actions", "train actions"]
    assert figure.get_supxlabel() == "error bars: so"
    assert axes.get_ylim() == (0.0, 110.0)


@pytest.mark.unit
def test_a_metric_has_the_unit_and_limit_of_the_paper() -> None:
    assert Metric.of("is_success").text(0.7029) == "70.3"
    height = Metric("Final height (m)", limit=2.75, unit=" m", cuts_train=True)
    assert Metric.of("final_height", "final_height") == Metric.of("final_height") == height
    assert Metric.of("click_through_rate", "ctr").text(0.1968) == "0.197"
    assert Metric.of("has_reached_subgoal").name == "Reached subgoal (%)"
    high = bars([BarSetting("a", RED, {"test": Bar(7.5, 7.0, 8.0)}, {})], Metric.of("x", "ctr"))
    assert high.axes[0].get_ylim()[1] > 8.0  # A limit never hides a bar.


@pytest.mark.unit
def test_heights_end_at_the_papers_limit_unless_test_bars_are_higher() -> None:
    metric = Metric.of("final_height")
    both = {"train": Bar(7.5, 6.4, 8.7), "test": Bar(1.4, 1.3, 1.5)}
    lines = {"random": 1.25, "scripted": 4.25}
    settings = [
        BarSetting("a", RED, both, {"train": Bar(2.5, 2.25, 2.8)}, anchors=lines),
        BarSetting("b", RED, {"test": Bar(1.0, 0.9, 1.1)}, {}, anchors={"scripted": 3.5}),
        BarSetting("b", RED, {"test": Bar(1.0, 0.9, 1.1)}, {}, anchors={"scripted": 4.25}),
        BarSetting("c", RED, {"test": Bar(1.0, 0.9, 1.1)}, {}, anchors={"random": 1.5}),
    ]
    figure = bars(settings, metric, footnote="so")
    (axes,) = figure.axes
    assert axes.get_ylim() == (0.0, 2.75)
    numbers = {t.get_text(): t for t in axes.texts}
    # Cut off, with its number below the end; one whose error bar alone is, without an arrow.
    assert numbers["7.500 ↑"].xy[1] == numbers["2.500"].xy[1] == 2.75
    assert {numbers[text].get_va() for text in ("7.500 ↑", "2.500")} == {"top"}
    assert (numbers["1.400"].xy[1], numbers["1.400"].get_va()) == (1.5, "baseline")
    drawn = [
        (tuple(line.get_xdata()), line.get_ydata()[0], line.get_linestyle())
        for line in axes.lines
        if len(line.get_xdata()) == 2
    ]
    assert drawn == [
        ((-0.46, 0.46), 1.25, ":"),
        ((-0.46, 0.46), 4.25, "-."),
        ((0.54, 1.46), 3.5, "-."),
        ((1.54, 2.46), 4.25, "-."),
        ((2.54, 3.46), 1.5, ":"),
    ]
    assert legend_texts(figure) == ["unseen test actions", "train actions", "random", "scripted"]
    assert figure.get_supxlabel() == "so\nLines above the axis: scripted at 4.250, 3.500 m."
    higher = bars([BarSetting("a", RED, {"test": Bar(3.0, 2.9, 3.0)}, {})], metric)
    assert higher.axes[0].get_ylim()[1] == pytest.approx(1.12 * 3.0)


@pytest.mark.unit
def test_scatter_draws_each_class_in_its_colour(tmp_path: Path) -> None:
    points = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])
    figure = tsne_scatter([Scatter(points, np.array([2, 0, 2]), "below")], ("a", "b", "c"), "title")
    first, second = (c for c in figure.axes[0].collections if isinstance(c, PathCollection))
    assert first.get_offsets().tolist() == [[2.0, 3.0]]
    assert second.get_offsets().tolist() == [[0.0, 1.0], [4.0, 5.0]]
    assert second.get_facecolor()[0][:3] == pytest.approx(hls_palette(3)[2])
    assert legend_texts(figure) == ["a", "c"]
    assert not figure.axes[0].axison
    written = save(figure, tmp_path / "new" / "a.png", pdf=True)
    assert [path.name for path in written] == ["a.png", "a.pdf"]
    assert Image.open(written[0]).size == (920, 960)
    assert written[1].read_bytes().startswith(b"%PDF")


@pytest.mark.unit
def test_the_legend_is_not_wider_than_the_picture() -> None:
    domain = Domain.of(load_task("create-push"))
    names = domain.universe.class_names
    labels = np.unique(domain.universe.class_labels[domain.split.test])
    points = np.column_stack([labels, labels]).astype(float)
    figure = tsne_scatter([Scatter(points, labels)] * 2, names)
    figure.draw_without_rendering()
    (legend,) = figure.legends
    extent = legend.get_window_extent()
    assert 0.5 * figure.bbox.width < extent.width < figure.bbox.width
    assert amount(96.0) == "96 steps"
