"""The commands that make what is missing, each in a process of its own, and how long they take.

A domain inside jit is trained by `sweep`, all seeds in one program; one on the host by `train`, run
by run.
"""

from __future__ import annotations

import math
import shlex
import signal
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.main import child
from experiments.reports.plots import amount
from experiments.reports.production import Cell, Source
from experiments.reports.runs import read_runs
from jaxnew.cores import available_cores
from jaxnew.embedding import TABLE_FILE, is_learned
from jaxnew.loop import InterruptedRunError
from jaxnew.recording import parse_representation
from jaxnew.storage.run_directory import RunDirectoryError
from jaxnew.task.methods import file_name
from jaxnew.task.places import UsageError


@dataclass(frozen=True)
class Job:
    """A command that makes something that is missing.

    Attributes:
      title: what it makes.
      command: `python -m experiments.NAME` without its beginning.
      cost: how long it takes.
      seconds: the same as a number; None if nobody measured it.
      folder: of the run or the sweep that it makes.
    """

    title: str
    command: tuple[str, ...]
    cost: str
    seconds: float | None
    folder: Path

    @property
    def is_done(self) -> bool:
        """Whether all its runs are finished."""
        try:
            return all(run.is_finished for run in read_runs([self.folder]))
        except (UsageError, RunDirectoryError):  # Not begun, or a sweep that is not over.
            return False

    def run(self) -> None:
        """Runs the command in a process of its own, and lets it save and end on a signal.

        Raises:
          UsageError: the command failed.
          InterruptedRunError: it, or this process, was stopped by a signal.
        """
        print(f"{self.title} ({self.cost}): {self.text}", flush=True)
        line, environment = child(*self.command)
        process = subprocess.Popen(line, env=environment)
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
        stops = {s for n in (signal.SIGINT, signal.SIGTERM) for s in (128 + n, -n)}
        if received or status in stops:
            number = received[0] if received else abs(status) % 128
            raise InterruptedRunError("Stopped; call the same command again to go on.", number)
        if status:
            raise UsageError(f"The command ended with status {status}: {self.text}")

    @property
    def text(self) -> str:
        """The whole command, for a shell."""
        return shlex.join(["python", "-m", f"experiments.{self.command[0]}", *self.command[1:]])


def embed_job(source: Source, representation: str) -> Job | None:
    """What makes a representation; None if there is nothing to make."""
    domain = source.domain
    if not is_learned(representation) or representation in source.given:
        return None
    folder = source.embed_folder(representation)
    if (folder / TABLE_FILE).exists():
        return None
    budget = domain.stage_one(parse_representation(domain, representation).play, source.stage_one)
    command = (
        "embed",
        # By the name of its actions, so that tasks which share them have one command.
        f"--task={domain.task.actions_name or domain.task.reference}",
        *_split_flags(source),
        f"--representation={representation}",
        f"--budget={source.stage_one}",
        f"--runs={source.folder}",
    )
    return Job(f"Representation {representation}", command, budget.cost, None, folder)


def training_jobs(source: Source, cell: Cell, seeds: Sequence[int]) -> list[Job]:
    """What trains a cell with some seeds: one program, or a run each on the host."""
    if source.domain.task.host is not None:
        return [train_job(source, cell, seed) for seed in seeds]
    return [sweep_job(source, cell, seeds)] if seeds else []


def train_job(source: Source, cell: Cell, seed: int, folder: Path | None = None) -> Job:
    """What trains one run, and goes on with it where it was stopped.

    Args:
      source: of the cell.
      folder: of the run; default: one that names all that the cell fixes.
    """
    folder = folder or _folder(source, cell, "", source.domain.split_label, [seed])
    workers = [f"--workers={source.workers}"] * (source.workers > 0)
    command = _command("train", source, cell, f"--seed={seed}", f"--workdir={folder}", *workers)
    steps = source.steps_of(cell)
    seconds = training_seconds(source, cell.method, steps)
    cost = duration(seconds)
    if seconds is None:
        whole = source.domain.task.budget(source.budget).cost
        cost += f"; a whole run of budget {source.budget} takes {whole}"
    return Job(f"{cell.label}, seed {seed}, {amount(steps)}", command, cost, seconds, folder)


