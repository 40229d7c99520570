"""All benchmarks, one after the other, each in a process of its own.

python -m experiments.benchmarks.run --output=runs/benchmarks.jsonl
"""

from __future__ import annotations

import subprocess
import sys

from experiments.benchmarks import _measure as m

SUBJECTS = (
    "environment",
    "utility",
    "images",
    "training",
    "methods",
    "representation",
    "sweep",
    "pool",
    "create",
    "host_training",
    "stacking",
    "stacking_training",
)
ARGUMENTS = m.Benchmark(__doc__)
ARGUMENTS.define("list", "only", list(SUBJECTS), "Which benchmarks, in this order.")


def main() -> None:
    arguments = [f"--quick={ARGUMENTS.quick}", f"--repeats={ARGUMENTS.repeats}"]
    if ARGUMENTS.output is not None:
        arguments.append(f"--output={ARGUMENTS.output}")
    failed = []
    for name in ARGUMENTS.only:
        command = [sys.executable, "-m", f"experiments.benchmarks.{name}", *arguments]
        if subprocess.run(command, check=False).returncode:
            failed.append(name)
    if failed:
        sys.exit(f"These benchmarks failed: {', '.join(failed)}.")


if __name__ == "__main__":
    ARGUMENTS.start(main)
