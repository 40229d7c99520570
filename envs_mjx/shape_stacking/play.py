"""Shape Stacking's play environment: each shape alone, seen from all around.

See docs/shape_stacking.md, "Play data".
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking.camera import FRAME_SIZE, orbit_camera, render_rgb
from envs_mjx.shape_stacking.shapes import Shape, shape_library

NUM_VIEWS = 1024
PICTURE_SHAPE = (FRAME_SIZE, FRAME_SIZE, 3)

_HEIGHTS = (0.5, 2.0)
# Pictures drawn side by side. A core is fastest with one (0.9 ms each; 1.4 ms with 16).
_VIEWS_AT_ONCE = {"cpu": 1}
_VIEWS_AT_ONCE_ELSEWHERE = 64


def viewpoints(
    seed: int, num_recordings: int, num_distinct_views: int = NUM_VIEWS
) -> tuple[np.ndarray, np.ndarray]:
    """Where pictures are taken from, the same for all shapes.

    Azimuths are uniform in [0, 2 pi), heights in [0.5, 2.0]. Recording k uses view
    `k % num_distinct_views`, and view k depends on `seed` and k only.

    Args:
      seed: of the views.
      num_recordings: S.
      num_distinct_views: views before they repeat; 32 mimics the original's files, which hold 1024
        pictures of 32 views. No command has it; a task of one's own gives its `Play`
        `partial(record_block, num_distinct_views=32)`.

    Returns:
      f32[S] azimuth, rad, and f32[S] height, m.

    Raises:
      ValueError: there is no view to record.
    """
    if num_distinct_views < 1:
        raise ValueError(f"num_distinct_views={num_distinct_views} must be 1 or more.")
    rng = np.random.default_rng(seed)
    drawn = rng.uniform((0.0, _HEIGHTS[0]), (2.0 * np.pi, _HEIGHTS[1]), (num_distinct_views, 2))
    azimuth, height = drawn[np.arange(num_recordings) % num_distinct_views].astype(np.float32).T
    return azimuth, height


def record_block(
    seed: int, ids: np.ndarray, num_recordings: int, num_distinct_views: int = NUM_VIEWS
) -> np.ndarray:
    """The viewpoints that shapes are recorded from; `draw_pictures` makes pictures of them.

    See `jaxnew.collection.collect`.

    Args:
      seed: of the viewpoints, which all shapes share.
      ids: int32[n] shapes.
      num_recordings: S, pictures per shape.
      num_distinct_views: see `viewpoints`.

    Returns:
      f32[n, S, 2] azimuth, rad, and height, m.
    """
    views = np.stack(viewpoints(seed, num_recordings, num_distinct_views), axis=-1)
    return np.tile(views, (len(ids), 1, 1))


def draw_pictures(ids: np.ndarray, views: np.ndarray, shapes: tuple[Shape, ...] = ()) -> np.ndarray:
    """Pictures of shapes.

    A shape's origin is at (0, 0, 0), it has the yaw and the colour of its id, the background is
    black. Nothing moves: the step that the original simulates before it looks is left out.

    Args:
      ids: int32[n] shapes.
      views: f32[n, 2] azimuth, rad, and height, m, of each.
      shapes: of the user's own, with ids from 810.

    Returns:
      uint8[n, 84, 84, 3] RGB.

    Raises:
      ValueError: an id is no shape.
    """
    ids, num_shapes = np.asarray(ids), len(shape_library(shapes).s)
    outside = ids[(ids < 0) | (ids >= num_shapes)]
    if outside.size:
        raise ValueError(f"Shape {outside[0]} does not exist; ids are 0..{num_shapes - 1}.")
    views_at_once = _VIEWS_AT_ONCE.get(jax.default_backend(), _VIEWS_AT_ONCE_ELSEWHERE)
    arrays = jnp.asarray(ids, jnp.int32), jnp.asarray(views, jnp.float32)
    return np.asarray(_draw(*arrays, views_at_once, shapes))


@partial(jax.jit, static_argnames=("views_at_once", "shapes"))
def _draw(
    ids: jax.Array, views: jax.Array, views_at_once: int, shapes: tuple[Shape, ...] = ()
) -> jax.Array:
    """uint8[n, 84, 84, 3]"""
    return jax.lax.map(
        lambda x: _picture(x[0], x[1], shapes), (ids, views), batch_size=views_at_once
    )


def _picture(shape_id: jax.Array, view: jax.Array, shapes: tuple[Shape, ...]) -> jax.Array:
    """uint8[84, 84, 3] from view f32[2]."""
    quaternion = jnp.asarray(shape_library(shapes).quaternion, jnp.float32)[shape_id]
    camera = orbit_camera(view[0], view[1])
    # A shape alone has nothing to cast shadows on, but for the sides of an arch's opening.
    return render_rgb(
        shape_id[None],
        jnp.zeros((1, 3), jnp.float32),
        quaternion[None],
        camera,
        has_table=False,
        has_shadows=False,
        shapes=shapes,
    )
