"""Towers from lists of drops, on any engine, and the figures that are known of
some (docs/shape_stacking.md, "Reference figures")."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking import rules, scene, shape_library
from envs_mjx.shape_stacking.engines import Engine
from envs_mjx.shape_stacking.rules import Bodies
from envs_mjx.shape_stacking.shapes import shape_name
from envs_mjx.shape_stacking.solids import CLASS_NAMES

# In place of a shape's id: nothing is dropped, but 3 s go by (a repeated shape, a stop).
SETTLE_ONLY = -1

Drop = tuple[int, float]  # Shape's id, or `SETTLE_ONLY`, and x in metres.


def start_scenes(
    cylinder_ids: Sequence[int], centers: Sequence[float], gaps: Sequence[float]
) -> Bodies:
    """Start scenes of n worlds, see `rules.start`."""
    as_floats = [jnp.asarray(values, jnp.float32) for values in (centers, gaps)]
    return jax.vmap(rules.start)(jnp.asarray(cylinder_ids, jnp.int32), *as_floats)


def empty_scenes(count: int) -> Bodies:
    """Worlds without any body."""
    qpos = jnp.tile(jnp.asarray(scene.parked_qpos()), (count, 1, 1))
    ids = jnp.full((count, scene.NUM_SLOTS), -1, jnp.int32)
    return Bodies(ids, qpos, jnp.zeros((count, scene.NUM_SLOTS, 6), jnp.float32))


def stack(engine: Engine, bodies: Bodies, drops: Sequence[Sequence[Drop]]) -> Bodies:
    """Drops shapes one after the other, each followed by a settling.

    Args:
      engine: settles.
      bodies: of n worlds.
      drops: of each world; worlds with fewer drops than others stay as they are when done.

    Raises:
      RuntimeError: a simulation failed.
    """
    slots = np.full(len(drops), scene.NUM_START_CYLINDERS, np.int32)
    for k in range(max(map(len, drops), default=0)):
        is_running = np.array([len(row) > k for row in drops])
        now = [row[k] if len(row) > k else (SETTLE_ONLY, 0.0) for row in drops]
        ids = np.array([drop[0] for drop in now], np.int32)
        x = np.array([drop[1] for drop in now], np.float32)
        placed = _place(bodies, slots, ids, np.stack([x, np.zeros_like(x)], axis=-1))
        placed = _chosen(ids >= 0, placed, bodies)
        bodies = _chosen(is_running, settled(engine, placed), bodies)
        slots = slots + (ids >= 0)
    return bodies


def settled(engine: Engine, bodies: Bodies) -> Bodies:
    """The same bodies after one settling.

    Raises:
      RuntimeError: a simulation failed.
    """
    qpos, qvel, ok = engine.settle(bodies.shape_ids, bodies.qpos, bodies.qvel)
    if not np.all(ok):
        raise RuntimeError(f"{engine.name} failed in the worlds {np.flatnonzero(~np.asarray(ok))}.")
    return Bodies(bodies.shape_ids, qpos, qvel)


_place = jax.jit(jax.vmap(rules.place))


@jax.vmap
def _chosen(is_new: jax.Array | np.ndarray, new: Bodies, old: Bodies) -> Bodies:
    """The worlds of `new` where bool[n] `is_new` is true, those of `old` elsewhere."""
    return jax.tree.map(lambda one, other: jnp.where(is_new, one, other), new, old)


@dataclass(frozen=True)
class Row:
    """One measured figure.

    Attributes:
      check: number in the list of reference figures.
      what: was measured, m.
      spec: value there, or what it says in words.
      tolerance: how far off it may be; None where nothing is asserted.
      value: measured.
    """

    check: int
    what: str
    spec: float | str
    tolerance: float | None
    value: float


@dataclass(frozen=True)
class _Case:
    """A tower and what is known of it.

    Attributes:
      check: number in the list of reference figures.
      drops: the tower.
      expected: by name: `height`, `reward`, and `x1`, `z1`, `x2`, ... of the drops in order.
      tolerance: of all of them.
      cylinder: id of the start cylinders at x = -0.65 and 0.65.
    """

    check: int
    drops: tuple[Drop, ...]
    expected: dict[str, float | str]
    tolerance: float | None = 0.005
    cylinder: int = 799


_LEFT = -0.65
_REST = 0.001  # Nothing moves: rounding, and contacts that give way a little.
_CASES = (
    _Case(4, (), {"height": 0.328, "reward": 0.164}, _REST, 798),
    _Case(4, (), {"height": 0.342, "reward": 0.171}, _REST),
    _Case(4, (), {"height": 0.355, "reward": 0.178}, _REST, 800),
    _Case(6, ((690, _LEFT),), {"z1": 0.482, "height": 0.982, "reward": 0.732}),
    _Case(7, ((290, 0.0),), {"z1": 0.579, "height": 1.079, "reward": 0.829}),
    _Case(7, ((290, 0.0), (594, 0.0)), {"z2": 1.455, "height": 1.955, "reward": 1.486}),
    _Case(8, ((735, _LEFT),), {"z1": 0.552, "height": 1.052}),
    _Case(8, ((726, -0.33),), {"z1": 0.379}),
    _Case(9, ((731, _LEFT), (729, _LEFT)), {"height": 1.519}),
    _Case(9, ((731, _LEFT), (729, _LEFT + 0.03)), {"z2": "falls off"}, None),
    _Case(10, ((764, _LEFT),), {"z1": 0.574, "height": 1.074, "reward": 0.824}),
    _Case(11, ((726, 0.0),), {"z1": -0.305, "height": 0.342, "reward": 0.171}),
    _Case(11, ((764, 0.0),), {"z1": -0.109, "height": 0.391, "reward": 0.195}),
    _Case(12, ((735, 0.0),), {"z1": 0.363, "height": 0.863, "reward": 0.613}, 0.03),
    _Case(
        13,
        ((690, _LEFT), (684, _LEFT), (678, _LEFT)),
        {"z1": 0.478, "z2": 1.027, "z3": 1.492, "height": 1.992, "reward": 1.496},
    ),
    _Case(
        13,
        ((594, _LEFT), (588, _LEFT), (582, _LEFT)),
        {"z1": 0.656, "z2": 1.574, "z3": 2.425, "height": 2.925, "reward": 2.239},
    ),
    _Case(14, ((690, 1.0),), {"x1": 1.43}, 0.03),
    _Case(14, ((690, 1.0),), {"z1": -0.20, "height": 0.342}),
    _Case(15, ((290, 0.0), (80, 0.0)), {"z2": 0.973, "height": 1.47}),
    _Case(16, ((402, _LEFT), (678, _LEFT)), {"z2": "rests askew [C4], falls [C2]"}, None),
    _Case(16, ((500, _LEFT),), {"z1": "rests [C4], slides off [C2]"}, None),
)


def measured(engine: Engine) -> list[Row]:
    """The reference figures 3, 4 and 6 to 16 on an engine."""
    return [*_rests(engine), *_towers(engine), *_released(engine)]


def _towers(engine: Engine) -> list[Row]:
    """Every case: 300 steps after its last drop, or of the start scene alone."""
    count = len(_CASES)
    bodies = start_scenes([c.cylinder for c in _CASES], [0.0] * count, [1.3] * count)
    bodies = stack(engine, bodies, [c.drops or ((SETTLE_ONLY, 0.0),) for c in _CASES])
    heights = np.asarray(jax.vmap(rules.tower_height)(bodies))
    rewards = np.asarray(jax.vmap(rules.tower_reward)(bodies))
    rows = []
    for k, case in enumerate(_CASES):
        found = {"height": heights[k], "reward": rewards[k]}
        for j in range(len(case.drops)):
            x, _, z = np.asarray(bodies.qpos)[k, scene.NUM_START_CYLINDERS + j, :3]
            found |= {f"x{j + 1}": x, f"z{j + 1}": z}
        for name, spec in case.expected.items():
            what = f"{_described(case)}: {name}"
            rows.append(Row(case.check, what, spec, case.tolerance, float(found[name])))
    return rows


def _described(case: _Case) -> str:
    if not case.drops:
        return f"stop at once, cylinders {case.cylinder}"
    return ", ".join(f"{shape_name(i).split()[0]} {i} at x = {x:g}" for i, x in case.drops)


def rest_shapes() -> list[int]:
    """A shape of every class, of the middle of its scales."""
    library = shape_library()
    chosen = []
    for label in range(len(CLASS_NAMES)):
        ids = np.flatnonzero(library.class_labels == label)
        middle = library.scale_index[ids].max() // 2
        chosen.append(int(ids[library.scale_index[ids] == middle][0]))
    return chosen


def _rests(engine: Engine) -> list[Row]:
    """Every class dropped straight onto the empty table: height of its origin, and its tilt."""
    library, ids = shape_library(), rest_shapes()
    bodies = stack(engine, empty_scenes(len(ids)), [((i, 0.0),) for i in ids])
    qpos = np.asarray(bodies.qpos)[:, scene.NUM_START_CYLINDERS]
    rows = []
    for i, pose in zip(ids, qpos, strict=True):
        what = f"{shape_name(i).split()[0]} {i} alone on the table: "
        height = float(pose[2] - scene.TABLE_HEIGHT)
        # "About 1 mm or less" below the exact height.
        rows.append(Row(3, what + "height", float(0.0 - library.base[i]), 0.0015, height))
        rows.append(Row(3, what + "cosine of its tilt", 1.0, 0.001, upright(pose)))
    return rows


def upright(pose: np.ndarray) -> float:
    """Cosine between a body's z axis and the vertical; pose f[7]."""
    _, x, y, _ = pose[3:]
    return float(1.0 - 2.0 * (x**2 + y**2))


