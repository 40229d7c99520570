"""Shape Stacking's MJX engine: what makes it cheaper, and what that does to towers.

    python -m experiments.benchmarks.mjx_variants > results/shape_stacking/mjx_speed.md

Every variant settles the same worlds once: random play in which the 4th, 7th or 10th shape has just
been let go, and each class of shapes alone above the table. MuJoCo's C engine made their states and
says where bodies come to rest.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking import hulls, rules, scene, shape_library
from envs_mjx.shape_stacking.engines import Settled
from envs_mjx.shape_stacking.engines import mjx_pool as _mjx_pool
from envs_mjx.shape_stacking.engines._mjx_private import Contacts
from envs_mjx.shape_stacking.engines.hull_contacts import APART
from envs_mjx.shape_stacking.engines.mjx import Mjx
from envs_mjx.shape_stacking.engines.mujoco_c import MujocoC
from envs_mjx.shape_stacking.polyhedra import Polyhedron, prism, pyramid
from envs_mjx.shape_stacking.scene import Solver
from envs_mjx.shape_stacking.shapes import NUM_SHAPES
from envs_mjx.shape_stacking.solids import DOME_AXIS_HEIGHT, solids
from experiments.benchmarks import _measure as m
from experiments.untrained import towers as stacking
from jaxnew.storage.session import describe_session

ARGUMENTS = m.Benchmark(__doc__)
ARGUMENTS.define("integer", "worlds", 6, "Worlds of each stage of random play.", lower_bound=1)

_STAGES = (4, 7, 10)
_SEED = 5
_SAME_M = 0.01
_QUIET = 0.05  # m/s and rad/s: the release's own, for a stop that never came.

State = tuple[np.ndarray, np.ndarray, np.ndarray]


def _mjx_hull_pairs(
    pool: _mjx_pool.Pool, limit: int, gaps: jax.Array, centers: jax.Array, axes: jax.Array
) -> Contacts:
    """`_mjx_pool._hull_pairs` with MJX's routine for two hulls in place of ours."""
    from mujoco.mjx._src.collision_convex import _convex_convex

    i, j = _mjx_pool._pairs(len(centers))
    chosen, is_near = _mjx_pool._nearest(pool.is_hull[i] & pool.is_hull[j], gaps, limit)
    first, second = jnp.asarray(i)[chosen], jnp.asarray(j)[chosen]
    both = (_mjx_pool._hull(pool, which, centers, axes) for which in (first, second))
    distance, position, normal = jax.vmap(_convex_convex)(*both)
    distance = jnp.where(is_near[:, None], distance, APART)
    return _mjx_pool._contacts(distance, position, normal, first + 1, second + 1)


@contextlib.contextmanager
def _hulls_by_mjx() -> Iterator[None]:
    with mock.patch.object(_mjx_pool, "_hull_pairs", _mjx_hull_pairs):
        yield


def _coarse_hull(name: str) -> Polyhedron | None:
    """8-gons of the unit circle's area for cylinders and cones, 6 chords for the dome's arc."""
    angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    radius = np.sqrt(np.pi / (4.0 * np.sin(np.pi / 4.0)))  # Area: 4 R^2 sin(45 degrees).
    polygon = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    if name == "cylinder":
        return prism(polygon, axis=2)
    if name in ("cone", "cone-hires"):
        return pyramid(polygon)
    if name == "dome":
        angles = np.linspace(0.0, np.pi, 7)
        return prism(np.stack([np.cos(angles), np.sin(angles) + DOME_AXIS_HEIGHT], -1), axis=1)
    return None


@contextlib.contextmanager
def _coarse_hulls() -> Iterator[None]:
    with mock.patch.multiple(
        hulls, MAX_VERTICES=16, MAX_FACES=10, MAX_FACE_VERTICES=8, MAX_EDGES=24
    ):
        rows = [
            hulls._row(replace(solid, hull=_coarse_hull(solid.name) or solid.hull))
            for solid in solids()
        ]
    table = hulls.HullTable(**{key: np.stack([row[key] for row in rows]) for key in rows[0]})
    constants = _mjx_pool._constants() | _mjx_pool.hull_constants(table)
    with mock.patch.object(_mjx_pool, "_constants", return_value=constants):
        yield


