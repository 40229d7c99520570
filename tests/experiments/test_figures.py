"""The command that draws runs, and finds and makes those of the paper's figures."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from experiments import figures
from experiments.reports import drawing
from experiments.reports.films import FilmOptions
from jaxnew.storage import config as config_lib
from jaxnew.task.domain import load_task
from jaxnew.task.places import UsageError
from tests.experiments import commands
from tests.experiments.handwritten import plain_config, write_evaluation, write_run


def call(*flags: str) -> None:
    """The command in this process."""
    figures.ARGUMENTS.parse(list(flags))
    figures.main()


@pytest.mark.integration
def test_figures_of_run_directories(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(drawing.report, "tsne", lambda vectors, seed: vectors[:, :2])
    paths = [write_run(tmp_path / f"run {seed}", plain_config(seed=seed)) for seed in (1, 2)]
    write_evaluation(paths[0], "train", 0.9)
    write_evaluation(paths[1], "train", 0.8)
    write_evaluation(paths[0], "test", 0.7)
    files = figures.make_figures(paths, tmp_path / "out")
    names = ["learning_curves.png", "bars.png", "results.md", "results.csv"]
    names += ["tsne_heldout.png", "tsne_train.png", "tsne_all.png"]
    assert [file.name for file in files] == names
    assert all(file.stat().st_size > 100 for file in files)
    with (tmp_path / "out" / "results.csv").open() as file:
        train, test = csv.DictReader(file)
    assert float(train["mean"]) == pytest.approx(0.85)
    assert float(train["difference"]) == pytest.approx(85.0 - 95.47)
    assert train["runs"] == f"{paths[0]};{paths[1]}"
    assert (test["num_seeds"], test["paper_method"]) == ("1", "ours_engineered")
    # What is missing is said with the command that makes it, here and in the table.
    message = f"evaluate --run='{paths[1]}' --sets=test --episodes=5000"
    assert message in capsys.readouterr().out
    assert message in (tmp_path / "out" / "results.md").read_text()


@pytest.mark.integration
def test_nothing_evaluated_leaves_out_the_bars_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(drawing.report, "tsne", lambda vectors, seed: vectors[:, :2])
    run = write_run(tmp_path / "run", plain_config(), curve=())
    files = figures.make_figures([run], run / "figures")
    assert [file.name for file in files][:2] == ["results.md", "results.csv"]
    output = capsys.readouterr().out
    assert "no evaluations in its metrics.jsonl yet" in output
    assert f"--run={run} --sets=train,test" in output


@pytest.mark.integration
def test_command_draws_a_run_of_embed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = {
        "task": "grid_world",
        "representation": "gt12",
        "split": "default",
        "seed": 3,
        "model": {},
    }
    run = write_run(tmp_path / "embed", config)
    call(f"--run={run}")
    files = capsys.readouterr().out.split()
    assert files == [str(run / "figures" / f"tsne_{part}.png") for part in drawing.TSNE_PARTS]
    assert all(Image.open(file).size == (920, 960) for file in files)


@pytest.mark.unit
def test_command_asks_for_what_it_needs(tmp_path: Path) -> None:
    one, other = (write_run(tmp_path / f"{i}", plain_config(seed=i)) for i in range(2))
    with pytest.raises(UsageError, match="--out=DIRECTORY"):
        call(f"--run={one},{other}")
    with pytest.raises(UsageError, match="Say which runs"):
        call()
    with pytest.raises(UsageError, match="Give --run, to draw these runs, or --figure"):
        call(f"--run={one}", "--figure=4")
    shop = write_run(tmp_path / "2", {**plain_config(), "task": "recommender"})
    with pytest.raises(UsageError, match=r"several tasks, \['grid_world', 'recommender'\]"):
        call(f"--run={one},{shop}", f"--out={tmp_path}")
    embedded = {"task": "grid_world", "representation": "hvae", "seed": 1, "split": "default"}
    path = write_run(tmp_path / "embed", {**embedded, "model": {}})
    with pytest.raises(UsageError, match="This needs a run of train"):
        call(f"--run={path}", "--episode")
    with pytest.raises(UsageError, match="--task, --seeds: of no meaning without --figure"):
        call(f"--run={one}", "--seeds=1", "--task=grid_world")
    with pytest.raises(UsageError, match="--episodes: of no meaning with --figure=8 --run"):
        call(f"--run={one}", "--figure=8", "--episodes=3")
    with pytest.raises(UsageError, match="--episode: of no meaning with --figure"):
        call("--figure=4", "--episode")
    with pytest.raises(UsageError, match="Unknown command line flag 'seed'"):
        call("--seed=1")
    with pytest.raises(UsageError, match="--add: of no meaning without --figure"):
        call(f"--run={one}", f"--add={other}")
    task = "--task=create-push"
    for flags, says in (
        (("--figure=4", "--films=2"), "--films: of no meaning for figures of bars"),
        (("--figure=4", "--finetune_steps=9"), "--finetune_steps: of no meaning for figures of b"),
        (
            ("--figure=5,8", task, "--episodes=9"),
            "--episodes: .* figures of films, representations",
        ),
        (("--figure=8", task, "--pdf"), "--pdf: of no meaning for figures of films"),
        (("--figure=8", task, f"--add={one}"), "--add: of no meaning for figures of films"),
        (("--figure=5", task, "--seeds=1"), "--seeds: of no meaning for figures of represent"),
        (("--figure=4", "--workers=2"), "environments of grid_world run inside jit"),
        (("--figure=3",), "No figure '3'"),
    ):
        with pytest.raises(UsageError, match=says):
            call(*flags, "--dry_run", f"--runs={tmp_path}")


@pytest.mark.unit
def test_which_run_is_filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(figures, "film_run", lambda *given: made.append(given) or [])
    config = {**plain_config(), "task": "create-push", "representation": "hvae"}
    config["environment"] = config_lib.plain(load_task("create-push").environment)
    path = write_run(tmp_path / "run", config)
    how = ("--figure=8", "--films=3", "--film_size=64", "--film_format=mp4", "--film_pages")
    call(f"--run={path}", *how)
    title = "Figure 8, CREATE Push: ours, hvae"
    options = FilmOptions(3, 64, ".mp4", with_pages=True)
    assert made == [(path, path / "figures" / "figure_8", title, options, 0)]
    other = write_run(tmp_path / "other", {**config, "seed": 2})
    with pytest.raises(UsageError, match="Figure 8 shows one run; 2 were given"):
        call(f"--run={path},{other}", *how)
    with pytest.raises(UsageError, match="is a run of create-push, not of create-seesaw"):
        call(f"--run={path}", "--task=create-seesaw", *how)


@pytest.mark.integration
def test_a_figure_is_made_stopped_and_finished(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [
        "figures",
        "--figure=6",
        f"--given=hvae={commands.ROOT}/results/grid_world/hvae_fast_seed31.npz",
        "--budget=smoke",
        "--seeds=1",
        "--episodes=16",
        "--set=sets.size=20",
        f"--runs={tmp_path}",
    ]
    call(*flags[1:], "--dry_run")
    planned = capsys.readouterr().out
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
    evaluations = list(folder.rglob("evaluation/test-best-sampled-m20-*.json"))
    assert len(evaluations) == 3
    mean = json.loads(evaluations[0].read_text())["metrics"]["is_success"]["mean"]
    assert mean in [float(row["mean"]) for row in rows]
    call(*flags[1:], "--dry_run")
    assert "All runs and evaluations are there" in capsys.readouterr().out
