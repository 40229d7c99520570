"""Learning curves are compared with the paper's at equal steps."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from envs_mjx.grid_world import skill_universe
from experiments.reports import comparison, paper_figures
from experiments.reports.comparison import compare_curves, comparison_markdown, verdict_of
from experiments.reports.figure_list import FIGURES
from experiments.reports.paper import paper_curve
from experiments.reports.production import Cell
from jaxnew.representation.table import RepresentationTable
from tests.experiments.handwritten import group_of, groups_at, plain_config, source_of, write_run

OURS = Cell("ours", "hvae")
TASK = "shape_stacking"


@pytest.mark.unit
def test_curves_are_compared_at_equal_steps(tmp_path: Path) -> None:
    vectors = skill_universe().engineered["gt12"]
    ids = np.arange(1024, dtype=np.int32)
    table = RepresentationTable(vectors, ids, source="hvae")
    for seed, values in ((1, (0.0, 0.4, 0.2, 0.1)), (2, (0.2, 0.2, 0.2, 0.6))):
        config = {**plain_config(seed, "hvae"), "num_updates": 8}
        config["ppo"]["rollout"] |= {"num_envs": 1000, "num_steps": 1000}  # 1 M steps an update.
        write_run(tmp_path / f"{seed}", config, curve=values, table=table)
    points = compare_curves(groups_at(tmp_path / "1", tmp_path / "2"))
    train = [p for p in points if p.split == "train"]
    assert [p.steps for p in train] == [2e6, 4e6, 6e6, 8e6]
    # Held at best: (0, .4, .4, .4) and (.2, .2, .2, .6); mean and population deviation.
    assert [p.mean for p in train] == pytest.approx([0.1, 0.3, 0.3, 0.5])
    assert [p.std for p in train] == pytest.approx([0.1, 0.1, 0.1, 0.1])
    published = paper_curve("Grid World", "ours", "train")
    expected = np.interp(6e6, published.steps, published.mean)
    assert train[2].paper_mean == pytest.approx(expected)
    assert train[2].verdict == "below"
    text = comparison_markdown("t", points, groups_at(tmp_path / "1")[0].metric)
    assert "| train | 6.00 | 30.0 ± 10.0 (2 seeds) |" in text


@pytest.mark.unit
def test_on_means_within_the_root_of_the_summed_variances() -> None:
    assert verdict_of(0.5, 0.03, 0.45, 0.04) == "on"  # Just: sqrt(0.03^2 + 0.04^2) = 0.05.
    assert verdict_of(0.501, 0.03, 0.45, 0.04) == "above"
    assert verdict_of(0.399, 0.03, 0.45, 0.04) == "below"
    assert verdict_of(0.5, 0.1, None, None) is None


@pytest.mark.golden
def test_learning_curves_stand_beside_the_papers(tmp_path: Path) -> None:
    """Ours at a third, two thirds and all of the budget."""
    source = source_of(TASK, tmp_path, budget="paper")
    # 244 updates of 4,096 steps are a third of 3 million.
    group = group_of(source, OURS, curve=(1.5, 2.4, 2.1), updates=244)
    picture, text, table = paper_figures.draw_curves("figure_24", "Curves", [group], tmp_path)
    with table.open() as file:
        rows = list(csv.DictReader(file))
    train = {round(float(r["steps"]), -4): r for r in rows if r["split"] == "train"}
    validation = {round(float(r["steps"]), -4): r for r in rows if r["split"] == "validation"}
    assert [float(train[s]["mean"]) for s in (1e6, 2e6, 3e6)] == [1.5, 2.4, 2.4]
    # The curves were traced, and are straight between points: 0.05.
    for rows_of, means in ((train, (2.160, 2.320)), (validation, (1.687, 1.777))):
        found = [float(rows_of[s]["paper_mean"]) for s in (1e6, 2e6)]
        assert found == pytest.approx(means, abs=0.05)
    assert "Final height (m); every seed held" in text.read_text()
    assert Image.open(picture).size[0] > 800
    curve = paper_curve("Shape Stacking", "ours", "train")
    assert curve.mean[-1] == pytest.approx(2.538, abs=0.005)
    assert 2.7e6 < curve.steps[-1] <= 3e6


@pytest.mark.unit
def test_train_curves_of_another_simulator_are_not_compared(tmp_path: Path) -> None:
    """Those of methods with one fixed set; their validation curves are sound."""
    source = source_of(TASK, tmp_path, budget="paper")
    cells = (OURS, Cell("nearest-neighbour", "hvae"), Cell("no-subsampling", "hvae"))
    groups = [group_of(source, cell, curve=(1.5, 2.4, 2.1), updates=244) for cell in cells]
    for group in groups:
        points = [p for p in comparison.compare_curves([group]) if p.paper_mean is not None]
        assert {p.split for p in points} == {"train", "validation"}
        for point in points:
            is_fair = group is groups[0] or point.split == "validation"
            assert (point.verdict is not None) == is_fair
    note = FIGURES["24"].notes[TASK]
    _, text, _ = paper_figures.draw_curves("f", "Curves", groups, tmp_path, note=note)
    assert text.read_text().rstrip().endswith(note)
