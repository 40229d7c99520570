"""Which figures of the paper there are, and what they show."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs_host.create.levels import TASK_NAMES
from experiments.reports.figure_list import FIGURES, number_of
from experiments.reports.paper_figures import parse_given
from jaxnew.task.places import UsageError
from tests.experiments.handwritten import source_of

TASK = "shape_stacking"


@pytest.mark.unit
def test_figures_that_do_not_exist_are_named(tmp_path: Path) -> None:
    assert number_of("10", "grid_world") == "19"
    assert number_of("19", "create-push") == "10"
    with pytest.raises(UsageError, match=r"No figure '3'; choose of 4, 5, 6, 7a"):
        number_of("3", "grid_world")
    with pytest.raises(UsageError, match="Figure 7b does not show recommender; it shows grid_wo"):
        number_of("7b", "recommender")
    with pytest.raises(UsageError, match="must be NAME=PATH"):
        parse_given([f"hvae={tmp_path / 'absent.npz'}"])
    with pytest.raises(UsageError, match="must be NAME=PATH"):
        parse_given(["hvae"])


@pytest.mark.unit
def test_figures_show_the_tasks_of_the_paper() -> None:
    shown = {
        number: sorted(t.removeprefix("create-") for t in figure.cells if t.startswith("create-"))
        for number, figure in FIGURES.items()
    }
    main = ["obstacle", "push", "seesaw"]
    further = sorted(level.lower() for level in TASK_NAMES if level.lower() not in main)
    for number in ("4", "6", "7a", "7b", "9a", "9b", "9c", "20", "21", "24"):
        assert shown[number] == main, number
    assert shown["18"] == further
    assert (shown["10"], shown["19"]) == (["push"], ["obstacle", "seesaw"])
    for number in ("5", "8", "15"):
        assert shown[number] == sorted(main + further)
    assert [cell.label for cell in FIGURES["15"].cells["create-push"]] == [
        "ours, hvae",
        "ours, vae",
        "ours, hvae-video",
        "ours, hvae, split full",
    ]
    for figure in FIGURES.values():
        for task, cells in figure.cells.items():
            if figure.kind == "study":
                source = source_of(task).of(cells[0])
                study = source.domain.task.shown.studies[figure.study]
                assert FIGURES[study.figure] is figure


@pytest.mark.unit
def test_figures_that_show_stacking() -> None:
    shown = [number for number, figure in FIGURES.items() if TASK in figure.cells]
    assert shown == ["4", "6", "7b", "8", "16", "19", "23", "24"]
    assert number_of("10", TASK) == "19"
    assert [cell.label for cell in FIGURES["23"].cells[TASK]] == [
        "ours, hvae",
        "ours, hvae, no place",
        "ours, hvae, 2d place",
        "ours, hvae, split full",
    ]
    assert [cell.label for cell in FIGURES["16"].cells[TASK]] == [
        "ours, hvae",
        "ours, vae",
        "ours, hvae, split full",
    ]