@dataclass(frozen=True)
class Variant:
    """A way to build the engine.

    Attributes:
      what: differs from the default.
      options: of `Mjx`.
      patch: in force while the program is traced.
    """

    what: str
    options: dict[str, Any] = field(default_factory=dict)
    patch: Callable[[], Any] = contextlib.nullcontext


def _variants() -> list[Variant]:
    spec = {"solver": Solver(8, 12)}
    return [
        Variant("MJX's routine for two hulls, solver 8/12 (the first design)", spec, _hulls_by_mjx),
        Variant("our routine for two hulls, solver 8/12", spec),
        Variant("our routine, solver 5/5", {"solver": Solver(5, 5)}),
        Variant("default: our routine, solver 3/5"),
        Variant("solver 2/3 (misses check 14)", {"solver": Solver(2, 3)}),
        Variant("solver 3/5, tolerance 1e-6", {"solver": Solver(3, 5, 1e-6)}),
        Variant("32 contacts", {"max_contacts": 32}),
        Variant("24 contacts", {"max_contacts": 24}),
        Variant("8-gons for cylinders and cones, 6 chords for domes", patch=_coarse_hulls),
        Variant("16, 12 and 6 pairs", {"limits": _mjx_pool.Limits(16, 12, 6)}),
        Variant("1 pair of each kind (no physics)", {"limits": _mjx_pool.Limits(1, 1, 1)}),
    ]


@dataclass(frozen=True)
class Scenes:
    """Worlds before a settling, and what becomes of them in C.

    Attributes:
      state: ids, qpos and qvel; the last 16 worlds hold one shape of each class.
      rests: int32[16] those shapes.
      reference: qpos in C with several contacts of two hulls.
    """

    state: State
    rests: np.ndarray
    reference: np.ndarray


def scenes(worlds: int, steps: int) -> Scenes:
    """Random play on C, each world stopped when a shape has just been let go."""
    engine = MujocoC(steps, has_multiple_contacts=True)
    parts, sets, starts = [], [], []
    for i in range(worlds):
        rng = np.random.default_rng([_SEED, i])
        sets.append(rng.choice(NUM_SHAPES, 20, replace=False))
        cylinder = rng.choice(rules.START_CYLINDERS)
        starts.append((cylinder, rng.uniform(*rules.START_CENTER), rng.uniform(*rules.START_GAP)))
    for stage in _STAGES:
        bodies = stacking.start_scenes(*zip(*starts, strict=True))
        drops = []
        for i, available in enumerate(sets):
            rng = np.random.default_rng([_SEED, stage, i])
            ids = rng.permutation(available)[:stage]
            drops.append([(int(k), float(rng.uniform(-1.0, 1.0))) for k in ids])
        bodies = stacking.stack(engine, bodies, [row[:-1] for row in drops])
        parts.append(_let_go(bodies, stage + 1, [row[-1] for row in drops]))
    rests = np.array(stacking.rest_shapes(), np.int32)
    parts.append(_let_go(stacking.empty_scenes(len(rests)), 0, [(int(i), 0.0) for i in rests]))
    state = tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Scenes(state, rests, engine.settle_host(*state)[0])  # type: ignore[arg-type]


def _let_go(bodies: rules.Bodies, slot: int, drops: list[stacking.Drop]) -> State:
    ids = jnp.array([i for i, _ in drops], jnp.int32)
    position = jnp.array([[x, 0.0] for _, x in drops], jnp.float32)
    placed = jax.vmap(rules.place, (0, None, 0, 0))(bodies, slot, ids, position)
    return np.array(placed.shape_ids), np.array(placed.qpos), np.array(placed.qvel)


def outcome(found: Settled, at: Scenes) -> list[str]:
    """Cells: rest heights, and agreement with C."""
    ids, qpos = at.state[0], np.asarray(found.qpos)
    count = len(at.rests)
    height = qpos[-count:, 0, 2] - scene.TABLE_HEIGHT + shape_library().base[at.rests]
    used, z, z_c = (x[:-count] for x in (ids >= 0, qpos[..., 2], at.reference[..., 2]))
    tall, tall_c = (np.where(used, x, -np.inf).max(axis=1) for x in (z, z_c))
    difference = tall - tall_c
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    return [
        f"{1e3 * np.abs(height).max():.2f}",
        f"{np.mean(np.abs(z - z_c)[used] < _SAME_M):.1%}",
        f"{np.mean(np.abs(difference) < _SAME_M):.0%}",
        f"{difference.mean():+.3f} +- {error:.3f}",
        str(int((~np.asarray(found.ok)).sum())),
    ]