def sweep_job(
    source: Source,
    cell: Cell,
    seeds: Sequence[int],
    folder: Path | None = None,
    vary: Sequence[str] = (),
) -> Job:
    """What trains a cell with some seeds in one program.

    Args:
      source: of the cell.
      folder: of the sweep; default: one that names all that the cell fixes.
      vary: values of `--vary`, each `FIELD=VALUE,VALUE...`.
    """
    split = source.domain.split_label
    split = "" if split == source.domain.task.default_split else split
    folder = folder or _folder(source, cell, "sweep", split, seeds)
    own = [f"--seeds={','.join(map(str, seeds))}", f"--workdir={folder}"]
    command = _command("sweep", source, cell, *own, *(f"--vary={values}" for values in vary))
    steps = source.steps_of(cell)
    num_runs = len(seeds) * math.prod(values.count(",") + 1 for values in vary)
    seconds = training_seconds(source, cell.method, steps * num_runs, num_runs)
    title = f"{cell.label}, {num_runs} runs of {amount(steps)} in one program"
    return Job(title, command, duration(seconds), seconds, folder)


def _folder(source: Source, cell: Cell, start: str, split: str, seeds: Sequence[int]) -> Path:
    """One that names all that a cell fixes."""
    words = [start, file_name(cell.method), cell.representation]
    words += ["conditioned" * cell.conditions_position, split, source.budget]
    words += [str(source.config_of(cell).num_updates), *map(str, seeds)]
    return source.domain.folder(source.folder) / "-".join(filter(None, words))


def _command(name: str, source: Source, cell: Cell, *own: str) -> tuple[str, ...]:
    """`train` or `sweep` with what says what is trained, and flags of its own."""
    table = str(source.given.get(cell.representation, cell.representation))
    updates = f"num_updates={source.config_of(cell).num_updates}"
    return (
        name,
        f"--task={source.domain.task.reference}",
        *_split_flags(source),
        f"--method={cell.method}",
        f"--representation={table}",
        *([f"--representation_budget={source.stage_one}"] if is_learned(table) else []),
        f"--budget={source.budget}",
        f"--runs={source.folder}",
        *own,
        *(f"--set={text}" for text in (*source.assignments, *cell.assignments, updates)),
    )


def _split_flags(source: Source) -> list[str]:
    domain = source.domain
    seed = [f"--split_seed={domain.split_seed}"] if domain.split_seed else []
    return [f"--split={domain.split_name}", *seed]


def training_seconds(source: Source, method: str, steps: float, num_runs: int = 1) -> float | None:
    """How long `steps` of training take, in all of `num_runs` runs of a sweep.

    A single run on the host is foretold as on one core; its workers make it faster on several.
    """
    measured = source.domain.task.shown.measured
    if measured is None:
        return None
    rate = measured.training.get(method, measured.training["ours"])
    devices = max(n for n in range(1, available_cores() + 1) if num_runs % n == 0)
    return steps / (rate * devices)


def evaluation_seconds(source: Source, num_episodes: float) -> float | None:
    """How long so many episodes take."""
    measured = source.domain.task.shown.measured
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


def announce(
    jobs: Sequence[Job],
    episodes: int = 0,
    evaluation: float | None = None,
    tuned: Sequence[float | None] = (),
) -> None:
    """Says what will be made and how long it takes.

    Args:
      episodes: of evaluations, and `evaluation`: their seconds.
      tuned: seconds of each fine-tuning.
    """
    if not jobs and not episodes and not tuned:
        print("All runs and evaluations are there.")
        return
    print("Missing:")
    for job in jobs:
        print(f"  {job.title}: {job.cost}\n    {job.text}")
    if episodes:
        print(f"  {episodes:,} episodes of evaluation: {duration(evaluation)}")
    for seconds in tuned:
        cost = duration(seconds) if seconds is None else f"up to {duration(seconds)}"
        print(f"  fine-tuning and its zero-shot lines, where not there: {cost}")
    numbers = [job.seconds for job in jobs] + ([evaluation] if episodes else []) + list(tuned)
    known = [seconds for seconds in numbers if seconds is not None]
    lacking = len(numbers) - len(known)
    total = f"In all {duration(sum(known))}" if known else "Nobody measured how long it takes"
    total += f", and {lacking} unmeasured" if known and lacking else ""
    print(f"  {total}. It can be stopped, and called again to go on.")
