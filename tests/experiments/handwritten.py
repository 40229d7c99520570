"""Run directories written by hand, for tests of what reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from envs_mjx.grid_world import skill_universe
from experiments.pipeline.artifacts import SPLIT_FILE, TABLE_FILE
from experiments.pipeline.evaluation import file_stem
from experiments.pipeline.flags import budget_of
from experiments.reports.runs import Group, group_runs, read_runs
from experiments.tasks.grid_world import TASK
from jaxnew.actions import ActionSplit
from jaxnew.representation.table import RepresentationTable, engineered_table
from jaxnew.storage import config as config_lib
from jaxnew.storage.metrics import MetricsLog
from jaxnew.storage.run_directory import RunDirectory


def plain_config(
    seed: int = 1,
    representation: str = "gt12",
    split: str = "default",
    learning_rate: float = 0.001,
) -> dict[str, Any]:
    budget = budget_of(TASK.stage_two, "smoke", "Stage two")
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
        "hyperparameters": {
            **config_lib.to_dict(budget.hyperparameters),
            "learning_rate": learning_rate,
        },
        "loop": config_lib.to_dict(budget.loop),
        "trained_on": "train",
        "start": "fresh parameters",
    }


def a_split() -> ActionSplit:
    return TASK.make_split("default", skill_universe())


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
