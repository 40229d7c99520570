"""Flags that the commands share, and what they have in common at the start."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from absl import app, flags, logging

from envs_host.pool import WorkerError
from jaxnew.task import Task

TASK = flags.DEFINE_string("task", "grid_world", "Task name, or package.module:TASK.")
METHOD = flags.DEFINE_string(
    "method",
    "ours",
    "ours, no-entropy, no-subsampling, continuous, nearest-neighbour, random, or "
    "package.module:NAME of a callable (MethodContext) -> PolicyMethod.",
)
REPRESENTATION = flags.DEFINE_string(
    "representation",
    "hvae",
    "Engineered vectors by name (gt12), hvae or vae with an optional -MODALITY (hvae-onehot) and "
    "-oracle (trained on all actions), random-SIZE, a run directory of embed, or an .npz table.",
)
SPLIT = flags.DEFINE_string("split", None, "Name of the split; default: the task's first.")
BUDGET = flags.DEFINE_string("budget", "laptop", "smoke, laptop, paper (stage one also: fast).")
SEED = flags.DEFINE_integer("seed", 31, "Seed of the run.")
WORKDIR = flags.DEFINE_string("workdir", None, "Directory of the run; default: below --runs.")
RUNS = flags.DEFINE_string("runs", "runs", "Where runs and what they share are kept.")
OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace an existing run instead of resuming.")
WORKERS = flags.DEFINE_integer(
    "workers", 0, "Processes for environments on the host; 0: one per core.", lower_bound=0
)
SET = flags.DEFINE_multi_string(
    "set",
    [],
    "path.to.field=value, for any field of the config; pool.FIELD=value, such as "
    "pool.on_worker_death=restart, says how environments on the host are run.",
)
DEBUG_NANS = flags.DEFINE_bool("debug_nans", False, "Stop at the operation that makes a NaN.")


class UsageError(ValueError):
    """The command was asked for something that does not exist or does not fit."""


def load_place(place: str, what: str, allowed: str) -> Any:
    """The object at `package.module:NAME`, wherever Python finds that module.

    Args:
      place: where it is.
      what: what was asked for, and `allowed`: what may be asked for; for the message.

    Raises:
      UsageError: `place` is not of that form, or there is no such module or object.
    """
    module_name, _, attribute = place.partition(":")
    if not all(part.isidentifier() for part in [*module_name.split("."), attribute]):
        raise UsageError(f"Unknown {what}: {place!r} is not a package.module:NAME. {allowed}")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as err:
        if err.name is None or not f"{module_name}.".startswith(f"{err.name}."):
            raise  # The module is there, and what it imports is not.
        raise UsageError(
            f"Unknown {what}: there is no module {module_name} (it has to be importable from "
            f"{Path.cwd()} or installed). {allowed}"
        ) from err
    if not hasattr(module, attribute):
        similar = difflib.get_close_matches(attribute, vars(module), 1, 0.0)
        hint = f"; did you mean {module_name}:{similar[0]}?" if similar else "."
        raise UsageError(f"Unknown {what}: {module_name} has no {attribute}{hint} {allowed}")
    return getattr(module, attribute)


def load_task(name: str) -> Task:
    """A task by name (`grid_world`, `create-push`) or by place (`package.module:TASK`).

    A module of `experiments/tasks` defines `TASK` or, for several tasks in one domain, `TASKS`, a
    mapping from the part of the name after the dash; `TASK` is then the one without a dash.

    Raises:
      UsageError: there is no such module or object, or it is not a `Task`.
    """
    known = sorted(path.stem for path in (Path(__file__).parents[1] / "tasks").glob("[a-z]*.py"))
    allowed = f"Tasks: {', '.join(known)}; or give package.module:TASK for one of your own."
    is_place = ":" in name
    module, _, variant = ("", "", "") if is_place else name.partition("-")
    place = name if is_place else f"experiments.tasks.{module}:TASK{'S' if variant else ''}"
    task = load_place(place, f"task {name!r}", allowed)
    if variant:
        if variant not in task:
            listed = ", ".join(f"{module}-{key}" for key in task)
            raise UsageError(f"Unknown task {name!r}: there are {listed}.")
        task = task[variant]
    if not isinstance(task, Task):
        raise UsageError(f"{place} is {task!r}, not a jaxnew.task.Task. {allowed}")
    return replace(task, place=name) if is_place else task


def budget_of(stage: Any, name: str, what: str) -> Any:
    """The preset called `name`.

    Raises:
      UsageError: there is none of that name.
    """
    if name not in stage:
        raise UsageError(f"{what} has no budget {name!r}; choose one of {', '.join(stage)}.")
    return stage[name]


def configure_jax() -> None:
    """Compiled programs are kept between processes; `--debug_nans` is obeyed."""
    import jax

    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(Path.home() / ".cache" / "jaxnew"))
    jax.config.update("jax_compilation_cache_dir", cache)
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    jax.config.update("jax_debug_nans", DEBUG_NANS.value)


def run_command(main: Callable[[], None]) -> None:
    """Runs a command's `main`; a user's mistake ends it with one line instead of a traceback."""

    def wrapped(arguments: Sequence[str]) -> None:
        if len(arguments) > 1:
            sys.exit(f"Unknown argument {arguments[1]!r}; every option is a --flag=value.")
        logging.set_verbosity(logging.WARNING)  # Orbax logs every file it writes.
        configure_jax()
        try:
            main()
        except (ValueError, ArithmeticError, WorkerError) as err:
            if DEBUG_NANS.value or os.environ.get("JAXNEW_TRACEBACK"):
                raise
            sys.exit(f"{type(err).__name__}: {err}\n{_advice(err)}")

    app.run(wrapped)


def _advice(err: Exception) -> str:
    if isinstance(err, WorkerError):
        return (
            "The same command goes on from the last checkpoint; with "
            "--set=pool.on_worker_death=restart it replaces workers that are lost."
        )
    return "(JAXNEW_TRACEBACK=1 shows where.)"
