"""Trains a policy on a representation table (paper algorithm 1).

python -m experiments.train --representation=gt12 --budget=paper
"""

from __future__ import annotations

from experiments.flags import Arguments
from jaxnew.training import train

ARGUMENTS = Arguments(
    __doc__,
    "task",
    "method",
    "representation",
    "representation_budget",
    "split",
    "split_seed",
    "budget",
    "seed",
    "workdir",
    "runs",
    "overwrite",
    "workers",
    "set",
    "debug_nans",
)


def main() -> int | None:
    run = train(
        ARGUMENTS.task,
        ARGUMENTS.representation,
        method=ARGUMENTS.method,
        budget=ARGUMENTS.budget,
        seed=ARGUMENTS.seed,
        split=ARGUMENTS.split,
        split_seed=ARGUMENTS.split_seed,
        set=ARGUMENTS.set,
        representation_budget=ARGUMENTS.representation_budget,
        workdir=ARGUMENTS.path,
        runs=ARGUMENTS.runs,
        overwrite=ARGUMENTS.overwrite,
        num_workers=ARGUMENTS.workers,
    )
    return run.interrupted_by


if __name__ == "__main__":
    ARGUMENTS.start(main)
