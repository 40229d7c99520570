"""Runs commands as a user does: in a process of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
# Programs that are compiled fast rather than fast programs, and all of them kept on disk. Runs
# whose bits are compared have to be of one kind.
ENVIRONMENT = {
    "XLA_FLAGS": "--xla_cpu_use_fusion_emitters=false",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
}
# For runs that compute a lot.
OPTIMIZED = {"XLA_FLAGS": "", "JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}


def run(
    *arguments: str | Path, fails: bool = False, environment: Mapping[str, str] = ENVIRONMENT
) -> str:
    """Output (stdout and stderr) of `python -m experiments.ARGUMENTS`; checks the exit status.

    Args:
      arguments: the module, and its flags.
      fails: whether the command ends with an error, which is then told without a traceback.
      environment: variables of the process, beside those of this one.
    """
    module, *flags = map(str, arguments)
    done = subprocess.run(
        [sys.executable, "-m", f"experiments.{module}", *flags],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    output = done.stdout + done.stderr
    assert (done.returncode != 0) == fails, output
    assert not fails or "Traceback" not in output, output
    return output


def read_json(path: Path) -> Any:
    """What a JSON file holds."""
    return json.loads(path.read_text())
