"""Pictures of towers, by casting rays inside jit.

See docs/shape_stacking.md, "Camera", "Light" and "Play data".
"""

from __future__ import annotations

import math

import chex
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking.rays import Bodies, Hits, Vector, dot, nearest, normals, walk
from envs_mjx.shape_stacking.scene import TABLE_HEIGHT
from envs_mjx.shape_stacking.shapes import Shape, shape_library

FRAME_SIZE = 84
# The table as it is drawn: half-sizes along x and y, m, and gray.
TABLE_HALF_SIZES = (4.0, 2.0)
TABLE_COLOR = 0.9

_FIELD_OF_VIEW = math.radians(45.0)
_EMISSION = 0.25
_AMBIENT = 0.1
_HEADLIGHT = 0.4
_SPOT_POSITIONS = ((0.0, 4.0, 4.0), (0.0, 4.0, 1.0))
_SPOT_DIFFUSE = 1.5
_SPOT_EXPONENT = 10
_SPOT_CUTOFF = math.cos(math.radians(45.0))
# How far a shadow's ray starts off the surface, m: above rounding, below any shape's size.
_SHADOW_GAP = 1e-3
_GRAY = (0.299, 0.587, 0.114)


@flax.struct.dataclass
class Camera:
    """Where a picture is taken from.

    Attributes:
      position: f32[3] m.
      right, down, forward: f32[3] unit vectors: along growing columns, along growing rows, and
        into the picture. A mirrored picture has a left-handed triple.
    """

    position: jax.Array
    right: jax.Array
    down: jax.Array
    forward: jax.Array


def task_camera(position_dim: int = 1) -> Camera:
    """The camera of the stacking task.

    The original renders upside down and never turns its rows over, so that the picture is upright
    but mirrored: columns grow with x although the camera looks along -y.

    Args:
      position_dim: coordinates that an action sets: 0 or 1 (seen from the front) or 2 (from above).

    Raises:
      ValueError: there is no such variant.
    """
    if position_dim not in (0, 1, 2):
        raise ValueError(f"position_dim={position_dim} is not a variant; it is 0, 1 or 2.")
    position, turn = ((0.0, 7.0, 2.0), -1.57) if position_dim < 2 else ((0.0, 4.0, 5.0), -0.8)
    return Camera(
        position=jnp.array(position, jnp.float32),
        right=jnp.array((1.0, 0.0, 0.0), jnp.float32),
        down=jnp.array((0.0, math.cos(turn), math.sin(turn)), jnp.float32),
        forward=jnp.array((0.0, math.sin(turn), -math.cos(turn)), jnp.float32),
    )


def orbit_camera(azimuth: jax.Array, height: jax.Array, distance: float = 2.0) -> Camera:
    """A camera that looks at the origin, upright and not mirrored.

    Args:
      azimuth: f32[] rad, from +x towards +y.
      height: f32[] m above the origin.
      distance: horizontal, m.
    """
    position = jnp.stack([distance * jnp.cos(azimuth), distance * jnp.sin(azimuth), height])
    forward = -position / jnp.linalg.norm(position)
    right = jnp.stack([-jnp.sin(azimuth), jnp.cos(azimuth), jnp.zeros_like(azimuth)])
    return Camera(position=position, right=right, down=jnp.cross(forward, right), forward=forward)


def render(
    shape_ids: jax.Array,
    positions: jax.Array,
    quaternions: jax.Array,
    camera: Camera,
    *,
    has_shadows: bool = True,
    shapes: tuple[Shape, ...] = (),
) -> jax.Array:
    """The observation of the task: shapes on their table.

    The original casts shadows. Without them a picture costs a third and means rise by about 2 %.

    Args:
      shape_ids: int32[N], see `render_rgb`.
      positions: f32[N, 3] m.
      quaternions: f32[N, 4].
      camera: usually `task_camera`.
      has_shadows: whether the two spots cast shadows.
      shapes: of the user's own, with ids from 810.

    Returns:
      uint8[84, 84] 0.299 R + 0.587 G + 0.114 B of the 8-bit picture, rounded.
    """
    picture = render_rgb(
        *(shape_ids, positions, quaternions, camera),
        has_table=True,
        has_shadows=has_shadows,
        shapes=shapes,
    )
    red, green, blue = jnp.moveaxis(picture.astype(jnp.float32), -1, 0)
    gray = _GRAY[0] * red + _GRAY[1] * green + _GRAY[2] * blue
    return jnp.round(gray).astype(jnp.uint8)


