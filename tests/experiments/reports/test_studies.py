"""Studies ask runs about each value of a condition; the paper's points beside ours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from experiments.reports.production import Cell
from experiments.reports.studies import kind_of, paper_point
from experiments.tasks.grid_world import TASK
from jaxnew.results import Question
from jaxnew.task.places import UsageError
from tests.experiments.handwritten import groups_at, plain_config, source_of, unwritten, write_run

FULL = Cell("ours", "hvae", split="full")


@pytest.mark.golden
@pytest.mark.parametrize(
    ("study", "means"),
    [
        # CREATE Obstacle.
        ("angle", [83.9, 83.4, 82.4, 74.5, 36.7]),
        ("embedding", [75.3, 74.1, 72.8, 71.8, 68.7, 61.5, 54.6, 44.6, 36.7, 26.7]),
        ("mix", [93.6, 90.2, 85.6, 77.3, 71.8]),
    ],
)
def test_points_of_figure_9(study: str, means: list[float]) -> None:
    source = source_of("create-obstacle")
    analysed = Cell("ours", "hvae-oracle", variant="-analysis")
    group = unwritten(source, analysed)
    kind = kind_of(study, group.task)
    points = {value: paper_point(kind, group, value) for value in kind.values}
    assert [100 * points[value].mean for value in sorted(points)] == pytest.approx(means, abs=0.06)
    assert {point.num_seeds for point in points.values()} == {5}
    assert paper_point(kind, group, 0.123) is None
    for cell in (
        Cell("no-entropy", "hvae-oracle", variant="-analysis"),
        replace(analysed, conditions_position=True),
        replace(analysed, variant="-no-subgoals-analysis"),
    ):
        other = unwritten(source, cell)
        value = kind.values[0]
        kind_of_other = kind_of(study, other.task)
        assert paper_point(kind_of_other, other, value) is None, cell


@pytest.mark.golden
def test_points_of_the_set_sizes() -> None:
    source = source_of("create-push")
    kind = kind_of("set-size", source.domain.task)
    # 10 and 60 actions.
    for method, first, last in (("ours", 45.3, 81.8), ("no-subsampling", 23.1, 41.0)):
        group = unwritten(source, Cell(method, "hvae"))
        means = [100 * paper_point(kind, group, size).mean for size in (10, 60)]
        assert means == pytest.approx([first, last], abs=0.06)
    assert paper_point(kind, group, 12) is None
    assert paper_point(kind, unwritten(source, FULL), 10) is None


@pytest.mark.unit
def test_conditions_of_the_default_axes() -> None:
    assert list(kind_of("set-size", TASK).values) == [float(n) for n in range(10, 61, 5)]
    assert list(kind_of("growing-set", TASK).values) == [5.0, 10.0, 25.0, 50.0]
    assert list(kind_of("recordings", TASK).values) == [1024, 64, 16, 4, 1]


@pytest.mark.unit
def test_what_a_value_asks_of_a_run(tmp_path: Path) -> None:
    (group,) = groups_at(write_run(tmp_path / "run", plain_config()))

    def asked(name: str, value: float) -> Question:
        return kind_of(name, group.task).asked(group.runs[0], value).question

    assert asked("set-size", 10) == Question("test", 10)
    assert asked("unseen-ratio", 0.4) == Question("unseen-0.4", 50)
    # 10 skills an episode: 9 steps after the first make 45 more.
    assert asked("growing-set", 5) == Question("test", 50, first_size=5, growth=5)
    assert asked("growing-set", 50) == Question("test", 50)
    with pytest.raises(UsageError, match="--study=recordings needs --encoder"):
        asked("recordings", 4)
    with pytest.raises(UsageError, match="has no study 'mix'; choose one of set-size, unseen-"):
        asked("mix", 4)
