"""The paper's figures of Shape Stacking: settings, commands, and the numbers beside them."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from envs_mjx.shape_stacking import ShapeStacking, films
from envs_mjx.shape_stacking.camera import task_camera
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from envs_mjx.shape_stacking.solids import CLASS_NAMES
from experiments import figures
from experiments.pipeline.flags import load_task
from experiments.pipeline.training import load_trainer
from experiments.reports import comparison, drawing, finetuning, paper_figures
from experiments.reports import films as film_reports
from experiments.reports.episode import is_success
from experiments.reports.figure_list import FIGURES, number_of
from experiments.reports.paper import paper_curve, paper_method, paper_value
from experiments.reports.production import Cell, find
from experiments.reports.results import result_rows
from experiments.reports.runs import Group, read_runs
from jaxnew.representation.table import RepresentationTable, engineered_table
from tests.experiments.handwritten import write_evaluation, write_run
from tests.experiments.test_anchors import write_anchors
from tests.experiments.test_create_figures import config_of, source_of
from tests.experiments.test_films import untrained

TASK = "shape_stacking"
OURS = Cell("ours", "hvae")
NO_PLACE = Cell("ours", "hvae", variant="-no-place")
SQUARE = Cell("ours", "hvae", variant="-2d-place")
FULL = Cell("ours", "hvae", split="full")
HEIGHT = "final_height"


def finished(source: Any, cell: Cell, seed: int = 1, **written: Any) -> Path:
    own = source.of(cell)
    name = f"{cell.label}-{seed}".replace(" ", "").replace(",", "-")
    config = config_of(source, cell, seed)
    curve = {"curve": (0.1,), "metric": HEIGHT, **written}
    return write_run(own.domain.folder(own.folder) / name, config, **curve)


def group_of(source: Any, cell: Cell, **written: Any) -> Group:
    path = finished(source, cell, **written)
    return Group(cell.label, source.of(cell).domain.task, tuple(read_runs([path])))


# ---- Settings and commands ----


@pytest.mark.unit
def test_figures_that_show_stacking() -> None:
    shown = [number for number, figure in FIGURES.items() if TASK in figure.cells]
    assert shown == ["4", "6", "7b", "8", "16", "19", "23", "24"]
    assert number_of("10", TASK) == "19"
    assert [cell.label for cell in FIGURES["23"].cells[TASK]] == [
        "ours, hvae",
        "ours, hvae, no place",
        "ours, hvae, 2d place",
        "ours, hvae, split full",
    ]
    assert [cell.label for cell in FIGURES["16"].cells[TASK]] == [
        "ours, hvae",
        "ours, vae",
        "ours, hvae, split full",
    ]


@pytest.mark.unit
def test_the_variants_share_an_encoder_and_have_sweeps_of_their_own(tmp_path: Path) -> None:
    source = source_of(TASK, tmp_path)
    settings = paper_figures.settings_of(FIGURES["23"], source)
    jobs = paper_figures.unique_jobs(paper_figures.missing_jobs(FIGURES["23"], settings))
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


# ---- The paper's numbers ----


@pytest.mark.golden
@pytest.mark.parametrize(
    ("cell", "train", "test"),
    [
        # Experiments spec 3, 4, 6 and 13.
        (OURS, 2.354, 1.716),
        (Cell("ours", "vae"), 2.231, 1.526),
        (Cell("continuous", "hvae"), 1.473, 1.120),
        (Cell("nearest-neighbour", "hvae"), 7.545, 1.433),
        (Cell("no-entropy", "hvae"), 2.228, 1.604),
        (Cell("no-subsampling", "hvae"), 7.239, 1.241),
        (Cell("ours", "gt21"), 1.436, 1.329),
        (Cell("ours", "hvae-oracle"), 2.326, 1.660),
        (NO_PLACE, 2.612, 1.412),
        (SQUARE, 1.618, 1.448),
        (FULL, 2.407, 1.288),
        (Cell("ours", "vae", split="full"), None, None),
        (Cell("no-entropy", "hvae", variant="-no-place"), None, None),
        (Cell("ours", "hvae", variant="-no-place", split="full"), None, None),
        (Cell("no-entropy", "hvae", split="full"), None, None),
    ],
    ids=lambda value: value.label if isinstance(value, Cell) else None,
)
def test_bars_stand_beside_their_rows(
    tmp_path: Path, cell: Cell, train: float | None, test: float | None
) -> None:
    group = group_of(source_of(TASK, tmp_path), cell)
    found = []
    for split in ("train", "test"):
        value = None
        if group.paper_method is not None:
            value = paper_value("Shape Stacking", group.paper_method, split, group.paper_figure)
        found.append(None if value is None else value.mean)
    # The spec's tables are rounded.
    assert found == pytest.approx([train, test], abs=6e-4)


@pytest.mark.unit
def test_both_names_of_the_default_modality_count() -> None:
    assert paper_method("ours", "hvae-image") == "ours"
    assert paper_method("ours", "vae-image") == "vae"
    assert paper_method("no-subsampling", "hvae-image") == "ours_no_subsampling"


@pytest.mark.unit
def test_every_curve_of_figure_24_is_the_papers(tmp_path: Path) -> None:
    source = source_of(TASK, tmp_path)
    for cell in FIGURES["24"].cells[TASK]:
        group = group_of(source, cell)
        curves, label = drawing._paper_curves(group)
        assert label == f"paper, {group.paper_method}"
        assert set(curves) == {"train", "validation"}


@pytest.mark.unit
def test_figures_find_runs_of_their_own_environment_only(tmp_path: Path) -> None:
    """A run with other settings is another setting, which the paper has no numbers of."""
    kept, curve = "environment.reward_variant=paper", {"curve": (0.1,), "metric": HEIGHT}
    settings = {"plain": [], "changed": [kept]}
    plain = source_of(TASK, tmp_path)
    changed = replace(plain, assignments=(" environment.reward_variant = paper",))
    for name, environment in settings.items():
        config = {**config_of(plain, OURS), "environment": environment}
        write_run(tmp_path / TASK / name, config, **curve)
    for source, name in ((plain, "plain"), (changed, "changed")):
        (run,) = find(source, OURS).values()
        assert run.path == tmp_path / TASK / name
        group = Group("ours", source.domain.task, (run,))
        assert group.paper_method == {"plain": "ours", "changed": None}[name]
    source = replace(plain, assignments=(kept, "pool.max_restarts=3", "num_updates=7"))
    assert source.budget_of("ours").num_updates == 7
    assert source.budget_assignments == ["num_updates=7"]
    job = finetuning.finetune_job(source, tmp_path, "ours", 1, "warm", 0)
    assert [word for word in job.command if word.startswith("--set")] == [
        "--set=num_updates=7",
        f"--set=num_updates={math.ceil(7 * source.domain.task.baselines.finetune_share)}",
    ]


@pytest.mark.golden
def test_learning_curves_stand_beside_the_papers(tmp_path: Path) -> None:
    """Experiments spec 15, ours at a third, two thirds and all of the budget."""
    source = source_of(TASK, tmp_path, budget="paper")
    # 244 updates of 4,096 steps are a third of 3 million.
    group = group_of(source, OURS, curve=(1.5, 2.4, 2.1), updates=244)
    picture, text, table = paper_figures.draw_curves("figure_24", "Curves", [group], tmp_path)
    with table.open() as file:
        rows = list(csv.DictReader(file))
    train = {round(float(r["steps"]), -4): r for r in rows if r["split"] == "train"}
    validation = {round(float(r["steps"]), -4): r for r in rows if r["split"] == "validation"}
    assert [float(train[s]["mean"]) for s in (1e6, 2e6, 3e6)] == [1.5, 2.4, 2.4]
    # The curves were traced, and are straight between points: 0.05.
    for rows_of, means in ((train, (2.160, 2.320)), (validation, (1.687, 1.777))):
        found = [float(rows_of[s]["paper_mean"]) for s in (1e6, 2e6)]
        assert found == pytest.approx(means, abs=0.05)
    assert "Final height (m); every seed held" in text.read_text()
    assert Image.open(picture).size[0] > 800
    curve = paper_curve("Shape Stacking", "ours", "train")
    assert curve.mean[-1] == pytest.approx(2.538, abs=0.005)
    assert 2.7e6 < curve.steps[-1] <= 3e6


@pytest.mark.unit
def test_train_curves_of_another_simulator_are_not_compared(tmp_path: Path) -> None:
    """Experiments spec 15: of methods with one fixed set; their validation curves are sound."""
    source = source_of(TASK, tmp_path, budget="paper")
    cells = (OURS, Cell("nearest-neighbour", "hvae"), Cell("no-subsampling", "hvae"))
    groups = [group_of(source, cell, curve=(1.5, 2.4, 2.1), updates=244) for cell in cells]
    for group in groups:
        points = [p for p in comparison.compare_curves([group]) if p.paper_mean is not None]
        assert {p.split for p in points} == {"train", "validation"}
        for point in points:
            is_fair = group is groups[0] or point.split == "validation"
            assert (point.verdict is not None) == is_fair
    note = FIGURES["24"].notes[TASK]
    _, text, _ = paper_figures.draw_curves("f", "Curves", groups, tmp_path, note=note)
    assert text.read_text().rstrip().endswith(note)


@pytest.mark.unit
def test_zero_shot_lines_of_fine_tuning(tmp_path: Path) -> None:
    source = source_of(TASK, tmp_path)
    path = finished(source, OURS)
    write_evaluation(path, "test", 1.5, HEIGHT, set_size=5)
    write_evaluation(path, "test", 1.75, HEIGHT, set_size=203)
    group = Group("ours", source.domain.task, tuple(read_runs([path])))
    lines = [(r.label, r.mean) for r in finetuning._references(source, group, 1000)]
    # Experiments spec 8.
    assert lines == [
        ("ours, zero-shot, sets as in training (5)", 1.5),
        ("paper, zero-shot, sets as in training", pytest.approx(1.716, abs=1e-3)),
        ("ours, zero-shot, all at once (203)", 1.75),
        ("paper, zero-shot, all at once", pytest.approx(2.054, abs=1e-3)),
    ]


# ---- Pictures ----


@pytest.mark.unit
def test_bars_of_figure_23_with_anchors(tmp_path: Path) -> None:
    source = source_of(TASK, tmp_path)
    settings = paper_figures.settings_of(FIGURES["23"], source)
    means = iter(np.arange(1, 17) / 8)
    expected, groups = [], []
    for own, cell in settings:
        for split in ("train", "test"):
            both = [float(next(means)) for _ in source.seeds]
            expected.append(np.mean(both))
            for seed, mean in zip(source.seeds, both, strict=True):
                write_evaluation(finished(source, cell, seed), split, mean, HEIGHT, set_size=5)
        groups.append(paper_figures.group_of(own, cell))
    for number, task in enumerate((TASK, f"{TASK}-no-place")):
        write_anchors(tmp_path / task / "anchors", 0.25 * (1 + number), task=task)
    write_anchors(tmp_path / TASK / "anchors", 0.75, split="full")
    for file in tmp_path.rglob("anchors/*.json"):  # Runs at smoke budget have smaller sets.
        file.write_text(file.read_text().replace('"set_size": 20', '"set_size": 5'))
    values = SimpleNamespace(episodes=1000, pdf=False)
    drawn = paper_figures.draw("23", FIGURES["23"], settings, tmp_path, values)
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
    table, _ = figures.write_table(groups, of_groups, tmp_path, ["A note."])
    assert table.read_text().count("Policies without training, shape_stacking") == 3
    assert "A note." in table.read_text()
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
    values = SimpleNamespace(episodes=1000, pdf=False)
    _, text, _ = paper_figures.draw("6", FIGURES["6"], settings, tmp_path, values)
    assert "another simulator" in text.read_text()
    groups = [paper_figures.group_of(own, cell) for own, cell in settings]
    figure = drawing.bars_figure(groups, {g.label: result_rows(g) for g in groups})
    assert figure.axes[0].get_ylim()[1] == 2.75
    assert "7.239 ↑" in [text.get_text() for text in figure.axes[0].texts]


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
    # Spec 9: 405 and 390 are held out, of the Full split 8 classes.
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


# ---- Films ----


@pytest.mark.unit
def test_a_tower_is_a_success_from_the_mean_of_random_play() -> None:
    task = load_task(TASK)
    assert is_success(task, {HEIGHT: 1.3})
    assert not is_success(task, {HEIGHT: 1.29})
    assert is_success(load_task("grid_world"), {"is_success": 1.0})
    assert not is_success(load_task("grid_world"), {"is_success": 0.0})


@pytest.mark.integration
def test_films_of_towers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, trainer = untrained(tmp_path / "run", TASK, "gt21")
    short = ShapeStacking(MujocoC(settle_steps=24))
    narrow = replace(trainer, evaluator=replace(trainer.evaluator, env=short, width=2))
    played: list[Any] = []

    def load(*given: Any) -> Any:
        run, _, split = load_trainer(*given)
        return run, narrow, split

    def play(*given: Any) -> Any:
        played.extend(_episode_play(*given))
        return played

    _episode_play = film_reports.play_episodes
    monkeypatch.setattr(film_reports, "load_trainer", load)
    monkeypatch.setattr(film_reports, "play_episodes", play)
    out = tmp_path / "figure_8"
    files = film_reports.film_run(path, out, 2, size=40, title="Towers", with_pages=True)
    assert [file.name for file in files[:2]] == ["figure_8.png", "figure_8.csv"]
    with files[1].open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2
    heights = [float(row[HEIGHT]) for row in rows]
    for row, episode in zip(rows, played, strict=True):
        last = episode.states[-1].bodies
        top = max(z for i, z in zip(last.shape_ids, last.qpos[:, 2], strict=True) if i >= 0)
        assert float(row[HEIGHT]) == pytest.approx(top + 0.5, abs=1e-6)
        assert row["outcome"] == ("success" if float(row[HEIGHT]) >= 1.3 else "failure")
        assert row["action_ids"] == " ".join(str(int(a.id)) for a in episode.actions)
        film = tmp_path / row["film"]
        for word, state in (("start", episode.states[0]), ("end", episode.states[-1])):
            still = np.asarray(Image.open(film.with_name(f"{film.stem}-{word}.png")))
            expected = films.draw_bodies(state.bodies, task_camera(1), 40)
            np.testing.assert_array_equal(still, expected)
        num_placed = int(np.sum(last.shape_ids[2:] >= 0))
        assert int(float(row["num_placed"])) == num_placed
        assert Image.open(film).n_frames >= 1 + num_placed
        page = film.with_suffix(".html").read_text(encoding="utf-8")
        assert page == films.episode_page(short, episode.states, episode.actions)
    assert max(len(episode.actions) for episode in played) > 1
    assert len(set(heights)) == 2
