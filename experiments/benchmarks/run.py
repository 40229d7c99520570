"""All benchmarks, one after the other, each in a process of its own.

python -m experiments.benchmarks.run --output=runs/benchmarks.jsonl
"""

from __future__ import annotations

import subprocess
import sys

from absl import flags

from experiments.benchmarks import _measure as m

SUBJECTS = (
    "environment",
    "utility",
    "images",
    "training",
    "methods",
    "evaluation",
    "representation",
    "sweep",
    "pool",
    "create",
    "host_training",
    "stacking",
    "stacking_training",
)
ONLY = flags.DEFINE_list("only", list(SUBJECTS), "Which benchmarks, in this order.")


def main() -> None:
    arguments = [f"--quick={m.QUICK.value}", f"--repeats={m.REPEATS.value}"]
    if m.OUTPUT.value is not None:
        arguments.append(f"--output={m.OUTPUT.value}")
    failed = []
    for name in ONLY.value:
        command = [sys.executable, "-m", f"experiments.benchmarks.{name}", *arguments]
        if subprocess.run(command, check=False).returncode:
            failed.append(name)
    if failed:
        sys.exit(f"These benchmarks failed: {', '.join(failed)}.")


if __name__ == "__main__":
    m.run_benchmark(main)
