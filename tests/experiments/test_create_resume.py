"""CREATE's runs are exact: stopped and resumed, with one worker or two, with workers that die."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer
from tests.experiments.commands import ENVIRONMENT, ROOT, command_line, evaluation, read_json
from tests.experiments.create_runs import saved, timeless
from tests.experiments.several import run_several

pytestmark = pytest.mark.integration

COMMON = ("--task=create-push", "--representation=gt32", "--budget=smoke")
KILLING = "tests.experiments.create_probes:killing"
RESTART = "--set=pool.on_worker_death=restart"
TWICE, ONCE = "killed-in-evaluation-and-in-update", "killed-in-update"


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two updates that SIGTERM stops during the evaluation after the first."""
    path = tmp_path_factory.mktemp("runs") / "stopped"
    process = subprocess.Popen(
        command_line("train", *COMMON, f"--workdir={path}", "--workers=1"),
        cwd=ROOT,
        env={**os.environ, **ENVIRONMENT},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    log = path / "metrics.jsonl"
    while process.poll() is None and not (log.exists() and log.stat().st_size):
        time.sleep(0.005)
    process.terminate()
    output, _ = process.communicate(timeout=200)
    assert process.returncode == 128 + signal.SIGTERM, output
    assert "stopped at step 1; run again to go on" in output
    assert Checkpointer(path / "checkpoints").steps("latest")[-1] == 1
    return path


@pytest.fixture(scope="module")
def outputs(stopped: Path) -> dict[str, str]:
    """What `train` printed, in order; all in one process, which is not that of `stopped`."""
    runs = stopped.parent
    jobs = {
        "calm": ("calm", "--workers=1"),
        "resumed": ("stopped", "--workers=1"),
        "twice": (TWICE, "--workers=2", RESTART),
        "failed": (ONCE, "--workers=2"),
        "retried": (ONCE, "--workers=2", RESTART),
    }
    flags = [(*COMMON, f"--workdir={runs / name}", *more) for name, *more in jobs.values()]
    printed = run_several("train", flags, probe=KILLING, may_fail=True, alone=True)
    return dict(zip(jobs, printed, strict=True))


@pytest.fixture(scope="module")
def evaluated(stopped: Path, outputs: dict[str, str]) -> dict[str, str]:
    """What `evaluate` printed for each run, in a third process; a worker dies for one of them."""
    assert outputs
    names = ("stopped", TWICE)
    common = ("--episodes=12", "--workers=2", RESTART)
    jobs = [(f"--run={stopped.parent / name}", *common) for name in names]
    printed = run_several("evaluate", jobs, probe=KILLING, alone=True)
    return dict(zip(names, printed, strict=True))


@pytest.mark.parametrize("name", ["stopped", TWICE, ONCE])
def test_runs_are_equal_to_the_bit(stopped: Path, outputs: dict[str, str], name: str) -> None:
    """Parameters, optimizer, environments, sets, metrics, and the config."""
    assert "Traceback" not in outputs["calm"]
    calm, path = stopped.parent / "calm", stopped.parent / name
    for kind in ("best", "latest"):
        assert saved(path, kind) == saved(calm, kind)
    assert any("environments" in leaf for leaf in saved(path, "latest"))
    assert timeless(path) == timeless(calm)
    assert metrics.read(path)[-1]["step"] == 2
    assert read_json(path / "config.json") == read_json(calm / "config.json")


def test_what_was_resumed_and_restarted(outputs: dict[str, str]) -> None:
    assert "resuming" in outputs["resumed"]
    assert "at step 1 of 2" in outputs["resumed"]
    assert outputs["twice"].count("killed in-evaluation") == 1
    assert outputs["twice"].count("killed in-update") == 1
    assert "at step 1 of 2" in outputs["retried"]
    assert outputs["retried"].count("killed in-update") == 1
    assert "killed" not in outputs["calm"] + outputs["resumed"]


def test_without_the_setting_a_dead_worker_ends_the_run(outputs: dict[str, str]) -> None:
    output = outputs["failed"]
    assert "WorkerError: Worker 1 was killed by SIGKILL" in output
    assert "It held environments [1, 3], with seed 31 and spawn keys (environment, " in output
    assert "update 2 of 2" not in output


def test_evaluations_are_equal_to_the_bit(stopped: Path, evaluated: dict[str, str]) -> None:
    assert [text.count("killed in-evaluation") for text in evaluated.values()] == [0, 1]
    found = [evaluation(stopped.parent / name, "test-best-sampled-m5") for name in evaluated]
    assert found[0]["num_episodes"] == 12
    assert found[0]["metrics"]["num_steps"]["mean"] > 1.0
    assert found[1]["metrics"] == found[0]["metrics"]


@pytest.mark.unit
def test_a_command_ends_with_the_error_of_the_worker_and_what_to_do() -> None:
    code = (
        "from envs_host._process import Lost\n"
        "from envs_host.pool import WorkerError\n"
        "from experiments.flags import Arguments\n"
        "def main():\n"
        "    raise WorkerError(1, [2], ((31, (2, 5)),), Lost('was killed by SIGKILL'))\n"
        "Arguments('').start(main)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "WorkerError: Worker 1 was killed by SIGKILL" in done.stderr
    assert "seed 31 and spawn keys (environment, episode) (2, 5)" in done.stderr
    assert "--set=pool.on_worker_death=restart" in done.stderr
    assert "Traceback" not in done.stderr
