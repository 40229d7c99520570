"""The figures of the paper: what they lack, and what they show."""

from __future__ import annotations

import csv
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments import figures
from experiments.main import child
from experiments.reports import drawing, jobs, paper_figures
from experiments.reports.figure_list import FIGURES, PaperFigure
from experiments.reports.paper_figures import Options
from experiments.reports.production import Cell, find
from experiments.reports.results import result_rows
from experiments.reports.runs import Group, read_runs
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.task.places import UsageError
from tests.experiments.commands import ROOT, read_json
from tests.experiments.handwritten import (
    finished,
    source_of,
    write_anchors,
    write_evaluation,
    write_run,
)

OURS = Cell("ours", "hvae")
NO_SUBGOALS = Cell("ours", "hvae", variant="-no-subgoals")
NO_PLACE = Cell("ours", "hvae", variant="-no-place")
SQUARE = Cell("ours", "hvae", variant="-2d-place")
FULL = Cell("ours", "hvae", split="full")
TOY = Cell("ours", "gt4")
OWN = "examples.attention_policy:AttentionMethod"
PLACE = "tests.toy_task:TASK"
TASK = "shape_stacking"
HEIGHT = "final_height"


@pytest.mark.unit
def test_what_a_figure_lacks_is_counted(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path, seeds=(1,))
    settings = paper_figures.settings_of(FIGURES["20"], source)
    jobs = paper_figures.missing_jobs(FIGURES["20"], settings)
    assert [job.command[0] for job in jobs] == ["embed", "train", "train"]
    assert paper_figures.missing_episodes(FIGURES["20"], settings, 100) == 400
    write_evaluation(finished(source, NO_SUBGOALS), "test", 0.5, set_size=5)
    assert paper_figures.missing_episodes(FIGURES["20"], settings, 100) == 300
    settings = paper_figures.settings_of(FIGURES["9c"], source)
    assert paper_figures.missing_episodes(FIGURES["9c"], settings, 100) == 500
    path = finished(source, settings[0][1])
    write_evaluation(path, "mix-0.2", 0.5, set_size=5)
    write_evaluation(path, "mix-0.4", 0.5, set_size=50)
    assert paper_figures.missing_episodes(FIGURES["9c"], settings, 100) == 400
    (run,) = read_runs([path])
    group = Group("analysed", settings[0][0].domain.task, (run,))
    questions = paper_figures.questions_of(FIGURES["9c"], group)
    lacking = [question.actions for question in questions if run.answer(question, 100) is None]
    assert lacking == ["mix-0", "mix-0.4", "mix-0.6", "mix-0.8"]
    assert all(run.answer(question, 1001) is None for question in questions)
    films = paper_figures.settings_of(FIGURES["8"], source_of("create-push", seeds=(3, 4)))
    assert films[0][0].seeds == (3,)


@pytest.mark.unit
def test_the_variants_share_an_encoder_and_have_sweeps_of_their_own(tmp_path: Path) -> None:
    source = source_of(TASK, tmp_path)
    settings = paper_figures.settings_of(FIGURES["23"], source)
    jobs = paper_figures.missing_jobs(FIGURES["23"], settings)
    kinds = [job.command[0] for job in jobs]
    assert kinds == ["embed", "embed", *["sweep"] * 4]
    assert {job.command[1] for job in jobs[:2]} == {"--task=shape_stacking"}
    assert {job.command[2] for job in jobs[:2]} == {"--split=default", "--split=full"}
    tasks = [job.command[1].removeprefix("--task=") for job in jobs[2:]]
    assert tasks == [TASK, f"{TASK}-no-place", f"{TASK}-2d-place", TASK]
    # Those of one task tell their splits apart.
    folders = [next(word for word in job.command if "--workdir" in word) for job in jobs[2:]]
    assert folders[0].endswith("/shape_stacking/sweep-ours-hvae-smoke-2-1-2")
    assert folders[1].endswith("/shape_stacking-no-place/sweep-ours-hvae-smoke-2-1-2")
    assert folders[3].endswith("/shape_stacking/sweep-ours-hvae-full-smoke-2-1-2")
    assert paper_figures.missing_episodes(FIGURES["23"], settings, 100) == 4 * 2 * 2 * 100
    write_evaluation(finished(source, NO_PLACE), "test", 1.0, HEIGHT, set_size=5)
    assert paper_figures.missing_episodes(FIGURES["23"], settings, 100) == 1500
    found = {cell: find(source.of(cell), cell) for cell in (OURS, NO_PLACE, SQUARE, FULL)}
    assert [len(runs) for runs in found.values()] == [0, 1, 0, 0]


