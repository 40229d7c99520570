"""What is missing becomes commands, with the time that they take."""

from __future__ import annotations

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.reports import jobs
from experiments.reports.jobs import (
    Job,
    announce,
    duration,
    embed_job,
    sweep_job,
    train_job,
    training_jobs,
)
from experiments.reports.production import Cell, Source
from experiments.tasks.grid_world import TASK
from jaxnew.loop import InterruptedRunError
from jaxnew.task.domain import load_task
from jaxnew.task.places import UsageError
from tests.experiments.handwritten import source_of

OURS = Cell("ours", "hvae")
NO_SUBGOALS = Cell("ours", "hvae", variant="-no-subgoals")
CONDITIONED = Cell("ours", "hvae", conditions_position=True)
FULL = Cell("ours", "hvae", split="full")
GT12 = Cell("ours", "gt12")


def unmeasured(source: Source) -> Source:
    """Of a task whose speed nobody measured."""
    task = source.domain.task
    task = replace(task, shown=replace(task.shown, measured=None))
    return replace(source, domain=replace(source.domain, task=task))


@pytest.mark.unit
def test_what_is_missing_becomes_a_command_with_its_duration(tmp_path: Path) -> None:
    source = source_of(
        "grid_world", tmp_path, budget="paper", steps=4e6, assignments=("loop.chunk_updates=7",)
    )
    assert source.config_of(GT12).num_updates == 245  # 4e6 / 16,384, rounded up.
    assert (
        source.config_of(Cell("continuous", "gt12")).num_updates == 489
    )  # Half as many steps each.
    job = sweep_job(source, GT12, [1, 2, 3])
    assert "--seeds=1,2,3" in job.command
    assert job.command[-2:] == ("--set=loop.chunk_updates=7", "--set=num_updates=245")
    # 3 runs cannot be shared out evenly to 2 cores, so that one takes all; on 3 each has one.
    rate = TASK.shown.measured.training["ours"]
    seconds = {1: 3, 2: 3, 3: 1}.get(len(os.sched_getaffinity(0)))
    if seconds is not None:
        assert job.seconds == pytest.approx(seconds * 245 * 16_384 / rate)
    assert duration(50.0) == "about 50 s"
    assert duration(600.0) == "about 10 minutes"
    assert duration(7200.0) == "about 2.0 hours"
    assert "nobody measured" in sweep_job(unmeasured(source), GT12, [1]).cost


@pytest.mark.unit
def test_a_command_that_fails_ends_the_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(UsageError, match="ended with status 1: python -m"):
        Job("it", ("sweep", "--x"), "seconds", None, Path()).run()


@pytest.mark.unit
@pytest.mark.parametrize(
    ("code", "number"),
    [
        ("import sys; sys.exit(143)", signal.SIGTERM),
        ("import os; os.kill(os.getpid(), 15)", signal.SIGTERM),
        ("import sys; sys.exit(130)", signal.SIGINT),
        # To the list; a command that is through all the same is the last one.
        ("import os, signal, time; os.kill(os.getppid(), signal.SIGINT); time.sleep(0.2)", 2),
        ("import os, time; os.kill(os.getppid(), 15); time.sleep(60)", signal.SIGTERM),
    ],
)
def test_a_signal_ends_the_plan(monkeypatch: pytest.MonkeyPatch, code: str, number: int) -> None:
    monkeypatch.setattr(jobs, "child", lambda *command: ([sys.executable, "-c", code], None))
    with pytest.raises(InterruptedRunError, match="same command again to go on") as caught:
        Job("it", ("sweep", "--x"), "seconds", None, Path()).run()
    assert caught.value.number == number


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
    rate = source.domain.task.shown.measured.training["ours"]
    assert first.seconds == pytest.approx(20834 * 48 / rate)
    assert first.cost == "about 35 minutes"
    assert training_jobs(source, OURS, []) == []
    (job,) = training_jobs(source.of(NO_SUBGOALS), NO_SUBGOALS, [1])
    assert "--task=create-push-no-subgoals" in job.command
    assert "--set=conditions_position=true" not in job.command
    (job,) = training_jobs(source.of(FULL), FULL, [1])
    assert "--split=full" in job.command
    jobs = training_jobs(unmeasured(source), CONDITIONED, [1, 2])
    assert jobs[0].cost.endswith("a whole run of budget smoke takes seconds")
    announce(jobs)
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
def test_a_given_table_is_one_of_the_cells_split(tmp_path: Path) -> None:
    source = source_of("create-push", tmp_path, given={"hvae": tmp_path / "t.npz"})
    assert embed_job(source, "hvae") is None
    assert embed_job(source.of(FULL), "hvae") is not None
    assert "--representation=hvae" in train_job(source.of(FULL), FULL, 1).command
    assert f"--representation={tmp_path / 't.npz'}" in train_job(source, OURS, 1).command
