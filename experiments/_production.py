"""The runs that figures need: found below a folder, or made by the commands that make runs."""

from __future__ import annotations

import math
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from experiments._artifacts import REPRESENTATION_SEED, TABLE_FILE, Domain, parse_representation
from experiments._flags import UsageError, budget_of
from experiments._methods import adapted, file_name
from experiments._runs import Run, read_runs
from jaxnew import config as config_lib
from jaxnew.representation.table import RepresentationTable
from jaxnew.run_directory import RunDirectoryError
from jaxnew.task import StageTwoBudget

_EQUAL = ("num_updates", "hyperparameters", "ppo")  # Fields that make runs the same setting.


@dataclass(frozen=True)
class Cell:
    """One setting of a figure: `--method` and `--representation`."""

    method: str
    representation: str


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
      given: tables and runs of `embed` to take for a representation.
    """

    domain: Domain
    folder: Path
    budget: str
    stage_one: str
    steps: float
    seeds: tuple[int, ...]
    assignments: tuple[str, ...]
    given: Mapping[str, Path]

    def budget_of(self, method: str) -> StageTwoBudget:
        """What a run of the method spends."""
        task = self.domain.task
        budget = budget_of(task.stage_two, self.budget, "Stage two")
        budget = adapted(budget, method, task, self.domain.split)
        budget = config_lib.set_paths(budget, list(self.assignments))
        if self.steps:
            updates = math.ceil(self.steps / budget.ppo.steps_per_update)
            budget = replace(budget, num_updates=updates)
        return budget

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
    table = source.table_of(cell.representation)
    found: dict[int, Run] = {}
    for run in policies(source.domain.folder(source.folder)):
        config = run.config
        is_wanted = (
            config["method"] == cell.method
            and config["trained_on"] == "train"
            and not config.get("num_clusters", 0)
            and config["split_hash"] == source.domain.split.hash
            and run.representation == cell.representation
            and _plain(config) == wanted
            and config["seed"] in source.seeds
            and (table is None or config["table_hash"] == table.hash)
            and run.trained_steps >= config["num_updates"] * run.steps_per_update
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


@dataclass(frozen=True)
class Job:
    """A command that makes something that is missing.

    Attributes:
      title: what it makes.
      command: `python -m experiments.NAME` without its beginning.
      cost: how long it takes.
      seconds: the same as a number; None if nobody measured it.
    """

    title: str
    command: tuple[str, ...]
    cost: str
    seconds: float | None

    def run(self) -> None:
        """Runs the command in a process of its own, and lets it save and end on a signal.

        Raises:
          UsageError: the command failed, or was stopped.
        """
        print(f"{self.title} ({self.cost}): {self.text}", flush=True)
        process = subprocess.Popen([sys.executable, "-m", *self._module, *self.command[1:]])
        received: list[int] = []

        def stop(number: int, frame: Any) -> None:
            received.append(number)
            if number == signal.SIGTERM:  # Ctrl-C reaches the process by itself.
                process.terminate()

        previous = {which: signal.signal(which, stop) for which in (signal.SIGINT, signal.SIGTERM)}
        try:
            status = process.wait()
        finally:
            for which, handler in previous.items():
                signal.signal(which, handler)
        if received:
            raise UsageError("Stopped; call the same command again to go on.")
        if status:
            raise UsageError(f"The command ended with status {status}: {self.text}")

    @property
    def _module(self) -> tuple[str, ...]:
        return (f"experiments.{self.command[0]}",)

    @property
    def text(self) -> str:
        """The whole command, for a shell."""
        return shlex.join(["python", "-m", *self._module, *self.command[1:]])


def embed_job(source: Source, representation: str) -> Job | None:
    """What makes a representation; None if there is nothing to make."""
    domain = source.domain
    is_learned = representation.startswith(("hvae", "vae"))
    if not is_learned or representation in source.given:
        return None
    if (source.embed_folder(representation) / TABLE_FILE).exists():
        return None
    budget = domain.stage_one(parse_representation(domain, representation).play, source.stage_one)
    command = (
        "embed",
        f"--task={domain.task.reference}",
        f"--representation={representation}",
        f"--budget={source.stage_one}",
        f"--runs={source.folder}",
    )
    return Job(f"Representation {representation}", command, budget.cost, None)


def sweep_job(source: Source, cell: Cell, seeds: Sequence[int]) -> Job:
    """What trains a cell with some seeds."""
    domain = source.domain
    budget = source.budget_of(cell.method)
    listed = ",".join(map(str, seeds))
    name = (
        f"sweep-{file_name(cell.method)}-{cell.representation}-{source.budget}-{budget.num_updates}"
    )
    folder = domain.folder(source.folder) / f"{name}-{listed.replace(',', '-')}"
    command = (
        "sweep",
        f"--task={domain.task.reference}",
        f"--split={domain.split_name}",
        f"--method={cell.method}",
        f"--representation={source.representation_flag(cell.representation)}",
        f"--representation_budget={source.stage_one}",
        f"--budget={source.budget}",
        f"--seeds={listed}",
        f"--runs={source.folder}",
        f"--workdir={folder}",
        *(f"--set={assignment}" for assignment in source.assignments),
        f"--set=num_updates={budget.num_updates}",
    )
    steps = budget.num_updates * budget.ppo.steps_per_update
    seconds = training_seconds(source, cell.method, steps * len(seeds), len(seeds))
    title = f"{cell.method} on {cell.representation}, {len(seeds)} seeds of {steps * 1e-6:.2f} M"
    return Job(title, command, duration(seconds), seconds)


def training_seconds(source: Source, method: str, steps: float, num_runs: int) -> float | None:
    """How long `steps` of training take, in all of `num_runs` runs of a sweep."""
    measured = source.domain.task.measured
    if measured is None:
        return None
    rate = measured.training.get(method, measured.training["ours"])
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    devices = max(n for n in range(1, cores + 1) if num_runs % n == 0)
    return steps / (rate * devices)


def evaluation_seconds(source: Source, num_episodes: float) -> float | None:
    """How long so many episodes take."""
    measured = source.domain.task.measured
    return None if measured is None else num_episodes / measured.evaluation


def duration(seconds: float | None) -> str:
    """Seconds for reading."""
    if seconds is None:
        return "nobody measured how long it takes"
    if seconds < 90:
        return f"about {max(1, round(seconds))} s"
    if seconds < 5400:
        return f"about {round(seconds / 60)} minutes"
    return f"about {seconds / 3600:.1f} hours"
