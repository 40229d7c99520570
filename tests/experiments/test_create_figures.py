"""The paper's figures of CREATE: their settings, their commands and the numbers beside them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from experiments.pipeline.artifacts import Domain
from experiments.pipeline.flags import UsageError, load_task
from experiments.reports import drawing, finetuning, paper_figures, studies
from experiments.reports.figure_list import FIGURES
from experiments.reports.jobs import announce, embed_job, training_jobs
from experiments.reports.paper import paper_value
from experiments.reports.production import Cell, Source, find
from experiments.reports.runs import Group, read_runs
from experiments.reports.study_report import Study, StudyPoint, as_csv, as_markdown, study_figure
from experiments.tasks.create import LEVELS
from jaxnew.representation.table import RepresentationTable, engineered_table
from jaxnew.storage import config as config_lib
from tests.experiments.handwritten import plain_config, write_evaluation, write_run

OURS = Cell("ours", "hvae")
NO_SUBGOALS = Cell("ours", "hvae", variant="-no-subgoals")
CONDITIONED = Cell("ours", "hvae", conditions_position=True)
FULL = Cell("ours", "hvae", split="full")


def source_of(task: str, folder: Path = Path("runs"), **changes: Any) -> Source:
    domain = Domain.of(load_task(task), None)
    return replace(Source(domain, folder, "smoke", "smoke", 0.0, (1, 2), (), {}), **changes)


def config_of(source: Source, cell: Cell, seed: int = 1) -> dict[str, Any]:
    """The config of a run that `figures --budget=smoke` would have made for a cell."""
    own = source.of(cell)
    plain = config_lib.to_dict(own.budget_of(cell.method))
    return {
        **plain_config(seed=seed, representation=cell.representation),
        **{name: plain[name] for name in ("num_updates", "ppo", "hyperparameters")},
        "task": own.domain.task.reference,
        "method": cell.method,
        "split": own.domain.split_name,
        "split_hash": own.domain.split.hash,
        "conditions_position": cell.conditions_position,
    }


def finished(source: Source, cell: Cell, seed: int = 1) -> Path:
    """A run of a cell as `train_job` names none, whose last report is that of its last update."""
    own = source.of(cell)
    name = f"{cell.label}-{seed}".replace(" ", "").replace(",", "-")
    return write_run(
        own.domain.folder(own.folder) / name, config_of(source, cell, seed), curve=(0.1,)
    )


def group_of(source: Source, cell: Cell) -> Group:
    path = finished(source, cell)
    return Group(cell.label, source.of(cell).domain.task, tuple(read_runs([path])))


# ---- Settings ----


@pytest.mark.unit
def test_a_cell_has_a_task_and_a_split_of_its_own() -> None:
    tables = {"hvae": Path("a"), "hvae@full": Path("b"), "hvae@analysis": Path("c")}
    source = source_of("create-seesaw", given=tables)
    assert source.of(OURS) is source
    assert source.of(NO_SUBGOALS).domain.task.name == "create-seesaw-no-subgoals"
    assert source.of(NO_SUBGOALS).given == tables  # The same tools.
    assert source.of(FULL).domain.split_name == "full"
    assert source.of(FULL).domain.split.hash != source.domain.split.hash
    assert source.of(FULL).given == {"hvae": Path("b")}
    analysed = source.of(Cell("ours", "hvae", variant="-analysis"))
    assert analysed.domain.universe.num_actions == 10_877
    assert analysed.given == {"hvae": Path("c")}
    labels = [cell.label for cell in (OURS, NO_SUBGOALS, FULL, CONDITIONED)]
    assert labels == [
        "ours, hvae",
        "ours, hvae, no subgoals",
        "ours, hvae, split full",
        "ours, hvae, conditioned position",
    ]
    with pytest.raises(UsageError, match="Unknown task 'create-seesaw-upside-down'"):
        source.of(Cell("ours", "hvae", variant="-upside-down"))
    with pytest.raises(ValueError, match="has no split 'half'"):
        source.of(Cell("ours", "hvae", split="half"))


@pytest.mark.unit
def test_runs_are_told_apart_by_all_that_cells_differ_in(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path)
    cells = (OURS, NO_SUBGOALS, CONDITIONED, FULL)
    paths = {cell: finished(source, cell) for cell in cells}
    for cell in cells:
        assert {1: paths[cell]} == {s: r.path for s, r in find(source.of(cell), cell).items()}
    assert paths[NO_SUBGOALS].parent.name == "create-push-no-subgoals"
    assert paths[FULL].parent == paths[OURS].parent


@pytest.mark.unit
def test_figures_show_the_tasks_of_the_paper() -> None:
    shown = {
        number: sorted(t.removeprefix("create-") for t in figure.cells if t.startswith("create-"))
        for number, figure in FIGURES.items()
    }
    main = ["obstacle", "push", "seesaw"]
    further = sorted(level.lower() for level in LEVELS if level.lower() not in main)
    for number in ("4", "6", "7a", "7b", "9a", "9b", "9c", "20", "21", "24"):
        assert shown[number] == main, number
    assert shown["18"] == further
    assert (shown["10"], shown["19"]) == (["push"], ["obstacle", "seesaw"])
    for number in ("5", "8", "15"):
        assert shown[number] == sorted(main + further)
    assert [cell.label for cell in FIGURES["15"].cells["create-push"]] == [
        "ours, hvae",
        "ours, vae",
        "ours, hvae-video",
        "ours, hvae, split full",
    ]
    for figure in FIGURES.values():
        for task, cells in figure.cells.items():
            if figure.kind == "study":
                source = source_of(task).of(cells[0])
                study = source.domain.task.studies[figure.study]
                assert FIGURES[study.figure] is figure


# ---- Commands ----


@pytest.mark.unit
def test_on_the_host_every_seed_is_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    source = source_of("create-push", workers=3, assignments=("ppo.num_epochs=3",), steps=1e6)
    first, second = training_jobs(source, CONDITIONED, [1, 2])
    # 4 environments of 12 steps an update: 1e6 / 48 rounded up.
    folder = "runs/create-push/ours-hvae-conditioned-default-smoke-20834-2"
    assert second.command == (
        "train",
        "--task=create-push",
        "--split=default",
        "--method=ours",
        "--representation=hvae",
        "--representation_budget=smoke",
        "--budget=smoke",
        "--runs=runs",
        "--seed=2",
        f"--workdir={folder}",
        "--workers=3",
        "--set=ppo.num_epochs=3",
        "--set=conditions_position=true",
        "--set=num_updates=20834",
    )
    assert first.command != second.command
    assert first.title == "ours, hvae, conditioned position, seed 1, 1 M steps"
    rate = source.domain.task.measured.training["ours"]
    assert first.seconds == pytest.approx(20834 * 48 / rate)
    assert first.cost == "about 35 minutes"
    assert training_jobs(source, OURS, []) == []
    (job,) = training_jobs(source.of(NO_SUBGOALS), NO_SUBGOALS, [1])
    assert "--task=create-push-no-subgoals" in job.command
    assert "--set=conditions_position=true" not in job.command
    (job,) = training_jobs(source.of(FULL), FULL, [1])
    assert "--split=full" in job.command
    unknown = replace(source.domain, task=replace(source.domain.task, measured=None))
    jobs = training_jobs(replace(source, domain=unknown), CONDITIONED, [1, 2])
    assert jobs[0].cost.endswith("a whole run of budget smoke takes seconds")
    announce(jobs, 0, None)
    text = capsys.readouterr().out
    assert text.count("python -m experiments.train --task=create-push") == 2
    assert "Nobody measured how long it takes. It can be stopped" in text
    announce([replace(first, seconds=60.0), jobs[1]], 100, 60.0)
    assert "In all about 2 minutes, and 1 unmeasured." in capsys.readouterr().out


@pytest.mark.unit
def test_three_tasks_share_an_encoder(tmp_path: Path) -> None:
    push, seesaw = (source_of(task, tmp_path) for task in ("create-push", "create-seesaw"))
    job = embed_job(push, "hvae")
    assert job == embed_job(seesaw, "hvae") == embed_job(push.of(NO_SUBGOALS), "hvae")
    assert "--task=create" in job.command
    assert load_task("create").actions_name == "create"
    full = embed_job(push.of(FULL), "hvae")
    assert "--split=full" in full.command
    analysed = embed_job(push.of(Cell("ours", "hvae-oracle", variant="-analysis")), "hvae-oracle")
    assert "--task=create-analysis" in analysed.command
    folder = tmp_path / "create" / "embed-hvae-default-smoke-31"
    folder.mkdir(parents=True)
    (folder / "table.npz").touch()
    assert embed_job(push, "hvae") is None is embed_job(seesaw, "hvae")
    assert embed_job(push.of(FULL), "hvae") == full


@pytest.mark.unit
def test_what_a_figure_lacks_is_counted(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path, seeds=(1,))
    settings = paper_figures.settings_of(FIGURES["20"], source)
    jobs = paper_figures.unique_jobs(paper_figures.missing_jobs(FIGURES["20"], settings))
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
    task = settings[0][0].domain.task
    assert studies.lacking_values("mix", run, task, 100) == [0.0, 0.4, 0.6, 0.8]
    assert len(studies.lacking_values("mix", run, task, 1001)) == 5
    films = paper_figures.settings_of(FIGURES["8"], source_of("create-push", seeds=(3, 4)))
    assert films[0][0].seeds == (3,)


# ---- The paper's numbers ----


@pytest.mark.golden
@pytest.mark.parametrize(
    ("task", "cell", "train", "test"),
    [
        # Experiments spec 3 to 6 and 9 to 11, in percent.
        ("create-push", OURS, 90.7, 79.7),
        ("create-push", Cell("ours", "vae"), 66.6, 39.3),
        ("create-obstacle", Cell("no-entropy", "hvae"), 34.1, 28.1),
        ("create-push", FULL, 96.8, 17.2),
        ("create-seesaw", Cell("ours", "hvae-video"), 52.1, 43.1),
        ("create-seesaw", Cell("ours", "gt32"), 10.1, 7.9),
        ("create-push", Cell("ours", "gt32"), None, None),
        ("create-push", Cell("ours", "hvae-oracle"), 91.2, 74.5),
        ("create-ladder", Cell("nearest-neighbour", "hvae"), 98.9, 10.3),
        ("create-basket", Cell("ours", "vae"), 68.1, 61.2),
        ("create-obstacle", NO_SUBGOALS, 52.0, 30.1),
        ("create-seesaw", CONDITIONED, 97.0, 68.0),
        ("create-push", Cell("no-entropy", "hvae", variant="-no-subgoals"), None, None),
        ("create-push", Cell("ours", "vae", split="full"), None, None),
        ("create-push", Cell("ours", "hvae", variant="-analysis"), None, None),
        ("create-ladder", CONDITIONED, None, None),
    ],
    ids=lambda value: value.label if isinstance(value, Cell) else None,
)
def test_bars_stand_beside_their_rows(
    tmp_path: Path, task: str, cell: Cell, train: float | None, test: float | None
) -> None:
    group = group_of(source_of(task, tmp_path), cell)
    found = []
    for split in ("train", "test"):
        value = None
        if group.paper_method is not None:
            environment = str(group.paper_environment)
            value = paper_value(environment, group.paper_method, split, group.paper_figure)
        found.append(None if value is None else 100 * value.mean)
    # 0.1: the spec's tables are rounded, some twice.
    assert found == pytest.approx([train, test], abs=0.1)


@pytest.mark.unit
def test_every_bar_of_the_paper_is_found(tmp_path: Path) -> None:
    lacking = []
    for number, figure in FIGURES.items():
        for task, cells in figure.cells.items():
            if figure.kind == "bars" and task.startswith("create-"):
                for place, cell in enumerate(cells):
                    group = group_of(source_of(task, tmp_path / number / str(place)), cell)
                    arguments = str(group.paper_environment), str(group.paper_method), "test"
                    if paper_value(*arguments, group.paper_figure) is None:
                        lacking.append((number, task, cell.representation))
    assert lacking == [("7b", "create-push", "gt32"), ("7b", "create-obstacle", "gt32")]


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
    values = SimpleNamespace(episodes=1000, pdf=False)
    figure = FIGURES[number]
    picture, text, table = paper_figures.draw(number, figure, settings, tmp_path, values)
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
def test_the_whole_test_set_has_the_no_op(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path)
    path = finished(source, OURS)
    write_evaluation(path, "test", 0.6, set_size=5)
    write_evaluation(path, "test", 0.7, set_size=507)
    group = Group("ours", source.domain.task, tuple(read_runs([path])))
    lines = [(r.label, r.mean) for r in finetuning._references(source, group, 1000)]
    # Experiments spec 8.
    assert lines == [
        ("ours, zero-shot, sets as in training (5)", 0.6),
        ("paper, zero-shot, sets as in training", pytest.approx(0.797, abs=1e-3)),
        ("ours, zero-shot, all at once (507)", 0.7),
        ("paper, zero-shot, all at once", pytest.approx(0.775, abs=1e-3)),
    ]


# ---- Studies ----


@pytest.mark.golden
@pytest.mark.parametrize(
    ("study", "means"),
    [
        # Experiments spec 7, CREATE Obstacle.
        ("angle", [83.9, 83.4, 82.4, 74.5, 36.7]),
        ("embedding", [75.3, 74.1, 72.8, 71.8, 68.7, 61.5, 54.6, 44.6, 36.7, 26.7]),
        ("mix", [93.6, 90.2, 85.6, 77.3, 71.8]),
    ],
)
def test_points_of_figure_9(tmp_path: Path, study: str, means: list[float]) -> None:
    source = source_of("create-obstacle", tmp_path)
    analysed = Cell("ours", "hvae-oracle", variant="-analysis")
    group = group_of(source, analysed)
    kind = studies._kind_of(study, group.task)
    points = {value: studies.paper_point(kind, group, value) for value in kind.values(group.task)}
    assert [100 * points[value].mean for value in sorted(points)] == pytest.approx(means, abs=0.06)
    assert {point.num_seeds for point in points.values()} == {5}
    assert studies.paper_point(kind, group, 0.123) is None
    for cell in (
        Cell("no-entropy", "hvae-oracle", variant="-analysis"),
        replace(analysed, conditions_position=True),
        replace(analysed, variant="-no-subgoals-analysis"),
    ):
        other = group_of(source, cell)
        value = kind.values(other.task)[0]
        kind_of_other = studies._kind_of(study, other.task)
        assert studies.paper_point(kind_of_other, other, value) is None, cell


@pytest.mark.golden
def test_points_of_the_set_sizes(tmp_path: Path) -> None:
    kind = studies.STUDIES["set-size"]
    source = source_of("create-push", tmp_path)
    # Experiments spec 17: 10 and 60 actions.
    for method, first, last in (("ours", 45.3, 81.8), ("no-subsampling", 23.1, 41.0)):
        group = group_of(source, Cell(method, "hvae"))
        means = [100 * studies.paper_point(kind, group, size).mean for size in (10, 60)]
        assert means == pytest.approx([first, last], abs=0.06)
    assert studies.paper_point(kind, group, 12) is None
    assert studies.paper_point(kind, group_of(source, FULL), 10) is None


@pytest.mark.unit
def test_a_study_shows_the_papers_points_beside_their_setting() -> None:
    value = studies.PaperValue(0.4, 0.05, 5)
    points = (
        StudyPoint("a", 2.0, np.array([0.125, 0.375]), 100, value),
        StudyPoint("a", 1.0, np.array([0.5, 0.5]), 100),
        StudyPoint("b", 2.0, np.array([0.6, 0.6]), 100),
        StudyPoint("b", 1.0, np.array([0.7, 0.7]), 100),
    )
    metric = drawing.plots.Metric.of("is_success")
    study = Study("angle", "angle", False, metric, points, "Note.", "9a", "CREATE Push")
    lines = as_markdown(study).splitlines()
    assert lines[0] == "# Figure 9a, CREATE Push: angle: success rate (%)"
    assert lines[2] == "| angle | a | paper | b |"
    assert lines[4:6] == [
        "| 2 | 25.0 ± 12.5 | 40.0 ± 5.0 | 60.0 ± 0.0 |",
        "| 1 | 50.0 ± 0.0 | - | 70.0 ± 0.0 |",
    ]
    assert as_csv(study).splitlines()[1].endswith(",0.25,0.125,2,100,0.4,0.05,5")
    figure = study_figure(study)
    drawn = [container[0].get_xydata().tolist() for container in figure.axes[0].containers]
    assert drawn == [
        [[1.0, 50.0], [2.0, 25.0]],
        [[2.0, 40.0]],
        [[1.0, 70.0], [2.0, 60.0]],
    ]
    assert figure.get_suptitle() == "Figure 9a, CREATE Push: angle"


# ---- Representations ----


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
def test_the_legend_is_not_wider_than_the_picture() -> None:
    domain = Domain.of(load_task("create-push"), None)
    names = domain.universe.class_names
    labels = np.unique(domain.universe.class_labels[domain.split.test])
    points = np.column_stack([labels, labels]).astype(float)
    figure = drawing.plots.tsne_scatter([drawing.Scatter(points, labels)] * 2, names)
    figure.canvas.draw()
    (legend,) = figure.legends
    extent = legend.get_window_extent()
    assert 0.5 * figure.bbox.width < extent.width < figure.bbox.width
    assert drawing.plots.amount(96.0) == "96 steps"


@pytest.mark.unit
def test_a_given_table_is_one_of_the_cells_split(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path, given={"hvae": tmp_path / "t.npz"})
    assert embed_job(source, "hvae") is None
    assert embed_job(source.of(FULL), "hvae") is not None
    assert source.of(FULL).representation_flag("hvae") == "hvae"
