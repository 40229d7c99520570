"""Shape Stacking's play environment: each shape alone, seen from all around (spec 7)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from envs_mjx.shape_stacking.camera import FRAME_SIZE, orbit_camera, render_rgb
from envs_mjx.shape_stacking.shapes import NUM_SHAPES, shape_library

NUM_VIEWS = 1024
PICTURE_SHAPE = (FRAME_SIZE, FRAME_SIZE, 3)

_HEIGHTS = (0.5, 2.0)
# Pictures drawn side by side. A core is fastest with one (0.9 ms each; 1.4 ms with 16).
_VIEWS_AT_ONCE = {"cpu": 1}
_VIEWS_AT_ONCE_ELSEWHERE = 64


def viewpoints(
    seed: int, num_recordings: int, num_distinct_views: int = NUM_VIEWS
) -> tuple[np.ndarray, np.ndarray]:
    """Where pictures are taken from, the same for all shapes (spec 7).

    Azimuths are uniform in [0, 2 pi), heights in [0.5, 2.0]. Recording k uses view
    `k % num_distinct_views`, and view k depends on `seed` and k only.

    Args:
      seed: of the views.
      num_recordings: S.
      num_distinct_views: views before they repeat; 32 mimics the original's files, which hold 1024
        pictures of 32 views.

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
    """Pictures of shapes; see `jaxnew.observations.collect`.

    A shape's origin is at (0, 0, 0), it has the yaw and the colour of its id, the background is
    black. Nothing moves: the step that the original simulates before it looks is left out.

    Args:
      seed: of the viewpoints, which all shapes share.
      ids: int32[n] shapes.
      num_recordings: S, pictures per shape.
      num_distinct_views: see `viewpoints`.

    Returns:
      uint8[n, S, 84, 84, 3] RGB.

    Raises:
      ValueError: an id is no shape.
    """
    ids = np.asarray(ids)
    outside = ids[(ids < 0) | (ids >= NUM_SHAPES)]
    if outside.size:
        raise ValueError(f"Shape {outside[0]} does not exist; ids are 0..{NUM_SHAPES - 1}.")
    azimuth, height = viewpoints(seed, num_recordings, num_distinct_views)
    views_at_once = _VIEWS_AT_ONCE.get(jax.default_backend(), _VIEWS_AT_ONCE_ELSEWHERE)
    return np.asarray(_record(jnp.asarray(ids, jnp.int32), azimuth, height, views_at_once))


@partial(jax.jit, static_argnames="views_at_once")
def _record(ids: jax.Array, azimuth: jax.Array, height: jax.Array, views_at_once: int) -> jax.Array:
    """uint8[n, S, 84, 84, 3], one shape after the other."""

    def of_shape(shape_id: jax.Array) -> jax.Array:
        look = partial(_picture, shape_id)
        return jax.lax.map(look, (azimuth, height), batch_size=views_at_once)

    return jax.lax.map(of_shape, ids)


def _picture(shape_id: jax.Array, view: tuple[jax.Array, jax.Array]) -> jax.Array:
    """uint8[84, 84, 3]"""
    quaternion = jnp.asarray(shape_library().quaternion, jnp.float32)[shape_id]
    camera = orbit_camera(*view)
    # A shape alone has nothing to cast shadows on, but for the sides of an arch's opening.
    return render_rgb(
        shape_id[None],
        jnp.zeros((1, 3)),
        quaternion[None],
        camera,
        has_table=False,
        has_shadows=False,
    )
