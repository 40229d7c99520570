"""Shape Stacking's engine on CPUs against bare MuJoCo, stepping one world after the other.

python -m experiments.benchmarks.stacking
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs_mjx.shape_stacking import rules, scene
from envs_mjx.shape_stacking.engines import Engine
from envs_mjx.shape_stacking.engines._mujoco_pool import world_model
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from envs_mjx.shape_stacking.rules import Bodies
from envs_mjx.shape_stacking.shapes import NUM_SHAPES
from experiments import _stacking as stacking
from experiments.benchmarks import _measure as m

_SEED = 7
_TOWERS = 20
RATIO = "time of the first over time of the second, both on one core"


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
    models: dict[bytes, mujoco.MjModel] = {}
    for row in shape_ids:
        if row.tobytes() not in models:
            models[row.tobytes()] = world_model(row)
    worlds = [models[row.tobytes()] for row in shape_ids]
    data = {key: mujoco.MjData(model) for key, model in models.items()}

    def loop(qpos: np.ndarray, qvel: np.ndarray) -> None:
        for k, model in enumerate(worlds):
            state = data[shape_ids[k].tobytes()]
            mujoco.mj_resetData(model, state)
            state.qpos[:], state.qvel[:] = qpos[k].ravel(), qvel[k].ravel()
            mujoco.mj_step(model, state, num_steps)

    return loop


def compare(report: m.Report, num_worlds: int, num_steps: int) -> None:
    """Placements in one compiled program, on one core and on all, and the bare loop."""
    engines = {"one core": MujocoC(num_steps, num_threads=1), "all cores": MujocoC(num_steps)}
    bodies, slots, ids = towers(MujocoC(num_steps), min(num_worlds, _TOWERS))
    repeated = np.arange(num_worlds) % len(ids)
    bodies = jax.tree.map(lambda x: jnp.asarray(x)[repeated], bodies)
    place = jax.jit(jax.vmap(rules.place))

    def inputs(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        x = jax.random.uniform(key, (num_worlds, 1), minval=-1.0)
        position = jnp.concatenate([x, jnp.zeros_like(x)], axis=-1)
        placed = place(bodies, slots[repeated], ids[repeated], position)
        return placed.shape_ids, placed.qpos, placed.qvel

    loop = bare_loop(np.asarray(inputs(jax.random.key(0))[0]), num_steps)
    subjects = {name: m.compiled(engine.settle, inputs) for name, engine in engines.items()}
    subjects["bare loop"] = m.Subject(
        lambda _, qpos, qvel: loop(np.asarray(qpos), np.asarray(qvel)), inputs
    )
    timings = m.measure(subjects, m.REPEATS.value)
    for name, timing in timings.items():
        report.timing(
            f"{num_worlds} worlds, {name}",
            timing,
            work={"placements": num_worlds, "physics steps": num_worlds * num_steps},
            num_envs=num_worlds,
            how=f"2 to 11 bodies and a new one, {num_steps} steps of 0.01 s each",
        )
    share = m.ratio(timings["bare loop"], timings["one core"])
    report.values(f"{num_worlds} worlds, bare loop / one core", share, how=RATIO)


def main() -> None:
    report = m.Report("stacking")
    report.add_versions("mujoco")
    num_steps = 5 if m.QUICK.value else scene.SETTLE_STEPS
    for num_worlds in (2,) if m.QUICK.value else (1, 20, 60):
        compare(report, num_worlds, num_steps)


if __name__ == "__main__":
    m.run_benchmark(main)
