"""The commands on a domain whose environments run on the host."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxnew.run import Run
from jaxnew.storage import metrics
from jaxnew.storage.checkpoint import Checkpointer
from jaxnew.task.task import Task
from tests.experiments.commands import (
    ENVIRONMENT,
    ROOT,
    command_line,
    evaluation,
    read_json,
    run,
    run_alone,
)
from tests.experiments.create_runs import saved, timeless
from tests.toy_task import TASK

pytestmark = pytest.mark.integration

PLACE = "--task=tests.toy_task:TASK"
COMMON = (PLACE, "--representation=gt4", "--budget=smoke")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    runs = tmp_path_factory.mktemp("runs")
    run("train", *COMMON, f"--runs={runs}", "--workers=1")
    return runs / "toy" / "ours-gt4-default-smoke-31"


def test_train_save_and_evaluate_in_a_new_process(trained: Path) -> None:
    lines = metrics.read(trained)
    assert lines[-1]["step"] == 4
    assert any("validation/is_success" in line for line in lines)
    assert any("time/rollout_s" in line for line in lines)
    results = []
    for evaluate in (run, run_alone):
        evaluate("evaluate", f"--run={trained}", "--sets=test,train", "--episodes=7", "--trust")
        results.append(evaluation(trained, "test-best-sampled-m4"))
    assert results[0]["metrics"] == results[1]["metrics"]
    assert (results[0]["num_actions"], results[0]["num_episodes"]) == (6, 7)
    assert set(results[0]["metrics"]) == {"is_success", "episode_return", "num_steps"}


def test_finetune_with_the_test_actions(trained: Path, tmp_path: Path) -> None:
    # Of another seed, whose fresh parameters are others.
    flags = ("--budget=smoke", "--seed=7", f"--workdir={tmp_path / 'warm'}")
    run("finetune", f"--run={trained}", *flags)
    config = read_json(tmp_path / "warm" / "config.json")
    assert (config["trained_on"], config["method"]) == ("test", "no-subsampling")
    start = Run.load(trained).policy.params
    with Run.load(tmp_path / "warm", "latest") as warm:
        end = warm.policy.params
        fresh = warm.trainer.init().params

    def distance(params: Any) -> float:
        return float(
            np.abs(end["critic"]["value"]["kernel"] - params["critic"]["value"]["kernel"]).max()
        )

    assert 0 < distance(start) < 0.1 * distance(fresh)


def test_a_method_with_a_fixed_set_trains_and_is_evaluated(tmp_path: Path) -> None:
    method = "--method=nearest-neighbour"
    run("train", *COMMON, method, "--set=num_updates=1", f"--workdir={tmp_path / 'run'}")
    run("evaluate", f"--run={tmp_path / 'run'}", "--episodes=3")
    assert evaluation(tmp_path / "run", "test-best-sampled-m4")["metrics"]


def test_a_killed_run_resumes_to_the_same_bits(trained: Path, tmp_path: Path) -> None:
    killed = tmp_path / "killed"
    command = command_line("train", *COMMON, f"--workdir={killed}")
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, **ENVIRONMENT},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while process.poll() is None and not Checkpointer(killed / "checkpoints").steps("latest"):
        time.sleep(0.005)
    assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert Checkpointer(killed / "checkpoints").steps("latest")[-1] < 4
    assert "resuming" in run("train", *COMMON, f"--workdir={killed}")
    for kind in ("best", "latest"):
        assert saved(killed, kind) == saved(trained, kind)
        assert any("environments" in leaf for leaf in saved(trained, kind))
    assert timeless(killed) == timeless(trained)


def test_sweep_says_what_to_do(tmp_path: Path) -> None:
    output = run_alone("sweep", *COMMON, f"--runs={tmp_path}", fails=True)
    assert "toy run on the host" in output
    assert "Run `train` once per seed" in output
    assert not list(tmp_path.iterdir())


@pytest.mark.unit
def test_a_task_has_one_kind_of_environment() -> None:
    with pytest.raises(ValueError, match="Task none needs one of make_environment and host"):
        Task(name="none", make_universe=TASK.make_universe, splits=TASK.splits, stage_two={})
    with pytest.raises(ValueError, match="environments of task toy run on the host"):
        TASK.environment_of()
