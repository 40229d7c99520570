"""Workers that die, raise or hang: what is reported, and that a replacement changes nothing."""

from __future__ import annotations

import logging
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs_host import _process
from envs_host.memory import Setup
from envs_host.pool import HostPool, ReplayMismatch, WorkerError
from tests.envs_host.pool_toys import CHAOTIC, FAULTY, NAME

# Long enough for a healthy worker on a busy machine, where a hanging one has to be noticed.
TIMEOUT_S = 3.0
NUM_ENVS, NUM_STEPS, SEED = 4, 14, 7
BAD = 99


def actions(bad: tuple[int, int] | None = None) -> list[tuple[np.ndarray, np.ndarray]]:
    """Random ones; `bad` is a step and an environment that gets the action that misbehaves."""
    rng = np.random.default_rng(1)
    drawn = [
        (rng.integers(0, 10, NUM_ENVS), rng.uniform(-1, 1, (NUM_ENVS, 2))) for _ in range(NUM_STEPS)
    ]
    if bad is not None:
        drawn[bad[0]][0][bad[1]] = BAD
    return drawn


def outcome(pool: HostPool, steps: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """Every number of a rollout."""
    found: list[np.ndarray] = [pool.reset().copy()]
    for ids, positions in steps:
        for half in range(pool.num_halves):
            rows = pool.rows(half)
            pool.send(half, ids[rows], positions[rows])
        for half in range(pool.num_halves):
            found += numbers(pool.receive(half))
    return found


def numbers(step: Any) -> list[np.ndarray]:
    values = [value for name, value in vars(step).items() if name != "metrics"]
    return [np.array(value) for value in [*values, *step.metrics.values()]]


def undisturbed(bad: tuple[int, int] | None = None) -> list[np.ndarray]:
    with HostPool(CHAOTIC, {}, NUM_ENVS, 1, SEED) as pool:
        return outcome(pool, actions(bad))


def assert_same(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    assert len(found) == len(expected)
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.integration
def test_a_fault_in_an_evaluation_names_environments_and_numbers_of_episodes() -> None:
    with HostPool(FAULTY, {"fault": "raise"}, NUM_ENVS, 2, SEED) as pool:
        pool.reset_numbered(seed=5)
        steps = actions()
        while pool.episodes[3] == 0:
            pool.step(*steps[0])
        episodes = pool.episodes
        with pytest.raises(WorkerError) as caught:
            pool.step(np.array([0, 0, 0, BAD]), steps[0][1])
    keys = [(int(episodes[i]) * NUM_ENVS + i,) for i in (1, 3)]
    assert caught.value.environments == (1, 3)
    assert caught.value.seeds == tuple((5, key) for key in keys)
    assert (
        "It held environments [1, 3], with seed 5 and spawn keys (number of the episode,) "
        f"{keys[0]}, {keys[1]}.\n"
    ) in str(caught.value)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("fault", "reason", "detail"),
    [
        ("raise", "raised an exception while it stepped half 1", "a fault in the physics"),
        ("exit", "raised an exception while it stepped half 1", "SystemExit: an environment that"),
        ("SIGKILL", "was killed by SIGKILL", "when memory runs out"),
        ("segfault", "was killed by SIGSEGV", "in misbehave"),
        ("hang", "gave no answer in 3 s", "in misbehave"),
        ("SIGSTOP", "gave no answer in 3 s", ""),
    ],
)
def test_a_fault_is_reported_with_all_that_is_known(
    fault: str, reason: str, detail: str, capfd: pytest.CaptureFixture[str]
) -> None:
    hangs = fault in ("hang", "SIGSTOP")
    timeout_s = TIMEOUT_S if hangs else 60.0
    with HostPool(FAULTY, {"fault": fault}, NUM_ENVS, 2, SEED, timeout_s=timeout_s) as pool:
        pool.reset()
        steps = actions(bad=(2, 3))  # Environment 3 is in half 1 and in worker 1.
        for step in steps[:2]:
            pool.step(*step)
        start = time.monotonic()
        with pytest.raises(WorkerError) as caught:
            pool.step(*steps[2])
        took = time.monotonic() - start
        state = pool.state_dict()
        with pytest.raises(RuntimeError, match="The pool is closed: worker 1 was lost"):
            pool.reset()
    error = caught.value
    assert capfd.readouterr() == ("", f"about to {fault}\n")  # Printed before the end, not lost.
    assert error.worker == 1
    assert error.environments == (1, 3)
    assert error.seeds == tuple((SEED, (i, int(state["episodes"][i]))) for i in (1, 3))
    assert error.reason.startswith(reason)
    assert detail in str(error)
    assert str(error).startswith(f"Worker 1 {reason}")
    assert f"(1, {state['episodes'][1]})" in str(error)
    is_raised = fault in ("raise", "exit")
    assert error.environment == (3 if is_raised else None)
    assert ("in environment 3" in str(error)) == is_raised
    assert error.traceback.startswith("Traceback") == is_raised
    # No sooner than the timeout, if it hangs; else long before. And not much later: a second to ask
    # where it hangs, five at most to close the others, and a busy machine.
    assert (TIMEOUT_S if hangs else 0.0) < took < TIMEOUT_S + 20.0


@pytest.mark.integration
def test_a_state_after_a_loss_is_that_of_the_last_step() -> None:
    bad = (5, 1)  # In half 0, so neither half is received.
    expected, steps = undisturbed(bad), actions(bad)
    with HostPool(FAULTY, {"fault": "SIGKILL"}, NUM_ENVS, 2, SEED) as pool:
        found = outcome(pool, steps[:5])
        with pytest.raises(WorkerError):
            pool.step(*steps[5])
        state = pool.state_dict()
    with HostPool(CHAOTIC, {}, NUM_ENVS, 2, SEED) as pool:
        pool.load_state(state)
        for ids, positions in steps[5:]:
            for half in range(2):
                rows = pool.rows(half)
                pool.send(half, ids[rows], positions[rows])
                found += numbers(pool.receive(half))
    assert_same(found, expected)


@pytest.mark.integration
@pytest.mark.parametrize("fault", ["raise", "SIGKILL", "hang"])
def test_a_replaced_worker_changes_nothing(
    fault: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bad = (9, 3)
    expected = undisturbed(bad)
    kwargs = {"fault": fault, "once": str(tmp_path / "happened")}
    with HostPool(
        FAULTY, kwargs, NUM_ENVS, 2, SEED, on_worker_death="restart", timeout_s=TIMEOUT_S
    ) as pool:
        before = pool.worker_pids
        found = outcome(pool, actions(bad))
        after = pool.worker_pids
    assert_same(found, expected)
    assert (tmp_path / "happened").exists()
    assert before[0] == after[0]
    assert before[1] != after[1]
    (record,) = caplog.records
    assert record.name == "envs_host.pool"
    assert record.levelno == logging.WARNING
    assert "Replacing a worker (restart 1 of 10). Worker 1 " in record.getMessage()


def end_of(pid: int) -> None:
    """Kills a worker from outside; the pool finds out by itself."""
    os.kill(pid, signal.SIGKILL)


@pytest.mark.integration
def test_a_worker_killed_at_any_moment_is_replaced_exactly() -> None:
    expected = iter(undisturbed())

    def check(values: list[np.ndarray]) -> None:
        for value in values:
            np.testing.assert_array_equal(value, next(expected))

    with HostPool(
        CHAOTIC, {}, NUM_ENVS, 2, SEED, on_worker_death="restart", max_restarts=100
    ) as pool:
        end_of(pool.worker_pids[0])
        check([pool.reset()])
        for t, (ids, positions) in enumerate(actions()[:7]):
            for half in range(2):
                if t == half:
                    end_of(pool.worker_pids[1])
                rows = pool.rows(half)
                pool.send(half, ids[rows], positions[rows])
            if t == 2:
                end_of(pool.worker_pids[0])
            first = pool.receive(0)
            before = numbers(first)
            if t in (3, 4):
                end_of(pool.worker_pids[t % 2])
            if t == 5:
                for pid in pool.worker_pids:
                    end_of(pid)
            second = pool.receive(1)
            for x, y in zip(before, numbers(first), strict=True):  # Views of it stay as they were.
                np.testing.assert_array_equal(x, y)
            check(before)
            check(numbers(second))


@pytest.mark.integration
def test_the_number_of_restarts_is_bounded(caplog: pytest.LogCaptureFixture) -> None:
    with HostPool(
        FAULTY, {"fault": "raise"}, 4, 2, 0, on_worker_death="restart", max_restarts=2
    ) as pool:
        pool.reset()
        pool.step(np.zeros(4, int), np.zeros((4, 2)))
        with pytest.raises(WorkerError, match="a fault in the physics"):
            pool.step(np.array([0, 0, BAD, 0]), np.zeros((4, 2)))
        with pytest.raises(RuntimeError, match="closed"):
            pool.reset()
    assert [record.getMessage()[:37] for record in caplog.records] == [
        "Replacing a worker (restart 1 of 2). ",
        "Replacing a worker (restart 2 of 2). ",
    ]


@pytest.mark.integration
def test_a_replacement_that_differs_is_refused() -> None:
    factory = f"{NAME}:Unfaithful"
    with HostPool(factory, {"how": "start"}, 4, 2, 0, on_worker_death="restart") as pool:
        pool.reset()
        pool.send(0, np.zeros(2, int), np.zeros((2, 2)))
        end_of(pool.worker_pids[1])
        # Environment 1 is running; 3, the other one of worker 1, has an observation to keep.
        with pytest.raises(ReplayMismatch, match=r"environments \[3\] have other observations"):
            pool.receive(0)
        with pytest.raises(RuntimeError, match="replaying its actions led elsewhere"):
            pool.reset()


@pytest.mark.integration
def test_a_replacement_of_another_kind_is_refused() -> None:
    factory = f"{NAME}:Broken"
    with HostPool(
        factory, {"how": "process"}, 2, 1, 0, on_worker_death="restart", max_restarts=2
    ) as pool:
        end_of(pool.worker_pids[0])
        with pytest.raises(WorkerError, match="came back with other environments: Format") as error:
            pool.reset()
        assert error.value.worker == 0


@pytest.mark.integration
def test_a_worker_that_does_not_read_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its socket cannot hold the actions that it is to replay."""
    num_steps = 20_000
    with HostPool(CHAOTIC, {}, 2, 1, 0, timeout_s=TIMEOUT_S) as pool:
        pool.reset()
        state = pool.state_dict(num_steps)
        state["lengths"][:] = num_steps
        # Known from sending: waiting for an answer as well would take twice the timeout.
        monkeypatch.setattr(_process.WorkerProcess, "read", None)
        os.kill(pool.worker_pids[0], signal.SIGSTOP)
        with pytest.raises(WorkerError, match="gave no answer in 3 s"):
            pool.load_state(state)


@pytest.mark.integration
def test_a_worker_that_is_just_starting_ignores_ctrl_c_and_is_started_once() -> None:
    worker = _process.WorkerProcess(Setup(CHAOTIC, {}, 1, ((0, 1),), None))
    try:
        worker.start()
        first = worker.pid
        worker.start()
        os.kill(worker.pid, signal.SIGINT)  # Long before Python can run a line of it.
        with pytest.raises(ProcessLookupError):
            os.kill(first, 0)
        assert worker.read(60.0)[1].position_dim == 2
    finally:
        worker.stop(grace_s=0.0)


@pytest.mark.integration
def test_a_start_that_hangs_is_reported() -> None:
    with pytest.raises(WorkerError, match="gave no answer in 2 s") as caught:
        HostPool(f"{NAME}:misbehave", {"fault": "hang"}, 2, 1, 0, start_timeout_s=2.0)
    assert "in misbehave" in str(caught.value)


@pytest.mark.integration
def test_no_process_outlives_a_closed_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_process, "EXIT_S", 0.2)
    with HostPool(FAULTY, {"fault": "hang"}, 2, 1, 0, num_halves=1, timeout_s=TIMEOUT_S) as pool:
        pool.reset()
        pool.send(0, np.array([0, BAD]), np.zeros((2, 2)))
        (pid,) = pool.worker_pids
    # Hanging in a step: it was killed and reaped.
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
