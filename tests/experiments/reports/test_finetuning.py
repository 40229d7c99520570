"""The curves of fine-tuning and the zero-shot lines beside them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from experiments.reports import finetuning
from experiments.reports.finetuning import Tuning, make_finetuned, zero_shot
from experiments.reports.jobs import Job
from experiments.reports.paper import paper_value
from experiments.reports.production import Cell
from jaxnew.storage.metrics import MetricsLog
from tests.experiments.handwritten import (
    config_of,
    finished,
    group_of,
    groups_at,
    source_of,
    write_evaluation,
    write_run,
)

OURS = Cell("ours", "hvae")


@pytest.mark.unit
def test_fine_tuning_is_drawn_from_its_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = source_of("grid_world", tmp_path, seeds=(1,))
    tuning, made = Tuning(source, 512.0), []
    monkeypatch.setattr(Job, "run", lambda job: made.append(job.command))
    paths = []
    for method in ("ours", "nearest-neighbour"):
        paths.append(finished(source, Cell(method, "gt12")))
        assert tuning.size(method) == (2, 256)  # 512 steps of 256 an update.
        for kind, success in (("warm", 0.5), ("scratch", 0.25)):
            folder = tuning.job(paths[-1], method, 1, kind).folder
            config = config_of(source, Cell(method, "gt12"))
            config |= {"trained_on": "test", "num_updates": 2}
            write_run(folder, config, curve=(0.1,))
            with MetricsLog(folder) as log:
                log.write(2, {"episode/is_success": success})
    write_evaluation(paths[0], "test", 0.7, set_size=50, num_actions=256)
    write_evaluation(paths[0], "test", 0.8, set_size=256, num_actions=256)
    groups = [groups_at(path)[0] for path in paths]
    curves = make_finetuned(tuning, groups)
    assert made == []
    assert {label: runs[0].values.tolist() for label, runs in curves.items()} == {
        "ours, fine-tuned": [0.5],
        "ours, from scratch": [0.25],
        "discrete, fine-tuned": [0.5],
        "discrete, from scratch": [0.25],
    }
    whole = paper_value("Grid World", "ours_zero_shot_whole_test_set", "test")
    assert list(zero_shot(source, groups[0], 1000).items()) == [
        ("jaxnew, zero-shot, sets as in training (50)", 0.7),
        ("paper, zero-shot, sets as in training", paper_value("Grid World", "ours", "test").mean),
        ("jaxnew, zero-shot, all at once (256)", 0.8),
        ("paper, zero-shot, all at once", whole.mean),
    ]
    figure = finetuning.finetune_figure(tuning, groups, 1000, "title")
    heights = [float(line.get_ydata()[0]) for line in figure.axes[0].lines]
    assert heights[:4] == [50.0, 25.0, 50.0, 25.0]
    assert heights[4] == 70.0
    # What is not there is made: from the run it goes on with, and beside it from scratch.
    with pytest.raises(Exception, match="finetune-warm-3"):
        make_finetuned(Tuning(source, 768.0), groups)
    assert made[0][:2] == ("finetune", f"--run={paths[0]}")


@pytest.mark.unit
def test_the_whole_test_set_has_the_no_op(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path)
    group = group_of(source, OURS)
    path = group.runs[0].path
    write_evaluation(path, "test", 0.6, set_size=5)
    write_evaluation(path, "test", 0.7, set_size=507)
    assert list(zero_shot(source, group, 1000).items()) == [
        ("jaxnew, zero-shot, sets as in training (5)", 0.6),
        ("paper, zero-shot, sets as in training", pytest.approx(0.797, abs=1e-3)),
        ("jaxnew, zero-shot, all at once (507)", 0.7),
        ("paper, zero-shot, all at once", pytest.approx(0.775, abs=1e-3)),
    ]


@pytest.mark.unit
def test_zero_shot_lines_of_fine_tuning(tmp_path: Path) -> None:
    source = source_of("shape_stacking", tmp_path)
    group = group_of(source, OURS)
    path = group.runs[0].path
    write_evaluation(path, "test", 1.5, "final_height", set_size=5)
    write_evaluation(path, "test", 1.75, "final_height", set_size=203)
    assert list(zero_shot(source, group, 1000).items()) == [
        ("jaxnew, zero-shot, sets as in training (5)", 1.5),
        ("paper, zero-shot, sets as in training", pytest.approx(1.716, abs=1e-3)),
        ("jaxnew, zero-shot, all at once (203)", 1.75),
        ("paper, zero-shot, all at once", pytest.approx(2.054, abs=1e-3)),
    ]


@pytest.mark.unit
def test_the_command_keeps_what_the_pretrained_run_was_made_with(tmp_path: Path) -> None:
    kept = ("pool.max_restarts=3", "num_updates=7")
    source = source_of("create-push", tmp_path, assignments=kept, workers=2)
    tuning = Tuning(source, 0)
    share = source.domain.task.baselines.finetune_share
    updates = math.ceil(7 * share)
    assert tuning.size("ours")[0] == updates
    command = tuning.job(tmp_path, "ours", 1, "scratch").command
    assert [word for word in command if word.startswith("--set")] == [
        "--set=pool.max_restarts=3",
        "--set=num_updates=7",
        f"--set=num_updates={updates}",
    ]
    assert command[-2:] == ("--scratch", "--workers=2")
