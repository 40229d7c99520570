"""Runs one command many times in one process, as `python -m tests.experiments.several`.

Starting Python, importing JAX and compiling take most of a smoke run's time; here they are paid
once. `run_several` starts it.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import subprocess
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.experiments.commands import ROOT

# Code that is compiled quickly, not code that runs quickly.
FAST_COMPILATION = "--xla_backend_optimization_level=0"


def run_several(
    module: str, jobs: Sequence[Sequence[str | Path]], *, timeout_s: float = 400.0
) -> list[str]:
    """Output of `python -m experiments.MODULE JOB` for each job, all of them in one new process.

    The text of a job that failed ends with its traceback; later jobs run all the same.

    Args:
      module: of `experiments`.
      jobs: the flags of each job.
      timeout_s: for all of them.
    """
    done = subprocess.run(
        [sys.executable, "-m", "tests.experiments.several", module],
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": FAST_COMPILATION},
        input=json.dumps([[str(flag) for flag in job] for job in jobs]),
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    outputs: list[str] = json.loads(done.stdout)
    return outputs


def main(module: str, jobs: list[list[str]]) -> list[str]:
    """Runs the jobs; see `run_several`."""
    command: Any = importlib.import_module(f"experiments.{module}")
    from absl import flags, logging

    from experiments._flags import configure_jax

    logging.set_verbosity(logging.WARNING)
    outputs = []
    for job in jobs:
        for name in flags.FLAGS:
            flags.FLAGS[name].unparse()
        flags.FLAGS([module, *job])
        configure_jax()
        text = io.StringIO()
        with contextlib.redirect_stdout(text):
            try:
                command.main()
            except Exception:
                traceback.print_exc(file=text)
        outputs.append(text.getvalue())
    return outputs


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], json.load(sys.stdin))))
