"""The paper's search grids: every value is trained with several seeds, the best one is named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import Domain
from experiments.pipeline.methods import file_name
from experiments.reports.jobs import Job, announce, sweep_job, train_job
from experiments.reports.production import Cell, Source
from experiments.reports.runs import Group, Run, group_runs, read_runs
from experiments.reports.study_report import Study, StudyPoint
from jaxnew.storage.run_directory import RunDirectoryError


@dataclass(frozen=True)
class Grid:
    """A search of the paper (appendix D, "Hyperparameter Search").

    Attributes:
      axis: what its values are.
      values: the paper's.
      sources: `(source, method, values) ->` for each value, what its runs are made from.
      value_of: what a run's plain config has on the axis.
      traced: the hyper-parameter whose values one program can hold; None if they are shapes.
    """

    axis: str
    values: tuple[float, ...]
    sources: Callable[[Source, str, Sequence[float]], list[Source]]
    value_of: Callable[[dict[str, Any]], float]
    traced: str | None = None


def entropy_sources(source: Source, method: str, values: Sequence[float]) -> list[Source]:
    """Sources that differ in the entropy coefficient."""
    del method
    return [
        _with(source, f"hyperparameters.entropy_coefficient={value:g}", source.steps)
        for value in values
    ]


def batch_size_sources(source: Source, method: str, values: Sequence[float]) -> list[Source]:
    """Sources with other minibatches: longer rollouts make larger ones, steps stay the same.

    Raises:
      UsageError: a minibatch is no whole number of steps of the environments.
    """
    preset = source.budget_of(method)
    steps = source.steps or float(preset.num_updates * preset.ppo.steps_per_update)
    num_envs, num_minibatches = preset.ppo.rollout.num_envs, preset.ppo.num_minibatches
    found = []
    for value in values:
        num_steps, rest = divmod(int(value) * num_minibatches, num_envs)
        if rest or not num_steps:
            raise flag.UsageError(
                f"Minibatches of {value:g} are no whole number of steps: a rollout of {num_envs} "
                f"environments is cut into {num_minibatches}."
            )
        found.append(_with(source, f"ppo.rollout.num_steps={num_steps}", steps))
    return found


def _with(source: Source, assignment: str, steps: float) -> Source:
    return replace(source, steps=steps, assignments=(*source.assignments, assignment))


def _entropy_of(config: dict[str, Any]) -> float:
    return float(config["hyperparameters"]["entropy_coefficient"])


def _batch_size_of(config: dict[str, Any]) -> float:
    rollout = config["ppo"]["rollout"]
    return float(rollout["num_envs"] * rollout["num_steps"] / config["ppo"]["num_minibatches"])


GRIDS = {
    "entropy": Grid(
        "entropy coefficient",
        (0.0001, 0.001, 0.005, 0.01, 0.05, 0.1),
        entropy_sources,
        _entropy_of,
        traced="entropy_coefficient",
    ),
    "batch-size": Grid(
        "transitions per minibatch",
        (1024, 2048, 3072, 4096),
        batch_size_sources,
        _batch_size_of,
    ),
}


@dataclass(frozen=True)
class Part:
    """A command of a search, and the folder of the run or of the sweep that it makes."""

    job: Job
    folder: Path

    @property
    def is_finished(self) -> bool:
        """Whether all its runs are done."""
        try:
            runs = read_runs([self.folder])
        except (flag.UsageError, RunDirectoryError):  # Not begun, or a sweep that is not over.
            return False
        return all(run.is_finished for run in runs)


def search_parts(name: str, source: Source, cell: Cell, values: Sequence[float]) -> list[Part]:
    """The commands of a search.

    On the host every value and seed is a run of its own. Inside jit a value is a program, and all
    of them are one where they are traced.
    """
    grid = GRIDS[name]
    budget = source.budget_of(cell.method)
    seeds = "-".join(map(str, source.seeds))
    words = ["search", name, file_name(cell.method), Path(cell.representation).stem, source.budget]
    folder = source.domain.folder(source.folder) / "-".join([*words, str(budget.num_updates)])
    by_value = dict(zip(values, grid.sources(source, cell.method, values), strict=True))
    if source.domain.task.host is not None:
        return [
            Part(_named(train_job(own, cell, seed, place), grid, value), place)
            for value, own in by_value.items()
            for seed in source.seeds
            for place in [folder / f"{value:g}-{seed}"]
        ]
    if grid.traced:
        place = folder / f"all-{seeds}"
        vary = [f"{grid.traced}={','.join(f'{value:g}' for value in values)}"]
        return [Part(sweep_job(source, cell, source.seeds, place, vary), place)]
    return [
        Part(_named(sweep_job(own, cell, source.seeds, place), grid, value), place)
        for value, own in by_value.items()
        for place in [folder / f"{value:g}-{seeds}"]
    ]


def _named(job: Job, grid: Grid, value: float) -> Job:
    return replace(job, title=f"{grid.axis} {value:g}: {job.title}")


def search(
    name: str,
    seeds: Sequence[int],
    steps: float,
    values: Sequence[float],
    stage_one: str | None = None,
    is_dry: bool = False,
) -> Study | None:
    """Trains every value of a grid with every seed; the best by validation is named.

    Args:
      name: of the grid.
      seeds: of the runs.
      steps: environment steps of every run; 0 for those of the preset.
      values: of the grid; none for the paper's.
      stage_one: budget of a representation that is to be trained; None for that of the runs.
      is_dry: only says what is missing and how long it takes.

    Returns:
      The best evaluations on validation sets; None if `is_dry`.

    Raises:
      UsageError: a value cannot be trained, or a command was stopped.
    """
    grid = GRIDS[name]
    source = Source(
        domain=Domain.of(flag.load_task(flag.TASK.value), flag.SPLIT.value),
        folder=Path(flag.RUNS.value),
        budget=flag.BUDGET.value,
        stage_one=stage_one or flag.BUDGET.value,
        steps=steps,
        seeds=tuple(seeds),
        assignments=tuple(flag.SET.value),
        given={},
        workers=flag.WORKERS.value,
    )
    cell = Cell(flag.METHOD.value, flag.REPRESENTATION.value)
    parts = search_parts(name, source, cell, tuple(values or grid.values))
    missing = [part for part in parts if not part.is_finished]
    announce([part.job for part in missing], 0, None)
    if is_dry:
        return None
    for part in missing:
        part.job.run()
        if not part.is_finished:
            raise flag.UsageError(
                f"{part.folder} is not finished; call the same command again to go on."
            )
    return chosen(name, grid, read_runs([part.folder for part in parts]))


def chosen(name: str, grid: Grid, runs: Sequence[Run]) -> Study:
    """The runs of a search as a study of their best evaluations on validation sets."""
    groups = sorted(group_runs(runs), key=lambda group: grid.value_of(group.config))
    points = [
        StudyPoint(
            group.label.split(",")[0], grid.value_of(group.config), best_validations(group), 0
        )
        for group in groups
    ]
    best = max(points, key=lambda point: float(point.means.mean()))
    note = (
        f"Best evaluation on validation sets during training, mean over {len(best.means)} seeds. "
        f"Chosen by it: {grid.axis} {best.x:g}."
    )
    return Study(name, grid.axis, name == "entropy", groups[0].metric, tuple(points), note)


def best_validations(group: Group) -> np.ndarray:
    """f64[n] the best value on validation sets of each run."""
    name = f"validation/{group.task.selection_metric}"
    return np.array([run.curve(name)[1].max() for run in group.runs])
