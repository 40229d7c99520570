"""A task with one of its splits, and where tasks are found."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

from jaxnew.actions import ActionSplit, ActionUniverse
from jaxnew.task.budgets import StageOneBudget
from jaxnew.task.places import UsageError, budget_of, import_recorded, load_place
from jaxnew.task.task import Play, Task

# Packages that bring tasks name a module for each in this group of entry points.
ENTRY_POINTS = "jaxnew.tasks"


@dataclass(frozen=True)
class Domain:
    """A task with its universe and one of its splits.

    Attributes:
      task: the domain.
      universe: its actions.
      split_name, split_seed: which split, and the seed that drew it.
      split: the parts.
    """

    task: Task
    universe: ActionUniverse
    split_name: str
    split_seed: int
    split: ActionSplit

    @classmethod
    def of(cls, task: Task, split_name: str | None = None, split_seed: int = 0) -> Domain:
        """A split of a task by name (default: its first) and seed.

        Raises:
          UsageError: there is none of that name, or it cannot be drawn from that seed.
        """
        universe = task.make_universe()
        name = split_name or task.default_split
        if name not in task.splits:
            raise UsageError(
                f"Task {task.name} has no split {name!r}; choose one of {sorted(task.splits)}."
            )
        return cls(task, universe, name, split_seed, task.splits[name](universe, split_seed))

    @property
    def split_label(self) -> str:
        """Name of the split in the names of folders."""
        return self.split_name + (f"-split{self.split_seed}" if self.split_seed else "")

    def folder(self, runs: Path) -> Path:
        """Where this task's runs are kept."""
        return runs / self.task.name

    def actions_folder(self, runs: Path) -> Path:
        """Where recordings and encoders are kept, which tasks with the same actions share."""
        return runs / (self.task.actions_name or self.task.name)

    @property
    def play(self) -> Play:
        """The default play environment.

        Raises:
          UsageError: the task has none; its representations are given.
        """
        if not self.task.plays:
            raise UsageError(f"Task {self.task.name} has no play environment to record actions in.")
        return self.task.plays[0]

    def stage_one(self, play: Play, budget_name: str) -> StageOneBudget:
        """What a budget spends on representations of a play's recordings.

        Raises:
          UsageError: there is no such budget.
        """
        return budget_of(play.stage_one or self.task.stage_one, budget_name, "Stage one")


def published(make: Callable[[], ActionSplit]) -> Callable[[ActionUniverse, int], ActionSplit]:
    """A split that was published and cannot be drawn anew, as `Task.splits` takes one.

    It refuses every seed but 0 with a `UsageError`.
    """

    def of_seed(universe: ActionUniverse, seed: int) -> ActionSplit:
        if seed:
            raise UsageError(
                f"The split of {universe.name} is the published one and cannot be drawn from "
                f"split_seed={seed}; leave out --split_seed."
            )
        return make()

    return of_seed


def load_task(name: str, *, is_recorded: bool = False) -> Task:
    """A task by name (`grid_world`, `create-push`) or by place (`package.module:TASK`).

    Names are those of the entry points `jaxnew.tasks` of what is installed. Such a module defines
    `TASK` and, for several tasks of one domain, `TASKS`, a mapping from the part of the name after
    the dash.

    Args:
      name: see above.
      is_recorded: a run names it, not the user; see `import_recorded`.

    Raises:
      UsageError: there is no such module or object, or it is not a `Task`; or a run names a module
        that is neither installed nor trusted.
    """
    known = _installed()
    allowed = f"Tasks: {', '.join(sorted(known))}; or give package.module:TASK for one of your own."
    if ":" in name:
        if is_recorded:
            import_recorded(name)
        return _checked(load_place(name, f"task {name!r}", allowed), name, allowed, place=name)
    base, _, variant = name.partition("-")
    if base not in known:
        raise UsageError(f"Unknown task {name!r}. {allowed}")
    module: ModuleType = known[base].load()
    if not variant:
        return _checked(module.TASK, name, allowed)
    tasks = getattr(module, "TASKS", {})
    if variant not in tasks:
        listed = ", ".join([base, *(f"{base}-{key}" for key in tasks)])
        raise UsageError(f"Unknown task {name!r}: there are {listed}.")
    return _checked(tasks[variant], name, allowed)


def is_installed(task: Task) -> bool:
    """Whether an installed package brings the task, or the one whose variant it is."""
    return task.place is None and task.name.partition("-")[0] in _installed()


def _installed() -> dict[str, importlib.metadata.EntryPoint]:
    return {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}


def _checked(task: Any, name: str, allowed: str, place: str | None = None) -> Task:
    if not isinstance(task, Task):
        raise UsageError(f"{name} is {task!r}, not a jaxnew.Task. {allowed}")
    return replace(task, place=place)
