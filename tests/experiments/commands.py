"""Runs commands as a user does, in this process or in one of their own."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import subprocess
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import jax

ROOT = Path(__file__).resolve().parents[2]
# Programs that are compiled fast rather than fast programs. Runs whose bits are compared have to be
# of one kind.
ENVIRONMENT = {
    "XLA_FLAGS": "--xla_cpu_use_fusion_emitters=false",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
}
# For runs that compute a lot.
OPTIMIZED = {"XLA_FLAGS": "", "JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}


def run(*arguments: str | Path, fails: bool = False) -> str:
    """Output (stdout and stderr) of `python -m experiments.ARGUMENTS`; checks how it ends.

    It runs in this process, which has imported JAX and compiled much of what it needs; see
    `run_alone`.

    Args:
      arguments: the module, and its flags.
      fails: whether the command ends with an error, which is then told without a traceback.
    """
    module, *flags = map(str, arguments)
    output, has_failed = as_user(module, flags)
    return _checked(flags, output, has_failed, fails)


def run_alone(
    *arguments: str | Path, fails: bool = False, environment: Mapping[str, str] = ENVIRONMENT
) -> str:
    """`run` in a process of its own, with these variables beside those of this one."""
    module, *flags = map(str, arguments)
    done = subprocess.run(
        command_line(module, *flags),
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    return _checked(flags, done.stdout + done.stderr, done.returncode != 0, fails)


def command_line(module: str, *flags: str) -> list[str]:
    return [sys.executable, "-m", f"experiments.{module}", *flags]


def as_user(module: str, flags: Sequence[str]) -> tuple[str, bool]:
    """What a user reads of a command in this process, and whether it ends with an error."""
    command: Any = importlib.import_module(f"experiments.{module}")
    text = io.StringIO()
    with (
        mock.patch.object(sys, "orig_argv", command_line(module, *flags)),
        compiling(),
        contextlib.chdir(ROOT),
        contextlib.redirect_stdout(text),
        contextlib.redirect_stderr(text),
    ):
        try:
            command.ARGUMENTS.start(command.main, list(flags))
        except SystemExit as end:
            # As the interpreter does it: a text is printed, and is an error.
            if isinstance(end.code, str):
                print(end.code)
            return text.getvalue(), bool(end.code)
        except Exception:
            traceback.print_exc()
            return text.getvalue(), True
    return text.getvalue(), False


@contextlib.contextmanager
def compiling(optimized: bool = False) -> Iterator[None]:
    """Programs are like those of `ENVIRONMENT`, or fast, whatever the marker of the test."""
    name = "jax_disable_most_optimizations"
    before = jax.config.read(name)
    jax.config.update(name, not optimized)
    try:
        yield
    finally:
        jax.config.update(name, before)


def refused(module: str, jobs: Iterable[Sequence[str | Path]]) -> list[str]:
    """What a user reads of a command that refuses each job."""
    return [run(module, *job, fails=True) for job in jobs]


def _checked(flags: Sequence[str], output: str, has_failed: bool, fails: bool) -> str:
    assert has_failed == fails, f"{flags}: {output}"
    assert not fails or "Traceback" not in output, output
    return output


def of_new_actions(section: str, runs: Path, paths: Mapping[str, Path]) -> list[list[str]]:
    """The commands that `docs/new_actions.md` shows in a section, at smoke budget.

    Args:
      runs: in place of `runs/`.
      paths: in place of run directories that the page names.
    """
    page = (ROOT / "docs" / "new_actions.md").read_text()
    block = page.partition(f"\n## {section}")[2].partition("```shell\n")[2].partition("```")[0]
    for shown, path in paths.items():
        assert shown in block, shown
        block = block.replace(shown, str(path))
    block = block.replace("=runs/", f"={runs}/").replace("--budget=laptop", "--budget=smoke")
    return [line.split()[1:] for line in block.splitlines()]


def evaluation(path: Path, words: str) -> Any:
    """What is on record in a run's directory under these words, behind which is a hash."""
    (file,) = (path / "evaluation").glob(f"{words}-{'[0-9a-f]' * 8}.json")
    return read_json(file)


def read_json(path: Path) -> Any:
    """What a JSON file holds."""
    return json.loads(path.read_text())
