"""A sweep as one program against its members as single runs, on one CPU device and on two.

python -m experiments.benchmarks.sweep
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax

from experiments.benchmarks import _measure as m
from experiments.benchmarks import _trainers
from jaxnew.ppo import TrainState
from jaxnew.sweeping import SweepProgram, member_configs
from jaxnew.trainer import Trainer

ARGUMENTS = m.Benchmark(__doc__)

SEEDS = range(31, 39)
# A grid of the paper's size (appendix, "Hyperparameter Search"): 8 coefficients, 4 seeds each.
GRID = {"entropy_coefficient": (1e-4, 5e-4, 1e-3, 5e-3, 1e-2, 2e-2, 5e-2, 1e-1)}
GRID_SEEDS = SEEDS[:4]
SINGLE_RUNS = "single runs"
GRID_NAME = "grid of 32"
HOW = "time per update and member of the first over that of the second"


def sweep_subject(program: SweepProgram, num_updates: int) -> m.Subject:
    """All members in one program."""
    members = program.init().members

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        keys = jax.device_put(jax.random.split(key, len(program.configs)), program.sharding)
        return replace(members, key=keys), program.hyperparameters

    return m.compiled(lambda *args: program._updates(*args, n=num_updates), inputs)


def singles_subject(trainer: Trainer, num_updates: int) -> m.Subject:
    """The members as runs of `train`, one after the other with one compiled program."""
    start, numbers, actions = trainer.init(), trainer.config.hyperparameters, trainer.training

    def update(state: TrainState) -> Any:
        return trainer.learner.updates(state, numbers, actions, num_updates)

    one = m.compiled(update, lambda key: (replace(start, key=key),))

    def run_all(states: list[TrainState]) -> list[Any]:
        return [jax.block_until_ready(one.call(state)) for state in states]

    def inputs(key: jax.Array) -> tuple[list[TrainState]]:
        return ([replace(start, key=k) for k in jax.random.split(key, len(SEEDS))],)

    return m.Subject(run_all, inputs, one.compilation)


def scaled(timing: m.Timing, factor: float = 1.0, compilations: int = 0) -> m.Timing:
    """Rounds that take `factor` times as long, after compiling so many times."""
    start = (timing.compilation or m.Cost(0.0, 0.0)) * compilations
    return m.Timing(tuple(start + cost * factor for cost in timing.costs))


def main() -> None:
    jax.config.update("jax_num_cpu_devices", 2)
    report = m.Report("sweep", ARGUMENTS)
    trainer = _trainers.make_trainer(report.is_quick)
    num_updates = 1 if report.is_quick else 2
    members = member_configs(trainer.config, list(SEEDS), {})
    grid = member_configs(trainer.config, list(GRID_SEEDS), GRID)
    programs = {
        f"{len(devices)} device(s), members {how}": SweepProgram.of(
            trainer, members, devices, at_once
        )
        for devices in (jax.devices()[:1], jax.devices())
        for at_once, how in ((1, "in turn"), (len(members), "side by side"))
    }
    programs[GRID_NAME] = SweepProgram.of(trainer, grid, jax.devices(), 1)
    timings = report.measure(
        {SINGLE_RUNS: singles_subject(trainer, num_updates)}
        | {name: sweep_subject(program, num_updates) for name, program in programs.items()}
    )
    apart = timings[SINGLE_RUNS]
    for name, timing in timings.items():
        num_members = len(programs[name].configs) if name in programs else len(members)
        report.timing(
            name,
            timing,
            work={"steps": num_members * num_updates * trainer.config.ppo.steps_per_update},
            num_envs=num_members * trainer.config.ppo.rollout.num_envs,
            includes=["auto-reset", "policy", "update"],
            how=f"{num_updates} updates of each member; {_trainers.describe(trainer)}",
        )
        if name == SINGLE_RUNS:
            continue
        more, case = num_members / len(members), f"{SINGLE_RUNS} / {name}"
        report.ratio(case, scaled(apart, more), timing, how=f"{HOW}; without compiling")
        compiling = scaled(apart, more, num_members), scaled(timing, compilations=1)
        how = f"{HOW}; every single run in a process that compiles, {num_updates} updates"
        report.ratio(f"{case}, with compiling", *compiling, how=how)


if __name__ == "__main__":
    ARGUMENTS.start(main)
