"""Runs one command several times in one process, watched by a probe.

Starting Python, importing JAX and compiling take most of a smoke run's time, and are paid once
here. `python -m tests.experiments.several` is the process where it is to be a new one.
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

from tests.experiments.commands import ENVIRONMENT, ROOT, compiling

_FAILED = "Traceback (most recent call last)"


def run_several(
    module: str,
    jobs: Sequence[Sequence[str | Path]],
    *,
    probe: str = "contextlib:nullcontext",
    may_fail: bool = False,
    alone: bool = False,
    optimized: bool = False,
) -> list[str]:
    """What `python -m experiments.MODULE JOB` prints for each job.

    Args:
      module: of `experiments`.
      jobs: the flags of each.
      probe: `package.module:NAME` of `job -> context manager`, in which the job is done.
      may_fail: a job's output may end with a traceback; later jobs are done all the same.
      alone: in one new process, not in this one, which has imported JAX and compiled programs.
      optimized: for jobs in this process that compute more than they compile.
    """
    if alone:
        outputs = finish_several(start_several(module, jobs, probe=probe))
    else:
        with contextlib.chdir(ROOT), compiling(optimized):
            outputs = main(module, probe, [[str(flag) for flag in job] for job in jobs])
    failed = [output for output in outputs if _FAILED in output]
    assert may_fail or not failed, "\n".join(failed)
    return outputs


def start_several(
    module: str,
    jobs: Sequence[Sequence[str | Path]],
    *,
    probe: str,
) -> subprocess.Popen[str]:
    """A new process that does what `run_several` does; `finish_several` waits for it."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.experiments.several", module, probe],
        cwd=ROOT,
        env={**os.environ, **ENVIRONMENT},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    process.stdin.write(json.dumps([[str(flag) for flag in job] for job in jobs]))
    process.stdin.close()
    process.stdin = None  # `communicate` would flush it.
    return process


def finish_several(process: subprocess.Popen[str]) -> list[str]:
    """What each job printed."""
    stdout, stderr = process.communicate(timeout=1800)
    assert process.returncode == 0, stdout + stderr
    outputs: list[str] = json.loads(stdout)
    return outputs


def main(module: str, probe: str, jobs: list[list[str]]) -> list[str]:
    """Does the jobs; see `run_several`."""
    command: Any = importlib.import_module(f"experiments.{module}")
    from absl import logging

    place, _, name = probe.partition(":")
    around = getattr(importlib.import_module(place), name)
    logging.set_verbosity(logging.WARNING)
    return [_output(command, job, around) for job in jobs]


def _output(command: Any, job: list[str], around: Any) -> str:
    from experiments.flags import configure_jax

    command.ARGUMENTS.parse(job)
    configure_jax()
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        try:
            with around(job):
                command.main()
        except Exception:
            traceback.print_exc(file=text)
    return text.getvalue()


if __name__ == "__main__":
    print(json.dumps(main(*sys.argv[1:], json.load(sys.stdin))))
