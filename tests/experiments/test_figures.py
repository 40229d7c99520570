"""Figures show the numbers of the run directories, and the table sets them beside the paper's."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from PIL import Image

from envs_mjx.grid_world import skill_universe
from experiments import figures
from experiments.pipeline.flags import UsageError
from experiments.pipeline.training import TrainConfig, Trainer
from experiments.reports import drawing
from experiments.reports import episode as episodes
from experiments.reports.curves import CurveSetting, RunCurve, learning_curves, mean_curve
from experiments.reports.episode import Episode, choose, episode_animation, play_episodes
from experiments.reports.paper import PaperCurve, paper_value
from experiments.reports.plots import (
    Bar,
    BarSetting,
    Metric,
    Scatter,
    bars,
    hls_palette,
    save,
    tsne_scatter,
)
from experiments.reports.results import as_markdown, result_rows
from experiments.reports.runs import read_runs
from experiments.tasks.grid_world import TASK
from jaxnew.ppo import TrainState
from jaxnew.representation.table import RepresentationTable, engineered_table
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.run_directory import RunDirectory
from tests.experiments import commands
from tests.experiments.handwritten import (
    a_split,
    groups_at,
    plain_config,
    write_evaluation,
    write_run,
)

RED = (1.0, 0.0, 0.0)
SUCCESS = Metric.of("is_success")


def texts(figure: Any) -> str:
    return " | ".join(t.get_text() for axes in figure.axes for t in axes.texts)


def legend_texts(figure: Any) -> list[str]:
    legends = [*figure.legends, *(a.get_legend() for a in figure.axes if a.get_legend())]
    return [text.get_text() for legend in legends for text in legend.get_texts()]


# ---- Plots ----


@pytest.mark.unit
def test_palette_is_evenly_spaced_in_hue_from_h() -> None:
    # Hue 0.7 + 3/10 = 0 (red): with l = 0.6, s = 0.9 the parts are l + s - l s = 0.96 and 0.24.
    assert hls_palette(10)[3] == pytest.approx((0.96, 0.24, 0.24))
    # Hue 0.7 + 2/4 = 0.2: yellow-green, red falls to 0.96 - 0.72 * 0.2.
    assert hls_palette(4)[2] == pytest.approx((0.816, 0.96, 0.24))
    assert len(set(hls_palette(7))) == 7


@pytest.mark.unit
def test_a_curve_is_held_at_its_first_maximum() -> None:
    held = RunCurve(np.arange(6.0), np.array([2.0, 1.0, 3.0, 2.0, 3.0, 0.0])).held_at_best()
    assert held.values.tolist() == [2.0, 1.0, 3.0, 3.0, 3.0, 3.0]
    assert held.steps.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.unit
def test_mean_over_seeds_where_all_of_them_are() -> None:
    runs = [
        RunCurve(np.array([1.0, 2.0, 3.0]), np.array([0.0, 2.0, 9.0])),
        RunCurve(np.array([1.0, 2.0]), np.array([2.0, 6.0])),
    ]
    steps, mean, std = mean_curve(runs)
    assert steps.tolist() == [1.0, 2.0]
    assert mean.tolist() == [1.0, 4.0]
    assert std.tolist() == [1.0, 2.0]  # Population deviation of (0, 2) and (2, 6).


@pytest.mark.unit
def test_learning_curves_draw_the_numbers() -> None:
    runs = [
        RunCurve(np.array([1e6, 2e6, 3e6]), np.array([0.1, 0.5, 0.2])),
        RunCurve(np.array([1e6, 2e6, 3e6]), np.array([0.3, 0.3, 0.7])),
    ]
    paper = PaperCurve(np.array([2e6, 8e6]), np.array([0.4, 0.9]), np.array([0.1, 0.05]))
    setting = CurveSetting("mine", RED, {"train": runs}, {"train": paper}, "the paper")
    figure = learning_curves([setting], SUCCESS)
    train, validation = figure.axes
    lines = {line.get_label(): [] for line in train.lines}
    for line in train.lines:
        lines[line.get_label()].append(np.array(line.get_data()))
    x, y = lines["mine: run"][0]
    assert x.tolist() == [1.0, 2.0, 3.0]
    assert y == pytest.approx([10.0, 50.0, 20.0])
    # Held at best: (10, 50, 50) and (30, 30, 70); mean and, as half a band, deviation.
    x, y = lines["mine"][0]
    assert y == pytest.approx([20.0, 40.0, 60.0])
    band = train.collections[-1].get_paths()[0].vertices
    assert band[band[:, 0] == 1.0][:, 1].min() == pytest.approx(10.0)
    assert band[band[:, 0] == 3.0][:, 1].max() == pytest.approx(70.0)
    x, y = lines["the paper"][0]
    assert x.tolist() == [2.0, 8.0]
    assert y == pytest.approx([40.0, 90.0])
    # Ours ends at 3 million: a line tells where the paper's curve goes to.
    assert train.get_xlim()[1] == pytest.approx(3.03)
    assert texts(figure) == "paper after 8 million: 90.0%"
    assert len(validation.lines) == 0
    assert legend_texts(figure) == [
        "mine, held at best (mean ± std of 2 seeds)",
        "every evaluation of a run",
        "the paper, held at best (mean ± std over seeds)",
    ]


@pytest.mark.unit
def test_a_paper_curve_of_two_settings_is_drawn_once() -> None:
    run = {"train": [RunCurve(np.array([1e6, 2e6]), np.array([0.1, 0.5]))]}
    paper = {"train": PaperCurve(np.array([1e6, 2e6]), np.array([0.4, 0.9]), np.zeros(2))}
    settings = [CurveSetting(name, RED, run, paper) for name in ("a", "b")]
    figure = learning_curves(settings, SUCCESS, ["train"])
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert labels.count("paper") == 1
    assert {"a", "b"} < set(labels)


@pytest.mark.unit
def test_bars_draw_the_numbers() -> None:
    ours = {"train": Bar(0.9, 0.88, 0.91), "test": Bar(0.7, 0.65, 0.72)}
    settings = [
        BarSetting("mine", RED, ours, {"test": Bar(0.6, 0.5, 0.7)}, "1 seed", "8 seeds"),
        BarSetting("other", RED, {"test": Bar(0.2, 0.2, 0.2)}, {}),
    ]
    figure = bars(settings, SUCCESS, footnote="error bars: so")
    (axes,) = figure.axes
    shown = [
        (p.get_x() + p.get_width() / 2, p.get_height(), p.get_alpha(), bool(p.get_hatch()))
        for p in axes.patches
    ]
    assert shown[0] == pytest.approx((-0.21, 90.0, 0.25, False))
    assert shown[1] == pytest.approx((-0.21, 70.0, 0.8, True))
    assert shown[2] == pytest.approx((0.21, 60.0, 0.8, True))
    assert shown[3] == pytest.approx((1.0, 20.0, 0.8, True))  # Nothing of the paper: in the middle.
    assert axes.patches[1].get_zorder() > axes.patches[0].get_zorder()
    assert to_rgb(axes.patches[0].get_facecolor()) == RED
    assert to_rgb(axes.patches[2].get_facecolor()) != RED
    ends = [c.get_paths()[0].vertices[:, 1] for c in axes.collections]
    assert ends[0] == pytest.approx([88.0, 91.0])
    assert ends[1] == pytest.approx([65.0, 72.0])
    assert ends[2] == pytest.approx([50.0, 70.0])
    ticks = [label.get_text() for label in axes.get_xticklabels()]
    assert ticks == ["ours\n1 seed", "paper\n8 seeds", "ours"]
    assert texts(figure) == "90.0 | 70.0 | 60.0 | mine | 20.0 | other"
    assert legend_texts(figure) == ["unseen test actions", "train actions"]
    assert figure.get_supxlabel() == "error bars: so"
    assert axes.get_ylim() == (0.0, 110.0)


@pytest.mark.unit
def test_a_metric_has_the_unit_and_limit_of_the_paper() -> None:
    assert Metric.of("is_success").text(0.7029) == "70.3"
    height = Metric("Final height (m)", limit=2.75, unit=" m", cuts_train=True)
    assert Metric.of("final_height", "final_height") == Metric.of("final_height") == height
    assert Metric.of("click_through_rate", "ctr").text(0.1968) == "0.197"
    assert Metric.of("has_reached_subgoal").name == "Reached subgoal (%)"
    high = bars([BarSetting("a", RED, {"test": Bar(7.5, 7.0, 8.0)}, {})], Metric.of("x", "ctr"))
    assert high.axes[0].get_ylim()[1] > 8.0  # A limit never hides a bar.


@pytest.mark.unit
def test_heights_end_at_the_papers_limit_unless_test_bars_are_higher() -> None:
    metric = Metric.of("final_height")
    both = {"train": Bar(7.5, 6.4, 8.7), "test": Bar(1.4, 1.3, 1.5)}
    lines = {"random": 1.25, "scripted": 4.25}
    settings = [
        BarSetting("a", RED, both, {"train": Bar(2.5, 2.25, 2.8)}, anchors=lines),
        BarSetting("b", RED, {"test": Bar(1.0, 0.9, 1.1)}, {}, anchors={"scripted": 3.5}),
        BarSetting("b", RED, {"test": Bar(1.0, 0.9, 1.1)}, {}, anchors={"scripted": 4.25}),
        BarSetting("c", RED, {"test": Bar(1.0, 0.9, 1.1)}, {}, anchors={"random": 1.5}),
    ]
    figure = bars(settings, metric, footnote="so")
    (axes,) = figure.axes
    assert axes.get_ylim() == (0.0, 2.75)
    numbers = {t.get_text(): t for t in axes.texts}
    # Cut off, with its number below the end; one whose error bar alone is, without an arrow.
    assert numbers["7.500 ↑"].xy[1] == numbers["2.500"].xy[1] == 2.75
    assert {numbers[text].get_va() for text in ("7.500 ↑", "2.500")} == {"top"}
    assert (numbers["1.400"].xy[1], numbers["1.400"].get_va()) == (1.5, "baseline")
    drawn = [
        (tuple(line.get_xdata()), line.get_ydata()[0], line.get_linestyle())
        for line in axes.lines
        if len(line.get_xdata()) == 2
    ]
    assert drawn == [
        ((-0.46, 0.46), 1.25, ":"),
        ((-0.46, 0.46), 4.25, "-."),
        ((0.54, 1.46), 3.5, "-."),
        ((1.54, 2.46), 4.25, "-."),
        ((2.54, 3.46), 1.5, ":"),
    ]
    assert legend_texts(figure) == ["unseen test actions", "train actions", "random", "scripted"]
    assert figure.get_supxlabel() == "so\nLines above the axis: scripted at 4.250, 3.500 m."
    higher = bars([BarSetting("a", RED, {"test": Bar(3.0, 2.9, 3.0)}, {})], metric)
    assert higher.axes[0].get_ylim()[1] == pytest.approx(1.12 * 3.0)


@pytest.mark.unit
def test_scatter_draws_each_class_in_its_colour(tmp_path: Path) -> None:
    points = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])
    figure = tsne_scatter([Scatter(points, np.array([2, 0, 2]), "below")], ("a", "b", "c"), "title")
    first, second = (c for c in figure.axes[0].collections if isinstance(c, PathCollection))
    assert first.get_offsets().tolist() == [[2.0, 3.0]]
    assert second.get_offsets().tolist() == [[0.0, 1.0], [4.0, 5.0]]
    assert second.get_facecolor()[0][:3] == pytest.approx(hls_palette(3)[2])
    assert legend_texts(figure) == ["a", "c"]
    assert not figure.axes[0].axison
    written = save(figure, tmp_path / "new" / "a.png", pdf=True)
    assert [path.name for path in written] == ["a.png", "a.pdf"]
    assert Image.open(written[0]).size == (920, 960)
    assert written[1].read_bytes().startswith(b"%PDF")


# ---- Runs and results ----


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
def test_another_split_is_not_compared_with_the_paper(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run", plain_config(split="another"))
    write_evaluation(path, "test", 0.75)
    (group,) = groups_at(path)
    assert group.paper_method is None
    assert result_rows(group)[0].paper_mean is None


@pytest.mark.unit
def test_a_damaged_evaluation_is_named(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run", plain_config())
    (path / "evaluation" / "test.json").write_text("{")
    with pytest.raises(UsageError, match=r"test\.json is damaged"):
        read_runs([path])


@pytest.mark.unit
def test_colours_are_the_papers_and_never_shared(tmp_path: Path) -> None:
    configs = [
        plain_config(representation="hvae"),
        plain_config(representation="gt5"),
        plain_config(representation="hvae", learning_rate=0.01),
        plain_config(representation="gt12"),
    ]
    paths = [write_run(tmp_path / f"{i}", config) for i, config in enumerate(configs)]
    colors = drawing.setting_colors(groups_at(*paths))
    assert colors[0] == hls_palette(10)[3]
    assert colors[3] == hls_palette(10)[4]
    assert len(set(colors)) == 4


@pytest.mark.unit
def test_learning_curve_of_a_run_in_environment_steps(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run", plain_config(representation="hvae"))
    figure = drawing.curves_figure(groups_at(path))
    assert figure is not None
    raw, held = (line for line in figure.axes[1].lines if line.get_label().startswith("ours,"))
    # Evaluated after 2, 4 and 6 updates of 256 steps; below a million the axis is in thousands.
    assert raw.get_xdata() == pytest.approx([0.512, 1.024, 1.536])
    assert raw.get_ydata() == pytest.approx([5.0, 15.0, 10.0])
    assert held.get_ydata() == pytest.approx([5.0, 15.0, 15.0])
    labels = legend_texts(figure)
    assert labels[-1] == "paper, ours, held at best (mean ± std over seeds)"
    # The paper has no curve for engineered vectors: its default stands in, under its own name.
    engineered = write_run(tmp_path / "gt12", plain_config())
    figure = drawing.curves_figure(groups_at(engineered))
    assert figure is not None
    assert legend_texts(figure)[-1].startswith("paper, ours on HVAE (none for gt12), held")
    untrained = write_run(tmp_path / "none", plain_config(seed=5), curve=())
    assert drawing.curves_figure(groups_at(untrained)) is None


@pytest.mark.unit
def test_bars_of_runs_beside_the_papers(tmp_path: Path) -> None:
    paths = [
        write_run(tmp_path / f"{i}", plain_config(seed=i, representation="hvae")) for i in (1, 2)
    ]
    paths.append(write_run(tmp_path / "gt5", plain_config(representation="gt5")))
    for path, mean in zip(paths, (0.6, 0.8, 0.5), strict=True):
        write_evaluation(path, "test", mean)
    groups = groups_at(*paths)
    rows = {group.label: result_rows(group) for group in groups}
    figure = drawing.bars_figure(groups, rows)
    assert figure is not None
    axes = figure.axes[0]
    # Two seeds, the paper's `ours`, and a setting that the paper does not have.
    assert [p.get_height() for p in axes.patches] == pytest.approx([70.0, 70.29, 50.0])
    assert [c.get_paths()[0].vertices[0, 1] for c in axes.collections] == pytest.approx(
        [60.0, 70.29 - 3.86, 48.0]
    )
    assert [label.get_text() for label in axes.get_xticklabels()] == [
        "ours\n2 seeds\n1.54 k steps",
        "paper\n8 seeds\n40 M steps",
        "ours\n1 seed\n1.54 k steps",
    ]
    assert figure.get_supxlabel().split("\n") == [
        "Error bars: ours, population std over seeds;",
        "ours, 95 % interval over episodes (1,000 episodes a bar);",
        "paper, population std over seeds.",
    ]
    assert drawing.bars_figure(groups, {label: [] for label in rows}) is None


@pytest.mark.unit
def test_tsne_draws_the_actions_of_one_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[np.ndarray] = []

    def first_two(vectors: np.ndarray, seed: int) -> np.ndarray:
        seen.append(vectors)
        return vectors[:, :2]

    monkeypatch.setattr(drawing.report, "tsne", first_two)
    ids = np.arange(1024, dtype=np.int32)
    # The vector says which action it is; quadrants lie apart, so that every neighbour is a friend.
    labels = skill_universe().class_labels
    vectors = np.stack([1e4 * labels + ids, np.zeros(1024)], axis=1)
    table = RepresentationTable(vectors.astype(np.float32), ids, source="made")
    (run,) = read_runs([write_run(tmp_path / "run", plain_config(seed=3), table=table)])
    split = a_split()
    held_out = np.sort(np.concatenate([split.validation, split.test]))
    parts = {"heldout": held_out, "train": split.train, "all": ids}
    for part, members in parts.items():
        figure = drawing.tsne_figure(run, part)
        assert figure is not None
        drawn = (seen[-1][:, 0] % 1e4).astype(int)
        assert len(drawn) == 400
        assert len(set(drawn)) == 400
        assert set(drawn) <= set(members.tolist())
        subtitle = figure.axes[0].get_title()
        assert subtitle.startswith(f"t-SNE of 400 of {len(members)} actions; 5-NN purity 1.000")
        for label, points in enumerate(figure.axes[0].collections):
            x = np.asarray(points.get_offsets())[:, 0]
            assert x.tolist() == seen[-1][labels[drawn] == label, 0].tolist()
    assert legend_texts(figure) == list(skill_universe().class_names)
    drawing.tsne_figure(run, "all")
    assert np.array_equal(seen[-1], seen[-2])  # The seed of the run chooses.


# ---- From directories to files ----


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
def test_command_draws_a_run_of_embed(tmp_path: Path) -> None:
    config = {
        "task": "grid_world",
        "representation": "gt12",
        "split": "default",
        "seed": 3,
        "model": {},
    }
    run = write_run(tmp_path / "embed", config)
    files = commands.run("figures", f"--run={run}").split()
    assert files == [str(run / "figures" / f"tsne_{part}.png") for part in drawing.TSNE_PARTS]
    assert all(Image.open(file).size == (920, 960) for file in files)


@pytest.mark.unit
def test_command_asks_for_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(paths: list[Path], episode: bool = False, out: Path | None = None) -> None:
        values = {"run": list(map(str, paths)), "out": out, "pdf": False, "episode": episode}
        values["figure"] = []
        monkeypatch.setattr(figures.flags, "FLAGS", SimpleNamespace(**values))
        figures.main()

    one, other = (write_run(tmp_path / f"{i}", plain_config(seed=i)) for i in range(2))
    with pytest.raises(UsageError, match="--out=DIRECTORY"):
        run([one, other])
    with pytest.raises(UsageError, match="Say which runs"):
        run([])
    config = {**plain_config(), "task": "recommender"}
    with pytest.raises(UsageError, match=r"several tasks, \['grid_world', 'recommender'\]"):
        run([one, write_run(tmp_path / "2", config)], out=tmp_path)


# ---- Episodes ----


@pytest.fixture(scope="module")
def trainer() -> Trainer:
    table = engineered_table(skill_universe(), "gt12")
    config = TrainConfig.from_plain(plain_config())
    return Trainer.of(config, TASK, a_split(), table)


@pytest.fixture(scope="module")
def untrained(trainer: Trainer) -> TrainState:
    """A state of the right shapes with random parameters; `init` would take seconds to compile."""
    shapes = jax.eval_shape(
        trainer.learner.init, jax.random.key(0), trainer.table, trainer.pools["train"]
    )
    rng = np.random.default_rng(0)

    def fill(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.key(0)
        return jnp.ones(leaf.shape, leaf.dtype)

    state = jax.tree.map(fill, shapes)
    params = jax.tree.map(
        lambda leaf: jnp.asarray(rng.normal(0.0, 0.3, leaf.shape), leaf.dtype), shapes.params
    )
    return state.replace(params=params)


@pytest.mark.integration
def test_episodes_are_those_of_the_evaluation(trainer: Trainer, untrained: TrainState) -> None:
    # Narrow, so that two blocks are needed.
    evaluator = replace(trainer.evaluator, width=32)
    trainer = replace(trainer, evaluator=evaluator)
    played = play_episodes(trainer, untrained, "test", 20, 60)
    expected = trainer.evaluator.run(
        untrained.params,
        untrained.rollout.observation_statistics,
        trainer.table,
        trainer.pools["test"],
        jax.random.key(episodes.EVALUATION_SEED),
        80,
    )
    assert [e.number for e in played] == list(range(20, 80))
    assert [len(e.action_ids) for e in played] == expected["num_steps"][20:].astype(int).tolist()
    assert [e.is_success for e in played] == expected["is_success"][20:].astype(bool).tolist()
    # Rewards are multiples of 0.1 and 0.018, added in the same order in float32.
    assert [sum(e.rewards) for e in played] == pytest.approx(
        expected["episode_return"][20:].tolist(), abs=1e-5
    )
    assert [e.metrics["episode_return"] for e in played] == expected["episode_return"][20:].tolist()
    moves = [int(e.states[-1].num_moves) for e in played]
    assert moves == expected["episode_length"][20:].astype(int).tolist()
    test_ids = set(a_split().test.tolist())
    for e in played:
        assert len(e.states) == len(e.action_ids) + 1 == len(e.rewards) + 1
        assert len(set(e.available_ids.tolist())) == 50
        assert set(e.action_ids) <= set(e.available_ids.tolist()) <= test_ids


@pytest.mark.unit
def test_the_first_success_is_chosen_and_said() -> None:
    played = [
        Episode(number, [], [], [], {}, is_success, np.zeros(0, np.int32))
        for number, is_success in enumerate([False, False, True, True])
    ]
    assert choose(played) == (
        played[2],
        "episode 2, first successful of episodes 0..3 (2 of 4 were)",
    )
    assert choose(played[:2]) == (
        played[0],
        "episode 0: none of episodes 0..1 was successful",
    )


@pytest.mark.integration
def test_animation_of_a_checkpoint(
    tmp_path: Path,
    trainer: Trainer,
    untrained: TrainState,
    capsys: pytest.CaptureFixture[str],
) -> None:
    split, table = a_split(), engineered_table(skill_universe(), "gt12")
    hashes = {"split_hash": split.hash, "table_hash": table.hash}
    path = write_run(tmp_path / "run", {**plain_config(), **hashes})
    metadata = {"best_metric": 0.0, "best_step": 0, "elapsed_s": 0.0}
    Checkpointer(path / "checkpoints").save("best", 0, untrained, metadata)
    gif, still = episode_animation(path, tmp_path / "out" / "episode.gif", episode=7)
    assert (gif.name, still.name) == ("episode.gif", "episode.png")
    (episode,) = play_episodes(trainer, untrained, "test", 7, 1)
    # One frame per move, and the start.
    assert Image.open(gif).n_frames == 1 + int(episode.states[-1].num_moves)
    assert Image.open(still).size[0] == 540
    output = capsys.readouterr().out
    assert "episode 7, as asked for; sets of 50 test skills, 0 of them seen in training" in output
    assert json.loads((path / "config.json").read_text())["seed"] == 1
