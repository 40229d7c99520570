"""A sweep as one program against its members as single runs, on one CPU device and on two.

python -m experiments.benchmarks.sweep
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax

from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from experiments.pipeline.training import Trainer
from experiments.sweep import Sweep, member_configs
from jaxnew.ppo import TrainState

NUM_MEMBERS = 8
# A grid of the paper's size (appendix, "Hyperparameter Search"): 8 coefficients, 4 seeds each.
GRID = "entropy_coefficient=1e-4,5e-4,1e-3,5e-3,1e-2,2e-2,5e-2,1e-1"
GRID_SEEDS = 4
SINGLE_RUNS = "single runs"
GRID_NAME = "one program, grid of 32"
RATIO = "time of the first over time of the second, for the same updates"


def make_sweep(
    trainer: Trainer, devices: list[jax.Device], at_once: int, has_grid: bool = False
) -> Sweep:
    """Members that differ in their seed, or a grid of hyper-parameters and seeds."""
    num_seeds = GRID_SEEDS if has_grid else NUM_MEMBERS
    seeds = [31 + member for member in range(num_seeds)]
    configs = member_configs(trainer.config, seeds, [GRID] if has_grid else [])
    return Sweep.of(trainer, configs, devices, at_once)


def sweep_subject(sweep: Sweep, num_updates: int) -> m.Subject:
    """All members in one program."""
    members = sweep.init().members

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        keys = jax.device_put(jax.random.split(key, len(sweep.configs)), sweep.sharding)
        return replace(members, key=keys), sweep.hyperparameters

    return m.compiled(lambda *args: sweep._updates(*args, n=num_updates), inputs)


def singles_subject(trainer: Trainer, num_updates: int) -> m.Subject:
    """The members as runs of `train`, one after the other with one compiled program."""
    start = trainer.init()
    numbers, table, pool = trainer.config.hyperparameters, trainer.table, trainer.pools["train"]

    def update(state: TrainState) -> Any:
        return trainer.learner.updates(state, numbers, table, pool, num_updates)

    one = m.compiled(update, lambda key: (replace(start, key=key),))

    def run_all(states: list[TrainState]) -> list[Any]:
        return [jax.block_until_ready(one.call(state)) for state in states]

    def inputs(key: jax.Array) -> tuple[list[TrainState]]:
        return ([replace(start, key=k) for k in jax.random.split(key, NUM_MEMBERS)],)

    return m.Subject(run_all, inputs, one.compilation)


def with_compilation(timing: m.Timing, times: int = 1) -> m.Timing:
    """Rounds that each begin with compiling, `times` times."""
    assert timing.compilation is not None
    wall, cpu = timing.compilation.wall_s, timing.compilation.cpu_s
    return m.Timing(
        tuple(times * wall + seconds for seconds in timing.wall_s),
        tuple(times * cpu + seconds for seconds in timing.cpu_s),
    )


def subjects_of(trainer: Trainer, num_updates: int) -> dict[str, m.Subject]:
    """Single runs, and the sweep on one device or all, its members in turn or side by side."""
    subjects = {SINGLE_RUNS: singles_subject(trainer, num_updates)}
    for devices in (jax.devices()[:1], jax.devices()):
        for at_once, how in ((1, "in turn"), (NUM_MEMBERS, "side by side")):
            sweep = make_sweep(trainer, devices, at_once)
            name = f"one program, {len(devices)} device(s), {how}"
            subjects[name] = sweep_subject(sweep, num_updates)
    grid = make_sweep(trainer, jax.devices(), 1, has_grid=True)
    subjects[GRID_NAME] = sweep_subject(grid, num_updates)
    return subjects


def compare(
    report: m.Report, name: str, together: m.Timing, apart: m.Timing, num_updates: int
) -> None:
    """Records how many times faster than single runs a sweep is."""
    case = f"{SINGLE_RUNS} / {name}"
    report.values(case, m.ratio(apart, together), how=f"{RATIO}; without compiling")
    values = m.ratio(with_compilation(apart, NUM_MEMBERS), with_compilation(together))
    how = f"{RATIO}; every single run in a process that compiles, {num_updates} updates"
    report.values(f"{case}, with compiling", values, how=how)


def record(
    report: m.Report, trainer: Trainer, timings: dict[str, m.Timing], num_updates: int
) -> None:
    for name, timing in timings.items():
        num_members = 32 if name == GRID_NAME else NUM_MEMBERS
        steps = num_members * num_updates * trainer.config.ppo.steps_per_update
        report.timing(
            name if name == GRID_NAME else f"{NUM_MEMBERS} seeds {name}",
            timing,
            work={"steps": steps},
            num_envs=num_members * trainer.config.ppo.rollout.num_envs,
            includes=["auto-reset", "policy", "update"],
            how=f"{num_updates} updates of each seed; {_trainers.describe(trainer)}",
        )


def main() -> None:
    jax.config.update("jax_num_cpu_devices", 2)
    report = m.Report("sweep")
    trainer = _trainers.make_trainer()
    num_updates = 1 if m.QUICK.value else 2
    timings = m.measure(subjects_of(trainer, num_updates), m.REPEATS.value)
    record(report, trainer, timings, num_updates)
    for name, timing in timings.items():
        if name == GRID_NAME:  # Four times the work of the single runs.
            values = {c: 4.0 * v for c, v in m.ratio(timings[SINGLE_RUNS], timing).items()}
            how = "time per update and member of the first over that of the second; no compiling"
            report.values(f"{SINGLE_RUNS} / {name}", values, how=how)
        elif name != SINGLE_RUNS:
            compare(report, name, timing, timings[SINGLE_RUNS], num_updates)


if __name__ == "__main__":
    m.run_benchmark(main)
