"""Our settings stand beside the rows of the paper that are theirs."""

from __future__ import annotations

import pytest

from experiments.reports.figure_list import FIGURES
from experiments.reports.paper import paper_method, paper_value
from experiments.reports.production import Cell
from tests.experiments.handwritten import source_of, unwritten

OURS = Cell("ours", "hvae")
NO_SUBGOALS = Cell("ours", "hvae", variant="-no-subgoals")
CONDITIONED = Cell("ours", "hvae", conditions_position=True)
FULL = Cell("ours", "hvae", split="full")
NO_PLACE = Cell("ours", "hvae", variant="-no-place")
SQUARE = Cell("ours", "hvae", variant="-2d-place")
TASK = "shape_stacking"


@pytest.mark.golden
@pytest.mark.parametrize(
    ("task", "cell", "train", "test"),
    [
        # In percent.
        ("create-push", OURS, 90.7, 79.7),
        ("create-push", Cell("ours", "vae"), 66.6, 39.3),
        ("create-obstacle", Cell("no-entropy", "hvae"), 34.1, 28.1),
        ("create-push", FULL, 96.8, 17.2),
        ("create-seesaw", Cell("ours", "hvae-video"), 52.1, 43.1),
        ("create-seesaw", Cell("ours", "gt32"), 10.1, 7.9),
        ("create-push", Cell("ours", "gt32"), None, None),
        ("create-push", Cell("ours", "hvae-oracle"), 91.2, 74.5),
        ("create-ladder", Cell("nearest-neighbour", "hvae"), 98.9, 10.3),
        ("create-basket", Cell("ours", "vae"), 68.1, 61.2),
        ("create-obstacle", NO_SUBGOALS, 52.0, 30.1),
        ("create-seesaw", CONDITIONED, 97.0, 68.0),
        ("create-push", Cell("no-entropy", "hvae", variant="-no-subgoals"), None, None),
        ("create-push", Cell("ours", "vae", split="full"), None, None),
        ("create-push", Cell("ours", "hvae", variant="-analysis"), None, None),
        ("create-ladder", CONDITIONED, None, None),
    ],
    ids=lambda value: value.label if isinstance(value, Cell) else None,
)
def test_bars_stand_beside_their_rows(
    task: str, cell: Cell, train: float | None, test: float | None
) -> None:
    group = unwritten(source_of(task), cell)
    found = []
    for split in ("train", "test"):
        value = None
        if group.paper_method is not None:
            environment = str(group.paper_environment)
            value = paper_value(environment, group.paper_method, split, group.paper_figure)
        found.append(None if value is None else 100 * value.mean)
    # 0.1: the numbers above are rounded, some twice.
    assert found == pytest.approx([train, test], abs=0.1)


@pytest.mark.golden
@pytest.mark.parametrize(
    ("cell", "train", "test"),
    [
        (OURS, 2.354, 1.716),
        (Cell("ours", "vae"), 2.231, 1.526),
        (Cell("continuous", "hvae"), 1.473, 1.120),
        (Cell("nearest-neighbour", "hvae"), 7.545, 1.433),
        (Cell("no-entropy", "hvae"), 2.228, 1.604),
        (Cell("no-subsampling", "hvae"), 7.239, 1.241),
        (Cell("ours", "gt21"), 1.436, 1.329),
        (Cell("ours", "hvae-oracle"), 2.326, 1.660),
        (NO_PLACE, 2.612, 1.412),
        (SQUARE, 1.618, 1.448),
        (FULL, 2.407, 1.288),
        (Cell("ours", "vae", split="full"), None, None),
        (Cell("no-entropy", "hvae", variant="-no-place"), None, None),
        (Cell("ours", "hvae", variant="-no-place", split="full"), None, None),
        (Cell("no-entropy", "hvae", split="full"), None, None),
    ],
    ids=lambda value: value.label if isinstance(value, Cell) else None,
)
def test_heights_stand_beside_their_rows(
    cell: Cell, train: float | None, test: float | None
) -> None:
    group = unwritten(source_of(TASK), cell)
    found = []
    for split in ("train", "test"):
        value = None
        if group.paper_method is not None:
            value = paper_value("Shape Stacking", group.paper_method, split, group.paper_figure)
        found.append(None if value is None else value.mean)
    # The numbers above are rounded.
    assert found == pytest.approx([train, test], abs=6e-4)


@pytest.mark.unit
def test_every_bar_of_the_paper_is_found() -> None:
    lacking = []
    for number, figure in FIGURES.items():
        for task, cells in figure.cells.items():
            if figure.kind == "bars" and task.startswith("create-"):
                for cell in cells:
                    group = unwritten(source_of(task), cell)
                    arguments = str(group.paper_environment), str(group.paper_method), "test"
                    if paper_value(*arguments, group.paper_figure) is None:
                        lacking.append((number, task, cell.representation))
    assert lacking == [("7b", "create-push", "gt32"), ("7b", "create-obstacle", "gt32")]


@pytest.mark.unit
def test_both_names_of_the_default_modality_count() -> None:
    assert paper_method("ours", "hvae-image") == "ours"
    assert paper_method("ours", "vae-image") == "vae"
    assert paper_method("no-subsampling", "hvae-image") == "ours_no_subsampling"
