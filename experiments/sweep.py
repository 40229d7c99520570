"""Trains many seeds and hyper-parameters as one program, sharded over all devices.

    python -m experiments.sweep --representation=gt12 --seeds=31,41,51,61
        --vary=entropy_coefficient=0.01,0.05 --vary=learning_rate=3e-4,1e-3

Every combination becomes an ordinary run directory, as `train` would have made it. The end is a
table by what was varied, which `evaluate --run=SWEEP` and `figures --run=SWEEP` show again with the
evaluations that were made meanwhile.
"""

from __future__ import annotations

import os

import jax

from experiments.flags import TRAINED, Arguments
from experiments.reports.sweeps import show_sweep
from jaxnew.cores import available_cores
from jaxnew.sweeping import sweep
from jaxnew.task.places import UsageError

ARGUMENTS = Arguments(__doc__, *TRAINED, "workdir", "runs", "overwrite", "set", "debug_nans")
ARGUMENTS.define("integers", "seeds", [31, 41, 51, 61, 71], "Seeds of the members.")
ARGUMENTS.define("multi_string", "vary", [], "hyperparameter=value,value,...")
ARGUMENTS.define(
    "integer",
    "members_at_once",
    0,
    "Members that a device vmaps; 0: all, or 1 on CPUs.",
    lower_bound=0,
)


def main() -> int | None:
    # Each core is a device; without effect on accelerators.
    if "JAX_NUM_CPU_DEVICES" not in os.environ:
        jax.config.update("jax_num_cpu_devices", available_cores())
    found = sweep(
        ARGUMENTS.task,
        ARGUMENTS.representation,
        vary=dict(varied(entry) for entry in ARGUMENTS.vary),
        **ARGUMENTS.of("seeds", "method", "budget", "split", "split_seed", "set"),
        **ARGUMENTS.of("representation_budget", "runs", "overwrite", "members_at_once"),
        workdir=ARGUMENTS.path,
    )
    if found.rows:
        for file in show_sweep(found):
            print(file)
    return found.interrupted_by


def varied(entry: str) -> tuple[str, list[float]]:
    """What a value of `--vary` says.

    Raises:
      UsageError: it is not `name=value,value`.
    """
    name, _, values = entry.partition("=")
    try:
        return name, [float(value) for value in values.split(",")]
    except ValueError as err:
        raise UsageError(f"--vary={entry}: must be name=value,value,...; {err}.") from err


if __name__ == "__main__":
    ARGUMENTS.start(main)