def measured(variant: Variant, at: Scenes, steps: int) -> list[str]:
    """A row of the table."""
    with variant.patch():
        engine = Mjx(steps, **variant.options)
        subject = m.compiled(engine.settle, lambda _: at.state)
    result, cost = m.timed(lambda: subject.call(*at.state))
    assert subject.compilation is not None
    per_step = cost.cpu_s / (len(at.state[0]) * steps)
    cells = [f"{subject.compilation.cpu_s:.0f}", f"{1e3 * per_step:.2f}"]
    row = [variant.what, *cells, *outcome(result, at)]
    print(*row, sep="; ", file=sys.stderr, flush=True)
    return row


def in_c(what: str, at: Scenes, steps: int, several: bool, noise: float) -> list[str]:
    """The row of C, started from positions that are off by a random `noise`, m."""
    ids, qpos, qvel = at.state
    moved = qpos.copy()
    moved[..., :3] += noise * np.random.default_rng(0).normal(size=moved[..., :3].shape)
    engine = MujocoC(steps, num_threads=1, has_multiple_contacts=several)
    result, cost = m.timed(lambda: engine.settle_host(ids, moved, qvel))
    per_step = cost.cpu_s / (len(ids) * steps)
    return [what, "", f"{1e3 * per_step:.3f}", *outcome(Settled(*map(jnp.asarray, result)), at)]


def quiet_after(at: Scenes, steps: int) -> str:
    """When all bodies of a world are slow, in C: what stopping early could save."""
    ids, qpos, qvel = at.state
    chunk = max(1, steps // 15)
    engine = MujocoC(chunk, has_multiple_contacts=True)
    last = np.zeros(len(ids), int)
    for done in range(chunk, steps + 1, chunk):
        qpos, qvel, _ = engine.settle_host(ids, qpos, qvel)
        is_slow = (np.abs(qvel) < _QUIET).all(axis=(1, 2))
        last = np.where(is_slow, last, done)
    random = last[: -len(at.rests)]
    return (
        f"median {np.median(random):.0f}, 90 % {np.quantile(random, 0.9):.0f}, all {random.max()}"
    )


HEADER = (
    *("variant", "compile, cpu-s", "cpu-ms per world and step", "rest heights off by, mm"),
    *("bodies within 1 cm of C", "towers within 1 cm", "height - C's, m", "failed"),
)


def main() -> None:
    steps, worlds = (5, 2) if ARGUMENTS.quick else (scene.SETTLE_STEPS, ARGUMENTS.worlds)
    at = scenes(worlds, steps)
    rows = [
        in_c("C, several contacts, starts off by 1e-5 m", at, steps, True, 1e-5),
        in_c("C, one contact of two hulls", at, steps, False, 0.0),
    ]
    variants = _variants()[:1] if ARGUMENTS.quick else _variants()
    rows += [measured(variant, at, steps) for variant in variants]
    session = describe_session()
    print("# Shape Stacking: the MJX engine's speed and what it hangs on\n")
    print(f"    python -m experiments.benchmarks.mjx_variants {' '.join(sys.argv[1:])}".rstrip())
    print(f"\n{', '.join(session['devices'])}; {session['machine']}")
    count = len(at.state[0])
    print(f"{count} worlds of 12 slots, {steps} steps; {count - len(at.rests)} of random play.")
    print("Processor time of all threads; other work may have run on the machine.\n")
    print(m.markdown(HEADER, rows))
    print(
        "\nHeights: mean over random play and its standard error. Steps until all bodies of such a"
    )
    print(
        f"world are slow for good (below {_QUIET:g} m/s and rad/s, in C): {quiet_after(at, steps)}."
    )


if __name__ == "__main__":
    ARGUMENTS.start(main)
