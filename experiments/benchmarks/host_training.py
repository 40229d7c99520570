"""CREATE Push at the paper's shapes: steps per second of training, and where the time goes.

    python -m experiments.benchmarks.host_training

The process of the learner either chooses actions, or waits for environments, or makes gradient
steps; the environments run in processes of their own, beside the first of these. Evaluations during
training are not in it.
"""

from __future__ import annotations

import statistics
import time
from contextlib import closing

import jax
from absl import flags

from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from jaxnew.storage.metrics import TIME_PREFIX

TASK = flags.DEFINE_string("host_task", "create-push", "A task with environments on the host.")

_PARTS = {
    "act_s": "inference",
    "wait_s": "waiting for environments",
    "learn_s": "gradient steps",
}
_REPRESENTATION_SIZE = 128  # Of CREATE's HVAE (spec method 3).


def main() -> None:
    report = m.Report("host_training")
    report.add_versions("pymunk")
    trainer = _trainers.make_trainer(task=TASK.value, representation_size=_REPRESENTATION_SIZE)
    num_steps = trainer.config.ppo.steps_per_update
    with closing(trainer):
        state, _ = trainer.chunk(trainer.init(), 1)  # Compiles.
        workers = trainer.learner.rollout.environments.pool.worker_pids
        wall_s: list[float] = []
        cpu: dict[str, list[float]] = {"learner's process": [], "environments": []}
        parts: dict[str, list[float]] = {name: [] for name in _PARTS}
        for _ in range(m.REPEATS.value):
            start, own, others = time.perf_counter(), time.process_time(), m.cpu_s_of(workers)
            state, metrics = jax.block_until_ready(trainer.chunk(state, 1))
            wall_s.append(time.perf_counter() - start)
            cpu["learner's process"].append(time.process_time() - own)
            cpu["environments"].append(m.cpu_s_of(workers) - others)
            for name, seconds in parts.items():
                seconds.append(float(metrics[TIME_PREFIX + name]))
    how = f"{m.REPEATS.value} updates after one; {len(workers)} workers; "
    how += _trainers.describe(trainer)
    whole = statistics.median(wall_s)
    report.values(
        "training",
        {"steps_per_s": num_steps / whole, "update_s": whole},
        how=how,
        num_envs=trainer.config.ppo.rollout.num_envs,
    )
    shares = {_PARTS[name]: statistics.median(s) / whole for name, s in parts.items()}
    shares["the rest of the rollout"] = 1.0 - sum(shares.values())
    report.values("shares of the wall clock", shares, how="of medians; one process, in turn")
    spent = {name: 1e6 * statistics.median(s) / num_steps for name, s in cpu.items()}
    report.values("processor time, us per step", spent, how="of all threads and processes")


if __name__ == "__main__":
    m.run_benchmark(main)
