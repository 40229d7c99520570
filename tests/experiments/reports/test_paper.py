"""The paper's numbers are those of the released results."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.reports.paper import (
    PaperError,
    paper_curve,
    paper_environments,
    paper_method,
    paper_results,
    paper_steps,
    paper_value,
)


@pytest.mark.golden
@pytest.mark.parametrize(
    ("environment", "method", "split", "mean", "std", "num_seeds"),
    [
        ("Grid World", "ours", "train", 0.9042, 0.0104, 9),
        ("Grid World", "ours", "test", 0.7029, 0.0386, 8),
        ("Grid World", "ours_onehot", "test", 0.7251, 0.0139, 8),
        ("Grid World", "ours_engineered", "test", 0.7972, 0.0245, 8),
        ("Grid World", "vae", "train", 0.6994, 0.0076, 6),
        ("CREATE Push", "ours", "test", 0.7968, 0.1339, 5),
        ("CREATE Ladder", "nearest_neighbor", "test", 0.1035, 0.1463, 3),
        ("Recommender (fully observable)", "ours", "test", 0.4203, 0.0054, 5),
    ],
)
def test_bars_of_the_paper(
    environment: str, method: str, split: str, mean: float, std: float, num_seeds: int
) -> None:
    # 1e-4: the precision of the published table.
    value = paper_value(environment, method, split)
    assert value is not None
    assert value.mean == pytest.approx(mean, abs=1e-4)
    assert value.std == pytest.approx(std, abs=1e-4)
    assert value.num_seeds == num_seeds


@pytest.mark.golden
def test_the_first_figure_counts_unless_one_is_named() -> None:
    # Push, default split 79.7 and class-disjoint split 17.2.
    main = paper_value("CREATE Push", "ours", "test")
    full = paper_value("CREATE Push", "ours", "test", figure="fig7a_create_full_split")
    assert main is not None
    assert full is not None
    assert main.mean == 0.7968
    assert full.mean == pytest.approx(0.172, abs=5e-4)


@pytest.mark.golden
def test_all_rows_are_read() -> None:
    environments = paper_environments()
    assert len(environments) == 16
    assert sum(len(paper_results(name)) for name in environments) == 384
    assert {row.metric for row in paper_results("Recommender")} == {"ctr"}
    assert {row.metric for row in paper_results("Shape Stacking")} == {"final_height"}
    assert {row.metric for row in paper_results("Grid World")} == {"success_rate"}


@pytest.mark.golden
def test_learning_curve_in_true_steps_without_padding() -> None:
    curve = paper_curve("Grid World", "ours", "train")
    assert curve is not None
    # First traced point: plotted at 1.118 million, really 2.236 million steps.
    assert [values[0] for values in curve] == [2.236e6, 0.2529, 0.1589]
    assert np.all(np.diff(curve.steps) > 0)
    # The released plot goes on to 116 million steps; the runs had 40 million.
    assert 36e6 < curve.steps[-1] <= 40e6
    assert len(curve.steps) == len(curve.mean) == len(curve.std)


@pytest.mark.golden
@pytest.mark.parametrize(
    ("environment", "split", "end"),
    [
        ("Grid World", "train", 0.928),
        ("Grid World", "validation", 0.777),
        ("Recommender", "validation", 0.216),
        ("Shape Stacking", "train", 2.538),
    ],
)
def test_ends_of_learning_curves(environment: str, split: str, end: float) -> None:
    # The last point before the budget may be one bin earlier.
    curve = paper_curve(environment, "ours", split)
    assert curve is not None
    assert curve.mean[-1] == pytest.approx(end, rel=0.005)


@pytest.mark.unit
def test_what_the_paper_did_not_show_is_none() -> None:
    assert paper_value("Grid World", "ours", "validation") is None
    assert paper_value("Recommender", "vae", "test") is None
    assert paper_value("Grid World", "ours", "test", figure="fig7a_create_full_split") is None
    assert paper_curve("Grid World", "ours_onehot", "train") is None
    assert paper_curve("CREATE Ladder", "ours", "train") is None


@pytest.mark.unit
def test_wrong_names_are_answered_with_the_right_ones() -> None:
    with pytest.raises(PaperError, match=r"environment 'grid_world'.*Grid World"):
        paper_value("grid_world", "ours", "test")
    with pytest.raises(PaperError, match=r"method 'hvae'.*ours_onehot"):
        paper_value("Grid World", "hvae", "test")
    with pytest.raises(PaperError, match=r"split 'tests'.*train.*test"):
        paper_value("Grid World", "ours", "tests")
    with pytest.raises(PaperError, match=r"figure 'fig4'.*fig4_baselines"):
        paper_value("Grid World", "ours", "test", figure="fig4")
    with pytest.raises(PaperError, match=r"method 'hvae'"):
        paper_curve("Grid World", "hvae", "train")
    with pytest.raises(PaperError, match=r"split 'val'.*validation"):
        paper_curve("Grid World", "ours", "val")
    with pytest.raises(PaperError, match=r"environment 'Push'"):
        paper_steps("Push")


@pytest.mark.unit
def test_names_of_our_settings_in_the_paper() -> None:
    assert paper_method("ours", "hvae") == "ours"
    assert paper_method("ours", "hvae-xy") == "ours"
    assert paper_method("ours", "hvae-onehot") == "ours_onehot"
    assert paper_method("ours", "gt12") == "ours_engineered"
    assert paper_method("ours", "vae") == "vae"
    assert paper_method("ours", "gt5") is None
    assert paper_method("nearest", "hvae") is None


@pytest.mark.unit
def test_training_budgets() -> None:
    assert paper_steps("Grid World") == 40e6
    assert paper_steps("CREATE Belt") == 60e6
    assert paper_steps("Shape Stacking") == 3e6
    assert paper_steps("Recommender (fully observable)") == 80e6
