"""Studies: conditions of evaluation, and the search grids, through the command."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments.pipeline.artifacts import load_encoder
from experiments.pipeline.flags import UsageError
from experiments.pipeline.training import load_trainer

from experiments.reports.plots import Metric
from experiments.reports.searches import batch_size_sources
from experiments.reports.studies import STUDIES, encoded_test_actions
from experiments.reports.study_report import Study, StudyPoint, as_markdown, study_figure
from experiments.tasks.grid_world import TASK
from jaxnew import collection
from jaxnew.actions import ActionSplit
from jaxnew.evaluation import Evaluator
from jaxnew.representation.table import RepresentationTable
from jaxnew.rollout.normalization import RunningStatistics
from jaxnew.sampling import ActionPool
from tests import probe_environments as probe
from tests.experiments.commands import run
from tests.experiments.several import run_several
from tests.experiments.test_paper_figures import source_at


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An encoder and a policy on its table, at smoke budget."""
    folder = tmp_path_factory.mktemp("runs")
    run("train", "--representation=hvae-relative", "--budget=smoke", f"--runs={folder}")
    return folder / "grid_world"


POLICY = "ours-hvae-relative-default-smoke-31"
ENCODER = "embed-hvae-relative-default-smoke-31"


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as opened:
        return list(csv.DictReader(opened))


STUDIED = {
    "set-size": "10,50",
    "unseen-ratio": "0,1",
    "growing-set": "5,50",
    "recordings": "16,1",
}


@pytest.mark.integration
def test_sizes_ratios_growth_and_recordings(runs: Path) -> None:
    common = (
        f"--run={runs / POLICY}",
        f"--encoder={runs / ENCODER}",
        "--episodes=128",
        f"--out={runs / 'analysis'}",
    )
    jobs = [(f"--study={study}", f"--values={STUDIED[study]}", *common) for study in STUDIED]
    *first, again = run_several("analyze", [*jobs, jobs[-1]])
    assert " done in " not in again
    found = {}
    for study, output in zip(STUDIED, first, strict=True):
        assert output.count(" done in ") == {"growing-set": 1}.get(study, 2)  # 50 is there already.
        name = study.replace("-", "_")
        assert (runs / "analysis" / f"{name}.png").stat().st_size > 5000
        found[study] = [float(row["mean"]) for row in rows_of(runs / "analysis" / f"{name}.csv")]
    files = {path.name for path in (runs / POLICY / "evaluation").iterdir()}
    assert {
        "test-best-sampled-m10.json",
        "test-best-sampled-m50.json",
        "unseen-0-best-sampled-m50.json",
        "test-best-sampled-m50-from5-by5.json",
        "recordings-1-best-sampled-m50.json",
    } <= files
    # The whole set from the start, all recordings, or only unseen actions: the same evaluation.
    whole = found["set-size"][1]
    assert (found["growing-set"][1], found["recordings"][0]) == (whole, whole)
    stored = json.loads(
        (runs / POLICY / "evaluation" / "unseen-1-best-sampled-m50.json").read_text()
    )
    assert stored["num_actions"] == 256
    assert found["unseen-ratio"][1] == whole


@pytest.mark.integration
def test_an_encoder_sees_the_first_recordings_of_test_actions(runs: Path) -> None:
    split = ActionSplit.load(runs / POLICY / "split.json")
    _, learner, state, _ = load_encoder(runs / ENCODER)
    recordings = collection.load(runs / "recordings-16", universe=TASK.make_universe())
    rows = recordings.rows(split.test)
    expected = learner.encode(state, recordings.data[rows][:, :4])
    np.testing.assert_array_equal(encoded_test_actions(runs / ENCODER, split, 4), expected)
    table = RepresentationTable.load(runs / POLICY / "table.npz")
    everything = encoded_test_actions(runs / ENCODER, split, 16)
    np.testing.assert_allclose(everything, table.rows(split.test), atol=1e-5)
    with pytest.raises(UsageError, match=r"17 recordings per action were asked for.*has 16"):
        encoded_test_actions(runs / ENCODER, split, 17)
    other = replace(split, seed=1)
    if other.hash != split.hash:
        with pytest.raises(UsageError, match="another split"):
            encoded_test_actions(runs / ENCODER, other, 4)
    _, trainer, _ = load_trainer(runs / POLICY)
    with pytest.raises(UsageError, match="--study=recordings needs --encoder"):
        STUDIES["recordings"].condition((trainer, split, None), 4.0)