def _released(engine: Engine) -> list[Row]:
    """A rolling sphere and a tilted capsule, let go on the table."""
    sphere, capsule = 726, 764
    s = shape_library().s
    tilt = math.radians(20.0)
    qpos = np.array(empty_scenes(2).qpos)
    qvel = np.zeros((2, scene.NUM_SLOTS, 6), np.float32)
    ids = np.full((2, scene.NUM_SLOTS), -1, np.int32)
    ids[:, 0] = sphere, capsule
    qpos[0, 0, :3] = 0.0, 0.0, scene.TABLE_HEIGHT + s[sphere]
    qvel[0, 0, [0, 4]] = 1.0, 1.0 / s[sphere]
    qpos[1, 0, :3] = 0.0, 0.0, scene.TABLE_HEIGHT + s[capsule] * (1.0 + math.cos(tilt))
    qpos[1, 0, 3:] = math.cos(tilt / 2.0), 0.0, math.sin(tilt / 2.0), 0.0
    state = (jnp.asarray(array) for array in (ids, qpos, qvel))
    end = np.asarray(settled(engine, Bodies(*state)).qpos)[:, 0]
    rolling = "sphere 726 rolling on the table at 1 m/s: distance in 3 s"
    lying = "capsule 764 let go on the table at 20 degrees: cosine of its tilt"
    return [
        Row(9, rolling, 0.086, 0.02, float(end[0, 0])),
        Row(10, lying, 0.0, 0.02, abs(upright(end[1]))),
    ]
