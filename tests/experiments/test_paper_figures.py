"""Figures of the paper by number: their runs are found, made where missing, and compared."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs_mjx.grid_world import skill_universe
from experiments.pipeline.artifacts import Domain
from experiments.pipeline.flags import UsageError
from experiments.reports import finetuning, jobs
from experiments.reports.comparison import compare_curves, comparison_markdown, verdict_of
from experiments.reports.figure_list import number_of
from experiments.reports.finetuning import finetune_budget, finetune_folder, make_finetuned
from experiments.reports.jobs import Job, duration, sweep_job
from experiments.reports.paper import paper_curve, paper_set_size, paper_value
from experiments.reports.paper_figures import lacking_splits, parse_given
from experiments.reports.production import Cell, Source, find
from experiments.reports.results import result_rows
from experiments.reports.runs import read_runs
from experiments.tasks.grid_world import TASK
from jaxnew.representation.table import RepresentationTable, engineered_table
from jaxnew.storage import config as config_lib
from jaxnew.storage.metrics import MetricsLog
from tests.experiments import commands
from tests.experiments.handwritten import groups_at, plain_config, write_evaluation, write_run

DOMAIN = Domain.of(TASK, None)
OURS = Cell("ours", "gt12")


def source_at(folder: Path, **changes: Any) -> Source:
    plain = Source(DOMAIN, folder, "smoke", "smoke", 0.0, (1, 2), (), {})
    return replace(plain, **changes)


def run_config(method: str = "ours", seed: int = 1, **changes: Any) -> dict[str, Any]:
    """The config of a run that `figures --budget=smoke` would have made."""
    budget = source_at(Path()).budget_of(method)
    plain = config_lib.to_dict(budget)
    config = {name: plain[name] for name in ("num_updates", "ppo", "hyperparameters")}
    config = {**plain_config(seed=seed), **config, "method": method}
    return {**config, "split_hash": DOMAIN.split.hash, **changes}


def finished(path: Path, config: dict[str, Any], **options: Any) -> Path:
    """A run whose last report is that of its last update."""
    return write_run(path, config, curve=(0.1, 0.3), **options)


@pytest.mark.unit
def test_runs_of_a_cell_are_found_wherever_they_lie(tmp_path: Path) -> None:
    folder = tmp_path / "grid_world"
    one = finished(folder / "deep" / "down", run_config(seed=1))
    other_microbatch = run_config(seed=2)
    other_microbatch["ppo"] = {**other_microbatch["ppo"], "microbatch_size": 32}
    two = finished(folder / "two", other_microbatch)
    finished(folder / "other-seed", run_config(seed=3))
    finished(folder / "other-method", run_config("continuous", seed=1))
    finished(folder / "longer", run_config(seed=1, num_updates=8))
    write_run(folder / "unfinished", run_config(seed=1, num_updates=4), curve=(0.1,))
    finished(folder / "finetuned", run_config(seed=1, trained_on="test"))
    finished(folder / "other-split", run_config(seed=1, split_hash="s"))
    entropy = run_config(seed=1)
    entropy["hyperparameters"] = {**entropy["hyperparameters"], "entropy_coefficient": 0.0}
    finished(folder / "other-numbers", entropy)
    found = find(source_at(tmp_path), OURS)
    assert {seed: run.path for seed, run in found.items()} == {1: one, 2: two}
    assert find(source_at(tmp_path), Cell("ours", "hvae")) == {}


@pytest.mark.unit
def test_two_runs_that_fit_are_not_guessed_between(tmp_path: Path) -> None:
    vectors = skill_universe().engineered["gt12"]
    ids = np.arange(1024, dtype=np.int32)
    tables = [RepresentationTable(k * vectors, ids, source=f"hvae, {k}") for k in (1, 2)]
    paths = [
        finished(
            tmp_path / "grid_world" / f"{k}",
            run_config(representation="hvae", table_hash=table.hash),
            table=table,
        )
        for k, table in enumerate(tables)
    ]
    with pytest.raises(UsageError, match=r"are both ours on hvae with seed 1.*--given=hvae=TABLE"):
        find(source_at(tmp_path), Cell("ours", "hvae"))
    tables[1].save(tmp_path / "given.npz")
    source = source_at(tmp_path, given={"hvae": tmp_path / "given.npz"})
    assert find(source, Cell("ours", "hvae"))[1].path == paths[1]


@pytest.mark.unit
def test_what_is_missing_becomes_a_command_with_its_duration(tmp_path: Path) -> None:
    source = source_at(tmp_path, budget="paper", steps=4e6, assignments=("loop.chunk_updates=7",))
    assert source.budget_of("ours").num_updates == 245  # 4e6 / 16,384, rounded up.
    assert source.budget_of("continuous").num_updates == 489  # Half as many steps each.
    job = sweep_job(source, OURS, [1, 2, 3])
    assert "--seeds=1,2,3" in job.command
    assert job.command[-2:] == ("--set=loop.chunk_updates=7", "--set=num_updates=245")
    # 3 runs cannot be shared out evenly to 2 cores, so that one takes all; on 3 each has one.
    rate = TASK.measured.training["ours"]
    seconds = {1: 3, 2: 3, 3: 1}.get(len(os.sched_getaffinity(0)))
    if seconds is not None:
        assert job.seconds == pytest.approx(seconds * 245 * 16_384 / rate)
    assert duration(50.0) == "about 50 s"
    assert duration(600.0) == "about 10 minutes"
    assert duration(7200.0) == "about 2.0 hours"
    unmeasured = replace(DOMAIN, task=replace(TASK, measured=None))
    assert "nobody measured" in sweep_job(replace(source, domain=unmeasured), OURS, [1]).cost


@pytest.mark.unit
def test_a_command_that_fails_ends_the_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs.sys, "executable", "/bin/false")
    with pytest.raises(UsageError, match="ended with status 1: python -m"):
        Job("it", ("sweep", "--x"), "seconds", None).run()


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
def test_the_train_bar_of_a_fixed_set_is_all_of_it(tmp_path: Path) -> None:
    config = run_config("no-subsampling", representation="hvae")
    vectors = skill_universe().engineered["gt12"]
    ids = np.arange(1024, dtype=np.int32)
    path = finished(
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
    assert lacking_splits(read_runs([path])[0], 1000) == []
    assert lacking_splits(read_runs([path])[0], 1001) == ["train", "test"]


@pytest.mark.unit
def test_the_recommender_that_shows_its_constants_is_another_environment(tmp_path: Path) -> None:
    from envs_mjx.recommender import product_universe

    table = engineered_table(product_universe(), "product-mu")
    config = run_config("no-entropy", task="recommender", representation="product-mu")
    config["ppo"]["rollout"]["set_size"] = 500
    (group,) = groups_at(finished(tmp_path / "run", config, table=table))
    assert group.paper_environment == "Recommender (fully observable)"
    assert group.paper_method == "ours_no_entropy"
    assert (group.set_size("train"), group.set_size("test")) == (500, 25)
    assert paper_set_size("Recommender", "test", 500) == 500


@pytest.mark.unit
def test_curves_are_compared_at_equal_steps(tmp_path: Path) -> None:
    vectors = skill_universe().engineered["gt12"]
    ids = np.arange(1024, dtype=np.int32)
    table = RepresentationTable(vectors, ids, source="hvae")
    for seed, values in ((1, (0.0, 0.4, 0.2, 0.1)), (2, (0.2, 0.2, 0.2, 0.6))):
        config = run_config(seed=seed, representation="hvae", num_updates=8)
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


@pytest.mark.unit
def test_fine_tuning_is_drawn_from_its_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = source_at(tmp_path, seeds=(1,))
    made = []
    monkeypatch.setattr(finetuning.Job, "run", lambda job: made.append(job.command))
    paths = []
    for method in ("ours", "nearest-neighbour"):
        paths.append(finished(tmp_path / method, run_config(method)))
        budget = finetune_budget(source, method, 512.0)
        assert budget.num_updates == 2  # 512 steps of 256 an update.
        for kind, success in (("warm", 0.5), ("scratch", 0.25)):
            folder = finetune_folder(paths[-1], budget, kind)
            config = run_config(method, trained_on="test", num_updates=2)
            write_run(folder, config, curve=(0.1,))
            with MetricsLog(folder) as log:
                log.write(2, {"episode/is_success": success})
    write_evaluation(paths[0], "test", 0.7, set_size=50, num_actions=256)
    write_evaluation(paths[0], "test", 0.8, set_size=256, num_actions=256)
    groups = [groups_at(path)[0] for path in paths]
    content = make_finetuned(source, groups, 512.0, 1000)
    assert made == []
    assert [(c.label, c.runs[0].values.tolist()) for c in content.curves] == [
        ("ours, fine-tuned", [0.5]),
        ("ours, from scratch", [0.25]),
        ("discrete, fine-tuned", [0.5]),
        ("discrete, from scratch", [0.25]),
    ]
    whole = paper_value("Grid World", "ours_zero_shot_whole_test_set", "test")
    assert [(r.label, r.mean) for r in content.references] == [
        ("ours, zero-shot, sets as in training (50)", 0.7),
        ("paper, zero-shot, sets as in training", paper_value("Grid World", "ours", "test").mean),
        ("ours, zero-shot, all at once (256)", 0.8),
        ("paper, zero-shot, all at once", whole.mean),
    ]
    figure = finetuning.finetune_figure(content, "title")
    heights = [float(line.get_ydata()[0]) for line in figure.axes[0].lines]
    assert heights[:4] == [50.0, 25.0, 50.0, 25.0]
    assert heights[4] == 70.0
    # What is not there is made: from the run it goes on with, and beside it from scratch.
    with pytest.raises(Exception, match="finetune-warm-3"):
        make_finetuned(source, groups, 768.0, 1000)
    assert made[0][:2] == ("finetune", f"--run={paths[0]}")


@pytest.mark.integration
def test_a_figure_is_made_stopped_and_finished(tmp_path: Path) -> None:
    flags = [
        "figures",
        "--figure=6",
        f"--given=hvae={commands.ROOT}/results/grid_world/hvae_fast_seed31.npz",
        "--budget=smoke",
        "--seeds=1",
        "--episodes=16",
        "--set=ppo.rollout.set_size=20",
        f"--runs={tmp_path}",
    ]
    planned = commands.run(*flags, "--dry_run")
    assert planned.count("python -m experiments.sweep") == 3
    assert "96 episodes of evaluation" in planned  # 3 methods on train and test sets.
    assert not any(tmp_path.iterdir())

    folder = tmp_path / "grid_world"
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.figures", *flags[1:]],
        cwd=commands.ROOT,
        env={**os.environ, **commands.ENVIRONMENT},
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    first = folder / "sweep-ours-hvae-smoke-4-1"
    deadline = time.monotonic() + 200
    while not list(first.glob("members/*/checkpoints")) and time.monotonic() < deadline:
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=200)
    assert process.returncode != 0, output
    stamp = (first / "metrics.jsonl").stat().st_mtime_ns

    place = str(folder / "figures")
    files = [Path(line) for line in commands.run(*flags).splitlines() if line.startswith(place)]
    assert [file.name for file in files] == ["figure_6.png", "figure_6.md", "figure_6.csv"]
    assert (first / "metrics.jsonl").stat().st_mtime_ns == stamp
    with (folder / "figures" / "figure_6.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["method"], row["actions"], row["set_size"]) for row in rows] == [
        ("ours", "train", "20"),
        ("ours", "test", "20"),
        ("no-entropy", "train", "20"),
        ("no-entropy", "test", "20"),
        ("no-subsampling", "train", "512"),
        ("no-subsampling", "test", "20"),
    ]
    assert rows[0]["paper_method"] == "ours"
    evaluations = list(folder.rglob("evaluation/test-best-sampled-m20.json"))
    assert len(evaluations) == 3
    mean = json.loads(evaluations[0].read_text())["metrics"]["is_success"]["mean"]
    assert mean in [float(row["mean"]) for row in rows]
    assert "All runs and evaluations are there" in commands.run(*flags, "--dry_run")
