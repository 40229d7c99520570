"""CREATE Push at the paper's shapes: steps per second of training, and where the time goes.

    python -m experiments.benchmarks.host_training

The process of the learner either chooses actions, or waits for environments, or makes gradient
steps; the environments run in processes of their own, beside the first of these. Evaluations during
training are not in it.
"""

from __future__ import annotations

import statistics
from functools import partial

from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from jaxnew.rollout.host import HostRollout
from jaxnew.storage.metrics import TIME_PREFIX

ARGUMENTS = m.Benchmark(__doc__)
ARGUMENTS.define("string", "task", "create-push", "A task with environments on the host.")

_PARTS = {
    "act_s": "inference",
    "wait_s": "waiting for environments",
    "learn_s": "gradient steps",
}
_REPRESENTATION_SIZE = 128  # Of CREATE's HVAE.


def main() -> None:
    report = m.Report("host_training", ARGUMENTS)
    report.add_versions("pymunk")
    costs: list[m.Cost] = []
    of_environments: list[float] = []
    parts: dict[str, list[float]] = {name: [] for name in _PARTS}
    with _trainers.make_trainer(report.is_quick, ARGUMENTS.task, "ours", _REPRESENTATION_SIZE) as t:
        assert isinstance(t.rollout, HostRollout)
        state, _ = t.chunk(t.init(), 1)  # Compiles.
        workers = t.rollout.environments.pool.worker_pids  # type: ignore[attr-defined]
        for _ in range(report.repeats):
            before = m.cpu_s_of(workers)
            (state, metrics), cost = m.timed(partial(t.chunk, state, 1))
            costs.append(cost)
            of_environments.append(m.cpu_s_of(workers) - before)
            for name, seconds in parts.items():
                seconds.append(float(metrics[TIME_PREFIX + name]))
    how = f"{report.repeats} updates after one; {len(workers)} workers; {_trainers.describe(t)}"
    whole, steps = m.Cost.median(costs), t.config.ppo.steps_per_update
    speed = {"steps_per_s": steps / whole.wall_s, "update_s": whole.wall_s}
    report.values("training", speed, how=how, num_envs=t.config.ppo.rollout.num_envs)
    shares = {_PARTS[name]: statistics.median(s) / whole.wall_s for name, s in parts.items()}
    shares["the rest of the rollout"] = 1.0 - sum(shares.values())
    report.values("shares of the wall clock", shares, how="of medians; one process, in turn")
    spent = {"learner's process": whole.cpu_s, "environments": statistics.median(of_environments)}
    per_step = {name: 1e6 * seconds / steps for name, seconds in spent.items()}
    report.values("processor time, us per step", per_step, how="of all threads and processes")


if __name__ == "__main__":
    ARGUMENTS.start(main)
