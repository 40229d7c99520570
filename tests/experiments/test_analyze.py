"""Studies and the search grids, through the command."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import analyze
from experiments.reports.studies import encoded_test_actions, kind_of
from experiments.tasks.grid_world import TASK
from jaxnew import collection
from jaxnew.actions import ActionSplit
from jaxnew.embedding import Encoder
from jaxnew.representation.table import RepresentationTable
from jaxnew.task.places import UsageError
from tests.experiments.commands import evaluation, run, run_alone
from tests.experiments.several import run_several

POLICY = "ours-hvae-default-smoke-31"
ENCODER = "embed-hvae-default-smoke-31"
STUDIED = {
    "set-size": "10,50",
    "unseen-ratio": "0,1",
    "growing-set": "5,50",
    "recordings": "16,1",
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An encoder and a policy on its table, at smoke budget."""
    folder = tmp_path_factory.mktemp("runs")
    run("train", "--representation=hvae", "--budget=smoke", f"--runs={folder}")
    return folder / "grid_world"


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as opened:
        return list(csv.DictReader(opened))


@pytest.mark.integration
def test_sizes_ratios_growth_and_recordings(runs: Path) -> None:
    common = (f"--run={runs / POLICY}", "--episodes=128", f"--out={runs / 'analysis'}")
    jobs = [(f"--study={study}", f"--values={STUDIED[study]}", *common) for study in STUDIED]
    assert jobs[-1][0] == "--study=recordings"
    jobs[-1] = (*jobs[-1], f"--encoder={runs / ENCODER}")
    *first, again = run_several("analyze", [*jobs, jobs[-1]])
    assert " done in " not in again
    found = {}
    for study, output in zip(STUDIED, first, strict=True):
        assert output.count(" done in ") == {"growing-set": 1}.get(study, 2)  # 50 is there already.
        name = study.replace("-", "_")
        assert (runs / "analysis" / f"{name}.png").stat().st_size > 5000
        found[study] = [float(row["mean"]) for row in rows_of(runs / "analysis" / f"{name}.csv")]
    encoder = Encoder.load(runs / ENCODER).table.hash[:8]
    for words in (
        "test-best-sampled-m10",
        "test-best-sampled-m50",
        "unseen-0-best-sampled-m50",
        "test-best-sampled-m50-from5-by5",
        f"recordings-1-{encoder}-best-sampled-m50",  # Another encoder is another question.
    ):
        assert evaluation(runs / POLICY, words)["num_episodes"] == 128
    # The whole set from the start, all recordings, or only unseen actions: the same evaluation.
    whole = found["set-size"][1]
    assert (found["growing-set"][1], found["recordings"][0]) == (whole, whole)
    stored = evaluation(runs / POLICY, "unseen-1-best-sampled-m50")
    assert stored["num_actions"] == 256
    assert found["unseen-ratio"][1] == whole


@pytest.mark.unit
def test_flags_of_the_other_kind_are_refused() -> None:
    for flags, message in (
        (["--study=entropy", "--run=a"], "--run: of no meaning for a search"),
        (["--study=set-size", "--steps=1"], "--steps: of no meaning for a study of runs"),
        (["--study=set-size", "--run=a", "--encoder=b"], "--encoder: of no meaning for --study=se"),
        ([], "Say which: --study=set-size|unseen-ratio|"),
    ):
        analyze.ARGUMENTS.parse(flags)
        with pytest.raises(UsageError, match=re.escape(message)):
            analyze.main()


@pytest.mark.integration
def test_an_encoder_sees_the_first_recordings_of_test_actions(runs: Path) -> None:
    split = ActionSplit.load(runs / POLICY / "split.json")
    learner, weights, _ = Encoder.load(runs / ENCODER).frozen()
    recordings = collection.load(runs / "recordings-16", universe=TASK.make_universe())
    rows = recordings.rows(split.test)
    expected = learner.encode(weights, recordings.data[rows][:, :4])
    found = encoded_test_actions(runs / ENCODER, split, 4)
    np.testing.assert_array_equal(found.vectors, expected)
    table = RepresentationTable.load(runs / POLICY / "table.npz")
    everything = encoded_test_actions(runs / ENCODER, split, 16)
    assert everything.made_by == table.hash
    np.testing.assert_allclose(everything.vectors, table.rows(split.test), atol=1e-5)
    assert kind_of("recordings", TASK, runs / ENCODER).values == [16.0, 4.0, 1.0]
    with pytest.raises(UsageError, match=r"17 recordings per action were asked for.*has 16"):
        encoded_test_actions(runs / ENCODER, split, 17)
    other = replace(split, seed=1)
    if other.hash != split.hash:
        with pytest.raises(UsageError, match="another split"):
            encoded_test_actions(runs / ENCODER, other, 4)


@pytest.mark.slow
@pytest.mark.integration
def test_a_grid_is_searched_by_validation(tmp_path: Path) -> None:
    common = ("--representation=gt12", "--budget=smoke", "--seeds=1,2", f"--runs={tmp_path}")
    output = run_alone("analyze", "--study=entropy", "--values=0.01,0.1", *common)
    assert "4 runs of 1.02 k steps in one program" in output
    rows = rows_of(tmp_path / "grid_world" / "analysis" / "entropy.csv")
    assert [row["entropy coefficient"] for row in rows] == ["0.01", "0.1"]
    assert [row["num_seeds"] for row in rows] == ["2", "2"]
    summary = next(tmp_path.rglob("evaluation/members.json"))
    members = json.loads(summary.read_text())["members"]
    of_first = [m for m in members if m["entropy_coefficient"] == 0.01]
    assert float(rows[0]["mean"]) == pytest.approx(np.mean([m["best_metric"] for m in of_first]))
    # One size is one program: 4 minibatches of 64 transitions are 32 steps of 8 environments.
    output = run_alone("analyze", "--study=batch-size", "--values=128", *common)
    assert "--set=ppo.rollout.num_steps=64 --set=num_updates=2" in output
    assert "Chosen by it: transitions per minibatch 128" in output
