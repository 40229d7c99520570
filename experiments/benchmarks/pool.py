"""Host environments: the pool against a plain loop and against gymnasium's AsyncVectorEnv.

python -m experiments.benchmarks.pool
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from gymnasium.vector import AsyncVectorEnv

from envs_host.pool import HostPool
from experiments.benchmarks import _measure as m
from experiments.benchmarks._host_toys import Toy

FACTORY = "experiments.benchmarks._host_toys:host_toy"
NUM_WORKERS = (1, 2)
WORK_MS = {"empty": 0.0, "1 ms of work": 1.0}
PEER, LOOP = "gymnasium AsyncVectorEnv", "plain loop"
Decide = Callable[[np.ndarray, np.ndarray], object]


def main() -> None:
    num_envs, num_steps = (4, 3) if m.QUICK.value else (32, 100)
    with contextlib.ExitStack() as stack:
        # Forks one process per environment, which must come before the devices are in use.
        peers = {name: make_peer(stack, num_envs, work) for name, work in WORK_MS.items()}
        report = m.Report("pool")
        report.add_versions("gymnasium")
        for name, work_ms in WORK_MS.items():
            deciders = {LOOP: make_loop(num_envs, work_ms), PEER: peers[name]}
            for num_workers in NUM_WORKERS:
                pool = HostPool(FACTORY, {"work_ms": work_ms}, num_envs, num_workers, seed=0)
                stack.enter_context(pool).reset()
                deciders[pool_name(num_workers)] = pool.step
            compare(report, name, deciders, num_envs, num_steps)


def pool_name(num_workers: int) -> str:
    return f"pool, {num_workers} worker{'s' * (num_workers > 1)}"


def make_loop(num_envs: int, work_ms: float) -> Decide:
    """The environments in this process, their pictures copied into a batch."""
    envs = [Toy(work_ms) for _ in range(num_envs)]
    batch = np.zeros((num_envs, 84, 84), np.uint8)

    def decide(ids: np.ndarray, positions: np.ndarray) -> None:
        for i, env in enumerate(envs):
            batch[i] = env.step({"id": ids[i], "position": positions[i]})[0]

    return decide


def make_peer(stack: contextlib.ExitStack, num_envs: int, work_ms: float) -> Decide:
    with warnings.catch_warnings():
        # jax warns of any fork after its import; the children never use it.
        warnings.filterwarnings("ignore", message=r"os\.fork\(\)", category=RuntimeWarning)
        envs = AsyncVectorEnv([partial(Toy, work_ms)] * num_envs, shared_memory=True, copy=False)
    stack.callback(envs.close)
    envs.reset()
    return lambda ids, positions: envs.step({"id": ids, "position": positions})


def compare(
    report: m.Report, name: str, deciders: dict[str, Decide], num_envs: int, num_steps: int
) -> None:
    """Times the same decisions with each, and reports what each costs beyond the work itself."""

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        return rng.integers(0, 100, num_envs), rng.uniform(-1, 1, (num_envs, 2)).astype(np.float32)

    def subject(decide: Decide) -> m.Subject:
        def call(ids: np.ndarray, positions: np.ndarray) -> None:
            for _ in range(num_steps):
                decide(ids, positions)

        return m.Subject(call, inputs)

    subjects = {case: subject(decide) for case, decide in deciders.items()}
    timings = m.measure(subjects, m.REPEATS.value)
    for case, timing in timings.items():
        report.timing(
            f"{name}, {case}",
            timing,
            work={"decisions": num_envs * num_steps},
            num_envs=num_envs,
            includes=["transfer"],
            how="84 x 84 uint8 pictures; no policy, no reset; cpu is that of this process alone",
        )
    for num_workers in NUM_WORKERS:
        case = pool_name(num_workers)
        report.values(
            f"{name}, {PEER} / {case}",
            m.ratio(timings[PEER], timings[case]),
            how="wall clock for the same decisions; all of it is overhead where the environment "
            "is empty; cpu is that of this process alone",
            num_envs=num_envs,
        )


if __name__ == "__main__":
    m.run_benchmark(main)
