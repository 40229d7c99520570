"""The paper's search grids: every value is trained with several seeds, the best one is named."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.reports.jobs import Job, announce, sweep_job, train_job
from experiments.reports.production import Cell, Source
from experiments.reports.runs import RunRecord, group_runs, read_runs
from experiments.reports.study_report import Study, StudyPoint
from jaxnew.ppo import PPOConfig
from jaxnew.task.methods import file_name
from jaxnew.task.places import UsageError


@dataclass(frozen=True)
class Grid:
    """A search of the paper (appendix D, "Hyperparameter Search").

    Attributes:
      axis: what its values are.
      values: the paper's.
      assignment: `(PPOConfig of the preset, value) ->` what `--set` sets.
      value_of: what a run's plain config has on the axis.
      traced: the hyper-parameter whose values one program can hold; None if they are shapes.
    """

    axis: str
    values: tuple[float, ...]
    assignment: Callable[[PPOConfig, float], str]
    value_of: Callable[[Mapping[str, Any]], float]
    traced: str | None = None

    def source(self, source: Source, cell: Cell, value: float) -> Source:
        """Where the runs of a value come from; they take as many steps as all others.

        Raises:
          UsageError: no run can have such a value.
        """
        assignment = self.assignment(source.config_of(cell).ppo, value)
        steps, assignments = float(source.steps_of(cell)), (*source.assignments, assignment)
        return replace(source, steps=source.steps or steps, assignments=assignments)


def _batch_size(ppo: PPOConfig, value: float) -> str:
    """Longer rollouts make larger minibatches."""
    num_steps, rest = divmod(int(value) * ppo.num_minibatches, ppo.rollout.num_envs)
    if rest or not num_steps:
        raise UsageError(
            f"Minibatches of {value:g} are no whole number of steps: a rollout of "
            f"{ppo.rollout.num_envs} environments is cut into {ppo.num_minibatches}."
        )
    return f"ppo.rollout.num_steps={num_steps}"


def _batch_size_of(config: Mapping[str, Any]) -> float:
    rollout = config["ppo"]["rollout"]
    return float(rollout["num_envs"] * rollout["num_steps"] / config["ppo"]["num_minibatches"])


GRIDS = {
    "entropy": Grid(
        "entropy coefficient",
        (0.0001, 0.001, 0.005, 0.01, 0.05, 0.1),
        lambda ppo, value: f"hyperparameters.entropy_coefficient={value:g}",
        lambda config: float(config["hyperparameters"]["entropy_coefficient"]),
        traced="entropy_coefficient",
    ),
    "batch-size": Grid(
        "transitions per minibatch", (1024, 2048, 3072, 4096), _batch_size, _batch_size_of
    ),
}


def search_jobs(name: str, source: Source, cell: Cell, values: Sequence[float]) -> list[Job]:
    """The commands of a search.

    On the host every value and seed is a run of its own. Inside jit a value is a program, and all
    of them are one where they are traced.
    """
    grid, seeds, is_host = GRIDS[name], source.seeds, source.domain.task.host is not None
    words = ["search", name, file_name(cell.method), Path(cell.representation).stem, source.budget]
    updates = str(source.config_of(cell).num_updates)
    folder = source.domain.folder(source.folder) / "-".join([*words, updates])
    all_seeds = "-".join(map(str, seeds))
    if grid.traced and not is_host:
        vary = [f"{grid.traced}={','.join(f'{value:g}' for value in values)}"]
        return [sweep_job(source, cell, seeds, folder / f"all-{all_seeds}", vary)]
    jobs = []
    for value in values:
        own, place = grid.source(source, cell, value), f"{value:g}"
        if is_host:
            found = [train_job(own, cell, seed, folder / f"{place}-{seed}") for seed in seeds]
        else:
            found = [sweep_job(own, cell, seeds, folder / f"{place}-{all_seeds}")]
        jobs += [replace(job, title=f"{grid.axis} {place}: {job.title}") for job in found]
    return jobs


def search(
    name: str, source: Source, cell: Cell, values: Sequence[float] = (), is_dry: bool = False
) -> Study | None:
    """Trains every value of a grid with every seed; the best by validation is named.

    Args:
      name: of the grid.
      source, cell: what is trained, but for the grid's value.
      values: of the grid; none for the paper's.
      is_dry: only says what is missing and how long it takes.

    Returns:
      The best evaluations on validation sets; None if `is_dry`.

    Raises:
      UsageError: a value cannot be trained, or a command was stopped.
    """
    grid = GRIDS[name]
    jobs = search_jobs(name, source, cell, tuple(values or grid.values))
    missing = [job for job in jobs if not job.is_done]
    announce(missing)
    if is_dry:
        return None
    for job in missing:
        job.run()
        if not job.is_done:
            raise UsageError(f"{job.folder} is not finished; call the same command again to go on.")
    return chosen(name, grid, read_runs([job.folder for job in jobs]))


def chosen(name: str, grid: Grid, runs: Sequence[RunRecord]) -> Study:
    """The runs of a search as a study of their best evaluations on validation sets."""
    groups = sorted(group_runs(runs), key=lambda group: grid.value_of(group.config))
    points = []
    for group in groups:
        curves = [run.curve(f"validation/{group.task.selection_metric}")[1] for run in group.runs]
        best_of_each = np.array([curve.max() for curve in curves])
        method = group.label.split(",")[0]
        points.append(StudyPoint(method, grid.value_of(group.config), best_of_each, 0))
    best = max(points, key=lambda point: float(point.means.mean()))
    note = (
        f"Best evaluation on validation sets during training, mean over {len(best.means)} seeds. "
        f"Chosen by it: {grid.axis} {best.x:g}."
    )
    return Study(name, grid.axis, name == "entropy", groups[0].metric, tuple(points), note)
