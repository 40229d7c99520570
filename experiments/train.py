"""Trains a policy on a representation table (paper algorithm 1).

    python -m experiments.train --representation=gt12 --budget=paper
"""

from __future__ import annotations

from pathlib import Path

from experiments import _flags as flag
from experiments._artifacts import Domain, find_table
from experiments._training import TrainConfig, Trainer, save_inputs, train
from jaxnew import config as config_lib
from jaxnew.run_directory import RunDirectory

REPRESENTATION_BUDGET = flag.flags.DEFINE_string(
    "representation_budget", None, "Budget of a representation to be trained; default: --budget."
)


def main() -> None:
    task = flag.load_task(flag.TASK.value)
    domain = Domain.of(task, flag.SPLIT.value)
    runs = Path(flag.RUNS.value)
    budget = flag.budget_of(task.stage_two, flag.BUDGET.value, "Stage two")
    table = find_table(
        domain,
        runs,
        flag.REPRESENTATION.value,
        REPRESENTATION_BUDGET.value or flag.BUDGET.value,
    )
    config = config_lib.set_paths(
        TrainConfig.of(
            domain,
            flag.METHOD.value,
            flag.REPRESENTATION.value,
            table,
            budget,
            flag.SEED.value,
        ),
        flag.SET.value,
    )
    trainer = Trainer.of(config, task, domain.split, table)
    representation = Path(flag.REPRESENTATION.value).name.removesuffix(".npz")
    name = f"{config.method}-{representation}-{domain.split_name}-{flag.BUDGET.value}"
    path = Path(flag.WORKDIR.value or domain.folder(runs) / f"{name}-{config.seed}")
    with RunDirectory.open_or_create(
        path,
        config_lib.to_dict(config),
        flag.OVERWRITE.value,
        {"split_hash": domain.split.hash, "table_hash": table.hash, "table": table.source},
    ) as run:
        save_inputs(run, domain.split, table)
        print(f"Training {name}: {config.num_updates} updates ({budget.cost}) in {path}.")
        result = train(trainer, run, name)
    if result.best_metric is not None:
        print(
            f"{path}: update {result.step} of {config.num_updates}; best "
            f"{trainer.selection_metric} {result.best_metric:.3f} at update {result.best_step}."
        )


if __name__ == "__main__":
    flag.run_command(main)
