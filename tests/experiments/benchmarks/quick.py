"""Benchmarks at tiny sizes, and what they write."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.benchmarks import _measure as m
from tests.experiments.commands import ROOT


def timing(wall_s: Sequence[float], cpu_s: Sequence[float]) -> m.Timing:
    """A made-up timing."""
    return m.Timing(tuple(map(m.Cost, wall_s, cpu_s)))


def report_to(output: Path) -> m.Report:
    """A report of this process."""
    arguments = m.Benchmark("")
    arguments.parse([f"--output={output}"])
    return m.Report("subject", arguments)


def run_quick(name: str, folder: Path) -> list[dict[str, Any]]:
    """The lines that a benchmark writes with `--quick`."""
    output = folder / "results.jsonl"
    done = subprocess.run(
        [sys.executable, "-m", f"experiments.benchmarks.{name}", "--quick", f"--output={output}"],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=1500,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return read(output)


def read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]
