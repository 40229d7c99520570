"""A command that a signal stops says so in its status: what would follow it does not begin."""

from __future__ import annotations

import importlib
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from experiments.flags import Arguments
from jaxnew import loop

TASK = "--task=tests.toy_device:TASK"


def status(command: str, *flags: str | Path) -> Any:
    """What the process would end with; 0 for None."""
    module: Any = importlib.import_module(f"experiments.{command}")
    try:
        module.ARGUMENTS.start(module.main, [str(flag) for flag in flags])
    except SystemExit as end:
        return end.code
    return 0


@pytest.mark.integration
def test_a_command_ends_with_the_signal_after_the_same_clean_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """In its own loop, and in that of the encoder that it needs."""
    real, coming = loop._Session.advance, [signal.SIGTERM]

    def advance(self: Any, *arguments: Any) -> Any:
        if coming:
            signal.raise_signal(coming.pop())
        return real(self, *arguments)

    monkeypatch.setattr(loop._Session, "advance", advance)
    flags = ("--task=tests.toy_device:TASK", "--budget=smoke", f"--runs={tmp_path}")
    assert status("train", *flags, "--representation=gt3", "--set=num_updates=2") == 143
    coming.append(signal.SIGINT)
    assert status("train", *flags) == 130
    output = capfd.readouterr().out
    assert output.count("Finishing the chunk, then saving") == 2
    assert "ours-gt3: stopped at step 1; run again to go on" in output
    assert "was interrupted; embed again to go on" in output
    assert not list(tmp_path.glob("*/ours-hvae*"))


@pytest.mark.unit
@pytest.mark.parametrize("command", ["train", "embed", "finetune", "sweep", "demo"])
def test_no_command_goes_on_with_what_was_interrupted(
    command: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    module: Any = importlib.import_module(f"experiments.{command}")
    stopped = SimpleNamespace(interrupted_by=15, was_interrupted=True, is_finished=False, rows=())
    finished = SimpleNamespace(table=None)
    monkeypatch.setattr(module, "train" if command == "demo" else command, lambda *a, **k: stopped)
    if command == "demo":
        monkeypatch.setattr(module, "embed", lambda *a, **k: finished)
    if command == "sweep":
        monkeypatch.setattr(module, "jax", SimpleNamespace(config=SimpleNamespace(update=print)))
    flags = [f"--run={tmp_path}"] if command == "finetune" else [f"--runs={tmp_path}"]
    assert status(command, *flags, "--budget=smoke") == 128 + 15


@pytest.mark.unit
def test_ctrl_c_outside_of_a_loop_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def main() -> None:
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as end:
        Arguments("Does something.").start(main, [])
    assert end.value.code == 130
    assert capsys.readouterr().out == "Stopped by Ctrl-C.\n"
