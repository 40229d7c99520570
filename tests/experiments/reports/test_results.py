"""The table of evaluations sets ours beside the paper's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from envs_mjx.grid_world import skill_universe
from experiments.reports.paper import paper_value
from experiments.reports.production import Cell
from experiments.reports.results import as_markdown, result_rows
from experiments.reports.runs import read_runs
from jaxnew.representation.table import RepresentationTable
from jaxnew.results import Question
from jaxnew.storage.run_directory import RunDirectory
from tests.experiments.handwritten import (
    config_of,
    groups_at,
    plain_config,
    source_of,
    write_evaluation,
    write_run,
)
from tests.experiments.reports.test_plots import SUCCESS


@pytest.mark.unit
def test_one_run_has_its_interval_and_its_distance_from_the_paper(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run", plain_config())
    write_evaluation(path, "test", 0.75)
    write_evaluation(path, "validation", 0.8)
    write_evaluation(path, "test", 0.6, policy="greedy")
    write_evaluation(path, "test", 0.5, set_size=20)
    write_evaluation(path, "test", 0.003, checkpoint="random-play")
    RunDirectory.load(path).record_evaluation("representation", {"purity_all": 0.5})
    (group,) = groups_at(path)
    rows = {(r.actions, r.checkpoint, r.policy, r.set_size): r for r in result_rows(group)}
    assert len(rows) == 5
    row = rows["test", "best", "sampled", 50]
    assert (row.mean, row.low, row.high) == pytest.approx((0.75, 0.73, 0.76))
    assert row.error == "95 % interval over episodes"
    assert (row.num_seeds, row.num_episodes) == (1, 1000)
    # 4 and 6 updates of 256 steps.
    assert (row.checkpoint_steps, row.trained_steps) == (1024.0, 1536.0)
    paper = paper_value("Grid World", "ours_engineered", "test")
    assert paper is not None
    assert (row.paper_mean, row.paper_std, row.paper_num_seeds) == paper
    assert row.paper_steps == 40e6
    assert row.difference == pytest.approx(75.0 - 79.72)  # In points.
    others = [r for key, r in rows.items() if key != ("test", "best", "sampled", 50)]
    assert [r.paper_mean for r in others] == [None] * 4
    assert [r.difference for r in others] == [None] * 4
    markdown = as_markdown("Grid World", list(rows.values()), SUCCESS, ["A note."])
    assert "75.0 [73.0, 76.0] | 79.7 ± 2.5 | -4.7 | 1 / 8 | 1,000 | 0.00154 / 40 |" in markdown
    assert "| random play | 0.3 [" in markdown
    assert "A note." in markdown


@pytest.mark.unit
def test_a_question_has_one_row_and_another_seed_of_episodes_is_another(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run", plain_config())
    write_evaluation(path, "test", 0.75)
    for episodes in range(100, 900, 100):
        write_evaluation(path, "test", 0.5, num_episodes=episodes)
    write_evaluation(path, "test", 0.25, evaluation_seed=7)
    (group,) = groups_at(path)
    usual, other = result_rows(group)
    assert (usual.mean, usual.num_episodes, usual.num_seeds) == (0.75, 1000, 1)
    assert (other.mean, other.evaluation_seed, other.is_standard) == (0.25, 7, False)
    text = as_markdown("Grid World", [usual, other], SUCCESS, [])
    assert "| sampled, best | 75.0" in text
    assert "| sampled, best, seed 7 | 25.0" in text
    # Training went on, and found a better one.
    (path / "checkpoints" / "best" / "000000000006").mkdir(parents=True)
    (group,) = groups_at(path)
    assert result_rows(group) == []


@pytest.mark.unit
def test_several_seeds_have_their_population_deviation(tmp_path: Path) -> None:
    paths = [write_run(tmp_path / f"{seed}", plain_config(seed=seed)) for seed in (1, 2, 3)]
    for path, mean in zip(paths, (0.6, 0.8, 0.9), strict=True):
        write_evaluation(path, "train", mean)
    write_evaluation(paths[0], "test", 0.5)
    (group,) = groups_at(*paths)
    train, test = result_rows(group)
    assert (train.actions, test.actions) == ("train", "test")
    # Mean 23/30; deviations -5/30, 1/30, 4/30: population variance 14/900.
    half = np.sqrt(14 / 900)
    assert train.mean == pytest.approx(23 / 30)
    assert (train.low, train.high) == pytest.approx((23 / 30 - half, 23 / 30 + half))
    assert train.error == "population std over seeds"
    assert train.num_seeds == 3
    assert train.runs == tuple(map(str, paths))
    assert test.num_seeds == 1
    assert test.error == "95 % interval over episodes"


@pytest.mark.unit
def test_the_train_bar_of_a_fixed_set_is_all_of_it(tmp_path: Path) -> None:
    config = config_of(source_of("grid_world"), Cell("no-subsampling", "hvae"))
    vectors = skill_universe().engineered["gt12"]
    ids = np.arange(1024, dtype=np.int32)
    path = write_run(
        tmp_path / "run", config, table=RepresentationTable(vectors, ids, source="hvae")
    )
    write_evaluation(path, "train", 0.6, set_size=50, num_actions=512)
    write_evaluation(path, "train", 0.9, set_size=512, num_actions=512)
    write_evaluation(path, "test", 0.2, set_size=50, num_actions=256)
    write_evaluation(path, "test", 0.3, set_size=50, num_actions=256, first_size=5, growth=5)
    (group,) = groups_at(path)
    rows = result_rows(group)
    standard = {row.actions: row for row in rows if row.is_standard}
    assert len(rows) == 4
    assert (standard["train"].mean, standard["test"].mean) == (0.9, 0.2)
    published = paper_value("Grid World", "ours_no_subsampling", "train")
    assert standard["train"].paper_mean == published.mean
    (run,) = read_runs([path])
    questions = [group.standard(part) for part in ("train", "test")]
    assert questions == [Question("train", None), Question("test", 50)]
    assert all(run.answer(question, 1000) is not None for question in questions)
    assert all(run.answer(question, 1001) is None for question in questions)
    # With an action that is always available, a whole set is larger than what it is drawn from.
    write_evaluation(path, "train", 0.9, set_size=513, num_actions=512)
    assert questions[0].is_answered_by(read_runs([path])[0].evaluations[-1])
