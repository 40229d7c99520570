"""A process with a pool, for the tests of what is left of it: `python -m ... KIND`.

It prints the workers' process ids once they have stepped, and then
  steps    steps for ever, within `with`;
  bare     the same, and nothing closes the pool;
  raise    raises an exception, and nothing closes the pool;
  abort    ends as by a crash;
  hang     steps environments that never answer;
  fork     has forked a child that holds all its descriptors, and steps for ever.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time

import numpy as np

from envs_host.pool import HostPool
from tests.envs_host.pool_toys import FAULTY


def main(kind: str) -> None:
    # Where the tests themselves run in a shell's background, Ctrl-C is ignored from the start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    pool = HostPool(FAULTY, {"fault": "hang"}, 4, 2, 0)
    if kind == "bare":
        step_for_ever(pool, [])
    elif kind == "raise":
        step_for_ever(pool, [], num_steps=3)
        raise ZeroDivisionError("an error of the parent")
    elif kind == "abort":
        step_for_ever(pool, [], num_steps=3)
        os.abort()
    elif kind == "hang":
        pool.reset()
        pool.send(0, np.array([99, 99]), np.zeros((2, 2)))
        announce([*pool.worker_pids])
        pool.receive(0)
    elif kind == "fork":
        child = os.fork()
        if child == 0:
            os.closerange(0, 3)  # What the test waits for; the pool's sockets stay open.
            time.sleep(1000.0)
        step_for_ever(pool, [child])
    else:
        with pool:
            step_for_ever(pool, [])


def step_for_ever(pool: HostPool, others: list[int], num_steps: int | None = None) -> None:
    pool.reset()
    steps = 0
    while steps != num_steps:
        pool.step(np.zeros(4, int), np.zeros((4, 2)))
        steps += 1
        if steps == 3:
            announce([*pool.worker_pids, *others])


def announce(pids: list[int]) -> None:
    print(json.dumps(pids), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
