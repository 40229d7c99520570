"""CREATE, one environment: random play with and without drawing, and the share of the physics.

    taskset -c 1 python -m experiments.benchmarks.create

A decision is a try to place a tool and 40 substeps of 1/30 s; episodes start again when they end,
with a new layout and a new set of tools. The share of the physics is the time inside
`pymunk.Space.step`, with the callbacks of the tools, over all of the time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from unittest import mock

import jax
import numpy as np

from envs_host.create import CreateConfig, CreateEnv
from envs_host.create.config import Observation
from envs_host.create.drawing import draw
from envs_host.create.stage import Stage
from envs_host.create.tools import all_tools
from envs_host.create.world import World
from experiments.benchmarks import _measure as m

ARGUMENTS = m.Benchmark(__doc__)
ARGUMENTS.define("list", "levels", ["Push", "Obstacle"], "What is played.")

SUBSTEPS = CreateConfig().physics.substeps
_NUM_TOOLS = 10
_MAX_TRIES = 10_000


def share_of_physics(play: Callable[[], object]) -> float:
    """Processor time inside `Stage.run`, which only calls `Space.step`, over all of the time."""
    run, inside = Stage.run, []

    def timed(stage: Stage, num_substeps: int) -> None:
        start = time.process_time()
        run(stage, num_substeps)
        inside.append(time.process_time() - start)

    with mock.patch.object(Stage, "run", timed):
        _, whole = m.timed(play)
    return sum(inside) / whole.cpu_s


def random_play(env: CreateEnv, seed: int, num_decisions: int) -> int:
    """Plays with uniform tools and positions; the number of episodes that ended."""
    rng = np.random.default_rng(seed)
    indices = rng.integers(env.config.action_set_size, size=num_decisions).tolist()
    positions = rng.uniform(-1.0, 1.0, (num_decisions, 2))
    env.reset(seed=seed)
    num_ends = 0
    for index, position in zip(indices, positions, strict=True):
        _, _, terminated, truncated, _ = env.step({"index": index, "position": position})
        if terminated or truncated:
            num_ends += 1
            env.reset()
    return num_ends


def crowded_env(level: str, num_tools: int) -> CreateEnv:
    """An environment at the start of an episode, with random tools placed in it."""
    config = CreateConfig(observation="none", action_ids="universe")
    env = CreateEnv(level, config=config)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(_MAX_TRIES):
        if len(env.world.tools) == num_tools:
            return env
        tool, (x, y) = all_tools()[rng.integers(config.no_op_id)], rng.uniform(-1, 1, 2).tolist()
        env.world.place(tool, (x, y))
    raise AssertionError(f"No room for {num_tools} tools in {level}.")


def measure_play(report: m.Report, level: str, num_decisions: int) -> None:
    """Random play of one level, drawn and not, and the share of the physics."""
    names: tuple[Observation, ...] = ("gray", "none")
    envs = {name: CreateEnv(level, config=CreateConfig(observation=name)) for name in names}
    play = {k: partial(random_play, env, num_decisions=num_decisions) for k, env in envs.items()}
    timings = report.measure({name: m.Subject(call, _seed_of) for name, call in play.items()})
    for name, timing in timings.items():
        report.timing(
            f"{level}, observation {name}",
            timing,
            work={"decisions": num_decisions, "substeps": num_decisions * SUBSTEPS},
            num_envs=1,
            includes=["auto-reset"] + ["rendering"] * (name != "none"),
            how=f"random play, {num_decisions} decisions, one process",
        )
    share = m.share_saved(timings["gray"], timings["none"])
    report.values(f"{level}, share of drawing", share, how="1 - none / gray")
    report.values(
        f"{level}, share of the physics",
        {"cpu": share_of_physics(partial(play["gray"], seed=0))},
        how="inside Space.step / all, observation gray, auto-reset",
        num_envs=1,
    )


def _seed_of(key: jax.Array) -> tuple[int]:
    return (int(jax.random.bits(key, dtype="uint16")),)


def measure_frames(report: m.Report, num_frames: int) -> None:
    """A gray frame of Push alone, at the start and with ten tools."""
    for num_tools in (0, _NUM_TOOLS):
        world = crowded_env("Push", num_tools).world

        def draw_often(world: World = world) -> None:
            for _ in range(num_frames):
                draw(world.sprites(), "gray")

        name = f"one gray frame, Push with {num_tools} tools"
        report.timing(
            name,
            report.measure({name: m.Subject(draw_often, lambda key: ())})[name],
            work={"frames": num_frames},
            includes=["rendering"],
            how=f"{num_frames} times the same world",
        )


def main() -> None:
    report = m.Report("create", ARGUMENTS)
    report.add_versions("pymunk", "gymnasium")
    for level in ARGUMENTS.levels:
        measure_play(report, level, 20 if report.is_quick else 300)
    measure_frames(report, 10 if report.is_quick else 2000)


if __name__ == "__main__":
    ARGUMENTS.start(main)