@pytest.mark.unit
@pytest.mark.parametrize(
    ("number", "labels", "papers"),
    [
        ("7a", ["ours, hvae, split full"], [0.968, 0.172]),
        ("20", ["ours, hvae", "ours, hvae, no subgoals"], [0.907, 0.797, 0.892, 0.698]),
        ("21", ["ours, hvae", "ours, hvae, conditioned position"], [0.907, 0.797, 0.962, 0.861]),
    ],
)
def test_bars_are_the_evaluations(
    tmp_path: Path, number: str, labels: list[str], papers: list[float]
) -> None:
    source = source_of("create-push", tmp_path)
    settings = paper_figures.settings_of(FIGURES[number], source)
    means = iter(np.arange(1, 17) / 32)
    expected = []
    for _, cell in settings:
        for split in ("train", "test"):
            both = [float(next(means)) for _ in source.seeds]
            expected.append(np.mean(both))
            for seed, mean in zip(source.seeds, both, strict=True):
                write_evaluation(finished(source, cell, seed), split, mean, set_size=5)
    drawn = paper_figures.draw(number, settings, tmp_path, Options(episodes=1000))
    picture, text, table = drawn
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert list(dict.fromkeys(row["setting"] for row in rows)) == labels
    assert [row["actions"] for row in rows] == ["train", "test"] * len(labels)
    assert [float(row["mean"]) for row in rows] == pytest.approx(expected)
    assert [float(row["paper_mean"]) for row in rows] == pytest.approx(papers, abs=1e-3)
    assert {row["num_seeds"] for row in rows} == {"2"}
    assert Image.open(picture).size[0] > 800
    assert (number == "7a") == ("the target is uncertain" in text.read_text())


@pytest.mark.unit
def test_bars_of_figure_23_with_anchors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = source_of(TASK, tmp_path)
    settings = paper_figures.settings_of(FIGURES["23"], source)
    means = iter(np.arange(1, 17) / 8)
    expected, groups = [], []
    for own, cell in settings:
        paths = [finished(source, cell, seed) for seed in source.seeds]
        for split in ("train", "test"):
            both = [float(next(means)) for _ in source.seeds]
            expected.append(np.mean(both))
            for path, mean in zip(paths, both, strict=True):
                write_evaluation(path, split, mean, HEIGHT, set_size=5)
        groups.append(paper_figures.group_of(own, cell))
    for number, task in enumerate((TASK, f"{TASK}-no-place")):
        write_anchors(tmp_path / task / "anchors", 0.25 * (1 + number), task=task, set_size=5)
    write_anchors(tmp_path / TASK / "anchors", 0.75, split="full", set_size=5)
    drawn = paper_figures.draw("23", settings, tmp_path, Options(episodes=1000))
    picture, text, table = drawn
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["mean"]) for row in rows] == pytest.approx(expected)
    papers = [2.354, 1.716, 2.612, 1.412, 1.618, 1.448, 2.407, 1.288]
    assert [float(row["paper_mean"]) for row in rows] == pytest.approx(papers, abs=1e-3)
    assert [row["paper_num_seeds"] for row in rows] == ["5", "5", "3", "3", "5", "3", "5", "5"]
    content = text.read_text()
    title = "# Figure 23, Shape Stacking: ways of placing, shapes of unseen classes: "
    assert content.startswith(f"{title}final height (m)\n")
    # Differences are in metres, not in points.
    assert "| 2.354 ± 0.146 | -2.166 | 2 / 5 |" in content
    assert content.count("Policies without training, shape_stacking") == 3
    assert "| stop at once | test | 0.500 [0.400, 0.600] |" in content
    assert "merge the results of several machines" in content
    assert Image.open(picture).size[0] > 1200
    of_groups = {group.label: result_rows(group) for group in groups}
    paths = [run.path for group in groups[:1] for run in group.runs]
    monkeypatch.setattr(figures, "tsne_figures", lambda runs: [])
    figures.make_figures(paths, tmp_path / "given")
    results = (tmp_path / "given" / "results.md").read_text()
    assert results.count("Policies without training, shape_stacking") == 1
    figure = drawing.bars_figure(groups, of_groups, "t")
    (axes,) = figure.axes
    lines = [
        (float(np.mean(line.get_xdata())), float(line.get_ydata()[0]))
        for line in axes.lines
        if line.get_linestyle() == ":"
    ]
    assert lines == [(0.0, 0.25), (1.0, 0.5), (3.0, 0.75)]  # None of 2-D placement.
    assert axes.get_ylabel() == "Final height (m)"
    assert axes.get_ylim()[1] == 2.75
    assert "policies without training" in figure.get_supxlabel()


