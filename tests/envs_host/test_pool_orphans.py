"""However a process with a pool ends: no worker, no memory and no complaint is left.

Each test starts a real process. Workers hold its stderr open, so reading that to its end is waiting
for the last of them.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from envs_host.pool import HostPool
from tests.envs_host.pool_toys import FAULTY

ROOT = Path(__file__).resolve().parents[2]
PROC = Path("/proc")
WAIT_S = 60.0


@contextlib.contextmanager
def parent(kind: str) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A started process, in a process group of its own, and the ids that it announced."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.envs_host.pool_parent", kind],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, process.communicate()[1]
        yield process, json.loads(line)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def assert_nothing_left(process: subprocess.Popen[str], pids: list[int]) -> str:
    """Waits for the end of all; returns what they wrote to stderr."""
    _, written = process.communicate(timeout=WAIT_S)
    deadline = time.monotonic() + WAIT_S  # A process closes its files before it is gone.
    while any(is_running(pid) for pid in pids):
        assert time.monotonic() < deadline, pids
        time.sleep(0.01)
    return written


def is_running(pid: int) -> bool:
    """A zombie is not: it has ended, and nobody may have asked how."""
    try:
        return (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["steps", "bare"])
def test_ctrl_c(kind: str) -> None:
    with parent(kind) as (process, pids):
        os.killpg(process.pid, signal.SIGINT)
        written = assert_nothing_left(process, pids)
    assert process.returncode == -signal.SIGINT
    assert written.count("Traceback") == 1  # The parent's own.
    assert written.endswith("KeyboardInterrupt\n")


@pytest.mark.integration
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("kind", ["steps", "hang"])
def test_parent_is_killed(kind: str, number: signal.Signals) -> None:
    """Also while workers are in a step that never ends."""
    with parent(kind) as (process, pids):
        if kind == "hang":
            assert process.stderr is not None
            assert [process.stderr.readline() for _ in pids] == ["about to hang\n"] * 2
        os.kill(process.pid, number)
        assert assert_nothing_left(process, pids) == ""
    assert process.returncode == -number


@pytest.mark.integration
@pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux tells a process of its parent's end"
)
def test_parent_is_killed_while_its_workers_are_stopped() -> None:
    with parent("steps") as (process, pids):
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        os.kill(process.pid, signal.SIGKILL)
        assert assert_nothing_left(process, pids) == ""


@pytest.mark.integration
def test_the_thread_that_started_the_workers_may_end() -> None:
    """Linux takes it for the parent's end, and the pool still needs them."""
    with ThreadPoolExecutor(1) as executor:
        pool = executor.submit(HostPool, FAULTY, {"fault": "hang"}, 4, 2, 0).result()
    with pool:
        pool.reset()
        pids = pool.worker_pids
        for _ in range(3):
            pool.step(np.zeros(4, int), np.zeros((4, 2)))
        assert pool.worker_pids == pids


@pytest.mark.integration
def test_parent_crashes() -> None:
    with parent("abort") as (process, pids):
        assert assert_nothing_left(process, pids) == ""
    assert process.returncode == -signal.SIGABRT


@pytest.mark.integration
def test_parent_raises() -> None:
    with parent("raise") as (process, pids):
        written = assert_nothing_left(process, pids)
    assert process.returncode == 1
    assert written.count("Traceback") == 1
    assert written.endswith("ZeroDivisionError: an error of the parent\n")


@pytest.mark.integration
def test_parent_is_killed_and_its_child_keeps_the_sockets() -> None:
    with parent("fork") as (process, (*workers, child)):
        os.kill(process.pid, signal.SIGKILL)
        assert assert_nothing_left(process, workers) == ""
        os.kill(child, 0)  # It was there all the time.


@pytest.mark.integration
@pytest.mark.skipif(not PROC.exists(), reason="needs /proc")
def test_shared_memory_has_no_name_that_could_be_left() -> None:
    with parent("steps") as (process, pids):
        for pid in (process.pid, *pids):
            lines = (PROC / str(pid) / "maps").read_text().splitlines()
            shared = [line.split(maxsplit=5) for line in lines if line.split()[1] == "rw-s"]
            mapped = {parts[5] for parts in shared}
            assert mapped == {"/memfd:envs_host_pool (deleted)"}
        os.killpg(process.pid, signal.SIGKILL)