def render_rgb(
    shape_ids: jax.Array,
    positions: jax.Array,
    quaternions: jax.Array,
    camera: Camera,
    *,
    has_table: bool,
    has_shadows: bool,
    size: int = FRAME_SIZE,
    shapes: tuple[Shape, ...] = (),
) -> jax.Array:
    """A picture of shapes before a black background. Pure; all arrays may be traced and vmapped.

    Args:
      shape_ids: int32[N] ids of the library; an id below 0 is not drawn, one beyond the library as
        its last.
      positions: f32[N, 3] origins of the shapes, m; a shape at one that is not finite is not drawn.
      quaternions: f32[N, 4] (w, x, y, z) rotations of the shapes, the yaw of their ids included
        (`ShapeLibrary.quaternion` for a shape as it is dropped); unit length.
      camera: where from.
      has_table: whether the table's top is drawn.
      has_shadows: whether the two spots cast shadows.
      size: pixels of a side.
      shapes: of the user's own, with ids from 810.

    Returns:
      uint8[size, size, 3] RGB, row 0 on top.

    Raises:
      ValueError: there is no pixel.
    """
    if size < 1:
        raise ValueError(f"size={size} must be 1 or more.")
    library = shape_library(shapes)
    ids = jnp.asarray(shape_ids, jnp.int32)
    chex.assert_rank(ids, 1)
    chex.assert_shape(positions, (len(ids), 3))
    chex.assert_shape(quaternions, (len(ids), 4))
    bodies = Bodies(
        label=jnp.asarray(library.class_labels)[ids],
        s=jnp.where(ids < 0, 0.0, jnp.asarray(library.s, jnp.float32)[ids]),
        position=jnp.asarray(positions, jnp.float32),
        rotation=_rotation(jnp.asarray(quaternions, jnp.float32)),
    )
    directions = _directions(camera, size)
    origin = (camera.position[0], camera.position[1], camera.position[2])
    hits = nearest(bodies, origin, directions, _table_distance(origin, directions, has_table))
    points = walk(origin, jnp.where(jnp.isfinite(hits.distance), hits.distance, 0.0), directions)
    light = _light(bodies, hits, points, camera, has_shadows)
    colors = jnp.asarray(library.color, jnp.float32)[ids]
    color = jnp.where(hits.surface[:, None] < 0, TABLE_COLOR, colors[hits.body])
    light = jnp.where(jnp.isfinite(hits.distance), light, 0.0)
    picture = jnp.clip(color * light[:, None], 0.0, 1.0)
    return jnp.round(255.0 * picture).astype(jnp.uint8).reshape(size, size, 3)


def _light(
    bodies: Bodies, hits: Hits, points: Vector, camera: Camera, has_shadows: bool
) -> jax.Array:
    """f32[P] how bright surfaces are, relative to their colour."""
    normal = normals(bodies, hits, points)
    light = _AMBIENT + jnp.where(hits.surface < 0, jnp.float32(0.0), _EMISSION)
    light += _HEADLIGHT * jnp.maximum(-dot(normal, camera.forward), 0.0)
    for spot in _SPOT_POSITIONS:
        towards, distance = _towards(spot, points)
        cosine = towards[1]  # Both spots point along -y.
        beam = jnp.where(cosine > _SPOT_CUTOFF, cosine, 0.0) ** _SPOT_EXPONENT
        added = _SPOT_DIFFUSE * jnp.maximum(dot(normal, towards), 0.0) * beam
        if has_shadows:
            above = walk(points, jnp.float32(_SHADOW_GAP), normal)
            is_lit = nearest(bodies, above, towards, distance).surface < 0
            added = jnp.where(is_lit, added, 0.0)
        light += added
    return light


def _towards(spot: tuple[float, float, float], points: Vector) -> tuple[Vector, jax.Array]:
    """Unit vectors towards a light, and its distance f32[P] in m."""
    x, y, z = (spot[0] - points[0], spot[1] - points[1], spot[2] - points[2])
    distance = jnp.sqrt(x * x + y * y + z * z)
    return (x / distance, y / distance, z / distance), distance


def _directions(camera: Camera, size: int) -> Vector:
    """f32[size * size] each: unit vectors through the middles of the pixels, row by row."""
    focal = size / 2.0 / math.tan(_FIELD_OF_VIEW / 2.0)
    steps = (np.arange(size, dtype=np.float32) - (size - 1) / 2.0) / focal
    rows, columns = np.repeat(steps, size), np.tile(steps, size)
    lengths = np.sqrt(1.0 + rows**2 + columns**2)
    x, y, z = (
        (camera.forward[axis] + columns * camera.right[axis] + rows * camera.down[axis]) / lengths
        for axis in range(3)
    )
    return x, y, z


def _table_distance(origin: Vector, directions: Vector, has_table: bool) -> jax.Array:
    """f32[P] to the table's top, seen from above; inf where it is not met."""
    nowhere = jnp.full(directions[0].shape, jnp.inf, jnp.float32)
    if not has_table:
        return nowhere
    is_down = directions[2] < 0.0
    distance = (TABLE_HEIGHT - origin[2]) / jnp.where(is_down, directions[2], -1.0)
    x, y, _ = walk(origin, distance, directions)
    is_met = is_down & (distance > 0.0)
    is_met &= (jnp.abs(x) <= TABLE_HALF_SIZES[0]) & (jnp.abs(y) <= TABLE_HALF_SIZES[1])
    return jnp.where(is_met, distance, nowhere)


def _rotation(quaternions: jax.Array) -> jax.Array:
    """f32[..., 3, 3] matrices of unit quaternions (w, x, y, z)."""
    w, x, y, z = jnp.moveaxis(quaternions, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
