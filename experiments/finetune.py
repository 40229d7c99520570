"""Goes on learning with the test actions, or learns them from scratch (figures 10 and 19).

    python -m experiments.finetune --run=RUN
    python -m experiments.finetune --run=RUN --scratch

RUN is a run of `train` with `--method=ours` or `--method=nearest-neighbour`. Its policy is trained
with all test actions as one fixed set; the learning rate starts anew. From a utility policy
everything is kept; from a discrete policy all but its categorical heads. `--scratch` keeps nothing.
"""

from __future__ import annotations

from experiments.flags import Arguments
from jaxnew.task.places import UsageError
from jaxnew.training import finetune

ARGUMENTS = Arguments(
    __doc__, "budget", "seed", "workdir", "overwrite", "workers", "set", "trust", "debug_nans"
)
ARGUMENTS.define("string", "run", None, "Run directory of train.")
ARGUMENTS.define("bool", "scratch", False, "Start from fresh parameters.")


def main() -> int | None:
    if ARGUMENTS.run is None:
        raise UsageError("Say which run to fine-tune: --run=DIRECTORY.")
    run = finetune(
        ARGUMENTS.run,
        is_scratch=ARGUMENTS.scratch,
        **ARGUMENTS.of("budget", "seed", "set", "overwrite"),
        workdir=ARGUMENTS.path,
        num_workers=ARGUMENTS.workers,
    )
    return run.interrupted_by


if __name__ == "__main__":
    ARGUMENTS.start(main)