@pytest.mark.integration
def test_a_grid_is_searched_by_validation(tmp_path: Path) -> None:
    common = ("--representation=gt12", "--budget=smoke", "--seeds=1,2", f"--runs={tmp_path}")
    output = run("analyze", "--study=entropy", "--values=0.01,0.1", *common)
    assert "4 runs of 1.02 k steps in one program" in output
    rows = rows_of(tmp_path / "grid_world" / "analysis" / "entropy.csv")
    assert [row["entropy coefficient"] for row in rows] == ["0.01", "0.1"]
    assert [row["num_seeds"] for row in rows] == ["2", "2"]
    summary = next(tmp_path.rglob("evaluation/members.json"))
    members = json.loads(summary.read_text())["members"]
    of_first = [m for m in members if m["hyperparameters"]["entropy_coefficient"] == 0.01]
    assert float(rows[0]["mean"]) == pytest.approx(np.mean([m["best_metric"] for m in of_first]))
    # One size is one program: 4 minibatches of 64 transitions are 32 steps of 8 environments.
    output = run("analyze", "--study=batch-size", "--values=128", *common)
    assert "--set=ppo.rollout.num_steps=64 --set=num_updates=2" in output
    assert "Chosen by it: transitions per minibatch 128" in output


@pytest.mark.unit
def test_a_minibatch_that_is_no_whole_number_of_steps_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="Minibatches of 3 are no whole number of steps"):
        batch_size_sources(source_at(tmp_path), "ours", [3.0])


@pytest.mark.unit
def test_conditions_of_the_default_axes() -> None:
    assert list(STUDIES["set-size"].values(TASK)) == [float(n) for n in range(10, 61, 5)]
    assert list(STUDIES["growing-set"].values(TASK)) == [5.0, 10.0, 25.0, 50.0]
    assert list(STUDIES["recordings"].values(TASK)) == [1024, 64, 16, 4, 1]


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
def test_a_set_grows_while_it_is_used() -> None:
    """Each rung can be climbed by one action only, the one of its number, which is there from step
    2 on if the set begins with one action and gains one at every step."""
    num_actions = 4
    seen = []

    class Recorder:
        """Acts with the last action that is there, and is asked for nothing else."""

        name = "last"

        def project(self, params: object, table: jax.Array) -> jax.Array:
            return table

        def distribution(
            self, params: object, obs: jax.Array, projected: jax.Array, mask: jax.Array
        ) -> object:
            from jaxnew.policy import Categorical

            seen.append(mask.shape)
            last = jnp.arange(mask.shape[-1]) * 100.0
            return Categorical.masked(jnp.broadcast_to(last, mask.shape), mask)

        def decode(self, sample: jax.Array, available: object, table: jax.Array) -> object:
            from jaxnew.environment import Action

            # The reward of "action" k is k: the episode's return adds up the places chosen.
            return Action.of(sample)

    world = probe.TableWorld(num_actions)
    reward = np.broadcast_to(np.arange(num_actions) * 1.0, (1, num_actions))
    params = probe.table_params(
        np.ones((1, 1)),
        np.zeros((1, num_actions), int),
        reward,
        np.zeros((1, num_actions), bool),
        time_limit=5,
    )

    def total(**options: int) -> float:
        evaluator = Evaluator(
            world,
            params,
            Recorder(),  # type: ignore[arg-type]
            num_actions,
            normalize_observations=False,
            width=4,
            **options,
        )
        pool = ActionPool.of(np.arange(num_actions, dtype=np.int32), capacity=num_actions)
        table = jnp.zeros((num_actions, 1))
        statistics = RunningStatistics.zeros((1,))
        found = evaluator.run({}, statistics, table, pool, jax.random.key(0), 4, True)
        return float(found["episode_return"].mean())

    assert total() == 5 * 3
    assert total(first_size=1) == 0 + 1 + 2 + 3 + 3
    assert total(first_size=1, growth=2) == 0 + 2 + 3 + 3 + 3
    assert total(first_size=2, growth=0) == 5 * 1
    with pytest.raises(ValueError, match=r"first_size=5 must be in 0\.\.4"):
        total(first_size=5)
