"""Learning curves show the numbers that they are given."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.reports.curves import CurveSetting, RunCurve, learning_curves, mean_curve
from experiments.reports.paper import PaperCurve
from tests.experiments.reports.test_plots import RED, SUCCESS, legend_texts, texts


@pytest.mark.unit
def test_a_curve_is_held_at_its_first_maximum() -> None:
    held = RunCurve(np.arange(6.0), np.array([2.0, 1.0, 3.0, 2.0, 3.0, 0.0])).held_at_best()
    assert held.values.tolist() == [2.0, 1.0, 3.0, 3.0, 3.0, 3.0]
    assert held.steps.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.unit
def test_mean_over_seeds_where_all_of_them_are() -> None:
    runs = [
        RunCurve(np.array([1.0, 2.0, 3.0]), np.array([0.0, 2.0, 9.0])),
        RunCurve(np.array([1.0, 2.0]), np.array([2.0, 6.0])),
    ]
    steps, mean, std = mean_curve(runs)
    assert steps.tolist() == [1.0, 2.0]
    assert mean.tolist() == [1.0, 4.0]
    assert std.tolist() == [1.0, 2.0]  # Population deviation of (0, 2) and (2, 6).


@pytest.mark.unit
def test_learning_curves_draw_the_numbers() -> None:
    runs = [
        RunCurve(np.array([1e6, 2e6, 3e6]), np.array([0.1, 0.5, 0.2])),
        RunCurve(np.array([1e6, 2e6, 3e6]), np.array([0.3, 0.3, 0.7])),
    ]
    paper = PaperCurve(np.array([2e6, 8e6]), np.array([0.4, 0.9]), np.array([0.1, 0.05]))
    setting = CurveSetting("mine", RED, {"train": runs}, {"train": paper}, "the paper")
    figure = learning_curves([setting], SUCCESS)
    train, validation = figure.axes
    lines = {line.get_label(): [] for line in train.lines}
    for line in train.lines:
        lines[line.get_label()].append(np.array(line.get_data()))
    x, y = lines["mine: run"][0]
    assert x.tolist() == [1.0, 2.0, 3.0]
    assert y == pytest.approx([10.0, 50.0, 20.0])
    # Held at best: (10, 50, 50) and (30, 30, 70); mean and, as half a band, deviation.
    x, y = lines["mine"][0]
    assert y == pytest.approx([20.0, 40.0, 60.0])
    band = train.collections[-1].get_paths()[0].vertices
    assert band[band[:, 0] == 1.0][:, 1].min() == pytest.approx(10.0)
    assert band[band[:, 0] == 3.0][:, 1].max() == pytest.approx(70.0)
    x, y = lines["the paper"][0]
    assert x.tolist() == [2.0, 8.0]
    assert y == pytest.approx([40.0, 90.0])
    # Ours ends at 3 million: a line tells where the paper's curve goes to.
    assert train.get_xlim()[1] == pytest.approx(3.03)
    assert texts(figure) == "paper after 8 million: 90.0%"
    assert len(validation.lines) == 0
    assert legend_texts(figure) == [
        "mine, held at best (mean ± std of 2 seeds)",
        "every evaluation of a run",
        "the paper, held at best (mean ± std over seeds)",
    ]


@pytest.mark.unit
def test_a_paper_curve_of_two_settings_is_drawn_once() -> None:
    run = {"train": [RunCurve(np.array([1e6, 2e6]), np.array([0.1, 0.5]))]}
    paper = {"train": PaperCurve(np.array([1e6, 2e6]), np.array([0.4, 0.9]), np.zeros(2))}
    settings = [CurveSetting(name, RED, run, paper) for name in ("a", "b")]
    figure = learning_curves(settings, SUCCESS, ["train"])
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert labels.count("paper") == 1
    assert {"a", "b"} < set(labels)
