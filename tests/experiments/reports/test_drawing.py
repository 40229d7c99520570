"""Figures of groups of runs show the numbers of their directories, the paper's beside them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs_mjx.grid_world import skill_universe
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from experiments.reports import drawing, paper_figures
from experiments.reports.figure_list import FIGURES
from experiments.reports.plots import hls_palette
from experiments.reports.production import Cell
from experiments.reports.results import result_rows
from experiments.reports.runs import read_runs
from jaxnew.representation.table import RepresentationTable, engineered_table
from jaxnew.task.domain import Domain
from tests.experiments.handwritten import (
    a_split,
    group_of,
    groups_at,
    plain_config,
    source_of,
    write_evaluation,
    write_run,
)
from tests.experiments.reports.test_plots import legend_texts

OURS = Cell("ours", "hvae")
NO_SUBGOALS = Cell("ours", "hvae", variant="-no-subgoals")
FULL = Cell("ours", "hvae", split="full")
TASK = "shape_stacking"


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
        "jaxnew\n2 seeds\n1.54 k steps",
        "paper\n8 seeds\n40 M steps",
        "jaxnew\n1 seed\n1.54 k steps",
    ]
    assert figure.get_supxlabel().split("\n") == [
        "Error bars: jaxnew, population std over seeds;",
        "jaxnew, 95 % interval over episodes (1,000 episodes a bar);",
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


@pytest.mark.unit
def test_curves_of_the_paper_are_those_of_the_default_setting(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path)

    def curves(cell: Cell) -> tuple[bool, str]:
        found, label = drawing._paper_curves(group_of(source, cell))
        return bool(found), label

    assert curves(OURS) == (True, "paper, ours")
    assert curves(Cell("no-entropy", "hvae")) == (True, "paper, ours_no_entropy")
    assert curves(FULL) == (False, "")
    beside = "paper, ours on HVAE (none for ours_no_subgoal_reward)"
    assert curves(NO_SUBGOALS) == (True, beside)
    assert curves(Cell("ours", "gt32")) == (True, "paper, ours on HVAE (none for gt32)")


@pytest.mark.unit
def test_every_curve_of_figure_24_is_the_papers(tmp_path: Path) -> None:
    source = source_of(TASK, tmp_path)
    for cell in FIGURES["24"].cells[TASK]:
        group = group_of(source, cell)
        curves, label = drawing._paper_curves(group)
        assert label == f"paper, {group.paper_method}"
        assert set(curves) == {"train", "validation"}


@pytest.mark.unit
def test_held_out_tools_of_two_splits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = source_of("create-push", tmp_path)
    full = source.of(FULL).domain
    universe = source.domain.universe
    vectors = universe.engineered["gt32"]
    noise = np.random.default_rng(0).normal(size=(universe.num_actions, 3)).astype(np.float32)
    ids = np.arange(universe.num_actions, dtype=np.int32)
    given = {}
    for name, rows in (("hvae", vectors), ("vae", noise), ("hvae-video", vectors[:, :2])):
        given[name] = tmp_path / f"{name}.npz"
        RepresentationTable(np.ascontiguousarray(rows), ids, source=name).save(given[name])
    given["hvae@full"] = tmp_path / "full.npz"
    engineered_table(universe, "gt32").save(given["hvae@full"])
    settings = paper_figures.settings_of(FIGURES["15"], replace(source, given=given))
    panels = paper_figures.representation_panels(settings)
    assert [(name, d.split_name) for name, (d, _) in panels.items()] == [
        ("hvae", "default"),
        ("vae", "default"),
        ("hvae-video", "default"),
        ("hvae, split full", "full"),
    ]
    drawn = []
    monkeypatch.setattr(
        drawing.report, "tsne", lambda rows, seed: drawn.append(len(rows)) or rows[:, :2]
    )
    figure = drawing.representations_figure(panels, "Figure 15")

    def purity(table: np.ndarray, domain: Domain) -> float:
        """Share of the five nearest others that are of an action's class, mean over actions."""
        rows = np.sort(np.concatenate([domain.split.validation, domain.split.test]))
        labels, x = universe.class_labels[rows], table[rows].astype(np.float64)
        distances = np.square(x[:, None] - x[None]).sum(axis=-1)
        np.fill_diagonal(distances, np.inf)
        nearest = np.argsort(distances, axis=1, kind="stable")[:, :5]
        return float((labels[nearest] == labels[:, None]).mean())

    titles = [axes.get_title() for axes in figure.axes]
    default, noisy = purity(vectors, source.domain), purity(noise, source.domain)
    assert titles[0].startswith("hvae\nt-SNE of 400 of ")
    # 0.005: ties between tools that the engineered vectors do not tell apart.
    for title, expected in (
        (titles[0], default),
        (titles[1], noisy),
        (titles[3], purity(vectors, full)),
    ):
        assert float(title.split("purity ")[1].split()[0]) == pytest.approx(expected, abs=5e-3)
    assert default > 0.9 > 0.5 > noisy
    assert drawn == [400] * 4


@pytest.mark.unit
def test_held_out_shapes_of_two_splits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = source_of(TASK, tmp_path)
    universe = source.domain.universe
    noise = np.random.default_rng(0).normal(size=(universe.num_actions, 3)).astype(np.float32)
    ids = np.arange(universe.num_actions, dtype=np.int32)
    given = {}
    for name in ("hvae", "vae", "hvae@full"):
        given[name] = tmp_path / f"{name}.npz"
        table = engineered_table(universe, "gt21")
        if name == "vae":
            table = RepresentationTable(noise, ids, source=name)
        table.save(given[name])
    settings = paper_figures.settings_of(FIGURES["16"], replace(source, given=given))
    assert paper_figures.missing_jobs(FIGURES["16"], settings) == []
    panels = paper_figures.representation_panels(settings)
    assert [(name, d.split_name) for name, (d, _) in panels.items()] == [
        ("hvae", "default"),
        ("vae", "default"),
        ("hvae, split full", "full"),
    ]
    monkeypatch.setattr(drawing.report, "tsne", lambda rows, seed: rows[:, :2])
    drawn = [drawing.tsne_panel(d, t, "heldout", 31, name) for name, (d, t) in panels.items()]
    # 405 and 390 are held out, of the Full split 8 classes.
    assert ["of 405 actions" in panel.subtitle for panel in drawn] == [True, True, False]
    full = {CLASS_NAMES[label] for label in drawn[2].labels}
    assert full == {
        *("hat", "cylinder", "tetrahedron", "horizontal_rectangle", "middle_triangle"),
        *("cube", "cone", "cone-hires"),
    }
    assert len(np.unique(drawn[0].labels)) == 16
    purity = [float(panel.subtitle.split("purity ")[1].split()[0]) for panel in drawn]
    assert purity[0] > 0.9 > 0.3 > purity[1]  # The engineered vectors hold the class.
    figure = drawing.representations_figure(panels, "Figure 16: held-out shapes")
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(CLASS_NAMES)
