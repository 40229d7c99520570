"""The runs that figures need: what tells them apart, and where they are found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.reports.runs import RunRecord, read_runs
from jaxnew.embedding import load_table
from jaxnew.recording import REPRESENTATION_SEED
from jaxnew.representation.table import RepresentationTable
from jaxnew.storage.config import ConfigError
from jaxnew.storage.run_directory import RunDirectoryError
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.places import UsageError
from jaxnew.task.settings import TrainConfig, identity, with_set
from jaxnew.training import train_config

# Fields in which runs of one setting may differ. The split is told by its hash, and the
# representation by what it is called today.
_FREE = ("task", "split", "split_seed", "seed", "representation", "table_hash", "loop")
_ANY_TABLE = RepresentationTable(np.zeros((1, 1), np.float32), np.zeros(1, np.int32))


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

    @property
    def assignments(self) -> tuple[str, ...]:
        """Those of `--set` that make it what it is."""
        return ("conditions_position=true",) if self.conditions_position else ()


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

    @classmethod
    def asked_for(cls, flags: Any, given: Mapping[str, Path] | None = None) -> Source:
        """What the flags of a command say; `flags` are its `Arguments`."""
        domain = Domain.of(load_task(flags.task), flags.split, flags.split_seed)
        domain.task.check_workers(flags.workers)
        return cls(
            domain=domain,
            folder=Path(flags.runs),
            budget=flags.budget,
            stage_one=flags.representation_budget or flags.budget,
            steps=flags.steps,
            seeds=tuple(flags.seeds),
            assignments=tuple(flags.set),
            given=given or {},
            workers=flags.workers,
        )

    def of(self, cell: Cell) -> Source:
        """Where the runs of a cell come from: those of its own task and split.

        Raises:
          UsageError: there is no such variant of the task, or no such split of it.
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
        domain = Domain.of(task, split, self.domain.split_seed)
        return replace(self, domain=domain, given=given)

    def config_of(self, cell: Cell) -> TrainConfig:
        """The config of a run of a cell, but for its seed and its table."""
        preset = self.domain.task.budget(self.budget)
        names = cell.method, cell.representation
        config = train_config(self.domain, *names, _ANY_TABLE, preset, seed=0)
        config = with_set(config, [*self.assignments, *cell.assignments])
        if self.steps:
            updates = math.ceil(self.steps / config.ppo.steps_per_update)
            config = replace(config, num_updates=updates)
        return config

    def steps_of(self, cell: Cell) -> int:
        """Environment steps of a run of a cell."""
        config = self.config_of(cell)
        return config.num_updates * config.ppo.steps_per_update

    def embed_folder(self, representation: str) -> Path:
        """Where `embed` keeps a representation."""
        name = f"embed-{representation}-{self.domain.split_label}-{self.stage_one}"
        return self.domain.actions_folder(self.folder) / f"{name}-{REPRESENTATION_SEED}"


def find(source: Source, cell: Cell) -> dict[int, RunRecord]:
    """The finished runs of a cell, by seed.

    Raises:
      UsageError: two runs of one seed fit, so that it is not clear which one is meant.
    """
    wanted = _setting(identity(source.config_of(cell)))
    given = source.given.get(cell.representation)
    table = None if given is None else load_table(given)
    found: dict[int, RunRecord] = {}
    for run in policies_below(source.domain.folder(source.folder)):
        config, seed = run.config, int(run.config["seed"])
        is_wanted = (
            seed in source.seeds
            and _setting(config) == wanted
            and (table is None or config["table_hash"] == table.hash)
            and run.table is not None
            and run.representation == cell.representation
            and run.is_finished
        )
        if is_wanted and seed in found:
            raise UsageError(
                f"{found[seed].path} and {run.path} are both {cell.method} on "
                f"{cell.representation} with seed {seed}; move one of them away, or name the table "
                f"that you mean with --given={cell.representation}=TABLE."
            )
        if is_wanted:
            found[seed] = run
    return found


def policies_below(folder: Path) -> list[RunRecord]:
    """Every readable policy run below a folder; members of sweeps are runs."""
    runs = []
    for file in sorted(folder.rglob("config.json")):
        if "members.partial" in file.parts:  # Of a sweep that is being written.
            continue
        with suppress(UsageError, ConfigError, RunDirectoryError):
            runs += [run for run in read_runs([file.parent]) if run.path == file.parent.resolve()]
    return [run for run in runs if run.is_policy]


def _setting(config: Mapping[str, Any]) -> dict[str, Any]:
    """The fields by which runs are the same setting; how a gradient is cut up is none of them."""
    kept = {name: value for name, value in config.items() if name not in _FREE}
    return {**kept, "ppo": {**kept["ppo"], "microbatch_size": 0}}
