"""Shape Stacking's engines: MuJoCo's C engine against bare MuJoCo, and MJX against the C engine.

    python -m experiments.benchmarks.stacking
    python -m experiments.benchmarks.stacking --engines=mjx --mjx_worlds=64,1024,4096

MJX settles for a fifth of the time, since a step costs the same at any moment; its placements per
second are steps over 300. All of it takes about five minutes on one quiet core of 2026.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from envs_mjx.shape_stacking import rules, scene
from envs_mjx.shape_stacking.engines import Engine, make_engine
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from envs_mjx.shape_stacking.engines.mujoco_pool import world_model
from envs_mjx.shape_stacking.rules import Bodies
from envs_mjx.shape_stacking.shapes import NUM_SHAPES
from experiments.benchmarks import _measure as m
from experiments.untrained import towers as stacking

ARGUMENTS = m.Benchmark(__doc__)
ARGUMENTS.define("list", "engines", ["mujoco", "mjx"], "Which engines.")
ARGUMENTS.define("list", "mjx_worlds", ["1", "20", "60"], "Worlds per call of MJX.")
ARGUMENTS.define("integer", "mjx_steps", 60, "Physics steps of a call of MJX.", lower_bound=1)

_SEED = 7
_TOWERS = 20


def towers(engine: Engine, count: int) -> tuple[Bodies, np.ndarray, np.ndarray]:
    """Random play at all stages of an episode: bodies at rest, then the slot and id of a new one.

    Ten worlds in a row have 0 to 9 shapes on the table, the first has 4.
    """
    rng = np.random.default_rng(_SEED)
    num_dropped = (4 + 7 * np.arange(count)) % scene.NUM_PLACEMENTS
    ids = rng.integers(0, NUM_SHAPES, (count, scene.NUM_PLACEMENTS)).astype(np.int32)
    x = rng.uniform(-1.0, 1.0, ids.shape)
    drops = [
        [(int(i), float(where)) for i, where in zip(ids[k, :n], x[k, :n], strict=True)]
        for k, n in enumerate(num_dropped)
    ]
    cylinders = rng.choice(rules.START_CYLINDERS, count)
    gaps = rng.uniform(*rules.START_GAP, count)
    bodies = stacking.start_scenes(cylinders.tolist(), [0.0] * count, gaps.tolist())
    bodies = stacking.stack(engine, bodies, drops)
    new = ids[np.arange(count), num_dropped]
    return bodies, scene.NUM_START_CYLINDERS + num_dropped.astype(np.int32), new


def bare_loop(shape_ids: np.ndarray, num_steps: int) -> Callable[[Any, Any], None]:
    """Steps a model of its own for each world, in this thread; the models are made beforehand."""
    models = {row.tobytes(): world_model(row) for row in np.unique(shape_ids, axis=0)}
    made = {key: (model, mujoco.MjData(model)) for key, model in models.items()}
    worlds = [made[row.tobytes()] for row in shape_ids]

    def loop(qpos: np.ndarray, qvel: np.ndarray) -> None:
        for k, (model, state) in enumerate(worlds):
            mujoco.mj_resetData(model, state)
            state.qpos[:], state.qvel[:] = qpos[k].ravel(), qvel[k].ravel()
            mujoco.mj_step(model, state, num_steps)

    return loop


Inputs = Callable[[jax.Array], tuple[jax.Array, jax.Array, jax.Array]]


def placements(num_worlds: int) -> Inputs:
    """Worlds at all stages of an episode in which a shape has just been let go, by key."""
    before = MujocoC(5 if ARGUMENTS.quick else scene.SETTLE_STEPS)
    bodies, slots, ids = towers(before, min(num_worlds, _TOWERS))
    repeated = np.arange(num_worlds) % len(ids)
    bodies = jax.tree.map(lambda x: jnp.asarray(x)[repeated], bodies)
    place = jax.jit(jax.vmap(rules.place))

    def inputs(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        x = jax.random.uniform(key, (num_worlds, 1), minval=-1.0)
        position = jnp.concatenate([x, jnp.zeros_like(x)], axis=-1)
        placed = place(bodies, slots[repeated], ids[repeated], position)
        return placed.shape_ids, placed.qpos, placed.qvel

    return inputs


def compare(
    report: m.Report,
    engines: dict[str, Engine],
    num_worlds: int,
    num_steps: int,
    has_bare_loop: bool = False,
) -> None:
    """Placements in one compiled program of each engine; before them, in the bare loop. A line for
    each, and the ratio of the first two.
    """
    inputs, subjects = placements(num_worlds), {}
    if has_bare_loop:
        loop = bare_loop(np.asarray(inputs(jax.random.key(0))[0]), num_steps)
        subjects["bare loop"] = m.Subject(
            lambda _, qpos, qvel: loop(np.asarray(qpos), np.asarray(qvel)), inputs
        )
    subjects |= {name: m.compiled(engine.settle, inputs) for name, engine in engines.items()}
    timings, steps = report.measure(subjects), num_worlds * num_steps
    for name, timing in timings.items():
        report.timing(
            f"{num_worlds} worlds, {name}",
            timing,
            work={"placements": steps / scene.SETTLE_STEPS, "physics steps": steps},
            num_envs=num_worlds,
            how=f"2 to 11 bodies and a new one, {num_steps} steps of 0.01 s each",
        )
    one, other, *_ = timings
    report.ratio(f"{num_worlds} worlds, {one} / {other}", timings[one], timings[other])


def cached_compilation(report: m.Report, num_worlds: int, num_steps: int) -> None:
    """What a second process would wait for, with a compilation cache on disk."""
    arguments = placements(num_worlds)(jax.random.key(0))
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_enable_compilation_cache", True)
        jax.config.update("jax_compilation_cache_dir", folder)
        for name in ("cold", "from the cache"):
            jax.clear_caches()
            compilation_cache.reset_cache()  # It remembers that it was off.
            program = jax.jit(make_engine("mjx", settle_steps=num_steps).settle)
            lowered, tracing = m.timed(partial(program.lower, *arguments))
            compilation = m.timed(lowered.compile)[1]
            values = {"tracing cpu-s": tracing.cpu_s, "compilation cpu-s": compilation.cpu_s}
            report.values(f"MJX program, {num_worlds} worlds, {name}", values, how="one settling")
        jax.config.update("jax_enable_compilation_cache", False)


def main() -> None:
    report = m.Report("stacking", ARGUMENTS)
    report.add_versions("mujoco", "mujoco-mjx")
    if "mujoco" in ARGUMENTS.engines:
        num_steps = 5 if report.is_quick else scene.SETTLE_STEPS
        for num_worlds in (2,) if report.is_quick else (1, 20, 60):
            one, every = MujocoC(num_steps, num_threads=1), MujocoC(num_steps)
            in_c: dict[str, Engine] = {"one core": one, "all cores": every}
            compare(report, in_c, num_worlds, num_steps, has_bare_loop=True)
    if "mjx" in ARGUMENTS.engines:
        num_steps = 5 if report.is_quick else ARGUMENTS.mjx_steps
        worlds = [2] if report.is_quick else [int(number) for number in ARGUMENTS.mjx_worlds]
        for num_worlds in worlds:
            mjx, one = make_engine("mjx", settle_steps=num_steps), MujocoC(num_steps, num_threads=1)
            compare(report, {"MJX": mjx, "C on one core": one}, num_worlds, num_steps)
        if not report.is_quick:
            cached_compilation(report, worlds[0], num_steps)


if __name__ == "__main__":
    ARGUMENTS.start(main)
