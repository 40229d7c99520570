"""Run directories written by hand, for tests of what reads them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.grid_world import skill_universe
from experiments.reports.anchors import Anchors
from experiments.reports.production import Cell, Source
from experiments.reports.runs import Group, RunRecord, group_runs, read_runs
from experiments.tasks.grid_world import TASK
from jaxnew.actions import ActionSplit
from jaxnew.embedding import SPLIT_FILE, TABLE_FILE
from jaxnew.representation.table import RepresentationTable, engineered_table
from jaxnew.results import file_stem
from jaxnew.storage import config as config_lib
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.storage.metrics import MetricsLog
from jaxnew.storage.run_directory import RunDirectory
from jaxnew.task.domain import Domain, load_task
from jaxnew.task.settings import identity
from jaxnew.trainer import Trainer
from jaxnew.training import open_run, train_config


def plain_config(
    seed: int = 1,
    representation: str = "gt12",
    split: str = "default",
    learning_rate: float = 0.001,
) -> dict[str, Any]:
    """The config of a run of Grid World at smoke budget."""
    budget = TASK.budget("smoke")
    hyperparameters = config_lib.to_dict(budget.hyperparameters)
    return {
        "task": "grid_world",
        "method": "ours",
        "representation": representation,
        "table_hash": "t",
        "split": split,
        "split_hash": "s",
        "seed": seed,
        "num_updates": 4,
        "ppo": config_lib.to_dict(budget.ppo),
        "sets": config_lib.to_dict(budget.sets),
        "hyperparameters": {**hyperparameters, "learning_rate": learning_rate},
        "loop": config_lib.to_dict(budget.loop),
        "trained_on": "train",
        "start": "fresh parameters",
        "split_seed": 0,
        "num_clusters": 0,
        "conditions_position": False,
        "network": config_lib.to_dict(budget.network),
        "environment": config_lib.plain(TASK.environment),
    }


def a_split() -> ActionSplit:
    return Domain.of(TASK).split


def write_run(
    path: Path,
    config: dict[str, Any],
    curve: tuple[float, ...] = (0.1, 0.3, 0.2),
    table: RepresentationTable | None = None,
    metric: str = "is_success",
    updates: int = 2,
) -> Path:
    """A run with an evaluation after so many updates; validation is half of train."""
    with RunDirectory.open_or_create(path, config):
        table = table or engineered_table(skill_universe(), "gt12")
        table.save(path / TABLE_FILE)
        a_split().save(path / SPLIT_FILE)
        with MetricsLog(path) as log:
            for number, value in enumerate(curve):
                step = updates * (number + 1)
                log.write(step, {"loss/total": 1.0})
                log.write(step, {f"train/{metric}": value, f"validation/{metric}": value / 2})
    return path


def write_evaluation(
    path: Path, actions: str, mean: float, metric: str = "is_success", **changes: Any
) -> None:
    content = {
        "checkpoint": "best",
        "step": 4,
        "actions": actions,
        "metrics": {
            metric: {"mean": mean, "low": mean - 0.02, "high": mean + 0.01, "interval": ""}
        },
        "num_episodes": 1000,
        "set_size": 50,
        "policy": "sampled",
        **changes,
    }
    RunDirectory.load(path).record_evaluation(file_stem(content), content)


def groups_at(*paths: Path) -> list[Group]:
    return group_runs(read_runs(paths))


# ---- Runs of the cells of figures ----


@cache
def domain_of(task: str) -> Domain:
    return Domain.of(load_task(task))


def source_of(task: str, folder: Path = Path("runs"), **changes: Any) -> Source:
    return replace(
        Source(domain_of(task), folder, "smoke", "smoke", 0.0, (1, 2), (), {}), **changes
    )


def config_of(source: Source, cell: Cell, seed: int = 1) -> dict[str, Any]:
    """The config of a run that `figures --budget=smoke` would have made for a cell."""
    return {**identity(source.of(cell).config_of(cell)), "seed": seed, "table_hash": "t"}


def finished(source: Source, cell: Cell, seed: int = 1, **written: Any) -> Path:
    """A run of a cell, whose last report is that of its last update."""
    own = source.of(cell)
    name = f"{cell.label}-{seed}".replace(" ", "").replace(",", "-")
    config = config_of(source, cell, seed)
    curve = {
        "curve": (0.1,),
        "metric": own.domain.task.selection_metric,
        "updates": config["num_updates"],
        **written,
    }
    return write_run(own.domain.folder(own.folder) / name, config, **curve)


def group_of(source: Source, cell: Cell, **written: Any) -> Group:
    """The group of one run of a cell."""
    path = finished(source, cell, **written)
    return Group(cell.label, source.of(cell).domain.task, tuple(read_runs([path])))


def unwritten(source: Source, cell: Cell) -> Group:
    """The same with nothing on disk, for what its config tells."""
    run = RunRecord(Path("nowhere"), config_of(source, cell))
    return Group(cell.label, source.of(cell).domain.task, (run,))


# ---- Policies that know nothing ----


def untrained(path: Path, place: str, representation: str, seed: int = 1) -> Path:
    """A run of a policy with random parameters, at smoke budget."""
    domain = Domain.of(load_task(place))
    table = engineered_table(domain.universe, representation)
    budget = domain.task.budget("smoke")
    config = train_config(domain, "ours", representation, table, budget, seed)
    with (
        Trainer.of(config, domain.task, domain.split, table) as trainer,
        open_run(path, trainer) as run,
    ):
        shapes = trainer.learner.policy_shapes(trainer.training)
        rng = np.random.default_rng(seed)

        def fill(leaf: Any) -> jax.Array:
            if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                return jax.random.key(0)
            is_number = jnp.issubdtype(leaf.dtype, jnp.floating)
            drawn = rng.normal(0.0, 0.1, leaf.shape) if is_number else np.ones(leaf.shape)
            return jnp.asarray(drawn, leaf.dtype)

        metadata = {"best_metric": 0.0, "best_step": 0, "elapsed_s": 0.0}
        Checkpointer(run.checkpoints).save("best", 0, jax.tree.map(fill, shapes), metadata)
        with MetricsLog(path) as log:
            log.write(config.num_updates, {"validation/is_success": 0.25})
    return path


def write_anchors(folder: Path, height: float, **changes: Any) -> Path:
    """Anchors of Shape Stacking with one policy."""
    interval = {"mean": height, "low": height - 0.1, "high": height + 0.1}
    values = {"stop at once": {part: {"final_height": interval} for part in ("train", "test")}}
    fields = {"task": "shape_stacking", "split": "default", "engine": "mujoco_c", **changes}
    return Anchors(**{"set_size": 20, **fields}, num_episodes=4, seed=1, values=values).save(folder)
