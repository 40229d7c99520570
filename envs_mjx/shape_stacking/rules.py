"""The rules of stacking as pure functions: starts, drops, heights, rewards.

All are for one world and may be vmapped. `shapes` are those of the user's own, with ids from 810.
See docs/shape_stacking.md, "Start", "Action" and "Height and reward".
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.shape_stacking import scene
from envs_mjx.shape_stacking.shapes import Shape, shape_library

# Two copies of one of these stand on the table when an episode starts.
START_CYLINDERS = (798, 799, 800)
START_CENTER = (-0.2, 0.2)
START_GAP = (1.0, 1.6)

RewardVariant = Literal["release", "paper"]
REWARD_VARIANTS = get_args(RewardVariant)

# A body is dropped so that its bounding sphere overlaps the one below by this much of its scale.
_OVERLAP = 0.1
_UNUSED = -1


@struct.dataclass
class Bodies:
    """The pool of bodies; the first two are the start cylinders.

    Attributes:
      shape_ids: int32[12] below 0 for an unused body.
      qpos: f32[12, 7] position of the origin, m, and quaternion (w, x, y, z).
      qvel: f32[12, 6] linear velocity in world axes, m/s, and angular in the body's, rad/s.
    """

    shape_ids: jax.Array
    qpos: jax.Array
    qvel: jax.Array

    @property
    def is_used(self) -> jax.Array:
        """bool[12]."""
        return self.shape_ids >= 0


@struct.dataclass
class ShapeTable:
    """What the rules ask about each shape, as arrays; see `shapes.ShapeLibrary`.

    Attributes:
      s: f32[A] m.
      quaternion: f32[A, 4] of the yaw.
      center_of_mass: f32[A, 3] relative to the origin, m.
      bounding_radius: f32[A] m.
    """

    s: jax.Array
    quaternion: jax.Array
    center_of_mass: jax.Array
    bounding_radius: jax.Array


@lru_cache(maxsize=8)
def shape_table(shapes: tuple[Shape, ...]) -> ShapeTable:
    """The library's, as NumPy arrays, so that every program may hold them as constants."""
    library = shape_library(shapes)
    fields = (library.s, library.quaternion, library.center_of_mass, library.bounding_radius)
    return ShapeTable(*(np.asarray(field, np.float32) for field in fields))  # type: ignore[arg-type]


def start(
    cylinder_id: jax.Array | int, center: jax.Array | float, gap: jax.Array | float
) -> Bodies:
    """Two equal cylinders at rest on the table at x = center -+ gap / 2; all else is parked.

    Args:
      cylinder_id: int32[] one of `START_CYLINDERS`.
      center, gap: f32[] m; see `START_CENTER`, `START_GAP`.
    """
    half = jnp.asarray(gap, jnp.float32) / 2.0
    x = jnp.asarray(center, jnp.float32) + jnp.stack([-half, half])
    z = scene.TABLE_HEIGHT + jnp.asarray(shape_table(()).s)[cylinder_id]
    qpos = jnp.asarray(scene.parked_qpos())
    qpos = qpos.at[:2, :3].set(jnp.stack([x, jnp.zeros_like(x), jnp.full(2, z)], axis=-1))
    shape_ids = jnp.full(scene.NUM_SLOTS, _UNUSED, jnp.int32).at[:2].set(cylinder_id)
    return Bodies(shape_ids, qpos, jnp.zeros((scene.NUM_SLOTS, 6), jnp.float32))


def top(bodies: Bodies, shapes: tuple[Shape, ...] = ()) -> jax.Array:
    """f32[] highest z of a bounding sphere around a centre of mass; 0 with no bodies."""
    table = jax.tree.map(jnp.asarray, shape_table(shapes))
    offsets = _rotated(bodies.qpos[:, 3:], table.center_of_mass[bodies.shape_ids])
    tops = bodies.qpos[:, 2] + offsets[:, 2] + table.bounding_radius[bodies.shape_ids]
    highest = jnp.max(tops, where=bodies.is_used, initial=-jnp.inf)
    return jnp.where(bodies.is_used.any(), highest, 0.0)


def drop_height(
    bodies: Bodies, shape_id: jax.Array | int, shapes: tuple[Shape, ...] = ()
) -> jax.Array:
    """f32[] z at which the origin of a new body of this shape is let go, m."""
    table = jax.tree.map(jnp.asarray, shape_table(shapes))
    return top(bodies, shapes) + table.bounding_radius[shape_id] - _OVERLAP * table.s[shape_id]


def place(
    bodies: Bodies,
    slot: jax.Array | int,
    shape_id: jax.Array | int,
    position: jax.Array,
    shapes: tuple[Shape, ...] = (),
) -> Bodies:
    """Puts a new body above the others, turned by its yaw, and stops all bodies.

    Args:
      bodies: before.
      slot: int32[] an unused body of the pool.
      shape_id: int32[].
      position: f32[2] x and y of the new body's origin, m.
      shapes: of the user's own.
    """
    height = drop_height(bodies, shape_id, shapes)
    quaternion = jnp.asarray(shape_table(shapes).quaternion)[shape_id]
    pose = jnp.concatenate([position, height[None], quaternion]).astype(jnp.float32)
    return Bodies(
        shape_ids=bodies.shape_ids.at[slot].set(shape_id),
        qpos=bodies.qpos.at[slot].set(pose),
        qvel=jnp.zeros_like(bodies.qvel),
    )


def tower_height(bodies: Bodies) -> jax.Array:
    """f32[] height of the highest origin above the table, m; 0 with no bodies.

    It is an origin, not an upper surface: a hat's is in its base.
    """
    heights = bodies.qpos[:, 2] - scene.TABLE_HEIGHT
    highest = jnp.max(heights, where=bodies.is_used, initial=-jnp.inf)
    return jnp.where(bodies.is_used.any(), highest, 0.0)


def tower_reward(bodies: Bodies, variant: str = "release") -> jax.Array:
    """f32[] reward at the end of an episode: half the tower's height, half a mean.

    Args:
      bodies: at the end.
      variant: `release`: the mean of the z above 0 (not above the table), 0 where there is none.
        `paper`: the mean of all heights above the table.

    Raises:
      ValueError: there is no such variant.
    """
    if variant not in REWARD_VARIANTS:
        raise ValueError(f"variant={variant!r} is unknown; choose from {REWARD_VARIANTS}.")
    z = bodies.qpos[:, 2]
    if variant == "release":
        counted, values = bodies.is_used & (z > 0.0), z
    else:
        counted, values = bodies.is_used, z - scene.TABLE_HEIGHT
    total = jnp.sum(values, where=counted)
    mean = total / jnp.maximum(jnp.sum(counted, dtype=jnp.float32), 1.0)
    return 0.5 * tower_height(bodies) + 0.5 * mean


def _rotated(quaternions: jax.Array, vectors: jax.Array) -> jax.Array:
    """Vectors f32[n, 3] turned by unit quaternions (w, x, y, z), f32[n, 4]."""
    w, axis = quaternions[:, :1], quaternions[:, 1:]
    crossed = 2.0 * jnp.cross(axis, vectors)
    return vectors + w * crossed + jnp.cross(axis, crossed)
