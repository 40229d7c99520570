"""Trains a policy on a representation table (paper algorithm 1).

python -m experiments.train --representation=gt12 --budget=paper
"""

from __future__ import annotations

from experiments.flags import TRAINED, Arguments
from jaxnew.training import train

ARGUMENTS = Arguments(
    __doc__,
    *TRAINED,
    *("seed", "workdir", "runs", "overwrite", "workers", "set", "debug_nans"),
)


def main() -> int | None:
    run = train(
        ARGUMENTS.task,
        ARGUMENTS.representation,
        **ARGUMENTS.of("method", "budget", "seed", "split", "split_seed", "set"),
        **ARGUMENTS.of("representation_budget", "runs", "overwrite"),
        workdir=ARGUMENTS.path,
        num_workers=ARGUMENTS.workers,
    )
    return run.interrupted_by


if __name__ == "__main__":
    ARGUMENTS.start(main)