@pytest.mark.unit
def test_bars_of_fixed_sets_leave_the_axis_as_it_is(tmp_path: Path) -> None:
    source = source_of(TASK, tmp_path, seeds=(1,))
    settings = paper_figures.settings_of(FIGURES["6"], source)
    for _, cell in settings:
        path = finished(source, cell)
        is_fixed = cell.method == "no-subsampling"
        size = {"set_size": 405, "num_actions": 405} if is_fixed else {"set_size": 5}
        write_evaluation(path, "train", 2.0, HEIGHT, **size)
        write_evaluation(path, "test", 1.0, HEIGHT, set_size=5)
    _, text, _ = paper_figures.draw("6", settings, tmp_path, Options(episodes=1000))
    assert "another simulator" in text.read_text()
    groups = [paper_figures.group_of(own, cell) for own, cell in settings]
    figure = drawing.bars_figure(groups, {g.label: result_rows(g) for g in groups})
    assert figure.axes[0].get_ylim()[1] == 2.75
    assert "7.239 ↑" in [text.get_text() for text in figure.axes[0].texts]


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as opened:
        return list(csv.DictReader(opened))


def two_settings(folder: Path) -> list[Path]:
    """Another method with two seeds, and the figure's own setting with another coefficient."""
    source = source_of("create-push", folder, assignments=("hyperparameters.clip=0.3",))
    own = [finished(source, Cell(OWN, "gt32"), seed) for seed in (1, 2)]
    return [*own, finished(source, OURS)]


@pytest.mark.unit
def test_one_s_own_runs_are_added_to_the_bars_and_the_curves(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path, seeds=(1,))
    settings = paper_figures.settings_of(FIGURES["20"], source)
    added = two_settings(tmp_path / "mine")
    for _, cell in settings:
        for split in ("train", "test"):
            write_evaluation(finished(source, cell), split, 0.25, set_size=5)
    options = Options(episodes=100, added=tuple(added))
    runs = paper_figures.added_to(FIGURES["20"], settings, options.added)
    assert paper_figures.missing_episodes(FIGURES["20"], settings, 100, runs) == 600
    for mean, path in zip((0.5, 0.75, 1.0), added, strict=True):
        for split in ("train", "test"):
            write_evaluation(path, split, mean, set_size=5)
    runs = paper_figures.added_to(FIGURES["20"], settings, options.added)
    assert paper_figures.missing_episodes(FIGURES["20"], settings, 100, runs) == 0
    picture, _, table = paper_figures.draw("20", settings, tmp_path / "out", options)
    rows = [row for row in rows_of(table) if row["actions"] == "test"]
    labels = ["ours, hvae, clip 0.1", "ours, hvae, no subgoals", f"{OWN}, gt32"]
    assert [row["setting"] for row in rows] == [*labels, "ours, hvae, clip 0.3"]
    found = [tuple(float(row[name]) for name in ("mean", "low", "high")) for row in rows]
    assert found[2] == pytest.approx((0.625, 0.5, 0.75))  # Two seeds.
    assert found[3] == pytest.approx((1.0, 0.98, 1.01))
    alone, *_ = paper_figures.draw("20", settings, tmp_path / "alone", Options(episodes=100))
    assert Image.open(picture).size[0] > 1.5 * Image.open(alone).size[0]
    _, _, table = paper_figures.draw("24", settings, tmp_path / "out", options)
    points = {row["setting"]: float(row["mean"]) for row in rows_of(table)}
    assert points[f"{OWN}, gt32"] == pytest.approx(0.05)  # Validation stands last.


