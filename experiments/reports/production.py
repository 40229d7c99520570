"""The runs that figures need: what tells them apart, and where they are found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from experiments.pipeline.artifacts import REPRESENTATION_SEED, TABLE_FILE, Domain
from experiments.pipeline.flags import UsageError, budget_of, load_task
from experiments.pipeline.machinery import environment_settings, in_group, pool_assignments
from experiments.pipeline.methods import adapted
from experiments.reports.runs import Run, read_runs
from jaxnew.representation.table import RepresentationTable
from jaxnew.storage import config as config_lib
from jaxnew.storage.run_directory import RunDirectoryError
from jaxnew.task import StageTwoBudget

_EQUAL = ("num_updates", "hyperparameters", "ppo")  # Fields that make runs the same setting.


@dataclass(frozen=True)
class Cell:
    """One setting of a figure.

    Attributes:
      method, representation: `--method` and `--representation`.
      variant: what the name of its task has after that of the figure's, such as `-no-subgoals`.
      split: `--split`; empty for that of the figure.
      conditions_position: see `TrainConfig`.
    """

    method: str
    representation: str
    variant: str = ""
    split: str = ""
    conditions_position: bool = False

    @property
    def label(self) -> str:
        """What tells it from the other settings of a figure."""
        words = [
            self.method,
            self.representation,
            self.variant.removeprefix("-").replace("-", " "),
            self.split and f"split {self.split}",
            "conditioned position" if self.conditions_position else "",
        ]
        return ", ".join(word for word in words if word)


@dataclass(frozen=True)
class Source:
    """Where runs come from, and what is asked of them.

    Attributes:
      domain: with the split of all runs.
      folder: that of all tasks' runs.
      budget: preset of both stages, unless `stage_one` names another for the first.
      stage_one: preset of representations.
      steps: environment steps of every run; 0 for those of the preset.
      seeds: of the policies.
      assignments: of `--set`.
      given: tables and runs of `embed` to take for a representation; where a cell has other actions
        or another split than `domain`, those under `REPRESENTATION@VARIANT` or
        `REPRESENTATION@SPLIT`.
      workers: processes for environments on the host; 0: one per core.
    """

    domain: Domain
    folder: Path
    budget: str
    stage_one: str
    steps: float
    seeds: tuple[int, ...]
    assignments: tuple[str, ...]
    given: Mapping[str, Path]
    workers: int = 0

    def of(self, cell: Cell) -> Source:
        """Where the runs of a cell come from: those of its own task and split.

        Raises:
          UsageError: there is no such variant of the task.
          ValueError: it has no such split.
        """
        task, split = self.domain.task, cell.split or self.domain.split_name
        if cell.variant:
            task = load_task(task.reference + cell.variant)
        if task is self.domain.task and split == self.domain.split_name:
            return self
        given = self.given
        words = [cell.variant.strip("-")] * (task.actions_name != self.domain.task.actions_name)
        words += [split] * (split != self.domain.split_name)
        if words:
            end = f"@{'-'.join(words)}"
            given = {k.removesuffix(end): path for k, path in given.items() if k.endswith(end)}
        return replace(self, domain=Domain.of(task, split), given=given)

    def budget_of(self, method: str) -> StageTwoBudget:
        """What a run of the method spends."""
        task = self.domain.task
        budget = budget_of(task.stage_two, self.budget, "Stage two")
        budget = adapted(budget, method, task, self.domain.split)
        budget = config_lib.set_paths(budget, self.budget_assignments)
        if self.steps:
            updates = math.ceil(self.steps / budget.ppo.steps_per_update)
            budget = replace(budget, num_updates=updates)
        return budget

    @property
    def budget_assignments(self) -> list[str]:
        """Those that are not about environments or pools."""
        _, others = in_group(self.assignments, "environment")
        return pool_assignments(others)[1]

    def table_of(self, representation: str) -> RepresentationTable | None:
        """The table that was given for a representation; None if none was."""
        path = self.given.get(representation)
        if path is None:
            return None
        return RepresentationTable.load(path / TABLE_FILE if path.is_dir() else path)

    def representation_flag(self, representation: str) -> str:
        """What `--representation` must be."""
        return str(self.given.get(representation, representation))

    def embed_folder(self, representation: str) -> Path:
        """Where `embed` keeps a representation."""
        name = f"embed-{representation}-{self.domain.split_name}-{self.stage_one}"
        return self.domain.actions_folder(self.folder) / f"{name}-{REPRESENTATION_SEED}"


def find(source: Source, cell: Cell) -> dict[int, Run]:
    """The finished runs of a cell, by seed.

    Raises:
      UsageError: two runs of one seed fit, so that it is not clear which one is meant.
    """
    wanted = _plain(source.budget_of(cell.method))
    environment = environment_settings(source.assignments)
    table = source.table_of(cell.representation)
    found: dict[int, Run] = {}
    for run in policies(source.domain.folder(source.folder)):
        config = run.config
        is_wanted = (
            config["method"] == cell.method
            and config["trained_on"] == "train"
            and not config.get("num_clusters", 0)
            and bool(config.get("conditions_position", False)) == cell.conditions_position
            and config["split_hash"] == source.domain.split.hash
            and run.representation == cell.representation
            and _plain(config) == wanted
            and tuple(config.get("environment", ())) == environment
            and config["seed"] in source.seeds
            and (table is None or config["table_hash"] == table.hash)
            and run.is_finished
        )
        if not is_wanted:
            continue
        seed = int(config["seed"])
        if seed in found:
            raise UsageError(
                f"{found[seed].path} and {run.path} are both {cell.method} on "
                f"{cell.representation} with seed {seed}; move one of them away, or name the table "
                f"that you mean with --given={cell.representation}=TABLE."
            )
        found[seed] = run
    return found


def policies(folder: Path) -> list[Run]:
    """Every readable policy run below a folder; members of sweeps are runs."""
    runs = []
    for file in sorted(folder.rglob("config.json")):
        if "members.partial" in file.parts:  # Of a sweep that is being written.
            continue
        with suppress(UsageError, RunDirectoryError):
            runs += [run for run in read_runs([file.parent]) if run.path == file.parent.resolve()]
    return [run for run in runs if run.is_policy and run.table is not None]


def _plain(config: Any) -> dict[str, Any]:
    """The fields by which runs are the same setting; how a gradient is cut up is none of them."""
    plain = config if isinstance(config, dict) else config_lib.to_dict(config)
    fields = {name: plain[name] for name in _EQUAL}
    return {**fields, "ppo": {**fields["ppo"], "microbatch_size": 0}}
