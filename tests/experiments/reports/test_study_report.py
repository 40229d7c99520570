"""Studies as tables and as pictures."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.reports.paper import PaperValue
from experiments.reports.plots import Metric
from experiments.reports.study_report import Study, StudyPoint, as_csv, as_markdown, study_figure


@pytest.mark.unit
def test_a_study_as_a_table_and_as_a_picture() -> None:
    points = (
        StudyPoint("a", 1.0, np.array([0.1, 0.3]), 100),
        StudyPoint("a", 2.0, np.array([0.5, 0.5]), 100),
    )
    study = Study("set-size", "size", False, Metric.of("is_success"), points, "Note.")
    text = as_markdown(study)
    assert "| 1 | 20.0 ± 10.0 |" in text
    assert "Note. Seeds: 2, 100 episodes each" in text
    (line,) = study_figure(study).axes[0].lines[:1]
    assert line.get_ydata().tolist() == pytest.approx([20.0, 50.0])


@pytest.mark.unit
def test_a_study_shows_the_papers_points_beside_their_setting() -> None:
    value = PaperValue(0.4, 0.05, 5)
    points = (
        StudyPoint("a", 2.0, np.array([0.125, 0.375]), 100, value),
        StudyPoint("a", 1.0, np.array([0.5, 0.5]), 100),
        StudyPoint("b", 2.0, np.array([0.6, 0.6]), 100),
        StudyPoint("b", 1.0, np.array([0.7, 0.7]), 100),
    )
    metric = Metric.of("is_success")
    study = Study("angle", "angle", False, metric, points, "Note.", "9a", "CREATE Push")
    lines = as_markdown(study).splitlines()
    assert lines[0] == "# Figure 9a, CREATE Push: angle: success rate (%)"
    assert lines[2] == "| angle | a | paper | b |"
    assert lines[4:6] == [
        "| 2 | 25.0 ± 12.5 | 40.0 ± 5.0 | 60.0 ± 0.0 |",
        "| 1 | 50.0 ± 0.0 | - | 70.0 ± 0.0 |",
    ]
    assert as_csv(study).splitlines()[1].endswith(",0.25,0.125,2,100,0.4,0.05,5")
    figure = study_figure(study)
    drawn = [container[0].get_xydata().tolist() for container in figure.axes[0].containers]
    assert drawn == [
        [[1.0, 50.0], [2.0, 25.0]],
        [[2.0, 40.0]],
        [[1.0, 70.0], [2.0, 60.0]],
    ]
    assert figure.get_suptitle() == "Figure 9a, CREATE Push: angle"
