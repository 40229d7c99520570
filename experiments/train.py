"""Trains a policy on a representation table (paper algorithm 1).

python -m experiments.train --representation=gt12 --budget=paper
"""

from __future__ import annotations

from pathlib import Path

from absl import flags

from experiments.pipeline import flags as flag
from experiments.pipeline.artifacts import Domain, find_table
from experiments.pipeline.machinery import pool_assignments, with_pool_settings
from experiments.pipeline.methods import variant_of
from experiments.pipeline.training import train_policy

REPRESENTATION_BUDGET = flags.DEFINE_string(
    "representation_budget", None, "Budget of a representation to be trained; default: --budget."
)


def main() -> None:
    pool, assignments = pool_assignments(flag.SET.value)
    task = with_pool_settings(flag.load_task(flag.TASK.value), pool)
    domain = Domain.of(task, flag.SPLIT.value)
    runs = Path(flag.RUNS.value)
    variant_of(flag.METHOD.value)  # Before a representation is trained for it.
    table = find_table(
        domain,
        runs,
        flag.REPRESENTATION.value,
        REPRESENTATION_BUDGET.value or flag.BUDGET.value,
    )
    train_policy(
        domain,
        runs,
        table,
        flag.REPRESENTATION.value,
        flag.BUDGET.value,
        method=flag.METHOD.value,
        seed=flag.SEED.value,
        assignments=assignments,
        workdir=Path(flag.WORKDIR.value) if flag.WORKDIR.value else None,
        overwrite=flag.OVERWRITE.value,
        num_workers=flag.WORKERS.value,
    )


if __name__ == "__main__":
    flag.run_command(main)
