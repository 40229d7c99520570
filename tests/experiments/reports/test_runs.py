"""Run directories as the figures read them, and their groups."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs_mjx.grid_world import skill_universe
from envs_mjx.recommender import product_universe
from experiments.reports.paper import paper_set_size
from experiments.reports.results import result_rows
from experiments.reports.runs import policies, read_runs
from jaxnew.representation.table import RepresentationTable, engineered_table
from jaxnew.results import Question
from jaxnew.storage import config as config_lib
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.metrics import MetricsError, MetricsLog
from jaxnew.storage.run_directory import RunDirectory, RunDirectoryError
from jaxnew.task.domain import load_task
from jaxnew.task.places import UsageError
from tests.experiments.handwritten import groups_at, plain_config, write_evaluation, write_run


@pytest.mark.unit
def test_runs_are_grouped_over_seeds_only(tmp_path: Path) -> None:
    one = write_run(tmp_path / "a", plain_config(seed=2))
    other = write_run(tmp_path / "b", plain_config(seed=1))
    faster = write_run(tmp_path / "c", plain_config(seed=1, learning_rate=0.01))
    first, second = groups_at(one, faster, other, one)
    assert [run.path for run in first.runs] == [other, one]
    assert [run.path for run in second.runs] == [faster]
    assert first.label == "ours, gt12, learning_rate 0.001"
    assert second.label == "ours, gt12, learning_rate 0.01"
    copy = write_run(tmp_path / "d", plain_config(seed=2))
    with pytest.raises(UsageError, match=r"a and .*d are the same setting with the same seed, 2"):
        groups_at(one, copy)


@pytest.mark.unit
def test_settings_that_differ_in_little_things_still_have_names_of_their_own(
    tmp_path: Path,
) -> None:
    config = plain_config()
    more = {**config, "loop": {**config["loop"], "evaluation_episodes": 1}}
    paths = write_run(tmp_path / "a", config), write_run(tmp_path / "b", more)
    assert [group.label for group in groups_at(*paths)] == ["ours, gt12", "ours, gt12 #2"]


@pytest.mark.unit
def test_a_sweep_stands_for_its_members(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    RunDirectory.open_or_create(sweep, {"members": [{}, {}]}).close()
    with pytest.raises(UsageError, match="written no members yet"):
        read_runs([sweep])
    members = [write_run(sweep / "members" / f"{i:03d}", plain_config(seed=i)) for i in range(2)]
    assert [run.path for run in read_runs([sweep, members[0]])] == members
    with pytest.raises(UsageError, match="Say which runs"):
        read_runs([])
    RunDirectory.open_or_create(tmp_path / "other", {"x": 1}).close()
    with pytest.raises(UsageError, match="no run of train, sweep or embed"):
        read_runs([tmp_path / "other"])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("given", "source", "name", "paper"),
    [
        ("hvae-onehot", "hvae-onehot, laptop, seed 31", "hvae-onehot", "ours_onehot"),
        ("runs/grid_world/embed-3", "hvae, fast, seed 31", "hvae", "ours"),
        ("mine.npz", "engineered:gt12", "gt12", "ours_engineered"),
        ("mine.npz", "/home/me/mine.npz", "mine", None),
        ("gt5", "engineered:gt5", "gt5", None),
    ],
)
def test_names_of_representations(
    tmp_path: Path, given: str, source: str, name: str, paper: str | None
) -> None:
    vectors = skill_universe().engineered["gt5"]
    table = RepresentationTable(vectors, np.arange(1024, dtype=np.int32), source=source)
    config = plain_config(representation=given)
    (group,) = groups_at(write_run(tmp_path / "run", config, table=table))
    assert group.runs[0].representation == name
    assert group.paper_method == paper


@pytest.mark.unit
def test_another_split_is_not_compared_with_the_paper(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run", plain_config(split="another"))
    write_evaluation(path, "test", 0.75)
    (group,) = groups_at(path)
    assert group.paper_method is None
    assert result_rows(group)[0].paper_mean is None


@pytest.mark.unit
@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ('{"', "{", r"test-best-sampled-m50-\w{8}\.json is damaged \(Expecting"),
        (
            '"mean": 0.5',
            '"mean": 0.6',
            r"m50-\w{8}\.json was edited or damaged: its hash is [0-9a-f]{16}",
        ),
        # As 0.2.0 wrote it, and then altered.
        (
            '"mean": 0.5',
            '"mean": 0.9',
            r"m50-\w{8}\.json is damaged: the mean of is_success, 0\.9, is not",
        ),
        ('"low": 0.48', '"low": NaN', r"m50-\w{8}\.json is damaged: .* \[nan, 0\.51\]"),
    ],
)
def test_a_damaged_evaluation_is_named(tmp_path: Path, before: str, after: str, says: str) -> None:
    path = write_run(tmp_path / "run", plain_config())
    write_evaluation(path, "test", 0.5)
    (file,) = (path / "evaluation").iterdir()
    text = json.dumps(json.loads(file.read_text()))
    if "was edited" not in says:
        text = re.sub(', "hash": "[0-9a-f]*"', "", text)
    file.write_text(text.replace(before, after))
    (run,) = read_runs([path])
    with pytest.raises(RunDirectoryError, match=says):
        run.answer(Question("test", 50))


@pytest.mark.unit
def test_metrics_are_those_of_the_checkpoint(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run", plain_config())
    state, mark = {"step": 4}, MetricsLog(path).mark
    Checkpointer(path / "checkpoints").save("latest", 4, state, {"metrics": mark})
    assert len(read_runs([path])[0].reports) == 6
    (path / "metrics.jsonl").unlink()
    with pytest.raises(MetricsError, match=r"metrics\.jsonl is missing; .* 6 reports"):
        read_runs([path])[0].reports  # noqa: B018


@pytest.mark.unit
def test_the_recommender_that_shows_its_constants_is_another_environment(tmp_path: Path) -> None:
    table = engineered_table(product_universe(), "product-mu")
    config = {
        **plain_config(representation="product-mu"),
        "task": "recommender",
        "method": "no-entropy",
        "environment": config_lib.plain(load_task("recommender").environment),
    }
    config["sets"]["size"] = 500
    (group,) = groups_at(write_run(tmp_path / "run", config, table=table))
    assert group.paper_environment == "Recommender (fully observable)"
    assert group.paper_method == "ours_no_entropy"
    assert group.standard("train") == Question("train", 500)
    assert group.standard("test") == Question("test", 25)
    assert paper_set_size("Recommender", "test", 500) == 500


@pytest.mark.unit
def test_a_question_is_answered_by_one_evaluation(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run", plain_config())
    write_evaluation(path, "test", 0.5)
    write_evaluation(path, "test", 0.6, set_size=10)
    write_evaluation(path, "test", 0.7, first_size=5, growth=5)
    write_evaluation(path, "test", 0.8, policy="greedy")
    write_evaluation(path, "test", 0.9, checkpoint="latest")
    write_evaluation(path, "train", 0.4, evaluation_seed=1)  # Other episodes.
    (run,) = read_runs([path])

    def mean(*asked: Any, episodes: int = 1000, **options: Any) -> float | None:
        found = run.answer(Question(*asked, **options), episodes)
        return None if found is None else found["metrics"]["is_success"]["mean"]

    assert mean("test", 50) == 0.5
    assert mean("test", 10) == 0.6
    assert mean("test", 50, first_size=5, growth=5) == 0.7
    assert mean("test", 50, policy="greedy") == 0.8
    assert mean("test", 50, checkpoint="latest") == 0.9
    assert mean("test", 50, first_size=5, growth=1) is None
    assert mean("test", 50, first_size=4, growth=5) is None
    assert mean("test", 20) is None
    assert mean("train", 50) is None
    assert mean("test", None) is None  # Nothing says that it was the whole set.
    assert mean("test", 50, episodes=1001) is None
    with pytest.raises(UsageError, match="needs a run of train"):
        policies([write_run(tmp_path / "embed", EMBEDDED)])


EMBEDDED = {
    "task": "grid_world",
    "representation": "hvae",
    "seed": 1,
    "split": "default",
    "model": {},
}
