"""A sweep as one vmapped program against its members one after the other, and on two CPU devices.

    python -m experiments.benchmarks.sweep

It starts itself once more with two virtual CPU devices, where one device is compared with two.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import jax
from absl import flags

from experiments._training import Trainer
from experiments.benchmarks import _grid_world
from experiments.benchmarks import _measure as m
from experiments.sweep import Sweep, member_configs
from jaxnew.ppo import Learner, TrainState

COMPARES_DEVICES = flags.DEFINE_bool("compares_devices", False, "Set where it starts itself.")
NUM_MEMBERS = 8
RATIO = "time of the first over time of the second, for the same updates"


def make_sweep(trainer: Trainer, num_members: int, devices: list[jax.Device]) -> Sweep:
    """Members that differ in their seed, with the microbatches that a sweep chooses."""
    seeds = [31 + member for member in range(num_members)]
    configs = member_configs(trainer.config, seeds, [])
    learner = Learner(trainer.learner.rollout, configs[0].ppo)
    return Sweep.of(replace(trainer, config=configs[0], learner=learner), configs, devices)


def sweep_subject(sweep: Sweep, num_updates: int) -> m.Subject:
    """All members in one program."""
    members = sweep.init().members

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        keys = jax.device_put(jax.random.split(key, len(sweep.configs)), sweep.sharding)
        return replace(members, key=keys), sweep.hyperparameters

    return m.compiled(lambda *args: sweep._updates(*args, n=num_updates), inputs)


def singles_subject(trainer: Trainer, num_members: int, num_updates: int) -> m.Subject:
    """The members as runs of `train`, one after the other with one compiled program."""
    start = trainer.init()
    numbers, table, pool = trainer.config.hyperparameters, trainer.table, trainer.pools["train"]

    def update(state: TrainState) -> Any:
        return trainer.learner.updates(state, numbers, table, pool, num_updates)

    one = m.compiled(update, lambda key: (replace(start, key=key),))

    def run_all(states: list[TrainState]) -> list[Any]:
        return [jax.block_until_ready(one.call(state)) for state in states]

    def inputs(key: jax.Array) -> tuple[list[TrainState]]:
        return ([replace(start, key=k) for k in jax.random.split(key, num_members)],)

    return m.Subject(run_all, inputs, one.compilation)


def with_compilation(timing: m.Timing, times: int = 1) -> m.Timing:
    """Rounds that each begin with compiling, `times` times."""
    assert timing.compilation is not None
    wall, cpu = timing.compilation.wall_s, timing.compilation.cpu_s
    return m.Timing(
        tuple(times * wall + seconds for seconds in timing.wall_s),
        tuple(times * cpu + seconds for seconds in timing.cpu_s),
    )


def compare_with_singles(report: m.Report, trainer: Trainer, num_updates: int) -> None:
    """One vmapped program against single runs."""
    sweep = make_sweep(trainer, NUM_MEMBERS, jax.devices()[:1])
    timings = m.measure(
        {
            "one program": sweep_subject(sweep, num_updates),
            "one after the other": singles_subject(trainer, NUM_MEMBERS, num_updates),
        },
        m.REPEATS.value,
    )
    record(report, trainer, timings, num_updates)
    together, apart = timings["one program"], timings["one after the other"]
    case = "one after the other / one program"
    report.values(case, m.ratio(apart, together), how=f"{RATIO}; without compiling")
    values = m.ratio(with_compilation(apart), with_compilation(together))
    how = f"{RATIO}; each program compiled once, {num_updates} updates"
    report.values(f"{case}, with compiling", values, how=how)
    values = m.ratio(with_compilation(apart, NUM_MEMBERS), with_compilation(together))
    how = f"{RATIO}; every single run in a process that compiles, {num_updates} updates"
    report.values(f"{case}, {NUM_MEMBERS} processes", values, how=how)


def compare_devices(report: m.Report, trainer: Trainer, num_updates: int) -> None:
    """The sweep on one of the devices against all of them."""
    devices = jax.devices()
    sweeps = {
        f"on {len(subset)} of {len(devices)} CPU devices": make_sweep(trainer, NUM_MEMBERS, subset)
        for subset in (devices[:1], devices)
    }
    timings = m.measure(
        {name: sweep_subject(sweep, num_updates) for name, sweep in sweeps.items()},
        m.REPEATS.value,
    )
    record(report, trainer, timings, num_updates)
    one, several = timings.values()
    report.values(f"one device / {len(devices)} devices", m.ratio(one, several), how=RATIO)


def record(
    report: m.Report, trainer: Trainer, timings: dict[str, m.Timing], num_updates: int
) -> None:
    steps = NUM_MEMBERS * num_updates * trainer.config.ppo.steps_per_update
    for name, timing in timings.items():
        report.timing(
            f"{NUM_MEMBERS} seeds {name}",
            timing,
            work={"steps": steps},
            num_envs=NUM_MEMBERS * trainer.config.ppo.rollout.num_envs,
            includes=["auto-reset", "policy", "update"],
            how=f"{num_updates} updates of each seed; {_grid_world.describe(trainer)}",
        )


def run_with_two_devices() -> int:
    """Starts this module again on two virtual CPU devices; its exit status."""
    flags_of_xla = os.environ.get("XLA_FLAGS", "")
    environment = {
        **os.environ,
        # XLA's threads. With as few of them as devices, making the first parameters on several
        # virtual CPU devices was seen to wait for itself for ever (jax 0.10.2).
        "NPROC": str(max(4, os.cpu_count() or 1)),
        "XLA_FLAGS": f"{flags_of_xla} --xla_force_host_platform_device_count=2".strip(),
        "JAX_PLATFORMS": "cpu",
    }
    command = [sys.executable, "-m", "experiments.benchmarks.sweep", "--compares_devices"]
    command += [*sys.argv[1:]]
    return subprocess.run(command, env=environment, check=False).returncode


def main() -> None:
    report = m.Report("sweep")
    trainer = _grid_world.make_trainer()
    num_updates = 1 if m.QUICK.value else 2
    if COMPARES_DEVICES.value:
        compare_devices(report, trainer, num_updates)
        return
    compare_with_singles(report, trainer, num_updates)
    status = run_with_two_devices()
    if status:
        sys.exit(status)


if __name__ == "__main__":
    m.run_benchmark(main)
