"""The runs of a sweep, read back: a row each, and one table by what was varied."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from jaxnew.ppo import Hyperparameters
from jaxnew.results import label, on_record
from jaxnew.run import Run, load_trainer
from jaxnew.storage.checkpoint import Kind
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.places import UsageError, trusting
from jaxnew.task.settings import read_train_config, recorded_task
from jaxnew.task.task import Task

MEMBERS = "members"  # Name of the folder of the runs, and of the file of their rows.


@dataclass(frozen=True)
class Runs:
    """The runs of a sweep, one per seed and combination of what was varied.

    Attributes:
      path: directory of the sweep.
      rows: of each run: `path`, `seed`, `best_metric`, `best_step`, `elapsed_s`, every
        hyper-parameter, and `diverged_at` and `diverged_by`: the update by which it diverged and
        what was not finite first (`jaxnew.finiteness.CAUSES`), or None. Empty where the sweep was
        interrupted: sweep again to go on.
      task: what they were trained on.
      interrupted_by: number of the signal that stopped the sweep just now, or None.
    """

    path: Path
    rows: tuple[Mapping[str, Any], ...]
    task: Task
    interrupted_by: int | None = None

    @classmethod
    def load(cls, path: Path | str, task: Task | None = None, *, trust: bool = False) -> Self:
        """The runs of a finished sweep.

        Args:
          path: its directory.
          task: in place of the one that it names, for a task that no name or place leads to.
          trust: import what it names as task or method, installed or not.

        Raises:
          UsageError: it is no sweep, or was interrupted, or names what has to be trusted.
          RunDirectoryError: it is no run directory.
        """
        directory = RunDirectory.load(path)
        if not is_sweep(directory):
            raise UsageError(f"{path} is no sweep; give the directory of a run of sweep.")
        try:
            recorded = directory.evaluation(MEMBERS)[MEMBERS]
        except FileNotFoundError as err:
            raise UsageError(
                f"The sweep {path} has written no members yet; run it to its end."
            ) from err
        with trusting(trust):
            task = recorded_task(directory.config[MEMBERS][0], task)
        rows = tuple(_row(entry, directory.path / MEMBERS) for entry in recorded)
        return cls(directory.path, rows, task)

    @property
    def selection_metric(self) -> str:
        """What `best_metric` is."""
        return f"validation/{self.task.selection_metric}"

    @property
    def varied(self) -> list[str]:
        """The hyper-parameters that differ between the runs."""
        names = [field.name for field in fields(Hyperparameters)]
        return [name for name in names if len({row.get(name) for row in self.rows}) > 1]

    def table(self) -> list[dict[str, Any]]:
        """Rows for `pandas.DataFrame`: `rows`, and what the runs' evaluations on record found, mean
        selection metrics by what was evaluated (`test-best-sampled-m50`).
        """
        return [{**row, **self._evaluated(Path(row["path"]))} for row in self.rows]

    def _evaluated(self, path: Path) -> dict[str, float]:
        metric = self.task.selection_metric
        found = {label(e): e["metrics"] for e in on_record(path)}
        return {
            name: found[name][metric]["mean"] for name in sorted(found) if metric in found[name]
        }

    def groups(self) -> list[tuple[dict[str, Any], dict[str, np.ndarray]]]:
        """Per combination of what was varied its values, and f64[n] over seeds of each number:
        of `best_metric` and of the evaluations of `table`. Runs that diverged count nowhere.
        """
        table, varied = self.table(), self.varied
        known = {
            "path",
            "seed",
            "best_step",
            "elapsed_s",
            "diverged_at",
            "diverged_by",
            *(f.name for f in fields(Hyperparameters)),
        }
        names = list(dict.fromkeys(name for row in table for name in row if name not in known))
        found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
        for row in table:
            seeds = found.setdefault(tuple(row[name] for name in varied), [])
            seeds += [row] * (row["diverged_at"] is None)
        return [
            (
                dict(zip(varied, values, strict=True)),
                {n: np.array([r[n] for r in rows if r.get(n) is not None], float) for n in names},
            )
            for values, rows in found.items()
        ]

    def summary(self) -> list[dict[str, Any]]:
        """Rows for `pandas.DataFrame`, one per combination of what was varied.

        Its values, and of each number of `groups` the mean over seeds, `NAME_std`, the population
        deviation, and `NAME_seeds`, how many have it; `diverged`: how many seeds did; `is_best`:
        the best mean by validation.
        """
        rows: list[dict[str, Any]] = []
        for values, numbers in self.groups():
            row = dict(values)
            seeds = [r for r in self.diverged if all(r[n] == v for n, v in values.items())]
            row["diverged"] = len(seeds)
            for name, of_seeds in numbers.items():
                has_any = bool(of_seeds.size)
                row[name] = float(of_seeds.mean()) if has_any else None
                row[f"{name}_std"] = float(of_seeds.std()) if has_any else None
                row[f"{name}_seeds"] = of_seeds.size
            rows.append(row)
        rated = [row["best_metric"] for row in rows if row["best_metric"] is not None]
        best = max(rated, default=None)
        return [{**row, "is_best": best is not None and row["best_metric"] == best} for row in rows]

    @property
    def diverged(self) -> list[Mapping[str, Any]]:
        """The rows of the runs that diverged."""
        return [row for row in self.rows if row["diverged_at"] is not None]

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Run]:
        """Loads one run after the other, with its best checkpoint."""
        return self.load_each()

    def load_each(self, checkpoint: Kind = "best") -> Iterator[Run]:
        """Loads one run after the other; they share their compiled parts.

        Runs that diverged are left out, and for `best` those that were not evaluated in training.
        """
        trainer = None
        for row in self.rows:
            if row in self.diverged or (checkpoint == "best" and row["best_metric"] is None):
                continue
            directory = RunDirectory.load(row["path"])
            trainer = trainer or load_trainer(directory, task=self.task)
            config, _ = read_train_config(directory.config, self.task)
            yield Run.of(directory.path, replace(trainer, config=config), checkpoint)

    def best(self) -> Run:
        """The run with the highest validation of those that did not diverge.

        Raises:
          UsageError: the sweep was interrupted, or nothing was evaluated.
        """
        sound = [row for row in self.rows if row not in self.diverged]
        rated = [row for row in sound if row["best_metric"] is not None]
        if not rated:
            raise UsageError(f"{self.path} has no evaluated runs; sweep again to go on.")
        best = max(rated, key=lambda row: row["best_metric"])
        return Run.load(best["path"], task=self.task)


def _row(recorded: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A row of `Runs`, wherever the sweep was moved to, and whichever version wrote it."""
    row = dict(recorded)
    path = Path(row.pop("path", None) or row.pop("member"))
    unknown = {"diverged_at": None, "diverged_by": None}
    return {"path": str(folder / path.name), **unknown, **row.pop("hyperparameters", {}), **row}


def is_sweep(directory: RunDirectory) -> bool:
    """Whether a directory is that of a sweep, not of a single run."""
    return MEMBERS in directory.config
