"""The search grids of the paper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from experiments.reports.production import Cell
from experiments.reports.runs import read_runs
from experiments.reports.searches import GRIDS, chosen, search_jobs
from jaxnew.task.places import UsageError
from tests.experiments.handwritten import config_of, source_of, write_run

TOY = Cell("ours", "gt4")
PLACE = "tests.toy_task:TASK"


@pytest.mark.unit
def test_a_minibatch_that_is_no_whole_number_of_steps_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="Minibatches of 3 are no whole number of steps"):
        search_jobs("batch-size", source_of("grid_world", tmp_path), Cell("ours", "gt12"), [3.0])


@pytest.mark.unit
def test_a_search_on_the_host_is_a_run_for_each_value_and_seed(tmp_path: Path) -> None:
    source = source_of(PLACE, tmp_path)
    jobs = search_jobs("entropy", source, TOY, (0.01, 0.1))
    folder = tmp_path / "toy" / "search-entropy-ours-gt4-smoke-4"
    names = [job.folder.relative_to(folder).name for job in jobs]
    assert names == ["0.01-1", "0.01-2", "0.1-1", "0.1-2"]
    for job, value in zip(jobs, ("0.01", "0.01", "0.1", "0.1"), strict=True):
        assert f"--set=hyperparameters.entropy_coefficient={value}" in job.command
        assert job.command[0] == "train"
        assert f"--workdir={job.folder}" in job.command
        assert job.title.startswith(f"entropy coefficient {value}: ours, gt4, seed")
        assert not job.is_done
    # Minibatches of 32: 2 of them in a rollout of 4 environments are 16 steps, twice as many.
    sizes = search_jobs("batch-size", source, TOY, (32,))
    assert [job.command[-2:] for job in sizes] == [
        ("--set=ppo.rollout.num_steps=16", "--set=num_updates=2")
    ] * 2
    runs = []
    for job, best in zip(jobs, (0.2, 0.4, 0.1, 0.2), strict=True):
        value, seed = job.folder.name.split("-")
        own = GRIDS["entropy"].source(source, TOY, float(value))
        config = config_of(own, TOY, int(seed))
        write_run(job.folder, config, curve=(2 * best, best))
        assert job.is_done
        runs += read_runs([job.folder])
    study = chosen("entropy", GRIDS["entropy"], runs)
    assert [(p.x, p.means.tolist()) for p in study.points] == [
        (0.01, [0.2, 0.4]),
        (0.1, [0.1, 0.2]),
    ]
    assert "mean over 2 seeds. Chosen by it: entropy coefficient 0.01." in study.note
    unfinished = write_run(tmp_path / "unfinished", config, curve=(0.1,))
    assert not replace(jobs[0], folder=unfinished).is_done
