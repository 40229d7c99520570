"""Host environments: the pool against a plain loop and against gymnasium's AsyncVectorEnv.

python -m experiments.benchmarks.pool
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from gymnasium.vector import AsyncVectorEnv

from envs_host.pool import HostPool
from experiments.benchmarks import _measure as m
from experiments.benchmarks._host_toys import Toy

ARGUMENTS = m.Benchmark(__doc__)

FACTORY = "experiments.benchmarks._host_toys:host_toy"
NUM_WORKERS = (1, 2)
EMPTY, WORKING = "empty", "1 ms of work"
PEER, LOOP = "gymnasium AsyncVectorEnv", "plain loop"


@dataclass(frozen=True)
class Way:
    """A way to step environments.

    Attributes:
      decide: one decision in all, from ids [N] and positions [N, 2].
      pids: the processes besides this one that it uses.
    """

    decide: Callable[[np.ndarray, np.ndarray], object]
    pids: tuple[int, ...] = ()


def main() -> None:
    is_quick = ARGUMENTS.quick
    num_envs = 4 if is_quick else 32
    num_steps = {EMPTY: 3, WORKING: 3} if is_quick else {EMPTY: 300, WORKING: 10}
    work_ms = {EMPTY: 0.0, WORKING: 1.0}
    with contextlib.ExitStack() as stack:
        # Forks one process per environment, which must come before the devices are in use.
        peers = {name: make_peer(stack, num_envs, work) for name, work in work_ms.items()}
        report = m.Report("pool", ARGUMENTS)
        report.add_versions("gymnasium")
        for name, work in work_ms.items():
            ways = {LOOP: make_loop(num_envs, work), PEER: peers[name]}
            for num_workers in NUM_WORKERS:
                pool = HostPool(FACTORY, {"work_ms": work}, num_envs, num_workers, seed=0)
                stack.enter_context(pool).reset()
                ways[pool_name(num_workers)] = Way(pool.step, pool.worker_pids)
            compare(report, name, ways, num_envs, num_steps[name])


def pool_name(num_workers: int) -> str:
    return f"pool, {num_workers} worker{'s' * (num_workers > 1)}"


def make_loop(num_envs: int, work_ms: float) -> Way:
    """The environments in this process, their pictures copied into a batch."""
    envs = [Toy(work_ms) for _ in range(num_envs)]
    batch = np.zeros((num_envs, 84, 84), np.uint8)

    def decide(ids: np.ndarray, positions: np.ndarray) -> None:
        for i, env in enumerate(envs):
            batch[i] = env.step({"id": ids[i], "position": positions[i]})[0]

    return Way(decide)


def make_peer(stack: contextlib.ExitStack, num_envs: int, work_ms: float) -> Way:
    with warnings.catch_warnings():
        # jax warns of any fork after its import; the children never use it.
        warnings.filterwarnings("ignore", message=r"os\.fork\(\)", category=RuntimeWarning)
        envs = AsyncVectorEnv([partial(Toy, work_ms)] * num_envs, shared_memory=True, copy=False)
    stack.callback(envs.close)
    envs.reset()
    return Way(
        lambda ids, positions: envs.step({"id": ids, "position": positions}),
        tuple(process.pid for process in envs.processes if process.pid is not None),
    )


def compare(
    report: m.Report, name: str, ways: dict[str, Way], num_envs: int, num_steps: int
) -> None:
    """Times the same decisions in each way."""

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        return rng.integers(0, 100, num_envs), rng.uniform(-1, 1, (num_envs, 2)).astype(np.float32)

    def subject(way: Way) -> m.Subject:
        def call(ids: np.ndarray, positions: np.ndarray) -> None:
            for _ in range(num_steps):
                way.decide(ids, positions)

        return m.Subject(call, inputs)

    num_decisions = num_envs * num_steps
    before = {case: m.cpu_s_of(way.pids) for case, way in ways.items()}
    timings = report.measure({case: subject(way) for case, way in ways.items()})
    for case, timing in timings.items():
        report.timing(
            f"{name}, {case}",
            timing,
            work={"decisions": num_decisions},
            num_envs=num_envs,
            includes=["transfer"],
            how="84 x 84 uint8 pictures; no policy, no reset; cpu is that of this process alone",
        )
    cpu_us = {}
    for case, way in ways.items():
        # The others are idle but for the calls, of which one was not counted.
        children_s = (m.cpu_s_of(way.pids) - before[case]) / (report.repeats + 1)
        cpu_us[case] = 1e6 * (timings[case].median.cpu_s + children_s) / num_decisions
    if name == EMPTY:  # Elsewhere the differences are those of the work.
        report_overheads(report, timings, cpu_us, num_envs, num_decisions)


def report_overheads(
    report: m.Report,
    timings: dict[str, m.Timing],
    cpu_us: dict[str, float],
    num_envs: int,
    num_decisions: int,
) -> None:
    """What a decision costs beyond the plain loop, and the peer's overhead over the pool's."""
    beyond = {
        case: {
            "wall_us": 1e6 * (timing.median - timings[LOOP].median).wall_s / num_decisions,
            "cpu_us": cpu_us[case] - cpu_us[LOOP],
        }
        for case, timing in timings.items()
        if case != LOOP
    }
    how = (
        "microseconds of one decision in one environment beyond those of the plain loop; cpu: of "
        "all processes; wall is below zero where processes share work"
    )
    for case, values in beyond.items():
        report.values(f"{EMPTY}, overhead of {case}", values, how=how, num_envs=num_envs)
    how = "cpu is that of all processes, which other load disturbs less"
    for case in map(pool_name, NUM_WORKERS):
        values = {clock[:-3]: beyond[PEER][clock] / us for clock, us in beyond[case].items()}
        report.values(f"{EMPTY}, overhead of {PEER} / {case}", values, how=how, num_envs=num_envs)


if __name__ == "__main__":
    ARGUMENTS.start(main)