@pytest.mark.unit
def test_what_cannot_be_added_is_named(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path, seeds=(1,))
    other = finished(source_of("create-seesaw", tmp_path), OURS)
    half = finished(source, Cell("continuous", "hvae"), updates=1)
    embedded = {"task": "create", "representation": "vae", "seed": 1, "split": "default"}
    encoder = write_run(tmp_path / "embed", {**embedded, "split_seed": 0, "model": {}})
    for number, path, says in (
        (
            "20",
            other,
            "is a run of create-seesaw; the figure shows create-push, create-push-no-sub",
        ),
        ("20", half, "is not finished"),
        ("20", encoder, "is a run of embed; train a policy on it"),
        ("5", finished(source_of("grid_world", tmp_path), OURS), "of grid_world; .* shows create"),
    ):
        settings = paper_figures.settings_of(FIGURES[number], source)
        with pytest.raises(UsageError, match=says):
            paper_figures.added_to(FIGURES[number], settings, [path])
    settings = paper_figures.settings_of(FIGURES["5"], source)
    found = paper_figures.added_to(FIGURES["5"], settings, [encoder, other])
    assert [run.path for run in found] == [encoder.resolve(), other.resolve()]
    # Of several figures that are asked for, those of other kinds stay as they are.
    assert paper_figures.added_to(FIGURES["8"], settings, [other]) == []


def run_and_kill(job: jobs.Job, folder: Path) -> None:
    """Starts a command, and ends it at its first checkpoint as a power cut would."""
    line, environment = child(*job.command)
    process = subprocess.Popen(line, env=environment, cwd=ROOT)
    while process.poll() is None and not Checkpointer(folder / "checkpoints").steps("latest"):
        time.sleep(0.005)
    assert process.poll() is None
    process.kill()
    process.wait()
    raise UsageError("Stopped.")


@pytest.mark.integration
def test_bars_and_a_study_of_runs_that_are_made_on_the_host(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    cells = {"toy": (TOY,)}
    monkeypatch.setitem(FIGURES, "4", PaperFigure("bars", "toys", cells))
    monkeypatch.setitem(FIGURES, "9c", PaperFigure("study", "good", cells, study="goodness"))
    source = source_of(PLACE, tmp_path, seeds=(1,), workers=1)
    options = Options(episodes=6)

    def make(is_dry: bool = False) -> list[Path]:
        return paper_figures.make(["4", "9c"], source, options, is_dry=is_dry)

    assert make(is_dry=True) == []
    planned = capfd.readouterr().out
    assert planned.count("python -m experiments.train") == 1  # Both figures need it.
    assert "30 episodes of evaluation" in planned  # 2 bars and 3 points.
    assert not any(tmp_path.iterdir())
    run = tmp_path / "toy" / "ours-gt4-default-smoke-4-1"
    with monkeypatch.context() as killed:
        killed.setattr(jobs.Job, "run", lambda job: run_and_kill(job, run))
        with pytest.raises(UsageError, match="Stopped"):
            make()
    assert Checkpointer(run / "checkpoints").steps("latest")[-1] < 4
    assert not find(source, TOY)
    files = make()
    assert "resuming" in capfd.readouterr().out
    before = {file: file.stat().st_mtime_ns for file in run.rglob("*.json*")}
    monkeypatch.setattr(jobs.Job, "run", lambda job: pytest.fail(job.text))
    assert make() == files
    assert before == {file: file.stat().st_mtime_ns for file in run.rglob("*.json*")}
    assert "All runs and evaluations are there" in capfd.readouterr().out
    assert [file.name for file in files] == [
        *("figure_4.png", "figure_4.md", "figure_4.csv"),
        *("figure_9c.png", "figure_9c.md", "figure_9c.csv"),
    ]
    found = {
        file.name.partition("-best-sampled-m4-")[0]: read_json(file)["metrics"]["is_success"]
        for file in (run / "evaluation").iterdir()
    }
    assert set(found) == {"train", "test", "goodness-0", "goodness-0.5", "goodness-1"}
    with files[2].open() as file:
        bars = {row["actions"]: row for row in csv.DictReader(file)}
    for split in ("train", "test"):
        numbers = [float(bars[split][name]) for name in ("mean", "low", "high")]
        assert numbers == [found[split][name] for name in ("mean", "low", "high")]
    with files[5].open() as file:
        points = list(csv.DictReader(file))
    means = {float(p["share of good actions"]): float(p["mean"]) for p in points}
    assert means == {x: found[f"goodness-{x:g}"]["mean"] for x in (0.0, 0.5, 1.0)}
    assert found["goodness-0"]["mean"] == 0.0  # Bad actions are worth nothing.
    assert found["goodness-1"]["mean"] > 0.0
    assert "| 0 | 0.0 |" in files[4].read_text()
