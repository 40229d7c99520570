"""Runs commands as a user does: in a process of their own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def run(
    *arguments: str | Path, fails: bool = False, environment: dict[str, str] | None = None
) -> str:
    """Output (stdout and stderr) of `python -m experiments.ARGUMENTS`; checks the exit status."""
    module, *flags = map(str, arguments)
    done = subprocess.run(
        [sys.executable, "-m", f"experiments.{module}", *flags],
        cwd=ROOT,
        env=environment,
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
